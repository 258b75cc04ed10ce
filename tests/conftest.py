"""Strict JAX for every test: 64-bit, no silent promotion of dtype or rank, annotated shapes checked while running."""

import gc
import os
import tempfile
from pathlib import Path

from jaxtyping import install_import_hook

# A compilation cache that survives the run: compiling is most of what the tests spend. Programs that call the host are
# not kept in it, so the checks of the solvers underneath give NaN and do not raise.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(tempfile.gettempdir()) / "ltljax-tests-jax-cache"))
os.environ.setdefault("EQX_ON_ERROR", "nan")

with install_import_hook("ltljax", "beartype.beartype"):
    import ltljax  # noqa: F401  (imported here first, so that the hook sees it)

import jax
import pytest

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)

MESHES = Path(__file__).parents[2] / "shared" / "meshes"


@pytest.fixture(autouse=True, scope="module")
def few_compiled_functions():
    """Compiled functions are let go of after each file: every one keeps pages mapped, and the kernel allows 65,530."""
    yield
    _let_go()


@pytest.fixture(autouse=True)
def few_compiled_functions_of_a_slow_test(request):
    """And after each slow test, which may compile hundreds."""
    yield
    if request.node.get_closest_marker("slow"):
        _let_go()


def _let_go():
    jax.clear_caches()
    gc.collect()


@pytest.fixture
def real_mesh():
    """The path of a real mesh by name; tests that ask for it are skipped where the meshes are not at hand."""

    def path(name: str) -> Path:
        if not (MESHES / name).exists():
            pytest.skip(f"the mesh {name} is not at hand")
        return MESHES / name

    return path

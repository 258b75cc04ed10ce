"""Strict JAX for every test: 64-bit, no silent promotion of dtype or rank.

With LTLJAX_CHECK_SHAPES=1 the annotated shapes are checked while the tests run, which takes about half as long again.
"""

import functools
import gc
import os
import tempfile
from pathlib import Path

from jaxtyping import install_import_hook

# A compilation cache that survives the run: compiling is most of what the tests spend. Programs that call the host are
# not kept in it, so the checks of the solvers underneath give NaN and do not raise.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(tempfile.gettempdir()) / "ltljax-tests-jax-cache"))
os.environ.setdefault("EQX_ON_ERROR", "nan")

if os.environ.get("LTLJAX_CHECK_SHAPES") == "1":
    with install_import_hook("ltljax", "beartype.beartype"):
        import ltljax  # noqa: F401  (imported here first, so that the hook sees it)

import jax
import jaxtyping
import pytest

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)

MESHES = Path(__file__).parents[2] / "shared" / "meshes"
CASES = Path(__file__).parents[2] / "shared" / "cases"


# The files that take longest, which begin first, so that no process is left alone with one of them in the end.
_LONGEST = ("notebooks", "robustness", "process", "recovery", "fit", "taped", "steppers", "scenarios", "distance")


def pytest_collection_modifyitems(items):
    """Order the files by how long they take; the tests of a file keep their order."""
    rank = {f"test_{name}.py": index for index, name in enumerate(_LONGEST)}
    items.sort(key=lambda item: rank.get(item.path.name, len(rank)))


# Every compiled function keeps pages mapped. Linux allows a process 65,530 mappings and XLA crashes beyond them.
_MOST_MAPPINGS = 25_000


@pytest.fixture(autouse=True, scope="module")
def clear_compiled_functions_of_a_file():
    """Forget the compiled functions of a file of tests after it."""
    yield
    _clear_compiled_functions()


@pytest.fixture(autouse=True)
def clear_compiled_functions_if_there_are_many():
    """Forget compiled functions within a file, too, before there are more than the kernel allows."""
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_bytes().count(b"\n") > _MOST_MAPPINGS:
        _clear_compiled_functions()


def _clear_compiled_functions():
    jax.clear_caches()
    gc.collect()


@pytest.fixture
def as_users_call_it():
    """Without the checks of annotated types, so that the package's own errors are seen."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


def _path_in(folder: Path, name: str) -> Path:
    """A file of the shared inputs; the test that asks for it is skipped where these are not at hand."""
    if not (folder / name).exists():
        pytest.skip(f"the file {name} is not at hand")
    return folder / name


@pytest.fixture
def real_mesh():
    """The path of a real mesh by name."""
    return functools.partial(_path_in, MESHES)


@pytest.fixture
def case_file():
    """The path of a small input by name."""
    return functools.partial(_path_in, CASES)

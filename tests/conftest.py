"""Settings of all tests: 64-bit mode, and errors instead of implicit promotion of dtypes or ranks.

With LTLJAX_CHECK_SHAPES=1, annotated shapes are checked while the tests run, which takes 50 % longer.
"""

import functools
import gc
import os
import tempfile
from pathlib import Path

from jaxtyping import install_import_hook

# A persistent compilation cache, because compiling takes most of the time of the tests. Programs that call the host are
# not cached, so failures in equinox give NaN instead of calling the host to raise.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(tempfile.gettempdir()) / "ltljax-tests-jax-cache"))
os.environ.setdefault("EQX_ON_ERROR", "nan")

if os.environ.get("LTLJAX_CHECK_SHAPES") == "1":
    # The hook stays in place, since the package imports its modules when they are first used.
    install_import_hook("ltljax", "beartype.beartype")

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
_LONGEST = ("notebooks", "robustness", "process", "fits_find_the_truth", "fit", "taped", "steppers", "distance")


def pytest_collection_modifyitems(items):
    """Sort the files by their duration; the order of tests within a file does not change."""
    rank = {f"test_{name}.py": index for index, name in enumerate(_LONGEST)}
    items.sort(key=lambda item: rank.get(item.path.name, len(rank)))


# Every compiled function maps memory pages. Linux allows 65,530 mappings for a process, beyond which XLA crashes.
_MOST_MAPPINGS = 25_000


@pytest.fixture(autouse=True, scope="module")
def clear_compiled_functions_of_a_file():
    """Clear the compiled functions after each file of tests."""
    yield
    _clear_compiled_functions()


@pytest.fixture(autouse=True)
def clear_compiled_functions_if_there_are_many():
    """Clear the compiled functions within a file before they exceed the limit on mappings."""
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_bytes().count(b"\n") > _MOST_MAPPINGS:
        _clear_compiled_functions()


def _clear_compiled_functions():
    jax.clear_caches()
    gc.collect()


@pytest.fixture
def as_users_call_it():
    """Turn off the checks of annotated types, so that the package raises its own errors."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


def _path_in(folder: Path, name: str) -> Path:
    """The path of a shared input file; the test is skipped if the file does not exist."""
    if not (folder / name).exists():
        pytest.skip(f"the file {name} is not available")
    return folder / name


@pytest.fixture
def real_mesh():
    """A function that returns the path of a real mesh by name."""
    return functools.partial(_path_in, MESHES)


@pytest.fixture
def case_file():
    """A function that returns the path of a small input file by name."""
    return functools.partial(_path_in, CASES)

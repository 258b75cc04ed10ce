"""The arrows between the rooms point one way, and what computes does not load what draws."""

import ast
import inspect
import pickle
import subprocess
import sys
from pathlib import Path

import pytest
import sizes

import ltljax as ltl

PACKAGE = Path(__file__).parents[1] / "ltljax"

# Each room, and the rooms of the package it may import: those before it in the data's way.
ROOMS = [
    "_base",
    "_tables",
    "_mesh",
    "_lifting",
    "_surface",
    "_operators",
    "_equations",
    "_output",
    "_solve",
    "_show",
    "_imaging",
    "_fit",
]
# The public modules. Each lists names of the rooms; nothing but the application imports one.
PUBLIC = ["errors", "imaging", "inverse", "io", "kinetics", "operators", "shapes", "solvers", "vectors"]
# What a room does without, although it comes later.
DOES_WITHOUT = {
    "_tables": {"_base"},
    "_mesh": {"_tables"},
    "_lifting": {"_base", "_mesh"},
    "_output": {"_tables", "_lifting", "_surface", "_operators", "_equations"},
}
MAY_IMPORT = {room: set(ROOMS[:place]) - DOES_WITHOUT.get(room, set()) for place, room in enumerate(ROOMS)}
MAY_IMPORT |= {name: set(ROOMS) for name in PUBLIC}
MAY_IMPORT["app"] = {*ROOMS, *PUBLIC}
# These compute on the host, and do not import JAX themselves. What they import from other rooms may import it.
NO_JAX = [
    "_mesh",
    "_output",
    "_surface/neighbours.py",
    "_surface/creases.py",
    "_surface/report.py",
    "_lifting/support.py",
    "_lifting/charts.py",
    "_lifting/delaunay.py",
    "_surface/conservation.py",
    "_base/progress.py",
]


def files(room):
    folder = PACKAGE / room
    return sorted(folder.rglob("*.py")) if folder.is_dir() else [PACKAGE / f"{room}.py"]


def imported(path):
    """What a file imports: full names, relative ones resolved."""
    parts = ["ltljax", *path.relative_to(PACKAGE).with_suffix("").parts]
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (name.name for name in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = parts[: -node.level] if node.level else []
            module = ".".join([*base, *([node.module] if node.module else [])])
            yield module
            yield from (f"{module}.{name.name}" for name in node.names)


def test_every_file_belongs_to_a_room_of_the_table():
    rooms = {path.relative_to(PACKAGE).parts[0].removesuffix(".py") for path in PACKAGE.rglob("*.py")}
    assert rooms - {"__init__"} == set(MAY_IMPORT)


@pytest.mark.parametrize("room", MAY_IMPORT)
def test_a_room_imports_only_the_rooms_before_it(room):
    for path in files(room):
        for name in imported(path):
            if name.startswith("ltljax."):
                other = name.split(".")[1]
                assert other == room or other in MAY_IMPORT[room], f"{path.name} imports {name}"


@pytest.mark.parametrize("room", NO_JAX)
def test_host_rooms_do_without_jax(room):
    for path in [PACKAGE / room] if room.endswith(".py") else files(room):
        assert not {"jax", "equinox", "diffrax"} & {name.split(".")[0] for name in imported(path)}, path.name


# Functions and files that are longer than a screen, each with its reason.
LONG_FUNCTIONS: dict[str, str] = {}
LONG_FILES = {
    "benchmarks/imaging.py": "one script prints one page, in parts that share its meshes and peers",
}


def test_functions_and_files_are_short():
    for path in sizes.files():
        name = path.relative_to(sizes.ROOT).as_posix()
        assert name in LONG_FILES or len(path.read_text().splitlines()) <= 450, name
        for function, size in sizes.functions(path):
            assert f"{name}: {function}" in LONG_FUNCTIONS or size <= 60, f"{name}: {function}"


def test_the_public_names_are_few_and_listed():
    assert dir(ltl) == sorted(ltl.__all__)
    assert len(ltl.__all__) <= 65
    for name in [*ltl.__all__, *dir(ltl.vectors), *dir(ltl.inverse)]:
        assert not name.startswith("_")
    for name in ltl.__all__:
        assert getattr(ltl, name) is not None


@pytest.mark.parametrize("name", PUBLIC)
def test_a_public_module_shows_its_public_names_only(name):
    module = getattr(ltl, name)
    assert sorted(module.__all__) == dir(module)
    assert all(getattr(module, public) is not None for public in module.__all__)


def test_a_function_and_a_module_never_share_a_name():
    modules = {path.stem for path in PACKAGE.iterdir() if not path.name.startswith("_")}
    assert {name for name in modules if not inspect.ismodule(getattr(ltl, name, ltl))} == set()


def test_names_that_moved_work_and_warn():
    for name in ltl._NEW_HOME:
        with pytest.warns(DeprecationWarning, match=rf"ltljax\.{name} is deprecated.*use ltljax\.\w+\.{name}"):
            assert getattr(ltl, name) is getattr(getattr(ltl, ltl._NEW_HOME[name]), name)


def test_an_unknown_name_raises_the_usual_error():
    with pytest.raises(AttributeError, match="module 'ltljax' has no attribute 'nothing'"):
        ltl.nothing  # noqa: B018  (the access itself raises)


@pytest.mark.parametrize("alias", ["imaging.smoothed", "imaging.denoise_mesh", "kinetics.turk"])
def test_deprecated_functions_can_be_pickled(alias):
    module, name = alias.split(".")
    function = getattr(getattr(ltl, module), name)
    assert pickle.loads(pickle.dumps(function)) is function


def test_importing_the_package_does_not_import_jax():
    code = "import sys, ltljax; print('jax' in sys.modules)"
    completed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert completed.stdout.strip() == "False"


def test_importing_the_library_loads_no_extra():
    code = (
        "import sys, ltljax as ltl; ltl.solve, ltl.plot, ltl.save, ltl.fit, ltl.imaging, ltl.io;"
        "print(*{'pyvista', 'vtkmodules', 'meshio', 'nibabel', 'matplotlib'} & set(sys.modules))"
    )
    completed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert completed.stdout.strip() == ""

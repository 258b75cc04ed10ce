"""The arrows between the rooms point one way, and what computes does not load what draws."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "ltljax"

# Each room, and the rooms of the package it may import.
MAY_IMPORT = {
    "mesh": set(),
    "tables": set(),
    "progress": set(),
    "folder": set(),
    "records": set(),
    "conservation": set(),
    "lifting": {"tables"},
    "construction": {"mesh", "lifting", "tables", "progress"},
    "surface": {"mesh", "lifting", "tables", "progress", "records", "conservation", "construction"},
    "operators": {"surface", "tables"},
    "curvature": {"surface", "construction", "lifting", "operators", "tables"},
    "vectors": {"surface", "lifting", "operators", "curvature", "tables"},
    "elliptic": {"surface", "construction", "lifting", "mesh", "operators", "tables", "progress"},
    "formulas": set(),
    "equations": {"elliptic", "operators", "surface", "tables", "vectors"},
    "solve": {
        "curvature",
        "elliptic",
        "equations",
        "operators",
        "surface",
        "tables",
        "lifting",
        "mesh",
        "progress",
        "vectors",
        "folder",
    },
    "imaging": {
        "curvature",
        "mesh",
        "lifting",
        "tables",
        "surface",
        "operators",
        "vectors",
        "elliptic",
        "equations",
        "solve",
        "progress",
        "output",
    },
    "fit": {"folder", "mesh", "equations", "operators", "surface", "tables", "solve", "progress", "output"},
    "output": {"mesh"},
    "show": {"mesh", "surface", "solve", "tables", "output"},
    "scenario": {
        "curvature",
        "formulas",
        "mesh",
        "lifting",
        "elliptic",
        "equations",
        "operators",
        "surface",
        "solve",
        "output",
    },
    "run": {"folder", "scenario", "mesh", "lifting", "operators", "surface", "solve", "output", "progress"},
    "recover": {"folder", "scenario", "fit", "lifting", "solve", "surface", "output", "progress"},
    "process": {
        "folder",
        "curvature",
        "mesh",
        "lifting",
        "operators",
        "vectors",
        "surface",
        "solve",
        "imaging",
        "output",
        "progress",
    },
    "cli": {"scenario", "process", "run", "recover", "fit", "mesh", "lifting", "solve"},
}
NO_JAX = [
    "mesh",
    "output",
    "construction.py",
    "lifting/support.py",
    "lifting/charts.py",
    "lifting/delaunay.py",
    "conservation.py",
    "progress.py",
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


def test_importing_the_package_loads_no_extra():
    code = "import sys, ltljax; print(*{'pyvista', 'vtkmodules', 'meshio', 'nibabel', 'matplotlib'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""

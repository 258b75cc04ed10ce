"""The notebooks and the script of the README run, and the stored notebooks are small."""

import re
from pathlib import Path

import pytest

nbclient = pytest.importorskip("nbclient")
nbformat = pytest.importorskip("nbformat")

ROOT = Path(__file__).parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
QUICK = ("01_heat_on_a_sphere",)


# The kernel's messaging layer warns while it starts and stops, which is not the notebook's fault.
@pytest.mark.filterwarnings("default")
@pytest.mark.parametrize(
    "path",
    [pytest.param(path, marks=() if path.stem in QUICK else pytest.mark.slow, id=path.stem) for path in NOTEBOOKS],
)
def test_a_notebook_runs_at_small_size(path, monkeypatch):
    monkeypatch.setenv("LTLJAX_NOTEBOOK_LEVEL", "3")
    # The kernel shares the cache of compiled programs with the other tests.
    monkeypatch.setenv("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.1")
    notebook = nbformat.read(path, as_version=4)
    nbclient.NotebookClient(notebook, timeout=900, kernel_name="python3").execute()
    assert any(
        "image/png" in output.get("data", {}) for cell in notebook.cells for output in cell.get("outputs", [])
    ), "a notebook ends in a picture"


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_stored_notebooks_are_smaller_than_300_kb(path):
    assert path.stat().st_size < 300_000, f"store {path.name} with notebooks/store.py"


def test_the_script_of_the_readme_runs(capsys):
    (script,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    exec(script.replace("subdivisions=4", "subdivisions=2"), {})
    assert len(capsys.readouterr().out.splitlines()) == 2

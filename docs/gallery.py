"""Run the scenarios that come with the package, and write their pictures and docs/gallery.md.

python docs/gallery.py [NAME ...]
"""

import argparse
import contextlib
import io
import shlex
import tempfile
import time
from pathlib import Path

from PIL import Image

from ltljax.app import scenario
from ltljax.app.cli import main as ltljax

HERE = Path(__file__).parent
MESHES = HERE.parents[1] / "shared" / "meshes"
# Scenarios without a picture here: heat makes no pattern, and the README shows turing.
NOT_SHOWN = ("heat", "turing")
# Patterns on other surfaces: heading, description, scenario, mesh, and changed values.
SURFACES = {
    "disk": (
        "A labyrinth on a disk", "Nothing flows through the boundary, which the stripes meet at right angles.",
        "fitzhugh-nagumo", "disk", ["diffusivity.u=5e-4", "diffusivity.v=5e-2"],
    ),
    "hand": (
        "Rings on an open hand", "Stripes along the greatest curvature go around fingers. (The scan has a boundary;\n"
        "it is by the Max Planck Society, CC BY 4.0. Its 810 vertices need a coarser pattern.)",
        "rings", "hand_open.obj", ['diffusivity.u="0.516*0.012"', "diffusivity.v=0.012", "time.end=600"],
    ),
    "box": (
        "Spots on a box", "Edges are no obstacle: spots cross them as if the box were unfolded.",
        "schnakenberg", "box", ["mesh.sides=[2.0, 1.0, 1.5]", "kinetics.rate=600"],
    ),
}  # fmt: skip


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help="only these (default: all)")
    names = parser.parse_args().names
    texts = {name: text for name, text in scenario.library().items() if name not in NOT_SHOWN}
    for name in names or [*texts, *SURFACES]:
        start = time.perf_counter()
        picture(name)
        print(f"{name}: {time.perf_counter() - start:.0f} s", flush=True)
    (HERE / "gallery.md").write_text(page(texts), encoding="utf-8")


def command(name):
    """The arguments of `ltljax` that make a picture."""
    if name not in SURFACES:
        return ["run", name]
    _, _, base, mesh, changes = SURFACES[name]
    return ["run", base, "--mesh", mesh, *(part for change in changes for part in ("--set", change))]


def picture(name):
    with tempfile.TemporaryDirectory() as folder:
        arguments = [str(MESHES / part) if part.endswith(".obj") else part for part in command(name)]
        output = io.StringIO()
        with contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
            code = ltljax([*arguments, "--frames", "1", "--out", folder])
        if code:
            raise SystemExit(f"{name} ended with {code}: {output.getvalue().splitlines()[-1]}")
        image = Image.open(Path(folder) / f"{command(name)[1]}.png").resize((720, 360), Image.Resampling.LANCZOS)
        (HERE / "gallery").mkdir(exist_ok=True)
        image.convert("P", palette=Image.Palette.ADAPTIVE, colors=128).save(
            HERE / "gallery" / f"{name}.png", optimize=True
        )


def page(texts):
    lines = [
        "# Patterns", "",
        "Each pattern is a scenario that comes with the package. `ltljax run NAME` runs it and writes a picture, a",
        "viewer, data and an animation. `ltljax new NAME > my.toml` copies it to a file that you can change and run.",
        "`--mesh my.obj` uses another surface, as in this picture of zebra, spirals (with diffusivity.u=0.01),",
        "barrio-spots and gray-scott. `--set KEY=VALUE` changes a value: `--set output.displacement=0.05` also writes",
        "a surface with the pattern as a relief. `python docs/gallery.py` makes the pictures below.", "",
        "![Four patterns on a cow, a torus and a rabbit](patterns.png)",
    ]  # fmt: skip
    for name, text in texts.items():
        about = text.splitlines()[0].removeprefix("# ")
        lines += ["", f"## {scenario.title(text)}", "", about, "", f"    ltljax run {name}", ""]
        lines += [f"![{scenario.title(text)}](gallery/{name}.png)"]
    for name, (heading, about, *_) in SURFACES.items():
        lines += ["", f"## {heading}", "", about, "", f"    ltljax {shlex.join(command(name))}", ""]
        lines += [f"![{heading}](gallery/{name}.png)"]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()

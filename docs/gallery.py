"""Runs the scenarios that come with the package and writes their pictures and docs/gallery.md.

python docs/gallery.py [NAME ...]
"""

import argparse
import contextlib
import io
import tempfile
import time
from pathlib import Path

from PIL import Image

from ltljax import scenario
from ltljax.cli import main as ltljax

HERE = Path(__file__).parent


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help="only these (default: all)")
    names = parser.parse_args().names
    texts = scenario.library()
    for name in names or texts:
        start = time.perf_counter()
        picture(name)
        print(f"{name}: {time.perf_counter() - start:.0f} s", flush=True)
    (HERE / "gallery.md").write_text(page(texts), encoding="utf-8")


def picture(name):
    with tempfile.TemporaryDirectory() as folder:
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            code = ltljax(["run", name, "--out", folder])
        if code:
            raise SystemExit(f"{name} ended with {code}")
        image = Image.open(Path(folder) / f"{name}.png").resize((720, 360), Image.Resampling.LANCZOS)
        (HERE / "gallery").mkdir(exist_ok=True)
        image.convert("P", palette=Image.Palette.ADAPTIVE, colors=128).save(
            HERE / "gallery" / f"{name}.png", optimize=True
        )


def page(texts):
    lines = [
        "# Patterns", "",
        "Each is a file that comes with the package: `ltljax run NAME` makes the picture, with a viewer, data and an",
        "animation; `ltljax new NAME > my.toml` writes the file down, to be changed and run. Add `--mesh my.obj` for",
        "a surface of your own, as in this picture of zebra, spirals, barrio-spots and gray-scott, and",
        "`--set KEY=VALUE` for other values. The pictures below are made by `python docs/gallery.py`.", "",
        "![Four patterns on a cow, a torus and a rabbit](patterns.png)",
    ]  # fmt: skip
    for name, text in texts.items():
        about = text.splitlines()[0].removeprefix("# ")
        lines += ["", f"## {scenario.title(text)}", "", about, "", f"    ltljax run {name}", ""]
        lines += [f"![{scenario.title(text)}](gallery/{name}.png)"]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()

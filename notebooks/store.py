"""Execute notebooks and store them with small outputs.

python notebooks/store.py [--as-they-are] NAME.ipynb ...

Viewers and log messages are removed from the stored outputs, and large pictures become JPEGs.
"""

import argparse
import base64
import io
from pathlib import Path

import nbclient
import nbformat
from PIL import Image

LARGEST_PNG = 40_000  # bytes
WIDEST = 1000  # pixels
QUALITY = 75


def main():
    """Parse the arguments, and store each notebook."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("paths", nargs="+", type=Path, metavar="NAME.ipynb")
    parser.add_argument("--as-they-are", action="store_true", help="keep the stored outputs, do not execute")
    arguments = parser.parse_args()
    for path in arguments.paths:
        notebook = nbformat.read(path, as_version=4)
        if not arguments.as_they_are:
            nbclient.NotebookClient(notebook, timeout=3600, kernel_name="python3").execute()
        for cell in notebook.cells:
            cell.metadata.pop("execution", None)
            if "outputs" in cell:
                cell.outputs = [output for output in map(small, cell.outputs) if output is not None]
        nbformat.write(notebook, path)
        print(f"{path.name}: {path.stat().st_size / 1000:.0f} kB")


def small(output):
    """The output with a small picture; None for a viewer or a log message."""
    data = output.get("data", {})
    if output.get("name") == "stderr" or ("text/html" in data and "image/png" not in data):
        return None
    if len(data.get("image/png", "")) > LARGEST_PNG or "image/jpeg" in data:
        encoded = data.pop("image/png", None) or data["image/jpeg"]
        data["image/jpeg"] = as_jpeg(base64.b64decode(encoded))
    return output


def as_jpeg(image_bytes):
    """The image on a white background, at most `WIDEST` pixels wide, as base64."""
    picture = Image.open(io.BytesIO(image_bytes)).convert("RGBA")
    image = Image.new("RGB", picture.size, "white")
    image.paste(picture, mask=picture.getchannel("A"))
    image.thumbnail((WIDEST, 4 * WIDEST), Image.Resampling.LANCZOS)
    buffer = io.BytesIO()
    image.save(buffer, "JPEG", quality=QUALITY, optimize=True)
    return base64.b64encode(buffer.getvalue()).decode() + "\n"


if __name__ == "__main__":
    main()

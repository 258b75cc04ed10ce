"""The commands on a mesh: ``denoise``, ``smooth``, ``lic``, ``curvature`` and ``distance``."""

import argparse
import sys
from pathlib import Path
from typing import Any

from .arguments import OUT, add_repair, count, natural, positive
from .choices import DENOISING_METHODS, LINE_FIELDS, MESHES, RENAMED_SMOOTHING_METHODS, SMOOTHING_METHODS


def add_mesh_commands(commands: Any) -> None:
    """Add the parsers of all commands on a mesh."""
    _add_denoise(commands)
    _add_smooth(commands)
    _add_lic(commands)
    _add(commands, "curvature", "draw the mean and Gauss curvature, ridges and valleys of a mesh")
    distance = _add(commands, "distance", "draw the distance along a mesh from some of its vertices, in bands")
    distance.add_argument(
        "--from", type=natural, nargs="+", required=True, metavar="V", dest="sources",
        help="vertices, counted from 0 in the order of the mesh file",
    )  # fmt: skip


def _add(commands: Any, name: str, summary: str) -> argparse.ArgumentParser:
    """Add a command whose options have the names of the arguments of its function in `process`."""
    parser = commands.add_parser(name, help=summary, description=f"{summary[0].upper()}{summary[1:]}.")
    parser.set_defaults(command=_run_on_mesh, function=name)
    parser.add_argument("mesh", help=f"{', '.join(MESHES)}, or a mesh file, whose length scale is kept")
    parser.add_argument(
        "--out", type=Path, default=OUT / name, metavar="DIR", help=f"folder for the results (default: {OUT / name})"
    )
    add_repair(parser)
    return parser


def _run_on_mesh(options: argparse.Namespace) -> int:
    import jax

    from . import process

    jax.config.update("jax_enable_x64", True)
    arguments = {key: value for key, value in vars(options).items() if key not in ("command", "function")}
    getattr(process, options.function)(arguments.pop("mesh"), arguments.pop("out"), **arguments)
    return 0


def _add_denoise(commands: Any) -> None:
    parser = _add(commands, "denoise", "denoise an image, numbers or colours on a mesh")
    values = parser.add_mutually_exclusive_group()
    values.add_argument(
        "--image", type=Path, help="denoise an image on the UV map of the mesh (default: the colours of the mesh file)"
    )
    values.add_argument(
        "--data", type=Path, metavar="FILE", help="denoise numbers at the vertices: a CSV, NPZ, PLY or VTP file"
    )
    parser.add_argument(
        "--name", metavar="COLUMN", help="column of the data (default: the only one, or red, green and blue)"
    )
    amount = parser.add_mutually_exclusive_group()
    amount.add_argument("--noise", type=positive, help="standard deviation of the noise (default: estimated)")
    amount.add_argument(
        "--strength", type=positive,
        help="in place of --noise: the weight of the total variation, in units of the values times length (tv), or "
        "the time of diffusion (heat, perona-malik)",
    )  # fmt: skip
    parser.add_argument(
        "--method", choices=DENOISING_METHODS, default="tv",
        help="total variation or Perona-Malik diffusion, which keep edges, or the heat equation, which blurs them "
        "(default: tv)",
    )  # fmt: skip


def _add_smooth(commands: Any) -> None:
    parser = _add(commands, "smooth", "smooth a mesh")
    parser.add_argument(
        "--method", type=_smoothing_method, choices=SMOOTHING_METHODS, default="mean-curvature-flow",
        help="mean curvature flow; fairing, which is one implicit step of it; or a filter of the normals, which keeps "
        "edges (default: mean-curvature-flow)",
    )  # fmt: skip
    parser.add_argument(
        "--time",
        type=positive,
        help="duration of the flow, in units of a length squared (default: a quarter of the squared mean edge length)",
    )
    parser.add_argument(
        "--strength", type=positive,
        help="fair: a length squared (default: half the squared mean edge length); filter-normals: the difference "
        "between unit normals below which they are averaged (default: 0.35)",
    )  # fmt: skip
    parser.add_argument(
        "--steps", type=count, help="steps of the flow (default: 10), or iterations of filter-normals (default: 5)"
    )
    parser.add_argument(
        "--keep-volume", action="store_true", help="mean-curvature-flow and fair: keep the volume of every component"
    )


def _smoothing_method(text: str) -> str:
    """The name of a method, also with underscores, as in Python, or as it was in version 0.1."""
    if text in RENAMED_SMOOTHING_METHODS:
        new_name = RENAMED_SMOOTHING_METHODS[text]
        print(f"warning: the method {text} is now called {new_name}; the old name goes in version 0.3", file=sys.stderr)
        return new_name
    return text.replace("_", "-")


def _add_lic(commands: Any) -> None:
    parser = _add(commands, "lic", "draw the lines of a field on a mesh by line integral convolution")
    parser.add_argument(
        "--field", choices=LINE_FIELDS, default="smallest",
        help="the directions of smallest or largest curvature, a smooth field of crosses, or a rotation about the "
        "vertical (default: smallest)",
    )  # fmt: skip
    parser.add_argument("--resolution", type=count, default=600, help="height of the picture in pixels (default: 600)")

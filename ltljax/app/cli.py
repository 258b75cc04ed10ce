"""The command line: ``ltljax run``, ``fit``, ``new``, ``list``, ``info``, and commands on a mesh: ``denoise``,
``smooth``, ``lic``, ``curvature``, ``distance``.
"""

import argparse
import dataclasses
import difflib
import io
import sys
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any, NoReturn

import jax

from .._fit import FitError
from .._lifting.schemes import Monotone, Paper, Polynomial, Scheme
from .._mesh import MeshError, load_mesh
from .._mesh.errors import in_one_line
from .._solve import SolveError
from . import process, scenario
from .fit_scenario import recover
from .process.fields import FIELDS
from .process.images import METHODS
from .process.shapes import SMOOTHINGS
from .run import run

_OUT = Path("out")


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        self.exit(2, f"ltljax: {message} (see: {self.prog} --help)\n")


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code: 0, 1 for a run that failed, 2 for a wrong argument."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # what a terminal cannot show it shows by number
            stream.reconfigure(errors="backslashreplace")
    options = _parser().parse_args(arguments)
    try:
        return options.command(options)
    except (ValueError, OSError) as error:  # a mesh that is not acceptable is a ValueError too
        return _fail(error, 2)
    except MemoryError as error:
        said = f" ({error})" if str(error) else ""
        return _fail(MemoryError(f"The memory does not suffice{said}. Take fewer frames, or a coarser mesh."), 2)
    except (SolveError, FitError) as error:
        return _fail(error, 1)
    except KeyboardInterrupt:
        said = "interrupted"
        if options.command in (_run, _fit):
            said += "; what was written so far is kept. Go on with the same command and --resume, or start over with "
            said += "--overwrite"
        print(f"ltljax: {said}.", file=sys.stderr)
        return 130


def _fail(error: Exception, code: int) -> int:
    print(f"ltljax: {in_one_line(str(error))}", file=sys.stderr)
    return code


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="ltljax", description="Differential equations on triangle meshes.")
    parser.add_argument("--version", action="version", version=f"ltljax {version('ltljax')}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND", parser_class=_Parser)

    run_ = commands.add_parser("run", help="solve a scenario and write pictures and data")
    run_.set_defaults(command=_run)
    run_.add_argument("scenario", help="what to solve: a name (see: ltljax list) or a scenario file (see: ltljax new)")
    run_.add_argument(
        "--mesh", help="sphere, torus, disk, box, or a mesh file (default: the scenario's own, or sphere)"
    )
    run_.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", dest="changes",
        help="a value of a scenario file, such as kinetics.feed=0.05; may be given several times",
    )  # fmt: skip
    run_.add_argument("--out", type=Path, metavar="DIR", help="where to write (default: out/ and the scenario's name)")
    run_.add_argument(
        "--source", choices=scenario.SOURCES, help="heat on the torus: the source (default: angle-zero-mean)"
    )
    run_.add_argument("--as-published", action="store_true", help="turing: the paper's parameters, which stay uniform")
    run_.add_argument("--scheme", choices=scenario.SCHEMES, help="default: the scenario's own, or monotone")
    run_.add_argument("--degree", type=int, choices=(3, 4), help="of the scheme polynomial (default: 4)")
    run_.add_argument(
        "--boundary",
        action="append",
        default=[],
        metavar="CONDITION",
        help="heat on an open mesh: neumann=FLUX, dirichlet=VALUE or robin=A,B,G (a u + b du/dnu = g), and @LOOP for "
        "one boundary loop; may be given several times (default: neumann=0)",
    )
    run_.add_argument("--t1", type=_positive, help="end of the run (default: the scenario's)")
    run_.add_argument("--frames", type=_count, help="states kept, evenly spaced in time (default: mostly 60)")
    run_.add_argument("--seed", type=_seed, help="of the random numbers (default: 0)")
    run_.add_argument(
        "--scale", type=_positive, help="factor by which patterns grow; 2 multiplies each diffusivity by four"
    )
    run_.add_argument("--view", choices=scenario.VIEWS, help="from where pictures look (default: aslant)")
    run_.add_argument(
        "--texture", type=_count, metavar="PIXELS", help="an edge of the image on a mesh's UV map (default: 1024)"
    )
    run_.add_argument("--dtype", choices=("float32", "float64"), help="default: mostly float64")
    run_.add_argument(
        "--keep-scale", action="store_true", help="mesh files: do not scale the area to the unit sphere's"
    )
    run_.add_argument("--repair", action="store_true", help="mesh files: mend what can be mended")
    run_.add_argument(
        "--resume", action="store_true", help="go on with a run that was interrupted: the same command, the same --out"
    )
    run_.add_argument("--overwrite", action="store_true", help="start over, although an earlier run was interrupted")

    fit = commands.add_parser("fit", help="find numbers of a scenario file from what was seen")
    fit.set_defaults(command=_fit)
    fit.add_argument("scenario", help="a scenario file with a table [fit]; its numbers are the first guess")
    fit.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", dest="changes",
        help="a value of the file, such as kinetics.feed=0.05; may be given several times",
    )  # fmt: skip
    fit.add_argument("--mesh", help="a mesh file, in place of the file's own mesh")
    fit.add_argument(
        "--out", type=Path, metavar="DIR", help="where to write (default: out/ and the scenario's name, and -fit)"
    )
    fit.add_argument("--resume", action="store_true", help="go on with a fit that was interrupted: the same --out")
    fit.add_argument("--overwrite", action="store_true", help="start over, although an earlier fit was interrupted")

    new = commands.add_parser("new", help="print a scenario file to start from: ltljax new gray-scott > my.toml")
    new.set_defaults(command=_new)
    new.add_argument(
        "scenario", choices=scenario.templates(), metavar="NAME",
        help="one of those of: ltljax list; or fit, which finds rates from measurements",
    )  # fmt: skip

    listing = commands.add_parser("list", help="the scenarios and built-in meshes")
    listing.set_defaults(command=_list)

    info = commands.add_parser("info", help="what a mesh file holds, and whether it is acceptable")
    info.set_defaults(command=_info)
    info.add_argument("mesh", help="a mesh file")
    info.add_argument("--repair", action="store_true", help="mend what can be mended")
    _add_commands_on_meshes(commands)
    return parser


def _add_commands_on_meshes(commands: Any) -> None:
    def command(name: str, on_mesh: Callable[[argparse.Namespace], None], says: str) -> argparse.ArgumentParser:
        parser = commands.add_parser(name, help=says, description=says)
        parser.set_defaults(command=_on_mesh, on_mesh=on_mesh)
        parser.add_argument("mesh", help="sphere, torus, disk, box, or a mesh file, which keeps its scale")
        parser.add_argument(
            "--out", type=Path, default=_OUT / name, metavar="DIR", help=f"where to write (default: {_OUT / name})"
        )
        parser.add_argument("--repair", action="store_true", help="mend what can be mended")
        return parser

    denoise = command("denoise", _denoise, "take noise off an image, numbers or colours on a mesh; edges stay")
    what = denoise.add_mutually_exclusive_group()
    what.add_argument("--image", type=Path, help="on the mesh's UV map (default: the colours of the mesh file)")
    what.add_argument("--data", type=Path, metavar="FILE", help="numbers for every vertex: a CSV, NPZ, PLY or VTP file")
    denoise.add_argument("--name", metavar="COLUMN", help="of the data (default: the only one, or red, green and blue)")
    much = denoise.add_mutually_exclusive_group()
    much.add_argument("--noise", type=_positive, help="its standard deviation in each value (default: estimated)")
    much.add_argument(
        "--strength", type=_positive, help="instead: of tv in values times length, of the others the time of diffusion"
    )
    denoise.add_argument("--method", choices=METHODS, default="tv", help="default: tv, the least total variation")

    smooth = command("smooth", _smooth, "smooth a mesh")
    smooth.add_argument(
        "--method", choices=SMOOTHINGS, default="flow",
        help="mean curvature flow, one implicit step of it, or a filter of normals that keeps edges (default: flow)",
    )  # fmt: skip
    smooth.add_argument("--time", type=_positive, help="of the flow, a length squared (default: of half a mean edge)")
    smooth.add_argument(
        "--strength", type=_positive,
        help="of fair, a length squared (default: half of that of a mean edge); of features, how far unit normals "
        "differ that count as the same (default: 0.35)",
    )  # fmt: skip
    smooth.add_argument("--steps", type=_count, help="of the flow (default: 10), or rounds of features (default: 5)")
    smooth.add_argument("--keep-volume", action="store_true", help="flow and fair: give back what is lost")

    lic = command("lic", _lic, "draw lines on a mesh by line integral convolution")
    lic.add_argument(
        "--field", choices=FIELDS, default="smallest",
        help="along the smallest or largest curvature, smooth crosses, or around the vertical (default: smallest)",
    )  # fmt: skip
    lic.add_argument("--resolution", type=_count, default=600, help="pixels of the picture's height (default: 600)")

    command("curvature", _curvature, "draw how a mesh bends: mean and Gauss curvature, ridges and valleys")

    distance = command("distance", _distance, "draw the distance along a mesh from vertices, in bands")
    distance.add_argument(
        "--from", type=_seed, nargs="+", required=True, metavar="V", dest="sources",
        help="vertices, counted from 0 in the order of the file",
    )  # fmt: skip


def _positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"expected a positive number, found {text!r}")
    return value


def _count(text: str) -> int:
    if not text.isdecimal() or not 1 <= int(text) <= 10_000:
        raise argparse.ArgumentTypeError(f"expected a whole number from 1 to 10000, found {text!r}")
    return int(text)


def _seed(text: str) -> int:
    if not text.isdecimal() or int(text) >= 2**64:
        raise argparse.ArgumentTypeError(f"expected a whole number from 0, found {text!r}")
    return int(text)


def _list(options: argparse.Namespace) -> int:
    del options
    rows = {name: (make.__doc__ or "").splitlines()[0] for name, make in scenario.SCENARIOS.items()}
    rows |= {name: scenario.title(text) for name, text in scenario.library().items()}
    for name, says in rows.items():
        print(f"{name:20} {says}")
    print(
        f"\nmeshes: {', '.join(scenario.BUILT_IN)}, or any mesh file. Start one with: ltljax run turing --mesh sphere"
    )
    print("All but heat and turing are files: ltljax new gray-scott > my.toml, change it, ltljax run my.toml")
    return 0


def _new(options: argparse.Namespace) -> int:
    print(scenario.templates()[options.scenario], end="")
    return 0


def _info(options: argparse.Namespace) -> int:
    try:
        print(load_mesh(options.mesh, repair=options.repair).report)
    except MeshError as error:
        if options.repair or not Path(options.mesh).is_file():
            raise
        report = load_mesh(options.mesh, repair=True).report  # which raises where nothing can be made of it
        print(f"not acceptable as it is: {in_one_line(str(error))}\n\nwith --repair:\n{report}")
    return 0


def _on_mesh(options: argparse.Namespace) -> int:
    jax.config.update("jax_enable_x64", True)
    options.on_mesh(options)
    return 0


def _denoise(options: argparse.Namespace) -> None:
    process.denoise(
        options.mesh, options.out, image=options.image, data=options.data, name=options.name, noise=options.noise,
        strength=options.strength, method=options.method, repair=options.repair,
    )  # fmt: skip


def _smooth(options: argparse.Namespace) -> None:
    process.smooth(
        options.mesh, options.out, method=options.method, time=options.time, strength=options.strength,
        steps=options.steps, keep_volume=options.keep_volume, repair=options.repair,
    )  # fmt: skip


def _lic(options: argparse.Namespace) -> None:
    process.lic(options.mesh, options.out, field=options.field, resolution=options.resolution, repair=options.repair)


def _curvature(options: argparse.Namespace) -> None:
    process.curvature(options.mesh, options.out, repair=options.repair)


def _distance(options: argparse.Namespace) -> None:
    process.distance(options.mesh, options.out, sources=options.sources, repair=options.repair)


def _scheme(name: str, degree: int | None) -> Scheme:
    if name != "polynomial" and degree is not None:
        raise ValueError(f"--degree {degree} needs --scheme polynomial.")
    if name == "polynomial":
        return Polynomial(degree or 4)
    return Paper() if name == "paper" else Monotone()


def _run(options: argparse.Namespace) -> int:
    # Scenario files are read in full precision, whatever the run's is.
    jax.config.update("jax_enable_x64", True)
    if options.scenario in scenario.SCENARIOS:
        if options.changes:
            raise ValueError(f"--set is for scenario files; {options.scenario} is none (see: ltljax list).")
        chosen = scenario.Options(
            mesh=options.mesh or "sphere",
            source=options.source,
            boundary=tuple(options.boundary),
            as_published=options.as_published,
            keep_scale=options.keep_scale,
            repair=options.repair,
            seed=options.seed or 0,
            t1=options.t1,
            scale=options.scale or 1.0,
        )
        example, record = scenario.SCENARIOS[options.scenario](chosen), dataclasses.asdict(chosen)
        shown = {"view": options.view, "texture": options.texture}
        settings = dataclasses.replace(example.settings, **{key: value for key, value in shown.items() if value})
        example = dataclasses.replace(example, settings=settings)
    else:
        example, mesh = _from_file(options)
        record = dict(scenario=options.scenario, mesh=mesh, changes=options.changes)
    inputs = [Path(name) for name in (options.scenario, options.mesh) if name is not None and Path(name).is_file()]
    degree = options.degree or example.settings.degree
    dtype = options.dtype or example.settings.dtype
    jax.config.update("jax_enable_x64", dtype == "float64")
    run(
        example, record, scheme=_scheme(options.scheme or example.settings.scheme, degree), dtype=dtype,
        frames=options.frames or example.frames, out=options.out or _OUT / example.name, inputs=inputs,
        resume=options.resume, overwrite=options.overwrite,
    )  # fmt: skip
    return 0


def _fit(options: argparse.Namespace) -> int:
    jax.config.update("jax_enable_x64", True)
    path = Path(options.scenario)
    if path.suffix != ".toml":
        raise ValueError(f"Expected a scenario file that ends in .toml, found {options.scenario!r}.")
    changes = dict(scenario.parse_change(change) for change in options.changes)
    mesh_file = None if options.mesh is None else Path(options.mesh)
    example = scenario.read(scenario.read_text(path), options.scenario, path.parent, changes, mesh_file)
    jax.config.update("jax_enable_x64", example.settings.dtype == "float64")
    recover(
        example,
        scheme=_scheme(example.settings.scheme, example.settings.degree),
        out=options.out or _OUT / f"{example.name}-fit",
        inputs=(path, *([mesh_file] if mesh_file else [])),
        resume=options.resume,
        overwrite=options.overwrite,
    )
    return 0


def _from_file(options: argparse.Namespace) -> tuple[scenario.Scenario, str]:
    """The scenario of a file or of the library, with what the command line changes; and its mesh in words."""
    for flag in ("source", "boundary", "as_published"):
        if getattr(options, flag):
            raise ValueError(f"--{flag.replace('_', '-')} is for heat and turing; in a scenario file write it down.")
    texts, path = scenario.library(), Path(options.scenario)
    if options.scenario in texts:
        text, folder = texts[options.scenario], Path()
    elif path.suffix == ".toml":
        text, folder = scenario.read_text(path), path.parent
    else:
        names = (*scenario.SCENARIOS, *texts)
        near = difflib.get_close_matches(options.scenario, names, n=1)
        raise ValueError(
            f"Expected the name of a scenario or a file that ends in .toml, found {options.scenario!r}"
            f"{f' (did you mean {near[0]}?)' if near else ''}. Names: {', '.join(names)}."
        )
    given = {"time.end": options.t1, "time.frames": options.frames, "seed": options.seed}
    given |= {"solver.dtype": options.dtype, "solver.scheme": options.scheme, "solver.degree": options.degree}
    given |= {"scale": options.scale, "output.view": options.view, "output.texture": options.texture}
    given |= {"mesh.repair": options.repair or None, "mesh.scale": "keep" if options.keep_scale else None}
    # The mesh first, so that what else is said of it still holds.
    changes: dict[str, Any] = {"mesh": {"shape": options.mesh}} if options.mesh in scenario.BUILT_IN else {}
    changes |= {key: value for key, value in given.items() if value is not None}
    changes |= dict(scenario.parse_change(change) for change in options.changes)
    mesh_file = None if options.mesh is None or options.mesh in scenario.BUILT_IN else Path(options.mesh)
    # The person at the command line may name any file; a scenario file may name only files beside it.
    if isinstance(named := changes.get("mesh.file"), str) and Path(named).is_absolute():
        mesh_file = Path(changes.pop("mesh.file"))
    return scenario.read(text, options.scenario, folder, changes, mesh_file), options.mesh or "its own mesh"

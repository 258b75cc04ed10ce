"""The command line: ``ltljax run``, ``ltljax list``, ``ltljax info``."""

import argparse
import sys
from importlib.metadata import version
from pathlib import Path
from typing import NoReturn

import jax

from . import scenario
from .lifting.schemes import Monotone, Paper, Polynomial, Scheme
from .mesh import load_mesh
from .run import run
from .solve import SolveError


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        self.exit(2, f"ltljax: {message} (see: {self.prog} --help)\n")


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code: 0, 1 for a run that failed, 2 for a wrong argument."""
    options = _parser().parse_args(arguments)
    try:
        return options.command(options)
    except (ValueError, OSError) as error:  # a mesh that is not acceptable is a ValueError too
        return _fail(error, 2)
    except SolveError as error:
        return _fail(error, 1)
    except KeyboardInterrupt:
        print("ltljax: interrupted; what was written so far is kept.", file=sys.stderr)
        return 130


def _fail(error: Exception, code: int) -> int:
    print(f"ltljax: {' '.join(str(error).split())}", file=sys.stderr)
    return code


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="ltljax", description="Differential equations on triangle meshes.")
    parser.add_argument("--version", action="version", version=f"ltljax {version('ltljax')}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND", parser_class=_Parser)

    run_ = commands.add_parser("run", help="solve a scenario and write pictures and data")
    run_.set_defaults(command=_run)
    run_.add_argument("scenario", choices=scenario.SCENARIOS, help="what to solve (see: ltljax list)")
    run_.add_argument("--mesh", default="sphere", help="sphere, torus, disk, or a mesh file (default: sphere)")
    run_.add_argument("--out", type=Path, default=Path("out"), metavar="DIR", help="where to write (default: out)")
    run_.add_argument(
        "--source", choices=scenario.SOURCES, help="heat on the torus: the source (default: angle-zero-mean)"
    )
    run_.add_argument("--as-published", action="store_true", help="turing: the paper's parameters, which stay uniform")
    run_.add_argument(
        "--scheme", choices=("monotone", "polynomial", "paper"), default="monotone", help="default: monotone"
    )
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
    run_.add_argument("--frames", type=_count, default=60, help="states kept, evenly spaced in time (default: 60)")
    run_.add_argument("--seed", type=_seed, default=0, help="of the random numbers (default: 0)")
    run_.add_argument("--dtype", choices=("float32", "float64"), default="float64", help="default: float64")
    run_.add_argument(
        "--keep-scale", action="store_true", help="mesh files: do not scale the area to the unit sphere's"
    )
    run_.add_argument("--repair", action="store_true", help="mesh files: mend what can be mended")
    run_.add_argument(
        "--resume", action="store_true", help="go on with a run that was interrupted: the same command, the same --out"
    )

    listing = commands.add_parser("list", help="the scenarios and built-in meshes")
    listing.set_defaults(command=_list)

    info = commands.add_parser("info", help="what a mesh file holds, and whether it is acceptable")
    info.set_defaults(command=_info)
    info.add_argument("mesh", help="a mesh file")
    info.add_argument("--repair", action="store_true", help="mend what can be mended")
    return parser


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
    for name, make in scenario.SCENARIOS.items():
        print(f"{name:8} {(make.__doc__ or '').splitlines()[0]}")
    print(
        f"\nmeshes: {', '.join(scenario.BUILT_IN)}, or any mesh file. Start one with: ltljax run turing --mesh sphere"
    )
    return 0


def _info(options: argparse.Namespace) -> int:
    print(load_mesh(options.mesh, repair=options.repair).report)
    return 0


def _scheme(options: argparse.Namespace) -> Scheme:
    if options.scheme != "polynomial" and options.degree is not None:
        raise ValueError(f"--degree {options.degree} needs --scheme polynomial.")
    if options.scheme == "polynomial":
        return Polynomial(options.degree or 4)
    return Paper() if options.scheme == "paper" else Monotone()


def _run(options: argparse.Namespace) -> int:
    jax.config.update("jax_enable_x64", options.dtype == "float64")
    chosen = scenario.Options(
        mesh=options.mesh,
        source=options.source,
        boundary=tuple(options.boundary),
        as_published=options.as_published,
        keep_scale=options.keep_scale,
        repair=options.repair,
        seed=options.seed,
        t1=options.t1,
    )
    example = scenario.SCENARIOS[options.scenario](chosen)
    run(
        example, chosen, scheme=_scheme(options), dtype=options.dtype, frames=options.frames, out=options.out,
        resume=options.resume,
    )  # fmt: skip
    return 0

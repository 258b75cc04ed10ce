"""The command line: ``ltljax run``, ``fit``, ``new``, ``list``, ``info``, and the commands on a mesh: ``denoise``,
``smooth``, ``lic``, ``curvature``, ``distance``.

JAX is imported by the commands that compute, so that the others answer at once.
"""

import argparse
import difflib
import io
import sys
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from .arguments import OUT, add_changes, add_out, add_repair, add_restart, count, natural, positive
from .choices import DTYPES, MESHES, SCHEMES, VIEWS
from .mesh_commands import add_mesh_commands
from .scenario import catalogue

if TYPE_CHECKING:
    from .scenario import Scenario


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        self.exit(2, f"ltljax: {message} (see: {self.prog} --help)\n")


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code: 0, 1 for a run that failed, 2 for a wrong argument."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            # Characters that the terminal cannot encode are printed as escapes.
            stream.reconfigure(errors="backslashreplace")
    options = _parser().parse_args(arguments)
    try:
        return options.command(options)
    except (ValueError, OSError) as error:
        return _fail(str(error), 2)
    except MemoryError as error:
        reason = f" ({error})" if str(error) else ""
        return _fail(f"Out of memory{reason}. Use fewer frames, or a coarser mesh.", 2)
    except RuntimeError as error:
        from ..errors import FitError, SolveError

        if not isinstance(error, FitError | SolveError):
            raise
        return _fail(str(error), 1)
    except KeyboardInterrupt:
        advice = ""
        if options.command in (_run, _fit):
            advice = (
                "; what was computed so far is on disk. Continue with the same command and --resume, or start over "
            )
            advice += "with --overwrite"
        print(f"ltljax: interrupted{advice}.", file=sys.stderr)
        return 130


def _fail(message: str, code: int) -> int:
    from .._mesh.errors import in_one_line

    print(f"ltljax: {in_one_line(message)}", file=sys.stderr)
    return code


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="ltljax", description="Solve partial differential equations on triangle meshes.")
    parser.add_argument("-V", "--version", action="version", version=f"ltljax {version('ltljax')}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND", parser_class=_Parser)
    _add_run(commands)
    _add_fit(commands)
    _add_new(commands)
    listing = commands.add_parser("list", help="list the scenarios and the built-in meshes")
    listing.set_defaults(command=_list)
    info = commands.add_parser("info", help="describe a mesh file and its defects")
    info.set_defaults(command=_info)
    info.add_argument("mesh", help="a mesh file")
    add_repair(info)
    add_mesh_commands(commands)
    return parser


def _add_run(commands: Any) -> None:
    parser = commands.add_parser("run", help="solve a scenario and write pictures and data")
    parser.set_defaults(command=_run)
    parser.add_argument(
        "scenario", help="the name of a scenario (see: ltljax list) or a scenario file (see: ltljax new)"
    )
    problem = parser.add_argument_group("problem")
    problem.add_argument("--mesh", help=f"{', '.join(MESHES)}, or a mesh file (default: the scenario's own mesh)")
    add_changes(problem)
    problem.add_argument(
        "--variant", "--source", metavar="NAME",
        help="a variant that the scenario describes, such as sine, angle or angle-zero-mean for heat on the torus",
    )  # fmt: skip
    problem.add_argument(
        "--as-published", action="store_const", const="as-published", dest="variant",
        help="turing: the published parameters, with which the state stays uniform (--variant as-published)",
    )  # fmt: skip
    problem.add_argument(
        "--boundary", action="append", metavar="CONDITION",
        help="a boundary condition on an open mesh: neumann=FLUX, dirichlet=VALUE or robin=A,B,G "
        "(a u + b du/dnu = g), with @LOOP for one boundary loop; can be repeated (default: no flux)",
    )  # fmt: skip
    problem.add_argument("--t1", type=positive, help="end time of the run (default: the scenario's)")
    problem.add_argument("--seed", type=natural, help="seed of the random numbers (default: the scenario's, mostly 0)")
    problem.add_argument(
        "--scale", type=positive,
        help="factor by which patterns become larger; 2 multiplies all diffusivities by 4 (default: 1)",
    )  # fmt: skip
    problem.add_argument("--keep-scale", action="store_true", help="keep the length scale of a mesh file, which is "
                         "otherwise scaled to the area of the unit sphere")  # fmt: skip
    add_repair(problem)
    method = parser.add_argument_group("method")
    method.add_argument(
        "--scheme", choices=SCHEMES, help="scheme of the operators (default: the scenario's, mostly monotone)"
    )
    method.add_argument("--degree", type=int, choices=(3, 4), help="degree of the scheme polynomial (default: 4)")
    method.add_argument("--dtype", choices=DTYPES, help="precision (default: the scenario's, mostly float64)")
    results = parser.add_argument_group("results")
    add_out(results, "out/ and the name of the scenario")
    results.add_argument(
        "--frames",
        type=count,
        help="number of states to record, evenly spaced in time (default: the scenario's, mostly 60)",
    )
    results.add_argument("--view", choices=VIEWS, help="side from which pictures are taken (default: aslant)")
    results.add_argument(
        "--texture", type=count, metavar="PIXELS", help="size of the texture, if the mesh has a UV map (default: 1024)"
    )
    add_restart(results, "run")


def _add_fit(commands: Any) -> None:
    parser = commands.add_parser("fit", help="fit numbers of a scenario file to measurements")
    parser.set_defaults(command=_fit)
    parser.add_argument("scenario", help="a scenario file with a table [fit]; its numbers are the first guess")
    add_changes(parser)
    parser.add_argument("--mesh", help="a mesh file in place of the mesh of the scenario")
    add_out(parser, "out/ and the name of the scenario with -fit")
    add_restart(parser, "fit")


def _add_new(commands: Any) -> None:
    parser = commands.add_parser("new", help="print a scenario file to start from: ltljax new gray-scott > my.toml")
    parser.set_defaults(command=_new)
    parser.add_argument(
        "scenario", choices=catalogue.templates(), metavar="NAME", type=_current_name,
        help="the name of a scenario (see: ltljax list), or fit for a file that fits rates to measurements",
    )  # fmt: skip


def _list(options: argparse.Namespace) -> int:
    del options
    print("scenarios:")
    for name, text in catalogue.library().items():
        print(f"  {name:20} {catalogue.title(text)}")
    print(f"\nmeshes: {', '.join(MESHES)}, or any mesh file")
    print("\nRun a scenario:     ltljax run turing --mesh sphere")
    print("Write one of yours: ltljax new gray-scott > my.toml, change the file, and: ltljax run my.toml")
    return 0


def _new(options: argparse.Namespace) -> int:
    print(catalogue.templates()[options.scenario], end="")
    return 0


def _current_name(name: str) -> str:
    """The name of a scenario, which may have had another name in version 0.1."""
    if name not in catalogue.RENAMED:
        return name
    new_name = catalogue.RENAMED[name]
    print(f"warning: the scenario {name} is now called {new_name}; the old name goes in version 0.3", file=sys.stderr)
    return new_name


def _info(options: argparse.Namespace) -> int:
    from .._mesh import MeshError, load_mesh
    from .._mesh.errors import in_one_line

    try:
        print(load_mesh(options.mesh, repair=options.repair).report)
    except MeshError as error:
        if options.repair or not Path(options.mesh).is_file():
            raise
        report = load_mesh(options.mesh, repair=True).report  # Raises if the mesh cannot be repaired.
        print(f"not acceptable as it is: {in_one_line(str(error))}\n\nwith --repair:\n{report}")
    return 0


def _run(options: argparse.Namespace) -> int:
    import jax

    from .run import run

    # Scenario files are read in double precision, whatever the precision of the run.
    jax.config.update("jax_enable_x64", True)
    scenario = _scenario(options)
    inputs = [Path(name) for name in (options.scenario, options.mesh) if name is not None and Path(name).is_file()]
    jax.config.update("jax_enable_x64", scenario.settings.dtype == "float64")
    run(
        scenario, dict(scenario=options.scenario, mesh=options.mesh or scenario.where, changes=options.changes),
        out=options.out or OUT / scenario.name, inputs=inputs, resume=options.resume, overwrite=options.overwrite,
    )  # fmt: skip
    return 0


def _fit(options: argparse.Namespace) -> int:
    import jax

    from . import scenario as scenarios
    from .fit_scenario import fit_scenario

    jax.config.update("jax_enable_x64", True)
    path = Path(options.scenario)
    if path.suffix != ".toml":
        raise ValueError(f"Expected a scenario file that ends in .toml, found {options.scenario!r}.")
    changes = dict(scenarios.parse_change(change) for change in options.changes)
    mesh_file = None if options.mesh is None else Path(options.mesh)
    scenario = scenarios.read(scenarios.read_text(path), options.scenario, path.parent, changes, mesh_file)
    jax.config.update("jax_enable_x64", scenario.settings.dtype == "float64")
    fit_scenario(
        scenario,
        out=options.out or OUT / f"{scenario.name}-fit",
        inputs=(path, *([mesh_file] if mesh_file else [])),
        resume=options.resume,
        overwrite=options.overwrite,
    )
    return 0


def _scenario(options: argparse.Namespace) -> "Scenario":
    """The scenario of a file or of the library, with the changes of the command line."""
    from . import scenario as scenarios

    texts, path = catalogue.library(), Path(options.scenario)
    name = _current_name(options.scenario)
    if name in texts:
        text, folder = texts[name], Path()
    elif path.suffix == ".toml":
        text, folder = scenarios.read_text(path), path.parent
    else:
        near = difflib.get_close_matches(name, texts, n=1)
        raise ValueError(
            f"Expected the name of a scenario or a file that ends in .toml, found {name!r}"
            f"{f' (did you mean {near[0]}?)' if near else ''}. Names: {', '.join(texts)}."
        )
    values = {
        "time.end": options.t1,
        "time.frames": options.frames,
        "seed": options.seed,
        "scale": options.scale,
        "solver.dtype": options.dtype,
        "solver.scheme": options.scheme,
        "solver.degree": options.degree,
        "output.view": options.view,
        "output.texture": options.texture,
        "boundary.conditions": options.boundary,
    }
    mesh_file = None if options.mesh is None or options.mesh in MESHES else Path(options.mesh)
    if mesh_file is not None or name not in texts:  # These options are for mesh files alone.
        values |= {"mesh.repair": options.repair or None, "mesh.scale": "keep" if options.keep_scale else None}
    # The mesh comes first, since it replaces the table that other changes refer to.
    changes: dict[str, Any] = {"mesh": {"shape": options.mesh}} if options.mesh in MESHES else {}
    changes |= {key: value for key, value in values.items() if value is not None}
    changes |= dict(scenarios.parse_change(change) for change in options.changes)
    # A person may name any mesh file; a scenario file may name only files beside it.
    if isinstance(named := changes.get("mesh.file"), str) and Path(named).is_absolute():
        mesh_file = Path(changes.pop("mesh.file"))
    return scenarios.read(text, name, folder, changes, mesh_file, options.variant)


if __name__ == "__main__":
    sys.exit(main())

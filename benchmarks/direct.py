"""Poisson's equation for many right-hand sides, with multigrid and with a sparse factor: a Markdown table.

python benchmarks/direct.py [--levels 4 5 6 7]

Every time is the median over rounds in which both take turns. The first call, which compiles, is listed separately.
"""

import argparse
import statistics
import time
import warnings

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402

import ltljax as ltl  # noqa: E402

ROUNDS = 9


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--levels", type=int, nargs="+", default=(4, 5, 6, 7), help="subdivision levels")
    warnings.simplefilter("ignore")
    print("| mesh | vertices | | setup (s) | first call (s) | each further call (ms) | relative residual |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for level in parser.parse_args().levels:
        meshes = {"icosphere": ltl.shapes.icosphere(level), "random": ltl.shapes.random_sphere(10 * 4**level + 2, 0)}
        for name, mesh in meshes.items():
            print_rows(name, ltl.Surface.from_mesh(mesh))


def print_rows(name, surface):
    """Solve for all right-hand sides with both preconditioners, and print a row for each."""
    x, y, z = np.asarray(surface.vertices).T
    right_hand_sides = [np.sin(3 * x + k) * y + z**3 for k in range(ROUNDS + 1)]
    right_hand_sides = [f - float(surface.mass @ f / surface.mass.sum()) for f in right_hand_sides]
    *timed, first = right_hand_sides
    ltl.laplacian(surface, first)  # compiles
    preconditioners, cells, times = {}, {}, {"multigrid": [], "factor": []}
    for method, set_up in (("multigrid", ltl.solvers.multigrid), ("factor", ltl.solvers.factorized)):
        start = time.perf_counter()
        preconditioners[method] = set_up(surface)
        after_setup = time.perf_counter()
        u = jax.block_until_ready(ltl.poisson(surface, first, preconditioner=preconditioners[method]))
        end = time.perf_counter()
        residual = rms(np.asarray(ltl.laplacian(surface, u)) - first) / rms(first)
        cells[method] = f"{after_setup - start:.2f} | {end - after_setup:.2f}", f"{residual:.0e}"
    for f in timed:
        for method, preconditioner in preconditioners.items():
            start = time.perf_counter()
            jax.block_until_ready(ltl.poisson(surface, f, preconditioner=preconditioner))
            times[method].append(1e3 * (time.perf_counter() - start))
    for method, (setup, residual) in cells.items():
        median = statistics.median(times[method])
        print(f"| {name} | {surface.num_vertices} | {method} | {setup} | {median:.1f} | {residual} |", flush=True)


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


if __name__ == "__main__":
    main()

"""Poisson's equation for many right sides: by multigrid, and by a factor of the matrix. A Markdown table.

python benchmarks/direct.py [--levels 4 5 6 7]

Every number is the median over rounds in which both take turns; the first call, with its compilation, stands apart.
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
    parser.add_argument("--levels", type=int, nargs="+", default=(4, 5, 6, 7), help="of icospheres")
    warnings.simplefilter("ignore")
    print("| mesh | vertices | | setting up (s) | first call (s) | every further one (ms) | relative residual |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for level in parser.parse_args().levels:
        for name, mesh in (
            ("icosphere", ltl.shapes.icosphere(level)),
            ("random", ltl.shapes.random_sphere(10 * 4**level + 2, 0)),
        ):
            surface = ltl.Surface.from_mesh(mesh)
            x, y, z = np.asarray(surface.vertices).T
            rights = [np.sin(3 * x + k) * y + z**3 for k in range(ROUNDS + 1)]
            rights = [f - float(surface.mass @ f / surface.mass.sum()) for f in rights]
            ways = {}
            ltl.laplacian(surface, rights[-1])
            for way, set_up in (("multigrid", ltl.solvers.multigrid), ("factor", ltl.solvers.factorized)):
                start = time.perf_counter()
                inverse = set_up(surface)
                middle = time.perf_counter()
                u = jax.block_until_ready(ltl.poisson(surface, rights[-1], preconditioner=inverse))
                end = time.perf_counter()
                residual = np.asarray(ltl.laplacian(surface, u)) - rights[-1]
                ways[way] = (inverse, middle - start, end - middle, rms(residual) / rms(rights[-1]), [])
            for f in rights[:-1]:
                for inverse, *_, times in ways.values():
                    start = time.perf_counter()
                    jax.block_until_ready(ltl.poisson(surface, f, preconditioner=inverse))
                    times.append(1e3 * (time.perf_counter() - start))
            for way, (_, building, first, residual, times) in ways.items():
                row = f"{building:.2f} | {first:.2f} | {statistics.median(times):.1f} | {residual:.0e}"
                print(f"| {name} | {surface.num_vertices} | {way} | {row} |", flush=True)


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


if __name__ == "__main__":
    main()

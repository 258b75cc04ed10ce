"""How cost grows with the number of vertices: a Markdown table, and the fitted slope of every column.

python benchmarks/scaling.py [--sizes 10000 30000 100000 300000 1000000]

A slope of 1 is linear cost. On small meshes the overhead of a call counts, so the slopes of sums over slots are
slightly below 1. The reverse of a step is evaluated repeatedly at the same state.
"""

import argparse
import math
import time
import warnings

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from speed import compare, compiled, kinetics_of, start_of, step  # noqa: E402

import ltljax as ltl  # noqa: E402

SIZES = (10_000, 30_000, 100_000, 300_000, 1_000_000)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", type=int, nargs="+", default=SIZES, help="approximate numbers of vertices")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    titles, rows = None, []
    for size in arguments.sizes:
        n_minor = round(math.sqrt(size / 2))
        mesh = ltl.shapes.torus(n_major=2 * n_minor, n_minor=n_minor)
        jittered = ltl.shapes.jittered_torus(2 * n_minor, n_minor, 0.25, seed=0)
        values = {"build (s)": build(mesh), "build, jittered (s)": build(jittered), **run(mesh)}
        if titles is None:
            titles = tuple(values)
            print("| vertices | " + " | ".join(titles) + " |\n" + "| --- " * (len(titles) + 1) + "|")
        rows.append((mesh.num_vertices, *values.values()))
        print(f"| {mesh.num_vertices} | " + " | ".join(f"{value:.3g}" for value in values.values()) + " |", flush=True)
    counts, *columns = np.log(np.array(rows)).T
    print("| slope | " + " | ".join(f"{np.polyfit(counts, column, 1)[0]:.2f}" for column in columns) + " |")


def build(mesh):
    """The best time to build a surface, in seconds."""
    _ = mesh.boundary_loops  # computed here, because it belongs to the mesh
    best = math.inf
    for _ in range(3 if mesh.num_vertices < 200_000 else 1):
        start = time.perf_counter()
        jax.block_until_ready(jax.tree.leaves(ltl.Surface.from_mesh(mesh)))
        best = min(best, time.perf_counter() - start)
    return best


def run(mesh):
    """Milliseconds of a Laplacian, of a reaction-diffusion step, and of its transposed derivative."""
    surface = ltl.Surface.from_mesh(mesh, dtype=np.float32)
    state, dt = start_of(surface)
    u, kinetics = jnp.asarray(state), kinetics_of(surface)

    def repeated(advance):
        return lambda surface, u, v: jax.lax.scan(lambda v, _: (advance(surface, u, v), None), v, length=20)[0]

    def backwards(surface, u, v):
        return jax.vjp(lambda u: step(surface, u, dt, kinetics), u)[1](v)[0]

    contestants = {
        "Laplacian (ms)": compiled(repeated(lambda surface, u, v: dt * ltl.laplacian(surface, v)), surface, u, u)[0],
        "step (ms)": compiled(repeated(lambda surface, u, v: step(surface, v, dt, kinetics)), surface, u, u)[0],
        "step, reverse (ms)": compiled(repeated(backwards), surface, u, u)[0],
    }
    return {name: value / 20 for name, value in compare(contestants, rounds=5, inner=2).items()}


if __name__ == "__main__":
    main()

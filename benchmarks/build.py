"""How long a surface takes to build, and its conserved measure to compute: prints one Markdown table.

python benchmarks/build.py [--largest 1000000] [MESH_FILE ...]

Everything here runs in NumPy and SciPy on the host; nothing is compiled.
"""

import argparse
import math
import time
import warnings

import jax

jax.config.update("jax_enable_x64", True)

import ltljax as ltl  # noqa: E402

SIZES = (10_000, 100_000, 1_000_000)
SCHEMES = {"Paper": ltl.Paper(), "Monotone": ltl.Monotone(), "Polynomial(degree=4)": ltl.Polynomial(degree=4)}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--largest", type=int, default=SIZES[-1], help="number of vertices not to exceed")
    parser.add_argument("files", nargs="*", help="mesh files to build as well")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore", ltl.InconsistentRowsWarning)
    print("| mesh | vertices | scheme | build (s) | rows from 1, 2, 3 rings | inconsistent | mass (s) |")
    print("|---|---|---|---|---|---|---|")
    for name, mesh in meshes(arguments.largest, arguments.files):
        for scheme_name, scheme in SCHEMES.items():
            print(f"| {name} | {mesh.num_vertices} | {scheme_name} | {' | '.join(row(mesh, scheme))} |", flush=True)


def meshes(largest, files):
    for size in SIZES:
        if size <= largest:
            n_minor = round(math.sqrt(size / 2))
            yield "torus, jittered", ltl.shapes.jittered_torus(2 * n_minor, n_minor, 0.25, seed=0)
            yield "sphere, random", ltl.shapes.random_sphere(size, seed=0)
    for path in files:
        yield path.rsplit("/", 1)[-1], ltl.load_mesh(path)


def row(mesh, scheme):
    start = time.perf_counter()
    surface = ltl.Surface.from_mesh(mesh, scheme)
    build = f"{time.perf_counter() - start:.2f}"
    report = surface.report
    if not isinstance(scheme, ltl.Monotone):
        return build, "-", "-", "-"
    shares = " ".join(f"{100 * (report.rings == rings).mean():.1f} %" for rings in (1, 2, 3))
    start = time.perf_counter()
    _ = surface.mass
    return build, shares, str(len(report.inconsistent)), f"{time.perf_counter() - start:.2f}"


if __name__ == "__main__":
    main()

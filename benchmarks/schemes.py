"""Errors of both schemes on the unit sphere, regular to random: prints one Markdown table.

python benchmarks/schemes.py
"""

import time

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

import ltljax as ltl  # noqa: E402

MESHES = {
    "icosphere": lambda: ltl.shapes.icosphere(4),
    "jittered by half an edge": lambda: ltl.shapes.jittered_sphere(4, 0.5, seed=0),
    "random points": lambda: ltl.shapes.random_sphere(2562, seed=0),
}
SCHEMES = {
    "Paper": ltl.Paper(),
    "Monotone": ltl.Monotone(),
    "Monotone(lift=projection)": ltl.Monotone(lift="projection"),
}


def main():
    print("| mesh | scheme | heat | Laplacian | gradient | one-ring rows | build (s) |")
    print("|---|---|---|---|---|---|---|")
    for mesh_name, make in MESHES.items():
        mesh = make()
        for scheme_name, scheme in SCHEMES.items():
            print(f"| {mesh_name} | `{scheme_name}` | {' | '.join(row(mesh, scheme))} |")


def row(mesh, scheme):
    x, y, z = mesh.vertices.T
    quadratic, cubic = (x**2 - y**2) / 2, x * y * z
    start = time.perf_counter()
    surface = ltl.Surface.from_mesh(mesh, scheme)
    seconds = time.perf_counter() - start
    u = jnp.asarray(quadratic + cubic)
    gradient = np.stack([y * z + x, x * z - y, x * y], axis=1)
    gradient -= (gradient * mesh.vertices).sum(axis=1, keepdims=True) * mesh.vertices
    decayed = quadratic * np.exp(-0.6) + cubic * np.exp(-1.2)
    try:
        heat = relative(ltl.solve(ltl.Diffusion(), surface, u, 0.1, rtol=1e-9, atol=1e-11).us[-1], decayed)
    except ltl.SolveError:
        heat = "overflows"
    rings = surface.report.rings
    return (
        heat,
        relative(ltl.laplacian(surface, u), -6 * quadratic - 12 * cubic),
        relative(ltl.gradient(surface, u), gradient),
        "100 %" if rings is None else f"{100 * np.mean(rings == 1):.0f} %",
        f"{seconds:.2f}",
    )


def relative(found, exact):
    return f"{np.linalg.norm(np.asarray(found) - exact) / np.linalg.norm(exact):.1e}"


if __name__ == "__main__":
    main()

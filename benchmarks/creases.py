"""Accuracy on creased, cut and stretched surfaces beside robust-laplacian: Markdown tables.

python benchmarks/creases.py [--problems folds,cube] [--json creases.json]

The Laplacian of a surface does not depend on how the surface bends in space, so a folded sheet, a box and a CAD part
should be as accurate as a plane. Every problem has a known solution, and every figure is a relative error. Errors of
fields are in the L2 norm, weighted by vertex areas; errors of eigenvalues are the worst or the mean, as named. A ratio
of ``Monotone()`` to robust-laplacian below 1 means that this package is more accurate. robust-laplacian (install
ltljax[bench]) is used as -M^-1 S with its lumped mass matrix M. Real meshes are read from ``../shared/meshes`` and
omitted if that folder is missing; the CAD part is omitted if manifold3d is not installed.
"""

import argparse
import json
import sys
import time
import warnings
from pathlib import Path
from typing import NamedTuple

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
import robust_laplacian  # noqa: E402
import scipy.interpolate  # noqa: E402
import scipy.sparse  # noqa: E402
import scipy.special  # noqa: E402
import trimesh  # noqa: E402
from scipy.optimize import brentq  # noqa: E402
from scipy.sparse.csgraph import reverse_cuthill_mckee  # noqa: E402
from scipy.sparse.linalg import LinearOperator, eigs, eigsh, splu  # noqa: E402

import ltljax as ltl  # noqa: E402

DEFAULT, CHORD, PEER = "Monotone()", 'Monotone(lift="chord")', "robust-laplacian"
SCHEMES = {DEFAULT: ltl.Monotone(), CHORD: ltl.Monotone(lift="chord")}
SCANS = Path(__file__).parents[2] / "shared" / "meshes"
TIME, TIME_STEPS = 0.1, 8
SHIFT = -0.1  # eigenvalues of -Delta are computed near this value
SMALL_POLYHEDRON = 60_000  # vertices; a polyhedron is refined at least twice, and again while it stays smaller


class Operator(NamedTuple):
    """A Laplacian as a matrix. That of robust-laplacian has a lumped mass; ``diag(mass) @ matrix`` is symmetric."""

    matrix: scipy.sparse.csr_array
    mass: np.ndarray | None = None
    surface: ltl.Surface | None = None


def robust(vertices, faces):
    """Cotangent weights of the intrinsic Delaunay triangulation, barycentric areas."""
    stiffness, mass = robust_laplacian.mesh_laplacian(vertices, faces)
    inverse = scipy.sparse.diags_array(1 / mass.diagonal())
    return Operator(scipy.sparse.csr_array(-inverse @ stiffness), mass.diagonal())


def compare(problem, mesh, measures):
    """One row for each measure {quantity: (function, *arguments)}, called as function(operator, mesh, *arguments)."""
    start, rows = time.perf_counter(), []
    surfaces = {scheme: ltl.Surface.from_mesh(mesh, scheme) for scheme in set(SCHEMES.values())}
    operators = {scheme: Operator(ltl.laplacian_matrix(s), surface=s) for scheme, s in surfaces.items()}
    operators[PEER] = robust(mesh.vertices, mesh.faces)
    inconsistent = len(surfaces[SCHEMES[DEFAULT]].report.inconsistent)
    for quantity, (function, *arguments) in measures.items():
        errors = {key: function(operator, mesh, *arguments) for key, operator in operators.items()}
        row = dict(problem=problem, quantity=quantity, vertices=mesh.num_vertices, inconsistent=inconsistent)
        row |= {name: errors[SCHEMES.get(name, name)] for name in (DEFAULT, CHORD, PEER)}
        rows.append(row | {f"{DEFAULT} / robust": row[PEER] and row[DEFAULT] / row[PEER]})
    print(f"{problem}, {mesh.num_vertices} vertices: {time.perf_counter() - start:.1f} s", file=sys.stderr)
    return rows


def heat_error(operator, mesh, u, u1):
    """The error of u_t = Delta u from u to u1 at TIME, by the [3/4] Pade approximant of exp in partial fractions.

    The approximant is seventh order and damps stiff modes. It adds less than 1e-8 to the error here.
    """
    numerator, denominator = scipy.interpolate.pade(1 / scipy.special.factorial(np.arange(8)), 4, 3)
    poles = [pole for pole in denominator.roots if pole.imag > 0]
    residues = [numerator(pole) / denominator.deriv()(pole) for pole in poles]
    step, identity = TIME / TIME_STEPS * operator.matrix, scipy.sparse.eye_array(len(u))
    solves = [factorized(step - pole * identity) for pole in poles]
    for _ in range(TIME_STEPS):
        u = 2 * sum(residue * solve(u) for residue, solve in zip(residues, solves, strict=True)).real
    return relative(u, u1, mesh)


def screened_error(operator, mesh, u, laplacian):
    """The error of Delta u - u = f with zero flux through the boundary."""
    solve = factorized(operator.matrix - scipy.sparse.eye_array(len(u)))
    return relative(solve(laplacian - u), u, mesh)


def dirichlet_error(operator, mesh, u, laplacian):
    """The error of Delta u = f with the exact values of u on the boundary."""
    inner, rim = np.flatnonzero(~mesh.boundary_vertices), np.flatnonzero(mesh.boundary_vertices)
    rows, solution = operator.matrix[inner], u.copy()
    solution[inner] = factorized(rows[:, inner])(laplacian[inner] - rows[:, rim] @ u[rim])
    return relative(solution, u, mesh)


def derivative_error(operator, mesh, derivative, u, exact, mask):
    """The error of a derivative on part of the surface, relative to the derivative on the whole surface."""
    if operator.surface is None:
        return None
    return relative(np.where(mask, derivative(operator.surface, u), exact), exact, mesh)


def eigenvalue_error(operator, mesh, spectrum, summary):
    """The worst (np.max) or mean (np.mean) relative error of the first nonzero eigenvalues."""
    return float(summary(np.abs(eigenvalues(operator, len(spectrum)) / spectrum - 1)))


def eigenvalues(operator, count):
    """The first nonzero eigenvalues of -Delta, sorted by their real parts."""
    size = operator.matrix.shape[0]
    solver, mass = (eigs, np.ones(size)) if operator.mass is None else (eigsh, operator.mass)
    mass = scipy.sparse.diags_array(mass)
    stiffness = -mass @ operator.matrix
    inverse = LinearOperator((size, size), factorized(stiffness - SHIFT * mass))
    start = np.random.default_rng(0).normal(size=size)
    options = dict(M=mass, sigma=SHIFT, OPinv=inverse, v0=start, tol=1e-10, return_eigenvectors=False)
    # Compute twice as many as needed, because Krylov methods find the copies of a multiple eigenvalue late.
    return np.sort(solver(stiffness, 2 * count, **options).real)[1 : count + 1]


def polyhedron_spectrum(mesh, count):
    """The first nonzero eigenvalues of the polyhedron itself, in the limit of subdividing its faces in their planes.

    The eigenvalues of robust-laplacian are extrapolated by Richardson's method. The order is estimated from the last
    two differences, between 1 and 4. It is below 2 if face angles at a vertex add up to more than 2 pi. If the
    differences have different signs, order 2 is used.
    """
    vertices, faces = mesh.vertices, mesh.faces.astype(np.int64)
    levels = [eigenvalues(robust(vertices, faces), count)]
    while len(levels) < 3 or 4 * len(vertices) < SMALL_POLYHEDRON:
        vertices, faces = trimesh.remesh.subdivide(vertices, faces)
        levels.append(eigenvalues(robust(vertices, faces), count))
    previous, last = levels[-2] - levels[-3], levels[-1] - levels[-2]
    order = np.where(previous * last > 0, np.clip(np.log2(np.abs(previous / last)), 1, 4), 2)
    return levels[-1] + last / (2**order - 1)


def relative(u, exact, mesh):
    """The relative error in the L2 norm, with a third of the area of every face at each of its corners."""
    face_areas = trimesh.triangles.area(mesh.vertices[mesh.faces])
    areas = np.bincount(mesh.faces.ravel(), np.repeat(face_areas / 3, 3))
    return float(np.sqrt(areas @ (u - exact) ** 2 / (areas @ exact**2)))


def factorized(matrix):
    """The function that solves matrix x = b. The matrix is diagonally dominant, so pivoting is not needed."""
    matrix = scipy.sparse.csr_array(matrix)
    # SuperLU's minimum degree ordering takes minutes on subdivided meshes unless neighbours have similar indices.
    order = reverse_cuthill_mckee(scipy.sparse.csr_array(abs(matrix) + abs(matrix.T)), symmetric_mode=True)
    options = dict(permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=dict(SymmetricMode=True))
    factors = splu(scipy.sparse.csc_array(matrix[order][:, order]), **options)
    inverse_order = np.argsort(order)
    return lambda b: factors.solve(b[order].astype(matrix.dtype))[inverse_order]


def decaying(u, rate):
    """The measures of an eigenfunction: Delta u = -rate u, with zero flux through the boundary."""
    return {"heat": (heat_error, u, np.exp(-rate * TIME) * u), "screened Poisson": (screened_error, u, -rate * u)}


def folds(n=48):
    """The strip [0, 2] x [0, 1], bent along x = 1, with u = cos(pi x / 2) in the unfolded x and zero flux."""
    derivatives = {
        "gradient": lambda surface, u: np.linalg.norm(ltl.gradient(surface, u), axis=1),
        "Hessian": lambda surface, u: np.linalg.norm(ltl.hessian(surface, u), axis=(1, 2)),
        "div grad": lambda surface, u: np.asarray(ltl.divergence(surface, ltl.gradient(surface, u))),
    }
    rows = []
    for angle in (0, 20, 30, 45, 60, 90, 120, 150, 170):
        plane, mesh = bent_strip(n, np.radians(angle))
        x, rate = plane[:, 0], (np.pi / 2) ** 2
        u = np.cos(np.pi * x / 2)
        exact = {"gradient": np.pi / 2 * np.sin(np.pi * x / 2), "Hessian": rate * np.abs(u), "div grad": -rate * u}
        measures = decaying(u, rate)
        # Fits within three cells of the boundary use boundary vertices.
        inner = np.all((plane > 3 / n) & (plane < np.array([2, 1]) - 3 / n), axis=1)
        for region, mask in {"inside": inner, "near the crease": inner & (np.abs(x - 1) < 3 / n)}.items():
            for name, function in derivatives.items():
                measures[f"{name} {region}"] = (derivative_error, function, u, exact[name], mask)
        rows += compare(f"fold of {angle} degrees", mesh, measures)
    flat = {row["quantity"]: row for row in reversed(rows)}  # the first row of each quantity
    return [row | {f"{name} / flat": row[name] / flat[row["quantity"]][name] for name in SCHEMES} for row in rows]


def bent_strip(n, angle):
    """The strip of 2 n by n cells: its vertices (V, 2) before bending, and its mesh after bending.

    Vertices are moved by up to 0.3 cells, on the rim and the crease only along them. Diagonals are random.
    """
    random = np.random.default_rng(0)
    cells = np.stack(np.meshgrid(np.arange(2 * n + 1), np.arange(n + 1), indexing="ij"), axis=-1)
    shift = random.uniform(-0.3, 0.3, cells.shape)
    shift[[0, n, 2 * n], :, 0] = shift[:, [0, n], 1] = 0
    plane = ((cells + shift) / n).reshape(-1, 2)
    a = (np.arange(2 * n)[:, None] * (n + 1) + np.arange(n)).reshape(-1, 1)
    b, c, d = a + n + 1, a + n + 2, a + 1
    is_rising = random.uniform(size=a.shape) < 0.5
    faces = np.where(is_rising, np.hstack([a, b, c, a, c, d]), np.hstack([a, b, d, b, c, d])).reshape(-1, 3)
    x, y = plane.T
    beyond = np.maximum(x - 1, 0)
    vertices = np.stack([np.minimum(x, 1) + beyond * np.cos(angle), y, beyond * np.sin(angle)], axis=1)
    return plane, ltl.Mesh(vertices, faces)


def cube(n=40):
    """The unit cube, whose first two eigenvalues have three eigenfunctions each."""
    square, edges = ltl.shapes.square(1.0, n), np.roll(np.eye(3), 1, axis=0)
    low = [np.roll(square.vertices, k, axis=1) for k in range(3)]
    mesh = welded(*((side, square.faces) for k in range(3) for side in (low[k], low[k] + edges[k])))
    spectrum = np.repeat(polyhedron_spectrum(mesh, 6).reshape(2, 3).mean(axis=1), 3)
    label = f"unit cube, {spectrum[0]:.5f} and {spectrum[3]:.5f}"
    return compare(label, mesh, {"worst of 6 eigenvalues": (eigenvalue_error, spectrum, np.max)})


def can(rings=36, n_along=60):
    """The cylinder of radius 1 and height 2 with both lids."""
    lid, side = ltl.shapes.disk(1.0, rings), ltl.shapes.cylinder(1.0, 2.0, 6 * rings, n_along)
    up = np.array([0.0, 0.0, 1.0])
    mesh = welded((side.vertices, side.faces), (lid.vertices - up, lid.faces), (lid.vertices + up, lid.faces))
    return compare("can", mesh, {"worst of 10 eigenvalues": (eigenvalue_error, can_spectrum(10), np.max)})


def can_spectrum(count):
    """The first eigenvalues of the can: roots e = k^2 + m^2 of w' J_m(sqrt(e)) + w sqrt(e) J_m'(sqrt(e)) at z = 1.

    On the lids u = J_m(sqrt(e) r) cos(m t), and on the side u = w(z) cos(m t) with w = cos(k z) or sin(k z) / k, where
    k^2 has any sign. The equation matches values and fluxes at the rim z = 1.
    """

    def mismatch(e, m, is_even):
        k, root = np.sqrt(e - m**2 + 0j), np.sqrt(e)
        sine = np.sinc(k / np.pi)
        wave, slope = (np.cos(k), -(k**2) * sine) if is_even else (sine, np.cos(k))
        return (slope * scipy.special.jv(m, root) + wave * root * scipy.special.jvp(m, root)).real

    values, grid = [], np.linspace(1e-3, 20, 4000)
    for m, is_even in ((m, is_even) for m in range(6) for is_even in (True, False)):
        signs = np.sign(mismatch(grid, m, is_even))
        for j in np.flatnonzero(signs[:-1] != signs[1:]):
            values += [brentq(mismatch, grid[j], grid[j + 1], args=(m, is_even), xtol=1e-13)] * (2 if m else 1)
    return np.sort(values)[:count]


def welded(*pieces):
    """One mesh of pieces (vertices, faces). Positions are rounded, so that shared vertices are equal."""
    vertices, faces = trimesh.util.append_faces(*zip(*pieces, strict=True))
    return ltl.Mesh(np.round(vertices, 12) + 0.0, faces, weld=True)


def cones():
    """Cones of slant length 1 and half angle a: Delta (1 - r^2) = -4, and the harmonic r^nu cos(t), nu = 1 / sin a."""
    rows = []
    for degrees, rings in ((30, 56), (15, 78)):
        sine, cosine = np.sin(np.radians(degrees)), np.cos(np.radians(degrees))
        r, t, faces = cone_lattice(sine, rings)
        mesh = ltl.Mesh(r[:, None] * np.stack([sine * np.cos(t), sine * np.sin(t), -cosine + 0 * t], axis=1), faces)
        wave = r ** (1 / sine) * np.cos(t)
        measures = {"1 - r^2": (dirichlet_error, 1 - r**2, 0 * r - 4), "r^nu cos(t)": (dirichlet_error, wave, 0 * r)}
        rows += compare(f"cone of {degrees} degrees", mesh, measures)
    return rows


def cone_lattice(sine, rings):
    """Distances r from the tip, angles t about the axis, and faces. Even rings are jittered by 0.2 of their spacing."""
    sizes = np.array([1] + [max(6, round(2 * np.pi * sine * j)) for j in range(1, rings + 1)])
    starts, ring = np.cumsum([0, *sizes]), np.repeat(np.arange(rings + 1), sizes)
    shift = np.random.default_rng(0).uniform(-0.2, 0.2, (2, len(ring)))
    shift[:, (ring == 0) | (ring == rings)] = 0
    r, t = (ring + shift[0]) / rings, 2 * np.pi * (np.arange(len(ring)) - starts[ring] + shift[1]) / sizes[ring]
    faces = []
    for m, n, inner, outer in zip(sizes, sizes[1:], starts, starts[1:], strict=False):
        # Every edge of a ring is joined to the vertex of the other ring that is closest in angle.
        j, k = np.arange(m if m > 1 else 0), np.arange(n)
        to_inner, to_outer = -((n - (2 * k + 1) * m) // (2 * n)) % m, ((2 * j + 1) * n + m) // (2 * m) % n
        faces.append(np.stack([outer + k, outer + (k + 1) % n, inner + to_inner], axis=1))
        faces.append(np.stack([inner + (j + 1) % m, inner + j, outer + to_outer], axis=1))
    return r, t, np.concatenate(faces)


def scans():
    """Real meshes, compared with the exact eigenvalues of the same polyhedra."""
    rows = []
    names = ("spot_low", "spot", "bunny_closed", "armadillo", "hand_open", "stanford_bunny")
    for path in filter(Path.exists, (SCANS / f"{name}.obj" for name in names)):
        mesh = ltl.load_mesh(path)
        mesh = mesh.scaled(np.sqrt(4 * np.pi / mesh.area))  # the first eigenvalues are then about 1
        spectrum = polyhedron_spectrum(mesh, 10)
        rows += compare(path.stem, mesh, {"mean of 10 eigenvalues": (eigenvalue_error, spectrum, np.mean)})
    return rows


def part():
    """A CAD part: a box with a hole, a boss and a slot, with split edges, and raw from the boolean operations."""
    if "manifold" not in trimesh.boolean.engines_available:
        print("The CAD part is omitted, because manifold3d is not installed.", file=sys.stderr)
        return []
    box = trimesh.creation.box((1.0, 0.7, 0.3))
    boss = trimesh.creation.cylinder(0.17, 0.3, sections=32).apply_translation([-0.2, 0.05, 0.2])
    hole = trimesh.creation.cylinder(0.12, 1.0, sections=32).apply_translation([0.28, 0.0, 0.0])
    slot = trimesh.creation.box((0.08, 1.0, 0.12)).apply_translation([0.05, 0.0, 0.15])
    solid = trimesh.boolean.difference([trimesh.boolean.union([box, boss]), hole, slot])
    fine = ltl.Mesh(*trimesh.remesh.subdivide_to_size(solid.vertices, solid.faces, 0.1))
    raw = ltl.Mesh(solid.vertices, solid.faces)
    measures = {"mean of 8 eigenvalues": (eigenvalue_error, polyhedron_spectrum(fine, 8), np.mean)}
    return compare("CAD part, edges below .1", fine, measures) + compare("CAD part, raw", raw, measures)


def smooth():
    """Smooth surfaces, on regular, jittered, random and stretched meshes."""
    sphere, axes = ltl.shapes.random_sphere(10_242, seed=0), np.array([1.0, 2.0, 3.0])
    ellipsoid = ltl.Mesh(axes * sphere.vertices, sphere.faces)

    def torus_level(minor):
        # The second derivatives of hypot in JAX are wrong where both arguments have the same size.
        return lambda x: (jnp.sqrt(x[0] ** 2 + x[1] ** 2) - 2) ** 2 + x[2] ** 2 - minor**2

    level_sets = {
        "torus": (ltl.shapes.torus(2.0, 1.0, 144, 72), torus_level(1.0)),
        "torus jittered by .3": (ltl.shapes.jittered_torus(144, 72, 0.3, seed=0), torus_level(1.0)),
        "thin torus, square cells": (ltl.shapes.torus(2.0, 0.2, 320, 32), torus_level(0.2)),
        "thin torus, cells of aspect 8": (ltl.shapes.torus(2.0, 0.2, 112, 90), torus_level(0.2)),
        "ellipsoid 1:2:3, random points": (ellipsoid, lambda x: jnp.sum((x / axes) ** 2)),
    }
    rows = []
    for name, (mesh, level) in level_sets.items():
        fields = zip(("(x^2 - y^2) / 2", "x y z"), zip(*on_level_set(level, mesh.vertices), strict=True), strict=True)
        rows += compare(name, mesh, {f"screened Poisson, {u}": (screened_error, *values) for u, values in fields})
    spheres = {
        "icosphere": ltl.shapes.icosphere(5),
        "sphere jittered by .5": ltl.shapes.jittered_sphere(5, 0.5, seed=0),
        "sphere, random points": sphere,
    }
    for name, mesh in spheres.items():
        second, third = harmonics(mesh.vertices.T)
        u1 = np.exp(-6 * TIME) * second + np.exp(-12 * TIME) * third
        rows += compare(name, mesh, {"heat": (heat_error, second + third, u1)})
    mesh, k = ltl.shapes.jittered(ltl.shapes.disk(1.0, 57), 0.4, seed=0), scipy.special.jnp_zeros(0, 1)[0]
    u = scipy.special.jv(0, k * np.linalg.norm(mesh.vertices, axis=1))  # zero flux through the rim
    return rows + compare("disk jittered by .4", mesh, decaying(u, k**2))


def harmonics(x):
    """Spherical harmonics of degrees 2 and 3."""
    return (x[0] ** 2 - x[1] ** 2) / 2, x[0] * x[1] * x[2]


def on_level_set(level, vertices):
    """The harmonics on a level set, and their Laplacians tr((I - n n^T) D^2 u) - (div n) n . grad u."""

    def normal(x):
        gradient = jax.grad(level)(x)
        return gradient / jnp.linalg.norm(gradient)

    def laplacian(x):
        n, bend = normal(x), jnp.trace(jax.jacfwd(normal)(x))
        first, second = jax.jacfwd(harmonics)(x), jax.hessian(harmonics)(x)
        return [jnp.trace(h) - n @ h @ n - bend * (n @ g) for g, h in zip(first, second, strict=True)]

    return [np.asarray(jax.vmap(function)(vertices)) for function in (harmonics, laplacian)]


PROBLEMS = {function.__name__: function for function in (folds, cube, can, cones, scans, part, smooth)}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--problems", default=",".join(PROBLEMS), help=f"among {', '.join(PROBLEMS)}")
    parser.add_argument("--json", help="write the rows to this file")
    arguments = parser.parse_args()
    names = [name.strip() for name in arguments.problems.split(",")]
    if unknown := set(names) - set(PROBLEMS):
        parser.error(f"There is no problem {', '.join(sorted(unknown))}. Choose among {', '.join(PROBLEMS)}.")
    warnings.simplefilter("ignore", ltl.errors.InconsistentRowsWarning)
    tables = {name: PROBLEMS[name]() for name in names}
    for name, rows in tables.items():
        print(f"\n{PROBLEMS[name].__doc__.splitlines()[0]}\n")
        header = list(rows[0]) if rows else []
        for cells in (header, ["---"] * len(header), *([cell(*item) for item in row.items()] for row in rows)):
            print(f"| {' | '.join(cells)} |")
    if arguments.json:
        Path(arguments.json).write_text(json.dumps(tables, indent=1))


def cell(column, value):
    if not isinstance(value, float):
        return "-" if value is None else str(value)
    return f"{value:.3g}" if "/" in column else f"{value:.1e}"


if __name__ == "__main__":
    main()

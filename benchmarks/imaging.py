"""Vectors, distances, curvature, smoothing of shapes and denoising of images, beside other packages. Markdown tables.

python benchmarks/imaging.py [--parts transport distance curvature flow noise features tv] [--levels 4 5]

The others (install ltljax[bench]): potpourri3d, libigl, LaPy, trimesh, pymeshlab, scikit-image. Where a method has
settings, each is shown at the best of its own, by the error in bold, which the clean shape or image decides. Times are
the median of calls after the first, which for this package compiles and so stands apart. Real meshes come from
--meshes; parts that need one that is not there are left out.
"""

import argparse
import contextlib
import functools
import io
import itertools
import statistics
import time
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import jax

jax.config.update("jax_enable_x64", True)

import igl  # noqa: E402
import lapy  # noqa: E402
import numpy as np  # noqa: E402
import potpourri3d  # noqa: E402
import pymeshlab  # noqa: E402
import scipy.sparse  # noqa: E402
import trimesh  # noqa: E402
from scipy.sparse.linalg import splu  # noqa: E402
from skimage.restoration import denoise_tv_chambolle  # noqa: E402

import ltljax as ltl  # noqa: E402
from ltljax import imaging  # noqa: E402

ROUNDS = 5
ENOUGH = 2.0  # seconds
SOURCES = 7
NOISE = 0.1  # of images whose values lie between 0 and 1
NEAR_ANTIPODE = -0.97  # cosine of the angle beyond which shortest paths on a sphere are as good as not unique

SPHERES = {
    "icosphere": ltl.shapes.icosphere,
    "jittered sphere": lambda level: ltl.shapes.jittered_sphere(level, 0.5, seed=0),
    "random sphere": lambda level: ltl.shapes.random_sphere(10 * 4**level + 2, seed=0),
}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", nargs="+", default=list(PARTS), choices=list(PARTS), metavar="PART")
    parser.add_argument("--levels", type=int, nargs="+", default=(4, 5), help="of icospheres")
    parser.add_argument("--meshes", type=Path, default=Path(__file__).parents[2] / "shared" / "meshes")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    for part in arguments.parts:
        start = time.perf_counter()
        PARTS[part](arguments)
        print(f"\n{part}: {time.perf_counter() - start:.0f} s in all.", flush=True)


# What each part prints.


def transport(arguments):
    """One vector carried over the unit sphere along great circles, whose exact transport is a rotation."""
    heading("Transport of a vector over the unit sphere", transport)
    table("mesh", "vertices", "method", "angle error, rms (°)", "largest (°)", *TIMES)
    for name, mesh, normals in spheres(arguments.levels):
        for method, set_up in TRANSPORTS.items():
            carry, building = timed(functools.partial(set_up, mesh))
            errors, times = [], []
            for source in sources(mesh):
                vector = tangent(normals[source], [0.3, 0.5, 0.8])
                found, seconds = timed(functools.partial(carry, source, vector))
                times.append(seconds)
                errors.append(turned(found, rotated_along(normals, source, vector), normals, source))
            rms, largest = np.mean(errors, axis=0)
            row(name, mesh.num_vertices, method, f"{rms:.3f}", f"{largest:.2f}", *shown(building, times))


def distance(arguments):
    """Distance from one vertex: on the unit sphere against the angle, on a mesh against its exact geodesics."""
    heading("Geodesic distance from a vertex", distance)
    table("mesh", "vertices", "method", "mean relative error", *TIMES)
    cases: list[Any] = [(*case, functools.partial(angles, case[2])) for case in spheres(arguments.levels)]
    if (bunny := real_mesh(arguments, "bunny_closed.obj")) is not None:
        exact = DISTANCES["libigl, exact of the mesh"](bunny)
        cases.append(("bunny_closed", bunny, None, exact))
    for name, mesh, _, reference in cases:
        references = {source: reference(source) for source in sources(mesh)}
        for method, set_up in DISTANCES.items():
            is_exact = "exact" in method
            if is_exact and name != "bunny_closed" and mesh.num_vertices > 3000:
                continue
            measure, building = timed(functools.partial(set_up, mesh))
            errors, times = [], []
            for source, expected in references.items():
                found, seconds = timed(functools.partial(measure, source))
                times.append(seconds)
                is_far = expected > 3 * mesh.mesh_size
                errors.append(np.mean(np.abs(np.asarray(found) - expected)[is_far] / expected[is_far]))
            row(name, mesh.num_vertices, method, f"{100 * np.mean(errors):.2f} %", *shown(building, times))


def curvature(arguments):
    """Mean and Gauss curvature against the exact ones at the vertices; errors are root mean squares, relative.

    LaPy's have no unit and the other sign: each field is multiplied by the number that fits best.
    """
    heading("Curvature", curvature)
    table("mesh", "vertices", "method", "mean curvature", "Gauss curvature", *TIMES)
    for level in arguments.levels:
        for name, mesh, mean, gauss in curved(level):
            for method, set_up in CURVATURES.items():
                measure, building = timed(functools.partial(set_up, mesh))
                found, times = repeated(measure)
                pairs = [(np.asarray(a), b) for a, b in zip(found, (mean, gauss), strict=True)]
                if method.startswith("LaPy"):
                    pairs = [(a * (a @ b) / (a @ a), b) for a, b in pairs]
                errors = (f"{relative(*pair):.1e}" for pair in pairs)
                row(name, mesh.num_vertices, method, *errors, *shown(building, times))


def flow(arguments):
    """A sphere of radius 2 after mean curvature flow for a time of 0.75, when its radius is 1."""
    del arguments
    heading("Mean curvature flow of a sphere", flow)
    table("mesh", "vertices", "method", "steps", "systems solved", "error of mean radius", "rms of radii", *CALLS)
    for name, make in SPHERES.items():
        mesh = make(4).scaled(2.0)
        surface = ltl.Surface.from_mesh(mesh)
        for method, run, steps, solves in (
            ("ltljax", functools.partial(imaging.mean_curvature_flow, surface, 0.75), 10, 30),
            ("ltljax", functools.partial(imaging.mean_curvature_flow, surface, 0.75), 30, 90),
            ("libigl, linearly implicit", functools.partial(cotangent_flow, mesh, 0.75), 30, 30),
            ("libigl, linearly implicit", functools.partial(cotangent_flow, mesh, 0.75), 90, 90),
            ("libigl, linearly implicit", functools.partial(cotangent_flow, mesh, 0.75), 300, 300),
        ):
            vertices, times = repeated(lambda run=run, steps=steps: run(steps))
            radii = np.linalg.norm(np.asarray(vertices), axis=1) - 1
            errors = (f"{radii.mean():+.1e}", f"{np.sqrt(np.mean(radii**2)):.1e}")
            row(name, mesh.num_vertices, method, steps, solves, *errors, *calls(times))


def noise(arguments):
    """Noise of a fifth of an edge length along the normals of smooth shapes; each method at its best.

    How far vertices are off is the root mean square of their distances from the clean surface, over that before.
    """
    heading("Noisy shapes", noise)
    axes = np.array([2.0, 1.5, 1.0])
    ball = ltl.shapes.jittered_sphere(4, 0.5, seed=0)
    shapes = {"A jittered ellipsoid": ltl.Mesh(ball.vertices * axes, ball.faces)}
    if (bunny := real_mesh(arguments, "bunny_closed.obj")) is not None:
        shapes["A bunny"] = bunny
    for name, clean in shapes.items():
        print(f"\n{name}, {clean.num_vertices} vertices:\n")
        smoothing_table(clean, 0.2, "off the clean surface", "normals turned (°)")


def features(arguments):
    """A cube with noise along its normals: the mean angle by which the normals of faces are turned."""
    del arguments
    heading("A noisy cube", features)
    for squares, amount in ((12, 0.2), (24, 0.3)):
        print(f"\n{squares} squares along an edge, noise of {amount} edge lengths:\n")
        smoothing_table(cube(squares), amount, "normals turned (°)", "off the clean surface")


def tv(arguments):
    """Images with noise of a tenth of their range: on a grid of pixels, and on a real surface."""
    heading("Total variation on a grid of pixels", tv)
    pixels = 128
    surface = ltl.Surface.from_mesh(ltl.shapes.square(n=pixels))
    x, y, _ = np.asarray(surface.vertices).T
    clean = np.where((x - 0.35) ** 2 + (y - 0.4) ** 2 < 0.06, 1.0, np.where((x > 0.6) & (y > 0.55), 0.6, 0.0))
    noisy = clean + NOISE * np.random.default_rng(1).normal(size=clean.shape)
    image, weights = noisy.reshape(pixels + 1, pixels + 1), np.geomspace(0.06, 0.2, 6)
    table("method", "weight", "PSNR (dB)", "rms from ltljax's", *CALLS)
    row("noisy", "", f"{decibels(noisy, clean):.2f}", "", "", "")
    first = None
    for method, run in {
        "ltljax.denoise": lambda weight: imaging.denoise(surface, noisy, strength=weight / pixels),
        "scikit-image, default tolerance": lambda weight: denoise_tv_chambolle(image, weight).ravel(),
        "scikit-image, eps 1e-8": lambda weight: denoise_tv_chambolle(image, weight, 1e-8, 5000).ravel(),
    }.items():
        found = swept(run, weights, lambda u: -decibels(u, clean))
        first = found if first is None else first
        apart = "" if found is first else f"{np.sqrt(np.mean((found.value - first.value) ** 2)):.1e}"
        row(method, f"{found.setting:.2f}", f"**{-found.error:.2f}**", apart, *calls(found.times))
    for name in ("spot_low.obj", "spot.obj"):
        if (mesh := real_mesh(arguments, name)) is not None:
            on_spot(name, mesh)


def on_spot(name, mesh):
    print(f"\nOn {name}, {mesh.num_vertices} vertices: patches of one value each. PSNR over the area.\n")
    surface, x = ltl.Surface.from_mesh(mesh), mesh.vertices
    clean = np.zeros(len(x))
    clean[x[:, 2] > 0.25] = 0.5
    clean[np.linalg.norm(x - [0, 0.6, -0.6], axis=1) < 0.63] = 1.0
    clean[np.linalg.norm(x - [0.3, -0.2, 0.2], axis=1) < 0.32] = 0.8
    noisy = clean + NOISE * np.random.default_rng(0).normal(size=len(x))
    h, faces = mesh.mesh_size, mesh.faces.astype(np.int64)

    def error(u):
        return -float(imaging.psnr(surface, np.asarray(u), clean))

    def averaged(rounds):
        u = noisy[:, None]
        for _ in range(rounds):
            u = igl.per_vertex_attribute_smoothing(np.ascontiguousarray(u), faces)
        return u[:, 0]

    table("method", "setting", "PSNR (dB)", *CALLS)
    row("noisy", "", f"{-error(noisy):.2f}", "", "")
    for method, run, settings in (
        ("ltljax.denoise, told the noise", lambda noise: imaging.denoise(surface, noisy, noise=noise), [NOISE]),
        ("ltljax.denoise", lambda s: imaging.denoise(surface, noisy, strength=s * h), np.geomspace(0.05, 0.4, 8)),
        (
            "ltljax.perona_malik",
            lambda s: imaging.perona_malik(surface, noisy, s[0] * h**2, s[1] / h),
            [(t, c) for t in (4, 8, 16) for c in (0.01, 0.02, 0.04)],
        ),
        ("ltljax.diffuse", lambda s: imaging.diffuse(surface, noisy, s * h**2), np.geomspace(0.03, 1, 8)),
        ("libigl, means of neighbours", averaged, range(1, 6)),
    ):
        found = swept(run, settings, error)
        row(method, found.said, f"**{-found.error:.2f}**", *calls(found.times))


PARTS = {part.__name__: part for part in (transport, distance, curvature, flow, noise, features, tv)}


# Transport and distance. Each set-up returns a function of the source.


def our_transport(mesh):
    surface = ltl.Surface.from_mesh(mesh)
    return lambda source, vector: ltl.vectors.transport_vectors(
        surface, source, on_plane(vector, surface.normals[source])
    )


def potpourri_transport(mesh, t_coef=1.0):
    solver = potpourri3d.MeshVectorHeatSolver(mesh.vertices, mesh.faces, t_coef=t_coef)
    first, second, _ = solver.get_tangent_frames()

    def carry(source, vector):
        found = solver.transport_tangent_vector(source, [vector @ first[source], vector @ second[source]])
        return found[:, :1] * first + found[:, 1:] * second

    return carry


TRANSPORTS = {
    "ltljax": our_transport,
    "potpourri3d": potpourri_transport,
    "potpourri3d, t_coef=4": functools.partial(potpourri_transport, t_coef=4.0),
}


def our_distance(mesh):
    return functools.partial(ltl.geodesic_distance, ltl.Surface.from_mesh(mesh))


def potpourri_distance(mesh):
    return potpourri3d.MeshHeatMethodDistanceSolver(mesh.vertices, mesh.faces).compute_distance


def libigl_distance(mesh):
    data = igl.HeatGeodesicsData()
    igl.heat_geodesics_precompute(mesh.vertices, mesh.faces.astype(np.int64), data)
    return lambda source: igl.heat_geodesics_solve(data, np.array([source], np.int64))


def marching_distance(mesh):
    solver = potpourri3d.MeshFastMarchingDistanceSolver(mesh.vertices, mesh.faces)
    return lambda source: solver.compute_distance([[(int(source), [])]])


def exact_distance(mesh):
    none, everywhere = np.zeros(0, np.int64), np.arange(mesh.num_vertices)
    faces = mesh.faces.astype(np.int64)
    return lambda source: igl.exact_geodesic(mesh.vertices, faces, np.array([source]), none, everywhere, none)


DISTANCES = {
    "ltljax": our_distance,
    "potpourri3d, heat": potpourri_distance,
    "potpourri3d, fast marching": marching_distance,
    "libigl, heat": libigl_distance,
    "libigl, exact of the mesh": exact_distance,
}


def spheres(levels):
    for name, make in SPHERES.items():
        for level in levels:
            mesh = make(level)
            yield name, mesh, mesh.vertices / np.linalg.norm(mesh.vertices, axis=1, keepdims=True)


def sources(mesh):
    return np.random.default_rng(0).choice(mesh.num_vertices, SOURCES, replace=False)


def angles(normals, source):
    return 2 * np.arcsin(np.clip(np.linalg.norm(normals - normals[source], axis=1) / 2, 0, 1))


def tangent(normal, aside):
    across = np.cross(normal, aside)
    return across / np.linalg.norm(across)


def on_plane(vector, normal):
    return vector - (vector @ np.asarray(normal)) * np.asarray(normal)


def rotated_along(normals, source, vector):
    """The exact parallel transport along great circles."""
    cosine = np.maximum(normals @ normals[source], NEAR_ANTIPODE)
    return vector - ((normals @ vector) / (1 + cosine))[:, None] * (normals + normals[source])


def turned(found, expected, normals, source):
    """The angle between fields on the unit sphere, in degrees: rms and largest."""
    found = np.asarray(found)
    sine, cosine = np.sum(np.cross(expected, found) * normals, axis=1), np.sum(expected * found, axis=1)
    angle = np.degrees(np.arctan2(sine, cosine))[normals @ normals[source] > NEAR_ANTIPODE]
    return np.sqrt(np.mean(angle**2)), np.abs(angle).max()


# Curvature: functions of a mesh that return a function without arguments, which returns mean and Gauss curvature.


def our_curvature(mesh, scheme):
    surface = ltl.Surface.from_mesh(mesh, scheme)

    def measure():
        found = ltl.curvature(surface)
        return found.mean, found.gauss

    return measure


def fitted_quadrics(mesh, radius):
    """Quadrics fitted to the vertices within some rings."""

    def measure():
        _, _, largest, least, _ = igl.principal_curvature(mesh.vertices, mesh.faces.astype(np.int64), radius=radius)
        return (largest + least) / 2, largest * least

    return measure


def classical(mesh):
    """The cotangent Laplacian of positions along the normals, and the angle defect, over mixed Voronoi areas."""
    vertices, faces = mesh.vertices, mesh.faces.astype(np.int64)

    def measure():
        areas = igl.massmatrix(vertices, faces, igl.MASSMATRIX_TYPE_VORONOI).diagonal()
        bent = -(igl.cotmatrix(vertices, faces) @ vertices) / areas[:, None] / 2
        mean = np.sum(bent * igl.per_vertex_normals(vertices, faces), axis=1)
        return mean, igl.gaussian_curvature(vertices, faces) / areas

    return measure


def lapy_curvature(mesh, smoothit):
    shape = lapy.TriaMesh(mesh.vertices, mesh.faces)

    def measure():
        with contextlib.redirect_stdout(io.StringIO()):
            found = shape.curvature(smoothit=smoothit)
        return found[4], found[5]

    return measure


def trimesh_curvature(mesh, edges):
    """Measures of a ball, over the area of a disk of its radius."""
    shape, radius = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False), edges * mesh.mesh_size

    def measure():
        shape._cache.clear()
        found = (
            trimesh.curvature.discrete_mean_curvature_measure(shape, shape.vertices, radius),
            trimesh.curvature.discrete_gaussian_curvature_measure(shape, shape.vertices, radius),
        )
        return found[0] / (np.pi * radius**2), found[1] / (np.pi * radius**2)

    return measure


CURVATURES = {
    "ltljax, Monotone": functools.partial(our_curvature, scheme=ltl.Monotone()),
    "ltljax, Polynomial(4)": functools.partial(our_curvature, scheme=ltl.Polynomial(4)),
    "libigl, quadrics over 5 rings": functools.partial(fitted_quadrics, radius=5),
    "libigl, quadrics over 2 rings": functools.partial(fitted_quadrics, radius=2),
    "libigl, cotangents and angles": classical,
    "LaPy, smoothed 3 times": functools.partial(lapy_curvature, smoothit=3),
    "trimesh, balls of 3 edges": functools.partial(trimesh_curvature, edges=3),
    "trimesh, balls of 5 edges": functools.partial(trimesh_curvature, edges=5),
}


def curved(level):
    """Irregular meshes with their exact mean and Gauss curvature."""
    ball = ltl.shapes.jittered_sphere(level, 0.5, seed=0)
    one = np.ones(ball.num_vertices)
    yield "jittered sphere", ball, one, one
    torus = ltl.shapes.jittered_torus(36 * 2 ** (level - 3), 18 * 2 ** (level - 3), 0.3, seed=0)
    around = np.hypot(*torus.vertices[:, :2].T)
    yield "jittered torus", torus, (1 + (around - 2) / around) / 2, (around - 2) / around
    axes = np.array([2.0, 1.5, 1.0])
    x = ball.vertices / np.linalg.norm(ball.vertices, axis=1, keepdims=True) * axes
    # From the distance of tangent planes from the centre.
    height, product = 1 / np.linalg.norm(x / axes**2, axis=1), np.prod(axes**2)
    mean = height**3 * (np.sum(axes**2) - np.sum(x**2, axis=1)) / (2 * product)
    yield "jittered ellipsoid", ltl.Mesh(x, ball.faces), mean, height**4 / product


# Shapes that are smoothed.


def cotangent_flow(mesh, t1, steps):
    """(M + dt S) X' = M X with the matrices of the mesh as it is, as Dziuk (1990)."""
    vertices, faces = mesh.vertices, mesh.faces.astype(np.int64)
    for _ in range(steps):
        mass = igl.massmatrix(vertices, faces, igl.MASSMATRIX_TYPE_VORONOI)
        system = mass - t1 / steps * igl.cotmatrix(vertices, faces)
        options = dict(permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=dict(SymmetricMode=True))
        vertices = np.ascontiguousarray(splu(scipy.sparse.csc_matrix(system), **options).solve(mass @ vertices))
    return vertices


def smoothers(mesh):
    """Methods by name: a function of a setting, the settings, and whether the first of these is the method's own."""
    surface, h = ltl.Surface.from_mesh(mesh), mesh.mesh_size
    times, counts = np.geomspace(0.03, 30, 13), (10, 1, 2, 3, 5, 20, 50, 100)

    def ours(function, power, **options):
        return lambda s: function(surface, s * h**power, **options)

    def followed(s):
        return imaging.filter_normals(surface, s[0], normal_iterations=s[1])

    def by_trimesh(filtered, **options):
        def run(iterations):
            shape = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
            return filtered(shape, iterations=iterations, **options).vertices

        return run

    def by_meshlab(name, *names):
        def run(setting):
            shapes = pymeshlab.MeshSet()
            shapes.add_mesh(pymeshlab.Mesh(mesh.vertices, mesh.faces))
            values = setting if isinstance(setting, tuple) else (setting,)
            getattr(shapes, name)(**dict(zip(names, values, strict=True)))
            return shapes.current_mesh().vertex_matrix()

        return run

    flows, fairs = imaging.mean_curvature_flow, imaging.fair
    alike = [(0.35, 5), *((s, n) for s in (0.25, 0.3, 0.4, 0.5) for n in (2, 5, 20, 50))]
    yield "ltljax.filter_normals", followed, alike, True
    for kept, keep_volume in (("", False), (", volume kept", True)):
        yield f"ltljax.mean_curvature_flow{kept}", ours(flows, 2, steps=8, keep_volume=keep_volume), times, False
        yield f"ltljax.fair{kept}", ours(fairs, 2, keep_volume=keep_volume), times, False
        yield f"ltljax.fair, order 2{kept}", ours(fairs, 4, order=2, keep_volume=keep_volume), times, False
    yield "trimesh, Laplacian", by_trimesh(trimesh.smoothing.filter_laplacian), counts, True
    yield "trimesh, Taubin", by_trimesh(trimesh.smoothing.filter_taubin, nu=0.53), counts, True
    yield "trimesh, Humphrey", by_trimesh(trimesh.smoothing.filter_humphrey), counts, True
    yield "trimesh, mutable diffusion", by_trimesh(trimesh.smoothing.filter_mut_dif_laplacian), counts, True
    yield "pymeshlab, Taubin", by_meshlab("apply_coord_taubin_smoothing", "stepsmoothnum"), counts, True
    names = ("stepsmoothnum", "normalthr", "stepnormalnum", "stepfitnum")
    grid = itertools.product((1, 3), (20.0, 30.0, 45.0, 60.0, 90.0), (5, 20, 50), (5, 20))
    two_steps = by_meshlab("apply_coord_two_steps_smoothing", *names)
    yield "pymeshlab, two steps", two_steps, [(3, 60.0, 20, 20), *grid], True


def smoothing_table(clean, amount, chosen_by, beside):
    """Of each method at its best by one measure, with another beside it, and as it comes where it has defaults."""
    mesh = noisy(clean, amount)
    before = float(imaging.enclosed_volume(mesh.vertices, mesh.faces))
    error, other = (MEASURES[name](clean, mesh) for name in (chosen_by, beside))
    table("method", f"{chosen_by}, as it comes", "at its best", "setting", beside, "volume", *CALLS)
    row("noisy", f"{error(mesh.vertices):.3g}", "", "", f"{other(mesh.vertices):.3g}", "", "", "")
    for method, run, settings, has_default in smoothers(mesh):
        found = swept(run, settings, error)
        volume = float(imaging.enclosed_volume(found.value, mesh.faces)) / before - 1
        rest = (f"{other(found.value):.3g}", f"{volume:+.2%}", *calls(found.times))
        row(method, f"{found.default:.3g}" if has_default else "", f"**{found.error:.3g}**", found.said, *rest)


def noisy(mesh, amount):
    normals = np.asarray(ltl.Surface.from_mesh(mesh).normals)
    shift = amount * mesh.mesh_size * np.random.default_rng(0).normal(size=(mesh.num_vertices, 1))
    return ltl.Mesh(mesh.vertices + shift * normals, mesh.faces)


def distance_left(clean, mesh):
    """A function of vertices: how far they are from the clean surface, over how far those of the noisy mesh are."""
    faces = clean.faces.astype(np.int64)

    def off(vertices):
        squares = igl.point_mesh_squared_distance(np.array(vertices, float), clean.vertices, faces)[0]
        return float(np.sqrt(np.mean(squares)))

    before = off(mesh.vertices)
    return lambda vertices: off(vertices) / before


def normals_turned(clean, mesh):
    """A function of vertices: the mean angle of the normals of faces with those of the clean mesh, in degrees."""
    del mesh
    reference = face_normals(clean.vertices, clean.faces)

    def angle(vertices):
        cosine = np.sum(face_normals(vertices, clean.faces) * reference, axis=1)
        return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean())

    return angle


MEASURES = {"off the clean surface": distance_left, "normals turned (°)": normals_turned}


def face_normals(vertices, faces):
    a, b, c = np.moveaxis(np.asarray(vertices)[faces], 1, 0)
    across = np.cross(b - a, c - a)
    return across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), np.finfo(float).tiny)


def cube(squares):
    """The unit cube with that many squares along each edge."""
    shape = trimesh.creation.box()
    lattice = ltl.shapes.square(n=squares)
    sides = []
    for matrix in (trimesh.geometry.align_vectors([0, 0, 1], normal) for normal in np.vstack([np.eye(3), -np.eye(3)])):
        flat = lattice.vertices - lattice.vertices.mean(axis=0) + [0, 0, 0.5]
        sides.append(trimesh.Trimesh(np.round(2 * squares * flat @ matrix[:3, :3].T), lattice.faces, process=False))
    shape = trimesh.util.concatenate(sides)
    shape.merge_vertices()
    return ltl.Mesh(np.asarray(shape.vertices) / (2 * squares), np.asarray(shape.faces))


# Errors, times and tables.


def relative(found, exact):
    return float(np.sqrt(np.mean((found - exact) ** 2) / np.mean(exact**2)))


def decibels(u, clean):
    return float(-10 * np.log10(np.mean((np.asarray(u) - clean) ** 2)))


def timed(run):
    """The result of a call and its seconds."""
    start = time.perf_counter()
    found = jax.block_until_ready(run())
    return found, time.perf_counter() - start


def repeated(run):
    found, first = timed(run)
    return found, [first, *further(run)]


def further(run):
    """The seconds of up to five calls, as many as begin within two seconds."""
    times = []
    while len(times) < ROUNDS and sum(times) < ENOUGH:
        times.append(timed(run)[1])
    return times


class Swept(NamedTuple):
    """A method at the best of its settings, and how good it is at the first of them."""

    setting: Any
    value: np.ndarray
    error: float
    default: float
    times: list[float]

    @property
    def said(self):
        return ", ".join(f"{value:.3g}" for value in np.atleast_1d(self.setting))


def swept(run, settings, error):
    settings = list(settings)
    found, first = timed(lambda: run(settings[0]))
    trials = [(error(found), settings[0], found)]
    for setting in settings[1:]:
        value = run(setting)
        trials.append((error(value), setting, value))
    best = min(trials, key=lambda trial: trial[0] if np.isfinite(trial[0]) else np.inf)
    times = [first, *further(lambda: run(best[1]))]
    return Swept(best[1], np.asarray(best[2]), best[0], trials[0][0], times)


TIMES = ("setting up (s)", "first call (s)", "further calls (ms)")
CALLS = ("first call (s)", "further calls (ms)")


def shown(building, times):
    return digits(building), *calls(times)


def calls(times):
    return digits(times[0]), digits(1e3 * statistics.median(times[1:]))


def digits(value):
    """Two digits, or all those before the point."""
    return f"{value:.0f}" if value >= 100 else f"{value:.2g}"


def heading(title, part):
    print(f"\n## {title}\n\n{' '.join(part.__doc__.split())}\n", flush=True)


def table(*names):
    row(*names)
    row(*["---"] * len(names))


def row(*cells):
    print(f"| {' | '.join(map(str, cells))} |", flush=True)


def real_mesh(arguments, name):
    path = arguments.meshes / name
    return ltl.load_mesh(path) if path.exists() else None


if __name__ == "__main__":
    main()

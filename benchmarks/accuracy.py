"""Accuracy of the Laplacian of this package and of three others on regular to random meshes, open and closed.

python benchmarks/accuracy.py [--refinements 4] [--families icosphere,disk] [--plot accuracy.png] [--json accuracy.json]

The fields are the lowest 9 to 15 eigenfunctions of each surface, so that their Laplacian, gradient, heat flow and
Poisson problem are known. Errors are relative to the exact field, and are root mean squares over the fields. The other
packages (libigl, robust-laplacian, LaPy; install ltljax[bench]) are used as -M^-1 S with a lumped mass matrix M. On a
boundary the normal derivative is zero, for the exact fields and for all operators.
"""

import argparse
import contextlib
import functools
import io
import json
import math
import sys
import time
from collections.abc import Callable
from typing import NamedTuple

import jax

jax.config.update("jax_enable_x64", True)

import igl  # noqa: E402
import lapy  # noqa: E402
import numpy as np  # noqa: E402
import robust_laplacian  # noqa: E402
import scipy.linalg  # noqa: E402
import scipy.sparse  # noqa: E402
from exact_modes import FAMILIES  # noqa: E402
from scipy.sparse.linalg import ArpackNoConvergence, eigs, splu  # noqa: E402

import ltljax as ltl  # noqa: E402

TIME = 0.1
TIME_STEPS = 4
NUM_EIGENVALUES = 12
SHIFT = -0.1  # eigenvalues of -Delta are computed near this value
LARGEST_DENSE = 3000  # vertices; the whole spectrum is computed up to this size
ROUNDING = 1e-12
REFERENCE = "robust-laplacian"

COLUMNS = {
    "laplacian_rms": "Laplacian, rms",
    "laplacian_max": "Laplacian, max",
    "gradient": "gradient",
    "heat": "heat",
    "poisson": "Poisson",
    "eigenvalues": "eigenvalues",
    "largest_real_part": "largest Re / radius",
    "negative_weights": "negative weights",
    "mass_drift": "mass drift",
}
ERRORS = ("laplacian_rms", "laplacian_max", "gradient", "heat", "poisson", "eigenvalues")
RATIOS = ("laplacian_rms", "laplacian_max", "heat", "poisson", "eigenvalues")


class Operator(NamedTuple):
    """A Laplacian as a matrix.

    Attributes:
        matrix: (V, V) the matrix.
        measure: (V,) measure that heat flow should conserve.
        is_symmetric: whether diag(measure) @ matrix is symmetric.
        gradient: function that returns the gradient (V, 3) of a field; None if the package has none.
    """

    matrix: scipy.sparse.csr_array
    measure: np.ndarray
    is_symmetric: bool
    gradient: Callable[[np.ndarray], np.ndarray] | None = None


def ours(scheme, mesh):
    """A scheme of this package. If it has no conserved measure, the vertex areas are used."""
    surface = ltl.Surface.from_mesh(mesh, scheme)
    measure = surface.mass if isinstance(scheme, ltl.Monotone) else surface.vertex_areas
    gradient = functools.partial(ltl.gradient, surface)
    return Operator(ltl.laplacian_matrix(surface), np.asarray(measure), False, gradient)


def libigl(mesh):
    """Cotangent weights, mixed Voronoi areas, and the area-weighted mean of the face gradients."""
    vertices, faces = mesh.vertices, mesh.faces.astype(np.int64)

    def gradient(u):
        weighted = face_areas(mesh)[:, None] * (igl.grad(vertices, faces) @ u).reshape(3, -1).T
        return vertex_sums(mesh, weighted) / vertex_sums(mesh, face_areas(mesh)[:, None])

    stiffness = -igl.cotmatrix(vertices, faces)
    mass = igl.massmatrix(vertices, faces, igl.MASSMATRIX_TYPE_VORONOI)
    return finite_elements(stiffness, mass)._replace(gradient=gradient)


def intrinsic_delaunay(mesh):
    """Cotangent weights of the intrinsic Delaunay triangulation, barycentric areas."""
    return finite_elements(*robust_laplacian.mesh_laplacian(mesh.vertices, mesh.faces, mollify_factor=1e-5))


def lapy_linear(mesh):
    """Linear finite elements with a lumped mass matrix: cotangent weights, barycentric areas."""
    with contextlib.redirect_stdout(io.StringIO()):
        solver = lapy.Solver(lapy.TriaMesh(mesh.vertices, mesh.faces), lump=True)
    return finite_elements(solver.stiffness, solver.mass)


def finite_elements(stiffness, mass):
    measure = mass.diagonal()
    return Operator(scipy.sparse.csr_array(-scipy.sparse.diags_array(1 / measure) @ stiffness), measure, True)


OTHERS = {"libigl": libigl, REFERENCE: intrinsic_delaunay, "LaPy": lapy_linear}


def operators():
    """Constructors by name: the schemes of this package, then the other packages."""
    schemes = {
        "Paper": ltl.Paper(),
        "Monotone": ltl.Monotone(),
        "Monotone(lift=projection)": ltl.Monotone(lift="projection"),
        "Polynomial(degree=3)": ltl.Polynomial(degree=3),
        "Polynomial(degree=4)": ltl.Polynomial(degree=4),
    }
    return {name: functools.partial(ours, scheme) for name, scheme in schemes.items()} | OTHERS


def face_areas(mesh):
    first, second, third = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    return np.linalg.norm(np.cross(second - first, third - first), axis=1) / 2


def vertex_sums(mesh, on_faces):
    """Sums (V, C) of face values (F, C) over the faces at each vertex."""
    sums = np.zeros((len(mesh.vertices), on_faces.shape[1]))
    np.add.at(sums, mesh.faces, on_faces[:, None])
    return sums


def measure(operator, mesh, modes, spectrum):
    """All columns of one row: None if an operator lacks the quantity, "overflows" if heat grows.

    Errors are relative, and are root mean squares over the modes. The pointwise maximum is of the worst mode.
    """
    areas = vertex_sums(mesh, face_areas(mesh)[:, None])[:, 0] / 3
    rates = np.array([mode.eigenvalue for mode in modes])
    u0 = np.stack([mode.values for mode in modes], axis=1)
    laplacian = -rates * u0
    approximation = operator.matrix @ u0
    row = {
        "laplacian_rms": relative(approximation, laplacian),
        "laplacian_max": np.max(np.abs(approximation - laplacian).max(axis=0) / np.abs(laplacian).max(axis=0)),
        "gradient": None,
        "heat": "overflows",
        "poisson": relative(without_mean(poisson(operator, laplacian, areas), areas), without_mean(u0, areas), areas),
        "eigenvalues": eigenvalue_error(operator, spectrum),
        "largest_real_part": largest_real_part(operator),
        "negative_weights": negative_share(operator.matrix),
        "mass_drift": "overflows",
    }
    if operator.gradient is not None:
        slopes = np.stack([operator.gradient(mode.values) for mode in modes], axis=-1)
        exact = np.stack([mode.gradient for mode in modes], axis=-1)
        row["gradient"] = relative(slopes.reshape(-1, len(modes)), exact.reshape(-1, len(modes)))
    u1 = heat(operator, u0)
    if not overflows(operator, u0, u1):
        row["heat"] = relative(u1, np.exp(-rates * TIME) * u0, areas)
        # Rows sum to zero, so u0 + 1 flows to u1 + 1.
        row["mass_drift"] = np.max(np.abs(operator.measure @ (u1 - u0)) / np.abs(operator.measure @ (u0 + 1)))
    return row


def relative(approximation, exact, weights=1.0):
    """The root mean square of the relative errors of the columns."""

    def squared(field):
        return np.sum(np.multiply(weights, (field**2).T), axis=1)

    return np.sqrt(np.mean(squared(approximation - exact) / squared(exact)))


def without_mean(u, areas):
    return u - areas @ u / areas.sum()


def heat(operator, u):
    """The solution of u_t = Delta u at TIME, by the diagonal Pade approximant of order eight (error below 1e-11 here).

    In partial fractions it is 1 + 2 Re(sum of residue / (z - pole)) over the poles above the real axis.
    """
    order = 4
    numerator = np.polynomial.Polynomial(
        [math.comb(order, j) * math.factorial(2 * order - j) / math.factorial(2 * order) for j in range(order + 1)]
    )
    denominator = numerator(np.polynomial.Polynomial([0, -1]))
    poles = [pole for pole in denominator.roots() if pole.imag > 0]
    residues = [numerator(pole) / denominator.deriv()(pole) for pole in poles]
    step = TIME / TIME_STEPS * operator.matrix
    shifted = [scipy.sparse.csc_array(step - pole * scipy.sparse.eye_array(len(u))) for pole in poles]
    solves = [splu(matrix).solve for matrix in shifted]
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(TIME_STEPS):
            parts = [residue * solve(u.astype(complex)) for residue, solve in zip(residues, solves, strict=True)]
            u = u + 2 * sum(parts).real
    return u


def overflows(operator, u0, u1):
    """Whether heat grows tenfold, or a mode of the operator would grow that much from rounding errors.

    Implicit steps damp modes that grow much faster than a step, so these modes are found by their eigenvalues.
    """
    if not np.isfinite(u1).all() or np.linalg.norm(u1) > 10 * np.linalg.norm(u0):
        return True
    start = np.random.default_rng(0).normal(size=len(u0))
    options = dict(which="LR", ncv=40, maxiter=20, tol=1e-3, v0=start, return_eigenvectors=False)
    try:
        rate = eigs(operator.matrix, 1, **options)[0].real
    except ArpackNoConvergence:  # isolated growing modes converge fast; clustered modes near zero do not
        return False
    return rate * TIME > np.log(10 / np.finfo(float).eps)


def poisson(operator, f, areas):
    """The solutions u of Delta u = f up to a constant, with zero mean over the area."""
    border = scipy.sparse.csr_array(np.ones((len(f), 1)))
    system = scipy.sparse.block_array([[operator.matrix, border], [scipy.sparse.csr_array(areas[None]), None]])
    return splu(scipy.sparse.csc_array(system)).solve(np.vstack([f, np.zeros(f.shape[1])]))[:-1]


def eigenvalue_error(operator, spectrum):
    """The worst relative error of the first nonzero eigenvalues, sorted by their real parts."""
    matrix = scipy.sparse.csc_array(-operator.matrix)
    start = np.random.default_rng(0).normal(size=len(operator.measure))
    # Compute twice as many as needed, because Arnoldi's method finds the copies of a multiple eigenvalue late.
    try:
        values = eigs(matrix, 2 * NUM_EIGENVALUES, sigma=SHIFT, v0=start, tol=1e-12, return_eigenvectors=False)
    except ArpackNoConvergence:
        return None
    _, *nonzero = sorted(values, key=lambda value: abs(value - SHIFT))[: NUM_EIGENVALUES + 1]  # the first is zero
    exact = spectrum[:NUM_EIGENVALUES]
    return np.max(np.abs(np.sort(np.real(nonzero)) - exact) / exact)


def largest_real_part(operator):
    """The largest real part of the spectrum, divided by the spectral radius; positive if some field grows."""
    if len(operator.measure) > LARGEST_DENSE:
        return None
    dense = operator.matrix.toarray()
    if operator.is_symmetric:
        root = np.sqrt(operator.measure)
        eigenvalues = scipy.linalg.eigvalsh(root[:, None] * dense / root)
    else:
        eigenvalues = scipy.linalg.eigvals(dense)
    return eigenvalues.real.max() / np.abs(eigenvalues).max()


def negative_share(matrix):
    """The fraction of negative weights among the nonzero weights of neighbours."""
    entries = matrix.tocoo()
    weights = entries.data[entries.row != entries.col]
    scale = np.abs(matrix.diagonal())[entries.row[entries.row != entries.col]]
    return np.mean(weights[np.abs(weights) > ROUNDING * scale] < 0)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--refinements", type=int, default=4, help="number of meshes of each family, from 640 vertices on"
    )
    parser.add_argument("--families", default=",".join(FAMILIES), help=f"among {', '.join(FAMILIES)}")
    parser.add_argument("--plot", help="write a picture of the errors over the mesh size to this file")
    parser.add_argument("--json", help="write the rows to this file")
    arguments = parser.parse_args()
    families = [name.strip() for name in arguments.families.split(",")]
    if unknown := set(families) - set(FAMILIES):
        parser.error(f"There is no family {', '.join(sorted(unknown))}. Choose among {', '.join(FAMILIES)}.")

    rows = [row for family in families for row in family_rows(family, arguments.refinements)]
    print_rows(rows)
    if arguments.refinements > 1:
        print_orders(rows)
    print_ratios(rows)
    if arguments.json:
        with open(arguments.json, "w") as file:
            json.dump(rows, file, indent=1)
    if arguments.plot:
        plot(rows, arguments.plot)


def family_rows(name, refinements):
    family = FAMILIES[name]
    spectrum = family.spectrum()
    for refinement in range(refinements):
        mesh = family.make(refinement)
        modes = family.modes(mesh.vertices)
        for operator_name, make in operators().items():
            start = time.perf_counter()
            row = dict(family=name, operator=operator_name, vertices=len(mesh.vertices), mesh_size=mesh.mesh_size)
            row |= measure(make(mesh), mesh, modes, spectrum)
            seconds = time.perf_counter() - start
            print(f"{name}, {len(mesh.vertices)} vertices, {operator_name}: {seconds:.1f} s", file=sys.stderr)
            yield {key: float(value) if isinstance(value, np.floating) else value for key, value in row.items()}


def print_rows(rows):
    print_table(
        ["mesh", "vertices", "operator", *COLUMNS.values()],
        [[row["family"], row["vertices"], row["operator"], *(cell(row, column) for column in COLUMNS)] for row in rows],
    )


def cell(row, column):
    value = row[column]
    if value is None or isinstance(value, str):
        return value or "-"
    if column == "negative_weights":
        return f"{100 * value:.1f} %"
    return "0" if abs(value) < ROUNDING else f"{value:.1e}"


def print_orders(rows):
    print("\nOrders of accuracy: the slope of log(error) over log(mean edge length), by least squares.\n")
    body = [
        [family, operator, *(order(group, column) for column in ERRORS)]
        for (family, operator), group in by_curve(rows).items()
    ]
    print_table(["mesh", "operator", *(COLUMNS[column] for column in ERRORS)], body)


def by_curve(rows):
    curves = {}
    for row in rows:
        curves.setdefault((row["family"], row["operator"]), []).append(row)
    return curves


def order(group, column):
    if not all(isinstance(row[column], float) for row in group):
        return "-"
    slope = np.polyfit(np.log([row["mesh_size"] for row in group]), np.log([row[column] for row in group]), 1)[0]
    return f"{slope:.1f}"


def print_ratios(rows):
    print(f"\nErrors on the finest mesh, divided by the errors of {REFERENCE}; a ratio below 1 is better.\n")
    finest = {key: group[-1] for key, group in by_curve(rows).items()}
    body = [
        [family, operator, *(ratio(row[column], finest[family, REFERENCE][column]) for column in RATIOS)]
        for (family, operator), row in finest.items()
        if operator != REFERENCE
    ]
    print_table(["mesh", "operator", *(COLUMNS[column] for column in RATIOS)], body)


def ratio(error, reference):
    return f"{error / reference:.3g}" if isinstance(error, float) and isinstance(reference, float) else "-"


def print_table(header, body):
    for line in (header, ["---"] * len(header), *body):
        print(f"| {' | '.join(map(str, line))} |")


def plot(rows, path):
    """Draw one column of panels per mesh family: this package solid, others dashed, second order dotted."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.ticker import NullLocator

    families = list(dict.fromkeys(row["family"] for row in rows))
    names = list(dict.fromkeys(row["operator"] for row in rows))
    shown = {"heat": "heat", "poisson": "Poisson", "laplacian_rms": "Laplacian, pointwise"}
    size = (2.6 * len(families) + 1, 9.5)
    figure, panels = plt.subplots(len(shown), len(families), figsize=size, sharex="col", sharey="row", squeeze=False)
    # The other packages often coincide. Open markers of decreasing size stay visible on top of each other.
    markers = {"libigl": ("s", 9), REFERENCE: ("D", 6), "LaPy": ("x", 4)}
    colors = dict(zip(names, plt.get_cmap("Dark2").colors, strict=True))
    curves = by_curve(rows)
    for across, family in enumerate(families):
        panels[0, across].set_title(family)
        panels[-1, across].set_xlabel("mean edge length")
        sizes = np.array([row["mesh_size"] for row in curves[family, REFERENCE]])
        for panel, column in zip(panels[:, across], shown, strict=True):
            for name in names:
                points = [(row["mesh_size"], row[column]) for row in curves[family, name] if row[column] != "overflows"]
                marker, marker_size = markers.get(name, ("o", 4))
                style = dict(color=colors[name], marker=marker, markersize=marker_size, label=name)
                style |= dict(linestyle="--", markerfacecolor="none") if name in markers else dict(linestyle="-")
                panel.plot(*np.reshape(points, (-1, 2)).T, **style)
            start = curves[family, "Monotone"][0][column]
            panel.plot(sizes, start / 3 * (sizes / sizes[0]) ** 2, color="0.4", linestyle=":", label="second order")
            panel.set_xscale("log")
            panel.set_yscale("log")
            panel.set_xticks(sizes, [f"{size:.2g}" for size in sizes])
            panel.xaxis.set_minor_locator(NullLocator())
            panel.grid(alpha=0.3)
    for label, panel in zip(shown.values(), panels[:, 0], strict=True):
        panel.set_ylabel(f"{label}: relative error")
        panel.set_ylim(top=min(panel.get_ylim()[1], 5.0))
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.tight_layout(rect=(0, 0.05, 1, 1))
    figure.legend(handles, labels, loc="lower center", ncols=min(len(labels), 2 * len(families) + 1), frameon=False)
    figure.savefig(path, dpi=130)


if __name__ == "__main__":
    main()

"""Error against time of all solvers, and of what a user would write otherwise: Markdown tables, and a picture.

python benchmarks/time_to_accuracy.py [--meshes 10000 40000 160000 spot] [--problems heat schnakenberg] [--picture FILE]

All contestants solve the same semi-discrete system, except the finite element codes, which use their own matrices for
the same problem. Errors are relative to a solution of the same system at much smaller tolerances, so they are errors in
time only. Times are those of the second call, without compiling; a factorisation that belongs to a step size is part of
the run. The last two columns are the seconds to a relative error of 1e-3, interpolated between runs, and their ratio to
those of the default, `solve` without a solver (above one is slower). If all runs of a contestant are more accurate, its
fastest run is given with a "<". The extra `bench` installs the other packages; missing ones are omitted.
"""

import argparse
import importlib.util
import os
import time
import warnings
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "2")

import jax

jax.config.update("jax_enable_x64", True)

import diffrax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
import scipy.integrate  # noqa: E402
import scipy.sparse  # noqa: E402
import scipy.sparse.linalg  # noqa: E402

import ltljax as ltl  # noqa: E402

LEVELS = {"10000": 5, "40000": 6, "160000": 7}
SPOT = Path(__file__).parents[2] / "shared" / "meshes" / "spot.obj"
TOLERANCES = (1e-3, 1e-5, 1e-7)
# Seconds. A contestant that takes longer does not run at higher accuracy, and at half of this not on a larger mesh.
PATIENCE = 40.0


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--meshes", nargs="+", default=list(LEVELS), choices=[*LEVELS, "spot"])
    parser.add_argument("--spot", default=SPOT, help="path of the mesh named spot")
    parser.add_argument("--problems", nargs="+", default=("heat", "schnakenberg"), choices=sorted(PROBLEMS))
    parser.add_argument("--picture", help="a PNG to draw error over time into")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    tables = {}
    for name in arguments.problems:
        smaller = {}
        for size in arguments.meshes:
            if size == "spot":
                mesh = ltl.load_mesh(arguments.spot)
                mesh = mesh.scaled(np.sqrt(4 * np.pi / mesh.area))
                tables[f"{name} on Spot", mesh.num_vertices] = table(f"{name} on Spot", PROBLEMS[name](mesh), {})
            else:
                problem = PROBLEMS[name](ltl.shapes.jittered_sphere(LEVELS[size], 0.3, seed=0))
                smaller = tables[name, problem.surface.num_vertices] = table(name, problem, smaller)
    if arguments.picture:
        draw(tables, arguments.picture)


class Problem:
    """A system u' = D L u + f(t, u) on a mesh, from u0 to t1."""

    def __init__(self, mesh, equation, u0, t1, explicit, fixed):
        self.mesh, self.equation, self.u0, self.t1, self.fixed = mesh, equation, u0, t1, fixed
        self.surface = ltl.Surface.from_mesh(mesh)
        self.laplacian = scipy.sparse.csc_matrix(ltl.laplacian_matrix(self.surface))
        self.explicit = explicit


def heat(mesh):
    """u_t = Delta u + x1 from a field with structure on many scales."""
    x = mesh.vertices
    u0 = np.exp(-8 * ((x - x[0]) ** 2).sum(axis=1)) + 0.2 * np.sin(9 * x[:, 1])
    source = x[:, 0]
    equation = ltl.Diffusion(source=jnp.asarray(source))
    return Problem(mesh, equation, u0, 0.5, lambda u: source, (0.05, 0.01, 0.002))


def schnakenberg(mesh):
    """A pattern that grows from noise to a stationary state: gamma 100, a 0.1, b 0.9, diffusivities 1 and 10."""

    def rates(species, p):
        u, v = species
        return p * (0.1 - u + u**2 * v), p * (0.9 - u**2 * v)

    u0 = np.stack([1 + 0.1 * np.sin(7 * mesh.vertices[:, 0] * mesh.vertices[:, 1]), 0.9 + 0 * mesh.vertices[:, 0]], 1)
    explicit = lambda u: np.stack(rates((u[:, 0], u[:, 1]), 100.0), axis=1)  # noqa: E731
    equation = ltl.ReactionDiffusion((1.0, 10.0), rates, params=jnp.array(100.0))
    return Problem(mesh, equation, u0, 0.5, explicit, (2e-3, 5e-4, 1e-4))


PROBLEMS = dict(heat=heat, schnakenberg=schnakenberg)

ADAPTIVE = {
    "the default": None,
    "RKL2": ltl.RKL2(),
    "Tsit5": diffrax.Tsit5(),
    "TRBDF2": ltl.TRBDF2(),
    "Kvaerno5": diffrax.Kvaerno5(),
    "KenCarp4": diffrax.KenCarp4(),
}
FIXED = {"SBDF2": ltl.SBDF2(), "CrankNicolson": ltl.CrankNicolson()}


def table(name, problem, smaller):
    """Print a table and return its runs (error, seconds) by contestant; ``smaller`` holds those of a smaller mesh."""
    size = problem.surface.num_vertices
    print(f"\n### {name}, {size} vertices, to t = {problem.t1}: relative error (seconds)\n")
    exact = np.asarray(ours(problem, diffrax.Kvaerno5(), rtol=1e-9, atol=1e-10)[0])
    contestants = {label: (runs, exact) for label, runs in contestants_of(problem).items()}
    if name == "heat":
        contestants |= finite_elements_of(problem)
    print("| solver | coarse | middle | fine | compile (s) | to 1e-3 (s) | over the default |\n" + "| --- " * 7 + "|")
    default = None
    rows = {}
    for label, (runs, exact) in contestants.items():
        rows[label], cells, compiling = [], [], 0.0
        is_slow = min((seconds for _, seconds in smaller.get(label, [(0, 0.0)])), default=PATIENCE) > PATIENCE / 2
        for run in runs:
            if is_slow or (rows[label] and rows[label][-1][1] > PATIENCE):
                cells.append("-")
                continue
            try:
                u, seconds, first = run()
            except (ltl.SolveError, MemoryError) as failure:
                cells.append(type(failure).__name__)
                continue
            error = float(np.linalg.norm(u - exact) / np.linalg.norm(exact))
            rows[label].append((error, seconds))
            cells.append(f"{error:.1e} ({seconds:.2f})")
            compiling = max(compiling, first - seconds)
        sign, seconds = to_accuracy(rows[label])
        default = seconds if default is None else default
        reached = f"{sign}{seconds:.2f} | {sign}{seconds / default:.1f}" if np.isfinite(seconds) else "- | -"
        print(f"| {label} | " + " | ".join(cells) + f" | {compiling:.1f} | {reached} |", flush=True)
    return rows


def contestants_of(problem):
    """The runs of each contestant on the same matrix, from coarse to fine."""
    contestants = {
        label: [lambda tol=tol, s=solver: ours(problem, s, rtol=tol, atol=0.1 * tol) for tol in TOLERANCES]
        for label, solver in ADAPTIVE.items()
    }
    for label, solver in FIXED.items():
        contestants[label] = [
            lambda dt=dt, s=solver: ours(problem, s, dt=dt, rtol=1e-6, atol=1e-8) for dt in problem.fixed
        ]
    contestants["SciPy BDF"] = [lambda tol=tol: scipy_ivp(problem, "BDF", tol) for tol in TOLERANCES]
    contestants["SciPy Radau"] = [lambda tol=tol: scipy_ivp(problem, "Radau", tol) for tol in TOLERANCES]
    contestants["SuperLU, SBDF2"] = [lambda dt=dt: superlu(problem, dt) for dt in problem.fixed]
    return contestants


def finite_elements_of(problem):
    """The runs of finite element codes, each with a fine solution of its own matrices, whose error in space differs."""
    contestants, finest = {}, problem.fixed[-1] / 4
    if importlib.util.find_spec("igl"):
        runs = [lambda dt=dt: libigl_heat(problem, dt) for dt in problem.fixed]
        contestants["libigl, backward Euler"] = runs, libigl_heat(problem, finest, implicit=0.5)[0]
    if importlib.util.find_spec("ngsolve"):
        runs = [lambda dt=dt: ngsolve_heat(problem, dt) for dt in problem.fixed]
        contestants["NGSolve, Crank-Nicolson"] = runs, ngsolve_heat(problem, finest)[0]
    return contestants


def to_accuracy(runs, goal=1e-3):
    """The seconds to a relative error, after "<" if the coarsest run is already better; infinite if no run is."""
    if not runs or min(error for error, _ in runs) > goal:
        return "", np.inf
    # Interpolate between the fastest run that is accurate enough and a faster one that is not.
    good = min((run for run in runs if run[0] <= goal), key=lambda run: run[1])
    worse = [run for run in runs if run[0] > goal and run[1] < good[1]]
    if not worse:
        return "<", good[1]
    near = min(worse)
    share = np.log(goal / near[0]) / np.log(good[0] / near[0])
    return "", float(np.exp((1 - share) * np.log(near[1]) + share * np.log(good[1])))


def ours(problem, solver, **options):
    """The last state, the seconds of the second call, and the seconds of the first call."""
    start = time.perf_counter()
    run = lambda: ltl.solve(problem.equation, problem.surface, problem.u0, problem.t1, solver=solver, **options)  # noqa: E731
    us = jax.block_until_ready(run().us)
    seconds = first = time.perf_counter() - start
    if first < PATIENCE:
        start = time.perf_counter()
        us = jax.block_until_ready(run().us)
        seconds = time.perf_counter() - start
    return np.asarray(us[-1]), seconds, first


def scipy_ivp(problem, method, tolerance):
    """`solve_ivp` with the sparse Jacobian of diffusion and reaction."""
    shape = problem.u0.shape
    diffusivities = np.atleast_1d(np.asarray(problem.equation.diffusivity))
    diffusion = scipy.sparse.block_diag([d * problem.laplacian for d in diffusivities], format="csc")
    flat = lambda u: u.reshape(len(problem.mesh.vertices), -1).T.ravel()  # noqa: E731
    field = lambda y: y.reshape(-1, len(problem.mesh.vertices)).T.reshape(shape)  # noqa: E731
    rate = lambda t, y: diffusion @ y + flat(problem.explicit(field(y)))  # noqa: E731

    def jacobian(t, y):
        if len(shape) == 1:
            return diffusion
        u, step = field(y), 1e-7
        parts = [[None] * shape[1] for _ in range(shape[1])]
        base = problem.explicit(u)
        for s in range(shape[1]):
            change = (problem.explicit(u + step * np.eye(shape[1])[s]) - base) / step
            for r in range(shape[1]):
                parts[r][s] = scipy.sparse.diags(change[:, r])
        return scipy.sparse.csc_matrix(diffusion + scipy.sparse.bmat(parts))

    start = time.perf_counter()
    solution = scipy.integrate.solve_ivp(
        rate, (0, problem.t1), flat(problem.u0), method=method, jac=jacobian, rtol=tolerance, atol=0.1 * tolerance,
        t_eval=[problem.t1],
    )  # fmt: skip
    seconds = time.perf_counter() - start
    return field(solution.y[:, -1]), seconds, seconds


def superlu(problem, dt):
    """SBDF2 with one factorisation per diffusivity and step size."""
    shape = problem.u0.shape
    start = time.perf_counter()
    diffusivities = np.broadcast_to(np.atleast_1d(np.asarray(problem.equation.diffusivity)), shape[1:] or (1,))
    eye = scipy.sparse.eye(len(problem.mesh.vertices), format="csc")
    first = [scipy.sparse.linalg.splu(eye - dt * d * problem.laplacian) for d in diffusivities]
    later = [scipy.sparse.linalg.splu(1.5 * eye - dt * d * problem.laplacian) for d in diffusivities]
    solve = lambda factors, b: np.stack(  # noqa: E731
        [f.solve(np.ascontiguousarray(column)) for f, column in zip(factors, b.T, strict=True)], axis=1
    )
    u, explicit = problem.u0.reshape(eye.shape[0], -1), lambda u: problem.explicit(u.reshape(shape)).reshape(u.shape)
    previous, previous_rate = u, explicit(u)
    u = solve(first, u + dt * previous_rate)
    for _ in range(round(problem.t1 / dt) - 1):
        rate = explicit(u)
        right_hand_side = 2 * u - previous / 2 + dt * (2 * rate - previous_rate)
        u, previous, previous_rate = solve(later, right_hand_side), u, rate
    seconds = time.perf_counter() - start
    return u.reshape(shape), seconds, seconds


def libigl_heat(problem, dt, implicit=1.0):
    """The cotangent Laplacian with lumped masses, and one symmetric factorisation for all steps."""
    import igl

    vertices, faces = np.asarray(problem.mesh.vertices, np.float64), np.asarray(problem.mesh.faces, np.int64)
    stiffness = scipy.sparse.csc_matrix(igl.cotmatrix(vertices, faces))
    mass = scipy.sparse.csc_matrix(igl.massmatrix(vertices, faces, igl.MASSMATRIX_TYPE_VORONOI))
    u, source = problem.u0, mass @ problem.explicit(problem.u0)
    start = time.perf_counter()
    factors = scipy.sparse.linalg.splu(
        mass - implicit * dt * stiffness, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0,
        options=dict(SymmetricMode=True),
    )  # fmt: skip
    for _ in range(round(problem.t1 / dt)):
        u = u + factors.solve(dt * (stiffness @ u + source))
    seconds = time.perf_counter() - start
    return u, seconds, seconds


def ngsolve_heat(problem, dt):
    """Linear finite elements on the same triangles, Crank-Nicolson with one sparse Cholesky factorisation."""
    import netgen.meshing as nm
    import ngsolve as ng

    mesh = nm.Mesh()
    mesh.dim = 3
    points = [mesh.Add(nm.MeshPoint(nm.Pnt(*map(float, vertex)))) for vertex in problem.mesh.vertices]
    mesh.Add(nm.FaceDescriptor(surfnr=1, domin=1, bc=1))
    for a, b, c in problem.mesh.faces:
        mesh.Add(nm.Element2D(1, [points[a], points[b], points[c]]))
    space = ng.H1(ng.Mesh(mesh), order=1)
    u, v = space.TnT()
    stiffness, mass = ng.BilinearForm(space), ng.BilinearForm(space)
    stiffness += ng.grad(u).Trace() * ng.grad(v).Trace() * ng.ds
    mass += u * v * ng.ds
    source = ng.LinearForm(space)
    source += ng.x * v * ng.ds
    for form in (stiffness, mass, source):
        form.Assemble()
    state = ng.GridFunction(space)
    state.vec.FV().NumPy()[:] = problem.u0
    start = time.perf_counter()
    system = mass.mat.CreateMatrix()
    system.AsVector().data = mass.mat.AsVector() + dt / 2 * stiffness.mat.AsVector()
    inverse = system.Inverse(freedofs=space.FreeDofs(), inverse="sparsecholesky")
    residual = state.vec.CreateVector()
    for _ in range(round(problem.t1 / dt)):
        residual.data = dt * source.vec - dt * stiffness.mat * state.vec
        state.vec.data += inverse * residual
    seconds = time.perf_counter() - start
    return np.array(state.vec.FV().NumPy()), seconds, seconds


def draw(tables, path):
    """Draw error over time, one panel per table."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    columns = 3
    rows = len(tables) // columns + 1
    figure, axes = plt.subplots(rows, columns, figsize=(4.6 * columns, 4 * rows), squeeze=False)
    labels = list(dict.fromkeys(label for contestants in tables.values() for label in contestants))
    colors = dict(zip(labels, plt.get_cmap("tab20").colors[::2] + plt.get_cmap("tab20").colors[1::2], strict=False))
    for axis, ((name, size), contestants) in zip(axes.flat, tables.items(), strict=False):
        for label, points in contestants.items():
            style = "-o" if label in ADAPTIVE or label in FIXED else "--s"
            axis.loglog(
                *zip(*[(seconds, error) for error, seconds in points], strict=True), style, color=colors[label], ms=4
            )
        axis.set(title=f"{name}, {size} vertices", xlabel="seconds", ylabel="relative error")
        axis.grid(alpha=0.3)
    for axis in axes.flat[len(tables) :]:
        axis.axis("off")
    for label in labels:
        style = "-o" if label in ADAPTIVE or label in FIXED else "--s"
        axes.flat[-1].plot([], [], style, color=colors[label], label=label, ms=4)
    axes.flat[-1].legend(loc="center", fontsize=10, frameon=False)
    figure.tight_layout()
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    main()

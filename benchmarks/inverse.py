"""The cost of inverse problems: gradients against forward runs, fits against SciPy, and many starts at once.

python benchmarks/inverse.py [--parts gradient protocol solves starts]

The gradient is of the mean square of a final state with respect to a source field, with Schnakenberg's reaction and the
steps of the default solver. It is computed with the default adjoint and with diffrax's recursive checkpoints, whose
number is the root of twice the largest number of steps. Times are medians from the second call on, with all programs in
turn. Memory is the amount that XLA reserves in addition to arguments and results. SciPy's `least_squares` takes finite
differences of the same compiled model.
"""

import argparse
import functools
import math
import time
import warnings

import jax

jax.config.update("jax_enable_x64", True)

import diffrax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from jax.flatten_util import ravel_pytree  # noqa: E402
from scipy import optimize  # noqa: E402

import ltljax as ltl  # noqa: E402

# Level of the icosphere, number of fixed steps or end of an adaptive run, number of unknowns (None: one per vertex).
RUNS = (
    (5, 250, None), (5, 1000, None), (5, 4000, None), (5, 8000, None),
    (5, 1000, 1), (5, 1000, 100), (4, 1000, None), (6, 1000, None), (4, 0.5, None), (4, 5.0, None), (5, 0.5, None),
)  # fmt: skip
ROUNDS = 5


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", nargs="+", default=tuple(PARTS), choices=sorted(PARTS))
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    for part in arguments.parts:
        PARTS[part]()


def start_of(surface):
    x = np.asarray(surface.vertices)
    push = np.sin(5 * x[:, 0]) * np.cos(4 * x[:, 1]) + np.sin(6 * x[:, 2])
    return jnp.asarray(np.array([1.0, 0.9]) + 0.05 * push[:, None] * np.array([1.0, -1.0]))


def gradient():
    print(
        "### A gradient over a forward run\n\n"
        "| vertices | steps | unknowns | forward (s) | gradient (s) | ratio | MB | compile (s) | "
        "diffrax's checkpoints: ratio | MB | compile (s) |\n" + "| --- " * 11 + "|"
    )
    for level, length, unknowns in RUNS:
        surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(level))
        u0, steps = start_of(surface), length if isinstance(length, int) else None
        size = surface.num_vertices if unknowns is None else unknowns
        # The unknowns are the values of a field that is constant over ranges of vertices.
        owner = np.arange(surface.num_vertices) * size // surface.num_vertices
        end, how = (length, {}) if steps is None else (2e-4 * steps, dict(dt=2e-4))

        def loss(field, surface, u0, adjoint, owner=owner, end=end, how=how):
            a = jnp.take(field, owner)
            equation = ltl.ReactionDiffusion((1.0, 10.0), ltl.kinetics.schnakenberg(a, 0.9, rate=30.0))
            solution = ltl.solve(equation, surface, u0, end, None, ltl.RKL2(), adjoint, **how)
            return jnp.mean(solution.u_end**2), solution.counts["num_steps"]

        field, runs, compiling = jnp.full(size, 0.1), [], []
        checkpoints = diffrax.RecursiveCheckpointAdjoint(checkpoints=math.isqrt(2 * (steps or 1_000_000)) + 1)
        for adjoint, function in (
            (None, loss), (None, jax.value_and_grad(loss, has_aux=True)),
            (checkpoints, jax.value_and_grad(loss, has_aux=True)),
        ):  # fmt: skip
            begin = time.perf_counter()
            runs.append(jax.jit(functools.partial(function, adjoint=adjoint)).lower(field, surface, u0).compile())
            compiling.append(time.perf_counter() - begin)
        seconds, count = [[] for _ in runs], 0
        for _ in range((2 if (steps or 0) > 1000 or level > 5 else ROUNDS) + 1):
            for run, times in zip(runs, seconds, strict=True):
                begin = time.perf_counter()
                out = jax.block_until_ready(run(field, surface, u0))
                times.append(time.perf_counter() - begin)
                count = int(out[1] if run is runs[0] else out[0][1])
        forward, ours, theirs = (float(np.median(times[1:])) for times in seconds)
        memory = [run.memory_analysis().temp_size_in_bytes / 1e6 for run in runs]
        print(
            f"| {surface.num_vertices} | {count}{'' if steps else ', adaptive'} | {size} | {forward:.2f} | "
            f"{ours:.2f} | {ours / forward:.2f} | {memory[1]:.0f} | {compiling[1]:.1f} | {theirs / forward:.2f} | "
            f"{memory[2]:.0f} | {compiling[2]:.1f} |",
            flush=True,
        )


def eight_unknowns():
    """The model, truth, first guess and times of a fit of rates, diffusivities and a rate that varies in space."""
    surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(3))
    x = surface.vertices

    def equation(p):
        kinetics = ltl.kinetics.schnakenberg(p["a"], p["b"] * jnp.exp(x @ p["tilt"]), rate=p["rate"])
        return ltl.ReactionDiffusion((p["du"], p["dv"]), kinetics)

    truth = dict(a=0.1, b=0.9, du=1.0, dv=10.0, rate=30.0, tilt=np.array([0.1, -0.05, 0.02]))
    start = dict(a=0.12, b=0.8, du=1.2, dv=8.5, rate=27.0, tilt=np.zeros(3))
    experiment = ltl.inverse.Experiment(equation, surface, start_of(surface), max_steps=2000)
    return experiment, truth, start, np.array([0.1, 0.25, 0.5])


def solves():
    experiment, truth, start, times = eight_unknowns()
    data = ltl.Observations(experiment(truth, times).us, times=times)
    rows = []
    for label in ("first call", "second call"):
        begin = time.perf_counter()
        fit = ltl.fit(experiment, start, data)
        rows.append(("ltljax, Levenberg-Marquardt", label, fit.num_runs, time.perf_counter() - begin, fit.params))
    flat, rebuild = ravel_pytree(jax.tree.map(jnp.asarray, start))
    # The residuals of a diverged run are infinite in ltljax; SciPy accepts only finite ones.
    residuals = jax.jit(lambda z: jnp.nan_to_num(data.misfit(experiment(rebuild(z), times)), nan=1e8))
    np.asarray(residuals(flat))
    for method in ("trf", "lm"):
        count = 0

        def counted(z):
            nonlocal count
            count += 1
            return np.asarray(residuals(z))

        begin = time.perf_counter()
        scale = np.maximum(np.abs(flat), 0.1)
        theirs = optimize.least_squares(
            counted, np.asarray(flat), x_scale=scale, xtol=1e-8, method=method, max_nfev=1000
        )
        rows.append(
            (f"SciPy, {method}", "compiled before", count, time.perf_counter() - begin, rebuild(jnp.asarray(theirs.x)))
        )
    exact = np.asarray(ravel_pytree(jax.tree.map(jnp.asarray, truth))[0])
    print(
        "\n### Eight unknowns of Schnakenberg's reaction from three snapshots, 642 vertices\n\n"
        "| method | | runs of the model | seconds | largest error |\n| --- | --- | --- | --- | --- |"
    )
    for name, label, count, seconds, params in rows:
        errors = np.abs(np.asarray(ravel_pytree(jax.tree.map(jnp.asarray, params))[0]) - exact)
        print(f"| {name} | {label} | {count} | {seconds:.1f} | {np.max(errors / np.maximum(np.abs(exact), 1)):.1e} |")
    ours, theirs = rows[1], rows[2]
    print(
        f"\nSciPy over ltljax: {theirs[2] / ours[2]:.1f} times the runs, {theirs[3] / ours[3]:.1f} times the seconds."
    )


def starts():
    print(
        "\n### 32 starts: `fit_many` against a loop of `fit`\n\n"
        "| vertices | at once (s) | loop (s) | ratio | first call at once (s) |\n| --- | --- | --- | --- | --- |"
    )
    random = np.random.default_rng(0)
    for level in (2,):
        surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(level))

        def equation(p):
            return ltl.ReactionDiffusion((1.0, p["d"]), ltl.kinetics.schnakenberg(p["a"], p["b"], rate=30.0))

        experiment = ltl.inverse.Experiment(equation, surface, start_of(surface))
        truth, times = dict(a=0.1, b=0.9, d=10.0), np.array([0.1, 0.25])
        data = ltl.Observations(experiment(truth, times).us, times=times)
        many = {key: value * random.uniform(0.7, 1.3, 32) for key, value in truth.items()}
        seconds = []
        for _ in range(2):
            begin = time.perf_counter()
            fits = ltl.inverse.fit_many(experiment, many, data, transforms=ltl.inverse.Positive())
            jax.block_until_ready(fits.losses)
            seconds.append(time.perf_counter() - begin)
        assert np.allclose(np.asarray(fits.params["a"]), 0.1, rtol=1e-3)
        ltl.fit(
            experiment, {key: float(values[0]) for key, values in many.items()}, data, transforms=ltl.inverse.Positive()
        )
        begin = time.perf_counter()
        for k in range(32):
            start = {key: float(values[k]) for key, values in many.items()}
            ltl.fit(experiment, start, data, transforms=ltl.inverse.Positive())
        loop = time.perf_counter() - begin
        print(
            f"| {surface.num_vertices} | {seconds[1]:.1f} | {loop:.1f} | {loop / seconds[1]:.2f} | {seconds[0]:.1f} |",
            flush=True,
        )


def protocol():
    """The protocol of Mosaic (arXiv 2606.27895): the gradient of a long run against differences, and its cost."""
    print(
        "\n### Every solver's gradient with respect to eight unknowns, 2,500 steps, 162 vertices\n\n"
        "| solver | cosine to differences | largest entry | forward (s) | gradient over forward | MB |\n"
        + "| --- " * 6
        + "|"
    )
    surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(2))
    x, u0, count, dt = surface.vertices, start_of(surface), 2500, 2e-4
    truth = dict(a=0.1, b=0.9, du=1.0, dv=10.0, rate=30.0, tilt=np.array([0.1, -0.05, 0.02]))
    flat, rebuild = ravel_pytree(jax.tree.map(jnp.asarray, truth))
    solvers = (
        ltl.RKL2(), ltl.RKL1(), diffrax.Tsit5(), ltl.TRBDF2(), ltl.SBDF2(), ltl.CrankNicolson(), ltl.BackwardEuler(),
        diffrax.KenCarp3(), diffrax.Kvaerno3(),
    )  # fmt: skip
    for solver in solvers:

        def loss(z, solver=solver):
            p = rebuild(z)
            kinetics = ltl.kinetics.schnakenberg(p["a"], p["b"] * jnp.exp(x @ p["tilt"]), rate=p["rate"])
            equation = ltl.ReactionDiffusion((p["du"], p["dv"]), kinetics)
            return jnp.mean(ltl.solve(equation, surface, u0, count * dt, None, solver, dt=dt).u_end ** 2)

        forward, reverse = (jax.jit(f).lower(flat).compile() for f in (loss, jax.grad(loss)))
        # Central differences with steps that balance truncation against rounding errors.
        steps = 1e-5 * np.maximum(np.abs(flat), 0.1)
        pairs = [(forward(flat.at[k].add(h)), forward(flat.at[k].add(-h))) for k, h in enumerate(steps)]
        differences = np.array([float(more - less) / (2 * h) for (more, less), h in zip(pairs, steps, strict=True)])
        seconds = [[], []]
        for _ in range(ROUNDS):
            for run, times in zip((forward, reverse), seconds, strict=True):
                begin = time.perf_counter()
                gradient = jax.block_until_ready(run(flat))
                times.append(time.perf_counter() - begin)
        gradient = np.asarray(gradient)
        cosine = gradient @ differences / (np.linalg.norm(gradient) * np.linalg.norm(differences))
        forward_time, reverse_time = (float(np.median(times)) for times in seconds)
        print(
            f"| {type(solver).__name__} | {cosine:.9f} | {np.abs(gradient).max():.3g} | {forward_time:.3f} | "
            f"{reverse_time / forward_time:.1f} | {reverse.memory_analysis().temp_size_in_bytes / 1e6:.0f} |",
            flush=True,
        )


PARTS = {"gradient": gradient, "protocol": protocol, "solves": solves, "starts": starts}

if __name__ == "__main__":
    main()

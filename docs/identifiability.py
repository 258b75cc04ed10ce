"""The figures of identifiability.md: what data determine about parameters.

python docs/identifiability.py [PART ...]
"""

import sys
import warnings

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

import ltljax as ltl  # noqa: E402

SURFACE = ltl.Surface.from_mesh(ltl.shapes.icosphere(3))
X = np.asarray(SURFACE.vertices)
RNG = np.random.default_rng(0)
WAVES = np.sin(X @ (5 * RNG.normal(size=(3, 40))) + RNG.uniform(0, 2 * np.pi, 40)).sum(axis=1) / np.sqrt(20)
U0 = np.array([1.0, 0.9]) + 0.1 * WAVES[:, None] * np.array([1.0, -1.0])
TRUTH = dict(a=0.1, b=0.9, d=10.0)
GUESS = dict(a=0.12, b=0.8, d=8.5)


def noisy(values, share=0.01, seed=1):
    values = np.asarray(values)
    level = share * float(values.std())
    return values + level * np.random.default_rng(seed).normal(size=values.shape), level


def schnakenberg(u0=U0):
    def equation(p):
        return ltl.ReactionDiffusion((1.0, p["d"]), ltl.kinetics.schnakenberg(p["a"], p["b"], rate=30.0))

    return ltl.inverse.Experiment(equation, SURFACE, u0)


def report(title, fit):
    print(f"### {title}\n\n```\n{fit}\n```\n", flush=True)


def growing_pattern():
    experiment, times = schnakenberg(), np.array([0.1, 0.25, 0.5])
    data = ltl.Observations(*noisy(experiment(TRUTH, times).us), times)
    report("three snapshots of a growing pattern", ltl.fit(experiment, GUESS, data, transforms=ltl.inverse.Positive()))


def one_scale():
    """A stationary pattern: a common factor of the reaction rate and both diffusivities is a unit of time."""

    def model(p, adjoint=None):
        equation = ltl.ReactionDiffusion((p["du"], p["dv"]), ltl.kinetics.schnakenberg(0.1, 0.9, rate=p["rate"]))
        return ltl.solve(equation, SURFACE, U0, 5.0, adjoint=adjoint, throw=False).u_end

    truth = dict(du=1.0, dv=10.0, rate=30.0)
    data = ltl.Observations(*noisy(model(jax.tree.map(jnp.asarray, truth))))
    start = dict(du=1.05, dv=10.3, rate=30.5)
    fit = ltl.fit(model, start, data, transforms=ltl.inverse.Positive(), max_iterations=30)
    report("one picture of a pattern that has become stationary", fit)


def uniform_start():
    """A uniform mixture, in which diffusion has no effect."""
    experiment, times = schnakenberg(np.array([1.5, 0.5]) + 0 * U0), np.array([0.05, 0.1, 0.2])
    values = np.asarray(experiment(TRUTH, times).us)
    level = 0.01 * values.std()
    data = ltl.Observations(values + level * RNG.normal(size=values.shape), level, times)
    report("a uniform mixture", ltl.fit(experiment, GUESS, data, transforms=ltl.inverse.Positive()))


def real_data():
    """The data of the first section with wrong values, an unknown factor, gaps, and a distant first guess."""
    experiment, times = schnakenberg(), np.array([0.1, 0.25, 0.5])
    clean, _ = noisy(experiment(TRUTH, times).us)
    chance = np.random.default_rng(2)
    wrong = np.where(chance.random(clean.shape) < 0.03, clean + 20, clean)
    gaps = np.where(chance.random(clean.shape) < 0.3, np.nan, clean)
    far = {key: 300 * value for key, value in TRUTH.items()}

    def fitted(values, start=GUESS, **options):
        return ltl.fit(
            experiment, start, ltl.Observations(values, times=times, **options), transforms=ltl.inverse.Positive()
        )

    cases = (
        ("three values in a hundred off by 20, least squares", fitted(wrong)),
        ('three values in a hundred off by 20, `loss="huber"`', fitted(wrong, loss="huber")),
        ("times 3.7, factor not given", fitted(3.7 * clean)),
        ("times 3.7, `scale=Positive(1.0)`", fitted(3.7 * clean, scale=ltl.inverse.Positive(1.0))),
        ("a third missing", fitted(gaps)),
        ("a guess 300 times too large", fitted(clean, far)),
    )
    print("| data | status | a | b | d | outliers named |\n" + "| --- " * 6 + "|")
    for title, fit in cases:
        low, high = fit.intervals
        values = [f"{fit.params[key]:.5g} ({low[key]:.5g} to {high[key]:.5g})" for key in TRUTH]
        print(f"| {title} | {fit.status} | {' | '.join(values)} | {len(fit.agreement.outliers)} |")
    for title, fit in cases[:4]:
        report(title, fit)
    figure = cases[1][1].plot()
    figure.savefig("docs/real_data.png", dpi=90)


def too_late():
    """A first guess that leads to another pattern, whose spots no small change of the rates turns into the data's."""
    experiment, times = schnakenberg(), np.array([2.0])
    data = ltl.Observations(*noisy(experiment(TRUTH, times).us), times)
    report("one late picture, from a first guess 30 % off", ltl.fit(
        experiment, dict(a=0.13, b=0.63, d=7.0), data, transforms=ltl.inverse.Positive(), max_iterations=40
    ))  # fmt: skip


def faded():
    """An initial state after its fine modes have decayed: amplitudes of harmonics, from a later state."""
    modes = ltl.eigenmodes(SURFACE, 49)
    vectors, truth = modes.vectors, jnp.asarray(RNG.normal(size=49))

    def model(p, adjoint=None):
        return ltl.solve(ltl.Diffusion(), SURFACE, vectors @ p, 0.1, adjoint=adjoint, throw=False).u_end

    data = ltl.Observations(*noisy(model(truth)))
    fit = ltl.fit(model, np.zeros(49), data)
    print("### an initial state from the state at t = 0.1\n\n| degree | exp(-l(l+1) t) | std of an amplitude |")
    print("| --- | --- | --- |")
    for degree in range(7):
        modes_of_degree = slice(degree**2, (degree + 1) ** 2)
        std = fit.evidence.std[modes_of_degree].mean()
        print(f"| {degree} | {np.exp(-degree * (degree + 1) * 0.1):.3f} | {std:.2g} |")
    print()


class Conduction(ltl.Equation):
    """u_t = div(g grad u)."""

    conductivity: jax.Array

    def rate(self, t, surface, u):
        return ltl.weighted_laplacian(surface, self.conductivity, u)

    def spectral_bound(self, t, surface, u):
        return jnp.max(self.conductivity) * ltl.operators.spectral_bound(surface)


def diffusivity_field():
    """A diffusivity at every vertex from snapshots, with a smoothness weight from the discrepancy principle."""
    surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(2))
    x, mass = np.asarray(surface.vertices), surface.mass
    rng = np.random.default_rng(0)
    waves = np.sin(x @ (5 * rng.normal(size=(3, 40))) + rng.uniform(0, 2 * np.pi, 40)).sum(axis=1) / np.sqrt(20)
    truth = 0.8 * np.exp(-((x - [0, 0, 1]) ** 2).sum(axis=1) / 0.5) - 0.5 * x[:, 0]
    equation = lambda p: Conduction(jnp.exp(p["log"]))  # noqa: E731
    times = np.array([0.02, 0.05, 0.1])
    print(
        "### a diffusivity field, from three snapshots\n\n"
        "| start | weight | misfit over values | relative error of the logarithm |\n| --- | --- | --- | --- |"
    )
    for title, u0 in (("waves everywhere", waves), ("waves on one half", waves * np.clip(2 * x[:, 2], 0, 1))):
        experiment = ltl.inverse.Experiment(equation, surface, u0, dt=0.01, solver=ltl.RKL2())
        data = ltl.Observations(*noisy(experiment(dict(log=jnp.asarray(truth)), times).us), times)

        def fit_with(weight, start, experiment=experiment, data=data):
            return ltl.fit(
                experiment, dict(log=np.zeros(len(x))) if start is None else start, data,
                penalty=lambda p: ltl.inverse.smoothness(surface, p["log"], weight, mass), max_iterations=150,
            )  # fmt: skip

        weight, fit, curve = ltl.inverse.choose_weight(fit_with, [1000.0, 500.0, 250.0, 125.0, 60.0])
        for half, name in ((x[:, 2] > 0, "upper half"), (x[:, 2] < 0, "lower half")):
            error = np.linalg.norm((fit.params["log"] - truth)[half]) / np.linalg.norm(truth[half])
            print(f"| {title}, {name} | {weight:g} | {curve[-1, 1] / data.values.size:.2f} | {error:.2f} |", flush=True)
    print()


PARTS = dict(
    growing_pattern=growing_pattern, one_scale=one_scale, uniform_start=uniform_start, too_late=too_late,
    real_data=real_data, faded=faded, diffusivity_field=diffusivity_field,
)  # fmt: skip

if __name__ == "__main__":
    warnings.simplefilter("ignore")
    for part in sys.argv[1:] or PARTS:
        PARTS[part]()

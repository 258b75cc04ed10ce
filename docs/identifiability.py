"""The figures of identifiability.md: what data tell about parameters, and what they do not.

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

    return ltl.Experiment(equation, SURFACE, u0)


def say(title, found):
    print(f"### {title}\n\n```\n{found}\n```\n", flush=True)


def growing_pattern():
    experiment, times = schnakenberg(), np.array([0.1, 0.25, 0.5])
    data = ltl.Observations(*noisy(experiment(TRUTH, times).us), times)
    say("three snapshots of a growing pattern", ltl.fit(experiment, GUESS, data, transforms=ltl.Positive()))


def one_scale():
    """A stationary pattern: the rate of the reaction and both diffusivities together are a unit of time."""

    def model(p, adjoint=None):
        equation = ltl.ReactionDiffusion((p["du"], p["dv"]), ltl.kinetics.schnakenberg(0.1, 0.9, rate=p["rate"]))
        return ltl.solve(equation, SURFACE, U0, 5.0, adjoint=adjoint, throw=False).u_end

    truth = dict(du=1.0, dv=10.0, rate=30.0)
    data = ltl.Observations(*noisy(model(jax.tree.map(jnp.asarray, truth))))
    found = ltl.fit(model, dict(du=1.05, dv=10.3, rate=30.5), data, transforms=ltl.Positive(), max_steps=30)
    say("one picture of a pattern that has become stationary", found)


def uniform_start():
    """Where nothing varies nothing diffuses."""
    experiment, times = schnakenberg(np.array([1.5, 0.5]) + 0 * U0), np.array([0.05, 0.1, 0.2])
    values = np.asarray(experiment(TRUTH, times).us)
    level = 0.01 * values.std()
    data = ltl.Observations(values + level * RNG.normal(size=values.shape), level, times)
    say("a uniform mixture", ltl.fit(experiment, GUESS, data, transforms=ltl.Positive()))


def too_late():
    """The first guess makes another pattern, and no small change of rates turns its spots into those that were seen."""
    experiment, times = schnakenberg(), np.array([2.0])
    data = ltl.Observations(*noisy(experiment(TRUTH, times).us), times)
    say("one late picture, from a first guess 30 % off", ltl.fit(
        experiment, dict(a=0.13, b=0.63, d=7.0), data, transforms=ltl.Positive(), max_steps=40
    ))  # fmt: skip


def faded():
    """An initial state after its fine parts have decayed: amplitudes of harmonics, from a later state."""
    modes = ltl.eigenmodes(SURFACE, 49)
    vectors, truth = modes.vectors, jnp.asarray(RNG.normal(size=49))

    def model(p, adjoint=None):
        return ltl.solve(ltl.Diffusion(), SURFACE, vectors @ p, 0.1, adjoint=adjoint, throw=False).u_end

    data = ltl.Observations(*noisy(model(truth)))
    found = ltl.fit(model, np.zeros(49), data)
    print(
        "### an initial state from what is left of it at t = 0.1\n\n| degree | exp(-l(l+1) t) | std of an amplitude |"
    )
    print("| --- | --- | --- |")
    for degree in range(7):
        own = slice(degree**2, (degree + 1) ** 2)
        print(f"| {degree} | {np.exp(-degree * (degree + 1) * 0.1):.3f} | {found.evidence.std[own].mean():.2g} |")
    print()


def dead_ends():
    """A diffusivity is not seen where the field is flat."""
    z = jnp.asarray(X[:, 2])
    source = 2 * z
    bands = [np.exp(-(((X[:, 2] - centre) / 0.25) ** 2)) for centre in (-1.0, -0.5, 0.0, 0.5, 1.0)]

    def model(p):
        conductivity = jnp.exp(jnp.stack(bands, axis=1) @ p["log"])

        def rate(u):
            return ltl.weighted_laplacian(SURFACE, u, conductivity)

        u, steps = jnp.zeros_like(z), 4000
        dt = 0.2 / ltl.operators.spectral_bound(SURFACE)
        return jax.lax.scan(lambda u, _: (u + dt * (rate(u) + source), None), u, None, length=steps)[0]

    data = ltl.Observations(*noisy(model(dict(log=jnp.zeros(5)))))
    found = ltl.fit(model, dict(log=np.full(5, 0.1)), data)
    print(
        "### a conductivity in bands, from a stationary temperature that falls from pole to pole\n\n| z | std of log |"
    )
    print("| --- | --- |")
    for centre, std in zip((-1.0, -0.5, 0.0, 0.5, 1.0), found.evidence.std, strict=True):
        print(f"| {centre} | {std:.2g} |")
    print()


PARTS = dict(
    growing_pattern=growing_pattern, one_scale=one_scale, uniform_start=uniform_start, too_late=too_late,
    faded=faded, dead_ends=dead_ends,
)  # fmt: skip

if __name__ == "__main__":
    warnings.simplefilter("ignore")
    for part in sys.argv[1:] or PARTS:
        PARTS[part]()

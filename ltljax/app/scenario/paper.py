"""The paper's two examples: `Options` become a `Scenario` with a mesh, an equation and an initial state."""

import math
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np

from ..._equations import Diffusion, Dirichlet, Equation, Neumann, ReactionDiffusion, Robin, kinetics
from ..._lifting.schemes import Monotone
from ..._mesh import Mesh, load_mesh, shapes
from ..._operators import integrate
from ..._surface import Surface
from .scenario import Options, Scenario, Settings, scaled_to_unit_area

BUILT_IN = ("sphere", "torus", "disk", "box")
SOURCES = ("angle", "angle-zero-mean", "sine")
_MAJOR, _MINOR = 2.0, 1.0


def heat(options: Options) -> Scenario:
    """u_t = Delta u + g from u = 0 (section 3): g = x1, or on the torus a function of the poloidal angle."""
    if options.as_published:
        raise ValueError("--as-published belongs to turing; for heat on the torus see --source angle.")
    if options.scale != 1:
        raise ValueError("--scale is for patterns; heat makes none.")
    if options.boundary and options.mesh in ("sphere", "torus"):
        raise ValueError(f"--boundary needs a mesh with a boundary; the {options.mesh} is closed.")
    if options.mesh == "torus":
        return _heat_on_torus(options)
    if options.source is not None:
        raise ValueError(f"--source {options.source} needs --mesh torus; elsewhere the source is x1.")
    if options.mesh == "sphere":
        mesh = shapes.icosphere(subdivisions=4)
        x1 = mesh.vertices[:, 0]
        return _diffusion(
            options, mesh, x1, 5.0, "x1",
            exact=lambda t: x1 * (1 - math.exp(-2 * t)) / 2,
            exact_is="x1 (1 - exp(-2 t)) / 2, which tends to x1 / 2",
        )  # fmt: skip
    mesh, note = _mesh_of(options)
    x1 = mesh.vertices[:, 0]
    conditions = tuple(parse_condition(text) for text in options.boundary)
    if conditions and mesh.is_closed:
        raise ValueError(f"--boundary needs a mesh with a boundary; {options.mesh} is closed.")
    for text, condition in zip(options.boundary, conditions, strict=True):
        if isinstance(condition.where, int) and condition.where >= len(mesh.boundary_loops):
            count = len(mesh.boundary_loops)
            raise ValueError(
                f"--boundary {text}: expected a loop below {count}, the number of the mesh's boundary loops."
            )
    if conditions:
        return _diffusion(options, mesh, x1, 5.0, "x1", notes=(note,), conditions=conditions)
    return _diffusion(
        options, mesh, x1, 5.0, "x1 - mean(x1)", takes_mean_off=True,
        notes=(note, "The mean of the source is taken off, so that a stationary state exists."),
    )  # fmt: skip


def parse_condition(text: str) -> Neumann | Dirichlet | Robin:
    """A boundary condition from ``neumann=FLUX``, ``dirichlet=VALUE`` or ``robin=A,B,G``, and ``@LOOP`` for one loop.

    Raises:
        ValueError: the text is none of these.
    """
    kinds = {"neumann": (Neumann, 1), "dirichlet": (Dirichlet, 1), "robin": (Robin, 3)}
    name, _, rest = text.partition("=")
    numbers, _, loop = rest.partition("@")
    try:
        make, count = kinds[name]
        values = [float(number) for number in numbers.split(",")]
        where = int(loop) if loop else None
        if len(values) != count or not all(map(math.isfinite, values)) or (where is not None and where < 0):
            raise ValueError
        if make is Robin and values[1] == 0:
            raise ValueError
    except (KeyError, ValueError):
        raise ValueError(
            f"Expected neumann=FLUX, dirichlet=VALUE or robin=A,B,G (a u + b du/dnu = g, b not 0), with @LOOP for one "
            f"boundary loop, such as dirichlet=1@0; found {text!r}."
        ) from None
    return make(*values, where=where)


def _heat_on_torus(options: Options) -> Scenario:
    source = options.source or "angle-zero-mean"
    mesh = shapes.torus(major=_MAJOR, minor=_MINOR, n_major=96, n_minor=48)
    angle = _poloidal_angle(mesh)
    # Where the angle jumps from 2 pi to 0 the source takes the mean of its two sides.
    jumps = np.isclose(np.cos(angle), 1, rtol=0, atol=1e-12)
    published = np.where(jumps, np.pi, angle)
    if source == "angle":
        note = (
            "As published, g = x has mean pi, so no stationary state exists: the mean of u grows like pi t, "
            "and only the profile about the mean settles. See --source angle-zero-mean."
        )
        return _diffusion(options, mesh, published, 10.0, "x, the poloidal angle in [0, 2 pi)", notes=(note,))
    if source == "angle-zero-mean":
        note = "The stationary profile ranges over +-2.1257, at the angles 1.4814 and 4.8018."
        return _diffusion(options, mesh, published - np.pi, 10.0, "x - pi, x the poloidal angle", notes=(note,))
    profile = _sine_profile(angle)
    return _diffusion(
        options, mesh, np.sin(angle), 10.0, "sin x, x the poloidal angle",
        exact=lambda t: profile,
        exact_is="the stationary profile (largest value 1.0330); the run approaches it like exp(-0.977 t)",
    )  # fmt: skip


def turing(options: Options) -> Scenario:
    """The paper's reaction-diffusion system (section 4), by default with parameters that make spots."""
    if options.source is not None:
        raise ValueError("--source belongs to heat; turing has no source.")
    if options.boundary:
        raise ValueError("--boundary belongs to heat; through the boundary of turing nothing flows.")
    note: tuple[str, ...] = ()
    scale = options.scale**2
    if options.mesh == "sphere":
        mesh = shapes.icosphere(subdivisions=5)
    elif options.mesh == "torus":
        mesh = shapes.torus(major=_MAJOR, minor=_MINOR, n_major=144, n_minor=72)
    else:
        mesh, says = _mesh_of(options)
        note = (says,)
    if options.as_published:
        reaction = dict(rate=2.0, feed=16.0, decay=0.0)
        diffusivity, start, noise, t1 = (1.0 * scale, 2.0 * scale), 1.0, 0.0, 20.0
        note += (
            "The published parameters (alpha = 1, beta = s = 2, gamma = 0, start at 1) make no pattern: without gamma "
            "no diffusivities can, so the state stays uniform and tends to (1, 16).",
        )
    else:
        # Turk's decay of 12 gives spots that run together into stripes; at 11 they stay apart.
        reaction = dict(rate=10.0, feed=16.0, decay=11.0)
        diffusivity, start, noise, t1 = (0.8 * scale, 0.1 * scale), 4.0, 0.1, 40.0
        note += ("Where v falls below 0.05 its sink fades to zero, which keeps v from turning negative.",)
    rng = np.random.default_rng(options.seed)
    decay = np.full(mesh.num_vertices, reaction["decay"])
    decay[mesh.source_order] += noise * rng.uniform(-1, 1, mesh.num_vertices)

    def make_equation(surface: Surface) -> Equation:
        dtype = surface.dtype
        return ReactionDiffusion(
            diffusivity,
            kinetics.turk(
                rate=jnp.asarray(reaction["rate"], dtype),
                feed=jnp.asarray(reaction["feed"], dtype),
                decay=jnp.asarray(decay, dtype),
            ),
        )

    return Scenario(
        name="turing",
        mesh=mesh,
        make_equation=make_equation,
        u0=np.full((mesh.num_vertices, 2), start),
        t1=t1 if options.t1 is None else options.t1,
        parameters=dict(diffusivity=diffusivity, **reaction, decay_noise=noise, start=start),
        species=("u1", "u2"),
        shown=1,
        settings=Settings(show="u2"),
        exact=(lambda t: np.broadcast_to([1.0, 16.0], (mesh.num_vertices, 2))) if options.as_published else None,
        exact_is="(1, 16), the state the published parameters tend to" if options.as_published else "",
        notes=note,
    )


SCENARIOS: dict[str, Callable[[Options], Scenario]] = {"heat": heat, "turing": turing}


def _diffusion(
    options, mesh, source, t1, formula, *, exact=None, exact_is="", notes=(), conditions=(), takes_mean_off=False
) -> Scenario:
    def make_equation(surface: Surface) -> Equation:
        g = jnp.asarray(source, surface.dtype)
        if takes_mean_off:
            # In the measure that diffusion conserves, or what is left of the mean would add up.
            measure = surface.mass if isinstance(surface.scheme, Monotone) else surface.vertex_areas
            g = g - integrate(surface, g, measure) / jnp.sum(measure)
        return Diffusion(jnp.asarray(1.0, surface.dtype), g, conditions)

    return Scenario(
        name="heat",
        mesh=mesh,
        make_equation=make_equation,
        u0=np.zeros(mesh.num_vertices),
        t1=t1 if options.t1 is None else options.t1,
        parameters=dict(diffusivity=1.0, source=formula, boundary=options.boundary or None),
        species=("u",),
        exact=exact,
        exact_is=exact_is,
        notes=notes,
    )


def _mesh_of(options: Options) -> tuple[Mesh, str]:
    if options.mesh == "disk":
        return shapes.disk(rings=40), "The disk has radius 1."
    if options.mesh == "box":
        return shapes.box(n=40), "The box has sides of length 1."
    mesh = load_mesh(options.mesh, repair=options.repair).reordered()
    if options.keep_scale:
        return mesh, f"The mesh keeps its scale: area {mesh.area:.6g}."
    return scaled_to_unit_area(mesh)


def _poloidal_angle(mesh: Mesh) -> np.ndarray:
    x, y, z = mesh.vertices.T
    return np.mod(np.arctan2(z, np.hypot(x, y) - _MAJOR), 2 * np.pi)


def _sine_profile(angle: np.ndarray) -> np.ndarray:
    """The stationary solution for g = sin x: (r^2/2) sin x + (a r/2) [x - 2 atan(sqrt((a - r)/(a + r)) tan(x/2))]."""
    x = np.where(angle > np.pi, angle - 2 * np.pi, angle)
    root = math.sqrt((_MAJOR - _MINOR) / (_MAJOR + _MINOR))
    bracket = x - 2 * np.arctan2(root * np.sin(x / 2), np.cos(x / 2))
    return _MINOR**2 / 2 * np.sin(x) + _MAJOR * _MINOR / 2 * bracket

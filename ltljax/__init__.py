"""Differentiable partial differential equations on triangle meshes, in JAX, by local tangential lifting.

A mesh file becomes a `Mesh`; a mesh and a scheme become a `Surface`; operators act on fields over the surface;
equations are made of operators; `solve` integrates them in time.

    mesh = ltl.load_mesh("spot.obj")
    surface = ltl.Surface.from_mesh(mesh)
    solution = ltl.solve(ltl.Diffusion(), surface, u0, t1=1.0)

`__init__.pyi` lists the public names and the module each comes from. A name is imported when it is first used.
"""

import importlib
import sys
from typing import Any

import lazy_loader

from ._base.deprecated import warn_deprecated

_load, _list_names, __all__ = lazy_loader.attach_stub(__name__, __file__)

# Names that were at the top in version 0.1, and the public module each has moved to.
_MOVED = {
    "errors": "CoarseMeshWarning FarFromOriginWarning FitError GrowingModesWarning IncompatibleSourceWarning "
    "InconsistentRowsWarning RestartError",
    "imaging": "displaced",
    "inverse": "Agreement Bounded Evidence Experiment Fit GradientCheck ManyFits PatternStatistics Positive Real "
    "Sampling check_gradient choose_weight explore fit_many observe_at observe_patches pattern_statistics smoothness "
    "total_variation",
    "io": "vertex_data",
    "operators": "Curvature EllipticStencil PolyhedralCurvature direction_tensor elliptic_stencil growth_rate "
    "polyhedral_curvature spectral_bound spectral_width",
    "solvers": "Dispersion Eigenmodes Explanation Factorized Multigrid dispersion factorized multigrid plot_dispersion",
    "vectors": "Connection HarmonicFields HodgeParts connection connection_matrix covariant_derivative curl "
    "direction_field from_frame harmonic_fields helmholtz_hodge hodge_laplacian lie_bracket lie_derivative rotated "
    "rotated_gradient singularities tangential tensor_laplacian to_frame transport_along transport_vectors",
}
_NEW_HOME = {name: module for module, names in _MOVED.items() for name in names.split()}


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("ltljax")
    if name in _NEW_HOME:
        home = f"ltljax.{_NEW_HOME[name]}"
        warn_deprecated(f"ltljax.{name}", f"{home}.{name}")
        return getattr(importlib.import_module(home), name)
    if name in __all__:
        return _load(name)
    raise AttributeError(f"module 'ltljax' has no attribute {name!r}", name=name, obj=sys.modules[__name__])


def __dir__() -> list[str]:
    return sorted(__all__)

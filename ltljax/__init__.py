"""Differentiable partial differential equations on triangle meshes, in JAX, by local tangential lifting.

The data's way: a mesh file becomes a `Mesh`, a mesh and a scheme a `Surface`; operators act on fields over a surface;
equations are made of operators; `solve` carries them through time.

    mesh = ltl.load_mesh("spot.obj")
    surface = ltl.Surface.from_mesh(mesh)
    solution = ltl.solve(ltl.Diffusion(), surface, u0, t1=1.0)
"""

from importlib.metadata import version as _version

from .elliptic import EllipticStencil, direction_tensor, elliptic_stencil
from .equations import (
    CahnHilliard,
    Diffusion,
    Dirichlet,
    Equation,
    Moving,
    Neumann,
    ReactionDiffusion,
    Robin,
    kinetics,
)
from .lifting.schemes import Monotone, Paper, Polynomial
from .mesh import Mesh, MeshError, load_mesh, shapes
from .operators import (
    Curvature,
    curvature,
    divergence,
    gradient,
    growth_rate,
    hessian,
    integrate,
    laplacian,
    laplacian_matrix,
    spectral_bound,
    weighted_laplacian,
)
from .show import plot, plot_dispersion, view
from .solve import (
    RKL1,
    RKL2,
    SBDF2,
    TRBDF2,
    BackwardEuler,
    CrankNicolson,
    Dispersion,
    Eigenmodes,
    Explanation,
    GrowingModesWarning,
    IncompatibleSourceWarning,
    Multigrid,
    RestartError,
    Solution,
    SolveError,
    Steady,
    dispersion,
    eigenmodes,
    explain,
    geodesic_distance,
    multigrid,
    poisson,
    screened_poisson,
    solve,
    steady_state,
)
from .surface import InconsistentRowsWarning, Surface

__version__ = _version("ltljax")

__all__ = [
    "RKL1",
    "RKL2",
    "SBDF2",
    "TRBDF2",
    "BackwardEuler",
    "CahnHilliard",
    "CrankNicolson",
    "Curvature",
    "Diffusion",
    "Dirichlet",
    "Dispersion",
    "Eigenmodes",
    "EllipticStencil",
    "Equation",
    "Explanation",
    "GrowingModesWarning",
    "IncompatibleSourceWarning",
    "InconsistentRowsWarning",
    "Mesh",
    "MeshError",
    "Monotone",
    "Moving",
    "Multigrid",
    "Neumann",
    "Paper",
    "Polynomial",
    "ReactionDiffusion",
    "RestartError",
    "Robin",
    "Solution",
    "SolveError",
    "Steady",
    "Surface",
    "curvature",
    "direction_tensor",
    "dispersion",
    "divergence",
    "eigenmodes",
    "elliptic_stencil",
    "explain",
    "geodesic_distance",
    "gradient",
    "growth_rate",
    "hessian",
    "integrate",
    "kinetics",
    "laplacian",
    "laplacian_matrix",
    "load_mesh",
    "multigrid",
    "plot",
    "plot_dispersion",
    "poisson",
    "screened_poisson",
    "shapes",
    "solve",
    "spectral_bound",
    "steady_state",
    "view",
    "weighted_laplacian",
]

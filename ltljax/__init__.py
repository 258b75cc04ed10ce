"""Differentiable partial differential equations on triangle meshes, in JAX, by local tangential lifting.

The data's way: a mesh file becomes a `Mesh`, a mesh and a scheme a `Surface`; operators act on fields over a surface;
equations are made of operators; `solve` carries them through time.

    mesh = ltl.load_mesh("spot.obj")
    surface = ltl.Surface.from_mesh(mesh)
    solution = ltl.solve(ltl.Diffusion(), surface, u0, t1=1.0)
"""

from importlib.metadata import version as _version

from .elliptic import EllipticStencil, elliptic_stencil
from .equations import Diffusion, Dirichlet, Equation, Neumann, ReactionDiffusion, Robin, kinetics
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
    weighted_laplacian,
)
from .solve import (
    RKL1,
    RKL2,
    SBDF2,
    TRBDF2,
    BackwardEuler,
    CrankNicolson,
    Eigenmodes,
    GrowingModesWarning,
    IncompatibleSourceWarning,
    Multigrid,
    RestartError,
    Solution,
    SolveError,
    Steady,
    eigenmodes,
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
    "CrankNicolson",
    "Curvature",
    "Diffusion",
    "Dirichlet",
    "Eigenmodes",
    "EllipticStencil",
    "Equation",
    "GrowingModesWarning",
    "IncompatibleSourceWarning",
    "InconsistentRowsWarning",
    "Mesh",
    "MeshError",
    "Monotone",
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
    "divergence",
    "eigenmodes",
    "elliptic_stencil",
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
    "poisson",
    "screened_poisson",
    "shapes",
    "solve",
    "steady_state",
    "weighted_laplacian",
]

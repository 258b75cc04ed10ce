# The public names at the top and the module each comes from. Type checkers read this file; so does `__init__.py`, which
# imports a name when it is first used.

from . import (
    app as app,
    errors as errors,
    imaging as imaging,
    inverse as inverse,
    io as io,
    kinetics as kinetics,
    operators as operators,
    shapes as shapes,
    solvers as solvers,
    vectors as vectors,
)
from ._equations import (
    CahnHilliard as CahnHilliard,
    Diffusion as Diffusion,
    Dirichlet as Dirichlet,
    Equation as Equation,
    Moving as Moving,
    Neumann as Neumann,
    ReactionDiffusion as ReactionDiffusion,
    Robin as Robin,
    VectorDiffusion as VectorDiffusion,
)
from ._fit import Observations as Observations, fit as fit
from ._lifting.schemes import Monotone as Monotone, Paper as Paper, Polynomial as Polynomial
from ._mesh import Mesh as Mesh, MeshError as MeshError, as_mesh as as_mesh, load_mesh as load_mesh
from ._operators import (
    curvature as curvature,
    divergence as divergence,
    gradient as gradient,
    hessian as hessian,
    integrate as integrate,
    laplacian as laplacian,
    laplacian_matrix as laplacian_matrix,
    vector_laplacian as vector_laplacian,
    weighted_laplacian as weighted_laplacian,
)
from ._output.load import load_fields as load_fields
from ._output.save import save as save
from ._show import plot as plot, view as view
from ._solve import (
    RKL1 as RKL1,
    RKL2 as RKL2,
    SBDF2 as SBDF2,
    TRBDF2 as TRBDF2,
    Adaptive as Adaptive,
    BackwardEuler as BackwardEuler,
    Checkpoints as Checkpoints,
    CrankNicolson as CrankNicolson,
    Fixed as Fixed,
    Solution as Solution,
    SolveError as SolveError,
    Steady as Steady,
    eigenmodes as eigenmodes,
    explain as explain,
    geodesic_distance as geodesic_distance,
    poisson as poisson,
    screened_poisson as screened_poisson,
    solve as solve,
    steady_state as steady_state,
)
from ._surface.surface import Surface as Surface

__version__: str

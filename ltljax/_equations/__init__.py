"""Equations: small pytrees of parameters that `solve` asks for their rate of change.

What enters: diffusivities, reactions, sources and boundary conditions. What leaves: the rate u_t of a state on a
surface, and bounds of the eigenvalues of its derivative.
"""

from . import kinetics
from .boundary import Dirichlet, Neumann, Robin
from .cahn_hilliard import CahnHilliard
from .diffusion import Diffusion
from .equation import Equation
from .moving import Moving
from .reaction_diffusion import ReactionDiffusion
from .vector_diffusion import VectorDiffusion

__all__ = [
    "CahnHilliard",
    "Diffusion",
    "Dirichlet",
    "Equation",
    "Moving",
    "Neumann",
    "ReactionDiffusion",
    "Robin",
    "VectorDiffusion",
    "kinetics",
]

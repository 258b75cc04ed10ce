"""What is solved: equations as small pytrees of parameters. `solve` asks them for their rate of change."""

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

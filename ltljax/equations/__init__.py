"""What is solved: equations as small pytrees of parameters. `solve` asks them for their rate of change."""

from . import kinetics
from .boundary import Dirichlet, Neumann, Robin
from .diffusion import Diffusion
from .equation import Equation
from .reaction_diffusion import ReactionDiffusion

__all__ = ["Diffusion", "Dirichlet", "Equation", "Neumann", "ReactionDiffusion", "Robin", "kinetics"]

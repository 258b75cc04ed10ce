"""What is solved: equations as small pytrees of parameters. `solve` asks them for their rate of change."""

from . import kinetics
from .diffusion import Diffusion
from .equation import Equation
from .reaction_diffusion import ReactionDiffusion

__all__ = ["Diffusion", "Equation", "ReactionDiffusion", "kinetics"]

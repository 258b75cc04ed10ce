"""Inverse problems: the parameters, fields, initial states or shapes that explain measurements."""

from .agreement import Agreement
from .evidence import Evidence
from .experiment import Experiment
from .fit import fit
from .many import ManyFits, explore, fit_many
from .observations import Observations
from .penalties import choose_weight, smoothness, total_variation
from .result import Fit
from .sampling import Sampling, observe_at, observe_patches
from .search import FitError
from .statistics import PatternStatistics, pattern_statistics
from .taylor import GradientCheck, check_gradient
from .unknowns import Bounded, Positive, Real

__all__ = [
    "Agreement",
    "Bounded",
    "Evidence",
    "Experiment",
    "Fit",
    "FitError",
    "GradientCheck",
    "ManyFits",
    "Observations",
    "PatternStatistics",
    "Positive",
    "Real",
    "Sampling",
    "check_gradient",
    "choose_weight",
    "explore",
    "fit",
    "fit_many",
    "observe_at",
    "observe_patches",
    "pattern_statistics",
    "smoothness",
    "total_variation",
]

"""Inverse problems: what a model's parameters, fields, start or shape must be for it to give what was seen."""

from .agreement import Agreement
from .fit import Fit, fit
from .many import ManyFits, explore, fit_many
from .observations import Experiment, Observations
from .penalties import choose_weight, smoothness, total_variation
from .report import Evidence
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

"""Inverse problems: parameters, initial states and sources from measurements, with uncertainties."""

from ._fit import (
    Agreement,
    Bounded,
    Evidence,
    Experiment,
    Fit,
    FitError,
    GradientCheck,
    ManyFits,
    Observations,
    PatternStatistics,
    Positive,
    Real,
    Sampling,
    check_gradient,
    choose_weight,
    explore,
    fit,
    fit_many,
    observe_at,
    observe_patches,
    pattern_statistics,
    smoothness,
    total_variation,
)

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


def __dir__() -> list[str]:
    return sorted(__all__)

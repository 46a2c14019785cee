"""The columns of an observer's rows that learned thresholds may watch."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.monitoring.thresholds.learned import LearnedThresholds
from obsynth.monitoring.thresholds.learned_levels import SETTLING
from obsynth.monitoring.thresholds.monitor import Evidence, LinearSample
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.changed_options import changed
from obsynth.observers.linear.observer import LinearObserver
from obsynth.observers.nonlinear.region_observer import RegionObserver
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.observers.recursive.steady_filter import settled_contraction
from obsynth.observers.scheduled.observer import ScheduledObserver
from obsynth.observers.window.observer import WindowObserver
from obsynth.results.design import ObserverDesign

#: Rows count as settled if less than this share of the error at the start of a run is left.
START_REMAINDER = 1e-3


def as_learned(observer: Any, learned: LearnedThresholds) -> Any:
    """Return an observer with the sizes of outliers and the initial covariance of the learned thresholds."""
    options = {"outlier_sizes": learned.outlier_sizes, "initial_covariance": learned.initial_covariance}
    stated = {name: value for name, value in options.items() if value is not None}
    return changed(observer, **stated) if stated else observer


def watched_names(design: ObserverDesign) -> tuple[str, ...]:
    """Return the columns of a design that may be watched: fault estimates, then residuals (or innovations)."""
    observer = design.observer
    if isinstance(observer, WindowObserver):
        raise SpecError(
            f"Design {design.name!r} is a test whose weights change with k: the threshold of each row is proved, so "
            "none is learned (use the monitor pointwise).",
            path="design",
        )
    if isinstance(observer, (LinearObserver, RegionObserver, ScheduledObserver)):
        names = observer.row_names
        return (*names[observer.fault_rows], *names[observer.residual_rows])
    return (*(f"fhat[{name}]" for name in observer.fault_names), *(f"r[{name}]" for name in innovation_names(observer)))


def settling_rows(design: ObserverDesign) -> int:
    """Return the number of rows at the start of a run that are not settled; zero for designs with a warm-up.

    For a Kalman filter whose gains tend to a steady state, this is the number of rows in which an initial error decays
    to `START_REMAINDER` of itself.
    """
    observer = design.observer
    if isinstance(observer, (LinearObserver, RegionObserver, ScheduledObserver)):
        return 0
    if not isinstance(observer, RecursiveObserver) or observer.fault_names:
        return SETTLING
    contraction = settled_contraction(observer)
    if contraction is None or contraction >= 1.0:
        return SETTLING
    return min(SETTLING, math.ceil(math.log(START_REMAINDER) / math.log(max(contraction, START_REMAINDER))))


def has_innovations_by_sensor(observer: Any) -> bool:
    """Whether each residual is the innovation of one sensor, whose distribution does not depend on missing others."""
    return not isinstance(
        observer, (LinearObserver, RecursiveObserver, RegionObserver, ScheduledObserver, WindowObserver)
    )


def innovation_names(observer: Any) -> tuple[str, ...]:
    """Return the names of the innovations of a recursive or nonlinear observer, as in the columns of runs."""
    if isinstance(observer, RecursiveObserver):
        # These are innovations of the parity space, and not of single outputs.
        return tuple(f"innovation {i + 1}" for i in range(observer.innovation_count))
    names: tuple[str, ...] = observer.plant.output_names
    return names


def watched_values(residuals: FloatArray, evidence: Any) -> FloatArray | None:
    """Return fault estimates and residuals of a row, in the order of `watched_names`; `None` where there are none."""
    if isinstance(evidence, Evidence):
        return np.concatenate([evidence.theta, residuals])
    return evidence.faults_and_residuals if isinstance(evidence, LinearSample) else None

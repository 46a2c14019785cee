"""Which observer a design has on a log."""

from __future__ import annotations

from obsynth.errors import SpecError
from obsynth.monitoring.logs.linear_observer import SAMPLED_GAP, LinearLogObserver
from obsynth.monitoring.logs.log_observer import LogObserver
from obsynth.monitoring.logs.region_observer import RegionLogObserver
from obsynth.monitoring.logs.scheduled_observer import ScheduledLogObserver
from obsynth.monitoring.logs.step_observer import SteppingLogObserver
from obsynth.monitoring.logs.window_observer import WindowLogObserver
from obsynth.observers.linear.observer import LinearObserver
from obsynth.observers.nonlinear.region_observer import RegionObserver
from obsynth.observers.scheduled.observer import ScheduledObserver
from obsynth.observers.window.observer import WindowObserver
from obsynth.results.design import ObserverDesign


def log_observer(
    design: ObserverDesign, *, gap: float | None = None, warm_up: float | None = None, outliers: str | None = None
) -> LogObserver:
    """Return the observer of a design on a log, at its start; ``outliers`` replace what the design says."""
    if isinstance(design.observer, LinearObserver):
        if outliers not in (None, "none"):
            raise SpecError(
                "outliers is for recursive and nonlinear designs, which know how far a sample may be from "
                "its prediction.",
                path="outliers",
            )
        return LinearLogObserver(design, gap=gap, warm_up=warm_up)
    if gap is not None:
        raise SpecError(SAMPLED_GAP, path="gap")
    if isinstance(design.observer, WindowObserver):
        if outliers not in (None, "none"):
            raise SpecError("outliers is for recursive and nonlinear designs: leave it out.", path="outliers")
        return WindowLogObserver(design, design.observer, warm_up=warm_up)
    if isinstance(design.observer, ScheduledObserver):
        if outliers not in (None, "none"):
            raise SpecError("outliers is for recursive and nonlinear designs: leave it out.", path="outliers")
        return ScheduledLogObserver(design, warm_up=warm_up)
    if isinstance(design.observer, RegionObserver):
        if outliers not in (None, "none"):
            raise SpecError("outliers is for designs that state deviations: leave it out.", path="outliers")
        return RegionLogObserver(design, warm_up=warm_up)
    return SteppingLogObserver(design, warm_up=warm_up, outliers=outliers)

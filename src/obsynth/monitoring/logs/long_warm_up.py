"""Advice where most rows of a log are warm-up: which settling time that is, and a warm-up that was tried."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from obsynth.methods.installed import OWN
from obsynth.methods.registry import method_class
from obsynth.monitoring.logs.linear_observer import LinearLogObserver
from obsynth.monitoring.logs.log_observer import LogObserver
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.outward import upper
from obsynth.observers.linear.modes import SETTLED_TO, settling_from_rest, settling_of_modes
from obsynth.results.design import ObserverDesign
from obsynth.results.number_texts import duration, number

#: From this share of rows in the warm-up on a user is advised.
LONG_SHARE = 0.5

#: Share of a log in which an observer with the decay rate that is advised settles.
SETTLED_WITHIN = 0.25

#: Advice where the start of the observer is in its estimates for longer than a log lasts.
AT_REST = (
    "Where the plant is at rest in the first row, state inputs and outputs of this row as the operating point of the "
    "plant: the observer then starts in that state, and --warm-up may be short."
)

#: Digits of a warm-up that is advised.
DIGITS = 3


def cause_of_warm_up(observer: LogObserver) -> str:
    """Return of what the default warm-up is the settling time, as a part of a sentence; empty for another one."""
    if not isinstance(observer, LinearLogObserver) or observer.warm_up < settling_of_modes(observer.observer):
        return ""
    return f"the time in which the slowest mode of the observer decays to {100.0 * SETTLED_TO:g} %"


def advice_on_warm_up(design: ObserverDesign, observer: LogObserver, logs: Sequence[tuple[float, FloatArray]]) -> str:
    """Return what makes the warm-up shorter, as sentences.

    ``logs``: of each log how many seconds it lasts, and inputs and outputs ``(nu + ny,)`` of its first row.  The
    warm-up that is named has been tried: until then an observer that starts at rest would differ from the one that
    starts at zero by more than noise, and the logs last longer.
    """
    if not isinstance(observer, LinearLogObserver):
        return ""
    longest = max((seconds for seconds, _ in logs), default=0.0)
    return " ".join(text for text in (_tried(observer, logs), _faster(design, longest)) if text)


def _tried(observer: LinearLogObserver, logs: Sequence[tuple[float, FloatArray]]) -> str:
    linear, deviations = observer.observer, np.sqrt(observer.noise)
    starts = [start for _, start in logs if np.isfinite(start).all()]
    seconds = max((settling_from_rest(linear, start, deviations) for start in starts), default=math.inf)
    if not math.isfinite(seconds):
        return ""
    tried = max(upper(seconds, DIGITS), linear.dt)
    lasting = sum(seconds for seconds, _ in logs)
    decided = sum(max(seconds - tried, 0.0) for seconds, _ in logs)
    if not decided > 0.0:
        return AT_REST
    if tried >= observer.warm_up:
        return ""
    option = np.format_float_positional(tried, precision=DIGITS, fractional=False, trim="-")
    return (
        f"Where the plant is at rest in the first row, faults and residuals settle in {duration(tried)}: with "
        f"--warm-up {option}, {number(100.0 * decided / lasting, digits=2)} % of the time are left for decisions."
    )


def _faster(design: ObserverDesign, seconds: float) -> str:
    """Return with which decay rate the errors settle in a part of so many seconds, for methods that take one."""
    if design.method not in OWN or "decay" not in method_class(design.method).placed or not seconds > 0.0:
        return ""
    decay = upper(-math.log(SETTLED_TO) / (SETTLED_WITHIN * seconds), DIGITS)
    return (
        f"An observer that settles in {number(100.0 * SETTLED_WITHIN)} % of the longest log has the option decay: "
        f"{number(decay)} ({design.method}, in 1/s), if there is one."
    )

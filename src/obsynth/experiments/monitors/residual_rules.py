"""Rules for the residual of a linear design, row by row."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.experiments.monitors.between_samples import InputResponse
from obsynth.experiments.monitors.online import share_of_look
from obsynth.experiments.monitors.thresholds import UnlimitedHorizonBound
from obsynth.numerics.arrays import FloatArray

#: Share of an interval by which the data's sampling may differ from the one that a threshold is for.
FITTING_SHARE = 0.01
#: Share of an interval within which two of them are the same: stamps are rounded.
SAME_SHARE = 1e-6
#: What rounding may take from a number of samples, as a share of it.
ROUNDING = 1e-9


class NormRule:
    """The norm of the residual, or of a window of it, against a bound by the number of samples since the start.

    Continuous designs: ``irregular`` holds where samples are not all ``dt`` apart, but none further; ``driven``: what
    known inputs add.  ``watched``: rows of the observer that take the place of the residual.
    """

    def __init__(
        self, table: FloatArray, limit: float, *, window: int, dt: float,
        irregular: UnlimitedHorizonBound | None = None, watched: slice | None = None,
        driven: InputResponse | None = None,
    ) -> None:  # fmt: skip
        self._table, self._limit, self._dt = table, limit, dt
        self._watched, self._driven = watched, driven
        self._states = None if driven is None else driven.start()
        self._inputs: FloatArray | None = None
        self._moved, self._late = False, False
        self._added: deque[float] = deque(maxlen=window)
        self._other, self._regular = irregular, True
        self._norms: deque[float] = deque(maxlen=window)
        self._begin: float | None = None
        self._last: float | None = None

    def take(
        self, time: float, residuals: FloatArray, evidence: Any, *, deciding: bool
    ) -> tuple[float, float, int | None]:
        """Return statistic and threshold; see `obsynth.experiments.monitors.online.Rule`."""
        if self._watched is not None:
            residuals = evidence.rows[self._watched]
        late = 0.0 if self._last is None else (time - self._last - self._dt) / self._dt
        away = abs(late)
        self._late |= self._other is not None and late > FITTING_SHARE
        fits = away <= FITTING_SHARE
        self._regular &= away <= SAME_SHARE
        if self._norms.maxlen != 1 and not fits:
            # A window is a number of samples at the sampling that its bound is for.
            self._norms.clear()
        self._begin, self._last = (time if self._begin is None else self._begin), time
        k = math.floor((time - self._begin) / self._dt * (1.0 + ROUNDING))
        table, limit = (self._table, self._limit) if self._regular or self._other is None else self._other
        threshold = float(table[k]) if k < len(table) else limit
        self._added.append(self._from_inputs(evidence))
        # Neither rows further apart than stated nor inputs that move at other stamps are in the bound.
        if self._late or (self._moved and not self._regular):
            threshold = math.inf
        threshold += math.hypot(*self._added)
        if not deciding:
            return math.nan, threshold, None
        # Not squared: the square of a number of any size may be none.
        self._norms.append(math.hypot(*residuals))
        # The bound counts samples before the window as well: a window that is not full is bounded all the more.
        return math.hypot(*self._norms), threshold, None

    def _from_inputs(self, evidence: Any) -> float:
        """Return what known inputs add to the norm, and take those of this row."""
        if self._driven is None or self._states is None:
            return 0.0
        u = evidence.inputs
        if not np.isfinite(u).all():
            u = np.zeros(len(u)) if self._inputs is None else self._inputs
        if self._inputs is not None:
            self._states = self._driven.advanced(self._states, self._inputs, u)
            self._moved |= bool(u.any() or self._inputs.any())
        self._inputs = u
        return self._driven.size(self._states)

    def restart(self) -> None:
        """Begin again: the error at a new start is taken to be no larger than that at the first."""
        self._norms.clear()
        self._added.clear()
        self._begin = self._last = None
        self._regular, self._late = True, False

    def as_dict(self) -> dict[str, Any]:
        """Return the state that goes from row to row, as data."""
        return {
            "norms": list(self._norms), "begin": self._begin, "last": self._last, "limit": self._limit,
            "regular": self._regular, "added": list(self._added), "states": self._states, "inputs": self._inputs,
            "moved": self._moved, "late": self._late,
        }  # fmt: skip

    def resume(self, data: Mapping[str, Any]) -> None:
        """Go on from what `as_dict` returned."""
        require_same(data["limit"], self._limit)
        self._norms.clear()
        self._norms.extend(data["norms"])
        self._begin, self._last, self._regular = data["begin"], data["last"], data["regular"]
        self._added.clear()
        self._added.extend(data["added"])
        self._states, self._inputs = data["states"], data["inputs"]
        self._moved, self._late = data["moved"], data["late"]


class WhitenedRule:
    """A window of residuals in the metric of its covariance: chi-square, or cumulative sums for a ``change``.

    ``whitener (m, window nr)``, oldest sample first; ``white``: see `whitening.cusum_whitener`.
    """

    def __init__(
        self, whitener: FloatArray, mean: FloatArray, *, window: int, change: float | None, false_alarms: float,
        dt: float, white: bool = True,
    ) -> None:  # fmt: skip
        self._whitener, self._mean, self._change = whitener, mean, change
        self._probability, self._dt, self._white = false_alarms, dt, white
        self._window: deque[FloatArray] = deque(maxlen=window)
        self._levels = np.zeros(2 * len(whitener))
        self._looks = 0
        self._last: float | None = None

    def take(
        self, time: float, residuals: FloatArray, evidence: Any, *, deciding: bool
    ) -> tuple[float, float, int | None]:
        """Return statistic and threshold; see `obsynth.experiments.monitors.online.Rule`."""
        del evidence
        if self._last is not None and abs(time - self._last - self._dt) > FITTING_SHARE * self._dt:
            self.restart()
        self._last = time
        if not deciding:
            return math.nan, math.nan, None
        self._window.append(residuals - self._mean)
        if len(self._window) < (self._window.maxlen or 1):
            return math.nan, math.nan, None
        self._looks += 1
        probability = self._probability * share_of_look(self._looks)
        with np.errstate(over="ignore", invalid="ignore"):
            white = _finite(self._whitener @ np.concatenate(self._window))
            if self._change is None:
                from scipy.special import chdtri

                return float(white @ white), float(chdtri(len(white), probability)), None
            rise = self._change * np.concatenate([white, -white]) - 0.5 * self._change**2
            self._levels = _finite(np.maximum(self._levels + _finite(rise), 0.0))
        # Sums of what is not white are counted one by one: as many end here as there were looks.
        ending = 1 if self._white else self._looks
        return float(self._levels.max()), math.log(len(self._levels) * ending / probability), None

    def restart(self) -> None:
        """Forget window and sums; looks that were taken stay taken."""
        self._window.clear()
        self._levels = np.zeros_like(self._levels)
        self._last = None

    def as_dict(self) -> dict[str, Any]:
        """Return the state that goes from row to row, as data."""
        return {
            "window": list(self._window), "levels": self._levels, "looks": self._looks, "last": self._last,
            "options": [self._probability, float(self._window.maxlen or 0), self._change or 0.0],
        }  # fmt: skip

    def resume(self, data: Mapping[str, Any]) -> None:
        """Go on from what `as_dict` returned."""
        require_same(data["options"], [self._probability, float(self._window.maxlen or 0), self._change or 0.0])
        self._window.clear()
        self._window.extend(data["window"])
        self._levels, self._looks, self._last = data["levels"], data["looks"], data["last"]


def _finite(values: FloatArray) -> FloatArray:
    """Return numbers that have overflowed as the largest there is: one of them must not silence all that follow."""
    largest = np.finfo(np.float64).max
    return np.nan_to_num(values, nan=largest, posinf=largest, neginf=-largest)


def require_same(saved: Any, own: Any) -> None:
    """Raise `SpecError` unless a saved state has the options of the monitor that it is for."""
    if saved != own:
        raise SpecError("The saved state is of a run whose monitor had other options: use the same.", path="state")

"""Rules of monitors, row by row: norms and whitened windows of residuals; parameters and innovations."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.experiments.monitors.between_samples import InputResponse
from obsynth.experiments.monitors.online import Evidence, OnlineMonitor, Rule, share_of_look
from obsynth.experiments.monitors.thresholds import UnlimitedHorizonBound
from obsynth.numerics.arguments import is_finite_number
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.alarms import alone
from obsynth.observers.dae.observer import DAEObserver
from obsynth.observers.decisions import WALKING_FORMS
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.plants.validation import index_of

#: Share of an interval by which the data's sampling may differ from the one that a threshold is for.
FITTING_SHARE = 0.01
#: Share of an interval within which two of them are the same: stamps are rounded.
SAME_SHARE = 1e-6
#: What rounding may take from a number of samples, as a share of it.
ROUNDING = 1e-9


class NormRule(Rule):
    """The norm of the residual, or of a window of it, against a bound by the number of samples since the start.
    Continuous designs: ``irregular`` holds where samples are not all ``dt`` apart, but none further; ``driven``: what
    known inputs add.  ``watched``: rows of the observer that take the place of the residual."""

    GUARANTEES = True
    KEPT = ("norms", "begin", "last", "regular", "added", "states", "inputs", "moved", "late")
    SAME = "limit"

    def __init__(
        self,
        table: FloatArray,
        limit: float,
        *,
        window: int,
        dt: float,
        irregular: UnlimitedHorizonBound | None = None,
        watched: slice | None = None,
        driven: InputResponse | None = None,
    ) -> None:
        self._table, self._limit, self._dt = table, limit, dt
        self._watched, self._driven = watched, driven
        self.states = None if driven is None else driven.start()
        self.inputs: FloatArray | None = None
        self.moved, self.late = False, False
        self.added: deque[float] = deque(maxlen=window)
        self._other, self.regular = irregular, True
        self.norms: deque[float] = deque(maxlen=window)
        self.begin: float | None = None
        self.last: float | None = None

    def take(
        self, time: float, residuals: FloatArray, evidence: Any, *, deciding: bool
    ) -> tuple[float, float, int | None]:
        """Return statistic and threshold."""
        if self._watched is not None:
            residuals = evidence.rows[self._watched]
        late = 0.0 if self.last is None else (time - self.last - self._dt) / self._dt
        away = abs(late)
        self.late |= self._other is not None and late > FITTING_SHARE
        fits = away <= FITTING_SHARE
        self.regular &= away <= SAME_SHARE
        if self.norms.maxlen != 1 and not fits:
            # A window is a number of samples at the sampling that its bound is for.
            self.norms.clear()
        self.begin, self.last = (time if self.begin is None else self.begin), time
        k = math.floor((time - self.begin) / self._dt * (1.0 + ROUNDING))
        table, limit = (self._table, self._limit) if self.regular or self._other is None else self._other
        threshold = float(table[k]) if k < len(table) else limit
        self.added.append(self._from_inputs(evidence))
        # Neither rows further apart than stated nor inputs that move at other stamps are in the bound.
        if self.late or (self.moved and not self.regular):
            threshold = math.inf
        threshold += math.hypot(*self.added)
        if not deciding:
            return math.nan, threshold, None
        # Not squared: the square of a number of any size may be none.
        self.norms.append(math.hypot(*residuals))
        # The bound counts samples before the window as well: a window that is not full is bounded all the more.
        return math.hypot(*self.norms), threshold, None

    def _from_inputs(self, evidence: Any) -> float:
        """Return what known inputs add to the norm, and take those of this row."""
        if self._driven is None or self.states is None:
            return 0.0
        u = evidence.inputs
        if not np.isfinite(u).all():
            u = np.zeros(len(u)) if self.inputs is None else self.inputs
        if self.inputs is not None:
            self.states = self._driven.advanced(self.states, self.inputs, u)
            self.moved |= bool(u.any() or self.inputs.any())
        self.inputs = u
        return self._driven.size(self.states)

    def restart(self) -> None:
        """Begin again: the error at a new start is taken to be no larger than that at the first."""
        self.norms.clear()
        self.added.clear()
        self.begin = self.last = None
        self.regular, self.late = True, False

    def options(self) -> float:
        """Return the limit: it depends on all options."""
        return self._limit


class WhitenedRule(Rule):
    """A window of residuals in the metric of its covariance: chi-square, or cumulative sums for a ``change``.
    ``whitener (m, window nr)``, oldest sample first; ``white``: see `whitening.cusum_whitener`."""

    KEPT = ("window", "levels", "looks", "last")

    def __init__(
        self,
        whitener: FloatArray,
        mean: FloatArray,
        *,
        window: int,
        change: float | None,
        false_alarms: float,
        dt: float,
        white: bool = True,
    ) -> None:
        self._whitener, self._mean, self._change = whitener, mean, change
        self._probability, self._dt, self._white = false_alarms, dt, white
        self.window: deque[FloatArray] = deque(maxlen=window)
        self.levels = np.zeros(2 * len(whitener))
        self.looks = 0
        self.last: float | None = None

    def take(
        self, time: float, residuals: FloatArray, evidence: Any, *, deciding: bool
    ) -> tuple[float, float, int | None]:
        """Return statistic and threshold."""
        del evidence
        if self.last is not None and abs(time - self.last - self._dt) > FITTING_SHARE * self._dt:
            self.restart()
        self.last = time
        if not deciding:
            return math.nan, math.nan, None
        self.window.append(residuals - self._mean)
        if len(self.window) < (self.window.maxlen or 1):
            return math.nan, math.nan, None
        self.looks += 1
        probability = self._probability * share_of_look(self.looks)
        with np.errstate(over="ignore", invalid="ignore"):
            white = _finite(self._whitener @ np.concatenate(self.window))
            if self._change is None:
                from scipy.special import chdtri

                return float(white @ white), float(chdtri(len(white), probability)), None
            rise = self._change * np.concatenate([white, -white]) - 0.5 * self._change**2
            self.levels = _finite(np.maximum(self.levels + _finite(rise), 0.0))
        # Sums of what is not white are counted one by one: as many end here as there were looks.
        ending = 1 if self._white else self.looks
        return float(self.levels.max()), math.log(len(self.levels) * ending / probability), None

    def restart(self) -> None:
        """Forget window and sums; looks that were taken stay taken."""
        self.window.clear()
        self.levels = np.zeros_like(self.levels)
        self.last = None

    def options(self) -> list[float]:
        """Return probability, window and change."""
        return [self._probability, float(self.window.maxlen or 0), self._change or 0.0]


def _finite(values: FloatArray) -> FloatArray:
    """Return numbers that have overflowed as the largest there is: one of them must not silence all that follow."""
    largest = np.finfo(np.float64).max
    return np.nan_to_num(values, nan=largest, posinf=largest, neginf=-largest)


PARAMETER_KINDS = ("chi-square", "cusum", "nis")
#: Samples that the NIS sums up.
NIS_WINDOW = 20
ANY_LENGTH = " (the run may have any length)"
_PARAMETER_STATEMENTS = {
    "chi-square": "distance of the parameters from their nominal values in the metric of their covariance: passed in a "
    "run without a change with at most the stated probability, for Gaussian noise as stated",
    "cusum": "cumulative sum of the whitened innovation for a change of the stated size: passed in a run without a "
    "change with at most the stated probability, for Gaussian noise as stated",
    "nis": "squared innovations of 20 samples: passed in a run that the model explains with at most the stated "
    "probability, for Gaussian noise as stated",
}


class ParameterRule(Rule):
    """Parameters against nominal values, or innovations against what noise explains, in a run of any length.
    ``chi-square`` of theta by its covariance; ``cusum`` of the innovations for a ``change (nq,)``; ``nis``, squares of
    the innovations over 20 samples, for all that the model does not explain."""

    KEPT = ("levels", "looks", "squares")

    def __init__(self, kind: str, nominal: FloatArray, change: FloatArray, false_alarms: float) -> None:
        self._kind, self._nominal, self._change, self._probability = kind, nominal, change, false_alarms
        self._signs = np.concatenate([change, -change])
        self.levels, self.looks = np.zeros(2 * len(nominal)), 0
        self.squares: deque[tuple[float, int]] = deque(maxlen=NIS_WINDOW)

    def take(
        self, time: float, residuals: FloatArray, evidence: Evidence, *, deciding: bool
    ) -> tuple[float, float, int | None]:
        """Return statistic, threshold, and the number of the parameter if it is known."""
        del time, residuals
        if not deciding:
            return math.nan, math.nan, None
        gap = evidence.innovation
        if evidence.regressor.size:
            gap = gap - evidence.regressor @ self._nominal
        if self._kind == "chi-square":
            return self._chi_square(evidence)
        return self._nis(gap) if self._kind == "nis" else self._cusum(evidence)

    def _share(self) -> float:
        self.looks += 1
        return self._probability * share_of_look(self.looks)

    def _chi_square(self, found: Evidence) -> tuple[float, float, int | None]:
        from scipy.special import chdtri

        away = found.theta - self._nominal
        weights = np.linalg.pinv(found.covariance, hermitian=True)
        return (
            float(away @ weights @ away),
            float(chdtri(len(away), self._share())),
            alone(weights @ away, np.diag(weights)),
        )

    def _nis(self, gap: FloatArray) -> tuple[float, float, int | None]:
        from scipy.special import chdtri

        self.squares.append((float(gap @ gap), len(gap)))
        degrees = sum(count for _, count in self.squares)
        if not degrees:
            return math.nan, math.nan, None
        return sum(value for value, _ in self.squares), float(chdtri(degrees, self._share())), None

    def _cusum(self, found: Evidence) -> tuple[float, float, int | None]:
        along, squares = found.score - found.information @ self._nominal, np.diag(found.information)
        rise = np.concatenate([along, along]) * self._signs
        rise -= 0.5 * np.concatenate([squares, squares]) * self._signs**2
        self.levels = np.maximum(self.levels + rise, 0.0)
        which = int(np.argmax(self.levels)) % len(self._nominal)
        return float(self.levels.max()), math.log(len(self.levels) / self._share()), which

    def restart(self) -> None:
        """Forget sums; the filter itself knows what missing rows cost."""
        self.levels = np.zeros_like(self.levels)
        self.squares.clear()

    def options(self) -> list[Any]:
        """Return kind, probability, nominal values and change."""
        return [self._kind, self._probability, self._nominal.tolist(), self._change.tolist()]


def _whole_record(observer: RecursiveObserver | DAEObserver) -> str:
    """Return why a likelihood ratio is not among the monitors, and what to use instead."""
    why = " glr compares every time at which a change may have begun, which takes a whole record"
    if isinstance(observer, DAEObserver):
        return f"{why}, and regressors, which a nonlinear design does not have: chi-square, cusum or nis serve here."
    if observer.form in ("", "random-walk"):
        return f"{why}, and regressors, which this design does not have: chi-square or nis serve here."
    return f"{why}: obsynth.decide(..., statistic='glr') has it for recorded estimates; row by row, use cusum."


def parameter_monitor(
    observer: RecursiveObserver | DAEObserver,
    kind: str,
    nominal: Mapping[str, float],
    change: float,
    false_alarms: float,
) -> OnlineMonitor:
    """Return the monitor of parameters, or of innovations, for data of any length."""
    if kind not in PARAMETER_KINDS:
        hint = _whole_record(observer) if kind == "glr" else ""
        raise SpecError(
            f"kind is {kind!r}: for a recursive or nonlinear design use one of {', '.join(PARAMETER_KINDS)}.{hint}",
            path="kind",
        )
    names = observer.fault_names
    theta = np.array(observer.initial_parameters, dtype=np.float64)
    for name, value in nominal.items():
        place = index_of(name, names, what="nominal")
        if not is_finite_number(value):
            raise SpecError(f"The nominal value of {name!r} is {value!r}: give a finite number.", path="nominal")
        theta[place] = float(value)
    if kind != "nis" and not len(theta):
        raise SpecError(f"{kind} watches parameters, and this design estimates none: use nis.", path="kind")
    if kind == "cusum" and observer.form in WALKING_FORMS:
        raise SpecError(
            f"cusum needs regressors, which a {observer.form} design does not have: use chi-square or nis.", path="kind"
        )
    rule = ParameterRule(kind, theta, np.full(len(theta), float(change)), false_alarms)
    return OnlineMonitor(
        kind,
        _PARAMETER_STATEMENTS[kind] + ANY_LENGTH,
        rule,
        residuals=observer.innovation_count,
        fault_names=names,
        fault_scales=np.ones(len(names)),
    )

"""Monitors of recursive and nonlinear designs, row by row: innovations are white, covariances of parameters honest."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.experiments.monitors.online import Evidence, OnlineMonitor, share_of_look
from obsynth.experiments.monitors.residual_rules import require_same
from obsynth.numerics.arguments import is_finite_number
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.alarms import alone
from obsynth.observers.dae.observer import DAEObserver
from obsynth.observers.decisions import WALKING_FORMS
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.plants.names import index_of

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


class ParameterRule:
    """Parameters against their nominal values, or innovations against what noise explains, in a run of any length.

    ``chi-square`` of theta in the metric of its covariance; ``cusum`` of the innovations for a ``change (nq,)``;
    ``nis``, squares of the innovations over 20 samples, for all that the model does not explain.
    """

    def __init__(self, kind: str, nominal: FloatArray, change: FloatArray, false_alarms: float) -> None:
        self._kind, self._nominal, self._change, self._probability = kind, nominal, change, false_alarms
        self._signs = np.concatenate([change, -change])
        self._levels, self._looks = np.zeros(2 * len(nominal)), 0
        self._squares: deque[tuple[float, int]] = deque(maxlen=NIS_WINDOW)

    def take(
        self, time: float, residuals: FloatArray, evidence: Evidence, *, deciding: bool
    ) -> tuple[float, float, int | None]:
        """Return statistic, threshold and parameter; see `obsynth.experiments.monitors.online.Rule`."""
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
        self._looks += 1
        return self._probability * share_of_look(self._looks)

    def _chi_square(self, found: Evidence) -> tuple[float, float, int | None]:
        from scipy.special import chdtri

        away = found.theta - self._nominal
        weights = np.linalg.pinv(found.covariance, hermitian=True)
        return (
            float(away @ weights @ away), float(chdtri(len(away), self._share())),
            alone(weights @ away, np.diag(weights)),
        )  # fmt: skip

    def _nis(self, gap: FloatArray) -> tuple[float, float, int | None]:
        from scipy.special import chdtri

        self._squares.append((float(gap @ gap), len(gap)))
        degrees = sum(count for _, count in self._squares)
        if not degrees:
            return math.nan, math.nan, None
        return sum(value for value, _ in self._squares), float(chdtri(degrees, self._share())), None

    def _cusum(self, found: Evidence) -> tuple[float, float, int | None]:
        along, squares = found.score - found.information @ self._nominal, np.diag(found.information)
        rise = np.concatenate([along, along]) * self._signs
        rise -= 0.5 * np.concatenate([squares, squares]) * self._signs**2
        self._levels = np.maximum(self._levels + rise, 0.0)
        which = int(np.argmax(self._levels)) % len(self._nominal)
        return float(self._levels.max()), math.log(len(self._levels) / self._share()), which

    def restart(self) -> None:
        """Forget sums; the filter itself knows what missing rows cost."""
        self._levels = np.zeros_like(self._levels)
        self._squares.clear()

    def _options(self) -> list[Any]:
        return [self._kind, self._probability, self._nominal.tolist(), self._change.tolist()]

    def as_dict(self) -> dict[str, Any]:
        """Return the state that goes from row to row, as data."""
        return {
            "levels": self._levels, "looks": self._looks, "squares": [list(item) for item in self._squares],
            "options": self._options(),
        }  # fmt: skip

    def resume(self, data: Mapping[str, Any]) -> None:
        """Go on from what `as_dict` returned."""
        require_same(data["options"], self._options())
        self._levels, self._looks = data["levels"], data["looks"]
        self._squares.clear()
        self._squares.extend((value, int(count)) for value, count in data["squares"])


def _whole_record(observer: RecursiveObserver | DAEObserver) -> str:
    """Return why a likelihood ratio is not among the monitors, and what to use instead."""
    why = " glr compares every time at which a change may have begun, which takes a whole record"
    if isinstance(observer, DAEObserver):
        return f"{why}, and regressors, which a nonlinear design does not have: chi-square, cusum or nis serve here."
    if observer.form in ("", "random-walk"):
        return f"{why}, and regressors, which this design does not have: chi-square or nis serve here."
    return f"{why}: obsynth.decide(..., statistic='glr') has it for recorded estimates; row by row, use cusum."


def parameter_monitor(
    observer: RecursiveObserver | DAEObserver, kind: str, nominal: Mapping[str, float], change: float,
    false_alarms: float,
) -> OnlineMonitor:  # fmt: skip
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
        raise SpecError(f"cusum needs regressors, which a {observer.form} design does not have: use chi-square or nis.",
                        path="kind")  # fmt: skip
    rule = ParameterRule(kind, theta, np.full(len(theta), float(change)), false_alarms)
    return OnlineMonitor(
        kind, _PARAMETER_STATEMENTS[kind] + ANY_LENGTH, rule, residuals=observer.innovation_count, fault_names=names,
        fault_scales=np.ones(len(names)),
    )  # fmt: skip

"""Rules for recursive designs, row by row: their innovations are white, and the covariance of parameters is honest."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np

from obsynth.experiments.monitors.online import Evidence, share_of_look
from obsynth.experiments.monitors.residual_rules import require_same
from obsynth.numerics.arrays import FloatArray

PARAMETER_KINDS = ("chi-square", "cusum", "nis")
#: Samples that the NIS sums up.
NIS_WINDOW = 20


class ParameterRule:
    """Parameters against their nominal values, or innovations against what noise explains.

    Fields: kind: ``chi-square`` of theta less nominal in the metric of its covariance; ``cusum`` of the innovations for
    a change of given size; ``nis``, squares of the innovations over 20 samples, for all that the model does not
    explain; nominal: ``(nq,)``; empty for a filter without parameters; change: ``(nq,)``: what ``cusum`` is tuned for,
    in parameter units; false_alarms: Probability of a false alarm in a run, however long.
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
            _alone(weights @ away, np.diag(weights)),
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


def _alone(scores: FloatArray, information: FloatArray) -> int:
    """Return the parameter whose change alone explains most."""
    return int(np.argmax(scores**2 / np.maximum(information, np.finfo(np.float64).tiny)))

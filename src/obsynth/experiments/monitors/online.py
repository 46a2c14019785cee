"""Monitors for runs of any length: thresholds that hold from the first row to the last, whenever that comes."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics.arrays import FloatArray


class Seen(NamedTuple):
    """What a monitor says of one row: NaN where nothing is decided; no fault stands out without an alarm."""

    statistic: float
    threshold: float
    alarm: bool
    fault: str
    more: tuple[float, ...] = ()


class Evidence(NamedTuple):
    """What a recursive observer learnt from a sample."""

    theta: FloatArray  # ``(nq,)``
    covariance: FloatArray
    innovation: FloatArray  # ``(m,)``; less regressor times true parameters: white, N(0, I)
    regressor: FloatArray
    score: FloatArray  # ``(nq,)``
    information: FloatArray  # ``(nq, nq)``


class LinearSample(NamedTuple):
    """What a linear observer took and gave at one row: its own rows, known inputs, outputs; deviations."""

    rows: FloatArray
    inputs: FloatArray
    outputs: FloatArray
    states: int  # how many of the rows are state estimates

    @property
    def faults_and_residuals(self) -> FloatArray:
        """The rows after those of the states."""
        return self.rows[self.states :]


UNDECIDED = Seen(math.nan, math.nan, False, "")


class Rule(ABC):
    """A statistic and its threshold, row by row; ``KEPT`` names what goes from row to row."""

    KEPT: ClassVar[tuple[str, ...]] = ()
    #: Where a saved state has the options of its monitor.
    SAME: ClassVar[str] = "options"
    #: Whether its threshold is never passed without a fault, which needs an error at the start that is as stated.
    GUARANTEES: ClassVar[bool] = False
    #: Of an adaptive threshold: what it is made of, and cells of a row for its columns.
    plan: Any = None
    cells: tuple[float, ...] = ()

    @abstractmethod
    def take(
        self, time: float, residuals: FloatArray, evidence: Any, *, deciding: bool
    ) -> tuple[float, float, int | None]:
        """Return statistic, threshold, and the number of the fault if the rule knows it."""

    @abstractmethod
    def restart(self) -> None:
        """Forget windows and sums: rows are missing."""

    @abstractmethod
    def options(self) -> Any:
        """Return what a saved state must share with the monitor that it is for."""

    def as_dict(self) -> dict[str, Any]:
        """Return the state that goes from row to row, as data."""
        kept = {name: getattr(self, name) for name in self.KEPT}
        kept = {name: list(value) if isinstance(value, deque) else value for name, value in kept.items()}
        return {**kept, self.SAME: self.options()}

    def resume(self, data: Mapping[str, Any]) -> None:
        """Go on from what `as_dict` returned."""
        if data[self.SAME] != self.options():
            raise SpecError("The saved state is of a run whose monitor had other options: use the same.", path="state")
        for name in self.KEPT:
            own = getattr(self, name)
            setattr(self, name, deque(data[name], own.maxlen) if isinstance(own, deque) else data[name])


class OnlineMonitor:
    """A monitor for data of any length; made by `obsynth.online_monitor`.  Each run begins with a copy.

    Parameters
    ----------
    kind, statement : str
        Which one, and what its threshold means.
    rule : Rule
        Statistic and threshold.
    residuals : int
        Columns of the residual that it watches.
    fault_names : tuple of str
        What an alarm may name.
    fault_scales : FloatArray
        ``(nf,)``: what fault estimates are compared in.
    """

    def __init__(
        self,
        kind: str,
        statement: str,
        rule: Rule,
        *,
        residuals: int,
        fault_names: tuple[str, ...],
        fault_scales: FloatArray,
    ) -> None:
        self.kind, self.statement, self._rule = kind, statement, rule
        self._residuals, self._names, self._scales = residuals, fault_names, fault_scales
        self._decided = False

    @property
    def bound(self) -> Any:
        """Bound of an adaptive threshold, for exports; `None` for other monitors."""
        return None if self._rule.plan is None else self._rule.plan.bound

    @property
    def guarantees(self) -> bool:
        """Whether the threshold is never passed without a fault: nothing is decided while a gap is being forgotten."""
        return self._rule.GUARANTEES

    @property
    def columns(self) -> tuple[str, ...]:
        """Columns of a run besides statistic, threshold and alarm: those of an adaptive threshold."""
        return () if self._rule.plan is None else tuple(self._rule.plan.columns)

    def require_fit(self, residuals: int, fault_names: tuple[str, ...]) -> None:
        """Refuse a design that this monitor was not made for.

        Parameters
        ----------
        residuals : int
            Columns of its residual.
        fault_names : tuple of str
            What it estimates.

        Raises
        ------
        SpecError
            They differ from those that are watched.
        """
        if residuals != self._residuals or fault_names != self._names:
            raise SpecError("The monitor was made for another design.", path="monitor")

    def see(
        self, time: float, *, deciding: bool, skipped: int, residuals: FloatArray, faults: FloatArray, evidence: Any
    ) -> Seen:
        """Take one row of estimates.

        Parameters
        ----------
        time : float, seconds
            Of the row.
        deciding : bool
            Whether a decision may be taken: not in gaps, and not while a start is being forgotten.
        skipped : int
            Rows that were missing before this one.
        residuals, faults : FloatArray
            ``(nr,)`` and ``(nf,)``, deviations.
        evidence : object
            What a recursive observer learnt.
        """
        if skipped or (self._decided and not deciding):
            self._rule.restart()
        self._decided = deciding
        statistic, threshold, which = self._rule.take(time, residuals, evidence, deciding=deciding)
        more = self._rule.cells
        # A statistic that has overflowed has passed any threshold.
        if math.isnan(statistic) or not math.isfinite(threshold):
            return UNDECIDED._replace(more=more)
        if statistic <= threshold:
            return Seen(statistic, threshold, False, "", more)
        if which is None and self._names and np.isfinite(faults).all():
            which = int(np.argmax(np.abs(faults) / self._scales))
        return Seen(statistic, threshold, True, "" if which is None else self._names[which], more)

    def as_dict(self) -> dict[str, Any]:
        """Return the state that goes from row to row, as data."""
        return {"kind": self.kind, "decided": self._decided, "rule": self._rule.as_dict()}

    def resume(self, data: Mapping[str, Any]) -> None:
        """Go on from what `as_dict` returned.

        Parameters
        ----------
        data : mapping
            From a run with the same gain set and options.

        Raises
        ------
        SpecError
            The state is of another kind of monitor, or one with other options.
        """
        if data["kind"] != self.kind:
            raise SpecError(
                f"The saved state is of a run with the monitor {data['kind']!r}: use the same options.", path="state"
            )
        self._decided = data["decided"]
        self._rule.resume(data["rule"])


def share_of_look(look: int) -> float:
    """Return the share of the probability of a false alarm for look ``look`` (from 1); all sum up to one.
    Looks ``2^j`` to ``2^(j+1) - 1`` share ``6 / (pi (j + 1))^2`` evenly."""
    epoch = look.bit_length() - 1
    return 6.0 / (math.pi * (epoch + 1.0)) ** 2 / 2.0**epoch

"""An observer that keeps what it needs to be followed backwards, and whole records of arrays through it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from obsynth.errors import SpecError
from obsynth.numerics.arguments import is_whole
from obsynth.numerics.arrays import FloatArray, read_only
from obsynth.observers.dae.estimates import GatheredRows
from obsynth.observers.dae.observer import DAEObserver
from obsynth.observers.estimates import Estimates
from obsynth.observers.records import measured_record, whole_record
from obsynth.observers.recursive.estimates import recursive_estimates
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.observers.smoothing.chain import Links, Node, Smoothed, deviations_in, smoothed_from
from obsynth.observers.smoothing.links import links_of
from obsynth.plants.dae.checks import checked_inputs

SmoothedObserver = RecursiveObserver | DAEObserver


class Chain:
    """The samples of one run from its start, or from where it went on; the first that is kept is at k ``begin``."""

    def __init__(self) -> None:
        self.nodes: list[Node] = []
        self.rows: list[Any] = []
        self.begin = 0

    @property
    def last(self) -> int:
        """The k of the last sample."""
        return self.begin + len(self.nodes) - 1

    def smoothed(self, links: Links, first: int, last: int) -> list[Smoothed]:
        """Return the samples from k ``first`` to k ``last`` as those up to ``last`` say."""
        return smoothed_from(links, self.nodes, first - self.begin, last - self.begin)

    def row(self, k: int) -> Any:
        """Return what the observer said at a sample."""
        return self.rows[k - self.begin]

    def drop_before(self, k: int) -> None:
        """Forget the samples before one, which are not asked for any more."""
        count = min(max(k - self.begin, 0), len(self.nodes) - 1)
        del self.nodes[:count], self.rows[:count]
        self.begin += count

    def add(self, links: Links, before: Any, after: Any, row: Any, u: FloatArray) -> None:
        """Add the sample that leads from one state to another, in place of what was there of it and after it."""
        at = before.k - self.begin
        if not 0 <= at <= len(self.nodes) or (at == 0 and not self.nodes):
            self.nodes, self.rows, self.begin, at = [], [], before.k, 0
        del self.nodes[at:], self.rows[at:]
        if before.k == 0:
            node = links.first(after, row, u)
        else:
            node = links.next(self.nodes[-1] if at else links.begun(before), before, after, row, u)
        self.nodes.append(node)
        self.rows.append(row)


class KeepingObserver:
    """An observer that adds each sample it takes to a chain; a new start begins a new one."""

    def __init__(self, observer: SmoothedObserver) -> None:
        self.observer = observer
        self.links = links_of(observer)
        self.chain = Chain()

    def __getattr__(self, name: str) -> Any:
        return getattr(self.observer, name)

    def init(self) -> Any:
        """Return the state before the first sample."""
        self.chain = Chain()
        return self.observer.init()

    def accept(self, state: Any, y: FloatArray, u: FloatArray) -> tuple[Any, Any]:
        """Take a sample as the observer does, and keep it."""
        after, row = self.observer.timing.advance(self._kept, state, y, u)
        return after, self.observer.shown(row)

    def _kept(self, state: Any, y: FloatArray, u: FloatArray) -> tuple[Any, Any]:
        after, row = self.observer.in_order(state, y, u)
        self.chain.add(self.links, state, after, row, u)
        return after, row


def smoothed_estimates(observer: SmoothedObserver, rows: list[Any], found: list[Smoothed]) -> Estimates:
    """Return the estimates of smoothed samples; innovations and what belongs to them are those of the observer."""
    if isinstance(observer, RecursiveObserver):
        known = recursive_estimates(observer, rows)
    else:
        gathered = GatheredRows(observer)
        for row in rows:
            gathered.add(row)
        known = gathered.estimates()
    nx = len(observer.state_names)
    parameters = [parameters_of(sample, nx) for sample in found]
    deviations = [deviations_in(sample.factor, sample.diffuse)[:nx] for sample in found]
    spreads = np.array([spread @ spread.T for _, spread in parameters]).reshape(known.fault_covariances.shape)
    return replace(
        known,
        states=read_only(np.array([sample.x[:nx] for sample in found]).reshape(known.states.shape)),
        state_deviations=read_only(np.array(deviations).reshape(known.states.shape)),
        faults=read_only(np.array([theta for theta, _ in parameters]).reshape(known.faults.shape)),
        fault_covariances=read_only(spreads),
    )


def parameters_of(sample: Smoothed, nx: int) -> tuple[FloatArray, FloatArray]:
    """Return the parameters of a sample and a square root of their covariance."""
    if len(sample.x) > nx:
        return sample.x[nx:], sample.factor[nx:]
    return sample.theta, sample.spread


def checked_lag(lag: Any) -> int | None:
    """Return the lag of a smoother in samples, or ``None`` for the whole record."""
    if lag is None:
        return None
    if not is_whole(lag) or lag < 1:
        raise SpecError(f"lag is {lag!r}: give how many samples are waited for, 1 or more, or None for the whole "
                        "record.", path="lag")  # fmt: skip
    return int(lag)


def smoothed_record(observer: SmoothedObserver, y: ArrayLike, u: ArrayLike | None, lag: int | None) -> Estimates:
    """Return smoothed estimates of a whole record of arrays (``y (samples, ny)``, ``u (samples, nu)``)."""
    if isinstance(observer, RecursiveObserver):
        outputs, inputs = whole_record(y, u, observer.plant.ny, observer.plant.nu)
    else:
        outputs = measured_record(y, observer.model.ny)
        inputs = checked_inputs(observer.model, u, len(outputs))
    if not len(outputs):
        return observer.run(outputs, inputs)
    kept = KeepingObserver(observer)
    state, found = kept.init(), []
    for k in range(len(outputs)):
        state, _ = kept.accept(state, outputs[k], inputs[k])
        if lag is not None and k >= lag:
            # Values that come later than that change the samples behind them.
            found.append(kept.chain.smoothed(kept.links, k - lag, k)[0])
    found += kept.chain.smoothed(kept.links, len(found), len(outputs) - 1)
    return smoothed_estimates(observer, kept.chain.rows, found)

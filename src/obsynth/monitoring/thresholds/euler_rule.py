"""The rule of guaranteed thresholds of scheduled designs in continuous time: bounds of errors that follow the rows."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from obsynth.errors import PreconditionError
from obsynth.monitoring.thresholds.euler_bounds import EulerErrorBound, RowChange
from obsynth.monitoring.thresholds.monitor import Rule, RuleOutput, Sample
from obsynth.monitoring.thresholds.rules import norm_of
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.scheduled.observer import FORGOTTEN_SHARE, ScheduledObserver
from obsynth.plants.scheduling import Scheduling
from obsynth.proofs.intervals import range_over
from obsynth.verification.over_tolerances.responses import OUTWARD


@dataclass(frozen=True, eq=False)
class ResidualBound:
    """``|r| <= gain |e| + direct``, beside the bound of e in the same norm; ``start``: of e at a stated start."""

    errors: EulerErrorBound
    gain: float
    start: float | None


class EulerState(NamedTuple):
    """The state of `EulerRule`."""

    sizes: FloatArray  # bounds of the error in each norm, but for what is left of the start
    shares: FloatArray  # what is left of an error at the start, where nothing is stated of it
    last: float | None = None
    inputs: FloatArray | None = None  # known inputs, then parameters, of the row before


class EulerRule(Rule):
    """The norm of the residual against the least of bounds by several Lyapunov matrices; each holds at any stamps.

    ``direct``: what disturbances and noise add to the residual at once."""

    GUARANTEES = True
    adapts = True

    def __init__(self, observer: ScheduledObserver, bounds: list[ResidualBound], direct: float) -> None:
        self._observer, self.bounds, self.direct = observer, bounds, direct

    def init(self) -> EulerState:
        """Return the state before the first sample."""
        starts = [bound.start for bound in self.bounds]
        sizes = np.array([0.0 if start is None else start for start in starts])
        return EulerState(sizes, np.array([1.0 if start is None else 0.0 for start in starts]))

    def restart(self, state: EulerState, skipped: int = 0) -> EulerState:
        """Begin again with an error of which nothing is known."""
        return EulerState(np.zeros(len(self.bounds)), np.ones(len(self.bounds)))

    def step(self, state: EulerState, sample: Sample) -> tuple[EulerState, RuleOutput]:
        """Return the state after a sample, the norm of the residual and its threshold; infinite before it settles."""
        observation: Any = sample.observation
        if observation is None or not np.isfinite(observation.rows).all():
            return self.restart(state), RuleOutput(math.nan, math.inf)
        observer, signals = self._observer, np.asarray(observation.inputs, dtype=np.float64)
        sizes, shares = state.sizes, state.shares
        if state.last is not None and state.inputs is not None and sample.time > state.last:
            row = self._change(observation, state.inputs, signals, sample.time - state.last)
            made = [bound.errors.after(float(size), row) for bound, size in zip(self.bounds, sizes, strict=True)]
            sizes, shares = np.array([size for size, _ in made]), shares * np.array([left for _, left in made])
        settled = shares <= FORGOTTEN_SHARE
        limits = [bound.gain * size for bound, size, known in zip(self.bounds, sizes, settled, strict=True) if known]
        threshold = (min(limits, default=math.inf) + self.direct) * OUTWARD
        # A bound that was lost begins again.
        lost = ~np.isfinite(sizes)
        sizes, shares = np.where(lost, 0.0, sizes), np.where(lost, 1.0, shares)
        after = EulerState(sizes, shares, sample.time, signals)
        if not sample.deciding:
            return after, RuleOutput(math.nan, threshold)
        return after, RuleOutput(float(norm_of(observation.rows[observer.residual_rows])), threshold)

    def options(self) -> list[float]:
        """Return what the bounds are made of."""
        return [self.direct, *(number for b in self.bounds for number in (b.gain, b.errors.decay, b.errors.driven))]

    def _change(self, observation: Any, before: FloatArray, signals: FloatArray, seconds: float) -> RowChange:
        observer, nu = self._observer, self._observer.inputs
        scheduling = observer.scheduling
        weights, turned = weights_between(scheduling, before[nu:], signals[nu:])
        motion = self.bounds[0].errors.motion
        states = motion.estimated @ observation.rows[observer.state_rows]
        return RowChange(seconds, states, signals[:nu], np.abs(signals[:nu] - before[:nu]), weights, turned)


def weights_between(scheduling: Scheduling, before: FloatArray, now: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the weights ``(N,)`` at a row, and by how much they may differ from these while the parameters go there
    from those of the row before, each between its two values.

    Parameters
    ----------
    scheduling : Scheduling
        The parameters.
    before, now : FloatArray
        ``(p,)``: in their ranges.
    """
    weights = scheduling.weights(now)
    if np.array_equal(before, now):
        return weights, np.zeros(len(weights))
    if scheduling.gives_weights:
        return weights, np.abs(scheduling.weights(before) - weights)
    box = {
        name: (min(a, b), max(a, b)) for name, a, b in zip(scheduling.names, before.tolist(), now.tolist(), strict=True)
    }
    least, most = np.ones(1), np.ones(1)
    for expression, (low, high) in zip(scheduling.expressions, scheduling.bounds.tolist(), strict=True):
        ends = box[expression.text] if expression.text in box else _range(expression, box, (low, high))
        one, other = (min(max((end - low) / (high - low), 0.0), 1.0) for end in ends)
        least = np.outer(least, (1.0 - other, one)).ravel()
        most = np.outer(most, (1.0 - one, other)).ravel()
    return weights, np.maximum(np.maximum(most - weights, weights - least), 0.0) * OUTWARD


def _range(expression: Any, box: dict[str, tuple[float, float]], whole: tuple[float, float]) -> tuple[float, float]:
    """Return the range of a function while parameters stay in a box; all of it where none is enclosed."""
    try:
        known = range_over(expression, {name: box[name] for name in expression.names})
    except PreconditionError:
        return whole
    return known.low, known.high

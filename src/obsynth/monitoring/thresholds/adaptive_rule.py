"""The adaptive threshold as a rule of a monitor: row by row, and over many runs at once."""

from __future__ import annotations

import math
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from obsynth.monitoring.thresholds.adaptive_screening import Screening
from obsynth.monitoring.thresholds.monitor import LinearSample, Rule, RuleOutput, Sample
from obsynth.monitoring.thresholds.rules import FITTING_SHARE, NormRule, NormState, norm_of
from obsynth.numerics.arrays import FloatArray
from obsynth.simulation.benches import Runs
from obsynth.verification.over_tolerances.adaptive_recursion import (
    THRESHOLD_ROUNDING,
    AdaptivePlan,
    AdaptiveState,
    Thresholds,
    adaptive_step,
)

#: Rings after which an error that nothing is known of has decayed to a millionth.
FORGETTING_RINGS = 3


class AdaptiveRuleState(NamedTuple):
    """The state of `AdaptiveRule`."""

    nominal: NormState | None  # of the bound without the box, where there is one
    without: AdaptiveState  # without a fault, and for fault estimates during one where that is another
    during: AdaptiveState | None
    first: bool = True  # whether this is the first start, of which more may be known than of later ones
    last: float | None = None
    waiting: int = 0


class AdaptiveRule(Rule):
    """The norm of the residual against the nominal bound and what the box adds; rows and fault estimates beside it."""

    GUARANTEES = True
    adapts = True

    def __init__(self, plan: AdaptivePlan, later: AdaptivePlan, nominal: NormRule | None) -> None:
        self.plan, self.later, self.nominal = plan, later, nominal  # from the first start on, and after later ones
        self.table, self.columns = None if nominal is None else nominal.table, plan.columns

    def init(self) -> AdaptiveRuleState:
        """Return the state before the first sample."""
        return self._begun(None if self.nominal is None else self.nominal.init(), self.plan)

    def _begun(self, nominal: NormState | None, plan: AdaptivePlan) -> AdaptiveRuleState:
        during = None if plan.faults is None else AdaptiveState.of(plan.faults)
        return AdaptiveRuleState(nominal, AdaptiveState.of(plan.bound), during, plan is self.plan)

    def restart(self, state: AdaptiveRuleState, skipped: int = 0) -> AdaptiveRuleState:
        """Begin again: what is known of the error at the first start holds for no other one, but its norm."""
        nominal = state.nominal
        if self.nominal is not None and nominal is not None:
            nominal = self.nominal.restart(nominal)
        return self._begun(nominal, self.later)._replace(first=False, last=state.last, waiting=state.waiting)

    def step(self, state: AdaptiveRuleState, sample: Sample) -> tuple[AdaptiveRuleState, RuleOutput]:
        """Return the state, statistic and threshold: those of the residual's norm, or of the row passed most."""
        observation, dt = sample.observation, self.plan.sample_time
        if not isinstance(observation, LinearSample):
            return self.restart(state), RuleOutput(math.nan, math.nan, None, (math.nan,) * len(self.columns))
        last, state = state.last, state._replace(last=sample.time)
        if dt is not None and last is not None and abs(sample.time - last - dt) > FITTING_SHARE * dt:
            # What the observer did over another interval is an error of its own, which must decay first.
            state = self.restart(state)._replace(waiting=FORGETTING_RINGS * self.later.bound.length)
        plan = self.plan if state.first else self.later
        signals, bound = (observation.inputs, observation.outputs), plan.bound
        without, thresholds = adaptive_step(bound, state.without, bound.structure.reading @ observation.rows, *signals)
        during, error = state.during, thresholds
        if plan.faults is not None and during is not None:
            during, error = adaptive_step(
                plan.faults, during, plan.faults.structure.reading @ observation.rows, *signals
            )
        state = state._replace(without=without, during=during, waiting=max(state.waiting - 1, 0))
        values, at = observation.rows[len(observation.rows) - len(thresholds.total) :], plan.residuals
        if dt is None and self.nominal is not None and state.nominal is not None:
            nominal, (statistic, threshold, *_) = self.nominal.step(state.nominal, sample)
            state = state._replace(nominal=nominal)
            # What box, start and rounding add to the norm of the residual.
            parts = [thresholds.shift[at], thresholds.rest[at], plan.bound.of_tolerances[at], *thresholds.first[:, at]]
            if plan.start_beyond_nominal:
                parts.append(thresholds.start[at])
            threshold = (threshold + math.fsum(math.hypot(*part) for part in parts)) * THRESHOLD_ROUNDING
        else:
            statistic, threshold = math.hypot(*values[at]), math.hypot(*thresholds.total[at])
        nf = len(plan.fault_names)
        cells = self._cells(values[:nf], thresholds, error)
        if state.waiting or not sample.deciding:
            return state, RuleOutput(math.nan, math.nan if state.waiting else threshold, None, cells)
        ratios = np.abs(values) / thresholds.total
        worst = int(np.argmax(ratios)) if len(ratios) else 0
        if statistic <= threshold and len(ratios) and ratios[worst] > 1.0:
            # The row is passed although the norm is not: it decides, in the scale of the norm's threshold.
            value = threshold * float(ratios[worst])
            return state, RuleOutput(value, threshold, worst if worst < nf else None, cells)
        passed = int(np.argmax(ratios[:nf])) if nf and ratios[:nf].max() > 1.0 else None
        return state, RuleOutput(statistic, threshold, passed, cells)

    def _cells(self, faults: FloatArray, thresholds: Thresholds, error: Thresholds) -> tuple[float, ...]:
        nf = len(faults)
        cells = thresholds.total.tolist()
        if self.plan.intervals:
            width = error.total[:nf] - np.abs(error.shift[:nf])
            middle = faults - error.shift[:nf]
            cells += np.stack([middle - width, middle + width], axis=1).ravel().tolist()
        watched = slice(0, nf) if nf else self.plan.residuals
        count = len(self.plan.names)
        first = error.first.reshape(-1, count, len(error.total)).sum(axis=0) if count else error.first
        shares = (first[:, watched] / error.total[watched]).mean(axis=1) if count else np.zeros(0)
        return (*cells, *shares.tolist())

    def options(self) -> list[Any]:
        """Return names of constants, how they vary, the size of the nominal bound, and the limit without the box."""
        bound, limit = self.plan.bound, None if self.nominal is None else self.nominal.options()
        return [list(self.plan.names), bound.varying, float(bound.nominal.sum()), limit]

    def statistics(self, residuals: FloatArray) -> FloatArray:
        """Return the norm of the residual in records."""
        return np.asarray(norm_of(residuals))

    @cached_property
    def _screening(self) -> Screening:
        return Screening.of(self.plan)

    def passed_in(self, runs: Runs, norm: FloatArray, limits: FloatArray, onset: int | None) -> NDArray[np.bool_]:
        """Return where runs pass a threshold; nothing is computed in full that bounds decide."""
        return self._screening.passed_in(runs, norm, limits, onset)

"""The adaptive threshold for records of one length: what `obsynth.monitor` gives for a plant with tolerances."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any

import numpy as np

from obsynth.errors import PreconditionError, SpecError
from obsynth.experiments.benches import Runs
from obsynth.experiments.monitors.adaptive_bound import THRESHOLD_ROUNDING
from obsynth.experiments.monitors.adaptive_monitor import adaptive_plan, adaptive_statement
from obsynth.experiments.monitors.adaptive_record import thresholds_of_records
from obsynth.experiments.monitors.adaptive_rule import AdaptivePlan, record_columns
from obsynth.experiments.monitors.adaptive_screening import Records, Screening, first_passed
from obsynth.experiments.monitors.monitor import Detection, Monitor
from obsynth.experiments.monitors.residual_model import noisy_plant
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.estimates import Estimates
from obsynth.results.design import ObserverDesign
from obsynth.simulation.scenario import Scenario
from obsynth.simulation.signals import resolve


def noisy_design(design: ObserverDesign, scenario: Scenario | None) -> ObserverDesign:
    """Return a design whose plant has the noise of a scenario; tolerances stay."""
    if scenario is None:
        return design
    plant, _ = design.linear
    noise = noisy_plant(plant, scenario, resolve(plant, scenario))
    kept = noise.Bw.any(axis=0) | noise.Dw.any(axis=0)
    return design.replace(plant=noise.replace(Bw=noise.Bw[:, kept], Dw=noise.Dw[:, kept], noise_names=None))


@dataclass(frozen=True, eq=False)
class AdaptiveMonitor(Monitor):
    """A monitor whose threshold adapts to the signals; `threshold` is the nominal one, which it is never below."""

    plan: AdaptivePlan = field(kw_only=True)

    def bounds(self, runs: Runs) -> tuple[FloatArray, FloatArray]:
        """Return thresholds of fault estimates and residuals ``(runs, steps, no)``, and intervals of the faults."""
        return record_columns(self.plan, *_by_run(runs, slice(None)))

    @cached_property
    def _screening(self) -> Screening:
        return Screening.of(self.plan)

    def passed_in(self, runs: Runs, residuals: slice, *, onset: int | None = None) -> np.ndarray:
        """Return at which samples of which runs a threshold is passed, ``(steps, runs)``."""
        plan = self.plan
        *_, m, no = plan.bound.counts
        values = np.abs(runs.rows[:, :, runs.rows.shape[2] - no :])
        norm = self.statistic(runs.rows[:, :, residuals])
        # No threshold over the box is below the nominal one: runs that never pass that need no other.
        start = np.array([plan.bound.start_at(k)[m:] for k in range(len(values))])
        begun = np.linalg.norm(start[:, plan.residuals], axis=1) if plan.start_beyond_nominal else 0.0
        candidates = (values > (plan.bound.nominal[m:] + start)[:, None]).any(axis=2)
        candidates |= norm > (self.threshold + begun)[:, None] + self.floor
        if onset is None or plan.bound.varying or plan.bound.first is not None:
            return self._all_passed(runs, values, norm, candidates, len(values))
        passed = np.zeros(norm.shape, dtype=bool)
        chosen = np.flatnonzero(candidates.any(axis=0))
        if not len(chosen):
            return passed
        reading = plan.bound.structure.reading
        records = Records(runs.rows[:, chosen] @ reading.T, runs.inputs[:, chosen], runs.outputs[:, chosen],
                          values[:, chosen], norm[:, chosen], self.threshold + self.floor)  # fmt: skip
        sure, left = first_passed(self._screening, records, candidates[:, chosen], onset)
        passed[:, chosen] = sure
        if left.any():
            undecided = np.zeros_like(passed)
            undecided[:, chosen] = left
            length = int(np.flatnonzero(left.any(axis=1))[-1]) + 1
            passed |= self._all_passed(runs, values, norm, undecided, length)
        return passed

    def _all_passed(
        self, runs: Runs, values: FloatArray, norm: FloatArray, candidates: np.ndarray, length: int
    ) -> np.ndarray:
        """Compute the thresholds of runs with candidates in full, up to a number of samples."""
        plan = self.plan
        passed = np.zeros(norm.shape, dtype=bool)
        chosen = np.flatnonzero(candidates.any(axis=0))
        if not len(chosen):
            return passed
        rows, inputs, outputs = (item[:, :length] for item in _by_run(runs, chosen))
        found = thresholds_of_records(plan.bound, rows @ plan.bound.structure.reading.T, inputs, outputs)
        at = plan.residuals
        parts = [found.shift[..., at], found.rest[..., at], *np.moveaxis(found.first[..., at], 2, 0)]
        if plan.start_beyond_nominal:
            parts.append(found.start[..., at])
        beside = sum(np.linalg.norm(part, axis=2) for part in parts) + np.linalg.norm(plan.bound.more[at])
        limit = (self.threshold[:length, None] + self.floor + np.asarray(beside).T) * THRESHOLD_ROUNDING
        if plan.sample_time is not None:
            # Where the norm passes, one of the rows does.
            limit = np.full_like(limit, np.inf)
        beyond = (values[:length, chosen] > np.moveaxis(found.total, 0, 1)).any(axis=2)
        passed[:length, chosen] = (norm[:length, chosen] > limit) | beyond
        return np.asarray(passed & candidates)

    def watch(self, estimates: Estimates) -> Detection:
        """Refuse: the threshold needs the record of inputs and outputs."""
        raise SpecError(
            "An adaptive threshold follows inputs and outputs, which estimates do not hold: use obsynth.evaluate, or "
            "obsynth.online_monitor with obsynth.run_on_data.", path="monitor",
        )  # fmt: skip


def _by_run(runs: Runs, chosen: Any) -> tuple[FloatArray, FloatArray, FloatArray]:
    rows, inputs, outputs = (
        np.ascontiguousarray(np.moveaxis(signals[:, chosen], 1, 0))
        for signals in (runs.rows, runs.inputs, runs.outputs)
    )
    return rows, inputs, outputs


def with_box(
    design: ObserverDesign, scenario: Scenario, nominal: Monitor, bounds: FloatArray, noise_bound: float | None, *,
    initial_error: float | None, initial_set: Mapping[str, Any] | None,
) -> AdaptiveMonitor:  # fmt: skip
    """Return a pointwise monitor over the box of the design's plant, from the scenario's start unless one is given."""
    plant, _ = design.linear
    if not plant.is_discrete and scenario.inputs:
        raise PreconditionError(
            "The design is continuous in time, and the inputs of a scenario move between its samples: thresholds over "
            "tolerances need inputs that are held. Sample the plant first (transform: sample_time).",
            condition="discrete time",
        )
    state = None if scenario.observer_state is None else np.array(scenario.observer_state)
    if initial_set is None and initial_error is None:
        initial_set = {name: (scenario.initial_state.get(name, 0.0),) * 2 for name in plant.state_names}
    first, _ = adaptive_plan(
        noisy_design(design, scenario), bounds, noise_bound or 0.0, initial_error=initial_error,
        initial_set=initial_set, observer_state=state, sample_time=None if plant.is_discrete else scenario.sample_time,
    )  # fmt: skip
    values = {item.name: getattr(nominal, item.name) for item in fields(nominal)}
    return AdaptiveMonitor(**{**values, "statement": adaptive_statement(first, design)}, plan=first)

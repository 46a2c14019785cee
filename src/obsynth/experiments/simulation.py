"""A design on a scenario: the plant simulated, the observer beside it, and how far its estimates are off."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from obsynth.experiments.batch_simulation import Bench, make_bench
from obsynth.experiments.columns import SignalTable, named_columns, projected_note, root_mean_square
from obsynth.numerics.arguments import require_kind
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.linear.observer import Estimates, LinearObserver
from obsynth.results.design import ObserverDesign
from obsynth.simulation.scenario import Scenario

if TYPE_CHECKING:
    from obsynth.experiments.parameter_simulation import RecursiveSimulation

#: Warm-up ends when the effect of an error at the start has shrunk to this share of its largest, for good.
WARM_UP_SHARE = 0.01
#: An initial state that is off by less than this, relative to its size, is off by rounding only.
CONSISTENCY_TOLERANCE = 1e-9


@dataclass(frozen=True, eq=False)
class Simulation(SignalTable):
    """A plant and its observer over a scenario, one row per sample; arrays are read-only.

    Parameters
    ----------
    time : FloatArray
        ``(steps,)``, seconds.
    states, outputs, inputs, faults, disturbances : FloatArray
        ``(steps, nx)``, ``(steps, ny)`` as measured, ``(steps, nu)`` with any feedback, ``(steps, nf)``,
        ``(steps, nd)``.
    estimates : Estimates
        At sample k, of the signals at k minus their delays.
    output_names, input_names, disturbance_names : tuple of str
        Names of those columns; states and faults are named as in ``estimates``.
    inconsistency : float
        Norm of the change that the initial state needed to satisfy the algebraic equations.
    state_warm_up, fault_warm_up : int or None
        Sample from which an error at the start no longer shows in the estimates of states (faults); `None` if that is
        not within the record.
    notes : tuple of str
        What a reader must know: a feedback that was added, holds between samples, a projected start.
    """

    time: FloatArray
    states: FloatArray
    outputs: FloatArray
    inputs: FloatArray
    faults: FloatArray
    disturbances: FloatArray
    estimates: Estimates
    output_names: tuple[str, ...]
    input_names: tuple[str, ...]
    disturbance_names: tuple[str, ...]
    inconsistency: float
    state_warm_up: int | None
    fault_warm_up: int | None
    notes: tuple[str, ...]

    @property
    def fault_errors(self) -> FloatArray:
        """Estimate less fault, aligned with the known delays, ``(steps, nf)``; NaN before the first."""
        return aligned_errors(self.estimates.faults, self.faults, self.estimates.fault_delays)

    @property
    def state_errors(self) -> FloatArray:
        """Estimate less state, aligned with the known delays, ``(steps, nx)``; NaN before the first."""
        return aligned_errors(self.estimates.states, self.states, self.estimates.state_delays)

    def summary(self) -> dict[str, Any]:
        """Return root mean square and largest errors after warm-up by signal, and when warm-up ended, as plain data."""
        table: dict[str, Any] = {}
        for kind, names, errors, warm_up in (
            ("faults", self.estimates.fault_names, self.fault_errors, self.fault_warm_up),
            ("states", self.estimates.state_names, self.state_errors, self.state_warm_up),
        ):
            after = errors[warm_up:]
            table[kind] = {
                name: {"rmse": root_mean_square(after[:, i]), "largest": _largest(after[:, i])}
                for i, name in enumerate(names)
            }
            table[f"{kind[:-1]}_warm_up"] = None if warm_up is None else float(self.time[warm_up])
        return {"samples": len(self.time), "inconsistency": self.inconsistency, **table, "notes": list(self.notes)}

    def columns(self) -> dict[str, FloatArray]:
        """Return every column by name: ``time``, inputs and outputs, ``x[..]``, ``f[..]``, ``d[..]``, and estimates.

        An output with the name of an input is ``y[..]``.  Estimates ``xhat[..]``, ``fhat[..]`` and residuals ``r[..]``
        stand where the observer gave them.
        """
        shown = self.estimates
        groups = (
            ("u[{}]", self.input_names, self.inputs), ("y[{}]", self.output_names, self.outputs),
            ("x[{}]", shown.state_names, self.states), ("f[{}]", shown.fault_names, self.faults),
            ("d[{}]", self.disturbance_names, self.disturbances), ("xhat[{}]", shown.state_names, shown.states),
            ("fhat[{}]", shown.fault_names, shown.faults), ("r[{}]", shown.residual_names, shown.residuals),
        )  # fmt: skip
        return named_columns(self.time, groups)


def simulate(design: ObserverDesign, scenario: Scenario) -> Simulation | RecursiveSimulation:
    """Simulate a design's plant over a scenario, with its observer beside it.

    Parameters
    ----------
    design : ObserverDesign
        Of any method; the plant of a linear one has index 0 or 1.
    scenario : Scenario
        What happens.  For a time-varying plant or a DAE, ``inputs`` and ``faults`` are added to the nominal inputs and
        parameters, ``noise`` multiplies the deviations that the design states, and states without a value start where
        the observer does (those of a DAE at their nominal values).

    Returns
    -------
    Simulation or RecursiveSimulation
        Signals, estimates, and how well they agree; the second for recursive designs, with standard deviations.

    Raises
    ------
    SpecError
        An unknown name, a missing sample time, something that such a plant does not have, or states that outgrow double
        precision.
    PreconditionError
        The plant is not regular, has index 2 or more (its states then depend on derivatives of the signals, which a
        scenario does not have), or cannot be stabilised; the equations of a time-varying one do not determine its
        state at some k.
    SolverError
        A step of a DAE has no solution.

    Notes
    -----
    Discrete plants step by their own equations.  Continuous ones step by the matrix exponential, exactly for signals
    that are constant between samples (steps, intermittent ones, random ones) or linear (ramps); sines and drifts are
    taken as linear between samples.  The continuous observer runs on the samples, by a first-order hold.  A DAE is
    integrated by Radau IIA (fifth order) with inputs that are constant during each step, whatever its observer uses.
    """
    require_kind(design, ObserverDesign, "design", "an ObserverDesign, such as obsynth.load(path)")
    require_kind(scenario, Scenario, "scenario", "an obsynth.Scenario")
    if not isinstance(design.observer, LinearObserver):
        from obsynth.experiments.parameter_simulation import simulate_recursive

        return simulate_recursive(design, scenario)
    bench = make_bench(design, scenario)
    runs = bench.run([scenario.seed])
    plant, _ = design.linear
    warm_ups = warm_up_ends(bench)
    inconsistency = float(np.linalg.norm(runs.states[0, 0] - bench.initial_state)) if scenario.initial_state else 0.0
    return Simulation(
        time=bench.drive.dt * np.arange(bench.drive.steps, dtype=np.float64),
        states=runs.states[:, 0], outputs=runs.outputs[:, 0],
        inputs=runs.inputs[:, 0], faults=runs.faults[:, 0], disturbances=runs.disturbances[:, 0],
        estimates=Estimates.split(bench.observer, runs.rows[:, 0]), output_names=plant.output_names,
        input_names=plant.input_names, disturbance_names=plant.disturbance_names, inconsistency=inconsistency,
        state_warm_up=warm_ups[0], fault_warm_up=warm_ups[1],
        notes=_notes(bench, inconsistency, continuous=not plant.is_discrete),
    )  # fmt: skip


def warm_up_ends(bench: Bench) -> tuple[int | None, int | None]:
    """Return the samples at which the start no longer shows in the estimates of states, and of faults."""
    observer, steps = bench.observer, bench.drive.steps
    ends: list[int | None] = []
    for rows, delays in (
        (observer.state_rows, observer.state_delays),
        (observer.fault_rows, observer.fault_delays),
    ):
        shown, sizes = observer.Cz[rows], np.zeros(steps)
        for k in range(steps):
            sizes[k] = np.linalg.norm(shown)
            shown = shown @ observer.Az
        late = np.flatnonzero(sizes > WARM_UP_SHARE * np.max(sizes))
        end = int(late[-1]) + 1 if late.size else 0
        end = max(end, *delays, 0)
        ends.append(end if end < steps else None)
    return ends[0], ends[1]


def aligned_errors(estimates: FloatArray, truth: FloatArray, delays: tuple[int, ...]) -> FloatArray:
    """Return estimate(k) less truth(k - delay); NaN where there is no truth yet.

    Shapes: ``estimates (steps, ..., n)``, ``truth (steps, ..., n)``.
    """
    errors = np.full(estimates.shape, np.nan)
    for i, delay in enumerate(delays):
        errors[delay:, ..., i] = estimates[delay:, ..., i] - truth[: len(truth) - delay, ..., i]
    return errors


def _largest(errors: FloatArray) -> float:
    known = errors[~np.isnan(errors)]
    return float(np.max(np.abs(known))) if known.size else float("nan")


def _notes(bench: Bench, inconsistency: float, *, continuous: bool) -> tuple[str, ...]:
    notes = []
    if continuous:
        notes.append(
            "Between samples the plant is exact for signals that are constant or linear there; its observer is sampled "
            "by a first-order hold."
        )
    if bench.stepper.feedback is not None:
        notes.append(
            "A stabilising state feedback (linear-quadratic, unit weights) was added for this simulation; the inputs "
            "include it."
        )
    if inconsistency > CONSISTENCY_TOLERANCE * max(1.0, float(np.linalg.norm(bench.initial_state))):
        notes.append(projected_note(inconsistency))
    return tuple(notes)

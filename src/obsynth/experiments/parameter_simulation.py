"""A recursive design on a scenario: the plant simulated, the observer beside it, and how far its estimates are off."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from obsynth.experiments.columns import SignalTable, named_columns, projected_note, root_mean_square
from obsynth.experiments.parameter_batch_simulation import RowEstimates, make_recursive_bench
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.dae.observer import DAEObserver
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.results.design import ObserverDesign
from obsynth.simulation.scenario import Scenario

#: Standard deviations on each side: 95 % of a normal variable.
BAND_WIDTH = 1.96


@dataclass(frozen=True, eq=False)
class RecursiveSimulation(SignalTable):
    """A plant with parameters and its observer over a scenario, one row per sample; arrays are read-only.

    Parameters
    ----------
    time : FloatArray
        ``(steps,)``, seconds.
    states, outputs, inputs, parameters : FloatArray
        ``(steps, nx)``, ``(steps, ny)`` as measured (the model of a time-varying plant begins with y(1): its first row
        is NaN), ``(steps, nu)``, ``(steps, nq)``.
    estimates : RecursiveEstimates or DAEEstimates
        At sample k, of the signals at k.
    output_names, input_names : tuple of str
        Names of those columns; states and parameters are named as in ``estimates``.
    parameter_columns : tuple of int
        Which of ``parameters`` are estimated: all of them, or none by a Kalman filter.
    inconsistency : float
        Norm of the change that the initial state needed to satisfy the algebraic equations.
    notes : tuple of str
        What a reader must know.
    """

    time: FloatArray
    states: FloatArray
    outputs: FloatArray
    inputs: FloatArray
    parameters: FloatArray
    estimates: RowEstimates
    output_names: tuple[str, ...]
    input_names: tuple[str, ...]
    parameter_columns: tuple[int, ...]
    inconsistency: float
    notes: tuple[str, ...]

    @property
    def parameter_errors(self) -> FloatArray:
        """Estimate less parameter, ``(steps, nq)``; without columns for a Kalman filter."""
        return np.asarray(self.estimates.parameters - self.parameters[:, list(self.parameter_columns)])

    @property
    def state_errors(self) -> FloatArray:
        """Estimate less state, ``(steps, nx)``."""
        return np.asarray(self.estimates.states - self.states)

    def summary(self) -> dict[str, Any]:
        """Return root mean square and largest errors of the whole record by signal, as plain data.

        ``within_band`` is the share of samples at which the truth lies in the 95 % band of its estimate.
        """
        shown = self.estimates
        table: dict[str, Any] = {}
        for kind, names, errors, deviations in (
            ("faults", shown.parameter_names, self.parameter_errors, shown.parameter_deviations),
            ("states", shown.state_names, self.state_errors, shown.state_deviations),
        ):
            table[kind] = {
                name: {
                    "rmse": root_mean_square(errors[:, i]),
                    "largest": float(np.max(np.abs(errors[:, i]))),
                    "within_band": float(np.mean(np.abs(errors[:, i]) <= BAND_WIDTH * deviations[:, i])),
                }
                for i, name in enumerate(names)
            }
        return {"samples": len(self.time), "inconsistency": self.inconsistency, **table, "notes": list(self.notes)}

    def columns(self) -> dict[str, FloatArray]:
        """Return every column by name: ``time``, inputs and outputs, ``x[..]``, ``f[..]``, and what is estimated.

        An output with the name of an input is ``y[..]``.  Estimates are ``xhat[..]``, ``fhat[..]``, with their standard
        deviations ``std xhat[..]``, ``std fhat[..]``.
        """
        shown = self.estimates
        groups = (
            ("u[{}]", self.input_names, self.inputs), ("y[{}]", self.output_names, self.outputs),
            ("x[{}]", shown.state_names, self.states),
            ("f[{}]", shown.parameter_names, self.parameters[:, list(self.parameter_columns)]),
            ("xhat[{}]", shown.state_names, shown.states),
            ("std xhat[{}]", shown.state_names, shown.state_deviations),
            ("fhat[{}]", shown.parameter_names, shown.parameters),
            ("std fhat[{}]", shown.parameter_names, shown.parameter_deviations),
        )  # fmt: skip
        return named_columns(self.time, groups)


def simulate_recursive(design: ObserverDesign, scenario: Scenario) -> RecursiveSimulation:
    """Simulate the plant of a recursive design over a scenario: what `simulate` does for it."""
    bench = make_recursive_bench(design, scenario)
    runs = bench.run([scenario.seed])
    plant = _plant(bench.observer)
    change = float(np.linalg.norm(runs.states[0, 0] - bench.initial_state))
    notes = []
    if isinstance(bench.observer, DAEObserver):
        notes.append("The plant was integrated by Radau IIA, with inputs constant during each step.")
    else:
        notes.append("The model begins with y(1): the first row of the outputs is empty.")
    if change > 0.0:
        notes.append(projected_note(change))
    return RecursiveSimulation(
        time=bench.drive.dt * np.arange(bench.drive.steps, dtype=np.float64), states=runs.states[:, 0],
        outputs=runs.outputs[:, 0], inputs=runs.inputs, parameters=runs.parameters, estimates=runs.estimates[0],
        output_names=plant.output_names, input_names=plant.input_names,
        parameter_columns=tuple(range(len(bench.observer.fault_names))), inconsistency=change, notes=tuple(notes),
    )  # fmt: skip


def _plant(observer: RecursiveObserver | DAEObserver) -> Any:
    return observer.model if isinstance(observer, DAEObserver) else observer.plant

"""Simulation of a design on a scenario: plant, observer, and errors of the estimates as a table."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, cast, overload

import numpy as np

from obsynth.errors import SpecError
from obsynth.files.outputs import FileKind, write_atomically
from obsynth.files.tables import table_writer
from obsynth.numerics.arguments import arguments_checked, require_kind
from obsynth.numerics.arrays import FloatArray, freeze
from obsynth.observers.estimates import BAND_WIDTH, Estimates
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.dae import DAEModel
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.polytopic import PolytopicSystem
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem
from obsynth.plants.transformations.recovery import Transformation
from obsynth.results.design import ObserverDesign
from obsynth.results.registered import registered
from obsynth.simulation.benches import bench_of, rows_without_claim
from obsynth.simulation.dae import simulate_dae
from obsynth.simulation.linear import simulate_plant, simulate_time_varying
from obsynth.simulation.over_region import simulate_polytopic
from obsynth.simulation.plant_alone import PlantAlone, simulate_scenario
from obsynth.simulation.scenario import Scenario
from obsynth.simulation.trajectory import Trajectory

#: An initial state that is off by less than this, relative to its size, is off by rounding only.
CONSISTENCY_TOLERANCE = 1e-9

#: A table that `Simulation.write_csv` has written: signals of the plant beside time, and no status of rows.
SIMULATED_SIGNALS = FileKind("a table of simulated signals", rb"\Atime,(?!status,)[^\n]*x(hat)?\[", suffix=".csv")

#: Columns beside inputs and outputs that hold deviations from an operating point.
_OF_THE_POINT = ("x[{}]", "xhat[{}]", "f[{}]", "fhat[{}]", "d[{}]")

#: What simulates a plant alone.
_PLANT_SIMULATIONS: dict[type, Callable[..., Trajectory]] = {
    DescriptorSystem: simulate_plant,
    TimeVaryingDescriptorSystem: simulate_time_varying,
    DAEModel: simulate_dae,
    PolytopicSystem: simulate_polytopic,
}


@dataclass(frozen=True, eq=False)
class Simulation:
    """A plant and its observer over a scenario, one row per sample; arrays are read-only.

    Parameters
    ----------
    time : FloatArray
        ``(steps,)``, seconds.
    states, outputs, inputs, faults, disturbances : FloatArray
        ``(steps, nx)`` (of an observer of some states: those), ``(steps, ny)`` as measured (the model of a time-varying
        plant begins with y(1): its first row is NaN), ``(steps, nu)`` with any feedback, ``(steps, nf)``,
        ``(steps, nd)``.  The faults of a plant with parameters are these: `parameters` is another name.
    estimates : Estimates
        At sample k, of the signals at k minus their delays.
    output_names, input_names, disturbance_names : tuple of str
        Names of those columns; states and faults are named as in ``estimates``.
    fault_columns : tuple of int
        Which of ``faults`` are estimated: all of them, or some, or none by a Kalman filter.
    inconsistency : float
        Norm of the change that the initial state needed to satisfy the algebraic equations.
    state_warm_up, fault_warm_up : int or None
        Sample from which an error at the start no longer shows in the estimates of states (faults); `None` if that is
        not within the record.  Zero where the observer states deviations: they say from the start what it knows.
    notes : tuple of str
        What a reader must know: a feedback that was added, holds between samples, a projected start.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]], C=[[1, 0], [0, 1]], Bf=[[1], [0]], Bd=[[0], [1]], dt=1.0
    ... )
    >>> design = obsynth.fault_estimation_filter(plant)
    >>> run = obsynth.simulate(design, obsynth.Scenario(horizon=30, faults={"f1": obsynth.Step(size=1.0, start=10)}))
    >>> float(run.time[-1]), run.estimates.faults[-1].round(3).tolist()
    (30.0, [1.0])
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
    fault_columns: tuple[int, ...]
    inconsistency: float
    state_warm_up: int | None
    fault_warm_up: int | None
    notes: tuple[str, ...]

    def __post_init__(self) -> None:
        freeze(self, *(name for name, value in vars(self).items() if isinstance(value, np.ndarray)))

    def __repr__(self) -> str:
        """Return the errors of all estimates as a table."""
        return str(registered("text_of_simulation")(self))

    @property
    def fault_errors(self) -> FloatArray:
        """Estimate less fault, aligned with the known delays, ``(steps, nf)``; NaN before the first."""
        truth = self.faults[:, list(self.fault_columns)]
        return aligned_errors(self.estimates.faults, truth, self.estimates.fault_delays)

    @property
    def state_errors(self) -> FloatArray:
        """Estimate less state, aligned with the known delays, ``(steps, nx)``; NaN before the first."""
        return aligned_errors(self.estimates.states, self.states, self.estimates.state_delays)

    @property
    def parameters(self) -> FloatArray:
        """The parameters of a plant that has some, ``(steps, nq)``: the same as `faults`."""
        return self.faults

    @property
    def parameter_columns(self) -> tuple[int, ...]:
        """The same as `fault_columns`."""
        return self.fault_columns

    @property
    def parameter_errors(self) -> FloatArray:
        """The same as `fault_errors`, ``(steps, nq)``."""
        return self.fault_errors

    def summary(self) -> dict[str, Any]:
        """Return root mean square and largest errors by signal, as plain data.

        Those of an observer that states deviations are of the whole record, with the share of samples at which the
        truth lies in the 95 % band of its estimate (``within_band``); those of others come after warm-up, with the time
        at which that ended.
        """
        estimates, table = self.estimates, dict[str, Any]()
        for kind, names, errors, deviations, warm_up in (
            ("faults", estimates.fault_names, self.fault_errors, estimates.fault_deviations, self.fault_warm_up),
            ("states", estimates.state_names, self.state_errors, estimates.state_deviations, self.state_warm_up),
        ):
            table[kind] = {name: _error_sizes(errors[warm_up:, i]) for i, name in enumerate(names)}
            if estimates.has_deviations:
                for i, row in enumerate(table[kind].values()):
                    row["within_band"] = float(np.mean(np.abs(errors[:, i]) <= BAND_WIDTH * deviations[:, i]))
            else:
                table[f"{kind[:-1]}_warm_up"] = None if warm_up is None else float(self.time[warm_up])
        return {"samples": len(self.time), "inconsistency": self.inconsistency, **table, "notes": list(self.notes)}

    def columns(self) -> dict[str, FloatArray]:
        """Return every column by name: ``time``, inputs and outputs, ``x[..]``, ``f[..]``, ``d[..]``, and estimates.

        An output with the name of an input is ``y[..]``.  Estimates ``xhat[..]``, ``fhat[..]``, standard deviations
        ``sd xhat[..]``, ``sd fhat[..]`` and residuals ``r[..]`` stand where the observer gave them.
        """
        estimates, spread = self.estimates, self.estimates.has_deviations
        x, f = estimates.state_names, estimates.fault_names
        columns = {"time": self.time}
        for form, names, values in (
            ("u[{}]", self.input_names, self.inputs),
            ("y[{}]", self.output_names, self.outputs),
            ("x[{}]", x, self.states),
            ("f[{}]", f, self.faults[:, list(self.fault_columns)]),
            ("d[{}]", self.disturbance_names, self.disturbances),
            ("xhat[{}]", x, estimates.states),
            *([("sd xhat[{}]", x, estimates.state_deviations)] if spread else []),
            ("fhat[{}]", f, estimates.faults),
            ("sd fhat[{}]", f, estimates.fault_deviations)
            if spread
            else ("r[{}]", estimates.residual_names, estimates.residuals),
        ):
            for i, name in enumerate(names):
                # Inputs and outputs go by their own names, unless those are taken.
                plain = form[0] in "uy" and name not in columns
                columns[name if plain else form.format(name)] = values[:, i]
        return columns

    def write_csv(self, path: str | Path, *, operating_point: Mapping[str, float] = MappingProxyType({})) -> Path:
        """Write `columns` as comma-separated text, atomically, floats with all their digits.

        Parameters
        ----------
        path : path
            Of the file.
        operating_point : mapping, optional
            Values by signal that are added, so that the file is a log as `run_on_data` reads it; nothing by default.
        """
        table, text = self.columns(), io.StringIO()
        for form, name in [(f, n) for n in operating_point for f in ("{}", "y[{}]", *_OF_THE_POINT)]:
            if (column := form.format(name)) in table:
                table[column] = table[column] + operating_point[name]
        table_writer(text, table)(zip(*(column.tolist() for column in table.values()), strict=True))
        return write_atomically(path, text.getvalue(), kind=SIMULATED_SIGNALS)


@overload
def simulate(design: ObserverDesign, scenario: Scenario) -> Simulation: ...


@overload
def simulate(
    design: DescriptorSystem | PolytopicSystem | TimeVaryingDescriptorSystem | DAEModel | Transformation,
    scenario: Scenario,
) -> Trajectory: ...


@overload
def simulate(
    design: DescriptorSystem | PolytopicSystem | TimeVaryingDescriptorSystem | DAEModel | Transformation,
    **signals: Any,
) -> Trajectory: ...


@arguments_checked
def simulate(
    design: ObserverDesign
    | DescriptorSystem
    | PolytopicSystem
    | TimeVaryingDescriptorSystem
    | DAEModel
    | Transformation,
    scenario: Scenario | None = None,
    **signals: Any,
) -> Simulation | Trajectory:
    """Simulate a design's plant over a scenario, with its observer beside it; or a plant alone.

    Parameters
    ----------
    design : ObserverDesign, DescriptorSystem, PolytopicSystem, TimeVaryingDescriptorSystem, DAEModel or Transformation
        A design of any method, the plant of a linear one of index 0 or 1; or a plant.
    scenario : Scenario, optional
        What happens.  For a time-varying plant or a DAE, ``inputs`` and ``faults`` are added to the nominal inputs and
        parameters, ``noise`` multiplies the deviations that the design states, and states without a value start where
        the observer does (those of a DAE at their nominal values).  A plant alone has no observer to start, and a DAE
        alone needs ``sample_time``.
    **signals
        For a plant alone without a scenario.  A discrete linear one: ``steps`` samples, with ``u (steps, nu)``,
        ``f (steps, nf)``, ``d (steps, nd)``, ``w (steps, nw)`` and ``initial_state (nx,)``, zero by default.  A
        time-varying one: as `simulate_time_varying`.  A DAE: as `simulate_dae`.  A plant over a region: its course
        ``scheduling (samples, p)``, the same signals, and ``sample_time`` in continuous time.

    Returns
    -------
    Simulation or Trajectory
        Signals, estimates, and how well they agree, with standard deviations where the observer states them; or what
        the plant alone did.

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

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]], C=[[1, 0], [0, 1]], Bf=[[1], [0]], Bd=[[0], [1]], dt=1.0
    ... )
    >>> design = obsynth.fault_estimation_filter(plant)
    >>> scenario = obsynth.Scenario(horizon=30, faults={"f1": obsynth.Step(size=1.0, start=10)})
    >>> run = obsynth.simulate(design, scenario)
    >>> run.estimates.faults[-1].round(3).tolist()
    [1.0]
    """
    design = design.plant if isinstance(design, Transformation) else design
    for kind, plant_alone in _PLANT_SIMULATIONS.items():
        if isinstance(design, kind):
            if scenario is not None and signals:
                raise SpecError(
                    f"{', '.join(signals)}: give a scenario, or the signals of a plant alone.", path=next(iter(signals))
                )
            trajectory: Trajectory = (
                plant_alone(design, **signals)
                if scenario is None
                else simulate_scenario(cast(PlantAlone, design), scenario)
            )
            return trajectory
    require_kind(design, ObserverDesign, "design", "an ObserverDesign, such as obsynth.load(path)")
    require_kind(scenario, Scenario, "scenario", "an obsynth.Scenario")
    if signals:
        raise SpecError(f"{', '.join(signals)}: the signals of a design are its scenario's.", path=next(iter(signals)))
    return _simulated(cast(ObserverDesign, design), cast(Scenario, scenario))


def _simulated(design: ObserverDesign, scenario: Scenario) -> Simulation:
    bench = bench_of(design, scenario)
    runs = bench.run([scenario.seed])
    plant, dt = design.plant, bench.signals.dt
    silent = rows_without_claim(bench, runs)
    state_warm_up, fault_warm_up = bench.warm_ups()
    change, notes = float(np.linalg.norm(runs.states[0, 0] - bench.initial_state)), list(bench.notes)
    if isinstance(design.observer, LinearObserver) and not scenario.initial_state:
        # Nothing was asked for: the plant starts at rest, as its inputs let it.
        change = 0.0
    if change > CONSISTENCY_TOLERANCE * max(1.0, float(np.linalg.norm(bench.initial_state))):
        notes.append(
            "The initial state did not satisfy the algebraic equations: it was projected, a change of "
            f"{change:.3g} (norm)."
        )
    if silent:
        notes.append(
            f"In {silent} of {bench.signals.steps} samples nothing is claimed: the plant, or its estimate, was outside "
            "the region, or faster than a stated rate, or had been so until recently."
        )
    return Simulation(
        time=dt * np.arange(bench.signals.steps, dtype=np.float64),
        states=bench.true_states(runs.states[:, 0]),
        outputs=runs.outputs[:, 0],
        inputs=runs.inputs[:, 0],
        faults=runs.faults[:, 0],
        disturbances=runs.disturbances[:, 0],
        estimates=runs.estimates[0],
        output_names=plant.output_names,
        input_names=getattr(design.observer, "input_names", plant.input_names),
        disturbance_names=getattr(plant, "disturbance_names", ()),
        fault_columns=bench.estimated,
        inconsistency=change,
        state_warm_up=state_warm_up,
        fault_warm_up=fault_warm_up,
        notes=tuple(notes),
    )


def aligned_errors(estimates: FloatArray, truth: FloatArray, delays: tuple[int, ...]) -> FloatArray:
    """Return ``estimates(k) - truth(k - delay)``, ``(steps, ..., n)``; NaN where there is no truth yet."""
    errors = np.full(estimates.shape, np.nan)
    for i, delay in enumerate(delays):
        errors[delay:, ..., i] = estimates[delay:, ..., i] - truth[: len(truth) - delay, ..., i]
    return errors


def _error_sizes(errors: FloatArray) -> dict[str, float]:
    """Return root mean square and largest absolute value of what is not NaN."""
    known = errors[~np.isnan(errors)]
    if not known.size:
        return {"rmse": float("nan"), "largest": float("nan")}
    return {"rmse": float(np.sqrt(np.mean(known**2))), "largest": float(np.max(np.abs(known)))}

"""A design on a scenario: the plant simulated, the observer beside it, how far its estimates are off, as a table.

Designs and scenarios side by side, ready to run: plant, signals and observer, once for each of many seeds.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, cast, overload

import numpy as np

from obsynth.analysis.transformations.linear_plants import Transformation, plant_and_recovery
from obsynth.errors import SpecError
from obsynth.files.outputs import FileKind, write_atomically
from obsynth.files.tables import table_writer
from obsynth.numerics.arguments import FloatArray, arguments_checked, freeze, read_only, require_kind
from obsynth.numerics.continuous import driven, first_order_hold
from obsynth.numerics.ranks import covariance_factor
from obsynth.observers.dae.observer import DAEObserver
from obsynth.observers.linear.observer import LinearObserver, WindowObserver, sample_observer, split_rows
from obsynth.observers.recursive.gain_schedule import run_batch
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.observers.running import BAND_WIDTH, Estimates
from obsynth.plants.dae import DAEModel
from obsynth.plants.descriptor import DescriptorSystem, MatrixSequence, TimeVaryingDescriptorSystem, index_of
from obsynth.results.design import ObserverDesign
from obsynth.simulation.dae import simulate_dae
from obsynth.simulation.linear import (
    PlantRuns,
    scenario_runs,
    scenario_stepper,
    simulate_plant,
    simulate_time_varying,
    varying_runs,
)
from obsynth.simulation.scenario import Scenario, ScenarioSignals, Trajectory, observer_start, resolve_parameters
from obsynth.tolerances.robustness import drawn_points, plant_at

#: Warm-up ends when the effect of an error at the start has shrunk to this share of its largest, for good.
WARM_UP_SHARE = 0.01
#: Notes on simulations.
INPUTS_BETWEEN_SAMPLES = (
    "Between samples the plant is exact for signals that are constant or linear there; its observer is sampled by a "
    "first-order hold."
)
STABILISED = (
    "A stabilising state feedback (linear-quadratic, unit weights) was added for this simulation; the inputs include "
    "it."
)
#: An initial state that is off by less than this, relative to its size, is off by rounding only.
CONSISTENCY_TOLERANCE = 1e-9


@dataclass(frozen=True, eq=False)
class Runs:
    """What happened in several runs, ``(steps, runs, signals)`` each."""

    states: FloatArray
    outputs: FloatArray  # as measured
    inputs: FloatArray
    faults: FloatArray  # the parameters of a plant that has some
    disturbances: FloatArray
    rows: FloatArray  # the observer's states, faults, residuals
    observer: LinearObserver | RecursiveObserver | DAEObserver
    kept: tuple[Estimates, ...] = ()  # estimates that say more than rows

    @property
    def estimates(self) -> tuple[Estimates, ...]:
        """What the observer says, one per run."""
        if not isinstance(self.observer, LinearObserver):
            return self.kept
        return tuple(split_rows(self.observer, self.rows[:, run]) for run in range(self.rows.shape[1]))


@dataclass(frozen=True, eq=False)
class Bench:
    """A design and a scenario, ready to run; it can be sent to another process, with a model that is data."""

    signals: ScenarioSignals
    observer: LinearObserver | RecursiveObserver | DAEObserver  # in discrete time
    initial_state: FloatArray
    fault_signals: slice
    estimated: tuple[int, ...]  # which of the true faults are estimated
    notes: tuple[str, ...]
    #: The plant alone, once for each seed.
    simulated: Callable[[Sequence[int]], PlantRuns]
    #: Rows of the observer from outputs and inputs of several runs, and its estimates where they say more than rows.
    observed: Callable[[FloatArray, FloatArray], tuple[FloatArray, tuple[Estimates, ...]]]

    def run(self, seeds: Sequence[int]) -> Runs:
        """Run the plant and the observer, once for each seed."""
        states, outputs, inputs, faults, disturbances = self.simulated(seeds)
        rows, kept = self.observed(outputs, inputs)
        return Runs(states, outputs, inputs, faults, disturbances, rows, self.observer, kept)

    @property
    def onset(self) -> int | None:
        """First sample at which a fault acts, or a faulty sensor; `None` if there is none."""
        return self.signals.first_fault(self.fault_signals)

    def warm_ups(self) -> tuple[int | None, int | None]:
        """Return from when the start no longer shows in the estimates of states, and of faults; 0 with deviations."""
        observer, steps = self.observer, self.signals.steps
        if not isinstance(observer, LinearObserver):
            return 0, 0

        def end(rows: slice, delays: tuple[int, ...]) -> int | None:
            shown, sizes = observer.Cz[rows], np.zeros(steps)
            for k in range(steps):
                sizes[k] = np.linalg.norm(shown)
                shown = shown @ observer.Az
            late = np.flatnonzero(sizes > WARM_UP_SHARE * np.max(sizes))
            found = max(int(late[-1]) + 1 if late.size else 0, *delays, 0)
            return found if found < steps else None

        return end(observer.state_rows, observer.state_delays), end(observer.fault_rows, observer.fault_delays)


def make_bench(design: ObserverDesign, scenario: Scenario) -> Bench:
    """Return the bench of a linear design and a scenario."""
    plant, observer = design.linear
    start = np.array([scenario.initial_state.get(name, 0.0) for name in plant.state_names])
    drive, stepper = scenario_stepper(plant, scenario, start)
    begin = observer_start(scenario, observer.order)
    ramp = np.zeros((observer.order, len(observer.input_names) + len(observer.output_names)))
    if observer.dt <= 0.0:
        ramp = first_order_hold(observer.Az, np.hstack([observer.Bu, observer.By]), drive.dt)[2]
        observer = sample_observer(observer, drive.dt)
    said = ((not plant.is_discrete, INPUTS_BETWEEN_SAMPLES), (stepper.feedback is not None, STABILISED))
    return Bench(
        drive,
        observer,
        start,
        slice(plant.nu, plant.nu + plant.nf),
        tuple(index_of(name, plant.fault_names, what="The plant") for name in observer.fault_names),
        tuple(text for holds, text in said if holds),
        partial(scenario_runs, drive, stepper, (plant.nu, plant.nu + plant.nf)),
        partial(_linear_rows, observer, begin, ramp),
    )


def _linear_rows(
    observer: LinearObserver, begin: FloatArray, ramp: FloatArray, outputs: FloatArray, inputs: FloatArray
) -> tuple[FloatArray, tuple[Estimates, ...]]:
    """Return what a linear observer says to ``outputs (steps, runs, ny)``, ``inputs (steps, runs, nu)``: its rows.
    ``ramp (nz, nu + ny)``: what a first sample adds to the state at the start."""
    start = begin - np.concatenate([inputs[0], outputs[0]], axis=1) @ ramp.T
    z = driven(observer.Az, start, inputs @ observer.Bu.T + outputs @ observer.By.T)
    rows = z @ observer.Cz.T + inputs @ observer.Du.T + outputs @ observer.Dy.T + observer.added
    return np.asarray(rows), ()


def drawn_designs(design: ObserverDesign, count: int, seed: int) -> list[ObserverDesign]:
    """Return a linear design for so many plants, drawn from the box of its plant's constants."""
    plant, _ = design.linear
    uncertain = plant.uncertainty
    if uncertain is None:
        return [design] * count
    points = drawn_points(len(uncertain.box.names), count, seed)
    return [design.replace(plant=plant_at(plant, uncertain.box.values(q))) for q in points]


def bench_of(design: ObserverDesign, scenario: Scenario) -> Bench:
    """Return a design and a scenario, ready to run."""
    if isinstance(design.observer, LinearObserver):
        return make_bench(design, scenario)
    if isinstance(design.observer, WindowObserver):
        raise SpecError(
            f"Design {design.name!r} is a test whose weights change with k: it cannot be simulated. Simulate the "
            "plant (obsynth.simulate(plant, scenario)) and run the test on the outputs (design.observer.run).",
            path="observer",
        )
    observer: RecursiveObserver | DAEObserver
    simulated: Callable[..., PlantRuns]
    if isinstance(design.observer, DAEObserver):
        observer = design.observer
        model = observer.model
        drive = resolve_parameters(model, scenario, dt=observer.dt)
        start, inputs, theta = model.nominal_state, model.nominal_input, model.nominal_parameters
        note = "The plant was integrated by Radau IIA, with inputs constant during each step."
        simulated = partial(_dae_plant, observer)
    else:
        observer = design.recursive[1]
        adaptation = observer.adaptation
        drive = resolve_parameters(observer.plant, scenario, dt=observer.dt)
        start, inputs = observer.initial_state, np.zeros(observer.plant.nu)
        note = "The model begins with y(1): the first row of the outputs is empty."
        theta = np.zeros(observer.plant.nq) if adaptation is None else adaptation.initial_parameters
        simulated = partial(_varying_plant, observer)
    names = observer.state_names
    begin = np.array([scenario.initial_state.get(name, value) for name, value in zip(names, start, strict=True)])
    nu, estimated = len(inputs), tuple(range(len(observer.fault_names)))
    true = inputs + drive.left[:, :nu], theta + drive.left[:, nu:]
    return Bench(
        drive,
        observer,
        begin,
        slice(nu, None),
        estimated,
        (note,),
        partial(simulated, drive, begin, *true),
        partial(_rows_of, observer),
    )


def _varying_plant(
    observer: RecursiveObserver,
    drive: ScenarioSignals,
    begin: FloatArray,
    inputs: FloatArray,
    parameters: FloatArray,
    seeds: Sequence[int],
) -> PlantRuns:
    steps = drive.steps
    mu, nu = np.zeros((steps, len(seeds), observer.plant.ne)), np.zeros((steps - 1, len(seeds), observer.plant.ny))
    process, sensing = _factors(observer.Q, steps), _factors(observer.R, steps - 1)
    for run, seed in enumerate(seeds):
        rng = np.random.default_rng(seed)
        if drive.noise:
            mu[:, run] = drive.noise * _drawn(process, rng)
            nu[:, run] = drive.noise * _drawn(sensing, rng)
        if drive.deviations.any():
            nu[:, run] += drive.deviations * rng.standard_normal(nu[:, run].shape)
    states, clean = varying_runs(
        observer.plant,
        parameters=parameters,
        inputs=inputs,
        initial_state=begin,
        equation_noise=mu,
        output_noise=nu,
    )
    return _with_parameters(observer, drive, states, clean, inputs, parameters)


def _dae_plant(
    observer: DAEObserver,
    drive: ScenarioSignals,
    begin: FloatArray,
    inputs: FloatArray,
    parameters: FloatArray,
    seeds: Sequence[int],
) -> PlantRuns:
    share = drive.noise**2
    runs = [
        simulate_dae(
            observer.model,
            inputs,
            dt=observer.dt,
            parameters=parameters,
            initial_state=begin,
            Q=share * observer.Q if share else None,
            R=share * observer.R + np.diag(drive.deviations**2),
            seed=seed,
        )
        for seed in seeds
    ]
    states, clean = (np.stack([getattr(run, name) for run in runs], axis=1) for name in ("states", "outputs"))
    return _with_parameters(observer, drive, states, clean, inputs, parameters)


def _with_parameters(
    observer: RecursiveObserver | DAEObserver,
    drive: ScenarioSignals,
    states: FloatArray,
    clean: FloatArray,
    inputs: FloatArray,
    parameters: FloatArray,
) -> PlantRuns:
    """Return runs of a plant with parameters, with outputs as its sensors give them (``clean (steps, runs, ny)``)."""
    outputs = np.moveaxis(observer.timing.arriving(np.moveaxis(drive.measured(clean), 1, 0)), 0, 1)
    steps, runs = outputs.shape[:2]
    shared = (np.broadcast_to(signal[:, None], (steps, runs, signal.shape[1])) for signal in (inputs, parameters))
    return states, outputs, *shared, np.zeros((steps, runs, 0))  # type: ignore[return-value]


def _rows_of(
    observer: RecursiveObserver | DAEObserver, outputs: FloatArray, inputs: FloatArray
) -> tuple[FloatArray, tuple[Estimates, ...]]:
    """Return the rows and the estimates of an observer with parameters; all runs have the same inputs."""
    if isinstance(observer, RecursiveObserver):
        estimates = _recursive_estimates(observer, outputs, inputs[:, 0])
    else:
        estimates = tuple(observer.run(outputs[:, run], inputs[:, 0]) for run in range(outputs.shape[1]))
    rows = np.stack([np.hstack([found.states, found.faults, found.residuals]) for found in estimates], axis=1)
    return rows, estimates


def _recursive_estimates(observer: RecursiveObserver, outputs: FloatArray, inputs: FloatArray) -> tuple[Estimates, ...]:
    """Return the estimates of every run; gains and covariances depend on no data, unless the observer resets."""
    runs = outputs.shape[1]
    resets = observer.adaptation is not None and bool(observer.adaptation.reset)
    if runs == 1 or resets or not observer.is_plain:
        return tuple(observer.run(outputs[:, run], inputs, compiled=False) for run in range(runs))
    first = observer.run(outputs[:, 0], inputs, compiled=False)
    others = run_batch(observer, np.swapaxes(outputs[:, 1:], 0, 1), inputs)
    width = first.innovations.shape[1]
    found = [first]
    for states, parameters, innovations in zip(others.states, others.faults, others.innovations, strict=True):
        seen = read_only(innovations[:, :width])
        nis = read_only(_squares(seen, first.regressors, parameters))
        found.append(replace(first, states=states, faults=parameters, innovations=seen, nis=nis))
    return tuple(found)


def _factors(covariances: MatrixSequence, steps: int) -> FloatArray:
    """Return square roots ``(steps, n, n)`` of covariances."""
    if covariances.is_constant:
        root = covariance_factor(covariances.at(0), covariances.name)
        return np.broadcast_to(root, (steps, *root.shape))
    roots = [covariance_factor(covariances.at(k), f"{covariances.name}({k})") for k in range(steps)]
    return np.stack(roots) if roots else np.zeros((0, *covariances.shape))


def _drawn(factors: FloatArray, rng: np.random.Generator) -> FloatArray:
    return np.asarray(np.einsum("kij,kj->ki", factors, rng.standard_normal(factors.shape[:2])))


def _squares(innovations: FloatArray, regressors: FloatArray, parameters: FloatArray) -> FloatArray:
    """Return squared innovations at the parameters estimated one sample before."""
    before = np.concatenate([parameters[:1], parameters[:-1]])
    gaps = innovations
    if regressors.shape[1:] == (innovations.shape[1], parameters.shape[1]) and regressors.size:
        gaps = innovations - np.einsum("kmq,kq->km", np.nan_to_num(regressors), before)
    return np.asarray(np.nansum(gaps**2, axis=1))


#: A table that `Simulation.write_csv` has written: signals of the plant beside time, and no status of rows.
SIMULATED_SIGNALS = FileKind("a table of simulated signals", rb"\Atime,(?!status,)[^\n]*x(hat)?\[", suffix=".csv")


#: Columns beside inputs and outputs that hold deviations from an operating point.
_OF_THE_POINT = ("x[{}]", "xhat[{}]", "f[{}]", "fhat[{}]", "d[{}]")


@dataclass(frozen=True, eq=False)
class Simulation:
    """A plant and its observer over a scenario, one row per sample; arrays are read-only.

    Parameters
    ----------
    time : FloatArray
        ``(steps,)``, seconds.
    states, outputs, inputs, faults, disturbances : FloatArray
        ``(steps, nx)``, ``(steps, ny)`` as measured (the model of a time-varying plant begins with y(1): its first row
        is NaN), ``(steps, nu)`` with any feedback, ``(steps, nf)``, ``(steps, nd)``.  The faults of a plant with
        parameters are these: `parameters` is another name.
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
        shown, table = self.estimates, dict[str, Any]()
        for kind, names, errors, deviations, warm_up in (
            ("faults", shown.fault_names, self.fault_errors, shown.fault_deviations, self.fault_warm_up),
            ("states", shown.state_names, self.state_errors, shown.state_deviations, self.state_warm_up),
        ):
            table[kind] = {name: _sizes(errors[warm_up:, i]) for i, name in enumerate(names)}
            if shown.has_deviations:
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
        shown, spread = self.estimates, self.estimates.has_deviations
        x, f = shown.state_names, shown.fault_names
        found = {"time": self.time}
        for form, names, values in (
            ("u[{}]", self.input_names, self.inputs),
            ("y[{}]", self.output_names, self.outputs),
            ("x[{}]", x, self.states),
            ("f[{}]", f, self.faults[:, list(self.fault_columns)]),
            ("d[{}]", self.disturbance_names, self.disturbances),
            ("xhat[{}]", x, shown.states),
            *([("sd xhat[{}]", x, shown.state_deviations)] if spread else []),
            ("fhat[{}]", f, shown.faults),
            ("sd fhat[{}]", f, shown.fault_deviations) if spread else ("r[{}]", shown.residual_names, shown.residuals),
        ):
            for i, name in enumerate(names):
                # Inputs and outputs go by their own names, unless those are taken.
                plain = form[0] in "uy" and name not in found
                found[name if plain else form.format(name)] = values[:, i]
        return found

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
        return write_atomically(path, text.getvalue())


@overload
def simulate(design: ObserverDesign, scenario: Scenario) -> Simulation: ...


@overload
def simulate(
    design: DescriptorSystem | TimeVaryingDescriptorSystem | DAEModel | Transformation, **signals: Any
) -> Trajectory: ...


@arguments_checked
def simulate(
    design: ObserverDesign | DescriptorSystem | TimeVaryingDescriptorSystem | DAEModel | Transformation,
    scenario: Scenario | None = None,
    **signals: Any,
) -> Simulation | Trajectory:
    """Simulate a design's plant over a scenario, with its observer beside it; or a plant alone, with given signals.

    Parameters
    ----------
    design : ObserverDesign, DescriptorSystem, TimeVaryingDescriptorSystem, DAEModel or Transformation
        A design of any method, the plant of a linear one of index 0 or 1; or a plant.
    scenario : Scenario, optional
        What happens; for a design.  For a time-varying plant or a DAE, ``inputs`` and ``faults`` are added to the
        nominal inputs and parameters, ``noise`` multiplies the deviations that the design states, and states without a
        value start where the observer does (those of a DAE at their nominal values).
    **signals
        For a plant alone.  A discrete linear one: ``steps`` samples, with ``u (steps, nu)``, ``f (steps, nf)``,
        ``d (steps, nd)``, ``w (steps, nw)`` and ``initial_state (nx,)``, zero by default.  A time-varying one: as
        `simulate_time_varying`.  A DAE: as `simulate_dae`.

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
    """
    design, _ = plant_and_recovery(design)
    for kind, plant_alone in _PLANT_SIMULATIONS.items():
        if isinstance(design, kind) and scenario is None:
            found: Trajectory = plant_alone(design, **signals)
            return found
    require_kind(design, ObserverDesign, "design", "an ObserverDesign, such as obsynth.load(path)")
    require_kind(scenario, Scenario, "scenario", "an obsynth.Scenario")
    if signals:
        raise SpecError(f"{', '.join(signals)}: the signals of a design are its scenario's.", path=next(iter(signals)))
    return _simulated(cast(ObserverDesign, design), cast(Scenario, scenario))


#: What simulates a plant alone.
_PLANT_SIMULATIONS: dict[type, Callable[..., Trajectory]] = {
    DescriptorSystem: simulate_plant,
    TimeVaryingDescriptorSystem: simulate_time_varying,
    DAEModel: simulate_dae,
}


def _simulated(design: ObserverDesign, scenario: Scenario) -> Simulation:
    bench = bench_of(design, scenario)
    runs = bench.run([scenario.seed])
    plant, dt = design.plant, bench.signals.dt
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
    return Simulation(
        time=dt * np.arange(bench.signals.steps, dtype=np.float64),
        states=runs.states[:, 0],
        outputs=runs.outputs[:, 0],
        inputs=runs.inputs[:, 0],
        faults=runs.faults[:, 0],
        disturbances=runs.disturbances[:, 0],
        estimates=runs.estimates[0],
        output_names=plant.output_names,
        input_names=plant.input_names,
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


def _sizes(errors: FloatArray) -> dict[str, float]:
    """Return root mean square and largest absolute value of what is not NaN."""
    known = errors[~np.isnan(errors)]
    if not known.size:
        return {"rmse": float("nan"), "largest": float("nan")}
    return {"rmse": float(np.sqrt(np.mean(known**2))), "largest": float(np.max(np.abs(known)))}

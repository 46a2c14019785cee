"""Simulation benches: plant, signals and observer of several designs, ready to run for many seeds."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeAlias

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics.arrays import FloatArray, read_only
from obsynth.numerics.continuous import first_order_hold
from obsynth.numerics.linear_recursions import driven
from obsynth.numerics.ranks import covariance_factor
from obsynth.observers.estimates import Estimates
from obsynth.observers.linear.observer import LinearObserver
from obsynth.observers.linear.sampled import sample_observer
from obsynth.observers.nonlinear.observer import DAEObserver
from obsynth.observers.nonlinear.region_observer import RegionObserver
from obsynth.observers.recursive.batches import run_batch
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.observers.scheduled.observer import ScheduledObserver
from obsynth.observers.window.observer import WindowObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.polytopic import PolytopicSystem
from obsynth.plants.sequences import MatrixSequence
from obsynth.plants.signal_names import index_of
from obsynth.results.design import ObserverDesign
from obsynth.simulation.dae import simulate_dae
from obsynth.simulation.linear import PlantRuns, scenario_runs, scenario_stepper, varying_runs
from obsynth.simulation.over_region import scenario_runs_over_region, scheduled_parameters
from obsynth.simulation.scenario import Scenario, observer_start
from obsynth.simulation.signals import ScenarioSignals, resolve, resolve_parameters
from obsynth.verification.over_tolerances.plants_of_the_box import drawn_points, plant_at

#: Warm-up ends when the effect of an error at the start has shrunk to this share of its largest, for good.
WARM_UP_SHARE = 0.01

#: Notes on simulations.
INPUTS_BETWEEN_SAMPLES = (
    "Between samples the plant is exact for signals that are constant or linear there; its observer is sampled by a "
    "first-order hold."
)

INPUTS_OVER_REGION = (
    "Between samples the plant follows its parameters, with signals that are constant or linear there; its observer "
    "takes steps of implicit Euler."
)

STABILISED = (
    "A stabilising state feedback (linear-quadratic, unit weights) was added for this simulation; the inputs include "
    "it."
)

#: Observers that a bench runs.
BenchObserver: TypeAlias = LinearObserver | RecursiveObserver | DAEObserver | ScheduledObserver | RegionObserver


@dataclass(frozen=True, eq=False)
class Runs:
    """What happened in several runs, ``(steps, runs, signals)`` each."""

    states: FloatArray
    outputs: FloatArray  # as measured
    inputs: FloatArray
    faults: FloatArray  # the parameters of a plant that has some
    disturbances: FloatArray
    rows: FloatArray  # the observer's states, faults, residuals
    observer: BenchObserver
    estimates_of_runs: tuple[Estimates, ...] = ()  # of an observer whose estimates say more than rows

    @property
    def estimates(self) -> tuple[Estimates, ...]:
        """What the observer says, one per run."""
        if not isinstance(self.observer, LinearObserver):
            return self.estimates_of_runs
        return tuple(self.observer.split(self.rows[:, run]) for run in range(self.rows.shape[1]))


@dataclass(frozen=True, eq=False)
class Bench:
    """A design and a scenario, ready to run; it can be sent to another process, with a model that is data."""

    signals: ScenarioSignals
    observer: BenchObserver  # in discrete time, but for a scheduled one
    initial_state: FloatArray
    fault_signals: slice
    estimated: tuple[int, ...]  # which of the true faults are estimated
    notes: tuple[str, ...]
    #: The plant alone, once for each seed.
    simulated: Callable[[Sequence[int]], PlantRuns]
    #: Rows of the observer from outputs and inputs of several runs, and its estimates where they say more than rows.
    observed: Callable[[FloatArray, FloatArray], tuple[FloatArray, tuple[Estimates, ...]]]
    estimated_states: tuple[int, ...] | None = None  # which states are estimated, where only some are

    def run(self, seeds: Sequence[int]) -> Runs:
        """Run the plant and the observer, once for each seed."""
        states, outputs, inputs, faults, disturbances = self.simulated(seeds)
        rows, estimates = self.observed(outputs, inputs)
        return Runs(states, outputs, inputs, faults, disturbances, rows, self.observer, estimates)

    @property
    def onset(self) -> int | None:
        """First sample at which a fault acts, or a faulty sensor; `None` if there is none."""
        return self.signals.first_fault(self.fault_signals)

    def true_states(self, states: FloatArray) -> FloatArray:
        """Return of the plant's states ``(..., nx)`` those that the observer estimates, or all where it is none."""
        return states if self.estimated_states is None else states[..., list(self.estimated_states)]

    def warm_ups(self) -> tuple[int | None, int | None]:
        """Return from when the start no longer shows in the estimates of states, and of faults; 0 with deviations."""
        observer, steps = self.observer, self.signals.steps
        if isinstance(observer, (ScheduledObserver, RegionObserver)):
            forgotten = observer.rows_without_claim(self.signals.dt)
            end_of_start = forgotten if forgotten < steps else None
            return end_of_start, end_of_start
        if not isinstance(observer, LinearObserver):
            return 0, 0

        def end(rows: slice, delays: tuple[int, ...]) -> int | None:
            outputs, sizes = observer.Cz[rows], np.zeros(steps)
            for k in range(steps):
                sizes[k] = np.linalg.norm(outputs)
                outputs = outputs @ observer.Az
            late = np.flatnonzero(sizes > WARM_UP_SHARE * np.max(sizes))
            first_free = max(int(late[-1]) + 1 if late.size else 0, *delays, 0)
            return first_free if first_free < steps else None

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
    notes = ((not plant.is_discrete, INPUTS_BETWEEN_SAMPLES), (stepper.feedback is not None, STABILISED))
    return Bench(
        drive,
        observer,
        start,
        slice(plant.nu, plant.nu + plant.nf),
        tuple(index_of(name, plant.fault_names, what="The plant") for name in observer.fault_names),
        tuple(text for holds, text in notes if holds),
        partial(scenario_runs, drive, stepper, (plant.nu, plant.nu + plant.nf)),
        partial(_linear_rows, observer, begin, ramp),
        _some_states(observer, plant),
    )


def _some_states(observer: LinearObserver, plant: Any) -> tuple[int, ...] | None:
    """Return which states of the plant an observer estimates that is only for some."""
    names = observer.state_names
    if not names or names == plant.state_names:
        return None
    return tuple(index_of(name, plant.state_names, what="The plant") for name in names)


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
    """Return a design and a scenario, ready to run.

    A scenario may say where states of the plant as written begin: those that were eliminated follow from the others.
    """
    known = getattr(design.plant, "state_names", ())
    written = () if design.recovery is None else design.recovery.names
    eliminated = [name for name in scenario.initial_state if name in written and name not in known]
    if not eliminated:
        return _bench_of(design, scenario)
    kept = {name: value for name, value in scenario.initial_state.items() if name not in eliminated}
    bench = _bench_of(design, scenario.replace(initial_state=kept))
    return replace(bench, notes=(*bench.notes, *_other_beginnings(design, scenario, eliminated, bench)))


def _other_beginnings(
    design: ObserverDesign, scenario: Scenario, eliminated: Sequence[str], bench: Bench
) -> Iterator[str]:
    """Yield what a scenario says of states that follow from others, where it shows that they begin elsewhere."""
    from obsynth.results.number_texts import number

    recovery, plant = design.recovery, design.plant
    if recovery is None or not isinstance(plant, DescriptorSystem):
        return
    begins = bench.signals.at_begin[0]
    follows = recovery.from_state @ bench.initial_state + recovery.from_input @ begins[: plant.nu]
    follows = follows + recovery.from_fault @ begins[plant.nu : plant.nu + plant.nf]
    for name in eliminated:
        i = recovery.names.index(name)
        begin, stated = number(follows[i]), number(scenario.initial_state[name])
        if begin != stated and not recovery.from_disturbance[i].any():
            yield f"{name} follows from the other states: it begins at {begin}, not at {stated}."


def _bench_of(design: ObserverDesign, scenario: Scenario) -> Bench:
    """Return a design and a scenario of the states of its plant, ready to run."""
    if isinstance(design.observer, LinearObserver):
        return make_bench(design, scenario)
    if isinstance(design.observer, WindowObserver):
        raise SpecError(
            f"Design {design.name!r} is a test whose weights change with k: it cannot be simulated. Simulate the "
            "plant (obsynth.simulate(plant, scenario)) and run the test on the outputs (design.observer.run).",
            path="observer",
        )
    if isinstance(design.observer, ScheduledObserver):
        return _scheduled_bench(design, scenario)
    if isinstance(design.observer, RegionObserver):
        return _region_bench(design, scenario)
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
    true = inputs + drive.at_begin[:, :nu], theta + drive.at_begin[:, nu:]
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


def _scheduled_bench(design: ObserverDesign, scenario: Scenario) -> Bench:
    """Return a design over a region and a scenario with courses of its parameters."""
    plant, observer = design.scheduled
    for group, why in {
        "observer_state": "A scheduled observer starts at zero: leave observer_state out.",
        "stabilise": "No feedback is designed over a region: give inputs that keep the plant near its operating point.",
    }.items():
        if getattr(scenario, group):
            raise SpecError(why, path=group)
    drive = resolve(plant, scenario)
    parameters = scheduled_parameters(plant, scenario, drive.steps, drive.dt)
    start = np.array([scenario.initial_state.get(name, 0.0) for name in plant.state_names])
    return Bench(
        drive,
        observer,
        start,
        slice(plant.nu, plant.nu + plant.nf),
        tuple(index_of(name, plant.fault_names, what="The plant") for name in observer.fault_names),
        (*(() if plant.is_discrete else (INPUTS_OVER_REGION,)), *_measured_scheduling(plant)),
        partial(scenario_runs_over_region, plant, drive, parameters, start),
        partial(_scheduled_rows, observer, None if observer.dt else drive.dt),
    )


def _measured_scheduling(plant: PolytopicSystem) -> Iterator[str]:
    """Yield for each parameter that is an output of the plant that a scenario moves both apart."""
    scheduling = plant.scheduling
    for name, column in zip(scheduling.names, scheduling.read_names, strict=True):
        if column in plant.output_names:
            yield (
                f"In a log the parameter {name!r} is the output {column!r}; here it follows its profile of the "
                "scenario, and the output follows the plant: the two differ."
            )


def _scheduled_rows(
    observer: ScheduledObserver, sample_time: float | None, outputs: FloatArray, inputs: FloatArray
) -> tuple[FloatArray, tuple[Estimates, ...]]:
    """Return rows and estimates of a scheduled observer."""
    rows = [
        observer.record(outputs[:, run], inputs[:, run], sample_time=sample_time)[0] for run in range(outputs.shape[1])
    ]
    return np.stack(rows, axis=1), tuple(map(observer.split, rows))


def rows_without_claim(bench: Bench, runs: Runs) -> int:
    """Return in how many samples of the first run an observer over a region claims nothing; 0 of other observers."""
    observer, outputs, inputs = bench.observer, runs.outputs[:, 0], runs.inputs[:, 0]
    if isinstance(observer, ScheduledObserver):
        sample_time = None if observer.dt else bench.signals.dt
        return int(np.sum(~observer.record(outputs, inputs, sample_time=sample_time)[1]))
    return int(np.sum(~observer.record(outputs, inputs)[1])) if isinstance(observer, RegionObserver) else 0


def _region_bench(design: ObserverDesign, scenario: Scenario) -> Bench:
    """Return a design over a region of a nonlinear plant and a scenario."""
    _, observer = design.over_region
    model = observer.model
    drive = resolve_parameters(model, scenario, dt=observer.dt)
    begin = np.array([scenario.initial_state.get(name, value) for name, value in model.states.items()])
    nu = len(model.input_names)
    inputs, parameters = model.nominal_input + drive.at_begin[:, :nu], model.nominal_parameters + drive.at_begin[:, nu:]
    noise = dict(design.options.get("noise") or {}) if drive.noise else {}
    return Bench(
        drive,
        observer,
        begin,
        slice(nu, None),
        tuple(index_of(name, model.parameter_names, what="The plant") for name in observer.fault_names),
        ("The plant was integrated by Radau IIA, with inputs constant during each step.",),
        partial(_region_plant, observer, noise, drive, begin, inputs, parameters),
        partial(_region_rows, observer),
    )


def _region_plant(
    observer: RegionObserver,
    noise: Mapping[str, float],
    drive: ScenarioSignals,
    begin: FloatArray,
    inputs: FloatArray,
    parameters: FloatArray,
    seeds: Sequence[int],
) -> PlantRuns:
    """Run the nonlinear plant once for each seed, with the noise of its sensors and the drift of its faults."""
    model, dt = observer.model, observer.dt
    sensors = np.array([noise.get(name, 0.0) for name in model.output_names])
    drifts = np.array([noise.get(name, noise.get(f"der({name})", 0.0)) for name in model.parameter_names])
    R = np.diag((drive.noise * sensors) ** 2 + drive.deviations**2)
    states, clean, moved = [], [], []
    for seed in seeds:
        steps = np.random.default_rng([seed, 1]).standard_normal(parameters.shape) * drive.noise * drifts * np.sqrt(dt)
        theta = parameters + np.cumsum(steps, axis=0) - steps[:1]
        run = simulate_dae(model, inputs, dt=dt, parameters=theta, initial_state=begin, R=R, seed=seed)
        states.append(run.states)
        clean.append(run.outputs)
        moved.append(theta)
    outputs = drive.measured(np.stack(clean, axis=1))
    shared = np.broadcast_to(inputs[:, None], (len(inputs), len(seeds), inputs.shape[1]))
    none = np.zeros((len(inputs), len(seeds), 0))
    return np.stack(states, axis=1), outputs, shared, np.stack(moved, axis=1), none


def _region_rows(
    observer: RegionObserver, outputs: FloatArray, inputs: FloatArray
) -> tuple[FloatArray, tuple[Estimates, ...]]:
    """Return rows and estimates of an observer over a region."""
    rows = [observer.record(outputs[:, run], inputs[:, run])[0] for run in range(outputs.shape[1])]
    return np.stack(rows, axis=1), tuple(map(observer.split, rows))


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
    rows = np.stack(
        [np.hstack([estimate.states, estimate.faults, estimate.residuals]) for estimate in estimates], axis=1
    )
    return rows, estimates


def _recursive_estimates(observer: RecursiveObserver, outputs: FloatArray, inputs: FloatArray) -> tuple[Estimates, ...]:
    """Return the estimates of every run; gains and covariances depend on no data, unless the observer resets."""
    runs = outputs.shape[1]
    resets = observer.adaptation is not None and bool(observer.adaptation.reset)
    if runs == 1 or resets or not observer.is_plain:
        return tuple(observer.run(outputs[:, run], inputs, compiled=False) for run in range(runs))
    first = observer.run(outputs[:, 0], inputs, compiled=False)
    batch = run_batch(observer, np.swapaxes(outputs[:, 1:], 0, 1), inputs)
    width = first.innovations.shape[1]
    estimates = [first]
    for states, parameters, innovations in zip(batch.states, batch.faults, batch.innovations, strict=True):
        own_innovations = read_only(innovations[:, :width])
        nis = read_only(_squares(own_innovations, first.regressors, parameters))
        estimates.append(replace(first, states=states, faults=parameters, innovations=own_innovations, nis=nis))
    return tuple(estimates)


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

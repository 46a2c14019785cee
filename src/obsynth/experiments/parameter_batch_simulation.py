"""Plant, scenario and recursive observer side by side: time-varying plants many runs at once, DAEs one by one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics.arrays import FloatArray, read_only
from obsynth.numerics.covariances import covariance_factor
from obsynth.observers.dae.estimates import DAEEstimates
from obsynth.observers.dae.observer import DAEObserver
from obsynth.observers.recursive.estimates import RecursiveEstimates
from obsynth.observers.recursive.gain_schedule import run_batch
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.plants.sequences import MatrixSequence
from obsynth.results.design import ObserverDesign
from obsynth.simulation.dae import simulate_dae
from obsynth.simulation.parameter_scenario_signals import resolve_recursive
from obsynth.simulation.scenario import Scenario
from obsynth.simulation.scenario_signals import Drive
from obsynth.simulation.time_varying import varying_runs

RowEstimates: TypeAlias = RecursiveEstimates | DAEEstimates


@dataclass(frozen=True, eq=False)
class RecursiveRuns:
    """What happened in several runs.

    Fields: states, outputs: ``(steps, runs, nx)`` and ``(steps, runs, ny)``, outputs as measured; those of a
    time-varying plant begin with y(1); inputs, parameters: ``(steps, nu)`` and ``(steps, nq)``, of all runs; estimates:
    One per run.
    """

    states: FloatArray
    outputs: FloatArray
    inputs: FloatArray
    parameters: FloatArray
    estimates: tuple[RowEstimates, ...]


@dataclass(frozen=True, eq=False)
class RecursiveBench:
    """A recursive design and a scenario, ready to run; it can be sent to another process if the model is data.

    Fields: drive: Signals, as they differ from their nominal values; observer: The observer, with the plant;
    initial_state: ``(nx,)``: true state at the start, as asked for; inputs, parameters: ``(steps, nu)`` and ``(steps,
    nq)``: the true signals.
    """

    drive: Drive
    observer: RecursiveObserver | DAEObserver
    initial_state: FloatArray
    inputs: FloatArray
    parameters: FloatArray

    @property
    def onset(self) -> int | None:
        """First sample at which a parameter is not nominal or a sensor is faulty."""
        return self.drive.first_fault(slice(self.inputs.shape[1], None))

    def run(self, seeds: Sequence[int]) -> RecursiveRuns:
        """Run the plant and the observer, once for each seed."""
        if isinstance(self.observer, DAEObserver):
            return self._run_dae(self.observer, seeds)
        return self._run_varying(self.observer, seeds)

    def _run_varying(self, observer: RecursiveObserver, seeds: Sequence[int]) -> RecursiveRuns:
        steps = self.drive.steps
        mu, nu = np.zeros((steps, len(seeds), observer.plant.ne)), np.zeros((steps - 1, len(seeds), observer.plant.ny))
        process, sensing = _factors(observer.Q, steps), _factors(observer.R, steps - 1)
        for run, seed in enumerate(seeds):
            rng = np.random.default_rng(seed)
            if self.drive.noise:
                mu[:, run] = self.drive.noise * _drawn(process, rng)
                nu[:, run] = self.drive.noise * _drawn(sensing, rng)
            if self.drive.deviations.any():
                nu[:, run] += self.drive.deviations * rng.standard_normal(nu[:, run].shape)
        states, clean = varying_runs(
            observer.plant, parameters=self.parameters, inputs=self.inputs, initial_state=self.initial_state,
            equation_noise=mu, output_noise=nu,
        )  # fmt: skip
        outputs = self.drive.measured(clean)
        return RecursiveRuns(states, outputs, self.inputs, self.parameters, self._watched(observer, outputs))

    def _watched(self, observer: RecursiveObserver, outputs: FloatArray) -> tuple[RowEstimates, ...]:
        """Return the estimates of every run; gains and covariances are those of the first, unless the observer resets.

        They depend on no data: the other runs are one matrix product a step for all of them.
        """
        runs = outputs.shape[1]
        if runs == 1 or (observer.adaptation is not None and observer.adaptation.reset):
            return tuple(observer.run(outputs[:, run], self.inputs, compiled=False) for run in range(runs))
        first = observer.run(outputs[:, 0], self.inputs, compiled=False)
        others = run_batch(observer, np.swapaxes(outputs[:, 1:], 0, 1), self.inputs)
        width = first.innovations.shape[1]
        found = [first]
        for states, parameters, innovations in zip(others.states, others.parameters, others.innovations, strict=True):
            seen = read_only(innovations[:, :width])
            nis = read_only(_squares(seen, first.regressors, parameters))
            found.append(replace(first, states=states, parameters=parameters, innovations=seen, nis=nis))
        return tuple(found)

    def _run_dae(self, observer: DAEObserver, seeds: Sequence[int]) -> RecursiveRuns:
        share = self.drive.noise**2
        states, outputs, estimates = [], [], []
        for seed in seeds:
            truth = simulate_dae(
                observer.model, self.inputs, dt=observer.dt, parameters=self.parameters,
                initial_state=self.initial_state, Q=share * observer.Q if share else None,
                R=share * observer.R + np.diag(self.drive.deviations**2), seed=seed,
            )  # fmt: skip
            measured = self.drive.measured(truth.outputs[:, None])[:, 0]
            states.append(truth.states)
            outputs.append(measured)
            estimates.append(observer.run(measured, self.inputs))
        return RecursiveRuns(
            np.stack(states, axis=1), np.stack(outputs, axis=1), self.inputs, self.parameters, tuple(estimates)
        )


def make_recursive_bench(design: ObserverDesign, scenario: Scenario) -> RecursiveBench:
    """Return the bench of a recursive design and a scenario."""
    observer = design.observer
    if isinstance(observer, DAEObserver):
        model = observer.model
        drive = resolve_recursive(model, scenario, dt=observer.dt)
        start, inputs, theta = model.nominal_state, model.nominal_input, model.nominal_parameters
    elif isinstance(observer, RecursiveObserver):
        adaptation = observer.adaptation
        drive = resolve_recursive(observer.plant, scenario, dt=observer.dt)
        start, inputs = observer.initial_state, np.zeros(observer.plant.nu)
        theta = np.zeros(observer.plant.nq) if adaptation is None else adaptation.initial_parameters
    else:
        raise SpecError("The design is linear: use make_bench.", path="design")
    names = observer.state_names
    begin = np.array([scenario.initial_state.get(name, value) for name, value in zip(names, start, strict=True)])
    nu = len(inputs)
    return RecursiveBench(drive, observer, begin, inputs + drive.left[:, :nu], theta + drive.left[:, nu:])


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

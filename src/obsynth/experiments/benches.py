"""Plants with parameters side by side with their observers, and the bench of any design."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from obsynth.experiments.batch_simulation import Bench, Runs, make_bench
from obsynth.numerics.arrays import FloatArray, read_only
from obsynth.numerics.covariances import covariance_factor
from obsynth.observers.dae.observer import DAEObserver
from obsynth.observers.estimates import Estimates
from obsynth.observers.linear.observer import LinearObserver
from obsynth.observers.recursive.gain_schedule import run_batch
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.plants.sequences import MatrixSequence
from obsynth.results.design import ObserverDesign
from obsynth.simulation.dae import simulate_dae
from obsynth.simulation.scenario import Scenario
from obsynth.simulation.scenario_signals import resolve_parameters
from obsynth.simulation.time_varying import varying_runs


@dataclass(frozen=True, eq=False)
class ParameterBench(Bench):
    """A recursive or nonlinear design and a scenario; true ``inputs (steps, nu)`` and ``parameters (steps, nq)``."""

    observer: RecursiveObserver | DAEObserver
    inputs: FloatArray
    parameters: FloatArray

    def run(self, seeds: Sequence[int]) -> Runs:
        """Run the plant and the observer, once for each seed."""
        if isinstance(self.observer, DAEObserver):
            return self._run_dae(self.observer, seeds)
        return self._run_varying(self.observer, seeds)

    def _run_varying(self, observer: RecursiveObserver, seeds: Sequence[int]) -> Runs:
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
        outputs = np.moveaxis(observer.timing.arriving(np.moveaxis(self.drive.measured(clean), 1, 0)), 0, 1)
        return self._runs(states, outputs, self._watched(observer, outputs))

    def _watched(self, observer: RecursiveObserver, outputs: FloatArray) -> tuple[Estimates, ...]:
        """Return the estimates of every run; gains and covariances depend on no data, unless the observer resets."""
        runs = outputs.shape[1]
        resets = observer.adaptation is not None and bool(observer.adaptation.reset)
        if runs == 1 or resets or not observer.is_plain:
            return tuple(observer.run(outputs[:, run], self.inputs, compiled=False) for run in range(runs))
        first = observer.run(outputs[:, 0], self.inputs, compiled=False)
        others = run_batch(observer, np.swapaxes(outputs[:, 1:], 0, 1), self.inputs)
        width = first.innovations.shape[1]
        found = [first]
        for states, parameters, innovations in zip(others.states, others.faults, others.innovations, strict=True):
            seen = read_only(innovations[:, :width])
            nis = read_only(_squares(seen, first.regressors, parameters))
            found.append(replace(first, states=states, faults=parameters, innovations=seen, nis=nis))
        return tuple(found)

    def _run_dae(self, observer: DAEObserver, seeds: Sequence[int]) -> Runs:
        share = self.drive.noise**2
        states, outputs, estimates = [], [], []
        for seed in seeds:
            truth = simulate_dae(
                observer.model, self.inputs, dt=observer.dt, parameters=self.parameters,
                initial_state=self.initial_state, Q=share * observer.Q if share else None,
                R=share * observer.R + np.diag(self.drive.deviations**2), seed=seed,
            )  # fmt: skip
            measured = observer.timing.arriving(self.drive.measured(truth.outputs[:, None])[:, 0])
            states.append(truth.states)
            outputs.append(measured)
            estimates.append(observer.run(measured, self.inputs))
        return self._runs(np.stack(states, axis=1), np.stack(outputs, axis=1), tuple(estimates))

    def _runs(self, states: FloatArray, outputs: FloatArray, estimates: tuple[Estimates, ...]) -> Runs:
        steps, runs = outputs.shape[:2]
        inputs, parameters = (
            np.broadcast_to(signal[:, None], (steps, runs, signal.shape[1]))
            for signal in (self.inputs, self.parameters)
        )
        rows = np.stack([np.hstack([found.states, found.faults, found.residuals]) for found in estimates], axis=1)
        none = np.zeros((steps, runs, 0))
        return Runs(states, outputs, inputs, parameters, none, rows, self.observer, estimates)


def bench_of(design: ObserverDesign, scenario: Scenario) -> Bench:
    """Return a design and a scenario, ready to run."""
    if isinstance(design.observer, LinearObserver):
        return make_bench(design, scenario)
    observer: RecursiveObserver | DAEObserver
    if isinstance(design.observer, DAEObserver):
        observer = design.observer
        model = observer.model
        drive = resolve_parameters(model, scenario, dt=observer.dt)
        start, inputs, theta = model.nominal_state, model.nominal_input, model.nominal_parameters
        note = "The plant was integrated by Radau IIA, with inputs constant during each step."
    else:
        observer = design.recursive[1]
        adaptation = observer.adaptation
        drive = resolve_parameters(observer.plant, scenario, dt=observer.dt)
        start, inputs = observer.initial_state, np.zeros(observer.plant.nu)
        note = "The model begins with y(1): the first row of the outputs is empty."
        theta = np.zeros(observer.plant.nq) if adaptation is None else adaptation.initial_parameters
    names = observer.state_names
    begin = np.array([scenario.initial_state.get(name, value) for name, value in zip(names, start, strict=True)])
    nu, estimated = len(inputs), tuple(range(len(observer.fault_names)))
    true = inputs + drive.left[:, :nu], theta + drive.left[:, nu:]
    true = inputs + drive.left[:, :nu], theta + drive.left[:, nu:]
    return ParameterBench(drive, observer, begin, slice(nu, None), estimated, (note,), *true)


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

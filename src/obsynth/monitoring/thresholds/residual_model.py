"""The model of a residual without faults, driven by disturbances and noise: ``e = V E x - z`` at the samples.

``e+ = Phi e + Gamma d + w - By_h n``, ``r = -C e + Dd d + Dy_h n``, ``e(0) = V E x(0) - z(0) + Gamma_1 n(0)``: held
d, process noise w gathered over an interval, sensor noise n.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from obsynth.errors import SpecError
from obsynth.methods.registry import error_model
from obsynth.monitoring.thresholds.between_samples import IntersampleErrorSystem
from obsynth.monitoring.thresholds.watched_rows import Watched
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.continuous import first_order_hold
from obsynth.numerics.norms import output_covariance
from obsynth.observers.linear.observer import LinearObserver
from obsynth.observers.linear.sampled import sample_observer
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.transformations.sampling import discretise
from obsynth.results.design import ObserverDesign
from obsynth.simulation.profiles import SAMPLE_SLACK, Additive, Random
from obsynth.simulation.scenario import Scenario, observer_start
from obsynth.simulation.signals import ScenarioSignals, resolve
from obsynth.verification.error_system import ErrorModel


def schur_form(matrix: FloatArray) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return ``T, Q`` with ``A = Q T Q'``, T triangular (complex): its powers keep the eigenvalues, however large
    entries of A are that cancel."""
    if not matrix.size:
        return matrix, matrix
    from scipy.linalg import schur

    triangular, basis = schur(matrix, output="complex")
    return triangular, basis


@dataclass(frozen=True, eq=False)
class ResidualModel:
    """``e+ = A e + Bd d + Bw w``, ``r = C e + Dd d + Dw w`` at the samples, without faults, w of unit covariance."""

    A: FloatArray
    C: FloatArray
    Bd: FloatArray
    Dd: FloatArray
    Bw: FloatArray
    Dw: FloatArray
    fault_C: FloatArray
    fault_Dd: FloatArray
    fault_Dw: FloatArray
    steps: int
    start: FloatArray  # ``(n,)``: e there
    bounds: FloatArray  # ``(nd,)``: largest absolute values of disturbances, or infinite
    means: FloatArray  # ``(nd,)``: of what is random in them, as deviations
    deviations: FloatArray
    steady: tuple[bool, ...]  # nothing but what is random, all the time
    errors: ErrorModel  # with the noise of the scenario
    continuous: ContinuousDesign | None = None
    sampled: IntersampleErrorSystem | None = None  # of a plant on samples, where the continuous one behind it is known

    def held(self) -> ResidualModel:
        """Return the model of a sampled plant for disturbances that are held between samples; a continuous design takes
        signals as they are."""
        return replace(self, sampled=None)

    @property
    def initial_error(self) -> float:
        """Norm of e at the start of the scenario."""
        return float(np.linalg.norm(self.start))

    def powers(self) -> list[FloatArray]:
        """Return ``A^k`` for every sample."""
        triangular, basis = schur_form(self.A)
        power = np.eye(len(self.A), dtype=triangular.dtype)
        powers: list[FloatArray] = []
        while len(powers) < self.steps:
            powers.append(np.asarray((basis @ power @ basis.conj().T).real))
            power = np.triu(power @ triangular)
        return powers

    @property
    def noisy(self) -> bool:
        """Whether white noise reaches the residual."""
        return bool(self.Bw.any() or self.Dw.any())

    def fault_scales(self) -> FloatArray:
        """Return ``(nf,)``: deviations of the fault estimates, for disturbances of theirs, or of half their bound."""
        half_bounds = np.where(np.isfinite(self.bounds), self.bounds, 0.0) / 2.0
        sizes = np.where(self.deviations > 0.0, self.deviations, half_bounds)
        covariance = output_covariance(
            self.A,
            np.hstack([self.Bd * sizes, self.Bw]),
            self.fault_C,
            np.hstack([self.fault_Dd * sizes, self.fault_Dw]),
        )
        scales = np.sqrt(np.abs(np.diag(covariance)))
        largest = float(np.max(scales, initial=0.0))
        # What nothing disturbs is compared as it is, in the units of what is disturbed most.
        return np.where(scales > 0.0, scales, largest if largest > 0.0 else 1.0)


@dataclass(frozen=True, eq=False)
class ContinuousDesign:
    """The errors of a continuous design from sample to sample, by the recursion of the module's text, w sensors first;
    and what a bound at the samples is made of; ``rows`` are watched; ``endless``: the record may have any length."""

    errors: ErrorModel
    dt: float
    rows: slice
    endless: bool

    @property
    def plant(self) -> DescriptorSystem:
        """The plant, with the noise of the scenario."""
        return self.errors.plant

    @property
    def observer(self) -> LinearObserver:
        """The observer, in continuous time."""
        return self.errors.observer

    @cached_property
    def between(self) -> IntersampleErrorSystem:
        """The design on samples; raises `SpecError` where what is watched has no bound."""
        return IntersampleErrorSystem.of(
            self.plant, self.observer, self.errors.own, self.dt, rows=self.rows, endless=self.endless
        )

    def gathered_noise(self, smooth: DescriptorSystem) -> FloatArray:
        """Return a factor ``(n, m)`` of what process noise adds to the states of the plant in a sample."""
        process = smooth.Bw[:, smooth.Bw.any(axis=0)]
        return _gathered(smooth.A, process, self.dt) if process.shape[1] else np.zeros((smooth.nx, 0))

    @cached_property
    def recursion(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Matrices of e, d and w in ``e+``."""
        process = self.plant.Bw.any(axis=0)
        if (process & self.sensors).any():
            raise SpecError(
                "One noise acts on the plant and on a sensor, which has no model between samples: state two.",
                path="noise",
            )
        transition, held, _ = first_order_hold(self.observer.Az, self.errors.disturbance, self.dt)
        measured = -sample_observer(self.observer, self.dt).By @ self.plant.Dw[:, self.sensors]
        gathered = _gathered(self.observer.Az, self.errors.noise[:, process], self.dt)
        return transition, held, np.hstack([measured, gathered])

    @property
    def sensors(self) -> NDArray[np.bool_]:
        """Which noise acts on sensors ``(nw,)``."""
        return np.asarray(self.plant.Dw.any(axis=0))

    def direct(self, rows: slice) -> FloatArray:
        """Return the direct effect of w on some rows of output at a sample."""
        of_sensors = sample_observer(self.observer, self.dt).Dy[rows] @ self.plant.Dw[:, self.sensors]
        return np.hstack([of_sensors, np.zeros((len(of_sensors), self.recursion[2].shape[1] - of_sensors.shape[1]))])

    @property
    def start_noise(self) -> FloatArray:
        """From the noise of the first sample to e ``(n, sensors)``."""
        ramp = first_order_hold(self.observer.Az, self.observer.By, self.dt)[2]
        return np.asarray(ramp @ self.plant.Dw[:, self.sensors])

    @property
    def sensor_noise(self) -> tuple[FloatArray, FloatArray]:
        """From noise drawn as straight lines between samples, to e' and to what is watched."""
        return self.errors.noise[:, self.sensors], self.errors.output(self.rows)[3][:, self.sensors]


def _gathered(A: FloatArray, noise: FloatArray, dt: float) -> FloatArray:
    """Return a factor of what noise ``(n, m)`` adds to states in a sample."""
    plant = DescriptorSystem(None, A, C=np.eye(len(A)), Bw=noise)
    return np.asarray(discretise(plant, dt).plant.Bw)


def noisy_plant(plant: DescriptorSystem, scenario: Scenario, drive: ScenarioSignals) -> DescriptorSystem:
    """Return a plant with the noise of a scenario: its own, as often, and that of the sensors."""
    return plant.replace(
        Bw=np.hstack([scenario.noise * plant.Bw, np.zeros((plant.nx, plant.ny))]),
        Dw=np.hstack([scenario.noise * plant.Dw, np.diag(drive.deviations)]),
        noise_names=None,
    )


def residual_model(
    design: ObserverDesign, scenario: Scenario, *, endless: bool = False, watched: Watched = Watched.RESIDUALS
) -> ResidualModel:
    """Return the model of what is ``watched`` of a design on a scenario, zero but for errors."""
    plant, observer = design.linear
    drive = resolve(plant, scenario)
    noisy = noisy_plant(plant, scenario, drive)
    if not observer.residual_names:
        raise SpecError(f"Design {design.name!r} has no residual to monitor.", path="observer")
    errors = replace(error_model(design), plant=noisy)
    start = np.array([scenario.initial_state.get(name, 0.0) for name in plant.state_names])
    # Modes of the plant that the errors hold beside the observer's own state begin at zero in it.
    begun = np.zeros(errors.observer.order)
    begun[: observer.order] = observer_start(scenario, observer.order)
    initial = errors.own @ (plant.E @ start) - begun
    rows = watched.rows(observer)
    reading, _, direct_d, direct_w = errors.output(rows)
    faults, _, faults_d, faults_w = errors.fault_output
    bounds, means, deviations, steady = _disturbances(scenario, plant.disturbance_names, drive.steps, drive.dt)
    a, driven, noise, continuous = errors.Az, errors.disturbance, errors.noise, None
    if not plant.is_discrete:
        continuous = ContinuousDesign(errors, drive.dt, rows, endless)
        a, driven, noise = continuous.recursion
        direct_w, faults_w = continuous.direct(rows), continuous.direct(observer.fault_rows)
    between = None
    if plant.is_discrete and plant.nd and design.source is not None and design.source.sample_time is not None:
        between = IntersampleErrorSystem.of_sampled(design.source.plant, plant, observer, errors.own, rows=rows)
    return ResidualModel(
        A=a,
        C=-reading,
        Bd=driven,
        Dd=direct_d,
        Bw=noise,
        Dw=direct_w,
        fault_C=-faults,
        fault_Dd=faults_d,
        fault_Dw=faults_w,
        steps=drive.steps,
        start=initial,
        bounds=bounds,
        means=means,
        deviations=deviations,
        steady=steady,
        errors=errors,
        continuous=continuous,
        sampled=between,
    )


def largest_disturbances(scenario: Scenario, names: tuple[str, ...], dt: float) -> FloatArray:
    """Return the largest absolute value of each disturbance ``(nd,)`` in a whole scenario; infinite where it has none.

    Whoever looks at fewer samples has the bounds of all: a disturbance may begin, or grow, after an observer settled.
    """
    return _disturbances(scenario, names, int(scenario.horizon / dt + SAMPLE_SLACK) + 1, dt)[0]


def _disturbances(
    scenario: Scenario, names: tuple[str, ...], steps: int, dt: float
) -> tuple[FloatArray, FloatArray, FloatArray, tuple[bool, ...]]:
    totals, steady = np.zeros((3, len(names))), []
    for i, name in enumerate(names):
        fixed, calm = np.zeros(steps), True
        for profile in scenario.disturbances.get(name, ()):  # type: ignore[union-attr]
            if isinstance(profile, Random):
                calm &= bool(profile.active(steps, dt).all())
                totals[:, i] += profile.moments()
            else:
                fixed, calm = fixed + cast(Additive, profile).sampled(steps, dt)[0], False
        totals[0, i] += np.max(np.abs(fixed))
        steady.append(calm)
    return totals[0], totals[1], np.sqrt(totals[2]), tuple(steady)

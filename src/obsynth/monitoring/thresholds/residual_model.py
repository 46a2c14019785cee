"""The model of a residual without faults, driven by disturbances and noise, at the samples.

With the error ``e = V E x - z``,

    e+ = Phi e + Gamma d + w - By_h n,    r = -C e + Dd d + Dy_h n,    e(0) = V E x(0) - z(0) + Gamma_1 n(0),

where d is held between samples, w is the process noise integrated over an interval, and n is the noise of the sensors.
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
    """Return the complex Schur form ``T, Q`` with ``A = Q T Q'``.

    Powers of T have the right eigenvalues even where large entries of A cancel.
    """
    if not matrix.size:
        return matrix, matrix
    from scipy.linalg import schur

    triangular, basis = schur(matrix, output="complex")
    return triangular, basis


@dataclass(frozen=True, eq=False)
class ResidualModel:
    """The model ``e+ = A e + Bd d + Bw w``, ``r = C e + Dd d + Dw w`` at the samples, without faults.

    The noise w has unit covariance.  ``fault_C``, ``fault_Dd`` and ``fault_Dw`` give the errors of the fault estimates
    in the same way.
    """

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
    start: FloatArray  # ``(n,)``: e at the first sample
    bounds: FloatArray  # ``(nd,)``: largest absolute values of the disturbances, or infinite
    means: FloatArray  # ``(nd,)``: means of the random parts of the disturbances
    deviations: FloatArray  # ``(nd,)``: their standard deviations
    steady: tuple[bool, ...]  # whether a disturbance is random and stationary, without any other part
    errors: ErrorModel  # with the noise of the scenario
    continuous: ContinuousDesign | None = None
    sampled: IntersampleErrorSystem | None = None  # of a sampled plant whose continuous model is known

    def held(self) -> ResidualModel:
        """Return the model for disturbances that are held between samples; that of a continuous design does not
        change."""
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
        """Return the deviations of the fault estimates ``(nf,)``.

        A disturbance without a standard deviation counts with half of its bound.
        """
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
        # An estimate that nothing disturbs has no scale of its own: it takes the largest one.
        return np.where(scales > 0.0, scales, largest if largest > 0.0 else 1.0)


@dataclass(frozen=True, eq=False)
class ContinuousDesign:
    """The errors of a continuous design from sample to sample, by the recursion in the module's docstring.

    Parameters
    ----------
    errors : ErrorModel
        In continuous time.  In w, the noise of the sensors comes first.
    dt : float
        Seconds between samples.
    rows : slice
        The rows of the output that are watched.
    endless : bool
        Whether a record may have any length.
    """

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
        """The errors between samples; raises `SpecError` where the watched rows have no bound."""
        return IntersampleErrorSystem.of(
            self.plant, self.observer, self.errors.own, self.dt, rows=self.rows, endless=self.endless
        )

    def gathered_noise(self, smooth: DescriptorSystem) -> FloatArray:
        """Return a factor ``(n, m)`` of the covariance that process noise adds to the states in an interval."""
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
        """Effect of the sensors' noise at the first sample on e ``(n, sensors)``."""
        ramp = first_order_hold(self.observer.Az, self.observer.By, self.dt)[2]
        return np.asarray(ramp @ self.plant.Dw[:, self.sensors])

    @property
    def sensor_noise(self) -> tuple[FloatArray, FloatArray]:
        """Effects of the sensors' noise, linear between samples, on the derivative of e and on the watched rows."""
        return self.errors.noise[:, self.sensors], self.errors.output(self.rows)[3][:, self.sensors]


def _gathered(A: FloatArray, noise: FloatArray, dt: float) -> FloatArray:
    """Return a factor of the covariance that white noise ``(n, m)`` adds to the states in an interval."""
    plant = DescriptorSystem(None, A, C=np.eye(len(A)), Bw=noise)
    return np.asarray(discretise(plant, dt).plant.Bw)


def noisy_plant(plant: DescriptorSystem, scenario: Scenario, drive: ScenarioSignals) -> DescriptorSystem:
    """Return a plant with the noise of a scenario: a multiple of its own noise, and the noise of the sensors."""
    return plant.replace(
        Bw=np.hstack([scenario.noise * plant.Bw, np.zeros((plant.nx, plant.ny))]),
        Dw=np.hstack([scenario.noise * plant.Dw, np.diag(drive.deviations)]),
        noise_names=None,
    )


def residual_model(
    design: ObserverDesign, scenario: Scenario, *, endless: bool = False, watched: Watched = Watched.RESIDUALS
) -> ResidualModel:
    """Return the model of the ``watched`` rows of a design on a scenario without faults."""
    plant, observer = design.linear
    drive = resolve(plant, scenario)
    noisy = noisy_plant(plant, scenario, drive)
    if not observer.residual_names:
        raise SpecError(f"Design {design.name!r} has no residual to monitor.", path="observer")
    errors = replace(error_model(design), plant=noisy)
    start = np.array([scenario.initial_state.get(name, 0.0) for name in plant.state_names])
    # Modes of the plant that the error model has beside the observer's states are zero at the start of the observer.
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
    """Return the largest absolute value of each disturbance ``(nd,)`` in a whole scenario; infinite where unbounded.

    A test of fewer samples needs the same bounds, since a disturbance may begin or grow after the observer has settled.
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

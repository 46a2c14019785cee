"""Estimates of an observer with their names and delays, and their standard deviations where it has them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from obsynth.numerics.arrays import FloatArray, read_only
from obsynth.plants.signal_names import listed

NO_NUMBERS = read_only(np.zeros(0))

#: Standard deviations within which 95 % of a normal number lie: the width of bands, drawn or counted.
BAND_WIDTH = 1.96


def nothing() -> FloatArray:
    """Return an empty array: what an observer does not say."""
    return NO_NUMBERS


@dataclass(frozen=True, eq=False)
class Estimates:
    """What an observer says, one row per sample; of a batch there is an axis of trials before the samples.

    Every observer gives the first eight; recursive and nonlinear ones say besides how far their estimates may be off,
    and what their innovations are.  Arrays that an observer does not know are empty, and deviations NaN.

    Parameters
    ----------
    states : FloatArray
        ``(samples, nx)``; column i estimates state i at ``k - state_delays[i]``.
    faults : FloatArray
        ``(samples, nf)``; column i estimates fault i at ``k - fault_delays[i]``.  The faults of a plant with parameters
        are these: `parameters` is another name.
    residuals : FloatArray
        ``(samples, nr)``; of a nonlinear observer one column, the scaled residual of the equations in each step.
    state_names, fault_names, residual_names : tuple of str
        Names of the columns.
    state_delays, fault_delays : tuple of int
        Delays in samples.
    state_deviations : FloatArray
        ``(samples, nx)``: standard deviations; infinite where missing samples leave a state undetermined.
    fault_covariances : FloatArray
        ``(samples, nf, nf)``: the covariance of the estimates while the parameters are constant (or walk as stated).
        S is none: with forgetting it says how much is still remembered.
    state_covariances, cross_covariances : FloatArray
        ``(samples, nx, nx)`` and ``(samples, nx, nf)``: of the states, and of states with faults, see
        `joint_covariances`; recursive observers (but for the compiled kernel) and nonlinear ones (but for batches).
    innovations : FloatArray
        ``(samples, m)``.  Recursive observers: whitened parity innovations of the model without parameters; NaN where
        there are fewer.  Nonlinear ones: in units of the outputs; NaN where a sample is missing.
    regressors : FloatArray
        ``(samples, m, nq)``, recursive observers: innovations minus regressors times the true parameters are white,
        N(0, I).
    scores, informations : FloatArray
        ``(samples, nq)`` and ``(samples, nq, nq)``, nonlinear observers with a forgetting factor: what each sample says
        of the parameters; to first order scores minus informations times the true parameters are white, N(0,
        informations).
    innovation_covariances : FloatArray
        ``(samples, ny, ny)``, nonlinear observers: what is expected of the innovations; rows and columns of missing
        samples are those of the identity.
    nis, nis_degrees : FloatArray
        ``(samples,)``: squared innovations in units of their covariance, at the parameters estimated one sample before,
        and degrees of freedom, not counting the parameters.
    excitation : FloatArray
        ``(samples,)``: least eigenvalue of the information on the parameters in the last `window` samples, in parameter
        units to the power -2 (nonlinear observers: in units of ``S_0^-1``, so that below one a window says less than
        was known before); (26) asks that it stays above some alpha > 0.  Zero while the window fills; NaN for the
        random walk of a recursive observer, which has no regressors (`certificate.claims` hold the least level).
    conditions : FloatArray
        ``(samples,)``, nonlinear observers: condition of (7).
    contraction : FloatArray
        ``(samples,)``, nonlinear observers: spectral radius of F (I - K H); an error of the state filter decays in
        about ``-1 / log`` of it steps, which should not be longer than the window ``1 / (1 - lambda)``.
    projection : FloatArray
        ``(nx,)``, nonlinear observers: how far the initial state was moved onto its constraint.
    received : numpy.ndarray
        ``(samples, ny)``, of bool: which outputs were there; recursive and nonlinear observers.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]], C=[[1, 0], [0, 1]], Bf=[[1], [0]], Bd=[[0], [1]], dt=1.0
    ... )
    >>> design = obsynth.fault_estimation_filter(plant)
    >>> run = obsynth.simulate(design, obsynth.Scenario(horizon=30, faults={"f1": obsynth.Step(size=1.0)}))
    >>> run.estimates.fault_names, run.estimates.faults.shape
    (('f1',), (31, 1))
    """

    states: FloatArray
    faults: FloatArray
    residuals: FloatArray
    state_names: tuple[str, ...]
    fault_names: tuple[str, ...]
    residual_names: tuple[str, ...]
    state_delays: tuple[int, ...]
    fault_delays: tuple[int, ...]
    state_deviations: FloatArray = field(default_factory=nothing)
    fault_covariances: FloatArray = field(default_factory=nothing)
    state_covariances: FloatArray = field(default_factory=nothing)
    cross_covariances: FloatArray = field(default_factory=nothing)
    innovations: FloatArray = field(default_factory=nothing)
    regressors: FloatArray = field(default_factory=nothing)
    scores: FloatArray = field(default_factory=nothing)
    informations: FloatArray = field(default_factory=nothing)
    innovation_covariances: FloatArray = field(default_factory=nothing)
    nis: FloatArray = field(default_factory=nothing)
    nis_degrees: FloatArray = field(default_factory=nothing)
    excitation: FloatArray = field(default_factory=nothing)
    conditions: FloatArray = field(default_factory=nothing)
    contraction: FloatArray = field(default_factory=nothing)
    projection: FloatArray = field(default_factory=nothing)
    received: NDArray[np.bool_] = field(default_factory=lambda: NO_NUMBERS.astype(bool))

    def __post_init__(self) -> None:
        nf = len(self.fault_names)
        unknown = {"state_deviations": self.states.shape, "fault_covariances": (*self.faults.shape, nf)}
        for name, shape in unknown.items():
            if getattr(self, name) is NO_NUMBERS:
                object.__setattr__(self, name, np.broadcast_to(np.nan, shape))

    def __repr__(self) -> str:
        """Return names and values of one sample, names and the number of samples of a record."""
        names = (*self.state_names, *self.fault_names)
        if self.faults.size == len(self.fault_names) and self.states.size == len(self.state_names):
            values = np.concatenate([self.states.ravel(), self.faults.ravel()])
            return (
                f"<Estimates: {listed([f'{name} = {value:.4g}' for name, value in zip(names, values, strict=True)])}>"
            )
        deviations = ", with deviations" if self.has_deviations else ""
        return f"<Estimates of {self.faults.shape[-2]} samples: {listed(names) or 'nothing'}{deviations}>"

    @property
    def has_deviations(self) -> bool:
        """Whether the observer says how far its estimates may be off."""
        return not (np.isnan(self.state_deviations).all() and np.isnan(self.fault_covariances).all())

    @property
    def fault_deviations(self) -> FloatArray:
        """Standard deviations of the fault estimates ``(samples, nf)``; NaN where the observer knows none."""
        return np.asarray(np.sqrt(np.einsum("...ii->...i", self.fault_covariances)))

    @property
    def joint_covariances(self) -> FloatArray:
        """Covariances of states and faults together ``(samples, nx + nf, nx + nf)``; empty where they are not known."""
        if not self.state_covariances.size:
            return NO_NUMBERS
        across = self.cross_covariances
        return np.concatenate(
            [
                np.concatenate([self.state_covariances, across], axis=-1),
                np.concatenate([np.swapaxes(across, -1, -2), self.fault_covariances], axis=-1),
            ],
            axis=-2,
        )

    @property
    def parameters(self) -> FloatArray:
        """The estimates of the parameters ``(samples, nq)``: the same as `faults`."""
        return self.faults

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """The same as `fault_names`."""
        return self.fault_names

    @property
    def parameter_covariances(self) -> FloatArray:
        """The same as `fault_covariances`, ``(samples, nq, nq)``."""
        return self.fault_covariances

    @property
    def parameter_deviations(self) -> FloatArray:
        """The same as `fault_deviations`, ``(samples, nq)``."""
        return self.fault_deviations

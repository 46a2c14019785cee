"""The state and the rows of a recursive observer, and the estimates in them, with honest spreads."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.ranks import UNDETERMINED_SHARE
from obsynth.numerics.square_root_estimation import ParameterState
from obsynth.observers.estimates import Estimates
from obsynth.observers.recursive.settings import RecursiveSettings
from obsynth.observers.running import named_estimates


class RawEstimate(NamedTuple):
    """What is known at one sample."""

    k: int  # the sample
    x: FloatArray  # ``(nx,)``: the state estimate, with the parameters as they are estimated now
    factor: FloatArray  # ``(nx, any)``: square root of its covariance
    diffuse: FloatArray  # ``(nx, r)``: directions about which nothing is known
    parameters: ParameterState  # estimate and spreads; empty without parameters
    innovation: FloatArray  # ``(m,)``: whitened parity innovation of the model without parameters
    regressor: FloatArray  # ``(m, nq)``
    gap: FloatArray  # ``(m,)``: the innovation at the parameters estimated one sample before
    y: FloatArray  # ``(ny,)``: the outputs that were given, NaN where one was missing

    @property
    def theta(self) -> FloatArray:
        """The parameters ``(nq,)``."""
        return self.parameters.theta

    @property
    def parameter_covariance(self) -> FloatArray:
        """Covariance of `theta` ``(nq, nq)``."""
        return self.parameters.spread @ self.parameters.spread.T

    @property
    def state_deviations(self) -> FloatArray:
        """Standard deviations ``(nx,)`` of the states; infinite where one is undetermined."""
        deviations = np.sqrt(np.einsum("ij,ij->i", self.factor, self.factor))
        open_states = (np.abs(self.diffuse) > UNDETERMINED_SHARE).any(axis=1)
        return np.where(open_states, np.inf, deviations)

    @property
    def whitened(self) -> FloatArray:
        """The innovation in units of its standard deviations, ``(m,)``."""
        return self.innovation

    @property
    def nis(self) -> float:
        """Squared length of `gap`."""
        return float(self.gap @ self.gap)

    @property
    def score(self) -> FloatArray:
        """What the sample says of the parameters ``(nq,)``; nothing where they are states and have no regressor."""
        return np.asarray(self.regressor.T @ self.innovation[: len(self.regressor)])

    @property
    def information(self) -> FloatArray:
        """How much it says of them ``(nq, nq)``."""
        return np.asarray(self.regressor.T @ self.regressor)

    @property
    def is_finite(self) -> bool:
        """Whether no number has overflown; an undetermined state has a finite factor."""
        arrays = (self.x, self.factor, self.theta, self.parameters.spread, self.innovation)
        return all(bool(np.isfinite(array).all()) for array in arrays)


class RecursiveState(NamedTuple):
    """The state of a recursive observer."""

    k: int  # the next sample
    x: FloatArray  # ``(n,)``: estimate of the model without parameters, or of states and parameters of a random walk
    factor: FloatArray  # ``(n, any)``: square root of its covariance
    Upsilon: FloatArray  # ``(nx, nq)``
    diffuse: FloatArray  # ``(n, r)``: directions about which nothing is known
    parameters: ParameterState  # estimate and spreads
    u: FloatArray  # ``(nu,)``: the inputs of the sample before
    regressors: tuple[FloatArray, ...]  # of the latest samples
    # ``(any, 2)``: normalised squares of the latest innovations, and their degrees of freedom, for resets
    surprises: FloatArray
    resets: int  # how many there were
    refused: FloatArray  # ``(2, ny)``: outliers in a row, and at all


def recursive_estimates(
    observer: RecursiveSettings, rows: Sequence[RawEstimate], *, window: Sequence[FloatArray] | None = None
) -> Estimates:
    """Return the estimates in rows of a recursive observer: ``window (any, nq)``: regressors of the latest samples,
    when only the last row is given."""
    length = 1 if observer.adaptation is None else observer.adaptation.window
    levels = excitation_levels([row.regressor for row in rows] if window is None else list(window), length)
    levels = levels[len(levels) - len(rows) :]
    if observer.form == "random-walk":
        levels = np.full(len(rows), np.nan)
    nx, nq = observer.plant.nx, len(observer.fault_names)
    most = max((len(row.innovation) for row in rows), default=0)
    innovations, padded = np.full((len(rows), most), np.nan), np.full((len(rows), most, nq), np.nan)
    for i, row in enumerate(rows):
        innovations[i, : len(row.innovation)] = row.innovation
        if len(row.regressor):
            padded[i, : len(row.regressor)] = row.regressor
    return named_estimates(
        observer,
        states=np.array([row.x for row in rows]).reshape(len(rows), nx),
        state_deviations=np.array([row.state_deviations for row in rows]).reshape(len(rows), nx),
        faults=np.array([row.theta for row in rows]).reshape(len(rows), nq),
        fault_covariances=np.array([row.parameter_covariance for row in rows]).reshape(len(rows), nq, nq),
        state_covariances=np.array([_state_covariance(row) for row in rows]).reshape(len(rows), nx, nx),
        cross_covariances=np.array([_cross_covariance(row) for row in rows]).reshape(len(rows), nx, nq),
        innovations=innovations,
        regressors=padded,
        nis=np.array([row.nis for row in rows]),
        nis_degrees=np.array([float(len(row.innovation)) for row in rows]),
        excitation=levels,
        received=received_in(np.array([row.y for row in rows]).reshape(len(rows), observer.plant.ny)),
    )


def _state_covariance(row: RawEstimate) -> FloatArray:
    """Return the covariance of the states ``(nx, nx)``, infinite variances where missing samples leave one open."""
    found = row.factor @ row.factor.T
    unknown = np.isinf(row.state_deviations)
    found[unknown], found[:, unknown] = np.nan, np.nan
    found[unknown, unknown] = np.inf
    return np.asarray(found)


def _cross_covariance(row: RawEstimate) -> FloatArray:
    """Return the covariance of states and parameters ``(nx, nq)``: what their square roots have in common."""
    spread = row.parameters.spread
    shared = row.factor[:, row.factor.shape[1] - spread.shape[1] :]
    return np.asarray(shared @ spread.T)


def received_in(y: FloatArray) -> NDArray[np.bool_]:
    """Return which outputs were there, ``(samples, ny)`` and read-only; NaN marks those that were not."""
    received = ~np.isnan(y)
    received.setflags(write=False)
    return received


def excitation_levels(regressors: Sequence[FloatArray], window: int) -> FloatArray:
    """Return the least eigenvalue of ``sum G' G`` over the last ``window`` samples, zero while the window fills:
    ``regressors (any, nq)``."""
    nq = regressors[0].shape[1] if regressors else 0
    levels = np.zeros(len(regressors))
    if not nq or len(regressors) < window:
        return levels
    squares = np.array([regressor.T @ regressor for regressor in regressors])
    # Each window is summed anew: differences of cumulated sums would leave rounding of early, strong excitation.
    for start in range(len(regressors) - window + 1):
        total = squares[start : start + window].sum(axis=0)
        levels[start + window - 1] = float(np.linalg.eigvalsh(total)[0])
    return np.maximum(levels, 0.0)

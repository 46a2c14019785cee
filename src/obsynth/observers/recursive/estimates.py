"""What a recursive observer says, sample by sample, with honest spreads."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from obsynth.numerics.arrays import FloatArray, read_only

if TYPE_CHECKING:
    from obsynth.observers.recursive.recursion import RawEstimate
    from obsynth.observers.recursive.settings import RecursiveSettings

#: Share of a diffuse direction below which a state is held to be determined: rounding of an orthonormal basis.
UNDETERMINED_SHARE = 1e-8


@dataclass(frozen=True, eq=False)
class RecursiveEstimates:
    """Estimates of a recursive observer, one row per sample.

    Parameters
    ----------
    states : FloatArray
        ``(samples, nx)``: the states, with the parameters as estimated at the same sample.
    state_deviations : FloatArray
        ``(samples, nx)``: standard deviations; infinite where missing samples leave a state undetermined.
    parameters : FloatArray
        ``(samples, nq)``.
    parameter_covariances : FloatArray
        ``(samples, nq, nq)``: the covariance of the estimates, which S is not.
    innovations : FloatArray
        ``(samples, m)``: whitened parity innovations of the model without parameters; NaN where there are fewer.
    regressors : FloatArray
        ``(samples, m, nq)``: innovations minus regressors times the true parameters are white, N(0, I).
    nis : FloatArray
        ``(samples,)``: squared length of the innovation at the parameters estimated one sample before.
    nis_degrees : FloatArray
        ``(samples,)``: its degrees of freedom, not counting the parameters.
    excitation : FloatArray
        ``(samples,)``: least eigenvalue of the information on the parameters in the last `window` samples, in
        parameter units to the power -2; (26) asks that it stays above some alpha > 0.  Zero while the window fills;
        NaN for the random walk, which has no regressors (`certificate.claims` hold the least level).
    state_names, parameter_names : tuple of str
        Names of the columns.
    received : numpy.ndarray
        ``(samples, ny)``, of bool: which outputs were there.
    """

    states: FloatArray
    state_deviations: FloatArray
    parameters: FloatArray
    parameter_covariances: FloatArray
    innovations: FloatArray
    regressors: FloatArray
    nis: FloatArray
    nis_degrees: FloatArray
    excitation: FloatArray
    state_names: tuple[str, ...]
    parameter_names: tuple[str, ...]
    received: NDArray[np.bool_]

    @property
    def parameter_deviations(self) -> FloatArray:
        """Standard deviations of the parameters ``(samples, nq)``."""
        return np.asarray(np.sqrt(np.einsum("kii->ki", self.parameter_covariances)))

    @classmethod
    def of(
        cls, observer: RecursiveSettings, rows: Sequence[RawEstimate], *, window: Sequence[FloatArray] | None = None
    ) -> RecursiveEstimates:
        """Return the estimates in what a running observer gave.

        Parameters
        ----------
        observer : RecursiveObserver
            Whose rows they are.
        rows : sequence of RawEstimate
            May be empty.
        window : sequence of FloatArray, optional
            Regressors of the latest samples, when only the last row is given.
        """
        length = 1 if observer.adaptation is None else observer.adaptation.window
        regressors = [row.regressor for row in rows]
        levels = (
            excitation_levels(regressors, length)
            if window is None
            else excitation_levels(list(window), length)[-len(rows) :]
        )
        if observer.adaptation is not None and observer.adaptation.form == "random-walk":
            levels = np.full(len(rows), np.nan)
        nx, nq = observer.plant.nx, len(observer.fault_names)
        most = max((len(row.innovation) for row in rows), default=0)
        innovations, padded = np.full((len(rows), most), np.nan), np.full((len(rows), most, nq), np.nan)
        for i, row in enumerate(rows):
            innovations[i, : len(row.innovation)] = row.innovation
            if len(row.regressor):
                padded[i, : len(row.regressor)] = row.regressor
        spreads = np.array([row.parameters.spread @ row.parameters.spread.T for row in rows]).reshape(len(rows), nq, nq)
        parameters = np.array([row.parameters.theta for row in rows]).reshape(len(rows), nq)
        return cls(
            states=read_only(np.array([row.x for row in rows]).reshape(len(rows), nx)),
            state_deviations=read_only(np.array([deviations_of(row) for row in rows]).reshape(len(rows), nx)),
            parameters=read_only(parameters),
            parameter_covariances=read_only(spreads),
            innovations=read_only(innovations),
            regressors=read_only(padded),
            nis=read_only(np.array([row.nis for row in rows])),
            nis_degrees=read_only(np.array([float(len(row.innovation)) for row in rows])),
            excitation=read_only(levels),
            state_names=observer.state_names,
            parameter_names=observer.fault_names,
            received=received_in(np.array([row.y for row in rows]).reshape(len(rows), observer.plant.ny)),
        )


def received_in(y: FloatArray) -> NDArray[np.bool_]:
    """Return which outputs were there, ``(samples, ny)`` and read-only; NaN marks those that were not."""
    received = ~np.isnan(y)
    received.setflags(write=False)
    return received


def deviations_of(row: RawEstimate) -> FloatArray:
    """Return standard deviations ``(nx,)`` of the states; infinite where one is undetermined."""
    deviations = np.sqrt(np.einsum("ij,ij->i", row.factor, row.factor))
    open_states = (np.abs(row.diffuse) > UNDETERMINED_SHARE).any(axis=1)
    return np.where(open_states, np.inf, deviations)


def excitation_levels(regressors: Sequence[FloatArray], window: int) -> FloatArray:
    """Return the least eigenvalue of ``sum G' G`` over the last ``window`` samples, zero while the window fills.

    Shapes: ``regressors (any, nq)``.
    """
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

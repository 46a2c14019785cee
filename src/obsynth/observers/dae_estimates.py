"""What an observer of a DAE says, sample by sample, with honest spreads."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from obsynth.numerics.arrays import FloatArray, read_only

if TYPE_CHECKING:
    from obsynth.observers.dae import DAEObserver


@dataclass(frozen=True, eq=False)
class DAERow:
    """The estimates at one sample.

    Parameters
    ----------
    x, theta : FloatArray
        State after the measurement ``(nx,)`` and parameters ``(nq,)``.
    covariance, parameter_covariance : FloatArray
        Of their errors, ``(nx, nx)`` and ``(nq, nq)``.
    innovation : FloatArray
        ``(ny,)``, NaN where a sample is missing.
    nis, degrees : float
        Its square in units of its covariance, and degrees of freedom.
    information : FloatArray
        ``(nq, nq)``: what the sample says of the parameters.
    residual, condition, contraction : float
        Newton's scaled residual, the condition of (7), and the spectral radius of F (I - K H); zero, one and zero
        at k = 0, where no step was taken.
    moved : FloatArray
        ``(nx,)``: how far the state was put onto its constraint; zeros but at k = 0.
    """

    x: FloatArray
    theta: FloatArray
    covariance: FloatArray
    parameter_covariance: FloatArray
    innovation: FloatArray
    nis: float
    degrees: int
    information: FloatArray
    residual: float
    condition: float
    contraction: float
    moved: FloatArray


@dataclass(frozen=True, eq=False)
class DAEEstimates:
    """Estimates of an observer of a DAE, one row per sample.

    Parameters
    ----------
    states, state_deviations : FloatArray
        ``(samples, nx)``: after the measurement of the same sample, and standard deviations of their errors.
    parameters : FloatArray
        ``(samples, nq)``.
    parameter_covariances : FloatArray
        ``(samples, nq, nq)``: the covariance of the estimates while the parameters are constant (or walk as stated).
        S is none: with forgetting it says how much is still remembered.
    innovations : FloatArray
        ``(samples, ny)``, in units of the outputs; NaN where a sample is missing.
    nis, nis_degrees : FloatArray
        ``(samples,)``: squared innovations in units of their covariance, and degrees of freedom.
    excitation : FloatArray
        ``(samples,)``: least eigenvalue of the information on the parameters in the last `window` samples, in units of
        ``S_0^-1``: below one, a window says less than was known before.  Zero while the window fills.
    residuals, conditions : FloatArray
        ``(samples,)``: scaled residual of each step, and condition of (7).
    contraction : FloatArray
        ``(samples,)``: spectral radius of F (I - K H); an error of the state filter decays in about
        ``-1 / log`` of it steps, which should not be longer than the window ``1 / (1 - lambda)``.
    projection : FloatArray
        ``(nx,)``: how far the initial state was moved onto its constraint.
    state_names, parameter_names : tuple of str
        Names of the columns.
    """

    states: FloatArray
    state_deviations: FloatArray
    parameters: FloatArray
    parameter_covariances: FloatArray
    innovations: FloatArray
    nis: FloatArray
    nis_degrees: FloatArray
    excitation: FloatArray
    residuals: FloatArray
    conditions: FloatArray
    contraction: FloatArray
    projection: FloatArray
    state_names: tuple[str, ...]
    parameter_names: tuple[str, ...]

    @property
    def parameter_deviations(self) -> FloatArray:
        """Standard deviations of the parameters ``(samples, nq)``."""
        return np.asarray(np.sqrt(np.einsum("kii->ki", self.parameter_covariances)))

    @classmethod
    def of(
        cls, observer: DAEObserver, rows: Sequence[DAERow], *, informations: Sequence[FloatArray] | None = None
    ) -> DAEEstimates:
        """Return the estimates in what a running observer gave.

        Parameters
        ----------
        observer : DAEObserver
            Whose rows they are.
        rows : sequence of DAERow
            At least one.
        informations : sequence of FloatArray, optional
            Of the latest samples, when only the last row is given.
        """
        seen = [row.information for row in rows] if informations is None else list(informations)
        levels = _excitation(observer, seen)[-len(rows) :]
        variances = np.array([np.diag(row.covariance) for row in rows])
        nq = observer.model.nq
        return cls(
            read_only(np.array([row.x for row in rows])), read_only(np.sqrt(np.maximum(variances, 0.0))),
            read_only(np.array([row.theta for row in rows]).reshape(-1, nq)),
            read_only(np.array([row.parameter_covariance for row in rows]).reshape(-1, nq, nq)),
            read_only(np.array([row.innovation for row in rows])), read_only(np.array([row.nis for row in rows])),
            read_only(np.array([float(row.degrees) for row in rows])), read_only(levels),
            read_only(np.array([row.residual for row in rows])), read_only(np.array([row.condition for row in rows])),
            read_only(np.array([row.contraction for row in rows])), read_only(rows[0].moved),
            observer.state_names, observer.fault_names,
        )  # fmt: skip


def _excitation(observer: DAEObserver, informations: Sequence[FloatArray]) -> FloatArray:
    levels = np.zeros(len(informations))
    if not observer.model.nq:
        return levels
    root = np.linalg.cholesky(observer.initial_parameter_covariance)
    total = np.cumsum([root.T @ information @ root for information in informations], axis=0)
    for k in range(observer.window - 1, len(informations)):
        before = total[k - observer.window] if k >= observer.window else 0.0
        levels[k] = max(float(np.linalg.eigvalsh(total[k] - before)[0]), 0.0)
    return levels

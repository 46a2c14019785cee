"""Steps of the parameters of a recursive observer: as a random walk, or as (18) is printed.

They are the parameters of the equations that led to x(k + 1), or, with early constraints, those of x(k + 1) itself.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from obsynth.errors import PreconditionError
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.least_squares_step import LeastSquaresStep, least_squares_step, rank_revealing_step
from obsynth.observers.recursive.step_model import EarlyConstraintSteps, StepMatrices, StepModel


@dataclass
class RandomWalkParameterSteps:
    """The steps of a model with its parameters among the states, as a random walk. The state at k + 1 is ``[x(k+1);
    theta(k)]``: the parameters that acted in the step that led there. Their increment then is noise of an equation of
    its own, and no noise is correlated in time."""

    model: StepModel  # with parameters
    walk: FloatArray  # ``(nq, nq)``: square root of the covariance of one step of the walk

    def at(self, k: int) -> StepMatrices:
        """Return the matrices of the step from k to k + 1."""
        return with_walking_parameters(self.model.at(k), self.walk)


@dataclass
class WalkingEarlySteps(EarlyConstraintSteps):
    """Both at once: early constraints, and parameters that walk. An early equation of k + 1 holds for the parameters of
    k + 1, so the state at k + 1 is ``[x(k+1); theta(k+1)]``. The outputs still hold theta(k), which is theta(k + 1)
    without its last increment: that noise they share."""

    walk: FloatArray  # ``(nq, nq)``: square root of the covariance of one step of the walk

    def at(self, k: int) -> StepMatrices:
        """Return the matrices of the step from k to k + 1."""
        return self._augmented(super().at(k), self.walk)

    def first(self) -> StepMatrices:
        """Return the correction of x(0) and theta(0) by the algebraic equations of step 0."""
        return self._augmented(super().correction(0), np.zeros_like(self.walk))

    def correction(self, k: int) -> StepMatrices:
        """Return the correction of x(k) by the algebraic equations of step k, of parameters that walk until there."""
        return self._augmented(super().correction(k), self.walk)

    def _augmented(self, step: StepMatrices, walk: FloatArray) -> StepMatrices:
        ne, nq = len(step.A), len(walk)
        measured = len(step.Psi) - len(step.Dn)
        H = np.block([
            [step.H[:ne], np.zeros((ne, nq))], [np.zeros((nq, step.H.shape[1])), np.eye(nq)], [step.H[ne:], step.Psi],
        ])  # fmt: skip
        A = np.block([[step.A, step.Phi], [np.zeros((nq, step.A.shape[1])), np.eye(nq)]])
        width = step.noise.shape[1]
        noise = np.zeros((len(H), width + nq))
        noise[:ne, :width], noise[ne + nq :, :width] = step.noise[:ne], step.noise[ne:]
        noise[ne : ne + nq, width:] = walk
        noise[ne + nq : ne + nq + measured, width:] = step.Psi[:measured] @ walk
        return StepMatrices(
            np.asfortranarray(H), A, np.vstack([step.B, np.zeros((nq, step.B.shape[1]))]), np.zeros((len(A), 0)),
            np.zeros((len(step.Psi), 0)), step.Dn, noise,
        )  # fmt: skip


def with_walking_parameters(step: StepMatrices, walk: FloatArray) -> StepMatrices:
    """Return one step with its parameters among the states: ``walk (nq, nq)``."""
    ne, nx, nq = *step.A.shape, step.Phi.shape[1]
    E, C = step.H[:ne], step.H[ne:]
    H = np.block([[E, -step.Phi], [np.zeros((nq, nx)), np.eye(nq)], [C, step.Psi]])
    noise = np.zeros((len(H), step.noise.shape[1] + nq))
    noise[:ne, : step.noise.shape[1]], noise[ne + nq :, : step.noise.shape[1]] = step.noise[:ne], step.noise[ne:]
    noise[ne : ne + nq, step.noise.shape[1] :] = walk
    return StepMatrices(
        np.asfortranarray(H), np.block([[step.A, np.zeros((ne, nq))], [np.zeros((nq, nx)), np.eye(nq)]]),
        np.vstack([step.B, np.zeros((nq, step.B.shape[1]))]), np.zeros((ne + nq, 0)), np.zeros((len(C), 0)), step.Dn,
        noise,
    )  # fmt: skip


def posterior_residual(
    found: LeastSquaresStep,
    H: FloatArray,
    S: FloatArray,
    right: FloatArray,
    ne: int,
    *,
    unknown: FloatArray,
    columns: int = 1,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return what (18f) learns from: ``y - C x`` weighted by R, its regressor (18d), and a root of its covariance.

    Shapes: ``unknown (rows, r)``.

    References
    ----------
    .. [MoussaAli2013] Eqs. (18b), (18d), (18f).  Its covariance is not R but one of rank ``rank E + ny - nx``.
    """
    gaps = right[ne:] - H[ne:] @ found.estimate
    triangle = np.asarray(np.linalg.qr(S[ne:].T, mode="r")).T
    if not np.all(np.abs(np.diag(triangle)) > 0.0):
        raise PreconditionError("The literal form (18) divides by R, which is singular: use form 'innovation'.",
                                condition="R nonsingular")  # fmt: skip
    data = np.eye(len(H))
    gains = None if unknown.shape[1] else least_squares_step(H, S, data)
    if gains is None:
        # Undetermined directions lie in the null space of the outputs that are there: y - C xhat is what it is.
        gains = rank_revealing_step(H, S, data, unknown, mapped=len(H))
    spread = S[ne:] - H[ne:] @ gains.estimate @ S
    weighted = np.linalg.solve(triangle, np.hstack((gaps, spread)))
    regressor, end = slice(columns, gaps.shape[1]), gaps.shape[1]
    return weighted[:, :columns], -weighted[:, regressor], weighted[:, end:]

"""Steps of a model with its parameters among the states, as a random walk.

They are the parameters of the equations that led to x(k + 1), or, with early constraints, those of x(k + 1) itself.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.observers.recursive.step_model import EarlyConstraintSteps, StepMatrices, StepModel


@dataclass
class RandomWalkParameterSteps:
    """The steps of a model with its parameters among the states, as a random walk.

    The state at k + 1 is ``[x(k+1); theta(k)]``: the parameters that acted in the step that led there.  Their
    increment then is noise of an equation of its own, and no noise is correlated in time.

    Fields: model: With parameters; walk: ``(nq, nq)``: square root of the covariance of one step of the walk.
    """

    model: StepModel
    walk: FloatArray

    def at(self, k: int) -> StepMatrices:
        """Return the matrices of the step from k to k + 1."""
        return with_walking_parameters(self.model.at(k), self.walk)


@dataclass
class WalkingEarlySteps(EarlyConstraintSteps):
    """Both at once: early constraints, and parameters that walk.

    An early equation of k + 1 holds for the parameters of k + 1, so the state at k + 1 is ``[x(k+1); theta(k+1)]``.
    The outputs still hold theta(k), which is theta(k + 1) without its last increment: that noise they share.

    Fields: walk: ``(nq, nq)``: square root of the covariance of one step of the walk.
    """

    walk: FloatArray

    def at(self, k: int) -> StepMatrices:
        """Return the matrices of the step from k to k + 1."""
        return self._augmented(super().at(k), self.walk)

    def first(self) -> StepMatrices:
        """Return the correction of x(0) and theta(0) by the algebraic equations of step 0."""
        return self._augmented(super().first(), np.zeros_like(self.walk))

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
    """Return one step with its parameters among the states.

    Shapes: ``walk (nq, nq)``.
    """
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

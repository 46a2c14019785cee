"""The matrices of one step as the recursion needs them, with the two ways to rewrite a plant.

Early constraints: an equation of step k + 1 without x(k + 2) is an output of x(k + 1) already.
Random walk: the parameters become states, of the equations that led to x(k + 1), or of x(k + 1) itself with early
constraints.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from obsynth.analysis.time_varying import IntArray
from obsynth.analysis.zeros import leading_names
from obsynth.errors import PreconditionError, SpecError
from obsynth.models.sequences import MatrixSequence
from obsynth.models.time_varying import TimeVaryingDescriptorSystem
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.covariances import covariance_factor
from obsynth.numerics.ranks import OUTGROWN


class StepMatrices(NamedTuple):
    """One step ``E x(k+1) = A x(k) + B u(k) + Phi theta + q``, ``[y(k+1); Dn u(k+1)] = C x(k+1) + Psi theta + r``.

    Parameters
    ----------
    H : FloatArray
        ``(ne + ny, nx)``: E above C.
    A, B, Phi : FloatArray
        ``(ne, nx)``, ``(ne, nu)``, ``(ne, nq)``.
    Psi : FloatArray
        ``(ny, nq)``.
    Dn : FloatArray
        ``(ny - measured, nu)``: outputs that are made of the next input.
    noise : FloatArray
        ``(ne + ny, any)``: square root of the covariance of q and r.
    """

    H: FloatArray
    A: FloatArray
    B: FloatArray
    Phi: FloatArray
    Psi: FloatArray
    Dn: FloatArray
    noise: FloatArray


class StepModel(Protocol):
    """Something that knows the matrices of every step."""

    def at(self, k: int) -> StepMatrices:
        """Return the matrices of the step from k to k + 1."""
        ...


def stacked_noise(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the block-diagonal square root of two independent noises."""
    noise = np.zeros((len(first) + len(second), first.shape[1] + second.shape[1]))
    noise[: len(first), : first.shape[1]], noise[len(first) :, first.shape[1] :] = first, second
    return noise


def require_in_range(S: FloatArray, factor: FloatArray, k: int, state_names: Sequence[str]) -> None:
    """Raise `PreconditionError` when deviations outgrow double precision on the way to sample ``k``.

    Parameters
    ----------
    S : FloatArray
        Square root of the covariance of the data of a step.
    factor : FloatArray
        ``(nx or more, any)``: that of the state before it.
    k : int
        The sample that the step leads to.
    state_names : sequence of str
        Names of the first rows of ``factor``.
    """
    if float(np.max(np.abs(S), initial=0.0)) < OUTGROWN:
        return
    sizes = np.max(np.abs(np.nan_to_num(factor[: len(state_names)])), axis=1, initial=0.0)
    names = leading_names(sizes, state_names)
    raise PreconditionError(
        f"The errors outgrow double precision at k = {k}: the outputs do not show, or not often enough, what grows in "
        f"{', '.join(map(repr, names))}. Measure more, shorten the horizon, or leave out what grows unseen.",
        condition="bounded errors", signals=names,
    )  # fmt: skip


@dataclass
class PlantSteps:
    """The steps of a plant as it is.

    Parameters
    ----------
    plant : TimeVaryingDescriptorSystem
        The plant.
    Q, R : MatrixSequence
        ``(ne, ne)`` and ``(ny, ny)`` for each k.
    """

    plant: TimeVaryingDescriptorSystem
    Q: MatrixSequence
    R: MatrixSequence

    def __post_init__(self) -> None:
        self._constant: StepMatrices | None = None
        self._noise: FloatArray | None = None
        self._H: FloatArray | None = None
        self._Dn = np.zeros((0, self.plant.nu))
        self._noise_is_constant = self.Q.is_constant and self.R.is_constant
        self._H_is_constant = self.plant.E.is_constant and self.plant.C.is_constant
        self._is_constant = self._noise_is_constant and self._H_is_constant and self.plant.is_time_invariant

    def at(self, k: int) -> StepMatrices:
        """Return the matrices of the step from k to k + 1.

        Parameters
        ----------
        k : int
            Time index.
        """
        if self._constant is not None:
            return self._constant
        plant = self.plant
        noise, H = self._noise, self._H
        if noise is None:
            noise = stacked_noise(
                covariance_factor(self.Q.at(k), f"Q({k})"), covariance_factor(self.R.at(k), f"R({k})")
            )
            self._noise = noise if self._noise_is_constant else None
        if H is None:
            H = np.asfortranarray(np.vstack([plant.E.at(k + 1), plant.C.at(k + 1)]))
            self._H = H if self._H_is_constant else None
        found = StepMatrices(H, plant.A.at(k), plant.B.at(k), plant.Phi.at(k), plant.Psi.at(k), self._Dn, noise)
        self._constant = found if self._is_constant else None
        return found


@dataclass
class EarlySteps:
    """The steps of a plant with its algebraic equations used as outputs one step earlier.

    Parameters
    ----------
    plant : TimeVaryingDescriptorSystem
        The plant.
    Q, R : MatrixSequence
        Covariances; Q must not couple algebraic equations with the others.
    rows : IntArray
        The algebraic equations, see `obsynth.analysis.time_varying.algebraic_rows`.

    Raises
    ------
    SpecError
        No equation is algebraic.
    """

    plant: TimeVaryingDescriptorSystem
    Q: MatrixSequence
    R: MatrixSequence
    rows: IntArray

    def __post_init__(self) -> None:
        if not self.rows.size:
            raise SpecError(
                "early_constraints needs equations in which x(k+1) does not appear (rows of E that are zero for every "
                "k): this plant has none. Bring E into that form, or leave the option out.",
                path="method.options.early_constraints",
            )
        self.late = self.rows
        self.others = np.setdiff1d(np.arange(self.plant.ne), self.late)

    def _factors(self, k: int) -> tuple[FloatArray, FloatArray]:
        covariance = self.Q.at(k)
        if np.any(covariance[np.ix_(self.others, self.late)]):
            raise SpecError(
                f"Q({k}) couples the noise of algebraic equations with that of the others: early_constraints needs "
                "them independent.", path="method.options.early_constraints",
            )  # fmt: skip
        name = f"Q({k})"
        return (
            covariance_factor(covariance[np.ix_(self.others, self.others)], name),
            covariance_factor(covariance[np.ix_(self.late, self.late)], name),
        )

    def at(self, k: int) -> StepMatrices:
        """Return the matrices of the step from k to k + 1.

        Parameters
        ----------
        k : int
            Time index.
        """
        plant, late, others = self.plant, self.late, self.others
        H = np.vstack([plant.E.at(k + 1)[others], plant.C.at(k + 1), plant.A.at(k + 1)[late]])
        outputs = stacked_noise(covariance_factor(self.R.at(k), f"R({k})"), self._factors(k + 1)[1])
        return StepMatrices(
            np.asfortranarray(H), plant.A.at(k)[others], plant.B.at(k)[others], plant.Phi.at(k)[others],
            np.vstack([plant.Psi.at(k), plant.Phi.at(k + 1)[late]]), -plant.B.at(k + 1)[late],
            stacked_noise(self._factors(k)[0], outputs),
        )  # fmt: skip

    def first(self) -> StepMatrices:
        """Return the correction of x(0) by the algebraic equations of step 0: the prior is the 'equation'."""
        plant, late = self.plant, self.late
        H = np.vstack([np.eye(plant.nx), plant.A.at(0)[late]])
        noise = stacked_noise(np.zeros((plant.nx, 0)), self._factors(0)[1])
        return StepMatrices(
            H, np.eye(plant.nx), np.zeros((plant.nx, plant.nu)), np.zeros((plant.nx, plant.nq)),
            plant.Phi.at(0)[late], -plant.B.at(0)[late], noise,
        )  # fmt: skip


@dataclass
class WalkingSteps:
    """The steps of a model with its parameters among the states, as a random walk.

    The state at k + 1 is ``[x(k+1); theta(k)]``: the parameters that acted in the step that led there.  Their
    increment then is noise of an equation of its own, and no noise is correlated in time.

    Parameters
    ----------
    model : StepModel
        With parameters.
    walk : FloatArray
        ``(nq, nq)``: square root of the covariance of one step of the walk.
    """

    model: StepModel
    walk: FloatArray

    def at(self, k: int) -> StepMatrices:
        """Return the matrices of the step from k to k + 1.

        Parameters
        ----------
        k : int
            Time index.
        """
        return with_walking_parameters(self.model.at(k), self.walk)


@dataclass
class WalkingEarlySteps(EarlySteps):
    """Both at once: early constraints, and parameters that walk.

    An early equation of k + 1 holds for the parameters of k + 1, so the state at k + 1 is ``[x(k+1); theta(k+1)]``.
    The outputs still hold theta(k), which is theta(k + 1) without its last increment: that noise they share.

    Parameters
    ----------
    walk : FloatArray
        ``(nq, nq)``: square root of the covariance of one step of the walk.
    """

    walk: FloatArray

    def at(self, k: int) -> StepMatrices:
        """Return the matrices of the step from k to k + 1.

        Parameters
        ----------
        k : int
            Time index.
        """
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

    Parameters
    ----------
    step : StepMatrices
        With parameters.
    walk : FloatArray
        ``(nq, nq)``: square root of the covariance of one step of the walk.
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

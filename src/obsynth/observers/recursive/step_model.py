"""The matrices of one step of the recursion: of a plant as it is, with early constraints, or with random walks.

Early constraints: an equation of step k + 1 without x(k + 2) is an output of x(k + 1) already.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from obsynth.analysis.time_varying import IntArray
from obsynth.errors import PreconditionError, SpecError
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.ranks import covariance_factor, product_but_rounding
from obsynth.numerics.square_root_estimation import (
    OUTGROWN,
    LeastSquaresStep,
    Projection,
    Rounding,
    directions_of,
    noise_triangle,
    projected_step,
    projection_of,
    row_sizes,
)
from obsynth.plants.sequences import MatrixSequence
from obsynth.plants.signal_names import leading_names
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem

#: From so many rows on the noise that stays the same is brought to a triangle once, and only what moves is added to it.
MANY_ROWS = 100


class StepMatrices(NamedTuple):
    """One step ``E x(k+1) = A x(k) + B u(k) + Phi theta + q``, ``[y(k+1) - D u(k+1); Dn u(k+1)] = C x(k+1) + Psi theta
    + r``."""

    H: FloatArray  # ``(ne + ny, nx)``: E above C
    A: FloatArray  # A, B, Phi: ``(ne, nx)``, ``(ne, nu)``, ``(ne, nq)``
    B: FloatArray
    Phi: FloatArray
    Psi: FloatArray  # ``(ny, nq)``
    Dn: FloatArray  # ``(ny - measured, nu)``: outputs that are made of the next input
    D: FloatArray  # ``(measured, nu)``
    noise: FloatArray  # ``(ne + ny, any)``: square root of the covariance of q and r


def right_side(
    step: StepMatrices, x: FloatArray, Upsilon: FloatArray, before: FloatArray, y: FloatArray, u: FloatArray
) -> FloatArray:
    """Return the data of a step ``(rows, 1 + nq)``: of its state, inputs and outputs, and by its parameters."""
    ne, nq = len(step.A), Upsilon.shape[1]
    right = np.empty((len(step.H), 1 + nq), order="F")
    right[:ne, 0] = step.A.dot(x) + step.B.dot(before)
    right[ne : ne + len(y), 0] = y - step.D.dot(u)
    if len(step.Dn):
        right[ne + len(y) :, 0] = step.Dn @ u
    if nq:
        right[:ne, 1:] = step.A @ Upsilon + step.Phi
        right[ne:, 1:] = -step.Psi
    return right


def but_rounding_of_outputs(right: FloatArray, step: StepMatrices, y: FloatArray, u: FloatArray) -> FloatArray:
    """Return ``right (rows, 1 + nq)`` of `right_side` with a zero where ``y - D u`` is rounding of its two terms: a
    sensor without noise that reads a known input alone does not contradict that input."""
    outputs = slice(len(step.A), len(step.A) + len(y))
    cleared = right.copy(order="F")
    cleared[outputs, 0] = product_but_rounding(-step.D, u, y)
    return cleared


def terms_of_right_side(
    step: StepMatrices, x: FloatArray, Upsilon: FloatArray, before: FloatArray, y: FloatArray, u: FloatArray
) -> FloatArray:
    """Return how large the terms are that `right_side` adds, ``(rows, 1 + nq)``: an equation without noise is zero of
    an estimate that satisfies it, but for their rounding."""
    sizes = StepMatrices(*map(np.abs, step))._replace(D=-np.abs(step.D), Psi=-np.abs(step.Psi))
    return right_side(sizes, *map(np.abs, (x, Upsilon, before, y, u)))


def stacked_noise(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the block-diagonal square root of two independent noises."""
    noise = np.zeros((len(first) + len(second), first.shape[1] + second.shape[1]))
    noise[: len(first), : first.shape[1]], noise[len(first) :, first.shape[1] :] = first, second
    return noise


def rounding_of(step: StepMatrices, rounding: FloatArray) -> Rounding:
    """Return what no stated noise explains in the data of a step: what rounding made of the state before, ``rounding
    (n, any)``, and an error of each row in units of its entries."""
    entries = np.vstack([np.abs(step.A), np.zeros((len(step.H) - len(step.A), step.A.shape[1]))])
    lengths = np.sqrt(np.sum(step.H**2, axis=0) + np.sum(step.A**2, axis=0))
    sizes = np.max(np.maximum(np.abs(step.H), entries) / np.where(lengths > 0.0, lengths, 1.0), axis=1, initial=0.0)
    root = np.zeros((len(step.H), rounding.shape[1] + len(step.H)))
    root[: len(step.A), : rounding.shape[1]] = step.A @ rounding
    root[:, rounding.shape[1] :] = np.diag(sizes)
    rows = np.arange(len(step.H))
    measured = (rows >= len(step.A)) & (rows < len(step.H) - len(step.Dn))
    return Rounding(root, measured, bool(rounding.shape[1]))


def spreads(
    step: StepMatrices, factor: FloatArray, diffuse: FloatArray, k: int, state_names: Sequence[str]
) -> tuple[FloatArray, FloatArray]:
    """Return a root ``(rows, any)`` of the covariance of a step's data on the way to sample ``k``, and what is unknown
    in them ``(rows, r)``; raise `PreconditionError` where deviations outgrow double precision."""
    ne, rows, width = len(step.A), len(step.H), factor.shape[1]
    S = np.zeros((rows, max(width + step.noise.shape[1], rows)))
    S[:ne, :width] = step.A @ factor
    S[:, width : width + step.noise.shape[1]] = step.noise
    if not float(np.max(np.abs(S), initial=0.0)) < OUTGROWN:
        sizes = np.max(np.abs(np.nan_to_num(factor[: len(state_names)])), axis=1, initial=0.0)
        names = leading_names(sizes, state_names)
        raise PreconditionError(
            f"The errors outgrow double precision at k = {k}: they grow in states that the outputs do not observe, or "
            f"not often enough: {', '.join(map(repr, names))}. Measure more, shorten the horizon, or leave these "
            "states out.",
            condition="bounded errors",
            signals=names,
        )
    return S, np.vstack([step.A @ diffuse, np.zeros((rows - ne, diffuse.shape[1]))])


@dataclass
class StepModel:
    """The matrices of every step, with the parameters among the states where these walk at random.

    Then ``[x(k+1); theta(k)]`` is the state at k + 1: theta(k) acted in the step to k + 1, and its increment is noise
    of its own equation, not correlated in time. An algebraic equation used early holds for theta(k + 1), so that the
    state is ``[x(k+1); theta(k+1)]``; the outputs still hold theta(k), which is theta(k + 1) without its last
    increment: that noise they share.
    """

    plant: TimeVaryingDescriptorSystem
    Q: MatrixSequence  # Q, R: ``(ne, ne)`` and ``(ny, ny)`` for each k
    R: MatrixSequence
    #: Algebraic equations, of independent noise, that are used as outputs one step earlier, see
    #: `obsynth.analysis.time_varying.algebraic_rows`; none leaves the plant as it is.
    late: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.intp), kw_only=True)
    #: ``(nq, nq)``: square root of the covariance of one step of the walk.
    walk: FloatArray | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        plant = self.plant
        self.early = bool(self.late.size)
        self.others = np.setdiff1d(np.arange(plant.ne), self.late)
        self._constant: StepMatrices | None = None
        self._correction: StepMatrices | None = None
        self._H: FloatArray | None = None
        self._noise: FloatArray | None = None
        self._last: tuple[int, StepMatrices, StepMatrices] | None = None
        self._H_is_constant = plant.E.is_constant and plant.C.is_constant and (plant.A.is_constant or not self.early)
        self._noise_is_constant = self.Q.is_constant and self.R.is_constant
        self._is_constant = self._noise_is_constant and plant.is_time_invariant

    def _other(self, matrix: FloatArray) -> FloatArray:
        """Return the rows of a matrix of the equations that are not used early."""
        return matrix[self.others] if self.early else matrix

    def _factors(self, k: int) -> tuple[FloatArray, FloatArray]:
        """Return square roots of the covariances of the other equations' noise, and of that of those used early."""
        covariance, name = self.Q.at(k), f"Q({k})"
        if not self.early:
            return covariance_factor(covariance, name), np.zeros((0, 0))
        if np.any(covariance[np.ix_(self.others, self.late)]):
            raise SpecError(
                f"Q({k}) couples the noise of algebraic equations with that of the others: early_constraints needs "
                "them independent.",
                path="method.options.early_constraints",
            )
        return (
            covariance_factor(covariance[np.ix_(self.others, self.others)], name),
            covariance_factor(covariance[np.ix_(self.late, self.late)], name),
        )

    def without_walk(self, k: int) -> StepMatrices:
        """Return the matrices of the step from k to k + 1, as if the parameters did not walk."""
        if self._constant is not None:
            return self._constant
        plant, late = self.plant, self.late
        noise, H, Psi, Dn = self._noise, self._H, plant.Psi.at(k), np.zeros((0, plant.nu))
        if noise is None:
            outputs = covariance_factor(self.R.at(k), f"R({k})")
            if self.early:
                outputs = stacked_noise(outputs, self._factors(k + 1)[1])
            noise = stacked_noise(self._factors(k)[0], outputs)
            self._noise = noise if self._noise_is_constant else None
        if H is None:
            early_outputs = [plant.A.at(k + 1)[late]] if self.early else []
            H = np.asfortranarray(np.vstack([self._other(plant.E.at(k + 1)), plant.C.at(k + 1), *early_outputs]))
            self._H = H if self._H_is_constant else None
        if self.early:
            Psi, Dn = np.vstack([Psi, plant.Phi.at(k + 1)[late]]), -plant.B.at(k + 1)[late]
        A, B, Phi = (self._other(matrix.at(k)) for matrix in (plant.A, plant.B, plant.Phi))
        matrices = StepMatrices(H, A, B, Phi, Psi, Dn, plant.D.at(k + 1), noise)
        self._constant = matrices if self._is_constant else None
        return matrices

    def at(self, k: int) -> StepMatrices:
        """Return the matrices of the step from k to k + 1; the same object for the same step."""
        last = self._last
        if last is not None and last[0] == k:
            return last[2]
        step = self.without_walk(k)
        if self.walk is None:
            matrices = step
        elif last is not None and last[1] is step:
            matrices = last[2]
        else:
            matrices = with_walking_parameters(step, self.walk, early=self.early)
        self._last = (k, step, matrices)
        return matrices

    def first(self) -> StepMatrices | None:
        """Return the correction of x(0), and of parameters that walk, by the algebraic equations of step 0, where these
        are used early."""
        if not self.early:
            return None
        step = self._correction_without_walk(0)
        return step if self.walk is None else with_walking_parameters(step, np.zeros_like(self.walk), early=True)

    def correction(self, k: int) -> StepMatrices:
        """Return the correction of x(k) by the algebraic equations of step k, of parameters that walk until there."""
        step = self._correction_without_walk(k)
        return step if self.walk is None else with_walking_parameters(step, self.walk, early=True)

    def _correction_without_walk(self, k: int) -> StepMatrices:
        """Return the correction as if the parameters did not walk: what is known is the 'equation'."""
        if self._correction is not None:
            return self._correction
        plant, late = self.plant, self.late
        matrices = StepMatrices(
            np.vstack([np.eye(plant.nx), plant.A.at(k)[late]]),
            np.eye(plant.nx),
            np.zeros((plant.nx, plant.nu)),
            np.zeros((plant.nx, plant.nq)),
            plant.Phi.at(k)[late],
            -plant.B.at(k)[late],
            np.zeros((0, plant.nu)),
            stacked_noise(np.zeros((plant.nx, 0)), self._factors(k)[1]),
        )
        self._correction = matrices if self._is_constant else None
        return matrices


def with_walking_parameters(step: StepMatrices, walk: FloatArray, *, early: bool = False) -> StepMatrices:
    """Return one step with its parameters among the states: those before it, with early constraints those after it."""
    ne, nx, nq = *step.A.shape, step.Phi.shape[1]
    nothing, acting, rows, width = np.zeros((ne, nq)), step.Phi, len(step.H) + nq, step.noise.shape[1]
    below = [np.zeros((nq, nx)), np.eye(nq)]
    H = np.block([[step.H[:ne], nothing if early else -acting], below, [step.H[ne:], step.Psi]])
    A = np.block([[step.A, acting if early else nothing], below])
    noise = np.zeros((rows, width + nq))
    noise[:ne, :width], noise[ne + nq :, :width] = step.noise[:ne], step.noise[ne:]
    noise[ne : ne + nq, width:] = walk
    if early:
        measured = len(step.Psi) - len(step.Dn)
        noise[ne + nq : ne + nq + measured, width:] = step.Psi[:measured] @ walk
    return StepMatrices(
        np.asfortranarray(H),
        A,
        np.vstack([step.B, np.zeros((nq, step.B.shape[1]))]),
        np.zeros((ne + nq, 0)),
        np.zeros((len(step.Psi), 0)),
        step.Dn,
        step.D,
        noise,
    )


def with_missing_inputs(step: StepMatrices, before: FloatArray | float, now: FloatArray | None) -> StepMatrices:
    """Return one step whose inputs have variances ``before (nu,)``, and those of its own sample ``now (nu,)``."""
    ne, nu = step.B.shape
    acting = np.zeros((len(step.H), 2 * nu))
    acting[:ne, :nu] = step.B * np.sqrt(before)
    if now is not None and len(step.Dn):
        acting[len(step.H) - len(step.Dn) :, nu:] = step.Dn * np.sqrt(now)
    if now is not None and len(step.D):
        measured = len(step.H) - len(step.Dn) - len(step.D)
        acting[measured : measured + len(step.D), nu:] = -step.D * np.sqrt(now)
    return step._replace(noise=np.hstack((step.noise, acting[:, acting.any(axis=0)])))


@dataclass(frozen=True, eq=False)
class PreparedStep:
    """One step with its factorisation."""

    step: StepMatrices  # which step it is
    projection: Projection | None  # of H; ``None`` where its rank has to be decided
    moved: FloatArray  # ``(rows, n)``: rotated A, empty without a projection
    # The transpose of the rotated noise ``(any, rows)``, empty without a projection; of many rows its triangle.
    known: FloatArray
    sizes: FloatArray | None  # of the rows of H, see `row_sizes`
    directions: int  # of the step's own noise, see `directions_of`

    @classmethod
    def of(cls, step: StepMatrices, last: PreparedStep | None) -> PreparedStep:
        """Prepare a step."""
        if last is not None and last.step is step:
            return last
        same = last if last is not None and last.step.H is step.H else None
        # Once for a run: a varying H is in the same units at every step.
        same_rows = last is not None and len(last.step.H) == len(step.H)
        sizes = last.sizes if last is not None and same_rows else row_sizes(step.H)
        projection = projection_of(step.H, sizes=sizes) if same is None else same.projection
        if projection is None:
            return cls(step, None, step.A[:0], step.noise[:0], sizes, 0)
        rotation = projection.rotation
        moved = rotation[:, : len(step.A)] @ step.A
        if same is not None and same.step.noise is step.noise:
            return cls(step, projection, moved, same.known, sizes, same.directions)
        rotated_noise = (rotation @ step.noise).T
        return cls(
            step,
            projection,
            moved,
            rotated_noise if len(rotation) < MANY_ROWS else noise_triangle(rotated_noise),
            sizes,
            directions_of(step.noise),
        )

    def taken(self, factor: FloatArray, right: FloatArray | None) -> LeastSquaresStep | None:
        """Take the step, or return ``None`` where a rank has to be decided; ``right`` is the identity by default."""
        if self.projection is None:
            return None
        rotation = self.projection.rotation
        width, rotated_noise, rows = factor.shape[1], self.known, len(rotation)
        if self.directions < rows and directions_of(factor) + self.directions < rows:
            return None
        # `dot` is `@` with half the overhead, which for few states is most of the time.
        data = rotation if right is None else rotation.dot(right)
        if rows >= MANY_ROWS:
            return projected_step(self.projection, (self.moved @ factor).T, data, known=rotated_noise)
        # As many rows as the projection has at least: what is missing (rectangular roots) are rows of zeros.
        noise = np.zeros((max(width + len(rotated_noise), rows), rows), order="F")
        noise[:width] = self.moved.dot(factor).T
        noise[width : width + len(rotated_noise)] = rotated_noise
        return projected_step(self.projection, noise, data)

"""Properties of a recursive observer that do not depend on data: contraction of errors, excitation, last gains."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from obsynth.analysis.time_varying import STEPS_WITHOUT_HORIZON
from obsynth.errors import SpecError
from obsynth.numerics.arrays import FloatArray, remembered
from obsynth.numerics.norms import spectral_radius
from obsynth.numerics.ranks import BOUNDARY_TOLERANCE
from obsynth.observers.recursive.estimates import excitation_levels
from obsynth.observers.recursive.gain_schedule import Gains, gain_steps, shared_gains
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.observers.recursive.sample import deviations_in
from obsynth.observers.recursive.steady_filter import settled_contraction

#: If a product of steps is below this, it is normalised, so that it does not underflow.
GONE = 1e-200

#: A product of later steps is normalised if its entries are so many times larger or smaller than one.
FAR_FROM_ONE = 1e20

#: A norm below this share of the largest one is smaller despite rounding of both.
NEAR_GROWTH = 1.0 - 1e-10

#: On shorter horizons an error may not have decayed yet, so that the contraction is only reported, and not checked.
STEPS_TO_CONTRACT = 50

#: For a constant plant with constant noise, so many steps are examined first.  If errors do not decay over these, or if
#: the gains still change, `FOLLOW_FURTHER` times as many are examined, up to all.
FIRST_FOLLOWED = 100

#: With more states fewer steps are examined first, since the work grows with the cube of the number of states.
MANY_STATES = 100

FEWEST_FOLLOWED = 60

FOLLOW_FURTHER = 3

#: Gains count as steady if they change by less than this share over the second half of the steps.
STEADY_GAINS = 1e-9

#: Errors with constant gains decay despite rounding if the spectral radius is below this.
CLEARLY_STABLE = 1.0 - 1e-6


@dataclass(frozen=True, eq=False)
class GainScheduleSummary:
    """Properties of the gains along the horizon."""

    steps: int  # number of examined steps
    # ``norm(product of L_k A_k)^(1 / steps)``, the mean factor of an error in a step.  If it is not below one, the same
    # over the second half of the horizon, or else the spectral radius of the steady state that the gains tend to.
    contraction: float
    settles: bool  # whether the contraction is that of the steady state, since errors do not decay in these steps
    growth: float  # largest norm of the product: the factor by which an error may grow before it decays
    span: str  # text on the steps that the contraction belongs to
    # ``(nx,)``: size of the product in each state after the last step, relative to the largest: where errors remain
    survivors: FloatArray
    # Least eigenvalue of the information on the parameters in any window, (26); NaN without parameters.
    excitation: float
    excitation_k: int  # last sample of that window
    L: FloatArray  # L and K: the gains (11) of the last step
    K: FloatArray
    deviations: FloatArray  # ``(nq,)``: standard deviations of the parameters after the last step
    # ``(nx,)``: standard deviations of the states after the last step for known parameters
    state_deviations: FloatArray


def examined_steps(observer: RecursiveObserver) -> int:
    """Return the number of steps of an observer's model that are examined."""
    steps = observer.plant.horizon or STEPS_WITHOUT_HORIZON
    return max(steps - 1, 1) if observer.early_constraints else steps


def gain_schedule_summary(observer: RecursiveObserver, *, gains: Gains = gain_steps) -> GainScheduleSummary:
    """Return the properties of the gains along the horizon."""
    steps = examined_steps(observer)
    learning = observer.adaptation is not None
    random_walk = observer.form == "random-walk"
    # The state filter and the regressors of a random walk are those of the model without the walk.
    plain = observer.without_walk
    all_steps = steps + int(observer.early_constraints)
    product, regressors, last = ErrorProduct(observer.plant.nx, _first_end(observer, all_steps)), [], None
    early_contraction: tuple[float, str] | None = None
    middle: FloatArray | None = None
    for gain_step in gains(plain, steps):
        last, early_contraction = gain_step, None
        regressors.append(gain_step.G)
        product.move(gain_step.gain[:, : len(gain_step.step.A)] @ gain_step.step.A)
        if product.done == product.steps // 2:
            middle = gain_step.gain
        if product.done == product.steps < all_steps:
            shrinks = product.contraction()[0] < 1.0
            if (shrinks or (early_contraction := product.contraction_of_kept_gains()) is not None) and (
                plain.plant.nx > MANY_STATES or _stays(gain_step.gain, middle)
            ):
                break
            product.go_on_to(end_of_steps(FOLLOW_FURTHER * product.steps, all_steps))
    if last is None:
        raise SpecError("The plant has no steps.", path="horizon")
    (contraction, span), ne = (
        early_contraction if early_contraction is not None else product.contraction(),
        len(last.step.A),
    )
    settled = settled_contraction(plain) if contraction >= 1.0 else None
    settles = settled is not None and settled < 1.0 - BOUNDARY_TOLERANCE
    if settled is not None and settles:
        contraction, span = settled, "of the steady state, which the gains tend to: errors have not shrunk yet"
    window = observer.adaptation.window if observer.adaptation is not None else 1
    levels = excitation_levels(regressors, window)[window - 1 :]
    deviations, state_deviations = deviations_in(last.spread), deviations_in(last.factor)
    if random_walk:
        *_, end = gains(observer, steps)
        lengths = deviations_in(end.factor)
        state_deviations, deviations = lengths[: observer.plant.nx], lengths[observer.plant.nx :]
    return GainScheduleSummary(
        steps=len(regressors),
        contraction=contraction,
        settles=settles,
        growth=product.growth,
        span=span,
        survivors=product.survivors,
        excitation=float(levels.min()) if learning and levels.size else float("nan"),
        excitation_k=int(levels.argmin()) + window if learning and levels.size else 0,
        L=last.gain[:, :ne],
        K=last.gain[:, ne:],
        deviations=deviations,
        state_deviations=state_deviations,
    )


@remembered
def shared_summary(observer: RecursiveObserver) -> GainScheduleSummary:
    """Return the same, computed once for an observer: for many states synthesis and verification would each take
    seconds, with the same constant matrices."""
    return gain_schedule_summary(observer, gains=shared_gains)


def _first_end(observer: RecursiveObserver, steps: int) -> int:
    """Return the number of steps that are examined first: all, except for a plant and noise that are constant."""
    plant = observer.plant
    alike = plant.is_time_invariant and observer.Q.is_constant and observer.R.is_constant
    if not alike or plant.horizon or observer.adaptation is not None:
        return steps
    if plant.nx <= MANY_STATES:
        return end_of_steps(FIRST_FOLLOWED, steps)
    return end_of_steps(max(FEWEST_FOLLOWED, round(steps * (MANY_STATES / plant.nx) ** 3)), steps)


def end_of_steps(steps: int, all_steps: int) -> int:
    """Return the next number of steps to examine: ``steps``, or all if these are at most twice as many.

    Less than half of the steps up to a later end may be done before it is set, since the second half is examined alone.
    """
    return steps if 2 * steps < all_steps else all_steps


def _stays(gain: FloatArray, before: FloatArray | None) -> bool:
    """Whether a gain is the same as some time before."""
    if before is None or before.shape != gain.shape:
        return False
    return bool(np.abs(gain - before).max(initial=0.0) <= STEADY_GAINS * np.abs(gain).max(initial=0.0))


class ErrorProduct:
    """The product of the matrices L_k A_k over a number of steps, with its largest norm."""

    def __init__(self, nx: int, steps: int) -> None:
        self.steps, self.done = steps, 0
        self.product, self.logarithm, self.growth = np.eye(nx), 0.0, 1.0
        self.factor = np.eye(nx)
        self.late, self.late_logarithm, self.middle = np.eye(nx), 0.0, 0.0
        self.ended: tuple[float, str] | None = None

    def go_on_to(self, steps: int) -> None:
        """Set a later end, up to which less than half of the steps are done."""
        self.steps = steps
        self.late, self.late_logarithm = np.eye(len(self.late)), 0.0

    def move(self, factor: FloatArray) -> None:
        """Multiply by the matrix of one more step; once errors are zero or overflow, only the count changes."""
        self.done += 1
        if self.ended is not None:
            return
        self.factor = factor
        self.product = factor.dot(self.product)
        if not self._goes_on():
            return
        if self.done == self.steps // 2:
            self.middle = self._length()
        elif self.done > self.steps // 2:
            self.late = factor.dot(self.late)
            # Normalised only if its size is far from one, since singular values in every step would be most of the
            # work.
            if not is_near_one(self.late):
                late_size = norm_or_bound(self.late)
                self.late, self.late_logarithm = self.late / late_size, self.late_logarithm + float(np.log(late_size))

    def _goes_on(self) -> bool:
        """Update the growth, and normalise the product where it would underflow; return whether to go on."""
        if len(self.product) <= MANY_STATES:
            flat = self.product.ravel()
            # The Frobenius norm is an upper bound of the norm, and at most sqrt(nx) times larger.  Unlike `dot`, `vdot`
            # does not warn of overflow.
            above = math.sqrt(np.vdot(flat, flat))
            if len(flat) * GONE < above < NEAR_GROWTH * self.growth:
                return True
        size = norm_or_bound(self.product)
        self.growth = max(self.growth, size * float(np.exp(min(self.logarithm, 0.0))))
        if not size < 1.0 / GONE:
            self.growth, self.ended = float("inf"), (float("inf"), "from the start")
        elif size == 0.0:
            self.ended = 0.0, "from the start"
        elif size < GONE:
            self.product, self.logarithm = self.product / size, self.logarithm + float(np.log(size))
        return self.ended is None

    def _length(self) -> float:
        return self.logarithm + float(np.log(np.linalg.norm(self.product, 2)))

    @property
    def survivors(self) -> FloatArray:
        """Size of the product in each state, relative to its largest ``(nx,)``."""
        sizes = np.max(np.abs(self.product), axis=1)
        return np.asarray(sizes / max(float(sizes.max()), np.finfo(np.float64).tiny))

    def contraction_of_kept_gains(self) -> tuple[float, str] | None:
        """Return the contraction of one step with the last gains as constant gains; ``None`` if errors do not decay."""
        radius = 1.0 if self.ended is not None else spectral_radius(self.factor)
        span = "of one step with the last gains, were they kept: errors have not shrunk as a whole yet"
        return (radius, span) if radius < CLEARLY_STABLE else None

    def contraction(self) -> tuple[float, str]:
        """Return the mean factor of an error in a step, and a text on the steps that it belongs to."""
        if self.ended is not None:
            return self.ended
        steps = self.steps
        last = self._length()
        per_step = float(np.exp(last / steps))
        # With very different units, or if errors grow before they decay, an error of a slow mode may not be smaller at
        # the end of the horizon than at its start.  Then errors must decay over the second half, in norm and by the
        # spectral radius.
        radius = spectral_radius(self.late) if per_step >= 1.0 else 1.0
        slowest = max(last - self.middle, self.late_logarithm + float(np.log(radius)) if radius else -np.inf)
        second = float(np.exp(slowest / (steps - steps // 2)))
        if per_step >= 1.0 and second < 1.0 - BOUNDARY_TOLERANCE:
            return second, "over the second half"
        return per_step, "from the start"


def is_near_one(matrix: FloatArray) -> bool:
    """Whether the largest entry of a matrix is within `FAR_FROM_ONE` of one; the sum of squares often suffices."""
    squares = float(np.vdot(matrix, matrix))
    if matrix.size / FAR_FROM_ONE < squares < FAR_FROM_ONE:
        return True
    return bool(1.0 / FAR_FROM_ONE < float(np.abs(matrix).max()) < FAR_FROM_ONE)


def norm_or_bound(matrix: FloatArray) -> float:
    """Return the 2-norm of a matrix; for a large one an upper bound, without singular values."""
    if len(matrix) <= MANY_STATES:
        # The same as `norm`, without its checks of axes, which would run thousands of times.
        return float(np.linalg.svd(matrix, compute_uv=False).max(initial=0.0))
    return float(np.sqrt(np.linalg.norm(matrix, 1) * np.linalg.norm(matrix, np.inf)))

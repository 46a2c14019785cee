"""Proofs of the two norms of a detection filter, in outward rounding on its stored numbers.

The gain: a bounded real inequality.  The least singular value of ``G(jw) = C (jw - A)^-1 B + D`` is above a level on a
range of frequencies if it is at one of them, and if

    [A - jw, 0, B; -C'C, -A' - jw, -C'D; D'C, B', D'D - level^2]

is singular at none: excluded around a frequency by an approximate inverse, as long as what it misses is below one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.matrix_equations import continuous_lyapunov
from obsynth.numerics.scaling import balanced_matrix
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.proofs.balls import UNIT_ROUNDOFF, Ball, rounded_up
from obsynth.proofs.contraction import prove_contraction
from obsynth.proofs.definiteness import prove_positive_definite
from obsynth.verification.error_system import ErrorModel, contraction_of
from obsynth.verification.inequalities import prove_gain

#: Intervals that a range may take, the share of an interval's reach that is used, and its first guess.
MOST_INTERVALS, REACH, FIRST_SHARE = 20_000, 0.9, 1e-3

#: Intervals this short, relative to where they are, end at a frequency at which the pencil is singular.
SHORTEST_INTERVAL = 1e-8

#: A range of frequencies that is shorter begins with intervals as if it had this length.
LEAST_RANGE = 1e-9

#: Share of the least norm that is left to equations that the frequency does not enter.
LIGHT = 0.25

#: Steps towards the weights in which norms are least, and the least share of a weight's inverse.
PERRON_STEPS, LEAST_PERRON_SHARE = 8, 2.0**-60

#: Units of states are not taken further apart than two to this.
MOST_EXPONENT = 200


@dataclass(frozen=True, eq=False)
class Transfer:
    """``C (s - A)^-1 B + D``, with enclosures: products of what is stored; A ``(n, n)`` may be either."""

    A: FloatArray | Ball
    B: Ball
    C: Ball
    D: Ball

    @property
    def dynamics(self) -> Ball:
        """A as an enclosure."""
        return Ball.of(self.A)

    @property
    def order(self) -> int:
        """Number of states."""
        return self.B.shape[0]

    def balanced(self) -> Transfer:
        """Return it in states that are driven as much as they are seen, by powers of two: nothing is rounded."""
        if not self.order:
            return self
        a, scale = self.dynamics, _equal_shares(*(part.midpoint for part in (self.dynamics, self.B, self.C)))
        turned = scale / scale[:, None]
        return Transfer(
            Ball(a.midpoint * turned, a.radius * turned),
            Ball(self.B.midpoint / scale[:, None], self.B.radius / scale[:, None]),
            Ball(self.C.midpoint * scale, self.C.radius * scale),
            self.D,
        )


def _equal_shares(a: FloatArray, b: FloatArray, c: FloatArray) -> FloatArray:
    """Return units of the states in which the diagonals of both Gramians are equal; or those that balance A."""

    with np.errstate(all="ignore"):
        driven = np.diag(continuous_lyapunov(a, -b @ b.T))
        observability = np.diag(continuous_lyapunov(a.T, -c.T @ c))
        exponents = np.round(0.25 * np.log2(driven / observability))
    if not np.all(np.isfinite(exponents)) or np.max(np.abs(exponents)) > MOST_EXPONENT:
        return np.asarray(balanced_matrix(a)[1])
    return np.asarray(np.exp2(exponents))


def gain_is_proved(transfer: Transfer, bound: float, p: FloatArray) -> bool:
    """Prove by a matrix p ``(n, n)`` that the system is stable and its H-infinity norm at most a bound."""
    # Of the transposed system, of which p proves it.
    a, b, c, d = (part.T for part in (transfer.dynamics, transfer.C, transfer.B, transfer.D))
    return prove_gain(a, b, c, 0.5 * (p + p.T), bound, direct=d).proved


def sensitivity_is_proved(transfer: Transfer, level: float, low: float, high: float) -> bool:
    """Prove that the least singular value is above a level at every frequency (rad/s) from ``low`` to ``high``."""
    if transfer.B.shape[1] > transfer.C.shape[0]:
        return False
    if not level > 0.0:
        return False
    # In units in which the level is near one, and in which B is as large as C: powers of two, nothing is rounded.
    unit = float(np.exp2(-np.round(np.log2(level))))
    work, level = transfer.balanced(), level * unit
    out, into = work.C.scaled(unit), work.B
    sizes = [float(np.max(part.magnitude, initial=0.0)) for part in (out, into)]
    turn = float(np.exp2(np.round(0.5 * np.log2(sizes[0] / sizes[1])))) if min(sizes) > 0.0 else 1.0
    work = Transfer(work.A, into.scaled(turn), out.scaled(1.0 / turn), work.D.scaled(unit))
    return _is_above_at(work, level, low) and _is_never_singular(_pencil(work, level), work.order, low, high)


def _pencil(work: Transfer, level: float) -> Ball:
    a, n, m = work.dynamics, work.order, work.B.shape[1]
    corner = work.D.T @ work.D - Ball.exact(level**2 * np.eye(m))
    return Ball.blocks(
        [
            [a, Ball.exact(np.zeros((n, n))), work.B],
            [-(work.C.T @ work.C), -a.T, -(work.C.T @ work.D)],
            [work.D.T @ work.C, work.B.T, corner],
        ]
    )


def _is_never_singular(pencil: Ball, n: int, low: float, high: float) -> bool:
    """Whether ``M - jw diag(I, 0)`` is proved to be regular from ``low`` to ``high``, the identity of order 2 n."""
    covered, length = low, FIRST_SHARE * max(high - low, LEAST_RANGE)
    for _ in range(MOST_INTERVALS):
        if covered >= high:
            return True
        middle = min(covered + 0.5 * length, high)
        reach = _regular_around(pencil, n, middle)
        if max(length, reach) < SHORTEST_INTERVAL * max(covered, SHORTEST_INTERVAL * high):
            return False
        if middle - reach > covered:
            # Too far: the interval around a nearer point.
            length *= 0.25
            continue
        covered, length = middle + reach, 4.0 * reach
    return False


def _regular_around(pencil: Ball, n: int, frequency: float) -> float:
    """Return how far around a frequency the pencil is proved to be regular; negative where it is not at all."""
    size = pencil.shape[0]
    turning = np.zeros((size, size))
    turning[: 2 * n, : 2 * n] = np.eye(2 * n)
    try:
        inverse = np.linalg.inv(pencil.midpoint - 1j * frequency * turning)
    except np.linalg.LinAlgError:
        return -1.0
    if not np.all(np.isfinite(inverse)):
        return -1.0
    inverse_blocks = np.block([[inverse.real, -inverse.imag], [inverse.imag, inverse.real]])
    turned = Ball.exact(frequency * turning)
    matrix = Ball.blocks([[pencil, turned], [-turned, pencil]])
    missed = Ball.exact(inverse_blocks) @ matrix - Ball.exact(np.eye(2 * size))
    # The frequency enters the equations of the states alone: the others count for little in weighted norms.
    states = np.r_[0 : 2 * n, size : size + 2 * n]
    moved = np.abs(inverse_blocks[:, states])
    weights = _weights(moved, states)
    error_norm = _row_sum((np.abs(missed.midpoint) + missed.radius) * weights[:, None] / weights)
    speed = _row_sum(moved * weights[:, None] / weights[states])
    if not error_norm < 1.0 or not np.isfinite(speed):
        return -1.0
    return REACH * (1.0 - error_norm) / speed if speed > 0.0 else np.inf


def _weights(moved: FloatArray, states: NDArray[np.intp]) -> FloatArray:
    """Return weights of the equations in which the largest row sum of ``moved``, whose columns are those of the states,
    is near its least, the spectral radius: Perron's vector; powers of two, so that they round nothing."""
    shares, largest = np.ones(len(states)), 0.0
    with np.errstate(all="ignore"):
        for _ in range(PERRON_STEPS):
            following = moved[states] @ shares
            largest = float(np.max(following, initial=0.0))
            shares = np.maximum(following / largest, LEAST_PERRON_SHARE)
        effects = moved @ shares
        effects[states] = shares
        others = np.setdiff1d(np.arange(len(moved)), states)
        effects[others] = np.maximum(effects[others] / (LIGHT * largest), LEAST_PERRON_SHARE)
        weights: FloatArray = np.exp2(-np.round(np.log2(effects)))
    return weights if np.all(np.isfinite(weights)) and np.all(weights > 0.0) else np.ones(len(moved))


def _row_sum(sizes: FloatArray) -> float:
    """Return a bound on the largest row sum."""
    return float(np.max(rounded_up(np.sum(sizes, axis=1), sizes.shape[1] + 1), initial=0.0))


def _is_above_at(work: Transfer, level: float, frequency: float) -> bool:
    """Prove that the least singular value at one frequency is above a level."""
    n, m = work.B.shape
    size = work.C.shape[0]
    into = Ball.blocks([[work.B, Ball.exact(np.zeros((n, m)))], [Ball.exact(np.zeros((n, m))), work.B]])
    out = Ball.blocks([[work.C, Ball.exact(np.zeros((size, n)))], [Ball.exact(np.zeros((size, n))), work.C]])
    zero = Ball.exact(np.zeros((size, m)))
    response = Ball.blocks([[work.D, zero], [zero, work.D]])
    if n:
        turned = Ball.exact(frequency * np.eye(n))
        matrix = Ball.blocks([[-work.dynamics, -turned], [turned, -work.dynamics]])
        try:
            inverse: FloatArray = np.asarray(np.linalg.inv(matrix.midpoint), dtype=np.float64)
        except np.linalg.LinAlgError:
            return False
        solution = inverse @ into.midpoint
        remainder = Ball.exact(np.eye(2 * n)) - Ball.exact(inverse) @ matrix
        share = _row_sum(np.abs(remainder.midpoint) + remainder.radius)
        missed = into - matrix @ Ball.exact(solution)
        error = _row_sum(np.abs(inverse)) * float(np.max(np.abs(missed.midpoint) + missed.radius, initial=0.0))
        if not share < 1.0:
            return False
        solved = Ball(solution, np.full_like(solution, float(rounded_up(np.array(error / (1.0 - share)), 6))))
        response = response + out @ solved
    least: FloatArray = np.asarray(level**2 * np.eye(2 * m), dtype=np.float64)
    return prove_positive_definite(response.T @ response - Ball.exact(least)).proved


def error_transfer(plant: DescriptorSystem, observer: LinearObserver, b: FloatArray, d: FloatArray) -> Transfer:
    """Return the transfer of a signal that enters by b and d to the residuals, if ``Az = A - By C, Cz = -Dy C``."""
    direct, out = Ball.exact(d), Ball.exact(observer.Dy)
    return Transfer(
        observer.Az, Ball.exact(b) - Ball.exact(observer.By) @ direct, out @ Ball.exact(plant.C), out @ direct
    )


def added_gain(plant: DescriptorSystem, observer: LinearObserver, b: FloatArray, d: FloatArray) -> float:
    """Return a proved bound on what the stored numbers add to the transfer of a signal; infinite where none is proved.

    The plant's state x moves z - x by K and the residuals by J: ``(Cz (s - Az)^-1 K + J) (s - A)^-1 b``.
    """
    channel = ErrorModel(plant, observer, np.eye(plant.nx)).remainder
    k, j = channel.K, channel.J
    if not any(part.midpoint.any() or part.radius.any() for part in (k, j)):
        return 0.0
    own, plant_itself = contraction_of(observer), prove_contraction(plant.A, discrete=False)
    if own is None or plant_itself is None:
        return np.inf
    # Sums over time of absolute responses bound every entry of a transfer on the axis.
    moved = plant_itself.gain(np.eye(plant.nx), b)
    gain = rounded_up(own.gain(observer.Cz, k.midpoint, k.radius) + j.magnitude, 2)
    return Ball.exact(moved).frobenius_norm * Ball.exact(gain).frobenius_norm * (1.0 + 4.0 * UNIT_ROUNDOFF)

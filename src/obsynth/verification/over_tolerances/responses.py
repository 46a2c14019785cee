"""Responses of an observer's error to its inputs: finite sums with a proved tail, and the feedback between them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from obsynth.errors import PreconditionError
from obsynth.numerics.arrays import FloatArray
from obsynth.proofs.balls import gamma
from obsynth.proofs.nonnegative_matrices import inverse_bound, spectral_radius_bound
from obsynth.verification.over_tolerances.error_structure import ErrorStructure

#: A ring of L samples is long enough when ``|Az^L|`` is proved to contract this much.
CONTRACTION = 1e-2

#: Shortest and longest ring.
SHORTEST_RING, LONGEST_RING = 8, 8192

#: Sums of products of doubles are multiplied by this: more than rounding can take from them.
OUTWARD = 1.0 + 1e-12

#: The largest tolerance is found to this share.
FACTOR_SHARE = 1e-3

#: Factors beyond this are as good as infinite.
LARGEST_FACTOR = 1e6

#: Added to the loop, as a share of its largest entry, so that its eigenvector is positive.
_LOOP_SHIFT = 1e-12


@dataclass(frozen=True, eq=False)
class Responses:
    """What channels do, L samples long; what is older goes on through bounds of eps, the three ``tail`` matrices."""

    structure: ErrorStructure
    powers: FloatArray  # (L + 1, nz, nz), of Az
    kernels: FloatArray  # (L, m, m + no + nz): to channels, outputs and eps, j + 1 samples later
    same: FloatArray  # (m, m), at the same sample
    direct: FloatArray  # (no, m)
    tail_channels: FloatArray
    tail_outputs: FloatArray
    tail_eps: FloatArray
    repeated: FloatArray

    @property
    def length(self) -> int:
        """Samples in the ring."""
        return len(self.kernels)

    @property
    def loop(self) -> FloatArray:
        """``H``: what all channels at all times add to the channels, the tail included; see `loop_radius`."""
        m, no, gathered = len(self.same), len(self.direct), self.kernels.sum(axis=0)
        older = self.tail_channels @ (self.repeated @ gathered[:, m + no :].T)
        return np.asarray((self.same + gathered[:, :m].T + older) * OUTWARD)

    def gain(self, left_factor: FloatArray, right_factor: FloatArray, direct: FloatArray | None = None) -> FloatArray:
        """Return an upper bound of ``|direct| + sum_j |left_factor Az^j right_factor|``, entry by entry."""
        moved = self.powers[:-1] @ right_factor
        older = np.abs(left_factor @ self.powers[-1]) @ (self.repeated @ np.abs(moved).sum(axis=0))
        rounding = self.length * power_rounding(left_factor, self.powers) @ np.abs(right_factor)
        total = np.abs(left_factor @ moved).sum(axis=0) + older + rounding
        return np.asarray((total if direct is None else total + np.abs(direct)) * OUTWARD)

    def absolute_gain(self, left_factor: FloatArray, right_factor: FloatArray) -> FloatArray:
        """Return an upper bound of ``sum_j |left_factor Az^j| right_factor`` for a nonnegative ``right_factor``."""
        sums = np.abs(left_factor @ self.powers[:-1]).sum(axis=0)
        size = np.abs(self.powers[:-1]).sum(axis=0)
        rounding = self.length * power_rounding(left_factor, self.powers)
        return np.asarray(
            (sums + rounding + np.abs(left_factor @ self.powers[-1]) @ self.repeated @ size) @ right_factor * OUTWARD
        )


def power_rounding(left_factor: FloatArray, powers: FloatArray) -> FloatArray:
    """Return a bound of what rounding of the powers changes in ``left_factor Az^j``, for all j.

    With ``P(j+1) = Az P(j) + F(j)`` as computed, ``Az^j - P(j)`` is the sum of ``Az^(j-1-i) F(i)``.
    """
    largest, size = np.abs(powers).max(axis=0), gamma(len(powers[0]) + 2)
    later = np.abs(left_factor @ powers).sum(axis=0) @ np.abs(powers[min(1, len(powers) - 1)])
    return np.asarray(2.0 * size * (later + np.abs(left_factor)) @ largest)


def ring_length(az: FloatArray) -> int:
    """Return the least power of two L with ``|Az^L|`` proved to contract to `CONTRACTION`."""
    length = SHORTEST_RING
    power = np.linalg.matrix_power(az, length)
    while not spectral_radius_bound(power) < CONTRACTION:
        with np.errstate(over="ignore", invalid="ignore"):  # an observer whose response does not decay
            length, power = 2 * length, power @ power
        if length > LONGEST_RING or not np.isfinite(power).all():
            raise PreconditionError(
                f"Errors of the observer decay too slowly for a bound over tolerances (not within {LONGEST_RING} "
                "samples): ask for a faster one, or sample more slowly.",
                condition="observer's decay",
            )
    return length


def responses_of(structure: ErrorStructure) -> Responses:
    """Return the responses of an error system; the ring is as long as it must be."""
    az, nz = structure.Az, len(structure.Az)
    powers = np.empty((ring_length(az) + 1, nz, nz))
    powers[0] = np.eye(nz)
    for j in range(1, len(powers)):
        powers[j] = az @ powers[j - 1]
    _, state, outputs = structure.rows
    rows = structure.channel_rows @ structure.Cx
    kernels = np.concatenate(
        [
            _response_sizes(structure, rows, powers[:-1]),
            _plain(structure, structure.Co, powers[:-1]),
            _plain(structure, np.eye(nz), powers[:-1]),
        ],
        axis=1,
    )
    signed = structure.channel_rows @ structure.effects[state]
    absolute = np.abs(structure.channel_rows) @ np.abs(structure.effects[state])
    own = len(structure.owner)
    same = structure.channel_sizes(np.hstack([signed[:, :own], absolute[:, own:]]))
    eye = np.eye(nz)
    tail = structure.channel_sizes(np.abs(rows @ powers[-1]) + power_rounding(rows, powers))
    out = np.abs(structure.Co @ powers[-1]) + power_rounding(structure.Co, powers)
    inside = (np.abs(powers[-1]) + power_rounding(eye, powers)) * OUTWARD
    repeated = inverse_bound(inside)
    if repeated is None:
        raise PreconditionError("The observer does not contract within its ring.", condition="observer's decay")
    return Responses(
        structure,
        powers,
        np.ascontiguousarray(kernels.transpose(0, 2, 1)) * OUTWARD,
        same * OUTWARD,
        np.abs(structure.effects[outputs]) * OUTWARD,
        tail * OUTWARD,
        out * OUTWARD,
        inside,
        repeated,
    )


def _plain(structure: ErrorStructure, left_factor: FloatArray, powers: FloatArray) -> FloatArray:
    """Return ``|left_factor Az^j b|`` (absolute values inside for remainders) for all j."""
    own, inner = len(structure.owner), structure.effects[structure.rows[0]]
    responses, slack = left_factor @ powers, power_rounding(left_factor, powers)
    sizes = np.concatenate([np.abs(responses @ inner[:, :own]), np.abs(responses) @ np.abs(inner[:, own:])], axis=2)
    return np.asarray(sizes + slack @ np.abs(inner))


def _response_sizes(structure: ErrorStructure, rows: FloatArray, powers: FloatArray) -> FloatArray:
    sizes = _plain(structure, rows, powers)
    if structure.single == len(rows):
        return sizes
    largest = sizes[:, structure.single :].max(axis=1, keepdims=True)
    return np.concatenate([sizes[:, : structure.single], largest], axis=1)


def loop_radius(responses: Responses) -> float:
    """Return an upper bound of the loop's radius: below 1, bounds stay finite for ever."""
    return spectral_radius_bound(responses.loop)


def same_sample_inverse(responses: Responses) -> FloatArray:
    """Return a bound of ``(I - D0)^-1``; `PreconditionError` where the loop at one sample does not contract."""
    inverse = inverse_bound(responses.same)
    if inverse is None:
        raise PreconditionError(
            f"No bound: the loop at one and the same sample has radius {spectral_radius_bound(responses.same):.3g}, "
            "which must be below 1. Give smaller tolerances of C and D.",
            condition="same-sample loop",
        )
    return inverse


def largest_factor(structure_at: Callable[[float], ErrorStructure], radius: float) -> float:
    """Return the largest factor on all tolerances for which the loop's radius is below 1; matrices are built anew."""
    known: dict[float, float] = {1.0: radius}

    def radius_at(factor: float) -> float:
        if factor not in known:
            try:
                with np.errstate(over="ignore", invalid="ignore"):
                    structure = structure_at(factor)
                    # Of a plant that grows beyond all numbers nothing is known.
                    known[factor] = loop_radius(responses_of(structure)) if _is_finite(structure) else np.inf
            except PreconditionError:
                known[factor] = np.inf
        return known[factor]

    if radius == 0.0:
        return np.inf
    low, high = 0.0, min(1.0 / radius, LARGEST_FACTOR)
    while radius_at(high) < 1.0:
        low, high = high, 2.0 * high
        if low >= LARGEST_FACTOR:
            return np.inf
    if low == 0.0 and radius < 1.0:
        low = 1.0
    while high - low > FACTOR_SHARE * high:
        middle = (low + high) / 2.0
        low, high = (middle, high) if radius_at(middle) < 1.0 else (low, middle)
        if high < 1.0 / LARGEST_FACTOR:
            return 0.0
    return low


def _is_finite(structure: ErrorStructure) -> bool:
    parts = (structure.state, structure.inputs, structure.disturbances)
    return all(np.isfinite(part.spread + part.radius).all() for part in parts)


def blame(responses: Responses) -> FloatArray:
    """Return the share of each constant in the loop's radius, remainders last: its Perron vectors."""
    left_vector, right_vector = _perron(responses.loop)
    structure = responses.structure
    shares = np.zeros(structure.state.count + 1)
    owner = np.full(structure.channels, structure.state.count)
    owner[: len(structure.owner)] = structure.owner
    np.add.at(shares, owner, (left_vector @ responses.loop) * right_vector)
    return _as_shares(shares)


def blamed_rows(responses: Responses, tracking: FloatArray, parts: tuple[FloatArray, ...]) -> FloatArray:
    """Return the share of each row of the plant ``(nx,)`` in the loop; ``parts (p, nx, n)`` of E and A."""
    structure = responses.structure
    left_vector, right_vector = _perron(responses.loop)
    into = structure.channel_sizes(responses.gain(structure.channel_rows @ structure.Cx, tracking))
    shares = np.zeros(tracking.shape[1])
    for i in sorted(set(structure.owner)):
        chosen = np.flatnonzero(np.equal(structure.owner, i))
        rows = structure.channel_rows[chosen]
        for part in parts:
            width = part[i].shape[1]
            effect = np.abs(part[i] @ np.linalg.pinv(rows[:, :width]))
            shares += (left_vector @ into) * (effect @ right_vector[chosen])
    return _as_shares(shares)


def _as_shares(sizes: FloatArray) -> FloatArray:
    total = float(sizes.sum())
    return np.asarray(sizes / total if total > 0.0 else sizes)


def _perron(loop: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return left and right eigenvectors of the spectral radius, nonnegative."""
    size = float(loop.max(initial=0.0))
    if size == 0.0:
        return np.ones(len(loop)), np.ones(len(loop))
    values, right_vectors = np.linalg.eig(loop + _LOOP_SHIFT * size)
    transposed, left_vectors = np.linalg.eig(loop.T + _LOOP_SHIFT * size)
    return (
        np.abs(left_vectors[:, int(np.argmax(transposed.real))].real),
        np.abs(right_vectors[:, int(np.argmax(values.real))].real),
    )

"""Bound on residuals and fault estimates over the box of the plant's constants.

The bound at sample k is ``nominal + start_k + sum_i |phi_i| + rest_k + rounding_k``: ``nominal`` of disturbances and
noise, ``start_k`` of the error at the start, ``phi_i`` filters of the measured signals, one for each constant (first
order), ``rest`` all higher orders, by a recursion of nonnegative numbers over a ring of L samples.

Letters are those of `error_structure`: eps, the ``nz`` errors of the observer's states; ``no`` outputs (residuals and
fault estimates); p constants.  A channel is a nonnegative number of each sample, such as ``|c e|``, through which a
constant drives the errors again: ``m`` channels, of ``rows`` channel rows c.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.observers.linear.observer import LinearObserver
from obsynth.proofs.affine import AffineMatrix
from obsynth.proofs.balls import gamma
from obsynth.proofs.nonnegative_matrices import positive_vector
from obsynth.verification.over_tolerances.error_structure import ErrorStructure
from obsynth.verification.over_tolerances.responses import (
    OUTWARD,
    Responses,
    power_rounding,
    responses_of,
    same_sample_inverse,
)

#: The effect of the start is tabulated over this many rings.
START_RINGS = 4


@dataclass(frozen=True, eq=False)
class AdaptiveBound:
    """What a threshold over a box needs online, for ``v = [xhat; u]``; the ring holds ``w`` numbers of each sample.

    Numbers on channels and outputs are ``(m + no,)``, in this order; those on channels are after the loop at one
    sample."""

    structure: ErrorStructure
    responses: Responses
    varying: bool
    drive: FloatArray  # ``(p, nz + rows + no, nv)``: constants to eps, channel rows and outputs
    output_rows: FloatArray  # ``(rows + no, nz)``: eps to channel rows and outputs
    kernels: FloatArray  # ``(L w, m + no + nz)``, oldest first: ring to channels, outputs and eps
    same: FloatArray  # ``(w, m + no)``: ring to channels and outputs within one sample
    solved: FloatArray  # ``(m, m)``: inverse of the loop of the channels at one sample
    tail: FloatArray  # ``(m + no + nz, nz)``: what a bound of eps from before the ring adds
    nominal: FloatArray  # ``(m + no,)``: what disturbances and noise add, over the whole box
    of_tolerances: FloatArray  # ``(no,)``: the part of that which is there for the tolerances alone
    rounding: FloatArray  # ``(m + no, nu + ny + n + 1)``, for the largest signals so far
    start: FloatArray  # ``(samples, m + no)``: what the error at the start adds, sample by sample
    start_later: tuple[float, FloatArray]  # factor of each ring after these samples, and what it multiplies
    spans: FloatArray  # ``(p,)``: farthest that each constant is from nominal, in half widths of its range
    remainder_inputs: tuple[int, ...]  # inputs whose effect has a remainder beyond the first order
    first: FloatArray | None = None  # ``(nz, nu)``: first inputs to the last sensitivity (continuous designs)

    @property
    def length(self) -> int:
        """Samples in the ring."""
        return self.responses.length

    @cached_property
    def counts(self) -> tuple[int, int, int, int, int]:
        """``p, nz, rows, m, no``: constants, eps, channel rows, channels, outputs."""
        structure = self.structure
        nz, _, no = structure.sizes
        return structure.state.count, nz, len(structure.channel_rows), structure.channels, no

    @property
    def width(self) -> int:
        """Numbers of a sample that the ring holds."""
        return self.counts[3] + len(self.remainder_inputs)

    @cached_property
    def memory(self) -> FloatArray:
        """For varying constants ``(L, p, rows + no + nz, nv)``, oldest sample first: what signals of the past do."""
        nz = self.counts[1]
        powers = self.responses.powers[:-1][::-1]
        inner = self.drive[:, :nz]
        output_rows = np.concatenate(
            [np.broadcast_to(self.output_rows, (len(powers), *self.output_rows.shape)) @ powers, powers], axis=1
        )
        return np.asarray(np.einsum("jrz,pzv->jprv", output_rows, inner))

    @cached_property
    def tail_rows(self) -> FloatArray:
        """What a bound of eps from before the ring adds to each channel row, ``(rows, nz)``."""
        rows = self.structure.channel_rows @ self.structure.Cx
        powers = self.responses.powers
        return np.asarray((np.abs(rows @ powers[-1]) + power_rounding(rows, powers)) * OUTWARD)

    def start_at(self, k: int) -> FloatArray:
        """Return what the start adds to channels and outputs ``(m + no,)`` at sample k after it."""
        if k < len(self.start):
            return np.asarray(self.start[k])
        theta, later = self.start_later
        return later * theta ** (k // self.length)

    def known(self, estimates: FloatArray, inputs: FloatArray) -> FloatArray:
        """Return what signals put into the ring ``(..., w)``: estimates through remainders, inputs with remainders."""
        own, structure = len(self.structure.owner), self.structure
        sizes = np.abs(estimates @ structure.channel_rows[own:].T)
        single = structure.single - own
        channels = np.zeros((*estimates.shape[:-1], self.width))
        channels[..., own : structure.single] = sizes[..., :single]
        if sizes.shape[-1] > single:
            channels[..., structure.single] = sizes[..., single:].max(axis=-1)
        if self.remainder_inputs:
            channels[..., structure.channels :] = np.abs(inputs[..., list(self.remainder_inputs)])
        return channels


class Start:
    """What is known of eps at the start: nothing, a bound of its ``norm``, or ``center`` and ``radius (nz,)``.

    ``state (nz,)``: the observer's own state then, whose size rounding depends on."""

    def __init__(
        self,
        nz: int,
        *,
        norm: float | None = None,
        center: FloatArray | None = None,
        radius: FloatArray | None = None,
        state: FloatArray | None = None,
    ) -> None:
        self.norm, self.stated = norm, norm is not None or center is not None
        self.center = np.zeros(nz) if center is None else center
        self.radius = np.zeros(nz) if radius is None else radius
        self.state = np.zeros(nz) if state is None else np.abs(state)

    @property
    def size(self) -> FloatArray:
        """Upper bound of each component of eps."""
        size = np.abs(self.center) + self.radius
        return np.asarray(size if self.norm is None else size + self.norm)

    def largest(self, rows: FloatArray) -> FloatArray:
        """Return the largest size of each entry of ``rows @ eps``."""
        size = np.abs(rows @ self.center) + np.abs(rows) @ self.radius
        return np.asarray(size if self.norm is None else size + self.norm * np.linalg.norm(rows, axis=-1))


def adaptive_bound(
    structure: ErrorStructure, observer: LinearObserver, start: Start, *, varying: bool
) -> AdaptiveBound:
    """Return the bound of an error system; `PreconditionError` where the loop at one sample does not contract."""
    responses = responses_of(structure)
    solved = same_sample_inverse(responses)
    inner, state, outputs = structure.rows
    rows, m = structure.channel_rows, structure.channels
    both = np.concatenate([structure.state.parts, structure.inputs.parts], axis=2)
    drive = np.concatenate([both[:, inner], rows @ both[:, state], both[:, outputs]], axis=1)
    rest = structure.inputs.radius
    driven = np.flatnonzero(rest.max(axis=0, initial=0.0) > 0.0)
    kernels = np.concatenate([responses.kernels, _driven(structure, responses, rest[inner][:, driven])], axis=1)
    kernels[:, :, :m] = kernels[:, :, :m] @ solved.T * OUTWARD
    kernels = np.ascontiguousarray(kernels[::-1].reshape(-1, kernels.shape[2]))
    through = structure.channel_sizes(np.abs(rows) @ rest[state][:, driven])
    same = (
        np.hstack(
            [
                np.vstack([solved @ responses.same, responses.direct]),
                np.vstack([solved @ through, rest[outputs][:, driven]]),
            ]
        )
        * OUTWARD
    )
    tail = np.vstack([solved @ responses.tail_channels, responses.tail_outputs, responses.tail_eps]) * OUTWARD
    table, later = _start_table(structure, responses, start)
    outward = np.vstack(
        [
            np.hstack([solved, np.zeros((m, len(table[0]) - m))]),
            np.hstack([np.zeros((len(table[0]) - m, m)), np.eye(len(table[0]) - m)]),
        ]
    )
    theta, settled = later
    return AdaptiveBound(
        structure=structure,
        responses=responses,
        varying=varying,
        drive=drive,
        output_rows=np.vstack([rows @ structure.Cx, structure.Co]),
        kernels=kernels,
        same=np.ascontiguousarray(same.T),
        solved=solved,
        tail=tail,
        nominal=outward @ _nominal(structure, responses),
        of_tolerances=_nominal(structure, responses, center=False)[m:],
        rounding=outward @ _rounding(structure, responses, observer, start.state),
        start=table @ outward.T * OUTWARD,
        start_later=(theta, outward @ settled * OUTWARD),
        spans=1.0 + np.abs(structure.offsets),
        remainder_inputs=tuple(driven.tolist()),
    )


def _driven(structure: ErrorStructure, responses: Responses, columns: FloatArray) -> FloatArray:
    """Return the kernels of nonnegative columns into eps, ``(L, columns, m + no + nz)``."""
    powers = responses.powers[:-1]

    def sizes(rows: FloatArray) -> FloatArray:
        return np.asarray((np.abs(rows @ powers) + power_rounding(rows, powers)) @ columns)

    channels = structure.channel_sizes(np.moveaxis(sizes(structure.channel_rows @ structure.Cx), 1, 0))
    parts = [np.moveaxis(channels, 0, 1), sizes(structure.Co), sizes(np.eye(len(structure.Az)))]
    return np.asarray(np.concatenate(parts, axis=1).transpose(0, 2, 1) * OUTWARD)


def _start_table(
    structure: ErrorStructure, responses: Responses, start: Start
) -> tuple[FloatArray, tuple[float, FloatArray]]:
    """Return what the start adds to channels and outputs, sample by sample, and what goes on decaying after that."""
    both, power, table = (structure.channel_rows @ structure.Cx, structure.Co), np.eye(len(structure.Az)), []
    for _ in range(START_RINGS * responses.length):
        channels, outputs = (start.largest(rows @ power) for rows in both)
        table.append(np.concatenate([structure.channel_sizes(channels), outputs]) * OUTWARD)
        power = structure.Az @ power
    # ``|Az^L| w <= theta w`` is proved.
    theta, weights = positive_vector(responses.tail_eps)
    if not len(weights):
        return np.array(table), (0.0, np.zeros(len(table[0])))
    factor = float(np.max(start.size / weights)) * OUTWARD
    channels, outputs = (
        (np.abs(rows @ responses.powers[:-1]) + power_rounding(rows, responses.powers)).max(axis=0) @ weights
        for rows in both
    )
    return np.array(table), (theta, np.concatenate([structure.channel_sizes(channels), outputs]) * factor)


def _nominal(structure: ErrorStructure, responses: Responses, *, center: bool = True) -> FloatArray:
    """Return what disturbances and noise add to channels and outputs, over the whole box (or the tolerances alone)."""
    disturbances, (inner, state, outputs) = structure.disturbances, structure.rows

    def total(left_factor: FloatArray, direct: AffineMatrix) -> FloatArray:
        gains = responses.gain(left_factor, disturbances.center[inner], direct.center) * float(center)
        for part, at_once in zip(disturbances.parts, direct.parts, strict=True):
            if part.any():
                gains = gains + responses.gain(left_factor, part[inner], at_once)
        if disturbances.radius.any():
            gains = gains + responses.absolute_gain(left_factor, disturbances.radius[inner]) + direct.radius
        return np.asarray(gains @ structure.bounds * OUTWARD)

    rows = structure.channel_rows
    channels = total(rows @ structure.Cx, disturbances[state, :].after(rows))
    return np.concatenate([structure.channel_sizes(channels), total(structure.Co, disturbances[outputs, :])])


def _rounding(
    structure: ErrorStructure, responses: Responses, observer: LinearObserver, state: FloatArray
) -> FloatArray:
    """Return ``(m + no, nu + ny + n + 1)``: what rounding adds, per largest signal; last the observer's start."""
    nz, n, _ = structure.sizes
    nu, ny = observer.Bu.shape[1], observer.By.shape[1]
    inner, at_state, outputs = structure.rows
    absolute, eye = np.abs, np.eye(nz)
    size = gamma(nz + nu + ny + n + 8)
    entered = np.hstack([observer.Bu, observer.By])
    started = responses.absolute_gain(eye, eye) @ state
    largest = np.hstack([responses.gain(eye, entered), np.zeros((nz, n)), started[:, None]])
    pushed = absolute(observer.Az) @ largest + np.hstack([absolute(entered), np.zeros((nz, n + 1))])
    through = np.hstack([absolute(observer.Du), absolute(observer.Dy), np.zeros((len(observer.Cz), n + 1))])
    read = absolute(observer.Cz) @ largest + through
    picked = absolute(structure.watching)
    rows = structure.channel_rows

    def spread(left_factor: FloatArray, direct: FloatArray, into: FloatArray) -> FloatArray:
        return np.asarray(size * (responses.absolute_gain(left_factor, into) + direct))

    reading = absolute(rows) @ absolute(structure.reading)
    channels = spread(rows @ structure.Cx, reading @ read, pushed)
    output_rounding = spread(structure.Co, picked @ read, pushed)
    order = [*range(nu + ny, nu + ny + n), *range(nu)]
    for part, known in zip(structure.state.parts, structure.inputs.parts, strict=True):
        both = np.hstack([part, known])
        largest_psi = responses.gain(eye, both[inner])
        into = absolute(structure.Az) @ largest_psi + absolute(both[inner])
        for left_factor, direct, total in (
            (rows @ structure.Cx, absolute(rows) @ absolute(both[at_state]), channels),
            (structure.Co, absolute(both[outputs]), output_rounding),
        ):
            total[:, order] += spread(left_factor, direct + absolute(left_factor) @ largest_psi, into)
    return np.vstack([structure.channel_sizes(channels), output_rounding]) * OUTWARD

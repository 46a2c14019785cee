"""The adaptive threshold over whole records of one or many runs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.verification.over_tolerances.adaptive_bound import AdaptiveBound

#: What rounding of the threshold itself may take from it.
THRESHOLD_ROUNDING = 1.0 + 1e-10


#: Samples whose dependence on older ones is computed at once.
SAMPLES_AT_ONCE = 32

#: Samples of all runs together whose first order is computed at once.
CACHED_SAMPLES = 4000


class Thresholds(NamedTuple):
    """Bounds ``(..., no)`` of fault estimates, then residuals: ``nominal + start + sum of first + rest``; of a sample,
    or of records ``(runs, steps, no)``."""

    total: FloatArray
    first: FloatArray  # ``(..., p, no)``: of each constant
    shift: FloatArray  # where the interval's middle is, for a box off centre
    start: FloatArray
    rest: FloatArray


@dataclass(frozen=True, eq=False)
class AdaptivePlan:
    """What an adaptive monitor is made of."""

    bound: AdaptiveBound  # without a fault
    faults: AdaptiveBound | None  # of fault estimates during a fault; ``None`` if there is none, or the same
    same: bool
    reason: str  # why there is none
    start_beyond_nominal: bool
    estimates: bool
    names: tuple[str, ...]
    fault_names: tuple[str, ...]
    residual_names: tuple[str, ...]
    sample_time: float | None = None

    @property
    def columns(self) -> tuple[str, ...]:
        """Columns of a run: thresholds, intervals, and the share of each constant in them."""
        watched = (*(f"fhat[{name}]" for name in self.fault_names), *(f"r[{name}]" for name in self.residual_names))
        faults = [f"{end} {name}" for name in self.fault_names for end in ("lowest", "highest")]
        return (
            *(f"threshold {name}" for name in watched),
            *(faults if self.intervals else ()),
            *(f"share {name}" for name in self.names),
        )

    @property
    def intervals(self) -> bool:
        """Whether faults have guaranteed intervals."""
        return bool(self.fault_names) and (self.same or self.faults is not None)

    @property
    def residuals(self) -> slice:
        """Rows of the outputs whose norm is watched: residuals, or fault estimates where these do not see faults."""
        if self.estimates:
            return slice(0, len(self.fault_names))
        return slice(len(self.fault_names), len(self.fault_names) + len(self.residual_names))


def thresholds_of_records(
    bound: AdaptiveBound, estimates: FloatArray, inputs: FloatArray, outputs: FloatArray
) -> Thresholds:
    """Return the thresholds for records from the start; ``estimates (runs, steps, n)`` by `ErrorStructure.reading`."""
    _, _, _, m, no = bound.counts
    v = np.concatenate([estimates, inputs], axis=2)
    first_channels, first, shift = (_first_varying if bound.varying else _first_constant)(bound, v)
    steps = v.shape[1]
    start = np.array([bound.start_at(k) for k in range(steps)]).reshape(steps, m + no)
    largest = np.concatenate([np.abs(inputs), np.abs(outputs), np.abs(estimates)], axis=2)
    largest = np.maximum.accumulate(np.concatenate([largest, np.ones((*largest.shape[:2], 1))], axis=2), axis=1)
    known = bound.known(estimates, inputs)
    fixed = largest @ bound.rounding.T + known @ bound.same + bound.nominal + start
    fixed[:, :, :m] += first_channels @ bound.solved.T
    ring, found = _recursion(bound, fixed[:, :, :m], known)
    rest = found + largest @ bound.rounding[m:].T + ring @ bound.same[:, m:]
    total = (bound.nominal[m:] + start[:, m:] + first.sum(axis=2) + np.abs(shift) + rest) * THRESHOLD_ROUNDING
    return Thresholds(total, first, shift, np.broadcast_to(start[:, m:], total.shape), rest)


def _first_constant(bound: AdaptiveBound, v: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return first-order bounds of channels, ``|phi|`` of each constant, and the shift of the outputs' middle."""
    p, _, _, m, no = bound.counts
    runs, steps = v.shape[:2]
    if not p:
        return np.zeros((runs, steps, m)), np.zeros((runs, steps, 0, no)), np.zeros((runs, steps, no))
    # A few runs at a time stay in the processor's cache.
    size = max(1, CACHED_SAMPLES // steps)
    parts = [_first_of_some(bound, v[i : i + size]) for i in range(0, runs, size)]
    channels, phi, shift = (np.concatenate(part) for part in zip(*parts, strict=True))
    return channels, phi, shift


def _first_of_some(bound: AdaptiveBound, v: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    p, nz, rows, _, no = bound.counts
    runs, steps, nv = v.shape
    flat = np.ascontiguousarray(v).reshape(-1, nv)
    into = flat @ np.ascontiguousarray(bound.drive[:, :nz]).reshape(-1, nv).T
    seen = (flat @ np.ascontiguousarray(bound.drive[:, nz:]).reshape(-1, nv).T).reshape(-1, rows + no)
    begin = np.zeros((runs, 1, p, nz))
    if bound.first is not None:
        begin[:, 0, -1] = v[:, 0, nv - bound.first.shape[1] :] @ bound.first.T
    psi = filtered(bound.structure.Az, np.concatenate([begin, into.reshape(runs, steps, p, nz)], axis=1))[:, 1:]
    seen += psi.reshape(-1, nz) @ bound.shown.T
    whole = seen.reshape(runs, steps, p, rows + no)
    offsets = bound.structure.offsets
    middle = np.tensordot(whole, offsets, axes=(2, 0)) if offsets.any() else None
    sizes = np.abs(whole, out=whole)
    moved = sizes[..., :rows].sum(axis=2)
    if middle is not None:
        moved += np.abs(middle[..., :rows])
    shift = np.zeros((runs, steps, no)) if middle is None else -middle[..., rows:]
    return _seen(bound, moved), sizes[..., rows:].copy(), shift


def _seen(bound: AdaptiveBound, values: FloatArray) -> FloatArray:
    return np.moveaxis(bound.structure.seen(np.moveaxis(values, -1, 0)), 0, -1)


def filtered(az: FloatArray, w: FloatArray) -> FloatArray:
    """Return ``psi(k+1) = Az psi(k) + w(k)`` from zero, ``(runs, steps, p, nz)``; blocks side by side."""
    runs, steps, p, nz = w.shape
    size = max(1, int(np.sqrt(steps)))
    blocks = -(-steps // size)
    padded = np.zeros((runs, blocks * size, p, nz))
    padded[:, :steps] = w
    inside = np.ascontiguousarray(padded.reshape(runs, blocks, size, p, nz).transpose(2, 0, 1, 3, 4))
    found = np.zeros((size + 1, runs, blocks, p, nz))
    turned = np.ascontiguousarray(az.T)
    for k in range(size):
        found[k + 1] = inside[k]
        found[k + 1] += (found[k].reshape(-1, nz) @ turned).reshape(found[k].shape)
    power = np.linalg.matrix_power(turned, size)
    begins = np.zeros((runs, blocks, p, nz))
    for b in range(1, blocks):
        begins[:, b] = (begins[:, b - 1].reshape(-1, nz) @ power).reshape(runs, p, nz) + found[size, :, b - 1]
    step = begins
    for k in range(size):
        found[k] += step
        step = (step.reshape(-1, nz) @ turned).reshape(step.shape)
    whole = found[:size].transpose(1, 2, 0, 3, 4).reshape(runs, blocks * size, p, nz)
    return np.ascontiguousarray(whole[:, :steps])


def _first_varying(bound: AdaptiveBound, v: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the same for constants that may change at each sample: sums of absolute values, sample by sample."""
    p, nz, rows, m, no = bound.counts
    runs, steps, nv = v.shape
    zero = np.zeros((runs, steps, no))
    if not p:
        return np.zeros((runs, steps, m)), np.zeros((runs, steps, 0, no)), zero
    inner = bound.drive[:, :nz]
    whole = np.abs(v @ bound.drive[:, nz:].reshape(-1, nv).T).reshape(runs, steps, p, rows + no)
    eps = np.zeros((runs, steps + bound.length, nz))
    for j, power in enumerate(bound.responses.powers[:-1]):
        if j + 1 > steps:
            break
        moved = np.concatenate([bound.shown @ power @ inner, power @ inner], axis=1)
        sizes = np.abs(v[:, : steps - j - 1] @ moved.reshape(-1, nv).T).reshape(runs, -1, p, rows + no + nz)
        whole[:, j + 1 :] += sizes[..., : rows + no]
        eps[:, bound.length + j + 1 :] += np.einsum("rkpz,p->rkz", sizes[..., rows + no :], bound.spans)
    for k in range(bound.length, steps + bound.length):
        eps[:, k] += eps[:, k - bound.length] @ bound.responses.tail_eps.T
    first = whole * bound.spans[:, None]
    older = eps[:, :steps]
    channels = _seen(bound, first[..., :rows].sum(axis=2) + older @ bound.tail_rows.T)
    outputs = first[..., rows:]
    # What is older than the ring belongs to all constants: it is shared out evenly.
    outputs = outputs + (older @ bound.responses.tail_outputs.T)[:, :, None, :] / p
    return channels, outputs, zero


def _recursion(bound: AdaptiveBound, fixed: FloatArray, known: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the ring's numbers ``(runs, steps, w)`` and what all older ones add to the outputs."""
    _, nz, _, m, no = bound.counts
    runs, steps, w = known.shape
    length = bound.length
    ring = np.zeros((runs, steps + length, w))
    eps = np.zeros((runs, steps + length, nz))
    found = np.empty((runs, steps, no))
    kernels, tail = bound.kernels, np.ascontiguousarray(bound.tail.T)
    for begin in range(0, steps, min(SAMPLES_AT_ONCE, length)):
        end = min(begin + min(SAMPLES_AT_ONCE, length), steps)
        size = end - begin
        older = _windows(ring[:, begin : end + length], size, length) @ kernels
        older += eps[:, begin:end] @ tail
        for k in range(size):
            at = begin + k
            h = older[:, k, :m] + fixed[:, at]
            ring[:, at + length, :m] = h + known[:, at, :m]
            ring[:, at + length, m:] = known[:, at, m:]
            if k + 1 < size:
                recent = ring[:, begin + length : at + length + 1].reshape(runs, -1)
                older[:, k + 1] += recent @ kernels[-recent.shape[1] :]
        found[:, begin:end] = older[:, :, m : m + no]
        eps[:, begin + length : end + length] = older[:, :, m + no :]
    return ring[:, length:], found


def _windows(values: FloatArray, size: int, length: int) -> FloatArray:
    """Return ``(runs, size, length w)``: the samples before each, oldest first (zero where they are not known yet)."""
    runs, _, w = values.shape
    view = np.lib.stride_tricks.sliding_window_view(values[:, : size + length - 1], length, axis=1)
    return np.ascontiguousarray(view.transpose(0, 1, 3, 2)).reshape(runs, size, length * w)

"""The recursion of the adaptive threshold: a sample of one or of many runs at once; records are a scan of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.verification.over_tolerances.adaptive_bound import AdaptiveBound

#: What rounding of the threshold itself may take from it.
THRESHOLD_ROUNDING = 1.0 + 1e-10


class Thresholds(NamedTuple):
    """Bounds ``(..., no)`` of fault estimates, then residuals: ``nominal + start + sum of first + rest``; of a sample
    ``(..., no)``, or of records ``(runs, steps, no)``."""

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


class AdaptiveState(NamedTuple):
    """What goes from sample to sample, runs in leading axes, rings with the oldest first."""

    psi: FloatArray  # ``(..., p, nz)``: sensitivities
    ring: FloatArray  # ``(..., L, w)``
    eps: FloatArray  # ``(..., L, nz)``
    largest: FloatArray
    past: FloatArray  # ``(..., L, nv)``: signals, for varying constants
    moved: FloatArray  # ``(..., L, nz)``: bounds, for varying constants
    k: int = 0  # samples since the start

    @classmethod
    def of(cls, bound: AdaptiveBound, runs: tuple[int, ...] = ()) -> AdaptiveState:
        """Return the state before the first sample, of one run or of many."""
        (p, nz, *_), length = bound.counts, bound.length
        shapes = (p, nz), (length, bound.width), (length, nz)
        largest = np.zeros((*runs, bound.rounding.shape[1]))
        largest[..., -1] = 1.0
        memory = ((length, bound.drive.shape[2]), (length, nz)) if bound.varying else ((0, 0), (0, 0))
        psi, ring, eps, past, moved = (np.zeros((*runs, *shape)) for shape in (*shapes, *memory))
        return cls(psi, ring, eps, largest, past, moved)


def thresholds_of_records(
    bound: AdaptiveBound, estimates: FloatArray, inputs: FloatArray, outputs: FloatArray
) -> Thresholds:
    """Return the thresholds for records from the start; ``estimates (runs, steps, n)`` by `ErrorStructure.reading`."""
    runs, steps, _ = estimates.shape
    p, *_, no = bound.counts
    shapes = (no,), (p, no), (no,), (no,), (no,)
    found = Thresholds(*(np.empty((runs, steps, *shape)) for shape in shapes))
    state = AdaptiveState.of(bound, (runs,))
    for k in range(steps):
        state, sample = adaptive_step(bound, state, estimates[:, k], inputs[:, k], outputs[:, k])
        for whole, part in zip(found, sample, strict=True):
            whole[:, k] = part
    return found


def adaptive_step(
    bound: AdaptiveBound, state: AdaptiveState, estimates: FloatArray, inputs: FloatArray, outputs: FloatArray
) -> tuple[AdaptiveState, Thresholds]:
    """Take one sample: ``estimates (..., n)`` as `ErrorStructure.reading` gives them; return the state after it too."""
    *_, m, no = bound.counts
    v = np.concatenate([estimates, inputs], axis=-1)
    if bound.first is not None and state.k == 0:
        last = (inputs @ bound.first.T)[..., None, :]
        state = state._replace(psi=np.concatenate([state.psi[..., :-1, :], last], axis=-2))
    state, moved, first, shift = (_varying if bound.varying else _constant)(bound, state, v)
    sizes = np.abs(np.concatenate([inputs, outputs, estimates, np.ones((*v.shape[:-1], 1))], axis=-1))
    state = state._replace(largest=np.maximum(state.largest, sizes))
    known = bound.known(estimates, inputs)
    start = bound.start_at(state.k)
    rounding = state.largest @ bound.rounding.T
    older = state.ring.reshape(*v.shape[:-1], -1) @ bound.kernels + state.eps[..., 0, :] @ bound.tail.T
    fixed = rounding + known @ bound.same + bound.nominal + start
    h = known.copy()
    h[..., :m] += older[..., :m] + fixed[..., :m] + _channels(bound, moved) @ bound.solved.T
    rest = older[..., m : m + no] + rounding[..., m:] + h @ bound.same[:, m:]
    total = (bound.nominal[m:] + start[m:] + first.sum(axis=-2) + np.abs(shift) + rest) * THRESHOLD_ROUNDING
    after = state._replace(ring=_followed(state.ring, h), eps=_followed(state.eps, older[..., m + no :]), k=state.k + 1)
    return after, Thresholds(total, first, shift, start[m:], rest)


#: State, bounds of the channel rows, ``|phi|`` of each constant, and the shift of the outputs' middle.
_FirstOrder: TypeAlias = tuple[AdaptiveState, FloatArray, FloatArray, FloatArray]


def _constant(bound: AdaptiveBound, state: AdaptiveState, v: FloatArray) -> _FirstOrder:
    p, nz, rows, _, no = bound.counts
    runs = v.shape[:-1]
    w = (v @ bound.drive.reshape(-1, v.shape[-1]).T).reshape(*runs, p, nz + rows + no)
    seen = w[..., nz:] + state.psi @ bound.shown.T
    state = state._replace(psi=state.psi @ bound.structure.Az.T + w[..., :nz])
    sizes, offsets = np.abs(seen), bound.structure.offsets
    moved, shift = sizes[..., :rows].sum(axis=-2), np.zeros((*runs, no))
    if offsets.any():
        middle = offsets @ seen
        moved, shift = moved + np.abs(middle[..., :rows]), -middle[..., rows:]
    return state, moved, sizes[..., rows:], shift


def _varying(bound: AdaptiveBound, state: AdaptiveState, v: FloatArray) -> _FirstOrder:
    """Return the same for constants that may change at each sample: sums of absolute values, sample by sample."""
    p, nz, rows, _, no = bound.counts
    runs = v.shape[:-1]
    # For each sample of the ring ``(L, runs, p (rows + no + nz))``: one product of matrices each.
    memory = bound.memory.reshape(bound.length, -1, v.shape[-1])
    past = np.moveaxis(state.past.reshape(-1, bound.length, v.shape[-1]), 1, 0)
    eps = np.abs(past @ memory.transpose(0, 2, 1)).sum(axis=0).reshape(*runs, p, rows + no + nz) * bound.spans[:, None]
    now = (v @ bound.drive[:, nz:].reshape(-1, v.shape[-1]).T).reshape(*runs, p, rows + no)
    sizes = np.abs(now) * bound.spans[:, None] + eps[..., : rows + no]
    older = state.moved[..., 0, :]
    into = eps[..., rows + no :].sum(axis=-2) + older @ bound.responses.tail_eps.T
    state = state._replace(past=_followed(state.past, v), moved=_followed(state.moved, into))
    # What is older than the ring belongs to all constants: it is shared out evenly.
    first = sizes[..., rows:] + (older @ bound.responses.tail_outputs.T)[..., None, :] / p if p else sizes[..., rows:]
    return state, sizes[..., :rows].sum(axis=-2) + older @ bound.tail_rows.T, first, np.zeros((*runs, no))


def _channels(bound: AdaptiveBound, rows: FloatArray) -> FloatArray:
    """Return the size of each channel ``(..., m)`` from its rows ``(..., rows)``."""
    return np.moveaxis(bound.structure.channel_sizes(np.moveaxis(rows, -1, 0)), 0, -1)


def _followed(ring: FloatArray, row: FloatArray) -> FloatArray:
    """Return a ring ``(..., L, n)`` without its oldest row, with the newest ``(..., n)`` at its end."""
    return np.concatenate([ring[..., 1:, :], row[..., None, :]], axis=-2)

"""The recursion of the adaptive threshold: a sample of one or of many runs at once; records are a scan of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.verification.over_tolerances.adaptive_bound import AdaptiveBound

#: What rounding of the threshold itself may take from it.
THRESHOLD_ROUNDING = 1.0 + 1e-10

#: Samples of all runs together that are taken at once.
SAMPLES_AT_ONCE = 512


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


#: What of a state has runs in its first axis.
_ARRAYS = ("psi", "ring", "eps", "largest", "past", "moved")


#: State, bounds of the channel rows, ``|phi|`` of each constant, and the shift of the outputs' middle.
_FirstOrder: TypeAlias = tuple[AdaptiveState, FloatArray, FloatArray, FloatArray]


def thresholds_of_records(
    bound: AdaptiveBound, estimates: FloatArray, inputs: FloatArray, outputs: FloatArray
) -> Thresholds:
    """Return the thresholds for records from the start; ``estimates (runs, steps, n)`` by `ErrorStructure.reading`."""
    runs, steps, _ = estimates.shape
    p, *_, no = bound.counts
    shapes = (no,), (p, no), (no,), (no,), (no,)
    thresholds = Thresholds(*(np.empty((runs, steps, *shape)) for shape in shapes))
    state = AdaptiveState.of(bound, (runs,))
    # A few samples at a time stay in the processor's cache.
    size = max(1, SAMPLES_AT_ONCE // max(1, runs))
    for k in range(0, steps, size):
        part = slice(k, k + size)
        state, samples = _adaptive_samples(bound, state, estimates[:, part], inputs[:, part], outputs[:, part])
        for whole, some in zip(thresholds, samples, strict=True):
            whole[:, part] = some
    return thresholds


def adaptive_step(
    bound: AdaptiveBound, state: AdaptiveState, estimates: FloatArray, inputs: FloatArray, outputs: FloatArray
) -> tuple[AdaptiveState, Thresholds]:
    """Take one sample of one run: ``estimates (n,)`` as `ErrorStructure.reading` gives them; return the state after it
    too."""
    one = state._replace(**{name: getattr(state, name)[None] for name in _ARRAYS})
    after, thresholds = _adaptive_samples(bound, one, estimates[None, None], inputs[None, None], outputs[None, None])
    return after._replace(**{name: getattr(after, name)[0] for name in _ARRAYS}), Thresholds(
        *(item[0, 0] for item in thresholds)
    )


def _adaptive_samples(
    bound: AdaptiveBound, state: AdaptiveState, estimates: FloatArray, inputs: FloatArray, outputs: FloatArray
) -> tuple[AdaptiveState, Thresholds]:
    """Take some samples ``(runs, samples, ...)``: what follows from signals alone at once, what follows from older
    samples one by one."""
    *_, m, no = bound.counts
    count, length = estimates.shape[1], bound.length
    v = np.concatenate([estimates, inputs], axis=2)
    if bound.first is not None and state.k == 0:
        last = (inputs[:, 0] @ bound.first.T)[:, None]
        state = state._replace(psi=np.concatenate([state.psi[:, :-1], last], axis=1))
    state, moved, first, shift = (_varying if bound.varying else _constant)(bound, state, v)
    largest = np.empty((*v.shape[:2], state.largest.shape[1]))
    largest[..., -1] = 1.0
    np.abs(np.concatenate([inputs, outputs, estimates], axis=2), out=largest[..., :-1])
    np.maximum(largest[:, 0], state.largest, out=largest[:, 0])
    np.maximum.accumulate(largest, axis=1, out=largest)
    known = bound.known(estimates, inputs)
    begun = [bound.start_at(state.k + k) for k in range(count)]
    start = np.stack(begun) if count > 1 else begun[0][None]
    rounding = largest @ bound.rounding.T
    fixed = rounding + known @ bound.same + bound.nominal + start
    entering = known[..., :m] + fixed[..., :m] + _channels(bound, moved) @ bound.solved.T
    ring, eps = _continued(state.ring, count), _continued(state.eps, count)
    ring[:, length:, m:] = known[..., m:]
    older = np.empty((*v.shape[:2], bound.kernels.shape[1]))
    tail = bound.tail.T
    for k in range(count):
        now = ring[:, k : k + length].reshape(len(v), -1) @ bound.kernels
        now += eps[:, k] @ tail
        ring[:, length + k, :m] = entering[:, k] + now[:, :m]
        eps[:, length + k] = now[:, m + no :]
        older[:, k] = now
    rest = older[..., m : m + no] + rounding[..., m:] + ring[:, length:] @ bound.same[:, m:]
    total = (bound.nominal[m:] + start[:, m:] + first.sum(axis=2) + np.abs(shift) + rest) * THRESHOLD_ROUNDING
    after = state._replace(ring=ring[:, count:], eps=eps[:, count:], largest=largest[:, -1], k=state.k + count)
    return after, Thresholds(total, first, shift, start[None, :, m:], rest)


def _constant(bound: AdaptiveBound, state: AdaptiveState, v: FloatArray) -> _FirstOrder:
    p, nz, rows, _, no = bound.counts
    runs, count, nv = v.shape
    w = (v.reshape(-1, nv) @ bound.drive.reshape(-1, nv).T).reshape(runs, count, p, nz + rows + no)
    psi = np.empty((runs, count, p, nz))
    now, turned = state.psi, bound.structure.Az.T
    for k in range(count):
        psi[:, k] = now
        now = (now.reshape(-1, nz) @ turned).reshape(runs, p, nz) + w[:, k, :, :nz]
    responses = (psi.reshape(-1, nz) @ bound.output_rows.T).reshape(runs, count, p, rows + no)
    responses += w[..., nz:]
    sizes, offsets = np.abs(responses), bound.structure.offsets
    moved, shift = sizes[..., :rows].sum(axis=-2), np.zeros((runs, count, no))
    if offsets.any():
        middle = offsets @ responses
        moved, shift = moved + np.abs(middle[..., :rows]), -middle[..., rows:]
    return state._replace(psi=now), moved, sizes[..., rows:], shift


def _varying(bound: AdaptiveBound, state: AdaptiveState, v: FloatArray) -> _FirstOrder:
    """Return the same for constants that may change at each sample: sums of absolute values, sample by sample."""
    p, nz, rows, _, no = bound.counts
    (runs, count, nv), length = v.shape, bound.length
    past, moved = _continued(state.past, count), _continued(state.moved, count)
    past[:, length:] = v
    eps = np.zeros((runs, count, p * (rows + no + nz)))
    for j, memory in enumerate(bound.memory.reshape(length, -1, nv)):
        eps += np.abs(past[:, j : j + count] @ memory.T)
    eps = eps.reshape(runs, count, p, rows + no + nz) * bound.spans[:, None]
    now = (v @ bound.drive[:, nz:].reshape(-1, nv).T).reshape(runs, count, p, rows + no)
    sizes = np.abs(now) * bound.spans[:, None] + eps[..., : rows + no]
    into, tail = eps[..., rows + no :].sum(axis=2), bound.responses.tail_eps.T
    for k in range(count):
        moved[:, length + k] = into[:, k] + moved[:, k] @ tail
    older = moved[:, :count]
    # What is older than the ring belongs to all constants: it is shared out evenly.
    first = sizes[..., rows:]
    if p:
        first = first + (older @ bound.responses.tail_outputs.T)[..., None, :] / p
    state = state._replace(past=past[:, count:], moved=moved[:, count:])
    return state, sizes[..., :rows].sum(axis=2) + older @ bound.tail_rows.T, first, np.zeros((runs, count, no))


def _channels(bound: AdaptiveBound, rows: FloatArray) -> FloatArray:
    """Return the size of each channel ``(..., m)`` from the sizes of its rows ``(..., rows)``."""
    single = bound.structure.single
    if single == rows.shape[-1]:
        return rows
    return np.concatenate([rows[..., :single], rows[..., single:].max(axis=-1, keepdims=True)], axis=-1)


def _continued(ring: FloatArray, count: int) -> FloatArray:
    """Return a ring ``(runs, L, n)`` with room for further rows behind it."""
    runs, length, width = ring.shape
    longer = np.empty((runs, length + count, width))
    longer[:, :length] = ring
    return longer

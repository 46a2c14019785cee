"""The adaptive threshold sample by sample: the recursion of `adaptive_record` with its state as plain arrays."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from obsynth.experiments.monitors.adaptive_bound import THRESHOLD_ROUNDING, AdaptiveBound
from obsynth.numerics.arrays import FloatArray


@dataclass
class AdaptiveState:
    """What goes from sample to sample.

    ``psi (p, nz)`` sensitivities; ``ring (L, w)`` and ``eps (L, nz)``, oldest first; ``largest`` signals so far; for
    varying constants ``past (L, nv)`` signals and ``moved (L, nz)`` bounds; ``k`` samples since the start.
    """

    psi: FloatArray
    ring: FloatArray
    eps: FloatArray
    largest: FloatArray
    past: FloatArray
    moved: FloatArray
    k: int = 0

    @classmethod
    def of(cls, bound: AdaptiveBound) -> AdaptiveState:
        """Return the state before the first sample."""
        p, nz, *_ = bound.counts
        length = bound.length
        past = (length, bound.drive.shape[2]) if bound.varying else (0, 0)
        largest = np.zeros(bound.rounding.shape[1])
        largest[-1] = 1.0
        return cls(
            np.zeros((p, nz)), np.zeros((length, bound.width)), np.zeros((length, nz)), largest, np.zeros(past),
            np.zeros((length, nz) if bound.varying else (0, 0)),
        )  # fmt: skip

    def as_dict(self) -> dict[str, Any]:
        """Return plain data."""
        return {item.name: getattr(self, item.name) for item in fields(self)}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> AdaptiveState:
        """Return what `as_dict` described."""
        arrays: dict[str, Any] = {name: np.array(value) for name, value in data.items() if name != "k"}
        return cls(**arrays, k=int(data["k"]))


@dataclass(frozen=True, eq=False)
class AdaptiveStep:
    """Bounds of the outputs at one sample: ``total, shift, rest, start (no,)`` and ``first (p, no)``."""

    total: FloatArray
    first: FloatArray
    shift: FloatArray
    start: FloatArray
    rest: FloatArray


def adaptive_step(
    bound: AdaptiveBound, state: AdaptiveState, estimates: FloatArray, inputs: FloatArray, outputs: FloatArray
) -> AdaptiveStep:
    """Take one sample: ``estimates (n,)`` as `ErrorStructure.reading` gives them; the state is changed."""
    _, nz, rows, m, no = bound.counts
    v = np.concatenate([estimates, inputs])
    moved, first, shift = (_varying if bound.varying else _constant)(bound, state, v)
    sizes = np.abs(np.concatenate([inputs, outputs, estimates]))
    np.maximum(state.largest[:-1], sizes, out=state.largest[:-1])
    known = bound.known(estimates, inputs)
    start = bound.start_at(state.k)
    rounding = bound.rounding @ state.largest
    older = state.ring.reshape(-1) @ bound.kernels + bound.tail @ state.eps[0]
    fixed = rounding + known @ bound.same + bound.nominal + start
    h = known.copy()
    h[:m] += older[:m] + fixed[:m] + bound.solved @ bound.structure.seen(moved)
    rest = older[m : m + no] + rounding[m:] + h @ bound.same[:, m:]
    total = (bound.nominal[m:] + start[m:] + first.sum(axis=0) + np.abs(shift) + rest) * THRESHOLD_ROUNDING
    state.ring[:-1], state.eps[:-1] = state.ring[1:], state.eps[1:]
    state.ring[-1], state.eps[-1] = h, older[m + no :]
    state.k += 1
    del nz, rows
    return AdaptiveStep(total, first, shift, start[m:], rest)


def _constant(bound: AdaptiveBound, state: AdaptiveState, v: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    p, nz, rows, _, no = bound.counts
    if not p:
        return np.zeros(rows), np.zeros((0, no)), np.zeros(no)
    w = bound.drive @ v
    seen = w[:, nz:] + state.psi @ bound.shown.T
    state.psi = state.psi @ bound.structure.Az.T + w[:, :nz]
    sizes, offsets = np.abs(seen), bound.structure.offsets
    moved, shift = sizes[:, :rows].sum(axis=0), np.zeros(no)
    if offsets.any():
        middle = offsets @ seen
        moved, shift = moved + np.abs(middle[:rows]), -middle[rows:]
    return moved, sizes[:, rows:], shift


def _varying(bound: AdaptiveBound, state: AdaptiveState, v: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    p, nz, rows, _, no = bound.counts
    if not p:
        return np.zeros(rows), np.zeros((0, no)), np.zeros(no)
    eps = np.abs(np.einsum("jprv,jv->jpr", bound.memory, state.past)).sum(axis=0) * bound.spans[:, None]
    sizes = np.abs(bound.drive[:, nz:] @ v) * bound.spans[:, None] + eps[:, : rows + no]
    older = state.moved[0].copy()
    into = eps[:, rows + no :].sum(axis=0) + bound.responses.tail_eps @ older
    state.past[:-1], state.moved[:-1] = state.past[1:], state.moved[1:]
    state.past[-1], state.moved[-1] = v, into
    tail = bound.tail_rows @ older
    first = sizes[:, rows:] + (bound.responses.tail_outputs @ older) / p
    return sizes[:, :rows].sum(axis=0) + tail, first, np.zeros(no)

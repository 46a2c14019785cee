"""The adaptive threshold on a log, row by row: the recursion of `adaptive_record` with its state as plain arrays."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from obsynth.experiments.monitors.adaptive_bound import THRESHOLD_ROUNDING, AdaptiveBound
from obsynth.experiments.monitors.adaptive_record import thresholds_of_records
from obsynth.experiments.monitors.online import LinearSample, Rule
from obsynth.experiments.monitors.rules import FITTING_SHARE, NormRule
from obsynth.numerics.arrays import FloatArray


@dataclass
class AdaptiveState:
    """What goes from sample to sample, rings with the oldest first."""

    psi: FloatArray  # ``(p, nz)``: sensitivities
    ring: FloatArray  # ``(L, w)``
    eps: FloatArray  # ``(L, nz)``
    largest: FloatArray
    past: FloatArray  # ``(L, nv)``: signals, for varying constants
    moved: FloatArray  # ``(L, nz)``: bounds, for varying constants
    k: int = 0  # samples since the start

    @classmethod
    def of(cls, bound: AdaptiveBound) -> AdaptiveState:
        """Return the state before the first sample."""
        (p, nz, *_), length = bound.counts, bound.length
        shapes = (p, nz), (length, bound.width), (length, nz)
        largest = np.zeros(bound.rounding.shape[1])
        largest[-1] = 1.0
        memory = ((length, bound.drive.shape[2]), (length, nz)) if bound.varying else ((0, 0), (0, 0))
        psi, ring, eps, past, moved = (np.zeros(shape) for shape in (*shapes, *memory))
        return cls(psi, ring, eps, largest, past, moved)

    def as_dict(self) -> dict[str, Any]:
        """Return plain data."""
        return dict(vars(self))

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
    *_, m, no = bound.counts
    v = np.concatenate([estimates, inputs])
    if bound.first is not None and state.k == 0:
        state.psi[-1] = bound.first @ inputs
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


#: Rings after which an error that nothing is known of is forgotten to a millionth.
FORGETTING_RINGS = 3


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


def norm_beyond_nominal(plan: AdaptivePlan, found: AdaptiveStep) -> float:
    """Return what box, start and rounding add to the norm of the residual."""
    rows = plan.residuals
    parts = [found.shift[rows], found.rest[rows], plan.bound.more[rows], *found.first[:, rows]]
    if plan.start_beyond_nominal:
        parts.append(found.start[rows])
    return math.fsum(math.hypot(*part) for part in parts)


class AdaptiveRule(Rule):
    """The norm of the residual against the nominal bound and what the box adds; rows and fault estimates beside it."""

    GUARANTEES = True
    KEPT = ("last", "waiting")

    def __init__(self, plan: AdaptivePlan, later: AdaptivePlan, nominal: NormRule) -> None:
        self.plan, self._nominal = plan, nominal
        self._restarted = later.bound, later.faults
        self._bound, self._faults = plan.bound, plan.faults
        self._state = AdaptiveState.of(self._bound)
        self._fault_state = None if self._faults is None else AdaptiveState.of(self._faults)
        self.cells: tuple[float, ...] = (math.nan,) * len(plan.columns)
        self.last: float | None = None
        self.waiting = 0

    def _irregular(self, time: float) -> bool:
        """Whether a row of a continuous design is not where its sampled observer expects it."""
        dt, last = self.plan.sample_time, self.last
        self.last = time
        return dt is not None and last is not None and abs(time - last - dt) > FITTING_SHARE * dt

    def take(
        self, time: float, residuals: FloatArray, evidence: Any, *, deciding: bool
    ) -> tuple[float, float, int | None]:
        """Return statistic and threshold: those of the residual's norm, or of the row that is passed most."""
        if not isinstance(evidence, LinearSample):
            self.restart()
            self.cells = (math.nan,) * len(self.plan.columns)
            return math.nan, math.nan, None
        if self._irregular(time):
            # What the observer did over another interval is an error of its own, which must be forgotten first.
            self.restart()
            self.waiting = FORGETTING_RINGS * self._bound.length
        self.waiting = max(self.waiting - 1, 0)
        signals = evidence.inputs, evidence.outputs
        found = error = adaptive_step(self._bound, self._state, self._bound.structure.reading @ evidence.rows, *signals)
        if self._faults is not None and self._fault_state is not None:
            estimates = self._faults.structure.reading @ evidence.rows
            error = adaptive_step(self._faults, self._fault_state, estimates, *signals)
        values, at = evidence.rows[len(evidence.rows) - len(found.total) :], self.plan.residuals
        if self.plan.sample_time is None:
            statistic, nominal, _ = self._nominal.take(time, residuals, evidence, deciding=deciding)
            threshold = (nominal + norm_beyond_nominal(self.plan, found)) * THRESHOLD_ROUNDING
        else:
            statistic, threshold = math.hypot(*values[at]), math.hypot(*found.total[at])
        nf = len(self.plan.fault_names)
        self.cells = self._cells(values[:nf], found, error)
        if self.waiting:
            return math.nan, math.nan, None
        if not deciding:
            return math.nan, threshold, None
        ratios = np.abs(values) / found.total
        worst = int(np.argmax(ratios)) if len(ratios) else 0
        if statistic <= threshold and len(ratios) and ratios[worst] > 1.0:
            # The row is passed although the norm is not: it decides, in the scale of the norm's threshold.
            return threshold * float(ratios[worst]), threshold, worst if worst < nf else None
        passed = int(np.argmax(ratios[:nf])) if nf and ratios[:nf].max() > 1.0 else None
        return statistic, threshold, passed

    def _cells(self, faults: FloatArray, found: AdaptiveStep, error: AdaptiveStep) -> tuple[float, ...]:
        nf = len(faults)
        cells = found.total.tolist()
        if self.plan.intervals:
            width = error.total[:nf] - np.abs(error.shift[:nf])
            middle = faults - error.shift[:nf]
            cells += np.stack([middle - width, middle + width], axis=1).ravel().tolist()
        watched = slice(0, nf) if nf else self.plan.residuals
        count = len(self.plan.names)
        first = error.first.reshape(-1, count, len(error.total)).sum(axis=0) if count else error.first
        shares = (first[:, watched] / error.total[watched]).mean(axis=1) if count else np.zeros(0)
        return (*cells, *shares.tolist())

    def restart(self) -> None:
        """Begin again: what is known of the error at the first start holds for no other one, but its norm."""
        self._nominal.restart()
        self._bound, self._faults = self._restarted
        self._state = AdaptiveState.of(self._bound)
        self._fault_state = None if self._faults is None else AdaptiveState.of(self._faults)

    def options(self) -> list[Any]:
        """Return names of constants, how they vary, and the size of the nominal bound."""
        return [list(self.plan.names), self._bound.varying, float(self._bound.nominal.sum())]

    def as_dict(self) -> dict[str, Any]:
        """Return the state that goes from row to row, as data."""
        return {
            **super().as_dict(),
            "nominal": self._nominal.as_dict(),
            "first": self._bound is self.plan.bound,
            "state": self._state.as_dict(),
            "faults": None if self._fault_state is None else self._fault_state.as_dict(),
        }

    def resume(self, data: Mapping[str, Any]) -> None:
        """Go on from what `as_dict` returned."""
        super().resume(data)
        if not data["first"]:
            self._bound, self._faults = self._restarted
        self._nominal.resume(data["nominal"])
        self._state = AdaptiveState.from_dict(data["state"])
        if data["faults"] is not None:
            self._fault_state = AdaptiveState.from_dict(data["faults"])


def record_columns(
    plan: AdaptivePlan, rows: FloatArray, inputs: FloatArray, outputs: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return thresholds ``(runs, steps, no)`` and intervals of faults ``(runs, steps, nf, 2)`` over whole records."""
    found = thresholds_of_records(plan.bound, rows @ plan.bound.structure.reading.T, inputs, outputs)
    nf, error = len(plan.fault_names), found
    if plan.faults is not None:
        error = thresholds_of_records(plan.faults, rows @ plan.faults.structure.reading.T, inputs, outputs)
    first = rows.shape[2] - found.total.shape[2]
    middle = rows[:, :, first : first + nf] - error.shift[:, :, :nf]
    width = error.total[:, :, :nf] - np.abs(error.shift[:, :, :nf])
    return found.total, np.stack([middle - width, middle + width], axis=3)

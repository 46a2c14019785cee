"""Monitors whose thresholds hold for every plant within its tolerances, with guaranteed intervals of the faults.

A rule goes row by row, with its state as plain arrays, or over many runs at once.  Then only those that lie between the
first order of a threshold and a bound that is linear in the largest signals so far are computed in full.  What counts
is a pass before something is wrong, and the first after.

For continuous designs on samples, with ``eps = z - Gamma_1 v - T x`` at these,
``eps+ = Az eps + (Az T + By C - T Phi) x + (Bu + By D - T Gamma) u + (By Dd d - T q) + By v``, q of d of any time
course; what the brackets leave at the nominal plant acts like one more constant, ``sampling``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from obsynth.analysis.transformations.linear_plants import algebraic_coordinates, discretise, eliminate_algebraic_states
from obsynth.analysis.transformations.uncertain_plant import AffinePlant, affine_plant, reduced_family
from obsynth.errors import PreconditionError, SpecError
from obsynth.experiments.assumptions import Assumptions
from obsynth.experiments.monitors.monitor import Judged, LinearSample, Rule, Sample
from obsynth.experiments.monitors.residual_model import noisy_plant, watches_estimates
from obsynth.experiments.monitors.rules import FITTING_SHARE, NormRule, NormState, norm_of
from obsynth.experiments.simulation import Runs
from obsynth.methods.verifying import tracking_of
from obsynth.numerics.arguments import FloatArray, is_finite_number, require_mapping
from obsynth.numerics.continuous import first_order_hold
from obsynth.observers.linear.observer import LinearObserver, sample_observer
from obsynth.plants.constants import ELIMINATED, SAMPLED, ConstantsBox, Uncertainty, shown
from obsynth.plants.descriptor import DescriptorSystem, require_known
from obsynth.proofs.affine import AffineMatrix, affine_block, affine_zero_order_hold
from obsynth.proofs.balls import rounded_up
from obsynth.proofs.contraction import inverse_bound
from obsynth.results.design import ObserverDesign
from obsynth.simulation.scenario import Scenario, resolve
from obsynth.tolerances.robustness import EXACT_MODEL, index_one_on_box, structure_of, values_at, with_tolerances
from obsynth.verification.adaptive_bound import (
    THRESHOLD_ROUNDING,
    AdaptiveBound,
    AdaptivePlan,
    Start,
    Thresholds,
    adaptive_bound,
    filtered,
    thresholds_of_records,
)
from obsynth.verification.error_structure import ErrorStructure, Tracking, error_structure, loop_radius

#: Share of a bound within which a value is not decided here: more than rounding can change.
UNDECIDED_SHARE = 1e-9
#: What rounding may change in the first order, as a share of the largest it can be.
FIRST_ORDER_ROUNDING = 1e-10
#: Samples of the first window after something went wrong; each next one is as long as all before.
FIRST_WINDOW = 8
#: Rings after which a signal no longer matters beyond rounding.
REMEMBERED_RINGS = 8


#: Values ``(steps, runs)`` that surely pass the threshold, and values that surely do not.
Sides: TypeAlias = tuple[np.ndarray, np.ndarray]


class Records(NamedTuple):
    """Runs, time in the first axis, with ``values`` of the outputs, their ``norm`` and its ``limits (steps,)``."""

    estimates: FloatArray
    inputs: FloatArray
    outputs: FloatArray
    values: FloatArray
    norm: FloatArray
    limits: FloatArray

    def of(self, runs: np.ndarray) -> Records:
        """Return some of the runs."""
        estimates, inputs, outputs, values, norm = (item[:, runs] for item in self[:5])
        return Records(estimates, inputs, outputs, values, norm, self.limits)


@dataclass(frozen=True, eq=False)
class Screening:
    """Bounds of a threshold, per largest signal so far."""

    plan: AdaptivePlan
    rest: FloatArray  # ``(no, nu + ny + n + 1)``: all but the first order
    slack: FloatArray  # ``(no, n + nu)``: what rounding may change in the first order
    _memory: dict[int, FloatArray] = field(default_factory=dict, repr=False)

    @classmethod
    def of(cls, plan: AdaptivePlan) -> Screening:
        """Return the screening of an adaptive threshold."""
        bound = plan.bound
        structure, responses = bound.structure, bound.responses
        _, nz, rows, m, no = bound.counts
        n, nu = bound.drive.shape[2] - structure.inputs.shape[1], structure.inputs.shape[1]
        first = np.zeros((rows + no, n + nu))
        for span, part in zip(bound.spans, bound.drive, strict=True):
            first += span * responses.gain(bound.shown, part[:nz], part[nz:])
        slack = FIRST_ORDER_ROUNDING * first[rows:]
        ny = bound.rounding.shape[1] - 1 - n - nu
        order = [*range(nu + ny, nu + ny + n), *range(nu)]
        # Columns: inputs, outputs, estimates, one.
        entering, known = bound.rounding.copy(), np.zeros((bound.width, bound.rounding.shape[1]))
        known[:, order] = _known(bound, n, nu)
        largest_start = np.maximum(bound.start.max(axis=0, initial=0.0), bound.start_later[1])
        entering[:m, order] += bound.solved @ structure.seen(first[:rows])
        entering += bound.same.T @ known
        entering[:, -1] += bound.nominal + largest_start
        gathered = bound.kernels.reshape(bound.length, bound.width, -1).sum(axis=0).T
        gathered = gathered[: m + no] + bound.tail[: m + no] @ (responses.repeated @ gathered[m + no :])
        closed = inverse_bound(gathered[:m, :m])
        if closed is None:
            return cls(plan, np.full((no, entering.shape[1]), np.inf), slack)
        ring = known.copy()
        ring[:m] = closed @ (entering[:m] + known[:m] + gathered[:m, m:] @ known[m:])
        return cls(plan, gathered[m:] @ ring + bound.rounding[m:] + bound.same[:, m:].T @ ring, slack)

    def sides(self, records: Records, begin: int, end: int, psi: FloatArray) -> tuple[Sides, FloatArray]:
        """Return what is decided between two samples, and the sensitivities ``psi (runs, p, nz)`` at the end."""
        plan, bound = self.plan, self.plan.bound
        p, nz, rows, m, no = bound.counts
        v = np.concatenate([records.estimates[begin:end], records.inputs[begin:end]], axis=2)
        steps, runs, nv = v.shape
        flat = np.ascontiguousarray(np.moveaxis(v, 1, 0)).reshape(-1, nv)
        into = (flat @ bound.drive[:, :nz].reshape(-1, nv).T).reshape(runs, steps, p, nz)
        states = filtered(bound.structure.Az, np.concatenate([psi[:, None], into], axis=1))
        phi = (flat @ bound.drive[:, nz + rows :].reshape(-1, nv).T).reshape(runs, steps, p, no)
        phi += (states[:, 1:].reshape(-1, nz) @ bound.structure.Co.T).reshape(phi.shape)
        phi = np.moveaxis(phi, 0, 1)
        shift = np.abs(np.tensordot(phi, bound.structure.offsets, axes=(2, 0)))
        largest = self._largest(records, begin, end)
        rest = largest @ self.rest.T
        n, nu, last = records.estimates.shape[2], records.inputs.shape[2], largest.shape[2] - 1
        slack = largest[:, :, [*range(last - n, last), *range(nu)]] @ self.slack.T
        start = np.array([bound.start_at(k)[m:] for k in range(begin, end)])[:, None]
        certain = bound.nominal[m:] + start + np.abs(phi).sum(axis=2) + shift
        values, norm = records.values[begin:end], records.norm[begin:end]
        above = (values > (certain + rest + slack) * (1.0 + UNDECIDED_SHARE)).any(axis=2)
        below = (values <= (certain - slack) * (1.0 - UNDECIDED_SHARE)).all(axis=2)
        at = plan.residuals
        parts = np.linalg.norm(phi[..., at], axis=3).sum(axis=2) + np.linalg.norm(shift[..., at], axis=2)
        beside = parts + (np.linalg.norm(start[..., at], axis=2) if plan.start_beyond_nominal else 0.0)
        spread = np.linalg.norm(slack[..., at], axis=2) * (p + 1)
        limit = records.limits[begin:end, None] + beside
        most = limit + spread + np.linalg.norm(rest[..., at], axis=2) + np.linalg.norm(bound.more[at])
        above |= norm > most * THRESHOLD_ROUNDING * (1.0 + UNDECIDED_SHARE)
        below &= norm <= (limit - spread) * (1.0 - UNDECIDED_SHARE)
        return (above, below), states[:, -1] @ bound.structure.Az.T + into[:, -1]

    def sensitivities(self, records: Records, k: int) -> FloatArray:
        """Return the sensitivities ``(runs, p, nz)`` at a sample, from the signals before it."""
        bound = self.plan.bound
        p, nz, *_ = bound.counts
        length = min(k, REMEMBERED_RINGS * bound.length)
        if length not in self._memory:
            effect, found = bound.drive[:, :nz], []
            for _ in range(length):
                found.append(effect.reshape(p * nz, -1).T)
                effect = bound.structure.Az @ effect
            self._memory[length] = np.vstack([*found[::-1], np.zeros((0, p * nz))])
        v = np.concatenate([records.estimates[k - length : k], records.inputs[k - length : k]], axis=2)
        flat = np.moveaxis(v, 1, 0).reshape(v.shape[1], -1)
        return np.asarray(flat @ self._memory[length]).reshape(-1, p, nz)

    def _largest(self, records: Records, begin: int, end: int) -> FloatArray:
        """Return the largest signals up to each sample, ``(end - begin, runs, nu + ny + n + 1)``."""
        parts = [records.inputs, records.outputs, records.estimates]
        now = np.concatenate([np.abs(part[begin:end]) for part in parts], axis=2)
        if begin:
            before = np.concatenate([np.abs(part[:begin]).max(axis=0) for part in parts], axis=1)
            now[0] = np.maximum(now[0], before)
        now = np.maximum.accumulate(now, axis=0)
        return np.concatenate([now, np.ones((*now.shape[:2], 1))], axis=2)

    def passed_in(self, runs: Runs, norm: FloatArray, limits: FloatArray, onset: int | None) -> NDArray[np.bool_]:
        """Return at which samples of which runs a threshold is passed; ``norm (steps, runs)`` of the residual, and its
        nominal ``limits (steps,)``.  With an ``onset`` only the first pass after it need be right, and any before."""
        plan = self.plan
        *_, m, no = plan.bound.counts
        values = np.abs(runs.rows[:, :, runs.rows.shape[2] - no :])
        # No threshold over the box is below the nominal one: runs that never pass that need no other.
        start = np.array([plan.bound.start_at(k)[m:] for k in range(len(values))])
        begun = np.linalg.norm(start[:, plan.residuals], axis=1) if plan.start_beyond_nominal else 0.0
        candidates = (values > (plan.bound.nominal[m:] + start)[:, None]).any(axis=2)
        candidates |= norm > (limits + begun)[:, None]
        if onset is None or plan.bound.varying or plan.bound.first is not None:
            return self._all_passed(runs, values, norm, limits, candidates)
        passed = np.zeros(norm.shape, dtype=bool)
        chosen = np.flatnonzero(candidates.any(axis=0))
        if not len(chosen):
            return passed
        reading = plan.bound.structure.reading
        records = Records(
            runs.rows[:, chosen] @ reading.T,
            runs.inputs[:, chosen],
            runs.outputs[:, chosen],
            values[:, chosen],
            norm[:, chosen],
            limits,
        )
        sure, left = first_passed(self, records, candidates[:, chosen], onset)
        passed[:, chosen] = sure
        if left.any():
            undecided = np.zeros_like(passed)
            undecided[:, chosen] = left
            length = int(np.flatnonzero(left.any(axis=1))[-1]) + 1
            passed |= self._all_passed(runs, values, norm, limits[:length], undecided)
        return passed

    def _all_passed(
        self, runs: Runs, values: FloatArray, norm: FloatArray, limits: FloatArray, candidates: NDArray[np.bool_]
    ) -> NDArray[np.bool_]:
        """Compute the thresholds of runs with candidates in full, for as many samples as there are limits."""
        plan, length = self.plan, len(limits)
        passed = np.zeros(norm.shape, dtype=bool)
        chosen = np.flatnonzero(candidates.any(axis=0))
        if not len(chosen):
            return passed
        rows, inputs, outputs = (
            np.ascontiguousarray(np.moveaxis(signals[:, chosen], 1, 0))[:, :length]
            for signals in (runs.rows, runs.inputs, runs.outputs)
        )
        found = thresholds_of_records(plan.bound, rows @ plan.bound.structure.reading.T, inputs, outputs)
        at = plan.residuals
        parts = [found.shift[..., at], found.rest[..., at], *np.moveaxis(found.first[..., at], 2, 0)]
        if plan.start_beyond_nominal:
            parts.append(found.start[..., at])
        beside = sum(np.linalg.norm(part, axis=2) for part in parts) + np.linalg.norm(plan.bound.more[at])
        limit = (limits[:, None] + np.asarray(beside).T) * THRESHOLD_ROUNDING
        if plan.sample_time is not None:
            # Where the norm passes, one of the rows does.
            limit = np.full_like(limit, np.inf)
        beyond = (values[:length, chosen] > np.moveaxis(found.total, 0, 1)).any(axis=2)
        passed[:length, chosen] = (norm[:length, chosen] > limit) | beyond
        return np.asarray(passed & candidates)


def _known(bound: AdaptiveBound, n: int, nu: int) -> FloatArray:
    """Return what signals put into the ring at most, per largest estimate and input ``(w, n + nu)``."""
    structure = bound.structure
    own, m = len(structure.owner), structure.channels
    found = np.zeros((bound.width, n + nu))
    rows = np.abs(structure.channel_rows[own:])
    single = structure.single - own
    found[own : structure.single, :n] = rows[:single]
    if len(rows) > single:
        found[structure.single, :n] = rows[single:].max(axis=0)
    for place, number in enumerate(bound.remainder_inputs):
        found[m + place, n + number] = 1.0
    return found


def first_passed(
    screening: Screening, records: Records, candidates: np.ndarray, begin: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return samples ``(steps, runs)`` that surely pass, and those to be computed in full: the first one counts."""
    above, left = np.zeros(candidates.shape, dtype=bool), np.zeros(candidates.shape, dtype=bool)
    p, nz, *_ = screening.plan.bound.counts
    early = np.flatnonzero(candidates[:begin].any(axis=0))
    if len(early):
        (passed, below), _ = screening.sides(records.of(early), 0, begin, np.zeros((len(early), p, nz)))
        above[:begin, early] = passed & candidates[:begin, early]
        open_runs = ~above[:begin, early].any(axis=0)
        left[:begin, early] = candidates[:begin, early] & ~below & open_runs
    todo = np.flatnonzero(candidates[begin:].any(axis=0))
    if not len(todo):
        return above, left
    psi, at, size = screening.sensitivities(records.of(todo), begin), begin, FIRST_WINDOW
    while len(todo) and at < len(candidates):
        end = min(at + size, len(candidates))
        (passed, below), psi = screening.sides(records.of(todo), at, end, psi)
        above[at:end, todo] = passed & candidates[at:end, todo]
        left[at:end, todo] = candidates[at:end, todo] & ~below & ~passed
        going = ~above[at:end, todo].any(axis=0)
        todo, psi, at, size = todo[going], psi[going], end, 2 * size
    first = np.argmax(above[begin:], axis=0) + begin
    first[~above[begin:].any(axis=0)] = len(candidates)
    # What comes after the first that surely passes does not count.
    left &= np.arange(len(candidates))[:, None] < first
    return above, left


class AdaptiveState(NamedTuple):
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


def adaptive_step(
    bound: AdaptiveBound, state: AdaptiveState, estimates: FloatArray, inputs: FloatArray, outputs: FloatArray
) -> tuple[AdaptiveState, Thresholds]:
    """Take one sample: ``estimates (n,)`` as `ErrorStructure.reading` gives them; return the state after it as well."""
    *_, m, no = bound.counts
    v = np.concatenate([estimates, inputs])
    if bound.first is not None and state.k == 0:
        state = state._replace(psi=np.vstack([state.psi[:-1], bound.first @ inputs]))
    moved, first, shift = np.zeros(bound.counts[2]), np.zeros((0, no)), np.zeros(no)
    if bound.counts[0]:
        state, moved, first, shift = (_varying if bound.varying else _constant)(bound, state, v)
    sizes = np.abs(np.concatenate([inputs, outputs, estimates, np.ones(1)]))
    state = state._replace(largest=np.maximum(state.largest, sizes))
    known = bound.known(estimates, inputs)
    start = bound.start_at(state.k)
    rounding = bound.rounding @ state.largest
    older = state.ring.reshape(-1) @ bound.kernels + bound.tail @ state.eps[0]
    fixed = rounding + known @ bound.same + bound.nominal + start
    h = known.copy()
    h[:m] += older[:m] + fixed[:m] + bound.solved @ bound.structure.seen(moved)
    rest = older[m : m + no] + rounding[m:] + h @ bound.same[:, m:]
    total = (bound.nominal[m:] + start[m:] + first.sum(axis=0) + np.abs(shift) + rest) * THRESHOLD_ROUNDING
    ring, eps = np.vstack([state.ring[1:], h]), np.vstack([state.eps[1:], older[m + no :]])
    after = state._replace(ring=ring, eps=eps, k=state.k + 1)
    return after, Thresholds(total, first, shift, start[m:], rest)


_First: TypeAlias = tuple[AdaptiveState, FloatArray, FloatArray, FloatArray]


def _constant(bound: AdaptiveBound, state: AdaptiveState, v: FloatArray) -> _First:
    _, nz, rows, _, no = bound.counts
    w = bound.drive @ v
    seen = w[:, nz:] + state.psi @ bound.shown.T
    state = state._replace(psi=state.psi @ bound.structure.Az.T + w[:, :nz])
    sizes, offsets = np.abs(seen), bound.structure.offsets
    moved, shift = sizes[:, :rows].sum(axis=0), np.zeros(no)
    if offsets.any():
        middle = offsets @ seen
        moved, shift = moved + np.abs(middle[:rows]), -middle[rows:]
    return state, moved, sizes[:, rows:], shift


def _varying(bound: AdaptiveBound, state: AdaptiveState, v: FloatArray) -> _First:
    p, nz, rows, _, no = bound.counts
    eps = np.abs(np.einsum("jprv,jv->jpr", bound.memory, state.past)).sum(axis=0) * bound.spans[:, None]
    sizes = np.abs(bound.drive[:, nz:] @ v) * bound.spans[:, None] + eps[:, : rows + no]
    older = state.moved[0]
    into = eps[:, rows + no :].sum(axis=0) + bound.responses.tail_eps @ older
    state = state._replace(past=np.vstack([state.past[1:], v]), moved=np.vstack([state.moved[1:], into]))
    tail = bound.tail_rows @ older
    first = sizes[:, rows:] + (bound.responses.tail_outputs @ older) / p
    return state, sizes[:, :rows].sum(axis=0) + tail, first, np.zeros(no)


#: Rings after which an error that nothing is known of has decayed to a millionth.
FORGETTING_RINGS = 3


class AdaptiveRuleState(NamedTuple):
    """The state of `AdaptiveRule`."""

    nominal: NormState | None  # of the bound without the box, where there is one
    without: AdaptiveState  # without a fault, and for fault estimates during one where that is another
    during: AdaptiveState | None
    first: bool = True  # whether this is the first start, of which more may be known than of later ones
    last: float | None = None
    waiting: int = 0


class AdaptiveRule(Rule):
    """The norm of the residual against the nominal bound and what the box adds; rows and fault estimates beside it."""

    GUARANTEES = True

    def __init__(self, plan: AdaptivePlan, later: AdaptivePlan, nominal: NormRule | None) -> None:
        self.plan, self._later, self.nominal = plan, later, nominal
        self.table, self.columns = None if nominal is None else nominal.table, plan.columns

    def init(self) -> AdaptiveRuleState:
        """Return the state before the first sample."""
        return self._begun(None if self.nominal is None else self.nominal.init(), self.plan)

    def _begun(self, nominal: NormState | None, plan: AdaptivePlan) -> AdaptiveRuleState:
        during = None if plan.faults is None else AdaptiveState.of(plan.faults)
        return AdaptiveRuleState(nominal, AdaptiveState.of(plan.bound), during, plan is self.plan)

    def restart(self, state: AdaptiveRuleState, skipped: int = 0) -> AdaptiveRuleState:
        """Begin again: what is known of the error at the first start holds for no other one, but its norm."""
        nominal = state.nominal
        if self.nominal is not None and nominal is not None:
            nominal = self.nominal.restart(nominal)
        return self._begun(nominal, self._later)._replace(first=False, last=state.last, waiting=state.waiting)

    def step(self, state: AdaptiveRuleState, sample: Sample) -> tuple[AdaptiveRuleState, Judged]:
        """Return the state, statistic and threshold: those of the residual's norm, or of the row passed most."""
        said, dt = sample.said, self.plan.sample_time
        if not isinstance(said, LinearSample):
            return self.restart(state), Judged(math.nan, math.nan, None, (math.nan,) * len(self.columns))
        last, state = state.last, state._replace(last=sample.time)
        if dt is not None and last is not None and abs(sample.time - last - dt) > FITTING_SHARE * dt:
            # What the observer did over another interval is an error of its own, which must decay first.
            state = self.restart(state)._replace(waiting=FORGETTING_RINGS * self._later.bound.length)
        plan = self.plan if state.first else self._later
        signals, bound = (said.inputs, said.outputs), plan.bound
        without, found = adaptive_step(bound, state.without, bound.structure.reading @ said.rows, *signals)
        during, error = state.during, found
        if plan.faults is not None and during is not None:
            during, error = adaptive_step(plan.faults, during, plan.faults.structure.reading @ said.rows, *signals)
        state = state._replace(without=without, during=during, waiting=max(state.waiting - 1, 0))
        values, at = said.rows[len(said.rows) - len(found.total) :], plan.residuals
        if dt is None and self.nominal is not None and state.nominal is not None:
            nominal, (statistic, threshold, *_) = self.nominal.step(state.nominal, sample)
            state = state._replace(nominal=nominal)
            # What box, start and rounding add to the norm of the residual.
            parts = [found.shift[at], found.rest[at], plan.bound.more[at], *found.first[:, at]]
            if plan.start_beyond_nominal:
                parts.append(found.start[at])
            threshold = (threshold + math.fsum(math.hypot(*part) for part in parts)) * THRESHOLD_ROUNDING
        else:
            statistic, threshold = math.hypot(*values[at]), math.hypot(*found.total[at])
        nf = len(plan.fault_names)
        cells = self._cells(values[:nf], found, error)
        if state.waiting or not sample.deciding:
            return state, Judged(math.nan, math.nan if state.waiting else threshold, None, cells)
        ratios = np.abs(values) / found.total
        worst = int(np.argmax(ratios)) if len(ratios) else 0
        if statistic <= threshold and len(ratios) and ratios[worst] > 1.0:
            # The row is passed although the norm is not: it decides, in the scale of the norm's threshold.
            value = threshold * float(ratios[worst])
            return state, Judged(value, threshold, worst if worst < nf else None, cells)
        passed = int(np.argmax(ratios[:nf])) if nf and ratios[:nf].max() > 1.0 else None
        return state, Judged(statistic, threshold, passed, cells)

    def _cells(self, faults: FloatArray, found: Thresholds, error: Thresholds) -> tuple[float, ...]:
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

    def options(self) -> list[Any]:
        """Return names of constants, how they vary, the size of the nominal bound, and the limit without the box."""
        bound, limit = self.plan.bound, None if self.nominal is None else self.nominal.options()
        return [list(self.plan.names), bound.varying, float(bound.nominal.sum()), limit]

    def statistics(self, residuals: FloatArray) -> FloatArray:
        """Return the norm of the residual in records."""
        return np.asarray(norm_of(residuals))

    @cached_property
    def _screening(self) -> Screening:
        return Screening.of(self.plan)

    def passed_in(self, runs: Runs, norm: FloatArray, limits: FloatArray, onset: int | None) -> NDArray[np.bool_]:
        """Return where runs pass a threshold; nothing is computed in full that bounds decide."""
        return self._screening.passed_in(runs, norm, limits, onset)


#: Pieces of an interval in which a disturbance has a sign of its own.
SIGNED_PIECES = 16
#: Covers the rounding of a matrix exponential in double precision, and of a few sums.
SERIES_SLACK, SUM_SLACK = 1.0 + 1e-9, 1.0 + 1e-12
#: The name under which what the sampled observer misses counts among the constants.
SAMPLING = "sampling"


class SampledProblem(NamedTuple):
    """The error system of a continuous design at the samples of its data."""

    affine: AffinePlant
    observer: LinearObserver
    tracking: Tracking
    bounds: FloatArray  # of all pieces
    reading: FloatArray  # ``(n, nx)``: the dynamic state from the plant's
    first: FloatArray  # ``(nz, nu)``: first inputs to eps at the start
    ramp: FloatArray
    unknown: FloatArray  # ``(nz,)``: first disturbance and noise to eps at the start, at most

    def start(self, known: Start, box: tuple[FloatArray, FloatArray] | None) -> Start:
        """Return what is known of eps at the start; ``box`` of the plant's state, middle and half width."""
        z, t = known.state, self.tracking.T
        if box is None:
            if known.stated and not self.affine.C.is_certain:
                raise PreconditionError(
                    "A constant with a tolerance is in C: the norm of the error at the start bounds too little; give "
                    "initial_set (--initial).",
                    condition="start",
                )
            radius = self.unknown if known.stated else np.zeros(len(z))
            return Start(len(z), norm=known.norm, radius=radius, state=z)
        center, radius = self.reading @ box[0], np.abs(self.reading) @ box[1]
        moved = self.affine.C.spread + self.affine.C.radius
        seen = np.abs(self.ramp) @ (moved @ (np.abs(center) + radius))
        size = np.abs(t) @ radius + seen + self.unknown
        followed = (t + self.ramp @ self.affine.C.center) @ center
        far = np.abs(self.ramp) @ (np.abs(self.affine.C.center) @ radius)
        return Start(len(z), center=z - followed, radius=(size + far) * SUM_SLACK, state=z)


def sampled_problem(design: ObserverDesign, dt: float, bounds: FloatArray, noise_bound: float) -> SampledProblem:
    """Return the sampled error system of a continuous design; `PreconditionError` where there is none."""
    plant, observer = design.linear
    uncertain = plant.uncertainty if plant.uncertainty is not None else Uncertainty(ConstantsBox({}), {})
    if uncertain.box.variation == "varying":
        raise PreconditionError(
            "The constants may vary, and the design is continuous in time: their values between samples have no "
            "bound. Sample the plant first (transform: sample_time), or state constants that stay the same.",
            condition="discrete time",
        )
    exact = AffinePlant(plant, uncertain.box, {}, np.eye(plant.nx))
    followed = tracking_of(design, exact).T
    reduced, basis = reduced_family(plant, uncertain)
    # The plant's state from its dynamic part, the algebraic one left out.
    is_eliminated = any(kind == ELIMINATED for kind, _ in uncertain.steps)
    into = np.eye(plant.nx) if is_eliminated else algebraic_coordinates(plant)[1]
    back = 2.0 * np.eye(len(basis)) - basis
    reading = back @ np.linalg.pinv(into)
    smooth = eliminate_algebraic_states(plant).plant
    moving, held = affine_zero_order_hold(reduced["A"], reduced["B"], dt)
    pieces = _pieces(reduced["A"], reduced["Bd"], dt)
    nd, nf = plant.nd, plant.nf
    zero = AffineMatrix.exact(np.zeros((len(basis), nd)), moving.count)
    blind = AffineMatrix.exact(np.zeros((plant.ny, nd * SIGNED_PIECES)), moving.count)
    bd, dd = affine_block([[*pieces, zero]]), affine_block([[blind, reduced["Dd"]]])
    bw, dw = _noise(smooth, back, dt)
    matrices = {
        "E": AffineMatrix.exact(np.eye(len(basis)), moving.count),
        "A": moving,
        "B": held,
        "C": reduced["C"],
        "D": reduced["D"],
        "Bd": bd,
        "Dd": dd,
        "Bf": AffineMatrix.exact(np.zeros((len(basis), nf)), moving.count),
        "Df": reduced["Df"],
    }
    offsets = uncertain.box.offsets
    sampled = DescriptorSystem(
        None,
        moving.at(offsets),
        held.at(offsets),
        C=reduced["C"].at(offsets),
        D=reduced["D"].at(offsets),
        Bd=bd.at(offsets),
        Dd=dd.at(offsets),
        Bw=bw,
        Dw=dw,
        dt=dt,
    )
    affine = AffinePlant(sampled, uncertain.box, matrices, np.eye(len(basis)))
    inputs = np.hstack([observer.Bu, observer.By])
    ramp = first_order_hold(observer.Az, inputs, dt)[2]
    through_u, through_y = ramp[:, : plant.nu], ramp[:, plant.nu :]
    t = followed @ plant.E @ into @ basis - through_y @ affine.C.center
    if plant.nu and not affine.D.is_certain:
        raise PreconditionError(
            "A constant with a tolerance is in D, and the design is continuous in time: sample the plant first "
            "(transform: sample_time).",
            condition="discrete time",
        )
    unknown = np.abs(through_y) @ (reduced["Dd"].magnitude @ bounds + np.abs(dw).sum(axis=1) * noise_bound)
    first = -(through_u + through_y @ affine.D.center)
    sizes = np.concatenate([np.tile(bounds, SIGNED_PIECES), bounds])
    empty = np.zeros((len(observer.Cz), len(basis)))
    return SampledProblem(
        affine, sample_observer(observer, dt), Tracking(t, empty), sizes, reading, first, through_y, unknown
    )


def _pieces(a: AffineMatrix, bd: AffineMatrix, dt: float) -> list[AffineMatrix]:
    """Return what a disturbance of one sign does in each piece of an interval, newest first ``(n, nd)``.
    The remainder holds a change of sign inside a piece: at most a quarter of its length, squared, times the slope."""
    from scipy.linalg import expm

    width = dt / SIGNED_PIECES
    step, gathered = affine_zero_order_hold(a, bd, width)
    size = a.magnitude
    # ``exp(S)`` bounds ``sum_k S^k / (k + 1)!`` for ``S >= 0``.
    growth = np.eye(len(size)) + size * width @ (expm(size * width) * SERIES_SLACK)
    found, piece, value = [], gathered, bd
    for _ in range(SIGNED_PIECES):
        slope = size @ (growth @ value.magnitude)
        found.append(piece.enlarged(rounded_up(0.25 * width**2 * slope, 6)))
        piece, value = step @ piece, step @ value
    return found


def _noise(smooth: DescriptorSystem, back: FloatArray, dt: float) -> tuple[FloatArray, FloatArray]:
    """Return the noise of the plant gathered in a sample, and that of the sensors, as columns side by side."""
    process, sensors = smooth.Bw.any(axis=0), smooth.Dw.any(axis=0)
    if (process & sensors).any():
        raise PreconditionError(
            "One noise acts on the plant and on a sensor, which has no model between samples.", condition="noise"
        )
    gathered = np.zeros((smooth.nx, 0))
    if process.any():
        whole = DescriptorSystem(None, smooth.A, C=np.eye(smooth.nx), Bw=smooth.Bw[:, process])
        gathered = back @ discretise(whole, dt).plant.Bw
    measurement_noise = smooth.Dw[:, sensors]
    return (
        np.hstack([gathered, np.zeros((smooth.nx, measurement_noise.shape[1]))]),
        np.hstack([np.zeros((smooth.ny, gathered.shape[1])), measurement_noise]),
    )


#: Radii of a set are made larger by this share: more than the rounding of their sums.
RADIUS_OUTWARD = 1e-12
#: What a statement adds where no tolerance is known.
NO_TOLERANCE = f"; {EXACT_MODEL}"


def adaptive_plan(
    design: ObserverDesign,
    bounds: FloatArray,
    noise_bound: float,
    *,
    initial_error: float | None,
    initial_set: Mapping[str, Any] | None,
    observer_state: FloatArray | None = None,
    sample_time: float | None = None,
) -> tuple[AdaptivePlan, AdaptivePlan]:
    """Return the plans from the first start on and after a later one, over the plant's box, if there is a bound."""
    plant, observer = design.linear
    if plant.uncertainty is not None and plant.uncertainty.box.names:
        found = index_one_on_box(plant)
        if found.verdict == "refuted" and found.at is not None:
            values = values_at(plant.uncertainty.box, found.at)
            where = ", ".join(f"{name} = {value:.6g}" for name, value in values.items())
            raise PreconditionError(
                f"The plant is singular, or not of index 1, inside the box: at {where}. Give smaller tolerances.",
                condition="regularity",
            )
    if not plant.is_discrete:
        return _sampled_plan(design, bounds, noise_bound, initial_error, initial_set, observer_state, sample_time)
    affine = affine_plant(plant)
    tracking = tracking_of(design, affine)
    varying = affine.box.variation == "varying"
    noise = noise_bound if plant.nw else 0.0
    sizes = np.where(np.isfinite(bounds), bounds, 0.0)
    structure = structure_of(design, affine, tracking, bounds=sizes, noise_bound=noise)
    _require_bounds(structure, bounds, plant)
    z = np.zeros(observer.order) if observer_state is None else observer_state
    start = start_of(affine, tracking, initial_error, initial_set, z)
    later = Start(observer.order, norm=initial_error, state=z)
    reason, faults, same = "", None, False
    try:
        with_faults = structure_of(design, affine, tracking, bounds=sizes, noise_bound=noise, faults=True)
        same = affine.Bf.is_certain and affine.Df.is_certain
        faults = None if same else with_faults
    except PreconditionError as error:
        reason = str(error)

    def plan(begin: Start) -> AdaptivePlan:
        return AdaptivePlan(
            adaptive_bound(structure, observer, begin, varying=varying),
            None if faults is None else adaptive_bound(faults, observer, begin, varying=varying),
            same,
            reason,
            begin.norm is None,
            watches_estimates(design) or not observer.residual_names,
            affine.box.names,
            observer.fault_names,
            observer.residual_names,
        )

    return plan(start), plan(later)


def _sampled_plan(
    design: ObserverDesign,
    bounds: FloatArray,
    noise_bound: float,
    initial_error: float | None,
    initial_set: Mapping[str, Any] | None,
    observer_state: FloatArray | None,
    sample_time: float | None,
) -> tuple[AdaptivePlan, AdaptivePlan]:
    """Return the plans of a continuous design, whose observer runs on samples."""
    plant, observer = design.linear
    if sample_time is None:
        raise SpecError("A continuous design needs the sample_time of its data.", path="sample_time")
    noise = noise_bound if plant.nw else 0.0
    problem = sampled_problem(design, sample_time, np.where(np.isfinite(bounds), bounds, 0.0), noise)
    structure = error_structure(
        problem.observer, problem.affine, problem.tracking, problem.bounds, noise, reading=problem.reading
    )
    _require_bounds(structure, np.tile(bounds, SIGNED_PIECES + 1), plant)
    z = np.zeros(observer.order) if observer_state is None else observer_state
    box = None if initial_set is None else initial_box(plant, initial_set)
    stated = Start(observer.order, norm=initial_error, state=z)
    why = "the fault is estimated through the dynamics of a continuous design, which a change of it takes time to pass"

    def plan(begin: Start) -> AdaptivePlan:
        bound = adaptive_bound(structure, problem.observer, begin, varying=False)
        return AdaptivePlan(
            replace(bound, first=problem.first),
            None,
            False,
            why,
            True,
            watches_estimates(design),
            (*problem.affine.box.names, SAMPLING),
            observer.fault_names,
            observer.residual_names,
            sample_time,
        )

    return plan(problem.start(stated, box)), plan(problem.start(stated, None))


def _require_bounds(structure: ErrorStructure, bounds: FloatArray, plant: DescriptorSystem) -> None:
    """Raise `SpecError` where a disturbance without a bound reaches the error."""
    reached = structure.disturbances.magnitude.max(axis=0, initial=0.0)[: len(bounds)] > 0.0
    lacking = sorted({int(i) % plant.nd for i in np.flatnonzero(reached & ~np.isfinite(bounds))})
    if lacking:
        names = ", ".join(plant.disturbance_names[i] for i in lacking)
        raise SpecError(
            f"No bound is given on {names}: give disturbance_bounds (--disturbance).", path="disturbance_bounds"
        )


def start_of(
    affine: AffinePlant,
    tracking: Tracking,
    initial_error: float | None,
    initial_set: Mapping[str, Any] | None,
    z: FloatArray,
) -> Start:
    """Return what is known of eps at the start, ``z - T E(q) x`` for x in a box."""
    plant = affine.plant
    if initial_set is None:
        return Start(len(z), norm=initial_error, state=z)
    center, radius = initial_box(plant, initial_set)
    back = 2.0 * np.eye(plant.nx) - affine.coordinates
    followed = affine.E.after(tracking.T) @ back
    offset = followed.center @ center
    size = np.abs(followed.center) @ radius + (followed.spread + followed.radius) @ (np.abs(center) + radius)
    return Start(len(z), center=z - offset, radius=size * (1.0 + RADIUS_OUTWARD), state=z)


def initial_box(plant: DescriptorSystem, given: Mapping[str, Any]) -> tuple[FloatArray, FloatArray]:
    """Return middle and half width ``(nx,)`` of the plant's start; states that E does not see need no entry."""
    require_mapping(given, "initial_set")
    center, radius = np.zeros(plant.nx), np.zeros(plant.nx)
    needed = np.abs(plant.E).max(axis=0, initial=0.0) > 0.0
    require_known(given, plant.state_names, what="initial_set", kind="state")
    for i, name in enumerate(plant.state_names):
        if name not in given:
            if needed[i]:
                raise SpecError(
                    f"initial_set has no entry for the state {name!r}: give a bound, or [low, high].",
                    path="initial_set",
                )
            continue
        value = given[name]
        ends = list(value) if isinstance(value, (list, tuple, np.ndarray)) else [value]
        if len(ends) == 1 and is_finite_number(value):
            ends = [-value, value]
        if len(ends) != 2 or not all(map(is_finite_number, ends)) or not ends[0] <= ends[1]:
            raise SpecError(
                f"initial_set of {name!r} is {value!r}: give a bound of its absolute value, or [low, high].",
                path="initial_set",
            )
        low, high = map(float, ends)
        center[i], radius[i] = (low + high) / 2.0, (high - low) / 2.0
    return center, radius


def adaptive_statement(plan: AdaptivePlan, assumed: Assumptions) -> str:
    """Return what an alarm proves, what it rests on, and what bounds may do in the long run."""
    uncertain, box = assumed.plant.uncertainty, assumed.box
    kept = assumed.bounds_phrase if box is None else assumed.phrase()
    outside = "" if box is None else f": an alarm is a fault, or {box.sentence}"
    text = f"never passed without a fault{f', with {kept}' if kept else ''}{outside}"
    if box is None:
        return text + NO_TOLERANCE
    steps = () if uncertain is None else uncertain.steps
    sampled = any(kind == SAMPLED for kind, _ in steps)
    kept = ""
    if box.variation != "constant":
        kept = "; the state does not jump" if sampled else "; the value at k + 1 multiplies x(k+1)"
    radius = loop_radius(plan.bound.responses)
    ever = "" if radius < 1.0 else (f"; it holds at each sample, but may grow (loop radius {radius:.3g})")
    held = "; inputs and disturbances are held between samples" if sampled else ""
    if plan.sample_time is not None:
        apart = shown(plan.sample_time)
        held = f"; known inputs are held between rows, {apart} s apart, disturbances may move in between"
    why = (plan.reason[:1].lower() + plan.reason[1:]).partition(": ")[0].rstrip(".")
    missing = "" if plan.intervals or not plan.fault_names else f"; no guaranteed interval of faults: {why}"
    linear = "" if uncertain is None or not uncertain.not_covered else f"; {uncertain.not_covered}"
    return f"{text}{kept}{held}{ever}{missing}{linear}"


def tolerances_of(
    design: ObserverDesign,
    constants: Any,
    initial_set: Mapping[str, Any] | None,
    initial_error: float | None,
) -> tuple[ObserverDesign, bool]:
    """Return the design with the tolerances asked for, and whether its threshold adapts to the signals."""
    asked = constants is not None or initial_set is not None
    if initial_set is not None and initial_error is not None:
        raise SpecError("Give initial_set or initial_error, not both.", path="initial_set")
    return with_tolerances(design, constants)[0], asked


def noisy_design(design: ObserverDesign, scenario: Scenario | None) -> ObserverDesign:
    """Return a design whose plant has the noise of a scenario; tolerances stay."""
    if scenario is None:
        return design
    plant, _ = design.linear
    noise = noisy_plant(plant, scenario, resolve(plant, scenario))
    kept = noise.Bw.any(axis=0) | noise.Dw.any(axis=0)
    return design.replace(plant=noise.replace(Bw=noise.Bw[:, kept], Dw=noise.Dw[:, kept], noise_names=None))


def over_box(
    noisy: ObserverDesign,
    nominal: NormRule | None,
    bounds: FloatArray,
    noise_bound: float | None,
    initial_error: float | None,
    initial_set: Mapping[str, Any] | None,
    *,
    sample_time: float | None = None,
    scenario: Scenario | None = None,
) -> tuple[Rule, str]:
    """Return the pointwise rule over the box of the plant of a design with the noise that is bounded, and what it
    promises: for a record of a scenario, from its start unless one is given, or for data, which may have gaps."""
    plant, _ = noisy.linear
    state = None
    if scenario is not None:
        if not plant.is_discrete and scenario.inputs:
            raise PreconditionError(
                "The design is continuous in time, and the inputs of a scenario move between its samples: thresholds "
                "over tolerances need inputs that are held. Sample the plant first (transform: sample_time).",
                condition="discrete time",
            )
        state = None if scenario.observer_state is None else np.array(scenario.observer_state)
        sample_time = None if plant.is_discrete else scenario.sample_time
        if initial_set is None and initial_error is None:
            initial_set = {name: (scenario.initial_state.get(name, 0.0),) * 2 for name in plant.state_names}
    first, later = adaptive_plan(
        noisy,
        bounds,
        noise_bound or 0.0,
        initial_error=initial_error,
        initial_set=initial_set,
        observer_state=state,
        sample_time=sample_time,
    )
    assumed = Assumptions(plant, bounds, noise_bound or 0.0, initial_set, initial_error=initial_error)
    rule = AdaptiveRule(first, later if scenario is None else first, nominal)
    return rule, adaptive_statement(first, assumed)

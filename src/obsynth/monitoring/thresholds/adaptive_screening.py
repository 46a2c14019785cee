"""Which runs pass a threshold over a box, without computing all of it.

It lies between its first order and a bound that is linear in the largest signals so far; only runs in between are
computed in full.  What counts is a pass before something is wrong, and the first after.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from obsynth.numerics.arrays import FloatArray
from obsynth.proofs.nonnegative_matrices import inverse_bound
from obsynth.simulation.benches import Runs
from obsynth.verification.over_tolerances.adaptive_bound import AdaptiveBound
from obsynth.verification.over_tolerances.adaptive_recursion import (
    THRESHOLD_ROUNDING,
    AdaptivePlan,
    thresholds_of_records,
)

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
            first += span * responses.gain(bound.output_rows, part[:nz], part[nz:])
        slack = FIRST_ORDER_ROUNDING * first[rows:]
        ny = bound.rounding.shape[1] - 1 - n - nu
        order = [*range(nu + ny, nu + ny + n), *range(nu)]
        # Columns: inputs, outputs, estimates, one.
        per_signal, into_ring = bound.rounding.copy(), np.zeros((bound.width, bound.rounding.shape[1]))
        into_ring[:, order] = _known(bound, n, nu)
        largest_start = np.maximum(bound.start.max(axis=0, initial=0.0), bound.start_later[1])
        per_signal[:m, order] += bound.solved @ structure.channel_sizes(first[:rows])
        per_signal += bound.same.T @ into_ring
        per_signal[:, -1] += bound.nominal + largest_start
        gathered = bound.kernels.reshape(bound.length, bound.width, -1).sum(axis=0).T
        gathered = gathered[: m + no] + bound.tail[: m + no] @ (responses.repeated @ gathered[m + no :])
        closed = inverse_bound(gathered[:m, :m])
        if closed is None:
            return cls(plan, np.full((no, per_signal.shape[1]), np.inf), slack)
        ring = into_ring.copy()
        ring[:m] = closed @ (per_signal[:m] + into_ring[:m] + gathered[:m, m:] @ into_ring[m:])
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
        most = limit + spread + np.linalg.norm(rest[..., at], axis=2) + np.linalg.norm(bound.of_tolerances[at])
        above |= norm > most * THRESHOLD_ROUNDING * (1.0 + UNDECIDED_SHARE)
        below &= norm <= (limit - spread) * (1.0 - UNDECIDED_SHARE)
        return (above, below), states[:, -1] @ bound.structure.Az.T + into[:, -1]

    def sensitivities(self, records: Records, k: int) -> FloatArray:
        """Return the sensitivities ``(runs, p, nz)`` at a sample, from the signals before it."""
        bound = self.plan.bound
        p, nz, *_ = bound.counts
        length = min(k, REMEMBERED_RINGS * bound.length)
        if length not in self._memory:
            effect, responses = bound.drive[:, :nz], []
            for _ in range(length):
                responses.append(effect.reshape(p * nz, -1).T)
                effect = bound.structure.Az @ effect
            self._memory[length] = np.vstack([*responses[::-1], np.zeros((0, p * nz))])
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
        passing, open_rows = first_passed(self, records, candidates[:, chosen], onset)
        passed[:, chosen] = passing
        if open_rows.any():
            undecided = np.zeros_like(passed)
            undecided[:, chosen] = open_rows
            length = int(np.flatnonzero(open_rows.any(axis=1))[-1]) + 1
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
        thresholds = thresholds_of_records(plan.bound, rows @ plan.bound.structure.reading.T, inputs, outputs)
        at = plan.residuals
        parts = [thresholds.shift[..., at], thresholds.rest[..., at], *np.moveaxis(thresholds.first[..., at], 2, 0)]
        if plan.start_beyond_nominal:
            parts.append(thresholds.start[..., at])
        beside = sum(np.linalg.norm(part, axis=2) for part in parts) + np.linalg.norm(plan.bound.of_tolerances[at])
        limit = (limits[:, None] + np.asarray(beside).T) * THRESHOLD_ROUNDING
        if plan.sample_time is not None:
            # Where the norm passes, one of the rows does.
            limit = np.full_like(limit, np.inf)
        beyond = (values[:length, chosen] > np.moveaxis(thresholds.total, 0, 1)).any(axis=2)
        passed[:length, chosen] = (norm[:length, chosen] > limit) | beyond
        return np.asarray(passed & candidates)


def _known(bound: AdaptiveBound, n: int, nu: int) -> FloatArray:
    """Return what signals put into the ring at most, per largest estimate and input ``(w, n + nu)``."""
    structure = bound.structure
    own, m = len(structure.owner), structure.channels
    sizes = np.zeros((bound.width, n + nu))
    rows = np.abs(structure.channel_rows[own:])
    single = structure.single - own
    sizes[own : structure.single, :n] = rows[:single]
    if len(rows) > single:
        sizes[structure.single, :n] = rows[single:].max(axis=0)
    for place, number in enumerate(bound.remainder_inputs):
        sizes[m + place, n + number] = 1.0
    return sizes


def first_passed(
    screening: Screening, records: Records, candidates: np.ndarray, begin: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return samples ``(steps, runs)`` that surely pass, and those to be computed in full: the first one counts."""
    above, open_rows = np.zeros(candidates.shape, dtype=bool), np.zeros(candidates.shape, dtype=bool)
    p, nz, *_ = screening.plan.bound.counts
    early = np.flatnonzero(candidates[:begin].any(axis=0))
    if len(early):
        (passed, below), _ = screening.sides(records.of(early), 0, begin, np.zeros((len(early), p, nz)))
        above[:begin, early] = passed & candidates[:begin, early]
        open_runs = ~above[:begin, early].any(axis=0)
        open_rows[:begin, early] = candidates[:begin, early] & ~below & open_runs
    todo = np.flatnonzero(candidates[begin:].any(axis=0))
    if not len(todo):
        return above, open_rows
    psi, at, size = screening.sensitivities(records.of(todo), begin), begin, FIRST_WINDOW
    while len(todo) and at < len(candidates):
        end = min(at + size, len(candidates))
        (passed, below), psi = screening.sides(records.of(todo), at, end, psi)
        above[at:end, todo] = passed & candidates[at:end, todo]
        open_rows[at:end, todo] = candidates[at:end, todo] & ~below & ~passed
        going = ~above[at:end, todo].any(axis=0)
        todo, psi, at, size = todo[going], psi[going], end, 2 * size
    first = np.argmax(above[begin:], axis=0) + begin
    first[~above[begin:].any(axis=0)] = len(candidates)
    # What comes after the first that surely passes does not count.
    open_rows &= np.arange(len(candidates))[:, None] < first
    return above, open_rows


def filtered(az: FloatArray, w: FloatArray) -> FloatArray:
    """Return ``psi(k+1) = Az psi(k) + w(k)`` from zero, ``(runs, steps, p, nz)``; blocks side by side."""
    runs, steps, p, nz = w.shape
    size = max(1, int(np.sqrt(steps)))
    blocks = -(-steps // size)
    padded = np.zeros((runs, blocks * size, p, nz))
    padded[:, :steps] = w
    inside = np.ascontiguousarray(padded.reshape(runs, blocks, size, p, nz).transpose(2, 0, 1, 3, 4))
    states = np.zeros((size + 1, runs, blocks, p, nz))
    turned = np.ascontiguousarray(az.T)
    for k in range(size):
        states[k + 1] = inside[k]
        states[k + 1] += (states[k].reshape(-1, nz) @ turned).reshape(states[k].shape)
    power = np.linalg.matrix_power(turned, size)
    begins = np.zeros((runs, blocks, p, nz))
    for b in range(1, blocks):
        begins[:, b] = (begins[:, b - 1].reshape(-1, nz) @ power).reshape(runs, p, nz) + states[size, :, b - 1]
    step = begins
    for k in range(size):
        states[k] += step
        step = (step.reshape(-1, nz) @ turned).reshape(step.shape)
    joined = states[:size].transpose(1, 2, 0, 3, 4).reshape(runs, blocks * size, p, nz)
    return np.ascontiguousarray(joined[:, :steps])

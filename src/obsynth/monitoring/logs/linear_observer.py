"""A linear observer on a log, row by row, with gaps, bad rows and the warm-up."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import lru_cache, partial
from typing import ClassVar, TypeVar

import numpy as np

from obsynth.errors import ObsynthError, SpecError
from obsynth.methods.state_solver import state_solver
from obsynth.monitoring.logs.clock import LONGEST_BRIDGE
from obsynth.monitoring.logs.log_observer import GAP, OK, RECOVERING, WARM_UP, LogObserver, Row
from obsynth.monitoring.thresholds.monitor import LinearSample
from obsynth.numerics.arguments import real_number
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.continuous import first_order_hold
from obsynth.observers.linear.missing_samples import GAP_LEFT_SHARE, KEPT_INTERVALS, LEAST_SHOWN, MissingSamples
from obsynth.observers.linear.modes import transient
from obsynth.observers.taken_inputs import no_inputs, over_samples, taken_inputs
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.results.design import ObserverDesign

#: Guaranteed bounds are suspended after a gap until its effect is below this share of the usual changes, but at most
#: for so many durations of the initial-condition response.
GUARANTEED_SHARE, MOST_TRANSIENTS = 1e-3, 10

SAMPLED_GAP = "gap is for continuous-time designs: for a sampled one missing rows follow from the time stamps."

#: Number of steps after a gap whose effects are computed together.
STEPS_AT_ONCE = 256

#: Attributes that form the state between rows.
SAVED = (
    *("z", "v", "row", "model", "fault", "inputs", "measured", "seen"),
    *("moves", "reach"),
    *("clear_at", "begun", "changes", "counted", "gap_error", "held", "excess", "carried", "known_from", "bridged"),
)

_Part = TypeVar("_Part")


def _running(part: _Part | None) -> _Part:
    """Return a part of the state, which exists while the observer runs."""
    if part is None:
        raise ObsynthError(
            "The saved state is incomplete: its observer or plant model is missing. Start the run again."
        )
    return part


class LinearLogObserver(LogObserver):
    """A linear observer on a log; ``gap`` and ``warm_up`` in seconds, see `run_on_data`."""

    plant: DescriptorSystem
    saved: ClassVar = dict(zip(SAVED, SAVED, strict=True))

    def __init__(self, design: ObserverDesign, *, gap: float | None = None, warm_up: float | None = None) -> None:
        self.plant, self.observer = design.linear
        if gap is not None:
            real_number(gap, "gap", "seconds, a positive number", above=0.0)
        if gap is not None and self.observer.dt > 0.0:
            raise SpecError(SAMPLED_GAP, path="gap")
        super().__init__(self.observer, warm_up, transient(self.observer))
        self.options["gap"], self.input_delay = gap, design.input_delay
        self.input_names, self.output_names = self.observer.input_names, self.observer.output_names
        self.point, self.scales = self.plant.operating_point, self.plant.scales
        self.columns = self.observer.row_names
        missing = MissingSamples(self.plant, self.observer, state_solver(design))
        self.solver, self.gap_model, self.noise = missing.solver, missing.model, missing.noise
        self.nu = len(self.input_names)
        self.b = np.hstack([self.observer.Bu, self.observer.By])
        self.d = np.hstack([self.observer.Du, self.observer.Dy])
        self._hold = lru_cache(KEPT_INTERVALS)(partial(first_order_hold, self.observer.Az, self.b))
        self.z: FloatArray | None = None
        self.v = np.zeros(self.b.shape[1])
        self.row = np.full(len(self.observer.Cz), np.nan)
        self.model: FloatArray | None = None
        # Estimates of the plant's states at the last measured row, from which the model starts in a gap.
        self.seen = np.full(missing.known_states, np.nan)
        # Time from which on a gap has no effect, so that guaranteed bounds are valid; whether a run has begun before.
        self.clear_at, self.begun = -math.inf, False
        # Time from which on the initial-condition response has settled; whether the model has since then predicted all
        # missing values.
        self.known_from, self.bridged = math.inf, False
        # Sums of squared changes of fault estimates and residuals from row to row, and the number of these changes.
        self.shown = slice(len(self.observer.state_names), None)
        self.changes, self.counted = np.zeros(len(self.observer.Cz[self.shown])), 0
        # Effect on z of a unit error of each held input and of each output that the model predicted; the held inputs.
        self.gap_error, self.held = np.zeros(self.b.shape), np.zeros(self.nu)
        # History of the changes of inputs; bounds on the changes of missing inputs since they were measured.
        self.moves, self.reach = no_inputs(self.nu), np.zeros(self.nu)
        # Effect of the errors of the last gap on z, and of those of earlier gaps on the columns.
        self.excess, self.carried = np.zeros(self.b.shape), np.zeros(len(self.columns))
        self.transient = transient(self.observer)
        # All faults of the plant; those without an estimate are assumed to be zero.
        self.fault = np.zeros(self.plant.nf)
        self.estimated_faults = missing.estimated_faults
        self.measured = self.v
        self.kept_inputs = missing.kept_inputs
        self.inputs = np.zeros((0, self.nu))

    def _usual(self) -> FloatArray | None:
        """Return the effect of a gap on fault estimates and residuals that counts as usual; ``None`` if it is not known
        yet."""
        enough = self.counted >= LEAST_SHOWN
        if not enough and not self.noise.all():
            return None
        changes = self.changes / self.counted if enough else np.zeros_like(self.changes)
        return np.asarray(np.sqrt(np.maximum(GAP_LEFT_SHARE**2 * changes, self.noise)))

    def take(self, time: float, values: FloatArray, *, seconds: float, missing: int, longest: float) -> Row:
        """Take one row."""
        since = seconds
        good = bool(np.isfinite(values).all())
        previous = self.row if self.model is None and self.z is not None else None
        u = values[: self.nu]
        u = np.where(np.isfinite(u), u, self.v[: self.nu])
        # A sample that makes numbers overflow is a bad sample: the state is checked below.
        with np.errstate(over="ignore", invalid="ignore"):
            if missing:
                self._bridge_interval(seconds, missing, u)
                seconds = 0.0 if self.observer.dt == 0.0 else seconds
            recovered = unsure = self.warm_up
            if good and self.model is not None:
                self._propagate(seconds, u)
                recovered, unsure = self._recovering(seconds, values, longest)
                # The observer starts again if the model has lost the plant and a new start settles sooner.
                if recovered >= self.warm_up and self._lost(values):
                    self._restart()
            first = self.z is None
            if good and first:
                self.z, self.phase = np.zeros(self.observer.order), WARM_UP
                self.settled_at = self._after(time, self.warm_up)
                self.known_from = self._after(time, max(self.warm_up, self.transient))
                if self.begun:
                    self.clear_at = self.known_from
                self.begun = True
                self.inputs = self.inputs[:0]
                seconds = 0.0
            if good:
                if self.model is None:
                    self._advance_excess(seconds)
                self.moves = taken_inputs(self.moves, self.v[: self.nu], u, is_first=first).history
                estimates = self._measured(seconds, values)
                if self.model is not None:
                    self.model, self.gap_error, self.reach = None, np.zeros_like(self.gap_error), np.zeros(self.nu)
                    # The initial-condition response settles in as many measured rows as without a gap.  The effect of
                    # the gap is no larger than the rest of that response, and decays with it.
                    self.settled_at += since * missing / (missing + 1)
                    if self.phase != WARM_UP or time >= self.settled_at:
                        self.settled_at, self.phase = self._after(time, recovered), RECOVERING
                    self.clear_at = self._after(time, max(self.warm_up, self.transient, unsure))
                status = OK if time >= self.settled_at else self.phase
            else:
                estimates, status = self._unmeasured(seconds, u, values), GAP
        if status == GAP:
            self.settled_at += since if self.phase == WARM_UP else 0.0
            return Row(GAP, estimates, missing, bridged=self.bridged)
        if self.z is None or not (np.isfinite(self.z).all() and np.isfinite(estimates).all()):
            self._restart()
            return Row(GAP, self._held(), missing)
        self.fault = self._faults_in(estimates)
        # Rows after a gap are used to estimate the usual changes as long as there are too few others, which may never
        # come.
        counts = status == OK or (status == RECOVERING and self.counted < LEAST_SHOWN)
        if previous is not None and counts and not missing:
            self._count((estimates - previous)[None])
        sample = LinearSample(estimates, values[: self.nu], values[self.nu :], len(self.state_names))
        return self._complete_row(status, estimates, missing, sample, time)

    def _complete_row(
        self,
        status: str,
        estimates: FloatArray,
        missing: int,
        sample: LinearSample,
        time: float,
        *,
        clear: bool = False,
    ) -> Row:
        """Return a complete row; ``clear``: gaps are known to have no effect on it."""
        settled = time >= self.clear_at
        self.bridged |= settled and time >= self.known_from
        return Row(
            status, estimates, missing, sample, settled, None if clear else self._excess_in(status), self.bridged
        )

    def _excess_in(self, status: str) -> FloatArray | None:
        """Return a bound of the effect of gaps on the columns of a complete row; ``None`` unless it is recovering."""
        if status != RECOVERING:
            self.excess, self.carried = np.zeros_like(self.excess), np.zeros_like(self.carried)
            return None
        excess = self._output_excess()
        if self.observer.dt > 0.0:
            self.excess = self.observer.Az @ self.excess
        return excess

    def _output_excess(self) -> FloatArray:
        return np.asarray(self.carried + np.abs(self.observer.Cz @ self.excess).sum(axis=1))

    def _advance_excess(self, seconds: float) -> None:
        """Propagate the effect of a gap in a continuous observer to this row; a sampled one has done so already."""
        if self.observer.dt == 0.0 and seconds > 0.0 and self.excess.any():
            self.excess = self._hold(seconds)[0] @ self.excess

    @property
    def takes_pieces(self) -> bool:
        """Whether the observer runs without the model for missing samples, so that rows can be taken together."""
        return self.z is not None and self.model is None

    def take_piece(self, times: Sequence[float], values: FloatArray, intervals: Sequence[float]) -> list[Row]:
        """Take complete rows that follow each other without a gap; end before a number overflows."""
        count, observer = len(intervals), self.observer
        z, before, sampled = _running(self.z), self.v, observer.dt > 0.0
        states, rows = np.empty((count, observer.order)), np.empty((count, len(observer.Cz)))
        # The same products as in `step`, in the same order, so that results do not depend on where a piece ends.
        with np.errstate(over="ignore", invalid="ignore"):
            for k, v in enumerate(values[:count]):
                if not sampled:
                    transition, constant, ramp = self._hold(intervals[k])
                    z = transition @ z + constant @ before + ramp @ (v - before)
                    before = v
                states[k] = z
                rows[k] = observer.Cz @ z + self.d @ v + observer.added
                if sampled:
                    z = observer.Az @ z + self.b @ v
        after = np.vstack([states[1:], z]) if sampled else states
        finite = np.isfinite(after).all(axis=1) & np.isfinite(rows).all(axis=1)
        if not finite.all():
            count = int(np.argmin(finite))
            if not count:
                return []
        last = count - 1
        counts = np.array(times[:count]) >= self.settled_at
        if self.phase == RECOVERING:
            counts |= self.counted + np.cumsum(~counts) <= LEAST_SHOWN
        self._count(np.diff(np.vstack([self.row, rows[:count]]), axis=0)[counts])
        self.moves = over_samples(self.moves, self.v[: self.nu], values[:count, : self.nu])
        self.z, self.v, self.row, self.measured = np.array(after[last]), values[last], rows[last], values[last]
        self.fault = self._faults_in(rows[last])
        self.seen = self._states(states[last], values[last], rows[last], self.fault)
        self.inputs = np.vstack([self.inputs, values[:count, : self.nu]])[-self.kept_inputs :]
        settled, phase = self.settled_at, self.phase
        nu, nx, taken, clear = self.nu, len(self.state_names), list[Row](), False
        for time, seconds, row, v in zip(times[:count], intervals[:count], rows[:count], values[:count], strict=True):
            if not clear:
                self._advance_excess(seconds)
            status, sample = OK if time >= settled else phase, LinearSample(row, v[:nu], v[nu:], nx)
            taken.append(self._complete_row(status, row, 0, sample, time, clear=clear))
            clear = status != RECOVERING
        return taken

    def _measured(self, seconds: float, v: FloatArray) -> FloatArray:
        if self.observer.dt == 0.0:
            self._flow(seconds, v)
        z = _running(self.z)
        self.row = np.asarray(self.observer.Cz @ z + self.d @ v + self.observer.added)
        self.measured = v
        faults = self._faults_in(self.row)
        self.seen = self._states(z, v, self.row, faults)
        self._taken(v)
        return self.row

    def _states(self, z: FloatArray, v: FloatArray, row: FloatArray, fault: FloatArray) -> FloatArray:
        """Return the estimates of states at a sample with inputs and outputs ``v``."""
        if self.solver is None:
            return row[self.observer.state_rows]
        outputs = v[self.nu :] - self.plant.D @ v[: self.nu] - self.plant.Df @ fault
        return np.asarray(self.solver @ np.concatenate([z, outputs]))

    def _faults_in(self, row: FloatArray) -> FloatArray:
        """Return all faults of the plant ``(nf,)`` from a row of estimates."""
        faults = np.zeros(len(self.fault))
        faults[self.estimated_faults] = row[self.observer.fault_rows]
        return faults

    def _count(self, changes: FloatArray) -> None:
        """Add the squares of changes ``(n, rows)`` one after another, so that results do not depend on pieces."""
        with np.errstate(over="ignore"):
            squares = np.nan_to_num(changes[:, self.shown] ** 2, nan=0.0, posinf=0.0)
        self.changes = np.cumsum(np.vstack([self.changes, squares]), axis=0)[-1]
        self.counted += len(changes)

    def _recovering(self, seconds: float, v: FloatArray, longest: float) -> tuple[float, float]:
        """Return the seconds after a gap in which rows are not decided, and those in which nothing is guaranteed.

        The model has been propagated to this row.  Its errors grow during a gap, so that the present errors of its
        outputs are taken as bounds for the whole gap.  Their effect on fault estimates and residuals is computed until
        it is as small as usual changes.
        """
        gap_model, nu = _running(self.gap_model), self.nu
        missed = np.abs(v[nu:] - gap_model.outputs(_running(self.model), v[:nu], self.fault))
        # The error of a held input is at most its change since then, or a bound from its earlier changes.
        missed = np.concatenate([np.maximum(np.abs(v[:nu] - self.held), self.reach), missed])
        usual, step = self._usual(), self.observer.dt or longest
        if not (np.isfinite(self.gap_error).all() and step > 0.0):
            self.carried = np.full_like(self.carried, np.inf)
            return self.warm_up, self.warm_up
        a, remaining = self.observer.Az, self.gap_error
        if self.observer.dt == 0.0:
            transition, constant, _ = self._hold(seconds or step)
            from_model = remaining.any(axis=0) & np.repeat([False, True], [nu, len(self.output_names)])
            a, remaining = self._hold(step)[0], transition @ remaining + constant * from_model
        self.excess = remaining * missed
        if usual is None:
            return self.warm_up, self.warm_up
        longest_wait = MOST_TRANSIENTS * self.transient
        # The first row after a gap always counts as recovering.
        most = max(self.warm_up, longest_wait if np.isfinite(longest_wait) else 0.0)
        waited, recovered = 0.0, self.warm_up
        for effects in _effects_by_step(self.observer.Cz[self.shown], a, remaining, missed):
            # Added one after another, as in the C code.
            times = np.cumsum(np.concatenate([[waited], np.full(len(effects), step)]))
            within = np.count_nonzero(times[:-1] < most)
            quiet = np.flatnonzero((effects[:within] <= GUARANTEED_SHARE * usual).all(axis=1))
            last = int(quiet[0]) + 1 if quiet.size else within
            is_usual = np.flatnonzero((effects[:last] <= usual).all(axis=1))
            if is_usual.size:
                recovered = min(recovered, float(times[is_usual[0] + 1]))
            waited = float(times[last])
            if quiet.size or within < len(effects):
                break
        return recovered, waited

    def _lost(self, v: FloatArray) -> bool:
        """Whether the model's error in the outputs after a gap exceeds the sum of their sizes before and after it."""
        gap_model = _running(self.gap_model)
        if not self.gap_error[:, self.nu :].any():
            return False
        # An error that is not finite counts as lost as well.
        return not gap_model.miss(v, self.model, self.fault) <= gap_model.miss(self.measured) + gap_model.miss(v)

    def _taken(self, v: FloatArray) -> None:
        if self.observer.dt > 0.0:
            self.z = np.asarray(self.observer.Az @ _running(self.z) + self.b @ v)
        self.v = v
        self.inputs = np.vstack([self.inputs, v[: self.nu]])[-self.kept_inputs :]

    def _flow(self, seconds: float, v: FloatArray) -> None:
        """Propagate z of a continuous observer to the time of ``v``; its inputs are straight lines in between."""
        if seconds > 0.0:
            transition, constant, ramp = self._hold(seconds)
            self.z = np.asarray(transition @ _running(self.z) + constant @ self.v + ramp @ (v - self.v))

    def _bridge_interval(self, seconds: float, missing: int, u: FloatArray) -> None:
        """Propagate over missing rows, in continuous time up to this row's time; start again if they are too many."""
        if self.z is None:
            return
        if missing > LONGEST_BRIDGE:
            self._restart()
            return
        nothing = np.full_like(self.v, np.nan)
        begin, part = self.v[: self.nu].copy(), seconds / (missing + 1)
        for i in range(missing + 1):
            share = (i + 1) / (missing + 1)
            self._unmeasured(part, begin + (u - begin) * share, nothing)

    def _unmeasured(self, seconds: float, u: FloatArray, values: FloatArray) -> FloatArray:
        """Take one sample whose missing ``values (nu + ny,)`` the plant model predicts, and return the estimates.

        Fault estimates are held.  ``u (nu,)`` are the inputs, held where they are missing.
        """
        if self.z is None:
            return self._held()
        if self.gap_model is None:
            self._restart()
            return self._held()
        if self.model is None:
            self.carried, self.excess = self._output_excess(), np.zeros_like(self.excess)
            inputs = self.inputs if self.observer.dt > 0.0 else ()
            self.model, self.held = self.gap_model.start(self.seen, inputs, self.fault), self.v[: self.nu]
            if self.observer.dt == 0.0:
                self._propagate(seconds, u)
        else:
            self._propagate(seconds, u)
        # Measured values are used; the model predicts the others.
        from_model = ~np.isfinite(values)
        self.bridged &= not from_model[: self.nu].any()
        v = np.where(from_model, np.concatenate([u, self.gap_model.outputs(self.model, u, self.fault)]), values)
        self._unknown_inputs(np.where(from_model, np.nan, values)[: self.nu])
        if self.observer.dt == 0.0:
            self._flow(seconds, v)
            transition, constant, _ = self._hold(seconds)
            self.gap_error = transition @ self.gap_error + constant * from_model
        else:
            self.gap_error = self.observer.Az @ self.gap_error + self.b * from_model
        row = np.asarray(self.observer.Cz @ self.z + self.d @ v + self.observer.added)
        self._taken(v)
        row[self.observer.fault_rows] = self.fault[self.estimated_faults]
        row[self.observer.residual_rows] = np.nan
        if not np.isfinite(self.z).all():
            self._restart()
            return self._held()
        return row

    def _unknown_inputs(self, u: FloatArray) -> None:
        """Update the bounds on the changes of missing inputs (NaN in ``u (nu,)``)."""
        before, taken = self.v[: self.nu], taken_inputs(self.moves, self.v[: self.nu], u, is_first=False)
        lowest, highest, change, count, _ = taken.history
        returned = np.where((count == 0.0) & (self.moves[3] > 0.0), np.abs(taken.u - before), 0.0)
        # After one missing sample the error of an input is its change since then; after several, the input may have
        # changed and returned.
        moved = np.where(count > 1.0, np.minimum(count * change, highest - lowest), returned)
        self.moves, self.reach = taken.history, np.maximum(self.reach, moved)

    def _propagate(self, seconds: float, u: FloatArray) -> None:
        before, model = self.v[: self.nu], _running(self.model)
        self.model = _running(self.gap_model).after(model, seconds, before, u, self.fault)

    def _restart(self) -> None:
        self.z = self.model = None
        self.v, self.gap_error, self.reach = (
            np.zeros_like(self.v),
            np.zeros_like(self.gap_error),
            np.zeros_like(self.reach),
        )
        self.inputs = self.inputs[:0]
        self.excess, self.carried = np.zeros_like(self.excess), np.zeros_like(self.carried)
        self.settled_at, self.phase = math.inf, WARM_UP
        self.known_from, self.bridged = math.inf, False

    def _held(self) -> FloatArray:
        row = np.full(len(self.observer.Cz), np.nan)
        row[self.observer.fault_rows] = self.fault[self.estimated_faults]
        return row


def _effects_by_step(
    rows: FloatArray, a: FloatArray, remaining: FloatArray, missed: FloatArray
) -> Iterator[FloatArray]:
    """Yield bounds of the effect of errors during a gap on each row, for consecutive steps ``(steps, rows)``.

    The first steps are yielded one by one, later ones in groups, since slow modes of an observer may need tens of
    thousands.
    """
    for _ in range(STEPS_AT_ONCE):
        remaining = a @ remaining
        yield (np.abs(rows @ remaining) @ missed)[None]
    moved = [rows @ a]
    for _ in range(STEPS_AT_ONCE - 1):
        moved.append(moved[-1] @ a)
    each_step, power = np.array(moved), np.linalg.matrix_power(a, STEPS_AT_ONCE)
    while True:
        yield np.abs(each_step @ remaining) @ missed
        remaining = power @ remaining

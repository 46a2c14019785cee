"""Observers that take missing outputs themselves, on a log: held inputs, new starts, status."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from obsynth.errors import ObsynthError, PreconditionError, SolverError, SpecError, counted
from obsynth.monitoring.logs.log_observer import GAP, OK, PARTIAL, RECOVERING, WARM_UP, LogObserver, Row
from obsynth.monitoring.thresholds.monitor import Evidence
from obsynth.monitoring.thresholds.watched_columns import innovation_names
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.changed_options import as_run, rule_of_outliers
from obsynth.observers.nonlinear.observer import DAEObserver
from obsynth.observers.recursive.irregular_steps import IrregularSteps
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.observers.smoothing_chain import SmootherHistory
from obsynth.results.design import ObserverDesign
from obsynth.results.number_texts import point_in_time


class SteppingLogObserver(LogObserver):
    """An observer with deviations on a log (nonlinear plants: absolute values); the first row is k = 0.
    By default no warm-up, as covariances of the start say how uncertain the estimates are, and a gate for outliers
    where the observer says nothing of them."""

    saved: ClassVar = {
        "observer": "state",
        **{name: name for name in ("u", "spread", "usual", "left_out", "restarts", "first_restart")},
    }

    def __init__(self, design: ObserverDesign, *, warm_up: float | None = None, outliers: str | None = None) -> None:
        observer: Any = design.observer
        self.observer: RecursiveObserver | DAEObserver = as_run(observer, outliers, stated=rule_of_outliers(design))
        plant = design.plant
        super().__init__(self.observer, warm_up, 0.0)
        self.input_names, self.output_names = plant.input_names, plant.output_names
        self.input_delay = design.input_delay
        self.is_recursive, self.may_restart = isinstance(self.observer, RecursiveObserver), True
        self.intervals: IrregularSteps | None = None
        residuals = innovation_names(self.observer)
        if isinstance(self.observer, RecursiveObserver):
            model, Q, R = self.observer.plant, self.observer.Q, self.observer.R
            self.point, self.scales = model.operating_point, model.scales
            constant = model.is_time_invariant and Q.is_constant and R.is_constant
            self.may_restart = constant and model.horizon is None
            intervals = _irregular_steps(self.observer, design)
            self.intervals = None if isinstance(intervals, str) else intervals
            self.takes_any_interval = self.intervals is not None
            self.own_intervals_only = intervals if isinstance(intervals, str) else ""
        self.columns = (
            *self.estimated,
            *(f"sd {name}" for name in self.estimated),
            *(f"r[{name}]" for name in residuals),
        )
        self.directions = len(residuals)
        late = ", ".join(name for name, entry in (self.observer.sensors or {}).items() if entry["delay"])
        if late:
            self.notes = (
                f"Values of {late} are delayed: no row holds their innovations, and monitors use them through the "
                "estimates alone.",
            )
        #: Of a smoother: the samples since the observer last started.
        self.chain: SmootherHistory | None = None
        self.state: Any = self.observer.init()
        #: Seconds of the next step.
        self.seconds = self.dt
        self.u: FloatArray | None = None
        # Deviations of the faults at the last row, and before samples were missing: zero where nothing is left of that.
        self.spread = self.usual = np.zeros(len(self.fault_names))
        # Outliers before the observer last started, how often it did as the model had no solution, and first when.
        self.left_out = np.zeros(len(self.output_names))
        self.restarts, self.first_restart = 0, 0.0

    def follows(self, missing: int) -> bool:
        """Whether rows that are missing are taken one by one: always where the plant changes with k."""
        return super().follows(missing) or not self.may_restart

    def _begin(self) -> None:
        """Start the observer again."""
        self.left_out = self.left_out + self.state.refused[1]
        self.state = self.observer.init()
        if self.chain is not None:
            self.chain = SmootherHistory(self.chain.links)

    @property
    def gates(self) -> bool:
        """Whether a gate judges each sample in its own row."""
        return self.observer.outliers == "gate" and not self.observer.timing.longest

    @property
    def outliers(self) -> dict[str, int]:
        """How many samples of each output were outliers."""
        counts = self.left_out + self.state.refused[1]
        return {name: int(count) for name, count in zip(self.output_names, counts, strict=True) if count}

    def warnings(self) -> tuple[str, ...]:
        """Return a text where the observer started again as its model had no solution."""
        if not self.restarts:
            return ()
        first = point_in_time(self.first_restart)
        return (
            f"In {counted(self.restarts, 'row')} (the first at {first}) the model had no solution "
            "from the estimates before, and the observer started again: estimates there are those of the start, with "
            "its deviations. Either the model does not hold for these rows, or its steps are too long for them "
            "(integration, dt).",
        )

    def _begun(self, u: FloatArray) -> FloatArray:
        """Return inputs ``(nu,)`` with those of the row before where they are missing: an observer begins with known
        ones."""
        return np.where(np.isnan(u), 0.0 if self.u is None else self.u, u)

    def _taken(self, y: FloatArray, u: FloatArray) -> Evidence | None:
        """Take one sample, or none of it: `None` where numbers are no finite ones any more."""
        before = self.state
        u = u if self.state.k else self._begun(u)
        evidence: Evidence
        try:
            with np.errstate(all="ignore"):
                record_step = None if self.chain is None else self.chain.add
                self.state, evidence = self._stepping().accept(self.state, y, u, record_step)
        except (np.linalg.LinAlgError, ValueError):
            return None
        if evidence.is_finite:
            return evidence
        self.state = before
        return None

    def _stepping(self) -> RecursiveObserver | DAEObserver:
        """Return the observer of the next step: where its interval is not dt, one from the continuous plant."""
        if self.intervals is None or self.seconds == self.dt:
            return self.observer
        if self.chain is not None:
            raise SpecError(
                f"a row comes {self.seconds:.6g} s after the one before, and the design has dt = {self.dt:.6g} s: "
                "estimates are not smoothed over irregular time stamps; run without smooth and lag.",
                path="smooth",
            )
        return self.intervals.over(self.seconds)

    def _values(self, evidence: Evidence) -> FloatArray:
        """Return a row: estimates, standard deviations, innovation at the parameters of one sample before."""
        residual = np.full(self.directions, np.nan)
        # The correction of the start by early constraints has no more directions, but may have fewer.
        residual[: min(len(evidence.gap), self.directions)] = evidence.gap[: self.directions]
        deviations = np.sqrt(np.diag(evidence.parameter_covariance))
        return np.concatenate([evidence.x, evidence.theta, evidence.state_deviations, deviations, residual])

    def take(self, time: float, values: FloatArray, *, seconds: float, missing: int, longest: float) -> Row:
        """Take one row."""
        nu, fresh = len(self.input_names), self.u is None
        # After rows that nothing stands for the observer starts again: no step has that length.
        self.seconds = self.dt if missing else seconds
        finite = np.isfinite(values)
        if self.u is None and not self.is_recursive and not finite[:nu].all():
            # A nonlinear model has no zero to begin with: it begins when all inputs are known.
            return Row(GAP, np.full(len(self.columns), np.nan), missing)
        u, y = (np.where(finite, values, np.nan)[part] for part in (slice(nu), slice(nu, None)))
        if missing:
            self._begin()
            fresh = True
        total = self.state.refused[1]
        evidence, spoiled, restarted = self._evidence_of(y, u, may_restart=self.may_restart and not fresh)
        self.u, fresh = self._begun(u), fresh or restarted
        if restarted:
            self.restarts, self.first_restart = self.restarts + 1, self.first_restart if self.restarts else time
        if fresh:
            self.settled_at, self.phase = self._after(time, self.warm_up), WARM_UP
        elif nu and not finite[:nu].all():
            # A step took inputs that nobody measured.
            self.settled_at = self._after(time, self.warm_up)
            self.phase = WARM_UP if self.phase == WARM_UP else RECOVERING
        # A filter that begins with y(1) does not miss y(0).
        received = (finite[nu:] & ~self._refused(total)) | ~self.observer.timing.expected(self.state.k - 1)
        if fresh and self.is_recursive:
            received = np.ones_like(received)
        status = self._status(time, finite[:nu], received, spoiled=spoiled)
        complete = not spoiled and bool(finite[:nu].all() and received.all())
        return Row(
            status,
            self._values(evidence),
            missing,
            evidence,
            unsure=self._unsure(evidence, complete=complete, fresh=fresh),
        )

    def _unsure(self, evidence: Evidence, *, complete: bool, fresh: bool) -> FloatArray | None:
        """Return by how many times the deviations of faults are above those before samples were missing, after a row
        that is ``whole`` or lacks some; ``None`` where none is."""
        before, self.spread = self.spread, np.sqrt(np.diag(evidence.parameter_covariance))
        if fresh:
            self.usual = np.zeros_like(before)
        elif not complete:
            self.usual = np.where(self.usual > 0.0, self.usual, before)
        self.usual = np.where(self.spread > self.usual, self.usual, 0.0)
        if not self.usual.any():
            return None
        return np.divide(self.spread, self.usual, out=np.ones_like(before), where=self.usual > 0.0)

    def _refused(self, total: FloatArray) -> np.ndarray:
        """Return which outputs of the last sample were left out as outliers: of which more are than before it."""
        return np.asarray(self.state.refused[1] > total) & (self.observer.outliers == "gate")

    def _evidence_of(self, y: FloatArray, u: FloatArray, *, may_restart: bool) -> tuple[Evidence, bool, bool]:
        """Take one sample; return also whether its outputs were left out, and whether the observer started again."""
        evidence = self._safe(y, u)
        if evidence is not None:
            return evidence, False, False
        try:
            return self._required(u), True, False
        except ObsynthError:
            # An outlier may have led where the model cannot go on.
            if not may_restart:
                raise
        self._begin()
        evidence = self._safe(y, u)
        return (self._required(u), True, True) if evidence is None else (evidence, False, True)

    def _status(self, time: float, inputs: np.ndarray, outputs: np.ndarray, *, spoiled: bool) -> str:
        if spoiled or not inputs.all() or not outputs.any():
            return GAP
        if time < self.settled_at:
            return self.phase
        self.phase = OK
        return OK if outputs.all() else PARTIAL

    def _safe(self, y: FloatArray, u: FloatArray) -> Evidence | None:
        """Take one sample, or none of it where there is no solution either."""
        try:
            return self._taken(y, u)
        except SolverError:
            return None

    def _required(self, u: FloatArray) -> Evidence:
        """Take one sample without outputs."""
        evidence = self._taken(np.full(len(self.output_names), np.nan), u)
        if evidence is None:
            raise SpecError(
                "the estimates are no finite numbers any more: the model is unstable, or the inputs are too large.",
                path="inputs",
            )
        return evidence


def _irregular_steps(observer: RecursiveObserver, design: ObserverDesign) -> IrregularSteps | str:
    """Return the steps over any interval of an observer whose plant was sampled; why there are none, where there are
    none."""
    source = design.source
    if source is None or source.sample_time is None:
        return "its plant was stated in samples, and what happens between them is not known"
    try:
        return IrregularSteps(observer, source.plant)
    except (SpecError, PreconditionError) as error:
        return str(error)

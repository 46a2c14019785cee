"""Monitors of guaranteed tests: the threshold of the design itself, for records and for data of any length."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from obsynth.errors import SpecError
from obsynth.methods.guaranteed_test.bank import is_bank
from obsynth.methods.guaranteed_test.exact import Programmes
from obsynth.methods.guaranteed_test.method import GuaranteedTestMethod
from obsynth.methods.guaranteed_test.problem import window_as_designed
from obsynth.methods.guaranteed_test.regions import while_inside
from obsynth.methods.guaranteed_test.result import GuaranteedTest
from obsynth.methods.guaranteed_test.tolerant import HELD_BETWEEN_SAMPLES, noisy_as_bounded, rows_before
from obsynth.methods.guaranteed_test.windows import disturbances_in_words
from obsynth.monitoring.thresholds.adaptive_monitor import over_box
from obsynth.monitoring.thresholds.monitor import LinearSample, Monitor, Rule, RuleOutput, Sample
from obsynth.monitoring.thresholds.rules import NormRule
from obsynth.monitoring.thresholds.watched_rows import Watched
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.outward import lower_text, upper_text
from obsynth.observers.linear.observer import LinearObserver
from obsynth.observers.window.observer import WindowObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.results.design import ObserverDesign
from obsynth.results.number_texts import point_in_time
from obsynth.simulation.benches import make_bench
from obsynth.simulation.scenario import Scenario
from obsynth.verification.over_tolerances.stated_tolerances import with_tolerances

#: Options that other designs leave to their monitor.
STATED_BY_DESIGN = ("disturbance_bounds", "noise_bound", "initial_error", "gamma", "disturbance")


def refuse_bounds(options: Mapping[str, Any]) -> None:
    """Raise `SpecError` where bounds are given for a guaranteed test: those of its design count."""
    # The command line gives a mapping without entries where nothing is stated.
    stated = [name for name, value in options.items() if value is not None and value != {}]
    if stated:
        raise SpecError(
            f"{', '.join(stated)} cannot be given for a guaranteed test: its bounds are those of its design. Design it "
            "again with others.",
            path=stated[0],
        )


def _checked(design: ObserverDesign, kind: str, options: Mapping[str, Any]) -> GuaranteedTest:
    if kind != "pointwise":
        raise SpecError(
            f"kind is {kind!r}: a guaranteed test has its own threshold, use pointwise (the default).", path="kind"
        )
    refuse_bounds({name: options[name] for name in STATED_BY_DESIGN})
    test, why = GuaranteedTest.of(design), ""
    if isinstance(test.observer, WindowObserver):
        why = "A test of a plant that changes with k is for an exact model from any start: leave this out."
    elif test.options.get("exact") or is_bank(test):
        why = (
            f"{'isolate' if is_bank(test) else 'exact'} is for an exact model: design the test without it for a "
            "threshold over tolerances."
        )
    elif not test.linear[1].state_names:
        why = (
            "This guaranteed test is for an exact model: design it for a plant whose constants have tolerances, with a "
            "scenario, so that an observer of the state runs beside it."
        )
    refused = [name for name in ("constants", "initial_set") if options[name] is not None]
    if why and refused:
        raise SpecError(why, path=refused[0])
    return test


def _bounded(test: GuaranteedTest, constants: Any) -> tuple[ObserverDesign, FloatArray]:
    """Return the design for a plant with these tolerances and the noise of its own bounds; bounds of disturbances."""
    window = window_as_designed(test.linear[0], GuaranteedTestMethod.of(test.options))
    changed = test.replace(plant=noisy_as_bounded(window))
    return with_tolerances(changed, constants)[0], window.bounds.disturbance


def _between_samples(test: GuaranteedTest) -> str:
    """Return what disturbances do between samples, as the other monitors have it."""
    return "held" if test.options["disturbance"] in HELD_BETWEEN_SAMPLES else "any"


def _statement(test: GuaranteedTest) -> str:
    profile = test.options["course"]
    promises = "; ".join(
        _promise(test_of_group, group) for test_of_group, group in zip(test.tests, test.groups, strict=True)
    )
    ending = "; each row has the least interval for its own samples" if test.options.get("exact") else ""
    return f"{promises}, for a fault with the time course '{profile}'{ending}; for an exact model{while_inside(test)}"


def _promise(test: GuaranteedTest, group: tuple[str, ...]) -> str:
    # Bounds of states may show a fault of less than twice the least: that is then one of intervals.
    bounded = any(test.options.get(name) for name in ("state_bounds", "initial_bounds"))
    words = "estimates the fault to within less than" if bounded else "has a threshold below"
    least = "" if np.isnan(test.least) else f", and no function of these samples {words} {lower_text(test.least, 6)}"
    words = ""
    if isinstance(test.plant, DescriptorSystem):
        words = disturbances_in_words(window_as_designed(test.linear[0], GuaranteedTestMethod.of(test.options)))
    return (
        f"never passed without {' or '.join(group)} while disturbances and noise keep the bounds of the design"
        f"{f', for {words}' if words else ''}{least}; "
        f"a fault {test.fault} of {upper_text(test.surely_found, 6)} raises an alarm within {point_in_time(test.delay)}"
    )


def record_monitor(design: ObserverDesign, scenario: Scenario, kind: str, options: Mapping[str, Any]) -> Monitor:
    """Return the monitor of records as long as a scenario; ``options``: the options of a monitor by name."""
    test = _checked(design, kind, options)
    constants, initial_set = options["constants"], options["initial_set"]
    if isinstance(test.observer, WindowObserver):
        raise SpecError(
            "A test whose weights change with k is for measured data: use obsynth.online_monitor, or alarms() and "
            "limits() of the test on the estimates of its observer.",
            path="design",
        )
    bench = make_bench(design, scenario)
    runs = bench.run([scenario.seed])
    observer, tests = test.linear[1], test.tests
    signals = np.concatenate([np.abs(runs.inputs), np.abs(runs.outputs)], axis=2)
    floors = [
        float(np.max(signals @ row_test.certificate.matrices["rounding"].ravel(), initial=0.0)) for row_test in tests
    ]
    # Of a bank each row is reported in units of its own threshold, with what rounding adds.
    limits = np.array([row_test.threshold for row_test in tests])
    scales = limits + floors if is_bank(test) else np.ones(1)
    threshold = np.full(len(runs.outputs), 1.0 if is_bank(test) else limits[0])
    before = max(map(rows_before, tests))
    if before >= len(threshold):
        raise SpecError(
            f"The record has {len(threshold)} samples, but a window of the test has {before + 1}: give a longer "
            "horizon, or design the test with fewer samples.",
            path="samples",
        )
    threshold[:before] = np.inf
    dt, statement = bench.signals.dt, _statement(test)
    nominal = _RecordRule(test, threshold, scales, dt)
    rule: Rule = nominal
    if constants is not None or initial_set is not None:
        changed, bounds = _bounded(test, constants)
        rule, statement = over_box(
            changed,
            nominal,
            bounds,
            1.0,
            None,
            initial_set,
            scenario=scenario,
            disturbance=_between_samples(test),
            noise_as_bounds=True,
        )
    return Monitor(
        kind,
        statement,
        rule,
        residuals=len(observer.residual_names),
        fault_names=observer.fault_names,
        fault_scales=scales,
        horizon=len(threshold),
        dt=dt,
        floor=0.0 if is_bank(test) else floors[0],
        watched=Watched.ESTIMATES if observer.fault_names else Watched.RESIDUALS,
        groups=test.groups,
    )


class _RecordRule(NormRule):
    """The row that stands out, of records as long as the table; ``exact``: also what the least intervals tell."""

    def __init__(self, test: GuaranteedTest, table: FloatArray, scales: FloatArray, dt: float) -> None:
        super().__init__(table, np.inf, window=1, dt=dt)
        self._scales, self._states = scales, len(test.linear[1].state_names)
        self._tests = GuaranteedRule(test) if test.options.get("exact") else None
        self.columns = () if self._tests is None else self._tests.columns

    def statistics(self, residuals: FloatArray) -> FloatArray:
        """Return the statistic ``(steps, runs)`` of records: the largest row in its scale."""
        return np.asarray(np.max(np.abs(residuals) / self._scales, axis=-1))

    def passed_in(self, runs: Any, norm: FloatArray, limits: FloatArray, onset: int | None) -> NDArray[np.bool_]:
        """Return where runs pass; of exact intervals no more than is asked for."""
        passed = super().passed_in(runs, norm, limits, onset)
        if self._tests is None:
            return passed
        for run in range(norm.shape[1]):
            state = self._tests.init()
            for k, row in enumerate(runs.rows[:, run]):
                observation = LinearSample(row, runs.inputs[k, run], runs.outputs[k, run], self._states)
                state, judged = self._tests.step(state, Sample(k * self._dt, row[:0], row[:0], observation))
                passed[k, run] |= judged.statistic > judged.threshold
                if onset is not None and k >= onset and passed[k, run]:
                    break
        return passed


class GuaranteedState(NamedTuple):
    """The state of `GuaranteedRule`."""

    rows: int  # complete ones since the start
    largest: FloatArray
    recent: FloatArray  # ``(rows, nu + ny)``: the last known inputs and outputs, where programmes need them


class GuaranteedRule(Rule):
    """The test that stands out, its size against the threshold of the design, and what rounding adds for the signals.

    With ``exact`` these are middle and half width of the least interval.  With ``missing: solve`` a window without some
    samples has the least test of the others.
    """

    GUARANTEES = True

    def __init__(self, design: GuaranteedTest) -> None:
        tests = design.tests
        plant, self._length = design.linear[0], max(map(rows_before, tests)) + 1
        self._limits = np.array([test.threshold for test in tests])
        self._rounding = np.array([test.certificate.matrices["rounding"].ravel() for test in tests])
        self._exact, self._solve = bool(design.options.get("exact")), design.options.get("missing") == "solve"
        self._orders = [rows_before(test) for test in tests]
        self._programmes = [Programmes.of(test) for test in tests if self._exact or self._solve]
        self._nu, self._alone = plant.nu, [len(group) == 1 for group in design.groups]
        isolated = [test.fault for test, alone in zip(tests, self._alone, strict=True) if alone]
        self.columns = (
            tuple(f"{end} {name}" for name in isolated for end in ("lowest", "highest")) if self._exact else ()
        )
        self.takes_gaps = self._solve

    def init(self) -> GuaranteedState:
        """Return the state before the first sample."""
        width = self._rounding.shape[1]
        return GuaranteedState(0, np.zeros(width), np.zeros((0, width)))

    def step(self, state: GuaranteedState, sample: Sample) -> tuple[GuaranteedState, RuleOutput]:
        """Return statistic and threshold; NaN while the window is not full, and nothing else is known of it."""
        observation: Any = sample.observation
        cells = (np.nan,) * len(self.columns)
        signals = (
            np.full(len(state.largest), np.nan)
            if observation is None
            else np.concatenate([observation.inputs, observation.outputs])
        )
        if self._programmes:
            state = self._kept(state, signals[None])
        complete = bool(np.isfinite(signals).all())
        state = state._replace(largest=np.fmax(state.largest, np.abs(signals)), rows=state.rows + 1 if complete else 0)
        if not complete and not self._solve:
            state = self.restart(state)
        thresholds = self._limits + self._rounding @ state.largest
        if state.rows >= self._length and (sample.deciding or self._solve):
            values = np.asarray(observation.faults_and_residuals[: len(thresholds)], dtype=np.float64)
        elif self._solve and len(state.recent) == self._length:
            least_tests = [
                programme.least_test(*self._window(state, k)) for k, programme in enumerate(self._programmes)
            ]
            values, thresholds = (np.array(part) for part in zip(*least_tests, strict=True))
        else:
            return state, RuleOutput(np.nan, float(thresholds[0]), None, cells)
        if self._exact:
            values, thresholds, cells = self._intervals(state, values, thresholds)
        known_tests = np.isfinite(values) & np.isfinite(thresholds)
        if not known_tests.any():
            return state, RuleOutput(np.nan, float(thresholds[0]), None, cells)
        sizes = np.where(known_tests, np.abs(values), 0.0)
        share = np.divide(sizes, thresholds, out=np.where(sizes > 0.0, np.inf, 0.0), where=thresholds > 0.0)
        largest = int(np.argmax(np.where(known_tests, share, -1.0)))
        return state, RuleOutput(float(sizes[largest]), float(thresholds[largest]), largest, cells)

    def _kept(self, state: GuaranteedState, rows: FloatArray) -> GuaranteedState:
        return state._replace(recent=np.vstack([state.recent, rows])[-self._length :])

    def _window(self, state: GuaranteedState, test: int) -> tuple[FloatArray, FloatArray]:
        """Return the last outputs and known inputs that a test looks at."""
        rows = state.recent[-(self._orders[test] + 1) :]
        return rows[:, self._nu :], rows[:, : self._nu]

    def _intervals(
        self, state: GuaranteedState, values: FloatArray, widths: FloatArray
    ) -> tuple[FloatArray, FloatArray, tuple[float, ...]]:
        """Return middles and half widths of the least intervals, none wider than those of the fixed tests; and ends."""
        ends = np.array([programme.interval(*self._window(state, k)) for k, programme in enumerate(self._programmes)])
        low = np.fmax(ends[:, 0], values - widths)
        high = np.fmin(ends[:, 1], values + widths)
        # Nothing explains a window whose ends have passed each other: neither a fault of this course nor none.
        empty = low > high
        intervals = np.where(empty[:, None], np.nan, np.stack([low, high], axis=1))
        cells = tuple(intervals[self._alone].ravel().tolist())
        middle = np.where(empty, values, 0.5 * (low + high))
        half = np.where(empty, 0.0, 0.5 * (high - low))
        outside = (low > 0.0) | (high < 0.0) | empty
        size = np.where(
            outside, np.maximum(np.abs(middle), np.nextafter(half, np.inf)), np.minimum(np.abs(middle), half)
        )
        return np.copysign(size, middle), half, cells

    def restart(self, state: GuaranteedState, skipped: int = 0) -> GuaranteedState:
        """Begin again, as the next window has no row from before; or keep the places of missing rows."""
        if not self._solve:
            return state._replace(rows=0, recent=state.recent[:0])
        missing = np.full((min(skipped, self._length), state.recent.shape[1]), np.nan)
        return self._kept(state._replace(rows=0 if skipped else state.rows), missing)

    def options(self) -> list[float]:
        """Return the limits: they depend on all options but those on data."""
        return [*self._limits.tolist(), float(self._exact), float(self._solve)]


class VaryingState(NamedTuple):
    """The state of `VaryingRule`."""

    k: int  # of the next row
    largest: FloatArray


class VaryingRule(Rule):
    """The test of each row of a plant that changes with k: its size against the threshold of the row."""

    GUARANTEES = True
    # Rows are counted, whatever is missing in them.
    takes_gaps = True

    def __init__(self, design: GuaranteedTest, observer: WindowObserver) -> None:
        shipped = design.certificate.matrices
        self._limits, self._rounding = shipped["thresholds"].ravel(), shipped["rounding"]
        self._observer = observer

    def init(self) -> VaryingState:
        """Return the state before the first sample."""
        return VaryingState(0, np.zeros(self._rounding.shape[1]))

    def step(self, state: VaryingState, sample: Sample) -> tuple[VaryingState, RuleOutput]:
        """Return statistic and threshold; NaN where the row has no verdict."""
        observation: Any = sample.observation
        signals = np.concatenate([observation.inputs, observation.outputs])
        after = VaryingState(state.k + 1, np.fmax(state.largest, np.abs(signals)))
        programme = self._observer.programme_at(state.k)
        if programme < 0:
            return after, RuleOutput(np.nan, np.nan)
        threshold = float(self._limits[programme] + self._rounding[programme] @ after.largest)
        return after, RuleOutput(float(abs(observation.faults_and_residuals[0])), threshold, 0)

    def restart(self, state: VaryingState, skipped: int = 0) -> VaryingState:
        """Count the rows that are missing: those of the window before them have no verdict."""
        return state._replace(k=state.k + skipped)

    def options(self) -> list[float]:
        """Return the limits."""
        return [*self._limits.tolist()]


def data_monitor(design: ObserverDesign, kind: str, options: Mapping[str, Any]) -> Monitor:
    """Return the monitor of data of any length; with constants or a start its threshold follows the signals."""
    test = _checked(design, kind, options)
    constants, initial_set = options["constants"], options["initial_set"]
    own = test.observer if isinstance(test.observer, WindowObserver) else None
    observer: LinearObserver | WindowObserver = test.linear[1] if own is None else own
    rule: Rule = GuaranteedRule(test) if own is None else VaryingRule(test, own)
    statement = _statement(test) + ("" if own is None else "; each row has its own threshold")
    if constants is not None or initial_set is not None:
        changed, bounds = _bounded(test, constants)
        rule, statement = over_box(
            changed, None, bounds, 1.0, None, initial_set, disturbance=_between_samples(test), noise_as_bounds=True
        )
        if initial_set is None:
            statement += "; it holds once the effect of the initial error, which is not stated, has settled"
    return Monitor(
        kind,
        statement,
        rule,
        residuals=len(observer.residual_names),
        fault_names=observer.fault_names,
        fault_scales=np.ones(len(observer.fault_names)),
        groups=test.groups,
    )

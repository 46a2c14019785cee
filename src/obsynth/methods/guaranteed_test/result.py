"""The result of a guaranteed test, and the function that designs it."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import numpy as np

from obsynth.errors import SpecError
from obsynth.methods.functions import design_function
from obsynth.methods.guaranteed_test.method import GuaranteedTestMethod
from obsynth.methods.guaranteed_test.problem import WindowProgrammes, problem_as_designed, window_as_designed
from obsynth.methods.guaranteed_test.tolerant import rows_before
from obsynth.methods.guaranteed_test.window_bounds import free_faults
from obsynth.methods.guaranteed_test.windows import courses_of
from obsynth.numerics.arguments import arguments_checked, real_array, whole_number
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.suggestions import fields_suggested
from obsynth.observers.estimates import Estimates
from obsynth.observers.linear.observer import LinearObserver
from obsynth.observers.records import measured_record
from obsynth.observers.window.observer import WindowObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem
from obsynth.results.design import ObserverDesign
from obsynth.results.registered import registered

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@fields_suggested
@dataclass(frozen=True, eq=False, repr=False)
class GuaranteedTest(ObserverDesign):
    """A design by `guaranteed_test`: its threshold, the fault that it is certain to detect, and its table of samples.

    Parameters
    ----------
    name, method, plant, options, gains, observer, certificate, solver, notes, recovery, report, source, file_digest
        As of `ObserverDesign`.
    input_delay : int
        The same.
    """

    @classmethod
    @arguments_checked
    def of(cls, design: ObserverDesign) -> GuaranteedTest:
        """Return a design by this method, such as a loaded one, as what it is.

        Parameters
        ----------
        design : ObserverDesign
            By ``guaranteed-test``.

        Raises
        ------
        SpecError
            It is by another method.
        """
        if design.method != GuaranteedTestMethod.id:
            raise SpecError(f"Design {design.name!r} is by {design.method}, no guaranteed test.", path="design")
        return cls(**{field.name: getattr(design, field.name) for field in fields(ObserverDesign)})

    @property
    def tests(self) -> tuple[GuaranteedTest, ...]:
        """The tests of a bank (``isolate``), one for each fault, each as a design of its own; or this one alone."""
        from obsynth.methods.guaranteed_test.bank import is_bank, tests_of

        if not is_bank(self):
            return (self,)
        return tuple(GuaranteedTest.of(test) for test in tests_of(self, GuaranteedTestMethod.of))

    @property
    def groups(self) -> tuple[tuple[str, ...], ...]:
        """By test: an alarm means that one of these faults is there; one fault where it is isolated.

        Of a test that is blind to nothing (``free`` none) these are all faults, and one that is blind to all others
        isolates.
        """
        from obsynth.methods.guaranteed_test.bank import groups_of, is_bank

        names = self.fault_names
        if is_bank(self):
            return tuple(tuple(names[k] for k in group) for group in groups_of(self))
        own = names.index(self.fault)
        free = free_faults(names, self.options["free"], own)
        return (tuple(names[k] for k in range(len(names)) if k not in free),)

    @property
    def pairs(self) -> dict[tuple[str, str], float]:
        """Of a bank: the threshold of a test of the first fault that is blind to the second alone.

        Infinite where there is none, which is proved: the second then hides the first.
        """
        names, table = self.linear[0].fault_names, self.certificate.matrices.get("pairs", np.zeros((0, 0)))
        indices = [(i, j) for i in range(len(table)) for j in range(len(table)) if i != j]
        return {(names[i], names[j]): float(table[i, j]) for i, j in indices}

    @property
    def fault_names(self) -> tuple[str, ...]:
        """The faults of the plant: of one that changes with k its parameters."""
        if isinstance(self.plant, DescriptorSystem):
            return self.plant.fault_names
        return self._varying_plant.parameter_names

    @property
    def _varying_plant(self) -> TimeVaryingDescriptorSystem:
        """The plant of a test whose weights change with k."""
        if not isinstance(self.plant, TimeVaryingDescriptorSystem):
            raise SpecError(f"{self.name!r} is for a plant with constant matrices.", path="plant")
        return self.plant

    @property
    def fault(self) -> str:
        """The fault that is looked for."""
        return str(self._single("fault").options["fault"])

    def _record(self, y: FloatArray, u: FloatArray | None) -> tuple[FloatArray, FloatArray]:
        """Return outputs ``(steps, ny)`` and known inputs ``(steps, nu)``, where NaN may mark what is missing."""
        outputs = measured_record(y, self.plant.ny)
        inputs = np.zeros((len(outputs), 0)) if u is None else np.atleast_2d(real_array(u, "u"))
        needed = (len(outputs), self.plant.nu)
        if inputs.shape != needed:
            raise SpecError(f"u has shape {inputs.shape}, but {needed} is needed (samples by signals).", path="u")
        return outputs, inputs

    def _single(self, property_name: str) -> GuaranteedTest:
        """Return this test; raise `SpecError` for a bank, whose tests have that each."""
        if self.options.get("isolate"):
            raise SpecError(
                f"{self.name!r} is a bank: each of its tests has {property_name} of its own (tests).", path="isolate"
            )
        return self

    @property
    def samples(self) -> int:
        """Samples of the window."""
        return int(self.options["samples"])

    @property
    def threshold(self) -> float:
        """What the residual never passes without the fault, in the fault's unit; proved."""
        return float(self._single("a threshold").certificate.claims["threshold"])

    @property
    def least(self) -> float:
        """The threshold below which no function of these samples has one; proved.  NaN where that is not known."""
        return float(self._single("a least threshold").certificate.claims.get("least", np.nan))

    @property
    def surely_found(self) -> float:
        """The size from which a fault of the course is certain to raise an alarm, in the fault's unit."""
        return float(self._single("a size").certificate.claims["surely_found"])

    @property
    def delay(self) -> float:
        """Seconds after which it does so at the latest."""
        return float(self._single("a delay").certificate.claims["delay"])

    @property
    def trade_off(self) -> FloatArray:
        """Numbers of samples that were tried, each with the least threshold on them ``(tried, 2)``.

        By linear programmes; that of the samples chosen is proved.
        """
        return self._single("a table").certificate.matrices["trade_off"]

    def hidden_course(self, fault: str | None = None) -> dict[str, FloatArray]:
        """Return signals by name over the window with which a fault looks like none.

        Of a test the witness: its fault, of the size ``least``, with these disturbances, and all their opposites give
        the same samples; without bounds of states so do twice that fault and none.  Of a bank the courses of other
        faults, with states, that hide a fault exactly from any test of a smaller group; none where it is isolated.

        Parameters
        ----------
        fault : str, optional
            Of a bank: which one; the first by default.
        """
        from obsynth.methods.guaranteed_test.bank import hidden_by, is_bank

        if is_bank(self):
            names = self.linear[0].fault_names
            number = names.index(names[0] if fault is None else fault)
            return hidden_by(self, GuaranteedTestMethod.of, number)
        if isinstance(self.observer, WindowObserver):
            shipped = self.certificate.matrices
            leasts = shipped["leasts"].ravel()
            if np.isnan(self.least) or self.least == 0.0:
                return {}
            problem = problem_as_designed(self._varying_plant, GuaranteedTestMethod.of(self.options))
            place = int(np.flatnonzero(leasts == self.least)[0])
            window = WindowProgrammes.of(problem, self.samples).windows[place]
            return courses_of(window, shipped["witness"][place][: len(window.bar)])
        point = self.certificate.matrices.get("witness")
        if point is None:
            return {}
        window = window_as_designed(self.linear[0], GuaranteedTestMethod.of(self.options))
        return courses_of(window.inner, point.ravel())

    def slack(self, y: FloatArray, u: FloatArray | None = None) -> FloatArray:
        """Return what rounding may add to each row of a run ``(steps,)``, to be added to the threshold.

        Parameters
        ----------
        y, u : FloatArray
            Outputs ``(steps, ny)`` and known inputs ``(steps, nu)``.
        """
        outputs, inputs = self._record(y, u)
        known = np.hstack([np.abs(inputs), np.abs(outputs)])
        rounding = self._single("its own rounding").certificate.matrices["rounding"]
        # Samples that are missing are in no window that has a verdict.
        largest = np.maximum.accumulate(np.nan_to_num(known), axis=0)
        if isinstance(self.observer, WindowObserver):
            programmes = [self.observer.programme_at(k) for k in range(len(known))]
            return np.asarray(np.sum(largest * rounding[programmes], axis=1))
        return np.asarray(largest @ rounding.ravel())

    def limits(self, rows: int) -> FloatArray:
        """Return the threshold of each row of a record ``(rows,)``: of a plant that changes with k each has its own.

        Parameters
        ----------
        rows : int
            Of the record, the first at k = 0.  Where there is no verdict the threshold is infinite.
        """
        whole_number(rows, "rows")
        if not isinstance(self.observer, WindowObserver):
            return np.full(rows, self.threshold)
        thresholds = np.append(self.certificate.matrices["thresholds"].ravel(), np.inf)
        return np.asarray(thresholds[[self.observer.programme_at(k) for k in range(rows)]])

    def interval(self, estimates: Estimates) -> tuple[FloatArray, FloatArray]:
        """Return the ends between which the fault lies at each row, ``(steps,)`` each; NaN where none is known.

        Parameters
        ----------
        estimates : Estimates
            Estimates of the observer over a record, from its start.  The interval is that of a fault of the stated
            course; of a ``step`` it is valid at the row at which the step is ``after`` samples old.
        """
        row = self.residual(estimates)
        limits = self.limits(len(row))
        return row - limits, row + limits

    @arguments_checked
    def residual(self, estimates: Estimates) -> FloatArray:
        """Return the residual of each row of a record ``(steps,)``; NaN before the window is full.

        Parameters
        ----------
        estimates : Estimates
            Estimates of the observer over a record, from its start.
        """
        self._single("a residual")
        row = np.hstack([estimates.faults, estimates.residuals])[..., 0].astype(np.float64)
        if isinstance(self.observer, LinearObserver):
            row[: rows_before(self)] = np.nan
        return row

    def alarms(self, estimates: Estimates) -> np.ndarray:
        """Return from which row on there is an alarm, as truths ``(steps,)``: once passed, it stays.

        Parameters
        ----------
        estimates : Estimates
            Estimates of the observer over a record, from its start.
        """
        row = np.nan_to_num(self.residual(estimates))
        return np.maximum.accumulate(np.abs(row) > self.limits(len(row)))

    def exact_interval(self, y: FloatArray, u: FloatArray | None = None) -> tuple[FloatArray, FloatArray]:
        """Return the ends of the least interval in which the fault lies at each row, ``(steps,)`` each.

        Two linear programmes a row, some milliseconds each: no interval that is sure to hold the fault is smaller for
        these very samples, but for rounding.  Each end is one that is proved, or that of the fixed test; where the
        lower one is above the upper one, no course within the bounds explains the window.

        Parameters
        ----------
        y, u : FloatArray
            Outputs ``(steps, ny)`` and known inputs ``(steps, nu)``, from the start of a record without gaps.

        Returns
        -------
        low, high : FloatArray
            NaN before the window is full.
        """
        from obsynth.methods.guaranteed_test.exact import Programmes

        if isinstance(self._single("an interval").observer, WindowObserver):
            raise SpecError(
                f"{self.name!r} is for a plant that changes with k: it has the fixed test of each row (interval).",
                path="exact",
            )
        outputs, inputs = self._record(y, u)
        low, high = (np.array(end) for end in self.interval(self.observer.run(outputs, inputs)))
        slack = self.slack(outputs, inputs)
        low, high = low - slack, high + slack
        length, programmes = rows_before(self) + 1, Programmes.of(self)
        for k in range(length - 1, len(outputs)):
            rows = slice(k + 1 - length, k + 1)
            ends = programmes.interval(outputs[rows], inputs[rows])
            low[k], high[k] = max(low[k], ends[0]), min(high[k], ends[1])
        return low, high

    def plot(self, axes: Axes | None = None) -> Axes:
        """Plot the least threshold against the samples of the window.

        Parameters
        ----------
        axes : Axes, optional
            Where; new ones by default.

        Returns
        -------
        Axes
            In seconds and in the fault's unit; what is chosen is marked.
        """
        drawn: Axes = registered("plot_least_thresholds")(self, axes=axes)
        return drawn


guaranteed_test = design_function(GuaranteedTestMethod, GuaranteedTest, positional=("fault",))

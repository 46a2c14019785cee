"""The result of a guaranteed test, the function that designs it, and the bank of tests that isolates."""

from __future__ import annotations

from dataclasses import dataclass, fields
from inspect import Parameter, getdoc, signature
from typing import TYPE_CHECKING, Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.extensions import extension
from obsynth.methods.designing import design
from obsynth.methods.functions import design_function
from obsynth.methods.guaranteed_test.method import GuaranteedTestMethod
from obsynth.methods.guaranteed_test.problem import window_as_designed
from obsynth.numerics.arguments import require_kind
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.estimates import Estimates
from obsynth.results.design import ObserverDesign

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True, eq=False, repr=False)
class GuaranteedTest(ObserverDesign):
    """A design by `guaranteed_test`: with its threshold, what it surely finds, and its table of samples.

    Parameters
    ----------
    name, method, plant, options, gains, observer, certificate, solver, notes, recovery, report, source, file_digest
        As of `ObserverDesign`.
    """

    @classmethod
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
        require_kind(design, ObserverDesign, "design", "an ObserverDesign, such as obsynth.load(path)")
        if design.method != GuaranteedTestMethod.id:
            raise SpecError(f"Design {design.name!r} is by {design.method}, no guaranteed test.", path="design")
        return cls(**{field.name: getattr(design, field.name) for field in fields(ObserverDesign)})

    @property
    def fault(self) -> str:
        """The fault that is looked for."""
        return str(self.options["fault"])

    @property
    def samples(self) -> int:
        """Samples of the window."""
        return int(self.options["samples"])

    @property
    def threshold(self) -> float:
        """What the residual never passes without the fault, in the fault's unit; proved."""
        return float(self.certificate.claims["threshold"])

    @property
    def least(self) -> float:
        """The threshold below which no function of these samples has one; proved.  NaN where that is not known."""
        return float(self.certificate.claims.get("least", np.nan))

    @property
    def surely_found(self) -> float:
        """The size from which a fault of the course surely alarms, in the fault's unit."""
        return float(self.certificate.claims["surely_found"])

    @property
    def delay(self) -> float:
        """Seconds after which it does so at the latest."""
        return float(self.certificate.claims["delay"])

    @property
    def trade_off(self) -> FloatArray:
        """Numbers of samples that were tried, each with the least threshold on them ``(tried, 2)``.

        By linear programmes; that of the samples chosen is proved.
        """
        return self.certificate.matrices["trade_off"]

    @property
    def hidden_course(self) -> dict[str, FloatArray]:
        """The witness, signals by name over the window: with them a fault of the size ``least`` looks like none.

        Twice that fault with these signals, and no fault with their opposites, give the same samples.
        """
        found: dict[str, FloatArray] = {}
        point = self.certificate.matrices.get("witness")
        if point is None:
            return found
        plant = self.linear[0]
        window = window_as_designed(plant, GuaranteedTestMethod.of(self.options))
        length = max(window.equations + 1, self.samples)
        names = {"x": plant.state_names, "d": plant.disturbance_names, "f": plant.fault_names}
        for label, value in zip(window.labels, point.ravel(), strict=True):
            if label[0] in names:
                course = found.setdefault(names[label[0]][label[2]], np.zeros(length))
                course[slice(None) if label[1] is None else label[1]] = value
        return found

    def slack(self, y: FloatArray, u: FloatArray | None = None) -> FloatArray:
        """Return what rounding may add to each row of a run ``(steps,)``, to be added to the threshold.

        Parameters
        ----------
        y, u : FloatArray
            Outputs ``(steps, ny)`` and known inputs ``(steps, nu)``.
        """
        known = np.abs(y) if u is None else np.hstack([np.abs(u), np.abs(y)])
        size = np.maximum.accumulate(known, axis=0) @ self.certificate.matrices["rounding"].ravel()
        return np.asarray(size)

    def interval(self, estimates: Estimates) -> tuple[FloatArray, FloatArray]:
        """Return the ends between which the fault lies at each row, ``(steps,)`` each; NaN where none is known.

        Parameters
        ----------
        estimates : Estimates
            What the observer said over a record, from its start.  The interval is of a fault of the stated course; of
            a ``step`` it holds at the row at which the step is ``after`` samples old.
        """
        row = self.residual(estimates)
        return row - self.threshold, row + self.threshold

    def residual(self, estimates: Estimates) -> FloatArray:
        """Return the residual of each row of a record ``(steps,)``; NaN before the window is full.

        Parameters
        ----------
        estimates : Estimates
            What the observer said over a record, from its start.
        """
        row = np.hstack([estimates.faults, estimates.residuals])[..., 0].astype(np.float64)
        row[: self.linear[1].order] = np.nan
        return row

    def alarms(self, estimates: Estimates) -> np.ndarray:
        """Return from which row on there is an alarm, as truths ``(steps,)``: once passed, it stays.

        Parameters
        ----------
        estimates : Estimates
            What the observer said over a record, from its start.
        """
        row = np.nan_to_num(self.residual(estimates))
        return np.maximum.accumulate(np.abs(row) > self.threshold)

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
        from obsynth.methods.guaranteed_test.exact import least_interval

        plant, observer = self.linear
        inputs = np.zeros((len(y), plant.nu)) if u is None else np.asarray(u, dtype=np.float64)
        outputs = np.asarray(y, dtype=np.float64)
        low, high = (np.array(end) for end in self.interval(observer.run(outputs, inputs)))
        slack = self.slack(outputs, inputs)
        low, high = low - slack, high + slack
        window = window_as_designed(plant, GuaranteedTestMethod.of(self.options))
        length = observer.order + 1
        for k in range(observer.order, len(outputs)):
            rows = slice(k + 1 - length, k + 1)
            found = least_interval(window, length - self.samples, outputs[rows], inputs[rows])
            low[k], high[k] = max(low[k], found[0]), min(high[k], found[1])
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
        found: Axes = extension("picture of a guaranteed test")(self, axes=axes)
        return found


def guaranteed_test(plant: Any, fault: str | None = None, **options: Any) -> GuaranteedTest:
    """Design a guaranteed test; the docstring is that of the method."""
    return GuaranteedTest.of(design(plant, GuaranteedTestMethod.id, fault=fault, **options))


def _like_the_method() -> None:
    given = signature(design_function(GuaranteedTestMethod))
    order = [
        part.replace(kind=Parameter.POSITIONAL_OR_KEYWORD) if part.name == "fault" else part
        for part in given.parameters.values()
    ]
    changed = given.replace(parameters=order, return_annotation="GuaranteedTest")
    guaranteed_test.__signature__ = changed  # type: ignore[attr-defined]
    guaranteed_test.__doc__ = getdoc(GuaranteedTestMethod)


_like_the_method()

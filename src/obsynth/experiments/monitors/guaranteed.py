"""Monitors of guaranteed tests: the threshold of the design itself, for records and for data of any length."""

from __future__ import annotations

from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.experiments.benches import make_bench
from obsynth.experiments.monitors.monitor import Monitor
from obsynth.experiments.monitors.online import OnlineMonitor, Rule
from obsynth.methods.guaranteed_test.result import GuaranteedTest
from obsynth.numerics.arrays import FloatArray
from obsynth.results.design import ObserverDesign
from obsynth.simulation.scenario import Scenario

#: Id of the method whose designs bring their threshold.
METHOD = "guaranteed-test"


def is_guaranteed(design: ObserverDesign) -> bool:
    """Whether a design brings its own threshold."""
    return design.method == METHOD


def _checked(design: ObserverDesign, kind: str, given: dict[str, Any]) -> GuaranteedTest:
    if kind != "pointwise":
        raise SpecError(
            f"kind is {kind!r}: a guaranteed test has its own threshold, use pointwise (the default).", path="kind"
        )
    stated = [name for name, value in given.items() if value is not None]
    if stated:
        raise SpecError(
            f"{', '.join(stated)} cannot be given to the monitor of a guaranteed test: its bounds are those of its "
            "design. Design it again with others.",
            path=stated[0],
        )
    return GuaranteedTest.of(design)


def _statement(test: GuaranteedTest) -> str:
    least = "" if np.isnan(test.least) else f", and no function of these samples has one below {test.least:.6g}"
    course = test.options["course"]
    return (
        f"never passed without {test.fault} while disturbances and noise keep the bounds of the design{least}; a fault "
        f"of {test.surely_found:.6g} of the course {course} alarms within {test.delay:g} s; for an exact model"
    )


def record_monitor(design: ObserverDesign, scenario: Scenario, kind: str, **given: Any) -> Monitor:
    """Return the monitor of records as long as a scenario."""
    test = _checked(design, kind, given)
    bench = make_bench(design, scenario)
    runs = bench.run([scenario.seed])
    observer = test.linear[1]
    threshold = np.full(len(runs.outputs), test.threshold)
    threshold[: observer.order] = np.inf
    known = np.concatenate([np.abs(runs.inputs), np.abs(runs.outputs)], axis=2)
    floor = float(np.max(known @ test.certificate.matrices["rounding"].ravel(), initial=0.0))
    return Monitor(
        kind,
        _statement(test),
        threshold,
        floor,
        bench.drive.dt,
        1,
        np.zeros(1),
        np.zeros((0, 0)),
        1.0,
        np.ones(len(observer.fault_names)),
        observer.fault_names,
        0,
        bool(observer.fault_names),
    )


class GuaranteedRule(Rule):
    """The size of the row against the threshold of the design, and what rounding adds for the signals so far."""

    GUARANTEES = True
    KEPT = ("rows", "largest")
    SAME = "limit"

    def __init__(self, test: GuaranteedTest) -> None:
        self._limit, self._order = test.threshold, test.linear[1].order
        self._rounding = test.certificate.matrices["rounding"].ravel()
        self.rows = 0
        self.largest = [0.0] * len(self._rounding)

    def take(
        self, time: float, residuals: FloatArray, evidence: Any, *, deciding: bool
    ) -> tuple[float, float, int | None]:
        """Return statistic and threshold; NaN while the window is not full of rows without a gap."""
        if evidence is None or not np.isfinite(evidence.outputs).all() or not np.isfinite(evidence.inputs).all():
            self.restart()
            return np.nan, self._limit, None
        known = np.abs(np.concatenate([evidence.inputs, evidence.outputs]))
        self.largest = np.maximum(self.largest, known).tolist()
        self.rows += 1
        threshold = self._limit + float(np.dot(self.largest, self._rounding))
        if not deciding or self.rows <= self._order:
            return np.nan, threshold, None
        return float(np.abs(evidence.rows[0])), threshold, None

    def restart(self) -> None:
        """Begin again: the next window has no row from before."""
        self.rows = 0

    def options(self) -> float:
        """Return the limit: it depends on all options."""
        return self._limit


def data_monitor(design: ObserverDesign, kind: str, **given: Any) -> OnlineMonitor:
    """Return the monitor of data of any length."""
    test = _checked(design, kind, given)
    observer = test.linear[1]
    return OnlineMonitor(
        kind,
        _statement(test),
        GuaranteedRule(test),
        residuals=len(observer.residual_names),
        fault_names=observer.fault_names,
        fault_scales=np.ones(len(observer.fault_names)),
    )

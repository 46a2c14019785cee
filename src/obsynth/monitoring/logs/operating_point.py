"""Whether the first rows of a log are near the operating point at which a design starts."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from obsynth.monitoring.alarms.events import AlarmEvent
from obsynth.monitoring.logs.log_observer import GAP
from obsynth.monitoring.logs.recovered_states import FIRST_SECONDS, MOST_FIRST_ROWS
from obsynth.monitoring.logs.signals import LogSignals
from obsynth.monitoring.thresholds.learned_levels import HOLD
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.linear.modes import SETTLED_TO, transient
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.results.design import ObserverDesign
from obsynth.results.number_texts import duration, number

#: A signal is far from its operating point when its mean differs by this share of it.
FAR_FROM_POINT = 0.2


class OperatingPointCheck:
    """Gathers the first second of data, to tell whether they begin near the operating point."""

    def __init__(self, signals: LogSignals) -> None:
        self._signals = signals
        self._begin: float | None = None
        self.status = ""  # of the first row
        self._taken = 0
        self._start = np.full(len(signals.names), np.nan)
        self._sum, self._count = np.zeros(len(signals.names)), np.zeros(len(signals.names))

    def take(self, times: Sequence[float], deviations: FloatArray) -> None:
        """Take rows: seconds, and deviations ``(n, nu + ny)`` of which some may be missing."""
        for time, row in zip(times, deviations, strict=True):
            if self._begin is None:
                self._begin, self._start = time, np.array(row)
            if not (time - self._begin <= FIRST_SECONDS and self._taken < MOST_FIRST_ROWS):
                break
            self._taken += 1
            finite = np.isfinite(row)
            self._sum[finite] += row[finite]
            self._count[finite] += 1.0

    def log_until(self, time: float) -> tuple[float, FloatArray]:
        """Return how many seconds are between the first row and a time, and the deviations of the first row."""
        return time - (time if self._begin is None else self._begin), self._start

    def alarm_of_the_start(
        self, design: ObserverDesign, alarms: Sequence[AlarmEvent], *, warm_up: float
    ) -> tuple[str, ...]:
        """Return a text where an alarm of a linear design may be its initial-condition response: when the warm-up
        ends, `SETTLED_TO` of it are left, or more after a shorter one than the default, which is more than the noise
        where the outputs begin far from the start.  Other designs leave out the first row as an outlier where it is so
        far away.

        ``warm_up``: seconds."""
        observer, plant = design.observer, design.plant
        refused = self.status == GAP and bool(np.isfinite(self._start).all())
        if refused and any(event.first_row <= HOLD for event in alarms):
            return (
                f"All outputs of the first row are left out as outliers, and an alarm comes within {HOLD} rows: the "
                "log may begin at other states than the design. State those at which it begins (states, or "
                "initial_state), or a larger initial_covariance.",
            )
        if not (isinstance(observer, LinearObserver) and isinstance(plant, DescriptorSystem)) or self._begin is None:
            return ()
        noise = np.linalg.norm(plant.Dw, axis=1)
        started = np.abs(self._start[len(self._start) - observer.By.shape[1] :])
        if len(noise) != len(started) or not np.any(comparable := np.isfinite(started) & (noise > 0.0)):
            return ()
        shares = np.where(comparable, started, 0.0) / np.where(comparable, noise, 1.0)
        worst = int(np.argmax(shares))
        usual = transient(observer)
        left = SETTLED_TO ** (warm_up / usual) if usual > 0.0 else 0.0
        if shares[worst] * left <= 1.0:
            return ()
        lasting = usual * math.log(shares[worst]) / -math.log(SETTLED_TO)
        if not any(event.start < self._begin + lasting for event in alarms):
            return ()
        name = plant.output_names[worst]
        is_stated = name in self._signals.point
        where = "its operating point" if is_stated else "zero (no operating point is stated)"
        advice = "Give" if is_stated else "State the operating point at which the log begins, or give"
        return (
            f"An alarm in the first {duration(lasting)} may be the initial-condition response: {name} begins "
            f"{shares[worst]:.3g} deviations of its noise from {where}, and when the warm-up ends "
            f"{number(100.0 * left, digits=2)} % of that response are left. {advice} a longer warm-up (--warm-up "
            f"{np.format_float_positional(lasting, precision=3, fractional=False, trim='-')}).",
        )

    def warnings(self) -> tuple[str, ...]:
        """Return a text for each signal with a stated operating point, not zero, that begins far from it."""
        texts = []
        for i, name in enumerate(self._signals.names):
            point = self._signals.point.get(name, 0.0)
            if point == 0.0 or self._count[i] == 0.0:
                continue
            away = self._sum[i] / self._count[i]
            if abs(away) > FAR_FROM_POINT * abs(point):
                texts.append(
                    f"{name} begins at {point + away:.6g}, far from its operating point {point:.6g}: the linear model "
                    "may not hold there, or the data are deviations already, or in another unit."
                )
        return tuple(texts)

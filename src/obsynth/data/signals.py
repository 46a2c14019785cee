"""From the columns of a log to deviations from the operating point, and back.

The names of what a linear design reads and estimates, as an engine has them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from obsynth.data.log_estimator import Engine
from obsynth.errors import SpecError
from obsynth.numerics.arguments import is_finite_number
from obsynth.numerics.arrays import FloatArray, read_only
from obsynth.results.design import ObserverDesign

#: The column of time stamps, in seconds.
TIME = "time"


@dataclass(frozen=True, eq=False)
class Signals:
    """Which column holds which measured signal, and how its values become deviations."""

    names: tuple[str, ...]  # signals: known inputs, then outputs
    columns: tuple[str, ...]  # the columns that are read: time, then one for each signal
    scale: FloatArray  # scale, offset: ``(nu + ny,)``: deviation = scale times the value in the column, minus offset
    offset: FloatArray
    point: Mapping[str, float]  # the operating point
    one: int | None = None  # number of the signal that is one in every row and has no column, if there is such a one

    @classmethod
    def of(
        cls,
        engine: Engine,
        columns: Mapping[str, str] | None,
        scales: Mapping[str, float] | None,
    ) -> Signals:
        """Return the signals that a running design reads."""
        names = engine.input_names + engine.output_names
        renamed, factors = dict(columns or {}), dict(scales or {})
        unknown = [name for name in renamed if name not in (TIME, *names)]
        unknown += [name for name in factors if name not in names]
        if unknown:
            raise SpecError(
                f"{unknown[0]!r} is no signal that this observer reads: it reads {', '.join(names)}.", path="columns"
            )
        for name, factor in factors.items():
            if not is_finite_number(factor) or factor == 0.0:
                raise SpecError(f"The scale of {name!r} is {factor!r}: give a finite number, not zero.", path="scales")
        uncertain = getattr(getattr(engine, "plant", None), "uncertainty", None)
        shift = None if uncertain is None else uncertain.shift
        return cls(
            names,
            tuple(renamed.get(name, name) for name in (TIME, *names) if not shift or name != shift),
            read_only(np.array([factors.get(name, engine.scales.get(name, 1.0)) for name in names])),
            read_only(np.array([engine.point.get(name, 0.0) for name in names])),
            dict(engine.point),
            names.index(shift) if shift and shift in names else None,
        )

    def measured(self, rows: FloatArray) -> FloatArray:
        """Return signals in their units ``(rows, nu + ny)`` from rows of time and columns."""
        read = rows[:, 1:] if self.one is None else np.insert(rows[:, 1:], self.one, 1.0, axis=1)
        return np.asarray(self.scale * read)

    def deviations(self, rows: FloatArray) -> FloatArray:
        """Return deviations ``(rows, nu + ny)`` from rows of time and columns."""
        return self.measured(rows) - self.offset

    def positions(self, header: tuple[str, ...]) -> list[int]:
        """Return where in a header each column is that is read."""
        missing = sorted({name for name in self.columns if name not in header})
        if missing:
            raise SpecError(
                f"The data have no column {', '.join(map(repr, missing))}; they have "
                f"{', '.join(map(repr, header)) or 'none'}. {_advice(header, missing)}",
                path="data",
            )
        repeated = sorted({name for name in self.columns if header.count(name) > 1})
        if repeated:
            raise SpecError(f"The data have more than one column {', '.join(map(repr, repeated))}.", path="data")
        return [header.index(name) for name in self.columns]

    def estimates_point(self, engine: Engine) -> FloatArray:
        """Return what is added to the columns of estimates: the operating point of states and faults."""
        biases = getattr(getattr(engine, "plant", None), "sensor_faults", ())
        values = [self.point.get(name, 0.0) for name in engine.state_names]
        values += [0.0 if name in biases else self.point.get(name, 0.0) for name in engine.fault_names]
        return np.array(values + [0.0] * (len(engine.columns) - len(values)))


#: How columns of time stamps are often called.
_TIMES = ("timestamp", "datetime", "date", "t", "zeit", "time")


def _advice(header: tuple[str, ...], missing: list[str]) -> str:
    if len(header) == 1 and any(mark in header[0] for mark in ":#~^ "):
        return "Separate columns by commas, semicolons, tabs or bars."
    found = next((name for kind in _TIMES for name in header if name.lower().startswith(kind)), None)
    if TIME in missing and found is not None:
        return f"If {found!r} is the time: --time-column {found!r}, or columns={{'time': {found!r}}}."
    return "Map signals to columns where their names differ."


class LinearSignalNames:
    """Names, delays, operating point and scales of a linear design. Fields: design: Linear."""

    def __init__(self, design: ObserverDesign) -> None:
        self.plant, self.observer = design.linear

    @property
    def input_names(self) -> tuple[str, ...]:
        """Known inputs."""
        return self.observer.input_names

    @property
    def output_names(self) -> tuple[str, ...]:
        """Outputs of the plant."""
        return self.observer.output_names

    @property
    def state_names(self) -> tuple[str, ...]:
        """States that are estimated."""
        return self.observer.state_names

    @property
    def fault_names(self) -> tuple[str, ...]:
        """Faults that are estimated."""
        return self.observer.fault_names

    @property
    def state_delays(self) -> tuple[int, ...]:
        """Samples by which each state estimate lags."""
        return self.observer.state_delays

    @property
    def fault_delays(self) -> tuple[int, ...]:
        """Samples by which each fault estimate lags."""
        return self.observer.fault_delays

    @property
    def dt(self) -> float:
        """Seconds between samples; 0 for continuous time."""
        return self.observer.dt

    @property
    def scales(self) -> Mapping[str, float]:
        """Factor of inputs and outputs by name."""
        return self.plant.scales

    @property
    def point(self) -> Mapping[str, float]:
        """Operating point by name of the signal."""
        return self.plant.operating_point

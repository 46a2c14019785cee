"""From the columns of a log to deviations from the operating point, and back."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from obsynth.errors import SpecError
from obsynth.models.descriptor import DescriptorSystem
from obsynth.numerics.arrays import FloatArray, read_only
from obsynth.observers.linear import LinearObserver

#: The column of time stamps, in seconds.
TIME = "time"


@dataclass(frozen=True, eq=False)
class Signals:
    """Which column holds which measured signal, and how its values become deviations.

    Parameters
    ----------
    names : tuple of str
        Signals: known inputs, then outputs.
    columns : tuple of str
        The columns that are read: time, then one for each signal.
    scale, offset : FloatArray
        ``(nu + ny,)``: deviation = scale times the value in the column, minus offset.
    point : Mapping of str to float
        The operating point.
    """

    names: tuple[str, ...]
    columns: tuple[str, ...]
    scale: FloatArray
    offset: FloatArray
    point: Mapping[str, float]

    @classmethod
    def of(
        cls,
        plant: DescriptorSystem,
        observer: LinearObserver,
        columns: Mapping[str, str] | None,
        scales: Mapping[str, float] | None,
    ) -> Signals:
        """Return the signals that an observer reads.

        Parameters
        ----------
        plant : DescriptorSystem
            With the operating point.
        observer : LinearObserver
            What is run.
        columns : mapping or None
            Column of a signal, or of ``time``, where the two names differ.
        scales : mapping or None
            Factor of a signal: the column's value times the factor is in the signal's unit.

        Raises
        ------
        SpecError
            A key is no signal that is read, or a factor is not finite or zero.
        """
        names = observer.input_names + observer.output_names
        renamed, factors = dict(columns or {}), dict(scales or {})
        unknown = [name for name in renamed if name not in (TIME, *names)]
        unknown += [name for name in factors if name not in names]
        if unknown:
            raise SpecError(
                f"{unknown[0]!r} is no signal that this observer reads: it reads {', '.join(names)}.", path="columns"
            )
        for name, factor in factors.items():
            if not math.isfinite(factor) or factor == 0.0:
                raise SpecError(f"The scale of {name!r} is {factor}: give a finite number, not zero.", path="scales")
        return cls(
            names,
            tuple(renamed.get(name, name) for name in (TIME, *names)),
            read_only(np.array([factors.get(name, 1.0) for name in names])),
            read_only(np.array([plant.operating_point.get(name, 0.0) for name in names])),
            dict(plant.operating_point),
        )

    def positions(self, header: tuple[str, ...]) -> list[int]:
        """Return where in a header each column is that is read.

        Parameters
        ----------
        header : tuple of str
            Names of the columns of the data.

        Raises
        ------
        SpecError
            Columns are missing, or stand there twice.
        """
        missing = sorted({name for name in self.columns if name not in header})
        if missing:
            raise SpecError(
                f"The data have no column {', '.join(map(repr, missing))}; they have "
                f"{', '.join(map(repr, header)) or 'none'}. Map signals to columns where their names differ.",
                path="data",
            )
        repeated = sorted({name for name in self.columns if header.count(name) > 1})
        if repeated:
            raise SpecError(f"The data have more than one column {', '.join(map(repr, repeated))}.", path="data")
        return [header.index(name) for name in self.columns]

    def estimates_point(self, observer: LinearObserver) -> FloatArray:
        """Return what is added to the rows ``[xhat, fhat, r]``: the operating point of states and faults."""
        named = observer.state_names + observer.fault_names
        values = [self.point.get(name, 0.0) for name in named] + [0.0] * len(observer.residual_names)
        return np.array(values)


def output_columns(observer: LinearObserver, *, alarms: bool) -> tuple[str, ...]:
    """Return the header of the estimates.

    Parameters
    ----------
    observer : LinearObserver
        Whose estimates they are.
    alarms : bool
        Whether there is a column of alarms.

    Returns
    -------
    tuple of str
        ``time, status``, a column ``time of ...`` for each kind of estimate that lags, ``xhat[...]``, ``fhat[...]``,
        ``r[...]`` and ``alarm``.
    """
    late = [f"time of {name}" for name, _ in delayed(observer)]
    return (TIME, "status", *late, *estimate_columns(observer), *(("alarm",) if alarms else ()))


def estimate_columns(observer: LinearObserver) -> tuple[str, ...]:
    """Return the names of the rows ``[xhat, fhat, r]`` of an observer."""
    return (
        *(f"xhat[{name}]" for name in observer.state_names),
        *(f"fhat[{name}]" for name in observer.fault_names),
        *(f"r[{name}]" for name in observer.residual_names),
    )


def delayed(observer: LinearObserver) -> tuple[tuple[str, int], ...]:
    """Return name and delay in samples of what lags: the states (together where they lag alike), and each fault."""
    states = set(observer.state_delays)
    found = [(f"xhat[{name}]", delay) for name, delay in zip(observer.state_names, observer.state_delays, strict=True)]
    if len(states) == 1:
        found = [("xhat", observer.state_delays[0])]
    found += [(f"fhat[{name}]", delay) for name, delay in zip(observer.fault_names, observer.fault_delays, strict=True)]
    return tuple((name, delay) for name, delay in found if delay)

"""Sensors with a slower sample rate, or with delayed values.

A delayed value is put where it belongs: the observer keeps its states of the latest samples, and takes those samples
again from the one that the value is about.  What it then knows is what it would know if everything had come in order.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from obsynth.errors import SpecError
from obsynth.numerics.arguments import is_whole
from obsynth.numerics.arrays import FloatArray
from obsynth.plants.signal_names import index_of

#: Rows that may be waited for: a delay in another unit is larger.
LONGEST_DELAY = 10_000

Inner = Callable[[Any, FloatArray, FloatArray], tuple[Any, Any]]


def checked_sensors(value: Any, names: Sequence[str]) -> dict[str, dict[str, int]] | None:
    """Return ``{sensor: {every, delay}}`` of the sensors that are not sampled at each row at once, or ``None``."""
    if value is None:
        return None
    if not isinstance(value, Mapping):
        raise SpecError("sensors must be a mapping by name, such as {y1: {every: 5, delay: 2}}.", path="sensors")
    timings: dict[str, dict[str, int]] = {}
    for name, entry in value.items():
        index_of(name, names, what="sensors")
        if not isinstance(entry, Mapping) or not set(entry) <= {"every", "delay"}:
            raise SpecError(
                f"sensors.{name} is {entry!r}: give every (rows) and delay (rows), or one of them.",
                path=f"sensors.{name}",
            )
        timing = {"every": entry.get("every", 1), "delay": entry.get("delay", 0)}
        for key, least in (("every", 1), ("delay", 0)):
            count = timing[key]
            if not is_whole(count) or not least <= count <= LONGEST_DELAY:
                raise SpecError(
                    f"sensors.{name}.{key} is {count!r}: give a whole number of rows from {least} to {LONGEST_DELAY}.",
                    path=f"sensors.{name}.{key}",
                )
            timing[key] = int(count)
        if timing != {"every": 1, "delay": 0}:
            timings[str(name)] = timing
    return timings or None


class WaitingState(NamedTuple):
    """The state of an observer with delayed sensors."""

    before: tuple[Any, ...]  # its states before each of the latest samples
    latest: Any  # after the last one
    outputs: FloatArray  # outputs, inputs: of these samples, as far as they have arrived
    inputs: FloatArray

    @property
    def k(self) -> int:
        """The next sample."""
        return int(self.latest.k)

    @property
    def refused(self) -> FloatArray:
        """Outliers in a row, and at all, ``(2, ny)``."""
        return np.asarray(self.latest.refused)

    def from_data(self, data: Mapping[str, Any], restored: Callable[[Any, Any], Any]) -> WaitingState:
        """Return the state that data describe, by what restores that of an observer without delayed sensors."""
        return WaitingState(
            tuple(restored(self.latest, part) for part in data["before"]),
            restored(self.latest, data["latest"]),
            np.array(data["outputs"]),
            np.array(data["inputs"]),
        )


@dataclass(frozen=True, eq=False)
class SensorTiming:
    """When each sensor is sampled, and by how much its values are delayed."""

    every: NDArray[np.int64]  # every, delays: ``(ny,)``, in rows
    delays: NDArray[np.int64]
    inputs: int  # how many there are. A sensor is sampled at k = 0, every, 2 every,

    @classmethod
    def of(cls, sensors: Mapping[str, Mapping[str, int]] | None, names: Sequence[str], inputs: int) -> SensorTiming:
        """Return the timing of outputs by name."""
        entries = [(sensors or {}).get(name, {}) for name in names]
        return cls(
            np.array([entry.get("every", 1) for entry in entries], dtype=np.int64),
            np.array([entry.get("delay", 0) for entry in entries], dtype=np.int64),
            inputs,
        )

    @cached_property
    def is_plain(self) -> bool:
        """Whether every sensor is sampled at each row, at once."""
        return bool((self.every == 1).all()) and not self.longest

    @property
    def longest(self) -> int:
        """The longest delay in rows."""
        return int(self.delays.max(initial=0))

    def expected(self, k: int) -> NDArray[np.bool_]:
        """Return which outputs ``(ny,)`` have a value in row k."""
        taken = k - self.delays
        return np.asarray((taken >= 0) & (taken % self.every == 0))

    def arriving(self, y: FloatArray) -> FloatArray:
        """Return rows as they arrive from outputs ``(..., samples, ny)`` at their own times; NaN where nothing does."""
        arrived = np.full_like(y, np.nan)
        for i, (period, delay) in enumerate(zip(self.every, self.delays, strict=True)):
            taken = y[..., : max(y.shape[-2] - delay, 0) : period, i]
            arrived[..., delay::period, i] = taken
        return arrived

    def in_order(self, y: FloatArray) -> FloatArray:
        """Return outputs ``(samples, ny)`` at their own times from rows as they arrive."""
        ordered = np.full_like(y, np.nan)
        for i, (period, delay) in enumerate(zip(self.every, self.delays, strict=True)):
            taken = y[delay::period, i]
            ordered[: len(taken) * period : period, i] = taken
        return ordered

    def begun(self, first: Any) -> Any:
        """Return the state before the first sample."""
        if not self.longest:
            return first
        return WaitingState((), first, np.zeros((0, len(self.every))), np.zeros((0, self.inputs)))

    def advance(self, inner: Inner, state: Any, y: FloatArray, u: FloatArray) -> tuple[Any, Any]:
        """Take a row as it arrives by the steps of an observer without delays (``y (ny,)``, ``u (nu,)``)."""
        if self.is_plain:
            return inner(state, y, u)
        received = np.where(self.expected(state.k), y, np.nan)
        if not self.longest:
            return inner(state, received, u)
        k, states = state.k, [*state.before, state.latest]
        oldest = k - len(state.before)
        outputs = np.vstack((state.outputs, np.where(self.delays == 0, received, np.nan)))
        inputs, earliest = np.vstack((state.inputs, u)), k
        for i in np.flatnonzero(self.delays):
            taken = k - int(self.delays[i])
            if taken >= oldest and not np.isnan(received[i]):
                outputs[taken - oldest, i] = received[i]
                earliest = min(earliest, taken)
        row = None
        for t in range(earliest - oldest, len(states)):
            after, row = inner(states[t], outputs[t], inputs[t])
            if t + 1 < len(states):
                states[t + 1] = after
        waiting = slice(max(len(states) - self.longest, 0), None)
        return WaitingState(tuple(states[waiting]), after, outputs[waiting], inputs[waiting]), row


def require_plain(observer: Any, user: str) -> None:
    """Raise `SpecError` where an observer has sensors of their own times, or bounds on states."""
    for option in ("sensors", "state_bounds"):
        if getattr(observer, option) is not None:
            raise SpecError(
                f"{user} has no {option}: leave the option out of the design, or run it by obsynth run.", path=option
            )

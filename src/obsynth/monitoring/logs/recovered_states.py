"""States of the plant as it was written, from the estimates for the plant it was made into."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from obsynth.monitoring.logs.log_observer import LogObserver, Row
from obsynth.numerics.arrays import FloatArray
from obsynth.plants.signal_names import index_of
from obsynth.plants.transformations.recovery import StateRecovery

#: Of plants with more states as written none is recovered unless asked for: each row would take too long.
MOST_RECOVERED = 300

#: Seconds of data that are compared with the operating point, and rows at most: a fast plant moves in a second.
FIRST_SECONDS, MOST_FIRST_ROWS = 1.0, 100


class RecoveredStates:
    """Estimates of states that a transformation took away: ``x_source = from_state x + from_input u + from_fault f``.
    Disturbances, noise and faults that are not estimated count as zero.  Where the fault estimate lags more than that
    of the state, both are taken of the older moment."""

    def __init__(self, recovery: StateRecovery, observer: LogObserver, names: Sequence[str]) -> None:
        wanted = set(names)
        places = [i for i, name in enumerate(recovery.names) if name in wanted and not _kept(recovery, observer, name)]
        self.names = tuple(recovery.names[i] for i in places)
        self.columns = tuple(
            f"xhat[{name}]" if name not in observer.state_names else f"xhat[{name} as written]" for name in self.names
        )
        flags = recovery.flags()
        self.flags: Mapping[str, str] = {recovery.names[i]: flags[i] for i in places}
        self.point = np.array([recovery.operating_point.get(name, 0.0) for name in self.names])
        states, faults = len(observer.state_names), recovery.from_fault.shape[1]
        estimated_faults = faults if faults == len(observer.fault_names) else 0
        self._map = np.hstack([recovery.from_state, recovery.from_fault[:, :estimated_faults]])[places]
        self._inputs = recovery.from_input[places]
        used = self._map.any(axis=0)
        delays = np.array([*observer.state_delays, *observer.fault_delays[:estimated_faults]], dtype=np.int64)
        self.delay = int(np.max(delays[used], initial=0))
        self._ages = np.where(used, self.delay - delays, 0)
        self._used, self._columns = used, np.arange(states + estimated_faults)
        self._rows: deque[FloatArray] = deque(maxlen=self.delay + 1)
        self._known = np.zeros(len(observer.input_names))

    @classmethod
    def of(
        cls, recovery: StateRecovery | None, observer: LogObserver, wanted: str | Sequence[str] | None = None
    ) -> RecoveredStates | None:
        """Return the recovery of a design, of all states or of those asked for; `None` where there is nothing."""
        if recovery is None:
            return None
        names = _chosen_states(recovery, wanted)
        if not names:
            return None
        # Of a large map its operator knows the number of states from which the others follow.
        operator = recovery.by_operator
        states = recovery.from_state.shape[1] if operator is None else operator.state_count
        if states != len(observer.state_names):
            return None
        recovered = cls(recovery, observer, names)
        return recovered if recovered.names else None

    def take(self, row: Row) -> FloatArray:
        """Return the recovered states, deviations; NaN where they are not known."""
        if row.skipped:
            self._rows.clear()
        inputs = self._known if row.deviations is None else row.deviations[: len(self._known)]
        self._known = np.where(np.isfinite(inputs), inputs, self._known)
        self._rows.append(np.concatenate([row.values[self._columns], self._known]))
        if len(self._rows) <= self.delay:
            return np.full(len(self.names), np.nan)
        rows = np.array(self._rows)[::-1]
        estimates = np.where(self._used, rows[self._ages, self._columns], 0.0)
        with np.errstate(over="ignore", invalid="ignore"):
            return np.asarray(self._map @ estimates + self._inputs @ rows[self.delay, len(self._columns) :])

    def as_dict(self) -> dict[str, Any]:
        """Return the state that goes from row to row, as data."""
        return {"rows": list(self._rows), "known": self._known}

    def resume(self, data: Mapping[str, Any]) -> None:
        """Go on from what `as_dict` returned."""
        self._rows.clear()
        self._rows.extend(data["rows"])
        self._known = data["known"]


def _chosen_states(recovery: StateRecovery, wanted: str | Sequence[str] | None) -> tuple[str, ...]:
    if wanted is None:
        return recovery.names if len(recovery.names) <= MOST_RECOVERED else ()
    if isinstance(wanted, str) and wanted in ("all", "none"):
        return recovery.names if wanted == "all" else ()
    names = (wanted,) if isinstance(wanted, str) else tuple(wanted)
    for name in names:
        index_of(name, recovery.names, what="The plant as written")
    return names


def _kept(recovery: StateRecovery, observer: LogObserver, name: str) -> bool:
    """Whether a state of the source is one of the observer's own, by name and as it is."""
    if name not in observer.state_names:
        return False
    row = recovery.names.index(name)
    own = np.arange(len(observer.state_names)) == observer.state_names.index(name)
    other_maps = (recovery.from_input, recovery.from_fault, recovery.from_disturbance)
    return bool(np.array_equal(recovery.from_state[row], own)) and not any(matrix[row].any() for matrix in other_maps)

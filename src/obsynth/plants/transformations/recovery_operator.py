"""Recovery of a large plant's states after elimination, as a sparse solution instead of a dense matrix."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import scipy

from obsynth.errors import SpecError
from obsynth.numerics.arrays import FloatArray, require_entries_once, whole_numbers
from obsynth.numerics.ranks import CANCELLATION_TOLERANCE
from obsynth.numerics.sparse import csr
from obsynth.numerics.sparse_factor import MEAN_FACTOR, SIZE_SAMPLES, SparseFactor, sparse_factor

#: Signals in the order in which they stand in the algebraic equations.
SIGNAL_ORDER = ("state", "input", "fault", "disturbance", "noise")


@dataclass(frozen=True, eq=False)
class RecoveryOperator:
    """``x = dynamic xi + algebraic z`` with ``coupling z + right [xi; u; f; d; w] = 0``, all sparse."""

    dynamic: Any  # ``(nx, count)``
    algebraic: Any
    coupling: Any  # ``(nx - count, nx - count)``, nonsingular
    right: Any
    counts: tuple[int, ...]  # of states, inputs, faults, disturbances, noise
    states: Mapping[str, FloatArray] = field(default_factory=dict)  # ``xi`` from the plant's signals now
    noise_kept: FloatArray | None = None

    @cached_property
    def factor(self) -> SparseFactor:
        """Factors of the algebraic equations."""
        return sparse_factor(self.coupling)

    def __getstate__(self) -> dict[str, Any]:
        """Leave the factors behind: they belong to this process."""
        return {name: value for name, value in self.__dict__.items() if name != "factor"}

    @property
    def state_count(self) -> int:
        """Number of states of the plant now."""
        step = self.states.get("state")
        return self.counts[0] if step is None else int(step.shape[1])

    def matrix(self, signal: str) -> FloatArray:
        """Return the dense map from one kind of signal, ``(nx, n)``."""
        own = np.eye(self.counts[SIGNAL_ORDER.index(signal)])
        if signal == "noise" and self.noise_kept is not None:
            own = self.noise_kept
        if signal == "state":
            return self.apply(self.states.get(signal, own), {})
        return self.apply(self.states.get(signal, np.zeros((self.counts[0], own.shape[1]))), {signal: own})

    def apply(self, xi: FloatArray, signals: Mapping[str, FloatArray]) -> FloatArray:
        """Return columns of ``x`` for columns of the eliminated plant's states and of its signals."""
        ends = np.cumsum([0, *self.counts])
        terms = np.zeros((self.right.shape[0], xi.shape[1]))
        for name, columns in {"state": xi, **signals}.items():
            place = SIGNAL_ORDER.index(name)
            terms = terms + self.right[:, ends[place] : ends[place + 1]] @ columns
        solution = without_rounding(self.factor, -self.factor.solve(terms))
        return np.asarray(self.dynamic @ xi + self.algebraic @ solution)

    def then(self, later: Mapping[str, FloatArray], noise_kept: FloatArray) -> RecoveryOperator:
        """Return the operator through another transformation: its maps of ``xi`` by signal, and the noise it kept."""
        step = self.states.get("state")
        states = {name: matrix if step is None else step @ matrix for name, matrix in later.items()}
        for name, matrix in self.states.items():
            if name != "state":
                own = matrix @ noise_kept if name == "noise" else matrix
                states[name] = states.get(name, np.zeros_like(own)) + own
        source_noise = noise_kept if self.noise_kept is None else self.noise_kept @ noise_kept
        return replace(self, states=states, noise_kept=source_noise)

    def as_dict(self) -> dict[str, Any]:
        """Return plain data: the parts of the sparse matrices as arrays."""
        data: dict[str, Any] = {"counts": list(self.counts), "states": dict(self.states), "noise": self.noise_kept}
        for name in ("dynamic", "algebraic", "coupling", "right"):
            matrix = csr(getattr(self, name))
            data[name] = {
                "rows": matrix.shape[0],
                "columns": matrix.shape[1],
                "values": matrix.data,
                "indices": matrix.indices.astype(np.float64),
                "starts": matrix.indptr.astype(np.float64),
            }
        return data

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> RecoveryOperator:
        """Return what `as_dict` wrote."""

        def matrix(entry: Mapping[str, Any]) -> Any:
            rows, columns = whole_numbers([entry["rows"], entry["columns"]], "rows and columns").tolist()
            values = np.asarray(entry["values"], dtype=np.float64)
            indices = whole_numbers(entry["indices"], "indices", below=columns)
            starts = whole_numbers(entry["starts"], "starts", below=len(values) + 1)
            if len(starts) != rows + 1 or starts[0] or (np.diff(starts) < 0).any():
                raise SpecError("starts: one for each row and the end, none before the last one.", path="starts")
            require_entries_once(np.repeat(np.arange(rows), np.diff(starts)), indices, values, columns)
            return scipy.sparse.csr_array((values, indices, starts), shape=(rows, columns))

        parts = {name: matrix(data[name]) for name in ("dynamic", "algebraic", "coupling", "right")}
        noise = None if data["noise"] is None else np.asarray(data["noise"])
        states = {name: np.asarray(matrix) for name, matrix in data["states"].items()}
        return cls(**parts, counts=tuple(int(n) for n in data["counts"]), states=states, noise_kept=noise)


def without_rounding(factor: SparseFactor, solution: FloatArray) -> FloatArray:
    """Set entries to zero that are so small beside the terms they come from that they are only rounding."""
    sizes = np.abs(solution) / factor.columns[:, None]
    # No sum of terms is larger than the condition number times the largest unknown.
    most = CANCELLATION_TOLERANCE * factor.condition * np.max(sizes, axis=0, initial=0.0)
    suspicious = (sizes > 0.0) & (sizes <= most)
    rows, columns = np.flatnonzero(suspicious.any(axis=1)), np.flatnonzero(suspicious.any(axis=0))
    if not rows.size:
        return solution
    cleaned = solution.copy()
    part = np.ix_(rows, columns)
    if len(rows) > SIZE_SAMPLES * len(columns):
        # Many rows: almost all of them are decided by an estimate.
        usual = CANCELLATION_TOLERANCE * factor.usual_size_of_terms(solution[:, columns])[rows]
        nothing = np.abs(solution[part]) <= usual / MEAN_FACTOR
        cleaned[part] = np.where(nothing, 0.0, solution[part])
        open_still = ~nothing & (np.abs(solution[part]) <= usual * MEAN_FACTOR * np.sqrt(factor.size))
        rows = rows[open_still.any(axis=1)]
        if not rows.size:
            return cleaned
        part = np.ix_(rows, columns)
    terms = factor.size_of_terms(solution[:, columns], rows)
    cleaned[part] = np.where(np.abs(solution[part]) > CANCELLATION_TOLERANCE * terms, cleaned[part], 0.0)
    return cleaned

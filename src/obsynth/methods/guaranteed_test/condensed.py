"""Proofs about large windows by simulation: E nonsingular leads from one state to the next, so no matrix of all rows is
inverted.

Multipliers of the equations follow from the weights of the outputs, of which a few are corrected: as many as there are
free columns but for later states.  A witness is simulated from its start, and what is left of outputs is noise.  All in
balls of many bits, so that every machine finds the same distance to the exact solution.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from flint import arb, arb_mat, ctx

from obsynth.methods.guaranteed_test.windows import Window
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.ranks import decide_rank
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.proofs.extended_balls import arb_matrix

#: Bits of the balls: far more than any window that double precision solves loses.
CONDENSED_BITS = 512

#: Weights count at least this share of the largest one when those to correct, or a square part, are chosen.
LEAST_WEIGHT = 1e-3

#: Windows with fewer rows are proved by the inverse of a square part, which needs no structure.
FEWEST_ROWS = 500


@contextmanager
def many_bits() -> Iterator[None]:
    """Compute in balls of many bits."""
    before, ctx.prec = ctx.prec, CONDENSED_BITS
    try:
        yield
    finally:
        ctx.prec = before


def _middles(matrix: Any) -> FloatArray:
    return np.array([float(entry.mid()) for entry in matrix.entries()]).reshape(matrix.nrows(), matrix.ncols())


def _distance_from(matrix: Any, values: FloatArray) -> FloatArray:
    """Return how far the entries of a matrix in balls are from doubles at most, in their order."""
    sizes = [float(abs(entry - value).upper()) for entry, value in zip(matrix.entries(), values.tolist(), strict=True)]
    # The conversion rounds to nearest.
    return np.asarray(np.nextafter(np.array(sizes), np.inf))


@dataclass(frozen=True, eq=False)
class Condensed:
    """A window in which the first state and the signals determine all later states: E is nonsingular."""

    window: Window

    @classmethod
    def of(cls, window: Window) -> Condensed | None:
        """Return the window in this form; ``None`` where it is small, or where E is singular, states are bounded, or
        equations reach beyond the samples."""
        if window.rows < FEWEST_ROWS or not isinstance(window.model.plant, DescriptorSystem):
            return None
        plant, samples = window.plant, window.test_problem.samples
        bounds = window.bounds
        # Products of entries and whole numbers would be rounded.
        is_plain = window.rows == window.outputs_at + samples * plant.ny and np.abs(window.times).max(initial=1) == 1
        unbounded = bool(np.isinf(bounds.state).all() and np.isinf(bounds.first).all())
        if not is_plain or not unbounded or window.equations != samples - 1:
            return None
        return cls(window) if plant.nx and decide_rank(plant.E).full else None

    @cached_property
    def _inverse(self) -> Any:
        e = self.window.plant.E
        return None if np.array_equal(e, np.eye(len(e))) else arb_matrix(e).inv()

    def _over_e(self, matrix: Any) -> Any:
        return matrix if self._inverse is None else self._inverse * matrix

    @cached_property
    def _columns_beside_states(self) -> np.ndarray:
        """Columns of the window that multiply anything but states."""
        return np.array([k for k, label in enumerate(self.window.labels) if label[0] != "x"])

    def _parts(self, columns: np.ndarray) -> tuple[list[FloatArray], list[FloatArray]]:
        """Return what columns put into the equations of each sample and into the outputs of each."""
        window, plant = self.window, self.window.plant
        dense = window.matrix[:, columns].toarray()
        equations = dense[: window.outputs_at].reshape(window.equations, plant.nx, -1)
        outputs = dense[window.outputs_at :].reshape(window.test_problem.samples, plant.ny, -1)
        return list(equations), list(outputs)

    @cached_property
    def _responses(self) -> Any:
        """What the first state, free columns and theta do to all outputs, in balls: ``(samples ny, nx + free + 1)``."""
        window, plant = self.window, self.window.plant
        free = [k for k in self._columns_beside_states.tolist() if k and window.free[k]]
        equations, outputs = self._parts(np.array([*free, 0]))
        a, c = self._over_e(arb_matrix(plant.A)), arb_matrix(plant.C)
        observed, state, responses = c, arb_matrix(np.zeros((plant.nx, len(free) + 1))), []
        for k, output in enumerate(outputs):
            response = c * state + arb_matrix(output)
            rows = [observed.tolist(), response.tolist()]
            responses += [first + second for first, second in zip(*rows, strict=True)]
            observed = observed * a
            if k < window.equations:
                state = a * state - self._over_e(arb_matrix(equations[k]))
        return arb_mat(responses)

    @many_bits()
    def least_weights(self) -> FloatArray | None:
        """Return the least weights of the outputs that see theta alone ``(rows,)``, equations zero; else ``None``."""
        responses = self._responses
        count = responses.ncols()
        target = arb_mat(count, 1, [arb(0)] * (count - 1) + [arb(1)])
        try:
            # Distant states of a network are so hard to observe that double precision would lose them.
            weights = responses * (responses.transpose() * responses).solve(target)
        except ZeroDivisionError:
            return None
        return np.concatenate([np.zeros(self.window.outputs_at), _middles(weights)[:, 0]])

    @many_bits()
    def multipliers(
        self, values: FloatArray, *, refine: bool, among: FloatArray | None
    ) -> tuple[FloatArray, FloatArray] | None:
        """Return multipliers and their distance from exact ones ``(rows,)`` each; ``None`` where none is proved."""
        window = self.window
        first = window.outputs_at
        weights = values[first:].copy()
        responses = self._responses
        count = responses.ncols()
        chosen = self._chosen(weights) if among is None else np.flatnonzero(among[first:] > 0.0)
        if chosen is None or len(chosen) != count:
            return None
        entries = responses.tolist()
        square = arb_mat([entries[k] for k in chosen.tolist()]).transpose()
        target = arb_mat(count, 1, [arb(0)] * (count - 1) + [arb(1)])
        exact: Any = None
        for _ in range(3 if refine else 1):
            exact = arb_matrix(weights[:, None])
            try:
                step = square.solve(target - responses.transpose() * exact)
            except ZeroDivisionError:
                return None
            for place, k in enumerate(chosen.tolist()):
                exact[k, 0] = exact[k, 0] + step[place, 0]
            if refine:
                weights = _middles(exact)[:, 0]
        equations = self._equations(exact)
        repaired = np.array(values)
        if refine:
            repaired[first:] = weights
            repaired[:first] = _middles(equations)[:, 0]
        distance = np.concatenate(
            [_distance_from(equations, repaired[:first]), _distance_from(exact, repaired[first:])]
        )
        corrected = np.ones(len(repaired), dtype=bool)
        corrected[first:] = False
        corrected[first + chosen] = True
        return repaired, np.where(corrected, np.maximum(distance, np.finfo(np.float64).tiny), 0.0)

    def _chosen(self, weights: FloatArray) -> np.ndarray | None:
        """Return the outputs whose weights are corrected: heavy ones with responses that differ most."""
        from scipy.linalg import qr

        responses = _middles(self._responses)
        heavy = np.maximum(np.abs(weights), LEAST_WEIGHT * float(np.max(np.abs(weights), initial=0.0)))
        if responses.shape[0] < responses.shape[1] or not heavy.any():
            return None
        scaled = responses / np.maximum(np.abs(responses).max(axis=0), np.finfo(np.float64).tiny) * heavy[:, None]
        _, order = qr(scaled.T, mode="r", pivoting=True)
        return np.sort(order[: responses.shape[1]])

    def _equations(self, weights: Any) -> Any:
        """Return the multipliers of all equations that belong to weights of the outputs, in balls."""
        window, plant = self.window, self.window.plant
        a, c = arb_matrix(plant.A.T), arb_matrix(plant.C.T)
        later, blocks = arb_matrix(np.zeros((plant.nx, 1))), []
        entries = weights.entries()
        for k in range(window.equations - 1, -1, -1):
            part = arb_mat(plant.ny, 1, entries[(k + 1) * plant.ny : (k + 2) * plant.ny])
            later = a * later - c * part
            later = later if self._inverse is None else self._inverse.transpose() * later
            blocks.append(later.entries())
        return arb_mat(len(blocks) * plant.nx, 1, [entry for part in blocks[::-1] for entry in part])

    @many_bits()
    def point(self, values: FloatArray) -> tuple[FloatArray, FloatArray] | None:
        """Return a witness and its distance from an exact one ``(columns,)`` each; ``None`` where noise is missing.

        Later states, and noise of as many columns as there are outputs, are corrected.
        """
        window, plant = self.window, self.window.plant
        absorbing = self._absorbing
        if absorbing is None:
            return None
        columns = np.array([k for k in self._columns_beside_states if k not in set(absorbing.ravel().tolist())])
        equations, outputs = self._parts(columns)
        known = arb_matrix(values[columns][:, None])
        a, c = self._over_e(arb_matrix(plant.A)), arb_matrix(plant.C)
        labels = {label: k for k, label in enumerate(window.labels)}
        state = arb_matrix(np.array([[values[labels["x", 0, i]]] for i in range(plant.nx)]))
        noise = window.bounds.noise_output[:, self._noise_columns]
        back = arb_matrix(noise).inv()
        witness, distance = np.array(values), np.zeros(len(values))
        for k in range(window.test_problem.samples):
            residual = back * (c * state + arb_matrix(outputs[k]) * known)
            self._put(witness, distance, absorbing[k], -residual)
            if k < window.equations:
                state = a * state - self._over_e(arb_matrix(equations[k]) * known)
                self._put(witness, distance, np.array([labels["x", k + 1, i] for i in range(plant.nx)]), state)
        return witness, distance

    @staticmethod
    def _put(witness: FloatArray, distance: FloatArray, places: np.ndarray, exact: Any) -> None:
        witness[places] = _middles(exact)[:, 0]
        distance[places] = np.maximum(_distance_from(exact, witness[places]), np.finfo(np.float64).tiny)

    @cached_property
    def _noise_columns(self) -> np.ndarray:
        """Columns of noise, as many as outputs, that reach the outputs alone and span them."""
        bounds, ny = self.window.bounds, self.window.plant.ny
        of_outputs = np.flatnonzero((bounds.noise > 0.0) & ~bounds.noise_state.any(axis=0)).tolist()
        first_of_row: dict[int, int] = {}
        for k in of_outputs:
            rows = np.flatnonzero(bounds.noise_output[:, k])
            if len(rows) == 1:
                first_of_row.setdefault(int(rows[0]), k)
        complete = len(first_of_row) == ny
        return np.array([first_of_row[row] for row in range(ny)]) if complete else np.zeros(0, dtype=np.int64)

    @cached_property
    def _absorbing(self) -> np.ndarray | None:
        """Columns of the window ``(samples, ny)`` that these are; ``None`` where an output has no noise of its own."""
        if not len(self._noise_columns):
            return None
        labels = {label: k for k, label in enumerate(self.window.labels)}
        samples = range(self.window.test_problem.samples)
        return np.array([[labels["w", k, int(i)] for i in self._noise_columns] for k in samples])

"""Linear descriptor plants for calibration: constants in their matrices, continuous, discrete, or varying with k.

An algebraic equation of a discrete plant (a row of zeros in E) is taken with the state it constrains, one sample later.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.monitoring.calibration.logs import RecordedLog, refused
from obsynth.monitoring.calibration.plants import (
    EXACT_STEP,
    SIZED_SAMPLES,
    CalibrationPlant,
    casadi_column,
    outputs_function,
)
from obsynth.numerics import lazy_casadi as ca
from obsynth.numerics.arrays import SMALLEST, FloatArray
from obsynth.numerics.ranks import rounding_rank
from obsynth.plants.dae_equations import symbolic_value
from obsynth.plants.dae_functions import BUTCHER
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.sequences import INDEX_NAME, MatrixSequence
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem

#: The least effect of a state on the outputs, as a share of the largest, by which it is sized.
LEAST_EFFECT = 1e-6

#: What the matrices of varying and of invariant plants are called here; G and L are of constant effects.
MATRIX_LETTERS = {"E": "E", "A": "A", "B": "B", "C": "C", "Phi": "G", "Psi": "L"}

#: Constant effects of an invariant plant are its faults, then its unknown inputs.
INVARIANT = {**{name: (name,) for name in "EABCD"}, "G": ("Bf", "Bd"), "L": ("Df", "Dd")}

Symbols = Mapping[str, Any]

#: Where the search for a correlation begins, and its bounds: in samples, the last as a share of the log.
FIRST_CORRELATION, LEAST_CORRELATION, LONGEST_SHARE = 10.0, 0.3, 1.0


@dataclass(frozen=True, eq=False)
class _Matrix:
    """A matrix ``(rows, columns)``: from values by name and its signals to symbols; from k to its signals, if any."""

    shape: tuple[int, int]
    symbolic: Callable[[Symbols, Any], Any]
    recorded: Callable[[int], FloatArray] | None = None

    @property
    def width(self) -> int:
        """Number of signals."""
        return self.shape[0] * self.shape[1] if self.recorded is not None else 0


def _of_sequence(matrix: MatrixSequence) -> _Matrix:
    """Return a matrix that may change with k; one without a formula is a signal."""
    if matrix.entries is not None:
        rows = matrix.entries
        return _Matrix(
            matrix.shape,
            lambda known, _: _dense([[symbolic_value(entry, known) for entry in row] for row in rows], matrix.shape),
        )
    if matrix.is_constant:
        return _Matrix(matrix.shape, lambda known, _: ca.SX(ca.DM(matrix.at(0))))
    return _Matrix(
        matrix.shape,
        lambda known, flat: ca.reshape(flat, *matrix.shape),
        lambda k: np.asarray(matrix.at(k)).ravel(order="F"),
    )


def _dense(rows: Sequence[Sequence[Any]], shape: tuple[int, int]) -> Any:
    return ca.vertcat(*(ca.horzcat(*row) for row in rows)) if all(shape) else ca.SX(*shape)


class LinearPlant(CalibrationPlant):
    """A linear plant in one of three forms; its signals are inputs before and at the row, k, and varying matrices."""

    has_levels = False

    def __init__(self, plant: DescriptorSystem | TimeVaryingDescriptorSystem, log: RecordedLog) -> None:
        uncertainty = getattr(plant, "uncertainty", None)
        constants = {} if uncertainty is None else uncertainty.box.constants
        if isinstance(plant, TimeVaryingDescriptorSystem):
            self.matrices = {key: _of_sequence(getattr(plant, name)) for name, key in MATRIX_LETTERS.items()}
            values, effects = {name: float(value) for name, value in plant.constants.items()}, plant.parameter_names
            self.continuous = False
        else:
            entries = {} if uncertainty is None else uncertainty.entries
            self.matrices = {
                key: _with_entries([(getattr(plant, name), entries.get(name, ())) for name in beside], uncertainty)
                for key, beside in INVARIANT.items()
            }
            values = {name: item.nominal for name, item in constants.items()}
            # A fault may have the name of an unknown input.
            own = (f"unknown input {name}" if name in plant.fault_names else name for name in plant.disturbance_names)
            effects = (*plant.fault_names, *own)
            self.continuous = not plant.is_discrete
        self.state_names = self.equation_names = plant.state_names
        self.nx, self.nu, self.ny = len(plant.state_names), plant.nu, plant.ny
        self.effects = tuple(effects)
        self.unstated = frozenset(self.effects)
        self.walking = tuple(self.effects)
        self.unknown_inputs = self.effects[len(self.effects) - len(getattr(plant, "disturbance_names", ())) :]
        self.values = {**values, **dict.fromkeys(self.effects, 0.0)}
        self.units = {**{name: item.unit or "1" for name, item in constants.items()}, **plant.units}
        if unknown := getattr(plant, "disturbance_names", ()):
            self.notes = (
                f"Of the unknown inputs ({', '.join(unknown)}) no bounds are known: the noise of the equations "
                "represents them.",
            )
        self.own_integration = "radau" if self.continuous else EXACT_STEP
        if self.matrices["E"].shape != (self.nx, self.nx):
            raise SpecError(
                "The plant has another number of equations than of states: they do not determine a step, "
                "which a calibration needs.",
                path="E",
            )
        self.late = self._algebraic(log)
        point = plant.operating_point
        self.input_point = np.array([point.get(name, 0.0) for name in plant.input_names])
        self.output_point = np.array([point.get(name, 0.0) for name in plant.output_names])
        self.nominal_state = np.zeros(self.nx)
        first = self.signals(log)
        self.nominal_signals = first[min(1, len(first) - 1)]
        # A linear plant says nothing of the size of its states: the outputs do, so that units change no answer.
        self.state_scales = self.state_deviations = self._sizes(log, first)

    def _algebraic(self, log: RecordedLog) -> list[int]:
        """Return the rows of E that are zero for every k of the log, of a discrete plant."""
        if self.continuous:
            return []
        matrix = self.matrices["E"]
        if matrix.recorded is not None:
            stack = np.array(
                [matrix.recorded(log.rows[0] + i).reshape(self.nx, self.nx, order="F") for i in range(1, log.samples)]
            )
            return np.flatnonzero(~stack.any(axis=(0, 2))).tolist()
        symbols = {name: ca.SX.sym(name) for name in (*self.values, INDEX_NAME)}
        E = ca.SX(matrix.symbolic(symbols, None))
        return [i for i in range(self.nx) if all(E[i, j].is_zero() for j in range(self.nx))]

    def signals(self, log: RecordedLog) -> FloatArray:
        """Return inputs before and at each row, its k, and the matrices without a formula ``(n, ns)``."""
        u = log.u - self.input_point
        k = log.rows[0] + np.arange(log.samples, dtype=np.float64)
        parts = [np.vstack([u[:1], u[:-1]]), u, k[:, None]]
        for name, later in self._recorded():
            read = self.matrices[name].recorded
            if read is not None:
                start = log.rows[0] + (0 if later else -1)
                rows = [read(max(start + i, 1 if later and name in ("E", "C") else 0)) for i in range(log.samples)]
                parts.append(np.array(rows))
        return np.hstack(parts)

    def _recorded(self) -> list[tuple[str, bool]]:
        """Return matrices that are signals, with whether at the row itself or at the one before."""
        matrices = []
        for name, matrix in self.matrices.items():
            if matrix.recorded is None:
                continue
            if name in ("E", "C"):
                matrices.append((name, True))
                continue
            matrices.append((name, False))
            if self.late and name in ("A", "B", "G"):
                matrices.append((name, True))
        return matrices

    def _at(self, s: Any, t: Any, unknown: Sequence[str]) -> Callable[[str, bool], Any]:
        """Return the function from a matrix's name, and whether at the row itself, to its symbols."""
        place = 2 * self.nu + 1
        flats = {}
        for name, later in self._recorded():
            width = self.matrices[name].width
            flats[name, later] = s[place : place + width]
            place += width
        values = {
            **{name: ca.SX(value) for name, value in self.values.items()},
            **{name: t[i] for i, name in enumerate(unknown)},
        }
        k = s[2 * self.nu]

        def matrix(name: str, later: bool) -> Any:
            # A constant of an invariant plant may have the name of the index.
            at_row = {INDEX_NAME: k if later else k - 1.0} | values
            return self.matrices[name].symbolic(at_row, flats.get((name, later)))

        return matrix

    def _constant_effects(self, t: Any, unknown: Sequence[str]) -> Any:
        return casadi_column([t[list(unknown).index(name)] if name in unknown else 0.0 for name in self.effects])

    def step(self, unknown: Sequence[str], integration: str) -> tuple[int, Any]:
        """Return stages, and the function from stages, state before, signals, constants and dt to equations."""
        stages = len(BUTCHER[integration]) if self.continuous else 1
        X, x, dt = ca.SX.sym("X", self.nx * stages), ca.SX.sym("x", self.nx), ca.SX.sym("dt")
        s, t = ca.SX.sym("s", len(self.nominal_signals)), ca.SX.sym("t", len(unknown))
        at, f = self._at(s, t, unknown), self._constant_effects(t, unknown)
        before, now = s[: self.nu], s[self.nu : 2 * self.nu]
        driven = self._product(at("B", False), before) + self._product(at("G", False), f)
        if self.continuous:
            weights, parts = np.linalg.inv(BUTCHER[integration]), ca.reshape(X, self.nx, stages)
            E, A = at("E", True), at("A", False)
            rows = []
            for i in range(stages):
                rate = (
                    sum(
                        (float(weights[i, j]) * (parts[:, j] - x) for j in range(1, stages)),
                        float(weights[i, 0]) * (parts[:, 0] - x),
                    )
                    / dt
                )
                rows.append(E @ rate - A @ parts[:, i] - driven)
            equations = ca.vertcat(*rows)
        else:
            equations = at("E", True) @ X - at("A", False) @ x - driven
            if self.late:
                held = -(at("A", True) @ X + self._product(at("B", True), now) + self._product(at("G", True), f))
                for i in self.late:
                    equations[i] = held[i]
        return stages, ca.Function("equations", [X, x, s, t, dt], [equations])

    def _product(self, matrix: Any, column: Any) -> Any:
        """Return a product that is zero where there are no signals."""
        return matrix @ column if column.numel() else ca.SX.zeros(matrix.shape[0])

    def outputs(self, unknown: Sequence[str]) -> Any:
        """Return the function from state, signals and constants to y, H and L."""
        x, s, t = ca.SX.sym("x", self.nx), ca.SX.sym("s", len(self.nominal_signals)), ca.SX.sym("t", len(unknown))
        at, f = self._at(s, t, unknown), self._constant_effects(t, unknown)
        y = at("C", True) @ x + self._product(at("L", False), f) + ca.DM(self.output_point)
        if "D" in self.matrices:
            y = y + self._product(at("D", True), s[self.nu : 2 * self.nu])
        return outputs_function(x, s, t, y)

    def _sizes(self, log: RecordedLog, signals: FloatArray) -> FloatArray:
        """Return how large each initial state can be ``(nx,)``: so that alone it makes outputs as large as they are."""
        stages, equations = self.step((), next(iter(BUTCHER)) if self.continuous else EXACT_STEP)
        X, x, s = ca.SX.sym("X", self.nx * stages), ca.SX.sym("x", self.nx), ca.SX.sym("s", signals.shape[1])
        residual = equations(X, x, s, ca.SX(0, 1), log.dt)
        jacobians = ca.Function(
            "both", [s], [ca.densify(ca.jacobian(residual, X)), ca.densify(ca.jacobian(residual, x))]
        )
        outputs = self.outputs(())
        y = log.y - self.output_point
        large = np.sqrt(np.nanmean(y**2, axis=0))
        large = np.where(large > 0.0, large, 1.0)[:, None]
        reach, effects = np.eye(self.nx), np.zeros(self.nx)
        for i, row in enumerate(signals[:SIZED_SAMPLES]):
            if i:
                J, before = (np.array(part) for part in jacobians(row))
                if not np.isfinite(J).all() or rounding_rank(J / np.maximum(np.abs(J).max(), SMALLEST)) < self.nx:
                    raise refused(
                        "undetermined-step",
                        "The equations of a step do not determine the state: a discrete "
                        "plant needs its algebraic equations as rows without x(k+1), and index one. "
                        "Eliminate algebraic states first.",
                        signals=list(self.state_names),
                    )
                reach = -np.linalg.solve(J, before) @ reach
            H = np.array(outputs(np.zeros(self.nx), row, np.zeros(0))[1])
            effects = np.maximum(effects, (np.abs(H @ reach) / large).max(axis=0, initial=0.0))
        effects = np.maximum(
            np.nan_to_num(effects), LEAST_EFFECT * max(float(np.nanmax(effects, initial=0.0)), SMALLEST)
        )
        return np.asarray(1.0 / effects)


def _with_entries(beside: Sequence[tuple[FloatArray, Sequence[tuple[int, int, str]]]], uncertainty: Any) -> _Matrix:
    """Return matrices side by side, of which some entries are expressions."""

    def symbolic(values: Symbols, _: Any) -> Any:
        parts = []
        for matrix, entries in beside:
            symbols = ca.SX(ca.DM(np.asarray(matrix, dtype=np.float64)))
            for row, column, text in entries:
                symbols[row, column] = (
                    values[text] if text in values else symbolic_value(uncertainty.parsed(text), values)
                )
            parts.append(symbols)
        return ca.horzcat(*parts)

    return _Matrix((len(beside[0][0]), sum(matrix.shape[1] for matrix, _ in beside)), symbolic)

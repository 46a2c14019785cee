"""What is asked of a calibration, checked: a model with unknown constants, a log, priors and what is known of noise.

The innovations likelihood of a log and its exact gradient, and the outputs of a simulation with sensitivities.

``nll = 1/2 sum(e' S^-1 e + log det 2 pi S)``, x(0) ~ N(x0, P0) integrated out; Q on named equations and R as logarithms
of variances.  CasADi differentiates one sample; two accumulations take the gradient back through the filter.

What a calibration needs of a plant: one implicit step and the outputs as CasADi functions of unknown constants.

Linear descriptor plants have constants in their matrices, in continuous time, discrete, or varying with k.  An
algebraic equation of a discrete plant (a row of zeros in E) is taken with the state it constrains, one sample later.

A plant of a calibration with states for what disturbs it: coloured noise, offsets of sensors, loads that walk.

One sample of a nonlinear plant as CasADi functions of state, input and unknown constants, with derivatives.

Newton's iterations are not differentiated: the solved stages and their first derivatives enter as numbers, and the
implicit function theorem does the rest.  Machine code where a C compiler is there and the work is long enough.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from types import MappingProxyType
from typing import Any

import numpy as np

from obsynth.analysis.transformations.linearisation import promoted
from obsynth.calibration.logs import EVEN, Log, bad_log, quantum, refused, repeats, roughness
from obsynth.errors import SpecError
from obsynth.files.outputs import working_folder
from obsynth.numerics import lazy_casadi as ca
from obsynth.numerics.arguments import (
    SMALLEST,
    FloatArray,
    is_number,
    real_number,
    require_mapping,
    require_shape,
    whole_number,
)
from obsynth.numerics.newton import largest_entries
from obsynth.numerics.ranks import covariance_factor, rounding_rank
from obsynth.observers.dae.observer import compiler, shared_library
from obsynth.observers.records import named_covariance, named_vector
from obsynth.plants.dae import BUTCHER, Compiled, DAEFunctions, DAEModel, symbolic_value, symbols_of
from obsynth.plants.descriptor import (
    INDEX_NAME,
    DescriptorSystem,
    MatrixSequence,
    TimeVaryingDescriptorSystem,
    index_of,
)
from obsynth.plants.noise_model import UNKNOWN_NUMBER, noise_state, offset_state, seconds

#: Deviation of an initial state that is not stated, as a share of its nominal size.
CALIBRATED_STATE_SHARE = 0.1
#: A load, or an initial state, is sized by what it does to the outputs in this many samples.
SIZED_SAMPLES = 50


class CalibrationPlant(ABC):
    """A plant whose constants are to be found."""

    state_names: tuple[str, ...]
    equation_names: tuple[str, ...]  # to whose right sides noise may be added
    values: Mapping[str, float]  # nominal value of all that may be unknown
    unstated: frozenset[str] = frozenset()  # those of them without a value that is stated
    units: Mapping[str, str]
    nominal_state: FloatArray  # ``(nx,)``
    state_scales: FloatArray  # sizes of the states ``(nx,)``
    state_deviations: FloatArray  # what an initial state may differ by ``(nx,)``
    nominal_signals: FloatArray  # ``(ns,)``
    notes: tuple[str, ...] = ()  # sentences of every verdict
    has_levels: bool = True  # whether signals are values, and no deviations from an operating point
    unknown_inputs: tuple[str, ...] = ()  # of which nothing is known, among ``values``
    bounds: Mapping[str, tuple[float, float]] = MappingProxyType({})  # of what is sought beside constants, by name

    own_integration: str  # unless something else is asked for; a discrete plant is stepped as it is

    def integration(self, asked: str) -> str:
        """Return how the plant is integrated at first."""
        return self.own_integration if asked == "auto" or self.own_integration == EXACT_STEP else asked

    @abstractmethod
    def signals(self, log: Log) -> FloatArray:
        """Return what steps and outputs take of each row ``(n, ns)``."""

    @abstractmethod
    def step(self, unknown: Sequence[str], integration: str) -> tuple[int, Any]:
        """Return stages, and the function from stages, state before, signals, constants and dt to equations."""

    @abstractmethod
    def outputs(self, unknown: Sequence[str]) -> Any:
        """Return the function from state, signals and constants to y, H and L."""


class NonlinearPlant(CalibrationPlant):
    """A `DAEModel`; its signals are its inputs."""

    own_integration = "backward-euler"

    def __init__(self, model: DAEModel) -> None:
        self.model = model
        self.state_names, self.equation_names = model.state_names, model.equation_names
        self.values: Mapping[str, float] = {**model.constants, **model.parameters}
        self.units = model.units
        self.nominal_state, self.state_scales = np.array(model.nominal_state), np.array(model.state_scales)
        self.state_deviations = CALIBRATED_STATE_SHARE * self.state_scales
        self.nominal_signals = np.array(model.nominal_input)
        self._promoted: dict[tuple[str, ...], DAEModel] = {}

    def signals(self, log: Log) -> FloatArray:
        """Return the inputs ``(n, nu)``."""
        return log.u

    def promoted(self, unknown: Sequence[str]) -> DAEModel:
        """Return the model with what is unknown among its parameters."""
        key = tuple(unknown)
        if key not in self._promoted:
            for name in key:
                index_of(name, [*self.model.parameter_names, *self.model.constants], what="unknown")
            self._promoted[key] = promoted(self.model, key)
        return self._promoted[key]

    def theta(self, unknown: Sequence[str], t: Any) -> list[Any]:
        """Return all parameters of the promoted model: the unknown from t, and nominal values for the rest."""
        model = self.promoted(unknown)
        entries: list[Any] = model.nominal_parameters.tolist()
        for i, name in enumerate(unknown):
            entries[model.parameter_names.index(name)] = t[i]
        return entries

    def step(self, unknown: Sequence[str], integration: str) -> tuple[int, Any]:
        """Return stages, and the function from stages, state before, signals, constants and dt to equations."""
        functions = DAEFunctions(self.promoted(unknown), integration)
        X, x = ca.SX.sym("X", functions.stages * len(self.nominal_state)), ca.SX.sym("x", len(self.nominal_state))
        u, t, dt = ca.SX.sym("u", len(self.nominal_signals)), ca.SX.sym("t", len(unknown)), ca.SX.sym("dt")
        theta = _column(self.theta(unknown, t))
        found = functions.residual_function(X, x, u, theta, dt)[0]
        return functions.stages, ca.Function("equations", [X, x, u, t, dt], [found])

    def outputs(self, unknown: Sequence[str]) -> Any:
        """Return the function from state, signals and constants to y, H and L."""
        model = self.promoted(unknown)
        symbols = symbols_of(model)
        columns = [model.parameter_names.index(name) for name in unknown]
        H = ca.jacobian(symbols.outputs, symbols.x)
        L = ca.jacobian(symbols.outputs, symbols.theta)[:, columns]
        full = ca.Function("h", [symbols.x, symbols.theta], [ca.densify(part) for part in (symbols.outputs, H, L)])
        x, u, t = ca.SX.sym("x", model.nx), ca.SX.sym("u", model.nu), ca.SX.sym("t", len(unknown))
        return ca.Function("outputs", [x, u, t], list(full(x, _column(self.theta(unknown, t)))))


def _column(entries: Sequence[Any]) -> Any:
    return ca.vertcat(*(ca.SX(entry) for entry in entries)) if entries else ca.SX(0, 1)


#: A discrete plant is stepped as it is.
EXACT_STEP = "exact"
#: The least effect of a state on the outputs, as a share of the largest, by which it is sized.
LEAST_EFFECT = 1e-6
#: What the matrices of varying and of invariant plants are called here; G and L are of constant effects.
MATRIX_LETTERS = {"E": "E", "A": "A", "B": "B", "C": "C", "Phi": "G", "Psi": "L"}
#: Constant effects of an invariant plant are its faults, then its unknown inputs.
INVARIANT = {**{name: (name,) for name in "EABCD"}, "G": ("Bf", "Bd"), "L": ("Df", "Dd")}

Known = Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class _Matrix:
    """A matrix ``(rows, columns)``: from values by name and its signals to symbols; from k to its signals, if any."""

    shape: tuple[int, int]
    symbolic: Callable[[Known, Any], Any]
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


def _outputs_function(x: Any, s: Any, t: Any, y: Any) -> Any:
    """Return the function from state, signals and constants to y, H and L."""
    return ca.Function("outputs", [x, s, t], [ca.densify(part) for part in (y, ca.jacobian(y, x), ca.jacobian(y, t))])


def _dense(rows: Sequence[Sequence[Any]], shape: tuple[int, int]) -> Any:
    return ca.vertcat(*(ca.horzcat(*row) for row in rows)) if all(shape) else ca.SX(*shape)


class LinearPlant(CalibrationPlant):
    """A linear plant in one of three forms; its signals are inputs before and at the row, k, and varying matrices."""

    has_levels = False

    def __init__(self, plant: DescriptorSystem | TimeVaryingDescriptorSystem, log: Log) -> None:
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

    def _algebraic(self, log: Log) -> list[int]:
        """Return the rows of E that are zero for every k of the log, of a discrete plant."""
        if self.continuous:
            return []
        matrix = self.matrices["E"]
        if matrix.recorded is not None:
            stack = np.array(
                [matrix.recorded(log.rows[0] + i).reshape(self.nx, self.nx, order="F") for i in range(1, log.samples)]
            )
            return np.flatnonzero(~stack.any(axis=(0, 2))).tolist()
        known = {name: ca.SX.sym(name) for name in (*self.values, INDEX_NAME)}
        E = ca.SX(matrix.symbolic(known, None))
        return [i for i in range(self.nx) if all(E[i, j].is_zero() for j in range(self.nx))]

    def signals(self, log: Log) -> FloatArray:
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
        found = []
        for name, matrix in self.matrices.items():
            if matrix.recorded is None:
                continue
            if name in ("E", "C"):
                found.append((name, True))
                continue
            found.append((name, False))
            if self.late and name in ("A", "B", "G"):
                found.append((name, True))
        return found

    def _at(self, s: Any, t: Any, unknown: Sequence[str]) -> Callable[[str, bool], Any]:
        """Return the function from a matrix's name, and whether at the row itself, to its symbols."""
        place = 2 * self.nu + 1
        flats = {}
        for name, later in self._recorded():
            width = self.matrices[name].width
            flats[name, later] = s[place : place + width]
            place += width
        known = {
            **{name: ca.SX(value) for name, value in self.values.items()},
            **{name: t[i] for i, name in enumerate(unknown)},
        }
        k = s[2 * self.nu]

        def matrix(name: str, later: bool) -> Any:
            # A constant of an invariant plant may have the name of the index.
            here = {INDEX_NAME: k if later else k - 1.0} | known
            return self.matrices[name].symbolic(here, flats.get((name, later)))

        return matrix

    def _constant_effects(self, t: Any, unknown: Sequence[str]) -> Any:
        return _column([t[list(unknown).index(name)] if name in unknown else 0.0 for name in self.effects])

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
            found = ca.vertcat(*rows)
        else:
            found = at("E", True) @ X - at("A", False) @ x - driven
            if self.late:
                held = -(at("A", True) @ X + self._product(at("B", True), now) + self._product(at("G", True), f))
                for i in self.late:
                    found[i] = held[i]
        return stages, ca.Function("equations", [X, x, s, t, dt], [found])

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
        return _outputs_function(x, s, t, y)

    def _sizes(self, log: Log, signals: FloatArray) -> FloatArray:
        """Return how large each initial state can be ``(nx,)``: so that alone it makes outputs as large as they are."""
        stages, equations = self.step((), next(iter(BUTCHER)) if self.continuous else EXACT_STEP)
        X, x, s = ca.SX.sym("X", self.nx * stages), ca.SX.sym("x", self.nx), ca.SX.sym("s", signals.shape[1])
        found = equations(X, x, s, ca.SX(0, 1), log.dt)
        both = ca.Function("both", [s], [ca.densify(ca.jacobian(found, X)), ca.densify(ca.jacobian(found, x))])
        outputs = self.outputs(())
        y = log.y - self.output_point
        large = np.sqrt(np.nanmean(y**2, axis=0))
        large = np.where(large > 0.0, large, 1.0)[:, None]
        reach, effects = np.eye(self.nx), np.zeros(self.nx)
        for i, row in enumerate(signals[:SIZED_SAMPLES]):
            if i:
                J, before = (np.array(part) for part in both(row))
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

    def symbolic(known: Known, _: Any) -> Any:
        parts = []
        for matrix, entries in beside:
            found = ca.SX(ca.DM(np.asarray(matrix, dtype=np.float64)))
            for row, column, text in entries:
                found[row, column] = known[text] if text in known else symbolic_value(uncertainty.parsed(text), known)
            parts.append(found)
        return ca.horzcat(*parts)

    return _Matrix((len(beside[0][0]), sum(matrix.shape[1] for matrix, _ in beside)), symbolic)


#: Where the search for a correlation begins, and its bounds: in samples, the last as a share of the log.
FIRST_CORRELATION, LEAST_CORRELATION, LONGEST_SHARE = 10.0, 0.3, 1.0
#: An offset may be this many times what a sensor changes from row to row, or as large as it moves.
LARGEST_SENSOR_OFFSET = 10.0


@dataclass(frozen=True)
class NoiseStates:
    """What gets states: coloured noise by output, with its correlation in s or None; offsets by output; loads."""

    correlations: Mapping[str, float | None] = field(default_factory=dict)
    offsets: tuple[str, ...] = ()
    loads: tuple[str, ...] = ()

    @property
    def searched(self) -> tuple[str, ...]:
        """Outputs whose correlation is to be found."""
        return tuple(name for name, value in self.correlations.items() if value is None)

    def __bool__(self) -> bool:
        return bool(self.correlations or self.offsets or self.loads)


def asked_states(
    sensor_noise: Mapping[str, Any] | None, offset: Any, walks: Any, output_names: Sequence[str]
) -> NoiseStates:
    """Return the states that a caller asks for; what is white needs none."""
    correlations = {}
    for name, item in (sensor_noise or {}).items():
        index_of(name, output_names, what="sensor_noise")
        if not isinstance(item, Mapping) or "correlation" not in item:
            continue
        value = item["correlation"]
        correlations[name] = None if value == UNKNOWN_NUMBER else seconds(value, f"sensor_noise.{name}.correlation")
    offsets = () if offset is None else tuple(offset)
    for name in offsets:
        index_of(name, output_names, what="offset")
    return NoiseStates(correlations, offsets, () if walks is None else tuple(walks))


def correlation_name(output: str) -> str:
    """Return what the logarithm of a correlation in s is called among what is sought."""
    return f"correlation of {output}"


class PlantWithNoise(CalibrationPlant):
    """A plant with further states, which follow its own: coloured noise, offsets, loads.

    Coloured noise goes over a sample as the plant's own integration makes it, so that a design finds the same numbers.
    """

    def __init__(self, inner: CalibrationPlant, states: NoiseStates, log: Log) -> None:
        self.inner, self.states, self._outputs = inner, states, log.output_names
        for name in states.loads:
            index_of(name, list(inner.values), what="walks")
        self.coloured, self.own = tuple(states.correlations), len(inner.state_names)
        added = (
            *(noise_state(name) for name in self.coloured),
            *(offset_state(name) for name in states.offsets),
            *states.loads,
        )
        self.added = added
        self.state_names, self.equation_names = (*inner.state_names, *added), (*inner.equation_names, *added)
        first = np.log(FIRST_CORRELATION * log.dt)
        self.values = {
            **{name: value for name, value in inner.values.items() if name not in states.loads},
            **{correlation_name(name): first for name in states.searched},
        }
        self.unstated = inner.unstated - set(states.loads)
        self.units, self.has_levels, self.own_integration = inner.units, inner.has_levels, inner.own_integration
        self.notes = () if set(inner.unknown_inputs) <= set(states.loads) else inner.notes
        self.unknown_inputs = inner.unknown_inputs
        self.nominal_signals = inner.nominal_signals
        means = [float(inner.values[name]) for name in states.loads]
        self.nominal_state = np.concatenate([inner.nominal_state, np.zeros(len(added) - len(means)), means])
        longest = max(LONGEST_SHARE * log.samples, 2.0 * FIRST_CORRELATION)
        span = (float(np.log(LEAST_CORRELATION * log.dt)), float(np.log(longest * log.dt)))
        self.bounds = {correlation_name(name): span for name in states.searched}
        sizes = self._sizes(log)
        self.state_scales = np.concatenate([inner.state_scales, sizes])
        self.state_deviations = np.concatenate([inner.state_deviations, sizes])

    @property
    def noisy(self) -> tuple[str, ...]:
        """Equations of further states that noise drives: all but those of offsets."""
        fixed = {offset_state(name) for name in self.states.offsets}
        return tuple(name for name in self.added if name not in fixed)

    def signals(self, log: Log) -> FloatArray:
        """Return what steps and outputs take of each row ``(n, ns)``."""
        return self.inner.signals(log)

    def _sizes(self, log: Log) -> FloatArray:
        """Return how large the further states may be: as sensors move, or as loads that make them move so."""
        rough = roughness(log.y)
        moved = np.nan_to_num(np.nanstd(log.y, axis=0))
        moved = np.maximum(np.where(moved > 0.0, moved, 1.0), rough)
        large = dict(zip(log.output_names, moved, strict=True))
        offsets = dict(zip(log.output_names, np.maximum(moved, LARGEST_SENSOR_OFFSET * rough), strict=True))
        found = [large[name] for name in self.coloured] + [offsets[name] for name in self.states.offsets]
        return np.array([*found, *self._load_sizes(log, moved)])

    def _load_sizes(self, log: Log, moved: FloatArray) -> list[float]:
        found = []
        for name in self.states.loads:
            graphs = sample_graphs(self.inner, (name,), log.dt, integration=self.inner.integration("auto"), substeps=1)
            x, t = self.inner.nominal_state, np.array([float(self.inner.values[name])])
            signals, reach, effect = self.inner.signals(log), np.zeros((self.own, 1)), 0.0
            for row in signals[:SIZED_SAMPLES]:
                stages = graphs.solve(x, row, t)[0]
                numbers = graphs.sensitivities(x, row, t, stages)
                _, F, G, _ = graphs.local(x, row, t, t, numbers)
                reach = np.array(F) @ reach + np.array(G)
                _, H, L = graphs.outputs(x, row, t)
                effect = max(effect, float(np.nanmax(np.abs(np.array(H) @ reach + np.array(L))[:, 0] / moved)))
            nominal = abs(t[0]) or 1.0
            found.append(1.0 / effect if effect > SMALLEST else nominal)
        return found

    def _correlation(self, name: str, t: Any, unknown: Sequence[str]) -> Any:
        value = self.states.correlations[name]
        return ca.exp(t[list(unknown).index(correlation_name(name))]) if value is None else ca.SX(value)

    def _inner_constants(self, x: Any, t: Any, unknown: Sequence[str]) -> tuple[tuple[str, ...], Any]:
        """Return what the plant itself takes as unknown, and its values: constants, and loads from their states."""
        searched = {correlation_name(name) for name in self.states.searched}
        kept = [i for i, name in enumerate(unknown) if name not in searched]
        loads = x[x.numel() - len(self.states.loads) :] if self.states.loads else ca.SX(0, 1)
        values = ca.vertcat(*(t[i] for i in kept), loads)
        return (*(unknown[i] for i in kept), *self.states.loads), values if values.numel() else ca.SX(0, 1)

    def step(self, unknown: Sequence[str], integration: str) -> tuple[int, Any]:
        """Return stages, and the function from stages, state before, signals, constants and dt to equations."""
        n, whole = self.own, len(self.state_names)
        names, _ = self._inner_constants(ca.SX.sym("x", whole), ca.SX.sym("t", len(unknown)), unknown)
        stages, inner = self.inner.step(names, integration)
        X, x, dt = ca.SX.sym("X", whole * stages), ca.SX.sym("x", whole), ca.SX.sym("dt")
        s, t = ca.SX.sym("s", len(self.nominal_signals)), ca.SX.sym("t", len(unknown))
        parts = ca.reshape(X, whole, stages)
        # Loads act as inputs do: during the step that ends with them, of a discrete plant that begins with them.
        _, values = self._inner_constants(parts[:, stages - 1] if integration in BUTCHER else x, t, unknown)
        found = ca.reshape(inner(ca.vec(parts[:n, :]), x[:n], s, values, dt), n, stages)
        added = self._added(parts[n:, :], x[n:], t, unknown, dt, integration)
        return stages, ca.Function("equations", [X, x, s, t, dt], [ca.vec(ca.vertcat(found, added))])

    def _added(self, parts: Any, before: Any, t: Any, unknown: Sequence[str], dt: Any, integration: str) -> Any:
        """Return the equations of the further states at each stage, in units of their change over a second."""
        stages = parts.shape[1]
        rows = []
        if integration in BUTCHER:
            weights = np.linalg.inv(BUTCHER[integration])
            for i in range(parts.shape[0]):
                change = parts[i, :] - before[i]
                rate = ca.horzcat(
                    *(sum(float(weights[k, j]) * change[j] for j in range(stages)) / dt for k in range(stages))
                )
                fall = parts[i, :] / self._correlation(self.coloured[i], t, unknown) if i < len(self.coloured) else 0.0
                rows.append(rate + fall)
        else:
            for i in range(parts.shape[0]):
                kept = ca.exp(-dt / self._correlation(self.coloured[i], t, unknown)) if i < len(self.coloured) else 1.0
                rows.append(parts[i, :] - kept * before[i])
        return ca.vertcat(*rows)

    def outputs(self, unknown: Sequence[str]) -> Any:
        """Return the function from state, signals and constants to y, H and L."""
        whole = len(self.state_names)
        x, s, t = ca.SX.sym("x", whole), ca.SX.sym("s", len(self.nominal_signals)), ca.SX.sym("t", len(unknown))
        names, values = self._inner_constants(x, t, unknown)
        y = self.inner.outputs(names)(x[: self.own], s, values)[0]
        shown = np.zeros((y.numel(), len(self.coloured) + len(self.states.offsets)))
        for column, name in enumerate((*self.coloured, *self.states.offsets)):
            shown[self._outputs.index(name), column] = 1.0
        y = ca.densify(y) + ca.mtimes(ca.DM(shown), x[self.own : self.own + shown.shape[1]]) if shown.size else y
        return _outputs_function(x, s, t, y)


#: Optimisation costs more than it gains on straight code of thousands of lines.
STRAIGHT_CODE_FLAGS = ("-std=c99", "-O1", "-ffp-contract=off", "-shared", "-fPIC")


def compiled(functions: Sequence[Any]) -> list[Any]:
    """Return the same functions as machine code; as they are where there is no compiler or it fails."""
    command = compiler()
    if command is None:
        return list(functions)
    generator = ca.CodeGenerator("calibration.c")
    for function in functions:
        generator.add(function)
    try:
        return list(
            _loaded(
                generator.dump(), tuple(function.name() for function in functions), (*command, *STRAIGHT_CODE_FLAGS)
            )
        )
    except (SpecError, RuntimeError):  # CasADi, of a folder from which nothing is loaded
        return list(functions)


@lru_cache(maxsize=16)
def _loaded(code: str, names: tuple[str, ...], command: tuple[str, ...]) -> tuple[Any, ...]:
    """Return functions of C code; the same code is compiled once."""
    with working_folder() as folder:
        library = shared_library(folder, {"calibration.c": code}, command, path="calibrate")
        # What is loaded stays when the file is gone; Windows keeps the file.
        return tuple(ca.external(name, str(library)) for name in names)


#: Newton iterations of every step, from the last sample's state, and further ones where the residual is above
#: `SOLVED_STEP`.
ITERATIONS, FURTHER_ITERATIONS = 3, 8
SOLVED_STEP = 1e-11
#: Operations in one evaluation above which functions are compiled: a second or so, before a thousand evaluations.
COMPILED_OPERATIONS = 200_000


@dataclass(frozen=True, eq=False)
class SampleGraphs:
    """The functions of one sample; ``u (nu,)`` are the signals, ``t (nt,)`` the unknown constants."""

    solve: Any  # from x, u, t to the stages of all substeps and the scaled residual that is left
    sensitivities: Any  # from x, u, t, stages to what `local` takes as numbers: stages and their derivatives
    local: Any  # from x, u, t, t and those numbers to the state after, F, G by t, and the noise's way
    outputs: Any  # from x, u, t to y, H and L by t
    fast: Any  # `local`, to be evaluated and not to be differentiated
    nx: int
    nu: int
    ny: int
    nt: int
    numbers: int
    in_c: bool  # whether functions are machine code
    made: dict[Any, Any] = field(default_factory=dict, repr=False)


def sample_graphs(
    plant: CalibrationPlant, unknown: Sequence[str], dt: float, *, integration: str, substeps: int, samples: int = 1
) -> SampleGraphs:
    """Return the functions of one sample of ``dt`` seconds, in C where there are many."""
    base = _Substep(plant, unknown, dt / substeps, integration)
    nx, nu, nt, n = len(plant.state_scales), len(plant.nominal_signals), len(unknown), base.size
    x, u, t = ca.MX.sym("x", nx), ca.MX.sym("u", nu), ca.MX.sym("t", nt)
    stages: list[Any] = []
    state, left = x, ca.MX(0.0)
    for _ in range(substeps):
        X, rest = base.solve(ca.repmat(state, base.stages, 1), state, u, t)
        stages, state, left = [*stages, X], X[n - nx :], ca.fmax(left, rest)
    solve = ca.Function("solve", [x, u, t], [ca.vertcat(*stages), left])

    Z, numbers, state = ca.MX.sym("Z", n * substeps), [x], x
    for i in range(substeps):
        X = Z[n * i : n * (i + 1)]
        numbers += [X, *(ca.vec(part) for part in base.derivatives(X, state, u, t))]
        state = X[n - nx :]
    packed = ca.vertcat(*numbers)
    sensitivities = ca.Function("sensitivities", [x, u, t, Z], [packed])
    outputs = plant.outputs(unknown)
    local = _local(base, substeps, nx, nu, nt)
    fast, in_c = local, 8 * samples * local.n_instructions() > COMPILED_OPERATIONS
    if in_c:
        solve, sensitivities, fast = compiled([solve, sensitivities, local])
    return SampleGraphs(
        solve, sensitivities, local, outputs, fast, nx, nu, outputs.size1_out(0), nt, packed.shape[0], in_c
    )


def _local(base: _Substep, substeps: int, nx: int, nu: int, nt: int) -> Any:
    """Return the differentiable part: values from the numbers, derivatives from the equations at them."""
    n = base.size
    x, u, t, tc = (ca.SX.sym(name, size) for name, size in (("x", nx), ("u", nu), ("t", nt), ("tc", nt)))
    length = nx + substeps * n * (1 + nx + nt)
    packed = ca.SX.sym("numbers", length)
    before, state, place = packed[:nx], x, nx
    F, G, noise = ca.SX.eye(nx), ca.SX.zeros(nx, nt), ca.SX.zeros(nx, nx)
    for _ in range(substeps):
        X = packed[place : place + n]
        by_x = ca.reshape(packed[place + n : place + n * (1 + nx)], n, nx)
        by_t = ca.reshape(packed[place + n * (1 + nx) : place + n * (1 + nx + nt)], n, nt)
        moved = X + by_x @ (state - before) + by_t @ (t - tc)
        by_x, by_t, way = base.symbolic(moved, state, u, t)
        # What is added to the equations is added during the whole sample, in every substep.
        noise = by_x[n - nx :, :] @ noise + way
        F, G = by_x[n - nx :, :] @ F, by_x[n - nx :, :] @ G + by_t[n - nx :, :]
        state, before, place = moved[n - nx :], X[n - nx :], place + n * (1 + nx + nt)
    return ca.Function("local", [x, u, t, tc, packed], [state, ca.densify(F), ca.densify(G), ca.densify(noise)])


class _Substep:
    """One implicit step: its Newton iteration and its derivatives, by elimination in an order that is fixed."""

    def __init__(self, plant: CalibrationPlant, unknown: Sequence[str], dt: float, integration: str) -> None:
        self.nx, self.dt = len(plant.state_scales), dt
        self.stages, self.function = plant.step(unknown, integration)
        self.size = self.stages * self.nx
        X, x = ca.SX.sym("X", self.size), ca.SX.sym("x", self.nx)
        u, t = ca.SX.sym("u", len(plant.nominal_signals)), ca.SX.sym("t", len(unknown))
        sizes = ca.DM(np.tile(plant.state_scales, self.stages))
        equations = self.function(X, x, u, t, self.dt)
        J = ca.jacobian(equations, X)
        values = np.array([plant.values[name] for name in unknown])
        self.order = _pivots(ca.Function("J", [X, x, u, t], [ca.densify(J)]), plant, self.stages, values)
        step = eliminated(J, -equations, self.order)
        weights = 1.0 / ca.fmax(largest_entries(ca.densify(J) @ ca.diag(sizes)), SMALLEST)
        left = ca.mmax(ca.fabs(weights * equations)) if self.size > 1 else ca.fabs(weights * equations)
        # The residual is that before the iteration, so that the last one is better than it says.
        self.newton = ca.Function("newton", [X, x, u, t], [X + step, left])
        self.solve = self._solve()
        found = [ca.densify(part) for part in self.symbolic(X, x, u, t)[:2]]
        self.derivatives = ca.Function("derivatives", [X, x, u, t], found)

    def _solve(self) -> Any:
        """Return the solution of the stages from a start, in as many iterations as it takes."""
        start = [ca.MX.sym(name, self.newton.size1_in(i)) for i, name in enumerate(("X", "x", "u", "t"))]
        X, before = start[0], start[1:]
        for _ in range(ITERATIONS):
            X, left = self.newton(X, *before)
        X, left = self.newton(X, *before)
        more, rest = start[0], ca.MX(0.0)
        for _ in range(FURTHER_ITERATIONS):
            more, rest = self.newton(more, *before)
        further = ca.Function("iterate", start, [more, rest])
        done = ca.Function("done", start, [start[0], ca.MX(0.0)])
        choice = ca.Function.if_else("choice", further, done)
        unsolved = ca.logic_not(left <= SOLVED_STEP)
        after, rest = choice(unsolved, X, *before)
        return ca.Function("solution", start, [after, ca.if_else(unsolved, rest, left)])

    def symbolic(self, X: Any, x: Any, u: Any, t: Any) -> tuple[Any, Any, Any]:
        """Return the derivatives of the stages by x and by t, and of the state after by what is added."""
        Xs, xs, us, ts = (ca.SX.sym(name, part.numel()) for name, part in zip("Xxut", (X, x, u, t), strict=True))
        equations, nx, nt = self.function(Xs, xs, us, ts, self.dt), self.nx, ts.numel()
        right = ca.horzcat(
            -ca.jacobian(equations, xs), -ca.jacobian(equations, ts), ca.repmat(ca.SX.eye(nx), self.stages, 1)
        )
        found = eliminated(ca.jacobian(equations, Xs), right, self.order)
        found = ca.Function("found", [Xs, xs, us, ts], [found])(X, x, u, t)
        return found[:, :nx], found[:, nx : nx + nt], found[self.size - nx :, nx + nt :]


def _pivots(jacobian: Any, plant: CalibrationPlant, stages: int, values: FloatArray) -> list[int]:
    """Return the order of rows in which elimination goes at the nominal point."""
    from scipy.linalg import lu_factor

    x = plant.nominal_state
    J = np.array(jacobian(np.tile(x, stages), x, plant.nominal_signals, values))
    J = np.nan_to_num(J * np.tile(plant.state_scales, stages))
    peaks = np.abs(J).max(axis=1)
    _, exchanges = lu_factor(J / np.where(peaks > 0.0, peaks, 1.0)[:, None], check_finite=False)
    order = list(range(len(J)))
    for i, j in enumerate(exchanges):
        order[i], order[j] = order[j], order[i]
    return order


def eliminated(matrix: Any, right: Any, order: Sequence[int]) -> Any:
    """Return ``matrix^-1 right`` by scalar operations, rows in a given order; structural zeros cost nothing."""
    n, m = matrix.shape[0], right.shape[1]
    rows = [[matrix[i, j] for j in range(n)] + [right[i, j] for j in range(m)] for i in order]
    for j in range(n):
        for i in range(j + 1, n):
            if rows[i][j].is_zero():
                continue
            factor = rows[i][j] / rows[j][j]
            for c in range(j + 1, n + m):
                if not rows[j][c].is_zero():
                    rows[i][c] = rows[i][c] - factor * rows[j][c]
    found: list[list[Any]] = [[]] * n
    for j in reversed(range(n)):
        solution = []
        for c in range(m):
            rest = rows[j][n + c]
            for i in range(j + 1, n):
                if not (rows[j][i].is_zero() or found[i][c].is_zero()):
                    rest = rest - rows[j][i] * found[i][c]
            solution.append(rest if rest.is_zero() else rest / rows[j][j])
        found[j] = solution
    return ca.vertcat(*(ca.horzcat(*row) for row in found))


#: Measured values for each unknown constant and variance that are needed at least.
VALUES_PER_UNKNOWN = 5
#: Least deviation of a sensor, as a share of its largest value: rounding.
LEAST_NOISE = 1e-9


@dataclass(frozen=True, eq=False)
class Problem:
    """A plant with its log; arrays by unknown ``(nt,)``, by sensor ``(ny,)``, by noisy equation. ``u (n, ns)``: the
    signals that the plant takes of each row."""

    plant: CalibrationPlant
    log: Log
    u: FloatArray
    unknown: tuple[str, ...]
    nominal: FloatArray
    low: FloatArray
    high: FloatArray
    prior_means: FloatArray
    prior_weights: FloatArray
    noisy: tuple[str, ...]
    known_Q: FloatArray
    known_R: FloatArray
    x0: FloatArray
    P0: FloatArray
    quanta: FloatArray
    floors: FloatArray
    graphs: SampleGraphs
    integration: str
    substeps: int
    notes: tuple[str, ...] = ()

    @property
    def y(self) -> FloatArray:
        """Outputs ``(n, ny)``, NaN where missing."""
        return self.log.y

    @property
    def names(self) -> tuple[str, ...]:
        """The constants that were asked for; what is sought beside them stands last."""
        return self.unknown[: len(self.unknown) - len(self.plant.bounds)]

    @property
    def widths(self) -> FloatArray:
        """Width of the bounds of each unknown ``(nt,)``."""
        return self.high - self.low

    @property
    def output_names(self) -> tuple[str, ...]:
        """The sensors."""
        return self.log.output_names

    @property
    def noisy_equations(self) -> list[int]:
        """Numbers of the noisy equations."""
        return [self.plant.equation_names.index(name) for name in self.noisy]

    def integrated(self, integration: str, substeps: int) -> Problem:
        """Return the same problem with other steps."""
        graphs = sample_graphs(
            self.plant, self.unknown, self.log.dt, integration=integration, substeps=substeps, samples=self.log.samples
        )
        return Problem(**{**vars(self), "graphs": graphs, "integration": integration, "substeps": substeps})

    def with_start(self, P0: FloatArray, *notes: str) -> Problem:
        """Return the same problem with another covariance of the initial state, and what is said of that."""
        return Problem(**{**vars(self), "P0": P0, "notes": notes})

    def with_notes(self, *notes: str) -> Problem:
        """Return the same problem with more that is said of it."""
        return Problem(**{**vars(self), "notes": (*self.notes, *notes)})

    def with_log(self, log: Log) -> Problem:
        """Return the same problem with another log of the same signals."""
        return Problem(**{**vars(self), "log": log, "u": self.plant.signals(log)})


def calibration_problem(
    plant: CalibrationPlant,
    log: Log,
    *,
    unknown: Mapping[str, Sequence[float]],
    priors: Mapping[str, Sequence[float]] | None,
    noisy: Sequence[str] | None,
    Q: Mapping[str, float | None] | None,
    R: Mapping[str, float | None] | None,
    initial_state: Any,
    initial_covariance: Any,
    integration: str,
    substeps: int,
) -> Problem:
    """Return the problem, or say what is wrong with what is asked."""
    substeps = whole_number(substeps, "substeps")
    if not log.samples > 1:
        raise bad_log("too-short", f"The log has {log.samples} row(s): a calibration needs more.")
    if not isinstance(unknown, Mapping):
        raise SpecError("unknown must be a mapping from names to [low, high], such as {k: [0.5, 2]}.", path="unknown")
    unknown = {**unknown, **plant.bounds}
    names = tuple(unknown)
    for name in names:
        index_of(name, list(plant.values), what="unknown")
    values = _started(unknown, plant)
    low, high = _bounds(unknown, values)
    equations = tuple(plant.equation_names if noisy is None else noisy)
    for name in equations:
        index_of(name, plant.equation_names, what="noisy (the equations that Q names)")
    means, weights = _priors(priors, names, values)
    known_Q = _variances(Q, equations, "Q")
    known_R = _variances(R, log.output_names, "R")
    quanta = np.array([quantum(column) for column in log.y.T])
    _require_enough(log, len(names), int(np.isnan(known_Q).sum() + np.isnan(known_R).sum()))
    x0 = named_vector(initial_state, plant.state_names, plant.nominal_state, "initial_state")
    graphs = sample_graphs(plant, names, log.dt, integration=integration, substeps=substeps, samples=log.samples)
    return Problem(
        plant,
        log,
        plant.signals(log),
        names,
        np.array([values[name] for name in names]),
        low,
        high,
        means,
        weights,
        equations,
        known_Q,
        known_R,
        x0,
        _covariance(plant, initial_covariance),
        quanta,
        _floors(log.y, quanta),
        graphs,
        integration,
        substeps,
    )


def _floors(y: FloatArray, quanta: FloatArray) -> FloatArray:
    """Return the least variance of each sensor ``(ny,)``: of its quantisation, where values repeat, or of rounding."""
    held = np.array([repeats(column) for column in y.T])
    largest = np.nanmax(np.abs(y), axis=0)
    return np.maximum(np.where(held, quanta**2 / EVEN, 0.0), (LEAST_NOISE * np.where(largest > 0.0, largest, 1.0)) ** 2)


def _require_enough(log: Log, constants: int, variances: int) -> None:
    """Refuse a question without unknowns, or with more of them than the log can determine."""
    if not constants and not variances:
        raise SpecError(
            "unknown is empty, and Q and R are known: there is nothing to estimate. Name constants with their "
            "bounds, or leave variances out.",
            path="unknown",
        )
    needed, seen = VALUES_PER_UNKNOWN * (constants + variances), int(np.isfinite(log.y).sum())
    if seen < needed:
        raise bad_log(
            "too-short",
            f"The log is too short: {seen} measured values for {constants} constants and "
            f"{variances} variances; at least {needed} are needed. Take more rows, fewer unknowns, or state "
            "Q and R.",
        )


def _started(unknown: Mapping[str, Sequence[float]], plant: CalibrationPlant) -> dict[str, float]:
    """Return nominal values; the middle of its bounds for what has none within them and none that is stated."""
    values = dict(plant.values)
    for name in plant.unstated.intersection(unknown):
        pair = unknown[name]
        if _is_pair(pair) and not pair[0] <= values[name] <= pair[1]:
            values[name] = 0.5 * (float(pair[0]) + float(pair[1]))
    return values


def _is_pair(pair: Any) -> bool:
    """Whether a value is two finite numbers."""
    return np.shape(pair) == (2,) and all(is_number(entry) and np.isfinite(entry) for entry in pair)


def _bounds(unknown: Mapping[str, Sequence[float]], values: Mapping[str, float]) -> tuple[FloatArray, FloatArray]:
    rows = []
    for name, pair in unknown.items():
        if not _is_pair(pair) or not pair[0] < pair[1]:
            raise SpecError(
                f"unknown.{name} is {pair!r}: give [low, high], finite, the lower one first.", path=f"unknown.{name}"
            )
        if not pair[0] <= values[name] <= pair[1]:
            raise SpecError(
                f"The nominal value of {name!r}, {values[name]:g}, is outside its bounds [{pair[0]:g}, "
                f"{pair[1]:g}]: move one of them.",
                path=f"unknown.{name}",
            )
        rows.append([float(pair[0]), float(pair[1])])
    low, high = np.array(rows).reshape(len(rows), 2).T
    return low, high


def _priors(
    priors: Mapping[str, Sequence[float]] | None, names: Sequence[str], values: Mapping[str, float]
) -> tuple[FloatArray, FloatArray]:
    means, weights = np.array([values[name] for name in names]), np.zeros(len(names))
    for name, pair in (priors or {}).items():
        i = index_of(name, names, what="priors")
        if not _is_pair(pair) or not pair[1] > 0.0:
            raise SpecError(f"priors.{name} is {pair!r}: give [mean, standard deviation].", path=f"priors.{name}")
        means[i], weights[i] = float(pair[0]), float(pair[1]) ** -2
    return means, weights


def _variances(given: Mapping[str, float | None] | None, names: Sequence[str], what: str) -> FloatArray:
    """Return known variances, NaN for those that are to be found."""
    require_mapping(given, what)
    found = np.full(len(names), np.nan)
    for name, value in (given or {}).items():
        i = index_of(name, names, what=what)
        if value is None:
            continue
        found[i] = real_number(
            value, f"{what}.{name}", "a positive variance, or leave it out to have it found", above=0.0
        )
    return found


def _covariance(plant: CalibrationPlant, value: Any) -> FloatArray:
    default, nx = plant.state_deviations**2, len(plant.state_names)
    matrix = named_covariance(value, plant.state_names, "initial_covariance", default, others=default)
    require_shape(matrix.shape, (nx, nx), "initial_covariance")
    covariance_factor(matrix, "initial_covariance")
    return matrix


def require_variation(problem: Problem) -> None:
    """Refuse a log in which nothing moves and nothing is put in: it determines no constant."""
    if not np.nanstd(problem.y, axis=0).any() and not np.std(problem.u, axis=0).any():
        raise refused(
            "not-exciting",
            "Every signal is constant in these rows: they hold no information on the dynamics.",
            signals=list(problem.unknown),
        )


#: A scaled Newton residual above this is no solution of a step.
LARGEST_STEP_RESIDUAL = 1e-7
#: Stands for the likelihood where there is none.
IMPOSSIBLE = 1e12


class Likelihood:
    """Negative log likelihood of a problem's record, or of other outputs ``y (n, ny)`` with NaN for what is missing, as
    a function of ``v = [t, log q, log r]``."""

    def __init__(self, problem: Problem, y: FloatArray | None = None) -> None:
        graphs, noisy = problem.graphs, problem.noisy_equations
        self.ny, self.size = graphs.ny, graphs.nt + len(noisy) + graphs.ny
        y, self._nx = problem.y if y is None else y, graphs.nx
        self._both, self._missing = Compiled(_whole(graphs, problem.u, y, noisy, problem.x0, problem.P0)), np.isnan(y)

    def __call__(self, v: FloatArray) -> tuple[float, FloatArray]:
        """Return the value and its gradient ``(nt + len(noisy) + ny,)``."""
        total, gradient, rows, _ = self._both(v)
        left = rows[-1]
        good = np.isfinite(total).all() and np.isfinite(gradient).all() and np.abs(left).max() <= LARGEST_STEP_RESIDUAL
        return (float(total[0, 0]), gradient[:, 0]) if good else (IMPOSSIBLE, np.zeros(self.size))

    def at_end(self, v: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the state after the last row ``(nx,)``, and its covariance."""
        packed = self._both(v)[3][:, 0]
        return packed[: self._nx], packed[self._nx :].reshape(self._nx, self._nx)

    def innovations(self, v: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return whitened innovations, innovations and their variances, each ``(n, ny)``; no innovation (NaN) where y
        is missing."""
        whitened, e, variances = (part.T for part in np.split(self._both(v)[2][1 : 1 + 3 * self.ny], 3))
        return np.where(self._missing, np.nan, whitened), np.where(self._missing, np.nan, e), variances


def _whole(
    graphs: SampleGraphs, u: FloatArray, y: FloatArray, noisy: Sequence[int], x0: FloatArray, P0: FloatArray
) -> Any:
    """Return the function from v to value, gradient, rows, and the state and covariance after them, packed."""
    nx, nt, n = graphs.nx, graphs.nt, len(y)
    first = _first(graphs, noisy)
    seen = np.isfinite(y)
    data = np.hstack([u, np.where(seen, y, 0.0), seen]).T
    v = ca.MX.sym("v", nt + len(noisy) + graphs.ny)
    begin = ca.DM(np.concatenate([x0, P0.ravel()]))
    state, row = first(begin, data[:, 0], v)
    rows, total = row, row[0]
    gradient = ca.MX.zeros(v.shape[0])
    size = nx + nx * nx
    back_first = first.reverse(1)
    if n > 1:
        forward, backward = _accumulated(graphs, noisy, size)
        states, said, numbers = forward.mapaccum(n - 1)(state, data[:, 1:], ca.repmat(v, 1, n - 1))
        before = ca.horzcat(state, states[:, :-1])
        rows, total = ca.horzcat(row, said), row[0] + ca.sum2(said[0, :])
        flip = list(range(n - 2, -1, -1))
        costates = backward.mapaccum(n - 1)(
            ca.MX.zeros(size + v.shape[0]),
            before[:, flip],
            numbers[:, flip],
            ca.DM(data[:, 1:])[:, flip],
            ca.repmat(v, 1, n - 1),
        )
        end = costates[:, -1]
        costate, gradient, last = end[:size], end[size:], states[:, -1]
    else:
        costate, last = ca.MX.zeros(size), state
    seed = ca.MX.zeros(row.shape[0])
    seed[0] = 1.0
    gradient = gradient + back_first(begin, data[:, 0], v, state, row, costate, seed)[2]
    return ca.Function("likelihood", [v], [total, ca.densify(gradient), ca.densify(rows), ca.densify(last)])


def _update(graphs: SampleGraphs, x: Any, P: Any, u: Any, t: Any, log_r: Any, y: Any, seen: Any) -> tuple[Any, Any]:
    """Return the state and covariance after a measurement, packed; and its row: value, whitened, e, variances."""
    predicted, H, _ = graphs.outputs(x, u, t)
    H = ca.densify(H) * ca.repmat(seen, 1, graphs.nx)
    e = seen * (y - predicted)
    S = H @ P @ H.T + ca.diag(seen * ca.exp(log_r) + (1.0 - seen))
    root = ca.chol(ca.densify(S)).T
    whitened = ca.solve(root, ca.horzcat(e, H @ P))
    w, V = whitened[:, 0], whitened[:, 1:]
    after = P - V.T @ V
    value = 0.5 * ca.sumsqr(w) + ca.sum1(ca.log(ca.diag(root))) + 0.5 * math.log(2.0 * math.pi) * ca.sum1(seen)
    return ca.vertcat(x + V.T @ w, ca.vec(0.5 * (after + after.T))), ca.vertcat(value, w, e, ca.diag(S))


def _symbols(graphs: SampleGraphs, noisy: Sequence[int]) -> tuple[Any, ...]:
    nx, ny = graphs.nx, graphs.ny
    packed = ca.SX.sym("packed", nx + nx * nx)
    data = ca.SX.sym("data", graphs.nu + 2 * ny)
    v = ca.SX.sym("v", graphs.nt + len(noisy) + ny)
    u, y, seen = ca.vertsplit(data, [0, graphs.nu, graphs.nu + ny, graphs.nu + 2 * ny])
    t, log_q, log_r = ca.vertsplit(v, [0, graphs.nt, graphs.nt + len(noisy), v.numel()])
    return packed, data, v, u, y, seen, t, log_q, log_r


def _first(graphs: SampleGraphs, noisy: Sequence[int]) -> Any:
    packed, data, v, u, y, seen, t, _, log_r = _symbols(graphs, noisy)
    nx = graphs.nx
    x, P = packed[:nx], ca.reshape(packed[nx:], nx, nx)
    after, row = _update(graphs, x, P, u, t, log_r, y, seen)
    return ca.Function("first", [packed, data, v], [ca.densify(after), ca.densify(ca.vertcat(row, 0.0))])


def _later(graphs: SampleGraphs, noisy: Sequence[int]) -> Any:
    """Return one sample, with what was solved as numbers: from packed, data, v, tc, numbers to packed and row."""
    packed, data, v, u, y, seen, t, log_q, log_r = _symbols(graphs, noisy)
    nx = graphs.nx
    tc, numbers = ca.SX.sym("tc", graphs.nt), ca.SX.sym("numbers", graphs.numbers)
    P = ca.reshape(packed[nx:], nx, nx)
    x, F, _, way = graphs.local(packed[:nx], u, t, tc, numbers)
    added = way[:, list(noisy)]
    P = F @ P @ F.T + added @ ca.diag(ca.exp(log_q)) @ added.T if noisy else F @ P @ F.T
    after, row = _update(graphs, x, P, u, t, log_r, y, seen)
    return ca.Function("later", [packed, data, v, tc, numbers], [ca.densify(after), ca.densify(row)])


def _accumulated(graphs: SampleGraphs, noisy: Sequence[int], size: int) -> list[Any]:
    """Return what goes forward and back over samples, made once for all logs of a problem."""
    key = tuple(noisy)
    if key not in graphs.made:
        later = _later(graphs, noisy)
        backward = _backward(graphs, later, size)
        if graphs.in_c:
            later, backward = compiled([later, backward])
        graphs.made[key] = [_forward(graphs, later), backward]
    found: list[Any] = graphs.made[key]
    return found


def _forward(graphs: SampleGraphs, later: Any) -> Any:
    packed, data, v = (ca.MX.sym(name, later.size1_in(i)) for i, name in enumerate(("packed", "data", "v")))
    x, u, t = packed[: graphs.nx], data[: graphs.nu], v[: graphs.nt]
    stages, left = graphs.solve(x, u, t)
    numbers = graphs.sensitivities(x, u, t, stages)
    after, row = later(packed, data, v, t, numbers)
    return ca.Function("forward", [packed, data, v], [after, ca.vertcat(row, left), numbers])


def _backward(graphs: SampleGraphs, later: Any, size: int) -> Any:
    """Return the accumulation of costate and gradient over samples that go back."""
    names = ("packed", "data", "v")
    packed, data, v = (ca.MX.sym(name, later.size1_in(i)) for i, name in enumerate(names))
    numbers, costate = ca.MX.sym("numbers", graphs.numbers), ca.MX.sym("costate", size + v.shape[0])
    reverse = later.reverse(1)
    seed = ca.MX.zeros(later.size1_out(1))
    seed[0] = 1.0
    nothing = [ca.MX(later.size1_out(i), 1) for i in range(2)]
    # The derivative of scalar operations takes its function's results as arguments without using them.
    unused = all(reverse.nnz_in(i) == 0 for i in (5, 6))
    outputs = nothing if unused else list(later(packed, data, v, v[: graphs.nt], numbers))
    found = reverse(packed, data, v, v[: graphs.nt], numbers, *outputs, costate[:size], seed)
    after = ca.vertcat(found[0], costate[size:] + found[2])
    return ca.Function("backward", [costate, packed, numbers, data, v], [after])

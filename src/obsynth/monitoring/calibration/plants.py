"""Plants in a calibration: one implicit step and the outputs as CasADi functions of unknown constants."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np

from obsynth.monitoring.calibration.logs import RecordedLog
from obsynth.numerics import lazy_casadi as ca
from obsynth.numerics.arrays import FloatArray
from obsynth.plants.dae import DAEModel
from obsynth.plants.dae_equations import symbols_of
from obsynth.plants.dae_functions import DAEFunctions
from obsynth.plants.signal_names import index_of
from obsynth.plants.transformations.entries_in_constants import promoted

#: Deviation of an initial state that is not stated, as a share of its nominal size.
CALIBRATED_STATE_SHARE = 0.1

#: A load, or an initial state, is sized by what it does to the outputs in this many samples.
SIZED_SAMPLES = 50

#: A discrete plant is stepped as it is.
EXACT_STEP = "exact"


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
    walking: tuple[str, ...] = ()  # what may be taken as a random walk, among ``values``
    bounds: Mapping[str, tuple[float, float]] = MappingProxyType({})  # of what is sought beside constants, by name

    own_integration: str  # unless something else is asked for; a discrete plant is stepped as it is

    def integration(self, option: str) -> str:
        """Return how the plant is integrated at first."""
        return self.own_integration if option == "auto" or self.own_integration == EXACT_STEP else option

    @abstractmethod
    def signals(self, log: RecordedLog) -> FloatArray:
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
        self.units, self.walking = model.units, model.parameter_names
        self.nominal_state, self.state_scales = np.array(model.nominal_state), np.array(model.state_scales)
        self.state_deviations = CALIBRATED_STATE_SHARE * self.state_scales
        self.nominal_signals = np.array(model.nominal_input)
        self._promoted: dict[tuple[str, ...], DAEModel] = {}

    def signals(self, log: RecordedLog) -> FloatArray:
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
        theta = casadi_column(self.theta(unknown, t))
        residual = functions.residual_function(X, x, u, theta, dt)[0]
        return functions.stages, ca.Function("equations", [X, x, u, t, dt], [residual])

    def outputs(self, unknown: Sequence[str]) -> Any:
        """Return the function from state, signals and constants to y, H and L."""
        model = self.promoted(unknown)
        symbols = symbols_of(model)
        columns = [model.parameter_names.index(name) for name in unknown]
        H = ca.jacobian(symbols.outputs, symbols.x)
        L = ca.jacobian(symbols.outputs, symbols.theta)[:, columns]
        full = ca.Function("h", [symbols.x, symbols.theta], [ca.densify(part) for part in (symbols.outputs, H, L)])
        x, u, t = ca.SX.sym("x", model.nx), ca.SX.sym("u", model.nu), ca.SX.sym("t", len(unknown))
        return ca.Function("outputs", [x, u, t], list(full(x, casadi_column(self.theta(unknown, t)))))


def casadi_column(entries: Sequence[Any]) -> Any:
    """Return a column of CasADi expressions."""
    return ca.vertcat(*(ca.SX(entry) for entry in entries)) if entries else ca.SX(0, 1)


def outputs_function(x: Any, s: Any, t: Any, y: Any) -> Any:
    """Return the function from state, signals and constants to y, H and L."""
    return ca.Function("outputs", [x, s, t], [ca.densify(part) for part in (y, ca.jacobian(y, x), ca.jacobian(y, t))])

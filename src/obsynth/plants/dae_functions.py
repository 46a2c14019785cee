"""Compiled evaluation of a DAE with exact derivatives: one implicit step, outputs, and its equations at one point."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from obsynth.numerics import lazy_casadi as ca
from obsynth.numerics.arguments import chosen
from obsynth.numerics.arrays import FloatArray
from obsynth.plants.dae import DAEModel
from obsynth.plants.dae_equations import DAESymbols, symbols_of

_ROOT_OF_SIX = np.sqrt(6.0)

#: Butcher matrices of the implicit methods whose last stage is the result (stiffly accurate).
BUTCHER: dict[str, FloatArray] = {
    "backward-euler": np.array([[1.0]]),
    "radau": np.array(
        [
            [(88 - 7 * _ROOT_OF_SIX) / 360, (296 - 169 * _ROOT_OF_SIX) / 1800, (-2 + 3 * _ROOT_OF_SIX) / 225],
            [(296 + 169 * _ROOT_OF_SIX) / 1800, (88 + 7 * _ROOT_OF_SIX) / 360, (-2 - 3 * _ROOT_OF_SIX) / 225],
            [(16 - _ROOT_OF_SIX) / 36, (16 + _ROOT_OF_SIX) / 36, 1 / 9],
        ]
    ),
}

#: Samples in one call.  After a sample that had to be taken by itself the shorter stretch is tried first: hard samples
#: come together, and what follows one inside a stretch is lost.
STRETCHES = (16, 256)


class Compiled:
    """A CasADi function of columns that is called on float arrays without conversion."""

    def __init__(self, function: Any) -> None:
        # CasADi's own annotations of these two do not fit what they return.
        buffer_and_run: Any = function.buffer()
        self._buffer, self._run = buffer_and_run
        self._returned = self._buffer.ret
        self._sizes = [function.numel_in(i) for i in range(function.n_in())]
        self._arguments = [np.zeros(max(size, 1)) for size in self._sizes]
        self._shapes = [function.size_out(i) for i in range(function.n_out())]
        self._results = [np.zeros(max(rows * columns, 1)) for rows, columns in self._shapes]
        for i, argument in enumerate(self._arguments):
            self._buffer.set_arg(i, memoryview(argument.data))
        for i, result in enumerate(self._results):
            self._buffer.set_res(i, memoryview(result.data))
        self._given = [argument[:size] for argument, size in zip(self._arguments, self._sizes, strict=True)]
        self._found = [
            result[: rows * columns].reshape((rows, columns), order="F")
            for result, (rows, columns) in zip(self._results, self._shapes, strict=True)
        ]

    def __call__(self, *values: FloatArray) -> tuple[FloatArray, ...]:
        """Return fresh arrays, NaN or infinite where there is no value."""
        for argument, value in zip(self._given, values, strict=True):
            argument[:] = value
        self._run()
        if self._returned():
            # A factorisation inside met a singular matrix; what is in the buffers belongs to another call.
            return tuple(np.full(shape, np.nan) for shape in self._shapes)
        return tuple([found.copy("F") for found in self._found])


class DAEFunctions:
    """What an observer or a simulation needs of a model, compiled, for an implicit method."""

    def __init__(self, model: DAEModel, method: str = "backward-euler") -> None:
        chosen(method, "method", tuple(BUTCHER))
        self.model, self.method, self.stages = model, method, len(BUTCHER[method])
        if (method,) not in model.graphs:
            model.graphs[(method,)] = _graphs(model, method)
        self.residual_function, self.derivative_function, self.output_function = model.graphs[(method,)]
        # Buffers belong to one user each, functions to all.
        self.residual, self._outputs = Compiled(self.residual_function), Compiled(self.output_function)

    def outputs(self, x: FloatArray, theta: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return ``y (ny,)``, ``H = dh/dx (ny, nx)`` and ``L = dh/dtheta (ny, nq)`` at ``x (nx,)``, ``theta (nq,)``."""
        y, H, L = self._outputs(x, theta)
        return y[:, 0], H, L


def _graphs(model: DAEModel, method: str) -> tuple[Any, Any, Any]:
    symbols = symbols_of(model)
    stages = ca.SX.sym("X", model.nx, len(BUTCHER[method]))
    start, dt = ca.SX.sym("start", model.nx), ca.SX.sym("dt")
    weights = np.asarray(np.linalg.inv(BUTCHER[method]), dtype=np.float64)
    residual, X = _stage_equations(symbols, stages, start, dt, weights), ca.vec(stages)
    inputs = [X, start, symbols.u, symbols.theta, dt]
    jacobians = [ca.jacobian(residual, X), ca.jacobian(residual, start), ca.jacobian(residual, symbols.theta)]
    outputs = [symbols.outputs, ca.jacobian(symbols.outputs, symbols.x), ca.jacobian(symbols.outputs, symbols.theta)]
    return (
        _dense("residual", inputs, [residual, jacobians[0]]),
        _dense("derivatives", inputs, jacobians),
        _dense("outputs", [symbols.x, symbols.theta], outputs),
    )


def _dense(name: str, inputs: list[Any], outputs: list[Any]) -> Any:
    return ca.Function(name, inputs, [ca.densify(output) for output in outputs])


def _stage_equations(symbols: DAESymbols, stages: Any, start: Any, dt: Any, weights: FloatArray) -> Any:
    """Return the equations of all stages: derivatives of stored quantities are combinations of their differences."""

    def stored_at(x: Any) -> Any:
        return ca.substitute(symbols.stored, symbols.x, x)

    count = len(weights)
    gained = [stored_at(stages[:, i]) - stored_at(start) for i in range(count)]
    rows = []
    for i in range(count):
        rates = sum((weights[i, j] * gained[j] for j in range(1, count)), weights[i, 0] * gained[0]) / dt
        rows.append(
            ca.substitute(symbols.equations, ca.vertcat(symbols.x, symbols.rates), ca.vertcat(stages[:, i], rates))
        )
    return ca.vertcat(*rows)


def take_samples(
    samples: int,
    together: Callable[[int, int], int],
    alone: Callable[[int], object],
    note: Callable[[int], object] = bool,
) -> None:
    """Go through the samples after the first in stretches."""
    k, allowed = 1, STRETCHES[-1]
    while k < samples:
        length = next((size for size in reversed(STRETCHES) if size <= min(allowed, samples - k)), 0)
        taken = together(k, length) if length else 0
        k, allowed = k + taken, STRETCHES[-1] if length == 0 or taken == length else STRETCHES[0]
        if taken < max(length, 1):
            alone(k)
            k += 1
        note(k)


@dataclass(frozen=True, eq=False)
class LocalEquations:
    """``G(x', x, u, theta) = F(q_x x', x, u, theta)`` and ``h(x, theta)`` with their Jacobians at a point."""

    value: FloatArray
    E: FloatArray
    by_state: FloatArray
    by_input: FloatArray
    by_parameter: FloatArray
    y: FloatArray
    C: FloatArray
    outputs_by_parameter: FloatArray

    @property
    def is_defined(self) -> bool:
        """Whether every number is finite."""
        return all(np.isfinite(part).all() for part in vars(self).values())


def local_equations(
    model: DAEModel, rates: FloatArray, x: FloatArray, u: FloatArray, theta: FloatArray
) -> LocalEquations:
    """Return the equations at derivatives ``(nx,)``, states ``(nx,)``, inputs ``(nu,)`` and parameters ``(nq,)``."""
    values = [np.array(part.full()) for part in symbolic_equations(model)(rates, x, u, theta)]
    value, E, by_state, by_input, by_parameter, y, C, outputs_by_parameter = values
    return LocalEquations(value[:, 0], E, by_state, by_input, by_parameter, y[:, 0], C, outputs_by_parameter)


def symbolic_equations(model: DAEModel) -> Any:
    """Return CasADi's function from derivatives, states, inputs and parameters to the fields of `LocalEquations`."""
    if ("local",) not in model.graphs:
        model.graphs[("local",)] = _function(model)
    return model.graphs[("local",)]


def _function(model: DAEModel) -> Any:
    s = symbols_of(model)
    rates = ca.SX.sym("rates", model.nx)
    value = ca.substitute(s.equations, s.rates, ca.jacobian(s.stored, s.x) @ rates)
    parts = [value, *(ca.jacobian(value, by) for by in (rates, s.x, s.u, s.theta))]
    parts += [s.outputs, ca.jacobian(s.outputs, s.x), ca.jacobian(s.outputs, s.theta)]
    return ca.Function("local", [rates, s.x, s.u, s.theta], [ca.densify(part) for part in parts])

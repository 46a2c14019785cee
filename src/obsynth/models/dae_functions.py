"""Compiled evaluation of a DAE: the residual of one implicit step and the outputs, with exact derivatives."""

from __future__ import annotations

from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.models.dae import DAEModel
from obsynth.models.dae_symbols import DAESymbols, symbols_of
from obsynth.numerics.arrays import FloatArray

_ROOT = np.sqrt(6.0)
#: Butcher matrices of the implicit methods whose last stage is the result (stiffly accurate).
BUTCHER: dict[str, FloatArray] = {
    "backward-euler": np.array([[1.0]]),
    "radau": np.array([
        [(88 - 7 * _ROOT) / 360, (296 - 169 * _ROOT) / 1800, (-2 + 3 * _ROOT) / 225],
        [(296 + 169 * _ROOT) / 1800, (88 + 7 * _ROOT) / 360, (-2 - 3 * _ROOT) / 225],
        [(16 - _ROOT) / 36, (16 + _ROOT) / 36, 1 / 9],
    ]),
}  # fmt: skip


class Compiled:
    """A CasADi function that is called on float arrays without conversion.

    Parameters
    ----------
    name : str
        For CasADi.
    inputs, outputs : list of casadi.SX
        Columns, and columns or matrices.
    """

    def __init__(self, name: str, inputs: list[Any], outputs: list[Any]) -> None:
        import casadi as ca

        function = ca.Function(name, inputs, [ca.densify(output) for output in outputs])
        # CasADi's own annotations of these two do not fit what they return.
        found: Any = function.buffer()
        self._buffer, self._run = found
        self._arguments = [np.zeros(max(entry.numel(), 1)) for entry in inputs]
        self._sizes = [entry.numel() for entry in inputs]
        self._shapes = [output.shape for output in outputs]
        self._results = [np.zeros(max(output.numel(), 1)) for output in outputs]
        for i, argument in enumerate(self._arguments):
            self._buffer.set_arg(i, memoryview(argument.data))
        for i, result in enumerate(self._results):
            self._buffer.set_res(i, memoryview(result.data))

    def __call__(self, *values: FloatArray) -> tuple[FloatArray, ...]:
        """Return fresh arrays, NaN or infinite where there is no value."""
        for argument, size, value in zip(self._arguments, self._sizes, values, strict=True):
            argument[:size] = value
        self._run()
        return tuple(
            np.array(result[: shape[0] * shape[1]]).reshape(shape, order="F")
            for result, shape in zip(self._results, self._shapes, strict=True)
        )


class DAEFunctions:
    """What an observer or a simulation needs of a model, compiled.

    Parameters
    ----------
    model : DAEModel
        The model.
    method : {"backward-euler", "radau"}, optional
        The implicit method.

    Raises
    ------
    SpecError
        The method is unknown.
    """

    def __init__(self, model: DAEModel, method: str = "backward-euler") -> None:
        import casadi as ca

        if method not in BUTCHER:
            raise SpecError(f"The method of integration is {method!r}: use one of {', '.join(BUTCHER)}.", path="method")
        self.model, self.method, self.stages = model, method, len(BUTCHER[method])
        symbols = symbols_of(model)
        stages, start, dt = ca.SX.sym("X", model.nx, self.stages), ca.SX.sym("start", model.nx), ca.SX.sym("dt")
        residual = _stage_equations(
            symbols, stages, start, dt, np.asarray(np.linalg.inv(BUTCHER[method]), dtype=np.float64)
        )
        X = ca.vec(stages)
        inputs = [X, start, symbols.u, symbols.theta, dt]
        jacobians = [ca.jacobian(residual, X), ca.jacobian(residual, start), ca.jacobian(residual, symbols.theta)]
        self.residual = Compiled("residual", inputs, [residual, jacobians[0]])
        self.derivatives = Compiled("derivatives", inputs, [residual, *jacobians])
        seen = [symbols.outputs, ca.jacobian(symbols.outputs, symbols.x),
                ca.jacobian(symbols.outputs, symbols.theta)]  # fmt: skip
        self._outputs = Compiled("outputs", [symbols.x, symbols.theta], seen)

    def outputs(self, x: FloatArray, theta: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return ``y (ny,)``, ``H = dh/dx (ny, nx)`` and ``L = dh/dtheta (ny, nq)``.

        Parameters
        ----------
        x, theta : FloatArray
            ``(nx,)`` and ``(nq,)``.
        """
        y, H, L = self._outputs(x, theta)
        return y[:, 0], H, L


def _stage_equations(symbols: DAESymbols, stages: Any, start: Any, dt: Any, weights: FloatArray) -> Any:
    """Return the equations of all stages: derivatives of stored quantities are combinations of their differences."""
    import casadi as ca

    def stored_at(x: Any) -> Any:
        return ca.substitute(symbols.stored, symbols.x, x)

    count = len(weights)
    gained = [stored_at(stages[:, i]) - stored_at(start) for i in range(count)]
    rows = []
    for i in range(count):
        rates = sum((weights[i, j] * gained[j] for j in range(1, count)), weights[i, 0] * gained[0]) / dt
        rows.append(ca.substitute(symbols.equations, ca.vertcat(symbols.x, symbols.rates),
                                  ca.vertcat(stages[:, i], rates)))  # fmt: skip
    return ca.vertcat(*rows)

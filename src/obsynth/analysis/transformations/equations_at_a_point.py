"""A nonlinear plant and its exact derivatives at one point, with derivatives of the states in place of those stored."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.plants.dae.model import DAEModel
from obsynth.plants.dae.symbols import symbols_of


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
    found = [np.array(part.full()) for part in symbolic_equations(model)(rates, x, u, theta)]
    value, E, by_state, by_input, by_parameter, y, C, outputs_by_parameter = found
    return LocalEquations(value[:, 0], E, by_state, by_input, by_parameter, y[:, 0], C, outputs_by_parameter)


def symbolic_equations(model: DAEModel) -> Any:
    """Return CasADi's function from derivatives, states, inputs and parameters to the fields of `LocalEquations`."""
    if ("local",) not in model.graphs:
        model.graphs[("local",)] = _function(model)
    return model.graphs[("local",)]


def _function(model: DAEModel) -> Any:
    import casadi as ca

    s = symbols_of(model)
    rates = ca.SX.sym("rates", model.nx)
    value = ca.substitute(s.equations, s.rates, ca.jacobian(s.stored, s.x) @ rates)
    parts = [value, *(ca.jacobian(value, by) for by in (rates, s.x, s.u, s.theta))]
    parts += [s.outputs, ca.jacobian(s.outputs, s.x), ca.jacobian(s.outputs, s.theta)]
    return ca.Function("local", [rates, s.x, s.u, s.theta], [ca.densify(part) for part in parts])

"""Which integration a nonlinear plant needs: backward Euler damps what turns within a step."""

from __future__ import annotations

import numpy as np

from obsynth.analysis.transformations.equations_at_a_point import local_equations
from obsynth.plants.dae.model import DAEModel

#: Radians that a mode may turn in one step of backward Euler: its amplitude then falls by an eighth of a per cent.
LARGEST_TURN = 0.05
#: Eigenvalues above this, per second times dt, are those at infinity, up to rounding.
INFINITE = 1e8


def largest_turn(model: DAEModel, dt: float) -> float:
    """Return by how many radians the fastest oscillation at the nominal point turns in a step."""
    from scipy.linalg import eigvals

    local = local_equations(model, np.zeros(model.nx), model.nominal_state, model.nominal_input,
                            model.nominal_parameters)  # fmt: skip
    if not local.is_defined:
        return 0.0
    homogeneous = eigvals(-local.by_state * model.state_scales, local.E * model.state_scales, homogeneous_eigvals=True)
    above, below = homogeneous
    finite = np.abs(below) * INFINITE > np.abs(above) * dt
    turns = np.abs((above[finite] / below[finite]).imag) * dt
    return float(turns.max(initial=0.0))


def chosen_integration(model: DAEModel, dt: float) -> str:
    """Return Radau where a mode turns too far in a step, and backward Euler elsewhere."""
    return "radau" if largest_turn(model, dt) > LARGEST_TURN else "backward-euler"

"""An observer of a DAE from a model and plain options: used to design one, and to check the one that was shipped.

Which integration a nonlinear plant needs: backward Euler damps what turns within a step.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics.arguments import is_number, real_number
from obsynth.numerics.arrays import FloatArray, as_matrix, read_only
from obsynth.observers.dae.observer import DAEObserver
from obsynth.plants.dae.checks import finite_vector, step_length
from obsynth.plants.dae.functions import local_equations
from obsynth.plants.dae.model import DAEModel
from obsynth.plants.validation import index_of

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


#: Deviation of an initial state that is not stated, as a share of its nominal size.
DEFAULT_STATE_SHARE = 0.01
#: Deviation of an initial parameter that is not stated, as a share of its nominal value.
DEFAULT_PARAMETER_SHARE = 0.1
OPTIONS = (
    "dt", "Q", "R", "form", "forgetting", "guard", "weight", "integration", "random_walk", "initial_state",
    "initial_covariance", "initial_parameters", "initial_parameter_covariance", "bounds", "largest_move", "window",
    "outliers", "outlier_limit", "sensors", "state_bounds", "reset",
)  # fmt: skip


def dae_observer_from_options(model: DAEModel, options: Mapping[str, Any]) -> DAEObserver:
    """Return the observer that options stand for."""
    states, parameters = model.state_names, model.parameter_names
    bounds = _bounds(options["bounds"], parameters)
    return DAEObserver(
        model=model, dt=options["dt"],
        Q=_covariance(options["Q"], model.equation_names, "Q", None),
        R=_covariance(options["R"], model.output_names, "R", None),
        initial_state=_vector(options["initial_state"], states, model.nominal_state, "initial_state"),
        initial_covariance=_covariance(
            options["initial_covariance"], states, "initial_covariance",
            (DEFAULT_STATE_SHARE * model.state_scales) ** 2,
        ),
        initial_parameters=_vector(
            options["initial_parameters"], parameters, model.nominal_parameters, "initial_parameters"
        ),
        initial_parameter_covariance=_covariance(
            options["initial_parameter_covariance"], parameters, "initial_parameter_covariance",
            _default_parameter_variances(model, options["initial_parameter_covariance"]),
        ),
        random_walk=_covariance(options["random_walk"], parameters, "random_walk", np.zeros(model.nq)),
        lower=bounds[:, 0], upper=bounds[:, 1], form=_form(options), forgetting=options["forgetting"],
        guard=options["guard"], weight=options["weight"], integration=_integration(model, options),
        largest_move=options["largest_move"], window=options["window"],
        outliers=options.get("outliers", "none"), outlier_limit=options.get("outlier_limit"),
        sensors=options.get("sensors"), state_bounds=options.get("state_bounds"),
        reset=options.get("reset", 0.0),
    )  # fmt: skip


def _form(options: Mapping[str, Any]) -> str:
    """Return the form that is asked for; by itself that of parameters that walk where a walk is stated."""
    walks = options["random_walk"] is not None
    return ("random-walk" if walks else "forgetting") if options["form"] == "auto" else str(options["form"])


def _integration(model: DAEModel, options: Mapping[str, Any]) -> str:
    """Return the integration that is asked for, or that the plant needs."""
    wanted: str = options["integration"]
    return chosen_integration(model, step_length(options["dt"])) if wanted == "auto" else wanted


def resolved_options(observer: DAEObserver) -> dict[str, Any]:
    """Return every option as it was resolved, plain data: the observer can be built from them again."""
    bounds = read_only(np.column_stack([observer.lower, observer.upper]))
    return {name: bounds if name == "bounds" else getattr(observer, name) for name in OPTIONS}


def _default_parameter_variances(model: DAEModel, given: Any) -> FloatArray:
    sizes = np.abs(model.nominal_parameters)
    if given is None and not sizes.all():
        name = model.parameter_names[int(np.argmin(sizes))]
        raise SpecError(
            f"initial_parameter_covariance is missing, and the nominal value of {name!r} is zero: say how large it may "
            "be.", path="initial_parameter_covariance",
        )  # fmt: skip
    return np.asarray((DEFAULT_PARAMETER_SHARE * sizes) ** 2)


def _covariance(value: Any, names: Sequence[str], what: str, default: FloatArray | None) -> FloatArray:
    if value is None:
        if default is None:
            raise SpecError(f"{what} is missing: give variances, for example by the names {', '.join(names)}.",
                            path=what)  # fmt: skip
        return np.diag(default)
    if isinstance(value, Mapping):
        variances = np.zeros(len(names))
        for name, variance in value.items():
            variances[index_of(name, names, what=what)] = real_number(variance, f"{what}.{name}")
        return np.diag(variances)
    empty = isinstance(value, (list, tuple, np.ndarray)) and not np.asarray(value, dtype=object).size
    matrix = np.zeros((0, 0)) if empty else as_matrix(value, what)
    return float(matrix[0, 0]) * np.eye(len(names)) if np.ndim(value) == 0 else matrix


def _vector(value: Any, names: Sequence[str], default: FloatArray, what: str) -> FloatArray:
    if value is None:
        return np.array(default)
    if isinstance(value, Mapping):
        vector = np.array(default)
        for name, entry in value.items():
            vector[index_of(name, names, what=what)] = real_number(entry, f"{what}.{name}")
        return vector
    return finite_vector(value, names, default, what)


def _bound(value: Any, path: str) -> float:
    """Return a bound, which may be infinite."""
    if not is_number(value):
        raise SpecError(f"{path} is {value!r}: give a number.", path=path)
    return float(value)


def _bounds(value: Any, names: Sequence[str]) -> FloatArray:
    """Return lower and upper bounds ``(nq, 2)`` from rows or from pairs by name."""
    found = np.tile([-np.inf, np.inf], (len(names), 1))
    if isinstance(value, Mapping):
        for name, pair in value.items():
            if np.shape(pair) != (2,):
                raise SpecError(f"bounds.{name} must be [lower, upper].", path=f"bounds.{name}")
            found[index_of(name, names, what="bounds")] = [_bound(bound, f"bounds.{name}") for bound in pair]
        return found
    if value is None:
        return found
    try:
        rows = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        rows = np.zeros(0)
    if rows.shape != found.shape:
        raise SpecError(f"bounds must be {len(names)} pairs [lower, upper], or pairs by name.", path="bounds")
    return rows

"""The paper's conditions of a finished design, with the values of its certificate."""

from __future__ import annotations

from typing import Any

import numpy as np

from obsynth.analysis.existence.augmented_pencils import shipped_model
from obsynth.analysis.existence.recursive import recursive_conditions
from obsynth.analysis.existence.sharepasand import existence_conditions
from obsynth.conditions.augmented_plant import direct_part
from obsynth.conditions.filasova import filasova_theorem1, filasova_theorem2
from obsynth.conditions.kalman_gain import steady_gain
from obsynth.conditions.problem import Conditions
from obsynth.conditions.share_pasand import augmented_problem
from obsynth.conditions.wang import wang2015
from obsynth.errors import SpecError
from obsynth.numerics.matrix_equations import discrete_lyapunov
from obsynth.observers.recursive.steady_filter import steady_state_filter
from obsynth.results.design import ObserverDesign


def conditions_of(design: ObserverDesign) -> Conditions:
    """Return the conditions of a design's paper, every variable with the value that the certificate gives it."""
    makers = {
        "fault-estimation-filter": _wang,
        "pd-observer": _filasova,
        "ui-pi-observer": _share_pasand,
        "descriptor-kalman": _kalman,
    }
    if design.method not in makers:
        raise SpecError(
            f"Method {design.method!r} is not made of matrix inequalities; those that are: {', '.join(makers)}.",
            path="method",
        )
    return makers[design.method](design)


def _with_values(problem: Conditions, **values: Any) -> Conditions:
    """Give variables their values, symmetric ones exactly so."""
    for name, value in values.items():
        variable, number = problem.variables[name], np.asarray(value, dtype=np.float64)
        variable.value = 0.5 * (number + number.T) if variable.attributes["symmetric"] else number
    return problem


def _shipped_already(design: ObserverDesign) -> Any:
    """Return what makes a design of gains that a design has shipped already: the design itself, under another name."""
    return lambda gains, name: design.replace(name=name)


def _wang(design: ObserverDesign) -> Conditions:
    plant, _ = design.linear
    gains, factor = design.gains, design.certificate.matrices["P_factor"]
    gamma = design.certificate.claims.get("gamma")
    problem = wang2015(plant, gamma=gamma, T=gains["T"], N=gains["N"], W=gains["W"], margin=0.0)
    P = factor.T @ factor
    # L = L0 + P^-1 Y (I - Upsilon W): of all Y, the one that has no part along Upsilon.
    values = {"P": P, "Y": P @ (gains["L"] - problem.data["L0"])}
    return _with_values(problem, **values, **({} if gamma is not None else {"gamma_squared": 0.0}))


def _filasova(design: ObserverDesign) -> Conditions:
    plant, _ = design.linear
    claims, matrices, gains = design.certificate.claims, design.certificate.matrices, design.gains
    theorem = filasova_theorem2 if claims["theorem"] == 2.0 else filasova_theorem1
    decay = claims["decay"]
    problem = theorem(plant, delta=claims["delta"], decay=decay, reading="printed", margin=0.0)
    loop = gains.get("G", np.eye(plant.nf))
    J = np.vstack([gains["J"], loop @ gains["M"]])
    L = np.vstack([gains["L"], loop @ gains["N"]])
    P3 = matrices["P3"]
    return _with_values(problem, P1=matrices["P1"], P3=P3, Y=P3.T @ (J - decay * L), Z=P3.T @ L)


def _share_pasand(design: ObserverDesign) -> Conditions:
    plant, _ = design.linear
    gains, matrices = design.gains, design.certificate.matrices
    U_a, K_a = gains["U_a"], gains["K_a"]
    X = np.asarray(np.linalg.inv(matrices["stability"]))
    model = shipped_model(matrices, plant.nf)
    conditions = existence_conditions(plant, model)
    problem = augmented_problem(
        plant, model, (U_a, gains["D_a"]), X=X, margin=0.0, conditions=conditions, design=_shipped_already(design)
    )
    undisturbed, injection, _ = direct_part(plant)
    injected = np.vstack([injection, np.zeros((model.order, plant.ny))])
    gain = (K_a - U_a @ injected) @ undisturbed.T
    return _with_values(problem, P=np.eye(len(X)), Y=np.linalg.solve(X, gain))


def _kalman(design: ObserverDesign) -> Conditions:
    plant, observer = design.recursive
    if not plant.is_time_invariant:
        raise SpecError("The plant changes with k: its filter has no steady gain.", path="plant")
    process, sensor = observer.Q.at(0), observer.R.at(0)
    conditions = tuple(recursive_conditions(plant, parameters=False))
    steady = steady_state_filter(plant, Q=process, R=sensor)
    problem = steady_gain(plant, process, sensor, margin=0.0, conditions=conditions, design=_shipped_already(design))
    data = problem.data
    S = np.hstack([steady.L - data["L0"], steady.K - data["K0"]]) @ np.hstack([data["N1"], data["N2"]]).T
    X = data["X"]
    P = X.T @ discrete_lyapunov((steady.L @ data["A"]).T, np.eye(len(X))) @ X
    driven = np.linalg.solve(X, np.hstack([steady.L @ data["W"], -steady.K @ data["V"]]))
    return _with_values(problem, P=P, Y=P @ np.linalg.solve(X, S), Z=driven.T @ P @ driven)

"""An observer of a DAE from a model and plain options, with facts from a run at nominal inputs.

Used to design one, and to check the one that was shipped.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from obsynth.analysis.dae_structure import Identifiability, identifiability, index_report
from obsynth.errors import SolverError, SpecError
from obsynth.numerics.arrays import FloatArray, read_only
from obsynth.numerics.lapack import pencil_eigenvalues
from obsynth.observers.nonlinear.estimates import DAERow, GatheredRows
from obsynth.observers.nonlinear.observer import DAEObserver, advanced
from obsynth.observers.records import named_bounds, named_covariance, named_vector
from obsynth.plants.dae import DAEModel
from obsynth.plants.dae_functions import local_equations
from obsynth.plants.dae_signals import step_length

#: Radians that a mode may turn in one step of backward Euler: its amplitude then falls by an eighth of a per cent.
LARGEST_TURN = 0.05

#: Eigenvalues above this, per second times dt, are those at infinity, up to rounding.
INFINITE = 1e8

#: Deviation of an initial state that is not stated, as a share of its nominal size.
DEFAULT_STATE_SHARE = 0.01

#: Deviation of an initial parameter that is not stated, as a share of its nominal value.
DEFAULT_PARAMETER_SHARE = 0.1

#: Options that are fields of the observer as they are given.
AS_GIVEN = (
    "forgetting",
    "guard",
    "weight",
    "largest_move",
    "window",
    "outliers",
    "outlier_limit",
    "outlier_sizes",
    "sensors",
    "state_bounds",
    "reset",
)

OPTIONS = (
    "dt",
    "Q",
    "R",
    "form",
    "integration",
    "random_walk",
    "initial_state",
    "initial_covariance",
    "initial_parameters",
    "initial_parameter_covariance",
    "bounds",
    *AS_GIVEN,
)

#: Steps of the nominal run; where a plant leaves its nominal point for where its equations have no solution, so small a
#: share of the steps to there, and the fewest that say anything.
NOMINAL_STEPS, SHARE_OF_SOLVED, FEWEST_STEPS = 100, 0.5, 2


def largest_turn(model: DAEModel, dt: float) -> float:
    """Return by how many radians the fastest oscillation at the nominal point turns in a step."""
    local = local_equations(
        model, np.zeros(model.nx), model.nominal_state, model.nominal_input, model.nominal_parameters
    )
    if not local.is_defined:
        return 0.0
    above, below = pencil_eigenvalues(-local.by_state * model.state_scales, local.E * model.state_scales)
    finite = np.abs(below) * INFINITE > np.abs(above) * dt
    turns = np.abs((above[finite] / below[finite]).imag) * dt
    return float(turns.max(initial=0.0))


def dae_observer_from_options(model: DAEModel, options: Mapping[str, Any]) -> DAEObserver:
    """Return the observer that options stand for."""
    states, parameters = model.state_names, model.parameter_names
    form, integration = options["form"], options["integration"]
    if form == "auto":
        form = "forgetting" if options["random_walk"] is None or not model.nq else "random-walk"
    if form != "forgetting" and not model.nq:
        raise SpecError(
            f"form is {form!r}, but the plant has no parameters: leave it out, and the observer is the extended Kalman "
            "filter of the states.",
            path="method.options.form",
        )
    if integration == "auto":
        turns_far = largest_turn(model, step_length(options["dt"])) > LARGEST_TURN
        integration = "radau" if turns_far else "backward-euler"
    bounds = named_bounds(options["bounds"], parameters, "bounds")
    return DAEObserver(
        model=model,
        dt=options["dt"],
        Q=named_covariance(options["Q"], model.equation_names, "Q", None),
        R=named_covariance(options["R"], model.output_names, "R", None),
        initial_state=named_vector(options["initial_state"], states, model.nominal_state, "initial_state"),
        initial_covariance=named_covariance(
            options["initial_covariance"],
            states,
            "initial_covariance",
            (DEFAULT_STATE_SHARE * model.state_scales) ** 2,
        ),
        initial_parameters=named_vector(
            options["initial_parameters"], parameters, model.nominal_parameters, "initial_parameters"
        ),
        initial_parameter_covariance=named_covariance(
            options["initial_parameter_covariance"],
            parameters,
            "initial_parameter_covariance",
            _default_parameter_variances(model, options["initial_parameter_covariance"]),
        ),
        random_walk=named_covariance(options["random_walk"], parameters, "random_walk", np.zeros(model.nq)),
        lower=bounds[:, 0],
        upper=bounds[:, 1],
        form=form,
        integration=integration,
        **{
            name: options[name]
            for name in AS_GIVEN
            if name in options and not (name == "outliers" and options[name] is None)
        },
    )


def resolved_options(observer: DAEObserver) -> dict[str, Any]:
    """Return every option as it was resolved, plain data: the observer can be built from them again."""
    bounds = read_only(np.column_stack([observer.lower, observer.upper]))
    return {name: bounds if name == "bounds" else getattr(observer, name) for name in OPTIONS}


def _default_parameter_variances(model: DAEModel, stated: Any) -> FloatArray:
    sizes = np.abs(model.nominal_parameters)
    if stated is None and not sizes.all():
        name = model.parameter_names[int(np.argmin(sizes))]
        raise SpecError(
            f"initial_parameter_covariance is missing, and the nominal value of {name!r} is zero: state how large it "
            "may be.",
            path="initial_parameter_covariance",
        )
    return np.asarray((DEFAULT_PARAMETER_SHARE * sizes) ** 2)


@dataclass(frozen=True, eq=False)
class DAEFacts:
    """Facts of a nominal run."""

    index: int  # at the nominal point, 0 where (7) is always singular
    condition: float  # largest condition number of (7) along the run
    condition_k: int  # the sample at which it is largest
    residual: float  # largest scaled Newton residual
    contraction: float  # spectral radius of the last of the transitions
    deviations: FloatArray  # ``(nq,)``: standard deviations of the parameters at the end
    # ``(nq, nq)``: of the parameters' errors at the end: how much a change of one is taken for another
    correlations: FloatArray
    projection: FloatArray  # ``(nx,)``: how far the initial state is moved onto its constraint
    identifiable: Identifiability  # of states and parameters along the nominal trajectory
    K: FloatArray  # ``(nx, ny)`` at the end
    Upsilon: FloatArray  # ``(nx, nq)`` at the end
    transitions: FloatArray  # ``(steps, nx, nx)``: F (I - K H) of every step, K the gain where parameters are known
    parameter_covariance: FloatArray  # ``(nq, nq)`` at the end

    @property
    def steps(self) -> int:
        """Steps of the run."""
        return len(self.transitions)

    @property
    def decay_time(self) -> float:
        """Steps in which an error of the state filter falls to 1/e; infinite where it does not."""
        if not 0.0 < self.contraction < 1.0:
            return 0.0 if self.contraction == 0.0 else float("inf")
        return float(-1.0 / np.log(self.contraction))


def dae_facts(observer: DAEObserver) -> DAEFacts:
    """Run an observer on its own model at nominal inputs and parameters."""
    model = observer.model
    u = np.array(model.nominal_input)
    outputs = _nominal_outputs(observer, u)
    gathered, parts = GatheredRows(observer), []

    def add(rows: DAERow) -> None:
        gathered.add(rows)
        parts.append({name: np.array(rows.several.part(name)) for name in ("kept", "F", "H", "noise")})

    end = advanced(observer.steps, outputs, np.tile(u, (len(outputs), 1)), add)
    estimates = gathered.estimates()
    transitions = _transitions(observer, {name: np.concatenate([each[name] for each in parts]) for name in parts[0]})
    covariance = estimates.parameter_covariances[-1]
    deviations = np.sqrt(np.diag(covariance))
    safe = np.where(deviations > 0.0, deviations, 1.0)
    identifiable = identifiability(
        model,
        np.tile(u, (len(outputs), 1)),
        dt=observer.dt,
        R=observer.R,
        method=observer.integration,
        initial_state=observer.initial_state,
        parameters=observer.initial_parameters,
        parameter_scales=np.sqrt(np.diag(observer.initial_parameter_covariance)),
    )
    return DAEFacts(
        index=index_report(model, observer.dt, x=estimates.states[-1], u=u, theta=estimates.parameters[-1]).index,
        condition=float(estimates.conditions.max()),
        condition_k=int(np.argmax(estimates.conditions)),
        residual=float(estimates.residuals.max()),
        contraction=float(np.abs(np.linalg.eigvals(transitions[-1])).max()),
        deviations=read_only(deviations),
        correlations=read_only(covariance / np.outer(safe, safe)),
        projection=estimates.projection,
        identifiable=identifiable,
        K=read_only(observer.steps.part(end, "K")),
        Upsilon=read_only(observer.steps.part(end, "Upsilon")),
        transitions=read_only(transitions),
        parameter_covariance=read_only(covariance),
    )


def _transitions(observer: DAEObserver, rows: dict[str, FloatArray]) -> FloatArray:
    """Return F (I - K H) ``(steps, nx, nx)`` of every step of a run, K the gain of the state where the parameters are
    known; ``rows``: arrays by name, a row for each sample.

    In the form ``augmented-kalman`` the state's rows of the joint gain also make up for what it moves the parameters
    by, and I - K H of these alone is the map of no error.
    """
    if observer.form != "augmented-kalman":
        return rows["kept"][1:]
    P, identity = np.array(observer.initial_covariance), np.eye(observer.model.nx)
    transitions, error_map = [], identity
    for k, (F, H, noise) in enumerate(zip(rows["F"], rows["H"], rows["noise"], strict=True)):
        if k > 0:
            P = F @ P @ F.T + noise @ observer.Q @ noise.T
            transitions.append(F @ error_map)
        K = np.linalg.solve(H @ P @ H.T + observer.R, H @ P).T
        error_map = identity - K @ H
        P = error_map @ P @ error_map.T + K @ observer.R @ K.T
    return np.array(transitions)


def _nominal_outputs(observer: DAEObserver, u: FloatArray) -> FloatArray:
    """Return the outputs of the model from the observer's initial state, without noise.

    Inputs that a controller moves are constant here: an unstable plant, or a tank whose flows are not in balance, goes
    to where its equations have no solution, and what is near to that is no nominal run.
    """
    step, outputs = observer.steps.implicit, list[FloatArray]()
    x, theta = np.array(observer.initial_state), np.array(observer.initial_parameters)
    for k in range(NOMINAL_STEPS + 1):
        try:
            x = step.solve(x, u, theta, k=k).x
        except SolverError:
            steps = int(SHARE_OF_SOLVED * len(outputs))
            if steps <= FEWEST_STEPS:  # the first is none
                raise
            return np.array(outputs[:steps])
        outputs.append(step.functions.outputs(x, theta)[0])
    return np.array(outputs)

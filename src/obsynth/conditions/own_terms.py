"""Designs whose inequality holds something of one's own: constraints, an objective, a region for the eigenvalues.

The methods leave these to the problem as it stands in the paper: solved as it is here, gains taken from it, and the
realisation and certificate of these gains made as for any others.  `verify` knows nothing of how they were found.

The paper's conditions of a finished design, with the matrices of its certificate put in.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from obsynth.analysis.conditions import require_all
from obsynth.conditions import atoms
from obsynth.conditions.filasova import filasova_theorem1, filasova_theorem2
from obsynth.conditions.kalman_gain import steady_gain
from obsynth.conditions.problem import Conditions, named_constraints
from obsynth.conditions.share_pasand import augmented_problem, sharepasand
from obsynth.conditions.wang import error_norm, h2_terms, noise_paths, wang2015
from obsynth.errors import PreconditionError, SolverError, SpecError
from obsynth.methods.conic import lazy_cvxpy as cp
from obsynth.methods.conic.lmi import SOLVER_SETTINGS, USABLE_STATUSES, semidefinite_solvers
from obsynth.methods.fault_estimation_filter.conditions import fault_filter_conditions, with_sensor_faults_as_states
from obsynth.methods.fault_estimation_filter.method import FaultEstimationFilter
from obsynth.methods.fault_estimation_filter.realisation import synthesis_from_gains as filter_from_gains
from obsynth.methods.method import Synthesis
from obsynth.methods.pd_observer.conditions import explicit_form, pd_observer_conditions
from obsynth.methods.pd_observer.inequalities import default_delta
from obsynth.methods.pd_observer.method import PdObserver
from obsynth.methods.pd_observer.realisation import synthesis_from_gains as pd_from_gains
from obsynth.methods.recursive.conditions import recursive_conditions
from obsynth.methods.recursive.synthesis import steady_state_filter
from obsynth.methods.refusals import require_all_told
from obsynth.methods.ui_pi_observer.augmented_plant import direct_part, shipped_model
from obsynth.methods.ui_pi_observer.conditions import existence, existence_conditions
from obsynth.methods.ui_pi_observer.method import UiPiObserver
from obsynth.methods.ui_pi_observer.placement_problem import synthesis_from_gains as ui_pi_from_gains
from obsynth.numerics.arguments import FloatArray
from obsynth.numerics.matrix_equations import discrete_lyapunov
from obsynth.numerics.regions import LMIRegion, checked_region, disk, half_plane, sector
from obsynth.observers.linear.observer import LinearObserver, averaged
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.fault_models import exosystem
from obsynth.results.design import Certificate, ObserverDesign

#: What is tried by default: an interior-point method, and one of first order that says infeasible where that stalls.
AUTOMATIC = ("CLARABEL", "SCS")
#: What a claimed gain keeps to the true norm, so that the claim has a proof with room for rounding.
CLAIM_ROOM = 1e-3
#: Multiples of a rate among which one inside a region is looked for.
RATE_MULTIPLES = np.logspace(-4, 4, 161)
#: Eigenvalues may be outside a region by this much, by a solver's rounding.
REGION_TOLERANCE = 1e-6


def filter_by_inequality(
    plant: DescriptorSystem, asked: FaultEstimationFilter, *, progress: Callable[[str], None]
) -> Synthesis:
    """Return a fault-estimation filter by (45) with what was asked for in it; see `obsynth.fault_estimation_filter`."""
    progress("checking the existence conditions")
    require_all(fault_filter_conditions(plant))
    free = bool(asked.free_residual_weight)
    found = wang2015(plant, S=asked.S, W="free" if free else None, gamma=None)
    squared, P, Y = found.variables["gamma_squared"], found.variables["P"], found.variables["Y"]
    parts = [] if asked.region is None else [checked_region(asked.region)]
    if asked.decay is not None:
        parts.append(disk(0.0, float(np.exp(-asked.decay * plant.dt))))
    where = None if not parts else parts[0] if len(parts) == 1 else parts[0] & parts[1]
    added: dict[str, Any] = {}
    if where is not None:
        if not where.contains([0.0]):
            raise PreconditionError(
                f"No filter has all its eigenvalues in {where}: (32) puts those of the fault directions at 0. Give a "
                "region with 0 in it.",
                condition="region",
                mode=0j,
            )
        added["region"] = atoms.region(found.data["A1"], P, where, Y=Y, Cy=found.data["C1"])[1]
    if asked.gamma is not None:
        added["gamma"] = squared <= asked.gamma**2
    goal: Any = None
    drop: tuple[str, ...] = ()
    if asked.objective == "h2":
        # From unit white disturbances and noise to the fault errors.
        work = with_sensor_faults_as_states(plant)
        b, d = np.hstack([work.Bd, work.Bw]), np.hstack([work.Dd, work.Dw])
        added["H2 stable"], added["H2"], Z = h2_terms(plant, found, *noise_paths(plant, found, b, d))
        goal, found = cp.trace(Z), replace(found, variables={**found.variables, "Z": Z})
        drop = ("(45)",) if asked.gamma is None else ()
    elif asked.objective is not None:
        goal = asked.objective(found.variables)
    found = found.changed(constraints=_with_own(asked, found, added), objective=goal, drop=drop)
    progress("solving the matrix inequality")
    runs = [_solved(found, asked)]
    if goal is None and plant.nd:
        # The bare optimum is badly conditioned: a little more gain buys small matrices.
        least = float(np.sqrt(max(squared.value, 0.0)))
        level = (1.0 + asked.gamma_margin) * least if asked.gamma is None else asked.gamma
        found = found.changed(constraints={"gamma": squared <= level**2}, objective=cp.trace(P) + cp.norm(Y, "fro"))
        runs.append(_solved(found, asked))
    gains = found.gains()
    work = with_sensor_faults_as_states(plant)
    _require_inside(gains["T"] @ work.A - gains["L"] @ work.C, where)
    gamma = None
    if plant.nd:
        gamma = (1.0 + CLAIM_ROOM) * error_norm(plant, gains)
        gamma = asked.gamma if asked.gamma is not None and asked.gamma > gamma else gamma
    progress("building the realisation and its certificate")
    given: dict[str, Any] = {letter: gains[letter] for letter in "TNLW"}
    made = filter_from_gains(plant, **given, gamma=gamma, indexes=None)
    if asked.mean > 1 and isinstance(made.observer, LinearObserver):
        zeros = np.zeros(((asked.mean - 1) * plant.nf, made.certificate.matrices["tracking"].shape[1]))
        matrices, claims = dict(made.certificate.matrices), made.certificate.claims
        matrices["tracking"] = np.vstack([matrices["tracking"], zeros])
        made = replace(made, observer=averaged(made.observer, asked.mean), certificate=Certificate(matrices, claims))
    return _told(made, asked, found, runs, where, free_residual_weight=free)


def pd_by_inequality(plant: DescriptorSystem, asked: PdObserver, *, progress: Callable[[str], None]) -> Synthesis:
    """Return a PD observer by a theorem with what was asked for in it; see `obsynth.pd_observer`."""
    progress("checking the existence conditions")
    require_all(pd_observer_conditions(plant))
    theorem = filasova_theorem2 if asked.theorem == 2 else filasova_theorem1
    where = None if asked.region is None else checked_region(asked.region)
    decay, form = asked.decay or 0.0, explicit_form(plant)
    delta = asked.delta
    if delta is None:
        delta = _fitting_delta(default_delta(plant if form is None else form.plant, asked, decay), where)
    found = theorem(plant, delta=delta, decay=decay, region=where)
    goal = None if asked.objective is None else asked.objective(found.variables)
    found = found.changed(constraints=_with_own(asked, found, {}), objective=goal)
    progress("solving the matrix inequality")
    runs = [_solved(found, asked)]
    gains = found.gains()
    A_o, C_o = found.data["A_o"], found.data["C_o"]
    J, L = np.vstack([gains["J"], gains["M"]]), np.vstack([gains["L"], gains["N"]])
    _require_inside(np.asarray(np.linalg.solve(np.eye(len(A_o)) + L @ C_o, A_o - J @ C_o)), where)
    progress("building the realisation and its certificate")
    made = pd_from_gains(plant, gains=gains, adaptation_gain=None, decay=decay)
    return _told(made, asked, found, runs, where, delta=delta, decay=decay)


def ui_pi_by_inequality(plant: DescriptorSystem, asked: UiPiObserver, *, progress: Callable[[str], None]) -> Synthesis:
    """Return a UI-PI observer by its inequality with what was asked for in it; see `obsynth.ui_pi_observer`."""
    progress("checking the existence conditions")
    model = exosystem(asked.fault_model, plant.fault_names, plant.dt)
    known = existence(plant, model)
    require_all_told(known.conditions)
    where = _region_of_poles(asked, plant.dt)
    found = sharepasand(
        plant, fault_model=asked.fault_model, region=where, E_sharp=asked.E_sharp, C_sharp=asked.C_sharp, G=asked.G
    )
    goal = asked.objective(found.variables) if callable(asked.objective) else None
    found = found.changed(constraints=_with_own(asked, found, {}), objective=goal)
    progress("solving the matrix inequality")
    runs = [_solved(found, asked)]
    gains = found.gains()
    _require_inside(gains["Ahat"], where)
    progress("building the realisation and its certificate")
    given = {letter: gains[letter] for letter in "UDKF"}
    made = ui_pi_from_gains(known.plant, **given, fault_model=asked.fault_model)
    told = _told(made, asked, found, runs, where, **asked.resolved(model, plant.fault_names))
    return replace(told, transformation=known.transformation)


def _fitting_delta(delta: float, where: LMIRegion | None) -> float:
    """Return the delta nearest to a given one with ``-1 / delta`` well inside a region."""
    if where is None or where.contains([-1.0 / delta]):
        return delta
    rates = RATE_MULTIPLES * (1.0 / delta)
    margins = where.margins(-rates) / rates
    inside = rates[margins > 0.5 * np.max(margins)]
    return float(1.0 / inside[np.argmin(np.abs(np.log(inside * delta)))]) if len(inside) else delta


def _with_own(asked: Any, found: Conditions, added: Mapping[str, Any]) -> dict[str, Any]:
    """Return constraints to add, those of the user among them."""
    own = {} if asked.constraints is None else named_constraints(asked.constraints(found.variables))
    return {**added, **own}


def _region_of_poles(asked: UiPiObserver, dt: float) -> LMIRegion | None:
    """Return the region of an observer's poles, by name too: decay, radius, damping."""
    given = dict(asked.region) if isinstance(asked.region, Mapping) else {}
    if asked.region is not None and not given:
        return checked_region(asked.region)
    checked = asked.checked_region(dt)
    decay = asked.decay if checked is None else checked.decay
    parts = [] if not decay else [disk(0.0, float(np.exp(-decay * dt))) if dt > 0.0 else half_plane(decay)]
    if checked is not None and checked.radius is not None:
        parts.append(disk(0.0, checked.radius))
    if checked is not None and checked.damping is not None:
        parts.append(sector(checked.damping))
    whole = None
    for part in parts:
        whole = part if whole is None else whole & part
    return whole


def _require_inside(closed: FloatArray, where: LMIRegion | None) -> None:
    """Raise where the eigenvalues that a solver's gains have are outside the region that was asked for."""
    if where is None:
        return
    worst = float(np.min(where.margins(np.linalg.eigvals(closed)), initial=np.inf))
    if worst < -REGION_TOLERANCE:
        raise SolverError(
            f"The solver ended with eigenvalues outside {where}, by {-worst:.3g}: the result is inconclusive. "
            "Take another solver, or a wider region."
        )


def _solved(found: Conditions, asked: Any) -> dict[str, Any]:
    """Solve a problem by the solver that was asked for, and return the record of the run."""
    names = AUTOMATIC if asked.solver == AUTOMATIC[0] else (asked.solver,)
    for name in (name for name in names if name == names[0] or name in semidefinite_solvers()):
        settings = {**SOLVER_SETTINGS.get(name, {}), **(asked.solver_options or {})}
        failure = None
        record: dict[str, Any] = {"what": found.source, "solver": str(name), "settings": settings}
        try:
            found.solve(name, settings)
            break
        except SolverError as error:
            error.record, failure = {**record, "status": "crashed"}, error
    if failure is not None:
        raise failure
    record |= {"status": str(found.problem.status)}
    if record["status"] not in USABLE_STATUSES:
        raise SolverError(
            f"{name} ended with status {record['status']!r} for {found.source} with "
            f"{', '.join(map(repr, found.constraints))}: with these constraints nothing was found. Relax them, or take "
            "another solver.",
            record=record,
        )
    return record


def _told(
    made: Synthesis, asked: Any, found: Conditions, runs: list[dict[str, Any]], where: LMIRegion | None, **resolved: Any
) -> Synthesis:
    """Return a synthesis from gains as the one that was asked for, with its record."""
    options = {**asked.as_plain(), **resolved, "constraints": list(found.constraints)}
    imposed = f", and every eigenvalue in {where}" if where is not None else ""
    note = f"The inequality was solved as it stands in the paper, with {', '.join(found.constraints)}{imposed}."
    return replace(made, options=options, solver={"engine": "lmi", "runs": runs}, notes=(note, *made.notes))


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


def _put(found: Conditions, **values: Any) -> Conditions:
    """Give variables their values, symmetric ones exactly so."""
    for name, value in values.items():
        variable, number = found.variables[name], np.asarray(value, dtype=np.float64)
        variable.value = 0.5 * (number + number.T) if variable.attributes["symmetric"] else number
    return found


def _kept(design: ObserverDesign) -> Any:
    """The design of gains that are shipped already is that design."""
    return lambda gains, name: design.replace(name=name)


def _wang(design: ObserverDesign) -> Conditions:
    plant, _ = design.linear
    gains, factor = design.gains, design.certificate.matrices["P_factor"]
    gamma = design.certificate.claims.get("gamma")
    found = wang2015(plant, gamma=gamma, T=gains["T"], N=gains["N"], W=gains["W"], margin=0.0)
    P = factor.T @ factor
    # L = L0 + P^-1 Y (I - Upsilon W): of all Y, the one that has no part along Upsilon.
    values = {"P": P, "Y": P @ (gains["L"] - found.data["L0"])}
    return _put(found, **values, **({} if gamma is not None else {"gamma_squared": 0.0}))


def _filasova(design: ObserverDesign) -> Conditions:
    plant, _ = design.linear
    claims, matrices, gains = design.certificate.claims, design.certificate.matrices, design.gains
    theorem = filasova_theorem2 if claims["theorem"] == 2.0 else filasova_theorem1
    decay = claims["decay"]
    found = theorem(plant, delta=claims["delta"], decay=decay, reading="printed", margin=0.0)
    loop = gains.get("G", np.eye(plant.nf))
    J = np.vstack([gains["J"], loop @ gains["M"]])
    L = np.vstack([gains["L"], loop @ gains["N"]])
    P3 = matrices["P3"]
    return _put(found, P1=matrices["P1"], P3=P3, Y=P3.T @ (J - decay * L), Z=P3.T @ L)


def _share_pasand(design: ObserverDesign) -> Conditions:
    plant, _ = design.linear
    gains, matrices = design.gains, design.certificate.matrices
    U_a, K_a = gains["U_a"], gains["K_a"]
    X = np.asarray(np.linalg.inv(matrices["stability"]))
    model = shipped_model(matrices, plant.nf)
    held = existence_conditions(plant, model)
    found = augmented_problem(plant, model, (U_a, gains["D_a"]), X=X, margin=0.0, held=held, design=_kept(design))
    seen, injection, _ = direct_part(plant)
    injected = np.vstack([injection, np.zeros((model.order, plant.ny))])
    gain = (K_a - U_a @ injected) @ seen.T
    return _put(found, P=np.eye(len(X)), Y=np.linalg.solve(X, gain))


def _kalman(design: ObserverDesign) -> Conditions:
    plant, observer = design.recursive
    if not plant.is_time_invariant:
        raise SpecError("The plant changes with k: its filter has no steady gain.", path="plant")
    process, sensor = observer.Q.at(0), observer.R.at(0)
    held = tuple(recursive_conditions(plant, parameters=False))
    steady = steady_state_filter(plant, Q=process, R=sensor)
    found = steady_gain(plant, process, sensor, margin=0.0, held=held, design=_kept(design))
    data = found.data
    S = np.hstack([steady.L - data["L0"], steady.K - data["K0"]]) @ np.hstack([data["N1"], data["N2"]]).T
    X = data["X"]
    P = X.T @ discrete_lyapunov((steady.L @ data["A"]).T, np.eye(len(X))) @ X
    driven = np.linalg.solve(X, np.hstack([steady.L @ data["W"], -steady.K @ data["V"]]))
    return _put(found, P=P, Y=P @ np.linalg.solve(X, S), Z=driven.T @ P @ driven)

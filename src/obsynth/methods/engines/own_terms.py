"""Designs with the user's own constraints, objective, or region of eigenvalues in the inequality.

With such options a method solves the problem of the paper itself.  Its gains get a realisation and a certificate like
any other gains, and `verify` does not depend on the way they were found.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from obsynth.analysis.existence.condition import require_all
from obsynth.analysis.existence.filasova import explicit_form, pd_observer_conditions
from obsynth.analysis.existence.restricted_equivalent import with_sensor_faults_as_states
from obsynth.analysis.existence.sharepasand import existence
from obsynth.analysis.existence.wang2015 import fault_filter_conditions
from obsynth.conditions import atoms, lmi
from obsynth.conditions import lazy_cvxpy as cp
from obsynth.conditions.filasova import filasova_theorem1, filasova_theorem2
from obsynth.conditions.lmi import SOLVER_SETTINGS, USABLE_STATUSES, semidefinite_solvers
from obsynth.conditions.problem import Conditions, named_constraints, of_the_letters
from obsynth.conditions.share_pasand import sharepasand
from obsynth.conditions.wang import error_norm, h2_terms, noise_paths, wang2015
from obsynth.errors import PreconditionError, SolverError
from obsynth.methods.fault_estimation_filter.method import FaultEstimationFilter
from obsynth.methods.fault_estimation_filter.realisation import synthesis_from_gains as filter_from_gains
from obsynth.methods.method import Synthesis
from obsynth.methods.pd_observer.given_gains import synthesis_from_gains as pd_from_gains
from obsynth.methods.pd_observer.limits import default_delta
from obsynth.methods.pd_observer.method import PdObserver
from obsynth.methods.refusals import require_all_conditions
from obsynth.methods.ui_pi_observer.assembly import synthesis_from_gains as ui_pi_from_gains
from obsynth.methods.ui_pi_observer.method import UiPiObserver
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.regions import LMIRegion, checked_region, disk, half_plane, sector
from obsynth.observers.linear.means import averaged
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.faults import exosystem
from obsynth.results.design import Certificate

#: Default solvers: an interior-point method, and a first-order method that can detect infeasibility where it stalls.
AUTOMATIC = ("CLARABEL", "SCS")

#: A claimed gain exceeds the true norm by this share, so that its proof has room for rounding.
CLAIM_ROOM = 1e-3

#: Multiples of a default rate that are tried to find a rate inside a region.
RATE_MULTIPLES = np.logspace(-4, 4, 161)

#: A rate is well inside a region if its margin exceeds this share of the largest margin.
WELL_INSIDE = 0.5

#: Eigenvalues may lie outside a region by this much, because of a solver's tolerances.
REGION_TOLERANCE = 1e-6


def filter_by_inequality(
    plant: DescriptorSystem, method: FaultEstimationFilter, *, progress: Callable[[str], None]
) -> Synthesis:
    """Return a fault-estimation filter from (45) with the user's terms; see `obsynth.fault_estimation_filter`."""
    progress("checking the existence conditions")
    require_all(fault_filter_conditions(plant))
    free = bool(method.asks_for_free_weight)
    problem = wang2015(plant, S=method.S, W="free" if free else method.given_weight, gamma=None)
    squared, P, Y = problem.variables["gamma_squared"], problem.variables["P"], problem.variables["Y"]
    where = _filter_region(method, plant.dt)
    added: dict[str, Any] = {}
    if where is not None:
        added["region"] = atoms.region(problem.data["A1"], P, where, Y=Y, Cy=problem.data["C1"], margin=lmi.MARGIN)[1]
    if method.gamma is not None:
        added["gamma"] = squared <= method.gamma**2
    goal: Any = None
    drop: tuple[str, ...] = ()
    if method.objective == "h2":
        # From unit white disturbances and noise to the fault errors.
        work = with_sensor_faults_as_states(plant)
        b, d = np.hstack([work.Bd, work.Bw]), np.hstack([work.Dd, work.Dw])
        added["H2 stable"], added["H2"], Z = h2_terms(plant, problem, *noise_paths(plant, problem, b, d))
        goal, problem = cp.trace(Z), replace(problem, variables={**problem.variables, "Z": Z})
        drop = ("(45)",) if method.gamma is None else ()
    elif method.objective is not None:
        goal = of_the_letters(method.objective, problem.letters(), "objective")
    own = _own_constraints(method, problem)
    problem = problem.changed(constraints={**added, **own}, objective=goal, drop=drop)
    progress("solving the matrix inequality")
    runs = [_solved(problem, method)]
    if goal is None and plant.nd:
        # The optimum itself is badly conditioned: a slightly larger gain allows much smaller matrices.
        least = float(np.sqrt(max(squared.value, 0.0)))
        level = (1.0 + method.gamma_margin) * least if method.gamma is None else method.gamma
        problem = problem.changed(constraints={"gamma": squared <= level**2}, objective=cp.trace(P) + cp.norm(Y, "fro"))
        runs.append(_solved(problem, method))
    problem.require_satisfied(own)
    gains = problem.gains()
    work = with_sensor_faults_as_states(plant)
    _require_inside(gains["T"] @ work.A - gains["L"] @ work.C, where)
    progress("building the realisation and its certificate")
    made = _realised_filter(plant, method, gains)
    return _recorded(made, method, problem, runs, where, weight=method.taken_weight(free=free))


def _filter_region(method: FaultEstimationFilter, dt: float) -> LMIRegion | None:
    """Return the requested region of the eigenvalues, intersected with that of the decay; ``None`` without either."""
    regions = [] if method.region is None else [checked_region(method.region)]
    if method.decay is not None:
        regions.append(disk(0.0, float(np.exp(-method.decay * dt))))
    where = None if not regions else regions[0] if len(regions) == 1 else regions[0] & regions[1]
    if where is not None and not where.contains([0.0]):
        raise PreconditionError(
            f"No filter has all its eigenvalues in {where}: (32) puts those of the fault directions at 0. Give a "
            "region with 0 in it.",
            condition="region",
            mode=0j,
        )
    return where


def _realised_filter(
    plant: DescriptorSystem, method: FaultEstimationFilter, gains: Mapping[str, FloatArray]
) -> Synthesis:
    """Return the filter with given gains, its claimed gain, and the requested averaging of its estimates."""
    gamma = None
    if plant.nd:
        gamma = (1.0 + CLAIM_ROOM) * error_norm(plant, gains)
        gamma = method.gamma if method.gamma is not None and method.gamma > gamma else gamma
    letters: dict[str, Any] = {letter: gains[letter] for letter in "TNLW"}
    made = filter_from_gains(plant, **letters, gamma=gamma, indexes=None)
    if method.mean > 1 and isinstance(made.observer, LinearObserver):
        zeros = np.zeros(((method.mean - 1) * plant.nf, made.certificate.matrices["tracking"].shape[1]))
        matrices, claims = dict(made.certificate.matrices), made.certificate.claims
        matrices["tracking"] = np.vstack([matrices["tracking"], zeros])
        made = replace(made, observer=averaged(made.observer, method.mean), certificate=Certificate(matrices, claims))
    return made


def pd_by_inequality(plant: DescriptorSystem, method: PdObserver, *, progress: Callable[[str], None]) -> Synthesis:
    """Return a PD observer from Theorem 1 or 2 with the user's terms; see `obsynth.pd_observer`."""
    progress("checking the existence conditions")
    require_all(pd_observer_conditions(plant))
    theorem = filasova_theorem2 if method.theorem == 2 else filasova_theorem1
    where = None if method.region is None else checked_region(method.region)
    decay, form = method.decay or 0.0, explicit_form(plant)
    delta = method.delta
    if delta is None:
        delta = _fitting_delta(default_delta(plant if form is None else form.plant, method, decay), where)
    problem = theorem(plant, delta=delta, decay=decay, region=where)
    goal = None if method.objective is None else of_the_letters(method.objective, problem.letters(), "objective")
    own = _own_constraints(method, problem)
    problem = problem.changed(constraints=own, objective=goal)
    progress("solving the matrix inequality")
    runs = [_solved(problem, method)]
    problem.require_satisfied(own)
    gains = problem.gains()
    A_o, C_o = problem.data["A_o"], problem.data["C_o"]
    J, L = np.vstack([gains["J"], gains["M"]]), np.vstack([gains["L"], gains["N"]])
    _require_inside(np.asarray(np.linalg.solve(np.eye(len(A_o)) + L @ C_o, A_o - J @ C_o)), where)
    progress("building the realisation and its certificate")
    made = pd_from_gains(plant, gains=gains, adaptation_gain=None, decay=decay)
    return _recorded(made, method, problem, runs, where, delta=delta, decay=decay)


def ui_pi_by_inequality(plant: DescriptorSystem, method: UiPiObserver, *, progress: Callable[[str], None]) -> Synthesis:
    """Return a UI-PI observer from its inequality with the user's terms; see `obsynth.ui_pi_observer`."""
    progress("checking the existence conditions")
    model = exosystem(method.fault_model, plant.fault_names, plant.dt)
    known = existence(plant, model)
    require_all_conditions(known.conditions)
    where = _region_of_poles(method, plant.dt)
    problem = sharepasand(
        plant, fault_model=method.fault_model, region=where, E_sharp=method.E_sharp, C_sharp=method.C_sharp, G=method.G
    )
    goal = of_the_letters(method.objective, problem.letters(), "objective") if callable(method.objective) else None
    own = _own_constraints(method, problem)
    problem = problem.changed(constraints=own, objective=goal)
    progress("solving the matrix inequality")
    runs = [_solved(problem, method)]
    problem.require_satisfied(own)
    gains = problem.gains()
    _require_inside(gains["Ahat"], where)
    progress("building the realisation and its certificate")
    letters = {letter: gains[letter] for letter in "UDKF"}
    made = ui_pi_from_gains(known.plant, **letters, fault_model=method.fault_model)
    synthesis = _recorded(made, method, problem, runs, where, **method.resolved(model, plant.fault_names))
    return replace(synthesis, transformation=known.transformation)


def _fitting_delta(delta: float, where: LMIRegion | None) -> float:
    """Return the delta nearest to a given one with ``-1 / delta`` well inside a region."""
    if where is None or where.contains([-1.0 / delta]):
        return delta
    rates = RATE_MULTIPLES * (1.0 / delta)
    margins = where.margins(-rates) / rates
    inside = rates[margins > WELL_INSIDE * np.max(margins)]
    return float(1.0 / inside[np.argmin(np.abs(np.log(inside * delta)))]) if len(inside) else delta


def _own_constraints(method: Any, problem: Conditions) -> dict[str, Any]:
    """Return the user's constraints by name."""
    if method.constraints is None:
        return {}
    return named_constraints(of_the_letters(method.constraints, problem.letters(), "constraints"))


def _region_of_poles(method: UiPiObserver, dt: float) -> LMIRegion | None:
    """Return the requested region of an observer's poles, also from decay, radius and damping."""
    stated = dict(method.region) if isinstance(method.region, Mapping) else {}
    if method.region is not None and not stated:
        return checked_region(method.region)
    checked = method.checked_region(dt)
    decay = method.decay if checked is None else checked.decay
    parts = [] if not decay else [disk(0.0, float(np.exp(-decay * dt))) if dt > 0.0 else half_plane(decay)]
    if checked is not None and checked.radius is not None:
        parts.append(disk(0.0, checked.radius))
    if checked is not None and checked.damping is not None:
        parts.append(sector(checked.damping))
    region = None
    for part in parts:
        region = part if region is None else region & part
    return region


def _require_inside(closed: FloatArray, where: LMIRegion | None) -> None:
    """Raise `SolverError` where the eigenvalues with the solver's gains are outside the requested region."""
    if where is None:
        return
    worst = float(np.min(where.margins(np.linalg.eigvals(closed)), initial=np.inf))
    if worst < -REGION_TOLERANCE:
        raise SolverError(
            f"The solver ended with eigenvalues outside {where}, by {-worst:.3g}: the result is inconclusive. "
            "Take another solver, or a wider region."
        )


def _solved(problem: Conditions, method: Any) -> dict[str, Any]:
    """Solve a problem with the requested solver, or the default ones in turn, and return the record of the run."""
    names = AUTOMATIC if method.solver == AUTOMATIC[0] else (method.solver,)
    for name in (name for name in names if name == names[0] or name in semidefinite_solvers()):
        settings = {**SOLVER_SETTINGS.get(name, {}), **(method.solver_options or {})}
        failure = None
        record: dict[str, Any] = {"what": problem.source, "solver": str(name), "settings": settings}
        try:
            problem.solve(solver=name, settings=settings)
            break
        except SolverError as error:
            error.record, failure = {**record, "status": "crashed"}, error
    if failure is not None:
        raise failure
    record |= {"status": str(problem.problem.status)}
    if record["status"] not in USABLE_STATUSES:
        raise SolverError(
            f"{name} ended with status {record['status']!r} for {problem.source} with "
            f"{', '.join(map(repr, problem.constraints))}: with these constraints nothing was found. Relax them, "
            "or take another solver.",
            record=record,
        )
    return record


def _recorded(
    made: Synthesis,
    method: Any,
    problem: Conditions,
    runs: list[dict[str, Any]],
    where: LMIRegion | None,
    **resolved: Any,
) -> Synthesis:
    """Return a synthesis from gains with the options, the record of the solver, and a note on the user's terms."""
    options = {**method.as_plain(), **resolved, "constraints": list(problem.constraints)}
    imposed = f", and every eigenvalue in {where}" if where is not None else ""
    note = f"The inequality was solved as it stands in the paper, with {', '.join(problem.constraints)}{imposed}."
    return replace(made, options=options, solver={"engine": "lmi", "runs": runs}, notes=(note, *made.notes))

r"""Fault-estimation filter for discrete-time descriptor systems.

Source: Z. Wang, M. Rodrigues, D. Theilliol, Y. Shen, *Fault estimation filter design for discrete-time descriptor
systems*, IET Control Theory and Applications 9 (10), 2015: filter (23), gain structure (60), LMI (45).

Our deviations
    1. (48) has the sign of its second term wrong: L = TA Psi Upsilon^+ + P^-1 Y (I - Upsilon Upsilon^+), see (60).
    2. W = Upsilon^+ of (47), not Psi^+ as the proof says.
    3. Existence is decided before any solver, with the zero condition the paper never states.
    4. Only the part of Y that matters is a variable (Y = y V', V = null Upsilon'), or none at all (eliminated form).
    5. gamma^2 is minimised directly; Algorithm 1 never advances past one step, our bisection ends with a bracket.
    6. A second stage at a slightly larger gamma picks small gains: the bare optimum has condition numbers of 1e7.
    7. Feedthrough of inputs, faults, disturbances and noise, exactly (see `prepared_plant`).
    8. What is shipped corrects the state estimate, which the paper leaves biased by Psi.

The search for the gains of a fault-estimation filter: the least gain, the one to ship, and small gains for it.

The least gain by bisection: the paper's Algorithm 1, made to end.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from obsynth.analysis.conditions import require_all
from obsynth.errors import InfeasibleError, SolverError
from obsynth.extensions import extension
from obsynth.methods.conic.lmi import AUTO, SCHUR, chosen_solver
from obsynth.methods.fault_estimation_filter import inequality_solutions
from obsynth.methods.fault_estimation_filter.central_filter import central_filter_at
from obsynth.methods.fault_estimation_filter.certificate import bounded_real_certificate
from obsynth.methods.fault_estimation_filter.conditions import examine_fault_filter
from obsynth.methods.fault_estimation_filter.gamma_lower_bound import (
    BOUND_MARGIN,
    least_gain_certificate,
    proved_lower_bound,
)
from obsynth.methods.fault_estimation_filter.inequality_search import SMALLEST_USEFUL_GAIN, LeastGain, search_least_gain
from obsynth.methods.fault_estimation_filter.inequality_solutions import null_basis
from obsynth.methods.fault_estimation_filter.injection_problem import GainProblem, Injection, WeightLimit, normalise
from obsynth.methods.fault_estimation_filter.method import FaultEstimationFilter
from obsynth.methods.fault_estimation_filter.prepared_plant import PreparedPlant, prepare
from obsynth.methods.fault_estimation_filter.realisation import notes, realise_filter
from obsynth.methods.fault_estimation_filter.small_gains import small_gain_design
from obsynth.methods.method import Synthesis
from obsynth.numerics.arrays import FloatArray, as_matrix
from obsynth.observers.linear.derived import averaged
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.results.design import Certificate

#: The bracket ends at this share of the width asked for: the filter in hand is at its upper end.
BRACKET_SHARE = 0.1


def search_by_bisection(problem: GainProblem, *, tolerance: float, solver: str, polish: bool = True) -> LeastGain:
    """Minimise the gain by bisection: the paper's Algorithm 1, made to end.

    Every upper end of the bracket is the true norm of a filter in hand, the lower end a level at which none was found.
    """
    problem = replace(problem, judged_exactly=True)
    normalised = normalise(problem, solver=solver)
    gain = normalised.start_gain
    if problem.measured == 0 or gain == 0.0:
        return LeastGain(gain, normalised, normalised.start, gain, (gain, gain))
    work, best = normalised.problem, normalised.contracted(normalised.start)
    high, low, records = work.achieved_gain(best), 0.0, list[dict[str, Any]]()
    while high - low > BRACKET_SHARE * tolerance * high:
        middle = 0.5 * (low + high)
        better = central_filter_at(work, middle)
        if better is None and polish:
            found = inequality_solutions.feasible_point(work, middle, solver=solver)
            better = None if found is None else found.injection
            records += [] if found is None else [found.record]
        if better is None:
            low = middle
        else:
            best, high = better, min(middle, work.achieved_gain(better))
    injection, bracket = normalised.restore(best), (low * normalised.gain, high * normalised.gain)
    return LeastGain(problem.achieved_gain(injection), normalised, injection, gain, bracket, records)


#: Asking for a gain above this multiple of the starting filter's adds nothing but bad scaling.
LARGEST_USEFUL_GAIN = 1e3
#: The gains are designed for a slightly smaller gamma than claimed, so that the claim has a well-conditioned proof.
CERTIFICATE_MARGIN = 5e-3
CERTIFICATE_SHARE = 0.2
#: Gains below this, relative to the disturbance and the output it could reach, are rounding errors.
ROUNDING_GAIN = 1e-11
#: Level of the certificate, relative to the same, when no disturbance reaches the fault estimate at all.
NOMINAL_GAIN = 1e-3
#: A gamma between these multiples of the least gain found by the equations calls the inequality by default, up to so
#: many states: far below the least no polish helps, and far above none is needed.
BELOW_LEAST, ABOVE_LEAST = 0.95, 1.0 + 1e-4
MOST_STATES_TO_POLISH = 64


@dataclass(frozen=True, eq=False)
class FoundGains:
    """The problem in the end, its least gain, the gain that is claimed, and the gains that are shipped."""

    problem: GainProblem
    least: LeastGain
    gamma: float
    chosen: Injection
    records: list[dict[str, Any]]

    def within(self, limit: WeightLimit) -> bool:
        """Whether the weights of both, the least gain and what is shipped, keep a limit."""
        return all(limit.norm(found.V) <= limit.bound for found in (self.least.injection, self.chosen))


def found_gains(
    problem: GainProblem, asked: FaultEstimationFilter, engine: str, *, noisy: bool, progress: Callable[[str], None]
) -> FoundGains:
    """Search the least gain, and small gains for a slightly larger one."""
    size = max(problem.disturbance_size, NOMINAL_GAIN)
    progress("searching the least gain")
    least = _least_gain(problem, asked, engine)
    unfelt = problem.disturbances and least.starting_gain <= ROUNDING_GAIN * problem.disturbance_size
    if unfelt and noisy and problem.weight_limit is None:
        # Against the noise, gains may take up measurements that feel the disturbance: it stays in the problem.
        least = replace(least, starting_gain=NOMINAL_GAIN * size)
    elif unfelt:
        # What is left of the disturbance in the estimates is rounding: nothing to minimise.
        problem = problem.without_disturbance()
        least = replace(_least_gain(problem, asked, engine), gain=least.starting_gain)
    elif engine == "auto" and asked.gamma is not None and _leaves_little(asked.gamma, least.gain, problem):
        progress("polishing the least gain")
        polished = _least_gain(problem, asked, "lmi")
        records = [*least.records, *polished.records]
        least = replace(min(least, polished, key=lambda found: found.gain), records=records)
    gamma = _gain_to_ship(asked, problem, least, noisy=noisy)
    progress("choosing small gains")
    inner = gamma - min(CERTIFICATE_SHARE * (gamma - least.gain), CERTIFICATE_MARGIN * gamma)
    chosen, records = small_gain_design(problem, least, inner, solver=asked.solver, engine=engine)
    return FoundGains(problem, least, gamma, chosen, records)


def found_within(
    problem: GainProblem,
    limited: GainProblem,
    asked: FaultEstimationFilter,
    *,
    noisy: bool,
    progress: Callable[[str], None],
) -> FoundGains:
    """Search gains with a limit on the weight, which Riccati equations do not cover."""
    if asked.engine == "auto" and limited.weight_limit is not None:
        # They do where the limit costs nothing: what is found without it keeps it.
        try:
            free = found_gains(problem, asked, "auto", noisy=noisy, progress=progress)
        except SolverError:
            free = None
        if free is not None and free.within(limited.weight_limit):
            return free
    engine = "lmi" if asked.engine == "auto" else asked.engine
    return found_gains(limited, asked, engine, noisy=noisy, progress=progress)


def _least_gain(problem: GainProblem, asked: FaultEstimationFilter, engine: str) -> LeastGain:
    polish = engine == "lmi"
    if asked.gamma_search == "direct":
        return search_least_gain(problem, solver=asked.solver, polish=polish)
    return search_by_bisection(problem, tolerance=asked.tolerance, solver=asked.solver, polish=polish)


def _leaves_little(gamma: float, least: float, problem: GainProblem) -> bool:
    """Whether a gamma leaves less room above the least gain found than the inequality may still find."""
    near = BELOW_LEAST * least <= gamma <= ABOVE_LEAST * least
    return near and problem.disturbances > 0 and problem.order <= MOST_STATES_TO_POLISH


def _gain_to_ship(asked: FaultEstimationFilter, problem: GainProblem, least: LeastGain, *, noisy: bool) -> float:
    floor = SMALLEST_USEFUL_GAIN * least.starting_gain
    if problem.disturbances == 0:
        return NOMINAL_GAIN
    if asked.gamma is None and noisy:
        # Where noise is stated, the least gain may cost any amount of it (a decoupled disturbance).  The Kalman filter
        # that takes the disturbance as unit white noise is a fair compromise, and its gain is known to be reachable.
        return max((1.0 + asked.gamma_margin) * least.gain, least.starting_gain)
    if asked.gamma is None:
        return max((1.0 + asked.gamma_margin) * least.gain, floor)
    _require_reachable(problem, least, asked.gamma, solver=asked.solver)
    ceiling = LARGEST_USEFUL_GAIN * least.starting_gain
    return min(asked.gamma, ceiling) if ceiling > 0.0 else asked.gamma


def _require_reachable(problem: GainProblem, least: LeastGain, gain: float, *, solver: str) -> None:
    """Raise unless ``gain`` is within reach of the best filter found."""
    best = least.gain
    if problem.disturbances == 0 or best <= gain:
        return
    # Without free measurements there is one filter, and its norm is attained at a frequency.
    bound = best * (1.0 - BOUND_MARGIN)
    if problem.measured:
        bound = proved_lower_bound(problem, solver=solver, best=least.injection, enough=gain)
    choice = "for this T and N" if problem.free_weight else "for this T, N and W"
    if bound > gain:
        remedy = "" if problem.free_weight else ", or set free_residual_weight: true"
        raise InfeasibleError(
            f"No filter reaches gamma = {gain:.6g} {choice}: a checked certificate proves gamma >= {bound:.6g}, and "
            f"the best filter found has {best:.6g}. Ask for a larger gamma, leave it out for the least{remedy}.",
            necessary=False,
            lower_bound=bound,
        )
    raise SolverError(
        f"gamma = {gain:.6g} was not reached (best found {best:.6g}), and the proved lower bound {bound:.6g} does not "
        f"rule it out: the result is inconclusive {choice}. Ask for a slightly larger gamma."
    )


#: Fictitious noise on the measurements, relative to the given one, so that no direction of the gains is free of cost.
BACKGROUND_NOISE = 1e-3
#: Coordinates in which a certificate is looked for before the gain is judged again.
FIRST_TRIES = 4


def synthesise(plant: DescriptorSystem, asked: FaultEstimationFilter, *, progress: Callable[[str], None]) -> Synthesis:
    """Design the filter; see `obsynth.fault_estimation_filter` for the options, results and errors."""
    solver = chosen_solver(asked.solver, asked.solver_options, ours=(AUTO, SCHUR))
    if asked.own_inequality:
        own: Synthesis = extension("filter by its inequality")(plant, asked, progress=progress)
        return own
    asked = replace(asked, solver=solver)
    progress("checking the existence conditions")
    held, prepared = examine_fault_filter(plant)
    require_all(held)
    s = None if asked.S is None else as_matrix(asked.S, "S")
    prepared = prepare(plant, s) if prepared is None or s is not None else prepared
    limit = asked.residual_weight_limit
    free = asked.free_residual_weight if asked.free_residual_weight is not None else plant.nw > 0 or limit is not None
    problem, parts = gain_problem(prepared, free_weight=free)
    # Where nothing disturbs the estimates, a small share of what disturbances could do is proved.
    nominal = NOMINAL_GAIN * max(problem.disturbance_size, NOMINAL_GAIN)
    if s is not None or limit is not None:
        # With the paper's S the weight is its W = Upsilon^+ too, which is that of the outputs as given.
        problem, parts = centred(problem, prepared, parts)
    limited = None if limit is None else with_weight_limit(problem, prepared, parts, limit)
    search = partial(_found, problem, limited, asked, noisy=plant.nw > 0, progress=progress)
    found = search(exactly=False)
    progress("building the realisation and its certificate")
    shipped = _Shipped.of(plant, prepared, parts, found, nominal, tries=FIRST_TRIES)
    if not shipped.proved:
        if not replace(found.problem, judged_exactly=True).reaches(found.chosen, shipped.level):
            found = search(exactly=True)  # a peak was missed
        shipped = _Shipped.of(plant, prepared, parts, found, nominal, tries=None)
    problem, least, records = found.problem, found.least, found.records
    gains, observer, tracking, lag, level, factor = shipped[:6]
    claims = (
        {"gamma": level, "gamma_min": least.gain, "state_lag": float(lag)} if plant.nd else {"state_lag": float(lag)}
    )
    if plant.nd and asked.gamma_search == "bisection":
        claims |= {"gamma_bracket_low": least.bracket[0], "gamma_bracket_high": least.bracket[1]}
    witnesses = {"P_factor": factor, "tracking": tracking}
    if plant.nd:
        progress("proving that no filter does better")
        proof, proved = least_gain_certificate(
            problem,
            prepared.plant,
            gains,
            factor,
            gain=least.gain,
            free_weight=free,
            solver=asked.solver,
            thorough=asked.prove_least,
        )
        witnesses |= proof
        # The search may end below what is proved, by its tolerance: no filter is there.
        claims["gamma_min"] = min(max(least.gain, proved), level)
        if "gamma_bracket_high" in claims:
            claims["gamma_bracket_high"] = max(claims["gamma_bracket_high"], claims["gamma_min"])
    resolved = asked.as_plain() | {"free_residual_weight": free, "S": None if s is None else s.tolist()}
    del resolved["model_error"]  # decided before this
    if asked.mean > 1:
        # Registers hold estimates, which see no state: nothing of the plant is tracked there.
        zeros = np.zeros(((asked.mean - 1) * plant.nf, tracking.shape[1]))
        witnesses["tracking"] = np.vstack([tracking, zeros])
        observer = averaged(observer, asked.mean)
    return Synthesis(
        resolved,
        gains,
        observer,
        Certificate(witnesses, claims),
        {"engine": _engine_of([*least.records, *records]), "runs": [*least.records, *records]},
        (
            *_gamma_notes(asked.gamma, level if plant.nd else np.inf),
            *notes(plant, prepared.detectability, observer, largest_zero=held[-1].value),
        ),
    )


def _found(
    problem: GainProblem,
    limited: GainProblem | None,
    asked: FaultEstimationFilter,
    *,
    exactly: bool,
    noisy: bool,
    progress: Callable[[str], None],
) -> FoundGains:
    problem = replace(problem, judged_exactly=exactly)
    if limited is None:
        return found_gains(problem, asked, asked.engine, noisy=noisy, progress=progress)
    return found_within(problem, replace(limited, judged_exactly=exactly), asked, noisy=noisy, progress=progress)


class _Shipped(NamedTuple):
    """Gains, their realisation, and the certificate of the level that is claimed."""

    gains: dict[str, FloatArray]
    observer: LinearObserver
    tracking: FloatArray
    lag: int
    level: float
    factor: FloatArray
    proved: bool

    @classmethod
    def of(
        cls,
        plant: DescriptorSystem,
        prepared: PreparedPlant,
        parts: _Parts,
        found: FoundGains,
        nominal: float,
        *,
        tries: int | None,
    ) -> _Shipped:
        gains = _gains(prepared, parts, found.chosen)
        observer, tracking, lag = realise_filter(plant, prepared.plant, gains, prepared.detectability)
        level = found.gamma if found.problem.disturbances else nominal
        factor, proved = bounded_real_certificate(
            plant, observer, tracking, level, core=prepared.plant.nx, lag=lag, tries=tries
        )
        return cls(gains, observer, tracking, lag, level, factor, proved)


@dataclass(frozen=True, eq=False)
class _Parts:
    """Fixed parts of the gains in balanced coordinates: L = L0 + R V', W = W0 + Vw V'."""

    L0: FloatArray
    W0: FloatArray
    V: FloatArray


def gain_problem(prepared: PreparedPlant, *, free_weight: bool) -> tuple[GainProblem, _Parts]:
    """Return the convex problem behind Theorem 2, with (32) solved exactly, and the fixed parts of the gains."""
    detectability = prepared.detectability
    upsilon = detectability.Upsilon
    w0, v = _left_inverse(upsilon), null_basis(upsilon.T)
    l0 = prepared.TA @ detectability.Psi @ w0
    measure, na = v.T, prepared.TA.shape[0]
    if prepared.Bw.shape[1]:
        size = BACKGROUND_NOISE * max(
            float(np.linalg.norm(measure @ prepared.Dw)),
            # In units of the outputs: W may be large.
            float(np.linalg.norm(w0 @ prepared.Dw) / np.linalg.norm(w0)),
        )
        background = size if size > 0.0 else BACKGROUND_NOISE
        bn = np.hstack([prepared.Bw - l0 @ prepared.Dw, np.zeros((na, v.shape[1]))])
        dn = np.hstack([measure @ prepared.Dw, -background * np.eye(v.shape[1])])
        zn = np.hstack([w0 @ prepared.Dw, np.zeros((w0.shape[0], v.shape[1]))])
    else:
        # Unit noise on the free measurements: the variance is then the size of R (and V) itself.
        bn, dn, zn = np.zeros((na, v.shape[1])), -np.eye(v.shape[1]), np.zeros((w0.shape[0], v.shape[1]))
    problem = GainProblem(
        A=prepared.TA - l0 @ prepared.C,
        C=measure @ prepared.C,
        Z=w0 @ prepared.C,
        B=prepared.Bd - l0 @ prepared.Dd,
        D=measure @ prepared.Dd,
        Zd=w0 @ prepared.Dd,
        Bn=bn,
        Dn=dn,
        Zn=zn,
        free_weight=free_weight,
    )
    return problem, _Parts(l0, w0, v)


def _left_inverse(upsilon: FloatArray) -> FloatArray:
    """Return the left inverse of least norm of a matrix of full column rank, whatever the units of the faults."""
    units = np.exp2(np.round(np.log2(np.linalg.norm(upsilon, axis=0))))
    return np.asarray(np.linalg.pinv(upsilon / units) / units[:, None])


def _engine_of(records: list[dict[str, Any]]) -> str:
    """Return which engine ran: the inequality comes in only where it may and where there is something to find."""
    return "lmi" if any("settings" in record for record in records) else "riccati"


def _gamma_notes(asked: float | None, shipped: float) -> tuple[str, ...]:
    """Return a note where less is shipped than was asked for."""
    if asked is None or shipped >= asked:
        return ()
    return (
        f"gamma = {asked:.6g} was asked for, and {shipped:.6g} is proved: gains for more would only be scaled worse.",
    )


def _gains(prepared: PreparedPlant, parts: _Parts, chosen: Injection) -> dict[str, FloatArray]:
    """Return the gains in the user's coordinates; the factors are powers of two, so this is exact."""
    states, equations, outputs = (
        prepared.scaling.states[:, None],
        prepared.scaling.equations,
        prepared.scaling.outputs,
    )
    free = chosen.R @ parts.V.T
    return {
        "T": states * prepared.T * equations,
        "N": states * prepared.N * outputs,
        "L": states * (parts.L0 + free) * outputs,
        "W": (parts.W0 + chosen.V @ parts.V.T) * outputs,
        "Psi": states * prepared.detectability.Psi,
        "Upsilon": prepared.detectability.Upsilon / outputs[:, None],
        "R": states * free * outputs,
    }


def centred(problem: GainProblem, prepared: PreparedPlant, parts: _Parts) -> tuple[GainProblem, _Parts]:
    """Return the problem written so that V = 0 is the W of least norm in the user's output units, not balanced ones."""
    outputs = prepared.scaling.outputs
    w0 = _left_inverse(prepared.detectability.Upsilon / outputs[:, None]) / outputs
    v = (w0 - parts.W0) @ parts.V
    moved = replace(problem, Z=problem.Z + v @ problem.C, Zd=problem.Zd + v @ problem.D, Zn=problem.Zn + v @ problem.Dn)
    return moved, replace(parts, W0=w0)


def with_weight_limit(problem: GainProblem, prepared: PreparedPlant, parts: _Parts, bound: float) -> GainProblem:
    """Return the problem with the norm of W bounded, in the user's output units."""
    outputs = prepared.scaling.outputs
    smallest = 1.0 / float(np.linalg.svd(prepared.detectability.Upsilon / outputs[:, None], compute_uv=False)[-1])
    if smallest >= bound:
        raise InfeasibleError(
            f"No residual weight W with W Upsilon = I has a norm of {bound:.6g} or less: the least is {smallest:.6g}. "
            "Raise residual_weight_limit.",
            necessary=True,
            lower_bound=smallest,
        )
    return replace(problem, weight_limit=WeightLimit(parts.W0 * outputs, parts.V.T * outputs, bound))

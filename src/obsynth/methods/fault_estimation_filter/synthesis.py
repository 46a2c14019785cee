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
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from obsynth.analysis.conditions import require_all
from obsynth.errors import InfeasibleError
from obsynth.extensions import extension
from obsynth.methods.conic.lmi import AUTO, SCHUR, chosen_solver
from obsynth.methods.fault_estimation_filter.certificate import bounded_real_certificate
from obsynth.methods.fault_estimation_filter.conditions import examine_fault_filter
from obsynth.methods.fault_estimation_filter.filter_search import NOMINAL_GAIN, FoundGains, found_gains, found_within
from obsynth.methods.fault_estimation_filter.gamma_lower_bound import least_gain_certificate
from obsynth.methods.fault_estimation_filter.inequality_solutions import null_basis
from obsynth.methods.fault_estimation_filter.injection_problem import GainProblem, Injection, WeightLimit
from obsynth.methods.fault_estimation_filter.method import FaultEstimationFilter
from obsynth.methods.fault_estimation_filter.prepared_plant import PreparedPlant, prepare
from obsynth.methods.fault_estimation_filter.realisation import notes, realise_filter
from obsynth.methods.method import Synthesis
from obsynth.numerics.arrays import FloatArray, as_matrix
from obsynth.observers.linear.derived import averaged
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.results.design import Certificate

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
    problem: GainProblem, limited: GainProblem | None, asked: FaultEstimationFilter, *, exactly: bool, noisy: bool,
    progress: Callable[[str], None],
) -> FoundGains:  # fmt: skip
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
        cls, plant: DescriptorSystem, prepared: PreparedPlant, parts: _Parts, found: FoundGains, nominal: float,
        *, tries: int | None,
    ) -> _Shipped:  # fmt: skip
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

"""The fault-estimation filter over the region of a polytopic plant: gains at the vertices, one certificate for all.

Wang 2015, (45), with the vertices of A1 and T D: P and Y of `obsynth.conditions.polytope`, L of (60) at each vertex.
``W = Upsilon^+ + V U2'`` with V a variable beside P and Y, in balanced units, so that neither states nor outputs have
units that matter.  Where the disturbances can be decoupled, gains in closed form do it (`decoupled_gains`): a search
ends some way before a gain of zero, and where depends on the outputs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from obsynth.analysis.existence.condition import require_all
from obsynth.analysis.existence.detectability_indexes import FaultDetectability
from obsynth.analysis.existence.over_region import FilterOverRegion, examine_over_region
from obsynth.analysis.existence.turning_filter import TurningFilter
from obsynth.conditions.lmi import chosen_solver
from obsynth.conditions.wang_over_region import errors_over_region
from obsynth.errors import SolverError, SpecError
from obsynth.methods.engines.region_notes import by_product_notes, certificate_note, unused_rate_notes
from obsynth.methods.engines.vertex_certificates import (
    ROOMS,
    ErrorUnits,
    VertexCertificate,
    certified_for_steps,
    level_without_gains,
    proved_decay,
)
from obsynth.methods.fault_estimation_filter.centred_errors import certified_when_centred
from obsynth.methods.fault_estimation_filter.decoupled_gains import decoupling_of, witness_of_gain
from obsynth.methods.fault_estimation_filter.method import FaultEstimationFilter
from obsynth.methods.fault_estimation_filter.realisation import realise_filter
from obsynth.methods.fault_estimation_filter.turning_faults import synthesise_turning
from obsynth.methods.method import Synthesis
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.ranks import decide_rank
from obsynth.observers.scheduled.observer import ScheduledObserver
from obsynth.plants.polytopic import PolytopicSystem
from obsynth.proofs.vertex_inequalities import prove_gain
from obsynth.results.design import Certificate
from obsynth.verification.error_polytope import ErrorPolytope
from obsynth.verification.over_region import rows_to_forget, stored_witness

#: Gains of decoupled estimates that are proved, as shares of what the disturbances do without gains: the first that
#: rounding allows.
PROVABLE = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1, 1.0)
#: A gain that is all but zero is better than one of zero where its errors are forgotten in fewer rows by this factor.
MUCH_FASTER = 10
#: Options of the filter of a constant plant that the one over a region does not have.
NOT_OVER_REGION = (
    "S", "constraints", "mean", "objective", "prove_least", "region", "residual_weight_limit",
)  # fmt: skip


def synthesise_over_region(
    plant: PolytopicSystem, method: FaultEstimationFilter, *, progress: Callable[[str], None]
) -> Synthesis:
    """Return a scheduled filter with its certificate; see `obsynth.fault_estimation_filter`."""
    _require_options(method)
    progress("checking the existence conditions over the region")
    conditions, parts = examine_over_region(plant)
    require_all(conditions)
    if isinstance(parts, TurningFilter):
        return synthesise_turning(plant, method, parts, progress=progress)
    if parts is None:  # every condition holds, so there are parts
        raise SpecError("The plant has no filter over its region.", path="plant")
    # The paper's W is that of the outputs as they are; a free one is sought in balanced units.
    balanced = parts if method.asks_for_free_weight is False else parts.balanced()
    W = np.asarray(np.linalg.pinv(balanced.Upsilon))
    errors, _, _ = errors_over_region(balanced, W)
    steps = plant.scheduling.usable_step_of(plant.dt)
    progress("solving the inequalities at the vertices")
    certificate = _certified(errors, method, parts, steps)
    decoupled = _decoupled(errors, method, parts)
    progress("building the realisation and its certificate")
    if decoupled is not None and not (certificate.is_negligible and certificate.decay < decoupled.decay**MUCH_FASTER):
        return _synthesis(plant, method, (parts, balanced), W, decoupled, None, decoupled=True)
    return _synthesis(plant, method, (parts, balanced), W, certificate, steps)


def _decoupled(
    errors: ErrorPolytope, method: FaultEstimationFilter, parts: FilterOverRegion
) -> VertexCertificate | None:
    """Return gains with which no disturbance reaches a fault estimate, where they are found."""
    made = decoupling_of(errors, free_output=method.asks_for_free_weight is not False)
    if made is None:
        return None
    try:
        rest = _certified(made.errors, method, parts, None)
    except SolverError:
        return None
    R = [r + z @ made.N.T for r, z in zip(made.R, rest.gains_at_each(errors.count), strict=True)]
    whole, size = errors.with_innovation(made.V), level_without_gains(ErrorUnits.of(errors).moved(1.0))
    levels = [share * size for share in PROVABLE] if method.gamma is None else [method.gamma / parts.reach]
    for level in levels:
        witness = witness_of_gain(whole, R, rest.witness.P[0], level)
        if witness is None:
            return None
        proof = prove_gain(whole.closed(R), witness, level, discrete=True)
        decay = proved_decay(whole, R, witness, required=rest.decay) if proof.proved else np.inf
        if decay <= (1.0 if method.decay is None else float(np.exp(-method.decay * errors.dt))):
            return replace(
                rest, gains=R, witness=witness, level=level, least=0.0, decay=decay, proof=proof, output=made.V
            )
    return None


def synthesis_of_gains(plant: PolytopicSystem, R: Sequence[FloatArray]) -> Synthesis:
    """Return the filter of gains R ``(n, ny - nf)``, one for each vertex, with a certificate that is found for them."""
    conditions, parts = examine_over_region(plant)
    require_all(conditions)
    if not isinstance(parts, FilterOverRegion):
        raise SpecError("The plant has no filter of such gains over its region.", path="plant")
    W = np.asarray(np.linalg.pinv(parts.Upsilon))
    errors, _, _ = errors_over_region(parts, W)
    method = FaultEstimationFilter()
    certificate = _certified(errors, method, parts, None, gains=R, margin=0.0)
    return _synthesis(plant, method, (parts, parts), W, certificate, None)


def _synthesis(
    plant: PolytopicSystem,
    method: FaultEstimationFilter,
    in_units: tuple[FilterOverRegion, FilterOverRegion],
    W: FloatArray,
    certificate: VertexCertificate,
    steps: float | None,
    *,
    decoupled: bool = False,
) -> Synthesis:
    """Return the filter of a certificate; ``in_units``: its parts as they are, and in the units of the certificate."""
    parts, own = in_units
    errors, L0, U2 = errors_over_region(own, W)
    # L0 is that of the pseudoinverse: another W changes R alone.
    weight = W if certificate.output is None else W + certificate.output @ U2.T
    R = certificate.gains_at_each(errors.count)
    states, outputs = (np.ones(1), np.ones(1)) if own is parts else (parts.scaling.states, parts.scaling.outputs)
    L = [states[:, None] * (first + r @ U2.T) * outputs for first, r in zip(L0, R, strict=True)]
    gains: dict[str, FloatArray] = {
        "T": parts.T, "N": parts.N, "W": weight * outputs, "Psi": parts.Psi, "Upsilon": parts.Upsilon
    }  # fmt: skip
    gains |= {f"L[{i + 1}]": matrix for i, matrix in enumerate(L)}
    certificate = replace(certificate, witness=certificate.witness.in_units(states))
    observer, tracking = _realised(plant, parts, gains, L, certificate.decay)
    matrices = {"tracking": tracking, **stored_witness(certificate.witness)}
    claims = {"region_decay": certificate.decay, "state_lag": 0.0}
    if plant.nd:
        claims |= {
            "gamma": certificate.gain_times(parts.reach),
            "gamma_min": certificate.least * parts.reach,
        }
    return Synthesis(
        options=method.as_plain(),
        gains=gains,
        observer=observer,
        certificate=Certificate(matrices, claims),
        solver={"engine": "lmi", "runs": list(certificate.runs)},
        notes=_notes(plant, parts, certificate, steps, decoupled=decoupled),
    )


def _require_options(method: FaultEstimationFilter) -> None:
    plain = FaultEstimationFilter()
    unsupported = [name for name in NOT_OVER_REGION if getattr(method, name) is not getattr(plain, name)]
    unsupported += ["gamma_search"] if method.gamma_search != plain.gamma_search else []
    unsupported += ["engine"] if method.engine == "riccati" else []
    unsupported += ["given weight"] if method.given_weight is not None else []
    if unsupported:
        raise SpecError(
            f"A filter over a region has no {', '.join(unsupported)}: leave it out. It takes gamma, gamma_margin, "
            "decay, weight ('free' or 'paper'), solver and solver_options.",
            path=f"method.options.{unsupported[0].removeprefix('given ')}",
        )
    chosen_solver(method.solver, method.solver_options)


def _certified(
    errors: ErrorPolytope,
    method: FaultEstimationFilter,
    parts: FilterOverRegion,
    steps: float | None,
    *,
    gains: Sequence[FloatArray] | None = None,
    margin: float | None = None,
) -> VertexCertificate:
    """Return the gains R and their certificate; without disturbances every state has one of its own."""
    work, count = errors, errors.inputs
    if not count:
        # A certificate of stability alone: every error is driven, so that gains stay small.
        n = errors.order
        work = ErrorPolytope(
            errors.A, list(errors.C), B=np.eye(n), D=np.zeros((errors.outputs, n)), Cz=np.eye(n), dt=errors.dt
        )
    level = method.gamma / parts.reach if method.gamma is not None and count else None
    options: dict[str, Any] = {
        "level": level,
        "margin": method.gamma_margin if margin is None else margin,
        "decay": None if method.decay is None else float(np.exp(-method.decay * errors.dt)),
        "steps": steps,
        "gains": gains,
        "solver": method.solver,
        "settings": method.solver_options,
    }
    if not count or gains is not None or method.asks_for_free_weight is False or not errors.outputs:
        return certified_for_steps(work, **options)

    def with_free_weight(centred: ErrorPolytope) -> VertexCertificate:
        return certified_for_steps(centred, free_output=True, **options)

    if method.asks_for_free_weight:
        return certified_when_centred(work, with_free_weight)
    try:
        free = certified_when_centred(work, with_free_weight)
    except SolverError:
        return certified_for_steps(work, **options)
    if level is not None or free.is_negligible or free.level <= (1.0 + ROOMS[-1] + options["margin"]) * free.least:
        return free
    # Gains of a least level that is all but zero are too large to be proved near it: those of the paper's weight may
    # have a smaller gain that is.
    try:
        return min(free, certified_for_steps(work, **options), key=lambda certificate: certificate.level)
    except SolverError:
        return free


def _realised(
    plant: PolytopicSystem, parts: FilterOverRegion, gains: dict[str, FloatArray], L: list[FloatArray], decay: float
) -> tuple[ScheduledObserver, FloatArray]:
    """Return the observer and its tracking map: the realisation of the constant filter at each vertex."""
    nf = plant.nf
    once = FaultDetectability((1,) * nf, parts.Psi, parts.Upsilon, decide_rank(parts.Upsilon, expected=nf), 1.0)
    made = []
    for vertex, work, gain in zip(parts.vertices, parts.work, L, strict=True):
        made.append(realise_filter(vertex, work, {**gains, "L": gain}, once))
    first, tracking, _ = made[0]
    each: dict[str, Any] = {
        name: np.array([getattr(observer, name) for observer, _, _ in made]) for name in ("Az", "Bu", "By")
    }
    observer = ScheduledObserver(
        **each,
        Cz=first.Cz,
        Du=first.Du,
        Dy=first.Dy,
        effectiveness=np.array(parts.Delta).reshape(plant.count, nf, nf),
        forgetting=rows_to_forget(decay),
        **ScheduledObserver.names_of(plant),
        fault_names=plant.fault_names,
        residual_names=plant.fault_names,
        state_delays=first.state_delays,
        fault_delays=first.fault_delays,
    )
    return observer, tracking


def _notes(
    plant: PolytopicSystem,
    parts: FilterOverRegion,
    certificate: VertexCertificate,
    steps: float | None,
    *,
    decoupled: bool,
) -> tuple[str, ...]:
    notes = [certificate_note(plant, f"{rows_to_forget(certificate.decay)} rows")]
    if not decoupled:
        notes += unused_rate_notes(plant, steps if certificate.witness.G is not None else None)
    if decoupled:
        notes.append(
            "No disturbance reaches a fault estimate, for every course of the parameters: the gain is zero but for "
            "rounding of the stored numbers. The inequalities prove no gain of zero: that of them is "
            f"{certificate.gain_times(parts.reach):.3g}."
        )
    notes += by_product_notes(replace(certificate, is_negligible=certificate.is_negligible and not decoupled))
    if parts.reach != 1.0:
        notes.append(
            f"The effect of the faults changes with the scheduling: the estimates are divided by it, and gamma is the "
            f"gain of that effect times a proved bound on its inverse, {parts.reach:.6g}."
        )
    return tuple(notes)

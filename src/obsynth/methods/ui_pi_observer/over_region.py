"""The unknown-input PI observer over the region of a polytopic plant: gains at the vertices, proofs for every course.

Gains by the inequalities at the vertices (`obsynth.conditions.sharepasand`), for a small gain from what drives the
fault models, the states and the noise to the errors; then what is claimed of the shipped numbers, each with a Lyapunov
matrix of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from obsynth.analysis.existence.sharepasand_over_region import pi_conditions_over_region
from obsynth.conditions.augmented_plant import measured_combinations, realise
from obsynth.conditions.lmi import chosen_solver
from obsynth.conditions.share_pasand_over_region import PiOverRegion, checked_free_gains, pi_over_region
from obsynth.errors import SolverError, SpecError
from obsynth.methods.engines.rated_certificates import rated_certificate, rated_gains
from obsynth.methods.engines.region_notes import by_product_notes, certificate_note
from obsynth.methods.engines.vertex_certificates import (
    DECAY_MARGINS,
    VertexCertificate,
    analysed,
    best_decay,
    certified,
    proved_decay,
)
from obsynth.methods.method import Synthesis
from obsynth.methods.refusals import require_all_conditions
from obsynth.methods.ui_pi_observer.method import NOISE_AT_REST_ROW, UiPiObserver
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.linear.observer import LinearObserver
from obsynth.observers.scheduled.observer import ScheduledObserver
from obsynth.plants.faults import Exosystem, exosystem
from obsynth.plants.polytopic import PolytopicSystem
from obsynth.proofs.vertex_inequalities import Witness
from obsynth.results.design import Certificate
from obsynth.verification.error_polytope import ErrorPolytope
from obsynth.verification.over_region import GAIN_WITNESSES, WITNESSES, forgetting_of, stored_witness

#: Options of the observer of a constant plant that the one over a region does not have.
NOT_OVER_REGION = ("poles", "region", "joint", "E_sharp", "C_sharp", "G", "constraints")
#: Distance to the least gain, which buys small gains: the bare optimum is badly conditioned.
DESIGN_MARGIN = 0.1
#: The same where gains are given, and nothing but the number is sought.
ANALYSIS_MARGIN = 1e-3


def synthesise_over_region(
    plant: PolytopicSystem, method: UiPiObserver, *, progress: Callable[[str], None]
) -> Synthesis:
    """Return a scheduled observer with its certificates; see `obsynth.ui_pi_observer`."""
    _require_options(method)
    solver = chosen_solver(method.solver, method.solver_options)
    model = exosystem(method.fault_model, plant.fault_names, plant.dt)
    noise = method.checked_noise(plant.output_names)
    progress("checking the existence conditions over the region")
    require_all_conditions(pi_conditions_over_region(plant, model))
    parts = pi_over_region(plant, model, noise=noise)
    steps = _steps(plant)
    progress("solving the inequalities at the vertices")
    options: dict[str, Any] = {"margin": DESIGN_MARGIN, "solver": solver, "settings": method.solver_options}
    decay = _scaled_decay(method.decay, parts, plant.dt)
    rate = None if plant.is_discrete else plant.scheduling.rate_of_weight
    try:
        certificates = [certified(parts.errors, decay=decay, **options)]
    except SolverError:
        if steps is None:
            raise
        certificates = [certified(parts.errors, decay=decay, lyapunov="vertex", steps=steps, **options)]
    if steps is not None and certificates[0].witness.G is None:
        with suppress(SolverError):
            needed = certificates[0].decay
            certificates.append(certified(parts.errors, decay=needed, lyapunov="vertex", steps=steps, **options))
    elif rate is not None:
        certificates += _for_slow_courses(parts, certificates[0], rate, method)
    progress("building the realisation and its certificates")
    made = [_synthesis(plant, model, parts, each, steps, decay=method.decay, rate=rate) for each in certificates]
    return replace(_best(made, plant.is_discrete), options=method.resolved(model, plant.fault_names))


def _best(made: Sequence[Synthesis], discrete: bool) -> Synthesis:
    """Return the last design whose gain is below that of the first, and whose decay is no slower."""
    first, *others = made
    one = first.certificate.claims
    for each in others[::-1]:
        other = each.certificate.claims
        slower = other["region_decay"] - one["region_decay"]
        if other.get("region_gain", 0.0) < one.get("region_gain", 0.0) and (slower if discrete else -slower) <= 0.0:
            return each
    return first


def synthesis_of_gains(plant: PolytopicSystem, K_a: Sequence[FloatArray], fault_model: Any) -> Synthesis:
    """Return the observer of gains ``K_a (na, ny)`` at each vertex, with certificates that are found for them."""
    model = exosystem(fault_model, plant.fault_names, plant.dt)
    require_all_conditions(pi_conditions_over_region(plant, model))
    parts = pi_over_region(plant, model)
    certificate = certified(parts.errors, margin=ANALYSIS_MARGIN, gains=checked_free_gains(parts, list(K_a)))
    method = UiPiObserver(fault_model=fault_model)
    made = _synthesis(plant, model, parts, certificate, None, decay=None)
    return replace(made, options=method.resolved(model, plant.fault_names))


def _require_options(method: UiPiObserver) -> None:
    plain = UiPiObserver()
    unsupported = [name for name in NOT_OVER_REGION if getattr(method, name) is not getattr(plain, name)]
    unsupported += ["objective"] if method.objective != plain.objective else []
    if unsupported:
        raise SpecError(
            f"An observer over a region has no {', '.join(unsupported)}: leave it out. It takes fault_model, decay, "
            "noise, solver and solver_options; for another objective change obsynth.conditions.sharepasand(plant).",
            path=f"method.options.{unsupported[0]}",
        )


def _steps(plant: PolytopicSystem) -> float | None:
    """Return how far the weight may move in a sample, where the certificate is to use it."""
    return plant.scheduling.usable_step_of(plant.dt) if plant.is_discrete else None


def _for_slow_courses(
    parts: PiOverRegion, certificate: VertexCertificate, rate: float, method: UiPiObserver
) -> list[VertexCertificate]:
    """Return gains that are better for a slow parameter in continuous time, where they are, with one P for a decay."""
    errors, scaled = parts.errors, rate * parts.units.time
    decay = certificate.decay
    solver: dict[str, Any] = {"solver": method.solver, "settings": method.solver_options}
    try:
        gains = rated_gains(errors, scaled, decay=decay, **solver)
        slow = rated_certificate(errors, scaled, gains, scale=certificate.level, **solver)
        if slow is None or slow.level >= certificate.level:
            return []
        # A step of implicit Euler shrinks errors in the norm of one P, which these gains need too.
        own = certified(errors, margin=DESIGN_MARGIN, decay=decay, gains=gains, **solver)
    except SolverError:
        return []
    return [replace(own, runs=(*certificate.runs, *slow.runs, *own.runs))]


def _scaled_decay(decay: float | None, parts: PiOverRegion, dt: float) -> float | None:
    """Return a decay in 1/s as a factor a sample, or in scaled time."""
    if not decay:
        return None
    return float(np.exp(-decay * dt)) if dt > 0.0 else decay * parts.units.time


def _synthesis(
    plant: PolytopicSystem,
    model: Exosystem,
    parts: PiOverRegion,
    certificate: VertexCertificate,
    steps: float | None,
    *,
    decay: float | None,
    rate: float | None = None,
) -> Synthesis:
    U_a, D_a, K_a = parts.letters(certificate.gains)
    combinations = measured_combinations(plant.center)
    made = [
        realise(vertex, model, (U_a, D_a, K), combinations)[0] for vertex, K in zip(plant.vertices, K_a, strict=True)
    ]
    shipped = _Shipped.of(made, U_a, plant.nx)
    states = parts.units.augmented_states
    witness = replace(
        certificate.witness,
        P=[_symmetric(P / states / states[:, None]) for P in certificate.witness.P],
        G=None if certificate.witness.G is None else [G / states / states[:, None] for G in certificate.witness.G],
    )
    required_decay = None if not decay else float(np.exp(-decay * plant.dt)) if plant.dt > 0.0 else decay
    required = required_decay or (certificate.decay if plant.dt > 0.0 else certificate.decay / parts.units.time)
    shrinking = proved_decay(shipped.errors, shipped.none, witness, required=required)
    if not plant.is_discrete:
        witness, shrinking = _of_its_own(shipped, parts.units.time, witness, shrinking)
    matrices: dict[str, FloatArray] = {"tracking": U_a, "Phi": model.Phi, "Cw": model.Cw}
    matrices |= stored_witness(witness)
    claims, runs, slow = {"region_decay": shrinking}, list(certificate.runs), None
    if plant.nf:
        gain = analysed(shipped.errors, shipped.none, steps=steps, margin=ANALYSIS_MARGIN)
        if rate is not None:
            slow = rated_certificate(shipped.errors, rate, shipped.none, scale=gain.level)
        used = slow if slow is not None and slow.level < gain.level else gain
        slow = slow if used is slow else None
        matrices |= (
            stored_witness(gain.witness, GAIN_WITNESSES) if slow is None else {GAIN_WITNESSES[0]: np.array(slow.P)}
        )
        claims["region_gain"] = used.level
        runs += used.runs
    used_rate = slow is not None or any(names[1] in matrices for names in (WITNESSES, GAIN_WITNESSES))
    letters = {"U_a": U_a, "D_a": D_a, "Phi": model.Phi, "Cw": model.Cw}
    letters |= {f"K_a[{i + 1}]": K for i, K in enumerate(K_a)}
    return Synthesis(
        {},
        letters,
        _observer(plant, made, shrinking),
        Certificate(matrices, claims),
        {"engine": "lmi", "runs": runs},
        _notes(
            plant,
            shrinking,
            used=used_rate,
            constant=len(certificate.gains) == 1,
        )
        + tuple(by_product_notes(replace(certificate, is_negligible=False))),
    )


def _of_its_own(shipped: _Shipped, time: float, witness: Witness, decay: float) -> tuple[Witness, float]:
    """Return a Lyapunov matrix for the decay alone in continuous time, of the same gains, where it proves a faster one.

    The matrix of the gain proves some decay, which depends on where the solver ends; a little below the fastest one
    that has the largest slack is a number of the gains.
    """
    scaled = replace(shipped.errors, A=[time * A for A in shipped.errors.A])
    # No rate is faster than the slowest mode at a vertex.
    limit = min(-float(np.max(np.linalg.eigvals(A).real)) for A in scaled.A)
    try:
        found, own, _ = best_decay(scaled, gains=shipped.none, limit=limit, margins=DECAY_MARGINS)
    except SolverError:
        return witness, decay
    faster = proved_decay(shipped.errors, shipped.none, own, required=found / time)
    return (own, faster) if faster > decay else (witness, decay)


@dataclass(frozen=True, eq=False)
class _Shipped:
    """The error system of shipped observers, driven by what drives the fault models."""

    errors: ErrorPolytope
    none: list[FloatArray]  # no gains: the errors are closed already

    @classmethod
    def of(cls, made: Sequence[LinearObserver], tracking: FloatArray, nx: int) -> _Shipped:
        n, first = len(made[0].Az), made[0]
        errors = ErrorPolytope(
            [observer.Az for observer in made],
            np.zeros((0, n)),
            B=tracking[:, nx:],
            D=np.zeros((0, n - nx)),
            Cz=first.Cz[first.fault_rows],
            dt=first.dt,
        )
        return cls(errors, [np.zeros((n, 0))])


def _symmetric(matrix: FloatArray) -> FloatArray:
    """Return the symmetric part: rounding of a product is not the same on both sides."""
    return np.asarray(0.5 * (matrix + matrix.T))


def _observer(plant: PolytopicSystem, made: Sequence[LinearObserver], rate: float) -> ScheduledObserver:
    first = made[0]
    each: dict[str, Any] = {
        name: np.array([getattr(observer, name) for observer in made]) for name in ("Az", "Bu", "By")
    }
    return ScheduledObserver(
        **each,
        Cz=first.Cz,
        Du=first.Du,
        Dy=first.Dy,
        effectiveness=np.array([np.eye(plant.nf)] * plant.count).reshape(plant.count, plant.nf, plant.nf),
        forgetting=forgetting_of(rate, discrete=plant.is_discrete),
        **ScheduledObserver.names_of(plant),
        fault_names=plant.fault_names,
        residual_names=first.residual_names,
        state_delays=first.state_delays,
        fault_delays=first.fault_delays,
    )


def _notes(plant: PolytopicSystem, rate: float, *, used: bool, constant: bool) -> tuple[str, ...]:
    forgetting = forgetting_of(rate, discrete=plant.is_discrete)
    for_how_long = f"{forgetting} rows" if plant.is_discrete else f"{forgetting:.4g} s"
    notes = [certificate_note(plant, for_how_long)]
    if used and not plant.is_discrete:
        notes.append(
            "The gain over the region is proved for courses with the stated rate, by a Lyapunov matrix that moves with "
            "the parameter; the decay for every course."
        )
    if constant and plant.count > 1:
        notes.append("The gain is the same at all vertices: in continuous time one that changes would be no better.")
    if not plant.is_discrete:
        notes.append(
            "Between the rows of a log the observer takes a step of implicit Euler, along which errors decay in the "
            "norm of the same certificate however long the step is. The claims do not count what such a step misses of "
            "the plant's own motion, which is little where rows are close beside it."
        )
    if plant.nf:
        notes.append(
            "What is made small is a gain from states, faults and noise together. The noise of the fault estimates has "
            f"no claim of its own; the row '{NOISE_AT_REST_ROW}' has its size while the parameters rest. A smaller "
            "drive of the faults (option noise, such as {fault: 0.3}) weighs the noise more: mostly less of it comes "
            "with a larger gain."
        )
    rated = plant.scheduling.rated_names
    if rated and not used:
        notes.append(
            f"The rate of {', '.join(rated)} is not used: the certificate is for every course. One with a rate is "
            "sought for one parameter that enters linearly, in discrete time where it cannot cross its range in a "
            "sample; it is taken where it proves more."
        )
    return tuple(notes)

"""Fault-estimation filters for faults whose direction changes with the scheduling, by a correction; two vertices.

``z+ = T A(mu) xhat + T B(mu) u`` with ``xhat = z + N y + K(mu) r``, ``r = y - C (z + N y)``, K at the weights of the
sample before: those with which z was formed.  Its error is that of `obsynth.analysis.existence.turning_filter`, and
``fhat = Delta(mu)^-1 W r`` is the fault of the sample before.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from obsynth.analysis.existence.turning_filter import TurningFilter, pairs_of_vertices
from obsynth.errors import SolverError
from obsynth.methods.engines.region_notes import by_product_notes, certificate_note, unused_rate_notes
from obsynth.methods.engines.vertex_certificates import VertexCertificate, certified
from obsynth.methods.fault_estimation_filter.method import FaultEstimationFilter
from obsynth.methods.method import Synthesis
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.scheduled.observer import ScheduledObserver
from obsynth.plants.polytopic import PolytopicSystem
from obsynth.results.design import Certificate
from obsynth.verification.error_polytope import ErrorPolytope
from obsynth.verification.over_region import rows_to_forget, stored_witness


def synthesise_turning(
    plant: PolytopicSystem, method: FaultEstimationFilter, parts: TurningFilter, *, progress: Callable[[str], None]
) -> Synthesis:
    """Return a filter whose correction turns with the faults, with its certificate."""
    progress("solving the inequalities at the pairs of vertices")
    certificate = _certified(plant, method, parts)
    R = certificate.gains[0]
    K = [first + R @ own.T for first, own in zip(parts.K0, parts.U, strict=True)]
    progress("building the realisation and its certificate")
    gains: dict[str, FloatArray] = {"T": parts.T, "N": parts.N, "W": parts.W}
    gains |= {f"K[{i + 1}]": each for i, each in enumerate(K)}
    claims = {"region_decay": certificate.decay, "state_lag": 0.0}
    if plant.nd:
        claims |= {
            "gamma": certificate.gain_times(parts.reach),
            "gamma_min": certificate.least * parts.reach,
        }
    observer = _observer(plant, parts, K, certificate.decay)
    return Synthesis(
        options=method.as_plain(),
        gains=gains,
        observer=observer,
        certificate=Certificate({"tracking": parts.T, **stored_witness(certificate.witness)}, claims),
        solver={"engine": "lmi", "runs": list(certificate.runs)},
        notes=(*_notes(plant, parts, observer.forgetting), *by_product_notes(certificate)),
    )


def turning_error_polytope(plant: PolytopicSystem, parts: TurningFilter) -> ErrorPolytope:
    """Return the error system in R at the pairs of vertices; without disturbances every error has one of its own."""
    T, C, eye = parts.T, plant.vertices[0].C, np.eye(plant.nx)
    TA = [T @ vertex.A for vertex in plant.vertices]
    TB = [T @ vertex.Bd if plant.nd else eye for vertex in plant.vertices]
    read = parts.W @ C
    into: dict[str, Any] = {name: [] for name in ("A", "C", "B", "D", "Cz", "Dz")}
    for i, j in pairs_of_vertices(plant.count):
        for name, moved in (("A", TA), ("B", TB)):
            both = (eye - parts.K0[i] @ C) @ moved[j] + (eye - parts.K0[j] @ C) @ moved[i]
            into[name].append(0.5 * both)
        for name, moved in (("C", TA), ("D", TB)):
            into[name].append(0.5 * (parts.U[i].T @ C @ moved[j] + parts.U[j].T @ C @ moved[i]))
        into["Cz"].append(0.5 * read @ (TA[i] + TA[j]) if plant.nd else eye)
        into["Dz"].append(0.5 * read @ (TB[i] + TB[j]) if plant.nd else np.zeros((plant.nx, plant.nx)))
    return ErrorPolytope(**into, dt=plant.dt)


def _certified(plant: PolytopicSystem, method: FaultEstimationFilter, parts: TurningFilter) -> VertexCertificate:
    errors = turning_error_polytope(plant, parts)
    try:
        return certified(
            errors,
            level=method.gamma / parts.reach if method.gamma is not None and plant.nd else None,
            margin=method.gamma_margin,
            decay=None if method.decay is None else float(np.exp(-method.decay * errors.dt)),
            gain="constant",
            gains=None if errors.outputs else [np.zeros((errors.order, 0))],
            solver=method.solver,
            settings=method.solver_options,
        )
    except SolverError as error:
        raise SolverError(
            f"{error} The faults turn with the scheduling: ui-pi-observer takes such faults, too.", record=error.record
        ) from error


def _observer(plant: PolytopicSystem, parts: TurningFilter, K: Sequence[FloatArray], decay: float) -> ScheduledObserver:
    T, N, W = parts.T, parts.N, parts.W
    C, D = plant.vertices[0].C, plant.vertices[0].D
    free = np.eye(plant.ny) - C @ N  # of the outputs, in the residual
    each: dict[str, Any] = {
        "Az": np.array([T @ vertex.A for vertex in plant.vertices]),
        "Bu": np.array([T @ vertex.B - T @ vertex.A @ N @ D for vertex in plant.vertices]),
        "By": np.array([T @ vertex.A @ N for vertex in plant.vertices]),
    }
    return ScheduledObserver(
        **each,
        Cz=np.vstack([np.eye(plant.nx), -W @ C, -C]),
        Du=-np.vstack([N, W @ free, free]) @ D,
        Dy=np.vstack([N, W @ free, free]),
        effectiveness=np.array(parts.Delta).reshape(plant.count, plant.nf, plant.nf),
        correction=np.array(K),
        # One row more than the certificate says: a fault estimate has the error of the sample before.
        forgetting=rows_to_forget(decay) + 1,
        **ScheduledObserver.names_of(plant),
        fault_names=plant.fault_names,
        residual_names=plant.output_names,
        state_delays=(0,) * plant.nx,
        fault_delays=(1,) * plant.nf,
    )


def _notes(plant: PolytopicSystem, parts: TurningFilter, forgetting: float) -> tuple[str, ...]:
    notes = [certificate_note(plant, f"{forgetting:.0f} rows"), *unused_rate_notes(plant, None)]
    notes.append(
        "The faults turn with the scheduling: the estimates are corrected by gains that turn with them, at the weights "
        "of the sample before."
    )
    if plant.nd:
        notes.append(
            "gamma is the gain of the effect of the faults in the outputs times a proved bound on its inverse, "
            f"{parts.reach:.6g}."
        )
    return tuple(notes)

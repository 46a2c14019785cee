"""Checks of an unknown-input PI observer over a region, from the polytopic plant and the shipped realisation alone."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np

from obsynth.analysis.existence.augmented_pencils import shipped_model
from obsynth.analysis.existence.sharepasand_over_region import pi_conditions_over_region
from obsynth.methods.ui_pi_observer.identities import identities
from obsynth.methods.ui_pi_observer.number_checks import gain_rows, noise_at_rest_row
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.scheduled.observer import ScheduledObserver
from obsynth.plants.faults import Exosystem
from obsynth.plants.polytopic import PolytopicSystem
from obsynth.proofs.extended_balls import Enclosed
from obsynth.proofs.vertex_inequalities import Vertex, pairs_of
from obsynth.results.checks import Check, fitting_check
from obsynth.results.design import ObserverDesign
from obsynth.verification.claims import claimed
from obsynth.verification.fault_models import fault_model_row
from obsynth.verification.identities import EQUALITY_TOLERANCE, Residual, are_residual_names, equality, worst
from obsynth.verification.over_region import (
    GAIN_WITNESSES,
    REGION_GAIN_ROW,
    WITNESSES,
    by_vertex,
    courses,
    decay_row,
    forgetting_row,
    listed_gains_row,
    rated_gain_row,
    region_gain_row,
    same_scheduling_row,
    scheduled_pair,
    share_signals,
    switching_row,
    witness_of_certificate,
    worst_of_vertices,
    wrong_kinds_row,
)
from obsynth.verification.plant import condition_rows

#: Letters of gains that all vertices share.
_SAME_EVERYWHERE = ("U_a", "D_a", "Phi", "Cw")

_MATRICES = ("tracking", "Phi", "Cw")


def checks_over_region(design: ObserverDesign) -> Iterator[Check]:
    """Yield every check of an observer over a region; see `obsynth.verify`."""
    pair = scheduled_pair(design)
    if pair is None:
        yield wrong_kinds_row()
        return
    plant, observer = pair
    matrices = design.certificate.matrices
    fits = _fits(plant, observer, matrices)
    yield fitting_check("observer, certificate and plant have matching signals and shapes", fits=fits)
    if not fits:
        return
    yield fault_model_row(plant, design)
    model = shipped_model(matrices, plant.nf)
    yield from condition_rows(pi_conditions_over_region(plant, model))
    same = same_scheduling_row(plant, observer)
    yield same
    if not same.passed:
        return
    yield from _identity_rows(plant, observer, matrices["tracking"], model)
    yield from _gain_rows(design.gains, plant, observer, matrices["tracking"], model)
    yield from _proved_rows(design, plant, observer)


def _fits(plant: PolytopicSystem, observer: ScheduledObserver, matrices: Mapping[str, FloatArray]) -> bool:
    if not all(name in matrices for name in _MATRICES):
        return False
    tracking, phi, cw = (matrices[name] for name in _MATRICES)
    order = len(phi)
    return bool(
        tracking.shape == (observer.order, plant.nx + order)
        and phi.shape == (order, order)
        and cw.shape == (plant.nf, order)
        and all(np.isfinite(matrix).all() for matrix in (tracking, phi, cw))
        and observer.order == plant.nx + order
        and share_signals(plant, observer)
        and observer.effectiveness_is_one
        and observer.fault_names == plant.fault_names
        and are_residual_names(observer.residual_names, plant.output_names)
        and not any((*observer.state_delays, *observer.fault_delays))
    )


def _identity_rows(
    plant: PolytopicSystem, observer: ScheduledObserver, tracking: FloatArray, model: Exosystem
) -> Iterator[Check]:
    """Yield the rows of (19), each for the vertex where it misses most."""
    entries_by_name: dict[str, list[tuple[Residual, str, str]]] = {}
    for place, vertex in enumerate(plant.vertices):
        for name, claim, miss, source in identities(vertex, observer.at_vertex(place), model, tracking):
            entries_by_name.setdefault(name, []).append((miss, claim, source))
    for name, entries in entries_by_name.items():
        misses = [miss for miss, _, _ in entries]
        place = misses.index(worst(misses))
        miss, claim, source = entries[place]
        row = equality(name, f"{claim}, at every vertex", miss, source, bound=EQUALITY_TOLERANCE)
        yield replace(row, detail=f"{row.detail}, at {plant.scheduling.vertex_name(place)}")


def _gain_rows(
    gains: Mapping[str, FloatArray],
    plant: PolytopicSystem,
    observer: ScheduledObserver,
    tracking: FloatArray,
    model: Exosystem,
) -> Iterator[Check]:
    """Yield the row on the listed gains, of which K_a is that of a vertex."""
    own = by_vertex("K_a", plant.count)
    if not gains or gains.keys() != {*_SAME_EVERYWHERE, *own}:
        yield from listed_gains_row(gains, dict.fromkeys((*_SAME_EVERYWHERE, *own), ()), tuple)
        return
    same = {letter: gains[letter] for letter in _SAME_EVERYWHERE}
    letters = frozenset({*same, "K_a"})
    yield from worst_of_vertices(
        (
            gain_rows(
                {**same, "K_a": gains[letter]},
                vertex,
                observer.at_vertex(place),
                model,
                tracking,
                EQUALITY_TOLERANCE,
                letters=letters,
            )
            for place, (letter, vertex) in enumerate(zip(own, plant.vertices, strict=True))
        ),
        plant.scheduling,
    )


def _vertices(observer: ScheduledObserver, tracking: FloatArray, nx: int) -> list[Vertex]:
    """Return how the errors, driven by what drives the fault models, are formed at each vertex."""

    def vertex_of(place: int) -> Vertex:
        def vertex(kind: type[Enclosed]) -> tuple[Enclosed, Enclosed, Enclosed, Enclosed]:
            cz = observer.Cz[observer.fault_rows]
            drive = tracking[:, nx:]
            nothing = np.zeros((len(cz), drive.shape[1]))
            return kind.exact(observer.Az[place]), kind.exact(drive), kind.exact(cz), kind.exact(nothing)

        return vertex

    return [vertex_of(place) for place in range(observer.count)]


def _is_rated(matrices: Mapping[str, FloatArray]) -> bool:
    """Whether the certificate of the gain is one with several matrices and no slack: coefficients in the parameter."""
    P = matrices.get(GAIN_WITNESSES[0])
    return P is not None and P.ndim == 3 and len(P) > 1 and GAIN_WITNESSES[1] not in matrices


def _proved_rows(design: ObserverDesign, plant: PolytopicSystem, observer: ScheduledObserver) -> Iterator[Check]:
    claims, matrices = design.certificate.claims, design.certificate.matrices
    slack = WITNESSES[1] in matrices or GAIN_WITNESSES[1] in matrices
    steps = plant.scheduling.step_of(plant.dt) if slack and plant.is_discrete else None
    words = courses(plant.scheduling, steps)
    pairs = None if steps is None else pairs_of(plant.count, steps)
    vertices = _vertices(observer, matrices["tracking"], plant.nx)
    decay = claimed(claims, "region_decay")
    yield decay_row(vertices, witness_of_certificate(matrices, pairs), decay, discrete=plant.is_discrete, words=words)
    if plant.nf:
        level = claimed(claims, "region_gain")
        witness = witness_of_certificate(matrices, pairs, GAIN_WITNESSES)
        drive = "their change in a sample" if plant.is_discrete else "their derivative"
        claim = (
            f"the l2 gain from what drives the fault models (for steps: {drive}) to the errors of the fault estimates "
        )
        rate = plant.scheduling.rate_of_weight if _is_rated(matrices) and not plant.is_discrete else None
        if rate is not None:
            claim += f"is below this, {courses(plant.scheduling, rate)}"
            yield rated_gain_row(REGION_GAIN_ROW, claim, vertices, list(matrices[GAIN_WITNESSES[0]]), rate, level)
        else:
            yield region_gain_row(
                REGION_GAIN_ROW,
                f"{claim}is below this, {words}",
                vertices,
                witness,
                level,
                discrete=plant.is_discrete,
            )
        if plant.is_discrete and steps is None:
            yield switching_row(vertices, level)
        yield noise_at_rest_row([observer.at_vertex(place) for place in range(plant.count)])
    yield forgetting_row(decay, observer.forgetting, discrete=plant.is_discrete)

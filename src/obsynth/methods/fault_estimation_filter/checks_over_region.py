"""Checks of a fault-estimation filter over a region, from the polytopic plant and the shipped realisation alone."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

from obsynth.analysis.existence.over_region import FilterOverRegion, examine_over_region
from obsynth.errors import PreconditionError
from obsynth.methods.fault_estimation_filter.identities_over_region import (
    IDENTITIES,
    effectiveness_row,
    gain_rows,
    have_matching_signals,
)
from obsynth.methods.fault_estimation_filter.printed_gains import gain_rows as gain_rows_of_vertex
from obsynth.methods.fault_estimation_filter.printed_gains import gains_fit
from obsynth.methods.fault_estimation_filter.turning_checks import turning_checks
from obsynth.methods.fault_estimation_filter.whole_transfer import Equations, fault_rows
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.logarithmic_balance import balance_by_least_squares
from obsynth.numerics.scaling import Scaling
from obsynth.observers.linear.observer import LinearObserver
from obsynth.observers.scheduled.observer import ScheduledObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.polytopic import PolytopicSystem
from obsynth.proofs.vertex_inequalities import pairs_of
from obsynth.results.checks import Check, fitting_check
from obsynth.results.design import ObserverDesign
from obsynth.verification.claims import claimed
from obsynth.verification.error_system import ErrorModel
from obsynth.verification.over_region import (
    DECOUPLING_ROW,
    WITNESSES,
    by_vertex,
    courses,
    decay_row,
    fault_error_vertices,
    forgetting_row,
    listed_gains_row,
    same_scheduling_row,
    scheduled_pair,
    tracking_rows,
    vertex_errors,
    witness_of_certificate,
    worst_of_vertices,
    wrong_kinds_row,
)
from obsynth.verification.plant import condition_rows

#: Letters of gains that all vertices share.
_SAME_EVERYWHERE = ("T", "N", "W", "Psi", "Upsilon")


def checks_over_region(design: ObserverDesign) -> Iterator[Check]:
    """Yield every check of a filter over a region; see `obsynth.verify`."""
    pair = scheduled_pair(design)
    if pair is None:
        yield wrong_kinds_row()
        return
    plant, observer = pair
    conditions, parts = examine_over_region(plant)
    yield from condition_rows(conditions)
    if observer.correction is not None:
        yield from turning_checks(design, plant, observer)
        return
    tracking = design.certificate.matrices.get("tracking")
    fits = (
        tracking is not None
        and have_matching_signals(plant, observer, tracking)
        and claimed(design.certificate.claims, "state_lag") == 0.0
        and observer.residual_names == plant.fault_names
    )
    yield fitting_check("observer, certificate and plant have matching signals and shapes", fits=fits)
    if tracking is None or not fits:
        return
    same = same_scheduling_row(plant, observer)
    yield same
    if not same.passed:
        return
    observers = [observer.at_vertex(place) for place in range(plant.count)]
    models = vertex_errors(plant, observers, tracking)
    yield from tracking_rows(models, plant.scheduling, IDENTITIES)
    yield from _fault_rows(plant, observer, observers, tracking, models)
    if isinstance(parts, FilterOverRegion):
        yield from _gain_rows(design.gains, plant, observer, tracking, parts)
    yield from _proved_rows(design, plant, observer, tracking)


def _fault_rows(
    plant: PolytopicSystem,
    observer: ScheduledObserver,
    observers: list[LinearObserver],
    tracking: FloatArray,
    models: list[ErrorModel],
) -> Iterator[Check]:
    """Yield the rows on the transfer from the faults, that at the vertex where they miss most."""
    reports = []
    for vertex, own, errors in zip(plant.vertices, observers, models, strict=True):
        rows = fault_rows(vertex, own, tracking, errors, _scaling(vertex), {})
        # The residual is the effect of a fault, which is the fault itself where that does not change.
        reports.append([row for row in rows if observer.effectiveness_is_one or row.name != "fault in the residual"])
    for row in worst_of_vertices(reports, plant.scheduling):
        if row.name == "fault decoupled after its delay":
            claim = (
                "(T A - L C) T Bf = 0 at every vertex, and Bf keeps its directions: at every point, for every course "
                "of the parameters, a fault has no effect on the error after a sample"
            )
            yield replace(row, name=DECOUPLING_ROW, claim=claim)
        else:
            yield row


def _gain_rows(
    gains: Mapping[str, FloatArray],
    plant: PolytopicSystem,
    observer: ScheduledObserver,
    tracking: FloatArray,
    parts: FilterOverRegion,
) -> Iterator[Check]:
    """Yield the rows on the listed gains, of which L is that of a vertex, as a filter of constant matrices has them."""
    own = by_vertex("L", plant.count)
    if not gains or gains.keys() != {*_SAME_EVERYWHERE, *own}:
        yield from listed_gains_row(gains, dict.fromkeys((*_SAME_EVERYWHERE, *own), ()), tuple)
        return
    reports = []
    for place, (letter, vertex, work) in enumerate(zip(own, parts.vertices, parts.work, strict=True)):
        undivided, listed = observer.before_division(place), {name: gains[name] for name in _SAME_EVERYWHERE}
        listed["L"] = gains[letter]
        rows = [gains_fit(work, listed, undivided)]
        scaling = _scaling(work)
        if rows[0].passed and scaling is not None:
            equations = Equations.of(vertex, work, undivided.fault_delays)
            rows += gain_rows_of_vertex(work, listed, undivided, tracking, equations, scaling, {})
        reports.append(rows)
    yield from worst_of_vertices(reports, plant.scheduling)


def _scaling(plant: DescriptorSystem) -> Scaling | None:
    try:
        return balance_by_least_squares(plant.E, plant.A, inputs=[plant.Bf], outputs=[plant.C])
    except PreconditionError:
        return None


def _proved_rows(
    design: ObserverDesign, plant: PolytopicSystem, observer: ScheduledObserver, tracking: FloatArray
) -> Iterator[Check]:
    claims, matrices = design.certificate.claims, design.certificate.matrices
    steps = plant.scheduling.step_of(plant.dt) if WITNESSES[1] in matrices else None
    words = courses(plant.scheduling, steps)
    witness = witness_of_certificate(matrices, None if steps is None else pairs_of(plant.count, steps))
    undivided = [observer.before_division(place) for place in range(plant.count)]
    vertices = fault_error_vertices(plant.vertices, undivided, tracking)
    reach = 1.0
    if not observer.effectiveness_is_one:
        row, reach = effectiveness_row(observer)
        yield row
    if plant.nd:
        yield from gain_rows(design, vertices, witness, reach, words, switched=[] if steps is not None else vertices)
    decay = claimed(claims, "region_decay")
    yield decay_row(vertices, witness, decay, discrete=True, words=words)
    yield forgetting_row(decay, observer.forgetting, discrete=True)

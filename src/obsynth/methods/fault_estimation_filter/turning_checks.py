"""Checks of filters for faults whose direction changes with the scheduling, from plant and realisation alone.

With ``r = -Cr e`` the error ``e = T E x - z`` is corrected to ``eps = (I + K(mu) Cr) e``, K at the weights with which z
was formed, so that ``eps+ = (I + K(mu) Cr) (Az(mu) eps + T Bf(mu) f + T Bd(mu) d)``, and the fault rows are
``-Cf (Az(mu) eps + T Bf(mu) f + T Bd(mu) d)`` before they are divided.  What is of second degree in the weights is the
mean, with weights ``mu_i^2`` and ``2 mu_i mu_j``, of what it is at pairs of vertices.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from obsynth.analysis.existence.turning_filter import has_turning_form, pairs_of_vertices
from obsynth.methods.fault_estimation_filter.identities_over_region import (
    IDENTITIES,
    effectiveness_row,
    gain_rows,
    have_matching_signals,
)
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.scheduled.observer import ScheduledObserver
from obsynth.plants.polytopic import PolytopicSystem
from obsynth.proofs.extended_balls import Enclosed
from obsynth.proofs.vertex_inequalities import Vertex
from obsynth.results.checks import Check, fitting_check
from obsynth.results.design import ObserverDesign
from obsynth.verification.claims import claimed
from obsynth.verification.identities import Identity, equality, worst
from obsynth.verification.over_region import (
    DECOUPLING_ROW,
    by_vertex,
    courses,
    decay_row,
    forgetting_row,
    listed_gains_row,
    same_scheduling_row,
    tracking_rows,
    vertex_errors,
    witness_of_certificate,
)

_SOURCE = "a correction that turns with the faults"


def turning_checks(design: ObserverDesign, plant: PolytopicSystem, observer: ScheduledObserver) -> Iterator[Check]:
    """Yield every check after the conditions of existence."""
    tracking, K = design.certificate.matrices.get("tracking"), observer.correction
    lag = claimed(design.certificate.claims, "state_lag")
    fits = tracking is not None and K is not None and lag == 0.0 and _fits(plant, observer, tracking)
    yield fitting_check("observer, certificate and plant have matching signals and shapes", fits=fits)
    if tracking is None or K is None or not fits:
        return
    same = same_scheduling_row(plant, observer)
    yield same
    if not same.passed:
        return
    undivided = [observer.before_division(place) for place in range(plant.count)]
    models = vertex_errors(plant, undivided, tracking)
    yield from tracking_rows(models, plant.scheduling, IDENTITIES)
    yield from _fault_rows(plant, observer, tracking, K)
    n, ny = plant.nx, plant.ny
    shapes = {"T": (n, n), "N": (n, ny), "W": (plant.nf, ny)} | dict.fromkeys(by_vertex("K", plant.count), (n, ny))
    yield from listed_gains_row(design.gains, shapes, lambda: _of_gains(design.gains, plant, observer, tracking, K))
    yield from _proved_rows(design, plant, observer, tracking, K)


def _fits(plant: PolytopicSystem, observer: ScheduledObserver, tracking: FloatArray) -> bool:
    return (
        has_turning_form(plant)
        and have_matching_signals(plant, observer, tracking)
        and observer.order == plant.nx
        and observer.residual_names == plant.output_names
        # The corrected state is the corrected z, whole.
        and np.array_equal(observer.Cz[observer.state_rows], np.eye(plant.nx))
    )


def _fault_rows(
    plant: PolytopicSystem, observer: ScheduledObserver, tracking: FloatArray, K: FloatArray
) -> Iterator[Check]:
    """Yield the rows on what a fault does, at the pair or the vertex where they miss most."""
    Cr, Cf = observer.Cz[observer.residual_rows], observer.Cz[observer.fault_rows]
    driven = [tracking @ vertex.Bf for vertex in plant.vertices]
    each = []
    for i, j in pairs_of_vertices(plant.count):
        terms = (driven[i], driven[j], K[i] @ (Cr @ driven[j]), K[j] @ (Cr @ driven[i]))
        factors = ((K[i], Cr, tracking, plant.vertices[j].Bf), (K[j], Cr, tracking, plant.vertices[i].Bf))
        each.append(Identity(terms, factors).residual())
    yield equality(
        DECOUPLING_ROW,
        "(I - K C) T Bf = 0 at every pair of vertices: at every point, for every course of the parameters, a fault has "
        "no effect on the corrected error",
        worst(each),
        _SOURCE,
    )
    each = [
        Identity((Cf @ own, effect), ((Cf, tracking, vertex.Bf),)).residual()
        for own, effect, vertex in zip(driven, observer.effectiveness, plant.vertices, strict=True)
    ]
    yield equality("fault estimate", "fhat(k) = f(k - 1): W C T Bf is the effectiveness", worst(each), _SOURCE)


def _of_gains(
    gains: Mapping[str, FloatArray],
    plant: PolytopicSystem,
    observer: ScheduledObserver,
    tracking: FloatArray,
    K: FloatArray,
) -> Iterator[Identity]:
    """Yield what makes the realisation that of the listed gains."""
    N, W, C, rows = gains["N"], gains["W"], plant.vertices[0].C, observer.fault_rows
    yield Identity((gains["T"], -tracking), entrywise=True)
    yield Identity((N, -observer.Dy[observer.state_rows]), entrywise=True)
    yield Identity((observer.Cz[rows], W @ C), ((W, C),))
    yield Identity((observer.Dy[rows], -W, W @ C @ N), ((W, C, N),))
    for letter, own in zip(by_vertex("K", plant.count), K, strict=True):
        yield Identity((gains[letter], -own), entrywise=True)


def _proved_rows(
    design: ObserverDesign, plant: PolytopicSystem, observer: ScheduledObserver, tracking: FloatArray, K: FloatArray
) -> Iterator[Check]:
    claims, matrices = design.certificate.claims, design.certificate.matrices
    words = courses(plant.scheduling, None)
    # A P for every course alone: pairs of vertices are no vertices between which a rate would be one.
    witness = None if "G_region" in matrices else witness_of_certificate(matrices, None)
    vertices = pair_vertices(plant, observer, tracking, K)
    row, reach = effectiveness_row(observer)
    yield row
    if plant.nd:
        yield from gain_rows(design, vertices, witness, reach, words, switched=[vertices[0], vertices[-1]])
    decay = claimed(claims, "region_decay")
    yield decay_row(vertices, witness, decay, discrete=True, words=words)
    # A fault estimate has the error of the sample before.
    yield forgetting_row(decay, observer.forgetting - 1, discrete=True)


def pair_vertices(
    plant: PolytopicSystem, observer: ScheduledObserver, tracking: FloatArray, K: FloatArray
) -> list[Vertex]:
    """Return how the corrected errors and the fault rows are formed at each pair of vertices."""
    Cr, Cf = observer.Cz[observer.residual_rows], observer.Cz[observer.fault_rows]

    def vertex_of(i: int, j: int) -> Vertex:
        def vertex(kind: type[Enclosed]) -> tuple[Enclosed, Enclosed, Enclosed, Enclosed]:
            exact = kind.exact
            eye = exact(np.eye(observer.order))
            corrected = {k: eye + exact(K[k]) @ exact(Cr) for k in (i, j)}
            driven = {k: exact(tracking) @ exact(plant.vertices[k].Bd) for k in (i, j)}
            moved = {k: exact(observer.Az[k]) for k in (i, j)}

            def mean(one: Enclosed, other: Enclosed) -> Enclosed:
                return (one + other).scaled(0.5)

            return (
                mean(corrected[i] @ moved[j], corrected[j] @ moved[i]),
                mean(corrected[i] @ driven[j], corrected[j] @ driven[i]),
                -(exact(Cf) @ mean(moved[i], moved[j])),
                -(exact(Cf) @ mean(driven[i], driven[j])),
            )

        return vertex

    return [vertex_of(i, j) for i, j in pairs_of_vertices(plant.count)]

"""Checks of a Kalman filter over a region, from the polytopic plant and the shipped realisation alone."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from obsynth.analysis.existence.kalman_over_region import kalman_conditions_over_region
from obsynth.errors import SpecError
from obsynth.methods.descriptor_kalman.noise_over_region import NoiseOverRegion
from obsynth.methods.descriptor_kalman.options_over_region import not_over_region
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.norms import output_covariance
from obsynth.observers.scheduled.observer import ScheduledObserver
from obsynth.plants.polytopic import PolytopicSystem
from obsynth.proofs.balls import Ball
from obsynth.proofs.extended_balls import Enclosed, block
from obsynth.proofs.vertex_inequalities import Vertex, pairs_of
from obsynth.results.checks import Check, fitting_check, information, nothing_wrong
from obsynth.results.design import ObserverDesign
from obsynth.verification.claims import claimed
from obsynth.verification.identities import Identity, Residual, equality
from obsynth.verification.over_region import (
    FROZEN_ROW,
    GAIN_WITNESSES,
    WITNESSES,
    by_vertex,
    courses,
    decay_row,
    deviation_row,
    forgetting_row,
    listed_gains_row,
    same_scheduling_row,
    scheduled_pair,
    share_signals,
    tracking_rows,
    vertex_errors,
    witness_of_certificate,
    wrong_kinds_row,
)
from obsynth.verification.plant import condition_rows

_IDENTITIES = {
    "dynamics": ("unbiased: dynamics", "Az T E + By C = T A", "Nikoukhah, Willsky, Levy 1992, Lemma 2.3"),
    "inputs": ("unbiased: inputs", "Bu + By D = T B", "Nikoukhah, Willsky, Levy 1992, Lemma 2.3"),
    "state estimate": (
        "unbiased: state",
        "the state estimate equals the state when the error is zero",
        "L E + K C = I",
    ),
    "residual": ("unbiased: residual", "the state has no effect on the innovation", "L E + K C = I"),
    "input feedthrough": ("unbiased: feedthrough", "the input has no direct effect on any estimate", "our extension"),
}


def checks_over_region(design: ObserverDesign) -> Iterator[Check]:
    """Yield every check of a Kalman filter over a region; see `obsynth.verify`."""
    pair = scheduled_pair(design)
    if pair is None:
        yield wrong_kinds_row()
        return
    plant, observer = pair
    tracking, noise = design.certificate.matrices.get("tracking"), _noise(design, plant)
    fits = tracking is not None and noise is not None and _fits(plant, observer, tracking)
    yield fitting_check("observer, certificate, noise and plant have matching signals and shapes", fits=fits)
    if tracking is None or noise is None or not fits:
        return
    yield nothing_wrong(
        "options over the region",
        "no option is stated that a filter over a region does not have",
        not_over_region(design.options),
        source="options",
    )
    yield from condition_rows(kalman_conditions_over_region(plant))
    same = same_scheduling_row(plant, observer)
    yield same
    if not same.passed:
        return
    observers = [observer.at_vertex(place) for place in range(plant.count)]
    yield from tracking_rows(vertex_errors(plant, observers, tracking), plant.scheduling, _IDENTITIES)
    yield _unknown_input_row(plant, tracking)
    n, ny = plant.nx, plant.ny
    shapes = {"L": (n, n), "K": (n, ny)} | dict.fromkeys(by_vertex("S", plant.count), (n, ny))
    yield from listed_gains_row(design.gains, shapes, lambda: _of_gains(design.gains, plant, observer, tracking))
    yield from _proved_rows(design, plant, observer, tracking, noise)


def _noise(design: ObserverDesign, plant: PolytopicSystem) -> NoiseOverRegion | None:
    """Return the noise that the options and the plant state; ``None`` where they state none that fits."""
    try:
        return NoiseOverRegion.of(plant, design.options.get("Q"), design.options.get("R"))
    except SpecError:
        return None


def _fits(plant: PolytopicSystem, observer: ScheduledObserver, tracking: FloatArray) -> bool:
    return bool(
        share_signals(plant, observer)
        and observer.order == plant.nx
        and observer.residual_names == plant.output_names
        and not observer.fault_names
        and not any(observer.state_delays)
        and tracking.shape == (plant.nx, plant.nx)
        and np.isfinite(tracking).all()
    )


def _of_gains(
    gains: Mapping[str, FloatArray], plant: PolytopicSystem, observer: ScheduledObserver, tracking: FloatArray
) -> Iterator[Identity]:
    """Yield what makes the realisation that of the listed gains: ``Az = L A - S C, By = L A K + S (I - C K)``."""
    L, K = gains["L"], gains["K"]
    yield Identity((L, -tracking), entrywise=True)
    yield Identity((K, -observer.Dy[observer.state_rows]), entrywise=True)
    each = zip(by_vertex("S", plant.count), plant.vertices, observer.Az, observer.By, strict=True)
    for letter, vertex, Az, By in each:
        S, A, C = gains[letter], vertex.A, vertex.C
        yield Identity((Az, -L @ A, S @ C), ((L, A), (S, C)))
        yield Identity((By, -L @ A @ K, -S, S @ C @ K), ((L, A, K), (S, C, K)))


def _unknown_input_row(plant: PolytopicSystem, tracking: FloatArray) -> Check:
    # Each unknown input has units of its own: it is compared with its own terms.
    entering = np.hstack([vertex.Bd for vertex in plant.vertices])
    misses = np.max(np.abs(tracking @ entering), axis=0, initial=0.0)
    sizes = np.max(np.abs(tracking) @ np.abs(entering), axis=0, initial=0.0)
    shares = np.divide(misses, sizes, out=np.zeros(len(sizes)), where=sizes > 0.0)
    return equality(
        "unknown inputs decoupled",
        "T Bd = 0: no unknown input has an effect on the error, at every vertex",
        Residual(float(np.max(shares, initial=0.0)), 1.0),
        "equations that an unknown input enters are left out",
    )


def _proved_rows(
    design: ObserverDesign,
    plant: PolytopicSystem,
    observer: ScheduledObserver,
    tracking: FloatArray,
    noise: NoiseOverRegion,
) -> Iterator[Check]:
    claims, matrices = design.certificate.claims, design.certificate.matrices
    slack = WITNESSES[1] in matrices or GAIN_WITNESSES[1] in matrices
    steps = plant.scheduling.step_of(plant.dt) if slack else None
    words = courses(plant.scheduling, steps)
    pairs = None if steps is None else pairs_of(plant.count, steps)
    vertices = _vertices(observer, tracking, noise)
    level = claimed(claims, "region_deviation")
    yield deviation_row(
        "mean square over the region: the root of the mean square of all state errors together, averaged over "
        f"the samples, is below this in the end, for the stated white noise, {words}, whatever they are that does not "
        "depend on the noise",
        vertices,
        witness_of_certificate(matrices, pairs, GAIN_WITNESSES),
        level,
        discrete=True,
    )
    at_rest = max(_deviation_at_rest(vertex) for vertex in vertices)
    yield information(
        FROZEN_ROW,
        "the largest root mean square at a vertex at which the parameters rest: no claim below it can be true",
        at_rest,
        source="Lyapunov equation at every vertex",
        detail=f"{at_rest / level:.3f} of what is proved" if level > 0.0 else "",
    )
    decay = claimed(claims, "region_decay")
    yield decay_row(vertices, witness_of_certificate(matrices, pairs), decay, discrete=True, words=words)
    yield forgetting_row(decay, observer.forgetting, discrete=True)


def _vertices(observer: ScheduledObserver, tracking: FloatArray, noise: NoiseOverRegion) -> list[Vertex]:
    """Return how the errors of the states, driven by the noise, are formed at each vertex.

    ``e = T E x - z`` obeys ``e+ = Az e + T w - By v``, and the estimate misses by ``e - Dy v``.
    """
    V, rows = noise.sensor, slice(0, len(observer.state_names))

    def vertex_of(place: int) -> Vertex:
        def vertex(kind: type[Enclosed]) -> tuple[Enclosed, Enclosed, Enclosed, Enclosed]:
            exact, W = kind.exact, noise.process[place]
            driven = block([[exact(tracking) @ exact(W), -(exact(observer.By[place]) @ exact(V))]])
            missed = block([[exact(np.zeros((observer.order, W.shape[1]))), -(exact(observer.Dy[rows]) @ exact(V))]])
            return exact(observer.Az[place]), driven, exact(observer.Cz[rows]), missed

        return vertex

    return [vertex_of(place) for place in range(observer.count)]


def _deviation_at_rest(vertex: Vertex) -> float:
    M, B, Cz, Dz = (part.midpoint for part in vertex(Ball))
    return float(np.sqrt(np.trace(output_covariance(M, B, Cz, Dz))))

"""Identities of fault-estimation filters over a region: unbiasedness, effectiveness of faults, and the claimed gain."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from obsynth.analysis.existence.effectiveness import inverse_bound
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.scheduled.observer import ScheduledObserver
from obsynth.plants.polytopic import PolytopicSystem
from obsynth.proofs.vertex_inequalities import Vertex, Witness
from obsynth.results.checks import Check, information, upper_bound_check
from obsynth.results.design import ObserverDesign
from obsynth.verification.claims import ORDER_TOLERANCE, claimed
from obsynth.verification.identities import Identity, equality, worst
from obsynth.verification.over_region import gain_row, share_signals, switching_row

#: Names, claims and sources of the rows on what makes a filter unbiased.
IDENTITIES = {
    "dynamics": ("unbiased: dynamics", "Az T E + By C = T A", "Wang 2015, eqs. (7), (26)"),
    "inputs": ("unbiased: inputs", "Bu + By D = T B", "Wang 2015, eq. (23)"),
    "state estimate": ("unbiased: state", "the state estimate equals the state when the error is zero", "(7)"),
    "fault estimate": ("unbiased: fault", "the state has no effect on the fault estimate", "Wang 2015, eq. (25)"),
    "residual": ("unbiased: residual", "the state has no effect on the residual", "Wang 2015, eq. (25)"),
    "input feedthrough": ("unbiased: feedthrough", "the input has no direct effect on any estimate", "our extension"),
}
#: The row that says what an effectiveness that changes does to the gain.
EFFECTIVENESS_ROW = "effectiveness of the faults"
#: What a product of three numbers and a quotient may be rounded by.
_ROOM = 4.0 * float(np.finfo(np.float64).eps)


def have_matching_signals(plant: PolytopicSystem, observer: ScheduledObserver, tracking: FloatArray) -> bool:
    """Whether an observer and a tracking map are for the signals of a plant, by names and shapes."""
    return (
        share_signals(plant, observer)
        and observer.fault_names == plant.fault_names
        and observer.state_delays == (0,) * plant.nx
        and observer.fault_delays == (1,) * plant.nf
        and tracking.shape == (observer.order, plant.nx)
    )


def effectiveness_row(observer: ScheduledObserver) -> tuple[Check, float]:
    """Return the row that the effectiveness is nonsingular over the region, and a bound on its inverse."""
    reach, reason = inverse_bound(list(observer.effectiveness))
    bound = np.inf if reach is None else reach
    row = upper_bound_check(
        EFFECTIVENESS_ROW,
        "the effect of the faults does not vanish over the region: the norm of its inverse is at most this",
        bound,
        -np.inf if reach is None else reach,
        source="Delta + Delta' definite at every vertex, proved in balls",
        kind="proved",
        detail=f"not proved: {reason}" if reach is None else "",
    )
    return row, bound


def gain_rows(
    design: ObserverDesign,
    vertices: Sequence[Vertex],
    witness: Witness | None,
    reach: float,
    words: str,
    *,
    switched: Sequence[Vertex],
) -> Iterator[Check]:
    """Yield the rows on the claimed gain from the disturbances, the errors of which are divided by an effectiveness
    whose inverse is at most ``reach``; ``switched``: the vertices between which worst courses are searched."""
    claims = design.certificate.claims
    gamma = claimed(claims, "gamma")
    level = gamma / reach * (1.0 - _ROOM)
    yield gain_row(vertices, witness, level, gamma, discrete=True, words=words)
    if switched:
        yield switching_row(switched, level)
    decoupled = decoupled_row(design) if claims.get("gamma_min") == 0.0 else None
    if decoupled is not None and decoupled.passed:
        yield decoupled
    elif "gamma_min" in claims:
        least = claimed(claims, "gamma_min")
        yield upper_bound_check(
            "claimed least gain",
            "0 <= gamma_min <= gamma",
            max(least - gamma, -least, 0.0) / gamma if gamma > 0.0 else np.nan,
            ORDER_TOLERANCE,
            source="certificate",
            detail="the largest step backwards, as a share of gamma",
        )
        yield information(
            "least gain",
            "the least level that the search reached with the inequalities at the vertices; no lower bound of the gain",
            least,
            source="certificate",
            status="assumed",
        )


def decoupled_row(design: ObserverDesign) -> Check:
    """Return the row that no disturbance reaches a fault estimate, whatever the parameters do: the least gain is 0.

    What a disturbance adds to the errors at any vertex is shown by no fault estimate, and is mapped to zero by the
    matrix of the errors at every vertex.
    """
    (plant, observer), tracking = design.scheduled, design.certificate.matrices["tracking"]
    residuals, T = [], np.abs(tracking)
    sizes = [
        float(np.max(T @ np.abs(vertex.A)) + np.max(np.abs(By) @ np.abs(vertex.C)))
        for vertex, By in zip(plant.vertices, observer.By, strict=True)
    ]
    for place, vertex in enumerate(plant.vertices):
        added = tracking @ vertex.Bd, -observer.By[place] @ vertex.Dd
        by_factors = (tracking, vertex.Bd), (observer.By[place], vertex.Dd)
        rows = observer.fault_rows
        for left, size in ((observer.Cz[rows], 0.0), *zip(observer.Az, sizes, strict=True)):
            # What Az is made of may cancel: then it is rounding itself.
            factors = tuple((np.abs(left) + size, *pair) for pair in by_factors)
            residuals.append(Identity((left @ added[0], left @ added[1]), factors).residual())
        residuals.append(Identity((observer.Dy[rows] @ vertex.Dd,)).residual())
    return equality(
        "least gain",
        "the least gain is 0: for every course of the parameters no disturbance reaches a fault estimate, and its "
        "effect on the errors has gone after one sample",
        worst(residuals),
        "Cz (T Bd_j - By_j Dd) = 0, Az_i (T Bd_j - By_j Dd) = 0, Dy Dd = 0 at all vertices i, j",
    )

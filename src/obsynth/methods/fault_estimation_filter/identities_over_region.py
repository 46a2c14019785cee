"""Rows that every fault-estimation filter over a region has: what makes it unbiased, and the effect of the faults."""

from __future__ import annotations

import numpy as np

from obsynth.analysis.existence.effectiveness import EFFECTIVENESS_SHARES
from obsynth.observers.scheduled.observer import ScheduledObserver
from obsynth.plants.polytopic import PolytopicSystem
from obsynth.proofs.vertex_inequalities import VertexProof, prove_nonsingular
from obsynth.results.checks import Check, upper_bound_check

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


def effectiveness_row(plant: PolytopicSystem, observer: ScheduledObserver) -> tuple[Check, float]:
    """Return the row that the effectiveness is nonsingular over the region, and a bound on its inverse."""
    each = list(observer.effectiveness)
    least = min(float(np.linalg.eigvalsh(0.5 * (matrix + matrix.T))[0]) for matrix in each)
    room, proof = 0.0, VertexProof(False, -np.inf, 0, "it is singular at a vertex, or next to it")
    for share in EFFECTIVENESS_SHARES:
        room = share * least
        if room <= 0.0:
            break
        proof = prove_nonsingular(each, np.eye(plant.nf), room)
        if proof.proved:
            break
    reach = float(np.nextafter(1.0 / room, np.inf)) if proof.proved else np.inf
    row = upper_bound_check(
        EFFECTIVENESS_ROW,
        "the effect of the faults does not vanish over the region: the norm of its inverse is at most this",
        reach,
        reach if proof.proved else -np.inf,
        source="Delta + Delta' definite at every vertex, proved in balls",
        kind="proved",
        detail="" if proof.proved else f"not proved: {proof.reason}",
    )
    return row, reach

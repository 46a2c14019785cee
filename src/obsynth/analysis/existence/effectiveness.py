"""The effect of the faults over a region: whether it vanishes nowhere, with a proved bound on its inverse."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from obsynth.analysis.existence.condition import Condition
from obsynth.numerics.arrays import FloatArray
from obsynth.proofs.vertex_inequalities import prove_nonsingular

#: What is kept of ``1 / |Delta^-1|`` in its proof, largest share first.
_SHARES = (1.0 - 1e-9, 0.99, 0.5, 0.1)


def inverse_bound(Delta: Sequence[FloatArray]) -> tuple[float | None, str]:
    """Return a proved bound on ``|Delta^-1|`` over the hull; without a proof ``None``, and why."""
    count = len(Delta[0])
    if not count or all(np.array_equal(matrix, np.eye(count)) for matrix in Delta):
        return 1.0, ""
    least = min(float(np.linalg.eigvalsh(0.5 * (matrix + matrix.T))[0]) for matrix in Delta)
    reason = "it is singular at a vertex, or next to it"
    for share in _SHARES:
        room = share * least
        if room <= 0.0:
            break
        proof = prove_nonsingular(Delta, np.eye(count), room)
        if proof.proved:
            return float(np.nextafter(1.0 / room, np.inf)), ""
        reason = proof.reason
    return None, reason


def effectiveness_condition(reach: float | None, claim: str, source: str) -> Condition:
    """Return the condition that the effect is nonsingular, with a bound on its inverse; ``None``: not proved."""
    return Condition(
        "effectiveness",
        claim,
        reach is not None,
        np.inf if reach is None else reach,
        np.inf,
        source,
        ""
        if reach is not None
        else "between the vertices some fault may have no effect: give a smaller region, in which it keeps one",
        of_the_method=True,
    )

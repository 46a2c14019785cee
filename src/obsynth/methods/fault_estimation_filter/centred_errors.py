r"""The errors over a region with those gains taken out that leave least of them, so that a search starts near its end.

The errors in R and V are those of ``R = R0_i + R'`` and ``V = V0 + V'``:

.. math::
    e^+ = ((A_i - R_{0i} C) - R'_i C) e + ((B_i - R_{0i} D) - R'_i D) w, \qquad
    z = ((C_z + V_0 C) + V' C) e + ((D_z + V_0 D) + V' D) w

With R0 and V0 of least squares, what is left does not depend on how the outputs are combined: a search that ends where
numbers run out ends at the same filter.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from obsynth.methods.engines.vertex_certificates import ErrorUnits, VertexCertificate
from obsynth.verification.error_polytope import ErrorPolytope


def certified_when_centred(
    errors: ErrorPolytope, search: Callable[[ErrorPolytope], VertexCertificate]
) -> VertexCertificate:
    """Return the gains R and V that a search finds for centred errors, in the coordinates of ``errors``.

    Parameters
    ----------
    errors : ErrorPolytope
        With constant C and D, and disturbances.
    search : callable
        Returns a certificate with V.
    """
    states, C, D = ErrorUnits.of(errors).states, errors.C[0], errors.D[0]
    back = np.linalg.pinv(np.hstack([C * states, D]))
    R0 = [np.hstack([a * states, b]) @ back for a, b in zip(errors.A, errors.B, strict=True)]
    V0 = -np.hstack([errors.Cz[0] * states, errors.Dz[0]]) @ back
    centred = replace(
        errors,
        A=[a - r @ C for a, r in zip(errors.A, R0, strict=True)],
        B=[b - r @ D for b, r in zip(errors.B, R0, strict=True)],
    ).with_innovation(V0)
    found = search(centred)
    R = found.gains_at_each(errors.count)
    V = V0 if found.output is None else found.output + V0
    return replace(found, gains=[r + own for r, own in zip(R, R0, strict=True)], output=V)

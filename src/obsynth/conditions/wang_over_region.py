r"""Wang et al. 2015, Theorem 2, over the region of a polytopic plant: (45) at every vertex, with one P.

With constant ``T E + N C = I`` and faults of constant directions, ``L(mu) = T A(mu) Psi Upsilon^+ + R(mu) U2'``
decouples the faults at every point; ``A1_i = T A_i (I - Psi Upsilon^+ C)`` is affine in the weights, and C1 = U2' C is
constant.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from obsynth.analysis.existence.condition import require_all
from obsynth.analysis.existence.over_region import FilterOverRegion, examine_over_region
from obsynth.conditions.polytope import vertex_inequalities
from obsynth.conditions.problem import Conditions, Values
from obsynth.errors import SpecError
from obsynth.numerics.arrays import FloatArray, largest_singular_value
from obsynth.numerics.injection_problem import null_basis
from obsynth.numerics.ranks import CANCELLATION_TOLERANCE, product_but_rounding
from obsynth.plants.polytopic import PolytopicSystem
from obsynth.results.registered import registered
from obsynth.verification.error_polytope import ErrorPolytope


def wang_over_region(plant: PolytopicSystem, *, gamma: float | None = None, margin: float) -> Conditions:
    """Return (45) at every vertex in P and ``Y[1]``, ...; see `obsynth.conditions.wang2015`."""
    conditions, parts = examine_over_region(plant)
    require_all(conditions)
    if not isinstance(parts, FilterOverRegion):
        raise SpecError(
            "The faults turn with the scheduling: (45) is for faults that keep their directions. Take "
            "obsynth.conditions.turning_faults.",
            path="plant",
        )
    W = np.asarray(np.linalg.pinv(parts.Upsilon))
    errors, L0, U2 = errors_over_region(parts, W)
    inequalities = vertex_inequalities(errors, level=gamma, margin=margin)

    def gains(values: Values) -> dict[str, FloatArray]:
        own = inequalities._gains(values)
        R = [own[f"L[{i + 1}]"] for i in range(errors.count)]
        L = {f"L[{i + 1}]": first + r @ U2.T for i, (first, r) in enumerate(zip(L0, R, strict=True))}
        constant = {"T": parts.T, "N": parts.N, "W": W, "Psi": parts.Psi, "Upsilon": parts.Upsilon}
        return {**constant, **L, **{f"R[{i + 1}]": r for i, r in enumerate(R)}}

    def named(name: str) -> str:
        return name.replace("(V1)", "(45)")

    data: dict[str, Any] = {"T": parts.T, "N": parts.N, "Psi": parts.Psi, "Upsilon": parts.Upsilon, "W": W}
    data |= {f"A1[{i + 1}]": A for i, A in enumerate(errors.A)} | {"C1": errors.C[0]}
    data |= {f"TD[{i + 1}]": B for i, B in enumerate(errors.B)}
    return replace(
        inequalities,
        source="Wang et al. 2015, Theorem 2, (45) at every vertex",
        constraints={named(name): constraint for name, constraint in inequalities.constraints.items()},
        data=data,
        _examined=lambda: conditions,
        _gains=gains,
        _design=lambda own, name: registered("design_of_conditions")("wang over region", plant, own, name),
    )


def errors_over_region(parts: FilterOverRegion, W: FloatArray) -> tuple[ErrorPolytope, list[FloatArray], FloatArray]:
    """Return the error system in R at each vertex, ``L0`` at each vertex, and U2: ``L = L0 + R U2'``.

    Combinations of outputs that show nothing, as of a sensor that repeats another, are not among those of U2: gains on
    them are of any size, and change nothing but by rounding."""
    C, Dd, T, N = parts.work[0].C, parts.work[0].Dd, parts.T, parts.N
    output_part = product_but_rounding(-C @ N, Dd, Dd)
    U2 = null_basis(parts.Upsilon.T)
    shown = np.hstack([C, output_part])
    directions, sizes, _ = np.linalg.svd(U2.T @ shown)
    U2 = U2 @ directions[:, : np.count_nonzero(sizes > CANCELLATION_TOLERANCE * largest_singular_value(shown))]
    A1, B1, L0 = [], [], []
    for vertex in parts.work:
        TA = product_but_rounding(T, vertex.A)
        first = TA @ parts.Psi @ W
        L0.append(first)
        A1.append(product_but_rounding(-first, C, TA))
        B1.append(product_but_rounding(T, vertex.Bd) - np.hstack([TA @ N, first]) @ np.vstack([Dd, output_part]))
    C1, D1 = product_but_rounding(U2.T, C), product_but_rounding(U2.T, output_part)
    Cz, Dz = product_but_rounding(W, C), product_but_rounding(W, output_part)
    return ErrorPolytope(A1, C1, B=B1, D=D1, Cz=Cz, Dz=Dz, dt=parts.work[0].dt), L0, U2

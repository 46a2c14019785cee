"""Whether a plant is regular and of index 1 (or 0) at every point of its box: robust.md, 1 and correction 8.5."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from obsynth.errors import PreconditionError
from obsynth.numerics.arrays import FloatArray
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.uncertainty import Uncertainty, matrices_of
from obsynth.proofs.affine import AffineMatrix, affine_block
from obsynth.tolerances.subdivision import BoxVerdict, proved_regular

#: What rounding may leave where a compressed row of E vanishes, beside the terms it is made of.
VANISHING_SHARE = 1e-13


def index_one_on_box(plant: DescriptorSystem) -> BoxVerdict:
    """Return whether ``[E_dyn; A_alg](q)`` is nonsingular on the box; `PreconditionError` where rows become dynamic."""
    written = plant.uncertainty
    if written is None:
        from obsynth.numerics.pencils import pencil_structure

        index = pencil_structure(plant.E, plant.A).index
        return BoxVerdict("proved" if index is not None and index <= 1 else "refuted", 0, np.zeros(0))
    numbers = matrices_of(plant) if written.written is None else written.written
    affine = written.affine(numbers, written.box)
    dynamic, algebraic = compressed_rows(affine["E"].at(written.box.offsets))
    require_algebraic(affine["E"], algebraic)

    def build(lower: FloatArray, upper: FloatArray) -> AffineMatrix:
        found = written.affine(numbers, written.box.part(lower, upper))
        return affine_block([[found["E"].after(dynamic)], [found["A"].after(algebraic)]])

    return proved_regular(
        build,
        len(written.box.names),
        _exactly(written, numbers, dynamic, algebraic),
    )


def compressed_rows(e: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return ``R1, R2``: rows of E that have full rank, and a rational basis of ``R2 E = 0``; numbers as written."""
    from obsynth.proofs.exact_matrices import null_basis, pivot_columns
    from obsynth.proofs.written_numbers import nearest_doubles, written_matrix

    n = len(e)
    exact = written_matrix(e.T)
    chosen = pivot_columns(exact)
    null = nearest_doubles(null_basis(exact)) if len(chosen) < n else np.zeros((n, 0))
    return np.eye(n)[chosen], np.asarray(null.T)


def require_algebraic(e: AffineMatrix, algebraic: FloatArray) -> None:
    """Refuse a box that makes an algebraic row dynamic."""
    found, size = e.after(algebraic), np.abs(algebraic) @ e.magnitude
    moving = np.abs(found.parts).sum(axis=0) > VANISHING_SHARE * size
    if moving.any():
        rows = np.flatnonzero(np.abs(algebraic[moving.any(axis=1)]).sum(axis=0))
        raise PreconditionError(
            f"A tolerance puts a derivative into an algebraic equation (rows {', '.join(str(i + 1) for i in rows)}): "
            "the plant's order changes inside the box. Give these rows of E no tolerance of their own.",
            condition="algebraic rows",
        )  # fmt: skip


def _exactly(
    written: Uncertainty, numbers: Mapping[str, FloatArray], dynamic: FloatArray, algebraic: FloatArray
) -> Callable[[FloatArray], FloatArray]:
    def at(q: FloatArray) -> FloatArray:
        found = written.filled(numbers, written.box.values(q))
        return np.vstack([dynamic @ found["E"], algebraic @ found["A"]])

    return at

"""Proof that no filter of a family has a smaller gain, by a combination of disturbances that no gain sees.

The filters with these T and N (and W unless it is free) differ by ``L' - L`` and ``W' - W`` that vanish on Upsilon: a
pair (e, d) with ``C e + D d`` in the range of Upsilon leads to the next error and to xi whatever the gains. Each F with
``Q = image F F' image' - top F F' top' >= 0`` is a mixture of pairs that can follow each other, so that ``g^2 |bottom
F|^2 >= |xi of F|^2 + tr P Q``, ``P >= 0``; where W is fixed, one more disturbance ``d = K e`` (and M, from rest) shows
before any gain can act: ``tr P Q >= |xi of (e, K e)|^2 - g^2 |K e|^2`` over Q. S and the pairs are rational, from the
stored numbers, so that nothing is nearly invisible; the sums are in ball arithmetic. Where outputs depend on others,
which rounding hides, filters that read as many combinations as are independent are looked at. Source: ours, the dual of
Wang 2015, eq. (45).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import flint
import numpy as np
from flint import fmpq_mat

from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.outward import lower_text
from obsynth.numerics.ranks import decide_rank
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.proofs.covariances import squared_norm
from obsynth.proofs.exact_doubles import stored_matrix, whole_matrices
from obsynth.proofs.extended_balls import arb_matrix, undecided_pivot
from obsynth.proofs.rational_matrices import (
    blocks,
    null_basis,
    picked_columns,
    picked_rows,
    row_basis,
    whole_null_basis,
    zeros_matrix,
)
from obsynth.results.checks import Check, information

#: Filters of more states are not examined: exact null spaces of that many doubles take seconds.
MOST_EXAMINED_STATES = 64

#: Digits (bits) of the sums.
SUM_BITS = 512

#: Names of the certificate's matrices: F, K and M; one that is left out is zero.
LEAST_GAIN_PAIRS, LAST, ALONE = "least_gain_pairs", "least_gain_last", "least_gain_alone"

#: Name of the combinations ``(m, ny)`` of outputs that the filters of the proof read, all outputs where there is none.
OUTPUTS_READ = "least_gain_outputs"

LEAST_GAIN_WITNESSES = frozenset({LEAST_GAIN_PAIRS, LAST, ALONE, OUTPUTS_READ})

#: The least gain found counts as proved where the proved bound is below it by this share at most.
PROVED_SHARE = 1e-4

#: Norms are computed in double precision: a bound may be above one by this share.
BOUND_TOLERANCE = 1e-6


@dataclass(frozen=True, eq=False)
class InvisiblePairs:
    """What no gain sees (``flint.fmpq_mat``): errors S ``(n, s)`` that pairs reach from rest, pairs that stay there.

    ``top (s, k)``, ``image (s, k)`` (in S), ``bottom (nd, k)`` (d), ``shown (nf, k)`` (xi); Z, Zd: xi of any error in
    S, any d.
    """

    S: Any
    top: Any
    bottom: Any
    image: Any
    shown: Any
    Z: Any
    Zd: Any

    @classmethod
    def of(
        cls, work: DescriptorSystem, gains: Mapping[str, FloatArray], outputs: FloatArray | None = None
    ) -> InvisiblePairs | None:
        """Return the pairs of a plant with its sensor faults as states; ``None`` where there are too many states.

        ``outputs (m, ny)``: combinations of outputs, stated where filters that read these alone are looked at."""
        if work.nx > MOST_EXAMINED_STATES or not work.nd:
            return None
        read = () if outputs is None else (np.ascontiguousarray(outputs, dtype=np.float64),)
        if any(part.ndim != 2 or part.shape[1] != work.ny or not np.all(np.isfinite(part)) for part in read):
            return None
        parts = (
            *(gains[letter] for letter in ("T", "N", "L", "W", "Upsilon")),
            work.A,
            work.C,
            work.Bd,
            work.Dd,
            *read,
        )
        return cls._of(*((part.shape, part.tobytes()) for part in parts))

    # Synthesis and verification ask for those of the same numbers.
    @classmethod
    @lru_cache(maxsize=2)
    def _of(cls, *numbers: tuple[tuple[int, ...], bytes]) -> InvisiblePairs:
        matrices, unit = whole_matrices([np.frombuffer(data).reshape(shape) for shape, data in numbers])
        t, n, feedback, w, upsilon, plain, c, bd, dd, *read = matrices
        # Whole numbers: a and z are `unit^2` times what they stand for, b and zd `unit^4` times.
        square = unit * unit
        ta, direct = t * plain, dd * square - c * (n * dd)
        a, b = ta - feedback * c, t * bd * square - ta * (n * dd) - feedback * direct
        z, zd = w * c, w * direct
        shows = blocks([[fmpq_mat(c), fmpq_mat(direct) / square, fmpq_mat(upsilon)]])
        pairs, size, free = whole_null_basis(fmpq_mat(read[0]) * shows if read else shows)
        states, inputs = int(plain.ncols()), int(bd.ncols())
        # A start has `size` times x where a state is free, and these come first.
        own = [j for j in free if j < states]
        others = [j for j in range(states) if j not in set(own)]
        first, beside = (
            fmpq_mat(picked_columns(picked_rows(pairs, others), range(*ends)))
            for ends in ((0, len(own)), (len(own), len(free)))
        )
        bottoms = fmpq_mat(picked_rows(pairs, range(states, states + inputs)))
        reached = zeros_matrix(states, 0)
        while True:
            # Pairs x that start where others have ended, at -y in the basis of that.
            ended = picked_rows(reached, own)
            chosen = null_basis(blocks([[beside, picked_rows(reached, others) * size - first * ended]]))
            width = int(beside.ncols())
            y = picked_rows(chosen, range(width, int(chosen.nrows())))
            starts = -reached * y
            ends = bottoms * blocks([[-ended * y], [picked_rows(chosen, range(width))]]) / size
            images = (a * starts * square + b * ends) / (square * square)
            # A basis of the range whose rows at `_pivot_rows` are the identity.
            larger = row_basis(blocks([[reached, images]]).transpose()).transpose()
            if larger.ncols() == reached.ncols():
                break
            reached = larger
        places = _pivot_rows(reached)
        top, image = picked_rows(starts, places), picked_rows(images, places)
        estimates = (z * starts * square + zd * ends) / (square * square)
        return cls(reached, top, ends, image, estimates, z * reached / square, fmpq_mat(zd) / (square * square))

    def bound(self, matrices: Mapping[str, FloatArray], *, free_weight: bool) -> float:
        """Return the lower bound that a certificate proves, rounded down; zero where it proves nothing."""
        k, s, nd = int(self.top.ncols()), int(self.S.ncols()), int(self.Zd.ncols())
        empty = {LEAST_GAIN_PAIRS: np.zeros((k, 1)), LAST: np.zeros((nd, s)), ALONE: np.zeros((nd, 1))}
        f, last, alone = (np.asarray(matrices.get(name, part)) for name, part in empty.items())
        if any(part.ndim != 2 or not np.all(np.isfinite(part)) for part in (f, last, alone)):
            return 0.0
        if len(f) != k or last.shape != (nd, s) or len(alone) != nd:
            return 0.0
        with flint.ctx.workprec(SUM_BITS):
            mixed, later, direct = (arb_matrix(part) for part in (f, last, alone))
            image, top = (_balls(part) * mixed for part in (self.image, self.top))
            slack = image * image.transpose() - top * top.transpose()
            shown, energy = squared_norm(_balls(self.shown) * mixed), squared_norm(_balls(self.bottom) * mixed)
            # Without pairs that start anywhere but at rest, Q is a square.
            if any(value != 0 for value in (self.top * stored_matrix(f)).entries()) and not _definite(slack):
                return 0.0
            if not free_weight:
                zd = _balls(self.Zd)
                estimates = _balls(self.Z) + zd * later
                shown += (estimates * slack * estimates.transpose()).trace() + squared_norm(zd * direct)
                energy += (later * slack * later.transpose()).trace() + squared_norm(direct)
            if not energy > 0 or not shown > 0:
                return 0.0
            return max(float(np.nextafter(float((shown / energy).sqrt().lower()), 0.0)), 0.0)


def least_gain_row(
    work: DescriptorSystem | None,
    gains: Mapping[str, FloatArray],
    matrices: Mapping[str, FloatArray],
    claimed: float,
    *,
    free_weight: bool,
    thorough: bool,
) -> Check:
    """Return the row on the least gain: proved from the certificate, or named as the least that was found."""
    family = "these T and N" if free_weight else "these T, N and W"
    detail = "" if thorough else "prove_least = true asks for a proof"
    if not LEAST_GAIN_WITNESSES & matrices.keys():
        return information(
            "least gain",
            f"the least gain found of all filters with {family}; that none is below is not proved",
            claimed,
            source="stated by the search",
            status="assumed",
            detail=detail,
        )
    outputs = matrices.get(OUTPUTS_READ)
    if outputs is not None:
        family = f"{family} that reads these combinations of dependent outputs"
    whole = work is not None and (outputs is None or _read_everything(work, outputs))
    pairs = InvisiblePairs.of(work, gains, outputs) if work is not None and whole else None
    bound = 0.0 if pairs is None else pairs.bound(matrices, free_weight=free_weight)
    holds = bound * (1.0 - BOUND_TOLERANCE) <= claimed and claimed * (1.0 - PROVED_SHARE) <= bound
    return Check(
        "least gain",
        f"no filter with {family} has a smaller gain than the claimed one, to {PROVED_SHARE:.0e} of it",
        bound,
        claimed,
        min(claimed * (1.0 + BOUND_TOLERANCE) - bound, bound - claimed * (1.0 - PROVED_SHARE)),
        bool(holds),
        "disturbances that no gain can attenuate, exactly; sums in ball arithmetic",
        "proved",
        f"proved: at least {lower_text(bound, 9)}",
    )


def _read_everything(work: DescriptorSystem, outputs: FloatArray) -> bool:
    """Return whether combinations of outputs hold all that the outputs do, but for rounding."""
    if outputs.ndim != 2 or outputs.shape[1] != work.ny or not np.all(np.isfinite(outputs)):
        return False
    shown = np.hstack([work.C, work.Dd])
    return decide_rank(outputs @ shown).rank == decide_rank(shown).rank


def _definite(matrix: Any) -> bool:
    size = int(matrix.nrows())
    return undecided_pivot([[matrix[i, j] for j in range(size)] for i in range(size)]) is None


def _balls(matrix: Any) -> Any:
    return flint.arb_mat(int(matrix.nrows()), int(matrix.ncols()), [flint.arb(value) for value in matrix.entries()])


def _pivot_rows(basis: Any) -> list[int]:
    rows, width = int(basis.nrows()), int(basis.ncols())
    return [next(i for i in range(rows) if basis[i, j] != 0) for j in range(width)]

"""How an uncertain plant drives the estimation error of a given observer.

    eps+ = Az eps + (Az T E + By C - T A) x + (Bu + By D - T B) u + (By Dd - T Bd) d,   eps = z - T E(q) x
    xhat - x = Cx eps + (Cx T E + Dyx C + T0x A - I) x + ...      (fault estimates, residuals: without I)

The brackets vanish at the nominal plant.  Elsewhere in the box they are driven by ``x = xhat - e``: by the estimate,
which is known, and by the error.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from obsynth.errors import PreconditionError
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.ranks import EFFECT_RANK_SHARE, ROUNDED_BESIDE
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.transformations.uncertain_plant import AffinePlant
from obsynth.proofs.affine import AffineMatrix, affine_block
from obsynth.proofs.balls import gamma, rounded_up
from obsynth.verification.error_system import IDENTITY_SHARE

#: Remainders below this share of the terms of their row are rounding and share one channel.
REMAINDER_SHARE = 1e-9


class Tracking(NamedTuple):
    """``z`` follows ``T E x``, ``T (nz, nx)``; outputs use ``T0 (nx + nf + nr, nx)``: ``T0 (A x + B u + Bd d) = 0``."""

    T: FloatArray
    T0: FloatArray


@dataclass(frozen=True, eq=False)
class ErrorStructure:
    """The error system over a box: rows ``[eps; e; outputs]`` (nz, n, no), columns of the state and the inputs."""

    Az: FloatArray
    Cx: FloatArray
    Co: FloatArray
    state: AffineMatrix
    inputs: AffineMatrix
    disturbances: AffineMatrix
    bounds: FloatArray
    channel_rows: FloatArray  # |c e| of a row c each: of constants, then of states with a remainder
    single: int  # rows after these share one channel, the largest of them
    effects: FloatArray  # (nz + n + no, m): what a channel does
    owner: tuple[int, ...]  # the constant of each channel
    offsets: FloatArray  # (p,): nominal values from the middles of their ranges, in half widths
    reading: FloatArray  # xhat (and fhat) from the rows of the observer
    watching: FloatArray

    @property
    def sizes(self) -> tuple[int, int, int]:
        """``nz, n, no``."""
        return len(self.Az), len(self.Cx), len(self.Co)

    @property
    def rows(self) -> tuple[slice, slice, slice]:
        """Rows of eps, e and the outputs."""
        nz, n, no = self.sizes
        return slice(0, nz), slice(nz, nz + n), slice(nz + n, nz + n + no)

    @property
    def channels(self) -> int:
        """Number of channels."""
        return int(self.effects.shape[1])

    def channel_sizes(self, values: FloatArray) -> FloatArray:
        """Return the size of each channel from ``channel_rows`` times something, rows in the first axis."""
        sizes = np.abs(values)
        if self.single == len(sizes):
            return sizes
        return np.concatenate([sizes[: self.single], sizes[self.single :].max(axis=0, keepdims=True)])


def error_structure(
    observer: LinearObserver,
    affine: AffinePlant,
    tracking: Tracking,
    bounds: FloatArray,
    noise_bound: float,
    *,
    faults: bool = False,
    states: bool = False,
    reading: FloatArray | None = None,
    varying: bool = False,
) -> ErrorStructure:
    """Return the error system of an observer over a box; ``bounds (nd,)``, ``noise_bound`` in standard deviations.

    With ``faults`` these are estimated like states; else outputs are fault estimates and residuals, or (``states``)
    errors of states.  ``reading (n, states of the observer)`` is that of a continuous design on samples: what its
    identities miss counts as one more constant, the last.  ``varying``: those of the sample of a late fault count too.
    """
    plant, count = affine.plant, affine.count
    t, t0 = tracking
    nz, n, nf = observer.order, plant.nx, plant.nf if faults else 0
    back = 2.0 * np.eye(n) - affine.coordinates
    picked = _picked_rows(observer, back if reading is None else reading, back, nf=nf, faults=faults, states=states)
    c, dy, du, algebraic = picked @ observer.Cz, picked @ observer.Dy, picked @ observer.Du, picked @ t0

    def stacked(inner: AffineMatrix, output: AffineMatrix) -> AffineMatrix:
        """Return rows of eps and of what is read, for one kind of signal."""
        top, low = output.after(observer.By) - inner.after(t), output.after(dy) + inner.after(algebraic)
        return affine_block([[top], [low]])

    rest = np.eye(n) if states else np.zeros((len(picked) - n, n))
    target = np.vstack([np.zeros((nz, n)), np.eye(n), rest])
    followed = affine.E.after(t)
    state = stacked(affine.A, affine.C) + affine_block([[followed.after(observer.Az)], [followed.after(c)]]) + (-target)
    known = stacked(affine.B, affine.D) + np.vstack([observer.Bu, du])
    sizes = _sizes(observer, affine, t, c, dy)
    offsets = affine.offsets
    if reading is None:
        _require_identities(state, known, sizes, offsets)
    noise = AffineMatrix.exact(plant.Bw, count), AffineMatrix.exact(plant.Dw, count)
    disturbances = affine_block([[stacked(affine.Bd, affine.Dd), stacked(*noise)]])
    if faults:
        columns = _fault_columns(stacked(affine.Bf, affine.Df), observer, c, n, offsets)
        state, known, disturbances, offsets = _with_faults(
            (state, known, disturbances), columns, observer, offsets, varying=varying
        )
    if reading is not None:
        state, known = _with_missed(state, offsets), _with_missed(known, offsets)
        disturbances = _with_more(disturbances, 1)
        offsets = np.append(offsets, 0.0)
    parts, rest = _about_nominal(state, offsets)
    rows, effects, owner, neglected = _channels(parts, offsets)
    rest = rounded_up(rest + neglected, 3)
    more, single, remainders = _remainder_channels(rest, sizes)
    input_parts, input_rest = _about_nominal(known, offsets)
    return ErrorStructure(
        Az=observer.Az,
        Cx=c[: n + nf],
        Co=c[n + nf :],
        state=AffineMatrix(np.zeros_like(rest), parts, rest),
        inputs=AffineMatrix(np.zeros_like(input_rest), input_parts, input_rest),
        disturbances=disturbances,
        bounds=np.concatenate([bounds, np.full(plant.nw, noise_bound)]),
        channel_rows=np.vstack([rows, more]),
        single=len(rows) + single,
        effects=np.hstack([effects, remainders]),
        owner=tuple(owner),
        offsets=offsets,
        reading=picked[: n + nf],
        watching=picked[n + nf :],
    )


def _with_faults(
    parts: tuple[AffineMatrix, AffineMatrix, AffineMatrix],
    columns: AffineMatrix,
    observer: LinearObserver,
    offsets: FloatArray,
    *,
    varying: bool,
) -> tuple[AffineMatrix, AffineMatrix, AffineMatrix, FloatArray]:
    """Return the matrices of states with those of faults, of inputs and of disturbances, and the offsets.

    ``varying``: late faults depend on the constants of an earlier sample, which are further constants.
    """
    state, known, disturbances = parts
    count = columns.count
    earlier = np.array(observer.fault_delays, dtype=np.int64) > 0 if varying else np.zeros(columns.shape[1], dtype=bool)
    if earlier.any():
        state, known, disturbances = (_with_more(item, count) for item in parts)
        columns = _at_earlier_samples(columns, earlier, count)
        offsets = np.concatenate([offsets, offsets])
    return affine_block([[state, columns]]), known, disturbances, offsets


def _sizes(observer: LinearObserver, affine: AffinePlant, t: FloatArray, c: FloatArray, dy: FloatArray) -> FloatArray:
    """Return the size of the terms of each row, ``(rows, 1)``."""
    absolute = np.abs
    own = absolute(observer.By) @ affine.C.magnitude + absolute(t) @ affine.A.magnitude
    # A state z that reads algebraic equations alone follows no state, but for the rounding of its own terms.
    te = absolute(t) @ affine.E.magnitude + ROUNDED_BESIDE * own
    top = absolute(observer.Az) @ te + own
    low = absolute(c) @ te + absolute(dy) @ affine.C.magnitude
    return np.asarray(np.vstack([top, low]).max(axis=1, initial=np.finfo(np.float64).tiny)[:, None])


def _require_identities(state: AffineMatrix, known: AffineMatrix, sizes: FloatArray, offsets: FloatArray) -> None:
    """Raise `PreconditionError` where the observer's identities do not hold on the nominal plant."""
    missed = float(np.max(_missed(state, offsets) / sizes, initial=0.0))
    missed = float(np.maximum(missed, np.max(_missed(known, offsets) / (sizes + known.magnitude), initial=0.0)))
    if not missed <= IDENTITY_SHARE:
        raise PreconditionError(
            f"The observer's identities do not hold on the nominal plant (by {missed:.1e} of their terms): a bound "
            "over tolerances needs z to follow T E x. Run obsynth.verify on the design.",
            condition="identities",
        )


def _missed(matrix: AffineMatrix, offsets: FloatArray) -> FloatArray:
    """Return a lower bound on a matrix at the nominal plant, where it should vanish, less its remainder."""
    return np.maximum(np.abs(matrix.at(offsets)) - matrix.radius, 0.0) if offsets.any() else np.abs(matrix.center)


def _require_every_fault(observer: LinearObserver, nf: int) -> None:
    """Raise `PreconditionError` where a fault of the plant is not estimated: the error system has all of them."""
    if len(observer.fault_names) != nf:
        raise PreconditionError(
            "Not every fault is estimated, so none has a guaranteed interval.", condition="fault interval"
        )


def _fault_columns(
    direct: AffineMatrix, observer: LinearObserver, c: FloatArray, n: int, offsets: FloatArray
) -> AffineMatrix:
    """Return the columns of faults as signals that are estimated, each at its delay."""
    nz, nf = observer.order, direct.shape[1]
    target = np.zeros((nz + len(c), nf))
    target[nz + n : nz + n + nf] = np.eye(nf)
    target[nz + n + nf :] = np.eye(nf)
    late = np.array(observer.fault_delays, dtype=np.int64)
    if (late > 1).any():
        raise PreconditionError(
            "A fault estimate that lags by more than one sample has no guaranteed interval.", condition="fault interval"
        )
    into = direct[:nz, :]
    moved = affine_block([[into.after(observer.Az)], [into.after(c)]])
    reached = direct.magnitude[nz:, late == 1]
    if reached.size and reached.max() > EFFECT_RANK_SHARE:
        raise PreconditionError(
            "A fault that is estimated with a delay of one sample reaches the estimates at once: its estimate has no "
            "guaranteed interval.",
            condition="fault interval",
        )
    chosen = [moved[:, [j]] if late[j] else direct[:, [j]] for j in range(nf)]
    columns = affine_block([chosen]) + (-target)
    if float(np.max(_missed(columns, offsets), initial=0.0)) > IDENTITY_SHARE:
        raise PreconditionError(
            "The estimate of a fault, or of the state, depends on how the fault came about: it has no guaranteed "
            "interval (a filter that estimates each sample of a fault on its own has one).",
            condition="fault interval",
        )
    return columns


def _picked_rows(
    observer: LinearObserver, reading: FloatArray, back: FloatArray, *, nf: int, faults: bool, states: bool
) -> FloatArray:
    """Return the selection ``(n + nf + watched, rows)`` of the observer's output rows.

    The first rows are the states, by ``reading``; with ``faults`` the faults follow; the last are the watched rows.
    """
    n, fault_rows = len(back), observer.fault_rows
    watched = list(range(n) if states else range(fault_rows.start, fault_rows.stop if faults else len(observer.Cz)))
    picked = np.zeros((n + nf + len(watched), len(observer.Cz)))
    picked[:n, observer.state_rows] = reading
    if faults:
        _require_every_fault(observer, nf)
        picked[n : n + nf, fault_rows] = np.eye(nf)
    picked[n + nf :, watched] = back if states else np.eye(len(watched))
    return picked


def _at_earlier_samples(columns: AffineMatrix, earlier: NDArray[np.bool_], count: int) -> AffineMatrix:
    """Return columns of faults in which late ones depend on the constants of an earlier sample, which are new ones."""
    doubled = _with_more(columns, count)
    doubled.parts[count:, :, earlier] = doubled.parts[:count, :, earlier]
    doubled.parts[:count, :, earlier] = 0.0
    return doubled


def _with_more(matrix: AffineMatrix, count: int) -> AffineMatrix:
    """Return a matrix as a function of ``count`` further constants, on which it does not depend."""
    return AffineMatrix(matrix.center, np.concatenate([matrix.parts, np.zeros((count, *matrix.shape))]), matrix.radius)


def _with_missed(matrix: AffineMatrix, offsets: FloatArray) -> AffineMatrix:
    """Return a matrix whose value at the nominal plant is the part of one further constant."""
    missed = matrix.at(offsets)
    rounding = gamma(matrix.count + 3) * matrix.magnitude
    return AffineMatrix(
        matrix.center - missed, np.concatenate([matrix.parts, missed[None]]), rounded_up(matrix.radius + rounding, 3)
    )


def _about_nominal(matrix: AffineMatrix, offsets: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the affine parts, which multiply ``q - offsets``, and a bound on the value at the nominal plant."""
    rounding = gamma(matrix.count + 2) * matrix.magnitude if offsets.any() else 0.0
    return matrix.parts, rounded_up(np.abs(matrix.at(offsets)) + matrix.radius + rounding, 3)


def _channels(parts: FloatArray, offsets: FloatArray) -> tuple[FloatArray, FloatArray, list[int], FloatArray]:
    """Return rows c, effects b (for the farthest value of a constant), owners, and a bound on the neglected parts."""
    rows_count, n = parts.shape[1:]
    rows, effects, owner, neglected = [np.zeros((0, n))], [np.zeros((rows_count, 0))], [], np.zeros((rows_count, n))
    for i, part in enumerate(parts):
        columns = np.flatnonzero(np.abs(part).sum(axis=0) > 0.0)
        if not len(columns):
            continue
        u, values, v = np.linalg.svd(part, full_matrices=False)
        rank = int(np.sum(values > EFFECT_RANK_SHARE * values[0]))
        if len(columns) <= rank:
            b, c = part[:, columns], np.eye(n)[columns]
        else:
            b, c = u[:, :rank] * values[:rank], v[:rank]
            c = np.where(np.abs(c) < EFFECT_RANK_SHARE, 0.0, c)
            missed = np.abs(part - b @ c) + gamma(2 * rank + 4) * (np.abs(b) @ np.abs(c))
            neglected += (1.0 + abs(offsets[i])) * missed
        rows.append(c)
        effects.append((1.0 + abs(offsets[i])) * b)
        owner += [i] * len(c)
    return np.vstack(rows), np.hstack(effects), owner, rounded_up(neglected, len(parts) + 4)


def _remainder_channels(rest: FloatArray, sizes: FloatArray) -> tuple[FloatArray, int, FloatArray]:
    """Return rows, the number of them with a channel of their own, and effects; small remainders share one channel."""
    n = rest.shape[1]
    share = (rest / sizes).max(axis=0, initial=0.0)
    large = np.flatnonzero(share > REMAINDER_SHARE)
    small = np.flatnonzero((share > 0.0) & (share <= REMAINDER_SHARE))
    rows, effects = [np.eye(n)[large]], [rest[:, large]]
    if len(small):
        rows.append(np.eye(n)[small] * share[small][:, None])
        effects.append(rounded_up((rest[:, small] / share[small]).sum(axis=1, keepdims=True), len(small) + 2))
    return np.vstack(rows), len(large), np.hstack(effects)

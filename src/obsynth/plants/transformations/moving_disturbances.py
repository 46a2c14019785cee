"""Disturbances that move between samples: the effects of any time course within bounds on a sampled plant.

.. math::
    q = \\int_0^h e^{A s} B_d d(h - s)\\, ds, \\qquad |d_i(t)| \\le \\bar d_i

What weights c of the states can make of q is at most the sum of ``\\bar d_i \\int |c e^{A s} B_{d,i}| ds``: the sum of
absolute values of what c makes of some columns (`obsynth.proofs.absolute_integrals`), a fraction of a per cent larger.
Every threshold, proof and tolerance of a sampled plant takes these columns from here.  What is at least possible comes
from fewer columns, of disturbances that rest in each piece of a sample.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from obsynth.errors import PreconditionError
from obsynth.numerics.arrays import FloatArray, remembered
from obsynth.plants.descriptor import MOST_STORED_STATES, DescriptorSystem
from obsynth.plants.transformations.elimination import eliminate_algebraic_states
from obsynth.plants.transformations.uncertain_plant import AffinePlant, reduced_family, sums_of_bounds
from obsynth.plants.uncertainty import SAMPLED
from obsynth.proofs.absolute_integrals import IntervalColumns, halvings, interval_columns
from obsynth.proofs.affine import AffineMatrix, affine_block, affine_inverse
from obsynth.proofs.balls import rounded_up
from obsynth.proofs.products import exponential

#: Pieces of a sample in which a disturbance rests, in the linear programmes of windows, which have a column for each of
#: each sample: of up to so many disturbances, and of more.
RESTING_PIECES, FEWEST_PIECES = ((2, 16), (6, 8)), 4

#: The shorter pieces that fast modes need are no more than as many again.
MOST_RESTING_TIMES = 2

#: Pieces of a sample where given weights are judged, which takes no programme: of up to so many entries, and of more.
JUDGED_PIECES, MOST_ENTRIES, JUDGED_PIECES_OF_MANY = 32, 60, 16


@dataclass(frozen=True, eq=False)
class MovingColumns:
    """What moving disturbances put into the states of a plant in a sample, from both sides.

    ``resting (nx, pieces nd)``, the last piece of a sample first: what disturbances that rest in each piece do, which
    has these ``shares (pieces,)`` of the sample.
    ``columns (nx, k nd)``, and ``directions (nx, nx)`` with ``sizes (nx, nd)``: |c q| is at most
    ``|c columns| bounds + |c directions| sizes bounds`` for every row c.  ``moved (nd,)``: which disturbances these
    are; the others act from sample to sample.
    """

    resting: FloatArray
    shares: FloatArray
    columns: FloatArray
    directions: FloatArray
    sizes: FloatArray
    moved: np.ndarray

    def rest(self, bounds: FloatArray) -> FloatArray:
        """Return how far q goes in each direction beside the columns ``(nx,)``, for bounds ``(nd,)``."""
        return sums_of_bounds(self.sizes, bounds)


def continuous_behind(plant: DescriptorSystem) -> DescriptorSystem | None:
    """Return the plant in continuous time that a plant was sampled from, without algebraic states.

    Parameters
    ----------
    plant : DescriptorSystem
        Any plant.

    Returns
    -------
    DescriptorSystem or None
        ``None`` where the plant was not sampled from one that is known, or has no disturbance.
    """
    written, sample_time = getattr(plant, "_made_from", (None, None))
    if type(written) is not DescriptorSystem or sample_time is None or not plant.nd or plant.dt != sample_time:
        return None
    if written.nx > MOST_STORED_STATES:
        # A design of it does not hold it: what is claimed has to be proved again from the design.
        return None
    smooth = eliminate_algebraic_states(written).plant
    same = smooth.nx == plant.nx and smooth.nd == plant.nd and np.array_equal(smooth.C, plant.C)
    return smooth if same else None


@remembered
def moving_columns(plant: DescriptorSystem, behind: DescriptorSystem | None = None) -> MovingColumns | None:
    """Return what disturbances of any time course put into the states in a sample; ``None`` where that is Bd d.

    Parameters
    ----------
    plant : DescriptorSystem
        Sampled by `obsynth.discretise`, or a spec with a sample time; of others nothing is known between samples.
    behind : DescriptorSystem, optional
        The plant in continuous time with the same states, where it is known otherwise; its disturbances are the first
        ones of ``plant``, whose others act from sample to sample.
    """
    smooth = continuous_behind(plant) if behind is None else behind
    if smooth is None or not smooth.Bd.any():
        return None
    judged = JUDGED_PIECES if plant.nx * smooth.nd <= MOST_ENTRIES else JUDGED_PIECES_OF_MANY
    a, bd = AffineMatrix.exact(smooth.A, 0), AffineMatrix.exact(smooth.Bd, 0)
    interval = interval_columns(a, bd, plant.dt, pieces=judged)
    radius = np.sum([block.radius for block in interval.blocks], axis=0)
    inverse = affine_inverse(AffineMatrix.exact(interval.directions, 0)).magnitude
    sizes = rounded_up(interval.rest + inverse @ radius, plant.nx + len(interval.blocks))
    sizes = np.where((interval.rest > 0.0) | (radius > 0.0), sizes, 0.0)
    pieces = next((pieces for most, pieces in RESTING_PIECES if smooth.nd <= most), FEWEST_PIECES)
    resting, shares = _resting(smooth, plant.dt, pieces)

    def of_all(columns: FloatArray) -> FloatArray:
        """Return columns with zeros for the disturbances that act from sample to sample."""
        blocks = columns.reshape(plant.nx, -1, smooth.nd)
        return np.pad(blocks, ((0, 0), (0, 0), (0, plant.nd - smooth.nd))).reshape(plant.nx, -1)

    columns = np.hstack([block.center for block in interval.blocks])
    moved = np.arange(plant.nd) < smooth.nd
    return MovingColumns(of_all(resting), shares, of_all(columns), interval.directions, of_all(sizes), moved)


def _resting(smooth: DescriptorSystem, dt: float, pieces: int) -> tuple[FloatArray, FloatArray]:
    """Return what a disturbance of one does that acts in one piece of a sample alone, newest piece first, and the
    shares of the pieces."""
    n, nd = smooth.nx, smooth.nd
    whole = np.vstack([np.hstack([smooth.A, smooth.Bd]), np.zeros((nd, n + nd))])
    levels = halvings(smooth.A, smooth.Bd, dt, pieces=pieces, times=MOST_RESTING_TIMES)
    shares = 2.0 ** -np.array(levels, dtype=np.float64)
    moves = {share: exponential(whole, dt * share).midpoint for share in set(shares.tolist())}
    columns, later = [], np.eye(n)
    for share in shares.tolist():
        columns.append(later @ moves[share][:n, n:])
        later = later @ moves[share][:n, :n]
    return np.hstack(columns), shares


def with_moving_disturbances(affine: AffinePlant) -> AffinePlant:
    """Return a sampled plant over its box with disturbances that move between samples: the columns that count them,
    and those of the values at the samples, which enter outputs.  Bounds go with `AffinePlant.disturbance_bounds`.

    Where no continuous plant is known it is returned as it is.
    """
    plant = affine.plant
    uncertain = plant.uncertainty
    if not plant.nd or plant.dt <= 0.0:
        return affine
    if uncertain is not None and any(kind == SAMPLED for kind, _ in uncertain.steps):
        reduced, basis = reduced_family(plant, uncertain, affine.box)
        a, bd = reduced["A"], reduced["Bd"]
    else:
        smooth = continuous_behind(plant)
        if smooth is None:
            return affine
        if not (affine.Bd.is_certain and affine.E.is_certain):
            raise PreconditionError(
                "Constants in E or Bd were given tolerances after the plant was sampled: between samples nothing is "
                "known of them. Give them in the continuous plant, or state disturbances that are held "
                "(disturbance: held).",
                condition="tolerances",
            )
        # Constants of the sampled plant act from sample to sample; in between it is the nominal one.
        basis = np.eye(plant.nx)
        a, bd = AffineMatrix.exact(smooth.A, affine.count), AffineMatrix.exact(smooth.Bd, affine.count)
    columns = interval_columns(a, bd, plant.dt)
    zero = AffineMatrix.exact(np.zeros((plant.nx, plant.nd)), affine.count)
    matrix = all_columns(columns, basis)
    blind = AffineMatrix.exact(np.zeros((plant.ny, matrix.shape[1])), affine.count)
    moved = {"Bd": affine_block([[matrix, zero]]), "Dd": affine_block([[blind, affine.Dd]])}
    return replace(affine, matrices={**affine.matrices, **moved}, blocks=len(columns.blocks), rest=columns.rest)


def all_columns(found: IntervalColumns, basis: FloatArray) -> AffineMatrix:
    """Return the columns ``(nx, k)`` of all blocks, then the directions of the rest, multiplied by a basis."""
    directions = AffineMatrix.exact(found.directions, found.blocks[0].count)
    return affine_block([[*(block.after(basis) for block in found.blocks), directions.after(basis)]])

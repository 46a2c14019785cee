"""Thresholds over a box for continuous designs on samples, for ``eps = z - Gamma_1 v - T x`` at these.

``eps+ = Az eps + (Az T + By C - T Phi) x + (Bu + By D - T Gamma) u + (By Dd d - T q) + By v``, q of d of any course;
what the brackets leave at the nominal plant acts like one more constant, ``sampling``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from obsynth.analysis.transformations.elimination import algebraic_coordinates, eliminate_algebraic_states
from obsynth.analysis.transformations.sampling import discretise
from obsynth.analysis.transformations.uncertain_plant import AffinePlant, reduced_family
from obsynth.errors import PreconditionError
from obsynth.experiments.monitors.adaptive_bound import Start
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.continuous import first_order_hold
from obsynth.observers.linear.derived import sample_observer
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.constants import ConstantsBox
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.uncertainty import ELIMINATED, Uncertainty
from obsynth.proofs.affine import AffineMatrix, affine_block, affine_zero_order_hold
from obsynth.proofs.balls import rounded_up
from obsynth.results.design import ObserverDesign
from obsynth.tolerances.exact_plant import Tracking, tracking_of

#: Pieces of an interval in which a disturbance has a sign of its own.
PIECES = 16
#: Covers the rounding of a matrix exponential in double precision, and of a few sums.
SERIES_SLACK, SUM_SLACK = 1.0 + 1e-9, 1.0 + 1e-12
#: The name under which what the sampled observer misses counts among the constants.
SAMPLING = "sampling"


class SampledProblem(NamedTuple):
    """The error system of a continuous design at the samples of its data."""

    affine: AffinePlant
    observer: LinearObserver
    tracking: Tracking
    bounds: FloatArray  # of all pieces
    reading: FloatArray  # ``(n, nx)``: the dynamic state from the plant's
    first: FloatArray  # ``(nz, nu)``: first inputs to eps at the start
    ramp: FloatArray
    unknown: FloatArray  # ``(nz,)``: first disturbance and noise to eps at the start, at most

    def start(self, known: Start, box: tuple[FloatArray, FloatArray] | None) -> Start:
        """Return what is known of eps at the start; ``box`` of the plant's state, middle and half width."""
        z, t = known.state, self.tracking.T
        if box is None:
            if known.stated and not self.affine.C.is_certain:
                raise PreconditionError(
                    "A constant with a tolerance is in C: the norm of the error at the start bounds too little; give "
                    "initial_set (--initial).", condition="start",
                )  # fmt: skip
            radius = self.unknown if known.stated else np.zeros(len(z))
            return Start(len(z), norm=known.norm, radius=radius, state=z)
        center, radius = self.reading @ box[0], np.abs(self.reading) @ box[1]
        moved = self.affine.C.spread + self.affine.C.radius
        seen = np.abs(self.ramp) @ (moved @ (np.abs(center) + radius))
        size = np.abs(t) @ radius + seen + self.unknown
        followed = (t + self.ramp @ self.affine.C.center) @ center
        far = np.abs(self.ramp) @ (np.abs(self.affine.C.center) @ radius)
        return Start(len(z), center=z - followed, radius=(size + far) * SUM_SLACK, state=z)


def sampled_problem(design: ObserverDesign, dt: float, bounds: FloatArray, noise_bound: float) -> SampledProblem:
    """Return the sampled error system of a continuous design; `PreconditionError` where there is none."""
    plant, observer = design.linear
    uncertain = plant.uncertainty if plant.uncertainty is not None else Uncertainty(ConstantsBox({}), {})
    if uncertain.box.variation == "varying":
        raise PreconditionError(
            "The constants may vary, and the design is continuous in time: between samples nothing is known of them. "
            "Sample the plant first (transform: sample_time), or state constants that stay the same.",
            condition="discrete time",
        )  # fmt: skip
    exact = AffinePlant(plant, uncertain.box, {}, np.eye(plant.nx))
    followed = tracking_of(design, exact).T
    reduced, basis = reduced_family(plant, uncertain)
    into = _dynamic(plant, uncertain)
    reading = (2.0 * np.eye(len(basis)) - basis) @ np.linalg.pinv(into)
    smooth = eliminate_algebraic_states(plant).plant
    back = 2.0 * np.eye(len(basis)) - basis
    moving, held = affine_zero_order_hold(reduced["A"], reduced["B"], dt)
    pieces = _pieces(reduced["A"], reduced["Bd"], dt)
    nd, nf = plant.nd, plant.nf
    zero = AffineMatrix.exact(np.zeros((len(basis), nd)), moving.count)
    blind = AffineMatrix.exact(np.zeros((plant.ny, nd * PIECES)), moving.count)
    bd, dd = affine_block([[*pieces, zero]]), affine_block([[blind, reduced["Dd"]]])
    bw, dw = _noise(smooth, back, dt)
    matrices = {
        "E": AffineMatrix.exact(np.eye(len(basis)), moving.count), "A": moving, "B": held, "C": reduced["C"],
        "D": reduced["D"], "Bd": bd, "Dd": dd, "Bf": AffineMatrix.exact(np.zeros((len(basis), nf)), moving.count),
        "Df": reduced["Df"],
    }  # fmt: skip
    offsets = uncertain.box.offsets
    sampled = DescriptorSystem(
        None, moving.at(offsets), held.at(offsets), C=reduced["C"].at(offsets), D=reduced["D"].at(offsets),
        Bd=bd.at(offsets), Dd=dd.at(offsets), Bw=bw, Dw=dw, dt=dt,
    )  # fmt: skip
    affine = AffinePlant(sampled, uncertain.box, matrices, np.eye(len(basis)))
    inputs = np.hstack([observer.Bu, observer.By])
    ramp = first_order_hold(observer.Az, inputs, dt)[2]
    through_u, through_y = ramp[:, : plant.nu], ramp[:, plant.nu :]
    t = followed @ plant.E @ into @ basis - through_y @ affine.C.center
    if plant.nu and not affine.D.is_certain:
        raise PreconditionError(
            "A constant with a tolerance is in D, and the design is continuous in time: sample the plant first "
            "(transform: sample_time).", condition="discrete time",
        )  # fmt: skip
    unknown = np.abs(through_y) @ (reduced["Dd"].magnitude @ bounds + np.abs(dw).sum(axis=1) * noise_bound)
    first = -(through_u + through_y @ affine.D.center)
    sizes = np.concatenate([np.tile(bounds, PIECES), bounds])
    empty = np.zeros((len(observer.Cz), len(basis)))
    return SampledProblem(
        affine, sample_observer(observer, dt), Tracking(t, empty), sizes, reading, first, through_y, unknown
    )


def _dynamic(plant: DescriptorSystem, uncertain: Uncertainty) -> FloatArray:
    """Return ``(nx, n)``: the plant's state from its dynamic part, the algebraic one left out."""
    if any(kind == ELIMINATED for kind, _ in uncertain.steps):
        return np.eye(plant.nx)
    return algebraic_coordinates(plant)[1]


def _pieces(a: AffineMatrix, bd: AffineMatrix, dt: float) -> list[AffineMatrix]:
    """Return what a disturbance of one sign does in each piece of an interval, newest first ``(n, nd)``.
    The remainder holds a change of sign inside a piece: at most a quarter of its length, squared, times the slope."""
    from scipy.linalg import expm

    width = dt / PIECES
    step, gathered = affine_zero_order_hold(a, bd, width)
    size = a.magnitude
    # ``exp(S)`` bounds ``sum_k S^k / (k + 1)!`` for ``S >= 0``.
    growth = np.eye(len(size)) + size * width @ (expm(size * width) * SERIES_SLACK)
    found, piece, value = [], gathered, bd
    for _ in range(PIECES):
        slope = size @ (growth @ value.magnitude)
        found.append(piece.enlarged(rounded_up(0.25 * width**2 * slope, 6)))
        piece, value = step @ piece, step @ value
    return found


def _noise(smooth: DescriptorSystem, back: FloatArray, dt: float) -> tuple[FloatArray, FloatArray]:
    """Return the noise of the plant gathered in a sample, and that of the sensors, as columns side by side."""
    process, sensors = smooth.Bw.any(axis=0), smooth.Dw.any(axis=0)
    if (process & sensors).any():
        raise PreconditionError("A noise drives the plant and a sensor at once, which is not known between samples.",
                                condition="noise")  # fmt: skip
    gathered = np.zeros((smooth.nx, 0))
    if process.any():
        whole = DescriptorSystem(None, smooth.A, C=np.eye(smooth.nx), Bw=smooth.Bw[:, process])
        gathered = back @ discretise(whole, dt).plant.Bw
    heard = smooth.Dw[:, sensors]
    return (
        np.hstack([gathered, np.zeros((smooth.nx, heard.shape[1]))]),
        np.hstack([np.zeros((smooth.ny, gathered.shape[1])), heard]),
    )

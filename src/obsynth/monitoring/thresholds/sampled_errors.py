"""The error system of a continuous design on samples, over the box of its plant's constants.

``eps = z - Gamma_1 v - T x`` obeys
``eps+ = Az eps + (Az T + By C - T Phi) x + (Bu + By D - T Gamma) u + (By Dd d - T q) + By v``, q of d of any time
profile; what the brackets leave at the nominal plant acts like one more constant, ``sampling``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from obsynth.errors import PreconditionError
from obsynth.methods.tracking import tracking_of
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.continuous import first_order_hold
from obsynth.observers.linear.observer import LinearObserver
from obsynth.observers.linear.sampled import sample_observer
from obsynth.plants.constants import ConstantsBox
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.transformations.elimination import algebraic_coordinates, eliminate_algebraic_states
from obsynth.plants.transformations.moving_disturbances import all_columns
from obsynth.plants.transformations.sampling import discretise
from obsynth.plants.transformations.uncertain_plant import AffinePlant, reduced_family
from obsynth.plants.uncertainty import ELIMINATED, Uncertainty
from obsynth.proofs.absolute_integrals import interval_columns
from obsynth.proofs.affine import AffineMatrix, affine_block, affine_zero_order_hold
from obsynth.results.design import ObserverDesign
from obsynth.verification.over_tolerances.adaptive_bound import Start
from obsynth.verification.over_tolerances.error_structure import Tracking

#: Covers the rounding of a few sums.
SUM_SLACK = 1.0 + 1e-12

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

    def start(self, stated: Start, box: tuple[FloatArray, FloatArray] | None) -> Start:
        """Return what is known of eps at the start; ``box`` of the plant's state, middle and half width."""
        z, t = stated.state, self.tracking.T
        if box is None:
            if stated.stated and not self.affine.C.is_certain:
                raise PreconditionError(
                    "A constant with a tolerance is in C: the norm of the error at the start bounds too little; give "
                    "initial_set (--initial).",
                    condition="start",
                )
            radius = self.unknown if stated.stated else np.zeros(len(z))
            return Start(len(z), norm=stated.norm, radius=radius, state=z)
        center, radius = self.reading @ box[0], np.abs(self.reading) @ box[1]
        moved = self.affine.C.spread + self.affine.C.radius
        through_outputs = np.abs(self.ramp) @ (moved @ (np.abs(center) + radius))
        size = np.abs(t) @ radius + through_outputs + self.unknown
        followed = (t + self.ramp @ self.affine.C.center) @ center
        far = np.abs(self.ramp) @ (np.abs(self.affine.C.center) @ radius)
        return Start(len(z), center=z - followed, radius=(size + far) * SUM_SLACK, state=z)


def sampled_problem(design: ObserverDesign, dt: float, bounds: FloatArray, noise_bound: float) -> SampledProblem:
    """Return the sampled error system of a continuous design; `PreconditionError` where there is none."""
    plant, observer = design.linear
    uncertain = plant.uncertainty if plant.uncertainty is not None else Uncertainty(ConstantsBox({}), {})
    if uncertain.box.variation == "varying":
        raise PreconditionError(
            "The constants may vary, and the design is continuous in time: their values between samples have no "
            "bound. Sample the plant first (transform: sample_time), or state constants that stay the same.",
            condition="discrete time",
        )
    exact = AffinePlant(plant, uncertain.box, {}, np.eye(plant.nx))
    followed = tracking_of(design, exact).T
    reduced, basis = reduced_family(plant, uncertain)
    # The plant's state from its dynamic part, the algebraic one left out.
    is_eliminated = any(kind == ELIMINATED for kind, _ in uncertain.steps)
    into = np.eye(plant.nx) if is_eliminated else algebraic_coordinates(plant)[1]
    back = 2.0 * np.eye(len(basis)) - basis
    reading = back @ np.linalg.pinv(into)
    affine, dw = _sampled_plant(plant, uncertain, reduced, back, dt)
    inputs = np.hstack([observer.Bu, observer.By])
    ramp = first_order_hold(observer.Az, inputs, dt)[2]
    through_u, through_y = ramp[:, : plant.nu], ramp[:, plant.nu :]
    t = followed @ plant.E @ into @ basis - through_y @ affine.C.center
    if plant.nu and not affine.D.is_certain:
        raise PreconditionError(
            "A constant with a tolerance is in D, and the design is continuous in time: sample the plant first "
            "(transform: sample_time).",
            condition="discrete time",
        )
    unknown = np.abs(through_y) @ (reduced["Dd"].magnitude @ bounds + np.abs(dw).sum(axis=1) * noise_bound)
    first = -(through_u + through_y @ affine.D.center)
    sizes = affine.disturbance_bounds(bounds)
    empty = np.zeros((len(observer.Cz), len(basis)))
    return SampledProblem(
        affine, sample_observer(observer, dt), Tracking(t, empty), sizes, reading, first, through_y, unknown
    )


def _sampled_plant(
    plant: DescriptorSystem, uncertain: Uncertainty, reduced: Mapping[str, AffineMatrix], back: FloatArray, dt: float
) -> tuple[AffinePlant, FloatArray]:
    """Return the sampled plant over the box, disturbances gathered between samples, and what noise does to its outputs
    ``(ny, any)``; ``reduced``: the plant without algebraic states, ``back (n, n)``: into its own coordinates."""
    smooth = eliminate_algebraic_states(plant).plant
    moving, held = affine_zero_order_hold(reduced["A"], reduced["B"], dt)
    columns = interval_columns(reduced["A"], reduced["Bd"], dt)
    gathered = all_columns(columns, np.eye(len(back)))
    nd, nf = plant.nd, plant.nf
    zero = AffineMatrix.exact(np.zeros((len(back), nd)), moving.count)
    blind = AffineMatrix.exact(np.zeros((plant.ny, gathered.shape[1])), moving.count)
    bd, dd = affine_block([[gathered, zero]]), affine_block([[blind, reduced["Dd"]]])
    bw, dw = _noise(smooth, back, dt)
    matrices = {
        "E": AffineMatrix.exact(np.eye(len(back)), moving.count),
        "A": moving,
        "B": held,
        "C": reduced["C"],
        "D": reduced["D"],
        "Bd": bd,
        "Dd": dd,
        "Bf": AffineMatrix.exact(np.zeros((len(back), nf)), moving.count),
        "Df": reduced["Df"],
    }
    offsets = uncertain.box.offsets
    sampled = DescriptorSystem(
        None,
        moving.at(offsets),
        held.at(offsets),
        C=reduced["C"].at(offsets),
        D=reduced["D"].at(offsets),
        Bd=bd.at(offsets),
        Dd=dd.at(offsets),
        Bw=bw,
        Dw=dw,
        dt=dt,
    )
    affine = AffinePlant(
        sampled, uncertain.box, matrices, np.eye(len(back)), blocks=len(columns.blocks), rest=columns.rest
    )
    return affine, dw


def _noise(smooth: DescriptorSystem, back: FloatArray, dt: float) -> tuple[FloatArray, FloatArray]:
    """Return the noise of the plant gathered in a sample, and that of the sensors, as columns side by side."""
    process, sensors = smooth.Bw.any(axis=0), smooth.Dw.any(axis=0)
    if (process & sensors).any():
        raise PreconditionError(
            "One noise acts on the plant and on a sensor, which has no model between samples.", condition="noise"
        )
    gathered = np.zeros((smooth.nx, 0))
    if process.any():
        process_only = DescriptorSystem(None, smooth.A, C=np.eye(smooth.nx), Bw=smooth.Bw[:, process])
        gathered = back @ discretise(process_only, dt).plant.Bw
    measurement_noise = smooth.Dw[:, sensors]
    return (
        np.hstack([gathered, np.zeros((smooth.nx, measurement_noise.shape[1]))]),
        np.hstack([np.zeros((smooth.ny, gathered.shape[1])), measurement_noise]),
    )

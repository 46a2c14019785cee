r"""The residual of a continuous observer at the samples of its data.

Between samples the observer takes known inputs and outputs as straight lines.  As far as they are, its state at the
samples is that of the observer in continuous time; the noise of a sample is a sample like any other, and goes through
the sampled observer.  With ``e = V E x - z``, held disturbances d, process noise gathered over an interval, and sensor
noise n,

    e+ = Phi e + Gamma d + w - By_h n,   r = -C e + Dd d + Dy_h n

and the noise of the first sample is in the start as well, ``e(0) = V E x(0) - z(0) + Gamma_1 n(0)``, as the state that
is kept is ``z - Gamma_1 v``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from obsynth.analysis.transformations import discretise
from obsynth.errors import SpecError
from obsynth.methods.pd_observer.augmentation import with_faults_as_states
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.holds import first_order_hold
from obsynth.observers.linear.observer import LinearObserver
from obsynth.observers.linear.sampling import sample_observer
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.results.design import ObserverDesign
from obsynth.verification.error_system import ErrorSystem


@dataclass(frozen=True, eq=False)
class TrackedErrors:
    """The error system of a design, with what its error is at a start.

    Fields: errors: In the plant's own time; tracking: ``V (nz, nx)``, of the newest state.
    """

    errors: ErrorSystem
    tracking: FloatArray


def tracked_errors(design: ObserverDesign, plant: DescriptorSystem) -> TrackedErrors:
    """Return the error system of a linear design on its plant with some noise."""
    observer, matrices = design.linear[1], design.certificate.matrices
    if not observer.residual_names:
        raise SpecError(f"Design {design.name!r} has no residual to watch.", path="observer")
    if design.method == "pd-observer":
        # The observer's state is that of the plant with its faults as states.
        tracking = np.eye(plant.nx + plant.nf)
        return TrackedErrors(
            ErrorSystem.of(with_faults_as_states(plant), observer, tracking, 0), tracking[:, : plant.nx]
        )
    if "tracking" not in matrices:
        raise SpecError(f"Design {design.name!r} has no tracking map: its residual has no model.", path="observer")
    # A fault model's states come after the plant's own in the map; they track no fault here.
    tracking = matrices["tracking"][:, : plant.nx] if "Phi" in matrices else matrices["tracking"]
    lag = tracking.shape[1] // plant.nx - 1
    return TrackedErrors(ErrorSystem.of(plant, observer, tracking, lag), tracking[:, : plant.nx])


@dataclass(frozen=True, eq=False)
class SampledErrors:
    """The recursion of the module's text; w is noise of unit covariance, sensors first.

    Fields: A, Bd, Bw: Of the error; sensor_outputs: ``Dy_h Dw``: what the noise of a sample adds to states, faults and
    residuals at once; start: ``(n, sensors)``: what the noise of the first sample adds to the start; gathered: How many
    noise signals come after those of the sensors.
    """

    A: FloatArray
    Bd: FloatArray
    Bw: FloatArray
    sensor_outputs: FloatArray
    start: FloatArray
    gathered: int

    def direct(self, rows: slice) -> FloatArray:
        """Return the direct effect of all noise on some rows of output."""
        shown = self.sensor_outputs[rows]
        return np.hstack([shown, np.zeros((len(shown), self.gathered))])


def sampled_errors(plant: DescriptorSystem, observer: LinearObserver, found: TrackedErrors, dt: float) -> SampledErrors:
    """Return the error of a continuous observer from sample to sample."""
    process, sensors = plant.Bw.any(axis=0), plant.Dw.any(axis=0)
    if (process & sensors).any():
        raise SpecError("A noise drives the plant and a sensor at once, which is not known between samples: state two.",
                        path="noise")  # fmt: skip
    held = sample_observer(observer, dt)
    transition, gathered_d, _ = first_order_hold(observer.Az, found.errors.disturbance, dt)
    driven = found.errors.noise[:, process]
    whole = DescriptorSystem(None, observer.Az, C=np.eye(observer.order), Bw=driven)
    gathered = discretise(whole, dt).plant.Bw
    heard = plant.Dw[:, sensors]
    ramp = first_order_hold(observer.Az, observer.By, dt)[2]
    return SampledErrors(
        transition, gathered_d, np.hstack([-held.By @ heard, gathered]), held.Dy @ heard, ramp @ heard,
        gathered.shape[1],
    )  # fmt: skip

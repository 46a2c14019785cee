"""Steps of a recursive observer over intervals of any length, from the continuous plant.

A filter on samples of one length has one transition and one covariance of the process noise. Over another interval both
follow from the continuous plant, and a filter with these takes that step: the state of the recursion is the same.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from obsynth.analysis.existence.kalman import without_unknown_inputs
from obsynth.analysis.time_varying import as_time_varying
from obsynth.errors import PreconditionError, SpecError
from obsynth.numerics.arrays import FloatArray, as_matrix
from obsynth.numerics.continuous import zero_order_hold
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.observers.recursive.settings import Adaptation
from obsynth.plants.dead_times import delays_in_words
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.sequences import MatrixSequence
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem
from obsynth.plants.transformations.elimination import eliminate_algebraic_states
from obsynth.plants.transformations.sampling import discretise, gathered_noise

#: Intervals that are kept: of a log whose stamps are rounded few differ.
MOST_KEPT = 4096

#: Matrices that sampling finds again agree to this share of the largest entry.
SAME_MODEL = 1e-9

_MATRICES = ("E", "A", "B", "C", "Phi", "Psi")


class IrregularSteps:
    """The observer of each interval, made when it is first needed.

    Process noise is that of the continuous plant where the observer has it from there; a covariance that was given for
    one sample grows in proportion to the interval, as that of white noise does over short ones. The noise of a reading
    is the same after any interval. A forgetting factor is per sampling time of the design.

    Parameters
    ----------
    observer : RecursiveObserver
        On samples of ``observer.dt`` seconds.
    written : DescriptorSystem
        The continuous plant.

    Raises
    ------
    SpecError
        The observer does not follow from that plant, or has options that count samples.
    """

    def __init__(self, observer: RecursiveObserver, written: DescriptorSystem) -> None:
        self.observer, self._smooth = observer, eliminate_algebraic_states(written).plant
        self._kept: dict[float, RecursiveObserver] = {}
        if written.delays:
            raise SpecError(
                f"the plant has delays ({delays_in_words(written.delays)}), and samples on their way are of one length",
                path="delays",
            )
        if not (observer.sensors is None and observer.Q.is_constant and observer.R.is_constant):
            raise SpecError("sensors that are sampled every so many rows, or varying Q and R, count samples", path="Q")
        sampled = discretise(self._smooth, observer.dt).plant
        model, own = without_unknown_inputs(sampled).plant if sampled.nd else as_time_varying(sampled), observer.plant
        noise = self._sampled(observer.dt)[1]
        if not own.is_time_invariant or own.state_names != model.state_names or not _agree(own, model):
            raise SpecError("its model is not what sampling makes of the continuous plant", path="plant")
        self._is_physical = _near(noise, observer.Q.at(0))
        if not self._is_physical and written.nd:
            raise SpecError(
                "Q was given for equations without the unknown inputs, which change with the interval", path="Q"
            )

    def over(self, seconds: float) -> RecursiveObserver:
        """Return the observer whose next step takes so many seconds."""
        observer = self._kept.get(seconds)
        if observer is None:
            if len(self._kept) >= MOST_KEPT:
                self._kept.clear()
            observer = self._kept[seconds] = self._made(seconds)
        return observer

    def _made(self, seconds: float) -> RecursiveObserver:
        observer, share = self.observer, seconds / self.observer.dt
        model, noise = self._sampled(seconds)
        if model.ne != observer.plant.ne or model.state_names != observer.plant.state_names:
            raise PreconditionError(
                f"Over {seconds:g} s the plant has another number of equations than over {observer.dt:g} s.",
                condition="sampling",
            )
        covariance = noise if self._is_physical else observer.Q.at(0) * share
        return replace(
            observer,
            plant=model,
            Q=MatrixSequence.of(covariance, "Q"),
            adaptation=_over(observer.adaptation, share),
        )

    def _sampled(self, seconds: float) -> tuple[TimeVaryingDescriptorSystem, FloatArray]:
        """Return the model of a step, and the covariance of its process noise."""
        smooth = self._smooth
        if not smooth.nd:
            signals = np.hstack([smooth.B, smooth.Bf])
            transition, held = zero_order_hold(smooth.A, signals, seconds)
            factor = gathered_noise(smooth.A, smooth.Bw, seconds)
            B, Phi = np.split(held, [smooth.nu], axis=1)
            return self.observer.plant.replace(A=transition, B=B, Phi=Phi, dt=seconds), factor @ factor.T
        plant = discretise(smooth, seconds).plant
        reduced = without_unknown_inputs(plant)
        return reduced.plant, as_matrix(reduced.process_covariance(plant.Bw @ plant.Bw.T), "Q")


def _over(adaptation: Adaptation | None, share: float) -> Adaptation | None:
    """Return how parameters are learned over ``share`` of a sampling time."""
    if adaptation is None:
        return None
    return replace(adaptation, forgetting=adaptation.forgetting**share, walk=adaptation.walk * share)


def _agree(own: TimeVaryingDescriptorSystem, model: TimeVaryingDescriptorSystem) -> bool:
    return all(_near(getattr(own, name).at(1), getattr(model, name).at(1)) for name in _MATRICES)


def _near(first: FloatArray, second: FloatArray) -> bool:
    if first.shape != second.shape:
        return False
    return bool(np.all(np.abs(first - second) <= SAME_MODEL * np.max(np.abs(first), initial=0.0)))

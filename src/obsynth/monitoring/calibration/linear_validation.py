"""The Kalman filter of the plant of a linear design, by whose innovations a log is compared with the design.

Residuals of a linear observer are coloured by the observer itself, and not all of them show all noise.  The plant that
the design was made for has innovations: those of its Kalman filter, with the stated noise, no fault, and unknown
disturbances that may be anything.  Where the log starts is not known: the filter runs once, and again with a start that
may be as far off as its states have been.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from obsynth.errors import SpecError
from obsynth.monitoring.calibration.diagnostics import Consistency, SensorValidation
from obsynth.monitoring.calibration.explanations import Explanation
from obsynth.monitoring.calibration.hidden_motions import kalman_filter_of_what_shows
from obsynth.monitoring.calibration.logs import RecordedLog
from obsynth.monitoring.logs.log_run import LogRun
from obsynth.monitoring.logs.unit_check import UnitCheck
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.suggestions import quoted_names
from obsynth.observers.changed_options import changed
from obsynth.observers.linear.observer import LinearObserver
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.noise import is_noise_assumed
from obsynth.plants.transformations.sampling import discretise
from obsynth.results.design import ObserverDesign

#: The deviation of a start in that of what a state has been in the log: it may be as far off on the other side.
START_DEVIATIONS = 2.0

#: A mean square of innovations further from one than this factor is reported: nobody knows a variance better.
REPORTED_FACTOR = 1.5


def is_linear(design: ObserverDesign) -> bool:
    """Whether the observer of a design is linear with constant gains."""
    return isinstance(design.observer, LinearObserver)


def filter_of_linear_plant(
    design: ObserverDesign, log: RecordedLog, states_of: Callable[[ObserverDesign], FloatArray]
) -> ObserverDesign:
    """Return the Kalman filter of the plant of a linear design on the grid of a log, with a start that may be as far
    off as the states have been; ``states_of`` runs a design and returns these ``(n, nx)``."""
    plant = design.linear[0]
    _require_sensor_noise(design, plant)
    if not plant.is_discrete:
        plant = discretise(plant, log.dt).plant
    made = kalman_filter_of_what_shows(plant, name=design.name)
    observer = made.observer
    if not isinstance(observer, RecursiveObserver):
        raise TypeError(f"{type(observer).__name__} is no recursion")
    states = states_of(made)
    reached = np.nanmax(np.abs(np.where(np.isfinite(states), states, np.nan)), axis=0, initial=0.0)
    covariance = np.asarray(observer.initial_covariance) + np.diag((START_DEVIATIONS * reached) ** 2)
    return made.replace(observer=changed(observer, initial_covariance=covariance))


def _require_sensor_noise(design: ObserverDesign, plant: DescriptorSystem) -> None:
    """Raise `SpecError` where no noise of the sensors is stated, so that a log can contradict none."""
    if not plant.nw or is_noise_assumed(plant.noise_names):
        raise SpecError(
            f"No noise is stated for the plant of {design.name!r}, so that no innovation of a log has a size that is "
            "expected: state that of the sensors (sensor_noise in the spec or of the plant; calibrate finds it), and "
            "design again.",
            path="design",
        )
    silent = [name for name, row in zip(plant.output_names, plant.Dw, strict=True) if not row.any()]
    if len(silent) == plant.ny and not plant.Bw.any():
        raise SpecError(
            f"The noise of {silent[0]} is zero: an exact measurement is contradicted by any log.", path="design"
        )


def sentences_on_sizes(
    sensors: Mapping[str, SensorValidation], total: Consistency, explained: Sequence[Explanation]
) -> list[str]:
    """Return a sentence for each sensor whose innovations are of another size than the stated noise makes them; none
    where what explains their colour best explains the ``total`` size, too."""
    gain = max((nats for _, nats in explained), default=0.0)
    remaining = total.value * float(np.exp(-2.0 * gain / max(total.samples, 1)))
    if explained and total.value > 1.0 and remaining < REPORTED_FACTOR:
        return []
    return [
        f"The innovations of {name} are {np.sqrt(nis.value):.2g} times what the stated noise makes them: it is too "
        f"{'small' if nis.value > 1.0 else 'large'} there{' or a constant is wrong' if nis.value > 1.0 else ''}."
        for name, nis in ((name, sensor.nis) for name, sensor in sensors.items())
        if nis.samples and not nis.holds and max(nis.value, 1.0 / nis.value) > REPORTED_FACTOR
    ]


def sentences_on_units(design: ObserverDesign, log: RecordedLog) -> list[str]:
    """Return that a signal is likely in another unit, where the first rows of a log say so."""
    signals = replace(LogRun(design).signals, in_header=dict(log.header_units))
    units = UnitCheck(design, signals)
    explained = units.explanation(np.hstack([log.measured_inputs, log.y]) - signals.offset)
    return [] if explained is None else [f"{units.words(*explained)}."]


def notes_on_disturbances(design: ObserverDesign, sensors: Mapping[str, SensorValidation]) -> list[str]:
    """Return what unknown disturbances of a linear design leave open."""
    names = design.linear[0].disturbance_names if is_linear(design) else ()
    if not names:
        return []
    together = [name for name, sensor in sensors.items() if not sensor.nis.samples]
    unpredicted = (
        f" By {'itself' if len(together) == 1 else 'themselves'} {quoted_names(together)} cannot be predicted; what "
        "the disturbances leave of all outputs together is in the NIS."
        if together
        else ""
    )
    one = len(names) == 1
    explained = f"{'' if one else 's'} {quoted_names(names)} {'explains' if one else 'explain'}"
    return [f"What the unknown disturbance{explained} is not counted as a disagreement.{unpredicted}"]

"""Bounds of the plant's state over a record without a fault since its start: the observer run again, and its error."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from obsynth.analysis.transformations.uncertain_plant import AffinePlant, affine_plant
from obsynth.errors import SpecError
from obsynth.experiments.alarm_proofs.window import OUTWARD, WindowData
from obsynth.experiments.monitors.adaptive_bound import adaptive_bound
from obsynth.experiments.monitors.adaptive_monitor import start_of
from obsynth.experiments.monitors.adaptive_record import thresholds_of_records
from obsynth.numerics.arguments import is_finite_number
from obsynth.numerics.arrays import FloatArray
from obsynth.results.design import ObserverDesign
from obsynth.tolerances.robustness import structure_of
from obsynth.tolerances.tracking import tracking_of

#: Where the bounds of the state come from.
REPLAY, STATED = "replay from the start", "stated"


def window_data(
    design: ObserverDesign, u: FloatArray, y: FloatArray, length: int, *, bounds: FloatArray, noise_bound: float,
    initial_set: Mapping[str, Any] | None, state_bounds: Mapping[str, Any] | None,
) -> tuple[AffinePlant, WindowData, str]:  # fmt: skip
    """Return the plant over its box, the last ``length`` samples with bounds of the state, and where these come from.

    States are those of `AffinePlant.coordinates`.
    """
    affine = affine_plant(design.linear[0])
    first = max(0, len(y) - length)
    if initial_set is None:
        low, high = _stated(affine, state_bounds or {}, len(y) - first)
        return affine, WindowData(u[first:], y[first:], low, high), STATED
    _, observer = design.linear
    tracking = tracking_of(design, affine)
    structure = structure_of(
        design, affine, tracking, bounds=bounds, noise_bound=noise_bound, faults=False, states=True
    )
    start = start_of(affine, tracking, None, initial_set, np.zeros(observer.order))
    bound = adaptive_bound(structure, observer, start, varying=affine.box.variation == "varying")
    estimates = observer.run(y, u if u.shape[1] else None)
    rows = np.hstack([estimates.states, estimates.faults, estimates.residuals])
    read = rows @ structure.reading.T
    found = thresholds_of_records(bound, read[None], u[None], y[None])
    middle = read - found.shift[0]
    width = (found.total - np.abs(found.shift))[0] + OUTWARD * (np.abs(read) + found.total[0])
    low, high = (middle - width)[first:], (middle + width)[first:]
    return affine, WindowData(u[first:], y[first:], low, high), REPLAY


def _stated(affine: AffinePlant, given: Mapping[str, Any], steps: int) -> tuple[FloatArray, FloatArray]:
    names = affine.plant.state_names
    missing = [name for name in names if name not in given]
    if missing:
        raise SpecError(f"Nothing bounds the state {missing[0]!r}: give initial_set (--initial), or its bound.",
                        path="initial_set")  # fmt: skip
    sizes = []
    for name in names:
        if not (is_finite_number(given[name]) and given[name] >= 0.0):
            raise SpecError(f"The bound of {name!r} is {given[name]!r}: give a number, 0 or more.", path="state_bounds")
        sizes.append(float(given[name]))
    back = np.abs(2.0 * np.eye(len(names)) - affine.coordinates) @ np.array(sizes)
    high = np.tile(back, (steps, 1))
    return -high, high

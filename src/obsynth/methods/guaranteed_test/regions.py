"""The assumptions of the threshold of a nonlinear plant: its region, and the bound on the linearisation remainder."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from obsynth.errors import ObsynthError
from obsynth.plants.constants import shown
from obsynth.plants.dae import DAEModel
from obsynth.plants.transformations.remainders import bounded_model
from obsynth.results.checks import Check, upper_bound_check
from obsynth.results.design import ObserverDesign


def while_inside(design: ObserverDesign) -> str:
    """Return the region of a design in words; empty for linear plants."""
    region, model = (design.options.get(name) for name in ("region", "model"))
    if not region or model is None:
        return ""
    units = model["units"]
    ranges = [
        f"{name} stays within {shown(low)} to {shown(high, units.get(name, ''))}"
        for name, (low, high) in region.items()
    ]
    return f", while {', '.join(ranges)}, between samples too"


def remainder_check(design: ObserverDesign, read: Callable[[Mapping[str, Any]], Any]) -> Check:
    """Return the row on what the linear model leaves out of the nonlinear one in the region, bounded again."""
    plant, _ = design.linear
    reason, worst = "", np.inf
    try:
        options = read(design.options)
        own = [name for name in plant.disturbance_names if name in options.model["inputs"]]
        _, bounds = bounded_model(
            DAEModel(**options.model),
            options.region,
            options.sample_time,
            faults=plant.fault_names,
            disturbances=own,
            given=options.given,
            shipped=plant,
        )
        fits = plant.disturbance_names[len(own) :] == tuple(bounds) and plant.dt == options.sample_time
        ratios = [value / max(options.disturbance_bounds[name], np.finfo(float).tiny) for name, value in bounds.items()]
        worst = max(ratios) if fits and _represents_remainder(design, len(own)) else np.inf
    except (ObsynthError, ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        reason = str(error)
    return upper_bound_check(
        "remainder",
        "the remainder of the linear model is within the bounds of the disturbances that represent "
        f"it{while_inside(design)}",
        worst,
        1.0,
        source="affine arithmetic over the region; the exponential's series with its remainder",
        kind="proved",
        detail=reason or "the largest ratio of what is proved to what is shipped",
    )


def _represents_remainder(design: ObserverDesign, own: int) -> bool:
    """Whether the last disturbances are one for each state and each output, and nothing else is uncertain."""
    plant, _ = design.linear
    nx, ny = plant.nx, plant.ny
    into = np.hstack([np.eye(nx), np.zeros((nx, ny))])
    onto_outputs = np.hstack([np.zeros((ny, nx)), np.eye(ny)])
    same = np.array_equal(plant.Bd[:, own:], into) and np.array_equal(plant.Dd[:, own:], onto_outputs)
    return bool(same and np.array_equal(plant.E, np.eye(nx)))

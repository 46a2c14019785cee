"""Options that refer to equations and states as written, restated for the proper form of a plant of reduced index.

Process noise with covariance Q enters the equations as written.  It is carried through the reduction as any signal is:
the proper form's Q is that of the noise that arrives, exactly.  What is stated of the states is that of the free ones.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from obsynth.errors import ObsynthError, SpecError
from obsynth.methods.method import Method
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.ranks import covariance_factor
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.transformations.elimination import eliminate_algebraic_states
from obsynth.plants.transformations.recovery import Transformation

#: What is stated of the states as written, besides Q: values of the free ones are taken out of it.
_OF_STATES = ("initial_state", "initial_covariance")

_PATH = "method.options.Q"


def method_for_proper_form(
    plant: DescriptorSystem, step: Transformation, method: Method
) -> tuple[Method, tuple[str, ...]]:
    """Return the method with its options for the plant that a step made, and what was done to them."""
    reduced, free = step.plant, ", ".join(step.plant.state_names)
    options: dict[str, Any] = {}
    places = [plant.state_names.index(name) for name in reduced.state_names if name in plant.state_names]
    if len(places) < reduced.nx:
        return method, ()
    q = _of_size(getattr(method, "Q", None), (plant.nx, plant.nx))
    if q is not None:
        options["Q"] = _arriving_noise(plant, reduced, q)
    for name in _OF_STATES:
        shape = (plant.nx,) if name == "initial_state" else (plant.nx, plant.nx)
        value = _of_size(getattr(method, name, None), shape)
        if value is not None:
            options[name] = value[np.ix_(*(places for _ in shape))]
    if not options:
        return method, ()
    parts = []
    if "Q" in options:
        parts.append("Q, of the equations as written, is that of the noise which arrives at these")
    others = " and ".join(name for name in options if name != "Q")
    if others:
        parts.append(f"of {others} what is stated of these is taken")
    return replace(method, **options), (f"The free states are {free}: {'; '.join(parts)}.",)


def _of_size(value: Any, shape: tuple[int, ...]) -> FloatArray | None:
    """Return a constant option as an array where it is one of this shape; ``None`` for any other."""
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        return None
    return array if array.shape == shape and np.all(np.isfinite(array)) else None


def _arriving_noise(plant: DescriptorSystem, reduced: DescriptorSystem, q: FloatArray) -> FloatArray:
    """Return the covariance of what noise in the equations of a plant drives the free states with."""
    arriving = _driven(plant, reduced, covariance_factor(q, "Q"))
    if arriving is not None:
        return arriving
    free = f"{reduced.nx} by {reduced.nx}, of {', '.join(reduced.state_names)}"
    proper = [row for row in range(plant.nx) if _driven(plant, reduced, np.eye(plant.nx)[:, [row]]) is not None]
    together = np.eye(plant.nx)[:, proper]
    if proper and _driven(plant, reduced, together) is not None:
        rows = ", ".join(str(row + 1) for row in proper)
        one = len(proper) == 1
        instead = f"Of noise in equation{'' if one else 's'} {rows} alone it is taken. Give zeros elsewhere, or Q"
    else:
        instead = "Give Q"
    raise SpecError(
        f"Q is {plant.nx} by {plant.nx}, of the equations as written, but the plant was reduced: noise in constraints, "
        f"or in states that they fix, would be needed at another time, or reaches outputs at once. {instead} of the "
        f"free states, {free}.",
        path=_PATH,
    )


def _driven(plant: DescriptorSystem, reduced: DescriptorSystem, root: FloatArray) -> FloatArray | None:
    """Return the covariance in the free states of noise in the equations with this root; ``None`` where it is needed
    at another time, or reaches outputs or free states at once."""
    free = np.eye(plant.nx)[[plant.state_names.index(name) for name in reduced.state_names]]
    c = np.vstack([plant.C, free])
    alone = DescriptorSystem(
        plant.E, plant.A, C=c, Bw=root, Dw=np.zeros((len(c), root.shape[1])), dt=plant.dt, state_names=plant.state_names
    )
    try:
        driven = eliminate_algebraic_states(alone).plant
    except ObsynthError:
        return None
    if driven.state_names != reduced.state_names or (driven.nw and driven.Dw.any()):
        return None
    return np.asarray(driven.Bw @ driven.Bw.T) if driven.nw else np.zeros((reduced.nx, reduced.nx))

"""What would make a refused design possible: sensors to add, or what to leave out; found by asking again."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from obsynth.analysis.conditions import Condition
from obsynth.analysis.diagnosis.explanations import least_additions, listed, state_sensors
from obsynth.errors import ObsynthError, PreconditionError
from obsynth.methods.method_spec import MethodSpec
from obsynth.plants.descriptor import DescriptorSystem

#: Plants with more states are not searched for pairs, and those with more still not at all.
MOST_FOR_PAIRS, MOST_FOR_ONE = 16, 48
#: Conditions on the kind of plant, whose messages say what to do: no sensor changes it.
OF_THE_KIND = ("continuous time", "discrete time", "plant of this kind")


def with_advice(
    error: PreconditionError, plant: DescriptorSystem, method: MethodSpec, options: Mapping[str, Any]
) -> PreconditionError:
    """Return the refusal with what would help at its end; as it is where the existence conditions hold."""
    holds = _asker(method, options)
    if holds(plant):
        return error
    sets = least_additions(plant, state_sensors(plant), holds, most=(MOST_FOR_ONE, MOST_FOR_PAIRS))
    if sets:
        text = f"Add one of: {listed(sets)}."
    elif drops := _drops(plant, holds):
        text = f"Leave out one of: {', '.join(drops)}."
    elif error.condition in OF_THE_KIND:
        return error
    else:
        text = _nothing(plant)
    return PreconditionError(
        f"{error} {text}", condition=error.condition, mode=error.mode, signals=error.signals, add=sets
    )


def _asker(method: MethodSpec, options: Mapping[str, Any]) -> Callable[[DescriptorSystem], bool]:
    """Return what says whether all existence conditions of a method hold for a plant."""
    judge: Callable[..., Sequence[Condition]] = method.load("conditions")
    known = set(inspect.signature(judge).parameters)
    given = {name: value for name, value in options.items() if name in known}
    if "exactly" in known:
        # What would help is told to be tried, not proved: the tried plant is decided exactly then.
        given["exactly"] = False

    def holds(plant: DescriptorSystem) -> bool:
        try:
            return all(condition.holds for condition in judge(plant, **_fitting(given, plant)))
        except (ObsynthError, np.linalg.LinAlgError):
            return False

    return holds


def _fitting(given: Mapping[str, Any], plant: DescriptorSystem) -> dict[str, Any]:
    """Return options without the faults that a plant no longer has."""
    faults = given.get("faults")
    if faults is None or isinstance(faults, str):
        return dict(given)
    return {**given, "faults": [name for name in faults if name in plant.fault_names]}


def _drops(plant: DescriptorSystem, holds: Callable[[DescriptorSystem], bool]) -> list[str]:
    """Return the unknown inputs and faults without any one of which the design exists."""
    if plant.nx > MOST_FOR_ONE:
        return []
    found = []
    for i, name in enumerate(plant.disturbance_names):
        rest = [j for j in range(plant.nd) if j != i]
        fewer = plant.replace(
            Bd=plant.Bd[:, rest], Dd=plant.Dd[:, rest], disturbance_names=[plant.disturbance_names[j] for j in rest],
            units={}, operating_point={},
        )  # fmt: skip
        if holds(fewer):
            found.append(f"unknown input {name}")
    for i, name in enumerate(plant.fault_names if plant.nf > 1 else ()):
        rest = [j for j in range(plant.nf) if j != i]
        fewer = plant.replace(
            Bf=plant.Bf[:, rest], Df=plant.Df[:, rest], fault_names=[plant.fault_names[j] for j in rest], units={},
            operating_point={},
        )  # fmt: skip
        if holds(fewer):
            found.append(f"fault {name}")
    return found


def _nothing(plant: DescriptorSystem) -> str:
    if plant.nx > MOST_FOR_ONE:
        return f"With {plant.nx} states, ask obsynth.sensor_sets which sensors would help."
    return "No state measured besides, and no unknown input or fault left out, would help."

"""Conditions and synthesis: with C = I the gain A - pole I leaves the error nothing but the pole."""

from collections.abc import Callable
from typing import Any

import numpy as np

from luenberger_method.options import LuenbergerOptions
from obsynth.analysis.conditions import Condition, require_all
from obsynth.methods.designing import design
from obsynth.methods.method_spec import Synthesis
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.results.design import Certificate, ObserverDesign


def luenberger_observer(plant: DescriptorSystem, *, name: str = "design", **options: Any) -> ObserverDesign:
    return design(plant, "luenberger-observer", name=name, **options)


def conditions(plant: DescriptorSystem) -> tuple[Condition, ...]:
    discrete = plant.dt > 0.0 and np.array_equal(plant.E, np.eye(plant.nx))
    seen = np.array_equal(plant.C, np.eye(plant.nx))
    return (
        Condition("discrete time", "dt > 0 and E = I", discrete, plant.dt, 0.0, "Luenberger", "another plant."),
        Condition("states measured", "C = I", seen, float(seen), 1.0, "Luenberger", "measure every state."),
    )


def synthesise(plant: DescriptorSystem, asked: LuenbergerOptions, *, progress: Callable[[str], None]) -> Synthesis:
    require_all(conditions(plant))
    progress("choosing the gain")
    nx = plant.nx
    gain = plant.A - asked.pole * np.eye(nx)
    observer = LinearObserver(
        Az=plant.A - gain, Bu=plant.B - gain @ plant.D, By=gain, Cz=np.eye(nx), Du=np.zeros((nx, plant.nu)),
        Dy=np.zeros((nx, nx)), dt=plant.dt, input_names=plant.input_names, output_names=plant.output_names,
        state_names=plant.state_names, fault_names=(), residual_names=(), state_delays=(0,) * nx, fault_delays=(),
    )  # fmt: skip
    return Synthesis(asked.as_given(), {"L": gain}, observer, Certificate({}, {"radius": asked.pole}))

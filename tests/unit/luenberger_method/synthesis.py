"""Conditions and synthesis: where the sensors tell every state, a gain leaves the error nothing but the pole."""

from collections.abc import Callable
from typing import Any

import numpy as np

from luenberger_method.options import LuenbergerOptions
from obsynth.analysis.conditions import Condition, require_all
from obsynth.methods.designing import design
from obsynth.methods.method_spec import Synthesis
from obsynth.numerics.ranks import decide_rank
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.results.design import Certificate, ObserverDesign


def luenberger_observer(plant: DescriptorSystem, *, name: str = "design", **options: Any) -> ObserverDesign:
    return design(plant, "luenberger-observer", name=name, **options)


def conditions(plant: DescriptorSystem) -> tuple[Condition, ...]:
    states, sensors = decide_rank(plant.E), decide_rank(plant.C, expected=plant.nx)
    discrete = plant.dt > 0.0 and states.full
    square = sensors.full and plant.ny == plant.nx
    return (
        Condition("discrete time", "dt > 0 and rank E = nx", discrete, plant.dt, 0.0, "Luenberger", "another plant."),
        Condition(
            "states measured", "C invertible", square, sensors.rank, plant.nx, "Luenberger", "measure every state."
        ),
    )


def synthesise(plant: DescriptorSystem, asked: LuenbergerOptions, *, progress: Callable[[str], None]) -> Synthesis:
    require_all(conditions(plant))
    progress("choosing the gain")
    nx = plant.nx
    A, B = (np.linalg.solve(plant.E, matrix) for matrix in (plant.A, plant.B))
    gain = np.linalg.solve(plant.C.T, (A - asked.pole * np.eye(nx)).T).T
    observer = LinearObserver(
        Az=asked.pole * np.eye(nx), Bu=B - gain @ plant.D, By=gain, Cz=np.eye(nx), Du=np.zeros((nx, plant.nu)),
        Dy=np.zeros((nx, nx)), dt=plant.dt, input_names=plant.input_names, output_names=plant.output_names,
        state_names=plant.state_names, fault_names=(), residual_names=(), state_delays=(0,) * nx, fault_delays=(),
    )  # fmt: skip
    return Synthesis(asked.as_given(), {"L": gain}, observer, Certificate({}, {"radius": asked.pole}))

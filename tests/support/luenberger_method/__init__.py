"""A whole method in one class: where the sensors tell every state, a gain leaves the error nothing but the pole."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from obsynth.analysis.existence.condition import Condition, require_all
from obsynth.methods.method import ClaimMeaning, Method, PlantKind, Synthesis
from obsynth.numerics.arguments import OpenUnitInterval
from obsynth.numerics.ranks import decide_rank
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.results.checks import Check
from obsynth.results.design import Certificate, ObserverDesign
from obsynth.verification.error_system import ErrorModel


@dataclass(frozen=True)
class LuenbergerObserver(Method):
    """Design a Luenberger observer.

    Parameters
    ----------
    plant : DescriptorSystem
        ``dt > 0``, E nonsingular, C square and nonsingular.
    pole : float
        Every pole of the error.
    kind : {"predictor", "slow"}
        A slow one has a pole of at least 0.5.
    name : str
        Name of the design.
    """

    id: ClassVar[str] = "luenberger-observer"
    plants: ClassVar[tuple[PlantKind, ...]] = ("time-invariant",)
    time: ClassVar[str] = "discrete"
    summary: ClassVar[str] = "states, where every state is measured"
    source: ClassVar[str] = "Luenberger 1964"
    claims: ClassVar[Mapping[str, ClaimMeaning]] = {
        "radius": ClaimMeaning("", "spectral radius of the error", "radius")
    }

    pole: OpenUnitInterval = 0.5
    kind: Literal["predictor", "slow"] = "predictor"

    def conflicts(self) -> Iterator[str]:
        if self.kind == "slow" and self.pole < 0.5:
            yield "a slow observer has a pole of at least 0.5."

    def existence(self, plant: DescriptorSystem, *, exactly: bool = True) -> tuple[Condition, ...]:
        states, sensors = decide_rank(plant.E), decide_rank(plant.C, expected=plant.nx)
        discrete = plant.dt > 0.0 and states.full
        square = sensors.full and plant.ny == plant.nx
        return (
            Condition("discrete time", "dt > 0 and rank E = nx", discrete, plant.dt, 0.0, "Luenberger",
                      "another plant."),
            Condition("states measured", "C invertible", square, sensors.rank, plant.nx, "Luenberger",
                      "measure every state."),
        )  # fmt: skip

    def synthesise(self, plant: DescriptorSystem, *, progress: Callable[[str], None]) -> Synthesis:
        require_all(self.existence(plant))
        progress("choosing the gain")
        nx = plant.nx
        A, B = (np.linalg.solve(plant.E, matrix) for matrix in (plant.A, plant.B))
        gain = np.linalg.solve(plant.C.T, (A - self.pole * np.eye(nx)).T).T
        observer = LinearObserver(
            Az=self.pole * np.eye(nx), Bu=B - gain @ plant.D, By=gain, Cz=np.eye(nx), Du=np.zeros((nx, plant.nu)),
            Dy=np.zeros((nx, nx)), dt=plant.dt, input_names=plant.input_names, output_names=plant.output_names,
            state_names=plant.state_names, fault_names=(), residual_names=(), state_delays=(0,) * nx, fault_delays=(),
        )  # fmt: skip
        return Synthesis(self.as_given(), {"L": gain}, observer, Certificate({}, {"radius": self.pole}))

    @classmethod
    def checks(cls, design: ObserverDesign, printed_digits: int | None) -> Iterator[Check]:
        from luenberger_method.checks import checks

        return checks(design, printed_digits)

    @classmethod
    def error_model(cls, design: ObserverDesign) -> ErrorModel:
        plant, observer = design.linear
        return ErrorModel(plant, observer, np.linalg.inv(plant.E))

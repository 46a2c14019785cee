"""What no method can leave out: a method of another package whose own rows say nothing, or whatever it likes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import pytest

import obsynth
from obsynth.analysis.existence.condition import Condition
from obsynth.errors import VerificationError
from obsynth.methods.method import Method, PlantKind, Synthesis
from obsynth.methods.registry import REGISTRY
from obsynth.observers.linear.observer import LinearObserver
from obsynth.results.checks import Check, upper_bound_check
from obsynth.results.design import Certificate, ObserverDesign
from obsynth.verification.error_system import ErrorModel

CONTINUOUS = obsynth.DescriptorSystem(A=[[-2.0, 0.0], [1.0, -1.0]], B=[[1.0], [0.0]], C=[[0.0, 1.0]])
DISCRETE = obsynth.DescriptorSystem(A=[[0.5, 0.0], [0.3, 0.7]], B=[[1.0], [0.0]], C=[[0.0, 1.0]], dt=1.0)


@dataclass(frozen=True)
class Own(Method):
    """Design an observer with a gain for the second state."""

    id: ClassVar[str] = "own"
    plants: ClassVar[tuple[PlantKind, ...]] = ("time-invariant",)
    time: ClassVar[str] = "continuous or discrete"
    summary: ClassVar[str] = "states"
    source: ClassVar[str] = "a test"

    gain: float = 0.5

    def existence(self, plant: Any, *, exactly: bool = True) -> tuple[Condition, ...]:
        return (Condition("inputs", "at most one input", plant.nu <= 1, float(plant.nu), 1.0, "a test", "more."),)

    def synthesise(self, plant: Any, *, progress: Callable[[str], None]) -> Synthesis:
        gain, n = np.array([[0.0], [self.gain]]), plant.nx
        observer = LinearObserver(
            Az=plant.A - gain @ plant.C, Bu=plant.B, By=gain, Cz=np.eye(n), Du=np.zeros((n, plant.nu)),
            Dy=np.zeros((n, 1)), dt=plant.dt, input_names=plant.input_names, output_names=plant.output_names,
            state_names=plant.state_names, fault_names=(), residual_names=(), state_delays=(0,) * n, fault_delays=(),
        )  # fmt: skip
        return Synthesis(self.as_plain(), {"L": gain}, observer, Certificate({}, {}))

    @classmethod
    def error_model(cls, design: ObserverDesign) -> ErrorModel | None:
        return ErrorModel(*design.linear, np.eye(design.plant.nx))

    @classmethod
    def checks(cls, design: ObserverDesign, printed_digits: int | None) -> Iterator[Check]:
        yield from ()


class Boasting(Own):
    """Design the same, with rows of the names that methods of ours have."""

    @classmethod
    def checks(cls, design: ObserverDesign, printed_digits: int | None) -> Iterator[Check]:
        for name in ("stability", "decay", "weights", "joined"):
            yield upper_bound_check(name, "everything is well", 0.0, 1.0, source="its word")


class WithoutModel(Own):
    """Design the same, and say nothing of what it follows."""

    @classmethod
    def has_error_model(cls, design: ObserverDesign) -> bool:
        return False

    @classmethod
    def error_model(cls, design: ObserverDesign) -> ErrorModel | None:
        return None


class OpenLoop(Own):
    """Design a model that runs beside the plant."""

    open_loop: ClassVar[bool] = True


KINDS = (Own, Boasting, WithoutModel, OpenLoop)


@pytest.fixture(autouse=True)
def registered(monkeypatch: pytest.MonkeyPatch) -> None:
    for kind in KINDS:
        monkeypatch.setattr(kind, "id", kind.__name__.lower())
        monkeypatch.setitem(REGISTRY, kind.__name__.lower(), f"{__name__}:{kind.__name__}")


@pytest.mark.parametrize("plant", [CONTINUOUS, DISCRETE])
@pytest.mark.parametrize("method", ["own", "boasting"])
def test_a_gain_with_the_wrong_sign_is_refused_whatever_the_method_says(method: str, plant: Any) -> None:
    design = obsynth.design(plant, method, gain=0.5)
    assert design.report.passed
    assert {"exists: inputs", "signals", "decay of the state", "error model"} <= {
        row.name for row in design.report.checks
    }
    with pytest.raises(VerificationError, match="decay of the state") as caught:
        obsynth.design(plant, method, gain=-5.0)
    assert "eigenvalue of" in caught.value.report["decay of the state"].detail


def test_a_design_must_say_what_it_follows() -> None:
    with pytest.raises(VerificationError, match="error model"):
        obsynth.design(DISCRETE, "withoutmodel")


def test_signals_of_another_plant_and_other_numbers_fail() -> None:
    design = obsynth.design(DISCRETE, "own")
    observer = design.observer
    for change in (
        {"input_names": ("other",)}, {"output_names": ("other",)}, {"dt": 2.0}, {"state_names": ("x1", "other")},
    ):  # fmt: skip
        report = obsynth.verify(design.replace(observer=replace(observer, **change)))
        assert not report.passed
        assert not report["signals"].passed
    other = design.replace(plant=DISCRETE.replace(B=np.eye(2), D=np.zeros((1, 2)), input_names=("u1", "u2")))
    assert not obsynth.verify(other)["exists: inputs"].passed
    assert not obsynth.verify(design.replace(options={"gain": "large"})).passed
    with pytest.raises(VerificationError, match="exists: inputs"):
        obsynth.design(other.plant, "own")


@pytest.mark.parametrize("gain", [0.5, -5.0])
def test_the_verdict_on_an_open_loop_model_begins_with_what_it_is(gain: float) -> None:
    design = obsynth.design(DISCRETE, "openloop", gain=gain)
    verdict = " ".join(str(design).split())
    assert verdict.startswith("design: An open-loop model, of whose stability nothing is claimed. Verified")
    row = design.report["open-loop model"]
    assert (row.kind, row.status) == ("information", "assumed")
    assert ("eigenvalue of" in row.detail) is (gain < 0.0)

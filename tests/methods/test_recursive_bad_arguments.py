"""Arguments of the recursive methods that are no numbers, or of the wrong kind: always a SpecError that names them."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pytest
from time_varying_plants import varying

import obsynth
from obsynth import DescriptorSystem, ObserverDesign, SpecError

ALWAYS_BAD: tuple[Any, ...] = (
    "a", "", b"x", True, float("inf"), {}, [], object(), 1 + 2j, [["a"]], np.zeros((2, 2, 2, 2)),
)  # fmt: skip
Y, U = np.zeros((10, 2)), np.zeros((10, 1))


@cache
def design() -> ObserverDesign:
    return obsynth.adaptive_observer(varying(horizon=12), Q=0.1, R=0.2, window=5)


@cache
def estimates() -> obsynth.types.Estimates:
    return design().observer.run(Y, U)


def option(name: str) -> Callable[[Any], object]:
    needed = {"form": "random-walk"} if name == "random_walk" else {}
    return lambda value: obsynth.adaptive_observer(
        varying(horizon=12), **{"Q": 0.1, "R": 0.2, "window": 5, **needed, name: value}
    )


def still() -> DescriptorSystem:
    return DescriptorSystem(None, 0.5 * np.eye(2), C=np.eye(2), dt=1.0)


#: What is asked -> the call, the path of the error, and further values that are bad there.
CALLS: dict[str, tuple[Callable[[Any], object], tuple[Any, ...]]] = {
    **{name: (option(name), (-1.0,)) for name in ("Q", "R", "random_walk", "initial_parameter_covariance")},
    **{name: (option(name), (2.5,)) for name in ("initial_state", "initial_parameters")},
    "initial_covariance": (option("initial_covariance"), (-1.0,)),
    "forgetting": (option("forgetting"), (None, 0.0, 1.5, float("nan"))),
    "window": (option("window"), (None, 0, 2.5, float("nan"))),
    "reset": (option("reset"), (None, -0.1, 1.0)),
    "form": (option("form"), (None, 3)),
    "guard": (option("guard"), (3,)),
    "statistic": (lambda v: obsynth.decide(design().observer, estimates(), statistic=v), (None,)),
    "false_alarms": (lambda v: obsynth.decide(design().observer, estimates(), false_alarms=v), (None, 0.0, 1.0)),
    "nominal": (lambda v: obsynth.decide(design().observer, estimates(), nominal=v), (2.5,)),
    "change": (lambda v: obsynth.decide(design().observer, estimates(), statistic="cusum", change=v), (None, 0.0)),
    "y": (lambda v: design().observer.run(v, U), (None, 2.5)),
    "y of a step": (lambda v: design().observer.start().step(v, [0.0]), (None, 2.5)),
    "u of a step": (lambda v: design().observer.start().step([0.0, 0.0], v), (None,)),
    "u": (lambda v: design().observer.run(Y, v), (None, 2.5)),
    "y of a batch": (lambda v: obsynth.run_batch(design().observer, v, U), (None, 2.5)),
    "u of a batch": (lambda v: obsynth.run_batch(design().observer, Y[None], v), (None, 2.5)),
    "Q of the steady state": (lambda v: obsynth.steady_state_filter(still(), Q=v, R=np.eye(2)), (-1.0,)),
    "plant of the steady state": (lambda v: obsynth.steady_state_filter(v, Q=np.eye(2), R=np.eye(2)), (None, 2.5)),
    "constants": (lambda v: varying(constants=v), (2.5,)),
    "units": (lambda v: varying(units=v), (2.5,)),
    "state_names": (lambda v: varying(state_names=v), (2.5,)),
    "samples": (lambda v: obsynth.simulate_time_varying(varying(), samples=v), (None, 0, 2.5)),
    "initial_state of a simulation": (
        lambda v: obsynth.simulate_time_varying(varying(), samples=5, initial_state=v), (2.5,),
    ),
    "parameters": (lambda v: obsynth.simulate_time_varying(varying(), samples=5, parameters=v), (2.5,)),
}  # fmt: skip
#: Values in `ALWAYS_BAD` that are good after all.
GOOD: dict[str, tuple[Any, ...]] = {"constants": ({},), "units": ({},)}


@pytest.mark.one_in(4)
@pytest.mark.parametrize("name", CALLS)
def test_a_spec_error_names_the_argument(name: str) -> None:
    call, further = CALLS[name]
    for value in (*ALWAYS_BAD, *further):
        if any(value is good or (isinstance(value, dict) and value == good) for good in GOOD.get(name, ())):
            continue
        with pytest.raises(SpecError, match=name.split()[0]) as caught:
            call(value)
        assert caught.value.path


@pytest.mark.parametrize("value", ["a", None, 1, 0.0, [], object()])
def test_what_is_yes_or_no(value: Any) -> None:
    with pytest.raises(SpecError, match=r"early_constraints is .*: give True or False"):
        obsynth.descriptor_kalman(varying(horizon=12), Q=0.1, R=0.2, early_constraints=value)


def test_numbers_of_numpy_are_numbers() -> None:
    plain = design()
    found = obsynth.adaptive_observer(
        varying(horizon=12), Q=np.float64(0.1), R=np.float32(0.5), window=np.int64(5), forgetting=np.float64(0.98),
        early_constraints=np.False_,
    )  # fmt: skip
    assert found.report.passed
    assert found.observer.adaptation.window == plain.observer.adaptation.window
    assert obsynth.adaptive_observer(varying(horizon=12), Q=1, R=np.int64(2), forgetting=np.int64(1)).report.passed

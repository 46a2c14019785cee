"""Messages about a name that does not exist say which one may be meant."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

import obsynth

PLANT = obsynth.DescriptorSystem(
    A=[[0.9, 0.1], [0.0, 0.8]],
    C=[[1, 0], [0, 1]],
    Bf=[[1], [0]],
    Bd=[[0], [1]],
    state_names=["level", "flow"],
    fault_names=["leak"],
    dt=1.0,
)

WRONG_NAMES: dict[str, tuple[Callable[[], Any], str]] = {
    "parameter of conditions": (
        lambda: obsynth.conditions.wang2015(PLANT, gamma=10.0).bisect("gamma", 9.0, 1.0),
        "gamma_squared",
    ),
    "variable of conditions": (
        lambda: obsynth.conditions.wang2015(PLANT).variables["gama_squared"],
        "gamma_squared",
    ),
    "constraint of conditions": (lambda: obsynth.conditions.wang2015(PLANT).changed(drop=["(45"]), "(45)"),
    "fault to examine": (lambda: obsynth.diagnose(PLANT)["leek"], "leak"),
    "state of a functional": (lambda: obsynth.with_functionals(PLANT, {"sum": {"levl": 1.0, "flow": 1.0}}), "level"),
    "key of a parameter": (
        lambda: obsynth.PolytopicSystem(
            plant={"A": [["v", 0.0], [0.0, 0.8]], "C": [[1, 0]], "dt": 1.0}, scheduling={"v": {"rnge": [0.1, 0.2]}}
        ),
        "range",
    ),
}


@pytest.mark.parametrize("kind", WRONG_NAMES)
def test_a_message_on_a_wrong_name_suggests_the_right_one(kind: str) -> None:
    call, meant = WRONG_NAMES[kind]
    with pytest.raises((obsynth.SpecError, KeyError)) as refused:
        call()
    assert f"Did you mean {meant!r}?" in refused.value.args[0]

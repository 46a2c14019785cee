"""Guaranteed tests at the edges: optima of zero, windows without a free signal, several faults over tolerances."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pandas as pd
import pytest

import obsynth

NOISE = 0.01


def degenerate(seed: int) -> tuple[obsynth.DescriptorSystem, dict[str, Any]]:
    """A plant of a few states whose matrices are half zeros, with units far from one, and options of a test."""
    rng = np.random.default_rng([46, 9, seed])
    n, p, nf = (int(rng.integers(1, high)) for high in (4, 3, 4))

    def drawn(rows: int, columns: int) -> np.ndarray:
        return rng.choice([0.0, 0.0, 0.0, 1.0, -2.0, 0.1, 20.0, -200.0], (rows, columns))

    plant = obsynth.DescriptorSystem(
        A=rng.normal(size=(n, n)), C=drawn(p, n), Bf=drawn(n, nf), Df=drawn(p, nf), Bw=drawn(n, 1), Dw=drawn(p, 1),
        dt=0.5,
    )  # fmt: skip
    course = str(rng.choice(["step", "constant", "any", "ramp"]))
    options = {
        "course": course,
        "samples": int(rng.choice([4, 6, 8])),
        "before": 3,
        "free": str(rng.choice(["others", "none"])),
        "free_course": str(rng.choice(["any", "constant"])),
        "noise_bound": 2.0 if plant.Bw.any() or plant.Dw.any() else None,
        "state_bounds": {name: 1.0 for name in plant.state_names if rng.random() < 0.4},
    }
    return plant, {name: value for name, value in options.items() if course == "step" or name != "before"}


@pytest.mark.long
def test_a_test_of_half_empty_plants_is_a_result_or_a_reason(share: Callable[..., Any]) -> None:
    made, reasons = 0, []
    for seed in share(range(80), 2):
        plant, options = degenerate(seed)
        try:
            found = obsynth.guaranteed_test(plant, plant.fault_names[-1], **options)
        except obsynth.PreconditionError as error:
            reasons.append(str(error))
            continue
        made += 1
        assert found.report.passed
        assert found.threshold >= 0.0
    assert made >= 10
    assert len(reasons) >= 6
    assert all("fault detectable" in reason or "number of samples" in reason for reason in reasons), reasons


@pytest.mark.parametrize("course", ["constant", "step", "any", "ramp"])
def test_a_fault_without_effect_is_refused_where_no_signal_is_free(course: str) -> None:
    plant = obsynth.DescriptorSystem(A=[[0.5]], C=[[1.0]], Bf=[[0.0]], dt=1.0)
    options = {"before": 1} if course == "step" else {}
    with pytest.raises(obsynth.PreconditionError, match="fault detectable"):
        obsynth.guaranteed_test(plant, course=course, samples=3, state_bounds={"x1": 1.0}, free="none", **options)


def uncertain(faults: int) -> obsynth.DescriptorSystem:
    """A pump with a gain within 2 %, two sensors and one to three faults."""
    return obsynth.uncertain_system(
        {
            "A": [["0.5*p", 0.1], [0.0, 0.6]], "B": [[1.0], [0.0]], "C": [[1.0, 0.0], [0.0, 1.0]], "dt": 1.0,
            "Bf": np.eye(2, 3)[:, :faults].tolist(), "Df": np.zeros((2, faults)).tolist(),
            "Bw": np.zeros((2, 2)).tolist(), "Dw": (NOISE * np.eye(2)).tolist(),
        },
        {"p": {"nominal": 1.0, "tolerance": "2 %"}},
    )  # fmt: skip


def healthy(p: float, rng: np.random.Generator) -> pd.DataFrame:
    """A record of the plant with this gain, noise at its bounds, and no fault."""
    steps, x, rows = 60, np.zeros(2), []
    for k in range(steps):
        u = np.sin(0.5 * k)
        rows.append([float(k), u, *(x + 2.0 * NOISE * rng.choice([-1.0, 1.0], 2))])
        x = np.array([[0.5 * p, 0.1], [0.0, 0.6]]) @ x + np.array([u, 0.0])
    return pd.DataFrame(rows, columns=["time", "u1", "y1", "y2"])


@pytest.mark.one_in(4)
@pytest.mark.parametrize("free", ["others", "none"])
@pytest.mark.parametrize("course", ["constant", "step", "any", "ramp"])
def test_tests_of_one_of_several_faults_over_tolerances_watch_a_log(course: str, free: str) -> None:
    plant = uncertain(2)
    scenario = obsynth.Scenario(horizon=60.0, inputs={"u1": obsynth.Sine(amplitude=1.0, frequency=0.5)})
    test = obsynth.guaranteed_test(
        plant, "f1", course=course, samples=12, noise_bound=2.0, free=free, scenario=scenario
    )
    monitor = obsynth.online_monitor(test, constants=plant, initial_set={"x1": 0.0, "x2": 0.0})
    if course != "step":
        assert "not every fault is estimated" in monitor.statement
    rng = np.random.default_rng(46)
    for p in (0.98, 1.02):
        data = healthy(p, rng)
        table = obsynth.run_on_data(test, data, monitor=monitor).table
        assert (table["alarm"] == "").all()
        data.loc[30:, "y1"] += 5.0
        assert (obsynth.run_on_data(test, data, monitor=monitor).table["alarm"] != "").any()

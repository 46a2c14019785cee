"""Long logs: the search is made on the first rows, the fit and the box are of all rows."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from obsynth import DAEModel, PreconditionError, calibrate
from obsynth.monitoring.calibration import step_graphs
from obsynth.monitoring.calibration.logs import read_log
from obsynth.monitoring.calibration.long_logs import SEARCHED_ROWS, searched_rows
from obsynth.monitoring.calibration.maximum import Maximum, avoided_variances, descent, without_collapse
from obsynth.monitoring.calibration.plants import NonlinearPlant
from obsynth.monitoring.calibration.simulation_error import _runs_away

TANK = DAEModel(
    {"balance": "der(level) = inflow - c * level"}, {"gauge": "level"},
    states={"level": 1.0}, inputs={"inflow": 0.5}, constants={"c": 0.5},
)  # fmt: skip


def tank_log(rows: int, *, still: int = 0) -> dict[str, np.ndarray]:
    """Return a log of the tank with c = 0.55 by backward Euler, whose input does not move in the first rows."""
    rng, k = np.random.default_rng(4), np.arange(rows)
    inflow = 0.5 + np.where(k < still, 0.0, 0.2 * np.sign(np.sin(0.1 * k)))
    level = [1.0]
    for u in inflow[1:]:
        level.append((level[-1] + 0.1 * (u + 0.01 * rng.normal())) / (1 + 0.1 * 0.55))
    return {"time": 0.1 * k, "inflow": inflow, "gauge": np.array(level) + 0.01 * rng.normal(size=rows)}


def test_the_search_is_made_on_rows_that_move_as_all_do() -> None:
    def part(log: dict[str, np.ndarray]) -> int:
        return searched_rows(read_log(log, ("inflow",), ("gauge",))).samples

    assert part(tank_log(1900)) == 1900
    assert part(tank_log(8000)) == SEARCHED_ROWS
    # Rows in which nothing moves say nothing: twice as many are taken until they do.
    assert part(tank_log(8000, still=1500)) == 2 * SEARCHED_ROWS
    gone = tank_log(8000)
    gone["gauge"][:2500] = np.nan
    assert part(gone) == 4 * SEARCHED_ROWS


@pytest.mark.long
def test_the_fit_is_of_all_rows() -> None:
    log = tank_log(2400)
    log["gauge"][2000] += 1.0
    stages: list[str] = []
    found = calibrate(TANK, log, {"c": (0.2, 1.0)}, input_delay=0, starts=1, integration="backward-euler",
                      sensor_noise={}, offset={}, progress=stages.append)  # fmt: skip
    assert "all 2400 rows" in stages
    assert found.log["samples"] == len(found.innovations) == 2400
    assert any("row 2000" in sentence for sentence in found.verdict)
    assert found.box.low["c"] < 0.55 < found.box.high["c"]
    assert found.R["gauge"] == pytest.approx(1e-4, rel=0.15)
    # Twice and a half as many rows are more than the first ones say.
    first = calibrate(TANK, {name: part[:1000] for name, part in log.items()}, {"c": (0.2, 1.0)}, input_delay=0,
                      starts=1, integration="backward-euler", sensor_noise={}, offset={})  # fmt: skip
    width, of_first = (item.box.high["c"] - item.box.low["c"] for item in (found, first))
    assert width < 0.8 * of_first


def test_what_runs_away_as_an_integrated_constant_does_is_no_other_unit() -> None:
    time = np.linspace(0.0, 60.0, 600)
    y = np.sin(time)
    assert _runs_away(time, y + 0.2 * time**2, y)
    assert not _runs_away(time, 1000.0 * y, y)
    # Of a sensor that follows the polynomial itself nothing can be said.
    assert not _runs_away(time, 2.0 * time**2, time**2)


def test_a_force_that_is_integrated_twice_is_told_as_such() -> None:
    """A mass is held in its place against a force of which the model knows nothing: the input is no zero."""
    dt, n = 0.1, 400
    mass = DAEModel(
        {"place": "der(z) = v", "speed": "m * der(v) = thrust - drag * v + push"}, {"alt": "z"},
        states={"z": 0.0, "v": 0.0}, inputs={"thrust": 0.0}, parameters={"push": 0.0},
        constants={"m": 1.0, "drag": 0.05},
    )  # fmt: skip
    rng, z, v, thrusts, places = np.random.default_rng(1), 0.0, 0.0, [], []
    for k in range(n):
        thrust = 4.0 * (np.sign(np.sin(0.1 * k)) - z) - 3.0 * v
        v = (v + dt * (thrust + 1.5)) / (1.0 + dt * 0.05)
        z += dt * v
        thrusts.append(thrust)
        places.append(z + 0.01 * rng.normal())
    log = {"time": dt * np.arange(n), "thrust": np.array(thrusts), "alt": np.array(places)}
    with pytest.raises(PreconditionError, match=r"runs away from alt .* random walk \(walks: push\)"):
        calibrate(mass, log, {"drag": (0.04, 0.06)}, offset={}, starts=1, input_delay=0,
                  integration="backward-euler")  # fmt: skip


class OneVariance:
    """A likelihood that does not distinguish a variance from zero, and where searches of it began."""

    size, nt, bent = 1, 0, False
    free, is_q, is_r = np.array([True]), np.array([True]), np.array([False])
    low, high, first = np.array([-20.0]), np.array([20.0]), np.zeros(1)
    problem = SimpleNamespace(noisy=("balance",))

    def __init__(self) -> None:
        self.avoided, self.starts = np.zeros(1), list[float]()

    def __call__(self, z: np.ndarray) -> tuple[float, np.ndarray]:
        return float(np.exp(z[0]) - 0.5 * self.avoided @ z), np.exp(z) - 0.5 * self.avoided

    def descent(self, start: np.ndarray) -> tuple[float, np.ndarray]:
        self.starts.append(float(start[0]))
        return descent(self, start, self.low, self.high, np.ones(1))


def test_a_variance_that_is_kept_from_zero_is_sought_where_fewer_rows_have_it() -> None:
    places = []
    for known in (None, np.array([-0.5]), np.array([np.nan])):
        objective: Any = OneVariance()
        collapsed = np.array([-10.0])
        found = without_collapse(objective, Maximum(collapsed, 0.0, np.eye(1), collapsed), lambda text: None, known)
        assert found.z[0] == pytest.approx(np.log(0.5), abs=1e-4)
        assert avoided_variances(objective, found.z) == pytest.approx(found.z)
        places.append(objective.starts)
    assert places == [[0.0, 3.0, -3.0], [-0.5], [0.0, 3.0, -3.0]]


def test_what_leads_to_another_fit_has_no_box_and_what_is_not_evaluated_is_not_compiled(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Boxes and compilers took as long as the searches themselves, for models that were left at once."""
    log = tank_log(80)
    log["gauge"][50] += 1.0
    stages: list[str] = []
    options: dict[str, Any] = {"input_delay": 0, "starts": 1, "sensor_noise": {}, "offset": {}}
    calibrate(TANK, log, {"c": (0.2, 1.0)}, integration="backward-euler", progress=stages.append, **options)
    assert "without samples that stand out" in stages
    assert stages.count("boxes by profile likelihood") == 1
    built: list[str] = []

    def compiled(functions: Sequence[Any]) -> list[Any]:
        built.extend(function.name() for function in functions)
        return list(functions)

    monkeypatch.setattr(step_graphs, "COMPILED_OPERATIONS", 0)
    monkeypatch.setattr(step_graphs, "compiled", compiled)
    graphs = step_graphs.sample_graphs(NonlinearPlant(TANK), ["c"], 0.1, integration="radau", substeps=1)
    assert graphs.in_c
    assert built == []
    assert np.isfinite(np.array(graphs.solve([1.0], [0.5], [0.5])[0])).all()
    assert built == ["solve", "sensitivities"]

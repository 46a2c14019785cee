"""Several wrong samples of one sensor in a row of a calibration's log."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

import obsynth
from obsynth.monitoring.calibration import noise_proposals
from obsynth.monitoring.calibration import wrong_runs as wrong_runs_module
from obsynth.monitoring.calibration.wrong_runs import wrong_runs

ROWS = 300


def hidden(y: np.ndarray, monkeypatch: pytest.MonkeyPatch, memory: float = 0.0) -> list[tuple[int, int]]:
    """Return which measurements are hidden where a filter predicts a share of the sample before."""

    def whitened(problem: object, v: object, given: np.ndarray) -> np.ndarray:
        before, found = np.zeros(given.shape[1]), np.zeros_like(given)
        for k, row in enumerate(given):
            seen = np.isfinite(row)
            found[k] = np.where(seen, row - memory * before, 0.0)
            before = np.where(seen, row, memory * before)
        return found

    for module in (noise_proposals, wrong_runs_module):
        monkeypatch.setattr(module, "whitened_run", whitened)
    fit = SimpleNamespace(whitened=whitened(None, None, y), v=np.zeros(3))
    return [tuple(place) for place in np.argwhere(wrong_runs(SimpleNamespace(y=y), fit)).tolist()]


def noise() -> np.ndarray:
    return np.random.default_rng(0).standard_normal((ROWS, 2))


@pytest.mark.parametrize("memory", [0.0, 0.9])
@pytest.mark.parametrize("signs", [(1, 1), (1, 1, 1), (1, -1, 1), (1, 1, 1, 1, 1)])
def test_a_run_that_is_gone_afterwards_is_hidden(
    monkeypatch: pytest.MonkeyPatch, memory: float, signs: tuple[int, ...]
) -> None:
    y = noise()
    y[100 : 100 + len(signs), 0] += 20.0 * np.array(signs)
    assert hidden(y, monkeypatch, memory) == [(100 + k, 0) for k in range(len(signs))]


def test_what_another_sensor_sees_or_what_stays_is_no_run_of_wrong_samples(monkeypatch: pytest.MonkeyPatch) -> None:
    y = noise()
    y[100:103] += 20.0
    assert hidden(y, monkeypatch) == []
    y = noise()
    y[100:, 0] += 20.0
    assert hidden(y, monkeypatch, 0.9) == []
    y = noise()
    y[100:109, 0] += 20.0
    assert hidden(y, monkeypatch) == []
    # One alone is told by its whitened innovation, and a run at the end is not known to be gone.
    y = noise()
    y[100, 0] += 20.0
    y[-3:, 0] += 20.0
    assert hidden(y, monkeypatch) == []
    y = noise()
    y[100:103, 0] += 20.0
    y[101, 0] = np.nan
    assert hidden(y, monkeypatch) == [(100, 0), (102, 0)]


@pytest.mark.long
def test_coloured_noise_is_found_behind_a_run_of_wrong_samples() -> None:
    """Three in a row made calibrate take the noise for white, of twice its size."""
    rng, h, e, rows = np.random.default_rng(3), 1.0, 0.0, []
    for k in range(400):
        u = 0.5 + 0.5 * (k // 25 % 2)
        h = (h + 0.1 * u) / 1.1
        e = 0.9 * e + np.sqrt(0.19) * rng.standard_normal()
        rows.append([0.1 * k, u, h + 0.05 * e])
    log = pd.DataFrame(rows, columns=["time", "u", "y"])
    log.loc[[200, 202], "y"] += 1.0
    log.loc[201, "y"] -= 1.0
    model = obsynth.DAEModel({"tank": "der(h) = u - a * h"}, {"y": "h"}, states={"h": 1.0}, inputs={"u": 0.5},
                             constants={"a": 1.0})  # fmt: skip
    found = obsynth.calibrate(model, log, {"a": (0.5, 2.0)}, input_delay=0, starts=1, noisy=[], offset={})
    assert "row 200, 201, 202" in str(found)
    assert found.sensor_noise["y"]["deviation"] == pytest.approx(0.05, rel=0.4)
    # AR(.9) of .1 s: 0.95 s.
    assert 0.4 < found.sensor_noise["y"]["correlation"] < 2.4
    assert found.nominal["a"] == pytest.approx(1.0, rel=0.05)

"""Coloured noise of a sensor that process noise may stand for: a tank whose level is kept, simulated apart."""

from __future__ import annotations

import numpy as np
import pytest

import obsynth

ROWS, DEVIATION, KEPT = 400, 0.01, 0.9


def tank() -> obsynth.DAEModel:
    """Return the plant with the constants of its spec."""
    return obsynth.DAEModel(
        {"level": "S * der(h) = inflow - c * valve * sqrt(h)"}, {"gauge": "h", "flow": "c * valve * sqrt(h)"},
        states={"h": 1.0}, inputs={"inflow": 0.5, "valve": 1.0}, constants={"S": 20.0, "c": 0.5},
    )  # fmt: skip


def log(seed: int, *, kept: float, process: float) -> dict[str, np.ndarray]:
    """Return rows under a controller of the level; ``kept``: what the noise of the gauge keeps of a row before."""
    rng = np.random.default_rng(seed)
    inflow = np.repeat(0.5 + 0.1 * rng.uniform(-1.0, 1.0, ROWS // 25), 25)
    x, valve, reset, e, rows = 1.0, 1.0, 0.0, rng.standard_normal(), []
    for k in range(ROWS):
        for _ in range(4 if k else 0):
            x = max(x + 0.25 * (inflow[k] - 0.52 * valve * np.sqrt(x)) / 19.0, 0.05)
        x += process * rng.standard_normal()
        e = kept * e + np.sqrt(1.0 - kept**2) * rng.standard_normal()
        flow = 0.52 * valve * np.sqrt(x) + 0.003 * rng.standard_normal()
        rows.append([float(k), inflow[k], valve, x + DEVIATION * e, flow])
        reset = float(np.clip(reset + 0.01 * (x - 1.0), -0.3, 0.3))
        valve = 1.0 + 0.5 * (x - 1.0) + reset
    return dict(zip(("time", "inflow", "valve", "gauge", "flow"), np.array(rows).T, strict=True))


def calibrated(data: dict[str, np.ndarray], **options) -> obsynth.types.Calibration:
    """Return the calibration of a log."""
    bounds = {"S": (10.0, 40.0), "c": (0.3, 0.8)}
    return obsynth.calibrate(tank(), data, bounds, input_delay=0, starts=1, **options)


@pytest.mark.long
def test_colour_that_process_noise_stands_for_is_taken_or_told_with_what_helps() -> None:
    data = log(0, kept=KEPT, process=1e-4)
    found = calibrated(data)
    told = [text for text in found.verdict if "coloured noise of gauge" in text]
    assert told or "gauge" in found.sensor_noise
    stated = calibrated(data, sensor_noise={"gauge": {"correlation": "unknown"}})
    assert stated.sensor_noise["gauge"]["deviation"] == pytest.approx(DEVIATION, rel=0.4)
    assert stated.Q["level"] < found.Q["level"] or "gauge" in found.sensor_noise


@pytest.mark.long
def test_a_level_that_wanders_is_no_coloured_noise_of_its_gauge() -> None:
    found = calibrated(log(1, kept=0.0, process=0.01))
    assert not found.sensor_noise
    assert not any("coloured noise" in text for text in found.verdict)

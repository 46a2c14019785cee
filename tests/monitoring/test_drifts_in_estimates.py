"""Slow drifts of sensors that a filter with fast walks follows, so that no residual shows them."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

import obsynth

ROWS, BEGIN = 900, 300


def tanks_log(seed: int, *, drift: tuple[float, float] = (0.0, 0.0), leak: float = 0.0) -> pd.DataFrame:
    """Two tanks in fourths of a sample; sensors that drift from `BEGIN` on, or a leak that grows, by so much a row."""
    rng, h, rows = np.random.default_rng(seed), np.array([1.6, 0.9]), []
    pump, other = np.repeat(rng.uniform(0.6, 1.2, 18), 50), np.repeat(rng.uniform(0.0, 0.2, 12), 80)
    for k in range(ROWS):
        since = max(k - BEGIN, 0)
        for _ in range(4):
            between = 1.2 * np.sign(h[0] - h[1]) * np.sqrt(abs(h[0] - h[1]))
            h = h + 0.25 / 20.0 * np.array([pump[k] - between, between - np.sqrt(h[1]) + other[k] - leak * since])
        shown = h + 0.004 * rng.standard_normal(2) + np.array(drift) * since
        rows.append([float(k), pump[k], other[k], *shown])
    return pd.DataFrame(rows, columns=["time", "pump", "other", "h0", "h1"])


@pytest.mark.long
def test_slow_drifts_of_sensors_are_no_faults_of_the_plant() -> None:
    """They were a worn pump and a leak: only faults were ranked by what the estimates show."""
    model = obsynth.DAEModel(
        {"a": "20 * der(a) = pump * (1 - worn) - 1.2 * sqrt(a - b)",
         "b": "20 * der(b) = 1.2 * sqrt(a - b) - sqrt(b) + other - leak"},
        {"h0": "a", "h1": "b"}, states={"a": 1.6, "b": 0.9}, inputs={"pump": 0.9, "other": 0.1},
        parameters={"worn": 0.0, "leak": 0.0},
    )  # fmt: skip
    design = obsynth.dae_adaptive_observer(
        model, dt=1.0, Q={"a": 1e-6, "b": 1e-6}, R={"h0": 1.6e-5, "h1": 1.6e-5}, form="augmented-kalman",
        random_walk={"worn": 4e-4, "leak": 4e-4}, initial_parameter_covariance={"worn": 1e-2, "leak": 1e-2},
    )  # fmt: skip
    learned = obsynth.learn_thresholds(design, [tanks_log(1), tanks_log(2)], warm_up=50.0)
    monitor = obsynth.online_monitor(design, "learned", normal=learned)
    cases = {"sensor h0": {"drift": (3e-4, 0.0)}, "sensor h1": {"drift": (0.0, 3e-4)}, "leak": {"leak": 5e-4}}
    for name, flaw in cases.items():
        run = obsynth.run_on_data(design, tanks_log(11, **flaw), monitor=monitor, warm_up=50.0)
        first = next(event for event in run.events if event.last_row > BEGIN)
        assert first.fault == name

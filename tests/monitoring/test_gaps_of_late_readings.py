"""Missing samples of plants with late readings: the bound grows, and no record within the bounds passes it."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from scipy.linalg import expm

import obsynth

DT, PARTS, ROWS = 0.1, 10, 60
A, BD = np.array([[-1.0, 0.2], [0.0, -2.0]]), np.array([0.0, 1.0])


def record(rng: np.random.Generator, late: int) -> np.ndarray:
    """Return outputs of the plant at rest: a disturbance of size 0.5 that switches within samples; y1 is late."""
    step = expm(np.block([[A, BD[:, None]], [np.zeros((1, 3))]]) * DT / PARTS)
    states = np.zeros((ROWS * PARTS, 2))
    for i in range(1, len(states)):
        d = 0.5 * np.sign(np.sin(0.7 * DT * i + rng.uniform(0.0, 6.0)))
        states[i] = step[:2, :2] @ states[i - 1] + step[:2, 2] * d
    y = states[::PARTS].copy()
    y[:, 0] = np.concatenate([np.zeros(late), y[: ROWS - late, 0]])
    return y + 0.03 * rng.uniform(-1.0, 1.0, y.shape)


@pytest.mark.parametrize("late", [1, 2])
def test_no_record_with_missing_samples_passes_the_bound(late: int) -> None:
    # The states that hold late readings had no rows in the sums over a sample: the monitor was refused by an error.
    plant = obsynth.DescriptorSystem(
        A=A, C=np.eye(2), Bf=[[1.0], [0.5]], Bd=BD[:, None], delays={"y1": late * DT},
        sensor_noise={"y1": 0.01, "y2": 0.01},
    )  # fmt: skip
    design = obsynth.fault_estimation_filter(obsynth.discretise(plant, DT))
    monitor = obsynth.online_monitor(design, disturbance_bounds={"d1": 0.5}, noise_bound=3.0, initial_error=0.0)
    for seed in range(3):
        rng = np.random.default_rng([46, late, seed])
        y = record(rng, late)
        y[20:24, rng.integers(0, 2)] = np.nan
        log = pd.DataFrame({"time": DT * np.arange(ROWS), "y1": y[:, 0], "y2": y[:, 1]})
        table = obsynth.run_on_data(design, log, monitor=monitor).table
        statistic, threshold = table["statistic"].to_numpy(), table["threshold"].to_numpy()
        known = np.isfinite(statistic) & np.isfinite(threshold)
        assert known[30:].any()
        assert np.all(statistic[known] <= threshold[known])

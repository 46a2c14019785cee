"""Bounds on a residual for ever, against what inputs of the worst signs and a start of the worst direction reach."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from scipy.linalg import block_diag

from obsynth.monitoring.thresholds.residual_norm_bounds import ScaledInputs, pointwise_threshold, unlimited_bound


@dataclass
class Residual:
    """What the bounds know of a sampled residual ``e+ = A e + B u``, ``r = C e + D u``, in a table of some samples."""

    A: np.ndarray
    C: np.ndarray
    steps: int
    continuous: None = None
    sampled: None = None

    def powers(self) -> list[np.ndarray]:
        return [np.linalg.matrix_power(self.A, k) for k in range(self.steps)]


def turning(radius: float, angle: float) -> np.ndarray:
    return radius * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


RESONANCES = block_diag(*(turning(0.93, angle) for angle in (0.3, 0.9, 1.5, 2.1, 2.7)))
SYSTEMS = {
    # name: A, B, C, D
    "slow": ([[0.9]], [[1.0, 0.5]], [[2.0]], [[0.3, 0.1]]),
    "fast": ([[0.1]], [[1.0, 1.0]], [[1.0]], [[0.0, 0.0]]),
    "direct": ([[0.1]], [[0.1, 0.0]], [[1.0]], [[0.0, 3.0]]),
    "resonances": (RESONANCES, np.tile([[1.0, 1.0], [0.0, 0.0]], (5, 1)), np.tile([[1.0, 0.0]], (1, 5)), [[0.0, 0.0]]),
    "start alone": (turning(0.8, 0.7), [[0.0], [0.0]], [[1.0, 0.5]], [[0.0]]),
    "two rows": (turning(0.8, 0.7), [[1.0, 0.2], [0.0, 1.0]], [[1.0, 0.0], [0.5, 1.0]], [[0.2, 0.0], [0.0, 0.4]]),
}


def worst(parts: tuple[np.ndarray, ...], k: int, window: int, initial_error: float, start: np.ndarray) -> float:
    """Return what inputs of at most one, and a start, can make of the l2 norm of the window that ends at k."""
    a, b, c, d = parts
    n, m, rows = len(a), b.shape[1], []
    free, forced = np.eye(n), np.zeros((n, (k + 1) * m))
    for j in range(k + 1):
        direct = np.zeros((len(c), (k + 1) * m))
        direct[:, j * m : (j + 1) * m] = d
        rows.append(np.hstack([c @ free @ start, c @ forced + direct, c @ free * initial_error]))
        free, forced = a @ free, a @ forced
        forced[:, j * m : (j + 1) * m] += b
    whole, count = np.vstack(rows[max(k - window + 1, 0) :]), len(free)
    found, rng = 0.0, np.random.default_rng(0)
    for seed in range(6):
        direction = rng.standard_normal(len(whole)) if seed else np.ones(len(whole))
        for _ in range(12):
            back = direction @ whole
            size = float(np.linalg.norm(back[-count:]))
            causes = np.concatenate([np.sign(back[:-count]), back[-count:] / size if size else np.zeros(count)])
            direction = whole @ causes
        found = max(found, float(np.linalg.norm(direction)))
    return found


@pytest.mark.one_in(4)
@pytest.mark.parametrize("steps", [3, 40])
@pytest.mark.parametrize("name", SYSTEMS)
def test_nothing_passes_the_bounds_at_any_sample(name: str, steps: int) -> None:
    a, b, c, d = parts = tuple(np.array(part, dtype=float) for part in SYSTEMS[name])
    model: Any = Residual(a, c, steps)
    for initial_error, size in ((0.0, 0.0), (4.0, 0.0), (4.0, 2.0)):
        start = size * np.eye(len(a))[:, :1]
        inputs = ScaledInputs(b, d, np.zeros(steps), 0.0, start)
        for kind, window in (("pointwise", 1), ("window", 1), ("window", min(steps, 20))):
            if kind == "window" and size:
                continue  # of continuous designs alone, whose windows are made of their samples
            table, limit = unlimited_bound(kind, model, inputs, initial_error, window)
            for k in (0, 1, 2, steps - 1, steps, steps + 1, steps + window - 1, steps + 2 * window, 60, 90):
                reached = worst(parts, k, window, initial_error, start)
                allowed = table[k] if k < steps else limit
                assert reached <= allowed * (1.0 + 1e-9), (kind, window, k, initial_error)


@pytest.mark.parametrize("steps", [1, 4, 30])
def test_of_one_state_the_bound_for_ever_is_the_sum_of_the_series(steps: int) -> None:
    """|c| (|b1| + |b2|) / (1 - a) + |d1| + |d2|, and what is left of the start at the first sample after the table."""
    a, b, c, d = (np.array(part, dtype=float) for part in SYSTEMS["slow"])
    model: Any = Residual(a, c, steps)
    inputs = ScaledInputs(b, d, np.full(steps, 0.25), 0.25, np.zeros((1, 0)))
    _, limit = unlimited_bound("pointwise", model, inputs, 0.0, 1)
    series = 2.0 * 1.5 / 0.1 + 0.4 + 0.25
    # Rounded outwards twice, each time by 1e-12; rounding itself is below 1e-14.
    assert series < limit <= series * (1.0 + 2.1e-12)
    _, started = unlimited_bound("pointwise", model, inputs, 4.0, 1)
    assert started - limit == pytest.approx(2.0 * 0.9**steps * 4.0, rel=1e-9)
    series = [2.0 * 1.5 * (1.0 - 0.9**k) / 0.1 + 0.4 + 0.25 for k in range(steps)]
    # Rounded outwards once.
    assert (pointwise_threshold(model, inputs, 0.0) > series).all()
    np.testing.assert_allclose(pointwise_threshold(model, inputs, 0.0), series, rtol=1.1e-12)

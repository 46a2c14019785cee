"""Write a log of the oven, as a data logger would: dates, and a heater that loses 30 W after an hour."""

from __future__ import annotations

from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp

STEP, ROWS = 10.0, 720


def rates(_: float, temperatures: np.ndarray, power: float, ambient: float) -> list[float]:
    """Return the derivatives of heater, air and wall; the surface follows from its balance."""
    heater, air, wall = temperatures
    surface = (10.0 * heater + 3.0 * air + wall) / 14.0
    return [
        (power - 10.0 * (heater - surface)) / 500.0,
        (3.0 * (surface - air) - 2.0 * (air - wall)) / 1500.0,
        (2.0 * (air - wall) + surface - wall - (wall - ambient)) / 9000.0,
    ]


def main() -> None:
    """Write ``oven.csv`` into the current folder."""
    rng = np.random.default_rng(0)
    begin, state = datetime(2026, 5, 1, 8, 30), None
    lines = ["Timestamp,power,heater,air,wall"]
    for k in range(ROWS):
        ambient = 20.0 + 4.0 * np.sin(2.0 * np.pi * k * STEP / 7200.0)
        power = 100.0
        if state is None:
            # The temperatures at which nothing changes.
            columns = np.column_stack([rates(0.0, unit, 0.0, 0.0) for unit in np.eye(3)])
            state = np.linalg.solve(columns, -np.array(rates(0.0, np.zeros(3), power, 20.0)))
        shown = state + 0.1 * rng.normal(size=3)
        stamp = (begin + timedelta(seconds=k * STEP)).isoformat() + "+02:00"
        lines.append(",".join([stamp, f"{power:g}", *(f"{value:.2f}" for value in shown)]))
        lost = 30.0 if k * STEP >= 3600.0 else 0.0
        state = solve_ivp(rates, (0.0, STEP), state, args=(power - lost, ambient), rtol=1e-9).y[:, -1]
    Path("oven.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()

"""Write two logs of an oven, simulated independently: normal rows, and rows in which it loses 0.3 kW from 2400 s on.

    python make_logs.py FOLDER

The constants are others than the spec's (C1 2.1, k 0.052), the room's temperature walks, and the sensor on the case has
noise that is correlated over 95 s.
"""

import sys
from pathlib import Path

import numpy as np


def log(path: Path, *, seed: int, fails: int | None = None, rows: int = 360) -> None:
    """Write a log of one row each 10 s."""
    rng = np.random.default_rng(seed)
    core, case, room, slow = 60.0, 40.0, 20.0, 0.0
    heat = 1.0 + 0.4 * np.repeat(rng.choice([-1.0, 1.0], rows // 12 + 1), 12)[:rows]
    lines = ["time,heat,T core,T case"]
    for row in range(rows):
        lost = 0.3 if fails is not None and row >= fails else 0.0
        for _ in range(40 if row else 0):
            flow = 0.052 * (core - case)
            core += 0.25 * (heat[row] - lost - flow) / 2.1
            case += 0.25 * (flow - 0.05 * (case - room)) / 6.0
        room += 0.1 * rng.standard_normal()
        slow = 0.9 * slow + 0.2 * rng.standard_normal()
        seen = core + 0.05 * rng.standard_normal(), case + slow + 0.02 * rng.standard_normal()
        lines.append(f"{10 * row},{heat[row]:.2f},{seen[0]:.4f},{seen[1]:.4f}")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


folder = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
log(folder / "normal.csv", seed=1)
log(folder / "faulty.csv", seed=2, fails=240)

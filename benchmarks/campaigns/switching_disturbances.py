"""Thresholds that are never passed: disturbances that switch between samples, of the signs that hurt most at some time.

Random plants that oscillate, with and without feedthrough; PD observers on samples, and fault-estimation filters of the
sampled plant.  The simulation is exact for disturbances that are constant in pieces.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from benchmarks.campaigns.frame import Outcome
from scipy.linalg import expm

import obsynth as ob

CASES = 10_000
LIMIT = 120.0  # s
#: Seeds in a row share a plant and a design, which take longest.
TOGETHER, PIECES, STEPS = 500, 6, 120


def case(seed: int) -> Outcome:
    """Run one disturbance, and compare the residual with the threshold at every sample."""
    kind, threshold, kernel = prepared(seed // TOGETHER)
    rng = np.random.default_rng(seed)
    # Signs that add up at one sample, in one direction; some runs are of random signs.
    at = int(rng.integers(5, STEPS))
    direction = rng.standard_normal(kernel.shape[2])
    signs = np.sign(kernel @ direction)
    loads = np.zeros((STEPS, kernel.shape[1]))
    loads[: at + 1] = (
        signs[: at + 1][::-1] if rng.random() < 0.8 else rng.choice([-1.0, 1.0], (at + 1, kernel.shape[1]))
    )
    residual = np.einsum("kp,kpr->r", loads[: at + 1][::-1], kernel[: at + 1])
    size = float(np.linalg.norm(residual))
    wrong = f"{size:.6g} at sample {at}, threshold {threshold[at]:.6g}" if size > threshold[at] * (1.0 + 1e-12) else ""
    share = "above 0.9" if size > 0.9 * threshold[at] else "above 0.5" if size > 0.5 * threshold[at] else "below 0.5"
    return Outcome(kind, f"{share} of the threshold", wrong)


@cache
def prepared(group: int) -> tuple[str, np.ndarray, np.ndarray]:
    """Return kind, threshold by sample, and the residual ``(steps, pieces + 1, nr)`` after a pulse in each piece."""
    rng = np.random.default_rng([group, 7])
    speed, damping = rng.uniform(1.0, 8.0), rng.uniform(0.2, 1.0)
    direct = [[0.0], [float(rng.choice([0.0, 0.5]))]]
    written = ob.DescriptorSystem(
        None, [[-damping, speed], [-speed, -damping]], C=[[1.0, 0.1], [0.2, 1.0]], Bf=[[0.0], [1.0]],
        Bd=rng.uniform(-1.0, 1.0, (2, 1)), Dd=direct, disturbance_names=["load"],
    )  # fmt: skip
    dt = float(rng.uniform(0.02, 0.4))
    disturbances = {"load": ob.Uniform(low=-1, high=1)}
    if group % 2:
        design = ob.fault_estimation_filter(ob.discretise(written, dt).plant)
        observer, scenario = design.linear[1], ob.Scenario(horizon=(STEPS - 0.5) * dt, disturbances=disturbances)
    else:
        design = ob.pd_observer(written, decay=1.0)
        observer = ob.sample_observer(design.linear[1], dt)
        scenario = ob.Scenario(horizon=(STEPS - 0.5) * dt, sample_time=dt, disturbances=disturbances)
    threshold = ob.monitor(design, scenario).threshold
    whole = expm(np.block([[written.A, written.Bd], [np.zeros((1, 3))]]) * (dt / PIECES))
    kernel = np.zeros((STEPS, PIECES + 1, len(observer.residual_names)))
    for piece in range(PIECES + 1):  # the last one: the value at the sample alone
        x, z = np.zeros(2), np.zeros(observer.order)
        for k in range(STEPS):
            y = written.C @ x + (written.Dd[:, 0] if k == 0 and piece == PIECES else 0.0)
            kernel[k, piece] = (observer.Cz @ z + observer.Dy @ y)[observer.residual_rows]
            z = observer.Az @ z + observer.By @ y
            for i in range(PIECES):
                x = whole[:2, :2] @ x + whole[:2, 2] * (k == 0 and i == piece)
    return ("filter" if group % 2 else "PD observer"), threshold, kernel

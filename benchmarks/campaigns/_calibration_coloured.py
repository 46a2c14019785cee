"""Coverage of calibrated boxes where a sensor's noise is coloured, with and without an offset.

    python -m benchmarks.campaigns._calibration_coloured --runs 100 [--plant tank]

A lag of first order, 240 rows, noise of the sensor of AR(.9) with a deviation of 0.1, inputs that are held for 12 rows;
or a nonlinear tank, simulated in small steps.  The 95 % box holds both true constants or does not.  Tells shares and no
wrong cases, beside the frame of campaigns.
"""

from __future__ import annotations

import argparse

import numpy as np

from obsynth.monitoring.calibration.calibrating import calibrate
from obsynth.plants.dae import DAEModel
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.uncertain_system import uncertain_system

ROWS, KEPT, DEVIATION = 240, 0.9, 0.1
TRUTH = {"a": 0.95, "b": 0.1}
BOUNDS = {"a": (0.5, 0.999), "b": (0.01, 1.0)}
TANK, TANK_BOUNDS, STEPS = {"a": 2.06, "c": 0.485}, {"a": (1.0, 4.0), "c": (0.2, 1.0)}, 50
#: What is said of the noise: nothing, nothing but that no noise drives the equation, or what it is.
SAID = {
    "nothing": {},
    "no noise of the equation": {"noisy": []},
    "coloured, an offset": {"noisy": [], "sensor_noise": {"y": {"correlation": "unknown"}}, "offset": {"y": "unknown"}},
}


def lag() -> DescriptorSystem:
    """Return the plant with the constants of its spec."""
    return uncertain_system(
        {"A": [["a"]], "B": [["b"]], "C": [[1]], "dt": 1.0, "input_names": ["u"], "output_names": ["y"]},
        {"a": {"nominal": 0.9, "tolerance": "20 %"}, "b": {"nominal": 0.1, "tolerance": "90 %"}},
    )


def simulated(seed: int, offset: float) -> dict[str, np.ndarray]:
    """Return one log."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-1.0, 1.0, ROWS // 12), 12)
    x, e, y = 0.0, rng.standard_normal(), np.zeros(ROWS)
    for k in range(ROWS):
        if k:
            x, e = TRUTH["a"] * x + TRUTH["b"] * u[k - 1], KEPT * e + np.sqrt(1.0 - KEPT**2) * rng.standard_normal()
        y[k] = x + DEVIATION * e + offset
    return {"time": np.arange(float(ROWS)), "u": u, "y": y}


def tank() -> DAEModel:
    """Return the nonlinear plant with the constants of its spec."""
    return DAEModel(
        {"balance": "a * der(level) = inflow - c * sqrt(level)"}, {"y": "level"}, states={"level": 1.0},
        inputs={"inflow": 0.5}, constants={"a": 2.0, "c": 0.5},
    )  # fmt: skip


def tank_log(seed: int, offset: float) -> dict[str, np.ndarray]:
    """Return one log of the tank: inflows act during the step that ends at a row."""
    rng = np.random.default_rng(seed)
    inflow = np.repeat(rng.uniform(0.3, 0.7, ROWS // 12), 12)
    level, e, y = 1.0, rng.standard_normal(), np.zeros(ROWS)
    for k in range(ROWS):
        for _ in range(STEPS if k else 0):
            level += (inflow[k] - TANK["c"] * np.sqrt(level)) / TANK["a"] / STEPS
        e = KEPT * e + np.sqrt(1.0 - KEPT**2) * rng.standard_normal() if k else e
        y[k] = level + DEVIATION * e / 5.0 + offset / 5.0
    return {"time": np.arange(float(ROWS)), "inflow": inflow, "y": y}


PLANTS = {"lag": (lag, simulated, BOUNDS, TRUTH), "tank": (tank, tank_log, TANK_BOUNDS, TANK)}


def main() -> None:
    """Print a row for each case."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--plant", choices=list(PLANTS), default="lag")
    options = parser.parse_args()
    plant, log, bounds, truth = PLANTS[options.plant]
    print("| said | offset | logs | box holds | coloured noise taken | offset taken | box says it does not stand |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for said, arguments in SAID.items():
        for offset in (0.0, 5.0 * DEVIATION):
            found = [
                calibrate(plant(), log(seed, offset), bounds, input_delay=0, starts=1, **arguments)
                for seed in range(options.runs)
            ]
            holds = sum(item.box.holds(truth) for item in found)
            counts = [sum(map(bool, part)) for part in zip(*((item.sensor_noise, item.offset, not item.box.stands)
                                                             for item in found), strict=True)]  # fmt: skip
            print(f"| {said} | {offset / DEVIATION:g} deviations | {len(found)} | {holds / len(found):.2f} | "
                  f"{' | '.join(map(str, counts))} |", flush=True)  # fmt: skip


if __name__ == "__main__":
    main()

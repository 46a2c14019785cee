"""Coverage of calibrated boxes where a sensor's noise is coloured, with and without an offset.

    python -m benchmarks.campaigns._calibration_coloured --runs 100

A lag of first order, 240 rows, noise of the sensor of AR(.9) with a deviation of 0.1, inputs that are held for 12 rows;
its 95 % box holds both true constants or does not.  Tells shares and no wrong cases, beside the frame of campaigns.
"""

from __future__ import annotations

import argparse

import numpy as np

from obsynth.calibration.calibrating import calibrate
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.uncertain_system import uncertain_system

ROWS, KEPT, DEVIATION = 240, 0.9, 0.1
TRUTH = {"a": 0.95, "b": 0.1}
BOUNDS = {"a": (0.5, 0.999), "b": (0.01, 1.0)}
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


def main() -> None:
    """Print a row for each case."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=100)
    options = parser.parse_args()
    print("| said | offset | logs | box holds | coloured noise taken | offset taken | box says it does not stand |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for said, arguments in SAID.items():
        for offset in (0.0, 5.0 * DEVIATION):
            found = [
                calibrate(lag(), simulated(seed, offset), BOUNDS, input_delay=0, starts=1, **arguments)
                for seed in range(options.runs)
            ]
            holds = sum(item.box.holds(TRUTH) for item in found)
            counts = [sum(map(bool, part)) for part in zip(*((item.sensor_noise, item.offset, not item.box.stands)
                                                             for item in found), strict=True)]  # fmt: skip
            print(f"| {said} | {offset / DEVIATION:g} deviations | {len(found)} | {holds / len(found):.2f} | "
                  f"{' | '.join(map(str, counts))} |", flush=True)  # fmt: skip


if __name__ == "__main__":
    main()

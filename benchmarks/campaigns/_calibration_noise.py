"""Errors of calibrated noise variances: four linear plants, each simulated many times from known Q and R.

    python -m benchmarks.campaigns._calibration_noise --runs 20

Plants of the kinds for which the reference states what maximum likelihood reaches; nothing but variances is unknown.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass

import numpy as np

from obsynth.monitoring.calibration.calibrating import calibrate
from obsynth.monitoring.calibration.result import Calibration
from obsynth.plants.descriptor import DescriptorSystem

ROWS = 300


@dataclass(frozen=True)
class Case:
    """A plant, the states that noise enters, and the variances: those of the noise, then those of the sensors.

    reference : what the reference states as median errors, in %.
    """

    A: tuple[tuple[float, ...], ...]
    C: tuple[tuple[float, ...], ...]
    noisy: tuple[int, ...]
    Q: tuple[float, ...]
    R: tuple[float, ...]
    reference: tuple[int, ...]


CASES = {
    "3 states, 3 sensors": Case(
        ((0.9, 0.1, 0.0), (-0.1, 0.8, 0.1), (0.0, 0.2, 0.7)), ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
        (0, 1, 2), (1e-2, 4e-3, 2e-2), (1e-2, 2e-2, 5e-3), (16, 15, 22, 13, 19, 6),
    ),
    "3 states, 1 noise, 1 sensor": Case(
        ((0.95, 0.1, 0.0), (0.0, 0.9, 0.1), (0.0, 0.0, 0.8)), ((1.0, 0.0, 0.0),), (2,), (1e-2,), (1e-2,), (24, 6),
    ),
    "2 states, 2 noises, 1 sensor": Case(
        ((0.95, 0.2), (0.0, 0.8)), ((1.0, 0.0),), (0, 1), (1e-3, 1e-2), (1e-2,), (96, 27, 6),
    ),
    "R = 1000 Q": Case(
        ((0.95, 0.2), (-0.1, 0.9)), ((1.0, 0.0), (0.0, 1.0)), (0, 1), (1e-4, 1e-4), (1e-1, 1e-1), (68, 100, 7, 6),
    ),
}  # fmt: skip


def calibrated(case: Case, seed: int) -> Calibration:
    """Return what one simulated log says."""
    A, C, rng = np.array(case.A), np.array(case.C), np.random.default_rng(seed)
    u = 0.3 * np.repeat(rng.uniform(-1.0, 1.0, ROWS // 10), 10)
    x, y = np.zeros(len(A)), np.zeros((ROWS, len(C)))
    for k in range(ROWS):
        y[k] = C @ x + np.sqrt(case.R) * rng.standard_normal(len(C))
        x = A @ x + u[k]
        x[list(case.noisy)] += np.sqrt(case.Q) * rng.standard_normal(len(case.Q))
    plant = DescriptorSystem(None, A, np.ones((len(A), 1)), C, dt=1.0)
    log = {"time": np.arange(float(ROWS)), "u1": u, **{f"y{i + 1}": column for i, column in enumerate(y.T)}}
    return calibrate(plant, log, {}, noisy=[f"x{i + 1}" for i in case.noisy], input_delay=0)


def errors(case: Case, found: Calibration) -> list[float]:
    """Return relative errors; a variance that is told by its upper limit counts as one hundred per cent."""
    true = {**{f"x{i + 1}": q for i, q in zip(case.noisy, case.Q, strict=True)},
            **{f"y{i + 1}": r for i, r in enumerate(case.R)}}  # fmt: skip
    values = {**found.Q, **found.R}
    return [1.0 if name in found.upper_limits else abs(values[name] / truth - 1.0) for name, truth in true.items()]


def main() -> None:
    """Print a row for each case."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=20)
    options = parser.parse_args()
    print("| case | median error in %, Q then R | of the reference's plants | told as upper limits |")
    print("| --- | --- | --- | --- |")
    for name, case in CASES.items():
        runs = [calibrated(case, seed) for seed in range(options.runs)]
        medians = 100.0 * np.median([errors(case, found) for found in runs], axis=0)
        limits = sum(len(found.upper_limits) for found in runs)
        told = " ".join(f"{value:.0f}" for value in medians)
        print(f"| {name} | {told} | {' '.join(map(str, case.reference))} | {limits} of "
              f"{len(runs) * (len(case.Q) + len(case.R))} |")  # fmt: skip


if __name__ == "__main__":
    main()

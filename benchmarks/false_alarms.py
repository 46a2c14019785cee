"""False alarms per run of the four decisions, against the probability that was asked for.

Usage: ``python benchmarks/false_alarms.py [runs]``.  Records of 300 samples of three plants, simulated consistently
with their noise and with nominal parameters, complete and with a tenth of the samples missing.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import dataclasses
import platform
import sys
from typing import get_args

import numpy as np

import obsynth
from obsynth.monitoring.thresholds.parameter_decisions import Statistic

STATISTICS = get_args(Statistic)
SAMPLES, MISSING, ASKED = 300, 0.1, (0.01, 0.05, 0.2)

PLANTS = {
    "two states, one output, one parameter": obsynth.TimeVaryingDescriptorSystem(
        None, [[0.9, 0.2], ["-0.1 * sin(k)", 0.7]], C=[[1, 0.5]], Phi=[[1], ["cos(0.5 * k)"]], dt=1.0,
        horizon=SAMPLES + 1,
    ),
    "an algebraic equation, two parameters": obsynth.TimeVaryingDescriptorSystem(
        [[1, 0, "0.1 * sin(0.3 * k)"], [0, 1, 0], [0, 0, 0]],
        [["0.8 + 0.1 * cos(0.2 * k)", 0.1, 0.3], [0, 0.7, "0.2 * sin(k)"], [1, "0.4 + 0.1 * sin(k)", -1]],
        C=[[1, 0, "0.3 + 0.1 * cos(k)"], [0, 1, 1]], Phi=[["sin(0.7 * k)", 0.3], [1, "cos(1.1 * k)"], [0.2, 0]],
        Psi=[[0, 0.1], ["0.2 * cos(k)", 0]], dt=1.0, horizon=SAMPLES + 1,
    ),
    "four outputs, three parameters": obsynth.TimeVaryingDescriptorSystem(
        None, 0.9 * np.linalg.qr(np.random.default_rng(1).standard_normal((6, 6)))[0],
        C=np.random.default_rng(2).standard_normal((4, 6)), Phi=np.random.default_rng(3).standard_normal((6, 3)),
        dt=1.0, horizon=SAMPLES + 1,
    ),
}  # fmt: skip


def record(plant: obsynth.TimeVaryingDescriptorSystem, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return outputs with unit noise everywhere, and a prior mean that errs as much as the prior says."""
    run = obsynth.simulate_time_varying(
        plant, samples=SAMPLES, equation_noise=rng.standard_normal((SAMPLES, plant.ne)),
        output_noise=rng.standard_normal((SAMPLES - 1, plant.ny)),
    )  # fmt: skip
    return run.outputs, run.states[0] + rng.standard_normal(plant.nx)


def alarms(
    plant: obsynth.TimeVaryingDescriptorSystem, observer: obsynth.RecursiveObserver, runs: int, missing: float
) -> dict[str, list[float]]:
    """Return, for each statistic, the share of runs with a false alarm at each probability asked for."""
    rng = np.random.default_rng(20130703)
    count = {name: np.zeros(len(ASKED)) for name in STATISTICS}
    for _ in range(runs):
        y, mean = record(plant, rng)
        y = np.where(rng.random(y.shape) < missing, np.nan, y)
        here = dataclasses.replace(observer, initial_state=mean)
        found = here.run(y)
        for name in STATISTICS:
            for i in reversed(range(len(ASKED))):
                decision = obsynth.decide(here, found, statistic=name, false_alarms=ASKED[i], change=0.3)
                if decision.alarm is None:
                    # A smaller probability has a larger threshold.
                    break
                count[name][i] += 1.0
    return {name: list(found / runs) for name, found in count.items()}


def main() -> None:
    """Print the table."""
    runs = int(sys.argv[1]) if len(sys.argv) > 1 else 400
    print(f"Python {platform.python_version()}, numpy {np.__version__}, {runs} runs of {SAMPLES} samples")
    print("| plant | " + " | ".join(STATISTICS) + " |")
    print("| --- |" + " --- |" * len(STATISTICS))
    for name, plant in PLANTS.items():
        observer = obsynth.adaptive_observer(plant, Q=1.0, R=1.0, forgetting=0.97).observer
        for missing in (0.0, MISSING):
            found = alarms(plant, observer, runs, missing)
            label = name + (f", {missing:.0%} missing" if missing else "")
            cells = [" / ".join(f"{100 * share:.1f}" for share in found[statistic]) for statistic in STATISTICS]
            print(f"| {label} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()

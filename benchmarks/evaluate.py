"""Trial-steps per second of `obsynth.evaluate`, beside python-control's `forced_response` on the same realisation.

One trial of `evaluate` draws noise, simulates the plant, runs the observer, watches its residual and takes the errors;
`forced_response` runs the observer's realisation alone, on records that exist already.  What both give is compared
first.  Processor time, best of several, one thread: set OMP_NUM_THREADS=1.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path

import control
import numpy as np

import obsynth
from obsynth.simulation.benches import make_bench

sys.path.insert(0, str(Path(__file__).parent))
from run_on_data import made_up

STEPS = 500
REPEATS = 5


def best(work: Callable[[], object], count: int) -> float:
    """Return ``count`` per second of processor time, best of several."""
    seconds = []
    for _ in range(REPEATS):
        begin = time.process_time()
        work()
        seconds.append(time.process_time() - begin)
    return count / min(seconds)


def rates(nx: int, steps: int, runs: int) -> list[float]:
    """Return trial-steps per second: evaluate, plant and observer alone, observer alone, forced_response."""
    design = made_up(nx)
    plant = design.linear[0]
    noisy = plant.replace(Bw=np.eye(nx, 2), Dw=np.zeros((plant.ny, 2)), noise_names=None)
    design = design.replace(plant=noisy)
    scenario = obsynth.Scenario(
        horizon=(steps - 1) * plant.dt, noise=1.0, sensor_noise=dict.fromkeys(plant.output_names, 0.1),
        inputs={name: obsynth.Sine(amplitude=1.0, frequency=3.0) for name in plant.input_names},
        faults={plant.fault_names[0]: obsynth.Step(size=1.0, start=0.5 * steps * plant.dt)},
    )  # fmt: skip
    bench = make_bench(design, scenario)
    seeds = range(runs)
    found = bench.run(seeds)
    system = design.to_control()
    stamps = plant.dt * np.arange(steps)
    records = [np.hstack([found.inputs[:, i], found.outputs[:, i]]).T for i in range(runs)]
    for i, record in enumerate(records[:3]):
        wanted = control.forced_response(system, stamps, record).outputs.T
        assert np.abs(found.rows[:, i] - wanted).max() < 1e-9 * np.abs(wanted).max()
    total = steps * runs

    def one_by_one() -> None:
        for record in records:
            control.forced_response(system, stamps, record)

    return [
        best(lambda: obsynth.evaluate(design, scenario, runs=runs), total),
        best(lambda: bench.run(seeds), total),
        best(lambda: bench.observed(found.outputs, found.inputs), total),
        best(one_by_one, total),
    ]


def main() -> None:
    """Print one line of the table for each size."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--small", action="store_true", help="one small instance, to see that it runs")
    small = parser.parse_args().small
    print("| nx | evaluate | plant and observer | observer | control, forced_response |")
    print("| --- | --- | --- | --- | --- |")
    for nx in (4,) if small else (4, 20, 100):
        row = rates(nx, 50 if small else STEPS, 20 if small else 200)
        print(f"| {nx} | " + " | ".join(f"{rate:,.0f}" for rate in row) + " |", flush=True)


if __name__ == "__main__":
    main()

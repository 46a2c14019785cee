"""Thousands of small designs: processor milliseconds of a design with its proof, plants of order 6.

Usage: ``python benchmarks/small_designs.py [--plants 20] [--runs 4] [--method ...]``: median over the plants of the
least of the runs, on one thread; each run makes its plant anew, so that nothing decided of a plant is counted twice.
``--profile FILE`` writes what cProfile measures over the plants.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import cProfile
import statistics
import time

import numpy as np

import obsynth

ORDER, OUTPUTS = 6, 3
METHODS = ("fault-estimation-filter", "descriptor-kalman", "ui-pi-observer", "pd-observer")


def small_plant(index: int) -> obsynth.DescriptorSystem:
    """Return a stable plant with three outputs with noise, one fault and one unknown input, sampled."""
    rng = np.random.default_rng([52, index])
    a = rng.normal(size=(ORDER, ORDER))
    a *= 0.9 / np.max(np.abs(np.linalg.eigvals(a)))
    c, bf, bd = (rng.normal(size=shape) for shape in ((OUTPUTS, ORDER), (ORDER, 1), (ORDER, 1)))
    noise = {f"y{i + 1}": 0.1 for i in range(OUTPUTS)}
    return obsynth.DescriptorSystem(A=a, C=c, Bf=bf, Bd=bd, dt=0.1, sensor_noise=noise)


def spent(index: int, method: str) -> float:
    """Return processor milliseconds of a verified design."""
    plant = small_plant(index)
    start = time.process_time()
    design = obsynth.design(plant, method)
    seconds = time.process_time() - start
    assert design.report.passed
    return 1e3 * seconds


def main() -> None:
    """Print a line for each method."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--plants", type=int, default=20)
    parser.add_argument("--runs", type=int, default=4)
    parser.add_argument("--method", nargs="*", default=METHODS[:2], choices=METHODS)
    parser.add_argument("--profile")
    arguments = parser.parse_args()
    for method in arguments.method:
        spent(arguments.plants, method)
        if arguments.profile:
            profile = cProfile.Profile(time.process_time)
            with profile:
                for index in range(arguments.plants):
                    spent(index, method)
            profile.dump_stats(arguments.profile)
            continue
        least = [min(spent(index, method) for _ in range(arguments.runs)) for index in range(arguments.plants)]
        print(f"{method}: median {statistics.median(least):.1f} ms, worst {max(least):.1f} ms")


if __name__ == "__main__":
    main()

"""What BLAS threads cost: the same synthesis on one and on two, processor and wall time.

``python benchmarks/blas_threads.py [sizes ...]`` prints the table of ``benchmarks/README.md``; ``--small`` runs one
small row.  The public functions set one thread by themselves, so that the method is called directly here.
"""

from __future__ import annotations

import sys
import time
from importlib import import_module

import scipy.linalg  # noqa: F401 - its BLAS must be loaded to be limited
from fault_estimation_filter import random_plant
from threadpoolctl import threadpool_limits

import obsynth
from obsynth.methods.fault_estimation_filter.method import FaultEstimationFilter

THREADS = (1, 2)


def seconds(plant: obsynth.DescriptorSystem, threads: int) -> tuple[float, float]:
    """Return processor and wall time of one synthesis of a fault-estimation filter by its Riccati engine."""
    method = import_module("obsynth.methods.fault_estimation_filter.synthesis")
    with threadpool_limits(limits=threads, user_api="blas"):
        began, clock = time.process_time(), time.perf_counter()
        method.synthesise(plant, FaultEstimationFilter(engine="riccati"), progress=lambda _: None)
        return time.process_time() - began, time.perf_counter() - clock


def main(arguments: list[str]) -> None:
    """Print the table."""
    small = "--small" in arguments
    sizes = [int(item) for item in arguments if item.isdigit()] or ([6] if small else [8, 16, 32, 48, 64])
    print(
        "| nx | " + " | ".join(f"{count} thread{'s' if count > 1 else ''}: processor, wall" for count in THREADS) + " |"
    )
    print("| --- | --- | --- |")
    seconds(random_plant(6, "brief", 0), 1)
    for nx in sizes:
        found = [seconds(random_plant(nx, "brief", 0), threads) for threads in THREADS]
        print(f"| {nx} | " + " | ".join(f"{cpu:.2f} s, {wall:.2f} s" for cpu, wall in found) + " |", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])

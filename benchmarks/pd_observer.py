"""The PD observer's engines, from the plant to the verified design: processor time on one thread, and the gains.

``python benchmarks/pd_observer.py [sizes ...]`` prints the table of ``benchmarks/README.md``; a size is the number of
unknown states, two of them faults.  ``--small`` runs one small row, so that nothing here can rot.
"""

from __future__ import annotations

import os
import sys
import time

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

import obsynth

FAULTS = 2
#: Above these sizes an engine is left out: the whole inequality takes a gigabyte at 48, the smaller one minutes at 64.
MOST_STATES = {"lmi": 48, "riccati": 10_000}


def random_plant(states: int, seed: int = 0) -> obsynth.DescriptorSystem:
    """Return a plant with two faults, a quarter as many outputs as unknown states, and modes up to 1 rad/s."""
    rng = np.random.default_rng([states, seed])
    nx, ny = states - FAULTS, max(FAULTS, states // 4)
    a = rng.normal(size=(nx, nx)) / np.sqrt(nx)
    return obsynth.DescriptorSystem(
        None, a, C=rng.normal(size=(ny, nx)) / np.sqrt(nx), Bf=rng.normal(size=(nx, FAULTS))
    )


def cell(plant: obsynth.DescriptorSystem, engine: str) -> str:
    """Return processor time, gain and slowest mode of a verified design; or what went wrong."""
    began = time.process_time()
    try:
        design = obsynth.pd_observer(plant, engine=engine, delta=0.1, decay=0.1)
    except obsynth.ObsynthError as error:
        return f"{time.process_time() - began:.2f} s, {type(error).__name__}"
    spent = time.process_time() - began
    ran = "" if design.solver["engine"] == engine else f" ({design.solver['engine']})"
    gain, slowest = design.report["gain"].value, -design.report["error system"].value
    return f"{spent:.2f} s{ran}, {gain:.3g}, {slowest:.2g}"


def main(arguments: list[str]) -> None:
    """Print the table."""
    small = "--small" in arguments
    sizes = [int(item) for item in arguments if item.isdigit()] or ([6] if small else [8, 16, 32, 48, 100, 200])
    print("| unknown states | " + " | ".join(MOST_STATES) + " |")
    print("| --- |" + " --- |" * len(MOST_STATES))
    # What is loaded at the first design is not a design's time.
    cell(random_plant(6), "lmi")
    for states in sizes:
        cells = [cell(random_plant(states), engine) if states <= most else "-" for engine, most in MOST_STATES.items()]
        print(f"| {states} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])

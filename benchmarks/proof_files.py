"""Times of proof files by size: a full-order observer of a random plant, exported and checked in a process of its own.

python benchmarks/proof_files.py 10 20 50 100
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

import obsynth
from obsynth.exporting.independent import checker_path
from obsynth.exporting.proof_file import write_proof


def main(sizes: list[int]) -> None:
    """Print one row of a table for each number of states."""
    print("| states | export, s | check, s | file, MB |\n| --- | --- | --- | --- |")
    for size in sizes:
        rng = np.random.default_rng(size)
        a = rng.standard_normal((size, size))
        a *= 0.9 / np.abs(np.linalg.eigvals(a)).max()
        plant = obsynth.DescriptorSystem(
            None, a, np.zeros((size, 1)), rng.standard_normal((3, size)), Bf=rng.standard_normal((size, 1)),
            Bd=0.1 * rng.standard_normal((size, 1)), dt=0.1,
        )  # fmt: skip
        design = obsynth.fault_estimation_filter(plant)
        with tempfile.TemporaryDirectory() as folder:
            place, begin = Path(folder) / "proof.json", time.perf_counter()
            write_proof(design, place)
            written = time.perf_counter()
            found = subprocess.run(
                [sys.executable, "-I", str(checker_path()), str(place)], capture_output=True, check=True
            )
            checked = time.perf_counter()
            if b"are proved" not in found.stdout:
                raise AssertionError(found.stdout.decode())
            size_of_file = place.stat().st_size / 1e6
        print(f"| {size} | {written - begin:.2g} | {checked - written:.2g} | {size_of_file:.2g} |", flush=True)


if __name__ == "__main__":
    main([int(argument) for argument in sys.argv[1:]] or [5, 10, 20, 50])

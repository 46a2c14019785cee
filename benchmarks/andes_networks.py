"""Networks as the simulator ANDES ships them: every method from the pencil to the verified design.

``python benchmarks/networks.py --andes [case ...] [--seeds 1 2 3] [--limit SECONDS]`` prints the table of
``benchmarks/README.md``.  ANDES (``pip install andes``) writes each case as a pencil once; everything that is measured
runs in a process of its own without ANDES, with a limit on its processor time.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

#: Cases by their name in the table, below the folder of ANDES' cases.
CASES = {
    "kundur": "kundur/kundur_full.xlsx",
    "ieee14": "ieee14/ieee14_full.xlsx",
    "ieee39": "ieee39/ieee39_full.xlsx",
    "npcc": "npcc/npcc.xlsx",
    "wecc": "wecc/wecc_full.xlsx",
}
#: What is measured: each method's design with its verification, and the conditions of all methods.
WORK = ("check", "fault-estimation-filter", "descriptor-kalman", "ui-pi-observer", "pd-observer", "functional-filter")
#: On the plant that is not sampled, as no other is taken.
CONTINUOUS = ("pd-observer",)
#: Share of the buses whose angle and voltage are measured (a phasor measurement unit), and of the machines whose speed
#: is; how many mechanical torques may be wrong, and how many loads are unknown.
SHARE_OF_BUSES, SHARE_OF_SPEEDS, FAULTS, LOADS = 0.3, 0.5, 2, 2
SAMPLE_TIME, NOISE = 0.02, 1e-4

_ONE = """\
import json, sys, time
import obsynth
folder, work, signals = sys.argv[1], sys.argv[2], json.loads(sys.argv[3])
plant = obsynth.from_andes(
    folder, outputs=signals["outputs"], faults=signals["faults"], disturbances=signals["loads"],
    sensor_noise={name: signals["noise"] for name in signals["outputs"]},
)
begin = time.process_time()
sampled = obsynth.eliminate_algebraic_states(plant)
if work not in signals["continuous"]:
    sampled = obsynth.discretise(sampled, signals["dt"])
ready = time.process_time()
found = {"states": sampled.plant.nx, "outputs": sampled.plant.ny, "ready": ready - begin}
try:
    if work == "check":
        told = obsynth.check(sampled)
        found["verdict"] = "possible: " + ", ".join(method for method, report in told.items() if report.passed)
    else:
        design = obsynth.design(sampled, work)
        found["verdict"] = "verified" if design.report.passed else "not verified"
except obsynth.ObsynthError as error:
    found["verdict"] = f"{type(error).__name__}: {error}"
found["seconds"] = time.process_time() - ready
lines = open("/proc/self/status").read().splitlines()
found["MB"] = next(int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM"))
print(json.dumps(found))
"""


def write_case(case: str, folder: Path) -> list[str]:
    """Write a case of ANDES as a pencil, and return the names of its variables."""
    import andes
    from scipy.io import mmwrite
    from scipy.sparse import coo_array

    import obsynth

    root = Path(andes.__file__).parent / "cases"
    system = andes.load(str(root / CASES[case]), no_output=True, default_config=True, setup=True)
    system.PFlow.run()
    network = obsynth.from_andes(system, outputs=[str(system.dae.y_name[0])])
    folder.mkdir()
    for name, matrix in (("E", network.E), ("A", network.A)):
        mmwrite(folder / f"{name}.mtx", coo_array(matrix))
    names = list(network.state_names)
    (folder / "names.json").write_text(json.dumps({"differential": names, "algebraic": []}), encoding="utf-8")
    return names


def drawn_signals(names: list[str], seed: int) -> dict:
    """Return sensors, faults and unknown loads that a seed picks among the variables of a network."""
    rng = np.random.default_rng([20261128, seed])
    machines = [name for name in names if name.startswith("omega GEN")]
    buses = [name.removeprefix("v ") for name in names if name.startswith("v Bus ")]
    seen = rng.choice(buses, max(4, round(SHARE_OF_BUSES * len(buses))), replace=False)
    speeds = rng.choice(machines, max(2, round(SHARE_OF_SPEEDS * len(machines))), replace=False)
    torques = [name.replace("omega", "tm", 1) for name in rng.choice(machines, FAULTS, replace=False)]
    return {
        "outputs": [*sorted(map(str, speeds)), *(f"{kind} {bus}" for bus in sorted(map(str, seen)) for kind in "av")],
        "faults": [str(name) for name in torques],
        "loads": [f"a {bus}" for bus in rng.choice(buses, LOADS, replace=False)],
        "noise": NOISE,
        "dt": SAMPLE_TIME,
        "continuous": CONTINUOUS,
    }


def measured(folder: Path, work: str, signals: dict, limit: int) -> dict:
    """Return what a fresh process measures, within a limit of processor seconds."""
    done = subprocess.run(
        [sys.executable, "-c", _ONE, str(folder), work, json.dumps(signals)],
        capture_output=True, text=True, check=False,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_CPU, (limit, limit + 1)),
        env={**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
    )  # fmt: skip
    if done.returncode < 0:
        return {"seconds": float("inf"), "MB": float("nan"), "verdict": f"ended after {limit} s"}
    if done.returncode:
        return {"seconds": float("nan"), "MB": float("nan"), "verdict": done.stderr.strip().splitlines()[-1]}
    return json.loads(done.stdout.splitlines()[-1])


def row(case: str, work: str, found: list[dict], limit: int) -> str:
    """Return a line of the table."""
    seconds = sorted(item["seconds"] for item in found)
    median, worst = (f"{value:.1f}" if value < float("inf") else f"> {limit}" for value in (
        seconds[len(seconds) // 2], seconds[-1],
    ))  # fmt: skip
    verdicts = [" ".join(item["verdict"].split())[:90].replace("|", "/") for item in found]
    told = "; ".join(f"{verdicts.count(text)} of {len(found)}: {text}" for text in dict.fromkeys(verdicts))
    memory = np.nanmax([item["MB"] for item in found] or [np.nan])
    states = next((item["states"] for item in found if "states" in item), "-")
    return f"| {case}, {states} | {work} | {median}, {worst} | {memory:.0f} | {told} |"


def main(arguments: list[str]) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cases", nargs="*", default=list(CASES), metavar="case", help=f"of {', '.join(CASES)}")
    parser.add_argument("--seeds", nargs="+", type=int, default=[1, 2, 3, 4, 5])
    parser.add_argument("--work", nargs="+", choices=WORK, default=list(WORK))
    parser.add_argument("--limit", type=int, default=120, help="processor seconds of one process (default 120)")
    given = parser.parse_args(arguments)
    print("| case, dynamic states | work | s: median, worst | MB | verdict |\n| --- | --- | --- | --- | --- |")
    with tempfile.TemporaryDirectory() as name:
        for case in given.cases:
            names = write_case(case, Path(name) / case)
            signals = [drawn_signals(names, seed) for seed in given.seeds]
            for work in given.work:
                found = [measured(Path(name) / case, work, item, given.limit) for item in signals]
                print(row(case, work, found, given.limit), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])

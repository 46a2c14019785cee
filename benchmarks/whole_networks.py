"""Whole networks: load, eliminate, design and verify; each case in a process of its own, with its memory.

``python benchmarks/whole_networks.py [elimination | designs | checks | many]``; the networks are those of
``benchmarks/networks.py``, whose reduced matrix is compared with LAPACK's.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from networks import random_network, write

SEEDS = (1, 2, 3)
#: Variables at fixed dynamic states, for the growth of load and elimination.
GROWTH = (300, 1000, 2400, 5000, 10_000)
CASES = (
    (700, 150, "fault-estimation-filter"), (700, 150, "ui-pi-observer"), (700, 150, "pd-observer"),
    (700, 150, "descriptor-kalman"), (1750, 330, "fault-estimation-filter"), (2400, 565, "fault-estimation-filter"),
    (2400, 565, "pd-observer"), (2400, 565, "descriptor-kalman"),
)  # fmt: skip

_ONE = """\
import json, sys, time
from pathlib import Path
import numpy as np
from obsynth.specs.loader import load_spec
spec = load_spec(sys.argv[1])
loaded = time.process_time()
found = {"load": loaded, "states": spec.plant.nx, "dropped": list(spec.transformation.dropped)}
if spec.transformation.bounds is not None:
    found["error"] = spec.transformation.bounds.forward_error
if len(sys.argv) > 2 and sys.argv[2] == "design":
    import obsynth
    design = obsynth.design(spec.plant, spec.method, recovery=spec.transformation.recovery, **spec.options)
    found |= {"design": time.process_time() - loaded, "passed": design.report.passed}
if len(sys.argv) > 2 and sys.argv[2] == "matrix":
    found["A"] = spec.plant.A.tolist()
found["total"] = time.process_time()
# Not by getrusage, whose maximum begins with that of the process that started this one.
lines = Path("/proc/self/status").read_text().splitlines()
found["MB"] = next(int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM"))
print(json.dumps(found))
"""


def one(spec: Path, *what: str) -> dict:
    """Return what a fresh process measures, Python and its libraries included."""
    done = subprocess.run([sys.executable, "-c", _ONE, str(spec), *what], capture_output=True, text=True, check=False)
    if done.returncode:
        return {"refused": done.stderr.strip().splitlines()[-1][:200]}
    return json.loads(done.stdout.splitlines()[-1])


_WARM = """\
import sys, time
from obsynth.specs.loader import load_spec
load_spec(sys.argv[1])
begin = time.process_time()
load_spec(sys.argv[2])
print(time.process_time() - begin)
"""


def warm(first: Path, spec: Path) -> float:
    """Return the processor time to load and eliminate one network after another one, all modules being there."""
    done = subprocess.run(
        [sys.executable, "-c", _WARM, str(first), str(spec)], capture_output=True, text=True, check=True
    )
    return float(done.stdout)


def elimination(folder: Path) -> None:
    """Growth of loading and eliminating with the number of variables, at about 60 dynamic states."""
    print(
        "| variables | load and eliminate, s (median, worst) | without imports, s | MB | largest difference to LAPACK |"
    )
    print("| --- | --- | --- | --- | --- |")
    times = []
    write(random_network(400, 60, 0), folder / "first")
    for variables in GROWTH:
        found, errors = [], []
        for seed in SEEDS:
            network = random_network(variables, 60, seed)
            write(network, folder / f"{variables}-{seed}")
            found.append(one(folder / f"{variables}-{seed}" / "ui-pi-observer.yaml", "matrix"))
            if set(found[-1]["dropped"]) != set(network.idle):
                raise SystemExit(f"{variables}, seed {seed}: dropped {found[-1]['dropped']}")
            if variables <= 2400:
                truth = network.truth()
                errors.append(float(np.max(np.abs(truth - np.array(found[-1]["A"]))) / np.max(np.abs(truth))))
        loads = sorted(item["load"] for item in found)
        again = folder / f"{variables}-{SEEDS[0]}" / "ui-pi-observer.yaml"
        times.append(float(np.median([warm(folder / "first" / "ui-pi-observer.yaml", again) for _ in SEEDS])))
        memory = max(item["MB"] for item in found)
        shown = f"{max(errors):.0e}" if errors else "-"
        median = f"{loads[len(loads) // 2]:.2f}, {loads[-1]:.2f}"
        print(f"| {variables} | {median} | {times[-1]:.3f} | {memory:.0f} | {shown} |", flush=True)
    for first in (0, 1, 3):
        exponent = np.polyfit(np.log(GROWTH[first:]), np.log(times[first:]), 1)[0]
        print(f"Exponent from {GROWTH[first]} to {GROWTH[-1]}, without imports: {exponent:.2f}")


def designs(folder: Path, wanted: str = "") -> None:
    """Each method from the files to the verified design."""
    print("| variables, states, method | seconds, all (median, worst) | MB (worst) | verified |")
    print("| --- | --- | --- | --- |")
    for variables, states, method in CASES:
        if wanted and wanted != str(variables):
            continue
        found = []
        for seed in SEEDS:
            place = folder / f"{variables}-{states}-{seed}"
            if not place.exists():
                write(random_network(variables, states, seed), place)
            found.append(one(place / f"{method}.yaml", "design"))
        good = [item for item in found if item.get("passed")]
        seconds = sorted(item["total"] for item in good) or [float("nan")]
        memory = max((item["MB"] for item in good), default=float("nan"))
        said = f"{len(good)} of {len(found)}" + "".join(f"; {item['refused']}" for item in found if "refused" in item)
        dynamic = good[0]["states"] if good else "-"
        print(
            f"| {variables}, {dynamic}, {method} | {seconds[len(seconds) // 2]:.1f}, {seconds[-1]:.1f} | {memory:.0f} "
            f"| {said} |", flush=True,
        )  # fmt: skip


CHECK = """\
import json, sys, time
from dataclasses import replace
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from networks import random_network
import obsynth
network = random_network(int(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4]))
network = replace(network, faults=tuple(f"tm GENROU {k + 1}" for k in range(3)))
reduced = obsynth.eliminate_algebraic_states(network.plant())
sampled = obsynth.discretise(reduced, 0.02)
begin = time.process_time()
found = obsynth.check(sampled)
lines = Path("/proc/self/status").read_text().splitlines()
print(json.dumps({
    "states": sampled.plant.nx, "check": time.process_time() - begin,
    "exists": [method for method, report in found.items() if report.passed],
    "MB": next(int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM")),
}))
"""


def checks() -> None:
    """Every method's conditions on sampled networks with three faults, without making the network."""
    print("| variables, states | seconds (median, worst) | MB (worst) | a design exists by |")
    print("| --- | --- | --- | --- |")
    for variables, states in ((700, 150), (1500, 290), (2400, 565)):
        found = []
        for seed in SEEDS:
            arguments = [str(Path(__file__).parent), str(variables), str(states), str(seed)]
            done = subprocess.run([sys.executable, "-c", CHECK, *arguments], capture_output=True, text=True, check=True)
            found.append(json.loads(done.stdout.splitlines()[-1]))
        seconds = sorted(item["check"] for item in found)
        told = sorted({", ".join(item["exists"]) for item in found})
        print(
            f"| {variables}, {found[0]['states']} | {seconds[len(seconds) // 2]:.1f}, {seconds[-1]:.1f} "
            f"| {max(item['MB'] for item in found):.0f} | {'; '.join(told)} |", flush=True,
        )  # fmt: skip


def many() -> None:
    """Two hundred designs here and on two processes: wall time, and whether the numbers are the same."""
    from concurrent.futures import ProcessPoolExecutor
    from multiprocessing import get_context

    import obsynth

    rng = np.random.default_rng(0)
    plants = {
        f"plant {i}": obsynth.DescriptorSystem(
            None, rng.normal(size=(40, 40)) / 8, C=rng.normal(size=(10, 40)), Bf=rng.normal(size=(40, 2)),
            Bd=rng.normal(size=(40, 2)), dt=1.0,
        )
        for i in range(200)
    }  # fmt: skip
    wall = []
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as executor:
        list(executor.map(abs, range(4)))
        sets = []
        for used in (None, executor):
            begin = time.perf_counter()
            found = obsynth.sweep(plants, method="fault-estimation-filter", executor=used)
            wall.append(time.perf_counter() - begin)
            sets.append([(dict(result.claims), result.status) for result in found.results])
    print(
        f"one process {wall[0]:.1f} s, two {wall[1]:.1f} s: {wall[0] / wall[1]:.2f} times, same: {sets[0] == sets[1]}"
    )


if __name__ == "__main__":
    section, *rest = sys.argv[1:] or ["elimination"]
    with tempfile.TemporaryDirectory() as name:
        if section == "elimination":
            elimination(Path(name))
        elif section == "designs":
            designs(Path(name), *rest)
        elif section == "checks":
            checks()
        else:
            many()

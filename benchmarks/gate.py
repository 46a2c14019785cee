"""Twelve cases, each as a ratio to an anchor measured in the same run: what has become slow is seen at once.

``python benchmarks/gate.py`` takes five seeds from the commit's hash (``--commit HASH`` where there is no repository),
prints a table, and ends with exit code 1 where a ratio is too large for its bound in ``gate_bounds.json``. Of random
filters the median of the seeds is judged, at 1.5 times its bound, and the worst at 5 times: the worst of five varies by
three from commit to commit, the median by a quarter. Other cases have few seeds or none, and the worst is judged, at 2.
``--write`` takes ten seeds and writes the table into ``benchmarks/README.md``; ``--small`` runs one small instance of
each case.
Processor time (user and system) on one BLAS thread; memory is the peak of the process until the case was done.
What else a machine does only adds time (the same design took 1.2 and 3.5 s within an hour): where a ratio is too large,
all is measured anew in a fresh process, twice at most, and the least ratio of each case counts.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import hashlib
import json
import multiprocessing
import resource
import statistics
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from fault_estimation_filter import FAMILIES, direct_inequality, random_plant
from networks import random_network
from recursive_filters import Problem, observer_of
from run_on_data import made_up

import obsynth
from obsynth.analysis.existence.restricted_equivalent import prepare
from obsynth.methods.fault_estimation_filter.convex_problem import gain_problem

HERE = Path(__file__).resolve().parent
ROOT, BOUNDS = HERE.parent, HERE / "gate_bounds.json"
SEEDS, SEEDS_OF_THE_TABLE = 5, 10
#: Fails where the worst ratio is above its bound by more than this factor,
ALLOWED = 2.0
#: and, where there are seeds enough for a median, where the median is above its bound by more than the first of these,
#: or the worst by more than the second.
ALLOWED_OF_MEDIAN, ALLOWED_OF_WORST = 1.5, 5.0

#: Runs of a case and of its anchor that take turns.
IN_TURN = 6
SEEDS_OF_A_MEDIAN = 5
#: So many times everything is measured again where a ratio is too large.
MEASURED_AGAIN = 2
#: The table in the README stands between these lines.
BEGIN, END = "<!-- gate -->", "<!-- end of gate -->"


@dataclass(frozen=True)
class Case:
    """Seconds of ours for each seed, and those of what it is compared with."""

    name: str
    anchor: str
    ours: Sequence[float]
    anchored: float

    @property
    def ratio(self) -> float:
        """What the bound holds for, over the anchor: the median of enough seeds, else the worst."""
        return (statistics.median(self.ours) if self.of_median else max(self.ours)) / self.anchored

    @property
    def of_median(self) -> bool:
        """Whether the bound holds for the median."""
        return len(self.ours) >= SEEDS_OF_A_MEDIAN

    @property
    def excess(self) -> float:
        """What is judged, in units of what is allowed at a bound of 1: too large above the bound."""
        if not self.of_median:
            return self.ratio / ALLOWED
        return max(self.ratio / ALLOWED_OF_MEDIAN, max(self.ours) / self.anchored / ALLOWED_OF_WORST)


def seconds(action: Callable[[], object], runs: int = 1) -> float:
    """Return processor seconds, the least of some runs."""
    found = []
    for _ in range(runs):
        began = time.process_time()
        action()
        found.append(time.process_time() - began)
    return min(found)


def seconds_in_turn(*actions: Callable[[], object], runs: int) -> list[float]:
    """Return processor seconds of each of some actions, the least of some runs: they take turns, as a machine that is
    slower for a while is slower for all of them."""
    rounds = [[seconds(action) for action in actions] for _ in range(runs)]
    return [min(times) for times in zip(*rounds, strict=True)]


def seconds_of_process(arguments: Sequence[str], compiled: Path | None, runs: int) -> float:
    """Return processor seconds of a process of its own, the least of some runs.

    ``compiled``: a folder that the first run puts its byte code into, which is there after an installation."""
    kept = {} if compiled is None else {"PYTHONPYCACHEPREFIX": str(compiled), "PYTHONDONTWRITEBYTECODE": ""}
    own = {**os.environ, **kept}
    found = []
    for _ in range(runs):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run(arguments, stdout=subprocess.DEVNULL, check=True, env=own)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        found.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    return min(found)


def riccati_solution(order: int) -> Callable[[], object]:
    """Return a solution of a discrete Riccati equation of this order by scipy."""
    from scipy.linalg import solve_discrete_are

    rng = np.random.default_rng(order)
    a = rng.normal(size=(order, order)) / np.sqrt(order)
    b = rng.normal(size=(order, 4))
    return lambda: solve_discrete_are(a, b, np.eye(order), np.eye(4))


def singular_values(order: int) -> Callable[[], object]:
    """Return ten singular value decompositions of this order."""
    matrix = np.random.default_rng(order).normal(size=(order, order))
    return lambda: [np.linalg.svd(matrix) for _ in range(10)]


def filters(seeds: Sequence[int], *, small: bool) -> Iterator[Case]:
    """Yield fault-estimation filters beside the paper's inequality as written, and beside a Riccati solution."""
    nx = 8 if small else 16
    obsynth.fault_estimation_filter(random_plant(nx, "brief", 0))  # imports
    for family in FAMILIES:
        ours = [design_seconds(nx, family, seed) for seed in seeds]
        yield Case(f"filter, nx {nx}, {family}", "cvxpy and Clarabel", ours, direct(nx, family, seeds))
    nx = 10 if small else 32
    # By default both weights are tried, and the better one is shipped.
    for weight, name in (("paper", "paper's W"), (None, "both W")):
        ours = [design_seconds(nx, family, seed, weight) for family in FAMILIES for seed in seeds]
        yield Case(f"filter, nx {nx}, {name}", "solve_discrete_are", ours, seconds(riccati_solution(nx), 5))
    nx = 12 if small else 100
    ours = [seconds(lambda p=plant: obsynth.fault_estimation_filter(p)) for plant in plants(nx, "noise", seeds[:2])]
    yield Case(f"filter, nx {nx}, noise", "solve_discrete_are", ours, seconds(riccati_solution(nx), 3))


def design_seconds(nx: int, family: str, seed: int, weight: str | None = None) -> float:
    """Return the seconds of a filter, the least of two; the plant is made anew, as what is decided of one is kept."""
    made = [random_plant(nx, family, seed) for _ in range(2)]
    options = {} if weight is None else {"weight": weight}
    return min(seconds(lambda p=plant: obsynth.fault_estimation_filter(p, **options)) for plant in made)


def direct(nx: int, family: str, seeds: Sequence[int]) -> float:
    """Return the seconds of the paper's inequality, the median of some plants: on one it may end early, in an error."""
    import cvxpy  # noqa: F401 - not part of the time

    found = []
    for plant in plants(nx, family, seeds):
        problem, _ = gain_problem(prepare(plant), free_weight=False)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Clarabel's answer may be inaccurate
            found.append(seconds(lambda p=problem: direct_inequality(p)))
    return statistics.median(found)


def plants(nx: int, family: str, seeds: Sequence[int]) -> list[obsynth.DescriptorSystem]:
    """Return random plants; never the same twice, as what is decided of a plant is kept."""
    return [random_plant(nx, family, seed) for seed in seeds]


def verifications(*, small: bool) -> Iterator[Case]:
    """Yield the share of verification in whole designs."""
    from obsynth.methods.designing import design

    shares = []
    for file in ("smib/spec.yaml",) if small else ("kundur/spec_fault_filter.yaml", "smib/functional.yaml"):
        spec = obsynth.load_spec(ROOT / "designs" / file)
        kept: list[obsynth.ObserverDesign] = []
        whole = seconds(lambda s=spec, k=kept: k.append(design(s.plant, s.method, **dict(s.options))))
        shares.append(seconds(lambda k=kept: obsynth.verify(k[0]), 2) / whole)
    yield Case("verify of kundur, smib functional", "their designs", shares, 1.0)


def commands(*, small: bool) -> Iterator[Case]:
    """Yield the README's first command, without the installation."""
    spec = ROOT / "designs" / "wang2015" / "spec.yaml"
    with tempfile.TemporaryDirectory() as folder:
        code = (
            "import sys; from obsynth.cli.main import design_command; sys.exit(design_command(['--quiet', '--force', "
            f"'--system', {str(spec)!r}, '--output', {str(Path(folder) / 'wang2015.gains.json')!r}]))"
        )
        # One run of each has nothing to gain from byte code of its own.
        compiled, runs = (None, 1) if small else (Path(folder) / "compiled", 4)
        ours = seconds_of_process([sys.executable, "-c", code], compiled, runs)
        anchored = seconds_of_process([sys.executable, "-c", "import numpy"], compiled, runs)
    yield Case("README's first command", "import numpy", [ours], anchored)


def networks(seeds: Sequence[int], *, small: bool) -> Iterator[Case]:
    """Yield what can be asked of networks: kundur in orders of the states that are new, and random ones."""
    spec = obsynth.load_spec(ROOT / "designs" / ("smib" if small else "kundur") / "spec.yaml")
    orders = [reordered(spec.plant, seed) for seed in seeds[:2]]
    ours = [seconds(lambda p=plant: obsynth.check(p)) for plant in orders]
    yield Case("check of kundur", "10 SVDs of 196", ours, seconds(singular_values(196), 2))
    size = (60, 20) if small else (700, 150)
    ours = []
    for seed in seeds[:2]:
        made = replace(random_network(*size, seed), faults=tuple(f"tm GENROU {k + 1}" for k in range(2)))
        sampled = obsynth.discretise(obsynth.eliminate_algebraic_states(made.plant()), 0.02)
        ours.append(seconds(lambda p=sampled: (obsynth.diagnose(p), obsynth.check(p))))
    yield Case(f"check, diagnose, network of {size[1]}", "10 SVDs of 196", ours, seconds(singular_values(196), 2))


def reordered(plant: obsynth.DescriptorSystem, seed: int) -> obsynth.DescriptorSystem:
    """Return a plant with its states and equations in another order."""
    plant, order = plant.dense(), np.random.default_rng(seed).permutation(plant.nx)
    parts = {name: getattr(plant, name)[order] for name in ("B", "Bf", "Bd", "Bw")}
    return plant.replace(
        E=plant.E[np.ix_(order, order)], A=plant.A[np.ix_(order, order)], C=plant.C[:, order],
        state_names=[plant.state_names[i] for i in order], **parts,
    )  # fmt: skip


def records(*, small: bool) -> Iterator[Case]:
    """Yield Kalman filters beside a numpy loop over covariances, and a log beside the reading of it."""
    problem = Problem.of(20, 5, 3)
    if small:
        problem = replace(problem, y=problem.y[:200], u=problem.u[:200])
    observer = observer_of(problem, adaptive=False)
    loop, ours = seconds_in_turn(
        lambda: by_numpy(problem), lambda: observer.run(problem.y, problem.u, compiled=False), runs=IN_TURN
    )
    yield Case("Kalman run, 20 states", "numpy loop", [ours], loop)
    try:
        observer.run(problem.y, problem.u, compiled=True)
    except obsynth.SpecError:  # no numba
        return
    yield Case("Kalman run, 20 states, compiled", "numpy loop",
               [seconds(lambda: observer.run(problem.y, problem.u, compiled=True), 3)], loop)  # fmt: skip


def by_numpy(problem: Problem) -> np.ndarray:
    """Run a plain filter of covariances."""
    x, p, c = np.zeros(problem.nx), np.eye(problem.nx), problem.C
    for k in range(1, len(problem.y)):
        x, p = problem.A @ x + problem.u[k - 1], problem.A @ p @ problem.A.T + problem.Q
        gain = np.linalg.solve(c @ p @ c.T + problem.R, c @ p).T
        x, p = x + gain @ (problem.y[k] - c @ x), p - gain @ c @ p
    return x


def logs(*, small: bool) -> Iterator[Case]:
    """Yield a log as CSV beside the reading of it."""
    import pandas as pd

    design = made_up(4)
    names = [*design.linear[1].input_names, *design.linear[1].output_names]
    rows = 500 if small else 20_000
    frame = pd.DataFrame(np.random.default_rng(0).normal(size=(rows, len(names))), columns=names)
    frame.insert(0, "time", 0.01 * np.arange(rows))
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "log.csv"
        frame.to_csv(file, index=False)
        anchored, ours = seconds_in_turn(
            lambda: pd.read_csv(file), lambda: obsynth.run_on_data(design, file), runs=IN_TURN
        )
        yield Case("run on a log (CSV), 4 states", "pandas.read_csv", [ours], anchored)


def cases(seeds: Sequence[int], *, small: bool) -> Iterator[tuple[Case, int]]:
    """Yield each case with the peak memory of the process until there, MB."""
    parts = (filters(seeds, small=small), verifications(small=small), commands(small=small),
             networks(seeds, small=small), records(small=small), logs(small=small))  # fmt: skip
    for part in parts:
        for case in part:
            yield case, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024


def commit(given: str | None) -> str:
    """Return the commit whose hash gives the seeds."""
    if given:
        return given
    found = subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True, check=False, cwd=ROOT)
    return found.stdout.strip() or "no repository"


def seeds_of(text: str, count: int) -> list[int]:
    """Return seeds that nobody chose."""
    return [int.from_bytes(hashlib.sha256(f"{text} {i}".encode()).digest()[:4], "big") for i in range(count)]


def main() -> int:
    """Print the table; return 1 where a case is too slow for its bound."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--commit", help="hash that gives the seeds (default: that of the repository)")
    parser.add_argument("--write", action="store_true", help="ten seeds; the table goes into benchmarks/README.md")
    parser.add_argument("--small", action="store_true", help="one small instance of each, to see that it runs")
    options = parser.parse_args()
    count = 1 if options.small else SEEDS_OF_THE_TABLE if options.write else SEEDS
    bounds = json.loads(BOUNDS.read_text())
    lines = ["| case | ours, s: median, worst | anchor | anchor, s | median or worst / anchor | bound | MB so far |",
             "| --- | --- | --- | --- | --- | --- | --- |"]  # fmt: skip
    print("\n".join(lines), flush=True)
    missed: dict[str, str] = {}
    seeds = seeds_of(commit(options.commit), count)
    for case, memory in cases(seeds, small=options.small):
        bound = bounds.get(case.name)
        lines.append(
            f"| {case.name} | {statistics.median(case.ours):.3g}, {max(case.ours):.3g} | {case.anchor} | "
            f"{case.anchored:.3g} | {case.ratio:.3g} | {'-' if bound is None else bound} | {memory} |"
        )
        print(lines[-1], flush=True)
        if bound is None and not options.small:
            missed[case.name] = f"no bound in {BOUNDS.name}"
        elif bound is not None and not options.small and case.excess > bound:
            worst = max(case.ours) / case.anchored
            missed[case.name] = f"{case.ratio:.3g} (worst {worst:.3g}) times {case.anchor}, too much for {bound}"
    if options.write:
        write(lines, BEGIN, END)
    for _ in range(MEASURED_AGAIN):
        if not missed.keys() & bounds.keys():
            break
        again = measured_in_a_fresh_process(seeds)
        print("measured again:", ", ".join(f"{name} {again[name].ratio:.3g}" for name in missed if name in again))
        missed = {
            name: text for name, text in missed.items()
            if name not in again or name not in bounds or again[name].excess > bounds[name]
        }  # fmt: skip
    for name, text in missed.items():
        print(f"MISSED: {name}: {text}", file=sys.stderr)
    return 1 if missed else 0


def measured(seeds: Sequence[int]) -> dict[str, Case]:
    """Return each case by its name."""
    return {case.name: case for case, _ in cases(seeds, small=False)}


def measured_in_a_fresh_process(seeds: Sequence[int]) -> dict[str, Case]:
    """Return each case by its name, measured where nothing is remembered."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as process:
        return process.submit(measured, seeds).result()


def write(lines: Sequence[str], begin: str, end: str) -> None:
    """Put a table into the README, between two lines of it."""
    file = HERE / "README.md"
    before, _, rest = file.read_text().partition(begin)
    _, _, after = rest.partition(end)
    file.write_text("\n".join([before + begin, "", *lines, "", end]) + after)


if __name__ == "__main__":
    sys.exit(main())

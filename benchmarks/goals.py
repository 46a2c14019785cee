"""Where every goal of speed stands, with what the first landing took, in one table.

``python benchmarks/goals.py`` takes ten seeds from the commit's hash (``--commit HASH`` where there is no repository)
and prints a row for each goal: median and worst of the seeds in processor seconds on one thread, the peak memory of the
process, and whether the goal is met by the worst of them.  ``--only TEXT`` runs the rows whose group contains the text,
``--small`` a small instance of each, ``--write`` puts the table into ``benchmarks/README.md``.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import json
import statistics
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from dae_adaptive_observer import SPEC, record, stepped
from fault_estimation_filter import FAMILIES, peak, random_plant
from gate import ROOT, commands, commit, design_seconds, direct, networks, seconds, seeds_of, write
from pd_observer import random_plant as many_outputs
from recursive_filters import Problem, observer_of
from ui_pi_observer import rod, timed
from whole_networks import CHECK as ONE_CHECK

import obsynth

HERE = Path(__file__).resolve().parent
SEEDS = 10
#: Seeds of what takes many seconds each, and of the paper's inequality beside a design of 16 and of 32 states.
FEW_SEEDS, DIRECT_SEEDS = 3, {8: 1, 16: 10, 32: 2}
#: Verification may take this share of its design.
SHARE = 1.0 / 3.0
#: The table in the README stands between these lines.
BEGIN, END = "<!-- goals -->", "<!-- end of goals -->"


@dataclass(frozen=True)
class Goal:
    """What was measured on each seed, and the bound of the worst: an upper one, or a lower one for rates."""

    name: str
    unit: str
    found: Sequence[float]
    first: str = "-"
    most: float | None = None
    least: float | None = None
    megabytes: float | None = None

    @property
    def worst(self) -> float:
        """Return the value that the goal is judged by."""
        return max(self.found) if self.least is None else min(self.found)

    def row(self) -> str:
        """Return the row of the table."""
        limit = "-" if self.most is None and self.least is None else f"{self.most or self.least:.3g}"
        met = "-"
        if self.most is not None or self.least is not None:
            good = self.worst <= self.most if self.most is not None else self.worst >= self.least
            met = "yes" if good else "**no**"
        memory = "-" if self.megabytes is None else f"{self.megabytes:.0f}"
        shown = f"{statistics.median(self.found):.3g}, {self.worst:.3g}"
        return f"| {self.name} | {self.unit} | {self.first} | {shown} | {memory} | {limit} | {met} |"


def printed(*arguments: object) -> str:
    """Return the last line that a process of its own prints, which holds nothing but what it measures."""
    done = subprocess.run([sys.executable, *map(str, arguments)], capture_output=True, text=True, check=True)
    return done.stdout.splitlines()[-1]


def filter_alone(nx: int, family: str, seed: int) -> tuple[float, float]:
    """Return seconds and peak memory of a filter, which must be verified."""
    spent, megabytes, verified = printed(HERE / "fault_estimation_filter.py", "--one", nx, family, seed).split()
    if verified != "True":
        raise SystemExit(f"The filter of random_plant({nx}, {family!r}, {seed}) is not verified.")
    return float(spent), float(megabytes)


def check_alone(variables: int, states: int, seed: int) -> tuple[float, float]:
    """Return seconds and peak memory of ``check`` for a sampled network with three faults."""
    found = json.loads(printed("-c", ONE_CHECK, HERE, variables, states, seed))
    return found["check"], found["MB"]


def frame_alone(rows: int) -> tuple[float, float]:
    """Return seconds and peak memory of a run on a frame."""
    spent, megabytes = printed(HERE / "run_on_data.py", "--frame", rows).split()
    return float(spent), float(megabytes)


def filters(seeds: Sequence[int], *, small: bool) -> Iterator[Goal]:
    """Yield fault-estimation filters, alone and beside the paper's inequality as written."""
    first = {8: ".016", 16: ".018", 20: ".024", 24: ".026"}
    obsynth.fault_estimation_filter(random_plant(8, "brief", 0))
    for nx in (8,) if small else (8, 16, 20, 24):
        found = [design_seconds(nx, "noise", seed) for seed in seeds]
        yield Goal(f"filter, nx {nx}, noise", "s", found, first[nx], megabytes=peak())
    for nx, least, before in ((8, 1.0, "-"),) if small else ((16, 20.0, "15.7-28"), (32, 250.0, "171-378")):
        for family in FAMILIES:
            ours = [design_seconds(nx, family, seed) for seed in seeds]
            theirs = direct(nx, family, seeds[: DIRECT_SEEDS[nx]])
            yield Goal(f"nx {nx}, {family}, against direct cvxpy and Clarabel", "times", [theirs / s for s in ours],
                       before, least=least, megabytes=peak())  # fmt: skip


def large(seeds: Sequence[int], *, small: bool) -> Iterator[Goal]:
    """Yield filters of 800 states, each in a process of its own."""
    nx = 20 if small else 800
    for family in FAMILIES:
        found = [filter_alone(nx, family, seed % 1000) for seed in seeds[:FEW_SEEDS]]
        before = "46.0" if family == "noise" else "-"
        yield Goal(f"filter, nx {nx}, {family}", "s", [s for s, _ in found], before, most=15.0)
        yield Goal(f"filter, nx {nx}, {family}: memory", "MB", [mb for _, mb in found], most=400.0)


def verification(seeds: Sequence[int], *, small: bool) -> Iterator[Goal]:
    """Yield designs of committed plants, and the share that verification takes of them."""
    from obsynth.methods.designing import design

    files = {"kundur/spec_fault_filter": ".16", "smib/pd_observer": ".08", "smib/functional": "-", "kundur/spec": "-",
             "motor/spec": "-", "ieee14/spec": "-", "sharepasand/spec": "-", "filasova/spec": "-"}  # fmt: skip
    for file in ("smib/functional",) if small else files:
        work, shares = [], []
        for _ in range(2 if small else FEW_SEEDS + 1):
            # Loaded again each time: what is decided of a plant is kept.
            spec = obsynth.load_spec(ROOT / "designs" / f"{file}.yaml")
            whole, kept = timed(lambda s=spec: design(s.plant, s.method, **dict(s.options)))
            work.append(whole)
            shares.append(seconds(lambda k=kept: obsynth.verify(k)) / whole)
        # The first one loads modules.
        work, shares = work[1:], shares[1:]
        yield Goal(f"design of {file}", "s", work, files[file], megabytes=peak())
        yield Goal(f"verification of {file}", "share of its design", shares, most=SHARE)
    made = {} if small else {"UI-PI, rod of 60": lambda seed: obsynth.ui_pi_observer(rod(60)),
                             "PD, 60 states": lambda seed: obsynth.pd_observer(many_outputs(60, seed))}  # fmt: skip
    for name, make in made.items():
        shares = []
        for seed in seeds[:FEW_SEEDS]:
            whole, kept = timed(lambda s=seed, m=make: m(s))
            shares.append(seconds(lambda k=kept: obsynth.verify(k)) / whole)
        yield Goal(f"verification of {name}", "share of its design", shares, most=SHARE)


def questions(seeds: Sequence[int], *, small: bool) -> Iterator[Goal]:
    """Yield what is asked of networks before a design."""
    (first,) = commands(small=small)
    yield Goal("README's first command", "s", list(first.ours), ".49", most=0.5)
    for case in networks(seeds, small=small):
        if case.name.startswith("check of"):
            yield Goal(case.name, "s", list(case.ours), ".68", megabytes=peak())
    sizes = ((200, 60, 2.0),) if small else ((700, 150, 2.0), (1500, 290, 20.0), (2400, 565, 60.0))
    for variables, states, most in sizes:
        found = [check_alone(variables, states, seed % 1000) for seed in seeds[:FEW_SEEDS]]
        yield Goal(f"check of all methods, network of {variables} variables", "s", [s for s, _ in found], most=most,
                   megabytes=max(mb for _, mb in found))  # fmt: skip
    rng, nx, nf = np.random.default_rng(seeds[0]), 12 if small else 64, 3 if small else 32
    plant = obsynth.DescriptorSystem(
        None,
        rng.normal(size=(nx, nx)) / np.sqrt(2 * nx),
        C=rng.normal(size=(nf + 4, nx)),
        Bf=rng.normal(size=(nx, nf)),
        dt=1.0,
    )
    yield Goal(f"diagnose, {nx} states, {nf} faults", "s", [seconds(lambda: obsynth.diagnose(plant))], "13.4", most=3.0)
    spec = obsynth.load_spec(ROOT / "designs" / ("smib" if small else "kundur") / "spec.yaml")
    yield Goal("sensor_sets that isolate, kundur", "s",
               [seconds(lambda: obsynth.sensor_sets(spec.plant, goal="isolate"))], "7.1", most=2.0)  # fmt: skip


def recursive(seeds: Sequence[int], *, small: bool) -> Iterator[Goal]:
    """Yield steps a second of recursive observers, and those of plain loops beside them."""
    from obsynth.methods.registry import method_class
    from obsynth.observers.nonlinear.building import dae_observer_from_options

    repeats = 1 if small else SEEDS
    for size, least in (((2, 1, 1), 40.3e3), ((20, 5, 3), 27.3e3)):
        problem = Problem.of(*size)
        observer = observer_of(problem, adaptive=False)
        found = rates(lambda o=observer, p=problem: o.run(p.y, p.u, compiled=False), len(problem.y), repeats)
        yield Goal(f"Kalman run, {size[0]} states", "steps/s", found, f"{least:.3g}", least=least, megabytes=peak())
    problem = Problem.of(40, 10, 5)
    observer, plain = observer_of(problem, adaptive=False), numba_loop()
    observer.run(problem.y, problem.u, compiled=True)
    plain(problem.A, problem.C, problem.Q, problem.R, problem.y, problem.u)
    ours = rates(lambda: observer.run(problem.y, problem.u, compiled=True), len(problem.y), repeats)
    loop = rates(
        lambda: plain(problem.A, problem.C, problem.Q, problem.R, problem.y, problem.u), len(problem.y), repeats
    )
    yield Goal(
        "compiled run, 40 states, against a numba loop", "times", [statistics.median(ours) / max(loop)], least=1.0
    )
    spec = obsynth.load_spec(SPEC)
    dae = dae_observer_from_options(spec.plant, method_class("dae-adaptive-observer").of(spec.options).as_given())
    y, u = record(dae, 60 if small else 1001)
    stepped(dae, y, u)
    yield Goal(
        "step of the nonlinear observer", "steps/s", rates(lambda: stepped(dae, y, u), len(y), repeats), least=19e3
    )
    rows = 500 if small else 20_000
    found = [rows / frame_alone(rows)[0] for _ in seeds[:FEW_SEEDS]]
    yield Goal("run on a frame, 4 states", "rows/s", found, "73e3", least=60e3)
    many = rows if small else 1_000_000
    took, memory = frame_alone(many)
    yield Goal(f"run on a frame of {many:,} rows", "rows/s", [many / took])
    yield Goal(f"run on a frame of {many:,} rows: memory", "MB", [memory], most=400.0)


def rates(run: Callable[[], object], steps: int, repeats: int) -> list[float]:
    """Return steps a second of some runs."""
    return [steps / seconds(run) for _ in range(repeats)]


def numba_loop() -> Callable[..., np.ndarray]:
    """Return a plain Kalman filter of covariances, compiled."""
    import numba

    @numba.njit
    def run(a, c, q, r, y, u):
        x, p = np.zeros(len(a)), np.eye(len(a))
        states = np.zeros((len(y), len(a)))
        for k in range(1, len(y)):
            x = a @ x + u[k - 1]
            p = a @ p @ a.T + q
            gain = np.ascontiguousarray(np.linalg.solve(c @ p @ c.T + r, c @ p).T)
            x = x + gain @ (y[k] - c @ x)
            p = p - gain @ (c @ p)
            states[k] = x
        return states

    return run


GROUPS: dict[str, Callable[..., Iterator[Goal]]] = {
    "filters": filters, "large": large, "verification": verification, "questions": questions, "recursive": recursive,
}  # fmt: skip


def main() -> int:
    """Print the table; a goal that is missed is no error."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--commit", help="hash that gives the seeds (default: that of the repository)")
    parser.add_argument("--only", default="", help=f"groups of which the name contains this: {', '.join(GROUPS)}")
    parser.add_argument("--write", action="store_true", help="the table goes into benchmarks/README.md")
    parser.add_argument("--small", action="store_true", help="one small instance of each, to see that it runs")
    options = parser.parse_args()
    seeds = seeds_of(commit(options.commit), 1 if options.small else SEEDS)
    lines = [
        "| what | unit | first landing | median, worst | MB | goal | met |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    print("\n".join(lines), flush=True)
    for name, group in GROUPS.items():
        for goal in group(seeds, small=options.small) if options.only in name else ():
            lines.append(goal.row())
            print(lines[-1], flush=True)
    if options.write:
        write(lines, BEGIN, END)
    return 0


if __name__ == "__main__":
    sys.exit(main())

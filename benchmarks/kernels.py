"""The same answer on every machine: designs made with one processor's BLAS kernels and verified with another's, and
campaigns whose cases must come out the same.  Kernels are chosen by OpenBLAS's own switch (x86-64).

    python -m benchmarks.kernels designs                      every spec under designs/, all pairs of kernels
    python -m benchmarks.kernels campaigns --cases 200        cases of the campaigns on verdicts, every kernel
    python -m benchmarks.kernels designs --specs smib/spec    some specs alone
    python -m benchmarks.kernels random --cases 200           the designs of the campaign on existence, all pairs
    python -m benchmarks.kernels least --cases 200            least gains of fault-estimation filters, every kernel

All print their differences and exit 1 where there is one; ``campaigns`` goes on where an ended run was.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import asdict
from itertools import zip_longest
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, cast

if TYPE_CHECKING:
    from obsynth import DescriptorSystem

ROOT = Path(__file__).parents[1]
KERNELS = ("Haswell", "SkylakeX", "Nehalem", "Prescott")
#: What a process ends with whose kernels need instructions that this processor lacks.
WITHOUT_INSTRUCTIONS = -4
CAMPAIGNS = ("existence", "recursive_existence", "random_tolerances", "diagnosis")
#: Runs beside those of the kernels: a second thread, with the first kernel.
TWO_THREADS = "2 threads"
#: How many other texts a table lists for a campaign and a machine.
LISTED = 10
#: Least gains that are the same, relative to them.
SAME_GAIN = 1e-5


def environment(machine: str) -> dict[str, str]:
    """Return the environment of a process that computes as a machine does."""
    kernel, threads = (KERNELS[0], "2") if machine == TWO_THREADS else (machine, "1")
    return {
        **os.environ, "OPENBLAS_CORETYPE": kernel, "OPENBLAS_NUM_THREADS": threads, "OMP_NUM_THREADS": threads,
        "PYTHONPATH": os.pathsep.join([str(ROOT), *os.environ.get("PYTHONPATH", "").split(os.pathsep)]),
    }  # fmt: skip


def runnable(machines: Sequence[str]) -> list[str]:
    """Return those of some kernels that this processor can run, and say which are left out."""
    product = [sys.executable, "-c", "import numpy; numpy.ones((300, 300)) @ numpy.ones((300, 300))"]
    codes = {machine: subprocess.run(product, env=environment(machine)).returncode for machine in machines}
    left_out = [machine for machine, code in codes.items() if code == WITHOUT_INSTRUCTIONS]
    if left_out:
        print(f"left out, as this processor lacks their instructions: {', '.join(left_out)}", file=sys.stderr)
    return [machine for machine in machines if machine not in left_out]


def started(machine: str, *arguments: str) -> Iterator[dict[str, object]]:
    """Yield the lines of JSON that a process of a machine prints."""
    command = [sys.executable, "-m", "benchmarks.kernels", *arguments]
    with subprocess.Popen(command, env=environment(machine), cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        yield from map(json.loads, process.stdout)
    if process.returncode:
        raise SystemExit(f"{machine}: {' '.join(command)} ended with {process.returncode}")


def all_specs() -> list[str]:
    """Return the specs under designs/, without the parts of them that other specs include."""
    files = sorted((ROOT / "designs").glob("*/*.yaml"))
    return [f"{file.parent.name}/{file.stem}" for file in files if "\nmethod:" in file.read_text(encoding="utf-8")]


def design_all(folder: Path, specs: Iterable[str]) -> None:
    """Design every spec into a folder; a line of JSON for each."""
    from obsynth.cli.main import main

    for spec in specs:
        target = folder / f"{spec.replace('/', '-')}.json"
        system = str(ROOT / "designs" / f"{spec}.yaml")
        given = ["design", "--system", system, "--output", str(target), "--quiet", "--force"]
        with open(os.devnull, "w", encoding="utf-8") as nowhere, redirect_stdout(nowhere), redirect_stderr(nowhere):
            code = main(given)
        print(json.dumps({"spec": spec, "code": code}), flush=True)


def listen(campaign: ModuleType, designed: Callable[[Any], object], refused: Callable[[Exception], object]) -> None:
    """Let functions see what the methods of a campaign answer."""

    def heard(method: Callable[..., object]) -> Callable[..., object]:
        def answered(*given: object, **options: object) -> object:
            try:
                design = method(*given, **options)
            except Exception as error:
                refused(error)
                raise
            designed(design)
            return design

        return answered

    campaign._METHODS = {name: heard(method) for name, method in campaign._METHODS.items()}  # type: ignore[attr-defined]


def design_random(folder: Path, first: int, cases: int) -> None:
    """Design the plants of the campaign on existence into a folder; a line of JSON for each."""
    from benchmarks.campaigns import existence

    from obsynth import ObserverDesign

    kept: list[ObserverDesign] = []
    listen(existence, kept.append, lambda error: None)
    for seed in range(first, first + cases):
        kept.clear()
        outcome = existence.case(seed)
        for design in kept:
            design.save(folder / f"{outcome.group}-{seed}.json")
        print(json.dumps({"spec": f"seed {seed}", "code": outcome.result}), flush=True)


def least_gains(first: int, cases: int) -> None:
    """Search least gains on random plants, with the weight of least norm and a free one; a line of JSON for each."""
    import numpy as np
    from benchmarks.campaigns.conditions import _plant

    from obsynth.analysis.existence.wang2015 import examine_fault_filter
    from obsynth.methods.fault_estimation_filter.convex_problem import centred, gain_problem
    from obsynth.numerics.central_filter import NEGLIGIBLE_GAIN, search_least_gain

    for seed in range(first, first + cases):
        # One in four is usual: the disturbance in all measurements, poles of .7.
        plant = slow_plant(seed) if seed % 4 else _plant(np.random.default_rng([32, seed]))
        held, prepared = examine_fault_filter(plant)
        if prepared is None or not all(condition.holds for condition in held):
            print(json.dumps({"case": f"{seed}", "gain": None}), flush=True)
            continue
        for free in (False, True):
            problem, parts = gain_problem(prepared, free_weight=free)
            found = search_least_gain(centred(problem, prepared, parts)[0])
            # What is left of a disturbance that is decoupled is rounding.
            gain = found.gain if found.gain > NEGLIGIBLE_GAIN * found.starting_gain else 0.0
            print(
                json.dumps({"case": f"{seed}, {'free weight' if free else 'least weight'}", "gain": gain}), flush=True
            )


def slow_plant(seed: int) -> DescriptorSystem:
    """Return a plant as of a network: slow modes, an algebraic state, few disturbances, on odd seeds in all outputs."""
    import numpy as np

    from obsynth import DescriptorSystem

    rng = np.random.default_rng([77, seed])
    n, dt = int(rng.integers(3, 8)), 10.0 ** rng.uniform(-3.0, -1.0)
    modes = rng.normal(size=(n, n))
    A = np.zeros((n + 1, n + 1))
    A[:n, :n] = np.linalg.solve(modes, np.diag(np.exp(-dt * 10.0 ** rng.uniform(-2.0, 1.0, n))) @ modes)
    ny, nd = int(rng.integers(2, 5)), int(rng.integers(1, 3))
    A[n], A[n, n] = rng.normal(size=n + 1), -1.0 - rng.uniform()
    C, Bf, Bd = rng.normal(size=(ny, n + 1)), dt * rng.normal(size=(n + 1, 1)), dt * rng.normal(size=(n + 1, nd))
    Bf[n], Bd[n] = rng.normal(size=1), rng.normal(size=nd)
    Dd = rng.normal(size=(ny, nd)) * (seed % 2)
    return DescriptorSystem(np.diag([1.0] * n + [0.0]), A, None, C, Bf=Bf, Bd=Bd, Dd=Dd, dt=dt)


def compare_least(machines: Sequence[str], first: int, cases: int) -> int:
    """Search least gains on every machine; print those that differ by more than `SAME_GAIN`."""
    gains: dict[str, list[float | None]] = {}
    for machine in machines:
        for line in started(machine, "_least", str(first), str(cases)):
            gains.setdefault(str(line["case"]), []).append(cast("float | None", line["gain"]))
    wrong = 0
    for name, found in gains.items():
        known = [gain for gain in found if gain is not None]
        if len(known) not in (0, len(found)) or max(known, default=0.0) * (1.0 - SAME_GAIN) > min(known, default=0.0):
            wrong += 1
            print(f"{name}: " + ", ".join("none" if gain is None else f"{gain:.8g}" for gain in found))
    print(f"{len(gains)} least gains on {len(machines)} kernels: {wrong} differ by more than {SAME_GAIN:g}")
    return wrong


def verify_all(files: Iterable[Path]) -> None:
    """Verify gain sets; a line of JSON for each: what fails."""
    from obsynth import load, verify

    for file in files:
        report = verify(load(file))
        failed = [f"{row.name}: {row.value:.6g} against {row.bound:.6g}" for row in report.failures]
        print(json.dumps({"file": str(file), "failed": failed}), flush=True)


def compare_designs(machines: Sequence[str], what: Sequence[str], *, worker: str = "_design") -> int:
    """Design on every machine and verify on every other; print what differs."""
    wrong = 0
    with tempfile.TemporaryDirectory() as name:
        codes: dict[str, dict[str, object]] = {}
        for machine in machines:
            folder = Path(name) / machine
            folder.mkdir()
            for line in started(machine, worker, str(folder), *what):
                codes.setdefault(str(line["spec"]), {})[machine] = line["code"]
        for spec, found in codes.items():
            if len(set(found.values())) > 1:
                wrong += 1
                print(f"{spec}: {found}")
        files = sorted(Path(name).glob("*/*.json"))
        for machine in machines:
            others = [str(file) for file in files if file.parent.name != machine]
            listed = Path(name) / f"{machine}.txt"
            listed.write_text("\n".join(others), encoding="utf-8", newline="\n")
            for line in started(machine, "_verify", str(listed)):
                if line["failed"]:
                    wrong += 1
                    print(f"{Path(str(line['file'])).stem}: made on {Path(str(line['file'])).parent.name}, "
                          f"verified on {machine}: {line['failed']}")  # fmt: skip
        made = len(files)
    print(f"{len(codes)} plants, {made} gain sets, {made * (len(machines) - 1)} verifications: {wrong} differences")
    return wrong


def run_cases(campaign: str, first: int, cases: int) -> None:
    """Run the cases of a campaign; a line of JSON for each."""
    from benchmarks.campaigns.frame import load_campaign, outcome_of

    module = load_campaign(campaign)
    told: list[str] = []
    if hasattr(module, "_METHODS"):
        # What a person reads: the summary of a design, or the condition, mode and advice of a refusal.
        listen(module, lambda design: told.append(str(design)), lambda error: told.append(str(error)))
    for seed in range(first, first + cases):
        told.clear()
        outcome = outcome_of(module, seed)
        print(json.dumps({"seed": seed, **asdict(outcome), "told": "\n".join(told)}), flush=True)


def compare_campaigns(machines: Sequence[str], campaigns: Sequence[str], first: int, cases: int, journal: Path) -> str:
    """Run the cases on every machine, and return the table of differences."""
    known: dict[tuple[str, str], dict[int, dict[str, object]]] = {}
    if journal.exists():
        for text in journal.read_text(encoding="utf-8").splitlines():
            line = json.loads(text)
            known.setdefault((line.pop("campaign"), line.pop("machine")), {})[line["seed"]] = line
    rows = ["| campaign | cases | " + " | ".join(machines[1:]) + " |", "| --- | --- |" + " --- |" * (len(machines) - 1)]
    listed, changed = [], []
    for campaign in campaigns:
        for machine in machines:
            found = known.setdefault((campaign, machine), {})
            begin = first
            while begin in found:
                begin += 1
            if begin >= first + cases:
                continue
            with journal.open("a", encoding="utf-8", newline="\n") as stream:
                for line in started(machine, "_cases", campaign, str(begin), str(first + cases - begin)):
                    found[int(str(line["seed"]))] = line
                    stream.write(json.dumps({"campaign": campaign, "machine": machine, **line}) + "\n")
                    stream.flush()
        counts = []
        for machine in machines[1:]:
            pairs = [(known[campaign, machines[0]][seed], known[campaign, machine][seed])
                     for seed in range(first, first + cases)]  # fmt: skip
            differing = [pair for pair in pairs if outcome(pair[0]) != outcome(pair[1])]
            listed += [
                f"- {campaign}, seed {a['seed']}: {machines[0]} {answer(a)} / {answer(b)} {machine}"
                for a, b in differing
            ]
            texts = [line for pair in pairs if pair not in differing for line in other_line(*pair)]
            changed += [f"- {campaign}, {machine}: {line}" for line in texts[:LISTED]]
            counts.append(f"{len(differing)}, {len(texts)} of text")
        rows.append(f"| {campaign} | {first} to {first + cases - 1} | " + " | ".join(counts) + " |")
    told = ["", f"Texts that differ (at most {LISTED} of each):", *changed] if changed else []
    return "\n".join([*rows, "", f"Differences: {len(listed)}.", *listed, *told]) + "\n"


def outcome(line: Mapping[str, object]) -> dict[str, object]:
    """Return a case without what was told of it."""
    return {key: value for key, value in line.items() if key != "told"}


def answer(line: Mapping[str, object]) -> str:
    """Return method, answer and what was wrong as text."""
    return f"{line['group']}: {line['result']}{', ' + str(line['wrong']) if line['wrong'] else ''}"


def other_line(first: Mapping[str, object], second: Mapping[str, object]) -> Iterator[str]:
    """Yield the first line of two texts that is not the same, if there is one."""
    texts = (str(line.get("told", "")).splitlines() for line in (first, second))
    for one, other in zip_longest(*texts, fillvalue=""):
        if one != other:
            yield f"seed {first['seed']}: {one.strip()} / {other.strip()}"
            return


def main() -> int:
    """Run what was asked for."""
    if sys.argv[1:2] == ["_design"]:
        design_all(Path(sys.argv[2]), sys.argv[3:])
        return 0
    if sys.argv[1:2] == ["_verify"]:
        verify_all(map(Path, Path(sys.argv[2]).read_text(encoding="utf-8").splitlines()))
        return 0
    if sys.argv[1:2] == ["_random"]:
        design_random(Path(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4]))
        return 0
    if sys.argv[1:2] == ["_least"]:
        least_gains(int(sys.argv[2]), int(sys.argv[3]))
        return 0
    if sys.argv[1:2] == ["_cases"]:
        run_cases(sys.argv[2], int(sys.argv[3]), int(sys.argv[4]))
        return 0
    parser = argparse.ArgumentParser(prog="python -m benchmarks.kernels", description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)  # fmt: skip
    parser.add_argument("what", choices=("designs", "random", "least", "campaigns"))
    parser.add_argument("--machines", nargs="+", default=list(KERNELS), help=f"kernels, or {TWO_THREADS!r}")
    parser.add_argument("--specs", nargs="+", help="designs: which, such as smib/spec (default: all)")
    parser.add_argument("--campaigns", nargs="+", default=list(CAMPAIGNS), choices=CAMPAIGNS)
    parser.add_argument("--first", type=int, default=0, help="seed of the first case")
    parser.add_argument("--cases", type=int, default=1000, help="how many cases")
    parser.add_argument("--journal", type=Path, default=ROOT / "benchmarks" / "kernels.jsonl")
    options = parser.parse_args()
    machines = runnable(options.machines)
    if options.what == "designs":
        return int(compare_designs(machines, options.specs or all_specs()) > 0)
    if options.what == "random":
        what = [str(options.first), str(options.cases)]
        return int(compare_designs(machines, what, worker="_random") > 0)
    if options.what == "least":
        return int(compare_least(machines, options.first, options.cases) > 0)
    table = compare_campaigns(machines, options.campaigns, options.first, options.cases, options.journal)
    print(table)
    return int("Differences: 0." not in table)


if __name__ == "__main__":
    raise SystemExit(main())

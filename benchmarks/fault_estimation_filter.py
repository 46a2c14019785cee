"""The fault-estimation filter against what a user would write: processor time on one thread, verification included.

``python benchmarks/fault_estimation_filter.py [section ...]`` prints the tables of ``benchmarks/README.md``; sections
are ``speed``, ``growth``, ``verified``, ``constraints`` and ``networks``, all by default, and ``seeds``.  ``--small``
runs a small instance of each, so that nothing here can rot.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import obsynth
from obsynth.analysis.existence.restricted_equivalent import prepare
from obsynth.methods.fault_estimation_filter.convex_problem import centred, gain_problem, with_weight_limit
from obsynth.numerics.injection_problem import GainProblem
from obsynth.numerics.norms import hinf_norm
from obsynth.proofs.definiteness import prove_positive_definite
from obsynth.specs.loader import load_spec

ROOT = Path(__file__).parents[1]
FAMILIES = ("brief", "noise", "delay")
BISECTION_TOLERANCE = 1e-4
STRICTNESS = 1e-6
#: Bound on the residual weight in the section on constraints, relative to the least there is.
WEIGHT_BOUND = 1.5


def random_plant(nx: int, family: str, seed: int) -> obsynth.DescriptorSystem:
    """Return a plant with two faults of index one, E of rank nx - 2, and nx / 4 outputs more than faults.

    ``brief``: two disturbances; ``noise``: nx / 2 + 2, more than the outputs; ``delay``: two, which no output shows at
    once.
    """
    rng = np.random.default_rng([nx, FAMILIES.index(family), seed])
    ny, nd = 2 + max(2, nx // 4), nx // 2 + 2 if family == "noise" else 2
    a = rng.normal(size=(nx, nx))
    a *= 1.1 / np.max(np.abs(np.linalg.eigvals(a)))
    c = rng.normal(size=(ny, nx)) / np.sqrt(nx)
    hidden = rng.normal(size=(nx, 2))
    e = np.eye(nx) - hidden @ np.linalg.pinv(hidden)
    bf, bd = rng.normal(size=(nx, 2)), 0.3 * rng.normal(size=(nx, nd))
    if family == "delay":
        unseen = np.linalg.svd(c)[2][ny:].T
        bd = 0.3 * e @ unseen @ rng.normal(size=(nx - ny, nd))
    return obsynth.DescriptorSystem(e, a, None, c, Bf=bf, Bd=bd, dt=0.1)


@dataclass(frozen=True)
class Script:
    """What a script ends with: the true norm of its filter, and whether its own numbers satisfy its inequality."""

    norm: float
    verified: bool


def inequality(
    problem: GainProblem, p: object, y: object, squared: object, z: object, zd: object
) -> list[list[object]]:
    """Return the blocks of the paper's inequality."""
    a, b, c, d = problem.A, problem.B, problem.C, problem.D
    n, nd, q = len(a), b.shape[1], len(problem.Z)
    return [
        [p, np.zeros((n, nd)), (p @ a - y @ c).T, z.T],
        [np.zeros((nd, n)), squared * np.eye(nd), (p @ b - y @ d).T, zd.T],
        [p @ a - y @ c, p @ b - y @ d, p, np.zeros((n, q))],
        [z, zd, np.zeros((q, n)), np.eye(q)],
    ]


def direct_inequality(problem: GainProblem, level: float | None = None) -> Script:
    """Solve the paper's inequality as written, for the least gamma or at a level."""
    import cvxpy

    n, m, q = problem.order, problem.measured, len(problem.Z)
    limit = problem.weight_limit
    p, y = cvxpy.Variable((n, n), symmetric=True), cvxpy.Variable((n, m))
    v = np.zeros((q, m)) if limit is None else cvxpy.Variable((q, m))
    squared = cvxpy.Variable(nonneg=True) if level is None else level**2
    blocks = inequality(problem, p, y, squared, problem.Z + v @ problem.C, problem.Zd + v @ problem.D)
    whole = cvxpy.bmat(blocks)
    constraints = [whole + whole.T >> STRICTNESS * np.eye(whole.shape[0]), p >> STRICTNESS * np.eye(n)]
    if limit is not None:
        constraints.append(cvxpy.sigma_max(limit.fixed + v @ limit.free) <= limit.bound)
    try:
        cvxpy.Problem(cvxpy.Minimize(0 if level is not None else squared), constraints).solve(solver="CLARABEL")
        v = v if limit is None else v.value
        r = np.linalg.solve(p.value, y.value)
        shown, through = problem.Z + v @ problem.C, problem.Zd + v @ problem.D
        found = inequality(problem, p.value, y.value, level**2 if level else float(squared.value), shown, through)
    except BaseException as error:
        # Clarabel may end in a panic, which is no Exception.
        if isinstance(error, (KeyboardInterrupt, SystemExit)):
            raise
        return Script(np.inf, False)
    matrix = np.block(found)
    proved = prove_positive_definite(0.5 * (matrix + matrix.T)).proved
    if limit is not None:
        proved = proved and bool(np.linalg.norm(limit.fixed + v @ limit.free, 2) <= limit.bound)
    return Script(hinf_norm(problem.A - r @ problem.C, problem.B - r @ problem.D, shown, through).upper, proved)


def rebuilt_bisection(problem: GainProblem, start: float) -> Script:
    """Bisect on gamma and build the inequality anew at each step, as published scripts do."""
    low, high, best = 0.0, start, Script(np.inf, False)
    while high - low > BISECTION_TOLERANCE * high:
        middle = 0.5 * (low + high)
        found = direct_inequality(problem, middle)
        low, high, best = (low, middle, found) if found.norm <= middle else (middle, high, best)
    return best


def timed(action: Callable[[], object]) -> tuple[float, object]:
    """Return processor seconds and the result; an error of ours is a result."""
    began = time.process_time()
    try:
        found = action()
    except obsynth.ObsynthError as error:
        found = error
    return time.process_time() - began, found


def gain_of(found: object) -> float:
    """Return the least gain found; NaN for an error."""
    return found.certificate.claims["gamma_min"] if isinstance(found, obsynth.ObserverDesign) else np.nan


def table(title: str, *columns: str) -> None:
    """Print the head of a table."""
    print(f"\n{title}\n\n| {' | '.join(columns)} |\n|{' --- |' * len(columns)}", flush=True)


def row(*cells: object) -> None:
    """Print a line of a table."""
    print(f"| {' | '.join(map(str, cells))} |", flush=True)


def problem_of(plant: obsynth.DescriptorSystem) -> GainProblem:
    """Return the problem that all ways solve, in balanced coordinates, with W = Upsilon^+ of the outputs as given."""
    prepared = prepare(plant, None)
    problem, parts = gain_problem(prepared, free_weight=False)
    return centred(problem, prepared, parts)[0]


def speed(*, small: bool) -> None:
    """Print times and least gains of every way, and how much longer the scripts take."""
    table(
        "Processor seconds, median over seeds, and largest relative distance of gamma to the best of all ways",
        "nx, family", "seeds", "riccati, paper's W", "lmi", "direct inequality", "rebuilt bisection",
        "direct / riccati", "bisection / riccati",
    )  # fmt: skip
    for nx, seeds, bisected in (
        [(6, 1, FAMILIES[:1])] if small else [(8, 3, FAMILIES), (16, 3, FAMILIES), (32, 1, ("noise",))]
    ):
        for family in FAMILIES:
            seconds: dict[str, list[float]] = {}
            distances: dict[str, list[float]] = {}
            for seed in range(seeds):
                plant = random_plant(nx, family, seed)
                problem = problem_of(plant)
                gains = {}
                for engine in ("auto", "lmi"):
                    spent, found = timed(
                        lambda e=engine, p=plant: obsynth.fault_estimation_filter(p, engine=e, weight="paper")
                    )
                    seconds.setdefault(engine, []).append(spent)
                    gains[engine] = gain_of(found)
                spent, script = timed(lambda p=problem: direct_inequality(p))
                seconds.setdefault("direct", []).append(spent)
                gains["direct"] = script.norm
                if family in bisected and seed == 0:
                    spent, script = timed(lambda p=problem, g=gains["auto"]: rebuilt_bisection(p, 2.0 * g))
                    seconds["bisection"], gains["bisection"] = [spent], script.norm
                for way, gain in gains.items():
                    distances.setdefault(way, []).append(gain / min(gains.values()) - 1.0)
            spent = {way: float(np.median(values)) for way, values in seconds.items()}
            cells = [f"{spent[way]:.3g}, {max(distances[way]):.0e}" for way in ("auto", "lmi", "direct")]
            cells.append(
                f"{spent['bisection']:.3g}, {max(distances['bisection']):.0e}" if "bisection" in spent else "-"
            )
            ratios = [spent[a] / spent[b] if a in spent else np.nan
                      for a, b in (("direct", "auto"), ("bisection", "auto"))]  # fmt: skip
            row(f"{nx}, {family}", seeds, *cells, *("-" if np.isnan(ratio) else f"{ratio:.3g}" for ratio in ratios))


def growth(*, small: bool) -> None:
    """Print processor time and memory of large plants, each in its own process, and the exponent of the medians."""
    table(
        "Many states, default options, several seeds",
        "nx, family", "seeds", "seconds: median, worst", "MB (worst), Python and its libraries included", "verified",
    )  # fmt: skip
    sizes, spent = (((8, 1),) if small else ((100, 3), (200, 3), (400, 3), (800, 2))), {}
    for nx, seeds in sizes:
        for family in FAMILIES if not small else ("brief",):
            found = []
            for seed in range(seeds):
                done = subprocess.run(
                    [sys.executable, __file__, "--one", str(nx), family, str(seed)],
                    capture_output=True, text=True, check=True,
                )  # fmt: skip
                found.append(done.stdout.split())
            seconds = sorted(float(item[0]) for item in found)
            spent.setdefault(family, []).append(float(np.median(seconds)))
            megabytes = max(int(item[1]) for item in found)
            verified = all(item[2] == "True" for item in found)
            row(f"{nx}, {family}", seeds, f"{spent[family][-1]:.2f}, {seconds[-1]:.2f}", megabytes, verified)
    for family, seconds in spent.items() if len(sizes) > 1 else ():
        exponent = np.polyfit(np.log([nx for nx, _ in sizes]), np.log(seconds), 1)[0]
        print(f"\nGrowth exponent, {family}, nx = {sizes[0][0]} to {sizes[-1][0]}: {exponent:.2f}")


def seeds(*, small: bool) -> None:
    """Print the default's processor time at 32 states over ten seeds; the least of three runs of each."""
    table("Ten seeds, default options", "nx, family", "seconds: median, worst", "verified")
    for family in FAMILIES:
        spent, verified = [], True
        for seed in range(1 if small else 10):
            runs = []
            for _ in range(1 if small else 3):
                # A plant made anew: what is known of one is kept for as long as it lives.
                plant = random_plant(8 if small else 32, family, seed)
                runs.append(timed(lambda p=plant: obsynth.fault_estimation_filter(p)))
            spent.append(min(seconds for seconds, _ in runs))
            verified = verified and all(isinstance(found, obsynth.ObserverDesign) for _, found in runs)
        row(f"{8 if small else 32}, {family}", f"{np.median(spent):.4f}, {max(spent):.4f}", verified)


def peak() -> float:
    """Return the peak memory of this process in MB; not by getrusage, whose maximum begins with that of the parent."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM"))


def one(nx: int, family: str, seed: int) -> None:
    """Print processor seconds, memory and outcome of one design (imports and one small design before it)."""
    obsynth.fault_estimation_filter(random_plant(8, family, 0))
    seconds, found = timed(lambda: obsynth.fault_estimation_filter(random_plant(nx, family, seed)))
    print(f"{seconds:.2f} {peak():.0f} {isinstance(found, obsynth.ObserverDesign) and found.report.passed}")


def verified(*, small: bool) -> None:
    """Print the share of verified designs, and of the scripts' answers that meet their own inequality."""
    table("Verified share", "nx, family", "ours", "direct inequality (its own P, Y and gamma)")
    sizes, seeds = ((6,), 1) if small else ((8, 16, 32), 20)
    for nx in sizes:
        for family in FAMILIES:
            plants = [random_plant(nx, family, seed) for seed in range(seeds)]
            designs = [timed(lambda p=plant: obsynth.fault_estimation_filter(p))[1] for plant in plants]
            ours = sum(isinstance(found, obsynth.ObserverDesign) and found.report.passed for found in designs)
            scripts = [direct_inequality(problem_of(plant)) for plant in plants] if nx <= 16 else []
            share = f"{sum(found.verified for found in scripts)} of {seeds}" if scripts else "-"
            row(f"{nx}, {family}", f"{ours} of {seeds}", share)


def constraints(*, small: bool) -> None:
    """Print the whole inequality with a bound on the residual weight, in normalised coordinates and raw."""
    table(
        f"Residual weight free within {WEIGHT_BOUND} times its least norm", "nx, family", "ours verified",
        "ours, seconds", "raw inequality verified", "raw, seconds",
    )  # fmt: skip
    sizes, seeds = ((6,), 1) if small else ((8, 16), 5)
    for nx in sizes:
        for family in FAMILIES if not small else FAMILIES[:1]:
            ours, raw = [], []
            for seed in range(seeds):
                plant = random_plant(nx, family, seed)
                prepared = prepare(plant, None)
                problem, parts = gain_problem(prepared, free_weight=True)
                upsilon = prepared.detectability.Upsilon / prepared.scaling.outputs[:, None]
                bound = WEIGHT_BOUND / np.linalg.svd(upsilon)[1][-1]
                ours.append(timed(lambda p=plant, b=bound: obsynth.fault_estimation_filter(p, residual_weight_limit=b)))
                limited = with_weight_limit(problem, prepared, parts, bound)
                raw.append(timed(lambda p=limited: direct_inequality(p)))
            good = sum(isinstance(found, obsynth.ObserverDesign) and found.report.passed for _, found in ours)
            row(
                f"{nx}, {family}", f"{good} of {seeds}", f"{np.median([s for s, _ in ours]):.2f}",
                f"{sum(found.verified for _, found in raw)} of {seeds}", f"{np.median([s for s, _ in raw]):.2f}",
            )  # fmt: skip


def networks(*, small: bool) -> None:
    """Print wall and processor time from the spec to the verified filter."""
    table(
        "Power networks, from spec to verified filter", "network", "states", "wall", "processor", "verified", "progress"
    )
    for name in ("kundur/spec_fault_filter.yaml",) if small else ("kundur/spec_fault_filter.yaml", "ieee14/spec.yaml"):
        stages: list[str] = []
        wall, processor = time.perf_counter(), time.process_time()
        spec = load_spec(ROOT / "designs" / name)
        found = obsynth.design(spec.plant, spec.method, progress=stages.append, **dict(spec.options))
        wall, processor = time.perf_counter() - wall, time.process_time() - processor
        row(name, spec.plant.nx, f"{wall:.2f} s", f"{processor:.2f} s", found.report.passed, f"{len(stages)} stages")


SECTIONS = {
    "speed": speed, "growth": growth, "verified": verified, "constraints": constraints, "networks": networks,
    "seeds": seeds,
}  # fmt: skip


def main(arguments: list[str]) -> None:
    """Print the tables asked for."""
    if "--one" in arguments:
        one(int(arguments[1]), arguments[2], int(arguments[3]))
        return
    obsynth.fault_estimation_filter(random_plant(6, "brief", 0), engine="lmi")  # imports are no part of any time
    for name, section in SECTIONS.items():
        if name in arguments or (name != "seeds" and not set(SECTIONS) & set(arguments)):
            section(small="--small" in arguments)


if __name__ == "__main__":
    main(sys.argv[1:])

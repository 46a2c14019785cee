"""Guaranteed tests of shipped plants on windows at all bounds at once: no alarm is false, no fault is missed.

Disturbances, noise and known inputs jump between their bounds at random, states start anywhere, and the faults that a
test is blind to do what they like.  2,000 windows without the fault, and 400 with one of twice the threshold, either
sign, for each test: the row never passes its threshold (with what rounding may add) without the fault and always does
with it, and so does the least interval of the same samples, which holds the fault (one window in twenty).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from benchmarks.campaigns.frame import Outcome

import obsynth as ob
from obsynth.methods.guaranteed_test.exact import Programmes
from obsynth.methods.guaranteed_test.method import GuaranteedTestMethod
from obsynth.methods.guaranteed_test.problem import window_as_designed

ROOT = Path(__file__).parents[2]
LIMIT = 120.0  # s
WINDOWS, FAULTY, EXACT = 100, 20, 20
#: Known inputs jump by so much, and states start within as much.
SIZE = 3.0


def _spec(name: str) -> Callable[[], ob.GuaranteedTest]:
    def made() -> ob.GuaranteedTest:
        spec = ob.load_spec(ROOT / "designs" / name)
        return ob.guaranteed_test(spec.plant, **spec.options)

    return made


def _drive() -> ob.GuaranteedTest:
    plant = ob.load_spec(ROOT / "designs/drive/guaranteed_test.yaml").plant
    return ob.guaranteed_test(plant, course="constant", samples=10, disturbance_bounds=1.0, noise_bound=3)


def _tanks() -> ob.GuaranteedTest:
    plant = ob.load_spec(ROOT / "designs/tanks/spec.yaml").plant
    return ob.guaranteed_test(plant, isolate=True, course="constant", samples=8, noise_bound=3)


PLANTS: dict[str, Callable[[], ob.GuaranteedTest]] = {
    "vehicle": _spec("vehicle/spec.yaml"), "drive, a step": _spec("drive/guaranteed_test.yaml"),
    "drive, constant": _drive, "smib": _spec("smib/guaranteed_test.yaml"), "tanks, a bank": _tanks,
}  # fmt: skip
CASES = 20 * len(PLANTS)


@cache
def _designed(name: str) -> tuple[tuple[ob.GuaranteedTest, Any, Programmes], ...]:
    """Return the tests of a plant, each with its window and its programmes."""
    return tuple(
        (test, window_as_designed(test.plant, GuaranteedTestMethod.of(test.options)), Programmes.of(test))
        for test in PLANTS[name]().tests
    )


def case(seed: int) -> Outcome:
    """Look at some windows of one plant."""
    rng, group = np.random.default_rng([seed, 8]), list(PLANTS)[seed % len(PLANTS)]
    for test, window, programmes in _designed(group):
        sizes = np.zeros(WINDOWS + FAULTY)
        sizes[WINDOWS:] = 2.000001 * test.threshold * rng.choice([-1.0, 1.0], FAULTY)
        y, u, rows = _windows(rng, test, window, sizes)
        for k, size in enumerate(sizes):
            alarm = abs(rows[k]) > test.threshold + test.slack(y[:, k], u[:, k])[-1]
            if alarm != (size != 0.0):
                told = f"{test.fault}: fault {size:.6g}, row {rows[k]:.9g} of {test.threshold:.9g}"
                return Outcome(group, "windows", told)
            if k % EXACT == 0:
                low, high = programmes.interval(y[:, k], u[:, k])
                if not low <= size <= high or (size and low <= 0.0 <= high):
                    told = f"{test.fault}: fault {size:.6g}, interval {low:.9g} to {high:.9g}"
                    return Outcome(group, "windows", told)
    return Outcome(group, "windows")


def _windows(
    rng: np.random.Generator, test: ob.GuaranteedTest, window: Any, sizes: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return outputs and inputs ``(samples, windows, ...)`` of a plant with E = I, and the last row of the observer."""
    plant, bounds, test_problem, observer = window.plant, window.bounds, window.test_problem, test.observer
    count, free = len(sizes), list(test_problem.free)
    x, z = SIZE * rng.uniform(-1.0, 1.0, (count, plant.nx)), np.zeros((count, observer.order))
    outputs, inputs, row = [], [], np.zeros((count, 1))

    def jumps(of: np.ndarray) -> np.ndarray:
        return np.asarray(of * rng.choice([-1.0, 1.0], (count, len(of))))

    for k in range(test_problem.samples):
        d, v, u = jumps(bounds.disturbance), jumps(bounds.noise), jumps(np.full(plant.nu, SIZE))
        f = np.zeros((count, plant.nf))
        f[:, free] = SIZE * rng.standard_normal((count, len(free)))
        f[:, test_problem.fault] = sizes if test_problem.course == "constant" or k >= test_problem.before else 0.0
        y = x @ plant.C.T + u @ plant.D.T + d @ plant.Dd.T + f @ plant.Df.T + v @ bounds.noise_output.T
        x = x @ plant.A.T + u @ plant.B.T + d @ plant.Bd.T + f @ plant.Bf.T + v @ bounds.noise_state.T
        row = z @ observer.Cz.T + u @ observer.Du.T + y @ observer.Dy.T
        z = z @ observer.Az.T + u @ observer.Bu.T + y @ observer.By.T
        outputs.append(y)
        inputs.append(u)
    return np.array(outputs), np.array(inputs), row[:, -1]

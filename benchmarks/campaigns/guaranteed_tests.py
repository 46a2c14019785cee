"""Guaranteed tests of random plants: threshold over least, and windows made by the plant's equations alone.

Plants of one to five states and index 0 to 3, with feedthrough, known inputs, disturbances in states and outputs, two
faults, and any course, bounds and lag; where a design exists, threshold / least is at most 1 + 1e-6, least is never
above threshold, 40 windows without a fault (half of them bang-bang) stay below the threshold, the worst signs reach
1 - 1e-9 of it, and 20 windows with a fault of twice that size all alarm.

Every fifth plant has constants with tolerances, in E as well: 10 plants at vertices of its box, with bang-bang
disturbances and noise, must stay below the threshold that follows the signals, which is never below the nominal one.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from benchmarks.campaigns.frame import Outcome
from scipy.linalg import block_diag

import obsynth as ob
from obsynth.methods.guaranteed_test.method import GuaranteedTestMethod
from obsynth.methods.guaranteed_test.problem import window_as_designed
from obsynth.methods.guaranteed_test.tolerant import (
    noisy_as_bounded,
    over_the_box,
    rows_before,
    thresholds_over_tolerances,
    tracked,
)
from obsynth.verification.over_tolerances.plants_of_the_box import plant_at

CASES = 625
LIMIT = 60.0  # s
WINDOWS, FAULTY, GAP, REACHED = 40, 20, 1e-6, 1e-9
TOLERANT, VERTICES, STEPS = 5, 10, 120
COURSES = ("constant", "step", "any", "ramp", "rate")


def random_plant(rng: np.random.Generator) -> tuple[ob.DescriptorSystem, str]:
    """Return a plant whose pencil is regular, and its index in words."""
    index, slow = int(rng.choice([0, 0, 1, 2, 3])), int(rng.integers(1, 3))
    nilpotent = np.eye(index, k=1) if index else np.zeros((0, 0))
    E = block_diag(np.eye(slow), nilpotent)
    A = block_diag(np.round(64.0 * rng.uniform(-1.1, 1.1, (slow, slow))) / 64.0, np.eye(index))
    # Whole numbers: products are exact, and with them the index.
    left, right = (np.tril(rng.integers(-2, 3, (len(E), len(E))), -1) + np.eye(len(E)) for _ in range(2))
    right = right.T
    nx, ny, nd = len(E), int(rng.integers(1, 4)), int(rng.integers(0, 3))

    def some(rows: int, columns: int, share: float) -> np.ndarray:
        return rng.standard_normal((rows, columns)) * (rng.random((rows, columns)) < share)

    plant = ob.DescriptorSystem(
        left @ E @ right, left @ A @ right, some(nx, 1, 0.7), some(ny, nx, 0.8), D=some(ny, 1, 0.3),
        Bf=some(nx, 2, 0.7), Df=some(ny, 2, 0.3), Bd=some(nx, nd, 0.6) if nd else None,
        Dd=some(ny, nd, 0.3) if nd else None, Bw=np.zeros((nx, ny)), Dw=np.diag(10.0 ** rng.uniform(-2, 0, ny)), dt=0.1,
    )  # fmt: skip
    return plant, f"index {index}"


def random_options(rng: np.random.Generator, plant: ob.DescriptorSystem) -> dict[str, Any]:
    """Return options of a test."""
    course = str(rng.choice(COURSES))
    options: dict[str, Any] = {
        "fault": "f1", "course": course, "noise_bound": float(rng.uniform(0.5, 3.0)), "before": int(rng.integers(1, 6)),
        "disturbance_bounds": {name: float(10.0 ** rng.uniform(-2, 0)) for name in plant.disturbance_names},
        "free": str(rng.choice(["others", "none"])), "free_course": str(rng.choice(["any", "constant"])),
        "disturbance": str(rng.choice(["jump", "held"])), "samples": int(rng.integers(7, 16)),
    }  # fmt: skip
    if course == "rate":
        options |= {"fault_rate": 0.1}
    if course in ("ramp", "rate"):
        options |= {"lag": int(rng.integers(0, 3))}
    return options


def case(seed: int) -> Outcome:
    """Design one test, and try to break it."""
    rng = np.random.default_rng([seed, 29])
    if seed % TOLERANT == TOLERANT - 1:
        return tolerant_case(rng)
    plant, group = random_plant(rng)
    options = random_options(rng, plant)
    try:
        design = ob.guaranteed_test(plant, **options)
    except ob.PreconditionError as error:
        if "proved for" not in str(error):
            return Outcome(group, "hidden, not proved")
        return Outcome(group, "hidden, proved")
    except ob.VerificationError:
        return Outcome(group, "refused by its own checks")
    if np.isnan(design.least):
        return Outcome(group, "least not proved")
    wrong = _wrong(rng, design)
    return Outcome(group, "threshold zero" if design.threshold == 0.0 else "threshold least", wrong)


def tolerant_plant(rng: np.random.Generator) -> ob.DescriptorSystem:
    """Return a stable plant with tolerances of its masses (in E) and of all entries of A."""
    nx = int(rng.integers(1, 4))
    A = rng.uniform(-1.0, 1.0, (nx, nx))
    A *= rng.uniform(0.3, 0.9) / max(np.abs(np.linalg.eigvals(A)))
    ny = int(rng.integers(1, nx + 1))
    masses = {f"m{k}": {"nominal": float(rng.uniform(0.5, 2.0)), "tolerance": f"{rng.uniform(0.5, 4):.2f} %"}
              for k in range(nx)}  # fmt: skip
    E = [[f"m{k}" if j == k else 0.0 for j in range(nx)] for k in range(nx)]
    A = np.diag([mass["nominal"] for mass in masses.values()]) @ A
    return ob.uncertain_system(
        {"E": E, "A": A.tolist(), "B": rng.standard_normal((nx, 1)).tolist(),
         "C": rng.standard_normal((ny, nx)).tolist(), "Bf": rng.standard_normal((nx, 1)).tolist(),
         "Bd": rng.standard_normal((nx, 1)).tolist(), "Bw": np.zeros((nx, ny)).tolist(),
         "Dw": np.diag(10.0 ** rng.uniform(-3, -1, ny)).tolist(), "dt": 0.1},
        masses, tolerance={"A": f"{rng.uniform(0.5, 3):.2f} %"},
    )  # fmt: skip


def tolerant_case(rng: np.random.Generator) -> Outcome:
    """Design one test over tolerances, and try to break it."""
    plant, group = tolerant_plant(rng), "tolerances"
    bound, deviations = 10.0 ** rng.uniform(-2, 0), float(rng.uniform(0.5, 3.0))
    options: dict[str, Any] = {
        "course": str(rng.choice(["constant", "step", "any"])), "before": int(rng.integers(1, 6)),
        "samples": int(rng.integers(7, 16)), "noise_bound": deviations, "disturbance_bounds": bound,
    }  # fmt: skip
    sine = {"u1": ob.Sine(amplitude=1.0, frequency=float(rng.uniform(0.5, 10.0)))}
    try:
        design = ob.guaranteed_test(plant, scenario=ob.Scenario(horizon=10.0, inputs=sine), **options)
    except ob.PreconditionError:
        return Outcome(group, "hidden, proved")
    if "mean_threshold" not in design.certificate.claims:
        return Outcome(group, "no observer of the state beside")
    window = window_as_designed(design.plant, GuaranteedTestMethod.of(design.options))
    shipped, box = design.certificate.matrices, plant.uncertainty.box
    both = tracked(window, shipped["multipliers"].ravel(), shipped["state_tracking"], shipped["state_rows"])
    filled = rows_before(design)
    for _ in range(VERTICES):
        at = plant_at(plant, box.values(rng.choice([-1.0, 1.0], len(box.names))))
        inverse, x, record = np.linalg.inv(at.E), np.zeros(at.nx), []
        for k in range(STEPS):
            u = np.array([np.sin(0.3 * k)])
            record.append([*u, *(at.C @ x + deviations * at.Dw @ rng.choice([-1.0, 1.0], at.nw))])
            x = inverse @ (at.A @ x + at.B @ u + at.Bd[:, 0] * bound * rng.choice([-1.0, 1.0]))
        rows = np.array(record)
        run = design.observer.run(rows[:, 1:], rows[:, :1])
        residual = np.abs(np.hstack([run.faults, run.residuals])[:, -1])
        limits = thresholds_over_tolerances(
            over_the_box(noisy_as_bounded(window), window.test_problem.disturbance), design.observer, both,
            window.bounds.disturbance, rows,
        )[:, -1]  # fmt: skip
        if np.any(residual[filled:] > limits[filled:]):
            return Outcome(group, "threshold least", f"a plant of the box passes by {np.max(residual / limits):.9g}")
        if np.min(limits) < design.threshold * (1.0 - REACHED):
            return Outcome(group, "threshold least", "the threshold over the box is below the nominal one")
    wrong = "" if design.least <= design.threshold else "least above threshold"
    return Outcome(group, "threshold over the box", wrong)


def _wrong(rng: np.random.Generator, design: ob.GuaranteedTest) -> str:
    threshold, least = design.threshold, design.least
    if not least <= threshold:
        return f"least {least} above threshold {threshold}"
    if threshold > least * (1.0 + GAP):
        return f"threshold / least is 1 + {threshold / least - 1.0:.2e}"
    window = window_as_designed(design.plant, GuaranteedTestMethod.of(design.options))
    worst = np.sign(window.matrix.T @ design.certificate.matrices["multipliers"].ravel())
    simulated = _Simulated(design, window.equations)
    room = 1e-9 * (1.0 + simulated.size) * (1.0 + threshold)
    for k in range(WINDOWS):
        found = abs(simulated.last_row(rng, _signs(rng, window, bang=k % 2 == 0), 0.0))
        if found > threshold + room:
            return f"a window without a fault reaches {found:.9g}, threshold {threshold:.9g}"
    reached = abs(simulated.last_row(rng, _named(window, worst), 0.0))
    if design.options["course"] != "rate" and reached < threshold * (1.0 - REACHED) - room:
        return f"the worst window reaches {reached:.9g} of {threshold:.9g}"
    for _ in range(FAULTY):
        size = 2.0 * threshold * float(rng.choice([-1.0, 1.0]))
        found = abs(simulated.last_row(rng, _signs(rng, window, bang=True), size))
        if found < threshold - room:
            return f"a fault of twice the threshold is not found: {found:.9g} of {threshold:.9g}"
    return ""


def _named(window: Any, signs: np.ndarray) -> dict[Any, float]:
    sizes = signs * np.where(window.bounded, window.bar, 0.0)
    return dict(zip(window.labels, sizes.tolist(), strict=True))


def _signs(rng: np.random.Generator, window: Any, *, bang: bool) -> dict[Any, float]:
    drawn = rng.uniform(-1.0, 1.0, len(window.bar))
    return _named(window, np.sign(drawn) if bang else drawn)


class _Simulated:
    """Windows of a plant, all states solved for at once from its equations; starts and free faults at random."""

    def __init__(self, design: ob.GuaranteedTest, equations: int) -> None:
        plant = design.linear[0]
        self.design, self.plant, self.equations = design, plant, equations
        self.length = max(equations, design.samples)
        nx = plant.nx
        whole = np.zeros((equations * nx, (equations + 1) * nx))
        for k in range(equations):
            whole[k * nx : (k + 1) * nx, (k + 1) * nx : (k + 2) * nx] = plant.E
            whole[k * nx : (k + 1) * nx, k * nx : (k + 1) * nx] = -plant.A
        _, sizes, right = np.linalg.svd(whole)
        rank = int(np.sum(sizes > 1e-11 * max(sizes, default=1.0)))
        self.whole, self.inverse, self.starts = whole, np.linalg.pinv(whole, rcond=1e-11), right[rank:].T
        self.size = float(np.abs(design.observer.By).sum())

    def last_row(self, rng: np.random.Generator, signals: dict[Any, float], fault: float) -> float:
        """Return what the shipped observer says at the end of a window."""
        plant, design, options = self.plant, self.design, self.design.options
        free = [1] if options["free"] == "others" else []
        held = rng.standard_normal(1) if options["free_course"] == "constant" else None
        u = rng.standard_normal((self.length, 1))
        d, w, f = (np.zeros((self.length, count)) for count in (plant.nd, plant.nw, 2))
        for k in range(self.length):
            d[k] = [
                signals.get(("d", None if options["disturbance"] == "held" else k, i), 0.0) for i in range(plant.nd)
            ]
            w[k] = [signals.get(("w", k, i), 0.0) for i in range(plant.nw)]
            f[k, free] = rng.standard_normal(len(free)) if held is None else held[: len(free)]
        f[:, 0] = self._course(rng, fault)
        driven = u @ plant.B.T + d @ plant.Bd.T + f @ plant.Bf.T + w @ plant.Bw.T
        states = self.inverse @ driven[: self.equations].ravel()
        states = states + self.starts @ rng.standard_normal(self.starts.shape[1])
        x = states.reshape(-1, plant.nx)
        count = design.samples
        y = x[:count] @ plant.C.T if len(x) >= count else np.zeros((count, plant.ny))
        y = y + u[:count] @ plant.D.T + d[:count] @ plant.Dd.T + f[:count] @ plant.Df.T + w[:count] @ plant.Dw.T
        late = design.observer.order + 1 - count
        outputs = np.vstack([y, np.zeros((late, plant.ny))])
        known = np.vstack([u, np.zeros((late, 1))])[: count + late]
        run = design.observer.run(outputs, known)
        return float(np.hstack([run.faults, run.residuals])[-1, 0])

    def _course(self, rng: np.random.Generator, fault: float) -> np.ndarray:
        options, k = self.design.options, np.arange(self.length)
        course, target = options["course"], self.design.samples - 1 - int(options["lag"] or 0)
        if course == "step":
            return fault * (k >= options["before"])
        if course == "any":
            drawn = rng.standard_normal(self.length)
            drawn[target] = fault
            return drawn
        if course == "ramp":
            return fault + rng.standard_normal() * (k - target)
        if course == "rate":
            steps = np.cumsum(rng.uniform(-1.0, 1.0, self.length) * options["fault_rate"])
            return fault + steps - steps[target]
        return np.full(self.length, fault)

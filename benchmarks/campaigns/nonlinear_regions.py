"""Claims for nonlinear plants over a region, against what simulated plants do inside it, and after they have left it.

Random chains of two or three states, with sines, roots and squares between them, a fault that drifts, one or two
outputs, and at times an algebraic equation. On the record of a plant, integrated with fifth order, the distance of
two estimates that start anywhere shrinks in every step as is proved, in the norm of the certificate; where slopes
rest within their bounds, neither the mean square nor the gain exceeds the claim. Then an input drives the plant out:
every such row that an input, a measurement or the estimate shows is out, and so are the rows after it that the
certificate asks for. The mean is that of the share of the claim that is reached.
"""

from __future__ import annotations

import numpy as np
from benchmarks.campaigns.frame import Outcome

import obsynth
from obsynth.errors import PreconditionError, SolverError
from obsynth.numerics.matrix_equations import continuous_lyapunov
from obsynth.plants.operating_region import OperatingRegion
from obsynth.plants.transformations.nonlinear_terms import nonlinear_terms
from obsynth.verification.nonlinear_drive import drive_of, wanted_of
from obsynth.verification.nonlinear_region import directions, whole_gain
from obsynth.verification.over_region import WITNESSES

CASES = 50
LIMIT = 60.0  # s
STEPS, DRAWN, START = 60, 200, 3.0
#: Rounding of what a course reaches, and Newton's tolerance, beside the claim.
ROUNDING = 1e-6
GOALS = ("power", "gain", "decay")


def case(seed: int) -> Outcome:
    """Design over a region, and look for a trajectory that exceeds what is proved."""
    rng, goal = np.random.default_rng(seed), GOALS[seed % len(GOALS)]
    made = designed(rng, goal)
    if isinstance(made, Outcome):
        return made
    design, region, noise = made
    wrong, share = _decay(design, rng)
    if goal != "decay":
        more, share = _frozen(design, goal, noise, rng)
        wrong = wrong or more
    wrong = wrong or _left(design, region)
    return Outcome(goal, "above 0.9 of the claim" if share > 0.9 else "below 0.9 of the claim", wrong, share)


def designed(
    rng: np.random.Generator, goal: str
) -> tuple[obsynth.ObserverDesign, dict[str, list[float]], dict[str, float]] | Outcome:
    """Return a design for a random plant with its region and noise; the outcome where there is none."""
    model, region = _plant(rng)
    noise = {name: 1e-2 for name in (*model.output_names, "fault")} | {"der(x1)": 3e-2}
    step = float(rng.choice([0.02, 0.1, 0.5]))
    options = {} if goal == "decay" else {"noise": noise}
    try:
        design = obsynth.region_observer(model, region=region, sample_time=step, goal=goal, **options)
    except (SolverError, PreconditionError) as error:
        return Outcome(goal, f"{type(error).__name__}")
    return design, region, noise


def _plant(rng: np.random.Generator) -> tuple[obsynth.DAEModel, dict[str, list[float]]]:
    """Return a random plant of index 1 that stays where it is for a small input, and its region."""
    count, algebraic = int(rng.integers(2, 4)), bool(rng.random() < 0.4)
    a = rng.uniform(0.3, 1.5, count)
    texts, low = {}, 0.2
    for i in range(1, count + 1):
        other = i % count + 1
        bend = str(rng.choice(["sin(x{j})", "sqrt(x{j} + 0.5)", "x{j} ** 2", "x{j} / (1 + x{j})"])).format(j=other)
        driven = {1: " + u", 2: " + fault"}.get(i, "")
        inner = "flow" if algebraic and i == 1 else f"{rng.uniform(-0.6, 0.6):.3f} * {bend}"
        texts[f"state {i}"] = f"der(x{i}) = -{a[i - 1]:.3f} * x{i} + {inner}{driven}"
        if algebraic and i == 1:
            texts["flow"] = f"flow + 0.2 * sin(flow) = {rng.uniform(-0.6, 0.6):.3f} * {bend}"
    states = {f"x{i}": 0.5 for i in range(1, count + 1)} | ({"flow": 0.0} if algebraic else {})
    outputs = {f"y{i}": f"x{i}" for i in range(1, count + 1 if rng.random() < 0.5 else count)}
    outputs = outputs if "y2" in outputs else outputs | {"y2": "x2"}
    model = obsynth.DAEModel(texts, outputs, states=states, inputs={"u": 0.0}, parameters={"fault": 0.0})
    region = {f"x{i}": [low - 0.4, 2.0] for i in range(1, count + 1)} | ({"flow": [-3.0, 3.0]} if algebraic else {})
    return model, region


def _decay(design: obsynth.ObserverDesign, rng: np.random.Generator) -> tuple[str, float]:
    """Compare two estimates from the record of a simulated plant, of which one starts anywhere."""
    observer = design.observer
    rate, moving = design.certificate.claims["region_decay"], observer.terms.differential
    P = design.certificate.matrices[WITNESSES[0]][0][:moving, :moving]
    bound, nearest = (1.0 + 2.0 * rate * observer.dt) ** -0.5, 0.0
    u = 0.3 * np.sin(0.1 * np.arange(STEPS))[:, None]
    try:
        y = obsynth.simulate_dae(observer.model, u, dt=observer.dt).outputs
    except SolverError:  # a plant that leaves by itself: the record may be any
        y = 0.5 + np.cumsum(0.02 * rng.standard_normal((STEPS, len(observer.output_names))), axis=0)
    one = observer.init()
    other = one._replace(z=one.z + START * rng.standard_normal(len(one.z)))
    for k in range(STEPS):
        distance = _size(P, one.z - other.z, moving)
        one, _ = observer.advance(one, y[k], u[k])
        other, _ = observer.advance(other, y[k], u[k])
        if distance < 1e-6:
            break
        shrunk = _size(P, one.z - other.z, moving) / distance
        nearest = max(nearest, shrunk / bound)
        if shrunk > bound * (1.0 + ROUNDING):
            return f"an error shrinks by {shrunk:.9g} in step {k}, {bound:.9g} is proved", nearest
    return "", nearest


def _size(P: np.ndarray, error: np.ndarray, moving: int) -> float:
    return float(np.sqrt(error[:moving] @ P @ error[:moving]))


def _frozen(
    design: obsynth.ObserverDesign, goal: str, noise: dict[str, float], rng: np.random.Generator
) -> tuple[str, float]:
    """Compare the claim with what errors do where slopes rest anywhere within their bounds."""
    observer = design.observer
    terms = nonlinear_terms(observer.model, faults=observer.faults)
    region = OperatingRegion.of(terms, observer.region)
    W, Wy, V = directions(terms, region.slopes())
    B, D = drive_of(terms, noise, observer.dt)
    Cz, k = wanted_of(terms, region, None), terms.differential
    claim = design.certificate.claims["region_deviation" if goal == "power" else "region_gain"]
    L, best = whole_gain(terms, observer.gain), 0.0
    low, high = observer.slopes.T
    for number in range(DRAWN):
        share = rng.integers(0, 2, len(low)) if number % 2 else rng.random(len(low))
        slopes = np.diag(low + share * (high - low))
        A = terms.A + W @ slopes @ V - L @ (terms.C + Wy @ slopes @ V)
        F = B - L @ D
        z = Cz
        if k < len(A):
            inner = np.linalg.solve(A[k:, k:], np.hstack([A[k:, :k], F[k:]]))
            z = Cz[:, :k] - Cz[:, k:] @ inner[:, :k]
            A, F = A[:k, :k] - A[:k, k:] @ inner[:, :k], F[:k] - A[:k, k:] @ inner[:, k:]
        if goal == "power":
            reached = float(np.sqrt(np.trace(z @ continuous_lyapunov(A, -F @ F.T) @ z.T)))
        else:
            reached = max(
                float(np.linalg.norm(z @ np.linalg.solve(1j * w * np.eye(k) - A, F), 2))
                for w in (0.0, *np.geomspace(1e-3, 1e2, 40))
            )
        best = max(best, reached)
        if reached > claim * (1.0 + ROUNDING):
            return f"{reached:.9g} is reached at rest, {claim:.9g} claimed", reached / claim
    return "", best / claim


def _left(design: obsynth.ObserverDesign, region: dict[str, list[float]]) -> str:
    """Drive the plant out of the region and back: rows that show it, and those after them, must be without a claim."""
    observer = design.observer
    u = np.zeros((240, 1))
    u[60:90] = 6.0
    try:
        run = obsynth.simulate_dae(observer.model, u, dt=observer.dt)
    except SolverError:  # out there the plant may have no solution
        u = u[:20]
        try:
            run = obsynth.simulate_dae(observer.model, u, dt=observer.dt, initial_state=_outside(observer.model))
        except SolverError:
            return ""
    _, claimed = observer.record(run.outputs, u)
    low, high = region["x1"]
    left = (run.outputs[:, 0] < low) | (run.outputs[:, 0] > high)
    if claimed[left].any():
        return "a row is claimed whose measurement is outside the region"
    for k in np.flatnonzero(left):
        if claimed[k : k + observer.forgetting].any():
            return f"row {k} is outside, and one of the {observer.forgetting} rows from there on is claimed"
    return ""


def _outside(model: obsynth.DAEModel) -> np.ndarray:
    """Return a start above the region, from which the plant comes back or goes on."""
    return np.array([2.1 if name == "x1" else value for name, value in model.states.items()])

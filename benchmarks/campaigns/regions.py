"""Claims over a region that no course of the parameters exceeds, and how near the worst course found comes.

Random error systems with three states, one measurement and two or three vertices, in both times, with gains found by
the inequalities at the vertices: the l2 gain (any course; courses with small steps; a remainder beside A), the mean
square for white noise, and the decay.  Courses are searched by coordinate ascent over vertices (gains), by all periodic
courses of up to four samples (mean square, decay), and by random walks with the stated steps.  In continuous time
parameters and disturbances are constant in pieces, between which the integrals are exact.  The mean is that of the
share of the claim that is reached.
"""

from __future__ import annotations

import itertools

import numpy as np
from benchmarks.campaigns.frame import Outcome
from scipy.linalg import expm

from obsynth.conditions import ErrorPolytope
from obsynth.errors import SolverError
from obsynth.methods.engines.vertex_certificates import best_decay, certified
from obsynth.verification.over_region import worst_switching

CASES = 210
LIMIT = 120.0  # s
GOALS = ("gain", "gain, slow", "gain, remainder", "mean square", "decay", "gain, continuous", "decay, continuous")
STEP, BALL = 0.1, 0.03
HORIZON, STARTS, LONGEST = 20, 3, 4
#: Rounding of what a course reaches, beside the claim.
ROUNDING = 1e-9

Closed = list[tuple[np.ndarray, ...]]


def case(seed: int) -> Outcome:
    """Design for one goal, and search for a course that exceeds what is proved."""
    goal, rng = GOALS[seed % len(GOALS)], np.random.default_rng(seed)
    errors = _errors(rng, goal)
    try:
        claim, reached = _claim_and_reached(errors, goal, rng)
    except SolverError:
        return Outcome(goal, "no certificate found")
    wrong = f"{reached:.9g} is reached, {claim:.9g} claimed" if reached > claim * (1.0 + ROUNDING) else ""
    share = reached / claim if claim else 1.0
    told = "above 0.95" if share > 0.95 else "above 0.8" if share > 0.8 else "below 0.8"
    return Outcome(goal, f"{told} of the claim", wrong, share)


def _errors(rng: np.random.Generator, goal: str) -> ErrorPolytope:
    """Return a polytope whose vertices differ by about a third of their size."""
    count = 2 if "slow" in goal else int(rng.integers(2, 4))
    middle = rng.standard_normal((3, 3))
    A = [middle + 0.35 * rng.standard_normal((3, 3)) for _ in range(count)]
    B = [np.hstack([rng.standard_normal((3, 2)), np.zeros((3, 1))])] * count
    D, Cz = np.array([[0.0, 0.0, 0.5]]), rng.standard_normal((2, 3))
    if "continuous" in goal:
        A = [a - 0.3 * np.eye(3) for a in A]
        return ErrorPolytope(A, np.eye(1, 3), B=B, D=D, Cz=Cz, dt=0.0)
    size = max(abs(np.linalg.eigvals(a)).max() for a in A)
    A = [1.05 * a / size for a in A]
    return ErrorPolytope(A, np.eye(1, 3), B=B, D=D, Cz=Cz, ball=BALL if "remainder" in goal else 0.0)


def _claim_and_reached(errors: ErrorPolytope, goal: str, rng: np.random.Generator) -> tuple[float, float]:
    if goal.startswith("decay"):
        rate, _, gains = best_decay(errors, limit=20.0)
        closed = [errors.at(weights, gains) for weights in np.eye(errors.count)]
        if errors.dt > 0.0:
            return rate, _growth([part[0] for part in closed])
        step = 0.05
        return float(np.exp(-rate * step)), _growth([expm(step * part[0]) for part in closed])
    slow = {"lyapunov": "vertex", "steps": STEP} if goal == "gain, slow" else {}
    made = certified(errors, goal="power" if goal == "mean square" else "gain", **slow)
    closed = [errors.at(weights, made.gains) for weights in np.eye(errors.count)]
    if goal == "mean square":
        return made.level**2, _mean_square(closed)
    if goal == "gain, slow":
        return made.level, max(_slow_gain(errors, made.gains, rng) for _ in range(30))
    if goal == "gain, continuous":
        return made.level, max(worst_switching(_in_pieces(closed, step), horizon=HORIZON, starts=STARTS)
                               for step in (0.2, 0.7))  # fmt: skip
    if errors.ball:
        turned = []
        for _ in range(12):
            u, _, v = np.linalg.svd(rng.standard_normal((3, 3)))
            turned.append(worst_switching([(M + BALL * u @ v, *rest) for M, *rest in closed], horizon=12, starts=1))
        return made.level, max(turned)
    return made.level, worst_switching(closed, horizon=HORIZON, starts=STARTS)


def _growth(matrices: list[np.ndarray]) -> float:
    """Return the largest growth a sample over periodic courses: no decay below it can be true."""
    best = 0.0
    for length in range(1, LONGEST + 3):
        for course in itertools.product(matrices, repeat=length):
            product = np.linalg.multi_dot(course) if length > 1 else course[0]
            best = max(best, float(abs(np.linalg.eigvals(product)).max()) ** (1.0 / length))
    return best


def _mean_square(closed: Closed) -> float:
    """Return the largest mean of ``|z|^2`` over periodic courses, for white w."""
    best = 0.0
    for length in range(1, LONGEST + 1):
        for course in itertools.product(closed, repeat=length):
            P, total = np.zeros((3, 3)), 0.0
            for _ in range(120):
                total = 0.0
                for M, B, Cz, Dz in course:
                    total += float(np.trace(Cz @ P @ Cz.T) + np.sum(Dz**2))
                    P = M @ P @ M.T + B @ B.T
            best = max(best, total / length)
    return best


def _slow_gain(errors: ErrorPolytope, gains: list[np.ndarray], rng: np.random.Generator) -> float:
    """Return the l2 gain along one course whose weight moves by at most `STEP` a sample."""
    t, course = float(rng.random()), []
    push = rng.choice([-1.0, 1.0])
    for _ in range(2 * HORIZON):
        push = push if 0.0 < t < 1.0 and rng.random() < 0.9 else -push
        course.append(errors.at(np.array([1.0 - t, t]), gains))
        t = float(np.clip(t + push * STEP * rng.choice([1.0, rng.random()]), 0.0, 1.0))
    return _along(course)


def _along(course: Closed) -> float:
    q, p = course[0][3].shape
    whole, reached = np.zeros((len(course) * q, len(course) * p)), np.zeros((3, len(course) * p))
    for k, (M, B, Cz, Dz) in enumerate(course):
        whole[k * q : (k + 1) * q] = Cz @ reached
        whole[k * q : (k + 1) * q, k * p : (k + 1) * p] += Dz
        reached = M @ reached
        reached[:, k * p : (k + 1) * p] += B
    return float(np.linalg.norm(whole, 2))


def _in_pieces(closed: Closed, step: float) -> Closed:
    """Return what continuous systems do over a piece with constant w, whose norms are those of the integrals."""
    found = []
    for A, B, Cz, Dz in closed:
        n, p = B.shape
        M = np.block([[A, B], [np.zeros((p, n + p))]])
        C = np.hstack([Cz, Dz])
        # Twice as long a piece is two of half its length: no exponential of what grows is needed.
        doublings = max(int(np.ceil(np.log2(max(step * np.linalg.norm(M), 1.0)))) + 1, 1)
        h = step / 2**doublings
        both = expm(h * np.block([[-M.T, C.T @ C], [np.zeros_like(M), M]]))
        moved = both[n + p :, n + p :]
        form = moved.T @ both[: n + p, n + p :]
        for _ in range(doublings):
            form, moved = form + moved.T @ form @ moved, moved @ moved
        values, vectors = np.linalg.eigh(0.5 * (form + form.T))
        root = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
        unit = np.sqrt(step)
        found.append((moved[:n, :n], moved[:n, n:] / unit, root[:, :n], root[:, n:] / unit))
    return found

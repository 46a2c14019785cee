"""Claims over a region that no course of the parameters exceeds, and how near the worst course found comes.

Random error systems with three states, one measurement and two or three vertices, in both times, with gains found by
the inequalities at the vertices: the l2 gain (any course; courses with small steps; a remainder beside A), the mean
square for white noise, and the decay.  Courses are searched by coordinate ascent over vertices (gains), by all periodic
courses of up to four samples (mean square, decay), and with small steps or a remainder by following the adjoint of the
worst input's response.  In continuous time parameters and disturbances are constant in pieces, between which the
integrals are exact.  The mean is that of the share of the claim that is reached.
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
#: Lengths of the pieces in which a course is constant in continuous time, in s.
LONG_PIECES = 32
PIECES = (0.1, 0.2, 0.4, 0.8)
#: Of remainders: samples, courses to start from and rounds of each; rounds of slow courses; and the growth of the gain
#: that is worth another round.
LONG_HORIZON, REMAINDER_STARTS, REMAINDER_ROUNDS, SLOW_ROUNDS, PROGRESS = 60, 12, 30, 15, 1e-6
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
        return made.level, max(worst_switching(_in_pieces(closed, step), horizon=LONG_PIECES, starts=STARTS)
                               for step in PIECES)  # fmt: skip
    if errors.ball:
        return made.level, max(_with_remainder(closed, rng) for _ in range(REMAINDER_STARTS))
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
    """Return the l2 gain along one course whose weight moves by at most `STEP` a sample: a random walk, led on."""
    t, course = float(rng.random()), []
    push = rng.choice([-1.0, 1.0])
    for _ in range(2 * HORIZON):
        push = push if 0.0 < t < 1.0 and rng.random() < 0.9 else -push
        course.append(t)
        t = float(np.clip(t + push * STEP * rng.choice([1.0, rng.random()]), 0.0, 1.0))
    weights, ends = np.array(course), [errors.at(np.eye(2)[k], gains) for k in range(2)]
    best = 0.0
    for _ in range(SLOW_ROUNDS):
        gain, states, w, adjoints = _worst_input([errors.at(np.array([1.0 - t, t]), gains) for t in weights])
        if gain <= best * (1.0 + PROGRESS):
            break
        best = gain
        after = np.vstack([adjoints[1:], np.zeros((1, 3))])
        change = [end @ ((ends[1][0] - ends[0][0]) @ x + (ends[1][1] - ends[0][1]) @ v)
                  for end, x, v in zip(after, states, w, strict=True)]  # fmt: skip
        aim = _steepest(np.array(change))
        # Half way to another course is one with as small steps.
        trials = [(1.0 - share) * weights + share * aim for share in (1.0, 0.5, 0.25, 0.1)]
        reached = [_along([errors.at(np.array([1.0 - t, t]), gains) for t in trial]) for trial in trials]
        weights = trials[int(np.argmax(reached))]
    return best


def _steepest(change: np.ndarray) -> np.ndarray:
    """Return the weights between 0 and 1, in steps of at most `STEP`, with the largest ``sum(change * weights)``."""
    levels = np.linspace(0.0, 1.0, round(1.0 / STEP) + 1)
    total, chosen = np.zeros(len(levels)), []
    for value in change[::-1]:
        padded = np.pad(total, 1, constant_values=-np.inf)
        options = np.stack([padded[:-2], total, padded[2:]])
        chosen.append(np.argmax(options, axis=0) - 1)
        total = np.max(options, axis=0) + value * levels
    place, course = int(np.argmax(total)), []
    for step in chosen[::-1]:
        course.append(levels[place])
        place += int(step[place])
    return np.array(course)


def _with_remainder(closed: Closed, rng: np.random.Generator) -> float:
    """Return the l2 gain along one course with the remainder of each sample that the worst input and the adjoint of its
    response point to; course and remainders follow each other until the gain no longer grows."""
    places = rng.integers(0, len(closed), LONG_HORIZON)
    remainders, best = [np.zeros((3, 3))] * LONG_HORIZON, 0.0
    for _ in range(REMAINDER_ROUNDS):
        course = [(closed[k][0] + more, *closed[k][1:]) for k, more in zip(places, remainders, strict=True)]
        gain, before, w, after = _worst_input(course)
        if gain <= best * (1.0 + PROGRESS):
            break
        best = gain
        ends = np.vstack([after[1:], np.zeros((1, 3))])
        sizes = np.linalg.norm(ends, axis=1) * np.linalg.norm(before, axis=1)
        remainders = [
            BALL * np.outer(end, state) / size if size > 0.0 else np.zeros((3, 3))
            for end, state, size in zip(ends, before, sizes, strict=True)
        ]
        powers = [[end @ (M @ x + B @ v) for M, B, *_ in closed] for end, x, v in zip(ends, before, w, strict=True)]
        places = np.argmax(powers, axis=1)
    return best


def _worst_input(course: Closed) -> tuple[float, np.ndarray, np.ndarray, np.ndarray]:
    """Return the l2 gain of a course, and of the input that reaches it states, inputs and adjoint states by sample."""
    whole = _responses(course)
    left, values, right = np.linalg.svd(whole, full_matrices=False)
    w, z = right[0].reshape(len(course), -1), left[:, 0].reshape(len(course), -1)
    states, adjoints = np.zeros((len(course), 3)), np.zeros((len(course) + 1, 3))
    for k, (M, B, _, _) in enumerate(course[:-1]):
        states[k + 1] = M @ states[k] + B @ w[k]
    for k in range(len(course) - 1, -1, -1):
        M, _, Cz, _ = course[k]
        adjoints[k] = M.T @ adjoints[k + 1] + Cz.T @ z[k]
    return float(values[0]), states, w, adjoints[:-1]


def _along(course: Closed) -> float:
    """Return the l2 gain along one course from rest."""
    return float(np.linalg.norm(_responses(course), 2))


def _responses(course: Closed) -> np.ndarray:
    """Return what each input does to each output along one course from rest."""
    q, p = course[0][3].shape
    whole, reached = np.zeros((len(course) * q, len(course) * p)), np.zeros((3, len(course) * p))
    for k, (M, B, Cz, Dz) in enumerate(course):
        whole[k * q : (k + 1) * q] = Cz @ reached
        whole[k * q : (k + 1) * q, k * p : (k + 1) * p] += Dz
        reached = M @ reached
        reached[:, k * p : (k + 1) * p] += B
    return whole


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

"""Claims over a region against greedy adversaries: worst courses by recursions of the cost, not by responses.

The error systems are those of the campaign `regions`, with seeds of their own.  A gain is exceeded where the Riccati
recursion of its bound breaks down along some course: 200 courses follow at each sample the vertex (with a remainder:
also the rank-one matrix) that most enlarges the cost in a random metric, for 40 samples, and in continuous time for
240 pieces.  Courses with small steps climb the gradient of their gain, from sines and triangles.  The mean square is
that of courses that look four samples ahead, whose ends are repeated for ever, the decay that of the fastest-growing
products of up to 20 pieces.  The mean is that of the share of the claim that is reached.
"""

from __future__ import annotations

import itertools

import numpy as np
from benchmarks.campaigns.frame import Outcome
from benchmarks.campaigns.regions import GOALS, ROUNDING, STEP, _errors, _worst_input
from scipy.linalg import expm, solve_discrete_lyapunov

from obsynth.conditions import ErrorPolytope
from obsynth.errors import SolverError
from obsynth.methods.engines.vertex_certificates import best_decay, certified

CASES = 105
LIMIT = 240.0  # s
#: Added to a seed: none of the campaign `regions` comes again.
FRESH = 700_000
RESTARTS, HORIZON, PIECES, BISECTIONS = 200, 40, 240, 12
#: Share of samples at which a course takes a vertex at random.
WANDERING = 0.1
#: Seconds of a piece in continuous time.
PIECE = 0.05
#: A cost as large has no bound.
UNBOUNDED = 1e12
LOOKAHEAD, BURN_IN, WANDERERS = 4, 60, 6
BEAM, LONGEST = 150, 20
SLOW_STARTS, SLOW_ROUNDS, SLOW_HORIZON = 12, 25, 60

Closed = list[tuple[np.ndarray, ...]]


def case(seed: int) -> Outcome:
    """Design for one goal, and search for a course that exceeds what is proved."""
    goal, rng = GOALS[seed % len(GOALS)], np.random.default_rng(FRESH + seed)
    errors = _errors(rng, goal)
    try:
        claim, reached = _claim_and_reached(errors, goal, rng)
    except SolverError:
        return Outcome(goal, "no certificate found")
    wrong = f"{reached:.9g} is reached, {claim:.9g} claimed" if reached > claim * (1.0 + ROUNDING) else ""
    share = reached / claim if claim else 1.0
    result = "above 0.95" if share > 0.95 else "above 0.8" if share > 0.8 else "below 0.8"
    return Outcome(goal, f"{result} of the claim", wrong, share)


def _claim_and_reached(errors: ErrorPolytope, goal: str, rng: np.random.Generator) -> tuple[float, float]:
    if goal.startswith("decay"):
        rate, _, gains = best_decay(errors, limit=20.0)
        matrices = [errors.at(weights, gains)[0] for weights in np.eye(errors.count)]
        if errors.dt > 0.0:
            return rate, _growth([(matrix, 1.0) for matrix in matrices])
        pieces = [(expm(h * matrix), h) for matrix in matrices for h in (0.02, 0.1, 0.5)]
        return float(np.exp(-rate)), _growth(pieces)
    slow = {"lyapunov": "vertex", "steps": STEP} if goal == "gain, slow" else {}
    made = certified(errors, goal="power" if goal == "mean square" else "gain", **slow)
    closed = [errors.at(weights, made.gains) for weights in np.eye(errors.count)]
    if goal == "mean square":
        return made.level**2, _mean_square(closed, rng)
    if goal == "gain, slow":
        return made.level, max(_slow_gain(errors, made.gains, rng) for _ in range(SLOW_STARTS))
    exceeded = _exceeded_in_pieces if goal == "gain, continuous" else _exceeded
    ball = errors.ball
    high = made.level * (1.0 + ROUNDING)
    if exceeded(closed, high, ball, rng):
        return made.level, made.level * (1.0 + 10.0 * ROUNDING)
    low = max(float(np.linalg.norm(part[3], 2)) for part in closed)
    for _ in range(BISECTIONS):
        level = 0.5 * (low + high)
        low, high = (level, high) if exceeded(closed, level, ball, rng) else (low, level)
    return made.level, min(low, made.level)


def _metrics(rng: np.random.Generator, n: int) -> np.ndarray:
    """Return metrics ``(restarts, n, n)`` in which courses compare costs."""
    x = rng.standard_normal((RESTARTS, n, 1))
    return x @ x.transpose(0, 2, 1) + rng.choice([1e-3, 1.0], (RESTARTS, 1, 1)) * np.eye(n)


def _chosen(costs: list[np.ndarray], metrics: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return for each restart the cost that is largest in its metric, or at times any."""
    stacked = np.stack(costs)
    best = np.argmax(np.einsum("vrij,rij->vr", stacked, metrics), axis=0)
    anything = rng.integers(0, len(costs), RESTARTS)
    best = np.where(rng.random(RESTARTS) < WANDERING, anything, best)
    return stacked[best, np.arange(RESTARTS)]


def _exceeded(closed: Closed, level: float, ball: float, rng: np.random.Generator) -> bool:
    """Whether some course has a larger l2 gain: its Riccati recursion has no bound."""
    n = len(closed[0][0])
    P, metrics = np.zeros((RESTARTS, n, n)), _metrics(rng, n)
    for _ in range(HORIZON):
        costs = []
        for M, B, Cz, Dz in closed:
            for A in _with_remainders(M, P, ball, rng):
                At = np.swapaxes(A, -1, -2)
                slack = level**2 * np.eye(B.shape[1]) - Dz.T @ Dz - B.T @ P @ B
                if np.linalg.eigvalsh(slack)[:, 0].min() <= 0.0:
                    return True
                cross = At @ P @ B + Cz.T @ Dz
                costs.append(At @ P @ A + Cz.T @ Cz + cross @ np.linalg.solve(slack, np.swapaxes(cross, -1, -2)))
        P = _chosen(costs, metrics, rng)
    return False


def _with_remainders(M: np.ndarray, P: np.ndarray, ball: float, rng: np.random.Generator) -> list[np.ndarray]:
    """Return a matrix with remainders of rank one towards the direction that costs most, of states at random."""
    plain = np.broadcast_to(M, P.shape)
    if not ball:
        return [plain]
    worst = np.linalg.eigh(P)[1][..., -1]
    states = [np.linalg.eigh(M.T @ P @ M)[1][..., -1], rng.standard_normal(worst.shape)]
    made = []
    for x in states:
        x = x / np.linalg.norm(x, axis=1, keepdims=True)
        sign = np.sign(np.einsum("ri,ij,rj->r", worst, M, x))[:, None]
        made.append(plain + ball * (sign * worst)[:, :, None] * x[:, None, :])
    return made


def _exceeded_in_pieces(closed: Closed, level: float, ball: float, rng: np.random.Generator) -> bool:
    """Whether some course that is constant in pieces has a larger l2 gain, for any input within them."""
    n = len(closed[0][0])
    P, metrics, steps = np.zeros((RESTARTS, n, n)), _metrics(rng, n), []
    for A, B, Cz, Dz in closed:
        slack = level**2 * np.eye(B.shape[1]) - Dz.T @ Dz
        if np.linalg.eigvalsh(slack)[0] <= 0.0:
            return True
        inner = np.linalg.inv(slack)
        moved, cost = A + B @ inner @ Dz.T @ Cz, Cz.T @ Cz + Cz.T @ Dz @ inner @ Dz.T @ Cz
        passed = _over_a_piece(moved, B @ inner @ B.T, cost)
        if passed is None:
            return True
        steps.append(passed)
    for _ in range(PIECES):
        costs = []
        for through, gain, own in steps:
            product = gain @ P
            if np.linalg.eigvals(product).real.max() >= 1.0:
                return True
            cost = own + through.T @ P @ np.linalg.solve(np.eye(n) - product, np.broadcast_to(through, P.shape))
            costs.append(0.5 * (cost + np.swapaxes(cost, -1, -2)))
        P = _chosen(costs, metrics, rng)
        if np.abs(P).max() > UNBOUNDED:
            return True
    return False


def _over_a_piece(A: np.ndarray, G: np.ndarray, Q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Return what a piece makes of a cost P at its end: ``own + through' P (I - gain P)^-1 through`` at its beginning,
    from short pieces that are doubled, which fast modes do not spoil; ``None`` where the cost escapes within it."""
    n = len(A)
    hamiltonian = np.block([[-A, -G], [Q, A.T]])
    doublings = max(int(np.ceil(np.log2(max(PIECE * np.linalg.norm(hamiltonian), 1.0)))), 0)
    F = expm(PIECE / 2**doublings * hamiltonian)
    through = np.linalg.inv(F[:n, :n])
    gain, own = -through @ F[:n, n:], F[n:, :n] @ through
    for _ in range(doublings):
        if np.linalg.eigvals(gain @ own).real.max() >= 1.0:
            return None
        inner = np.linalg.inv(np.eye(n) - gain @ own)
        through, gain, own = (
            through @ inner @ through,
            gain + through @ inner @ gain @ through.T,
            own + through.T @ own @ inner @ through,
        )
    return through, gain, own


def _growth(pieces: list[tuple[np.ndarray, float]]) -> float:
    """Return the largest growth a second (a sample) of repeated products, by a search that goes on from the largest."""
    products, times, best = np.eye(len(pieces[0][0]))[None], np.zeros(1), 0.0
    for _ in range(LONGEST):
        products = np.concatenate([matrix @ products for matrix, _ in pieces])
        times = np.concatenate([times + h for _, h in pieces])
        radii = np.abs(np.linalg.eigvals(products)).max(axis=1) ** (1.0 / times)
        best = max(best, float(radii.max()))
        sizes = np.linalg.norm(products, 2, axis=(1, 2)) ** (1.0 / times)
        order = np.unique(np.r_[np.argsort(-radii)[: BEAM // 2], np.argsort(-sizes)[: BEAM // 2]])
        products, times = products[order], times[order]
    return best


def _mean_square(closed: Closed, rng: np.random.Generator) -> float:
    """Return the largest mean of ``|z|^2`` for white w along courses that look some samples ahead."""
    n, count = len(closed[0][0]), len(closed)
    tails = []
    for course in itertools.product(range(count), repeat=LOOKAHEAD):
        # What a covariance at the first of these samples costs until the last, but for what is the same for all.
        weight, offset = np.zeros((n, n)), 0.0
        for k in reversed(course):
            M, B, Cz, Dz = closed[k]
            offset += float(np.trace(B.T @ weight @ B) + np.sum(Dz**2))
            weight = M.T @ weight @ M + Cz.T @ Cz
        tails.append((course[0], weight, offset))
    first = np.array([tail[0] for tail in tails])
    weights, offsets = np.array([tail[1] for tail in tails]), np.array([tail[2] for tail in tails])
    best = 0.0
    for wandering in np.linspace(0.0, WANDERING, WANDERERS):
        S, course = np.eye(n) * rng.random(), []
        for _ in range(BURN_IN):
            chosen = int(first[int(np.argmax(np.einsum("tij,ij->t", weights, S) + offsets))])
            course.append(int(rng.integers(count)) if rng.random() < wandering else chosen)
            M, B, _, _ = closed[course[-1]]
            S = M @ S @ M.T + B @ B.T
        # The end of the course for ever again has a mean that is a limit.
        best = max(best, *(_periodic_mean([closed[k] for k in course[-length:]]) for length in range(1, LONGEST + 1)))
    return best


def _periodic_mean(course: Closed) -> float:
    """Return the mean of ``|z|^2`` for white w along a course that is repeated for ever, infinite where errors grow."""
    n = len(course[0][0])
    through, gathered = np.eye(n), np.zeros((n, n))
    for M, B, _, _ in course:
        through, gathered = M @ through, M @ gathered @ M.T + B @ B.T
    if np.abs(np.linalg.eigvals(through)).max() >= 1.0:
        return float("inf")
    S, total = solve_discrete_lyapunov(through, gathered), 0.0
    for M, B, Cz, Dz in course:
        total += float(np.trace(Cz @ S @ Cz.T) + np.sum(Dz**2))
        S = M @ S @ M.T + B @ B.T
    return total / len(course)


def _slow_gain(errors: ErrorPolytope, gains: list[np.ndarray], rng: np.random.Generator) -> float:
    """Return the l2 gain along one course whose weight moves by at most `STEP` a sample: a wave, by its gradient."""
    k = np.arange(SLOW_HORIZON)
    size = rng.uniform(0.3, 1.0)
    wave = np.sin(2.0 * STEP / size * rng.random() * k + rng.uniform(0.0, 2.0 * np.pi))
    wave = wave if rng.random() < 0.5 else 2.0 / np.pi * np.arcsin(wave)
    course = _within(0.5 + 0.5 * size * wave)
    ends = [errors.at(np.eye(2)[end], gains) for end in range(2)]
    turn = [b - a for a, b in zip(*ends, strict=True)]
    gain, states, w, adjoints = _worst_input(_systems(errors, gains, course))
    reach = 1.0
    for _ in range(SLOW_ROUNDS):
        after = np.vstack([adjoints[1:], np.zeros((1, 3))])
        slope = np.einsum("ki,ki->k", after, states @ turn[0].T + w @ turn[1].T)
        trial = _within(course + reach * slope / max(np.abs(slope).max(), 1e-300))
        more = _worst_input(_systems(errors, gains, trial))
        if more[0] > gain:
            course, (gain, states, w, adjoints) = trial, more
        else:
            reach *= 0.5
    return gain


def _within(course: np.ndarray) -> np.ndarray:
    """Return a course between 0 and 1 with steps of at most `STEP`."""
    made = [float(np.clip(course[0], 0.0, 1.0))]
    for value in course[1:]:
        made.append(float(np.clip(np.clip(value, made[-1] - STEP, made[-1] + STEP), 0.0, 1.0)))
    return np.array(made)


def _systems(errors: ErrorPolytope, gains: list[np.ndarray], course: np.ndarray) -> Closed:
    return [errors.at(np.array([1.0 - t, t]), gains) for t in course]

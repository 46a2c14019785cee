"""Claims for nonlinear plants over a region against slopes that switch, steps that shrink least, and random pulses.

The plants are those of the campaign `nonlinear_regions`, with seeds of their own.  The gain is exceeded where the
Riccati equation of its bound breaks down along one of 200 courses that follow, every 0.05 s, the corner of the slopes
that most enlarges its cost.  The mean square is that of periodic courses of slopes that look three pieces ahead.  For
the decay a search over record, input and two estimates looks for the step that shrinks their distance least.  Random
pulses drive the plant out: rows whose measurement shows it, and those after them, must have no claim.  The mean is
that of the share of the claim that is reached.
"""

from __future__ import annotations

import itertools

import numpy as np
from benchmarks.campaigns.frame import Outcome
from benchmarks.campaigns.nonlinear_regions import GOALS, ROUNDING, _size, designed
from benchmarks.campaigns.switched_regions import BISECTIONS, Closed, _exceeded_in_pieces
from scipy.linalg import expm, solve_discrete_lyapunov
from scipy.optimize import minimize

import obsynth
from obsynth.errors import SolverError
from obsynth.plants.operating_region import OperatingRegion
from obsynth.plants.transformations.nonlinear_terms import nonlinear_terms
from obsynth.verification.nonlinear_drive import drive_of, wanted_of
from obsynth.verification.nonlinear_region import directions, whole_gain
from obsynth.verification.over_region import WITNESSES

CASES = 50
LIMIT = 240.0  # s
#: Added to a seed: none of the campaign `nonlinear_regions` comes again.
FRESH = 900_000
#: Corners of slopes at most: others are left out at random.
CORNERS = 16
LOOKAHEAD, PIECES_OF_COURSE, LONGEST = 3, 40, 12
LENGTHS = (0.1, 0.5)
STARTS, EVALUATIONS = 8, 400
PULSES = 4


def case(seed: int) -> Outcome:
    """Design over a region, and look for what exceeds what is proved."""
    rng, goal = np.random.default_rng(FRESH + seed), GOALS[seed % len(GOALS)]
    made = designed(rng, goal)
    if isinstance(made, Outcome):
        return made
    design, region, noise = made
    wrong, share = _least_shrunk(design, rng)
    if goal != "decay":
        claim = design.certificate.claims["region_deviation" if goal == "power" else "region_gain"]
        closed = _closed(design, noise, rng)
        reached = _gain(closed, claim, rng) if goal == "gain" else np.sqrt(_mean_square(closed, rng))
        share = reached / claim
        if share > 1.0 + ROUNDING:
            wrong = wrong or f"{reached:.9g} is reached, {claim:.9g} claimed"
    wrong = wrong or _pulses(design, region, rng)
    return Outcome(goal, "above 0.9 of the claim" if share > 0.9 else "below 0.9 of the claim", wrong, float(share))


def _least_shrunk(design: obsynth.ObserverDesign, rng: np.random.Generator) -> tuple[str, float]:
    """Return the largest share of the proved factor by which a step shrinks the distance of two estimates."""
    observer = design.observer
    rate, moving = design.certificate.claims["region_decay"], observer.terms.differential
    P = design.certificate.matrices[WITNESSES[0]][0][:moving, :moving]
    bound = (1.0 + 2.0 * rate * observer.dt) ** -0.5
    first = observer.init()
    n, ny = len(first.z), len(observer.output_names)

    def share(v: np.ndarray) -> float:
        z, turn, y = v[:n], v[n : 2 * n], v[2 * n : 2 * n + ny]
        distance = _size(P, turn, moving)
        if distance < 1e-6:
            return 0.0
        one, _ = observer.advance(first._replace(z=z), y, v[2 * n + ny :])
        other, _ = observer.advance(first._replace(z=z + turn), y, v[2 * n + ny :])
        shrunk = _size(P, one.z - other.z, moving) / distance
        return -shrunk / bound if np.isfinite(shrunk) else 0.0

    best = 0.0
    for _ in range(STARTS):
        start = np.r_[first.z + rng.standard_normal(n), rng.standard_normal(n), 0.5 + rng.standard_normal(ny), 0.0]
        found = minimize(share, start, method="Nelder-Mead", options={"maxfev": EVALUATIONS})
        best = max(best, -float(found.fun))
    wrong = f"a step shrinks by {best:.9g} of what is proved" if best > 1.0 + ROUNDING else ""
    return wrong, best


def _closed(design: obsynth.ObserverDesign, noise: dict[str, float], rng: np.random.Generator) -> Closed:
    """Return the error system at the corners of the slopes, algebraic errors solved for."""
    observer = design.observer
    terms = nonlinear_terms(observer.model, faults=observer.faults)
    region = OperatingRegion.of(terms, observer.region)
    W, Wy, V = directions(terms, region.slopes())
    B, D = drive_of(terms, noise, observer.dt)
    Cz, k = wanted_of(terms, region, None), terms.differential
    L, corners = whole_gain(terms, observer.gain), list(itertools.product(*observer.slopes))
    closed = []
    for number in rng.permutation(len(corners))[:CORNERS]:
        slopes = np.diag(corners[number])
        A, F, z = terms.A + W @ slopes @ V - L @ (terms.C + Wy @ slopes @ V), B - L @ D, Cz
        Dz = np.zeros((len(z), F.shape[1]))
        if k < len(A):
            inner = np.linalg.solve(A[k:, k:], np.hstack([A[k:, :k], F[k:]]))
            z, Dz = Cz[:, :k] - Cz[:, k:] @ inner[:, :k], -Cz[:, k:] @ inner[:, k:]
            A, F = A[:k, :k] - A[:k, k:] @ inner[:, :k], F[:k] - A[:k, k:] @ inner[:, k:]
        closed.append((A, F, z, Dz))
    return closed


def _gain(closed: Closed, claim: float, rng: np.random.Generator) -> float:
    low, high = 0.0, claim * (1.0 + ROUNDING)
    if _exceeded_in_pieces(closed, high, 0.0, rng):
        return claim * (1.0 + 10.0 * ROUNDING)
    for _ in range(BISECTIONS):
        level = 0.5 * (low + high)
        low, high = (level, high) if _exceeded_in_pieces(closed, level, 0.0, rng) else (low, level)
    return min(low, claim)


def _mean_square(closed: Closed, rng: np.random.Generator) -> float:
    """Return the largest mean of ``|z|^2`` over time for white w along periodic courses of slopes."""
    best = 0.0
    for h in LENGTHS:
        pieces = [_piece(A, B, Cz, h) for A, B, Cz, _ in closed]
        n, tails = len(closed[0][0]), []
        for course in itertools.product(range(len(pieces)), repeat=LOOKAHEAD if len(pieces) <= 8 else 2):
            weight, offset = np.zeros((n, n)), 0.0
            for k in reversed(course):
                M, N, cost, own = pieces[k]
                offset += own + float(np.trace(weight @ N))
                weight = M.T @ weight @ M + cost
            tails.append((course[0], weight, offset))
        weights, offsets = np.array([tail[1] for tail in tails]), np.array([tail[2] for tail in tails])
        S, course = np.zeros((n, n)), []
        for _ in range(PIECES_OF_COURSE):
            course.append(tails[int(np.argmax(np.einsum("tij,ij->t", weights, S) + offsets))][0])
            M, N, _, _ = pieces[course[-1]]
            S = M @ S @ M.T + N
        for length in range(1, LONGEST + 1):
            best = max(best, _periodic_mean([pieces[k] for k in course[-length:]]) / h)
    return best


def _piece(A: np.ndarray, B: np.ndarray, Cz: np.ndarray, h: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Return over a piece what states become, the covariance that is gathered, and the integral of ``|z|^2``: its
    matrix for the covariance before, and what the noise within the piece adds."""
    n = len(A)
    nodes, shares = np.polynomial.legendre.leggauss(8)

    def gathered(t: float) -> tuple[np.ndarray, np.ndarray]:
        both = expm(t * np.block([[-A, B @ B.T], [np.zeros((n, n)), A.T]]))
        moved = both[n:, n:].T
        return moved, moved @ both[:n, n:]

    cost, own = np.zeros((n, n)), 0.0
    for node, share in zip(nodes, shares, strict=True):
        M, N = gathered(0.5 * h * (node + 1.0))
        cost += 0.5 * h * share * (Cz @ M).T @ (Cz @ M)
        own += 0.5 * h * share * float(np.trace(Cz @ N @ Cz.T))
    M, N = gathered(h)
    return M, N, cost, own


def _periodic_mean(course: list[tuple[np.ndarray, np.ndarray, np.ndarray, float]]) -> float:
    """Return the integral of ``|z|^2`` by piece along a course without end, infinite where errors grow."""
    n = len(course[0][0])
    through, gathered = np.eye(n), np.zeros((n, n))
    for M, N, _, _ in course:
        through, gathered = M @ through, M @ gathered @ M.T + N
    if np.abs(np.linalg.eigvals(through)).max() >= 1.0:
        return float("inf")
    S, total = solve_discrete_lyapunov(through, gathered), 0.0
    for M, N, cost, own in course:
        total += float(np.trace(cost @ S)) + own
        S = M @ S @ M.T + N
    return total / len(course)


def _pulses(design: obsynth.ObserverDesign, region: dict[str, list[float]], rng: np.random.Generator) -> str:
    """Drive the plant out of the region by random pulses: rows that show it, and those after, must have no claim."""
    observer = design.observer
    for _ in range(PULSES):
        u = np.zeros((160, 1))
        begin, length = int(rng.integers(5, 80)), int(rng.integers(1, 60))
        u[begin : begin + length] = rng.choice([-1.0, 1.0]) * rng.uniform(0.5, 12.0)
        try:
            outputs = obsynth.simulate_dae(observer.model, u, dt=observer.dt).outputs
        except SolverError:  # out there the plant may have no solution
            continue
        _, claimed = observer.record(outputs, u)
        left = np.zeros(len(outputs), dtype=bool)
        for name, values in zip(observer.model.output_names, outputs.T, strict=True):
            low, high = region[name.replace("y", "x")]
            left |= (values < low) | (values > high)
        for k in np.flatnonzero(left):
            if claimed[k : k + observer.forgetting].any():
                return f"row {k} is outside, and one of the {observer.forgetting} rows from there on is claimed"
    return ""

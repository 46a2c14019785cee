"""Kalman gains with a prescribed rate of decay (Anderson, Moore, "Linear optimal control", 1971, section 4).

The default needs no numbers: as fast as a fixed price in noise allows.  This compromise is ours.

Gains that put all poles into a region (M. Chilali, P. Gahinet, IEEE TAC 41, 1996), with little noise.

Pole placement by a Sylvester equation, with repeated poles of any multiplicity.

One Jordan chain for each repeated pole, which every observable pair allows: with L in real Jordan form and any G,
``F' X - X L = C' G``, ``K = (G X^{-1})'`` gives ``spectrum(F - K C) = spectrum(L)`` (S. P. Bhattacharyya, E. de Souza,
Systems & Control Letters 1, 1982); G by L-BFGS, its gradient by one adjoint equation.  scipy and python-control look
for as many eigenvectors as the multiplicity: they refuse, or miss poles without a word (error 4.3 for the paper's).
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from obsynth.errors import SolverError, SpecError
from obsynth.methods.conic import lazy_cvxpy as cp
from obsynth.methods.conic import lmi
from obsynth.numerics.arguments import SMALLEST, ComplexArray, FloatArray, is_finite_number, largest_singular_value
from obsynth.numerics.doubling import continuous_riccati_solution
from obsynth.numerics.matrix_equations import (
    continuous_lyapunov,
    continuous_solution,
    discrete_lyapunov,
    discrete_solution,
    doubled_solution,
)
from obsynth.numerics.spectra import (
    SAME_POLE,
    abscissa,
    decay_rates,
    eigenvalues,
    noise_covariance,
    spectrum_error,
    speeds,
)

#: Times the Riccati equation is solved, each time in the coordinates of the last solution, which improve it.
KALMAN_ROUNDS = 2
#: From so many states on the Riccati equation is solved by doubling first.
MOST_STATES_FOR_PENCILS = 40
#: A rate that cannot be had at once is gone to in steps of this factor, from one that is at most so many below.
RATE_FACTOR = 4.0
MOST_RATE_STEPS = 12
#: Steps are shortened down to this factor.
LEAST_FACTOR = 1.2


@dataclass(frozen=True, eq=False)
class KalmanProblem:
    """An observable pair with noise: ``e+ = F e + B w + drive v``, innovation ``C e + D w + background n``."""

    F: FloatArray  # (n, n)
    C: FloatArray  # (ny, n)
    B: FloatArray  # (n, k), for noise that counts, of unit covariance (dt = 0: intensity)
    D: FloatArray  # (ny, k)
    drive: FloatArray  # (n, p): so that the filter stays awake
    background: FloatArray  # (ny, q): regular where an innovation has no noise
    estimates: FloatArray  # (k, n): what the noise is counted in, the fault estimates
    dt: float  # s, 0 for continuous time

    def gain(self, decay: float, *, persistent: bool = False) -> FloatArray | None:
        """Return the gain whose poles all decay at ``decay`` (1/s) or faster; ``None`` when the equation has none."""
        plain = np.eye(self.F.shape[0])
        best, change = self.solved(decay, plain)
        if best is not None or not persistent:
            return best
        rate, steps = decay, 0
        while best is None and steps <= MOST_RATE_STEPS:
            rate, steps = rate / RATE_FACTOR, steps + 1
            best, change = self.solved(rate, plain)
        factor = RATE_FACTOR
        while best is not None and rate < decay and factor > LEAST_FACTOR:
            # By shorter steps where one fails: how long a step may be is a matter of rounding.
            further = min(rate * factor, decay)
            gain, moved = self.solved(further, change)
            if gain is None:
                factor = float(np.sqrt(factor))
            else:
                best, change, rate = gain, moved, further
        return best if rate == decay else None

    def solved(self, decay: float, change: FloatArray) -> tuple[FloatArray | None, FloatArray]:
        """Return the gain of a rate, and coordinates (like ``change``) in which its error covariance is one."""
        if not self.F.size:
            return np.zeros((0, self.C.shape[0])), change
        # The part of the process noise that the measurements carry is taken out first.
        measured = self.D @ self.D.T + self.background @ self.background.T
        direct = np.linalg.solve(measured, self.D @ self.B.T).T
        free = self.F - direct @ self.C
        rest = self.B @ self.B.T + self.drive @ self.drive.T - direct @ self.D @ self.B.T
        rest = 0.5 * (rest + rest.T)
        bound = float(np.exp(-decay * self.dt)) if self.dt > 0.0 else -decay
        best: FloatArray | None = None
        for _ in range(KALMAN_ROUNDS):
            found = _filtered(free, self.C, rest, measured, (bound, self.dt), change)
            if found is None:
                break
            total = found[0] + direct
            # Strictly: a rate that is only met within rounding is none.
            if abscissa(self.F - total @ self.C, self.dt) < bound:
                best = total
            change = found[1]
        return best, change

    def deviations(self, gain: FloatArray, change: FloatArray) -> FloatArray:
        """Return the deviation of each estimate (unit intensity where dt = 0); ``gain (n, ny)``, ``change (n, n)``."""
        entering = np.asarray(np.linalg.solve(change, self.B - gain @ self.D), dtype=np.float64)
        moved = np.asarray(np.linalg.solve(change, (self.F - gain @ self.C) @ change), dtype=np.float64)
        direct = np.zeros((self.estimates.shape[0], entering.shape[1]))
        bound = 1.0 if self.dt > 0.0 else 0.0
        if not abscissa(moved, self.dt) < bound:
            # Stable in some coordinates and not in others: only rounding tells.
            return np.full(len(direct), np.inf)
        covariance = noise_covariance(moved, entering, self.estimates @ change, direct, self.dt)
        return np.asarray(np.sqrt(np.maximum(np.diag(covariance), 0.0)))


def _filtered(
    f: FloatArray,
    c: FloatArray,
    driven: FloatArray,
    measured: FloatArray,
    asked: tuple[float, float],
    change: FloatArray,
) -> tuple[FloatArray, FloatArray] | None:
    """Return the gain of a Kalman filter, and states in which its error covariance is the identity."""
    bound, dt = asked
    with warnings.catch_warnings(action="ignore"), np.errstate(all="ignore"):
        # What a badly conditioned equation gives is judged by its poles.
        try:
            inverse = np.linalg.inv(change)
            moved, noise = inverse @ f @ change, inverse @ driven @ inverse.T
            moved = moved / bound if dt > 0.0 else moved - bound * np.eye(len(f))
            noise = 0.5 * (noise + noise.T)
            for doubled in (True, False) if len(f) >= MOST_STATES_FOR_PENCILS else (False,):
                gain, covariance = _solved(moved, c @ change, noise, measured, dt, doubled=doubled)
                gain = change @ (bound * gain if dt > 0.0 else gain)
                values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
                if np.all(np.isfinite(gain)) and abscissa(f - gain @ c, dt) < bound:
                    break
        except (np.linalg.LinAlgError, ValueError, ArithmeticError):
            return None
    if not np.all(np.isfinite(gain)) or not np.all(np.isfinite(values)) or values[-1] <= 0.0:
        return None
    floor = float(np.finfo(np.float64).eps) * values[-1]
    return np.asarray(gain), np.asarray(change @ (vectors * np.sqrt(np.maximum(values, floor))))


def _solved(
    f: FloatArray, c: FloatArray, noise: FloatArray, measured: FloatArray, dt: float, *, doubled: bool
) -> tuple[FloatArray, FloatArray]:
    """Return gain and error covariance of a Kalman filter, NaN where the equation is not solved: by doubling, or by the
    QZ algorithm, which takes several times as long and hardly ever breaks down."""
    if dt > 0.0:
        y = (doubled_solution if doubled else discrete_solution)(f, c, noise, measured, np.zeros((len(f), len(c))))
    else:
        y = (continuous_riccati_solution if doubled else continuous_solution)(f, c, noise, measured)
    if y is None:
        return np.full((len(f), len(c)), np.nan), np.eye(len(f))
    if dt > 0.0:
        return np.asarray(np.linalg.solve(c @ y @ c.T + measured, c @ y @ f.T).T), y
    return np.asarray(np.linalg.solve(measured, c @ y).T), y


#: The default pays at most this factor in noise, against the quietest Kalman filter, for being fast.
NOISE_PRICE = 10.0
#: The default rate is found to about this factor.
RATE_STEP = 1.05
#: Estimates with less than this share of the outputs' noise have none but rounding.
SILENT = 1e-8
#: Deviations that differ by more than this share from one choice of states to another are rounding.
SAME_DEVIATION = 0.1
#: Halvings of the default rate before the quietest filter is taken as it is.
MOST_RATE_HALVINGS = 40


def compromise(problem: KalmanProblem, rate: float) -> tuple[FloatArray, float, float] | None:
    """Return the fastest gain ``(n, ny)``, up to ``rate`` (1/s), that costs at most `NOISE_PRICE` in noise; its decay
    (1/s), and the largest deviation of an estimate over that of the Kalman gain without a rate."""
    start = np.eye(problem.F.shape[0])
    plain, change = problem.solved(0.0, start)
    slow = rate * 2.0**-MOST_RATE_HALVINGS
    while plain is None and slow <= rate:
        # The quietest filter may be so slow that its equation is lost in rounding: that of some rate is not.
        plain, change = problem.solved(slow, start)
        slow *= 2.0
    if plain is None:
        return None
    # Each estimate by itself: they have units of their own.
    quietest = problem.deviations(plain, change)
    silent = SILENT * np.linalg.norm(problem.estimates, axis=1) * float(np.linalg.norm(problem.D))
    # A deviation that depends on the coordinates it is computed in is rounding, too.
    again = problem.deviations(plain, start)
    counted = (quietest > silent) & np.isclose(quietest, again, rtol=SAME_DEVIATION, atol=0.0) & np.isfinite(quietest)
    best = plain, 0.0, 1.0

    def attempt(decay: float) -> tuple[FloatArray, float, float] | None:
        gain, change = problem.solved(decay, start)
        if gain is None:
            return None
        ratios = problem.deviations(gain, change)[counted] / quietest[counted]
        # None is quieter than the filter without a rate: what is less is rounding in that one.
        price = float(np.max(ratios, initial=1.0))
        return (gain, decay, price) if price <= NOISE_PRICE else None

    high = rate
    slowest = float(np.min(decay_rates(eigenvalues(problem.F - plain @ problem.C), problem.dt), initial=np.inf))
    for _ in range(MOST_RATE_HALVINGS):
        found = attempt(high)
        if found is not None:
            best = found
            break
        high /= 2.0
        if high <= slowest:
            # The quietest filter is as fast as that by itself.
            break
    if best[1] in (0.0, rate):
        return best
    low, high = best[1], 2.0 * best[1]
    while high > RATE_STEP * low:
        middle = float(np.sqrt(low * high))
        found = attempt(middle)
        if found is None:
            high = middle
        else:
            best, low = found, middle
    return best


#: The inequalities are asked for a region smaller by this share, so that a solution on its boundary still counts.
INNER_SHARE = 1e-3
#: Weight of the states beside the estimates in what is minimised, so that no direction is free.
STATE_WEIGHT = 1e-3
#: The matrix of the Lyapunov function stays above this multiple of the identity, in scaled states.
LEAST_LYAPUNOV = 1e-6
#: Above this many states the inequality moves only those poles that a Kalman gain leaves outside the region.
MOST_MOVED_STATES = 20


@dataclass(frozen=True)
class Region:
    """Where all movable poles must lie; ``radius`` and ``damping`` in continuous time only."""

    decay: float = 0.0  # every mode decays at least as exp(-decay t)
    radius: float | None = None  # abs(s) <= radius
    damping: float | None = None  # least ratio, 0 to 1

    @classmethod
    def of(cls, data: Mapping[str, Any], dt: float) -> Region:
        """Return a checked region."""
        known = [field.name for field in fields(cls)]
        problems = [f"unknown key {key!r}; there are: {', '.join(known)}." for key in data if key not in known]
        for key, value in data.items():
            if key in known and (not is_finite_number(value) or value < 0.0 or (key != "decay" and value == 0.0)):
                problems.append(f"{key} is {value!r}: give a positive number.")
        if not problems:
            found = cls(**data)
            if found.damping is not None and found.damping >= 1.0:
                problems.append(f"damping is {found.damping}: give a ratio below 1.")
            if found.radius is not None and found.radius <= found.decay:
                problems.append(f"the region is empty: radius {found.radius} is not above decay {found.decay}.")
            if dt > 0.0 and (found.radius is not None or found.damping is not None):
                problems.append("radius and damping are for continuous time: give decay alone.")
        if problems or not data:
            raise SpecError(
                "Option region of ui-pi-observer:",
                path="method.options.region",
                problems=problems or ["give at least one of decay, radius, damping."],
            )
        return cls(**data)

    def in_time(self, unit: float) -> Region:
        """Return the region with rates per ``unit`` (seconds) instead of per second."""
        return replace(self, decay=unit * self.decay, radius=None if self.radius is None else unit * self.radius)

    def shrunk(self) -> Region:
        """Return the region inside of which poles count as well within it."""
        return replace(
            self,
            decay=(1.0 + 0.5 * INNER_SHARE) * self.decay,
            radius=None if self.radius is None else (1.0 - 0.5 * INNER_SHARE) * self.radius,
            damping=None if self.damping is None else min((1.0 + 0.5 * INNER_SHARE) * self.damping, 1.0),
        )

    def holds(self, values: Any, dt: float) -> bool:
        """Whether all ``values`` lie in the region."""
        poles = np.asarray(values, dtype=np.complex128)
        if dt > 0.0:
            return bool(np.all(np.abs(poles) < np.exp(-self.decay * dt)))
        inside = np.all(poles.real < -self.decay) if self.decay else np.all(poles.real < 0.0)
        if self.radius is not None:
            inside = inside and np.all(speeds(poles, dt) <= self.radius)
        if self.damping is not None:
            inside = inside and np.all(-poles.real >= self.damping * np.abs(poles))
        return bool(inside)


def region_gain(problem: KalmanProblem, region: Region, *, solver: str) -> tuple[FloatArray, dict[str, Any]]:
    """Return K ``(n, ny)`` with the poles of ``F - K C`` in the region and little noise, and the solver's record.

    Above `MOST_MOVED_STATES` states a Kalman gain of the region's rate comes first, and the record is empty where it
    is enough.
    """
    n, dt = problem.F.shape[0], problem.dt
    if n == 0:
        return np.zeros((0, problem.C.shape[0])), {}
    # What one way cannot find, the other may.
    ways = [_partly, _by_inequality] if n > MOST_MOVED_STATES else [_by_inequality, _partly]
    failures: list[SolverError] = []
    for way in ways:
        try:
            gain, record = way(problem, region, solver=solver)
        except SolverError as error:
            failures.append(error)
            continue
        if region.holds(eigenvalues(problem.F - gain @ problem.C), dt):
            return gain, record
        failures.append(
            SolverError(
                f"{solver} ended with poles outside the region: the result is inconclusive. Widen the region, or "
                "use decay= instead.",
                record=record,
            )
        )
    raise failures[ways.index(_by_inequality)]


def _partly(problem: KalmanProblem, region: Region, *, solver: str) -> tuple[FloatArray, dict[str, Any]]:
    """Move only those poles into the region that a Kalman gain of the same rate leaves outside.

    With ``F - K C = V diag(T1, T2) V^-1``, T1 inside, a gain ``V [0; K2]`` makes ``T2 - K2 C V2`` of T2.
    """
    from scipy.linalg import schur, solve_sylvester

    gain = problem.gain((1.0 + INNER_SHARE) * region.decay)
    if gain is None:
        raise SolverError("The Riccati equation has no usable solution: give poles=, or a slower region.")
    inner = region.shrunk()
    triangular, turn, good = schur(
        problem.F - gain @ problem.C, output="real", sort=lambda re, im: inner.holds([complex(re, im)], problem.dt)
    )
    if good == len(triangular):
        return gain, {}
    first, mixed, second = triangular[:good, :good], triangular[:good, good:], triangular[good:, good:]
    apart = np.vstack([solve_sylvester(first, -second, -mixed), np.eye(len(second))])
    moved, rows = turn @ apart, turn[:, good:].T
    rest = replace(
        problem,
        F=second,
        C=problem.C @ moved,
        B=rows @ (problem.B - gain @ problem.D),
        drive=rows @ problem.drive,
        estimates=problem.estimates @ moved,
    )
    more, record = _by_inequality(rest, region, solver=solver)
    return np.asarray(gain + moved @ more), record


def _by_inequality(problem: KalmanProblem, region: Region, *, solver: str) -> tuple[FloatArray, dict[str, Any]]:
    n, dt = problem.F.shape[0], problem.dt
    change = _scaling(problem, region)
    inverse = np.linalg.inv(change)
    f, c = inverse @ problem.F @ change, problem.C @ change
    estimates = problem.estimates @ change
    # The drive is left out: the region says how fast the poles must be, and less noise is what is left to ask for.
    entering = inverse @ np.hstack([problem.B, np.zeros((n, problem.background.shape[1]))])
    direct = np.hstack([problem.D, problem.background])
    size = max(largest_singular_value(estimates), SMALLEST)
    weight = estimates.T @ estimates / size**2 + STATE_WEIGHT * np.eye(n)
    p, y = lmi.symmetric_variable(n), lmi.matrix_variable(n, c.shape[0])
    z = lmi.symmetric_variable(entering.shape[1])
    moved = p @ f - y @ c
    noise = p @ entering - y @ direct
    constraints = [
        lmi.at_least(p, LEAST_LYAPUNOV),
        lmi.at_least(lmi.symmetric_blocks([[z], [noise, p]])),
    ]
    if dt > 0.0:
        radius = float(np.exp(-region.decay * dt)) * (1.0 - INNER_SHARE * min(1.0, region.decay * dt))
        constraints += [
            lmi.at_least(lmi.symmetric_blocks([[p - weight], [moved, p]])),
            lmi.at_least(lmi.symmetric_blocks([[radius * p], [moved, radius * p]])),
        ]
    else:
        constraints.append(lmi.at_most(moved + moved.T + weight, 0.0))
        constraints += _continuous_region(region, p, moved)
    record = lmi.minimise(cp.trace(z), constraints, what="poles in a region", solver=solver)
    return np.asarray(change @ np.linalg.solve(lmi.value_of(p), lmi.value_of(y))), record


def _continuous_region(region: Region, p: Any, moved: Any) -> list[Any]:
    found = []
    if region.decay:
        found.append(lmi.at_most(moved + moved.T + 2.0 * region.decay * (1.0 + INNER_SHARE) * p, 0.0))
    if region.radius is not None:
        radius = region.radius * (1.0 - INNER_SHARE)
        found.append(lmi.at_least(lmi.symmetric_blocks([[radius * p], [moved, radius * p]])))
    if region.damping is not None:
        cosine = min(region.damping * (1.0 + INNER_SHARE), 1.0)
        sine = float(np.sqrt(1.0 - cosine**2))
        both, turned = sine * (moved + moved.T), cosine * (moved.T - moved)
        found.append(lmi.at_most(lmi.symmetric_blocks([[both], [turned, both]]), 0.0))
    return found


def _scaling(problem: KalmanProblem, region: Region) -> FloatArray:
    """Return a state change in which the error covariance of a filter of the same rate is the identity."""

    gain = problem.gain(region.decay)
    if gain is None:
        return np.eye(problem.F.shape[0])
    closed, entering = problem.F - gain @ problem.C, problem.B - gain @ problem.D
    noise = entering @ entering.T + problem.drive @ problem.drive.T
    noise = noise + gain @ problem.background @ problem.background.T @ gain.T
    with warnings.catch_warnings(action="ignore"), np.errstate(all="ignore"):
        # A poor scaling is judged by what the solver makes of it.
        if problem.dt > 0.0:
            radius = np.exp(-region.decay * problem.dt)
            covariance = discrete_lyapunov(closed / radius, noise)
        else:
            covariance = continuous_lyapunov(closed + region.decay * np.eye(len(closed)), -noise)
    if not np.all(np.isfinite(covariance)):
        return np.eye(len(closed))
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    if values[-1] <= 0.0:
        return np.eye(len(closed))
    floor = float(np.finfo(np.float64).eps) * values[-1]
    return np.asarray(vectors * np.sqrt(np.maximum(values, floor)))


#: Random starts of the search, and fewer for large pairs; each step costs two Sylvester equations.
STARTS, FEW_STARTS, LARGE_PAIR = 8, 2, 20
#: Longest run of the search, and how often it is taken up again from where it ended, with eigenvectors of unit length,
#: as long as the logarithm of the objective falls by more than this.
MOST_PLACEMENT_STEPS, RESTARTS, LEAST_PROGRESS = 400, 8, 1e-3
#: First steps of a search for good conditioning, and how many of the starts that are ahead after these go on.
FIRST_SEARCH_STEPS, FINALISTS = 40, 3
#: Seed of the starts: the same question gives the same gains.
STARTS_SEED = 20240
#: Spectra of F and L closer than this, relative to the size of F, make the Sylvester equation nearly singular: F is
#: then shifted by a random gain first.
OVERLAP = 1e-3
#: Computed poles may miss the wanted ones by this, relative to their size.
PLACEMENT_TOLERANCE = 1e-5


def jordan_form(poles: Sequence[complex]) -> FloatArray:
    """Return a real cyclic matrix ``(n, n)`` with these eigenvalues: one chain for each group of equal poles."""
    upper = [pole for pole in poles if pole.imag >= 0.0]
    groups: list[list[complex]] = []
    for pole in sorted(upper, key=lambda value: (value.real, value.imag)):
        home = next((group for group in groups if abs(group[0] - pole) <= SAME_POLE * max(abs(pole), SMALLEST)), None)
        if home is not None and (pole.imag > 0.0) == (home[0].imag > 0.0):
            home.append(pole)
        else:
            groups.append([pole])
    result, start = np.zeros((len(poles), len(poles))), 0
    for group in groups:
        width = 2 if group[0].imag > 0.0 else 1
        link = max(abs(group[0]), 1.0)
        for place, pole in enumerate(group):
            at = slice(start, start + width)
            block = [[pole.real, pole.imag], [-pole.imag, pole.real]] if width == 2 else [[pole.real]]
            result[at, at] = block
            if place:
                result[start - width : start, at] = link * np.eye(width)
            start += width
    return result


def place(
    f: FloatArray,
    c: FloatArray,
    poles: Sequence[complex],
    *,
    dt: float = 0.0,
    objective: str = "conditioning",
    weight: FloatArray | None = None,
) -> tuple[FloatArray, float]:
    """Return K ``(n, ny)`` such that ``F - K C`` has these poles, and the condition of the (generalised) eigenvectors;
    ``f (n, n)``, ``c (ny, n)``, ``weight (m, n)``."""
    n, outputs = f.shape[0], c.shape[0]
    if n == 0:
        return np.zeros((0, outputs)), 1.0
    target = jordan_form(poles)
    rng = np.random.default_rng(STARTS_SEED)
    size = max(largest_singular_value(f), SMALLEST)
    distance = np.min(np.abs(np.linalg.eigvals(f)[:, None] - np.asarray(poles)[None, :]))
    first = np.zeros((n, outputs))
    if distance <= OVERLAP * size:
        first = rng.standard_normal((n, outputs)) * size / max(largest_singular_value(c), SMALLEST)
    scale = np.eye(n) if weight is None else weight
    problem = _Sylvester.of((f - first @ c).T, c.T, target, first.T, objective, scale.T @ scale)
    best: tuple[float, FloatArray] | None = None
    starts = [rng.standard_normal((outputs, n)) for _ in range(STARTS if n <= LARGE_PAIR else FEW_STARTS)]
    if objective == "gain":
        # Well-conditioned eigenvectors are a good place to start from.
        other = replace(problem, objective="conditioning").minimised(starts[0])
        starts = starts if other is None else [other[1], *starts]
    if objective == "conditioning":
        # All go a short way, and the best of them to the end.  Small gains are not predicted as early.
        tried = [problem.minimised(start, steps=FIRST_SEARCH_STEPS, restarts=1) for start in starts]
        ahead = sorted((found for found in tried if found is not None), key=lambda found: found[0])
        starts = [start for _, start in ahead[:FINALISTS]]
    for start in starts:
        found = problem.minimised(start)
        if found is not None and (best is None or found[0] < best[0]):
            best = found
    if best is None:
        raise SolverError("No gain for these poles was found: the Sylvester equation stayed singular.")
    x, gain = problem.solution(best[1])
    k = first + gain.T
    error = spectrum_error(f - k @ c, poles, dt)
    if not error <= PLACEMENT_TOLERANCE:
        raise SolverError(
            f"The poles could not be placed: they are wrong by {error:.2g} of their size. The pair is "
            "close to an unobservable one: ask for slower or fewer distinct poles, lower the order of the fault model, "
            "or use decay= instead."
        )
    return k, float(np.linalg.cond(x))


@dataclass(frozen=True, eq=False)
class _Sylvester:
    """``A X - X L = B G`` for many G, by one Schur form of A; L is quasi-triangular already."""

    triangular: FloatArray
    rotation: FloatArray
    B: FloatArray
    L: FloatArray
    shift: FloatArray
    objective: str
    gram: FloatArray

    @classmethod
    def of(
        cls,
        a: FloatArray,
        b: FloatArray,
        target: FloatArray,
        shift: FloatArray,
        objective: str,
        gram: FloatArray,
    ) -> _Sylvester:
        from scipy.linalg import schur

        triangular, rotation = schur(a, output="real")
        return cls(triangular, rotation, b, target, shift, objective, gram)

    def states(self, g: FloatArray) -> FloatArray:
        from obsynth.numerics.lapack import dtrsyl

        right = self.rotation.T @ (self.B @ g)
        x, scale, _ = dtrsyl(self.triangular, self.L, right, isgn=-1)
        return np.asarray(self.rotation @ (x / scale))

    def adjoint(self, weight: FloatArray) -> FloatArray:
        """Return Y with ``A' Y - Y L' = weight``: the gradient of <weight, X> is ``B' Y``."""
        from obsynth.numerics.lapack import dtrsyl

        y, scale, _ = dtrsyl(self.triangular, self.L, self.rotation.T @ weight, trana="T", tranb="T", isgn=-1)
        return np.asarray(self.rotation @ (y / scale))

    def solution(self, g: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return X and the gain ``G X^-1``."""
        x = self.states(g)
        return x, np.asarray(np.linalg.solve(x.T, g.T).T)

    def value_and_gradient(self, flat: FloatArray) -> tuple[float, FloatArray]:
        g = flat.reshape(self.B.shape[1], -1)
        x = self.states(g)
        inverse = np.linalg.inv(x)
        if self.objective == "gain":
            gain = g @ inverse
            total = gain + self.shift
            weighted = total @ self.gram
            value = float(np.sum(weighted * total))
            weight = -2.0 * gain.T @ weighted @ inverse.T
            direct = 2.0 * weighted @ inverse.T
        else:
            own, other = float(np.sum(x**2)), float(np.sum(inverse**2))
            value = own * other
            weight = 2.0 * other * x - 2.0 * own * inverse.T @ inverse @ inverse.T
            direct = np.zeros_like(g)
        gradient = direct + self.B.T @ self.adjoint(weight)
        return float(np.log(value)), np.asarray(gradient / value).ravel()

    def minimised(
        self, start: FloatArray, *, steps: int = MOST_PLACEMENT_STEPS, restarts: int = RESTARTS
    ) -> tuple[float, FloatArray] | None:
        """Return the least value found and its G; ``None`` when the equation is singular from the start."""
        from scipy.optimize import minimize

        evaluate: Callable[[FloatArray], Any] = self.value_and_gradient
        best: tuple[float, FloatArray] | None = None
        g = start
        try:
            for _ in range(restarts):
                g = self.normalised(g)
                with np.errstate(all="ignore"):
                    done = minimize(evaluate, g.ravel(), jac=True, method="L-BFGS-B", options={"maxiter": steps})
                if not np.isfinite(done.fun):
                    break
                gained = np.inf if best is None else best[0] - float(done.fun)
                g = np.asarray(done.x).reshape(start.shape)
                if best is None or gained > 0.0:
                    best = (float(done.fun), g)
                if gained < LEAST_PROGRESS:
                    break
        except np.linalg.LinAlgError:
            return best
        return best

    def normalised(self, g: FloatArray) -> FloatArray:
        """Return G with each Jordan chain scaled so that its part of X has unit size; the gain stays the same."""
        lengths = np.linalg.norm(self.states(g), axis=0)
        linked = (self.L != 0.0) | (self.L.T != 0.0) | np.eye(len(self.L), dtype=bool)
        for _ in range(len(self.L).bit_length()):
            linked = (linked.astype(float) @ linked.astype(float)) > 0.0
        chains = np.array([np.max(lengths[row]) for row in linked])
        return np.asarray(g / np.where(chains > 0.0, chains, 1.0))


#: Poles given as numbers count as a conjugate pair when they agree to this, relative to their size.
PAIR_TOLERANCE = 1e-9
_POLES_OPTION = "method.options.poles"


def checked_poles(
    given: Any, count: int, fixed: ComplexArray, dt: float, *, of: str = "ui-pi-observer"
) -> list[complex]:
    """Return the wanted poles, in exact conjugate pairs; ``of``: what they are for, in messages."""
    listed = [as_pole(pole) for pole in given]
    problems = []
    if len(listed) != count:
        kept = ", ".join(f"{complex(value):.6g}" for value in fixed)
        besides = f" (fixed, not to be listed: {kept})" if kept else ""
        problems.append(f"{len(listed)} are given, but {count} can be placed{besides}.")
    rates = decay_rates(listed, dt)
    unstable = [pole for pole, rate in zip(listed, rates, strict=True) if not rate > 0.0]
    if unstable:
        where = "inside the unit circle" if dt > 0.0 else "in the left half plane"
        problems.append(f"{', '.join(f'{pole:.6g}' for pole in unstable)} would not be stable: give poles {where}.")
    upper = [pole for pole in listed if pole.imag > 0.0]
    lower = [pole for pole in listed if pole.imag < 0.0]
    lonely = []
    for pole in upper:
        partner = next((p for p in lower if abs(p - pole.conjugate()) <= PAIR_TOLERANCE * abs(pole)), None)
        if partner is None:
            lonely.append(pole)
        else:
            lower.remove(partner)
    lonely += lower
    if lonely:
        problems.append(f"{', '.join(f'{pole:.6g}' for pole in lonely)} lack their conjugates.")
    if problems:
        raise SpecError(f"Option poles of {of}:", path=_POLES_OPTION, problems=problems)
    real = [pole for pole in listed if pole.imag == 0.0]
    return [*real, *(p for pole in upper for p in (pole, pole.conjugate()))]


def as_pole(pole: Any) -> complex:
    """Return a pole that is given as a number, or as its real and imaginary part."""
    try:
        value = complex(*pole) if isinstance(pole, (list, tuple, np.ndarray)) and len(pole) == 2 else complex(pole)
    except (TypeError, ValueError):
        raise SpecError(f"{pole!r} is no pole: give a number, or [re, im].", path=_POLES_OPTION) from None
    if isinstance(pole, (bool, str)) or not np.isfinite(value):
        raise SpecError(f"{pole!r} is no pole: give a finite number, or [re, im].", path=_POLES_OPTION)
    return value

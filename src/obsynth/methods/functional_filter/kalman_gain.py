"""Filter models (a plant without unknown inputs, fault models on it) and their Kalman gains, for a fixed lag too.

A decoupled plant is driven by y itself, so the same noise stands in its states and in its outputs.

Random-walk intensity of a fault that is not stated: slowly, but so that a step is seen in the plant's own time.

And the deviation against the delay: one Riccati equation for each walk, as smoothing over L samples takes ``sum_j G_j C
M_j`` from the error covariance.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from obsynth.analysis.diagnosis.fault_columns import decoupled
from obsynth.analysis.plant_units import PlantUnits
from obsynth.analysis.zeros import structure_of
from obsynth.errors import ObsynthError, PreconditionError, SolverError
from obsynth.numerics.arguments import SMALLEST, FloatArray, largest_singular_value
from obsynth.numerics.matrix_equations import (
    continuous_lyapunov,
    continuous_solution,
    discrete_lyapunov,
    riccati_solution,
)
from obsynth.numerics.ranks import RANK_TOLERANCE, decide_rank, rank_from
from obsynth.numerics.scaling import balanced_matrix
from obsynth.numerics.spectra import abscissa, moving_speeds
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.fault_models import Exosystem, exosystem
from obsynth.verification.claims import slowest_decay


@dataclass(frozen=True, eq=False)
class FilterModel:
    """``xi+ = A xi + B v + N w``, ``0 = C xi - L v + M w`` with ``v = [u; y]``; some faults are ``estimate @ xi``.

    xi follows ``T E x`` and the states of the fault models, and ``L v - C xi`` is T0 times the plant's equations.
    """

    A: FloatArray  # (n, n)
    C: FloatArray  # (p, n)
    B: FloatArray  # (n, nu + ny)
    L: FloatArray  # (p, nu + ny)
    N: FloatArray  # (n, nw)
    M: FloatArray  # (p, nw)
    estimate: FloatArray  # (faults, n)
    drive: FloatArray  # (n, model states): where the fault models are driven
    T: FloatArray  # (n, nx)
    T0: FloatArray  # (p, nx)
    faults: tuple[int, ...]  # columns of the plant
    order: int  # states without those of the fault models
    fault_sizes: FloatArray
    dt: float


def filter_model(
    plant: DescriptorSystem, model: Exosystem, *, removed: Sequence[int], faults: Sequence[int]
) -> FilterModel:
    """Return the model for some faults, free of the unknown inputs and of the faults removed."""
    found, used = decoupled(plant, removed, faults), model_states(model, faults)
    phi, cw = model.Phi[np.ix_(used, used)], model.Cw[np.ix_(list(faults), used)]
    k, count = found.order, len(phi)
    inverse = np.linalg.inv(found.E) if k else np.zeros((0, 0))
    zeros = np.zeros((count, k))
    known = np.hstack([found.Bu, found.By])
    rows = _telling_rows(np.hstack([found.C, found.G @ cw, -found.Du, found.H, found.M]))
    return FilterModel(
        A=np.block([[inverse @ found.A, inverse @ found.F @ cw], [zeros, phi]]),
        C=rows @ np.hstack([found.C, found.G @ cw]),
        B=np.vstack([inverse @ known, np.zeros((count, plant.nu + plant.ny))]),
        L=rows @ np.hstack([-found.Du, found.H]),
        N=np.vstack([inverse @ found.N, np.zeros((count, plant.nw))]),
        M=rows @ found.M,
        estimate=np.hstack([np.zeros((len(faults), k)), cw]),
        drive=np.vstack([np.zeros((k, count)), np.eye(count)]),
        T=np.vstack([inverse @ found.rows[:k, : plant.nx], np.zeros((count, plant.nx))]),
        T0=-rows @ found.rows[k:, : plant.nx],
        faults=tuple(faults),
        order=k,
        fault_sizes=found.fault_sizes,
        dt=plant.dt,
    )


def model_states(model: Exosystem, faults: Sequence[int]) -> list[int]:
    """Return the states of the exosystem that some faults are made of."""
    reached = np.any(model.Cw[list(faults)] != 0.0, axis=0) if len(faults) else np.zeros(model.order, dtype=bool)
    for _ in range(model.order):
        reached = reached | np.any(model.Phi[reached] != 0.0, axis=0)
    return [int(i) for i in np.flatnonzero(reached)]


def _telling_rows(whole: FloatArray) -> FloatArray:
    """Return combinations ``(q, p)`` of the rows ``whole (p, columns)`` that say something: some are empty."""
    if not whole.size:
        return np.eye(len(whole))
    sizes = np.max(np.abs(whole), axis=0)
    left, values, _ = np.linalg.svd(whole / np.where(sizes > 0.0, sizes, 1.0))
    rank = rank_from(values, expected=len(whole)).rank
    return np.eye(len(whole)) if rank == len(whole) else np.asarray(left[:, :rank].T)


#: Noise that every state gets besides the stated one, as a share of the sensors', where the equation has no stable
#: solution without: a mode that nothing drives would never be corrected.
SHARES_OF_NOISE = (0.0, 1e-6, 1e-4, 1e-2, 1.0)
#: Noise that exact rows (equations without outputs and noise) are held to have, as a share of the sensors', by whether
#: the plant is sampled: a continuous gain would be infinite without, a sampled one need not be.
SHARES_OF_EXACT_ROWS = {True: (0.0, 1e-6, 1e-3), False: (1e-3, 1e-2, 0.1)}
#: A pole this close to the boundary of stability, of a sampled filter, or relative to its matrix, is none that a proof
#: could tell from one on it.
PROVABLE = 1e-10
#: A covariance that misses its equation by less than the first, relative to the terms, solves it.  Less than the second
#: is enough for the digits that are printed.  One that misses by more than the third solves another equation, although
#: its filter may be stable: wrong ones missed by .08 to .8 (500 plants).  Of those between, the best of all shares is
#: taken.
SOLVED, WELL_SOLVED, MOST_MISSED = 1e-14, 1e-10, 5e-3
#: Newton's method doubles the digits in a step, once it is near.
MOST_NEWTON_STEPS = 30


@dataclass(frozen=True, eq=False)
class KalmanGain:
    """A stable gain."""

    K: FloatArray  # (n, p), of the prediction
    lag: tuple[FloatArray, ...]  # (n, p) each: gain of xi(k) from the innovation at k + j
    innovation: FloatArray  # (p, p), its covariance; intensity in continuous time
    covariance: FloatArray | None = None  # (n, n), of the errors of the prediction; ``None``: of poles
    seen: tuple[float, float] | None = None  # of a walk by default: seconds, and share of a step still missing then


def exact_rows(model: FilterModel) -> FloatArray:
    """Return combinations ``(q, p)`` of the model's rows that no noise enters, of unit length."""
    p = model.M.shape[0]
    if not p:
        return np.zeros((0, 0))
    left, values, _ = np.linalg.svd(model.M) if model.M.shape[1] else (np.eye(p), np.zeros(0), None)
    return np.asarray(left[:, rank_from(values, expected=p).rank :].T)


def require_noise(model: FilterModel, plant_outputs: tuple[str, ...], noise: FloatArray) -> None:
    """Raise `PreconditionError` where a combination of outputs is free of noise; equations without any may be."""
    measured = model.L[:, model.L.shape[1] - len(plant_outputs) :]
    trusted = exact_rows(model) @ measured
    if not trusted.size or float(np.max(np.abs(trusted))) <= RANK_TOLERANCE * float(np.max(np.abs(measured))):
        return
    silent = [name for name, row in zip(plant_outputs, noise, strict=True) if not row.any()]
    which = f"no noise is stated for {', '.join(silent)}" if silent else "its noise cancels"
    raise PreconditionError(
        f"A combination of the outputs is free of noise: {which}. A Kalman gain would be infinite there; "
        "state the noise of every sensor (sensor_noise), or give poles.",
        condition="noise of every output",
        signals=silent or plant_outputs,
    )


def kalman_gain(model: FilterModel, rates: FloatArray, *, lag: int = 0, decay: float = 0.0) -> KalmanGain:
    """Return the gain for walks of the fault models, ``rates (model states,)``; errors decay at ``decay`` (1/s)."""
    n, p = model.A.shape[0], model.C.shape[0]
    if n == 0:
        return KalmanGain(np.zeros((0, p)), (np.zeros((0, p)),) * (lag + 1), model.M @ model.M.T, np.zeros((0, 0)))
    process = model.N @ model.N.T + (model.drive * rates**2) @ model.drive.T
    measured, cross = model.M @ model.M.T, model.N @ model.M.T
    unit = max(float(np.max(np.abs(model.N[: model.order]), initial=0.0)), float(np.max(np.abs(model.M), initial=0.0)))
    states = np.diag(np.r_[np.ones(model.order), np.zeros(n - model.order)])
    exact, sampled = exact_rows(model), model.dt > 0.0
    tried = product(SHARES_OF_NOISE, SHARES_OF_EXACT_ROWS[sampled] if len(exact) else (0.0,))
    best, least = None, MOST_MISSED
    for share, trust in tried:
        drive = process + (share * unit) ** 2 * states
        rows = measured + (trust * unit) ** 2 * (exact.T @ exact)
        if sampled:
            found = _discrete(model, drive, rows, cross, lag, float(np.exp(decay * model.dt)))
        else:
            found = _continuous(model, drive, rows, cross, decay)
        if found is not None and found[1] <= least:
            best, least = found
        if least <= WELL_SOLVED:
            break
    if best is not None:
        return best
    raise SolverError(
        "The Riccati equation of the filter has no stable solution that double precision could find: look at the units "
        "and the noise of the sensors, or give poles."
    )


def _discrete(
    model: FilterModel, process: FloatArray, measured: FloatArray, cross: FloatArray, lag: int, growth: float
) -> tuple[KalmanGain, float] | None:
    equation = _Equation(growth * model.A, model.C, process, measured, growth * cross, sampled=True)
    found = equation.solution()
    if found is None:
        return None
    p, missed = found
    innovation = equation.innovation(p)
    gain = equation.gain(p) / growth
    closed = model.A - gain @ model.C
    if not abscissa(closed, model.dt) < (1.0 - PROVABLE) / growth:
        return None
    gains, moved = [], p.copy()
    for _ in range(lag + 1):
        gains.append(np.asarray(np.linalg.solve(innovation, model.C @ moved).T))
        moved = closed @ moved
    return KalmanGain(gain, tuple(gains), innovation, p), missed


def _continuous(
    model: FilterModel, process: FloatArray, measured: FloatArray, cross: FloatArray, decay: float
) -> tuple[KalmanGain, float] | None:
    a = model.A + decay * np.eye(len(model.A))
    equation = _Equation(a, model.C, process, measured, cross, sampled=False)
    found = equation.solution()
    if found is None:
        return None
    p, missed = found
    gain = equation.gain(p)
    closed = model.A - gain @ model.C
    if not abscissa(closed, 0.0) < -decay - PROVABLE * _size(closed):
        return None
    return KalmanGain(gain, (), measured, p), missed


@dataclass(frozen=True, eq=False)
class _Equation:
    """The Riccati equation of a filter: ``0`` or ``P = a P a' + process - K innovation(P) K'``."""

    a: FloatArray
    c: FloatArray
    process: FloatArray
    measured: FloatArray
    cross: FloatArray
    sampled: bool

    def innovation(self, p: FloatArray) -> FloatArray:
        """Return the covariance of the innovations."""
        return self.c @ p @ self.c.T + self.measured if self.sampled else self.measured

    def gain(self, p: FloatArray) -> FloatArray:
        """Return the gain K ``(n, p)`` of an error covariance."""
        through = (self.a @ p if self.sampled else p) @ self.c.T + self.cross
        return np.asarray(np.linalg.solve(self.innovation(p), through.T).T, dtype=np.float64)

    def missed(self, p: FloatArray) -> float:
        """Return what a covariance misses the equation by, relative to the terms; infinite where it has no gain."""
        try:
            gain = self.gain(p)
        except np.linalg.LinAlgError:
            return np.inf
        moved = self.a @ p @ self.a.T - p if self.sampled else self.a @ p + p @ self.a.T
        taken = gain @ self.innovation(p) @ gain.T
        size = sum(float(np.linalg.norm(term)) for term in (moved, taken, self.process))
        size += float(np.linalg.norm(p)) if self.sampled else float(np.linalg.norm(self.a @ p))
        missed = float(np.linalg.norm(moved - taken + self.process)) / max(size, SMALLEST)
        return missed if np.isfinite(missed) else np.inf

    def solution(self) -> tuple[FloatArray, float] | None:
        """Return the covariance and what it misses the equation by; ``None`` where no stable filter came out."""
        solve = riccati_solution if self.sampled else continuous_solution
        p = solve(self.a, self.c, self.process, self.measured, self.cross)
        if p is None or not np.all(np.isfinite(p)):
            return None
        p = 0.5 * (p + p.T)
        missed = self.missed(p)
        for _ in range(MOST_NEWTON_STEPS):
            if missed <= SOLVED or not np.isfinite(missed):
                break
            better = self._stepped(p)
            less = np.inf if better is None else self.missed(better)
            if better is None or not less < missed:
                break
            p, missed = better, less
        return (p, missed) if np.isfinite(missed) else None

    def _stepped(self, p: FloatArray) -> FloatArray | None:
        """Return the covariance of the filter with the gain of another one: Newton's step, which needs no inverse of
        the sensors' noise, and from any stable filter goes to the best one (Hewer 1971, Kleinman 1968)."""
        gain = self.gain(p)
        closed = self.a - gain @ self.c
        shared = gain @ self.cross.T
        driven = self.process - shared - shared.T + gain @ self.measured @ gain.T
        limit, dt = (1.0, 1.0) if self.sampled else (0.0, 0.0)
        if not np.all(np.isfinite(closed)) or not abscissa(closed, dt) < limit:
            return None
        with warnings.catch_warnings(action="ignore"):
            # What an ill-conditioned step gives is judged by what it misses.
            try:
                found = discrete_lyapunov(closed, driven) if self.sampled else continuous_lyapunov(closed, -driven)
            except np.linalg.LinAlgError:
                return None
        return np.asarray(0.5 * (found + found.T)) if np.all(np.isfinite(found)) else None


def _size(matrix: FloatArray) -> float:
    """Return the norm of a matrix in the units of its states in which it is least."""
    return largest_singular_value(balanced_matrix(matrix)[0])


def whitening(innovation: FloatArray) -> FloatArray:
    """Return W ``(p, p)`` with ``W innovation W' = I``; rows of nothing but rounding are left out of it."""
    if not innovation.size:
        return innovation
    sizes, directions = np.linalg.eigh(0.5 * (innovation + innovation.T))
    kept = sizes > RANK_TOLERANCE**2 * sizes[-1]
    return np.asarray((directions[:, kept] / np.sqrt(sizes[kept])).T)


#: A step is to be seen to 90 % after so many time constants of the plant, but no sooner than so many samples.
STEP_TIME_CONSTANTS, LEAST_SAMPLES = 7.0, 4.0
#: Estimates of a step within this of one count as there; asked at these multiples of the time.
RATE_REACHED, ASKED_AT = 0.1, (1.0, 1.5, 2.5)
#: Where no walk shows a step in time: walks that miss it by so much more than the best are as good.
AS_CLOSE = 0.05
#: A walk that misses a step by more shows nothing of it in time: how much more than that is a matter of rounding.
#: Where no walk shows more, it has so many times as long, this often: the slowest of all would show nothing ever, and
#: is taken only where rounding hides what faster ones show.
NOTHING_SHOWN, LONGER, MOST_LONGER = 0.5, 2.0, 55
#: Errors that need longer than so many settling times to decay would stay in any run: the gain moves such poles.
FOR_GOOD = 1e5
#: Decades of the search around a rate of the size of the noise, and its steps per decade at the end.
DECADES, RATE_BISECTIONS = 8, 9


def settling_time(plant: DescriptorSystem) -> float:
    """Return the time in seconds after which a step of a fault should be seen."""
    own = 1.0 / (plant.dt or PlantUnits.of(plant).time)
    alive = np.sort(moving_speeds(structure_of(plant).finite_eigenvalues, plant.dt, own))
    # The median, for which numpy would load its masked arrays.
    middle = 0.5 * (alive[(alive.size - 1) // 2] + alive[alive.size // 2]) if alive.size else 0.0
    wanted = STEP_TIME_CONSTANTS / float(middle) if alive.size else max(plant.dt, 1.0) * 10.0
    return max(wanted, LEAST_SAMPLES * plant.dt)


def default_rates(
    model: FilterModel, seconds: float, *, lag: int, longer: int = MOST_LONGER
) -> tuple[FloatArray, KalmanGain]:
    """Return the slowest walk of all fault models with which steps are seen in time, and its gain."""
    states = model.drive.shape[1]
    natural = np.max(np.abs(model.estimate[:, model.order :]), axis=0, initial=0.0)
    sizes = np.ones(states)
    for row, size in zip(model.estimate[:, model.order :], model.fault_sizes, strict=True):
        sizes[row != 0.0] = max(float(size), np.finfo(np.float64).tiny)
    noise = max(float(np.max(np.abs(model.M), initial=0.0)), float(np.max(np.abs(model.N), initial=0.0)))
    noise = noise or 1.0  # a fault that equations without noise tell
    unit = np.where(natural > 0.0, noise / sizes, noise / float(np.max(sizes, initial=1.0)))
    tried: dict[float, KalmanGain | None] = {}

    def gain(exponent: float) -> KalmanGain | None:
        if exponent not in tried:
            try:
                tried[exponent] = kalman_gain(model, 10.0**exponent * unit, lag=lag)
            except SolverError:
                tried[exponent] = None
        return tried[exponent]

    def missed(exponent: float, seconds: float) -> float:
        found = gain(exponent)
        return np.inf if found is None else step_misses(model, found, seconds)

    exponents = [float(e) for e in range(-DECADES, DECADES + 1)]
    for waited in range(longer + 1):
        seconds *= LONGER if waited else 1.0
        misses: list[float] = []
        for exponent in exponents:
            misses.append(missed(exponent, seconds))
            if misses[-1] <= RATE_REACHED:
                break
        least = min(misses)
        if least <= NOTHING_SHOWN:
            break
    if not any(found is not None for found in tried.values()):
        raise SolverError("No random-walk intensity of the fault gives a stable filter: give fault_rate, or poles.")
    high = exponents[len(misses) - 1]
    if least > RATE_REACHED:
        # Some zero keeps every estimate from a step for long: the slowest walk that comes about as close as any.
        close = np.inf if least > NOTHING_SHOWN else least + AS_CLOSE
        high = next(e for e, miss in zip(exponents, misses, strict=True) if tried[e] is not None and miss <= close)
    else:
        low = high - 1.0
        for _ in range(RATE_BISECTIONS):
            middle = 0.5 * (low + high)
            low, high = (low, middle) if missed(middle, seconds) <= RATE_REACHED else (middle, high)
    walks = 10.0**high * unit
    found = _forgetting(model, walks, _known(gain(high)), seconds, lag)
    return walks, replace(found, seen=(seconds, step_misses(model, found, seconds)))


def _forgetting(model: FilterModel, walks: FloatArray, found: KalmanGain, seconds: float, lag: int) -> KalmanGain:
    """Return the gain, or one for the same walks whose errors do not stay for good, where there is one."""
    slowest = 1.0 / (FOR_GOOD * seconds)
    if not slowest_decay(model.A - found.K @ model.C, model.dt) < slowest:
        return found
    try:
        return kalman_gain(model, walks, lag=lag, decay=slowest)
    except SolverError:
        return found


def step_misses(model: FilterModel, gain: KalmanGain, seconds: float) -> float:
    """Return how far estimates of a unit step of each fault are from it at and after a time, at worst."""
    a = model.A - gain.K @ model.C
    worst = 0.0
    start = model.drive @ np.linalg.pinv(model.estimate[:, model.order :])
    for share in ASKED_AT:
        error = model.estimate @ _after(a, share * seconds, model.dt) @ start
        worst = max(worst, float(np.max(np.abs(error), initial=0.0)))
    return worst


def _after(a: FloatArray, seconds: float, dt: float) -> FloatArray:
    from scipy.linalg import expm

    if dt > 0.0:
        return np.asarray(np.linalg.matrix_power(a, max(round(seconds / dt), 1)))
    return np.asarray(expm(a * seconds))


def _known(gain: KalmanGain | None) -> KalmanGain:
    if gain is None:
        raise SolverError("The Riccati equation of the filter has no stable solution: give fault_rate, or poles.")
    return gain


#: Lags in samples, and walks relative to the middle one.
TRIED_LAGS, FACTORS = (0, 1, 2, 5, 10, 25), (0.3, 1.0, 3.0)


@dataclass(frozen=True, eq=False)
class DelayCurve:
    """Fields: fault; rates: walks per sample; lags: samples; deviations ``(rates, lags)`` of the delayed error."""

    fault: str
    rates: tuple[float, ...]
    lags: tuple[int, ...]
    deviations: FloatArray

    @property
    def sentence(self) -> str:
        """What the first sample of delay is worth at the middle walk, and five of them."""
        row = self.deviations[len(self.rates) // 2]
        rate = self.rates[len(self.rates) // 2]
        at = {lag: float(value) for lag, value in zip(self.lags, row, strict=True)}
        return (
            f"{self.fault}: for a random-walk intensity of {rate:.3g} per sample one sample of delay takes the "
            "deviation from "
            f"{at[0]:.3g} to {at[1]:.3g}, five samples to {at[5]:.3g}."
        )


def delay_curve(plant: DescriptorSystem, fault: int, rate: float | None = None) -> DelayCurve | None:
    """Return the curve of a fault of a sampled plant, free of all others; ``None`` where it cannot be estimated."""
    if not plant.dt > 0.0 or not plant.nw:
        return None
    removed = [j for j in range(plant.nf) if j != fault]
    model = filter_model(plant, exosystem("step", plant.fault_names, plant.dt), removed=removed, faults=[fault])
    if not len(model.M) or decide_rank(model.M, expected=len(model.M)).rank < len(model.M):
        return None
    try:
        middle = float(default_rates(model, settling_time(plant), lag=0)[0][0]) if rate is None else rate
        rows = []
        for factor in FACTORS:
            gain = kalman_gain(model, np.array([factor * middle]), lag=max(TRIED_LAGS))
            if gain.covariance is None:
                return None
            closed = model.A - gain.K @ model.C
            rows.append(_smoothed(gain.covariance, model.C, closed, model.estimate, gain.lag))
    except ObsynthError:
        return None
    rates = tuple(factor * middle for factor in FACTORS)
    return DelayCurve(plant.fault_names[fault], rates, TRIED_LAGS, np.array(rows))


def _smoothed(
    p: FloatArray, c: FloatArray, closed: FloatArray, estimate: FloatArray, gains: Sequence[FloatArray]
) -> list[float]:
    """Return the deviation of the estimate at each of `TRIED_LAGS`."""
    known, moved, found = np.zeros_like(p), p.copy(), []
    for gain in gains[: max(TRIED_LAGS) + 1]:
        known = known + gain @ c @ moved
        moved = closed @ moved
        found.append(float(np.sqrt(max((estimate @ (p - known) @ estimate.T)[0, 0], 0.0))))
    return [found[lag] for lag in TRIED_LAGS]

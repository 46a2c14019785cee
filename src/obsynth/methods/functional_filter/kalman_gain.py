"""Kalman gains for filter models (decoupled plant with fault models), also with a fixed lag.

A decoupled plant is driven by y itself, so the same noise stands in its states and in its outputs.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from obsynth.analysis.diagnosis.decoupled import decoupled
from obsynth.errors import PreconditionError, SolverError
from obsynth.numerics.arrays import SMALLEST, FloatArray, largest_singular_value
from obsynth.numerics.matrix_equations import (
    continuous_lyapunov,
    continuous_solution,
    discrete_lyapunov,
    discrete_solution,
    riccati_solution,
)
from obsynth.numerics.ranks import RANK_TOLERANCE, rank_from
from obsynth.numerics.scaling import balanced_matrix
from obsynth.numerics.spectra import abscissa
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.faults import Exosystem

#: Noise that every state gets besides the stated one, as a share of the sensors', where the equation has no stable
#: solution without: a mode that nothing drives would never be corrected.
SHARES_OF_NOISE = (0.0, 1e-6, 1e-4, 1e-2, 1.0)

#: Noise that exact rows (equations without outputs and noise, sensors that have none beside others that have some) are
#: held to have, as a share of the sensors', by whether the plant is sampled: a continuous gain would be infinite
#: without, a sampled one need not be.
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


#: A step is to be seen to 90 % after so many time constants of the plant, but no sooner than so many samples.
STEP_TIME_CONSTANTS, LEAST_SAMPLES = 7.0, 4.0

#: Estimates of a step within this of one count as there; asked at these multiples of the time.
RATE_REACHED, ASKED_AT = 0.1, (1.0, 1.5, 2.5)


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
    form, used = decoupled(plant, removed, faults), model_states(model, faults)
    phi, cw = model.Phi[np.ix_(used, used)], model.Cw[np.ix_(list(faults), used)]
    k, count = form.order, len(phi)
    inverse = np.linalg.inv(form.E) if k else np.zeros((0, 0))
    zeros = np.zeros((count, k))
    known = np.hstack([form.Bu, form.By])
    rows = _telling_rows(np.hstack([form.C, form.G @ cw, form.M]), np.hstack([form.Du, form.H]))
    return FilterModel(
        A=np.block([[inverse @ form.A, inverse @ form.F @ cw], [zeros, phi]]),
        C=rows @ np.hstack([form.C, form.G @ cw]),
        B=np.vstack([inverse @ known, np.zeros((count, plant.nu + plant.ny))]),
        L=rows @ np.hstack([-form.Du, form.H]),
        N=np.vstack([inverse @ form.N, np.zeros((count, plant.nw))]),
        M=rows @ form.M,
        estimate=np.hstack([np.zeros((len(faults), k)), cw]),
        drive=np.vstack([np.zeros((k, count)), np.eye(count)]),
        T=np.vstack([inverse @ form.rows[:k, : plant.nx], np.zeros((count, plant.nx))]),
        T0=-rows @ form.rows[k:, : plant.nx],
        faults=tuple(faults),
        order=k,
        fault_sizes=form.fault_sizes,
        dt=plant.dt,
    )


def model_states(model: Exosystem, faults: Sequence[int]) -> list[int]:
    """Return the states of the exosystem that some faults are made of."""
    reached = np.any(model.Cw[list(faults)] != 0.0, axis=0) if len(faults) else np.zeros(model.order, dtype=bool)
    for _ in range(model.order):
        reached = reached | np.any(model.Phi[reached] != 0.0, axis=0)
    return [int(i) for i in np.flatnonzero(reached)]


def _telling_rows(unknowns: FloatArray, known: FloatArray) -> FloatArray:
    """Return combinations ``(q, p)`` of equations in ``unknowns (p, states and noise)`` and signals that are ``known
    (p, columns)``, without those in which no unknown appears: empty ones, and outputs that read nothing."""
    p = len(unknowns)
    if not unknowns.size:
        return np.zeros((0, p))
    scaled, signals = (part / np.maximum(np.max(np.abs(part), axis=0), SMALLEST) for part in (unknowns, known))
    lengths = np.linalg.norm(scaled, axis=1)
    telling = np.flatnonzero(lengths > RANK_TOLERANCE * np.linalg.norm(signals, axis=1))
    if not len(telling):
        return np.zeros((0, p))
    # At length one: an equation in which the unknowns are small says as much as any.
    basis, values, _ = np.linalg.svd(scaled[telling] / lengths[telling, None])
    rank = rank_from(values, expected=len(telling)).rank
    if rank == p:
        return np.eye(p)
    combinations = np.zeros((rank, p))
    combinations[:, telling] = np.eye(rank) if rank == len(telling) else basis[:, :rank].T / lengths[telling]
    return combinations


@dataclass(frozen=True, eq=False)
class KalmanGain:
    """A stable gain."""

    K: FloatArray  # (n, p), of the prediction
    lag: tuple[FloatArray, ...]  # (n, p) each: gain of xi(k) from the innovation at k + j
    innovation: FloatArray  # (p, p), its covariance; intensity in continuous time
    covariance: FloatArray | None = None  # (n, n), of the errors of the prediction; ``None``: of poles
    step_time_and_miss: tuple[float, float] | None = None  # by default: s, share of a step missing then
    noisier_if_faster: bool = False  # faster walks show more of a step then, with too much noise
    shares: tuple[float, float] = (0.0, 0.0)  # of noise that states and exact rows were taken to have besides


def exact_rows(model: FilterModel) -> FloatArray:
    """Return combinations ``(q, p)`` of the model's rows that no noise enters, of unit length."""
    p = model.M.shape[0]
    if not p:
        return np.zeros((0, 0))
    basis, values, _ = np.linalg.svd(model.M) if model.M.shape[1] else (np.eye(p), np.zeros(0), None)
    return np.asarray(basis[:, rank_from(values, expected=p).rank :].T)


def require_noise(model: FilterModel, plant_outputs: tuple[str, ...], noise: FloatArray) -> None:
    """Raise `PreconditionError` where a combination of outputs is free of noise, and so is all else that is measured.

    Beside others that have noise it may be: a gain for a share of theirs has no more noise than that of a filter
    without the sensor, since a sensor that is worse than this one leaves it there."""
    if noise.any():
        return
    measured = model.L[:, model.L.shape[1] - len(plant_outputs) :]
    trusted = exact_rows(model) @ measured
    if not trusted.size or float(np.max(np.abs(trusted))) <= RANK_TOLERANCE * float(np.max(np.abs(measured))):
        return
    silent = [name for name, row in zip(plant_outputs, noise, strict=True) if not row.any()]
    reason = f"no noise is stated for {', '.join(silent)}" if silent else "its noise cancels"
    raise PreconditionError(
        f"A combination of the outputs is free of noise: {reason}. A Kalman gain would be infinite there; "
        "state the noise of every sensor (sensor_noise), or give poles.",
        condition="noise of every output",
        signals=silent or plant_outputs,
    )


def kalman_gain(
    model: FilterModel,
    rates: FloatArray,
    *,
    lag: int = 0,
    decay: float = 0.0,
    insist: bool = False,
    like: KalmanGain | None = None,
) -> KalmanGain:
    """Return the gain for walks of the fault models, ``rates (model states,)``; errors decay at ``decay`` (1/s).

    A decay may make modes unstable that nothing drives: with ``insist`` they get a gain, which may be very large.
    ``like``, of other walks, is for a search: the shares of noise with which that gain was solved come first, and the
    equation is solved no better than well.
    """
    n, p = model.A.shape[0], model.C.shape[0]
    if n == 0:
        return KalmanGain(np.zeros((0, p)), (np.zeros((0, p)),) * (lag + 1), model.M @ model.M.T, np.zeros((0, 0)))
    process = model.N @ model.N.T + (model.drive * rates**2) @ model.drive.T
    measured, cross = model.M @ model.M.T, model.N @ model.M.T
    unit = max(float(np.max(np.abs(model.N[: model.order]), initial=0.0)), float(np.max(np.abs(model.M), initial=0.0)))
    states = np.diag(np.r_[np.ones(model.order), np.zeros(n - model.order)])
    exact, sampled = exact_rows(model), model.dt > 0.0
    tried = product((False, True) if sampled and insist else (False,), SHARES_OF_NOISE,
                    SHARES_OF_EXACT_ROWS[sampled] if len(exact) else (0.0,))  # fmt: skip
    first = [] if like is None else [(False, *like.shares)]
    enough = SOLVED if like is None else WELL_SOLVED
    best, least = None, MOST_MISSED
    for stable, share, trust in (*first, *tried):
        if stable and best is not None:
            break
        drive = process + (share * unit) ** 2 * states
        rows = measured + (trust * unit) ** 2 * (exact.T @ exact)
        if sampled:
            growth = float(np.exp(decay * model.dt))
            solved = _discrete(model, drive, rows, cross, lag, growth, stable=stable, enough=enough)
        else:
            solved = _continuous(model, drive, rows, cross, decay, enough=enough)
        if solved is not None and solved[1] <= least:
            best, least = replace(solved[0], shares=(share, trust)), solved[1]
        if least <= WELL_SOLVED:
            break
    if best is not None:
        return best
    raise SolverError(
        "The Riccati equation of the filter has no stable solution that double precision could find: look at the units "
        "and the noise of the sensors, or give poles."
    )


def _discrete(
    model: FilterModel,
    process: FloatArray,
    measured: FloatArray,
    cross: FloatArray,
    lag: int,
    growth: float,
    *,
    stable: bool,
    enough: float,
) -> tuple[KalmanGain, float] | None:
    equation = _Equation(growth * model.A, model.C, process, measured, growth * cross, sampled=True)
    solution = equation.solution(stable=stable, enough=enough)
    if solution is None:
        return None
    p, missed = solution
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
    model: FilterModel,
    process: FloatArray,
    measured: FloatArray,
    cross: FloatArray,
    decay: float,
    *,
    enough: float,
) -> tuple[KalmanGain, float] | None:
    a = model.A + decay * np.eye(len(model.A))
    equation = _Equation(a, model.C, process, measured, cross, sampled=False)
    solution = equation.solution(enough=enough)
    if solution is None:
        return None
    p, missed = solution
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
        # What overflows is no solution.
        with np.errstate(over="ignore", invalid="ignore"):
            moved = self.a @ p @ self.a.T - p if self.sampled else self.a @ p + p @ self.a.T
            correction = gain @ self.innovation(p) @ gain.T
            size = sum(float(np.linalg.norm(term)) for term in (moved, correction, self.process))
            size += float(np.linalg.norm(p)) if self.sampled else float(np.linalg.norm(self.a @ p))
            missed = float(np.linalg.norm(moved - correction + self.process)) / max(size, SMALLEST)
        return missed if np.isfinite(missed) else np.inf

    def solution(self, *, stable: bool = False, enough: float = SOLVED) -> tuple[FloatArray, float] | None:
        """Return the covariance and what it misses the equation by, ``enough`` where a search needs no less; ``None``
        where no stable filter came out.

        Sampled, by doubling. It begins at zero, which solves the equation where nothing drives an unstable mode: with
        ``stable`` by the stable subspace then.
        """
        solve = riccati_solution if self.sampled else continuous_solution
        coefficients = (self.a, self.c, self.process, self.measured, self.cross)
        p = solve(*coefficients)
        if stable and p is not None and not self._is_stable(p):
            p = discrete_solution(*coefficients)
        if p is None or not np.all(np.isfinite(p)):
            return None
        p = 0.5 * (p + p.T)
        missed = self.missed(p)
        for _ in range(MOST_NEWTON_STEPS):
            if missed <= enough or not np.isfinite(missed):
                break
            better = self._stepped(p)
            less = np.inf if better is None else self.missed(better)
            if better is None or not less < missed:
                break
            p, missed = better, less
        return (p, missed) if np.isfinite(missed) else None

    def _is_stable(self, p: FloatArray) -> bool:
        try:
            closed = self.a - self.gain(p) @ self.c
        except np.linalg.LinAlgError:
            return False
        return bool(np.all(np.isfinite(closed)) and abscissa(closed, 1.0) < 1.0)

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
                covariance = discrete_lyapunov(closed, driven) if self.sampled else continuous_lyapunov(closed, -driven)
            except np.linalg.LinAlgError:
                return None
        return np.asarray(0.5 * (covariance + covariance.T)) if np.all(np.isfinite(covariance)) else None


def _size(matrix: FloatArray) -> float:
    """Return the norm of a matrix in the units of its states in which it is least."""
    return largest_singular_value(balanced_matrix(matrix)[0])


def whitening(innovation: FloatArray) -> FloatArray:
    """Return W ``(p, p)`` with ``W innovation W' = I``; rows of nothing but rounding are left out of it."""
    if not innovation.size:
        return innovation
    sizes, directions = np.linalg.eigh(0.5 * (innovation + innovation.T))
    certain = sizes > RANK_TOLERANCE**2 * sizes[-1]
    return np.asarray((directions[:, certain] / np.sqrt(sizes[certain])).T)

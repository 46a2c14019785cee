"""Consistency by Monte Carlo on the plant's model: sizes of errors against covariances, whiteness of innovations.

Errors of a linear estimator do not depend on the trajectory: on the one that is zero the *prior mean* is random.  To
draw x(0) and project it onto the constraint would be inconsistent, as mu(k) of an algebraic equation depends on x(k).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cache, lru_cache
from typing import Any

import numpy as np

from obsynth.numerics.arrays import FloatArray, read_only
from obsynth.numerics.logarithmic_balance import LogBalance
from obsynth.numerics.ranks import KNOWN_SHARE, ROUNDED_BESIDE
from obsynth.observers.recursive.gain_schedule import Gains, gain_steps
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.observers.recursive.step_model import StepMatrices
from obsynth.results.checks import Check, upper_bound_check

#: Trials and steps: a wrong variance of 10 % is 20 standard deviations away.
CONSISTENCY_TRIALS = 400

CONSISTENCY_STEPS = 60

CONSISTENCY_SEED = 20130703

#: So many numbers are drawn once for all plants, two megabytes; those of larger plants go on from there.
FIRST_NUMBERS = 2**18

#: Bands are this many standard deviations of the statistic wide: a sound design fails one time in two million.
BAND_DEVIATIONS = 5.0

_SOURCE = "recomputed, Monte Carlo with a fixed seed"


def consistency(
    stated: RecursiveObserver, shipped: RecursiveObserver, steps: int, *, gains: Gains = gain_steps
) -> Iterator[Check]:
    """Yield NEES, NIS and whiteness of a shipped observer on noise as it is stated."""
    drawn = _Drawn()
    truth = stated.init()
    nq = len(truth.parameters.theta)
    x = drawn.next(truth.factor.shape[1]) @ truth.factor.T
    theta = drawn.next(nq) @ truth.parameters.spread.T
    model = stated.recursion.model
    first = model.first()
    nis, pairs = [], []
    scores: dict[int, tuple[FloatArray, FloatArray]] = {}
    before = np.zeros((CONSISTENCY_TRIALS, 0))
    count, factor = min(steps, CONSISTENCY_STEPS), truth.factor
    for position, step_gains in enumerate(gains(shipped, count)):
        k = position if first is None else position - 1
        true = model.at(k) if first is None or position else first
        data = drawn.next(true.noise.shape[1]) @ true.noise.T
        data[:, : len(true.A)] += x @ step_gains.step.A.T
        innovation = data @ step_gains.parity.T
        x = data @ step_gains.gain.T
        theta = theta @ step_gains.retain.T + data @ step_gains.learn.T if nq else theta
        if innovation.shape[1]:
            nis.append(innovation)
            shared = min(before.shape[1], innovation.shape[1])
            pairs.append(before[:, :shared] * innovation[:, :shared])
        before = innovation
        if position in (0, count // 2, count - 1):
            joint = np.hstack([x + theta @ step_gains.Upsilon.T if nq else x, theta])
            # Factorisations round relative to the whole noise: a covariance that tends to zero ends there.
            terms = state_terms(step_gains.step, data_deviations(step_gains.step, factor))
            parameters = np.linalg.norm(step_gains.spread, axis=1)
            parameters = parameters + np.abs(step_gains.learn) @ data_deviations(step_gains.step, factor)
            # Of states and parameters together: its square is their covariance after the step.
            top = np.hstack([step_gains.factor, step_gains.Upsilon @ step_gains.spread])
            root = np.vstack(
                [top, np.hstack([np.zeros((len(step_gains.spread), step_gains.factor.shape[1])), step_gains.spread])]
            )
            terms = np.concatenate([terms + np.abs(step_gains.Upsilon) @ parameters, parameters])
            scores[k + 1] = normalised(joint, root, terms)
        factor = step_gains.factor
    yield from _error_rows(scores)
    squares = np.concatenate([np.zeros(0), *(block.ravel() for block in nis)]) ** 2
    if squares.size:
        yield _band("NIS", "squared whitened innovations per degree of freedom are one", squares)
        products = np.concatenate([block.ravel() for block in pairs])
        if products.size:
            yield _estimated(
                "whiteness",
                "mean product of innovations of successive samples: they are uncorrelated",
                float(products.mean()),
                0.0,
                BAND_DEVIATIONS / float(np.sqrt(products.size)),
                f"{products.size} products",
            )


class _Drawn:
    """Standard normal numbers from the fixed seed, in the order in which they are asked for."""

    def __init__(self) -> None:
        self.unused, state = _first_numbers()
        self.further = np.random.default_rng(CONSISTENCY_SEED)
        self.further.bit_generator.state = state

    def next(self, columns: int) -> FloatArray:
        """Return the next numbers, ``(trials, columns)``."""
        count = CONSISTENCY_TRIALS * columns
        taken, self.unused = self.unused[:count], self.unused[count:]
        if len(taken) < count:
            taken = np.concatenate([taken, self.further.standard_normal(count - len(taken))])
        return taken.reshape(CONSISTENCY_TRIALS, columns)


@cache
def _first_numbers() -> tuple[FloatArray, Mapping[str, Any]]:
    """Return the first numbers from the seed, which are the same for every plant, and the generator's state then."""
    generator = np.random.default_rng(CONSISTENCY_SEED)
    return read_only(generator.standard_normal(FIRST_NUMBERS)), generator.bit_generator.state


def data_deviations(step: StepMatrices, factor: FloatArray) -> FloatArray:
    """Return the standard deviations of the data of one step, ``(rows,)``; ``factor (nx, any)``."""
    deviations = np.linalg.norm(step.noise, axis=1)
    deviations[: len(step.A)] = np.hypot(deviations[: len(step.A)], np.linalg.norm(step.A @ factor, axis=1))
    return np.asarray(deviations)


def state_terms(step: StepMatrices, sizes: FloatArray) -> FloatArray:
    """Return how large the terms are that make up the state after a step, for data of these sizes."""
    inverse, state_units = _scaled_inverse(step.H.shape, step.H.tobytes())
    terms = (np.abs(inverse) @ sizes).T / state_units
    return np.asarray(((terms + ROUNDED_BESIDE * np.max(terms, axis=-1, keepdims=True)) * state_units).T)


@lru_cache(maxsize=2)
def _scaled_inverse(shape: tuple[int, int], entries: bytes) -> tuple[FloatArray, FloatArray]:
    """Return a pseudoinverse of ``H (rows, n)``, and the units of the states ``(n,)`` in which it was taken.

    Where H stays the same it is needed once for all samples."""
    H = np.frombuffer(entries).reshape(shape)
    rows, columns = shape
    problem = LogBalance(rows + columns)
    problem.add(H, range(rows), range(rows, rows + columns))
    # In the units given a part of it may be less than what a pseudoinverse takes for zero.
    units = np.exp2(np.round(problem.solve()))
    row_units, state_units = units[:rows], units[rows:]
    return state_units[:, None] * np.linalg.pinv(row_units[:, None] * H * state_units) * row_units, state_units


def normalised(errors: FloatArray, root: FloatArray, terms: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return ``errors (trials, n)`` in units of their covariance ``root root'``, of the rank beside ``terms (n,)``, and
    those that are claimed to be zero in units of the terms."""
    sizes = np.where(terms > 0.0, terms, 1.0)
    basis, values, _ = np.linalg.svd(root / sizes[:, None])
    turned = (errors / sizes) @ basis
    certain = np.flatnonzero(values > KNOWN_SHARE)
    return np.asarray(turned[:, certain] / values[certain]), np.delete(turned, certain, axis=1)


def _error_rows(scores: Mapping[int, tuple[FloatArray, FloatArray]]) -> Iterator[Check]:
    """Yield NEES at its worst sample, and the errors in directions without covariance."""
    # Errors at different samples are correlated, fully so without process noise: each has a band of its own.
    rows = [
        _band("NEES", "squared errors per degree of freedom are one", errors**2, f" at k = {k}")
        for k, (errors, _) in scores.items()
        if errors.size
    ]
    if rows:
        yield min(rows, key=lambda row: row.margin / (row.bound - 1.0) * np.sign(row.bound - 1.0))
    exact = [float(np.max(np.abs(known))) for _, known in scores.values() if known.size]
    if exact:
        yield upper_bound_check(
            "known directions",
            "where the covariance is zero, so is the error (in units of what it is made of)",
            float(np.max(exact)),
            BAND_DEVIATIONS * KNOWN_SHARE,
            source=_SOURCE,
            detail=f"{CONSISTENCY_TRIALS} trials",
        )


def _band(name: str, claim: str, squares: FloatArray, where: str = "") -> Check:
    """Return the row that the mean of squares of independent standard normal numbers is one."""
    width = BAND_DEVIATIONS * float(np.sqrt(2.0 / squares.size))
    return _estimated(name, claim, float(squares.mean()), 1.0, width, f"mean of {squares.size}{where}")


def _estimated(name: str, claim: str, mean: float, expected: float, width: float, detail: str) -> Check:
    """Return the row that a mean is within so much of what is expected."""
    low, high = expected - width, expected + width
    return Check(
        name=name,
        claim=claim,
        value=mean,
        bound=high if mean >= expected else low,
        margin=width - abs(mean - expected),
        passed=bool(low <= mean <= high),
        source=_SOURCE,
        kind="computed",
        detail=f"{detail}; chance alone keeps it within {low:.4g} to {high:.4g}, but one time in two million",
        status="estimated",
        interval=(low, high),
    )

"""Monte Carlo on the plant's own model: are the errors as large as the covariances say, and the innovations white?

The errors of a linear estimator do not depend on the trajectory.  We take the one that is zero, on which noise enters
as data and the *prior mean* is what is random: this is the consistent simulation of a descriptor plant, in which mu(k)
of an algebraic equation and x(k) are not independent (to draw x(0) and project it onto the constraint is inconsistent).
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.observers.gain_schedule import gain_steps
from obsynth.observers.recursive import RecursiveObserver
from obsynth.observers.recursive_running import RunningRecursiveObserver
from obsynth.observers.step_model import EarlySteps
from obsynth.results.report import Check, upper_bound_check

#: Trials and steps: a wrong variance of 10 % is 20 standard deviations away.
TRIALS = 400
STEPS = 60
SEED = 20130703
#: Bands are this many standard deviations of the statistic wide: a sound design fails one time in two million.
BAND = 5.0
#: Directions of a covariance below this share of its largest are exactly known and have no normalised error.
KNOWN_SHARE = 1e-9

_SOURCE = "recomputed, Monte Carlo with a fixed seed"


def consistency(stated: RecursiveObserver, shipped: RecursiveObserver, steps: int) -> Iterator[Check]:
    """Yield NEES, NIS and whiteness of a shipped observer on noise as it is stated.

    Parameters
    ----------
    stated : RecursiveObserver
        Built from plant and options: it makes the noise.
    shipped : RecursiveObserver
        Which is run.
    steps : int
        How many the model has; the first `STEPS` of them are run.
    """
    rng = np.random.default_rng(SEED)
    truth = RunningRecursiveObserver(stated)
    nq = len(truth.parameters.theta)
    x = rng.standard_normal((TRIALS, truth.factor.shape[1])) @ truth.factor.T
    theta = rng.standard_normal((TRIALS, nq)) @ truth.parameters.spread.T
    model, early = truth.model, isinstance(truth.model, EarlySteps)
    nis, pairs, scores = [], [], []
    before = np.zeros((TRIALS, 0))
    count = min(steps, STEPS)
    for position, gains in enumerate(gain_steps(shipped, count)):
        k = position - 1 if early else position
        true = model.first() if isinstance(model, EarlySteps) and position == 0 else model.at(k)
        noise = rng.standard_normal((TRIALS, true.noise.shape[1])) @ true.noise.T
        known = np.zeros_like(noise)
        known[:, : len(true.A)] = x @ gains.step.A.T
        data = known + noise
        innovation = data @ gains.parity.T
        x, theta = data @ gains.gain.T, theta @ gains.forget.T + data @ gains.learn.T
        if innovation.shape[1]:
            nis.append(innovation)
            shared = min(before.shape[1], innovation.shape[1])
            pairs.append(before[:, :shared] * innovation[:, :shared])
        before = innovation
        joint = np.hstack([x + theta @ gains.Upsilon.T if nq else x, theta])
        root = np.block(
            [[gains.factor, gains.Upsilon @ gains.spread], [np.zeros((nq, gains.factor.shape[1])), gains.spread]]
        )
        if position in (count // 2, count - 1):
            scores.append(normalised(joint, root))
    yield _band("NEES", "squared errors per degree of freedom are one", np.concatenate(scores, axis=1) ** 2)
    if nis:
        squares = np.concatenate([found.ravel() for found in nis]) ** 2
        yield _band("NIS", "squared whitened innovations per degree of freedom are one", squares)
        products = np.concatenate([found.ravel() for found in pairs])
        if products.size:
            yield upper_bound_check(
                "whiteness", "innovations of successive samples are uncorrelated", abs(float(products.mean())),
                BAND / np.sqrt(products.size), source=_SOURCE, detail=f"{products.size} products",
            )  # fmt: skip


def normalised(errors: FloatArray, root: FloatArray) -> FloatArray:
    """Return errors in units of their covariance ``root root'``, in the directions in which it is not zero.

    Parameters
    ----------
    errors : FloatArray
        ``(trials, n)``.
    root : FloatArray
        ``(n, any)``.
    """
    sizes = np.linalg.norm(root, axis=1)
    sizes[sizes == 0.0] = 1.0
    left, values, _ = np.linalg.svd(root / sizes[:, None], full_matrices=False)
    kept = values > KNOWN_SHARE * values[0] if values.size else values > 0.0
    return np.asarray((errors / sizes) @ left[:, kept] / values[kept])


def _band(name: str, claim: str, squares: FloatArray) -> Check:
    """Return the row that the mean of squares of standard normal numbers is one."""
    gap = abs(float(squares.mean()) - 1.0)
    bound = BAND * float(np.sqrt(2.0 / squares.size))
    return upper_bound_check(
        name, claim, gap, bound, source=_SOURCE, detail=f"mean {squares.mean():.4f} of {squares.size}"
    )

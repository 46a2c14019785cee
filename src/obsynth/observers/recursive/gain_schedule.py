"""The gains of a recursive observer step by step, computed before any data."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from functools import lru_cache
from itertools import chain, islice
from sys import maxsize
from threading import Lock
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.square_root_estimation import least_squares_step, rank_revealing_step, update
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.observers.recursive.recursion import posterior_residual
from obsynth.observers.recursive.step_model import PreparedStep, StepMatrices, rounding_of, spreads

#: Steps of the recursion before it is held to settle nowhere.
MOST_SETTLING_STEPS = 20_000

#: Numbers of gains that are kept for a second look, of twenty megabytes.
MOST_KEPT_GAINS = 2**21

#: Gains of the last observers are kept: one whose parameters walk at random is looked at without its walk as well.
OBSERVERS_KEPT = 2


class GainStep(NamedTuple):
    """The gains of one step; data are the rows ``[A x + B u; outputs]``."""

    step: StepMatrices  # of the model as it is run
    gain: FloatArray  # ``[L K] (nx, rows)`` of (11)
    parity: FloatArray  # ``(m, rows)``: from data to the whitened innovation
    G: FloatArray  # ``(m, nq)``: its regressor
    Upsilon: FloatArray  # ``(nx, nq)``, after the step
    factor: FloatArray  # ``(nx, nx)``: square root of the covariance of the state, the parameters being known
    learn: FloatArray  # ``(nq, rows)``: from data to the correction of the parameters
    retain: FloatArray  # ``(nq, nq)``: ``theta^+ = retain theta + learn data``
    spread: FloatArray  # ``(nq, nq)``: square root of the covariance of the parameters


#: From the gains of a step to the factor and Upsilon to go on from, or ``None``.
Correction: TypeAlias = Callable[[int, GainStep], tuple[FloatArray, FloatArray] | None]

#: Gains of the steps of an observer: `gain_steps`, or what remembers them.
Gains: TypeAlias = Callable[[RecursiveObserver, int], Iterable[GainStep]]


def gain_steps(
    observer: RecursiveObserver,
    steps: int,
    *,
    received: NDArray[np.bool_] | None = None,
    corrected: Correction | None = None,
) -> Iterator[GainStep]:
    """Yield the gains of the first steps (``received (samples, ny)``); ``corrected`` may change what comes after."""
    recursion = observer.recursion
    start = recursion.first
    factor, Upsilon, parameters, diffuse = start.factor, start.Upsilon, start.parameters, start.diffuse
    rounding, adaptation, model = start.rounding, observer.adaptation, recursion.model
    first = [step for step in (model.first(),) if step is not None]
    prepared: PreparedStep | None = None
    untaught: dict[int, tuple[FloatArray, FloatArray]] = {}  # by rows: parameters that learn nothing from them
    for k, step in enumerate(chain(first, (model.at(k) for k in range(steps))), 1 - len(first)):
        ne, rows, nq = len(step.A), len(step.H), Upsilon.shape[1]
        # Of data alone it is the identity, which a prepared step knows.
        right = np.hstack([np.eye(rows), np.vstack([step.A @ Upsilon + step.Phi, -step.Psi])]) if nq else None
        complete = received is None or not k or bool(received[k].all())
        solved = None
        if complete and not diffuse.shape[1] and not rounding.shape[1]:
            prepared = PreparedStep.of(step, prepared)
            solved = prepared.taken(factor, right)
        # The literal form asks for the noise itself.
        if solved is None or recursion.literal:
            S, unknown = spreads(step, factor, diffuse, k, observer.state_names)
            errors = rounding_of(step, rounding)
            H, right = step.H, np.eye(rows) if right is None else right
            if not complete and received is not None:
                rows_received = np.concatenate(
                    [np.ones(ne, dtype=bool), received[k], np.ones(len(step.Dn), dtype=bool)]
                )
                H, S, right, unknown = H[rows_received], S[rows_received], right[rows_received], unknown[rows_received]
                errors = errors.of(rows_received)
            if solved is None and not unknown.shape[1] and not complete and not errors.is_followed:
                solved = least_squares_step(H, S, right)
            solved = solved or rank_revealing_step(H, S, right, unknown, mapped=rows, rounding=errors)
        diffuse, rounding = solved.diffuse, solved.rounding if len(solved.rounding) else rounding
        gain, Upsilon, factor = solved.estimate[:, :rows], solved.estimate[:, rows:], solved.factor
        parity, G = solved.innovation[:, :rows], -solved.innovation[:, rows:]
        if rows not in untaught:
            untaught[rows] = np.zeros((nq, rows)), np.eye(nq)
        learn, retain = untaught[rows]
        if adaptation is not None and nq:
            innovation_map, regressor, noise = parity, G, None
            if recursion.literal and right is not None and len(H) > ne:
                innovation_map, regressor, noise = posterior_residual(
                    solved, H, S, right, ne, unknown=unknown, columns=rows
                )
            parameters, theta_gain = update(
                parameters,
                np.zeros(len(regressor)),
                regressor,
                forgetting=adaptation.forgetting,
                regular=recursion.regular,
                directional=recursion.directional,
                noise=noise,
            )
            learn, retain = theta_gain @ innovation_map, np.eye(nq) - theta_gain @ regressor
        taken = GainStep(step, gain, parity, G, Upsilon, factor, learn, retain, parameters.spread)
        yield taken
        if corrected is not None and not diffuse.shape[1] and not rounding.shape[1]:
            factor, Upsilon = corrected(k, taken) or (factor, Upsilon)


def shared_gains(observer: RecursiveObserver, steps: int) -> Iterable[GainStep]:
    """Yield the same as `gain_steps`, which all who look at the same observer share if they are few numbers.

    They follow from the observer alone, which never changes: synthesis and verification look at the same ones."""
    plant = observer.plant
    if steps * (plant.nx + plant.nq) * (plant.ne + plant.ny) > MOST_KEPT_GAINS:
        yield from gain_steps(observer, steps)
        return
    computed = _computed_gains(observer)
    known = computed.steps
    for position in range(steps + int(observer.early_constraints)):
        yield known[position] if position < len(known) else computed.at(position)


@lru_cache(maxsize=OBSERVERS_KEPT)
def _computed_gains(observer: RecursiveObserver) -> _ComputedGains:
    return _ComputedGains(observer)


class _ComputedGains:
    """The gains of an observer, computed up to the last step that was asked for, and kept."""

    def __init__(self, observer: RecursiveObserver) -> None:
        self.steps: list[GainStep] = []
        self._observer, self._lock = observer, Lock()
        self._further: Iterator[GainStep] = iter(())

    def at(self, position: int) -> GainStep:
        """Return the gains of a step, of which the one before was looked at."""
        with self._lock:
            if position == len(self.steps):
                step = next(self._further, None)
                if step is None:  # at the start, and after an error
                    self._further = islice(gain_steps(self._observer, maxsize), position, None)
                    step = next(self._further)
                self.steps.append(step)
            return self.steps[position]

"""Numbers about a recursive observer that do not depend on data: contraction of the errors, excitation, last gains."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from obsynth.analysis.time_varying import STEPS_WITHOUT_HORIZON
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.norms import spectral_radius
from obsynth.numerics.ranks import BOUNDARY_TOLERANCE
from obsynth.observers.recursive.estimates import excitation_levels
from obsynth.observers.recursive.gain_schedule import GainStep, gain_steps
from obsynth.observers.recursive.observer import RecursiveObserver

#: Errors that shrank below this are gone; the product starts anew from there, so that it does not underflow.
UNDERFLOW = 1e-200
#: On shorter horizons an error need not have shrunk yet, so that the contraction only informs.
STEPS_TO_CONTRACT = 50


@dataclass(frozen=True, eq=False)
class GainScheduleSummary:
    """What the gains along the horizon say.

    Fields: steps: How many steps were looked at; contraction: ``norm(product of L_k A_k)^(1 / steps)``: the mean factor
    by which an error shrinks in a step; where that is not below one, over the second half of the horizon; growth: The
    largest norm of the product on the way: how much an error may grow before it dies out; span: What the contraction
    was taken over; survivors: ``(nx,)``: size of the product in each state after the last step, relative to its
    largest: where errors last; excitation: The least eigenvalue of the information on the parameters in any window,
    (26); NaN without parameters; excitation_k: The sample that ends that window; L, K: The gains (11) of the last step;
    deviations: ``(nq,)``: standard deviations of the parameters after the last step; state_deviations: ``(nx,)``:
    standard deviations of the states after the last step, the parameters being known.
    """

    steps: int
    contraction: float
    growth: float
    span: str
    survivors: FloatArray
    excitation: float
    excitation_k: int
    L: FloatArray
    K: FloatArray
    deviations: FloatArray
    state_deviations: FloatArray


class Contraction(NamedTuple):
    """How the product of L_k A_k goes along a horizon; the fields are those of `GainScheduleSummary`."""

    mean: float
    growth: float
    span: str
    survivors: FloatArray


def looked_at(observer: RecursiveObserver) -> int:
    """Return how many steps of an observer's model are looked at."""
    steps = observer.plant.horizon or STEPS_WITHOUT_HORIZON
    return max(steps - 1, 1) if observer.early_constraints else steps


def gain_schedule_summary(observer: RecursiveObserver) -> GainScheduleSummary:
    """Return what the gains along the horizon say."""
    steps = looked_at(observer)
    learning = observer.adaptation is not None
    random_walk = observer.adaptation is not None and observer.adaptation.form == "random-walk"
    # Of a walk, the state filter and the regressors are those of the model without the walk.
    plain = observer
    if observer.adaptation is not None and random_walk:
        plain = replace(observer, adaptation=replace(observer.adaptation, form="innovation", forgetting=1.0))
    schedule = list(gain_steps(plain, steps))
    last = schedule[-1]
    ne = len(last.step.A)
    errors = _contraction(schedule, observer.plant.nx)
    window = observer.adaptation.window if observer.adaptation is not None else 1
    levels = excitation_levels([found.G for found in schedule], window)[window - 1 :]
    deviations, state_deviations = _lengths(last.spread), _lengths(last.factor)
    if random_walk:
        *_, end = gain_steps(observer, steps)
        lengths = _lengths(end.factor)
        state_deviations, deviations = lengths[: observer.plant.nx], lengths[observer.plant.nx :]
    return GainScheduleSummary(
        steps=len(schedule),
        contraction=errors.mean,
        growth=errors.growth,
        span=errors.span,
        survivors=errors.survivors,
        excitation=float(levels.min()) if learning and levels.size else float("nan"),
        excitation_k=int(levels.argmin()) + window if learning and levels.size else 0,
        L=last.gain[:, :ne],
        K=last.gain[:, ne:],
        deviations=deviations,
        state_deviations=state_deviations,
    )


def _lengths(factor: FloatArray) -> FloatArray:
    return np.asarray(np.sqrt(np.einsum("ij,ij->i", factor, factor)))


def _contraction(schedule: Sequence[GainStep], nx: int) -> Contraction:
    product, logarithm, growth, steps = np.eye(nx), 0.0, 1.0, len(schedule)
    late, late_logarithm, middle = np.eye(nx), 0.0, 0.0
    for k, found in enumerate(schedule, 1):
        factor = found.gain[:, : len(found.step.A)] @ found.step.A
        product = factor @ product
        size = float(np.linalg.norm(product, 2))
        growth = max(growth, size * float(np.exp(min(logarithm, 0.0))))
        if not size < 1.0 / UNDERFLOW:
            return Contraction(float("inf"), float("inf"), "from the start", _shares(product))
        if size == 0.0:
            return Contraction(0.0, growth, "from the start", _shares(product))
        if size < UNDERFLOW:
            product, logarithm = product / size, logarithm + float(np.log(size))
        if k == steps // 2:
            middle = logarithm + float(np.log(np.linalg.norm(product, 2)))
        elif k > steps // 2:
            late = factor @ late
            late_size = float(np.linalg.norm(late, 2))
            late, late_logarithm = late / late_size, late_logarithm + float(np.log(late_size))
    last = logarithm + float(np.log(np.linalg.norm(product, 2)))
    whole = float(np.exp(last / steps))
    # In units far apart, or where errors grow before they shrink, a slow mode may take longer than the horizon to make
    # an error smaller than it was: then errors must shrink over the second half, as a whole and along every mode.
    radius = spectral_radius(late)
    slowest = max(last - middle, late_logarithm + float(np.log(radius)) if radius else -np.inf)
    second = float(np.exp(slowest / (steps - steps // 2)))
    if whole >= 1.0 and second < 1.0 - BOUNDARY_TOLERANCE:
        return Contraction(second, growth, "over the second half", _shares(product))
    return Contraction(whole, growth, "from the start", _shares(product))


def _shares(product: FloatArray) -> FloatArray:
    sizes = np.max(np.abs(product), axis=1)
    return np.asarray(sizes / max(float(sizes.max()), np.finfo(np.float64).tiny))

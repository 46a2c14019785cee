"""The likelihood's maximum with everything that is read off it: boxes, directions, limits of variances, timing."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from obsynth.monitoring.calibration.intervals import (
    Information,
    Side,
    information,
    profile_box,
    quadratic_box,
    quantile,
    upper_limit,
)
from obsynth.monitoring.calibration.likelihood import IMPOSSIBLE
from obsynth.monitoring.calibration.maximum import (
    Maximum,
    Objective,
    at_bounds,
    avoided_variances,
    collapsed,
    greatest_likelihood,
    without_collapse,
)
from obsynth.monitoring.calibration.noise_states import PlantWithNoise
from obsynth.monitoring.calibration.problem import CalibrationProblem
from obsynth.monitoring.calibration.simulation_error import UNKNOWN_START, BoolArray, Fit, simulation_fits
from obsynth.numerics.arrays import FloatArray
from obsynth.plants.noise import DEFAULT_WHITE_SHARE

#: Nats by which another timing of the inputs must be better to be taken: a likelihood ratio of about 150.
TIMING_NATS = 5.0

#: The same for another row of delay beyond the first: what a slow actuator does looks like some rows of delay too.
FURTHER_NATS = 25.0

#: A likeliest variance below this share of its upper limit counts as zero.
ZERO_SHARE = 0.01

#: Rows by which the inputs are tried later, of which only positive ones are ever taken; more are tried while the last
#: one is the best, up to so many.
TRIED_DELAYS, MOST_DELAY = (-1, 1, 2, 3), 50

#: Share of its deviation by which a constant may move if the steps were exact.
TOLERATED_MOVE = 0.5

#: A logarithm of a variance with less curvature is known to no more than a factor of three or so.
WEAK_CURVATURE = 1.0


@dataclass(frozen=True, eq=False)
class InnovationsFit:
    """Constants ``(nt,)``, their information and box, variances by equation and sensor, and what the filter said: no
    innovation (NaN) where nothing was measured."""

    t: FloatArray
    value: float
    information: Information
    #: What computes the sides of the box: those of a fit that only leads to another one nobody reads.
    box: Callable[[], list[tuple[Side, Side]]]
    Q: FloatArray
    R: FloatArray
    limited_Q: BoolArray
    limited_R: BoolArray
    at_bounds: BoolArray
    #: As ``v``, of the variances that are kept away from zero; NaN for all others.
    avoided: FloatArray
    whitened: FloatArray
    innovations: FloatArray
    variances: FloatArray
    #: The state after the last row, and its deviations, to which those of the constants are added; `None` where no
    #: offset of a sensor is asked of it, or there is no filter.
    at_end: tuple[FloatArray, FloatArray] | None = None

    @cached_property
    def sides(self) -> list[tuple[Side, Side]]:
        """The box: the low and the high side of each constant."""
        return self.box()

    @property
    def v(self) -> FloatArray:
        """What the likelihood takes: ``[t, log q, log r]``."""
        return np.concatenate([self.t, np.log(np.concatenate([self.Q, self.R]))])


def chosen_timing(
    problem: CalibrationProblem, fits: list[Fit], seed: int, note: Callable[[str], object], *, any_start: bool = False
) -> tuple[CalibrationProblem, list[Fit], Mapping[int, float]]:
    """Return the problem with the inputs as the likelihood wants them, and what each delay loses in nats; a start that
    nobody stated must not decide."""
    compared = problem.with_start(UNKNOWN_START**2 * problem.P0) if any_start else problem
    objective = Objective(compared, fits[0])
    value, z = objective.descent(objective.start(fits[0].t))
    values, waiting, start = {0: value}, [*TRIED_DELAYS], z
    while waiting:
        delay = waiting.pop(0)
        if delay >= problem.log.samples:
            break
        note(f"inputs {delay:+d} row{'s' if abs(delay) > 1 else ''}")
        moved = Objective(compared.with_log(problem.log.shifted(delay)), fits[0])
        loss, at = moved.descent(z if abs(delay) == 1 else start)
        if loss < min(values.values()):
            # What a timing that is far off makes of the constants is a bad start for the next one.
            start = at
            waiting += [delay + 1] if not waiting and delay < MOST_DELAY else []
        values[delay] = loss
    best = min(values.values())
    # The least delay that none beats clearly; a log whose inputs would act before they are sent is only told.
    nats = {rows: FURTHER_NATS if rows else TIMING_NATS for rows in values if rows >= 0}
    delay = min((rows for rows, clear in nats.items() if values[rows] - best <= clear), default=0)
    if values[delay] > values.get(-1, np.inf):
        delay = 0
    losses = {rows: loss - best for rows, loss in sorted(values.items())}
    if delay:
        problem = problem.with_log(problem.log.shifted(delay))
        fits = simulation_fits(problem, 1, seed, note, start=fits[0].t)
    return problem, fits, losses


def _information_of_constants(objective: Objective, maximum: Maximum) -> Information:
    """Return what the log says of the constants; a variance with hardly a curvature leaves none of them open."""
    knowledge = information(maximum.hessian, objective, maximum.z)
    weak = (objective.is_q | objective.is_r) & (np.diag(maximum.hessian) < WEAK_CURVATURE)
    if knowledge.undetermined and weak.any():
        without_weak = information(maximum.hessian, objective, maximum.z, apart=weak)
        return without_weak if len(without_weak.undetermined) < len(knowledge.undetermined) else knowledge
    return knowledge


def guarded_maximum(
    objective: Objective, fits: list[Fit], note: Callable[[str], object], known: InnovationsFit | None = None
) -> tuple[Maximum, Information]:
    """Return the greatest likelihood, with variances that the log cannot distinguish from zero kept away from it."""
    maximum = greatest_likelihood(objective, fits, note, None if known is None else known.v)
    knowledge = _information_of_constants(objective, maximum)
    if not knowledge.undetermined:
        # Along a direction that the log leaves open the weight of a variance would only lead the constants away.
        maximum = without_collapse(objective, maximum, note, None if known is None else known.avoided)
        knowledge = _information_of_constants(objective, maximum)
    return maximum, knowledge


def moved_by(
    exact: CalibrationProblem, start: Fit, maximum: Maximum, avoided: FloatArray, knowledge: Information
) -> float:
    """Return by how much constants move with exact steps: the most, in their deviations."""
    objective = Objective(exact, start)
    objective.avoided[:] = avoided
    value, z = objective.descent(maximum.z)
    if value >= IMPOSSIBLE:
        return 0.0
    moves = np.abs(objective.constants(z) - objective.constants(maximum.z))[: len(exact.names)]
    return float(np.max(moves / np.sqrt(np.diag(knowledge.covariance)), initial=0.0))


def innovations_fit(
    problem: CalibrationProblem,
    fits: list[Fit],
    level: float,
    note: Callable[[str], object],
    *,
    exact: CalibrationProblem | None = None,
    known: InnovationsFit | None = None,
) -> tuple[InnovationsFit | None, float]:
    """Return the fit of the innovations, from fits of the simulation, or near what is ``known`` of it from fewer rows.
    With an ``exact`` problem also by how much its
    constants would move; there is no fit where that matters."""
    objective = Objective(problem, fits[0])
    maximum, knowledge = guarded_maximum(objective, fits, note, known)
    moved = 0.0 if exact is None else moved_by(exact, fits[0], maximum, objective.avoided, knowledge)
    if moved > TOLERATED_MOVE:
        return None, moved

    def box() -> list[tuple[Side, Side]]:
        note("boxes by profile likelihood")
        near = None if known is None else known.sides
        return profile_box(objective, maximum, _root(objective, level), knowledge, near)

    # Variances are kept from zero for the sake of the boxes; where the log tells them from it, it says them itself.
    Q, R = objective.noise(maximum.likeliest)
    limited, limits = _limits(objective, maximum)
    Q, R = np.where(limited[: len(Q)], limits[: len(Q)], Q), np.where(limited[len(Q) :], limits[len(Q) :], R)
    whitened, e, spread = objective.likelihood.innovations(objective.full(maximum.z))
    coloured = [len(Q) + j in _beside(problem) for j in range(len(R))]
    R = np.where(coloured, np.maximum(R, DEFAULT_WHITE_SHARE**2 * np.nanmean(e**2, axis=0)), R)
    bounds = at_bounds(maximum.z, objective.low, objective.high)[: objective.nt]
    has_offsets = isinstance(problem.plant, PlantWithNoise) and bool(problem.plant.states.offsets)
    return InnovationsFit(
        t=objective.constants(maximum.z),
        value=objective.likelihood(objective.full(maximum.z))[0],
        information=knowledge,
        box=box,
        Q=Q,
        R=R,
        limited_Q=limited[: len(Q)],
        limited_R=limited[len(Q) :],
        at_bounds=bounds,
        avoided=avoided_variances(objective, maximum.z),
        whitened=whitened,
        innovations=e,
        variances=spread,
        at_end=_at_end(objective, maximum, knowledge) if has_offsets else None,
    ), moved


def box_beside(
    problem: CalibrationProblem,
    fits: list[Fit],
    level: float,
    note: Callable[[str], object],
    known: InnovationsFit | None,
) -> list[tuple[Side, Side]]:
    """Return the box alone of a model with more states: by profile likelihood, or by deviations near what is
    ``known``."""
    objective = Objective(problem, fits[0])
    maximum, knowledge = guarded_maximum(objective, fits, note, known)
    root = _root(objective, level)
    if known is None:
        return profile_box(objective, maximum, root, knowledge)
    return quadratic_box(objective, maximum, root, knowledge)


def _root(objective: Objective, level: float) -> float:
    """Return the root of the deviance at the ends of a box."""
    problem, variances = objective.problem, int((objective.is_q | objective.is_r).sum())
    return quantile(level, len(problem.names), problem.log.samples, variances)


def _at_end(objective: Objective, maximum: Maximum, knowledge: Information) -> tuple[FloatArray, FloatArray]:
    """Return the state after the last row, and its deviations: of the filter, and by those of the constants."""
    v, deviations = objective.full(maximum.z), np.sqrt(np.diag(knowledge.covariance))
    x, P = objective.likelihood.at_end(v)
    moved = np.zeros((len(x), len(deviations)))
    for i, deviation in enumerate(deviations.tolist()):
        near = v.copy()
        near[i] += deviation
        change = objective.likelihood.at_end(near)[0] - x
        # Where the plant has no solution a constant is not so far off.
        moved[:, i] = change / deviation if np.isfinite(change).all() else 0.0
    return x, np.sqrt(np.diag(P) + np.einsum("ij,jk,ik->i", moved, knowledge.covariance, moved))


def _beside(problem: CalibrationProblem) -> list[int]:
    """Return places of variances, of equations and then of sensors, that stand beside a plant's own."""
    if not isinstance(problem.plant, PlantWithNoise):
        return []
    equations = [i for i, name in enumerate(problem.noisy) if name in problem.plant.added]
    coloured = problem.plant.states.correlations
    return equations + [len(problem.noisy) + j for j, name in enumerate(problem.output_names) if name in coloured]


def _limits(objective: Objective, maximum: Maximum) -> tuple[BoolArray, FloatArray]:
    """Return which variances, of equations and then of sensors, are told by an upper limit, and the limits."""
    free = np.flatnonzero(objective.is_q | objective.is_r)
    places = np.flatnonzero(objective.free[objective.nt :])
    limited = np.zeros(len(objective.free) - objective.nt, dtype=bool)
    limits = np.zeros(len(limited))
    weak = (objective.avoided > 0.0) | collapsed(objective, maximum)
    # Where coloured noise and walks are of no size there are none, and white noise beside coloured noise needs none.
    beside = _beside(objective.problem)
    for i, place in zip(free, places, strict=True):
        if weak[i] and place not in beside:
            limit = upper_limit(objective, maximum, int(i))
            limited[place] = maximum.likeliest[i] - limit < np.log(ZERO_SHARE)
            limits[place] = np.exp(limit)
    return limited, limits

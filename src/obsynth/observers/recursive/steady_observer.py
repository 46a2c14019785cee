"""The steady state of a recursive observer: its gains once they have settled, as a constant realisation."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from obsynth.errors import PreconditionError, SolverError, SpecError
from obsynth.numerics.arrays import FloatArray, read_only
from obsynth.numerics.ranks import covariance_factor, product_but_rounding
from obsynth.numerics.spectra import abscissa
from obsynth.observers.linear.observer import LinearObserver
from obsynth.observers.recursive.gain_schedule import MOST_SETTLING_STEPS, GainStep, gain_steps
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.observers.recursive.steady_filter import is_uncertain_at_first, reached_condition
from obsynth.observers.sensor_timing import require_plain

#: The gains have settled when what is left of their way is below this share of them.
SETTLED_GAINS = 1e-13

#: Gains that move by less than these roundings do not move.
UNMOVED_GAINS = 4.0 * np.finfo(np.float64).eps

#: Steps in a row that must have settled: at a turning point gains stand still, too.
STILL_STEPS = 5

#: Gains that are where they were so many steps before have settled, although their last digits go to and fro.
STILL_FOR_LONG = 256


#: Digits that go to and fro by rounding move over that time by at most so many times what they move in a step, and less
#: than that share: states in units that differ by 1e6 left 1e-11.
DRIFT, ROUNDED_GAINS = 2.0, 1e-8

#: After so many steps the recursion goes on from where these gains would lead if they stayed: Newton's method for its
#: limit, so many times, as slow plants take thousands of steps. Each doubles the digits; what needs more has no limit.
STEPS_BETWEEN_LEAPS, MOST_LEAPS = 32, 16

#: Constant gains are followed for two to this power of steps at most: slower ones have no limit to leap to.
MOST_DOUBLINGS = 30


class SteadyObserver(NamedTuple):
    """A recursive observer whose gains have settled."""

    # From ``[u; y]`` to states, parameters, and the whitened innovation at the parameters of one sample before.
    observer: LinearObserver
    start: FloatArray  # ``z(0)``, from the state and the parameters that the recursion starts with; read-only
    steps: int  # after how many steps the gains had settled


def steady_observer(observer: RecursiveObserver) -> SteadyObserver:
    """Return the steady state of a recursive observer: its gains once the covariances have settled."""
    require_plain(observer, "A steady filter")
    sequences = {**observer.plant.matrices, "Q": observer.Q, "R": observer.R}
    moving = [name for name, sequence in sequences.items() if not sequence.is_constant]
    if moving:
        raise SpecError(
            f"{', '.join(moving)} may change with k (given as more than constants), so the gains do too and there is "
            "no constant realisation to hand on: use the recursion itself, obsynth run or observer.step.",
            path="plant",
        )
    if observer.adaptation is not None and observer.adaptation.reset:
        raise SpecError(
            "This design resets its gains when the data ask for it, so there is no constant realisation to hand on: "
            "use the recursion itself (obsynth run), or design without reset.",
            path="reset",
        )
    _require_noise_that_reaches(observer)
    settled, steps = _settled(observer)
    realisation, start = _realised(observer, settled)
    radius = abscissa(realisation.Az, observer.dt)
    if not radius < 1.0:
        raise PreconditionError(
            f"The steady filter is not stable (spectral radius {radius:.6g}): a mode is neither observable nor "
            "damped, or the parameters are not excited in steady state. Run the recursion itself (obsynth run).",
            condition="stable steady filter",
        )
    return SteadyObserver(realisation, read_only(start), steps)


def _require_noise_that_reaches(observer: RecursiveObserver) -> None:
    """Raise `PreconditionError` where gains fall asleep like ``1 / k``, without following thousands of them: a mode on
    the unit circle that no noise reaches, and that is uncertain at first, as a start that is known leaves it alone."""
    walks = observer.adaptation is not None and observer.adaptation.form == "random-walk"
    if walks or observer.early_constraints or not is_uncertain_at_first(observer):
        return
    roots = covariance_factor(observer.Q.at(0), "Q"), covariance_factor(observer.R.at(0), "R")
    reached = reached_condition(observer.plant, *roots)
    if not reached.holds:
        raise PreconditionError(
            f"The gains do not settle: {reached.detail} Or run the recursion itself (obsynth run).",
            condition=reached.name,
        )


def _settled(observer: RecursiveObserver) -> tuple[GainStep, int]:
    """Return the first step whose gains have settled."""
    last: GainStep | None = None
    early: GainStep | None = None
    still, before, earlier, effect = 0, np.inf, np.inf, 0.0
    for k, gains in enumerate(gain_steps(observer, MOST_SETTLING_STEPS, corrected=_leap)):
        # The correction of the start, which comes first with early constraints, has other rows.
        if last is None or len(last.step.H) != len(gains.step.H):
            effect = _effect_of_parameters(gains)
        moved = np.inf if last is None else _moved(gains, last, effect)
        if not k % STILL_FOR_LONG:
            # What decays, even from side to side, is no rounding.
            rounded = min(DRIFT * moved, ROUNDED_GAINS) if moved >= earlier / DRIFT else 0.0
            if early is not None and _moved(gains, early, effect) <= max(SETTLED_GAINS, rounded):
                return gains, k
            early, earlier = gains, moved
        # What is left of a geometric series, from two of its terms.
        rate = min(moved / before, 1.0) if 0.0 < before < np.inf else 1.0
        remaining = moved / max(1.0 - rate, np.finfo(np.float64).eps) * rate
        quiet = moved == 0.0 or (moved <= SETTLED_GAINS and remaining <= SETTLED_GAINS) or moved <= UNMOVED_GAINS
        still, before = still + 1 if quiet else 0, moved
        if still == STILL_STEPS:
            return gains, k
        last = gains
    raise SolverError(
        f"The gains do not settle within {MOST_SETTLING_STEPS} steps: a mode is almost unobservable, or has almost no "
        "process noise. Run the recursion itself (obsynth run), or state more noise in Q.",
        record={"steps": MOST_SETTLING_STEPS},
    )


def _leap(k: int, gains: GainStep) -> tuple[FloatArray, FloatArray] | None:
    """Return the factor and Upsilon that the gains of a step would lead to if they stayed; ``None`` for no leap."""
    leap, rest = divmod(k, STEPS_BETWEEN_LEAPS)
    if rest or not 0 < leap <= MOST_LEAPS:
        return None
    step, ne = gains.step, len(gains.step.A)
    if len(step.H) != gains.gain.shape[1]:
        return None
    transition, factor = gains.gain[:, :ne] @ step.A, product_but_rounding(gains.gain, step.noise)
    radius = abscissa(transition, 1.0)
    if not radius < 1.0:
        return None
    Upsilon = gains.Upsilon
    if Upsilon.shape[1]:
        drive = gains.gain[:, :ne] @ step.Phi - gains.gain[:, ne:] @ step.Psi
        Upsilon = np.asarray(np.linalg.solve(np.eye(len(transition)) - transition, drive), dtype=np.float64)
    for _ in range(MOST_DOUBLINGS):
        further = transition @ factor
        if np.all(np.linalg.norm(further, axis=1) <= np.finfo(np.float64).eps * np.linalg.norm(factor, axis=1)):
            covariance = factor @ factor.T
            short = _distance(covariance, gains.factor @ gains.factor.T) + _distance(Upsilon, gains.Upsilon)
            # Of a slow plant a small rest takes more steps than all leaps.
            left = short * radius ** (STEPS_BETWEEN_LEAPS * MOST_LEAPS)
            return None if short <= ROUNDED_GAINS and left <= SETTLED_GAINS else (factor, Upsilon)
        factor = np.asarray(np.linalg.qr(np.hstack([factor, further]).T, mode="r")).T
        transition = transition @ transition
    return None


def _moved(now: GainStep, then: GainStep, effect: float) -> float:
    """Return the largest relative distance between two gains; infinite for those of other rows."""
    if now.gain.shape != then.gain.shape:
        return np.inf
    distances = (_distance(current, earlier) for current, earlier in zip(_parts(now), _parts(then), strict=True))
    return max(_distance(now.Upsilon, then.Upsilon, effect), *distances)


def _effect_of_parameters(gains: GainStep) -> float:
    """Return how far parameters of size one move the state in one step: sensors may cancel it down to its rounding."""
    driven = np.vstack([gains.step.Phi, gains.step.Psi])
    return float(np.abs(np.linalg.pinv(gains.step.H) @ driven).max(initial=0.0))


def _parts(gains: GainStep) -> tuple[FloatArray, ...]:
    # The sign of a direction of the innovation is free, its square is not.
    return gains.gain, gains.learn, gains.retain, gains.parity.T @ gains.parity, gains.G.T @ gains.G


def _distance(now: FloatArray, then: FloatArray, least: float = 0.0) -> float:
    size = max(float(np.abs(now).max(initial=0.0)), least)
    return float(np.abs(now - then).max(initial=0.0)) / size if size else 0.0


def _realised(observer: RecursiveObserver, gains: GainStep) -> tuple[LinearObserver, FloatArray]:
    step, plant = gains.step, observer.plant
    ne, ny, nx = len(step.A), plant.ny, plant.nx
    early, width = step.Dn, gains.gain.shape[1]
    parts = slice(0, ne), slice(ne, ne + ny), slice(ne + ny, width)
    gain, parity = [gains.gain[:, part] for part in parts], [gains.parity[:, part] for part in parts]
    learn, q = [gains.learn[:, part] for part in parts], len(gains.retain)
    random_walk = gains.gain.shape[0] - nx
    # With z(k) = A x(k-1) + B u(k-1) and the gains [L K M] of the rows [z; y - D u; Dn u] (the last with early
    # constraints): xbar = L z + K (y - D u) + M Dn u, z(k+1) = A xbar + B u, and theta = retain theta(k-1) + learn
    # [z; y - D u; Dn u] by least squares, x = xbar + Upsilon theta. States: z, then the parameters one sample before.
    state = np.hstack([gain[0], np.zeros((len(gain[0]), q))])
    theta = np.hstack([learn[0], gains.retain])
    az = np.vstack([step.A @ state, theta])
    by = np.vstack([step.A @ gain[1], learn[1]])

    def of_inputs(measured: FloatArray, constrained: FloatArray) -> FloatArray:
        """Return what the inputs do through what is subtracted from the outputs, and through early constraints."""
        return np.asarray(constrained @ early - measured @ step.D)

    bu = np.vstack([step.B + step.A @ of_inputs(gain[1], gain[2]), of_inputs(learn[1], learn[2])])
    # Rows of output: x (with Upsilon theta), theta, innovation less its regressor times theta of before.
    upsilon = gains.Upsilon[:nx]
    from_state = [state[:nx] + upsilon @ theta, np.vstack([state[nx:], theta]), np.hstack([parity[0], -gains.G])]
    from_outputs = [gain[1][:nx] + upsilon @ learn[1], np.vstack([gain[1][nx:], learn[1]]), parity[1]]
    constrained = [gain[2][:nx] + upsilon @ learn[2], np.vstack([gain[2][nx:], learn[2]]), parity[2]]
    fed = [of_inputs(measured, direct) for measured, direct in zip(from_outputs, constrained, strict=True)]
    residuals = tuple(f"innovation {i + 1}" for i in range(len(gains.parity)))
    names = observer.fault_names if random_walk or q else ()
    realisation = LinearObserver(
        Az=az,
        Bu=bu,
        By=by,
        Cz=np.vstack(from_state),
        Du=np.vstack(fed),
        Dy=np.vstack(from_outputs),
        dt=observer.dt,
        input_names=plant.input_names,
        output_names=plant.output_names,
        state_names=plant.state_names,
        fault_names=names,
        residual_names=residuals,
        state_delays=(0,) * nx,
        fault_delays=(0,) * len(names),
    )
    begin = observer.init()
    # z = E x gives back x, as [L K] [E; C] = I, where the first outputs agree with it.
    return realisation, np.concatenate([step.H[:ne] @ begin.x, begin.parameters.theta])

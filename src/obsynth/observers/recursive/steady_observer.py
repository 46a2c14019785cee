"""The steady state of a recursive observer: its gains once they have settled, as a constant realisation."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from obsynth.errors import PreconditionError, SolverError, SpecError
from obsynth.numerics.arrays import FloatArray, read_only
from obsynth.numerics.spectra import abscissa
from obsynth.observers.linear.observer import LinearObserver
from obsynth.observers.recursive.gain_schedule import GainStep, gain_steps
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.observers.sensor_timing import require_plain

#: The gains have settled when what is left of their way is below this share of them.
SETTLED_GAINS = 1e-13

#: Gains that move by less than these roundings do not move.
UNMOVED_GAINS = 4.0 * np.finfo(np.float64).eps

#: Steps of the recursion before it is held to settle nowhere.
MOST_SETTLING_STEPS = 20_000

#: Steps in a row that must have settled: at a turning point gains stand still, too.
STILL_STEPS = 5

#: Gains that are where they were so many steps before have settled, although their last digits go to and fro.
STILL_FOR_LONG = 256


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


def _settled(observer: RecursiveObserver) -> tuple[GainStep, int]:
    """Return the first step whose gains have settled."""
    last: GainStep | None = None
    early: GainStep | None = None
    still, before = 0, np.inf
    for k, gains in enumerate(gain_steps(observer, MOST_SETTLING_STEPS)):
        if not k % STILL_FOR_LONG:
            if early is not None and _moved(gains, early) <= SETTLED_GAINS:
                return gains, k
            early = gains
        # The correction of the start, which comes first with early constraints, has other rows.
        if last is not None and last.gain.shape == gains.gain.shape:
            moved = _moved(gains, last)
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


def _moved(now: GainStep, then: GainStep) -> float:
    """Return the largest relative distance between two gains; infinite for those of other rows."""
    if now.gain.shape != then.gain.shape:
        return np.inf
    return max(_distance(current, earlier) for current, earlier in zip(_parts(now), _parts(then), strict=True))


def _parts(gains: GainStep) -> tuple[FloatArray, ...]:
    # The sign of a direction of the innovation is free, its square is not.
    return gains.gain, gains.Upsilon, gains.learn, gains.retain, gains.parity.T @ gains.parity, gains.G.T @ gains.G


def _distance(now: FloatArray, then: FloatArray) -> float:
    size = float(np.abs(now).max(initial=0.0))
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

"""What a recursive observer computes that does not depend on data: gains, batches run with them, the steady state."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from itertools import chain
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from obsynth.errors import PreconditionError, SolverError, SpecError
from obsynth.numerics.arrays import FloatArray, read_only
from obsynth.numerics.spectra import abscissa
from obsynth.numerics.square_root_estimation import least_squares_step, rank_revealing_step, update
from obsynth.observers.estimates import Estimates
from obsynth.observers.linear.observer import LinearObserver
from obsynth.observers.records import batch_record, require_horizon
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.observers.recursive.recursion import posterior_residual
from obsynth.observers.recursive.step_model import PreparedStep, StepMatrices, spreads
from obsynth.observers.running import named_estimates
from obsynth.observers.sensor_timing import require_plain

#: Numbers of gains that are kept for a second look, of twenty megabytes.
MOST_KEPT_GAINS = 2**21


#: The gains have settled when what is left of their way is below this share of them.
SETTLED_GAINS = 1e-13

#: Steps of the recursion before it is held to settle nowhere.
MOST_SETTLING_STEPS = 20_000

#: Steps in a row that must have settled: at a turning point gains stand still, too.
STILL_STEPS = 5

#: Gains that are where they were so many steps before have settled, although their last digits go to and fro.
STILL_FOR_LONG = 256


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


def gain_steps(
    observer: RecursiveObserver, steps: int, *, received: NDArray[np.bool_] | None = None
) -> Iterator[GainStep]:
    """Yield the gains of the first steps (``received (samples, ny)``)."""
    recursion = observer.recursion
    start = recursion.first
    factor, Upsilon, parameters, diffuse = start.factor, start.Upsilon, start.parameters, start.diffuse
    adaptation, model = observer.adaptation, recursion.model
    first = [step for step in (model.first(),) if step is not None]
    prepared: PreparedStep | None = None
    for k, step in enumerate(chain(first, (model.at(k) for k in range(steps))), 1 - len(first)):
        ne, rows, nq = len(step.A), len(step.H), Upsilon.shape[1]
        # Of data alone it is the identity, which a prepared step knows.
        right = np.hstack([np.eye(rows), np.vstack([step.A @ Upsilon + step.Phi, -step.Psi])]) if nq else None
        complete = received is None or not k or bool(received[k].all())
        solved = None
        if complete and not diffuse.shape[1]:
            prepared = PreparedStep.of(step, prepared)
            solved = prepared.taken(factor, right)
        # The literal form asks for the noise itself.
        if solved is None or recursion.literal:
            S, unknown = spreads(step, factor, diffuse, k, observer.state_names)
            H, right = step.H, np.eye(rows) if right is None else right
            if not complete and received is not None:
                kept = np.concatenate([np.ones(ne, dtype=bool), received[k], np.ones(len(step.Dn), dtype=bool)])
                H, S, right, unknown = H[kept], S[kept], right[kept], unknown[kept]
            if solved is None and not unknown.shape[1] and not complete:
                solved = least_squares_step(H, S, right)
            solved = solved or rank_revealing_step(H, S, right, unknown, mapped=rows)
        diffuse = solved.diffuse
        gain, Upsilon, factor = solved.estimate[:, :rows], solved.estimate[:, rows:], solved.factor
        parity, G = solved.innovation[:, :rows], -solved.innovation[:, rows:]
        learn, retain = np.zeros((nq, rows)), np.eye(nq)
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
        yield GainStep(step, gain, parity, G, Upsilon, factor, learn, retain, parameters.spread)


#: Gains of the steps of an observer: `gain_steps`, or what remembers them.
Gains: TypeAlias = Callable[[RecursiveObserver, int], Iterable[GainStep]]


def gains_once() -> Gains:
    """Return `gain_steps` for several that look at the same gains, which are computed once if they are few numbers."""
    remembered_gains: dict[RecursiveObserver, tuple[int, list[GainStep], Iterator[GainStep]]] = {}

    def gains(observer: RecursiveObserver, steps: int) -> Iterable[GainStep]:
        if steps * (observer.plant.nx + observer.plant.nq) * (observer.plant.ne + observer.plant.ny) > MOST_KEPT_GAINS:
            yield from gain_steps(observer, steps)
            return
        if observer not in remembered_gains or remembered_gains[observer][0] < steps:
            remembered_gains[observer] = steps, [], gain_steps(observer, steps)
        _, kept, further = remembered_gains[observer]
        for position in range(steps + int(observer.early_constraints)):
            if position == len(kept):
                kept.append(next(further))
            yield kept[position]

    return gains


def run_batch(observer: RecursiveObserver, y: ArrayLike, u: ArrayLike | None = None) -> Estimates:
    """Run many trials at once: the gains do not depend on data, so a step is one product for all trials.

    Shapes: ``y (trials, samples, ny)``.
    """
    if observer.adaptation is not None and observer.adaptation.reset:
        raise SpecError("Resets depend on the data of each trial: run them one by one, or without reset.", path="reset")
    outputs, given_inputs = batch_record(y, u, observer.plant.ny, observer.plant.input_names)
    trials, samples = outputs.shape[:2]
    if not np.isfinite(outputs[:, 1:]).all():
        raise SpecError("A batch must be complete: run trials with missing samples one by one.", path="y")
    require_horizon(observer.plant.horizon, samples, early=observer.early_constraints)
    inputs = np.broadcast_to(given_inputs, (trials, *given_inputs.shape[-2:]))
    start = observer.init()
    early = observer.recursion.model.first() is not None
    x = np.broadcast_to(start.x, (trials, len(start.x)))
    theta = np.broadcast_to(start.parameters.theta, (trials, len(start.parameters.theta)))
    nx, nq = observer.plant.nx, len(observer.fault_names)
    states, parameters = np.empty((trials, samples, nx)), np.empty((trials, samples, nq))

    def keep(k: int, Upsilon: FloatArray) -> None:
        """Keep states and parameters: of a walk they are parts of x, else the states follow the parameters."""
        walks = x.shape[1] > nx
        states[:, k] = x[:, :nx] if walks else x + theta @ Upsilon.T
        parameters[:, k] = x[:, nx:] if walks else theta

    innovations: list[FloatArray] = []
    if not early:
        keep(0, np.zeros((nx, theta.shape[1])))
        innovations.append(np.full((trials, 0), np.nan))
    for k, gains in enumerate(gain_steps(observer, samples - 1), 0 if early else 1):
        step, arriving = gains.step, outputs[:, k] if k else outputs[:, k, :0]
        before = inputs[:, k - 1] if k else np.zeros((trials, observer.plant.nu))
        measured = arriving - inputs[:, k] @ step.D.T
        data = np.concatenate((x @ step.A.T + before @ step.B.T, measured, inputs[:, k] @ step.Dn.T), axis=1)
        x, theta = data @ gains.gain.T, theta @ gains.retain.T + data @ gains.learn.T
        keep(k, gains.Upsilon)
        innovations.append(data @ gains.parity.T)
    padded = np.full((trials, samples, max(rows_of_step.shape[1] for rows_of_step in innovations)), np.nan)
    for k, rows_of_step in enumerate(innovations):
        padded[:, k, : rows_of_step.shape[1]] = rows_of_step
    return named_estimates(observer, states=states, faults=parameters, innovations=padded)


class SteadyObserver(NamedTuple):
    """A recursive observer whose gains have settled."""

    # from ``[u; y]`` to states, parameters, and the whitened innovation at the parameters of one sample before
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
            quiet = (
                moved == 0.0
                or (moved <= SETTLED_GAINS and remaining <= SETTLED_GAINS)
                or moved <= 4.0 * np.finfo(np.float64).eps
            )
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

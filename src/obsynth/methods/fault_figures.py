"""Effects of faults, unknown inputs and noise on the estimates of a design, in closed form at one sample time.

The plant is sampled, with faults and unknown inputs held between samples; the error of an estimate is followed from
one impulse at each input, so that plants with modes on the boundary need no stationary covariance.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from obsynth.errors import PreconditionError
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.continuous import zero_order_hold
from obsynth.numerics.linear_recursions import impulse_responses
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.transformations.elimination import eliminate_algebraic_states
from obsynth.plants.transformations.recovery import Transformation
from obsynth.plants.transformations.sampling import discretise
from obsynth.simulation.linear import stabilising_feedback

#: Rounding alone leaves at most this share of the fault that moves the outputs as much as an unknown input.
ROUNDED_SHARE = 1e-9

#: Shares of a step at which its delay is read.
DELAY_SHARE, NEARLY_ALL = 0.5, 0.9

#: A fault estimate off its step by more than this at the horizon did not reach it.
REACHED_STEP = 0.1

#: An unstable plant that grows by more than this is held by a feedback; one without inputs is followed until it has
#: grown by the second, beyond which differences of its outputs are rounding.
HELD_GROWTH, LARGEST_STEP_GROWTH = 1e3, 1e6


@dataclass(frozen=True)
class StepFigures:
    """What becomes of a unit step of one fault in its estimate; fields as of `FaultFigures`."""

    fault: str
    half: float
    most: float
    at_horizon: float
    peak: float
    horizon: float

    @property
    def reaches(self) -> bool:
        """Whether a step is there at the horizon."""
        return bool(abs(self.at_horizon - 1.0) <= REACHED_STEP and np.isfinite(self.most))


@dataclass(frozen=True)
class FaultFigures(StepFigures):
    """What becomes of a unit step of one fault, of noise and of unknown inputs, in its estimate.

    Parameters
    ----------
    fault : str
        The fault.
    half, most : float, seconds
        Time until the estimate of a unit step first shows 50 and 90 % of it; infinite where it never does.
    at_horizon, peak : float
        The estimate of a unit step at the horizon, and its largest absolute value before.
    horizon : float, seconds
        How long the step was followed: a shorter time where the plant is unstable and nothing holds it.
    deviation : float
        Standard deviation under the stated noise.
    unknown_input_gain : float
        Largest gain of a held sinusoidal unknown input to the estimate, per unit of the input.
    unknown_input_share : float, dimensionless
        The same, as a share of the fault that moves the outputs as much as the unknown input does.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(A=[[0.9]], C=[[1.0]], Bf=[[1.0]], dt=1.0, sensor_noise={"y1": 0.1})
    >>> figures = obsynth.compare(plant, methods=["functional-filter"], runs=2).methods[0].faults[0].figures
    >>> figures.fault, figures.half <= figures.most
    ('f1', True)
    """

    deviation: float
    unknown_input_gain: float
    unknown_input_share: float


def largest_gain(figures: Iterable[FaultFigures]) -> float:
    """Return the largest gain from an unknown input to an estimate; zero where all are rounding."""
    return max((each.unknown_input_gain for each in figures if each.unknown_input_share > ROUNDED_SHARE), default=0.0)


# Methods and figures ask for that of the same plant, which never changes.
@lru_cache(maxsize=2)
def without_algebraic_states(plant: DescriptorSystem) -> Transformation:
    """Return a sampled plant without algebraic states, with the way back."""
    return eliminate_algebraic_states(plant)


def on_the_clock(plant: DescriptorSystem, sample_time: float) -> DescriptorSystem:
    """Return the plant sampled, in its own time where it is so already, without algebraic states."""
    if plant.dt > 0.0:
        return without_algebraic_states(plant).plant
    return discretise(plant, sample_time).plant


def steps_in_bounds(plant: DescriptorSystem, steps: int) -> tuple[int, FloatArray]:
    """Return for how many samples, and with which ``feedback (nu, nx)``, ``u = -feedback x``, a sampled plant
    ``(E = I)`` is kept in bounds: with none where it hardly grows; with no input, for a shorter time."""
    nothing = np.zeros((plant.nu, plant.nx))
    rate = float(np.log(max(float(np.max(np.abs(np.linalg.eigvals(plant.A)), initial=0.0)), 1.0)))
    if rate * steps <= np.log(HELD_GROWTH):
        return steps, nothing
    try:
        feedback = stabilising_feedback(plant)
        if float(np.max(np.abs(np.linalg.eigvals(plant.A - plant.B @ feedback)))) < 1.0:
            return steps, feedback
    except PreconditionError:
        pass
    return max(int(np.log(LARGEST_STEP_GROWTH) / rate), 2), nothing


def step_responses(
    plant: DescriptorSystem, observer: LinearObserver, steps: int, feedback: FloatArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """Return responses to impulses ``(steps, faults, nf + nd + nw)`` and to steps ``(steps, faults, nf)``."""
    rows = observer.fault_rows
    # Where no noise is stated, every output has one of its own, of deviation one.
    silent = not plant.Dw.any() and not plant.Bw.any()
    driven, measured = (np.zeros((plant.nx, plant.ny)), np.eye(plant.ny)) if silent else (plant.Bw, plant.Dw)
    inputs = np.hstack([plant.Bf, plant.Bd, driven])
    direct = np.hstack([plant.Df, plant.Dd, measured])
    moved, signals = _held(plant, feedback)
    into, through = np.hstack([observer.By, observer.Bu]), np.hstack([observer.Dy, observer.Du])[rows]
    direct = np.vstack([direct, np.zeros((plant.nu, direct.shape[1]))])
    a = np.block([[moved, np.zeros((plant.nx, observer.order))], [into @ signals, observer.Az]])
    b = np.vstack([inputs, into @ direct])
    c = np.hstack([through @ signals, observer.Cz[rows]])
    first = through @ direct
    responses = np.concatenate([first[None], impulse_responses(a, b, c, steps - 1)])
    return responses, np.cumsum(responses[:, :, : plant.nf], axis=0)


def _held(plant: DescriptorSystem, feedback: FloatArray | None) -> tuple[FloatArray, FloatArray]:
    """Return the dynamics ``(nx, nx)`` of a sampled plant under a feedback u = -feedback x, and what of the states its
    outputs and inputs show ``(ny + nu, nx)``.

    The observer knows this input: it changes no estimate, and keeps numbers small."""
    gain = np.zeros((plant.nu, plant.nx)) if feedback is None else feedback
    return plant.A - plant.B @ gain, np.vstack([plant.C - plant.D @ gain, -gain])


def _faults_that_move_as_much(plant: DescriptorSystem, steps: int, feedback: FloatArray) -> FloatArray:
    """Return how large faults are that move the outputs as much as one of each unknown input ``(nf, nd)``.

    Largest gains over frequency are compared, of the outputs in their noise; where not all have some, of each output
    in what the fault does to it.  No unit of a signal plays a part."""
    moved, signals = _held(plant, feedback)
    inputs, direct = np.hstack([plant.Bf, plant.Bd]), np.hstack([plant.Df, plant.Dd])
    later = impulse_responses(moved, inputs, signals[: plant.ny], steps - 1)
    peaks = np.abs(np.fft.rfft(np.concatenate([direct[None], later]), axis=0)).max(axis=0, initial=0.0)
    of_faults, of_unknown = peaks[:, : plant.nf], peaks[:, plant.nf :]
    noise = np.linalg.norm(plant.Dw, axis=1)
    sizes = np.tile(noise[:, None], plant.nf) if np.all(noise > 0.0) else of_faults
    weights = np.divide(1.0, sizes, out=np.zeros_like(sizes), where=sizes > 0.0)
    effects = np.linalg.norm(weights * of_faults, axis=0)
    unknown = np.sqrt((weights**2).T @ of_unknown**2)
    return np.asarray(np.divide(unknown, effects[:, None], out=np.zeros_like(unknown), where=effects[:, None] > 0.0))


def fault_figures(plant: DescriptorSystem, observer: LinearObserver, steps: int) -> tuple[FaultFigures, ...]:
    """Return the figures of every fault that a sampled observer estimates on a sampled plant ``(E = I)``."""
    followed, feedback = steps_in_bounds(plant, steps)
    impulse, step = step_responses(plant, observer, followed, feedback)
    unknown = impulse[:, :, plant.nf : plant.nf + plant.nd]
    noise = impulse[:, :, plant.nf + plant.nd :]
    # An observer that runs away has figures beyond all numbers, and needs no warning besides.
    with np.errstate(over="ignore", invalid="ignore"):
        alike = _faults_that_move_as_much(plant, followed, feedback)
        return tuple(_figures(plant, observer, step, unknown, noise, alike))


def _figures(
    plant: DescriptorSystem,
    observer: LinearObserver,
    step: FloatArray,
    unknown: FloatArray,
    noise: FloatArray,
    alike: FloatArray,
) -> Iterator[FaultFigures]:
    for row, name in enumerate(observer.fault_names):
        own = step[:, row, plant.fault_names.index(name)]
        gains = np.abs(np.fft.rfft(unknown[:, row], axis=0)).max(axis=0, initial=0.0)
        sizes = alike[plant.fault_names.index(name)]
        shares = np.divide(gains, sizes, out=np.zeros_like(gains), where=sizes > 0.0)
        yield FaultFigures(
            *_of_step(name, own, plant.dt),
            float(np.sqrt(np.sum(noise[:, row] ** 2))),
            float(np.max(gains, initial=0.0)),
            float(np.max(shares, initial=0.0)),
        )


def step_figures_between_samples(
    plant: DescriptorSystem, observer: LinearObserver, step: float, steps: int
) -> tuple[StepFigures, ...]:
    """Return what becomes of steps that last, on a continuous plant with its continuous observer, every ``step``
    seconds.

    Both are followed together, exactly: the observer sampled by itself takes outputs and inputs as lines between its
    samples, which a jump of the fault and inputs that a feedback holds are not."""
    followed, feedback = steps_in_bounds(on_the_clock(plant, step), steps)
    own = without_algebraic_states(plant).plant
    moved, signals = _held(own, stabilising_feedback(own) if feedback.any() else None)
    rows = observer.fault_rows
    into, through = np.hstack([observer.By, observer.Bu]), np.hstack([observer.Dy, observer.Du])[rows]
    direct = np.vstack([own.Df, np.zeros((own.nu, own.nf))])
    a = np.block([[moved, np.zeros((own.nx, observer.order))], [into @ signals, observer.Az]])
    transition, driven = zero_order_hold(a, np.vstack([own.Bf, into @ direct]), step)
    shown = np.hstack([through @ signals, observer.Cz[rows]])
    responses = np.concatenate([(through @ direct)[None], impulse_responses(transition, driven, shown, followed - 1)])
    with np.errstate(over="ignore", invalid="ignore"):
        of_steps = np.cumsum(responses, axis=0)
        return tuple(
            StepFigures(*_of_step(name, of_steps[:, row, own.fault_names.index(name)], step))
            for row, name in enumerate(observer.fault_names)
        )


def _of_step(name: str, estimates: FloatArray, dt: float) -> tuple[str, float, float, float, float, float]:
    """Return the fields of `StepFigures` from the estimates of a unit step."""
    half, most = (_first(estimates >= share, dt) for share in (DELAY_SHARE, NEARLY_ALL))
    return name, half, most, float(estimates[-1]), float(np.max(np.abs(estimates))), len(estimates) * dt


def _first(reached: NDArray[np.bool_], dt: float) -> float:
    return float(np.argmax(reached)) * dt if np.any(reached) else float("inf")

"""A design and a scenario side by side, ready to run: plant, signals and observer, once for each of many seeds."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.holds import driven, first_order_hold
from obsynth.observers.dae.observer import DAEObserver
from obsynth.observers.estimates import Estimates
from obsynth.observers.linear.observer import LinearObserver, split_rows
from obsynth.observers.linear.sampling import sample_observer
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.plants.names import index_of
from obsynth.results.design import ObserverDesign
from obsynth.simulation.linear import Stepper, make_stepper
from obsynth.simulation.scenario import Scenario
from obsynth.simulation.scenario_signals import Drive, resolve

#: Warm-up ends when the effect of an error at the start has shrunk to this share of its largest, for good.
WARM_UP_SHARE = 0.01
#: An initial state that is off by less than this, relative to its size, is off by rounding only.
CONSISTENCY_TOLERANCE = 1e-9


@dataclass(frozen=True, eq=False)
class Runs:
    """What happened in several runs, ``(steps, runs, signals)`` each; rows: the observer's states, faults, residuals.

    Outputs are as measured; faults are the parameters of a plant that has some; ``kept``: estimates that say more than
    rows.
    """

    states: FloatArray
    outputs: FloatArray
    inputs: FloatArray
    faults: FloatArray
    disturbances: FloatArray
    rows: FloatArray
    observer: LinearObserver | RecursiveObserver | DAEObserver
    kept: tuple[Estimates, ...] = ()

    @property
    def estimates(self) -> tuple[Estimates, ...]:
        """What the observer says, one per run."""
        if not isinstance(self.observer, LinearObserver):
            return self.kept
        return tuple(split_rows(self.observer, self.rows[:, run]) for run in range(self.rows.shape[1]))


@dataclass(frozen=True, eq=False)
class Bench(ABC):
    """A design and a scenario, ready to run; it can be sent to another process, with a model that is data.

    The observer is in discrete time; ``estimated``: which of the true faults are estimated; ``notes`` for readers.
    """

    drive: Drive
    observer: LinearObserver | RecursiveObserver | DAEObserver
    initial_state: FloatArray
    fault_signals: slice
    estimated: tuple[int, ...]
    notes: tuple[str, ...]

    @abstractmethod
    def run(self, seeds: Sequence[int]) -> Runs:
        """Run the plant and the observer, once for each seed."""

    @property
    def onset(self) -> int | None:
        """First sample at which a fault acts, or a faulty sensor; `None` if there is none."""
        return self.drive.first_fault(self.fault_signals)

    def warm_ups(self) -> tuple[int | None, int | None]:
        """Return from when the start no longer shows in the estimates of states, and of faults; 0 with deviations."""
        observer, steps = self.observer, self.drive.steps
        if not isinstance(observer, LinearObserver):
            return 0, 0
        ends: list[int | None] = []
        for rows, delays in (
            (observer.state_rows, observer.state_delays),
            (observer.fault_rows, observer.fault_delays),
        ):
            shown, sizes = observer.Cz[rows], np.zeros(steps)
            for k in range(steps):
                sizes[k] = np.linalg.norm(shown)
                shown = shown @ observer.Az
            late = np.flatnonzero(sizes > WARM_UP_SHARE * np.max(sizes))
            end = int(late[-1]) + 1 if late.size else 0
            end = max(end, *delays, 0)
            ends.append(end if end < steps else None)
        return ends[0], ends[1]


@dataclass(frozen=True, eq=False)
class LinearBench(Bench):
    """A linear design and a scenario; ``observer_ramp (nz, nu + ny)``: what a first sample adds to the kept state."""

    observer: LinearObserver
    stepper: Stepper
    observer_start: FloatArray
    observer_ramp: FloatArray
    sizes: tuple[int, int, int]

    def run(self, seeds: Sequence[int]) -> Runs:
        """Run the plant and the observer, once for each seed."""
        drawn, noise, sensor_noise = self.drive.drawn(seeds, self.stepper.noisy.shape[1])
        left = self.drive.left[:, None, :] + drawn
        difference = np.broadcast_to((self.drive.right - self.drive.left)[:, None, :], left.shape)
        states, clean, fed = self.stepper.run(left, difference, noise)
        inputs, faults, disturbances = np.split(left, np.cumsum(self.sizes)[:-1], axis=2)
        if fed.shape[2]:
            inputs = inputs + fed
        outputs = self.drive.measured(clean + sensor_noise)
        rows = self.observed(outputs, inputs)
        return Runs(states, outputs, inputs, faults, disturbances, rows, self.observer)

    def observed(self, outputs: FloatArray, inputs: FloatArray) -> FloatArray:
        """Return what the observer says to ``outputs (steps, runs, ny)``, ``inputs (steps, runs, nu)``: its rows."""
        system = self.observer
        start = self.observer_start - np.concatenate([inputs[0], outputs[0]], axis=1) @ self.observer_ramp.T
        z = driven(system.Az, start, inputs @ system.Bu.T + outputs @ system.By.T)
        return np.asarray(z @ system.Cz.T + inputs @ system.Du.T + outputs @ system.Dy.T)


def make_bench(design: ObserverDesign, scenario: Scenario) -> LinearBench:
    """Return the bench of a linear design and a scenario."""
    plant, observer = design.linear
    drive = resolve(plant, scenario)
    start = np.array([scenario.initial_state.get(name, 0.0) for name in plant.state_names])
    stepper = make_stepper(plant, drive, initial_state=start, stabilise=scenario.stabilise)
    given = scenario.observer_state
    if given is not None and len(given) != observer.order:
        raise SpecError(f"observer_state needs {observer.order} numbers, not {len(given)}.", path="observer_state")
    ramp = np.zeros((observer.order, len(observer.input_names) + len(observer.output_names)))
    if observer.dt <= 0.0:
        ramp = first_order_hold(observer.Az, np.hstack([observer.Bu, observer.By]), drive.dt)[2]
        observer = sample_observer(observer, drive.dt)
    begin = np.zeros(observer.order) if given is None else np.array(given)
    notes = []
    if not plant.is_discrete:
        notes.append(
            "Between samples the plant is exact for signals that are constant or linear there; its observer is sampled "
            "by a first-order hold."
        )
    if stepper.feedback is not None:
        notes.append(
            "A stabilising state feedback (linear-quadratic, unit weights) was added for this simulation; the inputs "
            "include it."
        )
    return LinearBench(
        drive, observer, start, slice(plant.nu, plant.nu + plant.nf),
        tuple(index_of(name, plant.fault_names, what="The plant") for name in observer.fault_names), tuple(notes),
        stepper, begin, ramp, (plant.nu, plant.nf, plant.nd),
    )  # fmt: skip

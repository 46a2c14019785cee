"""Plant, scenario and observer side by side, in plain arrays: a bench that many seeds run on at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.holds import first_order_hold
from obsynth.observers.linear.observer import LinearObserver
from obsynth.observers.linear.sampling import sample_observer
from obsynth.results.design import ObserverDesign
from obsynth.simulation.linear import Stepper, make_stepper
from obsynth.simulation.scenario import Scenario
from obsynth.simulation.scenario_signals import Drive, resolve


@dataclass(frozen=True, eq=False)
class Runs:
    """What happened in several runs, ``(steps, runs, signals)`` each.

    Fields: states, outputs, inputs, faults, disturbances: Of the plant; outputs as measured; rows: What the observer
    says: state estimates, fault estimates, residuals.
    """

    states: FloatArray
    outputs: FloatArray
    inputs: FloatArray
    faults: FloatArray
    disturbances: FloatArray
    rows: FloatArray


@dataclass(frozen=True, eq=False)
class Bench:
    """A design and a scenario, ready to run; it can be sent to another process.

    Fields: drive: Signals; stepper: Plant; observer: In discrete time; a continuous one sampled by a first-order hold;
    observer_start: ``z(0)``; observer_ramp: ``(nz, nu + ny)``: what a first sample adds to the state that a sampled
    observer keeps; initial_state: ``(nx,)``, as asked for; sizes: ``nu, nf, nd``.
    """

    drive: Drive
    stepper: Stepper
    observer: LinearObserver
    observer_start: FloatArray
    observer_ramp: FloatArray
    initial_state: FloatArray
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
        return Runs(states, outputs, inputs, faults, disturbances, self.observed(outputs, inputs))

    def observed(self, outputs: FloatArray, inputs: FloatArray) -> FloatArray:
        """Return what the observer says to records, ``(steps, runs, nx + nf + nr)``.

        Shapes: ``outputs (steps, runs, ny)``, ``inputs (steps, runs, nu)``.
        """
        system = self.observer
        drive = inputs @ system.Bu.T + outputs @ system.By.T
        z = np.empty((*outputs.shape[:2], system.order))
        z[0] = self.observer_start - np.concatenate([inputs[0], outputs[0]], axis=1) @ self.observer_ramp.T
        turned = np.ascontiguousarray(system.Az.T)
        for k in range(len(drive) - 1):
            z[k + 1] = z[k] @ turned + drive[k]
        return np.asarray(z @ system.Cz.T + inputs @ system.Du.T + outputs @ system.Dy.T)


def make_bench(design: ObserverDesign, scenario: Scenario) -> Bench:
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
    return Bench(drive, stepper, observer, begin, ramp, start, (plant.nu, plant.nf, plant.nd))

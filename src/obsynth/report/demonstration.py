"""A demonstration scenario for a design, made from the design alone: a step of each fault in turn."""

from __future__ import annotations

import numpy as np

from obsynth.methods.fault_figures import HELD_GROWTH
from obsynth.numerics.spectra import decay_rates, eigenvalues
from obsynth.observers.linear.observer import LinearObserver
from obsynth.observers.nonlinear.observer import DAEObserver
from obsynth.observers.nonlinear.region_observer import RegionObserver
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.observers.scheduled.observer import ScheduledObserver
from obsynth.observers.window.observer import WindowObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.transformations.elimination import eliminate_algebraic_states
from obsynth.results.design import ObserverDesign
from obsynth.simulation.profiles import Step
from obsynth.simulation.scenario import Scenario

#: A segment lasts as long as the slowest error needs to shrink by this factor, and more.
SEGMENT_LEFT = 0.005

#: Samples in a segment, at least and at most; those of a continuous observer are chosen.
SHORTEST_SEGMENT, LONGEST_SEGMENT, CHOSEN = 12, 1500, 150

#: An observer with this forgetting factor or more, or none, is shown for as long as one with this.
LONG_MEMORY = 0.99

#: Inches: a picture beside another one, and one of a row of its own; small, so that texts stay readable on a phone.
HALF_WIDTH, WIDE = 5.6, 6.6

#: Inches: a panel of several, and what the axis of time takes.
PANEL, EDGE = 1.5, 0.6


def demonstration_scenario(design: ObserverDesign) -> Scenario | None:
    """Return a scenario with each fault on for a while, one after another, or each parameter changed for good."""
    observer = design.observer
    if isinstance(observer, LinearObserver):
        return _of_linear(design.linear[0], observer) if observer.fault_names else None
    return (
        None if isinstance(observer, (RegionObserver, ScheduledObserver, WindowObserver)) else _of_recursive(observer)
    )


def _of_linear(plant: DescriptorSystem, observer: LinearObserver) -> Scenario:
    slowest = float(np.min(decay_rates(eigenvalues(observer.Az), observer.dt), initial=np.inf))
    settling = -np.log(SEGMENT_LEFT) / slowest if slowest > 0.0 else 0.0
    if observer.dt > 0.0:
        step = observer.dt
        samples = int(np.clip(np.ceil(settling / step), SHORTEST_SEGMENT, LONGEST_SEGMENT)) + max(observer.fault_delays)
    else:
        samples = CHOSEN
        step = (settling or 1.0) / samples
    segment = samples * step
    count = 2 * len(observer.fault_names) + 1
    faults = {
        name: Step(size=1.0, start=(2 * i + 1) * segment, end=(2 * i + 2) * segment)
        for i, name in enumerate(observer.fault_names)
    }
    growth = _growth(plant, count * segment)
    return Scenario(
        horizon=count * segment,
        sample_time=None if plant.is_discrete else step,
        faults=faults,
        stabilise=growth > np.log(HELD_GROWTH),
    )


def _growth(plant: DescriptorSystem, horizon: float) -> float:
    """Return the logarithm of what the fastest unstable mode grows by."""
    modes = eigenvalues(eliminate_algebraic_states(plant).plant.A)
    if plant.is_discrete:
        return float(np.log(max(np.max(np.abs(modes)), 1.0))) * horizon / plant.dt
    return max(float(np.max(modes.real)), 0.0) * horizon


def _of_recursive(observer: RecursiveObserver | DAEObserver) -> Scenario | None:
    if isinstance(observer, DAEObserver):
        spread, forgetting = observer.initial_parameter_covariance, observer.forgetting
        longest, discounts = None, observer.form == "forgetting"
    else:
        adaptation, longest = observer.adaptation, observer.plant.horizon
        # A Kalman filter has noise to show, and nothing else.
        spread, forgetting, discounts = np.zeros((0, 0)), 1.0, False
        if adaptation is not None:
            spread, forgetting = adaptation.initial_covariance, adaptation.forgetting
            discounts = adaptation.form != "random-walk"
    memory = min(forgetting, LONG_MEMORY) if discounts else LONG_MEMORY
    samples = int(np.clip(np.log(SEGMENT_LEFT) / np.log(memory), SHORTEST_SEGMENT, LONGEST_SEGMENT))
    count = len(observer.fault_names) + 1
    if longest is not None:
        samples = min(samples, (longest - 1) // count)
    if samples < SHORTEST_SEGMENT:
        return None
    deviations = np.sqrt(np.diag(spread))
    faults = {
        name: Step(size=float(size), start=(i + 1) * samples * observer.dt)
        for i, (name, size) in enumerate(zip(observer.fault_names, deviations, strict=True))
    }
    return Scenario(horizon=count * samples * observer.dt, faults=faults, noise=1.0)

"""What a passed design may still not do: show a step in time, or a fault that can be told from unknown inputs."""

from __future__ import annotations

from collections.abc import Collection, Iterator

from obsynth.analysis.diagnosis.columns import question
from obsynth.analysis.diagnosis.diagnosing import rest_point
from obsynth.errors import ObsynthError
from obsynth.methods.choosing.automatic import SAMPLES
from obsynth.methods.choosing.figures import fault_figures, on_the_clock
from obsynth.methods.functional_filter.rates import settling_time
from obsynth.observers.linear.observer import LinearObserver
from obsynth.observers.linear.sampling import sample_observer
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.results.design import ObserverDesign

#: Without a scenario steps are followed for so many settling times of the plant, at most so many samples.
SETTLING_TIMES, MOST_STEPS = 30, 6000
#: Plants with more states are not followed.
MOST_STATES = 80


def design_warnings(
    design: ObserverDesign, horizon: float | None = None, *, told: Collection[str] = ()
) -> tuple[str, ...]:
    """Return what a user should know before trusting the fault estimates; ``horizon`` in s, of the spec's scenario.

    Of faults that are ``told`` of already, steps are not followed again.
    """
    plant, observer = design.plant, design.observer
    if not isinstance(plant, DescriptorSystem) or not isinstance(observer, LinearObserver):
        return ()
    if not observer.fault_names or plant.nx > MOST_STATES or set(observer.fault_names) - set(plant.fault_names):
        return ()
    return (*_undetectable(plant, observer), *_followed(plant, observer, horizon, told))


def _undetectable(plant: DescriptorSystem, observer: LinearObserver) -> Iterator[str]:
    rest = rest_point(plant.dt)
    unknown = ", ".join(plant.disturbance_names)
    for name in observer.fault_names if plant.nd else ():
        asked = question(plant, (), plant.fault_names.index(name))
        if asked.shows_at(rest):
            continue
        what = f"A constant {name}" if asked.visible else name
        yield (
            f"{what} cannot be told from {unknown}: what the estimate shows may as well be that. See obsynth check for "
            "the sensors that would tell them apart."
        )


def _followed(
    plant: DescriptorSystem, observer: LinearObserver, horizon: float | None, told: Collection[str]
) -> Iterator[str]:
    """Yield steps that the estimates do not reach within the horizon."""
    step = plant.dt if plant.dt > 0.0 else settling_time(plant) / SAMPLES
    length = horizon if horizon is not None else SETTLING_TIMES * settling_time(plant)
    steps = int(min(max(length / step, 20), MOST_STEPS))
    try:
        sampled = on_the_clock(plant, step)
        clocked = observer if observer.dt > 0.0 else sample_observer(observer, step)
    except ObsynthError:
        return
    for figures in fault_figures(sampled, clocked, steps):
        if not figures.reaches and figures.fault not in told:
            yield (
                f"A unit step of {figures.fault} reads {figures.at_horizon:.3g} after {steps * step:.3g} s: the "
                "estimate does not reach it by then."
            )

"""What a passed design may still not do: show a step in time, or a fault that can be told from unknown inputs."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass

from obsynth.analysis.diagnosis.exact import question
from obsynth.analysis.diagnosis.fault_columns import rest_point
from obsynth.errors import ObsynthError
from obsynth.methods.choosing.automatic import SAMPLES
from obsynth.methods.choosing.figures import FaultFigures, fault_figures, on_the_clock
from obsynth.methods.functional_filter.rates import settling_time
from obsynth.observers.linear.observer import LinearObserver
from obsynth.observers.linear.sampling import sample_observer
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.results.design import ObserverDesign

#: Without a scenario steps are followed for so many settling times of the plant, at most so many samples.
SETTLING_TIMES, MOST_STEPS = 30, 6000
#: Plants with more states are not followed.
MOST_STATES = 80


@dataclass(frozen=True)
class Followed:
    """Steps of the faults, followed for so many seconds: figures by fault, none where they could not be followed."""

    figures: Mapping[str, FaultFigures]
    seconds: float


def followed_steps(design: ObserverDesign, horizon: float | None = None) -> Followed:
    """Return what becomes of a unit step of each fault of a linear design; ``horizon`` in s."""
    plant, observer = design.plant, design.observer
    nothing = Followed({}, 0.0)
    if not isinstance(plant, DescriptorSystem) or not isinstance(observer, LinearObserver):
        return nothing
    if not observer.fault_names or plant.nx > MOST_STATES or set(observer.fault_names) - set(plant.fault_names):
        return nothing
    if (observer.Bu.shape[1], observer.By.shape[1]) != (plant.nu, plant.ny):
        return nothing
    step = plant.dt if plant.dt > 0.0 else settling_time(plant) / SAMPLES
    length = horizon if horizon is not None else SETTLING_TIMES * settling_time(plant)
    steps = int(min(max(length / step, 20), MOST_STEPS))
    try:
        sampled = on_the_clock(plant, step)
        clocked = observer if observer.dt > 0.0 else sample_observer(observer, step)
    except ObsynthError:
        return nothing
    return Followed({found.fault: found for found in fault_figures(sampled, clocked, steps)}, steps * step)


def design_warnings(
    design: ObserverDesign, horizon: float | None = None, *, told: Collection[str] = (), steps: Followed | None = None
) -> tuple[str, ...]:
    """Return what a user should know before trusting the fault estimates; ``horizon`` in s, of the spec's scenario.

    Of faults that are ``told`` of already, no step is; ``steps``: from `followed_steps`, where they are known.
    """
    plant, observer = design.plant, design.observer
    if not isinstance(plant, DescriptorSystem) or not isinstance(observer, LinearObserver):
        return ()
    if not observer.fault_names or plant.nx > MOST_STATES or set(observer.fault_names) - set(plant.fault_names):
        return ()
    found = followed_steps(design, horizon) if steps is None else steps
    missed = (
        f"A unit step of {name} reads {figures.at_horizon:.3g} after {found.seconds:.3g} s: the estimate does not "
        "reach it by then."
        for name, figures in found.figures.items() if not figures.reaches and name not in told
    )  # fmt: skip
    return (*_undetectable(plant, observer), *missed)


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

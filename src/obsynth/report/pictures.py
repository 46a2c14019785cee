"""Pictures of a design on its HTML page, drawn without a display and stored as data URLs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from html import escape
from typing import TYPE_CHECKING, Any, NamedTuple

from obsynth.errors import ObsynthError
from obsynth.methods.guaranteed_test.method import GuaranteedTestMethod
from obsynth.methods.guaranteed_test.result import GuaranteedTest
from obsynth.methods.optimal_filter.method import OptimalFilterMethod
from obsynth.methods.optimal_filter.public import OptimalFilter
from obsynth.observers.detection import Decision, Detection
from obsynth.observers.linear.observer import LinearObserver
from obsynth.report.demonstration import EDGE, HALF_WIDTH, PANEL, WIDE, demonstration_scenario
from obsynth.report.plots.estimates import plot_states
from obsynth.report.plots.frequency import plot_gains
from obsynth.report.plots.guaranteed import plot_hidden_course
from obsynth.report.plots.panels import data_url, image_of
from obsynth.report.plots.simulation import plot_simulation
from obsynth.report.plots.spectra import plot_poles
from obsynth.report.plots.trade_off import plot_delays
from obsynth.results.design import ObserverDesign
from obsynth.results.number_texts import point_in_time
from obsynth.results.registered import is_registered, registered
from obsynth.simulation.scenario import Scenario
from obsynth.simulation.simulate import Simulation, simulate

if TYPE_CHECKING:
    from matplotlib.axes import Axes


#: Designs with more states get no picture of states.
MOST_DRAWN_STATES = 6


class Picture(NamedTuple):
    """A picture in a page: title, text (the caption, and for readers who cannot see it), and image as a data URL."""

    title: str
    text: str
    source: str
    wide: bool = False

    def html(self) -> str:
        """Return the picture as an HTML figure; a wide one takes a row of its own."""
        title = f"<h3>{escape(self.title)}</h3>" if self.title else ""
        return (
            f'<figure class="{"wide" if self.wide else "half"}">{title}<img alt="{escape(self.text)}" '
            f'src="{self.source}"><figcaption>{escape(self.text)}</figcaption></figure>'
        )


def pictures_of(design: ObserverDesign, *, scenario: Scenario | None = None) -> Iterator[Picture]:
    """Yield the pictures of a design."""
    yield from _simulation_pictures(design, scenario)
    if design.method == GuaranteedTestMethod.id:
        yield from _test_pictures(GuaranteedTest.of(design))
    if design.method == OptimalFilterMethod.id and len(OptimalFilter.of(design).trade_off) > 1:
        text = (
            "The least gain and the least deviation of any filter with an exact fault map against its delay, as the "
            "search computed them; of this filter's own delay they are verified."
        )
        yield Picture("Delay", text, drawn((HALF_WIDTH, 4.2), 1, lambda axes: plot_delays(design, axes=axes[0])))
    if not isinstance(design.observer, LinearObserver):
        return
    sampled = design.observer.dt > 0.0
    if design.observer.order:
        region = "inside the circle" if sampled else "left of the dashed line"
        yield Picture(
            "Spectrum",
            f"Eigenvalues of the observer: its initial-condition response decays where all are {region}. "
            "Grey curves: equal damping ratio.",
            drawn((HALF_WIDTH, 5.4 if sampled else 4.2), 1, lambda axes: plot_poles(design, axes=axes[0])),
        )
    if design.observer.fault_names:
        yield _gains_picture(
            design,
            "faults",
            "Gains to the fault estimates",
            "Singular values over the frequency: from the faults, where 1 is ideal, and from disturbances and noise, "
            "where small values are better.",
        )
    if design.observer.state_names:
        yield _gains_picture(
            design,
            "states",
            "Gains to the errors of the state estimates",
            "Largest singular values over the frequency, to the errors of the states: small values are better.",
        )


def _test_pictures(test: GuaranteedTest) -> Iterator[Picture]:
    """Yield the least threshold against the number of samples, and a fault profile that no test can detect."""
    if len(test.tests) == 1:
        if len(test.trade_off) > 1:
            text = (
                "The least threshold of all tests against the duration of their samples, by linear programmes; the "
                "marked one is proved."
            )
            yield Picture("Least threshold", text, drawn((HALF_WIDTH, 4.2), 1, lambda axes: test.plot(axes=axes[0])))
        if test.least > 0.0:
            yield Picture(
                "Why there is no smaller one",
                f"This time course of {test.fault} with these disturbances, and the opposite of all of them, give the "
                "same samples: every equation and all bounds hold.",
                drawn((HALF_WIDTH, 4.2), 1, lambda axes: plot_hidden_course(test, axes=axes[0])),
            )
        return
    for own, group in zip(test.tests, test.groups, strict=True):
        if len(group) > 1:
            yield Picture(
                f"Why {own.fault} is not isolated",
                "Together these time courses change no output: every equation holds, without disturbance and noise.",
                drawn((HALF_WIDTH, 4.2), 1, partial(_draw_hidden, test, own.fault)),
            )


def _draw_hidden(test: GuaranteedTest, fault: str, axes: Sequence[Axes]) -> None:
    plot_hidden_course(test, fault=fault, axes=axes[0])


def _gains_picture(design: ObserverDesign, to: str, title: str, text: str) -> Picture:
    return Picture(title, text, drawn((HALF_WIDTH, 4.2), 1, lambda axes: plot_gains(design, to=to, axes=axes[0])))


def shown_simulation(design: ObserverDesign, scenario: Scenario | None) -> tuple[Scenario, Simulation] | None:
    """Return the given or a demonstration scenario with its simulation; `None` where the plant has no demonstration."""
    try:
        used = scenario if scenario is not None else demonstration_scenario(design)
        return None if used is None else (used, simulate(design, used))
    except ObsynthError:
        # A page without a given scenario is complete without this picture.
        if scenario is not None:
            raise
        return None


def _simulation_pictures(design: ObserverDesign, scenario: Scenario | None) -> Iterator[Picture]:
    """Yield faults and states with their estimates in a simulation; nothing where the plant has no demonstration."""
    demonstration, is_stated = shown_simulation(design, scenario), scenario is not None
    if demonstration is None:
        return
    used, simulation = demonstration
    linear = isinstance(design.observer, LinearObserver)
    what = "On the scenario" if is_stated else "Each fault in turn" if linear else "Each parameter in turn"
    text = f"{what}: {_story(used, is_stated=is_stated, linear=linear)}"
    faults, states = len(design.observer.fault_names), simulation.estimates.state_names
    units, dt = design.plant.units, float(simulation.time[1]) if len(simulation.time) > 1 else 1.0
    first_detections = [*_detections(design, used, simulation)] if is_stated else []
    if faults or first_detections:
        yield stacked(
            "The design at work",
            text,
            faults + len(first_detections),
            lambda axes: plot_simulation(simulation, detections=first_detections, units=units, axes=axes),
        )
    if 0 < len(states) <= MOST_DRAWN_STATES:
        run = "in the same run" if faults or first_detections else "in a run with the stated noise"
        bands = "" if linear else ", with 95 % bands"
        yield stacked(
            "States",
            f"States {run}, and their estimates{bands}.",
            len(states),
            lambda axes: plot_states(simulation.estimates, states=simulation.states, dt=dt, units=units, axes=axes),
        )


def _detections(design: ObserverDesign, scenario: Scenario, simulation: Simulation) -> Iterator[Detection | Decision]:
    """Yield the detections of the first monitor that fits design and scenario; nothing where none does."""
    if is_registered("detections"):
        yield from registered("detections")(design, scenario, simulation)


def _story(scenario: Scenario, *, is_stated: bool, linear: bool) -> str:
    if is_stated:
        return f"{point_in_time(scenario.horizon)}, seed {scenario.seed}."
    if not linear:
        return (
            "a step of one initial standard deviation, with the stated noise. The 95 % bands hold while the "
            "parameters are constant."
        )
    closed = " A stabilising state feedback was added, as the plant is unstable." if scenario.stabilise else ""
    return (
        "a unit step, from zero and without noise. It shows how fast each estimate follows its fault, and its gain "
        f"from the other faults.{closed}"
    )


def stacked(title: str, text: str, panels: int, draw: Callable[[Sequence[Axes]], Any]) -> Picture:
    """Return a wide picture of several panels, one above the other."""
    return Picture(title, text, drawn((WIDE, PANEL * panels + EDGE), panels, draw), wide=True)


def drawn(size: tuple[float, float], panels: int, draw: Callable[[Sequence[Axes]], Any]) -> str:
    """Return the picture that ``draw`` makes on panels one above the other, as a data URL."""
    return data_url(image_of(panels, draw, size=size))

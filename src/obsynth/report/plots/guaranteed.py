"""Plots of guaranteed tests: the least fault against the number of samples, and the interval of a fault."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from obsynth.errors import SpecError
from obsynth.methods.guaranteed_test.result import GuaranteedTest
from obsynth.numerics.arguments import arguments_checked
from obsynth.observers.estimates import Estimates
from obsynth.report.plots.panels import (
    BAND_STYLE,
    LINE_COLOURS,
    PANEL_HEIGHT,
    RESIDUAL_STYLE,
    WIDTH,
    finish,
    one_panel,
    plain_decades,
    with_unit,
)
from obsynth.results.design import ObserverDesign

if TYPE_CHECKING:
    from matplotlib.axes import Axes


#: Courses below this share of the largest number are zero but for rounding.
ROUNDED_COURSE = 1e-12

#: From this ratio of largest to smallest threshold on, its axis is logarithmic.
WIDE_THRESHOLDS = 5.0


@arguments_checked
def plot_least_thresholds(design: ObserverDesign, *, axes: Axes | None = None) -> Axes:
    """Plot the least threshold of a guaranteed test against the time that its samples take.

    Parameters
    ----------
    design : ObserverDesign
        By `obsynth.guaranteed_test` with ``samples="auto"``, so that there is a table.
    axes : Axes, optional
        Where; new ones by default.

    Returns
    -------
    Axes
        Threshold in the fault's unit against seconds from the begin of the fault to the verdict; the samples chosen
        are marked, and what lies below the curve no test finds.

    Raises
    ------
    SpecError
        The design is by another method.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]],
    ...     C=[[1, 0], [0, 1]],
    ...     Bf=[[1], [0]],
    ...     Bd=[[0], [1]],
    ...     dt=1.0,
    ...     sensor_noise={"y1": 0.1, "y2": 0.1},
    ... )
    >>> test = obsynth.guaranteed_test(plant, disturbance_bounds=0.1, noise_bound=3)
    >>> obsynth.plotting.plot_least_thresholds(test).get_xlabel()
    'from the step to the last sample (s)'
    """
    test = GuaranteedTest.of(design)
    panel = one_panel(axes, size=(WIDTH, 1.6 * PANEL_HEIGHT))
    table = test.trade_off[np.isfinite(test.trade_off[:, 1])]
    before = int(test.options["before"]) if test.options["course"] == "step" else 0
    seconds = (table[:, 0] - 1 - before) * test.observer.dt
    panel.plot(
        seconds, table[:, 1], color="black", marker="o", markersize=4, label="least threshold, by linear programmes"
    )
    panel.fill_between(seconds, 0.0, table[:, 1], color="0.9", label="no test without false alarms, by the same")
    panel.plot(
        (test.samples - 1 - before) * test.observer.dt,
        test.threshold,
        marker="s",
        markersize=9,
        color="tab:red",
        linestyle="none",
        label=f"chosen: {test.samples} samples, proved",
    )
    sizes = table[:, 1]
    if sizes.size and sizes.min() > 0.0 and sizes.max() > WIDE_THRESHOLDS * sizes.min():
        panel.set_yscale("log")
        panel.set_ylim(bottom=0.7 * float(sizes.min()))
    else:
        panel.set_ylim(bottom=0.0)
    if seconds.size > 1 and seconds[0] > 0.0:
        # What a few more samples bring is of interest where they are few.
        plain_decades(panel, across=True)
    after = "from the step to the last sample" if before else "from the first to the last sample"
    return finish(panel, with_unit(test.fault, test.plant.units), below=f"{after} (s)")


@arguments_checked
def plot_intervals(design: ObserverDesign, estimates: Estimates, *, axes: Axes | None = None) -> Axes:
    """Plot the proved interval of the fault from a guaranteed test, and its first alarm.

    Parameters
    ----------
    design : ObserverDesign
        By `obsynth.guaranteed_test`.
    estimates : Estimates
        The observer's estimates over a record, from its start.
    axes : Axes, optional
        Where; new ones by default.

    Returns
    -------
    Axes
        Residual, and the interval of one threshold on both sides of it, against seconds; a line at the first alarm.

    Raises
    ------
    SpecError
        The design is by another method.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]],
    ...     C=[[1, 0], [0, 1]],
    ...     Bf=[[1], [0]],
    ...     Bd=[[0], [1]],
    ...     dt=1.0,
    ...     sensor_noise={"y1": 0.1, "y2": 0.1},
    ... )
    >>> test = obsynth.guaranteed_test(
    ...     plant, course="constant", disturbance_bounds=0.1, noise_bound=3, exact=True
    ... )
    >>> scenario = obsynth.Scenario(horizon=30, faults={"f1": obsynth.Step(size=1.0, start=10)})
    >>> run = obsynth.simulate(test, scenario)
    >>> obsynth.plotting.plot_intervals(test, run.estimates).get_xlabel()
    'time (s)'
    """
    test = GuaranteedTest.of(design)
    panel = one_panel(axes, size=(WIDTH, 1.6 * PANEL_HEIGHT))
    low, high = test.interval(estimates)
    seconds = np.arange(len(low)) * test.observer.dt
    panel.fill_between(seconds, low, high, label="proved interval of the fault", **BAND_STYLE)
    panel.plot(seconds, test.residual(estimates), label="residual", **RESIDUAL_STYLE)
    panel.axhline(0.0, color="0.4", linewidth=0.8)
    alarms = np.flatnonzero(test.alarms(estimates))
    if alarms.size:
        panel.axvline(float(seconds[alarms[0]]), color="#B2182B", linestyle=":", label="first alarm")
    return finish(panel, with_unit(test.fault, test.plant.units))


@arguments_checked
def plot_hidden_course(design: ObserverDesign, *, fault: str | None = None, axes: Axes | None = None) -> Axes:
    """Plot the courses with which a fault looks like none: why no test finds a smaller one, or tells it from others.

    Parameters
    ----------
    design : ObserverDesign
        By `obsynth.guaranteed_test`: of a test its witness; of a bank what hides a fault from a smaller group.
    fault : str, optional
        Of a bank: which one; the first by default.
    axes : Axes, optional
        Where; new ones by default.

    Returns
    -------
    Axes
        Faults, disturbances and states over the window, each as a share of its largest value, which the legend has.

    Raises
    ------
    SpecError
        The design is by another method, or nothing hides the fault.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]],
    ...     C=[[1, 0], [0, 1]],
    ...     Bf=[[1], [0]],
    ...     Bd=[[0], [1]],
    ...     dt=1.0,
    ...     sensor_noise={"y1": 0.1, "y2": 0.1},
    ... )
    >>> test = obsynth.guaranteed_test(plant, disturbance_bounds=0.1, noise_bound=3)
    >>> obsynth.plotting.plot_hidden_course(test).get_xlabel()
    'time (s)'
    """
    test = GuaranteedTest.of(design)
    plant, courses = test.plant, test.hidden_course(fault)
    if not courses:
        raise SpecError("No combination of signals hides this fault: there is none to draw.", path="fault")
    panel = one_panel(axes, size=(WIDTH, 1.6 * PANEL_HEIGHT))
    styles = dict.fromkeys(courses, "--")
    styles |= dict.fromkeys(plant.state_names, ":") | dict.fromkeys(test.fault_names, "-")
    sizes = {name: float(np.max(np.abs(course))) for name, course in courses.items()}
    largest = max(sizes.values())
    drawn_names = [name for name in courses if sizes[name] > ROUNDED_COURSE * largest]
    # Faults first, then disturbances, then states.
    for i, name in enumerate(sorted(drawn_names, key=lambda name: ("-", "--", ":").index(styles.get(name, ":")))):
        style, unit = styles.get(name, ":"), plant.units.get(name, "")
        panel.plot(
            np.arange(len(courses[name])) * test.observer.dt,
            courses[name] / sizes[name],
            style,
            color=LINE_COLOURS[i % len(LINE_COLOURS)],
            # What acts on a sampled plant is held between samples.
            drawstyle="default" if style == ":" else "steps-post",
            linewidth=1.0 if style == ":" else 1.8,
            label=f"{name}, up to {sizes[name]:.3g}{f' {unit}' if unit else ''}",
        )
    panel.axhline(0.0, color="0.4", linewidth=0.8)
    return finish(panel, "relative to its largest value", below="time (s)")

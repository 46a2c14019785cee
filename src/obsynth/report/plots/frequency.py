"""Frequency responses from faults, disturbances and noise to the estimates of faults and states and to the residual."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics.arguments import arguments_checked, chosen
from obsynth.numerics.arrays import ComplexArray, FloatArray
from obsynth.numerics.outward import upper_text
from obsynth.observers.linear.modes import GRID_REACH
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.report.plots.panels import WIDTH, one_panel, plain_decades, tidy
from obsynth.results.design import ObserverDesign
from obsynth.verification.output_responses import at_frequencies, output_responses, over_frequencies, sizes_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes


#: A gain below this share of what is subtracted from one another in it is rounding: zero gain.
GAIN_ROUNDING_SHARE = 1e-9

#: Frequencies between the neighbours of a largest gain: a peak that was missed by 1 % is missed by 1e-5 then.
POINTS_OF_A_PEAK = 33

#: The least singular value is drawn where it is below this share of the largest one somewhere.
VISIBLE_SHARE = 0.99

TARGETS = {"faults": "fault estimates", "states": "errors of the states", "residuals": "residual"}

_STYLES: dict[str, dict[str, Any]] = {
    "faults": {"color": "black", "linewidth": 1.8, "linestyle": "-"},
    "disturbances": {"color": "tab:red", "linewidth": 1.6, "linestyle": "--"},
    "noise": {"color": "tab:blue", "linewidth": 1.6, "linestyle": ":"},
}

_LEAST_LINE: dict[str, Any] = {"color": "black", "linewidth": 0.8, "linestyle": "-"}

_BOUND: dict[str, Any] = {"color": "tab:green", "linewidth": 1.2, "linestyle": "-."}


@dataclass(frozen=True, eq=False)
class EstimateGains:
    """Singular values from what acts on a plant to what an observer says.

    Fields: frequencies: ``(k,)``, rad/s; gains: Largest ones from ``faults``, ``disturbances``, ``noise`` as far as the
    plant has them: ``(k,)``, zero where only rounding is left; least: ``(k,)``: the least ones from the faults.
    """

    frequencies: FloatArray
    gains: dict[str, FloatArray]
    least: FloatArray


@arguments_checked
def estimate_gains(design: ObserverDesign, *, to: str = "faults") -> EstimateGains:
    """Return the singular values of the transfer functions that matter, from the plant and the shipped realisation.

    Parameters
    ----------
    design : ObserverDesign
        Linear.
    to : {"faults", "states", "residuals"}, optional
        The fault estimates, the errors of the state estimates (aligned with their delays), or the residual.

    Returns
    -------
    EstimateGains
        Around the poles of the observer.

    Raises
    ------
    SpecError
        The design is recursive, or has no such output.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]], C=[[1, 0], [0, 1]], Bf=[[1], [0]], Bd=[[0], [1]], dt=1.0
    ... )
    >>> design = obsynth.fault_estimation_filter(plant)
    >>> gains = obsynth.plotting.estimate_gains(design)
    >>> sorted(gains.gains)
    ['disturbances', 'faults']
    """
    plant, observer = design.linear
    chosen(to, "to", tuple(TARGETS))
    rows = {"faults": observer.fault_rows, "states": observer.state_rows, "residuals": observer.residual_rows}[to]
    if rows.start == rows.stop:
        what = "estimates no faults" if to == "faults" else f"has no {to}"
        raise SpecError(f"The design {what}.", path="observer")
    frequencies, points, to_estimate = over_frequencies(observer, rows)
    inputs = {"faults": (plant.Bf, plant.Df), "disturbances": (plant.Bd, plant.Dd), "noise": (plant.Bw, plant.Dw)}
    gains: dict[str, FloatArray] = {}
    least: FloatArray = np.zeros(len(points))
    for name, (b, d) in inputs.items():
        if not b.shape[1]:
            continue
        states, seen, terms = output_responses(plant, b, d, points, to_estimate)
        if to == "states":
            own = [plant.state_names.index(name) for name in observer.state_names]
            truth = _delayed(observer, points) * states[:, own]
            seen, terms = seen - truth, terms + sizes_of(truth)
        values = _above_rounding(np.linalg.svd(seen, compute_uv=False), terms[:, None])
        gains[name] = values[:, 0]
        if name == "faults":
            least = values[:, -1]
    return EstimateGains(frequencies, gains, least)


@dataclass(frozen=True, eq=False)
class FaultGains:
    """Largest gain from unknown inputs to fault estimates ``(nf, nd)``; share of a step shown in the end ``(nf,)``."""

    disturbance_gains: FloatArray
    steady: FloatArray


def fault_gains(design: ObserverDesign) -> FaultGains:
    """Return what reaches each fault estimate of a linear design that estimates faults."""
    plant, observer = design.linear
    frequencies, points, to_estimate = over_frequencies(observer, observer.fault_rows)
    disturbance_gains = np.zeros((len(observer.fault_names), plant.nd))
    if plant.nd:
        coarse = _disturbance_gains(plant, points, to_estimate)
        # A peak lies between the frequencies of the grid: beside the largest gains they are looked at closely.
        top = frequencies[-1] * (GRID_REACH if observer.dt == 0.0 else 1.0)
        sides = np.concatenate([frequencies[:1] / GRID_REACH, frequencies, [top]])
        peaks = np.unique(coarse.argmax(axis=0))
        near = np.concatenate([np.geomspace(sides[k], sides[k + 2], POINTS_OF_A_PEAK) for k in peaks])
        fine = _disturbance_gains(plant, *at_frequencies(observer, observer.fault_rows, near))
        disturbance_gains = np.maximum(coarse.max(axis=0), fine.max(axis=0))
    own = [plant.fault_names.index(name) for name in observer.fault_names]
    _, slowest, _ = output_responses(plant, plant.Bf, plant.Df, points, to_estimate)
    steady = slowest[0].real[np.arange(len(own)), own]
    return FaultGains(disturbance_gains, np.asarray(steady))


def _disturbance_gains(plant: DescriptorSystem, points: ComplexArray, to_estimate: ComplexArray) -> FloatArray:
    """Return gains from each unknown input to each fault estimate ``(k, nf, nd)``."""
    _, responses, terms = output_responses(plant, plant.Bd, plant.Dd, points, to_estimate)
    return _above_rounding(np.abs(responses), terms[:, None, None])


def _above_rounding(sizes: Any, terms: FloatArray) -> FloatArray:
    """Return sizes, and zero where only the rounding of terms is left."""
    return np.asarray(np.where(sizes > GAIN_ROUNDING_SHARE * terms, sizes, 0.0), dtype=np.float64)


def _delayed(observer: LinearObserver, points: ComplexArray) -> ComplexArray:
    """Return what a known delay makes of each state, ``(k, nx, 1)``."""
    delays = np.array(observer.state_delays, dtype=float)
    return np.asarray(points[:, None, None] ** -delays[None, :, None])


@arguments_checked
def plot_gains(design: ObserverDesign, *, to: str = "faults", axes: Axes | None = None) -> Axes:
    """Plot what reaches the fault estimates (or the state errors, or the residual), from whatever acts on the plant.

    A faithful fault estimate has singular values of 1 from the faults and small ones from disturbances and noise.

    Parameters
    ----------
    design : ObserverDesign
        Linear.
    to : {"faults", "states", "residuals"}, optional
        As for `estimate_gains`.
    axes : Axes, optional
        New ones by default.

    Returns
    -------
    Axes
        Largest singular values over the frequency, both logarithmic; the least one from the faults too where it
        differs, and the gain that was proved where there is one.

    Raises
    ------
    SpecError
        The design is recursive, or has no such output.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]], C=[[1, 0], [0, 1]], Bf=[[1], [0]], Bd=[[0], [1]], dt=1.0
    ... )
    >>> design = obsynth.fault_estimation_filter(plant)
    >>> obsynth.plotting.plot_gains(design).get_xlabel()
    'frequency (rad/s)'
    """
    gains, target = estimate_gains(design, to=to), TARGETS.get(to, "")
    panel = one_panel(axes, size=(WIDTH, 4.0))
    if to == "faults":
        panel.axhline(1.0, color="0.7", linewidth=0.8, zorder=0)
    for name, gain in gains.gains.items():
        if np.any(gain > 0.0):
            ending = "" if np.all(gain > 0.0) else " (elsewhere only rounding)"
            panel.plot(gains.frequencies, _positive(gain), label=f"{name} to {target}{ending}", **_STYLES[name])
        else:
            panel.plot([], [], label=f"{name}: zero gain", **_STYLES[name])
    largest = gains.gains.get("faults", gains.least)
    if to != "states" and np.any(gains.least < VISIBLE_SHARE * largest):
        panel.plot(gains.frequencies, _positive(gains.least), label="faults, least singular value", **_LEAST_LINE)
    gamma = design.certificate.claims.get("gamma")
    if to == "faults" and gamma is not None and "disturbances" in gains.gains:
        panel.plot(
            gains.frequencies[[0, -1]], [gamma, gamma], label=f"proved for disturbances: {upper_text(gamma)}", **_BOUND
        )
    plain_decades(panel)
    plain_decades(panel, across=True)
    panel.set_xlabel("frequency (rad/s)")
    panel.set_ylabel("singular value\n(unit of the estimate / of the input)")
    if gains.gains:
        panel.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2, frameon=False)
    else:
        panel.set_title("The plant states no faults, disturbances or noise.")
    tidy(panel)
    return panel


def _positive(gain: FloatArray) -> FloatArray:
    return np.where(gain > 0.0, gain, np.nan)

"""Designs against one another: what one promise costs in another, scans of delta, studies of tolerances, sweeps.

The spectrum of an observer with the limit of stability, and the region that was asked for.

What reaches the estimates of faults and states, and the residual, at each frequency.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from obsynth.analysis.zeros import fault_zeros, regularity_of
from obsynth.errors import SpecError
from obsynth.methods.registry import REGISTRY, method_class
from obsynth.methods.ui_pi_observer.augmented_plant import equilibrated
from obsynth.numerics.arguments import ComplexArray, FloatArray, arguments_checked, chosen, is_number
from obsynth.numerics.modal_response import resolved
from obsynth.numerics.norms import response
from obsynth.numerics.ranks import RANK_TOLERANCE
from obsynth.numerics.spectra import boundary_points, eigenvalues
from obsynth.observers.linear.observer import GRID_REACH, LinearObserver, frequency_grid
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plotting.panels import (
    PANEL_HEIGHT,
    WIDE_AXIS,
    WIDTH,
    new_panels,
    one_panel,
    plain_decades,
    tidy,
)
from obsynth.results.design import ObserverDesign

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@arguments_checked
def plot_trade_off(
    designs: Sequence[ObserverDesign], along: str, against: str | Sequence[str], *, axes: Iterable[Axes] | None = None
) -> list[Axes]:
    """Plot what several designs claim (or what was found in their reports) against one of their claims.

    Parameters
    ----------
    designs : sequence of ObserverDesign
        Such as designs of one plant with several values of an option.
    along : str
        Claim, check or numeric option on the horizontal axis, such as ``"decay"``.
    against : str or sequence of str
        Claims, checks or numeric options, one panel each, such as ``"noise_amplification"`` or
        ``"noise in fhat[valve]"``.
    axes : iterable of Axes, optional
        One for each of ``against``; new ones, one above the other, by default.

    Returns
    -------
    list of Axes
        One for each of ``against``; logarithmic where the values spread over more than a decade.

    Raises
    ------
    SpecError
        No design, or one that has no such number (the names that it has are listed).
    """
    if len(designs) == 0:
        raise SpecError("A trade-off needs designs: give at least one.", path="designs")
    names = [against] if isinstance(against, str) else list(against)
    panels = new_panels(axes, len(names), size=(WIDTH, PANEL_HEIGHT * len(names) + 1.2))
    x = np.array([_number(design, along) for design in designs])
    order = np.argsort(x, kind="stable")
    for panel, name in zip(panels, names, strict=True):
        y = np.array([_number(design, name) for design in designs])
        panel.plot(x[order], y[order], color="black", linewidth=1.2, marker="o", markersize=5)
        for values in (x, y):
            if values.min() > 0.0 and values.max() > WIDE_AXIS * values.min():
                plain_decades(panel, across=values is x)
        panel.set_ylabel(name)
        tidy(panel)
        panel.margins(x=0.03)
    if panels:
        panels[-1].set_xlabel(along)
    return panels


def _number(design: ObserverDesign, name: str) -> float:
    claims, checks = design.certificate.claims, {check.name: check.value for check in design.report.checks}
    options = {key: float(value) for key, value in design.options.items() if is_number(value)}
    for source in (claims, checks, options):
        if name in source:
            return float(source[name])
    raise SpecError(
        f"Design {design.name!r} has no {name!r}: its claims are {', '.join(claims) or 'none'}; names of checks and "
        f"numeric options ({', '.join(options) or 'none'}) go too.",
        path=name,
    )


#: Inches: height of the picture of a sweep.
SWEEP_HEIGHT = 4.2
#: A ratio of the largest to the smallest value above which an axis is logarithmic.
LOGARITHMIC = 100.0
#: Markers of lines, in turn, and of cases without a design, by what they came to.
MARKERS = "osD^vP*Xh"
FAILED = {"impossible": "x", "infeasible": "+", "unknown": "1", "unverified": "2", "malformed": "|"}
#: At most so many lines get an entry of their own in the legend.
MOST_LINES = 8


def plot_sweep(results: Sequence[Any], claim: str | None = None, *, parameter: str | None = None) -> Figure:
    """Draw a claim of every case over a parameter, one line for each combination of the others."""
    import matplotlib.pyplot as plt

    claim = _claim(results, claim)
    along = _parameter(results, parameter)
    figure, panel = plt.subplots(figsize=(WIDTH, SWEEP_HEIGHT), layout="constrained")
    lines: dict[str, list[tuple[float, Any]]] = {}
    for number, result in enumerate(results, 1):
        place = float(number) if along is None else float(result.parameters[along])
        lines.setdefault("" if along is None else _others(result, along), []).append((place, result))
    for number, (label, points) in enumerate(lines.items()):
        points.sort(key=lambda point: point[0])
        panel.plot(
            [place for place, _ in points],
            [result.claims.get(claim, np.nan) for _, result in points],
            linewidth=1.0,
            marker=MARKERS[number % len(MARKERS)],
            markersize=4,
            label=label if label and number < MOST_LINES else None,
        )
    # Cases without a design are marked at the lower edge, by what they came to.
    for status, marker in FAILED.items():
        places = [place for points in lines.values() for place, result in points if result.status == status]
        if places:
            panel.plot(
                places,
                [0.03] * len(places),
                marker,
                color="tab:red",
                markersize=8,
                clip_on=False,
                transform=panel.get_xaxis_transform(),
                label=f"{status}: {len(places)}",
            )
    values = [result.claims[claim] for result in results if claim in result.claims]
    if _spread(values):
        panel.set_yscale("log")
    if along is not None and _spread([place for points in lines.values() for place, _ in points]):
        panel.set_xscale("log")
    panel.set_xlabel("case" if along is None else along)
    panel.set_ylabel(claim)
    tidy(panel)
    if panel.get_legend_handles_labels()[1]:
        panel.legend(frameon=False, fontsize="small")
    return figure


def _claim(results: Sequence[Any], claim: str | None) -> str:
    counts: Counter[str] = Counter(name for result in results for name in result.claims)
    if claim is None and counts:
        return max(counts, key=lambda name: counts[name])
    if claim is None or claim not in counts:
        known = ", ".join(counts) or "none"
        raise SpecError(f"No design of the sweep claims {claim!r}; there are: {known}.", path="claim")
    return claim


def _parameter(results: Sequence[Any], parameter: str | None) -> str | None:
    numbers = {}
    for name in {name for result in results for name in result.parameters}:
        values = [result.parameters.get(name) for result in results]
        if all(is_number(value) for value in values):
            numbers[name] = len(set(values))
    if parameter is not None and parameter not in numbers:
        known = ", ".join(numbers) or "none"
        raise SpecError(f"{parameter!r} is no number that was varied; there are: {known}.", path="parameter")
    varied = {name: count for name, count in numbers.items() if count > 1}
    return parameter or max(sorted(varied), key=lambda name: varied[name], default=None)


def _others(result: Any, along: str) -> str:
    stem = result.name.partition(",")[0]
    said = [f"{name.rpartition('.')[2]} = {value}" for name, value in result.parameters.items() if name != along]
    return ", ".join([stem, *said])


def _spread(values: list[float]) -> bool:
    positive = [value for value in values if value > 0.0]
    return len(positive) == len(values) > 1 and max(positive) >= LOGARITHMIC * min(positive)


#: From this ratio of the fastest to the slowest part on, axes are logarithmic away from zero.
WIDE_RATES = 30.0
#: Points of the grid on which a region is found, each way.
REGION_GRID = 400
_LIMIT: dict[str, Any] = {"color": "0.45", "linewidth": 1.0, "linestyle": "--"}
_REGION_EDGE: dict[str, Any] = {"color": "tab:green", "linewidth": 1.4, "linestyle": "-."}
_REGION_SHADE = "0.93"
_POLE_MARKS: dict[str, Any] = {
    "marker": "x",
    "markersize": 9,
    "markeredgewidth": 1.6,
    "linestyle": "none",
    "color": "black",
    "zorder": 3,
}
_ZEROS: dict[str, Any] = {
    "marker": "o",
    "markersize": 9,
    "markeredgewidth": 1.6,
    "linestyle": "none",
    "color": "tab:red",
    "markerfacecolor": "none",
    "zorder": 3,
}
#: How far a complex number is outside of a part of the region: negative inside.
Excess = Callable[[ComplexArray], FloatArray]


@arguments_checked
def plot_poles(design: ObserverDesign, *, axes: Axes | None = None) -> Axes:
    """Plot the observer's eigenvalues and the plant's fault zeros, the limit of stability, and the region asked for.

    Parameters
    ----------
    design : ObserverDesign
        Of a linear method, either time.
    axes : Axes, optional
        New ones by default.

    Returns
    -------
    Axes
        The complex plane: with the unit circle in discrete time; in 1/s with the imaginary axis in continuous time,
        logarithmic away from zero where the eigenvalues spread widely.

    Raises
    ------
    SpecError
        The design is recursive.
    """
    plant, observer = design.linear
    sampled = observer.dt > 0.0
    axes = one_panel(axes, size=(5.0, 5.4) if sampled else (WIDTH, 4.4))
    poles = np.asarray(eigenvalues(observer.Az), dtype=complex)
    zeros = np.array([zero.value for zero in fault_zeros(plant)[0]], dtype=complex)
    axes.axhline(0.0, color="0.85", linewidth=0.8, zorder=0)
    if sampled:
        _discrete_plane(axes, poles, zeros)
    else:
        _continuous_plane(axes, poles, zeros)
    _draw_region(axes, region_asked_for(design))
    axes.plot(poles.real, poles.imag, label=f"observer eigenvalues ({len(poles)})", **_POLE_MARKS)
    axes.plot(zeros.real, zeros.imag, label=f"fault zeros ({len(zeros)})", **_ZEROS)
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2, frameon=False)
    return axes


def _discrete_plane(axes: Axes, poles: ComplexArray, zeros: ComplexArray) -> None:
    circle = np.exp(2j * np.pi * np.linspace(0.0, 1.0, 361))
    axes.plot(circle.real, circle.imag, label="unit circle", **_LIMIT)
    axes.axvline(0.0, color="0.85", linewidth=0.8, zorder=0)
    axes.set_aspect("equal")
    reach = 1.1 * max(1.05, float(np.max(np.abs(np.concatenate([poles, zeros])), initial=0.0)))
    axes.set_xlim(-reach, reach)
    axes.set_ylim(-reach, reach)
    axes.set_xlabel("real part")
    axes.set_ylabel("imaginary part")


def _continuous_plane(axes: Axes, poles: ComplexArray, zeros: ComplexArray) -> None:
    axes.axvline(0.0, label="limit of stability", **_LIMIT)
    shown = np.concatenate([poles, zeros])
    for values, scale, limits in (
        (shown.real, axes.set_xscale, axes.set_xlim),
        (shown.imag, axes.set_yscale, axes.set_ylim),
    ):
        sizes = np.abs(values)
        alive = sizes[sizes > np.finfo(np.float64).eps * np.max(np.abs(shown), initial=0.0)]
        if not alive.size:
            limits(-1.0, 1.0)
        elif alive.max() > WIDE_RATES * alive.min():
            scale("symlog", linthresh=float(alive.min()))
            limits(*(side * 3.0 * float(max(np.max(side * values), alive.min())) for side in (-1.0, 1.0)))
        else:
            reach = 0.15 * float(alive.max())
            limits(float(min(np.min(values), 0.0)) - reach, float(max(np.max(values), 0.0)) + reach)
    axes.set_xlabel("real part (1/s)")
    axes.set_ylabel("imaginary part (1/s)")


def region_asked_for(design: ObserverDesign) -> list[Excess]:
    """Return the parts of the region that was asked for (or imposed and proved); none where none was."""
    claims, options, dt = design.certificate.claims, design.options, design.linear[1].dt
    asked = options.get("region") or {}
    asked = dict(asked) if isinstance(asked, Mapping) else {}
    decay = asked.get("decay") or options.get("decay") or 0.0
    if design.method in REGISTRY and "decay" in method_class(design.method).imposed:
        decay = claims.get("decay", 0.0)
    parts: list[Excess] = []
    if decay and dt > 0.0:
        parts.append(lambda z: np.abs(z) - np.exp(-decay * dt))
    elif decay:
        parts.append(lambda s: s.real + decay)
    if asked.get("radius"):
        parts.append(lambda s: np.abs(s) - asked["radius"])
    if asked.get("damping"):
        parts.append(lambda s: asked["damping"] * np.abs(s) + s.real)
    if "disk_radius" in claims:
        parts.append(lambda s: np.abs(s + claims["disk_centre"]) - claims["disk_radius"])
    return parts


def _draw_region(axes: Axes, parts: list[Excess]) -> None:
    """Shade where all parts hold, within the limits of the axes, on whatever scale they have."""
    if not parts:
        return
    scales = axes.xaxis.get_transform(), axes.yaxis.get_transform()
    x, y = (_grid(scale, limits) for scale, limits in zip(scales, (axes.get_xlim(), axes.get_ylim()), strict=True))
    plane = x[None, :] + 1j * y[:, None]
    excess = np.max([part(plane) for part in parts], axis=0)
    axes.contourf(x, y, excess, levels=[-np.inf, 0.0], colors=[_REGION_SHADE], zorder=-1)
    if excess.min() < 0.0 < excess.max():
        axes.contour(
            x,
            y,
            excess,
            levels=[0.0],
            colors=[_REGION_EDGE["color"]],
            linestyles=[_REGION_EDGE["linestyle"]],
            linewidths=[_REGION_EDGE["linewidth"]],
            zorder=1,
        )
    axes.plot([], [], label="region asked for", **_REGION_EDGE)


def _grid(scale: Any, limits: tuple[float, float]) -> FloatArray:
    """Return points that are evenly spaced on a scale."""
    low, high = scale.transform(np.array(limits))
    return np.asarray(scale.inverted().transform(np.linspace(float(low), float(high), REGION_GRID)))


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
    """
    plant, observer = design.linear
    chosen(to, "to", tuple(TARGETS))
    rows = {"faults": observer.fault_rows, "states": observer.state_rows, "residuals": observer.residual_rows}[to]
    if rows.start == rows.stop:
        what = "estimates no faults" if to == "faults" else f"has no {to}"
        raise SpecError(f"The design {what}.", path="observer")
    frequencies, points, to_estimate = _over_frequencies(observer, rows)
    inputs = {"faults": (plant.Bf, plant.Df), "disturbances": (plant.Bd, plant.Dd), "noise": (plant.Bw, plant.Dw)}
    gains: dict[str, FloatArray] = {}
    least: FloatArray = np.zeros(len(points))
    for name, (b, d) in inputs.items():
        if not b.shape[1]:
            continue
        states, seen, terms = _seen(plant, b, d, points, to_estimate)
        if to == "states":
            truth = _delayed(observer, points) * states
            seen, terms = seen - truth, terms + _sizes(truth)
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
    frequencies, points, to_estimate = _over_frequencies(observer, observer.fault_rows)
    disturbance_gains = np.zeros((len(observer.fault_names), plant.nd))
    if plant.nd:
        found = _disturbance_gains(plant, points, to_estimate)
        # A peak lies between the frequencies of the grid: beside the largest gains they are looked at closely.
        top = frequencies[-1] * (GRID_REACH if observer.dt == 0.0 else 1.0)
        sides = np.concatenate([frequencies[:1] / GRID_REACH, frequencies, [top]])
        peaks = np.unique(found.argmax(axis=0))
        near = np.concatenate([np.geomspace(sides[k], sides[k + 2], POINTS_OF_A_PEAK) for k in peaks])
        closely = _disturbance_gains(plant, *_at_frequencies(observer, observer.fault_rows, near))
        disturbance_gains = np.maximum(found.max(axis=0), closely.max(axis=0))
    own = [plant.fault_names.index(name) for name in observer.fault_names]
    _, slowest, _ = _seen(plant, plant.Bf, plant.Df, points, to_estimate)
    steady = slowest[0].real[np.arange(len(own)), own]
    return FaultGains(disturbance_gains, np.asarray(steady))


def _disturbance_gains(plant: DescriptorSystem, points: ComplexArray, to_estimate: ComplexArray) -> FloatArray:
    """Return gains from each unknown input to each fault estimate ``(k, nf, nd)``."""
    _, found, terms = _seen(plant, plant.Bd, plant.Dd, points, to_estimate)
    return _above_rounding(np.abs(found), terms[:, None, None])


def _over_frequencies(observer: LinearObserver, rows: slice) -> tuple[FloatArray, ComplexArray, ComplexArray]:
    """Return frequencies (rad/s), their points on the boundary, and what some outputs make of y there."""
    frequencies = frequency_grid(observer)[1:]
    return frequencies, *_at_frequencies(observer, rows, frequencies)


def _at_frequencies(
    observer: LinearObserver, rows: slice, frequencies: FloatArray
) -> tuple[ComplexArray, ComplexArray]:
    """Return the points on the boundary of some frequencies (rad/s), and what some outputs make of y there."""
    points = boundary_points(frequencies, observer.dt)
    return points, response(observer.Az, observer.By, observer.Cz[rows], observer.Dy[rows], points)


def _seen(
    plant: DescriptorSystem, b: FloatArray, d: FloatArray, points: ComplexArray, to_estimate: ComplexArray
) -> tuple[ComplexArray, ComplexArray, FloatArray]:
    """Return the states that an input drives, what the outputs show of it, and the size of the terms of that."""
    states = _state_response(plant, b, points)
    outputs = plant.C @ states + d
    return states, np.asarray(to_estimate @ outputs), _sizes(to_estimate) * _sizes(outputs)


def _above_rounding(sizes: Any, terms: FloatArray) -> FloatArray:
    """Return sizes, and zero where only the rounding of terms is left."""
    return np.asarray(np.where(sizes > GAIN_ROUNDING_SHARE * terms, sizes, 0.0), dtype=np.float64)


def _sizes(matrices: ComplexArray) -> FloatArray:
    return np.asarray(np.linalg.norm(matrices, axis=(1, 2)))


def _delayed(observer: LinearObserver, points: ComplexArray) -> ComplexArray:
    """Return what a known delay makes of each state, ``(k, nx, 1)``."""
    delays = np.array(observer.state_delays, dtype=float)
    return np.asarray(points[:, None, None] ** -delays[None, :, None])


def _state_response(plant: DescriptorSystem, b: FloatArray, points: ComplexArray) -> ComplexArray:
    """Return a state for each input: of a plant that is not regular one of many, which its estimates cannot tell."""
    if regularity_of(plant)[0]:
        try:
            return np.concatenate([*resolved(plant.E, plant.A, b, points)])
        except np.linalg.LinAlgError:
            pass  # beside an integrator a low frequency is lost in rounding
    return np.stack([_least_state(point * plant.E - plant.A, b) for point in points])


def _least_state(pencil: ComplexArray, b: FloatArray) -> ComplexArray:
    """Return the least ``x`` with ``pencil x = b``, where each row and column has a size near one."""
    nx = pencil.shape[1]
    scaled, columns = equilibrated(np.hstack([pencil, b]))
    found = np.linalg.pinv(scaled[:, :nx], rcond=RANK_TOLERANCE) @ scaled[:, nx:]
    return np.asarray(columns[:nx, None] * found / columns[nx:])


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
    """
    found, target = estimate_gains(design, to=to), TARGETS.get(to, "")
    panel = one_panel(axes, size=(WIDTH, 4.0))
    if to == "faults":
        panel.axhline(1.0, color="0.7", linewidth=0.8, zorder=0)
    for name, gain in found.gains.items():
        if np.any(gain > 0.0):
            ending = "" if np.all(gain > 0.0) else " (elsewhere only rounding)"
            panel.plot(found.frequencies, _positive(gain), label=f"{name} to {target}{ending}", **_STYLES[name])
        else:
            panel.plot([], [], label=f"{name}: zero gain", **_STYLES[name])
    largest = found.gains.get("faults", found.least)
    if to != "states" and np.any(found.least < VISIBLE_SHARE * largest):
        panel.plot(found.frequencies, _positive(found.least), label="faults, least singular value", **_LEAST_LINE)
    gamma = design.certificate.claims.get("gamma")
    if to == "faults" and gamma is not None and "disturbances" in found.gains:
        panel.plot(found.frequencies[[0, -1]], [gamma, gamma], label=f"proved for disturbances: {gamma:.4g}", **_BOUND)
    plain_decades(panel)
    plain_decades(panel, across=True)
    panel.set_xlabel("frequency (rad/s)")
    panel.set_ylabel("singular value")
    if found.gains:
        panel.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2, frameon=False)
    else:
        panel.set_title("The plant states no faults, disturbances or noise.")
    tidy(panel)
    return panel


def _positive(gain: FloatArray) -> FloatArray:
    return np.where(gain > 0.0, gain, np.nan)

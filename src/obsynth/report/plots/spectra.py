"""Plot of an observer's eigenvalues in the complex plane, with the limit of stability and the requested region."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.ticker import NullLocator

from obsynth.analysis.zeros import fault_zeros
from obsynth.methods.registry import REGISTRY, method_class
from obsynth.numerics.arguments import arguments_checked
from obsynth.numerics.arrays import ComplexArray, FloatArray
from obsynth.numerics.spectra import eigenvalues
from obsynth.report.plots.panels import WIDTH, one_panel
from obsynth.results.design import ObserverDesign

if TYPE_CHECKING:
    from matplotlib.axes import Axes


#: Axes are logarithmic away from zero where real or imaginary parts differ by more than this factor.
WIDE_RATES = 30.0

#: Points in each direction of the grid on which a region is evaluated.
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

#: A function that is positive for complex numbers outside a part of the region, and negative inside.
Excess = Callable[[ComplexArray], FloatArray]

#: Damping ratios of the lines behind the poles, and the natural frequencies along these lines: many decades in 1/s, or
#: rad per sample for sampled poles.
DAMPING_RATIOS = (0.2, 0.4, 0.6, 0.8)
RATES = np.concatenate([[0.0], np.geomspace(1e-9, 1e9, 400)])
RATES_PER_SAMPLE = np.linspace(0.0, np.pi, 200)

#: Least distance between labels of these lines, as a share of the axes, so that they do not overlap.
LABELS_APART = 0.04

#: Most ticks of a logarithmic axis, on both sides of zero together.
MOST_DECADE_TICKS = 7


@arguments_checked
def plot_poles(design: ObserverDesign, *, axes: Axes | None = None) -> Axes:
    """Plot the observer's eigenvalues, the plant's fault zeros, the limit of stability, and the requested region.

    Parameters
    ----------
    design : ObserverDesign
        A design with a linear observer, in discrete or continuous time.
    axes : Axes, optional
        Where to plot; by default new axes.

    Returns
    -------
    Axes
        The complex plane, with the unit circle in discrete time, or in 1/s with the imaginary axis in continuous time.
        Where the eigenvalues differ by decades, the scale is logarithmic away from zero.

    Raises
    ------
    SpecError
        The design is recursive.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]], C=[[1, 0], [0, 1]], Bf=[[1], [0]], Bd=[[0], [1]], dt=1.0
    ... )
    >>> design = obsynth.ui_pi_observer(plant, decay=0.5)
    >>> obsynth.plotting.plot_poles(design).get_xlabel()
    'real part'
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
    if zeros.size:
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
    _damping_grid(axes, sampled=True)
    axes.set_xlabel("real part")
    axes.set_ylabel("imaginary part")


def _continuous_plane(axes: Axes, poles: ComplexArray, zeros: ComplexArray) -> None:
    from matplotlib.ticker import SymmetricalLogLocator

    axes.axvline(0.0, label="limit of stability", **_LIMIT)
    points = np.concatenate([poles, zeros])
    for values, scale, limits in (
        (points.real, axes.set_xscale, axes.set_xlim),
        (points.imag, axes.set_yscale, axes.set_ylim),
    ):
        sizes = np.abs(values)
        nonzero = sizes[sizes > np.finfo(np.float64).eps * np.max(np.abs(points), initial=0.0)]
        if not nonzero.size:
            # As wide as the other axis, since lines of equal damping would coincide in a flat picture.
            reach = 0.5 * float(np.max(np.abs(points), initial=0.0)) or 1.0
            limits(-reach, reach)
        elif nonzero.max() > WIDE_RATES * nonzero.min():
            linear = float(nonzero.min())
            scale("symlog", linthresh=linear)
            axis = axes.xaxis if scale == axes.set_xscale else axes.yaxis
            # Ticks at powers of ten outside the linear part, within which they would overlap.
            locator = SymmetricalLogLocator(base=10.0, linthresh=10.0 ** np.ceil(np.log10(linear)))
            locator.set_params(numticks=MOST_DECADE_TICKS)
            axis.set_major_locator(locator)
            axis.set_minor_locator(NullLocator())
            limits(*(side * 3.0 * float(max(np.max(side * values), nonzero.min())) for side in (-1.0, 1.0)))
        else:
            reach = 0.15 * float(nonzero.max())
            limits(float(min(np.min(values), 0.0)) - reach, float(max(np.max(values), 0.0)) + reach)
    _damping_grid(axes, sampled=False)
    axes.set_xlabel("real part (1/s)")
    axes.set_ylabel("imaginary part (1/s)")


def _damping_grid(axes: Axes, *, sampled: bool) -> None:
    """Draw labelled lines of equal damping ratio within the limits of the axes."""
    limits = axes.get_xlim(), axes.get_ylim()
    labelled: list[FloatArray] = []
    for ratio in DAMPING_RATIOS:
        pole = -ratio + 1j * np.sqrt(1.0 - ratio**2)
        line = np.exp(RATES_PER_SAMPLE / pole.imag * pole) if sampled else RATES * pole
        for side in (line, line.conj()):
            axes.plot(side.real, side.imag, color="0.85", linewidth=0.7, zorder=0)
        inside = (line.real > limits[0][0]) & (line.real < limits[0][1]) & (line.imag < limits[1][1])
        if inside.any():
            place = line[np.flatnonzero(inside)[len(line) // 3 if sampled else -1]]
            at = axes.transAxes.inverted().transform(axes.transData.transform((place.real, place.imag)))
            if any(np.abs(at - other).max() < LABELS_APART for other in labelled):
                continue
            labelled.append(at)
            axes.annotate(f"{ratio:g}", (place.real, place.imag), color="0.45", fontsize=7, ha="right", va="top")
    axes.plot([], [], color="0.75", linewidth=0.9, label="damping ratio")
    axes.set_xlim(*limits[0])
    axes.set_ylim(*limits[1])


def region_asked_for(design: ObserverDesign) -> list[Excess]:
    """Return the parts of the region of eigenvalues that the options request or the certificate claims, if any."""
    claims, options, dt = design.certificate.claims, design.options, design.linear[1].dt
    region = options.get("region") or {}
    region = dict(region) if isinstance(region, Mapping) else {}
    decay = region.get("decay") or options.get("decay") or 0.0
    if design.method in REGISTRY and "decay" in method_class(design.method).imposed:
        decay = claims.get("decay", 0.0)
    parts: list[Excess] = []
    if decay and dt > 0.0:
        parts.append(lambda z: np.abs(z) - np.exp(-decay * dt))
    elif decay:
        parts.append(lambda s: s.real + decay)
    if region.get("radius"):
        parts.append(lambda s: np.abs(s) - region["radius"])
    if region.get("damping"):
        parts.append(lambda s: region["damping"] * np.abs(s) + s.real)
    if "disk_radius" in claims:
        parts.append(lambda s: np.abs(s + claims["disk_centre"]) - claims["disk_radius"])
    return parts


def _draw_region(axes: Axes, parts: list[Excess]) -> None:
    """Shade the intersection of all parts within the limits of the axes, on a linear or logarithmic scale."""
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
    """Return points that are evenly spaced on the scale of an axis."""
    low, high = scale.transform(np.array(limits))
    return np.asarray(scale.inverted().transform(np.linspace(float(low), float(high), REGION_GRID)))

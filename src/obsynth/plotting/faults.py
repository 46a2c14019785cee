"""Fault estimates against faults, and residuals against thresholds."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from obsynth.errors import SpecError
from obsynth.numerics.arrays import FloatArray, as_matrix
from obsynth.observers.estimates import Estimates
from obsynth.plotting.panels import (
    ESTIMATE_STYLE,
    MARK_STYLE,
    RESIDUAL_STYLE,
    THRESHOLD_STYLES,
    TRUE_STYLE,
    legend_above,
    new_panels,
    tidy,
    with_unit,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

CROSSING_MARKERS = ("o", "s", "^")


def plot_faults(
    estimates: Estimates,
    *,
    faults: ArrayLike | None = None,
    dt: float = 1.0,
    units: Mapping[str, str] | None = None,
    axes: Iterable[Axes] | None = None,
) -> list[Axes]:
    """Plot each fault estimate, on the true fault delayed by its detectability index.

    Parameters
    ----------
    estimates : Estimates
        From a run of an observer; ``faults (steps, nf)``.
    faults : array_like, optional
        True faults ``(steps, nf)``, not delayed; a single one may be ``(steps,)``.
    dt : float, optional, seconds
        Time between samples.
    units : mapping, optional
        Unit of each fault by name, such as ``plant.units``.
    axes : iterable of Axes, optional
        One for each fault; new ones, one above the other, by default.

    Returns
    -------
    list of Axes
        One for each fault.

    Raises
    ------
    SpecError
        ``faults`` has the wrong shape, or there are too few or too many axes.
    """
    steps, count = estimates.faults.shape
    truth = None if faults is None else _matching(faults, "faults", (steps, count))
    panels = new_panels(axes, count)
    time = dt * np.arange(steps)
    for i, (panel, name, delay) in enumerate(zip(panels, estimates.fault_names, estimates.fault_delays, strict=True)):
        if truth is not None:
            label = f"fault, delayed by {_samples(delay)}" if delay else "fault"
            panel.plot(time[delay:], truth[: steps - delay, i], label=label, **TRUE_STYLE)
        panel.plot(time, estimates.faults[:, i], label="estimate", **ESTIMATE_STYLE)
        panel.set_ylabel(with_unit(name, units))
        legend_above(panel)
        tidy(panel)
    if panels:
        panels[-1].set_xlabel("time (s)")
    return panels


def plot_residuals(
    estimates: Estimates,
    *,
    threshold: ArrayLike | Mapping[str, ArrayLike] | None = None,
    dt: float = 1.0,
    axes: Axes | None = None,
) -> Axes:
    """Plot the norm of the residual, with thresholds and the first sample at which each is crossed.

    Parameters
    ----------
    estimates : Estimates
        From a run of an observer; ``residuals (steps, nr)``.
    threshold : array_like or mapping of str to array_like, optional
        A number or a curve ``(steps,)``, or up to three of them by name.
    dt : float, optional, seconds
        Time between samples.
    axes : Axes, optional
        New ones by default.

    Returns
    -------
    Axes
        With a vertical logarithmic scale, where a residual of exactly zero has no place; linear if all are zero.

    Raises
    ------
    SpecError
        A threshold has the wrong length, or there are more than three.
    """
    steps = len(estimates.residuals)
    if threshold is None:
        curves = {}
    else:
        named = threshold if isinstance(threshold, Mapping) else {"threshold": threshold}
        curves = {name: _curve(value, name, steps) for name, value in named.items()}
    if len(curves) > len(THRESHOLD_STYLES):
        raise SpecError(f"{len(curves)} thresholds are too many for one picture: give at most 3.", path="threshold")
    (panel,) = new_panels(None if axes is None else [axes], 1)
    time, size = dt * np.arange(steps), np.linalg.norm(estimates.residuals, axis=1)
    if np.any(size > 0.0):
        panel.set_yscale("log")
        panel.plot(time, np.where(size > 0.0, size, np.nan), label="norm of the residual", **RESIDUAL_STYLE)
    else:
        panel.plot(time, size, label="norm of the residual", **RESIDUAL_STYLE)
    for (name, curve), style, marker in zip(curves.items(), THRESHOLD_STYLES, CROSSING_MARKERS, strict=False):
        panel.plot(time, curve, label=name, **style)
        crossed = np.flatnonzero(size > curve)
        if crossed.size:
            first = int(crossed[0])
            panel.plot(
                time[first], size[first], marker=marker, color=style["color"],
                label=f"first above it at k = {first} ({time[first]:g} s)", **MARK_STYLE,
            )  # fmt: skip
    panel.set_ylabel("norm of the residual")
    panel.set_xlabel("time (s)")
    legend_above(panel)
    tidy(panel)
    return panel


def _matching(value: ArrayLike, name: str, shape: tuple[int, int]) -> FloatArray:
    array = np.asarray(value)
    matrix = as_matrix(array.reshape(-1, 1) if array.ndim == 1 and shape[1] == 1 else array, name)
    if matrix.shape != shape:
        raise SpecError(f"{name} is {matrix.shape[0]} by {matrix.shape[1]}, but {shape[0]} by {shape[1]} is needed "
                        "(samples by faults).", path=name)  # fmt: skip
    return matrix


def _curve(value: ArrayLike, name: str, steps: int) -> FloatArray:
    curve = np.asarray(value, dtype=np.float64)
    if curve.ndim and curve.shape != (steps,):
        raise SpecError(f"{name} needs one number, or {steps} of them: one for each sample.", path="threshold")
    return np.broadcast_to(curve, (steps,)).copy()


def _samples(count: int) -> str:
    return f"{count} sample" if count == 1 else f"{count} samples"

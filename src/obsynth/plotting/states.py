"""State and parameter estimates on the truth, with their confidence bands where the observer states them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from obsynth.errors import SpecError
from obsynth.numerics.arrays import FloatArray, as_matrix
from obsynth.observers.estimates import BAND_WIDTH, Estimates
from obsynth.plants.validation import index_of
from obsynth.plotting.panels import (
    BAND_STYLE,
    ESTIMATE_STYLE,
    TRUE_STYLE,
    legend_above,
    new_panels,
    tidy,
    with_unit,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Around what is drawn there is this share of its range, and room for this many usual half-widths of the band.
ROOM_SHARE, USUAL_BANDS = 0.2, 3.0


def plot_parameters(
    estimates: Estimates,
    *,
    parameters: ArrayLike | None = None,
    dt: float = 1.0,
    units: Mapping[str, str] | None = None,
    axes: Iterable[Axes] | None = None,
) -> list[Axes]:
    """Plot each parameter estimate with its 95 % band, on the true parameter.

    Parameters
    ----------
    estimates : Estimates
        From a run.
    parameters : array_like, optional
        True parameters ``(samples, nq)``; a single one may be ``(samples,)``.
    dt : float, optional, seconds
        Time between samples.
    units : mapping, optional
        Unit of each parameter by name.
    axes : iterable of Axes, optional
        One for each parameter; new ones, one above the other, by default.

    Returns
    -------
    list of Axes
        One for each parameter.

    Raises
    ------
    SpecError
        The true parameters have the wrong shape, or there are too few or too many axes.
    """
    names, count = estimates.parameter_names, len(estimates.parameter_names)
    true = _truth(parameters, estimates.parameters.shape)
    return _panels(
        estimates.parameters, estimates.parameter_deviations, names, true, (0,) * count, dt, units, range(count), axes
    )


def plot_states(
    estimates: Estimates,
    *,
    states: ArrayLike | None = None,
    names: Sequence[str] | None = None,
    dt: float = 1.0,
    units: Mapping[str, str] | None = None,
    axes: Iterable[Axes] | None = None,
) -> list[Axes]:
    """Plot each state estimate on the true state, delayed as the estimate is; recursive observers with a 95 % band.

    Parameters
    ----------
    estimates : Estimates
        From a run.  Where a state is undetermined there is no band.
    states : array_like, optional
        True states ``(samples, nx)``, not delayed.
    names : sequence of str, optional
        Which states, in this order; all by default.
    dt : float, optional, seconds
        Time between samples.
    units : mapping, optional
        Unit of each state by name.
    axes : iterable of Axes, optional
        One for each state shown; new ones, one above the other, by default.

    Returns
    -------
    list of Axes
        One for each state shown.

    Raises
    ------
    SpecError
        The true states have the wrong shape, a name is unknown, or there are too few or too many axes.
    """
    known = estimates.state_names
    chosen = range(len(known)) if names is None else [index_of(name, known, what="The estimates") for name in names]
    deviations = estimates.state_deviations if estimates.has_deviations else None
    true = _truth(states, estimates.states.shape)
    return _panels(estimates.states, deviations, known, true, estimates.state_delays, dt, units, chosen, axes)


def _truth(given: ArrayLike | None, shape: tuple[int, ...]) -> FloatArray | None:
    if given is None:
        return None
    raw = np.asarray(given)
    true = as_matrix(raw[:, None] if raw.ndim == 1 else raw, "true signals")
    if true.shape != shape:
        raise SpecError(f"The true signals have shape {true.shape}, but the estimates {shape}.", path="truth")
    return true


def _panels(
    values: FloatArray, deviations: FloatArray | None, names: tuple[str, ...], true: FloatArray | None,
    delays: Sequence[int], dt: float, units: Mapping[str, str] | None, chosen: Sequence[int],
    axes: Iterable[Axes] | None,
) -> list[Axes]:  # fmt: skip
    panels = new_panels(axes, len(chosen))
    time, steps = dt * np.arange(len(values)), len(values)
    for panel, i in zip(panels, chosen, strict=True):
        if true is not None:
            late = f"true, delayed by {delays[i]} sample{'s' * (delays[i] > 1)}" if delays[i] else "true"
            panel.plot(time[delays[i] :], true[: steps - delays[i], i], **TRUE_STYLE, label=late)
        if deviations is not None:
            half = np.where(np.isfinite(deviations[:, i]), BAND_WIDTH * deviations[:, i], np.nan)
            panel.fill_between(time, values[:, i] - half, values[:, i] + half, **BAND_STYLE, label="95 % band")
        panel.plot(time, values[:, i], **ESTIMATE_STYLE, label="estimate")
        panel.set_ylabel(with_unit(names[i], units))
        tidy(panel)
        if deviations is not None:
            _show_what_moves(panel, values[:, i] if true is None else np.hstack([values[:, i], true[:, i]]), half)
    if panels:
        legend_above(panels[0])
        panels[-1].set_xlabel("time (s)")
    return panels


def _show_what_moves(panel: Axes, drawn: FloatArray, half: FloatArray) -> None:
    """Let a wide band at the start, or where samples are missing, leave the picture: not what is in it vanish."""
    known = drawn[np.isfinite(drawn)]
    usual = half[np.isfinite(half)]
    if not known.size or not usual.size:
        return
    room = max(ROOM_SHARE * float(np.ptp(known)), USUAL_BANDS * float(np.median(usual)))
    if room > 0.0:
        panel.set_ylim(float(known.min()) - room, float(known.max()) + room)

"""Pictures of a design for a page: drawn without a window, held as text."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterator
from typing import NamedTuple

from obsynth.observers.linear import LinearObserver
from obsynth.plotting.frequency import plot_gains
from obsynth.plotting.spectra import plot_poles
from obsynth.results.design import ObserverDesign

#: Dots per inch: sharp on a screen that shows two for each pixel.
RESOLUTION = 160


class Picture(NamedTuple):
    """A picture in a page.

    Parameters
    ----------
    title : str
        What it shows.
    text : str
        The same for who cannot see it, and as a caption.
    source : str
        A data URL.
    wide : bool, optional
        Whether it takes a row of its own.
    """

    title: str
    text: str
    source: str
    wide: bool = False


def pictures_of(design: ObserverDesign) -> Iterator[Picture]:
    """Yield the pictures of a linear design; a recursive one, whose dynamics change with k, has none.

    Parameters
    ----------
    design : ObserverDesign
        Any design.

    Yields
    ------
    Picture
        Poles, and singular values over the frequency.
    """
    from matplotlib.figure import Figure

    if not isinstance(design.observer, LinearObserver):
        return
    sampled = design.observer.dt > 0.0
    if design.observer.order:
        figure = Figure(figsize=(5.0, 5.4) if sampled else (7.5, 4.0), layout="constrained")
        plot_poles(design, axes=figure.subplots())
        region = "inside the circle" if sampled else "left of the dashed line"
        yield Picture("Poles", f"Eigenvalues of the observer: it forgets its start where all are {region}.",
                      _data_url(figure))  # fmt: skip
    if design.observer.fault_names:
        figure = Figure(figsize=(7.5, 4.0), layout="constrained")
        plot_gains(design, axes=figure.subplots())
        yield Picture(
            "What reaches the fault estimates",
            "Largest singular values over the frequency: from the faults, where 1 is faithful, and from disturbances "
            "and noise, where less is better.", _data_url(figure),
        )  # fmt: skip


def _data_url(figure: object) -> str:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=RESOLUTION)  # type: ignore[attr-defined]
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")

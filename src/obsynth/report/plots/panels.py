"""Plot panels one above the other, with line styles that differ by more than colour, for print."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from textwrap import fill
from typing import TYPE_CHECKING, Any

import numpy as np

from obsynth.errors import SpecError

if TYPE_CHECKING:
    from datetime import tzinfo

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


#: Inches: the width of every figure, and the height of one panel.
WIDTH = 7.5

PANEL_HEIGHT = 2.2

#: Dots per inch of a picture made of dots: sharp on a screen that shows two for each pixel.
RESOLUTION = 160

#: Okabe and Ito's colours, which most eyes that see no red distinguish, with the two brightest made darker: each has a
#: contrast of 3 to 1 with white. Black is left for the truth.
LINE_COLOURS = ("#0072B2", "#D55E00", "#008F66", "#A3478A", "#8A6200", "#5B6770")

#: In every picture the truth is black and solid, an estimate coloured, an interval shaded, a threshold dashed.  The
#: estimate is thinner, and lighter in print, so that it is seen on the truth.
TRUE_STYLE: dict[str, Any] = {"color": "black", "linewidth": 2.6, "linestyle": "-", "solid_capstyle": "butt"}

ESTIMATE_STYLE: dict[str, Any] = {"color": "#D55E00", "linewidth": 1.2, "linestyle": "-", "zorder": 2.2}

MEASURED_STYLE: dict[str, Any] = {"color": "0.55", "linewidth": 2.4, "linestyle": "-", "solid_capstyle": "butt"}

RESIDUAL_STYLE: dict[str, Any] = {"color": "#0072B2", "linewidth": 1.0, "linestyle": "-"}

BAND_STYLE: dict[str, Any] = {"color": "#D55E00", "alpha": 0.22, "linewidth": 0.0}

#: An interval that the data contradict.
CONTRADICTED_STYLE: dict[str, Any] = {"facecolor": "none", "edgecolor": "0.6", "hatch": "////", "linewidth": 0.0}

#: One line style for each threshold, in order.
THRESHOLD_STYLES: tuple[dict[str, Any], ...] = (
    {"color": "#B2182B", "linewidth": 1.6, "linestyle": "--"},
    {"color": "#5E3C99", "linewidth": 1.6, "linestyle": "-."},
    {"color": "#00695C", "linewidth": 1.6, "linestyle": ":"},
)

#: A line in a legend is this wide at least.
LEGEND_LINE = 1.2

#: A ring where something happens.
MARK_STYLE: dict[str, Any] = {
    "markersize": 9,
    "markerfacecolor": "none",
    "markeredgewidth": 1.6,
    "linestyle": "none",
}

#: Units of a long time: its name, its seconds, and how many of it a record is longer than that is drawn in it.
LONG_UNITS = (("d", 86400, 4), ("h", 3600, 3), ("min", 60, 10))

#: Share of a panel's height, with the room below it, that a line beside it may take: longer names are broken.
LABEL_SHARE = 0.9

#: Letters of small print that fit in an inch, and those that the sample of a line takes.
LETTERS_PER_INCH, KEY_LETTERS = 12.5, 8

#: From this ratio of largest to smallest on, an axis is logarithmic.
WIDE_AXIS = 10.0

#: Up to this ratio of largest to smallest, a logarithmic axis has plain numbers.
SHORT_SPREAD = 300.0

#: Signals whose ranges differ by this factor, and whose units nobody states, are not compared.
UNLIKE_RANGES = 100.0


def new_panels(axes: Iterable[Axes] | None, count: int, *, size: tuple[float, float] | None = None) -> list[Axes]:
    """Return ``count`` axes: the given ones, or new ones one above the other."""
    if axes is not None:
        panels = list(np.ravel(np.asarray(axes, dtype=object)))
        if len(panels) != count:
            raise SpecError(f"{len(panels)} axes were given, but {count} are needed.", path="axes")
        return panels
    return new_figure(count, size=size)[1] if count else []


def new_figure(
    count: int, *, size: tuple[float, float] | None = None, heights: Sequence[float] | None = None
) -> tuple[Figure, list[Axes]]:
    """Return a figure of panels one above the other, which share their horizontal axis unless heights are given."""
    import matplotlib.pyplot as plt

    figure, grid = plt.subplots(
        count,
        1,
        sharex=heights is None,
        squeeze=False,
        layout="constrained",
        figsize=size or (WIDTH, PANEL_HEIGHT * count + 0.8),
        height_ratios=heights,
    )
    figure.align_ylabels(grid[:, 0])
    return figure, list(grid[:, 0])


def image_of(
    count: int, draw: Callable[[list[Axes]], Any], *, size: tuple[float, float] | None = None, kind: str = "png"
) -> bytes:
    """Return the bytes of a picture of panels one above the other; ``draw`` fills them, without a window."""
    from matplotlib.figure import Figure

    panels = max(count, 1)
    figure = Figure(figsize=size or (WIDTH, PANEL_HEIGHT * panels + 0.6), layout="constrained")
    axes = list(figure.subplots(panels, 1, sharex=True, squeeze=False)[:, 0])
    figure.align_ylabels(axes)
    draw(axes[:count])
    return written(figure, kind=kind)


def written(figure: Figure, *, kind: str = "png") -> bytes:
    """Return the bytes of a figure's file."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    for panel in figure.axes:
        names_as_they_are(panel)
    buffer = io.BytesIO()
    if kind == "png":
        # What `savefig` does without a pass of its own for the layout, which drawing finds as well.
        figure.dpi = RESOLUTION
        canvas: Any = FigureCanvasAgg(figure)
        canvas.print_png(buffer)
    else:
        # Without a date the same data give the same picture.
        undated = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}.get(kind)
        figure.savefig(buffer, format=kind, dpi=RESOLUTION, metadata=undated)
    return buffer.getvalue()


def data_url(picture: bytes) -> str:
    """Return a picture of dots as a page holds it."""
    return f"data:image/png;base64,{base64.b64encode(picture).decode('ascii')}"


def tidy(panel: Axes) -> None:
    """Give a panel a faint grid and no box."""
    panel.grid(True, color="0.9", linewidth=0.6)
    panel.set_axisbelow(True)
    for side in ("top", "right"):
        panel.spines[side].set_visible(False)
    panel.margins(x=0.01)
    if "\n" not in (label := panel.get_ylabel()):
        panel.set_ylabel(fill(label, _letters_beside(panel), break_long_words=False))
    # A factor such as 1e-5 stands at the right: at the left is the legend.
    panel.yaxis.set_offset_position("right")
    names_as_they_are(panel)


def _letters_beside(panel: Axes) -> int:
    """Return how many letters a line beside a panel may have."""
    place = panel.get_subplotspec()
    rows = place.get_gridspec().nrows if place is not None else 1
    height = panel.figure.bbox.height / panel.figure.dpi
    return int(LABEL_SHARE * LETTERS_PER_INCH * height / rows)


def one_panel(axes: Axes | None, *, size: tuple[float, float] | None = None) -> Axes:
    """Return the axes that are given, or new ones."""
    return axes if axes is not None else new_panels(None, 1, size=size)[0]


def finish(panel: Axes, label: str, *, below: str = "") -> Axes:
    """Label the axes of a panel over the time, or over what is told ``below``; give it a legend and a grid."""
    panel.set_ylabel(label)
    if below:
        panel.set_xlabel(below)
    else:
        label_time(panel)
    legend_above(panel)
    tidy(panel)
    return panel


def label_time(panel: Axes) -> None:
    """Label the axis of a panel over the time in seconds, in minutes, hours or days where it is long."""
    from matplotlib.ticker import FuncFormatter, MaxNLocator, MultipleLocator

    begin, end = panel.get_xlim()
    fitting = ((unit, seconds) for unit, seconds, many in LONG_UNITS if end - begin > many * seconds)
    unit, seconds = next(fitting, ("s", 1))
    panel.set_xlabel(f"time ({unit})")
    if seconds > 1:
        ticks = MaxNLocator(nbins=6, steps=[1, 2, 3, 5, 6, 10]).tick_values(begin / seconds, end / seconds)
        panel.xaxis.set_major_locator(MultipleLocator(seconds * (ticks[1] - ticks[0])))
        panel.xaxis.set_major_formatter(FuncFormatter(lambda time, _: f"{time / seconds:g}"))


def mark(panel: Axes, time: Any, value: Any, label: str, *, marker: str = "o", color: str = "black") -> None:
    """Draw a ring where something happens."""
    panel.plot([time], [value], marker=marker, color=color, label=label, **MARK_STYLE)


def names_as_they_are(panel: Axes) -> None:
    """Show dollars in names as dollars: two of them would begin and end a formula, which most names are not."""
    legend = panel.get_legend()
    for text in (panel.title, panel.xaxis.label, panel.yaxis.label, *(legend.get_texts() if legend else ())):
        text.set_parse_math(False)


def legend_above(panel: Axes) -> None:
    """Put the legend above a panel, where it hides nothing: in as few lines as fit its width."""
    _, labels = panel.get_legend_handles_labels()
    figure = panel.get_figure()
    # Of a part of a figure the whole has the width.
    inches = panel.get_position().width * (WIDTH if figure is None else float(figure.figure.get_figwidth()))
    columns = max(len(labels), 1)
    while columns > 1 and _letters(labels, columns) > inches * LETTERS_PER_INCH:
        columns -= 1
    legend = panel.legend(
        loc="lower left",
        bbox_to_anchor=(0.0, 1.0),
        ncols=columns,
        frameon=False,
        fontsize="small",
        borderaxespad=0.1,
        columnspacing=1.4,
        handlelength=2.4,
    )
    for handle in legend.get_lines():
        # Thin and pale lines that are many fill a band; alone in a legend they could not be seen.
        if handle.get_linestyle() != "None":
            handle.set(alpha=1.0, linewidth=max(float(handle.get_linewidth()), LEGEND_LINE))
    names_as_they_are(panel)


def _letters(labels: Sequence[str], columns: int) -> int:
    """Return how wide a legend is: matplotlib fills it column by column, the first ones with one more."""
    rows, longer = divmod(len(labels), columns)
    widths, begin = 0, 0
    for column in range(columns):
        end = begin + rows + (column < longer)
        widths += max(map(len, labels[begin:end]), default=0) + KEY_LETTERS
        begin = end
    return widths


def short_dates(panel: Axes, zone: tzinfo | None) -> None:
    """Write dates on the horizontal axis in the zone of the log, which its label names; what they share stands at its
    end."""
    from matplotlib.dates import AutoDateLocator, ConciseDateFormatter

    make_locator: Any = AutoDateLocator
    make_formatter: Any = ConciseDateFormatter
    locator = make_locator(tz=zone)
    panel.xaxis.set_major_locator(locator)
    panel.xaxis.set_major_formatter(make_formatter(locator, tz=zone))
    panel.set_xlabel("time" if zone is None else f"time ({zone})")


def share_scale(panels: Sequence[Axes], units: Sequence[str | None]) -> None:
    """Give panels of signals in one unit one scale, so that noise does not look as large as a fault.

    Signals without a stated unit share a scale where their ranges differ by less than `UNLIKE_RANGES`.
    """
    for unit in dict.fromkeys(units):
        alike = [panel for panel, own in zip(panels, units, strict=True) if own == unit]
        ranges = [panel.get_ylim() for panel in alike]
        spans = [high - low for low, high in ranges]
        if len(alike) < 2 or (not unit and max(spans) > UNLIKE_RANGES * min(spans)):
            continue
        for panel in alike:
            panel.set_ylim(min(low for low, _ in ranges), max(high for _, high in ranges))


def with_unit(name: str, units: Mapping[str, str] | None) -> str:
    """Return the name of a signal, with its unit where it has one; ``1`` is none."""
    unit = (units or {}).get(name)
    return f"{name} ({unit})" if unit and unit != "1" else name


def plain_decades(panel: Axes, *, across: bool = False) -> None:
    """Give an axis, vertical or ``across``, a logarithmic scale, with plain numbers at 1, 2 and 5 where it is short."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    lines = [np.asarray(line.get_ydata(), dtype=np.float64) for line in panel.get_lines()]
    # Across, a level that is drawn from one side to the other has no place.
    values = np.array(panel.dataLim.intervalx) if across else np.concatenate([np.zeros(0), *lines])
    values = values[np.isfinite(values) & (values > 0.0)]
    if not values.size:
        return  # nothing has a place on it, and matplotlib gives an axis without data limits below zero
    (panel.set_xscale if across else panel.set_yscale)("log")
    if values.max() > SHORT_SPREAD * values.min():
        return
    axis = panel.xaxis if across else panel.yaxis
    if not across:
        steps = np.ravel(np.outer(10.0 ** np.arange(-15, 16), (1.0, 2.0, 5.0)))
        below, above = steps[steps < values.min()], steps[steps > values.max()]
        panel.set_ylim(below[-1] if below.size else None, above[0] if above.size else None)
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_locator(NullLocator())

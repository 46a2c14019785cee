"""A design on one's own data: measured outputs, estimates with intervals, residuals, statistics and alarms."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from textwrap import fill
from typing import TYPE_CHECKING, Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.monitoring.alarms.events import CONTRADICTING
from obsynth.monitoring.logs.log_observer import DECIDING
from obsynth.monitoring.logs.run import DataRun
from obsynth.numerics.arguments import arguments_checked
from obsynth.observers.estimates import BAND_WIDTH
from obsynth.plants.noise import noise_words
from obsynth.report.plots.estimates import MODEL_BAND
from obsynth.report.plots.panels import (
    BAND_STYLE,
    CONTRADICTED_STYLE,
    ESTIMATE_STYLE,
    LINE_COLOURS,
    MEASURED_STYLE,
    PANEL_HEIGHT,
    RESIDUAL_STYLE,
    THRESHOLD_STYLES,
    WIDTH,
    label_time,
    legend_above,
    mark,
    new_panels,
    short_dates,
    tidy,
    with_unit,
)
from obsynth.results.design import ObserverDesign, unverified_mark
from obsynth.results.number_texts import number

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes


#: Kinds of panels, in their order.
PANELS = ("outputs", "faults", "residuals", "statistic", "shares")

#: Letters in a line of the sentence below a picture: what fits below panels of a page, in small print.
STATEMENT_LETTERS = 105

#: Signals of a kind that are drawn.
MOST_DRAWN = 6

#: A statistic this many times above its threshold gets a logarithmic axis.
_FAR_ABOVE = 30.0

#: The initial-condition response leaves the picture where the range with it is this many times that of decided rows.
HIDING = 8.0

#: Rows in which nothing is decided lie in grey, those with an alarm in red.
_UNDECIDED_ROWS: dict[str, Any] = {"color": "0.9", "linewidth": 0.0, "zorder": 0}

_ALARM: dict[str, Any] = {"color": "tab:red", "alpha": 0.15, "linewidth": 0.0, "zorder": 0}


@arguments_checked
def plot_data(
    run: DataRun,
    *,
    design: ObserverDesign | None = None,
    show: Sequence[str] = PANELS,
    axes: Iterable[Axes] | None = None,
) -> list[Axes]:
    """Plot what a design says of measured data.

    Parameters
    ----------
    run : DataRun
        From `obsynth.run_on_data` without ``out``, so that it holds its table.
    design : ObserverDesign, optional
        Which was run: gives units, and the standard deviations of the fault estimates of linear designs.
    show : sequence of {"outputs", "faults", "residuals", "statistic", "shares"}, optional
        What is drawn, of what there is: measured outputs with their estimates, fault estimates with 95 % intervals of
        the stated noise (with adaptive thresholds: their threshold and the guaranteed interval of the fault), residuals
        with the thresholds of the run, the statistic of its monitor, and how much of an adaptive threshold each
        constant with a tolerance makes.
    axes : iterable of Axes, optional
        As many as there are panels; new ones, one above the other, by default.

    Returns
    -------
    list of Axes
        One for each of the first six outputs and inputs that change, and of the faults, one for the residuals of each
        unit, one for the statistic, one for the shares.  Rows in which nothing is decided (warm-up, gaps) lie in grey,
        rows with an alarm in red; in the panel of a fault those that name it.

    Raises
    ------
    SpecError
        The run holds no table, ``show`` names something else, or there are too few or too many axes.

    Examples
    --------
    >>> import numpy as np
    >>> import pandas as pd
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]], C=[[1, 0], [0, 1]], Bf=[[1], [0]], Bd=[[0], [1]], dt=1.0
    ... )
    >>> design = obsynth.fault_estimation_filter(plant)
    >>> log = pd.DataFrame({"time": range(50), "y1": np.zeros(50), "y2": np.zeros(50)})
    >>> run = obsynth.run_on_data(design, log, thresholds={"fhat[f1]": 0.5})
    >>> axes = obsynth.plotting.plot_data(run, design=design, show=["faults"])
    >>> len(axes)
    1
    """
    if run.table is None or run.measured is None:
        raise SpecError("The run holds no table, since it was written to a file: run it without out.", path="run")
    unknown = [part for part in show if part not in PANELS]
    if isinstance(show, str) or unknown:
        raise SpecError(f"show is {show!r}: use some of {', '.join(PANELS)}.", path="show")
    plans = _plans(run.table, run.measured, show, design)
    panels = new_panels(axes, len(plans), size=(WIDTH, PANEL_HEIGHT * max(len(plans), 1) + 0.6))
    units = {} if design is None else dict(design.plant.units)
    # A marked alarm explains the red rows as well.
    explained = {"alarm"} if any(part == "faults" and name in run.alarms for part, name in plans) else set[str]()
    drawing = _Drawing(run, run.table, units, design)
    for panel, (part, name) in zip(panels, plans, strict=True):
        _shade(panel, run.table, explained, _alarm_rows(run, run.table, part, name))
        getattr(drawing, part)(panel, name)
        if part in ("faults", "residuals"):
            _show_decided_rows(
                panel, run, run.table, [name] if part == "faults" else _residuals_of(run.table, design, name)
            )
        legend_above(panel)
        tidy(panel)
    mark = "" if design is None or not design.report.checks else unverified_mark(design.report)
    if panels and mark:
        panels[0].annotate(
            mark,
            (0.0, 1.0),
            xycoords="figure fraction",
            xytext=(4, -4),
            textcoords="offset points",
            va="top",
            fontsize=8,
            color="tab:red",
        )
    still = _constant_inputs(run.measured, design) if "outputs" in show else {}
    below = [f"Constant inputs: {', '.join(_with_value(name, still[name], units) for name in still)}."] if still else []
    # What an alarm means stands below the picture, as in the run's summary.
    below += [f"The threshold: {run.statement}."] if run.statement else []
    if panels and below:
        panels[-1].annotate(
            "\n".join(fill(text, STATEMENT_LETTERS) for text in below),
            (0.0, 0.0),
            xycoords="axes fraction",
            xytext=(0, -36),
            textcoords="offset points",
            va="top",
            fontsize=7,
        )
    if panels and run.stamps.is_dated:
        short_dates(panels[-1], run.stamps.zone)
    elif panels:
        label_time(panels[-1])
    return panels


def panel_count(run: DataRun, show: Sequence[str] = PANELS, *, design: ObserverDesign | None = None) -> int:
    """Return how many axes `plot_data` needs."""
    return 0 if run.table is None or run.measured is None else len(_plans(run.table, run.measured, show, design))


def _plans(
    table: pd.DataFrame, measured: pd.DataFrame, show: Sequence[str], design: ObserverDesign | None
) -> list[tuple[str, str]]:
    """Return part and signal of each panel."""
    columns = [str(name) for name in table.columns]
    estimated = {name[5:-1] for name in columns if name.startswith("xhat[")}
    # The input of a linearised plant that is one in every row is in no log.
    plant = getattr(design, "plant", None)
    shift = getattr(getattr(plant, "uncertainty", None), "shift", None) or getattr(plant, "shift", None)
    still = _constant_inputs(measured, design)
    outputs = [str(name) for name in measured.columns if name not in ("time", shift) and name not in still]
    # Known inputs come first and are no outputs; of these the estimated ones say more.
    outputs.sort(key=lambda name: name not in estimated)
    plans = [("outputs", name) for name in outputs[:MOST_DRAWN]]
    plans += [("faults", name) for name in [name for name in columns if name.startswith("fhat[")][:MOST_DRAWN]]
    # Residuals of unlike units would hide one another.
    plans += [("residuals", unit) for unit in dict.fromkeys(_residual_units(columns, design).values())]
    plans += [("statistic", "")] if "statistic" in columns else []
    plans += [("shares", "")] if any(name.startswith("share ") for name in columns) else []
    return [plan for plan in plans if plan[0] in show]


def _constant_inputs(measured: pd.DataFrame, design: ObserverDesign | None) -> dict[str, float]:
    """Return the known inputs that have one value in all rows, with it: a panel of such a one says nothing."""
    names = [] if design is None else [name for name in design.plant.input_names if name in measured]
    values = {name: measured[name].to_numpy(dtype=float) for name in names}
    known = {name: numbers[np.isfinite(numbers)] for name, numbers in values.items()}
    return {name: float(numbers[0]) for name, numbers in known.items() if numbers.size and np.ptp(numbers) == 0.0}


def _residual_units(columns: Iterable[Any], design: ObserverDesign | None) -> dict[str, str]:
    """Return the residuals that are drawn, with their units."""
    units: Mapping[str, str] = {} if design is None else design.plant.units
    names = [str(name) for name in columns if str(name).startswith("r[")][:MOST_DRAWN]
    return {name: unit if (unit := units.get(name[2:-1], "")) != "1" else "" for name in names}


def _with_value(name: str, value: float, units: Mapping[str, str]) -> str:
    unit = units.get(name, "1")
    return f"{name} {number(value)}{'' if unit in ('', '1') else f' {unit}'}"


def _residuals_of(table: pd.DataFrame, design: ObserverDesign | None, unit: str) -> list[str]:
    """Return the residuals of a unit."""
    return [name for name, own in _residual_units(table.columns, design).items() if own == unit]


@dataclass(frozen=True)
class _Drawing:
    """What is drawn of a run: one method for each kind of panel, by its name, for the signal of that panel."""

    run: DataRun
    table: Any
    units: dict[str, str]
    design: Any

    def outputs(self, panel: Axes, name: str) -> None:
        """Draw a known input, or a measured output with its estimate."""
        measured: Any = self.run.measured
        is_input = self.design is not None and name in self.design.plant.input_names
        panel.plot(measured["time"], measured[name], label="input" if is_input else "measured", **MEASURED_STYLE)
        column = f"xhat[{name}]"
        # Where a disturbance biases the estimate of an algebraic state, its measurement says more, and would be hidden.
        if column in self.table and not self.run.recovered.get(name, "").startswith("biased"):
            panel.plot(self._times(column), self.table[column], label="estimate", **ESTIMATE_STYLE)
        panel.set_ylabel(with_unit(name, self.units))

    def faults(self, panel: Axes, column: str) -> None:
        """Draw a fault estimate with its interval, its thresholds and its first alarm."""
        run, table = self.run, self.table
        name, times = column[5:-1], self._times(column)
        values, deviation = table[column].to_numpy(float), self._deviation(column)
        guaranteed, adaptive = f"lowest {name}" in table, f"threshold {column}" in table
        if guaranteed:
            low, high = table[f"lowest {name}"].to_numpy(float), table[f"highest {name}"].to_numpy(float)
            panel.fill_between(times, low, high, label="guaranteed interval", **BAND_STYLE)
        elif deviation is not None and not adaptive:
            low, high = values - BAND_WIDTH * deviation, values + BAND_WIDTH * deviation
            noise = noise_words(getattr(getattr(self.design, "plant", None), "noise_names", ()))
            band = MODEL_BAND if f"sd {column}" in table else f"95 % interval of {noise}"
            contradicted = self._contradicted()
            where = ~contradicted & np.isfinite(low)
            if where.any():
                panel.fill_between(times, low, high, where=where, label=band, **BAND_STYLE)
            if contradicted.any():
                not_valid = "interval not valid: the alarm contradicts its noise"
                panel.fill_between(times, low, high, where=contradicted, label=not_valid, **CONTRADICTED_STYLE)
        panel.plot(times, values, label="estimate", **ESTIMATE_STYLE)
        if adaptive:
            limit = table[f"threshold {column}"].to_numpy(float)
            for side, label in ((limit, "threshold without a fault"), (-limit, None)):
                panel.plot(table["time"], side, label=label, **THRESHOLD_STYLES[0])
        if (level := run.thresholds.get(column)) is not None:
            biases = () if self.design is None else getattr(self.design.plant, "sensor_faults", ())
            centre = 0.0
            if self.design is not None and name not in biases:
                # Nonlinear plants estimate their parameters themselves, not deviations from a point.
                centre = getattr(self.design.plant, "operating_point", {}).get(name, 0.0)
            _limits(panel, centre, level, "threshold", THRESHOLD_STYLES[0])
        if column in run.alarms:
            row = int(table["alarm"].astype(str).str.contains(column, regex=False).to_numpy().argmax())
            mark(panel, times.iloc[row], values[row], f"alarm at {run.stamps.shown(run.alarms[column])}")
        panel.set_ylabel(with_unit(name, self.units))

    def residuals(self, panel: Axes, unit: str) -> None:
        """Draw the residuals of a unit with the thresholds of the run."""
        names = _residuals_of(self.table, self.design, unit)
        for name, colour in zip(names, LINE_COLOURS, strict=False):
            style = {**RESIDUAL_STYLE, "linewidth": 0.9, "color": colour}
            panel.plot(self.table["time"], self.table[name], label=name, **style)
        for i, name in enumerate(name for name in names if name in self.run.thresholds):
            style = THRESHOLD_STYLES[i % len(THRESHOLD_STYLES)]
            _limits(panel, 0.0, self.run.thresholds[name], f"threshold of {name}", style)
        panel.set_ylabel(with_unit("residuals", {"residuals": unit}))

    def statistic(self, panel: Axes, _: str) -> None:
        """Draw the statistic of the monitor with its threshold and its first alarm."""
        run, table = self.run, self.table
        panel.plot(table["time"], table["statistic"], label="statistic", **RESIDUAL_STYLE)
        panel.plot(table["time"], table["threshold"], label="threshold", **THRESHOLD_STYLES[0])
        values, levels = table["statistic"].to_numpy(float), table["threshold"].to_numpy(float)
        passed = np.flatnonzero(values > levels)
        own = [run.alarms[name] for name in run.alarms if name not in run.thresholds]
        if passed.size and own:
            first = int(passed[0])
            mark(panel, table["time"].iloc[first], values[first], f"first alarm at {run.stamps.shown(own[0])}")
        level = float(np.nanmax(levels, initial=0.0))
        if level > 0.0 and np.nanmax(values, initial=0.0) > _FAR_ABOVE * level:
            panel.set_yscale("symlog", linthresh=level)
        panel.set_ylabel("statistic")

    def shares(self, panel: Axes, _: str) -> None:
        """Stack what each constant makes of the threshold; those that make least count together."""
        names = [name for name in self.table.columns if name.startswith("share ")]
        values = 100.0 * np.nan_to_num(self.table[names].to_numpy(float))
        order = np.argsort(-values.mean(axis=0), kind="stable")
        drawn, rest_of_them = order[: MOST_DRAWN - 1], order[MOST_DRAWN - 1 :]
        parts = [values[:, i] for i in drawn] + ([values[:, rest_of_them].sum(axis=1)] if len(rest_of_them) else [])
        labels = [names[i].removeprefix("share ") for i in drawn] + (["other constants"] if len(rest_of_them) else [])
        panel.stackplot(
            self.table["time"], parts, labels=labels, colors=LINE_COLOURS[: len(parts)], alpha=0.7, linewidth=0.0
        )
        panel.set_ylim(0.0, 100.0)
        panel.set_ylabel("share of the\nthreshold (%)")

    def _contradicted(self) -> Any:
        """Return the rows of alarms that contradict the noise on which intervals rest."""
        rows = np.zeros(len(self.table), dtype=bool)
        for event in self.run.events:
            if event.by in CONTRADICTING:
                rows[event.first_row - 1 : event.last_row] = True
        return rows

    def _times(self, column: str) -> Any:
        """Return the time of which a column is the estimate."""
        own = f"time of {column}"
        return self.table[own if own in self.table else "time"]

    def _deviation(self, column: str) -> Any:
        if f"sd {column}" in self.table:
            return self.table[f"sd {column}"].to_numpy(float)
        # Of a continuous design it is that for one second between samples: of no use without the sampling.
        if self.design is None or not getattr(self.design.observer, "dt", 0.0) > 0.0:
            return None
        rows = (check.value for check in self.design.report.checks if check.name == f"noise in {column}")
        return next(map(float, rows), None)


def _show_decided_rows(panel: Axes, run: DataRun, table: pd.DataFrame, columns: Sequence[str]) -> None:
    """Let the initial-condition response leave the picture where it would hide all that comes after it."""
    values = table[list(columns)].to_numpy(float)
    decided = values[table["status"].isin(DECIDING).to_numpy()]
    low, high = panel.get_ylim()
    own = decided[np.isfinite(decided)]
    if not own.size:
        return
    levels = [abs(run.thresholds.get(name, 0.0)) for name in columns]
    size = max(float(np.ptp(own)), *levels)
    if not high - low > HIDING * size > 0.0:
        return
    reached = max(values[np.isfinite(values)], key=abs)
    panel.set_ylim(float(own.min()) - 0.5 * size, float(own.max()) + 0.5 * size)
    panel.annotate(
        f"warm-up and gaps: up to {number(float(reached), digits=3)}",
        (0.0, 1.0),
        xycoords="axes fraction",
        xytext=(4, -4),
        textcoords="offset points",
        va="top",
        fontsize=7,
    )


def _limits(panel: Axes, centre: float, level: float, label: str, style: dict[str, Any]) -> None:
    """Draw a threshold on both sides of a centre."""
    for side, text in ((level, label), (-level, None)):
        panel.axhline(centre + side, label=text, **style)


def _alarm_rows(run: DataRun, table: Any, part: str, column: str) -> Any:
    """Return in which rows a panel shows an alarm: one of its own fault, of a residual, or of the monitor."""
    if part == "outputs" or "alarm" not in table:
        return np.zeros(len(table), dtype=bool)

    def concerns(alarm: str) -> bool:
        # "fhat[leak]; pointwise: leak or clog": what passed its threshold; a monitor and whom it names.
        by, _, named = alarm.partition(": ")
        if part == "faults":
            return by == column or column[5:-1] in named.split(" or ")
        return bool(by) and (by not in run.thresholds or (part == "residuals" and by.startswith("r[")))

    texts = table["alarm"].astype(str)
    return texts.map(lambda text: any(map(concerns, text.split("; ")))).to_numpy(bool)


def _shade(panel: Axes, table: Any, explained: set[str], alarms: Any) -> None:
    """Shade the rows in which nothing is decided, and those with an alarm; each is explained in one panel."""
    undecided = ~table["status"].isin(DECIDING).to_numpy()
    marks = [(undecided, _UNDECIDED_ROWS, "warm-up or gap"), (alarms, _ALARM, "alarm")]
    times = table["time"]
    for where, style, label in marks:
        edges = np.flatnonzero(np.diff(np.concatenate([[False], where, [False]]).astype(np.int64)))
        for begin, end in edges.reshape(-1, 2):
            new = None if label in explained else label
            explained.add(label)
            panel.axvspan(times.iloc[begin], times.iloc[min(end, len(times) - 1)], label=new, **style)

"""The result of `obsynth.compare`: one row per method, one recommendation, one picture."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.files.outputs import FileKind, write_atomically
from obsynth.files.tables import html_table, standing_page, text_table
from obsynth.methods.fault_figures import FaultFigures
from obsynth.methods.optimal_filter.least_possible import LeastPossible
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.suggestions import fields_suggested, there_are
from obsynth.observers.linear.observer import LinearObserver
from obsynth.report.plots.panels import (
    LINE_COLOURS,
    TRUE_STYLE,
    data_url,
    label_time,
    legend_above,
    tidy,
    with_unit,
    written,
)
from obsynth.results.certificate_files import SHOWN_DIGITS, result_text
from obsynth.results.design import ObserverDesign
from obsynth.results.gain_set_writing import design_as_dict
from obsynth.results.gain_sets import COMPARISON
from obsynth.results.layout import number, upper_number
from obsynth.studies.equal_delays import HEALTHY_TIME

if TYPE_CHECKING:
    from matplotlib.figure import Figure


#: Samples of the window on which the least threshold is looked for, at most.
LONGEST_WINDOW = 32

#: How far a signal reaches is judged by this share of its samples.
SHOWN_SAMPLES = 0.98

#: Room below and above a fault in its panel, as a share of its range.
ROOM_AROUND_FAULT = 0.1

#: An estimate that reaches so many times as far as the fault and the best estimate has a panel of its own.
NOISIER = 3.0

#: Order in which truth is drawn among noise that would hide it.
ON_TOP = 20.0

#: What the page of a comparison begins with.
COMPARISON_PAGE = FileKind("a comparison of obsynth", rb'name="generator" content="obsynth compare"', suffix=".html")

#: Where nothing is known of delays on a log, a method comes last.
NO_DELAYS = (float("inf"), float("inf"))

#: The column that a log adds.
EQUAL_DELAY = "delay at equal healthy time"

_HEADER = (
    "method",
    "fault",
    "order",
    "s to 50 %",
    "s to 90 %",
    "at horizon",
    "peak",
    "deviation",
    "gain from d",
    "bias",
    "s to alarm",
    "smallest",
    "bound",
    "bound / optimum",
    "rms",
    "gain / least",
    "noise / least",
    "ms",
)
#: Where the bound stands among the numbers between order and time, and the shares of the least possible.
_BOUND_COLUMN, _SHARE_COLUMNS = _HEADER.index("bound") - 3, slice(-2, None)
#: A gain of at most this is zero but for rounding, and is shown as zero.
ROUNDED_GAIN = 1e-9

#: What the columns of numbers mean.
_FIGURE_MEANINGS = {
    "order": "states of the observer",
    "s to 50 %": "time until the estimate of a unit step reaches 50 %",
    "s to 90 %": "time until the estimate of a unit step reaches 90 %",
    "at horizon": "the estimate of a unit step at the end",
    "peak": "its largest absolute value",
    "deviation": "standard deviation of the estimate",
    "gain from d": "largest gain from an unknown input to the estimate",
    "bias": "largest mean of the estimate without a fault",
    "s to alarm": "median detection delay",
    "smallest": "step that half of the runs detect",
    "bound": "largest estimate without a fault, for the exact model (tolerances not counted) and held disturbances",
    "bound / optimum": (
        f"1 = as sensitive as the best test with the same delay on {LONGEST_WINDOW} samples of inputs and outputs (on "
        "fewer of plants with more than 78 states); below 1 = better, because the observer uses older samples"
    ),
    "rms": "root mean square error in the runs, or on the log where it has a column of the fault",
    EQUAL_DELAY: (
        f"seconds from a fault to its alarm with the level that {100 * HEALTHY_TIME:g} % of the normal rows of the log "
        "pass; never: no more rows of the fault are in alarm than by chance"
    ),
    "gain / least": (
        "gain from all unknown inputs to all estimates, in times the least of any causal filter that responds to the "
        "faults as this one does; inf: some such filter has none"
    ),
    "noise / least": (
        "root mean square for the stated noise as white noise, likewise, of filters that decouple the unknown inputs "
        "where this one does"
    ),
    "ms": "milliseconds to design and verify",
}

#: For what the figures hold that no run was made for.
_OF_THE_EXACT_MODEL = (
    "Times, deviations, gains and the least of any causal filter are of the exact model, with faults and disturbances "
    "that are held between samples."
)


@dataclass(frozen=True)
class FaultComparison:
    """How one method estimates one fault.

    Parameters
    ----------
    figures : FaultFigures
        In closed form, on the nominal plant.
    rms : float
        Root mean square of ``fhat - f`` over the drawn runs of the scenario, not shifted by any delay.
    size : float
        Root mean square of the fault itself in these runs; where it does not happen, the largest `rms` of any method.
    bias : float
        Largest absolute mean over the runs of the estimate without a fault: what tolerances and disturbances make.
    threshold : float
        Level of an alarm, calibrated on the fault-free runs.
    detection_delay : float, seconds
        Median over the runs, from the start of the fault.
    smallest_found : float
        Size of a step that half of the runs find.
    bound : float
        What the estimate of the exact model never passes without a fault, with disturbances as large as in the scenario
        that are held between samples, and three deviations of noise: sums of absolute values.
    least : float
        The least such bound that any test with the same delay on at most `LONGEST_WINDOW` samples of inputs and outputs
        can have (fewer of plants with more than 78 states), linear or not: of a fault of any time course where the
        estimate is one sample of it, else of a constant one.  An observer uses all samples before, and its bound may be
        smaller.
    equal_delay : float, seconds
        On a log: from the fault to its alarm, with the level that 1 % of the normal rows pass; median over its begins,
        infinite where it is not found.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(A=[[0.9]], C=[[1.0]], Bf=[[1.0]], dt=1.0, sensor_noise={"y1": 0.1})
    >>> comparison = obsynth.compare(plant, methods=["functional-filter"], runs=2)
    >>> fault = comparison.methods[0].faults[0]
    >>> fault.figures.fault, fault.rms >= 0.0
    ('f1', True)
    """

    figures: FaultFigures
    rms: float
    size: float
    bias: float
    threshold: float
    detection_delay: float
    smallest_found: float
    bound: float = float("nan")
    least: float = float("nan")
    equal_delay: float = float("nan")


@dataclass(frozen=True, eq=False)
class ComparedMethod:
    """One method, or why there is none.

    Parameters
    ----------
    method : str
        Its id.
    refused : str
        Why it does not exist, in one line; empty where it does.
    design : ObserverDesign or None
        The design, verified.
    order : int
        States of the observer on the common clock.
    milliseconds : float
        To design and verify.
    faults : tuple of FaultComparison
        One for each fault.
    fast_enough : bool
        Whether 90 % of every step is shown within the time asked for.
    responses : FloatArray
        ``(steps, faults)``: estimates of a unit step of each fault.
    estimates : FloatArray
        ``(steps, faults)``: on the first drawn run, or on the log.
    beside : LeastPossible or None
        Gain from the unknown inputs, and deviation for the noise, with the least of any causal filter that responds to
        the faults as this one does, in the design's own time; ``None`` where that is not known.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(A=[[0.9]], C=[[1.0]], Bf=[[1.0]], dt=1.0, sensor_noise={"y1": 0.1})
    >>> comparison = obsynth.compare(plant, methods=["functional-filter"], runs=2)
    >>> method = comparison.methods[0]
    >>> method.method, method.refused, method.order
    ('functional-filter', '', 2)
    """

    method: str
    refused: str
    design: ObserverDesign | None
    order: int
    milliseconds: float
    faults: tuple[FaultComparison, ...]
    fast_enough: bool
    responses: FloatArray
    estimates: FloatArray
    beside: LeastPossible | None = None

    @property
    def shares(self) -> tuple[float, float]:
        """Gain and deviation in times the least possible; NaN where that is not known."""
        beside = self.beside
        return (np.nan, np.nan) if beside is None else (beside.gain_share, beside.deviation_share)

    @property
    def relative_error(self) -> float:
        """Root mean square over all faults of each one's error, as a share of its size: the same in all units."""
        return relative_error([vars(fault) for fault in self.faults])

    @property
    def equal_delay(self) -> tuple[int, float] | None:
        """How many faults raise no alarm, and the mean delay of the others (s), at equal healthy time in alarm on a
        log; `None` without one."""
        return mean_delay([fault.equal_delay for fault in self.faults])

    @property
    def label(self) -> str:
        """What it is called in a picture: with its delay at equal healthy time in alarm, on a log."""
        delay = self.equal_delay
        if delay is None:
            return self.method
        return f"{self.method} ({f'{number(delay[1])} s' if np.isfinite(delay[1]) else 'no alarm'})"

    @property
    def ranked_by(self) -> tuple[float, ...]:
        """What methods are ranked by, the least first."""
        return (*(self.equal_delay or NO_DELAYS), self.relative_error)


def relative_error(faults: Sequence[Mapping[str, Any]]) -> float:
    """Return the root mean square of ``rms / size`` over faults; infinite where there are none."""
    shares = [fault["rms"] / fault["size"] if fault["rms"] else 0.0 for fault in faults]
    return rms(shares) if shares else float("inf")


def mean_delay(delays: Sequence[float]) -> tuple[int, float] | None:
    """Return how many delays are infinite, and the mean of the finite ones; `None` where there are none at all."""
    known = [delay for delay in delays if not np.isnan(delay)]
    finite = [delay for delay in known if np.isfinite(delay)]
    if not known:
        return None
    return len(known) - len(finite), float(np.mean(finite)) if finite else float("inf")


def delay_in_words(delay: tuple[int, float], healthy_time: float) -> str:
    """Return what `ComparedMethod.equal_delay` is, in words."""
    missing, mean = delay
    words = "no fault raises an alarm" if np.isinf(mean) else f"alarms after {number(mean)} s"
    words += f" with {100 * healthy_time:g} % of healthy time in alarm"
    return f"{words} ({missing} without one)" if missing and np.isfinite(mean) else words


def short_delay(delay: tuple[int, float]) -> str:
    """Return the same in two or three words, for a list."""
    missing, mean = delay
    if np.isinf(mean):
        return "no alarm"
    return f"{number(mean)} s" + (f" ({missing} without one)" if missing else "")


@fields_suggested
@dataclass(frozen=True, eq=False)
class Comparison:
    """All methods side by side on one clock; made by `compare`.

    Parameters
    ----------
    methods : tuple of ComparedMethod
        The best first; refused ones last.
    recommended : str
        Method id, empty where none exists.
    reason : str
        Why, in one sentence.
    sample_time : float, seconds
        The clock.
    times : FloatArray
        ``(steps,)``, seconds.
    truth : FloatArray
        ``(steps, nf)``: faults of the scenario (zeros for a log without them).
    fault_names : tuple of str
        Columns of `truth`.
    setting : str
        What was drawn, in words.
    asked : mapping, optional
        Plant, scenario and options, as plain data; empty where a log is in no file.
    log : mapping, optional
        The log by its name and digest, and how its columns were read.
    notes : tuple of str, optional
        What is to be said of the log: cells without numbers, rows that are left out, outputs that are stuck.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(A=[[0.9]], C=[[1.0]], Bf=[[1.0]], dt=1.0, sensor_noise={"y1": 0.1})
    >>> comparison = obsynth.compare(plant, methods=["functional-filter", "optimal-filter"], runs=2)
    >>> [method.method for method in comparison.methods]
    ['optimal-filter', 'functional-filter']
    """

    methods: tuple[ComparedMethod, ...]
    recommended: str
    reason: str
    sample_time: float
    times: FloatArray
    truth: FloatArray
    fault_names: tuple[str, ...]
    setting: str
    asked: Mapping[str, Any] = field(default_factory=dict)
    log: Mapping[str, Any] | None = None
    notes: tuple[str, ...] = ()

    def __getitem__(self, method: str) -> ComparedMethod:
        for entry in self.methods:
            if entry.method == method:
                return entry
        raise KeyError(f"no method {method!r}; {there_are(method, [entry.method for entry in self.methods])}")

    def rows(self) -> tuple[tuple[str, ...], ...]:
        """Return the table as texts: the header, then a row for each method and fault."""
        rows = []
        for entry in self.methods:
            for k, fault in enumerate(entry.faults):
                order, *figures, milliseconds = self._figures(entry, fault)
                texts = [_number(value) for value in figures]
                if np.isfinite(fault.bound):
                    texts[_BOUND_COLUMN] = upper_number(fault.bound)
                if k:
                    # What is of the method stands in its first row.
                    texts[_SHARE_COLUMNS] = ["", ""]
                own = (str(order), f"{milliseconds:.0f}") if k == 0 else ("", "")
                rows.append((entry.method if k == 0 else "", fault.figures.fault, own[0], *texts, own[1]))
        return (self._header, *rows)

    @property
    def _has_delays(self) -> bool:
        """Whether there are delays at equal healthy time: only on a log."""
        return any(not np.isnan(fault.equal_delay) for entry in self.methods for fault in entry.faults)

    @property
    def _header(self) -> tuple[str, ...]:
        return (*_HEADER[:-3], EQUAL_DELAY, *_HEADER[-3:]) if self._has_delays else _HEADER

    def _figures(self, entry: ComparedMethod, fault: FaultComparison) -> tuple[float, ...]:
        """Return the numbers of a row, in the order of the header after method and fault."""
        figures = _figures(entry, fault)
        return (*figures[:-3], fault.equal_delay, *figures[-3:]) if self._has_delays else figures

    @property
    def _units(self) -> dict[str, str]:
        return next((dict(entry.design.plant.units) for entry in self.methods if entry.design is not None), {})

    def meanings(self, columns: Sequence[str] | None = None) -> str:
        """Return what columns of numbers of the table mean, in one sentence.

        Parameters
        ----------
        columns : sequence of str, optional
            Headers of the columns: all by default.

        Returns
        -------
        str
            Each header with its meaning.
        """
        columns_drawn = self._header if columns is None else columns
        texts = [f"{name}: {_FIGURE_MEANINGS[name]}" for name in columns_drawn if name in _FIGURE_MEANINGS]
        return " ".join(filter(None, ("; ".join(texts) + ".", _OF_THE_EXACT_MODEL, self._of_settled_gains)))

    @property
    def _of_settled_gains(self) -> str:
        """Which methods have figures that do not cover the first samples, in a sentence; empty for none."""
        moving = [
            entry.method
            for entry in self.methods
            if entry.design is not None and not isinstance(entry.design.observer, LinearObserver)
        ]
        if not moving:
            return ""
        return (
            f"Figures of {', '.join(moving)} are those of gains that have settled: before that, estimates may pass the "
            "bound."
        )

    @property
    def beside_the_least(self) -> tuple[str, ...]:
        """How near each method is to the least that any causal filter lets through, in one line each."""
        sentences = ((entry.method, "" if entry.beside is None else entry.beside.sentence()) for entry in self.methods)
        return tuple(f"{method}: {text}" for method, text in sentences if text)

    @property
    def refusals(self) -> tuple[str, ...]:
        """Methods that do not exist, each with the reason in one line."""
        return tuple(f"{entry.method}: {entry.refused}" for entry in self.methods if entry.refused)

    def to_dict(self) -> dict[str, Any]:
        """Return the comparison as plain data."""
        return {
            "recommended": self.recommended,
            "reason": self.reason,
            "sample_time": self.sample_time,
            "setting": self.setting,
            "notes": list(self.notes),
            "beside_the_least": list(self.beside_the_least),
            "refusals": list(self.refusals),
            "rows": [
                dict(zip(self._header, (entry.method, fault.figures.fault, *self._figures(entry, fault)), strict=True))
                for entry in self.methods
                for fault in entry.faults
            ],
            "methods": [{"method": name, **entry} for name, entry in self.claims()["methods"].items()],
        }

    def claims(self) -> dict[str, Any]:
        """Return what a certificate claims: the figures of every design on the same draws."""
        left_out = ("figures",) if self._has_delays else ("figures", "equal_delay")
        figures = {
            entry.method: {
                "order": entry.order,
                "fast_enough": entry.fast_enough,
                "relative_error": entry.relative_error,
                "faults": [
                    {**vars(fault.figures), **{k: v for k, v in vars(fault).items() if k not in left_out}}
                    for fault in entry.faults
                ],
            }
            for entry in self.methods
            if not entry.refused
        }
        return {"setting": self.setting, "methods": figures}

    @property
    def statement(self) -> str:
        """Which method is best on what, in one sentence, with everything that it rests on."""
        if not self.recommended:
            return f"None exists: {self.reason}."
        digests = {name: design_as_dict(design)["sha256"] for name, design in self._designs().items()}
        return comparison_statement(self.claims(), digests, self.log)

    def _designs(self) -> dict[str, ObserverDesign]:
        return {entry.method: entry.design for entry in self.methods if entry.design is not None}

    def save(self, path: str | Path) -> Path:
        """Write a certificate that `obsynth verify` recomputes, with every gain set inside.

        Parameters
        ----------
        path : str or Path
            Where to write (.json).

        Raises
        ------
        SpecError
            No method exists, or the log is in no file: there is nothing to certify.
        """
        if not self.recommended or not self.asked:
            why = "no method exists" if not self.recommended else "the log is in no file"
            raise SpecError(f"There is nothing to certify: {why}.", path="methods")
        text = result_text(COMPARISON, self._designs(), self.asked, self.claims(), self.statement, self.log)
        return write_atomically(path, text)

    def plot(self) -> Figure:
        """Return a figure: for each fault, each method's estimate of a unit step, and its estimate on the scenario.

        Estimates that are much noisier than the best one are drawn in a panel of their own, each in its full range.
        """
        import matplotlib.pyplot as plt

        return self._drawn(plt.figure)

    def _drawn(self, new_figure: Callable[..., Figure]) -> Figure:
        drawn = [entry for entry in self.methods if entry.faults]
        count = len(self.fault_names)
        far = [self._far_noisier(drawn, row) for row in range(count)]
        columns = 3 if any(far) else 2
        figure = new_figure(figsize=(3.5 + 3.75 * (columns - 1), 2.8 * count), layout="constrained")
        axes = figure.subplots(count, columns, squeeze=False)
        figure.align_ylabels(axes)
        for row, name in enumerate(self.fault_names):
            left_panel, *panels = axes[row]
            sets = ([entry for entry in drawn if entry not in far[row]], far[row])
            for panel, entries in zip(panels, sets, strict=False):
                if not entries:
                    panel.set_visible(False)
                    continue
                over = {"zorder": ON_TOP} if entries is far[row] else {}
                if np.isfinite(self.truth[:, row]).any():
                    panel.plot(self.times, self.truth[:, row], label="fault", **over, **TRUE_STYLE)
                panel.set_ylim(*self._range(entries, row))
                panel.set_ylabel(with_unit(name, self._units))
            left_panel.axhline(1.0, color="0.8", linewidth=0.8)
            for rank, entry in enumerate(drawn):
                names = [fault.figures.fault for fault in entry.faults]
                if name not in names:
                    continue
                column, colour = names.index(name), LINE_COLOURS[rank % len(LINE_COLOURS)]
                # The best lies on top.
                style: dict[str, Any] = {"color": colour, "zorder": 3.0 + len(drawn) - rank}
                response, estimate = np.clip(entry.responses[:, column], -1.0, 3.0), entry.estimates[:, column]
                left_panel.plot(np.arange(len(response)) * self.sample_time, response, label=entry.label, **style)
                noisy = entry in far[row]
                label = {"label": f"{entry.method}, far noisier"} if noisy else {}
                panels[int(noisy)].plot(self.times, estimate, **style, **label, linewidth=0.4 if noisy else 0.8)
            times = [f.figures.most for entry in drawn for f in entry.faults if np.isfinite(f.figures.most)]
            length = max((len(entry.responses) for entry in drawn), default=2) * self.sample_time
            left_panel.set_xlim(0.0, min(max([3.0 * max(times, default=length), 10.0 * self.sample_time]), length))
            left_panel.set_ylabel(f"estimate of a unit step\nof {name}")
            for panel in (left_panel, *panels):
                label_time(panel)
                tidy(panel)
            for panel in panels if row == 0 else panels[1:]:
                if panel.get_visible() and panel.get_legend_handles_labels()[0]:
                    legend_above(panel)
        legend_above(axes[0, 0])
        return figure

    def _far_noisier(self, entries: Sequence[ComparedMethod], row: int) -> list[ComparedMethod]:
        """Return the methods whose estimate of a fault would hide the others in one panel; the first is none."""
        name, reaches = self.fault_names[row], list[tuple[ComparedMethod, float]]()
        for entry in entries:
            names = [fault.figures.fault for fault in entry.faults]
            if name in names:
                reaches.append((entry, _reach(entry.estimates[:, names.index(name)])))
        if not reaches:
            return []
        most = NOISIER * max(_reach(self.truth[:, row]), reaches[0][1])
        return [entry for entry, reach in reaches[1:] if reach > most]

    def _range(self, entries: Sequence[ComparedMethod], row: int) -> tuple[float, float]:
        """Return the ends of the panel of a fault: all of the truth, and of every estimate."""
        known = self.truth[np.isfinite(self.truth[:, row]), row]
        low, high = float(np.min(known, initial=0.0)), float(np.max(known, initial=0.0))
        for entry in entries:
            names = [fault.figures.fault for fault in entry.faults]
            if self.fault_names[row] in names:
                estimate = entry.estimates[:, names.index(self.fault_names[row])]
                if np.isfinite(estimate).any():
                    low, high = min(low, float(np.nanmin(estimate))), max(high, float(np.nanmax(estimate)))
        room = ROOM_AROUND_FAULT * (high - low or 1.0)
        return low - room, high + room

    def __repr__(self) -> str:
        table = text_table(self.rows(), left_aligned=2)
        return "\n".join(
            [self.setting, *self.notes, *table, self.meanings(), *self.beside_the_least, *self.refusals, self.advice]
        )

    @property
    def advice(self) -> str:
        """The recommendation with its reason."""
        return f"Take {self.recommended}: {self.reason}." if self.recommended else f"None exists: {self.reason}."

    def _repr_html_(self) -> str:
        return f"<p>{escape(self.setting)}</p>{html_table(self.rows())}" + "".join(
            f"<p>{escape(text)}</p>"
            for text in (*self.notes, self.meanings(), *self.beside_the_least, *self.refusals, self.advice)
        )

    def page(self) -> str:
        """Return a page of HTML that stands alone, with table, picture, refusals and recommendation."""
        from matplotlib.figure import Figure

        picture = data_url(written(self._drawn(Figure)))
        meanings = "".join(
            f"<li>{escape(f'{name}: {text}')}</li>" for name, text in _FIGURE_MEANINGS.items() if name in self._header
        )
        meanings += f"<li>{escape(_OF_THE_EXACT_MODEL)}</li>"
        refused = "".join(f"<li>{escape(text)}</li>" for text in self.refusals)
        head, *rows = self.rows()
        # With the unit of each fault, in which its figures are.
        table = (head, *((method, with_unit(fault, self._units), *cells) for method, fault, *cells in rows))
        body = [
            f'<p class="verdict {"holds" if self.recommended else "fails"}">{escape(self.advice)}</p>',
            f"<p>{escape(self.setting)}</p>",
            *(f"<p>{escape(text)}</p>" for text in self.notes),
            f'<div class="scroll figures">{html_table(table)}</div>',
            f'<div class="scroll"><figure><img alt="Estimates of each method" src="{picture}"></figure></div>',
            "<h2>What the columns mean</h2>",
            f'<ul class="soft">{meanings}</ul>',
            *(["<h2>Methods without a design</h2>", f"<ul>{refused}</ul>"] if refused else []),
        ]
        return standing_page("Comparison of methods", body, generator="obsynth compare")


def comparison_statement(claims: Mapping[str, Any], digests: Mapping[str, str], log: Mapping[str, Any] | None) -> str:
    """Return what the figures of a comparison come to; ``digests`` are those of the gain sets."""
    methods = claims["methods"]
    errors = {name: relative_error(entry["faults"]) for name, entry in methods.items()}
    delays = {
        name: mean_delay([float(fault.get("equal_delay", "nan")) for fault in entry["faults"]])
        for name, entry in methods.items()
    }
    best = min(methods, key=lambda name: (not methods[name]["fast_enough"], *(delays[name] or NO_DELAYS), errors[name]))
    if delays[best] is not None:
        return _statement_on_log(claims, digests, log, best, delays)
    other_errors = ", ".join(f"{errors[name]:.4g} of {name}" for name in methods if name != best)
    fast = "" if methods[best]["fast_enough"] else ", though none reaches 90 % of a step within the time asked for"
    where = "" if log is None else f", errors on {log['name']} (sha256 {log['sha256'][:SHOWN_DIGITS]})"
    gain_sets = ", ".join(f"{name} {digest[:SHOWN_DIGITS]}" for name, digest in digests.items())
    against = f" against {other_errors}" if other_errors else ""
    return (
        f"Of the methods that exist, {best} has the least rms error of the fault estimates, as a share of each fault's "
        f"size ({errors[best]:.4g}{against}){fast}: {claims['setting']}{where}. Gain sets: {gain_sets}."
    )


def _statement_on_log(
    claims: Mapping[str, Any],
    digests: Mapping[str, str],
    log: Mapping[str, Any] | None,
    best: str,
    delays: Mapping[str, tuple[int, float] | None],
) -> str:
    """Return the sentence where methods are ranked by their delays at equal healthy time in alarm on a log."""
    methods = claims["methods"]
    own = delays[best]
    words = "" if own is None else delay_in_words(own, HEALTHY_TIME)
    others = ", ".join(
        f"{short_delay(delay)} of {name}" for name, delay in delays.items() if name != best and delay is not None
    )
    fast = "" if methods[best]["fast_enough"] else ", though none reaches 90 % of a step within the time asked for"
    where = "" if log is None else f", on {log['name']} (sha256 {log['sha256'][:SHOWN_DIGITS]})"
    gain_sets = ", ".join(f"{name} {digest[:SHOWN_DIGITS]}" for name, digest in digests.items())
    return (
        f"Of the methods that exist, {best} comes first by the time that was asked for, the faults that raise no alarm "
        f"and the mean delay of the others: {words}{f', against {others}' if others else ''}"
        f"{fast}: {claims['setting']}{where}. Gain sets: {gain_sets}."
    )


def _reach(values: FloatArray) -> float:
    """Return how far nearly all values of a signal reach from zero; 0 where none is known."""
    known = np.abs(values[np.isfinite(values)])
    return float(np.quantile(known, SHOWN_SAMPLES)) if known.size else 0.0


def _figures(entry: ComparedMethod, fault: FaultComparison) -> tuple[float, ...]:
    """Return the numbers of a row, in the order of the header after method and fault."""
    figures = fault.figures
    return (
        entry.order,
        figures.half,
        figures.most,
        figures.at_horizon,
        figures.peak,
        figures.deviation,
        0.0 if figures.unknown_input_gain <= ROUNDED_GAIN else figures.unknown_input_gain,
        fault.bias,
        fault.detection_delay,
        fault.smallest_found,
        fault.bound,
        fault.bound / fault.least if fault.least > 0.0 else np.nan,
        fault.rms,
        *entry.shares,
        entry.milliseconds,
    )


def _number(value: float) -> str:
    return "-" if np.isnan(value) else "never" if np.isinf(value) else number(value, digits=3)


def rms(errors: Sequence[float] | FloatArray) -> float:
    """Return the root of the mean square; where a sample is missing (NaN) there is no error."""
    values = np.asarray(errors, dtype=np.float64)
    values = values[~np.isnan(values)]
    return float(np.sqrt(np.mean(values**2))) if values.size else float("nan")

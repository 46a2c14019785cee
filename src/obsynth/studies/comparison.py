"""The result of `obsynth.compare`: one row for each method, a recommendation, and a plot."""

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
from obsynth.methods.fault_figures import largest_gain
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.suggestions import fields_suggested, there_are
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.noise import is_noise_assumed
from obsynth.report.plots.panels import data_url, with_unit, written
from obsynth.results.certificate_files import RESULT_FILE, result_text
from obsynth.results.design import ObserverDesign
from obsynth.results.gain_set_writing import design_as_dict
from obsynth.results.gain_sets import COMPARISON
from obsynth.results.number_texts import number, upper_number
from obsynth.studies.compared_methods import ComparedMethod, FaultComparison
from obsynth.studies.equal_delays import HEALTHY_TIME
from obsynth.studies.plots.comparison import drawn_comparison
from obsynth.studies.ranking import comparison_statement

if TYPE_CHECKING:
    from matplotlib.figure import Figure


#: Noise counts as within so many deviations.
DEVIATIONS = 3.0

#: Samples of the window on which the least threshold is looked for, at most.
LONGEST_WINDOW = 32

#: What the page of a comparison begins with.
COMPARISON_PAGE = FileKind("a comparison of obsynth", rb'name="generator" content="obsynth compare"', suffix=".html")

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
#: Where times and sizes of alarms stand, of which there may be none.
_NEVER_COLUMNS = tuple(_HEADER.index(name) - 3 for name in ("s to alarm", "smallest"))
#: Where times of a step stand, which are followed for as long as the runs: no more is known of later ones.
_TIME_COLUMNS = tuple(_HEADER.index(name) - 3 for name in ("s to 50 %", "s to 90 %"))
#: A bound of at most this share of the fault is zero but for rounding, and is shown as zero.
ROUNDED_BOUND = 1e-9

#: What the columns of numbers mean.
_FIGURE_MEANINGS = {
    "order": "states of the observer",
    "s to 50 %": "time until the estimate of a unit step reaches 50 %; after >: not while it was followed",
    "s to 90 %": "time until the estimate of a unit step reaches 90 %; after >: not while it was followed",
    "at horizon": "the estimate of a unit step at the end",
    "peak": "its largest absolute value",
    "deviation": "standard deviation of the estimate",
    "gain from d": "largest gain from an unknown input to the estimate",
    "bias": "largest mean of the estimate without a fault",
    "s to alarm": "median detection delay; never: not within the run",
    "smallest": "step that half of the runs detect",
    "bound": (
        "largest estimate without a fault, for the exact model (tolerances not counted) and held disturbances: those "
        f"of the scenario, with noise within {DEVIATIONS:g} standard deviations"
    ),
    "bound / optimum": (
        f"1 = as sensitive as the best test with the same delay on {LONGEST_WINDOW} samples of inputs and outputs (on "
        "fewer of plants with more than 78 states); below 1 = better, because the observer uses older samples"
    ),
    "rms": (
        "root mean square of the estimate less the fault of the same sample in the runs, or on the log where it has a "
        "column of the fault"
    ),
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
                for column in _NEVER_COLUMNS:
                    if np.isinf(figures[column]):
                        texts[column] = "never"
                if self._has_delays and np.isinf(fault.equal_delay):
                    texts[-3] = "never"
                for column in _TIME_COLUMNS:
                    if np.isinf(figures[column]):
                        texts[column] = f"> {number(fault.figures.horizon, digits=3)}"
                if np.isfinite(fault.bound):
                    is_rounding = fault.bound <= ROUNDED_BOUND * fault.size
                    texts[_BOUND_COLUMN] = "0" if is_rounding else upper_number(fault.bound)
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
    def units(self) -> dict[str, str]:
        """The units of the signals, by their names."""
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
        sentences = ("; ".join(texts) + ".", _OF_THE_EXACT_MODEL, self._of_assumed_noise, self._of_settled_gains)
        return " ".join(filter(None, sentences))

    @property
    def _of_assumed_noise(self) -> str:
        """Which noise deviations are for where the plant states none, in a sentence; empty where it does."""
        # Methods that have covariances of their own keep a plant without noise, which tells nothing of the one given.
        plants = [entry.design.plant for entry in self.methods if entry.design is not None]
        stated = [
            plant.nw and not is_noise_assumed(plant.noise_names)
            for plant in plants
            if isinstance(plant, DescriptorSystem)
        ]
        if all(stated):
            return ""
        return "The plant states no noise: deviations are for white noise of deviation 1 on every output."

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
        refused = ((entry.method, entry.refused) for entry in self.methods if entry.refused)
        return tuple(f"{method}: {text.removeprefix(f'{method} ')}" for method, text in refused)

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
        return write_atomically(path, text, kind=RESULT_FILE)

    def plot(self) -> Figure:
        """Return a figure: for each fault, each method's estimate of a unit step, and its estimate on the scenario.

        Estimates that are much noisier than the best one are drawn in a panel of their own, each in its full range.
        """
        import matplotlib.pyplot as plt

        return self._drawn(plt.figure)

    def _drawn(self, new_figure: Callable[..., Figure]) -> Figure:
        return drawn_comparison(
            self.methods,
            self.fault_names,
            self.times,
            self.truth,
            sample_time=self.sample_time,
            units=self.units,
            new_figure=new_figure,
        )

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
        table = (head, *((method, with_unit(fault, self.units), *cells) for method, fault, *cells in rows))
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
        largest_gain([figures]),
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
    return "-" if np.isnan(value) else "inf" if np.isinf(value) else number(value, digits=3)

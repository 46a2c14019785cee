"""What `obsynth.compare` returns: one row per method, one recommendation, one picture."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from obsynth.files.outputs import FileKind
from obsynth.files.tables import html_table, text_table
from obsynth.methods.fault_figures import FaultFigures
from obsynth.numerics.arrays import FloatArray
from obsynth.results.design import ObserverDesign

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class FaultComparison:
    """How one method estimates one fault.

    Parameters
    ----------
    figures : FaultFigures
        In closed form, on the nominal plant.
    rms : float
        Root mean square of ``fhat - f`` over the drawn runs of the scenario, not shifted by any delay.
    bias : float
        Largest absolute mean over the runs of the estimate without a fault: what tolerances and disturbances make.
    threshold : float
        Level of an alarm, calibrated on the fault-free runs.
    detection_delay : float, seconds
        Median over the runs, from the start of the fault.
    smallest_found : float
        Size of a step that half of the runs find.
    """

    figures: FaultFigures
    rms: float
    bias: float
    threshold: float
    detection_delay: float
    smallest_found: float


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

    @property
    def rms(self) -> float:
        """Root mean square over all faults, each in its own unit."""
        return float(np.sqrt(np.mean([found.rms**2 for found in self.faults]))) if self.faults else float("inf")


#: A picture of estimates reaches as far as this share of their samples.
SHOWN = 0.98
#: What the page of a comparison begins with.
COMPARISON_PAGE = FileKind("a comparison of obsynth", rb'name="generator" content="obsynth compare"')
_HEADER = (
    "method",
    "fault",
    "order",
    "50 % s",
    "90 % s",
    "at horizon",
    "peak",
    "deviation",
    "leak",
    "bias",
    "alarm s",
    "smallest",
    "rms",
    "ms",
)


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
    """

    methods: tuple[ComparedMethod, ...]
    recommended: str
    reason: str
    sample_time: float
    times: FloatArray
    truth: FloatArray
    fault_names: tuple[str, ...]
    setting: str

    def __getitem__(self, method: str) -> ComparedMethod:
        for found in self.methods:
            if found.method == method:
                return found
        raise KeyError(f"no method {method!r}; there are: {', '.join(found.method for found in self.methods)}")

    def rows(self) -> tuple[tuple[str, ...], ...]:
        """Return the table as texts: the header, then a row for each method and fault."""
        rows = []
        for entry in self.methods:
            for k, fault in enumerate(entry.faults):
                figures = fault.figures
                numbers = (
                    figures.half,
                    figures.most,
                    figures.at_horizon,
                    figures.peak,
                    figures.deviation,
                    figures.leak,
                    fault.bias,
                    fault.detection_delay,
                    fault.smallest_found,
                    fault.rms,
                )
                rows.append(
                    (
                        entry.method if k == 0 else "",
                        figures.fault,
                        str(entry.order) if k == 0 else "",
                        *(_number(value) for value in numbers),
                        f"{entry.milliseconds:.0f}" if k == 0 else "",
                    )
                )
        return (_HEADER, *rows)

    @property
    def refusals(self) -> tuple[str, ...]:
        """Methods that do not exist, each with the reason in one line."""
        return tuple(f"{entry.method}: {entry.refused}" for entry in self.methods if entry.refused)

    def to_dict(self) -> dict[str, Any]:
        """Return the comparison as plain data."""
        header, *rows = self.rows()
        return {
            "recommended": self.recommended,
            "reason": self.reason,
            "sample_time": self.sample_time,
            "setting": self.setting,
            "refusals": list(self.refusals),
            "rows": [dict(zip(header, row, strict=True)) for row in rows],
            "methods": [
                {
                    "method": entry.method,
                    "order": entry.order,
                    "fast_enough": entry.fast_enough,
                    "rms": entry.rms,
                    "faults": [
                        {**vars(fault.figures), **{k: v for k, v in vars(fault).items() if k != "figures"}}
                        for fault in entry.faults
                    ],
                }
                for entry in self.methods
                if not entry.refused
            ],
        }

    def plot(self) -> Figure:
        """Return a figure: for each fault, what each method makes of a unit step, and its estimate on the scenario."""
        from matplotlib.figure import Figure

        shown = [entry for entry in self.methods if entry.faults]
        count = max(len(self.fault_names), 1)
        figure = Figure(figsize=(11.0, 2.8 * count), layout="constrained")
        axes = figure.subplots(count, 2, squeeze=False)
        for row, name in enumerate(self.fault_names):
            left, right = axes[row]
            right.plot(self.times, self.truth[:, row], color="0.3", linewidth=1.5, label="fault")
            left.axhline(1.0, color="0.8", linewidth=0.8)
            for rank, entry in enumerate(shown):
                # The best lies on top.
                height = 3.0 + len(shown) - rank
                names = [fault.figures.fault for fault in entry.faults]
                if name not in names:
                    continue
                column = names.index(name)
                response = np.clip(entry.responses[:, column], -1.0, 3.0)
                left.plot(np.arange(len(response)) * self.sample_time, response, label=entry.method, zorder=height)
                right.plot(self.times, entry.estimates[:, column], linewidth=0.8, zorder=height)
            left.set(xlabel="s after a unit step", ylabel=f"estimate of {name}")
            times = [f.figures.most for entry in shown for f in entry.faults if np.isfinite(f.figures.most)]
            length = max((len(entry.responses) for entry in shown), default=2) * self.sample_time
            left.set_xlim(0.0, min(max([3.0 * max(times, default=length), 10.0 * self.sample_time]), length))
            right.set(xlabel="s", ylabel=name)
            spread = float(np.max(np.abs(self.truth[:, row]), initial=0.0)) or 1.0
            best = shown[0].estimates[:, 0] if shown else self.truth[:, row]
            reach = max(2.5 * spread, 1.5 * float(np.quantile(np.abs(best), SHOWN))) if row == 0 else 2.5 * spread
            right.set_ylim(-reach, reach)
        axes[0, 0].legend(fontsize=8)
        return figure

    def __str__(self) -> str:
        return "\n".join([self.setting, *text_table(self.rows(), left=2), *self.refusals, self.advice])

    @property
    def advice(self) -> str:
        """The recommendation with its reason."""
        return f"Take {self.recommended}: {self.reason}." if self.recommended else f"None exists: {self.reason}."

    def _repr_html_(self) -> str:
        return f"<p>{escape(self.setting)}</p>{html_table(self.rows())}" + "".join(
            f"<p>{escape(text)}</p>" for text in (*self.refusals, self.advice)
        )

    def page(self) -> str:
        """Return a page of HTML that stands alone, with table, picture, refusals and recommendation."""
        from base64 import b64encode
        from io import BytesIO

        picture = BytesIO()
        self.plot().savefig(picture, format="png", dpi=110)
        encoded = b64encode(picture.getvalue()).decode("ascii")
        style = "body{font-family:sans-serif;margin:2em;max-width:75em}td,th{padding:.2em .6em;text-align:right}"
        return (
            "<!DOCTYPE html><html lang='en'><head><meta charset='utf-8'>"
            '<meta name="generator" content="obsynth compare"><title>Comparison of methods</title>'
            f"<style>{style}</style></head><body><h1>{escape(self.advice)}</h1>{self._repr_html_()}"
            f"<img alt='Estimates of each method' style='max-width:100%' src='data:image/png;base64,{encoded}'></body>"
            "</html>\n"
        )


def _number(value: float) -> str:
    return "-" if np.isnan(value) else "never" if np.isinf(value) else f"{value:.3g}"

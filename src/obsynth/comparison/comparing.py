"""Every method that exists for a plant, designed, on one clock and on the same draws.

The stated scenario, many times: disturbances, noise and tolerances drawn; the same draws for every method.

Beside every method's threshold the least that any test can have: same bounds, same delay, same faults left out.

What `obsynth.compare` returns: one row per method, one recommendation, one picture.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from obsynth.analysis.transformations.linear_plants import Transformation, linear_plant
from obsynth.data.run import faults_on_rows
from obsynth.data.sources import TIME_HEADER, log_table
from obsynth.data.stuck_sensors import stuck_rows, stuck_texts
from obsynth.errors import ObsynthError, SpecError
from obsynth.experiments.assumptions import Log
from obsynth.experiments.monitors.residual_model import largest_disturbances
from obsynth.files.outputs import FileKind, write_atomically
from obsynth.files.tables import html_table, standing_page, text_table
from obsynth.methods.automatic import (
    DECOUPLED,
    SETTLING_TIMES,
    Candidate,
    FaultFigures,
    Maker,
    candidate,
    held,
    linear_methods,
    on_the_clock,
    step_responses,
)
from obsynth.methods.designing import agree, design
from obsynth.methods.functional_filter.kalman_gain import settling_time
from obsynth.methods.guaranteed_test.method import GuaranteedTestMethod
from obsynth.methods.guaranteed_test.problem import MOST_STATES, problem_of
from obsynth.methods.guaranteed_test.programs import largest_hidden_fault
from obsynth.methods.registry import method_class
from obsynth.numerics.arguments import (
    Count,
    FloatArray,
    NonNegative,
    Positive,
    Probability,
    arguments_checked,
    is_finite_number,
    read_only,
    require_kind,
)
from obsynth.numerics.continuous import driven
from obsynth.numerics.libraries import on_one_thread_if_small
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plotting.panels import (
    LINE_COLOURS,
    TRUE_STYLE,
    data_url,
    label_time,
    legend_above,
    tidy,
    with_unit,
    written,
)
from obsynth.results.design import COMPARISON, SHOWN_DIGITS, ObserverDesign, design_as_dict, result_text
from obsynth.simulation.scenario import Scenario, Sine, Step, resolve, scenario_from
from obsynth.tolerances.robustness import plant_at

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
        What the estimate never passes without a fault, with disturbances as large as in the scenario and three
        deviations of noise: sums of absolute values.
    least : float
        The least such bound that any test with the same delay on at most `LONGEST_WINDOW` samples can have, linear or
        not: of a fault of any time course where the estimate is one sample of it, else of a constant one.  An observer
        uses all samples before, and its bound may be smaller.
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
    def relative_error(self) -> float:
        """Root mean square over all faults of each one's error, as a share of its size: the same in all units."""
        return relative_error([vars(found) for found in self.faults])


def relative_error(faults: Sequence[Mapping[str, Any]]) -> float:
    """Return the root mean square of ``rms / size`` over faults; infinite where there are none."""
    shares = [fault["rms"] / fault["size"] if fault["rms"] else 0.0 for fault in faults]
    return rms(shares) if shares else float("inf")


#: Samples of the window on which the least threshold is looked for, at most.
LONGEST_WINDOW = 32
#: A picture of estimates reaches as far as this share of their samples.
SHOWN_SAMPLES = 0.98
#: Room below and above a fault in its panel, as a share of its range.
ROOM_AROUND_FAULT = 0.75
#: Opacity of an estimate that reaches beyond its panel.
FAINT = 0.25
#: What the page of a comparison begins with.
COMPARISON_PAGE = FileKind("a comparison of obsynth", rb'name="generator" content="obsynth compare"', suffix=".html")
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
    "/ least",
    "rms",
    "ms",
)
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
    "bound": "what the estimate never exceeds without a fault",
    "/ least": f"the bound, divided by the least of all tests with this delay on at most {LONGEST_WINDOW} samples",
    "rms": "root mean square error in the runs, or on the log where it has a column of the fault",
    "ms": "milliseconds to design and verify",
}


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
                    figures.unknown_input_gain,
                    fault.bias,
                    fault.detection_delay,
                    fault.smallest_found,
                    fault.bound,
                    fault.bound / fault.least if fault.least > 0.0 else np.nan,
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
    def _units(self) -> dict[str, str]:
        return next((dict(entry.design.plant.units) for entry in self.methods if entry.design is not None), {})

    def meanings(self, columns: Sequence[str] = _HEADER) -> str:
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
        return "; ".join(f"{name}: {_FIGURE_MEANINGS[name]}" for name in columns if name in _FIGURE_MEANINGS) + "."

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
            "notes": list(self.notes),
            "refusals": list(self.refusals),
            "rows": [dict(zip(header, row, strict=True)) for row in rows],
            "methods": [{"method": name, **entry} for name, entry in self.claims()["methods"].items()],
        }

    def claims(self) -> dict[str, Any]:
        """Return what a certificate claims: the figures of every design on the same draws."""
        figures = {
            entry.method: {
                "order": entry.order,
                "fast_enough": entry.fast_enough,
                "relative_error": entry.relative_error,
                "faults": [
                    {**vars(fault.figures), **{k: v for k, v in vars(fault).items() if k != "figures"}}
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

        An estimate that is too noisy for the range of its panel lies faintly behind the others.
        """
        import matplotlib.pyplot as plt

        return self._drawn(plt.figure)

    def _drawn(self, new_figure: Callable[..., Figure]) -> Figure:
        shown = [entry for entry in self.methods if entry.faults]
        count = len(self.fault_names)
        figure = new_figure(figsize=(11.0, 2.8 * count), layout="constrained")
        axes = figure.subplots(count, 2, squeeze=False)
        for row, name in enumerate(self.fault_names):
            left, right = axes[row]
            right.plot(self.times, self.truth[:, row], label="fault", **TRUE_STYLE)
            left.axhline(1.0, color="0.8", linewidth=0.8)
            low, high = self._range(shown, row)
            for rank, entry in enumerate(shown):
                names = [fault.figures.fault for fault in entry.faults]
                if name not in names:
                    continue
                column, colour = names.index(name), LINE_COLOURS[rank % len(LINE_COLOURS)]
                # The best lies on top.
                style: dict[str, Any] = {"color": colour, "zorder": 3.0 + len(shown) - rank}
                response, estimate = np.clip(entry.responses[:, column], -1.0, 3.0), entry.estimates[:, column]
                left.plot(np.arange(len(response)) * self.sample_time, response, label=entry.method, **style)
                noisy = float(np.nanquantile(np.abs(estimate), SHOWN_SAMPLES)) > max(-low, high)
                faint = {"alpha": FAINT, "linewidth": 0.4, "zorder": 1.0} if noisy else {"linewidth": 0.8}
                right.plot(self.times, estimate, **{**style, **faint})
            times = [f.figures.most for entry in shown for f in entry.faults if np.isfinite(f.figures.most)]
            length = max((len(entry.responses) for entry in shown), default=2) * self.sample_time
            left.set_xlim(0.0, min(max([3.0 * max(times, default=length), 10.0 * self.sample_time]), length))
            left.set_ylabel(f"estimate of a unit step\nof {name}")
            right.set_ylabel(with_unit(name, self._units))
            right.set_ylim(low, high)
            for panel in (left, right):
                label_time(panel)
                tidy(panel)
        legend_above(axes[0, 0])
        legend_above(axes[0, 1])
        return figure

    def _range(self, shown: Sequence[ComparedMethod], row: int) -> tuple[float, float]:
        """Return the ends of the panel of a fault: room about the fault, and for the best estimate of the first one."""
        known = self.truth[np.isfinite(self.truth[:, row]), row]
        low, high = float(np.min(known, initial=0.0)), float(np.max(known, initial=0.0))
        room = ROOM_AROUND_FAULT * (high - low or 1.0)
        if row or not shown:
            return low - room, high + room
        best = np.nanquantile(shown[0].estimates[:, 0], (1.0 - SHOWN_SAMPLES, SHOWN_SAMPLES))
        return min(low - room, 1.5 * float(best[0])), max(high + room, 1.5 * float(best[1]))

    def __repr__(self) -> str:
        table = text_table(self.rows(), left=2)
        return "\n".join([self.setting, *self.notes, *table, self.meanings(), *self.refusals, self.advice])

    @property
    def advice(self) -> str:
        """The recommendation with its reason."""
        return f"Take {self.recommended}: {self.reason}." if self.recommended else f"None exists: {self.reason}."

    def _repr_html_(self) -> str:
        return f"<p>{escape(self.setting)}</p>{html_table(self.rows())}" + "".join(
            f"<p>{escape(text)}</p>" for text in (*self.notes, self.meanings(), *self.refusals, self.advice)
        )

    def page(self) -> str:
        """Return a page of HTML that stands alone, with table, picture, refusals and recommendation."""
        from matplotlib.figure import Figure

        picture = data_url(written(self._drawn(Figure)))
        meanings = "".join(f"<li>{escape(f'{name}: {text}')}</li>" for name, text in _FIGURE_MEANINGS.items())
        refused = "".join(f"<li>{escape(text)}</li>" for text in self.refusals)
        head, *rows = self.rows()
        # With the unit of each fault, in which its figures are.
        table = (head, *((method, with_unit(fault, self._units), *others) for method, fault, *others in rows))
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
    best = min(methods, key=lambda name: (not methods[name]["fast_enough"], errors[name]))
    others = ", ".join(f"{errors[name]:.4g} of {name}" for name in methods if name != best)
    fast = "" if methods[best]["fast_enough"] else ", though none reaches 90 % of a step within the time asked for"
    where = "" if log is None else f", errors on {log['name']} (sha256 {log['sha256'][:SHOWN_DIGITS]})"
    kept = ", ".join(f"{name} {digest[:SHOWN_DIGITS]}" for name, digest in digests.items())
    against = f" against {others}" if others else ""
    return (
        f"Of the methods that exist, {best} has the least rms error of the fault estimates, as a share of each fault's "
        f"size ({errors[best]:.4g}{against}){fast}: {claims['setting']}{where}. Gain sets: {kept}."
    )


def _number(value: float) -> str:
    return "-" if np.isnan(value) else "never" if np.isinf(value) else f"{value:.3g}"


#: Noise counts as within so many deviations.
DEVIATIONS = 3.0
#: What a response may differ from one sample of the fault, and be taken as it.
SAME_RESPONSE = 1e-6
#: A response is followed for `SETTLING_TIMES`, and for so many steps at most.
MOST_RESPONSE_STEPS = 6000


def thresholds_beside_least(
    plant: DescriptorSystem, impulses: FloatArray, faults: Sequence[str], bounds: FloatArray
) -> list[tuple[float, float]]:
    """Return for each estimate what it never passes without a fault, and the least that any test with its delay has.

    ``plant`` sampled; ``impulses (steps, estimates, nf + nd + nw)`` as of `step_responses`; ``bounds (nd,)`` of the
    disturbances, noise within `DEVIATIONS`.  The first is a sum of absolute values; NaN where none is known.
    """
    noisy = bool(plant.Dw.any() or plant.Bw.any())
    noise = np.full(impulses.shape[2] - plant.nf - plant.nd, DEVIATIONS if noisy else 0.0)
    found = []
    for row, name in enumerate(faults):
        gains = np.abs(impulses[:, row]).sum(axis=0)
        bound = float(gains[plant.nf :] @ np.concatenate([bounds, noise]))
        seen = impulses[:, row, plant.fault_names.index(name)]
        lag = int(np.argmax(np.abs(seen) > SAME_RESPONSE))
        alone = abs(seen[lag] - 1.0) <= SAME_RESPONSE and float(np.abs(seen).sum() - abs(seen[lag])) <= SAME_RESPONSE
        blind = [other for k, other in enumerate(plant.fault_names) if other != name and gains[k] <= SAME_RESPONSE]
        found.append((bound, _least(plant, name, bounds, noisy=noisy, lag=lag if alone else None, blind=blind)))
    return found


def _least(
    plant: DescriptorSystem, fault: str, bounds: FloatArray, *, noisy: bool, lag: int | None, blind: list[str]
) -> float:
    """Return the least threshold: of a fault of any time course told after a lag, else of a constant one."""
    course = {"course": "constant"} if lag is None else {"course": "any", "lag": lag}
    samples = max(min(LONGEST_WINDOW, MOST_STATES // max(plant.nx, 1)), (lag or 0) + 2)
    try:
        asked = GuaranteedTestMethod.of({
            "fault": fault, "samples": samples, "free": blind, "noise_bound": DEVIATIONS if noisy else None,
            "disturbance_bounds": dict(zip(plant.disturbance_names, bounds.tolist(), strict=True)), **course,
        })  # fmt: skip
        size = largest_hidden_fault(problem_of(plant, asked).window(samples)).size
    except ObsynthError:
        return float("nan")
    return size if np.isfinite(size) else float("nan")


def in_words(fault: str, bound: float, least: float, unit: str = "") -> str:
    """Return a sentence on one fault."""
    own = f"Without a fault the estimate of {fault} stays within {bound:.4g}{f' {unit}' if unit else ''}"
    if not np.isfinite(least):
        return f"{own}; its least threshold is not known."
    if least <= SAME_RESPONSE * bound:
        return f"{own}; a test exists on which disturbances and noise have no effect."
    return (
        f"{own}, {bound / least:.2f} times the least of all tests with its delay on at most {LONGEST_WINDOW} "
        f"samples ({least:.4g})."
    )


def design_beside_least(design: ObserverDesign, scenario: Scenario) -> dict[str, tuple[float, float]]:
    """Return the same by fault for a linear design that estimates faults, on a scenario; empty for others."""
    if not isinstance(design.observer, LinearObserver) or not isinstance(design.plant, DescriptorSystem):
        return {}
    plant, observer = design.linear
    if not plant.is_discrete or not observer.fault_names:
        return {}
    try:
        sampled = on_the_clock(plant, plant.dt)
        steps = int(min(max(SETTLING_TIMES * settling_time(plant) / plant.dt, observer.order + 2), MOST_RESPONSE_STEPS))
        steps, feedback = held(sampled, steps)
        impulses, _ = step_responses(sampled, observer, steps, feedback)
        bounds = largest_disturbances(scenario, sampled.disturbance_names, steps, plant.dt)
    except ObsynthError:
        return {}
    pairs = thresholds_beside_least(sampled, impulses, observer.fault_names, bounds)
    return dict(zip(observer.fault_names, pairs, strict=True))


#: Entries of A, B, Bf, Bd that tolerances do not touch: they are kinematics, not parameters.
EXACT_ENTRIES = (0.0, 1.0, -1.0)


@dataclass(frozen=True, eq=False)
class Record:
    """What observers are run on, ``(.., steps, ..)``: many runs of drawn plants, or a log."""

    times: FloatArray  # ``(steps,)``, seconds
    u: FloatArray
    y: FloatArray
    truth: FloatArray  # ``(steps, nf)``: the faults, zero where a log has no column of one
    known: tuple[str, ...] = ()  # the faults of which a log has a column
    notes: tuple[str, ...] = ()  # what is to be said of a log


def drawn_runs(
    source: DescriptorSystem,
    sampled: DescriptorSystem,
    scenario: Scenario,
    *,
    runs: int,
    tolerance: float,
    seed: int,
    feedback: FloatArray,
) -> tuple[Record, Record]:
    """Return runs ``(runs, steps, ..)`` with the scenario's faults, and without any; plants are drawn before they are
    sampled, and disturbances by a factor between -1 and 1."""
    drive = resolve(sampled, scenario)
    nu, nf = sampled.nu, sampled.nf
    rng = np.random.default_rng(seed)
    seeds = [int(value) for value in rng.integers(0, 2**31, size=runs)]
    random, noise, sensors = drive.drawn(seeds, sampled.nw)
    scales = rng.uniform(-1.0, 1.0, size=(runs, sampled.nd))
    faults = drive.left[:, nu : nu + nf]
    found: list[tuple[list[FloatArray], list[FloatArray]]] = [([], []), ([], [])]
    off = tolerance > 0.0 or source.uncertainty is not None
    for run in range(runs):
        plant = on_the_clock(_drawn(source, tolerance, rng), sampled.dt) if off else sampled
        signals = drive.left + random[:, run]
        d = signals[:, nu + nf :] * scales[run]
        shaken = noise[:, run] if noise.shape[2] == plant.nw else np.zeros((drive.steps, plant.nw))
        for (inputs, outputs), f in zip(found, (signals[:, nu : nu + nf], np.zeros((drive.steps, nf))), strict=True):
            measured, known = _outputs(plant, signals[:, :nu], d, f, shaken, feedback)
            inputs.append(known)
            outputs.append(measured + sensors[:, run])
    times = _clock(drive.steps, drive.dt)
    (u, y), (healthy_u, healthy_y) = ((np.array(inputs), np.array(outputs)) for inputs, outputs in found)
    return Record(times, u, y, faults), Record(times, healthy_u, healthy_y, np.zeros_like(faults))


def estimates(observer: LinearObserver, runs: Record) -> FloatArray:
    """Return fault estimates ``(runs, steps, faults)`` of an observer at rest."""
    rows, y, known = observer.fault_rows, runs.y.swapaxes(0, 1), runs.u.swapaxes(0, 1)
    z = driven(observer.Az, np.zeros(observer.order), y @ observer.By.T + known @ observer.Bu.T)
    with np.errstate(over="ignore", invalid="ignore"):
        found = z @ observer.Cz[rows].T + y @ observer.Dy[rows].T + known @ observer.Du[rows].T + observer.added[rows]
    return np.ascontiguousarray(found.swapaxes(0, 1))


def _outputs(
    plant: DescriptorSystem, u: FloatArray, d: FloatArray, f: FloatArray, w: FloatArray, feedback: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return outputs and known inputs ``(steps, ..)`` of a plant at rest, with ``u - feedback x`` as its input."""
    into = u @ plant.B.T + d @ plant.Bd.T + f @ plant.Bf.T + w @ plant.Bw.T
    direct = u @ plant.D.T + d @ plant.Dd.T + f @ plant.Df.T + w @ plant.Dw.T
    closed, seen = plant.A - plant.B @ feedback, plant.C - plant.D @ feedback
    states = driven(closed, np.zeros(plant.nx), into)
    return np.asarray(states @ seen.T + direct), np.asarray(u - states @ feedback.T)


def _drawn(plant: DescriptorSystem, tolerance: float, rng: np.random.Generator) -> DescriptorSystem:
    """Return a plant with its constants within their tolerances, and parameters off by up to one; equal stay equal."""
    if plant.uncertainty is not None:
        box = plant.uncertainty.box
        plant = plant_at(plant, box.values(rng.uniform(-1.0, 1.0, size=len(box.names))))
        if not tolerance:
            return plant
    factors: dict[float, float] = {}

    def off(matrix: FloatArray) -> FloatArray:
        changed = matrix.copy()
        for index, value in np.ndenumerate(matrix):
            if value not in EXACT_ENTRIES:
                factor = factors.setdefault(abs(float(value)), 1.0 + tolerance * rng.uniform(-1.0, 1.0))
                changed[index] = value * factor
        return changed

    return plant.replace(E=off(plant.E), A=off(plant.A), B=off(plant.B), Bf=off(plant.Bf), Bd=off(plant.Bd))


def alarms(
    found: FloatArray, quiet: FloatArray, fault: FloatArray, response: FloatArray, false_alarms: float, dt: float
) -> tuple[float, float, float]:
    """Return threshold (passed in a share of the fault-free runs), median detection delay (s) and smallest fault found.
    ``found, quiet (runs, steps)``: estimates with and without the fault; ``response (steps,)``: to a unit step."""
    level = float(np.quantile(np.max(np.abs(quiet), axis=1), 1.0 - false_alarms))
    acts = np.flatnonzero(fault)
    if not acts.size:
        return level, float("nan"), float("nan")
    first = int(acts[0])
    above = np.abs(found[:, first:]) > level
    delays = np.where(above.any(axis=1), np.argmax(above, axis=1) * dt, np.inf)
    # The response is computed as far as a step is followed, which may be less than the record.
    length = min(len(fault) - first, len(response))
    shown = np.maximum(response[:length], 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        needed = np.where(shown > 0.0, (level - quiet[:, first : first + length]) / shown, np.inf)
    smallest = np.maximum(np.min(needed, axis=1), 0.0)
    return level, float(np.median(delays)), float(np.median(smallest))


def rms(errors: Sequence[float] | FloatArray) -> float:
    """Return the root of the mean square; where a sample is missing (NaN) there is no error."""
    values = np.asarray(errors, dtype=np.float64)
    values = values[~np.isnan(values)]
    return float(np.sqrt(np.mean(values**2))) if values.size else float("nan")


#: Runs of the scenario, and samples and settling times where nothing is stated.
RUNS, SCENARIO_SAMPLES, MOST_SCENARIO_SAMPLES = 20, 40, 6000
COMPARISON_SEED = 7
#: Unknown inputs of the scenario that is made up are sines with so many periods in a settling time.
PERIOD_SHARE = 0.2


@arguments_checked
@on_one_thread_if_small
def compare(
    plant: DescriptorSystem | Transformation,
    *,
    scenario: Scenario | None = None,
    options: Mapping[str, Mapping[str, Any]] | None = None,
    methods: Sequence[str] | None = None,
    sample_time: Positive | None = None,
    within: Positive | None = None,
    tolerance: NonNegative = 0.0,
    disturbance: NonNegative = 1.0,
    runs: Count = RUNS,
    false_alarms: Probability = 0.05,
    data: Any = None,
    columns: Mapping[str, str] | None = None,
    scales: Mapping[str, float] | None = None,
    input_delay: int = 0,
    progress: Callable[[str], None] | None = None,
) -> Comparison:
    """Design every method that exists for a plant and put them side by side, on one clock and the same draws.

    Methods are ranked by the root mean square error over the scenario, with disturbances, noise and tolerances drawn,
    as a share of the size of each fault there, so that units do not matter, among those whose estimate reaches 90 % of
    a step within the time asked for.

    Parameters
    ----------
    plant : DescriptorSystem or Transformation
        Either time, with faults.  A continuous one is sampled: methods are designed for the samples where they can be.
        Options such as poles are for the plant: such a method of either time is designed for it, and sampled
        afterwards.  Of a transformation they are for the plant that it makes; compared is the one it starts from.
    scenario : Scenario, optional
        What happens; by default each fault in turn is a step, while every unknown input is a sinusoid.
    options : mapping of str to mapping, optional
        Options by method id.
    methods : sequence of str, optional
        Ids; by default all for linear plants.
    sample_time : float, optional, seconds
        The clock of a continuous plant; by default that of the scenario, or a fortieth of the plant's settling time.
    within : float, optional, seconds
        Time within which 90 % of a step must be shown; by default the plant's settling time.
    tolerance : float, optional
        Relative: each parameter of a drawn plant is off by up to this.
    disturbance : float, optional
        Amplitude of unknown inputs where no scenario is given.
    runs : int, optional
        Drawn runs, with and without faults each.
    false_alarms : float, optional
        Share of fault-free runs that pass the threshold of an alarm.
    data : str, Path or DataFrame, optional
        A log with the outputs and inputs by name, replayed through every method; columns named as faults are the truth.
    input_delay : int, optional
        Rows of ``data`` by which inputs act later than during the step that begins with them.
    columns, scales : mapping, optional
        Columns of signals where their names differ, and factors of their values, as for `obsynth.run_on_data`.
    progress : callable, optional
        Called with a text at the start of each stage.

    Returns
    -------
    Comparison
        ``times (steps,)``, ``truth (steps, nf)``; refused methods with the reason in one line.

    Raises
    ------
    SpecError
        The plant has no faults, an argument is out of range, a method is unknown, or the log lacks a column.

    References
    ----------
    Ours: see `Comparison` for what each number means.
    """
    made = linear_plant(plant)
    # Some methods are continuous, and so are tolerances; faults and unknown inputs are those of the plant as written.
    plant, clock = (plant.source, made.dt or None) if isinstance(plant, Transformation) else (made, None)
    sample_time = clock if sample_time is None else sample_time
    if plant.nf == 0:
        raise SpecError("The plant has no faults, so there are no fault estimates to compare.", path="plant")
    unused = sorted(name for name, given in (("columns", columns), ("scales", scales)) if given and data is None)
    if unused:
        raise SpecError(f"{unused[0]} is for a log: give data.", path=unused[0])
    if scenario is not None and disturbance != 1.0:
        raise SpecError("disturbance is for the default scenario: the scenario that is given states its own.",
                        path="disturbance")  # fmt: skip
    if plant.dt and sample_time not in (None, plant.dt):
        raise SpecError(f"sample_time is for continuous plants: this one has {plant.dt:g} s.", path="sample_time")
    known = [spec.id for spec in linear_methods()]
    unknown = [name for name in methods or () if name not in known]
    if unknown:
        raise SpecError(f"{', '.join(map(repr, unknown))}: use some of {', '.join(known)}.", path="methods")
    ids = known if methods is None else list(methods)
    for method in options or {}:
        if method not in ids:
            raise SpecError(f"options has {method!r}, which is not compared: {', '.join(ids)} are.", path="options")
    return side_by_side(
        plant,
        scenario,
        ids,
        lambda given, method, own: design(given, method, **own),
        sample_time=sample_time,
        within=within,
        tolerance=float(tolerance),
        disturbance=float(disturbance),
        runs=int(runs),
        false_alarms=float(false_alarms),
        input_delay=int(input_delay),
        options=options or {},
        of_samples=made.dt > 0.0,
        data=data,
        columns=columns,
        scales=scales,
        progress=progress,
    )


def side_by_side(
    plant: DescriptorSystem,
    scenario: Scenario | None,
    methods: Sequence[str],
    maker: Maker,
    *,
    sample_time: float | None,
    within: float | None,
    tolerance: float,
    disturbance: float,
    runs: int,
    false_alarms: float,
    input_delay: int = 0,
    options: Mapping[str, Mapping[str, Any]] | None = None,
    of_samples: bool = True,
    data: Any = None,
    columns: Mapping[str, str] | None = None,
    scales: Mapping[str, float] | None = None,
    progress: Callable[[str], None] | None = None,
) -> Comparison:
    """Return the designs that ``maker(plant, method, options)`` gives side by side; arguments as for `compare`.

    ``of_samples``: options are for the sampled plant.
    """
    report_stage = progress or (lambda _: None)
    asked = {"plant": plant.as_dict(), "scenario": None if scenario is None else scenario.as_dict(),
             "sample_time": sample_time, "within": within, "tolerance": tolerance, "disturbance": disturbance,
             "runs": runs, "false_alarms": false_alarms,
             **({"input_delay": input_delay} if input_delay else {})}  # fmt: skip
    plant = plant.dense() if plant.is_sparse else plant
    stated = None if scenario is None else scenario.sample_time
    dt = plant.dt or sample_time or stated or settling_time(plant) / SCENARIO_SAMPLES
    sampled = on_the_clock(plant, dt)
    happening = _scenario(plant, scenario, dt, disturbance)
    steps = int(min(happening.horizon / dt, MOST_SCENARIO_SAMPLES)) + 1
    followed, feedback = held(sampled, steps)
    if followed < steps:
        steps, happening = followed, happening.replace(horizon=followed * dt)
    found = []
    for method in methods:
        report_stage(f"designing by {method}")
        own = (options or {}).get(method, {})
        in_own_time = bool(own) and not of_samples and method_class(method).time == "both"
        found.append(candidate(method, plant, sampled, steps, maker, own, continuous=in_own_time))
    report_stage("running the scenario")
    faulty, healthy = drawn_runs(
        plant, sampled, happening, runs=runs, tolerance=tolerance, seed=COMPARISON_SEED, feedback=feedback
    )
    log = None if data is None else _log(data, sampled, columns, scales, input_delay)
    limit = within if within is not None else settling_time(plant)
    bounds = largest_disturbances(happening, sampled.disturbance_names, followed, dt)
    kept = followed, feedback
    compared = _sized(
        [_compared(entry, sampled, faulty, healthy, log, kept, limit, false_alarms, bounds) for entry in found]
    )
    compared.sort(key=lambda entry: (bool(entry.refused), not entry.fast_enough, entry.relative_error))
    setting = (
        f"{runs} runs of {happening.horizon:g} s, sampled every {dt:g} s, disturbances and noise drawn"
        + (", constants within their tolerances" if plant.uncertainty is not None else "")
        + (f", parameters off by up to {tolerance:.0%}" if tolerance else "")
        + (", a state feedback stabilises the plant" if feedback.any() else "")
        + f"; 90 % of a step to be reached within {limit:.3g} s"
    )
    shown = faulty if log is None else log
    best = next((entry for entry in compared if not entry.refused), None)
    settling = settling_time(plant)
    among = [entry for entry in found if entry.figures and "faults" in method_class(entry.method).purposes]
    usual = min(among, key=lambda entry: entry.rank(sampled.nd > 0, settling), default=None)
    from_file = isinstance(data, (str, Path))
    return Comparison(
        tuple(compared),
        "" if best is None else best.method,
        _reason(best, compared, sampled, "" if usual is None else usual.method),
        dt,
        read_only(shown.times),
        read_only(shown.truth),
        plant.fault_names,
        setting,
        asked if data is None or from_file else {},
        Log.of(Path(data), columns, scales).as_dict() if from_file else None,
        () if log is None else log.notes,
    )


def compared_again(
    body: Mapping[str, Any], designs: Mapping[str, ObserverDesign], log: Path | None
) -> tuple[dict[str, Any], str, list[str]]:
    """Return figures and sentence of a certificate made again from its plant and gain sets, and designs of others."""
    asked = dict(body["asked"])
    plant = DescriptorSystem(**asked.pop("plant"))
    scenario = asked.pop("scenario")
    read = {} if log is None else {"data": log, "columns": body["log"]["columns"], "scales": body["log"]["scales"]}
    found = side_by_side(
        plant,
        None if scenario is None else scenario_from(scenario),
        sorted(designs),
        lambda _, method, __: designs[method],
        **asked,
        **read,
    )
    result = found.claims()
    if log is None and body["log"] is not None:
        # The errors on a log that is not given are assumed.
        for name, entry in result["methods"].items():
            for fault, stored in zip(entry["faults"], body["result"]["methods"][name]["faults"], strict=True):
                fault |= {name: float(stored[name]) for name in ("rms", "size")}
            entry["relative_error"] = relative_error(entry["faults"])
    sampled = on_the_clock(plant, found.sample_time)
    others = [f"plant of {name}" for name, one in designs.items() if not _is_of(one, (plant, sampled))]
    digests = {name: inside["sha256"] for name, inside in body["gain_sets"].items()}
    return result, comparison_statement(body["result"], digests, body["log"]), others


def _is_of(made: ObserverDesign, plants: Sequence[DescriptorSystem]) -> bool:
    """Whether a design is for one of some plants, as it was written or transformed."""
    own = [made.plant] if made.source is None else [made.source.plant, made.plant]
    return any(isinstance(one, DescriptorSystem) and agree(one.dense(), other) for one in own for other in plants)


def _scenario(plant: DescriptorSystem, given: Scenario | None, dt: float, disturbance: float) -> Scenario:
    """Return what happens: the scenario given, with at least the sensors' own noise, or each fault in turn."""
    if given is not None:
        clocked = given if plant.dt or given.sample_time == dt else given.replace(sample_time=dt)
        # All runs begin at rest; a state that is given may be one that the sampled plant does not have any more.
        return clocked.replace(observer_state=None, initial_state={}, stabilise=False)
    settle = max(settling_time(plant), 4.0 * dt)
    length = SETTLING_TIMES * settle
    faults = {
        name: Step(size=1.0, start=(1.0 + 2.0 * i) * length / 2.0, end=(2.0 + 2.0 * i) * length / 2.0)
        for i, name in enumerate(plant.fault_names)
    }
    frequency = PERIOD_SHARE / settle
    return Scenario(
        horizon=min(plant.nf * length, MOST_SCENARIO_SAMPLES * dt),
        sample_time=None if plant.dt else dt,
        faults=faults,
        noise=1.0,
        disturbances={name: Sine(amplitude=disturbance, frequency=frequency) for name in plant.disturbance_names}
        if disturbance
        else {},
    )


def _log(
    data: Any,
    plant: DescriptorSystem,
    columns: Mapping[str, str] | None,
    scales: Mapping[str, float] | None,
    input_delay: int = 0,
) -> Record:
    """Return a log on the clock."""
    import pandas as pd

    if not isinstance(data, (str, Path)):
        require_kind(data, pd.DataFrame, "data", "a file name or a pandas.DataFrame")
    wanted = {
        name: (columns or {}).get(name, name) for name in (*plant.input_names, *plant.output_names, *plant.fault_names)
    }
    table, _, said = log_table(data, list(wanted.values()), (columns or {}).get(TIME_HEADER, TIME_HEADER))
    frame = {name: table[column] for name, column in wanted.items() if column in table}
    shift = None if plant.uncertainty is None else plant.uncertainty.shift
    if shift and frame:
        # The input of a linearised plant that is one in every row has no column.
        frame[shift] = np.ones(max(map(len, frame.values())))
    missing = [wanted[name] for name in (*plant.input_names, *plant.output_names) if name not in frame]
    if missing:
        raise SpecError(f"The log has no column {', '.join(map(repr, missing))}.", path="data")
    count = max(map(len, frame.values()), default=0)
    if not count:
        raise SpecError("The log has no rows.", path="data")
    for name in (*plant.input_names, *plant.output_names):
        if not np.isfinite(frame[name]).any():
            raise SpecError(f"The column {wanted[name]!r} holds no number: {name!r} is never measured.", path="data")

    def signals(names: Sequence[str]) -> FloatArray:
        offsets = np.array([plant.operating_point.get(name, 0.0) for name in names])
        factors = np.array([(scales or {}).get(name, plant.scales.get(name, 1.0)) for name in names])
        values = np.column_stack([frame[name] for name in names]) if names else np.zeros((count, 0))
        return np.asarray(values * factors - offsets)

    there = [name for name in plant.fault_names if name in frame]
    truth = np.zeros((count, plant.nf))
    for name in there:
        truth[:, plant.fault_names.index(name)] = frame[name]
    u, y = signals(plant.input_names), signals(plant.output_names)
    u = u[np.clip(np.arange(count) - input_delay, 0, count - 1)]
    stamps = table.get((columns or {}).get(TIME_HEADER, TIME_HEADER))
    stuck = {name: stuck_rows(values) for name, values in zip(plant.output_names, y.T, strict=True)}
    times = _clock(count, plant.dt) if stamps is None else stamps
    return Record(times, u, y, truth, tuple(there), (*said, *stuck_texts(stuck)))


def _clock(samples: int, dt: float) -> FloatArray:
    return np.asarray(np.arange(samples) * float(dt), dtype=np.float64)


def _compared(
    entry: Candidate,
    plant: DescriptorSystem,
    faulty: Record,
    healthy: Record,
    log: Record | None,
    kept: tuple[int, FloatArray],
    limit: float,
    false_alarms: float,
    bounds: FloatArray,
) -> ComparedMethod:
    nothing = np.zeros((0, 0))
    if entry.observer is None:
        return ComparedMethod(entry.method, entry.refused, None, 0, entry.milliseconds, (), False, nothing, nothing)
    observer = entry.observer
    impulses, responses = step_responses(plant, observer, *kept)
    names = [figures.fault for figures in entry.figures]
    beside = thresholds_beside_least(plant, impulses, names, bounds)
    found, quiet = estimates(observer, faulty), estimates(observer, healthy)
    replayed = None if log is None or entry.design is None else faults_on_rows(entry.design, log.times, log.u, log.y)
    rows = []
    for row, figures in enumerate(entry.figures):
        column = plant.fault_names.index(figures.fault)
        fault = faulty.truth[:, column]
        response = responses[:, row, column]
        level, delay, smallest = alarms(found[:, :, row], quiet[:, :, row], fault, response, false_alarms, plant.dt)
        error, truth = found[:, :, row] - fault, fault
        if replayed is not None and log is not None and figures.fault in log.known:
            truth = log.truth[:, column]
            error = replayed[:, row] - truth
        bias = float(np.max(np.abs(np.mean(quiet[:, :, row], axis=1)), initial=0.0))
        rows.append(FaultComparison(figures, rms(error), rms(truth), bias, level, delay, smallest, *beside[row]))
    shown = found[0] if replayed is None else replayed
    fast = all(fault.figures.reaches and fault.figures.most <= limit for fault in rows)
    own = np.column_stack([responses[:, i, plant.fault_names.index(f.fault)] for i, f in enumerate(entry.figures)])
    return ComparedMethod(
        entry.method,
        "",
        entry.design,
        observer.order,
        entry.milliseconds,
        tuple(rows),
        fast,
        read_only(own),
        read_only(shown),
    )


def _sized(compared: Sequence[ComparedMethod]) -> list[ComparedMethod]:
    """Return the methods with a size for each fault that does not happen: the largest error of any method."""
    largest: dict[str, float] = {}
    for fault in (fault for entry in compared for fault in entry.faults):
        largest[fault.figures.fault] = max(largest.get(fault.figures.fault, 0.0), fault.size or fault.rms)
    return [
        replace(entry, faults=tuple(replace(fault, size=largest[fault.figures.fault]) for fault in entry.faults))
        for entry in compared
    ]


def _reason(
    best: ComparedMethod | None, compared: Sequence[ComparedMethod], plant: DescriptorSystem, by_default: str
) -> str:
    if best is None:
        return compared[0].refused if compared else "no method was asked for"
    others = [entry for entry in compared if not entry.refused and entry is not best]
    words = [f"rms error {best.relative_error:.3g} of the size of the faults"]
    if others and is_finite_number(others[0].relative_error):
        words[0] += f" against {others[0].relative_error:.3g} by {others[0].method}"
    gain = max(fault.figures.unknown_input_gain for fault in best.faults)
    if plant.nd:
        words.append("decoupled from unknown inputs" if gain <= DECOUPLED else f"gain from unknown inputs {gain:.2g}")
    if not best.fast_enough:
        words.append("though none reaches 90 % of a step within the time asked for")
    slow = [entry.method for entry in others if not entry.fast_enough] if best.fast_enough else []
    if slow:
        words.append(f"90 % of a step is reached too late or never: {', '.join(slow)}")
    if by_default not in ("", best.method):
        words.append(
            f"auto, which knows no scenario, takes {by_default}, by whether a step is reached, by the gain from "
            "unknown inputs, and by noise against delay"
        )
    return "; ".join(words)

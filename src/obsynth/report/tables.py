"""Designs, plants and scenarios for people, as tables and sentences.

A finished design: what its plant is, what it promises, and what it may still not do; in about twelve lines: what it is,
what each fault estimate is worth, what it rests on.

A plant: its structure, what can be diagnosed on it, which methods can serve it, its matrices as text.

Simulations, evaluations and comparisons: how far estimates were off, how often alarms were right.
"""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from html import escape
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from obsynth.analysis.diagnosis.fault_columns import dc_point, others, question
from obsynth.analysis.structure import Structure, questions
from obsynth.analysis.transformations.linear_plants import StateRecovery
from obsynth.errors import ObsynthError, PreconditionError
from obsynth.files.outputs import yaml_text
from obsynth.files.tables import html_table
from obsynth.methods.automatic import SETTLING_SAMPLES, FaultFigures, fault_figures, on_the_clock
from obsynth.methods.functional_filter.kalman_gain import DelayCurve, delay_curve, settling_time
from obsynth.methods.guaranteed_test.method import is_guaranteed
from obsynth.methods.registry import REGISTRY, method_class
from obsynth.observers.decisions import ParameterMonitor
from obsynth.observers.linear.observer import SETTLED_TO, LinearObserver, WindowObserver, sample_observer, transient
from obsynth.plants.dae import DAEModel
from obsynth.plants.descriptor import DescriptorSystem, TimeVaryingDescriptorSystem, listed
from obsynth.plotting.trade_off import FaultGains, fault_gains
from obsynth.results.checks import FITS, Check
from obsynth.results.design import ObserverDesign, VerificationReport
from obsynth.results.layout import (
    checks_table,
    complex_numbers,
    facts_table,
    headed_table,
    name_list,
    number,
    print_checks,
    print_section,
    verdict_line,
)
from obsynth.verification.plant import PLANT_MATRICES

if TYPE_CHECKING:
    from obsynth.analysis.diagnosis.diagnosing import Diagnosis
    from obsynth.comparison.comparing import Comparison
    from obsynth.experiments.monitors.monitor import Monitor
    from obsynth.experiments.monte_carlo import Evaluation, Interval
    from obsynth.experiments.simulation import Simulation


def tolerance_facts(design: ObserverDesign) -> list[tuple[str, str]]:
    """Return what holds for every plant within its tolerances, as label and text; none for other designs."""
    from obsynth.tolerances.robustness import EXACT_MODEL, robustness

    if not isinstance(design.plant, DescriptorSystem) or not isinstance(design.observer, LinearObserver):
        return []
    uncertain = design.plant.uncertainty
    if uncertain is None or not uncertain.box.names:
        return [("model", f"{EXACT_MODEL} (no constant has a tolerance).")]
    if design.report.checks and not design.report.passed:
        return [("bounds", "none: the design fails its verification")]
    try:
        return list(robustness(design).facts())
    except PreconditionError as error:
        # The design is one for the nominal plant whatever the box may be.
        return [("bounds", f"none: {error}")]


#: Signals of any kind of plant, as they are called here.
_NAMES_OF_SIGNALS = {
    "states": "state_names",
    "known inputs": "input_names",
    "outputs": "output_names",
    "faults": "fault_names",
    "disturbances": "disturbance_names",
    "noise": "noise_names",
    "parameters": "parameter_names",
}


def plant_facts(plant: DescriptorSystem | TimeVaryingDescriptorSystem | DAEModel) -> Iterator[tuple[str, str]]:
    """Yield label and value of what is known about a plant."""
    if isinstance(plant, DAEModel):
        yield "equations", f"{plant.nx}: {name_list(plant.equation_names)}"
    elif isinstance(plant, TimeVaryingDescriptorSystem):
        steps = "without end" if plant.horizon is None else f"{plant.horizon} steps"
        yield "time", f"discrete, {plant.dt:g} s between samples, {steps}"
        varying = [name for name, matrix in plant.matrices.items() if not matrix.is_constant]
        yield "change with k", name_list(varying) if varying else "nothing"
        yield "equations", str(plant.ne)
    else:
        yield "time", f"discrete, {plant.dt:g} s between samples" if plant.is_discrete else "continuous"
    for label, attribute in _NAMES_OF_SIGNALS.items():
        if (names := getattr(plant, attribute, None)) is not None:
            yield label, f"{len(names)}: {name_list(names)}" if names else "none"


def design_report(design: ObserverDesign, *, console: Console) -> None:
    """Print a design with its report."""
    print_section(console, f"Design '{design.name}' by {design.method}", facts_table(plant_facts(design.plant)))
    print_section(console, "Claims", facts_table(promises(design)))
    if design.observer.fault_names:
        headings, rows = fault_estimates(design, gains_if_linear(design))
        table = headed_table(*headings)
        for row in rows:
            table.add_row(*map(Text, row))
        print_section(console, f"{headings[0].capitalize()} estimates", table)
    for curve in delay_curves(design):
        print_section(console, f"Deviation of {curve.fault} against delay", delay_table(curve))
        console.print(Text(curve.sentence))
        console.print()
    if design.recovery is not None:
        print_section(console, "States of the plant as written", facts_table(recovered_states(design.recovery)))
    print_checks(design.report.checks, console=console)
    facts = tolerance_facts(design)
    if len(facts) == 1 and facts[0][0] == "model":
        console.print(Text(f"Model: {facts[0][1]}"))
    elif facts:
        print_section(console, "Within the tolerances of the plant", facts_table(facts))
    for note in design.notes:
        console.print(Text(f"Note: {note}"))


#: Curves of at most so many faults; plants with more states have none, and no steps are followed there.
MOST_CURVES, MOST_STATES_OF_CURVES = 3, 80


def delay_curves(design: ObserverDesign) -> list[DelayCurve]:
    """Return the deviation against the delay on the plant of a design, for each fault that it estimates, where noise is
    stated."""
    plant, observer = design.plant, design.observer
    if (
        not isinstance(plant, DescriptorSystem)
        or not isinstance(observer, LinearObserver)
        or plant.nx > MOST_STATES_OF_CURVES
    ):
        return []
    names = [name for name in observer.fault_names if name in plant.fault_names][:MOST_CURVES]
    rates = design.options.get("fault_rate")
    found = []
    for name in names:
        rate = rates.get(name) if isinstance(rates, Mapping) else rates
        found.append(delay_curve(plant, plant.fault_names.index(name), rate))
    return [curve for curve in found if curve is not None]


def delay_table(curve: DelayCurve) -> Table:
    """Return deviations by walk (rows) and lag in samples (columns)."""
    table = headed_table("walk per sample", *(f"lag {lag}" for lag in curve.lags))
    for rate, row in zip(curve.rates, curve.deviations, strict=True):
        table.add_row(Text(f"{rate:.3g}"), *(Text(number(float(value), digits=3)) for value in row))
    return table


def recovered_states(recovery: StateRecovery) -> Iterator[tuple[str, str]]:
    """Yield how good an estimate of each original state is, with the names, best first."""
    names_by_flag: dict[str, list[str]] = {}
    for name, flag in zip(recovery.names, recovery.flags(), strict=True):
        names_by_flag.setdefault(flag, []).append(name)
    for flag in sorted(names_by_flag, key=lambda flag: flag != "exact"):
        yield flag, f"{len(names_by_flag[flag])}: {name_list(names_by_flag[flag])}"


#: What the meaning of a claim says of its proof, which is left out where checks fail.
_PROOF_WORDS = re.compile(r"[,:;]? ?\bproved( where a row says so)?\b")


def unproved(meaning: str) -> str:
    """Return the meaning of a claim without the word that it is proved."""
    return _PROOF_WORDS.sub("", meaning).strip()


def promises(design: ObserverDesign) -> Iterator[tuple[str, str, str]]:
    """Yield name, value and meaning of what a design claims."""
    known = method_class(design.method).claims if design.method in REGISTRY else {}
    for name, value in design.certificate.claims.items():
        claim = known.get(name.partition("[")[0])
        unit, meaning = (claim.unit, claim.meaning) if claim else ("", "unknown to this version")
        if not design.report.passed:
            meaning = f"{unproved(meaning)} (claimed only: checks fail)"
        yield name, f"{number(value, digits=7)} {unit}".strip(), meaning
    for check in design.report.checks:
        if check.name == "H-infinity norm":
            yield "norm", number(check.value, digits=7), "the same gain recomputed by a second route"
    yield "observer order", str(design.observer.order), "states of the shipped realisation"


def gains_if_linear(design: ObserverDesign) -> FaultGains | None:
    """Return the gains of a linear design that estimates faults of its plant; a broken one has none."""
    if not isinstance(design.plant, DescriptorSystem) or not design.observer.fault_names:
        return None
    if any(check.name == FITS for check in design.report.failures):
        return None
    # Numbers of a corrupted design may overflow; the table shows infinity then, beside the checks that fail.
    with np.errstate(over="ignore", invalid="ignore"):
        return fault_gains(design)


def fault_estimates(design: ObserverDesign, gains: FaultGains | None) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Return headings and one row for each fault, or parameter: delay, deviation, and what else reaches it."""
    observer, plant, units = design.observer, design.plant, design.plant.units
    deviations = {check.name: check.value for check in design.report.checks}

    def deviation(name: str, missing: str) -> str:
        value = deviations.get(f"noise in fhat[{name}]")
        unit = units.get(name, "")
        return missing if value is None else f"{number(value)} {'' if unit == '1' else unit}".strip()

    if isinstance(observer, WindowObserver):
        delayed = zip(observer.fault_names, observer.fault_delays, strict=True)
        return ("fault", "delay", "delay in s"), [(name, str(k), number(k * observer.dt)) for name, k in delayed]
    if gains is None or not isinstance(plant, DescriptorSystem):
        when = "after the nominal run" if isinstance(plant, DAEModel) else "at the end of the horizon"
        return ("parameter", f"deviation {when}"), [(name, deviation(name, "-")) for name in observer.fault_names]
    linear = design.linear[1]
    none, noise = "by sampling" if plant.nw else "none stated", "deviation" if plant.is_discrete else "deviation, 1 s"
    delays = ("delay", "delay in s") if plant.is_discrete else ()
    rows: list[tuple[str, ...]] = []
    for name, lag, disturbance_gains in zip(
        linear.fault_names, linear.fault_delays, gains.disturbance_gains, strict=True
    ):
        delay = (str(lag), number(lag * plant.dt)) if plant.is_discrete else ()
        row = (name, *delay, deviation(name, none))
        if plant.nd:
            gain = float(disturbance_gains.max())
            row += (
                f"{number(gain)} from {plant.disturbance_names[int(disturbance_gains.argmax())]}" if gain else "none",
            )
        rows.append(row)
    return ("fault", *delays, noise, *(("largest gain",) if plant.nd else ())), rows


#: Without a scenario steps are followed for so many settling times of the plant, at most so many samples.
STEP_SETTLING_TIMES, MOST_STEP_SAMPLES = 30, 6000
#: How often the time to 90 % is looked at on a finer clock, each time 200 times as fine at most.
MOST_CLOSER_LOOKS = 2
#: An estimate of a unit step beyond this is no estimate, and its size is that of rounding that has grown.
FAR_FROM_ONE = 10.0


def _estimating(design: ObserverDesign) -> tuple[DescriptorSystem, LinearObserver] | None:
    """Return plant and observer of a linear design that estimates faults of a plant that is not too large."""
    plant, observer = design.plant, design.observer
    if (
        not isinstance(plant, DescriptorSystem)
        or not isinstance(observer, LinearObserver)
        or plant.nx > MOST_STATES_OF_CURVES
    ):
        return None
    return (plant, observer) if observer.fault_names and set(observer.fault_names) <= set(plant.fault_names) else None


def followed_steps(design: ObserverDesign) -> Mapping[str, FaultFigures]:
    """Return what becomes of a unit step of each fault of a linear design, by fault, none where they could not be
    followed."""
    pair = _estimating(design)
    if pair is None:
        return {}
    plant, observer = pair
    if (observer.Bu.shape[1], observer.By.shape[1]) != (plant.nu, plant.ny):
        return {}
    step = plant.dt if plant.dt > 0.0 else settling_time(plant) / SETTLING_SAMPLES
    length = STEP_SETTLING_TIMES * settling_time(plant)
    steps = int(min(max(length / step, 20), MOST_STEP_SAMPLES))
    try:
        sampled = on_the_clock(plant, step)
        clocked = observer if observer.dt > 0.0 else sample_observer(observer, step)
    except ObsynthError:
        return {}
    figures = fault_figures(sampled, clocked, steps)
    if plant.dt == 0.0:
        figures = _closely_timed(plant, observer, figures, step)
    return {found.fault: found for found in figures}


def _closely_timed(
    plant: DescriptorSystem, observer: LinearObserver, figures: tuple[FaultFigures, ...], step: float
) -> tuple[FaultFigures, ...]:
    """Return figures whose times to 90 % are known to one in `SETTLING_SAMPLES`: the plant's settling time, by which
    they were sampled, may be long beside these."""
    for _ in range(MOST_CLOSER_LOOKS):
        coarse = [found.most for found in figures if found.reaches and 0.0 < found.most < SETTLING_SAMPLES * step]
        if not coarse:
            break
        # The straight lines between samples may show a step by up to two of these too soon.
        length, step = max(coarse) + 2.0 * step, min(coarse) / SETTLING_SAMPLES
        steps = int(min(length / step, MOST_STEP_SAMPLES))
        try:
            closer = fault_figures(on_the_clock(plant, step), sample_observer(observer, step), steps)
        except ObsynthError:
            break
        figures = tuple(
            replace(found, most=fine.most) if math.isfinite(fine.most) else found
            for found, fine in zip(figures, closer, strict=True)
        )
    return figures


def design_warnings(
    design: ObserverDesign, steps: Mapping[str, FaultFigures], *, told: Collection[str] = ()
) -> tuple[str, ...]:
    """Return what to know before trusting the fault estimates; ``steps`` from `followed_steps`."""
    pair = _estimating(design)
    if pair is None:
        return ()
    missed = (
        f"A unit step of {name} gives an estimate of {_of_one(figures.at_horizon)} after {figures.horizon:.2g} s: it "
        "has not reached the fault by then."
        for name, figures in steps.items()
        if not figures.reaches and name not in told
    )
    return (*_undetectable(*pair), *missed)


def _of_one(value: float) -> str:
    """Return the estimate of a unit step to the digits that are not rounding, whatever the design."""
    return f"{round(value, 2) + 0.0:g}" if abs(value) <= FAR_FROM_ONE else f"more than {FAR_FROM_ONE:g} times as much"


def _undetectable(plant: DescriptorSystem, observer: LinearObserver) -> Iterator[str]:
    rest = dc_point(plant.dt)
    unknown = ", ".join(plant.disturbance_names)
    for name in observer.fault_names if plant.nd else ():
        number = plant.fault_names.index(name)
        beside = others(plant, number)
        asked, among, either = question(plant, (), number), unknown, "either"
        if asked.shows_at(rest):
            if not beside or question(plant, beside, number).shows_at(rest):
                continue
            among = f"{unknown} and {', '.join(plant.fault_names[i] for i in beside)} together"
            either = "any of them"
        what = f"A constant {name}" if asked.visible else name
        yield (
            f"{what} cannot be distinguished from {among}: the estimate may be an effect of {either}. See obsynth "
            "check for the sensors that would distinguish them."
        )


#: Faults, warnings and notes that are listed; the others are counted.
_MOST_IN_SUMMARY, _MOST_NOTES = 5, 1
#: An unknown input that reaches a fault estimate in the fault's own unit with this gain or more is not separated from
#: the fault.
UNSEPARATED_GAIN = 0.5
#: An estimate follows a step if in the end it misses it by no more than this share.
FOLLOWS = 0.1
_LABEL = 10
#: Claims that say what a design is worth; the others are for -v.
_PROMISES = ("gamma", "decay")
#: Errors that shrink to less of them in a step are gone within a few, and how much is left is rounding.
LEAST_CONTRACTION = 1e-6


@dataclass(frozen=True)
class Summary:
    """The lines of a summary: a verdict, facts by label, a table of the fault estimates, warnings and notes."""

    verdict: str
    passed: bool
    facts: tuple[tuple[str, str], ...]
    headings: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    more: str
    warnings: tuple[str, ...]
    notes: tuple[str, ...]
    file: str = ""

    def lines(self, width: int = 80) -> Iterator[tuple[str, str]]:
        """Yield text and style of each line, none wider than ``width`` but the file's."""
        yield self.verdict, "green" if self.passed else "bold red"
        for label, text in self.facts:
            yield from ((line, "") for line in _wrapped(label, text, width))
        if self.rows:
            yield from _table(self.headings, self.rows, width)
        if self.more:
            yield self.more, "dim"
        for text in self.warnings:
            yield from ((line, "yellow") for line in _wrapped("warning", text, width))
        for text in self.notes:
            yield from ((line, "") for line in _wrapped("note", text, width))
        if self.file:
            yield f"Gain set: {self.file}", ""

    def __repr__(self) -> str:
        """Return the lines as plain text."""
        return "\n".join(text for text, _ in self.lines())

    def html(self) -> str:
        """Return the summary as a piece of HTML."""
        colour = "#1a7f37" if self.passed else "#b42318"
        parts = [f'<p style="color:{colour};font-weight:600">{escape(self.verdict)}</p>', "<table>"]
        parts += [
            f'<tr><th style="text-align:left">{escape(label)}</th><td style="text-align:left">{escape(text)}</td></tr>'
            for label, text in self.facts
        ]
        parts += ["</table>", *([html_table([self.headings, *self.rows])] if self.rows else [])]
        parts += [f"<p>{escape(self.more)}</p>"] if self.more else []
        parts += [f'<p style="color:#9a6700">Warning: {escape(text)}</p>' for text in self.warnings]
        parts += [f"<p>Note: {escape(text)}</p>" for text in self.notes]
        return f'<div class="obsynth-design">{"".join(parts)}</div>'

    def as_dict(self) -> dict[str, Any]:
        """Return the summary as plain data."""
        return {
            "verdict": self.verdict,
            "passed": self.passed,
            "facts": dict(self.facts),
            "estimates": [dict(zip(self.headings, row, strict=True)) for row in self.rows],
            "warnings": list(self.warnings),
            "notes": list(self.notes),
        }


def summary(design: ObserverDesign, *, file: Path | None = None, everything: bool = False) -> Summary:
    """Return the summary of a design; with ``everything`` no fault and no note is left out."""
    gains = gains_if_linear(design)
    steps = followed_steps(design)
    headings, rows = fault_estimates(design, gains)
    warnings = tuple(_warnings(design, gains, steps))
    shown = len(rows) if everything else _MOST_IN_SUMMARY
    notes = design.notes if everything else design.notes[:_MOST_NOTES]
    hidden = ((len(rows) - shown, "more estimate"), (len(design.notes) - len(notes), "more note"))
    more = _counted([(count, what) for count, what in hidden if count > 0])
    verdict = f"{design.name}: {verdict_line(design.report.checks).plain}"
    return Summary(
        verdict,
        design.report.passed,
        tuple(_facts(design, steps)),
        headings,
        tuple(rows[:shown]),
        f"{more} with -v" if more else "",
        warnings,
        notes,
        "" if file is None else str(file),
    )


def print_summary(found: Summary, *, console: Console) -> None:
    """Print a summary; a file's name stays in one piece, so that it can be copied."""
    for text, style in found.lines(min(console.width, 120)):
        console.print(Text(text, style=style), soft_wrap=True)


def _facts(design: ObserverDesign, steps: Mapping[str, FaultFigures]) -> Iterator[tuple[str, str]]:
    known = method_class(design.method) if design.method in REGISTRY else None
    yield "method", design.method + (f": {known.summary}" if known else "")
    yield "plant", _plant(design.plant)
    yield from _promise(design)
    yield "dynamics", _dynamics(design)
    yield from _speed(design, steps)
    yield "assumes", "; ".join(_assumptions(design))


def _plant(plant: DescriptorSystem | TimeVaryingDescriptorSystem | DAEModel) -> str:
    counts = [(len(plant.state_names), "state"), (len(plant.output_names), "output")]
    if isinstance(plant, DescriptorSystem):
        time = f"{plant.dt:g} s between samples" if plant.is_discrete else "continuous in time"
        return f"{time}; {_counted([*counts, (plant.nf, 'fault'), (plant.nd, 'unknown input')])}"
    counts.append((len(plant.parameter_names), "parameter"))
    if isinstance(plant, DAEModel):
        return f"nonlinear; {_counted(counts)}"
    varying = [name for name, matrix in plant.matrices.items() if not matrix.is_constant]
    change = (
        f"{', '.join(varying)} {'change' if len(varying) > 1 else 'changes'} with k" if varying else "constant matrices"
    )
    return f"{plant.dt:g} s between samples; {change}; {_counted(counts)}"


def _counted(counts: Sequence[tuple[int, str]]) -> str:
    return ", ".join(f"{count or 'no'} {word}{'' if count == 1 else 's'}" for count, word in counts)


def _promise(design: ObserverDesign) -> Iterator[tuple[str, str]]:
    """Yield the claim that says what is shipped."""
    known = method_class(design.method).claims if design.method in REGISTRY else {}
    claims = design.certificate.claims
    for name in (name for name in _PROMISES if name in claims and name in known):
        unit = f" {known[name].unit}" if known[name].unit else ""
        label, meaning = (
            ("claim", known[name].meaning)
            if design.report.passed
            else ("claimed", f"{unproved(known[name].meaning)} (NOT proved: checks fail)")
        )
        yield label, f"{name} = {number(claims[name])}{unit}, {meaning}"


def _dynamics(design: ObserverDesign) -> str:
    """Return how fast the initial-condition response settles, and the order of the observer."""
    if isinstance(design.observer, WindowObserver):
        return f"the last {design.observer.samples} samples are used, and none before them"
    if isinstance(design.plant, DescriptorSystem):
        seconds = transient(design.linear[1])
        if not math.isfinite(seconds):
            return f"the initial-condition response does not decay; observer of order {design.observer.order}"
        settling = f"{100.0 * SETTLED_TO:g} % settling time {number(float(f'{seconds:.2g}'))} s"
        return f"{settling}; observer of order {design.observer.order}"
    factor = design.certificate.claims.get("contraction", math.nan)
    share = f"less than {100.0 * LEAST_CONTRACTION:g}" if factor < LEAST_CONTRACTION else number(100.0 * factor)
    return f"errors shrink to {share} % per step on average; observer of order {design.observer.order}"


def _speed(design: ObserverDesign, steps: Mapping[str, FaultFigures]) -> Iterator[tuple[str, str]]:
    """Yield how soon the estimates show a step, where that is later than their delays say."""
    if not steps:
        return
    observer = design.linear[1]
    late = dict(zip(observer.fault_names, observer.fault_delays, strict=True))
    reached = [(name, found.most) for name, found in steps.items() if found.reaches]
    digits = 4 if observer.dt > 0.0 else 3
    told = [
        f"{name} {number(most, digits=digits)} s" for name, most in reached if most > (late[name] + 0.5) * observer.dt
    ]
    if told:
        yield "step", f"the estimate reaches 90 % after: {listed(told, most=_MOST_IN_SUMMARY)}"


def _assumptions(design: ObserverDesign) -> Iterator[str]:
    if isinstance(design.plant, DescriptorSystem):
        uncertain = design.plant.uncertainty
        some = uncertain is not None and bool(uncertain.box.names)
        yield "an exact model, except in thresholds over its tolerances" if some else "an exact model"
    else:
        bounded = isinstance(design.observer, WindowObserver)
        yield f"a model with the stated {'bounds' if bounded else 'noise'}"
    model = design.options.get("fault_model")
    if isinstance(model, str):
        yield f"faults that follow the model '{model}'"
    if is_guaranteed(design) and isinstance(design.plant, DescriptorSystem) and design.options.get("noise_bound"):
        yield "noise within its stated bounds"
    elif isinstance(design.plant, DescriptorSystem):
        noisy = sum(bool(row.any()) for row in design.plant.Dw)
        yield f"white noise on {noisy} of {design.plant.ny} sensors" if noisy else "no sensor noise stated"


def _warnings(design: ObserverDesign, gains: FaultGains | None, steps: Mapping[str, FaultFigures]) -> Iterator[str]:
    """Yield what a user should not overlook: disturbances that look like faults, steps that are not followed."""
    if isinstance(design.plant, DescriptorSystem):
        yield from questions(design.plant)
    if gains is None:
        return
    plant, observer = design.linear
    units = plant.units
    told = []
    for i, fault in enumerate(observer.fault_names):
        for j, name in enumerate(plant.disturbance_names):
            gain = float(gains.disturbance_gains[i, j])
            if gain >= UNSEPARATED_GAIN and units.get(fault) == units.get(name):
                yield (
                    f"{name} reaches the estimate of {fault} with a gain of up to {number(gain)}: the estimate cannot "
                    "separate it from the fault."
                )
        followed = float(gains.steady[i])
        if abs(followed - 1.0) > FOLLOWS:
            share = f"{round(100.0 * followed)} %" if abs(followed) <= FAR_FROM_ONE else "many times the size"
            told.append(fault)
            yield f"the estimate of {fault} does not follow a step: its steady state is {share} of it."
    yield from design_warnings(design, steps, told=told)
    for check in design.report.checks:
        if check.name.startswith("limit at "):
            place = check.name.removeprefix("limit at ")
            limit = check.claim.rpartition(": ")[0].replace("at this zero", f"At the zero {place}")
            yield f"{limit.replace('cannot follow', 'cannot follow a fault of that mode')}."


def _wrapped(label: str, text: str, width: int) -> list[str]:
    return textwrap.wrap(
        text, width, initial_indent=f"{label:<{_LABEL}}", subsequent_indent=" " * _LABEL, break_on_hyphens=False
    )


def _table(headings: Sequence[str], rows: Sequence[Sequence[str]], width: int) -> Iterator[tuple[str, str]]:
    """Yield the lines of a table; long names are cut, and the last column takes what is left."""
    widths = [max(len(row[i]) for row in (headings, *rows)) for i in range(len(headings))]
    excess = sum(widths) + 2 * (len(widths) - 1) - width
    for column in (0, len(widths) - 1):
        cut = min(max(excess, 0), max(widths[column] - 16, 0))
        widths[column] -= cut
        excess -= cut

    def line(row: Sequence[str]) -> str:
        cells = (text if len(text) <= size else f"{text[: size - 1]}…" for text, size in zip(row, widths, strict=True))
        return "  ".join(f"{text:<{size}}" for text, size in zip(cells, widths, strict=True)).rstrip()

    yield line(headings), "bold"
    for row in rows:
        yield line(row), ""


def check_report(
    plant: DescriptorSystem | TimeVaryingDescriptorSystem | DAEModel,
    structures: Mapping[str, Structure],
    methods: Mapping[str, VerificationReport],
    *,
    console: Console,
    transformation: str = "",
) -> None:
    """Print the structure of a plant, and for each method whether it can serve this plant."""
    facts = list(plant_facts(plant))
    if transformation:
        facts.insert(0, ("transformed", transformation))
    print_section(console, "Plant", facts_table(facts))
    columns = [structure_facts(structure) for structure in structures.values()]
    if columns:
        rows = [(label, *(column[label] for column in columns)) for label in columns[0]]
        headings = ["", *structures] if len(columns) > 1 else []
        print_section(console, "Structure (information, no verdict)", facts_table(rows, headings=headings))
    for method, report in methods.items():
        title = f"Existence conditions of {method}"
        print_section(console, title, checks_table(report.checks, width=console.width))
        console.print(_existence_line(method, report))


def _existence_line(method: str, report: VerificationReport) -> Text:
    if report.passed:
        return Text(f"{method}: all conditions hold, so a design exists.", style="green")
    failed = ", ".join(check.name for check in report.failures) or "no condition was checked"
    if {check.name for check in report.failures} & _ASKED:
        return Text(f"{method}: needs more options: {failed}.", style="yellow")
    return Text(f"{method}: {_verdict(report.failures)} for this plant: {failed}.", style="bold red")


def is_unclear(failed: Sequence[Check]) -> bool:
    """Whether all conditions that do not hold are undecided."""
    return bool(failed) and all(check.unclear for check in failed)


def _verdict(failed: Sequence[Check]) -> str:
    return "UNCLEAR" if is_unclear(failed) else "IMPOSSIBLE"


def structure_facts(structure: Structure) -> dict[str, str]:
    """Return the facts about a plant's structure."""
    blocks = [f"{size}" for size in structure.infinite_block_sizes]
    return {
        "pencil A - zE": "regular" if structure.regular else "NOT regular",
        "index": "-" if structure.index is None else str(structure.index),
        "rank of E": structure.rank_of_E.describe(),
        "finite eigenvalues": complex_numbers(structure.finite_eigenvalues),
        "infinite blocks": f"{len(blocks)}, of size {name_list(sorted(set(blocks)))}" if blocks else "none",
        "impulse-free": _yes(structure.impulse_free),
        "stable": _yes(structure.stable),
        "admissible": _yes(structure.admissible),
        "finitely observable": _yes(structure.finitely_observable),
        "unobservable modes": complex_numbers(structure.unobservable_modes),
        "detectable": _yes(structure.detectable),
        "undetectable modes": complex_numbers(structure.undetectable_modes),
        "impulse observable": _yes(structure.impulse_observable),
        "rank [E; C] = nx": _yes(structure.causally_observable),
        "unclear ranks": name_list(structure.unclear),
    }


def _yes(value: bool) -> str:
    return "yes" if value else "no"


#: Of a bank of residuals so many rows are shown.
MOST_BANK_ROWS = 12
#: What the columns of numbers mean.
_COLUMN_MEANINGS = (
    "detectable: some residual responds to the fault; steady state: also to a constant one. as a step, any signal: the "
    "fault can be estimated if it is a step, or whatever its time course. delay: samples, or derivatives of the "
    "outputs in continuous time. residual, filter: order of the smallest residual generator, and of a filter that "
    "estimates the fault."
)


def diagnosis_report(diagnosis: Diagnosis, *, console: Console, everything: bool = True) -> None:
    """Print what can be diagnosed: verdicts and sentences; isolability and banks with ``everything``."""
    if not diagnosis.faults:
        return
    print_section(console, diagnosis.heading, _rich_table(diagnosis.verdict_rows()))
    console.print(Text(_COLUMN_MEANINGS, style="dim"))
    if everything and len(diagnosis.faults) > 1:
        rows = diagnosis.bank_rows()
        print_section(
            console,
            "Isolability: which fault (row) can be distinguished from which (column)",
            _rich_table(diagnosis.isolability_rows()),
        )
        more = len(rows) - 1 - MOST_BANK_ROWS
        title = "Structured residuals" + (f" ({more} more are not shown; --json has them)" if more > 0 else "")
        if len(rows) > 1:
            print_section(console, title, _rich_table(rows[: MOST_BANK_ROWS + 1]))
    for sentence in diagnosis.sentences:
        console.print(Text(sentence))
    for warning in diagnosis.warnings:
        console.print(Text(f"Warning: {warning}", style="yellow"))
    if diagnosis.sentences or diagnosis.warnings:
        console.print()


def _rich_table(rows: Sequence[Sequence[str]]) -> Table:
    table = headed_table(*rows[0])
    for column, (heading, *cells) in zip(table.columns, zip(*rows, strict=True), strict=True):
        column.overflow = "fold"
        # A column that cannot fold must not be narrowed: the last columns would be cut off.
        column.no_wrap = " " not in heading and all(len(cell) <= len(heading) for cell in cells)
    for row in rows[1:]:
        table.add_row(*(Text(text) for text in row))
    return table


#: Conditions that ask for another time than the plant's, and what to do about each.
_TIME_CONDITIONS = {
    "exists: continuous time": "continuous only: design for the plant in continuous time (dt: 0, without sample_time), "
    "and sample the observer afterwards (obsynth.sample_observer)",
    "exists: discrete time": "discrete only: sample the plant first (transform: {sample_time: ...})",
}
#: Conditions on what a spec says, which the plant cannot fail.
_ASKED = {"exists: bounds stated", "exists: fault named", "exists: region stated", "exists: stated"}
_PLANT_KIND, _OF_THIS_KIND = "exists: kind of plant", "exists: plant of this kind"


def method_lines(methods: Mapping[str, VerificationReport], *, own: str = "") -> Iterator[tuple[str, str, str]]:
    """Yield method, verdict in words and style; methods for other kinds of plants come last, in one line."""
    others = []
    for method, report in methods.items():
        failed = report.failures
        names = {check.name for check in failed}
        asked = " (the spec's method)" if method == own else ""
        if report.passed:
            yield method, f"all conditions hold, so a design exists{asked}", "green"
        elif _PLANT_KIND in names and method != own:
            others.append(method)
        elif names & set(_TIME_CONDITIONS):
            yield method, next(text for name, text in _TIME_CONDITIONS.items() if name in names) + asked, "yellow"
        elif _OF_THIS_KIND in names:
            reason = next(check.detail for check in failed if check.name == _OF_THIS_KIND)
            yield method, f"not for this plant{asked}: {reason}".rstrip("."), "yellow"
        elif names & _ASKED:
            reason = " ".join(check.detail for check in failed if check.name in _ASKED)
            yield method, f"needs more options{asked}: {reason}".rstrip("."), "yellow"
        else:
            yield method, f"{_verdict(failed)} for this plant{asked}: {_reason(failed)}", "bold red"
    if others:
        yield "for other kinds of plants", ", ".join(others), "dim"


def print_methods(methods: Mapping[str, VerificationReport], *, own: str, console: Console) -> None:
    """Print the lines of all methods."""
    for method, text, style in method_lines(methods, own=own):
        lines = textwrap.wrap(
            f"{method}: {text}", min(console.width, 120), subsequent_indent="  ", break_on_hyphens=False
        )
        for line in lines:
            console.print(Text(line, style=style), soft_wrap=True)


def _reason(failed: Sequence[Check]) -> str:
    if not failed:
        return "no condition was checked"
    first, *more = failed
    told = f"the condition '{first.name.removeprefix('exists: ')}' FAILS. Needed: {first.claim}".rstrip(".")
    told += f". Found: {first.detail}".rstrip(".") if first.detail else ""
    return f"{told}." + (f" {len(more)} more condition{' fails' if len(more) == 1 else 's fail'} (-v)." if more else "")


_PLANT_NAMES = ("state_names", "input_names", "output_names", "fault_names", "disturbance_names")


def linear_plant_text(plant: DescriptorSystem) -> str:
    """Return operating point and matrices, each with its signals."""
    lines = ["Operating point:"]
    for name, value in plant.operating_point.items():
        unit = plant.units.get(name, "1")
        lines.append(f"  {name} = {value:.8g}{'' if unit == '1' else ' ' + unit}")
    for name, signals in (
        ("E", plant.state_names),
        ("A", plant.state_names),
        ("B", plant.input_names),
        ("C", plant.state_names),
        ("Bf", plant.fault_names),
        ("Df", plant.fault_names),
        ("Bd", plant.disturbance_names),
    ):
        matrix = getattr(plant, name)
        if matrix.size and (np.any(matrix) or name in "EABC"):
            lines += [f"{name}, columns {', '.join(signals)}:"]
            lines += ["  " + "  ".join(f"{value + 0.0:>11.5g}" for value in row) for row in matrix]
    return "\n".join(lines)


def plant_document(plant: DescriptorSystem, source: str) -> str:
    """Return the plant as YAML that a spec can name; every number as exact as it is."""
    data: dict[str, Any] = {"schema_version": 1, "dt": float(plant.dt)}
    for name in PLANT_MATRICES:
        matrix = getattr(plant, name)
        if matrix.size and (np.any(matrix) or name in "EAC"):
            data[name] = [[float(value) + 0.0 for value in row] for row in matrix]
    data |= {name: list(getattr(plant, name)) for name in _PLANT_NAMES if getattr(plant, name)}
    data["operating_point"] = {name: float(value) for name, value in plant.operating_point.items()}
    data["units"] = dict(plant.units)
    where = "at the operating point below and at nominal values of all constants"
    return f"# Linearised by obsynth from {source}, {where}.\n{yaml_text(data)}"


#: Rows of a table; of a large plant the worst estimates are shown.
SHOWN_ROWS = 12
_DECISIONS = {
    "false_alarm_rate": ("false alarms", "share of runs"),
    "missed_detection_rate": ("missed detections", "share of runs"),
    "detection_delay": ("detection delay", "s"),
    "isolation_error_rate": ("wrong fault named", "share of detections"),
}


def evaluation_report(
    name: str,
    found: Evaluation,
    *,
    monitor: Monitor | ParameterMonitor | None,
    console: Console,
    units: Mapping[str, str],
    beside: Sequence[str] = (),
) -> None:
    """Print rates, delays and errors over many runs; ``beside``: sentences on thresholds."""
    share = f"{100.0 * found.confidence:g} % interval"
    console.print(Text(f"{name}: {found.runs} runs", style="bold"))
    console.print()
    if monitor is not None:
        table = headed_table("decisions", "value", share, "of", "unit")
        for key, (title, unit) in _DECISIONS.items():
            item: Interval = getattr(found, key)
            if item.count:
                table.add_row(Text(title), number(item.value), _interval(item), str(item.count), Text(unit))
        kind, statement = described(monitor)
        print_section(console, f"Monitor {kind}", table)
        end = final_threshold(monitor)
        size = "" if end is None else f" ({number(end)} at the end of a run)"
        console.print(Text(f"Its threshold{size}: {statement}."))
        console.print()
    for sentence in beside:
        console.print(Text(sentence))
    for title, errors in (("Fault estimates", found.fault_rmse), ("State estimates", found.state_rmse)):
        if errors:
            table = headed_table("signal", "RMSE after warm-up", share, "unit")
            title, rows = _worst(title, list(errors.items()), lambda row: row[1].value)
            for signal, item in rows:
                table.add_row(Text(signal), number(item.value), _interval(item), Text(units.get(signal, "")))
            print_section(console, f"{title} (mean over runs)", table)


def _worst(title: str, rows: list[Any], size: Callable[[Any], float]) -> tuple[str, list[Any]]:
    """Return title and rows of a table; of many the worst."""
    if len(rows) <= SHOWN_ROWS:
        return title, rows
    return f"{title}: the worst {SHOWN_ROWS} of {len(rows)}", sorted(rows, key=lambda row: -size(row))[:SHOWN_ROWS]


def described(monitor: Monitor | ParameterMonitor) -> tuple[str, str]:
    """Return which monitor it is, and what its threshold means."""
    if not isinstance(monitor, ParameterMonitor):
        return monitor.kind, monitor.statement
    return monitor.statistic, (
        "of a decision on parameters, passed in a run without a change with about the stated probability "
        f"({monitor.false_alarms:g})"
    )


def final_threshold(monitor: Monitor | ParameterMonitor) -> float | None:
    """Return the threshold at the end of a run; ``None`` where it is not the same in each run, or decides nothing."""
    if isinstance(monitor, ParameterMonitor) or not monitor.threshold.size or not np.isfinite(monitor.threshold[-1]):
        return None
    return float(monitor.threshold[-1])


def _interval(item: Interval) -> str:
    return "-" if math.isnan(item.low) else f"{number(item.low)} to {number(item.high)}"


#: Columns left out where the console is narrower than so many characters.
NARROW = 130
_LESS = ("order", "s to 50 %", "at horizon", "peak", "bias", "s to alarm", "smallest", "ms")
#: Columns of names, how wide they are there (eighty columns less six of numbers), and how wide headings of numbers.
_NAME_COLUMNS = ("method", "fault")
_NAME_WIDTH, _HEADING_WIDTH = 11, 8


def comparison_report(found: Comparison, *, console: Console, file: Path | None = None) -> None:
    """Print what was compared, the table, the refusals and the recommendation."""
    header, *rows = found.rows()
    wide = console.width >= NARROW
    kept = [i for i, name in enumerate(header) if wide or name not in _LESS]
    table = headed_table(
        *(header[i] if wide else fill(header[i], _HEADING_WIDTH, break_long_words=False) for i in kept)
    )
    # Only names break, and at their hyphens and blanks: a number that is cut is another number.
    for column, i in zip(table.columns, kept, strict=True):
        column.no_wrap = header[i] not in _NAME_COLUMNS
        if not column.no_wrap:
            words = [word for row in rows for word in row[i].replace("-", "- ").split()]
            column.min_width = min(max(map(len, [header[i], *words])), _NAME_WIDTH)
    for row in rows:
        texts = [row[i] if wide or header[i] not in _NAME_COLUMNS else fill(row[i], _NAME_WIDTH) for i in kept]
        table.add_row(*map(Text, texts))
    console.print(Text(found.setting))
    for note in found.notes:
        console.print(Text(note, style="yellow"))
    if rows:
        print_section(console, "", table)
        console.print(Text(found.meanings([header[i] for i in kept]), style="dim"))
    for refusal in found.refusals:
        console.print(Text(refusal, style="yellow"))
    console.print(Text(found.advice, style="bold"))
    if file is not None:
        console.print(Text(f"Written: {file}"), soft_wrap=True)


def simulation_report(
    name: str,
    found: Simulation,
    *,
    console: Console,
    units: Mapping[str, str],
    file: str | None = None,
) -> None:
    """Print errors of all estimates: after warm-up for linear designs, with the coverage of their bands for others."""
    summary = found.summary()
    console.print(Text(f"{name}: {summary['samples']} samples, {found.time[-1]:g} s", style="bold"))
    console.print()
    linear = not found.estimates.has_deviations
    for kind, title in (
        ("faults", "Fault estimates" if linear else "Parameter estimates"),
        ("states", "State estimates"),
    ):
        if not summary[kind]:
            continue
        lasts = _last_column(found, kind)
        table = headed_table("signal", "RMSE", "largest error", next(lasts), "unit")
        title, rows = _worst(title, list(zip(summary[kind].items(), lasts, strict=True)), lambda row: row[0][1]["rmse"])
        for (signal, row), last in rows:
            table.add_row(Text(signal), number(row["rmse"]), number(row["largest"]), last, Text(units.get(signal, "")))
        told = "errors of the whole record"
        if linear and (end := summary[f"{kind[:-1]}_warm_up"]) is None:
            told = "the initial-condition response has not settled: errors of the whole record"
        elif linear:
            told = f"errors after the warm-up, which ended at {end:g} s"
        print_section(console, f"{title} ({told})", table)
    for note in summary["notes"]:
        console.print(Text(note))
    if file is not None:
        console.print(Text(f"Written: {file}"))


def _last_column(found: Simulation, kind: str) -> Iterator[str]:
    """Yield a heading, and a cell for each signal: delays of a linear observer, coverage of a recursive one."""
    if not found.estimates.has_deviations:
        yield "delay (samples)"
        yield from map(str, found.estimates.fault_delays if kind == "faults" else found.estimates.state_delays)
    else:
        yield "in its 95 % band"
        yield from (f"{100.0 * row['within_band']:.0f} %" for row in found.summary()[kind].values())

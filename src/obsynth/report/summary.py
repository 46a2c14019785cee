"""The summary of a design in about twelve lines: method, claims, quality of each fault estimate, assumptions."""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.text import Text

from obsynth.analysis.structure import questions
from obsynth.files.tables import html_table
from obsynth.methods.fault_figures import StepFigures
from obsynth.methods.guaranteed_test.method import is_guaranteed
from obsynth.methods.optimal_filter.least_possible import least_possible
from obsynth.methods.registry import REGISTRY, method_class
from obsynth.observers.linear.modes import SETTLED_TO, settling_of_modes
from obsynth.observers.nonlinear.region_observer import RegionObserver
from obsynth.observers.scheduled.observer import ScheduledObserver
from obsynth.observers.window.observer import WindowObserver
from obsynth.plants.dae import DAEModel
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.noise import is_noise_assumed
from obsynth.plants.polytopic import PolytopicSystem
from obsynth.plants.sequences import MatrixSequence
from obsynth.plants.signal_names import listed
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem
from obsynth.report.designs import (
    FAR_FROM_ONE,
    UNVERIFIED_NOTES,
    design_warnings,
    estimate_figures,
    fault_estimates,
    followed_steps,
    gains_if_linear,
    held_signals,
    unproved,
)
from obsynth.report.plants import plain_table
from obsynth.report.plots.frequency import FaultGains
from obsynth.results.design import ObserverDesign
from obsynth.results.layout import verdict_line
from obsynth.results.number_texts import bound_number, lower_number, number, upper_number
from obsynth.verification.constant_faults import CONSTANT_FAULT

#: Faults, warnings and notes that are listed; the others are counted.
_MOST_IN_SUMMARY, _MOST_NOTES = 5, 1

#: What an observer over a region that steps from row to row by implicit Euler needs besides.
_CLOSE_ROWS = "rows that are close beside its motion"

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

#: The inequality of each method that an engine of Riccati equations does without.
_INEQUALITIES = {"fault-estimation-filter": "(45)", "pd-observer": "the theorem"}

#: How a recursive method notes which covariances nobody stated.
_IDENTITY_NOTE = re.compile(r"No noise is stated: (Q and R|Q|R) taken as the identity")


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
    figures: tuple[Mapping[str, Any], ...] = ()
    is_of_file: bool = False

    def lines(self, width: int = 80) -> Iterator[tuple[str, str]]:
        """Yield text and style of each line, none wider than ``width`` but the file's."""
        yield self.verdict, "green" if self.passed else "bold red"
        for label, text in self.facts:
            yield from ((line, "") for line in _wrapped(label, text, width))
        if self.rows:
            yield from plain_table(self.headings, self.rows, width)
        if self.more:
            yield self.more, "dim"
        for text in self.warnings:
            yield from ((line, "yellow") for line in _wrapped("warning", text, width))
        if self.notes and self.is_of_file:
            yield from ((line, "") for line in textwrap.wrap(UNVERIFIED_NOTES, width))
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
            "estimates": [dict(figures) for figures in self.figures],
            "warnings": list(self.warnings),
            "notes": list(self.notes),
        }


def summary(
    design: ObserverDesign, *, file: Path | None = None, everything: bool = False, is_read: bool = False
) -> Summary:
    """Return the summary of a design; with ``everything`` no fault and no note is left out.

    ``is_read``: the design is read from ``file``, and its notes are whatever stands there."""
    gains = gains_if_linear(design)
    steps = followed_steps(design)
    headings, rows = fault_estimates(design, gains)
    warnings = tuple(_warnings(design, gains, steps))
    row_count = len(rows) if everything else _MOST_IN_SUMMARY
    notes = design.notes if everything else design.notes[:_MOST_NOTES]
    hidden = ((len(rows) - row_count, "more estimate"), (len(design.notes) - len(notes), "more note"))
    more = _counted([(count, what) for count, what in hidden if count > 0])
    verdict = f"{design.name}: {verdict_line(design.report.checks).plain}"
    return Summary(
        verdict=verdict,
        passed=design.report.passed,
        facts=(*_facts(design, steps), *(_beside_the_least(design) if everything else ())),
        headings=headings,
        rows=tuple(rows[:row_count]),
        more=f"{more} with -v" if more else "",
        warnings=warnings,
        notes=notes,
        file="" if file is None else str(file),
        figures=tuple(estimate_figures(design, gains)),
        is_of_file=is_read,
    )


def print_summary(shown_summary: Summary, *, console: Console) -> None:
    """Print a summary; a file's name stays in one piece, so that it can be copied."""
    for text, style in shown_summary.lines(min(console.width, 120)):
        console.print(Text(text, style=style), soft_wrap=True)


def _facts(design: ObserverDesign, steps: Mapping[str, StepFigures]) -> Iterator[tuple[str, str]]:
    known = method_class(design.method) if design.method in REGISTRY else None
    yield "method", design.method + (f": {known.summary}" if known else "")
    yield from _engine(design)
    yield "plant", _plant(design.plant)
    yield from _promise(design)
    yield "dynamics", _dynamics(design)
    yield from _speed(design, steps)
    yield "assumes", "; ".join(_assumptions(design))
    if _is_open_about_constant_faults(design):
        yield "unproved", "that the estimate of a constant fault equals it in the end"


def _is_open_about_constant_faults(design: ObserverDesign) -> bool:
    """Return whether faults are estimated and no row says what the estimate of a constant one is in the end."""
    proved = any(row.name == CONSTANT_FAULT and row.status == "proved" for row in design.report.checks)
    tests = isinstance(design.observer, WindowObserver)
    return bool(getattr(design.observer, "fault_names", ())) and not proved and not tests and design.report.passed


def _beside_the_least(design: ObserverDesign) -> Iterator[tuple[str, str]]:
    """Yield how near a design is to the least that any causal filter with its response to the faults lets through."""
    least = least_possible(design, later=True) if design.method in REGISTRY else None
    if least is not None and (text := least.sentence()):
        yield "least", text


def _engine(design: ObserverDesign) -> Iterator[tuple[str, str]]:
    """Yield how the gains were computed, where a method has several ways, and how to have the other one."""
    engine, inequality = design.solver.get("engine"), _INEQUALITIES.get(design.method)
    if engine == "riccati" and inequality:
        yield "engine", f"Riccati equations; {inequality} verified with P (engine: lmi uses Clarabel)"
    elif engine == "lmi":
        runs = design.solver.get("runs", ())
        names = dict.fromkeys(str(run["solver"]) for run in runs if "settings" in run and "solver" in run)
        yield "engine", f"matrix inequality{f', solved by {listed(list(names))}' if names else ''}"


def _plant(plant: DescriptorSystem | TimeVaryingDescriptorSystem | PolytopicSystem | DAEModel) -> str:
    counts = [(len(plant.state_names), "state"), (len(plant.output_names), "output")]
    if isinstance(plant, PolytopicSystem):
        time = f"{plant.dt:g} s between samples" if plant.is_discrete else "continuous in time"
        counts += [(plant.nf, "fault"), (plant.nd, "unknown input"), (plant.count, "vertex")]
        return f"{time}; {_counted(counts).replace('vertexs', 'vertices')}; region {plant.scheduling.sentence()}"
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
        yield label, f"{name} = {bound_number(claims[name], known[name].side)}{unit}, {meaning}"


def _dynamics(design: ObserverDesign) -> str:
    """Return how fast the initial-condition response settles, and the order of the observer."""
    if isinstance(design.observer, WindowObserver):
        return f"the last {design.observer.samples} samples are used, and none before them"
    if isinstance(design.plant, DescriptorSystem):
        seconds = settling_of_modes(design.linear[1])
        if not math.isfinite(seconds):
            return f"the initial-condition response does not decay; observer of order {design.observer.order}"
        # The whole response may take longer: where modes are alike, or large at first.
        settling = f"the slowest mode falls to {100.0 * SETTLED_TO:g} % in {upper_number(seconds)} s"
        return f"{settling}; observer of order {design.observer.order}"
    order = f"observer of order {design.observer.order}"
    if isinstance(design.observer, (RegionObserver, ScheduledObserver)):
        decay = design.certificate.claims.get("region_decay", math.nan)
        if isinstance(design.observer, RegionObserver) or design.observer.dt == 0.0:
            return f"errors decay by {lower_number(decay, digits=4)} 1/s at least; {order}"
        return f"errors shrink to {upper_number(100.0 * decay, digits=4)} % or less a sample; {order}"
    factor = design.certificate.claims.get("contraction", math.nan)
    if not math.isfinite(factor):
        return order
    if factor < LEAST_CONTRACTION:
        return f"the error is gone after a few samples; {order}"
    share = f"decays by about {number(100.0 * (1.0 - factor), digits=2)} % per sample"
    if getattr(design.plant, "parameter_names", ()):
        # How soon a parameter is followed is up to forgetting, random walk and excitation.
        return f"the error of the states {share} where the parameters are known; {order}"
    return f"the error {share}; {order}"


def _speed(design: ObserverDesign, steps: Mapping[str, StepFigures]) -> Iterator[tuple[str, str]]:
    """Yield how soon the estimates show a step, where that is later than their delays say."""
    if not steps:
        return
    observer = design.linear[1]
    late = dict(zip(observer.fault_names, observer.fault_delays, strict=True))
    reached = [(name, step_figures.most) for name, step_figures in steps.items() if step_figures.reaches]
    digits = 4 if observer.dt > 0.0 else 3
    slow_steps = [
        f"{number(most, digits=digits)} s ({name})" for name, most in reached if most > (late[name] + 0.5) * observer.dt
    ]
    if slow_steps:
        yield "step", f"the estimate reaches 90 % after {listed(slow_steps, most=_MOST_IN_SUMMARY)}"


def _assumptions(design: ObserverDesign) -> Iterator[str]:
    if isinstance(design.plant, DescriptorSystem):
        uncertain = design.plant.uncertainty
        some = uncertain is not None and bool(uncertain.box.names)
        held = f", {signals} held over each sample" if (signals := held_signals(design)) else ""
        # Of a continuous design with known inputs a threshold over tolerances takes inputs as held between rows, which
        # must be asked for.
        is_asked = design.plant.nu and not design.plant.is_discrete
        sampled = " of a sampled plant (transform: sample_time)" if is_asked else ""
        yield f"the model is exact{held}" + (
            f"; only --monitor pointwise{sampled} accounts for tolerances" if some else ""
        )
    elif isinstance(design.observer, WindowObserver):
        yield "a model with the stated bounds"
    elif isinstance(design.observer, RegionObserver):
        yield f"the model is exact, with {design.observer.operating_region.sentence()}; {_CLOSE_ROWS}"
    elif isinstance(design.plant, PolytopicSystem):
        close = "" if design.plant.is_discrete else f"; {_CLOSE_ROWS}"
        yield f"the model is exact, with the scheduling parameters measured and in their region{close}"
    else:
        chosen = next(filter(None, map(_IDENTITY_NOTE.match, design.notes)), None)
        names = "" if chosen is None else " = ".join(chosen.group(1).split(" and "))
        yield f"{names} = identity, because no noise was given" if names else _noise_of_recursion(design)
    model = design.options.get("fault_model")
    of_states = bool(getattr(design.observer, "state_names", ())) and not design.observer.fault_names
    if isinstance(model, str) and not of_states:
        yield f"faults that follow the model '{model}'"
    if is_guaranteed(design) and isinstance(design.plant, DescriptorSystem) and design.options.get("noise_bound"):
        yield f"{'disturbances and noise within their' if design.plant.nd else 'noise within its'} stated bounds"
    elif isinstance(design.plant, DescriptorSystem):
        noisy = sum(bool(row.any()) for row in design.plant.Dw)
        if is_noise_assumed(design.plant.noise_names):
            yield "white noise of deviation 1 on every sensor, as none is stated"
            return
        yield f"white noise on {noisy} of {design.plant.ny} sensors" if noisy else "no sensor noise given"


def _noise_of_recursion(design: ObserverDesign) -> str:
    """Return which noise a recursive observer is for; a file that has lost its notes does not say who stated it."""
    identities = [name for name in ("Q", "R") if _is_identity(getattr(design.observer, name, None))]
    return f"{' = '.join(identities)} = identity" if identities else "noise of the covariances Q and R"


def _is_identity(covariance: object) -> bool:
    if isinstance(covariance, MatrixSequence):
        covariance = covariance.at(0) if covariance.is_constant else None
    return isinstance(covariance, np.ndarray) and np.array_equal(covariance, np.eye(len(covariance)))


def _warnings(design: ObserverDesign, gains: FaultGains | None, steps: Mapping[str, StepFigures]) -> Iterator[str]:
    """Yield what a user should not overlook: disturbances that look like faults, steps that are not followed."""
    if isinstance(design.plant, DescriptorSystem):
        yield from questions(design.plant)
    if gains is None:
        return
    plant, observer = design.linear
    units = plant.units
    not_followed = []
    for i, fault in enumerate(observer.fault_names):
        for j, name in enumerate(plant.disturbance_names):
            gain = float(gains.disturbance_gains[i, j])
            if gain >= UNSEPARATED_GAIN and units.get(fault) == units.get(name):
                largest = upper_number(gain, digits=4)
                yield (
                    f"Disturbance {name} leaks into the estimate of {fault} (gain up to {largest}) and looks like a "
                    "fault."
                )
        followed = float(gains.steady[i])
        if abs(followed - 1.0) > FOLLOWS:
            share = f"{round(100.0 * followed)} %" if abs(followed) <= FAR_FROM_ONE else "many times the size"
            not_followed.append(fault)
            yield f"the estimate of {fault} does not follow a step: its steady state is {share} of it."
    yield from design_warnings(design, steps, reported=not_followed)
    for check in design.report.checks:
        if check.name.startswith("limit at "):
            place = check.name.removeprefix("limit at ")
            limit = check.claim.rpartition(": ")[0].replace("at this zero", f"At the zero {place}")
            yield f"{limit.replace('cannot follow', 'cannot follow a fault of that mode')}."


def _wrapped(label: str, text: str, width: int) -> list[str]:
    return textwrap.wrap(
        text, width, initial_indent=f"{label:<{_LABEL}}", subsequent_indent=" " * _LABEL, break_on_hyphens=False
    )

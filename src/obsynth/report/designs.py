"""The printed report of a design: its plant, its claims, and its limits."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from obsynth.analysis.diagnosis.exact_fault_columns import decoupled_fault
from obsynth.analysis.diagnosis.fault_columns import dc_point, others
from obsynth.errors import ObsynthError, PreconditionError
from obsynth.methods.candidates import SETTLING_SAMPLES
from obsynth.methods.fault_figures import (
    StepFigures,
    fault_figures,
    on_the_clock,
    step_figures_between_samples,
)
from obsynth.methods.functional_filter.rates import DelayCurve, delay_curve, settling_time
from obsynth.methods.guaranteed_test.method import is_guaranteed
from obsynth.methods.registry import REGISTRY, method_class
from obsynth.observers.linear.observer import LinearObserver
from obsynth.observers.nonlinear.region_observer import RegionObserver
from obsynth.observers.scheduled.observer import ScheduledObserver
from obsynth.observers.window.observer import WindowObserver
from obsynth.plants.dae import DAEModel
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.polytopic import PolytopicSystem
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem
from obsynth.plants.transformations.recovery import StateRecovery
from obsynth.report.plots.frequency import FaultGains, fault_gains
from obsynth.results.checks import FITS
from obsynth.results.design import ObserverDesign
from obsynth.results.layout import facts_table, headed_table, print_checks, print_section
from obsynth.results.number_texts import bound_number, name_list, number, upper_number
from obsynth.results.registered import is_registered, registered
from obsynth.verification.assumptions import Assumptions

#: What is said above the notes of a gain set that is read: they are sentences, which whoever holds the file may change.
UNVERIFIED_NOTES = "Notes as they were written with the design, which verify does not check:"

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

#: Curves of at most so many faults; plants with more states have none, and no steps are followed there.
MOST_CURVES, CURVES_UP_TO = 3, 80

#: What the meaning of a claim says of its proof, which is left out where checks fail.
_PROOF_WORDS = re.compile(r"[,:;]? ?\bproved( where the row '[^']*' says so)?\b")

#: Without a scenario steps are followed for so many settling times of the plant, at most so many samples.
STEP_SETTLING_TIMES, MOST_STEP_SAMPLES = 30, 6000

#: How often the time to 90 % is looked at on a finer clock, each time 200 times as fine at most.
MOST_CLOSER_LOOKS = 2

#: An estimate of a unit step beyond this is no estimate, and its size is that of rounding that has grown.
FAR_FROM_ONE = 10.0


def tolerance_facts(design: ObserverDesign) -> list[tuple[str, str]]:
    """Return what holds for every plant within its tolerances, as label and text; none for other designs."""
    if not isinstance(design.plant, DescriptorSystem) or not isinstance(design.observer, LinearObserver):
        return []
    uncertain = design.plant.uncertainty
    if uncertain is None or not uncertain.box.names:
        return [("model", "none stated; every claim is for the exact model.")]
    if design.report.checks and not design.report.passed:
        return [("bounds", "none: the design fails its verification")]
    if not is_registered("robustness"):
        return [("bounds", "not computed: this installation has no obsynth.studies")]
    try:
        return list(registered("robustness")(design).facts())
    except PreconditionError as error:
        # The design is one for the nominal plant whatever the box may be.
        return [("bounds", f"none. {error}")]


def plant_facts(
    plant: DescriptorSystem | TimeVaryingDescriptorSystem | PolytopicSystem | DAEModel,
) -> Iterator[tuple[str, str]]:
    """Yield label and value of what is known about a plant."""
    if isinstance(plant, DAEModel):
        yield "equations", f"{plant.nx}: {name_list(plant.equation_names)}"
    elif isinstance(plant, TimeVaryingDescriptorSystem):
        steps = "without end" if plant.horizon is None else f"{plant.horizon} steps"
        yield "time", f"discrete, {plant.dt:g} s between samples, {steps}"
        varying = [name for name, matrix in plant.matrices.items() if not matrix.is_constant]
        yield "change with k", name_list(varying) if varying else "nothing"
        yield "equations", str(plant.ne)
    elif isinstance(plant, PolytopicSystem):
        yield "time", f"discrete, {plant.dt:g} s between samples" if plant.is_discrete else "continuous"
        yield "region", f"{plant.scheduling.sentence()}; {plant.count} vertices"
        yield "directions", name_list(plant.scheduling.functions or plant.scheduling.names)
    else:
        yield "time", f"discrete, {plant.dt:g} s between samples" if plant.is_discrete else "continuous"
    for label, attribute in _NAMES_OF_SIGNALS.items():
        if (names := getattr(plant, attribute, None)) is not None:
            yield label, f"{len(names)}: {name_list(names)}" if names else "none"


def design_report(design: ObserverDesign, *, console: Console, is_read: bool = False) -> None:
    """Print a design with its report; with ``is_read`` its notes are said to be those of its file."""
    print_section(console, f"Design '{design.name}' by {design.method}", facts_table(plant_facts(design.plant)))
    print_section(console, "Claims", facts_table(promises(design)))
    if design.observer.fault_names:
        headings, rows = fault_estimates(design, gains_if_linear(design))
        table = headed_table(*headings)
        for row in rows:
            table.add_row(*map(Text, row))
        print_section(console, f"{headings[0].capitalize()} estimates", table)
    for curve in delay_curves(design):
        print_section(console, curve.title, delay_table(curve))
        console.print(Text(curve.sentence))
        console.print()
    if design.recovery is not None:
        print_section(console, "States of the plant as written", facts_table(recovered_states(design.recovery)))
    print_checks(design.report.checks, console=console)
    facts = tolerance_facts(design)
    if len(facts) == 1 and facts[0][0] == "model":
        console.print(Text(f"Tolerances: {facts[0][1]}"))
    elif facts:
        print_section(console, "Tolerances", facts_table(facts))
    if design.notes and is_read:
        console.print(Text(UNVERIFIED_NOTES))
    for note in design.notes:
        console.print(Text(f"Note: {note}"))


def delay_curves(design: ObserverDesign) -> list[DelayCurve]:
    """Return the deviation against the delay on the plant of a design, for each fault that it estimates, where noise is
    stated."""
    plant, observer = design.plant, design.observer
    if not isinstance(plant, DescriptorSystem) or not isinstance(observer, LinearObserver) or plant.nx > CURVES_UP_TO:
        return []
    names = [name for name in observer.fault_names if name in plant.fault_names][:MOST_CURVES]
    rates = design.options.get("fault_rate")
    curves = []
    for name in names:
        rate = rates.get(name) if isinstance(rates, Mapping) else rates
        curves.append(delay_curve(plant, plant.fault_names.index(name), rate))
    return [curve for curve in curves if curve is not None]


def delay_table(curve: DelayCurve) -> Table:
    """Return deviations of the estimate by walk of the fault (rows) and delay in samples (columns)."""
    unit = f" ({curve.unit})" if curve.unit else ""
    table = headed_table(f"walk per sample{unit}", *(f"delay {lag}" for lag in curve.lags))
    for rate, row in zip(curve.rates, curve.deviations, strict=True):
        table.add_row(Text(number(rate, digits=3)), *(Text(number(float(value), digits=3)) for value in row))
    return table


def recovered_states(recovery: StateRecovery) -> Iterator[tuple[str, str]]:
    """Yield how good an estimate of each original state is, with the names, best first."""
    names_by_flag: dict[str, list[str]] = {}
    for name, flag in zip(recovery.names, recovery.flags(), strict=True):
        names_by_flag.setdefault(flag, []).append(name)
    for flag in sorted(names_by_flag, key=lambda flag: flag != "exact"):
        yield flag, f"{len(names_by_flag[flag])}: {name_list(names_by_flag[flag])}"


def unproved(meaning: str) -> str:
    """Return the meaning of a claim without the word that it is proved."""
    return _PROOF_WORDS.sub("", meaning).strip()


def promises(design: ObserverDesign) -> Iterator[tuple[str, str, str]]:
    """Yield name, value and meaning of what a design claims."""
    known = method_class(design.method).claims if design.method in REGISTRY else {}
    for name, value in design.certificate.claims.items():
        claim = known.get(name.partition("[")[0])
        unit, meaning, side = (claim.unit, claim.meaning, claim.side) if claim else ("", "unknown to this version", "")
        if not design.report.passed:
            meaning = f"{unproved(meaning)} (claimed only: checks fail)"
        yield name.replace("_", " "), f"{bound_number(value, side)} {unit}".strip(), meaning
    for check in design.report.checks:
        if check.name == "H-infinity norm":
            yield "norm", number(check.value), "that gain itself, which gamma bounds, computed by a second route"
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

    if isinstance(observer, (RegionObserver, ScheduledObserver, WindowObserver)):
        delayed = zip(observer.fault_names, observer.fault_delays, strict=True)
        return ("fault", "delay", "delay in s"), [(name, str(k), number(k * observer.dt)) for name, k in delayed]
    if gains is None or not isinstance(plant, DescriptorSystem):
        return ("parameter", f"deviation {deviation_time(design)}"), [
            (name, deviation(name, "-")) for name in observer.fault_names
        ]
    linear = design.linear[1]
    none, noise = "by sampling" if plant.nw else "-", "deviation" if plant.is_discrete else "deviation at 1 sample/s"
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
                f"{upper_number(gain, digits=4)} from {plant.disturbance_names[int(disturbance_gains.argmax())]}"
                if gain
                else "none",
            )
        rows.append(row)
    return ("fault", *delays, noise, *(("largest gain",) if plant.nd else ())), rows


def deviation_time(design: ObserverDesign) -> str:
    """Return when the deviation of a recursive observer is that of its report."""
    if isinstance(design.plant, DAEModel):
        return "after the nominal run"
    steps = design.certificate.claims.get("steps", math.nan)
    if getattr(design.plant, "horizon", None) is not None or not math.isfinite(steps):
        return "at the end of the horizon"
    return f"after {steps:,.0f} samples without a change"


def estimate_figures(design: ObserverDesign, gains: FaultGains | None) -> Iterator[dict[str, Any]]:
    """Yield the numbers of `fault_estimates` as data: `None` where there is no such number."""
    observer, units = design.observer, design.plant.units
    deviations = {check.name: float(check.value) for check in design.report.checks}
    delays = getattr(observer, "fault_delays", None) or (0,) * len(observer.fault_names)
    dt = float(getattr(observer, "dt", 0.0))
    for i, name in enumerate(observer.fault_names):
        figures: dict[str, Any] = {
            "name": name,
            "unit": units.get(name),
            "delay": int(delays[i]),
            "delay_seconds": float(delays[i]) * dt,
            "deviation": deviations.get(f"noise in fhat[{name}]"),
        }
        if gains is not None and isinstance(design.plant, DescriptorSystem) and design.plant.nd:
            row = gains.disturbance_gains[i]
            figures["largest_gain"] = float(row.max())
            figures["largest_gain_from"] = design.plant.disturbance_names[int(row.argmax())]
        yield figures


def is_of_held_disturbances(design: ObserverDesign) -> bool:
    """Return whether gains or decoupling are claimed of a sampled plant whose disturbances may move between samples.

    A guaranteed test says itself which disturbances it is for."""
    plant = design.plant
    if not isinstance(plant, DescriptorSystem) or not isinstance(design.observer, LinearObserver) or not plant.nd:
        return False
    sampled = _is_sampled(design)
    return not is_guaranteed(design) and (sampled or Assumptions(plant, np.ones(plant.nd), 0.0).moves)


def held_signals(design: ObserverDesign) -> str:
    """Return which signals every claim of a linear design takes as held between the samples of its plant, if any: a
    fault that begins within a sample is estimated as another one at first."""
    if _is_sampled(design):
        return "all signals"
    return "disturbances" if is_of_held_disturbances(design) else ""


def _is_sampled(design: ObserverDesign) -> bool:
    """Return whether a design is for the samples of a continuous plant that it names."""
    plant, written = design.plant, None if design.source is None else design.source.plant
    if not isinstance(plant, DescriptorSystem) or not isinstance(written, DescriptorSystem):
        return False
    return written.dt == 0.0 < plant.dt


def _estimating(design: ObserverDesign) -> tuple[DescriptorSystem, LinearObserver] | None:
    """Return plant and observer of a linear design that estimates faults of a plant that is not too large."""
    plant, observer = design.plant, design.observer
    if not isinstance(plant, DescriptorSystem) or not isinstance(observer, LinearObserver) or plant.nx > CURVES_UP_TO:
        return None
    return (plant, observer) if observer.fault_names and set(observer.fault_names) <= set(plant.fault_names) else None


def followed_steps(design: ObserverDesign) -> Mapping[str, StepFigures]:
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
    figures: tuple[StepFigures, ...]
    try:
        if plant.dt > 0.0:
            figures = fault_figures(on_the_clock(plant, step), observer, steps)
        else:
            figures = step_figures_between_samples(plant, observer, step, steps)
            figures = _closely_timed(plant, observer, figures, step)
    except ObsynthError:
        return {}
    return {fault_step.fault: fault_step for fault_step in figures}


def _closely_timed(
    plant: DescriptorSystem, observer: LinearObserver, figures: tuple[StepFigures, ...], step: float
) -> tuple[StepFigures, ...]:
    """Return figures whose times to 90 % are known to one in `SETTLING_SAMPLES`: the plant's settling time, by which
    they were sampled, may be long beside these."""
    for _ in range(MOST_CLOSER_LOOKS):
        coarse = [figure.most for figure in figures if figure.reaches and 0.0 < figure.most < SETTLING_SAMPLES * step]
        if not coarse:
            break
        length, step = max(coarse) + 2.0 * step, min(coarse) / SETTLING_SAMPLES
        steps = int(min(length / step, MOST_STEP_SAMPLES))
        try:
            closer = step_figures_between_samples(plant, observer, step, steps)
        except ObsynthError:
            break
        figures = tuple(
            replace(figure, most=fine.most) if math.isfinite(fine.most) else figure
            for figure, fine in zip(figures, closer, strict=True)
        )
    return figures


def design_warnings(
    design: ObserverDesign, steps: Mapping[str, StepFigures], *, reported: Collection[str] = ()
) -> tuple[str, ...]:
    """Return what to know before trusting the fault estimates; ``steps`` from `followed_steps`."""
    pair = _estimating(design)
    if pair is None:
        return ()
    missed = (
        f"A unit step of {name} gives an estimate of {_of_one(figures.at_horizon)} after {figures.horizon:.2g} s: it "
        "has not reached the fault by then."
        for name, figures in steps.items()
        if not figures.reaches and name not in reported
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
        other_faults = others(plant, number)
        decoupled, among = decoupled_fault(plant, (), number), unknown
        either = "either" if plant.nd == 1 else "any of them"
        if decoupled.shows_at(rest):
            if not other_faults or decoupled_fault(plant, other_faults, number).shows_at(rest):
                continue
            among = f"{unknown} and {', '.join(plant.fault_names[i] for i in other_faults)} together"
            either = "any of them"
        what = f"A constant {name}" if decoupled.visible else name
        yield (
            f"{what} cannot be distinguished from {among}: the estimate may be an effect of {either}. See obsynth "
            "check for the sensors that would distinguish them."
        )

"""A finished design for people: what it is, what it promises, and where it was written.

What a design promises over the tolerances of its plant, for people.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

from rich.console import Console
from rich.table import Table
from rich.text import Text

from obsynth.analysis.transformations.recovery import StateRecovery
from obsynth.errors import PreconditionError
from obsynth.methods.functional_filter.delay_curve import DelayCurve, delay_curve
from obsynth.methods.registry import REGISTRY, method_spec
from obsynth.observers.linear.observer import LinearObserver
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.plants.dae.model import DAEModel
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem
from obsynth.results.checks_table import print_checks
from obsynth.results.delta_scan import DeltaScan
from obsynth.results.design import ObserverDesign
from obsynth.results.layout import facts_table, headed_table, name_list, number, print_section
from obsynth.results.report import VerificationReport


def verification_report(report: VerificationReport, *, console: Console) -> None:
    """Print a verification report."""
    print_checks(report.checks, console=console)


def tolerances_report(design: ObserverDesign, *, console: Console) -> None:
    """Print what holds for every plant within its tolerances, or that the design assumes an exact model."""
    facts = tolerance_facts(design)
    if len(facts) == 1 and facts[0][0] == "model":
        console.print(Text(f"Model: {facts[0][1]}"))
    elif facts:
        print_section(console, "Within the tolerances of the plant", facts_table(facts))


def tolerance_facts(design: ObserverDesign) -> list[tuple[str, str]]:
    """Return what holds for every plant within its tolerances, as label and text; none for other designs."""
    from obsynth.tolerances.result import EXACT_MODEL
    from obsynth.tolerances.robustness import robustness

    if not isinstance(design.plant, DescriptorSystem) or not isinstance(design.observer, LinearObserver):
        return []
    uncertain = design.plant.uncertainty
    if uncertain is None or not uncertain.box.names:
        return [("model", f"{EXACT_MODEL} (no constant has a tolerance).")]
    try:
        return list(robustness(design).facts())
    except PreconditionError as error:
        # The design is one for the nominal plant whatever the box may be.
        return [("bounds", f"none: {error}")]


def plant_facts(plant: DescriptorSystem | TimeVaryingDescriptorSystem | DAEModel) -> Iterator[tuple[str, str]]:
    """Yield label and value of what is known about a plant."""
    if isinstance(plant, TimeVaryingDescriptorSystem):
        yield from _varying_facts(plant)
        return
    if isinstance(plant, DAEModel):
        yield from _nonlinear_facts(plant)
        return
    yield "time", f"discrete, {plant.dt:g} s between samples" if plant.is_discrete else "continuous"
    signals = {
        "states": plant.state_names, "known inputs": plant.input_names, "outputs": plant.output_names,
        "faults": plant.fault_names, "disturbances": plant.disturbance_names, "noise": plant.noise_names,
    }  # fmt: skip
    for label, names in signals.items():
        yield label, f"{len(names)}: {name_list(names)}" if names else "none"


def _varying_facts(plant: TimeVaryingDescriptorSystem) -> Iterator[tuple[str, str]]:
    steps = "without end" if plant.horizon is None else f"{plant.horizon} steps"
    yield "time", f"discrete, {plant.dt:g} s between samples, {steps}"
    varying = [name for name, matrix in plant.matrices.items() if not matrix.is_constant]
    yield "change with k", name_list(varying) if varying else "nothing"
    yield "equations", str(plant.ne)
    signals = {
        "states": plant.state_names, "known inputs": plant.input_names, "outputs": plant.output_names,
        "parameters": plant.parameter_names,
    }  # fmt: skip
    for label, names in signals.items():
        yield label, f"{len(names)}: {name_list(names)}" if names else "none"


def _nonlinear_facts(plant: DAEModel) -> Iterator[tuple[str, str]]:
    yield "equations", f"{plant.nx}: {name_list(plant.equation_names)}"
    signals = {
        "states": plant.state_names, "known inputs": plant.input_names, "outputs": plant.output_names,
        "parameters": plant.parameter_names,
    }  # fmt: skip
    for label, names in signals.items():
        yield label, f"{len(names)}: {name_list(names)}" if names else "none"


def design_report(design: ObserverDesign, *, console: Console, file: Path | None = None) -> None:
    """Print a design with its report."""
    print_section(console, f"Design '{design.name}' by {design.method}", facts_table(plant_facts(design.plant)))
    print_section(console, "What is promised", facts_table(promises(design)))
    if design.observer.fault_names:
        print_section(console, *fault_estimates_table(design))
    for curve in delay_curves(design):
        print_section(console, f"Deviation of {curve.fault} against delay", delay_table(curve))
        console.print(Text(curve.sentence))
        console.print()
    if "delta_scan" in design.solver:
        print_section(
            console, "Other values of delta", delta_scan_table(DeltaScan.from_dict(design.solver["delta_scan"]))
        )
    if design.recovery is not None:
        print_section(console, "States of the plant as written", facts_table(recovered_states(design.recovery)))
    verification_report(design.report, console=console)
    tolerances_report(design, console=console)
    for note in design.notes:
        console.print(Text(f"Note: {note}"))
    if file is not None:
        # A path must stay in one piece, so that it can be copied.
        console.print(Text(f"Gain set: {file}"), soft_wrap=True)


#: Curves of at most so many faults, of plants with at most so many states.
MOST_CURVES, MOST_STATES = 3, 80


def delay_curves(design: ObserverDesign) -> list[DelayCurve]:
    """Return what delay buys on the plant of a design, for each fault that it estimates, where noise is stated."""
    plant, observer = design.plant, design.observer
    if not isinstance(plant, DescriptorSystem) or not isinstance(observer, LinearObserver) or plant.nx > MOST_STATES:
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


def delta_scan_table(scan: DeltaScan) -> Table:
    """Return the table of a scan of delta: decay against gains against noise."""
    table = headed_table("delta (s)", "decay (1/s)", "norm of gains", "f' to fault (s)", "noise to fault", "fast noise")
    for row in scan.rows():
        names = ("delta", "decay", "gain", "rate_gain", "noise_gain", "fast_noise_gain")
        table.add_row(*(Text(number(float(row[name]))) for name in names))
    return table


def recovered_states(recovery: StateRecovery) -> Iterator[tuple[str, str]]:
    """Yield how good an estimate of each original state is, with the names, best first."""
    names_by_flag: dict[str, list[str]] = {}
    for name, flag in zip(recovery.names, recovery.flags(), strict=True):
        names_by_flag.setdefault(flag, []).append(name)
    for flag in sorted(names_by_flag, key=lambda flag: flag != "exact"):
        yield flag, f"{len(names_by_flag[flag])}: {name_list(names_by_flag[flag])}"


def promises(design: ObserverDesign) -> Iterator[tuple[str, str, str]]:
    """Yield name, value and meaning of what a design claims."""
    known = method_spec(design.method).claims if design.method in REGISTRY else {}
    for name, value in design.certificate.claims.items():
        claim = known.get(name)
        unit, meaning = (claim.unit, claim.meaning) if claim else ("", "unknown to this version")
        yield name, f"{number(value, digits=7)} {unit}".strip(), meaning
    for check in design.report.checks:
        if check.name == "H-infinity norm":
            yield "norm", number(check.value, digits=7), "the same gain recomputed by a second route"
    yield "observer order", str(design.observer.order), "states of the shipped realisation"


def fault_estimates_table(design: ObserverDesign) -> tuple[str, Table]:
    """Return heading and table of delays and deviations of the estimates of faults or parameters."""
    observer, units = design.observer, design.plant.units
    deviations = {check.name: check.value for check in design.report.checks}
    if not isinstance(observer, LinearObserver):
        table = headed_table(
            "parameter",
            "std at the end of the horizon" if isinstance(observer, RecursiveObserver) else "std after the nominal run",
        )
        for name in observer.fault_names:
            table.add_row(Text(name), f"{number(deviations[f'noise in fhat[{name}]'])} {units.get(name, '')}".strip())
        return "Parameter estimates", table
    sampled = observer.dt > 0.0
    delays = ("delay in samples", "delay in s") if sampled else ()
    noise = "std under the stated noise" + ("" if sampled else ", 1 s between samples")
    table = headed_table("fault", *delays, noise)
    for name, delay in zip(observer.fault_names, observer.fault_delays, strict=True):
        deviation = deviations.get(f"noise in fhat[{name}]")
        missing = "depends on the sampling" if design.linear[0].nw else "no noise stated"
        shown = missing if deviation is None else f"{number(deviation)} {units.get(name, '')}".strip()
        table.add_row(Text(name), *((str(delay), number(delay * observer.dt)) if sampled else ()), Text(shown))
    return "Fault estimates", table

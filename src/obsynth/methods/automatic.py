"""Method "auto": the best method for a plant, by figures of its fault estimates in closed form."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from obsynth.analysis.existence.condition import OPTIONS_PATH
from obsynth.errors import ObsynthError, PreconditionError, SpecError
from obsynth.methods.candidates import Candidate, Maker, candidate_designs, linear_methods, methods_with
from obsynth.methods.functional_filter.rates import settling_time
from obsynth.methods.method import Purpose
from obsynth.methods.registry import kind_of, methods_for
from obsynth.numerics.arguments import field_types
from obsynth.numerics.suggestions import suggestion
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.results.design import ObserverDesign
from obsynth.results.number_texts import number
from obsynth.simulation.scenario import Scenario

#: The method of the least gain, which has options of its own for what is least: it is not chosen, but named where it
#: ranks above what is, of plants of few states, for which it takes a fraction of a second.
LEAST, COMPARED_STATES = "optimal-filter", 20

#: By so much noise and delay together must be less.
WORTH_NAMING = 1.05


def automatic_design(
    plant: Any, options: Mapping[str, Any], maker: Maker, refusing: Maker, scenario: Scenario | None = None
) -> ObserverDesign:
    """Return the design of the best method for a plant.

    Parameters
    ----------
    plant : plant of any kind
        Only linear time-invariant plants have a choice by figures; others get the first method for their purpose.
    options : mapping
        Options by name: only methods that have all of them are tried.
    maker : callable
        Makes a design: ``maker(plant, method, options)``.
    refusing : callable
        The same with suggestions in its error, for the case that no method exists.
    scenario : Scenario, optional
        States noise and sizes of faults that the choice takes into account.
    """
    if not isinstance(plant, DescriptorSystem):
        purpose: Purpose = "parameters" if plant.parameter_names else "state despite noise"
        known = methods_for(kind_of(plant))
        return maker(plant, next(iter(methods_with(purpose, known)), known[0]), options)
    possible = [method.id for method in linear_methods() if set(options) <= set(field_types(method))]
    if not possible:
        raise _no_method_with(options)
    if plant.nf == 0:
        order: list[Purpose] = ["state despite unknown inputs", "state despite noise"]
        if plant.nw and not plant.nd:
            order.reverse()
        refusals = []
        for each in [name for purpose in order for name in methods_with(purpose, possible)]:
            try:
                return _with_note(maker(plant, each, options), "there are no faults to estimate")
            except ObsynthError as error:
                refusals.append(error)
        if refusals:
            raise refusals[0]
        raise SpecError("The plant has no faults, and the options are for methods that estimate some.", path="method")
    return _chosen(plant, options, possible, maker, refusing, scenario)


def _chosen(
    plant: DescriptorSystem,
    options: Mapping[str, Any],
    possible: list[str],
    maker: Maker,
    refusing: Maker,
    scenario: Scenario | None,
) -> ObserverDesign:
    """Return the best design for a plant with faults."""
    methods = methods_with("faults", possible)
    entries = candidate_designs(plant, options, methods, maker, scenario)
    candidates = [entry for entry in entries if entry.design is not None]
    if not candidates:
        # Where the method with the weakest conditions does not exist, its reason holds for all of them.
        purposes: tuple[Purpose, ...] = ("faults under the weakest conditions", "faults")
        last = next((name for purpose in purposes for name in methods_with(purpose, possible)), possible[0])
        return refusing(plant, last, options)
    settling = settling_time(plant)
    best, *ranked_below = sorted(candidates, key=lambda entry: entry.rank(plant.nd > 0, settling))
    if best.design is None:
        raise PreconditionError("No method exists for this plant.", condition="existence")
    least: list[Candidate] = []
    if LEAST in possible and plant.nx <= COMPARED_STATES:
        least = [
            entry
            for entry in candidate_designs(plant, options, [LEAST], maker, scenario)
            if entry.design is not None
            and _is_better(entry.rank(plant.nd > 0, settling), best.rank(plant.nd > 0, settling))
        ]
    missing = [entry.method for entry in entries if entry.design is None]
    return _with_note(best.design, reason(best, ranked_below, plant, missing, least))


def _is_better(rank: tuple[float, ...], other: tuple[float, ...]) -> bool:
    """Return whether a rank is above another by more than what is not worth a word."""
    return (*rank[:-1], rank[-1] * WORTH_NAMING) < other


def reason(
    best: Candidate, ranked_below: list[Candidate], plant: DescriptorSystem, missing: list[str], better: list[Candidate]
) -> str:
    """Return in one sentence why a candidate ranks first; ``missing``: methods among which it was chosen and which
    do not exist; ``better``: those that rank above it, among which it was not."""
    above = "".join(
        f"; {entry.method} is not among these, and ranks above it: {_figures_in_words(entry, plant)}"
        for entry in better
    )
    if not ranked_below:
        none = f"of {', '.join(missing)} none exists for this plant" if missing else "the only one with these options"
        return none + above
    parts = ["its estimates reach every step"] if best.rank(False)[0] == 0.0 else []
    parts.append(_figures_in_words(best, plant))
    below = ", ".join(
        f"{other.method} (its noise hides {' and '.join(other.hidden)} of the scenario)"
        if other.hidden and not best.hidden
        else other.method
        for other in ranked_below
    )
    if best.hidden:
        parts.append(f"its noise hides {' and '.join(best.hidden)} of the scenario")
    return (
        f"{'; '.join(parts)}; ranked below it: {below}{above}; obsynth compare ranks by errors over a scenario instead"
    )


def _figures_in_words(entry: Candidate, plant: DescriptorSystem) -> str:
    """Return by what a candidate is ranked."""
    gains = f"gain from the unknown inputs {joined(fault.unknown_input_gain for fault in entry.figures)}; "
    deviations, delays = (
        joined(fault.deviation for fault in entry.figures),
        joined(fault.most for fault in entry.figures),
    )
    return f"{gains if plant.nd else ''}90 % of a step after {delays} s, with a deviation of {deviations}"


def joined(values: Iterable[float]) -> str:
    """Return numbers in words."""
    return ", ".join(number(value, digits=3) for value in values)


def _with_note(design: ObserverDesign, why: str) -> ObserverDesign:
    return design.replace(notes=(f"Method chosen by auto: {design.method} ({why}).", *design.notes))


def _no_method_with(options: Iterable[str]) -> SpecError:
    known = {name for method in linear_methods() for name in field_types(method)}
    unknown = next((name for name in sorted(options) if name not in known), None)
    text = (
        f"No single method has the options {', '.join(sorted(options))}: name the method they are for."
        if unknown is None
        else f"No method has the option {unknown!r}.{suggestion(unknown, sorted(known))}"
    )
    return SpecError(text, path=OPTIONS_PATH)

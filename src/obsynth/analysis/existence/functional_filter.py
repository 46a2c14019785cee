"""When a functional filter exists: each fault is visible, decoupled from the rest, at every pole of its model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from obsynth.analysis.diagnosis.decoupled import fault_numbers
from obsynth.analysis.diagnosis.diagnosing import model_points
from obsynth.analysis.diagnosis.exact_fault_columns import decoupled_fault
from obsynth.analysis.diagnosis.fault_columns import DecoupledFault, dc_point
from obsynth.analysis.diagnosis.hidden_motions import hidden_motion
from obsynth.analysis.existence.condition import OPTIONS_PATH, Condition
from obsynth.analysis.existence.distance import ROUNDING_LEVEL
from obsynth.analysis.existence.named_pencils import NamedPencil
from obsynth.analysis.existence.plant_numbers import COMPUTED_STATES
from obsynth.analysis.existence.statements import Evaluator, FullRank
from obsynth.errors import SpecError
from obsynth.numerics.arrays import remembered
from obsynth.numerics.spectra import pole_text
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.faults import Exosystem, exosystem

_SOURCE = "left null space of [A - sE, Bd, Bf; C, Dd, Df]"


def conditions(
    plant: DescriptorSystem,
    *,
    fault_model: Any = "step",
    faults: Any = None,
    residuals: Any = None,
    exactly: bool | None = None,
) -> tuple[Condition, ...]:
    """Return the existence conditions, one or two for each fault asked for."""
    sets = residual_sets(residuals, plant)
    if plant.nf == 0:
        return (
            Condition(
                "faults",
                "the plant has a fault",
                False,
                0.0,
                1.0,
                _SOURCE,
                "there is none: give Bf or Df.",
                of_the_method=True,
            ),
        )
    if sets is not None:
        return tuple(condition for sensitive in sets for condition in _residual_conditions(plant, sensitive, exactly))
    is_exosystem = isinstance(fault_model, Exosystem)
    model = fault_model if is_exosystem else exosystem(fault_model, plant.fault_names, plant.dt)
    return tuple(
        condition
        for fault in chosen_faults(faults, plant)
        for condition in _fault_conditions(
            plant, tuple(model_points(model, fault)), model.descriptions[fault], fault, exactly
        )
    )


@remembered
def _fault_conditions(
    plant: DescriptorSystem, points: tuple[complex, ...], description: str, fault: int, exactly: bool | None
) -> tuple[Condition, ...]:
    """Return whether one fault, whose model has these poles, can be estimated, free of others and unknown inputs."""
    name = plant.fault_names[fault]
    decoupled = decoupled_fault(plant, [j for j in range(plant.nf) if j != fault], fault, exactly)
    visible = _visibility(plant, decoupled, f"{name} detectable", _other_signals(plant, fault))
    if not decoupled.visible:
        return (visible,)
    lost = [point for point in points if not decoupled.shows_at(point)]
    doubtful = [point for point in lost if _may_show(decoupled, point)]
    named = _named_columns(plant, decoupled) if points else None
    shares = {} if named is None else {point: named.last_share(point) for point in points}
    least = min(points, key=lambda point: shares[point], default=dc_point(plant.dt))
    share = f", at the poles of its model at least {shares[least]:.2g} of it reaches the outputs" if shares else ""
    follows = Condition(
        f"{name} follows its model",
        f"{name} has no zero at a pole of its model ({description})",
        not lost,
        float(len(lost)),
        0.0,
        _SOURCE,
        f"{_gap(decoupled)}{share}" if not lost else _hidden(plant, decoupled, lost[0]),
        mode=lost[0] if lost else None,
        signals=(name,) if lost else (),
    )
    if doubtful and len(doubtful) == len(lost):
        return visible, _in_doubt(follows, plant, decoupled, doubtful[0])
    at_rounding_level = not lost and bool(shares) and shares[least] <= ROUNDING_LEVEL
    return visible, _in_doubt(follows, plant, decoupled, least) if at_rounding_level else follows


def _may_show(decoupled: DecoupledFault, point: complex | None = None) -> bool:
    """Whether a fault that floating point does not see shows on paper (at a point), or may for all that can be
    isolated."""
    if decoupled.exactly:
        return False
    if not decoupled.clear:
        return True
    plant = decoupled.source
    if plant.nx + plant.nd + plant.nf > COMPUTED_STATES or plant.exact is not None:
        return False
    exact = decoupled_fault(plant, decoupled.removed, decoupled.number, True)
    return exact.visible if point is None else exact.shows_at(point)


def _named_columns(plant: DescriptorSystem, decoupled: DecoupledFault) -> NamedPencil:
    """Return what the fault must not be a combination of, and the fault itself in the last column."""
    columns = {name: [*decoupled.removed, decoupled.number] for name in ("Bf", "Df")}
    return Evaluator(plant).named(FullRank([["A", "Bd", "Bf"], ["C", "Dd", "Df"]], columns))


def _in_doubt(condition: Condition, plant: DescriptorSystem, decoupled: DecoupledFault, point: complex) -> Condition:
    """Return the condition as one that rounding of the data could change."""
    named, name = _named_columns(plant, decoupled), plant.fault_names[decoupled.number]
    share = named.last_share(point)
    other = f"hides {name} at {'z' if plant.dt > 0.0 else 's'} = {pole_text(point)}, and no filter estimates it"
    doubt = Evaluator(plant).doubt(named, other, point=point, tolerance=max(ROUNDING_LEVEL, share), last=True)
    detail = f"{share:.1g} of {name} reaches the outputs at {pole_text(point)}: rounding of the data is as large."
    return replace(condition, detail=detail, mode=point, signals=(name,)).in_doubt(doubt, plant)


def _residual_conditions(plant: DescriptorSystem, sensitive: Sequence[int], exactly: bool | None) -> list[Condition]:
    """Return whether each fault of a set shows in residuals that are blind to all others."""
    removed = [j for j in range(plant.nf) if j not in sensitive]
    conditions = []
    for fault in sensitive:
        decoupled = decoupled_fault(plant, removed, fault, exactly)
        blind = [*plant.disturbance_names, *(plant.fault_names[j] for j in removed)]
        without = f" without {', '.join(plant.fault_names[j] for j in removed)}" if removed else ""
        name = f"{plant.fault_names[fault]} detectable{without}"
        conditions.append(_visibility(plant, decoupled, name, ", ".join(blind) or "the initial state"))
    return conditions


def _visibility(plant: DescriptorSystem, decoupled: DecoupledFault, name: str, unknowns: str) -> Condition:
    """Return the condition of this name that a fault shows, decoupled from the rest."""
    fault, point = plant.fault_names[decoupled.number], dc_point(plant.dt)
    condition = Condition(
        name,
        f"{fault} is visible, decoupled from {unknowns}",
        decoupled.visible,
        float(decoupled.visible),
        1.0,
        _SOURCE,
        _gap(decoupled) if decoupled.visible else _hidden(plant, decoupled, point),
        signals=() if decoupled.visible else (fault,),
    )
    return (
        _in_doubt(condition, plant, decoupled, point) if not decoupled.visible and _may_show(decoupled) else condition
    )


def _other_signals(plant: DescriptorSystem, fault: int) -> str:
    names = [*plant.disturbance_names, *(name for j, name in enumerate(plant.fault_names) if j != fault)]
    return ", ".join(names) or "the initial state"


def _gap(decoupled: DecoupledFault) -> str:
    return "decided exactly" if np.isinf(decoupled.gap) else f"gap {decoupled.gap:.1e}"


def _hidden(plant: DescriptorSystem, decoupled: DecoupledFault, point: complex) -> str:
    motion = hidden_motion(plant, decoupled.number, point, decoupled.removed)
    if motion is None:
        return "no output responds to it."
    return f"{motion} ({'z' if plant.dt > 0.0 else 's'} = {pole_text(point)})."


def chosen_faults(faults: Any, plant: DescriptorSystem) -> list[int]:
    """Return the columns of the faults to estimate."""
    listed = [faults] if isinstance(faults, str) else list(plant.fault_names if faults is None else faults)
    numbers = fault_numbers(plant, listed, f"{OPTIONS_PATH}.faults")
    if len(numbers) < len(listed):
        names = ", ".join(plant.fault_names)
        raise SpecError(f"a fault is named twice; there are: {names}.", path=f"{OPTIONS_PATH}.faults")
    return sorted(numbers)


def residual_sets(residuals: Any, plant: DescriptorSystem) -> list[list[int]] | None:
    """Return the sets of faults that residuals are to see; ``None`` where estimates are asked for."""
    if residuals is None:
        return None
    everything = list(range(plant.nf))
    if residuals == "detect":
        return [everything]
    if residuals == "isolate":
        return [[i] for i in everything]
    entries = [residuals] if isinstance(residuals, str) else list(residuals)
    sets = [[entry] if isinstance(entry, str) else list(entry) for entry in entries]
    unknown = sorted({str(name) for entry in sets for name in entry if name not in plant.fault_names})
    if unknown or not all(sets):
        raise SpecError(
            f"residuals is {residuals!r}: give detect, isolate, or lists of faults to see; there are: "
            f"{', '.join(plant.fault_names) or 'none'}.",
            path=f"{OPTIONS_PATH}.residuals",
        )
    return [sorted(plant.fault_names.index(name) for name in entry) for entry in sets]

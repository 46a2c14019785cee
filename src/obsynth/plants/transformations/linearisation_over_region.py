"""A nonlinear plant whose equations are linear beside measured inputs, parameters or constants, as a plant over their
region: exact Jacobians as expressions in them."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np

from obsynth.errors import PreconditionError, SpecError
from obsynth.numerics.suggestions import there_are
from obsynth.plants.dae import DAEModel
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.polytopic import PolytopicSystem
from obsynth.plants.scheduled_inputs import SHIFT_INPUT
from obsynth.plants.scheduling import parameters_of
from obsynth.plants.transformations.entries_in_constants import entries_in, promoted, require_linear_beside
from obsynth.plants.transformations.equilibrium import Point


def scheduled_names(
    model: DAEModel, region: Mapping[str, Any] | None, scheduling: Sequence[str] | None, *, constants: Any, drift: bool
) -> dict[str, dict[str, Any]]:
    """Return the scheduling parameters that are asked for by name, as `PolytopicSystem` takes them; none without a
    region."""
    if region is None:
        if scheduling is not None:
            raise SpecError("scheduling needs the ranges of these signals: give region.", path="region")
        return {}
    if isinstance(scheduling, str):
        raise SpecError(f"scheduling is the text {scheduling!r}: give a list of names.", path="scheduling")
    parameters = parameters_of(region)
    names = list(parameters) if scheduling is None else list(scheduling)
    for name in names:
        if name not in parameters:
            raise SpecError(f"scheduling has {name!r}, of which region gives no range.", path=f"region.{name}")
        _require_no_state(model, name)
    idle = [name for name in parameters if name not in names]
    if idle:
        raise SpecError(
            f"region has {idle[0]!r}, by which the model is not scheduled: name it in scheduling, or leave it out. A "
            "nonlinear plant over a region of its states is for obsynth.region_observer.",
            path=f"region.{idle[0]}",
        )
    if constants is not None or drift:
        raise SpecError(
            f"A model over a region has no {'constants' if constants is not None else 'drift'}: leave it out.",
            path="constants" if constants is not None else "drift",
        )
    return {name: parameters[name] for name in names}


def at_scheduling(
    model: DAEModel, scheduling: Mapping[str, Mapping[str, Any]], given: Mapping[str, float]
) -> tuple[DAEModel, dict[str, float]]:
    """Return the model whose scheduled constants are parameters, and what is given with the scheduling at its nominal
    values, in the middle of its range where these are outside."""
    promoted_model = promoted(model, tuple(scheduling))
    known = dict(zip(promoted_model.parameter_names, promoted_model.nominal_parameters.tolist(), strict=True))
    known |= dict(zip(model.input_names, model.nominal_input.tolist(), strict=True))
    values = dict(given)
    for name, entry in scheduling.items():
        low, high = entry["range"]
        nominal = known[name] if low <= known[name] <= high else 0.5 * (low + high)
        values.setdefault(name, nominal)
    return promoted_model, values


def unscheduled_faults(
    model: DAEModel, scheduling: Collection[str], faults: Sequence[str] | None, disturbances: Sequence[str]
) -> list[str]:
    """Return the parameters that are faults: all that are not scheduled by default."""
    chosen = [name for name in model.parameter_names if name not in scheduling] if faults is None else list(faults)
    both = [name for name in (*chosen, *disturbances) if name in scheduling]
    if both:
        kind = "a fault" if both[0] in chosen else "a disturbance"
        raise SpecError(f"{both[0]!r} is scheduled, and {kind}: choose one.", path=f"region.{both[0]}")
    return chosen


def over_scheduling(
    linear: DescriptorSystem,
    model: DAEModel,
    point: Point,
    parameters: Mapping[str, Mapping[str, Any]],
    faults: Sequence[str],
    disturbances: Sequence[str],
) -> PolytopicSystem:
    """Return a linear model at a point over the region of its scheduling.

    Raises
    ------
    PreconditionError
        The equations are not linear beside the scheduling.
    """
    require_linear_beside(model, tuple(parameters), faults)
    unknown = [model.input_names.index(name) for name in disturbances]
    columns = {
        "B": [i for i, name in enumerate(model.input_names) if i not in unknown and name not in parameters],
        "Bd": unknown,
        "Bf": [model.parameter_names.index(name) for name in faults],
    }
    at = dict(zip((*model.parameter_names, *model.input_names), (*point.theta, *point.u), strict=True))
    entries, moved, shown = entries_in(
        model, point, {name: float(at[name]) for name in parameters}, columns, moving=False
    )
    shift = None
    if moved or shown:
        shift, place = shift_name(linear), linear.nu
        linear = with_shift(linear, shift)
        for name, items in (("B", moved), ("D", shown)):
            entries[name] = [*entries.get(name, []), *((i, place, text) for i, _, text in items)]
    arguments = {name: value for name, value in linear.as_dict().items() if value is not None}
    for name, items in entries.items():
        rows: list[list[Any]] = np.asarray(getattr(linear, name)).tolist()
        for i, j, text in items:
            rows[i][j] = text
        arguments[name] = rows
    scheduling = {
        name: {**({"unit": model.units[name]} if name in model.units else {}), **entry}
        for name, entry in parameters.items()
    }
    return PolytopicSystem(plant=arguments, scheduling=scheduling, shift=shift)


def shift_name(linear: DescriptorSystem) -> str:
    """Return what the input is called that is one in every row."""
    taken = {
        *linear.state_names,
        *linear.input_names,
        *linear.output_names,
        *linear.fault_names,
        *linear.disturbance_names,
    }
    return SHIFT_INPUT if SHIFT_INPUT not in taken else f"equilibrium {SHIFT_INPUT}"


def with_shift(linear: DescriptorSystem, shift: str) -> DescriptorSystem:
    """Return a linear model with one more input, whose columns are zero."""
    return linear.replace(
        B=np.column_stack([linear.B, np.zeros(linear.nx)]),
        D=np.column_stack([linear.D, np.zeros(linear.ny)]),
        input_names=[*linear.input_names, shift],
        operating_point={**linear.operating_point, shift: 0.0},
        units={**linear.units, shift: "1"} if linear.units else linear.units,
    )


def _require_no_state(model: DAEModel, name: str) -> None:
    """Refuse to schedule by what the plant itself moves."""
    if name in model.input_names or name in model.parameter_names or name in model.constants:
        return
    if name not in model.state_names:
        known = (*model.input_names, *model.parameter_names, *model.constants)
        raise SpecError(
            f"{name!r} is no input, parameter or constant of the model; {there_are(name, known)}",
            path=f"region.{name}",
        )
    raise PreconditionError(
        f"{name!r} is a state: the derivatives at its present value are not the plant's way from the operating point "
        "there, so that a model scheduled by it would be wrong at rest. Take the nonlinear equations "
        "(obsynth.region_observer); or, where it is measured and multiplies other signals, write the measured value "
        "there as an input of its own, and schedule by that.",
        condition="scheduling by a state",
        signals=(name,),
    )

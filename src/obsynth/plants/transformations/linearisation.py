"""Exact linearisation of nonlinear plants, at an equilibrium or at a point of a trajectory."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal, overload

import numpy as np

from obsynth.errors import PreconditionError, SpecError
from obsynth.numerics.arguments import arguments_checked, real_number
from obsynth.numerics.arrays import FloatArray
from obsynth.plants.constants import ConstantsBox
from obsynth.plants.dae import DAEModel
from obsynth.plants.dae_functions import LocalEquations, local_equations
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.polytopic import PolytopicSystem
from obsynth.plants.signal_names import index_of
from obsynth.plants.transformations.entries_in_constants import at_nominal, box_of_model, entries_in_constants
from obsynth.plants.transformations.equilibrium import Point, consistent_point, equilibrium, nominal_point
from obsynth.plants.transformations.linearisation_over_region import (
    at_scheduling,
    over_scheduling,
    scheduled_names,
    shift_name,
    unscheduled_faults,
    with_shift,
)
from obsynth.plants.uncertain_system import filled_plant
from obsynth.plants.uncertainty import Uncertainty

#: What E x' may be, in sizes of its row, where a point counts as resting.
LARGEST_MOTION = 1e-9

#: Input of a linear model at a moving point: it is one, always.
DRIFT = "drift"


@overload
def linearise(
    model: DAEModel,
    *,
    at: Literal["equilibrium", "point"] = ...,
    given: Mapping[str, float] | None = ...,
    free: Sequence[str] | Mapping[str, tuple[float, float]] = ...,
    faults: Sequence[str] | None = ...,
    disturbances: Sequence[str] = ...,
    start: Mapping[str, float] | None = ...,
    drift: bool = ...,
    constants: Mapping[str, Any] | ConstantsBox | None = ...,
    sensor_noise: Mapping[str, float] | None = ...,
    process_noise: Mapping[str, float] | None = ...,
    region: None = ...,
    scheduling: None = ...,
) -> DescriptorSystem: ...
@overload
def linearise(
    model: DAEModel,
    *,
    at: Literal["equilibrium", "point"] = ...,
    given: Mapping[str, float] | None = ...,
    free: Sequence[str] | Mapping[str, tuple[float, float]] = ...,
    faults: Sequence[str] | None = ...,
    disturbances: Sequence[str] = ...,
    start: Mapping[str, float] | None = ...,
    drift: bool = ...,
    constants: Mapping[str, Any] | ConstantsBox | None = ...,
    sensor_noise: Mapping[str, float] | None = ...,
    process_noise: Mapping[str, float] | None = ...,
    region: Mapping[str, Any],
    scheduling: Sequence[str] | None = ...,
) -> PolytopicSystem: ...
@arguments_checked
def linearise(
    model: DAEModel,
    *,
    at: Literal["equilibrium", "point"] = "equilibrium",
    given: Mapping[str, float] | None = None,
    free: Sequence[str] | Mapping[str, tuple[float, float]] = (),
    faults: Sequence[str] | None = None,
    disturbances: Sequence[str] = (),
    start: Mapping[str, float] | None = None,
    drift: bool = False,
    constants: Mapping[str, Any] | ConstantsBox | None = None,
    sensor_noise: Mapping[str, float] | None = None,
    process_noise: Mapping[str, float] | None = None,
    region: Mapping[str, Any] | None = None,
    scheduling: Sequence[str] | None = None,
) -> DescriptorSystem | PolytopicSystem:
    r"""Linearise a nonlinear plant: exact Jacobians, names, units and operating point.

    With ``F(d/dt q(x, theta), x, u, theta) = 0`` and ``G(x', x, u, theta) = F(q_x x', x, u, theta)``

    .. math::
        E = G_{x'}, \quad A = -G_x, \quad B = -G_u, \quad B_f = -G_\theta, \quad C = h_x, \quad D_f = h_\theta .

    Parameters
    ----------
    model : DAEModel
        ``nx`` states, ``nu`` inputs, ``ny`` outputs, ``nq`` parameters.
    at : {"equilibrium", "point"}, optional
        Where nothing moves, found from what is given; or the point that is given, nominal where nothing is said, with
        the algebraic states solved for.
    given : mapping, optional
        Values of states, inputs, parameters and (at an equilibrium) outputs, in their units.  Inputs and parameters
        that are not given have their nominal values; states are unknown.
    free : list of str, or mapping of str to (low, high), optional
        Inputs and parameters that are solved for at an equilibrium, with the bounds they must keep.
    faults : list of str, optional
        Parameters that become faults ``Bf (nx, nf)``, ``Df (ny, nf)``: deviations from their values at the point; all
        by default.  Where a derivative is taken of something that contains one, the columns hold while its deviation
        is constant.
    disturbances : list of str, optional
        Inputs that are not known: they become ``Bd (nx, nd)``.
    start : mapping, optional
        Where the search for an equilibrium begins: states by name; nominal values by default.
    drift : bool, optional
        Whether a point that moves is taken: its motion becomes an input ``drift``, which is 1 in every row.
    constants : mapping, ConstantsBox or CalibratedBox, optional
        Tolerances of constants and parameters of the model, as `obsynth.uncertain_system` takes them; parameters among
        them are no faults.  Entries of the linear model are then expressions in them (CasADi's derivatives, at the one
        point), and the equilibrium that others have acts as an input ``shift``, which is 1 in every row and zero for
        the nominal ones.  What is not linear in the plant is not covered.
    sensor_noise : mapping, optional
        Standard deviation of white noise by output, in its unit: columns of ``Dw (ny, nw)``.
    process_noise : mapping, optional
        Intensity of white noise by equation, in the unit of the equation times the root of a second: columns of
        ``Bw (nx, nw)``, which come before those of the sensors.
    region : mapping, optional
        Ranges ``[low, high]`` of inputs, parameters or constants that are measured while they change (or ``{"range":
        [low, high], "rate": ..., "column": ...}``, as `obsynth.PolytopicSystem` takes them).  Entries are then
        expressions in them, and the equations must be linear in everything else, so that the model is exact at every
        point of the region.  They are no inputs and no faults then; what they move beside the point acts as an input
        ``shift``, which is 1 in every row.
    scheduling : list of str, optional
        Names of these; all that ``region`` names by default.

    Returns
    -------
    DescriptorSystem, or PolytopicSystem for a region
        Continuous in time, in deviations from ``operating_point``.  A state whose name an output has, with another
        value, is called ``"... (state)"``.  With ``constants`` it knows its tolerances; those that stand in no entry
        are left out.

    Raises
    ------
    SpecError
        A name is unknown, a value is no finite number, or an output is given for a point.
    PreconditionError
        ``no-equilibrium``: nothing satisfies the equations at rest; the combination of equations that no unknown
        changes is named.  ``equilibrium-not-unique``: the direction that nothing determines is named.
        ``outside-bounds``: what is free would leave its bounds.  ``no-consistent-point``: no derivatives satisfy the
        equations at the point.

    Examples
    --------
    >>> tank = DAEModel(
    ...     {"balance": "2.0 * der(level) = inflow - c * sqrt(level)"}, {"seen": "level"}, states={"level": 1.0},
    ...     inputs={"inflow": 0.5}, parameters={"c": 0.5},
    ...     units={"level": "m", "inflow": "m3/s", "c": "m2.5/s", "seen": "m"},
    ... )
    >>> linear = linearise(tank, given={"level": 4.0}, free=["inflow"])
    >>> float(linear.operating_point["inflow"]), linear.A.tolist()
    (1.0, [[-0.125]])

    References
    ----------
    .. [CampbellLinearisation1995] S. L. Campbell, "Linearization of DAEs along trajectories", ZAMP 46, 1995; at a
       moving point we keep E x' as an input, which is exact to first order.
    """
    values, freed = dict(given or {}), _names(free, "free")
    parameters = scheduled_names(model, region, scheduling, constants=constants, drift=drift)
    if parameters:
        model, values = at_scheduling(model, parameters, values)
    for name, bounds in free.items() if isinstance(free, Mapping) else ():
        if np.shape(bounds) != (2,) or not float(bounds[0]) <= float(bounds[1]):
            raise SpecError(f"free.{name} must be [low, high].", path=f"free.{name}")
    box = None
    if constants is not None:
        box = box_of_model(model, constants, values)
        both = [name for name in box.names if name in freed or name in (faults or ())]
        if both:
            raise SpecError(
                f"{both[0]!r} has a tolerance, and is {'free' if both[0] in freed else 'a fault'}: choose one.",
                path=f"constants.{both[0]}",
            )
        model = at_nominal(model, box)
    if at == "equilibrium":
        point = equilibrium(model, values, freed, start)
        _require_bounds(model, point, free)
    else:
        if freed or start:
            raise SpecError("free and start belong to an equilibrium: at a point, give every value.", path="free")
        others = (*model.state_names, *model.input_names, *model.parameter_names)
        wrong = [name for name in values if name in model.output_names and name not in others]
        if wrong:
            raise SpecError(
                f"The output {wrong[0]!r} cannot be given at a point: give states.", path=f"given.{wrong[0]}"
            )
        point = consistent_point(model, nominal_point(model, values), values)
    if parameters:
        faults = unscheduled_faults(model, parameters, faults, disturbances)
    linear = linear_model(
        model, point, faults=faults, disturbances=disturbances, drift=drift, box=box, scheduled=parameters
    )
    linear = _with_noise(linear, model.equation_names, process_noise, sensor_noise)
    return over_scheduling(linear, model, point, parameters, faults or (), disturbances) if parameters else linear


def _with_noise(
    linear: DescriptorSystem,
    equations: Sequence[str],
    process_noise: Mapping[str, float] | None,
    sensor_noise: Mapping[str, float] | None,
) -> DescriptorSystem:
    """Return a linear model with the noise of its equations and sensors, if any is stated."""
    if process_noise:
        columns = np.zeros((linear.nx, len(process_noise)))
        for column, (name, value) in enumerate(process_noise.items()):
            row = index_of(name, equations, what="process_noise")
            real_number(value, f"process_noise.{name}", "an intensity above 0", above=0.0)
            columns[row, column] = value
        linear = linear.replace(Bw=columns, Dw=np.zeros((linear.ny, len(process_noise))))
    return linear.replace(sensor_noise=sensor_noise) if sensor_noise else linear


def linear_model(
    model: DAEModel,
    point: Point,
    *,
    faults: Sequence[str] | None,
    disturbances: Sequence[str],
    drift: bool,
    box: ConstantsBox | None = None,
    scheduled: Collection[str] = (),
) -> DescriptorSystem:
    """Return the linear model at a point that satisfies the equations, over the box of its constants if it has one;
    ``scheduled`` are no inputs."""
    local = local_equations(model, point.rates, point.x, point.u, point.theta)
    if not local.is_defined:
        raise PreconditionError(
            "The derivatives of the model are not finite at the point: move it.",
            condition="not-differentiable",
            signals=list(model.equation_names),
        )
    motion = _motion(model, point, local, drift=drift)
    uncertain = () if box is None else box.names
    every = [name for name in model.parameter_names if name not in uncertain]
    chosen = every if faults is None else _names(faults, "faults")
    fault_columns = [index_of(name, model.parameter_names, what="faults") for name in chosen]
    unknown = [index_of(name, model.input_names, what="disturbances") for name in _names(disturbances, "disturbances")]
    known = [i for i in range(model.nu) if i not in unknown and model.input_names[i] not in scheduled]
    inputs, B = [model.input_names[i] for i in known], -local.by_input[:, known]
    if motion is not None:
        inputs, B = [*inputs, DRIFT], np.column_stack([B, motion])
    names = _state_names(model, point, local)
    values = _values_at(model, point, local, names) | ({} if motion is None else {DRIFT: 0.0})
    signals = {*names, *inputs, *model.output_names, *chosen, *disturbances}
    units = {name: unit for name, unit in model.units.items() if name in signals}
    units |= {
        name: model.units[original]
        for name, original in zip(names, model.state_names, strict=True)
        if original in model.units
    }
    linear = DescriptorSystem(
        local.E,
        -local.by_state,
        B if inputs else None,
        local.C,
        dt=0.0,
        Bf=-local.by_parameter[:, fault_columns] if fault_columns else None,
        Df=local.outputs_by_parameter[:, fault_columns] if fault_columns else None,
        Bd=-local.by_input[:, unknown] if unknown else None,
        state_names=names,
        input_names=inputs or None,
        output_names=list(model.output_names),
        fault_names=list(chosen) or None,
        disturbance_names=list(disturbances) or None,
        units=units,
        operating_point={name: value for name, value in values.items() if name in signals},
    )
    if box is None or not box.names:
        return linear
    columns = {"B": known, "Bd": unknown, "Bf": fault_columns}
    return _over_box(linear, model, point, box, columns, moving=motion is not None)


def _state_names(model: DAEModel, point: Point, local: LocalEquations) -> list[str]:
    """Return the names of the states: none is that of an output with another value."""
    outputs = dict(zip(model.output_names, local.y, strict=True))
    return [
        name if outputs.get(name, x) == x else f"{name} (state)"
        for name, x in zip(model.state_names, point.x, strict=True)
    ]


def _values_at(model: DAEModel, point: Point, local: LocalEquations, states: Sequence[str]) -> dict[str, float]:
    """Return the value of every signal at the point, by name."""
    names = (*model.parameter_names, *model.input_names, *states, *model.output_names)
    return dict(zip(names, map(float, (*point.theta, *point.u, *point.x, *local.y)), strict=True))


def _motion(model: DAEModel, point: Point, local: LocalEquations, *, drift: bool) -> FloatArray | None:
    """Return ``E x'`` of a point that moves, refused unless ``drift`` makes an input of it; ``None`` at rest."""
    motion = local.E @ point.rates
    moves = np.abs(motion) > LARGEST_MOTION * np.maximum(
        np.abs(local.by_state) @ model.state_scales, np.abs(motion).min()
    )
    if not moves.any():
        return None
    if not drift:
        moved = {name: value for name, value, moving in zip(model.equation_names, motion, moves, strict=True) if moving}
        raise PreconditionError(
            f"The point moves: E x' = ({', '.join(f'{name}: {value:.4g}' for name, value in moved.items())}), so that "
            f"it is no equilibrium. With drift=True this motion becomes an input {DRIFT!r}, which is 1 in every row.",
            condition="no-equilibrium",
            signals=list(moved),
        )
    return np.asarray(motion)


def _over_box(
    linear: DescriptorSystem,
    model: DAEModel,
    point: Point,
    box: ConstantsBox,
    columns: Mapping[str, Sequence[int]],
    *,
    moving: bool,
) -> DescriptorSystem:
    """Return a linear model that knows the tolerances of its constants."""
    entries, moved, outputs = entries_in_constants(model, point, box, columns, moving=moving)
    shift = ""
    if moved or outputs:
        shift = shift_name(linear)
        nu = linear.nu
        for name, items in (("B", moved), ("D", outputs)):
            if items:
                entries[name] = [*entries.get(name, []), *((i, nu, text) for i, _, text in items)]
        linear = with_shift(linear, shift)
    uncertainty = Uncertainty(box, {name: tuple(items) for name, items in entries.items()}, shift=shift)
    used = {name: item for name, item in box.constants.items() if name in uncertainty.used}
    return filled_plant(linear, uncertainty.with_box(replace(box, constants=used)), set(used))


def _names(value: Sequence[str] | Mapping[str, tuple[float, float]], what: str) -> list[str]:
    if isinstance(value, str):
        raise SpecError(f"{what} is the text {value!r}: give a list of names.", path=what)
    return list(value)


def _require_bounds(model: DAEModel, point: Point, free: Sequence[str] | Mapping[str, tuple[float, float]]) -> None:
    if not isinstance(free, Mapping):
        return
    values = dict(zip((*model.input_names, *model.parameter_names), (*point.u, *point.theta), strict=True))
    outside = {
        name: f"{name} = {values[name]:.6g} is outside [{float(low):g}, {float(high):g}]"
        for name, (low, high) in free.items()
        if not float(low) <= values[name] <= float(high)
    }
    if outside:
        raise PreconditionError(
            f"The equilibrium is not admissible: {'; '.join(outside.values())}. Give other values, or free something "
            "else.",
            condition="outside-bounds",
            signals=list(outside),
        )

"""Coloured noise, sensor offsets and random-walk loads as further states of a plant, for use with every method."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics.arguments import arguments_checked, real_number
from obsynth.numerics.arrays import SMALLEST, FloatArray, require_no_overflow
from obsynth.numerics.quantities import numbers_in_units
from obsynth.plants.dae import DAEModel
from obsynth.plants.dae_signals import step_length
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.noise import (
    OFFSET_SIZE,
    OFFSET_WALK,
    SensorNoise,
    noise_state,
    offset_state,
    process_variance,
    sensor_noises,
    stated_number,
)
from obsynth.plants.signal_names import index_of
from obsynth.plants.transformations.recovery import Transformation, unchanged_states
from obsynth.plants.uncertainty import Uncertainty


@arguments_checked
def with_noise(
    plant: DescriptorSystem | Transformation | DAEModel,
    *,
    sensor_noise: Mapping[str, Any] | None = None,
    offset: Mapping[str, Any] | Sequence[str] | None = None,
    walks: Mapping[str, float] | None = None,
    process_noise: Mapping[str, float] | None = None,
    dt: float | None = None,
    integration: str = "backward-euler",
) -> tuple[Transformation | DAEModel, dict[str, Any]]:
    r"""Give a plant states for coloured noise, for offsets of sensors, and for loads that are random walks.

    Coloured noise :math:`n_y` of an output, its offset :math:`o_y` and a load :math:`l` follow

    .. math::
        \dot n_y = -n_y / \tau + \sigma \sqrt{2 / \tau}\, w, \qquad \dot o_y \approx 0, \qquad \dot l = s\, w, \qquad
        y = \dots + n_y + o_y .

    Every method takes the plant as any other; the plant's own states keep their names and come first.  What cannot be
    distinguished (an offset and a fault of the same sensor) is named by the existence conditions.

    Parameters
    ----------
    plant : DescriptorSystem, Transformation or DAEModel
        ``nx`` states, ``ny`` outputs; give a linear plant before it is sampled or its algebraic states are eliminated.
    sensor_noise : mapping, optional
        By output: a standard deviation of white noise, or ``{"deviation": number, "correlation": "5 s"}`` (seconds
        where there is no unit), with ``"white"``: the deviation of what is white beside it, by default a hundredth.
    offset : mapping or list of str, optional
        By output: ``"unknown"``, or the standard deviation of what the offset may be, in the output's unit.
    walks : mapping, optional
        By unknown input or fault of a linear plant, by input or parameter of a nonlinear one: how far it walks, in its
        unit per square root of a second; of discrete plants per sample.
    process_noise : mapping, optional
        Of a nonlinear plant: intensity of white noise by equation, as for `linearise`.
    dt, integration : float and str, optional
        Of the design of a nonlinear plant, in s: Q and R of its options are per step.

    Returns
    -------
    tuple
        The plant with these states (of a linear one with the way back), and options of the methods that take them:
        of a nonlinear plant ``Q``, ``R`` and ``initial_covariance`` by name, or without ``dt`` the arguments of
        `linearise`; of a linear one ``initial_covariance``.

    Raises
    ------
    SpecError
        A name is unknown, a number is not positive or still unknown, or the model is given as Python functions.

    Examples
    --------
    >>> plant = DescriptorSystem(None, [[-1.0]], C=[[1.0]], output_names=["y"])
    >>> made, _ = with_noise(plant, sensor_noise={"y": {"deviation": 0.1, "correlation": "5 s"}})
    >>> made.plant.state_names, made.plant.A.tolist()
    (('x1', 'noise_y'), [[-1.0, 0.0], [0.0, -0.2]])
    """
    own = plant.plant if isinstance(plant, Transformation) else plant
    names = own.output_names
    sizes, shifts = (
        numbers_in_units(stated, own.units, kind, are_differences=True)
        for kind, stated in (("sensor_noise", sensor_noise), ("offset", offset))
    )
    noises = sensor_noises(sizes, names)
    offsets = _offsets(() if shifts is None else shifts, names, noises)
    loads = {name: stated_number(value, f"walks.{name}") for name, value in (walks or {}).items()}
    if isinstance(plant, DAEModel):
        model = _of_equations(plant, noises, offsets, loads)
        drives = _intensities_by_equation(plant, process_noise)
        if dt is None:
            return model, _intensities(plant, noises, offsets, loads, drives)
        step = step_length(dt)
        for what, value in (("dt", step), ("1 / dt", 1.0 / max(step, SMALLEST))):
            require_no_overflow(value, what, "dt")
        return model, _options(model, noises, offsets, loads, drives, step, integration)
    if isinstance(plant, Transformation):
        made, options = _of_matrices(plant.plant, noises, offsets, loads)
        return plant.then(made), options
    return _of_matrices(plant, noises, offsets, loads)


def _intensities_by_equation(model: DAEModel, intensities: Mapping[str, float] | None) -> dict[str, float]:
    """Return the intensity of white noise by equation."""
    for name, value in (intensities or {}).items():
        index_of(name, model.equation_names, what="process_noise")
        real_number(value, f"process_noise.{name}", "an intensity above 0", above=0.0, path="process_noise")
    return {name: float(value) for name, value in (intensities or {}).items()}


def _offsets(offset: Any, names: Sequence[str], noises: Mapping[str, SensorNoise]) -> dict[str, tuple[float, float]]:
    """Return by output the deviation of its offset, and how far it walks: in the unit of a deviation."""
    offsets = {}
    for name, value in (offset if isinstance(offset, Mapping) else dict.fromkeys(offset, "unknown")).items():
        index_of(name, names, what="offset")
        size = noises[name].size if name in noises else 1.0
        deviation = OFFSET_SIZE * size if value == "unknown" else stated_number(value, f"offset.{name}")
        offsets[name] = deviation, OFFSET_WALK * size
    return offsets


def _of_matrices(
    plant: DescriptorSystem,
    noises: Mapping[str, SensorNoise],
    offsets: Mapping[str, tuple[float, float]],
    loads: Mapping[str, float],
) -> tuple[Transformation, dict[str, Any]]:
    coloured = {name: noise for name, noise in noises.items() if noise.correlation}
    own = plant.dense()
    nx, ny, count = own.nx, own.ny, len(coloured) + len(offsets) + len(loads)
    names = [*map(noise_state, coloured), *map(offset_state, offsets)]
    names += [name if name not in own.state_names else f"walk_{name}" for name in loads]
    # In continuous time rates, in discrete time what a sample keeps.
    times = np.array([noise.correlation for noise in coloured.values()])
    sizes = np.array([noise.deviation for noise in coloured.values()])
    decays = np.exp(-own.dt / times) if own.is_discrete else -1.0 / times
    drives = sizes * (np.sqrt(1.0 - decays**2) if own.is_discrete else np.sqrt(2.0 / times))
    keeps = np.concatenate([decays, np.full(len(offsets) + len(loads), 1.0 if own.is_discrete else 0.0)])
    driven = np.concatenate([drives, [walk for _, walk in offsets.values()], list(loads.values())])
    dynamics, outputs = np.zeros((nx, count)), np.zeros((ny, count))
    for column, name in enumerate((*coloured, *offsets)):
        outputs[own.output_names.index(name), column] = 1.0
    moved, other_columns = _columns_of(own, loads)
    for column, (matrix, direct, i) in enumerate(moved, len(coloured) + len(offsets)):
        dynamics[:, column], outputs[:, column] = getattr(own, matrix)[:, i], getattr(own, direct)[:, i]

    def below(matrix: FloatArray) -> FloatArray:
        return np.vstack([matrix, np.zeros((count, matrix.shape[1]))])

    E = np.block([[own.E, np.zeros((nx, count))], [np.zeros((count, nx)), np.eye(count)]])
    A = np.block([[own.A, dynamics], [np.zeros((count, nx)), np.diag(keeps)]])
    white = {name: noise.white for name, noise in noises.items() if noise.white > 0.0}
    new = own.replace(
        E=E,
        A=A,
        C=np.hstack([own.C, outputs]),
        B=below(own.B),
        Bf=below(own.Bf[:, other_columns["Bf"]]),
        Df=own.Df[:, other_columns["Bf"]],
        Bd=below(own.Bd[:, other_columns["Bd"]]),
        Dd=own.Dd[:, other_columns["Bd"]],
        Bw=np.hstack([below(own.Bw), np.vstack([np.zeros((nx, count)), np.diag(driven)])]),
        Dw=np.hstack([own.Dw, np.zeros((ny, count))]),
        state_names=(*own.state_names, *names),
        fault_names=[own.fault_names[i] for i in other_columns["Bf"]],
        disturbance_names=[own.disturbance_names[i] for i in other_columns["Bd"]],
        noise_names=(*own.noise_names, *(f"drive of {name}" for name in names)),
        units={**own.units, **_units(own.units, dict(zip(names, (*coloured, *offsets, *loads), strict=True)))},
        uncertainty=_carried(own, moved, other_columns, len(coloured) + len(offsets)),
    )
    new = new.replace(sensor_noise=white) if white else new
    spread = np.array([*sizes, *(size for size, _ in offsets.values()), *np.ones(len(loads))])
    kept_noise = np.eye(own.nw, new.nw)
    recovery = unchanged_states(plant, new, from_state=np.eye(nx, nx + count), noise_kept=kept_noise)
    description = f"appended {', '.join(names)} as states" if names else ""
    options = {"initial_covariance": np.diag(np.concatenate([np.ones(nx), spread**2]))} if names else {}
    return Transformation(plant, new, description, recovery), options


def _columns_of(
    plant: DescriptorSystem, loads: Mapping[str, float]
) -> tuple[list[tuple[str, str, int]], dict[str, list[int]]]:
    """Return matrices and columns of loads, unknown inputs or faults, and the columns that are left."""
    known = {"Bd": ("Dd", plant.disturbance_names), "Bf": ("Df", plant.fault_names)}
    moved = []
    for name in loads:
        homes = [(matrix, direct, names.index(name)) for matrix, (direct, names) in known.items() if name in names]
        if not homes:
            index_of(name, (*plant.disturbance_names, *plant.fault_names), what="walks")
        moved.append(homes[0])
    other_columns = {
        matrix: [i for i in range(len(names)) if not any(item[0] == matrix and item[2] == i for item in moved)]
        for matrix, (_, names) in known.items()
    }
    return moved, other_columns


def _carried(
    plant: DescriptorSystem,
    moved: Sequence[tuple[str, str, int]],
    other_columns: Mapping[str, list[int]],
    first: int,
) -> Uncertainty | None:
    """Return what is uncertain in a plant with further states: entries of the columns of loads are then of A and C."""
    uncertain = plant.uncertainty
    if uncertain is None or uncertain.lost:
        return uncertain
    if uncertain.written is not None:
        return uncertain.left_behind("states were appended after the plant was transformed: append them before")
    entries = {name: list(items) for name, items in uncertain.entries.items()}
    for matrix, target in (("Bd", "A"), ("Bf", "A"), ("Dd", "C"), ("Df", "C")):
        beside = matrix.replace("D", "B")
        unmoved = []
        for row, column, text in entries.pop(matrix, []):
            places = [i for i, item in enumerate(moved) if (item[0], item[2]) == (beside, column)]
            if places:
                entries.setdefault(target, []).append((row, plant.nx + first + places[0], text))
            else:
                unmoved.append((row, other_columns[beside].index(column), text))
        if unmoved:
            entries[matrix] = unmoved
    return replace(uncertain, entries={name: tuple(items) for name, items in entries.items()})


def _units(units: Mapping[str, str], of: Mapping[str, str]) -> dict[str, str]:
    return {state: units[signal] for state, signal in of.items() if signal in units}


def _of_equations(
    model: DAEModel,
    noises: Mapping[str, SensorNoise],
    offsets: Mapping[str, tuple[float, float]],
    loads: Mapping[str, float],
) -> DAEModel:
    if not isinstance(model.equations, Mapping) or not isinstance(model.outputs, Mapping):
        raise SpecError(
            "The model is given as Python functions: write its equations as texts, to which states can be added.",
            path="equations",
        )
    coloured = {name: noise for name, noise in noises.items() if noise.correlation}
    if not (coloured or offsets or loads):
        return model
    equations, outputs = dict(model.equations), dict(model.outputs)
    states, units, added = dict(model.states), dict(model.units), dict[str, str]()
    inputs, parameters = dict(model.inputs), dict(model.parameters)
    for name, noise in coloured.items():
        state = noise_state(name)
        equations[state] = f"der({state}) = -{state} / {noise.correlation!r}"
        added[state] = name
    for name in offsets:
        equations[offset_state(name)] = f"der({offset_state(name)}) = 0"
        added[offset_state(name)] = name
    for state, name in added.items():
        outputs[name] = f"({outputs[name]}) + {state}"
        states[state] = 0.0
    for name in loads:
        if name not in inputs and name not in parameters:
            index_of(name, (*inputs, *parameters), what="walks")
        states[name] = inputs.pop(name) if name in inputs else parameters.pop(name)
        equations[name] = f"der({name}) = 0"
    units |= _units(units, added)
    return model.replace(
        equations=equations, outputs=outputs, states=states, inputs=inputs, parameters=parameters, units=units
    )


def _intensities(
    plant: DAEModel,
    noises: Mapping[str, SensorNoise],
    offsets: Mapping[str, tuple[float, float]],
    loads: Mapping[str, float],
    process_noise: Mapping[str, float],
) -> dict[str, Any]:
    """Return arguments of `linearise`: noise in continuous time, and where what does not move by itself stands."""
    drives = dict(process_noise)
    for name, noise in noises.items():
        if noise.correlation:
            drives[noise_state(name)] = noise.deviation * float(np.sqrt(2.0 / noise.correlation))
    drives |= {offset_state(name): walk for name, (_, walk) in offsets.items()} | dict(loads)
    resting = {offset_state(name): 0.0 for name in offsets}
    resting |= {name: {**plant.inputs, **plant.parameters}[name] for name in loads}
    white = {name: noise.white for name, noise in noises.items()}
    return {"sensor_noise": white or None, "process_noise": drives or None, "given": resting}


def _options(
    model: DAEModel,
    noises: Mapping[str, SensorNoise],
    offsets: Mapping[str, tuple[float, float]],
    loads: Mapping[str, float],
    process_noise: Mapping[str, float],
    dt: float,
    integration: str,
) -> dict[str, Any]:
    """Return Q per step, R and the first covariance by name, as far as the noise is stated."""
    Q, first = {name: value**2 / dt for name, value in process_noise.items()}, {}
    for name, noise in noises.items():
        if noise.correlation:
            Q[noise_state(name)] = process_variance(noise.deviation**2, noise.correlation, dt, integration)
            first[noise_state(name)] = noise.deviation**2
    for name, (deviation, walk) in offsets.items():
        # What is added to an equation acts during the whole step.
        Q[offset_state(name)] = walk**2 / dt**2
        first[offset_state(name)] = deviation**2
    Q |= {name: walk**2 / dt for name, walk in loads.items()}
    options: dict[str, Any] = {"Q": Q} if Q else {}
    if set(noises) == set(model.output_names):
        options["R"] = {name: noise.white**2 for name, noise in noises.items()}
    return options | ({"initial_covariance": first} if first else {})

"""Functional mock-up units (FMI 2 and 3, model exchange), linearised at an operating point."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from obsynth.errors import PreconditionError, SpecError
from obsynth.files.inputs import path_of
from obsynth.numerics.arguments import arguments_checked, real_number
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.suggestions import suggestion
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.importing.fmu_description import require_linear_meaning
from obsynth.plants.importing.fmu_instance import Instance, opened_fmu
from obsynth.plants.importing.roles import plant_of

#: Newton steps towards an equilibrium.
_EQUILIBRIUM_STEPS = 50

#: A derivative counts as zero when it is this small next to the terms it is the sum of.
_AT_REST = 1e-8


@arguments_checked
def from_fmu(
    path: str | Path,
    *,
    at: Mapping[str, float] | None = None,
    equilibrium: bool = False,
    inputs: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
    **plant: Any,
) -> DescriptorSystem:
    """Return the plant of an FMU, linearised at an operating point.

    The FMU is linearised by its own directional derivatives if it provides them, otherwise by central differences,
    which are accurate to about eight digits if it is smooth.

    Parameters
    ----------
    path : path
        An FMU for model exchange, FMI 2.0 or 3.0.  Arrays have a signal for each entry, ``x[1]`` or ``A[1,2]``.
    at : mapping, optional
        Values of states, inputs and parameters at the operating point; those of the FMU by default.
    equilibrium : bool
        Search the states at which the FMU is at rest with these inputs, from those of ``at``.
    inputs, outputs : list of str, optional
        Which of the FMU's inputs and outputs are used; all real ones by default.
    **plant
        Roles, as lists of names: ``faults`` and ``disturbances`` (inputs that are faults, or unknown; the others are
        known inputs), ``actuator_faults`` (known inputs on which a fault acts: adds ``fault of <input>``) and
        ``sensor_faults`` (outputs with a bias: adds ``bias of <output>``).  Any other argument of `DescriptorSystem`.

    Returns
    -------
    DescriptorSystem
        Continuous, with names and units of the FMU's variables, and the operating point.

    Raises
    ------
    SpecError
        fmpy is not installed, the file is no such FMU, a name is unknown, its time is not in seconds, it has a clock,
        or, unless ``inputs`` and ``outputs`` say which to use, inputs that are no continuous real numbers or outputs
        that are no real numbers (Boolean, Integer, Enumeration and so on) or change at events alone.
    PreconditionError
        The operating point is no equilibrium (a linear model of deviations would not be one), or none is found.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.from_fmu("plant.fmu", equilibrium=True)  # doctest: +SKIP
    >>> plant.state_names  # doctest: +SKIP
    ('level', 'temperature')
    """
    for name, value in (at or {}).items():
        real_number(value, f"at[{name!r}]", "a finite number", path="at")
    with opened_fmu(path_of(path)) as instance:
        require_linear_meaning(instance.description, path_of(path), inputs, outputs)
        used = _used(instance.input_names, inputs, "inputs"), _used(instance.output_names, outputs, "outputs")
        for name in at or {}:
            if name not in instance.settable:
                close = suggestion(name, instance.settable)
                raise SpecError(f"at: the FMU has no real variable {name!r} that can be set.{close}", path="at")
        instance.begin(at or {})
        states = np.array(
            [
                dict(at or {}).get(name, value)
                for name, value in zip(instance.state_names, instance.states(), strict=True)
            ]
        )
        instance.set_states(states)
        if equilibrium:
            states = _equilibrium(instance, states)
        a, b, c, d = instance.jacobians(*used)
        _require_rest(instance, states, a, b, used[0])
        point = dict(zip(instance.state_names, states.tolist(), strict=True))
        point |= {name: instance.value(name) for names in used for name in names}
        units = {name: unit for name in point if (unit := instance.unit(name))}
    if not len(a):
        raise SpecError(f"{path} has no continuous states: there is nothing to observe.", path=str(path))
    labels = {"state_names": instance.state_names, "input_names": used[0], "output_names": used[1]}
    return plant_of({"A": a, "B": b, "C": c, "D": d}, plant, labels=labels, dt=0.0, point=point, units=units)


def _used(known: Sequence[str], picked: Sequence[str] | None, what: str) -> list[str]:
    if picked is None:
        return list(known)
    if isinstance(picked, str):
        raise SpecError(f"{what} is {picked!r}: give a list of names.", path=what)
    for name in picked:
        if name not in known:
            raise SpecError(f"{what}: the FMU has no {name!r} among its {what}.{suggestion(name, known)}", path=what)
    return list(picked)


def _equilibrium(instance: Instance, states: FloatArray) -> FloatArray:
    """Return the states at which the derivatives vanish, by Newton with halved steps."""
    rates = instance.derivatives()
    for _ in range(_EQUILIBRIUM_STEPS):
        a = instance.jacobians([], [])[0]
        if _is_rest(rates, a, states, np.zeros(len(states))):
            return states
        step = np.linalg.lstsq(a, -rates, rcond=None)[0]
        share = 1.0
        while True:
            instance.set_states(states + share * step)
            new_rates = instance.derivatives()
            if np.isfinite(new_rates).all() and np.linalg.norm(new_rates) < np.linalg.norm(rates):
                break
            share /= 2.0
            if share < _AT_REST:
                instance.set_states(states)
                return states
        states, rates = states + share * step, new_rates
    return states


def _is_rest(rates: FloatArray, a: FloatArray, states: FloatArray, known: FloatArray) -> bool:
    terms = np.abs(a) @ np.abs(states) + known + 1.0
    return bool((np.abs(rates) <= _AT_REST * terms).all())


def _require_rest(instance: Instance, states: FloatArray, a: FloatArray, b: FloatArray, inputs: Sequence[str]) -> None:
    rates = instance.derivatives()
    known = np.abs(b) @ np.abs([instance.value(name) for name in inputs]) if len(inputs) else np.zeros(len(states))
    if _is_rest(rates, a, states, known):
        return
    worst = int(np.argmax(np.abs(rates)))
    raise PreconditionError(
        f"The operating point is no equilibrium: {instance.state_names[worst]!r} changes by {rates[worst]:.6g} per "
        "second there, so deviations from it obey no linear model without a constant term. Give the point by at={...}, "
        "or let it be searched by equilibrium=True.",
        condition="equilibrium",
        signals=(instance.state_names[worst],),
    )

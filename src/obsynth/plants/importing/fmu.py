"""Functional mock-up units (FMI 2 and 3, model exchange), linearised at an operating point by their own derivatives,
or by central differences.
"""

from __future__ import annotations

import ctypes
import os
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np

from obsynth.errors import PreconditionError, SpecError
from obsynth.files.inputs import path_of
from obsynth.files.outputs import working_folder
from obsynth.numerics.arguments import arguments_checked, real_number
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.libraries import imported
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.importing.roles import plant_of
from obsynth.plants.signal_names import suggestion

_REAL = ("Real", "Float64")

#: By version of FMI: fmpy's class, and how it gets and sets real variables and updates the discrete states.
_SPELLED = {
    "2": ("FMU2Model", "getReal", "setReal", "newDiscreteStates"),
    "3": ("FMU3Model", "getFloat64", "setFloat64", "updateDiscreteStates"),
}

_GET, _SET, _UPDATE = 1, 2, 3

#: Spellings of the second, the unit of an FMU's independent variable where it states none.
_SECONDS = ("", "s", "sec", "second", "seconds")


#: A step of central differences, in sizes of the variable: it balances rounding with the third derivative.
STEP = float(np.cbrt(np.finfo(np.float64).eps))


#: Newton steps towards an equilibrium.
_EQUILIBRIUM_STEPS = 50

#: A derivative counts as zero when it is this small next to the terms it is the sum of.
_AT_REST = 1e-8


class Place(NamedTuple):
    """A number of an FMU: the reference of its variable, and which entry it is of an array, in C's order.
    Names that stand for the same number have the same place."""

    reference: int
    entry: int = 0


def _places(variable: Any) -> dict[str, Place]:
    """Return the numbers of a variable by name: ``x``, or ``x[1]`` and ``A[1,2]`` of arrays."""
    shape = tuple(getattr(variable, "shape", None) or ())
    if not shape:
        return {variable.name: Place(int(variable.valueReference))}
    entries = (",".join(str(i + 1) for i in entry) for entry in np.ndindex(*shape))
    return {
        f"{variable.name}[{entry}]": Place(int(variable.valueReference), index) for index, entry in enumerate(entries)
    }


class Instance:
    """States, values and Jacobians of an unpacked FMU at one point; ``differentiates``: it tells derivatives."""

    def __init__(self, description: Any, folder: str, *, differentiates: bool) -> None:
        self.description, self.differentiates = description, differentiates
        self.version = "2" if description.fmiVersion.startswith("2") else "3"
        variables = [v for v in description.modelVariables if v.type in _REAL]
        self.places = {name: place for v in variables for name, place in _places(v).items()}
        self.variables = {name: v for v in variables for name in _places(v)}
        self._sizes = {int(v.valueReference): len(_places(v)) for v in variables}
        self._nominals = {int(v.valueReference): abs(float(v.nominal or 1.0)) for v in variables}
        derivatives = [unknown.variable for unknown in description.derivatives]
        self.derivative_places = [place for v in derivatives for place in _places(v).values()]
        states = {name: place for v in derivatives for name, place in _places(v.derivative).items()}
        self.state_names, self.state_places = list(states), list(states.values())
        self.input_names = [name for name, v in self.variables.items() if v.causality == "input"]
        self.output_names = [name for name, v in self.variables.items() if v.causality == "output"]
        self.settable = [
            name
            for name, v in self.variables.items()
            if v.causality in ("input", "parameter") or name in self.state_names or v.initial in ("exact", "approx")
        ]
        kind: Any = getattr(import_module(f"fmpy.fmi{self.version[0]}"), _SPELLED[self.version][0])
        self.model = kind(
            guid=self.description.guid,
            unzipDirectory=folder,
            instanceName="linearised",
            modelIdentifier=self.description.modelExchange.modelIdentifier,
        )
        self.model.instantiate()

    def _call(self, position: int, *arguments: Any) -> Any:
        """Call what the version of FMI calls the function at a position of `_SPELLED`."""
        return getattr(self.model, _SPELLED[self.version][position])(*arguments)

    def begin(self, at: Mapping[str, float]) -> None:
        """Initialise at the given values and enter continuous time."""
        if self.version == "2":
            self.model.setupExperiment(startTime=0.0)
        self._set(at, ("parameter", "structuralParameter", "local", "output", "input"))
        self.model.enterInitializationMode()
        self._set(at, ("input",))
        self.model.exitInitializationMode()
        while self._call(_UPDATE)[0]:
            pass
        self.model.enterContinuousTimeMode()
        self._set(at, ("input",))

    def _whole(self, references: Sequence[int]) -> list[FloatArray]:
        """Return all numbers of variables."""
        if not references:
            return []
        sizes = [self._sizes[reference] for reference in references]
        more = () if self.version == "2" else (sum(sizes),)
        flat = np.array(self._call(_GET, list(references), *more), dtype=np.float64)
        return np.split(flat, np.cumsum(sizes)[:-1])

    def _get(self, places: Sequence[Place]) -> FloatArray:
        references = list(dict.fromkeys(at.reference for at in places))
        whole = dict(zip(references, self._whole(references), strict=True))
        return np.array([whole[at.reference][at.entry] for at in places], dtype=np.float64)

    def _put(self, at: Place, value: float) -> None:
        (whole,) = self._whole([at.reference]) if self._sizes[at.reference] > 1 else (np.zeros(1),)
        whole[at.entry] = value
        self._call(_SET, [at.reference], whole.tolist())

    def _set(self, at: Mapping[str, float], causalities: Sequence[str]) -> None:
        for name, value in at.items():
            if self.variables[name].causality in causalities:
                self._put(self.places[name], float(value))

    def _derivative(self, unknowns: Sequence[Place], known: Place) -> FloatArray:
        """Return what a change of one number does to others, as the FMU tells it."""
        references = list(dict.fromkeys(at.reference for at in unknowns))
        sizes = [self._sizes[reference] for reference in references]
        seed = np.zeros(self._sizes[known.reference])
        seed[known.entry] = 1.0
        more = () if self.version == "2" else (sum(sizes),)
        flat = np.array(self.model.getDirectionalDerivative(references, [known.reference], seed.tolist(), *more))
        begins = dict(zip(references, np.cumsum([0, *sizes[:-1]]).tolist(), strict=True))
        return np.array([flat[begins[at.reference] + at.entry] for at in unknowns])

    def _difference(self, unknowns: Sequence[Place], known: Place) -> FloatArray:
        """Return the same by central differences around the present point."""
        states = self.states()
        place = self.state_places.index(known) if known in self.state_places else None
        value = float(self._get([known])[0])
        step = STEP * max(abs(value), self._nominals[known.reference])
        found, at = [], []
        for side in (1.0, -1.0):
            moved = value + side * step
            if place is None:
                self._put(known, moved)
            else:
                self.set_states(np.concatenate([states[:place], [moved], states[place + 1 :]]))
            found.append(self._get(unknowns))
            at.append(moved)
        if place is None:
            self._put(known, value)
        else:
            self.set_states(states)
        return np.asarray((found[0] - found[1]) / (at[0] - at[1]))

    def states(self) -> FloatArray:
        """Return the continuous states ``(nx,)``."""
        return self._get(self.state_places)

    def set_states(self, states: FloatArray) -> None:
        """Set the continuous states ``(nx,)``."""
        values = (ctypes.c_double * len(states))(*states)
        if len(states):
            self.model.setContinuousStates(values, len(states))

    def derivatives(self) -> FloatArray:
        """Return the derivatives of the states ``(nx,)``."""
        return self._get(self.derivative_places)

    def value(self, name: str) -> float:
        """Return the value of a variable."""
        return float(self._get([self.places[name]])[0])

    def unit(self, name: str) -> str:
        """Return the unit of a variable, empty where it has none."""
        variable = self.variables[name]
        declared = variable.declaredType.unit if variable.declaredType is not None else None
        return variable.unit or declared or ""

    def jacobians(
        self, inputs: Sequence[str], outputs: Sequence[str]
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return A ``(nx, nx)``, B, C and D of the named inputs and outputs."""
        unknowns = [*self.derivative_places, *(self.places[name] for name in outputs)]
        knowns = [*self.state_places, *(self.places[name] for name in inputs)]
        nx = len(self.state_places)
        whole = np.zeros((len(unknowns), len(knowns)))
        told = self._derivative if self.differentiates else self._difference
        for column, known in enumerate(knowns):
            whole[:, column] = told(unknowns, known)
        # An output that is a state, or an input, is that: FMUs are only asked for outputs that they calculate.
        for row, unknown in enumerate(unknowns[nx:], nx):
            if unknown in knowns:
                whole[row] = [float(unknown == known) for known in knowns]
        # Of one that nothing seems to move, the FMU may tell no derivative although it has one.
        still = [row for row in range(nx, len(unknowns)) if not whole[row].any()]
        if self.differentiates and still:
            for column, known in enumerate(knowns):
                whole[still, column] = self._difference([unknowns[row] for row in still], known)
        return whole[:nx, :nx], whole[:nx, nx:], whole[nx:, :nx], whole[nx:, nx:]

    def end(self) -> None:
        """Free the instance."""
        self.model.terminate()
        self.model.freeInstance()


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
    with _instance(path_of(path)) as instance:
        _require_linear_meaning(instance.description, path_of(path), inputs, outputs)
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


@contextmanager
def _instance(path: Path) -> Iterator[Instance]:
    fmpy = imported("fmpy", extra="fmu")
    differentiates = _differentiates(fmpy, path)
    description = _read(lambda: fmpy.read_model_description(str(path)), path)
    before = os.getcwd()
    with working_folder() as folder:
        try:
            _read(lambda: fmpy.extract(str(path), str(folder)), path)
            instance = _read(lambda: Instance(description, str(folder), differentiates=differentiates), path)
            try:
                yield instance
            finally:
                instance.end()
        finally:
            # A library that cannot be loaded leaves the process in the folder of the FMU, which is then deleted.
            os.chdir(before)


def _read(make: Callable[[], Any], path: Path) -> Any:
    """Return what fmpy makes of a file; whatever it says of a damaged one becomes one error."""
    try:
        return make()
    except MemoryError:
        raise
    # Whatever readers of damaged zips and texts raise; fmpy raises bare ones for a library that cannot be loaded.
    except Exception as error:
        raise SpecError(f"{path} cannot be used as an FMU: {error}", path=str(path)) from error


def _description(path: Path) -> ElementTree.Element:
    """Return the description of the model in an FMU."""
    with zipfile.ZipFile(path) as archive, archive.open("modelDescription.xml") as stream:
        return ElementTree.parse(stream).getroot()


def _differentiates(fmpy: Any, path: Path) -> bool:
    """Return whether an FMU tells derivatives; raise `SpecError` unless it can be linearised on this machine."""
    if not path.is_file():
        raise SpecError(f"{path} does not exist.", path=str(path))
    root = _read(lambda: _description(path), path)
    version = root.get("fmiVersion", "")
    if version[:2] not in ("2.", "3."):
        raise SpecError(f"{path} is of FMI {version or '?'}: give an FMU of FMI 2 or 3.", path=str(path))
    exchange = root.find("ModelExchange")
    if exchange is None:
        raise SpecError(
            f"{path} is for co-simulation only: it does not give its states and derivatives. Export it "
            "for model exchange.",
            path=str(path),
        )
    platforms = _read(lambda: fmpy.supported_platforms(str(path)), path)
    if fmpy.platform not in platforms and fmpy.platform_tuple not in platforms:
        raise SpecError(
            f"{path} has no binary for this machine ({fmpy.platform_tuple}); it has {', '.join(platforms) or 'none'}.",
            path=str(path),
        )
    # fmpy does not read the attribute of FMI 3, which is spelled differently.
    named = "providesDirectionalDerivative" + ("" if version.startswith("2") else "s")
    return exchange.get(named) in ("true", "1")


def _require_linear_meaning(
    description: Any, path: Path, inputs: Sequence[str] | None, outputs: Sequence[str] | None
) -> None:
    """Refuse, by name, what a description states and a linear model in seconds of its real variables does not have:
    another unit of time, clocks, inputs that are no real numbers, outputs that change at events alone."""
    for variable in description.modelVariables:
        if variable.causality == "independent":
            unit = variable.unit or (variable.declaredType.unit if variable.declaredType is not None else None) or ""
            if unit not in _SECONDS:
                raise SpecError(
                    f"{path}: its independent variable {variable.name!r} is in {unit!r}, not in seconds: derivatives "
                    "would be per that unit. Export the FMU in seconds.",
                    path=str(path),
                )
        if variable.type == "Clock":
            raise SpecError(
                f"{path} has the clock {variable.name!r}: a part of it is sampled, and a linear model in continuous "
                "time would leave it out. Export the FMU without it.",
                path=str(path),
            )
    # An input that is left at its value may switch the equations; an output that changes at events alone has no row.
    strange = {
        "inputs": [v for v in description.modelVariables if v.causality == "input" and not _is_continuous(v)],
        "outputs": [
            v
            for v in description.modelVariables
            if v.causality == "output" and (v.type not in _REAL or v.variability == "discrete")
        ],
    }
    left = {"inputs": "keep the values that they start with", "outputs": "are left out"}
    for what, picked in (("inputs", inputs), ("outputs", outputs)):
        if picked is None and strange[what]:
            names = ", ".join(v.name if v.type in _REAL else f"{v.name} ({v.type})" for v in strange[what])
            raise SpecError(
                f"{path}: its {what} {names} are no continuous real numbers, and a linear model has no such signal: "
                f"name those that it shall have by {what}=[...]; the others {left[what]}.",
                path=what,
            )
        for variable in strange[what]:
            if picked is not None and variable.type not in _REAL and variable.name in picked:
                raise SpecError(
                    f"{path}: {variable.name!r} is of type {variable.type}, and a linear model has real numbers "
                    f"({' or '.join(_REAL)}) alone: leave it out of {what}.",
                    path=what,
                )


def _is_continuous(variable: Any) -> bool:
    return variable.type in _REAL and variable.variability in (None, "continuous")


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
            found = instance.derivatives()
            if np.isfinite(found).all() and np.linalg.norm(found) < np.linalg.norm(rates):
                break
            share /= 2.0
            if share < _AT_REST:
                instance.set_states(states)
                return states
        states, rates = states + share * step, found
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

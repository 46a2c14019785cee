"""A functional mock-up unit at one point: its states, its values, and its Jacobians by its own derivatives or by
differences.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from obsynth.files.outputs import working_folder
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.libraries import imported
from obsynth.plants.importing.fmu_description import REAL_TYPES, provides_derivatives, read_or_refuse

#: A step of central differences, in sizes of the variable: it balances rounding with the third derivative.
STEP = float(np.cbrt(np.finfo(np.float64).eps))


class _Names(NamedTuple):
    """fmpy's class of a version of FMI, and its methods that get and set real variables and update discrete states."""

    model: str
    get_reals: str
    set_reals: str
    update_discrete_states: str


#: By version of FMI.
_NAMES = {
    "2": _Names("FMU2Model", "getReal", "setReal", "newDiscreteStates"),
    "3": _Names("FMU3Model", "getFloat64", "setFloat64", "updateDiscreteStates"),
}


class Place(NamedTuple):
    """A number of an FMU: the reference of its variable, and which entry it is of an array, in C's order.
    Names that stand for the same number have the same place."""

    reference: int
    entry: int = 0


@contextmanager
def opened_fmu(path: Path) -> Iterator[Instance]:
    """Yield an instance of an FMU that is unpacked meanwhile; `SpecError` where it cannot be used."""
    fmpy = imported("fmpy", extra="fmu")
    differentiates = provides_derivatives(fmpy, path)
    description = read_or_refuse(lambda: fmpy.read_model_description(str(path)), path)
    before = os.getcwd()
    with working_folder() as folder:
        try:
            read_or_refuse(lambda: fmpy.extract(str(path), str(folder)), path)
            instance = read_or_refuse(lambda: Instance(description, str(folder), differentiates=differentiates), path)
            try:
                yield instance
            finally:
                instance.end()
        finally:
            # A library that cannot be loaded leaves the process in the folder of the FMU, which is then deleted.
            os.chdir(before)


class Instance:
    """States, values and Jacobians of an unpacked FMU at one point; ``differentiates``: it has derivatives."""

    def __init__(self, description: Any, folder: str, *, differentiates: bool) -> None:
        self.description, self.differentiates = description, differentiates
        self.version = "2" if description.fmiVersion.startswith("2") else "3"
        variables = [v for v in description.modelVariables if v.type in REAL_TYPES]
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
        self._names = _NAMES[self.version]
        kind: Any = getattr(import_module(f"fmpy.fmi{self.version[0]}"), self._names.model)
        self.model = kind(
            guid=self.description.guid,
            unzipDirectory=folder,
            instanceName="linearised",
            modelIdentifier=self.description.modelExchange.modelIdentifier,
        )
        self.model.instantiate()

    def _call(self, name: str, *arguments: Any) -> Any:
        return getattr(self.model, name)(*arguments)

    def begin(self, at: Mapping[str, float]) -> None:
        """Initialise at the given values and enter continuous time."""
        if self.version == "2":
            self.model.setupExperiment(startTime=0.0)
        self._set(at, ("parameter", "structuralParameter", "local", "output", "input"))
        self.model.enterInitializationMode()
        self._set(at, ("input",))
        self.model.exitInitializationMode()
        while self._call(self._names.update_discrete_states)[0]:
            pass
        self.model.enterContinuousTimeMode()
        self._set(at, ("input",))

    def _all_entries(self, references: Sequence[int]) -> list[FloatArray]:
        """Return all numbers of variables."""
        if not references:
            return []
        sizes = [self._sizes[reference] for reference in references]
        more = () if self.version == "2" else (sum(sizes),)
        flat = np.array(self._call(self._names.get_reals, list(references), *more), dtype=np.float64)
        return np.split(flat, np.cumsum(sizes)[:-1])

    def _get(self, places: Sequence[Place]) -> FloatArray:
        references = list(dict.fromkeys(at.reference for at in places))
        entries = dict(zip(references, self._all_entries(references), strict=True))
        return np.array([entries[at.reference][at.entry] for at in places], dtype=np.float64)

    def _put(self, at: Place, value: float) -> None:
        (entries,) = self._all_entries([at.reference]) if self._sizes[at.reference] > 1 else (np.zeros(1),)
        entries[at.entry] = value
        self._call(self._names.set_reals, [at.reference], entries.tolist())

    def _set(self, at: Mapping[str, float], causalities: Sequence[str]) -> None:
        for name, value in at.items():
            if self.variables[name].causality in causalities:
                self._put(self.places[name], float(value))

    def _derivative(self, unknowns: Sequence[Place], known: Place) -> FloatArray:
        """Return what a change of one number does to others, as the FMU returns it."""
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
        values, points = [], []
        for side in (1.0, -1.0):
            moved = value + side * step
            if place is None:
                self._put(known, moved)
            else:
                self.set_states(np.concatenate([states[:place], [moved], states[place + 1 :]]))
            values.append(self._get(unknowns))
            points.append(moved)
        if place is None:
            self._put(known, value)
        else:
            self.set_states(states)
        return np.asarray((values[0] - values[1]) / (points[0] - points[1]))

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
        jacobian = np.zeros((len(unknowns), len(knowns)))
        column_of = self._derivative if self.differentiates else self._difference
        for column, known in enumerate(knowns):
            jacobian[:, column] = column_of(unknowns, known)
        # An output that is a state, or an input, is that: FMUs are only asked for outputs that they calculate.
        for row, unknown in enumerate(unknowns[nx:], nx):
            if unknown in knowns:
                jacobian[row] = [float(unknown == known) for known in knowns]
        # Of one that nothing seems to move, the FMU may return no derivative although there is one.
        still = [row for row in range(nx, len(unknowns)) if not jacobian[row].any()]
        if self.differentiates and still:
            for column, known in enumerate(knowns):
                jacobian[still, column] = self._difference([unknowns[row] for row in still], known)
        return jacobian[:nx, :nx], jacobian[:nx, nx:], jacobian[nx:, :nx], jacobian[nx:, nx:]

    def end(self) -> None:
        """Free the instance."""
        self.model.terminate()
        self.model.freeInstance()


def _places(variable: Any) -> dict[str, Place]:
    """Return the numbers of a variable by name: ``x``, or ``x[1]`` and ``A[1,2]`` of arrays."""
    shape = tuple(getattr(variable, "shape", None) or ())
    if not shape:
        return {variable.name: Place(int(variable.valueReference))}
    entries = (",".join(str(i + 1) for i in entry) for entry in np.ndindex(*shape))
    return {
        f"{variable.name}[{entry}]": Place(int(variable.valueReference), index) for index, entry in enumerate(entries)
    }

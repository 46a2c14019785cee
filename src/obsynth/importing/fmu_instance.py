"""One instance of an FMU for model exchange, of either version of FMI, with the same few functions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib import import_module
from typing import Any

import numpy as np

from obsynth.numerics.arrays import FloatArray

_REAL = ("Real", "Float64")
#: By version of FMI: fmpy's class, and how it gets and sets real variables and updates the discrete states.
_SPELLED = {
    "2": ("FMU2Model", "getReal", "setReal", "newDiscreteStates"),
    "3": ("FMU3Model", "getFloat64", "setFloat64", "updateDiscreteStates"),
}
_GET, _SET, _UPDATE = 1, 2, 3


class Instance:
    """States, values and Jacobians of an unpacked FMU at one point."""

    def __init__(self, description: Any, folder: str) -> None:
        self.description = description
        self.version = "2" if description.fmiVersion.startswith("2") else "3"
        variables = [v for v in description.modelVariables if v.type in _REAL and not getattr(v, "dimensions", None)]
        self.variables = {v.name: v for v in variables}
        derivatives = [unknown.variable for unknown in description.derivatives]
        self.derivative_references = [v.valueReference for v in derivatives]
        self.state_references = [v.derivative.valueReference for v in derivatives]
        self.state_names = [v.derivative.name for v in derivatives]
        self.input_names = [v.name for v in variables if v.causality == "input"]
        self.output_names = [v.name for v in variables if v.causality == "output"]
        self.settable = [
            v.name for v in variables
            if v.causality in ("input", "parameter") or v.name in self.state_names or v.initial in ("exact", "approx")
        ]  # fmt: skip
        self.model = self._instantiate(folder)

    def _instantiate(self, folder: str) -> Any:
        kind = getattr(import_module(f"fmpy.fmi{self.version[0]}"), _SPELLED[self.version][0])
        model = kind(
            guid=self.description.guid, unzipDirectory=folder, instanceName="linearised",
            modelIdentifier=self.description.modelExchange.modelIdentifier,
        )  # fmt: skip
        model.instantiate()
        return model

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

    def _get(self, references: Sequence[int]) -> FloatArray:
        return np.array(self._call(_GET, list(references)), dtype=np.float64) if references else np.zeros(0)

    def _set(self, at: Mapping[str, float], causalities: Sequence[str]) -> None:
        for name, value in at.items():
            if self.variables[name].causality in causalities:
                self._call(_SET, [self.variables[name].valueReference], [float(value)])

    def _derivative(self, unknowns: Sequence[int], known: int) -> FloatArray:
        return np.array(self.model.getDirectionalDerivative(list(unknowns), [known], [1.0]))

    def states(self) -> FloatArray:
        """Return the continuous states ``(nx,)``."""
        return self._get(self.state_references)

    def set_states(self, states: FloatArray) -> None:
        """Set the continuous states ``(nx,)``."""
        import ctypes

        values = (ctypes.c_double * len(states))(*states)
        if len(states):
            self.model.setContinuousStates(values, len(states))

    def derivatives(self) -> FloatArray:
        """Return the derivatives of the states ``(nx,)``."""
        return self._get(self.derivative_references)

    def value(self, name: str) -> float:
        """Return the value of a variable."""
        return float(self._get([self.variables[name].valueReference])[0])

    def unit(self, name: str) -> str:
        """Return the unit of a variable, empty where it has none."""
        variable = self.variables[name]
        declared = variable.declaredType.unit if variable.declaredType is not None else None
        return variable.unit or declared or ""

    def jacobians(
        self, inputs: Sequence[str], outputs: Sequence[str]
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return A ``(nx, nx)``, B, C and D of the named inputs and outputs."""
        unknowns = [*self.derivative_references, *(self.variables[name].valueReference for name in outputs)]
        knowns = [*self.state_references, *(self.variables[name].valueReference for name in inputs)]
        nx = len(self.state_references)
        whole = np.zeros((len(unknowns), len(knowns)))
        for column, known in enumerate(knowns):
            whole[:, column] = self._derivative(unknowns, known)
        return whole[:nx, :nx], whole[:nx, nx:], whole[nx:, :nx], whole[nx:, nx:]

    def end(self) -> None:
        """Free the instance."""
        self.model.terminate()
        self.model.freeInstance()

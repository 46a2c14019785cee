"""One instance of an FMU for model exchange, of either version of FMI, with the same few functions."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from obsynth.numerics.arrays import FloatArray

_REAL = ("Real", "Float64")


class Instance(ABC):
    """States, values and Jacobians of an FMU at one point; subclasses know the version of FMI."""

    def __init__(self, fmpy: Any, description: Any, folder: str) -> None:
        self.fmpy, self.description = fmpy, description
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

    #: Causalities of what may be set before the initialisation.
    settable_first: tuple[str, ...] = ("parameter", "local", "output", "input")

    @abstractmethod
    def _kind(self) -> Any:
        """Return the class of fmpy for this version."""

    @abstractmethod
    def _reals(self, references: Sequence[int]) -> Sequence[float]:
        """Return values of real variables."""

    @abstractmethod
    def _set_reals(self, references: Sequence[int], values: Sequence[float]) -> None:
        """Set real variables."""

    @abstractmethod
    def _discrete_states_change(self) -> bool:
        """Update the discrete states once; return whether that has to be done again."""

    def _instantiate(self, folder: str) -> Any:
        model = self._kind()(
            guid=self.description.guid, unzipDirectory=folder, instanceName="linearised",
            modelIdentifier=self.description.modelExchange.modelIdentifier,
        )  # fmt: skip
        model.instantiate()
        return model

    def begin(self, at: Mapping[str, float]) -> None:
        """Initialise at the given values and enter continuous time."""
        self._set(at, self.settable_first)
        self.model.enterInitializationMode()
        self._set(at, ("input",))
        self.model.exitInitializationMode()
        while self._discrete_states_change():
            pass
        self.model.enterContinuousTimeMode()
        self._set(at, ("input",))

    def _get(self, references: Sequence[int]) -> FloatArray:
        return np.array(self._reals(list(references)), dtype=np.float64) if references else np.zeros(0)

    def _set(self, at: Mapping[str, float], causalities: Sequence[str]) -> None:
        for name, value in at.items():
            if self.variables[name].causality in causalities:
                self._set_reals([self.variables[name].valueReference], [float(value)])

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


class InstanceOfFMI2(Instance):
    """FMI 2.0."""

    def _kind(self) -> Any:
        from fmpy.fmi2 import FMU2Model

        return FMU2Model

    def begin(self, at: Mapping[str, float]) -> None:
        """Initialise at the given values and enter continuous time."""
        self.model.setupExperiment(startTime=0.0)
        super().begin(at)

    def _reals(self, references: Sequence[int]) -> Sequence[float]:
        return list(self.model.getReal(references))

    def _set_reals(self, references: Sequence[int], values: Sequence[float]) -> None:
        self.model.setReal(references, values)

    def _discrete_states_change(self) -> bool:
        return bool(self.model.newDiscreteStates()[0])


class InstanceOfFMI3(Instance):
    """FMI 3.0."""

    settable_first = ("parameter", "structuralParameter", "local", "output", "input")

    def _kind(self) -> Any:
        from fmpy.fmi3 import FMU3Model

        return FMU3Model

    def _reals(self, references: Sequence[int]) -> Sequence[float]:
        return list(self.model.getFloat64(references))

    def _set_reals(self, references: Sequence[int], values: Sequence[float]) -> None:
        self.model.setFloat64(references, values)

    def _discrete_states_change(self) -> bool:
        return bool(self.model.updateDiscreteStates()[0])


def instance_of(fmpy: Any, description: Any, folder: str) -> Instance:
    """Return an instance of an unpacked FMU."""
    kind = InstanceOfFMI2 if description.fmiVersion.startswith("2") else InstanceOfFMI3
    return kind(fmpy, description, folder)

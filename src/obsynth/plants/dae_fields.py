"""The fields of a nonlinear differential-algebraic plant: equations, outputs and signals, as texts or functions."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

#: Name -> text, or a function of lists of symbols that returns a list.
Equations = Mapping[str, str] | Callable[..., Sequence[Any]]


@dataclass(frozen=True, eq=False)
class DAEFields:
    """Equations, signals with nominal values, and names; `DAEModel` checks them."""

    equations: Equations
    outputs: Equations
    states: Mapping[str, float]
    inputs: Mapping[str, float]
    parameters: Mapping[str, float]
    constants: Mapping[str, float]
    definitions: Mapping[str, str]
    units: Mapping[str, str]
    storage: Callable[..., Sequence[Any]] | None
    equation_names: tuple[str, ...]
    output_names: tuple[str, ...]

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the states, in order."""
        return tuple(self.states)

    @property
    def input_names(self) -> tuple[str, ...]:
        """Names of the known inputs, in order."""
        return tuple(self.inputs)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the parameters, in order."""
        return tuple(self.parameters)

    @property
    def nx(self) -> int:
        """Number of states, and of equations."""
        return len(self.states)

    @property
    def nu(self) -> int:
        """Number of known inputs."""
        return len(self.inputs)

    @property
    def ny(self) -> int:
        """Number of outputs."""
        return len(self.output_names)

    @property
    def nq(self) -> int:
        """Number of parameters."""
        return len(self.parameters)

"""Unclear answers: the tolerance, a witness (a plant within it with the opposite answer), and what would decide."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from types import MappingProxyType
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from obsynth.numerics.arrays import FloatArray, remembered
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.exact_numbers import DECISIVE, ExactNumbers
from obsynth.plants.faults import Exosystem
from obsynth.proofs.exact_doubles import written_fraction

#: At most so many changes are listed.
LISTED_CHANGES = 4

#: Fractions of plants with more states are found each time: kept, they would take tens of megabytes.
MOST_KEPT_STATES = 200

#: Rational matrices, as arrays of fractions.
Rational: TypeAlias = NDArray[Any]


@dataclass(frozen=True)
class EntryChange:
    """One entry of a matrix and its change; ``Phi`` is that of the fault model, ``By`` and ``Dy`` the observer's."""

    matrix: str
    row: int
    column: int
    before: Fraction
    after: Fraction

    def described(self, plant: DescriptorSystem, *, parameters: bool = False) -> str:
        """Return the change in words; with ``parameters`` Bf and Df are called Phi and Psi."""
        sides = {
            "E": ("equation", "state"),
            "A": ("equation", "state"),
            "C": ("output", "state"),
            "Bf": ("equation", "fault"),
            "Df": ("output", "fault"),
            "Bd": ("equation", "unknown input"),
            "Dd": ("output", "unknown input"),
        }.get(self.matrix)
        names = {
            "state": plant.state_names,
            "output": plant.output_names,
            "fault": plant.fault_names,
            "unknown input": plant.disturbance_names,
        }
        called = {"Bf": "Phi", "Df": "Psi"}.get(self.matrix, self.matrix) if parameters else self.matrix
        place = f"entry ({self.row + 1}, {self.column + 1}) of {called}"
        if sides is None:
            place += " of the fault model" if self.matrix == "Phi" else " of the observer"
        else:
            signals = [
                f"{kind} {names[kind][number]!r}" if kind in names else f"{kind} {number + 1}"
                for kind, number in zip(sides, (self.row, self.column), strict=True)
            ]
            place += f" ({', '.join(signals)})"
            place = place.replace("fault ", "parameter ") if parameters else place
        return f"{place} from {_number(self.before)} to {_new_number(self.before, self.after)}"


@dataclass(frozen=True)
class Witness:
    """Changes of entries after which the answer is another one."""

    changes: tuple[EntryChange, ...]
    size: float  # of the largest change, beside scaled entries
    point: complex | None = None  # where the changed pencil loses rank; ``None`` for a matrix without s

    def described(self, plant: DescriptorSystem, *, parameters: bool = False) -> str:
        """Return the changes in words."""
        texts = [change.described(plant, parameters=parameters) for change in self.changes[:LISTED_CHANGES]]
        more = len(self.changes) - len(texts)
        return "; ".join(texts) + (f"; and {more} more like these" if more > 0 else "")

    def plant(self, plant: DescriptorSystem) -> DescriptorSystem:
        """Return the changed plant: its exact numbers decide, whatever its doubles are rounded to."""
        exact = {name: matrix.copy() for name, matrix in rational_matrices(plant).items()}
        for change in self.changes:
            if change.matrix in exact:
                exact[change.matrix][change.row, change.column] = change.after
        doubles = {name: nearest(matrix) for name, matrix in exact.items()}
        rows = {name: tuple(map(tuple, matrix.tolist())) for name, matrix in exact.items()}
        return plant.replace(**doubles, exact=ExactNumbers(rows))

    def model(self, model: Exosystem) -> Exosystem:
        """Return the changed fault model, rounded."""
        phi = np.array(model.Phi)
        for change in self.changes:
            if change.matrix == "Phi":
                phi[change.row, change.column] = float(change.after)
        return replace(model, Phi=phi)


@dataclass(frozen=True)
class Unclear:
    """Why rounding of the data could change an answer."""

    tolerance: float  # what the data are known to, relative to the largest scaled entry
    witness: Witness | None  # a plant within it that has the other answer, where one was found
    other: str  # what that plant is, in words
    decider: str  # what would decide it
    parameters: bool = False  # whether what stands as faults are parameters, in Phi and Psi

    def described(self, plant: DescriptorSystem) -> str:
        """Return all of it in words."""
        if self.witness is None:
            witness = f"{self.other}; no single entries were found that do it."
        elif not self.witness.changes:
            witness = f"the {_plant_in_words(plant)} as it is rounded to double precision {self.other}."
        else:
            change = self.witness.described(plant, parameters=self.parameters)
            witness = f"the {_plant_in_words(plant)} with {change} {self.other}."
        return f"Tolerance: {self.tolerance:.1g} of the largest scaled entry. Witness: {witness} {self.decider}"


def _plant_in_words(plant: DescriptorSystem) -> str:
    exact = plant.exact
    if exact is None:
        return "plant"
    if exact.sample_time is not None:
        return "sampled plant"
    return "plant without its algebraic states" if plant.nx < exact.states else "plant"


def rational_matrices(plant: DescriptorSystem) -> Mapping[str, Rational]:
    """Return the decisive matrices of a plant in its own coordinates, as written, or as they were rounded."""
    return _kept_matrices(plant) if plant.nx <= MOST_KEPT_STATES else _rational_matrices(plant)


@remembered
def _kept_matrices(plant: DescriptorSystem) -> Mapping[str, Rational]:
    matrices = _rational_matrices(plant)
    for matrix in matrices.values():
        matrix.setflags(write=False)
    return MappingProxyType(matrices)


def _rational_matrices(plant: DescriptorSystem) -> dict[str, Rational]:
    exact = plant.exact
    if exact is not None and exact.sample_time is None and exact.own:
        return {name: as_array(exact.matrices[name], getattr(plant, name).shape) for name in DECISIVE}
    return {name: rational(getattr(plant, name)) for name in DECISIVE}


def rational(matrix: FloatArray) -> Rational:
    """Return a matrix of doubles as the fractions that were written."""
    values = [written_fraction(value) for value in np.ravel(matrix).tolist()]
    return as_array([values], matrix.shape)


def as_array(rows: Sequence[Sequence[Fraction]], shape: tuple[int, ...]) -> Rational:
    """Return fractions, row by row, as an array of a shape."""
    array = np.empty(int(np.prod(shape)), dtype=object)
    array[:] = [value for row in rows for value in row]
    return array.reshape(shape)


def nearest(matrix: Rational) -> FloatArray:
    """Return fractions as the nearest doubles."""
    # As `float` of a fraction has it, in a tenth of its time; most entries are zero.
    values = [value.numerator / value.denominator if value else 0.0 for value in matrix.ravel().tolist()]
    return np.array(values, dtype=np.float64).reshape(matrix.shape)


def _number(value: Fraction) -> str:
    return repr(float(value)) if float(value) != int(float(value)) else str(int(float(value)))


def _new_number(before: Fraction, after: Fraction) -> str:
    """Return the new number, as a difference where it is nearer to the old one than doubles tell."""
    if abs(after - before) * 10**12 > abs(before):
        return _number(after)
    change = float(after - before)
    return f"{_number(before)} {'-' if change < 0.0 else '+'} {abs(change):.4g}"

"""Pencils whose entries are traced to entries of the plant, and the nearest plants for which they lose rank.

For v with ``M v`` small, rounded to a few digits, one entry (two if v is complex) in each row of M is changed in
rational arithmetic so that ``M v = 0``: the changed matrix loses rank exactly, and the changed entries are named.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from math import isqrt, lcm

import numpy as np

from obsynth.analysis.existence.witnesses import (
    EntryChange,
    Rational,
    Witness,
    as_array,
    nearest,
    rational,
    rational_matrices,
)
from obsynth.numerics.arrays import ComplexArray, FloatArray
from obsynth.numerics.ranks import RANK_TOLERANCE
from obsynth.numerics.scaling import equilibrate_pencil
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.faults import Exosystem
from obsynth.plants.plant_units import PlantUnits, sized_plant
from obsynth.proofs.exact_doubles import written_fraction

#: Digits of the direction of a witness, tried in turn until the plant is within the tolerance.
WITNESS_DIGITS = (1, 2, 3, 5, 8, 11, 14, 17)

#: Preference for changing a nonzero entry, and an entry of E, whose ones are structure rather than data.
KNOWN_ENTRY, STRUCTURE = 8.0, 1e-2

#: One block of a block matrix: the name of a matrix of the plant, or none.
Cell = str | None


@dataclass(frozen=True, eq=False)
class NamedPencil:
    """A pencil ``A - s E (m, n)``, and for each entry of A the entry of the plant from which it comes."""

    A: Rational
    E: Rational
    owners: Rational  # ``None`` for no entry
    rows: FloatArray  # powers of two, as columns, in which entries are of like size
    columns: FloatArray
    terms: FloatArray | None = None  # sizes of what the entries of A are sums of, where known

    @property
    def transposed(self) -> NamedPencil:
        """The same with rows and columns exchanged."""
        terms = None if self.terms is None else self.terms.T
        return NamedPencil(self.A.T, self.E.T, self.owners.T, self.columns, self.rows, terms)

    @cached_property
    def _doubles(self) -> tuple[FloatArray, FloatArray]:
        """A and E, rounded."""
        return nearest(self.A), nearest(self.E)

    @cached_property
    def _whole(self) -> list[tuple[Rational, list[int]]]:
        """A and E in whole numbers, each row over its own denominator."""
        integer_rows = []
        for matrix in (self.A, self.E):
            rows = [_whole_numbers(row) for row in matrix.tolist()]
            integer_rows.append(
                (_objects([row for row, _ in rows], matrix.shape), [denominator for _, denominator in rows])
            )
        return integer_rows

    @cached_property
    def _weights(self) -> FloatArray:
        """Preference for changing each entry ``(m, n)``; zero for entries that are no data."""
        names = [0.0 if owner is None else STRUCTURE if owner[0] == "E" else 1.0 for owner in self.owners.ravel()]
        known: FloatArray = np.where(self.A != 0, KNOWN_ENTRY, 1.0) * np.reshape(names, self.A.shape)
        return known

    def with_rows(self, rows: list[int]) -> NamedPencil:
        """Return the same with some of its rows."""
        terms = None if self.terms is None else self.terms[rows]
        return NamedPencil(self.A[rows], self.E[rows], self.owners[rows], self.rows[rows], self.columns, terms)

    def witness(
        self, tolerance: float, point: complex | None = None, *, dt: float | None = None, last: bool = False
    ) -> Witness | None:
        """Return a plant whose pencil loses column rank at a point: within the tolerance, or the nearest one found.

        With ``dt`` the point may move, but not become stable.  ``last``: the last column shall depend on the others.
        """
        at = 0j if point is None else complex(point)
        a, e = self._doubles
        matrix = a - (at if at.imag else at.real) * e
        # Sizes of the terms, not of their differences: near a mode these cancel.
        sizes = (np.abs(a) if self.terms is None else self.terms) + abs(at) * np.abs(e)
        scaled = self.rows[:, None] * sizes * self.columns
        pencil = equilibrate_pencil(np.zeros_like(scaled), scaled)
        rows, columns = self.rows * pencil.rows, self.columns * pencil.columns
        if not matrix.size or not np.all(np.isfinite(rows[:, None] * matrix * columns)):
            return None
        balanced = rows[:, None] * matrix * columns
        if last:
            vector = np.append(-np.linalg.lstsq(balanced[:, :-1], balanced[:, -1], rcond=RANK_TOLERANCE)[0], 1.0)
        else:
            vector = np.linalg.svd(balanced)[2][-1].conj()
        vector = vector / vector[int(np.argmax(np.abs(vector)))]
        best: Witness | None = None
        for digits in WITNESS_DIGITS:
            place = _placed(at, digits, dt)
            changes, size = self._changes(_rounded(vector, digits), place, rows, columns)
            if best is None or size < best.size:
                best = Witness(changes, size, None if point is None else complex(float(place[0]), float(place[1])))
            if best.size <= tolerance:
                break
        return best if best is not None and np.isfinite(best.size) else None

    def last_share(self, point: complex) -> float:
        """Return the distance of the last column from the span of the others, relative to the terms of that column."""
        a, e = self._doubles
        matrix = a - (point if point.imag else point.real) * e
        scaled = self.rows[:, None] * matrix * self.columns
        sizes = np.abs(scaled) if self.terms is None else self.rows[:, None] * self.terms * self.columns
        left_vectors, values, _ = np.linalg.svd(scaled[:, :-1], full_matrices=False)
        basis = left_vectors[:, values > RANK_TOLERANCE * np.max(values, initial=0.0)]
        remainder = scaled[:, -1] - basis @ (basis.conj().T @ scaled[:, -1])
        size = float(np.linalg.norm(sizes[:, -1]))
        return float(np.linalg.norm(remainder)) / size if size > 0.0 else 0.0

    def _changes(
        self, vector: tuple[Rational, Rational], point: tuple[Fraction, Fraction], rows: FloatArray, columns: FloatArray
    ) -> tuple[tuple[EntryChange, ...], float]:
        """Return the changes that make a scaled vector a null vector, and their size; none where that is impossible."""
        scale = rational(columns)
        real, imaginary = vector[0] * scale, vector[1] * scale
        # (A - s E) v, s = a + b j.
        (of_a, of_e) = ([_product(*matrix, part) for part in (real, imaginary)] for matrix in self._whole)
        residual = (
            of_a[0] - point[0] * of_e[0] + point[1] * of_e[1],
            of_a[1] - point[0] * of_e[1] - point[1] * of_e[0],
        )
        weights = np.asarray(vector[0] + 0.0, dtype=float) + 1j * np.asarray(vector[1] + 0.0, dtype=float)
        changes, size = list[EntryChange](), 0.0
        for i in range(len(self.A)):
            if not residual[0][i] and not residual[1][i]:
                continue
            solved = self._row_changes(i, (residual[0][i], residual[1][i]), (real, imaginary), weights)
            if solved is None:
                return (), np.inf
            for j, delta in solved:
                name, row, column = self.owners[i, j]
                changes.append(EntryChange(name, row, column, self.A[i, j], self.A[i, j] + delta))
                size = max(size, float(rows[i] * columns[j] * abs(float(delta))))
        return tuple(change for change in changes if change.before != change.after), size

    def _row_changes(
        self, i: int, residual: tuple[Fraction, Fraction], vector: tuple[Rational, Rational], weights: ComplexArray
    ) -> list[tuple[int, Fraction]] | None:
        """Return changes of one row or two entries of it that make its product with the vector zero."""
        known = self._weights[i]
        scores = known * np.abs(weights)
        j = int(np.argmax(scores))
        if scores[j] == 0.0:
            return None
        real, imaginary = vector
        if residual[0] * imaginary[j] == residual[1] * real[j]:
            part = (residual[0], real[j]) if real[j] else (residual[1], imaginary[j])
            return [(j, -part[0] / part[1])]
        areas = known * np.abs(np.imag(np.conj(weights[j]) * weights))
        k = int(np.argmax(areas))
        area = real[j] * imaginary[k] - real[k] * imaginary[j]
        if not area:
            return None
        return [
            (j, -(residual[0] * imaginary[k] - residual[1] * real[k]) / area),
            (k, -(residual[1] * real[j] - residual[0] * imaginary[j]) / area),
        ]


def _product(numerators: Rational, denominators: list[int], vector: Rational) -> Rational:
    """Return the product of whole rows over their denominators with a rational vector ``(n,)``."""
    integers, common = _whole_numbers(vector.tolist())
    products = zip(numerators @ _objects(integers, vector.shape), denominators, strict=True)
    return as_array([[Fraction(value, common * own) for value, own in products]], (len(denominators),))


def _objects(numbers: Sequence[object], shape: tuple[int, ...]) -> Rational:
    return np.array(numbers, dtype=object).reshape(shape)


def _whole_numbers(values: Sequence[Fraction]) -> tuple[list[int], int]:
    """Return rational numbers as whole ones over one denominator."""
    common = lcm(*(value.denominator for value in values))
    return [value.numerator * (common // value.denominator) for value in values], common


def _rounded(vector: ComplexArray | FloatArray, digits: int) -> tuple[Rational, Rational]:
    parts = []
    for part in (np.real(vector), np.imag(vector)):
        values = [Fraction(round(Fraction(value) * 10**digits), 10**digits) for value in part.tolist()]
        parts.append(as_array([values], (len(values),)))
    return parts[0], parts[1]


def _placed(point: complex, digits: int, dt: float | None) -> tuple[Fraction, Fraction]:
    """Return a point rounded to ``digits``, not inside the stability boundary; without ``dt`` to almost all digits."""
    if dt is None and digits < WITNESS_DIGITS[-2]:
        # The point may be a computed eigenvalue of a matrix of short numbers: drop its rounding.
        return Fraction(f"{point.real:.13g}"), Fraction(f"{point.imag:.13g}")
    if dt is None:
        return written_fraction(point.real), written_fraction(point.imag)
    real, imaginary = (Fraction(f"{part:.{digits}e}") for part in (point.real, point.imag))
    if dt == 0.0:
        return max(real, Fraction(0)), imaginary
    if not imaginary:
        return (real if abs(real) >= 1 else Fraction(1 if real >= 0 else -1)), imaginary
    square = real * real + imaginary * imaginary
    if square < 1:
        # The least stretch of so many digits that reaches the circle.
        stretch = Fraction(isqrt(int(10 ** (2 * digits) / square)) + 1, 10**digits)
        real, imaginary = stretch * real, stretch * imaginary
    return real, imaginary


def named_pencil(
    plant: DescriptorSystem,
    units: PlantUnits,
    layout: Sequence[Sequence[Cell]],
    *,
    taken_columns: Mapping[str, Sequence[int]] | None = None,
) -> NamedPencil:
    """Return a block matrix of the plant's matrices by name, such as ``[["A", "Bf"], ["C", "Df"]]``, minus s times E.
    ``taken_columns``: those of a matrix, all by default.  E by name stands for itself, not for s."""
    exact, chosen, sized = rational_matrices(plant), taken_columns or {}, sized_plant(plant)
    scale = {"x": units.states, "f": units.faults, "d": units.disturbances}
    kinds = {"E": "x", "A": "x", "C": "x", "Bf": "f", "Df": "f", "Bd": "d", "Dd": "d"}
    widths, columns = list[list[int]](), list[FloatArray]()
    for position in range(len(layout[0])):
        name = next(row[position] for row in layout if row[position] is not None)
        every = range(exact[str(name)].shape[1])
        picked = list(chosen.get(str(name), every))
        widths.append(picked)
        columns.append(scale[kinds[str(name)]][picked])
    blocks: list[list[Rational]] = []
    moving: list[list[Rational]] = []
    owners: list[list[Rational]] = []
    terms: list[list[FloatArray]] = []
    rows: list[FloatArray] = []
    for row in layout:
        is_output = next(name for name in row if name is not None) in ("C", "Df", "Dd")
        rows.append(units.outputs if is_output else units.equations)
        height = plant.ny if is_output else plant.nx
        blocks.append([])
        moving.append([])
        owners.append([])
        terms.append([])
        for name, picked in zip(row, widths, strict=True):
            nothing = as_array([[Fraction(0)] * (height * len(picked))], (height, len(picked)))
            blocks[-1].append(nothing if name is None else exact[name][:, picked])
            moving[-1].append(exact["E"] if name == "A" else nothing)
            owners[-1].append(_owners(name, height, picked))
            own = None if sized is None or name is None else np.abs(getattr(sized, name)[:, picked])
            terms[-1].append(nearest(nothing) if own is None else own)
    return NamedPencil(
        np.block(blocks),
        np.block(moving),
        np.block(owners),
        np.concatenate(rows),
        np.concatenate(columns),
        None if sized is None else np.block(terms),
    )


def named_augmented(
    plant: DescriptorSystem, model: Exosystem, units: PlantUnits, *, independent: Sequence[int], of_the_model: bool
) -> NamedPencil:
    """Return ``[A - s E, Bf Cw, Bd; 0, Phi - s, 0; C, Df Cw, Dd]`` with the ``independent`` disturbances.

    Entries of Phi are named ``of_the_model`` only."""
    layout = [["A", "Bf", "Bd"], ["C", "Df", "Dd"]]
    pencil = named_pencil(plant, units, layout, taken_columns={"Bd": independent, "Dd": independent})
    nx, nf, count = plant.nx, plant.nf, model.order
    cw, phi = rational(model.Cw), rational(model.Phi)
    states, faults, disturbances = np.split(np.arange(pencil.A.shape[1]), [nx, nx + nf])
    order = (np.arange(nx), np.arange(nx, nx + plant.ny))
    width = nx + count + len(disturbances)
    middle = as_array([[Fraction(0)] * (count * width)], (count, width))
    slope, owners = middle.copy(), np.empty((count, width), dtype=object)
    middle[:, nx : nx + count] = phi
    slope[:, nx : nx + count] = rational(np.eye(count))
    if of_the_model:
        owners[:, nx : nx + count] = _owners("Phi", count, range(count))
    # An entry of Bf or Df can be changed through a state of the model that is a fault by itself.
    alone = [np.flatnonzero(cw[:, j] != 0) for j in range(count)]
    single = [int(rows[0]) if len(rows) == 1 and cw[rows[0], j] == 1 else -1 for j, rows in enumerate(alone)]

    def stacked(matrix: Rational, through: Rational, part: Rational) -> Rational:
        top, bottom = (
            np.hstack([matrix[rows][:, states], through[rows], matrix[rows][:, disturbances]]) for rows in order
        )
        return np.vstack([top, part, bottom])

    named = np.empty((len(pencil.A), count), dtype=object)
    for j, fault in enumerate(single):
        if fault >= 0:
            named[:, j] = pencil.owners[:, faults[fault]]
    through = pencil.A[:, faults] @ cw
    terms = None
    if pencil.terms is not None:
        between = pencil.terms[:, faults] @ np.abs(model.Cw)
        terms = stacked(pencil.terms, between, np.abs(nearest(middle)))
    columns = np.concatenate([pencil.columns[states], units.model, pencil.columns[disturbances]])
    return NamedPencil(
        stacked(pencil.A, through, middle),
        stacked(pencil.E, 0 * through, slope),
        stacked(pencil.owners, named, owners),
        np.concatenate([pencil.rows[:nx], 1.0 / units.model, pencil.rows[nx:]]),
        columns,
        terms,
    )


def _owners(name: Cell, height: int, columns: Sequence[int]) -> Rational:
    owners = np.empty((height, len(columns)), dtype=object)
    if name is not None:
        for i in range(height):
            for place, j in enumerate(columns):
                owners[i, place] = (name, i, j)
    return owners

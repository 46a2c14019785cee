"""The uncertainty of a linear plant: constants in its matrices, as written, and the transformations since."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from obsynth.errors import PreconditionError, SpecError
from obsynth.numerics.arguments import require_kind
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.expressions import Expression, parse_expression
from obsynth.plants.constants import ConstantsBox, constants_box

if TYPE_CHECKING:
    from obsynth.proofs.affine import AffineMatrix


#: Matrices that may hold constants.
UNCERTAIN_MATRICES = ("E", "A", "B", "C", "D", "Bf", "Df", "Bd", "Dd")

#: Transformations that carry tolerances along.
ELIMINATED, SAMPLED = "eliminate", "sample"

#: A stored number and the value of its expression may differ by this share: matrices in files have few digits.
SAME_EXPRESSION_VALUE = 1e-6

#: Rounding of a middle and of half a width, relative to the ends of a range.
HALVING = 2.0**-51

#: Row, column and text of an entry.
Entry = tuple[int, int, str]


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Constants with tolerances in the matrices of a plant.

    Parameters
    ----------
    box : ConstantsBox
        The constants.
    entries : mapping of str to sequence
        By matrix: ``(row, column, text)`` of each entry that is an expression, counted from 0.  A text that is the name
        of a constant stands for it, whatever it looks like.
    written : mapping, optional
        Matrices of the plant as written, if what holds this was made from it by ``steps``.
    steps : sequence, optional
        ``(kind, seconds)``, kinds ``eliminate`` and ``sample``.
    shift : str, optional
        For a linear model of a nonlinear plant: the input that is one in every row and carries how the equilibrium
        moves with the constants; empty where it does not move, None for a plant that is linear.
    lost : str, optional
        What was done to the plant that its tolerances could not follow: bounds over the box are refused then.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.uncertain_system(
    ...     {"A": [["a"]], "C": [[1]], "Bf": [[1]], "dt": 1.0}, {"a": {"nominal": 0.5, "tolerance": "5 %"}}
    ... )
    >>> dict(plant.uncertainty.entries), plant.uncertainty.box.names
    ({'A': ((0, 0, 'a'),)}, ('a',))
    """

    box: ConstantsBox
    entries: Mapping[str, tuple[Entry, ...]]
    written: Mapping[str, Any] | None = None
    steps: tuple[tuple[str, float], ...] = ()
    shift: str | None = None
    lost: str = ""
    _parsed: dict[str, Expression] = field(default_factory=dict, repr=False, init=False)

    def __post_init__(self) -> None:
        checked: dict[str, tuple[Entry, ...]] = {}
        for matrix, entries in self.entries.items():
            if matrix not in UNCERTAIN_MATRICES:
                raise SpecError(f"{matrix!r} holds no constants: {', '.join(UNCERTAIN_MATRICES)} may.", path=matrix)
            checked[matrix] = tuple((int(row), int(column), str(text)) for row, column, text in entries)
            for row, column, text in checked[matrix]:
                self._check(text, f"{matrix}, row {row + 1}, column {column + 1}", matrix)
        object.__setattr__(self, "entries", MappingProxyType(checked))
        object.__setattr__(self, "steps", tuple((str(kind), float(size)) for kind, size in self.steps))
        object.__setattr__(self, "written", None if self.written is None else MappingProxyType(dict(self.written)))

    def _check(self, text: str, place: str, matrix: str) -> None:
        known = self.box.constants
        if text in known:
            return
        expression = self._parsed.setdefault(text, parse_expression(text))
        unknown = sorted(expression.names - known.keys())
        if unknown:
            raise SpecError(
                f"{place}: {text!r} has the unknown name {unknown[0]!r}; the constants are "
                f"{', '.join(known) or 'none'}.",
                path=matrix,
            )

    @cached_property
    def used(self) -> frozenset[str]:
        """Names of the constants that stand in some entry."""
        texts = {text for entries in self.entries.values() for *_, text in entries}
        direct = {text for text in texts if text in self.box.constants}
        return frozenset(direct.union(*(self._parsed[text].names for text in texts - direct)))

    @property
    def not_covered(self) -> str:
        """What statements about the box leave out: empty for a plant that is linear."""
        return "" if self.shift is None else "what is not linear in the plant is not covered: this is its linear model"

    def left_behind(self, why: str) -> Uncertainty | None:
        """Return what is uncertain in a plant that was changed in a way that constants and entries do not tell:
        `None` where no constant has a tolerance, as the plant is still an exact model.

        Parameters
        ----------
        why : str
            What was done.
        """
        return replace(self, lost=self.lost or why) if self.box.names else None

    def with_box(self, box: ConstantsBox) -> Uncertainty:
        """Return the same entries with other tolerances.

        Parameters
        ----------
        box : ConstantsBox
            Of the same constants.
        """
        return replace(self, box=box)

    def then(self, matrices: Mapping[str, FloatArray], kind: str, size: float = 0.0) -> Uncertainty:
        """Return what is uncertain in a plant made from this one.

        Parameters
        ----------
        matrices : mapping of str to FloatArray
            Of the plant before, which is kept if it is the one as written.
        kind : str
            ``eliminate`` or ``sample``.
        size : float, optional
            Seconds, for ``sample``.
        """
        written = {name: matrices[name] for name in UNCERTAIN_MATRICES} if self.written is None else self.written
        return replace(self, written=written, steps=(*self.steps, (kind, size)))

    def value(self, text: str, values: Mapping[str, float]) -> float:
        """Return the value of an entry for values of the constants.

        Parameters
        ----------
        text : str
            The entry.
        values : mapping
            Of all constants.
        """
        return float(values[text]) if text in values else float(self._parsed[text](values))

    def parsed(self, text: str) -> Expression:
        """Return the expression of an entry that is not a name alone.

        Parameters
        ----------
        text : str
            The entry.
        """
        return self._parsed[text]

    def filled(self, matrices: Mapping[str, FloatArray], values: Mapping[str, float]) -> dict[str, FloatArray]:
        """Return matrices with every entry at values of the constants.

        Parameters
        ----------
        matrices : mapping of str to FloatArray
            As written.
        values : mapping
            Of all constants.
        """
        filled = {name: np.array(matrices[name], dtype=np.float64) for name in UNCERTAIN_MATRICES}
        for name, entries in self.entries.items():
            for row, column, text in entries:
                filled[name][row, column] = self.value(text, values)
        return filled

    def affine(self, matrices: Mapping[str, FloatArray], box: ConstantsBox) -> dict[str, AffineMatrix]:
        """Return the matrices over a box of the constants.

        Parameters
        ----------
        matrices : mapping of str to FloatArray
            As written.
        box : ConstantsBox
            Its uncertain constants are the unknowns, in order.

        Raises
        ------
        PreconditionError
            An expression is not bounded on the box.
        """
        from obsynth.proofs.affine import AffineMatrix
        from obsynth.proofs.affine_numbers import AffineNumber, affine_translation

        count, translation = len(box.names), affine_translation(len(box.names))
        zero, numbers = AffineNumber(0.0, np.zeros(count), 0.0), dict[str, AffineNumber]()
        for name, item in box.constants.items():
            parts = item.half * np.array([unknown == name for unknown in box.names], dtype=np.float64)
            # The middle and the half are rounded.
            slack = 0.0 if item.certain else HALVING * max(abs(item.low), abs(item.high))
            numbers[name] = AffineNumber(item.nominal if item.certain else item.middle, parts, slack)
        known = dict(numbers)
        families = {name: AffineMatrix.exact(np.array(matrices[name]), count) for name in UNCERTAIN_MATRICES}
        for name, entries in self.entries.items():
            at = families[name]
            for row, column, text in entries:
                if text not in known:
                    known[text] = zero.lifted(self._parsed[text].translated(numbers, translation))
                value, place = known[text], (row, column)
                at.center[place], at.parts[:, row, column], at.radius[place] = value.center, value.parts, value.radius
        return families

    def as_dict(self) -> dict[str, Any]:
        """Return plain data, as `uncertainty_of` reads it."""
        entries = {name: [list(item) for item in items] for name, items in self.entries.items()}
        written = None if self.written is None else dict(self.written)
        plain = {
            "box": self.box.as_dict(),
            "entries": entries,
            "written": written,
            "steps": list(map(list, self.steps)),
        }
        more = {} if self.shift is None else {"shift": self.shift}
        return {**plain, **more, **({"lost": self.lost} if self.lost else {})}


def uncertainty_of(data: Any) -> Uncertainty | None:
    """Return what `Uncertainty.as_dict` described; `None` and an `Uncertainty` stay as they are."""
    if data is None or isinstance(data, Uncertainty):
        return data
    require_kind(data, Mapping, "uncertainty", "what obsynth.uncertain_system makes, or its as_dict()")
    missing = [part for part in ("box", "entries", "written", "steps") if part not in data]
    if missing:
        raise SpecError(f"uncertainty has no {missing[0]!r}: give what its as_dict() returns.", path="uncertainty")
    box = dict(data["box"])
    return Uncertainty(
        constants_box(box.pop("constants"), **box),
        data["entries"],
        data["written"],
        data["steps"],
        data.get("shift"),
        str(data.get("lost", "")),
    )


def expressions_in(rows: Any) -> tuple[Any, list[Entry]]:
    """Return rows of numbers and texts as numbers (zero for texts), and the texts with their places."""
    if not isinstance(rows, (list, tuple)) or not all(isinstance(row, (list, tuple)) for row in rows):
        return rows, []
    entries = [(i, j, cell) for i, row in enumerate(rows) for j, cell in enumerate(row) if isinstance(cell, str)]
    return [[0.0 if isinstance(cell, str) else cell for cell in row] for row in rows], entries


def matrices_of(plant: Any) -> dict[str, FloatArray]:
    """Return the matrices of a plant that may hold constants, by name."""
    return {name: getattr(plant, name) for name in UNCERTAIN_MATRICES}


def as_written(plant: Any, uncertain: Uncertainty) -> Mapping[str, FloatArray]:
    """Return the matrices that may hold constants as they were written, before any transformation; raise
    `PreconditionError` where the tolerances did not follow what was done to the plant."""
    if uncertain.lost:
        names = ", ".join(uncertain.box.names)
        raise PreconditionError(
            f"The tolerances of the constants ({names}) are not carried over: {uncertain.lost}. No bounds over the "
            "box exist for this plant. Let obsynth eliminate and sample it (transform) without other changes, or "
            "leave the tolerances out for an exact model (plant.replace(uncertainty=None)).",
            condition="tolerances carried",
        )
    return matrices_of(plant) if uncertain.written is None else uncertain.written

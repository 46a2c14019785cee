"""Results of a diagnosis: the verdict on each fault and the bank of structured residuals, with printed tables."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from html import escape
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from obsynth.analysis.diagnosis.exact_fault_columns import DecoupledFaults
from obsynth.analysis.diagnosis.margins import NEARLY_ALIKE
from obsynth.files.tables import html_table, text_table
from obsynth.numerics.arrays import ComplexArray, FloatArray
from obsynth.numerics.suggestions import there_are

#: With more faults only residuals that see all faults, all but one, or a single one are searched by default.
MOST_PATTERN_FAULTS = 6


@dataclass(frozen=True)
class StructuredResidual:
    """A residual that exists: some faults affect it, and the other faults and all unknown inputs do not.

    Parameters
    ----------
    sees : tuple of str
        Faults that affect the residual.
    blind_to : tuple of str
        The other faults, which do not.
    at_rest : tuple of str
        Faults in `sees` whose constant values affect the residual in the steady state.
    order : int or None
        Least order of a filter with one residual that all faults of `sees` affect; ``None`` where it was not computed.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]], C=[[1, 0], [0, 1]], Bf=[[1], [0]], Bd=[[0], [1]], dt=1.0
    ... )
    >>> residual = obsynth.diagnose(plant).bank[0]
    >>> residual.sees, residual.order
    (('f1',), 1)
    """

    sees: tuple[str, ...]
    blind_to: tuple[str, ...]
    at_rest: tuple[str, ...]
    order: int | None


def residual_bank(faults: DecoupledFaults, whole_bank: bool = False) -> tuple[StructuredResidual, ...]:
    """Return the structured residuals that exist, those that see fewest faults first."""
    residuals, plant = [], faults.source
    for removed in _sets(plant.nf, whole_bank):
        remaining = [i for i in range(plant.nf) if i not in removed]
        decoupled = [faults.of(removed, i) for i in remaining]
        if not all(fault.visible for fault in decoupled):
            continue
        orders = [fault.residual_order for fault in decoupled]
        known = [order for order in orders if order is not None]
        sets = (remaining, removed, [fault.number for fault in decoupled if fault.shows_at_rest])
        sees, blind, at_rest = (tuple(plant.fault_names[i] for i in chosen) for chosen in sets)
        residuals.append(StructuredResidual(sees, blind, at_rest, max(known) if len(known) == len(orders) else None))
    return tuple(sorted(residuals, key=lambda residual: len(residual.sees)))


def _sets(count: int, whole_bank: bool) -> Iterator[Sequence[int]]:
    """Yield the sets of faults that residuals are decoupled from: all sets, or none, one, and all but one of many."""
    if whole_bank or count <= MOST_PATTERN_FAULTS:
        for size in range(count):
            yield from combinations(range(count), size)
        return
    yield ()
    for i in range(count):
        yield (i,)
        yield tuple(j for j in range(count) if j != i)


@dataclass(frozen=True, eq=False)
class FaultDiagnosis:
    """Diagnosability of one fault from a plant's outputs, for arbitrary unknown inputs and initial states.

    Parameters
    ----------
    name : str
        Name of the fault.
    detectable : bool
        Whether the fault affects a residual.
    detectable_at_rest : bool
        Whether a constant fault affects a residual in the steady state.
    detectable_at : dict of float to bool
        The same for sinusoidal faults, by frequency in rad/s.
    estimable : bool
        Whether the fault can be estimated for arbitrary profiles of all faults.
    step_estimable : bool
        Whether the fault can be estimated if it is a step (the other faults are arbitrary).
    model_estimable : bool
        Whether the fault can be estimated if it follows the given fault model.
    order : int or None
        Derivatives of the outputs (samples of delay, for sampled plants) that the estimate of an arbitrary profile
        needs; a step needs none.  ``None`` where the fault is not isolable from the others.
    residual_order : int or None
        Least order of a filter with one residual that the fault affects, decoupled from the unknown inputs.
    filter_order : int
        Order of the plant without unknown inputs and other faults.  A filter that estimates the fault has one more
        state for each state of its model.
    zeros : ComplexArray
        Points ``(k,)`` of the complex plane, in 1/s (dimensionless for sampled plants), at which the fault cannot be
        distinguished from the unknown inputs and the other faults.
    blocking : ComplexArray
        The zeros on or outside the boundary of stability, which make an estimate of an arbitrary profile impossible.
    sentences : tuple of str
        What hides the fault, and which sensors would help.
    exact : bool
        Whether the verdicts were decided in rational arithmetic; orders of larger plants are not.
    gap : float
        The least ratio of a singular value that counts as nonzero to one that counts as zero, over all decisions;
        infinite for exact decisions.
    margin : float
        Ratio of the fault sizes at which it can be isolated from all other faults, of any size, and at which it is
        visible at all; for constant faults where these are isolable, else for sinusoids.  Infinite where it is not
        isolable.
    least_step : float or None
        The step, in the fault's unit, with an effect of three standard deviations of sensor noise on the mean of 100
        samples, whatever the other faults are; ``None`` unless noise is stated on every output.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]], C=[[1, 0], [0, 1]], Bf=[[1], [0]], Bd=[[0], [1]], dt=1.0
    ... )
    >>> fault = obsynth.diagnose(plant).faults[0]
    >>> fault.name, fault.detectable, fault.estimable
    ('f1', True, True)
    """

    name: str
    detectable: bool
    detectable_at_rest: bool
    detectable_at: Mapping[float, bool]
    estimable: bool
    step_estimable: bool
    model_estimable: bool
    order: int | None
    residual_order: int | None
    filter_order: int
    zeros: ComplexArray
    blocking: ComplexArray
    sentences: tuple[str, ...]
    exact: bool
    gap: float
    margin: float
    least_step: float | None

    def to_dict(self) -> dict[str, Any]:
        """Return the verdicts as plain data, zeros as ``[real, imaginary]``."""
        plain = {field.name: getattr(self, field.name) for field in fields(self)}
        return plain | {
            "detectable_at": {f"{frequency:g}": detectable for frequency, detectable in self.detectable_at.items()},
            "zeros": _pairs(self.zeros),
            "blocking": _pairs(self.blocking),
            "sentences": list(self.sentences),
            "gap": None if np.isinf(self.gap) else self.gap,
            "margin": None if np.isinf(self.margin) else self.margin,
            "least_step": None if self.least_step is None or np.isinf(self.least_step) else self.least_step,
        }


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """Diagnosability of all faults of a plant, as `diagnose` returns it.

    Parameters
    ----------
    faults : tuple of FaultDiagnosis
        The faults, in the order of the plant.
    isolable : NDArray
        ``(nf, nf)`` of bool: entry (i, j) says whether fault i can be isolated from fault j; the diagonal says whether
        it is detectable.
    isolable_at_rest : NDArray
        ``(nf, nf)`` of bool: the same for constant faults in the steady state.
    bank : tuple of StructuredResidual
        The structured residuals that exist, those that see fewest faults first: all of them for up to six faults, or
        with ``whole_bank``; else those that see all faults, all but one, or a single one, with a warning.
    unknown_inputs : tuple of str
        The unknown inputs that all residuals and estimates are decoupled from.
    model : str
        The given fault model.
    exact : bool
        Whether the verdicts were decided in rational arithmetic.
    warnings : tuple of str
        Warnings about unclear decisions and unusual plants.
    margins : FloatArray
        ``(nf, nf)``, dimensionless: entry (i, j) is the ratio of the sizes at which fault i can be isolated from fault
        j and at which it is visible; infinite where it is not isolable.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]], C=[[1, 0], [0, 1]], Bf=[[1], [0]], Bd=[[0], [1]], dt=1.0
    ... )
    >>> diagnosis = obsynth.diagnose(plant)
    >>> diagnosis.faults[0].name, diagnosis.faults[0].detectable
    ('f1', True)
    """

    faults: tuple[FaultDiagnosis, ...]
    isolable: NDArray[np.bool_]
    isolable_at_rest: NDArray[np.bool_]
    bank: tuple[StructuredResidual, ...]
    unknown_inputs: tuple[str, ...]
    model: str
    exact: bool
    warnings: tuple[str, ...]
    margins: FloatArray

    def __getitem__(self, name: str) -> FaultDiagnosis:
        for fault in self.faults:
            if fault.name == name:
                return fault
        raise KeyError(f"no fault named {name!r}; {there_are(name, [fault.name for fault in self.faults])}")

    @property
    def sentences(self) -> tuple[str, ...]:
        """The sentences of all faults: what hides them, and which sensors would help."""
        return tuple(sentence for fault in self.faults for sentence in fault.sentences)

    def verdict_rows(self) -> tuple[tuple[str, ...], ...]:
        """Return the table of verdicts as texts: the header, then one row per fault."""
        header = ("fault", "detectable", "steady state", "as a step", "any signal", "delay", "residual", "filter")
        rows = [
            (
                fault.name,
                _word(fault.detectable),
                _word(fault.detectable_at_rest),
                _word(fault.step_estimable),
                _word(fault.estimable),
                _count(fault.order) if fault.estimable else "0" if fault.step_estimable else "-",
                _count(fault.residual_order),
                str(fault.filter_order) if fault.estimable or fault.step_estimable else "-",
            )
            for fault in self.faults
        ]
        return (header, *rows)

    def isolability_rows(self) -> tuple[tuple[str, ...], ...]:
        """Return the isolability table as texts: 'yes', 'changing' (not at rest) or 'no', with large margins."""
        names = [fault.name for fault in self.faults]
        words = np.where(self.isolable_at_rest, "yes", np.where(self.isolable, "changing", "no")).tolist()
        far = [[NEARLY_ALIKE <= value < np.inf for value in row] for row in self.margins.tolist()]
        for i, j in np.argwhere(far).tolist():
            words[i][j] += f" (margin {self.margins[i, j]:.2g})"
        rows = ((name, *row) for name, row in zip(names, words, strict=True))
        return (("fault", *(f"from {name}" for name in names)), *rows)

    def bank_rows(self) -> tuple[tuple[str, ...], ...]:
        """Return the bank of structured residuals as texts: faults that affect it, those at rest, and least order."""
        rows = [(", ".join(r.sees), ", ".join(r.at_rest) or "none", _count(r.order)) for r in self.bank]
        return (("residual sensitive only to", "in steady state to", "least order"), *rows)

    def to_dict(self) -> dict[str, Any]:
        """Return the diagnosis as plain data."""
        return {
            "faults": [fault.to_dict() for fault in self.faults],
            "isolable": self.isolable.tolist(),
            "isolable_at_rest": self.isolable_at_rest.tolist(),
            "bank": [
                {"sees": list(r.sees), "blind_to": list(r.blind_to), "at_rest": list(r.at_rest), "order": r.order}
                for r in self.bank
            ],
            "unknown_inputs": list(self.unknown_inputs),
            "model": self.model,
            "exact": self.exact,
            "warnings": list(self.warnings),
            "margins": [[None if np.isinf(value) else value for value in row] for row in self.margins.tolist()],
        }

    @property
    def heading(self) -> str:
        """One line on the unknown inputs and the arithmetic of the decisions."""
        count = len(self.unknown_inputs)
        named = ", ".join(self.unknown_inputs) if count <= 4 else f"{count} unknown inputs"
        arithmetic = "decided exactly" if self.exact else "decided in floating point"
        return f"What can be diagnosed ({f'decoupled from {named}' if count else 'no unknown inputs'}; {arithmetic})"

    def __repr__(self) -> str:
        if not self.faults:
            return "The plant has no faults to diagnose."
        more = ["", *text_table(self.isolability_rows())] if len(self.faults) > 1 else []
        return "\n".join([self.heading, *text_table(self.verdict_rows()), *more, *self._texts])

    def _repr_html_(self) -> str:
        parts = [f"<p><b>{escape(self.heading)}</b></p>", html_table(self.verdict_rows())]
        if len(self.faults) > 1:
            parts += [html_table(self.isolability_rows()), html_table(self.bank_rows())]
        return "".join([*parts, *(f"<p>{escape(text)}</p>" for text in self._texts)])

    @property
    def _texts(self) -> list[str]:
        return [*self.sentences, *(f"Warning: {text}" for text in self.warnings)]


def _pairs(values: ComplexArray) -> list[list[float]]:
    return [[float(value.real), float(value.imag)] for value in values]


def _word(verdict: bool) -> str:
    return "yes" if verdict else "no"


def _count(number: int | None) -> str:
    return "-" if number is None else str(number)

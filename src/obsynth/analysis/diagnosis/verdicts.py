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

#: With more faults only residuals that are blind to one fault, or see one, are looked for unless all are asked for.
MOST_PATTERN_FAULTS = 6


@dataclass(frozen=True)
class StructuredResidual:
    """A residual that can be had: it sees some faults, and neither the others nor any unknown input.

    Parameters
    ----------
    sees : tuple of str
        Faults that leave a trace in it.
    blind_to : tuple of str
        The others.
    at_rest : tuple of str
        Those of `sees` whose constant values it keeps seeing.
    order : int or None
        Least order of a filter with one residual that sees them all; ``None`` where it is beyond what is computed.

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
    """Return the structured residuals that exist, those that see least first: all, or those of `_sets`."""
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
    """Yield the sets of faults to be blind to."""
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
    """What a plant's outputs tell about one fault, whatever the unknown inputs and the initial state are.

    Parameters
    ----------
    name : str
        The fault.
    detectable : bool
        Whether it leaves any trace.
    detectable_at_rest : bool
        Whether a constant fault leaves a constant trace.
    detectable_at : dict of float to bool
        The same for sinusoids, by frequency in rad/s.
    estimable : bool
        Whether its value can be estimated, whatever its time course and that of all other faults.
    step_estimable : bool
        Whether it can if it is a step (the other faults are arbitrary).
    model_estimable : bool
        Whether it can if it follows the fault model that was asked about.
    order : int or None
        Derivatives of the outputs (samples of delay, for sampled plants) that an estimate of an arbitrary time course
        needs; a step needs none.  ``None`` where it cannot be distinguished from the rest.
    residual_order : int or None
        Least order of a filter with one residual that shows it, blind to the unknown inputs.
    filter_order : int
        Order of the plant without unknown inputs and other faults; a filter that estimates the fault has one state
        more for each of its model.
    zeros : ComplexArray
        ``(k,)``, 1/s (dimensionless for sampled plants): where it cannot be distinguished from the unknown inputs and
        the other faults.
    blocking : ComplexArray
        Those on or outside the boundary of stability: what forbids an estimate of an arbitrary time course.
    sentences : tuple of str
        What hides it, and what would help.
    exact : bool
        Whether all this was decided over the rational numbers; orders of larger plants are not.
    gap : float
        How clear the least clear decision was, kept over dropped; infinite for exact ones.
    margin : float
        By how much it has to be larger to be distinguished from all other faults, of any size, than to be seen; as a
        constant where it can be, else as a sinusoid.  Infinite where it cannot be.
    least_step : float or None
        In its unit: the step that stands out by three standard deviations of the sensors' noise in the mean of 100
        samples, whatever the other faults are; ``None`` where no noise is stated on every output.

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
    """What can be diagnosed on a plant; made by `diagnose`.

    Parameters
    ----------
    faults : tuple of FaultDiagnosis
        In the order of the plant.
    isolable : NDArray
        ``(nf, nf)`` of bool: entry (i, j) whether fault i can be distinguished from fault j (the diagonal: whether it
        shows).
    isolable_at_rest : NDArray
        ``(nf, nf)`` of bool: the same for constant faults that leave constant traces.
    bank : tuple of StructuredResidual
        The structured residuals that exist, those that see least first: all of them up to six faults, or where the
        whole bank was asked for; else those that see all faults, all but one, or one alone, and a warning says so.
    unknown_inputs : tuple of str
        What all this is free of.
    model : str
        The fault model that was asked about.
    exact : bool
        Whether the verdicts were decided over the rational numbers.
    warnings : tuple of str
        Thin decisions and what else a reader should know.
    margins : FloatArray
        ``(nf, nf)``, dimensionless: entry (i, j) by how much fault i has to be larger to be distinguished from fault j
        than to be seen; infinite where it cannot be.

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
        """What hides faults and what would help, of all faults."""
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
        """Return the isolability table as texts: 'yes', 'changing' (not at rest) or 'no', row from column; with the
        margin where it is worth a word."""
        names = [fault.name for fault in self.faults]
        words = np.where(self.isolable_at_rest, "yes", np.where(self.isolable, "changing", "no")).tolist()
        far = [[NEARLY_ALIKE <= value < np.inf for value in row] for row in self.margins.tolist()]
        for i, j in np.argwhere(far).tolist():
            words[i][j] += f" (margin {self.margins[i, j]:.2g})"
        rows = ((name, *row) for name, row in zip(names, words, strict=True))
        return (("fault", *(f"from {name}" for name in names)), *rows)

    def bank_rows(self) -> tuple[tuple[str, ...], ...]:
        """Return the bank of structured residuals as texts: what each sees, at rest, and its least order."""
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
        """What was asked, in one line."""
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

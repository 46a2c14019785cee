"""From a plant to what can be diagnosed on it: what is known of each fault, and the bank of structured residuals.

Least sets of sensors for detecting, isolating or estimating faults: few sets are enumerated; of many, greedy choices
find inclusion-minimal ones, and say so: with y = (d1, d2, d1 + f) {1, 3} suffices, greedy takes three.  Screening at
points s0 is by rows of ``[C, D] (s0 E - A)^-1 [Bd, Bf]``.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from html import escape
from itertools import combinations
from math import comb
from typing import Any

import numpy as np
from numpy.typing import NDArray

from obsynth.analysis.diagnosis.fault_columns import (
    MOST_STATES_FOR_SENSOR_PAIRS,
    MOST_STATES_FOR_SENSORS,
    PencilUnits,
    Question,
    Questions,
    Removal,
    Sensor,
    dc_point,
    decided_exactly,
    hidden_motion,
    least_additions,
    listed_sets,
    others,
    state_sensors,
    with_sensors,
)
from obsynth.analysis.transformations.linear_plants import Transformation, linear_plant
from obsynth.analysis.zeros import structure_of
from obsynth.errors import SpecError
from obsynth.files.tables import html_table, text_table
from obsynth.numerics.arguments import (
    SMALLEST,
    ComplexArray,
    FloatArray,
    arguments_checked,
    is_finite_number,
    read_only,
)
from obsynth.numerics.libraries import failed_computations, on_one_thread_if_small
from obsynth.numerics.ranks import CANCELLATION_TOLERANCE, RANK_TOLERANCE, REST_TOLERANCE
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.fault_models import Exosystem, exosystem, stated_eigenvalues

#: Points without meaning, in units of the plant's own time scale.
GENERIC_SCALED_POINTS = (0.7391 + 0.2j, 0.31 + 1.3247j)
#: Part of a fault's column outside the span of the others, relative to it, below which it does not show.
SHOWN_PART = 1e-9


@dataclass(frozen=True, eq=False)
class SensorResponses:
    """Rows: outputs, then candidates; columns: unknown inputs, then faults; ``tables (points, rows, nd + nf)``."""

    tables: ComplexArray
    outputs: int
    nd: int

    @classmethod
    def of(cls, plant: DescriptorSystem, sensors: Sequence[Sensor]) -> SensorResponses | None:
        """Return the tables, or ``None`` where the pencil is singular at a generic point."""
        units = PencilUnits.of(plant.E, plant.A)
        inputs = np.hstack([plant.Bd, plant.Bf])
        c = np.vstack([plant.C, *(sensor.C[None, :] for sensor in sensors)])
        direct = np.vstack(
            [np.hstack([plant.Dd, plant.Df]), *(np.hstack([sensor.Dd, sensor.Df])[None, :] for sensor in sensors)]
        )
        tables = []
        for point in GENERIC_SCALED_POINTS:
            pencil = units.rows[:, None] * (point * units.time * plant.E - plant.A) * units.columns
            values = np.linalg.svd(pencil, compute_uv=False) if pencil.size else np.ones(1)
            if values[-1] <= RANK_TOLERANCE * values[0]:
                return None
            states, terms = _solution(pencil, units.rows[:, None] * inputs)
            table = c @ (units.columns[:, None] * states) + direct
            terms = np.abs(c) @ (units.columns[:, None] * terms) + np.abs(direct)
            # What a sensor does not see would be rounding, and that as large as any response once rows have one size.
            table = np.where(np.abs(table) > CANCELLATION_TOLERANCE * terms, table, 0.0)
            for axis in (1, 0):
                sizes = np.linalg.norm(table, axis=axis, keepdims=True)
                table = table / np.where(sizes > 0.0, sizes, 1.0)
            tables.append(table)
        return cls(np.array(tables, dtype=np.complex128), plant.ny, plant.nd)

    def shows(self, sets: NDArray[np.int64], fault: int, beside: Sequence[int]) -> NDArray[np.float64]:
        """Return the share of a fault's column outside the span of d and ``beside``, for sets ``(N, k)``."""
        count = len(sets)
        fixed = np.broadcast_to(np.arange(self.outputs), (count, self.outputs))
        rows = np.hstack([fixed, self.outputs + sets])
        columns = [*range(self.nd), *(self.nd + j for j in beside)]
        found = np.zeros(count)
        if rows.shape[1] == 0:
            return found
        for table in self.tables:
            goal = table[:, self.nd + fault][rows]
            rest = _outside(table[:, columns][rows], goal)
            size = np.linalg.norm(goal, axis=1)
            found = np.maximum(found, np.where(size > 0.0, rest / np.where(size > 0.0, size, 1.0), 0.0))
        return np.where(found > SHOWN_PART, found, 0.0)


def _solution(matrix: ComplexArray | FloatArray, right: FloatArray) -> tuple[ComplexArray, FloatArray]:
    """Return a solution, refined once, and the sizes of the terms of each entry: ``|M^-1| (|M| |x| + |b|)``.

    An entry errs by a few roundings of its own terms then, whatever units rows and columns have ([Higham2002]_, 12.2).

    .. [Higham2002] N. J. Higham, Accuracy and Stability of Numerical Algorithms, 2nd ed., SIAM, 2002.
    """
    found = np.linalg.solve(matrix, np.hstack([right, np.eye(len(matrix))]))
    x, inverse = found[:, : right.shape[1]], found[:, right.shape[1] :]
    x = x + inverse @ (right - matrix @ x)
    return x, np.abs(inverse) @ (np.abs(matrix) @ np.abs(x) + np.abs(right))


def _outside(span: ComplexArray, vector: ComplexArray) -> NDArray[np.float64]:
    """Return the norm of the part of each vector ``(N, m)`` outside the span of columns ``(N, m, c)``."""
    if span.shape[2] == 0:
        return np.asarray(np.linalg.norm(vector, axis=1))
    left, values, _ = np.linalg.svd(span, full_matrices=False)
    kept = left * (values > RANK_TOLERANCE * np.maximum(values[:, :1], SMALLEST))[:, None, :]
    for _ in range(2):
        vector = vector - np.einsum("nij,nj->ni", kept, np.einsum("nij,ni->nj", kept.conj(), vector))
    return np.asarray(np.linalg.norm(vector, axis=1))


#: Sets of one size are enumerated up to so many; the best of each size are confirmed until so many fail in a row.
MOST_ENUMERATED_SETS = 40_000
MOST_CONFIRMED = 400


@dataclass(frozen=True)
class Task:
    """One thing to be reached: a fault, free of the unknown inputs and of the faults ``beside``."""

    fault: int
    beside: tuple[int, ...]
    goal: str


@dataclass(frozen=True, eq=False)
class SensorSearch:
    """A search over sets of candidate sensors, for the columns ``faults``."""

    plant: DescriptorSystem
    sensors: tuple[Sensor, ...]
    goal: str
    faults: tuple[int, ...]
    may_fail: bool  # an added sensor brings a fault of its own, to be told as well
    copies: int  # how often a sensor may be taken

    @cached_property
    def responses(self) -> SensorResponses | None:
        """What outputs and candidates show of unknown inputs and faults at generic points."""
        return SensorResponses.of(self.plant, self.sensors)

    def tasks(self, plant: DescriptorSystem, faults: Sequence[int]) -> list[Task]:
        """Return everything that the goal asks of a plant."""
        if self.goal == "detect":
            return [Task(i, (), self.goal) for i in faults]
        if self.goal == "isolate":
            pairs = [Task(i, (j,), self.goal) for i in faults for j in others(plant, i)]
            return [*(Task(i, (), self.goal) for i in faults), *pairs]
        return [Task(i, others(plant, i), self.goal) for i in faults]

    @cached_property
    def had(self) -> list[Task]:
        """The tasks that the plant reaches with no sensor added."""
        return [task for task in self.tasks(self.plant, self.faults) if reached(self._bare, task)]

    @cached_property
    def _bare(self) -> Questions:
        return Questions(self.plant, exactly=False)

    def reachable(self) -> list[Task]:
        """Return the tasks that all candidates together reach: no set can do more, and no sensor takes one away."""
        whole, had = Questions(with_sensors(self.plant, self.sensors), exactly=False), set(self.had)
        return [task for task in self.tasks(self.plant, self.faults) if task in had or reached(whole, task)]

    def equipped(self, chosen: Sequence[int]) -> DescriptorSystem:
        """Return the plant with a set of candidates, each with a fault of its own where sensors may fail."""
        picked = []
        names = [self.sensors[index].name for index in chosen]
        for place, (index, name) in enumerate(zip(chosen, names, strict=True)):
            again = names[: place + 1].count(name)
            picked.append(replace(self.sensors[index], name=name if again == 1 else f"{name} ({again})"))
        plant = with_sensors(self.plant, picked)
        if not self.may_fail or not picked:
            return plant
        count = len(picked)
        own = np.vstack([np.zeros((self.plant.ny, count)), np.eye(count)])
        return plant.replace(
            Bf=np.hstack([plant.Bf, np.zeros((plant.nx, count))]),
            Df=np.hstack([plant.Df, own]),
            fault_names=[*plant.fault_names, *(f"sensor {sensor.name}" for sensor in picked)],
        )

    def feasible(self, chosen: Sequence[int], wanted: Sequence[Task]) -> bool:
        """Whether a set reaches all that is wanted (and all about its own faults)."""
        if not chosen:
            return set(wanted) <= set(self.had)
        plant = self.equipped(chosen)
        asked = Questions(plant, exactly=False)
        if not all(reached(asked, task) for task in wanted):
            return False
        if not self.may_fail:
            return True
        known = self.plant.nf
        more = self.tasks(plant, [*self.faults, *range(known, plant.nf)])
        return all(reached(asked, task) for task in more if max(task.fault, *task.beside, -1) >= known)

    def minimal_sets(self, wanted: Sequence[Task], largest: int, most: int) -> tuple[list[tuple[int, ...]], bool]:
        """Return inclusion-minimal sets by size, and whether these are all of them up to the largest size."""
        responses = None if self.may_fail else self.responses
        found: list[tuple[int, ...]] = []
        count = len(self.sensors)
        for size in range(largest + 1):
            if comb(count * self.copies, size) > MOST_ENUMERATED_SETS:
                return found, False
            every = dict.fromkeys(combinations([i for i in range(count) for _ in range(self.copies)], size))
            sets = [chosen for chosen in every if not any(Counter(f) <= Counter(chosen) for f in found)]
            new: list[tuple[int, ...]] = []
            for tried, chosen in enumerate(self._promising(sets, wanted, responses), start=1):
                if self.feasible(chosen, wanted):
                    new.append(chosen)
                if len(found) + len(new) >= most or tried >= MOST_CONFIRMED:
                    return [*found, *new], False
            found += new
            if () in found:  # every other set holds it
                break
        return found, True

    def _promising(
        self, sets: Sequence[tuple[int, ...]], wanted: Sequence[Task], responses: SensorResponses | None
    ) -> list[tuple[int, ...]]:
        """Return the sets that pass the rank test, those that show most first."""
        if responses is None or not sets or self.copies > 1:
            return list(sets)
        table = np.array(sets, dtype=np.int64).reshape(len(sets), -1)
        strength = np.full(len(sets), np.inf)
        for task in wanted:
            strength = np.minimum(strength, responses.shows(table, task.fault, task.beside))
        order = np.argsort(-strength, kind="stable")
        return [sets[i] for i in order if strength[i] > 0.0]

    def greedy_set(self, wanted: Sequence[Task]) -> tuple[int, ...] | None:
        """Return one inclusion-minimal set: the sensor that reaches most, again and again; then what is not needed."""
        chosen: list[int] = []
        left = list(range(len(self.sensors)))
        while not self.feasible(chosen, wanted):
            if not left:
                return None
            scores = [self._score([*chosen, i], wanted) for i in left]
            chosen.append(left.pop(int(np.argmax(scores))))
        for index in list(chosen):
            rest = [i for i in chosen if i != index]
            if self.feasible(rest, wanted):
                chosen = rest
        return tuple(sorted(chosen))

    def _score(self, chosen: Sequence[int], wanted: Sequence[Task]) -> float:
        responses = self.responses
        if responses is None:
            asked = Questions(self.equipped(chosen), exactly=False)
            return float(sum(reached(asked, task) for task in wanted))
        table = np.array([chosen], dtype=np.int64)
        shown = [float(responses.shows(table, task.fault, task.beside)[0]) for task in wanted]
        return sum(value > 0.0 for value in shown) + min([value for value in shown if value > 0.0], default=0.0) / 2.0


def reached(questions: Questions, task: Task) -> bool:
    """Whether a plant reaches a task, decided by taking out what must not show: once for all faults that stay."""
    asked = questions.of(task.beside, task.fault)
    if task.goal == "estimate":
        return asked.estimable
    return asked.shows_at_rest if task.goal == "estimate-step" else asked.visible


#: With more faults only residuals that are blind to one fault, or see one, are looked for unless all are asked for.
MOST_PATTERN_FAULTS = 6
#: Of more faults the whole bank is refused: 4095 sets are asked about for this many.
MOST_FAULTS_OF_WHOLE_BANK = 12


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
    """

    sees: tuple[str, ...]
    blind_to: tuple[str, ...]
    at_rest: tuple[str, ...]
    order: int | None


def residual_bank(questions: Questions, whole: bool = False) -> tuple[StructuredResidual, ...]:
    """Return the structured residuals that exist, those that see least first: all, or those of `_sets`."""
    found, plant = [], questions.source
    for removed in _sets(plant.nf, whole):
        kept = [i for i in range(plant.nf) if i not in removed]
        asked = [questions.of(removed, i) for i in kept]
        if not all(one.visible for one in asked):
            continue
        orders = [one.residual_order for one in asked]
        known = [order for order in orders if order is not None]
        sets = (kept, removed, [one.number for one in asked if one.shows_at_rest])
        sees, blind, at_rest = (tuple(plant.fault_names[i] for i in chosen) for chosen in sets)
        found.append(StructuredResidual(sees, blind, at_rest, max(known) if len(known) == len(orders) else None))
    return tuple(sorted(found, key=lambda residual: len(residual.sees)))


def _sets(count: int, whole: bool) -> Iterator[Sequence[int]]:
    """Yield the sets of faults to be blind to."""
    if whole or count <= MOST_PATTERN_FAULTS:
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

    def to_dict(self) -> dict[str, Any]:
        """Return the verdicts as plain data, zeros as ``[real, imaginary]``."""
        plain = {field.name: getattr(self, field.name) for field in fields(self)}
        return plain | {
            "detectable_at": {f"{frequency:g}": found for frequency, found in self.detectable_at.items()},
            "zeros": _pairs(self.zeros),
            "blocking": _pairs(self.blocking),
            "sentences": list(self.sentences),
            "gap": None if np.isinf(self.gap) else self.gap,
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
    """

    faults: tuple[FaultDiagnosis, ...]
    isolable: NDArray[np.bool_]
    isolable_at_rest: NDArray[np.bool_]
    bank: tuple[StructuredResidual, ...]
    unknown_inputs: tuple[str, ...]
    model: str
    exact: bool
    warnings: tuple[str, ...]

    def __getitem__(self, name: str) -> FaultDiagnosis:
        for fault in self.faults:
            if fault.name == name:
                return fault
        raise KeyError(f"no fault named {name!r}; there are: {', '.join(fault.name for fault in self.faults)}")

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
                _count(fault.order),
                _count(fault.residual_order),
                str(fault.filter_order),
            )
            for fault in self.faults
        ]
        return (header, *rows)

    def isolability_rows(self) -> tuple[tuple[str, ...], ...]:
        """Return the isolability table as texts: 'yes', 'changing' (not at rest) or 'no', row from column."""
        names = [fault.name for fault in self.faults]
        words = np.where(self.isolable_at_rest, "yes", np.where(self.isolable, "changing", "no")).tolist()
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
        }

    @property
    def heading(self) -> str:
        """What was asked, in one line."""
        count = len(self.unknown_inputs)
        named = ", ".join(self.unknown_inputs) if count <= 4 else f"{count} unknown inputs"
        way = "decided exactly" if self.exact else "decided in floating point"
        return f"What can be diagnosed ({f'decoupled from {named}' if count else 'no unknown inputs'}; {way})"

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


def _word(found: bool) -> str:
    return "yes" if found else "no"


def _count(number: int | None) -> str:
    return "-" if number is None else str(number)


#: States that could be measured times faults: with more, what would help is not searched here.
MOST_ADDITIONS = 300
#: Zeros that are named in a sentence; the others are counted.
MOST_ZEROS = 4
_PART_OF_THE_BANK = (
    "Of {count} faults, the residuals listed see all faults, all but one, or one alone; others may exist. "
    "diagnose(..., whole_bank=True) and obsynth check --whole-bank list all of up to 12 faults."
)


@arguments_checked
@failed_computations()
@on_one_thread_if_small
def diagnose(
    plant: DescriptorSystem | Transformation,
    *,
    fault_model: Any = "step",
    frequencies: Sequence[float] = (),
    suggest: bool = True,
    whole_bank: bool = False,
    progress: Callable[[str], None] | None = None,
) -> Diagnosis:
    """Decide for each fault whether it can be detected, distinguished from the others, and estimated; and if not, why.

    The answers hold for any unknown inputs and initial state, for descriptor plants of any index, continuous or not.
    Small plants whose numbers are as somebody wrote them are decided over the rational numbers; all others in floating
    point, in units that do not depend on those of the data, with the gap behind each decision.

    Parameters
    ----------
    plant : DescriptorSystem or Transformation
        ``E, A (nx, nx)``, ``C (ny, nx)``, ``Bf (nx, nf)``, ``Bd (nx, nd)``, ``Df, Dd`` allowed.  Where ``sE - A`` is
        not regular, the verdicts are about all trajectories that satisfy the equations, and a warning says so.
    fault_model : str, mapping or FaultModel, optional
        How faults run, as for `ui_pi_observer`: it decides `model_estimable`.
    frequencies : sequence of float, optional, rad/s
        Where to ask whether a sinusoidal fault leaves a trace.
    suggest : bool, optional
        Look for states that would help where a fault cannot be estimated.
    whole_bank : bool, optional
        List every structured residual that exists of up to 12 faults; that is always done for six.
    progress : callable, optional
        Called with a text at the start of each stage.

    Returns
    -------
    Diagnosis
        ``isolable (nf, nf)``, `FaultDiagnosis` per fault, and the bank of structured residuals.

    Raises
    ------
    SpecError
        ``plant`` is no linear time-invariant plant, the fault model is malformed, a frequency is no number, or the
        whole bank is asked for of more than 12 faults.
    SolverError
        The numbers are beyond double precision.

    References
    ----------
    .. [Varga] A. Varga, Solving Fault Diagnosis Problems, Springer 2017: fault detectability, weak and strong, and
       isolability.  Here all of it is read from one reduction of a pencil, and decided exactly where that can be.
    """
    plant = linear_plant(plant)
    if not all(is_finite_number(value) and value >= 0.0 for value in frequencies):
        raise SpecError(f"frequencies is {list(frequencies)!r}: give numbers in rad/s, 0 or more.", path="frequencies")
    model = exosystem(fault_model, plant.fault_names, plant.dt)
    if whole_bank and plant.nf > MOST_FAULTS_OF_WHOLE_BANK:
        raise SpecError(
            f"The plant has {plant.nf} faults: the whole bank of residuals is listed for up to "
            f"{MOST_FAULTS_OF_WHOLE_BANK}. Leave faults out, or whole_bank.",
            path="whole_bank",
        )
    report_stage = progress or (lambda _: None)
    exactly = decided_exactly(plant)
    report_stage("deciding which faults are detectable")
    asked, candidates = Questions(plant, exactly), _Candidates(plant) if suggest else None
    shown = [asked.of((), i) for i in range(plant.nf)]
    free = [asked.of(others(plant, i), i) for i in range(plant.nf)]
    faults = tuple(
        _verdict(plant, own, alone, frequencies, model_points(model, i), candidates)
        for i, (own, alone) in enumerate(zip(shown, free, strict=True))
    )
    report_stage("deciding which faults can be isolated")
    weak, strong, pairs = _isolability(plant, shown, asked)
    bank = residual_bank(asked, whole_bank)
    part = () if whole_bank or plant.nf <= MOST_PATTERN_FAULTS else (_PART_OF_THE_BANK.format(count=plant.nf),)
    return Diagnosis(
        faults,
        weak,
        strong,
        bank,
        plant.disturbance_names,
        "; ".join(dict.fromkeys(model.descriptions)),
        exactly,
        (*_warnings(plant, [*shown, *free, *pairs]), *part),
    )


def model_points(model: Exosystem, fault: int) -> list[complex]:
    """Return the eigenvalues of the part of the exosystem that a fault is made of."""
    reached = model.Cw[fault] != 0.0
    for _ in range(len(reached)):
        reached = reached | np.any(model.Phi[reached] != 0.0, axis=0)
    part = model.Phi[np.ix_(reached, reached)]
    return [complex(value) for value in stated_eigenvalues(part)] if part.size else []


def _verdict(
    plant: DescriptorSystem,
    shown: Question,
    free: Question,
    frequencies: Sequence[float],
    modes: Sequence[complex],
    candidates: _Candidates | None,
) -> FaultDiagnosis:
    points = [complex(np.exp(1j * w * plant.dt)) if plant.dt > 0.0 else 1j * w for w in frequencies]
    return FaultDiagnosis(
        name=plant.fault_names[shown.number],
        detectable=shown.visible,
        detectable_at_rest=shown.shows_at_rest,
        detectable_at={float(w): shown.visible and shown.shows_at(s) for w, s in zip(frequencies, points, strict=True)},
        estimable=free.estimable,
        step_estimable=free.shows_at_rest,
        model_estimable=free.visible and all(free.shows_at(mode) for mode in modes),
        order=free.derivatives if free.visible else None,
        residual_order=shown.residual_order if shown.visible else None,
        filter_order=free.order,
        zeros=free.zeros,
        blocking=free.blocking,
        sentences=tuple(_sentences(plant, shown, free, candidates)),
        exact=shown.exactly,
        gap=min(shown.gap, free.gap),
    )


def _sentences(plant: DescriptorSystem, shown: Question, free: Question, candidates: _Candidates | None) -> list[str]:
    """Return what hides a fault, at which point, and what would help."""
    name, rest = plant.fault_names[shown.number], dc_point(plant.dt)
    letter = "z" if plant.dt > 0.0 else "s"
    step, texts = free.shows_at_rest, []
    if not shown.visible:
        unknown = ", ".join(plant.disturbance_names)
        texts.append(
            f"{name}: not detectable by any residual" + (f" that is decoupled from {unknown}." if unknown else ".")
        )
    elif not free.visible:
        others = ", ".join(plant.fault_names[j] for j in free.removed)
        texts.append(f"{name}: detectable, but not distinguishable from {others} and the unknown inputs together.")
    if not step:
        motion = hidden_motion(plant, shown.number, rest, () if not shown.visible else free.removed)
        if motion is not None:
            seen = shown.visible and (free.visible or not shown.shows_at_rest)
            then = " It cannot be estimated; residuals respond only while it changes." if seen else ""
            texts.append(f"{name}: {motion} ({letter} = {_number(rest)}).{then}")
    hiding = [zero for zero in free.blocking if abs(zero - rest) > REST_TOLERANCE and zero.imag >= 0.0]
    for zero in hiding[:MOST_ZEROS]:
        motion = hidden_motion(plant, shown.number, complex(zero), free.removed)
        at = f"{letter} = {_number(zero)}"
        how = f"output-nulling at {at}" if motion is None else f"{motion} ({at})"
        texts.append(f"{name}: {how}. A fault with this time course cannot be estimated.")
    if len(hiding) > MOST_ZEROS:
        texts.append(f"{name}: output-nulling at {len(hiding) - MOST_ZEROS} more points.")
    if free.visible and free.derivatives:
        more = "s" if free.derivatives > 1 else ""
        needed = f"sample{more} of delay" if plant.dt > 0.0 else f"derivative{more} of the outputs"
        texts.append(
            f"{name}: the estimate needs {free.derivatives} {needed}{'; that of a step needs none' if step else ''}."
        )
    if candidates is not None and not (step and free.estimable):
        texts += _suggestion(candidates, name, shown, step=step)
    return texts


@dataclass(frozen=True, eq=False)
class _Candidates:
    """States that could be measured, and what they show at generic points: of most sets that is enough to refuse."""

    plant: DescriptorSystem

    @cached_property
    def sensors(self) -> tuple[Sensor, ...]:
        return state_sensors(self.plant)

    @property
    def searched(self) -> str:
        """Which additions are searched, in words; empty where none are: each is asked anew for each fault."""
        if self.plant.nx > MOST_STATES_FOR_SENSORS or len(self.sensors) * self.plant.nf > MOST_ADDITIONS:
            return ""
        return "state" if self.plant.nx > MOST_STATES_FOR_SENSOR_PAIRS else "state or pair of states"

    @cached_property
    def responses(self) -> SensorResponses | None:
        return SensorResponses.of(self.plant, self.sensors)

    def additions(
        self, fault: int, beside: Sequence[int], reached: Callable[[DescriptorSystem], bool]
    ) -> tuple[tuple[str, ...], ...]:
        """Return the least sets that reach something for which a fault has to show, free of those ``beside``."""

        def promising(sets: NDArray[np.int64]) -> NDArray[np.bool_]:
            return np.ones(len(sets), bool) if responses is None else responses.shows(sets, fault, beside) > 0.0

        if not self.searched:
            return ()
        responses = self.responses
        return least_additions(self.plant, self.sensors, reached, promising=promising)


def _suggestion(candidates: _Candidates, name: str, shown: Question, *, step: bool) -> list[str]:
    """Return which states to measure, computed; and those that would only show the fault."""
    plant, fault = candidates.plant, shown.number
    rest = others(plant, fault)
    answered: dict[tuple[str, ...], Question] = {}

    def free(changed: DescriptorSystem) -> Question:
        added = changed.output_names[plant.ny :]
        return answered.setdefault(added, Question(Removal(changed, rest), fault))

    full = candidates.additions(fault, rest, lambda changed: free(changed).estimable)
    constant = () if step else candidates.additions(fault, rest, lambda changed: free(changed).shows_at_rest)
    texts = []
    if full:
        texts.append(f"{name}: Measure one of: {listed_sets(full)}.")
    elif constant:
        texts.append(f"{name}: Measure one of: {listed_sets(constant)} (then a step of it can be estimated).")
    if not shown.visible:
        showing = candidates.additions(fault, (), lambda changed: Question(Removal(changed, ()), fault).visible)
        more = [names for names in showing if names not in (*full, *constant)]
        if more:
            texts.append(f"{name}: {listed_sets(more)} would make it detectable, but not estimable.")
    if not candidates.searched:
        texts.append(f"{name}: obsynth.sensor_sets searches which sensors would help.")
    elif not texts and plant.nx:
        texts.append(f"{name}: no further {candidates.searched} makes it estimable.")
    return texts


def _isolability(
    plant: DescriptorSystem, shown: Sequence[Question], questions: Questions
) -> tuple[np.ndarray, np.ndarray, list[Question]]:
    weak, strong = np.zeros((2, plant.nf, plant.nf), dtype=bool)
    asked = {(i, j): questions.of((j,), i) for i in range(plant.nf) for j in others(plant, i)}
    for place, pair in {**asked, **{(i, i): own for i, own in enumerate(shown)}}.items():
        weak[place], strong[place] = pair.visible, pair.shows_at_rest
    return read_only(weak, bool), read_only(strong, bool), list(asked.values())


def _warnings(plant: DescriptorSystem, asked: Sequence[Question]) -> tuple[str, ...]:
    texts = []
    if not structure_of(plant).regular:
        texts.append(
            "sE - A is not regular: the equations leave states open or bind the inputs. The verdicts are about all "
            "trajectories that satisfy them."
        )
    thin = [question for question in asked if not question.clear]
    if thin:
        worst = min(thin, key=lambda question: question.gap)
        texts.append(
            f"{plant.fault_names[worst.number]}: the least clear decision has a gap of {worst.gap:.1e} only; orders, "
            "and in the worst case a verdict, may depend on the last digits of the data."
        )
    return tuple(texts)


def _number(value: complex) -> str:
    value = complex(value)
    if value.imag == 0.0:
        return f"{value.real:.4g}"
    return f"{value.real:.4g} +- {abs(value.imag):.4g}j" if value.real else f"+- {abs(value.imag):.4g}j"

"""Sensor placement: sets of sensors ranked by cost, then by the quality of the fault estimate after design."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from html import escape
from typing import Annotated, Any, Literal

import numpy as np
from annotated_types import Ge

from obsynth.analysis.diagnosis.candidate_sensors import Sensor, state_sensors
from obsynth.analysis.diagnosis.decoupled import fault_numbers
from obsynth.analysis.diagnosis.exact_fault_columns import DecoupledFaults
from obsynth.analysis.diagnosis.sensor_search import SensorSearch, Task, reached
from obsynth.errors import ObsynthError, PreconditionError, SpecError
from obsynth.files.tables import html_table, text_table
from obsynth.methods.functions import functional_filter
from obsynth.numerics.arguments import Count, arguments_checked, is_finite_number, real_vector
from obsynth.numerics.libraries import on_one_thread_if_small
from obsynth.numerics.outward import upper_text
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.transformations.delays import linear_plant
from obsynth.plants.transformations.recovery import Transformation
from obsynth.studies.threshold_sensors import ThresholdProblem

#: So many sets are returned at most by default, and so many of them designed for.
MOST_LISTED_SETS = 24


@dataclass(frozen=True)
class SensorSet:
    """A set of sensors that reaches the goal.

    Parameters
    ----------
    sensors : tuple of str
        What to measure besides.
    cost : float
        Sum of their costs.
    deviation : float or None
        Largest standard deviation of the error of an estimate after design, over the faults asked for; ``None`` where
        noise is not stated, or nothing is estimated.
    threshold, samples, sample_time : float, int, float, optional
        Of goal ``threshold``: the proved threshold of the test with the shortest delay, on so many samples.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]], C=[[1, 0]], Bf=[[1], [0]], Bd=[[0], [1]], dt=1.0, state_names=["a", "b"]
    ... )
    >>> cheapest = obsynth.sensor_sets(plant, goal="estimate-step").sets[0]
    >>> cheapest.sensors, cheapest.cost
    (('b',), 1.0)
    """

    sensors: tuple[str, ...]
    cost: float
    deviation: float | None
    threshold: float | None = None
    samples: int | None = None
    sample_time: float | None = None


@dataclass(frozen=True)
class SensorSets:
    """Sets of sensors that reach a goal, cheapest first; made by `sensor_sets`.

    Parameters
    ----------
    goal : str
        What they are for.
    sets : tuple of SensorSet
        Ranked by cost, then by deviation after design.
    exact : bool
        Whether these are all inclusion-minimal sets; otherwise each is inclusion-minimal, and others may be cheaper.
    out_of_reach : tuple of str
        What not even all candidates together reach, in words.
    may_be_lost : tuple of str
        Outputs of the plant that may fail, one at a time, without losing the goal (with no sensor added).
    lost_without : mapping of str to tuple of str
        The reverse question: by output of the plant, the faults for which the goal is lost when that sensor fails, of
        those that the plant reaches with no sensor added.
    notes : tuple of str
        What was searched; where no set is small enough, one that does it.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]], C=[[1, 0]], Bf=[[1], [0]], Bd=[[0], [1]], dt=1.0, state_names=["a", "b"]
    ... )
    >>> additions = obsynth.sensor_sets(plant, goal="estimate-step")
    >>> additions.sets[0].sensors, additions.exact
    (('b',), True)
    """

    goal: str
    sets: tuple[SensorSet, ...]
    exact: bool
    out_of_reach: tuple[str, ...]
    may_be_lost: tuple[str, ...]
    lost_without: Mapping[str, tuple[str, ...]]
    notes: tuple[str, ...]

    @property
    def best(self) -> SensorSet | None:
        """The first set, or ``None``."""
        return self.sets[0] if self.sets else None

    def rows(self) -> tuple[tuple[str, ...], ...]:
        """Return the table as texts: the header, then one row per set."""
        if any(sensor_set.threshold is not None for sensor_set in self.sets):
            tested = [("add", "cost", "threshold", "samples", "sample time (s)")]
            for sensor_set in self.sets:
                numbers = (
                    f"{sensor_set.cost:g}",
                    "none" if sensor_set.threshold is None else upper_text(sensor_set.threshold),
                    f"{sensor_set.samples}",
                    f"{sensor_set.sample_time:g}",
                )
                tested.append((", ".join(sensor_set.sensors) or "nothing", *numbers))
            return tuple(tested)
        rows = [("add", "cost", "deviation after design")]
        for sensor_set in self.sets:
            deviation = "-" if sensor_set.deviation is None else f"{sensor_set.deviation:.3g}"
            rows.append((", ".join(sensor_set.sensors) or "nothing", f"{sensor_set.cost:g}", deviation))
        return tuple(rows)

    def to_dict(self) -> dict[str, Any]:
        """Return the result as plain data."""
        return {
            "goal": self.goal,
            "exact": self.exact,
            "out_of_reach": list(self.out_of_reach),
            "may_be_lost": list(self.may_be_lost),
            "lost_without": {name: list(lost) for name, lost in self.lost_without.items()},
            "notes": list(self.notes),
            "sets": [{**vars(sensor_set), "sensors": list(sensor_set.sensors)} for sensor_set in self.sets],
        }

    def __repr__(self) -> str:
        lines = [line.rstrip() for line in text_table(self.rows())]
        return "\n".join([f"Sensors to {self.goal}:", *lines, *self.out_of_reach, *self.failures(), *self.notes])

    def failures(self) -> tuple[str, ...]:
        """Return a sentence for each output whose failure loses a fault, and one for those that may fail."""
        lost = [
            f"If {name} fails, the goal is lost for {', '.join(faults)}."
            for name, faults in self.lost_without.items()
            if faults
        ]
        free = [name for name, faults in self.lost_without.items() if not faults]
        return (*lost, *([f"You can lose any one of {', '.join(free)} and still reach the goal."] if free else []))

    def _repr_html_(self) -> str:
        texts = "".join(f"<p>{escape(text)}</p>" for text in (*self.out_of_reach, *self.failures(), *self.notes))
        return html_table(self.rows()) + texts


@arguments_checked
@on_one_thread_if_small
def sensor_sets(
    plant: DescriptorSystem | Transformation,
    *,
    goal: Literal["detect", "isolate", "estimate-step", "estimate", "threshold"] = "estimate",
    faults: Sequence[str] | None = None,
    candidates: Sequence[str] | Mapping[str, Any] | None = None,
    cost: Mapping[str, float] | None = None,
    noise: float | Mapping[str, float] | None = None,
    largest: Annotated[int, Ge(0)] | None = None,
    copies: Count = 1,
    may_fail: bool = False,
    most: Count = MOST_LISTED_SETS,
    fault: str | None = None,
    below: float | None = None,
    sample_time: float | Sequence[float] | None = None,
    test: Mapping[str, Any] | None = None,
    progress: Callable[[str], None] | None = None,
) -> SensorSets:
    """Find least sets of sensors to add for detecting, isolating or estimating faults.

    If there are few candidate sets, all are tried, and the answer is exact.  Otherwise each set found is
    inclusion-minimal (no sensor of it can be left out), and the result says so.  Every answer is confirmed on the
    decoupled plant.

    Parameters
    ----------
    plant : DescriptorSystem or Transformation
        Either time; its outputs are there already.
    goal : {"detect", "isolate", "estimate-step", "estimate", "threshold"}, optional
        What every fault asked for must be: shown free of the unknown inputs; distinguished from each other fault as
        well; estimated as a step, or whatever its time course, free of all others.  ``threshold``: the least threshold
        of ``fault`` without false alarms is at most ``below``, by `guaranteed_test`.
    faults : sequence of str, optional
        All by default.
    candidates : sequence of str or mapping, optional
        Names of states that can be measured, or a row ``(nx,)`` of C by the name of each sensor; by default every state
        that is no output.
    cost : mapping of str to float, optional
        By candidate, 1 by default.
    noise : float or mapping of str to float, optional
        Standard deviation of each candidate: sets of equal cost are then ranked by the error after design.
    largest : int, optional
        Most sensors to add; by default as many as can be needed, nd + nf + 1.
    copies : int, optional
        How often one candidate may be measured.
    may_fail : bool, optional
        Every added sensor may fail: its fault must be distinguished as well.
    most : int, optional
        Sets returned at most.
    fault, below : str, float, optional
        Of goal ``threshold``: which fault, and what its threshold must be, half of the size that is certain to raise an
        alarm.
    sample_time : float or sequence of float, optional, seconds
        Of goal ``threshold`` and a continuous plant: sample times to try.
    test : mapping, optional
        Of goal ``threshold``: other options of `guaranteed_test`; ``noise_bound`` is in deviations, of candidates too.
    progress : callable, optional
        Called with a text at the start of each stage.

    Returns
    -------
    SensorSets
        Also which outputs may be lost without losing the goal.

    Raises
    ------
    SpecError
        An unknown goal, fault or candidate, or a cost or noise that is no positive number.
    PreconditionError
        Not even all candidates together reach anything of the goal.

    References
    ----------
    .. [Krysander] M. Krysander, E. Frisk, "Sensor placement for fault diagnosis", IEEE Trans. SMC-A 38, 2008: the
       question, on structure alone.  Here the numbers decide, zeros included.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]], C=[[1, 0]], Bf=[[1], [0]], Bd=[[0], [1]], dt=1.0, state_names=["a", "b"]
    ... )
    >>> additions = obsynth.sensor_sets(plant, goal="estimate-step")
    >>> [item.sensors for item in additions.sets]
    [('b',)]
    """
    plant = linear_plant(plant)
    report_stage = progress or (lambda _: None)
    chosen = tuple(range(plant.nf)) if faults is None else tuple(fault_numbers(plant, faults, "faults"))
    if goal == "threshold":
        sensors = _candidates(plant, candidates, noise)
        return _by_threshold(plant, sensors, fault, below, sample_time, test or {}, cost or {}, largest, most)
    if not chosen:
        raise SpecError("The plant has no faults to place sensors for.", path="faults")
    sensors = _candidates(plant, candidates, noise)
    _require_positive(cost or {}, sensors, "cost", of_all=False)
    costs = [float((cost or {}).get(sensor.name, 1.0)) for sensor in sensors]
    search = SensorSearch(plant, sensors, goal, chosen, may_fail, copies)
    report_stage("asking what all candidates together reach")
    reachable = search.reachable()
    lost = [task for task in search.tasks(plant, chosen) if task not in reachable]
    if not reachable:
        raise PreconditionError(
            f"Not even all {len(sensors)} candidates together suffice for any fault: to {goal} is not possible"
            f"{' with unknown inputs that may do anything' if plant.nd else ''}. Give other candidates"
            f"{'' if goal == 'detect' else ', or a weaker goal'}"
            f"{', or bounds of the unknown inputs in a guaranteed-test (goal threshold)' if plant.nd else ''}.",
            condition="sensors",
            signals=tuple(plant.fault_names[i] for i in chosen),
        )
    report_stage("searching for least sets")
    bound = largest if largest is not None else min(plant.nd + len(chosen) + 1 + may_fail, len(sensors) * copies)
    sets, exact = search.minimal_sets(reachable, bound, most)
    notes = [_note(search, exact, bound, most, len(sets))]
    if not sets:
        greedy = search.greedy_set(reachable)
        if greedy is not None and largest is not None and len(greedy) > largest:
            # More than asked for: said, not given.
            notes.append(f"One of {len(greedy)} does: {', '.join(sensors[i].name for i in greedy)}.")
        else:
            sets, exact = ([], exact) if greedy is None else ([greedy], False)
    report_stage("designing for each set")
    ranked = _ranked(search, sets, costs, noise is not None and goal.startswith("estimate"))
    failing = _lost_without(plant, search.had, range(plant.ny))
    may_be_lost = tuple(name for name, faults in failing.items() if len(search.had) == len(reachable) and not faults)
    out_of_reach = []
    for task in lost:
        beside = ", ".join(plant.fault_names[j] for j in task.beside)
        ending = f" (from {beside})." if beside else "."
        out_of_reach.append(f"{plant.fault_names[task.fault]}: not possible with all candidates{ending}")
    return SensorSets(goal, ranked, exact, tuple(out_of_reach), may_be_lost, failing, tuple(notes))


def _by_threshold(
    plant: DescriptorSystem,
    sensors: tuple[Sensor, ...],
    fault: str | None,
    below: float | None,
    sample_time: Any,
    test: Mapping[str, Any],
    cost: Mapping[str, float],
    largest: int | None,
    most: int,
) -> SensorSets:
    """Return the cheapest sets with which the least threshold of a fault is at most ``below``."""
    if fault is None or not (is_finite_number(below) and float(below or 0.0) > 0.0):
        raise SpecError(
            "goal threshold needs fault (--fault) and below (--below), a positive number in the unit of the fault.",
            path="below",
        )
    fault_numbers(plant, [fault], "fault")
    if any(sensor.deviation is None for sensor in sensors):
        raise SpecError("goal threshold needs the noise of each candidate (noise, --set noise).", path="noise")
    times = [] if sample_time is None else list(np.atleast_1d(np.asarray(sample_time, dtype=np.float64)))
    if bool(times) == plant.is_discrete:
        raise SpecError("sample_time is for continuous plants, which need one.", path="sample_time")
    _require_positive(cost, sensors, "cost", of_all=False)
    costs = [float(cost.get(sensor.name, 1.0)) for sensor in sensors]
    size = float(below or 0.0)
    problem = ThresholdProblem(plant, fault, size, sensors, costs, tuple(map(float, times)), test)
    everything = tuple(range(len(sensors)))
    if problem.best(everything) is None:
        raise PreconditionError(
            f"Not even all {len(sensors)} candidates together suffice for a threshold of {size:g}: the least is "
            f"{problem.least(everything):.4g}. Give other candidates, sample times, or a larger size.",
            condition="sensors",
            signals=(fault,),
        )
    sets = problem.minimal_sets(largest, most)
    rows = tuple(
        SensorSet(
            tuple(sensors[i].name for i in chosen),
            sum(costs[i] for i in chosen),
            None,
            made.threshold,
            made.samples,
            made.linear[0].dt,
        )
        for chosen, made in sets
    )
    note = "Cheapest first; of each set the test with the shortest delay. More sensors never raise a least threshold."
    return SensorSets(f"find {fault} by a threshold of {size:g}", rows, len(sets) < most, (), (), {}, (note,))


def _candidates(
    plant: DescriptorSystem, candidates: Sequence[str] | Mapping[str, Any] | None, noise: Any
) -> tuple[Sensor, ...]:
    if isinstance(candidates, Mapping):
        zero = (np.zeros(plant.nu), np.zeros(plant.nd), np.zeros(plant.nf))
        sensors: tuple[Sensor, ...] = ()
        for name, row in candidates.items():
            try:
                sensors += (Sensor(str(name), real_vector(row, plant.nx, str(name)), *zero),)
            except SpecError:
                raise SpecError(f"{name}: give a row of {plant.nx} numbers for C.", path="candidates") from None
    else:
        listed = None if candidates is None else list(candidates)
        unknown = [name for name in listed or () if name not in plant.state_names]
        if unknown:
            raise SpecError(f"{', '.join(map(repr, unknown))}: no such state.", path="candidates")
        sensors = state_sensors(plant, listed)
    if noise is None:
        return sensors
    levels = noise if isinstance(noise, Mapping) else {sensor.name: noise for sensor in sensors}
    _require_positive(levels, sensors, "noise", of_all=True)
    return tuple(replace(sensor, deviation=float(levels[sensor.name])) for sensor in sensors)


def _require_positive(numbers: Mapping[str, Any], sensors: Sequence[Sensor], argument: str, *, of_all: bool) -> None:
    names = [sensor.name for sensor in sensors]
    unknown = [name for name in numbers if name not in names]
    missing = [name for name in names if name not in numbers] if of_all else []
    wrong = [name for name, value in numbers.items() if not (is_finite_number(value) and value > 0.0)]
    if unknown or missing or wrong:
        raise SpecError(
            f"{argument}: unknown {unknown}, missing {missing}, not a positive number {wrong}.", path=argument
        )


def _note(search: SensorSearch, exact: bool, bound: int, most: int, count: int) -> str:
    tried = f"at most {bound} of {len(search.sensors)} candidates"
    if exact and bound == 0 and count:
        return "There are no further sensors to try; the present ones suffice."
    if exact:
        return (
            f"These are all minimal sets of {tried}."
            if count
            else f"No set of {tried} reaches the goal: all were tried."
        )
    if count >= most:
        return f"The first {most} inclusion-minimal sets found, the most sensitive at a generic point first."
    plain = search.goal == "detect"
    size = f"; a least set has at most {search.plant.nd + 1} sensors for each fault" if plain else ""
    return f"Too many sets to try all: each one given is inclusion-minimal, others may be cheaper{size}."


def _ranked(
    search: SensorSearch, sets: Sequence[tuple[int, ...]], costs: Sequence[float], with_design: bool
) -> tuple[SensorSet, ...]:
    """Return the sets by cost and largest deviation after design, with the walks that the first got by default."""
    rates: dict[str, float] | None = None
    rows = []
    for chosen in sets:
        names, deviation = tuple(search.sensors[i].name for i in chosen), None
        if with_design:
            plant = search.equipped(chosen)
            faults = [plant.fault_names[i] for i in search.faults]
            with suppress(ObsynthError):
                made = functional_filter(plant, faults=faults, fault_rate=rates)
                deviation = float(np.max(made.certificate.matrices["deviations"][:, 1]))
                if rates is None and made.options["fault_rate_found"] is not None:
                    rates = dict(zip(made.observer.fault_names, made.options["fault_rate_found"], strict=True))
        rows.append(SensorSet(names, sum(costs[i] for i in chosen), deviation))
    return tuple(sorted(rows, key=lambda row: (row.cost, np.inf if row.deviation is None else row.deviation)))


def _lost_without(plant: DescriptorSystem, had: Sequence[Task], outputs: Sequence[int]) -> dict[str, tuple[str, ...]]:
    """Return the faults that are lost without each of some outputs, one at a time, of what the plant reaches.

    Outputs that may fail together may fail alone: halves are asked about before what is in them."""
    if not had or not outputs:
        return {}
    decoupled = DecoupledFaults(_without(plant, outputs), exactly=False)
    if len(outputs) == 1:
        lost = (plant.fault_names[task.fault] for task in had if not reached(decoupled, task))
        return {plant.output_names[outputs[0]]: tuple(dict.fromkeys(lost))}
    if all(reached(decoupled, task) for task in had):
        return {plant.output_names[i]: () for i in outputs}
    half = len(outputs) // 2
    return {**_lost_without(plant, had, outputs[:half]), **_lost_without(plant, had, outputs[half:])}


def _without(plant: DescriptorSystem, outputs: Sequence[int]) -> DescriptorSystem:
    """Return a plant without some of its outputs."""
    remaining = [i for i in range(plant.ny) if i not in outputs]
    gone = {plant.output_names[i] for i in outputs}
    return plant.replace(
        C=plant.C[remaining],
        D=plant.D[remaining],
        Dd=plant.Dd[remaining],
        Df=plant.Df[remaining],
        Dw=plant.Dw[remaining],
        output_names=[plant.output_names[i] for i in remaining],
        scales={name: value for name, value in plant.scales.items() if name not in gone},
        units={},
        operating_point={},
    )

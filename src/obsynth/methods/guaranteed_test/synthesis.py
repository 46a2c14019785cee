"""The weights of the least threshold, by linear programmes whose answers are then proved."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

import numpy as np

from obsynth.analysis.conditions import require_all
from obsynth.errors import ObsynthError, SolverError
from obsynth.methods.guaranteed_test.beside import observer_beside
from obsynth.methods.guaranteed_test.conditions import conditions, told
from obsynth.methods.guaranteed_test.options import Asked
from obsynth.methods.guaranteed_test.problem import (
    COURSES,
    MOST_STATES,
    WITHIN,
    Problem,
    delay_in_samples,
    observer_of,
    problem_of,
    rounding_of,
)
from obsynth.methods.guaranteed_test.programs import Optimum, largest_hidden_fault
from obsynth.methods.guaranteed_test.proofs import (
    Repaired,
    proved_least,
    proved_threshold,
    repaired_multipliers,
    repaired_point,
)
from obsynth.methods.guaranteed_test.tolerant import Beside, mean_over_record, with_tolerances
from obsynth.methods.guaranteed_test.windows import Window
from obsynth.methods.method import Synthesis
from obsynth.numerics.arrays import FloatArray
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.results.design import Certificate
from obsynth.simulation.scenario import Scenario

#: A threshold below this share of what all bounds could do is tried as an exact zero.
ZERO_THRESHOLD = 1e-9
#: The table of samples against threshold in a certificate.
TRADE_OFF = "trade_off"


def synthesise(
    plant: DescriptorSystem, asked: Asked, *, progress: Callable[[str], None], scenario: Scenario | None = None
) -> Synthesis:
    """Return weights, observer and certificate; with a scenario the threshold over the tolerances of the plant's
    constants is least in the mean over it, without its faults."""
    if scenario is None:
        return _synthesised(plant, asked, progress, None)
    try:
        beside = observer_beside(asked, scenario, plant, progress)
    except ObsynthError as error:
        found = _synthesised(plant, asked, progress, None)
        return replace(found, notes=(*found.notes, f"There is no threshold over the tolerances: {error}"))
    return _synthesised(plant, asked, progress, beside)


def _synthesised(
    plant: DescriptorSystem, asked: Asked, progress: Callable[[str], None], beside: Beside | None
) -> Synthesis:
    problem = problem_of(plant, asked)
    require_all(conditions(plant, asked, with_windows=False))
    condition, lag = told(problem, asked)
    condition.require()
    problem = replace(problem, question=replace(problem.question, lag=lag))
    given = asked.before + asked.after if asked.after is not None else asked.samples
    most = problem.ladder()[-1] if given == "auto" else int(given)
    progress(f"solving linear programmes of up to {most} samples, which take {in_time(plant.nx, most)}")
    samples, table, found = chosen_samples(problem, asked, beside)
    progress(f"proving the threshold on {samples} samples")
    window = problem.window(samples)
    shipped = proved_test(window, found)
    return _synthesis(problem, asked, window, shipped, table, beside)


def chosen_samples(problem: Problem, asked: Asked, beside: Beside | None) -> tuple[int, FloatArray, Optimum]:
    """Return the number of samples, the table of those tried with their thresholds ``(tried, 2)``, and the optimum.

    With tolerances the table has a third column, the mean threshold over the record, which decides, and the
    multipliers are those that make it least.
    """
    given = asked.before + asked.after if asked.after is not None else asked.samples
    tried = problem.ladder() if given == "auto" else (int(given),)
    if beside is not None:
        tried = tuple(rung for rung in tried if rung <= beside.longest()) or tried[:1]
    found: list[Optimum] = []
    for rung in reversed(tried):
        # More samples never raise a threshold: where there is no test, there is none on fewer.
        hopeless = bool(found) and not np.isfinite(found[0].size)
        found.insert(0, Optimum(np.inf) if hopeless else largest_hidden_fault(problem.window(rung)))
    table = np.array([[rung, optimum.size] for rung, optimum in zip(tried, found, strict=True)])
    if not np.isfinite(table[-1, 1]):
        raise SolverError(
            f"HiGHS finds no test on {tried[-1]} samples, but there is one: inconclusive. Other units may help."
        )
    if beside is not None:
        wider = [
            largest_hidden_fault(with_tolerances(problem.window(rung), beside)) if np.isfinite(own.size) else own
            for rung, own in zip(tried, found, strict=True)
        ]
        table = np.column_stack([table, [optimum.size for optimum in wider]])
        found = [replace(own, multipliers=other.multipliers) for own, other in zip(found, wider, strict=True)]
    # With tolerances more samples may be worse.
    good = table[:, -1] <= (1.0 + WITHIN) * np.min(table[:, -1])
    place = int(np.flatnonzero(good)[0])
    return int(table[place, 0]), table, found[place]


#: A programme of so many equations took so many seconds, and others about this power of their ratio as many.
MEASURED_EQUATIONS, MEASURED_SECONDS, TIME_GROWTH = 1800, 2.3, 2.3


def in_time(states: int, samples: int) -> str:
    """Return about how long the linear programme of a window takes, in words."""
    seconds = MEASURED_SECONDS * (states * samples / MEASURED_EQUATIONS) ** TIME_GROWTH
    if seconds < SHORT_SECONDS:
        return "a few seconds"
    return f"about {seconds:.0f} s" if seconds < MINUTES else f"about {seconds / 60.0:.0f} minutes"


#: Seconds below which no number is given, and from which on minutes are.
SHORT_SECONDS, MINUTES = 5.0, 120.0


class Shipped:
    """What is proved of a window: multipliers, a witness, and both claims."""

    def __init__(self, test: Repaired, threshold: float, witness: Repaired | None, least: float) -> None:
        self.test, self.threshold, self.witness, self.least = test, threshold, witness, least


def proved_test(window: Window, found: Optimum) -> Shipped:
    """Return the proved test next to a solution; raise `SolverError` where nothing can be proved."""
    if found.multipliers is None or found.point is None:
        raise SolverError("The linear programme is unbounded on this window: the result is inconclusive.")
    rows, columns = window.scales
    # What all bounds together could do to these weights.
    able = float(np.abs(window.matrix[:, window.bounded]).T @ np.abs(found.multipliers) @ window.bar[window.bounded])
    if found.size <= ZERO_THRESHOLD * able and not window.standing:
        exact = repaired_multipliers(window, found.multipliers, refine=True, exact_zero=True)
        if exact is not None:
            return Shipped(exact.with_room(rows), 0.0, None, 0.0)
    test = repaired_multipliers(window, found.multipliers, refine=True)
    if test is None:
        raise SolverError(
            f"Weights of {window.question.samples} samples were found, but double precision cannot tell how far they "
            "are from exact ones: the result is inconclusive. Fewer samples, or signals in units near one, help."
        )
    test = test.with_room(rows)
    witness = repaired_point(window, found.point, refine=True)
    witness = None if witness is None else witness.with_room(columns)
    least = np.nan if witness is None else proved_least(window, witness)
    return Shipped(test, proved_threshold(window, test), witness, least)


def _synthesis(
    problem: Problem, asked: Asked, window: Window, shipped: Shipped, table: FloatArray, beside: Beside | None
) -> Synthesis:
    on_y, on_u, delay = window.weights(shipped.test.values)
    observer = observer_of(window, shipped.test.values, None if beside is None else beside.observer)
    question, plant = window.question, problem.plant
    matrices = {
        "multipliers": shipped.test.values,
        "multiplier_radius": shipped.test.radius,
        "rounding": rounding_of(window, shipped.test.values, shipped.test.radius),
        TRADE_OFF: table,
    }
    claims = {
        "threshold": shipped.threshold,
        "surely_found": 2.0 * shipped.threshold,
        "delay": delay_in_samples(window, delay) * plant.dt,
    }
    if shipped.witness is not None:
        matrices |= {"witness": shipped.witness.values, "witness_radius": shipped.witness.radius}
    if np.isfinite(shipped.least):
        claims["least"] = shipped.least
    if beside is not None:
        matrices |= {"state_tracking": beside.T, "state_rows": beside.T0, "record": beside.record}
        mean = mean_over_record(window, observer, shipped.test.values, beside.T, beside.T0, beside.record)
        claims["mean_threshold"] = mean
    options: dict[str, Any] = {option.name: getattr(asked, option.name) for option in fields(Asked)} | {
        "samples": question.samples,
        "lag": question.lag if question.course in ("any", "ramp", "rate") else None,
        "fault": plant.fault_names[question.fault],
    }
    return Synthesis(
        options,
        {"h": on_y, "g": on_u},
        observer,
        Certificate(matrices, claims),
        notes=tuple(_notes(problem, asked, window, shipped, table, claims.get("mean_threshold"))),
    )


def _notes(
    problem: Problem, asked: Asked, window: Window, shipped: Shipped, table: FloatArray, mean: float | None
) -> list[str]:
    question = window.question
    words = []
    if shipped.threshold == 0.0:
        words.append(
            "No disturbance and no noise has an effect on the residual: compare it with the effect of rounding."
        )
    elif np.isfinite(shipped.least):
        words.append(
            f"The threshold is {shipped.threshold:.9g}, and no function of {question.samples} samples has one below "
            f"{shipped.least:.9g}: they differ by {shipped.threshold - shipped.least:.1e}. A fault of twice "
            "that is certain to raise an alarm."
        )
        if not window.twice_is_hidden:
            words.append(
                "As states have bounds, the latter is about intervals: no function estimates the fault to within "
                "less. It is "
                "not claimed that none detects every fault of less than twice that size: bounds of states may make "
                "that possible."
            )
    else:
        words.append("That there is no smaller threshold could not be proved on these numbers: least is not claimed.")
    words.append(f"The course {question.course} is {COURSES[question.course]}.")
    if question.course == "any" and asked.lag is None:
        words.append(
            f"The least lag with which {problem.plant.fault_names[question.fault]} can be estimated is {question.lag}."
        )
    if mean is not None:
        words.append(
            f"Over the tolerances of the constants the threshold follows the signals ({mean:.4g} in the mean over the "
            "scenario, for which the weights are made); that of the nominal plant is never above it, and no function "
            "of these samples has one below least over the tolerances either. The size that is certain to be detected "
            "is that of the nominal plant: over the tolerances a fault of twice the threshold of its row may be "
            "needed, and more where they move what the fault does."
        )
    elif problem.plant.uncertainty is not None:
        words.append(
            "The threshold is that of the nominal plant: tolerances of its constants are not in it (give a scenario)."
        )
    if len(table) > 1:
        listed = ", ".join(f"{int(row[0])}: {row[-1]:.4g}" for row in table)
        words.append(f"Samples and thresholds (by linear programmes; that of {question.samples} is proved): {listed}.")
        if problem.plant.nx * table[-1, 0] * 2 > MOST_STATES:
            words.append(
                f"The table ends at {int(table[-1, 0])} samples, as its programmes grow with samples times states: "
                f"twice as many take {in_time(problem.plant.nx, 2 * int(table[-1, 0]))}. Give samples for more."
            )
    return words

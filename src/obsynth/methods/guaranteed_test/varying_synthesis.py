"""The weights of the least threshold at each row of a plant whose matrices change with k."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

import numpy as np

from obsynth.analysis.conditions import Condition, require_all
from obsynth.errors import SolverError, SpecError
from obsynth.methods.guaranteed_test.conditions import bounds_stated, fault_named, has_test, hidden, told_condition
from obsynth.methods.guaranteed_test.options import Asked
from obsynth.methods.guaranteed_test.problem import COURSES, WITHIN, delay_in_samples, rounding_of
from obsynth.methods.guaranteed_test.programs import largest_hidden_fault
from obsynth.methods.guaranteed_test.proofs import proved_ray
from obsynth.methods.guaranteed_test.synthesis import TRADE_OFF, Shipped, proved_test
from obsynth.methods.guaranteed_test.varying import (
    Programmes,
    VaryingProblem,
    disturbance_names,
    missing_varying_bounds,
    observer_of_rows,
    varying_problem,
)
from obsynth.methods.guaranteed_test.windows import Window
from obsynth.methods.method import Synthesis
from obsynth.numerics.arrays import FloatArray
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem
from obsynth.results.design import Certificate


def varying_conditions(plant: TimeVaryingDescriptorSystem, asked: Asked) -> tuple[Condition, ...]:
    """Return the conditions: a fault is named, bounds are stated, some row has a window that tells the fault."""
    named = asked.fault is not None or plant.nq == 1
    fault = fault_named(named, plant.parameter_names, "the plant has no parameter (Phi, Psi).")
    stated = bounds_stated(list(missing_varying_bounds(plant, asked)))
    if not (fault.holds and stated.holds):
        return fault, stated
    return fault, stated, _told(varying_problem(plant, asked), asked)[0]


def _given_samples(asked: Asked) -> Any:
    return asked.before + asked.after if asked.after is not None else asked.samples


def _told(problem: VaryingProblem, asked: Asked) -> tuple[Condition, int]:
    """Return the condition that some row has a window that tells the fault, and the lag with which it does."""
    given = _given_samples(asked)
    samples = problem.ladder()[-1] if given == "auto" else int(given)
    tried = problem.tried(samples)
    if not tried:
        raise SpecError(
            f"The plant's horizon of {problem.plant.horizon} steps has no window of {samples} samples (k = 1 is the "
            "first): give fewer samples, or extend the model.",
            path="method.options.samples",
        )
    lags = [problem.question.lag]
    if asked.course == "any" and asked.lag is None:
        lags = list(range(min(problem.plant.nx + 2, samples)))
    for lag in lags:
        windows = [problem.window(row, samples, lag) for row in tried]
        if any(has_test(window) for window in windows):
            return told_condition(windows[0], True, ""), lag
    return told_condition(windows[0], False, _why(windows[0], tried[0])), lags[-1]


def _why(window: Window, row: int) -> str:
    fault = window.model.fault_names[window.question.fault]
    point = proved_ray(window)
    if point is None:
        return (
            f"no weights of {window.question.samples} samples respond to {fault} and to nothing that is free at the "
            "rows that were tried."
        )
    return f"{hidden(window, point)} (proved for the window that ends at k = {row}: every equation holds exactly)."


def synthesise_varying(plant: TimeVaryingDescriptorSystem, asked: Any, *, progress: Callable[[str], None]) -> Synthesis:
    """Return weights by row, observer and certificate, not yet verified."""
    problem = varying_problem(plant, asked)
    require_all(varying_conditions(plant, asked)[:2])
    condition, lag = _told(problem, asked)
    condition.require()
    problem = replace(problem, question=replace(problem.question, lag=lag))
    given = _given_samples(asked)
    progress("searching for the least number of samples")
    samples, table = _chosen_samples(problem, given, lag)
    programmes = Programmes.of(problem, samples, lag)
    progress(f"solving and proving {len(programmes.windows)} linear programmes, one for each different window")
    shipped = [_solved(window) for window in programmes.windows]
    told = np.array([found is not None for found in shipped])
    if not told[programmes.of_row].any():
        raise SolverError(
            f"HiGHS finds no test on {samples} samples at any row, but there is one: inconclusive. Other units may "
            "help."
        )
    return _synthesis(problem, asked, programmes, shipped, told, table)


def _solved(window: Window) -> Shipped | None:
    """Return the proved test of a window; `None` where there is none."""
    found = largest_hidden_fault(window)
    return proved_test(window, found) if np.isfinite(found.size) else None


def _chosen_samples(problem: VaryingProblem, given: Any, lag: int) -> tuple[int, FloatArray]:
    """Return the number of samples, and those tried with the worst of the thresholds at some rows ``(tried, 2)``."""
    tried = problem.ladder() if given == "auto" else (int(given),)
    # Rows that have a window of every length.
    rows = problem.tried(tried[-1])
    table = np.array(
        [[rung, max(largest_hidden_fault(problem.window(row, rung, lag)).size for row in rows)] for rung in tried]
    )
    if not np.isfinite(table[:, 1]).any():
        # No length tells the fault at all of these rows: the longest tells it at most of them.
        return tried[-1], table
    good = table[:, 1] <= (1.0 + WITHIN) * np.min(table[:, 1])
    return int(table[np.flatnonzero(good)[0], 0]), table


def _synthesis(
    problem: VaryingProblem,
    asked: Any,
    programmes: Programmes,
    shipped: list[Shipped | None],
    told: np.ndarray,
    table: FloatArray,
) -> Synthesis:
    plant, windows = problem.plant, programmes.windows
    empty = [np.zeros(window.rows) for window in windows]
    multipliers = [zero if one is None else one.test.values for one, zero in zip(shipped, empty, strict=True)]
    radius = [zero if one is None else one.test.radius for one, zero in zip(shipped, empty, strict=True)]
    thresholds = np.array([np.inf if one is None else one.threshold for one in shipped])
    leasts, points, away = [], [], []
    for window, one, row in zip(windows, shipped, programmes.first, strict=True):
        witness = None if one is None or not problem.continues(window, row) else one.witness
        least = np.nan if one is None or not problem.continues(window, row) else one.least
        leasts.append(least)
        points.append(np.zeros(1) if witness is None else witness.values)
        away.append(np.zeros(1) if witness is None else witness.radius)
    of_row = np.where(told[programmes.of_row], programmes.of_row, -1)
    matrices = {
        "multipliers": _padded(multipliers),
        "multiplier_radius": _padded(radius),
        "rounding": np.array(
            [rounding_of(window, *both) for window, *both in zip(windows, multipliers, radius, strict=True)]
        ),
        "witness": _padded(points),
        "witness_radius": _padded(away),
        "thresholds": thresholds[:, None],
        "leasts": np.array(leasts)[:, None],
        "programmes": of_row.astype(np.float64)[:, None],
        TRADE_OFF: table,
    }
    used = sorted(set(of_row[of_row >= 0].tolist()))
    question = windows[0].question
    claims = {
        "threshold": float(thresholds[used].max()),
        "surely_found": 2.0 * float(thresholds[used].max()),
        "delay": delay_in_samples(windows[0], 0) * plant.dt,
    }
    known = np.array(leasts)[used]
    if np.isfinite(known).any():
        claims["least"] = float(np.nanmax(known))
    options: dict[str, Any] = {option.name: getattr(asked, option.name) for option in fields(Asked)} | {
        "samples": question.samples,
        "lag": question.lag if question.course in ("any", "ramp", "rate") else None,
        "fault": plant.parameter_names[question.fault],
    }
    observer = observer_of_rows(problem, programmes, told, multipliers)
    notes = tuple(_notes(problem, programmes, claims, thresholds, np.array(leasts), of_row))
    return Synthesis(options, {"weights": observer.weights}, observer, Certificate(matrices, claims), notes=notes)


def _padded(rows: list[FloatArray]) -> FloatArray:
    width = max(len(row) for row in rows)
    return np.array([np.pad(row, (0, width - len(row))) for row in rows])


def _notes(
    problem: VaryingProblem,
    programmes: Programmes,
    claims: dict[str, float],
    thresholds: FloatArray,
    leasts: FloatArray,
    of_row: np.ndarray,
) -> Any:
    question, without = programmes.windows[0].question, int(np.sum(of_row < 0))
    used = thresholds[sorted(set(of_row[of_row >= 0].tolist()))]
    forever = problem.plant.horizon is None
    rows = "every row from" if forever else f"the {len(of_row)} rows from"
    yield (
        f"{len(thresholds)} linear programme(s) serve {rows} k = {question.samples} on, each proved: thresholds from "
        f"{used.min():.6g} to {used.max():.6g}, of which the largest is claimed."
    )
    if without:
        yield (
            f"{without} rows have no verdict: no weights of {question.samples} samples respond to the fault and to "
            "nothing that is free."
        )
    if "least" not in claims:
        yield "That there is no smaller threshold is not claimed: equations after the window may reduce it."
    elif np.isnan(leasts).any():
        yield "At some rows it is not claimed that there is no smaller threshold."
    yield f"The course {question.course} is {COURSES[question.course]}."
    yield (
        f"A fault of k acts on the way to sample k + 1; {', '.join(disturbance_names(problem.plant))} stand for mu(k) "
        "in the equations."
    )

"""Synthesis of the guaranteed test: weights of the least threshold, by linear programmes whose solutions are proved."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np

from obsynth.analysis.existence.condition import require_all
from obsynth.errors import ObsynthError, PreconditionError, SolverError, counted
from obsynth.methods.designing import design
from obsynth.methods.guaranteed_test.existence import conditions, detectability
from obsynth.methods.guaranteed_test.options import TestOptions
from obsynth.methods.guaranteed_test.problem import (
    COURSES,
    MOST_WINDOW_STATES,
    WITHIN,
    WindowProblem,
    WindowProgrammes,
    problem_of,
    samples_given,
)
from obsynth.methods.guaranteed_test.programs import Optimum, largest_hidden_fault
from obsynth.methods.guaranteed_test.proofs import proved_least, proved_threshold, repaired_multipliers, repaired_point
from obsynth.methods.guaranteed_test.tolerant import (
    Beside,
    mean_over_record,
    noisy_as_bounded,
    over_the_box,
    thresholds_over_record,
    with_tolerances,
)
from obsynth.methods.guaranteed_test.window_models import TestProblem, disturbance_names
from obsynth.methods.guaranteed_test.window_observers import (
    delay_in_samples,
    observer_of,
    observer_of_rows,
    rounding_of,
)
from obsynth.methods.guaranteed_test.windows import Window, disturbances_in_words
from obsynth.methods.method import Synthesis
from obsynth.methods.tracking import tracking_of
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.outward import lower_text, upper_text
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem
from obsynth.proofs.nearby_solutions import NearbySolution
from obsynth.results.design import Certificate
from obsynth.simulation.linear import scenario_runs, scenario_stepper
from obsynth.simulation.scenario import Scenario
from obsynth.verification.over_tolerances.error_structure import error_structure

#: If the threshold is below this share of the effect of all bounds together, weights with an exact zero are tried.
ZERO_THRESHOLD = 1e-9

#: Factor of thresholds for moving disturbances, whose columns differ by rounding on another machine.
COLUMN_ROOM = 1.0 + 1e-9

#: Name of the table of numbers of samples and thresholds in a certificate.
TRADE_OFF = "trade_off"

#: Method of the observer that runs beside a test; faults do not affect its state estimate.
BESIDE = "fault-estimation-filter"

#: Largest number of samples of the scenario over which thresholds are compared.
MOST_COMPARED_SAMPLES = 500

#: A programme with so many equations took so many seconds; times grow with this power of the number of equations.
MEASURED_EQUATIONS, MEASURED_SECONDS, TIME_GROWTH = 1800, 2.3, 2.3

#: Shorter times are printed without a number, and longer ones than the second number in minutes.
SHORT_SECONDS, MINUTES = 5.0, 120.0


def synthesise(
    plant: DescriptorSystem | TimeVaryingDescriptorSystem,
    options: TestOptions,
    *,
    progress: Callable[[str], None],
    scenario: Scenario | None = None,
) -> Synthesis:
    """Return weights, observer and certificate.

    With a scenario, the weights minimise the mean over this scenario, without its faults, of the threshold that is
    valid over the tolerances of the plant's constants.
    """
    beside, notes = None, []
    if scenario is not None and isinstance(plant, DescriptorSystem):
        try:
            beside = _observer_beside(options, scenario, plant, progress)
        except ObsynthError as error:
            notes.append(f"There is no threshold over the tolerances: {error}")
    problem = problem_of(plant, options)
    require_all(conditions(plant, options, with_windows=False))
    condition, lag = detectability(problem, options)
    condition.require()
    problem = replace(problem, test_problem=replace(problem.test_problem, lag=lag))
    stated_samples = samples_given(options)
    most = problem.ladder()[-1] if stated_samples == "auto" else int(stated_samples)
    progress(f"solving linear programmes of up to {most} samples, which take {in_time(plant.nx, most)}")
    samples, table, known = chosen_samples(problem, options, beside)
    programmes = WindowProgrammes.of(problem, samples)
    per_window = f", one for each of {len(programmes.windows)} different windows" if len(programmes.windows) > 1 else ""
    progress(f"proving the threshold on {counted(samples, 'sample')}{per_window}")
    shipped = []
    for window, row in zip(programmes.windows, programmes.first, strict=True):
        optimum = known.get(row) or largest_hidden_fault(window)
        shipped.append(proved_test(window, optimum) if np.isfinite(optimum.size) else None)
    if not any(shipped[programme] for programme in programmes.of_row):
        raise SolverError(
            f"HiGHS finds no test on {counted(samples, 'sample')} at any row, but there is one: inconclusive. Other "
            "units may help."
        )
    synthesis = _synthesis(problem, options, programmes, shipped, table, beside)
    return replace(synthesis, notes=(*synthesis.notes, *notes))


def _observer_beside(
    options: TestOptions, scenario: Scenario, plant: DescriptorSystem, progress: Callable[[str], None]
) -> Beside:
    """Return the observer of the state beside the test, with its estimates and thresholds on a scenario without
    faults."""
    if options.state_bounds or options.initial_bounds:
        raise PreconditionError(
            "Bounds of states and tolerances do not go together: leave state_bounds and initial_bounds out.",
            condition="tolerances",
        )
    if options.exact:
        raise PreconditionError(
            "exact is for an exact model: leave it out for a threshold over the tolerances.", condition="tolerances"
        )
    if list(problem_of(plant, options).bounds.middles):
        raise PreconditionError(
            "Bounds [low, high] and tolerances do not go together: the effect of the constants on the middle is not "
            "known. Give the larger end.",
            condition="tolerances",
        )
    progress("designing the observer of the state beside the test")
    own = design(plant, BESIDE)
    affine = over_the_box(plant, options.disturbance)
    tracking = tracking_of(own, affine)
    observer = own.linear[1]
    quiet = scenario.replace(faults={}, sensors={}, horizon=min(scenario.horizon, MOST_COMPARED_SAMPLES * plant.dt))
    nu = plant.nu
    start = np.array([quiet.initial_state.get(name, 0.0) for name in plant.state_names])
    _, outputs, inputs, _, _ = scenario_runs(
        *scenario_stepper(own.linear[0], quiet, start), (nu, nu + plant.nf), [quiet.seed]
    )
    record = np.hstack([inputs[:, 0], outputs[:, 0]])
    problem = problem_of(plant, options)
    noisy = noisy_as_bounded(problem.window(problem.shortest + 1))
    bounded = replace(affine, plant=noisy)
    sizes = affine.disturbance_bounds(problem.bounds.disturbance)
    structure = error_structure(observer, bounded, tracking, sizes, 1.0, states=True)
    thresholds, states = thresholds_over_record(structure, observer, record, varying=affine.box.variation == "varying")
    n = plant.nx
    return Beside(observer, tracking.T, tracking.T0[:n], affine, record, states[:, :n], thresholds.total[0])


def chosen_samples(
    problem: WindowProblem, options: TestOptions, beside: Beside | None
) -> tuple[int, FloatArray, Mapping[int, Optimum]]:
    """Return the number of samples, the tried numbers with their thresholds ``(tried, 2)``, and the optima by row.

    If each row has a window of its own, some rows are tried, and the largest threshold counts.  With tolerances the
    table has a third column, the mean threshold over the record, by which the number is chosen; the multipliers then
    minimise that mean.
    """
    stated_samples = samples_given(options)
    tried = problem.ladder() if stated_samples == "auto" else (int(stated_samples),)
    if beside is not None:
        tried = tuple(rung for rung in tried if rung <= beside.longest()) or tried[:1]
    # Only rows that have a window of every tried length.
    rows = problem.tried(tried[-1])
    optima_by_length: list[list[Optimum]] = []
    for rung in reversed(tried):
        # More samples never raise a threshold: if there is no test on these, there is none on fewer.
        hopeless = bool(optima_by_length) and problem.horizon is None and not np.isfinite(optima_by_length[0][0].size)
        windows = (problem.window(rung, row=row) for row in rows)
        optima_by_length.insert(
            0, [Optimum(np.inf) if hopeless else largest_hidden_fault(window) for window in windows]
        )
    table = np.array(
        [[rung, max(optimum.size for optimum in optima)] for rung, optima in zip(tried, optima_by_length, strict=True)]
    )
    if not np.isfinite(table[:, 1]).any():
        if problem.horizon is None:
            raise SolverError(
                f"HiGHS finds no test on {tried[-1]} samples, but there is one: inconclusive. Other units may help."
            )
        # No length gives a test at all of these rows; the longest one gives a test at the most of them.
        return tried[-1], table, dict(zip(rows, optima_by_length[-1], strict=True))
    if beside is not None:
        wider = [
            largest_hidden_fault(with_tolerances(problem.window(rung), beside)) if np.isfinite(own.size) else own
            for rung, (own,) in zip(tried, optima_by_length, strict=True)
        ]
        table = np.column_stack([table, [optimum.size for optimum in wider]])
        optima_by_length = [
            [replace(own, multipliers=more.multipliers)] for (own,), more in zip(optima_by_length, wider, strict=True)
        ]
    # With tolerances, more samples may raise the mean threshold.
    good = table[:, -1] <= (1.0 + WITHIN) * np.min(table[:, -1])
    place = int(np.flatnonzero(good)[0])
    return tried[place], table, dict(zip(rows, optima_by_length[place], strict=True))


def in_time(states: int, samples: int) -> str:
    """Return a text on the approximate time that the linear programme of a window takes."""
    seconds = MEASURED_SECONDS * (states * samples / MEASURED_EQUATIONS) ** TIME_GROWTH
    if seconds < SHORT_SECONDS:
        return "a few seconds"
    return f"about {seconds:.0f} s" if seconds < MINUTES else f"about {seconds / 60.0:.0f} minutes"


class Shipped:
    """The proofs for a window: multipliers with their threshold, and a witness with the least threshold."""

    def __init__(self, test: NearbySolution, threshold: float, witness: NearbySolution | None, least: float) -> None:
        self.test, self.threshold, self.witness, self.least = test, threshold, witness, least


def proved_test(window: Window, optimum: Optimum) -> Shipped:
    """Return the proved test near a solution of a linear programme; raise `SolverError` if there is no proof."""
    if optimum.multipliers is None or optimum.point is None:
        raise SolverError("The linear programme is unbounded on this window: the result is inconclusive.")
    rows, _ = window.scales
    # The largest effect of all bounded signals together, if no terms cancelled.
    able = float(np.abs(window.matrix[:, window.bounded]).T @ np.abs(optimum.multipliers) @ window.bar[window.bounded])
    if optimum.size <= ZERO_THRESHOLD * able and not window.standing:
        exact = repaired_multipliers(window.outer, optimum.multipliers, refine=True, exact_zero=True)
        if exact is not None:
            return Shipped(exact.with_room(rows), 0.0, None, 0.0)
    test = repaired_multipliers(window, optimum.multipliers, refine=True)
    if test is None:
        raise SolverError(
            f"Weights of {counted(window.test_problem.samples, 'sample')} were found, but double precision cannot "
            "tell how far they are from exact ones: the result is inconclusive. Fewer samples, or signals in units "
            "near one, help."
        )
    test = test.with_room(rows)
    inner = window.inner
    point = optimum.point if inner is window else largest_hidden_fault(inner).point
    witness = None if point is None else repaired_point(inner, point, refine=True)
    witness = None if witness is None else witness.with_room(inner.scales[1])
    least = np.nan if witness is None else proved_least(inner, witness)
    threshold = proved_threshold(window.outer_with_room, test)
    threshold *= 1.0 if window.bounds.moving is None else COLUMN_ROOM
    return Shipped(test, threshold, witness, least)


def _synthesis(
    problem: WindowProblem,
    options: TestOptions,
    programmes: WindowProgrammes,
    shipped: list[Shipped | None],
    table: FloatArray,
    beside: Beside | None,
) -> Synthesis:
    first, test_problem = programmes.windows[0], programmes.windows[0].test_problem
    multipliers = [
        np.zeros(window.rows) if proved is None else proved.test.values
        for window, proved in zip(programmes.windows, shipped, strict=True)
    ]
    matrices = _by_programme(problem, programmes, shipped)
    of_row, thresholds, leasts = (matrices[name].ravel() for name in ("programmes", "thresholds", "leasts"))
    used = sorted(set(of_row[of_row >= 0].astype(np.int64).tolist()))
    on_y, on_u, delay = first.weights(multipliers[0])
    claims = {
        "threshold": float(thresholds[used].max()),
        "surely_found": 2.0 * float(thresholds[used].max()),
        "delay": delay_in_samples(first, delay) * problem.plant.dt,
    }
    if np.isfinite(leasts[used]).any():
        claims["least"] = float(np.nanmax(leasts[used]))
    shipped_options: dict[str, Any] = {option.name: getattr(options, option.name) for option in fields(TestOptions)} | {
        "samples": test_problem.samples,
        "lag": test_problem.lag if test_problem.course in ("any", "ramp", "rate") else None,
        "fault": problem.fault,
    }
    if not isinstance(problem.plant, DescriptorSystem):
        has_test = np.array([proved is not None for proved in shipped])
        weighing = observer_of_rows(problem, programmes, has_test, multipliers)
        by_row = tuple(_notes_of_rows(problem, claims, matrices, test_problem))
        certificate = Certificate(matrices | {TRADE_OFF: table}, claims)
        return Synthesis(shipped_options, {"weights": weighing.weights}, weighing, certificate, notes=by_row)
    observer = observer_of(first, multipliers[0], None if beside is None else beside.observer)
    alone = {name: matrices[name][0] for name in ("multipliers", "multiplier_radius", "rounding")}
    if matrices["witness"].any():
        alone |= {name: matrices[name][0] for name in ("witness", "witness_radius")}
    if beside is not None:
        alone |= {"state_tracking": beside.T, "state_rows": beside.T0, "record": beside.record}
        mean = mean_over_record(first, observer, multipliers[0], beside.T, beside.T0, beside.record)
        claims["mean_threshold"] = mean
    notes = tuple(_notes(problem, options, first, claims, table))
    certificate = Certificate(alone | {TRADE_OFF: table}, claims)
    return Synthesis(shipped_options, {"h": on_y, "g": on_u}, observer, certificate, notes=notes)


def _by_programme(
    problem: WindowProblem, programmes: WindowProgrammes, shipped: list[Shipped | None]
) -> dict[str, FloatArray]:
    """Return the proofs for each different window, one row for each, and the window that each row of a record has."""
    windows, empty = programmes.windows, NearbySolution(np.zeros(1), np.zeros(1))
    tests = [empty if proved is None else proved.test for proved in shipped]
    continued = [
        proved if proved is not None and _is_lasting(problem, window, row, proved.witness) else None
        for window, proved, row in zip(windows, shipped, programmes.first, strict=True)
    ]
    witnesses = [empty if proved is None or proved.witness is None else proved.witness for proved in continued]
    has_test = np.array([proved is not None for proved in shipped])
    _, _, nu, ny = windows[0].model.sizes
    rounding = [
        np.zeros(nu + ny) if proved is None else rounding_of(window, proved.test.values, proved.test.radius)
        for window, proved in zip(windows, shipped, strict=True)
    ]
    rows = max(window.rows for window in windows)
    return {
        "multipliers": padded([test.values for test in tests], rows),
        "multiplier_radius": padded([test.radius for test in tests], rows),
        "rounding": np.array(rounding),
        "witness": padded([witness.values for witness in witnesses]),
        "witness_radius": padded([witness.radius for witness in witnesses]),
        "thresholds": np.array([[np.inf if proved is None else proved.threshold] for proved in shipped]),
        "leasts": np.array([[np.nan if proved is None else proved.least] for proved in continued]),
        "programmes": np.where(has_test[programmes.of_row], programmes.of_row, -1).astype(np.float64)[:, None],
    }


def padded(rows: Sequence[FloatArray], width: int = 1) -> FloatArray:
    """Return rows of different lengths as a matrix, filled with zeros."""
    width = max(width, *(len(row) for row in rows))
    return np.array([np.pad(row, (0, width - len(row))) for row in rows])


def _is_lasting(problem: WindowProblem, window: Window, row: int, witness: NearbySolution | None) -> bool:
    """Whether a witness, if there is one, is a trajectory of a plant that runs before and after the window."""
    if witness is None:
        return problem.continues(window, row)
    return problem.is_of_a_running_plant(window.inner, row, witness.values, witness.radius)


def _notes(
    problem: WindowProblem, options: TestOptions, window: Window, claims: Mapping[str, float], table: FloatArray
) -> list[str]:
    test_problem, threshold, least = window.test_problem, claims["threshold"], claims.get("least")
    words, mean = [], claims.get("mean_threshold")
    if threshold == 0.0:
        words.append(
            "No disturbance and no noise has an effect on the residual: compare it with the effect of rounding."
        )
    elif least is not None:
        kind = disturbances_in_words(window) if isinstance(problem.plant, DescriptorSystem) else ""
        words.append(
            f"The threshold is {upper_text(threshold)}; none with {counted(test_problem.samples, 'sample')} is below "
            f"{lower_text(least)} (proved{f', for {kind}' if kind else ''}). "
            + (
                f"A fault of {upper_text(2.0 * threshold)} with this course, from a sample on, is certain to raise an "
                "alarm."
                if mean is None
                else f"This is for the nominal plant: over the tolerances it is {mean:.4g} in the mean of the scenario."
            )
        )
        if not window.twice_is_hidden:
            words.append(
                "As states have bounds, the latter is about intervals: no function of the samples estimates the fault "
                "to within less, but a fault of less than twice that size may be detectable."
            )
    elif not problem.has_past(0, test_problem.samples):
        words.append(
            "That there is no smaller threshold is not claimed: A is singular, as with a delay, so that what went "
            "before the window says more of its first state."
        )
    else:
        words.append("That there is no smaller threshold could not be proved on these numbers: least is not claimed.")
    words.append(f"The course {test_problem.course} is {COURSES[test_problem.course]}.")
    if test_problem.course == "any" and options.lag is None:
        words.append(f"The least lag with which {problem.fault} can be estimated is {test_problem.lag}.")
    if mean is not None:
        words.append(
            "Over the tolerances of the constants the threshold follows the signals, and the weights are those with "
            "the smallest mean over the scenario; no function of these samples has a threshold below least over the "
            "tolerances either. No size is certain to be detected there: a fault of twice the threshold of its row may "
            "be needed, and more where the constants change the effect of the fault. For the nominal plant a fault of "
            f"{upper_text(2.0 * threshold)} is certain to pass its threshold."
        )
    elif (
        isinstance(problem.plant, DescriptorSystem)
        and problem.plant.uncertainty is not None
        and problem.plant.uncertainty.box.names
    ):
        words.append(
            "The threshold is that of the nominal plant: tolerances of its constants are not in it (give a scenario)."
        )
    if len(table) > 1:
        listed = ", ".join(f"{int(row[0])}: {row[-1]:.4g}" for row in table)
        words.append(
            f"Samples and thresholds (by linear programmes; that of {test_problem.samples} is proved): {listed}."
        )
        if problem.plant.nx * table[-1, 0] * 2 > MOST_WINDOW_STATES:
            words.append(
                f"The table ends at {int(table[-1, 0])} samples, as its programmes grow with samples times states: "
                f"twice as many take {in_time(problem.plant.nx, 2 * int(table[-1, 0]))}. Give samples for more."
            )
    return words


def _notes_of_rows(
    problem: WindowProblem, claims: Mapping[str, float], matrices: Mapping[str, FloatArray], test_problem: TestProblem
) -> Iterator[str]:
    thresholds, of_row = matrices["thresholds"], matrices["programmes"].astype(np.int64)
    without = int(np.sum(of_row < 0))
    used = thresholds[sorted(set(of_row[of_row >= 0].tolist()))]
    forever = problem.horizon is None
    rows = "every row from" if forever else f"the {len(of_row)} rows from"
    yield (
        f"{counted(len(thresholds), 'linear programme')} for {rows} k = {test_problem.samples} on, each proved: "
        f"thresholds from {upper_text(used.min(), 6)} to {upper_text(used.max(), 6)}; the largest one is claimed."
    )
    if without:
        yield (
            f"{without} rows have no verdict: no weights of {counted(test_problem.samples, 'sample')} respond to "
            "the fault and to nothing that is free."
        )
    if "least" not in claims:
        yield "That there is no smaller threshold is not claimed: equations before or after the window may reduce it."
    elif np.isnan(matrices["leasts"]).any():
        yield "At some rows it is not claimed that there is no smaller threshold."
    yield f"The course {test_problem.course} is {COURSES[test_problem.course]}."
    yield (
        f"A fault of k acts on the way to sample k + 1; {', '.join(disturbance_names(problem.plant))} stand for mu(k) "
        "in the equations."
    )

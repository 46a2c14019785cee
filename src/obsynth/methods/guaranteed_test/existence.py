"""Whether a window of samples can detect a fault: proved by a fault that no sample shows, or by a test."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from obsynth.analysis.existence.condition import Condition
from obsynth.errors import SpecError, counted
from obsynth.methods.guaranteed_test.condensed import Condensed
from obsynth.methods.guaranteed_test.options import TestOptions
from obsynth.methods.guaranteed_test.problem import WindowProblem, problem_of, samples_given
from obsynth.methods.guaranteed_test.proofs import proved_ray, repaired_multipliers
from obsynth.methods.guaranteed_test.window_bounds import missing_bounds
from obsynth.methods.guaranteed_test.window_models import fault_names
from obsynth.methods.guaranteed_test.windows import Window
from obsynth.numerics.arrays import FloatArray
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem

SOURCE = "duality of linear programmes"

#: Values of a hidden course below this share of its largest are not told.
TOLD_COURSE = 1e-6

#: What least squares may leave of an equation, as a share of the fault's own weight.
SEEN = 1e-6

#: More states than these are not listed.
MOST_NAMED_STATES = 8


def conditions(
    plant: DescriptorSystem | TimeVaryingDescriptorSystem, options: TestOptions, *, with_windows: bool = True
) -> tuple[Condition, ...]:
    """Return the conditions in order; ``with_windows``: also whether a window tells the fault, if the others hold."""
    first: tuple[Condition, ...] = ()
    names, none = fault_names(plant), "the plant has no parameter (Phi, Psi)."
    named = options.fault is not None or len(names) == 1
    if isinstance(plant, DescriptorSystem):
        detail = "the plant is continuous: sample it (transform: sample_time, obsynth.discretise)."
        sampled = plant.dt > 0.0
        first = (
            Condition(
                "discrete time", "dt > 0", sampled, plant.dt, 0.0, SOURCE, "" if sampled else detail, of_the_method=True
            ),
        )
        named, none = named if not options.isolate else plant.nf > 0, "the plant has no fault (Bf, Df)."
    advice = f"name one of {', '.join(names)} (fault)." if names else none
    lacking = list(missing_bounds(plant, options))
    first = (
        *first,
        Condition(
            "fault named",
            "one fault is tested for",
            named,
            float(len(names)),
            1.0,
            SOURCE,
            "" if named else advice,
            of_the_method=True,
        ),
        Condition(
            "bounds stated",
            "disturbances and noise have bounds",
            not lacking,
            float(len(lacking)),
            0.0,
            SOURCE,
            " ".join(lacking),
            of_the_method=True,
        ),
    )
    if not all(condition.holds for condition in first) or not with_windows:
        return first
    # Of a bank: that a fault is reported where no other is there; some group then shows it.
    alone = [replace(options, isolate=False, fault=name, free="none") for name in names]
    each = alone if options.isolate and isinstance(plant, DescriptorSystem) else [options]
    return (*first, *(detectability(problem_of(plant, own), own)[0] for own in each))


def detectability(problem: WindowProblem, options: TestOptions) -> tuple[Condition, int]:
    """Return the condition that some window tells the fault, and the lag with which it does."""
    lags = [problem.test_problem.lag]
    if problem.test_problem.course == "any" and options.lag is None:
        lags = list(range(problem.plant.nx + 2))
    if isinstance(problem.plant, TimeVaryingDescriptorSystem):
        lags = [lag for lag in lags if lag < _samples_by_row(problem, options)] or lags[:1]
    for lag in lags:
        for window in _decisive(problem, options, lag):
            if has_test(window):
                return detectability_condition(window, True, ""), lag
    return detectability_condition(window, False, _hiding_in_words(problem, options, window)), lags[-1]


def _decisive(problem: WindowProblem, options: TestOptions, lag: int) -> Iterator[Window]:
    """Yield the windows of which one has a test where there is any."""
    if isinstance(problem.plant, TimeVaryingDescriptorSystem):
        samples = _samples_by_row(problem, options)
        rows = problem.tried(samples)
        if not rows:
            raise SpecError(
                f"The plant's horizon of {problem.horizon} steps has no window of {counted(samples, 'sample')} (k = 1 "
                "is the first): give fewer samples, or extend the model.",
                path="method.options.samples",
            )
        yield from (problem.window(samples, lag=lag, row=row) for row in reversed(rows))
        return
    most = samples_decided_on(problem, options, lag)
    least = max(problem.test_problem.before, lag) + 2
    # A test on fewer samples is one on more: short windows are decided in no time.
    doubled = [least * 2**k for k in range(most.bit_length())]
    yield from (problem.window(samples, lag=lag) for samples in (*(tried for tried in doubled if tried < most), most))


def _samples_by_row(problem: WindowProblem, options: TestOptions) -> int:
    """Return the samples on which it is decided where each row has a window of its own."""
    samples = samples_given(options)
    return problem.ladder()[-1] if samples == "auto" else int(samples)


def samples_decided_on(problem: WindowProblem, options: TestOptions, lag: int) -> int:
    """Return the samples on which it is decided."""
    enough = problem.enough(lag)
    if options.samples != "auto":
        return int(min(max(options.samples, lag + 1), max(enough, lag + 1)))
    if options.after is not None:
        return min(options.before + options.after, enough)
    return enough


def has_test(window: Window) -> bool:
    """Whether exact multipliers see the fault and no free column."""
    multipliers = least_multipliers(window)
    if multipliers is None:
        return False
    return repaired_multipliers(window, multipliers, refine=True) is not None


def least_multipliers(window: Window) -> FloatArray | None:
    """Return multipliers that see theta with weight one and no free column; ``None`` where least squares have none."""
    condensed = Condensed.of(window)
    if condensed is not None:
        return condensed.least_weights()
    rows, columns = window.scales
    prescribed = np.flatnonzero(window.free | (np.arange(len(window.bar)) == 0))
    matrix = np.ldexp(np.ldexp(window.matrix[:, prescribed].toarray(), columns[prescribed]), rows[:, None]).T
    target = np.zeros(len(prescribed))
    target[0] = float(np.ldexp(1.0, int(columns[0])))
    multipliers = np.linalg.lstsq(matrix, target, rcond=None)[0]
    if np.max(np.abs(matrix @ multipliers - target)) > SEEN * target[0]:
        return None
    return np.asarray(np.ldexp(multipliers, rows))


def detectability_condition(window: Window, holds: bool, detail: str) -> Condition:
    """Return the condition that a window tells the fault, in words."""
    fault = fault_names(window.model.plant)[window.test_problem.fault]
    return Condition(
        "fault detectable",
        f"{fault} changes the samples in a way that no free signal does",
        holds,
        float(holds),
        1.0,
        SOURCE,
        detail,
        signals=() if holds else (fault,),
    )


def _hiding_in_words(problem: WindowProblem, options: TestOptions, window: Window) -> str:
    """Return in words what hides the fault."""
    fault, varies = problem.fault, isinstance(problem.plant, TimeVaryingDescriptorSystem)
    point = proved_ray(window)
    samples = window.test_problem.samples
    if point is None and varies:
        return (
            f"no weights of {counted(samples, 'sample')} respond to {fault} and to nothing that is free at the rows "
            "that were tried."
        )
    if point is None:
        return (
            f"no test on {counted(samples, 'sample')} responds to {fault} and to nothing that is free, but a time "
            "course that hides it could not be "
            "proved: this is at the edge of double precision. Bounds of the states (state_bounds) help, even wide ones."
        )
    where = f"the window that ends at k = {samples}" if varies else counted(samples, "sample")
    text = f"{hidden(window, point)} (proved for {where}: every equation holds exactly)."
    if varies:
        return text
    lag = window.test_problem.lag
    if problem.test_problem.course == "any" and options.lag is not None:
        for more in range(lag + 1, problem.plant.nx + 2):
            if has_test(problem.window(max(samples, problem.enough(more)), lag=more)):
                return f"{text} The least lag for which there is a test is {more}."
    if options.samples != "auto" and samples < problem.enough(lag):
        for more in range(samples + 1, problem.enough(lag) + 1):
            if has_test(problem.window(more, lag=lag)):
                return f"{text} The least number of samples for which there is a test is {more}."
    return text


def hidden(window: Window, point: FloatArray) -> str:
    """Return which signals together look like nothing."""
    plant, test_problem = window.model.plant, window.test_problem
    names = fault_names(plant)
    fault = names[test_problem.fault]
    largest = float(np.max(np.abs(point)))
    other_faults = []
    for label, value in zip(window.labels, point, strict=True):
        if label[0] == "f" and label[2] != test_problem.fault and abs(value) > TOLD_COURSE * largest:
            name = names[label[2]]
            if name not in other_faults:
                other_faults.append(name)
    states = {
        plant.state_names[label[2]]
        for label, value in zip(window.labels, point, strict=True)
        if label[0] == "x" and abs(value) > TOLD_COURSE * largest
    }
    moving = f", while {', '.join(sorted(states))} move" if states and len(states) <= MOST_NAMED_STATES else ""
    if other_faults:
        return f"{fault} and {' and '.join(other_faults)} together give the same outputs as neither of them{moving}"
    return f"{fault} gives the same outputs as no fault{moving or ', from another start of the states'}"

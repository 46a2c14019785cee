"""Comparison of all methods that exist for a plant, at one sample time and on the same random runs.

The stated scenario, many times: disturbances, noise and tolerances drawn; the same draws for every method.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from obsynth.errors import SpecError
from obsynth.methods.candidates import SETTLING_TIMES, Candidate, Maker, candidate, linear_methods
from obsynth.methods.designing import agree, design
from obsynth.methods.fault_figures import largest_gain, on_the_clock, step_responses, steps_in_bounds
from obsynth.methods.functional_filter.rates import settling_time
from obsynth.methods.optimal_filter.least_possible import least_possible
from obsynth.methods.registry import method_class
from obsynth.monitoring.logs.log_run import faults_on_rows
from obsynth.monitoring.thresholds.residual_model import largest_disturbances
from obsynth.numerics.arguments import Count, NonNegative, Positive, Probability, arguments_checked, is_finite_number
from obsynth.numerics.arrays import FloatArray, read_only
from obsynth.numerics.libraries import on_one_thread_if_small
from obsynth.numerics.linear_recursions import driven
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.transformations.delays import linear_plant
from obsynth.plants.transformations.recovery import Transformation
from obsynth.results.design import ObserverDesign
from obsynth.results.number_texts import duration
from obsynth.simulation.profiles import Sine, Step
from obsynth.simulation.scenario import Scenario, scenario_from
from obsynth.studies.compared_methods import ComparedMethod, FaultComparison
from obsynth.studies.compared_records import ComparedLog, Record, drawn_runs
from obsynth.studies.comparison import Comparison
from obsynth.studies.equal_delays import (
    HEALTHY_TIME,
    delay_of_scenario,
    delay_on_log,
    level_of_normal_rows,
    normal_rows,
)
from obsynth.studies.least_thresholds import response_steps, thresholds_beside_least
from obsynth.studies.ranking import comparison_statement, delay_in_words, relative_error, rms, short_delay

#: Runs of the scenario, and samples and settling times where nothing is stated.
RUNS, SCENARIO_SAMPLES, MOST_SCENARIO_SAMPLES = 20, 40, 6000

COMPARISON_SEED = 7

#: Unknown inputs of the scenario that is made up are sines with so many periods in a settling time.
PERIOD_SHARE = 0.2


@dataclass(frozen=True)
class ComparisonSettings:
    """What designs are compared by: the options of `obsynth.compare` on which figures hang."""

    sample_time: float | None
    within: float | None
    tolerance: float
    disturbance: float
    runs: int
    false_alarms: float
    input_delay: int = 0

    def as_dict(self) -> dict[str, Any]:
        """Return what a certificate keeps of them."""
        return {name: value for name, value in vars(self).items() if name != "input_delay" or value}

    def in_words(self, plant: DescriptorSystem, dt: float, horizon: float, limit: float, *, stabilised: bool) -> str:
        """Return the setting of a comparison as a sentence; ``horizon``, ``limit`` of the settling in seconds."""
        runs = f"{self.runs} runs of {duration(horizon)}, sampled every {dt:g} s"
        parts = [f"{runs}, disturbances and noise of the scenario"]
        uncertain = plant.uncertainty is not None and plant.uncertainty.box.names
        parts += ["constants within their tolerances"] if uncertain else []
        parts += [f"parameters off by up to {self.tolerance:.0%}"] if self.tolerance else []
        parts += ["a state feedback stabilises the plant"] if stabilised else []
        return f"{', '.join(parts)}; 90 % of a step to be reached within {duration(limit)}"


@dataclass(frozen=True)
class DesignSource:
    """Where the designs come from: ``maker(plant, method, options)`` of each method."""

    methods: Sequence[str]
    maker: Maker
    options: Mapping[str, Mapping[str, Any]]
    of_samples: bool = True  # whether options are for the sampled plant

    def candidates(
        self, plant: DescriptorSystem, sampled: DescriptorSystem, steps: int, report_stage: Callable[[str], None]
    ) -> list[Candidate]:
        """Return the design of each method on the clock of the comparison, or why there is none."""
        designs = []
        for method in self.methods:
            report_stage(f"designing by {method}")
            own = self.options.get(method, {})
            in_own_time = bool(own) and not self.of_samples and method_class(method).time == "both"
            designs.append(candidate(method, plant, sampled, steps, self.maker, own, continuous=in_own_time))
        return designs


def estimates(observer: LinearObserver, runs: Record) -> FloatArray:
    """Return fault estimates ``(runs, steps, faults)`` of an observer at rest."""
    rows, y, known = observer.fault_rows, runs.y.swapaxes(0, 1), runs.u.swapaxes(0, 1)
    z = driven(observer.Az, np.zeros(observer.order), y @ observer.By.T + known @ observer.Bu.T)
    with np.errstate(over="ignore", invalid="ignore"):
        values = z @ observer.Cz[rows].T + y @ observer.Dy[rows].T + known @ observer.Du[rows].T + observer.added[rows]
    return np.ascontiguousarray(values.swapaxes(0, 1))


def alarms(
    with_fault: FloatArray, quiet: FloatArray, fault: FloatArray, response: FloatArray, false_alarms: float, dt: float
) -> tuple[float, float, float]:
    """Return threshold (passed in a share of the fault-free runs), median detection delay (s) and smallest fault found.
    ``with_fault, quiet (runs, steps)``: estimates with and without the fault; ``response (steps,)``: to a unit step."""
    level = float(np.quantile(np.max(np.abs(quiet), axis=1), 1.0 - false_alarms))
    acts = np.flatnonzero(fault)
    if not acts.size:
        return level, float("nan"), float("nan")
    first = int(acts[0])
    above = np.abs(with_fault[:, first:]) > level
    delays = np.where(above.any(axis=1), np.argmax(above, axis=1) * dt, np.inf)
    # The response is computed as far as a step is followed, which may be less than the record.
    length = min(len(fault) - first, len(response))
    growth = np.maximum(response[:length], 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        needed = np.where(growth > 0.0, (level - quiet[:, first : first + length]) / growth, np.inf)
    smallest = np.maximum(np.min(needed, axis=1), 0.0)
    return level, float(np.median(delays)), float(np.median(smallest))


@arguments_checked
@on_one_thread_if_small
def compare(
    plant: DescriptorSystem | Transformation,
    *,
    scenario: Scenario | None = None,
    options: Mapping[str, Mapping[str, Any]] | None = None,
    methods: Sequence[str] | None = None,
    sample_time: Positive | None = None,
    within: Positive | None = None,
    tolerance: NonNegative = 0.0,
    disturbance: NonNegative = 1.0,
    runs: Count = RUNS,
    false_alarms: Probability = 0.05,
    data: Any = None,
    columns: Mapping[str, str] | None = None,
    scales: Mapping[str, float] | None = None,
    input_delay: int = 0,
    progress: Callable[[str], None] | None = None,
) -> Comparison:
    """Design every method that exists for a plant and put them side by side, on one clock and the same draws.

    Methods are ranked by the root mean square error over the scenario, with disturbances, noise and tolerances drawn,
    as a share of the size of each fault there, so that units do not matter, among those whose estimate reaches 90 % of
    a step within the time asked for.  On a log they are ranked by the delay of an alarm first, with the level of each
    design such that 1 % of the normal rows of the log are in alarm.

    Parameters
    ----------
    plant : DescriptorSystem or Transformation
        Either time, with faults.  A continuous one is sampled: methods are designed for the samples where they can be.
        Options such as poles are for the plant: such a method of either time is designed for it, and sampled
        afterwards.  Of a transformation they are for the plant that it makes; compared is the one it starts from.
    scenario : Scenario, optional
        What happens; by default each fault in turn is a step, while every unknown input is a sinusoid.
    options : mapping of str to mapping, optional
        Options by method id.
    methods : sequence of str, optional
        Ids; by default all for linear plants.
    sample_time : float, optional, seconds
        The clock of a continuous plant; by default that of the scenario, or a fortieth of the plant's settling time.
    within : float, optional, seconds
        Time within which 90 % of a step must be shown; by default the plant's settling time.
    tolerance : float, optional
        Relative: each parameter of a drawn plant is off by up to this.
    disturbance : float, optional
        Amplitude of unknown inputs where no scenario is given.
    runs : int, optional
        Drawn runs, with and without faults each.
    false_alarms : float, optional
        Share of fault-free runs that pass the threshold of an alarm.
    data : str, Path or DataFrame, optional
        A log with the outputs and inputs by name, replayed through every method; columns named as faults are the
        truth, and other rows than those of faults are normal.  Faults without a column are the scenario's, added to it.
    input_delay : int, optional
        Rows of ``data`` by which inputs act later than during the step that begins with them.
    columns, scales : mapping, optional
        Columns of signals where their names differ, and factors of their values, as for `obsynth.run_on_data`.
    progress : callable, optional
        Called with a text at the start of each stage.

    Returns
    -------
    Comparison
        ``times (steps,)``, ``truth (steps, nf)``; refused methods with the reason in one line.

    Raises
    ------
    SpecError
        The plant has no faults, an argument is out of range, a method is unknown, or the log lacks a column.

    References
    ----------
    Ours: see `Comparison` for what each number means.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]],
    ...     C=[[1, 0], [0, 1]],
    ...     Bf=[[1], [0]],
    ...     Bd=[[0], [1]],
    ...     dt=1.0,
    ...     sensor_noise={"y1": 0.1, "y2": 0.1},
    ... )
    >>> comparison = obsynth.compare(plant, methods=["fault-estimation-filter", "ui-pi-observer"], runs=2)
    >>> comparison.recommended in ("fault-estimation-filter", "ui-pi-observer")
    True
    """
    made = linear_plant(plant)
    # Some methods are continuous, and so are tolerances; faults and unknown inputs are those of the plant as written.
    plant, clock = (plant.source, made.dt or None) if isinstance(plant, Transformation) else (made, None)
    sample_time = clock if sample_time is None else sample_time
    if plant.nf == 0:
        raise SpecError("The plant has no faults, so there are no fault estimates to compare.", path="plant")
    unused = sorted(name for name, argument in (("columns", columns), ("scales", scales)) if argument and data is None)
    if unused:
        raise SpecError(f"{unused[0]} is for a log: give data.", path=unused[0])
    if scenario is not None and disturbance != 1.0:
        raise SpecError(
            "disturbance is for the default scenario: the scenario that is given states its own.", path="disturbance"
        )
    if plant.dt and sample_time not in (None, plant.dt):
        raise SpecError(f"sample_time is for continuous plants: this one has {plant.dt:g} s.", path="sample_time")
    known = [spec.id for spec in linear_methods()]
    unknown = [name for name in methods or () if name not in known]
    if unknown:
        raise SpecError(f"{', '.join(map(repr, unknown))}: use some of {', '.join(known)}.", path="methods")
    ids = known if methods is None else list(methods)
    for method in options or {}:
        if method not in ids:
            raise SpecError(f"options has {method!r}, which is not compared: {', '.join(ids)} are.", path="options")
    settings = ComparisonSettings(
        sample_time, within, float(tolerance), float(disturbance), int(runs), float(false_alarms), int(input_delay)
    )
    source = DesignSource(ids, lambda target, method, own: design(target, method, **own), options or {}, made.dt > 0.0)
    log = None if data is None else ComparedLog(data, columns, scales)
    return side_by_side(plant, scenario, source, settings, log=log, progress=progress)


def side_by_side(
    plant: DescriptorSystem,
    scenario: Scenario | None,
    source: DesignSource,
    settings: ComparisonSettings,
    *,
    log: ComparedLog | None = None,
    progress: Callable[[str], None] | None = None,
) -> Comparison:
    """Return designs side by side, on one clock and on the same draws."""
    report_stage = progress or (lambda _: None)
    stated_options = {
        "plant": plant.as_dict(),
        "scenario": None if scenario is None else scenario.as_dict(),
        **settings.as_dict(),
    }
    plant = plant.dense() if plant.is_sparse else plant
    sampled, trial, loop = _on_one_clock(plant, scenario, settings)
    dt, (steps, feedback) = sampled.dt, loop
    candidates = source.candidates(plant, sampled, steps, report_stage)
    report_stage("running the scenario")
    faulty, healthy = drawn_runs(
        plant,
        sampled,
        trial,
        runs=settings.runs,
        tolerance=settings.tolerance,
        seed=COMPARISON_SEED,
        feedback=feedback,
    )
    logged = None if log is None else log.record(sampled, settings.input_delay)
    limit = settings.within if settings.within is not None else settling_time(plant)
    bounds = largest_disturbances(trial, sampled.disturbance_names, dt)
    compared = _sized(
        [
            _compared(entry, sampled, faulty, healthy, logged, loop, limit, settings.false_alarms, bounds)
            for entry in candidates
        ]
    )
    compared.sort(key=lambda entry: (bool(entry.refused), not entry.fast_enough, *entry.ranked_by))
    best = next((entry for entry in compared if not entry.refused), None)
    record, truth = (faulty, faulty.truth) if logged is None else (logged, _known_truth(logged, plant.fault_names))
    reference = None if log is None else log.reference
    return Comparison(
        methods=tuple(compared),
        recommended="" if best is None else best.method,
        reason=_reason(best, compared, sampled, _method_by_default(candidates, sampled, settling_time(plant)), limit),
        sample_time=dt,
        times=read_only(record.times),
        truth=read_only(truth),
        fault_names=plant.fault_names,
        setting=settings.in_words(plant, dt, trial.horizon, limit, stabilised=bool(feedback.any())),
        asked=stated_options if log is None or reference is not None else {},
        log=reference,
        notes=() if logged is None else logged.notes,
    )


def _on_one_clock(
    plant: DescriptorSystem, scenario: Scenario | None, settings: ComparisonSettings
) -> tuple[DescriptorSystem, Scenario, tuple[int, FloatArray]]:
    """Return the sampled plant, the scenario, and samples and feedback of a run (an unstable plant is stabilised)."""
    stated = None if scenario is None else scenario.sample_time
    dt = plant.dt or settings.sample_time or stated or settling_time(plant) / SCENARIO_SAMPLES
    sampled = on_the_clock(plant, dt)
    trial = _scenario(plant, scenario, dt, settings.disturbance)
    steps = int(min(trial.horizon / dt, MOST_SCENARIO_SAMPLES)) + 1
    within_bounds, feedback = steps_in_bounds(sampled, steps)
    if within_bounds < steps:
        trial = trial.replace(horizon=within_bounds * dt)
    return sampled, trial, (within_bounds, feedback)


def _known_truth(logged: Record, fault_names: Sequence[str]) -> FloatArray:
    """Return the faults of a log, NaN where nobody says what they were: zero would be drawn as the truth."""
    truth = np.array(logged.truth)
    truth[:, [name not in logged.known for name in fault_names]] = np.nan
    return truth


def _method_by_default(candidates: Sequence[Candidate], sampled: DescriptorSystem, settling: float) -> str:
    """Return the method that `design` takes by default among those that estimate faults."""
    among = [entry for entry in candidates if entry.figures and "faults" in method_class(entry.method).purposes]
    first = min(among, key=lambda entry: entry.rank(sampled.nd > 0, settling), default=None)
    return "" if first is None else first.method


def compared_again(
    body: Mapping[str, Any], designs: Mapping[str, ObserverDesign], log: Path | None
) -> tuple[dict[str, Any], str, list[str]]:
    """Return figures and sentence of a certificate made again from its plant and gain sets, and designs of others."""
    options = dict(body["asked"])
    plant = DescriptorSystem(**options.pop("plant"))
    scenario = options.pop("scenario")
    source = DesignSource(sorted(designs), lambda _, method, __: designs[method], {})
    comparison = side_by_side(
        plant,
        None if scenario is None else scenario_from(scenario),
        source,
        ComparisonSettings(**options),
        log=None if log is None else ComparedLog(log, body["log"]["columns"], body["log"]["scales"]),
    )
    result = comparison.claims()
    if log is None and body["log"] is not None:
        # The errors on a log that is not given are assumed.
        for name, entry in result["methods"].items():
            for fault, stored in zip(entry["faults"], body["result"]["methods"][name]["faults"], strict=True):
                fault |= {name: float(stored[name]) for name in ("rms", "size", "equal_delay") if name in stored}
            entry["relative_error"] = relative_error(entry["faults"])
    sampled = on_the_clock(plant, comparison.sample_time)
    foreign = [f"plant of {name}" for name, design in designs.items() if not _is_of(design, (plant, sampled))]
    digests = {name: inside["sha256"] for name, inside in body["gain_sets"].items()}
    return result, comparison_statement(body["result"], digests, body["log"]), foreign


def _is_of(made: ObserverDesign, plants: Sequence[DescriptorSystem]) -> bool:
    """Whether a design is for one of some plants, as it was written or transformed."""
    own = [made.plant] if made.source is None else [made.source.plant, made.plant]
    return any(
        isinstance(variant, DescriptorSystem) and agree(variant.dense(), other) for variant in own for other in plants
    )


def _scenario(plant: DescriptorSystem, scenario: Scenario | None, dt: float, disturbance: float) -> Scenario:
    """Return what happens: the scenario given, with at least the sensors' own noise, or each fault in turn."""
    if scenario is not None:
        clocked = scenario if plant.dt or scenario.sample_time == dt else scenario.replace(sample_time=dt)
        # All runs begin at rest; a state that is given may be one that the sampled plant does not have any more.
        return clocked.replace(observer_state=None, initial_state={}, stabilise=False)
    settle = max(settling_time(plant), 4.0 * dt)
    # Each fault has its turn, if need be before everything has settled.
    length = min(SETTLING_TIMES * settle, MOST_SCENARIO_SAMPLES * dt / max(plant.nf, 1))
    faults = {
        name: Step(size=1.0, start=(1.0 + 2.0 * i) * length / 2.0, end=(2.0 + 2.0 * i) * length / 2.0)
        for i, name in enumerate(plant.fault_names)
    }
    frequency = PERIOD_SHARE / settle
    return Scenario(
        horizon=plant.nf * length,
        sample_time=None if plant.dt else dt,
        faults=faults,
        noise=1.0,
        disturbances={name: Sine(amplitude=disturbance, frequency=frequency) for name in plant.disturbance_names}
        if disturbance
        else {},
    )


def _compared(
    entry: Candidate,
    plant: DescriptorSystem,
    faulty: Record,
    healthy: Record,
    log: Record | None,
    loop: tuple[int, FloatArray],
    limit: float,
    false_alarms: float,
    bounds: FloatArray,
) -> ComparedMethod:
    nothing = np.zeros((0, 0))
    if entry.observer is None:
        return ComparedMethod(entry.method, entry.refused, None, 0, entry.milliseconds, (), False, nothing, nothing)
    observer = entry.observer
    _, responses = step_responses(plant, observer, *loop)
    names = [figures.fault for figures in entry.figures]
    followed, radius = response_steps(plant, observer, loop[0])
    beside = thresholds_beside_least(plant, step_responses(plant, observer, *followed)[0], names, bounds, radius)
    estimated, quiet = estimates(observer, faulty), estimates(observer, healthy)
    replay = None if log is None or entry.design is None else faults_on_rows(entry.design, log.times, log.u, log.y)
    replayed = None if replay is None else replay[0]
    rows = []
    for row, figures in enumerate(entry.figures):
        column = plant.fault_names.index(figures.fault)
        fault = faulty.truth[:, column]
        response = responses[:, row, column]
        level, delay, smallest = alarms(estimated[:, :, row], quiet[:, :, row], fault, response, false_alarms, plant.dt)
        error, truth = estimated[:, :, row] - fault, fault
        if replayed is not None and log is not None and figures.fault in log.known:
            truth = log.truth[:, column]
            error = replayed[:, row] - truth
        bias = float(np.max(np.abs(np.mean(quiet[:, :, row], axis=1)), initial=0.0))
        of_fault = FaultComparison(figures, rms(error), rms(truth), bias, level, delay, smallest, *beside[row])
        if replay is not None and log is not None:
            effects = estimated[:, :, row] - quiet[:, :, row]
            equal = _equal_delay(log, column, (replay[0][:, row], replay[1]), effects, fault, plant.dt)
            of_fault = replace(of_fault, equal_delay=equal)
        rows.append(of_fault)
    drawn = estimated[0] if replayed is None else replayed
    fast = all(fault.figures.reaches and fault.figures.most <= limit for fault in rows)
    least = None if entry.design is None else least_possible(entry.design, later=True)
    own = np.column_stack([responses[:, i, plant.fault_names.index(f.fault)] for i, f in enumerate(entry.figures)])
    return ComparedMethod(
        entry.method,
        "",
        entry.design,
        observer.order,
        entry.milliseconds,
        tuple(rows),
        fast,
        read_only(own),
        read_only(drawn),
        least,
    )


def _equal_delay(
    log: Record,
    column: int,
    replay: tuple[FloatArray, NDArray[np.bool_]],
    effects: FloatArray,
    fault: FloatArray,
    dt: float,
) -> float:
    """Return the delay of the alarm of one fault at equal healthy time in alarm on a log, in seconds: of the log's own
    fault where it has one, else of the scenario's ``fault (steps,)``, which moves estimates by ``effects (runs,
    steps)``; ``replay``: estimates of the log, and in which rows a decision may be taken."""
    values, decided = replay
    normal = normal_rows(log.truth, decided)
    centre, level = level_of_normal_rows(values, normal)
    if np.nan_to_num(log.truth[:, column]).any():
        return delay_on_log(np.where(decided, values, np.nan), log.times, log.truth[:, column], centre, level)
    return delay_of_scenario(values[normal], effects, fault, dt, centre, level)


def _sized(compared: Sequence[ComparedMethod]) -> list[ComparedMethod]:
    """Return the methods with a size for each fault that does not happen: the largest error of any method."""
    largest: dict[str, float] = {}
    for fault in (fault for entry in compared for fault in entry.faults):
        largest[fault.figures.fault] = max(largest.get(fault.figures.fault, 0.0), fault.size or fault.rms)
    return [
        replace(entry, faults=tuple(replace(fault, size=largest[fault.figures.fault]) for fault in entry.faults))
        for entry in compared
    ]


def _reason(
    best: ComparedMethod | None,
    compared: Sequence[ComparedMethod],
    plant: DescriptorSystem,
    by_default: str,
    limit: float,
) -> str:
    if best is None:
        return compared[0].refused if compared else "no method was asked for"
    other_designs = [entry for entry in compared if not entry.refused and entry is not best]
    words = [f"rms error {best.relative_error:.3g} of the size of the faults"]
    if other_designs and is_finite_number(other_designs[0].relative_error):
        words[0] += f" against {other_designs[0].relative_error:.3g} by {other_designs[0].method}"
    if best.equal_delay is not None:
        words.insert(0, delay_in_words(best.equal_delay, HEALTHY_TIME))
        if other_designs and other_designs[0].equal_delay is not None:
            words[0] += f", against {short_delay(other_designs[0].equal_delay)} by {other_designs[0].method}"
    if plant.nd:
        gain = largest_gain(fault.figures for fault in best.faults)
        words.append(f"gain from unknown inputs {gain:.3g}" if gain else "decoupled from unknown inputs")
    if not best.fast_enough:
        words.append("though none reaches 90 % of a step within the time asked for")
    slow = [entry for entry in other_designs if not entry.fast_enough] if best.fast_enough else []
    late = [entry.method for entry in slow if any(fault.figures.most > limit for fault in entry.faults)]
    leaving = [entry.method for entry in slow if entry.method not in late]
    if late:
        words.append(f"90 % of a step is not reached within {duration(limit)} by {', '.join(late)}")
    if leaving:
        words.append(f"the estimate of a step does not stay within 10 % of it by {', '.join(leaving)}")
    if by_default not in ("", best.method):
        words.append(f"`method: auto` would choose {by_default}, because it ranks without your scenario")
    return "; ".join(words)

"""Which states for coloured noise, offsets and loads the innovations of a log ask for, chosen by likelihood.

One state at a time is added, that which gains most: its nats less half a logarithm of the number of samples for each
number that it adds (Schwarz 1978).  An offset is integrated out, which counts it already.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import cast

import numpy as np

from obsynth.analysis.dae_structure import identifiability
from obsynth.analysis.existence.moussaali_dae import NOMINAL_SAMPLES
from obsynth.errors import SolverError
from obsynth.monitoring.calibration.diagnostics import SIGNIFICANT, mean_off, whiteness
from obsynth.monitoring.calibration.explanations import LEAST_EXPLANATION, regression_gain
from obsynth.monitoring.calibration.innovations_fit import InnovationsFit
from obsynth.monitoring.calibration.likelihood import IMPOSSIBLE, Likelihood
from obsynth.monitoring.calibration.maximum import COLLAPSE, COLLAPSE_NATS, Objective
from obsynth.monitoring.calibration.noise_states import NoiseStates, PlantWithNoise, correlation_name
from obsynth.monitoring.calibration.plants import NonlinearPlant
from obsynth.monitoring.calibration.problem import CalibrationProblem
from obsynth.monitoring.calibration.simulation_error import Fit
from obsynth.numerics.arrays import FloatArray
from obsynth.plants.dae import DAEModel
from obsynth.plants.noise import noise_state, process_variance
from obsynth.plants.transformations.noise_states import with_noise
from obsynth.results.number_texts import duration

#: Numbers that a state adds: the variance and correlation of coloured noise, the variance of a walk.
ADDED_NUMBERS = {"coloured": 2, "offset": 0, "walk": 1}

#: Nats above which a state is taken.  An offset that is not taken spoils constants, and one too many only widens boxes.
LEAST_NATS = {"coloured": LEAST_EXPLANATION, "offset": 1.0, "walk": LEAST_EXPLANATION}

#: Nats by which coloured noise has to be better to be reported where the process noise that stands for it is no longer
#: needed beside it, so that it adds no number: what stays near its mean fits a log that wanders at random by so much
#: better in one of a hundred (Dickey & Fuller 1979, with a mean: half of the square of 3.43).
LEAST_REPLACEMENT = 5.9

#: Nats that an offset explains beside constants, variances as they are, before it is tried; and by how much constants
#: are moved to see what they explain, in widths of their bounds.
LEAST_OFFSET_GAIN, SMALL_MOVE = 2.0, 1e-4

#: Nats for each row above which a state stands for an error of the model: those of noise that is correlated over 100
#: rows; a constant that is off by a factor of ten was taken for noise of a sensor that lasts as long as the log.
NATS_OF_MODEL_ERRORS = 2.0

_MODEL_ERROR = (
    "That is more than the noise or an offset of {name} is likely to explain: a constant that is not among the unknown "
    "ones, an equation or a unit may be wrong instead."
)

_STATE_SENTENCES = {
    "coloured": "The noise of {name} is coloured: the model has a state for it (better by {gain:.3g} nats).",
    "offset": "The sensor {name} has an offset: the model has a state for it (better by {gain:.3g} nats).",
    "walk": "The unknown input {name} is taken as a random walk (better by {gain:.3g} nats).",
}

_REPLACED = (
    "Process noise may stand for coloured noise of {name} here: with noise of {name} that is correlated over about "
    "{time}, the log needs it no longer, and is better by {gain:.3g} nats. As it is, a design follows {name}, "
    "and its monitor may not see a fault of that sensor. If the noise is coloured, state this (sensor_noise: "
    "{{{name}: {{correlation: unknown}}}} in calibrate)."
)

_OFFSET_HIDES = (
    "At constant inputs {faults} cannot be distinguished from the offset of {name}: a design for both may be "
    "refused. If the sensor has no offset, state this (offset: {{}} in calibrate)."
)

#: Wrong samples in a row at most, and how many after them must be where they are predicted.
LONGEST_RUN, RETURNED = 5, 3

#: Autocorrelations between which a search for coloured noise begins, and the share of R that it begins with.
FIRST_AUTOCORRELATIONS, COLOURED_SHARE = (0.3, 0.98), 0.7


def proposed_states(
    problem: CalibrationProblem,
    fit: InnovationsFit,
    stated: NoiseStates,
    kinds: Sequence[str],
    problem_with: Callable[[NoiseStates], CalibrationProblem],
    note: Callable[[str], object],
) -> tuple[NoiseStates, list[str], list[str]]:
    """Return the states asked for with those that the innovations ask for, and a sentence for each of these; and one
    for coloured noise that is not taken, but for which process noise may stand."""
    states, sentences = stated, list[str]()
    asking = _proposals(problem, fit)
    value, start = fit.value, _SearchStart.of(problem, fit)
    needed_before: Callable[[], int] = lambda: _needed_by_fit(problem, fit)  # noqa: E731 - counted where asked
    while True:
        candidates, replacements = [], {}
        for kind, name, tried in _candidates(states, kinds, problem.output_names, problem.plant.unknown_inputs):
            if (kind, name) not in asking:
                continue
            note(f"{kind} of {name}")
            reached, place, needed = start.best(like_problem(problem, problem_with(tried)))
            gain = value - reached - 0.5 * ADDED_NUMBERS[kind] * np.log(problem.log.samples)
            least = LEAST_NATS[kind]
            if kind == "offset" and least < gain < LEAST_EXPLANATION and hidden_faults(problem, fit, tried):
                least = LEAST_EXPLANATION
            candidates.append((gain - least, kind, name, tried, reached, place, needed))
            if kind == "coloured" and value - reached > LEAST_REPLACEMENT:
                replacements[name] = value - reached, place.t[correlation_name(name)], needed()
        if not candidates:
            break
        gain, kind, name, tried, reached, place, needed = max(candidates, key=lambda item: item[0])
        if not gain > 0.0:
            break
        hidden = hidden_faults(problem, fit, tried) if kind == "offset" else ()
        least = LEAST_EXPLANATION if hidden else LEAST_NATS[kind]
        sentences.append(_STATE_SENTENCES[kind].format(name=name, gain=gain + least))
        if kind != "walk" and gain > NATS_OF_MODEL_ERRORS * problem.log.samples:
            sentences.append(_MODEL_ERROR.format(name=name))
        if hidden:
            sentences.append(_OFFSET_HIDES.format(name=name, faults=" and ".join(hidden)))
        states, value, start, needed_before = tried, reached, place, needed
    remarks = [
        _REPLACED.format(name=name, time=duration(float(np.exp(time)), digits=2), gain=gain)
        for name, (gain, time, numbers) in replacements.items()
        if numbers <= needed_before()
    ]
    return states, sentences, remarks


def _needed_by_fit(problem: CalibrationProblem, fit: InnovationsFit) -> int:
    """Return how many numbers the log needs where it was fitted."""
    deviations = np.sqrt(np.nanmean(fit.innovations**2, axis=0))
    objective = Objective(problem, Fit(fit.t, problem.x0, deviations, 0.0, np.zeros((0, 0))))
    return needed_numbers(objective, objective.free_of(fit.v))


def needed_numbers(objective: Objective, z: FloatArray) -> int:
    """Return how many of the free variables the log needs at a maximum ``z``: constants, correlations, and variances
    that it distinguishes from zero, one after the other."""
    value, held, unneeded = objective(z)[0], z.copy(), 0
    places = [int(i) for i in np.flatnonzero(objective.is_q | objective.is_r)]
    for i in sorted(places, key=lambda i: objective(_collapsed_at(objective, z, i))[0]):
        trial = _collapsed_at(objective, held, i)
        reached = objective(trial)[0]
        if reached - value < COLLAPSE_NATS:
            held, value, unneeded = trial, min(value, reached), unneeded + 1
    return objective.size - unneeded


def _collapsed_at(objective: Objective, z: FloatArray, i: int) -> FloatArray:
    """Return free variables of which one variance is next to nothing, or the least that it may be."""
    trial = z.copy()
    trial[i] = max(z[i] - COLLAPSE, objective.low[i])
    return trial


def hidden_faults(problem: CalibrationProblem, fit: InnovationsFit, states: NoiseStates) -> tuple[str, ...]:
    """Return the faults of a nonlinear plant that the outputs determine at nominal constant inputs, but not beside the
    offsets of sensors."""
    inner = problem.plant.inner if isinstance(problem.plant, PlantWithNoise) else problem.plant
    if not isinstance(inner, NonlinearPlant) or not inner.model.nq:
        return ()
    model, unidentifiable = inner.model, []
    u = np.tile(model.nominal_input, (NOMINAL_SAMPLES, 1))
    for plant in (model, cast(DAEModel, with_noise(model, offset=states.offsets)[0])):
        try:
            result = identifiability(plant, u, dt=problem.log.dt, R=np.diag(fit.R), method=problem.integration)
        except SolverError:
            return ()
        unidentifiable.append(result.unidentifiable)
    return tuple(name for name in model.parameter_names if name in unidentifiable[1] and name not in unidentifiable[0])


def _proposals(problem: CalibrationProblem, fit: InnovationsFit) -> set[tuple[str, str]]:
    """Return kinds and names that innovations ask for: coloured noise of a sensor where those of one are not white or
    an equation has process noise, which may stand for it; offsets that explain more of them than constants can; unknown
    inputs."""
    proposed = {("walk", name) for name in problem.plant.unknown_inputs}
    names, ny = problem.output_names, len(problem.output_names)
    coloured = [whiteness(column).probability < SIGNIFICANT for column in fit.whitened.T]
    # Process noise that stands for coloured noise whitens that sensor: the next one pays for it, or none does.
    # A mean is no colour, but a bias.
    hidden = any(coloured) or not np.all(fit.limited_Q)
    proposed |= {
        ("coloured", name)
        for name, own, column in zip(names, coloured, fit.whitened.T, strict=True)
        if own or (hidden and not mean_off(column))
    }
    v = fit.v
    before = whitened_run(problem, v, problem.y)
    moves = [
        (whitened_run(problem, v + step, problem.y) - before) / SMALL_MOVE
        for step in SMALL_MOVE * np.hstack([np.diag(problem.widths), np.zeros((len(fit.t), len(v) - len(fit.t)))])
    ]
    deviations = np.sqrt(np.nanmean(fit.innovations**2, axis=0))
    for j, name in enumerate(names):
        offset = deviations[j] * (np.arange(ny) == j)
        effect = whitened_run(problem, v, problem.y - offset) - before
        if regression_gain(before.ravel(), [move.ravel() for move in moves], effect.ravel()) > LEAST_OFFSET_GAIN:
            proposed.add(("offset", name))
    return proposed


def whitened_run(problem: CalibrationProblem, v: FloatArray, y: FloatArray) -> FloatArray:
    """Return whitened innovations ``(n, ny)`` of other measurements, NaN where nothing was measured."""
    return Likelihood(problem, y).innovations(v)[0]


def _candidates(
    states: NoiseStates, kinds: Sequence[str], outputs: Sequence[str], unknown_inputs: Sequence[str]
) -> Iterator[tuple[str, str, NoiseStates]]:
    for name in outputs:
        if "coloured" in kinds and name not in states.correlations:
            yield "coloured", name, replace(states, correlations={**states.correlations, name: None})
        if "offset" in kinds and name not in states.offsets:
            yield "offset", name, replace(states, offsets=(*states.offsets, name))
    for name in unknown_inputs:
        if "walk" in kinds and name not in states.loads:
            yield "walk", name, replace(states, loads=(*states.loads, name))


def like_problem(problem: CalibrationProblem, new: CalibrationProblem) -> CalibrationProblem:
    """Return a problem with the steps, the inputs and the start of another one, as far as it goes."""
    if (new.integration, new.substeps) != (problem.integration, problem.substeps):
        new = new.integrated(problem.integration, problem.substeps)
    own = len(problem.plant.state_names)
    places = [new.plant.state_names.index(name) for name in problem.plant.state_names]
    P0 = new.P0.copy()
    P0[np.ix_(places, places)] = problem.P0[:own, :own]
    return new.with_start(P0)


def _letters(problem: CalibrationProblem) -> list[tuple[str, str]]:
    """Return letter and name of each variance, in order: an equation and a sensor may share a name."""
    return [*(("Q", name) for name in problem.noisy), *(("R", name) for name in problem.output_names)]


class _SearchStart:
    """Results of a fit, by name, from which a search with one more state begins."""

    def __init__(
        self,
        t: dict[str, float],
        variances: dict[tuple[str, str], float],
        autocorrelations: dict[str, float],
        R: FloatArray,
    ) -> None:
        self.t, self.variances, self.autocorrelations, self.R = t, variances, autocorrelations, R

    @classmethod
    def of(cls, problem: CalibrationProblem, fit: InnovationsFit) -> _SearchStart:
        """Return the results of a fit, and the first autocorrelation of the innovations of each sensor."""
        columns = zip(problem.output_names, fit.whitened.T, strict=True)
        autocorrelations = {name: whiteness(column).first for name, column in columns}
        variances = dict(zip(_letters(problem), (*fit.Q.tolist(), *fit.R.tolist()), strict=True))
        spread = np.nanmean(fit.innovations**2, axis=0)
        return cls(dict(zip(problem.unknown, fit.t.tolist(), strict=True)), variances, autocorrelations, spread)

    def best(self, problem: CalibrationProblem) -> tuple[float, _SearchStart, Callable[[], int]]:
        """Return the least negative log likelihood with another model, what it found, and what counts the numbers that
        the log needs there."""
        plant = problem.plant
        nominal = {name: float(value) for name, value in zip(problem.unknown, problem.nominal, strict=True)}
        best, value = None, np.inf
        for longer in (1.0, 5.0):
            t, variances = nominal | self.t, dict(self.variances)
            for j, name in enumerate(problem.output_names):
                if correlation_name(name) in self.t or noise_state(name) not in problem.noisy:
                    continue
                time = (
                    -longer
                    * problem.log.dt
                    / float(np.log(np.clip(self.autocorrelations[name], *FIRST_AUTOCORRELATIONS)))
                )
                if correlation_name(name) in problem.unknown:
                    t[correlation_name(name)] = float(np.log(time))
                variances["Q", noise_state(name)] = process_variance(
                    COLOURED_SHARE * self.R[j], time, problem.log.dt, problem.integration
                )
                variances["R", name] = (1.0 - COLOURED_SHARE) * variances["R", name]
            start = np.clip([t[name] for name in problem.unknown], problem.low, problem.high)
            fit = Fit(start, problem.x0, np.sqrt(self.R), 0.0, np.zeros((0, 0)))
            objective = Objective(problem, fit)
            full = objective.full(objective.start(start))
            for i, key in enumerate(_letters(problem)):
                if variances.get(key, 0.0) > 0.0:
                    full[objective.nt + i] = np.log(variances[key])
            full[: objective.nt] /= problem.widths
            reached, z = objective.descent(full[objective.free])
            if reached < value and reached < IMPOSSIBLE:
                value, best = reached, (objective, z)
            if not isinstance(plant, PlantWithNoise) or not plant.bounds:
                break
        if best is None:
            return np.inf, self, lambda: 0
        objective, z = best
        Q, R = objective.noise(z)
        variances_at = dict(zip(_letters(problem), (*Q.tolist(), *R.tolist()), strict=True))
        place = _SearchStart(
            dict(zip(problem.unknown, objective.constants(z).tolist(), strict=True)),
            variances_at,
            self.autocorrelations,
            self.R,
        )
        return value, place, lambda: needed_numbers(objective, z)

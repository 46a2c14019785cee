"""The stages in which a calibration is fitted to a log: simulations, steps, timing, innovations, noise and boxes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from obsynth.errors import PreconditionError, SolverError
from obsynth.monitoring.calibration.diagnostics import OUTLYING, standing_out
from obsynth.monitoring.calibration.innovations_fit import InnovationsFit, box_beside, chosen_timing, innovations_fit
from obsynth.monitoring.calibration.integration_error import IntegrationError, integration_error
from obsynth.monitoring.calibration.likelihood import Likelihood
from obsynth.monitoring.calibration.logs import RecordedLog, listed_rows
from obsynth.monitoring.calibration.long_logs import is_long, searched_rows
from obsynth.monitoring.calibration.noise_proposals import like_problem, proposed_states
from obsynth.monitoring.calibration.noise_states import NoiseStates, PlantWithNoise
from obsynth.monitoring.calibration.plants import CalibrationPlant, NonlinearPlant
from obsynth.monitoring.calibration.problem import CalibrationProblem
from obsynth.monitoring.calibration.simulation_error import (
    FIRST_ROWS,
    Fit,
    SimulationError,
    simulation_fits,
    with_observed_start,
)
from obsynth.monitoring.calibration.wrong_runs import wrong_runs
from obsynth.numerics.arrays import read_only
from obsynth.plants.noise import offset_state

#: How often samples that stand out are left out: each time the others are known better.
OUTLIER_ROUNDS = 3

#: Deviations of an innovation that an offset may have which the innovations do not show: of one at twice this size most
#: logs do, and the model gets a state for it.
UNSEEN_OFFSET = 2.0

#: Notes on these.
OFFSETS_ALLOWED = (
    "The box holds beside offsets of {} too small to be seen (a deviation of {:g} innovations each): where the sensors "
    "have none, state this (offset: {{}}), and it is narrower."
)

OFFSETS_UNTRIED = (
    "The box holds where no sensor has an offset: the fit beside offsets that are too small to be seen failed."
)

#: Note on an offset without which the model follows nothing.
OFFSET_TAKEN = "Without an offset of the sensor {} the model does not follow the log: it has a state for it."


@dataclass(frozen=True, eq=False)
class FittedProblem:
    """A fitted problem: the fits of simulations, that of the innovations, the error of backward Euler, and what each
    delay of the inputs loses in nats, where the delay was searched for."""

    problem: CalibrationProblem
    fits: list[Fit]
    fit: InnovationsFit | None
    error: IntegrationError | None
    losses: Mapping[int, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Fitting:
    """Fits problems of one plant: simulations first, then steps that are exact enough, timing, and the innovations."""

    plant: CalibrationPlant
    problem_with: Callable[[NoiseStates, RecordedLog], CalibrationProblem]
    starts: int
    seed: int
    level: float
    note: Callable[[str], object]
    choose_steps: bool
    widen_start: bool
    innovations: bool

    def fitted(self, problem: CalibrationProblem, *, search: bool) -> FittedProblem:
        """Return the fit of a problem; the delay of the inputs is searched for where asked."""
        fits = simulation_fits(problem, self.starts, self.seed, self.note)
        if self.widen_start and (widened := with_observed_start(problem, fits[0])) is not problem:
            problem, fits = widened, simulation_fits(widened, 1, self.seed, self.note, start=fits[0].t)
        error = None
        if self.choose_steps and isinstance(self.plant, NonlinearPlant):
            names, start = problem.names, fits[0]
            states = SimulationError(problem).states(start)[:, : len(self.plant.state_names)]
            theta = np.array(self.plant.theta(names, start.t), dtype=np.float64)
            error = integration_error(
                self.plant.promoted(names), states, problem.u, theta, start.deviations, problem.log.dt
            )
            if error is not None and error.matters:
                self.note("integrating by Radau")
                problem = problem.integrated("radau", problem.substeps)
                fits = simulation_fits(problem, self.starts, self.seed, self.note)
        losses: Mapping[int, float] = {}
        if search:
            problem, fits, losses = chosen_timing(problem, fits, self.seed, self.note, any_start=self.widen_start)
        fit = None
        if self.innovations:
            before = problem, error
            problem, fit, error = _innovations_fitted(problem, fits, self.level, self.note, error)
            if self.widen_start and fit is not None:
                widened = with_observed_start(before[0], fits[0], first=fit.whitened[:FIRST_ROWS])
                if widened is not before[0]:
                    fits = simulation_fits(widened, 1, self.seed, self.note, start=fits[0].t)
                    problem, fit, error = _innovations_fitted(widened, fits, self.level, self.note, before[1])
        return FittedProblem(problem, fits, fit, error, losses)

    def in_stages(
        self, noise_model: NoiseStates, record: RecordedLog, *, search: bool, open_kinds: tuple[str, ...]
    ) -> FittedProblem:
        """Return the fit of a log: on part of its rows, without outliers, with noise of the kinds that are not stated,
        on all rows, and beside offsets that are too small to be estimated.  ``search``: for the delay of the inputs."""
        part = searched_rows(record) if self.innovations else record
        fitted, noise_model, sentences = self.first_fit(
            noise_model, part, search=search, may_take_offsets="offset" in open_kinds
        )
        fitted = self.without_outliers(fitted)
        if fitted.fit is not None and open_kinds:
            fitted = self.with_proposals(fitted, fitted.fit, noise_model, open_kinds, sentences)
        if part is not record and fitted.fit is not None:
            fitted = self.on_all_rows(fitted, fitted.fit, record)
        return self.with_unseen_offsets(fitted) if "offset" in open_kinds else fitted

    def first_fit(
        self, states: NoiseStates, log: RecordedLog, *, search: bool, may_take_offsets: bool
    ) -> tuple[FittedProblem, NoiseStates, list[str]]:
        """Return the fit with the states that were asked for; and with those, and a sentence for each, the offsets of
        sensors that it takes where without them the model explains nothing."""
        try:
            return self.fitted(self.problem_with(states, log), search=search), states, []
        except PreconditionError as error:
            # An offset as large as what a sensor does looks like a model that explains nothing.
            if not may_take_offsets or not self.innovations or error.condition != "explains-nothing":
                raise
            states = replace(states, offsets=log.output_names)
            try:
                fitted = self.fitted(self.problem_with(states, log), search=search)
            except PreconditionError:
                raise error from None
        sentences = [OFFSET_TAKEN.format(name) for name in log.output_names]
        return replace(fitted, problem=fitted.problem.with_notes(*sentences)), states, sentences

    def with_proposals(
        self,
        fitted: FittedProblem,
        fit: InnovationsFit,
        stated: NoiseStates,
        kinds: tuple[str, ...],
        before: list[str],
    ) -> FittedProblem:
        """Return the fit with states of some kinds where its innovations ask for them; ``before``: the notes on
        those that it has."""
        log = fitted.problem.log
        states, sentences, remarks = proposed_states(
            fitted.problem, fit, stated, kinds, lambda states: self.problem_with(states, log), self.note
        )
        if not sentences:
            return replace(fitted, problem=fitted.problem.with_notes(*remarks)) if remarks else fitted
        again = self.fitted(self.problem_with(states, log), search=False)
        # What is white beside coloured noise is less than both: more samples stand out.
        problem = again.problem.with_notes(*before, *sentences, *remarks)
        return self.without_outliers(replace(again, problem=problem, losses=fitted.losses))

    def on_all_rows(self, fitted: FittedProblem, fit: InnovationsFit, log: RecordedLog) -> FittedProblem:
        """Return the fit of the whole log, which begins at that of its first rows."""
        delay = fitted.problem.log.input_delay - log.input_delay
        problem = fitted.problem.with_whole_log(log.shifted(delay) if delay else log)
        for _ in range(OUTLIER_ROUNDS):
            whitened, innovations, variances = Likelihood(problem).innovations(fit.v)
            judged = replace(fit, whitened=whitened, innovations=innovations, variances=variances)
            usual_rows = _without_outlying_rows(problem, judged)
            if usual_rows is None:
                break
            problem = problem.with_log(usual_rows)
        self.note(f"all {log.samples} rows")
        fits = simulation_fits(problem, 1, self.seed, self.note, start=fit.t)
        again, _ = innovations_fit(problem, fits, self.level, self.note, known=fit)
        return replace(fitted, problem=problem, fits=fits, fit=again)

    def with_unseen_offsets(self, fitted: FittedProblem) -> FittedProblem:
        """Return the fit with boxes that hold beside offsets of sensors which are too small to be seen: the wider of
        those without and with offsets of `UNSEEN_OFFSET` deviations."""
        problem, fit = fitted.problem, fitted.fit
        states = problem.plant.states if isinstance(problem.plant, PlantWithNoise) else NoiseStates()
        unseen = [name for name in problem.output_names if name not in states.offsets]
        if fit is None or not unseen or not problem.names:
            return fitted
        own = fit.sides
        self.note("boxes beside offsets")
        wide = like_problem(
            problem, self.problem_with(replace(states, offsets=(*states.offsets, *unseen)), problem.log)
        )
        P0, spread = wide.P0.copy(), np.sqrt(np.nanmean(fit.innovations**2, axis=0))
        for name in unseen:
            place = wide.plant.state_names.index(offset_state(name))
            P0[place, place] = (UNSEEN_OFFSET * spread[problem.output_names.index(name)]) ** 2
        wide = wide.with_start(P0)
        try:
            fits = simulation_fits(wide, 1, self.seed, self.note, start=fit.t)
            beside = box_beside(wide, fits, self.level, self.note, fit if is_long(problem.log) else None)
        except (PreconditionError, SolverError):
            noted = problem.with_notes(OFFSETS_UNTRIED)
            return replace(fitted, problem=noted)
        sides = [
            (min(low, other_low, key=lambda side: side.value), max(high, other_high, key=lambda side: side.value))
            for (low, high), (other_low, other_high) in zip(own, beside, strict=True)
        ]
        noted = problem.with_notes(OFFSETS_ALLOWED.format(", ".join(unseen), UNSEEN_OFFSET))
        return replace(fitted, problem=noted, fit=replace(fit, box=lambda: sides))

    def without_outliers(self, fitted: FittedProblem) -> FittedProblem:
        """Return the fit again without samples that stand out alone or a few in a row: they would make R a multiple of
        what it is."""
        for _ in range(OUTLIER_ROUNDS):
            if fitted.fit is None:
                break
            problem = fitted.problem
            usual_rows = _without_outlying_rows(problem, fitted.fit)
            if usual_rows is None:
                break
            self.note("without samples that stand out")
            fits = simulation_fits(problem.with_log(usual_rows), 1, self.seed, self.note, start=fitted.fit.t)
            again = _innovations_fitted(problem.with_log(usual_rows), fits, self.level, self.note, fitted.error)
            fitted = FittedProblem(again[0], fits, *again[1:], fitted.losses)
        return fitted


def _without_outlying_rows(problem: CalibrationProblem, fit: InnovationsFit) -> RecordedLog | None:
    """Return the log without samples that stand out from what a fit predicts, with a note for each sensor; `None` where
    there are none."""
    alone = standing_out(fit.whitened)
    wrong = alone | wrong_runs(problem, fit)
    if not wrong.any():
        return None
    off, names, log = np.abs(fit.innovations).T, problem.output_names, problem.log
    sentences = [
        f"Samples of {name} stand out by more than {OUTLYING:g} deviations (row "
        f"{listed_rows(log.rows[0] + np.flatnonzero(wrong[:, i]))}): they count as not measured."
        for i, name in enumerate(names)
        if wrong[:, i].any()
    ]
    return replace(
        log,
        y=read_only(np.where(wrong, np.nan, problem.y)),
        notes=(*log.notes, *sentences),
        outliers=tuple(
            np.concatenate([before, off[i, alone[:, i]]])
            for i, before in enumerate(log.outliers or [np.zeros(0)] * len(names))
        ),
    )


def _innovations_fitted(
    problem: CalibrationProblem,
    fits: list[Fit],
    level: float,
    note: Callable[[str], object],
    error: IntegrationError | None,
) -> tuple[CalibrationProblem, InnovationsFit | None, IntegrationError | None]:
    """Return the fit, with the steps that it needs: errors of single steps that are small may move constants still."""
    chosen = error is not None and not error.matters
    exact = problem.integrated("radau", problem.substeps) if chosen else None
    fit, moved = innovations_fit(problem, fits, level, note, exact=exact)
    if error is None or exact is None:
        return problem, fit, error
    if fit is None:
        note("integrating by Radau")
        problem, (fit, _) = exact, innovations_fit(exact, fits, level, note)
    return problem, fit, replace(error, moved=moved)

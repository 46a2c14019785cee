"""The recursion of the descriptor Kalman filter in square roots, with or without parameters.

Moussa Ali et al. 2013, (12) and (18). Missing samples and undetermined directions go through a rank-revealing
factorisation.
"""

from __future__ import annotations

import math
from functools import cached_property

import numpy as np

from obsynth.analysis.time_varying import IntArray, early_rows
from obsynth.errors import PreconditionError, SpecError
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.ranks import UNDETERMINED_SHARE, covariance_factor
from obsynth.numerics.square_root_estimation import (
    DEPENDENT_COLUMN,
    SUSPECT_COLUMN,
    LeastSquaresStep,
    ParameterState,
    least_squares_step,
    rank_revealing_step,
    start_of,
    update,
)
from obsynth.observers.outliers import checked_limit, has_jumped, no_refusals, robust_advance, with_surprise
from obsynth.observers.recursive.sample import RawEstimate, RecursiveState
from obsynth.observers.recursive.settings import RecursiveSettings
from obsynth.observers.recursive.step_model import (
    PreparedStep,
    StepMatrices,
    StepModel,
    but_rounding_of_outputs,
    right_side,
    rounding_of,
    spreads,
    terms_of_right_side,
    with_missing_inputs,
)
from obsynth.observers.taken_inputs import TakenInputs, held_inputs, no_inputs, taken_inputs


class Recursion:
    """The recursion of an observer: what follows from it alone, once for all runs."""

    def __init__(self, settings: RecursiveSettings) -> None:
        self.settings, self.model = settings, chosen_steps(settings)
        self.limit = checked_limit(settings.outliers, settings.outlier_limit)
        adaptation, nx = settings.adaptation, settings.plant.nx
        self.random_walk = adaptation is not None and adaptation.form == "random-walk"
        self.literal = adaptation is not None and adaptation.form == "literal"
        self.directional = adaptation is not None and adaptation.guard == "directional"
        self.window = 1 if adaptation is None else adaptation.window
        self.regular: FloatArray | None = None
        # The factorisation of a step that stays the same; it follows from the step alone.
        self._prepared: PreparedStep | None = None
        factor = covariance_factor(settings.initial_covariance, "initial_covariance")
        nq = 0 if adaptation is None else settings.plant.nq
        self.first = RecursiveState(
            0,
            settings.initial_state.copy(),
            factor,
            np.zeros((nx, nq)),
            np.zeros((nx, 0)),
            start_of(np.zeros(0), np.zeros((0, 0))),
            np.zeros(settings.plant.nu),
            (),
            np.zeros((0, 2)),
            0,
            no_refusals(settings.plant.ny),
            no_inputs(settings.plant.nu),
            None,
            np.zeros((nx, 0)),
        )
        if adaptation is None:
            return
        spread = covariance_factor(adaptation.initial_covariance, "initial_covariance")
        if self.random_walk:
            joint = np.zeros((nx + nq, nx + nq))
            joint[:nx, :nx], joint[nx:, nx:] = factor, spread
            x = np.concatenate([self.first.x, adaptation.initial_parameters])
            empty = np.zeros((nx + nq, 0))
            self.first = self.first._replace(x=x, factor=joint, Upsilon=empty, diffuse=empty, rounding=empty)
            return
        parameters = start_of(adaptation.initial_parameters, spread)
        self.first = self.first._replace(parameters=parameters)
        self.regular = parameters.triangle if adaptation.guard == "regularise" else None

    def advance(self, state: RecursiveState, y: FloatArray, u: FloatArray) -> tuple[RecursiveState, RawEstimate]:
        """Return the state after a sample and what is known at it; NaN in ``y (ny,)`` or ``u (nu,)`` is missing."""
        if self.settings.outliers == "none":
            return self.plain(state, y, u)
        predicted_outputs = self.predicted_outputs if state.k and self._constraints is not None else None
        return robust_advance(
            self.settings.outliers,
            self.limit,
            self.settings.outlier_sizes,
            self.plain,
            self.predicted,
            state,
            y,
            u,
            predicted_outputs=predicted_outputs,
            held=held_inputs(state.u, u) if state.k else None,
        )

    def predicted_outputs(self, state: RecursiveState, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return mean ``(ny,)`` and covariance of outputs before the sample, with its own algebraic equations. They
        come with the next step, but what they say of this sample is known now. Infinite where nothing is."""
        plant, k = self.settings.plant, state.k
        nothing = np.full(plant.ny, np.nan)
        if self._constraints is None or (plant.horizon is not None and k >= plant.horizon):
            return nothing, np.diag(np.full(plant.ny, np.inf))
        try:
            after, _ = self.plain(state, nothing, u)
            corrected, v, G = self._stepped(after, self._constraints.correction(k), np.zeros(0), after.u)
        except PreconditionError:
            # Equations without noise contradict each other within rounding: they judge nothing.
            return nothing, np.diag(np.full(plant.ny, np.inf))
        return self._outputs(self._estimate(corrected, v, G, v, nothing)._replace(k=k), taken_now(state, u))

    def predicted(self, state: RecursiveState, received: FloatArray, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return mean ``(ny,)`` and covariance of outputs from what is received of the next sample. The variance is
        infinite where nothing is known."""
        plant, k = self.settings.plant, state.k
        if k == 0:
            return np.zeros(plant.ny), np.diag(np.full(plant.ny, np.inf))
        return self._outputs(self.plain(state, received, u)[1], taken_now(state, u))

    def _outputs(self, row: RawEstimate, inputs: TakenInputs) -> tuple[FloatArray, FloatArray]:
        """Return mean ``(ny,)`` and covariance of outputs at what is known; the variance is infinite where nothing
        is."""
        plant, k = self.settings.plant, row.k
        C = plant.C.at(k)
        D = plant.D.at(k)
        mean, reach = C @ row.x + D @ inputs.u, C @ row.factor
        covariance = reach @ reach.T + self.settings.R.at(k)
        if inputs.missing is not None:
            covariance = covariance + (D * inputs.missing) @ D.T
        if len(row.parameters.theta):
            Psi = plant.Psi.at(k - 1)
            moved = Psi @ row.parameters.spread
            mean, covariance = mean + Psi @ row.parameters.theta, covariance + moved @ moved.T
        unknown = (np.abs(C @ row.diffuse) > UNDETERMINED_SHARE).any(axis=1)
        covariance[unknown, unknown] = np.inf
        return mean, covariance

    @cached_property
    def _constraints(self) -> StepModel | None:
        """The algebraic equations of a plant that takes them with its next step; none where noise couples them."""
        settings = self.settings
        rows = early_rows(settings.plant, early=not settings.early_constraints)
        if not rows.size or not settings.Q.is_constant:
            return None
        dynamic_rows = np.setdiff1d(np.arange(settings.plant.ne), rows)
        return None if np.any(settings.Q.at(0)[np.ix_(dynamic_rows, rows)]) else steps_of(settings, rows)

    def plain(self, state: RecursiveState, y: FloatArray, u: FloatArray) -> tuple[RecursiveState, RawEstimate]:
        """Take a sample as it is."""
        theta = state.parameters.theta
        inputs = taken_now(state, u)
        u = inputs.u
        if state.k > 0:
            after, v, G = self._stepped(state, self.step_of(state, inputs), y, u)
        elif (first := self.model.first()) is not None:
            after, v, G = self._stepped(state, first, np.zeros(0), u)
        else:
            after, v, G = state, np.zeros(0), np.zeros((0, state.Upsilon.shape[1]))
        gap = v - G @ theta if len(theta) else v
        row = self._estimate(after, v, G, gap, y)
        k, regressors = state.k + 1, (*state.regressors, G)[-self.window :]
        # By place: `_replace` of two or three fields takes as long as a product.
        _, x, factor, Upsilon, diffuse, parameters, _, _, surprises, resets, refused, _, _, rounding = after
        taken = RecursiveState(
            k,
            x,
            factor,
            Upsilon,
            diffuse,
            parameters,
            u,
            regressors,
            surprises,
            resets,
            refused,
            inputs.history,
            inputs.missing,
            rounding,
        )
        return taken, row

    def step_of(self, state: RecursiveState, inputs: TakenInputs) -> StepMatrices:
        """Return the step that ends at a sample after the first, with the noise that missing inputs are."""
        step = self.model.at(state.k - 1)
        parts = [part for part in (state.missing, inputs.returned) if part is not None]
        return step if not parts and inputs.missing is None else with_missing_inputs(step, sum(parts), inputs.missing)

    def _stepped(
        self, state: RecursiveState, step: StepMatrices, y: FloatArray, u: FloatArray
    ) -> tuple[RecursiveState, FloatArray, FloatArray]:
        """Take the step that ends at the sample ``y``; return also innovation and regressor."""
        nq = state.Upsilon.shape[1]
        right = right_side(step, state.x, state.Upsilon, state.u, y, u)
        solved, learned = None, None
        # The product is NaN exactly if a sample is.
        followed = state.diffuse.shape[1] or state.rounding.shape[1]
        if not (self.literal or followed or math.isnan(y.dot(y))):
            self._prepared = PreparedStep.of(step, self._prepared)
            solved = self._prepared.taken(state.factor, right)
        if solved is None:
            terms = terms_of_right_side(step, state.x, state.Upsilon, state.u, y, u)
            solved, learned = self._careful(state, step, but_rounding_of_outputs(right, step, y, u), terms)
        v, G = solved.innovation[:, 0], -solved.innovation[:, 1:]
        parameters, surprises, resets = state.parameters, state.surprises, state.resets
        if nq and self.settings.adaptation is not None:
            if self.settings.adaptation.reset:
                gap, seen = v - G @ parameters.theta, G @ parameters.spread
                nis = float(gap @ np.linalg.solve(np.eye(len(v)) + seen @ seen.T, gap))
                surprises = with_surprise(surprises, nis, len(v))
                if has_jumped(surprises, self.settings.adaptation.reset):
                    # The same estimate, known no better than at the start.
                    parameters, surprises = self.first.parameters._replace(theta=parameters.theta), surprises[:0]
                    resets += 1
            seen, regressor, noise = learned or (v, G, None)
            parameters, _ = update(
                parameters,
                seen,
                regressor,
                forgetting=self.settings.adaptation.forgetting,
                regular=self.regular,
                directional=self.directional,
                noise=noise,
            )
        after = RecursiveState(
            state.k,
            solved.estimate[:, 0],
            solved.factor,
            solved.estimate[:, 1:],
            solved.diffuse,
            parameters,
            state.u,
            state.regressors,
            surprises,
            resets,
            state.refused,
            state.inputs,
            state.missing,
            solved.rounding if len(solved.rounding) else state.rounding,
        )
        return after, v, G

    def _careful(
        self, state: RecursiveState, step: StepMatrices, right: FloatArray, terms: FloatArray
    ) -> tuple[LeastSquaresStep, tuple[FloatArray, FloatArray, FloatArray] | None]:
        """Take a step with missing samples, with undetermined directions, with perfect rows, or of the literal form.
        Return also what the literal form learns from."""
        ne, H = len(step.A), step.H
        S, unknown = spreads(step, state.factor, state.diffuse, state.k, self.settings.state_names)
        rounding = rounding_of(step, state.rounding)
        received = ~np.isnan(right[:, 0])
        complete = bool(received.all())
        if not complete:
            H, S, right, unknown = H[received], S[received], right[received], unknown[received]
            rounding, terms = rounding.of(received), terms[received]
        solved = None
        if not unknown.shape[1] and not rounding.is_followed:
            solved = least_squares_step(H, S, right, least=DEPENDENT_COLUMN if complete else SUSPECT_COLUMN)
        if solved is None:
            solved = rank_revealing_step(H, S, right, unknown, rounding=rounding, terms=terms)
            if complete and solved.diffuse.shape[1] > unknown.shape[1]:
                raise PreconditionError(
                    f"rank H_k is lost at k = {state.k}: the equations and outputs of that step do not determine the "
                    "state.",
                    condition="rank [E; C]",
                )
        if not self.literal or len(H) <= ne:
            return solved, None
        data, regressor, noise = posterior_residual(solved, H, S, right, ne, unknown=unknown)
        return solved, (data[:, 0], regressor, noise)

    def _estimate(
        self, state: RecursiveState, innovation: FloatArray, regressor: FloatArray, gap: FloatArray, y: FloatArray
    ) -> RawEstimate:
        x, factor, diffuse = state.x, state.factor, state.diffuse
        if self.random_walk:
            nx = self.settings.plant.nx
            nq = len(x) - nx
            parameters = ParameterState(x[nx:], np.zeros((nq, nq)), factor[nx:])
            return RawEstimate(
                state.k, x[:nx], factor[:nx], diffuse[:nx], parameters, innovation, np.zeros((0, nq)), gap, y
            )
        parameters = state.parameters
        if len(parameters.theta):
            x = x + state.Upsilon @ parameters.theta
            factor = np.hstack((factor, state.Upsilon @ parameters.spread))
        return RawEstimate(state.k, x, factor, diffuse, parameters, innovation, regressor, gap, y)


def steps_of(settings: RecursiveSettings, late: IntArray) -> StepModel:
    """Return the steps of an observer, with its algebraic equations ``late`` used one step earlier."""
    adaptation, walk = settings.adaptation, None
    if adaptation is not None and adaptation.form == "random-walk":
        walk = covariance_factor(adaptation.walk, "walk")
    return StepModel(settings.plant, settings.Q, settings.R, late=late, walk=walk)


def chosen_steps(settings: RecursiveSettings) -> StepModel:
    """Return the steps that an observer runs on, by its options."""
    late = early_rows(settings.plant, early=settings.early_constraints)
    if settings.early_constraints and not late.size:
        raise SpecError(
            "early_constraints needs equations in which x(k+1) does not appear (rows of E that are zero for every k): "
            "this plant has none. Bring E into that form, or leave the option out.",
            path="method.options.early_constraints",
        )
    return steps_of(settings, late)


def posterior_residual(
    solved: LeastSquaresStep,
    H: FloatArray,
    S: FloatArray,
    right: FloatArray,
    ne: int,
    *,
    unknown: FloatArray,
    columns: int = 1,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return what (18f) learns from: ``y - C x`` weighted by R, its regressor (18d), and a root of its covariance.
    That covariance is not R but one of rank ``rank E + ny - nx`` (Moussa Ali et al. 2013, (18b), (18d), (18f))."""
    gaps = right[ne:] - H[ne:] @ solved.estimate
    triangle = np.asarray(np.linalg.qr(S[ne:].T, mode="r")).T
    if not np.all(np.abs(np.diag(triangle)) > 0.0):
        raise PreconditionError(
            "The literal form (18) divides by R, which is singular: use form 'innovation'.", condition="R nonsingular"
        )
    data = np.eye(len(H))
    gains = None if unknown.shape[1] else least_squares_step(H, S, data)
    if gains is None:
        # Undetermined directions lie in the null space of the outputs that are there: y - C xhat is what it is.
        gains = rank_revealing_step(H, S, data, unknown, mapped=len(H))
    spread = S[ne:] - H[ne:] @ gains.estimate @ S
    weighted = np.linalg.solve(triangle, np.hstack((gaps, spread)))
    regressor, end = slice(columns, gaps.shape[1]), gaps.shape[1]
    return weighted[:, :columns], -weighted[:, regressor], weighted[:, end:]


def taken_now(state: RecursiveState, u: FloatArray) -> TakenInputs:
    """Return what the inputs of the next sample are taken as."""
    return taken_inputs(state.inputs, state.u, u, is_first=state.k == 0)

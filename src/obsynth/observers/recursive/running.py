"""A running recursive observer: one factorisation per sample gives state, regressor, innovation and its regressor."""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from obsynth.analysis.time_varying import early_rows
from obsynth.errors import PreconditionError
from obsynth.numerics.arguments import real_array, real_vector
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.covariances import covariance_factor
from obsynth.numerics.least_squares_step import (
    LeastSquaresStep,
    least_squares_step,
    rank_revealing_step,
)
from obsynth.numerics.recursive_least_squares import ParameterState, start_of, update
from obsynth.observers.recursive.estimates import RecursiveEstimates
from obsynth.observers.recursive.literal_form import posterior_residual
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.observers.recursive.parameter_reset import ParameterReset
from obsynth.observers.recursive.prepared_step import PreparedStep
from obsynth.observers.recursive.random_walk_parameters import RandomWalkParameterSteps, WalkingEarlySteps
from obsynth.observers.recursive.records import measured_record, require_horizon
from obsynth.observers.recursive.step_model import (
    EarlyConstraintSteps,
    PlantSteps,
    StepMatrices,
    StepModel,
    require_in_range,
)


class RawEstimate(NamedTuple):
    """What is known at one sample.

    Fields: k: The sample; x: ``(nx,)``: the state estimate, with the parameters as they are estimated now; factor:
    ``(nx, any)``: square root of its covariance; diffuse: ``(nx, r)``: directions about which nothing is known;
    parameters: Estimate and spreads; empty without parameters; innovation: ``(m,)``: whitened parity innovation of the
    model without parameters; regressor: ``(m, nq)``; nis: Squared length of the innovation at the parameters estimated
    one sample before; y: ``(ny,)``: the outputs that were given, NaN where one was missing.
    """

    k: int
    x: FloatArray
    factor: FloatArray
    diffuse: FloatArray
    parameters: ParameterState
    innovation: FloatArray
    regressor: FloatArray
    nis: float
    y: FloatArray


def step_model_of(observer: RecursiveObserver) -> StepModel:
    """Return the steps that an observer runs on, with its plant rewritten as its options ask."""
    parts, adaptation = (observer.plant, observer.Q, observer.R), observer.adaptation
    walk = None
    if adaptation is not None and adaptation.form == "random-walk":
        walk = covariance_factor(adaptation.walk, "walk")
    if observer.early_constraints:
        rows = early_rows(observer.plant, early=True)
        return EarlyConstraintSteps(*parts, rows) if walk is None else WalkingEarlySteps(*parts, rows, walk)
    return PlantSteps(*parts) if walk is None else RandomWalkParameterSteps(PlantSteps(*parts), walk)


class RunningRecursiveObserver:
    """A running recursive observer: `step` takes y(k) and u(k) and returns the estimates at k.

    Parameters
    ----------
    observer : RecursiveObserver
        At rest.
    """

    def __init__(self, observer: RecursiveObserver) -> None:
        self.observer, self.model, self.k = observer, step_model_of(observer), 0
        adaptation, nx = observer.adaptation, observer.plant.nx
        nq = 0 if adaptation is None else observer.plant.nq
        self.random_walk = adaptation is not None and adaptation.form == "random-walk"
        self.literal = adaptation is not None and adaptation.form == "literal"
        self.x = observer.initial_state.copy()
        self.factor = covariance_factor(observer.initial_covariance, "initial_covariance")
        self.Upsilon, self.diffuse = np.zeros((nx, nq)), np.zeros((nx, 0))
        self.parameters = start_of(np.zeros(0), np.zeros((0, 0)))
        self.regular: FloatArray | None = None
        self.directional = adaptation is not None and adaptation.guard == "directional"
        self.window: deque[FloatArray] = deque(maxlen=1 if adaptation is None else adaptation.window)
        self.u = np.zeros(observer.plant.nu)
        self.alarm: ParameterReset | None = None
        # What the literal form learns from where it is used, and the factorisation of a step that stays the same.
        self.lesson: tuple[FloatArray, FloatArray, FloatArray] | None = None
        self.prepared: PreparedStep | None = None
        if adaptation is None:
            return
        spread = covariance_factor(adaptation.initial_covariance, "initial_covariance")
        if self.random_walk:
            self.x = np.concatenate([self.x, adaptation.initial_parameters])
            joint = np.zeros((nx + nq, nx + nq))
            joint[:nx, :nx], joint[nx:, nx:] = self.factor, spread
            self.factor, self.Upsilon, self.diffuse = joint, np.zeros((nx + nq, 0)), np.zeros((nx + nq, 0))
            return
        self.parameters = start_of(adaptation.initial_parameters, spread)
        self.alarm = ParameterReset(adaptation.reset, self.parameters) if adaptation.reset else None
        self.regular = self.parameters.triangle if adaptation.guard == "regularise" else None

    def step(self, y: ArrayLike, u: ArrayLike = ()) -> RecursiveEstimates:
        """Take one sample, return the estimates at that sample, and keep u(k) for the next.

        Parameters
        ----------
        y : array_like
            Outputs ``(ny,)``; NaN marks a missing one.  y(0) is not used.
        u : array_like, optional
            Known inputs ``(nu,)``.

        Raises
        ------
        SpecError
            A sample has the wrong length, an input is not finite, or the horizon is passed; nothing is changed then.
        PreconditionError
            Rank H_k is lost at this k although no sample is missing.
        """
        plant = self.observer.plant
        outputs = measured_record(np.atleast_2d(real_array(y, "y")), plant.ny)[0]
        inputs = real_vector(u, plant.nu, "u")
        require_horizon(plant.horizon, self.k + 1, early=self.observer.early_constraints)
        return RecursiveEstimates.of(self.observer, [self.raw_step(outputs, inputs)], window=list(self.window))

    def raw_step(self, y: FloatArray, u: FloatArray) -> RawEstimate:
        """Advance without checking the samples.

        Parameters
        ----------
        y, u : FloatArray
            ``(ny,)`` and ``(nu,)``.
        """
        before = self.parameters.theta
        if self.k > 0:
            found = self._advance(self.model.at(self.k - 1), y, u)
        elif isinstance(self.model, EarlyConstraintSteps):
            found = self._advance(self.model.first(), np.zeros(0), u)
        else:
            found = np.zeros(0), np.zeros((0, self.Upsilon.shape[1]))
        self.window.append(found[1])
        self.u = u
        gap = found[0] - found[1] @ before if len(before) else found[0]
        estimate = self._estimate(*found, float(gap @ gap), y)
        self.k += 1
        return estimate

    def _advance(self, step: StepMatrices, y: FloatArray, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Take the step that ends at the sample ``y``; return innovation and regressor."""
        ne, nq = len(step.A), self.Upsilon.shape[1]
        right = np.empty((len(step.H), 1 + nq), order="F")
        right[:ne, 0] = step.A @ self.x + step.B @ self.u
        right[ne : ne + len(y), 0] = y
        if len(step.Dn):
            right[ne + len(y) :, 0] = step.Dn @ u
        if nq:
            right[:ne, 1:] = step.A @ self.Upsilon + step.Phi
            right[ne:, 1:] = -step.Psi
        found = None
        # The product is NaN exactly if a sample is.
        if not (self.literal or self.diffuse.shape[1] or math.isnan(y.dot(y))):
            found = self._fast(step, right)
        if found is None:
            found = self._careful(step, right)
        self.x, self.Upsilon = found.estimate[:, 0], found.estimate[:, 1:]
        self.factor, self.diffuse = found.factor, found.diffuse
        v, G = found.innovation[:, 0], -found.innovation[:, 1:]
        if nq and self.observer.adaptation is not None:
            if self.alarm is not None:
                self.parameters = self.alarm.watched(self.parameters, v, G)
            seen, regressor, noise = self.lesson or (v, G, None)
            self.parameters, _ = update(
                self.parameters, seen, regressor, forgetting=self.observer.adaptation.forgetting, regular=self.regular,
                directional=self.directional, noise=noise,
            )  # fmt: skip
        return v, G

    def _fast(self, step: StepMatrices, right: FloatArray) -> LeastSquaresStep | None:
        """Take a step that is complete; what depends on the matrices alone is kept while they stay the same."""
        if self.prepared is None or step is not self.prepared.step:
            self.prepared = PreparedStep.of(step, self.prepared)
        return self.prepared.taken(self.factor, right)

    def _careful(self, step: StepMatrices, right: FloatArray) -> LeastSquaresStep:
        """Take a step with missing samples, with undetermined directions, with perfect rows, or of the literal form."""
        ne, width, H = len(step.A), self.factor.shape[1], step.H
        S = np.zeros((len(H), max(width + step.noise.shape[1], len(H))))
        S[:ne, :width] = step.A @ self.factor
        S[:, width : width + step.noise.shape[1]] = step.noise
        require_in_range(S, self.factor, self.k, self.observer.state_names)
        unknown = np.zeros((len(H), self.diffuse.shape[1]))
        unknown[:ne] = step.A @ self.diffuse
        kept = ~np.isnan(right[:, 0])
        complete = bool(kept.all())
        if not complete:
            H, S, right, unknown = H[kept], S[kept], right[kept], unknown[kept]
        found = None if unknown.shape[1] or S.shape[1] < len(S) else least_squares_step(H, S, right)
        if found is None:
            found = rank_revealing_step(H, S, right, unknown)
            if complete and found.diffuse.shape[1] > unknown.shape[1]:
                raise PreconditionError(
                    f"rank H_k is lost at k = {self.k}: the equations and outputs of that step do not determine the "
                    "state.", condition="rank [E; C]",
                )  # fmt: skip
        self.lesson = None
        if self.literal and len(H) > ne:
            seen, regressor, noise = posterior_residual(found, H, S, right, ne, unknown=unknown)
            self.lesson = seen[:, 0], regressor, noise
        return found

    def _estimate(self, innovation: FloatArray, regressor: FloatArray, nis: float, y: FloatArray) -> RawEstimate:
        if self.random_walk:
            nx = self.observer.plant.nx
            nq = len(self.x) - nx
            spread = self.factor[nx:]
            known = ParameterState(self.x[nx:], np.zeros((nq, nq)), spread)
            return RawEstimate(
                self.k, self.x[:nx], self.factor[:nx], self.diffuse[:nx], known, innovation, np.zeros((0, nq)), nis, y
            )
        known = self.parameters
        x, factor = self.x, self.factor
        if len(known.theta):
            x = x + self.Upsilon @ known.theta
            factor = np.hstack((factor, self.Upsilon @ known.spread))
        return RawEstimate(self.k, x, factor, self.diffuse, known, innovation, regressor, nis, y)

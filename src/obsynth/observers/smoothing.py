"""Fixed-interval smoothing: the steps of a recursive observer forward, then their estimates corrected backward.

Constant parameters (form ``forgetting``): states at given parameters, which are estimated from both sides.  Parameters
that walk are states of the chain.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from obsynth.errors import PreconditionError
from obsynth.numerics.arguments import whole_number
from obsynth.numerics.arrays import FloatArray, read_only
from obsynth.numerics.ranks import covariance_factor
from obsynth.numerics.square_root_estimation import joint_step
from obsynth.observers.estimates import Estimates
from obsynth.observers.nonlinear.estimates import DAERow, GatheredRows
from obsynth.observers.nonlinear.observer import DAEObserver
from obsynth.observers.nonlinear.steps import DAEState, Steps
from obsynth.observers.records import measured_record, whole_record
from obsynth.observers.recursive.estimates import recursive_estimates
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.observers.recursive.recursion import Recursion
from obsynth.observers.recursive.sample import RawEstimate, RecursiveState, deviations_in
from obsynth.observers.recursive.step_model import StepMatrices, right_side, stacked_noise
from obsynth.observers.smoothing_chain import Node, ParameterInformation, Smoothed, SmootherHistory, StepLinearisation
from obsynth.observers.taken_inputs import taken_inputs
from obsynth.plants.dae_signals import checked_inputs

SmoothedObserver = RecursiveObserver | DAEObserver


def linearisation_of(observer: RecursiveObserver | DAEObserver) -> StepLinearisation:
    """Return how a chain is made of the steps of an observer."""
    if isinstance(observer, RecursiveObserver):
        return _RecursiveLinearisation(observer.recursion)
    return (_ConstantParameters if observer.form == "forgetting" else _WalkingParameters)(observer.steps)


class _Sample(NamedTuple):
    """One sample of an observer at the point where its step was linearised."""

    x: FloatArray  # x, theta: before the measurement
    theta: FloatArray
    F: FloatArray  # F, G, noise: of the step
    G: FloatArray
    noise: FloatArray
    e: FloatArray  # e, H, L, R: innovation, derivatives and covariance of the outputs that are there
    H: FloatArray
    L: FloatArray
    R: FloatArray


class _DAELinearisation(StepLinearisation):
    """Those of an observer of a nonlinear plant: linearised along what it found, as the observer is itself."""

    def __init__(self, steps: Steps) -> None:
        self.steps, settings = steps, steps.settings
        self.nx, self.nq = settings.model.nx, settings.model.nq
        self.bounds, self.lower, self.upper = settings.state_bounds, settings.lower, settings.upper
        self.Q = covariance_factor(settings.Q, "Q")
        self.walk = covariance_factor(settings.random_walk, "random_walk") if self.nq else np.zeros((0, 0))

    def sample(self, before: DAEState, after: DAEState, row: DAERow) -> _Sample:
        """Return a sample as the observer predicted it."""
        theta = self.steps.part(before, "theta")
        x = self.steps.part(after, "x")
        if self.steps.settings.form == "augmented-kalman":
            x = x - self.steps.part(after, "K") @ row.part("innovation")
        else:
            x = x - self.steps.part(after, "Upsilon") @ (self.steps.part(after, "theta") - theta)
        measured = row.measured
        _, H, L = self.steps.graph.functions.outputs(x, theta)
        R = self.steps.settings.R[np.ix_(measured, measured)]
        noise, missing = np.asarray(row.part("noise") @ self.Q), row.part("missing")
        if missing.any():
            noise = np.hstack((noise, covariance_factor(0.5 * (missing + missing.T), "covariance")))
        return _Sample(
            x,
            theta,
            row.part("F"),
            row.part("G"),
            noise,
            row.innovation[measured],
            H[measured],
            L[measured],
            R,
        )

    def through(self, state: DAEState) -> FloatArray:
        """Return the derivative of the state after the measurement by the parameters."""
        K, H, L, Upsilon = (self.steps.part(state, name) for name in ("K", "H", "L", "Upsilon"))
        return np.asarray(Upsilon - K @ (H @ Upsilon + L))

    def own_factor(self, state: DAEState) -> FloatArray:
        """Return a square root of the covariance of the states at given parameters, not for joint ones."""
        K, H, P = (self.steps.part(state, name) for name in ("K", "H", "P"))
        root = covariance_factor(0.5 * (P + P.T), "P")
        noise = covariance_factor(self.steps.settings.R, "R")
        factor = np.hstack((root - K @ (H @ root), K @ noise))
        return np.asarray(np.linalg.qr(factor.T, mode="r")).T


class _ConstantParameters(_DAELinearisation):
    """States at given parameters, and what each sample says of the parameters."""

    def __init__(self, steps: Steps) -> None:
        super().__init__(steps)
        self.forgetting = steps.settings.forgetting

    def begun(self, state: DAEState) -> Node:
        """Return the node of a state from which a chain begins; y(0) corrects the states alone."""
        nothing = np.zeros((0, self.nq))
        return Node(
            self._origin(state),
            self.own_factor(state),
            np.zeros((self.nx, 0)),
            None,
            self._information(state, np.zeros(0), nothing, np.zeros((0, 0))),
        )

    def next(self, node: Node, before: DAEState, after: DAEState, row: DAERow, u: FloatArray) -> Node:
        """Return the node of the next sample."""
        at, theta = self.sample(before, after, row), self.steps.part(after, "theta")
        # The state is corrected where the parameters have moved it already.
        moved = self.steps.part(after, "x")
        y = at.e + self.steps.graph.functions.outputs(at.x, at.theta)[0][row.measured]
        expected, H, L = (part[row.measured] for part in self.steps.graph.functions.outputs(moved, theta))
        nx, count = self.nx, len(y)
        right = np.zeros((nx + count, 1 + self.nq))
        right[:nx, 1:], right[nx:, 0], right[nx:, 1:] = self.steps.part(after, "Upsilon"), y - expected, -L
        root = covariance_factor(at.R, "R") if count else np.zeros((0, 0))
        spread = np.vstack((at.F @ node.factor, np.zeros((count, node.factor.shape[1]))))
        solved, back = joint_step(
            np.vstack((np.eye(nx), H)), spread, stacked_noise(at.noise, root), right, np.zeros((nx + count, 0))
        )
        # Its way back is written about the parameters of this sample.
        offset = back.offset.copy()
        offset[:, 0] -= offset[:, 1:] @ theta
        return Node(
            self._origin(after),
            solved.factor,
            solved.diffuse,
            back._replace(offset=offset),
            self._learnt(before, after, at, node.factor),
        )

    def _origin(self, state: DAEState) -> FloatArray:
        through = self.through(state)
        return np.column_stack(
            (self.steps.part(state, "posterior") - through @ self.steps.part(state, "theta"), through)
        )

    def _learnt(
        self, before: DAEState, after: DAEState, at: _Sample, factor: FloatArray
    ) -> ParameterInformation | None:
        """Return what a sample says of the parameters: its innovation at parameters zero, and how it follows them."""
        Omega = at.H @ self.steps.part(after, "Upsilon") + at.L
        spread = at.H @ np.hstack((at.F @ factor, at.noise))
        Sigma = spread @ spread.T + at.R
        weight = at.R if self.steps.settings.weight == "paper" else Sigma
        if not len(Omega):
            return self._information(after, np.zeros(0), Omega, np.zeros((0, 0)))
        root = np.linalg.cholesky(weight)
        noise = np.linalg.solve(root, np.linalg.cholesky(Sigma))
        v, G = np.linalg.solve(root, at.e + Omega @ at.theta), np.linalg.solve(root, Omega)
        information = self._information(after, v, G, noise)
        return information if information is None else information._replace(is_reset=after.resets > before.resets)

    def _information(
        self, after: DAEState, v: FloatArray, G: FloatArray, noise: FloatArray
    ) -> ParameterInformation | None:
        if not self.nq:
            return None
        theta, S, spread = (self.steps.part(after, name) for name in ("theta", "S", "spread"))
        triangle = np.linalg.inv(np.linalg.cholesky(S))
        return ParameterInformation(
            theta, triangle, covariance_factor(0.5 * (spread + spread.T), "spread"), v, G, noise
        )


class _WalkingParameters(_DAELinearisation):
    """States and parameters together."""

    def begun(self, state: DAEState) -> Node:
        """Return the node of a state from which a chain begins."""
        nx, nq = self.nx, self.nq
        spread = self.steps.part(state, "spread")
        if self.steps.settings.form == "augmented-kalman":
            P, cross = self.steps.part(state, "P"), self.steps.part(state, "cross")
            joint = np.block([[P, cross], [cross.T, spread]])
            factor = covariance_factor(0.5 * (joint + joint.T), "covariance")
        else:
            root = covariance_factor(0.5 * (spread + spread.T), "spread")
            factor = stacked_noise(self.own_factor(state), root)
            factor[:nx, nx:] = self.through(state) @ root
        return Node(self._posterior(state)[:, None], factor, np.zeros((nx + nq, 0)), None)

    def _posterior(self, state: DAEState) -> FloatArray:
        return np.concatenate((self.steps.part(state, "posterior"), self.steps.part(state, "theta")))

    def next(self, node: Node, before: DAEState, after: DAEState, row: DAERow, u: FloatArray) -> Node:
        """Return the node of the next sample."""
        at, nx, nq = self.sample(before, after, row), self.nx, self.nq
        count = len(at.e)
        F = np.block([[at.F, at.G], [np.zeros((nq, nx)), np.eye(nq)]])
        noise = stacked_noise(at.noise, self.walk)
        # The parameters of a sample act in the step that leads there.
        noise[:nx, at.noise.shape[1] :] = at.G @ self.walk
        factor = node.factor
        if after.resets > before.resets:
            # Nothing is known of the parameters from before: they begin anew, beside the states.
            begun = np.vstack(
                (
                    np.zeros((nx, nq)),
                    covariance_factor(self.steps.settings.initial_parameter_covariance, "initial_parameter_covariance"),
                )
            )
            factor = np.vstack((factor[:nx], np.zeros((nq, factor.shape[1]))))
            noise = np.hstack((noise, F @ begun))
        right = np.concatenate((np.zeros(nx + nq), at.e))[:, None]
        root = covariance_factor(at.R, "R") if count else np.zeros((0, 0))
        spread = np.vstack((F @ factor, np.zeros((count, factor.shape[1]))))
        rows = np.vstack((np.eye(nx + nq), np.hstack((at.H, at.L))))
        solved, back = joint_step(rows, spread, stacked_noise(noise, root), right, np.zeros((len(rows), 0)))
        # The observer's own estimate, which keeps to the bounds.
        return Node(self._posterior(after)[:, None], solved.factor, solved.diffuse, back)


class _RecursiveLinearisation(StepLinearisation):
    """Those of a recursive observer."""

    def __init__(self, recursion: Recursion) -> None:
        if recursion.literal:
            raise PreconditionError(
                "Form 'literal' learns from residuals that are correlated in time, for which no smoother exists: use "
                "form 'innovation' or 'random-walk'.",
                condition="white residuals",
            )
        self.recursion, self.start, settings = recursion, recursion.first, recursion.settings
        self.forgetting = 1.0 if settings.adaptation is None else settings.adaptation.forgetting
        self.bounds = settings.state_bounds

    def first(self, after: RecursiveState, row: RawEstimate, u: FloatArray) -> Node:
        """Return the node of k = 0."""
        start = self.start
        origin = np.column_stack((start.x, start.Upsilon))
        node = Node(origin, start.factor, np.zeros((len(start.x), 0)), None)
        if (step := self.recursion.model.first()) is not None:
            node = self._linked(node, step, start.u, np.zeros(0), u)._replace(back=None)
        return node._replace(information=self._information(start, after, row))

    def begun(self, state: RecursiveState) -> Node:
        """Return the node of a state from which a chain begins."""
        parameters, nq = state.parameters, len(state.parameters.theta)
        information = None
        if nq:
            information = ParameterInformation(
                parameters.theta,
                parameters.triangle,
                parameters.spread,
                np.zeros(0),
                np.zeros((0, nq)),
                np.zeros((0, 0)),
            )
        return Node(np.column_stack((state.x, state.Upsilon)), state.factor, state.diffuse, None, information)

    def next(self, node: Node, before: RecursiveState, after: RecursiveState, row: RawEstimate, u: FloatArray) -> Node:
        """Return the node of the next sample."""
        inputs = taken_inputs(before.inputs, before.u, u, is_first=False)
        step = self.recursion.step_of(before, inputs)
        return self._linked(node, step, before.u, row.y, inputs.u)._replace(
            information=self._information(before, after, row)
        )

    def _linked(self, node: Node, step: StepMatrices, before: FloatArray, y: FloatArray, u: FloatArray) -> Node:
        """Take a step from inputs ``before`` to the sample ``y`` with inputs ``u``."""
        ne, right = len(step.A), right_side(step, node.origin[:, 0], node.origin[:, 1:], before, y, u)
        spread, unknown = (np.zeros((len(step.H), part.shape[1])) for part in (node.factor, node.diffuse))
        spread[:ne], unknown[:ne] = step.A @ node.factor, step.A @ node.diffuse
        received = ~np.isnan(right[:, 0])
        parts = (step.H, spread, step.noise, right, unknown)
        complete = bool(received.all())
        solved, back = joint_step(*(parts if complete else tuple(part[received] for part in parts)), complete=complete)
        return Node(*solved, back)

    def _information(
        self, before: RecursiveState, after: RecursiveState, row: RawEstimate
    ) -> ParameterInformation | None:
        parameters = after.parameters
        if not len(parameters.theta):
            return None
        G = row.regressor if row.regressor.size else np.zeros((len(row.innovation), len(parameters.theta)))
        return ParameterInformation(
            parameters.theta,
            parameters.triangle,
            parameters.spread,
            row.innovation,
            G,
            np.eye(len(row.innovation)),
            after.resets > before.resets,
        )


def smoothed_estimates(observer: SmoothedObserver, rows: list[Any], smoothed: list[Smoothed]) -> Estimates:
    """Return the estimates of smoothed samples; innovations and what belongs to them are those of the observer."""
    if isinstance(observer, RecursiveObserver):
        filtered = recursive_estimates(observer, rows)
    else:
        gathered = GatheredRows(observer)
        for row in rows:
            gathered.add(row)
        filtered = gathered.estimates()
    nx = len(observer.state_names)
    parameters = [parameters_of(sample, nx) for sample in smoothed]
    deviations = [deviations_in(sample.factor, sample.diffuse)[:nx] for sample in smoothed]
    spreads = np.array([spread @ spread.T for _, spread in parameters]).reshape(filtered.fault_covariances.shape)
    return replace(
        filtered,
        states=read_only(np.array([sample.x[:nx] for sample in smoothed]).reshape(filtered.states.shape)),
        state_deviations=read_only(np.array(deviations).reshape(filtered.states.shape)),
        faults=read_only(np.array([theta for theta, _ in parameters]).reshape(filtered.faults.shape)),
        fault_covariances=read_only(spreads),
    )


def parameters_of(sample: Smoothed, nx: int) -> tuple[FloatArray, FloatArray]:
    """Return the parameters of a sample and a square root of their covariance."""
    if len(sample.x) > nx:
        return sample.x[nx:], sample.factor[nx:]
    return sample.theta, sample.spread


def checked_lag(lag: Any) -> int | None:
    """Return the lag of a smoother in samples, or ``None`` for the whole record."""
    if lag is None:
        return None
    return whole_number(lag, "lag", "how many samples are waited for, or None for the whole record")


def smoothed_record(observer: SmoothedObserver, y: ArrayLike, u: ArrayLike | None, lag: int | None) -> Estimates:
    """Return smoothed estimates of a whole record of arrays (``y (samples, ny)``, ``u (samples, nu)``)."""
    if isinstance(observer, RecursiveObserver):
        outputs, inputs = whole_record(y, u, observer.plant.ny, observer.plant.nu)
    else:
        outputs = measured_record(y, observer.model.ny)
        inputs = checked_inputs(observer.model, u, len(outputs))
    if not len(outputs):
        return observer.run(outputs, inputs)
    state, chain, smoothed = observer.init(), SmootherHistory(linearisation_of(observer)), list[Smoothed]()
    for k in range(len(outputs)):
        state, _ = observer.accept(state, outputs[k], inputs[k], chain.add)
        if lag is not None and k >= lag:
            # Values that come later than that change the samples behind them.
            smoothed.append(chain.smoothed(k - lag, k)[0])
    smoothed += chain.smoothed(len(smoothed), len(outputs) - 1)
    return smoothed_estimates(observer, chain.rows, smoothed)

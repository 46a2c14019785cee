"""The samples of a run as a chain that can be followed backwards: what the end of a record says of its beginning.

An observer that keeps what it needs to be followed backwards, and whole records of arrays through it.

The chains of observers: the steps of each again, with the way back.

Constant parameters (form ``forgetting``): states at given parameters, which are estimated from both sides.  Parameters
that walk are states of the chain.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import replace
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from obsynth.errors import PreconditionError
from obsynth.numerics.arguments import whole_number
from obsynth.numerics.arrays import FloatArray, read_only
from obsynth.numerics.ranks import covariance_factor
from obsynth.numerics.square_root_estimation import Gaussian, SmootherGain, joint_step, nothing_later, stepped_back
from obsynth.observers.estimates import Estimates
from obsynth.observers.nonlinear.estimates import DAERow, GatheredRows
from obsynth.observers.nonlinear.observer import DAEObserver
from obsynth.observers.nonlinear.steps import DAEState, Steps
from obsynth.observers.outliers import projected
from obsynth.observers.records import measured_record, whole_record
from obsynth.observers.recursive.observer import (
    RawEstimate,
    Recursion,
    RecursiveObserver,
    RecursiveState,
    deviations_in,
    recursive_estimates,
)
from obsynth.observers.recursive.step_model import StepMatrices, right_side, stacked_noise
from obsynth.observers.taken_inputs import taken_inputs
from obsynth.plants.dae import checked_inputs

#: What later samples say of constant parameters: weight and weighted data ``(any, nq + 1)``, and a square root of the
#: covariance of the weighted sum ``(nq, any)``.
Later: TypeAlias = tuple[FloatArray, FloatArray]


SmoothedObserver = RecursiveObserver | DAEObserver


class Lesson(NamedTuple):
    """What the samples up to one, and that one itself, say of constant parameters."""

    theta: FloatArray  # ``(nq,)``: the estimate
    triangle: FloatArray  # ``(any, nq)``: its weight is ``triangle' triangle``
    spread: FloatArray  # ``(nq, any)``: square root of its covariance
    v: FloatArray  # v, G: ``v = G theta + noise`` of this sample, ``(m,)`` and ``(m, nq)``
    G: FloatArray
    noise: FloatArray  # ``(m, any)``: square root of the covariance of that noise, in units of the weight
    is_reset: bool = False  # whether what was learnt before this sample is discarded at it


class Node(NamedTuple):
    """One sample of the chain: ``x = origin [1; theta] + factor c + diffuse d`` with parameters theta."""

    origin: FloatArray  # ``(n, 1 + nq)`` of constant parameters, ``(n, 1)`` where they are among the states or none
    factor: FloatArray  # ``(n, any)``
    diffuse: FloatArray  # ``(n, r)``
    back: SmootherGain | None  # to the coordinates of the sample before; `None` at the first
    lesson: Lesson | None = None  # of constant parameters; `None` where there are none


class Smoothed(NamedTuple):
    """One smoothed sample."""

    x: FloatArray  # ``(n,)``
    factor: FloatArray  # ``(n, any)``: square root of its covariance
    diffuse: FloatArray  # ``(n, r)``: directions about which nothing is known
    theta: FloatArray  # ``(nq,)``
    # ``(nq, any)``: square root of their covariance; both empty where parameters are among the states
    spread: FloatArray


def with_lesson(later: Later, lesson: Lesson, forgetting: float) -> Later:
    """Return what one more sample says as well, before those that were taken in; weights fall by the factor.
    It is independent of what earlier samples have learnt, and of the errors of the states at given parameters."""
    triangle, noise = later
    if lesson.is_reset:
        # The change lies here: what came later does not hold before it, and it is the later sample that says so.
        return triangle[:0], noise[:, :0]
    nq = len(noise)
    stacked = np.vstack((triangle, np.column_stack((lesson.G, lesson.v)))) * np.sqrt(forgetting)
    triangle = np.asarray(np.linalg.qr(stacked, mode="r")) if len(stacked) > nq + 1 else stacked
    noise = np.hstack((noise, lesson.G.T @ lesson.noise)) * forgetting
    return triangle, np.asarray(np.linalg.qr(noise.T, mode="r")).T if noise.shape[1] > nq else noise


def beside(lesson: Lesson, later: Later) -> tuple[FloatArray, FloatArray]:
    """Return the parameters, and a square root of their covariance, from both sides."""
    if not len(later[0]):
        return lesson.theta, lesson.spread
    nq = len(lesson.theta)
    stacked = np.vstack((np.column_stack((lesson.triangle, lesson.triangle @ lesson.theta)), later[0]))
    packed: FloatArray = np.asarray(np.linalg.qr(stacked, mode="r"))
    triangle = packed[:nq, :nq]
    sums = np.hstack((lesson.triangle.T @ (lesson.triangle @ lesson.spread), later[1]))
    theta: FloatArray = np.asarray(np.linalg.solve(triangle, packed[:nq, nq]))
    return theta, np.asarray(np.linalg.solve(triangle, np.linalg.solve(triangle.T, sums)))


class Links(ABC):
    """How an observer makes a chain."""

    forgetting = 1.0  # lambda of constant parameters
    bounds: FloatArray | None = None  # ``(nx, 2)``, of the states
    lower: FloatArray | None = None  # ``(nq,)``, of the parameters, as `upper`
    upper: FloatArray | None = None

    @abstractmethod
    def begun(self, state: Any) -> Node:
        """Return the node of a state from which a chain begins."""

    def first(self, after: Any, row: Any, u: FloatArray) -> Node:
        """Return the node of k = 0 from the state after it and its row."""
        return self.begun(after)

    @abstractmethod
    def next(self, node: Node, before: Any, after: Any, row: Any, u: FloatArray) -> Node:
        """Return the node of the next sample, from the states before and after it, its row and its input."""


class Chain:
    """The samples of one run from its start, or from where it went on; the first that is kept is at k ``begin``."""

    def __init__(self, links: Links) -> None:
        self.links = links
        self.nodes: list[Node] = []
        self.rows: list[Any] = []
        self.begin = 0

    @property
    def last(self) -> int:
        """The k of the last sample."""
        return self.begin + len(self.nodes) - 1

    def smoothed(self, first: int, last: int) -> list[Smoothed]:
        """Return the samples from k ``first`` to k ``last`` as those up to ``last`` say, in this order."""
        node = self.nodes[last - self.begin]
        known = nothing_later(node.factor.shape[1], node.diffuse.shape[1], node.origin.shape[1])
        nq = 0 if node.lesson is None else len(node.lesson.theta)
        later: Later = (np.zeros((0, nq + 1)), np.zeros((nq, 0)))
        found = []
        for k in range(last, first - 1, -1):
            node = self.nodes[k - self.begin]
            found.append(_smoothed(self.links, node, known, later))
            if k > first and node.back is not None:
                known = stepped_back(known, node.back)
                if node.lesson is not None:
                    later = with_lesson(later, node.lesson, self.links.forgetting)
        return found[::-1]

    def row(self, k: int) -> Any:
        """Return what the observer said at a sample."""
        return self.rows[k - self.begin]

    def drop_before(self, k: int) -> None:
        """Drop the samples before one, which are not needed any more."""
        count = min(max(k - self.begin, 0), len(self.nodes) - 1)
        del self.nodes[:count], self.rows[:count]
        self.begin += count

    def add(self, before: Any, after: Any, row: Any, u: FloatArray) -> None:
        """Add the sample that leads from one state to another, in place of what was there of it and after it."""
        at = before.k - self.begin
        if not 0 <= at <= len(self.nodes) or (at == 0 and not self.nodes):
            self.nodes, self.rows, self.begin, at = [], [], before.k, 0
        del self.nodes[at:], self.rows[at:]
        if before.k == 0:
            node = self.links.first(after, row, u)
        else:
            node = self.links.next(self.nodes[-1] if at else self.links.begun(before), before, after, row, u)
        self.nodes.append(node)
        self.rows.append(row)


def _smoothed(links: Links, node: Node, known: Gaussian, later: Later) -> Smoothed:
    both = np.hstack((node.factor, node.diffuse))
    x, factor, diffuse = node.origin + both @ known.mean, both @ known.factor, both @ known.diffuse
    theta, spread = np.zeros(0), np.zeros((0, 0))
    if node.lesson is not None:
        theta, spread = beside(node.lesson, later)
    if x.shape[1] > 1:
        factor = np.hstack((factor, x[:, 1:] @ spread))
    estimate = x[:, 0] + x[:, 1:] @ theta if x.shape[1] > 1 else x[:, 0].copy()
    if links.lower is not None and links.upper is not None and node.lesson is not None:
        theta = np.clip(theta, links.lower, links.upper)
    elif links.lower is not None and links.upper is not None and len(links.lower):
        walking = slice(len(estimate) - len(links.lower), None)
        estimate[walking] = np.clip(estimate[walking], links.lower, links.upper)
    if links.bounds is not None:
        states = slice(0, len(links.bounds))
        estimate[states] = projected(estimate[states], factor[states], links.bounds)
    return Smoothed(estimate, factor, diffuse, theta, spread)


def links_of(observer: RecursiveObserver | DAEObserver) -> Links:
    """Return how a chain is made of the steps of an observer."""
    if isinstance(observer, RecursiveObserver):
        return _RecursiveLinks(observer.recursion)
    return (_ConstantLinks if observer.form == "forgetting" else _WalkingLinks)(observer.steps)


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


class _DAELinks(Links):
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
        seen = row.seen
        _, H, L = self.steps.graph.functions.outputs(x, theta)
        R = self.steps.settings.R[np.ix_(seen, seen)]
        noise, missing = np.asarray(row.part("noise") @ self.Q), row.part("missing")
        if missing.any():
            noise = np.hstack((noise, covariance_factor(0.5 * (missing + missing.T), "covariance")))
        return _Sample(
            x,
            theta,
            row.part("F"),
            row.part("G"),
            noise,
            row.innovation[seen],
            H[seen],
            L[seen],
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


class _ConstantLinks(_DAELinks):
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
            self._lesson(state, np.zeros(0), nothing, np.zeros((0, 0))),
        )

    def next(self, node: Node, before: DAEState, after: DAEState, row: DAERow, u: FloatArray) -> Node:
        """Return the node of the next sample."""
        at, theta = self.sample(before, after, row), self.steps.part(after, "theta")
        # The state is corrected where the parameters have moved it already.
        moved = self.steps.part(after, "x")
        y = at.e + self.steps.graph.functions.outputs(at.x, at.theta)[0][row.seen]
        expected, H, L = (part[row.seen] for part in self.steps.graph.functions.outputs(moved, theta))
        nx, count = self.nx, len(y)
        right = np.zeros((nx + count, 1 + self.nq))
        right[:nx, 1:], right[nx:, 0], right[nx:, 1:] = self.steps.part(after, "Upsilon"), y - expected, -L
        root = covariance_factor(at.R, "R") if count else np.zeros((0, 0))
        known = np.vstack((at.F @ node.factor, np.zeros((count, node.factor.shape[1]))))
        found, back = joint_step(
            np.vstack((np.eye(nx), H)), known, stacked_noise(at.noise, root), right, np.zeros((nx + count, 0))
        )
        # Its way back is written about the parameters of this sample.
        offset = back.offset.copy()
        offset[:, 0] -= offset[:, 1:] @ theta
        return Node(
            self._origin(after),
            found.factor,
            found.diffuse,
            back._replace(offset=offset),
            self._learnt(before, after, at, node.factor),
        )

    def _origin(self, state: DAEState) -> FloatArray:
        through = self.through(state)
        return np.column_stack(
            (self.steps.part(state, "posterior") - through @ self.steps.part(state, "theta"), through)
        )

    def _learnt(self, before: DAEState, after: DAEState, at: _Sample, factor: FloatArray) -> Lesson | None:
        """Return what a sample says of the parameters: its innovation at parameters zero, and how it follows them."""
        Omega = at.H @ self.steps.part(after, "Upsilon") + at.L
        spread = at.H @ np.hstack((at.F @ factor, at.noise))
        Sigma = spread @ spread.T + at.R
        weight = at.R if self.steps.settings.weight == "paper" else Sigma
        if not len(Omega):
            return self._lesson(after, np.zeros(0), Omega, np.zeros((0, 0)))
        root = np.linalg.cholesky(weight)
        noise = np.linalg.solve(root, np.linalg.cholesky(Sigma))
        v, G = np.linalg.solve(root, at.e + Omega @ at.theta), np.linalg.solve(root, Omega)
        found = self._lesson(after, v, G, noise)
        return found if found is None else found._replace(is_reset=after.resets > before.resets)

    def _lesson(self, after: DAEState, v: FloatArray, G: FloatArray, noise: FloatArray) -> Lesson | None:
        if not self.nq:
            return None
        theta, S, spread = (self.steps.part(after, name) for name in ("theta", "S", "spread"))
        triangle = np.linalg.inv(np.linalg.cholesky(S))
        return Lesson(theta, triangle, covariance_factor(0.5 * (spread + spread.T), "spread"), v, G, noise)


class _WalkingLinks(_DAELinks):
    """States and parameters together."""

    def begun(self, state: DAEState) -> Node:
        """Return the node of a state from which a chain begins."""
        nx, nq = self.nx, self.nq
        spread = self.steps.part(state, "spread")
        if self.steps.settings.form == "augmented-kalman":
            P, cross = self.steps.part(state, "P"), self.steps.part(state, "cross")
            whole = np.block([[P, cross], [cross.T, spread]])
            factor = covariance_factor(0.5 * (whole + whole.T), "covariance")
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
        known = np.vstack((F @ factor, np.zeros((count, factor.shape[1]))))
        rows = np.vstack((np.eye(nx + nq), np.hstack((at.H, at.L))))
        found, back = joint_step(rows, known, stacked_noise(noise, root), right, np.zeros((len(rows), 0)))
        # The observer's own estimate, which keeps to the bounds.
        return Node(self._posterior(after)[:, None], found.factor, found.diffuse, back)


class _RecursiveLinks(Links):
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
        return node._replace(lesson=self._lesson(start, after, row))

    def begun(self, state: RecursiveState) -> Node:
        """Return the node of a state from which a chain begins."""
        known, nq = state.parameters, len(state.parameters.theta)
        lesson = None
        if nq:
            lesson = Lesson(known.theta, known.triangle, known.spread, np.zeros(0), np.zeros((0, nq)), np.zeros((0, 0)))
        return Node(np.column_stack((state.x, state.Upsilon)), state.factor, state.diffuse, None, lesson)

    def next(self, node: Node, before: RecursiveState, after: RecursiveState, row: RawEstimate, u: FloatArray) -> Node:
        """Return the node of the next sample."""
        known = taken_inputs(before.inputs, before.u, u, is_first=False)
        step = self.recursion.step_of(before, known)
        return self._linked(node, step, before.u, row.y, known.u)._replace(lesson=self._lesson(before, after, row))

    def _linked(self, node: Node, step: StepMatrices, before: FloatArray, y: FloatArray, u: FloatArray) -> Node:
        """Take a step from inputs ``before`` to the sample ``y`` with inputs ``u``."""
        ne, right = len(step.A), right_side(step, node.origin[:, 0], node.origin[:, 1:], before, y, u)
        known, unknown = (np.zeros((len(step.H), part.shape[1])) for part in (node.factor, node.diffuse))
        known[:ne], unknown[:ne] = step.A @ node.factor, step.A @ node.diffuse
        kept = ~np.isnan(right[:, 0])
        parts = (step.H, known, step.noise, right, unknown)
        complete = bool(kept.all())
        found, back = joint_step(*(parts if complete else tuple(part[kept] for part in parts)), complete=complete)
        return Node(*found, back)

    def _lesson(self, before: RecursiveState, after: RecursiveState, row: RawEstimate) -> Lesson | None:
        known = after.parameters
        if not len(known.theta):
            return None
        G = row.regressor if row.regressor.size else np.zeros((len(row.innovation), len(known.theta)))
        return Lesson(
            known.theta,
            known.triangle,
            known.spread,
            row.innovation,
            G,
            np.eye(len(row.innovation)),
            after.resets > before.resets,
        )


def smoothed_estimates(observer: SmoothedObserver, rows: list[Any], found: list[Smoothed]) -> Estimates:
    """Return the estimates of smoothed samples; innovations and what belongs to them are those of the observer."""
    if isinstance(observer, RecursiveObserver):
        known = recursive_estimates(observer, rows)
    else:
        gathered = GatheredRows(observer)
        for row in rows:
            gathered.add(row)
        known = gathered.estimates()
    nx = len(observer.state_names)
    parameters = [parameters_of(sample, nx) for sample in found]
    deviations = [deviations_in(sample.factor, sample.diffuse)[:nx] for sample in found]
    spreads = np.array([spread @ spread.T for _, spread in parameters]).reshape(known.fault_covariances.shape)
    return replace(
        known,
        states=read_only(np.array([sample.x[:nx] for sample in found]).reshape(known.states.shape)),
        state_deviations=read_only(np.array(deviations).reshape(known.states.shape)),
        faults=read_only(np.array([theta for theta, _ in parameters]).reshape(known.faults.shape)),
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
    state, chain, found = observer.init(), Chain(links_of(observer)), list[Smoothed]()
    for k in range(len(outputs)):
        state, _ = observer.accept(state, outputs[k], inputs[k], chain.add)
        if lag is not None and k >= lag:
            # Values that come later than that change the samples behind them.
            found.append(chain.smoothed(k - lag, k)[0])
    found += chain.smoothed(len(found), len(outputs) - 1)
    return smoothed_estimates(observer, chain.rows, found)

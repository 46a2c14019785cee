"""The chain of a recursive observer: its steps again, each with the way back."""

from __future__ import annotations

import numpy as np

from obsynth.errors import PreconditionError
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.square_root_smoothing import joint_step
from obsynth.observers.recursive.recursion import RawEstimate, Recursion, RecursiveState
from obsynth.observers.recursive.step_model import EarlyConstraintSteps, StepMatrices
from obsynth.observers.smoothing.chain import Lesson, Links, Node


def recursive_links(recursion: Recursion) -> Links:
    """Return how a chain is made of the steps of a recursive observer."""
    if recursion.literal:
        raise PreconditionError(
            "Form 'literal' learns from residuals that are correlated in time, of which no smoother exists: use form "
            "'innovation' or 'random-walk'.", condition="white residuals",
        )  # fmt: skip
    adaptation = recursion.settings.adaptation
    own = _RecursiveLinks(recursion)
    return Links(
        own.first,
        own.next,
        own.begun,
        1.0 if adaptation is None else adaptation.forgetting,
        recursion.settings.state_bounds,
    )


class _RecursiveLinks:
    def __init__(self, recursion: Recursion) -> None:
        self.recursion, self.start = recursion, recursion.first

    def first(self, after: RecursiveState, row: RawEstimate, u: FloatArray) -> Node:
        """Return the node of k = 0."""
        start = self.start
        origin = np.column_stack((start.x, start.Upsilon))
        node = Node(origin, start.factor, np.zeros((len(start.x), 0)), None)
        if isinstance(self.recursion.model, EarlyConstraintSteps):
            step = self.recursion.model.first()
            node = self._linked(node, step, np.zeros(0), np.zeros(0), u)._replace(back=None)
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
        step = self.recursion.model.at(before.k - 1)
        return self._linked(node, step, before.u, row.y, u)._replace(lesson=self._lesson(before, after, row))

    def _linked(self, node: Node, step: StepMatrices, before: FloatArray, y: FloatArray, u: FloatArray) -> Node:
        """Take a step from inputs ``before`` to the sample ``y`` with inputs ``u``."""
        ne, columns = len(step.A), node.origin.shape[1]
        right = np.empty((len(step.H), columns))
        right[:ne] = step.A @ node.origin
        right[:ne, 0] += step.B @ before if len(before) else 0.0
        right[ne : ne + len(y), 0] = y
        right[ne + len(y) :, 0] = step.Dn @ u
        if columns > 1:
            right[:ne, 1:] += step.Phi
            right[ne:, 1:] = -step.Psi
        known, unknown = (np.zeros((len(step.H), part.shape[1])) for part in (node.factor, node.diffuse))
        known[:ne], unknown[:ne] = step.A @ node.factor, step.A @ node.diffuse
        kept = ~np.isnan(right[:, 0])
        parts = (step.H, known, step.noise, right, unknown)
        complete = bool(kept.all())
        found = joint_step(*(parts if complete else tuple(part[kept] for part in parts)), complete=complete)
        return Node(found.estimate, found.factor, found.diffuse, found.back)

    def _lesson(self, before: RecursiveState, after: RecursiveState, row: RawEstimate) -> Lesson | None:
        known = after.parameters
        if not len(known.theta):
            return None
        G = row.regressor if row.regressor.size else np.zeros((len(row.innovation), len(known.theta)))
        return Lesson(known.theta, known.triangle, known.spread, row.innovation, G, np.eye(len(row.innovation)),
                      after.resets > before.resets)  # fmt: skip

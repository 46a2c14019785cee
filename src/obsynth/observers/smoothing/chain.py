"""The samples of a run as a chain that can be followed backwards: what the end of a record says of its beginning."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.ranks import UNDETERMINED_SHARE
from obsynth.numerics.square_root_estimation import Gaussian, SmootherGain, nothing_later, stepped_back
from obsynth.observers.outliers import projected


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


class LaterLessons:
    """Constant parameters from the samples after one, with weights that fall by the forgetting factor.
    They are independent of what the sample itself has learnt, and of the errors of the states at given parameters."""

    def __init__(self, forgetting: float, nq: int) -> None:
        self.forgetting = forgetting
        # Weight and weighted data ``(any, nq + 1)``; square root of the covariance of the weighted sum ``(nq, any)``.
        self.triangle, self.noise = np.zeros((0, nq + 1)), np.zeros((nq, 0))

    def add(self, lesson: Lesson) -> None:
        """Take in one more sample, before those that were taken in."""
        if lesson.is_reset:
            # The change lies here: what came later does not hold before it, and it is the later sample that says so.
            self.triangle, self.noise = self.triangle[:0], self.noise[:, :0]
            return
        share, nq = self.forgetting, len(self.noise)
        stacked = np.vstack((self.triangle, np.column_stack((lesson.G, lesson.v)))) * np.sqrt(share)
        self.triangle = np.asarray(np.linalg.qr(stacked, mode="r")) if len(stacked) > nq + 1 else stacked
        noise = np.hstack((self.noise, lesson.G.T @ lesson.noise)) * share
        self.noise = np.asarray(np.linalg.qr(noise.T, mode="r")).T if noise.shape[1] > nq else noise

    def beside(self, lesson: Lesson) -> tuple[FloatArray, FloatArray]:
        """Return the parameters, and a square root of their covariance, from both sides."""
        nq = len(lesson.theta)
        if not len(self.triangle):
            return lesson.theta, lesson.spread
        stacked = np.vstack((np.column_stack((lesson.triangle, lesson.triangle @ lesson.theta)), self.triangle))
        packed: FloatArray = np.asarray(np.linalg.qr(stacked, mode="r"))
        triangle = packed[:nq, :nq]
        sums = np.hstack((lesson.triangle.T @ (lesson.triangle @ lesson.spread), self.noise))
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


def smoothed_from(links: Links, nodes: Sequence[Node], begin: int, end: int) -> list[Smoothed]:
    """Return the samples ``begin ... end`` as those up to ``end`` say, in this order."""
    last = nodes[end]
    columns = last.origin.shape[1]
    known = nothing_later(last.factor.shape[1], last.diffuse.shape[1], columns)
    later = LaterLessons(links.forgetting, 0 if last.lesson is None else len(last.lesson.theta))
    found = []
    for i in range(end, begin - 1, -1):
        node = nodes[i]
        found.append(_smoothed(links, node, known, later))
        if i > begin and node.back is not None:
            known = stepped_back(known, node.back)
            if node.lesson is not None:
                later.add(node.lesson)
    return found[::-1]


def _smoothed(links: Links, node: Node, known: Gaussian, later: LaterLessons) -> Smoothed:
    both = np.hstack((node.factor, node.diffuse))
    x, factor, diffuse = node.origin + both @ known.mean, both @ known.factor, both @ known.diffuse
    theta, spread = np.zeros(0), np.zeros((0, 0))
    if node.lesson is not None:
        theta, spread = later.beside(node.lesson)
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


def deviations_in(factor: FloatArray, diffuse: FloatArray) -> FloatArray:
    """Return standard deviations ``(n,)``, infinite where a state is undetermined."""
    deviations = np.sqrt(np.einsum("ij,ij->i", factor, factor))
    return np.where((np.abs(diffuse) > UNDETERMINED_SHARE).any(axis=1), np.inf, deviations)

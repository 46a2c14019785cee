"""The samples of a run, linked for backward smoothing."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.square_root_estimation import SmootherGain, SquareRootGaussian, nothing_later, stepped_back
from obsynth.observers.outliers import projected

#: What later samples say of constant parameters: weight and weighted data ``(any, nq + 1)``, and a square root of the
#: covariance of the weighted sum ``(nq, any)``.
Later: TypeAlias = tuple[FloatArray, FloatArray]


class ParameterInformation(NamedTuple):
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
    information: ParameterInformation | None = None  # of constant parameters; `None` where there are none


class Smoothed(NamedTuple):
    """One smoothed sample."""

    x: FloatArray  # ``(n,)``
    factor: FloatArray  # ``(n, any)``: square root of its covariance
    diffuse: FloatArray  # ``(n, r)``: directions about which nothing is known
    theta: FloatArray  # ``(nq,)``
    # ``(nq, any)``: square root of their covariance; both empty where parameters are among the states
    spread: FloatArray


def with_information(later: Later, information: ParameterInformation, forgetting: float) -> Later:
    """Return what one more sample says as well, before those that were taken in; weights fall by the factor.
    It is independent of what earlier samples have learnt, and of the errors of the states at given parameters."""
    triangle, noise = later
    if information.is_reset:
        # The change lies here: what came later does not hold before it, and it is the later sample that says so.
        return triangle[:0], noise[:, :0]
    nq = len(noise)
    stacked = np.vstack((triangle, np.column_stack((information.G, information.v)))) * np.sqrt(forgetting)
    triangle = np.asarray(np.linalg.qr(stacked, mode="r")) if len(stacked) > nq + 1 else stacked
    noise = np.hstack((noise, information.G.T @ information.noise)) * forgetting
    return triangle, np.asarray(np.linalg.qr(noise.T, mode="r")).T if noise.shape[1] > nq else noise


def beside(information: ParameterInformation, later: Later) -> tuple[FloatArray, FloatArray]:
    """Return the parameters, and a square root of their covariance, from both sides."""
    if not len(later[0]):
        return information.theta, information.spread
    nq = len(information.theta)
    stacked = np.vstack((np.column_stack((information.triangle, information.triangle @ information.theta)), later[0]))
    packed: FloatArray = np.asarray(np.linalg.qr(stacked, mode="r"))
    triangle = packed[:nq, :nq]
    sums = np.hstack((information.triangle.T @ (information.triangle @ information.spread), later[1]))
    theta: FloatArray = np.asarray(np.linalg.solve(triangle, packed[:nq, nq]))
    return theta, np.asarray(np.linalg.solve(triangle, np.linalg.solve(triangle.T, sums)))


class StepLinearisation(ABC):
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


class SmootherHistory:
    """The samples of one run from its start, or from where it went on; the first that is kept is at k ``begin``."""

    def __init__(self, links: StepLinearisation) -> None:
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
        coordinates = nothing_later(node.factor.shape[1], node.diffuse.shape[1], node.origin.shape[1])
        nq = 0 if node.information is None else len(node.information.theta)
        later: Later = (np.zeros((0, nq + 1)), np.zeros((nq, 0)))
        samples = []
        for k in range(last, first - 1, -1):
            node = self.nodes[k - self.begin]
            samples.append(_smoothed(self.links, node, coordinates, later))
            if k > first and node.back is not None:
                coordinates = stepped_back(coordinates, node.back)
                if node.information is not None:
                    later = with_information(later, node.information, self.links.forgetting)
        return samples[::-1]

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


def _smoothed(links: StepLinearisation, node: Node, coordinates: SquareRootGaussian, later: Later) -> Smoothed:
    directions = np.hstack((node.factor, node.diffuse))
    x, factor, diffuse = (
        node.origin + directions @ coordinates.mean,
        directions @ coordinates.factor,
        directions @ coordinates.diffuse,
    )
    theta, spread = np.zeros(0), np.zeros((0, 0))
    if node.information is not None:
        theta, spread = beside(node.information, later)
    if x.shape[1] > 1:
        factor = np.hstack((factor, x[:, 1:] @ spread))
    estimate = x[:, 0] + x[:, 1:] @ theta if x.shape[1] > 1 else x[:, 0].copy()
    if links.lower is not None and links.upper is not None and node.information is not None:
        theta = np.clip(theta, links.lower, links.upper)
    elif links.lower is not None and links.upper is not None and len(links.lower):
        walking = slice(len(estimate) - len(links.lower), None)
        estimate[walking] = np.clip(estimate[walking], links.lower, links.upper)
    if links.bounds is not None:
        states = slice(0, len(links.bounds))
        estimate[states] = projected(estimate[states], factor[states], links.bounds)
    return Smoothed(estimate, factor, diffuse, theta, spread)

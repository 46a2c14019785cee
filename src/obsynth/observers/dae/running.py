"""A running observer of a DAE: sample by sample, or whole stretches inside CasADi."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from obsynth.errors import SolverError, SpecError
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.dae.estimates import DAEEstimates, DAERow, GatheredRows
from obsynth.observers.dae.memory_layout import initial_memory
from obsynth.observers.dae.observer import DAEObserver
from obsynth.observers.recursive.records import measured_record
from obsynth.plants.dae.checks import require_known
from obsynth.plants.dae.functions import Compiled, DAEFunctions
from obsynth.plants.dae.step import ImplicitStep

#: A step of backward Euler this much shorter than dt puts a state onto its constraint and moves it no further.
PROJECTION_SHARE = 1e-6
#: Smaller moves, in sizes of the states, are the motion during that step and no projection.
PROJECTION_NOTICE = 1e-5


def _remembered(name: str, text: str) -> property:
    def get(self: RunningDAEObserver) -> FloatArray:
        return self.graph.memory.part(self.memory, name)

    return property(get, doc=text)


class RunningDAEObserver:
    """A running observer.

    Parameters
    ----------
    observer : DAEObserver
        The observer at rest.
    """

    posterior = _remembered("posterior", "The state after the measurement ``(nx,)``.")
    x = _remembered("x", "The state before it, with the parameters as they are estimated now ``(nx,)``.")
    theta = _remembered("theta", "The parameters ``(nq,)``.")
    P = _remembered("P", "Covariance of `x` without what the parameters add ``(nx, nx)``.")
    S = _remembered("S", "S of (17)-(19) ``(nq, nq)``; not of form ``augmented-kalman``.")
    spread = _remembered("spread", "Covariance of the parameters ``(nq, nq)``.")
    Upsilon = _remembered("Upsilon", "``(nx, nq)``.")
    K = _remembered("K", "``(nx, ny)``.")
    H = _remembered("H", "``(ny, nx)``.")
    L = _remembered("L", "``(ny, nq)``.")

    def __init__(self, observer: DAEObserver) -> None:
        self.observer, self.graph = observer, observer.graph
        self.implicit = ImplicitStep(self.graph.functions, observer.dt, largest_move=observer.largest_move)
        self.memory = initial_memory(observer, observer.initial_state)
        self.k, self.u = 0, np.zeros(observer.model.nu)
        self.informations: deque[FloatArray] = deque(maxlen=observer.window)

    def step(self, y: ArrayLike, u: ArrayLike = ()) -> DAEEstimates:
        """Take one sample and return the estimates at that sample.

        Parameters
        ----------
        y : array_like
            Outputs ``(ny,)``; NaN marks a missing one.
        u : array_like, optional
            Known inputs ``(nu,)`` during the step that ends at this sample.

        Raises
        ------
        SpecError
            A sample has the wrong length, or an input is not finite; nothing is changed then.
        SolverError
            The step has no solution; k, iteration and worst equation are named, and nothing is changed.
        """
        model = self.observer.model
        outputs = measured_record(np.atleast_2d(np.asarray(y)), model.ny)[0]
        try:
            inputs = np.atleast_1d(np.asarray(u, dtype=np.float64))
        except (TypeError, ValueError):
            inputs = np.zeros((0, 0))
        if inputs.shape != (model.nu,):
            raise SpecError(f"u must be {model.nu} finite number(s) at k = {self.k}.", path="u")
        require_known(model, inputs[None], self.k)
        before = self.memory, self.u, self.k, self.informations.copy()
        row = self.raw_step(outputs, inputs)
        found = GatheredRows(self.observer)
        try:
            found.add_regular(row)
        except SolverError:
            self.memory, self.u, self.k, self.informations = before
            raise
        return found.estimates(np.array(self.informations))

    def raw_step(self, y: FloatArray, u: FloatArray) -> DAERow:
        """Advance without checking the sample.

        Parameters
        ----------
        y, u : FloatArray
            ``(ny,)`` and ``(nu,)``.
        """
        seen = ~np.isnan(y)
        heard, moved = np.where(seen, y, 0.0), np.zeros(self.observer.model.nx)
        if self.k == 0:
            memory, moved = self.projected(u)
            after, said = self._first(memory, heard, seen)
        else:
            after, said = self._whole(self.memory, np.concatenate([u, heard, seen]))
            if said[-1, 0] != 1.0:
                after, said = self._carefully(heard, seen, u)
        if not np.isfinite(after).all():
            raise SolverError(
                f"The matrix of (7), dF/dx' / dt + dF/dx, is singular at k = {self.k}, or the model is not defined "
                "there: the step has no unique solution.", record={"k": self.k},
            )  # fmt: skip
        row = DAERow(self.graph, self.k, after[:, 0], said[:, 0], seen, moved)
        self.memory, self.u, self.k = after[:, 0], u, self.k + 1
        self.informations.append(row.part("information"))
        return row

    def stretch(self, y: FloatArray, u: FloatArray, run: Callable[..., tuple[FloatArray, ...]]) -> DAERow:
        """Advance over samples until a step is not solved; return what was reached, which may be nothing.

        Parameters
        ----------
        y, u : FloatArray
            ``(samples, ny)`` and ``(samples, nu)``.
        run : callable
            `ObserverGraph.whole` over that many samples.
        """
        seen = ~np.isnan(y)
        arriving = np.hstack([u, np.where(seen, y, 0.0), seen])
        after, said = (found.T for found in run(self.memory, arriving.ravel()))
        good = (said[:, -1] == 1.0) & np.isfinite(after).all(axis=1)
        taken = len(y) if good.all() else int(np.argmin(good))
        rows = DAERow(self.graph, self.k, after[:taken], said[:taken], seen[:taken], np.zeros(0))
        if taken:
            self.memory, self.u, self.k = after[taken - 1].copy(), u[taken - 1], self.k + taken
            self.informations.extend(rows.part("information"))
        return rows

    def projected(self, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Put the initial state onto the algebraic equations; return the memory and how far it moved.

        Parameters
        ----------
        u : FloatArray
            ``(nu,)`` at k = 0.
        """
        model, start = self.observer.model, self.x
        short = ImplicitStep(DAEFunctions(model), PROJECTION_SHARE * self.observer.dt)
        found = short.solve_carefully(start, u, self.theta).x
        if np.abs((found - start) / model.state_scales).max() <= PROJECTION_NOTICE:
            return self.memory, np.zeros_like(start)
        return initial_memory(self.observer, found), found - start

    def _carefully(self, y: FloatArray, seen: FloatArray, u: FloatArray) -> tuple[FloatArray, ...]:
        """Take a step that needs damping or a homotopy: solved outside the graph, and all else in it."""
        solution = self.implicit.solve_carefully(self.posterior, u, self.theta, before=self.u, k=self.k)
        after, said = self._sample(self.memory, solution.stages, u, y, seen)
        said[-2:, 0] = solution.residual, 1.0
        return after, said

    @cached_property
    def _first(self) -> Compiled:
        return Compiled(self.graph.first)

    @cached_property
    def _sample(self) -> Compiled:
        return Compiled(self.graph.sample)

    @cached_property
    def _whole(self) -> Compiled:
        return Compiled(self.graph.whole)

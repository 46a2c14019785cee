"""The steps of an observer of a DAE: sample by sample, or whole stretches inside CasADi."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from obsynth.errors import SolverError
from obsynth.numerics.arrays import FloatArray, all_finite, read_only
from obsynth.numerics.ranks import covariance_factor
from obsynth.observers.nonlinear.estimates import DAERow
from obsynth.observers.nonlinear.layouts import initial_memory
from obsynth.observers.nonlinear.settings import DAESettings
from obsynth.observers.nonlinear.step_graph import ObserverGraph, observer_graph
from obsynth.observers.outliers import checked_limit, has_jumped, no_refusals, projected, robust_advance, with_surprise
from obsynth.observers.taken_inputs import TakenInputs, held_inputs, no_inputs, over_samples, taken_inputs
from obsynth.plants.dae_functions import Compiled
from obsynth.plants.implicit_step import ImplicitStep, onto_constraint


class DAEState(NamedTuple):
    """The state of an observer of a DAE."""

    memory: FloatArray  # laid out as `memory_layout` says
    k: int  # the next sample
    u: FloatArray  # ``(nu,)``: the inputs of the sample before
    informations: tuple[FloatArray, ...]  # ``(nq, nq)`` each: on the parameters, of the latest samples
    refused: FloatArray  # ``(4, ny)``: what `no_refusals` says
    # ``(any, 2)``: normalised squares of the latest innovations, and their degrees of freedom, for resets
    surprises: FloatArray
    resets: int  # how many there were
    inputs: FloatArray  # ``(5, nu)``: what `no_inputs` says


class Steps:
    """The steps of an observer: what follows from it alone, once for all runs."""

    def __init__(self, settings: DAESettings, graph: ObserverGraph | None = None) -> None:
        self.settings, self.graph = settings, observer_graph(settings) if graph is None else graph
        self._compiled: dict[str, Compiled] = {}
        self.limit = checked_limit(settings.outliers, settings.outlier_limit)
        self.implicit = ImplicitStep(self.graph.functions, settings.dt, largest_move=settings.largest_move)
        self._unmoved = read_only(np.zeros(settings.model.nx))
        self._all_there = read_only(np.ones(settings.model.ny))
        self._all_seen = read_only(self._all_there, bool)
        self.first = DAEState(
            initial_memory(settings, settings.initial_state),
            0,
            np.zeros(settings.model.nu),
            (),
            no_refusals(settings.model.ny),
            np.zeros((0, 2)),
            0,
            no_inputs(settings.model.nu),
        )

    def part(self, state: DAEState, name: str) -> FloatArray:
        """Return a part of what is remembered, by its name in `memory_layout`."""
        return self.graph.memory.part(state.memory, name)

    def advance(self, state: DAEState, y: FloatArray, u: FloatArray) -> tuple[DAEState, DAERow]:
        """Return the state after a sample and what is said at it; NaN in ``y (ny,)`` or ``u (nu,)`` is missing."""
        take = self.watched if self.settings.reset else self.plain
        if self.settings.outliers == "none":
            after, row = take(state, y, u)
        else:
            held = held_inputs(state.u, u) if state.k else None
            after, row = robust_advance(
                self.settings.outliers, self.limit, self.settings.outlier_sizes, take, self.predicted, state, y, u,
                held=held,
            )  # fmt: skip
        return (after, row) if self.settings.state_bounds is None else self.within_bounds(after, row)

    def within_bounds(self, state: DAEState, row: DAERow) -> tuple[DAEState, DAERow]:
        """Project the states after a measurement onto their bounds; the next step begins there."""
        bounds = self.settings.state_bounds
        if bounds is None or ((bounds[:, 0] <= row.x) & (row.x <= bounds[:, 1])).all():
            return state, row
        root = covariance_factor(0.5 * (row.covariance + row.covariance.T), "covariance")
        memory, layout = state.memory.copy(), self.graph.memory
        memory[layout.slices["posterior"]] = projected(row.x, root, bounds)
        if self.settings.form == "augmented-kalman":
            memory[layout.slices["x"]] = memory[layout.slices["posterior"]]
        return state._replace(memory=memory), replace(row, memory=memory)

    def watched(self, state: DAEState, y: FloatArray, u: FloatArray) -> tuple[DAEState, DAERow]:
        """Take a sample; where innovations have become too large, again with parameters known no better than at first.
        A jump of a parameter is followed from there at once."""
        after, row = self.plain(state, y, u)
        surprises = with_surprise(state.surprises, float(row.nis), row.degrees) if state.k else state.surprises
        if not has_jumped(surprises, self.settings.reset):
            return after._replace(surprises=surprises), row
        after, row = self.plain(state._replace(memory=self._with_initial_spread(state)), y, u)
        return after._replace(surprises=state.surprises[:0], resets=state.resets + 1), row

    def _with_initial_spread(self, state: DAEState) -> FloatArray:
        """Return what is remembered with the covariance that the parameters had at the start."""
        memory, layout, nq = state.memory.copy(), self.graph.memory, self.settings.model.nq
        spread = np.array(self.settings.initial_parameter_covariance)
        for name in ("S", "spread"):
            if name in layout.shapes:
                memory[layout.slices[name]] = spread.ravel(order="F")
        if "cross" in layout.shapes:
            # A filter of both together carries the old share of the parameters in the state's covariance.
            memory[layout.slices["cross"]] = np.zeros(self.settings.model.nx * nq)
        return memory

    def predicted(self, state: DAEState, received: FloatArray, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return mean ``(ny,)`` and covariance of outputs from what is received of the next sample."""
        after, row = self.plain(state, received, u)
        mean, covariance = self._call("forecast", after.memory, row.row_values)
        return mean[:, 0], covariance

    def plain(self, state: DAEState, y: FloatArray, u: FloatArray) -> tuple[DAEState, DAERow]:
        """Take a sample as it is."""
        seen, received, arriving, moved = self._all_seen, y, self._all_there, self._unmoved
        if math.isnan(y.dot(y)):
            seen = arriving = ~np.isnan(y)
            received = np.where(seen, y, 0.0)
        taken = taken_inputs(state.inputs, state.u, u, is_first=state.k == 0)
        if state.k == 0:
            begun, moved = self.projected(state, u)
            after, said = self._call("first", begun, received, seen)
        elif taken.variances is not None:
            after, said = self._carefully(state, received, seen, taken)
        else:
            after, said = self._call("whole", state.memory, np.concatenate((u, received, arriving)))
            if said[-1, 0] != 1.0:
                after, said = self._carefully(state, received, seen, taken)
        memory = after[:, 0]
        if not all_finite(memory):
            raise SolverError(
                f"The matrix of (7), dF/dx' / dt + dF/dx, is singular at k = {state.k}, or the model is not defined "
                "there: the step has no unique solution.",
                record={"k": state.k},
            )
        row = DAERow(self.graph, state.k, memory, said[:, 0], seen, moved)
        informations = (*state.informations, row.part("information"))[-self.settings.window :]
        return DAEState(memory, state.k + 1, taken.u, informations, *state[4:7], taken.history), row

    def stretch(
        self, state: DAEState, y: FloatArray, u: FloatArray, run: Callable[..., tuple[FloatArray, ...]]
    ) -> tuple[DAEState, DAERow]:
        """Advance until a step is not solved, by `ObserverGraph.whole` over so many samples; return what is reached."""
        seen = ~np.isnan(y)
        arriving = np.hstack([u, np.where(seen, y, 0.0), seen])
        after, said = (part.T for part in run(state.memory, arriving.ravel()))
        good = (said[:, -1] == 1.0) & np.isfinite(after).all(axis=1)
        taken = len(y) if good.all() else int(np.argmin(good))
        rows = DAERow(self.graph, state.k, after[:taken], said[:taken], seen[:taken], np.zeros(0))
        if taken:
            latest = tuple(rows.part("information")[-self.settings.window :])
            informations = (*state.informations, *latest)[-self.settings.window :]
            state = state._replace(
                memory=after[taken - 1].copy(),
                k=state.k + taken,
                u=u[taken - 1],
                informations=informations,
                inputs=over_samples(state.inputs, state.u, u[:taken]),
            )
        return state, rows

    def projected(self, state: DAEState, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Put the initial state onto the algebraic equations; return the memory and how far it moved."""
        start = self.part(state, "x")
        on_constraint = onto_constraint(self.settings.model, start, u, self.part(state, "theta"), self.settings.dt)
        if on_constraint is start:
            return state.memory, np.zeros_like(start)
        return initial_memory(self.settings, on_constraint), on_constraint - start

    def _carefully(
        self, state: DAEState, y: FloatArray, seen: FloatArray, taken: TakenInputs
    ) -> tuple[FloatArray, ...]:
        """Take a step that needs damping or a homotopy, or whose inputs are not all known: solved outside the graph,
        and all else in it."""
        posterior, theta = self.part(state, "posterior"), self.part(state, "theta")
        missing = np.zeros(self.settings.model.nx**2)
        if taken.variances is None:
            solution = self.implicit.solve_carefully(posterior, taken.u, theta, before=state.u, k=state.k)
        else:
            solution = self.implicit.solve(posterior, taken.u, theta, before=state.u, k=state.k)
            (added,) = self._call("unknown", state.memory, solution.stages, taken.u, taken.variances)
            missing = added.ravel(order="F")
        after, said = self._call("sample", state.memory, solution.stages, taken.u, y, seen, missing)
        said[-2:, 0] = solution.residual, 1.0
        return after, said

    def _call(self, name: str, *arguments: FloatArray) -> tuple[FloatArray, ...]:
        """Return what a function of the graph gives, compiled when it is first needed."""
        if name not in self._compiled:
            self._compiled[name] = Compiled(getattr(self.graph, name))
        return self._compiled[name](*arguments)

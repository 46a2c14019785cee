"""The observer of states and parameters of a nonlinear DAE: single steps, and whole records inside CasADi."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from obsynth.errors import SolverError, SpecError, counted
from obsynth.numerics.arguments import checked_value, real_array
from obsynth.numerics.arrays import FloatArray, all_finite, as_given
from obsynth.numerics.ranks import SINGULAR_CONDITION
from obsynth.observers.estimates import Estimates
from obsynth.observers.nonlinear.c_code import DAELibrary
from obsynth.observers.nonlinear.estimates import DAERow, GatheredRows, SampleEstimates, require_regular
from obsynth.observers.nonlinear.settings import DAESettings
from obsynth.observers.nonlinear.step_graph import ObserverGraph
from obsynth.observers.nonlinear.steps import DAEState, Steps
from obsynth.observers.progress import shown_progress
from obsynth.observers.records import measured_record
from obsynth.observers.taken_inputs import require_inputs
from obsynth.plants.dae_functions import Compiled, take_samples
from obsynth.plants.dae_signals import checked_inputs

#: Samples in one call of the C: a tenth of a second or less, so that progress shows and memory stays small.
SAMPLES_PER_CALL = 10_000


def _nothing(steps: Steps) -> DAERow:
    """Return rows of no samples, so that an empty record has estimates of the right shape."""
    graph, model = steps.graph, steps.settings.model
    memory, said = np.zeros((0, graph.memory.size)), np.zeros((0, graph.row.size))
    return DAERow(graph, 0, memory, said, np.zeros((0, model.ny), dtype=bool), np.zeros(model.nx))


def _in_c(
    steps: Steps,
    library: DAELibrary,
    y: FloatArray,
    u: FloatArray,
    keep: Callable[[DAERow], object],
    note: Callable[[int], object],
) -> None:
    moved = np.zeros(0)
    state = library.started()
    for begin in range(0, len(y), SAMPLES_PER_CALL):
        received = y[begin : begin + SAMPLES_PER_CALL]
        after, said = library.record(state, received, u[begin : begin + SAMPLES_PER_CALL])
        if len(after) < len(received):
            # Go there again where the message is written.
            advanced(steps, y, u, bool, note)
            raise SolverError(
                f"The C code stops at k = {begin + len(after)}, but CasADi does not: leave compiled=True out."
            )
        if begin == 0:
            moved = steps.projected(steps.first, u[0])[1]
        keep(DAERow(steps.graph, begin, after, said, ~np.isnan(received[: len(after)]), moved))
        note(begin + len(received))


def advanced(
    steps: Steps,
    y: FloatArray,
    u: FloatArray,
    keep: Callable[[DAERow], object],
    note: Callable[[int], object] = bool,
) -> DAEState:
    """Lead an observer from its start through a record; return its state at the end."""
    calls: dict[int, Compiled] = {}
    state = steps.first

    def alone(k: int) -> None:
        nonlocal state
        state, row = steps.advance(state, y[k], u[k])
        keep(row)

    def together(k: int, length: int) -> int:
        nonlocal state
        if length not in calls:
            calls[length] = Compiled(steps.graph.over(length))
        state, rows = steps.stretch(state, y[k : k + length], u[k : k + length], calls[length])
        keep(rows)
        return len(rows.memory)

    if len(y):
        alone(0)
    take_samples(len(y), together, alone, note)
    return state


def _is_plain(values: ArrayLike, count: int) -> bool:
    """Whether a sample is an array of so many numbers already."""
    return type(values) is np.ndarray and values.dtype == np.float64 and values.shape == (count,)


class DAEObserver(DAESettings):
    """A nonlinear observer: everything that `start` and `run` need, and nothing that depends on data.

    Parameters
    ----------
    model : DAEModel
        The model it runs on.
    dt : float
        Seconds between samples.
    Q : FloatArray
        ``(nx, nx)``: covariance of what is added to the right sides of the equations in each step.
    R : FloatArray
        ``(ny, ny)``: covariance of the sensors, positive definite.
    initial_state, initial_parameters : FloatArray
        ``(nx,)`` and ``(nq,)``.
    initial_covariance, initial_parameter_covariance : FloatArray
        ``P_0 (nx, nx)`` and ``S_0 (nq, nq)``.
    random_walk : FloatArray
        ``(nq, nq)``: covariance of one step of the parameters.
    lower, upper : FloatArray
        ``(nq,)``: bounds of the parameters, infinite where there are none.
    form : {"forgetting", "random-walk", "augmented-kalman"}
        Recursive least squares with a forgetting factor or with parameters that walk; or the extended Kalman filter
        of states and parameters together.
    forgetting : float
        lambda in (0, 1], dimensionless; used by form ``forgetting``.
    guard : {"regularise", "none"}
        Whether S is kept below S_0 where excitation is missing; used by form ``forgetting``.
    weight : {"innovation", "paper"}
        The covariance in (18): of the innovation, or R as printed.
    integration : {"backward-euler", "radau"}
        How F is discretised.
    largest_move : float or None
        In nominal sizes of the states; see `obsynth.plants.implicit_step.ImplicitStep`.
    window : int
        Samples over which excitation is watched.
    outliers, outlier_limit, outlier_sizes, sensors, state_bounds
        As for `RecursiveObserver`.
    reset : float
        Detect and reset: probability, per sample, that innovations which no change has made larger pass the threshold
        above which the covariance of the parameters starts again from S_0.  Zero never resets.

    Raises
    ------
    SpecError
        Something is out of range or has the wrong shape.
    """

    def __repr__(self) -> str:
        return f"<DAEObserver of {self.model!r}>"

    @cached_property
    def steps(self) -> Steps:
        """What follows from the observer alone, made when it is first needed."""
        return Steps(self)

    @property
    def _steps(self) -> Steps:
        return self.steps

    def _trust(self, row: DAERow) -> None:
        if not row.condition <= SINGULAR_CONDITION:
            require_regular(self, row, row.conditions)

    def _sample(self, state: DAEState, y: ArrayLike, u: ArrayLike) -> tuple[FloatArray, FloatArray]:
        outputs = as_given(y, "y", f"y must be {counted(self.model.ny, 'number')} at k = {state.k}.")
        # What can be wrong with plain numbers is an infinity: it is reported below.
        if not (_is_plain(y, self.model.ny) and (all_finite(outputs) or not np.isinf(outputs).any())):
            outputs = measured_record(np.atleast_2d(outputs), self.model.ny)[0]
        if _is_plain(u, self.model.nu) and all_finite(np.asarray(u)):
            return outputs, np.asarray(u)
        try:
            inputs = np.atleast_1d(real_array(u, "u"))
        except SpecError:
            inputs = np.zeros((0, 0))
        require_inputs(inputs, self.model.input_names, state.k)
        return outputs, inputs

    def _estimates(self, state: DAEState, row: DAERow) -> Estimates:
        return SampleEstimates(self, row, state.informations)

    @property
    def graph(self) -> ObserverGraph:
        """The steps of each sample as CasADi functions, built when they are first needed."""
        return self.steps.graph

    @cached_property
    def library(self) -> DAELibrary:
        """The observer in C, compiled when it is first needed.

        Raises
        ------
        SpecError
            There is no compiler, or it fails.
        """
        return DAELibrary(self.steps)

    def run(
        self,
        y: ArrayLike,
        u: ArrayLike | None = None,
        *,
        compiled: bool | None = None,
        progress: bool | Callable[[int], None] | None = None,
    ) -> Estimates:
        """Run over a whole record.

        Parameters
        ----------
        y : array_like
            Outputs ``(samples, ny)``, the first at k = 0; NaN marks a missing one.
        u : array_like, optional
            Known inputs ``(samples, nu)``; ``u(k)`` holds during the step that ends at k, and ``u(0)`` puts the
            initial state onto its constraint.  May be left out when there are none.
        compiled : bool, optional
            ``None`` runs whole stretches inside CasADi, ``False`` each sample by itself, and ``True`` the observer as C
            (a compiler is needed, which takes about a second once for each observer).  The numbers are the same.
        progress : bool or callable, optional
            ``None`` shows a bar on a terminal in runs of more than two seconds, ``True`` everywhere, ``False`` never; a
            function is called with the number of samples that are done.

        Returns
        -------
        Estimates
            One row per sample.

        Raises
        ------
        SpecError
            Shapes do not fit, or an input is not finite (k is named); there is no compiler, but one is needed.
        SolverError
            A step has no solution; k, iteration and worst equation are named.
        """
        checked_value(compiled, "compiled", bool | None)
        outputs = measured_record(y, self.model.ny)
        inputs = checked_inputs(self.model, u, len(outputs))
        alone = self.outside_graph
        if compiled and not self.is_plain:
            raise SpecError(
                "The C code has neither sensors with their own times nor state_bounds: leave compiled=True out.",
                path="compiled",
            )
        if compiled and alone:
            raise SpecError(
                f"The C code has no {alone}: leave compiled=True out, or leave {alone} out.", path="compiled"
            )
        library = self.library if compiled else None
        gathered = GatheredRows(self)
        gathered.add(_nothing(self.steps))
        with shown_progress(progress, len(outputs), "samples") as note:
            if library is not None:
                _in_c(self.steps, library, outputs, inputs, gathered.add_regular, note)
            elif compiled is None and self.is_plain and not alone:
                advanced(self.steps, outputs, inputs, gathered.add_regular, note)
            else:
                state = self.init()
                for k in range(len(outputs)):
                    state, row = self.accept(state, outputs[k], inputs[k])
                    gathered.add(row)
                    note(k + 1)
        return gathered.estimates()

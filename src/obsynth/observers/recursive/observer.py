"""The recursive observer that a time-varying design ships: descriptor Kalman filter, with or without parameters.

A recursive observer from a plant and plain options: used to design one, and to check the one that was shipped.
"""

from __future__ import annotations

import importlib.util
import math
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from obsynth.analysis.time_varying import IntArray, early_rows
from obsynth.errors import PreconditionError, SpecError
from obsynth.numerics.arguments import (
    checked_value,
    is_number,
    real_array,
    real_number,
    real_vector,
    require_kind,
    require_shape,
    truth,
)
from obsynth.numerics.arrays import FloatArray, as_matrix, read_only
from obsynth.numerics.ranks import UNDETERMINED_SHARE, covariance_factor
from obsynth.numerics.square_root_estimation import (
    DEPENDENT_COLUMN,
    SUSPECT_COLUMN,
    SUSPECT_PARITY,
    LeastSquaresStep,
    ParameterState,
    least_squares_step,
    rank_revealing_step,
    start_of,
    update,
)
from obsynth.observers.estimates import Estimates
from obsynth.observers.outliers import (
    Outliers,
    checked_limit,
    has_jumped,
    no_refusals,
    projected,
    robust_advance,
    with_surprise,
)
from obsynth.observers.records import measured_record, require_horizon, whole_record
from obsynth.observers.recursive.settings import Adaptation
from obsynth.observers.recursive.step_model import (
    PreparedStep,
    StepMatrices,
    StepModel,
    right_side,
    spreads,
    stacked_noise,
    with_missing_inputs,
)
from obsynth.observers.running import StepObserver, named_estimates
from obsynth.observers.taken_inputs import TakenInputs, held_inputs, no_inputs, require_inputs, taken_inputs
from obsynth.plants.sequences import MatrixSequence
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem

#: Rows whose arrays are put together at once: more would leave the processor's cache, and their room be made anew.
ROWS_TOGETHER = 256


#: Samples from which the kernel is used unasked: they take seconds without it, which is what loading numba, or the
#: first compilation of an installation, takes.
LONG_RECORD = 100_000

#: Numbers in the state up to which the kernel is faster than LAPACK.
SMALL_ORDER = 25

#: Steps that are prepared together: bounds the memory of plants that vary.
PREPARED_STEPS = 4096

#: Fewer complete samples in a row than this are faster step by step.
SHORT_STRETCH = 8


def deviations_in(factor: FloatArray, diffuse: FloatArray | None = None) -> FloatArray:
    """Return standard deviations ``(n,)``, infinite where a state is undetermined."""
    deviations = np.asarray(np.sqrt(np.einsum("ij,ij->i", factor, factor)))
    return (
        deviations
        if diffuse is None
        else np.where((np.abs(diffuse) > UNDETERMINED_SHARE).any(axis=1), np.inf, deviations)
    )


class RawEstimate(NamedTuple):
    """What is known at one sample."""

    k: int  # the sample
    x: FloatArray  # ``(nx,)``: the state estimate, with the parameters as they are estimated now
    factor: FloatArray  # ``(nx, any)``: square root of its covariance
    diffuse: FloatArray  # ``(nx, r)``: directions about which nothing is known
    parameters: ParameterState  # estimate and spreads; empty without parameters
    innovation: FloatArray  # ``(m,)``: whitened parity innovation of the model without parameters
    regressor: FloatArray  # ``(m, nq)``
    gap: FloatArray  # ``(m,)``: the innovation at the parameters estimated one sample before
    y: FloatArray  # ``(ny,)``: the outputs that were given, NaN where one was missing

    @property
    def theta(self) -> FloatArray:
        """The parameters ``(nq,)``."""
        return self.parameters.theta

    @property
    def parameter_covariance(self) -> FloatArray:
        """Covariance of `theta` ``(nq, nq)``."""
        return self.parameters.spread @ self.parameters.spread.T

    @property
    def state_deviations(self) -> FloatArray:
        """Standard deviations ``(nx,)`` of the states; infinite where one is undetermined."""
        return deviations_in(self.factor, self.diffuse)

    @property
    def whitened(self) -> FloatArray:
        """The innovation in units of its standard deviations, ``(m,)``."""
        return self.innovation

    @property
    def nis(self) -> float:
        """Squared length of `gap`."""
        return float(self.gap @ self.gap)

    @property
    def score(self) -> FloatArray:
        """What the sample says of the parameters ``(nq,)``; nothing where they are states and have no regressor."""
        return np.asarray(self.regressor.T @ self.innovation[: len(self.regressor)])

    @property
    def information(self) -> FloatArray:
        """How much it says of them ``(nq, nq)``."""
        return np.asarray(self.regressor.T @ self.regressor)

    @property
    def is_finite(self) -> bool:
        """Whether no number has overflown; an undetermined state has a finite factor."""
        arrays = (self.x, self.factor, self.theta, self.parameters.spread, self.innovation)
        return all(bool(np.isfinite(array).all()) for array in arrays)


class RecursiveState(NamedTuple):
    """The state of a recursive observer."""

    k: int  # the next sample
    x: FloatArray  # ``(n,)``: estimate of the model without parameters, or of states and parameters of a random walk
    factor: FloatArray  # ``(n, any)``: square root of its covariance
    Upsilon: FloatArray  # ``(nx, nq)``
    diffuse: FloatArray  # ``(n, r)``: directions about which nothing is known
    parameters: ParameterState  # estimate and spreads
    u: FloatArray  # ``(nu,)``: the inputs of the sample before
    regressors: tuple[FloatArray, ...]  # of the latest samples
    # ``(any, 2)``: normalised squares of the latest innovations, and their degrees of freedom, for resets
    surprises: FloatArray
    resets: int  # how many there were
    refused: FloatArray  # ``(4, ny)``: what `no_refusals` says
    inputs: FloatArray  # ``(5, nu)``: what `no_inputs` says
    missing: FloatArray | None  # ``(nu,)``: variances of `u`, where inputs are missing


def recursive_estimates(
    observer: RecursiveObserver, rows: Sequence[RawEstimate], *, window: Sequence[FloatArray] | None = None
) -> Estimates:
    """Return the estimates in rows of a recursive observer: ``window (any, nq)``: regressors of the latest samples,
    when only the last row is given."""
    length = 1 if observer.adaptation is None else observer.adaptation.window
    levels = excitation_levels([row.regressor for row in rows] if window is None else list(window), length)
    levels = levels[len(levels) - len(rows) :]
    if observer.form == "random-walk":
        levels = np.full(len(rows), np.nan)
    nx, nq = observer.plant.nx, len(observer.fault_names)
    most = max((len(row.innovation) for row in rows), default=0)
    innovations, padded = np.full((len(rows), most), np.nan), np.full((len(rows), most, nq), np.nan)
    degrees, nis = np.zeros(len(rows)), np.zeros(len(rows))
    for chosen, part in _alike(rows, "innovation"):
        innovations[chosen, : part.shape[1]], degrees[chosen] = part, part.shape[1]
    for chosen, part in _alike(rows, "regressor"):
        padded[chosen, : part.shape[1]] = part
    for chosen, part in _alike(rows, "gap"):
        # A matrix product for each row, as for a single one.
        nis[chosen] = np.matmul(part[:, None, :], part[:, :, None])[:, 0, 0]
    return named_estimates(
        observer,
        states=np.array([row.x for row in rows]).reshape(len(rows), nx),
        **_spreads(rows, nx, nq),
        innovations=innovations,
        regressors=padded,
        nis=nis,
        nis_degrees=degrees,
        excitation=levels,
        received=read_only(~np.isnan(np.array([row.y for row in rows])).reshape(len(rows), observer.plant.ny), bool),
    )


def _alike(rows: Sequence[RawEstimate], name: str) -> Iterator[tuple[NDArray[np.intp], FloatArray]]:
    """Yield places of rows with arrays of one shape, and these as one array."""
    return _groups([getattr(row, name) for row in rows])


def _groups(arrays: Sequence[FloatArray]) -> Iterator[tuple[NDArray[np.intp], FloatArray]]:
    places = defaultdict[tuple[int, ...], list[int]](list)
    for place, array in enumerate(arrays):
        places[array.shape].append(place)
    for alike in places.values():
        for begin in range(0, len(alike), ROWS_TOGETHER):
            chosen = alike[begin : begin + ROWS_TOGETHER]
            yield np.array(chosen), np.array([arrays[place] for place in chosen])


def _spreads(rows: Sequence[RawEstimate], nx: int, nq: int) -> dict[str, FloatArray]:
    """Return parameters, and the deviations and covariances of states and parameters, infinite where one is open."""
    count = len(rows)
    states, parameters, cross = (np.zeros((count, *shape)) for shape in ((nx, nx), (nq, nq), (nx, nq)))
    deviations = np.zeros((count, nx))
    spreads = [row.parameters.spread for row in rows]
    for chosen, factor in _alike(rows, "factor"):
        deviations[chosen] = np.sqrt(np.einsum("kij,kij->ki", factor, factor))
        states[chosen] = np.matmul(factor, factor.transpose(0, 2, 1))
        for spread_of, spread in _groups([spreads[place] for place in chosen] if nq else []):
            shared = factor[spread_of][:, :, factor.shape[2] - spread.shape[2] :]
            parameters[chosen[spread_of]] = np.matmul(spread, spread.transpose(0, 2, 1))
            cross[chosen[spread_of]] = np.matmul(shared, spread.transpose(0, 2, 1))
    for place, row in enumerate(rows):
        if row.diffuse.shape[1]:
            unknown = (np.abs(row.diffuse) > UNDETERMINED_SHARE).any(axis=1)
            deviations[place, unknown] = np.inf
            states[place, unknown], states[place][:, unknown] = np.nan, np.nan
            states[place, unknown, unknown] = np.inf
    for made in (deviations, states, cross):
        made.setflags(write=False)
    return {
        "state_deviations": deviations,
        "faults": np.array([row.theta for row in rows]).reshape(count, nq),
        "fault_covariances": parameters,
        "state_covariances": states,
        "cross_covariances": cross,
    }


def excitation_levels(regressors: Sequence[FloatArray], window: int) -> FloatArray:
    """Return the least eigenvalue of ``sum G' G`` over the last ``window`` samples, zero while the window fills:
    ``regressors (any, nq)``."""
    nq = regressors[0].shape[1] if regressors else 0
    levels = np.zeros(len(regressors))
    if not nq or len(regressors) < window:
        return levels
    squares = np.empty((len(regressors), nq, nq))
    for chosen, part in _groups(regressors):
        squares[chosen] = np.matmul(part.transpose(0, 2, 1), part)
    # Each window is summed anew: differences of cumulated sums would leave rounding of early, strong excitation.
    count = len(regressors) - window + 1
    totals = squares[:count].copy()
    for later in range(1, window):
        totals += squares[later : later + count]
    levels[window - 1 :] = np.linalg.eigvalsh(totals)[:, 0]
    return np.maximum(levels, 0.0)


def steps_of(settings: RecursiveObserver, late: IntArray) -> StepModel:
    """Return the steps of an observer, with its algebraic equations ``late`` used one step earlier."""
    adaptation, walk = settings.adaptation, None
    if adaptation is not None and adaptation.form == "random-walk":
        walk = covariance_factor(adaptation.walk, "walk")
    return StepModel(settings.plant, settings.Q, settings.R, late=late, walk=walk)


def asked_steps(settings: RecursiveObserver) -> StepModel:
    """Return the steps that an observer runs on, as its options ask."""
    late = early_rows(settings.plant, early=settings.early_constraints)
    if settings.early_constraints and not late.size:
        raise SpecError(
            "early_constraints needs equations in which x(k+1) does not appear (rows of E that are zero for every k): "
            "this plant has none. Bring E into that form, or leave the option out.",
            path="method.options.early_constraints",
        )
    return steps_of(settings, late)


def posterior_residual(
    found: LeastSquaresStep,
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
    gaps = right[ne:] - H[ne:] @ found.estimate
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


class Recursion:
    """The recursion of an observer: what follows from it alone, once for all runs."""

    def __init__(self, settings: RecursiveObserver) -> None:
        self.settings, self.model = settings, asked_steps(settings)
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
        )
        if adaptation is None:
            return
        spread = covariance_factor(adaptation.initial_covariance, "initial_covariance")
        if self.random_walk:
            joint = np.zeros((nx + nq, nx + nq))
            joint[:nx, :nx], joint[nx:, nx:] = factor, spread
            x = np.concatenate([self.first.x, adaptation.initial_parameters])
            empty = np.zeros((nx + nq, 0))
            self.first = self.first._replace(x=x, factor=joint, Upsilon=empty, diffuse=empty)
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
        return self._outputs(self._estimate(corrected, v, G, v, nothing)._replace(k=k))

    def predicted(self, state: RecursiveState, received: FloatArray, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return mean ``(ny,)`` and covariance of outputs from what is received of the next sample. The variance is
        infinite where nothing is known."""
        plant, k = self.settings.plant, state.k
        if k == 0:
            return np.zeros(plant.ny), np.diag(np.full(plant.ny, np.inf))
        return self._outputs(self.plain(state, received, u)[1])

    def _outputs(self, row: RawEstimate) -> tuple[FloatArray, FloatArray]:
        """Return mean ``(ny,)`` and covariance of outputs at what is known; the variance is infinite where nothing
        is."""
        plant, k = self.settings.plant, row.k
        C = plant.C.at(k)
        mean, reach = C @ row.x, C @ row.factor
        covariance = reach @ reach.T + self.settings.R.at(k)
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
        others = np.setdiff1d(np.arange(settings.plant.ne), rows)
        return None if np.any(settings.Q.at(0)[np.ix_(others, rows)]) else steps_of(settings, rows)

    def plain(self, state: RecursiveState, y: FloatArray, u: FloatArray) -> tuple[RecursiveState, RawEstimate]:
        """Take a sample as it is."""
        theta = state.parameters.theta
        known = taken_inputs(state.inputs, state.u, u, is_first=state.k == 0)
        u = known.u
        if state.k > 0:
            after, v, G = self._stepped(state, self.step_of(state, known), y, u)
        elif (first := self.model.first()) is not None:
            after, v, G = self._stepped(state, first, np.zeros(0), u)
        else:
            after, v, G = state, np.zeros(0), np.zeros((0, state.Upsilon.shape[1]))
        gap = v - G @ theta if len(theta) else v
        row = self._estimate(after, v, G, gap, y)
        k, regressors = state.k + 1, (*state.regressors, G)[-self.window :]
        # By place: `_replace` of two or three fields takes as long as a product.
        _, x, factor, Upsilon, diffuse, parameters, _, _, surprises, resets, refused, _, _ = after
        taken = RecursiveState(k, x, factor, Upsilon, diffuse, parameters, u, regressors, surprises, resets, refused,
                               known.history, known.missing)  # fmt: skip
        return taken, row

    def step_of(self, state: RecursiveState, known: TakenInputs) -> StepMatrices:
        """Return the step that ends at a sample after the first, with the noise that missing inputs are."""
        step = self.model.at(state.k - 1)
        parts = [part for part in (state.missing, known.returned) if part is not None]
        return step if not parts and known.missing is None else with_missing_inputs(step, sum(parts), known.missing)

    def _stepped(
        self, state: RecursiveState, step: StepMatrices, y: FloatArray, u: FloatArray
    ) -> tuple[RecursiveState, FloatArray, FloatArray]:
        """Take the step that ends at the sample ``y``; return also innovation and regressor."""
        nq = state.Upsilon.shape[1]
        right = right_side(step, state.x, state.Upsilon, state.u, y, u)
        found, lesson = None, None
        # The product is NaN exactly if a sample is.
        if not (self.literal or state.diffuse.shape[1] or math.isnan(y.dot(y))):
            self._prepared = PreparedStep.of(step, self._prepared)
            found = self._prepared.taken(state.factor, right)
        if found is None:
            found, lesson = self._careful(state, step, right)
        v, G = found.innovation[:, 0], -found.innovation[:, 1:]
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
            seen, regressor, noise = lesson or (v, G, None)
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
            found.estimate[:, 0],
            found.factor,
            found.estimate[:, 1:],
            found.diffuse,
            parameters,
            state.u,
            state.regressors,
            surprises,
            resets,
            state.refused,
            state.inputs,
            state.missing,
        )
        return after, v, G

    def _careful(
        self, state: RecursiveState, step: StepMatrices, right: FloatArray
    ) -> tuple[LeastSquaresStep, tuple[FloatArray, FloatArray, FloatArray] | None]:
        """Take a step with missing samples, with undetermined directions, with perfect rows, or of the literal form.
        Return also what the literal form learns from."""
        ne, H = len(step.A), step.H
        S, unknown = spreads(step, state.factor, state.diffuse, state.k, self.settings.state_names)
        kept = ~np.isnan(right[:, 0])
        complete = bool(kept.all())
        if not complete:
            H, S, right, unknown = H[kept], S[kept], right[kept], unknown[kept]
        found = None
        if not unknown.shape[1] and S.shape[1] >= len(S):
            found = least_squares_step(H, S, right, least=DEPENDENT_COLUMN if complete else SUSPECT_COLUMN)
        if found is None:
            found = rank_revealing_step(H, S, right, unknown)
            if complete and found.diffuse.shape[1] > unknown.shape[1]:
                raise PreconditionError(
                    f"rank H_k is lost at k = {state.k}: the equations and outputs of that step do not determine the "
                    "state.",
                    condition="rank [E; C]",
                )
        if not self.literal or len(H) <= ne:
            return found, None
        seen, regressor, noise = posterior_residual(found, H, S, right, ne, unknown=unknown)
        return found, (seen[:, 0], regressor, noise)

    def _estimate(
        self, state: RecursiveState, innovation: FloatArray, regressor: FloatArray, gap: FloatArray, y: FloatArray
    ) -> RawEstimate:
        x, factor, diffuse = state.x, state.factor, state.diffuse
        if self.random_walk:
            nx = self.settings.plant.nx
            nq = len(x) - nx
            known = ParameterState(x[nx:], np.zeros((nq, nq)), factor[nx:])
            return RawEstimate(state.k, x[:nx], factor[:nx], diffuse[:nx], known, innovation, np.zeros((0, nq)), gap, y)
        known = state.parameters
        if len(known.theta):
            x = x + state.Upsilon @ known.theta
            factor = np.hstack((factor, state.Upsilon @ known.spread))
        return RawEstimate(state.k, x, factor, diffuse, known, innovation, regressor, gap, y)


def stacked_matrices(model: StepModel, first: int, count: int) -> StepMatrices:
    """Return the matrices of steps, each with a new first axis: one entry if it is the same for all, or ``count``."""
    if model.early or model.walk is not None:
        steps = [model.at(k) for k in range(first, first + count)]
        same = all(step is steps[0] for step in steps)
        return StepMatrices(*(np.array(matrices[:1] if same else matrices) for matrices in zip(*steps, strict=True)))
    plant = model.plant
    H = _joined(_stack(plant.E, first + 1, count), _stack(plant.C, first + 1, count))
    last = first + (1 if model.Q.is_constant and model.R.is_constant else count)
    noise = [
        stacked_noise(covariance_factor(model.Q.at(k), f"Q({k})"), covariance_factor(model.R.at(k), f"R({k})"))
        for k in range(first, last)
    ]
    A, B, Phi, Psi = (_stack(sequence, first, count) for sequence in (plant.A, plant.B, plant.Phi, plant.Psi))
    return StepMatrices(H, A, B, Phi, Psi, np.zeros((1, 0, plant.nu)), np.array(noise))


def _stack(sequence: MatrixSequence, first: int, count: int) -> FloatArray:
    if sequence.is_constant:
        return sequence.at(first)[None]
    if sequence.values is not None:
        sequence.at(first + count - 1)
        return np.asarray(sequence.values[first : first + count])
    return np.array([sequence.at(k) for k in range(first, first + count)])


def _joined(above: FloatArray, below: FloatArray) -> FloatArray:
    count = max(len(above), len(below))
    both = [np.broadcast_to(part, (count, *part.shape[1:])) for part in (above, below)]
    return np.concatenate(both, axis=1)


def _products(matrices: FloatArray, rows: FloatArray) -> FloatArray:
    """Return matrix times vector for each row, the matrices being one or as many."""
    if len(matrices) == 1:
        return np.asarray(rows @ matrices[0].T)
    return np.asarray(np.matmul(matrices, rows[:, :, None])[:, :, 0])


def stacked_steps(
    step: StepMatrices, before: FloatArray, y: FloatArray, u: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray] | None:
    """Return steps with H factorised and everything rotated, up to the first H whose rank has to be decided, as
    `obsynth.numerics.compiled_steps.square_root_steps` takes them: ``moved (1 or steps, n, rows)``, the triangles
    ``known (1 or steps, rows, rows)``, ``head (1 or steps, n, n)`` and ``data (steps, rows)``.

    Shapes: ``before (steps, nu)``, ``y (steps, measured)``, ``u (steps, nu)``.
    """
    ne, rows, n = step.A.shape[1], step.H.shape[1], step.H.shape[2]
    if rows < n:
        return None
    orthogonal, triangle = np.linalg.qr(step.H, mode="complete")
    lengths = np.sqrt(np.einsum("kij,kij->kj", step.H, step.H))
    doubtful = (np.abs(np.einsum("kii->ki", triangle[:, :n])) <= DEPENDENT_COLUMN * lengths).any(axis=1)
    count = len(y) if not doubtful.any() else int(np.argmax(doubtful))
    if not count:
        return None
    # The transpose of a rotation: parity first.
    turned = np.concatenate((orthogonal[:, :, n:], orthogonal[:, :, :n]), axis=2)
    moved = np.matmul(step.A.transpose(0, 2, 1), turned[:, :ne])
    # The triangular factors of the rotated noise.
    known = np.asarray(np.linalg.qr(np.matmul(step.noise.transpose(0, 2, 1), turned), mode="r"))
    known = np.pad(known, ((0, 0), (0, rows - known.shape[1]), (0, 0)))
    right = np.concatenate((_products(step.B, before), y, _products(step.Dn, u)), axis=1)
    data = _products(turned.transpose(0, 2, 1), right)
    head, data = np.ascontiguousarray(triangle[:, :n]), np.ascontiguousarray(data[:count])
    return np.ascontiguousarray(moved), np.ascontiguousarray(known), head, data


def kernel_is_chosen(observer: RecursiveObserver, samples: int, compiled: bool | None) -> bool:
    """Return whether a record goes through the kernel."""
    if compiled is False:
        return False
    if observer.outliers != "none":
        if compiled:
            raise SpecError(
                "compiled=True: the kernel has no outlier test: leave it out, or take outliers='none'.", path="compiled"
            )
        return False
    # The recursion of a filter, with parameters as a random walk or none.
    covered, installed = observer.form in ("", "random-walk"), importlib.util.find_spec("numba") is not None
    if compiled is None:
        return covered and installed and samples >= LONG_RECORD and observer.order <= SMALL_ORDER
    if not installed:
        raise SpecError(
            "compiled=True needs numba, which is not installed: pip install 'obsynth[fast]', or leave the option out.",
            path="compiled",
        )
    if not covered:
        raise SpecError(
            "compiled=True: the kernel runs filters, without parameters or with form 'random-walk'. The forms "
            "'innovation' and 'literal' run without it: leave the option out.",
            path="compiled",
        )
    return True


def run_compiled(recursion: Recursion, y: FloatArray, u: FloatArray) -> Estimates:
    """Run over a record ``y (samples, ny)``: by single steps where samples are missing or a rank has to be decided."""
    state, observer, samples = recursion.first, recursion.settings, len(y)
    nx, nq, rows = observer.plant.nx, len(observer.fault_names), observer.innovation_count + observer.order
    # Innovations are padded by NaN.
    record = {
        "states": np.empty((samples, nx)),
        "state_deviations": np.empty((samples, nx)),
        "faults": np.empty((samples, nq)),
        "fault_covariances": np.empty((samples, nq, nq)),
        "innovations": np.full((samples, rows), np.nan),
        "nis_degrees": np.zeros(samples),
    }
    # For each sample, how many complete ones begin with it.
    missing = np.flatnonzero(np.isnan(y).any(axis=1))
    stretches = np.append(missing, samples)[np.searchsorted(missing, np.arange(samples))] - np.arange(samples)
    pause, patience = 1, 1
    k = 0
    while k < samples:
        count = min(int(stretches[k]), PREPARED_STEPS)
        if pause or count < SHORT_STRETCH or state.diffuse.shape[1]:
            state, row = recursion.advance(state, y[k], u[k])
            _fill(
                record,
                slice(k, k + 1),
                row.x,
                row.state_deviations,
                row.theta,
                row.parameter_covariance,
                row.innovation,
            )
            k, pause = k + 1, max(pause - 1, 0)
            continue
        state = _kernel_steps(recursion, state, record, y[k : k + count], u[k - 1 : k + count])
        taken, k = state.k - k, state.k
        if taken < count:
            # A step for the other path; where such steps are the rule, the kernel is tried less and less often.
            pause, patience = patience, 2 * patience
    most = int(record["nis_degrees"].max(initial=0.0))
    record["innovations"] = innovations = record["innovations"][:, :most]
    # Without parameters there is nothing to excite; with a random walk no window is watched.
    excitation = np.full(samples, 0.0 if observer.adaptation is None else np.nan)
    return named_estimates(
        observer,
        **record,
        regressors=np.full((samples, most, nq), np.nan),
        excitation=excitation,
        nis=np.nansum(innovations * innovations, axis=1),
        received=read_only(~np.isnan(y), bool),
    )


def _fill(record: dict[str, FloatArray], kept: slice, *parts: FloatArray) -> None:
    """Keep some samples: states, their deviations, parameters, their covariances, and innovations ``(..., any)``."""
    for name, part in zip(("states", "state_deviations", "faults", "fault_covariances"), parts[:4], strict=True):
        record[name][kept] = part
    record["innovations"][kept, : parts[4].shape[-1]] = parts[4]
    record["nis_degrees"][kept] = parts[4].shape[-1]


def _kernel_steps(
    recursion: Recursion, state: RecursiveState, record: dict[str, FloatArray], y: FloatArray, u: FloatArray
) -> RecursiveState:
    """Take as many steps as the kernel can; ``u`` begins one sample before ``y``."""
    from obsynth.numerics.compiled_steps import square_root_steps

    first = state.k
    stack = stacked_steps(stacked_matrices(recursion.model, first - 1, len(y)), u[:-1], y, u[1:])
    if stack is None:
        return state
    count, rows = stack[-1].shape
    n, nx = len(state.x), recursion.settings.plant.nx
    x, factor = np.array(state.x), np.array(state.factor, order="C")
    states, innovations = np.empty((count, n)), np.empty((count, rows - n))
    deviations, covariances = np.empty((count, nx)), np.empty((count, n - nx, n - nx))
    taken = square_root_steps(x, factor, *stack, states, innovations, deviations, covariances, SUSPECT_PARITY)
    _fill(
        record,
        slice(first, first + taken),
        states[:taken, :nx],
        deviations[:taken],
        states[:taken, nx:],
        covariances[:taken],
        innovations[:taken],
    )
    return state._replace(x=x, factor=factor, k=first + taken, u=u[taken])


@dataclass(frozen=True, eq=False)
class RecursiveObserver(StepObserver):
    """A recursive observer: everything that `start` and `run` need, and nothing that depends on data.

    Parameters
    ----------
    plant : TimeVaryingDescriptorSystem
        The model it runs on.
    Q, R : MatrixSequence
        Covariances of mu(k) ``(ne, ne)`` and nu(k) ``(ny, ny)``; may be singular.
    initial_state : FloatArray
        ``(nx,)``: the mean of x(0).
    initial_covariance : FloatArray
        ``P_0 (nx, nx)``.
    adaptation : Adaptation or None
        ``None`` for a Kalman filter.
    early_constraints : bool
        Whether equations without x(k+1) are used one step earlier, with u(k+1).
    outliers : {"none", "gate", "huber"}
        What is done with a sample that its prediction excludes: taken as it is; left out, at most twice in a row
        of one sensor; or taken at the limit.
    outlier_limit : float or None
        In standard deviations of the prediction: 6 for ``gate`` and 3 for ``huber`` by default.
    outlier_sizes : FloatArray or None
        ``(ny,)``, in units of the sensors: a sample that is nearer than this to its prediction is no outlier.
    sensors : mapping or None
        ``{name: {"every": rows, "delay": rows}}`` of the sensors that are sampled every so many rows, at k = 0, every,
        2 every, ..., or whose values are delayed by so many rows.
    state_bounds : FloatArray or None
        ``(nx, 2)``: lower and upper bounds of the states, infinite where there are none.

    Raises
    ------
    SpecError
        A shape does not fit the plant.
    """

    plant: TimeVaryingDescriptorSystem
    Q: MatrixSequence
    R: MatrixSequence
    initial_state: FloatArray
    initial_covariance: FloatArray
    adaptation: Adaptation | None
    early_constraints: bool = False
    outliers: Outliers = "none"
    outlier_limit: float | None = None
    outlier_sizes: FloatArray | None = None
    sensors: Mapping[str, Mapping[str, int]] | None = None
    state_bounds: FloatArray | None = None

    def __post_init__(self) -> None:
        self._check_options()
        plant = self.plant
        for name, size in (("Q", plant.ne), ("R", plant.ny)):
            shape = getattr(self, name).shape
            require_shape(shape, (size, size), name)
        state = real_vector(self.initial_state, plant.nx, "initial_state")
        object.__setattr__(self, "early_constraints", truth(self.early_constraints, "early_constraints"))
        covariance = as_matrix(self.initial_covariance, "initial_covariance")
        require_shape(covariance.shape, (plant.nx, plant.nx), "initial_covariance")
        covariance_factor(covariance, "initial_covariance")
        object.__setattr__(self, "initial_state", read_only(state))
        object.__setattr__(self, "initial_covariance", covariance)
        if self.adaptation is not None and len(self.adaptation.initial_parameters) != plant.nq:
            raise SpecError(f"initial_parameters must be {plant.nq} numbers.", path="initial_parameters")

    @property
    def dt(self) -> float:
        """Seconds between samples."""
        return self.plant.dt

    @property
    def fault_names(self) -> tuple[str, ...]:
        """The parameters that are estimated, in order."""
        return () if self.adaptation is None else self.plant.parameter_names

    @property
    def form(self) -> str:
        """How parameters are estimated; empty for a filter without any."""
        return "" if self.adaptation is None else self.adaptation.form

    @property
    def initial_parameters(self) -> FloatArray:
        """Mean of the parameters at the start ``(nq,)``; empty for a filter without any."""
        return np.zeros(0) if self.adaptation is None else self.adaptation.initial_parameters

    @property
    def innovation_count(self) -> int:
        """Numbers in an innovation: what equations and outputs say beyond the state."""
        return self.plant.ne + self.plant.ny - self.plant.nx

    def as_dict(self) -> dict[str, Any]:
        """Return every field as data."""
        found = {field.name: getattr(self, field.name) for field in fields(self)}
        if self.adaptation is not None:
            found["adaptation"] = {field.name: getattr(self.adaptation, field.name) for field in fields(Adaptation)}
        return {
            **found,
            "plant": self.plant.as_dict(),
            "Q": self.Q.as_data(),
            "R": self.R.as_data(),
            "noise_constants": {**(self.Q.constants or {}), **(self.R.constants or {})},
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """Return the observer that `as_dict` described.

        Parameters
        ----------
        data : mapping
            Every field by name.
        """
        require_kind(data, Mapping, "data", "what as_dict() returns")
        given = dict(data)
        constants, adaptation = given.pop("noise_constants"), given["adaptation"]
        noise = {name: MatrixSequence.of(given[name], name, constants=constants) for name in ("Q", "R")}
        return cls(
            **{
                **given,
                **noise,
                "plant": TimeVaryingDescriptorSystem(**given["plant"]),
                "adaptation": None if adaptation is None else Adaptation(**adaptation),
            }
        )

    @cached_property
    def recursion(self) -> Recursion:
        """What follows from the observer alone, made when it is first needed."""
        return Recursion(self)

    @cached_property
    def without_walk(self) -> RecursiveObserver:
        """The observer whose state filter is that of the model without a walk of the parameters."""
        if self.adaptation is None or self.form != "random-walk":
            return self
        return replace(self, adaptation=replace(self.adaptation, form="innovation", forgetting=1.0))

    @property
    def _steps(self) -> Recursion:
        return self.recursion

    def _allow(self, state: RecursiveState) -> None:
        require_horizon(self.plant.horizon, state.k + 1, early=self.early_constraints)

    def _sample(self, state: RecursiveState, y: ArrayLike, u: ArrayLike) -> tuple[FloatArray, FloatArray]:
        outputs = measured_record(np.atleast_2d(real_array(y, "y")), self.plant.ny)[0]
        inputs = np.atleast_1d(real_array(u, "u"))
        require_inputs(inputs, self.plant.input_names, state.k)
        return outputs, inputs

    def _estimates(self, state: RecursiveState, row: RawEstimate) -> Estimates:
        return recursive_estimates(self, [row], window=state.regressors)

    def run(self, y: ArrayLike, u: ArrayLike | None = None, *, compiled: bool | None = None) -> Estimates:
        """Run over a whole record.

        Parameters
        ----------
        y : array_like
            Outputs ``(samples, ny)``, the first at k = 0; NaN marks a missing sample.  y(0) is not used: the model
            begins with y(1).
        u : array_like, optional
            Known inputs ``(samples, nu)``; may be left out when there are none.
        compiled : bool, optional
            Whether a kernel compiled by numba (`obsynth[fast]`) runs the same square-root recursion: always, never, or,
            by default, for long records of small observers.  `compiled_run` says what it covers.

        Returns
        -------
        Estimates
            One row per sample.

        Raises
        ------
        SpecError
            Shapes do not fit, an input is not finite, or the record is longer than the plant's horizon; the kernel is
            asked for, but numba is missing or parameters are estimated by least squares.
        PreconditionError
            Rank H_k is lost at some k (named) although no sample is missing.
        """
        checked_value(compiled, "compiled", bool | None)
        outputs, inputs = whole_record(y, u, self.plant.ny, self.plant.nu)
        require_horizon(self.plant.horizon, len(outputs), early=self.early_constraints)
        if compiled and not self.is_plain:
            raise SpecError(
                "compiled=True: the kernel has neither sensors with their own times nor state_bounds: leave it out.",
                path="compiled",
            )
        if self.is_plain and kernel_is_chosen(self, len(outputs), compiled):
            return run_compiled(self.recursion, outputs, inputs)
        rows, state = [], self.init()
        for y_k, u_k in zip(outputs, inputs, strict=True):
            state, row = self.advance(state, y_k, u_k)
            rows.append(row)
        return recursive_estimates(self, rows)

    def shown(self, row: RawEstimate) -> RawEstimate:
        """Return a row with its states within their bounds; the recursion goes on without them.

        Parameters
        ----------
        row : RawEstimate
            What is known at a sample.
        """
        return row if self.state_bounds is None else row._replace(x=projected(row.x, row.factor, self.state_bounds))


def observer_from_options(plant: TimeVaryingDescriptorSystem, options: Mapping[str, Any]) -> RecursiveObserver:
    """Return the observer that options stand for."""
    adaptation = None
    if "form" in options:
        nq = plant.nq
        adaptation = Adaptation(
            form=options["form"],
            forgetting=options["forgetting"],
            guard=options["guard"],
            initial_parameters=_vector(options["initial_parameters"], nq, "initial_parameters"),
            initial_covariance=_square(
                options["initial_parameter_covariance"], nq, 1.0, "initial_parameter_covariance"
            ),
            walk=_square(options["random_walk"], nq, 0.0, "random_walk"),
            window=options["window"],
            reset=options["reset"],
        )
    return RecursiveObserver(
        plant,
        _sequence(options["Q"], plant.ne, "Q", plant),
        _sequence(options["R"], plant.ny, "R", plant),
        _vector(options["initial_state"], plant.nx, "initial_state"),
        _square(options["initial_covariance"], plant.nx, 1.0, "initial_covariance"),
        adaptation,
        options["early_constraints"],
        options.get("outliers") or "none",
        options.get("outlier_limit"),
        options.get("outlier_sizes"),
        options.get("sensors"),
        options.get("state_bounds"),
    )


def plain_options(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return options as they are kept with a design: arrays and sequences as data, callables as they are."""
    plain: dict[str, Any] = {}
    for name, given in options.items():
        value = given.item() if isinstance(given, np.generic) else given
        if isinstance(value, MatrixSequence):
            plain[name] = value.as_data() if value.is_data else value.function
        elif (
            value is None or callable(value) or isinstance(value, (bool, int, float, str, Mapping)) or _has_text(value)
        ):
            plain[name] = value
        else:
            plain[name] = np.array(value, dtype=np.float64)
    return plain


def _has_text(value: Any) -> bool:
    return isinstance(value, (list, tuple)) and any(isinstance(item, str) or _has_text(item) for item in value)


def _sequence(value: Any, size: int, name: str, plant: TimeVaryingDescriptorSystem) -> MatrixSequence:
    if value is None:
        return MatrixSequence.of(np.eye(size), name)
    if is_number(value):
        value = real_number(value, name, "a variance, or a covariance matrix") * np.eye(size)
    found = MatrixSequence.of(value, name, constants=plant.constants)
    if found.length is not None and (plant.horizon is None or found.length < plant.horizon):
        raise SpecError(
            f"{name} is a stack for {found.length} steps: it must reach as far as the plant's horizon "
            f"({plant.horizon or 'without end'}).",
            path=name,
        )
    return found


def _vector(value: Any, size: int, name: str) -> FloatArray:
    return np.zeros(size) if value is None else real_vector(value, size, name)


def _square(value: Any, size: int, default: float, name: str) -> FloatArray:
    if value is None:
        return default * np.eye(size)
    matrix = as_matrix(value, name)
    return float(matrix[0, 0]) * np.eye(size) if np.ndim(value) == 0 else matrix

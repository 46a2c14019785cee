"""Whole records: step by step, or through the compiled kernel with single steps where it does not reach.

The kernel (`obsynth.numerics.compiled_steps`, numba) covers filters of every plant, with early constraints too, without
parameters or with parameters as a random walk; not the forms that learn by least squares.  It propagates square roots
at each step as the normal path does, with equal results up to rounding.  Steps with missing samples, with undetermined
states, or where a rank has to be decided (perfect equations) are taken by the normal path.  It is used unasked when
numba is installed, the record has `LONG_RECORD` samples and the observer no more than `SMALL_ORDER` states.  The first
use of an installation compiles for some seconds; numba keeps the result.

Many steps of a model as stacks of arrays, factorised together: what a compiled loop needs.
"""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.least_squares_step import DEPENDENT_COLUMN, SUSPECT_PARITY
from obsynth.numerics.ranks import covariance_factor
from obsynth.observers.estimates import Estimates
from obsynth.observers.recursive.estimates import RawEstimate, RecursiveState, received_in
from obsynth.observers.recursive.recursion import Recursion
from obsynth.observers.recursive.settings import RecursiveSettings
from obsynth.observers.recursive.step_model import PlantSteps, StepMatrices, StepModel, stacked_noise
from obsynth.observers.running import named_estimates
from obsynth.plants.sequences import MatrixSequence


class StepStack(NamedTuple):
    """Steps as `obsynth.numerics.compiled_steps.square_root_steps` takes them."""

    moved: FloatArray  # ``(1 or steps, n, rows)``
    known: FloatArray  # ``(1 or steps, any, rows)``
    head: FloatArray  # ``(1 or steps, n, n)``
    data: FloatArray  # ``(steps, rows)``: as many steps as have an H of full rank, from the first one


def stacked_matrices(model: StepModel, first: int, count: int) -> StepMatrices:
    """Return the matrices of steps, each with a new first axis: one entry if it is the same for all, or ``count``."""
    if not isinstance(model, PlantSteps):
        steps = [model.at(k) for k in range(first, first + count)]
        return StepMatrices(*(np.array(matrices) for matrices in zip(*steps, strict=True)))
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


def stacked_steps(step: StepMatrices, before: FloatArray, y: FloatArray, u: FloatArray) -> StepStack | None:
    """Return steps with H factorised and everything rotated, up to the first H whose rank has to be decided: ``before
    (steps, nu)``, ``y (steps, measured)``, ``u (steps, nu)``."""
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
    known = np.matmul(step.noise.transpose(0, 2, 1), turned)
    right = np.concatenate((_products(step.B, before), y, _products(step.Dn, u)), axis=1)
    data = _products(turned.transpose(0, 2, 1), right)
    return StepStack(*(np.ascontiguousarray(part) for part in (moved, known, triangle[:, :n], data[:count])))


#: Samples from which the kernel is used unasked: they take seconds without it, which is what loading numba, or the
#: first compilation of an installation, takes.
LONG_RECORD = 100_000
#: Numbers in the state up to which the kernel is faster than LAPACK.
SMALL_ORDER = 25
#: Steps that are prepared together: bounds the memory of plants that vary.
CHUNK = 4096
#: Fewer complete samples in a row than this are faster step by step.
SHORT_STRETCH = 8


def kernel_is_chosen(observer: RecursiveSettings, samples: int, compiled: bool | None) -> bool:
    """Return whether a record goes through the kernel."""
    if compiled is False:
        return False
    if observer.outliers != "none":
        if compiled:
            raise SpecError("compiled=True: the kernel knows no outliers: leave it out, or take outliers='none'.",
                            path="compiled")  # fmt: skip
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
            "'innovation' and 'literal' run without it: leave the option out.", path="compiled",
        )  # fmt: skip
    return True


@dataclass
class _Record:
    """The estimates of a record while it is being filled; innovations are padded by NaN."""

    states: FloatArray
    deviations: FloatArray
    parameters: FloatArray
    covariances: FloatArray
    innovations: FloatArray
    degrees: FloatArray

    @classmethod
    def empty(cls, samples: int, nx: int, nq: int, rows: int) -> _Record:
        """Return a record of samples without estimates."""
        return cls(
            np.empty((samples, nx)), np.empty((samples, nx)), np.empty((samples, nq)), np.empty((samples, nq, nq)),
            np.full((samples, rows), np.nan), np.zeros(samples),
        )  # fmt: skip

    def note(self, k: int, row: RawEstimate) -> None:
        """Keep one sample of a running observer."""
        self.states[k], self.deviations[k] = row.x, row.state_deviations
        self.parameters[k], self.covariances[k] = row.theta, row.parameter_covariance
        self.innovations[k, : len(row.innovation)], self.degrees[k] = row.innovation, len(row.innovation)

    def estimates(self, observer: RecursiveSettings, y: FloatArray) -> Estimates:
        """Return the whole."""
        most = int(self.degrees.max(initial=0.0))
        innovations = self.innovations[:, :most]
        samples, nq = self.parameters.shape
        # Without parameters there is nothing to excite; with a random walk no window is watched.
        excitation = np.full(samples, 0.0 if observer.adaptation is None else np.nan)
        return named_estimates(
            observer, states=self.states, state_deviations=self.deviations, faults=self.parameters,
            fault_covariances=self.covariances, innovations=innovations,
            regressors=np.full((samples, most, nq), np.nan), nis=np.nansum(innovations * innovations, axis=1),
            nis_degrees=self.degrees, excitation=excitation, received=received_in(y),
        )  # fmt: skip


def run_compiled(recursion: Recursion, y: FloatArray, u: FloatArray) -> Estimates:
    """Run over a whole record with the kernel; single steps where samples are missing or a rank has to be decided: ``y
    (samples, ny)``, ``u (samples, nu)``."""
    state, observer = recursion.first, recursion.settings
    plant = observer.plant
    nq = 0 if observer.adaptation is None else plant.nq
    record = _Record.empty(len(y), plant.nx, nq, plant.ne + plant.ny + nq)
    stretches = _complete_stretches(y)
    pause, patience = 1, 1
    k = 0
    while k < len(y):
        count = min(int(stretches[k]), CHUNK)
        if pause or count < SHORT_STRETCH or state.diffuse.shape[1]:
            state, row = recursion.advance(state, y[k], u[k])
            record.note(k, row)
            k, pause = k + 1, max(pause - 1, 0)
            continue
        state = _kernel_steps(recursion, state, record, y[k : k + count], u[k - 1 : k + count])
        taken, k = state.k - k, state.k
        if taken < count:
            # A step for the other path; where such steps are the rule, the kernel is tried less and less often.
            pause, patience = patience, 2 * patience
    return record.estimates(observer, y)


def _complete_stretches(y: FloatArray) -> FloatArray:
    """Return, for each sample, how many complete ones begin with it."""
    missing = np.flatnonzero(np.isnan(y).any(axis=1))
    after = np.append(missing, len(y))[np.searchsorted(missing, np.arange(len(y)))]
    return np.asarray(after - np.arange(len(y)))


def _kernel_steps(
    recursion: Recursion, state: RecursiveState, record: _Record, y: FloatArray, u: FloatArray
) -> RecursiveState:
    """Take as many steps as the kernel can; ``u`` begins one sample before ``y``."""
    from obsynth.numerics.compiled_steps import square_root_steps

    first = state.k
    stack = stacked_steps(stacked_matrices(recursion.model, first - 1, len(y)), u[:-1], y, u[1:])
    if stack is None:
        return state
    count, rows = stack.data.shape
    n, nx = len(state.x), record.states.shape[1]
    x, factor = np.array(state.x), np.array(state.factor, order="C")
    states, innovations = np.empty((count, n)), np.empty((count, rows - n))
    deviations, covariances = np.empty((count, nx)), np.empty((count, n - nx, n - nx))
    taken = square_root_steps(x, factor, *stack, states, innovations, deviations, covariances, SUSPECT_PARITY)
    kept = slice(first, first + taken)
    record.states[kept], record.parameters[kept] = states[:taken, :nx], states[:taken, nx:]
    record.deviations[kept], record.covariances[kept] = deviations[:taken], covariances[:taken]
    record.innovations[kept, : rows - n], record.degrees[kept] = innovations[:taken], rows - n
    return state._replace(x=x, factor=factor, k=first + taken, u=u[taken])

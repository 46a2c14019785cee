"""Records run by the compiled kernel: when it is chosen, and its arguments."""

from __future__ import annotations

import importlib.util

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics.arrays import FloatArray, read_only
from obsynth.numerics.ranks import covariance_factor
from obsynth.numerics.square_root_estimation import DEPENDENT_COLUMN, SUSPECT_PARITY, directions_of
from obsynth.observers.estimates import Estimates
from obsynth.observers.recursive.recursion import Recursion
from obsynth.observers.recursive.sample import RecursiveState
from obsynth.observers.recursive.settings import RecursiveSettings
from obsynth.observers.recursive.step_model import StepMatrices, StepModel, stacked_noise
from obsynth.observers.running import named_estimates
from obsynth.plants.sequences import MatrixSequence

#: Samples from which the kernel is used unasked: they take seconds without it, which is what loading numba, or the
#: first compilation of an installation, takes.
LONG_RECORD = 100_000

#: Numbers in the state up to which the kernel is faster than LAPACK.
SMALL_ORDER = 25

#: Steps that are prepared together: bounds the memory of plants that vary.
PREPARED_STEPS = 4096

#: Fewer complete samples in a row than this are faster step by step.
SHORT_STRETCH = 8


def kernel_is_chosen(observer: RecursiveSettings, samples: int, compiled: bool | None) -> bool:
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
        if pause or count < SHORT_STRETCH or state.diffuse.shape[1] or state.rounding.shape[1]:
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


def _kernel_steps(
    recursion: Recursion, state: RecursiveState, record: dict[str, FloatArray], y: FloatArray, u: FloatArray
) -> RecursiveState:
    """Take as many steps as the kernel can; ``u`` begins one sample before ``y``."""
    from obsynth.numerics.compiled_steps import square_root_steps

    first = state.k
    matrices = stacked_matrices(recursion.model, first - 1, len(y))
    stack = stacked_steps(matrices, u[:-1], y, u[1:])
    if stack is None or directions_of(state.factor) + _fewest_directions(matrices.noise) < stack[-1].shape[1]:
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


def _fewest_directions(noise: FloatArray) -> int:
    """Return `directions_of` for the least of some steps, ``noise (1 or steps, rows, any)``."""
    return int(np.min(np.count_nonzero(noise.any(axis=1), axis=1)))


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
    noise = np.asarray(np.linalg.qr(np.matmul(step.noise.transpose(0, 2, 1), turned), mode="r"))
    noise = np.pad(noise, ((0, 0), (0, rows - noise.shape[1]), (0, 0)))
    right = np.concatenate((_products(step.B, before), y - _products(step.D, u), _products(step.Dn, u)), axis=1)
    data = _products(turned.transpose(0, 2, 1), right)
    head, data = np.ascontiguousarray(triangle[:, :n]), np.ascontiguousarray(data[:count])
    return np.ascontiguousarray(moved), np.ascontiguousarray(noise), head, data


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
    D = _stack(plant.D, first + 1, count)
    return StepMatrices(H, A, B, Phi, Psi, np.zeros((1, 0, plant.nu)), D, np.array(noise))


def _stack(sequence: MatrixSequence, first: int, count: int) -> FloatArray:
    if sequence.is_constant:
        return sequence.at(first)[None]
    if sequence.values is not None:
        sequence.at(first + count - 1)
        return np.asarray(sequence.values[first : first + count])
    return np.array([sequence.at(k) for k in range(first, first + count)])


def _joined(above: FloatArray, below: FloatArray) -> FloatArray:
    count = max(len(above), len(below))
    widened = [np.broadcast_to(part, (count, *part.shape[1:])) for part in (above, below)]
    return np.concatenate(widened, axis=1)


def _products(matrices: FloatArray, rows: FloatArray) -> FloatArray:
    """Return matrix times vector for each row, the matrices being one or as many."""
    if len(matrices) == 1:
        return np.asarray(rows @ matrices[0].T)
    return np.asarray(np.matmul(matrices, rows[:, :, None])[:, :, 0])


def _fill(record: dict[str, FloatArray], rows: slice, *parts: FloatArray) -> None:
    """Keep some samples: states, their deviations, parameters, their covariances, and innovations ``(..., any)``."""
    for name, part in zip(("states", "state_deviations", "faults", "fault_covariances"), parts[:4], strict=True):
        record[name][rows] = part
    record["innovations"][rows, : parts[4].shape[-1]] = parts[4]
    record["nis_degrees"][rows] = parts[4].shape[-1]

"""Many steps of a model as stacks of arrays, factorised together: what a compiled loop needs."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.covariances import covariance_factor
from obsynth.numerics.least_squares_step import DEPENDENT_COLUMN
from obsynth.observers.recursive.step_model import PlantSteps, StepMatrices, StepModel, stacked_noise
from obsynth.plants.sequences import MatrixSequence


class StepStack(NamedTuple):
    """Steps as `obsynth.numerics.compiled_steps.square_root_steps` takes them.

    Fields: moved: ``(1 or steps, n, rows)``; known: ``(1 or steps, any, rows)``; head: ``(1 or steps, n, n)``; data:
    ``(steps, rows)``: as many steps as have an H of full rank, from the first one.
    """

    moved: FloatArray
    known: FloatArray
    head: FloatArray
    data: FloatArray


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
    """Return steps with H factorised and everything rotated, up to the first H whose rank has to be decided.

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
    known = np.matmul(step.noise.transpose(0, 2, 1), turned)
    right = np.concatenate((_products(step.B, before), y, _products(step.Dn, u)), axis=1)
    data = _products(turned.transpose(0, 2, 1), right)
    return StepStack(*(np.ascontiguousarray(part) for part in (moved, known, triangle[:, :n], data[:count])))

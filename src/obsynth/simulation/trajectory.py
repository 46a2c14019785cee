"""What a plant of any kind did over a record, and the signals of one, checked."""

from __future__ import annotations

from dataclasses import dataclass, field, fields

import numpy as np
from numpy.typing import ArrayLike

from obsynth.errors import SpecError
from obsynth.numerics.arrays import FloatArray, as_matrix, read_only


def _none() -> FloatArray:
    return np.zeros((0, 0))


@dataclass(frozen=True, eq=False)
class Trajectory:
    """A simulated record, one row per sample; arrays are read-only, and empty where such a plant has none.

    Parameters
    ----------
    states, outputs : FloatArray
        ``(samples, nx)`` and ``(samples, ny)``, with noise; the outputs of a time-varying plant begin with y(1): their
        first row is NaN.
    inputs, faults, disturbances, noise : FloatArray
        ``(samples, nu)``, ``(samples, nf)``, ``(samples, nd)``, ``(samples, nw)``: what drove a plant; the faults of a
        plant with parameters are these, ``(samples, nq)``.
    time : FloatArray
        ``(samples,)``, seconds; starts at zero.
    residuals : FloatArray
        ``(samples,)``, nonlinear plants: scaled Newton residual of each step.
    inconsistency : float
        Linear plants: norm of the change that the given initial state needed to satisfy the algebraic equations at
        k = 0; only rounding for a consistent one.
    """

    states: FloatArray
    outputs: FloatArray
    inputs: FloatArray
    faults: FloatArray
    disturbances: FloatArray = field(default_factory=_none)
    noise: FloatArray = field(default_factory=_none)
    time: FloatArray = field(default_factory=_none)
    inconsistency: float = 0.0
    residuals: FloatArray = field(default_factory=_none)

    def __post_init__(self) -> None:
        for item in fields(self):
            if isinstance(getattr(self, item.name), np.ndarray):
                object.__setattr__(self, item.name, read_only(getattr(self, item.name)))


def signal_of(value: ArrayLike | None, name: str, shape: tuple[int, int]) -> FloatArray:
    """Return a signal over a record, zero where none is given; a list of numbers is a single one."""
    if value is None or (0 in shape and not np.size(value)):
        return np.zeros(shape)
    array = np.asarray(value)
    matrix = as_matrix(array.reshape(-1, 1) if array.ndim == 1 and shape[1] == 1 else array, name)
    if matrix.shape != shape:
        raise SpecError(
            f"{name} is {matrix.shape[0]} by {matrix.shape[1]}, but {shape[0]} by {shape[1]} is needed (samples by "
            "signals).", path=name,
        )  # fmt: skip
    return matrix

"""Mean and covariance of the initial state of a plant that is augmented with further states."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.linalg import block_diag

from obsynth.numerics.arguments import real_array, require_shape
from obsynth.numerics.arrays import FloatArray, as_matrix
from obsynth.numerics.ranks import covariance_factor


def extended_mean(state: Any, nx: int, added: int) -> FloatArray:
    """Return the initial mean of ``nx`` states (zero where none is stated), followed by zeros for the added states."""
    mean = np.zeros(nx) if state is None else real_array(state, "initial_state").ravel()
    require_shape(mean.shape, (nx,), "initial_state")
    return np.concatenate([mean, np.zeros(added)])


def stated_covariance(covariance: Any, nx: int) -> FloatArray:
    """Return the initial covariance ``(nx, nx)``: a number means that multiple of the identity, ``None`` means 1."""
    matrix = np.eye(nx) if covariance is None else as_matrix(covariance, "initial_covariance")
    matrix = matrix[0, 0] * np.eye(nx) if matrix.shape == (1, 1) else matrix
    require_shape(matrix.shape, (nx, nx), "initial_covariance")
    covariance_factor(matrix, "initial_covariance")  # refuses what is no covariance
    return matrix


def extended_covariance(covariance: FloatArray, added_variances: FloatArray) -> FloatArray:
    """Return the initial covariance with independent states of the given variances added."""
    return np.asarray(block_diag(covariance, np.diag(added_variances)))

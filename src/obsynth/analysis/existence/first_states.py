"""What is stated of the first state of a plant, for one that has more states than are written."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.linalg import block_diag

from obsynth.numerics.arguments import require_shape
from obsynth.numerics.arrays import FloatArray, as_matrix


def extended_mean(state: Any, written: int, more: int) -> FloatArray:
    """Return the mean of the first state with ``more`` states of mean zero behind the ``written`` ones."""
    mean = np.zeros(written) if state is None else np.ravel(np.asarray(state, dtype=np.float64))
    require_shape(mean.shape, (written,), "initial_state")
    return np.concatenate([mean, np.zeros(more)])


def stated_covariance(covariance: Any, written: int) -> FloatArray:
    """Return the covariance of the first state ``(written, written)``: the identity where none is stated, and that
    multiple of it where a number is."""
    own = np.eye(written) if covariance is None else as_matrix(covariance, "initial_covariance")
    own = own[0, 0] * np.eye(written) if own.shape == (1, 1) else own
    require_shape(own.shape, (written, written), "initial_covariance")
    return own


def extended_covariance(own: FloatArray, more: FloatArray) -> FloatArray:
    """Return the covariance of the first state with states of the variances ``more`` behind it."""
    return np.asarray(block_diag(own, np.diag(more)))

"""What a recursive observer is made of: plant, noise, start, and how parameters are estimated; all of it checked."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics.arguments import Count, ForgettingFactor, Probability, check_fields, real_array, require_shape
from obsynth.numerics.arrays import FloatArray, as_matrix, read_only
from obsynth.numerics.ranks import covariance_factor, rounding_rank

Form: TypeAlias = Literal["innovation", "literal", "random-walk"]

Guard: TypeAlias = Literal["regularise", "directional", "none"]


@dataclass(frozen=True, eq=False)
class Adaptation:
    """How parameters are estimated.

    Parameters
    ----------
    form : {"innovation", "literal", "random-walk"}
        Least squares on the whitened parity innovation; (18) as printed; or the parameters as states.
    forgetting : float
        lambda in (0, 1], dimensionless; not used by the random walk.
    guard : {"regularise", "directional", "none"}
        What keeps S bounded where excitation is missing.
    initial_parameters : FloatArray
        ``(nq,)``.
    initial_covariance : FloatArray
        ``S_0 (nq, nq)``, positive definite: also the covariance of the initial parameters.
    walk : FloatArray
        ``(nq, nq)``: covariance of one step of the random walk.
    window : int
        Samples over which excitation is watched.
    reset : float
        Detect and reset: probability, per sample, that innovations which no change has made larger pass the threshold
        above which S and the covariance start again from S_0.  Zero never resets.

    Raises
    ------
    SpecError
        Something is out of range or has the wrong shape.
    """

    form: Form
    forgetting: ForgettingFactor
    guard: Guard
    initial_parameters: FloatArray
    initial_covariance: FloatArray
    walk: FloatArray
    window: Count
    reset: Probability = 0.0

    def __post_init__(self) -> None:
        check_fields(self, Adaptation)
        if self.reset and self.form == "random-walk":
            raise SpecError("reset is for the forms with a forgetting factor.", path="reset")
        start = np.atleast_1d(real_array(self.initial_parameters, "initial_parameters"))
        q = len(start)
        object.__setattr__(self, "initial_parameters", read_only(start))
        for name, option in (("initial_covariance", "initial_parameter_covariance"), ("walk", "random_walk")):
            matrix = as_matrix(getattr(self, name), option)
            require_shape(matrix.shape, (q, q), option)
            object.__setattr__(self, name, matrix)
            factor = covariance_factor(matrix, option)
            if name == "initial_covariance" and (np.diag(matrix) <= 0.0).any() | (rounding_rank(factor) < q):
                raise SpecError(f"{option} (S_0) must be positive definite.", path=option)

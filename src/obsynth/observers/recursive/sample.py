"""The estimates of a recursive observer at a sample, and its state before the next one."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.ranks import UNDETERMINED_SHARE
from obsynth.numerics.square_root_estimation import ParameterState


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
    rounding: FloatArray  # ``(n, any)``: root of what rounding makes of `x`; without columns unless it is followed


def deviations_in(factor: FloatArray, diffuse: FloatArray | None = None) -> FloatArray:
    """Return standard deviations ``(n,)``, infinite where a state is undetermined."""
    deviations = np.asarray(np.sqrt(np.einsum("ij,ij->i", factor, factor)))
    return (
        deviations
        if diffuse is None
        else np.where((np.abs(diffuse) > UNDETERMINED_SHARE).any(axis=1), np.inf, deviations)
    )

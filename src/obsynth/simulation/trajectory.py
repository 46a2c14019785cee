"""The record of a simulated plant: states, outputs, and what drove it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from obsynth.errors import counted
from obsynth.numerics.arrays import FloatArray, freeze


def _no_signals() -> FloatArray:
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

    Examples
    --------
    >>> import obsynth
    >>> import numpy as np
    >>> model = obsynth.DAEModel(
    ...     {"balance": "der(level) = inflow - level"}, {"gauge": "level"},
    ...     states={"level": 1.0}, inputs={"inflow": 1.0},
    ... )
    >>> run = obsynth.simulate_dae(model, np.full((3, 1), 2.0), dt=1.0)
    >>> run.time.tolist(), run.states[:, 0].round(3).tolist()
    ([0.0, 1.0, 2.0], [1.0, 1.632, 1.865])
    """

    states: FloatArray
    outputs: FloatArray
    inputs: FloatArray
    faults: FloatArray
    disturbances: FloatArray = field(default_factory=_no_signals)
    noise: FloatArray = field(default_factory=_no_signals)
    time: FloatArray = field(default_factory=_no_signals)
    inconsistency: float = 0.0
    residuals: FloatArray = field(default_factory=_no_signals)

    def __repr__(self) -> str:
        """Return what it holds, without the numbers."""
        parts = {"state": self.states, "output": self.outputs, "input": self.inputs, "fault": self.faults}
        signals = ", ".join(counted(part.shape[1], name) for name, part in parts.items() if part.shape[1])
        length = f" over {self.time[-1]:g} s" if self.time.size else ""
        return f"<Trajectory of {counted(len(self.states), 'sample')}{length}: {signals}>"

    def __post_init__(self) -> None:
        freeze(self, *(name for name, value in vars(self).items() if isinstance(value, np.ndarray)))

"""The error of backward Euler on a log, against the noise of the sensors: it decides how the model is integrated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from obsynth.errors import SolverError
from obsynth.numerics.arrays import FloatArray
from obsynth.plants.dae import DAEModel
from obsynth.plants.dae_functions import DAEFunctions
from obsynth.plants.implicit_step import ImplicitStep

#: A step whose error in an output exceeds this share of the sensor's deviation is not exact enough.
TOLERATED = 0.25

#: Samples at which both methods are compared: half of them spread over the record, half before the largest changes of
#: the inputs, as inputs that are held change in rows that an even spread may miss.
COMPARED = 100


@dataclass(frozen=True)
class IntegrationError:
    """Largest difference of one step of backward Euler from Radau, in deviations of a sensor, and where it is."""

    largest: float
    sensor: str
    row: int
    moved: float = 0.0  # by how much it moves a constant, in deviations of that, where it was asked

    @property
    def matters(self) -> bool:
        """Whether backward Euler is not exact enough."""
        return not self.largest <= TOLERATED


def _compared(u: FloatArray) -> NDArray[np.int64]:
    """Return the samples of inputs ``(n, nu)`` from which steps are compared."""
    steps = max(len(u) - 1, 1)
    if steps <= COMPARED:
        return np.arange(steps)
    spread = np.linspace(0, steps - 1, COMPARED // 2).astype(np.int64)
    changes, sizes = np.abs(np.nan_to_num(np.diff(u, axis=0))), np.nanstd(u, axis=0)
    largest = np.max(changes / np.where(sizes > 0.0, sizes, 1.0), axis=1, initial=0.0)
    return np.union1d(spread, np.argsort(-largest, kind="stable")[: COMPARED // 2])


def integration_error(
    model: DAEModel, states: FloatArray, u: FloatArray, theta: FloatArray, deviations: FloatArray, dt: float
) -> IntegrationError | None:
    """Compare one step from each state ``(n, nx)``, where Radau has a solution, with the input that leads on."""
    steps = [ImplicitStep(DAEFunctions(model, method), dt) for method in ("backward-euler", "radau")]
    worst = IntegrationError(0.0, model.output_names[0], 0)
    for k in _compared(u[: len(states)]):
        after = min(k + 1, len(u) - 1)
        try:
            outputs = [
                step.functions.outputs(step.solve(states[k], u[after], theta, before=u[k], k=int(k)).x, theta)[0]
                for step in steps
            ]
        except SolverError:
            return None
        errors = np.abs(outputs[0] - outputs[1]) / deviations
        i = int(np.argmax(errors))
        if not errors[i] <= worst.largest:
            worst = IntegrationError(float(errors[i]), model.output_names[i], int(after))
    return worst

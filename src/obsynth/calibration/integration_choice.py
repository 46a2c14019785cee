"""How a model is to be integrated on a log: what a step of backward Euler errs, against the noise of the sensors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.plants.dae.functions import DAEFunctions
from obsynth.plants.dae.model import DAEModel
from obsynth.plants.dae.step import ImplicitStep

#: A step whose error in an output exceeds this share of the sensor's deviation is not exact enough.
TOLERATED = 0.25
#: Samples at which both methods are compared, spread over the record.
COMPARED = 100


@dataclass(frozen=True)
class IntegrationError:
    """Largest difference of one step of backward Euler from Radau, in deviations of a sensor, and where it is."""

    largest: float
    sensor: str
    row: int

    @property
    def matters(self) -> bool:
        """Whether backward Euler is not exact enough."""
        return not self.largest <= TOLERATED


def integration_error(
    model: DAEModel, states: FloatArray, u: FloatArray, theta: FloatArray, deviations: FloatArray, dt: float
) -> IntegrationError:
    """Compare one step from each state ``(n, nx)`` with the input that leads on, ``u (n, nu)``, k + 1 for state k."""
    steps = [ImplicitStep(DAEFunctions(model, method), dt) for method in ("backward-euler", "radau")]
    worst = IntegrationError(0.0, model.output_names[0], 0)
    for k in np.unique(np.linspace(0, max(len(states) - 2, 0), min(COMPARED, max(len(states) - 1, 1))).astype(int)):
        after = min(k + 1, len(u) - 1)
        seen = [step.functions.outputs(step.solve(states[k], u[after], theta, before=u[k], k=int(k)).x, theta)[0]
                for step in steps]  # fmt: skip
        errors = np.abs(seen[0] - seen[1]) / deviations
        i = int(np.argmax(errors))
        if not errors[i] <= worst.largest:
            worst = IntegrationError(float(errors[i]), model.output_names[i], int(after))
    return worst

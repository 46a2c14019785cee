"""Missing samples of a linear observer: predictions of the plant's model replace the measurements in a gap."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cached_property, lru_cache, partial

import numpy as np

from obsynth.errors import PreconditionError
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.continuous import first_order_hold
from obsynth.observers.linear.modes import noise_variances
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem

#: Number of interval lengths whose discretised model is cached.
KEPT_INTERVALS = 64

#: A gap counts as over when its possible error in fault estimates and residuals has decayed below this share of their
#: usual change from row to row, measured over at least LEAST_SHOWN rows, or below their deviation by sensor noise.
GAP_LEFT_SHARE, LEAST_SHOWN = 1.0, 20


class GapModel:
    """The plant model that predicts the measurements in a gap, with faults held and unknown inputs zero.

    The plant has ``E = I``.  ``into (nx, nx_source)`` maps an estimate of all states to its dynamic states.
    """

    def __init__(self, plant: DescriptorSystem, into: FloatArray) -> None:
        self.plant, self.into = plant, into
        self._hold = lru_cache(KEPT_INTERVALS)(partial(first_order_hold, plant.A, np.hstack([plant.B, plant.Bf])))

    @classmethod
    def of(cls, plant: DescriptorSystem) -> GapModel | None:
        """Return the model of a plant; ``None`` where the plant cannot be propagated (index 2 or more)."""
        if np.array_equal(plant.E, np.eye(plant.nx)):
            return cls(plant, np.eye(plant.nx))
        from obsynth.plants.transformations.elimination import eliminate_algebraic_states

        try:
            eliminated = eliminate_algebraic_states(plant)
        except PreconditionError:
            return None
        # E x depends on the dynamic states alone: solve E x = (E R) z for z.
        dynamic = plant.E @ eliminated.recovery.from_state
        return cls(eliminated.plant, np.asarray(np.linalg.pinv(dynamic) @ plant.E))

    def start(self, estimate: FloatArray, inputs: Iterable[FloatArray], fault: FloatArray) -> FloatArray:
        """Return the present dynamic states from an older estimate ``(nx_source,)`` and the inputs since."""
        state = self.into @ estimate
        for u in inputs:
            state = self.after(state, 0.0, u, u, fault)
        return np.asarray(state)

    def after(
        self, state: FloatArray, seconds: float, before: FloatArray, u: FloatArray, fault: FloatArray
    ) -> FloatArray:
        """Return the state one sample later, or after an interval in which inputs change linearly to ``u``."""
        plant = self.plant
        if plant.dt > 0.0:
            return np.asarray(plant.A @ state + plant.B @ before + plant.Bf @ fault)
        if seconds <= 0.0:
            return state
        transition, constant, ramp = self._hold(seconds)
        rise = np.concatenate([u - before, np.zeros(len(fault))])
        return np.asarray(transition @ state + constant @ np.concatenate([before, fault]) + ramp @ rise)

    def outputs(self, state: FloatArray, u: FloatArray, fault: FloatArray) -> FloatArray:
        """Return the outputs ``(ny,)`` of a state."""
        return np.asarray(self.plant.C @ state + self.plant.D @ u + self.plant.Df @ fault)

    def miss(self, v: FloatArray, state: FloatArray | None = None, fault: FloatArray | None = None) -> float:
        """Return the distance between measured outputs and those of a state; of rest and no fault by default."""
        plant = self.plant
        at = np.zeros(plant.nx) if state is None else state
        f = np.zeros(plant.nf) if fault is None else fault
        return float(np.linalg.norm(v[plant.nu :] - self.outputs(at, v[: plant.nu], f)))


class MissingSamples:
    """What a run of a linear observer needs in order to bridge missing samples: model, delays, and noise.

    ``solver (nx, nz + ny)`` recovers all states of the plant from the observer's state and the outputs, for an
    observer that does not estimate all of them; ``None`` where there is no such matrix.
    """

    def __init__(self, plant: DescriptorSystem, observer: LinearObserver, solver: FloatArray | None) -> None:
        self.plant, self.observer, self.solver = plant, observer, solver
        lags = set(observer.state_delays) or {0}
        #: Number of last inputs that are kept: from the sample of the delayed estimate on.
        self.kept_inputs = max(lags) + 1
        gives_states = estimates_all_states(plant, observer) or solver is not None
        self.model = None if len(lags) > 1 or not gives_states else GapModel.of(plant)
        #: Indexes of the plant's faults that are estimated; the model has the other ones at zero.
        self.estimated_faults = [plant.fault_names.index(name) for name in observer.fault_names]
        #: Number of states at a measured row from which the model starts.
        self.known_states = len(observer.state_names) if solver is None else plant.nx

    @cached_property
    def noise(self) -> FloatArray:
        """Variances of fault estimates and residuals by the stated sensor noise; zero where they are not known."""
        observer, compared = self.observer, slice(len(self.observer.state_names), None)
        if observer.dt > 0.0 and observer.By.shape[1] == self.plant.ny:
            return noise_variances(observer, self.plant.Dw)[compared]
        return np.zeros(len(observer.Cz[compared]))


def estimates_all_states(plant: DescriptorSystem, observer: LinearObserver) -> bool:
    """Whether every state of the plant is estimated."""
    return len(observer.state_names) == plant.nx

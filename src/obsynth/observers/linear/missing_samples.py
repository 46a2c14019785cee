"""Missing samples of a linear observer: the plant's model replaces the sensors, until its effect has decayed."""

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

#: How many lengths of an interval are kept discretised.
KEPT_INTERVALS = 64

#: A gap is over when what it can have left in fault estimates and residuals is below this share of their usual changes
#: from row to row, which so many rows must have shown, or below what the stated noise of the sensors makes of them.
GAP_LEFT_SHARE, LEAST_SHOWN = 1.0, 20


class GapModel:
    """The plant model that stands in for the sensors during a gap: faults held, unknown inputs zero, ``E = I``.
    ``into (nx, nx_source)``: the dynamic states in an estimate of all states."""

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
            done = eliminate_algebraic_states(plant)
        except PreconditionError:
            return None
        moving = plant.E @ done.recovery.from_state
        return cls(done.plant, np.asarray(np.linalg.pinv(moving) @ plant.E))

    def start(self, estimate: FloatArray, inputs: Iterable[FloatArray], fault: FloatArray) -> FloatArray:
        """Return the dynamic states now from an estimate ``(nx_source,)`` and the inputs of the samples since."""
        state = self.into @ estimate
        for u in inputs:
            state = self.after(state, 0.0, u, u, fault)
        return np.asarray(state)

    def after(
        self, state: FloatArray, seconds: float, before: FloatArray, u: FloatArray, fault: FloatArray
    ) -> FloatArray:
        """Return the state a sample later, or after an interval along which inputs go from ``before`` to ``u``."""
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
    """What a linear observer of a plant goes by where samples are missing; ``solver (nx, nz + ny)`` gives the states of
    an observer that does not estimate all of them, where there is one."""

    def __init__(self, plant: DescriptorSystem, observer: LinearObserver, solver: FloatArray | None) -> None:
        self.plant, self.observer, self.solver = plant, observer, solver
        lags = set(observer.state_delays) or {0}
        #: Inputs from the moment on of which the estimates are.
        self.kept_inputs = max(lags) + 1
        gives_states = estimates_all_states(plant, observer) or solver is not None
        self.model = None if len(lags) > 1 or not gives_states else GapModel.of(plant)
        #: Numbers of the plant's faults that are estimated; the others are held to be absent.
        self.estimated_faults = [plant.fault_names.index(name) for name in observer.fault_names]
        #: How many states are known at a measured row, from which the model starts.
        self.known_states = len(observer.state_names) if solver is None else plant.nx

    @cached_property
    def noise(self) -> FloatArray:
        """Variances that the stated noise of the sensors gives fault estimates and residuals, zero if not known."""
        observer, compared = self.observer, slice(len(self.observer.state_names), None)
        if observer.dt > 0.0 and observer.By.shape[1] == self.plant.ny:
            return noise_variances(observer, self.plant.Dw)[compared]
        return np.zeros(len(observer.Cz[compared]))


def estimates_all_states(plant: DescriptorSystem, observer: LinearObserver) -> bool:
    """Whether every state of the plant is estimated."""
    return len(observer.state_names) == plant.nx

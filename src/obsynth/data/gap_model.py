"""The plant model that stands in for the sensors during a gap: faults held, unknown inputs zero.

What depends on an observer and an interval alone: its first-order hold.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from obsynth.errors import PreconditionError
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.holds import first_order_hold
from obsynth.plants.descriptor import DescriptorSystem


@dataclass(frozen=True, eq=False)
class GapModel:
    """A plant with its algebraic states eliminated, ready to be propagated.

    Fields: plant: ``E = I``; into: ``(nx, nx_source)``: the dynamic states in an estimate of all states.
    """

    plant: DescriptorSystem
    into: FloatArray

    @classmethod
    def of(cls, plant: DescriptorSystem) -> GapModel | None:
        """Return the gap_model of a plant; ``None`` where the plant cannot be propagated (index 2 or more)."""
        if np.array_equal(plant.E, np.eye(plant.nx)):
            return cls(plant, np.eye(plant.nx))
        from obsynth.analysis.transformations.elimination import eliminate_algebraic_states

        try:
            done = eliminate_algebraic_states(plant)
        except PreconditionError:
            return None
        moving = plant.E @ done.recovery.from_state
        return cls(done.plant, np.asarray(np.linalg.pinv(moving) @ plant.E))

    def start(self, estimate: FloatArray, inputs: Sequence[FloatArray], fault: FloatArray) -> FloatArray:
        """Return the dynamic states now from an estimate of the past.

        Shapes: ``estimate (nx_source,)``, ``inputs (nu,)``, ``fault (nf,)``.
        """
        state = self.into @ estimate
        for u in inputs:
            state = self.sampled(state, u, fault)
        return np.asarray(state)

    def sampled(self, state: FloatArray, u: FloatArray, fault: FloatArray) -> FloatArray:
        """Return the state one sample later, discrete time."""
        return np.asarray(self.plant.A @ state + self.plant.B @ u + self.plant.Bf @ fault)

    def held(self, step: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the first-order hold of ``[u; f]`` over ``step`` seconds, continuous time."""
        return first_order_hold(self.plant.A, np.hstack([self.plant.B, self.plant.Bf]), step)

    def outputs(self, state: FloatArray, u: FloatArray, fault: FloatArray) -> FloatArray:
        """Return the outputs ``(ny,)`` of a state."""
        return np.asarray(self.plant.C @ state + self.plant.D @ u + self.plant.Df @ fault)

    def miss(self, v: FloatArray, state: FloatArray | None = None, fault: FloatArray | None = None) -> float:
        """Return the distance between measured outputs and those of a state; of rest and no fault by default.

        Shapes: ``state (nx,)``, ``fault (nf,)``.
        """
        plant = self.plant
        at = np.zeros(plant.nx) if state is None else state
        f = np.zeros(plant.nf) if fault is None else fault
        return float(np.linalg.norm(v[plant.nu :] - self.outputs(at, v[: plant.nu], f)))


#: How many lengths of an interval are kept discretised.
KEPT_INTERVALS = 64
Hold: TypeAlias = tuple[FloatArray, FloatArray, FloatArray]


class KeptHolds:
    """First-order holds of one system by the length of the interval; those used last are kept.

    Fields: compute: Takes seconds, returns ``Phi, Gamma_0, Gamma_1``.
    """

    def __init__(self, compute: Callable[[float], Hold]) -> None:
        self._compute = compute
        self._kept: OrderedDict[float, Hold] = OrderedDict()

    def at(self, seconds: float) -> Hold:
        """Return the hold over an interval of ``seconds``."""
        if seconds not in self._kept:
            self._kept[seconds] = self._compute(seconds)
            if len(self._kept) > KEPT_INTERVALS:
                self._kept.popitem(last=False)
        self._kept.move_to_end(seconds)
        return self._kept[seconds]

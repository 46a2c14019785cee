r"""A plant whose noise drives equations and outputs at once, with that noise as states, so that noises are independent.

With the columns of the noise w that enter both in ``w1`` and the others in ``w2``, the states ``s(k) = w1(k)`` give

.. math::
    [E \; 0; 0 \; I] [x; s](k + 1) = [A \; B_{w1}; 0 \; 0] [x; s](k) + [B_{w2} w_2(k); w_1(k + 1)], \qquad
    y(k) = [C \; D_{w1}] [x; s](k) + D_{w2} w_2(k),

in which no noise enters equations and outputs at once.  Nothing is lost: the estimate of x is that of the plant as
written, and no inverse of a covariance is needed.  Of more such columns than outputs, those combinations become states
that the outputs show.  Source: Anderson, Moore 1979, section 11.2 (noise as part of the state).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from obsynth.analysis.existence.first_states import extended_covariance, extended_mean, stated_covariance
from obsynth.numerics.arrays import FloatArray, remembered
from obsynth.numerics.ranks import product_but_rounding
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem


@dataclass(frozen=True, eq=False)
class SharedNoise:
    """A plant with the noise that enters equations and outputs at once as states."""

    plant: DescriptorSystem
    names: tuple[str, ...]  # of the states s
    note: str

    @property
    def written(self) -> int:
        """Number of states of the plant as written."""
        return self.plant.nx - len(self.names)

    def initial_state(self, state: Any) -> FloatArray:
        """Return the mean of the first state: that of the noise is zero."""
        return extended_mean(state, self.written, len(self.names))

    def initial_covariance(self, covariance: Any) -> FloatArray:
        """Return the covariance of the first state: that of the noise is the identity at every sample."""
        return extended_covariance(stated_covariance(covariance, self.written), np.ones(len(self.names)))


def shared_noise(plant: DescriptorSystem | TimeVaryingDescriptorSystem, *, Q: Any, R: Any) -> SharedNoise | None:
    """Return the plant with independent noises; ``None`` where they are, or where ``Q`` or ``R`` is stated instead."""
    if not isinstance(plant, DescriptorSystem) or not plant.nw or Q is not None or R is not None:
        return None
    return _noise_as_states(plant) if np.any(product_but_rounding(plant.Bw, plant.Dw.T)) else None


@remembered
def _noise_as_states(plant: DescriptorSystem) -> SharedNoise:
    both = np.any(plant.Bw != 0.0, axis=0) & np.any(plant.Dw != 0.0, axis=0)
    equations, outputs = plant.Bw[:, both], plant.Dw[:, both]
    count = outputs.shape[1]
    if count > plant.ny:
        # The outputs show as many combinations as there are outputs; the others drive equations alone.
        turned, triangle = np.linalg.qr(outputs.T, mode="complete")
        # Rounding of zeros would have units of its own, far from those of all else.
        equations, outputs = product_but_rounding(equations, turned), triangle[: plant.ny].T
        count = plant.ny
    rest = np.hstack([plant.Bw[:, ~both], equations[:, count:]])
    alone = np.hstack([plant.Dw[:, ~both], np.zeros((plant.ny, equations.shape[1] - count))])
    empty = np.zeros((count, plant.nx))
    names = _names(plant, count)
    with_noise = plant.replace(
        E=np.block([[plant.E, empty.T], [empty, np.eye(count)]]),
        A=np.block([[plant.A, equations[:, :count]], [empty, np.zeros((count, count))]]),
        C=np.hstack([plant.C, outputs]),
        **{name: _above_zeros(getattr(plant, name), count) for name in ("B", "Bf", "Bd")},
        Bw=block_diag(rest, np.eye(count)),
        Dw=np.hstack([alone, np.zeros((plant.ny, count))]),
        state_names=(*plant.state_names, *names),
        noise_names=None,
    )
    listed = ", ".join(map(repr, names))
    note = (
        f"Noise that drives equations and outputs at once is estimated with the states, as {listed}: values of noise "
        "with variance one."
    )
    return SharedNoise(with_noise, names, note)


def _names(plant: DescriptorSystem, count: int) -> tuple[str, ...]:
    taken = {*plant.state_names, *plant.input_names, *plant.output_names, *plant.fault_names, *plant.disturbance_names}
    names: list[str] = []
    number = 1
    while len(names) < count:
        if (name := f"shared noise {number}") not in taken:
            names.append(name)
        number += 1
    return tuple(names)


def _above_zeros(matrix: FloatArray, count: int) -> FloatArray:
    return np.vstack([matrix, np.zeros((count, matrix.shape[1]))])

"""Modes that last and that no noise drives: integrators of a constant, oscillations that go on.

Their part of the error decays only where the filter reads them, which costs noise: where they are on the boundary of
stability, no stable filter reaches the least gain of all causal ones, and some come as near as one likes.  Beyond it
(modes that grow) a gap may stay.  The filter is designed as if a little noise drove them, and its claims are those for
the plant as it is.
"""

from __future__ import annotations

import numpy as np
import scipy.linalg

from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.least_estimation import STABLE_RADIUS
from obsynth.numerics.ranks import RANK_TOLERANCE
from obsynth.numerics.standard_form import INFINITE_EIGENVALUE
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.plant_units import PlantUnits

#: Noise that drives them, of the largest of the plant's own, in units in which the plant is near one: the less, the
#: nearer is the gain to the least, and the slower the errors settle (at 1e-2 in some hundred samples).
ADDED_DRIVES = (1e-2, 1e-3, 1e-4, 1e-5)
#: How far from the axis, of its distance from the origin or of the fastest mode, a continuous mode counts as lasting.
AXIS_SHARE = 1e-6


def with_lasting_modes_driven(plant: DescriptorSystem, drive: float = ADDED_DRIVES[0]) -> DescriptorSystem:
    """Return the plant with noise that drives its lasting modes; as it is where each of them is driven."""
    units = PlantUnits.of(plant).rounded()
    left, own = units.equations[:, None], units.states
    columns = _undriven(left * plant.E * own, left * plant.A * own, left * plant.Bw, discrete=plant.is_discrete)
    count = columns.shape[1]
    if not count:
        return plant
    noise = np.vstack([left * plant.Bw, units.outputs[:, None] * plant.Dw])
    size = drive * (float(np.max(np.abs(noise), initial=0.0)) or 1.0)
    return plant.replace(
        Bw=np.hstack([plant.Bw, size * columns / left]),
        Dw=np.hstack([plant.Dw, np.zeros((plant.ny, count))]),
        noise_names=[*plant.noise_names, *(f"drive of lasting mode {i + 1}" for i in range(count))],
    )


def _undriven(e: FloatArray, a: FloatArray, noise: FloatArray, *, discrete: bool) -> FloatArray:
    """Return orthonormal columns that drive every lasting mode which the noise does not."""
    alpha, beta = scipy.linalg.eigvals(a, e, homogeneous_eigvals=True)
    finite = np.abs(beta) * INFINITE_EIGENVALUE > np.abs(alpha)
    modes = alpha[finite] / beta[finite]
    if discrete:
        lasting = modes[np.abs(modes) >= STABLE_RADIUS]
    else:
        lasting = modes[modes.real >= -AXIS_SHARE * np.max(np.abs(modes), initial=0.0)]
    columns: list[FloatArray] = []
    for mode in lasting[lasting.imag >= 0.0]:
        vectors = scipy.linalg.null_space((a - mode * e).conj().T, rcond=RANK_TOLERANCE)
        # Older releases of SciPy take no matrix without rows or columns.
        if vectors.shape[1] and noise.shape[1]:
            vectors = vectors @ scipy.linalg.null_space(noise.T @ vectors, rcond=RANK_TOLERANCE)
        columns += [vectors.real, vectors.imag] if vectors.shape[1] else []
    if not columns:
        return np.zeros((len(a), 0))
    return np.asarray(scipy.linalg.orth(np.hstack(columns), rcond=RANK_TOLERANCE))

"""Undamped modes without noise: integrators of a constant, and oscillations.

Their part of the error decays only where the filter reads them, which costs noise: where they are on the boundary of
stability, no stable filter reaches the least gain of all causal ones, and some come as near as one likes.  Beyond it
(modes that grow) a gap may stay.  The filter is designed as if a little noise drove them, and its claims are those for
the plant as it is.  The least mean square of filters whose errors decay needs no such noise where modes grow: the
Riccati equation has a stabilising solution without it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.least_estimation import STABLE_RADIUS
from obsynth.numerics.ranks import RANK_TOLERANCE
from obsynth.numerics.standard_form import INFINITE_EIGENVALUE
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.plant_units import PlantUnits
from obsynth.plants.signal_names import unused_names

#: Noise that drives them, of the largest of the plant's own, in units in which the plant is near one: the less, the
#: nearer is the gain to the least, and the slower the errors settle (at 1e-2 in some hundred samples).
ADDED_DRIVES = (1e-2, 1e-3, 1e-4, 1e-5)
#: How far from the axis, of its distance from the origin or of the fastest mode, a continuous mode counts as lasting.
AXIS_SHARE = 1e-6


def with_lasting_modes_driven(plant: DescriptorSystem, drive: float = ADDED_DRIVES[0]) -> DescriptorSystem:
    """Return the plant with noise that drives its lasting modes; as it is where each of them is driven."""
    return _with_drives(plant, drive, "drive of lasting mode", grows=None)


def with_growing_modes_reached(plant: DescriptorSystem, drive: float | None = None) -> tuple[DescriptorSystem, int]:
    """Return the plant with columns of noise, the last ones, that reach its undriven growing modes, and their count.

    ``drive``: of noise on lasting modes that do not grow; by default none.
    """
    driven = plant if drive is None else _with_drives(plant, drive, "drive of lasting mode", grows=False)
    reached = _with_drives(driven, ADDED_DRIVES[0], "start of growing mode", grows=True)
    return reached, reached.nw - driven.nw


def _with_drives(plant: DescriptorSystem, drive: float, name: str, *, grows: bool | None) -> DescriptorSystem:
    units = PlantUnits.of(plant).rounded()
    equation_units, own = units.equations[:, None], units.states
    columns = _undriven(
        equation_units * plant.E * own,
        equation_units * plant.A * own,
        equation_units * plant.Bw,
        plant.is_discrete,
        grows,
    )
    count = columns.shape[1]
    if not count:
        return plant
    noise = np.vstack([equation_units * plant.Bw, units.outputs[:, None] * plant.Dw])
    size = drive * (float(np.max(np.abs(noise), initial=0.0)) or 1.0)
    return plant.replace(
        Bw=np.hstack([plant.Bw, size * columns / equation_units]),
        Dw=np.hstack([plant.Dw, np.zeros((plant.ny, count))]),
        noise_names=[
            *plant.noise_names,
            *unused_names([f"{name} {i + 1}" for i in range(count)], plant.noise_names),
        ],
    )


def _undriven(e: FloatArray, a: FloatArray, noise: FloatArray, discrete: bool, grows: bool | None) -> FloatArray:
    """Return orthonormal columns that drive every lasting mode which the noise does not: of all, or as it ``grows``.

    Columns of modes that grow drive none of the others that last, nor do those of these drive modes that grow."""
    alpha, beta = scipy.linalg.eigvals(a, e, homogeneous_eigvals=True)
    finite = _is_finite(alpha, beta)
    edge = 1.0 - STABLE_RADIUS
    if not discrete:
        edge = AXIS_SHARE * float(np.max(np.abs(alpha[finite] / beta[finite]), initial=0.0))

    def lasts(modes: NDArray[np.complex128], grows: bool | None) -> NDArray[np.bool_]:
        beyond = np.abs(modes) - 1.0 if discrete else modes.real
        return np.asarray((beyond >= -edge) & ((grows is None) | ((beyond > edge) == bool(grows))))

    modes = alpha[finite] / beta[finite]
    lasting = modes[lasts(modes, grows)]
    columns: list[FloatArray] = []
    lengths = np.linalg.norm(noise, axis=0)
    directions = noise[:, lengths > 0.0] / lengths[lengths > 0.0]
    for mode in lasting[lasting.imag >= 0.0]:
        vectors = scipy.linalg.null_space((a - mode * e).conj().T, rcond=RANK_TOLERANCE)
        # Older releases of SciPy take no matrix without rows or columns.
        if vectors.shape[1] and directions.shape[1]:
            _, sizes, turned = np.linalg.svd(directions.T @ vectors)
            vectors = vectors @ turned[int(np.sum(sizes > RANK_TOLERANCE)) :].conj().T
        columns += [vectors.real, vectors.imag] if vectors.shape[1] else []
    if not columns:
        return np.zeros((len(a), 0))
    driving = np.hstack(columns)
    others = 0 if grows is None else int(np.sum(lasts(modes, not grows)))
    if others:

        def is_other(alpha: NDArray[np.complex128], beta: NDArray[np.float64]) -> NDArray[np.bool_]:
            found = _is_finite(alpha, beta)
            found[found] = lasts(alpha[found] / beta[found], not grows)
            return found

        left = scipy.linalg.ordqz(a.T, e.T, sort=is_other)[5][:, :others]
        driving = driving - left @ (left.T @ driving)
    return np.asarray(scipy.linalg.orth(driving, rcond=RANK_TOLERANCE))


def _is_finite(alpha: NDArray[np.complex128], beta: NDArray[Any]) -> NDArray[np.bool_]:
    return np.asarray(np.abs(beta) * INFINITE_EIGENVALUE > np.abs(alpha))

"""Lasting modes: modes of the plant that do not decay and that no noise drives, as constants and oscillations.

The error of such a mode decays only if the filter corrects the mode by measurements, which adds noise to the estimates.
For modes on the boundary of stability, no stable filter reaches the least gain of all causal filters, but stable
filters come arbitrarily near to it.  For growing modes a gap may remain.  The filter is designed with a little noise on
these modes, and its claims are computed for the plant without that noise.  For growing modes, the least mean square of
filters whose errors decay needs no added noise: the Riccati equation has a stabilising solution without it.
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

#: Noise added to lasting modes, relative to the largest noise of the plant, in units in which the plant's entries are
#: near one.  Less noise gives a gain nearer to the least one, and slower errors (at 1e-2 some hundred samples).
ADDED_DRIVES = (1e-2, 1e-3, 1e-4, 1e-5)
#: A continuous mode counts as lasting up to this distance left of the axis, relative to the size of the fastest mode.
AXIS_SHARE = 1e-6


def with_lasting_modes_driven(plant: DescriptorSystem, drive: float = ADDED_DRIVES[0]) -> DescriptorSystem:
    """Return the plant with noise that drives its lasting modes; the plant itself if noise drives each of them."""
    return _with_drives(plant, drive, "drive of lasting mode", grows=None)


def with_growing_modes_reached(plant: DescriptorSystem, drive: float | None = None) -> tuple[DescriptorSystem, int]:
    """Return the plant with additional last columns of noise on growing modes without noise, and their number.

    ``drive`` is the size of the noise on lasting modes that do not grow; by default there is none.
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
    """Return orthonormal columns of noise for the lasting modes that no noise drives.

    ``grows`` selects the growing modes, those that do not grow, or all (`None`).  Columns of growing modes drive no
    other lasting mode, and columns of the others no growing mode.
    """
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

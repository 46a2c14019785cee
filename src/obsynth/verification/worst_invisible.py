"""The worst combination of invisible faults and noise, in double precision, as a starting point of a proof.

Of each point there are as many invisible signals as inputs beyond the outputs, and the ratio of error to noise is the
largest for one combination of all of them.  It is computed here, and nothing is concluded from it: a proof that
encloses that one direction of each point, and not all, does the same with a hundredth of the work.  Signals come in
conjugate pairs, so that the energies are real matrices on real coefficients.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from obsynth.numerics.arrays import ComplexArray, FloatArray

Model = tuple[FloatArray, FloatArray, FloatArray, FloatArray]
Array = NDArray[Any]

#: What is added to the energy of the noise where close points leave it singular to rounding, of its trace's rounding.
REGULAR_SHARES = (1.0, 10.0, 100.0, 1000.0)


class Directions(NamedTuple):
    """The free entries of the worst signals: of each point, and of the last samples; and their ratio, not proved."""

    of_points: Mapping[complex, ComplexArray]
    of_samples: FloatArray
    ratio: float


class Kernel(NamedTuple):
    """Signals as columns, ``(x, h, w)`` of a point or all unknowns of the last samples, and their free entries."""

    columns: Array
    free: Array


class Shown(NamedTuple):
    """Where faults and noise are in the signals: slices of their rows."""

    faults: slice
    noise: slice


class Through(NamedTuple):
    """Models that the faults pass, one after the other, delays of each fault (none with models), and the last samples
    up to now: those that follow show no output."""

    models: Sequence[Model]
    delays: Sequence[int]
    samples: int


def kernel(matrix: Array, pivots: Sequence[int], others: Sequence[int]) -> Kernel:
    """Return an orthonormal basis of the kernel of a matrix, and its entries at the places ``others``.

    Parameters
    ----------
    matrix : array
        With independent rows, of which the columns ``pivots`` are regular.
    pivots, others : sequences of int
        All columns.

    Raises
    ------
    numpy.linalg.LinAlgError
        The pivots are singular.
    """
    placed = np.zeros((len(pivots) + len(others), len(others)), dtype=matrix.dtype)
    placed[others, range(len(others))] = 1.0
    placed[pivots] = -np.linalg.solve(matrix[:, pivots], matrix[:, others])
    columns = np.linalg.qr(placed)[0]
    return Kernel(columns, columns[others])


def worst_directions(
    kernels: Mapping[complex, Kernel],
    rest: tuple[Sequence[FloatArray], FloatArray],
    shown: Shown,
    through: Through,
    *,
    discrete: bool,
) -> Directions | None:
    """Return the combination of invisible signals whose ratio of error to noise is the largest; ``None`` for none.

    Parameters
    ----------
    kernels : mapping
        The signals of each point on or above the real axis; conjugates are added.
    rest : pair
        Inputs of each of the last samples that start from rest, as columns, and the free entries of those columns.
    shown : Shown
        Rows of faults and noise in the signals; in the last samples they are the first and the last ones.
    through : Through
        What the faults pass to the error, and until when.
    discrete : bool
        Whether signals are ``s^t`` or ``e^{s t}``.
    """
    points = np.concatenate([np.full(part.free.shape[1], point) for point, part in kernels.items()] or [np.zeros(0)])
    columns = [part.columns for part in kernels.values()]
    signals = np.hstack(columns) if columns else np.zeros((shown.noise.stop, 0))
    both = np.concatenate([points, points.conj()])
    faults, noise = (np.hstack([part, part.conj()]) for part in (signals[shown.faults], signals[shown.noise]))
    error, states = faults, []
    for a, b, c, d in through.models:
        inner = _states(a, b @ error, both)
        states.append(inner)
        error = c @ inner + d @ error
    inner_weights = both.conj()[:, None] * both - 1.0 if discrete else both.conj()[:, None] + both
    energies = [(part.conj().T @ part) / inner_weights for part in (error, noise)]
    inputs, free = rest
    if inputs:
        tails = _last_samples((faults, noise), both, inputs, through, states)
        late = free.shape[1]
        energies = [np.pad(part, (0, late)) for part in energies]
        energies = [part + tail.conj().T @ tail for part, tail in zip(energies, tails, strict=True)]
    found = _largest(*(_on_real_coefficients(part, points) for part in energies))
    if found is None:
        return None
    ratio, best = found
    of_points, place = {}, 0
    for point, part in kernels.items():
        here = slice(place, place + part.free.shape[1])
        place = here.stop
        coefficients = best[: len(points)][here] + 1j * best[len(points) : 2 * len(points)][here]
        of_points[point] = np.asarray(part.free @ coefficients)
    return Directions(of_points, free @ best[2 * len(points) :], ratio)


def _states(a: FloatArray, driven: ComplexArray, points: ComplexArray) -> ComplexArray:
    """Return the states of a model, which a column of inputs drives at each point."""
    if not len(a) or not len(points):
        return np.zeros((len(a), len(points)), dtype=complex)
    return np.asarray(np.linalg.solve(points[:, None, None] * np.eye(len(a)) - a, driven.T[:, :, None])[:, :, 0].T)


def _last_samples(
    members: tuple[ComplexArray, ComplexArray],
    points: ComplexArray,
    inputs: Sequence[FloatArray],
    through: Through,
    states: Sequence[ComplexArray],
) -> tuple[ComplexArray, ComplexArray]:
    """Return error and noise in the last samples, one under the other: members go on, others start from rest."""
    faults, noise = members
    powers = points ** np.arange(len(inputs))[:, None]
    nf, nw = len(faults), len(noise)
    outputs = [np.hstack([faults * power, part[:nf]]) for power, part in zip(powers, inputs, strict=True)]
    noises = [np.hstack([noise * power, part[len(part) - nw :]]) for power, part in zip(powers, inputs, strict=True)]
    for (a, b, c, d), inner in zip(through.models, states, strict=True):
        state, passed = np.pad(inner, ((0, 0), (0, inputs[0].shape[1]))), []
        for sample in outputs:
            passed.append(c @ state + d @ sample)
            state = a @ state + b @ sample
        outputs = passed
    late = np.array(through.delays or (0,) * len(outputs[0]))
    outputs = [part[k + late < through.samples] for k, part in enumerate(outputs)]
    return np.vstack(outputs), np.vstack(noises)


def _on_real_coefficients(energy: ComplexArray, points: ComplexArray) -> FloatArray:
    """Return the energy of ``c v + conj(c v)`` on the real and imaginary parts of c, beside real signals."""
    count = len(points)
    first, second = slice(count), slice(count, 2 * count)

    def paired(part: ComplexArray, turn: complex) -> ComplexArray:
        ahead, behind = part[:, first], part[:, second]
        return np.hstack([ahead + behind, turn * (ahead - behind), part[:, 2 * count :]])

    real = np.array(paired(paired(energy, 1j).T, -1j).T.real)
    # Signals of real points have no imaginary part.
    nothing = count + np.flatnonzero(points.imag == 0.0)
    real[nothing], real[:, nothing] = 0.0, 0.0
    return real


def _largest(error: FloatArray, noise: FloatArray) -> tuple[float, FloatArray] | None:
    """Return the root of the largest ratio of two energies and its coefficients; the error's has few directions."""
    sizes = np.diag(error) + np.diag(noise)
    present = np.flatnonzero(sizes > 0.0)
    if not present.size or not np.all(np.isfinite(sizes)):
        return None
    units = 1.0 / np.sqrt(sizes[present])
    error, noise = (units[:, None] * part[np.ix_(present, present)] * units for part in (error, noise))
    factor = _factor(noise)
    lower, order, rank, _ = scipy.linalg.lapack.dpstrf(error, lower=1)
    roots = np.zeros((len(error), rank))
    roots[order - 1] = np.tril(lower)[:, :rank]
    if factor is None:
        return None
    scaled = scipy.linalg.solve_triangular(factor, roots, lower=True)
    values, vectors = np.linalg.eigh(scaled.T @ scaled)
    if not rank or values[-1] <= 0.0:
        return None
    whole = np.zeros(len(sizes))
    whole[present] = units * scipy.linalg.solve_triangular(factor, scaled @ vectors[:, -1], lower=True, trans="T")
    return float(np.sqrt(values[-1])), whole


def _factor(energy: FloatArray) -> FloatArray | None:
    """Return a Cholesky factor of an energy with as little on its diagonal as makes it definite."""
    for share in REGULAR_SHARES:
        try:
            added = share * np.finfo(float).eps * np.trace(energy) * np.eye(len(energy))
            return np.asarray(scipy.linalg.cholesky(energy + added, lower=True))
        except np.linalg.LinAlgError:
            continue
    return None

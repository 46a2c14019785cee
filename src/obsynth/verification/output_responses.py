"""Frequency responses of a plant's outputs and of what a linear observer makes of them.

From the plant and the shipped realisation alone.  The plant may be unstable, and need not be regular.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from obsynth.analysis.existence.augmented_pencils import equilibrated
from obsynth.errors import SpecError
from obsynth.numerics.arguments import arguments_checked, real_array
from obsynth.numerics.arrays import ComplexArray, FloatArray
from obsynth.numerics.modal_response import resolved
from obsynth.numerics.norms import response
from obsynth.numerics.ranks import BOUNDARY_TOLERANCE, RANK_TOLERANCE
from obsynth.numerics.spectra import boundary_points
from obsynth.observers.linear.modes import frequency_grid, poles_of
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.pencil import regularity_of
from obsynth.results.design import ObserverDesign

#: Around a mode of the plant: a circle of this share of the distance to the nearest mode of the observer.
CIRCLE_SHARE, POINTS_OF_A_CIRCLE = 0.1, 16

#: On a circle of half the radius a pole is twice as large, and what has none nearly the same.
GROWTH_TO_A_POLE = 1.5


@arguments_checked
def fault_response(design: ObserverDesign, frequencies: ArrayLike) -> ComplexArray:
    """Return the frequency response from the faults to their estimates: what a sinusoidal fault looks like.

    Parameters
    ----------
    design : ObserverDesign
        Linear, with fault estimates; a fault model plays no role here.
    frequencies : array_like, rad/s
        ``(k,)``, or one number; zero is the response to a constant.

    Returns
    -------
    ComplexArray
        ``(k, nf of the estimates, nf)``: entry (i, j) is ``fhat_i / f_j``; the identity where the estimates are
        faithful, ``exp(-i w L dt)`` times it where they are so with a delay of L samples.

    Raises
    ------
    SpecError
        The design is recursive or scheduled, estimates no faults, or a frequency is not finite, or is that of an
        undamped mode of the plant, at which the response has no limit.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]], C=[[1, 0], [0, 1]], Bf=[[1], [0]], Bd=[[0], [1]], dt=1.0
    ... )
    >>> design = obsynth.ui_pi_observer(plant, decay=0.5)
    >>> abs(obsynth.fault_response(design, [1e-6])).round(3).ravel().tolist()
    [1.0]
    """
    plant, observer = design.linear
    if not observer.fault_names:
        raise SpecError("The design estimates no faults.", path="design")
    at = np.atleast_1d(real_array(frequencies, "frequencies")).ravel()
    if not np.isfinite(at).all():
        raise SpecError("frequencies must be finite numbers, in rad/s.", path="frequencies")
    if not at.size:
        return np.zeros((0, len(observer.fault_names), plant.nf), dtype=np.complex128)
    points = boundary_points(at, observer.dt)
    responses = _fault_responses(plant, observer, points)
    if regularity_of(plant)[0]:
        for k, point in enumerate(points):
            if _is_a_mode(plant, point):
                responses[k] = _mean_around(plant, observer, point, f"{at[k]:g} rad/s")
    return responses


def _fault_responses(plant: DescriptorSystem, observer: LinearObserver, points: ComplexArray) -> ComplexArray:
    rows = observer.fault_rows
    to_estimate = response(observer.Az, observer.By, observer.Cz[rows], observer.Dy[rows], points)
    return output_responses(plant, plant.Bf, plant.Df, points, to_estimate)[1]


def _is_a_mode(plant: DescriptorSystem, point: complex) -> bool:
    """Whether a point is an eigenvalue of the plant, where its outputs have no response but their estimates may."""
    values = np.linalg.svd(equilibrated(point * plant.E - plant.A)[0], compute_uv=False)
    return bool(values[-1] <= BOUNDARY_TOLERANCE * values[0])


def _mean_around(plant: DescriptorSystem, observer: LinearObserver, point: complex, shown: str) -> ComplexArray:
    """Return the response at a mode of the plant that the observer cancels: the mean over a circle around it.

    What is not cancelled grows as the circle shrinks; what is has the same size on both.
    """
    radius = CIRCLE_SHARE * float(np.min(np.abs(poles_of(observer) - point), initial=max(abs(point), 1.0)))
    circle = np.exp(2j * np.pi * (np.arange(POINTS_OF_A_CIRCLE) + 0.5) / POINTS_OF_A_CIRCLE)
    wide, narrow = (_fault_responses(plant, observer, point + share * radius * circle) for share in (1.0, 0.5))
    if np.abs(narrow).max() > GROWTH_TO_A_POLE * np.abs(wide).max():
        raise SpecError(
            f"frequencies has {shown}, an undamped mode of the plant that the fault estimates do not cancel: leave it "
            "out.",
            path="frequencies",
        )
    return np.asarray(wide.mean(axis=0))


def over_frequencies(observer: LinearObserver, rows: slice) -> tuple[FloatArray, ComplexArray, ComplexArray]:
    """Return frequencies (rad/s), their points on the boundary, and what some outputs make of y there."""
    frequencies = frequency_grid(observer)[1:]
    return frequencies, *at_frequencies(observer, rows, frequencies)


def at_frequencies(observer: LinearObserver, rows: slice, frequencies: FloatArray) -> tuple[ComplexArray, ComplexArray]:
    """Return the points on the boundary of some frequencies (rad/s), and what some outputs make of y there."""
    points = boundary_points(frequencies, observer.dt)
    return points, response(observer.Az, observer.By, observer.Cz[rows], observer.Dy[rows], points)


def output_responses(
    plant: DescriptorSystem, b: FloatArray, d: FloatArray, points: ComplexArray, to_estimate: ComplexArray
) -> tuple[ComplexArray, ComplexArray, FloatArray]:
    """Return the states that an input drives, what the outputs show of it, and the size of the terms of that."""
    states = _state_response(plant, b, points)
    outputs = plant.C @ states + d
    return states, np.asarray(to_estimate @ outputs), sizes_of(to_estimate) * sizes_of(outputs)


def _state_response(plant: DescriptorSystem, b: FloatArray, points: ComplexArray) -> ComplexArray:
    """Return a state for each input: of a plant that is not regular one of many, which its estimates cannot tell."""
    if regularity_of(plant)[0]:
        try:
            return np.concatenate([*resolved(plant.E, plant.A, b, points)])
        except np.linalg.LinAlgError:
            pass  # beside an integrator a low frequency is lost in rounding
    return np.stack([_least_state(point * plant.E - plant.A, b) for point in points])


def _least_state(pencil: ComplexArray, b: FloatArray) -> ComplexArray:
    """Return the least ``x`` with ``pencil x = b``, where each row and column has a size near one."""
    nx = pencil.shape[1]
    scaled, columns = equilibrated(np.hstack([pencil, b]))
    solution = np.linalg.pinv(scaled[:, :nx], rcond=RANK_TOLERANCE) @ scaled[:, nx:]
    return np.asarray(columns[:nx, None] * solution / columns[nx:])


def sizes_of(matrices: ComplexArray) -> FloatArray:
    """Return the Frobenius norm of each matrix."""
    return np.asarray(np.linalg.norm(matrices, axis=(1, 2)))

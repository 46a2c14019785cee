"""Time scales of a PD observer, and options that are proved impossible before a solver runs."""

from __future__ import annotations

import math

import numpy as np

from obsynth.analysis.structure import analyse_structure
from obsynth.errors import InfeasibleError
from obsynth.methods.pd_observer.method import PdObserver
from obsynth.methods.pd_observer.realisation import with_sensor_noise
from obsynth.numerics.arrays import ComplexArray, FloatArray, largest_singular_value
from obsynth.numerics.outward import lower_text
from obsynth.numerics.ranks import NEGLIGIBLE_MODE, decide_rank
from obsynth.numerics.scaling import balanced_matrix, equilibrate_pencil
from obsynth.plants.descriptor import DescriptorSystem

#: Damping ratio from which a mode decays by itself.
WELL_DAMPED = 0.5

#: Well-damped modes this many times faster than the plant's pace are none of the observer's business.
FAR_BEYOND = 100.0

NO_MODES: ComplexArray = np.zeros(0, dtype=np.complex128)


def fastest_shown_mode(plant: DescriptorSystem) -> float:
    """Return `fastest_mode` of an explicit plant without the modes that no output shows, where it has others."""
    return fastest_mode(plant.A, np.array(analyse_structure(plant).unobservable_modes))


def fastest_mode(a: FloatArray, hidden: ComplexArray = NO_MODES) -> float:
    """Return the largest modulus of an eigenvalue to follow, damped ones far beyond left out; 1 for integrators."""
    balanced = balanced_matrix(a)[0]
    modes = np.linalg.eigvals(balanced)
    for mode in hidden if len(hidden) < len(modes) else NO_MODES:
        modes = np.delete(modes, np.argmin(np.abs(modes - mode)))
    sizes = np.abs(modes)
    if not np.max(sizes) > NEGLIGIBLE_MODE * largest_singular_value(balanced):
        return 1.0
    # An integrator is at rest, on whichever side of zero rounding has put it.
    moving = sizes > NEGLIGIBLE_MODE * float(np.max(sizes))
    damped = moving & (modes.real < -WELL_DAMPED * sizes)
    # What is not damped sets the pace; where all is damped or at rest, the slowest mode that moves does.
    pace = float(np.max(sizes[moving & ~damped], initial=0.0)) or float(np.min(sizes[moving]))
    return float(np.max(sizes[(sizes <= FAR_BEYOND * pace) | ~damped]))


def default_delta(plant: DescriptorSystem, method: PdObserver, decay: float) -> float:
    """Return the delta to use, in seconds: as asked, or the inverse of the plant's fastest mode where that serves."""
    if method.delta is not None:
        return float(method.delta)
    if method.disk_numbers is not None:
        centre, radius = method.disk_numbers
        return 1.0 / centre if centre > 0.0 else 2.0 / (centre + radius)
    delta = 1.0 / fastest_shown_mode(plant)
    limit = theorem_2_limit(plant, decay) if method.theorem == 2 else math.inf
    return min(delta, 0.5 * limit)


def theorem_2_limit(plant: DescriptorSystem, decay: float) -> float:
    """Return the delta from which Theorem 2 has no solution: the least ``4 |sigma| / w^2`` of an unobservable pair."""
    pairs = [mode for mode in analyse_structure(plant).unobservable_modes if mode.imag > 0.0]
    return min((4.0 * abs(mode.real + decay) / mode.imag**2 for mode in pairs), default=math.inf)


def require_possible(plant: DescriptorSystem, method: PdObserver, *, delta: float, decay: float) -> None:
    """Refuse what no gains, or no solution of these inequalities, can give."""
    hidden = analyse_structure(plant).unobservable_modes
    slowest = max((mode.real for mode in hidden), default=-math.inf)
    if -slowest <= decay:
        raise InfeasibleError(
            f"No observer reaches a decay rate of {decay:.6g} 1/s: the mode with real part {slowest:.6g} is "
            "unobservable, so that no gain moves it. Ask for less, or measure something it moves.",
            necessary=True,
        )
    if method.disk_numbers is not None:
        centre, radius = method.disk_numbers
        outside = [mode for mode in hidden if abs(mode + centre) >= radius]
        if outside:
            raise InfeasibleError(
                f"No observer has all its eigenvalues within {radius:.6g} of {-centre:.6g}: the mode {outside[0]:.6g} "
                "is unobservable, so that no gain moves it.",
                necessary=True,
            )
        if abs(-1.0 / delta + centre) >= radius:
            raise InfeasibleError(
                f"The inequality for the disk has no solution with delta = {delta:.6g} s: -1/delta must lie inside the "
                f"disk. Leave delta out, or take {1.0 / centre if centre > 0.0 else 2.0 / (centre + radius):.6g} s.",
                necessary=False,
            )
    limit = theorem_2_limit(plant, decay) if method.theorem == 2 else math.inf
    if delta >= limit:
        raise InfeasibleError(
            f"Theorem 2 has no solution with delta = {delta:.6g} s: an unobservable pair of modes needs delta < "
            f"4 |sigma| / w^2 = {limit:.6g} s. Lower delta, or use theorem 1, which does not depend on it.",
            necessary=False,
            lower_bound=None,
        )
    if method.noise_gain is not None:
        least = least_noise_gain(plant)
        if method.noise_gain <= least:
            raise InfeasibleError(
                f"No observer has a noise gain of {method.noise_gain:.6g}: already in steady state the fault has to be "
                f"computed from the outputs, which multiplies errors by {lower_text(least, 6)} or more. Raise "
                "noise_gain.",
                necessary=True,
                lower_bound=least,
            )


def least_noise_gain(plant: DescriptorSystem) -> float:
    """Return a lower bound, for any unbiased observer, on the gain from constant sensor noise to the fault estimate.

    That of the least linear map that reads every pair ``A x + Bf f = 0`` from ``C x + Df f``; zero where sensor noise
    alone does not reach every output.
    """
    noisy = with_sensor_noise(plant)
    noise = noisy.Dw[:, ~np.any(noisy.Bw != 0.0, axis=0)]
    if not decide_rank(noise, expected=plant.ny).full:
        return 0.0
    equations = np.hstack([plant.A, plant.Bf])
    scaled = equilibrate_pencil(np.zeros_like(equations), equations)
    rank = decide_rank(scaled.A, equilibrated=False).rank
    still = scaled.columns[:, None] * np.linalg.svd(scaled.A)[2][rank:].T
    outputs, faults = np.hstack([plant.C, plant.Df]) @ still, still[plant.nx :]
    return largest_singular_value(faults @ np.linalg.pinv(np.linalg.pinv(noise) @ outputs)) if still.size else 0.0

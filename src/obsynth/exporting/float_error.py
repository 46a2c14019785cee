"""Bounds on the difference between an observer in single precision and the one in double precision."""

from __future__ import annotations

import numpy as np

from obsynth.exporting.realisation import Realisation
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.outward import upper_text

#: Relative rounding of a float, and of a double.
UNIT = 2.0**-24

#: Samples whose effects are summed up at most, and what is left of an effect that is over.
MOST_SUMMED_SAMPLES, OVER = 100_000, 1e-9

#: Rounds in which an error that feeds on itself has to settle, and by how much it may still grow.
MOST_ROUNDS, SETTLED_ERROR = 100, 1e-3


def float_bounds(realisation: Realisation) -> FloatArray | None:
    """Return a bound on the error of each row of estimates ``(rows,)``, for inputs and outputs whose deviations stay
    within one unit, and samples that are complete; `None` where none is found.

    Rounding of n products and of the coefficients is at most ``(n + 2) u`` of the sum of their sizes (Higham 2002,
    lemma 3.1); errors of the state are carried on by ``sum |Az^k|``.
    """
    observer = realisation.observer
    driven = np.abs(np.hstack(list(realisation.transition.values())[1:])).sum(axis=1)
    if realisation.straight:
        # A rise between samples is at most two units.
        driven = driven + np.abs(realisation.transition["rise"]).sum(axis=1)
    transition, rows = realisation.transition["z"], np.abs(realisation.running.Cz)
    through = np.abs(np.hstack([realisation.running.Du, realisation.running.Dy])).sum(axis=1)
    gathered = _sum_of_powers(transition)
    if gathered is None:
        return None
    # A sum that is not known of all samples is rounded up.
    size, count = gathered @ driven, observer.order + 2 * len(realisation.inputs) + 2
    unit = count * UNIT / (1.0 - count * UNIT)
    error = np.zeros(observer.order)
    for _ in range(MOST_ROUNDS):
        local = unit * (np.abs(transition) @ (size + error) + driven)
        after = gathered @ local
        if np.all(after <= error * (1.0 + SETTLED_ERROR)):
            return np.asarray((1.0 + SETTLED_ERROR) * (rows @ error + unit * (rows @ (size + error) + through)))
        error = np.maximum(after, error) * (1.0 + SETTLED_ERROR)
    return None


def _sum_of_powers(matrix: FloatArray) -> FloatArray | None:
    """Return ``sum |A^k|`` over all k >= 0, from above but for rounding; `None` where it does not end."""
    power, total = np.eye(len(matrix)), np.zeros_like(matrix)
    for _ in range(MOST_SUMMED_SAMPLES):
        with np.errstate(over="ignore", invalid="ignore"):  # an observer that is not stable
            total += np.abs(power)
            power = power @ matrix
        norm = float(np.abs(power).sum(axis=1).max(initial=0.0))
        if not np.isfinite(norm):
            return None
        if norm <= OVER:
            # What is left: |A^K| sum |A^k|, which is less than a share OVER of the sum.
            return np.asarray(total * (1.0 + OVER) / (1.0 - OVER) + OVER * np.abs(total).sum())
    return None


def float_error(realisation: Realisation) -> str:
    """Return what the header of an export in floats says of its error."""
    bounds = float_bounds(realisation)
    if bounds is None:
        return "Floats: no bound on the error of single precision was found, as its errors decay too slowly."
    names = realisation.observer.row_names
    listed = ", ".join(f"{name} {upper_text(bound, 2)}" for name, bound in zip(names, bounds, strict=True))
    return (
        "Floats: a derived bound on the error against double precision, for complete samples whose deviations stay "
        f"within 1 unit each (n times as much for n units): {listed}"
    )

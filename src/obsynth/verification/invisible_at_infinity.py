"""Faults and noise of ever higher frequency that no output shows: a bound by what passes the reference model at once.

Continuous time, index one.  With ``E x0 = 0``, ``E x1 = A x0 + Bh h + Bw w`` and ``C x0 + Dh h + Dw w = 0`` the signals
``(h, w) e^{s t}`` drive outputs that vanish like 1/s, and so does what a causal filter of finite gain makes of them:
its error tends to the reference model at infinity times the faults.  The kernel is exact, in rational numbers.
Source: ours; compare A. Varga, *Solving Fault Diagnosis Problems*, 2017, section 5.7, where the model is rescaled.
"""

from __future__ import annotations

from typing import Any

import flint
import numpy as np

from obsynth.plants.descriptor import DescriptorSystem
from obsynth.verification.invisible_faults import (
    PRECISION_BITS,
    Setting,
    exact_kernel,
    has_index_one,
    hidden_and_bounded,
    without_dependent,
    worst_ratio,
)


def proved_at_infinity(plant: DescriptorSystem, setting: Setting) -> float | None:
    """Return a number that the gain of every causal filter reaches, rounded down; ``None`` where nothing is proved.

    Parameters
    ----------
    plant : DescriptorSystem
        As `obsynth.verification.invisible_faults.seen_plant` returns it, in continuous time.
    setting : Setting
        What the filter must do.
    """
    if plant.is_discrete or not setting.models or not has_index_one(plant):
        return None
    plant, faint = without_dependent(plant, setting)
    (bh, dh), (bw, dw) = hidden_and_bounded(plant, setting)
    nx, ny = plant.nx, plant.ny
    rows = [
        np.hstack([plant.E, np.zeros((nx, nx + bh.shape[1] + bw.shape[1]))]),
        np.hstack([plant.A, -plant.E, bh, bw]),
        np.hstack([plant.C, np.zeros((ny, nx)), dh, dw]),
    ]
    with flint.ctx.workprec(PRECISION_BITS[0]):
        signals = exact_kernel(np.vstack(rows))
        inputs, answered = _rows(signals, 2 * nx), None
        if faint is not None:
            rows_shown = np.hstack([faint.C, np.zeros((len(faint.C), nx)), faint.Dh, faint.Dw])
            shown = flint.acb_mat(len(rows_shown), rows_shown.shape[1], rows_shown.ravel().tolist()) * signals
            shown = shown * flint.acb(faint.answer_limit)
            answered = shown.transpose() * shown
        first = 0 if setting.exact else bh.shape[1]
        faults = _rows(inputs, first, first + plant.nf)
        noise = _rows(inputs, bh.shape[1])
        error = faults
        for *_, direct in setting.models:
            error = flint.acb_mat(len(direct), direct.shape[1], direct.ravel().tolist()) * error
        try:
            return worst_ratio(error.transpose() * error, noise.transpose() * noise, None, answered=answered)
        except ZeroDivisionError:  # a matrix is singular to these digits
            return None


def _rows(matrix: Any, begin: int, end: int | None = None) -> Any:
    table = matrix.tolist()[begin:end]
    return flint.acb_mat(len(table), matrix.ncols(), [entry for row in table for entry in row])

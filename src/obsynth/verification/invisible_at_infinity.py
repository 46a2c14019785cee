"""Lower bound on the gain by high frequencies: what passes the reference model directly and no output shows.

Continuous time, index one.  With ``E x0 = 0``, ``E x1 = A x0 + Bh h + Bw w`` and ``C x0 + Dh h + Dw w = 0`` the signals
``(h, w) e^{s t}`` drive outputs that vanish like 1/s, and so does what a causal filter of finite gain makes of them:
its error tends to the reference model at infinity times the faults.  The kernel is exact, in rational numbers.
Source: ours; compare A. Varga, *Solving Fault Diagnosis Problems*, 2017, section 5.7, where the model is rescaled.
"""

from __future__ import annotations

import flint
import numpy as np

from obsynth.plants.descriptor import DescriptorSystem
from obsynth.proofs.ball_kernels import exact_kernel
from obsynth.proofs.complex_balls import complex_matrix, rows_of
from obsynth.verification.energy_ratios import worst_ratio
from obsynth.verification.invisible_faults import PRECISION_BITS
from obsynth.verification.seen_outputs import Setting, hidden_and_bounded, without_dependent
from obsynth.verification.signals_from_rest import has_index_one


def proved_at_infinity(plant: DescriptorSystem, setting: Setting) -> float | None:
    """Return a number that the gain of every causal filter reaches, rounded down; ``None`` where nothing is proved.

    Parameters
    ----------
    plant : DescriptorSystem
        As `obsynth.verification.seen_outputs.seen_plant` returns it, in continuous time.
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
        inputs, answered = rows_of(signals, range(2 * nx, signals.nrows())), None
        if faint is not None:
            rows_shown = np.hstack([faint.C, np.zeros((len(faint.C), nx)), faint.Dh, faint.Dw])
            shown = complex_matrix(rows_shown) * signals
            shown = shown * flint.acb(faint.answer_limit)
            answered = shown.transpose() * shown
        first = 0 if setting.exact else bh.shape[1]
        faults = rows_of(inputs, range(first, first + plant.nf))
        noise = rows_of(inputs, range(bh.shape[1], inputs.nrows()))
        error = faults
        for *_, direct in setting.models:
            error = complex_matrix(direct) * error
        try:
            return worst_ratio(error.transpose() * error, noise.transpose() * noise, None, answered=answered)
        except ZeroDivisionError:  # a matrix is singular to these digits
            return None

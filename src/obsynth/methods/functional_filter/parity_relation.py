"""A filter model of low order for one fault of a large plant, from a parity relation over a few samples.

With ``xi+ = A xi + B v + N w + F f``, ``0 = C xi - L v + M w + G f`` and rows ``w_0 .. w_s`` with
``sum_i w_i C A^i = 0``, the rows ``t_i = w_i C + t_(i+1) A`` end with ``t_0 = 0``: ``z_i = t_i xi`` is a chain of s
delays, driven by what is known alone, and the last of them is read (E. Chow, A. Willsky, "Analytical redundancy and the
design of robust failure detection systems", IEEE TAC 29(7), 1984).  Of all relations, the one with which a constant
fault shows most beside the noise.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.linalg import qr
from scipy.sparse import csr_array

from obsynth.methods.functional_filter.kalman_gain import FilterModel
from obsynth.numerics.arrays import FloatArray, largest_singular_value
from obsynth.numerics.ranks import rank_from, rounding_rank
from obsynth.numerics.sparse_factor import residual_in_twice_the_digits
from obsynth.numerics.spectra import abscissa

#: Plants of fewer states are served by the filter of least noise, which then takes seconds.
LARGE_ORDER = 200

#: Samples of a relation: npcc's deviations fall by less than two from 16 to 24, and its filters have to stay below 40.
SAMPLES = 16

#: Powers of A over the samples may grow by so much: digits are lost by as much.
MOST_GROWTH = 2.0

#: Sums of a relation may miss zero by this share of their terms (npcc: 5e-14 to 5e-12); what is shipped is verified.
MOST_MISSED = 1e-10

#: The noise of a relation is taken to be at least this share of its largest direction, so that none is divided by zero.
LEAST_NOISE = 1e-14


def is_large(model: FilterModel) -> bool:
    """Whether a model is of a large sampled plant, and one constant fault with noise in every row, and A does not
    grow."""
    k, faults = model.order, len(model.estimate)
    if k < LARGE_ORDER or not model.dt > 0.0 or faults != 1 or model.drive.shape[1] != 1:
        return False
    if model.A[k, k] != 1.0 or rounding_rank(model.M) < len(model.M) or len(model.C) * (SAMPLES + 1) <= k:
        return False
    return abscissa(model.A[:k, :k], model.dt) ** SAMPLES <= MOST_GROWTH


def relation_model(model: FilterModel, seconds: float) -> FilterModel | None:
    """Return the model of a relation, for noise averaged over a time; ``None`` where no relation is accurate."""
    k, p, s = model.order, len(model.C), SAMPLES
    a, c, n, m = model.A[:k, :k], model.C[:, :k], model.N[:k], model.M
    f, g = model.A[:k, k:], model.C[:, k:]
    powers = [c]
    for _ in range(s):
        powers.append(powers[-1] @ a)
    q, r, _ = qr(np.vstack(powers), pivoting=True)
    relations = q[:, rank_from(np.abs(np.diag(r)), expected=k).rank :].T
    if not len(relations):
        return None
    noise, shown = (_responses(relations, a, c, *inputs) for inputs in ((n, m), (f, g)))
    steady, gains = noise.sum(axis=1), shown.sum(axis=1)[:, 0]
    every = noise.reshape(len(relations), -1)
    covariance = steady @ steady.T + every @ every.T * (model.dt / max(seconds, model.dt))
    covariance += LEAST_NOISE * float(np.trace(covariance)) * np.eye(len(relations))
    best = np.linalg.solve(covariance, gains)
    size = float(np.linalg.norm(best))
    if not np.isfinite(size) or size == 0.0:
        return None
    w = (best / size @ relations).reshape(s + 1, p)
    # Small gains of large relations lose their digits: what is missed is taken away from the relation itself.
    missed = _rows(w, a, c)[0]
    w = w - np.linalg.lstsq(np.vstack(powers).T, missed, rcond=None)[0].reshape(s + 1, p)
    missed, *t = _rows(w, a, c)
    terms = np.linalg.norm(w, axis=1) @ [largest_singular_value(power) for power in powers]
    if float(np.linalg.norm(missed)) > MOST_MISSED * float(terms):
        return None
    return _chain(model, np.array(t), w, f, g)


def _rows(w: FloatArray, a: FloatArray, c: FloatArray) -> FloatArray:
    """Return the rows ``t_0 .. t_s`` of a relation ``w (s + 1, p)``, each sum rounded once."""
    negative = csr_array(-np.vstack([c, a]).T)
    rows, none = np.zeros((len(w) + 1, len(a))), np.zeros((len(a), 1))
    for i in range(len(w) - 1, -1, -1):
        rows[i] = residual_in_twice_the_digits(negative, np.concatenate([w[i], rows[i + 1]])[:, None], none)[:, 0]
    return rows[:-1]


def _responses(
    relations: FloatArray, a: FloatArray, c: FloatArray, moving: FloatArray, direct: FloatArray
) -> FloatArray:
    """Return what an input at each sample makes of relations, ``(relations, s + 1, inputs)``."""
    p, count = len(c), relations.shape[1] // len(c)
    responses, row = np.zeros((len(relations), count, moving.shape[1])), np.zeros((len(relations), len(a)))
    for i in range(count - 1, -1, -1):
        weights = relations[:, i * p : (i + 1) * p]
        responses[:, i] = weights @ direct + row @ moving
        row = weights @ c + row @ a
    return responses


def _chain(model: FilterModel, t: FloatArray, w: FloatArray, f: FloatArray, g: FloatArray) -> FilterModel:
    """Return the model of the chain ``z_i = t_i xi`` with the model of the fault."""
    k, s, count = model.order, len(t), model.drive.shape[1]
    fed, last = w[:-1], w[-1:]
    none = np.zeros((count, s))

    def moved(own: FloatArray, known: FloatArray) -> FloatArray:
        return np.vstack([t @ own[:k] + fed @ known, np.zeros((count, known.shape[1]))])

    return replace(
        model,
        A=np.block([[np.eye(s, k=-1), t @ f + fed @ g], [none, model.A[k:, k:]]]),
        C=np.hstack([np.eye(1, s, s - 1), last @ g]),
        B=moved(model.B, -model.L),
        L=last @ model.L,
        N=moved(model.N, model.M),
        M=last @ model.M,
        estimate=np.hstack([np.zeros((1, s)), model.estimate[:, k:]]),
        drive=np.vstack([np.zeros((s, count)), np.eye(count)]),
        T=moved(model.T, -model.T0),
        T0=last @ model.T0,
        order=s,
    )

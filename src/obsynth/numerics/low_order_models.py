"""Stable low-order models near a target: balanced truncation, and a search over all their matrices.

What is weighed is ``left_weight (F(p) shown - target)`` at points p of the circle or the axis, F the model.  Balanced
truncation also takes the Gramians that these weights make (D. Enns, *Model reduction with balanced realizations*,
CDC 1984).  The search ends in a local minimum, never above where it began.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.linalg

from obsynth.numerics.arrays import SMALLEST, ComplexArray, FloatArray
from obsynth.numerics.decoupling_windows import Model
from obsynth.numerics.gramians import gramian_factor
from obsynth.numerics.least_estimation import STABLE_RADIUS
from obsynth.numerics.norms import response
from obsynth.numerics.ranks import HANKEL_SHARE
from obsynth.numerics.standard_form import cayley

#: Exponents of the norm of all singular values at all points: one is the mean square, the last ones near the largest.
EXPONENTS = {"h2": (1,), "hinf": (4, 16, 64, 256, 1024)}
#: Steps of the search for each exponent.
STEPS = 150
#: A search begins at so many of the truncations, the best ones.
STARTS = 2
#: A start without all states gets others: their mode per sample, and how they are driven.
ADDED_STATE, ADDED_LINK = 0.3, 1e-2
#: The logarithm of the norm of a model that is not stable: far above that of any gain.
UNSTABLE = 1e6


class Target(NamedTuple):
    """Where a model is weighed: points and their shares, weights, what it is shown and what it shall be.

    ``discrete``: points of the circle, else of the axis in units of a rate near those of the model; ``direct``:
    whether D is free.
    """

    points: ComplexArray
    shares: FloatArray
    left_weight: ComplexArray
    shown: ComplexArray
    target: ComplexArray
    discrete: bool
    direct: bool


def truncations(model: Model, order: int, target: Target) -> list[Model]:
    """Return stable models of at most ``order`` states: truncated plainly, by the weights, and by one of them."""
    plain = plainly_truncated(model, order, discrete=target.discrete)
    driven, read = _weighted_factors(model, target)
    own = _factors(model, discrete=target.discrete)
    pairs = ((driven, own[1]), (driven, read), (own[0], read))
    models: list[Model | None] = [plain, *(_projected(model, *pair, order) for pair in pairs)]
    if target.direct:
        models += [_residualised(model, *pair, order, discrete=target.discrete) for pair in (own, (driven, own[1]))]
    return [one for one in models if one is not None and is_stable(one, discrete=target.discrete)]


def plainly_truncated(model: Model, order: int, *, discrete: bool) -> Model:
    """Return a stable model's balanced truncation; of all states that which is left without those of rounding."""
    return _projected(model, *_factors(model, discrete=discrete), order)


def searched(starts: Sequence[Model], order: int, target: Target, norm: str) -> list[Model]:
    """Return the models that searches from the best of some starts end in, those on the way too, the best first."""
    ranked = sorted(starts, key=lambda one: weighed(one, target, norm))
    found: list[Model] = []
    for start in ranked[:STARTS]:
        model = _with_states(start, order, discrete=target.discrete)
        for exponent in EXPONENTS[norm]:
            model = _improved(model, target, exponent)
            found.append(model)
    return sorted(found, key=lambda one: weighed(one, target, norm))


def is_stable(model: Model, *, discrete: bool) -> bool:
    """Whether all modes decay, with some room."""
    if not all(np.all(np.isfinite(part)) for part in model):
        return False
    modes = np.linalg.eigvals(model[0])
    return bool(np.all(np.abs(modes) < STABLE_RADIUS) if discrete else np.all(modes.real < STABLE_RADIUS - 1.0))


def weighed(model: Model, target: Target, norm: str) -> float:
    """Return the norm of the weighted error at the points."""
    values = np.linalg.svd(_errors(target, response(*model, target.points)), compute_uv=False)
    if norm == "hinf":
        return float(np.max(values, initial=0.0))
    return float(np.sqrt(np.sum(target.shares[:, None] * values**2)))


def _errors(target: Target, responses: ComplexArray) -> ComplexArray:
    return np.asarray(target.left_weight @ (responses @ target.shown - target.target))


def _factors(model: Model, *, discrete: bool) -> tuple[FloatArray, FloatArray]:
    """Return factors of both Gramians, which the Cayley transform leaves as they are."""
    a, b, c, _ = model if discrete else cayley(*model, 1.0)
    return gramian_factor(a, b), gramian_factor(a.T, c.T)


def _weighted_factors(model: Model, target: Target) -> tuple[FloatArray, FloatArray]:
    """Return factors of the Gramians of the states between the weights, by sums over the points."""
    a, b, c, _ = model
    inverse = np.linalg.inv(target.points[:, None, None] * np.eye(len(a)) - a)
    roots = np.sqrt(target.shares)[:, None, None]
    driven = roots * (inverse @ b @ target.shown)
    read = roots * (target.left_weight @ c @ inverse)

    def factor(columns: ComplexArray) -> FloatArray:
        whole = np.concatenate(list(columns), axis=1)
        rows = np.hstack([whole.real, whole.imag]).T
        return np.asarray(np.linalg.qr(rows, mode="r")).T

    return factor(driven), factor(np.swapaxes(read, 1, 2))


def _balancing(driven: FloatArray, read: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return ``into (k, n)`` and ``out (n, k)``: balanced states, the largest first, without those of rounding."""
    left, values, right = np.linalg.svd(read.T @ driven, full_matrices=False)
    own = values > HANKEL_SHARE * np.max(values, initial=0.0)
    roots = np.sqrt(values[own])
    return (read @ left[:, own] / roots).T, driven @ right[own].T / roots


def _projected(model: Model, driven: FloatArray, read: FloatArray, order: int) -> Model:
    a, b, c, d = model
    into, out = _balancing(driven, read)
    into, out = into[:order], out[:, :order]
    return into @ a @ out, into @ b, c @ out, d


def _residualised(model: Model, driven: FloatArray, read: FloatArray, order: int, *, discrete: bool) -> Model | None:
    """Return a model whose last balanced states are always where slow signals leave them; ``None`` for none such."""
    a, b, c, d = model
    into, out = _balancing(driven, read)
    a, b, c = into @ a @ out, into @ b, c @ out
    kept, left = slice(None, order), slice(order, None)
    still = (np.eye(len(a)) if discrete else np.zeros_like(a)) - a
    try:
        answer = np.linalg.solve(still[left, left], np.hstack([a[left, kept], b[left]]))
    except np.linalg.LinAlgError:
        return None
    states, inputs = np.split(answer, [min(order, len(a))], axis=1)
    return (
        a[kept, kept] + a[kept, left] @ states,
        b[kept] + a[kept, left] @ inputs,
        c[:, kept] + c[:, left] @ states,
        d + c[:, left] @ inputs,
    )


def _with_states(model: Model, order: int, *, discrete: bool) -> Model:
    """Return a model with as many states: the others are hardly driven, and not read yet."""
    a, b, c, d = model
    more = order - len(a)
    if more <= 0:
        return model
    added = np.full(more, ADDED_STATE if discrete else -1.0)
    links = np.full((more, b.shape[1]), ADDED_LINK)
    return (
        scipy.linalg.block_diag(a, np.diag(added)),
        np.vstack([b, links]),
        np.hstack([c, np.zeros((len(c), more))]),
        d,
    )


def _improved(model: Model, target: Target, exponent: int) -> Model:
    """Return what is found from a stable model for one exponent."""
    from scipy.optimize import minimize

    shapes = [part.shape for part in model]
    ends = np.cumsum([part.size for part in model])[:-1]
    free = np.ones(sum(part.size for part in model), dtype=bool)
    free[ends[-1] :] = target.direct
    whole = np.concatenate([part.ravel() for part in model])

    def parts(t: FloatArray) -> Model:
        numbers = whole.copy()
        numbers[free] = t
        a, b, c, d = (part.reshape(shape) for part, shape in zip(np.split(numbers, ends), shapes, strict=True))
        return a, b, c, d

    def measured(t: FloatArray) -> tuple[float, FloatArray]:
        value, gradient = _logarithm(parts(t), target, exponent)
        return value, gradient[free]

    minimum = minimize(measured, whole[free], jac=True, method="BFGS", options={"maxiter": STEPS})
    return parts(minimum.x) if np.isfinite(minimum.fun) and minimum.fun < UNSTABLE else model


def _logarithm(model: Model, target: Target, exponent: int) -> tuple[float, FloatArray]:
    """Return the logarithm of ``(sum of (singular values)^2q)^(1/2q)`` and its gradient; large where not stable."""
    a, b, c, d = model
    if not is_stable(model, discrete=target.discrete):
        return UNSTABLE, np.zeros(sum(part.size for part in model))
    inverse = np.linalg.inv(target.points[:, None, None] * np.eye(len(a)) - a)
    driven, read = inverse @ b, c @ inverse
    errors = _errors(target, c @ driven + d)
    squares, vectors = np.linalg.eigh(errors @ np.conj(np.swapaxes(errors, 1, 2)))
    largest = float(np.max(squares, initial=0.0))
    if largest <= SMALLEST:  # nothing is left to be made smaller
        return 0.5 * float(np.log(SMALLEST)), np.zeros(sum(part.size for part in model))
    squares = np.maximum(squares / largest, 0.0)
    total = max(float(np.sum(target.shares[:, None] * squares**exponent)), SMALLEST)
    slopes = target.shares[:, None] * squares ** (exponent - 1) / (total * largest)
    of_errors = (vectors * slopes[:, None, :]) @ np.conj(np.swapaxes(vectors, 1, 2)) @ errors
    # Of what changes by Re sum conj(G) dF, F = C (p - A)^-1 B + D.
    turned = np.conj(np.swapaxes(target.left_weight, 1, 2))
    of_model = turned @ of_errors @ np.conj(np.swapaxes(target.shown, 1, 2))
    back, forward = np.conj(np.swapaxes(read, 1, 2)) @ of_model, np.conj(np.swapaxes(driven, 1, 2))
    slopes_of = (back @ forward, back, of_model @ forward, of_model)
    gradient = np.concatenate([np.sum(part.real, axis=0).ravel() for part in slopes_of])
    return float(np.log(total) / (2 * exponent) + 0.5 * np.log(largest)), gradient

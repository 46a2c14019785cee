"""Filters of low order as left fractions: ``D(q) ehat_k = N(q) y_k`` in the backward shift q.

Every filter whose state follows the plant's has a left fraction whose row degrees add up to its order, and each row
``(N, D)`` lies in the left kernel of a window of the plant: it sees neither the state before the window, nor faults,
nor unknown inputs.  The least order is therefore a matter of linear algebra; what the rows leave open is chosen for the
error, by a search that ends in a local minimum.  Source: ours; row degrees of left fractions: T. Kailath, *Linear
Systems*, 1980, section 6.3; minimal bases in fault estimation: A. Varga, *Solving Fault Diagnosis Problems*, 2017.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy.linalg

from obsynth.numerics.arrays import SMALLEST, ComplexArray, FloatArray
from obsynth.numerics.decoupling_windows import Model, stacked
from obsynth.numerics.least_estimation import STABLE_RADIUS
from obsynth.numerics.ranks import WINDOW_RANK_TOLERANCE

#: The newest coefficients of D count as independent beyond this share: rows of a kernel's basis have norm one.
INDEPENDENT_SHARE = 1e-6
#: Exponents of the norm of all singular values at all angles: one is the mean square, the last ones near the largest.
EXPONENTS = {"h2": (1,), "hinf": (1, 4, 16, 64, 256, 1024)}
#: Steps of the search for each exponent, and on each circle for a stable fraction to begin with.
STEPS, STEPS_TO_STABLE = 150, 30
#: An unstable fraction is made smaller on circles that are this much outside its modes, so often.
OUTSIDE, MOST_CIRCLES = 1.05, 30
#: The logarithm of the norm of a fraction that is not stable: far above that of any gain.
UNSTABLE = 1e6
#: What the squares of the coefficients count beside those of the error where a search begins.
RIDGE = 1e-9

#: Entries of a filter that are smaller, of the largest of their matrix, are rounding of the kernels.
ROUNDING_SHARE = 1e-13


@dataclass(frozen=True, eq=False)
class FractionProblem:
    """``x+ = A x + Bh h + Bw w``, ``Y = C x + Dh h + Dw w``: h is what no row sees, w drives the error.

    ``C, Dh, Dw``: ``ny`` outputs of the plant, below them the ``rows`` of what is estimated where that is exact.
    The first ``own`` states are not seen at the oldest sample that is read, the others ``spare`` samples earlier: what
    is late by then drives nothing.  ``ends``: whether the error vanishes at z = -1 (infinite frequency of continuous
    time, for a finite mean square).
    """

    A: FloatArray
    C: FloatArray
    Bh: FloatArray
    Dh: FloatArray
    Bw: FloatArray
    Dw: FloatArray
    ny: int
    rows: int
    exact: bool
    own: int
    spare: int
    ends: bool

    @property
    def width(self) -> int:
        """Coefficients of a row for each sample: those of y, and those of the estimates."""
        return self.ny + self.rows


class Criterion(NamedTuple):
    """Where the error ``left_weight @ (response - target) @ right_weight`` is weighed: angles and their shares."""

    angles: FloatArray
    shares: FloatArray
    left_weight: ComplexArray
    right_weight: ComplexArray
    target: ComplexArray


class _Row(NamedTuple):
    """Coefficients ``first + free @ t`` of one row, oldest sample first; ``driven``: what w adds at each sample."""

    first: FloatArray
    free: FloatArray
    driven: FloatArray
    degree: int


def least_degrees(problem: FractionProblem, most: int) -> tuple[int, ...] | None:
    """Return the least row degrees of a left fraction, their sum no more than ``most``; ``None`` where it is more.

    No filter whose state follows the plant's has fewer states than their sum: rows of degree up to k have newest
    coefficients of D in a space that grows with k, and any of full rank takes at least these degrees.
    """
    degrees: list[int] = []
    for degree in range(most + 1):
        newest = _kernel(problem, degree)[-problem.rows :]
        rank = int(np.sum(np.linalg.svd(newest, compute_uv=False) > INDEPENDENT_SHARE)) if newest.size else 0
        degrees += [degree] * (rank - len(degrees))
        if sum(degrees) + (problem.rows - len(degrees)) * (degree + 1) > most and len(degrees) < problem.rows:
            return None
        if len(degrees) == problem.rows:
            return tuple(degrees) if sum(degrees) <= most else None
    return None


def best_fraction(
    problem: FractionProblem, degrees: Sequence[int], criterion: Criterion, norm: str
) -> tuple[Model, float] | None:
    """Return a filter ``(A, B, C, D)`` from y with these row degrees, and its norm at the angles; ``None`` for none.

    Its norm is a local minimum over all stable fractions of these degrees.
    """
    rows = _rows(problem, degrees)
    if rows is None:
        return None
    stable = [t for start in _starts(problem, rows) if (t := _stabilised(problem, rows, start)) is not None]
    if not stable:
        return None
    first, *more = EXPONENTS[norm]
    searched = [_searched(problem, rows, criterion, t, first) for t in stable]
    tried = [*stable, min(searched, key=lambda t: _norm(problem, rows, criterion, t, "h2"))]
    for exponent in more:
        tried.append(_searched(problem, rows, criterion, tried[-1], exponent))
    sizes = [_norm(problem, rows, criterion, t, norm) for t in tried]
    best = int(np.argmin(sizes))
    return _realised(problem, rows, tried[best]), sizes[best]


def is_stabilised(problem: FractionProblem, degrees: Sequence[int]) -> bool:
    """Whether a stable left fraction with these row degrees is found."""
    rows = _rows(problem, degrees)
    return rows is not None and any(_stabilised(problem, rows, start) is not None for start in _starts(problem, rows))


def _searched(
    problem: FractionProblem, rows: Sequence[_Row], criterion: Criterion, t: FloatArray, exponent: int
) -> FloatArray:
    """Return what is found from a stable fraction for one exponent."""
    from scipy.optimize import minimize

    if not len(t):
        return t
    minimum = minimize(
        lambda t: _logarithm(problem, rows, criterion, t, exponent),
        t,
        jac=True,
        method="BFGS",
        options={"maxiter": STEPS},
    )
    return np.asarray(minimum.x) if np.isfinite(minimum.fun) and minimum.fun < UNSTABLE else t


def _kernel(problem: FractionProblem, degree: int) -> FloatArray:
    """Return columns, an orthonormal basis of the rows of a degree that see no state before the window and no h."""
    length, height = degree + problem.spare, len(problem.C)
    powers = [problem.C]
    for _ in range(length):
        powers.append(powers[-1] @ problem.A)
    states = np.vstack(powers[problem.spare :])
    states[:, : problem.own] = np.vstack(powers[: degree + 1])[:, : problem.own]
    left_vectors, values, _ = np.linalg.svd(states, full_matrices=False)
    states = left_vectors[:, values > WINDOW_RANK_TOLERANCE * max(float(np.max(values, initial=0.0)), SMALLEST)]
    hidden = stacked(problem.A, problem.C, problem.Bh, problem.Dh, length)[problem.spare * height :]
    hidden = hidden / max(float(np.linalg.norm(hidden)), SMALLEST)
    conditions = [states, hidden]
    if problem.ends:
        driven = _driven(problem, degree)
        signs = (-1.0) ** np.arange(driven.shape[1])
        at_end = np.einsum("itw,t->iw", driven, signs)
        conditions.append(at_end / max(float(np.linalg.norm(at_end)), SMALLEST))
    seen = np.hstack(conditions)
    if not problem.exact:
        # What is estimated is no output: its coefficients are free.
        whole = np.zeros((degree + 1, problem.width, seen.shape[1]))
        whole[:, : problem.ny] = seen.reshape(degree + 1, problem.ny, -1)
        seen = whole.reshape(-1, seen.shape[1])
    if not seen.shape[1]:
        return np.eye(len(seen))
    return np.asarray(scipy.linalg.null_space(seen.T, rcond=WINDOW_RANK_TOLERANCE))


def _driven(problem: FractionProblem, degree: int) -> FloatArray:
    """Return ``(coefficients, samples, nw)``: what each output that is read shows of w, oldest sample first."""
    length, height = degree + problem.spare, len(problem.C)
    whole = stacked(problem.A, problem.C, problem.Bw, problem.Dw, length)[problem.spare * height :]
    return whole.reshape(len(whole), length + 1, problem.Bw.shape[1])


def _rows(problem: FractionProblem, degrees: Sequence[int]) -> list[_Row] | None:
    """Return rows of these degrees, whose newest coefficients of D are one in directions at right angles."""
    taken = np.zeros((problem.rows, 0))
    rows: list[_Row] = []
    for degree in degrees:
        basis = _kernel(problem, degree)
        newest = basis[-problem.rows :]
        left_vectors, values, _ = np.linalg.svd(newest - taken @ (taken.T @ newest), full_matrices=False)
        if not len(values) or values[0] <= INDEPENDENT_SHARE:
            return None
        direction = left_vectors[:, 0]
        share = direction @ newest
        first = basis @ (share / (share @ share))
        free = basis @ scipy.linalg.null_space(share[None, :])
        driven = _driven(problem, degree)
        if not problem.exact:
            whole = np.zeros((degree + 1, problem.width, *driven.shape[1:]))
            whole[:, : problem.ny] = driven.reshape(degree + 1, problem.ny, *driven.shape[1:])
            driven = whole.reshape(-1, *driven.shape[1:])
        rows.append(_Row(first, free, driven, degree))
        taken = np.hstack([taken, direction[:, None]])
    return rows


def _coefficients(problem: FractionProblem, rows: Sequence[_Row], t: FloatArray) -> list[FloatArray]:
    """Return the coefficients of each row, ``(degree + 1, width)``, oldest sample first."""
    ends = np.cumsum([row.free.shape[1] for row in rows])[:-1]
    return [
        (row.first + row.free @ part).reshape(row.degree + 1, problem.width)
        for row, part in zip(rows, np.split(t, ends), strict=True)
    ]


def _realised(problem: FractionProblem, rows: Sequence[_Row], t: FloatArray) -> Model:
    """Return the fraction in observer form: a chain of as many states as its degree for each row."""
    ny, parts = problem.ny, _coefficients(problem, rows, t)
    newest = np.array([part[-1, ny:] for part in parts])
    # D ehat = -N y: both are in the kernel together.
    direct = -np.linalg.solve(newest, np.array([part[-1, :ny] for part in parts]))
    order = sum(row.degree for row in rows)
    A, B, heads = np.zeros((order, order)), np.zeros((order, ny)), np.zeros((len(rows), order))
    place = 0
    for i, row in enumerate(rows):
        if row.degree:
            heads[i, place] = 1.0
        place += row.degree
    C = np.linalg.solve(newest, heads)
    place = 0
    for row, part in zip(rows, parts, strict=True):
        own = slice(place, place + row.degree)
        older = part[:-1][::-1]  # one sample old first
        A[own, own] = np.eye(row.degree, k=1)
        A[own] -= older[:, ny:] @ C
        B[own] = -older[:, :ny] - older[:, ny:] @ direct
        place += row.degree
    return _cleaned(A), _cleaned(B), _cleaned(C), _cleaned(direct)


def _cleaned(matrix: FloatArray) -> FloatArray:
    return np.where(np.abs(matrix) > ROUNDING_SHARE * np.max(np.abs(matrix), initial=0.0), matrix, 0.0)


def _radius(problem: FractionProblem, rows: Sequence[_Row], t: FloatArray) -> float:
    try:
        return float(np.max(np.abs(np.linalg.eigvals(_realised(problem, rows, t)[0])), initial=0.0))
    except np.linalg.LinAlgError:
        return np.inf


def _starts(problem: FractionProblem, rows: Sequence[_Row]) -> list[FloatArray]:
    """Return two starts: the fraction nearest to one of finite response, and the one of least ``D error``."""
    nearest, smallest = [], []
    for row in rows:
        older = np.arange(row.degree * problem.width) % problem.width >= problem.ny
        place = np.flatnonzero(older)
        if not row.free.shape[1]:
            continue
        nearest.append(np.linalg.lstsq(row.free[place], -row.first[place], rcond=None)[0])
        free, first = (np.tensordot(part.T, row.driven, 1) for part in (row.free, row.first[:, None]))
        ridge = np.sqrt(RIDGE) * max(float(np.linalg.norm(free)), SMALLEST)
        system = np.vstack([free.reshape(len(free), -1).T, ridge * row.free])
        wanted = np.concatenate([first.ravel(), ridge * row.first])
        smallest.append(np.linalg.lstsq(system, -wanted, rcond=None)[0])
    return [np.concatenate([np.zeros(0), *parts]) for parts in (nearest, smallest)]


def _stabilised(problem: FractionProblem, rows: Sequence[_Row], t: FloatArray) -> FloatArray | None:
    """Return a stable fraction: the inverse of D is made small on circles around its modes, until these are inside."""
    from scipy.optimize import minimize

    radius = _radius(problem, rows, t)
    for _ in range(MOST_CIRCLES):
        if radius < STABLE_RADIUS:
            return t
        if not len(t) or not np.isfinite(radius):
            return None
        minimum = minimize(
            lambda t, outside=OUTSIDE * radius: _inverse_size(problem, rows, t, outside),
            t,
            jac=True,
            method="BFGS",
            options={"maxiter": STEPS_TO_STABLE},
        )
        smaller = _radius(problem, rows, minimum.x)
        if smaller >= radius:
            return None
        t, radius = minimum.x, smaller
    return None


def _inverse_size(
    problem: FractionProblem, rows: Sequence[_Row], t: FloatArray, circle: float
) -> tuple[float, FloatArray]:
    """Return the logarithm of the norm of ``D^-1`` on a circle that has all modes inside, and its gradient."""
    if _radius(problem, rows, t) >= circle:
        return UNSTABLE, np.zeros_like(t)
    count = 8 * (sum(row.degree for row in rows) + 1)
    points = circle * np.exp(1j * (np.arange(count) + 0.5) * np.pi / count)
    inverse = np.linalg.inv(_denominators(problem, rows, t, points))
    size = float(np.linalg.norm(inverse))
    # d |D^-1|^2 = -2 Re tr(D^-H D^-1 dD D^-1) summed over the points.
    turned = np.conj(np.swapaxes(inverse, 1, 2))
    weight = -turned @ inverse @ turned / size**2
    return float(np.log(size)), _gradient(problem, rows, points, None, weight)


def _denominators(problem: FractionProblem, rows: Sequence[_Row], t: FloatArray, points: ComplexArray) -> ComplexArray:
    parts = _coefficients(problem, rows, t)
    denominators = np.zeros((len(points), len(rows), problem.rows), dtype=complex)
    for i, part in enumerate(parts):
        denominators[:, i] = _delays(points, len(part)) @ part[:, problem.ny :]
    return denominators


def _delays(points: ComplexArray, count: int) -> ComplexArray:
    """Return ``z^-k`` of samples, the oldest first."""
    return np.asarray(points[:, None] ** -np.arange(count - 1.0, -1.0, -1.0))


def _gradient(
    problem: FractionProblem,
    rows: Sequence[_Row],
    points: ComplexArray,
    of_driven: ComplexArray | None,
    of_denominator: ComplexArray,
) -> FloatArray:
    """Return the gradient in t of what changes by ``Re sum conj(G) dM + conj(H) dD``, entry by entry."""
    parts = []
    for i, row in enumerate(rows):
        width, count = problem.width, row.degree + 1
        own = np.zeros((count, width))
        own[:, problem.ny :] = np.real(np.conj(_delays(points, count)).T @ of_denominator[:, i])
        whole = own.ravel()
        if of_driven is not None:
            samples = np.real(np.conj(_delays(points, row.driven.shape[1])).T @ of_driven[:, i])
            whole = whole + np.tensordot(row.driven, samples, 2)
        parts.append(row.free.T @ whole)
    return np.concatenate(parts)


def _errors(
    problem: FractionProblem, rows: Sequence[_Row], criterion: Criterion, t: FloatArray
) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
    """Return the weighted errors at the angles, ``D^-1`` and ``D^-1 M``."""
    points = np.exp(1j * criterion.angles)
    parts = _coefficients(problem, rows, t)
    driven = np.zeros((len(points), len(rows), problem.Bw.shape[1]), dtype=complex)
    for i, (row, part) in enumerate(zip(rows, parts, strict=True)):
        samples = np.tensordot(part.ravel(), row.driven, 1)
        driven[:, i] = _delays(points, len(samples)) @ samples
    inverse = np.linalg.inv(_denominators(problem, rows, t, points))
    response = inverse @ driven
    # The rows' sum is zero, not the error: what is estimated is minus that of y, from which the target is taken.
    errors = criterion.left_weight @ (-response - criterion.target) @ criterion.right_weight
    return np.asarray(errors), np.asarray(inverse), np.asarray(response)


def _logarithm(
    problem: FractionProblem, rows: Sequence[_Row], criterion: Criterion, t: FloatArray, exponent: int
) -> tuple[float, FloatArray]:
    """Return the logarithm of ``(sum of (singular values)^2q)^(1/2q)`` and its gradient; large where not stable."""
    if _radius(problem, rows, t) >= STABLE_RADIUS:
        return UNSTABLE, np.zeros_like(t)
    errors, inverse, response = _errors(problem, rows, criterion, t)
    squares, vectors = np.linalg.eigh(errors @ np.conj(np.swapaxes(errors, 1, 2)))
    largest = float(np.max(squares, initial=0.0))
    if largest <= SMALLEST:  # nothing is left to be made smaller
        return 0.5 * float(np.log(SMALLEST)), np.zeros_like(t)
    squares = np.maximum(squares / largest, 0.0)
    total = max(float(np.sum(criterion.shares[:, None] * squares**exponent)), SMALLEST)
    slopes = criterion.shares[:, None] * squares ** (exponent - 1) / (total * largest)
    of_errors = (vectors * slopes[:, None, :]) @ np.conj(np.swapaxes(vectors, 1, 2)) @ errors
    turned = np.conj(np.swapaxes(criterion.left_weight @ inverse, 1, 2))
    of_driven = -turned @ of_errors @ np.conj(np.swapaxes(criterion.right_weight, 1, 2))
    of_denominator = -of_driven @ np.conj(np.swapaxes(response, 1, 2))
    points = np.exp(1j * criterion.angles)
    return (
        float(np.log(total) / (2 * exponent) + 0.5 * np.log(largest)),
        _gradient(problem, rows, points, of_driven, of_denominator),
    )


def _norm(problem: FractionProblem, rows: Sequence[_Row], criterion: Criterion, t: FloatArray, norm: str) -> float:
    values = np.linalg.svd(_errors(problem, rows, criterion, t)[0], compute_uv=False)
    if norm == "hinf":
        return float(np.max(values, initial=0.0))
    return float(np.sqrt(np.sum(criterion.shares[:, None] * values**2)))

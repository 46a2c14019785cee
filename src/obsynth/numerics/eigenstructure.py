"""Pole placement by a Sylvester equation, with repeated poles of any multiplicity.

Let L be a real Jordan form of the poles, and G any matrix.  If ``F' X - X L = C' G``, then ``K = (G X^{-1})'`` gives
``spectrum(F - K C) = spectrum(L)`` (S. P. Bhattacharyya, E. de Souza, Systems & Control Letters 1, 1982).  L-BFGS
chooses G; one adjoint equation gives its gradient.  A repeated pole gets one Jordan chain, which every observable pair
allows.  scipy and python-control demand as many eigenvectors as the multiplicity: they refuse, or return other poles
without a warning (an error of 4.3 on the example of the paper).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from obsynth.errors import SolverError
from obsynth.numerics.arrays import SMALLEST, FloatArray, largest_singular_value
from obsynth.numerics.placed_noise import PlacedNoise
from obsynth.numerics.spectra import SAME_POLE, spectrum_error

#: Random starts of the search, and fewer for pairs with more than LARGE_PAIR states: each step of the search solves
#: two Sylvester equations.
STARTS, FEW_STARTS, LARGE_PAIR = 8, 2, 20

#: Most L-BFGS steps of one run, and most runs.  Each run continues from the end of the last one with eigenvectors of
#: unit length, as long as the logarithm of the objective falls by more than LEAST_PROGRESS.
MOST_PLACEMENT_STEPS, RESTARTS, LEAST_PROGRESS = 400, 8, 1e-3

#: Steps after which the starts of a search for good conditioning are compared, and how many of the best are continued.
FIRST_SEARCH_STEPS, FINALISTS = 40, 3

#: Steps of the search for less noise, and the weight of the logarithm of the squared condition in its objective.
NOISE_SEARCH_STEPS, CONDITION_SHARE = 200, 0.05

#: The search for less noise may worsen the condition of the eigenvectors by at most this factor.
MOST_CONDITION = 30.0

#: Penalty weights of the squared logarithm by which the condition exceeds that limit, tried in turn until it holds.
EXCESS_WEIGHTS = (1.0, 30.0, 1000.0)

#: Significant binary digits of the searched matrices, in each entry and relative to the largest entry.  Plants in other
#: units have the same numbers to so many digits, so that a search of many steps ends at the same gains.
DIGITS, DIGITS_OF_LARGEST = 20, 30

#: Offset of binary exponents: entries are often powers of two, whose exponents rounding would otherwise decide.
OFF_THE_POWERS = 1e-3

#: Seed of the random starts: the same problem gives the same gains.
STARTS_SEED = 20240

#: Spectra of F and L closer than this, relative to the size of F, make the Sylvester equation nearly singular: F is
#: then shifted by a random gain first.
OVERLAP = 1e-3

#: Largest error of the placed poles, relative to their size.
PLACEMENT_TOLERANCE = 1e-5


def jordan_form(poles: Sequence[complex]) -> FloatArray:
    """Return the real Jordan form ``(n, n)`` with these eigenvalues: one chain for each group of equal poles."""
    upper = [pole for pole in poles if pole.imag >= 0.0]
    groups: list[list[complex]] = []
    for pole in sorted(upper, key=lambda value: (value.real, value.imag)):
        home = next((group for group in groups if abs(group[0] - pole) <= SAME_POLE * max(abs(pole), SMALLEST)), None)
        if home is not None and (pole.imag > 0.0) == (home[0].imag > 0.0):
            home.append(pole)
        else:
            groups.append([pole])
    result, start = np.zeros((len(poles), len(poles))), 0
    for group in groups:
        width = 2 if group[0].imag > 0.0 else 1
        link = max(abs(group[0]), 1.0)
        for place, pole in enumerate(group):
            at = slice(start, start + width)
            block = [[pole.real, pole.imag], [-pole.imag, pole.real]] if width == 2 else [[pole.real]]
            result[at, at] = block
            if place:
                result[start - width : start, at] = link * np.eye(width)
            start += width
    return result


def place(
    f: FloatArray,
    c: FloatArray,
    poles: Sequence[complex],
    *,
    dt: float = 0.0,
    objective: str = "conditioning",
    weight: FloatArray | None = None,
    noise: PlacedNoise | None = None,
) -> tuple[FloatArray, float]:
    """Return K ``(n, ny)`` such that ``F - K C`` has these poles, and the condition of its (generalised) eigenvectors.

    Parameters
    ----------
    f, c : FloatArray
        The pair ``(n, n)``, ``(ny, n)``.
    poles : sequence of complex
        Closed under conjugation, ``n`` of them.
    dt : float, optional
        Sample time in s, 0 for continuous time.
    objective : {"conditioning", "gain"}, optional
        What the freedom beside the poles is spent on: well-conditioned eigenvectors, or a small gain.
    weight : FloatArray, optional
        Weight ``(m, n)`` of the gain in the objective "gain".
    noise : PlacedNoise, optional
        From the best gain on, search for one with less noise; the condition of its eigenvectors grows at most by the
        factor `MOST_CONDITION`.
    """
    n, outputs = f.shape[0], c.shape[0]
    if n == 0:
        return np.zeros((0, outputs)), 1.0
    if outputs == 0:
        raise SolverError("No output is free of the unknown inputs: no gain moves these poles.")
    target, scale = jordan_form(poles), np.eye(n) if weight is None else weight
    searched_f, searched_c, searched_target = f, c, target
    if noise is not None:
        # Only the search uses rounded matrices: its result is turned into a gain with the exact ones.
        noise, searched_target = noise.rounded(_in_few_digits), _in_few_digits(target)
        searched_f, searched_c = noise.F, noise.C
    rng = np.random.default_rng(STARTS_SEED)
    size = max(largest_singular_value(searched_f), SMALLEST)
    distance = np.min(np.abs(np.linalg.eigvals(f)[:, None] - np.asarray(poles)[None, :]))
    first = np.zeros((n, outputs))
    if distance <= OVERLAP * size:
        first = rng.standard_normal((n, outputs)) * size / max(largest_singular_value(searched_c), SMALLEST)
    exact, problem = (
        _Sylvester.of((a - first @ b).T, b.T, values, first.T, objective, scale.T @ scale)
        for a, b, values in ((f, c, target), (searched_f, searched_c, searched_target))
    )
    best = _best_injection(problem, rng)
    if noise is not None and (quieter := problem.with_less_noise(best, noise)) is not None:
        x, gain = exact.solution(quieter)
        if spectrum_error(f - (first + gain.T) @ c, poles, dt) <= PLACEMENT_TOLERANCE:
            return first + gain.T, float(np.linalg.cond(x))
    x, gain = exact.solution(best)
    k = first + gain.T
    error = spectrum_error(f - k @ c, poles, dt)
    if not error <= PLACEMENT_TOLERANCE:
        raise SolverError(
            f"The poles could not be placed: they are wrong by {error:.2g} of their size. The pair is "
            "close to an unobservable one: ask for slower or fewer distinct poles, lower the order of the fault model, "
            "or use decay= instead."
        )
    return k, float(np.linalg.cond(x))


def _best_injection(problem: _Sylvester, rng: np.random.Generator) -> FloatArray:
    """Return the G with the least objective that searches from random starts reach."""
    n, outputs = problem.B.shape
    starts = [rng.standard_normal((outputs, n)) for _ in range(STARTS if n <= LARGE_PAIR else FEW_STARTS)]
    if problem.objective == "gain":
        # Well-conditioned eigenvectors are a good start for small gains.
        conditioned = replace(problem, objective="conditioning").minimised(starts[0])
        starts = starts if conditioned is None else [conditioned[1], *starts]
    else:
        # A few steps show which starts are worth a full search.  For small gains they do not.
        tried = [problem.minimised(start, steps=FIRST_SEARCH_STEPS, restarts=1) for start in starts]
        ahead = sorted((candidate for candidate in tried if candidate is not None), key=lambda candidate: candidate[0])
        starts = [start for _, start in ahead[:FINALISTS]]
    best: tuple[float, FloatArray] | None = None
    for start in starts:
        candidate = problem.minimised(start)
        if candidate is not None and (best is None or candidate[0] < best[0]):
            best = candidate
    if best is None:
        raise SolverError("No gain for these poles was found: the Sylvester equation stayed singular.")
    return best[1]


@dataclass(frozen=True, eq=False)
class _Sylvester:
    """The equation ``A X - X L = B G`` for many G, solved by one real Schur form of A; L is quasi-triangular.

    The objective is a function of G: the condition of X, or the norm of the gain ``G X^-1 + shift`` with weight
    ``gram``.
    """

    triangular: FloatArray
    rotation: FloatArray
    B: FloatArray
    L: FloatArray
    shift: FloatArray
    objective: str
    gram: FloatArray

    @classmethod
    def of(
        cls,
        a: FloatArray,
        b: FloatArray,
        target: FloatArray,
        shift: FloatArray,
        objective: str,
        gram: FloatArray,
    ) -> _Sylvester:
        from scipy.linalg import schur

        triangular, rotation = schur(a, output="real")
        return cls(triangular, rotation, b, target, shift, objective, gram)

    def states(self, g: FloatArray) -> FloatArray:
        from obsynth.numerics.lapack import dtrsyl

        right = self.rotation.T @ (self.B @ g)
        x, scale, _ = dtrsyl(self.triangular, self.L, right, isgn=-1)
        return np.asarray(self.rotation @ (x / scale))

    def adjoint(self, weight: FloatArray) -> FloatArray:
        """Return Y with ``A' Y - Y L' = weight``: the gradient of <weight, X> is ``B' Y``."""
        from obsynth.numerics.lapack import dtrsyl

        y, scale, _ = dtrsyl(self.triangular, self.L, self.rotation.T @ weight, trana="T", tranb="T", isgn=-1)
        return np.asarray(self.rotation @ (y / scale))

    def solution(self, g: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return X and the gain ``G X^-1``."""
        x = self.states(g)
        return x, np.asarray(np.linalg.solve(x.T, g.T).T)

    def value_and_gradient(self, flat: FloatArray) -> tuple[float, FloatArray]:
        """Return the logarithm of the objective at the entries of G, and its gradient."""
        g = flat.reshape(self.B.shape[1], -1)
        x = self.states(g)
        inverse = np.asarray(np.linalg.inv(x), dtype=np.float64)
        if self.objective == "gain":
            gain = g @ inverse
            total = gain + self.shift
            weighted = total @ self.gram
            value = float(np.sum(weighted * total))
            weight = -2.0 * gain.T @ weighted @ inverse.T
            direct = 2.0 * weighted @ inverse.T
        else:
            value, weight = _conditioning(x, inverse)
            direct = np.zeros_like(g)
        gradient = direct + self.B.T @ self.adjoint(weight)
        return float(np.log(value)), np.asarray(gradient / value).ravel()

    def with_less_noise(self, start: FloatArray, noise: PlacedNoise) -> FloatArray | None:
        """Return a G near ``start`` whose estimates have less noise, and whose X is at most `MOST_CONDITION` times as
        ill-conditioned; ``None`` where the search finds none."""
        g = self.normalised(start)
        try:
            x, gain = self.solution(start)
            limit = MOST_CONDITION * float(np.linalg.cond(x))
            variance, _ = noise.value_and_slope((gain + self.shift).T)
            for weight in EXCESS_WEIGHTS if 0.0 < variance < np.inf else ():
                evaluate = self._noise_and_condition(noise, variance, np.log(limit**2), weight)
                before, (after, quieter) = evaluate(g.ravel())[0], _minimised(evaluate, g, NOISE_SEARCH_STEPS)
                if not after < before:
                    return None
                if np.linalg.cond(self.states(quieter)) <= limit:
                    return quieter
        except np.linalg.LinAlgError:
            pass
        return None

    def _noise_and_condition(
        self, noise: PlacedNoise, reference: float, limit: float, weight: float
    ) -> Callable[[FloatArray], tuple[float, FloatArray]]:
        """Return a function of G whose values are an objective and its gradient: noise and condition of X, weighted.

        The objective is the logarithm of the variance relative to ``reference``, plus `CONDITION_SHARE` times the
        logarithm of the squared condition, plus ``weight`` times the squared excess of the latter over ``limit``.
        """

        def evaluate(flat: FloatArray) -> tuple[float, FloatArray]:
            g = flat.reshape(self.B.shape[1], -1)
            x = self.states(g)
            inverse = np.asarray(np.linalg.inv(x), dtype=np.float64)
            gain = g @ inverse
            value, slope = noise.value_and_slope((gain + self.shift).T)
            condition, of_condition = _conditioning(x, inverse)
            if not (value > 0.0 and np.isfinite(value)):
                return np.inf, np.zeros(g.size)
            excess = max(float(np.log(condition)) - limit, 0.0)
            share = CONDITION_SHARE + 2.0 * weight * excess
            of_states = -gain.T @ slope.T @ inverse.T / value + share * of_condition / condition
            gradient = slope.T @ inverse.T / value + self.B.T @ self.adjoint(of_states)
            counted = CONDITION_SHARE * np.log(condition) + weight * excess**2
            return float(np.log(value / reference) + counted), np.asarray(gradient).ravel()

        return evaluate

    def minimised(
        self, start: FloatArray, *, steps: int = MOST_PLACEMENT_STEPS, restarts: int = RESTARTS
    ) -> tuple[float, FloatArray] | None:
        """Return the least objective that L-BFGS reaches from a start, and its G; ``None`` if X is singular there."""
        best: tuple[float, FloatArray] | None = None
        g = start
        try:
            for _ in range(restarts):
                value, g = _minimised(self.value_and_gradient, self.normalised(g), steps)
                if not np.isfinite(value):
                    break
                gained = np.inf if best is None else best[0] - value
                if best is None or gained > 0.0:
                    best = (value, g)
                if gained < LEAST_PROGRESS:
                    break
        except np.linalg.LinAlgError:
            return best
        return best

    def normalised(self, g: FloatArray) -> FloatArray:
        """Return G with each Jordan chain scaled so that its part of X has unit size; the gain stays the same."""
        lengths = np.linalg.norm(self.states(g), axis=0)
        linked = (self.L != 0.0) | (self.L.T != 0.0) | np.eye(len(self.L), dtype=bool)
        for _ in range(len(self.L).bit_length()):
            linked = (linked.astype(float) @ linked.astype(float)) > 0.0
        chains = np.array([np.max(lengths[row]) for row in linked])
        return np.asarray(g / np.where(chains > 0.0, chains, 1.0))


def _minimised(evaluate: Callable[[FloatArray], Any], start: FloatArray, steps: int) -> tuple[float, FloatArray]:
    """Return the least value that L-BFGS reaches from a start, and its argument."""
    from scipy.optimize import minimize

    with np.errstate(all="ignore"):
        done = minimize(evaluate, start.ravel(), jac=True, method="L-BFGS-B", options={"maxiter": steps})
    return float(done.fun), np.asarray(done.x).reshape(start.shape)


def _in_few_digits(matrix: FloatArray) -> FloatArray:
    """Return a matrix rounded to so few binary digits that it is the same whatever the units of the data were."""
    largest = float(np.max(np.abs(matrix), initial=0.0))
    if largest == 0.0:
        return matrix
    sizes = np.where(matrix == 0.0, largest, np.abs(matrix))
    exponents = np.floor(np.log2(sizes) + OFF_THE_POWERS) - DIGITS
    steps = np.exp2(np.maximum(exponents, np.floor(np.log2(largest) + OFF_THE_POWERS) - DIGITS_OF_LARGEST))
    return np.asarray(steps * np.round(matrix / steps))


def _conditioning(x: FloatArray, inverse: FloatArray) -> tuple[float, FloatArray]:
    """Return the square of the condition in the Frobenius norm, and its gradient in X."""
    own, other = float(np.sum(x**2)), float(np.sum(inverse**2))
    return own * other, np.asarray(2.0 * other * x - 2.0 * own * inverse.T @ inverse @ inverse.T)

"""Pole placement by a Sylvester equation, with repeated poles of any multiplicity.

One Jordan chain for each repeated pole, which every observable pair allows: with L in real Jordan form and any G,
``F' X - X L = C' G``, ``K = (G X^{-1})'`` gives ``spectrum(F - K C) = spectrum(L)`` (S. P. Bhattacharyya, E. de Souza,
Systems & Control Letters 1, 1982); G by L-BFGS, its gradient by one adjoint equation.  scipy and python-control look
for as many eigenvectors as the multiplicity: they refuse, or miss poles without a word (error 4.3 for the paper's).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from obsynth.errors import SolverError, SpecError
from obsynth.numerics.arrays import SMALLEST, ComplexArray, FloatArray, largest_singular_value
from obsynth.numerics.placed_noise import PlacedNoise
from obsynth.numerics.spectra import SAME_POLE, decay_rates, pole_text, spectrum_error

#: Random starts of the search, and fewer for large pairs; each step costs two Sylvester equations.
STARTS, FEW_STARTS, LARGE_PAIR = 8, 2, 20

#: Longest run of the search, and how often it is taken up again from where it ended, with eigenvectors of unit length,
#: as long as the logarithm of the objective falls by more than this.
MOST_PLACEMENT_STEPS, RESTARTS, LEAST_PROGRESS = 400, 8, 1e-3

#: First steps of a search for good conditioning, and how many of the starts that are ahead after these go on.
FIRST_SEARCH_STEPS, FINALISTS = 40, 3

#: Steps of the search for less noise, and how much a condition that is e times as large counts, in its logarithm.
QUIETENING_STEPS, CONDITION_SHARE = 200, 0.05

#: Less noise costs at most this factor of the condition of the best conditioned eigenvectors.
MOST_CONDITION = 30.0

#: Weights of what a condition exceeds that by, squared and in its logarithm, one after the other until it is kept.
EXCESS_WEIGHTS = (1.0, 30.0, 1000.0)

#: Binary digits of the numbers that are searched with, of each entry and of the largest: those of a plant in other
#: units are the same, and so is what a search of many steps ends at.
DIGITS, DIGITS_OF_LARGEST = 20, 30

#: Entries are often powers of two, which rounding would count with those above or below by chance.
OFF_THE_POWERS = 1e-3

#: Seed of the starts: the same question gives the same gains.
STARTS_SEED = 20240

#: Spectra of F and L closer than this, relative to the size of F, make the Sylvester equation nearly singular: F is
#: then shifted by a random gain first.
OVERLAP = 1e-3

#: Computed poles may miss the wanted ones by this, relative to their size.
PLACEMENT_TOLERANCE = 1e-5


#: Poles given as numbers count as a conjugate pair when they agree to this, relative to their size.
PAIR_TOLERANCE = 1e-9

_POLES_OPTION = "method.options.poles"


def jordan_form(poles: Sequence[complex]) -> FloatArray:
    """Return a real cyclic matrix ``(n, n)`` with these eigenvalues: one chain for each group of equal poles."""
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
    """Return K ``(n, ny)`` such that ``F - K C`` has these poles, and the condition of the (generalised) eigenvectors;
    ``f (n, n)``, ``c (ny, n)``, ``weight (m, n)``.

    ``noise``: of these gains one near the best of the objective is taken that makes less of it; its eigenvectors have
    at most `MOST_CONDITION` times the condition.
    """
    n, outputs = f.shape[0], c.shape[0]
    if n == 0:
        return np.zeros((0, outputs)), 1.0
    if outputs == 0:
        raise SolverError("No output is free of the unknown inputs: no gain moves these poles.")
    target, scale = jordan_form(poles), np.eye(n) if weight is None else weight
    searched_f, searched_c, searched_target = f, c, target
    if noise is not None:
        # Only the search is in few digits: the gain of what it finds is that of the pair as it is.
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
    best: tuple[float, FloatArray] | None = None
    starts = [rng.standard_normal((outputs, n)) for _ in range(STARTS if n <= LARGE_PAIR else FEW_STARTS)]
    if objective == "gain":
        # Well-conditioned eigenvectors are a good place to start from.
        other = replace(problem, objective="conditioning").minimised(starts[0])
        starts = starts if other is None else [other[1], *starts]
    if objective == "conditioning":
        # All go a short way, and the best of them to the end.  Small gains are not predicted as early.
        tried = [problem.minimised(start, steps=FIRST_SEARCH_STEPS, restarts=1) for start in starts]
        ahead = sorted((candidate for candidate in tried if candidate is not None), key=lambda candidate: candidate[0])
        starts = [start for _, start in ahead[:FINALISTS]]
    for start in starts:
        candidate = problem.minimised(start)
        if candidate is not None and (best is None or candidate[0] < best[0]):
            best = candidate
    if best is None:
        raise SolverError("No gain for these poles was found: the Sylvester equation stayed singular.")
    if noise is not None and (quieter := problem.quieter(best[1], noise)) is not None:
        x, gain = exact.solution(quieter)
        if spectrum_error(f - (first + gain.T) @ c, poles, dt) <= PLACEMENT_TOLERANCE:
            return first + gain.T, float(np.linalg.cond(x))
    x, gain = exact.solution(best[1])
    k = first + gain.T
    error = spectrum_error(f - k @ c, poles, dt)
    if not error <= PLACEMENT_TOLERANCE:
        raise SolverError(
            f"The poles could not be placed: they are wrong by {error:.2g} of their size. The pair is "
            "close to an unobservable one: ask for slower or fewer distinct poles, lower the order of the fault model, "
            "or use decay= instead."
        )
    return k, float(np.linalg.cond(x))


@dataclass(frozen=True, eq=False)
class _Sylvester:
    """``A X - X L = B G`` for many G, by one Schur form of A; L is quasi-triangular already."""

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

    def quieter(self, start: FloatArray, noise: PlacedNoise) -> FloatArray | None:
        """Return a G near ``start`` whose gain makes less of the noise, with eigenvectors that are not much worse;
        ``None`` where none is found."""
        g = self.normalised(start)
        try:
            x, gain = self.solution(start)
            limit = MOST_CONDITION * float(np.linalg.cond(x))
            loudest, _ = noise.value_and_slope((gain + self.shift).T)
            for weight in EXCESS_WEIGHTS if 0.0 < loudest < np.inf else ():
                evaluate = self._noise_and_condition(noise, loudest, np.log(limit**2), weight)
                before, (after, found) = evaluate(g.ravel())[0], _minimised(evaluate, g, QUIETENING_STEPS)
                if not after < before:
                    return None
                if np.linalg.cond(self.states(found)) <= limit:
                    return found
        except np.linalg.LinAlgError:
            pass
        return None

    def _noise_and_condition(
        self, noise: PlacedNoise, loudest: float, limit: float, weight: float
    ) -> Callable[[FloatArray], tuple[float, FloatArray]]:
        """Return the logarithm of the noise, relative to ``loudest``, with what a condition counts beside it, and its
        slope, as a function of G; ``limit`` is of the logarithm of the condition's square."""

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
            return float(np.log(value / loudest) + counted), np.asarray(gradient).ravel()

        return evaluate

    def minimised(
        self, start: FloatArray, *, steps: int = MOST_PLACEMENT_STEPS, restarts: int = RESTARTS
    ) -> tuple[float, FloatArray] | None:
        """Return the least value found and its G; ``None`` when the equation is singular from the start."""
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
    """Return the least value that L-BFGS finds, and where."""
    from scipy.optimize import minimize

    with np.errstate(all="ignore"):
        done = minimize(evaluate, start.ravel(), jac=True, method="L-BFGS-B", options={"maxiter": steps})
    return float(done.fun), np.asarray(done.x).reshape(start.shape)


def _in_few_digits(matrix: FloatArray) -> FloatArray:
    """Return a matrix without the digits in which it may differ from one unit of the data to another."""
    largest = float(np.max(np.abs(matrix), initial=0.0))
    if largest == 0.0:
        return matrix
    sizes = np.where(matrix == 0.0, largest, np.abs(matrix))
    exponents = np.floor(np.log2(sizes) + OFF_THE_POWERS) - DIGITS
    steps = np.exp2(np.maximum(exponents, np.floor(np.log2(largest) + OFF_THE_POWERS) - DIGITS_OF_LARGEST))
    return np.asarray(steps * np.round(matrix / steps))


def _conditioning(x: FloatArray, inverse: FloatArray) -> tuple[float, FloatArray]:
    """Return the square of the condition in the Frobenius norm, and its slope in X."""
    own, other = float(np.sum(x**2)), float(np.sum(inverse**2))
    return own * other, np.asarray(2.0 * other * x - 2.0 * own * inverse.T @ inverse @ inverse.T)


def checked_poles(
    requested: Any, count: int, fixed: ComplexArray, dt: float, *, of: str = "ui-pi-observer"
) -> list[complex]:
    """Return the wanted poles, in exact conjugate pairs; ``of``: what they are for, in messages."""
    listed = [as_pole(pole) for pole in requested]
    problems = []
    if len(listed) != count:
        fixed_text = ", ".join(pole_text(complex(value), 6) for value in fixed)
        besides = f" (fixed, not to be listed: {fixed_text})" if fixed_text else ""
        number = f"{len(listed)} {'is' if len(listed) == 1 else 'are'} given"
        problems.append(f"{number}, but {count} can be placed{besides}.")
    rates = decay_rates(listed, dt)
    unstable = [pole for pole, rate in zip(listed, rates, strict=True) if not rate > 0.0]
    if unstable:
        where = "inside the unit circle" if dt > 0.0 else "in the left half plane"
        problems.append(
            f"{', '.join(pole_text(pole, 6) for pole in unstable)} would not be stable: give poles {where}."
        )
    upper = [pole for pole in listed if pole.imag > 0.0]
    lower = [pole for pole in listed if pole.imag < 0.0]
    lonely = []
    for pole in upper:
        partner = next((p for p in lower if abs(p - pole.conjugate()) <= PAIR_TOLERANCE * abs(pole)), None)
        if partner is None:
            lonely.append(pole)
        else:
            lower.remove(partner)
    lonely += lower
    if lonely:
        poles = ", ".join(pole_text(pole, 6) for pole in lonely)
        problems.append(f"{poles} {'lacks its conjugate' if len(lonely) == 1 else 'lack their conjugates'}.")
    if problems:
        raise SpecError(f"Option poles of {of}:", path=_POLES_OPTION, problems=problems)
    real = [pole for pole in listed if pole.imag == 0.0]
    return [*real, *(p for pole in upper for p in (pole, pole.conjugate()))]


def as_pole(pole: Any) -> complex:
    """Return a pole that is given as a number, or as its real and imaginary part."""
    parts = pole if isinstance(pole, (list, tuple, np.ndarray)) and len(pole) == 2 else [pole]
    try:
        value = complex(*parts)
    except (TypeError, ValueError):
        raise SpecError(f"{pole!r} is no pole: give a number, or [re, im].", path=_POLES_OPTION) from None
    if any(isinstance(part, (bool, np.bool_, str)) for part in parts) or not np.isfinite(value):
        raise SpecError(f"{pole!r} is no pole: give a finite number, or [re, im].", path=_POLES_OPTION)
    return value

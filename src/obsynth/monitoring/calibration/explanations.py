"""Explanations of innovations that are not white: an offset, correlated noise, a delay of an input, or one constant.

Each candidate is one regression of the innovations, in their own deviations.  Its gain in nats is that of the Gaussian
likelihood less half a logarithm of the number of rows for each coefficient (Schwarz 1978), so that candidates with
different numbers of coefficients compare.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TypeAlias

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.results.number_texts import duration

#: Gains below this are no explanation: three nats are one in twenty.
LEAST_EXPLANATION = 3.0

#: Explanations that are reported, and constants that are tried: each costs a run over the log.
MOST_LISTED, MOST_CONSTANTS = 3, 12

#: Inputs whose delays are tried.
MOST_INPUTS = 12

#: Relative change of a constant by which its effect on the innovations is found: small beside any error worth telling.
CONSTANT_CHANGE = 1e-3

#: What may be wrong, and the nats that it gains on this log.
Explanation: TypeAlias = tuple[str, float]


def explanations(
    innovations: FloatArray,
    inputs: FloatArray,
    output_names: Sequence[str],
    input_names: Sequence[str],
    *,
    dt: float,
    constants: Mapping[str, float],
    with_constant: Callable[[str, float], FloatArray],
    with_later_input: Callable[[int, int], FloatArray] | None = None,
) -> tuple[Explanation, ...]:
    """Return what explains innovations ``(n, ny)`` best, the largest gain first.

    ``with_constant(name, value)``: the innovations, in the same deviations, with another value of a constant; NaN where
    the plant has no solution with it.  The constants that are told have been run with the value that is told.
    ``with_later_input(i, rows)``: the innovations with an input later by so many rows, where a run takes no long time.
    """
    candidates, values = [*_of_sensors(innovations, output_names, dt)], dict[str, tuple[str, float]]()
    for i, name in enumerate(input_names[:MOST_INPUTS]):
        for rows, word in ((1, "later"), (-1, "earlier")):
            if with_later_input is not None:
                gain = _of_run(innovations, with_later_input(i, rows))
            else:
                gain = _of_moves(innovations, inputs[:, i], rows)
            candidates.append((f"an input {name} that acts {word} than the design takes it", gain))
    for name, value in list(constants.items())[:MOST_CONSTANTS]:
        step = CONSTANT_CHANGE * (abs(value) or 1.0)
        effect = (with_constant(name, value + step) - innovations) / step
        gain, coefficient = _regression(innovations, effect[:, :, None])
        nearer = value - float(coefficient[0]) if len(coefficient) else value
        text = f"a constant {name} near {nearer:.3g} instead of {value:.3g}"
        values[text] = (name, nearer)
        candidates.append((text, gain))
    clear = sorted((item for item in candidates if item[1] >= LEAST_EXPLANATION), key=lambda item: -item[1])
    tried = [
        (text, _of_run(innovations, with_constant(*values[text])) if text in values else gain)
        for text, gain in clear[:MOST_LISTED]
    ]
    return tuple(sorted((item for item in tried if item[1] >= LEAST_EXPLANATION), key=lambda item: -item[1]))


def _of_moves(innovations: FloatArray, values: FloatArray, rows: int) -> float:
    """Return the gain in nats of what an input that acts one row later, or earlier (-1), does to the first innovation
    after each of its moves."""
    moves = np.diff(values)
    move = np.append(np.nan, moves) if rows > 0 else np.append(moves, np.nan)
    return _regression(innovations, move[:, None, None] * np.eye(innovations.shape[1]))[0]


def _of_run(before: FloatArray, after: FloatArray) -> float:
    """Return the gain in nats that a run with another constant has: what its effect foretells holds near by only."""
    measured = np.isfinite(before) & np.isfinite(after)
    count, before_squares, after_squares = (
        int(measured.sum()),
        float((before[measured] ** 2).sum()),
        float((after[measured] ** 2).sum()),
    )
    if not after_squares > 0.0 or not before_squares > 0.0:
        return -np.inf
    return 0.5 * count * float(np.log(before_squares / after_squares)) - 0.5 * float(np.log(count))


def _of_sensors(innovations: FloatArray, names: Sequence[str], dt: float) -> list[Explanation]:
    candidates = []
    for j, name in enumerate(names):
        column = innovations[:, j : j + 1]
        gain, _ = _regression(column, np.ones((len(column), 1, 1)))
        candidates.append((f"an offset of the sensor {name}", gain))
        gain, first, _ = _regression_on_previous(column)
        if first > 0.0:
            seconds = -dt / float(np.log(min(first, 1.0 - 1.0 / len(column))))
            lasting = f" over about {duration(seconds, digits=2)}"
            candidates.append((f"noise of {name} that is correlated{lasting}", gain))
    return candidates


def _regression(innovations: FloatArray, regressors: FloatArray) -> tuple[float, FloatArray]:
    """Return the gain in nats of regressors ``(n, ny, p)``, and their coefficients; none where they do not move."""
    count = regressors.shape[2]
    y, x = innovations.ravel(), regressors.reshape(-1, count)
    complete = np.isfinite(y) & np.isfinite(x).all(axis=1)
    y, x = y[complete], x[complete]
    if len(y) <= count + 1 or not np.any(x):
        return -np.inf, np.zeros(0)
    coefficients: FloatArray = np.asarray(np.linalg.lstsq(x, y, rcond=None)[0], dtype=np.float64)
    residual_squares, squares = float(np.sum((y - x @ coefficients) ** 2)), float(y @ y)
    if not residual_squares > 0.0:
        return np.inf, coefficients
    return 0.5 * len(y) * float(np.log(squares / residual_squares)) - 0.5 * count * float(np.log(len(y))), coefficients


def regression_gain(column: FloatArray, others: Sequence[FloatArray], regressor: FloatArray) -> float:
    """Return what a regressor ``(n,)`` of innovations ``(n,)`` gains beside others, in nats."""
    x = np.column_stack([*others, regressor])
    complete = np.isfinite(column) & np.isfinite(x).all(axis=1)
    y, x = column[complete], x[complete]
    residual_squares = [
        float(np.sum((y - part @ np.linalg.lstsq(part, y, rcond=None)[0]) ** 2)) for part in (x[:, :-1], x)
    ]
    return 0.5 * len(y) * float(np.log(residual_squares[0] / residual_squares[1])) if residual_squares[1] > 0.0 else 0.0


def whitened(innovations: FloatArray) -> FloatArray:
    """Return innovations ``(n, ny)`` less what each column keeps of its sample before: a change of mean stays one."""
    white = np.array(innovations)
    for j in range(innovations.shape[1]):
        _, first, before = _regression_on_previous(innovations[:, j : j + 1])
        white[:, j] -= np.where(np.isfinite(before), first * before, 0.0)
    return white


def _regression_on_previous(column: FloatArray) -> tuple[float, float, FloatArray]:
    """Return the gain in nats of a column's ``(n, 1)`` own sample before, its coefficient, and that sample ``(n,)``."""
    before = np.append(np.nan, column[:-1, 0])
    gain, coefficient = _regression(column, before[:, None, None])
    return gain, float(coefficient[0]) if len(coefficient) else 0.0, before

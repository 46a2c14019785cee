"""Least gains and least deviations against filters of finite response, which convex programmes find.

Plants of 1 to 4 states (a third with an algebraic equation besides, in other coordinates), stable or not, one or two
faults, no or one decoupled disturbance, with noise on the outputs or none.  Windows of outputs that no state, no
decoupled disturbance and, for exact fault maps, no fault but the wanted one passes are a linear space, for unstable
plants as for others; over it the error's largest gain (points of the circle, Clarabel; then the true gain of what was
found) and its mean square (least squares) are minimised.  Nothing of the search is of the package.

Wrong: a filter below ``least``, one where the package says that none exists, and a gain that is not together with
``least`` (1e-4).  A design beside which no window has the fault map, as where the faults have a stable zero, is a
count.  The mean is that of the share by which the longest window is above ``least``.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import cvxpy as cp
import numpy as np
import scipy.linalg
from benchmarks.campaigns.frame import Outcome

import obsynth

CASES = 100
LIMIT = 120.0  # s
#: Samples of windows beyond the newest, and points of the half circle.
WINDOWS = {"hinf": (4, 9), "h2": (6, 20)}
POINTS, TRUE_POINTS = 48, 1500
#: Singular values of windows below this share are rounding; what moves the error by less than the second is left out,
#: as it would make something of rounding, and fault maps are kept to the third.
NOTHING, TOO_LITTLE, EXACT = 1e-12, 1e-4, 1e-7
BELOW, TOGETHER = 1e-6, 1e-4


def case(seed: int) -> Outcome:
    """Design one filter, and search windows of growing length."""
    rng = np.random.default_rng([47, 12, seed])
    plant = _plant(rng)
    norm, exact = ("hinf", "h2")[seed % 2], bool(rng.random() < 0.65)
    late = int(rng.integers(0 if np.any(plant.Df) else 1, 3))
    group = f"{norm}, {'exact' if exact else 'matching'}"
    options: dict[str, Any] = {"delay": late} if exact else {"exact": False, "reference": _late(late)}
    if plant.nd:
        options["decoupled"] = list(plant.disturbance_names)
    reached = [_least(plant, window, late, norm, exact=exact) for window in WINDOWS[norm]]
    found = [gain for gain in reached if gain is not None]
    grown = [(one, more) for one, more in pairwise(found) if more > one * (1.0 + TOGETHER) + EXACT]
    wrong = [f"a longer window reaches {more:.9g}, a shorter one {one:.9g}" for one, more in grown]
    try:
        design = obsynth.optimal_filter(plant, norm=norm, **options)
    except obsynth.PreconditionError:
        wrong += [f"none exists, and {found[-1]:.9g} is reached"] if found else []
        return Outcome(group, "no such filter", "; ".join(wrong))
    unit = max(design.gain, NOTHING)
    if design.gain - design.least > TOGETHER * unit and design.gain > BELOW:
        wrong.append(f"least {design.least:.9g}, gain {design.gain:.9g}")
    if not found:
        return Outcome(group, "no window", "; ".join(wrong))
    if min(found) < design.least * (1.0 - BELOW):
        wrong.append(f"{min(found):.9g} is reached, least {design.least:.9g}")
    share = found[-1] / design.least - 1.0 if design.least > BELOW else None
    return Outcome(group, "compared", "; ".join(wrong), share)


def _plant(rng: np.random.Generator) -> obsynth.DescriptorSystem:
    n, algebraic, nf, nd = (int(rng.integers(*ends)) for ends in ((1, 5), (0, 3), (1, 3), (0, 2)))
    algebraic //= 2
    size, ny, nw = n + algebraic, nf + nd + int(rng.integers(0, 2)), int(rng.integers(1, 3))
    a = rng.normal(size=(n, n))
    a *= rng.choice([0.5, 0.8, 1.2]) / np.max(np.abs(np.linalg.eigvals(a)))
    left, right = (np.eye(size) + 0.4 * rng.normal(size=(size, size)) for _ in range(2))
    sensors = np.zeros((ny, 0)) if rng.random() < 0.2 else 0.3 * np.diag(rng.uniform(0.3, 1.5, ny))
    return obsynth.DescriptorSystem(
        E=left @ scipy.linalg.block_diag(np.eye(n), np.zeros((algebraic, algebraic))) @ right,
        A=left @ scipy.linalg.block_diag(a, np.eye(algebraic)) @ right,
        C=rng.normal(size=(ny, size)),
        Bf=rng.normal(size=(size, nf)),
        Df=rng.normal(size=(ny, nf)) * (rng.random() < 0.4),
        Bd=rng.normal(size=(size, nd)),
        Dd=rng.normal(size=(ny, nd)) * (rng.random() < 0.3),
        Bw=np.hstack([rng.normal(size=(size, nw)), np.zeros((size, sensors.shape[1]))]),
        Dw=np.hstack([np.zeros((ny, nw)), sensors]),
        dt=1.0,
    )


def _late(samples: int) -> dict[str, list[float]]:
    return {"num": [1.0], "den": [1.0, *[0.0] * samples]}


def _windows(plant: obsynth.DescriptorSystem, window: int) -> dict[str, np.ndarray]:
    """Return, by letter, what the rows that see no state make of each signal of the window, the oldest sample first.

    A row is of outputs and of the plant's equations, ``E x+ - A x = B v``, so that no inverse is needed.
    """
    n, count = plant.nx, window + 1
    states = np.zeros((count * n, (count + 1) * n))
    for k in range(count):
        states[k * n : (k + 1) * n, k * n : (k + 2) * n] = np.hstack([-plant.A, plant.E])
    outputs = np.hstack([np.kron(np.eye(count), plant.C), np.zeros((count * plant.ny, n))])
    rows = scipy.linalg.null_space(np.vstack([outputs, states]).T, rcond=NOTHING).T
    return {
        letter: rows
        @ np.vstack(
            [
                np.kron(np.eye(count), getattr(plant, f"D{letter}")),
                -np.kron(np.eye(count), getattr(plant, f"B{letter}")),
            ]
        )
        for letter in "fdw"
    }


def _least(plant: obsynth.DescriptorSystem, window: int, late: int, norm: str, *, exact: bool) -> float | None:
    """Return the least that a window reaches; ``None`` where none has the fault map."""
    seen, nf, count = _windows(plant, window), plant.nf, window + 1
    wanted = np.zeros((nf, count * nf))
    wanted[:, (window - late) * nf : (count - late) * nf] = np.eye(nf)
    given, target = seen["d"], np.zeros((nf, seen["d"].shape[1]))
    if exact:
        given, target = np.hstack([seen["f"], given]), np.hstack([wanted, target])
    left, values, across = np.linalg.svd(given)
    rank = int(np.sum(values > NOTHING * max(1.0, np.max(values, initial=0.0))))
    first = (target @ across[:rank].T / values[:rank]) @ left[:, :rank].T
    if not len(given) or np.linalg.norm(first @ given - target) > EXACT:
        return None
    free = left[:, rank:].T
    error, moves = first @ seen["w"], free @ seen["w"]
    if not exact:
        error = _side_by_side(first @ seen["f"] - wanted, error, count)
        moves = _side_by_side(free @ seen["f"], moves, count)
    _, sizes, directions = np.linalg.svd(moves, full_matrices=False)
    basis = directions[sizes > TOO_LITTLE * max(1.0, np.max(sizes, initial=0.0))]
    error = error - error @ basis.T @ basis
    if norm == "h2" or not len(basis):
        return float(np.linalg.norm(error)) if norm == "h2" else _gain(error, count)
    return _least_gain(error, basis, count)


def _side_by_side(faults: np.ndarray, noise: np.ndarray, count: int) -> np.ndarray:
    rows = len(faults)
    return np.concatenate([part.reshape(rows, count, -1) for part in (faults, noise)], axis=2).reshape(rows, -1)


def _at(points: np.ndarray, part: np.ndarray, count: int) -> np.ndarray:
    """Return responses of windows, the oldest sample first, at angles of the circle."""
    late = np.exp(-1j * np.outer(points, np.arange(count)[::-1]))
    return np.einsum("pk,ikj->pij", late, part.reshape(len(part), count, -1))


def _gain(error: np.ndarray, count: int) -> float:
    points = np.linspace(0.0, np.pi, TRUE_POINTS)
    return float(np.max(np.linalg.norm(_at(points, error, count), 2, axis=(1, 2)), initial=0.0))


def _least_gain(error: np.ndarray, basis: np.ndarray, count: int) -> float | None:
    """Return the gain of the best window by points of the circle: its true one, to a fine grid."""
    unit = float(np.linalg.norm(error)) or 1.0
    points, rows = np.linspace(0.0, np.pi, POINTS), len(error)
    unknown, level, limits = cp.Variable((rows, len(basis))), cp.Variable(), []
    for fixed, moved in zip(_at(points, error / unit, count), _at(points, basis, count), strict=True):
        real, imaginary = fixed.real + unknown @ moved.real, fixed.imag + unknown @ moved.imag
        if rows == 1:
            limits.append(cp.norm(cp.hstack([real[0], imaginary[0]])) <= level)
        else:
            limits.append(cp.sigma_max(cp.bmat([[real, -imaginary], [imaginary, real]])) <= level)
    cp.Problem(cp.Minimize(level), limits).solve(solver="CLARABEL")
    return None if unknown.value is None else _gain(error + unit * unknown.value @ basis, count)

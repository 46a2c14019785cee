"""The bounded real inequality proves a gain above the norm of a system, and none below it, with a direct term too."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg

from obsynth.verification.inequalities import prove_norm


def random_system(seed: int, dt: float) -> tuple[np.ndarray, ...]:
    rng = np.random.default_rng([194, seed])
    a = rng.normal(size=(4, 4))
    values = np.linalg.eigvals(a)
    a = a - (values.real.max() + 0.5) * np.eye(4) if dt == 0.0 else 0.7 * a / np.abs(values).max()
    return a, rng.normal(size=(4, 2)), rng.normal(size=(2, 4)), 2.0 * rng.normal(size=(2, 2))


def norm_of(system: tuple[np.ndarray, ...], dt: float) -> float:
    a, b, c, d = system
    angles = np.concatenate([[0.0], np.geomspace(1e-3, np.pi if dt else 1e3, 4000)])
    points = np.exp(1j * angles) if dt else 1j * angles
    return max(np.linalg.norm(c @ np.linalg.solve(s * np.eye(4) - a, b) + d, 2) for s in points)


@pytest.mark.one_in(4)
@pytest.mark.parametrize("dt", [0.0, 1.0])
@pytest.mark.parametrize("seed", range(4))
def test_what_is_proved_is_above_the_norm_and_all_but_reaches_it(seed: int, dt: float):
    system = a, b, c, d = random_system(seed, dt)
    norm = norm_of(system, dt)
    solve = scipy.linalg.solve_discrete_are if dt else scipy.linalg.solve_continuous_are
    # What is added makes the inequality strict.
    P = solve(a, b, c.T @ c + 0.01 * np.eye(4), d.T @ d - (1.05 * norm) ** 2 * np.eye(2), s=c.T @ d)
    P = (P + P.T) / 2.0

    def in_arithmetic(kind):
        return tuple(kind.exact(part) for part in system)

    assert prove_norm(in_arithmetic, P, 1.06 * norm, dt=dt).proved
    assert not prove_norm(in_arithmetic, P, 0.999 * norm, dt=dt).proved

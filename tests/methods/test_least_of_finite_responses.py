"""Least deviations against another route: least squares over filters of finite response, at points of the circle."""

from __future__ import annotations

import numpy as np
import pytest

import obsynth

TAPS, POINTS = 24, 256
#: A pole of a weight, its zero and its gain: ``g (z - zero) / (z - pole)``.
Weight = tuple[float, float, float]


def plant_of(seed: int) -> obsynth.DescriptorSystem:
    """Return a stable sampled plant of two faults and three outputs with noise on all, and an algebraic state."""
    rng = np.random.default_rng([47, 11, seed])
    modes = rng.standard_normal((2, 2))
    a = np.eye(3)
    a[:2, :2] = 0.6 / max(abs(np.linalg.eigvals(modes))) * modes
    left, right = (np.eye(3) + 0.3 * rng.standard_normal((3, 3)) for _ in range(2))
    return obsynth.DescriptorSystem(
        E=left @ np.diag([1.0, 1.0, 0.0]) @ right,
        A=left @ a @ right,
        C=rng.standard_normal((3, 3)),
        Bf=rng.standard_normal((3, 2)),
        Bw=np.hstack([rng.standard_normal((3, 1)), np.zeros((3, 3))]),
        Dw=np.hstack([np.zeros((3, 1)), 0.3 * np.eye(3)]),
        dt=1.0,
    )


def least_of_taps(plant: obsynth.DescriptorSystem, fault: int, late: int, noise: Weight, error: Weight) -> float:
    """Return the least deviation of the estimate of a fault by filters with so many taps."""
    points = np.exp(1j * np.pi * (np.arange(POINTS) + 0.5) / POINTS)
    exact, wanted, driven = [], [], []
    for z in points:
        states = np.linalg.solve(z * plant.E - plant.A, np.hstack([plant.Bf, plant.Bw]).astype(complex))
        shown = plant.C @ states + np.hstack([plant.Df, plant.Dw])
        taps = z ** -np.arange(TAPS)
        each = np.einsum("t,yi->ity", taps, shown).reshape(shown.shape[1], -1)
        exact.append(each[: plant.nf])
        wanted.append(z**-late * np.eye(plant.nf)[fault])
        weighted = np.prod([gain * (z - zero) / (z - pole) for pole, zero, gain in (noise, error)])
        driven.append(weighted * each[plant.nf :])
    rows, right, seen = np.vstack(exact), np.concatenate(wanted), np.vstack(driven)
    rows, right, seen = (np.concatenate([part.real, part.imag]) for part in (rows, right, seen))
    left, values, across = np.linalg.svd(rows, full_matrices=False)
    count = int(np.sum(values > 1e-10 * values[0]))
    first = across[:count].T @ (left[:, :count].T @ right / values[:count])
    assert np.linalg.norm(rows @ first - right) < 1e-8 * np.linalg.norm(right)
    kernel = np.linalg.svd(across[:count])[2][count:].T
    more = np.linalg.lstsq(seen @ kernel, -seen @ first, rcond=None)[0]
    return float(np.linalg.norm(seen @ (first + kernel @ more)) / np.sqrt(POINTS))


PLAIN = (0.0, 0.0, 1.0)


@pytest.mark.parametrize(
    "delays", [(1, 3), pytest.param((2, 2), marks=pytest.mark.long), pytest.param((4, 1), marks=pytest.mark.long)]
)
@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.long), pytest.param(2, marks=pytest.mark.long)])
def test_delays_of_each_fault_have_the_least_deviation_of_long_finite_responses(
    seed: int, delays: tuple[int, int]
) -> None:
    plant = plant_of(seed)
    design = obsynth.optimal_filter(plant, delay=list(delays), norm="h2")
    taps = np.hypot(*(least_of_taps(plant, fault, late, PLAIN, PLAIN) for fault, late in enumerate(delays)))
    assert design.least * (1.0 - 1e-7) <= taps <= design.gain * (1.0 + 1e-4)


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.long), pytest.param(2, marks=pytest.mark.long)])
def test_weighted_errors_and_noise_have_the_least_deviation_of_long_finite_responses(seed: int) -> None:
    plant, noise, errors = plant_of(seed), (0.5, -0.3, 2.0), ((-0.4, 0.2, 0.7), (0.3, 0.5, 3.0))

    def model(weight: Weight) -> dict[str, list[list[float]]]:
        pole, zero, gain = weight
        return {"A": [[pole]], "B": [[1.0]], "C": [[gain * (pole - zero)]], "D": [[gain]]}

    weights = {
        "errors": {name: model(weight) for name, weight in zip(plant.fault_names, errors, strict=True)},
        "inputs": {name: model(noise) for name in plant.noise_names},
    }
    design = obsynth.optimal_filter(plant, delay=2, norm="h2", weights=weights)
    taps = np.hypot(*(least_of_taps(plant, fault, 2, noise, error) for fault, error in enumerate(errors)))
    assert design.least * (1.0 - 1e-7) <= taps <= design.gain * (1.0 + 1e-4)

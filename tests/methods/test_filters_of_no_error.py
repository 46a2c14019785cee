"""Plants whose inputs and noise reach no error, with exact numbers: what stored ones leave is claimed, not refused."""

from __future__ import annotations

import numpy as np
import pytest

import obsynth

#: Least deviations of zero; of the last one the noise enters where T holds nothing but rounding.
SAMPLED = {
    "three states": {
        "A": [[-0.8, -0.6, 0.0], [0.2, -0.4, 0.4], [0.2, -0.4, 0.2]],
        "Bd": [[2.0], [-1.0], [-1.0]],
        "Bf": [[0.0], [-3.0], [-1.0]],
        "C": [[-2.0, -0.5, 0.5], [0.5, -0.5, -1.0], [-1.0, 0.5, 0.0]],
    },
    "two states": {
        "A": [[0.2, 0.4], [0.4, 0.0]],
        "Bd": [[0.0], [-1.5]],
        "Bf": [[1.0], [-0.5]],
        "C": [[0.5, 0.5], [-0.5, -0.5], [-0.5, -1.0]],
    },
    "an algebraic state": {
        "E": np.diag([1.0, 1.0, 0.0]),
        "A": 0.4 * np.array([[1.5, -2.0, -0.5], [3.0, -2.0, 0.5], [0.5, 1.5, 0.5]]),
        "Bd": [[1.0], [0.0], [0.0]],
        "Bf": [[0.0], [-1.0], [-0.5]],
        "C": [[0.5, 0.0, -1.5], [1.0, 1.0, 2.0], [-1.0, 0.5, 2.0]],
    },
}


@pytest.mark.one_in(3)
@pytest.mark.parametrize("name", SAMPLED)
def test_a_deviation_that_is_rounding_has_a_bound(name: str) -> None:
    design = obsynth.optimal_filter(obsynth.DescriptorSystem(**SAMPLED[name], dt=1.0), norm="h2", delay=2)
    assert design.report.passed
    assert design.certificate.claims["deviation"] <= 1e-5
    assert design.certificate.claims["least_deviation"] <= 1e-8


def test_a_bound_on_rounding_that_is_too_small_or_far_too_large_fails() -> None:
    design = obsynth.optimal_filter(obsynth.DescriptorSystem(**SAMPLED["two states"], dt=1.0), norm="h2", delay=2)
    stated = design.certificate.claims["deviation"]
    # Kernels of some processors leave no rounding at all: then zero is right.
    for wrong in (1e-6 * stated, 1e6 * stated) if stated else (1.0,):
        claims = {**design.certificate.claims, "deviation": wrong}
        report = obsynth.verify(design.replace(certificate=obsynth.results.design.Certificate(
            design.certificate.matrices, claims
        )))  # fmt: skip
        assert not report["deviation"].passed


def test_a_gain_that_stored_numbers_lose_is_the_one_that_is_proved_of_them() -> None:
    plant = obsynth.DescriptorSystem(**SAMPLED["three states"], dt=1.0)
    design = obsynth.optimal_filter(plant, delay=2)
    assert design.report.passed
    assert design.certificate.claims["gain"] < 1e-6

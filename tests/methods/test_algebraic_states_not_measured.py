"""Algebraic states that no sensor measures take no design away, in discrete time as in continuous time."""

from __future__ import annotations

import numpy as np
import pytest

import obsynth

METHODS = ("fault-estimation-filter", "descriptor-kalman", "adaptive-observer")


def plants(seed: int) -> tuple[obsynth.DescriptorSystem, obsynth.DescriptorSystem]:
    """Return a plant of two states, and the same with their weighted sum as an algebraic state that drives them."""
    rng = np.random.default_rng([48, seed])
    a, b = 0.4 * rng.standard_normal((2, 2)), 0.2 * rng.standard_normal((2, 1))
    row, c = rng.standard_normal((1, 2)), rng.standard_normal((2, 2))
    signals = {"Bf": rng.standard_normal((2, 1)), "Bw": 0.1 * np.eye(2, 4)}
    noise = np.hstack([np.zeros((2, 2)), 0.1 * np.eye(2)])
    explicit = obsynth.DescriptorSystem(A=a + b @ row, C=c, Dw=noise, dt=0.1, **signals)
    descriptor = obsynth.DescriptorSystem(
        E=np.diag([1.0, 1.0, 0.0]),
        A=np.block([[a, b], [row, -np.ones((1, 1))]]),
        C=np.hstack([c, np.zeros((2, 1))]),
        Dw=noise,
        dt=0.1,
        **{name: np.vstack([matrix, np.zeros((1, matrix.shape[1]))]) for name, matrix in signals.items()},
    )
    return explicit, descriptor


@pytest.mark.one_in(3)
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("method", METHODS)
def test_a_design_is_that_of_the_explicit_form(method: str, seed: int) -> None:
    explicit, descriptor = plants(seed)
    assert obsynth.check(descriptor)[method].passed
    written, reduced = (obsynth.design(plant, method) for plant in (descriptor, explicit))
    assert "only where they are measured" in written.notes[0]
    for name, claimed in reduced.certificate.claims.items():
        assert written.certificate.claims[name] == pytest.approx(claimed, rel=1e-6, abs=1e-9)
    assert [state in written.recovery.names for state in ("x1", "x2", "x3")] == [True] * 3


def test_what_is_stated_of_the_states_as_written_keeps_them() -> None:
    _, descriptor = plants(0)
    with pytest.raises(obsynth.PreconditionError, match=r"rank \[E; C\].*eliminate the algebraic states"):
        obsynth.descriptor_kalman(descriptor, Q=np.diag([0.01, 0.01, 0.0]), R=0.01 * np.eye(2))

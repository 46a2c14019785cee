"""What is no certificate proves nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from obsynth.conditions import ErrorPolytope
from obsynth.methods.engines.vertex_certificates import certified
from obsynth.proofs.vertex_inequalities import Witness, _place, prove_gain, prove_mean_square, prove_nonsingular

_ERRORS = ErrorPolytope(
    [[[0.5, 0.2], [0, 0.7]], [[0.6, -0.2], [0.1, 0.8]]], [[1.0, 0]], B=[[1.0, 0], [0.5, 0]], D=[[0, 0.3]]
)


def _proved(witness: Witness, gains: list[np.ndarray], level: float) -> bool:
    return prove_gain(_ERRORS.closed(gains), witness, level, discrete=True).proved


@pytest.mark.parametrize("lyapunov", ["common", "vertex"])
def test_every_number_of_a_certificate_counts(lyapunov: str) -> None:
    made = certified(_ERRORS, lyapunov=lyapunov)
    good, gains, level = made.witness, made.gains, made.level
    assert _proved(good, gains, level)
    skewed = [matrix + np.array([[0, 1e-9], [0, 0]]) for matrix in good.P]
    wrong: dict[str, Witness] = {
        "asymmetric": replace(good, P=skewed),
        "negative": replace(good, P=[-matrix for matrix in good.P]),
        "small": replace(good, P=[0.9 * matrix for matrix in good.P]),
        "not finite": replace(good, P=[np.full((2, 2), np.nan)] * len(good.P)),
        "of other order": replace(good, P=[np.eye(3)]),
    }
    if good.G is not None:
        wrong["without slack"] = replace(good, G=None)
        wrong["missing vertex"] = replace(good, P=[*good.P, good.P[0]])
        wrong["slack of another vertex"] = replace(good, G=list(good.G)[::-1])
        wrong["no weights"] = replace(good, pairs=[(np.array([0.5, 0.6]), np.array([1.0, 0.0]))])
        wrong["outside the simplex"] = replace(good, pairs=[(np.array([1.5, -0.5]), np.array([1.0, 0.0]))])
        wrong["between vertices"] = replace(good, pairs=[(np.array([0.5, 0.5]), np.array([1.0, 0.0]))])
    for name, witness in wrong.items():
        assert not _proved(witness, gains, level), name
    assert not _proved(good, [gain + 0.3 for gain in gains], level)
    assert not _proved(good, gains, 0.98 * level)
    assert not _proved(good, gains, -level)
    assert not _proved(good, gains, float("nan"))


def test_a_wider_hull_is_refused() -> None:
    made = certified(_ERRORS)
    wider = ErrorPolytope(
        [_ERRORS.A[0], 1.1 * _ERRORS.A[1]], _ERRORS.C[0], B=list(_ERRORS.B), D=list(_ERRORS.D), Cz=list(_ERRORS.Cz)
    )
    assert not prove_gain(wider.closed(made.gains), made.witness, made.level, discrete=True).proved


def test_hulls_with_a_singular_point_are_told() -> None:
    assert prove_nonsingular([np.diag([1.0, 2.0]), np.diag([0.5, 3.0])], np.eye(2), 0.49).proved
    assert not prove_nonsingular([np.diag([1.0, 2.0]), np.diag([0.5, 3.0])], np.eye(2), 0.51).proved
    assert not prove_nonsingular([np.eye(2), -np.eye(2)], np.eye(2), 1e-9).proved


def test_direct_noise_counts_in_the_mean_square() -> None:
    # z = 0.1 e + w, and nothing drives e: the mean square of z is that of w.
    errors = ErrorPolytope([[[0.5]]], np.zeros((0, 1)), B=[[0.0]], D=np.zeros((0, 1)), Cz=[[0.1]], Dz=[[1.0]])
    closed, witness = errors.closed([np.zeros((1, 0))]), Witness([np.eye(1)])
    assert prove_mean_square(closed, witness, 1.01, discrete=True).proved
    assert not prove_mean_square(closed, witness, 0.99, discrete=True).proved


@pytest.mark.parametrize(("discrete", "pole", "least"), [(True, 0.5, 4.0 / 3.0), (False, -1.0, 0.5)])
def test_a_mean_square_needs_a_matrix_that_bounds_the_outputs(discrete: bool, pole: float, least: float) -> None:
    # e+ = e / 2 + w, or e' = -e + w; z = e: the mean square is 4 / 3, or 1 / 2.
    errors = ErrorPolytope(
        [[[pole]]], np.zeros((0, 1)), B=[[1.0]], D=np.zeros((0, 1)), Cz=[[1.0]], dt=1.0 if discrete else 0.0
    )
    closed = errors.closed([np.zeros((1, 0))])
    enough, small = (Witness([share * least * np.eye(1)]) for share in (1.01, 0.01))
    assert prove_mean_square(closed, enough, np.sqrt(1.02 * least), discrete=discrete).proved
    assert not prove_mean_square(closed, small, np.sqrt(1.02 * least), discrete=discrete).proved
    assert not prove_mean_square(closed, enough, np.sqrt(1.0 * least), discrete=discrete).proved


def test_places_are_named_by_their_vertices() -> None:
    first, second, between = np.eye(2)[0], np.eye(2)[1], np.array([0.25, 0.75])
    assert _place(second, second) == "vertex 2"
    assert _place(first, second) == "vertex 1, then 2"
    assert _place(between, first) == "vertex 0.25 of 1 + 0.75 of 2, then 1"


@pytest.mark.parametrize("weights", [[-0.5, 1.5], [1.0], [0.5, 0.25, 0.25], [0.5, 0.25], [np.nan, 1.0]], ids=str)
def test_weights_are_those_of_the_simplex(weights: list[float]) -> None:
    right, wrong, eye = np.array([0.5, 0.5]), np.array(weights), np.eye(2)
    assert Witness([eye], [eye], pairs=[(right, right)]).problem(2) == ""
    for pair in ((right, wrong), (wrong, right)):
        assert "weights" in Witness([eye], [eye], pairs=[pair]).problem(2)

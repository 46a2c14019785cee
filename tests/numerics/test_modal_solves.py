"""Rows times the inverse of a pencil at many points, against a factorisation at each."""

import numpy as np
import pytest

from obsynth.numerics import modal_solves
from obsynth.numerics.modal_response import Modes
from obsynth.numerics.modal_solves import ModalSolves

POINTS = np.exp(1j * np.geomspace(1e-7, np.pi, 9))


def factored(e, a, rows):
    n, wanted = len(a), np.broadcast_to(rows, (len(POINTS), *rows.shape[-2:]))
    pencils = [point * (np.eye(n) if e is None else e) - a for point in POINTS]
    return np.stack([np.linalg.solve(pencil.T, c.T + 0j).T for pencil, c in zip(pencils, wanted, strict=True)])


def stable(rng, n):
    a = rng.standard_normal((n, n))
    return 0.9 * a / np.max(np.abs(np.linalg.eigvals(a)))


def nearly_a_jordan_block(rng, n):
    return np.diag(0.5 + 1e-9 * np.arange(n)) + np.triu(rng.standard_normal((n, n)), 1) / n


def singular(rng, n):
    e = np.eye(n)
    e[:, :2] = 0.0
    return e @ rng.standard_normal((n, n))


@pytest.mark.parametrize("kind", ["identity", "known", "nonsingular", "singular", "no basis"])
def test_rows_are_those_of_a_factorisation_at_each_point(kind, monkeypatch):
    n, rng = 30, np.random.default_rng(4)
    a = nearly_a_jordan_block(rng, n) if kind == "no basis" else stable(rng, n)
    e = {"nonsingular": np.eye(n) + 0.1 * rng.standard_normal((n, n))}.get(kind)
    e = singular(rng, n) if kind == "singular" else e
    points_factored = []
    plain = modal_solves.resolved
    monkeypatch.setattr(modal_solves, "resolved", lambda *given: points_factored.append(given) or plain(*given))
    solves = ModalSolves.of(e, a, at=3.0, modes=Modes.of(a) if kind == "known" else None)
    for rows in (rng.standard_normal((2, n)), rng.standard_normal((len(POINTS), 1, n)) + 1j):
        found, true = solves.rows(POINTS, rows), factored(e, a, rows)
        assert np.max(np.abs(found - true)) <= 1e-10 * np.max(np.abs(true))
    # What the eigenvectors are good for is measured: those of a Jordan block are for nothing.
    assert bool(points_factored) == (kind == "no basis")


def test_a_pole_at_a_point_is_an_error_as_in_a_factorisation():
    a = np.diag([1.0, 0.5, 0.25])
    with pytest.raises(np.linalg.LinAlgError):
        ModalSolves.of(None, a, at=3.0).rows(np.array([1.0 + 0j]), np.ones((1, 3)))


def test_what_is_not_finite_has_no_basis():
    assert ModalSolves.of(None, np.full((2, 2), np.nan), at=3.0) is None
    assert ModalSolves.of(np.zeros((2, 2)), np.zeros((2, 2)), at=3.0) is None

"""Problems of many vertices at those that bind: the level of all of them, proved at each."""

from __future__ import annotations

import numpy as np
import pytest

from obsynth.errors import SolverError
from obsynth.methods.engines import needed_vertices
from obsynth.methods.engines.needed_vertices import lack_of_decay, lack_of_level, solved_at_needed
from obsynth.methods.engines.vertex_certificates import VertexCertificate, best_decay, certified
from obsynth.proofs.vertex_inequalities import prove_mean_square
from obsynth.verification.error_polytope import ErrorPolytope


def _box(slopes: int) -> ErrorPolytope:
    """Return all corners of a plant of which two measured states are coupled by ``slopes`` uncertain numbers."""
    rng = np.random.default_rng(5)
    A, into, out = np.diag([-1.0, -2.0, -3.0]), rng.standard_normal((3, slopes)), rng.standard_normal((slopes, 3))
    signs = [[1.0 if corner >> k & 1 else -1.0 for k in range(slopes)] for corner in range(2**slopes)]
    matrices = [A + 0.1 * into @ np.diag(sign) @ out for sign in signs]
    B, D = np.hstack([np.eye(3), np.zeros((3, 1))]), np.array([[0.0, 0.0, 0.0, 1.0]])
    return ErrorPolytope(matrices, np.array([[1.0, 1.0, 0.0]]), B=B, D=D, dt=0.0)


def _levelled(errors: ErrorPolytope) -> tuple[VertexCertificate, list[str]]:
    said: list[str] = []
    made = solved_at_needed(
        errors,
        lambda some: certified(some, goal="power", gain="constant"),
        lambda found: lack_of_level(errors, found, "power", None),
        said.append,
    )
    return made, said


@pytest.mark.long
def test_a_level_at_the_vertices_that_bind_is_that_of_all_and_proved_at_each(monkeypatch: pytest.MonkeyPatch) -> None:
    errors = _box(3)
    whole = certified(errors, goal="power", gain="constant")
    monkeypatch.setattr(needed_vertices, "MOST_AT_ONCE", 4)
    monkeypatch.setattr(needed_vertices, "FIRST", 2)
    monkeypatch.setattr(needed_vertices, "JOINING", 2)
    made, said = _levelled(errors)
    assert said[0] == "solving the inequalities at 2 of 8 corners"
    assert len(said) > 1
    assert made.level == pytest.approx(whole.level, rel=1e-4)
    assert prove_mean_square(errors.closed(made.gains), made.witness, made.level, discrete=False).proved


def test_a_decay_holds_at_all_vertices(monkeypatch: pytest.MonkeyPatch) -> None:
    errors = _box(3)
    monkeypatch.setattr(needed_vertices, "MOST_AT_ONCE", 4)
    monkeypatch.setattr(needed_vertices, "FIRST", 2)
    gains = [np.zeros((3, 1))]
    whole = best_decay(errors, gains=gains)[0]
    rate, witness, shipped = solved_at_needed(
        errors, lambda some: best_decay(some, gains=gains), lambda found: lack_of_decay(errors, *found), lambda _: None
    )
    assert rate == pytest.approx(whole, rel=1e-2)
    assert max(lack_of_decay(errors, rate, witness, shipped)) <= 0.0
    assert max(lack_of_decay(errors, 1.1 * rate, witness, shipped)) > 0.0


def test_what_no_certificate_has_at_some_vertices_has_none_at_all() -> None:
    errors = _box(6)
    unstable = ErrorPolytope([*errors.A[:-1], np.eye(3)], np.zeros((1, 3)), B=np.eye(3), D=np.zeros((1, 3)), dt=0.0)
    with pytest.raises(SolverError, match="No common Lyapunov matrix was found"):
        _levelled(unstable)

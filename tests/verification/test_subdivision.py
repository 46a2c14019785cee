"""A box is proved by the parts into which it is cut: they cover it, and each of them was proved."""

from __future__ import annotations

import numpy as np
import pytest

from obsynth.proofs.affine import AffineMatrix
from obsynth.verification.over_tolerances.subdivision import proved_regular, proved_stable, subdivided


def test_proved_parts_cover_the_whole_box() -> None:
    """What is proved only of small parts is proved of the box only where these parts leave nothing out."""
    accepted: list[tuple[np.ndarray, np.ndarray]] = []
    last: list[tuple[np.ndarray, np.ndarray]] = []

    def build(lower: np.ndarray, upper: np.ndarray) -> AffineMatrix:
        last[:] = [(lower, upper)]
        parts = np.array([[[upper[i] - lower[i]]] for i in range(2)])
        return AffineMatrix(np.zeros((1, 1)), parts, np.zeros((1, 1)))

    def small(part: AffineMatrix) -> bool:
        fits = bool(np.abs(part.parts).max() < 0.6)
        accepted.extend(last if fits else [])
        return fits

    found = subdivided(build, 2, small, lambda _: False, lambda point: point)
    assert found.verdict == "proved"
    assert len(accepted) == 16
    for point in np.random.default_rng(0).uniform(-1.0, 1.0, (500, 2)):
        assert sum(bool(np.all(low <= point) and np.all(point <= high)) for low, high in accepted) == 1
    assert subdivided(build, 2, lambda _: False, lambda _: False, lambda point: point, most=5).verdict == "open"


def test_a_box_that_is_unstable_in_one_corner_region_alone_is_never_proved() -> None:
    """The matrix is unstable only where both constants are near one end, in every quarter of the box in turn."""
    for signs in np.array(np.meshgrid([-1.0, 1.0], [-1.0, 1.0])).T.reshape(-1, 2):
        edge = 0.4 * signs

        def exact(q: np.ndarray, edge: np.ndarray = edge) -> np.ndarray:
            return np.array([[0.7 + edge @ q]])

        def build(lower: np.ndarray, upper: np.ndarray, edge: np.ndarray = edge) -> AffineMatrix:
            half = (upper - lower) / 2.0
            return AffineMatrix(exact((lower + upper) / 2.0, edge), (edge * half)[:, None, None], np.zeros((1, 1)))

        found = proved_stable(build, 2, exact, discrete=True)
        assert found.verdict == "refuted"
        assert exact(found.at, edge)[0, 0] >= 1.0


@pytest.mark.parametrize(
    ("discrete", "center", "parts", "radius", "verdict"),
    [
        # |a| + r < 1: what does not depend on a constant counts in the term of second order too
        (True, 0.0, [], 1.5, "open"),
        (True, 0.5, [], 0.6, "open"),
        (True, 0.5, [], 0.4, "proved"),
        # of two constants each alone would leave it stable: .5 + .3, but .5 + .3 + .3
        (True, 0.5, [0.3, 0.3], 0.0, "open"),
        (True, 0.5, [0.2, 0.2], 0.0, "proved"),
        (True, 0.0, [0.6, 0.6], 0.0, "open"),
        # a + r < 0
        (False, -1.0, [], 1.5, "open"),
        (False, -1.0, [], 0.9, "proved"),
        (False, -1.0, [0.6, 0.6], 0.0, "open"),
        (False, -1.0, [0.4, 0.4], 0.0, "proved"),
    ],
)
def test_enclosure_alone_decides_where_no_point_fails(
    discrete: bool, center: float, parts: list[float], radius: float, verdict: str
) -> None:
    """Worked by hand for one state: the points that are looked at are stable, so that the enclosure has to tell."""
    part = AffineMatrix(np.array([[center]]), np.array(parts).reshape(-1, 1, 1), np.array([[radius]]))
    found = proved_stable(lambda lower, upper: part, len(parts), lambda q: part.center, discrete=discrete, most=3)
    assert found.verdict == verdict
    assert found.boxes == (1 if verdict == "proved" or not parts else 3)


def test_an_unstable_corner_refutes() -> None:
    """-1 + 1.25 q is unstable at q = 1; 0.5 + 0.75 q at q = 1."""
    for discrete, center, slope in ((False, -1.0, 1.25), (True, 0.5, 0.75)):
        exact = lambda q, c=center, s=slope: np.array([[c + s * q[0]]])  # noqa: E731
        build = lambda low, up, e=exact, s=slope: AffineMatrix(  # noqa: E731
            e((low + up) / 2.0), np.array([[[s * (up[0] - low[0]) / 2.0]]]), np.zeros((1, 1))
        )
        found = proved_stable(build, 1, exact, discrete=discrete)
        assert found.verdict == "refuted"
        assert found.at.tolist() == [1.0]


def test_a_singular_point_is_where_the_determinant_vanishes() -> None:
    """0.5 + q is singular at q = -1/2; 2 + q nowhere in -1 .. 1; a matrix that is zero in the middle is at once."""

    def found(center: float) -> tuple[str, list[float] | None]:
        exact = lambda q: np.array([[center + q[0]]])  # noqa: E731
        build = lambda low, up: AffineMatrix(  # noqa: E731
            exact((low + up) / 2.0), np.array([[[(up[0] - low[0]) / 2.0]]]), np.zeros((1, 1))
        )
        verdict = proved_regular(build, 1, exact)
        return verdict.verdict, None if verdict.at is None else verdict.at.tolist()

    verdict, at = found(0.5)
    assert verdict == "refuted"
    assert at == pytest.approx([-0.5], abs=1e-12)
    assert found(2.0) == ("proved", None)
    assert found(0.0)[0] == "refuted"

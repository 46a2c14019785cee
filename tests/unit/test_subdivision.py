"""A box is proved by the parts into which it is cut: they cover it, and each of them was proved."""

from __future__ import annotations

import numpy as np

from obsynth.proofs.affine import AffineMatrix
from obsynth.tolerances.subdivision import proved_stable, subdivided


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

"""LAPACK without ``scipy.linalg``: the same routines, and eigenvalues of pencils whose answer is known."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest

from obsynth.numerics import lapack


def test_eigenvalues_of_a_pencil_that_is_known() -> None:
    rng = np.random.default_rng(3)
    left, right = (np.linalg.qr(rng.normal(size=(4, 4)))[0] for _ in range(2))
    a = (
        left
        @ np.array([[0.0, 2.0, 0.0, 0.0], [-2.0, 0.0, 0.0, 0.0], [0.0, 0.0, 3.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
        @ right
    )
    b = left @ np.diag([1.0, 1.0, -2.0, 1.0]) @ right
    found = sorted(lapack.eigenvalues(a, b), key=lambda value: (value.real, value.imag))
    assert found == pytest.approx([-1.5, -2.0j, 2.0j, 1.0], abs=1e-12)


def test_an_eigenvalue_at_infinity_is_infinite_and_one_of_a_singular_pencil_is_no_number() -> None:
    values = lapack.eigenvalues(np.diag([1.0, 2.0, 0.0]), np.diag([1.0, 0.0, 0.0]))
    assert values[0] == 1.0
    assert np.isinf(values[1])
    assert np.isnan(values[2])


def test_what_is_not_finite_is_refused_and_nothing_has_no_eigenvalues() -> None:
    with pytest.raises(ValueError, match="infs or NaNs"):
        lapack.eigenvalues(np.eye(2), np.array([[1.0, np.nan], [0.0, 1.0]]))
    assert lapack.eigenvalues(np.zeros((0, 0)), np.zeros((0, 0))).shape == (0,)


@pytest.mark.parametrize("shape", [(5, 8), (8, 5), (6, 6), (0, 3), (3, 0)])
def test_least_squares_are_the_shortest_ones(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(sum(shape))
    a, b = rng.standard_normal(shape), rng.standard_normal((shape[0], 2))
    if a.size:
        a[-1] = a[0]
    np.testing.assert_allclose(lapack.least_squares(a, b), np.linalg.pinv(a) @ b, rtol=0, atol=1e-13)


def test_an_unknown_routine_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no_such_routine"):
        _ = lapack.no_such_routine


@pytest.mark.long
@pytest.mark.parametrize("first", ["pass", "import scipy.linalg"])
def test_routines_are_those_of_scipy_whichever_is_imported_first(first: str) -> None:
    code = (
        f"{first}\nimport sys, numpy as np\nfrom obsynth.numerics.lapack import dgesv\n"
        "print('scipy.linalg' in sys.modules)\n"
        "import scipy.linalg\na = np.array([[2.0, 1.0], [1.0, 3.0]])\n"
        "print(dgesv(a, a[:, :1])[2].tolist() == scipy.linalg.lapack.dgesv(a, a[:, :1])[2].tolist())\n"
        "print(scipy.linalg.eigvals(a).real.sum().round(9))"
    )
    path = os.pathsep.join(sys.path)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True,
                          env={**os.environ, "PYTHONPATH": path})  # fmt: skip
    assert done.stdout.split() == [str(first != "pass"), "True", "5.0"]

"""LAPACK's routines by name, and the eigenvalues of a pencil.

They come from SciPy's extension module alone: ``scipy.linalg`` imports three hundred modules more, a fifth of the time
of a first design.
"""

from __future__ import annotations

import sys
from functools import cache
from importlib import import_module
from importlib.machinery import PathFinder
from importlib.util import module_from_spec
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from obsynth.numerics.arrays import ComplexArray, FloatArray

#: Columns that LAPACK turns at once: its room is so many times the columns.
LAPACK_BLOCK = 64

#: Where SciPy keeps its LAPACK: the same object that ``scipy.linalg.lapack`` shows.
_PACKAGE, _EXTENSION = "scipy.linalg", "scipy.linalg._flapack"


@cache
def library() -> ModuleType:
    """Return the module of SciPy that has LAPACK's routines; its BLAS is loaded with it."""
    if _PACKAGE not in sys.modules:
        # Where it is, scipy itself not imported.
        package = PathFinder.find_spec("scipy")
        folders = [] if package is None else list(package.submodule_search_locations or ())
        spec = PathFinder.find_spec(_EXTENSION, [str(Path(folder) / "linalg") for folder in folders])
        if spec is not None and spec.loader is not None:
            try:
                module = module_from_spec(spec)
                spec.loader.exec_module(module)
            except ImportError:  # an installation whose extensions need their package first
                return import_module("scipy.linalg.lapack")
            return module
    return import_module("scipy.linalg.lapack")


def __getattr__(name: str) -> Any:
    """Return a routine of LAPACK by its name, such as ``dgesv``; asked for once."""
    if name.startswith("__"):
        raise AttributeError(name)
    routine = globals()[name] = getattr(library(), name)
    return routine


def pencil_eigenvalues(a: FloatArray, b: FloatArray) -> tuple[ComplexArray, FloatArray]:
    """Return alpha and beta ``(n,)`` of the eigenvalues ``z = alpha / beta`` of ``a - z b``, beta >= 0.

    Raises
    ------
    numpy.linalg.LinAlgError
        LAPACK's iteration does not converge.
    ValueError
        An entry is not finite.
    """
    a, b = np.asarray_chkfinite(a, dtype=np.float64), np.asarray_chkfinite(b, dtype=np.float64)
    if not a.size:
        return np.zeros(0, dtype=np.complex128), np.zeros(0)
    dggev = library().dggev
    size = int(dggev(a, b, lwork=-1)[-2][0])
    real, imaginary, beta, _, _, _, info = dggev(a, b, compute_vl=0, compute_vr=0, lwork=size)
    if info:
        raise np.linalg.LinAlgError(f"generalised eigenvalues did not converge (dggev, info {info})")
    return np.asarray(real + 1j * imaginary), np.asarray(beta)


def least_squares(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the shortest x with the least ``a x - b``, by a complete orthogonal factorisation.

    Raises
    ------
    numpy.linalg.LinAlgError
        LAPACK refuses the numbers.
    """
    routines, epsilon = library(), float(np.finfo(np.float64).eps)
    (rows, columns), width = a.shape, b.shape[1]
    if 0 in (rows, columns, width):
        return np.zeros((columns, width))
    padded = np.zeros((max(rows, columns), width))
    padded[:rows] = b
    room, failed = routines.dgelsy_lwork(rows, columns, width, epsilon)
    if not failed:
        pivots = np.zeros((columns, 1), dtype=np.int32)
        _, solution, _, _, failed = routines.dgelsy(a, padded, pivots, epsilon, int(room), False, False)
    if failed:
        raise np.linalg.LinAlgError(f"dgelsy ends with {failed}.")
    return np.asarray(solution[:columns])


def eigenvalues(a: FloatArray, b: FloatArray) -> ComplexArray:
    """Return the eigenvalues ``(n,)`` of ``a - z b``: infinite where b is singular alone, NaN where a is as well."""
    alpha, beta = pencil_eigenvalues(a, b)
    values = np.full(len(alpha), complex(np.inf), dtype=np.complex128)
    values[(alpha == 0.0) & (beta == 0.0)] = np.nan
    finite = beta != 0.0
    values[finite] = alpha[finite] / beta[finite]
    return values

"""Layouts of the arrays of a DAE observer in vectors: its memory between samples, and the results of a sample."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from obsynth.numerics import lazy_casadi as ca
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.nonlinear.settings import DAESettings
from obsynth.plants.dae_functions import BUTCHER

#: Arrays that are matrices even if they have a single column; all others are then vectors.
MATRICES = frozenset(
    {
        "P",
        "S",
        "spread",
        "cross",
        "Upsilon",
        "K",
        "H",
        "L",
        "information",
        "covariance",
        "F",
        "G",
        "noise",
        "missing",
        "kept",
        "scaled",
        "expected",
    }
)


@dataclass(frozen=True)
class Layout:
    """Named arrays in one vector, each column by column, as CasADi stores matrices."""

    shapes: Mapping[str, tuple[int, int]]  # in order

    @cached_property
    def slices(self) -> dict[str, slice]:
        """The slice of the vector that holds each array."""
        places, begin = {}, 0
        for name, (rows, columns) in self.shapes.items():
            places[name] = slice(begin, begin + rows * columns)
            begin += rows * columns
        return places

    @cached_property
    def size(self) -> int:
        """Length of the vector."""
        return sum(rows * columns for rows, columns in self.shapes.values())

    def part(self, vectors: FloatArray, name: str) -> FloatArray:
        """Return the array of this name from each of many vectors ``(..., size)``."""
        return self.shaped(vectors[..., self.slices[name]], name)

    def shaped(self, flat: FloatArray, name: str) -> FloatArray:
        """Return the array of this name from its entries ``(..., rows * columns)``."""
        rows, columns = self.shapes[name]
        if columns == 1 and name not in MATRICES:
            return flat
        return flat.reshape(*flat.shape[:-1], columns, rows).swapaxes(-1, -2)

    def packed(self, arrays: Mapping[str, FloatArray]) -> FloatArray:
        """Return the vector of named arrays."""
        return np.concatenate([np.ravel(arrays[name], order="F") for name in self.shapes])

    def symbols(self, vector: Any) -> dict[str, Any]:
        """Return the arrays of a vector of CasADi symbols by name."""
        return {
            name: ca.reshape(vector[self.slices[name]], *shape) if shape[0] * shape[1] else ca.MX(*shape)
            for name, shape in self.shapes.items()
        }

    def column(self, arrays: Mapping[str, Any]) -> Any:
        """Return the vector of named CasADi expressions."""
        return ca.vertcat(*(ca.vec(ca.densify(arrays[name])) for name in self.shapes))


def memory_layout(observer: DAESettings) -> Layout:
    """Return the layout of the memory between samples.

    ``posterior`` is the state after the measurement.  ``x``, with its covariance P, is the state before it at the
    present estimate of the parameters.  ``spread`` is the covariance of the parameters, which S is not where the
    observer forgets.
    """
    nx, ny, nq = observer.model.nx, observer.model.ny, observer.model.nq
    learning = {"cross": (nx, nq)} if observer.form == "augmented-kalman" else {"S": (nq, nq)}
    return Layout(
        {
            "posterior": (nx, 1),
            "x": (nx, 1),
            "theta": (nq, 1),
            "P": (nx, nx),
            **learning,
            "spread": (nq, nq),
            "Upsilon": (nx, nq),
            "K": (nx, ny),
            "H": (ny, nx),
            "L": (ny, nq),
        }
    )


def row_layout(observer: DAESettings) -> Layout:
    """Return the layout of the results of one sample that the memory does not hold.

    - ``innovation``, its covariance ``expected`` (the identity for missing outputs) and its normalised square ``nis``.
    - ``information`` and ``score`` on the parameters: for constant parameters ``score - information @ theta`` has, to
      first order, mean zero and the covariance ``information``.
    - ``covariance`` of the state after the measurement.
    - ``F`` of (8), ``G`` of (9), and ``noise``, the derivative of the step by what is added to the equations.
    - ``missing``: the covariance of the state by inputs without a measurement.
    - ``kept``: ``F (I - K H)`` with K and H of the sample before.
    - ``scaled``: the equilibrated matrix of (7), and ``residual`` of the step.
    - ``trusted``: 1 where the compiled graph has solved the step.
    """
    nx, ny, nq = observer.model.nx, observer.model.ny, observer.model.nq
    n = nx * len(BUTCHER[observer.integration])
    return Layout(
        {
            "innovation": (ny, 1),
            "expected": (ny, ny),
            "nis": (1, 1),
            "information": (nq, nq),
            "score": (nq, 1),
            "covariance": (nx, nx),
            "F": (nx, nx),
            "G": (nx, nq),
            "noise": (nx, nx),
            "missing": (nx, nx),
            "kept": (nx, nx),
            "scaled": (n, n),
            "residual": (1, 1),
            "trusted": (1, 1),
        }
    )


def initial_memory(observer: DAESettings, x: FloatArray) -> FloatArray:
    """Return the memory before the first sample, at the initial state ``x (nx,)``."""
    layout = memory_layout(observer)
    arrays = {name: np.zeros(shape) for name, shape in layout.shapes.items()}
    arrays |= {
        "posterior": x,
        "x": x,
        "theta": observer.initial_parameters,
        "P": observer.initial_covariance,
        "S": observer.initial_parameter_covariance,
        "spread": observer.initial_parameter_covariance,
    }
    return layout.packed(arrays)

"""How an observer of a DAE lays what it remembers and what it says in one vector of numbers."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.plants.dae.functions import BUTCHER

if TYPE_CHECKING:
    from obsynth.observers.dae.settings import DAESettings


@dataclass(frozen=True)
class Layout:
    """Named arrays in one vector, each by columns, as CasADi has them."""

    shapes: Mapping[str, tuple[int, int]]  # in order

    @cached_property
    def slices(self) -> dict[str, slice]:
        """Where each array lies."""
        found, begin = {}, 0
        for name, (rows, columns) in self.shapes.items():
            found[name] = slice(begin, begin + rows * columns)
            begin += rows * columns
        return found

    @cached_property
    def size(self) -> int:
        """Length of the vector."""
        return sum(rows * columns for rows, columns in self.shapes.values())

    def part(self, vectors: FloatArray, name: str) -> FloatArray:
        """Return one array of each of many vectors: ``vectors (..., size)``."""
        return self.shaped(vectors[..., self.slices[name]], name)

    def shaped(self, flat: FloatArray, name: str) -> FloatArray:
        """Return one array of each of many parts of vectors: ``flat (..., entries)``."""
        rows, columns = self.shapes[name]
        if columns == 1 and name not in MATRICES:
            return flat
        return np.swapaxes(flat.reshape(*flat.shape[:-1], columns, rows), -1, -2)

    def packed(self, arrays: Mapping[str, FloatArray]) -> FloatArray:
        """Return the vector of named arrays."""
        return np.concatenate([np.ravel(arrays[name], order="F") for name in self.shapes])

    def symbols(self, vector: Any) -> dict[str, Any]:
        """Return the arrays in a vector of CasADi symbols by name."""
        import casadi as ca

        return {
            name: ca.reshape(vector[self.slices[name]], *shape) if shape[0] * shape[1] else ca.MX(*shape)
            for name, shape in self.shapes.items()
        }

    def column(self, arrays: Mapping[str, Any]) -> Any:
        """Return the vector of named CasADi expressions."""
        import casadi as ca

        return ca.vertcat(*(ca.vec(ca.densify(arrays[name])) for name in self.shapes))

    def __iter__(self) -> Iterator[str]:
        return iter(self.shapes)


#: Arrays that stay matrices when they have one column.
MATRICES = frozenset({
    "P", "S", "spread", "cross", "Upsilon", "K", "H", "L", "information", "covariance", "F", "G", "noise", "kept",
    "scaled", "expected",
})  # fmt: skip


def memory_layout(observer: DAESettings) -> Layout:
    """Return the state. ``posterior`` is the state after the measurement, ``x`` the one before it with the parameters
    as they are estimated now; P belongs to ``x``, and ``spread`` is the covariance of the parameters, which S with
    forgetting is not."""
    nx, ny, nq = observer.model.nx, observer.model.ny, observer.model.nq
    learning = {"cross": (nx, nq)} if observer.form == "augmented-kalman" else {"S": (nq, nq)}
    return Layout({
        "posterior": (nx, 1), "x": (nx, 1), "theta": (nq, 1), "P": (nx, nx), **learning, "spread": (nq, nq),
        "Upsilon": (nx, nq), "K": (nx, ny), "H": (ny, nx), "L": (ny, nq),
    })  # fmt: skip


def row_layout(observer: DAESettings) -> Layout:
    """Return what is said of one sample besides what is remembered. ``score`` and ``information``: to first order the
    score less the information times the true parameters has mean zero and covariance ``information``, of parameters
    that stay as they are. ``expected`` is the covariance of the innovation, that of the identity for what is not seen;
    ``noise`` is the derivative by what is added to the equations, ``kept`` F (I - K H) with K and H of the sample
    before, ``scaled`` the equilibrated matrix of (7), and ``trusted`` one where the step of the compiled graph was
    solved."""
    nx, ny, nq = observer.model.nx, observer.model.ny, observer.model.nq
    n = nx * len(BUTCHER[observer.integration])
    return Layout({
        "innovation": (ny, 1), "expected": (ny, ny), "nis": (1, 1), "information": (nq, nq), "score": (nq, 1),
        "covariance": (nx, nx), "F": (nx, nx), "G": (nx, nq), "noise": (nx, nx), "kept": (nx, nx), "scaled": (n, n),
        "residual": (1, 1), "trusted": (1, 1),
    })  # fmt: skip


def initial_memory(observer: DAESettings, x: FloatArray) -> FloatArray:
    """Return what is remembered before the first sample: ``x (nx,)``."""
    layout = memory_layout(observer)
    start = {name: np.zeros(shape) for name, shape in layout.shapes.items()}
    start |= {"posterior": x, "x": x, "theta": observer.initial_parameters, "P": observer.initial_covariance,
              "S": observer.initial_parameter_covariance, "spread": observer.initial_parameter_covariance}  # fmt: skip
    return layout.packed(start)

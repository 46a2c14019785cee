r"""The error system of an observer whose plant lies in a polytope, as all designs over a region use it.

.. math::
    e^+ = (A(\mu) - L(\mu) C(\mu)) e + (B(\mu) - L(\mu) D(\mu)) w, \qquad z = C_z(\mu) e + D_z(\mu) w

with :math:`\mu` in the simplex, changing as it likes (or within stated steps), and in continuous time, where there
are algebraic errors too, :math:`E e'` on the left.  A gain that changes with :math:`\mu` needs constant C and D: the
product :math:`L(\mu) C(\mu)` would be of second degree.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics.arguments import require_shape
from obsynth.numerics.arrays import FloatArray, as_matrix, read_only
from obsynth.numerics.suggestions import fields_suggested
from obsynth.proofs.extended_balls import Enclosed, block
from obsynth.proofs.vertex_inequalities import Vertex


@fields_suggested
@dataclass(frozen=True, eq=False)
class ErrorPolytope:
    """Vertices of an error system.

    Parameters
    ----------
    A : sequence of array_like
        ``(n, n)`` at each vertex.
    C : array_like or sequence of array_like
        ``(m, n)``, one for all vertices or one for each; so are the others.
    B, D : array_like or sequence of array_like, optional
        ``(n, p)`` and ``(m, p)``: disturbances and noise; none by default.
    Cz, Dz : array_like or sequence of array_like, optional
        ``(q, n)`` and ``(q, p)``: the errors that count; all of e by default.
    dt : float
        Seconds between samples; 0 for continuous time.
    differential : int, optional
        How many of the errors, the first ones, are differential; all by default.
    ball : float, optional
        Largest spectral norm of a remainder beside A, that may change as it likes.

    Raises
    ------
    SpecError
        Shapes do not fit together.

    Examples
    --------
    >>> scalar = ErrorPolytope([[[0.5]], [[0.9]]], [[1.0]], B=[[1.0, 0.0]], D=[[0.0, 1.0]], dt=1.0)
    >>> scalar.count, scalar.order, scalar.constant_output
    (2, 1, True)
    """

    # Each a tuple of one matrix for each vertex, whatever was given.
    A: Any
    C: Any
    B: Any = None
    D: Any = None
    Cz: Any = None
    Dz: Any = None
    dt: float = 1.0
    differential: int | None = None
    ball: float = 0.0

    def __post_init__(self) -> None:
        A = tuple(as_matrix(matrix, "A") for matrix in self.A)
        if not A:
            raise SpecError("There is no vertex: give A at one or more.", path="A")
        n, count = len(A[0]), len(A)
        C = _each(self.C, "C", count)
        m = C[0].shape[0]
        Cz = _each(self.Cz, "Cz", count) if self.Cz is not None else (np.eye(n),) * count
        B = _each(self.B, "B", count) if self.B is not None else (np.zeros((n, 0)),) * count
        p, q = B[0].shape[1], len(Cz[0])
        D = _each(self.D, "D", count) if self.D is not None else (np.zeros((m, p)),) * count
        Dz = _each(self.Dz, "Dz", count) if self.Dz is not None else (np.zeros((q, p)),) * count
        shapes = {"A": (n, n), "C": (m, n), "B": (n, p), "D": (m, p), "Cz": (q, n), "Dz": (q, p)}
        matrices_of = {"A": A, "C": C, "B": B, "D": D, "Cz": Cz, "Dz": Dz}
        for name, matrices in matrices_of.items():
            for matrix in matrices:
                require_shape(matrix.shape, shapes[name], name)
        if self.differential is not None and (not 0 < self.differential <= n or self.dt > 0.0):
            raise SpecError(
                f"differential is {self.differential}: give 1 to {n}, in continuous time.", path="differential"
            )
        if not (np.isfinite(self.ball * self.ball) and self.ball >= 0.0):
            raise SpecError("ball must be a number with a finite square, 0 or more.", path="ball")
        if self.ball and self.differential not in (None, n):
            raise SpecError("A remainder beside A is for errors that are all differential.", path="ball")
        for name, matrices in matrices_of.items():
            object.__setattr__(self, name, tuple(read_only(matrix) for matrix in matrices))

    @property
    def count(self) -> int:
        """Number of vertices."""
        return len(self.A)

    @property
    def order(self) -> int:
        """Number of errors."""
        return len(self.A[0])

    @property
    def outputs(self) -> int:
        """Number of measurements."""
        return int(self.C[0].shape[0])

    @property
    def inputs(self) -> int:
        """Number of disturbances and noises."""
        return int(self.B[0].shape[1])

    @property
    def constant_output(self) -> bool:
        """Whether C and D are the same at all vertices."""
        return all(
            np.array_equal(c, self.C[0]) and np.array_equal(d, self.D[0]) for c, d in zip(self.C, self.D, strict=True)
        )

    def with_innovation(self, V: FloatArray) -> ErrorPolytope:
        """Return the error system with ``V (C e + D w)`` in z besides.

        Parameters
        ----------
        V : FloatArray
            ``(q, m)``.
        """
        return replace(
            self,
            Cz=[z + V @ c for z, c in zip(self.Cz, self.C, strict=True)],
            Dz=[z + V @ d for z, d in zip(self.Dz, self.D, strict=True)],
        )

    def closed(self, gains: Sequence[FloatArray]) -> list[Vertex]:
        """Return how the closed error system is formed at each vertex.

        Parameters
        ----------
        gains : sequence of FloatArray
            ``(n, m)``: one for all vertices, or one for each where C and D are constant.

        Raises
        ------
        SpecError
            A gain for each vertex beside an output that changes, or gains of another shape.
        """
        if len(gains) not in (1, self.count):
            raise SpecError(f"There are {len(gains)} gains: give one, or one for each of {self.count} vertices.")
        for gain in gains:
            require_shape(np.shape(gain), (self.order, self.outputs), "gain")
        if len(gains) > 1 and not self.constant_output:
            raise SpecError(
                "A gain that changes with the scheduling needs the same C and D at all vertices: the product "
                "L(mu) C(mu) has no vertices. Give one gain for all.",
                path="gains",
            )
        return [self._vertex(i, np.asarray(gains[i if len(gains) > 1 else 0])) for i in range(self.count)]

    def _vertex(self, i: int, gain: FloatArray) -> Vertex:
        def vertex(kind: type[Enclosed]) -> tuple[Enclosed, Enclosed, Enclosed, Enclosed]:
            exact = kind.exact
            shipped = exact(gain)
            return (
                exact(self.A[i]) - shipped @ exact(self.C[i]),
                driven_by(kind, self.B[i], gain, self.D[i]),
                exact(self.Cz[i]),
                exact(self.Dz[i]),
            )

        return vertex

    def at(self, weights: FloatArray, gains: Sequence[FloatArray]) -> tuple[FloatArray, ...]:
        """Return the closed M, B, Cz and Dz at weights, in floating point."""
        used = [int(i) for i in np.flatnonzero(weights)]

        def closed(i: int, matrix: FloatArray, measured: FloatArray) -> FloatArray:
            return np.asarray(matrix - gains[i if len(gains) > 1 else 0] @ measured)

        def mean(part: Callable[[int], FloatArray]) -> FloatArray:
            return np.asarray(sum(float(weights[i]) * part(i) for i in used))

        A = mean(lambda i: closed(i, self.A[i], self.C[i]))
        B = mean(lambda i: closed(i, self.B[i], self.D[i]))
        return A, B, mean(self.Cz.__getitem__), mean(self.Dz.__getitem__)


def driven_by(kind: type[Enclosed], B: FloatArray, gain: FloatArray, D: FloatArray) -> Enclosed:
    """Return ``B - L D``, where the last rows of L are zero without any rounding there: nothing enters these equations
    but what B has."""
    k = int(np.max(np.flatnonzero(gain.any(axis=1)), initial=-1)) + 1
    if k == 0:
        return kind.exact(B)
    above = kind.exact(B[:k]) - kind.exact(gain[:k]) @ kind.exact(D)
    return above if k == len(B) else block([[above], [kind.exact(B[k:])]])


def _each(entry: Any, name: str, count: int) -> tuple[FloatArray, ...]:
    """Return a matrix at each vertex."""
    several = not isinstance(entry, np.ndarray) and len(entry) and np.ndim(entry[0]) == 2
    several = several or (isinstance(entry, np.ndarray) and entry.ndim == 3)
    if not several:
        return (as_matrix(entry, name),) * count
    matrices = tuple(as_matrix(matrix, name) for matrix in entry)
    if len(matrices) != count:
        raise SpecError(f"{name} is given at {len(matrices)} vertices, A at {count}.", path=name)
    return matrices

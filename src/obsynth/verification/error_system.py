r"""The error system of a shipped observer, from the plant and the realisation alone; what stored numbers add to it.

If ``Az V E + By C = V A``, ``Bu + By D = V B``, then ``e = V E x - z`` obeys ``e+ = Az e + (V b - By d) s`` for every
fault, disturbance or noise s that enters by b and d, and an output with ``Cz V E + Dy C = K``, ``Du + Dy D = 0`` is
``K x - Cz e + Dy d s`` (estimates that lag: past states appended).  Stored numbers miss a little: for any T, and T0
with ``T0 E = 0``, ``eps = z - T E x`` obeys

.. math::
    \varepsilon^+ = A_z \varepsilon + K x + U u + \ldots, \qquad
    \text{estimate} - G x = C_z \varepsilon + J x + L u + \ldots

    K = A_z T E + B_y C - T A, \quad U = B_u + B_y D - T B, \quad
    J = C_z T E + D_y C + T_0 A - G, \quad L = D_u + D_y D + T_0 B

with balls K, U, J, L, zero in exact arithmetic: `errors_per_unit` (`robust.md`, theorem 1, corrections 3 and 7).
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.scaling import balance_by_least_squares
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.proofs.balls import Ball, rounded_up
from obsynth.proofs.contraction import Contraction, prove_contraction
from obsynth.proofs.peak_sums import absolute_gains


@dataclass(frozen=True, eq=False)
class LaggedPlant:
    """A plant whose state holds the last ``lag`` states as well: ``[x(k); x(k-1); ...; x(k-lag)]``."""

    E: FloatArray
    A: FloatArray
    B: FloatArray
    C: FloatArray
    lag: int
    nx: int

    @classmethod
    def of(cls, plant: DescriptorSystem, lag: int) -> LaggedPlant:
        """Return ``plant`` with its last ``lag`` states appended."""
        if lag == 0:
            return cls(plant.E, plant.A, plant.B, plant.C, 0, plant.nx)
        nx, total = plant.nx, plant.nx * (lag + 1)
        e, a = np.eye(total), np.zeros((total, total))
        e[:nx, :nx], a[:nx, :nx] = plant.E, plant.A
        a[nx:, :-nx] = np.eye(total - nx)
        b = np.vstack([plant.B, np.zeros((total - nx, plant.nu))])
        c = np.hstack([plant.C, np.zeros((plant.ny, total - nx))])
        return cls(e, a, b, c, lag, nx)

    def input(self, matrix: FloatArray) -> FloatArray:
        """Return an input matrix ``(nx, *)`` padded for the appended states."""
        return np.vstack([matrix, np.zeros((self.nx * self.lag, matrix.shape[1]))]) if self.lag else matrix

    @property
    def oldest(self) -> FloatArray:
        """Selector ``(nx, nx (lag + 1))`` of the oldest state."""
        return np.hstack([np.zeros((self.nx, self.nx * self.lag)), np.eye(self.nx)])


@dataclass(frozen=True, eq=False)
class ErrorSystem:
    """The observer's error ``e = V E x - z``, its inputs ``V b - By d``, and what it does to the estimates.

    Outputs ``(C, Df, Dd, Dw)``: fault estimate or residual = ``-C e + Df f + Dd d + Dw w``; minus that for states.
    """

    Az: FloatArray
    fault: FloatArray
    disturbance: FloatArray
    noise: FloatArray
    fault_output: tuple[FloatArray, FloatArray, FloatArray, FloatArray]
    residual_output: tuple[FloatArray, FloatArray, FloatArray, FloatArray]
    state_output: tuple[FloatArray, FloatArray, FloatArray, FloatArray]

    @classmethod
    def of(
        cls,
        plant: DescriptorSystem,
        observer: LinearObserver,
        tracking: FloatArray,
        lag: int,
        algebraic: FloatArray | None = None,
    ) -> ErrorSystem:
        """Return the error system for a tracking map ``(nz, nx (lag + 1))``."""
        # Equations that the outputs add, ``algebraic (rows, nx)``: Cz V E + Dy C = K + algebraic A.
        lagged = LaggedPlant.of(plant, lag)

        def driven(b: FloatArray, d: FloatArray) -> FloatArray:
            return np.asarray(tracking @ lagged.input(b) - observer.By @ d)

        def output(rows: slice) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
            direct = observer.Dy[rows]
            added = np.zeros((len(direct), plant.nx)) if algebraic is None else algebraic[rows]
            seen = ((plant.Bf, plant.Df), (plant.Bd, plant.Dd), (plant.Bw, plant.Dw))
            fault, disturbance, noise = (direct @ d - added @ b for b, d in seen)
            return observer.Cz[rows], fault, disturbance, noise

        return cls(
            observer.Az, driven(plant.Bf, plant.Df), driven(plant.Bd, plant.Dd), driven(plant.Bw, plant.Dw),
            output(observer.fault_rows), output(observer.residual_rows), output(observer.state_rows),
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class TrackedPlant:
    """A plant as an observer sees it, and what each row of its output stands for."""

    E: FloatArray  # (ne, n)
    A: FloatArray  # (ne, n)
    B: FloatArray  # (ne, nu)
    C: FloatArray  # (ny, n)
    D: FloatArray  # (ny, nu)
    T: FloatArray  # (nz, ne)
    goal: FloatArray  # (rows, n)
    state_names: tuple[str, ...]
    T0: FloatArray | None = None  # (rows, ne)
    Bd: FloatArray | None = None  # (ne, nd), of the disturbances that are decoupled
    Dd: FloatArray | None = None  # (ny, nd)

    @classmethod
    def of(
        cls, plant: DescriptorSystem, tracking: FloatArray, goal: FloatArray, *, T0: FloatArray | None = None
    ) -> TrackedPlant:
        """Return a linear plant without decoupled disturbances."""
        return cls(plant.E, plant.A, plant.B, plant.C, plant.D, tracking, goal, plant.state_names, T0)

    def equals(self, other: TrackedPlant) -> bool:
        """Whether all numbers are the same."""
        pairs = ((getattr(self, field.name), getattr(other, field.name)) for field in fields(self))
        return all(a is b or (a is not None and b is not None and np.array_equal(a, b)) for a, b in pairs)


@dataclass(frozen=True, eq=False)
class RemainderChannel:
    """What the identities miss, as balls."""

    K: Ball  # (nz, n)
    U: Ball  # (nz, nu)
    J: Ball  # (rows, n)
    L: Ball  # (rows, nu)
    W: Ball  # (nz, nd), of decoupled disturbances
    V: Ball  # (rows, nd)

    def errors_per_unit(self, observer: LinearObserver, contraction: Contraction) -> tuple[FloatArray, ...]:
        """Return upper bounds on each output row's error for each state, input and disturbance always within one.

        ``sum_j |c Az^j k| + |direct|``, outward rounded; ``(rows, n)``, ``(rows, nu)``, ``(rows, nd)``.
        """
        pairs = ((self.K, self.J), (self.U, self.L), (self.W, self.V))
        rows = observer.fault_rows
        gains = absolute_gains(observer.Az, observer.Cz[rows], contraction)
        found = []
        for k, direct in pairs:
            bound = contraction.gain(observer.Cz, k.midpoint, k.radius)
            # The rows that matter most get a tighter one.
            bound[rows] = np.minimum(bound[rows], rounded_up(gains @ k.magnitude, 2 * observer.order + 4))
            found.append(np.asarray(rounded_up(bound + direct.magnitude, 2)))
        return tuple(found)

    def rounding(self, tracked: TrackedPlant, observer: LinearObserver) -> float:
        """Return how much K and J are at most of the largest terms of their rows, in natural units of the states."""
        size = np.abs
        units = np.ones(tracked.E.shape[1])
        if tracked.E.shape[0] == tracked.E.shape[1]:
            units = balance_by_least_squares(tracked.E, tracked.A, outputs=[tracked.C]).states
        te, c = size(tracked.T) @ size(tracked.E), size(tracked.C)
        formed = size(observer.Az) @ te + size(observer.By) @ c + size(tracked.T) @ size(tracked.A)
        shown = size(observer.Cz) @ te + size(observer.Dy) @ c + size(tracked.goal)
        if tracked.T0 is not None:
            shown = shown + size(tracked.T0) @ size(tracked.A)
        pairs = ((self.K.midpoint, formed), (self.J.midpoint, shown))
        largest = [(size(k) * units, np.max(terms * units, axis=1, initial=0.0, keepdims=True)) for k, terms in pairs]
        return max(float(np.max(k / np.where(row > 0.0, row, 1.0), initial=0.0)) for k, row in largest)


def remainder_channel(tracked: TrackedPlant, observer: LinearObserver) -> RemainderChannel:
    """Return what the identities of a shipped observer miss on a plant, in outward rounding."""
    exact = Ball.exact
    az, bu, by, cz, du, dy = (exact(getattr(observer, name)) for name in ("Az", "Bu", "By", "Cz", "Du", "Dy"))
    e, a, b, c, d, t = (exact(part) for part in (tracked.E, tracked.A, tracked.B, tracked.C, tracked.D, tracked.T))
    te = t @ e
    j, el = cz @ te + dy @ c - exact(tracked.goal), du + dy @ d
    bd = np.zeros((len(tracked.E), 0)) if tracked.Bd is None else tracked.Bd
    dd = np.zeros((len(tracked.C), bd.shape[1])) if tracked.Dd is None else tracked.Dd
    v = dy @ exact(dd)
    if tracked.T0 is not None and tracked.T0.any():
        t0 = exact(tracked.T0)
        j, el, v = j + t0 @ a, el + t0 @ b, v + t0 @ exact(bd)
        # What T0 E leaves is driven by the next state, which keeps the bounds of x, or by its rate, which has none.
        left = (t0 @ e).magnitude
        if left.any():
            j = Ball(j.midpoint, j.radius + (left if observer.dt > 0.0 else np.where(left > 0.0, np.inf, 0.0)))
    return RemainderChannel(az @ te + by @ c - t @ a, bu + by @ d - t @ b, j, el, by @ exact(dd) - t @ exact(bd), v)


def contraction_of(observer: LinearObserver) -> Contraction | None:
    """Return a proved contraction of a shipped observer's state, ``None`` where none is found."""
    return prove_contraction(observer.Az, discrete=observer.dt > 0.0)

r"""The identities of a shipped observer in its stored numbers: what they miss is one more channel, driven by x and u.

For the plant ``E x+ = A x + B u``, ``y = C x + D u`` (+ disturbances and faults) and the observer
``z+ = Az z + Bu u + By y``, ``estimate = Cz z + Du u + Dy y``, the error ``eps = z - T E x`` obeys, whatever T, T0 are,

.. math::
    \varepsilon^+ = A_z \varepsilon + K x + U u + \ldots, \qquad
    \text{estimate} - G x = C_z \varepsilon + J x + L u + \ldots

    K = A_z T E + B_y C - T A, \quad U = B_u + B_y D - T B, \quad
    J = C_z T E + D_y C + T_0 A - G, \quad L = D_u + D_y D + T_0 B

(``T0 E = 0``: algebraic rows, which an estimate may use).  In exact arithmetic K, U, J and L vanish; in stored numbers
each is a `Ball` around its rounded value.  What they drive stays within the bounds of `errors_per_unit`.
Source: `robust.md`, theorem 1, with the corrections 3 and 7.
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
class TrackedPlant:
    """A plant as an observer sees it, and what each row of its output stands for.

    Shapes: E, A ``(ne, n)``; B, Bd ``(ne, *)``; C ``(ny, n)``; D, Dd ``(ny, *)``; T ``(nz, ne)``; goal ``(rows, n)``;
    T0 ``(rows, ne)`` or ``None``.  Bd and Dd hold the disturbances from which the estimates are decoupled, if any.
    """

    E: FloatArray
    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray
    T: FloatArray
    goal: FloatArray
    state_names: tuple[str, ...]
    T0: FloatArray | None = None
    Bd: FloatArray | None = None
    Dd: FloatArray | None = None

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
    """What the identities miss, as balls: K ``(nz, n)``, U ``(nz, nu)``, J ``(rows, n)``, L ``(rows, nu)``.

    W ``(nz, nd)`` and V ``(rows, nd)`` are those of decoupled disturbances; without columns where there are none.
    """

    K: Ball
    U: Ball
    J: Ball
    L: Ball
    W: Ball
    V: Ball

    def errors_per_unit(self, observer: LinearObserver, contraction: Contraction) -> tuple[FloatArray, ...]:
        """Return upper bounds on the error of every output row per unit of each state, input and disturbance.

        For signals that stay within one at all times: ``sum_j |c Az^j k| + |direct|``, outward rounded.  Shapes
        ``(rows, n)``, ``(rows, nu)``, ``(rows, nd)``.
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

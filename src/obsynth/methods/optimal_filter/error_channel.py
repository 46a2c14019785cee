"""Inputs of the error of an optimal filter: the noise, and the faults where their map is not exact."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from obsynth.methods.optimal_filter.fault_maps import FaultMap
from obsynth.methods.optimal_filter.weights import Weights
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.decoupling_windows import Model
from obsynth.numerics.matrix_equations import continuous_lyapunov, discrete_lyapunov
from obsynth.proofs.balls import Ball
from obsynth.proofs.extended_balls import Enclosed
from obsynth.verification.error_system import ErrorModel

#: What passes directly to the error is rounding below so many bounds on the rounding of its terms.
ROUNDED_UNITS = 1e4
#: Of what noise could do at most, what stored numbers may leave where everything cancels.
ROUNDED_SHARE = 1e-6
#: A mean square that one step of refinement moves by more than this share of itself has lost its digits.
LOST_SHARE = 1e-3


@dataclass(frozen=True)
class ErrorChannel:
    """``e+ = a e + b v``, error ``c e + d v``, of the stored numbers, formed in any arithmetic.

    v: the noise, or the faults and the noise where ``matched`` is the reference model that the error is from, each
    before its weight; the error is behind its own, in units of ``unit``, a power of two.
    """

    model: ErrorModel
    matched: Model | None = None
    weights: Weights | None = None
    unit: float = 1.0

    @classmethod
    def of(cls, model: ErrorModel, fault_map: FaultMap) -> ErrorChannel:
        """Return that of a fault map, whose reference model is as late as the rows of the model."""
        matched = None if fault_map.exact else fault_map.behind_delay(model.later).reference
        return cls(model, matched, fault_map.weights)

    def in_units_of(self, gain: float) -> ErrorChannel:
        """Return the same with the error in units of a power of two near ``gain``."""
        return replace(self, unit=2.0 ** round(math.log2(gain)) if gain > 0.0 else 1.0)

    @property
    def order(self) -> int:
        """States of the error system."""
        order = self.model.observer.order + (0 if self.matched is None else len(self.matched[0]))
        return order + (0 if self.weights is None else self.weights.order)

    @property
    def input_weight(self) -> Model | None:
        """The weight of all that drives the error, faults first where they do; ``None`` where nothing is weighted."""
        weights, plant = self.weights, self.model.plant
        if weights is None or (weights.noise is None and weights.faults is None):
            return None
        inputs = [] if self.matched is None else [weights.faults or _identity(plant.nf)]
        inputs.append(weights.noise or _identity(plant.nw))
        a, b, c, d = (np.asarray(block_diag(*(part[i] for part in inputs)), dtype=np.float64) for i in range(4))
        return a, b, c, d

    @property
    def size(self) -> float:
        """What noise, and faults that pass by no exact map, could do to the error in a sample, whatever cancels."""
        model = self.model
        observer, plant = model.observer, model.plant
        driving, showing = (
            (plant.Bw, plant.Dw)
            if self.matched is None
            else (np.hstack([plant.Bf, plant.Bw]), np.hstack([plant.Df, plant.Dw]))
        )
        own = model.driven_at_most(driving) + np.abs(observer.By) @ np.abs(showing)
        direct = np.abs(observer.Dy) @ np.abs(showing)
        if model.T0 is not None:
            direct = direct + np.abs(model.T0[:, : plant.nx]) @ np.abs(driving)
        return float(np.linalg.norm(observer.Cz) * np.linalg.norm(own) + np.linalg.norm(direct))

    @property
    def middle(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """The matrices in double precision."""
        a, b, c, d = self(Ball)
        return a.midpoint, b.midpoint, c.midpoint, d.midpoint

    @property
    def rounding(self) -> float:
        """A deviation below this may be rounding of stored numbers: of such a one only an upper bound is claimed."""
        return ROUNDED_SHARE * self.size

    def deviation(self, dt: float) -> float:
        """Return the root mean square of the error for white noise of unit intensity; infinite where this passes.

        It is no number where rounding of the Lyapunov equation leaves no digits of it.
        """
        (a, b, c, d), direct = self.middle, self(Ball)[3]
        if dt == 0.0:
            # White noise that passes, by more than rounding, has no mean square.
            d = np.where(np.abs(d) > ROUNDED_UNITS * direct.radius, np.inf, 0.0)
        square, lost = 0.0, 0.0
        if len(a):
            covariance, corrected = _covariances(a, b, dt)
            square = float(np.trace(c @ corrected @ c.T))
            lost = abs(square - float(np.trace(c @ covariance @ c.T)))
        if not lost <= max(LOST_SHARE * square, (self.rounding / self.unit) ** 2):
            return math.nan
        return float(np.sqrt(max(square, 0.0) + np.sum(d**2)))

    def __call__(self, kind: type[Enclosed]) -> tuple[Enclosed, Enclosed, Enclosed, Enclosed]:
        """Return the matrices with what forming them may have cost."""
        a, b, c, d = self._weighted(kind)
        return a, b, c.scaled(1.0 / self.unit), d.scaled(1.0 / self.unit)

    def _weighted(self, kind: type[Enclosed]) -> tuple[Enclosed, Enclosed, Enclosed, Enclosed]:
        system, weights = self._unweighted(kind), self.weights
        if weights is None:
            return system
        if (before := self.input_weight) is not None:
            system = _in_series(kind, tuple(kind.exact(part) for part in before), system)
        if weights.errors is not None:
            system = _in_series(kind, system, tuple(kind.exact(part) for part in weights.errors))
        return system

    def _unweighted(self, kind: type[Enclosed]) -> tuple[Enclosed, Enclosed, Enclosed, Enclosed]:
        model, exact = self.model, kind.exact
        observer, plant = model.observer, model.plant
        t, by, dy = exact(model.own), exact(observer.By), exact(observer.Dy)
        t0 = exact(np.zeros((len(observer.Cz), plant.nx)) if model.T0 is None else model.T0[:, : plant.nx])

        def driven(inner: FloatArray, direct: FloatArray) -> tuple[Any, Any]:
            b, d = exact(inner), exact(direct)
            return t @ b - by @ d, t0 @ b + dy @ d

        def zero(rows: int, columns: int) -> Any:
            return exact(np.zeros((rows, columns)))

        (noise, through), a, c = driven(plant.Bw, plant.Dw), exact(observer.Az), -exact(observer.Cz)
        if self.matched is None:
            return a, noise, c, through
        fault, direct_fault = driven(plant.Bf, plant.Df)
        ar, br, cr, dr = (exact(part) for part in self.matched)
        n, k = observer.order, len(self.matched[0])
        return (
            kind.blocks([[a, zero(n, k)], [zero(k, n), ar]]),
            kind.blocks([[fault, noise], [br, zero(k, plant.nw)]]),
            kind.blocks([[c, -cr]]),
            kind.blocks([[direct_fault - dr, through]]),
        )


def _covariances(a: FloatArray, b: FloatArray, dt: float) -> tuple[FloatArray, FloatArray]:
    """Return the covariance of states that unit white noise drives, and the same refined once by its residual."""
    driven = b @ b.T
    with warnings.catch_warnings(action="ignore"):
        if dt > 0.0:
            covariance = discrete_lyapunov(a, driven)
            step = discrete_lyapunov(a, a @ covariance @ a.T - covariance + driven)
        else:
            covariance = continuous_lyapunov(a, -driven)
            step = continuous_lyapunov(a, -(a @ covariance + covariance @ a.T + driven))
    return covariance, covariance + step


def _identity(count: int) -> Model:
    none = np.zeros((0, 0))
    return none, np.zeros((0, count)), np.zeros((count, 0)), np.eye(count)


def _in_series(kind: type[Enclosed], first: Any, second: Any) -> tuple[Enclosed, Enclosed, Enclosed, Enclosed]:
    """Return ``second`` behind ``first``, with what forming it may have cost."""
    (a1, b1, c1, d1), (a2, b2, c2, d2) = first, second
    nothing = kind.exact(np.zeros((a1.shape[0], a2.shape[0])))
    return (
        kind.blocks([[a1, nothing], [b2 @ c1, a2]]),
        kind.blocks([[b1], [b2 @ d1]]),
        kind.blocks([[d2 @ c1, c2]]),
        d2 @ d1,
    )

"""What drives the error of an optimal filter: the noise, and the faults where these pass by no exact map."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.decoupling_windows import Model
from obsynth.proofs.balls import Ball
from obsynth.proofs.extended_balls import Enclosed
from obsynth.verification.error_system import ErrorModel


@dataclass(frozen=True)
class ErrorChannel:
    """``e+ = a e + b v``, error ``c e + d v``, of the stored numbers, formed in any arithmetic.

    v: the noise, or the faults and the noise where ``matched`` is the reference model that the error is from; the
    error is in units of ``unit``, a power of two.
    """

    model: ErrorModel
    matched: Model | None = None
    unit: float = 1.0

    def in_units_of(self, gain: float) -> ErrorChannel:
        """Return the same with the error in units of a power of two near ``gain``."""
        return replace(self, unit=2.0 ** round(math.log2(gain)) if gain > 0.0 else 1.0)

    @property
    def order(self) -> int:
        """States of the error system."""
        return self.model.observer.order + (0 if self.matched is None else len(self.matched[0]))

    @property
    def middle(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """The matrices in double precision."""
        a, b, c, d = self(Ball)
        return a.midpoint, b.midpoint, c.midpoint, d.midpoint

    def __call__(self, kind: type[Enclosed]) -> tuple[Enclosed, Enclosed, Enclosed, Enclosed]:
        """Return the matrices with what forming them may have cost."""
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
            return a, noise, c.scaled(1.0 / self.unit), through.scaled(1.0 / self.unit)
        fault, seen = driven(plant.Bf, plant.Df)
        ar, br, cr, dr = (exact(part) for part in self.matched)
        n, k = observer.order, len(self.matched[0])
        return (
            kind.blocks([[a, zero(n, k)], [zero(k, n), ar]]),
            kind.blocks([[fault, noise], [br, zero(k, plant.nw)]]),
            kind.blocks([[c, -cr]]).scaled(1.0 / self.unit),
            kind.blocks([[seen - dr, through]]).scaled(1.0 / self.unit),
        )

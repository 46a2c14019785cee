r"""The error system of a shipped observer, from the plant and the realisation alone.

For the plant ``E x+ = A x + B u + b s``, ``y = C x + D u + d s`` (s a fault, disturbance or noise) and the observer
``z+ = Az z + Bu u + By y``, suppose a tracking map V satisfies

    Az V E + By C = V A,   Bu + By D = V B.

Then ``e = V E x - z`` obeys ``e+ = Az e + (V b - By d) s``, whatever x, u and s do.  An output ``Cz z + Du u + Dy y``
that satisfies ``Cz V E + Dy C = K`` and ``Du + Dy D = 0`` equals ``K x - Cz e + Dy d s``.  Estimates that lag by some
samples are covered by appending the past states to the plant.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from obsynth.models.descriptor import DescriptorSystem
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.scaling import balance_by_least_squares
from obsynth.observers.linear import LinearObserver


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
        nx, total = plant.nx, plant.nx * (lag + 1)
        e, a = np.eye(total), np.zeros((total, total))
        e[:nx, :nx], a[:nx, :nx] = plant.E, plant.A
        a[nx:, :-nx] = np.eye(total - nx)
        b = np.vstack([plant.B, np.zeros((total - nx, plant.nu))])
        c = np.hstack([plant.C, np.zeros((plant.ny, total - nx))])
        return cls(e, a, b, c, lag, nx)

    def input(self, matrix: FloatArray) -> FloatArray:
        """Return an input matrix ``(nx, *)`` padded for the appended states."""
        return np.vstack([matrix, np.zeros((self.nx * self.lag, matrix.shape[1]))])

    @property
    def oldest(self) -> FloatArray:
        """Selector ``(nx, nx (lag + 1))`` of the oldest state."""
        return np.hstack([np.zeros((self.nx, self.nx * self.lag)), np.eye(self.nx)])


@dataclass(frozen=True, eq=False)
class Residual:
    """How far an identity is from holding: largest entry, and the size of the terms it is made of."""

    error: float
    scale: float

    @property
    def relative(self) -> float:
        """The error in units of its terms."""
        return self.error / self.scale if self.scale > 0.0 else self.error


def residual(
    *terms: FloatArray, factors: tuple[tuple[FloatArray, ...], ...] = (), units: FloatArray | None = None
) -> Residual:
    """Return the residual of ``terms[0] + terms[1] + ... = 0``: the entry that is worst beside what it is made of.

    The scale counts what the terms and the products inside them (``factors``) could contribute to rounding, largest
    entry of each row.  ``units`` are the sizes of the columns' signals: multiplied by them, entries of one row compare.
    """
    total = sum(terms[1:], start=terms[0].copy())
    if total.size == 0:
        return Residual(0.0, 1.0)
    size = sum((np.abs(term) for term in terms), start=np.zeros_like(total))
    for product in factors:
        bound = np.abs(product[0])
        for factor in product[1:]:
            bound = bound @ np.abs(factor)
        size = size + bound
    if not np.all(np.isfinite(total)) or not np.all(np.isfinite(size)):
        return Residual(float("nan"), 1.0)
    columns = np.ones(total.shape[1]) if units is None else units
    rows = np.max(size * columns, axis=1, keepdims=True)
    scale = np.where(rows > 0.0, rows, 1.0) / columns
    worst = np.unravel_index(int(np.argmax(np.abs(total) / scale)), total.shape)
    return Residual(float(np.abs(total[worst])), float(scale[worst]))


@dataclass(frozen=True, eq=False)
class ErrorSystem:
    """The observer's error ``e = V E x - z`` and what it does to the estimates.

    Parameters
    ----------
    Az : FloatArray
        ``(nz, nz)``.
    fault, disturbance, noise : FloatArray
        Inputs of the error ``V b - By d``: ``(nz, nf)``, ``(nz, nd)``, ``(nz, nw)``.
    fault_output, residual_output : tuple of FloatArray
        ``(Cf, Df, Dd, Dw)``: fault estimate (residual) = ``-Cf e + Df f + Dd d + Dw w``.
    state_output : tuple of FloatArray
        ``(Cx, Df, Dd, Dw)``: state error = ``Cx e - Df f - Dd d - Dw w``.
    """

    Az: FloatArray
    fault: FloatArray
    disturbance: FloatArray
    noise: FloatArray
    fault_output: tuple[FloatArray, FloatArray, FloatArray, FloatArray]
    residual_output: tuple[FloatArray, FloatArray, FloatArray, FloatArray]
    state_output: tuple[FloatArray, FloatArray, FloatArray, FloatArray]

    @classmethod
    def of(cls, plant: DescriptorSystem, observer: LinearObserver, tracking: FloatArray, lag: int) -> ErrorSystem:
        """Return the error system of ``observer`` on ``plant``, given the tracking map ``(nz, nx (lag + 1))``."""
        lagged = LaggedPlant.of(plant, lag)

        def driven(b: FloatArray, d: FloatArray) -> FloatArray:
            return np.asarray(tracking @ lagged.input(b) - observer.By @ d)

        def output(rows: slice) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
            direct = observer.Dy[rows]
            return observer.Cz[rows], direct @ plant.Df, direct @ plant.Dd, direct @ plant.Dw

        return cls(
            observer.Az,
            driven(plant.Bf, plant.Df),
            driven(plant.Bd, plant.Dd),
            driven(plant.Bw, plant.Dw),
            output(observer.fault_rows),
            output(observer.residual_rows),
            output(observer.state_rows),
        )


def tracking_residuals(
    plant: DescriptorSystem, observer: LinearObserver, tracking: FloatArray, lag: int
) -> dict[str, Residual]:
    """Return the residuals of the identities that make the observer unbiased without faults and disturbances."""
    lagged = LaggedPlant.of(plant, lag)
    ve = tracking @ lagged.E
    states, cz, dy, du = observer.state_rows, observer.Cz, observer.Dy, observer.Du
    # A state in small units must not hide behind one in large units.
    units = np.tile(balance_by_least_squares(plant.E, plant.A, outputs=[plant.C]).states, lag + 1)

    # An observer state that tracks nothing but a sensor fault cancels what it is formed of down to rounding.
    formed = np.abs(tracking) @ np.abs(lagged.A) + np.abs(observer.By) @ np.abs(lagged.C)

    def unseen(rows: slice) -> Residual:
        factors = ((cz[rows], tracking, lagged.E), (dy[rows], lagged.C), (cz[rows], formed))
        return residual(cz[rows] @ ve, dy[rows] @ lagged.C, factors=factors, units=units)

    return {
        "dynamics": residual(
            observer.Az @ ve,
            observer.By @ lagged.C,
            -tracking @ lagged.A,
            factors=((observer.Az, tracking, lagged.E), (observer.By, lagged.C), (tracking, lagged.A)),
            units=units,
        ),
        "inputs": residual(
            observer.Bu,
            observer.By @ plant.D,
            -tracking @ lagged.B,
            factors=((observer.By, plant.D), (tracking, lagged.B)),
        ),
        "state estimate": residual(
            cz[states] @ ve,
            dy[states] @ lagged.C,
            -lagged.oldest,
            factors=((cz[states], tracking, lagged.E), (dy[states], lagged.C)),
            units=units,
        ),
        "fault estimate": unseen(observer.fault_rows),
        "residual": unseen(observer.residual_rows),
        "input feedthrough": residual(du, dy @ plant.D, factors=((dy, plant.D),)),
    }

"""The shipped observer of a functional filter, and the matrices T and T0 that prove it.

eps = z - T E x obeys ``eps+ = Az eps + (By Df - T Bf) f``, ``estimates = Cz eps + (Dy Df - T0 Bf) f`` when
``Az T E + By C = T A``, ``By Dd = T Bd``, ``Bu + By D = T B``, ``T0 E = 0``, ``Cz T E + Dy C = T0 A``,
``Dy Dd = T0 Bd``, ``Du + Dy D = T0 B``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import flint
import numpy as np
from scipy.linalg import block_diag, schur

from obsynth.methods.functional_filter.kalman_gain import FilterModel, KalmanGain
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.ranks import CANCELLATION_TOLERANCE, product_but_rounding
from obsynth.numerics.scaling import balanced_matrix
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.proofs.extended_balls import arb_matrix
from obsynth.proofs.products import EXPONENTIAL_BITS, as_ball

#: A matrix larger than its eigenvalues by this is given in coordinates in which it is triangular.
FAR_FROM_NORMAL = 1e3


@dataclass(frozen=True, eq=False)
class OutputRows:
    """``C z + D v`` with v = [u; y], and what these rows are of the plant's equations, T0 ``(rows, nx)``.

    C may have fewer columns than there are states: the first ones.  The dynamics of a filter are rows as well, those of
    the next state: C is A, D is B, and T0 is T.
    """

    C: FloatArray
    D: FloatArray
    T0: FloatArray

    def of_order(self, order: int) -> FloatArray:
        """Return C for so many states."""
        return np.hstack([self.C, np.zeros((len(self.C), order - self.C.shape[1]))])

    def plus(self, other: OutputRows) -> OutputRows:
        """Return the sum."""
        order = max(self.C.shape[1], other.C.shape[1])
        return OutputRows(self.of_order(order) + other.of_order(order), self.D + other.D, self.T0 + other.T0)

    def times(self, matrix: FloatArray) -> OutputRows:
        """Return combinations of the rows; where only rounding is left, there is nothing."""
        return OutputRows(
            product_but_rounding(matrix, self.C),
            product_but_rounding(matrix, self.D),
            product_but_rounding(matrix, self.T0),
        )


@dataclass(frozen=True, eq=False)
class FilterPart:
    """A filter for some faults, or for states: its dynamics, rows that estimate them, and residuals; ``delay`` in
    samples."""

    dynamics: OutputRows
    estimates: OutputRows
    residuals: OutputRows
    faults: tuple[int, ...]
    delay: int
    states: tuple[int, ...] = ()


def filter_part(
    model: FilterModel, gain: KalmanGain, residual_map: FloatArray, *, delay: int, mean: int, triangular: bool = False
) -> FilterPart:
    """Return the filter of a gain, with a delay in samples; ``residual_map (rows, p)``: residuals from innovations.

    ``triangular``: in coordinates in which its matrix is so, even where its entries are small."""
    sizes = np.sqrt(np.maximum(np.diag(gain.innovation), 0.0))
    gain = replace(
        gain, K=_without_rounding(gain.K, sizes), lag=tuple(_without_rounding(part, sizes) for part in gain.lag)
    )
    residual_map = _without_rounding(residual_map, sizes)
    parts = (model.A, -model.C), (model.B, model.L), (model.T, model.T0)
    dynamics = OutputRows(*(product_but_rounding(gain.K, fed_back, own) for own, fed_back in parts))
    innovation = OutputRows(-model.C, model.L, model.T0)
    count, nx = len(model.estimate), model.T.shape[1]
    row = OutputRows(model.estimate, np.zeros((count, model.L.shape[1])), np.zeros((count, nx)))
    coordinates = _plain_coordinates(dynamics.C, 0.0 if triangular else FAR_FROM_NORMAL)
    if coordinates is not None:
        dynamics = _rounded_once(model, gain, coordinates)
        innovation, row = (OutputRows(r.C @ coordinates, r.D, r.T0) for r in (innovation, row))
    corrections = [innovation.times(model.estimate @ part) for part in gain.lag]
    if corrections:
        row = row.plus(corrections[0])
    for correction in corrections[1:]:
        dynamics, row = _registered(dynamics, row)
        row = row.plus(correction)
    row, total = row, row
    for _ in range(mean - 1):
        dynamics, row = _registered(dynamics, row)
        total = total.plus(row)
    estimates = total.times(np.eye(count) / mean) if mean > 1 else total
    return FilterPart(dynamics, estimates, innovation.times(residual_map), model.faults, delay + (mean - 1) // 2)


def _without_rounding(gain: FloatArray, sizes: FloatArray) -> FloatArray:
    """Return a gain ``(rows, p)`` of innovations of some sizes without what only rounding put into its rows.

    A gain may be any number: of zero the identities of the filter hold exactly, of rounding they hold to all of it.
    """
    share = np.abs(gain) * np.where(sizes > 0.0, sizes, 1.0)
    return np.where(share > CANCELLATION_TOLERANCE * np.max(share, axis=1, initial=0.0, keepdims=True), gain, 0.0)


def _plain_coordinates(a: FloatArray, most: float) -> FloatArray | None:
    """Return coordinates in which A has entries as small as its eigenvalues (balanced real Schur); ``None``: it is at
    ``most`` so many times as large already."""
    if not len(a) or not np.all(np.isfinite(a)):
        return None
    largest = float(np.max(np.abs(np.linalg.eigvals(a))))
    if np.linalg.norm(balanced_matrix(a)[0], 2) <= most * largest:
        return None
    triangular, turn = schur(a, output="real")
    return np.asarray(turn * balanced_matrix(triangular)[1])


def _rounded_once(model: FilterModel, gain: KalmanGain, coordinates: FloatArray) -> OutputRows:
    """Return the dynamics in other coordinates; with digits to spare, for the small rows of entries that cancel."""
    with flint.ctx.workprec(EXPONENTIAL_BITS):
        k, basis = arb_matrix(gain.K), arb_matrix(coordinates)
        back = basis.inv()
        parts = ((model.A, -model.C), (model.B, model.L), (model.T, model.T0))
        a, b, t = (back * (arb_matrix(own) + k * arb_matrix(fed_back)) for own, fed_back in parts)
        return OutputRows(*(as_ball(part).midpoint for part in (a * basis, b, t)))


def _registered(dynamics: OutputRows, row: OutputRows) -> tuple[OutputRows, OutputRows]:
    """Return the dynamics with states that hold the last value of ``row``, and the rows that read them."""
    order, count = len(dynamics.C), len(row.C)
    more = OutputRows(
        np.block([[dynamics.C, np.zeros((order, count))], [row.of_order(order), np.zeros((count, count))]]),
        np.vstack([dynamics.D, row.D]),
        np.vstack([dynamics.T0, row.T0]),
    )
    read = np.hstack([np.zeros((count, order)), np.eye(count)])
    return more, OutputRows(read, np.zeros_like(row.D), np.zeros_like(row.T0))


def assembled(
    plant: DescriptorSystem, parts: Sequence[FilterPart], residual_names: Sequence[str]
) -> tuple[LinearObserver, FloatArray, FloatArray]:
    """Return the observer of several filters side by side, with T ``(nz, nx)`` and T0 ``(rows, nx)``."""
    nu, nx = plant.nu, plant.nx
    a = block_diag(*(part.dynamics.C for part in parts)) if parts else np.zeros((0, 0))
    b = _stacked([part.dynamics.D for part in parts], nu + plant.ny)
    states = [state for part in parts for state in part.states]
    faults = [(fault, part.delay) for part in parts for fault in part.faults if len(part.estimates.C)]
    # The filter of states comes first: so do its rows.
    order = sorted(range(len(faults)), key=lambda i: faults[i][0])
    rows = [*range(len(states)), *(len(states) + i for i in order)]
    orders = [len(part.dynamics.C) for part in parts]
    estimate = _side_by_side([part.estimates for part in parts], orders, nu + plant.ny, nx)
    residual = _side_by_side([part.residuals for part in parts], orders, nu + plant.ny, nx)
    cz, d, t0 = (
        np.vstack([mine[rows], other])
        for mine, other in ((estimate.C, residual.C), (estimate.D, residual.D), (estimate.T0, residual.T0))
    )
    observer = LinearObserver(
        Az=a,
        Bu=b[:, :nu],
        By=b[:, nu:],
        Cz=cz,
        Du=d[:, :nu],
        Dy=d[:, nu:],
        dt=plant.dt,
        input_names=plant.input_names,
        output_names=plant.output_names,
        state_names=tuple(plant.state_names[state] for state in states),
        fault_names=tuple(plant.fault_names[faults[i][0]] for i in order),
        residual_names=tuple(residual_names),
        state_delays=(0,) * len(states),
        fault_delays=tuple(faults[i][1] for i in order),
    )
    return observer, _stacked([part.dynamics.T0 for part in parts], nx), t0


def _side_by_side(outputs: Sequence[OutputRows], orders: Sequence[int], inputs: int, nx: int) -> OutputRows:
    """Return the rows of several filters, each reading its own states."""
    own = [rows.of_order(order) for rows, order in zip(outputs, orders, strict=True)]
    c = block_diag(*own) if own else np.zeros((0, 0))
    return OutputRows(c, _stacked([rows.D for rows in outputs], inputs), _stacked([rows.T0 for rows in outputs], nx))


def _stacked(matrices: Sequence[FloatArray], width: int) -> FloatArray:
    return np.vstack([np.zeros((0, width)), *matrices])

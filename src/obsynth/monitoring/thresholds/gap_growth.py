"""Growth of a pointwise bound after missing outputs, which the plant's model has predicted.

At the last complete row the states and faults of the model have the error ``zeta = S e + S_q q`` with inputs q of the
plant, each at most one.  After j rows without outputs their error is ``M^j zeta - sum M^l [Bq; 0] q`` with ``M = [A Bf;
0 I]``.  The predicted outputs then have the error ``delta = [C Df] (...) - Dq q``, and ``e+ = A e + ... - By delta``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from obsynth.monitoring.thresholds.monitor import LinearSample, Sample
from obsynth.monitoring.thresholds.residual_model import ResidualModel
from obsynth.numerics.arrays import FloatArray, largest_singular_value
from obsynth.verification.error_system import ErrorModel

#: Rounding up to which the states count as determined by the observer's states and the outputs.
SOLVED_SHARE = 1e-9

#: Largest length of an interval, in units of 1 / norm of A, over which a slope is bounded at once.
SLOPE_PIECE = 0.1

#: Largest number of columns of the error; more are replaced by a box that contains them.
MOST_APART = 200

#: Errors by a gap below this share of the error without a gap are rounding of the threshold.
GAP_ROUNDING = 2.0**-52


class GapState(NamedTuple):
    """The effect of missing outputs on the error: the sum of ``columns (n, any)``, each times at most one."""

    columns: FloatArray
    begun: FloatArray  # the columns at the last complete row
    age: int = 0  # number of rows since then


class GapGrowth:
    """The addition to the pointwise bound of a sampled design by missing outputs."""

    def __init__(self, errors: ErrorModel, model: ResidualModel, sizes: FloatArray, factor: float) -> None:
        plant, observer = errors.plant, errors.observer
        self._A, self._By, self._C = model.A, observer.By, model.C
        held, direct = _disturbances(model, errors, sizes)
        self._Bq = np.hstack([held, factor * plant.Bw])
        self._Dq = np.hstack([direct, factor * plant.Dw])
        self._S, self._Sq = _stand_in(errors, self._Bq, self._Dq)
        nx, nf = plant.nx, plant.nf
        self._M = np.block([[plant.A, plant.Bf], [np.zeros((nf, nx)), np.eye(nf)]])
        self._H = np.hstack([plant.C, plant.Df])
        powers, driven = model.powers(), errors.driven_by(self._Bq, self._Dq)
        self._last = powers[-1] @ model.A
        self._impulses = np.hstack([power @ driven for power in powers]) if len(model.A) else np.zeros((0, 0))
        self._powers, self._aged = np.stack(powers), float(np.linalg.norm(self._last @ driven, axis=0).sum())
        contraction = largest_singular_value(self._last)
        self._aged /= 1.0 - contraction
        self._size = np.abs(self._impulses).sum(axis=1) if self._impulses.size else np.zeros(len(model.A))
        # By age: bounds on the errors of the predicted outputs, and their dependence on e at the last complete row.
        self._misses: list[FloatArray] = [np.abs(self._Dq).sum(axis=1)]
        self._maps: list[FloatArray] = [np.zeros((plant.ny, len(model.A)))]
        self._power, self._drift = np.eye(nx + nf), np.zeros(plant.ny)
        # Lagging state estimates belong to earlier rows, from which the model starts.
        for _ in range(max(observer.state_delays, default=0)):
            self._further()

    def start(self) -> GapState:
        """Return the state before the first missing output."""
        nothing = np.zeros((len(self._A), 0))
        return GapState(nothing, nothing)

    def missed(self, age: int) -> tuple[FloatArray, FloatArray]:
        """Return bounds ``(ny,)`` on the errors of predicted outputs ``age`` rows after a complete row, and their
        dependence ``(ny, n)`` on the error at that row."""
        while len(self._misses) <= age:
            self._further()
            reading = self._H @ self._power
            on_errors = reading @ self._S
            reach = np.abs(on_errors @ self._impulses).sum(axis=1) if self._impulses.size else np.zeros(len(reading))
            # Inputs that are older than all stored powers, as in `unlimited_bound`.
            older = np.linalg.norm(np.einsum("ij,kjl->kil", on_errors, self._powers), axis=2).sum(axis=0) * self._aged
            own = np.abs(reading @ self._Sq).sum(axis=1)
            self._misses.append(reach + older + own + self._drift + self._misses[0])
            self._maps.append(on_errors)
        return self._misses[age], self._maps[age]

    def _further(self) -> None:
        driven = self._power[:, : len(self._Bq)] @ self._Bq
        self._drift = self._drift + np.abs(self._H @ driven).sum(axis=1)
        self._power = self._M @ self._power

    def after(self, state: GapState, sample: Sample) -> tuple[GapState, float]:
        """Return the state after a row, and the addition by earlier gaps to the norm of the watched signals."""
        for _ in range(sample.skipped):
            state = self._without(state, np.ones(len(self._H), dtype=bool))
        grown = float(np.linalg.norm(self._C @ state.columns, axis=0).sum())
        outputs = (
            sample.observation.outputs
            if isinstance(sample.observation, LinearSample)
            else np.full(len(self._H), np.nan)
        )
        return self._without(state, np.isnan(outputs)), grown

    def _without(self, state: GapState, missing: np.ndarray) -> GapState:
        """Return the state after a row in which some outputs are missing, or none."""
        columns = self._A @ state.columns
        if not missing.any():
            return GapState(self._kept(columns), state.columns, 0)
        age = state.age + 1
        bound, per_error = self.missed(age)
        bound = bound + np.abs(per_error @ state.begun).sum(axis=1)
        new = self._By[:, missing] * bound[missing]
        return GapState(self._kept(np.hstack([columns, new])), state.begun, age)

    def _kept(self, columns: FloatArray) -> FloatArray:
        """Return columns with the same or a larger effect: none if all are rounding, and at most `MOST_APART`."""
        sizes = np.abs(columns).sum(axis=1)
        if (sizes <= GAP_ROUNDING * self._size).all():
            return columns[:, :0]
        return columns if columns.shape[1] <= MOST_APART else np.diag(sizes)


def _disturbances(model: ResidualModel, errors: ErrorModel, sizes: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the effects of disturbances on the states in a sample, ``(nx, any)``, and on the outputs, ``(ny, any)``.

    Disturbances may change arbitrarily between samples.  The mean over the interval and the value at the sample are
    separate inputs: the first acts on the states, the second on the outputs.  The remaining effect on the states is
    ``int (e^(A s) b - mean) d ds``, at most ``L h^2 / 3`` with the largest slope L of ``e^(A s) b`` in each state.
    States after those of the continuous plant are delayed outputs, on which the value at the sample acts.
    """
    plant, sampled = errors.plant, model.sampled
    if sampled is None:
        return plant.Bd * sizes, plant.Dd * sizes
    a, h, n = sampled.plant.A, sampled.dt, sampled.plant.nx
    count = max(1, int(np.ceil(np.abs(a).sum(axis=1).max(initial=0.0) * h / SLOPE_PIECE)))
    from scipy.linalg import expm

    step, wider = expm(a * h / count), expm(np.abs(a) * h / count)
    slope, largest = a @ sampled.plant.Bd, np.zeros((n, plant.nd))
    for _ in range(count):
        largest, slope = np.maximum(largest, wider @ np.abs(slope)), step @ slope
    mean, value, deviation = plant.Bd * sizes, plant.Bd * sizes, np.zeros((plant.nx, n))
    mean[n:], value[:n], deviation[:n] = 0.0, 0.0, np.diag((largest @ sizes) * h**2 / 3.0)
    outputs = np.zeros((plant.ny, plant.nd)), plant.Dd * sizes, np.zeros((plant.ny, n))
    return np.hstack([mean, value, deviation]), np.hstack(outputs)


def _stand_in(errors: ErrorModel, Bq: FloatArray, Dq: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the errors of the states that the model starts from and of the held faults, per error and input."""
    plant, observer = errors.plant, errors.observer
    estimated = [plant.fault_names.index(name) for name in observer.fault_names]

    def off(rows: slice) -> tuple[FloatArray, FloatArray]:
        added = 0.0 if errors.T0 is None else errors.T0[rows, : plant.nx] @ Bq
        return -observer.Cz[rows], observer.Dy[rows] @ Dq + added

    fault_e, fault_q = np.zeros((plant.nf, observer.order)), np.zeros((plant.nf, Bq.shape[1]))
    fault_e[estimated], fault_q[estimated] = off(observer.fault_rows)
    if len(observer.state_names) == plant.nx:
        order = [plant.state_names.index(name) for name in observer.state_names]
        state_e, state_q = np.zeros((plant.nx, observer.order)), np.zeros((plant.nx, Bq.shape[1]))
        state_e[order], state_q[order] = off(observer.state_rows)
    else:
        into = np.linalg.pinv(np.vstack([errors.own @ plant.E, plant.C]))
        own, outputs = into[:, : observer.order], into[:, observer.order :]
        state_e = -own - outputs @ plant.Df @ fault_e
        state_q = outputs @ (Dq - plant.Df @ fault_q)
    return np.vstack([state_e, fault_e]), np.vstack([state_q, fault_q])


def gap_growth(model: ResidualModel, bounds: FloatArray, noise_bound: float | None) -> GapGrowth | str:
    """Return the growth of a pointwise bound by missing outputs, or the reason why it is unknown.

    ``bounds (nd,)`` are those of the disturbances.
    """
    errors = model.errors
    if model.continuous is not None:
        return "between samples of a continuous design the plant's model has no bound"
    plant, observer = errors.plant, errors.observer
    if not np.array_equal(plant.E, np.eye(plant.nx)):
        return "the plant has algebraic states"
    if observer.fault_names != plant.fault_names or len(set(observer.state_delays)) > 1:
        return "the observer does not estimate all faults, or not all states of the same row"
    moving = plant.Bd.any(axis=0) | plant.Dd.any(axis=0)
    if not np.isfinite(bounds[moving]).all():
        return "a disturbance that moves the plant has no bound"
    if len(observer.state_names) not in (0, plant.nx):
        return "the observer does not estimate all states"
    if not observer.state_names:
        if errors.T[:, plant.nx :].any():
            return "the observer follows earlier states"
        solved = np.vstack([errors.own @ plant.E, plant.C])
        gap = np.linalg.pinv(solved) @ solved - np.eye(plant.nx)
        if np.abs(gap).max(initial=0.0) > SOLVED_SHARE:
            return "the states that the plant's model starts from do not follow from the observer's"
    return GapGrowth(errors, model, np.where(moving, bounds, 0.0), 0.0 if noise_bound is None else noise_bound)

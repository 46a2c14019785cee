"""The complete transfer function from the faults, as a second route to the results of synthesis.

The error's response to an impulse is followed for one step more than the largest delay; zero from there on makes the
transfer complete. The equations (Wang 2015, eq. (23)) are run on unit vectors: ``x0 = z + N y``, ``z+ = T A x0 + L (y -
C x0) + T B u``, ``r = W (y - C x0)``, ``D u`` subtracted from y, and the state of age a corrected by ``(TA)^(rho_i - 1
- a) T f_i``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.scaling import Scaling
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.results.checks import Check
from obsynth.verification.error_system import ErrorModel, with_past
from obsynth.verification.identities import Identity, equality, worst

#: A trace of a fault in an observer state below this share of its largest one is held to be no trace.
UNREACHED_STATE = 1e-4

_SOURCE = "Wang 2015, eqs. (32), (44)"

#: The observer's matrices.
OBSERVER_MATRICES = ("Az", "Bu", "By", "Cz", "Du", "Dy")


def fault_identities(errors: ErrorModel, delays: tuple[int, ...]) -> dict[str, tuple[Identity, ...]]:
    """Return, per row of the report, the identities of the fault responses, one for each step."""
    cf, direct_fault = errors.fault_output[:2]
    cr, direct_residual = errors.residual_output[:2]
    cx, direct_state = errors.state_output[:2]
    traces = fault_traces(errors, delays)
    to_fault: list[tuple[FloatArray, ...]] = [(direct_fault,)]
    to_residual: list[tuple[FloatArray, ...]] = [(direct_residual,)]
    to_state: list[tuple[FloatArray, ...]] = [(direct_state,)]
    for step, trace in enumerate(traces[:-1], start=1):
        expected = np.diag([1.0 if delay == step else 0.0 for delay in delays])
        to_fault.append((-cf @ trace, -expected))
        to_residual.append((-cr @ trace, -expected))
        to_state.append((cx @ trace,))
    terms_by_row: dict[str, list[tuple[FloatArray, ...]]] = {
        "fault decoupled after its delay": [(traces[-1],)],
        "fault estimate": to_fault,
        "fault in the residual": to_residual,
        "no fault in the state estimate": to_state,
    }
    return {name: tuple(Identity(terms) for terms in steps) for name, steps in terms_by_row.items()}


def fault_traces(errors: ErrorModel, delays: tuple[int, ...]) -> list[FloatArray]:
    """Return the error states ``(nz, nf)`` one sample after a fault impulse, two samples after it, and so on."""
    traces = [errors.fault]
    for _ in range(max(delays, default=1)):
        traces.append(errors.Az @ traces[-1])
    return traces


def fault_rows(
    plant: DescriptorSystem,
    observer: LinearObserver,
    tracking: FloatArray,
    errors: ErrorModel,
    scaling: Scaling | None,
    allowances: Mapping[str, FloatArray],
) -> Iterator[Check]:
    """Yield the rows on the transfer from the faults."""
    sizes = _trace_sizes(plant, observer, tracking, fault_traces(errors, observer.fault_delays), scaling)
    delays = ", ".join(map(str, observer.fault_delays))
    claims = {
        "fault decoupled after its delay": "(TA - LC) Psi = 0: a fault has no effect on the error after its delay",
        "fault estimate": f"fhat_i(k) = f_i(k - rho_i), rho = {delays} (W Upsilon = I)",
        "fault in the residual": "r(k) equals fhat(k)",
        "no fault in the state estimate": "the transfer from the faults to the state error is zero",
    }
    factors = {
        "fault decoupled after its delay": ((sizes,),),
        "fault estimate": ((errors.fault_output[0], sizes),),
        "fault in the residual": ((errors.residual_output[0], sizes),),
        "no fault in the state estimate": ((errors.state_output[0], sizes), (_in_state_units(sizes, plant.nx),)),
    }
    for name, steps in fault_identities(errors, observer.fault_delays).items():
        residuals = [
            replace(identity, factors=factors[name]).residual(allowances.get(step_key(name, step)))
            for step, identity in enumerate(steps)
        ]
        source = "ours: the paper's xhat is biased by Psi" if name.startswith("no fault") else _SOURCE
        yield equality(name, claims[name], worst(residuals), source)


def step_key(name: str, step: int) -> str:
    """Return the name of one step of a row among the allowances."""
    return f"{name}, step {step}"


def _trace_sizes(
    plant: DescriptorSystem,
    observer: LinearObserver,
    tracking: FloatArray,
    traces: list[FloatArray],
    scaling: Scaling | None,
) -> FloatArray:
    """Return the size of the terms from which traces were formed ``(nz, nf)``: Az is the difference of V A and By C."""
    lag = tracking.shape[1] // plant.nx - 1
    _, a, _, c = with_past(plant, lag)
    formed = np.abs(tracking) @ np.abs(a) + np.abs(observer.By) @ np.abs(c)
    sizes = np.abs(tracking[:, : plant.nx]) @ np.abs(plant.Bf) + np.abs(observer.By) @ np.abs(plant.Df)
    largest = _in_state_units(np.maximum(sizes, np.max(np.abs(traces), axis=0)), plant.nx)
    for trace in traces[:-1]:
        sizes = np.maximum(sizes, np.abs(observer.Az) @ np.abs(trace))
    sizes = np.maximum(sizes, formed @ np.tile(largest, (lag + 1, 1)))
    # A state that no fault reaches holds only rounding errors of the gains: it is not judged against itself but
    # against a small share of the fault's largest trace, in the units in which the plant is balanced.
    if scaling is None:
        return np.asarray(sizes)  # a failed existence condition says so already
    units = np.append(scaling.states, np.tile(scaling.states[: plant.nx], lag))
    units = np.resize(units, len(sizes))[:, None]
    return np.asarray(np.maximum(sizes, UNREACHED_STATE * units * np.max(sizes / units, axis=0)))


def _in_state_units(sizes: FloatArray, nx: int) -> FloatArray:
    """Return the leading rows ``(nx, nf)``: these observer states are in the units of the plant's states."""
    leading = np.zeros((nx, sizes.shape[1]))
    leading[: len(sizes)] = sizes[:nx]
    return leading


@dataclass(frozen=True, eq=False)
class Equations:
    """The matrices of the filter's equations; A, B, C, F are those of the plant with its sensor faults as states.

    ``nx``: states of the plant itself; ``delays``: ``rho_i``, 1 or more.
    """

    A: FloatArray
    B: FloatArray
    C: FloatArray
    F: FloatArray
    D: FloatArray
    nx: int
    delays: tuple[int, ...]

    @classmethod
    def of(cls, plant: DescriptorSystem, work: DescriptorSystem, delays: tuple[int, ...]) -> Equations:
        """Return the equations for ``plant``; ``work`` has its sensor faults as states."""
        return cls(work.A, work.B, work.C, work.Bf, plant.D, plant.nx, delays)

    @property
    def absolute(self) -> Equations:
        """The same with absolute values, for sizes."""
        a, b, c, f, d = (np.abs(part) for part in (self.A, self.B, self.C, self.F, self.D))
        return Equations(a, b, c, f, d, self.nx, self.delays)

    def detectability_matrix(self, gains: Mapping[str, FloatArray]) -> FloatArray:
        """Return Psi ``(na, nf)`` for the delays, columns ``(TA)^(rho_i - 1) T f_i``."""
        return self.moved(gains["T"], 0, rows=len(self.A))

    def moved(self, t: FloatArray, age: int, *, rows: int) -> FloatArray:
        """Return what each fault known now did to the first ``rows`` states of some age, per unit ``(rows, nf)``."""
        effects = np.zeros((rows, len(self.delays)))
        for i, delay in enumerate(self.delays):
            if delay > age:
                column = t @ self.F[:, i]
                for _ in range(delay - 1 - age):
                    column = t @ (self.A @ column)
                effects[:, i] = column[:rows]
        return effects

    def realised(self, gains: Mapping[str, FloatArray], *, minus: float = -1.0) -> dict[str, FloatArray]:
        """Return Az, Bu, By, Cz, Du and Dy of the filter."""
        t, n, feedback, w = (gains[letter] for letter in "TNLW")
        na, nx, ny, lag = len(self.A), self.nx, len(self.C), max(self.delays, default=1) - 1
        nz = na + lag * nx
        core, stored, u, y = np.split(np.eye(nz + self.B.shape[1] + ny), [na, nz, nz + self.B.shape[1]])
        measured = y + minus * (self.D @ u)
        x0 = core + n @ measured
        innovation = measured + minus * (self.C @ x0)
        residual = w @ innovation
        known = [x0[:nx], *np.split(stored, lag)] if lag else [x0[:nx]]
        states = [state + self.moved(t, age, rows=nx) @ residual for age, state in enumerate(known)]
        following = np.vstack([t @ (self.A @ x0) + feedback @ innovation + t @ (self.B @ u), *states[:-1]])
        outputs = np.vstack([states[-1], residual, residual])
        columns = [nz, nz + self.B.shape[1]]
        return dict(
            zip(
                OBSERVER_MATRICES,
                [*np.split(following, columns, axis=1), *np.split(outputs, columns, axis=1)],
                strict=True,
            )
        )

    def tracking(self, t: FloatArray) -> FloatArray:
        """Return the map V ``(nz, nx (lag + 1))`` that the observer's states track."""
        lag = max(self.delays, default=1) - 1
        na, older = len(self.A), lag * self.nx
        tracking_map = np.zeros((na + older, self.nx + older))
        tracking_map[:na, : self.nx] = t[:, : self.nx]
        tracking_map[na:, self.nx :] = np.eye(older)
        return tracking_map

"""The whole transfer from the faults: a pure delay to the fault estimate, nothing to the state error.

The error's response to a fault impulse is followed for one step more than the largest delay; that it is zero from
there on makes the response, and so the transfer function, complete.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.scaling import Scaling
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.results.checks import Check
from obsynth.verification.error_system import ErrorSystem, LaggedPlant
from obsynth.verification.identities import Identity, equality, worst

#: A trace of a fault in an observer state below this share of its largest one is held to be no trace.
UNREACHED = 1e-4
_SOURCE = "Wang 2015, eqs. (32), (44)"


def fault_identities(errors: ErrorSystem, delays: tuple[int, ...]) -> dict[str, tuple[Identity, ...]]:
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
    found: dict[str, list[tuple[FloatArray, ...]]] = {
        "fault decoupled after its delay": [(traces[-1],)],
        "fault estimate": to_fault,
        "fault in the residual": to_residual,
        "no fault in the state estimate": to_state,
    }
    return {name: tuple(Identity(terms) for terms in steps) for name, steps in found.items()}


def fault_traces(errors: ErrorSystem, delays: tuple[int, ...]) -> list[FloatArray]:
    """Return the error states ``(nz, nf)`` one sample after a fault impulse, two samples after it, and so on."""
    traces = [errors.fault]
    for _ in range(max(delays, default=1)):
        traces.append(errors.Az @ traces[-1])
    return traces


def fault_rows(
    plant: DescriptorSystem,
    observer: LinearObserver,
    tracking: FloatArray,
    errors: ErrorSystem,
    scaling: Scaling | None,
    allowances: Mapping[str, FloatArray],
) -> Iterator[Check]:
    """Yield the rows on the transfer from the faults."""
    sizes = _trace_sizes(plant, observer, tracking, fault_traces(errors, observer.fault_delays), scaling)
    delays = ", ".join(map(str, observer.fault_delays))
    claims = {
        "fault decoupled after its delay": "(TA - LC) Psi = 0: no trace of a fault in the error after its delay",
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
        found = [
            replace(identity, factors=factors[name]).residual(allowances.get(step_key(name, step)))
            for step, identity in enumerate(steps)
        ]
        source = "ours: the paper's xhat is biased by Psi" if name.startswith("no fault") else _SOURCE
        yield equality(name, claims[name], worst(found), source)


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
    """Return, per error state and fault, the size of the terms from which its traces were formed ``(nz, nf)``.

    What is left after a cancellation is judged against these terms: Az itself is the difference of V A and By C.
    """
    lagged = LaggedPlant.of(plant, tracking.shape[1] // plant.nx - 1)
    formed = np.abs(tracking) @ np.abs(lagged.A) + np.abs(observer.By) @ np.abs(lagged.C)
    sizes = np.abs(tracking) @ np.abs(lagged.input(plant.Bf)) + np.abs(observer.By) @ np.abs(plant.Df)
    largest = _in_state_units(np.maximum(sizes, np.max(np.abs(traces), axis=0)), plant.nx)
    for trace in traces[:-1]:
        sizes = np.maximum(sizes, np.abs(observer.Az) @ np.abs(trace))
    sizes = np.maximum(sizes, formed @ np.tile(largest, (lagged.lag + 1, 1)))
    # A state that no fault reaches holds only rounding errors of the gains: it is not judged against itself but
    # against a small share of the fault's largest trace, in the units in which the plant is balanced.
    if scaling is None:
        return np.asarray(sizes)  # a failed existence condition says so already
    units = np.append(scaling.states, np.tile(scaling.states[: plant.nx], lagged.lag))
    units = np.resize(units, len(sizes))[:, None]
    return np.asarray(np.maximum(sizes, UNREACHED * units * np.max(sizes / units, axis=0)))


def _in_state_units(sizes: FloatArray, nx: int) -> FloatArray:
    """Return the leading rows ``(nx, nf)``: these observer states are in the units of the plant's states."""
    leading = np.zeros((nx, sizes.shape[1]))
    leading[: len(sizes)] = sizes[:nx]
    return leading

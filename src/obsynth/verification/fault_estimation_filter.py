"""Checks of a fault-estimation filter, from the plant and the shipped realisation alone.

Source of the claims: Wang 2015, eqs. (7), (26), (32), (44), (45), (49); the corrected state estimate is ours.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from obsynth.analysis.fault_filter import with_sensor_faults_as_states
from obsynth.analysis.fault_filter_conditions import fault_filter_conditions
from obsynth.errors import PreconditionError
from obsynth.models.descriptor import DescriptorSystem
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.norms import hinf_norm, output_covariance, spectral_radius
from obsynth.numerics.scaling import balance_by_least_squares
from obsynth.observers.linear import LinearObserver
from obsynth.results.design import ObserverDesign
from obsynth.results.report import Check, information, upper_bound_check
from obsynth.verification.bounded_real import prove_bounded_real
from obsynth.verification.error_system import ErrorSystem, LaggedPlant, Residual, residual, tracking_residuals
from obsynth.verification.plant import condition_rows, plant_information

#: Equalities may miss by this much, relative to the terms they are made of.
EQUALITY_TOLERANCE = 1e-9
#: A trace of a fault in an observer state below this share of its largest one is held to be no trace.
UNREACHED = 1e-4
_IDENTITIES = {
    "dynamics": ("unbiased: dynamics", "Az V E + By C = V A", "Wang 2015, eqs. (7), (26)"),
    "inputs": ("unbiased: inputs", "Bu + By D = V B", "Wang 2015, eq. (23)"),
    "state estimate": (
        "unbiased: state",
        "the state estimate equals the state when the error is zero",
        "Wang 2015, eq. (7)",
    ),
    "fault estimate": ("unbiased: fault", "the fault estimate does not see the state", "Wang 2015, eq. (25)"),
    "residual": ("unbiased: residual", "the residual does not see the state", "Wang 2015, eq. (25)"),
    "input feedthrough": (
        "unbiased: feedthrough",
        "no estimate sees the input directly (Du + Dy D = 0)",
        "our extension",
    ),
}


def checks(design: ObserverDesign, printed_digits: int | None) -> Iterator[Check]:
    """Yield every check of ``design``; see `obsynth.verification.verify`."""
    plant, observer = design.linear
    yield from plant_information(plant)
    yield from condition_rows(fault_filter_conditions(plant))
    tracking, factor = design.certificate.matrices.get("tracking"), design.certificate.matrices.get("P_factor")
    lag = _whole(design.certificate.claims.get("state_lag", -1.0))
    fitting = _fits(plant, observer, tracking, factor, lag)
    yield upper_bound_check(
        "fits the plant",
        "observer, certificate and plant have matching signals and shapes",
        0.0 if fitting else 1.0,
        0.0,
        source="shipped realisation",
    )
    if not fitting or tracking is None or factor is None:
        return
    tolerance = EQUALITY_TOLERANCE
    if printed_digits is not None:
        # Half a unit in the last printed place, in each of the products that an identity sums up.
        tolerance = 0.5 * 10.0 ** (-printed_digits) * (plant.nx + plant.ny)
    for key, found in tracking_residuals(plant, observer, tracking, lag).items():
        name, claim, source = _IDENTITIES[key]
        yield _equality(name, claim, found, tolerance, source)
    errors = ErrorSystem.of(plant, observer, tracking, lag)
    yield from _fault_rows(plant, errors, observer, tracking, tolerance)
    radius = spectral_radius(observer.Az)
    yield upper_bound_check(
        "spectral radius",
        "the observer is stable",
        radius,
        np.nextafter(1.0, 0.0),
        source="Wang 2015, Theorem 2",
        detail=f"eigenvalues computed; proved by the row 'LMI'; {_time_constant(radius, plant.dt)}",
    )
    yield from _gain_rows(design, errors, tracking, factor, lag)
    yield from _noise_rows(plant, errors)


def _whole(lag: float) -> int:
    """Return a lag as a number of samples, -1 when it is none."""
    return int(lag) if np.isfinite(lag) and lag == int(lag) else -1


def _fits(
    plant: DescriptorSystem, observer: LinearObserver, tracking: FloatArray | None, factor: FloatArray | None, lag: int
) -> bool:
    if tracking is None or factor is None or tracking.ndim != 2 or factor.ndim != 2:
        return False
    return bool(
        lag >= 0
        and tracking.shape == (observer.order, plant.nx * (lag + 1))
        and factor.shape[0] == factor.shape[1] <= observer.order
        and np.all(np.isfinite(tracking))
        and np.all(np.isfinite(factor))
        and observer.input_names == plant.input_names
        and observer.output_names == plant.output_names
        and observer.state_names == plant.state_names
        and observer.fault_names == observer.residual_names == plant.fault_names
        and observer.dt == plant.dt
        and all(delay == lag for delay in observer.state_delays)
        and all(delay >= 1 for delay in observer.fault_delays)
    )


def _equality(name: str, claim: str, found: Residual, tolerance: float, source: str) -> Check:
    return upper_bound_check(
        name,
        claim,
        found.relative,
        tolerance,
        source=source,
        kind="equality",
        detail=f"largest miss {found.error:.1e} among terms of size {found.scale:.1e}",
    )


def _fault_rows(
    plant: DescriptorSystem, errors: ErrorSystem, observer: LinearObserver, tracking: FloatArray, tolerance: float
) -> Iterator[Check]:
    """Check the whole transfer from the faults: a pure delay to the fault estimate, nothing to the state error.

    The error's response to a fault impulse is followed for one step more than the largest delay; that it is zero
    from there on makes the response, and so the transfer function, complete.
    """
    cf, direct_fault = errors.fault_output[:2]
    cr, direct_residual = errors.residual_output[:2]
    cx, direct_state = errors.state_output[:2]
    longest = max(observer.fault_delays, default=1)
    traces = [errors.fault]
    for _ in range(longest):
        traces.append(errors.Az @ traces[-1])
    sizes = _trace_sizes(plant, observer, tracking, traces)
    seen, shown, moved = (cf, sizes), (cr, sizes), (_in_state_units(sizes, plant.nx),)
    to_fault = [residual(direct_fault, factors=(seen,))]
    to_residual = [residual(direct_residual, factors=(shown,))]
    to_state = [residual(direct_state, factors=((cx, sizes), moved))]
    for step, trace in enumerate(traces[:-1], start=1):
        expected = np.diag([1.0 if delay == step else 0.0 for delay in observer.fault_delays])
        to_fault.append(residual(-cf @ trace, -expected, factors=(seen,)))
        to_residual.append(residual(-cr @ trace, -expected, factors=(shown,)))
        to_state.append(residual(cx @ trace, factors=((cx, sizes), moved)))
    source = "Wang 2015, eqs. (32), (44)"
    yield _equality(
        "fault decoupled after its delay",
        "(TA - LC) Psi = 0: no trace of a fault remains in the error after its delay",
        residual(traces[-1], factors=((sizes,),)),
        tolerance,
        source,
    )
    yield _equality(
        "fault estimate",
        f"fhat_i(k) = f_i(k - rho_i), rho = {', '.join(map(str, observer.fault_delays))} (W Upsilon = I)",
        _worst(to_fault),
        tolerance,
        source,
    )
    yield _equality("fault in the residual", "r(k) equals fhat(k)", _worst(to_residual), tolerance, source)
    yield _equality(
        "no fault in the state estimate",
        "the transfer from the faults to the state error is zero",
        _worst(to_state),
        tolerance,
        "ours: the paper's xhat is biased by Psi",
    )


def _trace_sizes(
    plant: DescriptorSystem, observer: LinearObserver, tracking: FloatArray, traces: list[FloatArray]
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
    try:
        work = with_sensor_faults_as_states(plant)
    except PreconditionError:
        return np.asarray(sizes)  # a failed existence condition says so already
    units = balance_by_least_squares(work.E, work.A, inputs=[work.Bf], outputs=[work.C]).states
    units = np.resize(np.append(units, np.tile(units[: plant.nx], lagged.lag)), len(sizes))[:, None]
    return np.asarray(np.maximum(sizes, UNREACHED * units * np.max(sizes / units, axis=0)))


def _in_state_units(sizes: FloatArray, nx: int) -> FloatArray:
    """Return the leading rows ``(nx, nf)``: these observer states are in the units of the plant's states."""
    leading = np.zeros((nx, sizes.shape[1]))
    leading[: len(sizes)] = sizes[:nx]
    return leading


def _worst(found: list[Residual]) -> Residual:
    finite = [item for item in found if not np.isnan(item.relative)]
    return max(finite, key=lambda item: item.relative) if len(finite) == len(found) else Residual(float("nan"), 1.0)


def _gain_rows(
    design: ObserverDesign, errors: ErrorSystem, tracking: FloatArray, factor: FloatArray, lag: int
) -> Iterator[Check]:
    (plant, observer), claims = design.linear, design.certificate.claims
    gamma = float(claims.get("gamma", np.nan))
    proof = prove_bounded_real(plant, observer, tracking, factor, gamma if plant.nd else 1.0, lag=lag)
    what = f"stable, and l2 gain d -> fault error < {gamma:.6g}" if plant.nd else "stable (Lyapunov)"
    yield Check(
        "LMI",
        f"the matrix inequality is positive definite: {what}",
        proof.lower_bound,
        0.0,
        proof.lower_bound,
        proof.proved,
        "Wang 2015, eq. (45)",
        "proved",
        f"Cholesky with rounding bound {proof.error_bound:.1e}, on a unit diagonal",
    )
    if not plant.nd:
        return
    norm = hinf_norm(errors.Az, errors.disturbance, errors.fault_output[0], -errors.fault_output[2])
    reported = max(gamma, norm.upper)
    yield upper_bound_check(
        "H-infinity norm",
        "the exact norm d -> fault error is at most the claimed gamma",
        norm.upper,
        gamma,
        source="Wang 2015, eq. (49)",
        detail=f"peak at {norm.angle:.4g} rad/sample; the gain to quote is {reported:.6g}",
    )
    state = hinf_norm(errors.Az, errors.disturbance, errors.state_output[0], -errors.state_output[2])
    yield information(
        "disturbance in the state estimate", "H-infinity norm d -> state error", state.upper, source="recomputed"
    )


def _noise_rows(plant: DescriptorSystem, errors: ErrorSystem) -> Iterator[Check]:
    if not plant.nw:
        return
    covariance = output_covariance(errors.Az, errors.noise, -errors.fault_output[0], errors.fault_output[3])
    for name, variance in zip(plant.fault_names, np.diag(covariance), strict=True):
        yield information(
            f"noise in fhat[{name}]",
            "standard deviation of the fault estimate under the stated noise",
            float(np.sqrt(variance)),
            source="recomputed, Lyapunov equation",
            detail=plant.units.get(name, ""),
        )


def _time_constant(radius: float, dt: float) -> str:
    if not 0.0 < radius < 1.0:
        return "no time constant"
    return f"slowest time constant {-dt / np.log(radius):.3g} s"

"""Checks of a fault-estimation filter, from the plant and the shipped realisation alone.

Source of the claims: Wang 2015, eqs. (7), (26), (32), (44), (45), (49); the corrected state estimate is ours.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator

import numpy as np

from obsynth.analysis.existence.restricted_equivalent import with_sensor_faults_as_states
from obsynth.analysis.existence.wang2015 import fault_filter_conditions
from obsynth.errors import PreconditionError
from obsynth.methods.fault_estimation_filter.checks_over_region import checks_over_region
from obsynth.methods.fault_estimation_filter.printed_gains import gain_rows, gains_fit, printed_allowances, weight_rows
from obsynth.methods.fault_estimation_filter.whole_transfer import Equations, fault_rows
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.logarithmic_balance import balance_by_least_squares
from obsynth.numerics.modal_response import Modes
from obsynth.numerics.norms import highest_gain_found, hinf_norm
from obsynth.numerics.outward import upper_text
from obsynth.numerics.ranks import decide_rank
from obsynth.numerics.scaling import Scaling
from obsynth.observers.linear.modes import modes_of
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.polytopic import PolytopicSystem
from obsynth.results.checks import Check, fitting_check, information, upper_bound_check
from obsynth.results.design import ObserverDesign
from obsynth.verification.claims import claim_rows, claimed, fault_noise_rows, recovery_rows
from obsynth.verification.error_system import ErrorModel
from obsynth.verification.identities import equality, tracking_identities
from obsynth.verification.inequalities import prove_bounded_real
from obsynth.verification.least_gain_proof import LEAST_GAIN_WITNESSES, least_gain_row
from obsynth.verification.plant import condition_rows, plant_information

_FILTER_IDENTITIES = {
    "dynamics": ("unbiased: dynamics", "Az V E + By C = V A", "Wang 2015, eqs. (7), (26)"),
    "inputs": ("unbiased: inputs", "Bu + By D = V B", "Wang 2015, eq. (23)"),
    "state estimate": (
        "unbiased: state",
        "the state estimate equals the state when the error is zero",
        "Wang 2015, eq. (7)",
    ),
    "fault estimate": ("unbiased: fault", "the state has no effect on the fault estimate", "Wang 2015, eq. (25)"),
    "residual": ("unbiased: residual", "the state has no effect on the residual", "Wang 2015, eq. (25)"),
    "input feedthrough": (
        "unbiased: feedthrough",
        "the input has no direct effect on any estimate (Du + Dy D = 0)",
        "our extension",
    ),
}


def checks(design: ObserverDesign, printed_digits: int | None) -> Iterator[Check]:
    """Yield every check of ``design``; see `obsynth.verify`."""
    if isinstance(design.plant, PolytopicSystem):
        yield from checks_over_region(design)
        return
    (plant, observer), claims = design.linear, design.certificate.claims
    yield from plant_information(plant)
    yield from condition_rows(fault_filter_conditions(plant))
    yield from claim_rows(plant, claims)
    yield from recovery_rows(plant, design.recovery)
    tracking, factor = design.certificate.matrices.get("tracking"), design.certificate.matrices.get("P_factor")
    lag = _whole_lag(claimed(claims, "state_lag"))
    fitting = _fits(plant, observer, tracking, factor, lag)
    yield fitting_check("observer, certificate and plant have matching signals and shapes", fits=fitting)
    if not fitting or tracking is None or factor is None:
        return
    work = _with_sensor_faults(plant)
    scaling = balance_by_least_squares(work.E, work.A, inputs=[work.Bf], outputs=[work.C]) if work is not None else None
    allowances = yield from _gain_set_rows(design, work, scaling, tracking, printed_digits)
    errors = ErrorModel(plant, observer, tracking, lag=lag)
    for key, identity in tracking_identities(errors).items():
        name, claim, source = _FILTER_IDENTITIES[key]
        yield equality(name, claim, identity.residual(allowances.get(key)), source)
    yield from fault_rows(plant, observer, tracking, errors, scaling, allowances)
    modes = modes_of(observer)
    radius = modes.radius
    slowest = f"slowest time constant {-plant.dt / np.log(radius):.3g} s" if 0.0 < radius < 1.0 else "no time constant"
    yield upper_bound_check(
        "spectral radius",
        "the observer is stable",
        radius,
        np.nextafter(1.0, 0.0),
        source="Wang 2015, Theorem 2",
        detail=f"eigenvalues computed; their proof is the row 'LMI'; {slowest}",
    )
    yield from _norm_rows(design, errors, modes, tracking, factor)
    yield from fault_noise_rows(errors)


def _gain_set_rows(
    design: ObserverDesign,
    work: DescriptorSystem | None,
    scaling: Scaling | None,
    tracking: FloatArray,
    printed_digits: int | None,
) -> Generator[Check, None, dict[str, FloatArray]]:
    """Yield the rows on the gain set, and return what its printed digits allow the identities to miss."""
    (plant, observer), gains = design.linear, design.gains
    if not gains:
        yield from _least_gain(design, None)
        return {}  # nothing is said about gains: the realisation stands for itself
    if work is None or scaling is None:
        return {}  # a failed existence condition says so already
    fitting = gains_fit(work, gains, observer)
    yield fitting
    if not fitting.passed:
        return {}
    allowances: dict[str, FloatArray] = {}
    if printed_digits is not None:
        allowances = printed_allowances(plant, work, observer, gains, scaling, printed_digits)
    equations = Equations.of(plant, work, observer.fault_delays)
    options = design.options
    yield from gain_rows(work, gains, observer, tracking, equations, scaling, allowances)
    if options.get("weight") != "paper" or decide_rank(np.hstack([work.C, work.Dd])).rank == work.ny:
        yield from weight_rows(gains, options.get("weight"))
    yield from _least_gain(design, work)
    return allowances


def _least_gain(design: ObserverDesign, work: DescriptorSystem | None) -> Iterator[Check]:
    """Yield the row on the least gain; without gains there is no family of filters to prove anything of."""
    claims, matrices = design.certificate.claims, design.certificate.matrices
    if "gamma_min" not in claims and not LEAST_GAIN_WITNESSES & matrices.keys():
        return
    free = design.options.get("weight") == "free"
    witnesses = matrices if work is not None else {}
    sought = bool(design.options.get("prove_least"))
    least = claimed(claims, "gamma_min")
    yield least_gain_row(work, design.gains, witnesses, least, free_weight=free, thorough=sought)


def _with_sensor_faults(plant: DescriptorSystem) -> DescriptorSystem | None:
    """Return the plant with its sensor faults as states; ``None`` where these cannot be distinguished from the
    others."""
    try:
        return with_sensor_faults_as_states(plant)
    except PreconditionError:
        return None


def _whole_lag(lag: float) -> int:
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


def _norm_rows(
    design: ObserverDesign, errors: ErrorModel, modes: Modes, tracking: FloatArray, factor: FloatArray
) -> Iterator[Check]:
    (plant, observer), claims = design.linear, design.certificate.claims
    gamma = claimed(claims, "gamma")
    proof = prove_bounded_real(plant, observer, tracking, factor, gamma if plant.nd else 1.0)
    claim = f"stable, and l2 gain d -> fault error < {upper_text(gamma, 6)}" if plant.nd else "stable (Lyapunov)"
    yield Check(
        "LMI",
        f"the matrix inequality is positive definite: {claim}",
        proof.lower_bound,
        0.0,
        proof.lower_bound,
        proof.proved,
        "Wang 2015, eq. (45)",
        "proved",
        proof.text,
    )
    if not plant.nd:
        return
    fault, states = errors.fault_output, errors.state_output
    norm = hinf_norm(errors.Az, errors.disturbance, fault[0], -fault[2], modes=modes)
    yield upper_bound_check(
        "H-infinity norm",
        "the exact norm d -> fault error is at most the claimed gamma",
        norm.upper,
        gamma,
        source="Wang 2015, eq. (49)",
        detail=f"peak at {norm.frequency:.4g} rad/sample",
    )
    state = highest_gain_found(errors.Az, errors.disturbance, states[0], -states[2], modes=modes)
    yield information(
        "disturbance in the state estimate", "H-infinity norm d -> state error", state, source="recomputed"
    )

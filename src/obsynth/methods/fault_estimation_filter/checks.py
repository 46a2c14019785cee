"""The whole transfer from the faults, and the filter that a set of gains stands for: a second route to synthesis.

The error's response to an impulse is followed for one step more than the largest delay; zero from there on makes the
transfer complete. The equations (Wang 2015, eq. (23)) are run on unit vectors: ``x0 = z + N y``, ``z+ = T A x0 + L (y -
C x0) + T B u``, ``r = W (y - C x0)``, ``D u`` subtracted from y, and the state of age a corrected by ``(TA)^(rho_i - 1
- a) T f_i``.

Checks of a fault-estimation filter, from the plant and the shipped realisation alone.

Source of the claims: Wang 2015, eqs. (7), (26), (32), (44), (45), (49); the corrected state estimate is ours.

The gain set beside the realisation: eqs. (8), (17), (20), (23), (60).  To first order an identity at gains printed to k
decimals is off by half a unit times the sizes of its cofactors, each found by moving an entry of the gains by as much,
either way.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from obsynth.errors import PreconditionError
from obsynth.methods.fault_estimation_filter.conditions import fault_filter_conditions, with_sensor_faults_as_states
from obsynth.methods.fault_estimation_filter.least_gain_proof import LEAST_GAIN_WITNESSES, least_gain_row
from obsynth.numerics.arguments import FloatArray
from obsynth.numerics.modal_response import Modes
from obsynth.numerics.norms import highest_gain_found, hinf_norm
from obsynth.numerics.scaling import Scaling, balance_by_least_squares
from obsynth.observers.linear.observer import LinearObserver, modes_of
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.results.checks import Check, fitting_check, information, nothing_wrong, upper_bound_check
from obsynth.results.design import ObserverDesign
from obsynth.verification.claims import (
    Identity,
    claim_rows,
    claimed,
    equality,
    fault_noise_rows,
    prove_bounded_real,
    recovery_rows,
    tracking_identities,
    tracking_totals,
    worst,
)
from obsynth.verification.error_system import ErrorModel, with_past
from obsynth.verification.plant import condition_rows, plant_information

#: A trace of a fault in an observer state below this share of its largest one is held to be no trace.
UNREACHED_STATE = 1e-4
_SOURCE = "Wang 2015, eqs. (32), (44)"


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
    found: dict[str, list[tuple[FloatArray, ...]]] = {
        "fault decoupled after its delay": [(traces[-1],)],
        "fault estimate": to_fault,
        "fault in the residual": to_residual,
        "no fault in the state estimate": to_state,
    }
    return {name: tuple(Identity(terms) for terms in steps) for name, steps in found.items()}


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


#: The observer's matrices.
OBSERVER_MATRICES = ("Az", "Bu", "By", "Cz", "Du", "Dy")


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
        found = np.zeros((rows, len(self.delays)))
        for i, delay in enumerate(self.delays):
            if delay > age:
                column = t @ self.F[:, i]
                for _ in range(delay - 1 - age):
                    column = t @ (self.A @ column)
                found[:, i] = column[:rows]
        return found

    def realised(self, gains: Mapping[str, FloatArray], *, minus: float = -1.0) -> dict[str, FloatArray]:
        """Return Az, Bu, By, Cz, Du and Dy of the filter."""
        t, n, feedback, w = (gains[letter] for letter in "TNLW")
        na, nx, ny, lag = len(self.A), self.nx, len(self.C), max(self.delays, default=1) - 1
        nz = na + lag * nx
        core, stored, u, y = np.split(np.eye(nz + self.B.shape[1] + ny), [na, nz, nz + self.B.shape[1]])
        measured = y + minus * (self.D @ u)
        x0 = core + n @ measured
        innovation = measured + minus * (self.C @ x0)
        shown = w @ innovation
        known = [x0[:nx], *np.split(stored, lag)] if lag else [x0[:nx]]
        states = [state + self.moved(t, age, rows=nx) @ shown for age, state in enumerate(known)]
        following = np.vstack([t @ (self.A @ x0) + feedback @ innovation + t @ (self.B @ u), *states[:-1]])
        outputs = np.vstack([states[-1], shown, shown])
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
        found = np.zeros((na + older, self.nx + older))
        found[:na, : self.nx] = t[:, : self.nx]
        found[na:, self.nx :] = np.eye(older)
        return found


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
    (plant, observer), claims = design.linear, design.certificate.claims
    yield from plant_information(plant)
    yield from condition_rows(fault_filter_conditions(plant))
    yield from claim_rows(plant, claims)
    yield from recovery_rows(plant, design.recovery)
    tracking, factor = design.certificate.matrices.get("tracking"), design.certificate.matrices.get("P_factor")
    lag = _whole(claimed(claims, "state_lag"))
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
    fixed = design.options.get("free_residual_weight") is False and design.options.get("S") is None
    yield from gain_rows(work, gains, observer, tracking, equations, scaling, allowances, fixed_weight=fixed)
    yield from _least_gain(design, work)
    return allowances


def _least_gain(design: ObserverDesign, work: DescriptorSystem | None) -> Iterator[Check]:
    """Yield the row on the least gain; without gains there is no family of filters to prove anything of."""
    claims, matrices = design.certificate.claims, design.certificate.matrices
    if "gamma_min" not in claims and not LEAST_GAIN_WITNESSES & matrices.keys():
        return
    free = bool(design.options.get("free_residual_weight"))
    kept = matrices if work is not None else {}
    sought = bool(design.options.get("prove_least"))
    least = claimed(claims, "gamma_min")
    yield least_gain_row(work, design.gains, kept, least, free_weight=free, thorough=sought)


def _with_sensor_faults(plant: DescriptorSystem) -> DescriptorSystem | None:
    """Return the plant with its sensor faults as states; ``None`` where these cannot be distinguished from the
    others."""
    try:
        return with_sensor_faults_as_states(plant)
    except PreconditionError:
        return None


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


def _norm_rows(
    design: ObserverDesign, errors: ErrorModel, modes: Modes, tracking: FloatArray, factor: FloatArray
) -> Iterator[Check]:
    (plant, observer), claims = design.linear, design.certificate.claims
    gamma = claimed(claims, "gamma")
    proof = prove_bounded_real(plant, observer, tracking, factor, gamma if plant.nd else 1.0)
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
        proof.text,
    )
    if not plant.nd:
        return
    fault, states = errors.fault_output, errors.state_output
    norm = hinf_norm(errors.Az, errors.disturbance, fault[0], -fault[2], modes=modes)
    reported = max(gamma, norm.upper)
    yield upper_bound_check(
        "H-infinity norm",
        "the exact norm d -> fault error is at most the claimed gamma",
        norm.upper,
        gamma,
        source="Wang 2015, eq. (49)",
        detail=f"peak at {norm.frequency:.4g} rad/sample; the largest gain is {reported:.6g}",
    )
    state = highest_gain_found(errors.Az, errors.disturbance, states[0], -states[2], modes=modes)
    yield information(
        "disturbance in the state estimate", "H-infinity norm d -> state error", state, source="recomputed"
    )


#: Letters that every gain set has; it may have R as well.
NEEDED = ("T", "N", "L", "W", "Psi", "Upsilon")
RESTRICTED, WEIGHT = "gains: T and N", "gains: W"


def gains_fit(work: DescriptorSystem, gains: Mapping[str, FloatArray], observer: LinearObserver) -> Check:
    """Return the row on letters and shapes of the gain set."""
    na, ny, nf = work.nx, work.ny, work.nf
    shapes = {
        "T": (na, na),
        "N": (na, ny),
        "L": (na, ny),
        "W": (nf, ny),
        "Psi": (na, nf),
        "Upsilon": (ny, nf),
        "R": (na, ny),
    }
    wrong = [letter for letter in NEEDED if letter not in gains]
    wrong += [letter for letter in gains if letter not in shapes]
    wrong += [
        letter
        for letter, shape in shapes.items()
        if letter in gains and (gains[letter].shape != shape or not np.all(np.isfinite(gains[letter])))
    ]
    order = na + len(observer.state_names) * (max(observer.fault_delays, default=1) - 1)
    wrong += ["the order of the observer"] if observer.order != order else []
    return nothing_wrong(
        "gains fit",
        "the gain set has the letters and shapes of the plant, the observer the order that follows",
        wrong,
        source="gain set",
    )


def gain_identities(
    work: DescriptorSystem, gains: Mapping[str, FloatArray], equations: Equations, scaling: Scaling
) -> dict[str, Identity]:
    """Return the identities that T, N and W satisfy, and that the rounding of printed gains disturbs."""
    t, n, w = gains["T"], gains["N"], gains["W"]
    upsilon = work.C @ equations.detectability_matrix(gains)
    # The columns are in the units of the faults, which differ: each is compared with its own largest products.
    peaks = np.max(np.abs(w) @ np.abs(upsilon), axis=0, initial=0.0)
    return {
        RESTRICTED: Identity((t @ work.E, n @ work.C, -np.eye(work.nx)), ((t, work.E), (n, work.C)), scaling.states),
        WEIGHT: Identity((w @ upsilon, -np.eye(work.nf)), ((w, upsilon),), 1.0 / np.where(peaks > 0.0, peaks, 1.0)),
    }


def gain_rows(
    work: DescriptorSystem,
    gains: Mapping[str, FloatArray],
    observer: LinearObserver,
    tracking: FloatArray,
    equations: Equations,
    scaling: Scaling,
    allowances: Mapping[str, FloatArray],
    *,
    fixed_weight: bool,
) -> Iterator[Check]:
    """Yield the rows on the gain set, which must fit."""
    identities = gain_identities(work, gains, equations, scaling)
    claims = {
        RESTRICTED: ("T E + N C = I", "Wang 2015, eq. (8)"),
        WEIGHT: ("W Upsilon = I", "Wang 2015, eq. (44)"),
    }
    for name, (claim, source) in claims.items():
        yield equality(name, claim, identities[name].residual(allowances.get(name)), source)
    psi, upsilon = equations.detectability_matrix(gains), gains["Upsilon"]
    sizes = equations.absolute.detectability_matrix({"T": np.abs(gains["T"])})
    detectability = [
        Identity((gains["Psi"], -psi), ((sizes,),), entrywise=True),
        Identity((upsilon, -work.C @ gains["Psi"]), ((work.C, sizes),), entrywise=True),
    ]
    yield equality(
        "gains: Psi and Upsilon",
        "Psi holds the columns (TA)^(rho_i - 1) T f_i, and Upsilon = C Psi",
        worst([identity.residual() for identity in detectability]),
        "Wang 2015, eq. (20)",
    )
    if "R" in gains:
        yield equality(
            "gains: R",
            "R is the free part of L: R Upsilon = 0, and L - R = T A Psi G with G Upsilon = I"
            + (", G = W" if fixed_weight else ""),
            worst([identity.residual() for identity in _free_part_identities(work, gains, scaling, fixed_weight)]),
            "Wang 2015, eq. (60)",
        )
    formed = equations.realised(gains)
    terms = equations.absolute.realised({letter: np.abs(gains[letter]) for letter in "TNLW"}, minus=1.0)
    realised = [
        Identity((getattr(observer, name), -formed[name]), ((terms[name],),), entrywise=True)
        for name in OBSERVER_MATRICES
    ]
    realised.append(Identity((tracking, -equations.tracking(gains["T"])), entrywise=True))
    yield equality(
        "gains: realisation",
        "the realisation is that of T, N, L and W, and the certificate tracks T x",
        worst([identity.residual() for identity in realised]),
        "Wang 2015, eq. (23); our state estimate",
    )


def _free_part_identities(
    work: DescriptorSystem, gains: Mapping[str, FloatArray], scaling: Scaling, fixed_weight: bool
) -> list[Identity]:
    # Beside a free weight, which left inverse G of Upsilon is taken depends on the units of the outputs: any is right.
    outputs, fixed, free = 1.0 / scaling.outputs, gains["L"] - gains["R"], gains["R"]
    moved = gains["T"] @ work.A @ gains["Psi"]
    # The columns of L - R are combinations of those of T A Psi: nothing is left beside their span.
    basis, sizes, _ = np.linalg.svd(moved / scaling.states[:, None], full_matrices=False)
    span = scaling.states[:, None] * basis[:, sizes > 0.0]
    shares = (basis[:, sizes > 0.0] / scaling.states[:, None]).T
    upsilon = gains["Upsilon"]
    # R is the difference of L and the fixed part: it is judged against these, however small it is itself.
    parts = np.abs(gains["L"]) + np.abs(fixed) + np.abs(free)
    rows = np.max(parts * outputs, axis=1, keepdims=True)
    columns = np.max(np.abs(upsilon) / outputs[:, None], axis=0, keepdims=True)
    products = ((rows, columns), (gains["T"], work.A, gains["Psi"]))
    formed = parts + np.abs(gains["T"]) @ np.abs(work.A) @ np.abs(gains["Psi"]) @ np.abs(gains["W"])
    # The projection mixes the rows in balanced units.
    mixed = scaling.states[:, None] * np.max(formed / scaling.states[:, None], axis=0, initial=0.0)
    found = [
        Identity((free @ upsilon,), products),
        Identity((fixed @ upsilon, -moved), products),
        Identity((fixed, -span @ (shares @ fixed)), ((mixed,),), outputs),
    ]
    return [*found, Identity((fixed, -moved @ gains["W"]), ((mixed,),), outputs)] if fixed_weight else found


#: The gains that are printed; Psi, Upsilon and R follow from them.
PRINTED = "TNLW"


def printed_allowances(
    plant: DescriptorSystem,
    work: DescriptorSystem,
    observer: LinearObserver,
    gains: Mapping[str, FloatArray],
    scaling: Scaling,
    digits: int,
) -> dict[str, FloatArray]:
    """Return, by identity, what the rounding of the gains can add to each of its entries, to first order."""
    half_a_unit = 0.5 * 10.0**-digits
    equations = Equations.of(plant, work, observer.fault_delays)

    def totals(letter: str = "", move: FloatArray | None = None) -> dict[str, FloatArray]:
        moved = dict(gains) if move is None else {**gains, letter: gains[letter] + move}
        built = LinearObserver(**{**observer.as_dict(), **equations.realised(moved)})
        tracking = equations.tracking(moved["T"])
        lag = tracking.shape[1] // plant.nx - 1
        errors = ErrorModel(plant, built, tracking, lag=lag)
        found = gain_identities(work, moved, equations, scaling)
        for name, steps in fault_identities(errors, built.fault_delays).items():
            found |= {step_key(name, step): identity for step, identity in enumerate(steps)}
        return {**tracking_totals(errors), **{name: identity.total for name, identity in found.items()}}

    centre = totals()
    found = {name: np.zeros_like(total) for name, total in centre.items()}
    for letter in PRINTED:
        for index in np.ndindex(gains[letter].shape):
            move = np.zeros_like(gains[letter])
            move[index] = half_a_unit
            more, less = totals(letter, move), totals(letter, -move)
            for name, middle in centre.items():
                found[name] += np.maximum(np.abs(more[name] - middle), np.abs(less[name] - middle))
    return found

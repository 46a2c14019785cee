r"""A plant without its unknown inputs, for the descriptor Kalman filter; and when that exists.

With ``[V1 V2]`` orthonormal and ``Dd V2 = 0``, ``d1 = V1' d`` becomes a state without an equation of its own, and
``d2 = V2' d`` is removed with an N, ``N Bd V2 = 0``, orthonormal where equations are near one:

.. math::
    N [E \; 0] [x; d_1]^+ = N [A \; B_d V_1] [x; d_1] + N B u + N \mu, \qquad y = [C \; D_d V_1] [x; d_1] + \nu.

Nothing else is known about d, so nothing is lost.  It exists when ``[N E 0; C Dd V1]`` has full column rank: (D1).

The steady state of the descriptor Kalman filter of a time-invariant plant, from its algebraic Riccati equation.

The recursive methods put together: noise that the plant states, gains to read, claims, notes.

Nikoukhah, Willsky, Levy, IEEE TAC 37 (9), 1992; A. Moussa Ali, Q. Zhang, IFAC ALCOSP 2013, (18).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from obsynth.analysis.conditions import Condition, require_all
from obsynth.analysis.plant_units import FAR_UNITS, PlantUnits
from obsynth.analysis.time_varying import WARN_MARKOV_CONDITION, HorizonRanks, as_time_varying, horizon_ranks
from obsynth.analysis.transformations.linear_plants import Transformation
from obsynth.analysis.zeros import are_outside, leading_names
from obsynth.errors import PreconditionError, SolverError, SpecError
from obsynth.methods.method import Method, Synthesis
from obsynth.methods.recursive.conditions import described_mode, detectability_condition, recursive_conditions
from obsynth.numerics.arguments import (
    FloatArray,
    arguments_checked,
    as_matrix,
    read_only,
    require_no_overflow,
    require_shape,
)
from obsynth.numerics.matrix_equations import discrete_lyapunov, discrete_riccati
from obsynth.numerics.norms import spectral_radius
from obsynth.numerics.pencils import finite_zeros
from obsynth.numerics.ranks import (
    BOUNDARY_TOLERANCE,
    CANCELLATION_TOLERANCE,
    covariance_factor,
    decide_rank,
    numerical_rank,
)
from obsynth.numerics.square_root_estimation import least_squares_step, rank_revealing_step
from obsynth.observers.recursive.gain_schedule import (
    MOST_SETTLING_STEPS,
    STEPS_TO_CONTRACT,
    GainScheduleSummary,
    gain_schedule_summary,
)
from obsynth.observers.recursive.observer import RecursiveObserver, observer_from_options, plain_options, stacked_noise
from obsynth.plants.descriptor import DescriptorSystem, TimeVaryingDescriptorSystem
from obsynth.results.design import Certificate

#: Prior deviation of an unknown input at the first sample, relative to the one that moves a state by its own prior
#: deviation: as good as none, and its square far from overflow.
UNKNOWN_INPUT_PRIOR = 1e4


@dataclass(frozen=True, eq=False)
class WithoutUnknownInputs:
    """A plant without unknown inputs."""

    plant: TimeVaryingDescriptorSystem
    equations: FloatArray  # N (ne, nx)
    shown: FloatArray  # V1 (nd, n1)
    names: tuple[str, ...]  # of the states d1
    scale: FloatArray  # of the prior deviations of d1, (n1,)
    note: str

    def process_covariance(self, given: object) -> object:
        """Return the covariance of the equations that are left, from that of all: a number or a constant matrix."""
        if np.ndim(given) == 0:  # type: ignore[arg-type]
            return given
        if callable(given) or np.ndim(given) != 2:  # type: ignore[arg-type]
            raise SpecError(
                "Q changes with k, which is not known how to be combined with unknown inputs: give a constant "
                "covariance.",
                path="Q",
            )
        matrix = as_matrix(given, "Q")
        count = self.equations.shape[1]
        require_shape(matrix.shape, (count, count), "Q")
        return self.equations @ matrix @ self.equations.T

    def initial_state(self, given: object) -> object:
        """Return the mean of the first state: unknown inputs are as likely to be of either sign."""
        mean = np.zeros(self.equations.shape[1]) if given is None else np.ravel(np.asarray(given, dtype=np.float64))
        return np.concatenate([mean, np.zeros(len(self.names))])

    def initial_covariance(self, given: object) -> object:
        """Return the covariance of the first state, in which unknown inputs may have any size."""
        count = self.equations.shape[1]
        own = np.eye(count) if given is None else as_matrix(given, "initial_covariance")
        own = own[0, 0] * np.eye(count) if own.shape == (1, 1) else own
        require_shape(own.shape, (count, count), "initial_covariance")
        whole = np.zeros((count + len(self.names),) * 2)
        whole[:count, :count] = own
        deviation = UNKNOWN_INPUT_PRIOR * self.scale * max(float(np.sqrt(np.max(np.diag(own)))), 1.0)
        whole[count:, count:] = np.diag(deviation**2)
        return whole


def without_unknown_inputs(plant: DescriptorSystem) -> WithoutUnknownInputs:
    """Return a plant without its unknown inputs; `SpecError` for what else these methods do not take."""
    nothing = {name: None for name in ("Bd", "Dd", "disturbance_names")}
    known = as_time_varying(plant.replace(**nothing))
    # In units in which each unknown input has the same effect, and the plant is near one: no unit decides what shows.
    own = PlantUnits.of(plant).rounded()
    rows, outputs = own.equations[:, None], own.outputs[:, None]
    sizes = np.linalg.norm(np.vstack([rows * plant.Bd, outputs * plant.Dd]), axis=0)
    units = 1.0 / np.where(sizes > 0.0, sizes, 1.0)
    bd, dd = plant.Bd * units, plant.Dd * units
    _, values, right = np.linalg.svd(outputs * dd) if dd.size else (None, np.zeros(0), np.eye(plant.nd))
    rank = numerical_rank(values, scale=1.0)
    shown, hidden = right[:rank].T, right[rank:].T
    if rank == plant.nd:
        shown, names = np.eye(plant.nd), plant.disturbance_names
    else:
        names = tuple(f"unknown input {i + 1}" for i in range(rank))
    left, sizes_of_entry, _ = np.linalg.svd(rows * bd @ hidden)
    moved = numerical_rank(sizes_of_entry, scale=1.0)
    if moved == plant.nx:
        raise SpecError(
            f"Unknown inputs ({', '.join(plant.disturbance_names)}) drive every equation: none is left to predict the "
            "state with. State one of them as noise (Bw), or leave it out.",
            path="Bd",
        )
    equations = left[:, moved:].T * own.equations if moved else np.eye(plant.nx)
    if rank == plant.nd:
        # In their own units again, with their own names.
        bd, dd = plant.Bd, plant.Dd
    through, direct = equations @ bd @ shown, dd @ shown
    scale = 1.0 / np.linalg.norm(np.vstack([bd, dd]) @ shown, axis=0)
    count = known.nx
    taken = TimeVaryingDescriptorSystem(
        np.hstack([equations @ plant.E, np.zeros((len(equations), rank))]),
        np.hstack([equations @ plant.A, through]),
        equations @ plant.B,
        np.hstack([plant.C, direct]),
        Phi=equations @ plant.Bf,
        Psi=plant.Df,
        dt=plant.dt,
        state_names=(*plant.state_names, *names),
        input_names=plant.input_names,
        output_names=plant.output_names,
        parameter_names=plant.fault_names,
        operating_point=known.operating_point,
        scales=known.scales,
        units={**known.units, **{name: plant.units[name] for name in names if name in plant.units}},
    )
    parts = []
    if rank:
        parts.append(f"{', '.join(map(repr, names))} {'is' if rank == 1 else 'are'} estimated with the states")
    if moved:
        parts.append(f"{moved} of {count} equations were removed with the unknown inputs that reach no output directly")
    note = f"Nothing is assumed about the unknown inputs {', '.join(map(repr, plant.disturbance_names))}: "
    return WithoutUnknownInputs(
        taken, equations, shown, names, scale, note + ("; ".join(parts) or "they have no effect") + "."
    )


def kalman_conditions(
    plant: DescriptorSystem | TimeVaryingDescriptorSystem, *, early: bool = False
) -> tuple[Condition, ...]:
    """Return the existence conditions; the list ends at the first failure."""
    if isinstance(plant, DescriptorSystem) and plant.nd:
        try:
            plant = without_unknown_inputs(plant).plant
        except SpecError:
            # What it is says why it is not taken.
            plant = plant.replace(Bd=None, Dd=None, disturbance_names=None)
    return tuple(recursive_conditions(plant, parameters=False, early=early))


#: The solution must satisfy its equation to this share of its size: half the digits.
RICCATI_TOLERANCE = 1e-8
#: Newton steps after the recursion: each doubles the digits.
MOST_RICCATI_STEPS = 50


@dataclass(frozen=True, eq=False)
class SteadyState:
    """What the filter converges to.

    Parameters
    ----------
    P : FloatArray
        ``(nx, nx)``: covariance of the estimate.
    P_predicted : FloatArray
        ``(ne, ne)``: ``A P A' + Q``, the unknown of (16).
    L, K : FloatArray
        ``(nx, ne)`` and ``(nx, ny)``: the gains (11).
    rate : float
        Factor per step by which the distance of P to its limit shrinks: the squared spectral radius of L A.
    """

    P: FloatArray
    P_predicted: FloatArray
    L: FloatArray
    K: FloatArray
    rate: float


@arguments_checked
def steady_state_filter(
    plant: DescriptorSystem | TimeVaryingDescriptorSystem | Transformation, *, Q: ArrayLike, R: ArrayLike
) -> SteadyState:
    r"""Return the steady state of the descriptor Kalman filter.

    Solves (16) for the inverse of P, where Q and R are definite:

    .. math::
        X = E^T Q^{-1} E + C^T R^{-1} C - E^T Q^{-1} A (A^T Q^{-1} A + X)^{-1} A^T Q^{-1} E, \qquad P = X^{-1}

    Parameters
    ----------
    plant : DescriptorSystem, TimeVaryingDescriptorSystem or Transformation
        Time-invariant, discrete; ``E (ne, nx)``, ``C (ny, nx)``.
    Q, R : array_like
        ``(ne, ne)`` and ``(ny, ny)``, may be singular; a number stands for that multiple of the identity.

    Returns
    -------
    SteadyState
        Covariances, gains, and the rate of convergence per step (dimensionless).

    Raises
    ------
    SpecError
        The plant changes with k, or Q or R is no covariance.
    PreconditionError
        ``rank [E; C] < nx``, an undetectable mode, or a mode on the unit circle that no noise reaches: the covariance
        then tends to zero like ``1 / k``, and no stabilising solution exists.
    SolverError
        No solution was found that passes its own residual; the recursion may still converge.

    Notes
    -----
    (16) needs Q and R definite.  Where they are singular (equations or outputs that hold exactly) or ill-conditioned,
    the fixed point of the filter's own step is found by Newton's method (Kleinman), from gains that the recursion has
    made stable.

    References
    ----------
    .. [MoussaAli2013] Fault diagnosis for linear time-varying descriptor systems, IFAC ALCOSP 2013, eq. (16).
    """
    varying = as_time_varying(plant)
    if not varying.is_time_invariant:
        raise SpecError("The plant changes with k: it has no steady state.", path="plant")
    require_all(recursive_conditions(varying, parameters=False))
    q, r = as_matrix(Q, "Q"), as_matrix(R, "R")
    q, r = (
        float(found[0, 0]) * np.eye(size) if np.ndim(given) == 0 else found
        for given, found, size in ((Q, q, varying.ne), (R, r, varying.ny))
    )
    for name, matrix, size in (("Q", q, varying.ne), ("R", r, varying.ny)):
        require_shape(matrix.shape, (size, size), name)
        require_no_overflow(matrix, name, name)
    roots = covariance_factor(q, "Q"), covariance_factor(r, "R")
    reached_condition(varying, *roots).require()
    E, A, C = varying.E.at(1), varying.A.at(0), varying.C.at(1)
    noise = stacked_noise(*roots)
    P = _from_riccati(E, A, C, q, r) if decide_rank(q).full and decide_rank(r).full else None
    if P is None or not _is_fixed(P, _step(E, A, C, noise, _root(P))[1]):
        P = _from_recursion(E, A, C, noise)
    gain, found = _step(E, A, C, noise, _root(P))
    if not _is_fixed(P, found):
        raise SolverError("The solution of the Riccati equation (16) fails its own residual. Run the filter instead.")
    L, K = gain[:, : varying.ne], gain[:, varying.ne :]
    return SteadyState(
        read_only(P), read_only(A @ P @ A.T + q), read_only(L), read_only(K), spectral_radius(L @ A) ** 2
    )


def reached_condition(plant: TimeVaryingDescriptorSystem, Q_root: FloatArray, R_root: FloatArray) -> Condition:
    """Return the condition that noise reaches every mode on the unit circle, so that the gains never fall asleep."""
    E, A, C = plant.E.at(1), plant.A.at(0), plant.C.at(1)
    noise = stacked_noise(Q_root, R_root)
    wide_e = np.hstack([np.vstack([E, C]), np.zeros_like(noise)])
    wide_a = np.hstack([np.vstack([A, np.zeros_like(C)]), noise])
    zeros = finite_zeros(wide_e, wide_a, to_the_end=False)
    outside = are_outside(wide_e, wide_a, zeros, plant.dt)
    on_circle = [
        complex(z) for z, out in zip(zeros.values, outside, strict=True) if out and abs(z) <= 1.0 + BOUNDARY_TOLERANCE
    ]
    listed = ", ".join(described_mode(z) for z in on_circle if z.imag >= 0.0)
    detail = (
        "no mode lies on the unit circle unreached"
        if not on_circle
        else (
            f"at z = {listed} the noise does not act: what is known there grows without end, so that the gains tend "
            "to zero like 1 / k and later changes are not followed. Give the equations that move this "
            "mode a variance in Q."
        )
    )
    return Condition(
        "noise on the unit circle",
        "[A - zE, Q^(1/2), 0; -zC, 0, R^(1/2)] has its full rank for all |z| = 1",
        not on_circle,
        float(len(on_circle)),
        0.0,
        "Nikoukhah, Willsky, Levy 1992",
        detail,
        on_circle[0] if on_circle else None,
    )


def _is_fixed(P: FloatArray, following: FloatArray) -> bool:
    return bool(np.linalg.norm(following - P) <= RICCATI_TOLERANCE * np.linalg.norm(P))


def _from_riccati(E: FloatArray, A: FloatArray, C: FloatArray, q: FloatArray, r: FloatArray) -> FloatArray | None:
    """Solve (16) for the inverse of P; return ``None`` where the solver finds nothing."""

    n = E.shape[1]
    weighted = np.linalg.solve(q, np.hstack([E, A]))
    known = E.T @ weighted[:, :n] + C.T @ np.linalg.solve(r, C)
    cross, square = E.T @ weighted[:, n:], A.T @ weighted[:, n:]
    try:
        inverse = discrete_riccati(
            np.zeros((n, n)), np.eye(n), 0.5 * (known + known.T), 0.5 * (square + square.T), e=np.eye(n), s=cross
        )
        P = np.linalg.inv(inverse)
    except (np.linalg.LinAlgError, ValueError):  # SciPy raises ValueError where it cannot reorder the Schur form
        return None
    return np.asarray(0.5 * (P + P.T), dtype=np.float64)


def _from_recursion(E: FloatArray, A: FloatArray, C: FloatArray, noise: FloatArray) -> FloatArray:
    """Find the fixed point of the step by Newton's method."""

    P, ne = np.eye(E.shape[1]), len(E)
    gain, following = _step(E, A, C, noise, _root(P))
    for _ in range(MOST_SETTLING_STEPS):
        if spectral_radius(gain[:, :ne] @ A) < 1.0:
            break
        P = following
        gain, following = _step(E, A, C, noise, _root(P))
    else:
        raise SolverError(
            f"The gains of the filter are not stable after {MOST_SETTLING_STEPS} steps: its convergence is too "
            "slow for a steady state. Run the filter instead."
        )
    for _ in range(MOST_RICCATI_STEPS):
        driven = gain @ noise
        last, P = P, discrete_lyapunov(gain[:, :ne] @ A, driven @ driven.T)
        P = np.asarray(0.5 * (P + P.T))
        gain, _ = _step(E, A, C, noise, _root(P))
        if np.linalg.norm(P - last) <= CANCELLATION_TOLERANCE * np.linalg.norm(P):
            break
    return P


def _step(
    E: FloatArray, A: FloatArray, C: FloatArray, noise: FloatArray, root: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return ``[L K]`` and the covariance after one step from ``root root'``."""
    H = np.vstack([E, C])
    S = np.hstack([np.vstack([A @ root, np.zeros((len(C), root.shape[1]))]), noise])
    S = np.hstack([S, np.zeros((len(H), max(len(H) - S.shape[1], 0)))])
    data = np.eye(len(H))
    found = least_squares_step(H, S, data) or rank_revealing_step(H, S, data, np.zeros((len(H), 0)), mapped=len(H))
    return found.estimate, np.asarray(found.factor @ found.factor.T)


def _root(P: FloatArray) -> FloatArray:
    """Return a square root of a covariance that rounding may have left slightly indefinite."""
    values, vectors = np.linalg.eigh(P)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


#: Information on the parameters in a window below this share of their prior's is as good as none.
LOST_EXCITATION = 1.0


def with_stated_noise(
    plant: DescriptorSystem | TimeVaryingDescriptorSystem, options: Mapping[str, Any]
) -> dict[str, Any]:
    """Return the options with Q and R from the noise that a time-invariant plant states, where none are given."""
    resolved = dict(options)
    wanted = [name for name in ("Q", "R") if resolved[name] is None]
    if not isinstance(plant, DescriptorSystem) or not plant.nw or not wanted:
        return resolved
    if np.any(plant.Bw @ plant.Dw.T):
        raise SpecError(
            "The plant's noise drives equations and outputs at once (Bw Dw' is not zero), which this method does not "
            "cover: state independent noises, or give Q and R.",
            path="Dw",
        )
    for name, matrix in (("Q", plant.Bw), ("R", plant.Dw)):
        if resolved[name] is None:
            resolved[name] = matrix @ matrix.T
    return resolved


def synthesise(
    plant: DescriptorSystem | TimeVaryingDescriptorSystem, asked: Method, *, progress: Callable[[str], None]
) -> Synthesis:
    """Put the observer together; see `obsynth.descriptor_kalman` and `obsynth.adaptive_observer`."""
    progress("checking the existence conditions along the horizon")
    require_all(asked.existence(plant))
    options = with_stated_noise(plant, asked.as_given())
    if options.get("guard", "") is None:
        options["guard"] = "none" if options["form"] == "literal" else "regularise"
    progress("computing the gains")
    missing = [name for name in ("Q", "R") if options[name] is None]
    far = isinstance(plant, DescriptorSystem) and PlantUnits.of(plant).spread > FAR_UNITS
    if isinstance(plant, DescriptorSystem) and far:
        options |= _identities(PlantUnits.of(plant).rounded(), options)
    if not isinstance(plant, DescriptorSystem) or not plant.nd:
        return _of_varying(as_time_varying(plant), options, missing=missing, own_units=far)
    reduced = without_unknown_inputs(plant)
    options |= {
        "initial_state": reduced.initial_state(options["initial_state"]),
        "initial_covariance": reduced.initial_covariance(options["initial_covariance"]),
    }
    if options["Q"] is not None:
        options["Q"] = reduced.process_covariance(options["Q"])
    found = _of_varying(reduced.plant, options, missing=missing, own_units=far)
    return replace(found, notes=(reduced.note, *found.notes))


def _of_varying(
    plant: TimeVaryingDescriptorSystem, options: Mapping[str, Any], *, missing: Sequence[str], own_units: bool
) -> Synthesis:
    """Return observer, gains, claims and notes; ``missing``: covariances of noise that were not stated."""
    observer = observer_from_options(plant, options)
    ranks = horizon_ranks(plant, early=observer.early_constraints)
    facts = gain_schedule_summary(observer)
    if missing and not own_units and not _contracts(facts) and plant.ne == plant.nx and _has_steady_state(observer):
        still = DescriptorSystem(
            plant.E.at(1), plant.A.at(0), C=plant.C.at(1), Bf=plant.Phi.at(0), Df=plant.Psi.at(0), dt=plant.dt or 1.0
        )
        options, own_units = {**options, **_identities(PlantUnits.of(still).rounded(), options)}, True
        observer = observer_from_options(plant, options)
        facts = gain_schedule_summary(observer)
    _require_contraction(observer, facts, () if own_units else missing)
    claims = {
        "condition": ranks.condition,
        "condition_k": float(ranks.condition_k),
        "residual_directions": float(ranks.directions),
        "contraction": facts.contraction,
        "steps": float(facts.steps),
    }
    if observer.adaptation is not None:
        claims |= {"excitation": facts.excitation, "excitation_k": float(facts.excitation_k)}
    resolved = {**options, "Q": observer.Q, "R": observer.R}
    # By the names of the plant that is filtered, as they were understood.
    resolved |= {
        "outlier_sizes": observer.outlier_sizes,
        "sensors": observer.sensors,
        "state_bounds": observer.state_bounds,
    }
    return Synthesis(
        plain_options(resolved),
        {"L": facts.L, "K": facts.K},
        observer,
        Certificate({}, claims),
        notes=tuple(_notes(observer, ranks, facts, missing, own_units=own_units)),
        plant=plant,
    )


def _contracts(facts: GainScheduleSummary) -> bool:
    """Whether errors decay along the horizon, or the horizon is too short to tell."""
    return facts.steps < STEPS_TO_CONTRACT or facts.contraction < 1.0


def _identities(units: PlantUnits, options: Mapping[str, Any]) -> dict[str, FloatArray]:
    """Return the covariances that are not given as identities in units in which a plant is near one."""
    found = {"Q": 1.0 / units.equations, "R": 1.0 / units.outputs, "initial_covariance": units.states}
    found["initial_parameter_covariance"] = units.faults
    return {name: np.diag(size**2) for name, size in found.items() if name in options and options[name] is None}


def _has_steady_state(observer: RecursiveObserver) -> bool:
    """Whether a time-invariant plant is detectable, and Q reaches its modes: then its initial-condition response
    decays."""
    if not (observer.plant.is_time_invariant and observer.Q.is_constant and observer.R.is_constant):
        return False
    roots = covariance_factor(observer.Q.at(0), "Q"), covariance_factor(observer.R.at(0), "R")
    return detectability_condition(observer.plant).holds and reached_condition(observer.plant, *roots).holds


def _require_contraction(observer: RecursiveObserver, facts: GainScheduleSummary, identity: Sequence[str]) -> None:
    """Raise `PreconditionError` where errors do not decay along the horizon."""
    if _contracts(facts):
        return
    names = leading_names(facts.survivors, observer.state_names)
    kept = (
        f"keeps the mean factor {facts.contraction:.6g} per step"
        if facts.contraction < float("inf")
        else "grows without bound"
    )
    if _has_steady_state(observer):
        given = f" {' and '.join(identity)} taken as the identity weigh this plant in its units." if identity else ""
        raise PreconditionError(
            "Unclear: the horizon is too short to decide whether errors decay fast enough. The outputs observe every "
            f"state, and with these Q and R the errors decay in the end; but over {facts.steps} steps the product of "
            f"L_k A_k {kept}, in {', '.join(map(repr, names))}.{given} State Q and R in the units of equations and "
            "outputs, or take units in which entries are near one.",
            condition="contraction",
            signals=names,
            unclear=True,
        )
    raise PreconditionError(
        f"Errors do not decay: over {facts.steps} steps the product of L_k A_k {kept}, in "
        f"{', '.join(map(repr, names))}. Either these states are unobservable: measure more, or leave them out; or Q "
        "and initial_covariance claim that they are known exactly: give them a variance.",
        condition="contraction",
        signals=names,
    )


def _notes(
    observer: RecursiveObserver,
    ranks: HorizonRanks,
    facts: GainScheduleSummary,
    missing: Sequence[str],
    *,
    own_units: bool,
) -> Iterator[str]:
    if missing:
        units = ", in units in which the plant is near one (those given are far from these)"
        yield (
            f"No noise is stated: {' and '.join(missing)} taken as the identity{units if own_units else ''}, which "
            "sets gains and deviations."
        )
    if ranks.condition > WARN_MARKOV_CONDITION:
        yield (
            f"H_k has the condition number {ranks.condition:.3g} at k = {ranks.condition_k}: about "
            f"{np.log10(ranks.condition):.0f} digits of the estimate are lost there."
        )
    if observer.plant.is_time_invariant and observer.Q.is_constant and observer.R.is_constant:
        roots = covariance_factor(observer.Q.at(0), "Q"), covariance_factor(observer.R.at(0), "R")
        reached = reached_condition(observer.plant, *roots)
        if not reached.holds:
            yield f"The filter has no steady state: {reached.detail}"
    adaptation = observer.adaptation
    if adaptation is None:
        return
    if adaptation.window > facts.steps:
        yield (
            f"The window of {adaptation.window} samples is longer than the {facts.steps} steps of the horizon: "
            "excitation is not watched."
        )
    prior = float(np.linalg.eigvalsh(np.linalg.inv(adaptation.initial_covariance))[0])
    if facts.excitation < LOST_EXCITATION * prior:
        yield (
            f"The parameters are poorly excited in the window that ends at k = {facts.excitation_k} (information "
            f"{facts.excitation:.3g}, the prior has {prior:.3g}): the values reported there are the prior ones"
            + (
                "."
                if adaptation.form == "random-walk" or adaptation.guard != "none"
                else ", and without a guard S winds up."
            )
        )
    if adaptation.form == "literal" and ranks.directions < observer.plant.ny:
        yield (
            f"The literal form (18) uses {ranks.directions} residual direction(s) of {observer.plant.ny} output(s); "
            "the innovation form uses all parity directions."
        )

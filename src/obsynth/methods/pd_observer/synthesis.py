"""PD observer: A. Filasova, D. Krokavec, V. Serbak, (4)-(6), Theorem 1 (40)-(44), Theorem 2 (61)-(65).

Unlike the paper: P and Q are both variables in Theorem 2; the G of (25), which is in no theorem, acts inside the loop;
what is minimised, ``||[Y Z]||_F + ||P3||_F`` with ``P3 + P3' >= 2 I``, keeps solvers from P3 close to singular.

A decay rate that nobody gives is chosen in the plant's own units, and its gains are small in these.

Of many states gains come in closed form: L = 0 and J of a Kalman filter for unit noise.  Their certificate comes from a
Lyapunov equation of ``A - J C``, for a delta below a limit that it tells.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import Any, NamedTuple

import numpy as np

from obsynth.analysis.conditions import require_all
from obsynth.analysis.plant_units import FAR_UNITS, PlantUnits
from obsynth.analysis.structure import analyse_structure
from obsynth.errors import InfeasibleError, SolverError
from obsynth.methods.conic.lmi import chosen_solver
from obsynth.methods.method import WARN_AMPLIFICATION, Synthesis, own_terms
from obsynth.methods.pd_observer.checks import (
    GAIN_CLAIMS,
    error_inputs,
    prove_gains,
    prove_shipped_stability,
)
from obsynth.methods.pd_observer.conditions import explicit_form, pd_observer_conditions
from obsynth.methods.pd_observer.inequalities import (
    PdSolution,
    PdTask,
    default_delta,
    fastest_mode,
    require_possible,
    solve,
)
from obsynth.methods.pd_observer.method import PdObserver
from obsynth.methods.pd_observer.realisation import (
    coupled_certificate,
    explicit_certificate,
    gain_certificate,
    realise_pd_observer,
    symmetric_certificate,
    with_faults_as_states,
    with_sensor_noise,
)
from obsynth.numerics.arguments import FloatArray, largest_singular_value
from obsynth.numerics.doubling import EQUATION_TOLERANCE, continuous_riccati_solution, symmetric
from obsynth.numerics.matrix_equations import continuous_solution
from obsynth.numerics.ranks import NEGLIGIBLE_SHARE
from obsynth.numerics.scaling import balancing_factors
from obsynth.numerics.spectra import abscissa
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.results.design import Certificate
from obsynth.verification.claims import prove_symmetric_positive

#: Beside the given units of signals that of time is the power of two nearest to this many times the inverse of the
#: plant's fastest mode, where the objective weighs J and L as it does for a plant with modes of a few 1/s in seconds.
TIME_UNITS = 10.0
#: By default errors should decay at least at this fraction of the plant's fastest mode.
DECAY_SHARE = 0.1
#: When the gains that this takes are out of proportion, less is tried.
DECAY_RETRIES = (1.0, 0.3, 0.1, 0.03)
#: Gains may grow by this factor for the sake of the default decay rate.
DECAY_PRICE = 100.0
#: In the plant's own units, gains of this size are small, whatever the smallest ones are.
SMALL_GAIN = 1.0
#: With more unknown states the least of these rates comes first, in one set of units, and the first failure is the end.
MANY_UNKNOWN_STATES = 100
#: By default a decay rate is never closer to that of an unobservable mode, which nothing moves.
HIDDEN_SHARE = 0.5


class _Units(NamedTuple):
    """Units in which the gains are found: what the augmented states, the outputs and the time are multiples of."""

    states: FloatArray
    outputs: FloatArray
    time: float

    def size(self, gains: PdGains) -> float:
        """Return the spectral norm of ``[J L S]`` in these units, S from outputs straight to the estimates."""
        parts = [self.time * gains.J, gains.L, gains.observer.Dy[: len(self.states)]]
        return largest_singular_value(np.hstack([part * self.outputs for part in parts]) / self.states[:, None])


def design_gains(plant: DescriptorSystem, asked: PdObserver) -> tuple[PdGains, list[Mapping[str, Any]]]:
    """Return the gains to ship and the records of all solver runs.

    What decays as asked is small in the given units.  A rate that is ours to choose is chosen, with its gains, in the
    plant's own units, so that it is the same in any; only a higher one may come from the given units.
    """
    free = asked.decay is None and asked.disk is None
    own = free and asked.gain_bound is None and asked.engines_for(plant.nx + plant.nf)[0] == "lmi"
    plain = gains_for(plant, asked, decay=0.0 if asked.decay is None else float(asked.decay), own=own)
    records = [plain.record]
    slowest = max((mode.real for mode in analyse_structure(plant).unobservable_modes), default=-np.inf)
    target = float(min(DECAY_SHARE * fastest_mode(plant.A), -HIDDEN_SHARE * slowest))
    if not free or plain.abscissa <= -target:
        return plain, records
    if plant.nx + plant.nf > MANY_UNKNOWN_STATES:
        # For many states as fast as the size of the gains allows: from the least rate upwards.
        faster, most = plain, DECAY_PRICE * _given_units(plant).size(plain)
        for share in sorted(DECAY_RETRIES):
            if share * target <= -plain.abscissa:
                continue
            try:
                faster = gains_for(plant, asked, decay=share * target, most=most)
            except (SolverError, InfeasibleError):
                break  # this rate was not asked for
        return faster, records
    found = _faster(plant, asked, plain, target, records, own=own)
    if own and found.decay < target:
        try:
            given = gains_for(plant, asked, decay=0.0)
        except (SolverError, InfeasibleError):
            return found, records
        records.append(given.record)
        other = _faster(plant, asked, given, target, records, own=False)
        found = other if other.decay > found.decay else found
    return found, records


def _faster(
    plant: DescriptorSystem,
    asked: PdObserver,
    plain: PdGains,
    target: float,
    records: list[Mapping[str, Any]],
    *,
    own: bool,
) -> PdGains:
    """Return gains that decay as fast as moderate ones do, or ``plain``, the smallest; adds the records."""
    units, least = (_own_units(plant), SMALL_GAIN) if own else (_given_units(plant), 0.0)
    most = DECAY_PRICE * max(units.size(plain), least)
    for share in DECAY_RETRIES:
        if share * target <= -plain.abscissa:
            break
        try:
            faster = gains_for(plant, asked, decay=share * target, own=own)
        except SolverError as error:
            records.append(error.record)
            continue
        except InfeasibleError:
            continue  # this rate was not asked for
        records.append(faster.record)
        if units.size(faster) <= most:
            return faster
    return plain


def gains_for(
    plant: DescriptorSystem, asked: PdObserver, *, decay: float, most: float | None = None, own: bool = False
) -> PdGains:
    """Return gains of the first coordinates whose answer is proved; with a bound ``most``, of the first alone.
    The plant's ``own`` units come first, or those that suit the engine."""
    delta = default_delta(plant, asked, decay)
    require_possible(plant, asked, delta=delta, decay=decay)
    failure = SolverError(
        "The gains that the solver returned could not be proved to be stable: the result is inconclusive."
    )
    engine, *spare = asked.engines_for(plant.nx + plant.nf)
    for name in (engine, *spare):
        tried = _units(plant, asked, balanced_first=name != "lmi", own_first=own)
        for units in islice(tried, None if most is None else 1):
            try:
                found = _solved(plant, asked, name, delta, decay, units, most)
            except SolverError as error:
                # What the spare engine meets says less than why it was needed.
                failure = error if name == engine else failure
                continue
            if found is not None and found.proved:
                return replace(found, engine=name)
    raise SolverError(
        f"{failure} {_advice(asked)}", record={**failure.record, "delta": delta, "decay": decay}
    ) from failure


def _advice(asked: PdObserver) -> str:
    wishes = ("decay", "disk", "gain_bound", "fault_rate_gain", "noise_gain", "adaptation_gain", "adaptation_range")
    given = [name for name in wishes if getattr(asked, name) is not None]
    if not given:
        return "Rescale the plant, or try another delta or solver."
    return f"Gains exist without {', '.join(given)}: ask for less there, or try another delta."


def _units(plant: DescriptorSystem, asked: PdObserver, *, balanced_first: bool, own_first: bool) -> Iterable[_Units]:
    """Return units of augmented states and outputs: the user's, balancing ones, those with the plant near one."""
    found = [*_candidate_units(plant, asked)]
    if asked.gain_bound is not None:
        return found
    users, *others = found
    if own_first:
        return [_own_units(plant), *others, users]
    rounded = PlantUnits.of(plant).rounded()
    natural = _with_faults(rounded, users.time)
    if rounded.spread > FAR_UNITS:
        return [users, natural, *others]
    # A Riccati equation has no objective that would weigh gains in the user's units.
    if balanced_first and len(others) == 2:
        return [others[0], users, others[1], natural]
    return [users, *others, natural]


def _own_units(plant: DescriptorSystem) -> _Units:
    """Return the plant's own units as they are: powers of two near them would hang on the given ones.

    With the fastest mode as the unit of rates, J and L weigh the same there.  A unit ten times longer makes L cheap:
    noise then reaches the estimates several times larger.  So it does by an output that hardly shows the states but for
    its noise, where that is stated: beside the others its unit is no less than its noise has it.
    """
    found = _with_faults(PlantUnits.of(plant), 1.0 / fastest_mode(plant.A))
    noise = np.linalg.norm(plant.Dw, axis=1)
    shown = float(np.max(found.outputs[noise > 0.0] / noise[noise > 0.0], initial=0.0))
    return found._replace(outputs=np.maximum(found.outputs, shown * noise))


def _with_faults(units: PlantUnits, time: float) -> _Units:
    return _Units(np.concatenate([units.states, units.faults]), 1.0 / units.outputs, time)


def _given_units(plant: DescriptorSystem) -> _Units:
    return _Units(np.ones(plant.nx + plant.nf), np.ones(plant.ny), 1.0)


def _candidate_units(plant: DescriptorSystem, asked: PdObserver) -> Iterator[_Units]:
    n, ny = plant.nx + plant.nf, plant.ny
    time = float(np.exp2(np.round(np.log2(TIME_UNITS / fastest_mode(plant.A)))))
    yield _given_units(plant)._replace(time=time)
    if asked.gain_bound is not None:
        return  # it is a bound in the user's units
    augmented = with_faults_as_states(plant, _inner_gain(plant, asked))
    system = np.zeros((n + ny, n + ny))
    system[:n, :n], system[n:, :n] = augmented.A, augmented.C
    factors = balancing_factors(system)
    if np.any(factors != 1.0):
        yield _Units(factors[:n], factors[n:], time)
    sizes = np.abs(np.vstack([augmented.A, augmented.C]))
    columns = np.exp2(-np.round(np.log2(np.maximum(np.max(sizes, axis=0), np.finfo(np.float64).tiny))))
    rows = np.max(np.abs(augmented.C) * columns, axis=1)
    yield _Units(columns, np.exp2(np.round(np.log2(np.where(rows > 0.0, rows, 1.0)))), time)


def _inner_gain(plant: DescriptorSystem, asked: PdObserver) -> FloatArray | None:
    """Return the G to design with; a bound on the gains is on those in the loop, in the fault's own coordinates."""
    return None if asked.gain_bound is not None else asked.gain_matrix(plant.nf)


def _solved(
    plant: DescriptorSystem,
    asked: PdObserver,
    engine: str,
    delta: float,
    decay: float,
    units: _Units,
    most: float | None = None,
) -> PdGains | None:
    """Return the gains found in some units, with a proved certificate where there is one."""
    states, outputs, unit = units
    task = _task(plant, asked, delta, decay, units)
    if engine == "riccati":
        found, used = closed_form(task, free_delta=asked.delta is None, once=most is not None)
        delta = delta if used == task.delta else used * unit
    else:
        found = solve(task, solver=asked.solver)
    g = _inner_gain(plant, asked)
    loop = np.eye(len(states))
    if g is not None:
        loop[plant.nx :, plant.nx :] = g
    back = np.linalg.inv(loop)
    gain_j, gain_l = (loop @ (states[:, None] * part / outputs) for part in (found.J / unit, found.L))
    if most is not None and not largest_singular_value(np.hstack([gain_j, gain_l])) <= most:
        raise SolverError("The gains are very large, and no decay rate was asked for.", record=found.record)
    p3, *p1 = (back.T @ (matrix / states[:, None] / states) @ back for matrix in (found.P3, *found.P1))
    return certified(plant, asked, PdSolution(gain_j, gain_l, tuple(p1), p3, found.record), delta=delta, decay=decay)


def _task(
    plant: DescriptorSystem,
    asked: PdObserver,
    delta: float,
    decay: float,
    units: _Units,
) -> PdTask:
    (states, outputs, unit), nx, nf = units, plant.nx, plant.nf
    g = _inner_gain(plant, asked)
    ends = asked.range_numbers
    gains = [g] if ends is None else [end * np.eye(nf) for end in ends]
    plants = [with_faults_as_states(plant, gain) for gain in gains]
    noisy = with_sensor_noise(plant)
    shown, rate = np.zeros((nf, nx + nf)), np.zeros((nx + nf, nf))
    shown[:, nx:], rate[nx:] = np.eye(nf) if g is None else g, np.eye(nf) if g is None else np.linalg.inv(g)
    padded = np.vstack([noisy.Bw, np.zeros((nf, noisy.nw))])
    return PdTask(
        plants=tuple((unit * p.A * states / states[:, None], p.C * states / outputs[:, None]) for p in plants),
        theorem=asked.theorem,
        delta=delta / unit,
        decay=decay * unit,
        disk=None if asked.disk_numbers is None else (asked.disk_numbers[0] * unit, asked.disk_numbers[1] * unit),
        gain_bound=asked.gain_bound,
        gain_unit=1.0 / unit,
        rate_gain=asked.fault_rate_gain,
        noise_gain=asked.noise_gain,
        rate=unit * rate / states[:, None],
        shown=shown * states,
        process=unit * padded / states[:, None],
        sensor=noisy.Dw / outputs[:, None],
        sensor_rate=unit * noisy.Dw / outputs[:, None],
    )


def synthesise(plant: DescriptorSystem, asked: PdObserver, *, progress: Callable[[str], None]) -> Synthesis:
    """Design the observer; see `obsynth.pd_observer` for the options, results and errors."""
    solver_of = chosen_solver(asked.solver, asked.solver_options)
    if own_terms(asked) or asked.region is not None:
        from obsynth.conditions.own_terms import pd_by_inequality

        return pd_by_inequality(plant, asked, progress=progress)
    asked = replace(asked, solver=solver_of)
    progress("checking the existence conditions")
    require_all(pd_observer_conditions(plant))
    form = explicit_form(plant)
    work = plant if form is None else form.plant
    g = asked.gain_matrix(work.nf)
    progress("solving the matrix inequalities")
    gains, records = design_gains(work, asked)
    shipped = asked.range_numbers and min(max(1.0, asked.range_numbers[0]), asked.range_numbers[1])
    loop = shipped * np.eye(work.nf) if shipped else g
    claims = {"theorem": float(gains.theorem), "delta": gains.delta, "decay": gains.decay}
    bounds: dict[str, float | None] = {
        "gain_bound": asked.gain_bound,
        "fault_rate_gain": asked.fault_rate_gain,
        "noise_gain": asked.noise_gain,
    }
    claims |= {name: float(bound) for name, bound in bounds.items() if bound is not None}
    matrices = {"P1": gains.P1, "P3": gains.P3, **gains.gain_certificates}
    if asked.disk_numbers is not None:
        claims |= {"disk_centre": asked.disk_numbers[0], "disk_radius": asked.disk_numbers[1]}
    if asked.range_numbers is not None:
        claims |= {"adaptation_low": asked.range_numbers[0], "adaptation_high": asked.range_numbers[1]}
        matrices |= {"P1_low": gains.ends[0], "P1_high": gains.ends[1]}
    return Synthesis(
        _resolved(asked, gains, g),
        listed_gains(work, gains.J, gains.L, loop),
        gains.observer,
        Certificate(matrices, claims),
        {"engine": gains.engine, "runs": records},
        notes(work, asked, gains),
        transformation=form,
    )


def _resolved(asked: PdObserver, gains: PdGains, g: FloatArray | None) -> dict[str, Any]:
    return {
        **asked.as_plain(),
        "delta": gains.asked_delta,
        "decay": gains.decay,
        "disk": None if asked.disk_numbers is None else list(asked.disk_numbers),
        "adaptation_gain": None if g is None else g.tolist(),
        "adaptation_range": None if asked.range_numbers is None else list(asked.range_numbers),
    }


def listed_gains(plant: DescriptorSystem, J: FloatArray, L: FloatArray, g: FloatArray | None) -> dict[str, FloatArray]:
    """Return the paper's J, L, M, N (and G) of gains in the loop ``[J; G M]`` and ``[L; G N]``."""
    nx = plant.nx
    inner = np.eye(plant.nf) if g is None else g
    bottom = [np.asarray(np.linalg.solve(inner, part[nx:])) for part in (J, L)]
    gains = {"J": J[:nx], "L": L[:nx], "M": bottom[0], "N": bottom[1]}
    return gains if g is None else {**gains, "G": g}


def notes(plant: DescriptorSystem, asked: PdObserver, gains: PdGains) -> tuple[str, ...]:
    """Return what a user should know: how delta and the decay rate were chosen, slow or noisy estimates."""
    found = []
    if asked.delta is None:
        less = ", or as much of it as the closed form serves" if gains.engine == "riccati" else ""
        found.append(f"delta = {gains.asked_delta:.4g} s was chosen, from the plant's fastest mode{less}.")
    if asked.decay is None and gains.decay > 0.0:
        found.append(
            f"A decay rate of {gains.decay:.4g} 1/s was imposed: a tenth of that of the plant's fastest mode, or as "
            "much of it as is "
            "reachable with moderate gains; without it errors would decay more slowly. decay: 0 takes the smallest "
            "gains."
        )
    found += _engine_notes(asked, gains, plant.nx + plant.nf)
    direct = gains.observer.Dy[gains.observer.fault_rows]
    return (
        *found,
        *[
            f"The estimate of {name!r} amplifies high-frequency errors of the measurements by up to "
            f"{np.linalg.norm(row):.3g}."
            for name, row in zip(plant.fault_names, direct, strict=True)
            if np.linalg.norm(row) > WARN_AMPLIFICATION
        ],
    )


_CLOSED_FORM = "a Riccati equation (engine 'riccati'), with L = 0 and N = 0."


def _engine_notes(asked: PdObserver, gains: PdGains, states: int) -> list[str]:
    wanted = asked.engines_for(states)[0]
    if gains.engine != wanted:
        return [
            f"The engine {wanted!r} failed: these gains come from "
            + ("the inequality (engine 'lmi')." if gains.engine == "lmi" else _CLOSED_FORM)
        ]
    if asked.engine == "auto" and wanted != "lmi":
        return [f"With {states} unknown states the gains come from {_CLOSED_FORM} Engine 'lmi' may find smaller ones."]
    return []


@dataclass(frozen=True, eq=False)
class PdGains:
    """Gains in the loop with what proves them."""

    J: FloatArray  # (nx + nf, ny), the paper's [J; G M]
    L: FloatArray  # (nx + nf, ny), [L; G N]
    P1: FloatArray  # (nx + nf, nx + nf), for the state [x; f]
    P3: FloatArray
    theorem: int
    asked_delta: float  # seconds, of the design; ``delta``: of the certificate
    delta: float
    decay: float  # alpha, 1/seconds
    observer: LinearObserver
    record: Mapping[str, Any]
    ends: tuple[FloatArray, ...] = ()  # P1 at the ends of the range of adaptation gains
    gain_certificates: Mapping[str, FloatArray] = field(default_factory=dict)  # P_rate, P_noise (nx + nf, nx + nf)
    proved: bool = False
    proved_in_double_precision: bool = False
    engine: str = ""

    @property
    def abscissa(self) -> float:
        """Largest real part of an eigenvalue of the error system, 1/seconds."""
        return abscissa(self.observer.Az, 0.0)


def certified(
    plant: DescriptorSystem, asked: PdObserver, found: PdSolution, *, delta: float, decay: float
) -> PdGains | None:
    """Return the gains with the solver's certificate or a computed one; ``None`` without a realisation."""
    augmented = with_faults_as_states(plant)
    try:
        observer = realise_pd_observer(plant, augmented, found.J, found.L)
    except np.linalg.LinAlgError:
        return None
    ends = asked.range_numbers
    p1, p3 = symmetric(found.P1[0]), symmetric(found.P3) if asked.theorem == 2 else found.P3
    gains = PdGains(found.J, found.L, p1, p3, asked.theorem, delta, delta, decay, observer, found.record)
    if ends is not None:
        return _certified_range(plant, replace(gains, ends=found.P1), ends)
    certificates = _gain_certificates(plant, asked, gains)
    if certificates is None:
        return gains
    gains = _judged(replace(gains, gain_certificates=certificates))
    if gains.proved_in_double_precision:
        return gains
    own = explicit_certificate(observer.Az, observer.Cz[: observer.order], decay=decay) if asked.theorem == 1 else None
    if own is None:
        return gains
    other = _judged(replace(gains, P1=own[0], P3=own[1], delta=own[2]))
    return gains if gains.proved and not other.proved_in_double_precision else other


def _gain_certificates(plant: DescriptorSystem, asked: PdObserver, gains: PdGains) -> dict[str, FloatArray] | None:
    """Return the certificates of the bounds on l2 gains that are asked for; ``None`` when one is not found."""
    observer, found = gains.observer, {}
    for option, kind in GAIN_CLAIMS.items():
        bound = getattr(asked, option)
        if bound is None:
            continue
        entering = error_inputs(with_sensor_noise(plant), gains.J, gains.L, kind)
        certificate = gain_certificate(observer.Az, entering, observer.Cz[observer.fault_rows], float(bound))
        if certificate is None:
            return None
        found[f"P_{kind}"] = certificate
    return found


def _judged(gains: PdGains) -> PdGains:
    """Return the gains with the outcome of proving their certificate."""
    proofs = [
        prove_symmetric_positive(gains.P1),
        prove_shipped_stability(gains.observer, gains.P1, gains.P3, delta=gains.delta, decay=gains.decay),
    ]
    if gains.theorem == 2:
        proofs.append(prove_symmetric_positive(gains.P3))
    return replace(
        gains,
        proved=all(proof.proved for proof in proofs),
        proved_in_double_precision=all(proof.in_double_precision for proof in proofs),
    )


def _certified_range(plant: DescriptorSystem, gains: PdGains, ends: tuple[float, float]) -> PdGains:
    """Certify every ``g I`` of a range by its ends (affine in g); ships g = 1 or the nearer end, P1 interpolated."""
    p1 = tuple(map(symmetric, gains.ends))
    plants = [with_faults_as_states(plant, end * np.eye(plant.nf)) for end in ends]
    proved = all(
        prove_symmetric_positive(matrix).proved
        and prove_gains(p.A, p.C, gains.J, gains.L, matrix, gains.P3, delta=gains.delta, decay=gains.decay).proved
        for matrix, p in zip(p1, plants, strict=True)
    )
    shipped = min(max(1.0, ends[0]), ends[1])
    share = (shipped - ends[0]) / (ends[1] - ends[0])
    middle = (1.0 - share) * p1[0] + share * p1[1]
    loop = np.eye(len(middle))
    loop[plant.nx :, plant.nx :] *= shipped
    back = np.linalg.inv(loop)
    gain_j, gain_l = loop @ gains.J, loop @ gains.L
    p3 = back.T @ gains.P3 @ back
    p3 = symmetric(p3) if gains.theorem == 2 else p3
    moved = replace(
        gains,
        J=gain_j,
        L=gain_l,
        P1=symmetric(back.T @ middle @ back),
        P3=p3,
        ends=p1,
        observer=realise_pd_observer(plant, with_faults_as_states(plant), gain_j, gain_l),
    )
    moved = _judged(moved)
    return replace(moved, proved=proved and moved.proved)


#: Share of its limit at which delta is taken where it is free.
DELTA_SHARE = 0.5
#: Times that states are changed to those in which a Riccati solution is near one.
MOST_NORMALISATIONS = 4
#: With more states the Riccati equation is solved by doubling first.
MOST_STATES_FOR_SCHUR = 60
#: With more still, the QZ algorithm would take minutes.
MOST_STATES_FOR_QZ = 200


def closed_form(task: PdTask, *, free_delta: bool, once: bool = False) -> tuple[PdSolution, float]:
    """Return gains for unit noise from a Riccati equation, L = 0, their certificate, and the delta that it is for."""
    try:
        return _closed_form(task, free_delta=free_delta)
    except SolverError as error:
        if once or "delta_limit" in error.record:
            raise
        failure = error
    a, c = task.plants[0]
    states = inverse = np.eye(len(a))
    for _ in range(MOST_NORMALISATIONS):
        found = _normalising(inverse @ a @ states, c @ states)
        if found is None:
            raise failure
        states, inverse = states @ found[0], found[1] @ inverse
        moved = replace(task, plants=((inverse @ a @ states, c @ states),))
        try:
            own, delta = _closed_form(moved, free_delta=free_delta)
        except SolverError:
            continue
        p1, p3 = (inverse.T @ part @ inverse for part in (own.P1[0], own.P3))
        return replace(own, J=states @ own.J, L=states @ own.L, P1=(symmetric(p1),), P3=p3), delta
    raise failure


def _normalising(a: FloatArray, c: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    """Return a change of states, and its inverse, in which the solution of the Riccati equation is near one."""
    p = _doubled(a, c)
    if p is None and len(a) <= MOST_STATES_FOR_QZ:
        p = continuous_solution(a, c, np.eye(len(a)), np.eye(len(c)))
    if p is None:
        return None
    sizes, directions = np.linalg.eigh(symmetric(p))
    roots = np.sqrt(np.maximum(sizes, NEGLIGIBLE_SHARE * sizes[-1]))
    return directions * roots, (directions / roots).T


def _closed_form(task: PdTask, *, free_delta: bool) -> tuple[PdSolution, float]:
    a, c = task.plants[0]
    shifted = a + task.decay * np.eye(len(a))
    record = {"what": _WHAT, "solver": "Riccati equation, LAPACK"}
    gain = _riccati_gain(shifted, c, record)
    moving = shifted - gain @ c
    found = symmetric_certificate(moving)
    if found is None:
        raise SolverError(
            "A Riccati equation gave gains that are not stable: the result is inconclusive.", record=record
        )
    p3, weight, limit = found
    delta = min(task.delta, DELTA_SHARE * limit) if free_delta else task.delta
    if delta < limit:
        p1 = p3 + 0.5 * delta * weight
    elif task.theorem == 1:
        p1, p3 = coupled_certificate(moving, delta)
    else:
        raise SolverError(
            "The closed form serves Theorem 2 for smaller delta alone: take engine 'lmi', or leave delta out.",
            record={**record, "delta_limit": limit},
        )
    return PdSolution(gain, np.zeros_like(gain), (symmetric(p1),), p3, record), delta


_WHAT = "a PD observer with L = 0"


def _riccati_gain(a: FloatArray, c: FloatArray, record: Mapping[str, Any]) -> FloatArray:
    """Return the gain of a Kalman filter for unit noise: of many states by doubling, else from the Hamiltonian matrix.

    Where that is not found, or not stable, by the QZ algorithm on a pencil, which takes several times as long.
    """
    from scipy.linalg import schur

    n, one = len(a), np.eye(len(a))
    p = _doubled(a, c)
    if p is not None and abscissa(a - p @ c.T @ c, 0.0) < 0.0:
        return np.asarray(p @ c.T)
    try:
        _, basis, stable = schur(np.block([[a.T, -c.T @ c], [-one, -a]]), sort="lhp")
        p = np.linalg.solve(basis[:n, :n].T, basis[n:, :n].T)
        gain = np.asarray(0.5 * (p + p.T) @ c.T)
        if stable == n and abscissa(a - gain @ c, 0.0) < 0.0:
            return gain
    except np.linalg.LinAlgError:
        pass
    p = None if n > MOST_STATES_FOR_QZ else continuous_solution(a, c, one, np.eye(len(c)))
    if p is None:
        raise SolverError("The Riccati equation was not solved: the result is inconclusive.", record=record)
    return np.asarray(p @ c.T)


def _doubled(a: FloatArray, c: FloatArray) -> FloatArray | None:
    """Return the solution of the equation of `_riccati_gain` for many states, in a tenth of the time of eigenvalues."""
    if len(a) <= MOST_STATES_FOR_SCHUR:
        return None
    p = continuous_riccati_solution(a, c, np.eye(len(a)), np.eye(len(c)))
    if p is None:
        return None
    terms = (a @ p, p @ c.T @ c @ p, np.eye(len(a)))
    left = float(np.linalg.norm(terms[0] + terms[0].T - terms[1] + terms[2]))
    return p if left <= EQUATION_TOLERANCE * sum(float(np.linalg.norm(term)) for term in terms) else None

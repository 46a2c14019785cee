"""PD observer: A. Filasova, D. Krokavec, V. Serbak, (4)-(6), Theorem 1 (40)-(44), Theorem 2 (61)-(65).

Deviations from the paper: P and Q are both variables in Theorem 2; the G of (25), which appears in no theorem, acts
inside the loop; ``||[Y Z]||_F + ||P3||_F`` is minimised with ``P3 + P3' >= 2 I``, so that P3 is not close to singular.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from itertools import islice
from typing import Any, NamedTuple

import numpy as np

from obsynth.analysis.existence.condition import require_all
from obsynth.analysis.existence.filasova import explicit_form, pd_observer_conditions
from obsynth.analysis.structure import analyse_structure
from obsynth.conditions.lmi import chosen_solver
from obsynth.conditions.options import own_terms
from obsynth.conditions.pd_inequalities import PdSolution, PdTask, solve
from obsynth.errors import InfeasibleError, ObsynthError, SolverError
from obsynth.methods.engines.fewer_sensors import AS_QUIET, left_out, with_fewer_sensors
from obsynth.methods.engines.sensor_noise import error_deviation, fault_deviation
from obsynth.methods.method import WARN_AMPLIFICATION, Synthesis
from obsynth.methods.pd_observer.closed_form import closed_form
from obsynth.methods.pd_observer.gains import PdGains, certified
from obsynth.methods.pd_observer.limits import default_delta, fastest_shown_mode, require_possible
from obsynth.methods.pd_observer.method import PdObserver
from obsynth.methods.pd_observer.realisation import realise_pd_observer, with_faults_as_states, with_sensor_noise
from obsynth.numerics.arrays import FloatArray, largest_singular_value
from obsynth.numerics.scaling import balancing_factors
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.plant_units import FAR_UNITS, PlantUnits
from obsynth.plants.transformations.redundant_outputs import MergedOutputs, merged_outputs, nearly_merged_outputs
from obsynth.results.design import Certificate
from obsynth.verification.error_system import ErrorModel

#: With the user's units of signals, the unit of time is the power of two nearest to so many times the inverse of the
#: plant's fastest mode.  The objective then weighs J and L as for a plant with modes of a few 1/s in seconds.
TIME_UNITS = 10.0

#: By default errors should decay at least at this fraction of the plant's fastest mode.
DECAY_SHARE = 0.1

#: Shares of that rate that are tried in turn, until the gains are moderate.
DECAY_RETRIES = (1.0, 0.3, 0.1, 0.03)

#: Largest factor by which gains may grow for the default decay rate.
DECAY_PRICE = 100.0

#: In the plant's own units, gains of at most this size count as small, even if smaller ones exist.
SMALL_GAIN = 1.0

#: With more unknown states the rates are tried in increasing order, in one set of units, until one fails.
MANY_UNKNOWN_STATES = 100

#: Default decay rates are at most this share of the decay rate of an unobservable mode, which no gain changes.
HIDDEN_SHARE = 0.5

#: With more unknown states no outputs are merged or left out, since the inequality is solved for each choice.
MOST_UNKNOWNS_OF_CHOICES = 10

#: Decay rates that differ by at most this factor count as equal.
AS_FAST = 1.001

_CLOSED_FORM = "a Riccati equation (engine 'riccati'), with L = 0 and N = 0."


class _Units(NamedTuple):
    """The units of the augmented states, the outputs and the time in which the gains are computed."""

    states: FloatArray
    outputs: FloatArray
    time: float

    def size(self, gains: PdGains) -> float:
        """Return the spectral norm of ``[J L S]`` in these units; S is the feedthrough from outputs to estimates."""
        parts = [self.time * gains.J, gains.L, gains.observer.Dy[: len(self.states)]]
        return largest_singular_value(np.hstack([part * self.outputs for part in parts]) / self.states[:, None])


def design_gains(plant: DescriptorSystem, method: PdObserver) -> tuple[PdGains, list[Mapping[str, Any]]]:
    """Return the gains to ship and the records of all solver runs.

    Dependent outputs are merged.  Nearly dependent ones are merged if the observer is then as fast (with a stated
    ``decay``: fast enough) and less noisy.  Bounds on gains and noise refer to the outputs as given, so that nothing is
    merged with them.  If noise is stated, outputs that make the estimates noisier are left out, since the smallest
    gains do not take noise into account.
    """
    as_they_are = method.gain_bound is not None or method.noise_gain is not None
    first, records = _merged_if_quieter(plant, method, as_they_are=as_they_are)
    unknowns = plant.nx + plant.nf
    few = unknowns <= MOST_UNKNOWNS_OF_CHOICES and method.engines_for(unknowns)[0] == "lmi"
    if method.further or method.adaptation_gain is not None or method.decay == 0.0 or not few:
        return first, records
    lag = fastest_shown_mode(plant)

    def noise(candidate: PdGains) -> float:
        return error_deviation(_error_model(plant, candidate), lag)

    fewer = with_fewer_sensors(plant, lambda some: _of_merged(plant, method, some)[0], noise)
    candidates = [first, *fewer]
    rates = [-candidate.abscissa for candidate in candidates]
    # All candidates reach a stated rate; by default, rates above the target are no advantage.
    wanted = 0.0 if method.decay else min(_target(plant), max(rates)) / AS_FAST
    deviations = [noise(one) if rate >= wanted else np.inf for one, rate in zip(candidates, rates, strict=True)]
    # The first of the candidates with about the least noise, and so the one with all outputs if it is among them.
    quiet = next(i for i, deviation in enumerate(deviations) if deviation <= AS_QUIET * min(deviations))
    return candidates[quiet], records


def _merged_if_quieter(
    plant: DescriptorSystem, method: PdObserver, *, as_they_are: bool
) -> tuple[PdGains, list[Mapping[str, Any]]]:
    """Return the gains for merged outputs, where some depend or nearly depend on others, and the records of all runs.

    With ``as_they_are`` no outputs are merged.
    """
    choices = [None] if as_they_are else [merged_outputs(plant), nearly_merged_outputs(plant)]
    first, records = _of_merged(plant, method, choices[0])
    for merged in choices[1:]:
        if merged is None:
            continue
        try:
            other, more = _of_merged(plant, method, merged)
        except ObsynthError:
            continue  # the differences between the outputs are needed
        # Both reach a stated rate; a faster one is no advantage then.
        as_fast = bool(method.decay) or AS_FAST * other.abscissa <= first.abscissa
        if as_fast and fault_deviation(plant, other.observer) < fault_deviation(plant, first.observer):
            first, records = other, [*records, *more]
    return first, records


def _of_merged(
    plant: DescriptorSystem, method: PdObserver, merged: MergedOutputs | None
) -> tuple[PdGains, list[Mapping[str, Any]]]:
    """Return the gains of a plant from the gains for its merged outputs."""
    if merged is None:
        return _gains_and_records(plant, method)
    gains, records = _gains_and_records(merged.plant, method)
    J, L = gains.J @ merged.weights, gains.L @ merged.weights
    observer = realise_pd_observer(plant, with_faults_as_states(plant), J, L)
    return replace(gains, J=J, L=L, observer=observer), records


def _gains_and_records(plant: DescriptorSystem, method: PdObserver) -> tuple[PdGains, list[Mapping[str, Any]]]:
    """Return the gains and the records of all solver runs.

    For a stated decay, the gains are the smallest in the user's units; if noise is stated, those in the plant's own
    units are taken if less noise reaches the fault estimates.  A default decay and its gains are chosen in the plant's
    own units, so that they do not depend on the user's; the user's units are used if they give a higher rate.
    """
    free = method.decay is None and method.disk is None
    has_objective = method.gain_bound is None and method.engines_for(plant.nx + plant.nf)[0] == "lmi"
    own = free and has_objective
    plain = gains_for(plant, method, decay=0.0 if method.decay is None else float(method.decay), own=own)
    records = [plain.record]
    if method.decay and has_objective and method.disk is None and method.noise_gain is None and plant.Dw.any():
        return _less_noisy(plant, method, plain)
    target = _target(plant)
    if not free or plain.abscissa <= -target:
        return plain, records
    if plant.nx + plant.nf > MANY_UNKNOWN_STATES:
        # For many states the rates are tried from the least one upwards, as long as the gains are moderate.
        faster, most = plain, DECAY_PRICE * _given_units(plant).size(plain)
        for share in sorted(DECAY_RETRIES):
            if share * target <= -plain.abscissa:
                continue
            try:
                faster = gains_for(plant, method, decay=share * target, most=most)
            except (SolverError, InfeasibleError):
                break  # the user did not require this rate
        return faster, records
    gains = _faster(plant, method, plain, target, records, own=own)
    if own and gains.decay < target:
        try:
            in_given_units = gains_for(plant, method, decay=0.0)
        except (SolverError, InfeasibleError):
            return gains, records
        records.append(in_given_units.record)
        other = _faster(plant, method, in_given_units, target, records, own=False)
        gains = other if other.decay > gains.decay else gains
    return gains, records


def _target(plant: DescriptorSystem) -> float:
    """Return the rate (1/s) at which errors should decay by default."""
    slowest = max((mode.real for mode in analyse_structure(plant).unobservable_modes), default=-np.inf)
    return float(min(DECAY_SHARE * fastest_shown_mode(plant), -HIDDEN_SHARE * slowest))


def _error_model(plant: DescriptorSystem, gains: PdGains) -> ErrorModel:
    """Return the error system of the gains, for the plant with constant faults as states."""
    nf = plant.nf
    return ErrorModel(plant, gains.observer, np.eye(plant.nx + nf), Phi=np.zeros((nf, nf)), Cw=np.eye(nf))


def _less_noisy(plant: DescriptorSystem, method: PdObserver, plain: PdGains) -> tuple[PdGains, list[Mapping[str, Any]]]:
    """Return the gains for a stated decay with less noise: those in the user's units, or those in the plant's own.

    The smallest gains depend on the units: with one output in a unit twice as large, up to six times as much noise
    reached the estimates.
    """
    try:
        other = gains_for(plant, method, decay=plain.decay, own=True)
    except (SolverError, InfeasibleError):
        return plain, [plain.record]
    is_better = fault_deviation(plant, other.observer) < fault_deviation(plant, plain.observer)
    return other if is_better else plain, [plain.record, other.record]


def _faster(
    plant: DescriptorSystem,
    method: PdObserver,
    plain: PdGains,
    target: float,
    records: list[Mapping[str, Any]],
    *,
    own: bool,
) -> PdGains:
    """Return the fastest gains that are moderate, or ``plain``, the smallest gains; adds to the records."""
    units, least = (_own_units(plant), SMALL_GAIN) if own else (_given_units(plant), 0.0)
    most = DECAY_PRICE * max(units.size(plain), least)
    for share in DECAY_RETRIES:
        if share * target <= -plain.abscissa:
            break
        try:
            faster = gains_for(plant, method, decay=share * target, own=own)
        except SolverError as error:
            records.append(error.record)
            continue
        except InfeasibleError:
            continue  # the user did not require this rate
        records.append(faster.record)
        if units.size(faster) <= most:
            return faster
    return plain


def gains_for(
    plant: DescriptorSystem, method: PdObserver, *, decay: float, most: float | None = None, own: bool = False
) -> PdGains:
    """Return the first gains whose stability is proved, from several units of the plant.

    The plant's ``own`` units are tried first, or else those that suit the engine.  With a bound ``most`` on the gains
    only the first units are tried.
    """
    delta = default_delta(plant, method, decay)
    require_possible(plant, method, delta=delta, decay=decay)
    failure = SolverError(
        "The gains that the solver returned could not be proved to be stable: the result is inconclusive."
    )
    engine, *spare = method.engines_for(plant.nx + plant.nf)
    for name in (engine, *spare):
        tried = _units(plant, method, balanced_first=name != "lmi", own_first=own)
        for units in islice(tried, None if most is None else 1):
            try:
                gains = _solved(plant, method, name, delta, decay, units, most)
            except SolverError as error:
                # The error of the first engine is reported, not that of the engine that was tried instead.
                failure = error if name == engine else failure
                continue
            if gains is not None and gains.proved:
                return replace(gains, engine=name)
    raise SolverError(
        f"{failure} {_advice(method)}", record={**failure.record, "delta": delta, "decay": decay}
    ) from failure


def _advice(method: PdObserver) -> str:
    wishes = ("decay", "disk", "gain_bound", "fault_rate_gain", "noise_gain", "adaptation_gain", "adaptation_range")
    stated = [name for name in wishes if getattr(method, name) is not None]
    if not stated:
        return "Rescale the plant, or try another delta or solver."
    return f"Gains exist without {', '.join(stated)}: ask for less there, or try another delta."


def _units(plant: DescriptorSystem, method: PdObserver, *, balanced_first: bool, own_first: bool) -> Iterable[_Units]:
    """Return units of augmented states and outputs in the order to try them: the user's, balancing ones, and those in
    which the plant's entries are near one."""
    candidates = [*_candidate_units(plant, method)]
    if method.gain_bound is not None:
        return candidates
    users, *alternatives = candidates
    if own_first:
        return [_own_units(plant), *alternatives, users]
    rounded = PlantUnits.of(plant).rounded()
    natural = _with_faults(rounded, users.time)
    if rounded.spread > FAR_UNITS:
        return [users, natural, *alternatives]
    # The Riccati equation has no objective, so that the size of gains in the user's units does not matter to it.
    if balanced_first and len(alternatives) == 2:
        return [alternatives[0], users, alternatives[1], natural]
    return [users, *alternatives, natural]


def _own_units(plant: DescriptorSystem) -> _Units:
    """Return the plant's own units, without rounding to powers of two, which would depend on the user's units.

    The inverse of the fastest mode is the unit of time, so that J and L have the same weight.  A unit ten times longer
    would make L cheap, and the noise of the estimates several times larger.  An output with small signals and large
    noise would have the same effect: if noise is stated, the unit of an output is at least proportional to its noise.
    """
    units = _with_faults(PlantUnits.of(plant), 1.0 / fastest_shown_mode(plant))
    noise = np.linalg.norm(plant.Dw, axis=1)
    largest_ratio = float(np.max(units.outputs[noise > 0.0] / noise[noise > 0.0], initial=0.0))
    return units._replace(outputs=np.maximum(units.outputs, largest_ratio * noise))


def _with_faults(units: PlantUnits, time: float) -> _Units:
    return _Units(np.concatenate([units.states, units.faults]), 1.0 / units.outputs, time)


def _given_units(plant: DescriptorSystem) -> _Units:
    return _Units(np.ones(plant.nx + plant.nf), np.ones(plant.ny), 1.0)


def _candidate_units(plant: DescriptorSystem, method: PdObserver) -> Iterator[_Units]:
    n, ny = plant.nx + plant.nf, plant.ny
    time = float(np.exp2(np.round(np.log2(TIME_UNITS / fastest_shown_mode(plant)))))
    yield _given_units(plant)._replace(time=time)
    if method.gain_bound is not None:
        return  # the bound is in the user's units
    augmented = with_faults_as_states(plant, _inner_gain(plant, method))
    system = np.zeros((n + ny, n + ny))
    system[:n, :n], system[n:, :n] = augmented.A, augmented.C
    factors = balancing_factors(system)
    if np.any(factors != 1.0):
        yield _Units(factors[:n], factors[n:], time)
    sizes = np.abs(np.vstack([augmented.A, augmented.C]))
    columns = np.exp2(-np.round(np.log2(np.maximum(np.max(sizes, axis=0), np.finfo(np.float64).tiny))))
    rows = np.max(np.abs(augmented.C) * columns, axis=1)
    yield _Units(columns, np.exp2(np.round(np.log2(np.where(rows > 0.0, rows, 1.0)))), time)


def _inner_gain(plant: DescriptorSystem, method: PdObserver) -> FloatArray | None:
    """Return the G to design with; `None` with a bound on the gains, which refers to ``[J; G M]`` and ``[L; G N]``."""
    return None if method.gain_bound is not None else method.gain_matrix(plant.nf)


def _solved(
    plant: DescriptorSystem,
    method: PdObserver,
    engine: str,
    delta: float,
    decay: float,
    units: _Units,
    most: float | None = None,
) -> PdGains | None:
    """Return the gains computed in some units, with a proved certificate if it could be proved."""
    states, outputs, unit = units
    task = _task(plant, method, delta, decay, units)
    if engine == "riccati":
        solution, used = closed_form(task, free_delta=method.delta is None, once=most is not None)
        delta = delta if used == task.delta else used * unit
    else:
        solution = solve(task, solver=method.solver)
    g = _inner_gain(plant, method)
    loop = np.eye(len(states))
    if g is not None:
        loop[plant.nx :, plant.nx :] = g
    back = np.linalg.inv(loop)
    gain_j, gain_l = (loop @ (states[:, None] * part / outputs) for part in (solution.J / unit, solution.L))
    if most is not None and not largest_singular_value(np.hstack([gain_j, gain_l])) <= most:
        raise SolverError("The gains are very large, and no decay rate was asked for.", record=solution.record)
    p3, *p1 = (back.T @ (matrix / states[:, None] / states) @ back for matrix in (solution.P3, *solution.P1))
    return certified(
        plant, method, PdSolution(gain_j, gain_l, tuple(p1), p3, solution.record), delta=delta, decay=decay
    )


def _task(
    plant: DescriptorSystem,
    method: PdObserver,
    delta: float,
    decay: float,
    units: _Units,
) -> PdTask:
    (states, outputs, unit), nx, nf = units, plant.nx, plant.nf
    g = _inner_gain(plant, method)
    ends = method.range_numbers
    gains = [g] if ends is None else [end * np.eye(nf) for end in ends]
    plants = [with_faults_as_states(plant, gain) for gain in gains]
    noisy = with_sensor_noise(plant)
    fault_rows, rate = np.zeros((nf, nx + nf)), np.zeros((nx + nf, nf))
    fault_rows[:, nx:], rate[nx:] = np.eye(nf) if g is None else g, np.eye(nf) if g is None else np.linalg.inv(g)
    padded = np.vstack([noisy.Bw, np.zeros((nf, noisy.nw))])
    return PdTask(
        plants=tuple((unit * p.A * states / states[:, None], p.C * states / outputs[:, None]) for p in plants),
        theorem=method.theorem,
        delta=delta / unit,
        decay=decay * unit,
        disk=None if method.disk_numbers is None else (method.disk_numbers[0] * unit, method.disk_numbers[1] * unit),
        gain_bound=method.gain_bound,
        gain_unit=1.0 / unit,
        rate_gain=method.fault_rate_gain,
        noise_gain=method.noise_gain,
        rate=unit * rate / states[:, None],
        fault_error=fault_rows * states,
        process=unit * padded / states[:, None],
        sensor=noisy.Dw / outputs[:, None],
        sensor_rate=unit * noisy.Dw / outputs[:, None],
    )


def synthesise(plant: DescriptorSystem, method: PdObserver, *, progress: Callable[[str], None]) -> Synthesis:
    """Design the observer; see `obsynth.pd_observer` for the options, results and errors."""
    solver_of = chosen_solver(method.solver, method.solver_options)
    if own_terms(method) or method.region is not None:
        from obsynth.methods.engines.own_terms import pd_by_inequality

        return pd_by_inequality(plant, method, progress=progress)
    method = replace(method, solver=solver_of)
    progress("checking the existence conditions")
    require_all(pd_observer_conditions(plant))
    form = explicit_form(plant)
    work = plant if form is None else form.plant
    g = method.gain_matrix(work.nf)
    progress("solving the matrix inequalities")
    gains, records = design_gains(work, method)
    shipped = method.range_numbers and min(max(1.0, method.range_numbers[0]), method.range_numbers[1])
    loop = shipped * np.eye(work.nf) if shipped else g
    claims = {"theorem": float(gains.theorem), "delta": gains.delta, "decay": gains.decay}
    bounds: dict[str, float | None] = {
        "gain_bound": method.gain_bound,
        "fault_rate_gain": method.fault_rate_gain,
        "noise_gain": method.noise_gain,
    }
    claims |= {name: float(bound) for name, bound in bounds.items() if bound is not None}
    matrices = {"P1": gains.P1, "P3": gains.P3, **gains.gain_certificates}
    if method.disk_numbers is not None:
        claims |= {"disk_centre": method.disk_numbers[0], "disk_radius": method.disk_numbers[1]}
    if method.range_numbers is not None:
        claims |= {"adaptation_low": method.range_numbers[0], "adaptation_high": method.range_numbers[1]}
        matrices |= {"P1_low": gains.ends[0], "P1_high": gains.ends[1]}
    return Synthesis(
        _resolved(method, gains, g),
        listed_gains(work, gains.J, gains.L, loop),
        gains.observer,
        Certificate(matrices, claims),
        {"engine": gains.engine, "runs": records},
        notes(work, method, gains),
        transformation=form,
    )


def _resolved(method: PdObserver, gains: PdGains, g: FloatArray | None) -> dict[str, Any]:
    return {
        **method.as_plain(),
        "delta": gains.asked_delta,
        "decay": gains.decay,
        "disk": None if method.disk_numbers is None else list(method.disk_numbers),
        "adaptation_gain": None if g is None else g.tolist(),
        "adaptation_range": None if method.range_numbers is None else list(method.range_numbers),
    }


def listed_gains(plant: DescriptorSystem, J: FloatArray, L: FloatArray, g: FloatArray | None) -> dict[str, FloatArray]:
    """Return the paper's J, L, M, N (and G) from the gains ``[J; G M]`` and ``[L; G N]`` of the loop."""
    nx = plant.nx
    inner = np.eye(plant.nf) if g is None else g
    bottom = [np.asarray(np.linalg.solve(inner, part[nx:])) for part in (J, L)]
    gains = {"J": J[:nx], "L": L[:nx], "M": bottom[0], "N": bottom[1]}
    return gains if g is None else {**gains, "G": g}


def notes(plant: DescriptorSystem, method: PdObserver, gains: PdGains) -> tuple[str, ...]:
    """Return notes on the choice of delta and of the decay rate, and on outputs without use and noisy estimates."""
    texts = []
    if method.delta is None:
        less = ", or as much of it as the closed form serves" if gains.engine == "riccati" else ""
        texts.append(f"delta = {gains.asked_delta:.4g} s was chosen, from the plant's fastest mode{less}.")
    if method.decay is None and gains.decay > 0.0:
        texts.append(
            f"A decay rate of {gains.decay:.4g} 1/s was imposed: a tenth of that of the plant's fastest mode, or as "
            "much of it as is "
            "reachable with moderate gains; without it errors would decay more slowly. decay: 0 takes the smallest "
            "gains."
        )
    if unused := left_out(plant, gains.J, gains.L):
        texts.append(
            f"No use is made of {unused}: the gains found with all outputs let more of the stated noise into the fault "
            "estimates."
        )
    texts += _engine_notes(method, gains, plant.nx + plant.nf)
    direct = gains.observer.Dy[gains.observer.fault_rows]
    return (
        *texts,
        *[
            f"The estimate of {name!r} amplifies high-frequency errors of the measurements by up to "
            f"{np.linalg.norm(row):.3g}."
            for name, row in zip(plant.fault_names, direct, strict=True)
            if np.linalg.norm(row) > WARN_AMPLIFICATION
        ],
    )


def _engine_notes(method: PdObserver, gains: PdGains, states: int) -> list[str]:
    first_engine = method.engines_for(states)[0]
    if gains.engine != first_engine:
        return [
            f"The engine {first_engine!r} failed: these gains come from "
            + ("the inequality (engine 'lmi')." if gains.engine == "lmi" else _CLOSED_FORM)
        ]
    if method.engine == "auto" and first_engine != "lmi":
        return [f"With {states} unknown states the gains come from {_CLOSED_FORM} Engine 'lmi' may find smaller ones."]
    return []

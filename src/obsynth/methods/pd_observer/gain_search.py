"""Finding the gains of a PD observer: coordinates, time unit, default decay rate, and a certificate that is proved."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from itertools import islice
from typing import Any

import numpy as np

from obsynth.analysis.plant_units import FAR_UNITS, PlantUnits
from obsynth.analysis.structure import analyse_structure
from obsynth.errors import InfeasibleError, SolverError
from obsynth.methods.pd_observer.gains import PdGains, certified
from obsynth.methods.pd_observer.inequalities import PdSolution, PdTask, solve
from obsynth.methods.pd_observer.limits import default_delta, fastest_mode, require_possible
from obsynth.methods.pd_observer.method import PdObserver
from obsynth.methods.pd_observer.realisation import with_faults_as_states, with_sensor_noise
from obsynth.methods.pd_observer.reduced_inequality import closed_form, reduced_lmi
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.scaling import balancing_factors
from obsynth.plants.descriptor import DescriptorSystem

#: The unit of time is the power of two nearest to this many times the inverse of the plant's fastest mode, where the
#: objective weighs J and L as it does for a plant with modes of a few 1/s in seconds.
TIME_UNITS = 10.0
#: By default errors should decay at least at this fraction of the plant's fastest mode.
DECAY_SHARE = 0.1
#: When the gains that this takes are out of proportion, less is tried.
DECAY_RETRIES = (1.0, 0.3, 0.1, 0.03)
#: Gains may grow by this factor for the sake of the default decay rate.
DECAY_PRICE = 100.0
#: With more unknown states the least of these rates comes first, in one set of units, and the first failure is the end.
MANY_STATES = 100
#: By default a decay rate is never closer to that of an unobservable mode, which nothing moves.
HIDDEN_SHARE = 0.5


def design_gains(plant: DescriptorSystem, asked: PdObserver) -> tuple[PdGains, list[Mapping[str, Any]]]:
    """Return the gains to ship and the records of all solver runs."""
    plain = gains_for(plant, asked, decay=0.0 if asked.decay is None else float(asked.decay))
    records = [plain.record]
    slowest = max((mode.real for mode in analyse_structure(plant).unobservable_modes), default=-np.inf)
    target = float(min(DECAY_SHARE * fastest_mode(plant.A), -HIDDEN_SHARE * slowest))
    if asked.decay is not None or asked.disk is not None or plain.abscissa <= -target:
        return plain, records
    if plant.nx + plant.nf > MANY_STATES:
        return _faster_at_little_cost(plant, asked, plain, target), records
    for share in DECAY_RETRIES:
        if share * target <= -plain.abscissa:
            break
        try:
            faster = gains_for(plant, asked, decay=share * target)
        except SolverError as error:
            records.append(error.record)
            continue
        except InfeasibleError:
            continue  # nobody asked for this rate
        records.append(faster.record)
        if faster.size <= DECAY_PRICE * plain.size:
            return faster, records
    return plain, records


def _faster_at_little_cost(plant: DescriptorSystem, asked: PdObserver, plain: PdGains, target: float) -> PdGains:
    """Return gains that decay as fast as their size allows, for many states: from the least rate upwards."""
    found = plain
    for share in sorted(DECAY_RETRIES):
        if share * target <= -plain.abscissa:
            continue
        try:
            found = gains_for(plant, asked, decay=share * target, most=DECAY_PRICE * plain.size)
        except (SolverError, InfeasibleError):
            break  # nobody asked for this rate
    return found


def gains_for(plant: DescriptorSystem, asked: PdObserver, *, decay: float, most: float | None = None) -> PdGains:
    """Return gains of the first coordinates whose answer is proved; with a bound ``most``, of the first alone."""
    delta = default_delta(plant, asked, decay)
    require_possible(plant, asked, delta=delta, decay=decay)
    failure = SolverError(
        "The gains that the solver returned could not be proved to be stable: the result is inconclusive."
    )
    engine, *spare = asked.engines_for(plant.nx + plant.nf)
    for name in (engine, *spare):
        for states, outputs in islice(_units(plant, asked, balanced_first=name != "lmi"), None if most is None else 1):
            try:
                found = _solved(plant, asked, name, delta, decay, states, outputs, most)
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


def _units(
    plant: DescriptorSystem, asked: PdObserver, *, balanced_first: bool
) -> Iterable[tuple[FloatArray, FloatArray]]:
    """Return units of augmented states and outputs: the user's, balancing ones, those with the plant near one."""
    found = [*_candidate_units(plant, asked)]
    if asked.gain_bound is not None:
        return found
    units = PlantUnits.of(plant).rounded()
    natural = np.concatenate([units.states, units.faults]), 1.0 / units.outputs
    users, *others = found
    if units.spread > FAR_UNITS:
        return [users, natural, *others]
    # A Riccati equation has no objective that would weigh gains in the user's units.
    if balanced_first and len(others) == 2:
        return [others[0], users, others[1], natural]
    return [users, *others, natural]


def _candidate_units(plant: DescriptorSystem, asked: PdObserver) -> Iterator[tuple[FloatArray, FloatArray]]:
    n, ny = plant.nx + plant.nf, plant.ny
    yield np.ones(n), np.ones(ny)
    if asked.gain_bound is not None:
        return  # it is a bound in the user's units
    augmented = with_faults_as_states(plant, _inner_gain(plant, asked))
    system = np.zeros((n + ny, n + ny))
    system[:n, :n], system[n:, :n] = augmented.A, augmented.C
    factors = balancing_factors(system)
    if np.any(factors != 1.0):
        yield factors[:n], factors[n:]
    sizes = np.abs(np.vstack([augmented.A, augmented.C]))
    columns = np.exp2(-np.round(np.log2(np.maximum(np.max(sizes, axis=0), np.finfo(np.float64).tiny))))
    rows = np.max(np.abs(augmented.C) * columns, axis=1)
    yield columns, np.exp2(np.round(np.log2(np.where(rows > 0.0, rows, 1.0))))


def _inner_gain(plant: DescriptorSystem, asked: PdObserver) -> FloatArray | None:
    """Return the G to design with; a bound on the gains is on those in the loop, in the fault's own coordinates."""
    return None if asked.gain_bound is not None else asked.gain_matrix(plant.nf)


def _solved(
    plant: DescriptorSystem,
    asked: PdObserver,
    engine: str,
    delta: float,
    decay: float,
    states: FloatArray,
    outputs: FloatArray,
    most: float | None = None,
) -> PdGains | None:
    """Return the gains found in the given units, with a proved certificate where there is one."""
    unit = float(np.exp2(np.round(np.log2(TIME_UNITS / fastest_mode(plant.A)))))
    task = _task(plant, asked, delta, decay, states, outputs, unit)
    if engine == "riccati":
        found, used = closed_form(task, free_delta=asked.delta is None, once=most is not None)
        delta = delta if used == task.delta else used * unit
    else:
        found = (solve if engine == "lmi" else reduced_lmi)(task, solver=asked.solver)
    g = _inner_gain(plant, asked)
    loop = np.eye(len(states))
    if g is not None:
        loop[plant.nx :, plant.nx :] = g
    back = np.linalg.inv(loop)
    gain_j, gain_l = (loop @ (states[:, None] * part / outputs) for part in (found.J / unit, found.L))
    if most is not None and not float(np.linalg.norm(np.hstack([gain_j, gain_l]), 2)) <= most:
        raise SolverError("The gains are out of proportion for a rate that nobody asked for.", record=found.record)
    p3, *p1 = (back.T @ (matrix / states[:, None] / states) @ back for matrix in (found.P3, *found.P1))
    return certified(plant, asked, PdSolution(gain_j, gain_l, tuple(p1), p3, found.record), delta=delta, decay=decay)


def _task(
    plant: DescriptorSystem,
    asked: PdObserver,
    delta: float,
    decay: float,
    states: FloatArray,
    outputs: FloatArray,
    unit: float,
) -> PdTask:
    nx, nf = plant.nx, plant.nf
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

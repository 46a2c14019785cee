"""The functional filter: estimates of chosen faults, or residuals that they affect.

The unknown inputs are decoupled (`decouple`).  A Kalman filter with the inputs u and y then estimates the faults, whose
models are driven by random walks.  The method is our own, with the null space of Frisk, Nyberg (2001) and the fixed lag
of Anderson, Moore (1979, ch. 7).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, TypeAlias

import numpy as np
from scipy.linalg import block_diag

from obsynth.analysis.existence.functional_filter import residual_sets
from obsynth.analysis.existence.functional_states import chosen_states, fixed_modes, state_goals, without_faults
from obsynth.errors import PreconditionError, SolverError, SpecError
from obsynth.methods.functional_filter.assembly import FilterPart, assembled, filter_part
from obsynth.methods.functional_filter.filter_models import with_noise_of_gains
from obsynth.methods.functional_filter.functional_observer import functional_part
from obsynth.methods.functional_filter.kalman_gain import (
    RATE_REACHED,
    FilterModel,
    KalmanGain,
    filter_model,
    kalman_gain,
    model_states,
    require_noise,
    whitening,
)
from obsynth.methods.functional_filter.method import FunctionalFilter
from obsynth.methods.functional_filter.parity_relation import SAMPLES, is_large, relation_model
from obsynth.methods.functional_filter.rates import MOST_LONGER, MOST_NOISE, default_rates, settling_time
from obsynth.methods.functional_filter.tracking import estimate_deviations, tracking_map
from obsynth.methods.method import Synthesis
from obsynth.methods.refusals import require_all_conditions
from obsynth.methods.rounding import require_above_rounding
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.eigenstructure import place
from obsynth.numerics.ranks import rounding_rank
from obsynth.numerics.requested_poles import checked_poles
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.faults import Exosystem, exosystem
from obsynth.results.design import Certificate
from obsynth.results.number_texts import duration
from obsynth.verification.error_system import ErrorModel, contraction_of
from obsynth.verification.inequalities import slowest_decay, stability_factor

_ModelGain: TypeAlias = tuple[FilterModel, KalmanGain]

#: A note is given if errors last longer than so many times the settling time.
SLOW_ERRORS = 20.0


def synthesise(plant: DescriptorSystem, method: FunctionalFilter, *, progress: Callable[[str], None]) -> Synthesis:
    """Design the filter; see `obsynth.functional_filter` for the options, results and errors."""
    method.require_samples(plant)
    model = exosystem(method.fault_model, plant.fault_names, plant.dt)
    progress("checking the existence conditions")
    require_all_conditions(method.existence(plant))
    noisy, notes = with_noise_of_gains(plant, method.sensor_noise(plant), needed=method.has_kalman_gains)
    progress("decoupling the unknown inputs")
    models = method.filter_models(noisy, model)
    progress("choosing the gains")
    of_states = _state_parts(noisy, model, method)
    for longer in (MOST_LONGER, 0):
        gains, rates, step_times = _gains(noisy, models, method, longer)
        parts = _parts(gains, method)
        observer, t, t0 = assembled(plant, [*of_states, *parts], _residual_names(plant, models, parts, method))
        if not any(seconds > settling_time(plant) for seconds, *_ in step_times) or _is_above_rounding(plant, observer):
            break
    progress("building the realisation and its certificate")
    if gains and contraction_of(observer) is None:
        # Stability cannot be proved if large entries cancel; a triangular form has no such entries.
        parts = _parts(gains, method, triangular=True)
        observer, t, t0 = assembled(plant, [*of_states, *parts], _residual_names(plant, models, parts, method))
    estimated = [plant.fault_names.index(name) for name in observer.fault_names]
    walks = np.zeros(model.order)
    for part, walk in zip(models, rates, strict=True):
        walks[model_states(model, part.faults)] = walk
    matrices = {
        "T": t,
        "T0": t0,
        "Phi": model.Phi,
        "Cw": model.Cw,
        "walks": np.diag(walks),
        "stability": stability_factor(observer),
        "tracking": tracking_map(ErrorModel(plant, observer, t), model.Phi, model.Cw),
    }
    low = [model for model, part in zip(models, parts, strict=True) if len(part.dynamics.C) < len(model.A)]
    if low:
        notes = (*notes, _low_order_note(plant, low))
    matrices["deviations"] = estimate_deviations(noisy, observer, matrices)
    slowest = slowest_decay(observer.Az, plant.dt)
    claims = {"order": float(observer.order), **({"decay": slowest} if np.isfinite(slowest) else {})}
    options = _resolved(method, plant, model, rates, estimated)
    return Synthesis(
        options,
        {"T": t, "T0": t0},
        observer,
        Certificate(matrices, claims),
        notes=(*notes, *_notes(plant, slowest, rates, step_times), *_silent_sensor_notes(noisy, gains)),
        plant=noisy if noisy is not plant else None,
    )


def _state_parts(plant: DescriptorSystem, model: Exosystem, method: FunctionalFilter) -> list[FilterPart]:
    """Return the filter of the states that the user chose, if any."""
    places = chosen_states(method.states, plant)
    if not places:
        return []
    free = filter_model(plant, model, removed=range(plant.nf), faults=())
    fixed = fixed_modes(plant, without_faults(plant), free.T, method.decay or 0.0)
    free = replace(
        free,
        A=block_diag(free.A, fixed.A),
        C=np.hstack([free.C, np.zeros((len(free.C), len(fixed.A)))]),
        B=np.vstack([free.B, fixed.B]),
        T=np.vstack([free.T, fixed.T]),
    )
    goals = state_goals(plant, places, free.T)
    rate = method.decay or 1.0 / settling_time(plant)
    return [functional_part(free, goals, rate=rate, poles=method.poles, places=places)]


def _is_above_rounding(plant: DescriptorSystem, observer: LinearObserver) -> bool:
    """Whether the estimates are larger than the effect of rounding of the outputs."""
    try:
        require_above_rounding(plant, observer)
    except PreconditionError:
        return False
    return True


def _parts(gains: Sequence[_ModelGain], method: FunctionalFilter, *, triangular: bool = False) -> list[FilterPart]:
    """Return the filter of each model with its gain (`filter_part`)."""
    delay = 0 if method.poles is not None else method.delay
    return [
        filter_part(model, gain, whitening(gain.innovation), delay=delay, mean=method.mean, triangular=triangular)
        for model, gain in gains
    ]


def _gains(
    plant: DescriptorSystem, models: Sequence[FilterModel], method: FunctionalFilter, longer: int
) -> tuple[list[_ModelGain], list[FloatArray], list[tuple[float, float, bool]]]:
    """Return the models of the filters with their gains, the random-walk intensities of the states of fault models, and
    the times in which steps of faults are estimated with default intensities."""
    if method.poles is not None and models:
        return _placed(plant, models, method), [np.zeros(model.drive.shape[1]) for model in models], []
    stated_rates = method.rates(plant)
    gains, rates, step_times = [], [], []
    for model in models:
        require_noise(model, plant.output_names, plant.Dw)
        low = _low_order(plant, model, method)
        if low is None:
            walks, gain = _gain(plant, model, stated_rates, method, longer)
        else:
            model, walks, gain = low
        rates.append(walks)
        if gain.step_time_and_miss is not None:
            step_times.append((*gain.step_time_and_miss, gain.noisier_if_faster))
        gains.append((model, gain))
    return gains, rates, step_times


def _low_order_note(plant: DescriptorSystem, models: Sequence[FilterModel]) -> str:
    names = ", ".join(plant.fault_names[fault] for model in models for fault in model.faults)
    return (
        f"The plant is large: the filter of {names} follows one parity relation over {SAMPLES} samples, not all "
        f"{models[0].order} states, and has more noise than one that does. State fault_rate for that one."
    )


def _low_order(
    plant: DescriptorSystem, model: FilterModel, method: FunctionalFilter
) -> tuple[FilterModel, FloatArray, KalmanGain] | None:
    """Return a model of low order with its random-walk intensities and gain, or ``None``.

    There is one if the plant is large, no option determines the gains, and steps are estimated in time.
    """
    if method.fault_rate is not None or method.decay is not None or not is_large(model):
        return None
    seconds = settling_time(plant)
    low = relation_model(model, seconds)
    if low is None:
        return None
    try:
        walks, gain = default_rates(low, seconds, lag=method.delay, longer=0)
    except SolverError:
        return None
    missed = np.inf if gain.step_time_and_miss is None else gain.step_time_and_miss[1]
    return (low, walks, gain) if missed <= RATE_REACHED else None


def _gain(
    plant: DescriptorSystem, model: FilterModel, stated_rates: FloatArray | None, method: FunctionalFilter, longer: int
) -> tuple[FloatArray, KalmanGain]:
    if not model.drive.shape[1]:
        return np.zeros(0), kalman_gain(model, np.zeros(0), decay=method.decay or 0.0, insist=True)
    if stated_rates is not None or method.decay is not None:
        walks = np.zeros(model.drive.shape[1])
        if stated_rates is not None:
            for row, fault in zip(model.estimate[:, model.order :], model.faults, strict=True):
                walks[row != 0.0] = stated_rates[fault]
                if not stated_rates[fault] and not method.decay:
                    raise SpecError(
                        f"fault_rate has no entry for {plant.fault_names[fault]}, which is to be estimated: with a "
                        "random-walk intensity of 0 it is a constant, and errors of its estimate would never decay.",
                        path="method.options.fault_rate",
                    )
        return walks, kalman_gain(model, walks, lag=method.delay, decay=method.decay or 0.0, insist=True)
    return default_rates(model, settling_time(plant), lag=method.delay, longer=longer)


def _placed(plant: DescriptorSystem, models: Sequence[FilterModel], method: FunctionalFilter) -> list[_ModelGain]:
    """Return gains with the poles of the options: one list, or one list for each of several filters."""
    pole_sets = [method.poles] if len(models) == 1 else list(method.poles)
    if len(pole_sets) != len(models) or not all(isinstance(entry, (list, tuple, np.ndarray)) for entry in pole_sets):
        orders = ", ".join(str(len(model.A)) for model in models)
        raise SpecError(
            f"{len(models)} filters are asked for, with {orders} poles: give a list of poles for each, such as "
            "[[-1], [-2, -3]], or ask for one fault, one set of residuals, or joint estimates.",
            path="method.options.poles",
        )
    return [(model, _placed_gain(plant, model, poles)) for model, poles in zip(models, pole_sets, strict=True)]


def _placed_gain(plant: DescriptorSystem, model: FilterModel, poles: Sequence[Any]) -> KalmanGain:
    fixed = np.zeros(0, dtype=np.complex128)
    wanted_poles = checked_poles(poles, len(model.A), fixed, plant.dt, of="functional-filter")
    gain = place(model.A, model.C, wanted_poles, dt=plant.dt)[0]
    lag = (np.zeros_like(gain),) if plant.dt > 0.0 else ()
    noise = model.M @ model.M.T if plant.nw and rounding_rank(model.M) == len(model.M) else np.eye(len(model.C))
    return KalmanGain(gain, lag, noise)


def _residual_names(
    plant: DescriptorSystem,
    models: Sequence[FilterModel],
    parts: Sequence[FilterPart],
    method: FunctionalFilter,
) -> list[str]:
    sets = residual_sets(method.residuals, plant)
    names = []
    for number, part in enumerate(parts):
        own_faults = part.faults if sets is None else sets[number]
        alone = len(parts) == 1
        label = "" if alone else f"{' '.join(plant.fault_names[i] for i in own_faults)}: "
        names += [f"{label}r{i + 1}" for i in range(len(part.residuals.C))]
    return names if len(set(names)) == len(names) else [f"{i + 1}: {name}" for i, name in enumerate(names)]


def _resolved(
    method: FunctionalFilter,
    plant: DescriptorSystem,
    model: Exosystem,
    rates: Sequence[FloatArray],
    estimated: Sequence[int],
) -> dict[str, Any]:
    """Return the options with chosen defaults as plain data for the gain set."""
    options = method.as_plain()
    options["faults"] = (
        None
        if method.residuals is not None or method.is_for_states_alone
        else [plant.fault_names[i] for i in estimated]
    )
    options["fault_model_in_words"] = dict(zip(plant.fault_names, model.descriptions, strict=True))
    chosen = np.concatenate([np.zeros(0), *rates])
    options["fault_rate_found"] = None if method.fault_rate is not None or not chosen.any() else chosen.tolist()
    return options


def _silent_sensor_notes(plant: DescriptorSystem, gains: Sequence[_ModelGain]) -> list[str]:
    """Return the note on sensors without stated noise for which the gains assume some."""
    silent = [name for name, row in zip(plant.output_names, plant.Dw, strict=True) if not row.any()]
    share = max((gain.shares[1] for _, gain in gains), default=0.0)
    if not plant.nw or not silent or not share:
        return []
    return [
        f"No noise is stated for {', '.join(silent)}: the gain is that for {share:g} times the largest noise of the "
        "plant there, since without any it would be infinite. State sensor_noise for a smaller one."
    ]


def _notes(
    plant: DescriptorSystem,
    slowest: float,
    rates: Sequence[FloatArray],
    step_times: Sequence[tuple[float, float, bool]],
) -> list[str]:
    notes = []
    unit = "per sample" if plant.dt > 0.0 else "per square root of a second"
    if step_times:
        largest = float(max(np.max(walk, initial=0.0) for walk in rates))
        seconds, missed, noisier = (max(values) for values in zip(*step_times, strict=True))
        close = f" (up to {missed:.0%} of it are still missing then; with larger ones less, and over {MOST_NOISE:g} "
        close += "times as much noise)"
        if not noisier:
            close = f" (with any intensity, up to {missed:.0%} of it are still missing then)"
        close = "" if missed <= RATE_REACHED else close
        notes.append(
            f"fault_rate was not given: a random-walk intensity of {largest:.3g} {unit} is the slowest with which a "
            f"step is estimated after {duration(seconds)}{close}. A delay reduces the noise only relative to a "
            "fault_rate that you state."
        )
    if np.isfinite(slowest) and slowest * SLOW_ERRORS * settling_time(plant) < 1.0:
        notes.append(
            f"The slowest pole has a time constant of {duration(1.0 / slowest)}: initial errors of the state last "
            "that long in the estimates. State decay= for a faster one, which has more noise."
        )
    return notes

"""Functional filter: estimates of the faults asked for, or residuals that show them, and nothing else.

After `decouple` a Kalman filter on inputs u *and* y, faults as walks of their models.  Source: ours; null space: Frisk,
Nyberg (2001); fixed lag: Anderson, Moore (1979, ch. 7).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.methods.functional_filter.kalman_gain import (
    FilterModel,
    KalmanGain,
    filter_model,
    kalman_gain,
    model_states,
    require_noise,
    whitening,
)
from obsynth.methods.functional_filter.method import FunctionalFilter
from obsynth.methods.functional_filter.rates import default_rates, settling_time
from obsynth.methods.functional_filter.realisation import FilterPart, assembled, filter_part
from obsynth.methods.functional_filter.tracking import estimate_deviations, tracking_map
from obsynth.methods.functional_filter.wanted_faults import chosen_faults, residual_sets
from obsynth.methods.method import Synthesis
from obsynth.methods.placement.eigenstructure import checked_poles, place
from obsynth.methods.refusals import require_all_told
from obsynth.methods.riccati import lyapunov_factor
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.ranks import rounding_rank
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.fault_models import Exosystem, exosystem
from obsynth.results.design import Certificate
from obsynth.verification.certificates import slowest_decay

#: Errors that need longer than so many times the settling time are mentioned.
SLOW = 20.0


def synthesise(plant: DescriptorSystem, asked: FunctionalFilter, *, progress: Callable[[str], None]) -> Synthesis:
    """Design the filter; see `obsynth.functional_filter` for the options, results and errors."""
    _require_samples(plant, asked)
    model = exosystem(asked.fault_model, plant.fault_names, plant.dt)
    progress("checking the existence conditions")
    require_all_told(asked.existence(plant))
    noisy, notes = _with_noise(plant, asked)
    progress("taking the unknown inputs out of the plant")
    models = _models(noisy, model, asked)
    progress("choosing the gains")
    parts, rates = _parts(noisy, models, asked)
    progress("building the realisation and its certificate")
    names = _residual_names(plant, models, parts, asked)
    observer, t, t0 = assembled(plant, parts, names)
    estimated = [plant.fault_names.index(name) for name in observer.fault_names]
    walks = _walks(model, models, rates)
    matrices = {
        "T": t, "T0": t0, "Phi": model.Phi, "Cw": model.Cw, "walks": np.diag(walks),
        "stability": lyapunov_factor(observer.Az, plant.dt),
        "tracking": tracking_map(plant, observer, t, model.Phi, model.Cw),
    }  # fmt: skip
    matrices["deviations"] = estimate_deviations(noisy, observer, matrices)
    slowest = slowest_decay(observer.Az, plant.dt)
    claims = {"order": float(observer.order), **({"decay": slowest} if np.isfinite(slowest) else {})}
    options = _resolved(asked, plant, model, rates, estimated)
    return Synthesis(
        options, {"T": t, "T0": t0}, observer, Certificate(matrices, claims),
        notes=(*notes, *_notes(plant, asked, slowest, rates)),
        plant=noisy if noisy is not plant else None,
    )  # fmt: skip


def _require_samples(plant: DescriptorSystem, asked: FunctionalFilter) -> None:
    late = [name for name, default in (("delay", 0), ("mean", 1)) if getattr(asked, name) != default]
    if late and not plant.dt > 0.0:
        raise SpecError(
            f"{' and '.join(late)} count samples, but the plant is continuous: sample it (transform: sample_time).",
            path="method.options",
        )


def _with_noise(plant: DescriptorSystem, asked: FunctionalFilter) -> tuple[DescriptorSystem, tuple[str, ...]]:
    """Return the plant with the noise that the gains are for."""
    given = asked.sensor_noise(plant)
    if given is None and plant.nw:
        return plant, ()
    if given is None and asked.poles is not None:
        return plant, ()
    deviations = np.ones(plant.ny) if given is None else given
    process = np.flatnonzero(plant.Bw.any(axis=0))
    noisy = plant.replace(
        Bw=np.hstack([plant.Bw[:, process], np.zeros((plant.nx, plant.ny))]),
        Dw=np.hstack([plant.Dw[:, process] * 0.0, np.diag(deviations)]),
        noise_names=[*(plant.noise_names[i] for i in process), *(f"noise {name}" for name in plant.output_names)],
    )
    note = "No noise is stated: every sensor is held to be as noisy as the others, with deviation 1 in its own unit."
    return noisy, () if given is not None else (note,)


def _models(plant: DescriptorSystem, model: Exosystem, asked: FunctionalFilter) -> list[FilterModel]:
    """Return a filter model for each group of faults that one filter serves."""
    groups = sets = residual_sets(asked.residuals, plant)
    if groups is None:
        chosen = chosen_faults(asked.faults, plant)
        groups = [chosen] if asked.joint else [[fault] for fault in chosen]
    others = ([j for j in range(plant.nf) if j not in group] for group in groups)
    return [
        filter_model(plant, model, removed=removed, faults=group if sets is None else ())
        for group, removed in zip(groups, others, strict=True)
    ]


def _parts(
    plant: DescriptorSystem, models: Sequence[FilterModel], asked: FunctionalFilter
) -> tuple[list[FilterPart], list[FloatArray]]:
    """Return the filters, and the walks of their fault models' states."""
    if asked.poles is not None:
        return _placed(plant, models, asked), [np.zeros(model.drive.shape[1]) for model in models]
    given = asked.rates(plant)
    parts, rates = [], []
    for model in models:
        require_noise(model, plant.output_names, plant.Dw)
        walks, gain = _gain(plant, model, given, asked)
        rates.append(walks)
        parts.append(filter_part(model, gain, whitening(gain.innovation), delay=asked.delay, mean=asked.mean))
    return parts, rates


def _gain(
    plant: DescriptorSystem, model: FilterModel, given: FloatArray | None, asked: FunctionalFilter
) -> tuple[FloatArray, KalmanGain]:
    if not model.drive.shape[1]:
        return np.zeros(0), kalman_gain(model, np.zeros(0), decay=asked.decay or 0.0)
    if given is not None or asked.decay is not None:
        walks = np.zeros(model.drive.shape[1])
        if given is not None:
            for row, fault in zip(model.estimate[:, model.order :], model.faults, strict=True):
                walks[row != 0.0] = given[fault]
                if not given[fault] and not asked.decay:
                    raise SpecError(
                        f"fault_rate says nothing about {plant.fault_names[fault]}, which is to be estimated: a walk "
                        "of 0 is a constant that is never forgotten.",
                        path="method.options.fault_rate",
                    )
        return walks, kalman_gain(model, walks, lag=asked.delay, decay=asked.decay or 0.0)
    return default_rates(model, settling_time(plant), lag=asked.delay)


def _placed(plant: DescriptorSystem, models: Sequence[FilterModel], asked: FunctionalFilter) -> list[FilterPart]:
    """Return the filters with the poles asked for: one list, or one for each of several filters."""
    given = [asked.poles] if len(models) == 1 else list(asked.poles)
    if len(given) != len(models) or not all(isinstance(entry, (list, tuple, np.ndarray)) for entry in given):
        orders = ", ".join(str(len(model.A)) for model in models)
        raise SpecError(
            f"{len(models)} filters are asked for, of {orders} poles: give a list of poles for each, such as "
            "[[-1], [-2, -3]], or ask for one fault, one set of residuals, or joint estimates.",
            path="method.options.poles",
        )
    return [_placed_filter(plant, model, poles, asked) for model, poles in zip(models, given, strict=True)]


def _placed_filter(
    plant: DescriptorSystem, model: FilterModel, poles: Sequence[Any], asked: FunctionalFilter
) -> FilterPart:
    fixed = np.zeros(0, dtype=np.complex128)
    wanted = checked_poles(poles, len(model.A), fixed, plant.dt, of="functional-filter")
    gain = place(model.A, model.C, wanted, dt=plant.dt).K if len(model.A) else np.zeros((0, len(model.C)))
    lag = (np.zeros_like(gain),) if plant.dt > 0.0 else ()
    noise = model.M @ model.M.T if plant.nw and rounding_rank(model.M) == len(model.M) else np.eye(len(model.C))
    return filter_part(model, KalmanGain(gain, lag, noise, 0.0), whitening(noise), delay=0, mean=asked.mean)


def _residual_names(
    plant: DescriptorSystem, models: Sequence[FilterModel], parts: Sequence[FilterPart],
    asked: FunctionalFilter,
) -> list[str]:  # fmt: skip
    sets = residual_sets(asked.residuals, plant)
    names = []
    for number, part in enumerate(parts):
        seen = part.faults if sets is None else sets[number]
        alone = len(parts) == 1
        label = "" if alone else f"{' '.join(plant.fault_names[i] for i in seen)}: "
        names += [f"{label}r{i + 1}" for i in range(len(part.residuals.C))]
    return names if len(set(names)) == len(names) else [f"{i + 1}: {name}" for i, name in enumerate(names)]


def _walks(model: Exosystem, models: Sequence[FilterModel], rates: Sequence[FloatArray]) -> FloatArray:
    """Return the walk of every state of the whole exosystem."""
    walks = np.zeros(model.order)
    for part, walk in zip(models, rates, strict=True):
        walks[model_states(model, part.faults)] = walk
    return walks


def _resolved(
    asked: FunctionalFilter, plant: DescriptorSystem, model: Exosystem, rates: Sequence[FloatArray],
    estimated: Sequence[int],
) -> dict[str, Any]:  # fmt: skip
    """Return the options as plain data, for the gain set."""
    found = asked.as_plain()
    found["faults"] = None if asked.residuals is not None else [plant.fault_names[i] for i in estimated]
    found["fault_model_in_words"] = dict(zip(plant.fault_names, model.descriptions, strict=True))
    chosen = np.concatenate([np.zeros(0), *rates])
    found["fault_rate_found"] = None if asked.fault_rate is not None or not chosen.any() else chosen.tolist()
    return found


def _notes(plant: DescriptorSystem, asked: FunctionalFilter, slowest: float, rates: Sequence[FloatArray]) -> list[str]:
    notes = []
    unit = "per sample" if plant.dt > 0.0 else "per square root of a second"
    if asked.residuals is None and asked.fault_rate is None and asked.poles is None and asked.decay is None:
        largest = float(max((np.max(walk, initial=0.0) for walk in rates), default=0.0))
        notes.append(
            f"fault_rate was not given: a walk of {largest:.3g} {unit} is the slowest that shows a step after "
            f"{settling_time(plant):.3g} s. Delay buys less noise only against a rate that you state."
        )
    if np.isfinite(slowest) and slowest * SLOW * settling_time(plant) < 1.0:
        notes.append(
            f"The slowest pole forgets the start with a time constant of {1.0 / slowest:.3g} s: errors of the state at "
            "the start stay that long where they show. Ask for decay= to be faster, at a price in noise."
        )
    return notes

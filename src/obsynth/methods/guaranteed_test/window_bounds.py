"""The bounds and faults that the options of a guaranteed test name, as numbers in the plant's order."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from fractions import Fraction
from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.methods.guaranteed_test.options import TestOptions
from obsynth.methods.guaranteed_test.window_models import Bounds, disturbance_names
from obsynth.numerics.arrays import LARGEST, FloatArray, require_no_overflow
from obsynth.numerics.suggestions import there_are
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem
from obsynth.plants.transformations.moving_disturbances import moving_columns
from obsynth.plants.transformations.remainders import continuous_model
from obsynth.proofs.exact_doubles import rounded_outward


def fault_of(names: tuple[str, ...], name: str | None) -> int:
    """Return the number of the fault that is looked for."""
    if name is None and len(names) == 1:
        return 0
    if name is None or name not in names:
        complaint = "No fault is named" if name is None else f"There is no fault {name!r}"
        listed = (
            f"name one of {', '.join(names)}"
            if names
            else "the plant has none (Bf, Df; for a plant that changes with k: Phi, Psi)"
        )
        raise SpecError(f"{complaint}: {listed}.", path="method.options.fault")
    return names.index(name)


def free_faults(names: tuple[str, ...], free: Any, fault: int) -> tuple[int, ...]:
    """Return the numbers of the faults that may do anything besides."""
    if isinstance(free, str) and free not in names:
        if free not in ("others", "none"):
            raise SpecError(
                f"free is {free!r}: use others, none, or a list of {', '.join(names)}.", path="method.options.free"
            )
        return tuple(k for k in range(len(names)) if k != fault) if free == "others" else ()
    listed = [free] if isinstance(free, str) else list(free or ())
    wrong = [str(name) for name in listed if name not in names or names.index(name) == fault]
    if wrong:
        raise SpecError(
            f"free names {', '.join(wrong)}: no other fault of the plant is called so; {there_are(wrong[0], names)}",
            path="method.options.free",
        )
    return tuple(sorted({names.index(name) for name in listed}))


def missing_bounds(plant: DescriptorSystem | TimeVaryingDescriptorSystem, options: TestOptions) -> Iterator[str]:
    """Yield a sentence for each bound that is missing."""
    known, names = options.disturbance_bounds, disturbance_names(plant)
    if isinstance(plant, TimeVaryingDescriptorSystem):
        if known is None:
            yield (
                "disturbance_bounds: the largest absolute value of mu(k) in each equation is missing: give it "
                f"for {', '.join(names)}, and 0 where an equation holds exactly."
            )
        if not isinstance(options.noise_bound, Mapping):
            yield (
                "noise_bound: a plant that changes with k states no deviations; give the bound of each output by name: "
                f"{', '.join(plant.output_names)}."
            )
        return
    acting = np.any(plant.Bd != 0.0, axis=0) | np.any(plant.Dd != 0.0, axis=0)
    if known is None or isinstance(known, Mapping):
        lacking = [name for name, does in zip(names, acting, strict=True) if does and name not in (known or {})]
        if lacking:
            yield f"disturbance_bounds: the largest absolute value of {', '.join(lacking)} is missing."
    noisy = bool(plant.Bw.any() or plant.Dw.any())
    if options.noise_bound and not isinstance(options.noise_bound, Mapping) and not noisy:
        yield (
            "noise_bound: the plant states no noise of which this is a number of deviations; give sensor_noise, or the "
            "bound of each output by name."
        )
    if options.noise_bound is None and noisy:
        yield (
            "noise_bound: a standard deviation is no bound; state how many of them the noise never exceeds, or the "
            "bound of each output by name."
        )


def bounds_of(plant: DescriptorSystem | TimeVaryingDescriptorSystem, options: TestOptions) -> Bounds:
    """Return the bounds that are given; raise `SpecError` where some are missing."""
    lacking = list(missing_bounds(plant, options))
    if lacking:
        first = lacking[0].partition(":")[0]
        raise SpecError("A guaranteed test needs bounds.", path=f"method.options.{first}", problems=lacking)
    every, names = isinstance(plant, TimeVaryingDescriptorSystem), disturbance_names(plant)
    disturbance, disturbance_middle = between(options.disturbance_bounds, names, "disturbance_bounds", every=every)
    if isinstance(options.noise_bound, Mapping) or not isinstance(plant, DescriptorSystem):
        state, output = np.zeros((plant.nx, plant.ny)), np.eye(plant.ny)
        noise, middle = between(options.noise_bound, plant.output_names, "noise_bound", every=True)
        if isinstance(plant, DescriptorSystem) and plant.Bw.any():
            raise SpecError(
                "noise_bound is given by output, but noise enters the equations too: give a number of deviations.",
                path="method.options.noise_bound",
            )
    else:
        state, output, middle = plant.Bw, plant.Dw, np.zeros(plant.nw)
        noise = by_name(options.noise_bound, plant.noise_names, "noise_bound", every=False)
    always = by_name(options.state_bounds, plant.state_names, "state_bounds", every=False, missing=np.inf)
    at_first = by_name(options.initial_bounds, plant.state_names, "initial_bounds", every=False, missing=np.inf)
    bounds = Bounds(disturbance, state, output, noise, always, at_first, disturbance_middle, middle)
    return _between_samples(plant, options, bounds) if isinstance(plant, DescriptorSystem) else bounds


def _between_samples(plant: DescriptorSystem, options: TestOptions, bounds: Bounds) -> Bounds:
    """Return bounds with what disturbances do between the samples of a plant whose continuous one is known."""
    if options.disturbance not in ("any", "rate") or not bounds.disturbance.any():
        return bounds
    moving = moving_columns(
        plant, None if options.model is None else continuous_model(plant, options.model, options.given)
    )
    if moving is None:
        return bounds
    sizes = bounds.disturbance
    if options.disturbance == "rate":
        # Beside its value at the sample before a disturbance has changed by no more than its rate.
        rates = by_name(options.disturbance_rate, plant.disturbance_names, "disturbance_rate", every=True)
        sizes = np.minimum(rates, 2.0 * sizes)
    return replace(bounds, moving=moving, moving_bounds=sizes)


def between(bounds: Any, names: tuple[str, ...], option: str, *, every: bool) -> tuple[FloatArray, FloatArray]:
    """Return half widths, rounded up, and middles of bounds that are numbers, or ``[low, high]`` by name."""
    low, high = {}, {}
    for name, value in bounds.items() if isinstance(bounds, Mapping) else ():
        if isinstance(value, (list, tuple, np.ndarray)):
            low[name], high[name] = float(value[0]), float(value[1])
    plain = {name: 0.0 if name in low else value for name, value in bounds.items()} if low else bounds
    half, middle = by_name(plain, names, option, every=every), np.zeros(len(names))
    for place, name in enumerate(names):
        if name in low:
            middle[place] = 0.5 * low[name] + 0.5 * high[name]
            ends = [abs(Fraction(end) - Fraction(middle[place])) for end in (low[name], high[name])]
            half[place] = rounded_outward(max(ends))
    return half, middle


def by_name(numbers: Any, names: tuple[str, ...], option: str, *, every: bool, missing: float = 0.0) -> FloatArray:
    """Return a number, 0 or more, for each name, from one number for all or a mapping."""
    path = f"method.options.{option}"
    if numbers is None:
        if every and names:
            raise SpecError(f"{option} is missing: give a number for each of {', '.join(names)}.", path=path)
        return np.full(len(names), missing)
    by_name = dict(numbers) if isinstance(numbers, Mapping) else dict.fromkeys(names, numbers)
    unknown = [str(name) for name in by_name if name not in names]
    lacking = [name for name in names if name not in by_name] if every else []
    if unknown or lacking:
        parts = [f"unknown: {', '.join(unknown)}"] if unknown else []
        parts += [f"missing: {', '.join(lacking)}"] if lacking else []
        raise SpecError(f"{option} must name {', '.join(names) or 'nothing'}; {'; '.join(parts)}.", path=path)
    for name, value in by_name.items():
        if isinstance(value, (list, tuple)):
            raise SpecError(
                f"{option} of {name} is {value!r}: one bound holds on both sides of the operating point: take the "
                "larger end.",
                path=path,
            )
        require_no_overflow(value, f"{option} of {name}", path)
        if 0.0 < value < 1.0 / LARGEST:
            raise SpecError(
                f"{option} of {name} is {value:.3g}, which underflows where it is multiplied: give it in other units.",
                path=path,
            )
    return np.array([float(by_name.get(name, missing)) for name in names])

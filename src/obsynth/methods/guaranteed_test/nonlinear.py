"""Guaranteed tests of nonlinear plants: the sampled linear model, with its remainder as a disturbance."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from obsynth.analysis.existence.condition import Condition
from obsynth.errors import PreconditionError, SpecError
from obsynth.methods.guaranteed_test.bank_synthesis import REMAINDER_ROUNDINGS, SHARE_ROOM
from obsynth.methods.guaranteed_test.existence import SOURCE, conditions
from obsynth.methods.guaranteed_test.synthesis import synthesise
from obsynth.methods.guaranteed_test.window_bounds import between, fault_of
from obsynth.methods.method import Synthesis
from obsynth.numerics.outward import upper_text
from obsynth.plants.dae import DAEModel
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.transformations.remainders import bounded_model, remainder_names
from obsynth.proofs.balls import UNIT_ROUNDOFF
from obsynth.results.design import Certificate


def nonlinear_conditions(model: DAEModel, options: Any) -> tuple[Condition, ...]:
    """Return the conditions: a region and a sample time are stated; then those of the linear model."""
    lacking = [name for name in ("region", "sample_time") if getattr(options, name) is None]
    stated = Condition(
        "region stated",
        "a nonlinear plant stays in a region",
        not lacking,
        float(len(lacking)),
        0.0,
        SOURCE,
        "" if not lacking else f"give {' and '.join(lacking)}: the remainder of the linear model is bounded there.",
        of_the_method=True,
    )
    if lacking:
        return (stated,)
    return (stated, *conditions(*_linear(model, options)))


def _linear(model: DAEModel, options: Any) -> tuple[DescriptorSystem, Any]:
    """Return the sampled linear model with its remainder, and what is asked of it."""
    if options.isolate:
        raise SpecError(
            "isolate is for linear plants: design one test for each fault, with the others free.",
            path="method.options.isolate",
        )
    if options.model is not None:
        raise SpecError("model is written by obsynth: leave it out.", path="method.options.model")
    if not isinstance(options.noise_bound, Mapping):
        raise SpecError(
            "noise_bound: a nonlinear plant states no deviations; give the bound of each output by name: "
            f"{', '.join(model.output_names)}.",
            path="method.options.noise_bound",
        )
    listed = options.free if not isinstance(options.free, str) or options.free in model.parameters else ()
    free_names = [listed] if isinstance(listed, str) else list(listed or ())
    fault = model.parameter_names[fault_of(model.parameter_names, options.fault)]
    wrong = [name for name in free_names if name not in model.parameters or name == fault]
    if wrong:
        raise SpecError(
            f"free names {', '.join(map(str, wrong))}: the other parameters are "
            f"{', '.join(name for name in model.parameters if name != fault) or 'none'}.",
            path="method.options.free",
        )
    disturbance_bounds = options.disturbance_bounds or {}
    if not isinstance(disturbance_bounds, Mapping) or any(name not in model.inputs for name in disturbance_bounds):
        raise SpecError(
            f"disturbance_bounds of a nonlinear plant are by name, of the inputs that are not known, among "
            f"{', '.join(model.inputs) or 'none'}; the others are known.",
            path="method.options.disturbance_bounds",
        )
    linear, bounds = bounded_model(
        model,
        options.region,
        options.sample_time,
        faults=[fault, *free_names],
        disturbances=list(disturbance_bounds),
        given=options.given,
    )
    _require_inside(linear, disturbance_bounds, options.region)
    sizes = {
        name: max(abs(float(end)) for end in options.region.get(name, (1.0, 1.0)))
        for name in (*model.state_names, *model.input_names)
    }
    largest = max(sizes.values(), default=1.0)
    room = {
        name: value * (1.0 + SHARE_ROOM) + REMAINDER_ROUNDINGS * UNIT_ROUNDOFF * largest
        for name, value in bounds.items()
    }
    own = replace(
        options,
        fault=fault,
        free=free_names or "none",
        disturbance_bounds={**disturbance_bounds, **room},
        region=None,
        sample_time=None,
        model=model.as_dict(),
    )
    return linear, own


def _require_inside(plant: DescriptorSystem, disturbance_bounds: Mapping[str, Any], region: Mapping[str, Any]) -> None:
    """Raise `SpecError` where an unknown input may leave the region."""
    names = tuple(disturbance_bounds)
    half, middle = between(disturbance_bounds, names, "disturbance_bounds", every=True)
    for name, size, at in zip(names, half.tolist(), middle.tolist(), strict=True):
        point = plant.operating_point.get(name, 0.0)
        if not region[name][0] <= point + at - size or not point + at + size <= region[name][1]:
            raise SpecError(
                f"region of {name} is {list(region[name])}, but its bounds reach from {point + at - size:.6g} to "
                f"{point + at + size:.6g}: widen the region.",
                path="method.options.region",
            )


def synthesise_nonlinear(model: DAEModel, options: Any, *, progress: Callable[[str], None]) -> Synthesis:
    """Return the test of the linear model with its remainder; what no test can do is not claimed."""
    lacking = [name for name in ("region", "sample_time") if getattr(options, name) is None]
    if lacking:
        raise PreconditionError(
            f"A nonlinear plant needs {' and '.join(lacking)}: the remainder of its linear model in the region counts "
            "as a disturbance. Or linearise and sample it (obsynth.linearise, obsynth.discretise): the test is then "
            "as good as the linear model.",
            condition="region stated",
        )
    progress("bounding the remainder of the linear model")
    plant, own = _linear(model, options)
    synthesis = synthesise(plant, own, progress=progress)
    matrices = {name: part for name, part in synthesis.certificate.matrices.items() if not name.startswith("witness")}
    claims = {name: value for name, value in synthesis.certificate.claims.items() if name != "least"}
    region = {name: [float(end) for end in ends] for name, ends in options.region.items()}
    shipped_options = {
        **synthesis.options,
        "region": region,
        "sample_time": options.sample_time,
        "given": options.given,
        "model": model.as_dict(),
    }
    left_out = [own.disturbance_bounds[name] for name in remainder_names(plant)]
    share = np.array(left_out)
    notes = [note for note in synthesis.notes if "no function" not in note and "least is not claimed" not in note]
    notes.insert(
        0,
        f"The plant is nonlinear: the remainder of its linear model is at most {upper_text(share.max(), 3)} in a state "
        "or an output, while all signals stay in the region, between samples too; known inputs and faults are held "
        "there"
        + (". " if own.disturbance in ("any", "rate") else ", and unknown inputs. ")
        + "That there is no smaller threshold is not claimed, as the remainder is bounded and not known.",
    )
    return replace(
        synthesis,
        options=shipped_options,
        certificate=Certificate(matrices, claims),
        notes=tuple(notes),
        plant=plant,
        transformation=None,
    )

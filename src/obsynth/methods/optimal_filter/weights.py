"""Weights of the errors, of the noise and of the faults: numbers or stable models, one for each signal or of a group.

The gain of the weighted problem is that from n to ``We e``, where ``w = Ww n`` (and ``f = Wf n`` where faults drive
the error).  A filter for ``We e`` gives ``We fhat``; the inverse of We behind it gives fhat, so that every We must pass
at once and have strictly stable zeros.  That of a group may be one square model that couples its signals.  In sampled
time a weight of one signal with fewer zeros than poles is taken without its delay, which changes no size.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import block_diag

from obsynth.analysis.existence.condition import OPTIONS_PATH
from obsynth.errors import SpecError
from obsynth.methods.optimal_filter.reference import plain
from obsynth.methods.optimal_filter.stated_models import is_stated_model, model_of
from obsynth.numerics.arguments import is_finite_number
from obsynth.numerics.decoupling_windows import Model
from obsynth.numerics.least_estimation import STABLE_RADIUS
from obsynth.numerics.ranks import decide_rank
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.signal_names import require_known

#: Where a message points.
PATH = f"{OPTIONS_PATH}.weights"
#: What is weighted, by the names of the groups.
ERRORS, INPUTS = "errors", "inputs"
#: What is done about a transfer function with fewer zeros than poles.
MORE_ZEROS = "For each zero that is missing add one beyond the frequencies that matter, as (0.001 s + 1) / (s + 1) has."
MORE_ZEROS_SAMPLED = "Multiply it by z for each zero that is missing, which leaves its size at every frequency."


class Weights(NamedTuple):
    """Square models: of the errors, of the noise, and of the faults where these drive the error."""

    errors: Model | None
    noise: Model | None
    faults: Model | None

    @property
    def order(self) -> int:
        """States of all of them."""
        return sum(len(model[0]) for model in self if model is not None)


def weights_of(option: Any, plant: DescriptorSystem, *, rows: int, exact: bool) -> Weights | None:
    """Return the weights of a plant whose bounded disturbances count as noise; ``None`` where nothing is weighted.

    ``rows``: of the estimate.  Raise `SpecError` for signals that have none, and for models that are no weights.
    """
    if option is None:
        return None
    if not isinstance(option, Mapping) or not set(option) <= {ERRORS, INPUTS}:
        raise SpecError(
            "weights are {'errors': {'fault': weight}, 'inputs': {'noise': weight}}, each a number or a stable model "
            "of one input and one output, such as control.tf([1, 1], [1, 0.1]), or one square model of a group.",
            path=PATH,
        )
    names = plant.fault_names if rows == plant.nf else tuple(f"reference {i + 1}" for i in range(rows))
    coupled = _coupled(option.get(ERRORS), names, plant, ERRORS)
    errors = {} if coupled is not None else _by_name(option.get(ERRORS), names, plant, ERRORS)
    if plant.is_discrete:
        errors = {name: _without_delay(model) for name, model in errors.items()}
    inverted = {f"{ERRORS}.{name}": model for name, model in errors.items()} if coupled is None else {ERRORS: coupled}
    for name, model in inverted.items():
        _require_inverse(model, plant, name)
    faults = () if exact else plant.fault_names
    noise = _coupled(option.get(INPUTS), plant.noise_names, plant, INPUTS)
    if noise is not None and faults:
        raise SpecError(
            "One model of all inputs would weigh the noise together with the faults, which drive the error here too: "
            "weigh each input by its name, or make the model that forms the noise part of the plant.",
            path=f"{PATH}.{INPUTS}",
        )
    inputs = {} if noise is not None else _by_name(option.get(INPUTS), (*plant.noise_names, *faults), plant, INPUTS)
    weights = Weights(
        _diagonal(errors, names) if coupled is None else coupled,
        _diagonal(inputs, plant.noise_names) if noise is None else noise,
        _diagonal(inputs, faults),
    )
    return None if weights == (None, None, None) else weights


def plain_weights(option: Any, plant: DescriptorSystem) -> Any:
    """Return the weights as an option: numbers, and matrices of models by name."""
    if option is None:
        return None
    groups = {ERRORS: option.get(ERRORS), INPUTS: option.get(INPUTS)}
    weights_by_group: dict[str, Any] = {}
    for group, entry in groups.items():
        if isinstance(entry, Mapping) and not is_stated_model(entry):
            weights_by_group[group] = {str(name): _plain(one, plant, f"{group}.{name}") for name, one in entry.items()}
        elif entry is not None:
            is_number = is_finite_number(entry)
            path = f"{PATH}.{group}"
            weights_by_group[group] = float(entry) if is_number else plain(model_of(entry, plant, "weight", path))
    return weights_by_group


def inverse(model: Model) -> Model:
    """Return the inverse of a square model that passes at once."""
    a, b, c, d = model
    over = np.asarray(np.linalg.inv(d), dtype=np.float64)
    return a - b @ over @ c, b @ over, -over @ c, over


def in_series(first: Model, second: Model) -> Model:
    """Return the model of ``second`` behind ``first``."""
    a1, b1, c1, d1 = first
    a2, b2, c2, d2 = second
    return (
        np.block([[a1, np.zeros((len(a1), len(a2)))], [b2 @ c1, a2]]),
        np.vstack([b1, b2 @ d1]),
        np.hstack([d2 @ c1, c2]),
        np.asarray(d2 @ d1, dtype=np.float64),
    )


def _plain(entry: Any, plant: DescriptorSystem, name: str) -> Any:
    return float(entry) if is_finite_number(entry) else plain(_weight(entry, plant, name))


def _coupled(entry: Any, names: tuple[str, ...], plant: DescriptorSystem, group: str) -> Model | None:
    """Return the one square model of several signals, in their order; ``None`` for weights of one signal each."""
    if entry is None or is_finite_number(entry) or (isinstance(entry, Mapping) and not is_stated_model(entry)):
        return None
    path = f"{PATH}.{group}"
    model = model_of(entry, plant, "weight", path)
    if model[3].shape == (1, 1):
        return None
    if model[3].shape != (len(names), len(names)):
        raise SpecError(
            f"The weight of all {group} has {model[3].shape[1]} inputs and {model[3].shape[0]} outputs: give one of "
            f"each, or {len(names)}, for {', '.join(names)}.",
            path=path,
        )
    return model


def _by_name(entries: Any, names: tuple[str, ...], plant: DescriptorSystem, group: str) -> dict[str, Model]:
    """Return the weights of named signals; one that is not by name is that of all of them."""
    if entries is None:
        return {}
    if isinstance(entries, Mapping) and not is_stated_model(entries):
        require_known(entries, names, what=f"{PATH}.{group}", kind="signal")
        return {name: _weight(entries[name], plant, f"{group}.{name}") for name in names if name in entries}
    weight = _weight(entries, plant, group)
    return dict.fromkeys(names, weight)


def _weight(value: Any, plant: DescriptorSystem, name: str) -> Model:
    path = f"{PATH}.{name}"
    if is_finite_number(value):
        if value == 0:
            raise SpecError(f"The weight of {name} is zero: leave the signal out of the plant instead.", path=path)
        none = np.zeros((0, 0))
        return none, np.zeros((0, 1)), np.zeros((1, 0)), np.array([[float(value)]])
    model = model_of(value, plant, "weight", path)
    if model[3].shape != (1, 1):
        raise SpecError(
            f"The weight of {name} has {model[3].shape[1]} inputs and {model[3].shape[0]} outputs: give one of each.",
            path=path,
        )
    return model


def _without_delay(model: Model) -> Model:
    """Return a sampled model of one signal times z for each zero that is missing."""
    a, b, c, d = model
    for _ in range(len(a)):
        if d.any():
            break
        c, d = c @ a, c @ b
    return a, b, c, d


def _require_inverse(model: Model, plant: DescriptorSystem, name: str) -> None:
    a, _, _, d = model
    if decide_rank(d, expected=len(d)).full:
        behind = inverse(model)[0]
        zeros = np.linalg.eigvals(behind) if len(a) else np.zeros(0)
        # Zeros on the boundary come out beside it, on either side.
        axis = (STABLE_RADIUS - 1.0) * float(np.linalg.norm(behind))
        if np.all(np.abs(zeros) < STABLE_RADIUS) if plant.is_discrete else np.all(zeros.real < axis):
            return
    raise SpecError(
        f"The weight of {name} has no stable inverse: it must pass at once (as many zeros as poles) and its zeros must "
        "be strictly stable. A zero outside may be replaced by its mirror image: the size of the weight is the same. "
        f"{MORE_ZEROS_SAMPLED if plant.is_discrete else MORE_ZEROS}",
        path=f"{PATH}.{name}",
    )


def _diagonal(weights: Mapping[str, Model], names: tuple[str, ...]) -> Model | None:
    """Return one model of all signals; ``None`` where none of them is weighted."""
    if not set(names) & set(weights):
        return None
    plain_one: Model = (np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.ones((1, 1)))
    parts = [weights.get(name, plain_one) for name in names]
    a, b, c, d = (np.asarray(block_diag(*(part[i] for part in parts)), dtype=np.float64) for i in range(4))
    return a, b, c, d

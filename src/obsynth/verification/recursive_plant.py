"""The way from the plant as written to the one that a recursive observer is for: sampled again, inputs made states."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from obsynth.analysis.existence.kalman import without_unknown_inputs
from obsynth.analysis.existence.shared_noise import shared_noise
from obsynth.analysis.time_varying import as_time_varying
from obsynth.errors import ObsynthError
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem
from obsynth.plants.transformations.recovery import StateRecovery, unchanged_states
from obsynth.results.checks import Check, nothing_wrong, upper_bound_check
from obsynth.results.design import ObserverDesign
from obsynth.results.plant_source import PlantSource
from obsynth.verification.plant import (
    DERIVED_TOLERANCE,
    FAMILY_TOLERANCE,
    STORED_TWICE,
    assumed_recovery_row,
    recovery_as_written_row,
    relative_difference,
)

#: Names that the plant as written and the recursive one share: faults are parameters there.
_SAME_NAMES = {"input_names": "input_names", "output_names": "output_names", "fault_names": "parameter_names"}

_SOURCE = "the plant as written, eliminated, sampled and extended again"


def recursive_plant_rows(design: ObserverDesign) -> Iterator[Check]:
    """Yield the rows on plant, way back and names of a recursive design of a plant that was written in another form."""
    plant, source, back = design.plant, design.source, design.recovery
    if not isinstance(plant, TimeVaryingDescriptorSystem) or (source is None and back is None):
        return
    if back is not None:
        yield _kept_states_row(plant, back)
    if source is None:
        yield assumed_recovery_row()
        return
    try:
        derived = source.derived
        misses = [_missed(other, plant) for other in _forms(derived.plant)]
    except ObsynthError as error:
        yield upper_bound_check(
            "plant as written", "it can be brought into this form again", 1.0, 0.0, source=_SOURCE, detail=str(error)
        )
        return
    follows = upper_bound_check(
        "plant as written",
        "the plant of the design follows from it",
        min(misses),
        DERIVED_TOLERANCE,
        source=_SOURCE,
        kind="equality",
        detail=derived.description or "nothing had to be done",
    )
    yield follows
    if follows.passed and back is not None:
        own = derived.plant
        leading = unchanged_states(own, own, from_state=np.eye(own.nx, plant.nx))
        yield recovery_as_written_row(derived.recovery.then(leading), back)
    wrong = [*_wrong_labels(source, plant), *_wrong_noise(derived.recovery, back)]
    yield nothing_wrong(
        "stored twice",
        "names, units, operating point, sample time and noise agree wherever they are stored",
        wrong,
        source=STORED_TWICE,
    )


def _forms(plant: DescriptorSystem) -> Iterator[TimeVaryingDescriptorSystem]:
    """Yield the plants that recursive methods filter for: without unknown inputs, with and without noise as states."""
    shared = shared_noise(plant, Q=None, R=None)
    for form in (plant,) if shared is None else (plant, shared.plant):
        yield without_unknown_inputs(form).plant if form.nd else as_time_varying(form)


def _missed(made: TimeVaryingDescriptorSystem, own: TimeVaryingDescriptorSystem) -> float:
    """Return the largest relative difference of matrices; infinite where states, inputs or a length are others."""
    if (made.nx, made.ne, made.state_names, made.horizon) != (own.nx, own.ne, own.state_names, own.horizon):
        return np.inf
    if not own.is_time_invariant:
        return np.inf
    mine = own.matrices
    pairs = [(each.at(1), mine[name].at(1)) for name, each in made.matrices.items()]
    return float(np.max([relative_difference(one, other) for one, other in pairs]))


def _kept_states_row(plant: TimeVaryingDescriptorSystem, back: StateRecovery) -> Check:
    """Return the row that a state, which the plant still has, is recovered as itself."""
    shaped = back.from_state.shape == (len(back.names), plant.nx) and len(set(back.names)) == len(back.names)
    difference = np.inf
    if shaped:
        names = [name for name in back.names if name in plant.state_names]
        rows = [back.names.index(name) for name in names]
        expected = np.eye(plant.nx)[[plant.state_names.index(name) for name in names]]
        direct = np.hstack([back.from_input, back.from_fault, back.from_disturbance, back.from_noise])[rows]
        difference = float(np.max(np.abs(np.hstack([back.from_state[rows] - expected, direct])), initial=0.0))
    return upper_bound_check(
        "recovery of kept states",
        "a state that the plant still has is recovered as itself",
        difference,
        DERIVED_TOLERANCE,
        source="the plant of the design",
        kind="equality",
    )


def _wrong_labels(source: PlantSource, plant: TimeVaryingDescriptorSystem) -> Iterator[str]:
    written = source.plant
    for name, own in _SAME_NAMES.items():
        if tuple(getattr(written, name)) != tuple(getattr(plant, own)):
            yield f"{name} as written"
    signals = {name for own in _SAME_NAMES.values() for name in getattr(plant, own)}
    signals |= set(plant.state_names) & {*written.state_names, *written.disturbance_names}
    for label in ("units", "scales", "operating_point"):
        one, other = getattr(written, label), getattr(plant, label)
        if any(one.get(name) != other.get(name) for name in signals):
            yield f"{label} as written"
    if plant.dt != (written.dt if source.sample_time is None else source.sample_time):
        yield "sample time"


def _wrong_noise(derived: StateRecovery, back: StateRecovery | None) -> Iterator[str]:
    """Yield covariances of the noise in the states as written that are others: factors are not unique."""
    if back is None or back.names != derived.names:
        return
    first, second = (np.vstack([each.from_noise, each.noise_kept]) for each in (derived, back))
    if len(first) != len(second):
        yield "size of the noise as written"
        return
    one, other = first @ first.T, second @ second.T
    size = np.sqrt(np.maximum(np.diag(one), np.diag(other)))
    if (np.abs(one - other) > FAMILY_TOLERANCE * np.outer(size, size)).any():
        yield "covariance of the noise"

"""Suggestions for a refused design, each of them tried: default options, more sensors, fewer signals, other methods."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import MISSING, fields, replace
from typing import TYPE_CHECKING

import numpy as np

from obsynth.analysis.existence.condition import Condition, without_opening
from obsynth.errors import ObsynthError, PreconditionError, SpecError
from obsynth.methods.method import Method, plain
from obsynth.methods.registry import REGISTRY, method_class
from obsynth.plants.descriptor import DescriptorSystem

if TYPE_CHECKING:
    from obsynth.analysis.diagnosis.candidate_sensors import Sensor

#: Plants with more states are not searched for pairs, and those with more still not at all.
MOST_FOR_PAIRS, MOST_FOR_ONE = 16, 48

#: Methods that estimate every state beside the faults.
_OF_THE_WHOLE_STATE = ("pd-observer", "ui-pi-observer")

#: Methods whose estimates unknown inputs reach, by a bounded gain.
_DISTURBED = ("fault-estimation-filter", "pd-observer")

#: Conditions on the kind of plant, whose messages say what to do: no sensor changes it.
OF_THE_KIND = ("continuous time", "discrete time", "plant of this kind")


def require_all_conditions(conditions: Iterable[Condition]) -> None:
    """Raise `PreconditionError` for the first condition that fails, and say which others fail too."""
    failed = [condition for condition in conditions if not condition.holds]
    if not failed:
        return
    first, *further = failed
    try:
        first.require()
    except PreconditionError as error:
        if not further:
            raise
        also = "; ".join(f"{other.name}: {other.detail}" for other in further)
        raise PreconditionError(
            f"{error} Also fails: {also}",
            condition=first.name,
            mode=next((condition.mode for condition in failed if condition.mode is not None), None),
            signals=tuple(dict.fromkeys(name for condition in failed for name in condition.signals)),
            unclear=error.unclear,
        ) from None


def with_advice(
    error: PreconditionError,
    plant: DescriptorSystem,
    method: Method,
    *,
    sensors: Sequence[Sensor] | None = None,
    notes: Sequence[str] = (),
) -> PreconditionError:
    """Return the refusal with what would help at its end; as it is where the existence conditions hold.

    ``sensors``: those to try, by default one for each state; ``notes``: what was done to the plant before."""
    from obsynth.analysis.diagnosis.candidate_sensors import least_additions, listed_sets, state_sensors

    def holds(plant: DescriptorSystem, method: Method = method) -> bool:
        # What would help is a suggestion, not proved: the tried plant is decided exactly then.
        try:
            return all(condition.holds for condition in method.for_plant(plant).existence(plant, exactly=False))
        except (ObsynthError, np.linalg.LinAlgError):
            return False

    if holds(plant):
        return error
    text = without_opening(str(error))
    if len(notes) > 1 and text is not None:
        # Outputs were left out: nothing is proved of the plant with them.
        error = PreconditionError(
            f"{method.id} works on a proper form of this plant, which does not allow it: {text}",
            condition=error.condition,
            mode=error.mode,
            signals=error.signals,
            unclear=error.unclear,
        )
    error = _named_assumption(error, plant, method)
    if not plant.nf and error.condition == "faults":
        # No sensor makes a fault of none.
        return error
    without = [words for words, other in _with_an_option_at_its_default(method) if holds(plant, other)]
    candidates = _as_noisy_as_others(plant, state_sensors(plant)) if sensors is None else sensors
    sets = () if without else least_additions(plant, candidates, holds, most=(MOST_FOR_ONE, MOST_FOR_PAIRS))
    if without:
        text = f"It exists {', or '.join(without)}."
    elif sets:
        text = f"Measure one of: {listed_sets(sets)}."
    elif drops := _drops(plant, holds):
        text = f"Leave out one of: {', '.join(drops)}."
    elif error.condition in OF_THE_KIND:
        return error
    else:
        text = _no_remedy(plant)
    return PreconditionError(
        " ".join([str(error), *notes, *_zero_columns(plant), text]),
        condition=error.condition,
        mode=error.mode,
        signals=error.signals,
        add=sets,
        unclear=error.unclear,
    )


def _zero_columns(plant: DescriptorSystem) -> list[str]:
    """Return one sentence on faults that enter no equation and no output, and where that comes from; none elsewhere."""
    entries = np.vstack([plant.Bf, plant.Df])
    names = [name for name, column in zip(plant.fault_names, entries.T, strict=True) if not column.any()]
    if not names:
        return []
    columns = f"The columns of {', '.join(names)} in Bf and Df are zero"
    if not plant.operating_point:
        return [f"{columns}."]
    return [f"{columns}: at this operating point small changes have no effect. That of another point may be different."]


def _with_an_option_at_its_default(method: Method) -> Iterator[tuple[str, Method]]:
    """Yield, for each option that a caller has changed, the method with its default, and words for the difference."""
    for option in fields(method):
        given, default = getattr(method, option.name), option.default
        if default is MISSING or np.array_equal(given, default):
            continue
        try:
            other = replace(method, **{option.name: default})
        except SpecError:
            # The other options need it.
            continue
        words = f"with {option.name} {default!r} in place of {plain(given)!r}"
        yield (f"without {option.name}" if default is None else words), other


def _as_noisy_as_others(plant: DescriptorSystem, sensors: Sequence[Sensor]) -> Sequence[Sensor]:
    """Return sensors with noise of the usual size, where every sensor of the plant has noise of its own."""
    deviations = np.linalg.norm(plant.Dw, axis=1)
    if not plant.ny or not np.all(deviations > 0.0):
        return sensors
    return [replace(sensor, deviation=float(np.median(deviations))) for sensor in sensors]


def _named_assumption(error: PreconditionError, plant: DescriptorSystem, method: Method) -> PreconditionError:
    """Return the refusal as one of this method alone where others estimate the faults of the plant: they are named."""
    text = without_opening(str(error))
    if text is None or plant.nx > MOST_FOR_ONE or "faults" not in method.purposes:
        return error
    alternatives = [name for name in _methods_for_faults(method) if _exists(name, plant)]
    states = bool(getattr(method, "states", None))
    if states:
        # Of the methods for faults these estimate the whole state, with faults that follow their models.
        alternatives = [name for name in alternatives if name in _OF_THE_WHOLE_STATE]
    if not alternatives:
        return error
    estimated = _with_alternatives(plant, alternatives, states=states)
    return PreconditionError(
        f"{method.id} assumes more than this plant has: {text} {estimated}",
        condition=error.condition,
        mode=error.mode,
        signals=error.signals,
        unclear=error.unclear,
    )


def _with_alternatives(plant: DescriptorSystem, names: Sequence[str], *, states: bool) -> str:
    """Return what other methods estimate: what unknown inputs reach is not said to be estimated without more."""
    disturbed = [name for name in names if plant.nd and name in _DISTURBED]
    free = [name for name in names if name not in disturbed]
    sentences = []
    if free and states:
        sentences.append(f"The states can be estimated beside faults that follow their models: {_exist(free)}.")
    elif free:
        sentences.append(f"The {'faults' if plant.nf else 'states'} can be estimated: {_exist(free)}.")
    if disturbed:
        reached = "its estimates" if len(disturbed) == 1 else "their estimates"
        inputs = f"{', '.join(plant.disturbance_names)} reach{'es' if plant.nd == 1 else ''}"
        sentences.append(f"{'Also ' if free else ''}{_exist(disturbed)}, but {inputs} {reached}.")
    return " ".join(sentences)


def _exist(names: Sequence[str]) -> str:
    return f"{', '.join(names)} exist{'s' if len(names) == 1 else ''}"


def _methods_for_faults(own: Method) -> list[str]:
    classes = {name: method_class(name) for name in REGISTRY}
    return [
        name
        for name, method in classes.items()
        if name != own.id and "faults" in method.purposes and "time-invariant" in method.plants
    ]


def _exists(name: str, plant: DescriptorSystem) -> bool:
    """Whether a method exists for a plant, decided on the numbers as written."""
    method = method_class(name)
    try:
        return all(condition.holds for condition in method.of(method.placeholders).existence(plant))
    except (ObsynthError, np.linalg.LinAlgError):
        return False


def _drops(plant: DescriptorSystem, holds: Callable[[DescriptorSystem], bool]) -> list[str]:
    """Return the unknown inputs and faults without any one of which the design exists."""
    if plant.nx > MOST_FOR_ONE:
        return []
    kinds = {"unknown input": ("Bd", "Dd", "disturbance_names"), "fault": ("Bf", "Df", "fault_names")}
    droppable = []
    for kind, (matrix, direct, listed_names) in kinds.items():
        names = getattr(plant, listed_names)
        for i, name in enumerate(names if kind != "fault" or plant.nf > 1 else ()):
            remaining = [j for j in range(len(names)) if j != i]
            fewer = {part: getattr(plant, part)[:, remaining] for part in (matrix, direct)}
            fewer |= {listed_names: [names[j] for j in remaining]}
            if holds(plant.replace(**fewer, units={}, operating_point={})):
                droppable.append(f"{kind} {name}")
    return droppable


def _no_remedy(plant: DescriptorSystem) -> str:
    if plant.nx > MOST_FOR_ONE:
        return f"With {plant.nx} states, ask obsynth.sensor_sets which sensors would help."
    return "Neither one more measured state nor one unknown input or fault less would help."

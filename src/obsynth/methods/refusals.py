"""Remedies for a refused design, each tried; and designs that rounding makes useless.

Outputs ``y = G f`` right to the last digit change an estimate by up to ``u (|Cz| |(s - Az)^-1| |By| + |Dy|) |G| |f|``,
u the unit roundoff, in any units; the observer's own numbers, with z its state, by up to
``u (|Cz| |(s - Az)^-1| (|Az| |z| + |By| |y|) + |Cz| |z| + |Dy| |y|)``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import MISSING, fields, replace
from fractions import Fraction
from typing import TYPE_CHECKING

import numpy as np

from obsynth.analysis.existence.condition import Condition, without_opening
from obsynth.analysis.existence.witnesses import EntryChange, Unclear, Witness
from obsynth.errors import ObsynthError, PreconditionError, SpecError
from obsynth.methods.method import Method, plain
from obsynth.methods.registry import REGISTRY, method_class
from obsynth.numerics.arrays import ComplexArray, FloatArray
from obsynth.numerics.spectra import pole_text
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.proofs.balls import UNIT_ROUNDOFF
from obsynth.verification.constant_faults import STEADY_ERROR

if TYPE_CHECKING:
    from obsynth.analysis.diagnosis.explanations import Sensor

#: Plants with more states are not searched for pairs, and those with more still not at all.
MOST_FOR_PAIRS, MOST_FOR_ONE = 16, 48

#: Methods that estimate every state beside the faults.
_OF_THE_WHOLE_STATE = ("pd-observer", "ui-pi-observer")

#: Methods whose estimates unknown inputs reach, by a bounded gain.
_DISTURBED = ("fault-estimation-filter", "pd-observer")

#: Conditions on the kind of plant, whose messages say what to do: no sensor changes it.
OF_THE_KIND = ("continuous time", "discrete time", "plant of this kind")

#: Share of a unit fault that rounding of the outputs may be of its estimate.
LARGEST_ROUNDED_SHARE = 0.1

#: Share of a unit fault from which on rounding of the observer's own numbers is reported.
TOLD_ROUNDING = 1e-6

#: Share of a constant fault from which on rounding while the observer runs is reported: what its estimate may miss.
TOLD_STEADY_ROUNDING = STEADY_ERROR

#: Observers of more states are not examined under constant faults: one inverse of this size takes 20 ms.
MOST_STEADY_STATES = 400

#: Observers of more states are not examined: their certificates bound what rounding of their numbers does.
MOST_OBSERVER_STATES = 150

#: Points at which that is judged, in continuous time in units of the plant's own rate.
ROUNDING_POINTS = (0.0, 1e-2, 1e-1, 1.0)


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
    from obsynth.analysis.diagnosis.explanations import least_additions, listed_sets, state_sensors

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
    without = [_without(name, method) for name, other in _at_default(method) if holds(plant, other)]
    candidates = _as_noisy_as_others(plant, state_sensors(plant)) if sensors is None else sensors
    sets = () if without else least_additions(plant, candidates, holds, most=(MOST_FOR_ONE, MOST_FOR_PAIRS))
    if without:
        text = f"It exists {', and '.join(without)}."
    elif sets:
        text = f"Measure one of: {listed_sets(sets)}."
    elif drops := _drops(plant, holds):
        text = f"Leave out one of: {', '.join(drops)}."
    elif error.condition in OF_THE_KIND:
        return error
    else:
        text = _no_remedy(plant)
    return PreconditionError(
        " ".join([str(error), *notes, text]),
        condition=error.condition,
        mode=error.mode,
        signals=error.signals,
        add=sets,
        unclear=error.unclear,
    )


def _at_default(method: Method) -> Iterator[tuple[str, Method]]:
    """Yield the method with one of its options at its default, for each option that a caller has changed."""
    for option in fields(method):
        if option.default is MISSING or np.array_equal(getattr(method, option.name), option.default):
            continue
        try:
            yield option.name, replace(method, **{option.name: option.default})
        except SpecError:
            # The other options need it.
            continue


def _without(name: str, method: Method) -> str:
    default = next(option.default for option in fields(method) if option.name == name)
    given = "" if default is None else f" in place of {plain(getattr(method, name))!r}"
    return f"without {name}" if default is None else f"with {name} {default!r}{given}"


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


def require_above_rounding(plant: DescriptorSystem, observer: LinearObserver) -> tuple[str, ...]:
    """Return what rounding of the observer's own numbers may do to an estimate, where that matters.

    Raise `PreconditionError` (unclear) where rounding of the outputs hides the estimate of a unit fault."""
    steady = tuple(_under_constant_faults(plant, observer))
    shares = _least(plant, observer)
    if shares is None:
        return steady
    least, own = shares
    worst = int(np.argmax(least))
    if least[worst] >= LARGEST_ROUNDED_SHARE:
        name = plant.fault_names[worst]
        raise PreconditionError(
            "Unclear: gains were found, but they are so large that rounding of the outputs to double "
            f"precision alone moves the estimate of {name!r} by {least[worst]:.2g} of the fault at every frequency "
            f"tried. {_deciding_digit(plant, observer, worst).described(plant)}",
            condition="gains against rounding",
            signals=(name,),
            unclear=True,
        )
    cancelling = tuple(
        f"The entries of the observer cancel: their last digits alone may change the estimate of {name!r}"
        f" by {share:.2g} of the fault, and by more at some frequencies. State the noise of the sensors, or ask "
        "for a larger gamma."
        for name, share in zip(plant.fault_names, own, strict=True)
        if share >= TOLD_ROUNDING
    )
    return (*cancelling, *steady)


def _under_constant_faults(plant: DescriptorSystem, observer: LinearObserver) -> Iterator[str]:
    """Yield a note for each fault whose estimate, while it stays constant, running in double precision may move."""
    if not _is_examined(plant, observer, MOST_STEADY_STATES):
        return
    with np.errstate(all="ignore"):
        shares = rounding_shares(plant, observer, _points(plant)[0])[1]
    for name, share in zip(plant.fault_names, shares, strict=True):
        if share >= TOLD_STEADY_ROUNDING:
            yield (
                f"While {name!r} is constant, rounding as the observer runs in double precision may move its estimate "
                f"by about {share:.2g} of the fault (every rounding at its worst, to first order): what is proved of "
                "the estimate in the end is for exact arithmetic. Compare with another method (obsynth.compare)."
            )


def _deciding_digit(plant: DescriptorSystem, observer: LinearObserver, fault: int) -> Unclear:
    """Return the last digit of a number of the plant, or else of the observer, that moves an estimate most."""
    worst_witness = max(
        (witness for point in _points(plant) for witness in last_digits(plant, observer, fault, point)),
        key=lambda witness: (
            witness.changes[0].matrix in ("C", "Df") and witness.size >= LARGEST_ROUNDED_SHARE,
            witness.size,
        ),
        default=None,
    )
    size, place = (0.0, 0j) if worst_witness is None else (worst_witness.size, worst_witness.point or 0j)
    where = pole_text(place)
    return Unclear(
        UNIT_ROUNDOFF,
        worst_witness,
        f"has an estimate of {plant.fault_names[fault]!r} that differs by {size:.2g} of the fault at "
        f"{'z' if plant.is_discrete else 's'} = {where}",
        "A slower decay, a larger gamma, or an output that is more sensitive to the fault would decide it.",
    )


def last_digits(plant: DescriptorSystem, observer: LinearObserver, fault: int, point: complex) -> Iterator[Witness]:
    """Yield the entry of each matrix whose last digit moves the estimate of a unit fault most at a point."""
    responses = _responses(plant, observer, point)
    if responses is None:
        return
    outputs, resolvent = responses
    row = range(len(observer.Cz))[observer.fault_rows][fault]
    states = np.linalg.solve(point * plant.E - plant.A, plant.Bf)[:, fault]
    row_response, output = observer.Cz[row] @ resolvent, outputs[:, fault]
    gain = row_response @ observer.By + observer.Dy[row]
    effects = {
        "C": np.outer(np.abs(gain), np.abs(states)),
        "Df": np.outer(np.abs(gain), np.eye(plant.nf)[fault]),
        "By": np.outer(np.abs(row_response), np.abs(output)),
        "Dy": np.outer(np.arange(len(observer.Dy)) == row, np.abs(output)),
    }
    for name, effect in effects.items():
        matrix = getattr(plant if name in ("C", "Df") else observer, name)
        moved = effect * np.where(matrix != 0.0, np.spacing(np.abs(matrix)), 0.0)
        if not moved.size or not np.all(np.isfinite(moved)) or not moved.any():
            continue
        i, j = (int(k) for k in np.unravel_index(np.argmax(moved), moved.shape))
        before = float(matrix[i, j])
        after = before + float(np.copysign(np.spacing(abs(before)), before))
        change = EntryChange(name, i, j, Fraction(before), Fraction(after))
        yield Witness((change,), float(moved[i, j]), point)


def _least(plant: DescriptorSystem, observer: LinearObserver) -> FloatArray | None:
    """Return the least of `rounding_shares` over the points ``(2, nf)``, NaN where none is a number; ``None`` where it
    is not examined."""
    if not _is_examined(plant, observer, MOST_OBSERVER_STATES):
        return None
    with np.errstate(all="ignore"):
        shares = [rounding_shares(plant, observer, point) for point in _points(plant)]
        return np.asarray(np.fmin.reduce(shares, axis=0))


def _is_examined(plant: DescriptorSystem, observer: LinearObserver, most: int) -> bool:
    return bool(plant.nf) and observer.order <= most and not plant.is_sparse and len(observer.fault_names) == plant.nf


def _points(plant: DescriptorSystem) -> list[complex]:
    if plant.is_discrete:
        return [complex(np.exp(1j * point)) for point in ROUNDING_POINTS]
    sizes = np.linalg.norm(plant.E), np.linalg.norm(plant.A)
    rate = float(sizes[1] / sizes[0]) if all(sizes) else 1.0
    return [complex(0.0, rate * point) for point in ROUNDING_POINTS]


def _responses(
    plant: DescriptorSystem, observer: LinearObserver, point: complex
) -> tuple[ComplexArray, ComplexArray] | None:
    """Return the outputs for each fault and the observer's resolvent at one point; ``None`` at a pole of either."""
    try:
        states = np.linalg.solve(point * plant.E - plant.A, plant.Bf)
        resolvent = np.linalg.inv(point * np.eye(observer.order) - observer.Az)
    except np.linalg.LinAlgError:
        return None
    return np.asarray(plant.C @ states + plant.Df, dtype=np.complex128), np.asarray(resolvent)


def rounding_shares(plant: DescriptorSystem, observer: LinearObserver, point: complex) -> FloatArray:
    """Return the shares of each fault that rounding may be ``(2, nf)``: of the outputs, and of the observer's own
    numbers; NaN where one is no number."""
    responses = _responses(plant, observer, point)
    if responses is None:
        return np.full((2, plant.nf), np.nan)
    outputs, resolvent = responses
    rows, output_sizes, size = observer.fault_rows, np.abs(outputs), np.abs(resolvent)
    driving, state = np.abs(observer.By) @ output_sizes, np.abs(resolvent @ observer.By @ outputs)
    of_outputs = size @ driving
    moved = np.stack((of_outputs, of_outputs + size @ (np.abs(observer.Az) @ state) + state))
    shares = np.abs(observer.Cz[rows]) @ moved + np.abs(observer.Dy[rows]) @ output_sizes
    rounded = UNIT_ROUNDOFF * np.diagonal(shares, axis1=1, axis2=2)
    return np.asarray(np.where(np.isfinite(rounded).all(axis=1, keepdims=True), rounded, np.nan))

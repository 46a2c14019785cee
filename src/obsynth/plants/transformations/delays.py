"""Plants with delays as plants without: exact for whole samples, by Pade approximations in continuous time."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from math import gcd, lcm
from typing import Annotated, Any

import numpy as np
import scipy
from annotated_types import Ge, Le

from obsynth.errors import PreconditionError, SpecError
from obsynth.numerics.arguments import arguments_checked, require_kind
from obsynth.numerics.arrays import FloatArray
from obsynth.plants.dae import DAEModel
from obsynth.plants.dead_times import delays_in_words
from obsynth.plants.descriptor import DescriptorSystem, note_source
from obsynth.plants.polytopic import PolytopicSystem
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem
from obsynth.plants.transformations.delayed_signals import counted_at_reading, whole_samples_late
from obsynth.plants.transformations.elimination import eliminate_algebraic_states
from obsynth.plants.transformations.recovery import StateRecovery, Transformation, unchanged_states, with_states

#: Polynomials of higher degree lose more digits than they gain in bandwidth.
MOST_PADE_ORDER = 8

#: A Pade approximation is good as far as it is off by at most this share.
PADE_SHARE = 0.05

#: Where that angle is looked for, in rad over the delay: even of order one it is above the first, and then by steps.
FIRST_ANGLE, ANGLE_RATIO = 0.5, 1.1

#: Delays that are multiples of one time get samples of that time where these are at most so many.
FEW_SAMPLES = 25

#: Otherwise the longest delay gets so many samples.
SAMPLES_OF_LONGEST = 10


@arguments_checked
def absorb_delays(
    plant: DescriptorSystem | Transformation, order: Annotated[int, Ge(1), Le(MOST_PADE_ORDER)] | None = None
) -> Transformation:
    """Return a plant whose delayed signals are states, so that it has no delays any more.

    Parameters
    ----------
    plant : DescriptorSystem or Transformation
        On samples: delays are whole samples, and the result is exact; algebraic states are eliminated first.
    order : int, optional
        Of a continuous plant: each delay is replaced by its Pade approximation of this order, 1 to 8, with as many
        states.  What is designed then holds for that model, and the notes of the transformation say up to which
        frequency it is good.

    Returns
    -------
    Transformation
        A plant without delays, and the way back to the states of the plant as written.

    Raises
    ------
    SpecError
        A delay is not a whole number of samples, or hundreds of them; ``order`` for a plant on samples.
    PreconditionError
        A continuous plant without ``order``; or its algebraic states cannot be eliminated.

    See Also
    --------
    discretise : samples a continuous plant; exact for delays of any length.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(A=[[0.5]], B=[[1.0]], C=[[1.0]], dt=0.1, delays={"u1": "200 ms"})
    >>> absorbed = obsynth.absorb_delays(plant).plant
    >>> absorbed.state_names, absorbed.delays
    (('x1', 'u1, 1 sample ago', 'u1, 2 samples ago'), {})
    """
    linear = plant.plant if isinstance(plant, Transformation) else plant
    if not linear.delays:
        return _as_it_is(plant)
    if linear.is_discrete:
        if order is not None:
            raise SpecError("order is for continuous plants: on samples delays are exact without it.", path="order")
        first = eliminate_algebraic_states(plant)
        made = whole_samples_late(first.plant)
        note_source(first.plant, made.plant)
        return made.after(first, "")
    if order is None:
        raise continuous_with_delays(linear)
    step = _approximated(linear.dense(), order)
    return plant.then(step) if isinstance(plant, Transformation) else step


def _as_it_is(plant: DescriptorSystem | Transformation) -> Transformation:
    if isinstance(plant, Transformation):
        return plant
    return Transformation(plant, plant, "", unchanged_states(plant, plant, from_state=np.eye(plant.nx)))


def continuous_with_delays(plant: DescriptorSystem, tried: str = "") -> PreconditionError:
    """Return the refusal of a continuous plant with delays; ``tried``: what is known of the plant on samples."""
    time = sample_time_of_delays(plant)
    return PreconditionError(
        f"The plant has delays ({delays_in_words(plant.delays)}), which nothing in continuous time takes: sample it, "
        f"obsynth.discretise(plant, {time:g}) (in a spec transform: {{sample_time: {time:g}}}), which is exact.{tried} "
        "Or take a Pade model, obsynth.absorb_delays(plant, order=3) (transform: {pade: 3}): claims are then for that.",
        condition="delays",
        signals=tuple(plant.delays),
    )


def sample_time_of_delays(plant: DescriptorSystem) -> float:
    """Return a sampling time in seconds that suits the delays of a plant: they are whole samples, if these are few."""
    exact = [Fraction(repr(delay)) for delay in plant.delays.values()]
    common = Fraction(gcd(*(part.numerator for part in exact)), lcm(*(part.denominator for part in exact)))
    few = max(exact) / common <= FEW_SAMPLES
    return float(common) if few else max(plant.delays.values()) / SAMPLES_OF_LONGEST


def without_delays(plant: Any) -> Any:
    """Return a linear plant whose delays became states, and any other plant as it is.

    Raises
    ------
    PreconditionError
        It is continuous.
    """
    linear = plant.plant if isinstance(plant, Transformation) else plant
    if not isinstance(linear, DescriptorSystem) or not linear.delays:
        return plant
    return absorb_delays(plant)


def require_no_delays(plant: Any, what: str) -> None:
    """Raise `SpecError` where a plant has delays, which ``what`` does not know."""
    linear = plant.plant if isinstance(plant, Transformation) else plant
    if isinstance(linear, DescriptorSystem) and linear.delays:
        way = "absorb_delays(plant)" if linear.is_discrete else f"discretise(plant, {sample_time_of_delays(linear):g})"
        raise SpecError(
            f"{what} takes no plant with delays ({delays_in_words(linear.delays)}): give obsynth.{way}, in which they "
            "are states.",
            path="delays",
        )


def plant_and_recovery(source: Any, recovery: StateRecovery | None = None) -> tuple[Any, StateRecovery | None]:
    """Return the plant of a transformation with its way back, or a plant as it is; a stated way back goes first.

    Delays on samples become states."""
    made = without_delays(source)
    if not isinstance(made, Transformation):
        return made, recovery
    if recovery is None:
        return made.plant, made.recovery
    return made.plant, recovery if isinstance(source, Transformation) else recovery.then(made.recovery)


def linear_plant(source: Any) -> DescriptorSystem:
    """Return a linear plant, of a transformation the transformed one, with delays on samples as states.

    Raises
    ------
    SpecError
        It is something else.
    PreconditionError
        It is continuous and has delays.
    """
    plant = source.plant if isinstance(source, Transformation) else source
    if isinstance(plant, DAEModel):
        raise SpecError(
            "A linear plant is needed, and this one is nonlinear. Linearise it: transform: {linearise: {at: "
            "equilibrium, faults: [...]}} in the spec, or obsynth.linearise in Python.",
            path="plant",
        )
    if isinstance(plant, PolytopicSystem):
        raise SpecError(
            "A linear plant with constant matrices is needed, and this one has scheduling parameters. Give the plant "
            "at one of their points, plant.at({...}), or compare designs by obsynth.simulate.",
            path="plant",
        )
    if isinstance(plant, TimeVaryingDescriptorSystem):
        raise SpecError(
            "A linear plant with constant matrices is needed, and this one changes with k. obsynth check names the "
            "methods that take it, and obsynth simulate and evaluate show what each of them does.",
            path="plant",
        )
    require_kind(plant, DescriptorSystem, "plant", "an obsynth.DescriptorSystem")
    made = without_delays(plant)
    linear: DescriptorSystem = made.plant if isinstance(made, Transformation) else made
    return linear


def _approximated(plant: DescriptorSystem, order: int) -> Transformation:
    """Return a continuous plant with Pade approximations of its delays, each with ``order`` states."""
    names = (*plant.input_names, *plant.output_names)
    parts = [_pade(plant.delays[name], order) if name in plant.delays else None for name in names]
    for_inputs, for_outputs = _stacked(parts[: plant.nu]), _stacked(parts[plant.nu :])
    a_u, b_u, c_u, d_u = for_inputs
    a_y, b_y, c_y, d_y = for_outputs
    n, p, q = plant.nx, len(a_u), len(a_y)
    # Readings before the delay, by [x, p, u]; signals of outputs only that are late alike are counted at the reading.
    read = np.hstack([plant.C, plant.D @ c_u]), plant.D @ d_u
    A = np.block(
        [
            [plant.A, plant.B @ c_u, np.zeros((n, q))],
            [np.zeros((p, n)), a_u, np.zeros((p, q))],
            [b_y @ read[0], a_y],
        ]
    )
    changes: dict[str, Any] = {
        "E": scipy.linalg.block_diag(plant.E, np.eye(p + q)),
        "A": A,
        "B": np.vstack([plant.B @ d_u, b_u, b_y @ read[1]]),
        "C": np.hstack([d_y @ read[0], c_y]),
        "D": d_y @ read[1],
    }
    for dynamic, direct in (("Bf", "Df"), ("Bd", "Dd"), ("Bw", "Dw")):
        inner, outer = getattr(plant, dynamic), getattr(plant, direct)
        at_once = counted_at_reading(plant, np.vstack([inner, outer]))
        if dynamic == "Bw":
            # Noise of a reading is white: it is not delayed, and a filter would colour it.
            at_once = np.ones_like(at_once)
        entering = np.where(at_once, 0.0, outer)
        changes[dynamic] = np.vstack([inner, np.zeros((p, inner.shape[1])), b_y @ entering])
        changes[direct] = np.where(at_once, outer, d_y @ outer)
    names = (*plant.state_names, *_state_names(plant, order))
    made = with_states(plant, names, delays=None, **changes)
    if plant.uncertainty is not None:
        made = made.replace(uncertainty=plant.uncertainty.left_behind("delays became states"))
    recovery = unchanged_states(plant, made, from_state=np.eye(n, n + p + q))
    good = good_up_to(order) / max(plant.delays.values())
    note = (
        f"The delays ({delays_in_words(plant.delays)}) are Pade approximations of order {order}, within "
        f"{100 * PADE_SHARE:g} % up to {good:.3g} rad/s: every claim is for that model, not for the delays."
    )
    return Transformation(plant, made, f"Pade approximations of order {order} of the delays", recovery, notes=(note,))


def _pade(delay: float, order: int) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return a realisation of the Pade approximation of a delay, with poles in its own unit of time."""
    import control

    a, b, c, d = scipy.signal.tf2ss(*control.pade(1.0, order))
    return a / delay, b / delay, c, d


def _stacked(parts: Sequence[tuple[FloatArray, ...] | None]) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return one system of all signals, of which those without a part pass at once."""
    size = sum(0 if part is None else len(part[0]) for part in parts)
    count = len(parts)
    a, b = np.zeros((size, size)), np.zeros((size, count))
    c, d = np.zeros((count, size)), np.eye(count)
    place = 0
    for i, part in enumerate(parts):
        if part is not None:
            rows = slice(place, place + len(part[0]))
            a[rows, rows], b[rows, i], c[i, rows], d[i, i] = part[0], part[1][:, 0], part[2][0], part[3].item()
            place = rows.stop
    return a, b, c, d


def _state_names(plant: DescriptorSystem, order: int) -> list[str]:
    return [
        f"delay of {name}, {i + 1}"
        for name in (*plant.input_names, *plant.output_names)
        if name in plant.delays
        for i in range(order)
    ]


def good_up_to(order: int) -> float:
    """Return the angle, in rad, up to which ``exp(-j w)`` and its approximation differ by at most `PADE_SHARE`.

    Both have modulus one, so that only the phase differs, and more and more so.
    """
    import control

    numerator, denominator = control.pade(1.0, order)

    def missed(angle: float) -> float:
        at = 1j * angle
        return float(abs(np.polyval(numerator, at) / np.polyval(denominator, at) - np.exp(-at))) - PADE_SHARE

    high = FIRST_ANGLE
    while missed(high) < 0.0:
        high *= ANGLE_RATIO
    low = high / ANGLE_RATIO
    return float(scipy.optimize.brentq(missed, low, high)) if missed(low) < 0.0 else high

"""Three answers: no (exact, on the numbers as written), yes with its distance from another answer, and unclear.

It is unclear where that distance is no more than what rounding of the data or of any gains can bridge.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from obsynth.analysis.conditions import Condition
from obsynth.analysis.existence.distance import (
    ROUNDING_LEVEL,
    Distance,
    distance_to_loss,
    relative_singular_value,
    zeros_at_rounding_level,
)
from obsynth.analysis.existence.named_pencils import named_pencil, unclear
from obsynth.analysis.existence.numbers import numbers_of
from obsynth.analysis.existence.rational import SystemFacts
from obsynth.analysis.existence.witnesses import Unclear
from obsynth.analysis.plant_units import PlantUnits
from obsynth.analysis.zeros import are_outside, is_outside, system_zeros
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.pencils import finite_zeros
from obsynth.numerics.ranks import NAMED_SHARE, RANK_TOLERANCE, RankDecision
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.proofs.balls import UNIT_ROUNDOFF


def settled_rank(decision: RankDecision, exact_rank: int | None, share: float = np.inf) -> RankDecision:
    """Return a rank decision with the exact rank in place of that by a tolerance, or unclear.
    ``share``: the least singular value beside the terms that the entries are sums of, where those are known."""
    if exact_rank is None:
        return decision
    if exact_rank < decision.expected:
        return replace(decision, rank=exact_rank, means="exact")
    values = decision.singular_values
    needed = decision.expected - 1
    enough = decision.expected == 0 or (
        len(values) > needed and values[needed] > ROUNDING_LEVEL * values[0] and share > ROUNDING_LEVEL
    )
    if enough:
        return replace(decision, rank=decision.expected, means="exact", share=share)
    return replace(decision, rank=min(decision.rank, decision.expected - 1), means="unclear", share=share)


#: What decides what rounding of the data leaves open.
DECIDER = "Data with more digits, or an output in which this shows more, would decide it."
#: Computed data hold more than one rounding: below this distance a zero of theirs is one.
COMPUTED = 1e-12
#: Rounding scatters a multiple zero by up to this, relative to its size or one.
SCATTER = 1e-2


@dataclass(frozen=True)
class ZeroVerdict:
    """What is known of the zeros of a pencil outside the region of stability."""

    answer: str  # no, yes or unclear
    facts: SystemFacts
    distance: Distance | None = None  # there unless the answer is no

    @property
    def means(self) -> str:
        """How it was decided, in words."""
        return (
            "exactly, on the numbers as written" if self.facts.exact else "to hundreds of digits of the sampled plant"
        )


def zero_verdict(
    facts: SystemFacts, E: FloatArray, A: FloatArray, *, nx: int, discrete: bool, sizes: FloatArray | None = None
) -> ZeroVerdict:
    """Return the answer for the pencil ``A - s E (m, n)`` of which the facts are known; ``sizes`` of the terms of A."""
    facts = believed(facts, E, A, nx=nx)
    if not facts.full or facts.outside:
        return ZeroVerdict("no", facts)
    distance = distance_to_loss(E, A, nx=nx, discrete=discrete, zeros=facts.zeros, sizes=sizes)
    lost = _lost_in_computing(facts, E, A, nx=nx, discrete=discrete)
    distance = min(distance, lost or distance, key=lambda found: found.value)
    return ZeroVerdict("unclear" if distance.value <= ROUNDING_LEVEL or lost else "yes", facts, distance)


def _lost_in_computing(facts: SystemFacts, E: FloatArray, A: FloatArray, *, nx: int, discrete: bool) -> Distance | None:
    """Return a zero on or outside the boundary that computed data have but for their rounding; ``None`` without one."""
    if not facts.computed:
        return None
    dt = 1.0 if discrete else 0.0
    values = [*facts.zeros, *map(complex, system_zeros(E, A, nx=nx).values)]
    found = [Distance(relative_singular_value(E, A, value, nx=nx), value) for value in values if is_outside(value, dt)]
    best = min(found, key=lambda distance: distance.value, default=None)
    return best if best is not None and best.value <= COMPUTED else None


def believed(facts: SystemFacts, E: FloatArray, A: FloatArray, *, nx: int) -> SystemFacts:
    """Return the facts without zeros that rounding of computed data has brought in from infinity."""
    if not facts.computed or not facts.zeros:
        return facts
    found = system_zeros(E, A, nx=nx).values

    def near(value: complex) -> bool:
        return bool(np.any(np.abs(found - value) <= SCATTER * max(1.0, abs(value))))

    zeros, outside = (tuple(filter(near, values)) for values in (facts.zeros, facts.outside))
    return replace(facts, zeros=zeros, outside=outside)


def in_own_time(verdict: ZeroVerdict, rate: float) -> ZeroVerdict:
    """Return a verdict on a plant in scaled time with its point in the time of the plant."""
    found = verdict.distance
    return verdict if found is None else replace(verdict, distance=Distance(found.value, found.point / rate))


def described_distance(verdict: ZeroVerdict) -> str:
    """Return the least singular value and where it is, for a condition that holds or is unclear."""
    found = verdict.distance
    if found is None:
        return ""
    where = f"{found.point.real:.4g}" if found.point.imag == 0.0 else f"{found.point:.4g}"
    return f"least singular value {found.value:.2g} of the scaled pencil outside (near {where}), {verdict.means}"


def unclear_detail(verdict: ZeroVerdict, what: str) -> str:
    """Return what cannot be told apart."""
    size = 0.0 if verdict.distance is None else verdict.distance.value
    return (
        f"{what} exists for the numbers as written ({verdict.means}), but the least singular value of the scaled "
        f"pencil outside is {size:.1g}: rounding of the data, or of any gains, is as large."
    )


def verdict_condition(
    verdict: ZeroVerdict,
    holding: Condition,
    plant: DescriptorSystem,
    *,
    what: str,
    doubt: Callable[[], Unclear],
    lost: Callable[[Sequence[complex]], Condition],
    gain: Callable[[complex], str],
    seen: Callable[[], Sequence[complex]],
) -> Condition:
    """Return the condition of a verdict: as it holds; lost, with the gain that anything else would need; or in doubt.
    ``lost(zeros)`` says what hides there, ``seen()`` which zeros floating point has outside, ``what`` would exist."""
    if verdict.answer == "no":
        found = lost(verdict.facts.outside)
        return replace(found, detail=f"{found.detail} {gain(found.mode or 0j)}".rstrip())
    if verdict.answer == "yes":
        return replace(holding, detail=f"{holding.detail}; {described_distance(verdict)}")
    detail, zeros = unclear_detail(verdict, what), seen()
    found = replace(holding, holds=False, detail=detail)
    if zeros:
        found = lost(zeros)
        found = replace(found, detail=f"{detail} In floating point, {found.detail}")
    return found.in_doubt(doubt(), plant)


def zero_doubt(
    plant: DescriptorSystem,
    units: PlantUnits,
    verdict: ZeroVerdict,
    layout: Sequence[Sequence[str | None]],
    *,
    kept: Mapping[str, Sequence[int]] | None = None,
    what: str,
) -> Unclear:
    """Return why it is unclear whether a pencil has a zero outside, with the point in the time of the plant."""
    found = verdict.distance
    point = 0j if found is None else found.point
    where = f"{point.real:.6g}" if point.imag == 0.0 else f"{point:.6g}"
    tolerance = ROUNDING_LEVEL if found is None else max(ROUNDING_LEVEL, found.value)
    return unclear(
        plant,
        named_pencil(plant, units, layout, kept=kept),
        tolerance=tolerance,
        point=point,
        dt=plant.dt,
        other=f"has a zero at {where}, and no {what}",
        decider=DECIDER,
    )


def needed_gain(plant: DescriptorSystem, units: PlantUnits, point: complex, *, inputs: str = "") -> str:
    """Return which gain any observer would need, were the last digits of data off that hide something only exactly.
    Empty where no digits would help: with as many inputs as outputs (``inputs``: Bf, Bd or none) a zero stays."""
    entering = getattr(plant, inputs) if inputs else np.zeros((plant.nx, 0))
    direct = getattr(plant, f"D{inputs[1:]}") if inputs else np.zeros((plant.ny, 0))
    if plant.ny <= entering.shape[1]:
        return ""
    columns = np.concatenate([units.states, getattr(units, {"Bf": "faults", "Bd": "disturbances"}.get(inputs, ""), [])])
    rows = np.concatenate([units.equations, units.outputs])[:, None]
    pencil = np.block([[plant.A - point * plant.E, entering], [plant.C, direct]])
    scaled = np.linalg.svd(rows * pencil * columns)[2][-1].conj()
    scaled = np.where(np.abs(scaled) > RANK_TOLERANCE, scaled, 0.0)
    signals = np.abs(columns * scaled)
    terms = np.max(np.abs(np.hstack([plant.C, direct])) * signals, axis=1, initial=0.0)
    names = (*plant.state_names, *({"Bf": plant.fault_names, "Bd": plant.disturbance_names}.get(inputs, ())))
    # What a fault moves is asked for by the fault; a mode by the state that moves most.
    faults = np.arange(len(signals)) >= plant.nx if inputs == "Bf" else np.zeros(len(signals), dtype=bool)
    shares = np.abs(scaled) * (faults if np.any(np.abs(scaled[faults]) > NAMED_SHARE) else ~faults)
    wanted, shown = int(np.argmax(shares)), int(np.argmax(terms))
    if terms[shown] == 0.0:
        return "No output holds anything of it: no digits of the data would show it."
    gain = signals[wanted] / (UNIT_ROUNDOFF * terms[shown])
    return (
        "This holds exactly, on the numbers as written: were their last digits off, any observer would need a gain of "
        f"about {gain:.0e} from {plant.output_names[shown]!r} to {names[wanted]!r}."
    )


def rank_doubt(
    plant: DescriptorSystem,
    units: PlantUnits,
    decision: RankDecision,
    layout: Sequence[Sequence[str | None]],
    *,
    rows: bool = False,
    kept: Mapping[str, Sequence[int]] | None = None,
) -> Unclear:
    """Return why it is unclear whether a block matrix has full column rank (row rank with ``rows``)."""
    named = named_pencil(plant, units, layout, kept=kept)
    return unclear(
        plant,
        named.transposed if rows else named,
        tolerance=ROUNDING_LEVEL,
        other=f"has rank {decision.expected - 1}",
        decider=DECIDER,
    )


@dataclass(frozen=True, eq=False)
class HiddenModes:
    """Unobservable modes, the undetectable ones of them, the normal rank of ``[A - z E; C]``, and ranks on the way."""

    modes: tuple[complex, ...]
    undetectable: tuple[complex, ...]
    normal_rank: int
    decisions: tuple[RankDecision, ...]


def hidden_modes(plant: DescriptorSystem) -> HiddenModes:
    """Return the modes that no output shows, decided exactly where the plant is small enough."""
    plant = plant.dense()
    tall_e, tall_a = np.vstack([plant.E, np.zeros_like(plant.C)]), np.vstack([plant.A, plant.C])
    hidden = finite_zeros(tall_e, tall_a)
    found = [complex(value) for value in hidden.values]
    outside = are_outside(tall_e, tall_a, hidden, plant.dt)
    numbers = numbers_of(plant)
    if numbers is None:
        undetectable = tuple(value for value, out in zip(found, outside, strict=True) if out)
        return HiddenModes(tuple(found), undetectable, hidden.normal_rank, hidden.decisions)
    exact = numbers.system(numbers.zeros(plant.nx, 0), numbers.zeros(plant.ny, 0))
    exact = believed(exact, tall_e, tall_a, nx=plant.nx)
    scaled = PlantUnits.of(plant).rounded().scaled_pencil(tall_e, tall_a)
    unclear_ones = zeros_at_rounding_level(*scaled, found, exact.zeros, nx=plant.nx)
    unstable = {value for value, out in zip(found, outside, strict=True) if out}
    modes = tuple(sorted((*exact.zeros, *unclear_ones), key=lambda value: (value.real, value.imag)))
    undetectable = (*exact.outside, *(value for value in unclear_ones if value in unstable))
    return HiddenModes(modes, undetectable, exact.normal_rank, ())

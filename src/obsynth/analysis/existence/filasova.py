"""Existence conditions of a PD observer.  Source: Filasova, Krokavec, Serbak, section 2.

Theorem 1 has a solution, for every delta > 0, exactly when the plant with its faults as states is detectable: (A, C)
is, and at s = 0 rank condition (3) holds.  Observability of (A, C), which the paper supposes, is more than needed.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from obsynth.analysis.existence.condition import Condition, up_to_failure
from obsynth.analysis.existence.plant_numbers import SystemFacts
from obsynth.analysis.existence.statements import Evaluator, FullRank, NoZeroOutside, reconsidered
from obsynth.errors import counted
from obsynth.numerics.arrays import FloatArray, remembered
from obsynth.numerics.invariant_zeros import equilibrated_at
from obsynth.numerics.ranks import equilibrate
from obsynth.numerics.spectra import pole_text
from obsynth.numerics.suggestions import quoted_names
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.pencil import structure_of
from obsynth.plants.signal_names import MOST_NAMES, leading_names
from obsynth.plants.transformations.elimination import eliminate_algebraic_states
from obsynth.plants.transformations.index_reduction import improper_outputs
from obsynth.plants.transformations.recovery import Transformation
from obsynth.proofs.exact_doubles import holds_computed
from obsynth.proofs.exact_pencils import ExactPencil

_SOURCE = "Filasova et al., eqs. (1), (2)"

_CLAIM = "every mode that does not decay is observable ((A, C) detectable)"

_NEEDED_FOR = "necessary and sufficient with (3); Filasova et al. suppose observability"


@remembered
def pd_observer_conditions(plant: DescriptorSystem, *, exactly: bool = True) -> tuple[Condition, ...]:
    """Return the existence conditions of the PD observer, in order; the list ends at the first failure."""
    plant = plant.dense()
    first = up_to_failure(_form_conditions(Evaluator(plant, exactly)))
    if not all(condition.holds for condition in first):
        return first
    form = explicit_form(plant)
    explicit = Evaluator(plant if form is None else form.plant, exactly)
    return (*first, *reconsidered(explicit, lambda judge: up_to_failure(_explicit_conditions(judge)), tuple))


def explicit_form(plant: DescriptorSystem) -> Transformation | None:
    """Return the elimination of the algebraic states; ``None`` for a plant with ``E = I``."""
    return None if np.array_equal(plant.E, np.eye(plant.nx)) else eliminate_algebraic_states(plant)


def _form_conditions(judge: Evaluator) -> Iterator[Condition]:
    """Yield the conditions on the plant as given; each may rely on those before it."""
    plant = judge.plant
    yield _condition(
        "continuous time",
        "a continuous-time plant (dt = 0)",
        not plant.is_discrete,
        plant.dt,
        0.0,
        _SOURCE,
        f"a plant sampled every {plant.dt:g} s. Give the continuous one (no sample_time in its transform): the "
        "observer is sampled afterwards, by obsynth.sample_observer.",
        of_the_method=True,
    )
    yield _condition(
        "faults",
        "at least one fault",
        plant.nf > 0,
        float(plant.nf),
        1.0,
        _SOURCE,
        "none. Name the fault to estimate in Bf or Df.",
        of_the_method=True,
    )
    (normal_rank, index, dynamic), floating = _pencil_facts(judge)
    yield _condition(
        "regularity",
        "a regular pencil (det(A - sE) not identically zero)",
        normal_rank == plant.nx,
        float(normal_rank),
        float(plant.nx),
        "definition of a descriptor plant",
        f"normal rank {normal_rank} of {plant.nx}: the equations do not determine the states. Add what is missing.",
        unclear=floating,
    )
    yield _condition(
        "index",
        "index 0 or 1: the algebraic states can be eliminated",
        index <= 1,
        float(index),
        1.0,
        "ours: elimination of algebraic states",
        f"index {index}: {_differentiated(plant) if index > 1 else ''}",
        unclear=floating,
        of_the_method=True,
    )
    yield _condition(
        "dynamic states",
        "at least one dynamic state",
        dynamic > 0,
        float(dynamic),
        1.0,
        "ours: elimination of algebraic states",
        "none: every state is algebraic. Solve the equations directly.",
        unclear=floating,
    )


def _differentiated(plant: DescriptorSystem) -> str:
    """Return which signals a constraint of a plant of index 2 or more makes outputs differentiate, and what to do."""
    outputs, signals = improper_outputs(plant)
    if not outputs:
        return (
            "the algebraic equations cannot be solved for the algebraic states without differentiating. Do that first."
        )
    names, many = quoted_names(signals), len(outputs) > 1
    needed = (
        f"the output{'s' if many else ''} {quoted_names(outputs)} need{'' if many else 's'} the derivative of {names}"
    )
    if set(signals) <= set(plant.noise_names):
        return f"{needed}, white noise in a constraint. Leave that noise out of Bw."
    return f"{needed}, as a constraint ties them to it."


def _pencil_facts(judge: Evaluator) -> tuple[tuple[int, int, int], bool]:
    """Return normal rank, index (0 for a plant that is not regular) and the number of dynamic states, and whether
    floating-point ranks tell so: such a no is none."""
    plant, numbers = judge.plant, judge.numbers
    if numbers is None or not numbers.exact or holds_computed(plant.E):
        pencil = structure_of(plant)
        return (pencil.normal_rank, pencil.index or 0, len(pencil.finite_eigenvalues)), True
    index = ExactPencil(numbers.matrices["E"], numbers.matrices["A"]).index
    dynamic = numbers.rank(numbers.matrices["E"])
    return (plant.nx if index is not None else numbers.regular_rank, index or 0, dynamic), False


def _explicit_conditions(judge: Evaluator) -> Iterator[Condition]:
    """Yield the conditions on the plant without its algebraic states."""
    plant, source = judge.plant, "Filasova et al., eq. (3)"
    yield _condition(
        "nf <= ny",
        "no more faults than outputs (nf <= ny)",
        plant.nf <= plant.ny,
        float(plant.nf),
        float(plant.ny),
        source,
        f"{counted(plant.nf, 'fault')} and {counted(plant.ny, 'output')}. Measure more, or leave a fault out.",
        signals=plant.fault_names,
    )

    def alike(columns: FloatArray) -> tuple[str, tuple[str, ...]]:
        text = "some faults act nowhere, or in the same direction as others, and cannot be distinguished."
        return text, _null_names(columns, plant.fault_names)

    def hidden(rosenbrock: FloatArray) -> tuple[str, tuple[str, ...]]:
        names = leading_names(
            np.linalg.svd(equilibrate(rosenbrock))[2][-1, plant.nx :], plant.fault_names, most=MOST_NAMES
        )
        text = (
            f"there is a zero at s = 0, where a constant fault {', '.join(map(repr, names))} has no effect on the "
            "outputs in steady state. Measure another signal."
        )
        return text, names

    yield judge.full_rank("rank F", FullRank([["Bf"], ["Df"]]), alike, source=source)
    yield judge.no_zero_outside(
        NoZeroOutside(), holding=_detectable, lost=lambda facts: _hidden_mode(plant, facts.outside), what="observer"
    )
    at_zero = judge.full_rank("rank [A F; C Df]", NoZeroOutside("Bf").at_zero, hidden, source=source)
    yield at_zero if at_zero.holds else replace(at_zero, mode=0j)


def _condition(
    name: str,
    claim: str,
    holds: bool,
    value: float,
    bound: float,
    source: str,
    failure: str,
    *,
    signals: tuple[str, ...] = (),
    unclear: bool = False,
    of_the_method: bool = False,
) -> Condition:
    return Condition(
        name,
        claim,
        holds,
        value,
        bound,
        source,
        "" if holds else failure,
        signals=() if holds else signals,
        unclear=True if unclear and not holds else None,
        of_the_method=of_the_method,
    )


def _detectable(facts: SystemFacts) -> Condition:
    modes = facts.zeros
    slowest = f", slowest real part {max(mode.real for mode in modes):.6g}" if modes else ""
    detail = f"{counted(len(modes), 'unobservable mode')}{slowest}"
    return Condition("detectability", _CLAIM, True, 0.0, 0.0, _NEEDED_FOR, detail)


def _hidden_mode(plant: DescriptorSystem, hidden: Sequence[complex]) -> Condition:
    mode = max(hidden, key=lambda value: value.real)
    still = np.vstack([plant.E, np.zeros_like(plant.C)])
    pencil = equilibrated_at(still, np.vstack([plant.A, plant.C]), mode, nx=plant.nx)
    point = mode if mode.imag else mode.real
    # The direction that [A - s I; C] shows least at the mode.
    direction = np.abs(pencil.columns * np.linalg.svd(pencil.A - point * pencil.E)[2][-1])
    signals = leading_names(direction, plant.state_names, most=MOST_NAMES)
    value = pole_text(mode, 6)
    detail = (
        f"the mode s = {value} (states {', '.join(map(repr, signals))}) is undetectable: no output responds to it, "
        "and it does not decay. Measure something that it moves."
    )
    return Condition(
        "detectability", _CLAIM, False, float(len(hidden)), 0.0, _NEEDED_FOR, detail, mode=mode, signals=signals
    )


def _null_names(matrix: FloatArray, names: tuple[str, ...]) -> tuple[str, ...]:
    lengths = np.linalg.norm(matrix, axis=0)
    if np.any(lengths == 0.0):
        return tuple(name for name, length in zip(names, lengths, strict=True) if length == 0.0)
    return leading_names(np.linalg.svd(equilibrate(matrix))[2][-1], names, most=MOST_NAMES)

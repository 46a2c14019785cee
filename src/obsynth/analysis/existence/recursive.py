"""Existence conditions of recursive methods: rank of H_k, detectability, identifiable parameters.

Of a plant whose matrices are constant this is decided on the numbers as written; of others in floating point along the
horizon, as the rows say.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from obsynth.analysis.existence.condition import Condition, rank_condition
from obsynth.analysis.existence.identifiability import constant_plant, identifiability_condition
from obsynth.analysis.existence.plant_numbers import SystemFacts
from obsynth.analysis.existence.statements import Evaluator, FullRank, NoZeroOutside
from obsynth.analysis.time_varying import HorizonRanks, as_time_varying, early_rows, horizon_ranks, step_blocks
from obsynth.errors import SpecError, counted
from obsynth.numerics.arrays import FloatArray, remembered
from obsynth.numerics.invariant_zeros import are_outside
from obsynth.numerics.pencils import finite_zeros
from obsynth.numerics.ranks import RANK_TOLERANCE, numerical_rank, real_but_rounding
from obsynth.numerics.scaling import equilibrate_pencil
from obsynth.numerics.spectra import pole_text
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.signal_names import leading_names
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem

SOURCE = "Moussa Ali, Zhang 2013"

_DETECTABLE = "Nikoukhah, Willsky, Levy 1992"


def recursive_conditions(
    plant: DescriptorSystem | TimeVaryingDescriptorSystem,
    *,
    parameters: bool,
    literal: bool = False,
    early: bool = False,
) -> Iterator[Condition]:
    """Yield the existence conditions of the recursive methods; the list ends at the first failure."""
    try:
        varying = as_time_varying(plant)
    except SpecError as error:
        yield Condition(
            "plant of this kind",
            "discrete time, no unknown disturbance",
            False,
            0.0,
            1.0,
            f"{SOURCE}, eq. (4)",
            str(error),
            of_the_method=True,
        )
        return
    ranks = horizon_ranks(varying, early=early)
    constant = constant_plant(plant, varying)
    known = _rank_of_steps(varying, ranks, early=early, constant=constant)
    yield known
    if not known.holds:
        return
    if varying.E.is_constant and varying.A.is_constant and varying.C.is_constant:
        detectable = detectability_condition(varying) if constant is None else _decided_detectability(constant)
        yield detectable
        if not detectable.holds:
            return
    if not parameters:
        return
    yield Condition(
        "parameters",
        "the plant has parameters (Phi or Psi)",
        varying.nq > 0,
        float(varying.nq),
        1.0,
        f"{SOURCE}, eq. (4)",
        f"{counted(varying.nq, 'parameter')}",
        of_the_method=True,
    )
    if not varying.nq:
        return
    yield identifiability_condition(varying, early=early, constant=constant)
    if literal:
        yield residual_condition(ranks)


def _rank_of_steps(
    plant: TimeVaryingDescriptorSystem, ranks: HorizonRanks, *, early: bool, constant: Evaluator | None
) -> Condition:
    """Return the condition that equations and outputs determine the state at every step."""
    name = "rank [E; C; algebraic rows of A]" if early else "rank [E; C]"
    late = early_rows(plant, early=early)
    statement = FullRank([["E"], ["C"], ["A"]], last_rows=late.tolist()) if late.size else FullRank([["E"], ["C"]])
    worst = ranks.worst if constant is None else constant.rank(statement, ranks.worst)
    condition = rank_condition(name, worst, "", source=f"{SOURCE}, A2")
    if constant is None and ranks.steps > 1:
        condition = replace(condition, detail=f"{condition.detail}, in floating point along the horizon")
    where = "for every k" if ranks.steps == 1 else f"for k = 1 ... {ranks.steps}, worst at k = {ranks.worst_k}"
    condition = replace(condition, claim=f"{condition.claim} {where}")
    if condition.holds:
        return condition
    k = ranks.worst_k - 1
    blocks = step_blocks(plant, k, late)
    H = np.vstack([blocks.E, blocks.C])
    names = _open_states(np.zeros_like(H), H, 0.0, plant)
    remedies = ["measure something that they act on"]
    if not early:
        algebraic = early_rows(plant, early=True).size
        if algebraic and horizon_ranks(plant, early=True).worst.full:
            remedies.append("use the algebraic equations one step earlier (early_constraints: true)")
        if algebraic:
            remedies.append(
                "eliminate the algebraic states (transform: {eliminate_algebraic_states: true} in "
                "continuous time, before sampling)"
            )
    remedies.append("leave out states that nothing depends on")
    at = "" if ranks.steps == 1 else f"at k = {ranks.worst_k} "
    detail = f"{worst.describe()}: {at}equations and outputs do not determine {_listed(names)}. {_sentence(remedies)}"
    failure = replace(condition, detail=detail, signals=names)
    if constant is None or worst.means != "unclear":
        return failure
    return failure.in_doubt(constant.rank_doubt(statement, worst), constant.plant)


@remembered
def detectability_condition(plant: TimeVaryingDescriptorSystem) -> Condition:
    """Return the condition that every mode that does not decay by itself shows in the outputs."""
    E, A, C = plant.E.at(1), plant.A.at(0), plant.C.at(1)
    tall_e, tall_a = np.vstack([E, np.zeros_like(C)]), np.vstack([A, C])
    zeros = finite_zeros(tall_e, tall_a)
    outside = are_outside(tall_e, tall_a, zeros, plant.dt)
    hidden = [complex(z) for z, out in zip(zeros.values, outside, strict=True) if out]
    if hidden:
        return _hidden_modes(plant, tall_e, tall_a, hidden)
    return Condition(
        "detectability", _detectable(plant), True, 0.0, 0.0, _DETECTABLE, _decaying_modes(len(zeros.values))
    )


def _decided_detectability(judge: Evaluator) -> Condition:
    """Return the same, decided on the numbers of the plant as written."""
    plant = judge.plant
    tall_e, tall_a = judge.pencil(NoZeroOutside())

    def holding(facts: SystemFacts) -> Condition:
        return Condition(
            "detectability", _detectable(plant), True, 0.0, 0.0, _DETECTABLE, _decaying_modes(len(facts.zeros))
        )

    def lost(facts: SystemFacts) -> Condition:
        return _hidden_modes(plant, tall_e, tall_a, facts.outside or [1 + 0j])

    return judge.no_zero_outside(NoZeroOutside(), holding=holding, lost=lost, what="filter")


def _detectable(plant: TimeVaryingDescriptorSystem | DescriptorSystem) -> str:
    return f"rank [A - zE; C] = {plant.nx} for all |z| >= 1"


def _decaying_modes(count: int) -> str:
    return f"{counted(count, 'unobservable mode')}, decaying" if count else "observable"


def _hidden_modes(
    plant: TimeVaryingDescriptorSystem | DescriptorSystem,
    tall_e: FloatArray,
    tall_a: FloatArray,
    modes: Sequence[complex],
) -> Condition:
    hidden = sorted(modes, key=lambda z: (-abs(z), -z.imag))
    mode = hidden[0]
    names = _open_states(tall_e, tall_a, mode, plant)
    other_modes = [described_mode(z) for z in hidden[1:] if z.imag >= 0.0 and z != mode]
    detail = (
        f"the mode z = {described_mode(mode)} of {_listed(names)} is unobservable"
        + (f" (as the modes {', '.join(other_modes)})" if other_modes else "")
        + f", so that an error in it {'grows' if abs(mode) > 1.0 + RANK_TOLERANCE else 'stays'} for ever. Measure "
        "something that it moves, or leave it out of the model."
    )
    return Condition(
        "detectability", _detectable(plant), False, float(len(hidden)), 0.0, _DETECTABLE, detail, mode, names
    )


def residual_condition(ranks: HorizonRanks) -> Condition:
    """Return the condition that (18) can learn at all, which the paper never states."""
    return Condition(
        "residual directions",
        "rank E_k + ny - nx >= 1 for every k",
        ranks.directions >= 1,
        float(ranks.directions),
        1.0,
        "our finding: missing in Moussa Ali, Zhang 2013",
        f"at k = {ranks.directions_k} (18) uses only rank E + ny - nx = {ranks.directions} residual directions"
        + (
            ""
            if ranks.directions >= 1
            else ": y - C xhat is zero whatever the parameters are, so the parameters are never corrected. Use form "
            "'innovation', which uses all parity directions."
        ),
        of_the_method=True,
    )


def _open_states(
    E: FloatArray, A: FloatArray, point: complex, plant: TimeVaryingDescriptorSystem | DescriptorSystem
) -> tuple[str, ...]:
    """Return the states in the null space of ``A - point E``, by their shares when the pencil is equilibrated."""
    pencil = equilibrate_pencil(E, A)
    _, values, right = np.linalg.svd(pencil.A - (point if point.imag else point.real) * pencil.E)
    kernel = right[min(numerical_rank(values), plant.nx - 1) :]
    return leading_names(np.linalg.norm(kernel, axis=0), plant.state_names)


def described_mode(value: complex) -> str:
    """Return an eigenvalue as a text, a pair as one."""
    return pole_text(complex(real_but_rounding(value), value.imag), 6, pair=True)


def _listed(names: Sequence[str]) -> str:
    return f"the state{'s' if len(names) > 1 else ''} {', '.join(map(repr, names))}"


def _sentence(remedies: Sequence[str]) -> str:
    first, *more = remedies
    return f"{first[0].upper()}{first[1:]}" + "".join(f", {text}" for text in more[:-1]) + f", or {more[-1]}."

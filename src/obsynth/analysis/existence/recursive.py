"""Whether a recursive method can work for a plant: rank of H_k, detectability, parameters that show.

Of a plant whose matrices are constant this is decided on the numbers as written; of others in floating point along the
horizon, as the rows say.

Whether constant parameters leave traces that can be distinguished; plants with constant matrices, decided as written:

up to 64 states in rational arithmetic (24 of a sampled plant, in enclosures); parameters stand where faults do.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np
from flint import fmpz_poly

from obsynth.analysis.existence.condition import Condition, rank_condition
from obsynth.analysis.existence.plant_numbers import SystemFacts
from obsynth.analysis.existence.statements import Evaluator, FullRank, NoZeroOutside, settled_rank
from obsynth.analysis.time_varying import (
    STEPS_WITHOUT_HORIZON,
    HorizonRanks,
    IntArray,
    StepBlocks,
    as_time_varying,
    early_rows,
    horizon_ranks,
    step_blocks,
)
from obsynth.errors import SpecError
from obsynth.numerics.arrays import FloatArray, remembered
from obsynth.numerics.invariant_zeros import are_outside
from obsynth.numerics.pencils import finite_zeros
from obsynth.numerics.ranks import (
    NAMED_SHARE,
    RANK_TOLERANCE,
    RankDecision,
    decide_rank,
    numerical_rank,
    real_but_rounding,
)
from obsynth.numerics.scaling import EquilibratedPencil, equilibrate_pencil
from obsynth.numerics.spectra import pole_text
from obsynth.numerics.square_root_estimation import OUTGROWN, least_squares_step, rank_revealing_step
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.signal_names import leading_names
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem

_NAME = "identifiable parameters"

_TRACES_SOURCE = "our finding: (26) needs it, Moussa Ali, Zhang 2013"


#: Constant parameters ``(nq,)`` that leave no trace, in their own units, their shares ``(nq,)``, free of units, and the
#: names of the states that hide them.
_Kernel: TypeAlias = tuple[FloatArray, FloatArray, tuple[str, ...]]


SOURCE = "Moussa Ali, Zhang 2013"


_DETECTABLE = "Nikoukhah, Willsky, Levy 1992"


def constant_plant(
    given: DescriptorSystem | TimeVaryingDescriptorSystem | object, varying: TimeVaryingDescriptorSystem
) -> Evaluator | None:
    """Return what decides about a plant, its parameters as faults; ``None`` where matrices change or are not square."""
    still = all(part.is_constant for part in (varying.E, varying.A, varying.C, varying.Phi, varying.Psi))
    if not still or varying.ne != varying.nx:
        return None
    if isinstance(given, DescriptorSystem):
        return Evaluator(given.dense())
    plant = DescriptorSystem(
        varying.E.at(1),
        varying.A.at(0),
        C=varying.C.at(1),
        Bf=varying.Phi.at(0),
        Df=varying.Psi.at(0),
        dt=varying.dt,
        state_names=varying.state_names,
        output_names=varying.output_names,
        fault_names=varying.parameter_names,
    )
    return Evaluator(plant)


def identifiability_condition(
    plant: TimeVaryingDescriptorSystem, *, early: bool = False, constant: Evaluator | None = None
) -> Condition:
    """Return the condition that outputs tell the parameters from each other and from the state."""
    still = all(matrix.is_constant for matrix in (plant.E, plant.A, plant.C, plant.Phi, plant.Psi))
    decision, (parameters, shares, states) = _steady(plant) if still else _along(plant, early=early)
    if still and constant is not None:
        settled, numbers = decision, constant.numbers
        if numbers is not None:
            traces = numbers.rank_at_root(numbers.matrices["Bf"], numbers.matrices["Df"], fmpz_poly([-1, 1]))
            settled = settled_rank(decision, traces)
        if settled.rank < decision.rank:
            # What leaves no trace exactly does so nearly in floating point.
            parameters, shares, states = _steady_kernel(plant, settled.rank)
        decision = settled
    wanted = "rank [A - E, Phi; C, Psi]" if still else "rank of the traces of all parameters"
    claim = f"{wanted} = {decision.expected}"
    value, bound = float(decision.rank), float(decision.expected)
    if decision.full:
        how = "" if still else ", in floating point along the horizon"
        return Condition(_NAME, claim, True, value, bound, _TRACES_SOURCE, f"{decision.describe()}{how}")
    names = leading_names(shares, plant.parameter_names)
    detail = f"{decision.describe()}: {_explained(parameters, states, names, plant)}"
    found = Condition(_NAME, claim, False, value, bound, _TRACES_SOURCE, detail, signals=names)
    if constant is None or decision.means != "unclear":
        return found
    doubt = constant.rank_doubt(NoZeroOutside("Bf").at_zero, decision, point=1 + 0j)
    return found.in_doubt(replace(doubt, parameters=True), constant.plant)


def _explained(
    parameters: FloatArray, states: tuple[str, ...], names: tuple[str, ...], plant: TimeVaryingDescriptorSystem
) -> str:
    hidden = ", ".join(map(repr, states))
    with_states = f" together with constant shifts of {hidden}" if hidden else ""
    if len(names) == 1:
        effect = (
            f"cannot be distinguished from constant shifts of {hidden}" if hidden else "has no effect on the outputs"
        )
        text = f"the parameter {names[0]!r} {effect}"
    else:
        values = [parameters[plant.parameter_names.index(name)] for name in names]
        size = values[int(np.argmax(np.abs(values)))]
        ratio = " : ".join(f"{value / size:.4g}" for value in values)
        text = (
            f"the parameters {', '.join(map(repr, names))} cannot be distinguished from each other: in the ratio "
            f"{ratio}"
            f"{with_states} they have no effect on the outputs"
        )
    return f"{text}. Estimate fewer parameters, or measure something that they act on."


@remembered
def _steady(plant: TimeVaryingDescriptorSystem) -> tuple[RankDecision, _Kernel]:
    """Decide about a time-invariant plant by its state and parameters at rest."""
    decision = decide_rank(_at_rest(plant).A, expected=plant.nx + plant.nq, equilibrated=False)
    return decision, _steady_kernel(plant, decision.rank)


def _at_rest(plant: TimeVaryingDescriptorSystem) -> EquilibratedPencil:
    whole = np.block([[plant.A.at(0) - plant.E.at(1), plant.Phi.at(0)], [plant.C.at(1), plant.Psi.at(0)]])
    return equilibrate_pencil(np.zeros_like(whole), whole)


def _steady_kernel(plant: TimeVaryingDescriptorSystem, rank: int) -> _Kernel:
    """Return what leaves no trace at rest, where the rank is less than full."""
    pencil = _at_rest(plant)
    shares = np.linalg.svd(pencil.A)[2][rank:]
    states, parameters = np.linalg.norm(shares[:, : plant.nx], axis=0), shares[:, plant.nx :]
    largest = max(float(np.max(states, initial=0.0)), float(np.max(np.abs(parameters), initial=0.0)))
    involved = leading_names(states, plant.state_names) if states.max(initial=0.0) > NAMED_SHARE * largest else ()
    return _kernel_of(parameters, pencil.columns[plant.nx :], involved)


@remembered
def _along(plant: TimeVaryingDescriptorSystem, *, early: bool) -> tuple[RankDecision, _Kernel]:
    """Decide along the horizon, by the whitened traces of the parameters for noise of unit size everywhere."""
    late = early_rows(plant, early=early)
    steps = plant.horizon or STEPS_WITHOUT_HORIZON
    steps = max(steps - 1, 1) if late.size else steps
    largest = _largest(plant, steps, late)
    ne = len(largest.E)
    pencil = equilibrate_pencil(np.vstack([largest.E, np.zeros_like(largest.C)]), np.vstack([largest.A, largest.C]))
    rows, columns = pencil.rows[:, None], pencil.columns
    direct = np.linalg.norm(rows * np.vstack([largest.Phi, largest.Psi]), axis=0)
    direct[direct == 0.0] = 1.0
    nx, nq = plant.nx, plant.nq
    factor, regressor, gathered, sizes = np.eye(nx), np.zeros((nx, nq)), np.zeros((0, nq)), np.zeros(nq)
    for k in range(steps):
        blocks = step_blocks(plant, k, late)
        H, A = rows * np.vstack([blocks.E, blocks.C]) * columns, rows[:ne] * blocks.A * columns
        Phi, Psi = rows[:ne] * blocks.Phi, rows[ne:] * blocks.Psi
        noise = np.hstack([np.zeros((len(H), nx)), np.eye(len(H))])
        noise[:ne, :nx] = A @ factor
        right = np.vstack([A @ regressor + Phi, -Psi])
        found = least_squares_step(H, noise, right) or rank_revealing_step(H, noise, right, np.zeros((len(H), 0)))
        regressor, factor = found.estimate, found.factor
        if not max(np.max(np.abs(regressor)), np.max(np.abs(factor))) < OUTGROWN:
            # What is unobservable grows without bound: what has been seen until here decides.
            break
        here = np.linalg.norm(right, axis=0)
        # A regressor that grows in an unobservable state must not hide what was measured before.
        weight = 1.0 / max(1.0, float(np.max(here / direct)))
        gathered = np.asarray(np.linalg.qr(np.vstack([gathered, weight * found.innovation]), mode="r"))
        sizes = np.hypot(sizes, weight * here)
    sizes[sizes == 0.0] = 1.0
    # Relative to the terms that a trace is made of: rounding of a trace that vanishes is no trace.
    relative = np.vstack([gathered, np.zeros((nq, nq))]) / sizes
    decision = decide_rank(relative, expected=nq, scale=1.0, equilibrated=False)
    parameters = np.linalg.svd(relative)[2][decision.rank :]
    return decision, _kernel_of(parameters, 1.0 / sizes, ())


def _kernel_of(parameters: FloatArray, columns: FloatArray, states: tuple[str, ...]) -> _Kernel:
    """Return a kernel whose rows are given in scaled coordinates; the row with most parameters stands for its ratio."""
    if not len(parameters):
        return np.zeros(len(columns)), np.zeros(len(columns)), states
    strongest = parameters[int(np.argmax(np.linalg.norm(parameters, axis=1)))]
    return strongest * columns, np.linalg.norm(parameters, axis=0), states


def _largest(plant: TimeVaryingDescriptorSystem, steps: int, late: IntArray) -> StepBlocks:
    """Return the largest absolute value of each entry along the horizon: it tells what rows and states are like."""
    found = [np.abs(matrix) for matrix in step_blocks(plant, 0, late)]
    for k in range(1, steps):
        for matrix, here in zip(found, step_blocks(plant, k, late), strict=True):
            np.maximum(matrix, np.abs(here), out=matrix)
    return StepBlocks(*found)


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
            "discrete time, no feedthrough, no unknown disturbance",
            False,
            0.0,
            1.0,
            f"{SOURCE}, eq. (4)",
            str(error),
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
        f"{varying.nq} parameter(s)",
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
    said = FullRank([["E"], ["C"], ["A"]], last_rows=late.tolist()) if late.size else FullRank([["E"], ["C"]])
    worst = ranks.worst if constant is None else constant.rank(said, ranks.worst)
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
    found = replace(condition, detail=detail, signals=names)
    if constant is None or worst.means != "unclear":
        return found
    return found.in_doubt(constant.rank_doubt(said, worst), constant.plant)


def detectability_condition(plant: TimeVaryingDescriptorSystem) -> Condition:
    """Return the condition that every mode that does not decay by itself shows in the outputs."""
    E, A, C = plant.E.at(1), plant.A.at(0), plant.C.at(1)
    tall_e, tall_a = np.vstack([E, np.zeros_like(C)]), np.vstack([A, C])
    zeros = finite_zeros(tall_e, tall_a)
    outside = are_outside(tall_e, tall_a, zeros, plant.dt)
    hidden = [complex(z) for z, out in zip(zeros.values, outside, strict=True) if out]
    if hidden:
        return _hidden_modes(plant, tall_e, tall_a, hidden)
    return Condition("detectability", _detectable(plant), True, 0.0, 0.0, _DETECTABLE, _dying(len(zeros.values)))


def _decided_detectability(judge: Evaluator) -> Condition:
    """Return the same, decided on the numbers of the plant as written."""
    plant = judge.plant
    tall_e, tall_a = judge.pencil(NoZeroOutside())

    def holding(facts: SystemFacts) -> Condition:
        return Condition("detectability", _detectable(plant), True, 0.0, 0.0, _DETECTABLE, _dying(len(facts.zeros)))

    def lost(facts: SystemFacts) -> Condition:
        return _hidden_modes(plant, tall_e, tall_a, facts.outside or [1 + 0j])

    return judge.no_zero_outside(NoZeroOutside(), holding=holding, lost=lost, what="filter")


def _detectable(plant: TimeVaryingDescriptorSystem | DescriptorSystem) -> str:
    return f"rank [A - zE; C] = {plant.nx} for all |z| >= 1"


def _dying(count: int) -> str:
    return f"{count} unobservable mode(s), all of which decay" if count else "observable"


def _hidden_modes(
    plant: TimeVaryingDescriptorSystem | DescriptorSystem,
    tall_e: FloatArray,
    tall_a: FloatArray,
    modes: Sequence[complex],
) -> Condition:
    hidden = sorted(modes, key=lambda z: (-abs(z), -z.imag))
    mode = hidden[0]
    names = _open_states(tall_e, tall_a, mode, plant)
    others = [described_mode(z) for z in hidden[1:] if z.imag >= 0.0 and z != mode]
    detail = (
        f"the mode z = {described_mode(mode)} of {_listed(names)} is unobservable"
        + (f" (as the modes {', '.join(others)})" if others else "")
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
    first, *rest = remedies
    return f"{first[0].upper()}{first[1:]}" + "".join(f", {text}" for text in rest[:-1]) + f", or {rest[-1]}."

"""Identifiability of constant parameters: whether their effects on the outputs are linearly independent.

Plants with constant matrices are decided as written: up to 64 states in rational arithmetic (24 of a sampled plant, in
enclosures); the parameters stand where faults do.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TypeAlias

import numpy as np
from flint import fmpz_poly

from obsynth.analysis.existence.condition import Condition
from obsynth.analysis.existence.statements import Evaluator, NoZeroOutside, settled_rank
from obsynth.analysis.time_varying import STEPS_WITHOUT_HORIZON, IntArray, StepBlocks, early_rows, step_blocks
from obsynth.numerics.arrays import FloatArray, remembered
from obsynth.numerics.ranks import NAMED_SHARE, RankDecision, decide_rank
from obsynth.numerics.scaling import EquilibratedPencil, equilibrate_pencil
from obsynth.numerics.square_root_estimation import OUTGROWN, least_squares_step, rank_revealing_step
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.signal_names import leading_names
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem

_NAME = "identifiable parameters"

_TRACES_SOURCE = "our finding: (26) needs it, Moussa Ali, Zhang 2013"

#: Constant parameters ``(nq,)`` that leave no trace, in their own units, their shares ``(nq,)``, free of units, and the
#: names of the states that hide them.
_Kernel: TypeAlias = tuple[FloatArray, FloatArray, tuple[str, ...]]


def constant_plant(
    original: DescriptorSystem | TimeVaryingDescriptorSystem | object, varying: TimeVaryingDescriptorSystem
) -> Evaluator | None:
    """Return what decides about a plant, its parameters as faults; ``None`` where matrices change or are not square."""
    still = all(part.is_constant for part in (varying.E, varying.A, varying.C, varying.Phi, varying.Psi))
    if not still or varying.ne != varying.nx:
        return None
    if isinstance(original, DescriptorSystem):
        return Evaluator(original.dense())
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
    decision, (parameters, shares, states) = (
        _decided_at_rest(plant) if still else _decided_along_horizon(plant, early=early)
    )
    if still and constant is not None:
        settled, numbers = decision, constant.numbers
        if numbers is not None:
            traces = numbers.rank_at_root(numbers.matrices["Bf"], numbers.matrices["Df"], fmpz_poly([-1, 1]))
            settled = settled_rank(decision, traces)
        if settled.rank < decision.rank:
            # What leaves no trace exactly does so nearly in floating point.
            parameters, shares, states = _steady_kernel(plant, settled.rank)
        decision = settled
    rank_name = "rank [A - E, Phi; C, Psi]" if still else "rank of the traces of all parameters"
    claim = f"{rank_name} = {decision.expected}"
    value, bound = float(decision.rank), float(decision.expected)
    if decision.full:
        how = "" if still else ", in floating point along the horizon"
        return Condition(_NAME, claim, True, value, bound, _TRACES_SOURCE, f"{decision.describe()}{how}")
    names = leading_names(shares, plant.parameter_names)
    detail = f"{decision.describe()}: {_explained(parameters, states, names, plant)}"
    condition = Condition(_NAME, claim, False, value, bound, _TRACES_SOURCE, detail, signals=names)
    if constant is None or decision.means != "unclear":
        return condition
    doubt = constant.rank_doubt(NoZeroOutside("Bf").at_zero, decision, point=1 + 0j)
    return condition.in_doubt(replace(doubt, parameters=True), constant.plant)


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
def _decided_at_rest(plant: TimeVaryingDescriptorSystem) -> tuple[RankDecision, _Kernel]:
    """Decide about a time-invariant plant by its state and parameters at rest."""
    decision = decide_rank(_at_rest(plant).A, expected=plant.nx + plant.nq, equilibrated=False)
    return decision, _steady_kernel(plant, decision.rank)


def _at_rest(plant: TimeVaryingDescriptorSystem) -> EquilibratedPencil:
    matrix = np.block([[plant.A.at(0) - plant.E.at(1), plant.Phi.at(0)], [plant.C.at(1), plant.Psi.at(0)]])
    return equilibrate_pencil(np.zeros_like(matrix), matrix)


def _steady_kernel(plant: TimeVaryingDescriptorSystem, rank: int) -> _Kernel:
    """Return what leaves no trace at rest, where the rank is less than full."""
    pencil = _at_rest(plant)
    shares = np.linalg.svd(pencil.A)[2][rank:]
    states, parameters = np.linalg.norm(shares[:, : plant.nx], axis=0), shares[:, plant.nx :]
    largest = max(float(np.max(states, initial=0.0)), float(np.max(np.abs(parameters), initial=0.0)))
    involved = leading_names(states, plant.state_names) if states.max(initial=0.0) > NAMED_SHARE * largest else ()
    return _kernel_of(parameters, pencil.columns[plant.nx :], involved)


@remembered
def _decided_along_horizon(plant: TimeVaryingDescriptorSystem, *, early: bool) -> tuple[RankDecision, _Kernel]:
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
        step = least_squares_step(H, noise, right) or rank_revealing_step(H, noise, right, np.zeros((len(H), 0)))
        regressor, factor = step.estimate, step.factor
        if not max(np.max(np.abs(regressor)), np.max(np.abs(factor))) < OUTGROWN:
            # What is unobservable grows without bound: what has been seen until here decides.
            break
        lengths = np.linalg.norm(right, axis=0)
        # A regressor that grows in an unobservable state must not hide what was measured before.
        weight = 1.0 / max(1.0, float(np.max(lengths / direct)))
        gathered = np.asarray(np.linalg.qr(np.vstack([gathered, weight * step.innovation]), mode="r"))
        sizes = np.hypot(sizes, weight * lengths)
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
    sizes = [np.abs(matrix) for matrix in step_blocks(plant, 0, late)]
    for k in range(1, steps):
        for matrix, entries in zip(sizes, step_blocks(plant, k, late), strict=True):
            np.maximum(matrix, np.abs(entries), out=matrix)
    return StepBlocks(*sizes)

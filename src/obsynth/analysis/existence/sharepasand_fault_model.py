"""Existence conditions on a fault model: (D3), and whether double precision can represent its order."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from obsynth.analysis.existence.augmented_pencils import (
    AugmentedPlant,
    equilibrated,
    exact_loss,
    in_disturbances,
    independent_disturbances,
    kernel,
    number,
)
from obsynth.analysis.existence.condition import Condition
from obsynth.analysis.existence.distance import least_share
from obsynth.analysis.existence.named_pencils import NamedPencil, named_augmented
from obsynth.analysis.existence.statements import Evaluator, settled_rank
from obsynth.analysis.existence.witnesses import Unclear
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.invariant_zeros import is_outside, system_pencil
from obsynth.numerics.pencils import finite_zeros
from obsynth.numerics.ranks import RANK_TOLERANCE, RankDecision, decide_rank
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.faults import Exosystem
from obsynth.plants.plant_units import PlantUnits
from obsynth.plants.signal_names import MOST_NAMES, leading_names


def model_conditions(judge: Evaluator, model: Exosystem) -> list[Condition]:
    """Return the conditions (D3), one for each unstable eigenvalue of the fault model in the closed upper half plane.

    A failing condition ends the list.
    """
    plant, units, scaled_model = judge.natural, judge.units, judge.units.scaled_model(model)
    sizes = None if judge.terms is None else units.scaled_plant(judge.terms)
    eigenvalues = map(complex, scaled_model.eigenvalues)
    unstable = [value for value in eigenvalues if value.imag >= 0.0 and is_outside(value, plant.dt)]
    conditions = []
    for value in sorted(unstable, key=lambda value: (value.real, value.imag)):
        lost = exact_loss(judge, model, units.eigenvalue(value))
        decision = _model_rank(plant, scaled_model, value, lost, sizes)
        if lost is None and not decision.full:
            # Natural units of a plant of many parts drift apart; the given units may then have less rounding.
            as_given = _model_rank(judge.plant, model, units.eigenvalue(value), None)
            decision = max(decision, as_given, key=lambda each: each.rank)
        condition = _model_condition(scaled_model, decision, plant, value, units)
        if decision.means == "unclear":
            point = units.eigenvalue(value)
            other = f"hides a fault that follows its model at {number(point)}, and no observer estimates it"
            named = _named(judge, model, of_the_model=False)
            condition = condition.in_doubt(judge.doubt(named, other, point=point), judge.plant)
        conditions.append(condition)
        if not conditions[-1].holds:
            break
    return conditions


def _model_matrix(plant: DescriptorSystem, amplitudes: NDArray[Any], value: complex) -> NDArray[Any]:
    """Return the matrix of (D3) at an eigenvalue; ``amplitudes (nf, k)``: the faults along its k eigenvectors."""
    inputs, direct = independent_disturbances(plant)
    return np.block(
        [
            [value * plant.E - plant.A, -plant.Bf @ amplitudes, -inputs],
            [plant.C.astype(complex), plant.Df @ amplitudes, direct],
        ]
    )


def _fault_amplitudes(model: Exosystem, value: complex) -> NDArray[Any]:
    return np.asarray(model.Cw @ kernel(model.Phi - value * np.eye(model.order)))


def _model_rank(
    plant: DescriptorSystem, model: Exosystem, value: complex, lost: int | None, sizes: DescriptorSystem | None = None
) -> RankDecision:
    """Decide (D3); ``sizes``: magnitudes of the terms that the entries of the plant are sums of."""
    amplitudes, share = _fault_amplitudes(model, value), np.inf
    matrix = _model_matrix(plant, amplitudes, value)
    if sizes is not None:
        # Disturbances that were replaced by independent combinations have no known terms: use their own magnitude.
        inputs, direct = independent_disturbances(plant)
        own = inputs.shape == plant.Bd.shape
        terms = np.block(
            [
                [abs(value) * sizes.E + sizes.A, sizes.Bf @ np.abs(amplitudes), sizes.Bd if own else np.abs(inputs)],
                [sizes.C, sizes.Df @ np.abs(amplitudes), sizes.Dd if own else np.abs(direct)],
            ]
        )
        share = least_share(matrix, terms)
    width = matrix.shape[1]
    decision = decide_rank(equilibrated(matrix)[0], expected=width, equilibrated=False)
    return settled_rank(decision, None if lost is None else width - lost, share)


def _model_condition(
    model: Exosystem, decision: RankDecision, plant: DescriptorSystem, value: complex, units: PlantUnits
) -> Condition:
    own = units.eigenvalue(value)
    where = f"{'s' if plant.dt == 0.0 else 'z'} = {number(own)}"
    signals: tuple[str, ...] = ()
    detail = decision.describe()
    if not decision.full:
        amplitudes = _fault_amplitudes(model, value)
        width = amplitudes.shape[1]
        scaled, columns = equilibrated(_model_matrix(plant, amplitudes, value))
        direction = columns * np.linalg.svd(scaled)[2][-1].conj()
        faults = leading_names(np.abs(amplitudes @ direction[plant.nx : plant.nx + width]), plant.fault_names)
        shares = in_disturbances(plant, *independent_disturbances(plant), direction[plant.nx + width :])
        # Where states alone already hide the fault, no disturbance does.
        without = scaled[:, : plant.nx + width]
        hides = decide_rank(without, expected=plant.nx + width, equilibrated=False)
        disturbances = leading_names(shares, plant.disturbance_names, most=MOST_NAMES) if hides.full else ()
        signals = (*faults, *disturbances)
        many = "s" if len(disturbances) > 1 else ""
        masked = f" is masked by the unknown input{many} {', '.join(map(repr, disturbances))}" if disturbances else ""
        alone = len(faults) == 1
        who = f"the fault {faults[0]!r}" if alone else f"a combination of the faults {', '.join(map(repr, faults))}"
        hidden = (
            "their effects on the outputs cancel, so no observer that is decoupled from the unknown inputs can"
            if masked
            else "it has no effect on the outputs, so no observer can"
        )
        detail += (
            f": at {where} {who}{masked or ' is output-nulling'}: {hidden} estimate {'it' if alone else 'them'}. "
            f"Measure another signal, or leave {'it' if alone else 'one of them'} out."
        )
    return Condition(
        f"(D3) fault model at {number(own)}",
        f"rank [lambda E - A, -Bf Cw V, -Bd; C, Df Cw V, Dd] full at {where}, an eigenvalue of Phi",
        decision.full,
        float(decision.rank),
        float(decision.expected),
        "in place of Share Pasand, Theorems 1 and 2, which are false",
        detail,
        mode=None if decision.full else own,
        signals=signals,
    )


def _named(judge: Evaluator, model: Exosystem, *, of_the_model: bool) -> NamedPencil:
    """Return the pencil of plant and fault model, with a name for each entry."""
    return named_augmented(
        judge.plant, model, judge.units, independent=judge.independent_disturbances, of_the_model=of_the_model
    )


def order_conditions(judge: Evaluator, model: Exosystem) -> list[Condition]:
    """Return the condition that the fault model is observable in double precision.

    At a zero z0 a model of order n shows in the outputs with only about ``abs(z0)^(n + 1)``.
    """
    plant, units = judge.natural, judge.units
    inputs, direct = np.hstack([plant.Bf, plant.Bd]), np.hstack([plant.Df, plant.Dd])
    wide_e, wide_a = system_pencil(plant.E, plant.A, inputs, plant.C, direct)
    zeros = finite_zeros(wide_e, wide_a)
    if zeros.normal_rank < wide_e.shape[1]:
        return []
    points = [complex(value) for value in zeros.values if value.imag >= 0.0 and is_outside(value, plant.dt)]
    augmented = AugmentedPlant.of(plant, units.scaled_model(model))
    worst: tuple[RankDecision, complex] | None = None
    for point in points:
        decision = rank_at(augmented, independent_disturbances(plant), point)
        if worst is None or (decision.rank, decision.smallest_kept) < (worst[0].rank, worst[0].smallest_kept):
            worst = (decision, point)
    if worst is None:
        return []
    decision, point = worst[0], units.eigenvalue(worst[1])
    lost = (
        f": at the zero {number(point)} of (f, d) -> y the fault model (order {model.order}) cannot be distinguished "
        "from zero in double precision. Lower its order."
    )
    condition = Condition(
        "order of the fault model",
        "the augmented plant is observable in double precision at the points where it is least so",
        decision.full,
        float(decision.rank),
        float(decision.expected),
        "ours: exact observability is not enough in double precision",
        f"{decision.describe()} at {number(point)}" + ("" if decision.full else lost),
        mode=None if decision.full else point,
        signals=() if decision.full else plant.fault_names,
    )
    return [condition if decision.full else condition.in_doubt(_order_doubt(judge, model, point), judge.plant)]


def rank_at(augmented: AugmentedPlant, disturbances: tuple[FloatArray, FloatArray], point: complex) -> RankDecision:
    """Decide the rank of the pencil of plant and fault model at a point where these disturbances may hide a mode."""
    inputs, direct = disturbances
    below = augmented.below(inputs)
    matrix = np.block([[point * augmented.E - augmented.A, -below], [augmented.C.astype(complex), direct]])
    return decide_rank(equilibrated(matrix)[0], expected=matrix.shape[1], equilibrated=False)


def _order_doubt(judge: Evaluator, model: Exosystem, point: complex) -> Unclear:
    return judge.doubt(
        _named(judge, model, of_the_model=True),
        f"hides a motion of plant and fault model at {number(point)}, and no observer estimates it",
        point=point,
        tolerance=RANK_TOLERANCE,
        decider="A fault model of lower order, or an output nearer to the fault, would decide it.",
        moving=True,
    )


def lost_in_rounding(judge: Evaluator, model: Exosystem, mode: complex) -> Condition:
    """Return the failing condition for an unstable mode that seems unobservable though all other conditions hold."""
    order = judge.plant.nx + model.order
    condition = Condition(
        "fault model in double precision",
        "no mode of plant and fault model seems unobservable by rounding alone",
        False,
        order - 1.0,
        float(order),
        "ours: exact observability is not enough in double precision",
        f"plant and fault model (order {model.order}) seem to have an unobservable unstable mode at {number(mode)}, "
        "which the conditions above exclude: in double precision the order of the model is too high. Lower it.",
        mode=mode,
        signals=judge.plant.fault_names,
    )
    return condition.in_doubt(_order_doubt(judge, model, mode), judge.plant)

"""Preparing a plant for the fault-estimation filter, and the conditions for one to exist.

Source: Wang, Rodrigues, Theilliol, Shen 2015.  Differences: feedthrough, which the paper does not have.  Sensor
faults become algebraic states.  Disturbances and noise in the outputs enter through the error coordinate
``e = T E x - z`` instead of ``x - xhat``: the future sample ``N Dd d(k+1)`` then drops out, and the error system

    e(k+1) = (TA - L C) e + (T Bd - TA N Dd - L (I - C N) Dd) d,   residual = W (C e + (I - C N) Dd d)

is exact, where treating d(k) and d(k+1) as independent would be conservative.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from obsynth.analysis.conditions import Condition
from obsynth.analysis.fault_detectability import (
    FaultDetectability,
    detectability_conditions,
    fault_detectability,
)
from obsynth.analysis.restricted_equivalent import restricted_equivalent, restricted_equivalent_from
from obsynth.analysis.transformations import augment_faults
from obsynth.analysis.zeros import Zero, fault_zeros
from obsynth.errors import PreconditionError
from obsynth.models.descriptor import DescriptorSystem
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.pencils import pencil_structure
from obsynth.numerics.ranks import RankDecision, decide_rank
from obsynth.numerics.scaling import Scaling, balance_system


@dataclass(frozen=True, eq=False)
class PreparedPlant:
    """A plant in the form the filter's theory works on: sensor faults as states, balanced, ``T E + N C = I``.

    Parameters
    ----------
    plant : DescriptorSystem
        With sensor faults appended as algebraic states; not balanced.
    scaling : Scaling
        Power-of-two factors of the balanced coordinates, in which everything below is given.
    T, N : FloatArray
        ``(na, na)`` and ``(na, ny)``, na states after appending.
    TA, C, TF : FloatArray
        ``(na, na)``, ``(ny, na)``, ``(na, nf)``.
    Bd, Dd : FloatArray
        Disturbance in the error system ``(na, nd)`` and in the innovation ``(ny, nd)``.
    Bw, Dw : FloatArray
        Noise likewise, ``(na, nw)`` and ``(ny, nw)``.
    detectability : FaultDetectability
        Indexes, Psi and Upsilon.
    """

    plant: DescriptorSystem
    scaling: Scaling
    T: FloatArray
    N: FloatArray
    TA: FloatArray
    C: FloatArray
    TF: FloatArray
    Bd: FloatArray
    Dd: FloatArray
    Bw: FloatArray
    Dw: FloatArray
    detectability: FaultDetectability


def with_sensor_faults_as_states(plant: DescriptorSystem) -> DescriptorSystem:
    """Return the plant with every fault that reaches an output directly appended as an algebraic state.

    Raises
    ------
    PreconditionError
        ``rank [E 0; 0 0; C Df]`` is too small; the faults are named.
    """
    direct = tuple(name for name, column in zip(plant.fault_names, plant.Df.T, strict=True) if np.any(column != 0.0))
    return augment_faults(plant, direct).plant if direct else plant


def prepare(plant: DescriptorSystem, s: FloatArray | None = None) -> PreparedPlant:
    """Return the prepared plant; the rank conditions must hold.

    Parameters
    ----------
    plant : DescriptorSystem
        Discrete time, with faults.
    s : FloatArray, optional
        The paper's free matrix S ``(na, na + ny)``; the plant is then not balanced.
    """
    work = with_sensor_faults_as_states(plant)
    if s is None:
        scaling = balance_system(work.E, work.A, inputs=[work.Bf], outputs=[work.C])
    else:
        scaling = Scaling(np.ones(work.nx), np.ones(work.nx), np.ones(work.ny))
    e, a = scaling.scale_dynamics(work.E), scaling.scale_dynamics(work.A)
    c = scaling.scale_output(work.C)
    t, n = restricted_equivalent(e, c) if s is None else restricted_equivalent_from(e, c, s)
    ta, tf = t @ a, t @ scaling.scale_input(work.Bf)
    shown = np.eye(work.ny) - c @ n

    def error_input(b: FloatArray, d: FloatArray) -> tuple[FloatArray, FloatArray]:
        direct = scaling.scale_feedthrough(d)
        return t @ scaling.scale_input(b) - ta @ (n @ direct), shown @ direct

    bd, dd = error_input(work.Bd, work.Dd)
    bw, dw = error_input(work.Bw, work.Dw)
    return PreparedPlant(work, scaling, t, n, ta, c, tf, bd, dd, bw, dw, fault_detectability(ta, c, tf))


def fault_filter_conditions(plant: DescriptorSystem) -> tuple[Condition, ...]:
    """Return the existence conditions of the fault-estimation filter, in order; the list ends at the first failure.

    Parameters
    ----------
    plant : DescriptorSystem
        Any plant.
    """
    found: list[Condition] = []
    for group in (_form_conditions, _rank_conditions, _visibility_conditions, _zero_conditions):
        found += group(plant)
        if not all(condition.holds for condition in found):
            first = next(i for i, condition in enumerate(found) if not condition.holds)
            return tuple(found[: first + 1])
    return tuple(found)


def _form_conditions(plant: DescriptorSystem) -> list[Condition]:
    structure = pencil_structure(plant.E, plant.A)
    return [
        Condition(
            "discrete time",
            "a discrete-time plant (dt > 0)",
            plant.is_discrete,
            plant.dt,
            0.0,
            "Wang 2015, eq. (1)",
            ""
            if plant.is_discrete
            else "a continuous plant. Sample it first (transform: {sample_time: ...} in "
            "a spec, obsynth.discretise in Python).",
        ),
        Condition(
            "faults",
            "at least one fault",
            plant.nf > 0,
            float(plant.nf),
            1.0,
            "Wang 2015, eq. (1)",
            "" if plant.nf else "none. Name the fault to estimate in Bf or Df.",
        ),
        Condition(
            "regularity",
            "a regular pencil (det(A - zE) not identically zero)",
            structure.regular,
            float(structure.normal_rank),
            float(plant.nx),
            "DESIGN: plants",
            f"normal rank {structure.normal_rank} of {plant.nx}"
            + ("" if structure.regular else ": the equations do not determine the states. Add what is missing."),
        ),
    ]


def _rank_condition(
    name: str, decision: RankDecision, remedy: str, *, source: str, signals: tuple[str, ...] = ()
) -> Condition:
    return Condition(
        name,
        f"{name} = {decision.expected}",
        decision.full,
        float(decision.rank),
        float(decision.expected),
        source,
        decision.describe() + ("" if decision.full else f": {remedy}"),
        signals=() if decision.full else signals,
    )


def _rank_conditions(plant: DescriptorSystem) -> list[Condition]:
    enough = Condition(
        "nf <= ny",
        "no more faults than outputs (nf <= ny)",
        plant.nf <= plant.ny,
        float(plant.nf),
        float(plant.ny),
        "Wang 2015, below eq. (1)",
        ""
        if plant.nf <= plant.ny
        else f"{plant.nf} faults and {plant.ny} output(s). Measure more, or leave a fault out.",
        signals=() if plant.nf <= plant.ny else plant.fault_names,
    )
    faults = decide_rank(np.vstack([plant.Bf, plant.Df]), expected=plant.nf)
    ranks = [
        enough,
        _rank_condition(
            "rank F",
            faults,
            "some faults act nowhere, or in the same direction as others, and cannot be told apart.",
            source="Wang 2015, below eq. (1)",
            signals=_dependent_columns(plant),
        ),
    ]
    if not all(condition.holds for condition in ranks):
        return ranks
    try:
        work = with_sensor_faults_as_states(plant)
    except PreconditionError as error:
        return [
            *ranks,
            Condition(
                error.condition,
                "sensor faults can be told from the states",
                False,
                np.nan,
                np.nan,
                "Wang 2015, eq. (2), with the fault as a state",
                str(error),
                signals=error.signals,
            ),
        ]
    outputs = decide_rank(work.C, expected=work.ny)
    stacked = np.vstack([work.E, work.C])
    ranks += [
        _rank_condition(
            "rank C",
            outputs,
            "some outputs repeat others: leave them out.",
            source="Wang 2015, below eq. (1)",
            signals=_leading(np.abs(np.linalg.svd(work.C)[0][:, -1]), plant.output_names),
        ),
        _rank_condition(
            "rank [E; C]",
            decide_rank(stacked, expected=work.nx),
            "not every state is either dynamic or measured. Measure more, or eliminate the algebraic states first "
            "(transform: {eliminate_algebraic_states: true} in a spec).",
            source="Wang 2015, eq. (2)",
            signals=_unseen_states(stacked, work.state_names),
        ),
    ]
    return ranks


def _visibility_conditions(plant: DescriptorSystem) -> list[Condition]:
    return list(detectability_conditions(prepare(plant).detectability, plant.fault_names))


def _zero_conditions(plant: DescriptorSystem) -> list[Condition]:
    zeros = fault_zeros(plant)
    largest = max((abs(zero.value) for zero in zeros.zeros), default=0.0)
    claim = "every invariant zero from the faults to the outputs strictly inside the unit circle"
    source = "never stated in Wang 2015: detectability of (A1, C1)"
    if not zeros.normal_rank_full:
        detail = f"faults {', '.join(map(repr, zeros.hidden_faults))} can act together without showing in any output."
        return [Condition("fault zeros", claim, False, np.inf, 1.0, source, detail, signals=zeros.hidden_faults)]
    if zeros.outside:
        return [_zero_failure(plant, max(zeros.outside, key=lambda zero: abs(zero.value)), claim, source)]
    detail = f"{len(zeros.zeros)} zero(s)" + (f", largest modulus {largest:.6g}" if zeros.zeros else "")
    return [Condition("fault zeros", claim, True, float(largest), 1.0, source, detail)]


def _zero_failure(plant: DescriptorSystem, zero: Zero, claim: str, source: str) -> Condition:
    value = f"{zero.value.real:.6g}" if zero.value.imag == 0.0 else f"{zero.value:.6g}"
    if zero.is_unobservable_mode:
        signals = _leading(np.abs(zero.state_direction), plant.state_names)
        detail = (
            f"the mode z = {value} (states {', '.join(map(repr, signals))}) never shows in the outputs and does "
            "not decay: measure something it moves."
        )
    else:
        signals = _leading(np.abs(zero.input_direction), plant.fault_names)
        detail = (
            f"at the zero z = {value} the fault {', '.join(map(repr, signals))} can follow z^k without showing "
            "in any output, so no filter can estimate it. Measure another signal."
        )
    return Condition(
        "fault zeros", claim, False, abs(zero.value), 1.0, source, detail, mode=zero.value, signals=signals
    )


def _leading(shares: FloatArray, names: tuple[str, ...], most: int = 4) -> tuple[str, ...]:
    order = np.argsort(-shares, kind="stable")[:most]
    return tuple(names[i] for i in order if shares[i] > 0.1 * shares[order[0]])


def _dependent_columns(plant: DescriptorSystem) -> tuple[str, ...]:
    columns = np.vstack([plant.Bf, plant.Df])
    lengths = np.linalg.norm(columns, axis=0)
    if np.any(lengths == 0.0):
        return tuple(name for name, length in zip(plant.fault_names, lengths, strict=True) if length == 0.0)
    return _leading(np.abs(np.linalg.svd(columns / lengths)[2][-1]), plant.fault_names)


def _unseen_states(stacked: FloatArray, names: tuple[str, ...]) -> tuple[str, ...]:
    return _leading(np.abs(np.linalg.svd(stacked)[2][-1]), names)

"""Fault-estimation filter for discrete-time descriptor systems.

Source: Z. Wang, M. Rodrigues, D. Theilliol, Y. Shen, *Fault estimation filter design for discrete-time descriptor
systems*, IET Control Theory and Applications 9 (10), 2015: filter (23), gain structure (60), LMI (45).

Deviations from the paper
    1. The sign of the second term of (48) is wrong: L = TA Psi Upsilon^+ + P^-1 Y (I - Upsilon Upsilon^+), see (60).
    2. W = Upsilon^+ as in (47), not Psi^+ as in the proof.
    3. Existence is decided before any solver runs, with a condition on zeros that the paper does not state.
    4. Only the part of Y that has an effect is a variable (Y = y V', V = null Upsilon'), or Y is eliminated.
    5. gamma^2 is minimised directly.  Algorithm 1 never advances past its first step; bisection ends with a bracket.
    6. A second stage at a slightly larger gamma chooses small gains, since those of the optimum have condition numbers
       of 1e7.
    7. Feedthrough of inputs, faults, disturbances and noise is treated exactly (see `prepared_plant`).
    8. The paper's state estimate has a bias of Psi times the fault; the shipped filter corrects it.
    9. An output may depend on disturbances alone: it is enough that the rows of [C Dd] are independent, where the paper
       assumes rank C = ny.  The filter treats such outputs as measured disturbances.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from obsynth.analysis.existence.condition import Condition, require_all
from obsynth.analysis.existence.restricted_equivalent import PreparedPlant, prepare, with_sensor_faults_as_states
from obsynth.analysis.existence.wang2015 import examine_fault_filter, known_fault_zeros
from obsynth.conditions.gamma_lower_bound import least_gain_certificate
from obsynth.conditions.lmi import chosen_solver
from obsynth.errors import ObsynthError, PreconditionError
from obsynth.methods.engines.sensor_noise import fault_deviation
from obsynth.methods.fault_estimation_filter.certificate import bounded_real_certificate
from obsynth.methods.fault_estimation_filter.convex_problem import (
    GainParts,
    centred,
    gain_problem,
    gains_in_given_units,
    with_output_noise,
    with_weight_limit,
)
from obsynth.methods.fault_estimation_filter.method import FaultEstimationFilter
from obsynth.methods.fault_estimation_filter.over_region import synthesise_over_region
from obsynth.methods.fault_estimation_filter.printed_gains import weight_rows
from obsynth.methods.fault_estimation_filter.realisation import notes, realise_filter
from obsynth.methods.fault_estimation_filter.search import NOMINAL_GAIN, FoundGains, found_within
from obsynth.methods.fault_estimation_filter.small_gains import PrintedInequality
from obsynth.methods.fault_estimation_filter.weights import least_by_weight, price_in_words
from obsynth.methods.method import Synthesis, silent
from obsynth.numerics.arrays import FloatArray, as_matrix
from obsynth.numerics.central_filter import LeastGain
from obsynth.numerics.outward import upper_text
from obsynth.observers.linear.means import averaged, unaveraged
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.polytopic import PolytopicSystem
from obsynth.plants.transformations.redundant_outputs import (
    MergedOutputs,
    merged_outputs,
    nearly_merged_outputs,
    picked_outputs,
)
from obsynth.results.design import Certificate
from obsynth.verification.least_gain_proof import LEAST_GAIN_WITNESSES, OUTPUTS_READ, least_gain_row

#: Gains that multiply the outputs.
_OF_OUTPUTS = ("N", "L", "W", "R")

#: A free weight is the default if it lowers the least gain by at least this share, since it may add noise.
WORTH_A_FREE_WEIGHT = 0.05

#: With more states the filter with the other weight is not designed for comparison, since it takes as long.
MOST_STATES_COMPARED = 8

_PRICES = "What is shipped for each, and its H2 norm from unit noise on each output to the estimates:"

#: Largest factor by which noise may grow for a smaller gain that uses differences of nearly dependent outputs.
MOST_NOISE_FOR_GAIN = 1e4

#: Number of coordinates in which a certificate is tried before the gain is computed again.
FIRST_TRIES = 4


def synthesise(
    plant: DescriptorSystem | PolytopicSystem, method: FaultEstimationFilter, *, progress: Callable[[str], None]
) -> Synthesis:
    """Design the filter; see `obsynth.fault_estimation_filter` for the options, results and errors."""
    if isinstance(plant, PolytopicSystem):
        return synthesise_over_region(plant, method, progress=progress)
    solver = chosen_solver(method.solver, method.solver_options)
    if method.own_inequality:
        from obsynth.methods.engines.own_terms import filter_by_inequality

        return filter_by_inequality(plant, method, progress=progress)
    method = replace(method, solver=solver)
    progress("checking the existence conditions")
    conditions, prepared = examine_fault_filter(plant)
    require_all(conditions)
    merged = merged_outputs(plant)
    dependent = merged is not None and _is_prepared_without(plant, prepared)
    paper = method.asks_for_free_weight is False
    near = nearly_merged_outputs(plant) if method.S is None and not paper else None
    if merged is None or not dependent:
        made = _synthesised(plant, conditions, prepared, method, progress)
        return made if near is None else _less_noisy(plant, near, made, method, progress)
    if method.S is not None:
        raise _for_independent_outputs("S", "S", plant, merged)
    if method.given_weight is not None:
        raise _for_independent_outputs("A given W", "weight", plant, merged)
    made = _of_merged(plant, merged, _synthesised(merged.plant, conditions, prepared, method, progress))
    if not _is_as_labelled(made):
        if paper:
            raise _for_independent_outputs("The paper's W", _that_asks_for_it(method), plant, merged)
        free = replace(method, weight="free")
        made = _of_merged(plant, merged, _synthesised(merged.plant, conditions, prepared, free, progress))
    return made if near is None else _less_noisy(plant, near, made, method, progress)


def _less_noisy(
    plant: DescriptorSystem,
    near: MergedOutputs,
    made: Synthesis,
    method: FaultEstimationFilter,
    progress: Callable[[str], None],
) -> Synthesis:
    """Return the filter with nearly dependent outputs merged if it has less noise, else the given one.

    If no filter with merged outputs exists, one of these outputs is used alone.  A gain on disturbances that is smaller
    by more than the margin is worth some noise, up to `MOST_NOISE_FOR_GAIN`: a difference between outputs that agree up
    to the last digits of a linearisation decouples nothing in a real plant.
    """
    for merged in (near, picked_outputs(plant, near)):
        conditions, prepared = examine_fault_filter(merged.plant)
        if prepared is None or not all(condition.holds for condition in conditions):
            continue
        try:
            other = _of_merged(plant, merged, _synthesised(merged.plant, conditions, prepared, method, progress))
        except ObsynthError:
            continue
        break
    else:
        return made
    if not _is_as_labelled(other):
        # The paper's W for merged outputs is another left inverse for the given outputs, and so a free one.
        other = replace(other, options={**other.options, "weight": "free"})
    least, gain = other.certificate.claims.get("gamma_min", 0.0), made.certificate.claims.get("gamma", 0.0)
    price = 1.0 if least <= (1.0 + method.gamma_margin) * gain else MOST_NOISE_FOR_GAIN
    merged_deviation, deviation = (fault_deviation(plant, one.linear_observer) for one in (other, made))
    return other if price * merged_deviation < deviation else made


def _for_independent_outputs(
    choice: str, option: str, plant: DescriptorSystem, merged: MergedOutputs
) -> PreconditionError:
    """Return the error for a choice that requires independent outputs; it names the option to leave out."""
    return PreconditionError(
        f"{choice} is for independent outputs (Wang 2015, below eq. (1), assumes rank C = {plant.ny}), but "
        f"{plant.ny - merged.plant.ny} of the outputs depend on others. Leave {option} out: a filter exists, and such "
        "outputs are merged by their noise then.",
        condition="rank [C Dd]",
    )


def _that_asks_for_it(method: FaultEstimationFilter) -> str:
    """Return the name of the option that requires the paper's W."""
    return "weight" if method.weight is not None else "gamma_search"


def _is_as_labelled(made: Synthesis) -> bool:
    """Whether W agrees with the option ``weight``: it is the paper's if the option says so."""
    return all(row.passed for row in weight_rows(made.gains, made.options["weight"]))


def _of_merged(plant: DescriptorSystem, merged: MergedOutputs, synthesis: Synthesis) -> Synthesis:
    """Return the filter of a plant from the filter for its merged outputs."""
    observer, weights, mean = synthesis.linear_observer, merged.weights, synthesis.options["mean"]
    work = with_sensor_faults_as_states(plant)
    # The averaging registers must contain the estimates of the shipped filter to the last bit.
    observer = unaveraged(observer, mean) or observer if mean > 1 else observer
    observer = replace(observer, By=observer.By @ weights, Dy=observer.Dy @ weights, output_names=plant.output_names)
    gains = {name: gain @ weights if name in _OF_OUTPUTS else gain for name, gain in synthesis.gains.items()}
    gains["Upsilon"] = work.C @ synthesis.gains["Psi"]
    return replace(
        synthesis,
        gains=gains,
        observer=averaged(observer, mean) if mean > 1 else observer,
        certificate=_where_it_holds(synthesis, work, gains, weights),
    )


def _where_it_holds(
    synthesis: Synthesis, work: DescriptorSystem, gains: Mapping[str, FloatArray], weights: FloatArray
) -> Certificate:
    """Return the certificate with a valid proof of the least gain, of all filters or of those of merged outputs.

    If neither proof is valid, the certificate has none.  Rounding of dependent outputs may make visible what merged
    outputs do not show, to filters with gains of any size.
    """
    certificate = synthesis.certificate
    if not LEAST_GAIN_WITNESSES & certificate.matrices.keys():
        return certificate
    for more in ({}, {OUTPUTS_READ: weights}):
        matrices = {**certificate.matrices, **more}
        row = least_gain_row(
            work,
            gains,
            matrices,
            certificate.claims["gamma_min"],
            free_weight=synthesis.options["weight"] == "free",
            thorough=False,
        )
        if row.passed:
            return replace(certificate, matrices=matrices)
    held = {name: part for name, part in certificate.matrices.items() if name not in LEAST_GAIN_WITNESSES}
    return replace(certificate, matrices=held)


def _is_prepared_without(plant: DescriptorSystem, prepared: PreparedPlant | None) -> bool:
    """Whether the conditions were decided for the merged outputs, which are fewer."""
    return prepared is None or prepared.plant.ny < plant.ny


def _synthesised(
    plant: DescriptorSystem,
    conditions: Sequence[Condition],
    prepared: PreparedPlant | None,
    method: FaultEstimationFilter,
    progress: Callable[[str], None],
) -> Synthesis:
    """Return the filter of a plant with independent outputs."""
    s = None if method.S is None else as_matrix(method.S, "S")
    prepared = prepare(plant, s) if prepared is None or s is not None else prepared
    limit = method.residual_weight_limit
    free, remarks, known = weight_by_gain(plant, prepared, method)
    other = None
    if remarks and plant.nx <= MOST_STATES_COMPARED:
        other = _of_other_weight(plant, conditions, prepared, replace(method, weight="paper" if free else "free"))
    problem, parts = gain_problem(prepared, free_weight=free)
    # If disturbances have no effect on the estimates, a small positive gain is proved instead.
    nominal = NOMINAL_GAIN * max(problem.disturbance_size, NOMINAL_GAIN)
    if not free or limit is not None:
        # The paper's W = Upsilon^+ is that of the given outputs, not of balanced ones.
        problem, parts = centred(problem, prepared, parts, weight=method.given_weight)
    elif plant.nw == 0:
        problem = with_output_noise(problem, parts)
    limited = None if limit is None else with_weight_limit(problem, prepared, parts, limit)
    printed = PrintedInequality(plant, prepared, parts, free, method.solver)
    search = partial(found_within, problem, limited, method, printed=printed, progress=progress)
    outcome = search(exactly=False, known=known)
    progress("building the realisation and its certificate")
    level = outcome.gamma if outcome.problem.disturbances else nominal
    gains, realised, factor, proved = _shipped(plant, prepared, parts, outcome, level, tries=FIRST_TRIES)
    if not proved:
        if not replace(outcome.problem, judged_exactly=True).reaches(outcome.chosen, level):
            outcome = search(exactly=True)  # a peak was missed
            level = outcome.gamma if outcome.problem.disturbances else nominal
        gains, realised, factor, _ = _shipped(plant, prepared, parts, outcome, level, tries=None)
    observer, tracking, lag = realised
    claims, witnesses = {"state_lag": float(lag)}, {"P_factor": factor, "tracking": tracking}
    if plant.nd:
        progress("proving that no filter has a smaller gain")
        least, proof = _least(outcome, prepared, method, gains, factor, level=level, free_weight=free)
        claims = {"gamma": level, "gamma_min": least["gamma_min"]} | claims | least
        witnesses |= proof
    records = [*outcome.least.records, *outcome.records]
    resolved = method.as_plain() | {"weight": method.taken_weight(free=free), "S": None if s is None else s.tolist()}
    if other is not None:
        both = {free: price_in_words(level, gains, observer), not free: other}
        remarks = (*remarks, f"{_PRICES} Free W: {both[True]}. The paper's W: {both[False]}.")
    if method.mean > 1:
        # The averaging registers contain fault estimates, and so track no state of the plant.
        zeros = np.zeros(((method.mean - 1) * plant.nf, tracking.shape[1]))
        witnesses["tracking"] = np.vstack([tracking, zeros])
        observer = averaged(observer, method.mean)
    if plant.nd and method.gamma is not None and level < method.gamma:
        remarks = (
            *remarks,
            f"gamma = {method.gamma:.6g} was asked for, and {upper_text(level, 6)} is proved: a larger gamma would "
            "only make the gains worse conditioned.",
        )
    return Synthesis(
        resolved,
        gains,
        observer,
        Certificate(witnesses, claims),
        {"engine": "lmi" if any("settings" in record for record in records) else "riccati", "runs": records},
        (*remarks, *notes(plant, prepared.detectability, observer, zeros=known_fault_zeros(plant))),
    )


def _of_other_weight(
    plant: DescriptorSystem, conditions: Sequence[Condition], prepared: PreparedPlant, method: FaultEstimationFilter
) -> str | None:
    """Return a text on gain and noise of the filter with the other weight; ``None`` if there is no such filter."""
    try:
        made = _synthesised(plant, conditions, prepared, replace(method, mean=1), silent)
    except ObsynthError:
        return None
    return price_in_words(made.certificate.claims["gamma"], made.gains, made.linear_observer)


def weight_by_gain(
    plant: DescriptorSystem, prepared: PreparedPlant, method: FaultEstimationFilter
) -> tuple[bool, tuple[str, ...], LeastGain | None]:
    """Return whether W is free, remarks on the comparison of a free W with the paper's, and the search for the gain.

    By default W is free if the plant states noise, or if a free W lowers the least gain by `WORTH_A_FREE_WEIGHT`.
    """
    if method.asks_for_free_weight is not None:
        return method.asks_for_free_weight, (), None
    if plant.nw or not plant.nd:
        return plant.nw > 0, (), None
    if not gain_problem(prepared, free_weight=True)[0].measured:
        return False, (), None
    upper, lower, of_paper, of_free = least_by_weight(prepared)
    is_free = bool(lower < (1.0 - WORTH_A_FREE_WEIGHT) * upper)
    taken_for = "the free W is taken" if is_free else "the paper's W is taken"
    remark = f"Least gamma with these T and N: {lower:.5g} with a free W, {upper:.5g} with the paper's W; {taken_for}."
    return is_free, (remark,), of_free if is_free else of_paper


def _least(
    outcome: FoundGains,
    prepared: PreparedPlant,
    method: FaultEstimationFilter,
    gains: Mapping[str, FloatArray],
    factor: FloatArray,
    *,
    level: float,
    free_weight: bool,
) -> tuple[dict[str, float], dict[str, FloatArray]]:
    """Return the claims on the least gain of all filters, and their witnesses."""
    least = outcome.least
    proof, proved = least_gain_certificate(
        outcome.problem,
        prepared.plant,
        gains,
        factor,
        gain=least.gain,
        free_weight=free_weight,
        solver=method.solver,
        thorough=method.prove_least,
    )
    # By its tolerance the search may end below the proved bound, where no filter exists.
    claims = {"gamma_min": min(max(least.gain, proved), level)}
    if method.gamma_search == "bisection":
        low, high = least.bracket
        claims |= {"gamma_bracket_low": low, "gamma_bracket_high": max(high, claims["gamma_min"])}
    return claims, proof


def _shipped(
    plant: DescriptorSystem,
    prepared: PreparedPlant,
    parts: GainParts,
    outcome: FoundGains,
    level: float,
    *,
    tries: int | None,
) -> tuple[dict[str, FloatArray], tuple[LinearObserver, FloatArray, int], FloatArray, bool]:
    """Return gains, their realisation, the certificate of the claimed level, and whether it proves that level."""
    gains = gains_in_given_units(prepared, parts, outcome.chosen)
    observer, tracking, lag = realise_filter(plant, prepared.plant, gains, prepared.detectability)
    proof = bounded_real_certificate(plant, observer, tracking, level, core=prepared.plant.nx, lag=lag, tries=tries)
    return gains, (observer, tracking, lag), *proof

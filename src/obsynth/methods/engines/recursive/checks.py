"""Checks of a recursive observer: fit, a batch solution, proofs, excitation, and consistency by Monte Carlo.

Source of the claims: Moussa Ali, Zhang 2013, (6), (13), (26) and Lemma 3.1; the residual directions are our finding.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping

import numpy as np

from obsynth.analysis.existence.recursive import SOURCE, recursive_conditions
from obsynth.analysis.time_varying import HorizonRanks, horizon_ranks
from obsynth.errors import ObsynthError, counted
from obsynth.methods.engines.recursive.batch import BATCH_STEPS, batch_residuals, batch_steps
from obsynth.methods.engines.recursive.consistency import consistency
from obsynth.methods.engines.recursive.horizon_proof import (
    HorizonProof,
    bias_row,
    covariance_row,
    horizon_proof,
    parameter_row,
)
from obsynth.methods.engines.recursive.steady_state import steady_rows
from obsynth.numerics.arrays import remembered
from obsynth.observers.changed_options import plain_recursion
from obsynth.observers.nonlinear.observer import DAEObserver
from obsynth.observers.recursive.gain_schedule import shared_gains
from obsynth.observers.recursive.gain_schedule_summary import (
    STEPS_TO_CONTRACT,
    GainScheduleSummary,
    examined_steps,
    shared_summary,
)
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.observers.recursive.options import observer_from_options
from obsynth.plants.sequences import MatrixSequence
from obsynth.results.checks import Check, fitting_check, information, upper_bound_check
from obsynth.results.design import ObserverDesign
from obsynth.verification.claims import listed_gains
from obsynth.verification.plant import condition_rows

#: Claims may differ from what is recomputed by this much: they are the same numbers from another run.
CLAIM_TOLERANCE = 1e-6

#: The recursion may differ from the batch solution by this much, relative to standard deviations, times cond H.
BATCH_TOLERANCE = 1e-9


def checks(design: ObserverDesign, printed_digits: int | None) -> Iterator[Check]:
    """Yield every check of ``design``; see `obsynth.verify`."""
    plant, observer = design.recursive
    form = None if observer.adaptation is None else observer.adaptation.form
    yield information(
        "plant: steps", "length of the horizon (0: without end)", float(plant.horizon or 0), source="the plant"
    )
    conditions = tuple(
        recursive_conditions(
            plant, parameters=form is not None, literal=form == "literal", early=observer.early_constraints
        )
    )
    yield from condition_rows(conditions)
    if not all(condition.holds for condition in conditions):
        return
    problem = misfit(design)
    yield fitting_check(
        "observer, options and plant hold the same matrices at every k",
        fits=not problem,
        source="shipped observer",
        kind="equality",
        detail=problem,
    )
    yield from refinement_rows(observer)
    stated = _stated(design)
    if stated is None or observer.plant.nx != plant.nx or observer.plant.ne != plant.ne:
        return
    try:
        # What is checked is the recursion; records that no plant made would seem full of outliers.
        yield from _dynamic_rows(design, plain_recursion(observer), plain_recursion(stated), same=not problem)
    except (ObsynthError, np.linalg.LinAlgError, ValueError) as error:
        yield failed_run(error)


def failed_run(error: Exception) -> Check:
    """Return the row of an observer that does not run."""
    return upper_bound_check(
        "runs",
        "the observer runs on the outputs of its own model",
        1.0,
        0.0,
        source="shipped observer",
        detail=str(error),
    )


def refinement_rows(observer: RecursiveObserver | DAEObserver) -> Iterator[Check]:
    """Yield what holds besides the recursion that is checked: bounds of states, and sensors of their own times."""
    if observer.state_bounds is not None:
        pairs = zip(observer.state_names, observer.state_bounds, strict=True)
        bounded = [name for name, pair in pairs if np.isfinite(pair).any()]
        is_fed_back = isinstance(observer, DAEObserver)
        goes_on = "the next step begins there" if is_fed_back else "the recursion goes on without them"
        yield information(
            "state bounds",
            "estimates are projected onto bounds in the metric of their covariance, which stays that without bounds",
            float(len(bounded)),
            source="options: state_bounds",
            status="assumed",
            detail=f"active for {', '.join(bounded)}; {goes_on}. The true states are assumed to keep the bounds: then "
            "no projection makes a squared error larger in units of the covariance",
        )
    for name, entry in (observer.sensors or {}).items():
        yield information(
            f"sensor {name}",
            "rows between its samples",
            float(entry["every"]),
            source="options: sensors",
            detail=f"its values are delayed by {counted(entry['delay'], 'row')}; the other rows of this report are "
            "about samples of every sensor at once",
        )


def _dynamic_rows(
    design: ObserverDesign, observer: RecursiveObserver, stated: RecursiveObserver, *, same: bool
) -> Iterator[Check]:
    """Yield the rows on what the observer does; ``same`` says that its matrices are those that are stated."""
    ranks, gains = horizon_ranks(observer.plant, early=observer.early_constraints), shared_gains
    facts = shared_summary(observer)
    yield information(
        "condition of H",
        "largest condition number of [E_k; C_k]",
        ranks.condition,
        source=f"{SOURCE}, (6)",
        detail=f"at k = {ranks.condition_k}",
    )
    yield information(
        "residual directions",
        "least rank E_k + ny - nx: what (18f) can use",
        float(ranks.directions),
        source="our finding",
        detail=f"at k = {ranks.directions_k}",
    )
    yield from _batch_rows(stated, observer, ranks.condition)
    # Where both hold the same matrices, they need not be recomputed.
    followed = facts.steps - int(observer.early_constraints)
    proof = horizon_proof(observer if same else stated, observer, followed, gains=gains)
    yield _contraction_row(facts, proof)
    if proof is not None:
        yield bias_row(proof, ranks.condition)
        yield covariance_row(stated, observer, proof.last)
        yield from parameter_row(proof)
        yield from steady_rows(stated, design.gains, proof.last, ranks.condition)
    if observer.adaptation is not None:
        yield from _parameter_information(observer, observer.adaptation.window, facts)
    yield listed_gains(design, {"L": facts.L, "K": facts.K}, tolerance=CLAIM_TOLERANCE)
    yield _claims(design, facts, ranks)
    yield from consistency(stated, observer, examined_steps(observer), gains=gains)


def _batch_rows(stated: RecursiveObserver, observer: RecursiveObserver, condition: float) -> Iterator[Check]:
    """Yield the rows that the recursion is the least-squares solution; ``condition`` is that of H."""
    in_batch = batch_steps(stated)
    span = f"{in_batch} steps at once" + (
        ", which the size of the plant allows" if in_batch < min(BATCH_STEPS, examined_steps(stated)) else ""
    )
    for name, gap in batch_residuals(stated, observer).items():
        yield upper_bound_check(
            f"batch: {name}",
            "the recursion equals the least-squares solution of the whole record",
            gap,
            BATCH_TOLERANCE * condition,
            source=f"{SOURCE}, (6)-(10)",
            kind="equality",
            detail=span,
        )


def _parameter_information(observer: RecursiveObserver, window: int, facts: GainScheduleSummary) -> Iterator[Check]:
    """Yield what the record tells about the parameters: the least information in a window, and their deviations."""
    yield information(
        "excitation",
        "least information on the parameters in a window",
        facts.excitation,
        source=f"{SOURCE}, (26)",
        detail=f"window of {window} ends at k = {facts.excitation_k}",
    )
    for name, deviation in zip(observer.fault_names, facts.deviations, strict=True):
        yield information(
            f"noise in fhat[{name}]",
            "standard deviation of the parameter after the last step",
            float(deviation),
            source="recomputed",
            detail=observer.plant.units.get(name, ""),
        )


def _contraction_row(facts: GainScheduleSummary, proof: HorizonProof | None) -> Check:
    claim, source = "mean factor per step of the product of L_k A_k", f"{SOURCE}, (13)"
    detail = f"{facts.steps} steps, {facts.span}; an error grows at most by {facts.growth:.3g} on the way"
    proved = proof is not None and proof.contraction < 1.0
    if proof is not None and proved:
        detail = (
            f"at most, in outward rounding of the gains as computed, {proof.span}; computed {facts.contraction:.6g}, "
            f"{detail}"
        )
    value = proof.contraction if proof is not None and proved else facts.contraction
    if facts.steps < STEPS_TO_CONTRACT:
        return information(
            "contraction", claim, value, source=source, detail=detail, status="proved" if proved else "recomputed"
        )
    return upper_bound_check(
        "contraction",
        claim,
        value,
        np.nextafter(1.0, 0.0),
        source=source,
        detail=detail,
        kind="proved" if proved else "computed",
    )


def _claims(design: ObserverDesign, facts: GainScheduleSummary, ranks: HorizonRanks) -> Check:
    claims = design.certificate.claims
    values = {
        "condition": ranks.condition,
        "residual_directions": float(ranks.directions),
        "contraction": facts.contraction,
        "steps": float(facts.steps),
    }
    places = {
        "condition_k": (ranks.condition_k, ranks.condition),
        "excitation_k": (facts.excitation_k, facts.excitation),
    }
    values |= {name: float(k) for name, (k, value) in places.items() if name in claims and not np.isnan(value)}
    if not np.isnan(facts.excitation):
        values["excitation"] = facts.excitation
    # An excitation that is all rounding has no digits to compare.
    return claims_row(design, values, rough=("excitation",))


def claims_row(design: ObserverDesign, values: Mapping[str, float], *, rough: Collection[str]) -> Check:
    """Return the row that claimed numbers are found again, relative to their size; small ``rough`` ones as they are."""
    claims, tiny = design.certificate.claims, float(np.finfo(np.float64).tiny)
    gaps = [
        abs(claims.get(name, np.nan) - value) / max(abs(value), CLAIM_TOLERANCE if name in rough else tiny)
        for name, value in values.items()
    ]
    return upper_bound_check(
        "claims", "every claimed number is found again", float(np.max(gaps)), CLAIM_TOLERANCE, source="certificate"
    )


@remembered
def _stated(design: ObserverDesign) -> RecursiveObserver | None:
    """Return the observer that plant and options stand for, or ``None`` when they stand for none."""
    try:
        return observer_from_options(design.recursive[0], design.options)
    except (ObsynthError, KeyError, TypeError):
        return None


def misfit(design: ObserverDesign) -> str:
    """Return what does not fit between a design's plant, options and shipped observer; empty when all does."""
    plant, observer = design.recursive
    stated = _stated(design)
    if stated is None:
        return "the options stand for no observer of this plant"
    filters = ("early_constraints", "outliers", "outlier_limit", "outlier_sizes", "sensors", "state_bounds")
    names = ("state_names", "input_names", "output_names", "parameter_names", "dt", "horizon")
    labels = ("units", "scales", "operating_point")
    adaptation = ("form", "forgetting", "guard", "window", "reset", "initial_parameters", "initial_covariance", "walk")
    for ours, theirs, fields in (
        (stated, observer, filters),
        (plant, observer.plant, (*names, *labels)),
        (stated.adaptation, observer.adaptation, adaptation),
        (stated, observer, ("initial_state", "initial_covariance")),
    ):
        if ours is None or theirs is None:
            if ours is not theirs:
                return "adaptation"
            continue
        for field in fields:
            if not np.array_equal(getattr(ours, field), getattr(theirs, field)):
                return field
    pairs: dict[str, tuple[MatrixSequence, MatrixSequence]] = {
        name: (matrix, observer.plant.matrices[name]) for name, matrix in plant.matrices.items()
    }
    pairs |= {"Q": (stated.Q, observer.Q), "R": (stated.R, observer.R)}
    steps = examined_steps(stated)
    for name, (first, second) in pairs.items():
        begin = 1 if name in ("E", "C") else 0
        last = begin + 1 if first.is_constant and second.is_constant else begin + steps
        for k in range(begin, last):
            if not np.array_equal(first.at(k), second.at(k)):
                return f"{name}({k})"
    return ""

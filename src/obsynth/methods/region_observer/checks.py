"""Checks of an observer over a region of a nonlinear plant, from the equations and the shipped numbers."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from obsynth.analysis.existence.nonlinear_region import region_conditions
from obsynth.errors import ObsynthError, SpecError
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.matrix_equations import continuous_lyapunov
from obsynth.numerics.spectra import abscissa
from obsynth.observers.nonlinear.region_observer import RegionObserver
from obsynth.observers.records import named_vector
from obsynth.plants.dae import DAEModel
from obsynth.plants.operating_region import OperatingRegion
from obsynth.plants.transformations.nonlinear_terms import NonlinearTerms, nonlinear_terms
from obsynth.proofs.balls import Ball
from obsynth.proofs.vertex_inequalities import Proved, Vertex, Witness, prove_decay
from obsynth.results.checks import Check, fitting_check, information, nothing_wrong, upper_bound_check
from obsynth.results.design import ObserverDesign
from obsynth.verification.claims import claimed, listed_gains
from obsynth.verification.nonlinear_drive import drive_of, in_words, wanted_of
from obsynth.verification.nonlinear_region import corner_errors
from obsynth.verification.over_region import (
    FROZEN_ROW,
    GAIN_WITNESSES,
    REGION_GAIN_ROW,
    WITNESSES,
    decay_row,
    deviation_row,
    region_gain_row,
    rows_of_euler,
    slope_name,
)
from obsynth.verification.plant import condition_rows

_SOURCE = "texts of the equations, enclosed by intervals"
#: Corners at which the deviation of slopes that rest is computed, for comparison.
_MOST_COMPARED = 64


def checks(design: ObserverDesign, printed_digits: int | None) -> Iterator[Check]:
    """Yield every check of ``design``; see `obsynth.verify`."""
    plant, observer = design.plant, design.observer
    fits = isinstance(plant, DAEModel) and isinstance(observer, RegionObserver)
    if not (isinstance(plant, DAEModel) and isinstance(observer, RegionObserver)):
        yield fitting_check("an observer over a region for a nonlinear plant", fits=fits)
        return
    same = plant.as_dict() == observer.model.as_dict()
    yield fitting_check("the observer's copy of the plant is the plant", fits=same)
    if not same:
        return
    yield nothing_wrong(
        "options of the region",
        "region, sample time, faults, gains and start of the options are those of the observer",
        [*_other_options(design, plant, observer)],
        source="options",
    )
    yield listed_gains(design, {"L": observer.gain})
    conditions = region_conditions(plant, observer.region, observer.faults, observer.dt)
    yield from condition_rows(conditions)
    if not all(condition.holds for condition in conditions):
        return
    terms = nonlinear_terms(plant, faults=observer.faults)
    region = OperatingRegion.of(terms, observer.region)
    row, wide = _slope_row(region, observer)
    yield row
    if not wide:
        return
    try:
        drive = _drive_of_options(design, terms, region, observer)
    except ObsynthError as error:
        yield nothing_wrong(
            "options", "noise and wanted signals are those of the plant", [str(error)], source="options"
        )
        return
    yield from _proved_rows(design, terms, region, observer, drive)


def _other_options(design: ObserverDesign, plant: DAEModel, observer: RegionObserver) -> Iterator[str]:
    """Yield the options with which the design is printed and which are not those of the observer that runs."""
    options = design.options
    faults = options.get("faults")
    named = plant.parameter_names if faults is None else [faults] if isinstance(faults, str) else faults
    try:
        region = {str(name): [float(end) for end in ends] for name, ends in (options.get("region") or {}).items()}
        start = named_vector(
            options.get("initial_state"),
            (*plant.state_names, *observer.faults),
            np.array([*plant.states.values(), *(plant.parameters[name] for name in observer.faults)]),
            "initial_state",
        )
    except (AttributeError, SpecError, TypeError, ValueError) as error:
        yield f"region and initial_state are not readable: {error}"
        return
    places = [(*plant.state_names, *observer.faults).index(name) for name in observer.terms.names]
    pairs = {
        "region": region == observer.region,
        "sample_time": options.get("sample_time") == observer.dt,
        "faults": tuple(named) == tuple(observer.faults),
        "gains": options.get("gains") is None or np.array_equal(options["gains"], observer.gain),
        "initial_state": np.array_equal(start[places], observer.initial_state),
    }
    yield from (name for name, same in pairs.items() if not same)


def _slope_row(region: OperatingRegion, observer: RegionObserver) -> tuple[Check, bool]:
    """Return the row that the stored bounds of slopes hold those over the region."""
    wrong = []
    for each, (low, high) in zip(region.slopes(), observer.slopes, strict=True):
        if not low <= each.low <= each.high <= high:
            text = region.terms.nonlinearities[each.nonlinearity].expression.text
            wrong.append(f"{text} by {region.terms.arguments[each.argument].text}: [{each.low:.6g}, {each.high:.6g}]")
    row = nothing_wrong(
        "slopes over the region",
        f"every nonlinearity rises between the stored bounds over {region.sentence()}",
        wrong,
        source=_SOURCE,
    )
    return row, not wrong


def _drive_of_options(
    design: ObserverDesign, terms: NonlinearTerms, region: OperatingRegion, observer: RegionObserver
) -> tuple[FloatArray, FloatArray, FloatArray]:
    options = design.options
    wanted = wanted_of(terms, region, options.get("wanted"))
    if options.get("noise") is None:
        return np.zeros((len(terms.names), 0)), np.zeros((len(terms.output_names), 0)), wanted
    return (*drive_of(terms, options["noise"], observer.dt), wanted)


def _witness(design: ObserverDesign, terms: NonlinearTerms, names: tuple[str, str]) -> Witness | None:
    P, G = (design.certificate.matrices.get(name) for name in names)
    shape = (1, len(terms.names), len(terms.names))
    if P is None or G is None or P.shape != shape or G.shape != shape:
        return None
    slopes = design.certificate.matrices.get(slope_name(names))
    return Witness(list(P), list(G), differential=terms.differential, slopes=slopes)


def _proved_rows(
    design: ObserverDesign,
    terms: NonlinearTerms,
    region: OperatingRegion,
    observer: RegionObserver,
    drive: tuple[FloatArray, FloatArray, FloatArray],
) -> Iterator[Check]:
    claims = design.certificate.claims
    witness, of_level = (_witness(design, terms, names) for names in (WITNESSES, GAIN_WITNESSES))
    vertices = corner_errors(terms, region.slopes(), observer.slopes, observer.gain, drive)
    words = (
        f"while the plant is in {region.sentence()}, for every trajectory there (what a step of implicit Euler misses "
        "of it is not counted)"
    )
    rate = claimed(claims, "region_decay")
    decay = decay_row(vertices, witness, rate, discrete=False, words=words)
    yield decay
    algebraic = terms.names[terms.differential :]
    if algebraic:
        yield _index_row(vertices, witness, algebraic)
    if "region_deviation" in claims:
        level = claimed(claims, "region_deviation")
        yield deviation_row(
            f"root mean square of the errors of {in_words(terms, drive[2])} for white noise of the stated sizes, "
            f"{words}",
            vertices,
            of_level,
            level,
        )
        if isinstance(vertices, list) and len(vertices) <= _MOST_COMPARED:
            frozen = max(_frozen_deviation(vertex, terms.differential) for vertex in vertices)
            yield information(
                FROZEN_ROW,
                "the root mean square where slopes stay at a corner: no claim below it can be true",
                frozen,
                source="Lyapunov equation at every corner",
                detail=f"{frozen / level:.3f} of what is proved" if level > 0.0 else "",
            )
    if "region_gain" in claims:
        yield region_gain_row(
            REGION_GAIN_ROW,
            f"the L2 gain from the noises, each in units of its size, to the errors of {in_words(terms, drive[2])} is "
            f"below this, {words}",
            vertices,
            of_level,
            claimed(claims, "region_gain"),
            discrete=False,
        )
    yield upper_bound_check(
        "rows without a claim",
        "after a row outside the region nothing is claimed until a hundredth of its error is left",
        float(rows_of_euler(rate, observer.dt)),
        float(observer.forgetting),
        source="decay over the region",
    )


def _index_row(vertices: Proved, witness: Witness | None, algebraic: tuple[str, ...]) -> Check:
    """Return the row that the algebraic equations have one solution everywhere in the region."""
    proof = None if witness is None else prove_decay(vertices, witness, 0.0, discrete=False)
    holds = proof is not None and proof.proved
    row = nothing_wrong(
        "index 1 over the region",
        f"the algebraic equations have exactly one solution for {', '.join(algebraic)}, everywhere in the region",
        [] if holds else ["not proved" if proof is None else proof.reason],
        source="algebraic block of the same inequality, proved in balls",
    )
    return replace(row, kind="proved") if holds else row


def _frozen_deviation(vertex: Vertex, differential: int) -> float:
    """Return the root mean square of the errors at one corner, by its Lyapunov equation."""
    M, B, Cz, _ = (part.midpoint for part in vertex(Ball))
    k = differential
    if k < len(M):
        below = np.linalg.solve(M[k:, k:], M[k:, :k])
        M, Cz = M[:k, :k] - M[:k, k:] @ below, Cz[:, :k] - Cz[:, k:] @ below
    if not np.isfinite(M).all() or not abscissa(M, 0.0) < 0.0:
        return float("inf")
    covariance = continuous_lyapunov(M, -B[:k] @ B[:k].T)
    return float(np.sqrt(max(np.trace(Cz @ covariance @ Cz.T), 0.0)))

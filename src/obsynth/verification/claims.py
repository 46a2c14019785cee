"""Claims: a closed list, each covered by a row; the recovery of states; fault estimates that are means.

A claim that is not on the list, or whose row is not in the report, fails: it would be printed, and nobody checked it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from obsynth.numerics.arguments import is_number
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.linear.means import unaveraged
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.noise import noise_words
from obsynth.plants.transformations.recovery import StateRecovery
from obsynth.proofs.covariances import certain_noise_covariance
from obsynth.results.checks import Check, information, nothing_wrong, upper_bound_check
from obsynth.results.design import Certificate, ObserverDesign
from obsynth.verification.error_system import ErrorModel
from obsynth.verification.identities import EQUALITY_TOLERANCE

#: Gains smaller than this are compared as they are.
LEAST_GAIN_SIZE = 1e-12

#: Every claim a fault-estimation filter can make.
KNOWN_CLAIMS = ("gamma", "gamma_min", "gamma_bracket_low", "gamma_bracket_high", "state_lag")

#: Gains are norms found in different coordinates: they may be out of order by this share of the claimed one.
ORDER_TOLERANCE = 1e-6

#: Why a variance is not known.
UNCERTAIN = "at rounding level: two ways of computing it disagree"

#: In place of a row: what the search stated, which no check recomputes.  Such a claim has a row that says so.
STATED_BY_SEARCH = "stated by the search"

#: Matrices that the certificate of any linear design may hold, with the rows that cover them.
WITNESS_CLAIMS: Mapping[str, str] = {
    "state_error": "stored numbers: states",
    "input_error": "stored numbers: inputs",
    "disturbance_error": "stored numbers: disturbances",
}


def claimed(claims: Mapping[str, Any], name: str) -> float:
    """Return a claim as a number; NaN where it is missing or none."""
    value = claims.get(name)
    return float(value) if value is not None and is_number(value) else math.nan


def claim_rows(plant: DescriptorSystem, claims: Mapping[str, Any]) -> Iterator[Check]:
    """Yield the rows on what is claimed: known names, numbers, and gains in order."""
    needed = {"state_lag"} | ({"gamma"} if plant.nd else set())
    # Both ends of a bracket, and what lies in it, or none of them.
    bracketed = bool({"gamma_bracket_low", "gamma_bracket_high"} & claims.keys())
    needed |= set(KNOWN_CLAIMS[:4]) if bracketed else set()
    wrong = [name for name in claims if name not in KNOWN_CLAIMS or not math.isfinite(claimed(claims, name))]
    wrong += sorted(needed - claims.keys())
    if "gamma" in claims and not claimed(claims, "gamma") > 0.0 and "gamma" not in wrong:
        wrong.append("gamma")
    yield nothing_wrong(
        "claims", "every claim is known and a finite number, and none is missing", wrong, source="certificate"
    )
    if "gamma_min" in claims or bracketed:
        yield upper_bound_check(
            "claimed gains",
            "0 <= bracket's lower end <= gamma_min <= its upper end, and gamma_min <= gamma",
            _disorder(claims, bracketed=bracketed),
            ORDER_TOLERANCE,
            source="certificate; whether a filter reaches less is said by the row 'least gain'",
            detail="the largest step backwards, as a share of gamma",
        )


def _disorder(claims: Mapping[str, Any], *, bracketed: bool) -> float:
    """Return by how much the claimed gains are out of order, relative to gamma; NaN when one is no number."""
    gamma, least = claimed(claims, "gamma"), claimed(claims, "gamma_min")
    steps = [least - gamma, -least]
    if bracketed:
        low, high = claimed(claims, "gamma_bracket_low"), claimed(claims, "gamma_bracket_high")
        steps += [low - least, least - high, -low]
    if not all(map(math.isfinite, steps)) or not gamma > 0.0:
        return math.nan
    return max(0.0, *steps) / gamma


def recovery_rows(plant: DescriptorSystem, recovery: StateRecovery | None) -> Iterator[Check]:
    """Yield the rows on the map back to the states of the plant before its transformation, where there is one."""
    if recovery is None:
        return
    wrong = _misfits(plant, recovery)
    source = "the plant; the one before its transformation is not stored"
    yield nothing_wrong(
        "recovery fits",
        "the map back to the original states has unique names, the plant's signals and finite entries",
        wrong,
        source=source,
    )
    if wrong:
        return
    names = [name for name in recovery.names if name in plant.state_names]
    states = np.hstack(
        [
            recovery.from_state,
            recovery.from_input,
            recovery.from_fault,
            recovery.from_disturbance,
            recovery.from_noise,
        ]
    )
    rows = [recovery.names.index(name) for name in names]
    expected = np.eye(plant.nx, states.shape[1])[[plant.state_names.index(name) for name in names]]
    yield upper_bound_check(
        "recovery of kept states",
        "a state that the plant still has is recovered as itself",
        float(np.max(np.abs(states[rows] - expected), initial=0.0)),
        EQUALITY_TOLERANCE,
        source=source,
        kind="equality",
        detail=f"{len(names)} of {len(recovery.names)} states; how the others follow from these is not checked",
    )


def _misfits(plant: DescriptorSystem, recovery: StateRecovery) -> list[str]:
    names = recovery.names
    valid = isinstance(names, tuple) and all(isinstance(name, str) and name.strip() for name in names)
    wrong = [] if valid and len(set(names)) == len(names) else ["names"]
    widths = {
        "from_state": plant.nx,
        "from_input": plant.nu,
        "from_fault": plant.nf,
        "from_disturbance": plant.nd,
        "from_noise": plant.nw,
    }
    for field, width in widths.items():
        matrix = getattr(recovery, field)
        if matrix.shape != (len(names), width) or not np.all(np.isfinite(matrix)):
            wrong.append(field)
    noise = recovery.noise_kept
    if noise.ndim != 2 or noise.shape[1] != plant.nw or not np.all(np.isfinite(noise)):
        wrong.append("noise_kept")
    return wrong


def closed_claims(
    design: ObserverDesign,
    rows: Iterable[Check],
    covered: Mapping[str, str],
    meanings: Mapping[str, str],
    witnesses: frozenset[str],
) -> Iterator[Check]:
    """Yield the row on claims that no row covers (``covered``, by claim), and one for each that is only stated."""
    # Where a row fails already nothing more is said: a report that ends early covers little.
    listed = tuple(rows)
    if not all(row.passed for row in listed):
        return
    names = {row.name for row in listed}
    claims = design.certificate.claims
    wrong = []
    for name, value in claims.items():
        # Of a bank each test has its claims, "threshold[leak]", and its rows.
        own, mark, which = name.partition("[")
        row = covered.get(own)
        row = f"{row}{mark}{which}" if row and row != STATED_BY_SEARCH else row
        # NaN claims nothing: a number that this design does not have.
        number = is_number(value) and not math.isinf(value)
        if not row or not number or (row != STATED_BY_SEARCH and row not in names):
            wrong.append(str(name))
    for name in design.certificate.matrices:
        if name not in witnesses and WITNESS_CLAIMS.get(name) not in names:
            wrong.append(str(name))
    yield upper_bound_check(
        "claims covered",
        "every claim is one that this method can make, and a row of this report checks it",
        float(len(wrong)),
        0.0,
        source="certificate",
        detail=f"not covered: {', '.join(wrong)}" if wrong else "",
    )
    for name, value in claims.items():
        own = name.partition("[")[0]
        if covered.get(own) == STATED_BY_SEARCH and name not in wrong:
            yield information(
                f"stated: {name}",
                f"{meanings[own]}; stated by the search, not recomputed",
                float(value),
                source="certificate",
                status="assumed",
            )


def before_the_mean(design: ObserverDesign) -> tuple[ObserverDesign, tuple[Check, ...]]:
    """Return the design without its mean, and the row that says that nothing else was done to it."""
    mean = design.options.get("mean", 1)
    if mean == 1:
        return design, ()
    _, observer = design.linear
    base = unaveraged(observer, mean) if isinstance(mean, int) and mean > 1 else None
    tracking = design.certificate.matrices.get("tracking")
    fitting = base is not None and tracking is not None and len(tracking) == observer.order
    row = upper_bound_check(
        "mean",
        f"each fault estimate is exactly the mean of the last {mean} estimates of the filter that is checked below",
        float(not fitting),
        0.0,
        source="shipped realisation",
    )
    if base is None or tracking is None or not fitting:
        return design, (row,)
    matrices = {**design.certificate.matrices, "tracking": tracking[: base.order]}
    return replace(design, observer=base, certificate=Certificate(matrices, design.certificate.claims)), (row,)


def fault_noise_rows(errors: ErrorModel) -> Iterator[Check]:
    """Yield the deviation of each fault estimate under the noise that the plant states."""
    plant = errors.plant
    if not plant.nw:
        return
    to_faults, _, _, direct = errors.fault_output
    # What noise does to an estimate at once has no finite variance in continuous time, and is left out.
    direct_noise = direct if plant.dt > 0.0 else 0.0 * direct
    covariance = certain_noise_covariance(errors.Az, errors.noise, to_faults, direct_noise, plant.dt)
    for name, variance in zip(plant.fault_names, np.diag(covariance), strict=True):
        yield information(
            f"noise in fhat[{name}]",
            f"standard deviation of the fault estimate under {noise_words(plant.noise_names)}"
            + ("" if plant.dt else ", for a sample time of 1 s (times its root for others)"),
            float(np.sqrt(variance)),
            source="recomputed, Lyapunov equation",
            detail=UNCERTAIN if np.isnan(variance) else plant.units.get(name, ""),
        )


def mean_noise_rows(design: ObserverDesign) -> Iterator[Check]:
    """Yield the deviation of each averaged estimate under the stated noise."""
    plant, observer = design.linear
    mean, tracking = design.options.get("mean", 1), design.certificate.matrices.get("tracking")
    if mean == 1 or not plant.nw or tracking is None or len(tracking) != observer.order:
        return
    rows = observer.fault_rows
    errors = ErrorModel(plant, observer, tracking)
    covariance = certain_noise_covariance(errors.Az, errors.noise, -observer.Cz[rows], errors.output(rows)[3], plant.dt)
    for name, variance in zip(observer.fault_names, np.diag(covariance), strict=True):
        yield information(
            f"noise in the mean of fhat[{name}]",
            f"standard deviation under {noise_words(plant.noise_names)} of what is shipped, a mean of {mean}",
            float(np.sqrt(max(float(variance), 0.0))),
            source="recomputed, Lyapunov equation",
        )


def listed_gains(
    design: ObserverDesign, recomputed: Mapping[str, FloatArray], *, tolerance: float = EQUALITY_TOLERANCE
) -> Check:
    """Return the row on the listed gains, which run; of a recursion they are those of the last step looked at.

    A gain set lists all of them or none."""
    wrong = sorted(design.gains.keys() ^ recomputed.keys()) if design.gains else []
    gap = 0.0
    for letter, matrix in recomputed.items():
        listed = design.gains.get(letter, matrix)
        if listed.shape != matrix.shape:
            wrong.append(letter)
        elif matrix.size:
            size = max(float(np.max(np.abs(matrix))), LEAST_GAIN_SIZE)
            # `max` would take a gain that is no number as none at all.
            gap = float(np.maximum(gap, np.max(np.abs(listed - matrix)) / size))
    return upper_bound_check(
        "gains",
        "the listed gains are those that run",
        np.inf if wrong else gap,
        tolerance,
        source="gain set",
        kind="equality",
        detail=f"wrong: {', '.join(wrong)}" if wrong else "",
    )

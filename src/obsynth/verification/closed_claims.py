"""The closed list of what each method may claim, and which row of the report covers each claim.

A claim that is not on the list, or whose row is not in the report, fails: it would be printed, and nobody checked it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from typing import TYPE_CHECKING

from obsynth.results.report import Check, information, upper_bound_check

if TYPE_CHECKING:
    from obsynth.results.design import ObserverDesign

#: In place of a row: what the search stated, which no check recomputes.  Such a claim has a row of its own that says so.
STATED = "stated by the search"

_RECURSIVE: Mapping[str, str] = {
    "condition": "claims", "condition_k": "claims", "residual_directions": "claims", "contraction": "claims",
    "steps": "claims", "excitation": "claims", "excitation_k": "claims",
}  # fmt: skip
_STORED: Mapping[str, str] = {"state_error": "stored numbers: states", "input_error": "stored numbers: inputs"}
#: Method id -> claim -> the row that covers it.
COVERED: Mapping[str, Mapping[str, str]] = {
    "fault-estimation-filter": {
        "gamma": "LMI", "gamma_min": "claimed gains", "gamma_bracket_low": "claimed gains",
        "gamma_bracket_high": "claimed gains", "state_lag": "unbiased: state",
    },
    "pd-observer": {
        "theorem": "LMI", "delta": "LMI", "decay": "LMI", "disk_centre": "disk", "disk_radius": "disk",
        "gain_bound": "gain bound", "fault_rate_gain": "LMI, rate", "noise_gain": "LMI, noise",
        "adaptation_low": "adaptation range", "adaptation_high": "adaptation range",
    },
    "ui-pi-observer": {
        "decay": "decay", "noise_amplification": "noise amplification", "noise_price": STATED, "condition": STATED,
    },
    "descriptor-kalman": _RECURSIVE,
    "adaptive-observer": _RECURSIVE,
    "dae-adaptive-observer": {"index": "claims", "condition": "claims", "contraction": "claims", "steps": "claims"},
}  # fmt: skip
_MEANING = {
    "noise_price": "noise of the fault estimates against the quietest Kalman filter that the search found",
    "condition": "condition number of the eigenvectors that the placement found",
}
#: Method id -> matrices that a certificate may hold.
WITNESSES: Mapping[str, frozenset[str]] = {
    "fault-estimation-filter": frozenset({"P_factor", "tracking", "T0"}),
    "pd-observer": frozenset({"P1", "P3", "P_rate", "P_noise", "P1_low", "P1_high", "T0"}),
    "ui-pi-observer": frozenset({"tracking", "Phi", "Cw", "poles", "stability", "T0"}),
}
#: Matrices that any certificate of a linear design may hold, with the rows that cover them.
WITNESS_CLAIMS: Mapping[str, str] = _STORED


def closed_claims(design: ObserverDesign, rows: Iterable[Check]) -> Iterator[Check]:
    """Yield the row on claims that nothing covers, and one for each claim that is stated and not checked.

    Where a row fails already nothing more is said: a report that ends early covers little.
    """
    given = tuple(rows)
    if not all(row.passed for row in given):
        return
    names = {row.name for row in given}
    known, claims = COVERED.get(design.method, {}), design.certificate.claims
    wrong = []
    for name, value in claims.items():
        row = known.get(name)
        number = isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
        if row is None or not number or (row != STATED and row not in names):
            wrong.append(str(name))
    witnesses = WITNESSES.get(design.method)
    if witnesses is not None:
        for name in design.certificate.matrices:
            row = WITNESS_CLAIMS.get(name)
            if name not in witnesses and (row is None or row not in names):
                wrong.append(str(name))
    elif design.certificate.matrices:
        wrong += list(design.certificate.matrices)
    yield upper_bound_check(
        "claims covered", "every claim is one that this method can make, and a row of this report checks it",
        float(len(wrong)), 0.0, source="certificate",
        detail=f"not covered: {', '.join(wrong)}" if wrong else "",
    )  # fmt: skip
    for name, value in claims.items():
        if known.get(name) == STATED and name not in wrong:
            yield information(
                f"stated: {name}", f"{_MEANING[name]}; stated by the search, not recomputed", float(value),
                source="certificate", status="assumed",
            )  # fmt: skip

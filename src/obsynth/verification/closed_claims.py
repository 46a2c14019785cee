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

#: In place of a row: what the search stated, which no check recomputes.  Such a claim has a row that says so.
STATED = "stated by the search"

#: Matrices that the certificate of any linear design may hold, with the rows that cover them.
WITNESS_CLAIMS: Mapping[str, str] = {
    "state_error": "stored numbers: states", "input_error": "stored numbers: inputs",
    "disturbance_error": "stored numbers: disturbances",
}  # fmt: skip


def closed_claims(
    design: ObserverDesign, rows: Iterable[Check], covered: Mapping[str, str], meanings: Mapping[str, str],
    witnesses: frozenset[str],
) -> Iterator[Check]:  # fmt: skip
    """Yield the row on claims that nothing covers, and one for each claim that is stated and not checked.

    ``covered`` and ``meanings`` are by claim: the row that checks it, and what it means.

    Where a row fails already nothing more is said: a report that ends early covers little.
    """
    given = tuple(rows)
    if not all(row.passed for row in given):
        return
    names = {row.name for row in given}
    claims = design.certificate.claims
    wrong = []
    for name, value in claims.items():
        row = covered.get(name)
        # NaN claims nothing: a number that this design does not have.
        number = isinstance(value, (int, float)) and not isinstance(value, bool) and not math.isinf(value)
        if not row or not number or (row != STATED and row not in names):
            wrong.append(str(name))
    for name in design.certificate.matrices:
        if name not in witnesses and WITNESS_CLAIMS.get(name) not in names:
            wrong.append(str(name))
    yield upper_bound_check(
        "claims covered", "every claim is one that this method can make, and a row of this report checks it",
        float(len(wrong)), 0.0, source="certificate",
        detail=f"not covered: {', '.join(wrong)}" if wrong else "",
    )  # fmt: skip
    for name, value in claims.items():
        if covered.get(name) == STATED and name not in wrong:
            yield information(
                f"stated: {name}", f"{meanings[name]}; stated by the search, not recomputed", float(value),
                source="certificate", status="assumed",
            )  # fmt: skip

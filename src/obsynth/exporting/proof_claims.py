"""Claims of a design that are collected for a proof file, and the names of those that are left out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from obsynth.results.design import ObserverDesign


@dataclass
class ProofClaims:
    """What a proof file claims of a design.

    Parameters
    ----------
    design : ObserverDesign
        As it is.
    claims : list of dict
        With what proves them.
    not_covered : list of str
        What the design claims besides.
    witness : dict, optional
        The contraction that claims share, where one was found.
    """

    design: ObserverDesign
    claims: list[dict[str, Any]] = field(default_factory=list)
    not_covered: list[str] = field(default_factory=list)
    witness: dict[str, Any] | None = None

    def add(self, name: str, claim: Mapping[str, Any] | None) -> None:
        """Add a claim, or its name to what is not covered where there is no proof of it."""
        if claim is None:
            self.not_covered.append(name)
        else:
            self.claims.append(dict(claim))

    def leave_the_source(self) -> None:
        """Name the way from the plant as written, where there is one, among what is not covered."""
        if self.design.source is not None:
            self.not_covered.append(
                "that the plant follows from the plant as written (elimination, sampling): `obsynth verify` repeats it"
            )

"""Designs with other numbers than were proved: what every table of corruptions is made of."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from obsynth import Certificate, ObserverDesign


def with_matrices(design: ObserverDesign, **changed: Any) -> ObserverDesign:
    """Return the design with other matrices in its certificate."""
    known = design.certificate
    return design.replace(certificate=Certificate({**known.matrices, **changed}, known.claims))


def with_claims(design: ObserverDesign, **changed: float) -> ObserverDesign:
    """Return the design with other claims."""
    known = design.certificate
    return design.replace(certificate=Certificate(known.matrices, {**known.claims, **changed}))


def with_observer(design: ObserverDesign, **changed: Any) -> ObserverDesign:
    """Return the design with other fields of its observer."""
    return design.replace(observer=replace(design.observer, **changed))  # type: ignore[type-var]

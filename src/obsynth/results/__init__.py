"""Results: the design, its report, and files of them."""

from obsynth.results.checks import Check, VerificationReport
from obsynth.results.design import Certificate, ObserverDesign

__all__ = ["Certificate", "Check", "ObserverDesign", "VerificationReport"]

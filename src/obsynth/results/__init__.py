"""Results: the design, its report, and files of them."""

from obsynth.results.checks import Check
from obsynth.results.design import Certificate, ObserverDesign, VerificationReport

__all__ = ["Certificate", "Check", "ObserverDesign", "VerificationReport"]

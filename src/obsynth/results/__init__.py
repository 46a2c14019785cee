"""Results: the design, its report, and files of them."""

from obsynth.results.design import Certificate, ObserverDesign
from obsynth.results.report import Check, VerificationReport

__all__ = ["Certificate", "Check", "ObserverDesign", "VerificationReport"]

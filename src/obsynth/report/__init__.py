"""Readable reports: tables of a design, its checks, and the structure of a plant."""

from obsynth.report.designs import design_report, verification_report
from obsynth.report.plants import check_report

__all__ = ["check_report", "design_report", "verification_report"]

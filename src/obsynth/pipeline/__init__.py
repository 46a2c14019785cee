"""The doors: analyse, synthesise, verify, and hand over an `ObserverDesign`."""

from obsynth.pipeline.doors import check, design, fault_estimation_filter, fault_estimation_filter_from_gains

__all__ = ["check", "design", "fault_estimation_filter", "fault_estimation_filter_from_gains"]

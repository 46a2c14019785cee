"""obsynth: designs, proves and runs observers and fault-estimation filters for descriptor systems."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from obsynth.analysis.structure import analyse_structure
    from obsynth.analysis.transformations import discretise, eliminate_algebraic_states
    from obsynth.errors import (
        InfeasibleError,
        ObsynthError,
        PreconditionError,
        SolverError,
        SpecError,
        VerificationError,
    )
    from obsynth.models.descriptor import DescriptorSystem
    from obsynth.models.time_varying import TimeVaryingDescriptorSystem
    from obsynth.observers.linear import Estimates, LinearObserver, RunningObserver
    from obsynth.observers.sampling import sample_observer
    from obsynth.pipeline.designing import design
    from obsynth.pipeline.fault_estimation_filter import fault_estimation_filter, fault_estimation_filter_from_gains
    from obsynth.results.design import Certificate, ObserverDesign
    from obsynth.results.report import Check, VerificationReport
    from obsynth.results.serialise import load
    from obsynth.verification import verify

__version__ = "0.1.0"

# Names are imported when they are first used, so that `import obsynth` stays fast.
_HOMES = {
    "Certificate": "obsynth.results.design",
    "Check": "obsynth.results.report",
    "DescriptorSystem": "obsynth.models.descriptor",
    "Estimates": "obsynth.observers.linear",
    "InfeasibleError": "obsynth.errors",
    "LinearObserver": "obsynth.observers.linear",
    "ObserverDesign": "obsynth.results.design",
    "ObsynthError": "obsynth.errors",
    "PreconditionError": "obsynth.errors",
    "RunningObserver": "obsynth.observers.linear",
    "SolverError": "obsynth.errors",
    "SpecError": "obsynth.errors",
    "TimeVaryingDescriptorSystem": "obsynth.models.time_varying",
    "VerificationError": "obsynth.errors",
    "VerificationReport": "obsynth.results.report",
    "analyse_structure": "obsynth.analysis.structure",
    "design": "obsynth.pipeline.designing",
    "discretise": "obsynth.analysis.transformations",
    "eliminate_algebraic_states": "obsynth.analysis.transformations",
    "fault_estimation_filter": "obsynth.pipeline.fault_estimation_filter",
    "fault_estimation_filter_from_gains": "obsynth.pipeline.fault_estimation_filter",
    "load": "obsynth.results.serialise",
    "sample_observer": "obsynth.observers.sampling",
    "verify": "obsynth.verification",
}

__all__ = [
    "Certificate",
    "Check",
    "DescriptorSystem",
    "Estimates",
    "InfeasibleError",
    "LinearObserver",
    "ObserverDesign",
    "ObsynthError",
    "PreconditionError",
    "RunningObserver",
    "SolverError",
    "SpecError",
    "TimeVaryingDescriptorSystem",
    "VerificationError",
    "VerificationReport",
    "analyse_structure",
    "design",
    "discretise",
    "eliminate_algebraic_states",
    "fault_estimation_filter",
    "fault_estimation_filter_from_gains",
    "load",
    "sample_observer",
    "verify",
]


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(import_module(_HOMES[name]), name)
    raise AttributeError(f"module 'obsynth' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])

"""obsynth: designs, proves and runs observers and fault-estimation filters for descriptor systems."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from obsynth.analysis.dae_identifiability import Identifiability, identifiability
    from obsynth.analysis.structure import analyse_structure
    from obsynth.analysis.transformations import discretise, eliminate_algebraic_states
    from obsynth.data.run import DataRun, run_on_data
    from obsynth.errors import (
        InfeasibleError,
        ObsynthError,
        PreconditionError,
        SolverError,
        SpecError,
        VerificationError,
    )
    from obsynth.evaluation.intervals import Interval
    from obsynth.evaluation.making_online import online_monitor
    from obsynth.evaluation.monitors import Detection, Monitor
    from obsynth.evaluation.monte_carlo import Evaluation, evaluate
    from obsynth.evaluation.online import OnlineMonitor
    from obsynth.evaluation.recursive_monte_carlo import ParameterMonitor
    from obsynth.evaluation.recursive_simulating import RecursiveSimulation
    from obsynth.evaluation.simulating import Simulation, simulate
    from obsynth.evaluation.watching import monitor
    from obsynth.exporting.files import export
    from obsynth.models.dae import DAEModel
    from obsynth.models.descriptor import DescriptorSystem
    from obsynth.models.fault_models import FaultModel, fault_model
    from obsynth.models.time_varying import TimeVaryingDescriptorSystem
    from obsynth.observers.alarms import Alarm, Decision
    from obsynth.observers.batches import run_batch
    from obsynth.observers.dae import DAEObserver
    from obsynth.observers.dae_batch import DAEBatchEstimates
    from obsynth.observers.dae_estimates import DAEEstimates
    from obsynth.observers.dae_running import RunningDAEObserver
    from obsynth.observers.decisions import decide
    from obsynth.observers.gain_schedule import BatchEstimates
    from obsynth.observers.linear import Estimates, LinearObserver, RunningObserver
    from obsynth.observers.recursive import Adaptation, RecursiveObserver
    from obsynth.observers.recursive_estimates import RecursiveEstimates
    from obsynth.observers.recursive_running import RunningRecursiveObserver
    from obsynth.observers.sampling import sample_observer
    from obsynth.pipeline.adaptive_observer import adaptive_observer
    from obsynth.pipeline.dae_adaptive_observer import dae_adaptive_observer
    from obsynth.pipeline.descriptor_kalman import descriptor_kalman
    from obsynth.pipeline.designing import design
    from obsynth.pipeline.fault_estimation_filter import fault_estimation_filter, fault_estimation_filter_from_gains
    from obsynth.pipeline.pd_observer import (
        apply_adaptation_gain,
        pd_delta_scan,
        pd_observer,
        pd_observer_from_gains,
    )
    from obsynth.pipeline.ui_pi_observer import ui_pi_observer, ui_pi_observer_from_gains
    from obsynth.report.page import html_report
    from obsynth.results.delta_scan import DeltaScan
    from obsynth.results.design import Certificate, ObserverDesign
    from obsynth.results.report import Check, VerificationReport
    from obsynth.results.serialise import load
    from obsynth.simulation.dae import DAETrajectory, simulate_dae
    from obsynth.simulation.failures import Gaussian, LostEffectiveness, Stuck, Uniform
    from obsynth.simulation.profiles import Drift, Intermittent, Ramp, Sine, Step
    from obsynth.simulation.scenario import Scenario
    from obsynth.simulation.time_varying import simulate_time_varying
    from obsynth.synthesis.steady_filter import SteadyState, steady_state_filter
    from obsynth.verification import verify
    from obsynth.verification.fault_tracking import fault_response

__version__ = "0.1.0"

# Names are imported when they are first used, so that `import obsynth` stays fast.
_HOMES = {
    "dae_adaptive_observer": "obsynth.pipeline.dae_adaptive_observer",
    "DAETrajectory": "obsynth.simulation.dae",
    "simulate_dae": "obsynth.simulation.dae",
    "DAEBatchEstimates": "obsynth.observers.dae_batch",
    "DAEEstimates": "obsynth.observers.dae_estimates",
    "RunningDAEObserver": "obsynth.observers.dae_running",
    "DAEObserver": "obsynth.observers.dae",
    "Identifiability": "obsynth.analysis.dae_identifiability",
    "identifiability": "obsynth.analysis.dae_identifiability",
    "DAEModel": "obsynth.models.dae",
    "Adaptation": "obsynth.observers.recursive",
    "Alarm": "obsynth.observers.alarms",
    "BatchEstimates": "obsynth.observers.gain_schedule",
    "Certificate": "obsynth.results.design",
    "Check": "obsynth.results.report",
    "DataRun": "obsynth.data.run",
    "Decision": "obsynth.observers.alarms",
    "DeltaScan": "obsynth.results.delta_scan",
    "DescriptorSystem": "obsynth.models.descriptor",
    "Detection": "obsynth.evaluation.monitors",
    "Drift": "obsynth.simulation.profiles",
    "Estimates": "obsynth.observers.linear",
    "Evaluation": "obsynth.evaluation.monte_carlo",
    "FaultModel": "obsynth.models.fault_models",
    "Gaussian": "obsynth.simulation.failures",
    "InfeasibleError": "obsynth.errors",
    "Intermittent": "obsynth.simulation.profiles",
    "Interval": "obsynth.evaluation.intervals",
    "LinearObserver": "obsynth.observers.linear",
    "LostEffectiveness": "obsynth.simulation.failures",
    "Monitor": "obsynth.evaluation.monitors",
    "ObserverDesign": "obsynth.results.design",
    "OnlineMonitor": "obsynth.evaluation.online",
    "ObsynthError": "obsynth.errors",
    "ParameterMonitor": "obsynth.evaluation.recursive_monte_carlo",
    "PreconditionError": "obsynth.errors",
    "Ramp": "obsynth.simulation.profiles",
    "RecursiveEstimates": "obsynth.observers.recursive_estimates",
    "RecursiveObserver": "obsynth.observers.recursive",
    "RecursiveSimulation": "obsynth.evaluation.recursive_simulating",
    "RunningObserver": "obsynth.observers.linear",
    "RunningRecursiveObserver": "obsynth.observers.recursive_running",
    "Scenario": "obsynth.simulation.scenario",
    "Simulation": "obsynth.evaluation.simulating",
    "Sine": "obsynth.simulation.profiles",
    "SolverError": "obsynth.errors",
    "SpecError": "obsynth.errors",
    "SteadyState": "obsynth.synthesis.steady_filter",
    "Step": "obsynth.simulation.profiles",
    "Stuck": "obsynth.simulation.failures",
    "TimeVaryingDescriptorSystem": "obsynth.models.time_varying",
    "Uniform": "obsynth.simulation.failures",
    "VerificationError": "obsynth.errors",
    "VerificationReport": "obsynth.results.report",
    "adaptive_observer": "obsynth.pipeline.adaptive_observer",
    "analyse_structure": "obsynth.analysis.structure",
    "apply_adaptation_gain": "obsynth.pipeline.pd_observer",
    "decide": "obsynth.observers.decisions",
    "descriptor_kalman": "obsynth.pipeline.descriptor_kalman",
    "design": "obsynth.pipeline.designing",
    "discretise": "obsynth.analysis.transformations",
    "eliminate_algebraic_states": "obsynth.analysis.transformations",
    "evaluate": "obsynth.evaluation.monte_carlo",
    "export": "obsynth.exporting.files",
    "fault_estimation_filter": "obsynth.pipeline.fault_estimation_filter",
    "fault_estimation_filter_from_gains": "obsynth.pipeline.fault_estimation_filter",
    "fault_model": "obsynth.models.fault_models",
    "fault_response": "obsynth.verification.fault_tracking",
    "html_report": "obsynth.report.page",
    "load": "obsynth.results.serialise",
    "monitor": "obsynth.evaluation.watching",
    "online_monitor": "obsynth.evaluation.making_online",
    "pd_delta_scan": "obsynth.pipeline.pd_observer",
    "pd_observer": "obsynth.pipeline.pd_observer",
    "pd_observer_from_gains": "obsynth.pipeline.pd_observer",
    "run_batch": "obsynth.observers.batches",
    "run_on_data": "obsynth.data.run",
    "sample_observer": "obsynth.observers.sampling",
    "simulate": "obsynth.evaluation.simulating",
    "simulate_time_varying": "obsynth.simulation.time_varying",
    "steady_state_filter": "obsynth.synthesis.steady_filter",
    "ui_pi_observer": "obsynth.pipeline.ui_pi_observer",
    "ui_pi_observer_from_gains": "obsynth.pipeline.ui_pi_observer",
    "verify": "obsynth.verification",
}

__all__ = [
    "Adaptation",
    "Alarm",
    "BatchEstimates",
    "Certificate",
    "Check",
    "DAEBatchEstimates",
    "DAEEstimates",
    "DAEModel",
    "DAEObserver",
    "DAETrajectory",
    "DataRun",
    "Decision",
    "DeltaScan",
    "DescriptorSystem",
    "Detection",
    "Drift",
    "Estimates",
    "Evaluation",
    "FaultModel",
    "Gaussian",
    "Identifiability",
    "InfeasibleError",
    "Intermittent",
    "Interval",
    "LinearObserver",
    "LostEffectiveness",
    "Monitor",
    "ObserverDesign",
    "ObsynthError",
    "OnlineMonitor",
    "ParameterMonitor",
    "PreconditionError",
    "Ramp",
    "RecursiveEstimates",
    "RecursiveObserver",
    "RecursiveSimulation",
    "RunningDAEObserver",
    "RunningObserver",
    "RunningRecursiveObserver",
    "Scenario",
    "Simulation",
    "Sine",
    "SolverError",
    "SpecError",
    "SteadyState",
    "Step",
    "Stuck",
    "TimeVaryingDescriptorSystem",
    "Uniform",
    "VerificationError",
    "VerificationReport",
    "adaptive_observer",
    "analyse_structure",
    "apply_adaptation_gain",
    "dae_adaptive_observer",
    "decide",
    "descriptor_kalman",
    "design",
    "discretise",
    "eliminate_algebraic_states",
    "evaluate",
    "export",
    "fault_estimation_filter",
    "fault_estimation_filter_from_gains",
    "fault_model",
    "fault_response",
    "html_report",
    "identifiability",
    "load",
    "monitor",
    "online_monitor",
    "pd_delta_scan",
    "pd_observer",
    "pd_observer_from_gains",
    "run_batch",
    "run_on_data",
    "sample_observer",
    "simulate",
    "simulate_dae",
    "simulate_time_varying",
    "steady_state_filter",
    "ui_pi_observer",
    "ui_pi_observer_from_gains",
    "verify",
]


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(import_module(_HOMES[name]), name)
    raise AttributeError(f"module 'obsynth' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])

"""obsynth: designs, proves and runs observers and fault-estimation filters for descriptor systems.

Plants
    DescriptorSystem, TimeVaryingDescriptorSystem, DAEModel; from other tools: from_andes, from_control, from_fmu,
    from_matlab, from_modelica, from_pandas, from_scipy, from_sympy; from a spec: load_spec; changed by discretise,
    eliminate_algebraic_states.
What is possible
    check, analyse_structure, diagnose, identifiability.
Designs
    design, and one function for each method: fault_estimation_filter, pd_observer, ui_pi_observer, descriptor_kalman,
    adaptive_observer, dae_adaptive_observer; verify, load.
On data
    run_on_data, smooth, online_monitor, plotting.plot_data, html_report, export.
In simulation
    Scenario, simulate, monitor, evaluate, decide; plotting.
What is wrong
    SpecError, PreconditionError, InfeasibleError, SolverError, VerificationError, all of them ObsynthError.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from obsynth.analysis.diagnosis.banks import StructuredResidual
    from obsynth.analysis.diagnosis.decoupled import DecoupledPlant, decouple
    from obsynth.analysis.diagnosis.diagnosing import diagnose
    from obsynth.analysis.diagnosis.verdicts import Diagnosis, FaultDiagnosis
    from obsynth.analysis.identifiability import Identifiability, identifiability
    from obsynth.analysis.structure import analyse_structure
    from obsynth.analysis.transformations import discretise, eliminate_algebraic_states
    from obsynth.analysis.transformations.linearisation import linearise
    from obsynth.calibration.calibrating import calibrate
    from obsynth.calibration.result import CalibratedBox, Calibration
    from obsynth.calibration.validating import validate
    from obsynth.calibration.validation import Validation
    from obsynth.calibration.validity import Validity, validity
    from obsynth.comparison.comparing import compare
    from obsynth.comparison.result import ComparedMethod, Comparison, FaultComparison
    from obsynth.comparison.sensor_sets import SensorSet, SensorSets, sensor_sets
    from obsynth.data.alarm_proof import prove_alarm
    from obsynth.data.run import DataRun, run_on_data
    from obsynth.data.smoothing import smooth
    from obsynth.errors import (
        InfeasibleError,
        ObsynthError,
        PreconditionError,
        SolverError,
        SpecError,
        VerificationError,
    )
    from obsynth.experiments.alarm_proofs.certificate import verify_alarm
    from obsynth.experiments.alarm_proofs.proof import AlarmProof
    from obsynth.experiments.intervals import Interval
    from obsynth.experiments.monitors.monitor import Detection, Monitor
    from obsynth.experiments.monitors.online import OnlineMonitor
    from obsynth.experiments.monitors.online_monitor import online_monitor
    from obsynth.experiments.monitors.residual_monitor import monitor
    from obsynth.experiments.monte_carlo import Evaluation, evaluate
    from obsynth.experiments.simulation import Simulation, simulate
    from obsynth.experiments.simulation import Simulation as RecursiveSimulation
    from obsynth.exporting.files import export
    from obsynth.importing.andes import from_andes
    from obsynth.importing.fmu import from_fmu
    from obsynth.importing.matlab import from_matlab
    from obsynth.importing.matrices import from_pandas, from_sympy
    from obsynth.importing.modelica import from_modelica
    from obsynth.importing.state_space import from_control, from_scipy
    from obsynth.methods.adaptive_observer.public import adaptive_observer
    from obsynth.methods.choosing.figures import FaultFigures
    from obsynth.methods.dae_adaptive_observer.public import dae_adaptive_observer
    from obsynth.methods.descriptor_kalman.public import descriptor_kalman
    from obsynth.methods.designing import check, design
    from obsynth.methods.fault_estimation_filter.public import (
        fault_estimation_filter,
        fault_estimation_filter_from_gains,
    )
    from obsynth.methods.functional_filter.detection import DetectionFilter, detection_filter
    from obsynth.methods.functional_filter.public import functional_filter
    from obsynth.methods.pd_observer.public import (
        apply_adaptation_gain,
        pd_delta_scan,
        pd_observer,
        pd_observer_from_gains,
    )
    from obsynth.methods.recursive.steady_filter import SteadyState, steady_state_filter
    from obsynth.methods.ui_pi_observer.checks.fault_response import fault_response
    from obsynth.methods.ui_pi_observer.public import ui_pi_observer, ui_pi_observer_from_gains
    from obsynth.methods.verifying import verify
    from obsynth.observers.alarms import Alarm, Decision
    from obsynth.observers.batches import run_batch
    from obsynth.observers.dae.observer import DAEObserver
    from obsynth.observers.decisions import ParameterMonitor, decide
    from obsynth.observers.estimates import Estimates
    from obsynth.observers.estimates import Estimates as BatchEstimates
    from obsynth.observers.estimates import Estimates as DAEBatchEstimates
    from obsynth.observers.estimates import Estimates as DAEEstimates
    from obsynth.observers.estimates import Estimates as RecursiveEstimates
    from obsynth.observers.linear.observer import LinearObserver
    from obsynth.observers.linear.sampling import sample_observer
    from obsynth.observers.recursive.observer import RecursiveObserver
    from obsynth.observers.recursive.settings import Adaptation
    from obsynth.observers.running import RunningObserver
    from obsynth.observers.running import RunningObserver as RunningDAEObserver
    from obsynth.observers.running import RunningObserver as RunningRecursiveObserver
    from obsynth.plants.constants import Constant, ConstantsBox
    from obsynth.plants.dae.model import DAEModel
    from obsynth.plants.descriptor import DescriptorSystem
    from obsynth.plants.fault_models import FaultModel, fault_model
    from obsynth.plants.time_varying import TimeVaryingDescriptorSystem
    from obsynth.plants.uncertain_system import uncertain_system
    from obsynth.plants.uncertainty import Uncertainty
    from obsynth.report.page import html_report
    from obsynth.results.delta_scan import DeltaScan
    from obsynth.results.design import Certificate, ObserverDesign
    from obsynth.results.gain_sets import load
    from obsynth.results.report import Check, VerificationReport
    from obsynth.simulation.dae import simulate_dae
    from obsynth.simulation.failures import Gaussian, LostEffectiveness, Stuck, Uniform
    from obsynth.simulation.profiles import Drift, Intermittent, Ramp, Sine, Step
    from obsynth.simulation.scenario import Scenario
    from obsynth.simulation.time_varying import simulate_time_varying
    from obsynth.simulation.trajectory import Trajectory
    from obsynth.simulation.trajectory import Trajectory as DAETrajectory
    from obsynth.spec.loader import Spec, load_spec
    from obsynth.sweeps.fleet import Fleet, FleetRun, run_fleet
    from obsynth.tolerances.robustness import Robustness, robustness

__version__ = "0.1.0"

# Names are imported when they are first used, so that `import obsynth` stays fast; ``module:name`` is another name.
_HOMES = {
    "DetectionFilter": "obsynth.methods.functional_filter.detection",
    "detection_filter": "obsynth.methods.functional_filter.detection",
    "Fleet": "obsynth.sweeps.fleet",
    "FleetRun": "obsynth.sweeps.fleet",
    "run_fleet": "obsynth.sweeps.fleet",
    "ComparedMethod": "obsynth.comparison.result",
    "Comparison": "obsynth.comparison.result",
    "FaultComparison": "obsynth.comparison.result",
    "FaultFigures": "obsynth.methods.choosing.figures",
    "compare": "obsynth.comparison.comparing",
    "Validation": "obsynth.calibration.validation",
    "Validity": "obsynth.calibration.validity",
    "validate": "obsynth.calibration.validating",
    "validity": "obsynth.calibration.validity",
    "SensorSet": "obsynth.comparison.sensor_sets",
    "SensorSets": "obsynth.comparison.sensor_sets",
    "sensor_sets": "obsynth.comparison.sensor_sets",
    "functional_filter": "obsynth.methods.functional_filter.public",
    "CalibratedBox": "obsynth.calibration.result",
    "Calibration": "obsynth.calibration.result",
    "calibrate": "obsynth.calibration.calibrating",
    "linearise": "obsynth.analysis.transformations.linearisation",
    "DecoupledPlant": "obsynth.analysis.diagnosis.decoupled",
    "decouple": "obsynth.analysis.diagnosis.decoupled",
    "diagnose": "obsynth.analysis.diagnosis.diagnosing",
    "Diagnosis": "obsynth.analysis.diagnosis.verdicts",
    "FaultDiagnosis": "obsynth.analysis.diagnosis.verdicts",
    "StructuredResidual": "obsynth.analysis.diagnosis.banks",
    "dae_adaptive_observer": "obsynth.methods.dae_adaptive_observer.public",
    "DAETrajectory": "obsynth.simulation.trajectory:Trajectory",
    "Trajectory": "obsynth.simulation.trajectory",
    "Constant": "obsynth.plants.constants",
    "ConstantsBox": "obsynth.plants.constants",
    "Robustness": "obsynth.tolerances.robustness",
    "Uncertainty": "obsynth.plants.uncertainty",
    "robustness": "obsynth.tolerances.robustness",
    "AlarmProof": "obsynth.experiments.alarm_proofs.proof",
    "prove_alarm": "obsynth.data.alarm_proof",
    "verify_alarm": "obsynth.experiments.alarm_proofs.certificate",
    "uncertain_system": "obsynth.plants.uncertain_system",
    "simulate_dae": "obsynth.simulation.dae",
    "DAEBatchEstimates": "obsynth.observers.estimates:Estimates",
    "DAEEstimates": "obsynth.observers.estimates:Estimates",
    "RunningDAEObserver": "obsynth.observers.running:RunningObserver",
    "DAEObserver": "obsynth.observers.dae.observer",
    "Identifiability": "obsynth.analysis.identifiability",
    "identifiability": "obsynth.analysis.identifiability",
    "DAEModel": "obsynth.plants.dae.model",
    "Adaptation": "obsynth.observers.recursive.settings",
    "Alarm": "obsynth.observers.alarms",
    "BatchEstimates": "obsynth.observers.estimates:Estimates",
    "Certificate": "obsynth.results.design",
    "Check": "obsynth.results.report",
    "DataRun": "obsynth.data.run",
    "Decision": "obsynth.observers.alarms",
    "DeltaScan": "obsynth.results.delta_scan",
    "DescriptorSystem": "obsynth.plants.descriptor",
    "Detection": "obsynth.experiments.monitors.monitor",
    "Drift": "obsynth.simulation.profiles",
    "Estimates": "obsynth.observers.estimates",
    "Evaluation": "obsynth.experiments.monte_carlo",
    "FaultModel": "obsynth.plants.fault_models",
    "Gaussian": "obsynth.simulation.failures",
    "InfeasibleError": "obsynth.errors",
    "Intermittent": "obsynth.simulation.profiles",
    "Interval": "obsynth.experiments.intervals",
    "LinearObserver": "obsynth.observers.linear.observer",
    "LostEffectiveness": "obsynth.simulation.failures",
    "Monitor": "obsynth.experiments.monitors.monitor",
    "ObserverDesign": "obsynth.results.design",
    "OnlineMonitor": "obsynth.experiments.monitors.online",
    "ObsynthError": "obsynth.errors",
    "ParameterMonitor": "obsynth.observers.decisions",
    "PreconditionError": "obsynth.errors",
    "Ramp": "obsynth.simulation.profiles",
    "RecursiveEstimates": "obsynth.observers.estimates:Estimates",
    "RecursiveObserver": "obsynth.observers.recursive.observer",
    "RecursiveSimulation": "obsynth.experiments.simulation:Simulation",
    "RunningObserver": "obsynth.observers.running",
    "RunningRecursiveObserver": "obsynth.observers.running:RunningObserver",
    "Scenario": "obsynth.simulation.scenario",
    "Simulation": "obsynth.experiments.simulation",
    "Sine": "obsynth.simulation.profiles",
    "SolverError": "obsynth.errors",
    "Spec": "obsynth.spec.loader",
    "SpecError": "obsynth.errors",
    "SteadyState": "obsynth.methods.recursive.steady_filter",
    "Step": "obsynth.simulation.profiles",
    "Stuck": "obsynth.simulation.failures",
    "TimeVaryingDescriptorSystem": "obsynth.plants.time_varying",
    "Uniform": "obsynth.simulation.failures",
    "VerificationError": "obsynth.errors",
    "VerificationReport": "obsynth.results.report",
    "adaptive_observer": "obsynth.methods.adaptive_observer.public",
    "analyse_structure": "obsynth.analysis.structure",
    "apply_adaptation_gain": "obsynth.methods.pd_observer.public",
    "check": "obsynth.methods.designing",
    "decide": "obsynth.observers.decisions",
    "descriptor_kalman": "obsynth.methods.descriptor_kalman.public",
    "design": "obsynth.methods.designing",
    "discretise": "obsynth.analysis.transformations",
    "eliminate_algebraic_states": "obsynth.analysis.transformations",
    "evaluate": "obsynth.experiments.monte_carlo",
    "export": "obsynth.exporting.files",
    "fault_estimation_filter": "obsynth.methods.fault_estimation_filter.public",
    "fault_estimation_filter_from_gains": "obsynth.methods.fault_estimation_filter.public",
    "fault_model": "obsynth.plants.fault_models",
    "fault_response": "obsynth.methods.ui_pi_observer.checks.fault_response",
    "from_andes": "obsynth.importing.andes",
    "from_control": "obsynth.importing.state_space",
    "from_fmu": "obsynth.importing.fmu",
    "from_matlab": "obsynth.importing.matlab",
    "from_modelica": "obsynth.importing.modelica",
    "from_pandas": "obsynth.importing.matrices",
    "from_scipy": "obsynth.importing.state_space",
    "from_sympy": "obsynth.importing.matrices",
    "html_report": "obsynth.report.page",
    "load": "obsynth.results.gain_sets",
    "load_spec": "obsynth.spec.loader",
    "monitor": "obsynth.experiments.monitors.residual_monitor",
    "online_monitor": "obsynth.experiments.monitors.online_monitor",
    "pd_delta_scan": "obsynth.methods.pd_observer.public",
    "pd_observer": "obsynth.methods.pd_observer.public",
    "pd_observer_from_gains": "obsynth.methods.pd_observer.public",
    "run_batch": "obsynth.observers.batches",
    "run_on_data": "obsynth.data.run",
    "Sweep": "obsynth.sweeps.sweep",
    "SweepResult": "obsynth.sweeps.sweep",
    "sweep": "obsynth.sweeps.sweep",
    "sample_observer": "obsynth.observers.linear.sampling",
    "smooth": "obsynth.data.smoothing",
    "simulate": "obsynth.experiments.simulation",
    "simulate_time_varying": "obsynth.simulation.time_varying",
    "steady_state_filter": "obsynth.methods.recursive.steady_filter",
    "ui_pi_observer": "obsynth.methods.ui_pi_observer.public",
    "ui_pi_observer_from_gains": "obsynth.methods.ui_pi_observer.public",
    "verify": "obsynth.methods.verifying",
}

__all__ = [
    "Adaptation",
    "Alarm",
    "AlarmProof",
    "BatchEstimates",
    "CalibratedBox",
    "Calibration",
    "Certificate",
    "Check",
    "ComparedMethod",
    "Comparison",
    "Constant",
    "ConstantsBox",
    "DAEBatchEstimates",
    "DAEEstimates",
    "DAEModel",
    "DAEObserver",
    "DAETrajectory",
    "DataRun",
    "Decision",
    "DecoupledPlant",
    "DeltaScan",
    "DescriptorSystem",
    "Detection",
    "DetectionFilter",
    "Diagnosis",
    "Drift",
    "Estimates",
    "Evaluation",
    "FaultComparison",
    "FaultDiagnosis",
    "FaultFigures",
    "FaultModel",
    "Fleet",
    "FleetRun",
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
    "Robustness",
    "RunningDAEObserver",
    "RunningObserver",
    "RunningRecursiveObserver",
    "Scenario",
    "SensorSet",
    "SensorSets",
    "Simulation",
    "Sine",
    "SolverError",
    "Spec",
    "SpecError",
    "SteadyState",
    "Step",
    "StructuredResidual",
    "Stuck",
    "Sweep",
    "SweepResult",
    "TimeVaryingDescriptorSystem",
    "Trajectory",
    "Uncertainty",
    "Uniform",
    "Validation",
    "Validity",
    "VerificationError",
    "VerificationReport",
    "adaptive_observer",
    "analyse_structure",
    "apply_adaptation_gain",
    "calibrate",
    "check",
    "compare",
    "dae_adaptive_observer",
    "decide",
    "decouple",
    "descriptor_kalman",
    "design",
    "detection_filter",
    "diagnose",
    "discretise",
    "eliminate_algebraic_states",
    "evaluate",
    "export",
    "fault_estimation_filter",
    "fault_estimation_filter_from_gains",
    "fault_model",
    "fault_response",
    "from_andes",
    "from_control",
    "from_fmu",
    "from_matlab",
    "from_modelica",
    "from_pandas",
    "from_scipy",
    "from_sympy",
    "functional_filter",
    "html_report",
    "identifiability",
    "linearise",
    "load",
    "load_spec",
    "monitor",
    "online_monitor",
    "pd_delta_scan",
    "pd_observer",
    "pd_observer_from_gains",
    "prove_alarm",
    "robustness",
    "run_batch",
    "run_fleet",
    "run_on_data",
    "sample_observer",
    "sensor_sets",
    "simulate",
    "simulate_dae",
    "simulate_time_varying",
    "smooth",
    "steady_state_filter",
    "sweep",
    "ui_pi_observer",
    "ui_pi_observer_from_gains",
    "uncertain_system",
    "validate",
    "validity",
    "verify",
    "verify_alarm",
]


#: Packages whose names are used through them, such as ``obsynth.plotting.plot_data``.
_PACKAGES = ("plotting",)


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        module, _, other_name = _HOMES[name].partition(":")
        return getattr(import_module(module), other_name or name)
    if name in _PACKAGES:
        return import_module(f"obsynth.{name}")
    raise AttributeError(f"module 'obsynth' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*__all__, *_PACKAGES, "__version__"])

"""Types of the arguments and results of obsynth's functions, for annotations: ``obsynth.types.Simulation``."""

from importlib import import_module
from typing import Any

#: By the module that holds it, imported when a name is first used.
_TYPE_NAMES = {
    "analysis.dae_structure": "Identifiability",
    "analysis.diagnosis.decoupled": "DecoupledPlant",
    "analysis.diagnosis.verdicts": "Diagnosis FaultDiagnosis StructuredResidual",
    "methods.detection_filter.public": "DetectionFilter",
    "observers.recursive.steady_filter": "SteadyState",
    "methods.fault_figures": "FaultFigures",
    "monitoring.alarms.events": "AlarmEvent",
    "monitoring.alarms.proof_file": "AlarmProof",
    "monitoring.calibration.diagnostics": "Validation",
    "monitoring.calibration.result": "Calibration",
    "monitoring.calibration.validity": "Validity",
    "monitoring.logs.run": "DataRun",
    "monitoring.thresholds.learned": "LearnedThresholds",
    "monitoring.thresholds.monitor": "Monitor",
    "observers.detection": "Alarm Decision Detection",
    "observers.estimates": "Estimates",
    "observers.nonlinear.region_observer": "RegionObserver",
    "observers.running": "RunningObserver",
    "observers.scheduled.observer": "ScheduledObserver",
    "observers.window.observer": "WindowObserver",
    "plants.calibrated_box": "CalibratedBox",
    "plants.constants": "Constant ConstantsBox",
    "plants.uncertainty": "Uncertainty",
    "results.checks": "Check",
    "simulation.simulate": "Simulation",
    "simulation.trajectory": "Trajectory",
    "studies.compared_methods": "ComparedMethod FaultComparison",
    "studies.evaluate": "Evaluation Interval",
    "studies.fleet": "Fleet FleetRun",
    "studies.region_trade_off": "RegionTradeOff",
    "studies.robustness_result": "Robustness",
    "studies.sensor_sets": "SensorSet SensorSets",
    "studies.sweep": "Sweep SweepResult",
    "studies.tolerance_study": "ToleranceStudy",
}
_TYPE_HOMES = {name: f"obsynth.{module}" for module, names in _TYPE_NAMES.items() for name in names.split()}

__all__ = sorted(_TYPE_HOMES)


def __getattr__(name: str) -> Any:
    if name not in _TYPE_HOMES:
        raise AttributeError(f"module 'obsynth.types' has no attribute {name!r}")
    return getattr(import_module(_TYPE_HOMES[name]), name)


def __dir__() -> list[str]:
    return list(__all__)

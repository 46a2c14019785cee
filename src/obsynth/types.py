"""Types of what obsynth's functions return and take, for annotations: ``obsynth.types.Simulation``."""

from importlib import import_module
from typing import Any

#: By the module that holds it, imported when a name is first used.
_TYPE_NAMES = {
    "analysis.diagnosis.fault_columns": "DecoupledPlant",
    "analysis.diagnosis.diagnosing": "Diagnosis FaultDiagnosis StructuredResidual",
    "analysis.dae_structure": "Identifiability",
    "calibration.diagnostics": "Validation",
    "calibration.calibrating": "Calibration",
    "calibration.validity": "Validity",
    "comparison.comparing": "ComparedMethod FaultComparison",
    "comparison.sensor_sets": "SensorSet SensorSets",
    "data.alarm_events": "AlarmEvent",
    "data.run": "DataRun",
    "experiments.alarm_proof": "AlarmProof",
    "experiments.monitors.learned": "LearnedThresholds",
    "experiments.monitors.monitor": "Detection Monitor",
    "experiments.monte_carlo": "Evaluation Interval",
    "experiments.tolerance_study": "ToleranceStudy",
    "experiments.simulation": "Simulation",
    "methods.automatic": "FaultFigures",
    "methods.detection_filter.public": "DetectionFilter",
    "methods.recursive.synthesis": "SteadyState",
    "observers.decisions": "Alarm Decision",
    "observers.running": "Estimates RunningObserver",
    "observers.linear.observer": "WindowObserver",
    "plants.constants": "CalibratedBox Constant ConstantsBox Uncertainty",
    "results.checks": "Check",
    "simulation.scenario": "Trajectory",
    "sweeps.sweep": "Fleet FleetRun Sweep SweepResult",
    "tolerances.robustness": "Robustness",
}
_TYPE_HOMES = {name: f"obsynth.{module}" for module, names in _TYPE_NAMES.items() for name in names.split()}

__all__ = sorted(_TYPE_HOMES)


def __getattr__(name: str) -> Any:
    if name not in _TYPE_HOMES:
        raise AttributeError(f"module 'obsynth.types' has no attribute {name!r}")
    return getattr(import_module(_TYPE_HOMES[name]), name)


def __dir__() -> list[str]:
    return list(__all__)

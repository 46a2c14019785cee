"""obsynth: designs, proves and runs observers and fault-estimation filters for descriptor systems.

Plants
    DescriptorSystem, TimeVaryingDescriptorSystem, DAEModel; from other tools: from_andes, from_casadi, from_control,
    from_fmu, from_matlab, from_modelica, from_pandas, from_scipy, from_sympy; from a spec: load_spec; changed by
    discretise, eliminate_algebraic_states, with_noise.
What is possible
    check, analyse_structure, diagnose, identifiability.
Designs
    design, and one function for each method: fault_estimation_filter, pd_observer, ui_pi_observer, descriptor_kalman,
    adaptive_observer, dae_adaptive_observer, guaranteed_test; verify, load.
On data
    run_on_data, smooth, learn_thresholds, online_monitor, plotting.plot_data, html_report, export.
In simulation
    Scenario, simulate, monitor, evaluate, decide; plotting.
What is wrong
    SpecError, PreconditionError, InfeasibleError, SolverError, VerificationError, all of them ObsynthError.
Types
    Of what functions return, for annotations: ``obsynth.types``.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

from obsynth.extensions import provide
from obsynth.version import __version__ as __version__

#: What is public, by the module that holds it.  Imported when it is first used, so that ``import obsynth`` stays fast;
#: ``__init__.pyi`` tells the types.
_PUBLIC_NAMES = {
    "analysis.diagnosis.fault_columns": "decouple",
    "analysis.diagnosis.diagnosing": "diagnose",
    "analysis.dae_structure": "identifiability",
    "analysis.structure": "analyse_structure",
    "analysis.transformations.linear_plants": "eliminate_algebraic_states discretise",
    "analysis.transformations.linearisation": "linearise",
    "analysis.transformations.noise": "with_noise",
    "calibration.calibrating": "calibrate",
    "calibration.validating": "validate",
    "calibration.validity": "validity",
    "comparison.certificates": "verify_certificate",
    "comparison.comparing": "compare Comparison",
    "comparison.sensor_sets": "sensor_sets",
    "data.alarm_proof": "prove_alarm verify_alarm",
    "data.online_monitor": "learn_thresholds online_monitor",
    "data.run": "run_on_data smooth",
    "errors": "InfeasibleError ObsynthError PreconditionError SolverError SpecError VerificationError",
    "experiments.monitors.learned": "load_thresholds",
    "experiments.monitors.residual_monitor": "monitor",
    "experiments.monte_carlo": "evaluate",
    "experiments.tolerance_study": "tolerance_study",
    "experiments.simulation": "simulate",
    "exporting.files": "export",
    "importing.fmu": "from_fmu",
    "importing.linear_models": (
        "from_andes from_casadi from_control from_matlab from_modelica from_pandas from_scipy from_sympy"
    ),
    "methods.designing": "check design design_from_gains",
    "methods.detection_filter.public": "detection_filter",
    "methods.guaranteed_test.result": "GuaranteedTest guaranteed_test",
    "methods.functions": (
        "adaptive_observer dae_adaptive_observer descriptor_kalman "
        "fault_estimation_filter functional_filter pd_observer ui_pi_observer"
    ),
    "methods.pd_observer.public": "apply_adaptation_gain",
    "methods.recursive.synthesis": "steady_state_filter",
    "methods.ui_pi_observer.checks": "fault_response",
    "methods.verifying": "verify",
    "observers.batches": "run_batch",
    "observers.dae.observer": "DAEObserver",
    "observers.decisions": "decide ParameterMonitor",
    "observers.linear.observer": "LinearObserver sample_observer",
    "observers.recursive.observer": "Adaptation RecursiveObserver",
    "plants.dae": "DAEModel",
    "plants.descriptor": "DescriptorSystem TimeVaryingDescriptorSystem",
    "plants.fault_models": "fault_model FaultModel",
    "plants.uncertain_system": "uncertain_system",
    "report.page": "html_report",
    "results.design": "Certificate ObserverDesign VerificationReport load",
    "simulation.dae": "simulate_dae",
    "simulation.linear": "simulate_time_varying",
    "simulation.scenario": "Drift Gaussian Intermittent LostEffectiveness Ramp Scenario Sine Step Stuck Uniform",
    "spec.loader": "load_spec Spec",
    "sweeps.sweep": "run_fleet sweep",
    "tolerances.robustness": "robustness",
}
_PUBLIC_HOMES = {name: f"obsynth.{module}" for module, names in _PUBLIC_NAMES.items() for name in names.split()}
#: Modules whose names are used through them, such as ``obsynth.plotting.plot_data``.
_PUBLIC_PACKAGES = ("conditions", "plotting", "types")

__all__ = sorted(_PUBLIC_HOMES)

provide(
    {
        "conditions of a design": "obsynth.conditions.own_terms:conditions_of",
        "design summary": "obsynth.report.tables:summary",
        "picture of a guaranteed test": "obsynth.plotting.estimates:plot_least_thresholds",
    }
)


#: Functions that `design_from_gains` has replaced, by method.
_FROM_GAINS = {
    "fault_estimation_filter_from_gains": "fault-estimation-filter",
    "pd_observer_from_gains": "pd-observer",
    "ui_pi_observer_from_gains": "ui-pi-observer",
}


def _replaced(name: str) -> Any:
    """Return a function of old with a warning that names the new one."""
    from warnings import warn

    method = _FROM_GAINS[name]
    warn(f"{name} is now design_from_gains(plant, {method!r}, ...).", DeprecationWarning, stacklevel=3)
    from obsynth.methods.designing import design_from_gains

    return lambda plant, **gains: design_from_gains(plant, method, **gains)


def __getattr__(name: str) -> Any:
    if name in _FROM_GAINS:
        return _replaced(name)
    if name in _PUBLIC_HOMES:
        return getattr(import_module(_PUBLIC_HOMES[name]), name)
    if name in _PUBLIC_PACKAGES:
        return import_module(f"obsynth.{name}")
    if name[:1].isupper() and name in (types := import_module("obsynth.types")).__all__:
        from warnings import warn

        warn(f"obsynth.{name} is now obsynth.types.{name}.", DeprecationWarning, stacklevel=2)
        return getattr(types, name)
    raise AttributeError(f"module 'obsynth' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*__all__, *_PUBLIC_PACKAGES, "__version__"])

"""obsynth: designs, proves and runs observers and fault-estimation filters for descriptor systems.

The papers' inequalities
    conditions: each as a cvxpy problem, in the letters of its paper, to read, change and solve.
Plants
    DescriptorSystem, TimeVaryingDescriptorSystem, PolytopicSystem, DAEModel; from a spec: load_spec, Spec; from other
    tools: from_andes, from_casadi, from_control, from_fmu, from_matlab, from_modelica, from_pandas, from_scipy,
    from_sympy; to other tools: uncertain_system.  Changed by absorb_delays, discretise, eliminate_algebraic_states,
    linearise, with_functionals, with_noise.
What is possible
    check, analyse_structure, diagnose, identifiability; decouple; fault_model.
Designs
    design, and one function for each method: optimal_filter (the least gain possible), fault_estimation_filter,
    pd_observer, ui_pi_observer, descriptor_kalman, steady_state_filter, functional_filter, detection_filter,
    adaptive_observer, dae_adaptive_observer, extended_kalman, region_observer, guaranteed_test.  design_from_gains,
    apply_adaptation_gain, sample_observer, fault_response; verify, load, export, html_report.
Comparing and choosing
    compare, sweep, sensor_sets, region_trade_off; robustness, tolerance_study; verify_certificate.
On data
    run_on_data, smooth, validate, calibrate, validity; learn_thresholds, load_thresholds, online_monitor; prove_alarm,
    verify_alarm.
In simulation
    Scenario of Step, Ramp, Drift, Sine, Stuck, Intermittent, LostEffectiveness, TimeTable, with Gaussian or Uniform
    noise; simulate, simulate_dae, simulate_time_varying, run_batch, run_fleet, evaluate; monitor, decide.
Pictures
    plotting: plot_data, plot_faults, plot_gains, plot_trade_off and others.
What is wrong
    SpecError, PreconditionError, InfeasibleError, SolverError, VerificationError, all of them ObsynthError.
Types
    What functions return: ObserverDesign, with a LinearObserver, RecursiveObserver or DAEObserver and a
    VerificationReport; OptimalFilter, GuaranteedTest, Comparison, Certificate, FaultModel, Adaptation,
    ParameterMonitor.  Others, for annotations: ``obsynth.types``.
"""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from typing import Any

from obsynth.results.registered import register
from obsynth.version import __version__ as __version__

#: What is public, by the module that holds it.  Imported when it is first used, so that ``import obsynth`` stays fast;
#: ``__init__.pyi`` tells the types.
_PUBLIC_NAMES = {
    "analysis.dae_structure": "identifiability",
    "analysis.diagnosis.decoupled": "decouple",
    "analysis.diagnosis.diagnosing": "diagnose",
    "analysis.structure": "analyse_structure",
    "errors": "InfeasibleError ObsynthError PreconditionError SolverError SpecError VerificationError",
    "exporting.files": "export",
    "methods.designing": "check design design_from_gains",
    "methods.detection_filter.public": "detection_filter",
    "observers.recursive.steady_filter": "steady_state_filter",
    "methods.functions": (
        "adaptive_observer dae_adaptive_observer descriptor_kalman extended_kalman "
        "fault_estimation_filter functional_filter pd_observer region_observer ui_pi_observer"
    ),
    "methods.guaranteed_test.result": "GuaranteedTest guaranteed_test",
    "methods.optimal_filter.public": "OptimalFilter optimal_filter",
    "methods.pd_observer.public": "apply_adaptation_gain",
    "methods.verifying": "verify",
    "monitoring.alarms.certificates": "verify_alarm",
    "monitoring.alarms.proving": "prove_alarm",
    "monitoring.calibration.calibrating": "calibrate",
    "monitoring.calibration.validating": "validate",
    "monitoring.calibration.validity": "validity",
    "monitoring.logs.run": "run_on_data",
    "monitoring.logs.smoothing": "smooth",
    "monitoring.thresholds.learned": "load_thresholds",
    "monitoring.thresholds.learning": "learn_thresholds",
    "monitoring.thresholds.online_monitor": "online_monitor",
    "monitoring.thresholds.parameter_decisions": "ParameterMonitor decide",
    "monitoring.thresholds.residual_monitor": "monitor",
    "observers.batches": "run_batch",
    "observers.linear.sampled": "sample_observer",
    "observers.linear.observer": "LinearObserver",
    "observers.nonlinear.observer": "DAEObserver",
    "observers.recursive.observer": "RecursiveObserver",
    "observers.recursive.settings": "Adaptation",
    "plants.dae": "DAEModel",
    "plants.descriptor": "DescriptorSystem",
    "plants.faults": "FaultModel fault_model",
    "plants.importing.andes": "from_andes",
    "plants.importing.casadi_models": "from_casadi",
    "plants.importing.fmu": "from_fmu",
    "plants.importing.matlab_models": "from_matlab",
    "plants.importing.modelica_models": "from_modelica",
    "plants.importing.python_objects": "from_control from_pandas from_scipy from_sympy",
    "plants.polytopic": "PolytopicSystem",
    "plants.time_varying": "TimeVaryingDescriptorSystem",
    "plants.transformations.delays": "absorb_delays",
    "plants.transformations.elimination": "eliminate_algebraic_states",
    "plants.transformations.functionals": "with_functionals",
    "plants.transformations.linearisation": "linearise",
    "plants.transformations.noise_states": "with_noise",
    "plants.transformations.sampling": "discretise",
    "plants.uncertain_system": "uncertain_system",
    "report.page": "html_report",
    "results.design": "Certificate ObserverDesign",
    "results.gain_sets": "load",
    "results.verification_report": "VerificationReport",
    "simulation.dae": "simulate_dae",
    "simulation.linear": "simulate_time_varying",
    "simulation.profiles": "Drift Gaussian Intermittent LostEffectiveness Ramp Sine Step Stuck TimeTable Uniform",
    "simulation.scenario": "Scenario",
    "simulation.simulate": "simulate",
    "specs.loader": "Spec load_spec",
    "studies.certificates": "verify_certificate",
    "studies.comparing": "compare",
    "studies.comparison": "Comparison",
    "studies.evaluate": "evaluate",
    "studies.fleet": "run_fleet",
    "studies.region_trade_off": "region_trade_off",
    "studies.robustness": "robustness",
    "studies.sensor_sets": "sensor_sets",
    "studies.sweep": "sweep",
    "studies.tolerance_study": "tolerance_study",
    "verification.output_responses": "fault_response",
}
_PUBLIC_HOMES = {name: f"obsynth.{module}" for module, names in _PUBLIC_NAMES.items() for name in names.split()}
#: Modules whose names are used through them, such as ``obsynth.plotting.plot_data``.
_PUBLIC_PACKAGES = ("conditions", "plotting", "types")

__all__ = sorted([*_PUBLIC_HOMES, "conditions"])

#: What other libraries call functions of this one.
_OTHER_NAMES = {
    **dict.fromkeys(("kalman", "kalman_filter", "KalmanFilter", "lqe", "dlqe"), "descriptor_kalman"),
    **dict.fromkeys(("ekf", "EKF", "ExtendedKalmanFilter"), "extended_kalman"),
    **dict.fromkeys(("uio", "UIO", "unknown_input_observer", "place", "pi_observer"), "ui_pi_observer"),
    **dict.fromkeys(("luenberger", "luenberger_observer", "observer"), "pd_observer"),
    **dict.fromkeys(("hinf", "hinf_filter", "h2_filter"), "optimal_filter"),
    **dict.fromkeys(("fault_detection", "residual_generator", "parity", "parity_space"), "detection_filter"),
    **dict.fromkeys(("ss", "dss", "StateSpace", "Plant", "System", "LTI"), "DescriptorSystem"),
    **dict.fromkeys(("c2d", "sample", "sample_system", "transform"), "discretise"),
    **dict.fromkeys(("lmi", "lmis"), "conditions"),
    **dict.fromkeys(("plot", "plots"), "plotting"),
    **dict.fromkeys(("load_gains", "load_design", "read"), "load"),
    "save": "ObserverDesign.save",
    "report": "html_report",
}


def _conditions_of_design(design: Any) -> Any:
    from obsynth.methods.engines.conditions_of_designs import conditions_of

    return conditions_of(design)


def _design_of_conditions(source: str, *arguments: Any) -> Any:
    from obsynth.methods.engines.designs_of_conditions import design_of

    return design_of(source, *arguments)


def _problem_of_options(*arguments: Any) -> Any:
    from obsynth.methods.engines.designs_of_conditions import problem_of_options

    return problem_of_options(*arguments)


def _summary_of_design(design: Any) -> Any:
    from obsynth.report.summary import summary

    return summary(design)


def _text_of_simulation(simulation: Any) -> str:
    from obsynth.report.scenarios import simulation_text

    return simulation_text(simulation)


def _text_of_methods(methods: Any) -> str:
    from obsynth.report.plants import methods_text

    return methods_text(methods)


def _monitor_in_c(monitor: Any, design: Any, seconds: float | None = None) -> Any:
    from obsynth.monitoring.exporting import monitor_in_c

    return monitor_in_c(monitor, design, seconds)


def _bound_of_monitor(monitor: Any, observer: Any) -> Any:
    from obsynth.monitoring.exporting import bound_of_monitor

    return bound_of_monitor(monitor, observer)


def _text_of_run(run: Any) -> str:
    from obsynth.monitoring.run_summary import text_of_run

    return text_of_run(run)


def _page_sections_of_run(*arguments: Any) -> Any:
    from obsynth.monitoring.page_sections import page_sections_of_run

    return page_sections_of_run(*arguments)


def _detections(*arguments: Any) -> Any:
    from obsynth.monitoring.page_sections import detections

    return detections(*arguments)


def _text_of_evaluation(evaluation: Any) -> str:
    from obsynth.studies.tables import evaluation_text

    return evaluation_text(evaluation)


def _run_many(options: Any) -> int:
    from obsynth.studies.verbs.sweeps import run_many

    return run_many(options)


def _robustness(design: Any) -> Any:
    from obsynth.studies.robustness import robustness

    return robustness(design)


def _plot_delays(design: Any, **options: Any) -> Any:
    from obsynth.report.plots.trade_off import plot_delays

    return plot_delays(design, **options)


def _plot_least_thresholds(test: Any, **options: Any) -> Any:
    from obsynth.report.plots.guaranteed import plot_least_thresholds

    return plot_least_thresholds(test, **options)


# What methods of results and of conditions call in rooms above their own.
register(
    conditions_of_design=_conditions_of_design,
    design_of_conditions=_design_of_conditions,
    plot_delays=_plot_delays,
    plot_least_thresholds=_plot_least_thresholds,
    problem_of_options=_problem_of_options,
    summary_of_design=_summary_of_design,
    text_of_methods=_text_of_methods,
    text_of_simulation=_text_of_simulation,
)
# Rooms on data and on many designs may be left out: the design half is whole without them.
if find_spec("obsynth.monitoring") is not None:
    register(
        bound_of_monitor=_bound_of_monitor,
        detections=_detections,
        monitor_in_c=_monitor_in_c,
        page_sections_of_run=_page_sections_of_run,
        text_of_run=_text_of_run,
    )
if find_spec("obsynth.studies") is not None:
    register(robustness=_robustness, run_many=_run_many, text_of_evaluation=_text_of_evaluation)


def __getattr__(name: str) -> Any:
    if name in _PUBLIC_HOMES:
        return getattr(import_module(_PUBLIC_HOMES[name]), name)
    if name in _PUBLIC_PACKAGES:
        return import_module(f"obsynth.{name}")
    from obsynth.numerics.suggestions import not_in_module

    raise not_in_module(__name__, name, __all__, _OTHER_NAMES)


def __dir__() -> list[str]:
    return sorted({*__all__, *_PUBLIC_PACKAGES, "__version__"})

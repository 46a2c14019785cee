"""From a plant to a verified design: the only place that goes analyse -> synthesise -> verify."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from typing import Any, TypeAlias

from obsynth.analysis.conditions import Condition
from obsynth.analysis.transformations import StateRecovery
from obsynth.errors import SpecError, VerificationError
from obsynth.methods.method_spec import MethodSpec, PlantKind
from obsynth.methods.registry import REGISTRY, method_spec, methods_for
from obsynth.methods.synthesis_result import Synthesis
from obsynth.methods.verifying import verify
from obsynth.numerics.failures import failed_computations
from obsynth.numerics.threads import one_thread_if_small
from obsynth.plants.dae.model import DAEModel
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem
from obsynth.results.design import ObserverDesign
from obsynth.results.report import VerificationReport
from obsynth.verification.plant import condition_rows

Plant: TypeAlias = DescriptorSystem | TimeVaryingDescriptorSystem | DAEModel

_KINDS: Mapping[PlantKind, tuple[type, str]] = {
    "time-invariant": (DescriptorSystem, "a linear plant with constant matrices"),
    "time-varying": (TimeVaryingDescriptorSystem, "a linear plant whose matrices change with k"),
    "nonlinear": (DAEModel, "a nonlinear DAEModel"),
}


def _silent(_: str) -> None:
    """Progress that nobody watches."""


def design(
    plant: Plant,
    method: str = "fault-estimation-filter",
    *,
    name: str = "design",
    recovery: StateRecovery | None = None,
    progress: Callable[[str], None] | None = None,
    **options: Any,
) -> ObserverDesign:
    """Design an observer and verify what is shipped.

    Parameters
    ----------
    plant : DescriptorSystem, TimeVaryingDescriptorSystem or DAEModel
        The plant.
    method : str, optional
        Method id; for its options see the function of the same name, such as `fault_estimation_filter`.
    name : str, optional
        Name of the design.
    recovery : StateRecovery, optional
        Map back to the states of the plant before its transformation, kept with the design.
    progress : callable, optional
        Called with a text at the start of each stage.
    **options
        Options of the method.

    Returns
    -------
    ObserverDesign
        Verified: every check of its report holds.

    Raises
    ------
    SpecError
        Unknown method or option, or an option out of range.
    PreconditionError
        No such observer exists for this plant; the failing condition, mode and signals are named.
    InfeasibleError
        A checked certificate proves that what was asked cannot be reached.
    SolverError
        The solver gave no usable answer: nothing is known.
    VerificationError
        Gains were found, but the shipped realisation fails a check.
    """
    report_stage = progress or _silent
    spec = method_spec(method)
    asked = spec.read_options(options)
    for condition in _kind_conditions(plant, spec):
        condition.require()
    with failed_computations(), one_thread_if_small(plant.nx):
        found = spec.load("synthesise")(plant, asked, progress=report_stage)
        report_stage("verifying the shipped realisation")
        return verified(plant, method, found, name=name, recovery=recovery)


def check(plant: Plant, options: Mapping[str, Mapping[str, Any]] | None = None) -> dict[str, VerificationReport]:
    """Return, for every method, the report of its existence conditions; nothing is designed, and what fails is a row.

    Malformed options are a `SpecError`, numbers beyond double precision a `SolverError`.
    """
    found = {}
    for method in REGISTRY:
        spec = method_spec(method)
        asked = {} if method not in (options or {}) else spec.read_options((options or {})[method]).as_given()
        conditions = _kind_conditions(plant, spec)
        if not conditions:
            judge = spec.load("conditions")
            known = set(inspect.signature(judge).parameters)
            given = {name: value for name, value in asked.items() if name in known}
            with failed_computations():
                conditions = judge(plant, **given)
        found[method] = VerificationReport.of(condition_rows(conditions))
    return found


def kind_of(plant: Any) -> PlantKind:
    """Return the kind of a plant; raise `SpecError` for anything else."""
    for kind, (plant_type, _) in _KINDS.items():
        if isinstance(plant, plant_type):
            return kind
    raise SpecError(
        f"The plant is a {type(plant).__name__}: give an obsynth.DescriptorSystem, TimeVaryingDescriptorSystem or "
        "DAEModel.",
        path="plant",
    )


def _kind_conditions(plant: Plant, method: MethodSpec) -> tuple[Condition, ...]:
    """Return the failing condition where a method does not take plants of this kind, else nothing."""
    kind = kind_of(plant)
    if kind in method.plants:
        return ()
    wanted = " or ".join(_KINDS[taken][1] for taken in method.plants)
    return (
        Condition(
            "kind of plant", f"{method.id} needs {wanted}", False, 0.0, 1.0, method.id,
            f"{_KINDS[kind][1]}; methods for such plants are: {', '.join(methods_for(kind))}.",
        ),
    )  # fmt: skip


def public_function(method: str) -> Callable[..., ObserverDesign]:
    """Return the public function of a method."""
    return method_spec(method).load("public")


def draft_of(
    plant: Plant, method: str, found: Synthesis, *, name: str, recovery: StateRecovery | None = None
) -> ObserverDesign:
    """Return the design that a synthesis stands for, without a report."""
    if found.plant is not None:
        plant = found.plant
    if found.transformation is not None:
        own = found.transformation.recovery
        plant, recovery = found.transformation.plant, own if recovery is None else recovery.then(own)
    return ObserverDesign(
        name=name,
        method=method,
        plant=plant,
        options=found.options,
        gains=found.gains,
        observer=found.observer,
        certificate=found.certificate,
        solver=found.solver,
        notes=found.notes,
        recovery=recovery,
    )


def verified(
    plant: Plant, method: str, found: Synthesis, *, name: str, recovery: StateRecovery | None = None
) -> ObserverDesign:
    """Return the design with its report."""
    draft = draft_of(plant, method, found, name=name, recovery=recovery)
    report = verify(draft)
    if not report.passed:
        failed = "; ".join(f"{row.name} ({row.value:.3g} against {row.bound:.3g})" for row in report.failures)
        raise VerificationError(
            f"Gains were found, but the shipped realisation fails: {failed}. Nothing was shipped; "
            "the plant may be badly scaled, or what was asked may be at the edge of what can be had: ask for less."
            + "".join(f" {note}" for note in draft.notes),
            report=report,
        )
    return draft.replace(report=report)

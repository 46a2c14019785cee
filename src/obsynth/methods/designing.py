"""From a plant to a verified design: the only place that goes analyse -> synthesise -> verify."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any, TypeAlias

import numpy as np

from obsynth.analysis.conditions import Condition
from obsynth.analysis.transformations import StateRecovery
from obsynth.errors import SolverError, SpecError, VerificationError
from obsynth.methods.registry import NONLINEAR, REGISTRY, TIME_VARYING, method_module
from obsynth.methods.synthesis_result import Synthesis
from obsynth.methods.verifying import verify
from obsynth.numerics.threads import one_thread_if_small
from obsynth.plants.dae.model import DAEModel
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem
from obsynth.results.design import ObserverDesign
from obsynth.results.report import VerificationReport
from obsynth.verification.plant import condition_rows

Plant: TypeAlias = DescriptorSystem | TimeVaryingDescriptorSystem | DAEModel


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
    options = _checked_options(method, options)
    for condition in _kind_conditions(plant, method):
        condition.require()
    try:
        with one_thread_if_small(plant.nx):
            found = method_module(method).synthesise(plant, progress=report_stage, **options)
            report_stage("verifying the shipped realisation")
            return verified(plant, method, found, name=name, recovery=recovery)
    except np.linalg.LinAlgError as error:
        raise SolverError(
            f"LAPACK gave up ({error}): the numbers are beyond double precision. Nothing is known; look at the units "
            "of the plant and at the options."
        ) from error


def check(plant: Plant, options: Mapping[str, Mapping[str, Any]] | None = None) -> dict[str, VerificationReport]:
    """Return, for every method, the report of its existence conditions; nothing is designed or raised."""
    found = {}
    for method in REGISTRY:
        conditions = _kind_conditions(plant, method)
        if not conditions:
            judge = method_module(method).conditions
            known = set(inspect.signature(judge).parameters)
            given = {name: value for name, value in (options or {}).get(method, {}).items() if name in known}
            conditions = judge(plant, **given)
        found[method] = VerificationReport.of(condition_rows(conditions))
    return found


def _kind_conditions(plant: Plant, method: str) -> tuple[Condition, ...]:
    """Return the failing condition where a method does not take plants of this kind, else nothing."""
    if not isinstance(plant, (DescriptorSystem, TimeVaryingDescriptorSystem, DAEModel)):
        raise SpecError(
            f"The plant is a {type(plant).__name__}: give an obsynth.DescriptorSystem, TimeVaryingDescriptorSystem or "
            "DAEModel.",
            path="plant",
        )
    if method in NONLINEAR:
        return () if isinstance(plant, DAEModel) else (_other_kind(method, "a nonlinear DAEModel"),)
    if isinstance(plant, DAEModel):
        return (_other_kind(method, f"a linear plant; methods for nonlinear ones are: {', '.join(NONLINEAR)}"),)
    if isinstance(plant, DescriptorSystem) or method in TIME_VARYING:
        return ()
    return (
        Condition(
            "time-invariant plant", "constant matrices, given as a DescriptorSystem", False, 0.0, 1.0, method,
            f"the matrices change with k; methods for such plants are: {', '.join(TIME_VARYING)}",
        ),
    )  # fmt: skip


def _other_kind(method: str, wanted: str) -> Condition:
    return Condition("kind of plant", f"{method} needs {wanted}", False, 0.0, 1.0, method, "a plant of another kind.")


def public_function(method: str) -> Callable[..., ObserverDesign]:
    """Return the public function of a method: of the same name, in a module of the same name."""
    name = method.replace("-", "_")
    function: Callable[..., ObserverDesign] = getattr(import_module(f"obsynth.methods.{name}.public"), name)
    return function


def _checked_options(method: str, options: dict[str, Any]) -> dict[str, Any]:
    method_module(method)
    allowed = set(inspect.signature(public_function(method)).parameters) - {"plant", "name"}
    unknown = sorted(set(options) - allowed)
    if unknown:
        raise SpecError(
            f"{method} has no option {', '.join(map(repr, unknown))}; there are: {', '.join(sorted(allowed))}.",
            path="method.options",
        )
    return options


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

"""Existence conditions of the observer of a DAE."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from obsynth.analysis.dae_structure import identifiability, index_report
from obsynth.analysis.existence.condition import Condition
from obsynth.errors import SolverError, a_kind, counted
from obsynth.plants.dae import DAEModel
from obsynth.plants.dae_functions import DAEFunctions

#: Samples of the nominal trajectory along which directions are looked for.
NOMINAL_SAMPLES = 51

SOURCE = "Moussa Ali, Zhang 2013 (DAE)"


def dae_conditions(model: object, dt: float) -> Iterator[Condition]:
    """Yield the existence conditions; the list ends at the first failure."""
    if not isinstance(model, DAEModel):
        yield Condition(
            "plant of this kind",
            "a DAEModel: F(x', x, u, theta) = 0, y = h(x, theta)",
            False,
            0.0,
            1.0,
            f"{SOURCE}, (3)",
            f"the plant is {a_kind(model)}",
            of_the_method=True,
        )
        return
    report = index_report(model, dt)
    growth = ", then ".join(f"{value:.3g}" for value in report.conditions)
    detail = f"the condition of dF/dx' / dt + dF/dx is {growth} when dt falls to a tenth"
    if report.undefined:
        detail = f"{report.undefined}; state other nominal values"
    elif report.index == 0:
        detail += (
            f": it is singular for every dt; the equations {', '.join(map(repr, report.equations))} are not independent"
        )
    elif report.index > 1:
        detail += (
            f": index {report.index}, because of the equations {', '.join(map(repr, report.equations))}; differentiate "
            "the constraint until it determines the algebraic states"
        )
    yield Condition(
        "index",
        "the plant has index 1",
        report.index == 1,
        float(report.index),
        1.0,
        f"{SOURCE}, (7)",
        detail,
        signals=report.states,
        of_the_method=True,
    )
    if report.index == 1 and model.nq:
        note = _unidentified(model, dt)
        yield Condition(
            "parameters",
            "the plant has parameters to estimate",
            True,
            float(model.nq),
            1.0,
            f"{SOURCE}, (3)",
            f"{counted(model.nq, 'parameter')}{note}",
            of_the_method=True,
        )


def known_parameters(plant: DAEModel) -> Condition:
    """Return the condition that a plant has no parameters to estimate."""
    names = ", ".join(plant.parameter_names)
    text = f"{names}. Make them constants, or take dae-adaptive-observer, which estimates them." if names else "none"
    return Condition(
        "known parameters",
        "a plant without unknown parameters",
        not names,
        float(plant.nq),
        0.0,
        "this method",
        text,
        signals=plant.parameter_names,
        of_the_method=True,
    )


def _unidentified(model: DAEModel, dt: float) -> str:
    """Return what the outputs do not tell at nominal constant inputs: no condition, since others may excite it."""
    theta = model.nominal_parameters
    y, _, L = DAEFunctions(model).outputs(model.nominal_state, theta)
    sizes = np.where(np.isfinite(y) & (y != 0.0), np.abs(y), 1.0)
    # A parameter that is nominally zero and is added to outputs, as a bias, is measured by these.
    effects = np.abs(L / sizes[:, None]).max(axis=0, initial=0.0)
    scales = np.where(theta != 0.0, np.abs(theta), 1.0 / np.where(effects > 0.0, effects, 1.0))
    u = np.tile(model.nominal_input, (NOMINAL_SAMPLES, 1))
    try:
        result = identifiability(model, u, dt=dt, R=np.diag(sizes**2), parameter_scales=scales)
    except SolverError as error:
        return f"; at nominal inputs there is no trajectory: {error}"
    if not result.unidentifiable:
        faintest = result.singular_values[-1] / result.singular_values[0]
        return (
            "; at nominal constant inputs the outputs determine every direction of parameters and initial state, the "
            f"weakest {faintest:.1e} times as strongly as the strongest"
        )
    listed = "; ".join(", ".join(f"{name} ({share:+.3g})" for name, share in row.items()) for row in result.unseen)
    return (
        f"; at nominal constant inputs the outputs do not determine these directions: {listed}. Ask "
        "obsynth.identifiability whether other inputs excite them, or add a sensor"
    )

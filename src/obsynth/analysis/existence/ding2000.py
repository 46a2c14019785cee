"""Existence conditions of a detection filter, decided exactly for plants with stated numbers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from obsynth.analysis.existence import functional_filter
from obsynth.analysis.existence.condition import Condition, rank_condition
from obsynth.analysis.existence.statements import Evaluator
from obsynth.errors import PreconditionError
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.ranks import decide_rank
from obsynth.numerics.spectra import pole_text
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.transformations.elimination import eliminate_algebraic_states
from obsynth.proofs.exact_doubles import holds_computed
from obsynth.proofs.exact_pencils import ExactPencil

#: The zeros of pencils with more columns are left to the Riccati equation.
MOST_PENCIL_COLUMNS = 70

#: The same of computed numbers, whose fractions are long; a zero of them on the axis is one, and others may be.
MOST_COMPUTED_COLUMNS = 20

_SOURCE = "Ding et al. 2000"


def unknown_inputs(plant: DescriptorSystem) -> tuple[FloatArray, FloatArray]:
    """Return ``[Bd, Bw]`` and ``[Dd, Dw]``."""
    return np.hstack([plant.Bd, plant.Bw]), np.hstack([plant.Dd, plant.Dw])


def conditions(plant: DescriptorSystem) -> tuple[Condition, ...]:
    """Return the existence conditions of a plant."""
    first = (
        Condition(
            "continuous time",
            "dt = 0",
            plant.dt == 0.0,
            plant.dt,
            0.0,
            _SOURCE,
            "continuous" if plant.dt == 0.0 else "sampled: give a continuous plant, or see functional_filter.",
            of_the_method=True,
        ),
        Condition(
            "faults",
            "at least one fault",
            plant.nf > 0,
            float(plant.nf),
            1.0,
            _SOURCE,
            f"{plant.nf} faults" if plant.nf else "none: name one by Bf or Df.",
            of_the_method=True,
        ),
    )
    if not all(condition.holds for condition in first):
        return first
    try:
        smooth = eliminate_algebraic_states(plant).plant
    except PreconditionError as error:
        return (
            *first,
            Condition(
                error.condition,
                "algebraic states that can be eliminated",
                False,
                np.nan,
                np.nan,
                _SOURCE,
                str(error),
                signals=error.signals,
                of_the_method=error.condition == "index",
            ),
        )
    reading = reading_outputs(smooth)
    reach = decide_rank(unknown_inputs(smooth)[1][reading], expected=len(reading))
    remedy = "" if reach.full else _without_full_rank(plant)
    direct = rank_condition("rank [Dd, Dw]", reach, remedy, source=_SOURCE, signals=smooth.output_names)
    return (
        *first,
        *(
            # Where one fails the optimum is not attained, or has no such filter: other residuals exist.
            replace(condition, of_the_method=True)
            for condition in (direct, _detectable(smooth), *(_no_zero_on_the_axis(plant) if reach.full else ()))
        ),
    )


def _without_full_rank(plant: DescriptorSystem) -> str:
    """Return what is so where unknown inputs and noise do not reach every output at once, and what can be done."""
    text = (
        "Unknown inputs and noise do not reach every output directly ([Dd, Dw] lacks row rank): some residual is free "
        "of them at high frequencies. "
    )
    residuals = functional_filter.conditions(plant, residuals="detect", exactly=False)
    if all(condition.holds for condition in residuals):
        return f"{text}functional_filter with residuals='detect' exists; or state the noise of all sensors."
    return f"{text}State the noise of all sensors (sensor_noise)."


def reading_outputs(plant: DescriptorSystem) -> NDArray[np.intp]:
    """Return the outputs in which a state, a fault, an unknown input or noise appears: others say nothing."""
    rows = np.hstack([plant.C, plant.Df, *unknown_inputs(plant)[1:]])
    return np.flatnonzero(rows.any(axis=1))


def _detectable(plant: DescriptorSystem) -> Condition:
    lost = Evaluator(plant.dense()).hidden_modes().outside
    detail = (
        f"the mode s = {pole_text(complex(lost[0]), 4)} is undetectable: measure more."
        if lost
        else ("every mode is observable, or decays")
    )
    mode = complex(lost[0]) if lost else None
    return Condition(
        "detectable",
        "unobservable modes decay",
        not lost,
        float(len(lost)),
        0.0,
        _SOURCE,
        detail,
        mode=mode,
    )


def _no_zero_on_the_axis(plant: DescriptorSystem) -> tuple[Condition, ...]:
    """Return whether ``[A - sE, B; C, D]`` of the unknown inputs keeps its rank on the axis, where that is decided."""
    b, d = unknown_inputs(plant)
    a = np.block([[plant.A, b], [plant.C, d]])
    computed = holds_computed(a) or holds_computed(plant.E)
    if a.shape[1] > (MOST_COMPUTED_COLUMNS if computed else MOST_PENCIL_COLUMNS):
        return ()
    e = np.zeros_like(a)
    e[: plant.nx, : plant.nx] = plant.E
    zeros = ExactPencil.written(e, a).zeros(discrete=False)
    on_axis = [complex(root.value) for root in zeros if root.side == "boundary"]
    if computed and not on_axis:
        return ()
    detail = (
        "none, exactly"
        if not on_axis
        else (
            f"s = {on_axis[0]:.4g}: the unknown inputs do not reach some residual there, and the filter that gives all "
            "residuals the same gain would not be stable. State noise of the states (Bw)."
        )
    )
    return (
        Condition(
            "zeros of the unknown inputs",
            "none on the imaginary axis",
            not on_axis,
            float(len(on_axis)),
            0.0,
            _SOURCE,
            detail,
            mode=on_axis[0] if on_axis else None,
        ),
    )

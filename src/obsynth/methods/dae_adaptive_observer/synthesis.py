"""Method ``dae-adaptive-observer``: A. Moussa Ali, Q. Zhang, IFAC SSSC 2013, (5)-(23)."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from obsynth.analysis.existence.condition import require_all
from obsynth.methods.dae_adaptive_observer.method import DaeAdaptiveObserver
from obsynth.methods.method import Synthesis
from obsynth.observers.changed_options import plain_recursion
from obsynth.observers.nonlinear.building import (
    LARGEST_TURN,
    NOMINAL_STEPS,
    DAEFacts,
    dae_facts,
    dae_observer_from_options,
    largest_turn,
    resolved_options,
)
from obsynth.observers.nonlinear.observer import DAEObserver
from obsynth.plants.dae import DAEModel
from obsynth.plants.implicit_step import PROJECTION_NOTICE
from obsynth.plants.noise import offset_state
from obsynth.results.design import Certificate


def synthesise(plant: DAEModel, method: DaeAdaptiveObserver, *, progress: Callable[[str], None]) -> Synthesis:
    """Put the observer together; see `obsynth.dae_adaptive_observer` for the options, results and errors."""
    observer = dae_observer_from_options(plant, method.as_given())
    progress("checking index and parameters")
    require_all(method.existence(plant))
    progress("running the observer on its own model")
    facts = dae_facts(plain_recursion(observer))
    claims = {
        "index": float(facts.index),
        "condition": facts.condition,
        "contraction": facts.contraction,
        "steps": float(facts.steps),
    }
    return Synthesis(
        resolved_options(observer) | {"outliers": method.outliers},
        {"K": facts.K, "Upsilon": facts.Upsilon},
        observer,
        Certificate({}, claims),
        notes=tuple(_notes(observer, facts)),
    )


def _notes(observer: DAEObserver, facts: DAEFacts) -> Iterator[str]:
    if np.any(facts.projection):
        sizes = PROJECTION_NOTICE * observer.model.state_scales
        moved = [
            f"{name} by {move:.4g}"
            for name, move, size in zip(observer.state_names, facts.projection, sizes, strict=True)
            if abs(move) > size
        ]
        yield f"The initial state does not meet the algebraic equations; it is moved onto them: {', '.join(moved)}."
    if facts.steps < NOMINAL_STEPS:
        yield (
            "At constant nominal inputs the plant leaves its nominal state for where its equations have no solution: "
            f"the checks are made over {facts.steps} steps in place of {NOMINAL_STEPS}. State inputs and states at "
            "which the plant rests to have them over more."
        )
    turn = largest_turn(observer.model, observer.dt)
    if observer.integration == "backward-euler" and turn > LARGEST_TURN:
        yield (
            f"At the nominal point a mode turns by {turn:.2g} radians in a step, which backward Euler damps: "
            "parameters that take up the difference will be wrong. Take integration: radau (or auto)."
        )
    if observer.integration == "radau" and turn > LARGEST_TURN:
        yield (
            f"Radau IIA integrates the plant: at the nominal point a mode rotates by {turn:.2g} radians a step, which "
            "backward Euler would damp."
        )
    for direction in facts.identifiable.faint:
        shares = ", ".join(f"{name} ({share:+.3g})" for name, share in direction.items())
        offsets = [name for name in observer.model.output_names if offset_state(name) in direction]
        remedy = f"add a sensor, or leave out the offset of {' and '.join(offsets)}" if offsets else "or add a sensor"
        yield (
            "At nominal constant inputs the outputs do not distinguish this direction from noise, in prior deviations "
            f"and nominal sizes: {shares}. Excite the plant, {remedy}."
        )
    window = 1.0 / (1.0 - observer.forgetting) if observer.forgetting < 1.0 else np.inf
    if observer.model.nq and observer.form == "forgetting" and facts.decay_time > window:
        yield (
            f"Errors of the state decay in {facts.decay_time:.0f} steps, those of the parameters in {window:.0f}: "
            "after a jump of a parameter the estimates will be biased for the longer of the two. Raise Q, or lambda."
        )

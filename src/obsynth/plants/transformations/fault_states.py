"""Faults that act on the outputs as algebraic states of the plant."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from obsynth.errors import PreconditionError
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.ranks import NEGLIGIBLE_INPUT, decide_rank
from obsynth.numerics.scaling import equilibrate_pencil
from obsynth.numerics.suggestions import quoted_names
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.signal_names import index_of, leading_names
from obsynth.plants.transformations.recovery import Transformation, unchanged_states, with_states
from obsynth.plants.uncertainty import Uncertainty


def augment_faults(plant: DescriptorSystem, faults: Sequence[str]) -> Transformation:
    """Append the chosen faults that act on the outputs as algebraic states ``phi = f``."""
    columns = [index_of(name, plant.fault_names, what="The plant") for name in faults]
    chosen = sorted({column for column in columns if plant.Df[:, column].any()})
    nx, count = plant.nx, len(chosen)
    chosen_names = [plant.fault_names[column] for column in chosen]
    names = [f"fault:{name}" for name in chosen_names]
    output = np.hstack([plant.C, plant.Df[:, chosen]])
    E, A = np.zeros((nx + count, nx + count)), -np.eye(nx + count)
    E[:nx, :nx], A[:nx, :nx] = plant.E, plant.A
    _require_visible(np.vstack([E, output]), plant, chosen_names)
    remaining = plant.Df.copy()
    remaining[:, chosen] = 0.0
    below = {name: np.zeros((count, getattr(plant, name).shape[1])) for name in ("B", "Bd", "Bw")}
    below["Bf"] = np.eye(plant.nf)[chosen]
    inputs = {name: np.vstack([getattr(plant, name), rows]) for name, rows in below.items()}
    new = with_states(
        plant,
        (*plant.state_names, *names),
        E=E,
        A=A,
        C=output,
        Df=remaining,
        **inputs,
        uncertainty=None if plant.uncertainty is None else _augmented(plant.uncertainty, plant.nx, chosen),
    )
    description = f"appended {', '.join(names)} as states" if names else ""
    return Transformation(plant, new, description, unchanged_states(plant, new, from_state=np.eye(nx, nx + count)))


def _augmented(uncertain: Uncertainty, nx: int, chosen: Sequence[int]) -> Uncertainty | None:
    """Return what is uncertain in a plant whose ``chosen`` faults have become states: entries of Df are then of C."""
    if uncertain.written is not None:
        return uncertain.left_behind("faults were appended as states after the plant was transformed")
    entries = {name: list(items) for name, items in uncertain.entries.items()}
    direct = entries.pop("Df", [])
    moved = [(row, nx + chosen.index(column), text) for row, column, text in direct if column in chosen]
    changed = {"C": [*entries.get("C", []), *moved], "Df": [item for item in direct if item[1] not in chosen]}
    return replace(uncertain, entries={name: tuple(items) for name, items in {**entries, **changed}.items() if items})


def _require_visible(stacked: FloatArray, plant: DescriptorSystem, faults: Sequence[str]) -> None:
    decision = decide_rank(stacked, expected=stacked.shape[1])
    if decision.full or not faults:
        return
    scaled = equilibrate_pencil(np.zeros_like(stacked), stacked).A
    shares = np.linalg.norm(np.linalg.svd(scaled)[2][decision.rank :], axis=0)
    if np.max(shares[plant.nx :]) > NEGLIGIBLE_INPUT:
        signals = leading_names(shares[plant.nx :], faults)
        culprit = (
            f"Faults {quoted_names(signals)} have the same effect on the outputs as algebraic states, or as each other."
        )
    else:
        signals = leading_names(shares[: plant.nx], plant.state_names)
        culprit = f"States {quoted_names(signals)} are neither dynamic nor measured."
    raise PreconditionError(
        f"Faults cannot be appended as states: {decision.describe()}. {culprit} Leave faults out, or add an output.",
        condition="rank [E 0; 0 0; C Df]",
        signals=signals,
    )

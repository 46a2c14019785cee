"""The outputs and disturbances that a filter of the faults uses: without redundant outputs, disturbances as noise."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.linalg

from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.ranks import decide_rank, equilibrate
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.proofs.exact_doubles import stored_matrix
from obsynth.verification.worst_invisible import Model


class Setting(NamedTuple):
    """What the filter must do: ``delays`` in samples of each fault, and models that the faults pass one after the other
    to what is wanted (a reference model, a weight of its error); whether the fault map is exact.

    ``dependent``: outputs, by their places, which signals may show a little, where the filters in question answer them,
    with the others at zero, by at most ``answer_limit`` times the energy: as a rule, combinations of the others but for
    rounding.
    """

    delays: tuple[int, ...]
    models: tuple[Model, ...]
    exact: bool
    dependent: tuple[int, ...] = ()
    answer_limit: float = 0.0

    @property
    def longest(self) -> int:
        """The longest delay."""
        return max(self.delays, default=0)


def seen_plant(plant: DescriptorSystem, decoupled: Sequence[str]) -> DescriptorSystem:
    """Return the plant in which disturbances that are not ``decoupled`` count as noise, before the noise."""
    columns = [plant.disturbance_names.index(name) for name in decoupled]
    bounded = [i for i in range(plant.nd) if i not in columns]
    return plant.replace(
        Bd=plant.Bd[:, columns],
        Dd=plant.Dd[:, columns],
        disturbance_names=[plant.disturbance_names[i] for i in columns],
        Bw=np.hstack([plant.Bd[:, bounded], plant.Bw]),
        Dw=np.hstack([plant.Dd[:, bounded], plant.Dw]),
        noise_names=[*(plant.disturbance_names[i] for i in bounded), *plant.noise_names],
    )


def with_independent_outputs(plant: DescriptorSystem) -> DescriptorSystem:
    """Return the plant without outputs that are combinations of others, exactly: they show nothing more.

    Stored numbers count as they are: of outputs that depend on each other but for rounding none is left out.
    """
    shown = np.hstack([plant.C, plant.Df, plant.Dd, plant.Dw])
    if decide_rank(shown).rank == plant.ny:
        return plant
    echelon, rank = stored_matrix(shown.T).rref()
    if rank == plant.ny:
        return plant
    entries, width = echelon.entries(), plant.ny
    return with_outputs(plant, [next(j for j in range(width) if entries[i * width + j] != 0) for i in range(rank)])


def with_outputs(plant: DescriptorSystem, places: Sequence[int]) -> DescriptorSystem:
    """Return the plant with these of its outputs alone."""
    own = [*places]
    rows = {name: getattr(plant, name)[own] for name in ("C", "D", "Df", "Dd", "Dw")}
    return plant.replace(**rows, output_names=[plant.output_names[i] for i in own])


class Faint(NamedTuple):
    """Rows ``C x + Dh h + Dw w`` of outputs that signals show a little, and the gain of a filter from them."""

    C: FloatArray
    Dh: FloatArray
    Dw: FloatArray
    answer_limit: float


def nearly_dependent_outputs(plant: DescriptorSystem) -> tuple[int, ...]:
    """Return the places of outputs that are combinations of the others but for rounding, decided in floating point."""
    shown = np.hstack([plant.C, plant.Df, plant.Dd, plant.Dw])
    rank = decide_rank(shown).rank
    if rank == plant.ny:
        return ()
    *_, order = scipy.linalg.qr(equilibrate(shown).T, mode="economic", pivoting=True)
    return tuple(sorted(int(i) for i in order[rank:]))


def without_dependent(plant: DescriptorSystem, setting: Setting) -> tuple[DescriptorSystem, Faint | None]:
    """Return the plant without the outputs that a setting calls dependent, and these."""
    if not setting.dependent:
        return plant, None
    (_, dh), (_, dw) = hidden_and_bounded(plant, setting)
    places = [*setting.dependent]
    faint = Faint(plant.C[places], dh[places], dw[places], setting.answer_limit)
    return with_outputs(plant, [i for i in range(plant.ny) if i not in setting.dependent]), faint


def hidden_and_bounded(
    plant: DescriptorSystem, setting: Setting
) -> tuple[tuple[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]:
    """Return the columns ``(Bh, Dh)`` of what the error must not show, and ``(Bw, Dw)`` of what its gain is from."""
    faults, unknown, noise = ((getattr(plant, f"B{name}"), getattr(plant, f"D{name}")) for name in ("f", "d", "w"))
    hidden, bounded = ((faults, unknown), (noise,)) if setting.exact else ((unknown,), (faults, noise))
    return (
        (np.hstack([pair[0] for pair in hidden]), np.hstack([pair[1] for pair in hidden])),
        (np.hstack([pair[0] for pair in bounded]), np.hstack([pair[1] for pair in bounded])),
    )

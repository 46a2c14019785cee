"""The exosystems of all faults of a plant, stacked: ``w+ = Phi w, f = Cw w``.

Source: Share Pasand, Aliyari, Taghirad, eqs. (2), (6), with ``Cw`` block-diagonal (as printed it would add the faults).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics.arrays import ComplexArray, FloatArray, read_only
from obsynth.plants.fault_models import MODEL_KEYS, FaultModel, fault_model
from obsynth.plants.validation import index_of


@dataclass(frozen=True, eq=False)
class Exosystem:
    """The exosystems of all faults, stacked: ``Phi (nw, nw)``, block-diagonal, in the plant's time, ``Cw (nf, nw)``."""

    Phi: FloatArray
    Cw: FloatArray
    names: tuple[str, ...]
    eigenvalues: ComplexArray
    descriptions: tuple[str, ...]

    @property
    def order(self) -> int:
        """Number of states."""
        return int(self.Phi.shape[0])


def exosystem(data: Any, fault_names: Sequence[str], dt: float) -> Exosystem:
    """Return the exosystem of all faults."""
    models = _by_fault(data, fault_names)
    _require_below_nyquist(fault_names, models, dt)
    count = sum(model.order for model in models)
    phi, cw = np.zeros((count, count)), np.zeros((len(models), count))
    starts = np.cumsum([0, *(model.order for model in models)])
    for row, model in enumerate(models):
        place = slice(starts[row], starts[row + 1])
        phi[place, place], cw[row, place] = model.transition(dt), model.Cw[0]
    each = zip(fault_names, models, strict=True)
    names = tuple(f"{name} model {i + 1}" for name, model in each for i in range(model.order))
    values = list(dict.fromkeys(value for model in models for value in model.eigenvalues(dt).tolist()))
    descriptions = tuple(model.description for model in models)
    return Exosystem(read_only(phi), read_only(cw), names, np.array(values, dtype=np.complex128), descriptions)


def _require_below_nyquist(names: Sequence[str], models: Sequence[FaultModel], dt: float) -> None:
    """Raise for a course in continuous time that samples cannot tell from a slower one."""
    if dt == 0.0:
        return
    problems = []
    for name, model in zip(names, models, strict=True):
        fastest = 0.0 if model.sampled else float(np.max(np.abs(model.eigenvalues(0.0).imag), initial=0.0))
        if fastest * dt >= np.pi:
            problems.append(
                f"the model of {name!r} ({model.description}) oscillates with {fastest:.6g} rad/s, but samples every "
                f"{dt:g} s show only what is slower than {np.pi / dt:.6g} rad/s (Nyquist): sample faster, or give the "
                "frequency that the samples show."
            )
    if problems:
        raise SpecError("fault_model:", path="fault_model", problems=problems)


def _by_fault(data: Any, fault_names: Sequence[str]) -> list[FaultModel]:
    if not isinstance(data, Mapping) or set(data) & set(MODEL_KEYS) - set(fault_names):
        model = fault_model(data)
        return [model for _ in fault_names]
    for name in data:
        index_of(name, fault_names, what="fault_model")
    missing = [name for name in fault_names if name not in data]
    if missing:
        raise SpecError(
            f"fault_model says nothing about {', '.join(map(repr, missing))}: give a model for each fault, or one for "
            "all.",
            path="fault_model",
        )
    return [fault_model(data[name]) for name in fault_names]

"""Plants made from plants, each with the way back to the original states.

Eliminating algebraic states, sampling, and treating sensor faults as states.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from obsynth.analysis.transformations.elimination import eliminate_algebraic_states
    from obsynth.analysis.transformations.recovery import StateRecovery, Transformation, augment_faults
    from obsynth.analysis.transformations.sampling import discretise, sampling_zero_warnings

__all__ = [
    "StateRecovery",
    "Transformation",
    "augment_faults",
    "discretise",
    "eliminate_algebraic_states",
    "sampling_zero_warnings",
]

# Loaded when they are used: gain sets need the way back only.
_HOMES = {
    "StateRecovery": "recovery", "Transformation": "recovery", "augment_faults": "recovery",
    "discretise": "sampling", "eliminate_algebraic_states": "elimination", "sampling_zero_warnings": "sampling",
}  # fmt: skip


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)

"""What a plant is and what can be known about it: structure, zeros, and plants made from plants."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from obsynth.analysis.structure import Structure, analyse_structure
    from obsynth.analysis.transformations import (
        StateRecovery,
        Transformation,
        augment_faults,
        discretise,
        eliminate_algebraic_states,
        sampling_zero_warnings,
    )
    from obsynth.analysis.zeros import FaultZeros, Zero, are_outside, fault_zeros, invariant_zeros, is_outside

__all__ = [
    "FaultZeros",
    "StateRecovery",
    "Structure",
    "Transformation",
    "Zero",
    "analyse_structure",
    "are_outside",
    "augment_faults",
    "discretise",
    "eliminate_algebraic_states",
    "fault_zeros",
    "invariant_zeros",
    "is_outside",
    "sampling_zero_warnings",
]

# Loaded when they are used: a running observer needs none of them.
_STRUCTURE = ("Structure", "analyse_structure")
_ZEROS = ("FaultZeros", "Zero", "are_outside", "fault_zeros", "invariant_zeros", "is_outside")


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    home = "structure" if name in _STRUCTURE else "zeros" if name in _ZEROS else "transformations"
    return getattr(import_module(f"{__name__}.{home}"), name)

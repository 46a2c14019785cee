"""What a plant is and what can be known about it: structure, zeros, and plants made from plants."""

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

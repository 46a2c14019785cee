"""Plants made from plants, each with the way back to the original states.

Eliminating algebraic states, sampling, and treating sensor faults as states.
"""

from obsynth.analysis.transformations.augmentation import augment_faults
from obsynth.analysis.transformations.elimination import eliminate_algebraic_states
from obsynth.analysis.transformations.recovery import StateRecovery, Transformation
from obsynth.analysis.transformations.sampling import discretise, sampling_zero_warnings

__all__ = [
    "StateRecovery",
    "Transformation",
    "augment_faults",
    "discretise",
    "eliminate_algebraic_states",
    "sampling_zero_warnings",
]

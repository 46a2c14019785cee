"""What a method hands to the pipeline: gains, realisation and certificate, not yet verified."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from obsynth.analysis.transformations import Transformation
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.dae.observer import DAEObserver
from obsynth.observers.linear.observer import LinearObserver
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem
from obsynth.results.design import Certificate


@dataclass(frozen=True, eq=False)
class Synthesis:
    """The unverified outcome of a method.

    Parameters
    ----------
    options : mapping
        Options as resolved, plain data.
    gains : mapping
        Gains with the paper's letters.
    observer : LinearObserver, RecursiveObserver or DAEObserver
        The realisation.
    certificate : Certificate
        Witnesses and claims.
    solver : mapping
        Records of the solver runs.
    notes : tuple of str
        What a user should know.
    transformation : Transformation, optional
        What the method did to the plant before it designed for it (such as the elimination of algebraic states):
        the design is then for the transformed plant, with the way back.
    plant : TimeVaryingDescriptorSystem, optional
        The plant as the recursive methods see it, where they were given another kind.
    """

    options: Mapping[str, Any]
    gains: Mapping[str, FloatArray]
    observer: LinearObserver | RecursiveObserver | DAEObserver
    certificate: Certificate
    solver: Mapping[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    transformation: Transformation | None = None
    plant: TimeVaryingDescriptorSystem | None = None

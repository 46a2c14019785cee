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
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem
from obsynth.results.design import Certificate


@dataclass(frozen=True, eq=False)
class Synthesis:
    """The unverified outcome of a method.

    Fields: options: Options as resolved, plain data; gains: Gains with the paper's letters; observer: The realisation;
    certificate: Witnesses and claims; solver: Records of the solver runs; notes: What a user should know;
    transformation: What the method did to the plant before it designed for it (such as the elimination of algebraic
    states): the design is then for the transformed plant, with the way back; plant: The plant as the recursive methods
    see it, where they were given another kind; or with the noise that the design is for.
    """

    options: Mapping[str, Any]
    gains: Mapping[str, FloatArray]
    observer: LinearObserver | RecursiveObserver | DAEObserver
    certificate: Certificate
    solver: Mapping[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    transformation: Transformation | None = None
    plant: DescriptorSystem | TimeVaryingDescriptorSystem | None = None

"""The detection filter as a method."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import numpy as np

from obsynth.analysis.existence.condition import Condition
from obsynth.methods.method import ClaimMeaning, Method, PlantKind
from obsynth.numerics.arguments import WrittenAs, is_finite_number
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.results.design import ObserverDesign
from obsynth.verification.claims import STATED_BY_SEARCH
from obsynth.verification.error_system import ErrorModel


@dataclass(frozen=True)
class DetectionFilterMethod(Method):
    """Design the residual filter of largest H-minus over H-infinity, where unknown inputs reach every output.

    In such a plant no residual is free of the unknown inputs and noise.  The best filter makes their transfer function
    to the residuals co-inner; no other filter of gain one responds more to any fault at any frequency.

    Parameters
    ----------
    plant : DescriptorSystem or Transformation
        Continuous time, index 0 or 1, detectable; unknown inputs and noise together reach every output directly
        (``[Dd, Dw]`` of full row rank), noise counting as an unknown input of its deviation.
    band : sequence of float, optional, rad/s
        Lowest and highest frequency at which the faults must show; by default from zero to that of the filter's fastest
        mode.  The filter is the same for every band, and `fault_sensitivity` is that of the band.
    name : str, optional
        Name of the design.

    Returns
    -------
    DetectionFilter
        An `ObserverDesign` with ``ny`` residuals, and the two norms by name.  Both are proved on the error's own
        equations, and on the plant together with the stored numbers where that has a finite gain: a plant that is
        not stable has none unless the stored numbers meet the equations exactly, and ``proved`` is false then.

    Raises
    ------
    SpecError
        The band is no range of frequencies.
    PreconditionError
        The plant is sampled or has no faults.  Or ``[Dd, Dw]`` has not full row rank: some residual is free of unknown
        inputs, see `functional_filter`.  Or a mode that does not decay is unobservable, a zero from the unknown
        inputs to the outputs lies on the imaginary axis (the filter would not be stable), or the index is above one.
    SolverError
        The Riccati equation has no stabilising solution in double precision, or no gain can be proved: such a zero is
        too close to the axis.
    VerificationError
        The shipped realisation fails a check.

    References
    ----------
    .. [Ding] S. X. Ding, T. Jeinsch, P. M. Frank, E. L. Ding, "A unified approach to the optimization of fault
       detection systems", Int. J. Adaptive Control and Signal Processing 14, 2000.
       Ours: both norms are proved on the stored numbers, at every frequency of the band.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[-1.0]], C=[[1.0]], Bf=[[1.0]], Bd=[[0.5]], sensor_noise={"y1": 0.1}
    ... )
    >>> design = obsynth.detection_filter(plant)
    >>> design.method, design.report.passed
    ('detection-filter', True)
    """

    id: ClassVar[str] = "detection-filter"
    plants: ClassVar[tuple[PlantKind, ...]] = ("time-invariant",)
    time: ClassVar[str] = "continuous"
    summary: ClassVar[str] = (
        "residuals alone, as sensitive to the faults as possible where unknown inputs reach every output"
    )
    source: ClassVar[str] = "Ding, Jeinsch, Frank, Ding 2000"
    claims: ClassVar[Mapping[str, ClaimMeaning]] = {
        "disturbance_gain": ClaimMeaning(
            "",
            "bound on the H-infinity norm from unknown inputs and noise to the residuals",
            "disturbance gain",
            side="at most",
        ),
        "fault_sensitivity": ClaimMeaning(
            "",
            "least singular value from the faults to the residuals on the band: at least this",
            "fault sensitivity",
            side="at least",
        ),
        "band_from": ClaimMeaning("rad/s", "where the band begins", "fault sensitivity"),
        "band_to": ClaimMeaning("rad/s", "where the band ends", "fault sensitivity"),
        "frequency": ClaimMeaning(
            "rad/s", "where the sensitivity to the faults is least on the band", STATED_BY_SEARCH
        ),
    }
    witnesses: ClassVar[frozenset[str]] = frozenset({"P"})

    band: Annotated[Any, WrittenAs("pair")] = None

    def conflicts(self) -> Iterator[str]:
        """Yield a sentence for each rule across options that is broken."""
        if self.band is None:
            return
        listed = list(self.band) if isinstance(self.band, (list, tuple, np.ndarray)) else []
        if len(listed) != 2 or not all(map(is_finite_number, listed)) or not 0.0 <= listed[0] < listed[1]:
            yield f"band is {self.band!r}: give the lowest and the highest frequency in rad/s."

    def existence(self, plant: DescriptorSystem, *, exactly: bool = True) -> tuple[Condition, ...]:
        """Return the existence conditions of a plant."""
        from obsynth.analysis.existence.ding2000 import conditions

        return conditions(plant)

    @classmethod
    def error_model(cls, design: ObserverDesign) -> ErrorModel:
        """Return the plant without algebraic states: the filter follows x, and its residuals stand for zero."""
        plant, observer = design.linear
        return ErrorModel(plant, observer, np.eye(plant.nx))

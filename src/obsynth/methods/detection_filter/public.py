"""The public function of the detection filter, and its result: a design whose two norms have names."""

from __future__ import annotations

from dataclasses import dataclass

from obsynth.methods.detection_filter.checks import TOGETHER
from obsynth.methods.detection_filter.method import DetectionFilterMethod
from obsynth.methods.functions import design_function
from obsynth.methods.verifying import verify
from obsynth.results.design import ObserverDesign, describe_parameters
from obsynth.results.verification_report import VerificationReport


@dataclass(frozen=True, repr=False)
class DetectionFilter(ObserverDesign):
    """The design of a residual filter of least gain from the unknown inputs for what it shows of the faults.

    An `ObserverDesign` in every respect; made by `detection_filter`.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[-1.0]], C=[[1.0]], Bf=[[1.0]], Bd=[[0.5]], sensor_noise={"y1": 0.1}
    ... )
    >>> design = obsynth.detection_filter(plant)
    >>> isinstance(design, obsynth.types.DetectionFilter), design.method
    (True, 'detection-filter')
    """

    @property
    def disturbance_gain(self) -> float:
        """Bound on the H-infinity norm from unknown inputs and noise to the residuals."""
        return float(self.certificate.claims["disturbance_gain"])

    @property
    def fault_sensitivity(self) -> float:
        """H-minus: the least singular value from the faults to the residuals on the band is at least this."""
        return float(self.certificate.claims["fault_sensitivity"])

    @property
    def frequency(self) -> float:
        """Where on the band it is least, rad/s."""
        return float(self.certificate.claims["frequency"])

    @property
    def band(self) -> tuple[float, float]:
        """The range of frequencies, rad/s."""
        claims = self.certificate.claims
        return float(claims["band_from"]), float(claims["band_to"])

    @property
    def ratio(self) -> float:
        """H-minus over H-infinity: the largest that any filter has, but for the margins of the proofs."""
        return self.fault_sensitivity / self.disturbance_gain

    @property
    def proved(self) -> bool:
        """Whether both norms are proved for the plant together with the filter as it is stored, rounding included."""
        rows = {row.name: row for row in self.report.checks}
        return self.report.passed and TOGETHER in rows and rows[TOGETHER].status == "proved"

    def verify(self) -> VerificationReport:
        """Prove both norms again, from the plant and the shipped filter alone."""
        return verify(self)


# Its parameters are those of every design.
describe_parameters(DetectionFilter)

detection_filter = design_function(DetectionFilterMethod, DetectionFilter)

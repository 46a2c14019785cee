"""The names of what a linear design reads and estimates, as an engine has them."""

from __future__ import annotations

from collections.abc import Mapping

from obsynth.results.design import ObserverDesign


class LinearSignalNames:
    """Names, delays, operating point and scales of a linear design.

    Fields: design: Linear.
    """

    def __init__(self, design: ObserverDesign) -> None:
        self.plant, self.observer = design.linear

    @property
    def input_names(self) -> tuple[str, ...]:
        """Known inputs."""
        return self.observer.input_names

    @property
    def output_names(self) -> tuple[str, ...]:
        """Outputs of the plant."""
        return self.observer.output_names

    @property
    def state_names(self) -> tuple[str, ...]:
        """States that are estimated."""
        return self.observer.state_names

    @property
    def fault_names(self) -> tuple[str, ...]:
        """Faults that are estimated."""
        return self.observer.fault_names

    @property
    def state_delays(self) -> tuple[int, ...]:
        """Samples by which each state estimate lags."""
        return self.observer.state_delays

    @property
    def fault_delays(self) -> tuple[int, ...]:
        """Samples by which each fault estimate lags."""
        return self.observer.fault_delays

    @property
    def dt(self) -> float:
        """Seconds between samples; 0 for continuous time."""
        return self.observer.dt

    @property
    def scales(self) -> Mapping[str, float]:
        """Factor of inputs and outputs by name."""
        return self.plant.scales

    @property
    def point(self) -> Mapping[str, float]:
        """Operating point by name of the signal."""
        return self.plant.operating_point

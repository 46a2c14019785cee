"""The rows that an observer returns at each sample: states, faults and residuals, one below the other, by name."""

from __future__ import annotations

from typing import TYPE_CHECKING

from obsynth.numerics.arrays import FloatArray, read_only
from obsynth.observers.estimates import Estimates


class EstimateRows:
    """The layout of a row ``[xhat; fhat; r]`` of an observer that has names of these signals, and their delays."""

    if TYPE_CHECKING:  # fields of some observers, properties of others

        @property
        def state_names(self) -> tuple[str, ...]:
            """The states that are estimated, in order."""

        @property
        def fault_names(self) -> tuple[str, ...]:
            """The faults that are estimated, in order."""

        @property
        def residual_names(self) -> tuple[str, ...]:
            """The residuals, in order."""

        @property
        def state_delays(self) -> tuple[int, ...]:
            """Samples by which each state estimate lags."""

        @property
        def fault_delays(self) -> tuple[int, ...]:
            """Samples by which each fault estimate lags."""

    @property
    def row_names(self) -> tuple[str, ...]:
        """Names of the rows: ``xhat[...]``, ``fhat[...]``, ``r[...]``."""
        kinds = (("xhat", self.state_names), ("fhat", self.fault_names), ("r", self.residual_names))
        return tuple(f"{kind}[{name}]" for kind, names in kinds for name in names)

    @property
    def state_rows(self) -> slice:
        """Rows that hold the state estimates."""
        return slice(0, len(self.state_names))

    @property
    def fault_rows(self) -> slice:
        """Rows that hold the fault estimates."""
        return slice(len(self.state_names), len(self.state_names) + len(self.fault_names))

    @property
    def residual_rows(self) -> slice:
        """Rows that hold the residuals."""
        return slice(self.fault_rows.stop, self.fault_rows.stop + len(self.residual_names))

    def split(self, rows: FloatArray) -> Estimates:
        """Return the estimates in rows.

        Parameters
        ----------
        rows : FloatArray
            ``(..., samples, nx + nf + nr)``: what `advance` returned, one below the other.
        """
        return Estimates(
            read_only(rows[..., self.state_rows]),
            read_only(rows[..., self.fault_rows]),
            read_only(rows[..., self.residual_rows]),
            self.state_names,
            self.fault_names,
            self.residual_names,
            self.state_delays,
            self.fault_delays,
        )

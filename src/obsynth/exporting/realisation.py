"""What every export holds: one discrete- or continuous-time realisation, its names, and the digest of the gain set."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.linear import LinearObserver
from obsynth.observers.sampling import sample_observer
from obsynth.results.design import ObserverDesign
from obsynth.results.serialise import design_as_dict


@dataclass(frozen=True, eq=False)
class Realisation:
    """The observer of a design, ready to be handed on.

    Parameters
    ----------
    design : ObserverDesign
        Linear.
    observer : LinearObserver
        Its observer, sampled if that was asked for.
    digest : str
        sha256 of the gain set.
    """

    design: ObserverDesign
    observer: LinearObserver
    digest: str

    @classmethod
    def of(cls, design: ObserverDesign, sample_time: float | None) -> Realisation:
        """Return the realisation of a design.

        Parameters
        ----------
        design : ObserverDesign
            Linear.
        sample_time : float or None
            Seconds; samples a continuous-time observer by a first-order hold.

        Raises
        ------
        SpecError
            The design is recursive, or the sample time is not positive or does not fit a sampled design.
        """
        _, observer = design.linear
        if sample_time is not None:
            if observer.dt > 0.0:
                raise SpecError(
                    f"The design is sampled already (dt = {observer.dt:g} s): leave the sample time out.",
                    path="sample_time",
                )
            observer = sample_observer(observer, sample_time)
        return cls(design, observer, str(design_as_dict(design)["sha256"]))

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the inputs: known inputs, then outputs of the plant."""
        return self.observer.input_names + self.observer.output_names

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the outputs, ``xhat[...]``, ``fhat[...]``, ``r[...]``."""
        observer = self.observer
        kinds = (("xhat", observer.state_names), ("fhat", observer.fault_names), ("r", observer.residual_names))
        return tuple(f"{kind}[{name}]" for kind, names in kinds for name in names)

    @property
    def operating_point(self) -> tuple[FloatArray, FloatArray]:
        """The operating point of inputs and of outputs: inputs are deviations from it, outputs as well."""
        point = self.design.linear[0].operating_point
        estimated = self.observer.state_names + self.observer.fault_names
        after = [point.get(name, 0.0) for name in estimated] + [0.0] * len(self.observer.residual_names)
        return np.array([point.get(name, 0.0) for name in self.inputs]), np.array(after)

    def as_arrays(self) -> dict[str, Any]:
        """Return ``A, B, C, D, x0, Ts`` and everything else by name."""
        observer = self.observer
        before, after = self.operating_point
        return {
            "A": observer.Az, "B": np.hstack([observer.Bu, observer.By]), "C": observer.Cz,
            "D": np.hstack([observer.Du, observer.Dy]), "x0": np.zeros((observer.order, 1)), "Ts": observer.dt,
            "input_point": before, "output_point": after,
            "delays": np.array([*observer.state_delays, *observer.fault_delays], dtype=np.float64),
            "input_names": list(self.inputs), "output_names": list(self.outputs),
            "name": self.design.name, "method": self.design.method, "sha256": self.digest,
        }  # fmt: skip

"""What every export holds: one discrete- or continuous-time realisation, its names, and the digest of the gain set."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.methods.handing_on import unverified_mark
from obsynth.numerics.arguments import require_kind
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.dae.observer import DAEObserver
from obsynth.observers.linear.derived import sample_observer
from obsynth.observers.linear.observer import LinearObserver
from obsynth.observers.recursive.gain_schedule import steady_observer
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.plants.dae.model import DAEModel
from obsynth.results.design import ObserverDesign
from obsynth.results.gain_sets import gain_set_digest

#: What a file says about the steady state of a recursion.
STEADY = (
    "The steady state of a recursive design: its estimates are those of the recursion once the covariances have "
    "settled, and it takes complete samples only."
)


@dataclass(frozen=True, eq=False)
class Realisation:
    """The observer of a design, sampled if that was asked for, or the steady state of its recursion; from ``z(0)``."""

    design: ObserverDesign
    observer: LinearObserver
    digest: str
    start: FloatArray
    note: str = ""

    @classmethod
    def of(cls, design: ObserverDesign, sample_time: float | None) -> Realisation:
        """Return the realisation of a design."""
        require_kind(design, ObserverDesign, "design", "an ObserverDesign, such as obsynth.load(path)")
        digest = gain_set_digest(design)
        if isinstance(design.observer, RecursiveObserver):
            if design.observer.outliers != "none":
                raise SpecError(
                    f"Design {design.name!r} uses the option 'outliers', which exported code does not know: design it "
                    "without, or run it with obsynth run.",
                    path="outliers",
                )
            found = steady_observer(design.observer)
            if sample_time is not None:
                raise SpecError("A recursive design is sampled already: leave the sample time out.", path="sample_time")
            return cls(design, found.observer, digest, found.start, STEADY)
        if isinstance(design.observer, DAEObserver):
            raise SpecError(
                f"Design {design.name!r} is for a nonlinear plant: it has no constant gains to write. Run it with "
                "obsynth run, or with observer.step.",
                path="observer",
            )
        _, observer = design.linear
        if sample_time is not None:
            if observer.dt > 0.0:
                raise SpecError(
                    f"The design is sampled already (dt = {observer.dt:g} s): leave the sample time out.",
                    path="sample_time",
                )
            observer = sample_observer(observer, sample_time)
        return cls(design, observer, digest, np.zeros(observer.order))

    @property
    def mark(self) -> str:
        """What every file says of a design that fails its verification; empty where it holds."""
        return unverified_mark(self.design.report)

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the inputs: known inputs, then outputs of the plant."""
        return self.observer.input_names + self.observer.output_names

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the outputs, ``xhat[...]``, ``fhat[...]``, ``r[...]``."""
        return self.observer.row_names

    @property
    def operating_point(self) -> tuple[FloatArray, FloatArray]:
        """The operating point of inputs and of outputs: inputs are deviations from it, outputs as well."""
        plant = self.design.plant
        point = {} if isinstance(plant, DAEModel) else plant.operating_point
        biases = getattr(plant, "sensor_faults", ())
        after = [point.get(name, 0.0) for name in self.observer.state_names]
        after += [0.0 if name in biases else point.get(name, 0.0) for name in self.observer.fault_names]
        after += [0.0] * len(self.observer.residual_names)
        return np.array([point.get(name, 0.0) for name in self.inputs]), np.array(after)

    def as_arrays(self) -> dict[str, Any]:
        """Return ``A, B, C, D, x0, Ts`` and everything else by name."""
        observer = self.observer
        before, after = self.operating_point
        return {
            "A": observer.Az,
            "B": np.hstack([observer.Bu, observer.By]),
            "C": observer.Cz,
            "D": np.hstack([observer.Du, observer.Dy]),
            "x0": self.start.reshape(-1, 1),
            "Ts": observer.dt,
            "input_point": before,
            "output_point": after,
            "delays": np.array([*observer.state_delays, *observer.fault_delays], dtype=np.float64),
            "input_names": list(self.inputs),
            "output_names": list(self.outputs),
            "name": self.design.name,
            "method": self.design.method,
            "sha256": self.digest,
            **({"unverified": self.mark} if self.mark else {}),
        }

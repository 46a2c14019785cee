"""The realisation that an export holds, discrete or continuous in time, with its names and the gain set's digest."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from obsynth.errors import SpecError
from obsynth.methods.state_solver import state_solver
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.continuous import first_order_hold
from obsynth.observers.linear.missing_samples import GAP_LEFT_SHARE, LEAST_SHOWN, MissingSamples
from obsynth.observers.linear.observer import LinearObserver
from obsynth.observers.linear.sampled import sample_observer
from obsynth.observers.nonlinear.observer import DAEObserver
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.observers.recursive.steady_observer import steady_observer
from obsynth.plants.dae import DAEModel
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem
from obsynth.results.checks import with_verdict
from obsynth.results.design import ObserverDesign, unverified_mark
from obsynth.results.gain_set_writing import gain_set_digest

#: What a file says about the steady state of a recursion.
STEADY = (
    "The steady state of a recursive design: its estimates are those of the recursion once the covariances have "
    "settled, and where a sample is missing the model alone is used."
)


class GapTables(NamedTuple):
    """Sizes and matrices of the plant's model, which replaces the sensors where a sample is missing, as on logs."""

    faults: int  # of the plant
    estimated: tuple[int, ...]  # which of them the observer estimates
    kept_inputs: int = 1
    states: int = 0
    known_states: int = 0
    exists: bool = False
    solved: bool = False
    tables: Mapping[str, FloatArray] = MappingProxyType({})
    left_share: float = 0.0
    least_shown: int = 0


@dataclass(frozen=True, eq=False)
class Realisation:
    """The observer of a design, sampled if that was asked for, or the steady state of its recursion; from ``z(0)``."""

    design: ObserverDesign
    observer: LinearObserver
    digest: str
    start: FloatArray
    note: str = ""
    precision: str = "double"

    @classmethod
    def of(cls, design: ObserverDesign, sample_time: float | None, precision: str = "double") -> Realisation:
        """Return the realisation of a design."""
        digest = gain_set_digest(design)
        if isinstance(design.observer, RecursiveObserver):
            if design.observer.outliers != "none":
                raise SpecError(
                    f"Design {design.name!r} uses the option 'outliers', which exported code does not know: design it "
                    "without, or run it with obsynth run.",
                    path="outliers",
                )
            steady = steady_observer(design.observer)
            if sample_time is not None:
                raise SpecError("A recursive design is sampled already: leave the sample time out.", path="sample_time")
            return cls(design, steady.observer, digest, steady.start, STEADY, precision)
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
        return cls(design, observer, digest, np.zeros(observer.order), precision=precision)

    @property
    def straight(self) -> bool:
        """Whether signals are taken as straight lines between samples, as the design is continuous in time."""
        return isinstance(self.design.observer, LinearObserver) and self.design.observer.dt == 0.0 < self.observer.dt

    @property
    def running(self) -> LinearObserver:
        """The observer whose output matrices are used: a continuous one unsampled, whose state a run starts at zero."""
        return self.design.linear[1] if self.straight else self.observer

    @cached_property
    def transition(self) -> dict[str, FloatArray]:
        """Matrices of one step of z: of inputs and outputs at the sample before, or of these and of their rise, where
        signals are straight lines between samples."""
        if not self.straight:
            return {"z": self.observer.Az, "u": self.observer.Bu, "y": self.observer.By}
        driven = np.hstack([self.running.Bu, self.running.By])
        return dict(
            zip(("z", "before", "rise"), first_order_hold(self.running.Az, driven, self.observer.dt), strict=True)
        )

    @cached_property
    def gap(self) -> GapTables:
        """The model that goes on where a sample is missing; without one the observer starts again."""
        observer, plant = self.observer, _constant_plant(self.design.plant)
        nothing = GapTables(len(observer.fault_names), tuple(range(len(observer.fault_names))))
        signals = observer.input_names, observer.output_names
        if plant is None or (plant.input_names, plant.output_names) != signals:
            return nothing
        if not set(observer.fault_names) <= set(plant.fault_names):
            return nothing
        solver = state_solver(self.design.replace(plant=plant, observer=self.running))
        missing = MissingSamples(plant, self.running, solver)
        model = missing.model
        estimated = tuple(missing.estimated_faults)
        if model is None:
            return GapTables(plant.nf, estimated)
        moving = model.plant
        if self.straight:
            held = first_order_hold(moving.A, np.hstack([moving.B, moving.Bf]), observer.dt)
            moves: tuple[FloatArray, ...] = (
                held[0],
                held[1][:, : moving.nu],
                held[1][:, moving.nu :],
                held[2][:, : moving.nu],
            )
        else:
            moves = (moving.A, moving.B, moving.Bf)
        tables = dict(zip(("model_A", "model_B", "model_F", "model_R"), moves, strict=False))
        tables |= {"model_C": moving.C, "model_D": moving.D, "model_Df": moving.Df, "model_into": model.into}
        tables |= {"noise_variances": missing.noise[None]}
        if solver is not None:
            tables |= {"source_D": plant.D, "source_Df": plant.Df, "model_solver": solver}
        kept_inputs = missing.kept_inputs
        return GapTables(
            plant.nf, estimated, kept_inputs, moving.nx, missing.known_states, True, solver is not None, tables,
            GAP_LEFT_SHARE, LEAST_SHOWN,
        )  # fmt: skip

    @property
    def mark(self) -> str:
        """The mark in every file of a design that fails its verification; empty where it holds."""
        return unverified_mark(self.design.report)

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the inputs: known inputs, then outputs of the plant."""
        return self.observer.input_names + self.observer.output_names

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
            "output_names": list(observer.row_names),
            "name": self.design.name,
            "method": self.design.method,
            "sha256": self.digest,
            **({"unverified": self.mark} if self.mark else {}),
        }


def verification_words(design: ObserverDesign) -> str:
    """Return the status of a design's verification, in a sentence."""
    mark = unverified_mark(design.report)
    return mark or f"Verified: all {len(with_verdict(design.report.checks))} checks of obsynth hold."


def _constant_plant(plant: Any) -> DescriptorSystem | None:
    """Return the plant of a linear observer; that of a recursion, if it is one that changes with nothing."""
    if isinstance(plant, DescriptorSystem):
        return plant
    if not isinstance(plant, TimeVaryingDescriptorSystem) or not plant.is_time_invariant:
        return None
    parts = {name: sequence.at(1) for name, sequence in plant.matrices.items()}
    names = ("state_names", "input_names", "output_names", "operating_point", "units")
    try:
        return DescriptorSystem(
            parts["E"], parts["A"], B=parts["B"], C=parts["C"], Bf=parts["Phi"], Df=parts["Psi"], D=parts["D"],
            dt=plant.dt, fault_names=plant.parameter_names, **{name: getattr(plant, name) for name in names},
        )  # fmt: skip
    except SpecError:
        # More or fewer equations than states.
        return None

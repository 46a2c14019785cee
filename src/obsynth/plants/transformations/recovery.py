"""The result of a transformation: the new plant, and the map from its states back to those of its source."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics.arrays import FloatArray, freeze, read_only
from obsynth.numerics.sparse_factor import SolutionBounds
from obsynth.numerics.suggestions import no_attribute
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.transformations.recovery_operator import RecoveryOperator
from obsynth.plants.uncertainty import matrices_of

#: Map of a recovery -> the signal that it maps.
_RECOVERED_SIGNALS = {
    "from_state": "state",
    "from_input": "input",
    "from_fault": "fault",
    "from_disturbance": "disturbance",
    "from_noise": "noise",
}


@dataclass(frozen=True, eq=False)
class StateRecovery:
    """``x_source = from_state x + from_input u + from_fault f + from_disturbance d + from_noise w``, read-only maps."""

    names: tuple[str, ...]
    from_state: FloatArray
    from_input: FloatArray
    from_fault: FloatArray
    from_disturbance: FloatArray
    from_noise: FloatArray
    noise_kept: FloatArray  # ``(nw_source, nw)``: the source's noise as far as it is left
    operating_point: Mapping[str, float] = field(default_factory=dict)  # of the source states

    def __post_init__(self) -> None:
        freeze(self, *_RECOVERED_SIGNALS, "noise_kept")
        object.__setattr__(self, "operating_point", dict(self.operating_point))

    @classmethod
    def from_operator(
        cls, names: Sequence[str], operator: RecoveryOperator, noise_kept: FloatArray, point: Mapping[str, float]
    ) -> StateRecovery:
        """Return a recovery by sparse solutions: a dense map is formed only where one is asked for."""
        made = object.__new__(cls)
        parts = {"names": tuple(names), "operator": operator, "noise_kept": read_only(noise_kept)}
        for name, value in {**parts, "operating_point": dict(point)}.items():
            object.__setattr__(made, name, value)
        return made

    def __getattr__(self, name: str) -> FloatArray:
        """Form a map of a recovery by sparse solutions when it is first asked for."""
        operator = self.__dict__.get("operator")
        if operator is None or name not in _RECOVERED_SIGNALS:
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        matrix = read_only(operator.matrix(_RECOVERED_SIGNALS[name]))
        object.__setattr__(self, name, matrix)
        return matrix

    @property
    def by_operator(self) -> RecoveryOperator | None:
        """The sparse operator behind the maps of a large plant, or ``None``."""
        return self.__dict__.get("operator")

    def flags(self) -> tuple[str, ...]:
        """Return per source state what an estimate from state and input alone is; where both hold, the bias."""
        return tuple(
            "biased by the disturbance" if biased.any() else "needs the fault estimate" if faulty.any() else "exact"
            for biased, faulty in zip(self.from_disturbance, self.from_fault, strict=True)
        )

    def then(self, later: StateRecovery) -> StateRecovery:
        """Return the recovery through two transformations, this one first."""
        if (operator := self.by_operator) is not None:
            through = operator.then(
                {signal: getattr(later, name) for name, signal in _RECOVERED_SIGNALS.items()}, later.noise_kept
            )
            source_noise = self.noise_kept @ later.noise_kept
            return StateRecovery.from_operator(self.names, through, source_noise, self.operating_point)
        step = self.from_state
        own = {
            "from_input": self.from_input,
            "from_fault": self.from_fault,
            "from_disturbance": self.from_disturbance,
            "from_noise": self.from_noise @ later.noise_kept,
        }
        maps = {name: step @ getattr(later, name) + direct for name, direct in own.items()}
        return replace(self, from_state=step @ later.from_state, noise_kept=self.noise_kept @ later.noise_kept, **maps)


@dataclass(frozen=True, eq=False)
class Transformation:
    """A plant made from another; ``dropped`` states are not recovered; ``bounds``: of sparse solutions;
    ``is_of_lower_index``: constraints were solved with their derivatives, which tolerances do not follow."""

    source: DescriptorSystem
    plant: DescriptorSystem
    description: str
    recovery: StateRecovery
    dropped: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    bounds: SolutionBounds | None = None
    is_of_lower_index: bool = False

    def __repr__(self) -> str:
        return f"<Transformation: {self.description or 'nothing changed'}; plant: {self.plant!r}>"

    def __getattr__(self, name: str) -> Any:
        made = self.__dict__.get("plant")
        own = {} if name.startswith("_") or not hasattr(made, name) else {name: f"transformation.plant.{name}"}
        raise no_attribute(self, name, own)

    def with_tolerances(self, kind: str, size: float = 0.0) -> Transformation:
        """Return the step with the tolerances of its source carried on to its plant."""
        before = self.source.uncertainty
        if before is None:
            return self
        after = before if before.lost else before.then(matrices_of(self.source), kind, size)
        return replace(self, plant=self.plant.replace(uncertainty=after))

    def then(self, later: Transformation) -> Transformation:
        """Return both steps as one, for a ``later`` that starts from this one's plant."""
        lost = set(self.plant.delays).intersection(self.plant.input_names) - set(later.plant.delays)
        if lost and np.any(self.recovery.from_input):
            raise SpecError(
                "Delayed inputs act on states that were eliminated: give the transformation itself to discretise or "
                "absorb_delays.",
                path="delays",
            )
        description = "; ".join(text for text in (self.description, later.description) if text)
        return Transformation(
            self.source,
            later.plant,
            description,
            self.recovery.then(later.recovery),
            self.dropped + later.dropped,
            self.notes + later.notes,
            self.bounds or later.bounds,
            self.is_of_lower_index or later.is_of_lower_index,
        )


def unchanged_states(
    source: DescriptorSystem, new: DescriptorSystem, *, from_state: FloatArray, noise_kept: FloatArray | None = None
) -> StateRecovery:
    """Return the recovery of a transformation that adds no direct effect of any signal on the states."""
    inputs, faults, disturbances, noise = (np.zeros((source.nx, n)) for n in (new.nu, new.nf, new.nd, new.nw))
    source_noise = np.eye(source.nw) if noise_kept is None else noise_kept
    point = state_point(source)
    return StateRecovery(source.state_names, from_state, inputs, faults, disturbances, noise, source_noise, point)


def state_point(plant: DescriptorSystem) -> dict[str, float]:
    """Return the operating point of the states of a plant, as far as it is stated."""
    return {name: value for name, value in plant.operating_point.items() if name in plant.state_names}


def with_states(plant: DescriptorSystem, names: Sequence[str], **changes: Any) -> DescriptorSystem:
    """Replace matrices and states, dropping operating points and units of states that are gone."""
    others = (plant.input_names, plant.output_names, plant.fault_names, plant.disturbance_names, plant.noise_names)
    # An output or a fault may carry the name of the state it was picked by, and outlives it.
    gone = set(plant.state_names) - set(names) - {name for signals in others for name in signals}

    labels = {
        label: {name: value for name, value in getattr(plant, label).items() if name not in gone}
        for label in ("operating_point", "units")
    }
    return plant.replace(state_names=names, **labels, **changes)

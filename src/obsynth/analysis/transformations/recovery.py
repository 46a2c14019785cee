"""What a transformation did, and the map back to the states of the plant it started from; faults as states.

From what elimination left of a large plant its states come by a sparse solution instead of a dense matrix.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from obsynth.analysis.zeros import leading_names
from obsynth.errors import PreconditionError, SpecError
from obsynth.numerics.arguments import FloatArray, freeze, read_only, require_kind
from obsynth.numerics.ranks import CANCELLATION_TOLERANCE, NEGLIGIBLE_INPUT, decide_rank
from obsynth.numerics.scaling import equilibrate_pencil
from obsynth.numerics.sparse import MEAN_FACTOR, SIZE_SAMPLES, SolutionBounds, SparseFactor, csr, sparse_factor
from obsynth.plants.constants import Uncertainty, matrices_of
from obsynth.plants.dae import DAEModel
from obsynth.plants.descriptor import DescriptorSystem, index_of

#: Signals in the order in which they stand in the algebraic equations.
SIGNAL_ORDER = ("state", "input", "fault", "disturbance", "noise")


@dataclass(frozen=True, eq=False)
class RecoveryOperator:
    """``x = dynamic xi + algebraic z`` with ``coupling z + right [xi; u; f; d; w] = 0``, all sparse."""

    dynamic: Any  # ``(nx, count)``
    algebraic: Any
    coupling: Any  # ``(nx - count, nx - count)``, nonsingular
    right: Any
    counts: tuple[int, ...]  # of states, inputs, faults, disturbances, noise
    states: Mapping[str, FloatArray] = field(default_factory=dict)  # ``xi`` from the plant's signals now
    noise_kept: FloatArray | None = None

    @cached_property
    def factor(self) -> SparseFactor:
        """Factors of the algebraic equations."""
        return sparse_factor(self.coupling)

    def __getstate__(self) -> dict[str, Any]:
        """Leave the factors behind: they belong to this process."""
        return {name: value for name, value in self.__dict__.items() if name != "factor"}

    @property
    def state_count(self) -> int:
        """Number of states of the plant now."""
        step = self.states.get("state")
        return self.counts[0] if step is None else int(step.shape[1])

    def matrix(self, signal: str) -> FloatArray:
        """Return the dense map from one kind of signal, ``(nx, n)``."""
        own = np.eye(self.counts[SIGNAL_ORDER.index(signal)])
        if signal == "noise" and self.noise_kept is not None:
            own = self.noise_kept
        if signal == "state":
            return self.apply(self.states.get(signal, own), {})
        return self.apply(self.states.get(signal, np.zeros((self.counts[0], own.shape[1]))), {signal: own})

    def apply(self, xi: FloatArray, signals: Mapping[str, FloatArray]) -> FloatArray:
        """Return columns of ``x`` for columns of the eliminated plant's states and of its signals."""
        ends = np.cumsum([0, *self.counts])
        terms = np.zeros((self.right.shape[0], xi.shape[1]))
        for name, columns in {"state": xi, **signals}.items():
            place = SIGNAL_ORDER.index(name)
            terms = terms + self.right[:, ends[place] : ends[place + 1]] @ columns
        solution = without_rounding(self.factor, -self.factor.solve(terms))
        return np.asarray(self.dynamic @ xi + self.algebraic @ solution)

    def then(self, later: Mapping[str, FloatArray], noise_kept: FloatArray) -> RecoveryOperator:
        """Return the operator through another transformation: its maps of ``xi`` by signal, and the noise it kept."""
        step = self.states.get("state")
        states = {name: matrix if step is None else step @ matrix for name, matrix in later.items()}
        for name, matrix in self.states.items():
            if name != "state":
                own = matrix @ noise_kept if name == "noise" else matrix
                states[name] = states.get(name, np.zeros_like(own)) + own
        kept = noise_kept if self.noise_kept is None else self.noise_kept @ noise_kept
        return replace(self, states=states, noise_kept=kept)

    def as_dict(self) -> dict[str, Any]:
        """Return plain data: the parts of the sparse matrices as arrays."""
        found: dict[str, Any] = {"counts": list(self.counts), "states": dict(self.states), "noise": self.noise_kept}
        for name in ("dynamic", "algebraic", "coupling", "right"):
            matrix = csr(getattr(self, name))
            found[name] = {
                "rows": matrix.shape[0],
                "columns": matrix.shape[1],
                "values": matrix.data,
                "indices": matrix.indices.astype(np.float64),
                "starts": matrix.indptr.astype(np.float64),
            }
        return found

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> RecoveryOperator:
        """Return what `as_dict` wrote."""
        from scipy.sparse import csr_array

        def matrix(entry: Mapping[str, Any]) -> Any:
            indices, starts = (np.asarray(entry[name]).astype(np.int64) for name in ("indices", "starts"))
            shape = int(entry["rows"]), int(entry["columns"])
            return csr_array((np.asarray(entry["values"]), indices, starts), shape=shape)

        parts = {name: matrix(data[name]) for name in ("dynamic", "algebraic", "coupling", "right")}
        noise = None if data["noise"] is None else np.asarray(data["noise"])
        states = {name: np.asarray(matrix) for name, matrix in data["states"].items()}
        return cls(**parts, counts=tuple(int(n) for n in data["counts"]), states=states, noise_kept=noise)


def without_rounding(factor: SparseFactor, solution: FloatArray) -> FloatArray:
    """Set entries to zero that are so small beside the terms they come from that they are only rounding."""
    sizes = np.abs(solution) / factor.columns[:, None]
    # No sum of terms is larger than the condition number times the largest unknown.
    most = CANCELLATION_TOLERANCE * factor.condition * np.max(sizes, axis=0, initial=0.0)
    suspicious = (sizes > 0.0) & (sizes <= most)
    rows, columns = np.flatnonzero(suspicious.any(axis=1)), np.flatnonzero(suspicious.any(axis=0))
    if not rows.size:
        return solution
    found = solution.copy()
    part = np.ix_(rows, columns)
    if len(rows) > SIZE_SAMPLES * len(columns):
        # Many rows: almost all of them are decided by an estimate.
        usual = CANCELLATION_TOLERANCE * factor.usual_size_of_terms(solution[:, columns])[rows]
        nothing = np.abs(solution[part]) <= usual / MEAN_FACTOR
        found[part] = np.where(nothing, 0.0, solution[part])
        open_still = ~nothing & (np.abs(solution[part]) <= usual * MEAN_FACTOR * np.sqrt(factor.size))
        rows = rows[open_still.any(axis=1)]
        if not rows.size:
            return found
        part = np.ix_(rows, columns)
    terms = factor.size_of_terms(solution[:, columns], rows)
    found[part] = np.where(np.abs(solution[part]) > CANCELLATION_TOLERANCE * terms, found[part], 0.0)
    return found


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
        """Return per source state what an estimate from state and input alone is; a bias wins."""
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
            kept = self.noise_kept @ later.noise_kept
            return StateRecovery.from_operator(self.names, through, kept, self.operating_point)
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
    """A plant made from another; ``dropped`` states are not recovered; ``bounds``: of sparse solutions."""

    source: DescriptorSystem
    plant: DescriptorSystem
    description: str
    recovery: StateRecovery
    dropped: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    bounds: SolutionBounds | None = None

    def with_tolerances(self, kind: str, size: float = 0.0) -> Transformation:
        """Return the step with the tolerances of its source carried on to its plant."""
        before = self.source.uncertainty
        if before is None:
            return self
        after = before if before.lost else before.then(matrices_of(self.source), kind, size)
        return replace(self, plant=self.plant.replace(uncertainty=after))

    def then(self, later: Transformation) -> Transformation:
        """Return both steps as one, for a ``later`` that starts from this one's plant."""
        description = "; ".join(text for text in (self.description, later.description) if text)
        return Transformation(
            self.source,
            later.plant,
            description,
            self.recovery.then(later.recovery),
            self.dropped + later.dropped,
            self.notes + later.notes,
            self.bounds or later.bounds,
        )


def plant_and_recovery(given: Any, recovery: StateRecovery | None = None) -> tuple[Any, StateRecovery | None]:
    """Return the plant of a transformation with its way back, or a plant as it is; a stated way back goes first."""
    if not isinstance(given, Transformation):
        return given, recovery
    return given.plant, given.recovery if recovery is None else recovery


def linear_plant(given: Any) -> DescriptorSystem:
    """Return a linear plant, of a transformation the transformed one; raise `SpecError` for anything else."""
    plant = given.plant if isinstance(given, Transformation) else given
    if isinstance(plant, DAEModel):
        raise SpecError(
            "This is for linear plants; of a plant of equations give the linear one that its spec makes with "
            "transform: {linearise: {at: equilibrium, faults: [...]}}, or obsynth.linearise.",
            path="plant",
        )
    require_kind(plant, DescriptorSystem, "plant", "an obsynth.DescriptorSystem")
    found: DescriptorSystem = plant
    return found


def unchanged_states(
    source: DescriptorSystem, new: DescriptorSystem, *, from_state: FloatArray, noise_kept: FloatArray | None = None
) -> StateRecovery:
    """Return the recovery of a transformation that adds no direct effect of any signal on the states."""
    inputs, faults, disturbances, noise = (np.zeros((source.nx, n)) for n in (new.nu, new.nf, new.nd, new.nw))
    kept = np.eye(source.nw) if noise_kept is None else noise_kept
    point = state_point(source)
    return StateRecovery(source.state_names, from_state, inputs, faults, disturbances, noise, kept, point)


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


def augment_faults(plant: DescriptorSystem, faults: Sequence[str]) -> Transformation:
    """Append the chosen faults that act on the outputs as algebraic states ``phi = f``."""
    columns = [index_of(name, plant.fault_names, what="The plant") for name in faults]
    chosen = sorted({column for column in columns if plant.Df[:, column].any()})
    nx, count = plant.nx, len(chosen)
    chosen_names = [plant.fault_names[column] for column in chosen]
    names = [f"fault:{name}" for name in chosen_names]
    output = np.hstack([plant.C, plant.Df[:, chosen]])
    E, A = np.zeros((nx + count, nx + count)), -np.eye(nx + count)
    E[:nx, :nx], A[:nx, :nx] = plant.E, plant.A
    _require_visible(np.vstack([E, output]), plant, chosen_names)
    remaining = plant.Df.copy()
    remaining[:, chosen] = 0.0
    below = {name: np.zeros((count, getattr(plant, name).shape[1])) for name in ("B", "Bd", "Bw")}
    below["Bf"] = np.eye(plant.nf)[chosen]
    inputs = {name: np.vstack([getattr(plant, name), rows]) for name, rows in below.items()}
    new = with_states(
        plant,
        (*plant.state_names, *names),
        E=E,
        A=A,
        C=output,
        Df=remaining,
        **inputs,
        uncertainty=None if plant.uncertainty is None else _augmented(plant.uncertainty, plant.nx, chosen),
    )
    description = f"appended {', '.join(names)} as states" if names else ""
    return Transformation(plant, new, description, unchanged_states(plant, new, from_state=np.eye(nx, nx + count)))


def _augmented(uncertain: Uncertainty, nx: int, chosen: Sequence[int]) -> Uncertainty:
    """Return what is uncertain in a plant whose ``chosen`` faults have become states: entries of Df are then of C."""
    if uncertain.written is not None:
        return uncertain.left_behind("faults were appended as states after the plant was transformed")
    entries = {name: list(found) for name, found in uncertain.entries.items()}
    direct = entries.pop("Df", [])
    moved = [(row, nx + chosen.index(column), text) for row, column, text in direct if column in chosen]
    kept = {"C": [*entries.get("C", []), *moved], "Df": [item for item in direct if item[1] not in chosen]}
    return replace(uncertain, entries={name: tuple(found) for name, found in {**entries, **kept}.items() if found})


def _require_visible(stacked: FloatArray, plant: DescriptorSystem, faults: Sequence[str]) -> None:
    decision = decide_rank(stacked, expected=stacked.shape[1])
    if decision.full or not faults:
        return
    scaled = equilibrate_pencil(np.zeros_like(stacked), stacked).A
    shares = np.linalg.norm(np.linalg.svd(scaled)[2][decision.rank :], axis=0)
    if np.max(shares[plant.nx :]) > NEGLIGIBLE_INPUT:
        signals = leading_names(shares[plant.nx :], faults)
        culprit = (
            f"Faults {', '.join(signals)} have the same effect on the outputs as algebraic states, or as each other."
        )
    else:
        signals = leading_names(shares[: plant.nx], plant.state_names)
        culprit = f"States {', '.join(signals)} are neither dynamic nor measured."
    raise PreconditionError(
        f"Faults cannot be appended as states: {decision.describe()}. {culprit} Leave faults out, or add an output.",
        condition="rank [E 0; 0 0; C Df]",
        signals=signals,
    )

"""Transformations of linear plants: algebraic states eliminated, sampled, and the map back to the states as written.

What a transformation did is the map back to the states of the plant it started from; faults are states there, too.

From what elimination left of a large plant its states come by a sparse solution instead of a dense matrix.

Elimination of algebraic states in rational arithmetic: every entry of the result is rounded once.

With bases N of ker E, L of its left null space, completed by unit vectors D and P, ``x = D z + N v``,
``L A N v = -L (A D z + B u)`` and ``P E D z+ = P (A D z + A N v + B u)``: index 1 is ``L A N`` nonsingular.

Solving the algebraic equations of an index-1 plant; those of a large one by its sparsity, without idle variables.

Variables that act on nothing (as in filters whose time constants are zero) are found by the pattern of a plant: no
output depends on them nor on what depends on them. They are left out exactly, with as many equations; with them the
plant would have index 2, or would not be regular.

Zero-order-hold sampling of continuous plants.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NoReturn

import flint
import numpy as np
import scipy
from flint import fmpq, fmpq_mat

from obsynth.analysis.plant_units import PlantUnits
from obsynth.analysis.zeros import fault_zeros, in_own_units, leading_names, structure_of
from obsynth.errors import PreconditionError, SpecError
from obsynth.numerics.arguments import (
    LARGEST,
    FloatArray,
    arguments_checked,
    freeze,
    read_only,
    real_number,
    require_kind,
    require_no_overflow,
)
from obsynth.numerics.continuous import zero_order_hold
from obsynth.numerics.libraries import on_one_thread_if_small, one_thread_if_small
from obsynth.numerics.pencils import GENERIC_POINTS
from obsynth.numerics.ranks import (
    CANCELLATION_TOLERANCE,
    NAMED_SHARE,
    NEGLIGIBLE_INPUT,
    RANK_TOLERANCE,
    but_rounding,
    decide_rank,
    numerical_rank,
    product_but_rounding,
    rounding_rank,
)
from obsynth.numerics.scaling import balanced_matrix, equilibrate_pencil, power_of_two_below
from obsynth.numerics.sparse import (
    MEAN_FACTOR,
    SIZE_SAMPLES,
    CoarseStructure,
    Indices,
    SolutionBounds,
    SparseFactor,
    blocks_of,
    coarse_structure,
    components_of,
    csr,
    dense,
    is_sparse,
    scales_by_all_entries,
    selection,
    sparse_factor,
    unmatched_instead,
)
from obsynth.numerics.spectra import pole_text
from obsynth.plants.constants import ELIMINATED, SAMPLED, Uncertainty, matrices_of
from obsynth.plants.dae import DAEModel
from obsynth.plants.descriptor import DECISIVE, DescriptorSystem, ExactNumbers, index_of, listed, note_source
from obsynth.proofs.balls import arb_matrix
from obsynth.proofs.exact_arithmetic import (
    blocks,
    fractions_of,
    holds_computed,
    identity,
    nearest_doubles,
    null_basis,
    picked_columns,
    picked_rows,
    pivot_columns,
    written_fraction,
    written_matrix,
    written_rows,
    zeros_matrix,
)
from obsynth.proofs.products import as_ball

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

        def matrix(entry: Mapping[str, Any]) -> Any:
            indices, starts = (np.asarray(entry[name]).astype(np.int64) for name in ("indices", "starts"))
            shape = int(entry["rows"]), int(entry["columns"])
            return scipy.sparse.csr_array((np.asarray(entry["values"]), indices, starts), shape=shape)

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


#: Plants of more states are eliminated in floating point.
MOST_STATES_EXACTLY = 64
#: Digits (binary) in which coordinates that are not rational are changed.
COORDINATE_BITS = 600

_EXACT_INPUTS = ("B", "Bf", "Bd", "Bw")
_EXACT_DIRECT = ("D", "Df", "Dd", "Dw")


@dataclass(frozen=True, eq=False)
class ExactElimination:
    """The reduced plant and the recovery of its states, in rational coordinates."""

    matrices: Mapping[str, fmpq_mat]  # ``A, B, Bf, Bd, Bw, C, D, Df, Dd, Dw`` of the reduced plant
    recovery: Mapping[str, fmpq_mat]  # ``x`` from the new states (``A``) and the signals (``B, Bf, Bd, Bw``)
    pivots: tuple[int, ...]  # states that stand for the dynamic ones
    computed: bool  # whether some of the data were computed in floating point
    sizes: Mapping[str, FloatArray]  # of ``matrices``, the sums of the sizes of all terms
    uncleaned: Mapping[str, fmpq_mat] | None = None  # ``matrices`` before what may be rounding was set to zero

    def numbers(self, sizes: Mapping[str, FloatArray], *, own: bool) -> ExactNumbers:
        """Return those of the reduced plant, with the sizes of the terms in its coordinates; ``own``: these ones."""
        found: dict[str, fmpq_mat] = {"E": identity(len(self.pivots)), **self.matrices}
        kept = {name: sizes[name] for name in DECISIVE if name in sizes}
        known = all(np.all(np.isfinite(part)) for part in kept.values())
        exact = {name: fractions_of(found[name]) for name in DECISIVE}
        before = None if self.uncleaned is None else {"E": found["E"], **self.uncleaned}
        return ExactNumbers(
            exact,
            own=own,
            computed=self.computed,
            sizes=kept if known else None,
            states=int(self.recovery["A"].nrows()),
            uncleaned=None if before is None else {name: fractions_of(before[name]) for name in DECISIVE},
        )


def exact_elimination(plant: DescriptorSystem) -> ExactElimination | None:
    """Return the elimination; ``None`` for too many states, or where no state can be eliminated so."""
    if plant.nx > MOST_STATES_EXACTLY or plant.exact is not None:
        return None
    computed = any(holds_computed(getattr(plant, name)) for name in ("E", "A", "C", *_EXACT_INPUTS, *_EXACT_DIRECT))
    found = _eliminated(plant, clean=computed)
    if found is None or not computed:
        return found
    before = _eliminated(plant, clean=False, sized=False)
    if before is None or all(found.matrices[name] == before.matrices[name] for name in found.matrices):
        return replace(found, computed=True)
    return replace(found, computed=True, uncleaned=before.matrices)


def _eliminated(plant: DescriptorSystem, *, clean: bool, sized: bool = True) -> ExactElimination | None:
    """Return the elimination; with ``clean`` what rounding of computed data may have left is zero.
    Without ``sized`` the sizes of terms are left out."""
    e, a, c = (written_matrix(matrix) for matrix in (plant.E, plant.A, plant.C))
    pivots, rows = pivot_columns(e), pivot_columns(e.transpose())
    if not pivots:
        return None
    null, left = null_basis(e), null_basis(e.transpose()).transpose()
    signals = [written_matrix(getattr(plant, name)) for name in _EXACT_INPUTS]
    whole = identity(plant.nx)
    keep, take = picked_columns(whole, pivots), picked_rows(whole, rows)
    right = blocks([[a * keep, *signals]])
    coupling = left * a * null
    if plant.nx > len(pivots) and coupling.det() == 0:
        return None
    direct = blocks([[c * keep, *(written_matrix(getattr(plant, name)) for name in _EXACT_DIRECT)]])
    states = blocks([[keep, *(zeros_matrix(plant.nx, int(signal.ncols())) for signal in signals)]])
    moving, leading = take * right, take * e * keep
    # The inverses are asked for their sizes alone.
    inverses = [_sizes(part.inv()) for part in (coupling, leading)] if clean or sized else []
    sizes = [np.zeros((int(part.nrows()), int(part.ncols()))) for part in (moving, direct)]
    if sized:
        with np.errstate(all="ignore"):
            sizes = _term_sizes((left, right), coupling, (take, a * null), (direct, c * null), leading, inverses)
    if plant.nx > len(pivots):
        algebraic = _solved_exactly(-coupling, left * right, inverses[0] if clean else None)
        moving = _sum(moving, take * (a * null), algebraic, clean=clean)
        direct = _sum(direct, c * null, algebraic, clean=clean)
        states = _sum(states, null, algebraic, clean=clean)
    moving = _solved_exactly(leading, moving, inverses[1] if clean else None)
    widths = [len(pivots), *(int(signal.ncols()) for signal in signals)]
    return ExactElimination(
        dict(zip(("A", *_EXACT_INPUTS), _split_exactly(moving, widths), strict=True))
        | dict(zip(("C", *_EXACT_DIRECT), _split_exactly(direct, widths), strict=True)),
        dict(zip(("A", *_EXACT_INPUTS), _split_exactly(states, widths), strict=True)),
        tuple(pivots),
        clean,
        dict(zip(("A", *_EXACT_INPUTS), np.split(sizes[0], np.cumsum(widths)[:-1], axis=1), strict=True))
        | dict(zip(("C", *_EXACT_DIRECT), np.split(sizes[1], np.cumsum(widths)[:-1], axis=1), strict=True)),
    )


def _term_sizes(
    constraints: tuple[fmpq_mat, fmpq_mat],
    coupling: fmpq_mat,
    equations: tuple[fmpq_mat, fmpq_mat],
    outputs: tuple[fmpq_mat, fmpq_mat],
    moving: fmpq_mat,
    inverses: Sequence[FloatArray],
) -> list[FloatArray]:
    """Return the sums of the sizes of all terms, of the dynamic equations and of the outputs.
    ``inverses``: sizes of the inverses of ``coupling`` and ``moving``."""
    (left, right), (take, across), (direct, shown) = constraints, equations, outputs
    solver, inverse = inverses
    dynamic = _sizes(take) @ _sizes(right)
    if not coupling.nrows():
        return [inverse @ (_sizes(moving) @ (inverse @ dynamic)), _sizes(direct)]
    algebraic = solver @ (_sizes(coupling) @ (solver @ (_sizes(left) @ _sizes(right))))
    dynamic = dynamic + _sizes(take * across) @ algebraic
    return [inverse @ (_sizes(moving) @ (inverse @ dynamic)), _sizes(direct) + _sizes(shown) @ algebraic]


def rounded_once(
    found: ExactElimination, plant: DescriptorSystem, dynamic: FloatArray | None
) -> tuple[dict[str, FloatArray], dict[str, FloatArray], dict[str, FloatArray]]:
    """Return matrices, recovery and sizes of terms as doubles; states ``dynamic (nx, count)`` instead of the pivots."""
    if dynamic is None:
        return (
            {name: nearest_doubles(matrix) for name, matrix in found.matrices.items()},
            {name: nearest_doubles(matrix) for name, matrix in found.recovery.items()},
            dict(found.sizes),
        )
    e = written_matrix(plant.E)
    rows = pivot_columns((picked_columns(e, found.pivots)).transpose())
    with flint.ctx.workprec(COORDINATE_BITS):
        # E dynamic z = E (unit vectors) z_rational
        change = flint.arb_mat(picked_rows(e * written_matrix(dynamic), rows)).solve(
            flint.arb_mat(picked_rows(picked_columns(e, found.pivots), rows))
        )
        back = change.inv()

        def moved(name: str, matrix: fmpq_mat, *, recovery: bool) -> FloatArray:
            work = flint.arb_mat(matrix) if matrix.nrows() and matrix.ncols() else None
            if work is None:
                return np.zeros((int(matrix.nrows()), int(matrix.ncols())))
            if name in ("A", "C"):
                work = work * back
            if not recovery and name in ("A", *_EXACT_INPUTS):
                work = change * work
            return _doubles(work)

        return (
            {name: moved(name, matrix, recovery=False) for name, matrix in found.matrices.items()},
            {name: moved(name, matrix, recovery=True) for name, matrix in found.recovery.items()},
            _moved_sizes(found.sizes, np.abs(_doubles(change)), np.abs(_doubles(back))),
        )


def _moved_sizes(sizes: Mapping[str, FloatArray], change: FloatArray, back: FloatArray) -> dict[str, FloatArray]:
    """Return sizes of terms in other coordinates of the states."""
    found = {name: size @ back if name in ("A", "C") else size for name, size in sizes.items()}
    return {name: change @ size if name in ("A", *_EXACT_INPUTS) else size for name, size in found.items()}


def _solved_exactly(matrix: fmpq_mat, right: fmpq_mat, inverse: FloatArray | None) -> fmpq_mat:
    """Return ``matrix^-1 right``; with the sizes of ``matrix^-1``, what rounding of the data may have left is zero."""
    solution = matrix.solve(right)
    return solution if inverse is None else _cleaned(solution, inverse @ (_sizes(matrix) @ _sizes(solution)))


def _sum(direct: fmpq_mat, factor: fmpq_mat, solution: fmpq_mat, *, clean: bool) -> fmpq_mat:
    result = direct + factor * solution
    return _cleaned(result, _sizes(direct) + _sizes(factor) @ _sizes(solution)) if clean else result


def _cleaned(result: fmpq_mat, size_of_terms: FloatArray) -> fmpq_mat:
    rows, columns = size_of_terms.shape
    kept = _sizes(result) > CANCELLATION_TOLERANCE * size_of_terms
    entries = [result[i, j] if kept[i, j] else fmpq(0) for i in range(rows) for j in range(columns)]
    return fmpq_mat(rows, columns, entries)


def _sizes(matrix: fmpq_mat) -> FloatArray:
    return np.abs(nearest_doubles(matrix))


def _doubles(matrix: Any) -> FloatArray:
    rows = [[0.0 if value.contains(0) else float(value) for value in row] for row in matrix.tolist()]
    return np.array(rows, dtype=np.float64)


def _split_exactly(matrix: fmpq_mat, widths: list[int]) -> list[fmpq_mat]:
    ends = np.cumsum(widths).tolist()
    return [picked_columns(matrix, range(end - width, end)) for end, width in zip(ends, widths, strict=True)]


def sampled_exact_numbers(smooth: DescriptorSystem, sample_time: float) -> ExactNumbers:
    """Return the exact numbers behind a plant that is sampled from one with ``E = I``."""
    step, known = written_fraction(sample_time), smooth.exact
    if known is None:
        computed = any(holds_computed(getattr(smooth, name)) for name in DECISIVE)
        return ExactNumbers({name: written_rows(getattr(smooth, name)) for name in DECISIVE}, step, computed=computed)
    sizes = None if known.sizes is None else _sampled_sizes(smooth, known.sizes, sample_time)
    return replace(known, sample_time=step, sizes=sizes, states=0)


def _sampled_sizes(
    smooth: DescriptorSystem, sizes: Mapping[str, FloatArray], sample_time: float
) -> dict[str, FloatArray] | None:
    """Return the sizes of terms once sampled: what cancelled before goes through the integral of ``exp(A t)``."""
    transition, held = zero_order_hold(smooth.A, np.hstack([smooth.Bf, smooth.Bd, np.eye(smooth.nx)]), sample_time)
    faults, disturbances, integral = np.split(np.abs(held), [smooth.nf, smooth.nf + smooth.nd], axis=1)
    found = dict(sizes)
    for name, own in (("A", np.abs(transition)), ("Bf", faults), ("Bd", disturbances)):
        found[name] = own + integral @ (sizes[name] - np.abs(getattr(smooth, name)))
    return found if all(np.all(np.isfinite(part)) for part in found.values()) else None


#: Rank that a matrix may lack beyond what its shape says, to begin with.
BORDER = 8
#: Lengths of projected states that differ by less count as equal: the first is taken, and not the one that rounding
#: makes larger.
EQUAL_LENGTHS = 1.0 - 1e-6
#: Binary digits of coordinates that are combinations: what rounding of a basis may be, times a million, is below.
BASIS_DIGITS = 20
#: How much rather a repeated equation is left out whose own variable is left out.
OTHERS_WEIGHT = 1e-3


@dataclass(frozen=True, eq=False)
class ActiveVariables:
    """What is left of a plant without its idle variables; names of these, and numbers of their equations from 1."""

    rows: Indices
    columns: Indices
    dropped: tuple[str, ...]
    equations: tuple[int, ...]

    def note(self) -> str:
        """Return one sentence for a reader; empty when nothing was dropped."""
        if not self.dropped:
            return ""
        return (
            "Left out, as they have no effect on the other variables and the outputs: "
            f"{', '.join(map(repr, self.dropped))} (with "
            f"{'equations' if len(self.equations) > 1 else 'equation'} {', '.join(map(str, self.equations))}); "
            "the rest of the plant is the same, and their values are not estimated."
        )


def active_variables(plant: DescriptorSystem) -> ActiveVariables:
    """Return which equations and variables stay: not those that act on nothing and cannot be solved for."""
    e, a, c = csr(plant.E), csr(plant.A), csr(plant.C)
    rows, columns = np.arange(plant.nx), np.arange(plant.nx)
    if not plant.ny:
        # Without any output nothing says what a variable is there for.
        return everything_active(plant)
    pattern = csr(abs(e) + abs(a))
    coarse = coarse_structure(pattern)
    if coarse.structural_rank < plant.nx:
        surplus = _surplus_equations(plant, coarse, e, a, c)
        if surplus is None:
            raise_structurally_singular(plant, coarse.over_rows, coarse.under_columns)
        rows, columns = np.setdiff1d(rows, surplus), np.setdiff1d(columns, coarse.under_columns)
        pattern = pattern[rows][:, columns]
        coarse = coarse_structure(pattern)
        if coarse.structural_rank < len(rows):
            raise_structurally_singular(plant, rows[coarse.over_rows], columns[coarse.under_columns])
    idle_rows, idle_columns = _idle(e[rows][:, columns], pattern, coarse, c[:, columns], plant, rows, columns)
    kept_rows, kept_columns = np.delete(rows, idle_rows), np.delete(columns, idle_columns)
    if not len(kept_columns):
        # No output sees anything: what is wrong with the plant is not that some variable acts on nothing.
        return everything_active(plant)
    dropped, unneeded = (np.setdiff1d(np.arange(plant.nx), kept) for kept in (kept_columns, kept_rows))
    names, numbers = tuple(plant.state_names[i] for i in dropped), tuple(int(i) + 1 for i in unneeded)
    return ActiveVariables(kept_rows, kept_columns, names, numbers)


def everything_active(plant: DescriptorSystem) -> ActiveVariables:
    """Return that all equations and variables stay."""
    return ActiveVariables(np.arange(plant.nx), np.arange(plant.nx), (), ())


def active_part(plant: DescriptorSystem, found: ActiveVariables) -> DescriptorSystem:
    """Return the plant without idle variables."""
    if not found.dropped:
        return plant
    rows, columns = found.rows, found.columns
    changes: dict[str, Any] = {name: getattr(plant, name)[rows] for name in ("B", "Bf", "Bd", "Bw")}
    changes |= {name: getattr(plant, name)[rows][:, columns] for name in ("E", "A")}
    return with_states(plant, [plant.state_names[i] for i in columns], C=plant.C[:, columns], **changes)


def _surplus_equations(plant: DescriptorSystem, coarse: CoarseStructure, e: Any, a: Any, c: Any) -> Indices | None:
    """Return the equations of these variables alone, and as many more as follow from others, if that is exact."""
    if c[:, coarse.under_columns].nnz or not _solvable(plant, coarse.under_rows, coarse.under_columns):
        return None
    rows = coarse.over_rows
    combinations, scale = _left_null_space(csr(a - GENERIC_POINTS[0] * e)[rows][:, coarse.over_columns])
    if not _say_nothing(plant, rows, scale, combinations):
        return None
    # By convention the equation of a variable has its number, and goes with it.
    weights = np.where(np.isin(rows, coarse.under_columns), 1.0, OTHERS_WEIGHT)
    _, _, order = scipy.linalg.qr((weights[:, None] * combinations).T, mode="economic", pivoting=True)
    # Where more equations are repeated than variables are in too few, those that the pattern can do without.
    left_out = unmatched_instead(csr(abs(e) + abs(a)), coarse, rows[order[: combinations.shape[1]]])
    return None if left_out is None else np.union1d(coarse.under_rows, left_out)


def _say_nothing(plant: DescriptorSystem, rows: Indices, scale: FloatArray, combinations: FloatArray) -> bool:
    """Whether combinations of scaled equations are ``0 = 0``, with known inputs, faults and noise as well."""
    everything = [csr(getattr(plant, name))[rows] for name in ("E", "A", "B", "Bf", "Bd", "Bw")]
    scaled = csr(scipy.sparse.diags_array(scale) @ scipy.sparse.hstack(everything))
    peaks = np.zeros(scaled.shape[1])
    np.maximum.at(peaks, scaled.indices, np.abs(scaled.data))
    left = np.abs(scaled.T @ combinations)
    return bool(np.all(left <= RANK_TOLERANCE * peaks[:, None] * np.max(np.abs(combinations), axis=0, initial=0.0)))


def _solvable(plant: DescriptorSystem, rows: Indices, columns: Indices) -> bool:
    """Whether equations can be solved for some of their variables, whatever the others are."""
    if not len(rows):
        return True
    part = csr(csr(plant.A) - GENERIC_POINTS[0] * csr(plant.E))[rows][:, columns]
    if len(rows) == len(columns) and not sparse_factor(part).singular:
        return True
    arrays = part.toarray()
    pencil = equilibrate_pencil(np.zeros_like(arrays), arrays)
    left, values, _ = np.linalg.svd(pencil.A)
    rank = int(np.sum(values > RANK_TOLERANCE * np.max(values, initial=np.finfo(float).tiny)))
    # Else these combinations of them are a condition on the others, and leaving them out would not be exact.
    return _say_nothing(plant, rows, pencil.rows, left[:, rank:])


def _left_null_space(tall: Any) -> tuple[FloatArray, FloatArray]:
    """Return an orthonormal left null basis of a matrix with scaled rows, and the scales: one solution, bordered.
    With random G and H ``[M G; H 0]`` is nonsingular; its left solutions for the columns of G hold the null space."""
    (count, width), rng, more = tall.shape, np.random.default_rng(2), 0
    rows, columns = scales_by_all_entries(tall)
    scaled = csr(scipy.sparse.diags_array(rows) @ tall @ scipy.sparse.diags_array(columns))
    while True:
        wanted = count - width + more
        border, below = rng.normal(size=(count, wanted)), rng.normal(size=(more, width))
        factor = SparseFactor(
            scipy.sparse.block_array([[scaled, csr(border)], [csr(below), None]] if more else [[scaled, border]])
        )
        right = np.vstack([np.zeros((width, wanted)), np.eye(wanted)])
        basis = np.linalg.qr(factor.solve_transposed(right)[:count])[0]
        _, values, turned = np.linalg.svd(np.linalg.qr(scaled.T @ basis)[1])
        null = wanted - int(np.sum(values > RANK_TOLERANCE * max(1.0, np.max(np.abs(scaled.data), initial=0.0))))
        # A border of rows costs fill, and is needed only where columns are dependent as well.
        if (more == 0 and not factor.singular) or (more and null < wanted) or more == width:
            return basis @ turned[wanted - null :].T, rows
        more = min(max(BORDER, 2 * more), width)


def _idle(
    e: Any, pattern: Any, coarse: CoarseStructure, c: Any, plant: DescriptorSystem, rows: Indices, columns: Indices
) -> tuple[Indices, Indices]:
    """Return the rows and columns of idle blocks that cannot be solved for without differentiating."""
    count, block = blocks_of(pattern, coarse.row_of_column)
    block_of_row = np.empty(len(rows), dtype=np.int64)
    block_of_row[coarse.row_of_column] = block
    links = pattern.tocoo()
    from_block, to_block = block[links.col], block_of_row[links.row]
    seen = np.zeros(count, dtype=bool)
    seen[block[np.unique(c.indices)]] = True
    seen = _spread(seen, to_block, from_block)
    moving = e.tocoo()
    inside = block_of_row[moving.row] == block[moving.col]
    differentiated = np.zeros(len(columns), dtype=bool)
    differentiated[moving.col[inside]] = True
    # What an idle block needs that is not known without differentiating makes it unknown as well.
    unknown = np.zeros(count, dtype=bool)
    unknown[block_of_row[moving.row[~differentiated[moving.col]]]] = True
    unknown[_undetermined_blocks(plant, rows, columns, block_of_row, block, ~seen)] = True
    unknown = _spread(unknown & ~seen, from_block, to_block, within=~seen) & ~seen
    found = np.flatnonzero(unknown[block_of_row]), np.flatnonzero(unknown[block])
    nothing = np.zeros(0, dtype=np.int64)
    return found if _solvable(plant, rows[found[0]], columns[found[1]]) else (nothing, nothing)


def _spread(marked: Any, source: Indices, target: Indices, *, within: Any = None) -> Any:
    """Mark every target of a link whose source is marked, until nothing changes."""
    found = marked.copy()
    while True:
        more = found.copy()
        more[target[found[source]]] = True
        more &= True if within is None else within
        if np.array_equal(more, found):
            return found
        found = more


def _undetermined_blocks(
    plant: DescriptorSystem, rows: Indices, columns: Indices, block_of_row: Indices, block: Indices, idle: Any
) -> list[int]:
    """Return the idle blocks that their equations do not determine."""
    # A block of one variable is its entry, which is there.
    several = np.flatnonzero(idle & (np.bincount(block, minlength=len(idle)) > 1))
    if not several.size:
        return []
    pencil = csr(csr(plant.A) - GENERIC_POINTS[0] * csr(plant.E))
    parts = ((number, rows[block_of_row == number], columns[block == number]) for number in several)
    return [int(number) for number, own, variables in parts if sparse_factor(pencil[own][:, variables]).singular]


def raise_structurally_singular(plant: DescriptorSystem, equations: Indices, variables: Indices) -> NoReturn:
    """Refuse a plant whose pattern alone leaves variables free, and name them and the surplus equations."""
    equations, variables = own_first(equations, variables), own_first(variables, equations)
    names = [plant.state_names[i] for i in variables]
    raise PreconditionError(
        "The plant is not regular, det(A - zE) is zero for every z and all values of the entries: "
        f"{listed([repr(name) for name in names])} {'is' if len(names) == 1 else 'are'} in too few equations, and "
        f"equations {listed([equation_name(plant, i) for i in equations])} hold too few variables. Check for a "
        "missing or repeated equation.",
        condition="regularity",
        signals=names,
    )


def own_first(places: Indices, others: Indices) -> Indices:
    """Return the places with those first that are among others: equations of such variables, or the reverse."""
    return places[np.argsort(~np.isin(places, others), kind="stable")]


def equation_name(plant: DescriptorSystem, row: int) -> str:
    """Return the number of an equation and the variable of the same number, whose equation it is by convention."""
    return f"{int(row) + 1} (of {plant.state_names[int(row)]!r})"


#: What to do about constraints that have to be differentiated.
INDEX_ADVICE = (
    "Combine the equations in which the force of a constraint acts so that it drops out, or differentiate the "
    "constraint (0 = a x becomes a x' = 0: move a from its row of A to that of E; this adds an integrator). Without "
    "elimination, obsynth check says which methods take the descriptor form."
)
#: Arrays of plants from this size on, with at most this share of entries that are not zero, are treated as sparse.
MANY_VARIABLES = 500
SPARSE_PENCIL_SHARE = 0.05


@arguments_checked
def eliminate_algebraic_states(plant: DescriptorSystem | Transformation) -> Transformation:
    """Solve the algebraic equations of an index-1 plant, so that ``E = I``.

    Parameters
    ----------
    plant : DescriptorSystem or Transformation
        Regular, index 0 or 1, either time, but for variables that act on no state and no output.

    Returns
    -------
    Transformation
        Signals in algebraic equations end up in ``D, Df, Dd, Dw``.  Dynamic states keep their names when
        the null space of ``E`` is spanned by whole states; otherwise the new states ``xi 1, xi 2, ...``
        are orthogonal combinations (after scaling by powers of two).  ``dropped`` names variables that act on
        nothing and have no value without differentiating: they were left out, exactly, and are not recovered.

    Raises
    ------
    PreconditionError
        Not regular, index 2 or more (equations and variables are named), or no dynamic state at all.

    Notes
    -----
    Up to 64 states the equations are solved in rational arithmetic and every entry is rounded once.  Beyond that, and
    where data were computed, results so small beside the terms they come from that they are only rounding are set to
    zero: the flags of the recovery depend on what is exactly zero.
    """
    if isinstance(plant, Transformation):
        return plant.then(eliminate_algebraic_states(plant.plant))
    if _is_identity(plant.E):
        same = plant.dense()
        return Transformation(plant, same, "", unchanged_states(plant, same, from_state=np.eye(plant.nx)))
    with one_thread_if_small(plant.nx):
        if plant.nx > MOST_STATES_EXACTLY and (plant.is_sparse or _has_few_entries(plant)):
            return eliminated_by_sparsity(plant)
        arrays = plant.dense()
        found = eliminated_exactly(arrays) or _eliminated_in_floating_point(arrays)
    if not found.dropped:
        found = found.with_tolerances(ELIMINATED)
    note_source(arrays, found.plant)
    return found if arrays is plant else replace(found, source=plant)


def _is_identity(e: Any) -> bool:
    if not is_sparse(e):
        return bool(np.array_equal(e, np.eye(e.shape[0])))
    return bool(e.nnz == e.shape[0] and np.all(e.diagonal() == 1.0))


def _has_few_entries(plant: DescriptorSystem) -> bool:
    """Whether a plant given as arrays is solved better by its sparsity."""
    stored = np.count_nonzero(plant.A) + np.count_nonzero(plant.E) if plant.nx >= MANY_VARIABLES else plant.nx**2
    return bool(stored <= SPARSE_PENCIL_SHARE * plant.nx**2)


def eliminated_by_sparsity(plant: DescriptorSystem) -> Transformation:
    """Leave out what acts on nothing, and solve the algebraic equations by a sparse factor."""
    active = active_variables(plant)
    part = active_part(plant, active)
    found = reduced_by_sparsity(part)
    if found is None:
        raise not_index_one(plant, active)
    return replace(
        found,
        source=plant,
        description=_description(part, found.plant.nx, active.dropped),
        dropped=active.dropped,
        notes=tuple(filter(None, (active.note(), *found.notes))),
    )


def _without_idle_variables(plant: DescriptorSystem, refusal: PreconditionError) -> Transformation:
    """Leave out what acts on nothing where that helps; else say which equations and variables are at fault."""
    active = active_variables(plant)
    part = active_part(plant, active)
    try:
        if not active.dropped:
            raise refusal
        found = eliminated_exactly(part) or _eliminated_densely(part, _dynamic_count(part))
    except PreconditionError as error:
        if error.condition == "dynamic states":
            # It did not help: what is wrong with the plant as written is what a user can mend.
            active, error = everything_active(plant), refusal
        raise not_index_one(plant, active, error) from None
    return replace(
        found,
        source=plant,
        description=_description(part, found.plant.nx, active.dropped),
        dropped=active.dropped,
        notes=(active.note(),),
    )


def _description(plant: DescriptorSystem, count: int, dropped: Sequence[str] = ()) -> str:
    """Return what was done to a plant of which ``count`` states are left, in words."""
    done = f"eliminated {plant.nx - count} algebraic states" if count < plant.nx else "multiplied by the inverse of E"
    if not dropped:
        return done
    return f"left out {len(dropped)} variable(s) that have no effect ({', '.join(dropped)}); {done}"


def eliminated_exactly(plant: DescriptorSystem, basis: FloatArray | None = None) -> Transformation | None:
    """Return the elimination in rational arithmetic, rounded once; ``None`` where it must be left to floating point.
    ``basis (nx, count)`` are the dynamic states to take, where they are combinations of those given."""
    exact = exact_elimination(plant)
    if exact is not None and holds_computed(plant.E) and _dynamic_count(plant) != len(exact.pivots):
        return None
    if exact is None:
        return None
    count = len(exact.pivots)
    whole = int(np.sum(plant.E.any(axis=0))) == count
    names = tuple(plant.state_names[i] for i in exact.pivots) if whole else tuple(f"xi {i + 1}" for i in range(count))
    if not whole and basis is None:
        basis = _coordinates(plant, count)[1]
    matrices, states, sizes = rounded_once(exact, plant, None if whole else basis)
    new = with_states(plant, names, E=None, **matrices, exact=exact.numbers(sizes, own=whole))
    recovery = StateRecovery(
        plant.state_names,
        states["A"],
        states["B"],
        states["Bf"],
        states["Bd"],
        states["Bw"],
        np.eye(plant.nw),
        state_point(plant),
    )
    return Transformation(plant, new, _description(plant, count), recovery)


def dynamic_coordinates(plant: DescriptorSystem) -> FloatArray | None:
    """Return the basis ``(nx, count)`` of dynamic states that elimination takes; ``None`` for given states."""
    count = rounding_rank(in_own_units(plant)[0])
    return None if int(np.sum(plant.E.any(axis=0))) == count else _coordinates(plant, count)[1]


def _eliminated_in_floating_point(plant: DescriptorSystem) -> Transformation:
    try:
        count = _dynamic_count(plant)
    except PreconditionError as error:
        if error.condition == "dynamic states":
            raise
        return _without_idle_variables(plant, error)
    return _eliminated_densely(plant, count)


def _eliminated_densely(plant: DescriptorSystem, count: int) -> Transformation:
    """Solve the algebraic equations of a plant with ``count`` dynamic states by LAPACK."""
    rows, dynamic, algebraic, names = _coordinates(plant, count)
    sizes = (count, plant.nu, plant.nf, plant.nd, plant.nw)
    signals = np.hstack([plant.B, plant.Bf, plant.Bd, plant.Bw])
    right_sides = rows @ np.hstack([plant.A @ dynamic, signals])
    coupling = rows @ plant.A @ algebraic
    # algebraic coordinates = solution @ [state; u; f; d; w]
    solution = _solved(-coupling[count:], right_sides[count:])
    reduced = _solved(
        rows[:count] @ plant.E @ dynamic, product_but_rounding(coupling[:count], solution, right_sides[:count])
    )
    direct = np.hstack([plant.C @ dynamic, plant.D, plant.Df, plant.Dd, plant.Dw])
    A, B, Bf, Bd, Bw = columns_of(reduced, sizes)
    C, D, Df, Dd, Dw = columns_of(product_but_rounding(plant.C @ algebraic, solution, direct), sizes)
    padded = np.hstack([dynamic, np.zeros((plant.nx, signals.shape[1]))])
    from_state, from_input, from_fault, from_disturbance, from_noise = columns_of(
        product_but_rounding(algebraic, solution, padded), sizes
    )
    new = with_states(plant, names, E=None, A=A, B=B, Bf=Bf, Bd=Bd, Bw=Bw, C=C, D=D, Df=Df, Dd=Dd, Dw=Dw)
    recovery = StateRecovery(
        plant.state_names,
        from_state,
        from_input,
        from_fault,
        from_disturbance,
        from_noise,
        np.eye(plant.nw),
        state_point(plant),
    )
    return Transformation(plant, new, _description(plant, count), recovery)


def algebraic_coordinates(plant: DescriptorSystem) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the row transformation and the bases of dynamic and algebraic states that an elimination uses."""
    if _is_identity(plant.E):
        return np.eye(plant.nx), np.eye(plant.nx), np.zeros((plant.nx, 0))
    return _coordinates(plant, _dynamic_count(plant))[:3]


def _dynamic_count(plant: DescriptorSystem) -> int:
    pencil = structure_of(plant)
    if pencil.index is None:
        raise PreconditionError(
            "The plant is not regular: det(A - zE) is zero for every z, so its equations do not determine the "
            "states. Check for a missing or repeated equation.",
            condition="regularity",
        )
    if pencil.index > 1:
        raise PreconditionError(
            f"The plant has index {pencil.index}: its algebraic equations cannot be solved for the algebraic states "
            f"without differentiating. {INDEX_ADVICE}",
            condition="index",
        )
    count = plant.nx - len(pencil.infinite_block_sizes)
    if count == 0:
        raise PreconditionError(
            "Every state is algebraic: nothing is left after elimination. Solve the equations directly.",
            condition="dynamic states",
        )
    return count


def _coordinates(plant: DescriptorSystem, count: int) -> tuple[FloatArray, FloatArray, FloatArray, tuple[str, ...]]:
    """Return row transformation, bases of dynamic and algebraic states, names of the dynamic ones."""
    units = PlantUnits.of(plant).rounded()
    left, _, right = np.linalg.svd(in_own_units(plant)[0])
    moving_rows, moving = plant.E.any(axis=1), plant.E.any(axis=0)
    rows = left.T
    if np.sum(moving_rows) == count:
        rows = np.eye(plant.nx)[np.argsort(~moving_rows, kind="stable")]
    rows = rows * units.equations
    if np.sum(moving) == count:
        order = np.argsort(~moving, kind="stable")
        basis, names = np.eye(plant.nx)[:, order], tuple(plant.state_names[i] for i in order[:count])
    else:
        directions = np.hstack([_settled_basis(right[:count].T), right[count:].T])
        basis, names = units.states[:, None] * directions, tuple(f"xi {i + 1}" for i in range(count))
    return rows, basis[:, :count], basis[:, count:], names


def _settled_basis(directions: FloatArray) -> FloatArray:
    """Return a basis ``(n, m)`` of the span of orthonormal columns that does not hang on how these were turned.

    Singular vectors of values that are equal are any, and so is every sign: another machine would make another plant.
    This one is the pivoted Cholesky factor of the projection, in few digits: any basis that E tells apart will do.
    """
    left, columns = directions @ directions.T, []
    for _ in range(directions.shape[1]):
        sizes = np.diag(left)
        first = int(np.flatnonzero(sizes >= EQUAL_LENGTHS * np.max(sizes))[0])
        columns.append(left[:, first] / np.sqrt(sizes[first]))
        left = left - np.outer(columns[-1], columns[-1])
    return np.asarray(np.ldexp(np.round(np.ldexp(np.array(columns).T, BASIS_DIGITS)), -BASIS_DIGITS))


def _solved(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """Return ``matrix^-1 right`` with entries that are only rounding set to zero."""
    scale = 1.0 / power_of_two_below(np.max(np.abs(matrix), axis=1, initial=0.0))[:, None]
    scaled = scale * matrix
    solution: FloatArray = np.asarray(np.linalg.solve(scaled, scale * right), dtype=np.float64)
    inverse = np.abs(np.linalg.inv(scaled))
    return but_rounding(solution, inverse @ (np.abs(scaled) @ np.abs(solution)))


def columns_of(matrix: FloatArray, sizes: Sequence[int]) -> list[FloatArray]:
    """Split a matrix into blocks of columns of the given sizes."""
    return np.split(matrix, np.cumsum(sizes)[:-1], axis=1)


def reduced_by_sparsity(plant: DescriptorSystem) -> Transformation | None:
    """Solve the algebraic equations of a plant with sparse factors; ``None`` where it does not have index 1.

    A note names states whose derivatives were taken as zero.
    """
    (dynamic_rows, algebraic_rows, dynamic, algebraic), names, neglected = split_by_derivatives(plant)
    count = dynamic.shape[1]
    if count == 0:
        raise PreconditionError(
            "Every state is algebraic: nothing is left after elimination. Solve the equations directly.",
            condition="dynamic states",
        )
    a, c = csr(plant.A), csr(plant.C)
    counts = (count, plant.nu, plant.nf, plant.nd, plant.nw)
    signals = np.hstack([dense(matrix) for matrix in (plant.B, plant.Bf, plant.Bd, plant.Bw)])
    inner = csr(algebraic_rows @ a @ algebraic)
    factor = sparse_factor(inner)
    if factor.singular:
        return None
    right = _side_by_side(algebraic_rows @ a @ dynamic, algebraic_rows @ csr(signals))
    found, backward = factor.solve_with_error(right.toarray())
    found[:, count:] = without_rounding(factor, found[:, count:])
    solution = -found
    kept = _side_by_side(dynamic_rows @ a @ dynamic, dynamic_rows @ csr(signals)).toarray()
    mass = sparse_factor(dynamic_rows @ csr(plant.E) @ dynamic)
    moved, backward_of_e = mass.solve_with_error(
        product_but_rounding(csr(dynamic_rows @ a @ algebraic), solution, kept)
    )
    direct = np.hstack([(c @ dynamic).toarray(), *(dense(m) for m in (plant.D, plant.Df, plant.Dd, plant.Dw))])
    shown = product_but_rounding(csr(c @ algebraic), solution, direct)
    ends = np.cumsum(counts)[:-1]
    matrices = dict(zip(("A", "B", "Bf", "Bd", "Bw"), np.split(moved, ends, axis=1), strict=True))
    matrices |= dict(zip(("C", "D", "Df", "Dd", "Dw"), np.split(shown, ends, axis=1), strict=True))
    operator = RecoveryOperator(dynamic, algebraic, inner, right, counts)
    recovery = StateRecovery.from_operator(plant.state_names, operator, np.eye(plant.nw), state_point(plant))
    bounds = SolutionBounds(max(factor.condition, mass.condition), max(backward, backward_of_e))
    notes = (
        f"Taken as algebraic, since the coefficients of their derivatives in E are less than {RANK_TOLERANCE:g} of the "
        f"largest in suitable units: {listed([repr(name) for name in neglected])}. Give E zeros there, or larger "
        "entries.",
    )
    reduced = with_states(plant, names, E=None, **matrices)
    return Transformation(plant, reduced, "", recovery, notes=notes if neglected else (), bounds=bounds)


def split_by_derivatives(
    plant: DescriptorSystem,
) -> tuple[tuple[Any, Any, Any, Any], tuple[str, ...], tuple[str, ...]]:
    """Return combinations of equations with E ``(count, nx)`` and without, bases of the states that E moves
    ``(nx, count)`` and does not, names of the former, and states whose derivatives count as zero beside the others.
    E is decomposed component by component of its pattern; names are their own where these are whole states."""
    e, a = csr(plant.E), csr(plant.A)
    parts = _components(e)
    pieces = _split(e, parts, _scales(e, a))
    if len(pieces.dynamic) < coarse_structure(e).structural_rank:
        # Small entries of E may be a matter of units: judged again with those that suit all entries.
        pieces = _split(e, parts, scales_by_all_entries(csr(abs(e) + abs(a))))
    moving = sorted(pieces.dynamic, key=lambda piece: piece[0])
    names = tuple(
        plant.state_names[piece[1][0]] if len(piece[1]) == 1 else f"xi {k}" for k, piece in enumerate(moving, 1)
    )
    neglected = tuple(plant.state_names[i] for i in sorted(set(pieces.neglected)))
    return pieces.matrices(), names, neglected


def _components(e: Any) -> list[tuple[Any, Any, FloatArray]]:
    """Return rows, columns and entries of the connected components of a sparse matrix."""
    row_part, column_part = components_of(e)
    moving = e.tocoo()
    with_entries = np.unique(row_part[moving.row])
    order = np.argsort(row_part, kind="stable"), np.argsort(column_part, kind="stable")
    starts = [np.searchsorted(part[o], with_entries) for part, o in zip((row_part, column_part), order, strict=True)]
    ends = [
        np.searchsorted(part[o], with_entries, side="right")
        for part, o in zip((row_part, column_part), order, strict=True)
    ]
    # Most components are single entries: slicing each would take most of the time.
    single = np.bincount(row_part[moving.row], weights=moving.data)[with_entries][:, None, None]
    blocks = []
    for k in range(len(with_entries)):
        rows = order[0][starts[0][k] : ends[0][k]]
        columns = order[1][starts[1][k] : ends[1][k]]
        block = e[rows][:, columns].toarray() if len(rows) * len(columns) > 1 else single[k]
        blocks.append((rows, columns, block))
    return blocks


def _split(e: Any, parts: list[tuple[Any, Any, FloatArray]], scales: tuple[FloatArray, FloatArray]) -> _Pieces:
    pieces, (row_scale, column_scale) = _Pieces(e.shape[0]), scales
    blocks = [
        (rows, columns, row_scale[rows][:, None] * block * column_scale[columns]) for rows, columns, block in parts
    ]
    largest = max((float(np.linalg.norm(block, 2)) for _, _, block in blocks), default=0.0)
    for rows, columns, block in blocks:
        pieces.add(rows, columns, block, row_scale[rows], column_scale[columns], largest)
    in_row, in_column = np.diff(e.indptr) > 0, np.bincount(e.indices, minlength=e.shape[1]) > 0
    pieces.rest(np.flatnonzero(~in_row), np.flatnonzero(~in_column))
    return pieces


class _Pieces:
    """Collects rows and columns of dynamic and algebraic parts, one component of E after the other."""

    def __init__(self, count: int) -> None:
        self.count = count
        # Each is a list of (place for sorting, indices, values).
        self.dynamic_rows: list[tuple[int, Any, FloatArray]] = []
        self.algebraic_rows: list[tuple[int, Any, FloatArray]] = []
        self.dynamic: list[tuple[int, Any, FloatArray]] = []
        self.algebraic: list[tuple[int, Any, FloatArray]] = []
        # States whose derivative has a coefficient, but one too small beside the others.
        self.neglected: list[int] = []

    def add(self, rows: Any, columns: Any, block: FloatArray, row_scale: Any, column_scale: Any, norm: float) -> None:
        """Split one component by its singular values, beside the norm of all of E."""
        if block.shape == (1, 1):
            whole_rows = whole_columns = abs(block[0, 0]) > RANK_TOLERANCE * norm
            rank = int(whole_rows)
            left, right, values = np.ones((1, 1)), np.ones((1, 1)), np.abs(block[0])
        else:
            left, values, right = np.linalg.svd(block)
            rank = numerical_rank(values, scale=norm)
            whole_rows, whole_columns = rank == len(rows), rank == len(columns)
            if not whole_columns:
                right[:rank] = _settled_basis(right[:rank].T).T
        for k in range(rank, len(values)):
            if values[k] > len(values) * np.finfo(float).eps * values[0]:
                self.neglected.append(int(columns[np.argmax(np.abs(right[k]))]))
        self._put(self.dynamic_rows, self.algebraic_rows, rows, left.T * row_scale, rank, whole=whole_rows)
        self._put(self.dynamic, self.algebraic, columns, right * column_scale, rank, whole=whole_columns)

    def _put(self, kept: Any, others: Any, places: Any, basis: FloatArray, rank: int, *, whole: bool) -> None:
        if whole:
            kept += [(int(place), np.array([place]), np.ones(1)) for place in places]
            return
        kept += [(int(places[0]), places, basis[k]) for k in range(rank)]
        others += [(int(places[0]), places, basis[k]) for k in range(rank, len(places))]

    def rest(self, rows: Any, columns: Any) -> None:
        """Add the equations and states that E does not touch."""
        self.algebraic_rows += [(int(row), np.array([row]), np.ones(1)) for row in rows]
        self.algebraic += [(int(column), np.array([column]), np.ones(1)) for column in columns]

    def matrices(self) -> tuple[Any, Any, Any, Any]:
        """Return the whole, in the order of equations and states: rows, then states as columns."""
        rows = self._matrix(self.dynamic_rows), self._matrix(self.algebraic_rows)
        return *rows, csr(self._matrix(self.dynamic).T), csr(self._matrix(self.algebraic).T)

    def _matrix(self, pieces: list[tuple[int, Any, FloatArray]]) -> Any:
        ordered = sorted(pieces, key=lambda piece: piece[0])
        if all(len(piece[1]) == 1 for piece in ordered):
            return selection([piece[0] for piece in ordered], self.count)
        starts = np.concatenate([[0], np.cumsum([len(piece[1]) for piece in ordered])])
        indices = np.concatenate([piece[1] for piece in ordered])
        values = np.concatenate([piece[2] for piece in ordered])
        return scipy.sparse.csr_array((values, indices, starts), shape=(len(ordered), self.count))


def _scales(e: Any, a: Any) -> tuple[FloatArray, FloatArray]:
    """Return the powers of two that bring the rows, then the columns, of ``[E A]`` near one."""

    def peaks(matrix: Any) -> FloatArray:
        found = np.asarray(scipy.sparse.csc_array(abs(matrix)).max(axis=0).toarray()).ravel()
        return np.asarray(found, dtype=np.float64)

    rows = 1.0 / power_of_two_below(np.maximum(peaks(e.T), peaks(a.T)))
    scaled = [matrix.multiply(rows[:, None]) for matrix in (e, a)]
    return rows, 1.0 / power_of_two_below(np.maximum(peaks(scaled[0]), peaks(scaled[1])))


def not_index_one(
    plant: DescriptorSystem, active: ActiveVariables, said: PreconditionError | None = None
) -> PreconditionError:
    """Return the refusal of a plant that does not have index 1 without its idle variables either: which part, and why.
    It goes on where ``said`` refused; its signals are the variables, none where nothing was found wrong."""
    part = active_part(plant, active)
    (_, algebraic_rows, _, algebraic), _, _ = split_by_derivatives(part)
    inner = csr(algebraic_rows @ csr(part.A) @ algebraic)
    factor = sparse_factor(inner)
    smallest, left, right = factor.null_vectors()
    if not factor.exactly_singular and smallest > RANK_TOLERANCE:
        return said or PreconditionError("", condition="index")
    generic = [sparse_factor(csr(part.A) - point * csr(part.E)) for point in GENERIC_POINTS[:2]]
    regular = any(not found.singular for found in generic)
    if regular:
        equations, variables = _leading(algebraic_rows, algebraic, left, right, inner)
    else:
        equations, variables = map(_named, generic[0].null_vectors()[1:])
    # As the plant was given: equations and variables that were left out count.
    variables = active.columns[variables]
    equations = own_first(active.rows[equations], variables)
    names = tuple(plant.state_names[i] for i in variables)
    numbers = listed([equation_name(plant, i) for i in equations])
    does = f"equation {numbers} does" if len(equations) == 1 else f"equations {numbers} do"
    does = f"{does} not determine {listed([repr(name) for name in names])}"
    if not regular:
        return PreconditionError(
            f"The plant is not regular: det(A - zE) is zero for every z, and {does}. Check for a missing or repeated "
            "equation.",
            condition="regularity",
            signals=names,
        )
    if said is not None and said.condition == "index":
        return PreconditionError(f"{said} {does[0].upper()}{does[1:]}.", condition="index", signals=names)
    return PreconditionError(
        f"The plant has index 2 or more: {does} without differentiating. {INDEX_ADVICE}",
        condition="index",
        signals=names,
    )


def _leading(rows: Any, basis: Any, left: FloatArray, right: FloatArray, inner: Any) -> tuple[Any, Any]:
    """Return the equations and variables of the null vectors; by the pattern alone, where that is singular already."""
    coarse = coarse_structure(inner)
    if coarse.structural_rank < inner.shape[0]:
        over, under = np.zeros(inner.shape[0]), np.zeros(inner.shape[0])
        over[coarse.over_rows], under[coarse.under_columns] = 1.0, 1.0
        return _named(abs(rows).T @ over), _named(abs(basis) @ under)
    return _named(abs(rows).T @ left), _named(abs(basis) @ right)


def _named(shares: FloatArray) -> Any:
    """Return the places of the leading entries, largest first."""
    order = np.argsort(-shares, kind="stable")
    return order[shares[order] >= NAMED_SHARE * max(float(np.max(shares, initial=0.0)), np.finfo(float).tiny)]


def _side_by_side(*blocks: Any) -> Any:
    return csr(scipy.sparse.hstack([csr(block) for block in blocks]))


#: With so many states and signals, whose exponential takes 10 ms, each entry is rounded once: another machine finds it
#: again, and entries that are small beside those they come from have all their digits.
MOST_ROUNDED_ONCE = 24
#: Digits, in bits: a chain of integrators in large units, whose exponential is squared thirty times, takes over 300.
SQUARING_BITS = 640
#: Fault zeros of a sampled plant between this radius and 1 make the fault estimate ring for long.
SLOW_ZERO_RADIUS = 0.98


@arguments_checked
@on_one_thread_if_small
def discretise(plant: DescriptorSystem | Transformation, sample_time: float) -> Transformation:
    """Sample a continuous plant with a zero-order hold.

    Exact for inputs, faults and disturbances that are constant between samples.  Algebraic states are
    eliminated first.  A fault that changes within an interval acts there like its mean over it, weighted by how much
    of the effect of each moment is left at the next sample: for short intervals the plain mean.

    Parameters
    ----------
    plant : DescriptorSystem
        Continuous, regular, index 0 or 1.
    sample_time : float, seconds
        Time between samples.

    Returns
    -------
    Transformation
        Process noise (``Bw``, per square root of a second) is integrated over a sample and becomes
        ``process noise 1, 2, ...``, a factor of its covariance; ``Dw`` is per sample and stays.

    Raises
    ------
    SpecError
        ``plant.dt > 0``, or ``sample_time`` is not a positive number, or an unstable mode outgrows double precision
        within it.
    PreconditionError
        As for `eliminate_algebraic_states`; or continuous white noise reaches an output directly.

    References
    ----------
    .. [VanLoan1978] C. Van Loan, "Computing integrals involving the matrix exponential", IEEE TAC 23, 1978.
    """
    if isinstance(plant, Transformation):
        return plant.then(discretise(plant.plant, sample_time))
    if plant.dt > 0.0:
        raise SpecError(f"The plant is already sampled (dt = {plant.dt:g} s): give a continuous plant.", path="dt")
    real_number(sample_time, "sample_time", "a positive number of seconds", above=0.0)
    require_no_overflow(sample_time, "sample_time", "sample_time")
    first = eliminate_algebraic_states(plant)
    smooth = first.plant
    direct = np.flatnonzero(np.any(smooth.Dw, axis=0))
    process = np.flatnonzero(np.any(dense(plant.Bw), axis=0) | np.any(smooth.Bw, axis=0))
    signals = tuple(smooth.noise_names[i] for i in np.intersect1d(direct, process))
    if signals:
        raise PreconditionError(
            f"Process noise {', '.join(signals)} reaches an output directly, where continuous white noise has "
            "infinite variance: give measurement noise in Dw only, or filter the process noise by a state.",
            condition="noise without a direct path",
            signals=signals,
        )
    _require_bounded_growth(smooth.A, float(sample_time))
    signals_in = np.hstack([smooth.B, smooth.Bf, smooth.Bd])
    few = sum(signals_in.shape) <= MOST_ROUNDED_ONCE
    transition, held = zero_order_hold(smooth.A, signals_in, sample_time, exponential=_rounded_once if few else None)
    B, Bf, Bd = columns_of(held, (smooth.nu, smooth.nf, smooth.nd))
    factor = _noise_factor(smooth.A, smooth.Bw, sample_time)
    kept = [smooth.noise_names[i] for i in direct]
    noise_names = [*(f"process noise {i + 1}" for i in range(factor.shape[1])), *kept]
    Bw = np.hstack([factor, np.zeros((smooth.nx, len(kept)))])
    Dw = np.hstack([np.zeros((smooth.ny, factor.shape[1])), smooth.Dw[:, direct]])
    changes = {"A": transition, "B": B, "Bf": Bf, "Bd": Bd, "Bw": Bw, "Dw": Dw}
    exact = sampled_exact_numbers(smooth, sample_time) if smooth.nx <= MOST_STATES_EXACTLY else None
    sampled = smooth.replace(**changes, dt=float(sample_time), noise_names=noise_names, exact=exact)
    noise_kept = np.hstack([np.zeros((smooth.nw, factor.shape[1])), np.eye(smooth.nw)[:, direct]])
    recovery = unchanged_states(smooth, sampled, from_state=np.eye(smooth.nx), noise_kept=noise_kept)
    description = f"sampled every {sample_time:g} s (zero-order hold)"
    note_source(smooth, sampled, sample_time=float(sample_time))
    step = Transformation(smooth, sampled, description, recovery)
    return first.then(step.with_tolerances(SAMPLED, sample_time))


def _rounded_once(block: FloatArray, step: float) -> FloatArray | None:
    """Return ``exp(A h)`` in which every entry is rounded once; ``None`` where its balls are too wide."""
    with flint.ctx.workprec(SQUARING_BITS):
        found = as_ball((arb_matrix(block) * flint.arb(float(step))).exp())
    size = np.abs(found.midpoint)
    if not np.max(found.radius, initial=0.0) <= CANCELLATION_TOLERANCE * np.max(size, initial=0.0):
        return None
    return np.where(size > found.radius, found.midpoint, 0.0)


def _require_bounded_growth(A: FloatArray, sample_time: float) -> None:
    """Raise `SpecError` where the fastest unstable mode of ``A`` leaves the range of numbers within a sample."""
    rate = float(np.linalg.eigvals(balanced_matrix(A)[0]).real.max(initial=0.0))
    if rate * sample_time > math.log(LARGEST):
        raise SpecError(
            f"In one sample of {sample_time:g} s an unstable mode (eigenvalue {rate:.3g} 1/s) grows beyond "
            f"{LARGEST:g}: sample more often than every {math.log(LARGEST) / rate:.2g} s, or look at the signs and "
            "units of A.",
            path="sample_time",
        )
    require_no_overflow(float(np.abs(A).max(initial=0.0)) * sample_time, "A times sample_time", "sample_time")


def sampling_zero_warnings(plant: DescriptorSystem) -> tuple[str, ...]:
    """Return a text for every fault zero inside, but near, the unit circle: estimates ring ``dt / -ln abs(z)`` s."""
    if not plant.is_discrete:
        return ()
    zeros, outside = fault_zeros(plant)
    inside = [zero.value for zero in zeros if not any(zero is other for other in outside)]
    texts = [
        f"Fault zero at {pole_text(value, 6, pair=True)} (modulus {abs(value):.6g}): errors of a fault estimate decay "
        f"there with a time constant of {-plant.dt / math.log(abs(value)):.3g} s. Sample more slowly, or measure a "
        "signal nearer to the fault."
        for value in inside
        if value.imag >= 0.0 and SLOW_ZERO_RADIUS < abs(value) < 1.0
    ]
    return tuple(dict.fromkeys(texts))


def _noise_factor(A: FloatArray, noise: FloatArray, step: float) -> FloatArray:
    """Return a factor of the covariance that unit white noise through ``noise`` gathers in ``step``."""
    nx = A.shape[0]
    if not noise.any():
        return np.zeros((nx, 0))
    balanced, scale = balanced_matrix(A)
    scaled = noise / scale[:, None]
    # Van Loan's block grows like exp(-A h): integrate a short step, then double it.
    doublings = math.ceil(math.log2(max(float(np.linalg.norm(balanced, 1)) * step, 1.0)))
    block = np.block([[-balanced, scaled @ scaled.T], [np.zeros((nx, nx)), balanced.T]])
    result = scipy.linalg.expm(block * (step / 2.0**doublings))
    transition = result[nx:, nx:].T
    covariance = transition @ result[:nx, nx:]
    for _ in range(doublings):
        covariance = covariance + transition @ covariance @ transition.T
        transition = transition @ transition
    # An integrated state gathers far less noise than its derivative: compare like with like.
    spread = power_of_two_below(np.sqrt(np.abs(np.diag(covariance))))
    correlation = covariance / spread / spread[:, None]
    sizes, directions = np.linalg.eigh((correlation + correlation.T) / 2.0)
    kept = sizes > CANCELLATION_TOLERANCE * sizes[-1]
    return np.asarray((scale * spread)[:, None] * directions[:, kept] * np.sqrt(sizes[kept]))

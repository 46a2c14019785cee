"""Structure of a plant with the evidence for it, and questions about plants that may be mistyped."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from types import MappingProxyType

import numpy as np

from obsynth.analysis.existence.statements import Evaluator
from obsynth.analysis.zeros import unstable_poles
from obsynth.files.tables import text_table
from obsynth.numerics.arguments import arguments_checked
from obsynth.numerics.arrays import ComplexArray
from obsynth.numerics.libraries import on_one_thread_if_small
from obsynth.numerics.ranks import RankDecision, decide_rank
from obsynth.numerics.scaling import equilibrate_pencil
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.pencil import structure_of
from obsynth.plants.signal_names import listed
from obsynth.plants.transformations.delays import linear_plant
from obsynth.plants.transformations.recovery import Transformation

#: A sampled plant with an eigenvalue this far from zero grows so fast that it is hardly one.
_FAR_EIGENVALUE = 3.0

#: Larger plants are not asked: their eigenvalues would take too long for a question.
_QUESTIONS_UP_TO = 200

#: Eigenvalues that a text lists; of more the first and last ones.
_MOST_SHOWN = 12

#: Signals that a question lists.
_MOST_QUESTIONED = 5


@dataclass(frozen=True, eq=False)
class Structure:
    """What kind of plant this is, with the evidence: every rank decided on the way is among the ``decisions``."""

    regular: bool
    index: int | None  # size of the largest block at infinity, ``None`` unless regular
    finite_eigenvalues: ComplexArray
    infinite_block_sizes: tuple[int, ...]
    impulse_free: bool
    stable: bool
    admissible: bool  # regular, impulse-free and stable
    observability_normal_rank: int  # of ``[A - z E; C]`` at almost every z
    unobservable_modes: tuple[complex, ...]
    undetectable_modes: tuple[complex, ...]
    finitely_observable: bool
    detectable: bool
    impulse_observable: bool  # ``rank [E A; 0 E; 0 C] = nx + rank E``
    causally_observable: bool  # ``rank [E; C] = nx``
    rank_of_E: RankDecision
    decisions: Mapping[str, RankDecision]

    def __repr__(self) -> str:
        """Return what a reader wants to know in lines; the evidence is among the ``decisions``."""
        words = {True: "yes", False: "no"}
        regular = "regular" if self.regular else "NOT regular"
        modes = np.array2string(np.array(self.unobservable_modes), precision=4, threshold=_MOST_SHOWN)
        facts = {
            "pencil": f"{regular}, {'no index' if self.index is None else f'index {self.index}'}",
            "E": self.rank_of_E.describe(),
            "finite eigenvalues": np.array2string(self.finite_eigenvalues, precision=4, threshold=_MOST_SHOWN),
            "stable": words[self.stable],
            "impulse-free": words[self.impulse_free],
            "observable": "yes" if self.finitely_observable else f"no: {modes}",
            "detectable": words[self.detectable],
            "impulse observable": words[self.impulse_observable],
            "rank [E; C] = nx": words[self.causally_observable],
        }
        facts |= {"unclear ranks": ", ".join(self.unclear)} if self.unclear else {}
        return "\n".join(text_table([("structure", ""), *facts.items()]))

    @property
    def unclear(self) -> tuple[str, ...]:
        """Names of the rank decisions without a clear gap."""
        return tuple(name for name, decision in self.decisions.items() if not decision.clear)


# Conditions, synthesis and verification ask for the same plant's; plants never change.
@arguments_checked
@lru_cache(maxsize=4)
@on_one_thread_if_small
def analyse_structure(plant: DescriptorSystem | Transformation) -> Structure:
    """Analyse regularity, index, stability and observability of ``plant``.

    Parameters
    ----------
    plant : DescriptorSystem or Transformation
        ``E, A (nx, nx)``, ``C (ny, nx)``, either time.

    Returns
    -------
    Structure
        A plant whose pencil is singular has ``regular`` False.

    Raises
    ------
    SpecError
        ``plant`` is neither a `DescriptorSystem` nor a `Transformation`.
    PreconditionError
        It is continuous and has delays.

    Notes
    -----
    Eigenvalues on the boundary count as unstable, multiple ones included (see `are_outside`).

    References
    ----------
    .. [Dai1989] L. Dai, "Singular Control Systems", 1989, chapters 1 and 2.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(E=[[1, 0], [0, 0]], A=[[-1, 1], [1, -2]], C=[[1, 0]])
    >>> structure = obsynth.analyse_structure(plant)
    >>> structure.index, structure.admissible
    (1, True)
    """
    plant = linear_plant(plant).dense()
    judge = Evaluator(plant)
    E, A, C = judge.natural.E, judge.natural.A, judge.natural.C
    pencil, unstable = structure_of(plant), unstable_poles(plant)
    stable = pencil.regular and not unstable
    impulse_free = pencil.index is not None and pencil.index <= 1

    hidden = judge.hidden_modes()
    full = hidden.normal_rank == plant.nx

    rank_e = decide_rank(E, expected=plant.nx)
    zero, none = np.zeros_like(E), np.zeros_like(C)
    impulse = decide_rank(np.block([[E, A], [zero, E], [none, C]]), expected=plant.nx + rank_e.rank)
    causal = decide_rank(np.vstack([E, C]), expected=plant.nx)
    decisions = {"rank E": rank_e, "rank [E; C]": causal, "rank [E A; 0 E; 0 C]": impulse}
    decisions |= {f"pencil A - zE, step {i + 1}": decision for i, decision in enumerate(pencil.decisions)}
    decisions |= {f"pencil [A - zE; C], step {i + 1}": decision for i, decision in enumerate(hidden.decisions)}
    tall = equilibrate_pencil(np.vstack([E, none]), np.vstack([A, C]))
    decisions |= {
        f"rank [A - zE; C] at z = {mode:.6g}": decide_rank(tall.A - judge.units.rate * mode * tall.E, expected=plant.nx)
        for mode in unstable
        if mode.imag >= 0.0
    }
    return Structure(
        regular=pencil.regular,
        index=pencil.index,
        finite_eigenvalues=pencil.finite_eigenvalues,
        infinite_block_sizes=pencil.infinite_block_sizes,
        impulse_free=impulse_free,
        stable=stable,
        admissible=stable and impulse_free,
        observability_normal_rank=hidden.normal_rank,
        unobservable_modes=hidden.zeros,
        undetectable_modes=hidden.outside,
        finitely_observable=full and not hidden.zeros,
        detectable=full and not hidden.outside,
        impulse_observable=impulse.full,
        causally_observable=causal.full,
        rank_of_E=rank_e,
        decisions=MappingProxyType(decisions),
    )


def questions(plant: DescriptorSystem) -> tuple[str, ...]:
    """Return what to ask about a linear plant: half an operating point, or matrices of another time than ``dt``."""
    return (*_half_a_point(plant), *(_other_time(plant) if plant.nx <= _QUESTIONS_UP_TO else ()))


def _half_a_point(plant: DescriptorSystem) -> tuple[str, ...]:
    """Ask about measured signals that the operating point leaves out, and say where the plant rests."""
    point, measured = plant.operating_point, (*plant.input_names, *plant.output_names)
    missing = [name for name in measured if name not in point]
    if not missing or not any(point.values()):
        return ()
    text = f"{', '.join(list(point)[:_MOST_QUESTIONED])}, but not {listed(missing, most=_MOST_QUESTIONED)}"
    return (
        f"operating_point has {text}: the values of these in a log count as deviations. "
        f"Give their values at that point as well{_resting_outputs(plant, missing)}.",
    )


def _resting_outputs(plant: DescriptorSystem, missing: Sequence[str]) -> str:
    """Return in words where the missing outputs are at rest, if the equations hold for absolute values."""
    names = [name for name in missing if name in plant.output_names]
    if not names or plant.nx > _QUESTIONS_UP_TO:
        return ""
    plain, point = plant.dense(), plant.operating_point
    known = np.array([point.get(name, 0.0) for name in plant.input_names])
    unknown = np.array([point.get(name, 0.0) for name in plant.disturbance_names])
    matrix = plain.A - plain.E if plant.is_discrete else plain.A
    drive = plain.B @ known + plain.Bd @ unknown
    state, _, rank, _ = np.linalg.lstsq(matrix, -drive, rcond=None)
    if rank < plant.nx:
        return ""
    values = plain.C @ state + plain.D @ known + plain.Dd @ unknown
    outputs = dict(zip(plant.output_names, values, strict=True))
    text = ", ".join(f"{name} {outputs[name]:.5g}" for name in names[:_MOST_QUESTIONED])
    return f" (if the equations hold for absolute values, the plant rests there at {text})"


def _other_time(plant: DescriptorSystem) -> tuple[str, ...]:
    """Ask about eigenvalues that are those of a plant in the other kind of time."""
    plain = plant.dense()
    values = np.asarray(structure_of(plain).finite_eigenvalues)
    values = values[np.isfinite(values)]
    far, close = int(np.sum(np.abs(values) > _FAR_EIGENVALUE)), (np.abs(values) < 1.0) & (values.real > 0.0)
    if plant.is_discrete and far and np.sum(values.real < 0.0) >= values.size / 2.0:
        return (
            f"dt is {plant.dt:g} s, but {far} of {values.size} eigenvalues lie far outside the unit circle (up to "
            f"{np.abs(values).max():.3g}): are these the matrices of a plant in continuous time? Then give dt: 0, "
            "and let transform.sample_time sample it.",
        )
    if not plant.is_discrete and values.size > 1 and bool(close.all()):
        return (
            "dt is 0, but all eigenvalues lie in the right half of the unit circle: are these the matrices of a "
            "sampled plant? Then give dt in seconds.",
        )
    return ()

"""The part of a plant that is decoupled from its unknown inputs, on which faults are diagnosed and filters designed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from obsynth.analysis.diagnosis.without_unknown_inputs import PencilUnits, finite_values, left_part
from obsynth.errors import SpecError, counted
from obsynth.numerics.arguments import arguments_checked
from obsynth.numerics.arrays import ComplexArray, FloatArray, read_only
from obsynth.numerics.libraries import on_one_thread_if_small
from obsynth.numerics.ranks import RankDecision, product_but_rounding, rank_from
from obsynth.numerics.staircase import full_svd
from obsynth.numerics.suggestions import there_are
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.transformations.delays import linear_plant
from obsynth.plants.transformations.recovery import Transformation

#: Entries of unit rows below this are rounding of the orthogonal transformations that made them.
ROTATION_ROUNDING = 1e-14


@dataclass(frozen=True, eq=False)
class DecoupledPlant:
    r"""What a plant tells without its unknown inputs.

    .. math::
        E z^+ = A z + B_u u + B_y y + F f + N w, \qquad H y = C z + D_u u + G f + M w

    with E regular and (E, A, C) observable: an ordinary plant whose known inputs are u **and y**, on which no unknown
    input acts.  Its order is the sum of the left Kronecker indices of ``[A - sE, Bd; C, Dd]``.

    Parameters
    ----------
    E, A : FloatArray
        ``(k, k)``.
    C : FloatArray
        ``(p, k)``.
    Bu, By, F, N : FloatArray
        ``(k, nu)``, ``(k, ny)``, ``(k, estimated faults)``, ``(k, nw)``.
    Du, H, G, M : FloatArray
        ``(p, nu)``, ``(p, ny)``, ``(p, estimated faults)``, ``(p, nw)``.
    rows : FloatArray
        ``(k + p, nx + ny)``: the combinations of the plant's equations, and of its outputs, that these rows are.
    states : FloatArray
        ``(k, nx)``: ``z = states @ x``.
    removed : ComplexArray
        Finite zeros of the pencil of the unknown inputs, 1/s (or dimensionless).  They need not be stable: no filter
        has a pole there.
    source : DescriptorSystem
        The plant.
    faults : tuple of str
        The faults to be estimated, in the order of the columns of F.
    without : tuple of str
        What was removed: the unknown inputs, and faults that are not to show.
    fault_sizes : FloatArray
        Sizes of the faults' columns in balanced units, before the reduction.
    signal_sizes : FloatArray
        The same of the columns of ``[u; y]``; one for those that are zero.
    time : float
        Unit of s in which the plant is balanced, 1/s.
    decisions : tuple of RankDecision
        Every rank decided on the way.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]], C=[[1, 0], [0, 1]], Bf=[[1], [0]], Bd=[[0], [1]], dt=1.0
    ... )
    >>> decoupled = obsynth.decouple(plant)
    >>> decoupled.order, decoupled.faults, decoupled.without
    (1, ('f1',), ('d1',))
    """

    E: FloatArray
    A: FloatArray
    C: FloatArray
    Bu: FloatArray
    By: FloatArray
    F: FloatArray
    N: FloatArray
    Du: FloatArray
    H: FloatArray
    G: FloatArray
    M: FloatArray
    rows: FloatArray
    states: FloatArray
    removed: ComplexArray
    source: DescriptorSystem
    faults: tuple[str, ...]
    without: tuple[str, ...]
    fault_sizes: FloatArray
    signal_sizes: FloatArray
    time: float
    decisions: tuple[RankDecision, ...]

    def __repr__(self) -> str:
        """Return what was removed and what is left, without the matrices."""
        removed = ", ".join(self.without) or "nothing"
        left = f"{counted(self.order, 'state')} and {counted(len(self.C), 'output')} for {', '.join(self.faults)}"
        return f"<DecoupledPlant without {removed}: {left}>"

    @property
    def order(self) -> int:
        """Number of states left."""
        return int(self.E.shape[0])

    @property
    def signals(self) -> FloatArray:
        """Columns ``(k + p, nu + ny)`` of ``[u; y]`` in both equations, each in units of its size."""
        return np.asarray(np.block([[self.Bu, self.By], [self.Du, -self.H]]) / self.signal_sizes)

    @property
    def thinnest(self) -> RankDecision | None:
        """The least clear rank decision; ``None`` where nothing had to be decided."""
        return min(self.decisions, key=lambda decision: decision.gap, default=None)

    @property
    def plant(self) -> DescriptorSystem:
        """The decoupled plant by itself: inputs ``[u; y]``, outputs ``H y``."""
        p, ny = len(self.C), self.By.shape[1]
        source = self.source
        return DescriptorSystem(
            self.E,
            self.A,
            np.hstack([self.Bu, self.By]),
            self.C if p else np.zeros((0, self.order)),
            D=np.hstack([self.Du, np.zeros((p, ny))]),
            Bf=self.F,
            Df=self.G,
            Bw=self.N,
            Dw=self.M,
            dt=source.dt,
            input_names=(*source.input_names, *(f"measured {name}" for name in source.output_names)),
            output_names=[f"r{i + 1}" for i in range(p)],
            state_names=[f"z{i + 1}" for i in range(self.order)],
            fault_names=self.faults,
            noise_names=source.noise_names,
        )


@arguments_checked
@on_one_thread_if_small
def decouple(
    plant: DescriptorSystem | Transformation, *, without: Sequence[str] = (), faults: Sequence[str] | None = None
) -> DecoupledPlant:
    """Remove the unknown inputs, and faults that are to have no effect, from a plant.

    Exact for descriptor plants of any index, and whatever the unknown inputs, the faults removed and the initial state
    are.  What is decided on the way does not depend on the units of the data, that of time included.

    Parameters
    ----------
    plant : DescriptorSystem or Transformation
        Either time; ``sE - A`` need not be regular.
    without : sequence of str, optional
        Names of faults to remove together with every unknown input.
    faults : sequence of str, optional
        Names of the faults to keep; all that are not removed by default.  The others are taken to be absent.

    Returns
    -------
    DecoupledPlant
        ``F (k, len(faults))`` and its like; the order k is the sum of the left Kronecker indices.

    Raises
    ------
    SpecError
        A name is unknown, or stands in both lists.

    References
    ----------
    .. [Frisk] E. Frisk, M. Nyberg, "A minimal polynomial basis solution to residual generation for fault diagnosis in
       linear systems", Automatica 37, 2001: the null space; here it is never formed, but reduced to a state space.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]], C=[[1, 0], [0, 1]], Bf=[[1], [0]], Bd=[[0], [1]], dt=1.0
    ... )
    >>> obsynth.decouple(plant).plant.nd
    0
    """
    plant = linear_plant(plant)
    removed = fault_numbers(plant, without, "without")
    estimated = (
        [i for i in range(plant.nf) if i not in removed] if faults is None else fault_numbers(plant, faults, "faults")
    )
    contradictory = [plant.fault_names[i] for i in estimated if i in removed]
    if contradictory:
        raise SpecError(f"{', '.join(contradictory)}: a fault cannot be kept and removed.", path="without")
    return decoupled(plant, removed, estimated)


def fault_numbers(plant: DescriptorSystem, names: Sequence[str], where: str) -> list[int]:
    """Return the columns of faults by name."""
    listed = [names] if isinstance(names, str) else list(names)
    unknown = [name for name in listed if name not in plant.fault_names]
    if unknown:
        raise SpecError(
            f"{', '.join(map(repr, unknown))}: no such fault; {there_are(unknown[0], plant.fault_names)}",
            path=where,
        )
    return [plant.fault_names.index(name) for name in dict.fromkeys(listed)]


def decoupled(plant: DescriptorSystem, removed: Sequence[int], estimated: Sequence[int]) -> DecoupledPlant:
    """Remove the unknown inputs and the faults ``removed`` from a plant; keep those that are ``estimated``."""
    nx, ny = plant.nx, plant.ny
    pencil_e, pencil_a = unknowns_pencil(plant, removed)
    units = PencilUnits.of(pencil_e, pencil_a, sampled=plant.is_discrete)
    part = left_part(
        units.rows[:, None] * pencil_e * units.columns * units.time, units.rows[:, None] * pencil_a * units.columns
    )
    # Rows of the orthogonal reduction have unit length: what is below rounding is nothing.
    rows = np.array(part.left_factor)
    moving = units.rows[:nx, None] * plant.E * units.columns[:nx]
    rows[part.order :, :nx] = _without_dynamics(rows[part.order :, :nx], moving)
    rows = np.where(np.abs(rows) > ROTATION_ROUNDING, rows, 0.0) * units.rows
    faults = np.vstack([plant.Bf, plant.Df])[:, list(estimated)]
    signals = np.block([[plant.B, np.zeros((nx, ny))], [plant.D, -np.eye(ny)]])
    sizes = np.linalg.norm(units.rows[:, None] * signals, axis=0)
    k = part.order
    parts = {
        "u": product_but_rounding(rows, signals[:, : plant.nu]),
        "y": product_but_rounding(rows, signals[:, plant.nu :]),
        "f": product_but_rounding(rows, faults),
        "w": product_but_rounding(rows, np.vstack([plant.Bw, plant.Dw])),
    }
    return DecoupledPlant(
        E=read_only(_without_rounding(part.E) / units.time),
        A=read_only(_without_rounding(part.A)),
        C=read_only(_without_rounding(part.C)),
        Bu=read_only(parts["u"][:k]),
        By=read_only(parts["y"][:k]),
        F=read_only(parts["f"][:k]),
        N=read_only(parts["w"][:k]),
        Du=read_only(parts["u"][k:]),
        H=read_only(-parts["y"][k:]),
        G=read_only(parts["f"][k:]),
        M=read_only(parts["w"][k:]),
        rows=read_only(rows),
        states=read_only((part.right_factor / units.columns)[:, :nx]),
        removed=finite_values(part) * units.time,
        source=plant,
        faults=tuple(plant.fault_names[i] for i in estimated),
        without=(*plant.disturbance_names, *(plant.fault_names[i] for i in removed)),
        fault_sizes=read_only(np.linalg.norm(units.rows[:, None] * faults, axis=0)),
        signal_sizes=read_only(np.where(sizes > 0.0, sizes, 1.0)),
        time=units.time,
        decisions=part.decisions,
    )


def _without_dynamics(rows: FloatArray, e: FloatArray) -> FloatArray:
    """Return combinations of equations that hold no derivative, ``rows E = 0``, without what rounding put into them.

    Nothing at all is left of them where E is regular: a reduction of many steps leaves more than the rounding of one.
    """
    left_vectors, values, _ = full_svd(e)
    rank = rank_from(values, expected=len(e)).rank
    if rank == len(e):
        return np.zeros_like(rows)
    span = left_vectors[:, :rank]
    return np.asarray(rows - (rows @ span) @ span.T)


def _without_rounding(matrix: FloatArray) -> FloatArray:
    """Return a matrix of the balanced plant, in which entries are near one, without what is only rounding."""
    size = ROTATION_ROUNDING * max(1.0, float(np.max(np.abs(matrix), initial=0.0)))
    return np.where(np.abs(matrix) > size, matrix, 0.0)


def unknowns_pencil(plant: DescriptorSystem, removed: Sequence[int]) -> tuple[FloatArray, FloatArray]:
    """Return E and A of ``[A - sE, Bd, Bf; C, Dd, Df]`` with the faults ``removed`` beside the unknown inputs."""
    columns = list(removed)
    a = np.block([[plant.A, plant.Bd, plant.Bf[:, columns]], [plant.C, plant.Dd, plant.Df[:, columns]]])
    e = np.zeros_like(a)
    e[: plant.nx, : plant.nx] = plant.E
    return e, a

"""Linear time-invariant descriptor systems with named signals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from obsynth.errors import SpecError
from obsynth.numerics.arrays import FloatArray, read_only, restore
from obsynth.numerics.quantities import numbers_in_units
from obsynth.numerics.sparse import dense, is_sparse, same_matrix
from obsynth.numerics.suggestions import no_attribute
from obsynth.plants.dead_times import delays_in_words
from obsynth.plants.exact_numbers import DECISIVE, ExactNumbers, exact_numbers
from obsynth.plants.given_matrices import ALL_MATRICES, SIGNAL_NAMES, MatrixOrNames, plant_fields
from obsynth.plants.other_names import ELSEWHERE, plant_keywords_suggested
from obsynth.plants.resized import with_what_follows, without_sensor_noise
from obsynth.plants.uncertainty import UNCERTAIN_MATRICES, Uncertainty, uncertainty_of

#: Larger plants as written are not stored with a design: their elimination is checked where it is done.
MOST_STORED_STATES = 500


def note_source(source: DescriptorSystem, new: DescriptorSystem, *, sample_time: float | None = None) -> None:
    """Note on a plant that elimination or sampling has just made which plant, as written, it comes from."""
    if new is source:
        return
    written, earlier = getattr(source, "_made_from", (source, None))
    if earlier is None or sample_time is None:
        object.__setattr__(new, "_made_from", (written, earlier if sample_time is None else sample_time))


def carry_source(old: DescriptorSystem, new: DescriptorSystem) -> None:
    """Note on a changed plant which plant, as written, the old one comes from, if nothing has changed that matters."""
    made = getattr(old, "_made_from", None)
    unchanged = (old.dt, old.delays) == (new.dt, new.delays) and all(
        same_matrix(getattr(old, name), getattr(new, name)) for name in (*DECISIVE, "B", "D")
    )
    if made is not None and unchanged:
        written, time = made
        if not (
            same_matrix(getattr(old, "Bw", None), getattr(new, "Bw", None))
            and same_matrix(getattr(old, "Dw", None), getattr(new, "Dw", None))
        ):
            # The noise was stated anew since: that of the plant as written says nothing about it.
            written = written.replace(Bw=None, Dw=None, noise_names=None)
        object.__setattr__(new, "_made_from", (written, time))


@dataclass(frozen=True, eq=False, init=False)
class DescriptorSystem:
    r"""A linear descriptor system with faults, unknown inputs and noise.

    .. math::
        E x^+ = A x + B u + B_d d + B_f f + B_w w, \qquad
        y = C x + D u + D_d d + D_f f + D_w w

    where :math:`x^+` is :math:`\dot x` for ``dt == 0`` and :math:`x(k+1)` for ``dt > 0``.

    Parameters
    ----------
    E : array_like, sparse matrix or None
        ``(nx, nx)``, may be singular; ``None`` means the identity.
    A : array_like or sparse matrix
        ``(nx, nx)``.  Sparse matrices of scipy stay sparse, here and wherever else they are given; methods get the
        plant without its algebraic states, which is dense (see `eliminate_algebraic_states` and `dense`).  Any matrix
        may be a labelled ``pandas.DataFrame``: its labels are the names, and rows and columns are put in one order.
    B : array_like, optional
        Known inputs ``(nx, nu)``.
    C : array_like or list of str, optional
        Outputs ``(ny, nx)``, or the names of the states that are measured.
    D : array_like, optional
        Feedthrough of the known inputs ``(ny, nu)``.
    Bf, Df : array_like, optional
        Faults ``(nx, nf)`` and ``(ny, nf)``.  ``Bf`` may be a list of state names: the fault is then
        added to the equation of the same number as that state.  ``Df`` may be a list of output names: each adds a
        fault of that sensor, after those of ``Bf``.
    Bd, Dd : array_like, optional
        Unknown inputs (disturbances) ``(nx, nd)`` and ``(ny, nd)``; by name as faults.
    Bw, Dw : array_like, optional
        Noise ``(nx, nw)`` and ``(ny, nw)``: ``w`` is white with unit covariance, so the columns hold
        standard deviations (per sample for ``dt > 0``, and always per sample in ``Dw``).
    dt : float, optional
        Seconds between samples, also as a `timedelta` or a quantity; 0 for continuous time.
    state_names, input_names, output_names, fault_names, disturbance_names, noise_names : list of str, optional
        Signal names; ``x1, x2, ...`` and so on by default.
    operating_point : mapping, optional
        Value of named signals at the point where a linear model was taken, in the signal's unit.
    scales : mapping, optional
        Factor of named inputs and outputs: what a log holds, times the factor, is in the signal's unit.
    units : mapping, optional
        Unit of named signals, as text.
    delays : mapping, optional
        Dead times of named inputs and outputs: seconds, or texts such as ``"300 ms"``.  A delayed input acts late
        wherever it acts; a delayed output shows late what ``C x + D u + Dd d + Df f`` was (``Dw`` is noise of the
        reading, and is not delayed).  Methods take the plant that `discretise` or `absorb_delays` makes of it.
    sensor_noise : mapping, optional
        Standard deviation of the noise of named outputs, per sample: adds a column to ``Dw`` for each.
    uncertainty : Uncertainty, optional
        Constants with tolerances in the matrices, see `obsynth.uncertain_system`.
    exact : ExactNumbers, optional
        Rational numbers that the matrices were rounded from, on which existence is decided; elimination and sampling
        give them, and `as_dict` has them as data.

    Raises
    ------
    SpecError
        A matrix has the wrong shape, holds something that is no finite number, or a name is unknown
        or repeated; all problems are listed at once.

    Examples
    --------
    >>> plant = DescriptorSystem([[1, 0], [0, 0]], [[0.5, 1], [1, 1]], C=[[1, 0], [0, 1]], Bf=[[1], [0]], dt=1.0)
    >>> plant.nx, plant.ny, plant.nf
    (2, 2, 1)
    """

    E: FloatArray
    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray
    Bf: FloatArray
    Df: FloatArray
    Bd: FloatArray
    Dd: FloatArray
    Bw: FloatArray
    Dw: FloatArray
    dt: float
    state_names: tuple[str, ...]
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]
    fault_names: tuple[str, ...]
    disturbance_names: tuple[str, ...]
    noise_names: tuple[str, ...]
    operating_point: Mapping[str, float]
    scales: Mapping[str, float]
    units: Mapping[str, str]
    delays: Mapping[str, float]
    uncertainty: Uncertainty | None
    exact: ExactNumbers | None

    @plant_keywords_suggested
    def __init__(
        self,
        E: ArrayLike | None = None,
        A: ArrayLike | None = None,
        B: ArrayLike | None = None,
        C: MatrixOrNames = None,
        *,
        D: ArrayLike | None = None,
        Bf: MatrixOrNames = None,
        Df: MatrixOrNames = None,
        Bd: MatrixOrNames = None,
        Dd: MatrixOrNames = None,
        Bw: ArrayLike | None = None,
        Dw: ArrayLike | None = None,
        dt: float = 0.0,
        state_names: Sequence[str] | None = None,
        input_names: Sequence[str] | None = None,
        output_names: Sequence[str] | None = None,
        fault_names: Sequence[str] | None = None,
        disturbance_names: Sequence[str] | None = None,
        noise_names: Sequence[str] | None = None,
        operating_point: Mapping[str, float] | None = None,
        scales: Mapping[str, float] | None = None,
        units: Mapping[str, str] | None = None,
        delays: Mapping[str, Any] | None = None,
        sensor_noise: Mapping[str, float] | None = None,
        uncertainty: Uncertainty | Mapping[str, Any] | None = None,
        exact: ExactNumbers | Mapping[str, Any] | None = None,
    ) -> None:
        if A is None:
            raise SpecError("A is missing: give the matrix (nx, nx) of the dynamics.", path="A")
        matrices = {"E": E, "A": A, "B": B, "C": C, "D": D, "Bf": Bf, "Df": Df, "Bd": Bd, "Dd": Dd, "Bw": Bw, "Dw": Dw}
        names = {
            "state_names": state_names,
            "input_names": input_names,
            "output_names": output_names,
            "fault_names": fault_names,
            "disturbance_names": disturbance_names,
            "noise_names": noise_names,
        }
        stated = units if isinstance(units, Mapping) else {}
        point = numbers_in_units(operating_point, stated, "operating_point")
        noise = numbers_in_units(sensor_noise, stated, "sensor_noise", are_differences=True)
        values = plant_fields(
            matrices,
            names,
            dt=dt,
            operating_point=point,
            scales=scales,
            units=units,
            delays=delays,
            sensor_noise=noise,
        )
        values["uncertainty"] = uncertainty_of(uncertainty)
        values["exact"] = exact_numbers(exact)
        for key, value in values.items():
            object.__setattr__(self, key, read_only(value) if isinstance(value, np.ndarray) else value)
        if self.exact is not None and self.exact is not exact:
            self.exact.require_of({name: getattr(self, name) for name in DECISIVE})

    @property
    def nx(self) -> int:
        """Number of states."""
        return int(self.A.shape[0])

    @property
    def nu(self) -> int:
        """Number of known inputs."""
        return int(self.B.shape[1])

    @property
    def ny(self) -> int:
        """Number of outputs."""
        return int(self.C.shape[0])

    @property
    def nf(self) -> int:
        """Number of faults."""
        return int(self.Bf.shape[1])

    @property
    def nd(self) -> int:
        """Number of unknown inputs."""
        return int(self.Bd.shape[1])

    @property
    def nw(self) -> int:
        """Number of noise inputs."""
        return int(self.Bw.shape[1])

    @property
    def is_sparse(self) -> bool:
        """Whether any matrix of the plant is a sparse one."""
        return any(is_sparse(getattr(self, name)) for name in ALL_MATRICES)

    def dense(self) -> DescriptorSystem:
        """Return the same plant with arrays instead of sparse matrices; a plant without any is returned as it is."""
        if not self.is_sparse:
            return self
        return self.replace(**{name: dense(getattr(self, name)) for name in ALL_MATRICES})

    @property
    def sensor_faults(self) -> tuple[str, ...]:
        """Faults that act on outputs only: their size has no operating point, whatever they are called."""
        acts = abs(self.Bf).sum(axis=0)
        return tuple(name for name, size in zip(self.fault_names, acts, strict=True) if size == 0.0)

    @property
    def is_discrete(self) -> bool:
        """Whether the plant is sampled (``dt > 0``)."""
        return self.dt > 0.0

    def as_dict(self) -> dict[str, Any]:
        """Return every field, as the constructor takes it; `delays`, `uncertainty` and `exact` only where there are
        such."""
        data = {field.name: getattr(self, field.name) for field in fields(self)}
        if not self.delays:
            data.pop("delays")
        records = {name: data.pop(name) for name in ("uncertainty", "exact")}
        return data | {name: record.as_dict() for name, record in records.items() if record is not None}

    def replace(self, **changes: Any) -> DescriptorSystem:
        """Return a plant with some fields changed, checked again as a whole.

        Tolerances and exact numbers are those of the matrices as they were: with a change of one of these they are
        not carried over, and whatever would use tolerances refuses (``uncertainty=None`` says that the model is exact).
        Units and other labels of signals that are gone, such as those of ``disturbance_names=None``, go with them.
        Matrices without entries, E = I and names such as u1, u2 follow the sizes of the changed matrices.  Noise that
        ``sensor_noise`` states takes the place of what it stated of the same outputs before; `None` removes all of it.

        Parameters
        ----------
        **changes
            Any argument of the constructor.
        """
        arguments = {field.name: getattr(self, field.name) for field in fields(self) if field.name != "exact"}
        changes = with_what_follows(arguments, changes)
        arguments |= without_sensor_noise(arguments, changes)
        gone = {name for field in SIGNAL_NAMES if field in changes for name in getattr(self, field)}
        gone -= {
            name for field in SIGNAL_NAMES for name in (changes[field] or () if field in changes else arguments[field])
        }
        for label in ("operating_point", "scales", "units", "delays"):
            arguments[label] = {name: value for name, value in arguments[label].items() if name not in gone}
        new = DescriptorSystem(**{**arguments, **changes})
        if self.uncertainty is not None and "uncertainty" not in changes:
            moved = [
                name
                for name in UNCERTAIN_MATRICES
                if name in changes and not same_matrix(getattr(self, name), getattr(new, name))
            ]
            if moved or self.dt != new.dt:
                what = f"{', '.join(moved or ['dt'])} {'were' if len(moved) > 1 else 'was'} changed"
                object.__setattr__(new, "uncertainty", self.uncertainty.left_behind(what))
        carry_source(self, new)
        same = self.dt == new.dt and all(same_matrix(getattr(self, name), getattr(new, name)) for name in DECISIVE)
        if same and "exact" not in changes:
            object.__setattr__(new, "exact", self.exact)
        return new

    def __setstate__(self, state: Mapping[str, Any]) -> None:
        restore(self, state)

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            raise no_attribute(self, name, ELSEWHERE)

    def __repr__(self) -> str:
        time = f"dt={self.dt:g} s" if self.is_discrete else "continuous"
        return (
            f"DescriptorSystem(nx={self.nx}, nu={self.nu}, ny={self.ny}, nf={self.nf}, nd={self.nd}, "
            f"nw={self.nw}, {time}{f', delays: {delays_in_words(self.delays)}' if self.delays else ''})"
        )

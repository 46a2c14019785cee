"""Linear time-invariant descriptor systems with named signals.

From what a caller gives for a linear plant to its fields: labelled frames, names for rows, noise of sensors.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from fractions import Fraction
from functools import cached_property, partial
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from obsynth.errors import SpecError
from obsynth.numerics.arguments import require_kind
from obsynth.numerics.arrays import FloatArray, read_only
from obsynth.numerics.quantities import in_unit
from obsynth.numerics.sparse import as_sparse_matrix, dense, is_sparse, same_matrix
from obsynth.plants.checking import (
    COUNTED_BY,
    Problems,
    any_matrix,
    checked_dt,
    checked_labels,
    matrix_or_picks,
    picked_names,
    signal_counts,
)
from obsynth.plants.dead_times import checked_delays, delays_in_words
from obsynth.plants.signal_names import checked_names, is_name_list, plain_names, require_picked, rows_picking
from obsynth.plants.uncertainty import UNCERTAIN_MATRICES, Uncertainty, uncertainty_of

#: Matrix, signal of its rows, signal of its columns.
MATRIX_LAYOUT = (
    ("E", "x", "x"),
    ("A", "x", "x"),
    ("C", "y", "x"),
    ("B", "x", "u"),
    ("D", "y", "u"),
    ("Bf", "x", "f"),
    ("Df", "y", "f"),
    ("Bd", "x", "d"),
    ("Dd", "y", "d"),
    ("Bw", "x", "w"),
    ("Dw", "y", "w"),
)


#: The matrices on which existence depends.
DECISIVE = ("E", "A", "Bf", "Bd", "C", "Df", "Dd")

#: Rational matrices by name.
RationalRows: TypeAlias = Mapping[str, tuple[tuple[Fraction, ...], ...]]


#: Names of the signals of each kind.
_FIELDS = {
    "x": "state_names",
    "u": "input_names",
    "y": "output_names",
    "f": "fault_names",
    "d": "disturbance_names",
    "w": "noise_names",
}


# Where a matrix picked by names names the signal as well.
_NAMED_BY = {"output_names": "C", "fault_names": "Bf", "disturbance_names": "Bd"}


#: Matrices of outputs that may be given by the names of sensors, each with that of the dynamics beside it.
SENSOR_PICKS = {"Df": "Bf", "Dd": "Bd"}


MatrixOrNames = ArrayLike | Sequence[str] | None

SIGNAL_NAMES = ("state_names", "input_names", "output_names", "fault_names", "disturbance_names", "noise_names")

ALL_MATRICES = tuple(name for name, *_ in MATRIX_LAYOUT)

#: Larger plants as written are not stored with a design: their elimination is checked where it is done.
MOST_STORED_STATES = 500


@dataclass(frozen=True, eq=False)
class ExactNumbers:
    """Rational matrices (`DECISIVE`) of a plant, or of the continuous plant that was sampled."""

    matrices: RationalRows
    sample_time: Fraction | None = None
    own: bool = True  # in the states of the plant; otherwise in other coordinates of them
    computed: bool = False  # some were computed in floating point
    sizes: Mapping[str, FloatArray] | None = None  # of the terms of entries, to which rounding is relative
    states: int = 0  # of the plant as written, 0 where unknown
    # Before what elimination of computed data may have left by rounding was set to zero.
    uncleaned: RationalRows | None = None

    @cached_property
    def content(self) -> tuple[object, ...]:
        """What tells these numbers from others: their hash stands for the rational ones."""
        return self.sample_time, self.computed, hash(tuple(self.matrices[name] for name in DECISIVE))

    def before_cleaning(self) -> ExactNumbers:
        """Return the numbers before any were taken for rounding."""
        return self if self.uncleaned is None else replace(self, matrices=self.uncleaned, uncleaned=None)

    def require_of(self, plant: DescriptorSystem) -> None:
        """Raise `SpecError` where these are not the numbers behind the matrices of a plant."""
        for name in DECISIVE:
            rows, matrix = self.matrices[name], getattr(plant, name)
            if (len(rows), *{len(row) for row in rows}) not in (matrix.shape, matrix.shape[:1]):
                raise SpecError(f"exact has another size of {name} than the plant: leave it out.", path="exact")
            rounded = [value.numerator / value.denominator for row in rows for value in row]
            if self.own and self.sample_time is None and rounded != np.ravel(matrix).tolist():
                raise SpecError(f"exact does not round to {name} of the plant: leave it out.", path="exact")

    def as_dict(self) -> dict[str, Any]:
        """Return the numbers as data, rational ones as text."""
        return {
            "matrices": _texts(self.matrices),
            "sample_time": None if self.sample_time is None else _text(self.sample_time),
            "own": self.own,
            "computed": self.computed,
            "sizes": None if self.sizes is None else dict(self.sizes),
            "states": self.states,
            "uncleaned": None if self.uncleaned is None else _texts(self.uncleaned),
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> ExactNumbers:
        """Return the numbers that `as_dict` described."""
        time, sizes, uncleaned = data["sample_time"], data["sizes"], data["uncleaned"]
        return cls(
            _fractions(data["matrices"]),
            None if time is None else _fraction(time),
            bool(data["own"]),
            bool(data["computed"]),
            None if sizes is None else {name: np.asarray(sizes[name], dtype=np.float64) for name in sizes},
            int(data["states"]),
            None if uncleaned is None else _fractions(uncleaned),
        )


def exact_numbers(data: Any) -> ExactNumbers | None:
    """Return what `ExactNumbers.as_dict` described; `None` and exact numbers stay as they are."""
    if data is None or isinstance(data, ExactNumbers):
        return data
    require_kind(data, Mapping, "exact", "what the exact numbers of a plant are as data (as_dict)")
    missing = [field.name for field in fields(ExactNumbers) if field.name not in data]
    if missing:
        raise SpecError(f"exact has no {missing[0]!r}: give what as_dict() returns, or leave it out.", path="exact")
    return ExactNumbers.from_dict(data)


def _texts(matrices: RationalRows) -> dict[str, list[list[str]]]:
    return {name: [[_text(value) for value in row] for row in rows] for name, rows in matrices.items()}


def _fractions(matrices: Mapping[str, Sequence[Sequence[str]]]) -> RationalRows:
    return {name: tuple(tuple(map(_fraction, row)) for row in matrices[name]) for name in DECISIVE}


def _text(value: Fraction) -> str:
    from flint import fmpq

    # Python refuses to write out integers of thousands of digits.
    return str(fmpq(value.numerator, value.denominator))


def _fraction(text: str) -> Fraction:
    from flint import fmpq

    found = fmpq(text)
    return Fraction(int(found.p), int(found.q))


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


def _without_frames(
    matrices: Mapping[str, Any], names: Mapping[str, Sequence[str] | None]
) -> tuple[dict[str, Any], dict[str, Sequence[str] | None]]:
    """Return matrices and names ``{"state_names": ...}``, labels of frames in one order; numbers are no names."""
    plain, labels = dict(matrices), dict(names)
    # A names the states, C the outputs; the first frame with a label decides on an order.
    for name, rows_of, columns_of in sorted(MATRIX_LAYOUT, key=lambda row: (row[0] != "A", row[0] != "C")):
        frame: Any = plain.get(name)
        if not (hasattr(frame, "columns") and hasattr(frame, "index") and hasattr(frame, "to_numpy")):
            continue
        rows = _order(frame.index, _FIELDS[rows_of], labels, f"the rows of {name}")
        columns = _order(frame.columns, _FIELDS[columns_of], labels, f"the columns of {name}")
        plain[name] = frame.to_numpy()[rows][:, columns] if len(frame) else frame.to_numpy()
    return plain, labels


def _order(labels: Any, kind: str, known: dict[str, Sequence[str] | None], what: str) -> list[int]:
    """Return the positions of labels in the order of the names known so far, which they define where there are none."""
    found = list(labels)
    if not found or not all(isinstance(label, str) for label in found):
        return list(range(len(found)))
    repeated = sorted({label for label in found if found.count(label) > 1})
    if repeated:
        raise SpecError(f"{what[0].upper()}{what[1:]} repeat the label {repeated[0]!r}.", path=kind)
    if known.get(kind) is None:
        known[kind] = found
    wanted = list(known[kind] or ())
    missing, foreign = [name for name in wanted if name not in found], [name for name in found if name not in wanted]
    if missing or foreign:
        texts = [f"lack {', '.join(map(repr, missing))}"] if missing else []
        texts += [f"have {', '.join(map(repr, foreign))}"] if foreign else []
        raise SpecError(
            f"{what[0].upper()}{what[1:]} {' and '.join(texts)}: the {kind} are {', '.join(wanted)}.", path=kind
        )
    return [found.index(name) for name in wanted]


def plant_fields(
    asked: Mapping[str, Any],
    names: Mapping[str, Sequence[str] | None],
    *,
    dt: Any,
    operating_point: Any,
    scales: Any,
    units: Any,
    delays: Any,
    sensor_noise: Any,
) -> dict[str, Any]:
    """Return every field of a `DescriptorSystem`; raise one `SpecError` with all problems."""
    problems = Problems()
    matrices, labels = _without_frames(asked, names)
    a = problems.collect(lambda: any_matrix(matrices.pop("A"), "A"))
    problems.raise_if_any()
    nx = a.shape[0]
    if nx == 0 or a.shape[1] != nx:
        raise SpecError(f"A is {nx} by {a.shape[1]}, but it must be square (nx by nx, nx >= 1).", path="A")
    states = problems.collect(lambda: checked_names(labels["state_names"], nx, prefix="x", what="state_names"))
    problems.raise_if_any()
    given: dict[str, FloatArray | None] = {"A": a, "E": _identity_like(a) if matrices["E"] is None else None}
    for name, value in matrices.items():
        if value is not None and not (name in SENSOR_PICKS and is_name_list(value)):
            given[name] = problems.collect(partial(matrix_or_picks, value, name, states))
    more = _appended(matrices, labels, given, sensor_noise, problems)
    sizes = {"x": nx, **signal_counts(given)}
    # What depends on a matrix that could not be read is not judged: its own message is enough.
    broken = {name for name, value in matrices.items() if value is not None and given.get(name) is None}
    unknown = {
        signal
        for signal, telling in COUNTED_BY.items()
        if broken.intersection(telling) and all(given.get(name) is None for name in telling)
    }
    values: dict[str, Any] = {
        name: problems.shaped(given.get(name), name, (sizes[rows], sizes[columns]))
        for name, rows, columns in MATRIX_LAYOUT
        if not unknown.intersection((rows, columns))
    }
    values |= {"dt": problems.collect(lambda: checked_dt(dt)), "state_names": states}
    for signal, key in _FIELDS.items():
        if signal in unknown or signal == "x":
            continue
        own = plain_names(labels[key])
        no_names = own is None or (isinstance(own, (list, tuple)) and not own)
        stated = picked_names(matrices.get(_NAMED_BY.get(key, ""))) if no_names else own
        extra = more.get(key, ())
        if (
            extra
            and is_name_list(["-"] if stated is None else stated)
            and (stated is None or len(stated) == sizes[signal] - len(extra))
        ):
            first = checked_names(stated, sizes[signal] - len(extra), prefix=signal, what=key)
            stated = (*first, *extra)
        values[key] = problems.collect(partial(checked_names, stated, sizes[signal], prefix=signal, what=key))
    if any(values.get(field) is None for field in _FIELDS.values()):
        # What refers to signals by name cannot be judged.
        problems.raise_if_any()
    known, measured = {name for field in _FIELDS.values() for name in values[field]}, set(values["input_names"])
    measured |= set(values["output_names"])
    values |= checked_labels(problems, known, measured, operating_point=operating_point, scales=scales, units=units)
    values["delays"] = problems.collect(lambda: checked_delays(delays, values["input_names"], values["output_names"]))
    problems.raise_if_any()
    return values


def _identity_like(a: Any) -> Any:
    """Return the identity of the size of A, sparse where A is."""
    if not is_sparse(a):
        return np.eye(a.shape[0])
    from scipy.sparse import eye_array

    return as_sparse_matrix(eye_array(a.shape[0], format="csr"), "E")


def _appended(
    matrices: Mapping[str, Any],
    labels: Mapping[str, Sequence[str] | None],
    given: dict[str, FloatArray | None],
    sensor_noise: Any,
    problems: Problems,
) -> dict[str, tuple[str, ...]]:
    """Append what is given by the names of sensors to ``given``; return the names of these signals by field."""
    if sensor_noise is None and not any(is_name_list(matrices[name]) for name in SENSOR_PICKS):
        return {}
    if matrices["C"] is not None and given.get("C") is None:
        return {}
    names = labels["output_names"]
    stated = picked_names(matrices["C"]) if names is None else names
    outputs = problems.collect(
        lambda: checked_names(stated, signal_counts(given)["y"], prefix="y", what="output_names")
    )
    problems.raise_if_any()
    picked = problems.collect(lambda: _with_sensor_picks(matrices, given, outputs)) or {}
    noises = problems.collect(lambda: _noise_of_sensors(sensor_noise, given, outputs)) or ()
    return {"fault_names": picked.get("Df", ()), "disturbance_names": picked.get("Dd", ()), "noise_names": noises}


def _size(given: Mapping[str, Any]) -> int:
    return int(given["A"].shape[0])


def _with_sensor_picks(
    asked: Mapping[str, Any], given: dict[str, FloatArray | None], outputs: Sequence[str]
) -> dict[str, tuple[str, ...]]:
    """Append a column to Df, Bf (Dd, Bd) in ``given`` for each sensor that Df (Dd) names; return these."""
    found = {}
    for name, beside in SENSOR_PICKS.items():
        picked = asked[name]
        if not is_name_list(picked):
            continue
        columns = rows_picking(picked, outputs, what=name).T
        own = given.get(beside)
        dynamics = np.zeros((_size(given), 0)) if own is None else dense(own)
        given[beside] = np.hstack([dynamics, np.zeros((len(dynamics), len(picked)))])
        given[name] = np.hstack([np.zeros((len(outputs), dynamics.shape[1])), columns])
        found[name] = tuple(picked)
    return found


def _noise_of_sensors(
    sensor_noise: Any, given: dict[str, FloatArray | None], outputs: Sequence[str]
) -> tuple[str, ...]:
    """Append a column to Bw, Dw in ``given`` for each sensor with a standard deviation; return their names."""
    if sensor_noise is None:
        return ()
    require_kind(sensor_noise, Mapping, "sensor_noise", "a standard deviation by output, such as {'speed': 0.01}")
    require_picked(sensor_noise, outputs, what="sensor_noise")
    columns = np.zeros((len(outputs), len(sensor_noise)))
    for column, (name, value) in enumerate(sensor_noise.items()):
        deviation = float(any_matrix(value, f"sensor_noise[{name!r}]")[0, 0])
        if deviation <= 0.0:
            raise SpecError(
                f"sensor_noise[{name!r}] is {deviation:g}: give a standard deviation above 0.", path="sensor_noise"
            )
        columns[list(outputs).index(name), column] = deviation
    others = [matrix for name in ("Bw", "Dw") if (matrix := given.get(name)) is not None and 0 not in matrix.shape]
    nw, nx = others[0].shape[1] if others else 0, _size(given)
    for name, rows, more in (("Bw", nx, np.zeros((nx, len(sensor_noise)))), ("Dw", len(outputs), columns)):
        matrix = given.get(name)
        matrix = np.zeros((rows, nw)) if matrix is None or 0 in matrix.shape else dense(matrix)
        if matrix.shape != (rows, nw):
            # Its own message is enough.
            return ()
        given[name] = np.hstack([matrix, more])
    return tuple(f"noise {name}" for name in sensor_noise)


def _in_stated_units(units: Any, **given: Any) -> list[Any]:
    """Return mappings from names of signals, with quantities in the units that are stated of these signals."""
    stated = units if isinstance(units, Mapping) else {}
    return [
        {name: in_unit(value, stated.get(name), f"{kind}[{name!r}]") for name, value in mapping.items()}
        if isinstance(mapping, Mapping)
        else mapping
        for kind, mapping in given.items()
    ]


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
        Seconds between samples; 0 for continuous time.
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
        asked = {"E": E, "A": A, "B": B, "C": C, "D": D, "Bf": Bf, "Df": Df, "Bd": Bd, "Dd": Dd, "Bw": Bw, "Dw": Dw}
        names = {
            "state_names": state_names,
            "input_names": input_names,
            "output_names": output_names,
            "fault_names": fault_names,
            "disturbance_names": disturbance_names,
            "noise_names": noise_names,
        }
        point, noise = _in_stated_units(units, operating_point=operating_point, sensor_noise=sensor_noise)
        values = plant_fields(
            asked,
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
            self.exact.require_of(self)

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
        found = {field.name: getattr(self, field.name) for field in fields(self)}
        if not self.delays:
            found.pop("delays")
        records = {name: found.pop(name) for name in ("uncertainty", "exact")}
        return found | {name: record.as_dict() for name, record in records.items() if record is not None}

    def replace(self, **changes: Any) -> DescriptorSystem:
        """Return a plant with some fields changed, checked again as a whole.

        Tolerances and exact numbers are those of the matrices as they were: with a change of one of these they are
        not carried over, and whatever would use tolerances refuses (``uncertainty=None`` says that the model is exact).
        Units and other labels of signals that are gone, such as those of ``disturbance_names=None``, go with them.

        Parameters
        ----------
        **changes
            Any argument of the constructor.
        """
        kept = {field.name: getattr(self, field.name) for field in fields(self) if field.name != "exact"}
        gone = {name for field in SIGNAL_NAMES if field in changes for name in getattr(self, field)}
        gone -= {name for field in SIGNAL_NAMES for name in (changes[field] or () if field in changes else kept[field])}
        for label in ("operating_point", "scales", "units", "delays"):
            kept[label] = {name: value for name, value in kept[label].items() if name not in gone}
        new = DescriptorSystem(**{**kept, **changes})
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

    def __repr__(self) -> str:
        time = f"dt={self.dt:g} s" if self.is_discrete else "continuous"
        return (
            f"DescriptorSystem(nx={self.nx}, nu={self.nu}, ny={self.ny}, nf={self.nf}, nd={self.nd}, "
            f"nw={self.nw}, {time}{f', delays: {delays_in_words(self.delays)}' if self.delays else ''})"
        )

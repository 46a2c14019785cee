"""Linear time-invariant descriptor systems with named signals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from obsynth.errors import SpecError
from obsynth.models.names import checked_names, is_name_list, rows_picking
from obsynth.numerics.arrays import FloatArray, as_matrix, read_only

MatrixOrNames = ArrayLike | Sequence[str] | None


@dataclass(frozen=True, eq=False, init=False)
class DescriptorSystem:
    r"""A linear descriptor system with faults, unknown inputs and noise.

    .. math::
        E x^+ = A x + B u + B_d d + B_f f + B_w w, \qquad
        y = C x + D u + D_d d + D_f f + D_w w

    where :math:`x^+` is :math:`\dot x` for ``dt == 0`` and :math:`x(k+1)` for ``dt > 0``.

    Parameters
    ----------
    E : array_like or None
        ``(nx, nx)``, may be singular; ``None`` means the identity.
    A : array_like
        ``(nx, nx)``.
    B : array_like, optional
        Known inputs ``(nx, nu)``.
    C : array_like or list of str, optional
        Outputs ``(ny, nx)``, or the names of the states that are measured.
    D : array_like, optional
        Feedthrough of the known inputs ``(ny, nu)``.
    Bf, Df : array_like, optional
        Faults ``(nx, nf)`` and ``(ny, nf)``.  ``Bf`` may be a list of state names: the fault is then
        added to the equation of the same number as that state.
    Bd, Dd : array_like, optional
        Unknown inputs (disturbances) ``(nx, nd)`` and ``(ny, nd)``; ``Bd`` by name as ``Bf``.
    Bw, Dw : array_like, optional
        Noise ``(nx, nw)`` and ``(ny, nw)``: ``w`` is white with unit covariance, so the columns hold
        standard deviations (per sample for ``dt > 0``, and always per sample in ``Dw``).
    dt : float, optional
        Seconds between samples; 0 for continuous time.
    state_names, input_names, output_names, fault_names, disturbance_names, noise_names : list of str, optional
        Signal names; ``x1, x2, ...`` and so on by default.
    operating_point : mapping, optional
        Value of named signals at the point where a linear model was taken, in the signal's unit.
    units : mapping, optional
        Unit of named signals, as text.

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
    units: Mapping[str, str]

    def __init__(
        self,
        E: ArrayLike | None,
        A: ArrayLike,
        B: ArrayLike | None = None,
        C: MatrixOrNames = None,
        *,
        D: ArrayLike | None = None,
        Bf: MatrixOrNames = None,
        Df: ArrayLike | None = None,
        Bd: MatrixOrNames = None,
        Dd: ArrayLike | None = None,
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
        units: Mapping[str, str] | None = None,
    ) -> None:
        problems = _Problems()
        a = problems.collect(lambda: as_matrix(A, "A"))
        if a is None or a.shape[0] == 0:
            problems.add("A is empty: a plant needs at least one state.")
            problems.raise_if_any()
        assert_square = problems.collect(lambda: _square(a, "A"))
        nx = a.shape[1] if assert_square is None else assert_square.shape[0]
        states = problems.collect(lambda: checked_names(state_names, nx, prefix="x", what="state_names"))
        known_states = states or tuple(f"x{i + 1}" for i in range(nx))
        if is_name_list(C) and output_names is None:
            output_names = tuple(C)  # type: ignore[arg-type]
        if is_name_list(Bf) and fault_names is None:
            fault_names = tuple(Bf)  # type: ignore[arg-type]
        if is_name_list(Bd) and disturbance_names is None:
            disturbance_names = tuple(Bd)  # type: ignore[arg-type]

        def matrix(value: Any, name: str) -> FloatArray | None:
            if value is None:
                return None
            if is_name_list(value):
                rows = problems.collect(lambda: rows_picking(value, known_states, what=name))
                return None if rows is None else (rows if name == "C" else rows.T)
            return problems.collect(lambda: as_matrix(value, name))

        given = {
            name: matrix(value, name)
            for name, value in {
                "E": np.eye(nx) if E is None else E, "B": B, "C": C, "D": D, "Bf": Bf, "Df": Df,
                "Bd": Bd, "Dd": Dd, "Bw": Bw, "Dw": Dw,
            }.items()
        }  # fmt: skip
        ny = 0 if given["C"] is None else given["C"].shape[0]
        sizes = {
            "u": _columns(given["B"], given["D"]), "f": _columns(given["Bf"], given["Df"]),
            "d": _columns(given["Bd"], given["Dd"]), "w": _columns(given["Bw"], given["Dw"]),
        }  # fmt: skip
        shapes = {"E": (nx, nx), "C": (ny, nx)}
        for name, rows, signal in _MATRIX_LAYOUT:
            shapes[name] = (nx if rows == "x" else ny, sizes[signal])
        values: dict[str, Any] = {"A": a}
        for name, shape in shapes.items():
            values[name] = problems.shaped(given[name], name, shape)
        values["dt"] = problems.collect(lambda: _checked_dt(dt))
        counts = {
            "input_names": (input_names, sizes["u"], "u"), "output_names": (output_names, ny, "y"),
            "fault_names": (fault_names, sizes["f"], "f"), "disturbance_names": (disturbance_names, sizes["d"], "d"),
            "noise_names": (noise_names, sizes["w"], "w"),
        }  # fmt: skip
        values["state_names"] = states
        for field, (names, count, prefix) in counts.items():
            values[field] = problems.collect(
                lambda n=names, c=count, p=prefix, f=field: checked_names(n, c, prefix=p, what=f)  # type: ignore[misc]
            )
        problems.raise_if_any()
        known = {name for field in ("state_names", *counts) for name in values[field]}
        values["operating_point"] = problems.collect(lambda: _checked_point(operating_point, known))
        values["units"] = problems.collect(lambda: _checked_units(units, known))
        problems.raise_if_any()
        for field, value in values.items():
            object.__setattr__(self, field, read_only(value) if isinstance(value, np.ndarray) else value)

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
    def is_discrete(self) -> bool:
        """Whether the plant is sampled (``dt > 0``)."""
        return self.dt > 0.0

    def as_dict(self) -> dict[str, Any]:
        """Return every field, as the constructor takes it."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def replace(self, **changes: Any) -> DescriptorSystem:
        """Return a plant with some fields changed, checked again as a whole.

        Parameters
        ----------
        **changes
            Any argument of the constructor.
        """
        return DescriptorSystem(**{**self.as_dict(), **changes})

    def __repr__(self) -> str:
        time = f"dt={self.dt:g} s" if self.is_discrete else "continuous"
        return (
            f"DescriptorSystem(nx={self.nx}, nu={self.nu}, ny={self.ny}, nf={self.nf}, nd={self.nd}, "
            f"nw={self.nw}, {time})"
        )


_MATRIX_LAYOUT = (
    ("B", "x", "u"), ("D", "y", "u"), ("Bf", "x", "f"), ("Df", "y", "f"),
    ("Bd", "x", "d"), ("Dd", "y", "d"), ("Bw", "x", "w"), ("Dw", "y", "w"),
)  # fmt: skip


class _Problems:
    """Collects every problem of one document, to raise them together."""

    def __init__(self) -> None:
        self.messages: list[str] = []
        self.first_path: str | None = None

    def add(self, message: str, path: str | None = None) -> None:
        self.messages.append(message)
        self.first_path = self.first_path or path

    def collect(self, make: Any) -> Any:
        try:
            return make()
        except SpecError as error:
            self.add(str(error), error.path)
            return None

    def shaped(self, value: FloatArray | None, name: str, shape: tuple[int, int]) -> FloatArray:
        if value is None:
            return np.zeros(shape)
        if value.size == 0 and 0 in shape:
            return np.zeros(shape)
        if value.shape != shape:
            self.add(f"{name} is {_by(value.shape)}, but {_by(shape)} is needed.", name)
        return value

    def raise_if_any(self) -> None:
        if len(self.messages) == 1:
            raise SpecError(self.messages[0], path=self.first_path)
        if self.messages:
            raise SpecError("The plant is not well formed:", path=self.first_path, problems=self.messages)


def _by(shape: tuple[int, ...]) -> str:
    return " by ".join(map(str, shape))


def _square(matrix: FloatArray, name: str) -> FloatArray:
    if matrix.shape[0] != matrix.shape[1]:
        raise SpecError(f"{name} is {_by(matrix.shape)}, but it must be square (nx by nx).", path=name)
    return matrix


def _columns(*matrices: FloatArray | None) -> int:
    return next((m.shape[1] for m in matrices if m is not None and m.size), 0)


def _checked_dt(dt: Any) -> float:
    if isinstance(dt, bool) or not isinstance(dt, (int, float, np.integer, np.floating)):
        raise SpecError(f"dt is {dt!r}: give the sampling time in seconds, or 0 for continuous time.", path="dt")
    if not np.isfinite(dt) or dt < 0:
        raise SpecError(f"dt is {dt}: give a sampling time >= 0 in seconds (0 for continuous time).", path="dt")
    return float(dt)


def _checked_point(point: Mapping[str, float] | None, known: set[str]) -> dict[str, float]:
    checked: dict[str, float] = {}
    for name, value in (point or {}).items():
        if name not in known:
            raise SpecError(f"operating_point names {name!r}, which is no signal of the plant.", path="operating_point")
        checked[name] = float(as_matrix(value, f"operating_point[{name!r}]")[0, 0])
    return checked


def _checked_units(units: Mapping[str, str] | None, known: set[str]) -> dict[str, str]:
    for name, value in (units or {}).items():
        if name not in known:
            raise SpecError(f"units names {name!r}, which is no signal of the plant.", path="units")
        if not isinstance(value, str):
            raise SpecError(f"The unit of {name!r} must be a text.", path="units")
    return dict(units or {})

"""Linear time-varying descriptor systems with unknown parameters, in discrete time."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeAlias

from numpy.typing import ArrayLike

from obsynth.errors import SpecError
from obsynth.numerics.arguments import arguments_checked
from obsynth.plants.checking import Problems, checked_labels
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.other_names import plant_keywords_suggested
from obsynth.plants.sequences import (
    LAYOUT,
    MatrixSequence,
    check_every_k,
    checked_constants,
    checked_horizon,
    completed,
    positive_dt,
)
from obsynth.plants.signal_names import checked_names

#: A matrix, a stack of matrices, a function of k, or rows whose entries may be texts.
MatrixLike: TypeAlias = ArrayLike | Callable[[int], ArrayLike] | Sequence[Sequence[float | str]] | None


@dataclass(frozen=True, eq=False, init=False)
class TimeVaryingDescriptorSystem:
    r"""A time-varying descriptor system with constant or slowly changing parameters.

    .. math::
        E_{k+1} x(k+1) = A_k x(k) + B_k u(k) + \Phi_k \theta + \mu(k), \qquad
        y(k+1) = C_{k+1} x(k+1) + D_{k+1} u(k+1) + \Psi_k \theta
        + \nu(k)

    Each matrix is a constant, a stack (a three-dimensional array, one matrix per k), a callable from k to a matrix
    (``E(k)`` is :math:`E_k`), or rows of numbers and expressions in ``k`` such as ``"k / (k + 1)"``.

    Parameters
    ----------
    E : MatrixLike or None
        ``(ne, nx)``, may be singular or rectangular; ``None`` means the identity.  Needed at k = 1 ... N.
    A : MatrixLike
        ``(ne, nx)``.  Needed at k = 0 ... N - 1, as B, Phi and Psi.
    B : MatrixLike, optional
        Known inputs ``(ne, nu)``.
    C : MatrixLike
        Outputs ``(ny, nx)``.  Needed at k = 1 ... N.
    D : MatrixLike, optional
        Known inputs in the outputs ``(ny, nu)``.  Needed at k = 1 ... N.
    Phi, Psi : MatrixLike, optional
        Parameters in the equations ``(ne, nq)`` and in the outputs ``(ny, nq)``.
    dt : float
        Seconds between samples, positive.
    horizon : int, optional
        Number of steps N the model is good for: k = 0 ... N.  Taken from the stacks where there are some; without
        stacks ``None`` means for ever.
    constants : mapping, optional
        Names and values that expressions may use besides ``k``.
    state_names, input_names, output_names, parameter_names : list of str, optional
        Signal names; ``x1, x2, ...``, ``u1``, ``y1`` and ``theta1`` by default.
    operating_point : mapping, optional
        Value of named signals at the point of which the signals are deviations, in the signal's unit.
    scales : mapping, optional
        Factor of named inputs and outputs: what a log holds, times the factor, is in the signal's unit.
    units : mapping, optional
        Unit of named signals, as text.

    Raises
    ------
    SpecError
        A matrix has the wrong shape or one that changes with k, holds something that is no finite number (k is
        named), stacks have different lengths, or names are wrong; as many problems as can be found at once.

    Examples
    --------
    >>> plant = TimeVaryingDescriptorSystem(
    ...     E=[[0, 0], [-1, "(k - 1) / k"]], A=[[1, "-(k + 1) / (k + 0.5)"], [0, "1 / (k + 1)"]],
    ...     C=[[1, 0], [0, 1]], Phi=[[1], [1]], dt=1.0, horizon=100,
    ... )
    >>> plant.nx, plant.ny, plant.nq, plant.E.at(2).tolist()
    (2, 2, 1, [[0.0, 0.0], [-1.0, 0.5]])
    """

    E: MatrixSequence
    A: MatrixSequence
    B: MatrixSequence
    C: MatrixSequence
    Phi: MatrixSequence
    Psi: MatrixSequence
    D: MatrixSequence
    dt: float
    horizon: int | None
    constants: Mapping[str, float]
    state_names: tuple[str, ...]
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]
    parameter_names: tuple[str, ...]
    operating_point: Mapping[str, float]
    scales: Mapping[str, float]
    units: Mapping[str, str]

    @plant_keywords_suggested
    def __init__(
        self,
        E: MatrixLike,
        A: MatrixLike,
        B: MatrixLike = None,
        C: MatrixLike = None,
        *,
        Phi: MatrixLike = None,
        Psi: MatrixLike = None,
        D: MatrixLike = None,
        dt: float,
        horizon: int | None = None,
        constants: Mapping[str, float] | None = None,
        state_names: Sequence[str] | None = None,
        input_names: Sequence[str] | None = None,
        output_names: Sequence[str] | None = None,
        parameter_names: Sequence[str] | None = None,
        operating_point: Mapping[str, float] | None = None,
        scales: Mapping[str, float] | None = None,
        units: Mapping[str, str] | None = None,
    ) -> None:
        problems = Problems()
        known = problems.collect(lambda: checked_constants(constants))
        problems.raise_if_any()
        matrices = {"E": E, "A": A, "B": B, "C": C, "Phi": Phi, "Psi": Psi, "D": D}
        sequences: dict[str, MatrixSequence | None] = {}
        for name, _, _, first in LAYOUT:
            if matrices[name] is not None:
                make = partial(MatrixSequence.of, matrices[name], name, first=first, constants=known)
                sequences[name] = problems.collect(make)
            elif name in ("A", "C"):
                problems.note(f"{name} is missing: a plant needs A and C.", name)
        problems.raise_if_any()
        values = completed(sequences, problems)
        problems.raise_if_any()
        sizes = {
            "x": values["A"].shape[1],
            "u": values["B"].shape[1],
            "y": values["C"].shape[0],
            "theta": values["Phi"].shape[1],
        }
        fields: dict[str, Any] = dict(values)
        fields |= {"dt": problems.collect(lambda: positive_dt(dt)), "constants": known}
        fields["horizon"] = problems.collect(lambda: checked_horizon(horizon, values))
        named = {
            "state_names": (state_names, "x"),
            "input_names": (input_names, "u"),
            "output_names": (output_names, "y"),
            "parameter_names": (parameter_names, "theta"),
        }
        for item, (names, signal) in named.items():
            fields[item] = problems.collect(partial(checked_names, names, sizes[signal], prefix=signal, what=item))
        problems.raise_if_any()
        signals = {name for field in named for name in fields[field]}
        measured = {*fields["input_names"], *fields["output_names"]}
        fields |= checked_labels(
            problems, signals, measured, operating_point=operating_point, scales=scales, units=units
        )
        problems.collect(lambda: check_every_k(values, fields["horizon"]))
        problems.raise_if_any()
        for item, value in fields.items():
            object.__setattr__(self, item, value)

    @classmethod
    @arguments_checked
    def from_descriptor(cls, plant: DescriptorSystem) -> TimeVaryingDescriptorSystem:
        """Return a time-invariant plant as a time-varying one: its faults become parameters, its noise is left out.

        Parameters
        ----------
        plant : DescriptorSystem
            Discrete time, without disturbances.

        Raises
        ------
        SpecError
            It is continuous in time or has disturbances.
        """
        if not plant.is_discrete:
            raise SpecError(
                "The plant is continuous in time: sample it first (transform: {sample_time: ...} in "
                "a spec, obsynth.discretise in Python).",
                path="dt",
            )
        if plant.nd:
            raise SpecError(
                "The plant has unknown disturbances, which this method does not cover: remove Bd and Dd, or make them "
                "faults.",
                path="Bd",
            )
        signals = {*plant.state_names, *plant.input_names, *plant.output_names, *plant.fault_names}
        return cls(
            plant.E,
            plant.A,
            plant.B,
            plant.C,
            Phi=plant.Bf,
            Psi=plant.Df,
            D=plant.D,
            dt=plant.dt,
            state_names=plant.state_names,
            input_names=plant.input_names,
            output_names=plant.output_names,
            parameter_names=plant.fault_names,
            operating_point={name: value for name, value in plant.operating_point.items() if name in signals},
            scales=plant.scales,
            units={name: unit for name, unit in plant.units.items() if name in signals},
        )

    @property
    def nx(self) -> int:
        """Number of states."""
        return self.A.shape[1]

    @property
    def ne(self) -> int:
        """Number of equations."""
        return self.A.shape[0]

    @property
    def nu(self) -> int:
        """Number of known inputs."""
        return self.B.shape[1]

    @property
    def ny(self) -> int:
        """Number of outputs."""
        return self.C.shape[0]

    @property
    def nq(self) -> int:
        """Number of parameters."""
        return self.Phi.shape[1]

    @property
    def matrices(self) -> dict[str, MatrixSequence]:
        """The matrices by name."""
        return {name: getattr(self, name) for name, *_ in LAYOUT}

    @property
    def is_time_invariant(self) -> bool:
        """Whether every matrix is the same for every k, as far as what is given tells: no stack, no function, no k."""
        return all(matrix.is_constant for matrix in self.matrices.values())

    def as_dict(self) -> dict[str, Any]:
        """Return every field as data, as the constructor takes it.

        Raises
        ------
        SpecError
            A matrix is a callable.
        """
        return {**{name: matrix.as_data() for name, matrix in self.matrices.items()}, **self._labels()}

    def replace(self, **changes: Any) -> TimeVaryingDescriptorSystem:
        """Return a plant with some fields changed, checked again as a whole.

        Parameters
        ----------
        **changes
            Any argument of the constructor.
        """
        matrices = self.matrices
        if self.D.is_constant and not self.D.at(1).any():
            del matrices["D"]  # none, whatever the number of inputs and outputs is then
        return TimeVaryingDescriptorSystem(**{**matrices, **self._labels(), **changes})

    def _labels(self) -> dict[str, Any]:
        names = ("state_names", "input_names", "output_names", "parameter_names")
        labels = {name: list(getattr(self, name)) for name in names}
        return {
            **labels,
            "dt": self.dt,
            "horizon": self.horizon,
            "constants": self.constants,
            "operating_point": self.operating_point,
            "scales": self.scales,
            "units": self.units,
        }

    def __repr__(self) -> str:
        steps = "no horizon" if self.horizon is None else f"{self.horizon} steps"
        return (
            f"TimeVaryingDescriptorSystem(ne={self.ne}, nx={self.nx}, nu={self.nu}, ny={self.ny}, nq={self.nq}, "
            f"dt={self.dt:g} s, {steps})"
        )

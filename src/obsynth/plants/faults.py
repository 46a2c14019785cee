"""Fault models: an exosystem ``w+ = Phi w, f = Cw w`` for each fault, stacked block-diagonally.

Share Pasand, Aliyari, Taghirad, (2), (5), (6), where the row of (6) would add faults up.  ``f = Cw w``, not
``f' = Phi f``; the states of a polynomial are f, f', f'', ..., initial values ``i! f_i``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy

from obsynth.errors import SpecError
from obsynth.numerics.arguments import is_finite_number, is_whole
from obsynth.numerics.arrays import ComplexArray, FloatArray, as_matrix, largest_singular_value, read_only
from obsynth.numerics.logarithmic_balance import LogBalance
from obsynth.numerics.ranks import decide_rank
from obsynth.numerics.suggestions import fields_suggested, keywords_suggested
from obsynth.plants.signal_names import index_of

#: Distance, relative to the norm of a given matrix, below which computed eigenvalues count as one multiple eigenvalue:
#: a triple one scatters by the cube root of the unit roundoff.
MULTIPLE_EIGENVALUE = 1e-4

#: The same for built-in models, whose matrices are triangular or diagonalisable: only rounding separates copies.
SAME_EIGENVALUE = 1e-9

#: Words for polynomials, and their orders.
POLYNOMIAL_WORDS = {"step": 0, "ramp": 1, "parabola": 2}

#: Keys of a model given as data; the last two come together.
MODEL_KEYS = ("polynomial", "sinusoid", "exponential", "sum", "Phi", "Cw")

#: A polynomial of higher order has no meaning in data of double precision.
HIGHEST_ORDER = 60


def stated_eigenvalues(phi: FloatArray) -> ComplexArray:
    """Return the distinct eigenvalues of a stacked transition ``(nw, nw)``, block by block where it falls apart."""
    if not (phi - np.diag(np.diag(phi))).any():
        # Blocks of one, such as steps: in order, each value once.
        return np.array(list(dict.fromkeys(np.diag(phi).tolist())), dtype=np.complex128)
    count, parts = (
        scipy.sparse.csgraph.connected_components(phi != 0.0, directed=False) if len(phi) else (0, np.zeros(0))
    )
    values: list[complex] = []
    for part in range(count):
        block = phi[np.ix_(parts == part, parts == part)]
        triangular = not np.any(np.tril(block, -1))
        of_block = np.unique(np.diag(block)) if triangular else distinct_eigenvalues(block, MULTIPLE_EIGENVALUE)
        values += [complex(value) for value in of_block if complex(value) not in values]
    return np.array(values, dtype=np.complex128)


def distinct_eigenvalues(matrix: FloatArray, tolerance: float) -> ComplexArray:
    """Return each eigenvalue once; those within ``tolerance`` times the balanced norm count as one, at their mean."""
    balanced = balanced_transition(matrix)[0]
    reach = tolerance * largest_singular_value(balanced)
    distinct: list[complex] = []
    waiting = [complex(value) for value in np.linalg.eigvals(balanced)]
    while waiting:
        near = [value for value in waiting if abs(value - waiting[0]) <= reach]
        waiting = [value for value in waiting if abs(value - waiting[0]) > reach]
        mean = sum(near) / len(near)
        # A cluster that scatters around the real axis is a real eigenvalue.
        distinct.append(complex(mean.real, 0.0) if abs(mean.imag) <= reach else mean)
    return np.array(distinct, dtype=np.complex128)


def balanced_transition(matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return a transition ``(n, n)`` with its states (f, f', ...) in powers of two as units, and these ``(n,)``."""
    n = len(matrix)
    problem = LogBalance(n + 1)
    # The unit of time is free: only the states are scaled.
    problem.add(matrix, range(n), range(n), signs=(-1, 1), common=n)
    states = np.exp2(np.round(problem.solve()[:n]))
    return np.asarray(matrix * states / states[:, None]), states


@fields_suggested
@dataclass(frozen=True, eq=False)
class FaultModel:
    """The model ``xi' = Phi xi, f = Cw xi`` of one fault f; `obsynth.fault_model` makes those with names.

    Parameters
    ----------
    Phi : FloatArray
        ``(n, n)``, in continuous time (1/s), or with ``sampled`` the transition over one sample of the plant.
    Cw : FloatArray
        ``(1, n)``.
    description : str
        In words.
    sampled : bool
        Whether ``Phi`` is the transition over one sample.

    Raises
    ------
    SpecError
        ``Phi`` or ``Cw`` is no matrix of finite numbers.

    Examples
    --------
    >>> import obsynth
    >>> ramp = obsynth.FaultModel(Phi=[[0, 1], [0, 0]], Cw=[[1, 0]], description="ramp")
    >>> ramp.order, ramp.transition(0.5).tolist()
    (2, [[1.0, 0.5], [0.0, 1.0]])
    """

    Phi: FloatArray
    Cw: FloatArray
    description: str
    sampled: bool = False

    def __post_init__(self) -> None:
        """Make the arrays private and read-only."""
        for name in ("Phi", "Cw"):
            object.__setattr__(self, name, as_matrix(getattr(self, name), name))

    @property
    def order(self) -> int:
        """Number of states."""
        return int(self.Phi.shape[0])

    def transition(self, dt: float) -> FloatArray:
        """Return ``Phi`` in the time of a plant.

        Parameters
        ----------
        dt : float, seconds
            Between samples of the plant; 0 for continuous time.
        """
        if dt == 0.0 or self.sampled:
            return self.Phi
        return np.asarray(scipy.linalg.expm(self.Phi * dt))

    def eigenvalues(self, dt: float) -> ComplexArray:
        """Return each eigenvalue of `transition` once; a multiple one, which rounding scatters, as a mean.

        Parameters
        ----------
        dt : float, seconds
            As for `transition`.
        """
        return distinct_eigenvalues(self.transition(dt), MULTIPLE_EIGENVALUE if self.sampled else SAME_EIGENVALUE)


def polynomial(order: int) -> FaultModel:
    """Return the model of a polynomial in time: order 0 is a step, 1 a ramp."""
    if not is_whole(order) or not 0 <= order <= HIGHEST_ORDER:
        raise _refused(
            f"A polynomial fault model has order {order!r}: give a whole number from 0 (step) to {HIGHEST_ORDER}."
        )
    words = [*POLYNOMIAL_WORDS, f"polynomial of order {order}"]
    return FaultModel(np.eye(order + 1, k=1), np.eye(1, order + 1), words[min(order, len(POLYNOMIAL_WORDS))])


def sinusoid(frequency: float) -> FaultModel:
    """Return the model of a sinusoid of known frequency, unknown amplitude and phase."""
    value = _number(frequency, "sinusoid")
    if value <= 0.0:
        raise _refused(f"The sinusoid has frequency {value}: give a positive number in rad/s.")
    return FaultModel(np.array([[0.0, value], [-value, 0.0]]), np.eye(1, 2), f"sinusoid of {value:g} rad/s")


def exponential(rate: float) -> FaultModel:
    """Return the model of ``exp(rate t)``; a negative rate decays."""
    value = _number(rate, "exponential")
    return FaultModel(np.array([[value]]), np.eye(1), f"exponential of rate {value:g} 1/s")


def from_matrices(Phi: Any, Cw: Any) -> FaultModel:
    """Return the model of ``Phi (n, n)``, ``Cw (1, n)`` in the time of the plant: ``w' = Phi w``, or ``w(k+1)``."""
    transition, row = as_matrix(Phi, "Phi"), as_matrix(Cw, "Cw")
    count = transition.shape[0]
    if transition.shape != (count, count) or count == 0 or row.shape != (1, count):
        raise _refused(
            f"A fault model has Phi {transition.shape} and Cw {row.shape}: Phi must be square and Cw one "
            "row of the same length."
        )
    return _observable(FaultModel(transition, row, f"given exosystem of order {count}", sampled=True))


def summed(models: Sequence[FaultModel]) -> FaultModel:
    """Return the model of a fault that is the sum of several signals, such as a step and a sinusoid."""
    if not models or len({model.sampled for model in models}) > 1:
        raise _refused(
            "A sum of fault models needs at least one part, and either built-in parts or given matrices, not both."
        )
    description = " plus ".join(model.description for model in models)
    phi, row = scipy.linalg.block_diag(*(model.Phi for model in models)), np.hstack([model.Cw for model in models])
    return _observable(FaultModel(phi, row, description, models[0].sampled))


@keywords_suggested
def fault_model(data: Any) -> FaultModel:
    """Return a model from data: a word, a mapping such as ``{sinusoid: 1.5}``, or a model itself.

    Parameters
    ----------
    data : str, mapping or FaultModel
        ``step``, ``ramp``, ``parabola``; ``{polynomial: order}``, ``{sinusoid: rad/s}``, ``{exponential: 1/s}``,
        ``{Phi: ..., Cw: ...}``, or ``{sum: [...]}`` of such.

    Returns
    -------
    FaultModel
        The exosystem of one fault.

    Raises
    ------
    SpecError
        There is no such model.

    Examples
    --------
    >>> import obsynth
    >>> ramp = obsynth.fault_model("ramp")
    >>> ramp.Phi.tolist(), ramp.Cw.tolist()
    ([[0.0, 1.0], [0.0, 0.0]], [[1.0, 0.0]])
    """
    if isinstance(data, FaultModel):
        return data
    if isinstance(data, str) and data in POLYNOMIAL_WORDS:
        return polynomial(POLYNOMIAL_WORDS[data])
    if isinstance(data, Mapping) and set(data) == {"Phi", "Cw"}:
        return from_matrices(data["Phi"], data["Cw"])
    if isinstance(data, Mapping) and len(data) == 1:
        ((key, value),) = data.items()
        makers = {"polynomial": polynomial, "sinusoid": sinusoid, "exponential": exponential}
        if key in makers:
            return makers[key](value)
        if key == "sum" and isinstance(value, Sequence) and not isinstance(value, str):
            return summed([fault_model(part) for part in value])
    raise _refused(
        f"There is no fault model {data!r}: use {', '.join(POLYNOMIAL_WORDS)}, or one of {{polynomial: "
        "order}, {sinusoid: rad/s}, {exponential: 1/s}, {Phi: ..., Cw: ...}, {sum: [...]}."
    )


def _observable(model: FaultModel) -> FaultModel:
    balanced, states = balanced_transition(model.Phi)
    output = model.Cw * states
    size = largest_singular_value(balanced) / (float(np.linalg.norm(output)) or 1.0)
    for value in model.eigenvalues(0.0):
        tested = np.vstack([balanced - value * np.eye(model.order), (size or 1.0) * output.astype(complex)])
        if not decide_rank(tested, expected=model.order, equilibrated=False).full:
            raise _refused(
                f"Some state of the fault model ({model.description}) is unobservable in the fault, at the "
                f"eigenvalue {value:.6g}: leave it out."
            )
    return model


def _number(value: Any, what: str) -> float:
    if not is_finite_number(value):
        raise _refused(f"The {what} model needs a finite number, not {value!r}.")
    return float(value)


def _refused(text: str) -> SpecError:
    return SpecError(text, path="fault_model")


@dataclass(frozen=True, eq=False)
class Exosystem:
    """The exosystems of all faults, stacked: ``Phi (nw, nw)``, block-diagonal, in the plant's time, ``Cw (nf, nw)``."""

    Phi: FloatArray
    Cw: FloatArray
    names: tuple[str, ...]
    eigenvalues: ComplexArray
    descriptions: tuple[str, ...]

    @property
    def order(self) -> int:
        """Number of states."""
        return int(self.Phi.shape[0])


def exosystem(data: Any, fault_names: Sequence[str], dt: float) -> Exosystem:
    """Return the exosystem of all faults."""
    models = _by_fault(data, fault_names)
    _require_below_nyquist(fault_names, models, dt)
    count = sum(model.order for model in models)
    phi, cw = np.zeros((count, count)), np.zeros((len(models), count))
    starts = np.cumsum([0, *(model.order for model in models)])
    for row, model in enumerate(models):
        place = slice(starts[row], starts[row + 1])
        phi[place, place], cw[row, place] = model.transition(dt), model.Cw[0]
    each = zip(fault_names, models, strict=True)
    names = tuple(f"{name} model {i + 1}" for name, model in each for i in range(model.order))
    values = list(dict.fromkeys(value for model in models for value in model.eigenvalues(dt).tolist()))
    descriptions = tuple(model.description for model in models)
    return Exosystem(read_only(phi), read_only(cw), names, np.array(values, dtype=np.complex128), descriptions)


def _require_below_nyquist(names: Sequence[str], models: Sequence[FaultModel], dt: float) -> None:
    """Raise for a course in continuous time that samples cannot distinguish from a slower one."""
    if dt == 0.0:
        return
    problems = []
    for name, model in zip(names, models, strict=True):
        fastest = 0.0 if model.sampled else float(np.max(np.abs(model.eigenvalues(0.0).imag), initial=0.0))
        if fastest * dt >= np.pi:
            problems.append(
                f"the model of {name!r} ({model.description}) oscillates with {fastest:.6g} rad/s, but samples every "
                f"{dt:g} s represent only frequencies below {np.pi / dt:.6g} rad/s (Nyquist): sample faster, or give "
                "the frequency of the samples."
            )
    if problems:
        raise SpecError("fault_model:", path="fault_model", problems=problems)


def _by_fault(data: Any, fault_names: Sequence[str]) -> list[FaultModel]:
    if not isinstance(data, Mapping) or set(data) & set(MODEL_KEYS) - set(fault_names):
        model = fault_model(data)
        return [model for _ in fault_names]
    for name in data:
        index_of(name, fault_names, what="fault_model")
    missing = [name for name in fault_names if name not in data]
    if missing:
        raise _refused(
            f"fault_model has no entry for {', '.join(map(repr, missing))}: give a model for each fault, "
            "or one for all."
        )
    return [fault_model(data[name]) for name in fault_names]

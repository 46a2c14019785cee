"""Plants from objects of other libraries: systems of python-control and scipy, matrices of sympy, frames of pandas."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from decimal import Decimal
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from obsynth.errors import SpecError
from obsynth.numerics.arguments import arguments_checked, is_finite_number, require_kind
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.libraries import imported
from obsynth.numerics.suggestions import suggestion
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.given_matrices import ALL_MATRICES, SIGNAL_NAMES
from obsynth.plants.importing.roles import plant_of
from obsynth.plants.importing.transfer_functions import realised

#: What goes in and what comes out, by the names that CasADi's integrators have; y is ours.
INTEGRATOR_INPUTS, OUTPUTS = ("x", "z", "u", "p"), ("ode", "alg", "y")

#: What an object of python-control has beside matrices and labels, without meaning for them.
_PARTS_OF_CONTROL = frozenset(
    (
        *(
            "A",
            "B",
            "C",
            "D",
            "dt",
            "name",
            "ninputs",
            "noutputs",
            "nstates",
            "updfcn",
            "outfcn",
            "params",
            "num",
            "den",
        ),
        *("input_index", "output_index", "state_index", "input_labels", "output_labels", "state_labels"),
        *("num_array", "den_array", "display_format", "repr_format", "syslist", "syslist_index", "state_offset"),
        *("input_offset", "output_offset", "connect_map", "input_map", "output_map", "connection_type"),
        *("remove_useless_states", "warn_duplicate", "states", "inputs", "outputs"),
    )
)


@arguments_checked
def from_control(
    system: Any,
    *,
    E: ArrayLike | None = None,
    dt: float | None = None,
    **plant: Any,
) -> DescriptorSystem:
    """Return the plant of a system of python-control, with its labels.

    Parameters
    ----------
    system : control.StateSpace or control.TransferFunction
        A transfer function is realised by ``control.ss``; one with more zeros than poles (continuous time) by a
        descriptor system, whose polynomial part are derivatives of the inputs in algebraic equations.
    E : array_like, optional
        ``(nx, nx)``: python-control has none; ``None`` means the identity.
    dt : float, optional, seconds
        Sampling time; needed where the system's own is ``True``, which only says that there is one.  A system whose
        ``dt`` is ``None`` is continuous.
    **plant
        Roles, as lists of names: ``faults`` and ``disturbances`` (inputs that are faults, or unknown; the others are
        known inputs), ``actuator_faults`` (known inputs on which a fault acts: adds ``fault of <input>``) and
        ``sensor_faults`` (outputs with a bias: adds ``bias of <output>``).  Any other argument of `DescriptorSystem`,
        such as ``sensor_noise``, ``Bd`` or ``operating_point``.

    Returns
    -------
    DescriptorSystem
        With ``state_labels``, ``input_labels`` and ``output_labels`` as names.

    Raises
    ------
    SpecError
        It is no linear system, python-control is not installed, a name is unknown, the sampling time is missing, or
        somebody gave the object an attribute (``InputDelay``, ``units``) that python-control does not know.

    Examples
    --------
    >>> import obsynth
    >>> import control
    >>> obsynth.from_control(control.ss([[-1.0]], [[1.0]], [[1.0]], [[0.0]])).A.tolist()
    [[-1.0]]
    """
    control = imported("control", extra=None)
    if type(system).__module__.startswith("scipy."):
        raise SpecError(
            f"system is a {type(system).__name__} of scipy: from_scipy reads it, and from_control those of control.",
            path="system",
        )
    if isinstance(system, control.NonlinearIOSystem) and not isinstance(system, control.StateSpace):
        raise SpecError(
            f"system is a {type(system).__name__}, which is not linear: give control.linearize(system, x0, u0) at an "
            "equilibrium, and its values as operating_point={...}; its equations as they are go into a DAEModel.",
            path="system",
        )
    require_kind(
        system,
        (control.StateSpace, control.TransferFunction),
        "system",
        "a control.StateSpace, such as control.ss(...)",
    )
    _require_understood(system)
    if isinstance(system, control.TransferFunction):
        system, chain = realised(system, control)
        if chain is not None:
            if E is not None:
                raise SpecError("E is for systems of states: a transfer function has its own.", path="E")
            return plant_of(
                chain,
                plant,
                labels={"input_names": system.input_labels, "output_names": system.output_labels},
                dt=_sampling_time(system.dt, dt),
            )
    labels = {
        "state_names": system.state_labels,
        "input_names": system.input_labels,
        "output_names": system.output_labels,
    }
    return plant_of(
        {"E": E, "A": system.A, "B": system.B, "C": system.C, "D": system.D},
        plant,
        labels=labels,
        dt=_sampling_time(system.dt, dt),
    )


@arguments_checked
def from_scipy(
    system: Any,
    *,
    E: ArrayLike | None = None,
    input_names: Sequence[str] | None = None,
    output_names: Sequence[str] | None = None,
    **plant: Any,
) -> DescriptorSystem:
    """Return the plant of a linear system of ``scipy.signal``.

    Parameters
    ----------
    system : scipy.signal.lti or scipy.signal.dlti
        A ``StateSpace``, or what ``to_ss`` makes into one; a transfer function with more zeros than poles as
        `from_control` takes it.
    E : array_like, optional
        ``(nx, nx)``: scipy has none; ``None`` means the identity.
    input_names, output_names : list of str, optional
        Of all inputs and outputs of the system; ``u1, u2, ...`` and ``y1, y2, ...`` by default.
    **plant
        Roles, as lists of names: ``faults`` and ``disturbances`` (inputs that are faults, or unknown; the others are
        known inputs), ``actuator_faults`` (known inputs on which a fault acts: adds ``fault of <input>``) and
        ``sensor_faults`` (outputs with a bias: adds ``bias of <output>``).  Any other argument of `DescriptorSystem`,
        such as ``state_names``.

    Returns
    -------
    DescriptorSystem
        Continuous, or with the ``dt`` of the system.

    Raises
    ------
    SpecError
        It is no linear system of scipy, a name is unknown, a discrete system does not say its ``dt``, or a continuous
        one is given a ``dt``.

    Examples
    --------
    >>> import obsynth
    >>> from scipy.signal import StateSpace
    >>> obsynth.from_scipy(StateSpace([[-1.0]], [[1.0]], [[1.0]], [[0.0]])).A.tolist()
    [[-1.0]]
    """
    signal = imported("scipy.signal", extra=None)
    if type(system).__module__.startswith("control."):
        raise SpecError(
            f"system is a {type(system).__name__} of python-control: from_control reads it, and from_scipy those of "
            "scipy.signal.",
            path="system",
        )
    require_kind(system, (signal.lti, signal.dlti), "system", "a scipy.signal.StateSpace")
    if isinstance(system, signal.lti) and plant.get("dt"):
        raise SpecError(
            f"dt is {plant['dt']}, but the system is continuous: leave dt out, and sample it by obsynth.discretise.",
            path="dt",
        )
    if _is_improper(system, signal):
        if E is not None:
            raise SpecError("E is for systems of states: a transfer function has its own.", path="E")
        function = system.to_tf()
        labels = {"inputs": input_names, "outputs": output_names}
        dt = _sampling_time(function.dt, plant.pop("dt", None))
        # Numbers of scipy are arrays of one row for each output.
        rows = [[list(row)] for row in np.atleast_2d(function.num)]
        bottoms = [[list(function.den)] for _ in rows]
        ours = {name: names for name, names in labels.items() if names is not None}
        return from_control(imported("control", extra=None).TransferFunction(rows, bottoms, dt, **ours), **plant)
    state_space = system.to_ss()
    return plant_of(
        {"E": E, **{name: np.asarray(getattr(state_space, name)) for name in "ABCD"}},
        plant,
        labels={"input_names": input_names, "output_names": output_names},
        dt=_sampling_time(state_space.dt, plant.pop("dt", None)),
    )


def _require_understood(system: Any) -> None:
    """Refuse, by name, attributes that are not python-control's: they may change what the matrices mean."""
    unknown = [
        name
        for name, value in getattr(system, "__dict__", {}).items()
        if not name.startswith("_") and name not in _PARTS_OF_CONTROL and value is not None and np.size(value)
    ]
    if unknown:
        raise SpecError(
            f"system has the attribute {unknown[0]!r}, which python-control does not know and is not read: give "
            "delays, units and an operating point as arguments of from_control, and delete it.",
            path="system",
        )


def _is_improper(system: Any, signal: Any) -> bool:
    """Whether a system of scipy has more zeros than poles, which ``to_ss`` does not take."""
    if isinstance(system, signal.ZerosPolesGain):
        return np.size(system.zeros) > np.size(system.poles)
    if not isinstance(system, signal.TransferFunction):
        return False
    rows = [np.trim_zeros(np.asarray(row), "f") for row in np.atleast_2d(system.num)]
    return any(len(row) > len(np.trim_zeros(np.atleast_1d(system.den), "f")) for row in rows)


def _sampling_time(own: Any, dt: float | None) -> float:
    """Return the sampling time: ``None`` is continuous, ``True`` unsaid; two that differ are refused."""
    if own is True and dt is None:
        raise SpecError("The system is sampled, but has no sampling time: give dt in seconds.", path="dt")
    if own is True and dt == 0.0:
        raise SpecError("The system is sampled, and dt = 0 is continuous time: give dt in seconds, above 0.", path="dt")
    if own is None or own is True:
        return 0.0 if dt is None else dt
    if dt is not None and dt != own:
        raise SpecError(f"dt is {dt}, but the system has dt = {own}: leave dt out.", path="dt")
    return float(own)


@arguments_checked
def from_sympy(
    A: Any, B: Any = None, C: Any = None, *, parameters: Mapping[Any, float] | None = None, **plant: Any
) -> DescriptorSystem:
    """Return the plant of matrices of sympy, whose symbols are parameters with values.

    Parameters
    ----------
    A : sympy.Matrix
        ``(nx, nx)``.
    B, C : sympy.Matrix, optional
        ``(nx, nu)``, ``(ny, nx)``.
    parameters : mapping, optional
        Value of each symbol, by the symbol or by its name; of functions of time (``dynamicsymbols``) the value at the
        point of the linear model, as ``{theta: 0, theta.diff(): 0}``.
    **plant
        Any other argument of `DescriptorSystem`: matrices (``E``, ``Bf``, ``Bd``, ``D``, ...) may be of sympy too, and
        names may be symbols.

    Returns
    -------
    DescriptorSystem
        With the numbers that the parameters give: rational entries exactly, and rounded once.

    Raises
    ------
    SpecError
        A symbol has no value, a value has no symbol, an entry is no real number, or sympy is not installed.

    Examples
    --------
    >>> import obsynth
    >>> import sympy
    >>> m = sympy.Symbol("m")
    >>> obsynth.from_sympy(sympy.Matrix([[-1 / m]]), C=sympy.Matrix([[1]]), parameters={m: 2.0}).A.tolist()
    [[-0.5]]
    """
    sympy = imported("sympy", extra="sympy")
    if isinstance(A, sympy.Basic) and not isinstance(A, (sympy.MatrixBase, sympy.NDimArray)):
        raise SpecError(
            f"A is a {type(A).__name__} of sympy, and matrices are read: of a StateSpace give its matrices, "
            "from_sympy(model.A, model.B, model.C, D=model.D); of a transfer function a realisation.",
            path="A",
        )
    matrices = {"A": A, "B": B, "C": C, **plant}
    symbolic = {name: sympy.Matrix(matrices[name]) for name in ALL_MATRICES if _is_symbolic(matrices.get(name), sympy)}
    free = {str(symbol) for matrix in symbolic.values() for symbol in _unknowns(matrix, sympy)}
    values = {str(name): value for name, value in (parameters or {}).items()}
    _require_values(free, values)
    arguments = {name: value for name, value in matrices.items() if value is not None}
    for name, matrix in symbolic.items():
        numbers = {symbol: _exact(values[str(symbol)], sympy) for symbol in _unknowns(matrix, sympy)}
        arguments[name] = _evaluated(matrix, numbers, name)
    for name in SIGNAL_NAMES:
        if arguments.get(name) is not None:
            arguments[name] = [str(entry) for entry in arguments[name]]
    return DescriptorSystem(**{"E": None, **arguments})


@arguments_checked
def from_pandas(A: Any, B: Any = None, C: Any = None, **plant: Any) -> DescriptorSystem:
    """Return the plant of labelled frames of pandas; `DescriptorSystem` takes them as well.

    Parameters
    ----------
    A : pandas.DataFrame
        ``(nx, nx)``; its labels are the names of the states.
    B, C : pandas.DataFrame, optional
        ``(nx, nu)`` and ``(ny, nx)``: columns of B name the inputs, rows of C the outputs.
    **plant
        Any other argument of `DescriptorSystem`: matrices may be frames, and columns of ``Bf`` name the faults, those
        of ``Bd`` the unknown inputs.

    Returns
    -------
    DescriptorSystem
        Rows and columns are put in the order of the first frame with their labels, A before C.

    Raises
    ------
    SpecError
        Labels differ between frames, or are repeated.

    Examples
    --------
    >>> import obsynth
    >>> import pandas as pd
    >>> A = pd.DataFrame([[-1.0, 0.5], [0.0, -2.0]], index=["a", "b"], columns=["a", "b"])
    >>> obsynth.from_pandas(A, C=pd.DataFrame([[1.0, 0.0]], index=["gauge"], columns=["a", "b"])).output_names
    ('gauge',)
    """
    return DescriptorSystem(**{"E": None, "A": A, "B": B, "C": C, **plant})


def _unknowns(matrix: Any, sympy: Any) -> list[Any]:
    """Return what needs a value in a matrix: functions of time (``dynamicsymbols``) and their derivatives, the highest
    first, since a function without its value hides in its derivative; then symbols."""
    functions = matrix.atoms(sympy.Derivative, sympy.core.function.AppliedUndef)
    outer = sorted(functions, key=lambda entry: (-getattr(entry, "derivative_count", 0), str(entry)))
    return [*outer, *sorted(matrix.subs({entry: 0 for entry in outer}).free_symbols, key=str)]


def _is_symbolic(value: Any, sympy: Any) -> bool:
    if isinstance(value, (sympy.MatrixBase, sympy.NDimArray)):
        return True
    rows = value.tolist() if isinstance(value, np.ndarray) and value.dtype == object else value
    rows = rows if isinstance(rows, Sequence) and not isinstance(rows, str) else ()
    return any(isinstance(entry, sympy.Basic) for row in rows if isinstance(row, Sequence) for entry in row)


def _require_values(free: set[str], values: Mapping[str, float]) -> None:
    missing = sorted(free - set(values))
    if missing:
        raise SpecError(
            f"The matrices hold symbols without a value: {', '.join(missing)}. Give parameters={{...}}.",
            path="parameters",
        )
    unused = sorted(set(values) - free)
    if unused:
        raise SpecError(
            f"No matrix holds the symbol {unused[0]!r}.{suggestion(unused[0], sorted(free))}", path="parameters"
        )
    wrong = [name for name, value in values.items() if not (is_finite_number(value) or _is_rational(value))]
    if wrong:
        raise SpecError(f"The parameter {wrong[0]!r} is {values[wrong[0]]!r}: give a finite number.", path="parameters")


def _is_rational(value: Any) -> bool:
    """Whether a value is an exact number: of fractions, decimal or sympy (which need not be rational, but must be real
    and finite there)."""
    if isinstance(value, Fraction):
        return True
    if isinstance(value, Decimal):
        return value.is_finite()
    return bool(getattr(value, "is_number", False) and value.is_real and value.is_finite)


def _exact(value: Any, sympy: Any) -> Any:
    if isinstance(value, sympy.Float) or is_finite_number(value):
        return sympy.Rational(*float(value).as_integer_ratio())
    if isinstance(value, (Fraction, Decimal)):
        return sympy.Rational(*value.as_integer_ratio())
    return value


def _evaluated(matrix: Any, numbers: Mapping[Any, Any], name: str) -> FloatArray:
    rows, columns = matrix.shape
    dense = np.zeros((rows, columns))
    for i in range(rows):
        for j in range(columns):
            entry = matrix[i, j]
            for unknown, number in numbers.items():
                entry = entry.subs(unknown, number)
            if not (entry.is_number and entry.is_real and entry.is_finite):
                raise SpecError(
                    f"{name}, row {i + 1}, column {j + 1}: {matrix[i, j]} is {entry} at these parameters; "
                    "give a finite real number.",
                    path=name,
                )
            dense[i, j] = int(entry.p) / int(entry.q) if entry.is_Rational else float(entry)
    return dense

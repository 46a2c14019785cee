"""Linear models of other tools as plants: systems of python-control and scipy, matrices of sympy, frames of pandas.

Plants from CasADi: a Function or a dictionary of expressions, as its integrators take them.

Power networks of the simulator ANDES: a case, or the pencil that was written from one.

Files: ``.mat`` files of MATLAB, and ``linearized_model.mo`` of OpenModelica's ``linearize``.

Which inputs of somebody's model are known, which are faults, and which are unknown.
"""

from __future__ import annotations

import errno
import json
import math
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import scipy
from numpy.typing import ArrayLike

from obsynth.errors import SpecError
from obsynth.files.outputs import path_of, read_text
from obsynth.numerics.arguments import (
    FloatArray,
    arguments_checked,
    as_matrix,
    is_finite_number,
    number_in_text,
    require_kind,
    require_readable,
    require_shape,
    shown,
)
from obsynth.numerics.libraries import imported
from obsynth.plants.dae import DAEModel
from obsynth.plants.descriptor import ALL_MATRICES, SIGNAL_NAMES, DescriptorSystem, checked_names, index_of, suggestion

_ROLES = ("faults", "disturbances", "actuator_faults", "sensor_faults")


def plant_of(
    matrices: Mapping[str, ArrayLike | None],
    plant: Mapping[str, Any],
    *,
    dt: float,
    labels: Mapping[str, Sequence[str] | None],
    point: Mapping[str, float] | None = None,
    units: Mapping[str, str] | None = None,
) -> DescriptorSystem:
    """Return the plant of matrices ``E, A, B, C, D`` whose inputs are shared out among known, faults and unknown.
    ``labels``: ``state_names``, ``input_names``, ``output_names``; ``plant``: roles and arguments of the plant, which
    go before ``dt``, and entry by entry before operating point and units."""
    more = {"dt": dt, **plant}
    for name, stated in (("operating_point", point), ("units", units)):
        if stated is not None:
            more[name] = {**stated, **(more.get(name) or {})}
    faults, disturbances, actuator_faults, sensor_faults = _role_lists(more)
    a = as_matrix(matrices["A"], "A")
    given = {name: None if value is None else as_matrix(value, name) for name, value in matrices.items()}
    c = given.get("C")
    c = np.eye(a.shape[0]) if c is None else c
    nu = next((m.shape[1] for name in "BD" if (m := given.get(name)) is not None), 0)
    inputs = checked_names(labels.get("input_names"), nu, prefix="u", what="input_names")
    outputs = checked_names(labels.get("output_names"), c.shape[0], prefix="y", what="output_names")
    b, d = _full(given.get("B"), a.shape[0], nu, "B"), _full(given.get("D"), c.shape[0], nu, "D")
    both = sorted(set(faults) & set(disturbances))
    if both:
        raise SpecError(f"Input {both[0]!r} is given as a fault and as a disturbance: keep one.", path="faults")
    fault, unknown = (
        _places(names, inputs, what) for names, what in ((faults, "faults"), (disturbances, "disturbances"))
    )
    doubled = _places(actuator_faults, inputs, "actuator_faults")
    gone = [name for name in actuator_faults if name in (*faults, *disturbances)]
    if gone:
        raise SpecError(f"actuator_faults names {gone[0]!r}, which is no known input.", path="actuator_faults")
    biased = _places(sensor_faults, outputs, "sensor_faults")
    known = [i for i in range(nu) if i not in (*fault, *unknown)]
    arguments: dict[str, Any] = {
        "E": given.get("E"),
        "A": a,
        "B": b[:, known],
        "C": c,
        "D": d[:, known],
        "state_names": labels.get("state_names"),
        "output_names": outputs,
        "input_names": [inputs[i] for i in known],
    }
    if fault or doubled or biased:
        _refuse_both(more, "faults", ("Bf", "Df", "fault_names"))
        bias = np.eye(c.shape[0])[:, biased]
        arguments |= {
            "Bf": np.hstack([b[:, [*fault, *doubled]], np.zeros((a.shape[0], len(biased)))]),
            "Df": np.hstack([d[:, [*fault, *doubled]], bias]),
            "fault_names": [
                *faults,
                *(f"fault of {name}" for name in actuator_faults),
                *(f"bias of {name}" for name in sensor_faults),
            ],
        }
    if unknown:
        _refuse_both(more, "disturbances", ("Bd", "Dd", "disturbance_names"))
        arguments |= {"Bd": b[:, unknown], "Dd": d[:, unknown], "disturbance_names": list(disturbances)}
    return DescriptorSystem(**{**arguments, **more})


def _full(matrix: FloatArray | None, rows: int, columns: int, name: str) -> FloatArray:
    if matrix is None or (matrix.size == 0 and 0 in (rows, columns)):
        return np.zeros((rows, columns))
    require_shape(matrix.shape, (rows, columns), name)
    return matrix


def _role_lists(more: dict[str, Any]) -> list[Sequence[str]]:
    """Take the names of each role out of the arguments of a plant."""
    lists = [more.pop(role, ()) for role in _ROLES]
    for role, names in zip(_ROLES, lists, strict=True):
        if isinstance(names, str) or not all(isinstance(name, str) for name in names):
            raise SpecError(f"{role} is {names!r}: give a list of names.", path=role)
        repeated = [name for name in names if list(names).count(name) > 1]
        if repeated:
            raise SpecError(f"{role} repeats {repeated[0]!r}.", path=role)
    return lists


def _places(names: Sequence[str], known: Sequence[str], what: str) -> list[int]:
    return [index_of(name, known, what=what) for name in names]


def _refuse_both(more: Mapping[str, Any], role: str, names: Sequence[str]) -> None:
    twice = [name for name in names if more.get(name) is not None]
    if twice:
        raise SpecError(f"{role} and {twice[0]} are both given: use one of them.", path=twice[0])


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
        A transfer function is realised by ``control.ss``.
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
        It is no linear system, python-control is not installed, a name is unknown, or the sampling time is missing.
    """
    control = imported("control", extra=None)
    if isinstance(system, control.TransferFunction):
        system = control.ss(system)
    require_kind(system, control.StateSpace, "system", "a control.StateSpace, such as control.ss(...)")
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
        A ``StateSpace``, or what ``to_ss`` makes into one.
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
        It is no linear system of scipy, a name is unknown, or a discrete system does not say its ``dt``.
    """
    signal = imported("scipy.signal", extra=None)
    require_kind(system, (signal.lti, signal.dlti), "system", "a scipy.signal.StateSpace")
    state_space = system.to_ss()
    return plant_of(
        {"E": E, **{name: np.asarray(getattr(state_space, name)) for name in "ABCD"}},
        plant,
        labels={"input_names": input_names, "output_names": output_names},
        dt=_sampling_time(state_space.dt, plant.pop("dt", None)),
    )


def _sampling_time(own: Any, given: float | None) -> float:
    """Return the sampling time: ``None`` is continuous, ``True`` unsaid; two that differ are refused."""
    if own is True and given is None:
        raise SpecError("The system is sampled, but has no sampling time: give dt in seconds.", path="dt")
    if own is None or own is True:
        return 0.0 if given is None else given
    if given is not None and given != own:
        raise SpecError(f"dt is {given}, but the system has dt = {own}: leave dt out.", path="dt")
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
        Value of each symbol, by the symbol or by its name.
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
    """
    sympy = imported("sympy", extra="sympy")
    given = {"A": A, "B": B, "C": C, **plant}
    symbolic = {name: sympy.Matrix(given[name]) for name in ALL_MATRICES if _is_symbolic(given.get(name), sympy)}
    free = {str(symbol) for matrix in symbolic.values() for symbol in matrix.free_symbols}
    values = {str(name): value for name, value in (parameters or {}).items()}
    _require_values(free, values)
    arguments = {name: value for name, value in given.items() if value is not None}
    for name, matrix in symbolic.items():
        numbers = {symbol: _exact(values[str(symbol)], sympy) for symbol in matrix.free_symbols}
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
    """
    return DescriptorSystem(**{"E": None, "A": A, "B": B, "C": C, **plant})


def _is_symbolic(value: Any, sympy: Any) -> bool:
    if isinstance(value, sympy.MatrixBase):
        return True
    rows = value if isinstance(value, Sequence) and not isinstance(value, str) else ()
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
    wrong = [name for name, value in values.items() if not is_finite_number(value)]
    if wrong:
        raise SpecError(f"The parameter {wrong[0]!r} is {values[wrong[0]]!r}: give a finite number.", path="parameters")


def _exact(value: float, sympy: Any) -> Any:
    return sympy.Rational(*float(value).as_integer_ratio())


def _evaluated(matrix: Any, numbers: Mapping[Any, Any], name: str) -> FloatArray:
    rows, columns = matrix.shape
    dense = np.zeros((rows, columns))
    for i in range(rows):
        for j in range(columns):
            entry = matrix[i, j].subs(numbers)
            if not (entry.is_number and entry.is_real and entry.is_finite):
                raise SpecError(
                    f"{name}, row {i + 1}, column {j + 1}: {matrix[i, j]} is {entry} at these parameters; "
                    "give a finite real number.",
                    path=name,
                )
            dense[i, j] = int(entry.p) / int(entry.q) if entry.is_Rational else float(entry)
    return dense


#: What goes in and what comes out, by the names that CasADi's integrators have; y is ours.
INTEGRATOR_INPUTS, OUTPUTS = ("x", "z", "u", "p"), ("ode", "alg", "y")


@arguments_checked
def from_casadi(
    system: Any,
    *,
    states: Mapping[str, float],
    inputs: Mapping[str, float] | None = None,
    parameters: Mapping[str, float] | None = None,
    output_names: Any = None,
    units: Mapping[str, str] | None = None,
) -> DAEModel:
    """Return the nonlinear plant of a CasADi Function, or of a dictionary of expressions.

    Parameters
    ----------
    system : casadi.Function or dict
        ``x' = ode(x, z, u, p)``, ``0 = alg(x, z, u, p)``, ``y = y(x, z, p)``: a Function with inputs and outputs of
        these names, or a dictionary of SX or MX with these keys, as ``casadi.integrator`` takes it.  ``z``, ``u``,
        ``p`` and ``alg`` may be missing.
    states : mapping of str to float
        Name -> nominal value, of x first and then of z.
    inputs : mapping of str to float, optional
        Name -> nominal value, of u.
    parameters : mapping of str to float, optional
        Name -> nominal value, of p.
    output_names : list of str, optional
        Names of y; ``y1, ...`` by default.
    units : mapping of str to str, optional
        As for `DAEModel`.

    Returns
    -------
    DAEModel
        Linearise it by `obsynth.linearise` for a method that needs a linear plant.

    Raises
    ------
    SpecError
        CasADi is not installed, a name is unknown, sizes do not fit, ``ode`` or ``y`` is missing, or y depends on u.

    References
    ----------
    .. [Andersson2019] J. Andersson et al., CasADi: a software framework for nonlinear optimization and optimal control,
       Math. Prog. Comp. 11 (1), 2019.
    """
    casadi = imported("casadi", extra="nonlinear", what="A plant of CasADi")
    function = _function(casadi, system)
    taken = {name: function.size1_in(name) if name in function.name_in() else 0 for name in INTEGRATOR_INPUTS}
    made = {name: function.size1_out(name) if name in function.name_out() else 0 for name in OUTPUTS}
    nx, nz = taken["x"], taken["z"]
    for what, count, wanted in (
        ("states", len(states), nx + nz), ("inputs", len(inputs or {}), taken["u"]),
        ("parameters", len(parameters or {}), taken["p"]),
    ):  # fmt: skip
        if count != wanted:
            raise SpecError(f"{what} names {count} value(s), but the system has {wanted}.", path=what)
    if made["ode"] != nx or made["alg"] != nz or not made["y"]:
        raise SpecError(
            f"The system has {nx} state(s) x and {nz} state(s) z, but {made['ode']} equation(s) ode, {made['alg']} alg "
            f"and {made['y']} output(s) y: one ode for each x, one alg for each z, and at least one y are needed.",
            path="system",
        )
    if "u" in function.name_in() and function.jac_sparsity(
        function.index_out("y"), function.index_in("u")
    ).nnz():  # fmt: skip
        raise SpecError("y depends on u: outputs are of states and parameters alone.", path="system")

    def values(x: Any, u: Any, theta: Any) -> dict[str, Any]:
        given = {"x": x[:nx], "z": x[nx:], "u": u, "p": theta}
        return dict(function(**{name: casadi.vertcat(*given[name]) for name in function.name_in()}))

    def equations(rates: Any, x: Any, u: Any, theta: Any) -> list[Any]:
        found = values(x, u, theta)
        moving = [rates[i] - found["ode"][i] for i in range(nx)]
        return moving + [found["alg"][i] for i in range(nz)]

    def outputs(x: Any, theta: Any) -> list[Any]:
        found = values(x, [0.0] * taken["u"], theta)["y"]
        return [found[i] for i in range(made["y"])]

    output_names = [f"y{i + 1}" for i in range(made["y"])] if output_names is None else output_names
    return DAEModel(
        equations, outputs, states=states, inputs=inputs, parameters=parameters, units=units, output_names=output_names
    )  # fmt: skip


def _function(casadi: Any, system: Any) -> Any:
    """Return a Function with our names; raise `SpecError` for what is none."""
    if isinstance(system, Mapping):
        unknown = [key for key in system if key not in (*INTEGRATOR_INPUTS, *OUTPUTS)]
        if unknown:
            raise SpecError(
                f"system has the unknown key {unknown[0]!r}; there are: {', '.join((*INTEGRATOR_INPUTS, *OUTPUTS))}.",
                path="system",
            )
        names = [name for name in INTEGRATOR_INPUTS if name in system]
        results = [name for name in OUTPUTS if name in system]
        try:
            made = casadi.Function("plant", [system[n] for n in names], [system[n] for n in results], names, results)
        except (RuntimeError, NotImplementedError, TypeError) as error:
            raise SpecError(f"CasADi makes no function of this system: {error}", path="system") from error
        return made
    if not isinstance(system, casadi.Function):
        raise SpecError(f"system is {shown(system)}: give a casadi.Function, or a dictionary.", path="system")
    unknown = [name for name in (*system.name_in(), *system.name_out()) if name not in (*INTEGRATOR_INPUTS, *OUTPUTS)]
    if unknown:
        raise SpecError(
            f"The Function has an input or output {unknown[0]!r}: name them {', '.join(INTEGRATOR_INPUTS)} and "
            f"{', '.join(OUTPUTS)}.", path="system",
        )  # fmt: skip
    return system


#: Names of variables, or the variables of each device: ``{"GENCLS 1": ["omega"], "Bus 1": ["a", "v"]}``.
Picked: TypeAlias = "Sequence[str] | Mapping[str, Sequence[str]]"

_PENCIL = ("E.mtx", "A.mtx", "names.json")


@arguments_checked
def from_andes(
    case: Any, *, outputs: Picked, faults: Picked = (), disturbances: Picked = (), **plant: Any
) -> DescriptorSystem:
    """Return the plant of a power network, linearised at its power flow solution.

    Parameters
    ----------
    case : path or andes.System
        A case file that ANDES reads (``.json``, ``.xlsx``, ``.raw``, ...); a folder with ``E.mtx``, ``A.mtx`` and
        ``names.json``, such as ``designs/smib``; or a system of ANDES, whose power flow is solved where it is not yet.
    outputs : list of str, or mapping
        Measured variables by name, ``["omega GENCLS 1", "v Bus 1"]``, or by device,
        ``{"GENCLS 1": ["omega"], "Bus 1": ["v"]}``.
    faults, disturbances : list of str, or mapping
        Variables in whose equations a fault, or an unknown input, is added: ``{"GENCLS 1": ["tm"]}`` is a change of
        mechanical torque, ``{"Bus 3": ["a"]}`` active power drawn at a bus.
    **plant
        Any other argument of `DescriptorSystem`, such as ``sensor_noise`` or ``fault_names``.

    Returns
    -------
    DescriptorSystem
        Continuous, ``T x' = f(x, y)``, ``0 = g(x, y)`` as one pencil ``(nx + ny, nx + ny)``: differential variables
        first.  From a case, the power flow solution is the operating point.

    Raises
    ------
    SpecError
        ANDES is not installed (it is licensed under the GPL and no dependency of ours), it cannot read or solve the
        case, or a name is unknown.
    """
    point: dict[str, float] = {}
    if isinstance(case, (str, Path)) and Path(case).is_dir():
        e, a, names = _written_pencil(Path(case))
    else:
        e, a, names, point = _solved_case(case)
    given = {
        kind: _names(picked, names, kind)
        for kind, picked in (("outputs", outputs), ("faults", faults), ("disturbances", disturbances))
    }
    stated = {**point, **(plant.pop("operating_point", None) or {})}
    arguments: dict[str, Any] = {
        "dt": 0.0,
        "state_names": checked_names(names, len(names), prefix="x", what="state_names"),
        "Bf": given["faults"] or None,
        "Bd": given["disturbances"] or None,
        "C": given["outputs"],
    }
    # A fault and a disturbance are changes: the value of the variable they are named after is not theirs.
    for kind, role, word in (("faults", "fault_names", "change of"), ("disturbances", "disturbance_names", "load on")):
        if given[kind]:
            arguments[role] = [f"{word} {name}" for name in given[kind]]
    return DescriptorSystem(e, a, **{**arguments, "operating_point": stated, **plant})


def _written_pencil(folder: Path) -> tuple[FloatArray, FloatArray, list[str]]:
    missing = [name for name in _PENCIL if not (folder / name).is_file()]
    if missing:
        raise SpecError(f"{folder} has no {missing[0]}: a pencil of ANDES is {', '.join(_PENCIL)}.", path=str(folder))
    try:
        e, a = (np.asarray(_dense(scipy.io.mmread(folder / name)), dtype=np.float64) for name in _PENCIL[:2])
        names = json.loads((folder / _PENCIL[2]).read_text(encoding="utf-8"))
        listed = [*names["differential"], *names["algebraic"]]
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise SpecError(f"{folder} holds no pencil of ANDES: {error}", path=str(folder)) from error
    return e, a, listed


def _solved_case(case: Any) -> tuple[FloatArray, FloatArray, list[str], dict[str, float]]:
    """Return E, A, the names of the variables and their values at the power flow solution."""
    andes = imported("andes", extra="andes")
    system = case
    if isinstance(case, (str, Path)):
        if not Path(case).is_file():
            raise SpecError(f"{case} does not exist.", path=str(case))
        system = andes.load(str(case), no_output=True, default_config=True, setup=True)
    if not hasattr(system, "PFlow") or not hasattr(system, "dae"):
        raise SpecError(f"ANDES cannot read {case}.", path="case")
    if not system.PFlow.converged and not system.PFlow.run():
        raise SpecError("The power flow of the case has no solution that ANDES finds.", path="case")
    if not system.TDS.initialized:
        system.TDS.init()
    dae = system.dae
    n, m = dae.n, dae.m
    blocks = ((dae.fx, dae.fy), (dae.gx, dae.gy))
    a = np.block([[_dense(block) for block in row] for row in blocks])
    e = np.zeros((n + m, n + m))
    e[np.arange(n), np.arange(n)] = np.asarray(dae.Tf, dtype=np.float64)
    names = [str(name) for name in (*dae.x_name, *dae.y_name)]
    values = np.concatenate([np.asarray(dae.x), np.asarray(dae.y)])
    return e, a, names, dict(zip(names, map(float, values), strict=True))


def _dense(matrix: Any) -> FloatArray:
    """Return a full array of a sparse matrix of scipy or of kvxopt."""
    if hasattr(matrix, "toarray"):
        return np.asarray(matrix.toarray(), dtype=np.float64)
    if hasattr(matrix, "V"):
        rows, columns, values = (np.array(part).ravel() for part in (matrix.I, matrix.J, matrix.V))
        dense = np.zeros(matrix.size)
        np.add.at(dense, (rows.astype(np.int64), columns.astype(np.int64)), values)
        return dense
    return np.asarray(matrix, dtype=np.float64)


#: Devices that a message lists.
_LISTED_DEVICES = 12


def _names(picked: Picked, known: Sequence[str], what: str) -> list[str]:
    """Return names of variables; devices are spelled as ANDES does, ``omega GENCLS 1``."""
    if isinstance(picked, str):
        raise SpecError(f"{what} is {picked!r}: give a list of names.", path=what)
    if not isinstance(picked, Mapping):
        return list(picked)
    listed = []
    for device, variables in picked.items():
        own = [name.removesuffix(f" {device}") for name in known if name.endswith(f" {device}")]
        if not own:
            devices = list(dict.fromkeys(name.partition(" ")[2] for name in known))
            shown = ", ".join(devices[:_LISTED_DEVICES]) + (", ..." if len(devices) > _LISTED_DEVICES else "")
            raise SpecError(f"{what}: the network has no device {device!r}; it has {shown}.", path=what)
        for variable in variables:
            if variable not in own:
                raise SpecError(f"{what}: {device} has no variable {variable!r}; it has {', '.join(own)}.", path=what)
            listed.append(f"{variable} {device}")
    return listed


_MODEL_MATRICES = ("E", "A", "B", "C", "D")
_MORE = ("Bf", "Df", "Bd", "Dd", "Bw", "Dw")
# What MATLAB's state-space objects call them, and what obsynth does.
_MATLAB_NAMES = {
    "StateName": "state_names",
    "InputName": "input_names",
    "OutputName": "output_names",
    **{f"{kind}_names": f"{kind}_names" for kind in ("state", "input", "output", "fault", "disturbance", "noise")},
}
_SAMPLE_TIME_NAMES = ("Ts", "dt")


@arguments_checked
def from_matlab(
    path: str | Path,
    variable: str | None = None,
    *,
    dt: float | None = None,
    **plant: Any,
) -> DescriptorSystem:
    """Return the plant in a ``.mat`` file (up to version 7.2).

    Parameters
    ----------
    path : path
        The file.
    variable : str, optional
        A struct with fields ``A`` and, as far as there are any, ``E, B, C, D, Bf, Df, Bd, Dd, Bw, Dw``, ``Ts`` or
        ``dt`` (seconds, 0 for continuous time) and names (``StateName``, ``InputName``, ``OutputName``, as
        ``struct(sys)`` has them, or ``state_names`` and so on).  May be left out where the file has one struct, or the
        matrices themselves.
    dt : float, optional, seconds
        Where the file does not say it; 0 for continuous time.
    **plant
        Roles, as lists of names: ``faults`` and ``disturbances`` (inputs that are faults, or unknown; the others are
        known inputs), ``actuator_faults`` (known inputs on which a fault acts: adds ``fault of <input>``) and
        ``sensor_faults`` (outputs with a bias: adds ``bias of <output>``).  Any other argument of `DescriptorSystem`.

    Returns
    -------
    DescriptorSystem
        With the names in the file.

    Raises
    ------
    SpecError
        The file cannot be read, holds no such struct, or its matrices do not fit together.
    """
    source = path_of(path)
    content = _content(source)
    fields = _fields(content, variable, source)
    if "A" not in fields:
        raise SpecError(
            f"{source} has no matrix A{_in(variable)}; it has: {', '.join(fields) or 'nothing'}.", path=str(source)
        )
    times = [
        float(np.squeeze(fields[name])) for name in _SAMPLE_TIME_NAMES if name in fields and np.size(fields[name]) == 1
    ]
    if dt is None and not times:
        raise SpecError(f"{source} has no sampling time (Ts): give dt in seconds, or 0 for continuous time.", path="dt")
    if dt is not None and times and dt != times[0]:
        raise SpecError(f"dt is {dt}, but {source} has {times[0]:g}: leave dt out.", path="dt")
    names = {ours: _texts(fields[theirs]) for theirs, ours in _MATLAB_NAMES.items() if theirs in fields}
    labels = {ours: names.pop(ours, None) for ours in ("state_names", "input_names", "output_names")}
    given = {name: _dense_value(fields[name]) for name in (*_MODEL_MATRICES, *_MORE) if name in fields}
    return plant_of(
        {name: given[name] for name in _MODEL_MATRICES if name in given and np.size(given[name])},
        {**{name: given[name] for name in _MORE if name in given}, **names, **plant},
        labels=labels,
        dt=times[0] if dt is None else dt,
    )


def mat_arrays(source: Path) -> dict[str, Any]:
    """Return what a ``.mat`` file holds by name; raise `ValueError` for other versions, damaged and too large files."""
    try:
        # A small file may unpack to more than the memory holds.
        require_readable(sum(math.prod(shape) for _, shape, kind in scipy.io.whosmat(source) if kind != "sparse"))
        content = scipy.io.loadmat(source)
    except NotImplementedError as error:
        raise ValueError("MATLAB 7.3 files are not supported, save it with '-v7'") from error
    except scipy.io.matlab.MatReadError as error:
        raise ValueError(str(error)) from error
    return {name: value for name, value in content.items() if not name.startswith("__")}


def _content(source: Path) -> dict[str, Any]:
    if not source.is_file():
        raise SpecError(f"{source} does not exist.", path=str(source))
    try:
        return mat_arrays(source)
    except (OSError, ValueError, TypeError, KeyError, EOFError, OverflowError) as error:
        raise SpecError(f"{source} cannot be read as a .mat file: {error}", path=str(source)) from error


def _fields(content: Mapping[str, Any], variable: str | None, source: Path) -> dict[str, Any]:
    structs = [
        name
        for name, value in content.items()
        if getattr(value, "dtype", None) is not None and value.dtype.names and value.size == 1
    ]
    if variable is None and "A" in content:
        return dict(content)
    if variable is None and len(structs) != 1:
        found = ", ".join(map(repr, structs)) or "none"
        raise SpecError(f"{source}: name the struct of the plant (variable=...); it has: {found}.", path=str(source))
    name = structs[0] if variable is None else variable
    if name not in structs:
        raise SpecError(
            f"{source} has no struct {name!r}; it has: {', '.join(map(repr, structs)) or 'none'}.", path=str(source)
        )
    record = content[name].reshape(-1)[0]
    return {field: record[field] for field in content[name].dtype.names}


def _in(variable: str | None) -> str:
    return "" if variable is None else f" in {variable!r}"


def _dense_value(value: Any) -> Any:
    return value.toarray() if hasattr(value, "toarray") else value


def _texts(value: Any) -> list[str] | None:
    """Return the texts of a cell array, or of a matrix of characters; `None` where all are empty, as MATLAB has it."""
    texts = [str(np.squeeze(cell)) if np.size(cell) else "" for cell in np.atleast_1d(value).ravel()]
    return [text.strip() for text in texts] if any(text.strip() for text in texts) else None


_SIZE = re.compile(r"parameter\s+Integer\s+([nmp])\s*=\s*(\d+)")
_MODELICA_MATRIX = re.compile(r"parameter\s+Real\s+([ABCD])\s*\[[^\]]*\]\s*=\s*(\[[^\]]*\]|zeros\([^)]*\))\s*;")
_POINT = re.compile(r"parameter\s+Real\s+([xu])0\s*\[[^\]]*\]\s*=\s*(\{[^}]*\}|zeros\([^)]*\)|fill\([^)]*\))\s*;")
_ALIAS = re.compile(r"Real\s+'([xuy])_([^']*)'\s*=\s*([xuy])\[(\d+)\]\s*;")
# OpenModelica makes outputs that are states into states of their own name.
_OUTPUT_ALIAS = "$outputAlias_"


@arguments_checked
def from_modelica(path: str | Path, **plant: Any) -> DescriptorSystem:
    """Return the plant of a linearised Modelica model, with the names of its variables.

    Parameters
    ----------
    path : path
        The file ``linearized_model.mo`` that OpenModelica's ``linearize`` (or ``-l=<time>``) writes.
    **plant
        Roles, as lists of names: ``faults`` and ``disturbances`` (inputs that are faults, or unknown; the others are
        known inputs), ``actuator_faults`` (known inputs on which a fault acts: adds ``fault of <input>``) and
        ``sensor_faults`` (outputs with a bias: adds ``bias of <output>``).  Any other argument of `DescriptorSystem`.

    Returns
    -------
    DescriptorSystem
        Continuous; states and known inputs have the values ``x0`` and ``u0`` of the file as operating point.  A model
        without outputs measures all its states.

    Raises
    ------
    SpecError
        The file cannot be read, or is no such model.

    Notes
    -----
    The file does not hold the outputs at the operating point: add them by ``operating_point={...}``.  Constant terms
    are not in it either: linearise in a steady state.
    """
    source = path_of(path)
    if not source.exists():
        raise SpecError(f"{source} cannot be read: {os.strerror(errno.ENOENT)}.", path=str(source))
    text = re.sub(r"//[^\n]*|/\*.*?\*/", "", read_text(source), flags=re.DOTALL)
    sizes = {name: int(count) for name, count in _SIZE.findall(text)}
    found = {name: body for name, body in _MODELICA_MATRIX.findall(text)}
    missing = [name for name in ("n", "m", "p") if name not in sizes] + [name for name in "ABCD" if name not in found]
    if missing:
        raise SpecError(
            f"{source} is no linear model as OpenModelica writes it: it has no {missing[0]}.", path=str(source)
        )
    shapes = {"A": ("n", "n"), "B": ("n", "m"), "C": ("p", "n"), "D": ("p", "m")}
    matrices = {
        name: _matrix(found[name], sizes[rows], sizes[columns], name, source)
        for name, (rows, columns) in shapes.items()
    }
    names = {kind: [f"{kind}{i + 1}" for i in range(sizes[size])] for kind, size in zip("xuy", "nmp", strict=True)}
    for kind, name, array, number in _ALIAS.findall(text):
        if kind == array and int(number) <= len(names[kind]):
            names[kind][int(number) - 1] = name.removeprefix(_OUTPUT_ALIAS)
    points = dict(_POINT.findall(text))
    point = {
        name: value
        for kind in "xu"
        for name, value in zip(
            names[kind], _numbers(points.get(kind, ""), len(names[kind]), f"{kind}0", source), strict=True
        )
    }
    measured = sizes["p"] > 0
    if not measured:
        matrices |= {"C": np.eye(sizes["n"]), "D": np.zeros((sizes["n"], sizes["m"]))}
    labels = {"state_names": names["x"], "input_names": names["u"], "output_names": names["y" if measured else "x"]}
    return plant_of(matrices, plant, labels=labels, dt=0.0, point=point)


def _matrix(body: str, rows: int, columns: int, name: str, source: Path) -> FloatArray:
    if body.startswith("zeros"):
        return np.zeros((rows, columns))
    lines = [line for line in body.strip("[]").split(";") if line.strip()]
    values = [[_number(entry, name, source) for entry in line.split(",")] for line in lines]
    if len(values) != rows or any(len(row) != columns for row in values):
        raise SpecError(f"{source}: {name} is not {rows} by {columns}, as the file states.", path=name)
    return np.array(values).reshape(rows, columns)


def _numbers(body: str, count: int, name: str, source: Path) -> list[float]:
    if not body.startswith("{"):
        return [0.0] * count
    entries = [entry for entry in body.strip("{}").split(",") if entry.strip()]
    if len(entries) != count:
        raise SpecError(f"{source}: {name} has {len(entries)} entries, but {count} are needed.", path=name)
    return [_number(entry, name, source) for entry in entries]


def _number(text: str, name: str, source: Path) -> float:
    try:
        return number_in_text(text)
    except ValueError:
        raise SpecError(f"{source}: {name} holds {text.strip()!r}, which is no number.", path=name) from None

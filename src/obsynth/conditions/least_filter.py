r"""The filter of least gain among all causal filters, as full-order inequalities on the innovation.

Every filter that decouples what it must is ``fhat0 - Z r`` with a causal Z, and its error is that of the problem of
estimation (`obsynth.numerics.decoupling_windows`)

.. math::
    \xi^+ = A \xi + B w, \qquad r = C \xi + D w, \qquad e_0 = L \xi + D_1 w ,

here with r as the innovation.  The least norm is reached by a filter of the same order with gains K and Z0, whose error
has ``A - K C``, ``B - K D``, ``L - Z0 C`` and ``D1 - Z0 D``: the bounded real and the H2 inequalities are linear in P,
``Y = P K`` and Z0.  Source: P. Gahinet, P. Apkarian, Int. J. Robust Nonlinear Control 4, 1994; C. de Souza, U. Shaked,
IEEE TAC 1999, for the same inequalities of uncertain plants.  Continuous time is the same after ``s = alpha (z - 1) /
(z + 1)``, which keeps the H-infinity norm.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from obsynth.conditions import atoms, lmi
from obsynth.conditions import lazy_cvxpy as cp
from obsynth.conditions.problem import Conditions, Values, design_of
from obsynth.errors import SpecError
from obsynth.numerics.arguments import arguments_checked
from obsynth.numerics.arrays import FloatArray
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.transformations.delays import linear_plant
from obsynth.plants.transformations.recovery import Transformation
from obsynth.results.registered import registered


@arguments_checked
def hinf_filter(
    plant: DescriptorSystem | Transformation,
    *,
    delay: Any = "auto",
    reference: Any = None,
    exact: bool = True,
    decoupled: Any = None,
    margin: float = lmi.MARGIN,
) -> Conditions:
    """Return the inequality of the least largest gain of any causal fault-estimation filter in P, Y and Z0.

    Parameters
    ----------
    plant : DescriptorSystem or Transformation
        Either time, a regular pencil of any index.
    delay, reference, exact, decoupled
        What the filter must do, as for `obsynth.optimal_filter`; with ``delay="auto"`` the first delay that exists.
    margin : float, optional
        What the inequality keeps to the boundary of the cone.

    Returns
    -------
    Conditions
        Variables ``P (n, n)``, ``Y (n, m)``, ``Z0 (nf, m)`` and ``gamma_squared``; the gain is ``unit`` times the root
        of the latter.  Data ``A, B, C, D, L, D1`` of the problem of estimation, in units near one, and ``unit (1, 1)``.
        Gains ``K (n, m)`` and ``Z0`` on the innovation.

    Raises
    ------
    SpecError
        An option is malformed.
    PreconditionError
        No causal filter has this fault map.

    Notes
    -----
    Trap: near the least P grows without bound; a solver leaves five digits of the gain of eight states or so.  The
    front door solves Riccati equations instead.

    Examples
    --------
    >>> import numpy as np
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[1.0]], C=[[1], [1]], Bf=[[0]], Df=[[1], [0]], Bw=[[1, 0]], Dw=[[0, 0], [0, 1]], dt=1.0
    ... )
    >>> paper = obsynth.conditions.hinf_filter(plant, delay=0)
    >>> value = paper.problem.solve(solver="CLARABEL")
    >>> print(f"{paper.data['unit'][0, 0] * np.sqrt(value):.4f}")
    1.0000
    """
    options = {"delay": delay, "reference": reference, "exact": exact, "decoupled": decoupled}
    data, design, conditions = _problem(plant, options)
    P, Y, Z0 = _variables(data)
    level = cp.Variable(name="gamma_squared")
    positive, bounded = atoms.bounded_real(
        *_error(data, Z0),
        P,
        None,
        1.0,
        Y=Y,
        Cy=data["C"],
        Dy=data["D"],
        gamma_squared=level,
        detectable=True,
        margin=margin,
    )
    constraints = {"P > 0": positive, "bounded real": bounded}
    return Conditions(
        "Gahinet, Apkarian 1994: least gain of any causal filter",
        lmi.semidefinite_problem(cp.Minimize(level), list(constraints.values())),
        {"P": P, "Y": Y, "Z0": Z0, "gamma_squared": level},
        {},
        data,
        constraints,
        lambda: conditions,
        _gains,
        design,
    )


@arguments_checked
def h2_filter(
    plant: DescriptorSystem | Transformation,
    *,
    delay: Any = "auto",
    reference: Any = None,
    exact: bool = True,
    decoupled: Any = None,
    margin: float = lmi.MARGIN,
) -> Conditions:
    """Return the inequalities of the least mean square of any causal linear filter in P, Y, Z0 and Z.

    Parameters
    ----------
    plant : DescriptorSystem or Transformation
        Discrete time: in continuous time the transformation behind the data keeps no H2 norm.
    delay, reference, exact, decoupled
        What the filter must do, as for `obsynth.optimal_filter`; with ``delay="auto"`` the first delay that exists.
    margin : float, optional
        What the inequalities keep to the boundary of the cone.

    Returns
    -------
    Conditions
        As of `hinf_filter`, with ``Z (nw, nw)``; the root mean square is ``unit`` times the root of the trace of Z.

    Raises
    ------
    SpecError
        An option is malformed, or the plant is continuous.
    PreconditionError
        No causal filter has this fault map.

    Examples
    --------
    >>> import numpy as np
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[1.0]], C=[[1], [1]], Bf=[[0]], Df=[[1], [0]], Bw=[[1, 0]], Dw=[[0, 0], [0, 1]], dt=1.0
    ... )
    >>> paper = obsynth.conditions.h2_filter(plant, delay=0)
    >>> value = paper.problem.solve(solver="CLARABEL")
    >>> print(f"{paper.data['unit'][0, 0] * np.sqrt(value):.4f}")
    0.7862
    """
    if not linear_plant(plant).is_discrete:
        raise SpecError(
            "h2_filter is for discrete time: use obsynth.optimal_filter(norm='h2') for a continuous plant.",
            path="plant",
        )
    options = {"delay": delay, "reference": reference, "exact": exact, "decoupled": decoupled, "norm": "h2"}
    data, design, conditions = _problem(plant, options)
    P, Y, Z0 = _variables(data)
    Z = cp.Variable((data["B"].shape[1],) * 2, symmetric=True, name="Z")
    stable, covariance = atoms.h2(
        *_error(data, Z0), P, Z, 1.0, Y=Y, Cy=data["C"], Dy=data["D"], detectable=True, margin=margin
    )
    constraints = {"stable": stable, "covariance": covariance}
    return Conditions(
        "de Souza, Shaked 1999: least mean square of any causal linear filter",
        lmi.semidefinite_problem(cp.Minimize(cp.trace(Z)), list(constraints.values())),
        {"P": P, "Y": Y, "Z0": Z0, "Z": Z},
        {},
        data,
        constraints,
        lambda: conditions,
        _gains,
        design,
    )


def _problem(
    plant: DescriptorSystem | Transformation, options: dict[str, Any]
) -> tuple[dict[str, FloatArray], Any, Any]:
    """Return the data, how gains become a design, and the conditions that were examined."""
    white, resolved, unit = registered("problem_of_options")(linear_plant(plant).dense(), options)
    core = white.problem
    if not len(core.A) or not len(core.C):
        raise SpecError(
            "There is one filter with this fault map, and nothing to choose: obsynth.optimal_filter returns it.",
            path="plant",
        )
    data = {name: getattr(core, name) for name in ("A", "B", "C", "D", "L", "D1")}
    return data | {"unit": np.array([[unit]])}, design_of("optimal filter", plant, resolved), resolved[2]


def _variables(data: dict[str, FloatArray]) -> tuple[Any, Any, Any]:
    n, m, rows = len(data["A"]), len(data["C"]), len(data["L"])
    P = cp.Variable((n, n), symmetric=True, name="P")
    return P, cp.Variable((n, m), name="Y"), cp.Variable((rows, m), name="Z0")


def _error(data: dict[str, FloatArray], Z0: Any) -> tuple[Any, Any, Any, Any]:
    """Return the error of a filter with Z0, without K, which is in Y."""
    return data["A"], data["B"], data["L"] - Z0 @ data["C"], data["D1"] - Z0 @ data["D"]


def _gains(values: Values) -> dict[str, FloatArray]:
    return {"K": np.asarray(np.linalg.solve(values["P"], values["Y"]), dtype=np.float64), "Z0": values["Z0"]}

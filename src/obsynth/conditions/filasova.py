r"""Filasova, Krokavec, Serbak, Theorems 1 and 2: the PD observer (4)-(6) of states and slowly varying faults.

The paper's letters: ``q' = A q + B u + F f``, ``y = C q`` (1), (2); with the faults as states (31), (32)
``A_o = [A F; 0 0]``, ``C_o = [C 0]``, ``J_o = [J; M]``, ``L_o = [L; N]``.  Theorem 1:

.. math::
    P_1 > 0 \tag{40}, \qquad
    \begin{bmatrix} A_o^T P_3 + P_3^T A_o - Y C_o - C_o^T Y^T & * \\ V_{21} & V_{22} \end{bmatrix} < 0 \tag{41}
.. math::
    V_{21} = P_1 - P_3 + \delta P_3^T A_o - \delta Y C_o - C_o^T Z^T \tag{42}
.. math::
    V_{22} = -\delta P_3 - \delta P_3^T - \delta Z C_o - \delta C_o^T Z^T \tag{43}
.. math::
    J_o = (P_3^T)^{-1} Y, \qquad L_o = (P_3^T)^{-1} Z \tag{44}

Theorem 2 is the same with a symmetric ``P3 = Q > 0`` (61)-(65).  As printed, nothing keeps P3 from singular: solvers
return gains of 1e9 (Theorem 1, delta = 1).  ``reading="safe"`` adds ``P3 + P3' >= 2 I``, which fixes the scale, and
minimises ``||[Y Z]|| + ||P3||``.  It has a solution wherever (40)-(43) have one (L = 0 makes ``P3 + P3' > 0`` of them),
not with all the same gains: the printed ones satisfy the printed reading alone.
Beyond the paper: outputs that show faults directly, ``C_o = [C Df]``; algebraic states are eliminated.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from obsynth.analysis.existence.filasova import explicit_form, pd_observer_conditions
from obsynth.conditions import lazy_cvxpy as cp
from obsynth.conditions import lmi
from obsynth.conditions.problem import Conditions, Values, design_of, require_data
from obsynth.errors import SpecError
from obsynth.numerics.arguments import arguments_checked, chosen, is_finite_number, shown
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.regions import LMIRegion, checked_region
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.transformations.delays import linear_plant
from obsynth.plants.transformations.recovery import Transformation

#: Conditions whose failure leaves an inequality that no matrices satisfy.
DECIDED_BY_THE_PD_INEQUALITY = ("nf <= ny", "rank F", "detectability", "rank [A F; C Df]")

#: How far inside the cone the inequalities must hold, with ``P3 + P3' >= 2 I`` as the scale.
PD_MARGIN = 1e-3


@arguments_checked
def filasova_theorem1(
    plant: DescriptorSystem | Transformation,
    *,
    delta: float,
    reading: str = "safe",
    decay: float = 0.0,
    region: LMIRegion | None = None,
    margin: float = PD_MARGIN,
) -> Conditions:
    """Return Theorem 1 of Filasova, Krokavec and Serbak: (40)-(43) in P1, P3, Y, Z.

    Parameters
    ----------
    plant : DescriptorSystem or Transformation
        Continuous time: ``A (nx, nx)``, ``C (ny, nx)``, ``Bf (nx, nf)`` (the paper's F); n = nx + nf below.
    delta : float, seconds
        The theorem's parameter, above zero.
    reading : {"safe", "printed"}, optional
        ``"printed"`` asks for (40)-(43) alone; ``"safe"`` keeps P3 from singular and minimises the gains.
    decay : float, optional, 1/seconds
        Errors decay at least like ``exp(-decay t)``: (41) for ``A_o + decay I``, and ``J_o = J' + decay L_o``.
    region : LMIRegion, optional
        Where all eigenvalues of the error system must lie (1/s): the constraint ``"region"``, with a P of its own.
    margin : float, optional
        What the inequalities keep to the boundary of the cone.

    Returns
    -------
    Conditions
        Variables ``P1 (n, n)`` symmetric, ``P3 (n, n)``, ``Y, Z (n, ny)``; data ``A_o, C_o``; constraints ``"(40)"``,
        ``"(41)"`` and, where safe, ``"scale"``; gains ``J, L (nx, ny)``, ``M, N (nf, ny)``.

    Raises
    ------
    SpecError
        An option is out of range.
    PreconditionError
        A discrete plant, no faults, or algebraic states that cannot be eliminated.

    References
    ----------
    .. [Filasova] Application of descriptor approaches in design of PD observer-based actuator fault estimation,
       Theorem 1, eqs. (40)-(44).

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(A=[[-1.0, 0.5], [0.0, -2.0]], C=[[1, 0], [0, 1]], Bf=[[1], [0]])
    >>> paper = obsynth.conditions.filasova_theorem1(plant, delta=0.1)
    >>> _ = paper.problem.solve()
    >>> paper.problem.status, sorted(paper.gains())
    ('optimal', ['J', 'L', 'M', 'N'])
    """
    return _theorem(plant, 1, delta, reading, decay, margin, region)


@arguments_checked
def filasova_theorem2(
    plant: DescriptorSystem | Transformation,
    *,
    delta: float,
    reading: str = "safe",
    decay: float = 0.0,
    region: LMIRegion | None = None,
    margin: float = PD_MARGIN,
) -> Conditions:
    """Return Theorem 2 of Filasova, Krokavec and Serbak: (61)-(64) in P1 (the paper's P), P3 (its Q), Y, Z.

    Parameters
    ----------
    plant : DescriptorSystem or Transformation
        As for `filasova_theorem1`.
    delta : float, seconds
        The theorem's parameter, above zero; a large one may make it infeasible.
    reading : {"safe", "printed"}, optional
        As for `filasova_theorem1`; both take P and Q as variables, as the proof does.
    decay : float, optional, 1/seconds
        As for `filasova_theorem1`.
    region : LMIRegion, optional
        Where all eigenvalues of the error system must lie (1/s): the constraint ``"region"``, with a P of its own.
    margin : float, optional
        What the inequalities keep to the boundary of the cone.

    Returns
    -------
    Conditions
        As for `filasova_theorem1`, with a symmetric ``P3``; constraints ``"(61) P"``, ``"(61) Q"``, ``"(62)"``.  Its
        ``design()`` verifies the gains, and claims Theorem 1 of them; `obsynth.pd_observer` claims Theorem 2.

    Raises
    ------
    SpecError
        An option is out of range.
    PreconditionError
        A discrete plant, no faults, or algebraic states that cannot be eliminated.

    References
    ----------
    .. [Filasova] Application of descriptor approaches in design of PD observer-based actuator fault estimation,
       Theorem 2, eqs. (61)-(65).

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(A=[[-1.0, 0.5], [0.0, -2.0]], C=[[1, 0], [0, 1]], Bf=[[1], [0]])
    >>> paper = obsynth.conditions.filasova_theorem2(plant, delta=0.1)
    >>> _ = paper.problem.solve()
    >>> paper.problem.status, sorted(paper.gains())
    ('optimal', ['J', 'L', 'M', 'N'])
    """
    return _theorem(plant, 2, delta, reading, decay, margin, region)


def _theorem(
    plant: DescriptorSystem | Transformation,
    theorem: int,
    delta: Any,
    reading: Any,
    decay: Any,
    margin: float,
    region: LMIRegion | None,
) -> Conditions:
    for name, number, least in (("delta", delta, "above 0"), ("decay", decay, "at least 0")):
        if not is_finite_number(number) or number < 0.0 or (name == "delta" and number == 0.0):
            raise SpecError(f"{name} is {shown(number)}: give a number {least}.", path=name)
    safe = chosen(reading, "reading", ("safe", "printed")) == "safe"
    own = linear_plant(plant)
    conditions = pd_observer_conditions(own)
    require_data(conditions, solvers=DECIDED_BY_THE_PD_INEQUALITY)
    form = explicit_form(own.dense())
    work = own.dense() if form is None else form.plant
    A_o, C_o = _augmented(work)
    n, m, nx = len(A_o), work.ny, work.nx
    Ad = A_o + decay * np.eye(n)

    P1 = cp.Variable((n, n), symmetric=True, name="P1")
    P3 = cp.Variable((n, n), symmetric=theorem == 2, name="P3")
    Y, Z = cp.Variable((n, m), name="Y"), cp.Variable((n, m), name="Z")
    V11 = Ad.T @ P3 + P3.T @ Ad - Y @ C_o - C_o.T @ Y.T
    V21 = P1 - P3 + delta * P3.T @ Ad - delta * Y @ C_o - C_o.T @ Z.T  # (42), (63)
    V22 = -delta * P3 - delta * P3.T - delta * Z @ C_o - delta * C_o.T @ Z.T  # (43), (64)
    variables = {"P1": P1, "P3": P3, "Y": Y, "Z": Z}
    names = ("(40)", "(41)") if theorem == 1 else ("(61) P", "(62)")
    constraints = {
        names[0]: lmi.at_least(P1, margin),
        names[1]: lmi.at_most(lmi.symmetric_blocks([[V11], [V21, V22]]), -margin),
    }
    if theorem == 2:
        constraints["(61) Q"] = lmi.at_least(P3, margin)
    if region is not None:
        moving, still = P3.T @ A_o - (Y + decay * Z) @ C_o, P3.T + Z @ C_o  # P3' (A_o - J_o C_o), P3' (I + L_o C_o)
        P = variables["P_region"] = cp.Variable((n, n), symmetric=True, name="P_region")
        constraints["region"] = _region(_fitting_region(region, float(delta)), P, moving, still, float(delta), margin)
    if safe:
        constraints["scale"] = lmi.at_least(P3 + P3.T, 2.0)
    size = cp.norm(cp.hstack([Y, Z]), "fro") + cp.norm(P3, "fro")
    goal = cp.Minimize(size if safe else 0)

    def gains(values: Values) -> dict[str, FloatArray]:
        J_o, L_o = (np.linalg.solve(values["P3"].T, values[name]) for name in "YZ")  # (44), (65)
        J_o = J_o + decay * L_o
        return {"J": J_o[:nx], "L": L_o[:nx], "M": J_o[nx:], "N": L_o[nx:]}

    return Conditions(
        f"Filasova, Krokavec, Serbak, Theorem {theorem}, {names[0]}-({43 if theorem == 1 else 64}), {reading}",
        lmi.semidefinite_problem(goal, list(constraints.values())),
        variables,
        {},
        {"A_o": A_o, "C_o": C_o},
        constraints,
        lambda: conditions,
        gains,
        design_of("filasova", plant, float(decay)),
    )


def _fitting_region(region: Any, delta: float) -> LMIRegion:
    """Return a region that holds ``-1 / delta``, without which its inequality has no solution."""
    where = checked_region(region)
    if not where.contains([-1.0 / delta]):
        raise SpecError(
            f"delta is {delta:g}, and -1 / delta = {-1.0 / delta:g} lies outside {where}: no P satisfies both. Choose "
            "delta so that -1 / delta lies inside.",
            path="delta",
        )
    return where


def _region(where: LMIRegion, P: Any, moving: Any, still: Any, delta: float, margin: float) -> Any:
    """Return the inequality of a region for the pencil ``Ae - s D``, with ``moving = P3' Ae``, ``still = P3' D``.

    ``[L x P, M x P; M' x P, 0] + He([I x Ae'; -I x D'] (I x P3) [I, delta I]) < 0`` with a P of its own: with
    ``(Ae - s D) x = 0`` the vector ``[v x x; s v x x]`` makes ``(v* (L + s M + conj(s) M') v) x* P x < 0`` of it.
    """
    n, k = still.shape[0], len(where.L)
    moving_k, still_k = cp.kron(np.eye(k), moving), cp.kron(np.eye(k), still)
    inequality = lmi.symmetric_blocks(
        [
            [cp.kron(where.L, P) + moving_k + moving_k.T],
            [cp.kron(where.M.T, P) + delta * moving_k - still_k.T, -delta * (still_k + still_k.T)],
        ]
    )
    # P > 0 follows where L < 0 does not; asked for in the same block, so that it is one constraint.
    zero = np.zeros((n, 2 * k * n))
    return lmi.at_most(cp.bmat([[inequality, zero.T], [zero, -P]]), -margin)


def _augmented(plant: DescriptorSystem) -> tuple[FloatArray, FloatArray]:
    """Return ``A_o = [A F; 0 0]`` and ``C_o = [C Df]`` (31), (32)."""
    nf = plant.nf
    below = np.zeros((nf, plant.nx + nf))
    return np.vstack([np.hstack([plant.A, plant.Bf]), below]), np.hstack([plant.C, plant.Df])

r"""Inequalities for faults whose direction changes with the scheduling, decoupled by a correction; two vertices.

With constant ``T E + N C = I`` and ``xhat = z + N y``, corrected at once by ``K(mu) (y - C xhat)`` where z was formed
with the same mu, the corrected error obeys

.. math::
    \epsilon^+ = (I - K(\mu) C) (T A(\mu) \epsilon + T B_d(\mu) d), \qquad K(\mu) C T B_f(\mu) = T B_f(\mu),

so that no fault has an effect on it, whatever its direction does.  Every matrix belongs to one sample.  With
``Y = P K`` linear in the weights both are linear in (P, Y):

.. math::
    Y_i C T B_{f,j} + Y_j C T B_{f,i} = P T (B_{f,i} + B_{f,j}), \qquad
    \begin{bmatrix} r^2 P & M_{ij}^T P \\ * & P \end{bmatrix} > 0, \quad
    P M_{ij} = \tfrac12 ((P - Y_i C) T A_j + (P - Y_j C) T A_i)

for i <= j: weights ``mu_i mu_j`` make every point of these pairs.  The equations leave freedom only where there are
more outputs than faults and their turns need; otherwise `obsynth.ui_pi_observer` takes such a plant.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from obsynth.analysis.existence.restricted_equivalent import prepare
from obsynth.analysis.existence.turning_filter import correction_equations
from obsynth.conditions import lazy_cvxpy as cp
from obsynth.conditions import lmi
from obsynth.conditions.polytope import MOST_ROOM, TRACE
from obsynth.conditions.problem import Conditions, Values
from obsynth.errors import PreconditionError, SpecError
from obsynth.numerics.arguments import arguments_checked, require_kind, require_shape, shown
from obsynth.numerics.arrays import FloatArray, as_matrix
from obsynth.numerics.ranks import RANK_TOLERANCE
from obsynth.plants.polytopic import PolytopicSystem
from obsynth.results.design import ObserverDesign
from obsynth.verification.error_polytope import ErrorPolytope

#: Pairs of two vertices: more of them are not tried, and not proved.
VERTICES = 2


@arguments_checked
def turning_faults(plant: PolytopicSystem, *, decay: float = 1.0) -> Conditions:
    """Return the inequalities of a correction that turns with the faults, in P and Y.

    Parameters
    ----------
    plant : PolytopicSystem
        Two vertices, discrete in time, with the same C and without Df, D of any kind.
    decay : float, optional
        Factor a sample by which corrected errors shrink at least, in the norm of P.

    Returns
    -------
    Conditions
        Variables ``P``, ``Y[1]``, ``Y[2]`` and ``room``, which is positive where there is such a correction; gains
        ``T``, ``N``, ``K[1]``, ``K[2]`` and ``P``.  `turning_errors` has the error system of these, for a proof.

    Raises
    ------
    SpecError
        Another number of vertices, or a decay that is none.
    PreconditionError
        The plant is continuous, its outputs change or see faults at once, or ``C T Bf`` loses rank at a vertex.

    Examples
    --------
    >>> plant = PolytopicSystem(
    ...     plant={
    ...         "A": [[0.9, 0, "0.1 * v"], [0, 0.7, 0], [0.1, 0, 0.8]], "C": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    ...         "Bf": [["1 - v"], ["v"], [0.3]], "dt": 1.0,
    ...     },
    ...     scheduling={"v": [0.0, 1.0]},
    ... )
    >>> found = turning_faults(plant)
    >>> _ = found.solve()
    >>> bool(found.variables["room"].value > 1e-6)
    True
    """
    require_kind(plant, PolytopicSystem, "plant", "a PolytopicSystem")
    if not 0.0 < decay <= 1.0:
        raise SpecError(f"decay is {shown(decay)}: give a factor a sample, above 0, to 1.", path="decay")
    T, N = _constant_parts(plant)
    n, m, C = plant.nx, plant.ny, plant.vertices[0].C
    TA, TB = ([T @ getattr(vertex, name) for vertex in plant.vertices] for name in ("A", "Bf"))
    P, room = cp.Variable((n, n), symmetric=True, name="P"), cp.Variable(name="room")
    Y = [cp.Variable((n, m), name=f"Y[{i + 1}]") for i in range(VERTICES)]
    constraints: dict[str, Any] = {"P": lmi.at_least(P, room), "trace": cp.trace(P) <= TRACE * n}
    constraints["room"] = room <= MOST_ROOM
    for i in range(VERTICES):
        for j in range(i, VERTICES):
            name = f"[{i + 1},{j + 1}]"
            constraints[f"decoupled{name}"] = Y[i] @ (C @ TB[j]) + Y[j] @ (C @ TB[i]) == P @ (TB[i] + TB[j])
            moved = 0.5 * ((P - Y[i] @ C) @ TA[j] + (P - Y[j] @ C) @ TA[i])
            constraints[f"stable{name}"] = lmi.at_least(lmi.symmetric_blocks([[decay**2 * P], [moved, P]]), room)

    def gains(_: Values) -> dict[str, FloatArray]:
        P_value = np.asarray(P.value)
        P_value = 0.5 * (P_value + P_value.T)
        K = _exactly_decoupled([np.linalg.solve(P_value, np.asarray(y.value)) for y in Y], C, TB)
        return {"T": T, "N": N, "P": P_value} | {f"K[{i + 1}]": each for i, each in enumerate(K)}

    def unsupported(_: dict[str, FloatArray], name: str) -> ObserverDesign:
        raise SpecError(
            f"{name!r}: these gains are not shipped as they are; obsynth.fault_estimation_filter(plant) ships such a "
            "correction with its proof.",
            path="plant",
        )

    return Conditions(
        "exact decoupling of faults that turn, two vertices",
        lmi.semidefinite_problem(cp.Maximize(room), list(constraints.values())),
        {"P": P, "Y[1]": Y[0], "Y[2]": Y[1], "room": room},
        {},
        {"T": T, "N": N} | {f"TA[{i + 1}]": each for i, each in enumerate(TA)},
        constraints,
        tuple,
        gains,
        unsupported,
    )


@dataclass(frozen=True, eq=False)
class TurningErrors:
    """The corrected errors of gains that turn.

    Parameters
    ----------
    errors : ErrorPolytope
        Three vertices, of weights ``mu_1^2``, ``2 mu_1 mu_2``, ``mu_2^2``: closed already, with no gain to add.
    leak : float
        Largest entry of ``(I - K C) T Bf`` over the pairs, beside the largest of ``T Bf``.
    """

    errors: ErrorPolytope
    leak: float


@arguments_checked
def turning_errors(plant: PolytopicSystem, gains: Mapping[str, FloatArray]) -> TurningErrors:
    """Return the error system of gains of `turning_faults`, recomputed from the plant.

    Parameters
    ----------
    plant : PolytopicSystem
        Two vertices.
    gains : mapping
        ``T (nx, nx)``, and ``K[1]`` and ``K[2]`` ``(nx, ny)``.

    Returns
    -------
    TurningErrors
        The error system, and how much of the faults its correction leaves in the errors.

    Raises
    ------
    SpecError
        Another kind of plant or gains, another number of vertices, gains of other sizes, or a T without an N.
    PreconditionError
        The plant is continuous, its outputs change, or they see faults or disturbances at once.

    Examples
    --------
    >>> plant = PolytopicSystem(
    ...     plant={"A": [[0.9, 0], [0, "0.5 * v"]], "C": [[1, 0], [0, 1]], "Bf": [["1 - v"], ["v"]], "dt": 1.0},
    ...     scheduling={"v": [0.0, 1.0]},
    ... )
    >>> all_measured = {"T": 0.5 * np.eye(2), "K[1]": np.eye(2), "K[2]": np.eye(2)}
    >>> made = turning_errors(plant, all_measured)
    >>> made.errors.count, made.leak
    (3, 0.0)
    """
    require_kind(plant, PolytopicSystem, "plant", "a PolytopicSystem")
    require_kind(gains, Mapping, "gains", "what gains() of turning_faults returns")
    _require_fitting(plant)
    T, *K = (_gain(gains, name, plant) for name in ("T", "K[1]", "K[2]"))
    C, eye = plant.vertices[0].C, np.eye(plant.nx)
    rest = eye - T @ plant.vertices[0].E
    missed = rest - rest @ np.linalg.pinv(C) @ C
    if not np.abs(missed).max(initial=0.0) <= RANK_TOLERANCE * max(1.0, float(np.abs(rest).max(initial=0.0))):
        raise SpecError("T: no N has T E + N C = I with it: take T of turning_faults.", path="T")
    A: list[FloatArray] = []
    leaks: list[float] = []
    largest = max(float(np.abs(T @ vertex.Bf).max(initial=0.0)) for vertex in plant.vertices)
    for i in range(VERTICES):
        for j in range(i, VERTICES):
            one, other = plant.vertices[i], plant.vertices[j]
            A.append(0.5 * ((eye - K[i] @ C) @ T @ other.A + (eye - K[j] @ C) @ T @ one.A))
            effects = 0.5 * ((eye - K[i] @ C) @ T @ other.Bf + (eye - K[j] @ C) @ T @ one.Bf)
            leaks.append(float(np.abs(effects).max(initial=0.0)))
    errors = ErrorPolytope(A, np.zeros((0, plant.nx)), dt=plant.dt)
    return TurningErrors(errors, max(leaks) / largest if largest else 0.0)


def _gain(gains: Mapping[str, FloatArray], name: str, plant: PolytopicSystem) -> FloatArray:
    """Return a gain, which must be there and have its size."""
    if name not in gains:
        raise SpecError(f"{name} is missing: give T, K[1] and K[2].", path="gains")
    gain = as_matrix(gains[name], name)
    require_shape(gain.shape, (plant.nx, plant.nx if name == "T" else plant.ny), name)
    return gain


def _require_fitting(plant: PolytopicSystem) -> None:
    """Raise where the error system of these gains is another one: the plant has two vertices and constant outputs."""
    if plant.count != VERTICES:
        raise SpecError(
            f"Exact decoupling of faults that turn is proved for two vertices, there are {plant.count}: take "
            "obsynth.ui_pi_observer, which estimates faults that follow a model.",
            path="plant",
        )
    changing = not plant.is_constant("C") or any(np.any(getattr(v, k)) for v in plant.vertices for k in ("Df", "Dd"))
    if not plant.is_discrete or changing:
        raise PreconditionError(
            "Exact decoupling of faults that turn is for discrete time, with the same C at both vertices and without "
            "Df and Dd.",
            condition="faults that turn",
        )


def _constant_parts(plant: PolytopicSystem) -> tuple[FloatArray, FloatArray]:
    """Return T and N, after what the plant must be."""
    _require_fitting(plant)
    first, prepared = plant.vertices[0], prepare(plant.center, exactly=False)
    states = prepared.scaling.states[:, None]
    T = states * prepared.T * prepared.scaling.equations
    for vertex in plant.vertices:
        if np.linalg.matrix_rank(first.C @ T @ vertex.Bf) < plant.nf:
            raise PreconditionError(
                "C T Bf loses rank at a vertex: a fault reaches the outputs later than after one sample there.",
                condition="one sample to the outputs",
            )
    return T, states * prepared.N * prepared.scaling.outputs


def _exactly_decoupled(K: list[FloatArray], C: FloatArray, TB: list[FloatArray]) -> list[FloatArray]:
    """Return the nearest gains that satisfy the equations to rounding: a solver satisfies them to its tolerances."""
    m = K[0].shape[1]
    W, target = correction_equations(C, TB)
    whole = np.hstack(K)
    whole = whole - (whole @ W - target) @ np.linalg.pinv(W)
    whole = whole - (whole @ W - target) @ np.linalg.pinv(W)
    return [whole[:, :m], whole[:, m:]]

r"""Wang, Rodrigues, Theilliol, Shen 2015, Theorem 2: the fault-estimation filter (23) by the inequality (45).

The paper's letters: ``E x(k+1) = A x(k) + B u(k) + F n(k) + D w(k)``, ``y(k) = C x(k)`` (1).

.. math::
    \begin{bmatrix} -P + (\Upsilon^+ C)^T (\Upsilon^+ C) & 0 & A_1^T P - C_1^T Y^T \\ * & -\gamma^2 I & (TD)^T P \\
    * & * & -P \end{bmatrix} < 0 \tag{45}

Beyond the paper: W may be any left inverse of Upsilon, or a variable; feedthrough of the disturbance (``Dd``) enters
``T D - T A N Dd - L (I - C N) Dd`` and ``W (I - C N) Dd``; faults in outputs (``Df``) are appended to the state.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from obsynth.analysis.existence.condition import Condition
from obsynth.analysis.existence.detectability_indexes import exact_indexes, fault_detectability
from obsynth.analysis.existence.restricted_equivalent import (
    prepare,
    restricted_equivalent_from,
    with_sensor_faults_as_states,
)
from obsynth.analysis.existence.wang2015 import examine_fault_filter
from obsynth.conditions import atoms, lmi
from obsynth.conditions import lazy_cvxpy as cp
from obsynth.conditions.gamma_lower_bound import proved_lower_bound
from obsynth.conditions.lmi import MARGIN
from obsynth.conditions.problem import Conditions, Values, design_of, require_data
from obsynth.conditions.wang_over_region import wang_over_region
from obsynth.errors import SpecError
from obsynth.numerics.arguments import arguments_checked, chosen, real_number, require_shape
from obsynth.numerics.arrays import FloatArray, as_matrix, identity_missed, require_no_overflow
from obsynth.numerics.central_filter import search_least_gain
from obsynth.numerics.injection_problem import GainProblem, normalise, null_basis
from obsynth.numerics.invariant_zeros import is_outside
from obsynth.numerics.norms import hinf_norm
from obsynth.numerics.outward import lower_text
from obsynth.numerics.ranks import HIDDEN_MODE_TOLERANCE, RANK_TOLERANCE, decide_rank
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.polytopic import PolytopicSystem
from obsynth.plants.transformations.delays import linear_plant
from obsynth.plants.transformations.recovery import Transformation

if TYPE_CHECKING:
    from obsynth.conditions.semidefinite_problem import SmallerProblem

#: What a design claims above the true norm of its filter, tried in turn until the proof goes through.
CLAIMED_ABOVE_NORM = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2)


@arguments_checked
def wang2015(
    plant: DescriptorSystem | PolytopicSystem | Transformation,
    *,
    gamma: float | None = None,
    S: ArrayLike | None = None,
    T: ArrayLike | None = None,
    N: ArrayLike | None = None,
    W: ArrayLike | str | None = None,
    coordinates: str = "plant",
    margin: float = MARGIN,
) -> Conditions:
    r"""Return Theorem 2 of Wang et al. 2015: the inequality (45) in P and Y.

    Parameters
    ----------
    plant : DescriptorSystem, PolytopicSystem or Transformation
        Discrete time; of a PolytopicSystem (45) stands at every vertex, ``"(45)[1]"``, ..., with one P and ``Y[1]``,
        ...: ``E (nx, nx)``, ``C (ny, nx)``, ``Bf (nx, nf)`` (the paper's F), ``Bd (nx, nd)`` (its D).
    gamma : float, optional, dimensionless
        A given level: is (45) feasible?  It is then the parameter ``gamma_squared``, for a bisection.  By default
        gamma squared is a variable, and minimised.
    S : array_like, optional
        The free matrix ``(nx, nx + ny)`` of (17); by default T is nonsingular by construction.
    T, N : array_like, optional
        ``(nx, nx)`` and ``(nx, ny)`` with ``T E + N C = I`` (7), instead.
    W : array_like or "free", optional
        Residual weight ``(nf, ny)`` with ``W Upsilon = I``; ``Upsilon^+`` of (47) by default; a variable with "free".
    coordinates : {"plant", "balanced"}, optional
        In which states P and Y are written: the plant's; or ``X^-1 e`` of the error e, with the change from the gain
        ``R0`` of a Riccati filter instead of R, w in units of that filter's gamma, and as many rows of C1 as there are
        measurements that no fault reaches.  The problem is the same, and solvers find more digits of its optimum.
    margin : float, optional
        What (45) keeps to the boundary of the cone.

    Returns
    -------
    Conditions
        Variables ``P``, ``Y``, ``gamma_squared``, and ``W`` where it is free; data ``T, N, Psi, Upsilon, A1, C1, TD``
        and ``W``; constraints ``"P"`` and ``"(45)"``, and where ``existence`` fails for a mode that neither the outputs
        nor the estimates show, two by which some gain makes the errors stable, with a Q of their own; gains
        ``T, N, L, W, Psi, Upsilon, R``.

    Raises
    ------
    SpecError
        A matrix has the wrong shape, ``T E + N C`` or ``W Upsilon`` is not the identity.
    PreconditionError
        The data of (45) do not exist: ``rank [E; C] < nx`` (2), or ``rank Upsilon < nf`` (Theorem 2 (i)).

    Notes
    -----
    ``problem.solve()``, without a solver or settings, solves the inequality without Y (projection lemma), of half its
    size, and takes the solution where it keeps (45) as well; there are no dual values then.  Problems of ``changed``,
    or with a margin of your own, are solved as they are written.

    Below the least gamma an interior-point solver may stall rather than say infeasible; one of first order (SCS) says
    so, and so do the others with a bound, ``changed(constraints={"bound": cvxpy.trace(P) <= 1e4})``.

    (48) has the sign of its second term wrong; L is that of (60).  The paper does not say that a zero from the faults
    to the outputs on or outside the unit circle makes (45) infeasible: ``existence`` does.

    References
    ----------
    .. [Wang2015] Fault estimation filter design for discrete-time descriptor systems, IET Control Theory Appl. 9 (10).

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]], C=[[1, 0], [0, 1]], Bf=[[1], [0]], Bd=[[0], [1]], dt=1.0
    ... )
    >>> paper = obsynth.conditions.wang2015(plant, coordinates="balanced")
    >>> _ = paper.problem.solve()
    >>> paper.problem.status, sorted(paper.variables)
    ('optimal', ['P', 'Y', 'gamma_squared'])
    """
    if isinstance(plant, PolytopicSystem):
        if any(value is not None for value in (S, T, N, W)) or coordinates != "plant":
            raise SpecError("Over a region there are gamma and margin: leave S, T, N, W and coordinates out.", path="W")
        return wang_over_region(plant, gamma=gamma, margin=margin)
    own = linear_plant(plant).dense()
    existence, _ = examine_fault_filter(own)
    require_data(existence, solvers=("fault zeros",))
    data = _paper_data(own, S, T, N, W)
    convex = data.gain_problem(free_weight=isinstance(W, str))
    chosen(coordinates, "coordinates", ("plant", "balanced"))
    written = _balanced_form(data, convex) if coordinates == "balanced" else _plant_form(data)

    n, q, m = len(data.A1), *data.W.shape
    P, Y = cp.Variable((n, n), symmetric=True, name="P"), cp.Variable((n, len(written.C1)), name="Y")
    gamma_squared = _gamma_squared(gamma)
    variables: dict[str, Any] = {"P": P, "Y": Y} | ({"gamma_squared": gamma_squared} if gamma is None else {})
    weight: Any = data.W
    if convex.free_weight:  # every left inverse of Upsilon
        Vw = cp.Variable((q, m - q), name="Vw") if m > q else np.zeros((q, 0))
        variables |= {"Vw": Vw} if m > q else {}
        weight = data.W + Vw @ data.V.T
    constraints = _constraints_45(data, written, (P, Y, gamma_squared), weight, margin, free=convex.free_weight)
    every_condition_holds = all(condition.holds for condition in existence)
    if not every_condition_holds and _hides_a_mode(written.A1, np.vstack([written.C1, data.W @ data.C @ written.X])):
        # Any solver's tolerance admits a P that is zero in a mode that no gain moves: demand a stabilising gain.
        positive, stable = atoms.some_gain_stabilises(written.A1, 1.0, written.C1)
        constraints |= {"Q": positive, "some gain is stable": stable}

    goal = cp.Minimize(gamma_squared if gamma is None else 0)
    # A margin of the user's is one in these coordinates; where a condition fails the smaller problem has no solution.
    level = None if gamma is None else gamma_squared
    has_smaller = margin == MARGIN and every_condition_holds
    smaller = partial(_without_gain, data, written, convex, variables, level) if has_smaller else None
    return Conditions(
        "Wang et al. 2015, Theorem 2, (45)",
        lmi.semidefinite_problem(goal, list(constraints.values()), smaller=smaller),
        variables,
        {} if gamma is None else {"gamma_squared": gamma_squared},
        _named_data(data, written),
        constraints,
        partial(_existence, existence, convex, gamma),
        partial(_gains, data, written),
        design_of("wang2015", plant, convex),
        weight=weight if convex.free_weight else None,
    )


def _gains(data: _PaperData, written: _WrittenForm, values: Values) -> dict[str, FloatArray]:
    """Return the gains of (23) from the values of P and Y, and of ``Vw`` where the weight is free."""
    R = written.R0 + written.X @ np.linalg.solve(values["P"], values["Y"]) @ written.innovation_rows  # (63)
    W = data.W + values["Vw"] @ data.V.T if "Vw" in values else data.W
    L = data.L0 + R  # (60)
    return {"T": data.T, "N": data.N, "L": L, "W": W, "Psi": data.Psi, "Upsilon": data.Upsilon, "R": R}


def _without_gain(
    data: _PaperData, written: _WrittenForm, convex: GainProblem, variables: dict[str, Any], level: Any
) -> SmallerProblem:
    """Return the inequality without Y (projection lemma), of half the size; ``level``: a given gamma squared."""
    from obsynth.conditions.wang_without_gain import WrittenIn, wang_without_gain

    form = WrittenIn(written.X, written.R0, written.innovation_rows, data.V)
    return wang_without_gain(convex, variables, level, form)


@dataclass(frozen=True, eq=False)
class _PaperData:
    """The data of (45), in the plant's states; L0 is that of (60) without R, V a basis of ``V' Upsilon = 0``."""

    T: FloatArray
    N: FloatArray
    Psi: FloatArray
    Upsilon: FloatArray
    W: FloatArray
    V: FloatArray
    L0: FloatArray
    C: FloatArray
    A1: FloatArray
    C1: FloatArray
    TD: FloatArray
    innovation_d: FloatArray  # (I - C N) Dd: zero in the paper, as D1 and W innovation_d
    unweighted: FloatArray  # I - Upsilon W

    def gain_problem(self, *, free_weight: bool) -> GainProblem:
        """Return the filter's error with R as an injection from ``V' y``."""
        n, (m, q) = len(self.A1), self.Upsilon.shape
        return GainProblem(
            A=self.A1,
            C=self.V.T @ self.C,
            Z=self.W @ self.C,
            B=self.TD,
            D=self.V.T @ self.innovation_d,
            Zd=self.W @ self.innovation_d,
            Bn=np.zeros((n, m - q)),
            Dn=-np.eye(m - q),
            Zn=np.zeros((q, m - q)),
            free_weight=free_weight,
        )


def _paper_data(plant: DescriptorSystem, S: Any, T: Any, N: Any, W: Any) -> _PaperData:
    """Return the data of (45) from the paper's (7), (16)-(20) and (46)-(47)."""
    work = with_sensor_faults_as_states(plant)
    A, C, F, D = work.A, work.C, work.Bf, work.Bd
    T, N = _restricted_equivalent(plant, work, S, T, N)  # (7), (16)-(17)
    TA, TF = T @ A, T @ F
    Psi = _psi(plant, TA, C, TF)  # (20)
    Upsilon = C @ Psi
    W0 = _left_inverse(W, Upsilon)  # (47)
    L0 = TA @ Psi @ W0
    unweighted = np.eye(work.ny) - Upsilon @ W0  # I - Upsilon Upsilon^+
    innovation_d = (np.eye(work.ny) - C @ N) @ work.Dd
    return _PaperData(
        T=T,
        N=N,
        Psi=Psi,
        Upsilon=Upsilon,
        W=W0,
        V=null_basis(Upsilon.T),
        L0=L0,
        C=C,
        A1=TA - L0 @ C,  # (46)
        C1=unweighted @ C,  # (46)
        TD=T @ D - TA @ (N @ work.Dd) - L0 @ innovation_d,
        innovation_d=innovation_d,
        unweighted=unweighted,
    )


@dataclass(frozen=True, eq=False)
class _WrittenForm:
    """The data of (45) for the error ``X xi`` and gain ``R = R0 + X P^-1 Y innovation_rows``, w in units ``unit``."""

    X: FloatArray
    R0: FloatArray
    innovation_rows: FloatArray
    unit: float
    A1: FloatArray
    C1: FloatArray
    TD: FloatArray
    D1: FloatArray


def _plant_form(data: _PaperData) -> _WrittenForm:
    """Return the data as the paper writes them."""
    X, R0 = as_matrix(np.eye(len(data.A1)), "X"), np.zeros_like(data.L0)
    D1 = data.unweighted @ data.innovation_d
    return _WrittenForm(X, R0, data.unweighted, 1.0, data.A1, data.C1, data.TD, D1)


def _balanced_form(data: _PaperData, convex: GainProblem) -> _WrittenForm:
    """Return the data in the coordinates of a Riccati filter, R counted from its gain, w in units of its level."""
    start = search_least_gain(convex)
    normalised = normalise(convex, start=start.injection, gain=start.gain or None)
    X, rows, unit = normalised.states, normalised.measurements @ data.V.T, normalised.gain or 1.0
    R0 = start.injection.R @ data.V.T
    return _WrittenForm(
        X,
        R0,
        rows,
        unit,
        A1=np.asarray(np.linalg.solve(X, (data.A1 - R0 @ data.C) @ X)),
        C1=rows @ data.C @ X,
        TD=np.asarray(np.linalg.solve(X, data.TD - R0 @ data.innovation_d) / unit),
        D1=rows @ data.innovation_d / unit,
    )


def _named_data(data: _PaperData, written: _WrittenForm) -> dict[str, FloatArray]:
    """Return the data by the names that `Conditions` lists."""
    named = {"T": data.T, "N": data.N, "Psi": data.Psi, "Upsilon": data.Upsilon, "W": data.W}
    named |= {"A1": written.A1, "C1": written.C1, "TD": written.TD, "L0": data.L0, "D1": written.D1}
    return named | {"X": written.X, "R0": written.R0, "rest": written.innovation_rows}


def _gamma_squared(gamma: float | None) -> Any:
    """Return gamma squared: a variable, or the parameter of a given level."""
    if gamma is None:
        return cp.Variable(nonneg=True, name="gamma_squared")
    level = real_number(gamma, "gamma", "a positive number", above=0.0)
    require_no_overflow(level, "gamma", "gamma")
    return cp.Parameter(nonneg=True, value=level**2, name="gamma_squared")


def _constraints_45(
    data: _PaperData, written: _WrittenForm, unknowns: tuple[Any, Any, Any], weight: Any, margin: float, *, free: bool
) -> dict[str, Any]:
    """Return P > 0 and (45) in P, Y and gamma squared."""
    P, Y, gamma_squared = unknowns
    if free:
        Z, Zd = weight @ (data.C @ written.X), weight @ (data.innovation_d / written.unit)
    else:
        Z, Zd = weight @ data.C @ written.X, weight @ data.innovation_d / written.unit
    error_blocks = P @ written.A1 - Y @ written.C1, P @ written.TD - Y @ written.D1
    inequality = _matrix_45(P, gamma_squared / written.unit**2, error_blocks, Z, Zd, free=free)
    return {"P": lmi.at_least(P, margin), "(45)": lmi.at_most(inequality, -margin)}


def _hides_a_mode(A: FloatArray, outputs: FloatArray) -> bool:
    """Return whether a mode on or outside the unit circle has no part in what is seen."""
    poles = [pole for pole in np.linalg.eigvals(A) if is_outside(complex(pole), 1.0)]
    pencils = (np.vstack([A - pole * np.eye(len(A)), outputs]) for pole in poles)
    return any(not decide_rank(pencil, expected=len(A), tolerance=HIDDEN_MODE_TOLERANCE).full for pencil in pencils)


def _matrix_45(P: Any, level: Any, error_blocks: tuple[Any, Any], Z: Any, Zd: Any, *, free: bool) -> Any:
    """Return the matrix of (45), which is to be negative definite; where the weight is free before its last Schur
    complement."""
    n, nd, q = P.shape[0], Zd.shape[1], Z.shape[0]
    if free:
        return lmi.symmetric_blocks(
            [
                [-P],
                [np.zeros((nd, n)), -level * np.eye(nd)],
                [*error_blocks, -P],
                [Z, Zd, np.zeros((q, n)), -np.eye(q)],
            ]
        )
    return lmi.symmetric_blocks([[-P + Z.T @ Z], [Zd.T @ Z, -level * np.eye(nd) + Zd.T @ Zd], [*error_blocks, -P]])


def _restricted_equivalent(
    plant: DescriptorSystem, work: DescriptorSystem, S: Any, T: Any, N: Any
) -> tuple[FloatArray, FloatArray]:
    """Return T and N with ``T E + N C = I``."""
    if (T is None) != (N is None) or (S is not None and T is not None):
        raise SpecError("Give T and N together, or S alone.", path="T" if T is not None else "N")
    if S is not None:
        return restricted_equivalent_from(work.E, work.C, as_matrix(S, "S"))
    if T is None:
        prepared = prepare(plant)
        states = prepared.scaling.states[:, None]
        return states * prepared.T * prepared.scaling.equations, states * prepared.N * prepared.scaling.outputs
    t, n = as_matrix(T, "T"), as_matrix(N, "N")
    for name, matrix, shape in (("T", t, (work.nx, work.nx)), ("N", n, (work.nx, work.ny))):
        require_shape(matrix.shape, shape, name)
    _require_identity("T E + N C", t @ work.E + n @ work.C, np.abs(t) @ np.abs(work.E) + np.abs(n) @ np.abs(work.C))
    return t, n


def _psi(plant: DescriptorSystem, TA: FloatArray, C: FloatArray, TF: FloatArray) -> FloatArray:
    """Return ``Psi`` (20), with the detectability indexes (19)."""
    detectability = fault_detectability(
        TA, C, TF, plant=with_sensor_faults_as_states(plant), exact=exact_indexes(plant)
    )
    if not detectability.finite:
        raise SpecError("With this T some fault never reaches the outputs: choose another.", path="T")
    return detectability.Psi


def _left_inverse(W: Any, Upsilon: FloatArray) -> FloatArray:
    """Return a left inverse of Upsilon: that of least norm, or a given one."""
    if W is None or (isinstance(W, str) and W == "free"):
        return np.asarray(np.linalg.pinv(Upsilon))
    if isinstance(W, str):
        raise SpecError(f"W is {W!r}: give a matrix, or 'free'.", path="W")
    weight = as_matrix(W, "W")
    require_shape(weight.shape, Upsilon.T.shape, "W")
    _require_identity("W Upsilon", weight @ Upsilon, np.abs(weight) @ np.abs(Upsilon))
    return weight


def _require_identity(name: str, product: FloatArray, size: FloatArray) -> None:
    miss = identity_missed(product, size)
    if not miss <= RANK_TOLERANCE:
        raise SpecError(f"{name} misses the identity by {miss:.3g}: give all digits.", path=name.split()[0])


def _existence(conditions: Sequence[Condition], convex: GainProblem, gamma: float | None) -> list[Condition]:
    """Return the existence conditions, and whether a filter of a given level can be."""
    listed = list(conditions)
    if gamma is None or not convex.disturbances or not all(condition.holds for condition in conditions):
        return listed
    best = search_least_gain(convex)
    bound = (
        best.gain
        if not convex.measured
        else proved_lower_bound(convex, solver="CLARABEL", best=best.injection, enough=gamma)
    )
    holds = bool(best.gain <= gamma or bound <= gamma)
    detail = f"the best filter found has {best.gain:.9g}, and none with this T, N and W is below {lower_text(bound, 9)}"
    source = "dual of (45), checked without the solver"
    claim = "gamma is not below the least gain for this T, N and W"
    return [*listed, Condition("gamma", claim, holds, gamma, bound, source, detail)]


def noise_paths(
    plant: DescriptorSystem, conditions: Conditions, b: FloatArray, d: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return how inputs by ``b (nx, k)`` and ``d (ny, k)`` enter the errors, but for R, and the outputs less C N d."""
    work, data = with_sensor_faults_as_states(plant), conditions.data
    free = (np.eye(work.ny) - work.C @ data["N"]) @ d
    return data["T"] @ b - data["T"] @ work.A @ (data["N"] @ d) - data["L0"] @ free, free


def h2_terms(
    plant: DescriptorSystem, conditions: Conditions, error_input: FloatArray, free: FloatArray
) -> tuple[Any, Any, Any]:
    """Return the H2 inequalities of inputs that enter the errors by ``error_input - R free``, estimates by ``W free``.

    They are a constraint of stability and one of variance; the third is the variable whose trace bounds the variance.
    """
    if not free.shape[1]:
        # Older cvxpy has no variable without entries: an input that does nothing stands for none.
        error_input, free = np.zeros((len(error_input), 1)), np.zeros((len(free), 1))
    data, k = conditions.data, free.shape[1]
    C = with_sensor_faults_as_states(plant).C
    Z = cp.Variable((k, k), symmetric=True, name="Z")
    weight = conditions.weight if conditions.weight is not None else data["W"]
    stable, variance = atoms.h2(
        data["A1"],
        np.linalg.solve(data["X"], error_input - data["R0"] @ free),
        weight @ (C @ data["X"]),
        weight @ free,
        conditions.variables["P"],
        Z,
        plant.dt,
        Y=conditions.variables["Y"],
        Cy=data["C1"],
        Dy=data["rest"] @ free,
        detectable=True,
    )
    return stable, variance, Z


def error_norm(plant: DescriptorSystem, gains: Mapping[str, FloatArray]) -> float:
    """Return the H-infinity norm from the disturbance to the fault errors of a filter with gains T, N, L, W."""
    work = with_sensor_faults_as_states(plant)
    T, N, L, W = (gains[letter] for letter in "TNLW")
    shown_d = (np.eye(work.ny) - work.C @ N) @ work.Dd
    error_input = T @ work.Bd - T @ work.A @ (N @ work.Dd) - L @ shown_d
    return float(hinf_norm(T @ work.A - L @ work.C, error_input, W @ work.C, W @ shown_d).upper)

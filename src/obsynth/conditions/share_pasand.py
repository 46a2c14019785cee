r"""Share Pasand, Aliyari, Taghirad: the unknown-input PI observer by its augmented pair, poles or an LMI region.

The paper's letters: ``E x' = A x + B u + Bf f + Bd d``, ``y = C x`` (1), faults ``f = Cw w``, ``w' = Phi w`` (2), (6);
``Ea = diag(E, I)``, ``Aa = [A Bf Cw; 0 Phi]``, ``Bda = [Bd; 0]``, ``Ca = [C Df Cw]`` (13).  With

.. math::
    U_a B_{da} = 0, \quad U_a E_a + \hat D_a C_a = I \tag{19}, \qquad \hat A_a = U_a A_a - K_a C_a, \quad
    \hat B_a = \hat A_a \hat D_a + K_a, \quad \hat J_a = U_a B_a

the errors obey ``e+ = Ahat_a e``: any K_a with all eigenvalues in the left half-plane (the unit disk) will do.  Here
``P (U_a A_a - K_a C_a) = P U_a A_a - Y C_a`` with ``Y = P K_a`` makes a region a linear matrix inequality.

Unlike the paper: existence by (D1)-(D3) of the invariant form, as its Theorems 1, 2 and Lemma 6 are false as printed;
a U of full rank, unless E_sharp, C_sharp and G of (10), (11) are given; several faults, in outputs too.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from obsynth.analysis.existence.augmented_pencils import AugmentedPlant
from obsynth.analysis.existence.condition import Condition
from obsynth.analysis.existence.sharepasand import existence
from obsynth.conditions import atoms, lmi
from obsynth.conditions import lazy_cvxpy as cp
from obsynth.conditions.augmented_plant import (
    Decoupled,
    decouple,
    direct_part,
    measured_combinations,
    paper_decoupling,
    realise,
    with_faults,
)
from obsynth.conditions.problem import Conditions, Values, design_of, require_data
from obsynth.conditions.share_pasand_over_region import share_pasand_over_region
from obsynth.errors import SpecError
from obsynth.numerics.arguments import arguments_checked
from obsynth.numerics.arrays import FloatArray, as_matrix
from obsynth.numerics.eigenstructure import place
from obsynth.numerics.gain_levels import is_positive
from obsynth.numerics.matrix_equations import continuous_solution, discrete_solution
from obsynth.numerics.regions import LMIRegion, checked_region, disk, half_plane
from obsynth.numerics.requested_poles import checked_poles
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.faults import Exosystem, exosystem
from obsynth.plants.polytopic import PolytopicSystem
from obsynth.plants.transformations.delays import linear_plant
from obsynth.plants.transformations.recovery import Transformation
from obsynth.proofs.contraction import prove_contraction
from obsynth.results.design import ObserverDesign

#: Conditions whose failure leaves an inequality that no matrices satisfy.
DECIDED_BY_THE_UI_PI_INEQUALITY = ("(D2)", "(D3)", "fixed modes", "order of the fault model", "fault model in double")

#: Real numbers among which the slowest of a region is looked for: a scale alone depends on it.
_REAL_RATES, _REAL_NUMBERS = -np.logspace(-6, 9, 151), np.linspace(-1.0, 1.0, 401)


@arguments_checked
def sharepasand(
    plant: DescriptorSystem | Transformation | PolytopicSystem,
    *,
    fault_model: Any = "step",
    region: LMIRegion | None = None,
    poles: Sequence[Any] | None = None,
    E_sharp: ArrayLike | None = None,
    C_sharp: ArrayLike | None = None,
    G: ArrayLike | None = None,
    margin: float = lmi.MARGIN,
) -> Conditions:
    """Return the unknown-input PI observer: the decoupling as data, and the gain by a region or by poles.

    Parameters
    ----------
    plant : DescriptorSystem, Transformation or PolytopicSystem
        ``E (nx, nx)``, ``C (ny, nx)``, ``Bf (nx, nf)``, ``Bd (nx, nd)``; na = nx + nw below.  For a PolytopicSystem
        the inequalities are those at every vertex, in one P and a Y for each, for the least gain from what drives
        states, fault models and outputs to the errors, in units of the plant's own; gains ``K_a[1]``, ...
    fault_model : optional
        As for `obsynth.ui_pi_observer`.
    region : LMIRegion, optional
        Where all eigenvalues must lie (1/s, or dimensionless for ``dt > 0``), beside stability.
    poles : sequence, optional
        All na eigenvalues instead (1/s, or dimensionless): K_a is then placed, which needs no solver, and what is left
        is the Lyapunov inequality of it, in P alone.
    E_sharp, C_sharp, G : array_like, optional
        The paper's ``(nx, nx)``, ``(nx, ny)``, ``(nx, ny)`` of (10), (11).
    margin : float, optional
        What the inequalities keep to the boundary of the cone.

    Returns
    -------
    Conditions
        Variables ``P (na, na)`` and ``Y (na, ny)``, small ones; data ``U_a, D_a, E_a, A_a, B_da, C_a, Phi, Cw`` and
        the coordinates ``X (na, na)`` of P and Y, in which solvers do not stall: ``K_a = X P^-1 Y``; constraints
        ``"P"``, ``"stability"`` and ``"region"``; gains ``K_a, U_a, D_a, Ahat, Bhat, Jhat, U, D, K, F``.

    Raises
    ------
    SpecError
        A malformed option.
    PreconditionError
        (D1) fails: no U decouples the unknown inputs.

    References
    ----------
    .. [SharePasand] Unknown Input-Proportional Integral Observer for Singular Systems: Application to fault detection,
       eqs. (10)-(13), (19), procedure 1.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]], C=[[1, 0], [0, 1]], Bf=[[1], [0]], Bd=[[0], [1]], dt=1.0
    ... )
    >>> paper = obsynth.conditions.sharepasand(plant)
    >>> _ = paper.problem.solve()
    >>> paper.problem.status
    'optimal'
    """
    if isinstance(plant, PolytopicSystem):
        refused = {"region": region, "poles": poles, "E_sharp": E_sharp, "C_sharp": C_sharp, "G": G}
        for name, value in refused.items():
            if value is not None:
                raise SpecError(f"Over a region there is no {name}: leave it out.", path=name)
        return share_pasand_over_region(plant, fault_model=fault_model, margin=margin)
    if poles is not None and region is not None:
        raise SpecError("poles and region are given: use one of them.", path="poles")
    own = linear_plant(plant).dense()
    model = exosystem(fault_model, own.fault_names, own.dt)
    result = existence(own, model)
    require_data(result.conditions, solvers=DECIDED_BY_THE_UI_PI_INEQUALITY)
    parts = _decoupling(result.plant, E_sharp, C_sharp, G)  # (10), (11)
    target = plant if result.transformation is None else result.transformation
    return augmented_problem(
        result.plant,
        model,
        with_faults(parts.U, parts.Dhat, result.plant, model),
        region=region,
        poles=poles,
        margin=margin,
        conditions=result.conditions,
        design=design_of("sharepasand", target, fault_model),
    )


def augmented_problem(
    plant: DescriptorSystem,
    model: Exosystem,
    decoupling: tuple[FloatArray, FloatArray],
    *,
    margin: float,
    conditions: Sequence[Condition],
    design: Callable[[dict[str, FloatArray], str], ObserverDesign],
    region: LMIRegion | None = None,
    poles: Sequence[Any] | None = None,
    X: FloatArray | None = None,
) -> Conditions:
    """Return the conditions for given ``U_a (na, na)`` and ``D_a (na, ny)`` (19), in coordinates ``X (na, na)``."""
    augmented = AugmentedPlant.of(plant, model)  # (13)
    U_a, D_a = decoupling
    # Outputs that show d directly are solved for it; the others are left for the gain.
    undisturbed, injection, _ = direct_part(plant)
    injected = np.vstack([injection, np.zeros((model.order, plant.ny))])
    UA, C_gain = U_a @ (augmented.A - injected @ augmented.C), undisturbed @ augmented.C
    if poles is None:
        inequality = _region_inequality(UA, C_gain, region, X, discrete=plant.is_discrete, margin=margin)
    else:
        inequality = _placed_inequality(UA, C_gain, poles, plant.dt, margin=margin)

    def gains(values: Values) -> dict[str, FloatArray]:
        free = inequality.gain(values)
        K_a = free @ undisturbed + U_a @ injected
        letters = realise(plant, model, (U_a, D_a, K_a), measured_combinations(plant))[1]
        nx = plant.nx
        return {**letters, "U": U_a[:nx, :nx], "D": D_a[:nx], "K": K_a[:nx], "F": K_a[nx:]}

    data = {
        "U_a": U_a,
        "D_a": D_a,
        "E_a": augmented.E,
        "A_a": augmented.A,
        "B_da": augmented.Bd,
        "C_a": augmented.C,
        "UA": UA,
        "C_seen": C_gain,
        "X": inequality.X,
        "Phi": model.Phi,
        "Cw": model.Cw,
    }
    return Conditions(
        "Share Pasand, Aliyari, Taghirad, (13), (19), procedure 1",
        lmi.semidefinite_problem(cp.Minimize(inequality.goal), list(inequality.constraints.values())),
        inequality.variables,
        {},
        data,
        inequality.constraints,
        lambda: conditions,
        gains,
        design,
    )


@dataclass(frozen=True, eq=False)
class _GainInequality:
    """An inequality in coordinates X for the gain of ``UA - K C``, and the K of a solution."""

    variables: dict[str, Any]
    goal: Any
    constraints: dict[str, Any]
    X: FloatArray
    gain: Callable[[Values], FloatArray]


def _stable_region(*, discrete: bool) -> LMIRegion:
    return disk(0.0, 1.0) if discrete else half_plane(0.0)


def _region_inequality(
    UA: FloatArray, C: FloatArray, region: LMIRegion | None, X: FloatArray | None, *, discrete: bool, margin: float
) -> _GainInequality:
    """Return the inequality of a stable region, and of a given one, in P and ``Y = P K``."""
    stable = _stable_region(discrete=discrete)
    where = stable if region is None else stable & checked_region(region)
    P = cp.Variable((len(UA), len(UA)), symmetric=True, name="P")
    X = _coordinates(UA, C, where, discrete=discrete) if X is None else X
    UAx, Cx = np.linalg.solve(X, UA @ X), C @ X
    Y = cp.Variable((len(UA), len(C)), name="Y")
    constraints = {"P": lmi.at_least(P, 1.0)}  # the inequalities leave the scale free
    constraints["stability"] = atoms.region(UAx, P, stable, Y=Y, Cy=Cx, margin=margin)[1]
    if region is not None:
        constraints["region"] = atoms.region(UAx, P, region, Y=Y, Cy=Cx, margin=margin)[1]
    # As P >= I, the first is no less than the norm of K_a; the second makes the optimum one that solvers agree on.
    goal = cp.norm(Y, "fro") + cp.trace(P)
    return _GainInequality(
        {"P": P, "Y": Y}, goal, constraints, X, lambda values: X @ np.linalg.solve(values["P"], values["Y"])
    )


def _placed_inequality(
    UA: FloatArray, C: FloatArray, poles: Sequence[Any], dt: float, *, margin: float
) -> _GainInequality:
    """Return the inequality of stability in P with the gain that places given poles."""
    n, discrete = len(UA), dt > 0.0
    P = cp.Variable((n, n), symmetric=True, name="P")
    targets = checked_poles(poles, n, np.zeros(0, dtype=np.complex128), dt, of="ui-pi-observer")
    K = place(UA, C, targets, dt=dt, objective="gain")[0]
    contraction = prove_contraction(UA - K @ C, discrete=discrete)
    X = np.eye(n) if contraction is None else contraction.inverse
    closed = np.linalg.solve(X, (UA - K @ C) @ X)
    constraints = {"P": lmi.at_least(P, 1.0)}
    constraints["stability"] = atoms.region(closed, P, _stable_region(discrete=discrete), margin=margin)[1]
    return _GainInequality({"P": P}, cp.trace(P), constraints, X, lambda _: K)


def _coordinates(F: FloatArray, C: FloatArray, where: LMIRegion, *, discrete: bool) -> FloatArray:
    """Return a state change ``(n, n)`` in which the errors of a Kalman filter of the region's speed are alike."""
    n = len(F)
    reals = [x for x in (_REAL_NUMBERS if discrete else _REAL_RATES) if where.contains(x)]
    if not reals:
        return np.eye(n)
    if discrete:
        covariance = discrete_solution(F / max(np.abs(reals)), C, np.eye(n), np.eye(len(C)))
    else:
        covariance = continuous_solution(F - max(reals) * np.eye(n), C, np.eye(n), np.eye(len(C)))
    if covariance is None or not is_positive(covariance):
        return np.eye(n)
    # What comes of it is a scale alone.
    return np.asarray(np.linalg.cholesky(0.5 * (covariance + covariance.T)))


def _decoupling(plant: DescriptorSystem, E_sharp: Any, C_sharp: Any, G: Any) -> Decoupled:
    """Return ``U`` and ``Dhat`` with ``U Bd = 0``, ``U E + Dhat C = I``: the paper's (11), or one of full rank."""
    sharps = {"E_sharp": E_sharp, "C_sharp": C_sharp, "G": G}
    if all(matrix is None for matrix in sharps.values()):
        return decouple(plant)
    missing = [name for name, matrix in sharps.items() if matrix is None]
    if missing:
        raise SpecError(f"{', '.join(missing)} is missing: give E_sharp, C_sharp and G together.", path=missing[0])
    e_sharp, c_sharp, g = (as_matrix(matrix, name) for name, matrix in sharps.items())
    _, u, d = paper_decoupling(plant, e_sharp=e_sharp, c_sharp=c_sharp, g=g)
    undisturbed, injection, _ = direct_part(plant)
    return Decoupled(u, d, np.zeros((0, plant.nx)), np.zeros((0, plant.ny)), undisturbed, injection)

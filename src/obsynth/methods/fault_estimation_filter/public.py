"""Public functions of the method ``fault-estimation-filter``."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

from numpy.typing import ArrayLike

from obsynth.analysis.transformations.recovery import Transformation, linear_plant
from obsynth.errors import SpecError
from obsynth.methods.designing import design, design_of_given_gains
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.results.design import ObserverDesign
from obsynth.simulation.scenario import Scenario


def fault_estimation_filter(
    plant: DescriptorSystem | Transformation,
    *,
    gamma: float | None = None,
    gamma_search: str = "direct",
    gamma_margin: float = 0.05,
    free_residual_weight: bool | None = None,
    residual_weight_limit: float | None = None,
    S: ArrayLike | None = None,
    engine: str = "auto",
    solver: str = "auto",
    tolerance: float = 1e-6,
    mean: int = 1,
    model_error: str = "none",
    scenario: Scenario | None = None,
    name: str = "design",
) -> ObserverDesign:
    r"""Design a fault-estimation filter with a guaranteed l2 gain from the disturbance to the fault error.

    Each fault estimate equals its fault delayed by its detectability index, untouched by the other faults and the
    state; what is left is the effect of the disturbance, bounded by gamma, and of the initial error, which dies out.

    Parameters
    ----------
    plant : DescriptorSystem or Transformation
        Discrete time (``dt > 0``), ``E (nx, nx)``, ``C (ny, nx)``, ``Bf (nx, nf)``, ``Bd (nx, nd)``; feedthrough
        ``D, Df, Dd`` and noise ``Bw, Dw`` allowed.
    gamma : float, optional, dimensionless
        Required bound on the l2 gain d -> fault error.  ``None`` ships ``1 + gamma_margin`` times the least one; where
        the plant states noise, not less than the gain of the Kalman filter that takes d as unit white noise.
    gamma_search : {"direct", "bisection"}, optional
        How the least gain is found: one minimisation, or the paper's Algorithm 1 made to end.
    gamma_margin : float, optional
        Relative distance to the least gain that buys small gains, or little noise where the plant states noise; the
        bare optimum is badly conditioned.
    free_residual_weight : bool, optional
        Whether W is free within ``W Upsilon = I``.  By default yes when the plant states noise, else no.
    residual_weight_limit : float, optional
        Bound on the spectral norm of W (implies a free W; not with engine "riccati").
    S : array_like, optional
        The paper's free matrix ``(nx, nx + ny)`` in (17); by default T is nonsingular by construction.
    engine : {"auto", "riccati", "lmi"}, optional
        Who finds the gains: Riccati equations alone, which serve hundreds of states; or the matrix inequality as well,
        started from them, for the last digits of gamma and, with up to 12 states, somewhat smaller gains.  By default
        the equations; the inequality where what they find does not keep ``residual_weight_limit``, where ``gamma``
        is below what they found or less than 1e-4 above (up to 64 states), and where up to 12 states have no filter of
        theirs.  The result's ``solver["engine"]`` says which ran: "riccati" also where
        "lmi" was asked for and the gain is at a lower bound already, see ``solver["runs"]``.  The inequality is what is
        verified in each case.
    solver : {"auto", "SCHUR", "CLARABEL", "SCS"}, optional
        Semidefinite solver, for the inequality and for proofs that a gamma cannot be reached.  "SCHUR" is our own
        interior-point method for few unknowns in dense blocks, several times as fast there as Clarabel; "auto" takes
        it, and Clarabel where it fails.
    tolerance : float, optional
        Relative width of the bracket at which bisection ends.
    mean : int, optional, samples
        Over how many samples each fault estimate is averaged; adds ``(mean - 1) // 2`` to its delay.  The gain gamma is
        proved for the estimate before the mean, which makes no l2 norm larger.
    model_error : {"none", "columns"}, optional
        With "columns", for a plant with tolerances: the directions that are to blame for what the tolerances do are
        tried as noise of several weights, and as unknown inputs where they can be told from the faults; what is shipped
        has the smallest mean adaptive threshold over ``scenario``.  A note says what was chosen.
    scenario : Scenario, optional
        For ``model_error``: inputs, disturbances and noise; its faults do not count.
    name : str, optional
        Name of the design.

    Returns
    -------
    ObserverDesign
        ``gains``: ``T (nx, nx)``, ``N (nx, ny)``, ``L (nx, ny)``, ``W (nf, ny)``, ``Psi (nx, nf)``,
        ``Upsilon (ny, nf)``, ``R (nx, ny)``, where faults with feedthrough count as further states.
        ``certificate.claims``: ``gamma`` (proved), ``gamma_min`` (least found), ``state_lag`` (samples).

    Raises
    ------
    SpecError
        An option is out of range or S has the wrong shape.
    PreconditionError
        ``rank [E; C] < nx`` (eq. (2)), dependent outputs or faults, a fault that never shows, ``rank Upsilon < nf``
        (Theorem 2 (i)), or an invariant zero from the faults to the outputs on or outside the unit circle.
    InfeasibleError
        No filter of this structure reaches ``gamma``, for this T, N and W.
    SolverError
        Nothing is known.
    VerificationError
        The shipped realisation fails a check.

    Notes
    -----
    Differs from the paper: the sign of the second term of (48), see (60); the zero condition; gamma minimised
    directly; a second stage for small gains; exact treatment of feedthrough; a state estimate without the fault's
    bias.  gamma depends on the coordinates of equations and outputs when W is fixed; existence does not.

    References
    ----------
    .. [Wang2015] Z. Wang, M. Rodrigues, D. Theilliol, Y. Shen, Fault estimation filter design for discrete-time
       descriptor systems, IET Control Theory Appl. 9 (10), 2015, Theorem 2, eqs. (45)-(48).
    """
    return design(
        plant,
        "fault-estimation-filter",
        name=name,
        gamma=gamma,
        gamma_search=gamma_search,
        gamma_margin=gamma_margin,
        free_residual_weight=free_residual_weight,
        residual_weight_limit=residual_weight_limit,
        S=S,
        engine=engine,
        solver=solver,
        tolerance=tolerance,
        mean=mean,
        model_error=model_error,
        scenario=scenario,
    )


def fault_estimation_filter_from_gains(
    plant: DescriptorSystem | Transformation,
    *,
    T: ArrayLike,
    N: ArrayLike,
    L: ArrayLike,
    W: ArrayLike,
    gamma: float | None = None,
    indexes: Sequence[int] | None = None,
    name: str = "design from gains",
) -> ObserverDesign:
    """Put gains from a paper or another program into a design, with its report; nothing is refused.

    Parameters
    ----------
    plant : DescriptorSystem or Transformation
        As for `fault_estimation_filter`.
    T, N, L, W : array_like
        ``(nx, nx)``, ``(nx, ny)``, ``(nx, ny)``, ``(nf, ny)`` of eq. (23).
    gamma : float, optional, dimensionless
        Claimed bound on the l2 gain; needed when the plant has disturbances.
    indexes : sequence of int, optional
        Detectability index ``rho_i`` of each fault (19): samples by which its estimate lags.  Found from T by default,
        which needs all of its digits: where an index is above one, ``C T f_i`` must vanish, and with a rounded T it
        does not.
    name : str, optional
        Name of the design.

    Returns
    -------
    ObserverDesign
        Its report may hold failed checks: look at ``report.passed``, or call `obsynth.verify` with the number of
        printed digits.

    Raises
    ------
    SpecError
        A gain has the wrong shape, gamma is missing, or ``indexes`` are not one positive number for each fault.
    PreconditionError
        No filter exists for this plant.

    References
    ----------
    .. [Wang2015] Fault estimation filter design for discrete-time descriptor systems, eq. (23).
    """
    from obsynth.methods.fault_estimation_filter.realisation import synthesis_from_gains

    if linear_plant(plant).nd and gamma is None:
        raise SpecError(
            "gamma is needed: the plant has disturbances, and a gain set claims a bound on them.", path="gamma"
        )
    synthesis = partial(synthesis_from_gains, T=T, N=N, L=L, W=W, gamma=gamma, indexes=indexes)
    return design_of_given_gains(plant, "fault-estimation-filter", synthesis, name=name)

"""Public function of the method ``dae-adaptive-observer``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from numpy.typing import ArrayLike

from obsynth.methods.designing import design
from obsynth.plants.dae.model import DAEModel
from obsynth.results.design import ObserverDesign


def dae_adaptive_observer(
    plant: DAEModel,
    *,
    dt: float | None = None,
    Q: ArrayLike | Mapping[str, float] | None = None,
    R: ArrayLike | Mapping[str, float] | None = None,
    form: str = "auto",
    forgetting: float = 0.98,
    guard: str = "regularise",
    weight: str = "innovation",
    integration: str = "auto",
    random_walk: ArrayLike | Mapping[str, float] | None = None,
    initial_state: ArrayLike | Mapping[str, float] | None = None,
    initial_covariance: ArrayLike | Mapping[str, float] | None = None,
    initial_parameters: ArrayLike | Mapping[str, float] | None = None,
    initial_parameter_covariance: ArrayLike | Mapping[str, float] | None = None,
    bounds: ArrayLike | Mapping[str, ArrayLike] | None = None,
    largest_move: float | None = None,
    window: int = 50,
    outliers: str = "none",
    outlier_limit: float | None = None,
    sensors: Mapping[str, Mapping[str, int]] | None = None,
    state_bounds: Mapping[str, Sequence[float]] | ArrayLike | None = None,
    reset: float = 0.0,
    name: str = "design",
) -> ObserverDesign:
    r"""Design an observer of states and parameters of a plant ``F(x', x, u, theta) = 0``, ``y = h(x, theta)``.

    While the parameters are constant and excited, their estimates forget their start at the rate of the forgetting
    factor; a change is followed with a lag of about ``lambda / (1 - lambda)`` samples.

    Parameters
    ----------
    plant : DAEModel
        Index 1, with parameters: ``nx`` states, ``ny`` outputs, ``nq`` parameters.
    dt : float
        Seconds between samples; must be given, as Q and R.
    Q : array_like or mapping
        Covariance of what is added to the right sides of the equations in each step ``(nx, nx)``, one variance for
        all, or variances by equation (zero for those not named), in units of the equations squared.
    R : array_like or mapping
        Covariance of the sensors ``(ny, ny)``, one variance for all, or variances by output.
    form : {"auto", "forgetting", "random-walk", "augmented-kalman"}, optional
        Adaptive observer with a forgetting factor, or with parameters that walk (by default where ``random_walk`` is
        stated); or the extended Kalman filter of states and parameters together.  Covariances of the last two are
        those of parameters that walk as stated.
    forgetting : float, optional, dimensionless
        lambda in (0, 1].
    guard : {"regularise", "none"}, optional
        ``(1 - lambda) S_0^-1`` is added to the information, so that S never exceeds S_0 (default); or nothing.
    weight : {"innovation", "paper"}, optional
        Covariance in (18): that of the innovation, or R as printed.
    integration : {"auto", "backward-euler", "radau"}, optional
        Backward Euler is the paper's; on data of a continuous plant with fast motion it finds wrong parameters, Radau
        IIA of order five does not.  By default Radau where a mode at the nominal point turns by more than 0.05
        radians in a step, which a note then says; with backward Euler asked for, a note says what it damps.
    random_walk : array_like or mapping, optional
        Covariance of one step of the parameters: ``(nq, nq)``, one variance for all, or variances by parameter.
    initial_state, initial_parameters : array_like or mapping, optional
        ``(nx,)`` and ``(nq,)``, or values by name; nominal values by default.
    initial_covariance : array_like or mapping, optional
        ``P_0 (nx, nx)`` or variances; deviations of 1 % of the nominal sizes by default.
    initial_parameter_covariance : array_like or mapping, optional
        ``S_0 (nq, nq)`` or variances; deviations of 10 % of the nominal values by default.
    bounds : array_like or mapping, optional
        ``(nq, 2)``, or pairs by name.
    largest_move : float, optional
        In nominal sizes of the states: longer steps are taken along a homotopy in the input, so that of several roots
        the connected one is found.
    window : int, optional
        Samples over which excitation is watched.
    outliers, outlier_limit, sensors, state_bounds
        As for `descriptor_kalman`; but the next step begins at the states within their bounds.
    reset : float, optional, dimensionless
        Detect and reset: when the innovations of 20 samples pass a threshold (with this probability per sample where
        nothing has changed), the covariance of the parameters starts again from S_0.  Zero never resets.
    name : str, optional
        Name of the design.

    Returns
    -------
    ObserverDesign
        ``observer`` is a `DAEObserver`; ``gains``: ``K (nx, ny)`` and ``Upsilon (nx, nq)`` after 100 steps at nominal
        inputs.  ``certificate.claims``: ``index``, ``condition`` of (7), ``contraction``, ``steps``.

    Raises
    ------
    SpecError
        An option is missing, out of range, or names no signal.
    PreconditionError
        The index is not 1 (the equations involved are named), or there are no parameters.
    SolverError
        A step at nominal inputs has no solution.
    VerificationError
        The observer fails a check.

    Notes
    -----
    Differs from the paper: (12a)-(12c), (22), (23) need theta(k) to compute theta(k); here the innovation is taken
    before any update, the state is corrected by ``Upsilon (theta(k) - theta(k-1))``, and H, L, K follow at the result.
    ``N_k = G_k - F_k K_{k-1} L_{k-1}``, where (24) prints ``L_k`` and (15) leaves N undefined.  (18) uses the
    covariance of the innovation where R is printed (option ``weight``): with lambda = 1 it is then the extended Kalman
    filter with constant parameters.  Reported is the state after the measurement of k, not a prediction.  S stays below
    S_0 where excitation is missing (``guard``), parameters have bounds, missing samples do not forget, and the
    covariance of theta is carried besides S.  Radau IIA beside backward Euler; stored quantities in conservative form.

    References
    ----------
    .. [MoussaAliDAE2013] Adaptive observer based fault diagnosis applied to differential-algebraic systems, IFAC SSSC
       2013, eqs. (5)-(23).
    """
    return design(
        plant, "dae-adaptive-observer", name=name, dt=dt, Q=Q, R=R, form=form, forgetting=forgetting, guard=guard,
        weight=weight, integration=integration, random_walk=random_walk, initial_state=initial_state,
        initial_covariance=initial_covariance, initial_parameters=initial_parameters,
        initial_parameter_covariance=initial_parameter_covariance, bounds=bounds, largest_move=largest_move,
        window=window, outliers=outliers, outlier_limit=outlier_limit, sensors=sensors, state_bounds=state_bounds,
        reset=reset,
    )  # fmt: skip

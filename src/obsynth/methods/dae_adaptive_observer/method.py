"""The adaptive observer of nonlinear plants as a method."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal, TypeAlias

from obsynth.analysis.existence.condition import Condition
from obsynth.methods.method import ClaimMeaning, Method, PlantKind, Purpose
from obsynth.numerics.arguments import Count, ForgettingFactor, Positive, Probability, WrittenAs
from obsynth.observers.nonlinear.settings import Guard, Weight
from obsynth.observers.outliers import Outliers
from obsynth.plants.dae import DAEModel

FormChoice: TypeAlias = Literal["forgetting", "random-walk", "augmented-kalman", "auto"]

IntegrationChoice: TypeAlias = Literal["backward-euler", "radau", "auto"]


@dataclass(frozen=True)
class DaeAdaptiveObserver(Method):
    r"""Design an observer of states and parameters of a plant ``F(x', x, u, theta) = 0``, ``y = h(x, theta)``.

    While the parameters are constant and excited, the effect of their initial values decays at the rate of the
    forgetting factor; a change is followed with a lag of about ``lambda / (1 - lambda)`` samples.

    Parameters
    ----------
    plant : DAEModel
        Index 1: ``nx`` states, ``ny`` outputs, ``nq`` parameters.  Without parameters the observer is the extended
        Kalman filter of the states.
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
    outliers, outlier_limit, outlier_sizes, sensors, state_bounds
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
        The index is not 1 (the equations involved are named).
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
    S_0 where excitation is missing (``guard``), parameters have bounds, missing samples do not discount earlier ones,
    and the covariance of theta is carried besides S.  Radau IIA beside backward Euler; stored quantities in
    conservative form.

    References
    ----------
    .. [MoussaAliDAE2013] Adaptive observer based fault diagnosis applied to differential-algebraic systems, IFAC SSSC
       2013, eqs. (5)-(23).

    Examples
    --------
    >>> import obsynth
    >>> tank = obsynth.DAEModel(
    ...     {"balance": "der(level) = inflow - c * sqrt(level)"},
    ...     {"gauge": "level"},
    ...     states={"level": 1.0},
    ...     inputs={"inflow": 0.5},
    ...     parameters={"c": 0.5},
    ...     units={"level": "m", "inflow": "m/s", "c": "m0.5/s", "gauge": "m"},
    ... )
    >>> design = obsynth.dae_adaptive_observer(tank, dt=1.0, Q=1e-6, R={"gauge": 1e-4})
    >>> design.observer.fault_names, design.report.passed
    (('c',), True)
    """

    id: ClassVar[str] = "dae-adaptive-observer"
    plants: ClassVar[tuple[PlantKind, ...]] = ("nonlinear",)
    time: ClassVar[str] = "discrete, nonlinear"
    summary: ClassVar[str] = "states and parameters of nonlinear plants"
    source: ClassVar[str] = "Moussa Ali, Zhang 2013 (differential-algebraic systems)"
    claims: ClassVar[Mapping[str, ClaimMeaning]] = {
        "index": ClaimMeaning("", "index of the plant", "claims"),
        "condition": ClaimMeaning("", "largest condition number of (7) along the nominal run", "claims"),
        "contraction": ClaimMeaning(
            "", "spectral radius of F (I - K H) at the end of the nominal run, where the parameters are known", "claims"
        ),
        "steps": ClaimMeaning("samples", "steps of the nominal run", "claims"),
    }
    purposes: ClassVar[frozenset[Purpose]] = frozenset({"parameters"})
    placeholders: ClassVar[Mapping[str, Any]] = {"dt": 1.0, "Q": 1.0, "R": 1.0, "initial_parameter_covariance": 1.0}

    dt: Positive | None = None
    Q: Annotated[Any, WrittenAs("named covariance")] = None
    R: Annotated[Any, WrittenAs("named covariance")] = None
    form: FormChoice = "auto"
    forgetting: ForgettingFactor = 0.98
    guard: Guard = "regularise"
    weight: Weight = "innovation"
    integration: IntegrationChoice = "auto"
    random_walk: Annotated[Any, WrittenAs("named covariance")] = None
    initial_state: Annotated[Any, WrittenAs("named vector")] = None
    initial_covariance: Annotated[Any, WrittenAs("named covariance")] = None
    initial_parameters: Annotated[Any, WrittenAs("named vector")] = None
    initial_parameter_covariance: Annotated[Any, WrittenAs("named covariance")] = None
    bounds: Annotated[Any, WrittenAs("named pairs")] = None
    largest_move: Positive | None = None
    window: Count = 50
    outliers: Outliers | None = None
    outlier_limit: Positive | None = None
    outlier_sizes: Annotated[Any, WrittenAs("named vector")] = None
    sensors: Annotated[Any, WrittenAs("sensor times")] = None
    state_bounds: Annotated[Any, WrittenAs("named pairs")] = None
    reset: Probability = 0.0

    def conflicts(self) -> Iterator[str]:
        """Yield a sentence for each rule across options that is broken."""
        if self.dt is None:
            yield "dt is missing: give the seconds between samples."
        if self.form == "forgetting" and self.random_walk is not None:
            yield (
                "random_walk belongs to the forms 'random-walk' and 'augmented-kalman': form 'forgetting' has a "
                "factor instead."
            )

    def existence(self, plant: DAEModel, *, exactly: bool = True) -> tuple[Condition, ...]:
        """Return the existence conditions; the list ends at the first failure."""
        from obsynth.analysis.existence.moussaali_dae import dae_conditions

        return tuple(dae_conditions(plant, 1.0 if self.dt is None else self.dt))

    def require_stated(self, plant: DAEModel) -> None:
        """Raise `SpecError` where noise or a parameter's deviation is not stated."""
        from obsynth.observers.nonlinear.building import dae_observer_from_options

        dae_observer_from_options(plant, self.as_given())

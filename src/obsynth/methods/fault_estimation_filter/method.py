"""The fault-estimation filter as a method."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from annotated_types import Ge

from obsynth.analysis.existence.condition import Condition
from obsynth.conditions.options import (
    OwnConstraints,
    OwnRegion,
    SolverName,
    SolverOptions,
    own_term_conflicts,
    own_terms,
)
from obsynth.errors import SpecError
from obsynth.methods.method import ClaimMeaning, Method, PlantKind, Purpose, Synthesis
from obsynth.numerics.arguments import (
    FewSamples,
    OpenUnitInterval,
    Positive,
    WrittenAs,
    checked_value,
    require_shape,
    shown,
)
from obsynth.numerics.arrays import FloatArray, as_matrix, require_no_overflow
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.polytopic import PolytopicSystem
from obsynth.results.design import ObserverDesign
from obsynth.verification.constant_faults import STEADY_ERROR
from obsynth.verification.error_system import ErrorModel
from obsynth.verification.least_gain_proof import LEAST_GAIN_WITNESSES
from obsynth.verification.over_region import DECAY_ROW, WITNESSES

if TYPE_CHECKING:
    from obsynth.verification.requested_limits import Limits

#: Smallest allowed `gamma_margin`: closer to the optimum there is no room for a proof.
LEAST_MARGIN = 1e-2


@dataclass(frozen=True)
class FaultEstimationFilter(Method):
    r"""Design a fault-estimation filter with a guaranteed l2 gain from the disturbance to the fault error.

    Each fault estimate equals its fault, delayed by its detectability index, and does not depend on the other faults or
    the state.  Its error is the effect of the disturbance, bounded by gamma, and of the initial error, which decays.

    Parameters
    ----------
    plant : DescriptorSystem, PolytopicSystem or Transformation
        Discrete time (``dt > 0``), ``E (nx, nx)``, ``C (ny, nx)``, ``Bf (nx, nf)``, ``Bd (nx, nd)``; feedthrough
        ``D, Df, Dd`` and noise ``Bw, Dw`` are allowed.  For a PolytopicSystem a scheduled filter is designed, with one
        certificate for all parameter trajectories.  Its outputs have to be constant, and its faults have to show after
        one sample, in constant directions or, with two vertices, in changing ones.  Options are then gamma,
        gamma_margin, decay, solver and solver_options.
    gamma : float, optional, dimensionless
        Required bound on the l2 gain from d to the fault error.  By default ``1 + gamma_margin`` times the least one,
        and, if the plant states noise, at least the gain of the Kalman filter for d as unit white noise.
    gamma_search : {"direct", "bisection"}, optional
        Search for the least gain: by one minimisation, or by the paper's Algorithm 1 with a stopping rule.
    gamma_margin : float, optional
        Relative distance to the least gain.  It allows small gains, or little noise if the plant states noise; the
        optimum itself is badly conditioned.
    weight : {"paper", "free"} or array_like, optional
        Residual weight W.  ``"paper"`` is W = Upsilon^+ of Theorem 2 in the given units of the outputs.  ``"free"`` is
        a W with ``W Upsilon = I`` and little noise for the shipped gamma.  A matrix ``(nf, ny)`` with
        ``W Upsilon = I`` is in units of faults by outputs (``gains["Upsilon"]`` of any design with the same T).  By
        default W is free, unless no noise is stated and a free W lowers the least gamma by less than 5 %; a note gives
        both values.  With S or bisection the default is the paper's.  Over a region W is free and constant by default,
        and no matrix is allowed.
    residual_weight_limit : float, optional
        Bound on the spectral norm of W (implies a free W; not with engine "riccati").
    S : array_like, optional
        The paper's free matrix ``(nx, nx + ny)`` in (17); by default T is nonsingular by construction.
    engine : {"auto", "riccati", "lmi"}, optional
        How the gains are computed: by Riccati equations alone, also for hundreds of states; or with the paper's
        inequality (`obsynth.conditions.wang2015`) as well, for the last digits of gamma and, with up to 20 states,
        smaller gains (some seconds at 16 states).  By default by the equations.  The inequality is solved where their
        result does not keep ``residual_weight_limit``, where ``gamma`` is below their least one or less than 1e-4 above
        it (up to 20 states), and where they have no filter for up to 12 states.  The result's ``solver["engine"]``
        says which ran.  In each case the inequality is verified.
    solver : str, optional
        Semidefinite solver, for the inequality and for proofs that a gamma cannot be reached: any of
        ``cvxpy.installed_solvers()`` that does semidefinite programmes.
    solver_options : mapping, optional
        Settings of that solver by its own names, such as ``{"max_iter": 200}`` for CLARABEL.
    constraints : callable, optional
        A function of the variables of `obsynth.conditions.wang2015` by name that returns cvxpy constraints:
        ``lambda v: [cvxpy.norm(v["Y"], 2) <= 3]``.  (45) is then solved as in the paper, not by an engine.
    objective : "h2" or callable, optional
        Objective to be minimised, in place of gamma and the size of the gains: the H2 norm from disturbances and noise,
        as unit white noise, to the fault errors; or a function of the variables.  With "h2" the problem has a further
        variable ``Z`` whose trace is the squared norm.
    region : LMIRegion, optional
        Region of all eigenvalues of the filter (dimensionless), such as ``conditions.disk(0, 0.3)``.  It has to contain
        0, where the filter always has eigenvalues.  It shares P with the other inequalities, which may increase gamma
        more than necessary.
    decay : float, optional, 1/seconds
        Errors decay at least like ``exp(-decay t)``: the disk of radius ``exp(-decay dt)``.
    tolerance : float, optional
        Relative width of the bracket at which bisection ends.
    prove_least : bool, optional
        Prove that no filter has a smaller gain than the least one that was found, also by the dual inequalities (up to
        24 states), which need a semidefinite solver and several times the time of the design.  By default
        only proofs by disturbances over a few samples are tried.  The row "least gain" says whether there is a proof.
    mean : int, optional, samples
        Number of samples over which each fault estimate is averaged; this adds ``(mean - 1) // 2`` to its delay.  The
        gain gamma is proved for the estimate before averaging, which increases no l2 norm.
    steady_error_limit : float, optional
        Largest steady error of the estimate of a constant fault, as a share of the fault, proved on plant and stored
        numbers; a design with a larger error is refused.
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
        An option is out of range, S or W has the wrong shape, or ``W Upsilon`` is not the identity.
    PreconditionError
        ``rank [E; C] < nx`` (eq. (2)) after the algebraic states of a plant of index 1 are eliminated too, dependent
        faults, a fault that reaches no output, ``rank Upsilon < nf`` (Theorem 2 (i)), or an invariant zero from the
        faults to the outputs on or outside the unit circle.
    InfeasibleError
        No filter of this structure reaches ``gamma``, for this T, N and W.
    SolverError
        The result is inconclusive.
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

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]], C=[[1, 0], [0, 1]], Bf=[[1], [0]], Bd=[[0], [1]], dt=1.0
    ... )
    >>> design = obsynth.fault_estimation_filter(plant)
    >>> round(design.certificate.claims["gamma"], 3), design.report.passed
    (0.0, True)
    """

    id: ClassVar[str] = "fault-estimation-filter"
    plants: ClassVar[tuple[PlantKind, ...]] = ("time-invariant", "polytopic")
    time: ClassVar[str] = "discrete"
    summary: ClassVar[str] = "fault estimates with a bounded gain from the disturbances"
    source: ClassVar[str] = "Wang, Rodrigues, Theilliol, Shen 2015"
    claims: ClassVar[Mapping[str, ClaimMeaning]] = {
        "gamma": ClaimMeaning(
            "", "proved bound on the L2 gain from disturbances to the fault-estimate error", "LMI", side="at most"
        ),
        "gamma_min": ClaimMeaning(
            "",
            "smallest gamma for this T, N and W (free weight: T and N); proved where 'least gain' says so, else the "
            "least that the search reached",
            "least gain",
            side="at least",
        ),
        "gamma_bracket_low": ClaimMeaning("", "lower end of the bisection's bracket", "claimed gains", side="at least"),
        "gamma_bracket_high": ClaimMeaning("", "upper end of the bisection's bracket", "claimed gains", side="at most"),
        "region_decay": ClaimMeaning(
            "", "factor by which errors decay in a sample, over the region", DECAY_ROW, side="at most"
        ),
        "state_lag": ClaimMeaning("samples", "samples by which the state estimate lags", "unbiased: state"),
    }
    witnesses: ClassVar[frozenset[str]] = LEAST_GAIN_WITNESSES | {"P_factor", "tracking", *WITNESSES}
    averaged: ClassVar[bool] = True
    recorded: ClassVar[frozenset[str]] = frozenset({"from_gains", "indexes"})
    placed: ClassVar[frozenset[str]] = frozenset({"decay", "region"})
    purposes: ClassVar[frozenset[Purpose]] = frozenset({"faults"})

    gamma: Positive | None = None
    gamma_search: Literal["direct", "bisection"] = "direct"
    gamma_margin: Annotated[float, Ge(LEAST_MARGIN)] = 0.05
    weight: Annotated[Any, WrittenAs("residual weight")] = None
    residual_weight_limit: Positive | None = None
    S: Annotated[Any, WrittenAs("matrix")] = None
    engine: Literal["auto", "riccati", "lmi"] = "auto"
    solver: SolverName = "CLARABEL"
    solver_options: SolverOptions = None
    constraints: OwnConstraints = None
    objective: Annotated[Any, WrittenAs("objective")] = None
    region: OwnRegion = None
    decay: Positive | None = None
    tolerance: OpenUnitInterval = 1e-6
    prove_least: bool = False
    mean: Annotated[FewSamples, Ge(1)] = 1
    steady_error_limit: OpenUnitInterval = STEADY_ERROR

    def is_for_states_as_written(self, plant: DescriptorSystem) -> bool:
        """Whether the option S, the free matrix of the paper, is given."""
        return self.S is not None

    def conflicts(self) -> Iterator[str]:
        """Yield a sentence for each pair of options that exclude each other."""
        if self.weight is not None and not self._is_free and self.residual_weight_limit is not None:
            yield "residual_weight_limit needs a free weight: leave weight out, or set weight: free."
        if self.residual_weight_limit is not None and self.engine == "riccati":
            yield "residual_weight_limit is not covered by engine 'riccati': use 'auto' or 'lmi'."
        if self.objective is not None and "objective" not in own_terms(self):
            yield f"objective is {shown(self.objective)}: give 'h2', or a function of the variables."
        if self.own_inequality and self.gamma_search == "bisection":
            yield "bisection does not know constraints, objective, region and decay: leave gamma_search out."
        beside = ("residual_weight_limit", "prove_least")
        yield from own_term_conflicts(self, beside=beside, engines=("riccati",), named_regions=True)
        if self.decay is not None and self.engine == "riccati":
            yield "engine 'riccati' imposes no decay: use 'auto' or 'lmi'."

    @property
    def _is_free(self) -> bool:
        return isinstance(self.weight, str) and self.weight == "free"

    @property
    def asks_for_free_weight(self) -> bool | None:
        """Whether the options request a free W; ``None`` where they leave it open."""
        if self.weight is not None:
            return self._is_free
        if self.residual_weight_limit is not None:
            return True
        return False if self.S is not None or self.gamma_search == "bisection" else None

    @property
    def given_weight(self) -> FloatArray | None:
        """The matrix W ``(nf, ny)`` that is given, if one is."""
        return None if self.weight is None or isinstance(self.weight, str) else as_matrix(self.weight, "weight")

    def taken_weight(self, *, free: bool) -> str | list[list[float]]:
        """Return the option ``weight`` as it was taken: "free", "paper", or the matrix that is given."""
        if free:
            return "free"
        return "paper" if self.given_weight is None else self.given_weight.tolist()

    @property
    def own_inequality(self) -> bool:
        """Whether (45) is asked for with something else in it."""
        return bool(own_terms(self)) or self.region is not None or self.decay is not None

    def require_fitting(self, plant: DescriptorSystem | PolytopicSystem) -> None:
        """Raise `SpecError` where S has another size than the plant's states and outputs ask for."""
        if self.S is not None:
            nx, ny = len(plant.state_names), len(plant.output_names)
            require_shape(as_matrix(self.S, "S").shape, (nx, nx + ny), "S")

    def existence(self, plant: DescriptorSystem | PolytopicSystem, *, exactly: bool = True) -> tuple[Condition, ...]:
        """Return the existence conditions, decided exactly or in floating point; the list ends at the first failure."""
        if isinstance(plant, PolytopicSystem):
            from obsynth.analysis.existence.over_region import conditions_over_region

            return conditions_over_region(plant, exactly=exactly)
        from obsynth.analysis.existence.wang2015 import fault_filter_conditions

        return fault_filter_conditions(plant, exactly=exactly)

    @classmethod
    def from_gains(  # type: ignore[override]
        cls, plant: DescriptorSystem, *, T: Any, N: Any, L: Any, W: Any, gamma: float | None = None, indexes: Any = None
    ) -> Synthesis:
        """Return realisation and certificate of the gains of eq. (23); see `obsynth.design_from_gains`."""
        from obsynth.methods.fault_estimation_filter.realisation import synthesis_from_gains

        if plant.nd and gamma is None:
            raise SpecError(
                "gamma is needed: the plant has disturbances, and a gain set claims a bound on them.", path="gamma"
            )
        if gamma is not None:
            for label, value in (("gamma", checked_value(gamma, "gamma", Positive)), ("1 / gamma", 1.0 / gamma)):
                require_no_overflow(value, label, "gamma")
        return synthesis_from_gains(plant, T=T, N=N, L=L, W=W, gamma=gamma, indexes=indexes)

    @classmethod
    def requested_limits(cls, design: ObserverDesign) -> Limits:
        """Return that gamma bounds the gain from disturbances, and decay over a region the factor of a sample."""
        limits: Limits = {"gamma": (("gamma", "at most"),)} if "gamma" in design.certificate.claims else {}
        return (
            {**limits, "decay": (("region_decay", "factor"),)}
            if "region_decay" in design.certificate.claims
            else limits
        )

    @classmethod
    def error_model(cls, design: ObserverDesign) -> ErrorModel | None:
        """Return the plant with its past states, which the filter follows; ``None`` without a tracking map."""
        if isinstance(design.plant, PolytopicSystem):
            return None  # one for each vertex: its checks have them
        (plant, observer), tracking = design.linear, design.certificate.matrices.get("tracking")
        if tracking is None:
            return None
        lag = tracking.shape[1] // plant.nx - 1 if observer.order else int(design.certificate.claims["state_lag"])
        return ErrorModel(plant, observer, tracking, lag=lag)

"""The extended Kalman filter of nonlinear plants as a method."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar

from obsynth.analysis.existence.condition import Condition
from obsynth.methods.dae_adaptive_observer.method import DaeAdaptiveObserver, IntegrationChoice
from obsynth.methods.method import ClaimMeaning, Method, PlantKind, Purpose, Synthesis
from obsynth.numerics.arguments import Positive, WrittenAs, field_types
from obsynth.observers.outliers import Outliers
from obsynth.plants.dae import DAEModel


@dataclass(frozen=True)
class ExtendedKalman(Method):
    r"""Design the extended Kalman filter of a plant ``F(x', x, u) = 0``, ``y = h(x)``: its states, with deviations.

    Each step solves the equations from the last estimate; the covariance follows the derivatives of that step, exact
    ones, and is corrected with those of the outputs.

    Parameters
    ----------
    plant : DAEModel
        Index 1, without unknown parameters: ``nx`` states, ``ny`` outputs.
    dt : float
        Seconds between samples; must be given, as Q and R.
    Q : array_like or mapping
        Covariance of what is added to the right sides of the equations in each step ``(nx, nx)``, one variance for
        all, or variances by equation (zero for those not named), in units of the equations squared.
    R : array_like or mapping
        Covariance of the sensors ``(ny, ny)``, one variance for all, or variances by output.
    integration : {"auto", "backward-euler", "radau"}, optional
        Radau IIA of order five where a mode at the nominal point turns by more than 0.05 radians in a step (a note
        says so), else backward Euler.
    initial_state : array_like or mapping, optional
        ``(nx,)``, or values by name; nominal values by default.
    initial_covariance : array_like or mapping, optional
        ``P_0 (nx, nx)`` or variances; deviations of 1 % of the nominal sizes by default.
    largest_move : float, optional
        In nominal sizes of the states: longer steps are taken along a homotopy in the input, so that of several roots
        the connected one is found.
    outliers, outlier_limit, outlier_sizes, sensors, state_bounds
        As for `descriptor_kalman`; but the next step begins at the states within their bounds.
    name : str, optional
        Name of the design.

    Returns
    -------
    ObserverDesign
        ``observer`` is a `DAEObserver`; ``gains``: ``K (nx, ny)`` after 100 steps at nominal inputs.
        ``certificate.claims``: ``index``, ``condition`` of the step's matrix, ``contraction``, ``steps``.

    Raises
    ------
    SpecError
        An option is missing, out of range, or names no signal.
    PreconditionError
        The index is not 1 (the equations involved are named), or the plant has parameters: make them constants, or
        take `dae_adaptive_observer`, which estimates them.
    SolverError
        A step at nominal inputs has no solution.
    VerificationError
        The observer fails a check.

    Notes
    -----
    It is the observer of `dae_adaptive_observer` of a plant without parameters.  Its covariances are first-order ones:
    `verify` runs it on noise and starts as they are stated, and reports the squared errors of the states and the
    innovations that it finds.

    References
    ----------
    .. [AndersonMoore1979] Optimal filtering, section 8.2.
    .. [MoussaAliDAE2013] Adaptive observer based fault diagnosis applied to differential-algebraic systems, IFAC SSSC
       2013, eqs. (5)-(16).

    Examples
    --------
    >>> import obsynth
    >>> tank = obsynth.DAEModel(
    ...     {"balance": "der(level) = inflow - 0.5 * sqrt(level)"},
    ...     {"gauge": "level"},
    ...     states={"level": 1.0},
    ...     inputs={"inflow": 0.5},
    ...     units={"level": "m", "inflow": "m/s", "gauge": "m"},
    ... )
    >>> design = obsynth.extended_kalman(tank, dt=1.0, Q=1e-6, R={"gauge": 1e-4})
    >>> design.observer.state_names, design.report.passed
    (('level',), True)
    """

    id: ClassVar[str] = "extended-kalman"
    plants: ClassVar[tuple[PlantKind, ...]] = ("nonlinear",)
    time: ClassVar[str] = "discrete, nonlinear"
    summary: ClassVar[str] = "states of nonlinear plants"
    source: ClassVar[str] = "Anderson, Moore 1979, section 8.2"
    claims: ClassVar[Mapping[str, ClaimMeaning]] = DaeAdaptiveObserver.claims
    purposes: ClassVar[frozenset[Purpose]] = frozenset({"state despite noise"})
    placeholders: ClassVar[Mapping[str, Any]] = {"dt": 1.0, "Q": 1.0, "R": 1.0}

    dt: Positive | None = None
    Q: Annotated[Any, WrittenAs("named covariance")] = None
    R: Annotated[Any, WrittenAs("named covariance")] = None
    integration: IntegrationChoice = "auto"
    initial_state: Annotated[Any, WrittenAs("named vector")] = None
    initial_covariance: Annotated[Any, WrittenAs("named covariance")] = None
    largest_move: Positive | None = None
    outliers: Outliers | None = None
    outlier_limit: Positive | None = None
    outlier_sizes: Annotated[Any, WrittenAs("named vector")] = None
    sensors: Annotated[Any, WrittenAs("sensor times")] = None
    state_bounds: Annotated[Any, WrittenAs("named pairs")] = None

    def conflicts(self) -> Iterator[str]:
        """Yield a sentence for each rule across options that is broken."""
        if self.dt is None:
            yield "dt is missing: give the seconds between samples."

    def existence(self, plant: DAEModel, *, exactly: bool = True) -> tuple[Condition, ...]:
        """Return the existence conditions; the list ends at the first failure."""
        from obsynth.analysis.existence.moussaali_dae import dae_conditions, known_parameters

        conditions = tuple(
            condition for condition in dae_conditions(plant, self.dt or 1.0) if condition.name == "index"
        )
        if not conditions or not conditions[0].holds:
            return conditions
        return (*conditions, known_parameters(plant))

    def require_stated(self, plant: DAEModel) -> None:
        """Raise `SpecError` where noise is not stated."""
        self.with_adaptation().require_stated(plant)

    def with_adaptation(self) -> DaeAdaptiveObserver:
        """Return the adaptive observer that this filter is where there are no parameters."""
        return DaeAdaptiveObserver(**self.as_given())

    def synthesise(self, plant: DAEModel, *, progress: Callable[[str], None]) -> Synthesis:
        """Return gains, observer and certificate, not yet verified."""
        from obsynth.analysis.existence.condition import require_all
        from obsynth.methods.dae_adaptive_observer.synthesis import synthesise

        require_all(self.existence(plant))
        synthesis = synthesise(plant, self.with_adaptation(), progress=progress)
        options = {name: value for name, value in synthesis.options.items() if name in field_types(type(self))}
        return replace(synthesis, options=options, gains={"K": synthesis.gains["K"]})

"""The descriptor Kalman filter as a method."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

from obsynth.analysis.existence.condition import Condition
from obsynth.methods.engines.recursive.claims import RECURSIVE_CLAIMS
from obsynth.methods.method import ClaimMeaning, Method, PlantKind, Purpose, Synthesis
from obsynth.numerics.arguments import Positive, WrittenAs
from obsynth.observers.outliers import Outliers
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.polytopic import PolytopicSystem
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem
from obsynth.results.checks import Check
from obsynth.results.design import ObserverDesign
from obsynth.verification.over_region import DECAY_ROW, DEVIATION_ROW, GAIN_WITNESSES, WITNESSES


@dataclass(frozen=True)
class DescriptorKalman(Method):
    r"""Design the Kalman filter of a descriptor plant, time-varying or not.

    The estimate at k is the maximum-likelihood estimate of x(k) from y(1) ... y(k) and u(0) ... u(k - 1).  It is
    computed by orthogonal factorisations only, so that covariances may be singular and equations may be exact.

    Parameters
    ----------
    plant : TimeVaryingDescriptorSystem, DescriptorSystem or PolytopicSystem
        ``E (ne, nx)``, ``C (ny, nx)``; a DescriptorSystem must be discrete in time.  The direct effect of known inputs
        on the outputs, ``D u``, is subtracted.  Parameters count as zero.  Unknown inputs are arbitrary: those with a
        direct effect on the outputs become states of the filter and are estimated; the equations that the others enter
        are left out (all of them, if necessary).  For a PolytopicSystem a scheduled observer is designed, with constant
        Q and R and no other option.  Its gains are steady at each vertex, and the mean square of its errors is proved
        for all parameter trajectories.
    Q : MatrixLike, optional
        Covariance ``(ne, ne)`` of mu(k): constant, stack, callable, or rows of expressions in ``k``; a number means
        that multiple of the identity.  By default ``Bw Bw'`` of a DescriptorSystem with noise, else the identity (in
        natural units, if the plant's units are far from these).  If neither Q nor R is given, noise that drives
        equations and outputs at once (``Bw Dw'`` not zero) becomes states of the filter, which are estimated.  A plant
        of index 2 or more is reduced.  A constant Q of its equations is then transformed to the remaining states, as
        are ``initial_state`` and ``initial_covariance``; it is refused if noise in a constraint would be needed at
        another time.
    R : MatrixLike, optional
        Covariance ``(ny, ny)`` of nu(k); by default ``Dw Dw'`` of a DescriptorSystem with noise, else the identity.
    initial_state : array_like, optional
        Mean of x(0), ``(nx,)``; zeros by default.
    initial_covariance : array_like, optional
        ``P_0 (nx, nx)``; by default the identity, as for Q.
    early_constraints : bool, optional
        Use equations of step k + 1 without x(k + 2) already for x(k + 1).  They need u(k + 1), which `step` has; Q must
        not couple them with the other equations.
    outliers : {"none", "gate", "huber"}, optional
        Treatment of a sample that is too far from its prediction: it is used (``none``); rejected, at most twice in a
        row for one sensor (``gate``); or replaced by the limit (``huber``, Huber's weight).  By default there is a gate
        in a run on data, and in a C or FMU file of a nonlinear design, and none elsewhere.  A stated option holds
        everywhere.
    outlier_limit : float, optional
        Limit in standard deviations of the prediction: by default 6 for ``gate`` and 3 for ``huber``.
    outlier_sizes : array_like or mapping, optional
        Least deviations of outliers from their prediction, ``(ny,)`` or by name, in units of the sensors: smaller
        deviations are no outliers, whatever the limit is.  `calibrate` estimates them from a log with outliers.  For
        these sensors two outliers in a row are rejected.
    sensors : mapping, optional
        ``{name: {"every": N, "delay": D}}``: a sensor that is sampled every N rows (k = 0, N, 2 N, ...; the values of a
        log in other rows are not used), or whose values are delayed by D rows.  The value in row k then belongs to row
        ``k - D``, and the observer repeats the rows from there on.
    state_bounds : mapping or array_like, optional
        ``{name: [low, high]}``, or ``(nx, 2)``: reported estimates are projected onto these bounds in the metric of
        their covariance.  Covariance and recursion do not change.
    name : str, optional
        Name of the design.

    Returns
    -------
    ObserverDesign
        ``observer`` is a `RecursiveObserver`; ``gains``: ``L (nx, ne)``, ``K (nx, ny)`` of the last step.
        ``certificate.claims``: ``condition`` (dimensionless; largest of H_k), ``contraction`` (per step),
        ``residual_directions``.  Over a region: a `ScheduledObserver`; ``L (nx, nx)``, ``K (nx, ny)`` and ``S[1]``,
        ...; ``region_deviation``: the root of the mean square of all state errors, averaged over the samples, and
        ``region_decay``.

    Raises
    ------
    SpecError
        A covariance is not symmetric or indefinite, or an option has the wrong shape.
    PreconditionError
        ``rank [E_k; C_k] < nx`` at some k, which is named (with early constraints their rows count; where matrices are
        constant and no option is about the states as written, algebraic states are eliminated instead); where E, A and
        C are constant, a mode with ``|z| >= 1`` that is unobservable; where they change, errors that do not decay along
        the horizon, or outgrow double precision at some k.
    VerificationError
        The observer fails a check.

    Notes
    -----
    Differs from the paper: square roots instead of (9)-(11); (14) and (15), which have misprints, are not needed; y(0)
    is not used, as the model begins with y(1).

    References
    ----------
    .. [Nikoukhah1992] Kalman filtering and Riccati equations for descriptor systems, IEEE TAC 37 (9), Lemmas 2.3, 2.4.
    .. [MoussaAli2013] Fault diagnosis for linear time-varying descriptor systems, IFAC ALCOSP 2013, eqs. (5)-(13).

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]],
    ...     C=[[1, 0], [0, 1]],
    ...     Bf=[[1], [0]],
    ...     dt=1.0,
    ...     sensor_noise={"y1": 0.1, "y2": 0.1},
    ... )
    >>> design = obsynth.descriptor_kalman(plant, Q=0.01)
    >>> design.observer.order, design.report.passed
    (2, True)
    """

    id: ClassVar[str] = "descriptor-kalman"
    plants: ClassVar[tuple[PlantKind, ...]] = ("time-invariant", "time-varying", "polytopic")
    time: ClassVar[str] = "discrete, time-varying"
    summary: ClassVar[str] = "states with deviations from Q and R"
    source: ClassVar[str] = "Nikoukhah, Willsky, Levy 1992"
    claims: ClassVar[Mapping[str, ClaimMeaning]] = {
        **RECURSIVE_CLAIMS,
        "region_deviation": ClaimMeaning(
            "",
            "root mean square of all state errors over a region, averaged over the samples, for the stated noise",
            DEVIATION_ROW,
            side="at most",
        ),
        "region_decay": ClaimMeaning(
            "", "factor a sample by which errors shrink over a region", DECAY_ROW, side="at most"
        ),
    }
    witnesses: ClassVar[frozenset[str]] = frozenset({"tracking", *WITNESSES, *GAIN_WITNESSES})
    purposes: ClassVar[frozenset[Purpose]] = frozenset({"state despite noise"})

    Q: Annotated[Any, WrittenAs("varying covariance")] = None
    R: Annotated[Any, WrittenAs("varying covariance")] = None
    initial_state: Annotated[Any, WrittenAs("vector")] = None
    initial_covariance: Annotated[Any, WrittenAs("covariance")] = None
    early_constraints: bool = False
    outliers: Outliers | None = None
    outlier_limit: Positive | None = None
    outlier_sizes: Annotated[Any, WrittenAs("named vector")] = None
    sensors: Annotated[Any, WrittenAs("sensor times")] = None
    state_bounds: Annotated[Any, WrittenAs("named pairs")] = None

    def existence(
        self, plant: DescriptorSystem | TimeVaryingDescriptorSystem | PolytopicSystem, *, exactly: bool = True
    ) -> tuple[Condition, ...]:
        """Return the existence conditions; the list ends at the first failure."""
        if isinstance(plant, PolytopicSystem):
            from obsynth.analysis.existence.kalman_over_region import kalman_conditions_over_region

            return kalman_conditions_over_region(plant)
        from obsynth.analysis.existence.kalman import kalman_conditions

        return kalman_conditions(plant, early=self.early_constraints)

    def require_stated(self, plant: DescriptorSystem | TimeVaryingDescriptorSystem | PolytopicSystem) -> None:
        """Raise `SpecError` where noise of the plant is none that the method covers, `PreconditionError` where what
        has no noise allows no gains."""
        if isinstance(plant, PolytopicSystem):
            from obsynth.methods.descriptor_kalman.noise_over_region import NoiseOverRegion

            NoiseOverRegion.of(plant, self.Q, self.R)
            return
        from obsynth.methods.engines.recursive.synthesis import require_gains

        require_gains(plant, self)

    def synthesise(
        self,
        plant: DescriptorSystem | TimeVaryingDescriptorSystem | PolytopicSystem,
        *,
        progress: Callable[[str], None],
    ) -> Synthesis:
        """Return gains, observer and certificate, not yet verified."""
        if isinstance(plant, PolytopicSystem):
            from obsynth.methods.descriptor_kalman.over_region import synthesise_over_region

            return synthesise_over_region(plant, self, progress=progress)
        from obsynth.methods.engines.recursive.synthesis import synthesise

        return synthesise(plant, self, progress=progress)

    @classmethod
    def checks(cls, design: ObserverDesign, printed_digits: int | None) -> Iterator[Check]:
        """Yield a row for each claim, from the plant and the shipped realisation alone."""
        if isinstance(design.plant, PolytopicSystem):
            from obsynth.methods.descriptor_kalman.checks_over_region import checks_over_region

            yield from checks_over_region(design)
            return
        from obsynth.methods.engines.recursive.checks import checks

        yield from checks(design, printed_digits)

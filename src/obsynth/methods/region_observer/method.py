"""The observer of nonlinear plants over a region as a method."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from obsynth.analysis.existence.condition import Condition
from obsynth.conditions.options import SolverName, SolverOptions
from obsynth.errors import SpecError
from obsynth.methods.method import ClaimMeaning, Method, PlantKind, Purpose
from obsynth.numerics.arguments import NonNegative, Positive, WrittenAs
from obsynth.plants.dae import DAEModel
from obsynth.verification.over_region import (
    DECAY_ROW,
    DEVIATION_ROW,
    GAIN_WITNESSES,
    REGION_GAIN_ROW,
    WITNESSES,
    slope_name,
)

if TYPE_CHECKING:
    from obsynth.results.design import ObserverDesign
    from obsynth.verification.requested_limits import Limits


@dataclass(frozen=True)
class RegionObserverMethod(Method):
    r"""Design an observer of states and faults of a nonlinear plant, with one proof for a whole region.

    A copy of the plant with one gain.  While the plant stays in the region, whatever its trajectory, errors decay at
    least at the proved rate, and the estimates deviate by less than is proved; the estimate may start anywhere.  The
    slopes of all nonlinearities are enclosed over the region from the texts of the equations, and the inequalities are
    proved at every corner of these slopes; of more than 12 slopes one inequality with a multiplier for each is proved,
    which is sufficient only.

    Parameters
    ----------
    plant : DAEModel
        Its equations as texts; derivatives linear in the states, beside constants; index 1 over the region, which is
        proved.  No formula may jump.
    region : mapping
        Ranges ``{name: [low, high]}`` of states, faults, inputs, or linear combinations of these such as ``"h1 - h2"``:
        at least of everything on which a nonlinearity depends in which there is a state or a fault.
    sample_time : float, seconds
        Between rows; the observer takes steps of implicit Euler, for which the same certificate is proved.
    noise : mapping, optional
        ``{output: standard deviation of a sample}`` for every output, ``{fault: intensity}`` for every fault, in its
        unit per root of a second: how it drifts; and ``{"der(state)": intensity}`` of what drives a state besides.
        Needed but for goal "decay".
    faults : list of str, optional
        Parameters that are estimated; all by default.  The others have their nominal values.
    wanted : mapping, optional
        ``{signal: size}``: differential states and faults whose errors count, each in units of its size; by default the
        faults (without any: the differential states), with sizes of 1 for one, else the widths of their ranges.
    goal : {"power", "gain", "decay"}, optional
        What is made small: the root mean square of the errors for white noise, the L2 gain from the noises (each in
        units of its size) to the errors, or how long errors last.
    decay : float, optional, 1/seconds
        Errors decay at least like ``exp(-decay t)``.
    gains : array_like, optional
        ``(nd + nf, ny)``: given gains of differential states and faults, for which what is claimed is found.
    initial_state : array_like or mapping, optional
        Of states and faults; nominal values by default.
    solver : str, optional
        Any of ``cvxpy.installed_solvers()`` that does semidefinite programmes.
    solver_options : mapping, optional
        Settings of that solver by its own names.
    name : str, optional
        Name of the design.

    Returns
    -------
    ObserverDesign
        ``observer`` is a `RegionObserver`; ``gains``: ``L (nd + nf, ny)``, differential states first.
        ``certificate.claims``: ``region_decay`` (1/s) and ``region_deviation`` or ``region_gain``, proved.

    Raises
    ------
    SpecError
        An option is missing or malformed, or the equations are Python functions.
    PreconditionError
        A slope is not bounded over the region, a formula jumps, E would change with the state, derivatives are
        dependent, or there are more than 64 slopes.
    SolverError
        No certificate was found: inconclusive.
    VerificationError
        The shipped realisation fails a check.

    Notes
    -----
    Nonlinearities are continued beyond their box with a slope between their bounds, so that the mean value theorem
    holds for any estimate while the plant is inside. White noise: the bound holds in continuous time, and for the
    samples of implicit Euler of any step (the noise of a sample enters the step itself). What a step of implicit Euler
    misses of the motion of a plant is in no claim: of a van der Pol oscillator whose deviation is claimed below 0.0309
    it was 0.058 in steps of 0.01 s, and 0.026 in steps of 0.00125 s. A row in which an input, a
    measured combination or the estimate leaves the region is ``out``, and so are those after it until a hundredth
    of the error is left. That a state which is neither is inside is assumed.

    References
    ----------
    .. [Zemouche2013] A. Zemouche, M. Boutayeb, On LMI conditions to design observers for Lipschitz nonlinear systems,
       Automatica 49 (2), 2013: slopes by the mean value theorem; the descriptor form and the continuation are ours.

    Examples
    --------
    >>> import obsynth
    >>> tank = obsynth.DAEModel(
    ...     {"balance": "2.0 * der(level) = inflow - 0.5 * sqrt(level) - leak"}, {"gauge": "level"},
    ...     states={"level": 1.0}, inputs={"inflow": 0.5}, parameters={"leak": 0.0},
    ... )
    >>> design = obsynth.region_observer(
    ...     tank, region={"level": [0.2, 2.0]}, sample_time=1.0, noise={"gauge": 1e-3, "leak": 1e-4}
    ... )
    >>> design.report.passed, design.certificate.claims["region_deviation"] < 5e-3
    (True, True)
    """

    id: ClassVar[str] = "region-observer"
    plants: ClassVar[tuple[PlantKind, ...]] = ("nonlinear",)
    time: ClassVar[str] = "continuous, nonlinear, run in samples"
    summary: ClassVar[str] = "states and faults of nonlinear plants, proved over a region"
    source: ClassVar[str] = "Zemouche, Boutayeb 2013 (slopes); descriptor form ours"
    claims: ClassVar[Mapping[str, ClaimMeaning]] = {
        "region_decay": ClaimMeaning("1/s", "decay of the errors over the region", DECAY_ROW, side="at least"),
        "region_deviation": ClaimMeaning(
            "", "root mean square of the errors that count, for white noise", DEVIATION_ROW, side="at most"
        ),
        "region_gain": ClaimMeaning(
            "", "L2 gain from the noises to the errors that count", REGION_GAIN_ROW, side="at most"
        ),
    }
    witnesses: ClassVar[frozenset[str]] = frozenset(
        {*WITNESSES, *GAIN_WITNESSES, slope_name(WITNESSES), slope_name(GAIN_WITNESSES)}
    )
    purposes: ClassVar[frozenset[Purpose]] = frozenset()
    placeholders: ClassVar[Mapping[str, Any]] = {"sample_time": 1.0, "goal": "decay"}

    region: Annotated[Any, WrittenAs("named pairs")] = None
    sample_time: Positive | None = None
    noise: Annotated[Any, WrittenAs("named vector")] = None
    faults: Annotated[Any, WrittenAs("texts")] = None
    wanted: Annotated[Any, WrittenAs("named vector")] = None
    goal: Literal["power", "gain", "decay"] = "power"
    decay: NonNegative | None = None
    gains: Annotated[Any, WrittenAs("matrix")] = None
    initial_state: Annotated[Any, WrittenAs("named vector")] = None
    solver: SolverName = "CLARABEL"
    solver_options: SolverOptions = None

    def conflicts(self) -> Iterator[str]:
        """Yield a sentence for each rule across options that is broken."""
        if self.sample_time is None:
            yield "sample_time is missing: give the seconds between samples."
        if self.goal != "decay" and self.noise is None:
            yield "noise is missing: give deviations of the outputs and how faults drift, or goal: decay."
        if self.faults is not None and not all(isinstance(name, str) for name in self.faults):
            yield "faults must be a list of names."

    def existence(self, plant: DAEModel, *, exactly: bool = True) -> tuple[Condition, ...]:
        """Return the existence conditions; the list ends at the first failure."""
        from obsynth.analysis.existence.nonlinear_region import region_conditions

        return region_conditions(plant, self.region, self.fault_names(plant), self.sample_time)

    @classmethod
    def requested_limits(cls, design: ObserverDesign) -> Limits:
        """Return that decay bounds the rate over the region."""
        return {"decay": (("region_decay", "at least"),)}

    def fault_names(self, plant: DAEModel) -> tuple[str, ...]:
        """Return the parameters that are estimated."""
        if self.faults is None:
            return tuple(plant.parameter_names)
        return (self.faults,) if isinstance(self.faults, str) else tuple(self.faults)

    def require_stated(self, plant: DAEModel) -> None:
        """Raise `SpecError` where the region is missing."""
        if self.region is None:
            raise SpecError(
                "region is missing: give ranges of the signals, such as {'level': [0.2, 2.0]}.",
                path="method.options.region",
            )

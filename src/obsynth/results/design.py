"""The result of every method: its options, the gains and the observer, and the certificate."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from obsynth.errors import SpecError, VerificationError
from obsynth.numerics.arrays import FloatArray, freeze, read_only
from obsynth.numerics.suggestions import fields_suggested, no_attribute
from obsynth.observers.linear.observer import LinearObserver
from obsynth.observers.nonlinear.observer import DAEObserver
from obsynth.observers.nonlinear.region_observer import RegionObserver
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.observers.scheduled.observer import ScheduledObserver
from obsynth.observers.sensor_timing import LONGEST_DELAY
from obsynth.observers.window.observer import WindowObserver
from obsynth.plants.dae import DAEModel
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.polytopic import PolytopicSystem
from obsynth.plants.signal_names import listed
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem
from obsynth.plants.transformations.recovery import StateRecovery
from obsynth.results.checks import with_verdict
from obsynth.results.gain_set_writing import digest_of as digest_of
from obsynth.results.gain_set_writing import save
from obsynth.results.plant_source import PlantSource
from obsynth.results.registered import registered
from obsynth.results.verification_report import VerificationReport

if TYPE_CHECKING:
    import control


OfObserver = TypeVar("OfObserver")

OfPlant = TypeVar("OfPlant")

#: What to write instead of an attribute that a design does not have.
ELSEWHERE = {
    "claims": "design.certificate.claims",
    "summary": "print(design)",
    **dict.fromkeys(("poles", "eigenvalues"), "design.to_control().poles()"),
    **dict.fromkeys(("A", "B", "C", "D", "ss", "to_ss", "to_statespace"), "design.to_control() or design.to_scipy()"),
    "verify": "obsynth.verify(design)",
    "simulate": "obsynth.simulate(design, scenario)",
    "evaluate": "obsynth.evaluate(design, scenario)",
    "run": "obsynth.run_on_data(design, log)",
    "monitor": "obsynth.monitor(design, scenario)",
    "export": "obsynth.export(design, 'observer.c')",
    "plot": "obsynth.plotting.plot_poles(design)",
    **dict.fromkeys(("html", "to_html", "page"), "obsynth.html_report(design)"),
    "to_json": "design.save(path)",
}

#: Checks that a mark names; the others are counted.
_MOST_NAMED_CHECKS = 4


@fields_suggested
@dataclass(frozen=True, eq=False)
class Certificate:
    """Matrices and claims from which a design can be rechecked without a solver.

    Parameters
    ----------
    matrices : mapping of str to FloatArray
        Witnesses of existence statements, such as the Lyapunov matrix of a matrix inequality.
    claims : mapping of str to float
        Numbers that are claimed, such as an l2 gain.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]], C=[[1, 0], [0, 1]], Bf=[[1], [0]], Bd=[[0], [1]], dt=1.0
    ... )
    >>> design = obsynth.fault_estimation_filter(plant)
    >>> sorted(design.certificate.claims)
    ['gamma', 'gamma_min', 'state_lag']
    """

    matrices: Mapping[str, FloatArray]
    claims: Mapping[str, float]

    def __repr__(self) -> str:
        claims = ", ".join(f"{name} = {value:.6g}" for name, value in self.claims.items())
        shapes = ", ".join(f"{name} {matrix.shape}" for name, matrix in self.matrices.items())
        return f"<Certificate: claims {claims or 'none'}; matrices {shapes or 'none'}>"

    def __post_init__(self) -> None:
        freeze(self, "claims", matrices={name: read_only(matrix) for name, matrix in self.matrices.items()})


@fields_suggested
@dataclass(frozen=True, eq=False, repr=False)
class ObserverDesign:
    """A finished design: gains to read, an observer to run, a certificate and a report.

    Parameters
    ----------
    name : str
        Name of the design, from the spec or the caller.
    method : str
        Identifier of the method.
    plant : DescriptorSystem, TimeVaryingDescriptorSystem, PolytopicSystem or DAEModel
        The plant the observer is for (after the transformations a spec asks for).
    options : mapping
        Options as resolved, plain data.
    gains : mapping of str to FloatArray
        Gains with the paper's letters, for readers; what is shipped is `observer`.
    observer : LinearObserver, RecursiveObserver, ScheduledObserver, RegionObserver or DAEObserver
        What is shipped.
    certificate : Certificate
        Enough to recheck every claim without a solver.
    solver : mapping
        Name, version, status, settings, iterations and time of each solver run, plain data.
    notes : tuple of str
        What a user should know: warnings and limits.
    recovery : StateRecovery, optional
        Map from the plant's states back to those of the plant before its transformation.
    report : VerificationReport
        The report of this very object.
    source : PlantSource, optional
        The plant as written, where algebraic states were eliminated or the plant was sampled: `verify` does it again.
    input_delay : int
        Rows by which inputs of a log act later than this design takes them.  Designs of linear discrete and of
        time-varying plants take the inputs of a row to act during the step that begins there, those of nonlinear plants
        during the step that ends there, continuous ones as straight lines between rows.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]], C=[[1, 0], [0, 1]], Bf=[[1], [0]], Bd=[[0], [1]], dt=1.0
    ... )
    >>> design = obsynth.fault_estimation_filter(plant)
    >>> design.method, design.report.passed, design.observer.order
    ('fault-estimation-filter', True, 2)
    """

    name: str
    method: str
    plant: DescriptorSystem | TimeVaryingDescriptorSystem | PolytopicSystem | DAEModel
    options: Mapping[str, Any]
    gains: Mapping[str, FloatArray]
    observer: LinearObserver | RecursiveObserver | DAEObserver | WindowObserver | ScheduledObserver | RegionObserver
    certificate: Certificate
    solver: Mapping[str, Any]
    notes: tuple[str, ...] = ()
    recovery: StateRecovery | None = None
    report: VerificationReport = field(default_factory=VerificationReport)
    source: PlantSource | None = None
    input_delay: int = 0

    def __post_init__(self) -> None:
        rows = self.input_delay
        if isinstance(rows, bool) or not isinstance(rows, int) or abs(rows) > LONGEST_DELAY:
            raise SpecError(
                f"input_delay is {rows!r}: give a whole number of rows, at most {LONGEST_DELAY}.", path="input_delay"
            )
        freeze(self, "options", "solver", gains={name: read_only(matrix) for name, matrix in self.gains.items()})

    @property
    def linear(self) -> tuple[DescriptorSystem, LinearObserver]:
        """Plant and observer of a linear time-invariant design.

        Raises
        ------
        SpecError
            The design is a recursive one.
        """
        return self._parts(DescriptorSystem, LinearObserver, "linear time-invariant observer")

    @property
    def recursive(self) -> tuple[TimeVaryingDescriptorSystem, RecursiveObserver]:
        """Plant and observer of a recursive design.

        Raises
        ------
        SpecError
            The design is a linear time-invariant one.
        """
        return self._parts(TimeVaryingDescriptorSystem, RecursiveObserver, "recursive observer")

    @property
    def scheduled(self) -> tuple[PolytopicSystem, ScheduledObserver]:
        """Plant and observer of a design over a region.

        Raises
        ------
        SpecError
            The design is for one point.
        """
        return self._parts(PolytopicSystem, ScheduledObserver, "scheduled observer")

    @property
    def over_region(self) -> tuple[DAEModel, RegionObserver]:
        """Plant and observer of a design over a region of a nonlinear plant.

        Raises
        ------
        SpecError
            The design is of another kind.
        """
        return self._parts(DAEModel, RegionObserver, "observer of a nonlinear plant over a region")

    @property
    def nonlinear(self) -> tuple[DAEModel, DAEObserver]:
        """Plant and observer of a nonlinear design.

        Raises
        ------
        SpecError
            The design is for a linear plant.
        """
        return self._parts(DAEModel, DAEObserver, "observer of a nonlinear plant")

    def _parts(self, plant: type[OfPlant], observer: type[OfObserver], what: str) -> tuple[OfPlant, OfObserver]:
        if not isinstance(self.plant, plant) or not isinstance(self.observer, observer):
            raise SpecError(f"Design {self.name!r} is no {what}.", path="observer")
        return self.plant, self.observer

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            own = {letter: f"design.gains[{letter!r}]" for letter in self.__dict__.get("gains", ())}
            if "certificate" in self.__dict__:
                own |= {claim: f"design.certificate.claims[{claim!r}]" for claim in self.certificate.claims}
            raise no_attribute(self, name, ELSEWHERE | own)

    def __repr__(self) -> str:
        """Return name, method and verdict in one line; ``print(design)`` shows the summary."""
        verdict = "verified" if self.report.passed else "NOT verified"
        return f"<ObserverDesign {self.name!r} by {self.method}: {verdict}>"

    def __str__(self) -> str:
        """Return the summary: what it is, what each estimate is worth, what it rests on."""
        return str(registered("summary_of_design")(self))

    def _repr_html_(self) -> str:
        return str(registered("summary_of_design")(self).html())

    def replace(self, **changes: Any) -> ObserverDesign:
        """Return the design with some fields changed (its report stays until `verify` is run again).

        Parameters
        ----------
        **changes
            Any field.
        """
        return replace(self, **changes)

    def save(self, path: str | Path) -> Path:
        """Write the gain set as one JSON document, atomically.

        Parameters
        ----------
        path : str or Path
            Where to write; an existing file is replaced.

        Returns
        -------
        Path
            The file.

        Raises
        ------
        SpecError
            The file cannot be written.
        """
        return save(self, path)

    def conditions(self) -> Any:
        """Return the `obsynth.conditions.Conditions` of the design's paper, with what is shipped put in.

        Every variable has the value of the certificate, so that each constraint can be evaluated:
        ``constraint.violation()`` is zero to rounding, whichever engine found the gains.

        Raises
        ------
        SpecError
            The method is not made of matrix inequalities, or the plant changes with k.
        """
        return registered("conditions_of_design")(self)

    def to_scipy(self) -> Any:
        """Return the observer as a ``scipy.signal`` state space from ``[u; y]`` to ``[xhat; fhat; r]``.

        A ``scipy.signal.StateSpace``, with ``dt`` in seconds where the design is discrete.  Of a recursive design for
        a time-invariant plant it is the steady state of the recursion.

        Raises
        ------
        SpecError
            The plant changes with k or is nonlinear: there is no constant realisation.
        PreconditionError, SolverError
            A recursive design has no stable steady state.
        """
        from scipy.signal import StateSpace

        observer = self._constant_observer()
        matrices = _from_inputs_and_outputs(observer)
        return StateSpace(*matrices, dt=observer.dt) if observer.dt > 0.0 else StateSpace(*matrices)

    def _constant_observer(self) -> LinearObserver:
        """Return the observer, of a recursive design its steady state."""
        from obsynth.observers.recursive.steady_observer import steady_observer

        if isinstance(self.observer, RecursiveObserver):
            return steady_observer(self.observer).observer
        return self.linear[1]

    def to_control(self) -> control.StateSpace:
        """Return the observer as a ``control.StateSpace`` from ``[u; y]`` to ``[xhat; fhat; r]``, with names.

        Of a recursive design for a time-invariant plant it is the steady state of the recursion.

        Raises
        ------
        SpecError
            The plant changes with k or is nonlinear: there is no constant realisation.
        PreconditionError, SolverError
            A recursive design has no stable steady state.
        """
        import control

        observer = self._constant_observer()
        return control.ss(
            *_from_inputs_and_outputs(observer),
            observer.dt,
            inputs=[*observer.input_names, *observer.output_names],
            outputs=list(observer.row_names),
            states=[f"z[{i + 1}]" for i in range(observer.order)],
            name=self.name,
        )


def _from_inputs_and_outputs(observer: LinearObserver) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return A, B, C and D from ``[u; y]`` to the rows of the observer."""
    if observer.constant is not None:
        raise SpecError("The observer adds a constant to its rows, which this form has no place for.", path="observer")

    return (
        observer.Az,
        np.hstack([observer.Bu, observer.By]),
        observer.Cz,
        np.hstack([observer.Du, observer.Dy]),
    )


def unverified_mark(report: VerificationReport) -> str:
    """Return what is written beside a design whose report fails, in one line of plain text; empty where it holds."""
    if report.passed:
        return ""
    names = [check.name for check in report.failures]
    if not names:
        return "UNVERIFIED: no check was made"
    count = len(with_verdict(report.checks))
    return f"UNVERIFIED: {len(names)} of {count} checks FAIL: {listed(names, most=_MOST_NAMED_CHECKS)}"


def require_verified(design: ObserverDesign, *, unverified: bool = False) -> None:
    """Raise `VerificationError` where the report of a design fails, unless it is wanted ``unverified``.
    A design that was put together by hand and has no report is the caller's own: it is marked, not refused."""
    report = design.report
    if unverified or report.passed or not report.checks:
        return
    raise VerificationError(
        f"{design.name!r} fails its verification ({unverified_mark(report).partition(': ')[2]}): it is not used. "
        "Design it again, or allow it (--unverified, unverified=True): every file that is written then says so.",
        report=report,
    )


def describe_parameters(result: type[ObserverDesign]) -> None:
    """Give a kind of design the parameters of every design in its docstring, before its examples."""
    summary, header, examples = (result.__doc__ or "").partition("Examples\n")
    parameters = (ObserverDesign.__doc__ or "").partition("\n")[2].partition("Examples\n")
    result.__doc__ = summary.rstrip(" ") + parameters[0] + "".join((header, examples) if header else parameters[1:])

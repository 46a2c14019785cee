"""The result of every method: what was asked, what is shipped, and the proof; the plant as written behind it."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from obsynth.analysis.transformations.recovery import StateRecovery, Transformation
from obsynth.errors import SpecError, VerificationError
from obsynth.extensions import extension
from obsynth.numerics.arguments import require_kind
from obsynth.numerics.arrays import FloatArray, freeze, read_only
from obsynth.observers.linear.observer import LinearObserver
from obsynth.observers.sensor_timing import LONGEST_DELAY
from obsynth.plants.dae.model import DAEModel
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.validation import listed
from obsynth.results.checks import Check, all_hold
from obsynth.results.gain_set_writing import save

if TYPE_CHECKING:
    import control

    from obsynth.observers.dae.observer import DAEObserver
    from obsynth.observers.recursive.observer import RecursiveObserver
    from obsynth.observers.windows import WindowObserver
    from obsynth.plants.time_varying import TimeVaryingDescriptorSystem

OfPlant = TypeVar("OfPlant")
OfObserver = TypeVar("OfObserver")
#: Larger plants are not stored: their elimination is checked where it is done.
MOST_STORED_STATES = 500


#: Checks by the names that they had once; asked for by these, they answer with a DeprecationWarning.
FORMER_NAMES = {"state part": "state error alone", "P part alone": "proportional part alone"}


@dataclass(frozen=True)
class VerificationReport:
    """All checks of one design; an empty report fails.

    Parameters
    ----------
    checks : tuple of Check
        The rows, in the order of the argument they make.
    """

    checks: tuple[Check, ...] = field(default_factory=tuple)

    @classmethod
    def of(cls, checks: Iterable[Check]) -> VerificationReport:
        """Return a report.

        Parameters
        ----------
        checks : iterable of Check
            Its rows.
        """
        return cls(tuple(checks))

    @property
    def passed(self) -> bool:
        """Whether there is at least one real check and all of them hold."""
        return all_hold(self.checks)

    @property
    def failures(self) -> tuple[Check, ...]:
        """The checks that do not hold."""
        return tuple(check for check in self.checks if not check.passed)

    def __getitem__(self, name: str) -> Check:
        for check in self.checks:
            if check.name == name:
                return check
        if name in FORMER_NAMES:
            warnings.warn(f"The check {name!r} is now {FORMER_NAMES[name]!r}.", DeprecationWarning, stacklevel=2)
            return self[FORMER_NAMES[name]]
        raise KeyError(f"no check named {name!r}; there are: {', '.join(c.name for c in self.checks)}")

    def __str__(self) -> str:
        """Return the table of the checks."""
        from obsynth.results.layout import report_text

        return report_text(self.checks)

    def as_dict(self) -> dict[str, Any]:
        """Return the report as plain data."""
        rows = [asdict(check) for check in self.checks]
        for row in rows:
            if not row["unclear"]:
                del row["unclear"]
        return {"passed": self.passed, "checks": rows}

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> VerificationReport:
        """Return the report that `as_dict` wrote.

        Parameters
        ----------
        data : dict
            With the key ``checks``.
        """
        require_kind(data, dict, "data", "what as_dict() returns")
        return cls.of(Check(**row) for row in data["checks"])


@dataclass(frozen=True, eq=False)
class PlantSource:
    """A plant as it was written; its algebraic states were eliminated, and it was sampled if there is a sample time."""

    plant: DescriptorSystem
    sample_time: float | None = None

    @cached_property
    def derived(self) -> Transformation:
        """The elimination, and the sampling where there was one, done again; once for all checks."""
        from obsynth.analysis.transformations.elimination import eliminate_algebraic_states
        from obsynth.analysis.transformations.sampling import discretise

        if self.sample_time is None:
            return eliminate_algebraic_states(self.plant)
        return discretise(self.plant, self.sample_time)

    @cached_property
    def smooth(self) -> DescriptorSystem:
        """The plant without its algebraic states, before it is sampled; made once for all checks."""
        from obsynth.analysis.transformations.elimination import eliminate_algebraic_states

        return eliminate_algebraic_states(self.plant).plant

    def as_dict(self) -> dict[str, Any]:
        """Return the source as data: matrices by their entries that are not zero."""
        values = self.plant.as_dict()
        values.pop("uncertainty", None)
        matrices = {name: _entries(value) for name, value in values.items() if isinstance(value, np.ndarray)}
        others = {name: value for name, value in values.items() if name not in matrices}
        return {"matrices": matrices, "signals": others, "sample_time": self.sample_time}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> PlantSource:
        """Return the source that `as_dict` described."""
        matrices: dict[str, Any] = {name: _matrix(entries) for name, entries in data["matrices"].items()}
        time = data["sample_time"]
        return cls(DescriptorSystem(**matrices, **data["signals"]), None if time is None else float(time))


def _entries(matrix: FloatArray) -> dict[str, Any]:
    rows, columns = np.nonzero(matrix)
    return {
        "size": list(matrix.shape),
        "rows": rows.tolist(),
        "columns": columns.tolist(),
        "values": matrix[rows, columns].tolist(),
    }


def _matrix(entries: Mapping[str, Any]) -> FloatArray:
    found = np.zeros([int(size) for size in entries["size"]])
    found[np.array(entries["rows"], dtype=np.int64), np.array(entries["columns"], dtype=np.int64)] = entries["values"]
    return found


def source_of(plant: Any) -> PlantSource | None:
    """Return what a plant was made from by elimination and sampling, where that is known and can be stored."""
    made = getattr(plant, "_made_from", None)
    if made is None or type(made[0]) is not DescriptorSystem or made[0].nx > MOST_STORED_STATES:
        return None
    return PlantSource(made[0], made[1])


@dataclass(frozen=True, eq=False)
class Certificate:
    """Matrices and claims from which a design can be rechecked without a solver.

    Parameters
    ----------
    matrices : mapping of str to FloatArray
        Witnesses of existence statements, such as the Lyapunov matrix of a matrix inequality.
    claims : mapping of str to float
        Numbers that are claimed, such as an l2 gain.
    """

    matrices: Mapping[str, FloatArray]
    claims: Mapping[str, float]

    def __post_init__(self) -> None:
        freeze(self, "claims", matrices={name: read_only(matrix) for name, matrix in self.matrices.items()})


@dataclass(frozen=True, eq=False, repr=False)
class ObserverDesign:
    """A finished design: gains to read, an observer to run, a certificate and a report.

    Parameters
    ----------
    name : str
        Name of the design, from the spec or the caller.
    method : str
        Identifier of the method.
    plant : DescriptorSystem, TimeVaryingDescriptorSystem or DAEModel
        The plant the observer is for (after the transformations a spec asks for).
    options : mapping
        Options as resolved, plain data.
    gains : mapping of str to FloatArray
        Gains with the paper's letters, for readers; what is shipped is `observer`.
    observer : LinearObserver, RecursiveObserver or DAEObserver
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
    """

    name: str
    method: str
    plant: DescriptorSystem | TimeVaryingDescriptorSystem | DAEModel
    options: Mapping[str, Any]
    gains: Mapping[str, FloatArray]
    observer: LinearObserver | RecursiveObserver | DAEObserver | WindowObserver
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
        from obsynth.observers.recursive.observer import RecursiveObserver
        from obsynth.plants.time_varying import TimeVaryingDescriptorSystem

        return self._parts(TimeVaryingDescriptorSystem, RecursiveObserver, "recursive observer")

    @property
    def nonlinear(self) -> tuple[DAEModel, DAEObserver]:
        """Plant and observer of a nonlinear design.

        Raises
        ------
        SpecError
            The design is for a linear plant.
        """
        from obsynth.observers.dae.observer import DAEObserver

        return self._parts(DAEModel, DAEObserver, "observer of a nonlinear plant")

    def _parts(self, plant: type[OfPlant], observer: type[OfObserver], what: str) -> tuple[OfPlant, OfObserver]:
        if not isinstance(self.plant, plant) or not isinstance(self.observer, observer):
            raise SpecError(f"Design {self.name!r} is no {what}.", path="observer")
        return self.plant, self.observer

    def __repr__(self) -> str:
        """Return name, method and verdict in one line; ``print(design)`` shows the summary."""
        verdict = "verified" if self.report.passed else "NOT verified"
        return f"<ObserverDesign {self.name!r} by {self.method}: {verdict}>"

    def __str__(self) -> str:
        """Return the summary: what it is, what each estimate is worth, what it rests on."""
        return str(extension("design summary")(self))

    def _repr_html_(self) -> str:
        return str(extension("design summary")(self).html())

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
        return extension("conditions of a design")(self)

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
        from obsynth.observers.recursive.gain_schedule import steady_observer
        from obsynth.observers.recursive.observer import RecursiveObserver

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
    import numpy as np

    return (
        observer.Az,
        np.hstack([observer.Bu, observer.By]),
        observer.Cz,
        np.hstack([observer.Du, observer.Dy]),
    )


#: Checks that a mark names; the others are counted.
_MOST_NAMED_CHECKS = 4


def unverified_mark(report: VerificationReport) -> str:
    """Return what is written beside a design whose report fails, in one line of plain text; empty where it holds."""
    if report.passed:
        return ""
    names = [check.name for check in report.failures]
    if not names:
        return "UNVERIFIED: no check was made"
    return f"UNVERIFIED: {len(names)} of {len(report.checks)} checks FAIL: {listed(names, most=_MOST_NAMED_CHECKS)}"


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

"""The errors of obsynth: one class for each kind of failure, with its exit code and machine-readable facts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol


class Report(Protocol):
    """What an error tells of a verification report; `obsynth.VerificationReport` is one."""

    @property
    def failures(self) -> tuple[Any, ...]:
        """The checks that do not hold."""

    def as_dict(self) -> dict[str, Any]:
        """Return the report as plain data."""


def a_kind(value: Any) -> str:
    """Return what kind of thing a value is, with its article, for a message: ``an int``."""
    if value is None:
        return "missing"
    name = type(value).__name__
    return f"an {name}" if name[:1].lower() in "aeio" else f"a {name}"


def counted(count: int, noun: str, plural: str = "") -> str:
    """Return a number with its noun, for a message: ``1 row``, ``2 rows``."""
    return f"{count} {noun if count == 1 else plural or f'{noun}s'}"


def _plain(value: Any) -> Any:
    """Return an attribute of an error as plain data."""
    if isinstance(value, complex):
        return [value.real, value.imag]
    if isinstance(value, Mapping):
        return {key: str(item) for key, item in value.items()}
    if isinstance(value, tuple):
        return [_plain(item) for item in value]
    return value.as_dict() if hasattr(value, "as_dict") else value


class ObsynthError(Exception):
    """Base class of every error that obsynth raises on purpose.

    Parameters
    ----------
    *args
        The message.

    Attributes
    ----------
    exit_code : int
        Exit code of the command line when this error ends it.

    Examples
    --------
    >>> import obsynth
    >>> issubclass(obsynth.SpecError, obsynth.ObsynthError), obsynth.SpecError.exit_code
    (True, 2)
    """

    exit_code = 1
    _told: tuple[str, ...] = ()

    def __init__(self, *args: object) -> None:
        super().__init__(*args)

    def as_dict(self) -> dict[str, Any]:
        """Return the error as plain data, for ``--json``."""
        facts = {name: _plain(getattr(self, name)) for name in self._told}
        return {"error": type(self).__name__, "exit_code": self.exit_code, "message": str(self), **facts}


class SpecError(ObsynthError):
    """A document, a matrix or a file is malformed.

    Parameters
    ----------
    message : str
        What is wrong and what to do.
    path : str, optional
        Where: a file, or a path inside a document such as ``plant.E``.
    problems : sequence of str, optional
        All problems found, when there are several; they are appended to the message.
    code : str, optional
        Short name of the problem that stays the same, for programs; empty if it has none.

    Examples
    --------
    >>> import obsynth
    >>> try:
    ...     obsynth.DescriptorSystem(A=[[1, 2]], C=[[1, 0]], dt=1.0)
    ... except obsynth.SpecError as error:
    ...     print(error.path, error.exit_code)
    A 2
    """

    exit_code = 2
    _told = ("path", "problems", "code")

    def __init__(self, message: str, *, path: str | None = None, problems: Sequence[str] = (), code: str = "") -> None:
        self.path = path
        self.code = code
        self.problems = tuple(problems)
        lines = [message, *(f"  - {problem}" for problem in self.problems)]
        super().__init__("\n".join(lines))


class PreconditionError(ObsynthError):
    """No design of this kind exists, whatever the solver, or the method does not take the plant as it is: the message
    says which.

    Parameters
    ----------
    message : str
        Which condition fails, where, and what to do.
    condition : str
        Short name of the condition, for example ``rank [E; C]``.
    mode : complex, optional
        The eigenvalue or zero at which it fails.
    signals : sequence of str, optional
        Names of the faults, states or outputs involved.
    add : sequence of sequence of str, optional
        Sets of states, the measurement of any one of which would make the design possible.
    unclear : bool, optional
        Whether double precision cannot decide the condition.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]], C=[[1, 0], [0, 1]], Bf=[[1], [0]], Bd=[[0], [1]], dt=1.0
    ... )
    >>> try:
    ...     obsynth.pd_observer(plant)
    ... except obsynth.PreconditionError as error:
    ...     print(error.condition)
    continuous time
    """

    exit_code = 3
    _told = ("condition", "code", "mode", "signals", "add")

    def __init__(
        self,
        message: str,
        *,
        condition: str,
        mode: complex | None = None,
        signals: Sequence[str] = (),
        add: Sequence[Sequence[str]] = (),
        unclear: bool = False,
    ) -> None:
        self.unclear = unclear
        self.add = tuple(tuple(names) for names in add)
        self.condition = self.code = condition
        self.mode = None if mode is None else complex(mode)
        self.signals = tuple(signals)
        super().__init__(message)


class InfeasibleError(ObsynthError):
    """The matrix inequalities have no solution, and a checked certificate proves it.

    Parameters
    ----------
    message : str
        What was asked, what is proved, and what to do.
    necessary : bool
        True if the inequalities are necessary for the design (so none exists); False if they are only
        sufficient (so another method or choice may still find one).
    lower_bound : float, optional
        The proved lower bound on the quantity that was asked for.
    """

    exit_code = 4
    _told = ("necessary", "lower_bound")

    def __init__(self, message: str, *, necessary: bool, lower_bound: float | None = None) -> None:
        self.necessary = necessary
        self.lower_bound = lower_bound
        super().__init__(message)


class SolverError(ObsynthError):
    """A solver ended without an answer that passes our own checks: the result is inconclusive.

    Parameters
    ----------
    message : str
        What was being solved and what to try.
    record : mapping, optional
        Solver name, version, status and iterations, as far as known.
    """

    exit_code = 5
    _told = ("record",)

    def __init__(self, message: str, *, record: Mapping[str, Any] | None = None) -> None:
        self.record = dict(record or {})
        super().__init__(message)


class VerificationError(ObsynthError):
    """Gains exist, but at least one check of the shipped realisation failed.

    Parameters
    ----------
    message : str
        Which checks failed.
    report : VerificationReport
        The whole report.
    """

    exit_code = 6
    _told = ("report",)

    def __init__(self, message: str, *, report: Report) -> None:
        self.report = report
        super().__init__(message)

"""Sweeps: many designs over plants, operating points, sensor sets and options, on any executor."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import numpy as np

from obsynth.errors import ObsynthError, SpecError
from obsynth.methods.registry import Plant
from obsynth.numerics.arguments import arguments_checked
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.progress import RunsProgress, progress_of_runs
from obsynth.results.design import ObserverDesign
from obsynth.results.gain_set_writing import gain_set_bytes, plain
from obsynth.results.gain_sets import load, loaded
from obsynth.studies.cases import plant_cases, spec_cases
from obsynth.studies.work import WORK_STATUSES, ResultFolder, ResultTable, Work, all_of, carried_out
from obsynth.version import __version__

if TYPE_CHECKING:
    from matplotlib.figure import Figure


_SWEEP_KIND = "obsynth sweep result"

_PLANT_TYPES = get_args(Plant)


@dataclass(frozen=True, eq=False)
class SweepResult:
    """What one case of a sweep came to.

    Parameters
    ----------
    name : str
        Of the case: its spec or plant, and what was varied.
    parameters : mapping
        Value of each varied parameter.
    status : str
        ``designed``, ``impossible`` (a condition fails), ``infeasible`` (proved), ``unknown`` (a solver gave up),
        ``unverified`` or ``malformed``.
    message : str
        Why there is no design; empty otherwise.
    condition : str
        The existence condition that fails; empty otherwise.
    signals : tuple of str
        The signals it names.
    claims : mapping of str to float
        Claims of the certificate; empty without a design.
    facts : mapping
        Method, numbers of states, faults and disturbances, and checks passed.
    seconds : float
        Processor time of the design and its verification, where it was made.
    file : Path or None
        The gain set, where the sweep has a folder.
    content : bytes or None
        The gain set, where it has none.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]], C=[[1, 0], [0, 1]], Bf=[[1], [0]], Bd=[[0], [1]], dt=1.0
    ... )
    >>> result = obsynth.sweep(plant, {"decay": [0.2]}, method="ui-pi-observer").results[0]
    >>> result.status, dict(result.parameters)
    ('designed', {'decay': 0.2})
    """

    name: str
    parameters: Mapping[str, Any]
    status: str
    message: str = ""
    condition: str = ""
    signals: tuple[str, ...] = ()
    claims: Mapping[str, float] = field(default_factory=dict)
    facts: Mapping[str, Any] = field(default_factory=dict)
    seconds: float = 0.0
    file: Path | None = None
    content: bytes | None = field(default=None, repr=False)

    @property
    def design(self) -> ObserverDesign:
        """The design, read back.

        Raises
        ------
        SpecError
            There is none; the message says why.
        """
        if self.file is not None:
            return load(self.file)
        if self.content is None:
            raise SpecError(f"The case {self.name!r} has no design: {self.message or self.status}", path="design")
        return loaded(self.content, self.name)


@dataclass(frozen=True, eq=False)
class Sweep(ResultTable):
    """All results of a sweep, in the order of its cases.

    Parameters
    ----------
    results : tuple of SweepResult
        One for each case.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]], C=[[1, 0], [0, 1]], Bf=[[1], [0]], Bd=[[0], [1]], dt=1.0
    ... )
    >>> grid = obsynth.sweep(plant, {"decay": [0.2, 0.5]}, method="ui-pi-observer")
    >>> len(grid.results), grid.counts
    (2, {'designed': 2})
    """

    results: tuple[SweepResult, ...]

    def __repr__(self) -> str:
        """Return the table as text."""
        from obsynth.results.layout import printed
        from obsynth.studies.printed_cases import printed_cases

        return printed(lambda console: console.print(printed_cases(self, console.width, rest="table()")))

    @property
    def _results(self) -> Sequence[SweepResult]:
        return self.results

    def rows(self) -> tuple[list[str], list[list[Any]]]:
        """Return the header and the rows of the table; what does not apply is empty."""
        parameters = all_of(result.parameters for result in self.results)
        claims = all_of(result.claims for result in self.results)
        facts = all_of(result.facts for result in self.results)
        # An option may have the name of what is claimed of it, and every column has its own.
        claimed = [f"certified {name}" if name in parameters else name for name in claims]
        header = ["case", *parameters, "status", *facts, *claimed, "condition", "signals", "message", "seconds", "file"]
        rows = [
            [
                result.name,
                *(_cell(result.parameters.get(name, "")) for name in parameters),
                result.status,
                *(result.facts.get(name, "") for name in facts),
                *(result.claims.get(name, float("nan")) for name in claims),
                result.condition,
                ", ".join(result.signals),
                result.message,
                result.seconds,
                "" if result.file is None else result.file.name,
            ]
            for result in self.results
        ]
        return header, rows

    def values(self, name: str) -> FloatArray:
        """Return a claim, or the value of a row of the report, of each case; NaN where there is none.

        Parameters
        ----------
        name : str
            Of the claim or of the row, such as ``"gain"``.
        """
        values = np.full(len(self.results), np.nan)
        for i, result in enumerate(self.results):
            if name in result.claims:
                values[i] = result.claims[name]
            elif result.status == WORK_STATUSES[0]:
                values[i] = next((row.value for row in result.design.report.checks if row.name == name), np.nan)
        return values

    def plot(self, claim: str | None = None, *, parameter: str | None = None) -> Figure:
        """Draw a claim of every case over a parameter; cases without a design are marked by what they came to.

        Parameters
        ----------
        claim : str, optional
            A claim of the certificates; by default the first that most designs have.
        parameter : str, optional
            Along the horizontal axis; by default the varied number with most values, or the cases in their order.

        Raises
        ------
        SpecError
            No design claims that, or no such parameter was varied.
        """
        from obsynth.report.plots.trade_off import plot_sweep

        return plot_sweep(self.results, claim, parameter=parameter)


@arguments_checked
def sweep(
    cases: str | Path | Sequence[str | Path] | Plant | Mapping[str, Plant],
    parameters: Mapping[str, Sequence[Any]] | None = None,
    *,
    method: str | None = None,
    executor: Executor | None = None,
    folder: str | Path | None = None,
    progress: RunsProgress | bool | None = None,
) -> Sweep:
    """Design and verify for every combination of plants and parameters; what fails is a row, not an error.

    Parameters
    ----------
    cases : path, sequence of paths, plant, or mapping of str to plant
        Specs; or plants in memory, with ``method``.
    parameters : mapping of str to sequence, optional
        Values by name; all combinations are taken.  Of a spec, the dotted path of an entry, such as
        ``plant.transform.sample_time``, ``plant.C.outputs`` or ``plant.file`` (a plant in a file of its own is changed
        as well); of a plant in memory ``plant.A`` and the like, or ``plant.outputs`` (names of its outputs).  Any
        other name is an option of the method.
    method : str, optional
        For plants in memory.
    executor : concurrent.futures.Executor, optional
        Where designs are made: processes, threads, or ``dask.distributed.Client(...).get_executor()``; by default here,
        one after the other.  The results do not depend on it.
    folder : str or Path, optional
        Where each gain set and result is written as soon as it is there; what is there already, from the same data and
        options, is not designed again.  It is made if need be.
    progress : callable or bool, optional
        Called with the number of cases done and their total; `True` shows a bar on standard error.

    Returns
    -------
    Sweep
        Results in the order of the cases; equal cases are designed once.

    Raises
    ------
    SpecError
        The cases or parameters are malformed, or the folder cannot be written.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]],
    ...     C=[[1, 0], [0, 1]],
    ...     Bf=[[1], [0]],
    ...     Bd=[[0], [1]],
    ...     dt=1.0,
    ...     sensor_noise={"y1": 0.1, "y2": 0.1},
    ... )
    >>> grid = obsynth.sweep(plant, {"decay": [0.2, 0.5]}, method="ui-pi-observer")
    >>> [result.status for result in grid.results]
    ['designed', 'designed']
    """
    made = _cases(cases, parameters or {}, method)
    place = None if folder is None else ResultFolder(folder, _SWEEP_KIND, SweepResult, ending=".gains.json")
    with progress_of_runs(progress) as report_cases:
        return Sweep(
            carried_out(
                made,
                run_case,
                executor=executor,
                progress=report_cases,
                at_start=True,
                known=lambda case: None if place is None else place.known(case, parameters=case.parameters),
                keep=lambda case, result: (
                    result if place is None else place.keep(case, replace(result, content=None), result.content)
                ),
            )
        )


def _cases(cases: Any, parameters: Mapping[str, Sequence[Any]], method: str | None) -> list[Work]:
    if not isinstance(parameters, Mapping):
        raise SpecError("parameters must be a mapping of names to lists of values.", path="parameters")
    if isinstance(cases, _PLANT_TYPES):
        cases = {"plant": cases}
    if isinstance(cases, Mapping):
        wrong = [name for name, plant in cases.items() if not isinstance(plant, _PLANT_TYPES)]
        if wrong or not cases:
            raise SpecError(f"{wrong or 'nothing'}: give a mapping of names to plants.", path="cases")
        if method is None:
            raise SpecError("Plants in memory need a method: give method='...'.", path="method")
        return plant_cases(dict(cases), method, parameters, __version__)
    if method is not None:
        raise SpecError("The specs name their methods: vary 'method.id' instead of giving one.", path="method")
    paths = [cases] if isinstance(cases, (str, Path)) else list(cases)
    if not paths or not all(isinstance(path, (str, Path)) for path in paths):
        raise SpecError("Give one spec or several, or plants.", path="cases")
    return spec_cases([Path(path) for path in paths], parameters, __version__)


def run_case(case: Work) -> SweepResult:
    """Return what a case comes to; errors of the package are results."""
    started = time.process_time()
    result = partial(SweepResult, case.name, case.parameters)
    try:
        made = case.make()
    except ObsynthError as error:
        details = error.as_dict()
        return result(
            WORK_STATUSES[error.exit_code],
            message=str(error),
            condition=str(details.get("condition") or ""),
            signals=tuple(details.get("signals", ())),
            seconds=time.process_time() - started,
        )
    checks = [check for check in made.report.checks if check.kind != "information"]
    facts = {
        "method": made.method,
        "nx": made.plant.nx,
        "ny": made.plant.ny,
        "checks": f"{sum(check.passed for check in checks)} of {len(checks)}",
    }
    return result(
        WORK_STATUSES[0],
        claims={name: float(value) for name, value in made.certificate.claims.items()},
        facts=facts,
        content=gain_set_bytes(made),
        seconds=time.process_time() - started,
    )


def _cell(value: Any) -> Any:
    if isinstance(value, (bool, str)) or value is None:
        return str(value)
    return value if isinstance(value, (int, float, np.number)) else json.dumps(plain(value))

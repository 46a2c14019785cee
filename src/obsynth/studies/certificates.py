"""Verification of certificate files of any kind, and of all files that they rest on, without a solver."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from obsynth.errors import ObsynthError, SpecError
from obsynth.files.inputs import path_of, read_json
from obsynth.monitoring.alarms.certificates import gain_set_row, verify_alarm
from obsynth.numerics.arguments import arguments_checked
from obsynth.results.calibration_files import CALIBRATION_KIND, verify_calibration
from obsynth.results.certificate_files import (
    ALARM_KIND,
    RESULT_VERSION,
    RESULTS,
    body_of,
    differences,
    kind_of_file,
    opened,
)
from obsynth.results.checks import Check, information, nothing_wrong
from obsynth.results.design import ObserverDesign
from obsynth.results.gain_sets import COMPARISON, ROBUSTNESS, STUDY, loaded
from obsynth.results.verification_report import VerificationReport
from obsynth.simulation.scenario import scenario_from
from obsynth.studies.comparing import compared_again
from obsynth.studies.robustness import robustness
from obsynth.studies.robustness_result import robustness_statement
from obsynth.studies.tolerance_study import study_statement, tolerance_study
from obsynth.verification.assumptions import LogReference, file_digest

#: A file may ask for no more runs than this: whoever wrote it does not wait for them.
MOST_RUNS = 100_000

_SOURCE = "the certificate, computed again from its gain sets"

#: Figures, the sentence made again, and what else differs.
Again = tuple[dict[str, Any], str, list[str]]


@arguments_checked
def verify_certificate(path: str | Path, *, data: str | Path | None = None) -> VerificationReport:
    """Check a certificate of any kind, to the end of what it rests on, without a solver.

    Parameters
    ----------
    path : str or Path
        What ``save`` of `AlarmProof`, `Robustness`, `ToleranceStudy` or `Comparison` wrote, or a calibration file.
    data : str or Path, optional
        The log that an alarm or a comparison names; without it, what was read from the log is assumed.

    Returns
    -------
    VerificationReport
        It fails, by name, where a gain set inside fails, or a figure, the sentence or the log is another one.

    Raises
    ------
    SpecError
        The file is no certificate (gain sets are read by `load`), or ``data`` does not belong to its kind.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> import obsynth
    >>> plant = obsynth.uncertain_system(
    ...     {"A": [["a"]], "C": [[1]], "Bf": [[1]], "dt": 1.0}, {"a": {"nominal": 0.5, "tolerance": "5 %"}}
    ... )
    >>> margins = obsynth.robustness(obsynth.fault_estimation_filter(plant))
    >>> with TemporaryDirectory() as folder:
    ...     _ = margins.save(f"{folder}/robust.json")
    ...     print(obsynth.verify_certificate(f"{folder}/robust.json").passed)
    True
    """
    kind = kind_of_file(path_of(path))
    if data is not None and kind not in (ALARM_KIND, COMPARISON):
        raise SpecError("data is for the certificates of alarms and comparisons.", path="data")
    if kind == ALARM_KIND:
        return verify_alarm(path, data=data)
    return verify_calibration(path) if kind == CALIBRATION_KIND else _verified_result(path, data)


def designs_inside(path: Path) -> list[ObserverDesign]:
    """Return the designs inside a certificate."""
    body = read_json(path)["certificate"]
    inside = body.get("gain_sets") or {"gain set": body["gain_set"]}
    return [loaded(json.dumps(gain_set).encode(), f"the {name}") for name, gain_set in inside.items()]


def _verified_result(path: str | Path, data: str | Path | None) -> VerificationReport:
    kind, body, intact = opened(Path(path), RESULTS, RESULT_VERSION, "certificate of a result", "make it again")
    rows = [nothing_wrong("digest", "the file is as it was written", [] if intact else ["sha256"], source=_SOURCE)]
    try:
        for row in _rows(kind, body, None if data is None else Path(data)):
            rows.append(row)  # those before an error stay
    except (ObsynthError, LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        rows.append(
            nothing_wrong(
                "contents",
                "the certificate can be read and computed again",
                [str(error) or repr(error)],
                source=_SOURCE,
            )
        )
    return VerificationReport.of(rows)


def _rows(kind: str, body: dict[str, Any], log_file: Path | None) -> Iterator[Check]:
    stored = body_of(body)
    if not float(stored["asked"].get("runs", 0)) <= MOST_RUNS:
        raise SpecError(f"it asks for more than {MOST_RUNS} runs", path="runs")
    designs = {
        name: loaded(json.dumps(inside).encode(), f"the gain set {name!r}")
        for name, inside in body["gain_sets"].items()
    }
    for name, design in designs.items():
        label = "gain set" if kind != COMPARISON else f"gain set of {name}"
        yield gain_set_row(design, body["gain_sets"][name]["sha256"], label)
    log = None if stored["log"] is None else LogReference.from_dict(stored["log"])
    if log is not None or log_file is not None:
        yield _log_row(log, log_file)
    result, statement, wrong = _AGAIN[kind]({**stored, "gain_sets": body["gain_sets"]}, designs, log_file)
    if kind == COMPARISON:
        yield nothing_wrong("plant", "every gain set is for the plant of the comparison", wrong, source=_SOURCE)
        yield information(
            "other methods",
            "methods that are not in the table do not exist for this plant: assumed, as nothing is designed again",
            float(len(designs)),
            source=_SOURCE,
            status="assumed",
        )
    yield nothing_wrong("figures", "every figure is found again", differences(stored["result"], result), source=_SOURCE)
    yield nothing_wrong(
        "statement",
        statement,
        [] if statement == stored["statement"] else ["another sentence is stored"],
        source=_SOURCE,
    )


def _log_row(log: LogReference | None, file: Path | None) -> Check:
    if log is not None and file is None:
        return information(
            "log",
            f"errors are those on {log.name}, sha256 {log.sha256}: assumed, as the log was not given (--data)",
            float("nan"),
            source=_SOURCE,
            status="assumed",
        )
    same = log is not None and file is not None and file_digest(file) == log.sha256
    return nothing_wrong(
        "log", "the log that is given is the one that the certificate names", [] if same else ["digest"], source=_SOURCE
    )


def _robustness(body: Mapping[str, Any], designs: Mapping[str, ObserverDesign], _: Path | None) -> Again:
    design = designs["design"]
    digest = body["gain_sets"]["design"]["sha256"]
    return robustness(design).claims(), robustness_statement(body["result"], design, digest), []


def _study(body: Mapping[str, Any], designs: Mapping[str, ObserverDesign], _: Path | None) -> Again:
    options = dict(body["asked"])
    study = tolerance_study(designs["design"], scenario_from(options.pop("scenario")), **options)
    digest = body["gain_sets"]["design"]["sha256"]
    return study.as_dict(), study_statement(body["result"], study.asked, digest), []


_AGAIN: Mapping[str, Callable[[Mapping[str, Any], Mapping[str, ObserverDesign], Path | None], Again]] = {
    ROBUSTNESS: _robustness,
    STUDY: _study,
    COMPARISON: compared_again,
}

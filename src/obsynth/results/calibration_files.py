"""Calibration files: constants with ranges, the log's digest, and a digest of all that the file says."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from obsynth.errors import SpecError
from obsynth.files.inputs import read_json
from obsynth.numerics.arguments import is_finite_number
from obsynth.results.checks import Check, information, nothing_wrong
from obsynth.results.gain_set_writing import digest_of, plain
from obsynth.results.verification_report import VerificationReport

CALIBRATION_KIND = "obsynth calibration"

CALIBRATION_VERSION = 1

_SOURCE = "the calibration file"

#: Ranges found again on another machine may differ by this share of their width.
SAME_WIDTH = 1e-2


def calibration_text(data: Mapping[str, Any]) -> str:
    """Return what a calibration file holds: the data and their digest."""
    body = plain({"kind": CALIBRATION_KIND, "schema_version": CALIBRATION_VERSION, **data})
    return json.dumps({"kind": CALIBRATION_KIND, "sha256": digest_of(body), **body}, indent=1, allow_nan=False) + "\n"


def _calibration_in(path: Path, where: str = "") -> dict[str, Any]:
    """Return the content of a calibration file of this version, whatever its digest; `SpecError` for any other."""
    content, name = read_json(path, where=where or None), path.name
    if not isinstance(content, dict) or content.get("kind") != CALIBRATION_KIND:
        raise SpecError(f"{name} is no calibration: write one by obsynth calibrate --out {name}.", path=where or name)
    version = content.get("schema_version")
    if version != CALIBRATION_VERSION:
        raise SpecError(
            f"{name} has the schema version {version!r}, and this obsynth reads {CALIBRATION_VERSION}: calibrate again "
            f"(obsynth calibrate --out {name}).",
            path=where or name,
        )
    return content


def read_calibration(path: Path, *, where: str = "") -> dict[str, Any]:
    """Return the content of a calibration file whose digest is right; raise `SpecError` for any other."""
    content, name = _calibration_in(path, where), path.name
    if "sha256" not in content:
        raise SpecError(
            f"{name} holds no digest of itself, as files of older versions: calibrate again (obsynth "
            f"calibrate --out {name}).",
            path=where or name,
        )
    if not _intact(content):
        raise SpecError(f"{name} was changed after it was written: its digest does not match.", path=where or name)
    wrong = _misfits(content)
    if wrong:
        raise SpecError(f"{name} is damaged: {', '.join(wrong)}. Calibrate again.", path=where or name)
    return content


def _intact(content: Mapping[str, Any]) -> bool:
    return bool(content.get("sha256") == digest_of({key: value for key, value in content.items() if key != "sha256"}))


def verify_calibration(path: str | Path, again: Mapping[str, Any] | None = None) -> VerificationReport:
    """Check a calibration file, against the same calibration done ``again`` where plant and log are given.

    Parameters
    ----------
    path : str or Path
        What ``obsynth calibrate --out`` wrote.
    again : mapping, optional
        `Calibration.to_dict` of the same plant and log.

    Returns
    -------
    VerificationReport
        Without ``again`` the ranges are assumed to be what the log says.

    Raises
    ------
    SpecError
        The file is no calibration.
    """
    content = _calibration_in(Path(path))
    rows = [
        nothing_wrong("digest", "the file is as it was written", [] if _intact(content) else ["sha256"], source=_SOURCE)
    ]
    rows.append(
        nothing_wrong(
            "box",
            "ranges are finite, hold their nominal values, and the level is a probability, of a log that is named",
            _misfits(content),
            source=_SOURCE,
        )
    )
    log = content.get("log") if isinstance(content.get("log"), dict) else {}
    cited = str(log.get("digest", "")) if isinstance(log, dict) else ""
    if again is None:
        rows.append(
            information(
                "log",
                f"the ranges follow from the log with digest {cited}: assumed, as plant and log were not "
                "given (--system, --data)",
                float("nan"),
                source=_SOURCE,
                status="assumed",
            )
        )
    else:
        rows.append(
            nothing_wrong(
                "log",
                "the log that is given has the digest that the file cites",
                [] if again["log"]["digest"] == cited else ["digest"],
                source=_SOURCE,
            )
        )
        rows.append(
            nothing_wrong(
                "ranges",
                "the same calibration gives the same constants, ranges and level",
                _differences(content, again),
                source=_SOURCE,
            )
        )
    return VerificationReport.of(rows)


def _differences(content: Mapping[str, Any], again: Mapping[str, Any]) -> list[str]:
    """Return what differs from the same calibration done again."""
    stored, expected = content.get("constants"), again["constants"]
    if not isinstance(stored, dict) or stored.keys() != expected.keys():
        return ["names"]
    wrong = [] if content.get("level") == again["level"] else ["level"]
    return wrong + [name for name, item in expected.items() if not _same_range(stored[name], item)]


def _same_range(stored: Any, item: Mapping[str, Any]) -> bool:
    """Whether a constant of a file is that of the calibration done again; what is malformed is not."""
    stated, (low, high) = _stated_range(stored), item["range"]
    if not stated or any(stored.get(key) != item[key] for key in ("open", "unit")):
        return False
    slack = SAME_WIDTH * (high - low)
    return all(abs(a - b) <= slack for a, b in zip(stated, (low, item["nominal"], high), strict=True))


def _stated_range(item: Any) -> list[float]:
    """Return low end, nominal value and high end of a constant of a file; nothing of what is malformed."""
    ends = item.get("range") if isinstance(item, dict) else None
    if not isinstance(ends, list) or len(ends) != 2 or not isinstance(item.get("open"), list):
        return []
    if not all(isinstance(text, str) for text in (item.get("unit"), *item["open"])):
        return []
    stated = [ends[0], item.get("nominal"), ends[1]]
    return stated if all(map(is_finite_number, stated)) else []


def _misfits(content: Mapping[str, Any]) -> list[str]:
    level = content.get("level")
    wrong = [] if is_finite_number(level) and 0.0 < float(level or 0.0) < 1.0 else ["level"]
    log = content.get("log")
    wrong += [] if isinstance(log, dict) and isinstance(log.get("digest"), str) else ["log"]
    wrong += [] if isinstance(content.get("stands"), bool) else ["stands"]
    constants = content.get("constants")
    if not isinstance(constants, dict):
        return [*wrong, "constants"]
    stated = {str(name): _stated_range(item) for name, item in constants.items()}
    return wrong + [name for name, values in stated.items() if not values or sorted(values) != values]


def box_row(box: Any, path: Path) -> Check:
    """Return the row that a calibrated box is that of a calibration file."""
    content = read_calibration(path)
    constants = content["constants"]
    wrong = [] if box.calibration == content["sha256"] else ["digest of the calibration"]
    wrong += [] if box.digest == content["log"]["digest"] and box.level == content["level"] else ["log or level"]
    for name in box.calibrated or box.constants:
        item, stated = box.constants.get(name), constants.get(name)
        if (
            item is None
            or stated is None
            or [item.low, item.high, item.nominal] != [*stated["range"], stated["nominal"]]
        ):
            wrong.append(name)
    return nothing_wrong("calibration", f"the box is that of {path.name}", wrong, source=_SOURCE)

"""An FMU of an observer (FMI 2.0 and 3.0, co-simulation): a zip archive of XML, C, and a binary where a compiler is."""

from __future__ import annotations

import io
import platform
import sys
import uuid
import zipfile
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path

from obsynth.errors import SpecError
from obsynth.exporting.alarms import ExportedMonitor, linear_alarms, scheduled_alarms
from obsynth.exporting.c_precision import in_precision
from obsynth.exporting.c_scheduled import scheduled_c_texts, seconds_between_rows
from obsynth.exporting.c_source import c_identifier, header_text, source_text
from obsynth.exporting.dae_c_source import dae_alarms, dae_c_texts, require_no_sample_time
from obsynth.exporting.fmu.description import build_description, model_description
from obsynth.exporting.fmu.layout import PREFIX, layout_header
from obsynth.exporting.fmu.signals import FmuSignals, signals_of_dae, signals_of_linear, signals_of_scheduled
from obsynth.exporting.realisation import Realisation, verification_words
from obsynth.files.outputs import working_folder, write_atomically
from obsynth.observers.nonlinear.c_code import FLAGS, compiler, shared_library
from obsynth.observers.nonlinear.observer import DAEObserver
from obsynth.observers.scheduled.observer import ScheduledObserver
from obsynth.results.design import ObserverDesign, unverified_mark
from obsynth.results.gain_set_writing import gain_set_digest

#: Date of every entry, so that archives of equal content are equal: the first day that a zip file can hold.
_FIRST_DAY = (1980, 1, 1, 0, 0, 0)


def write_fmu(
    design: ObserverDesign,
    target: Path,
    *,
    version: str,
    sample_time: float | None,
    thresholds: Mapping[str, float] | None,
    warm_up: float | None,
    monitor: ExportedMonitor | None,
    outliers: str | None = None,
) -> Path:
    """Write an FMU for co-simulation; the binary is left out where there is no compiler."""
    signals, texts, digest = _contents(design, sample_time, thresholds, warm_up, monitor, outliers)
    identifier = c_identifier(target.stem)
    token = f"{{{uuid.uuid5(uuid.NAMESPACE_URL, ' '.join((digest, version, repr(signals))))}}}"
    sentence = f"Observer of {design.name} by {design.method}, written by obsynth; sha256 of the gain set {digest}"
    mark = unverified_mark(design.report)
    sentence = f"{mark}. {sentence}" if mark else f"{sentence}. {verification_words(design)}"
    wrapper = f"fmi{version[0]}.c"
    sources = {f"{PREFIX}.c": texts[0], f"{PREFIX}.h": texts[1], "layout.h": layout_header(design, signals, token)}
    folder = files("obsynth.exporting.fmu")
    sources |= {name: folder.joinpath(name).read_text(encoding="utf-8") for name in ("instance.h", "common.h", wrapper)}
    compiled = [f"{PREFIX}.c", wrapper]
    content: dict[str, bytes] = {f"sources/{name}": text.encode() for name, text in sources.items()}
    content["modelDescription.xml"] = model_description(
        signals, version, compiled, identifier=identifier, token=token, name=design.name, sentence=sentence
    )
    if version == "3.0":
        content["sources/buildDescription.xml"] = build_description(identifier, compiled)
    place = _binary_folder(version)
    if place is not None:
        binary = _binary(sources)
        if binary is not None:
            content[f"binaries/{place[0]}/{identifier}{place[1]}"] = binary
    return write_atomically(target, _zipped(content))


def _contents(
    design: ObserverDesign,
    sample_time: float | None,
    thresholds: Mapping[str, float] | None,
    warm_up: float | None,
    monitor: ExportedMonitor | None,
    outliers: str | None,
) -> tuple[FmuSignals, tuple[str, str], str]:
    """Return the signals, source and header, and the digest of the gain set."""
    header = f"{PREFIX}.h"
    if isinstance(design.observer, DAEObserver):
        require_no_sample_time(design, sample_time)
        alarms = dae_alarms(design, thresholds, warm_up, monitor)
        text, declared, digest = dae_c_texts(design, PREFIX, header, alarms, outliers)
        return signals_of_dae(design, alarms), (text, declared), digest
    if isinstance(design.observer, ScheduledObserver):
        plant, observer = design.scheduled
        alarms = scheduled_alarms(observer, thresholds, warm_up, monitor)
        seconds = seconds_between_rows(observer, sample_time)
        texts = scheduled_c_texts(design, PREFIX, header, alarms, seconds)
        source, declared = (in_precision(text, "double") for text in texts)
        return signals_of_scheduled(plant, observer, alarms, seconds), (source, declared), gain_set_digest(design)
    realisation = Realisation.of(design, sample_time)
    if realisation.observer.dt == 0.0:
        raise SpecError(
            "The observer is continuous in time: give the sample time (sample_time, --sample-time), in seconds, for an "
            "FMU.",
            path="sample_time",
        )
    alarms = linear_alarms(realisation, thresholds, warm_up, monitor)
    texts = source_text(realisation, PREFIX, header, alarms), header_text(realisation, PREFIX, alarms)
    source, declared = (in_precision(text, realisation.precision) for text in texts)
    return signals_of_linear(realisation, alarms), (source, declared), realisation.digest


def _binary_folder(version: str) -> tuple[str, str] | None:
    """Return the folder and the suffix of this machine's binaries, `None` where the standard has none."""
    machine = {"amd64": "x86_64", "arm64": "aarch64"}.get(platform.machine().lower(), platform.machine().lower())
    system = {"linux": ("linux", ".so"), "darwin": ("darwin", ".dylib"), "win32": ("windows", ".dll")}.get(sys.platform)
    if system is None:
        return None
    if version == "3.0":
        return f"{machine}-{system[0]}", system[1]
    if machine != "x86_64":
        return None
    return {"linux": "linux64", "darwin": "darwin64", "windows": "win64"}[system[0]], system[1]


def _binary(sources: Mapping[str, str]) -> bytes | None:
    """Return the shared library, or `None` where there is no compiler."""
    command = compiler()
    if command is None:
        return None
    with working_folder() as folder:
        hidden = [*command, *FLAGS, "-fvisibility=hidden"]
        return shared_library(folder, sources, hidden, path="fmu").read_bytes()


def _zipped(content: Mapping[str, bytes]) -> bytes:
    """Return a zip archive in which equal content gives equal bytes."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in sorted(content):
            entry = zipfile.ZipInfo(name, date_time=_FIRST_DAY)
            entry.compress_type, entry.external_attr = zipfile.ZIP_DEFLATED, 0o644 << 16
            archive.writestr(entry, content[name])
    return buffer.getvalue()

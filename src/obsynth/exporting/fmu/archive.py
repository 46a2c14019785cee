"""Writing an FMU: the C of the observer, its description, and a binary where a compiler is."""

from __future__ import annotations

import io
import platform
import subprocess
import sys
import tempfile
import uuid
import zipfile
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path

from obsynth.errors import SpecError
from obsynth.exporting.c_source import c_identifier, comment, header_text, source_text
from obsynth.exporting.c_templates import dae_c_texts, require_no_sample_time
from obsynth.exporting.fmu.description import (
    Model,
    Signals,
    build_description,
    finite_warm_up,
    model_description,
    signals_of_dae,
    signals_of_linear,
    start_values,
)
from obsynth.exporting.realisation import Realisation
from obsynth.files.outputs import write_atomically
from obsynth.numerics.arguments import chosen
from obsynth.observers.dae.c_code import FLAGS, compiler
from obsynth.observers.dae.observer import DAEObserver
from obsynth.observers.linear.derived import checked_warm_up, transient
from obsynth.results.design import ObserverDesign

VERSIONS = ("2.0", "3.0")
#: Of every name in the C of the observer inside an FMU.
_PREFIX = "observer"
#: Archives of equal content are equal: the first day that a zip file can hold.
_DAY = (1980, 1, 1, 0, 0, 0)


def write_fmu(
    design: ObserverDesign,
    target: Path,
    *,
    version: str,
    sample_time: float | None,
    thresholds: Mapping[str, float] | None,
    warm_up: float | None,
) -> Path:
    """Write an FMU for co-simulation; the binary is left out where there is no compiler."""
    chosen(version, "fmi", VERSIONS)
    signals, texts, digest = _contents(design, sample_time, thresholds, warm_up)
    identifier = c_identifier(target.stem)
    token = f"{{{uuid.uuid5(uuid.NAMESPACE_URL, ' '.join((digest, version, repr(signals))))}}}"
    sentence = f"Observer of {design.name} by {design.method}, written by obsynth; sha256 of the gain set {digest}"
    model = Model(identifier, token, design.name, sentence, signals)
    wrapper = f"fmi{version[0]}.c"
    sources = {f"{_PREFIX}.c": texts[0], f"{_PREFIX}.h": texts[1], "layout.h": _layout(design, model)}
    folder = files("obsynth.exporting.fmu")
    sources |= {name: folder.joinpath(name).read_text(encoding="utf-8") for name in ("instance.h", "common.h", wrapper)}
    compiled = [f"{_PREFIX}.c", wrapper]
    content: dict[str, bytes] = {f"sources/{name}": text.encode() for name, text in sources.items()}
    content["modelDescription.xml"] = model_description(model, version, compiled)
    if version == "3.0":
        content["sources/buildDescription.xml"] = build_description(model, compiled)
    place = _binary_folder(version)
    if place is not None:
        binary = _binary(sources, compiled)
        if binary is not None:
            content[f"binaries/{place[0]}/{identifier}{place[1]}"] = binary
    return write_atomically(target, _zipped(content))


def _contents(
    design: ObserverDesign, sample_time: float | None, thresholds: Mapping[str, float] | None, warm_up: float | None
) -> tuple[Signals, tuple[str, str], str]:
    """Return the signals, source and header, and the digest of the gain set."""
    if isinstance(design.observer, DAEObserver):
        require_no_sample_time(design, sample_time)
        text, header, digest = dae_c_texts(design, _PREFIX, f"{_PREFIX}.h")
        return signals_of_dae(design, thresholds, finite_warm_up(checked_warm_up(warm_up, 0.0))), (text, header), digest
    found = Realisation.of(design, sample_time)
    if found.observer.dt == 0.0:
        raise SpecError("The observer is continuous in time: give the sample time, in seconds, for an FMU.",
                        path="sample_time")  # fmt: skip
    signals = signals_of_linear(found, thresholds, finite_warm_up(checked_warm_up(warm_up, transient(found.observer))))
    return signals, (source_text(found, _PREFIX, f"{_PREFIX}.h"), header_text(found, _PREFIX)), found.digest


def _layout(design: ObserverDesign, model: Model) -> str:
    """Return ``layout.h``: sizes, start values, and how one sample is taken."""
    signals = model.signals
    names = [output.name for output in signals.outputs]
    points = [signals.point_index(signal if signals.points else None) for signal in signals.input_signals]
    shown = [signals.point_index(output.signal) for output in signals.outputs]
    sizes = {"N_IN": len(signals.inputs), "N_OUT": len(names), "N_POINT": len(signals.points),
             "N_WATCHED": len(signals.watched)}  # fmt: skip
    body = _taking_dae(design) if isinstance(design.observer, DAEObserver) else _taking_linear(design, signals)
    return "\n".join([
        comment("Sizes and start values of this observer, written by obsynth."), "#ifndef OBSYNTH_FMU_LAYOUT_H",
        "#define OBSYNTH_FMU_LAYOUT_H", "", f'#include "{_PREFIX}.h"', "", f'#define TOKEN "{model.token}"',
        f"#define DT {signals.dt!r}", *(f"#define {name} {size}" for name, size in sizes.items()), "",
        f"typedef {_PREFIX}_state observer_memory;", "",
        _table("double", "start_values", [repr(value) for value in start_values(signals)]),
        _table("int", "point_of_in", points), _table("int", "point_of_out", shown),
        _table("int", "watched", [names.index(name) for name in signals.watched]), "",
        "static void observer_begin(observer_memory *memory)", "{", f"    {_PREFIX}_reset(memory);", "}", "",
        "static int observer_take(observer_memory *memory, const double *in, double *out)", "{", *body, "}", "",
        "#endif", "",
    ])  # fmt: skip


def _table(kind: str, name: str, values: list[object] | list[int] | list[str]) -> str:
    return f"static const {kind} {name}[{max(len(values), 1)}] = {{{', '.join(map(str, values)) or '0'}}};"


def _taking_linear(design: ObserverDesign, signals: Signals) -> list[str]:
    """Return the body that hands one sample to the linear observer; empty groups are no arguments there."""
    kinds = [output.name.partition("[")[0] for output in signals.outputs]
    known = len(signals.inputs) - len(design.plant.output_names)
    counts = (("in", known), (f"in + {known}", len(signals.inputs) - known))
    groups, place = [], 0
    for kind in ("xhat", "fhat", "r"):
        groups.append((f"out + {place}", kinds.count(kind)))
        place += kinds.count(kind)
    arguments = ", ".join(text for text, count in (*counts, *groups) if count)
    return [f"    return {_PREFIX}_step(memory, {arguments});"]


def _taking_dae(design: ObserverDesign) -> list[str]:
    model, _ = design.nonlinear
    parts = (("states", model.nx), ("state_deviations", model.nx), ("parameters", model.nq),
             ("parameter_deviations", model.nq), ("innovations", model.ny))  # fmt: skip
    lines = [f"    {_PREFIX}_estimates said;", "    int i;"]
    inputs = "in, " if model.nu else ""
    lines += [f"    int failed = {_PREFIX}_step(memory, {inputs}in + {model.nu}, &said);",
              "    if (failed) {", "        return failed;", "    }"]  # fmt: skip
    place = 0
    for name, size in parts:
        if size:
            lines += [f"    for (i = 0; i < {size}; i++) {{", f"        out[{place} + i] = said.{name}[i];", "    }"]
        place += size
    return [*lines, f"    out[{place}] = said.nis;", "    return 0;"]


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


def _binary(sources: Mapping[str, str], compiled: list[str]) -> bytes | None:
    """Return the shared library, or `None` where there is no compiler."""
    command = compiler()
    if command is None:
        return None
    with tempfile.TemporaryDirectory(prefix="obsynth-") as name:
        folder = Path(name)
        for file, text in sources.items():
            (folder / file).write_text(text, encoding="utf-8", newline="\n")
        library = folder / "library"
        done = subprocess.run(
            [*command, *FLAGS, "-fvisibility=hidden", *(str(folder / file) for file in compiled), "-o", str(library),
             "-lm"], capture_output=True, encoding="utf-8", errors="replace", check=False,
        )  # fmt: skip
        if done.returncode != 0:
            raise SpecError(f"The C compiler {command[0]!r} fails: {done.stderr.strip()[:500]}", path="fmu")
        return library.read_bytes()


def _zipped(content: Mapping[str, bytes]) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in sorted(content):
            entry = zipfile.ZipInfo(name, date_time=_DAY)
            entry.compress_type, entry.external_attr = zipfile.ZIP_DEFLATED, 0o644 << 16
            archive.writestr(entry, content[name])
    return buffer.getvalue()

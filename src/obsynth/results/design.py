"""The result of every method: what was asked, what is shipped, and the proof; the plant as written behind it; its file.

A gain set is one JSON document with a schema version and a digest, floats bit for bit.  Large ones are a zip of the
document and its arrays as ``.npz``, uncompressed and with a fixed date: the same design gives the same bytes.

Certificates and calibrations on disk: one JSON document, its kind, version and digest, and what it says.
"""

from __future__ import annotations

import errno
import hashlib
import io
import json
import math
import os
import re
import warnings
import zipfile
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from obsynth.analysis.transformations.linear_plants import (
    RecoveryOperator,
    StateRecovery,
    Transformation,
    discretise,
    eliminate_algebraic_states,
)
from obsynth.errors import SpecError, VerificationError
from obsynth.extensions import extension
from obsynth.files.outputs import FileKind, input_file, json_data, path_of, read_json, write_atomically
from obsynth.numerics.arguments import (
    FloatArray,
    arguments_checked,
    freeze,
    is_finite_number,
    is_number,
    read_only,
    require_kind,
)
from obsynth.observers.dae.observer import DAEObserver
from obsynth.observers.linear.observer import LinearObserver, WindowObserver
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.observers.running import LONGEST_DELAY
from obsynth.plants.dae import DAEModel
from obsynth.plants.descriptor import DescriptorSystem, TimeVaryingDescriptorSystem, listed
from obsynth.results.checks import Check, all_hold, information, nothing_wrong

if TYPE_CHECKING:
    import control


GAIN_SET_VERSION = 2
GAIN_SET_KIND = "obsynth gain set"
_PLACE_DIGITS = 16
GAIN_SET = FileKind(
    "a gain set",
    rb'\A(PK\x03\x04[\s\S]{26}gain_set\.json)?\s*\{\s*"kind":\s*"obsynth gain set"',
    ending=".gains.json",
    suffix=".json",
)
#: Tags of kinds of designs; linear time-invariant ones have none.
DESIGN_KINDS = (None, "recursive", "dae", "window")
#: From so many numbers on, which are more than a megabyte as text, the arrays of a gain set are a binary member.
MANY_NUMBERS = 50_000
DOCUMENT, ARRAYS = "gain_set.json", "arrays.npz"
#: Arrays with fewer numbers stay in the document of a packed gain set, where they can be read.
SMALL_ARRAY = 64
#: Larger files are refused before they fill the memory.
MAXIMUM_BYTES = 4_000_000_000
_DATE = (1980, 1, 1, 0, 0, 0)
# What JSON does not have is marked by these sets of keys; a mapping that happens to have one of them is wrapped.
_ARRAY, _FLOAT, _MAPPING, _MEMBER = {"shape", "data"}, {"float"}, {"mapping"}, {"member"}
_MARKS = (_ARRAY, _FLOAT, _MAPPING, _MEMBER)


def design_as_dict(design: Any) -> dict[str, Any]:
    """Return the whole gain set as JSON data, digest included."""
    body = plain(_body_of(design))
    return {"kind": GAIN_SET_KIND, "schema_version": GAIN_SET_VERSION, "sha256": digest_of(body), "design": body}


def gain_set_bytes(design: Any, *, spec: Path | None = None) -> bytes:
    """Return what a file with a gain set holds; with ``spec`` it remembers the place of that spec."""
    body, arrays, digest = _written(design)
    place = {} if spec is None else {"written_for": place_of(spec)}
    document = {"kind": GAIN_SET_KIND, **place, "schema_version": GAIN_SET_VERSION, "sha256": digest, "design": body}
    text = json.dumps(document, indent=1, allow_nan=False) + "\n"
    return text.encode() if arrays is None else _zipped({DOCUMENT: text, ARRAYS: arrays})


def gain_set_digest(design: Any) -> str:
    """Return the digest that the file of a design holds."""
    return _written(design)[2]


def _written(design: Any) -> tuple[Any, bytes | None, str]:
    """Return what a gain set says, its arrays where they are apart, and the digest of both."""
    body = _body_of(design)
    apart: dict[str, FloatArray] | None = {} if count_of_numbers(body) >= MANY_NUMBERS else None
    document, arrays = plain(body, apart), None
    if apart is not None:
        members: dict[str, bytes] = {}
        for name, array in apart.items():
            part = io.BytesIO()
            np.lib.format.write_array(part, np.ascontiguousarray(array), allow_pickle=False)
            members[f"{name}.npy"] = part.getvalue()
        arrays = _zipped(members)
    return document, arrays, digest_of(document, arrays)


def _zipped(members: Mapping[str, str | bytes]) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name, content in members.items():
            archive.writestr(zipfile.ZipInfo(name, _DATE), content)
    return stream.getvalue()


def _body_of(design: Any) -> dict[str, Any]:
    """Return everything that a gain set holds, with arrays."""
    kind = next((kind for kind in DESIGN_KINDS if isinstance(design.observer, types_of(kind)[1])), None)
    return {
        "name": design.name,
        "method": design.method,
        "plant": design.plant.as_dict(),
        "options": design.options,
        "gains": design.gains,
        "observer": design.observer.as_dict(),
        "certificate": {"matrices": design.certificate.matrices, "claims": design.certificate.claims},
        "solver": design.solver,
        "notes": design.notes,
        "recovery": None if design.recovery is None else _fields_of(design.recovery),
        "report": design.report.as_dict(),
        "source": None if design.source is None else design.source.as_dict(),
        **({"input_delay": design.input_delay} if design.input_delay else {}),
        **({} if kind is None else {"kind": kind}),
    }


def types_of(kind: str | None) -> tuple[Any, Any]:
    """Return the types of plant and observer of a kind."""
    others: dict[str | None, tuple[Any, Any]] = {
        "recursive": (TimeVaryingDescriptorSystem, RecursiveObserver),
        "window": (TimeVaryingDescriptorSystem, WindowObserver),
        "dae": (DAEModel, DAEObserver),
    }
    return others.get(kind, (DescriptorSystem, LinearObserver))


def _fields_of(record: StateRecovery) -> dict[str, Any]:
    if (operator := record.by_operator) is not None:
        # Sparse equations take less room than the map that they stand for.
        return {
            "names": record.names,
            "noise_kept": record.noise_kept,
            "operating_point": record.operating_point,
            "operator": operator.as_dict(),
        }
    return {field.name: getattr(record, field.name) for field in fields(record)}


def save(design: Any, path: str | Path) -> Path:
    """Write ``design`` to ``path`` atomically and return the path."""
    return write_atomically(path, gain_set_bytes(design))


def place_of(spec: Path) -> str:
    """Return a short digest of where a spec is, which tells two specs of one name apart."""
    return hashlib.sha256(os.fsencode(spec.resolve())).hexdigest()[:_PLACE_DIGITS]


def count_of_numbers(value: Any) -> int:
    """Return how many numbers the arrays in nested data hold."""
    if isinstance(value, np.ndarray):
        return int(value.size)
    if isinstance(value, Mapping):
        return sum(map(count_of_numbers, value.values()))
    return sum(map(count_of_numbers, value)) if isinstance(value, (list, tuple)) else 0


def plain(value: Any, arrays: dict[str, FloatArray] | None = None) -> Any:
    """Return ``value`` as JSON data, arrays (large ones in ``arrays``), NaN, infinities marked for `restored`."""
    kind = type(value)
    if kind is str or (kind is float and math.isfinite(value)):
        # Most values by far, and asking whether one is a mapping takes longest.
        return value
    if isinstance(value, np.ndarray):
        if arrays is not None and value.size >= SMALL_ARRAY and value.dtype == np.float64:
            name = f"array{len(arrays):05d}"
            arrays[name] = value
            return {"member": name}
        data = value.ravel().tolist()
        finite = value.dtype == np.float64 and bool(np.isfinite(value).all())
        return {"shape": list(value.shape), "data": data if finite else [plain(x) for x in data]}
    if isinstance(value, (np.floating, np.integer, np.bool_)):
        return plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return {"float": str(value)}
    if isinstance(value, Mapping):
        entries = {str(key): plain(item, arrays) for key, item in value.items()}
        return {"mapping": entries} if entries.keys() in _MARKS else entries
    if isinstance(value, (list, tuple)):
        return [plain(item, arrays) for item in value]
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    raise SpecError(f"A value of type {type(value).__name__} cannot be saved: only data can.")


def restored(value: Any, arrays: Mapping[str, FloatArray] | None = None) -> Any:
    """Return what `plain` wrote, with arrays and special floats restored."""
    if isinstance(value, dict):
        if value.keys() == _ARRAY:
            data = [restored(item) for item in value["data"]]
            if not {type(item) for item in data} <= {float, int}:
                raise TypeError("an array holds something that is no number")
            return np.array(data, dtype=np.float64).reshape(value["shape"])
        if value.keys() == _MEMBER and arrays is not None:
            return arrays[value["member"]]
        if value.keys() == _FLOAT:
            return float(value["float"])
        if value.keys() == _MAPPING:
            value = value["mapping"]
        return {key: restored(item, arrays) for key, item in value.items()}
    return [restored(item, arrays) for item in value] if isinstance(value, list) else value


def digest_of(body: Any, arrays: bytes | None = None) -> str:
    """Return the sha256 digest of the canonical JSON of ``body``, and of its arrays where they are apart."""
    text = json.dumps(body, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()
    return hashlib.sha256(text if arrays is None else hashlib.sha256(arrays).digest() + text).hexdigest()


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

    def __repr__(self) -> str:
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
        if self.sample_time is None:
            return eliminate_algebraic_states(self.plant)
        return discretise(self.plant, self.sample_time)

    @cached_property
    def smooth(self) -> DescriptorSystem:
        """The plant without its algebraic states, before it is sampled; made once for all checks."""
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
        return self._parts(TimeVaryingDescriptorSystem, RecursiveObserver, "recursive observer")

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


__all__ = [
    "GAIN_SET",
    "GAIN_SET_VERSION",
    "design_as_dict",
    "digest_of",
    "gain_set_bytes",
    "gain_set_digest",
    "load",
    "loaded",
    "place_of",
    "plain",
    "restored",
    "save",
    "written_for",
]

#: Larger gain sets are refused before they fill the memory.
MOST_GAIN_SET_CHARACTERS = 2_000_000_000
_HEAD_BYTES = 256


def written_for(gains: Path) -> str | None:
    """Return the digest of the place of the spec for which a gain set was written, `None` where it is not known."""
    if not gains.is_file():  # a pipe would keep us waiting
        return None
    with gains.open("rb") as stream:
        found = re.search(rb'"written_for":\s*"([0-9a-f]+)"', stream.read(_HEAD_BYTES))
    return None if found is None else found.group(1).decode()


@arguments_checked
def load(path: str | Path) -> ObserverDesign:
    """Read a gain set and check its digest.

    Parameters
    ----------
    path : str or Path
        A file written by `ObserverDesign.save`.

    Returns
    -------
    ObserverDesign
        Equal to the saved one, bit for bit; its report is the saved one, run `verify` for a new one.

    Raises
    ------
    SpecError
        The file is missing, is no gain set, has an unknown schema version, or was changed.
    """
    source = path_of(path)
    if source.is_dir() or not source.exists():
        why = os.strerror(errno.EISDIR if source.is_dir() else errno.ENOENT)
        raise SpecError(f"{source} cannot be read: {why}.", path=str(source))
    document, arrays = _read_members(source)
    return _design_of(document, arrays, str(source))


def is_packed(start: bytes) -> bool:
    """Whether a file that begins so is a zip."""
    return start.startswith(b"PK\x03\x04")


def _require_stored(archive: zipfile.ZipFile) -> None:
    """Raise `ValueError` for a zip that unpacks to more than it has, as no gain set does."""
    if any(item.compress_type != zipfile.ZIP_STORED for item in archive.infolist()):
        raise ValueError("it is compressed, as no gain set is")


def unpacked(content: bytes) -> tuple[str, bytes]:
    """Return the text of the document and the arrays; raise `ValueError` for any other zip."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            if sorted(archive.namelist()) != sorted([DOCUMENT, ARRAYS]):
                raise ValueError("it does not hold the two members of a gain set")
            _require_stored(archive)
            return archive.read(DOCUMENT).decode("utf-8"), archive.read(ARRAYS)
    except (zipfile.BadZipFile, NotImplementedError, RuntimeError, EOFError, OSError) as error:
        raise ValueError(f"it is damaged ({error})") from error


def loaded(content: bytes, name: str = "the gain set") -> ObserverDesign:
    """Return the design in what `gain_set_bytes` returned."""
    try:
        text, arrays = unpacked(content) if is_packed(content) else (content.decode("utf-8"), None)
        document = json_data(text)
    except ValueError as error:
        raise SpecError(f"{name} is no gain set of obsynth ({error}).", path=name) from error
    return _design_of(document, arrays, name)


def _read_members(source: Path) -> tuple[Any, bytes | None]:
    """Return the document of a gain set and, where they are apart, its arrays."""
    file = input_file(source)
    with file.open("rb") as stream:
        start = stream.read(_HEAD_BYTES)
    if not is_packed(start):
        return read_json(source, most=MOST_GAIN_SET_CHARACTERS), None
    try:
        if file.stat().st_size > MAXIMUM_BYTES:
            raise ValueError("it is too large")
        text, arrays = unpacked(file.read_bytes())
        return json_data(text), arrays
    except (ValueError, RecursionError) as error:
        raise SpecError(f"{source} is no gain set of obsynth: {error}.", path=str(source)) from error


def _design_of(document: Any, arrays: bytes | None, source: str) -> ObserverDesign:
    """Return the design in a document whose digest is right."""
    if not isinstance(document, dict) or document.get("kind") != GAIN_SET_KIND:
        raise SpecError(f"{source} is no gain set of obsynth.", path=source)
    if document.get("schema_version") != GAIN_SET_VERSION:
        version = document.get("schema_version")
        raise SpecError(
            f"{source} has schema version {version!r}; this obsynth reads {GAIN_SET_VERSION}.",
            path=source,
        )
    body = document.get("design")
    try:
        intact = isinstance(body, dict) and document.get("sha256") == digest_of(body, arrays)
    except (ValueError, RecursionError):  # a number too large for a float
        intact = False
    if not intact:
        raise SpecError(f"{source} was changed after it was written: its digest does not match.", path=source)
    try:
        parts = _checked_parts(restored(body, None if arrays is None else _arrays_in(arrays)))
        return _design_from(parts)
    except (SpecError, AttributeError, LookupError, TypeError, ValueError, ArithmeticError, RecursionError) as error:
        raise SpecError(f"{source} is incomplete: {str(error).rstrip('.')}.", path=source) from error


def _arrays_in(content: bytes) -> dict[str, FloatArray]:
    """Return arrays by name; raise `ValueError` where they are damaged."""
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as archive:
            _require_stored(archive.zip)
            return {name: np.asarray(archive[name], dtype=np.float64) for name in archive.files}
    except (zipfile.BadZipFile, EOFError, OSError) as error:
        raise ValueError(f"its arrays are damaged ({error})") from error


def _recovery_from(plant: Any, data: dict[str, Any]) -> StateRecovery:
    """Return the recovery of the states that ``plant`` was made from; its maps fit the signals of that plant."""
    names = tuple(data["names"])
    if "operator" in data:
        operator = RecoveryOperator.from_dict(data["operator"])
        if operator.dynamic.shape[0] != len(names):
            raise SpecError(f"it has {len(names)} names for {operator.dynamic.shape[0]} states")
        return StateRecovery.from_operator(names, operator, data["noise_kept"], data["operating_point"])
    found = StateRecovery(**{**data, "names": names})
    columns = {"state": plant.nx, "input": plant.nu}
    # A plant that changes with k has parameters and Q instead.
    if isinstance(plant, DescriptorSystem):
        columns |= {"fault": plant.nf, "disturbance": plant.nd, "noise": plant.nw}
    for signal, count in columns.items():
        rows, own = getattr(found, f"from_{signal}").shape
        if (rows, own) != (len(names), count):
            raise SpecError(f"from_{signal} is {rows} by {own}, but {len(names)} by {count} is needed")
    if "noise" in columns and found.noise_kept.shape[1] != plant.nw:
        raise SpecError(f"noise_kept has {found.noise_kept.shape[1]} columns, but {plant.nw} are needed")
    return found


def _design_from(data: dict[str, Any]) -> ObserverDesign:
    if not isinstance(data.get("kind"), (str, type(None))) or data.get("kind") not in DESIGN_KINDS:
        raise SpecError(f"A design of the kind {data['kind']!r} is unknown to this obsynth.", path="kind")
    kind, observer = types_of(data.get("kind"))
    plant, recovery = _made("plant", kind, **data["plant"]), data["recovery"]
    return ObserverDesign(
        name=data["name"],
        method=data["method"],
        plant=plant,
        options=data["options"],
        gains=data["gains"],
        observer=_made("observer", observer.from_dict, data["observer"]),
        certificate=_made("certificate", Certificate, **data["certificate"]),
        solver=data["solver"],
        notes=tuple(data["notes"]),
        recovery=None if recovery is None else _made("recovery", _recovery_from, plant, recovery),
        report=_made("report", VerificationReport.from_dict, data["report"]),
        source=None if data.get("source") is None else _made("source", PlantSource.from_dict, data["source"]),
        input_delay=data.get("input_delay", 0),
    )


_Made = TypeVar("_Made")

#: The type of every part that a gain set has, in words and as a test.
_TYPES: Mapping[str, tuple[str, Callable[[Any], bool]]] = {
    **dict.fromkeys(("name", "method"), ("a text", lambda value: isinstance(value, str))),
    **dict.fromkeys(
        ("plant", "options", "observer", "solver", "report"), ("a mapping", lambda value: isinstance(value, dict))
    ),
    "gains": ("a mapping to arrays of numbers", lambda value: _is_mapping_to(value, _is_array)),
    "certificate": ("matrices and claims that are numbers", lambda value: _is_certificate(value)),
    "notes": ("a list of texts", lambda value: _is_texts(value)),
    "recovery": ("maps with the names of states, or nothing", lambda value: value is None or _is_recovery(value)),
}


def _checked_parts(body: Any) -> dict[str, Any]:
    """Return the content of a gain set if it has every part, each of its type; raise `SpecError` for the first."""
    if not isinstance(body, dict):
        raise SpecError("it holds no design")
    for name, (wanted, fits) in _TYPES.items():
        if name not in body:
            raise SpecError(f"{name!r} is missing")
        if not fits(body[name]):
            shown = f"{name} is {body[name]!r}, not" if name in ("name", "method") else f"its {name} must be"
            raise SpecError(f"{shown} {wanted}")
    return body


def _made(part: str, make: Callable[..., _Made], *values: Any, **named: Any) -> _Made:
    """Return what a part describes; what cannot be made of it is a `SpecError`."""
    try:
        return make(*values, **named)
    except SpecError as error:
        raise SpecError(f"its {part} is refused: {str(error).rstrip('.')}") from error
    except KeyError as error:
        raise SpecError(f"its {part} has no {error}") from error
    except (AttributeError, IndexError, TypeError, ValueError, ArithmeticError) as error:
        raise SpecError(f"its {part} is damaged") from error


def _is_array(value: Any) -> bool:
    return isinstance(value, np.ndarray)


def _is_texts(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(item, str) for item in value)


def _is_mapping_to(value: Any, fits: Callable[[Any], bool]) -> bool:
    return isinstance(value, dict) and all(fits(item) for item in value.values())


def _is_certificate(value: Any) -> bool:
    return (
        isinstance(value, dict)
        and _is_mapping_to(value.get("matrices"), _is_array)
        and _is_mapping_to(value.get("claims"), is_number)
    )


def _is_recovery(value: Any) -> bool:
    if not isinstance(value, dict) or not _is_texts(value.get("names")):
        return False
    return all(_is_array(item) and item.ndim == 2 for key, item in value.items() if key.startswith(("from_", "noise_")))


#: Kinds of results that are certified with the gain sets that they rest on.
ROBUSTNESS, STUDY, COMPARISON = "obsynth robustness", "obsynth tolerance study", "obsynth comparison"
RESULTS = (ROBUSTNESS, STUDY, COMPARISON)
RESULT_FILE = FileKind(
    "a certificate of a result",
    rb'\A\s*\{\s*"kind":\s*"obsynth (robustness|tolerance study|comparison)"',
    suffix=".json",
)
RESULT_VERSION = 1
#: Digits of a digest that a sentence shows.
SHOWN_DIGITS = 12


def sealed(kind: str, version: int, body: Any, *, under: str = "certificate") -> str:
    """Return the text of a file that holds a body, plain data, with its digest."""
    document = {"kind": kind, "schema_version": version, "sha256": digest_of(body), under: body}
    return json.dumps(document, indent=1, allow_nan=False) + "\n"


def opened(
    path: Path,
    kinds: tuple[str, ...],
    version: int,
    what: str,
    again: str,
    *,
    under: str = "certificate",
    is_protected: bool = True,
) -> tuple[str, dict[str, Any], bool]:
    """Return kind and body of what `sealed` wrote, and whether its digest is right; ``again`` says how to make one."""
    document = read_json(path, is_protected=is_protected)
    if not isinstance(document, dict) or document.get("kind") not in kinds:
        raise SpecError(f"{path} is no {what}.", path=str(path))
    body = document.get(under)
    if document.get("schema_version") != version or not isinstance(body, dict):
        raise SpecError(
            f"{path} has the schema version {document.get('schema_version')!r}, and this obsynth reads {version}: "
            f"{again}.",
            path=str(path),
        )
    try:
        return document["kind"], body, document.get("sha256") == digest_of(body)
    except RecursionError as error:
        raise SpecError(f"{path} is nested too deeply to be a {what}: {again}.", path=str(path)) from error


def result_text(
    kind: str,
    designs: Mapping[str, ObserverDesign],
    asked: Mapping[str, Any],
    result: Mapping[str, Any],
    statement: str,
    log: Mapping[str, Any] | None = None,
) -> str:
    """Return the certificate of a result: what was asked, the figures, the sentence, and every gain set inside."""
    told = plain({"statement": statement, "asked": asked, "result": result, "log": log})
    inside = {name: design_as_dict(design) for name, design in designs.items()}
    return sealed(kind, RESULT_VERSION, {**told, "gain_sets": inside})


#: Figures that are found again agree to this share of themselves, or of the largest beside them for rounding.
SAME_FIGURE, FIGURE_ROUNDING_SHARE = 1e-6, 1e-9


def differences(stored: Any, found: Any, where: str = "") -> list[str]:
    """Return the places at which two results differ, numbers by more than rounding."""
    if isinstance(found, Mapping):
        if not isinstance(stored, Mapping) or stored.keys() != found.keys():
            return [where or "names"]
        items = [(str(name), stored[name], found[name]) for name in found]
    elif isinstance(found, (list, tuple)):
        if not isinstance(stored, (list, tuple)) or len(stored) != len(found):
            return [where]
        items = [(str(i + 1), one, other) for i, (one, other) in enumerate(zip(stored, found, strict=True))]
    else:
        return [] if _same_figure(stored, found, 0.0) else [where]
    numbers = [abs(float(other)) for _, _, other in items if _is_figure(other)]
    rounding = FIGURE_ROUNDING_SHARE * max((size for size in numbers if size < float("inf")), default=0.0)
    wrong = []
    for name, one, other in items:
        place = f"{where}, {name}" if where else name
        if not _is_figure(other):
            wrong += differences(one, other, place)
        elif not _same_figure(one, other, rounding):
            wrong.append(place)
    return wrong


def _is_figure(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _same_figure(one: Any, other: Any, rounding: float) -> bool:
    if not (_is_figure(one) and _is_figure(other)):
        return bool(type(one) is type(other) and one == other)
    if one == other or (one != one and other != other):
        return True
    if not (np.isfinite(one) and np.isfinite(other)):
        return False
    return bool(abs(one - other) <= max(SAME_FIGURE * abs(other), rounding))


def body_of(body: Mapping[str, Any]) -> dict[str, Any]:
    """Return what a certificate of a result holds beside its gain sets, as it was before it was written."""
    found: dict[str, Any] = restored({name: value for name, value in body.items() if name != "gain_sets"})
    return found


CALIBRATION_KIND = "obsynth calibration"
CALIBRATION_VERSION = 1
_SOURCE = "the calibration file"


def calibration_text(data: Mapping[str, Any]) -> str:
    """Return what a calibration file holds: the data and their digest."""
    body = plain({"kind": CALIBRATION_KIND, "schema_version": CALIBRATION_VERSION, **data})
    return json.dumps({"kind": CALIBRATION_KIND, "sha256": digest_of(body), **body}, indent=1, allow_nan=False) + "\n"


def _calibration_in(path: Path, where: str = "") -> dict[str, Any]:
    """Return the content of a calibration file of this version, whatever its digest; `SpecError` for any other."""
    found, name = read_json(path, where=where or None), path.name
    if not isinstance(found, dict) or found.get("kind") != CALIBRATION_KIND:
        raise SpecError(f"{name} is no calibration: write one by obsynth calibrate --out {name}.", path=where or name)
    version = found.get("schema_version")
    if version != CALIBRATION_VERSION:
        raise SpecError(
            f"{name} has the schema version {version!r}, and this obsynth reads {CALIBRATION_VERSION}: calibrate again "
            f"(obsynth calibrate --out {name}).",
            path=where or name,
        )
    return found


def read_calibration(path: Path, *, where: str = "") -> dict[str, Any]:
    """Return the content of a calibration file whose digest is right; raise `SpecError` for any other."""
    found, name = _calibration_in(path, where), path.name
    if "sha256" not in found:
        raise SpecError(f"{name} holds no digest of itself, as files of older versions: calibrate again (obsynth "
                        f"calibrate --out {name}).", path=where or name)  # fmt: skip
    if not _intact(found):
        raise SpecError(f"{name} was changed after it was written: its digest does not match.", path=where or name)
    wrong = _misfits(found)
    if wrong:
        raise SpecError(f"{name} is damaged: {', '.join(wrong)}. Calibrate again.", path=where or name)
    return found


def _intact(found: Mapping[str, Any]) -> bool:
    return bool(found.get("sha256") == digest_of({key: value for key, value in found.items() if key != "sha256"}))


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
    found = _calibration_in(Path(path))
    rows = [
        nothing_wrong("digest", "the file is as it was written", [] if _intact(found) else ["sha256"], source=_SOURCE)
    ]
    rows.append(
        nothing_wrong(
            "box",
            "ranges are finite, hold their nominal values, and the level is a probability, of a log that is named",
            _misfits(found),
            source=_SOURCE,
        )
    )
    log = found.get("log") if isinstance(found.get("log"), dict) else {}
    cited = str(log.get("digest", "")) if isinstance(log, dict) else ""
    if again is None:
        rows.append(information(
            "log", f"the ranges follow from the log with digest {cited}: assumed, as plant and log were not "
            "given (--system, --data)", float("nan"), source=_SOURCE, status="assumed",
        ))  # fmt: skip
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
                _differences(found, again),
                source=_SOURCE,
            )
        )
    return VerificationReport.of(rows)


#: Ranges found again on another machine may differ by this share of their width.
SAME_WIDTH = 1e-2


def _differences(found: Mapping[str, Any], again: Mapping[str, Any]) -> list[str]:
    """Return what differs from the same calibration done again."""
    one, two = found.get("constants"), again["constants"]
    if not isinstance(one, dict) or one.keys() != two.keys():
        return ["names"]
    wrong = [] if found.get("level") == again["level"] else ["level"]
    return wrong + [name for name, item in two.items() if not _same_range(one[name], item)]


def _same_range(one: Any, item: Mapping[str, Any]) -> bool:
    """Whether a constant of a file is that of the calibration done again; what is malformed is not."""
    stated, (low, high) = _stated_range(one), item["range"]
    if not stated or any(one.get(key) != item[key] for key in ("open", "unit")):
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


def _misfits(found: Mapping[str, Any]) -> list[str]:
    level = found.get("level")
    wrong = [] if is_finite_number(level) and 0.0 < float(level or 0.0) < 1.0 else ["level"]
    log = found.get("log")
    wrong += [] if isinstance(log, dict) and isinstance(log.get("digest"), str) else ["log"]
    wrong += [] if isinstance(found.get("stands"), bool) else ["stands"]
    constants = found.get("constants")
    if not isinstance(constants, dict):
        return [*wrong, "constants"]
    stated = {str(name): _stated_range(item) for name, item in constants.items()}
    return wrong + [name for name, values in stated.items() if not values or sorted(values) != values]


def box_row(box: Any, path: Path) -> Check:
    """Return the row that a calibrated box is that of a calibration file."""
    found = read_calibration(path)
    constants = found["constants"]
    wrong = [] if box.calibration == found["sha256"] else ["digest of the calibration"]
    wrong += [] if box.digest == found["log"]["digest"] and box.level == found["level"] else ["log or level"]
    for name in box.calibrated or box.constants:
        item, stated = box.constants.get(name), constants.get(name)
        if item is None or stated is None or [item.low, item.high, item.nominal] != [*stated["range"],
                                                                                     stated["nominal"]]:  # fmt: skip
            wrong.append(name)
    return nothing_wrong("calibration", f"the box is that of {path.name}", wrong, source=_SOURCE)

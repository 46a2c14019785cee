"""Linear models in ``.mat`` files of MATLAB: matrices, structs of systems, results of Simulink's ``linmod``."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from obsynth.errors import SpecError
from obsynth.files.inputs import READING_ERRORS, path_of
from obsynth.numerics.arguments import arguments_checked
from obsynth.numerics.arrays import FloatArray, require_readable
from obsynth.numerics.suggestions import there_are
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.importing.dymola_models import fields_of_dslin
from obsynth.plants.importing.hdf5_models import WHAT_TO_SAVE, hdf5_arrays
from obsynth.plants.importing.roles import plant_of
from obsynth.plants.signal_names import unused_names

_MODEL_MATRICES = ("E", "A", "B", "C", "D")

_MORE = ("Bf", "Df", "Bd", "Dd", "Bw", "Dw")

# What MATLAB's state-space objects call them, and what obsynth does.
_MATLAB_NAMES = {
    "StateName": "state_names",
    "InputName": "input_names",
    "OutputName": "output_names",
    **{f"{kind}_names": f"{kind}_names" for kind in ("state", "input", "output", "fault", "disturbance", "noise")},
}

#: Letters of signals without names.
_LETTERS = {"state_names": "x", "input_names": "u", "output_names": "y"}

_SAMPLE_TIME_NAMES = ("Ts", "dt")

#: What MATLAB writes for a sampled model whose sampling time is not stated.
_UNSAID = -1.0

#: Sampling times that differ by less were rounded.
_SAME_TIME = 1e-12

#: The next states of an equilibrium repeat its states to this share.
ROUNDED_OFFSET = 1e-9

#: Delays of inputs and of outputs, in the TimeUnit, or in samples.
_DELAYS_OF = {"InputDelay": "input_names", "OutputDelay": "output_names"}

#: Delays inside a model, which belong to no signal of it; zero in all of them is no delay.
_INNER_DELAYS = ("InternalDelay", "IODelay", "ioDelay")

#: Fields with an operating point, and with units: what they are of.
_POINTS = {"x0": "state_names", "u0": "input_names", "y0": "output_names"}

#: MATLAB's operating point of a linearised model: ``dx`` is the rate there, which a linear model has no term for.
_OFFSETS = {"x": "x0", "u": "u0", "y": "y0"}

#: What has an operating point as a struct, and entries of it that are of no signal: ``linmod`` writes the time.
_POINT_STRUCTS = {"Offsets": ("dx",), "OperPoint": ("t",)}

_UNIT_FIELDS = {"StateUnit": "state_names", "InputUnit": "input_names", "OutputUnit": "output_names"}

#: Fields on which no equation of the model depends.
_WITHOUT_MEANING = frozenset(
    ("TimeUnit", "Scaled", "StatePath", "InputGroup", "OutputGroup", "Notes", "UserData", "Name", "SamplingGrid")
)

#: MATLAB's units of time in s.
_SECONDS_OF_TIME_UNITS = {
    "nanoseconds": 1e-9,
    "microseconds": 1e-6,
    "milliseconds": 1e-3,
    "seconds": 1.0,
    "minutes": 60.0,
    "hours": 3600.0,
    "days": 86400.0,
    "weeks": 7 * 86400.0,
    "months": 365.25 / 12 * 86400.0,
    "years": 365.25 * 86400.0,
}

#: Octave's names of the fields of a struct of a system, and MATLAB's.
_OCTAVE_NAMES = {
    **{name: name.upper() for name in "abcde"},
    "stname": "StateName",
    "inname": "InputName",
    "outname": "OutputName",
    "tsam": "Ts",
    "scaled": "Scaled",
    "ingroup": "InputGroup",
    "outgroup": "OutputGroup",
    "name": "Name",
    "notes": "Notes",
    "userdata": "UserData",
}


@arguments_checked
def from_matlab(
    path: str | Path,
    variable: str | None = None,
    *,
    dt: float | None = None,
    **plant: Any,
) -> DescriptorSystem:
    """Return the plant in a ``.mat`` file (of version 7.3 with ``obsynth[hdf5]``).

    Parameters
    ----------
    path : path
        The file.
    variable : str, optional
        A struct with fields ``A`` and, as far as there are any, ``E, B, C, D, Bf, Df, Bd, Dd, Bw, Dw``, ``Ts`` or
        ``dt`` (0 for continuous time, in the ``TimeUnit`` of the file; -1 does not say it) and names (``StateName``,
        ``InputName``, ``OutputName``, as
        ``struct(sys)`` has them, or ``state_names`` and so on).  May be left out where the file has one struct, or the
        matrices themselves.
        A struct that ``linmod`` of Simulink returns is one, and so are matrices in a ``dslin.mat`` of Dymola.
    dt : float, optional, seconds
        Where the file does not say it; 0 for continuous time.
    **plant
        Roles, as lists of names: ``faults`` and ``disturbances`` (inputs that are faults, or unknown; the others are
        known inputs), ``actuator_faults`` (known inputs on which a fault acts: adds ``fault of <input>``) and
        ``sensor_faults`` (outputs with a bias: adds ``bias of <output>``).  Any other argument of `DescriptorSystem`.

    Returns
    -------
    DescriptorSystem
        With the names and units in the file, in seconds whatever the ``TimeUnit``, with ``x0, u0, y0``, MATLAB's
        ``Offsets`` or ``OperPoint`` of ``linmod`` (which has no outputs: add them by ``operating_point={...}``) as
        operating point, and with ``InputDelay`` and ``OutputDelay`` as delays.  A name that is repeated gets a number,
        and a line end in a name of a block of Simulink is a blank.

    Raises
    ------
    SpecError
        The file cannot be read, holds no such struct, its matrices do not fit together, or it has an inner delay
        (``InternalDelay``) or a field that is not read and may change what the matrices mean.

    Examples
    --------
    >>> import obsynth
    >>> from tempfile import TemporaryDirectory
    >>> from scipy.io import savemat
    >>> with TemporaryDirectory() as folder:
    ...     savemat(f"{folder}/plant.mat", {"A": [[-1.0]], "C": [[1.0]], "Ts": 0.0})
    ...     print(obsynth.from_matlab(f"{folder}/plant.mat").A.tolist())
    [[-1.0]]
    """
    source = path_of(path)
    content = _content(source)
    if variable is None:
        content = fields_of_dslin(content, source) or content
    fields = _fields(content, variable, source)
    if "A" not in fields:
        raise SpecError(
            f"{source} has no matrix A{_in(variable)}; it has: {', '.join(fields) or 'nothing'}.", path=str(source)
        )
    is_struct = fields is not content and fields.keys() != content.keys()
    fields = _with_point(fields, source)
    _require_understood(fields, source, is_struct=is_struct)
    unit = _seconds_of_unit(fields, source)
    step = _step(fields, dt, unit, source)
    names = {ours: _names(fields[theirs], ours) for theirs, ours in _MATLAB_NAMES.items() if theirs in fields}
    labels = {ours: names.pop(ours, None) for ours in ("state_names", "input_names", "output_names")}
    matrices = {name: _dense_value(fields[name]) for name in (*_MODEL_MATRICES, *_MORE) if name in fields}
    if step == 0.0 and unit != 1.0:
        matrices = _per_second(matrices, unit, source)
    return plant_of(
        {name: matrices[name] for name in _MODEL_MATRICES if name in matrices and np.size(matrices[name])},
        {**{name: matrices[name] for name in _MORE if name in matrices}, **names, **plant},
        labels=labels,
        dt=step,
        point=_point(fields, labels, matrices, source),
        units=_units(fields, labels, matrices, source),
        delays=_delays(fields, labels, matrices, step or unit, source),
    )


def mat_arrays(source: Path) -> dict[str, Any]:
    """Return what a ``.mat`` file holds by name; raise `ValueError` for damaged and too large files."""
    try:
        # A small file may unpack to more than the memory holds.
        require_readable(sum(math.prod(shape) for _, shape, kind in scipy.io.whosmat(source) if kind != "sparse"))
        content = scipy.io.loadmat(source)
    except NotImplementedError:
        return hdf5_arrays(source)
    except scipy.io.matlab.MatReadError as error:
        raise ValueError(str(error)) from error
    return {name: value for name, value in content.items() if not name.startswith("__")}


def _content(source: Path) -> dict[str, Any]:
    if not source.is_file():
        raise SpecError(f"{source} does not exist.", path=str(source))
    try:
        return mat_arrays(source)
    except READING_ERRORS as error:
        raise SpecError(f"{source} cannot be read as a .mat file: {error}", path=str(source)) from error


def _fields(content: Mapping[str, Any], variable: str | None, source: Path) -> dict[str, Any]:
    structs = [
        name
        for name, value in content.items()
        if getattr(value, "dtype", None) is not None and value.dtype.names and value.size == 1
    ]
    if variable is None and ("A" in content or (not structs and "a" in content)):
        return _as_matlab_names(content)
    if variable is None and len(structs) != 1:
        named_structs = ", ".join(map(repr, structs)) or "none"
        raise SpecError(
            f"{source}: name the struct of the plant (variable=...); it has: {named_structs}.", path=str(source)
        )
    name = structs[0] if variable is None else variable
    held = content.get(name)
    if isinstance(held, scipy.io.matlab.MatlabOpaque):
        kind = np.ravel(held)[0]["s2"]
        raise SpecError(
            f"{source}: {name} is an object of MATLAB's class {kind.decode() if isinstance(kind, bytes) else kind}, "
            f"which MATLAB alone can unpack. {WHAT_TO_SAVE.format(name=name)}.",
            path=str(source),
        )
    if name not in structs:
        raise SpecError(
            f"{source} has no struct {name!r}; it has: {', '.join(map(repr, structs)) or 'none'}.", path=str(source)
        )
    record = content[name].reshape(-1)[0]
    return _as_matlab_names({field: record[field] for field in content[name].dtype.names})


def _as_matlab_names(fields: Mapping[str, Any]) -> dict[str, Any]:
    """Return fields by the names that MATLAB has: Octave's are in lower case, and some in a struct of their own."""
    if "A" in fields or "a" not in fields:
        return dict(fields)
    renamed = {_OCTAVE_NAMES.get(name, name): value for name, value in fields.items()}
    inner = renamed.pop("lti", None)
    if getattr(getattr(inner, "dtype", None), "names", None) and inner.size == 1:
        record = inner.reshape(-1)[0]
        renamed |= {_OCTAVE_NAMES.get(name, name): record[name] for name in inner.dtype.names}
    return renamed


def _require_understood(fields: Mapping[str, Any], source: Path, *, is_struct: bool) -> None:
    """Refuse, by name, what would change the meaning of the matrices and is not read."""
    for name in _INNER_DELAYS:
        if name in fields and np.any(_numbers_in(fields[name])):
            raise SpecError(
                f"{source} has {name}, a delay inside the model, which is not read (InputDelay and OutputDelay are): "
                "give a model without it (pade or absorbDelay of MATLAB), or with delays at its inputs and outputs.",
                path=str(source),
            )
    delays = (*_INNER_DELAYS, *_DELAYS_OF)
    known = {*_MODEL_MATRICES, *_MORE, *_MATLAB_NAMES, *_SAMPLE_TIME_NAMES, *delays, *_POINTS, *_UNIT_FIELDS}
    spelled = {name.lower(): name for name in (*known, "TimeUnit") if len(name) > 1}
    for name in fields:
        # A variable beside matrices may be anything, but not the sampling time by another spelling.
        if name not in known | _WITHOUT_MEANING and name.lower() in spelled:
            raise SpecError(
                f"{source} has {name!r}, which is not read: did you mean {spelled[name.lower()]!r}?", path=str(source)
            )
    unknown = [
        name
        for name, value in fields.items()
        if is_struct and name not in known | _WITHOUT_MEANING and np.size(value) and np.any(_nonempty(value))
    ]
    if unknown:
        raise SpecError(
            f"{source} has {'the field' if len(unknown) == 1 else 'the fields'} {', '.join(unknown)}, whose meaning is "
            "not known here: remove what the matrices do not depend on.",
            path=str(source),
        )


def _with_point(fields: Mapping[str, Any], source: Path) -> dict[str, Any]:
    """Return fields with the operating point of ``Offsets``, or of ``OperPoint``, as ``x0``, ``u0`` and ``y0``."""
    struct = next((name for name in _POINT_STRUCTS if np.size(fields.get(name, ()))), "Offsets")
    offsets: Any = fields.get(struct)
    if getattr(getattr(offsets, "dtype", None), "names", None) is None:
        return dict(fields)
    rest = {name: value for name, value in fields.items() if name != struct}
    if offsets.size != 1:
        return rest if not offsets.size else dict(fields)
    record = offsets.reshape(-1)[0]
    values = {name: record[name] for name in offsets.dtype.names if np.size(record[name])}
    known = (*_POINT_STRUCTS[struct], *_OFFSETS)
    unknown = [name for name in values if name not in known]
    if unknown:
        raise SpecError(
            f"{source}: {struct} has the field {unknown[0]!r}; {there_are(unknown[0], known)}",
            path=str(source),
        )
    structured = [name for name in _OFFSETS if getattr(values.get(name), "dtype", np.dtype(float)).names]
    if structured:
        raise SpecError(
            f"{source}: {struct}.{structured[0]} is a struct, and a vector of numbers is read: give "
            f"operating_point={{...}}, and remove {struct} from the file.",
            path=str(source),
        )
    values.pop("t", None)
    if not _is_at_rest(values.pop("dx", None), values.get("x"), sampled=_is_sampled(fields)):
        raise SpecError(
            f"{source}: by Offsets.dx the operating point is no equilibrium, and deviations from it obey no linear "
            "model without a constant term: linearise in a steady state.",
            path=str(source),
        )
    return {**rest, **{_OFFSETS[name]: value for name, value in values.items()}}


def _is_sampled(fields: Mapping[str, Any]) -> bool:
    return bool(np.any(_numbers_in(fields.get("Ts", 0.0))))


def _is_at_rest(moved: Any, states: Any, *, sampled: bool) -> bool:
    """Return whether MATLAB's ``dx`` says so: derivatives of the states or, of a sampled model, their next values."""
    if moved is None:
        return True
    at = _numbers_in(0.0 if states is None or not sampled else states).ravel()
    if at.size not in (1, np.size(moved)):
        return False
    difference = _numbers_in(moved).ravel() - at
    return bool(np.all(np.abs(difference) <= ROUNDED_OFFSET * np.abs(at)))


def _numbers_in(value: Any) -> FloatArray:
    try:
        return np.asarray(_dense_value(value), dtype=np.float64)
    except (TypeError, ValueError):
        return np.array([float(np.size(value) > 0)])


def _nonempty(value: Any) -> Any:
    return [bool(np.size(cell)) for cell in np.ravel(value)] if np.asarray(value).dtype == object else [True]


def _seconds_of_unit(fields: Mapping[str, Any], source: Path) -> float:
    """Return how many seconds are in the unit of time of a file; one where it states none."""
    units = _texts(fields["TimeUnit"]) if "TimeUnit" in fields else None
    if units is None:
        return 1.0
    text = units[0].lower()
    if len(units) != 1 or text not in _SECONDS_OF_TIME_UNITS:
        raise SpecError(
            f"{source}: TimeUnit is {units[0]!r}; {there_are(units[0], _SECONDS_OF_TIME_UNITS)}", path=str(source)
        )
    return _SECONDS_OF_TIME_UNITS[text]


def _step(fields: Mapping[str, Any], dt: float | None, unit: float, source: Path) -> float:
    """Return the sampling time in s; MATLAB has -1 for a sampled model that does not say it."""
    times = [
        float(np.squeeze(fields[name])) for name in _SAMPLE_TIME_NAMES if name in fields and np.size(fields[name]) == 1
    ]
    if len(set(times)) > 1:
        raise SpecError(f"{source} has Ts = {times[0]:g} and dt = {times[1]:g}: keep one of them.", path=str(source))
    if not times:
        if dt is None:
            raise SpecError(
                f"{source} has no sampling time (Ts): give dt in seconds, or 0 for continuous time.", path="dt"
            )
        return dt
    if times[0] == _UNSAID:
        if dt is None or dt == 0.0:
            raise SpecError(
                f"{source} is sampled, but does not say its sampling time (Ts = -1): give dt in seconds, above 0.",
                path="dt",
            )
        return dt
    own = times[0] * unit
    if dt is not None and not math.isclose(dt, own, rel_tol=_SAME_TIME):
        raise SpecError(f"dt is {dt}, but {source} has {own:g} s: leave dt out.", path="dt")
    return own


def _per_second(matrices: Mapping[str, Any], unit: float, source: Path) -> dict[str, Any]:
    """Return the matrices of ``E x' = A x + ...`` with the derivative in a unit of time of ``unit`` s, per second."""
    noisy = [name for name in ("Bw",) if name in matrices and np.any(matrices[name])]
    if noisy:
        raise SpecError(
            f"{source}: {noisy[0]} is the intensity of noise in a TimeUnit that is not the second: convert the model "
            "to seconds (chgTimeUnit of MATLAB).",
            path=noisy[0],
        )
    dynamic = ("A", "B", "Bf", "Bd")
    return {name: np.asarray(value) / unit if name in dynamic else value for name, value in matrices.items()}


def _labelled(
    fields: Mapping[str, Any],
    labels: Mapping[str, Any],
    matrices: Mapping[str, Any],
    wanted: Mapping[str, str],
    source: Path,
) -> Iterator[tuple[str, Any]]:
    """Yield names of signals with what a field says of each of them."""
    counts = _signal_counts(matrices)
    for (field, kind), prefix in zip(wanted.items(), "xuy", strict=True):
        values = np.ravel(_dense_value(fields[field])) if field in fields else np.zeros(0)
        if not values.size:
            continue
        if len(values) != counts[kind]:
            raise SpecError(
                f"{source}: {field} has {len(values)} entries, but there are {counts[kind]} such signals.",
                path=str(source),
            )
        yield from zip(labels[kind] or [f"{prefix}{i + 1}" for i in range(counts[kind])], values, strict=True)


def _signal_counts(matrices: Mapping[str, Any]) -> dict[str, int]:
    """Return the numbers of states, inputs and outputs by the field that names them."""
    return {
        "state_names": np.shape(matrices["A"])[-1],
        "input_names": next((np.shape(matrices[name])[-1] for name in "BD" if name in matrices), 0),
        "output_names": len(matrices["C"] if "C" in matrices else matrices["A"]),
    }


def _point(
    fields: Mapping[str, Any], labels: Mapping[str, Any], matrices: Mapping[str, Any], source: Path
) -> dict[str, float]:
    """Return the operating point of states, inputs and outputs, as fields ``x0``, ``u0`` and ``y0`` have it."""
    return {name: float(np.squeeze(value)) for name, value in _labelled(fields, labels, matrices, _POINTS, source)}


def _units(
    fields: Mapping[str, Any], labels: Mapping[str, Any], matrices: Mapping[str, Any], source: Path
) -> dict[str, str]:
    stated = _labelled(fields, labels, matrices, _UNIT_FIELDS, source)
    units = {name: str(np.squeeze(cell)).strip() for name, cell in stated if np.size(cell)}
    return {name: unit for name, unit in units.items() if unit}


def _delays(
    fields: Mapping[str, Any], labels: Mapping[str, Any], matrices: Mapping[str, Any], unit: float, source: Path
) -> dict[str, float]:
    """Return delays in s by input or output; ``unit``: seconds in what the file counts them in, samples or TimeUnit."""
    sizes = _signal_counts(matrices)
    delays: dict[str, float] = {}
    for (field, kind), prefix in zip(_DELAYS_OF.items(), "uy", strict=True):
        values = np.ravel(_numbers_in(fields[field])) if field in fields else np.zeros(0)
        if not np.any(values):
            continue
        if len(values) not in (1, sizes[kind]):
            raise SpecError(
                f"{source}: {field} has {len(values)} numbers, but there are {sizes[kind]} such signals.",
                path=str(source),
            )
        names = labels[kind] or [f"{prefix}{i + 1}" for i in range(sizes[kind])]
        for name, value in zip(names, np.broadcast_to(values, sizes[kind]), strict=True):
            delays[name] = float(value) * unit
    return delays


def _in(variable: str | None) -> str:
    return "" if variable is None else f" in {variable!r}"


def _dense_value(value: Any) -> Any:
    return value.toarray() if hasattr(value, "toarray") else value


def _names(value: Any, kind: str) -> list[str] | None:
    """Return names of signals: blanks for the line ends in blocks of Simulink, a number behind those that are repeated
    (``linmod`` names every state of a block alike), and numbered names for those that are empty among others."""
    texts = _texts(value)
    if texts is None or kind not in _LETTERS:
        return texts
    full = (re.sub(r"[\r\n]+", " ", text) or f"{_LETTERS[kind]}{i}" for i, text in enumerate(texts, 1))
    return list(unused_names(list(full), ()))


def _texts(value: Any) -> list[str] | None:
    """Return the texts of a cell array, or of a matrix of characters; `None` where all are empty, as MATLAB has it."""
    texts = [str(np.squeeze(cell)) if np.size(cell) else "" for cell in np.atleast_1d(value).ravel()]
    return [text.strip() for text in texts] if any(text.strip() for text in texts) else None

"""From a spec file to a plant that a method can use, transformed as asked, and a scenario that can be simulated.

From the sections of a checked document to plants, with the tolerances of their constants.

Matrices in files beside a spec: ``.mtx``, ``.npz``, ``.mat`` and ``.csv``.

The reader of Matrix Market is ours, since that of scipy (1.17) crashes the interpreter on some damaged files.
"""

from __future__ import annotations

import math
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from obsynth.errors import SpecError
from obsynth.files.inputs import input_file, path_of
from obsynth.methods.registry import REGISTRY, method_class
from obsynth.numerics.arguments import arguments_checked
from obsynth.numerics.arrays import MAXIMUM_ENTRIES, FloatArray, as_matrix, read_only, require_readable
from obsynth.numerics.libraries import one_thread_if_small
from obsynth.numerics.sparse import as_sparse_matrix, is_sparse
from obsynth.plants.calibrated_box import does_not_stand
from obsynth.plants.constants import constant_of
from obsynth.plants.dae import DAEModel
from obsynth.plants.descriptor import ALL_MATRICES, SIGNAL_NAMES, DescriptorSystem
from obsynth.plants.signal_names import index_of
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem
from obsynth.plants.transformations.elimination import eliminate_algebraic_states
from obsynth.plants.transformations.recovery import Transformation
from obsynth.plants.transformations.sampling import discretise
from obsynth.plants.uncertain_system import with_expressions
from obsynth.plants.uncertainty import UNCERTAIN_MATRICES, Entry
from obsynth.results.calibration_files import read_calibration
from obsynth.results.design import ObserverDesign
from obsynth.simulation.profiles import Profile
from obsynth.simulation.scenario import PROFILE_KINDS, Scenario
from obsynth.simulation.signals import check_parameters
from obsynth.specs.documents import DocumentProblems, checked_plant, checked_spec, read_names, read_yaml

if TYPE_CHECKING:
    from obsynth.specs.schema import ScenarioSection
    from obsynth.specs.schema_plants import EntrySection, PlantReference, PlantSection, TransformSection
    from obsynth.specs.schema_sections import DAESection, TimeVaryingSection


# What the readers of numpy and scipy raise for a damaged file.
_READING_ERRORS = (
    OSError,
    ValueError,
    TypeError,
    KeyError,
    IndexError,
    EOFError,
    OverflowError,
    RuntimeError,
    MemoryError,
    AttributeError,
    UserWarning,
    struct.error,
    zlib.error,
    zipfile.BadZipFile,
)


#: Smaller matrices become arrays: nothing is gained by sparsity.
SPARSE_FROM = 300

#: A sparse matrix needs memory for each row and column as well: this many entries' worth, generously.
ENTRIES_PER_LINE = 1000

#: Whole numbers with more digits are damage.
MOST_DIGITS = 15


_Plant = TypeVar("_Plant", DescriptorSystem, TimeVaryingDescriptorSystem, DAEModel)

# Equations picked by name also name the signal that enters there.
_SIGNAL_OF_PICK = {"B": "input_names", "Bw": "noise_names"}

_LABELS = ("operating_point", "scales", "units")


#: Noise of a nonlinear plant, which its linear model or the options of a method take; and what `with_noise` takes.
_TAKEN_NOISE = ("sensor_noise", "process_noise")

_NOISE_MODEL = ("sensor_noise", "offset", "walks")


#: Signals that name the columns of a matrix; rows are equations (states) or outputs.
_COLUMN_NAMES = {
    "B": "input_names",
    "D": "input_names",
    "Bf": "fault_names",
    "Df": "fault_names",
    "Bd": "disturbance_names",
    "Dd": "disturbance_names",
}

_OUTPUT_ROWS = ("C", "D", "Df", "Dd")


_SCENARIO_GROUPS = ("inputs", "faults", "disturbances", "sensors")


def read_matrix(path: Path, *, variable: str | None = None, where: str, keep_sparse: bool = False) -> Any:
    """Return the matrix in a file; a CSR array where it is stored by coordinates and may stay sparse."""
    return _checked(_read_array(path, variable=variable, where=where, keep_sparse=keep_sparse), path.name, where)


def _checked(given: Any, name: str, where: str) -> Any:
    try:
        matrix = as_sparse_matrix(given, name) if is_sparse(given) else as_matrix(given, name)
    except SpecError as error:
        raise SpecError(str(error), path=where) from error
    if 0 in matrix.shape:
        raise SpecError(f"{name} holds an empty matrix.", path=where)
    return matrix


def read_matrices(path: Path, *, variable: str | None = None, count: int | None = None, where: str) -> FloatArray:
    """Return the matrix in a file, or a stack of matrices ``(entries, rows, columns)``."""
    array = _read_array(path, variable=variable, where=where)
    if np.ndim(array) != 3:
        matrix: FloatArray = _checked(array, path.name, where)
        if count is None:
            return matrix
        rows, columns = matrix.shape
        if rows % count:
            raise SpecError(
                f"{path.name} has {rows} rows, which cannot be shared out among {count} matrices.", path=where
            )
        return read_only(matrix.reshape(count, rows // count, columns))
    stack = np.moveaxis(array, -1, 0) if path.suffix.lower() == ".mat" else array
    if not stack.size:
        raise SpecError(f"{path.name} holds an empty stack of matrices.", path=where)
    if count is not None and len(stack) != count:
        raise SpecError(f"{path.name} holds a stack of {len(stack)} matrices, not {count}.", path=where)
    named = ((f"{path.name}, matrix {k} of the stack,", matrix) for k, matrix in enumerate(stack, 1))
    return read_only(np.array([_checked(matrix, name, where) for name, matrix in named]))


def _read_array(path: Path, *, variable: str | None, where: str, keep_sparse: bool = False) -> Any:
    """Return what a file holds as an array of any kind, or as a sparse one."""
    readers: dict[str, Callable[[Path], Any]] = {
        ".mtx": partial(read_matrix_market, maximum_entries=MAXIMUM_ENTRIES, keep_sparse=keep_sparse),
        ".csv": partial(np.loadtxt, delimiter=",", ndmin=2, encoding="utf-8-sig"),
    }
    archives: dict[str, Callable[[Path], Mapping[str, Any]]] = {".npz": _numpy_archive, ".mat": _matlab_archive}
    suffix = path.suffix.lower()
    if suffix not in readers and suffix not in archives:
        known = ", ".join(sorted([*readers, *archives]))
        raise SpecError(f"{path.name} has an unknown suffix: matrices are read from {known} files.", path=where)
    if variable is not None and suffix in readers:
        raise SpecError(f"{path.name} holds one matrix only: remove 'variable'.", path=where)
    input_file(path, where=where)
    try:
        with warnings.catch_warnings(action="error", category=UserWarning):
            content = readers[suffix](path) if suffix in readers else archives[suffix](path)
            raw = content if suffix in readers else _selected(content, variable, path, where)
            return raw if keep_sparse and is_sparse(raw) and suffix == ".mtx" else _as_dense(raw)
    except _READING_ERRORS as error:
        raise SpecError(f"{path} cannot be read as a matrix: {_reason(error)}", path=where) from error


def _numpy_archive(path: Path) -> dict[str, Any]:
    # Opened here, because numpy leaves a damaged file open.
    with path.open("rb") as stream:
        if not zipfile.is_zipfile(stream):
            raise ValueError("it is no .npz archive")
        stream.seek(0)
        with np.load(stream, allow_pickle=False) as archive:
            # A small file may unpack to more than the memory holds.
            require_readable(sum(item.file_size for item in archive.zip.infolist()) / np.float64().nbytes)
            return dict(archive)


def _matlab_archive(path: Path) -> dict[str, Any]:
    from obsynth.plants.importing.model_files import mat_arrays

    return mat_arrays(path)


def _selected(content: Mapping[str, Any], variable: str | None, path: Path, where: str) -> Any:
    known = ", ".join(map(repr, content)) or "none"
    if variable is not None:
        if variable not in content:
            raise SpecError(f"{path} has no array {variable!r}; it has: {known}.", path=where)
        return content[variable]
    if len(content) != 1:
        raise SpecError(f"{path} must say which array is meant ('variable: name'); it has: {known}.", path=where)
    return next(iter(content.values()))


def _as_dense(raw: Any) -> Any:
    """Return an array for whatever a reader gave; a damaged sparse matrix must not reach scipy's loops."""
    require_readable(math.prod(int(length) for length in getattr(raw, "shape", ())))
    if not hasattr(raw, "toarray"):
        return raw
    if hasattr(raw, "check_format"):
        raw.check_format(full_check=True)
    return raw.toarray()


def _reason(error: BaseException) -> str:
    if isinstance(error, OSError) and error.strerror:
        return f"{error.strerror}."
    text = str(error).strip().splitlines()
    return f"{text[0].rstrip('.')}." if text else f"{type(error).__name__}."


def read_matrix_market(path: Path, *, maximum_entries: int, keep_sparse: bool = False) -> Any:
    """Return the matrix in a Matrix Market file: an array, or a CSR array of a large one that may stay sparse."""
    with path.open(encoding="utf-8") as stream:
        layout, field, symmetry = _checked_header(stream.readline(200))
        lines = (line for line in stream if line.strip() and not line.startswith("%"))
        size = next(lines, "").split()
        tokens = [token for line in lines for token in line.split()]
    counts = [_whole(token, "the sizes") for token in size]
    if len(counts) != (3 if layout == "coordinate" else 2) or min(counts) < 0:
        raise ValueError("the line with the sizes is damaged")
    rows, columns = counts[:2]
    sparse = keep_sparse and layout == "coordinate" and max(rows, columns) >= SPARSE_FROM
    entries = max(rows, columns) * ENTRIES_PER_LINE if sparse else rows * columns
    if max(entries, *counts) > maximum_entries:
        raise ValueError(f"it is too large ({max(rows * columns, *counts):.1e} entries)")
    if symmetry != "general" and rows != columns:
        raise ValueError(f"it is {symmetry}, but {rows} by {columns}")
    if layout == "array":
        return _from_array(tokens, rows, columns, symmetry)
    return _from_coordinates(tokens, (rows, columns, counts[2]), field, symmetry, sparse=sparse)


def _checked_header(line: str) -> tuple[str, str, str]:
    words = line.lower().split()
    if len(words) != 5 or words[:2] != ["%%matrixmarket", "matrix"]:
        raise ValueError("its first line is no Matrix Market header")
    _, _, layout, field, symmetry = words
    if field == "complex" or symmetry == "hermitian":
        raise ValueError("it holds complex numbers")
    known = (
        layout in ("coordinate", "array")
        and field in ("real", "double", "integer", "unsigned-integer", "pattern")
        and symmetry in ("general", "symmetric", "skew-symmetric")
        and (layout, field) != ("array", "pattern")
    )
    if not known:
        raise ValueError(f"'{' '.join(words[2:])}' is no known kind of Matrix Market file")
    return layout, field, symmetry


def _from_array(tokens: list[str], rows: int, columns: int, symmetry: str) -> FloatArray:
    values = _numbers(tokens)
    if symmetry == "general":
        _require_count(len(values), rows * columns)
        return values.reshape(columns, rows).T
    # The lower triangle, column by column.
    column, row = np.triu_indices(rows, 1 if symmetry == "skew-symmetric" else 0)
    _require_count(len(values), len(row))
    matrix = np.zeros((rows, columns))
    (row, column), values = _both_triangles([row, column], values, symmetry)
    matrix[row, column] = values
    return matrix


def _from_coordinates(tokens: list[str], size: tuple[int, int, int], field: str, symmetry: str, *, sparse: bool) -> Any:
    rows, columns, stored = size
    width = 2 if field == "pattern" else 3
    _require_count(len(tokens), width * stored)
    positions = [_indices(tokens[k::width]) - 1 for k in (0, 1)]
    for position, limit in zip(positions, (rows, columns), strict=True):
        if np.any(position < 0) or np.any(position >= limit):
            raise ValueError("an index is outside the matrix")
    values = np.ones(stored) if field == "pattern" else _numbers(tokens[2::width])
    if symmetry != "general":
        positions, values = _both_triangles(positions, values, symmetry)
    # Entries that are given twice are added, as the format says.
    from scipy.sparse import coo_array

    found = coo_array((values, (positions[0], positions[1])), shape=(rows, columns))
    return found.tocsr() if sparse else found.toarray()


def _both_triangles(positions: list[Any], values: FloatArray, symmetry: str) -> tuple[list[Any], FloatArray]:
    """Return the coordinates of a lower triangle and of what it stands for above the diagonal."""
    row, column = positions
    if np.any(column[values != 0.0] > row[values != 0.0]):
        raise ValueError(f"it is {symmetry}, but has entries above the diagonal")
    sign, below = (-1.0 if symmetry == "skew-symmetric" else 1.0), row > column
    mirrored = [np.concatenate([row, column[below]]), np.concatenate([column, row[below]])]
    return mirrored, np.concatenate([values, sign * values[below]])


def _numbers(tokens: list[str]) -> FloatArray:
    return np.fromiter(map(float, tokens), dtype=np.float64, count=len(tokens))


def _indices(tokens: list[str]) -> Any:
    if not all(map(str.isdecimal, tokens)) or max(map(len, tokens), default=0) > MOST_DIGITS:
        return np.array([_whole(token, "an index") for token in tokens], dtype=np.int64)
    return np.fromiter(map(int, tokens), dtype=np.int64, count=len(tokens))


def _whole(token: str, what: str) -> int:
    if not token.isdecimal() or len(token) > MOST_DIGITS:
        raise ValueError(f"{what} must be whole numbers, not {token[:20]!r}")
    return int(token)


def _require_count(found: int, expected: int) -> None:
    if found != expected:
        raise ValueError(f"it has {found} numbers after the sizes, but {expected} are needed")


def built_plant(
    section: PlantSection | TimeVaryingSection | DAESection, source: Path, prefix: str
) -> DescriptorSystem | TimeVaryingDescriptorSystem | DAEModel:
    """Return the plant of a section, as written."""
    kind = getattr(section, "kind", None)
    make: Any = _invariant_plant if kind is None else _nonlinear_plant if kind == "dae" else _varying_plant
    plant: DescriptorSystem | TimeVaryingDescriptorSystem | DAEModel = make(section, source, prefix)
    return plant


def _placed(make: Callable[[], _Plant], source: Path, prefix: str) -> _Plant:
    """Return the plant that is made; an error gets its place in the document."""
    try:
        return make()
    except SpecError as error:
        raise SpecError(
            f"{source}: {error.args[0].splitlines()[0]}",
            path=joined(prefix, error.path or ""),
            problems=error.problems,
        ) from error


def joined(prefix: str, name: str) -> str:
    """Return the path of an entry of a document."""
    return f"{prefix}.{name}" if prefix and name else prefix or name


def read_value(value: Any, folder: Path, where: str, problems: DocumentProblems, *, keep_sparse: bool = False) -> Any:
    """Return rows as an array, files read (matrices, or names), picks as lists of names, sections as mappings, all else
    as it is."""
    if isinstance(value, list):
        entries = (entry for row in value for entry in (row if isinstance(row, list) else [row]))
        is_matrix = all(isinstance(row, list) for row in value) and not any(isinstance(entry, str) for entry in entries)
        return np.array(value, dtype=np.float64) if is_matrix else value
    if hasattr(value, "file"):
        path = folder / value.file
        try:
            if not hasattr(value, "variable"):
                return read_names(path, where=where)
            if hasattr(value, "stack"):
                return read_matrices(path, variable=value.variable, count=value.stack, where=where)
            return read_matrix(path, variable=value.variable, where=where, keep_sparse=keep_sparse)
        except SpecError as error:
            problems.add(where, str(error))
            return None
    if hasattr(value, "outputs") or hasattr(value, "states"):
        return getattr(value, "outputs", getattr(value, "states", None))
    if isinstance(value, dict):
        return {name: entry.model_dump() if hasattr(entry, "model_dump") else entry for name, entry in value.items()}
    return value.model_dump(exclude_unset=True) if hasattr(value, "model_dump") else value


def _read(
    section: Any,
    source: Path,
    prefix: str,
    kept: Sequence[str],
    matrices: Sequence[str],
    names: Sequence[str],
    *,
    keep_sparse: bool = False,
) -> dict[str, Any]:
    """Return entries of a section by name: some as they are, matrices and lists of names with their files read."""
    problems = DocumentProblems(source, what="plant" if not prefix else "spec")
    arguments: dict[str, Any] = {name: getattr(section, name) for name in kept}
    for name in (*matrices, *names):
        value, where = getattr(section, name), joined(prefix, name)
        # A list without names is no matrix.
        arguments[name] = value and read_value(value, source.parent, where, problems, keep_sparse=keep_sparse)
    problems.raise_if_any()
    return arguments


def _varying_plant(section: TimeVaryingSection, source: Path, prefix: str) -> TimeVaryingDescriptorSystem:
    names = ("state_names", "input_names", "output_names", "parameter_names")
    arguments = _read(
        section, source, prefix, ("dt", "horizon", "constants", *_LABELS), ("E", "A", "B", "C", "Phi", "Psi"), names
    )
    return _placed(lambda: TimeVaryingDescriptorSystem(**arguments), source, prefix)


def _noise_model(section: Any) -> dict[str, Any]:
    """Return what a section says of noise that needs states, as `with_noise` takes it; white noise of others too."""
    found = {name: getattr(section, name, None) or {} for name in _NOISE_MODEL}
    found["sensor_noise"] = {
        name: item if isinstance(item, (int, float)) else item.model_dump(exclude_none=True)
        for name, item in found["sensor_noise"].items()
    }
    return {name: dict(value) for name, value in found.items() if value}


def _needs_states(noise: Mapping[str, Any]) -> bool:
    coloured = any(isinstance(item, dict) for item in noise.get("sensor_noise", {}).values())
    return coloured or "offset" in noise or "walks" in noise


def _nonlinear_plant(section: DAESection, source: Path, prefix: str) -> DAEModel:
    left_out = {"kind", "schema_version", "transform", "variation", "box", *_TAKEN_NOISE, *_NOISE_MODEL}
    arguments = section.model_dump(exclude=left_out, exclude_none=True)

    def made() -> DAEModel:
        units = arguments.get("units")
        for name, item in boxed_constants(section, source.parent)[0].items():
            found = constant_of(name, item)
            arguments["constants"][name] = found.nominal
            if found.unit and units is not None:
                units.setdefault(name, found.unit)
        return DAEModel(**arguments)

    return _placed(made, source, prefix)


def _invariant_plant(section: PlantSection, source: Path, prefix: str) -> DescriptorSystem:
    arguments = _read(
        section, source, prefix, ("dt", "sensor_noise", *_LABELS), ALL_MATRICES, SIGNAL_NAMES, keep_sparse=True
    )
    if _needs_states(_noise_model(section)):
        arguments["sensor_noise"] = None
    for matrix, names in _SIGNAL_OF_PICK.items():
        if isinstance(arguments[matrix], list) and arguments[names] is None:
            arguments[names] = arguments[matrix]
    return _placed(lambda: with_constants(DescriptorSystem(**arguments), section, source.parent), source, prefix)


def matlab_plant(reference: PlantReference, spec: Path) -> DescriptorSystem | None:
    """Return the plant in a ``.mat`` file that a spec refers to; `None` where it refers to another kind of file."""
    arguments = reference.model_dump(exclude={"file", "transform"}, exclude_none=True)
    if Path(reference.file).suffix.lower() == ".mat":
        from obsynth.plants.importing.model_files import from_matlab

        return _placed(lambda: from_matlab(spec.parent / reference.file, **arguments), spec, "plant")
    if arguments:
        raise SpecError(
            f"{spec}: plant.{next(iter(arguments))}: unknown key beside a file that is no .mat file: it belongs "
            f"into {reference.file}.",
            path=f"plant.{next(iter(arguments))}",
        )
    return None


def with_constants(plant: DescriptorSystem, section: PlantSection, folder: Path) -> DescriptorSystem:
    """Return the plant of a section with its constants and tolerances, if it has any."""
    if section.constants is None and section.tolerance is None:
        for name in ("entries", "variation", "box"):
            if getattr(section, name) is not None:
                raise SpecError(f"{name} is for a plant with constants: give constants, or tolerance.", path=name)
        return plant
    constants, box = boxed_constants(section, folder)
    entries = {name: [_entry(plant, name, item) for item in found] for name, found in (section.entries or {}).items()}
    return with_expressions(plant, entries, constants, tolerance=section.tolerance, variation=section.variation, **box)


def boxed_constants(section: PlantSection | DAESection, folder: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the constants of a section, those of a calibration put in place, and where their box comes from."""
    constants = dict(section.constants or {})
    if section.box is None:
        return constants, {}
    box = section.box.model_dump(exclude_none=True)
    file = box.pop("file", None)
    if file is None:
        if "source" not in box:
            raise SpecError(
                "box has no source: give source (stated, set-membership or calibrated), or the file of a calibration.",
                path="box.source",
            )
        return constants, box
    if box:
        raise SpecError("box has a file, which says where it comes from: remove source, level and digest.", path="box")
    found = read_calibration(folder / file, where="box.file")
    if not found["stands"]:
        raise SpecError(f"{file}: {does_not_stand(found['level'])}", path="box.file")
    options = {"source": "calibrated", "level": found["level"], "digest": found["log"]["digest"],
               "calibration": found["sha256"]}  # fmt: skip
    calibrated = {}
    for name, item in found["constants"].items():
        stated = constants.get(name)
        if isinstance(stated, dict) and ("range" in stated or "tolerance" in stated):
            raise SpecError(
                f"{name!r} has a tolerance here, and one in {file}: remove one of them.", path=f"constants.{name}"
            )
        unit = stated.get("unit") if isinstance(stated, dict) else None
        calibrated[name] = _calibrated(name, item, unit or (section.units or {}).get(name), file)
    return constants | calibrated, {**options, "calibrated": tuple(calibrated)}


def _calibrated(name: str, item: Mapping[str, Any], unit: str | None, file: str) -> dict[str, Any]:
    """Return nominal value, range and unit of a calibrated constant, whose unit in the plant is ``unit``, if any."""
    if item["open"]:
        raise SpecError(
            f"The box of {name!r} has an open {item['open'][0]} side: the log does not bound it there. State its "
            "range, or take a log that excites it.",
            path=f"constants.{name}",
        )
    if unit is not None and item["unit"] not in (unit, "1"):
        raise SpecError(
            f"{name!r} is in {unit} here, and in {item['unit']} in {file}: it was calibrated in another unit, or for "
            "another plant.",
            path=f"constants.{name}",
        )
    return {"nominal": item["nominal"], "range": list(item["range"]), "unit": unit or item["unit"]}


def _entry(plant: DescriptorSystem, matrix: str, item: EntrySection) -> Entry:
    if matrix not in UNCERTAIN_MATRICES:
        raise SpecError(
            f"{matrix!r} holds no constants: {', '.join(UNCERTAIN_MATRICES)} may.", path=f"entries.{matrix}"
        )
    rows = plant.output_names if matrix in _OUTPUT_ROWS else plant.state_names
    columns = getattr(plant, _COLUMN_NAMES.get(matrix, "state_names"))
    places = []
    for key, value, names in (("row", item.row, rows), ("column", item.column, columns)):
        if isinstance(value, str):
            places.append(index_of(value, names, what=f"entries.{matrix}"))
        elif 1 <= value <= len(names):
            places.append(value - 1)
        else:
            raise SpecError(f"{matrix} has no {key} {value}: it has {len(names)}.", path=f"entries.{matrix}")
    return places[0], places[1], str(item.value)


def built_scenario(
    section: ScenarioSection | None, plant: DescriptorSystem | TimeVaryingDescriptorSystem | DAEModel, source: Path
) -> Scenario | None:
    """Return the scenario of a spec; `None` if it has none."""
    if section is None:
        return None
    problems = DocumentProblems(source, what="spec")
    given: dict[str, Any] = {name: getattr(section, name) for name in section.model_fields_set}
    for group in _SCENARIO_GROUPS:
        given[group] = {
            name: [
                _profile(item, f"scenario.{group}.{name}", problems)
                for item in (value if isinstance(value, list) else [value])
            ]
            for name, value in getattr(section, group).items()
        }
    problems.raise_if_any()
    try:
        scenario = Scenario(**given)
        if isinstance(plant, DescriptorSystem):
            scenario.check_names(plant)
            scenario.step_of(plant)
        else:
            check_parameters(plant, scenario)
    except SpecError as error:
        problems.add(f"scenario.{error.path}", str(error))
        problems.raise_if_any()
    return scenario


def _profile(section: Any, where: str, problems: DocumentProblems) -> Profile | None:
    """Return the profile; note what is wrong with it."""
    kind = PROFILE_KINDS[section.kind]
    given = {name: getattr(section, name) for name in section.model_fields_set - {"kind"}}
    known = {field.name: field.default is MISSING for field in fields(kind)}
    for name in sorted(given.keys() - known.keys()):
        problems.add(f"{where}.{name}", f"a {section.kind} has no {name}: it takes {', '.join(known)}.")
    missing = [name for name, needed in known.items() if needed and name not in given]
    for name in missing:
        problems.add(f"{where}.{name}", f"a {section.kind} needs this key.")
    if missing or given.keys() - known.keys():
        return None
    try:
        return kind(**given)
    except SpecError as error:
        problems.add(f"{where}.{error.path}", str(error))
        return None


@dataclass(frozen=True, eq=False)
class Spec:
    """A spec, read and checked.

    Parameters
    ----------
    name : str
        Name of the design.
    description : str
        Free text; empty if there is none.
    path : Path
        The file it was read from.
    plant : DescriptorSystem, TimeVaryingDescriptorSystem or DAEModel
        The plant as the method sees it, after the transformation.
    transformation : Transformation, optional
        What was done to the plant as written, and the way back.
    method : str
        Identifier of the method.
    options : mapping
        The options of the method that the spec gives, checked.
    scenario : Scenario, optional
        What `obsynth.simulate` is asked to let happen.
    model : DAEModel, optional
        The nonlinear plant as written, where the plant is one, or is linearised from one.
    calibrate : mapping, optional
        What `obsynth.calibrate` is asked to find, as written; its log is looked up beside the spec.
    inputs : mapping, optional
        When the inputs of a row act: ``hold`` (``begins`` or ``ends``: during the step that begins or ends with the
        row) and ``delay`` (rows).
    noise : mapping, optional
        Noise of the sensors, offsets and walks as written, for which the plant has states (`obsynth.with_noise`).
    """

    name: str
    description: str
    path: Path
    plant: DescriptorSystem | TimeVaryingDescriptorSystem | DAEModel
    transformation: Transformation | None
    method: str
    options: Mapping[str, Any]
    scenario: Scenario | None = None
    model: DAEModel | None = None
    calibrate: Mapping[str, Any] | None = None
    noise: Mapping[str, Any] | None = None
    inputs: Mapping[str, Any] | None = None

    def input_delay(self, plant: Any) -> int | None:
        """Return rows by which a log's inputs act later than a plant takes them; ``None`` where the spec says nothing.

        Nonlinear plants take the inputs of a row during the step that ends there, others on samples during the one that
        begins.  Without ``inputs.hold`` the delay is by the convention of the plant that is designed for.

        Parameters
        ----------
        plant : DescriptorSystem, TimeVaryingDescriptorSystem or DAEModel
            The one that takes the log.
        """
        own = _takes_inputs(plant)
        if self.inputs is not None:
            hold = self.inputs["hold"] or _takes_inputs(self.plant)
            return int(self.inputs["delay"]) + (hold == "begins") - (own == "begins")
        found = (self.calibrate or {}).get("input_delay")
        if not isinstance(found, int):
            return None
        # What a calibration of a nonlinear plant found is by the convention of that plant.
        sampled = isinstance(plant, DescriptorSystem) and plant.is_discrete and self.model is not None
        return found - int(sampled)


def _takes_inputs(plant: Any) -> str:
    """Return when a plant takes the inputs of a row, by the words of ``inputs.hold``."""
    nonlinear = isinstance(plant, DAEModel) or (isinstance(plant, DescriptorSystem) and not plant.is_discrete)
    return "ends" if nonlinear else "begins"


def load_model(path: str | Path) -> tuple[DAEModel, Spec | None]:
    """Return the nonlinear plant of a spec, with the spec, or of a file that holds a plant alone."""
    plant, spec = load_plant(path)
    if not isinstance(plant, DAEModel):
        raise SpecError(f"{path} holds no nonlinear plant (kind: dae).", path=str(path))
    return plant, spec


def load_plant(
    path: str | Path,
) -> tuple[DescriptorSystem | TimeVaryingDescriptorSystem | DAEModel, Spec | None]:
    """Return the plant of a spec as it was written, with the spec, or that of a file that holds a plant alone."""
    source = Path(path)
    document = read_yaml(source)
    if "method" not in document and "plant" not in document:
        return built_plant(checked_plant(document, source), source, ""), None
    spec = spec_of(document, source, with_states=False)
    if spec.model is not None:
        return spec.model, spec
    return spec.plant if spec.transformation is None else spec.transformation.source, spec


@arguments_checked
def load_spec(path: str | Path) -> Spec:
    """Read a spec; check it strictly; build its plant and transform it as asked.

    Parameters
    ----------
    path : str or Path
        A YAML 1.2 document.  Files it refers to are looked up in its own folder.

    Returns
    -------
    Spec
        Ready for `obsynth.design`.

    Raises
    ------
    SpecError
        The document or a file it refers to is malformed; as many problems as can be found at once, each
        with its path.
    PreconditionError
        The plant cannot be transformed as asked, for example because its index is not one.

    Examples
    --------
    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> import obsynth
    >>> text = "{schema_version: 1, name: first, plant: {dt: 1, A: [[0.9]], C: [[1]], Bf: [[1]]}}"
    >>> with TemporaryDirectory() as folder:
    ...     file = Path(folder) / "spec.yaml"
    ...     _ = file.write_text(text)
    ...     spec = obsynth.load_spec(file)
    >>> spec.name, spec.plant.fault_names
    ('first', ('f1',))
    """
    source = path_of(path)
    return spec_of(read_yaml(source), source)


def design_of_spec(
    spec: Spec, *, name: str | None = None, progress: Callable[[str], None] | None = None
) -> ObserverDesign:
    """Return the design that a spec asks for, proved, with what its transformation says and when its inputs act."""
    from obsynth.methods.designing import design

    done, late = spec.transformation, spec.input_delay(spec.plant)
    found = design(
        spec.plant,
        spec.method,
        name=name or spec.name,
        recovery=None if done is None else done.recovery,
        progress=progress,
        scenario=spec.scenario,
        **dict(spec.options),
    )
    notes = () if done is None else done.notes
    return found.replace(notes=(*notes, *found.notes), input_delay=late or found.input_delay)


def spec_of(
    document: Mapping[str, Any],
    source: Path,
    *,
    plant_changes: Mapping[str, Any] | None = None,
    with_states: bool = True,
) -> Spec:
    """Return the spec that a document stands for, as if it were in ``source``; a plant in a file may be changed.

    ``with_states``: whether the plant gets states for noise that is not white, offsets and walks.
    """
    checked, raw_options = checked_spec(document, source)
    reference: Any = checked.plant if hasattr(checked.plant, "file") else None
    section, plant_source, prefix, from_mat = _plant_section(checked.plant, source, plant_changes or {})
    problems = DocumentProblems(source, what="spec")
    options = {
        name: read_value(value, source.parent, f"method.options.{name}", problems)
        for name, value in raw_options.items()
    }
    problems.raise_if_any()
    plant, transformation = built_plant(section, plant_source, prefix) if from_mat is None else from_mat, None
    # A plant may serve several methods: the spec's own transform takes the place of the plant's.
    asked: tuple[TransformSection | None, Path, str] = (getattr(section, "transform", None), plant_source, prefix)
    if reference is not None and reference.transform is not None:
        asked = (reference.transform, source, "plant")
    model = plant if isinstance(plant, DAEModel) else None
    noise = _noise_model(section)
    states = with_states and _needs_states(noise)
    if model is not None:
        linear = _linearised(asked[0], model, section, plant_source.parent, noise if states else {}, *asked[1:])
        if linear is None and with_states and (noise or section.process_noise):
            plant, options = _noisy_model(model, section, noise, checked.method.id, options, plant_source, prefix)
        plant = plant if linear is None else linear
    elif asked[0] is not None and asked[0].linearise is not None:
        raise SpecError(
            f"{asked[1]}: transform.linearise is for nonlinear plants (kind: dae): remove it.",
            path="plant.transform.linearise",
        )
    if isinstance(plant, DescriptorSystem):
        noisy: Any = None
        if states and model is None:
            noisy, more = _placed_noise(plant, noise, plant_source, prefix)
            transformation, plant = noisy, noisy.plant
        if asked[0] is not None:
            with one_thread_if_small(plant.nx):
                later = _transformed(asked[0], plant, *asked[1:])
            if later is not None:
                transformation = later if transformation is None else transformation.then(later)
        plant = plant if transformation is None else transformation.plant
        if noisy is not None and plant.state_names == noisy.plant.state_names:
            options = _with_options(options, more, checked.method.id)
    elif model is None and reference is not None and reference.transform is not None:
        raise SpecError(
            f"{source}: plant.transform is for linear plants with constant matrices, which {plant_source.name} is not: "
            "remove it.",
            path="plant.transform",
        )
    return Spec(
        name=checked.name,
        description=checked.description or "",
        path=source,
        plant=plant,
        transformation=transformation,
        method=checked.method.id,
        options=options,
        scenario=built_scenario(checked.scenario, plant, source),
        model=model,
        calibrate=None if checked.calibrate is None else checked.calibrate.model_dump(exclude_none=True),
        noise=noise or None,
        inputs=_checked_inputs(checked.inputs, plant, source),
    )


def _plant_section(section: Any, source: Path, changes: Mapping[str, Any]) -> tuple[Any, Path, str, Any]:
    """Return the section of a plant, the file and place in it where it stands, and the plant where MATLAB wrote it."""
    from_mat = matlab_plant(section, source) if hasattr(section, "file") else None
    if from_mat is not None or not hasattr(section, "file"):
        return section, source, "plant", from_mat
    place = source.parent / section.file
    return checked_plant(changed_document(read_yaml(place, where="plant.file"), changes), place), place, "", None


def _checked_inputs(section: Any, plant: object, source: Path) -> dict[str, Any] | None:
    """Return how a log tells the known inputs, as plain data; ``None`` where nothing is said of that."""
    inputs: dict[str, Any] | None = None if section is None else section.model_dump()
    if inputs is not None and inputs["hold"] and isinstance(plant, DescriptorSystem) and not plant.is_discrete:
        raise SpecError(
            f"{source}: inputs.hold is for plants on samples, and a continuous design takes inputs as straight lines "
            "between rows: sample the plant (transform: sample_time).",
            path="inputs.hold",
        )
    return inputs


def _placed_noise(plant: Any, noise: Mapping[str, Any], source: Path, prefix: str, **more: Any) -> Any:
    """Return what `with_noise` makes of a plant; an error gets its place in the document."""
    from obsynth.plants.transformations.noise_states import with_noise

    try:
        return with_noise(plant, **noise, **more)
    except SpecError as error:
        raise SpecError(f"{source}: {error.args[0]}", path=joined(prefix, error.path or "")) from error


def _noisy_model(
    model: DAEModel,
    section: DAESection,
    noise: Mapping[str, Any],
    method: str,
    options: Mapping[str, Any],
    source: Path,
    prefix: str,
) -> tuple[DAEModel, dict[str, Any]]:
    """Return a nonlinear plant with states for its noise, and the options of its method with variances from it."""
    steps = {"integration": options["integration"]} if options.get("integration") == "radau" else {}
    given = {"process_noise": section.process_noise, "dt": options.get("dt"), **steps}
    made, more = _placed_noise(model, noise, source, prefix, **given)
    return made, _with_options(options, more, method)


def _with_options(options: Mapping[str, Any], more: Mapping[str, Any], method: str) -> dict[str, Any]:
    """Return options with others that the method has, where they are not given; of those by name, what is missing."""
    known = {field.name for field in fields(method_class(method))} if method in REGISTRY else set()
    found = dict(options)
    for name, value in more.items():
        if name not in known:
            continue
        if name not in found:
            found[name] = value
        elif isinstance(value, dict) and isinstance(found[name], dict):
            found[name] = {**value, **found[name]}
    return found


def _linearised(
    wanted: TransformSection | None,
    model: DAEModel,
    section: DAESection,
    folder: Path,
    noise: Mapping[str, Any],
    source: Path,
    prefix: str,
) -> DescriptorSystem | None:
    """Return the linear model of a nonlinear plant where a spec asks for one; ``folder``: of the plant's file."""
    constants, box = boxed_constants(section, folder)
    tolerances = {name: item for name, item in constants.items() if not isinstance(item, (int, float))}
    if wanted is None:
        if tolerances or section.variation is not None or section.box is not None:
            raise SpecError(
                f"{source}: {joined(prefix, 'constants')}: tolerances are for the linear model of a nonlinear plant: "
                "add transform: {linearise: {at: equilibrium}}, or write numbers.",
                path=joined(prefix, "constants"),
            )
        return None
    where = joined(prefix, "transform")
    if wanted.linearise is None:
        raise SpecError(
            f"{source}: {where} is for linear plants: say where this one is linearised, such as linearise: {{at: "
            "equilibrium}, or remove it.",
            path=where,
        )
    from obsynth.plants.transformations.entries_in_constants import box_of_model
    from obsynth.plants.transformations.linearisation import linearise

    arguments = wanted.linearise.model_dump(exclude_none=True)
    if noise:
        model, more = _placed_noise(model, noise, source, prefix, process_noise=section.process_noise)
    else:
        white = {name: item for name, item in (section.sensor_noise or {}).items() if isinstance(item, (int, float))}
        more = {"sensor_noise": white or None, "process_noise": section.process_noise}
    arguments["given"] = more.pop("given", {}) | arguments.get("given", {})
    arguments |= more
    tolerances |= arguments.pop("constants", {})
    if not tolerances and (box or section.variation is not None):
        raise SpecError(
            f"{source}: {joined(prefix, 'variation')} and box are for constants with tolerances: give some.",
            path=joined(prefix, "constants"),
        )
    try:
        if tolerances:
            given = arguments.get("given", {})
            arguments["constants"] = box_of_model(model, tolerances, given, variation=section.variation, **box)
        return linearise(model, **arguments)
    except SpecError as error:
        raise SpecError(f"{source}: {where}.linearise: {error}", path=f"{where}.linearise") from error


def _transformed(
    wanted: TransformSection | None, plant: DescriptorSystem, source: Path, prefix: str
) -> Transformation | None:
    """Return a plant without its algebraic states, sampled, or both, as asked; ``None`` where nothing is."""
    if wanted is None or not (wanted.eliminate_algebraic_states or wanted.sample_time is not None):
        return None
    where = joined(prefix, "transform")
    if wanted.sample_time is not None and plant.is_discrete:
        raise SpecError(
            f"{source}: {where}.sample_time is given, but the plant is discrete in time already "
            f"(dt = {plant.dt:g} s): remove it, or set dt to 0.",
            path=f"{where}.sample_time",
        )

    try:
        if wanted.sample_time is None:
            return eliminate_algebraic_states(plant)
        if not wanted.eliminate_algebraic_states:
            return discretise(plant, wanted.sample_time)
        reduced = eliminate_algebraic_states(plant)
        return reduced.then(discretise(reduced.plant, wanted.sample_time))
    except SpecError as error:
        raise SpecError(f"{source}: {where}: {error}", path=where) from error


def changed_document(document: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return a document with values at dotted paths put in place of those there; mappings on the way are made."""
    changed = dict(document)
    for path, value in changes.items():
        first, _, rest = path.partition(".")
        if not rest:
            changed[first] = value
            continue
        inner = changed.get(first)
        if inner is not None and not isinstance(inner, Mapping):
            raise SpecError(f"{path} cannot be set: {first} is no section with entries of its own.", path=path)
        changed[first] = changed_document(inner or {}, {rest: value})
    return changed

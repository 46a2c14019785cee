"""Variables of MATLAB 7.3 files, which are HDF5 with MATLAB's classes as attributes (h5py, ``obsynth[hdf5]``)."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse

from obsynth.numerics.arrays import require_readable
from obsynth.numerics.libraries import imported

#: What to save in MATLAB in place of an object.
WHAT_TO_SAVE = (
    "Of a system write there [A,B,C,D,E,Ts] = dssdata({name}); save('plant.mat','A','B','C','D','E','Ts'), or "
    "s = struct({name}); save('plant.mat','s'), which keeps the names; leave other objects out of the file"
)

#: What a struct of a system has for remarks: objects there (MATLAB's strings) are left out.
_REMARKS = ("Notes", "UserData")


def hdf5_arrays(source: Path) -> dict[str, Any]:
    """Return variables by name, as ``scipy.io.loadmat`` has those of older files.

    Raises
    ------
    SpecError
        h5py is not installed.
    ValueError
        A variable is of a class that no model has, or too large.
    """
    h5py = imported("h5py", extra="hdf5", what="A .mat file of version 7.3")
    with h5py.File(source, "r") as file:
        return {name: _value(file[name], file, h5py) for name in file if not name.startswith("#")}


def _value(item: Any, file: Any, h5py: Any) -> Any:
    kind = item.attrs.get("MATLAB_class", b"double")
    kind = kind.decode() if isinstance(kind, bytes) else str(kind)
    _require_no_object(item, kind)
    if isinstance(item, h5py.Group):
        if "MATLAB_sparse" in item.attrs:
            return _sparse(item)
        if kind != "struct":
            raise ValueError(f"{item.name} is a {kind}, which is not read: save struct(sys) or the matrices")
        return _struct({name: _value(item[name], file, h5py) for name in item if not _is_remark(item[name], name)})
    require_readable(math.prod(item.shape))
    if item.attrs.get("MATLAB_empty", 0):
        return np.zeros(tuple(int(size) for size in np.ravel(item[()])), dtype=object if kind == "cell" else float)
    # Columns come first there.
    raw = np.asarray(item[()]).T
    if kind == "char":
        return np.array(["".join(map(chr, row)) for row in np.atleast_2d(raw).tolist()])
    if kind == "cell":
        cells = np.empty(raw.shape, dtype=object)
        for place in np.ndindex(*raw.shape):
            cells[place] = _value(file[raw[place]], file, h5py)
        return cells
    if raw.dtype.names == ("real", "imag"):
        return raw["real"] + 1j * raw["imag"]
    if kind not in ("double", "single", "logical") and not kind.startswith(("int", "uint")):
        raise ValueError(f"{item.name} is a {kind}, which is not read: save struct(sys) or the matrices")
    return raw.astype(np.float64)


def _is_remark(item: Any, name: str) -> bool:
    return name in _REMARKS and "MATLAB_object_decode" in item.attrs


def _require_no_object(item: Any, kind: str) -> None:
    """Refuse an object: what stands in its place are marks of MATLAB's, and its numbers lie where no name tells."""
    if "MATLAB_object_decode" not in item.attrs or kind == "function_handle":
        return
    name = str(item.name).strip("/").replace("/", ".")
    raise ValueError(
        f"{name} is an object of MATLAB's class {kind} in a file of version 7.3, which MATLAB alone can unpack. "
        f"{WHAT_TO_SAVE.format(name=name)}"
    )


def _struct(fields: dict[str, Any]) -> Any:
    record = np.empty((1, 1), dtype=[(name, object) for name in fields])
    for name, value in fields.items():
        record[name][0, 0] = value
    return record


def _sparse(group: Any) -> Any:
    starts = np.asarray(group["jc"][()], dtype=np.int64)
    rows = np.asarray(group["ir"][()], dtype=np.int64) if "ir" in group else np.zeros(0, dtype=np.int64)
    data = np.asarray(group["data"][()], dtype=np.float64) if "data" in group else np.zeros(0)
    return scipy.sparse.csc_array((data, rows, starts), shape=(int(group.attrs["MATLAB_sparse"]), len(starts) - 1))

"""Linear models that Dymola's ``linearize`` writes: ``dslin.mat`` with ``[A, B; C, D]``, sizes and names."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from obsynth.errors import SpecError

_ARRAYS = ("ABCD", "nx", "xuyName")


def fields_of_dslin(content: Mapping[str, Any], source: Path) -> dict[str, Any] | None:
    """Return matrices and names of a ``dslin.mat``, by the names that MATLAB has for them; `None` for another file.

    Raises
    ------
    SpecError
        Its sizes do not fit together.
    """
    if any(name not in content for name in _ARRAYS[:2]):
        return None
    together = np.atleast_2d(np.asarray(content["ABCD"], dtype=np.float64))
    nx = int(np.squeeze(content["nx"]))
    rows, columns = together.shape
    names = [str(name).replace("\0", "").strip() for name in np.ravel(content.get("xuyName", ()))]
    nu, ny = columns - nx, rows - nx
    if min(nx, nu, ny) < 0 or (names and len(names) != nx + nu + ny):
        raise SpecError(
            f"{source}: ABCD is {rows} by {columns} with {nx} states and {len(names)} names in xuyName, which do not "
            "fit together: give the file as Dymola writes it.",
            path=str(source),
        )
    fields: dict[str, Any] = {
        "A": together[:nx, :nx],
        "B": together[:nx, nx:],
        "C": together[nx:, :nx],
        "D": together[nx:, nx:],
        "Ts": 0.0,
    }
    if names:
        parts = (names[:nx], names[nx : nx + nu], names[nx + nu :])
        fields |= {
            field: np.array(part, dtype=object)
            for field, part in zip(("StateName", "InputName", "OutputName"), parts, strict=True)
        }
    # A model without outputs measures all its states.
    if not ny:
        fields |= {"C": np.eye(nx), "D": np.zeros((nx, nu)), "OutputName": np.array(names[:nx], dtype=object)}
    return fields

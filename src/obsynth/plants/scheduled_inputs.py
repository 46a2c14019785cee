"""Signals of a plant by which it is scheduled: known inputs may be, and outputs; what is estimated proves nothing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.plants.signal_names import unused_names

#: Input of a linear model whose equilibrium or whose inputs depend on its scheduling: it is one, always.
SHIFT_INPUT = "shift"

#: Where the names of signals are that no log has.
_NOT_MEASURED = {"state_names": "a state", "fault_names": "a fault", "disturbance_names": "an unknown input"}
#: What is known of one input by its name.
_BY_NAME = ("operating_point", "units")

Entries = dict[str, list[tuple[int, int, str]]]


def require_measured(parameters: Mapping[str, Mapping[str, Any]], names: Mapping[str, Sequence[str]]) -> None:
    """Raise `SpecError` for a parameter that is a signal which no log has, unless the parameter has a column.

    Parameters
    ----------
    parameters : mapping
        As `obsynth.plants.scheduling.parameters_of` returns them.
    names : mapping
        Names of the plant's signals: ``state_names``, ``output_names`` and so on.
    """
    for kind, meaning in _NOT_MEASURED.items():
        for name in parameters:
            shown_by_log = parameters[name].get("column") or name in (*names["output_names"], *names["input_names"])
            if name in names[kind] and not shown_by_log:
                raise SpecError(
                    f"{name!r} is {meaning} of the plant: an estimated parameter proves nothing about the estimate "
                    "(the product of its error and the state is no disturbance of known size). Where it is measured, "
                    f"name the column of the log that holds it (scheduling: {{{name}: {{range: ..., column: ...}}}}); "
                    "else take the nonlinear model (obsynth.region_observer).",
                    path=f"scheduling.{name}",
                )


def with_inputs_scheduled(
    arguments: Mapping[str, Any], written: Entries, parameters: Mapping[str, Mapping[str, Any]], shift: str | None
) -> tuple[dict[str, Any], Entries, str | None]:
    """Return a plant without the known inputs by which it is scheduled: an input that is one has what they do.

    Parameters
    ----------
    arguments : mapping
        The arguments of `DescriptorSystem`, with zeros where entries are texts.
    written : dict
        The texts of matrices, with their places.
    parameters : mapping
        As `obsynth.plants.scheduling.parameters_of` returns them.
    shift : str or None
        An input that is one in every row, where there is one already.

    Raises
    ------
    SpecError
        Such an input has a dead time or a factor.
    """
    if arguments.get("B") is None:
        return dict(arguments), written, shift
    names = _input_names(arguments)
    read = {str(entry.get("column") or name): name for name, entry in parameters.items()}
    taken = {place: read[name] for place, name in enumerate(names) if name in read}
    if not taken:
        return dict(arguments), written, shift
    for key in ("delays", "scales"):
        both = [names[place] for place in taken if names[place] in (arguments.get(key) or {})]
        if both:
            raise SpecError(
                f"{both[0]!r} schedules the plant and has {key}: give the parameter a column of the log with the value "
                "that acts, and leave the input out.",
                path=f"plant.{key}",
            )
    changed = dict(arguments)
    kept = [place for place in range(len(names)) if place not in taken]
    if shift is None:
        signals = [name for key in arguments if key.endswith("_names") for name in arguments[key] or ()]
        (shift,) = unused_names([SHIFT_INPUT], [*signals, *names, *parameters])
    if shift not in names:
        kept.append(len(names))
        names = [*names, shift]
    point = arguments.get("operating_point") or {}
    moved = {place: _beside(name, point.get(names[place], 0.0)) for place, name in taken.items()}
    new_written = dict(written)
    for matrix in ("B", "D"):
        if arguments.get(matrix) is not None:
            rows = _padded(arguments[matrix], len(names))
            changed[matrix], new_written[matrix] = _gathered(rows, written[matrix], moved, names.index(shift), kept)
    changed["input_names"] = [names[place] for place in kept]
    gone = {names[place] for place in taken}
    for key in _BY_NAME:
        if arguments.get(key):
            changed[key] = {name: value for name, value in arguments[key].items() if name not in gone}
    if changed.get("operating_point"):
        changed["operating_point"].setdefault(shift, 0.0)
    if changed.get("units"):
        changed["units"].setdefault(shift, "1")
    return changed, new_written, shift


def _input_names(arguments: Mapping[str, Any]) -> list[str]:
    matrix, names = arguments["B"], arguments.get("input_names")
    if names is None and hasattr(matrix, "columns"):
        names = matrix.columns
    count = np.shape(matrix)[-1] if len(np.shape(matrix)) else 0
    return list(names) if names is not None else [f"u{place + 1}" for place in range(count)]


def _beside(name: str, point: Any) -> str:
    """Return a parameter beside the point of the linear model."""
    return f"({name} - {float(point)!r})" if float(point) else name


def _padded(matrix: Any, count: int) -> list[list[float]]:
    """Return the rows of a matrix with zeros up to so many columns."""
    rows = np.asarray(matrix.toarray() if hasattr(matrix, "toarray") else matrix, dtype=np.float64)
    padded: list[list[float]] = np.column_stack([rows, np.zeros((len(rows), count - rows.shape[1]))]).tolist()
    return padded


def _gathered(
    rows: list[list[float]],
    entries: Sequence[tuple[int, int, str]],
    moved: Mapping[int, str],
    shift: int,
    kept: Sequence[int],
) -> tuple[list[list[float]], list[tuple[int, int, str]]]:
    """Return the kept columns of a matrix, with the columns that move times their signals in that of the shift."""
    texts = {(i, j): text for i, j, text in entries}
    new: list[tuple[int, int, str]] = []
    for i, row in enumerate(rows):
        parts = [] if (i, shift) not in texts else [f"({texts[i, shift]})"]
        parts += [repr(row[shift])] if row[shift] else []
        moving = [
            f"({texts.get((i, j), repr(row[j]))}) * {signal}"
            for j, signal in moved.items()
            if (i, j) in texts or row[j]
        ]
        if moving:
            new.append((i, kept.index(shift), " + ".join([*parts, *moving])))
            row[shift] = 0.0
        elif (i, shift) in texts:
            new.append((i, kept.index(shift), texts[i, shift]))
        new += [(i, kept.index(j), texts[i, j]) for j in kept if j != shift and (i, j) in texts]
    return [[row[j] for j in kept] for row in rows], new

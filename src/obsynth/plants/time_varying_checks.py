"""Checking what a time-varying plant is made of."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics.arguments import is_finite_number, is_whole
from obsynth.numerics.expressions import CONSTANTS
from obsynth.plants.sequences import MatrixSequence, zeros
from obsynth.plants.validation import Problems, checked_dt

#: Matrix, signal of its rows ("e" counts the equations), signal of its columns, first k at which it is needed.
LAYOUT = (
    ("E", "e", "x", 1), ("A", "e", "x", 0), ("C", "y", "x", 1),
    ("B", "e", "u", 0), ("Phi", "e", "p", 0), ("Psi", "y", "p", 0),
)  # fmt: skip
#: E and C are needed at k = 1 ... N for N steps: as stacks they have N + 1 entries, of which the first is not used.
LATE = ("E", "C")


def missing(name: str) -> None:
    """Raise `SpecError`: the matrix ``name`` is missing."""
    raise SpecError(f"{name} is missing: a plant needs A and C.", path=name)


def positive_dt(dt: Any) -> float:
    """Return a sampling time in seconds that is not zero."""
    checked = checked_dt(dt)
    if checked == 0.0:
        raise SpecError("dt is 0: a time-varying plant is discrete in time, give the seconds between samples.",
                        path="dt")  # fmt: skip
    return checked


def checked_constants(constants: Mapping[str, float] | None) -> dict[str, float]:
    """Return names and finite values that expressions may use."""
    checked: dict[str, float] = {}
    if constants is None:
        return checked
    if not isinstance(constants, Mapping):
        raise SpecError(f"constants is a {type(constants).__name__}: give names and values.", path="constants")
    for name, value in constants.items():
        if not (isinstance(name, str) and name.isidentifier()) or name == "k" or name in CONSTANTS:
            raise SpecError(f"constants names {name!r}: use letters, digits and '_', not k or pi.", path="constants")
        if not is_finite_number(value):
            raise SpecError(f"The constant {name!r} is {value!r}: give a finite number.", path=f"constants.{name}")
        checked[name] = float(value)
    return checked


def completed(found: Mapping[str, MatrixSequence | None], problems: Problems) -> dict[str, MatrixSequence]:
    """Return all matrices, zeros or the identity where none is given; note wrong shapes."""
    a, c = found["A"], found["C"]
    if a is None or c is None:
        return {}
    b, phi, psi = found.get("B"), found.get("Phi"), found.get("Psi")
    columns = next((m.shape[1] for m in (phi, psi) if m is not None and 0 not in m.shape), 0)
    sizes = {"e": a.shape[0], "x": a.shape[1], "y": c.shape[0], "u": 0 if b is None else b.shape[1], "p": columns}
    if 0 in (sizes["e"], sizes["x"]):
        problems.collect(partial(_wrong_shape, "A", a.shape, "at least 1 by 1"))
    completed = {}
    for name, rows, cols, _ in LAYOUT:
        shape, matrix = (sizes[rows], sizes[cols]), found.get(name)
        if name == "E" and matrix is None:
            matrix = MatrixSequence.of(np.eye(sizes["x"]), "E")
        if matrix is None or (0 in matrix.shape and 0 in shape):
            matrix = zeros(name, shape)
        if matrix.shape != shape:
            problems.collect(partial(_wrong_shape, name, matrix.shape, f"{shape[0]} by {shape[1]}"))
        completed[name] = matrix
    return completed


def _wrong_shape(name: str, shape: tuple[int, int], wanted: str) -> None:
    raise SpecError(f"{name} is {shape[0]} by {shape[1]}, but {wanted} is needed.", path=name)


def checked_horizon(horizon: int | None, values: Mapping[str, MatrixSequence]) -> int | None:
    """Return the number of steps that all stacks are good for, or ``None`` without any limit."""
    if horizon is not None and (not is_whole(horizon) or horizon < 1):
        raise SpecError(f"horizon is {horizon!r}: give the number of steps, at least 1.", path="horizon")
    lengths = {name: m.length - (name in LATE) for name, m in values.items() if m.length is not None}
    if not lengths:
        return None if horizon is None else int(horizon)
    shortest = min(lengths, key=lambda name: lengths[name])
    if horizon is None and len(set(lengths.values())) > 1:
        listed = ", ".join(f"{name} for {steps}" for name, steps in lengths.items())
        raise SpecError(
            f"The stacks are good for different numbers of steps: {listed}. For N steps E and C need N + 1 matrices, "
            "A, B, Phi and Psi need N; or give the horizon.", path="horizon",
        )  # fmt: skip
    if horizon is not None and horizon > lengths[shortest]:
        raise SpecError(
            f"horizon is {horizon}, but the stack {shortest} is good for {lengths[shortest]} steps only.",
            path="horizon",
        )
    return lengths[shortest] if horizon is None else int(horizon)


def check_every_k(values: Mapping[str, MatrixSequence], horizon: int | None) -> None:
    """Evaluate callables and expressions along the horizon, so that a bad k is found before anything runs."""
    for name, matrix in values.items():
        if matrix.values is None and horizon is not None:
            first = 1 if name in LATE else 0
            for k in range(first, horizon + first):
                matrix.at(k)

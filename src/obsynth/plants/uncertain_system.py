"""Plants with tolerances: from a plant and its constants."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics.arguments import arguments_checked, require_mapping
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.expressions import parse_expression
from obsynth.plants.calibrated_box import CalibratedBox
from obsynth.plants.constants import Constant, ConstantsBox, constant_of, constants_box, tolerance_share
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.uncertainty import (
    SAME_EXPRESSION_VALUE,
    UNCERTAIN_MATRICES,
    Entry,
    Uncertainty,
    as_written,
    expressions_in,
    matrices_of,
)


def stated_box(constants: Any, variation: str | None = None) -> Any:
    """Return a calibrated box as a box of constants with its level and digest; any other argument unchanged."""
    if not isinstance(constants, CalibratedBox):
        return constants
    return constants_box(
        constants.constants(), variation=variation, source="calibrated", level=constants.level, digest=constants.digest
    )


@arguments_checked
def uncertain_system(
    plant: DescriptorSystem | Mapping[str, Any],
    constants: Mapping[str, Any] | ConstantsBox | None = None,
    *,
    tolerance: Mapping[str, Any] | None = None,
    variation: str | None = None,
    source: str | None = None,
    level: float | None = None,
    digest: str | None = None,
) -> DescriptorSystem:
    """Return a linear plant with tolerances of its constants.

    Parameters
    ----------
    plant : DescriptorSystem or mapping
        A mapping holds the arguments of `DescriptorSystem`, where entries of ``E, A, B, C, D, Bf, Df, Bd, Dd`` may be
        expressions in the constants, such as ``"-k / mass"``.  A plant that has constants already gets the new
        tolerances; its nominal values stay where none is given.
    constants : mapping, ConstantsBox or CalibratedBox, optional
        By name: a number (known exactly), ``{nominal, tolerance, unit}`` with a tolerance such as ``"5 %"``,
        ``{range: [low, high]}`` or ``(low, high)``.  One constant in several entries is one unknown.  The name of a
        matrix, such as ``{"A": "2 %"}``, stands for a tolerance of each of its entries.
    tolerance : mapping, optional
        ``{"A": "2 %"}``: a tolerance of every entry of a matrix that is a number other than zero, each an unknown of
        its own, named ``A[1,2]``.
    variation : {"constant", "varying"}, optional
        Whether constants stay as they are (the default), or may be anything in their ranges at each sample:
        ``E(p_{k+1}) x(k+1) = A(p_k) x(k) + ...``.  A zero-order hold takes them as constant within a sample.
    source : {"stated", "set-membership", "calibrated"}, optional
        Where the box comes from; what is said about it repeats that.
    level : float, optional
        For ``calibrated``: the probability that the box holds the truth.
    digest : str, optional
        For ``calibrated``: sha256 of the log.

    Returns
    -------
    DescriptorSystem
        With `uncertainty`; matrices are those at the nominal values.  Every method takes it.

    Raises
    ------
    SpecError
        A name is unknown, a tolerance has no nominal value or an open side, or an expression is malformed.
    PreconditionError
        A transformation since the plant was written is not defined at the new nominal values.

    Notes
    -----
    After Wang et al. 2015 with tolerances of our own: the reference is the theory of robust bounds (Neumaier, *Interval
    Methods for Systems of Equations*, 1990, and affine arithmetic, de Figueiredo and Stolfi, 2004), with proved
    remainders.

    Examples
    --------
    >>> plant = uncertain_system(
    ...     {"E": None, "A": [["1 - 0.1 * k / m"]], "C": [[1]], "dt": 0.1},
    ...     {"k": {"nominal": 2.0, "tolerance": "5 %"}, "m": {"range": [0.9, 1.2], "nominal": 1.0}},
    ... )
    >>> plant.A.tolist(), plant.uncertainty.box.names
    ([[0.8]], ('k', 'm'))
    """
    options = {"variation": variation, "source": source, "level": level, "digest": digest}
    before = plant.uncertainty if isinstance(plant, DescriptorSystem) else None
    constants = stated_box(constants, variation or (None if before is None else before.box.variation))
    for name, stated in (("constants", constants), ("tolerance", tolerance)):
        if not isinstance(stated, ConstantsBox):
            require_mapping(stated, name)
    if isinstance(plant, DescriptorSystem):
        system, entries = plant, dict[str, list[Entry]]()
        if before is not None:
            return _with_tolerances(plant, before, constants, tolerance, options)
    else:
        require_mapping(plant, "plant")
        arguments, entries = dict(plant), {}
        for name in UNCERTAIN_MATRICES:
            if arguments.get(name) is not None:
                arguments[name], written = expressions_in(arguments[name])
                if written:
                    entries[name] = written
        try:
            system = DescriptorSystem(arguments.pop("E", None), arguments.pop("A"), **arguments)
        except KeyError as error:
            raise SpecError("plant has no matrix A.", path="plant.A") from error
        except TypeError as error:
            raise SpecError(f"plant: {error}.", path="plant") from error
    return with_expressions(system, entries, constants, tolerance=tolerance, **options)


def with_expressions(
    system: DescriptorSystem,
    entries: Mapping[str, list[Entry]],
    constants: Any,
    *,
    tolerance: Any = None,
    **options: Any,
) -> DescriptorSystem:
    """Return a plant with expressions in some entries, at the nominal values of the constants."""
    names = set(constants.constants if isinstance(constants, ConstantsBox) else constants or {})
    # An entry with an expression has no tolerance of its own.
    box, more = _boxed(constants, tolerance, {}, matrices_of(system), entries, options)
    return filled_plant(system, Uncertainty(box, _joined(entries, more)), names)


def filled_plant(system: DescriptorSystem, uncertainty: Uncertainty, stated: set[str]) -> DescriptorSystem:
    """Return a plant as written with its entries at the nominal values of the constants."""
    values = {name: item.nominal for name, item in uncertainty.box.constants.items()}
    matrices = uncertainty.filled(matrices_of(system), values)
    _require_used(uncertainty, stated)
    for name, matrix in matrices.items():
        if not np.isfinite(matrix).all():
            raise SpecError(f"{name} is not finite at the nominal values of the constants.", path=name)
    return system.replace(**matrices, uncertainty=uncertainty)


def _require_used(uncertainty: Uncertainty, stated: set[str]) -> None:
    unknown = sorted(name for name in stated - uncertainty.used if name in uncertainty.box.constants)
    if unknown:
        raise SpecError(
            f"The constant {unknown[0]!r} appears in no matrix: write an entry as an expression in it, or remove it.",
            path=f"constants.{unknown[0]}",
        )


def _with_tolerances(
    plant: DescriptorSystem, before: Uncertainty, constants: Any, tolerance: Any, options: Mapping[str, Any]
) -> DescriptorSystem:
    """Return a plant with new tolerances of its constants; the nominal values stay the same."""
    written = as_written(plant, before)
    entries = {name: list(items) for name, items in before.entries.items()}
    stated = {key: value for key, value in options.items() if value is not None}
    variation = constants.variation if isinstance(constants, ConstantsBox) else before.box.variation
    box_options = {"variation": variation, **_kept_source(before.box, constants, stated), **stated}
    box, more = _boxed(constants, tolerance, before.box.constants, written, entries, box_options)
    after = replace(before, box=box, entries=_joined(entries, more))
    _require_used(after, set(box.constants))
    moved = [
        name
        for name, item in before.box.constants.items()
        if name not in box.constants
        or abs(box.constants[name].nominal - item.nominal) > SAME_EXPRESSION_VALUE * abs(item.nominal)
    ]
    if moved and before.written is None and moved[0] in box.constants:
        return filled_plant(plant, after, set())
    if moved:
        raise SpecError(
            f"The nominal value of {moved[0]!r} is {before.box.constants[moved[0]].nominal:g} in this plant, which was "
            "transformed since it was written: its tolerance may change, but another nominal value is another plant. "
            "Give the plant as written.",
            path=f"constants.{moved[0]}",
        )
    return plant.replace(uncertainty=after)


def _kept_source(box: ConstantsBox, constants: Any, stated: Mapping[str, Any]) -> dict[str, Any]:
    """Return the source of a box after some of its tolerances were replaced."""
    if isinstance(constants, ConstantsBox) or "source" in stated:
        return {}
    if box.source != "calibrated":
        return {"source": box.source}
    unchanged = tuple(name for name in box.calibrated or box.constants if name not in (constants or {}))
    return (
        {
            "source": "calibrated",
            "level": box.level,
            "digest": box.digest,
            "calibrated": unchanged,
            "calibration": box.calibration,
        }
        if unchanged
        else {}
    )


def _boxed(
    constants: Any,
    tolerance: Any,
    known: Mapping[str, Constant],
    matrices: Mapping[str, FloatArray],
    entries: Mapping[str, list[Entry]],
    options: Mapping[str, Any],
) -> tuple[ConstantsBox, dict[str, list[Entry]]]:
    """Return the box, and the matrix entries that are constants themselves."""
    if isinstance(constants, ConstantsBox):
        if not tolerance and not known.keys() - constants.constants.keys():
            return constants, {}
        logged = (constants.calibrated or tuple(constants.constants)) if constants.source == "calibrated" else None
        own = {
            "variation": constants.variation,
            "source": constants.source,
            "level": constants.level,
            "digest": constants.digest,
            "calibrated": logged,
            "calibration": constants.calibration or None,
        }
        options = own | {key: value for key, value in options.items() if value is not None}
        constants = constants.constants
    boxed, shares, more = dict[str, Any](), dict(tolerance or {}), dict[str, list[Entry]]()
    # A constant may have the name of a matrix, such as a capacitance C: names in expressions are constants.
    texts = [
        text for matrix, cells in entries.items() for row, column, text in cells if text != _entry(matrix, row, column)
    ]
    named = frozenset[str]().union(*(parse_expression(text).names for text in texts))
    for name, value in (constants or {}).items():
        if name in UNCERTAIN_MATRICES and name not in {*known, *named} and isinstance(value, (str, int, float)):
            shares.setdefault(name, value)
        else:
            boxed[name] = value
    for matrix, value in shares.items():
        if matrix not in UNCERTAIN_MATRICES:
            raise SpecError(
                f"{matrix!r} is no matrix: {', '.join(UNCERTAIN_MATRICES)} may have a tolerance.",
                path=f"tolerance.{matrix}",
            )
        share = tolerance_share(value, f"tolerance.{matrix}")
        present = {text for _, _, text in entries.get(matrix, ())}
        taken = {(row, column) for row, column, text in entries.get(matrix, ()) if text != _entry(matrix, row, column)}
        for row, column in np.argwhere(matrices[matrix] != 0.0).tolist():
            if (row, column) in taken:
                continue
            name, number = _entry(matrix, row, column), float(matrices[matrix][row, column])
            boxed[name] = constant_of(name, {"nominal": number, "tolerance": share})
            if name not in present:
                more.setdefault(matrix, []).append((row, column, name))
    return constants_box(boxed, known=known, **options), more


def _entry(matrix: str, row: int, column: int) -> str:
    return f"{matrix}[{row + 1},{column + 1}]"


def _joined(one: Mapping[str, list[Entry]], two: Mapping[str, list[Entry]]) -> dict[str, tuple[Entry, ...]]:
    return {name: (*one.get(name, ()), *two.get(name, ())) for name in {**one, **two}}

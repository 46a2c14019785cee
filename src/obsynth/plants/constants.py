"""Physical constants with tolerances: nominal value, range, and the source of both."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, Literal

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics.arguments import check_fields, is_finite_number, is_number, real_number
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.outward import lower, upper
from obsynth.numerics.suggestions import there_are

_KEYS = ("nominal", "tolerance", "range", "unit")

#: Signals, states and constants that a sentence lists; a digest stands for the others.
MOST_LISTED = 6

#: Whole numbers up to so many digits are shown without a point.
WHOLE_DIGITS = 12

#: Digits of a bound in a text: a calibrated one has all of them.
RANGE_DIGITS = 6

#: Shares of tolerances that agree so well are one share: they were stated as per cent.
SAME_TOLERANCE = 1e-9

_PER_CENT = re.compile(r"\s*([0-9]*\.?[0-9]+(?:[eE][+-]?[0-9]+)?)\s*%\s*")


def shown(value: float, unit: str = "") -> str:
    """Return a number with all its digits, and its unit."""
    number = float(value)
    text = str(int(number)) if number.is_integer() and abs(number) < 10.0**WHOLE_DIGITS else repr(number)
    return f"{text} {'' if unit == '1' else unit}".rstrip()


def _in_few_digits(item: Constant) -> tuple[float, float]:
    """Return a range inside that of a constant, so that what holds for the latter holds for what a text says."""
    low, high = upper(item.low, RANGE_DIGITS), lower(item.high, RANGE_DIGITS)
    return (low, high) if low < high else (item.low, item.high)


def shown_bound(value: float, unit: str = "") -> str:
    """Return a bound in the digits of a text, rounded down: what holds for a bound holds for a lower one."""
    return shown(lower(value, RANGE_DIGITS), unit)


def deviations_told(count: float) -> str:
    """Return so many standard deviations in words, rounded down: what holds for a bound holds for a lower one."""
    return f"{shown(lower(count, RANGE_DIGITS))} standard deviation{'' if count == 1 else 's'}"


@dataclass(frozen=True)
class Constant:
    """A physical constant: what it should be, and what it may be.

    Parameters
    ----------
    name : str
        As expressions use it.
    nominal : float
        What a design takes.
    low, high : float
        Ends of its range, around the nominal value; equal to it where the constant is known.
    unit : str, optional
        Of all three.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.uncertain_system(
    ...     {"A": [["a"]], "C": [[1]], "Bf": [[1]], "dt": 1.0}, {"a": {"nominal": 0.5, "tolerance": "5 %"}}
    ... )
    >>> constant = plant.uncertainty.box.constants["a"]
    >>> constant.nominal, constant.low, constant.high
    (0.5, 0.475, 0.525)
    """

    name: str
    nominal: float
    low: float
    high: float
    unit: str = ""

    def __post_init__(self) -> None:
        path = f"constants.{self.name}"
        for key, value in (("nominal", self.nominal), ("range", self.low), ("range", self.high)):
            real_number(value, f"The {key} of {self.name!r}", "finite numbers. A box needs both ends", path=path)
        if not self.low <= self.nominal <= self.high:
            raise SpecError(
                f"The nominal value {self.nominal:g} of {self.name!r} is outside its range {self.low:g} .. "
                f"{self.high:g}.",
                path=path,
            )

    @property
    def half(self) -> float:
        """Half the width of the range."""
        return (self.high - self.low) / 2.0

    @property
    def middle(self) -> float:
        """Middle of the range."""
        return self.low + self.half

    @property
    def certain(self) -> bool:
        """Whether there is no tolerance."""
        return self.low == self.high

    def scaled(self, factor: float) -> Constant:
        """Return the constant with its tolerance times a factor.

        Parameters
        ----------
        factor : float
            0 or more.
        """
        low = self.nominal - factor * (self.nominal - self.low)
        return Constant(self.name, self.nominal, low, self.nominal + factor * (self.high - self.nominal), self.unit)

    def as_dict(self) -> dict[str, Any]:
        """Return plain data, as `constants_box` reads it."""
        return {"nominal": self.nominal, "range": [self.low, self.high], "unit": self.unit}


@dataclass(frozen=True, eq=False)
class ConstantsBox:
    """Constants with their tolerances, whether they vary, and where the box comes from.

    Parameters
    ----------
    constants : mapping of str to Constant
        By name, in order.
    variation : {"constant", "varying"}, optional
        ``constant``: unknown, but the same at all times.  ``varying``: anything in its range at each sample, where the
        value at sample k + 1 multiplies x(k+1): ``E(p_{k+1}) x(k+1) = A(p_k) x(k) + ...``; a plant that was sampled
        has one value within a sample, and a state that does not jump when it changes.
    source : {"stated", "set-membership", "calibrated"}, optional
        Where the ranges come from.
    level : float, optional
        For ``calibrated``: probability that the box holds the truth.
    digest : str, optional
        For ``calibrated``: sha256 of the log.
    calibrated : tuple of str, optional
        For ``calibrated``: the constants that the log has bounded, where the ranges of others are stated; all if empty.
    calibration : str, optional
        For ``calibrated``: sha256 of the calibration file that gives the box.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.uncertain_system(
    ...     {"A": [["a"]], "C": [[1]], "Bf": [[1]], "dt": 1.0}, {"a": {"nominal": 0.5, "tolerance": "5 %"}}
    ... )
    >>> box = plant.uncertainty.box
    >>> box.names, box.variation, box.source
    (('a',), 'constant', 'stated')
    """

    constants: Mapping[str, Constant]
    variation: Literal["constant", "varying"] = "constant"
    source: Literal["stated", "set-membership", "calibrated"] = "stated"
    level: float | None = None
    digest: str = ""
    calibrated: tuple[str, ...] = ()
    calibration: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "constants", MappingProxyType(dict(self.constants)))
        object.__setattr__(self, "calibrated", tuple(self.calibrated))
        check_fields(self, ConstantsBox)
        calibrated = self.source == "calibrated"
        if calibrated and not (is_finite_number(self.level) and 0.0 < float(self.level or 0.0) < 1.0):
            raise SpecError(
                f"level is {self.level!r}: a calibrated box needs its probability, between 0 and 1.", path="level"
            )
        if not calibrated and (self.level is not None or self.digest or self.calibrated or self.calibration):
            raise SpecError("level and digest are for a calibrated box (source: calibrated).", path="level")

    @property
    def uncertain(self) -> tuple[Constant, ...]:
        """The constants that have a tolerance."""
        return tuple(item for item in self.constants.values() if not item.certain)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the constants that have a tolerance: the unknowns q, in order."""
        return tuple(item.name for item in self.uncertain)

    def _logged(self) -> tuple[str, list[str]]:
        """Return the words for a calibrated box, and the constants whose ranges are stated beside it."""
        log = f" of the log {self.digest[:12]}" if self.digest else ""
        stated = [name for name in self.names if self.calibrated and name not in self.calibrated]
        return f"{100.0 * float(self.level or 0.0):g} % box{log}", stated

    @property
    def origin(self) -> str:
        """Where the box comes from, in a few words."""
        words, stated = self._logged()
        only = f" for {', '.join(self.calibrated)}, others stated" if stated else ""
        return f"calibrated ({words}{only})" if self.source == "calibrated" else self.source

    @property
    def sentence(self) -> str:
        """What a statement says about where the box comes from."""
        if self.source == "calibrated":
            words, stated = self._logged()
            others = f", or outside its stated tolerance ({', '.join(stated)})" if stated else ""
            return f"a constant outside its {words}{others}"
        if self.source == "set-membership":
            return "a constant outside the set that the log's bounds allow"
        return "a constant outside its stated tolerance"

    @property
    def phrase(self) -> str:
        """Which constants are assumed to be where, and whether they may change."""
        if not self.names:
            return "an exact model"
        shares = [item.half / abs(item.nominal) if item.nominal else np.nan for item in self.uncertain]
        centred = [
            abs(item.middle - item.nominal) <= SAME_TOLERANCE * max(item.half, abs(item.nominal))
            for item in self.uncertain
        ]
        names = ", ".join(self.names) if len(self.names) <= MOST_LISTED else f"{len(self.names)} constants"
        if np.ptp(shares) <= SAME_TOLERANCE and all(centred):  # false where there is no share
            text = f"{names} within {100.0 * float(np.mean(shares)):.6g} % of nominal"
        elif len(self.names) <= MOST_LISTED:
            text = ", ".join(
                f"{item.name} in {shown(low)} .. {shown(high, item.unit)}"
                for item in self.uncertain
                for low, high in [_in_few_digits(item)]
            )
        else:
            text = f"{names} within their ranges"
        variation = "the same at all times" if self.variation == "constant" else "they may change from sample to sample"
        origin = "" if self.source == "stated" else f"; {self.origin}"
        return f"constants ({text}; {variation}{origin})"

    @property
    def offsets(self) -> FloatArray:
        """Where the nominal values are in the unknowns q, ``(p,)``: 0 in the middle of a range."""
        return np.array([(item.nominal - item.middle) / item.half for item in self.uncertain])

    def scaled(self, factors: float | FloatArray) -> ConstantsBox:
        """Return the box with tolerances times factors.

        Parameters
        ----------
        factors : float or FloatArray
            One for all, or one for each uncertain constant.
        """
        names = self.names
        each = dict(zip(names, np.broadcast_to(factors, (len(names),)).tolist(), strict=True))
        scaled_constants = {name: item.scaled(each.get(name, 1.0)) for name, item in self.constants.items()}
        return replace(self, constants=scaled_constants)

    def part(self, lower: FloatArray, upper: FloatArray) -> ConstantsBox:
        """Return the part ``lower <= q <= upper`` of the box; its nominal values are in its middle.

        Parameters
        ----------
        lower, upper : FloatArray
            One for each uncertain constant, in -1 .. 1.
        """
        constants = dict(self.constants)
        for item, a, b in zip(self.uncertain, lower, upper, strict=True):
            low, high = item.middle + float(a) * item.half, item.middle + float(b) * item.half
            constants[item.name] = Constant(item.name, min(max((low + high) / 2.0, low), high), low, high, item.unit)
        return replace(self, constants=constants)

    def values(self, q: FloatArray) -> dict[str, float]:
        """Return the value of each constant at ``q (p,)`` in -1 .. 1.

        Parameters
        ----------
        q : FloatArray
            One for each uncertain constant.
        """
        values = {name: item.nominal for name, item in self.constants.items()}
        for item, place in zip(self.uncertain, q, strict=True):
            values[item.name] = item.middle + float(place) * item.half
        return values

    def as_dict(self) -> dict[str, Any]:
        """Return plain data, as `constants_box` reads it."""
        plain = {name: getattr(self, name) for name in ("variation", "source", "level", "digest")}
        constants = {name: item.as_dict() for name, item in self.constants.items()}
        more = {"calibrated": list(self.calibrated)} if self.calibrated else {}
        return {
            "constants": constants,
            **plain,
            **more,
            **({"calibration": self.calibration} if self.calibration else {}),
        }


def tolerance_share(value: Any, path: str) -> float:
    """Return a tolerance as a share, from ``"5 %"`` or a share such as 0.05."""
    if isinstance(value, str):
        match = _PER_CENT.fullmatch(value)
        if match is None:
            raise SpecError(f"The tolerance {value!r} is no per cent: write it as '5 %'.", path=path)
        return float(match.group(1)) / 100.0
    if not (is_finite_number(value) and value >= 0.0):
        raise SpecError(f"The tolerance is {value!r}: write it as '5 %' (a box needs both ends).", path=path)
    if value >= 1.0:
        raise SpecError(
            f"The tolerance is {value!r}, a share of {100.0 * value:g} %: write it as '5 %' or 0.05.", path=path
        )
    return float(value)


def constant_of(name: str, entry: Any, *, nominal: float | None = None) -> Constant:
    """Return a constant from a number, ``(low, high)`` or a mapping with `nominal`, `tolerance` or `range`, `unit`."""
    path = f"constants.{name}"
    if isinstance(entry, Constant):
        return Constant(name, entry.nominal, entry.low, entry.high, entry.unit)
    if is_number(entry) and nominal is None:
        return Constant(name, float(entry), float(entry), float(entry))
    if isinstance(entry, str) and nominal is None:
        raise SpecError(
            f"{name!r} is the text {entry!r}, which is no number: give a number, or nominal, tolerance and unit by "
            "these keys.",
            path=path,
        )
    if isinstance(entry, str) or is_number(entry):
        entry = {"tolerance": entry}
    if isinstance(entry, (tuple, list)):
        entry = {"range": entry}
    if not isinstance(entry, Mapping):
        raise SpecError(f"{name!r} is {entry!r}: give nominal and tolerance, or a range.", path=path)
    for key in entry:
        if key not in _KEYS:
            raise SpecError(f"A constant has no key {key!r}; {there_are(key, _KEYS)}", path=f"{path}.{key}")
    unit = entry.get("unit") or ""
    if not isinstance(unit, str):
        raise SpecError(f"The unit of {name!r} is {unit!r}, no text.", path=f"{path}.unit")
    return _with_range(name, entry, entry.get("nominal") if entry.get("nominal") is not None else nominal, unit)


def _with_range(name: str, entry: Mapping[str, Any], middle: Any, unit: str) -> Constant:
    path, ends = f"constants.{name}", entry.get("range")
    if ends is not None:
        if entry.get("tolerance") is not None:
            raise SpecError(f"{name!r} has both a tolerance and a range: give one of them.", path=path)
        two = not isinstance(ends, str) and hasattr(ends, "__len__") and len(ends) == 2
        if not (two and all(map(is_finite_number, ends)) and ends[0] <= ends[1]):
            raise SpecError(
                f"The range of {name!r} is {ends!r}: give [low, high], finite and the lower one first. A box needs "
                "both ends.",
                path=f"{path}.range",
            )
        low, high = map(float, ends)
        inside = middle is not None and is_finite_number(middle)
        return Constant(name, float(middle) if inside else (middle or low + (high - low) / 2.0), low, high, unit)
    if not is_finite_number(middle):
        raise SpecError(f"{name!r} has no nominal value: give a number, or a range.", path=path)
    center = float(middle)
    share = tolerance_share(entry.get("tolerance", 0.0), f"{path}.tolerance")
    if share and center == 0.0:
        raise SpecError(
            f"The nominal value of {name!r} is zero, which has no per cent: give a range.", path=f"{path}.tolerance"
        )
    half = share * abs(center)
    return Constant(name, center, center - half, center + half, unit)


def constants_box(
    entries: Mapping[str, Any] | ConstantsBox,
    *,
    known: Mapping[str, Constant] | None = None,
    variation: str | None = None,
    source: str | None = None,
    level: float | None = None,
    digest: str | None = None,
    calibrated: Sequence[str] | None = None,
    calibration: str | None = None,
) -> ConstantsBox:
    """Return a box from a mapping by name; nominal values that are left out are those of ``known``."""
    if isinstance(entries, ConstantsBox):
        return entries
    if not isinstance(entries, Mapping):
        raise SpecError(f"constants is {entries!r}: give a mapping from names to tolerances.", path="constants")
    before = known or {}
    constants = dict(before)
    for name, value in entries.items():
        if not isinstance(name, str) or not name:
            raise SpecError(f"{name!r} is no name of a constant.", path="constants")
        constants[name] = constant_of(name, value, nominal=before[name].nominal if name in before else None)
    more = {
        "variation": variation,
        "source": source,
        "level": level,
        "digest": digest,
        "calibrated": calibrated,
        "calibration": calibration,
    }
    return ConstantsBox(constants, **{key: value for key, value in more.items() if value is not None})  # type: ignore[arg-type]

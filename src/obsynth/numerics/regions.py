"""Regions of the complex plane that a linear matrix inequality describes: ``L + z M + conj(z) M' < 0``.

Source: M. Chilali, P. Gahinet, IEEE TAC 41 (3), 1996, section II.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from functools import reduce
from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics.arguments import arguments_checked, is_finite_number, real_number, shown
from obsynth.numerics.arrays import FloatArray, freeze
from obsynth.numerics.suggestions import fields_suggested, there_are


@fields_suggested
@dataclass(frozen=True, eq=False)
class LMIRegion:
    """A region of the complex plane: all z with ``L + z M + conj(z) M' < 0``; open, convex, symmetric to the real axis.
    `disk`, `half_plane` and `sector` make regions, and ``&`` their intersections.

    Parameters
    ----------
    L : FloatArray
        ``(k, k)``, symmetric.
    M : FloatArray
        ``(k, k)``.
    text : str
        The region in words.
    parts : tuple of dict
        The same as plain data: ``{"disk": [center, radius]}``, ``{"half_plane": decay}``, ``{"sector": damping}``.

    Raises
    ------
    TypeError
        ``&`` is used with anything but another region.

    Examples
    --------
    >>> from obsynth.conditions import disk, half_plane
    >>> disk(0.0, 2.0) & half_plane(0.5)
    disk(0, 2) & half_plane(0.5)
    """

    L: FloatArray
    M: FloatArray
    text: str
    parts: tuple[dict[str, Any], ...] = ()

    def __post_init__(self) -> None:
        freeze(self, "L", "M")

    def __repr__(self) -> str:
        return self.text

    def __and__(self, other: LMIRegion) -> LMIRegion:
        """Return the intersection of two regions."""
        if not isinstance(other, LMIRegion):
            return NotImplemented
        one, two = len(self.L), len(other.L)
        zero = np.zeros((one, two))
        return LMIRegion(
            np.block([[self.L, zero], [zero.T, other.L]]),
            np.block([[self.M, zero], [zero.T, other.M]]),
            f"{self.text} & {other.text}",
            (*self.parts, *other.parts),
        )

    def margins(self, values: Any) -> FloatArray:
        """Return, for each of some complex numbers, how far inside the region it is: negative outside."""
        points = np.atleast_1d(np.asarray(values, dtype=np.complex128))
        forms = self.L + points[:, None, None] * self.M + points.conj()[:, None, None] * self.M.T
        return np.asarray(-np.linalg.eigvalsh(forms)[:, -1] if len(points) else np.zeros(0))

    def contains(self, values: Any) -> bool:
        """Whether all of some complex numbers lie in the region."""
        return bool(np.all(self.margins(values) > 0.0))


@arguments_checked
def disk(center: float, radius: float) -> LMIRegion:
    """Return the open disk ``abs(z - center) < radius``.

    Parameters
    ----------
    center : float
        A real number; 1/s in continuous time, dimensionless in discrete time.
    radius : float
        Above zero, in the same unit.

    Returns
    -------
    LMIRegion
        ``[[-r, z - c], [conj(z) - c, -r]] < 0``.

    Raises
    ------
    SpecError
        The center is no real number, or the radius is not positive.

    Examples
    --------
    >>> from obsynth.conditions import disk
    >>> disk(0, 0.3).text
    'disk(0, 0.3)'
    """
    c, r = real_number(center, "center"), real_number(radius, "radius", "a positive number", above=0.0)
    return LMIRegion(
        np.array([[-r, -c], [-c, -r]]),
        np.array([[0.0, 1.0], [0.0, 0.0]]),
        f"disk({c:g}, {r:g})",
        ({"disk": [c, r]},),
    )


@arguments_checked
def half_plane(decay: float) -> LMIRegion:
    """Return the open half-plane ``Re z < -decay``.

    Parameters
    ----------
    decay : float
        1/s; 0 is stability in continuous time.

    Returns
    -------
    LMIRegion
        ``2 decay + z + conj(z) < 0``.

    Raises
    ------
    SpecError
        The decay is no real number.

    Examples
    --------
    >>> from obsynth.conditions import half_plane
    >>> half_plane(2.0).text
    'half_plane(2)'
    """
    a = real_number(decay, "decay")
    return LMIRegion(np.array([[2.0 * a]]), np.array([[1.0]]), f"half_plane({a:g})", ({"half_plane": a},))


@arguments_checked
def sector(damping: float) -> LMIRegion:
    """Return the open sector of the left half-plane with ``-Re z > damping abs(z)``.

    Parameters
    ----------
    damping : float
        Damping ratio, between 0 and 1, dimensionless: the cosine of the angle to the negative real axis.

    Returns
    -------
    LMIRegion
        ``[[s (z + conj(z)), c (z - conj(z))], [c (conj(z) - z), s (z + conj(z))]] < 0`` with c the damping and
        ``s^2 + c^2 = 1``.

    Raises
    ------
    SpecError
        The damping is no number between 0 and 1.

    Examples
    --------
    >>> from obsynth.conditions import half_plane, sector
    >>> (sector(0.7) & half_plane(2.0)).text
    'sector(0.7) & half_plane(2)'
    """
    c = real_number(damping, "damping", "a ratio between 0 and 1", above=0.0, below=1.0)
    s = float(np.sqrt(1.0 - c**2))
    return LMIRegion(np.zeros((2, 2)), np.array([[s, c], [-c, s]]), f"sector({c:g})", ({"sector": c},))


@dataclass(frozen=True)
class NamedRegion:
    """A region by its decay, radius and damping; ``radius`` and ``damping`` in continuous time only."""

    decay: float = 0.0  # every mode decays at least as exp(-decay t), in 1/s
    radius: float | None = None  # abs(s) <= radius, in 1/s
    damping: float | None = None  # least ratio, 0 to 1

    @classmethod
    def of(cls, data: Mapping[str, Any], dt: float, *, path: str = "region") -> NamedRegion:
        """Return a checked region of poles in continuous time (``dt`` 0) or of samples of ``dt`` seconds."""
        known = [field.name for field in fields(cls)]
        problems = [f"unknown key {key!r}; {there_are(key, known)}" for key in data if key not in known]
        for key, value in data.items():
            if key in known and (not is_finite_number(value) or value < 0.0 or (key != "decay" and value == 0.0)):
                problems.append(f"{key} is {value!r}: give a positive number.")
        if not problems:
            region = cls(**data)
            if region.damping is not None and region.damping >= 1.0:
                problems.append(f"damping is {region.damping}: give a ratio below 1.")
            if region.radius is not None and region.radius <= region.decay:
                problems.append(f"the region is empty: radius {region.radius} is not above decay {region.decay}.")
            if dt > 0.0 and (region.radius is not None or region.damping is not None):
                problems.append("radius and damping are for continuous time: give decay alone.")
        if problems or not data:
            raise SpecError(
                "A region of poles by decay, radius and damping:",
                path=path,
                problems=problems or ["give at least one of decay, radius, damping."],
            )
        return cls(**data)

    def in_time(self, unit: float) -> NamedRegion:
        """Return the region with rates per ``unit`` (seconds) instead of per second."""
        return replace(self, decay=unit * self.decay, radius=None if self.radius is None else unit * self.radius)

    def shrunk(self, share: float) -> NamedRegion:
        """Return the region with each of its bounds tighter by a share."""
        return replace(
            self,
            decay=(1.0 + share) * self.decay,
            radius=None if self.radius is None else (1.0 - share) * self.radius,
            damping=None if self.damping is None else min((1.0 + share) * self.damping, 1.0),
        )

    def holds(self, values: Any, dt: float) -> bool:
        """Whether all ``values`` lie in the region."""
        poles = np.asarray(values, dtype=np.complex128)
        if dt > 0.0:
            return bool(np.all(np.abs(poles) < np.exp(-self.decay * dt)))
        inside = np.all(poles.real < -self.decay) if self.decay else np.all(poles.real < 0.0)
        if self.radius is not None:
            inside = inside and np.all(np.abs(poles) <= self.radius)
        if self.damping is not None:
            inside = inside and np.all(-poles.real >= self.damping * np.abs(poles))
        return bool(inside)

    def as_inequality(self, dt: float) -> LMIRegion:
        """Return the region as a linear matrix inequality: the parts that are asked for, or that of stability."""
        if dt > 0.0:
            return disk(0.0, float(np.exp(-self.decay * dt)))
        parts = [half_plane(self.decay)] if self.decay else []
        parts += [] if self.radius is None else [disk(0.0, self.radius)]
        parts += [] if self.damping is None else [sector(self.damping)]
        return reduce(operator.and_, parts) if parts else half_plane(0.0)


def checked_region(region: Any, name: str = "region") -> LMIRegion:
    """Return a region; raise `SpecError` for anything else."""
    if isinstance(region, Mapping):
        region = [region]
    if isinstance(region, (list, tuple)) and region and all(isinstance(part, Mapping) for part in region):
        regions = [_written(part, name) for part in region]
        return reduce(operator.and_, regions)
    if not isinstance(region, LMIRegion):
        raise SpecError(
            f"{name} is {shown(region)}: give conditions.disk(center, radius), conditions.half_plane(decay), "
            "conditions.sector(damping), or several of them joined by &.",
            path=name,
        )
    return region


def _written(part: Mapping[str, Any], name: str) -> LMIRegion:
    """Return a region that a document writes: ``{disk: [center, radius]}`` and its like."""
    makers: dict[str, Callable[..., LMIRegion]] = {"disk": disk, "half_plane": half_plane, "sector": sector}
    if len(part) != 1 or next(iter(part)) not in makers:
        raise SpecError(f"{name} is {shown(dict(part))}: use one of disk, half_plane, sector in each.", path=name)
    ((kind, value),) = part.items()
    numbers = value if isinstance(value, (list, tuple)) else [value]
    if len(numbers) != (2 if kind == "disk" else 1):
        raise SpecError(f"{name}: {kind} takes {'[center, radius]' if kind == 'disk' else 'one number'}.", path=name)
    return makers[kind](*numbers)

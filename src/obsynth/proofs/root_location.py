"""Where the roots of a rational polynomial lie, decided exactly: stability has no tolerance here.

A root on the boundary is also a root of the mirrored polynomial, ``p(-s)`` or ``z^n p(1/z)``; so is every pair of
roots that mirror each other, of which one is unstable.  So the greatest common divisor of both decides whether there is
any such root, and all others are told from the boundary by isolating them in enough digits.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import flint
from flint import fmpq_poly, fmpz_poly

#: Digits (binary) in which roots are isolated first, and how often they are doubled.
FIRST_BITS = 106
MOST_DOUBLINGS = 7


@dataclass(frozen=True)
class Root:
    """One root: its value to double precision, how often, and which side of the stability boundary it is on."""

    value: complex
    multiplicity: int
    side: str


@dataclass(frozen=True)
class RootLocation:
    """The roots of a polynomial, by decreasing instability; `side` is 'stable', 'boundary' or 'unstable'."""

    roots: tuple[Root, ...]

    @property
    def stable(self) -> bool:
        """Whether every root is strictly inside the region of stability."""
        return all(root.side == "stable" for root in self.roots)

    @property
    def outside(self) -> tuple[Root, ...]:
        """Those on or outside its boundary."""
        return tuple(root for root in self.roots if root.side != "stable")


def locate_roots(polynomial: fmpz_poly, *, discrete: bool) -> RootLocation:
    """Return the roots of a nonzero polynomial and where they are: exact, however close to the boundary.

    ``discrete`` takes the open unit disk as the region of stability, and the open left half plane otherwise.
    """
    if polynomial.degree() <= 0:
        return RootLocation(())
    mirror = fmpz_poly(polynomial.coeffs()[::-1]) if discrete else _at_minus(polynomial)
    common = polynomial.gcd(mirror)
    found: list[Root] = []
    # Origin: under the mirror of the unit circle it goes to infinity, and reversing has dropped it.
    for part, may_lie_on_boundary in ((common, True), (_quotient(polynomial, common), False)):
        found += _isolated(part, discrete=discrete, may_lie_on_boundary=may_lie_on_boundary)
    found.sort(key=lambda root: -(abs(root.value) if discrete else root.value.real))
    return RootLocation(tuple(found))


def primitive(polynomial: fmpq_poly) -> fmpz_poly:
    """Return a multiple with coprime integer coefficients and a positive leading one."""
    numerator = polynomial.numer()
    if numerator.is_zero():
        return numerator
    content = numerator.content()
    sign = -1 if int(numerator.leading_coefficient()) < 0 else 1
    return fmpz_poly([sign * coefficient // content for coefficient in numerator.coeffs()])


def _isolated(polynomial: fmpz_poly, *, discrete: bool, may_lie_on_boundary: bool) -> list[Root]:
    """Return the roots with their sides; more digits until each is told from the boundary, or shown to be on it."""
    if polynomial.degree() <= 0:
        return []
    bits = FIRST_BITS
    found: list[tuple[flint.acb, int, str]] = []
    for _ in range(MOST_DOUBLINGS):
        with flint.ctx.workprec(bits):
            pairs: Any = polynomial.complex_roots()
            found = [(root, int(times), _side(root, discrete)) for root, times in pairs]
        if all(side != "boundary" for _, _, side in found):
            break
        # What mirrors itself within so many digits cannot be one of a pair: those are further apart.
        if may_lie_on_boundary and bits > _separation_bits(polynomial):
            break
        bits *= 2
    return [Root(_value(root, side, discrete), times, side) for root, times, side in found]


def _side(root: flint.acb, discrete: bool) -> str:
    distance = root.real * root.real + root.imag * root.imag - 1 if discrete else root.real
    return "unstable" if distance > 0 else "stable" if distance < 0 else "boundary"


def _separation_bits(polynomial: fmpz_poly) -> int:
    """Return digits in which two different roots differ for certain (Mahler 1964), generously."""
    degree = polynomial.degree()
    return int(degree * (degree.bit_length() + 2) + degree * (polynomial.height_bits() + degree.bit_length()))


def _value(root: flint.acb, side: str, discrete: bool) -> complex:
    # Roots are isolated far beyond double precision: a part that may be zero is.
    real, imaginary = (0.0 if part.contains(0) else float(part.mid()) for part in (root.real, root.imag))
    value = complex(real, imaginary)
    if side == "boundary":
        value = value / abs(value) if discrete else complex(0.0, imaginary)
    return value


def _at_minus(polynomial: fmpz_poly) -> fmpz_poly:
    return fmpz_poly([(-1) ** power * coefficient for power, coefficient in enumerate(polynomial.coeffs())])


def _quotient(polynomial: fmpz_poly, divisor: fmpz_poly) -> fmpz_poly:
    return primitive(fmpq_poly(polynomial) / fmpq_poly(divisor)) if divisor.degree() > 0 else polynomial

"""Roots of polynomials with integer coefficients, and on which side of the stability boundary each of them lies.

A root on the boundary is a root of the greatest common divisor of p with its mirror ``p(-s)``, or ``z^n p(1/z)``.  So
is every pair of roots that mirror each other in the boundary, of which one is unstable.  All other roots are isolated
with enough digits to distinguish them from the boundary.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import flint
from flint import fmpq_poly, fmpz_poly

#: Bits in which roots are isolated first.
FIRST_BITS = 106

#: How often the number of bits is doubled at most.
MOST_DIGIT_DOUBLINGS = 7


@dataclass(frozen=True)
class Root:
    """A root: its value in double precision, its multiplicity, and its side of the stability boundary."""

    value: complex
    multiplicity: int
    side: str  # stable, boundary or unstable


def locate_roots(polynomial: fmpz_poly, *, discrete: bool) -> tuple[Root, ...]:
    """Return the roots of a nonzero polynomial, the most unstable first.

    Their sides of the stability boundary are exact, however close to it they lie.
    """
    if polynomial.degree() <= 0:
        return ()
    coefficients = polynomial.coeffs()
    at_minus = [(-1) ** power * coefficient for power, coefficient in enumerate(coefficients)]
    mirror = fmpz_poly(coefficients[::-1] if discrete else at_minus)
    common = polynomial.gcd(mirror)
    roots: list[Root] = []
    # A root at zero is in no such pair: reversing the coefficients has dropped it from the mirror.
    remaining = primitive(fmpq_poly(polynomial) / fmpq_poly(common)) if common.degree() > 0 else polynomial
    for part, may_lie_on_boundary in ((common, True), (remaining, False)):
        roots += _roots_with_sides(part, discrete=discrete, may_lie_on_boundary=may_lie_on_boundary)
    roots.sort(key=lambda root: -(abs(root.value) if discrete else root.value.real))
    return tuple(roots)


def primitive(polynomial: fmpq_poly) -> fmpz_poly:
    """Return the multiple of a polynomial with coprime integer coefficients and a positive leading coefficient."""
    numerator = polynomial.numer()
    if numerator.is_zero():
        return numerator
    content = numerator.content()
    sign = -1 if int(numerator.leading_coefficient()) < 0 else 1
    return fmpz_poly([sign * coefficient // content for coefficient in numerator.coeffs()])


def _roots_with_sides(polynomial: fmpz_poly, *, discrete: bool, may_lie_on_boundary: bool) -> list[Root]:
    """Return the roots with their sides: digits are doubled until each root is proved to be off or on the boundary."""
    if polynomial.degree() <= 0:
        return []
    bits = FIRST_BITS
    enclosures: list[tuple[flint.acb, int, str]] = []
    for _ in range(MOST_DIGIT_DOUBLINGS):
        with flint.ctx.workprec(bits):
            pairs: Any = polynomial.complex_roots()
            enclosures = [(root, int(times), _side(root, discrete)) for root, times in pairs]
        if all(side != "boundary" for _, _, side in enclosures):
            break
        # Roots of a mirrored pair are further apart than these digits, so a root that straddles lies on the boundary.
        if may_lie_on_boundary and bits > _separation_bits(polynomial):
            break
        bits *= 2
    return [Root(_value(root, side, discrete), times, side) for root, times, side in enclosures]


def _side(root: flint.acb, discrete: bool) -> str:
    distance = root.real * root.real + root.imag * root.imag - 1 if discrete else root.real
    return "unstable" if distance > 0 else "stable" if distance < 0 else "boundary"


def _separation_bits(polynomial: fmpz_poly) -> int:
    """Return a generous number of bits in which two different roots differ for certain (Mahler 1964)."""
    degree = polynomial.degree()
    return int(degree * (degree.bit_length() + 2) + degree * (polynomial.height_bits() + degree.bit_length()))


def _value(root: flint.acb, side: str, discrete: bool) -> complex:
    # Roots are isolated far beyond double precision, so that a part whose ball contains zero is zero.
    real, imaginary = (0.0 if part.contains(0) else float(part.mid()) for part in (root.real, root.imag))
    value = complex(real, imaginary)
    if side == "boundary":
        value = value / abs(value) if discrete else complex(0.0, imaginary)
    return value

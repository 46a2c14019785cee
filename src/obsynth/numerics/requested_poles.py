"""Poles that a user requests for a design: read, and checked for number, stability and conjugate pairs."""

from __future__ import annotations

from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics.arrays import ComplexArray
from obsynth.numerics.spectra import decay_rates, pole_text

#: Two poles are a conjugate pair when they agree to this, relative to their size.
PAIR_TOLERANCE = 1e-9

_POLES_OPTION = "method.options.poles"


def checked_poles(
    requested: Any, count: int, fixed: ComplexArray, dt: float, *, of: str = "ui-pi-observer"
) -> list[complex]:
    """Return the requested poles in exact conjugate pairs, real ones first.

    ``count`` poles can be placed, ``fixed`` ones cannot; ``of`` names the method in messages.
    """
    listed = [as_pole(pole) for pole in requested]
    problems = []
    if len(listed) != count:
        fixed_text = ", ".join(pole_text(complex(value), 6) for value in fixed)
        besides = f" (fixed, not to be listed: {fixed_text})" if fixed_text else ""
        number = f"{len(listed)} {'is' if len(listed) == 1 else 'are'} given"
        problems.append(f"{number}, but {count} can be placed{besides}.")
    rates = decay_rates(listed, dt)
    unstable = [pole for pole, rate in zip(listed, rates, strict=True) if not rate > 0.0]
    if unstable:
        where = "inside the unit circle" if dt > 0.0 else "in the left half plane"
        problems.append(
            f"{', '.join(pole_text(pole, 6) for pole in unstable)} would not be stable: give poles {where}."
        )
    upper = [pole for pole in listed if pole.imag > 0.0]
    lower = [pole for pole in listed if pole.imag < 0.0]
    unpaired = []
    for pole in upper:
        partner = next((p for p in lower if abs(p - pole.conjugate()) <= PAIR_TOLERANCE * abs(pole)), None)
        if partner is None:
            unpaired.append(pole)
        else:
            lower.remove(partner)
    unpaired += lower
    if unpaired:
        poles = ", ".join(pole_text(pole, 6) for pole in unpaired)
        problems.append(f"{poles} {'lacks its conjugate' if len(unpaired) == 1 else 'lack their conjugates'}.")
    if problems:
        raise SpecError(f"Option poles of {of}:", path=_POLES_OPTION, problems=problems)
    real = [pole for pole in listed if pole.imag == 0.0]
    return [*real, *(p for pole in upper for p in (pole, pole.conjugate()))]


def as_pole(pole: Any) -> complex:
    """Return a pole that is given as a number, or as a pair of real and imaginary part."""
    parts = pole if isinstance(pole, (list, tuple, np.ndarray)) and len(pole) == 2 else [pole]
    try:
        value = complex(*parts)
    except (TypeError, ValueError):
        raise SpecError(f"{pole!r} is no pole: give a number, or [re, im].", path=_POLES_OPTION) from None
    if any(isinstance(part, (bool, np.bool_, str)) for part in parts) or not np.isfinite(value):
        raise SpecError(f"{pole!r} is no pole: give a finite number, or [re, im].", path=_POLES_OPTION)
    return value

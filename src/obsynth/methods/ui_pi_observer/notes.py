"""What a user of the unknown-input PI observer should know besides the claims."""

from __future__ import annotations

import numpy as np

from obsynth.analysis.conditions import Condition
from obsynth.methods.placement.kalman import NOISE_PRICE
from obsynth.methods.ui_pi_observer.options import UiPiOptions
from obsynth.methods.ui_pi_observer.pencils import numbers
from obsynth.methods.ui_pi_observer.placement_problem import PlacementProblem
from obsynth.numerics.spectra import decay_rates

#: A default this many times slower than the plant itself is worth a note.
SLOW_DEFAULT = 1000.0


def elimination_note(found: tuple[Condition, ...], eliminated: bool) -> tuple[str, ...]:
    """Return a note where the method has eliminated the algebraic states by itself."""
    if not eliminated:
        return ()
    detail = next(condition.detail for condition in found if condition.name.startswith("(D1)"))
    return (f"(D1) holds only without the algebraic states, which were eliminated: {detail}.",)


def fixed_mode_notes(problem: PlacementProblem, asked: UiPiOptions, dt: float) -> tuple[str, ...]:
    """Return a note about poles that no gain moves."""
    found = []
    fixed = problem.fixed_modes
    if fixed.size:
        text = ", ".join(numbers(fixed))
        rates = decay_rates(fixed, dt)
        slow = asked.slowest_asked(dt)
        found.append(
            f"{fixed.size} of {len(problem.F)} poles are fixed, whatever the gains: {text}"
            + (
                f"; the slowest decays at {np.min(rates):.3g} 1/s, slower than asked."
                if slow is not None and np.min(rates) < slow
                else "."
            )
        )
    return tuple(found)


def slow_note(problem: PlacementProblem, asked: UiPiOptions, decay: float | None) -> tuple[str, ...]:
    """Return a note where the default, for lack of noise to pay with, is far slower than the plant."""
    own = problem.rate / problem.units.time
    default = asked.poles is None and asked.decay is None and asked.region is None
    if not default or decay is None or problem.fixed_modes.size or decay * SLOW_DEFAULT >= own:
        return ()
    return (
        f"The slowest pole decays at {decay:.3g} 1/s, against {own:.3g} 1/s of the plant itself: what is faster costs "
        f"more than {NOISE_PRICE:g} times the noise of a Kalman filter, or was not found. Parts of the fault models "
        f"that can hardly be told apart ({', '.join(dict.fromkeys(problem.model.descriptions))}) do that: leave one "
        "out, or give decay or poles.",
    )


def digits_note(digits: float | None) -> tuple[str, ...]:
    """Return a note where fewer digits than a double has, but more than are commonly printed, keep Ahat stable."""
    if digits is None:
        return ()
    return (
        f"Ahat is stable with {digits:.0f} significant digits and more, and unstable with fewer: in the coordinates of "
        "this plant its entries cancel. Copy the gain set or the exported code, not printed numbers.",
    )

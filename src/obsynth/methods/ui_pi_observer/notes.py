"""What a user of the unknown-input PI observer should know besides the claims."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from obsynth.methods.placement.kalman import NOISE_PRICE
from obsynth.methods.ui_pi_observer.conditions import Existence
from obsynth.methods.ui_pi_observer.method import UiPiObserver
from obsynth.methods.ui_pi_observer.pencils import numbers
from obsynth.methods.ui_pi_observer.placement_problem import PlacementProblem
from obsynth.numerics.spectra import decay_rates

#: A default this many times slower than the plant itself is worth a note.
SLOW_DEFAULT = 1000.0


def notes(
    found: Existence, problem: PlacementProblem, asked: UiPiObserver, claims: Mapping[str, float]
) -> Iterator[str]:
    """Yield notes on eliminated states, fixed poles, a slow default and digits, where these matter."""
    if found.transformation is not None:
        detail = next(condition.detail for condition in found.conditions if condition.name.startswith("(D1)"))
        yield f"(D1) holds only without the algebraic states, which were eliminated: {detail}."
    fixed, dt = problem.fixed_modes, found.plant.dt
    if fixed.size:
        slow, least = asked.slowest_asked(dt), np.min(decay_rates(fixed, dt))
        behind = slow is not None and least < slow
        yield (
            f"{fixed.size} of {len(problem.F)} poles are fixed, whatever the gains: {', '.join(numbers(fixed))}"
            + (f"; the slowest decays at {least:.3g} 1/s, slower than asked." if behind else ".")
        )
    own, decay = problem.rate / problem.units.time, claims.get("decay")
    default = asked.poles is None and asked.decay is None and asked.region is None
    if default and decay is not None and not fixed.size and decay * SLOW_DEFAULT < own:
        yield (
            f"The slowest pole decays at {decay:.3g} 1/s, against {own:.3g} 1/s of the plant itself: what is faster "
            f"costs more than {NOISE_PRICE:g} times the noise of a Kalman filter, or was not found. Parts of the fault "
            f"models that can hardly be told apart ({', '.join(dict.fromkeys(problem.model.descriptions))}) do that: "
            "leave one out, or give decay or poles."
        )
    if "digits" in claims:
        # Fewer digits than a double has, but more than are commonly printed, keep Ahat stable.
        yield (
            f"Ahat is stable with {claims['digits']:.0f} significant digits and more, and unstable with fewer: in the "
            "coordinates of this plant its entries cancel. Copy the gain set or the exported code, not printed numbers."
        )

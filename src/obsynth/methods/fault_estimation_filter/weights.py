"""What a free residual weight W is worth: the least gain with the paper's W = Upsilon^+, and with any left inverse."""

from __future__ import annotations

from obsynth.analysis.existence.restricted_equivalent import PreparedPlant
from obsynth.methods.fault_estimation_filter.convex_problem import centred, gain_problem
from obsynth.numerics.central_filter import search_least_gain

#: A least gain below this share of what disturbances can do is zero but for rounding.
AS_NOTHING = 1e-9


def least_gains_by_weight(prepared: PreparedPlant) -> tuple[float, float]:
    """Return the least gain found with the paper's W and with a free one; one number twice where no W is free."""
    free, _ = gain_problem(prepared, free_weight=True)
    fixed, parts = gain_problem(prepared, free_weight=False)
    fixed, _ = centred(fixed, prepared, parts)
    upper = search_least_gain(fixed).gain
    lower = search_least_gain(free).gain if free.measured else upper
    nothing = AS_NOTHING * max(free.disturbance_size, upper)
    return tuple(gain if gain > nothing else 0.0 for gain in (upper, lower))  # type: ignore[return-value]

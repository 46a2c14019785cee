"""Many samples in one call, and single samples where such a call cannot go on."""

from __future__ import annotations

from collections.abc import Callable

#: Samples in one call.  After a sample that had to be taken by itself the shorter stretch is tried first: hard samples
#: come together, and what follows one inside a stretch is lost.
STRETCHES = (16, 256)


def take_samples(
    first: int, samples: int, together: Callable[[int, int], int], alone: Callable[[int], object],
    note: Callable[[int], object] = bool,
) -> None:  # fmt: skip
    """Go through samples in stretches."""
    k, allowed = first, STRETCHES[-1]
    while k < samples:
        length = next((size for size in reversed(STRETCHES) if size <= min(allowed, samples - k)), 0)
        taken = together(k, length) if length else 0
        k, allowed = k + taken, STRETCHES[-1] if length == 0 or taken == length else STRETCHES[0]
        if taken < max(length, 1):
            alone(k)
            k += 1
        note(k)

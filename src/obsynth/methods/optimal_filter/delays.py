"""Delays of the fault estimates: of all faults, or of each of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from obsynth.analysis.existence.condition import OPTIONS_PATH
from obsynth.errors import SpecError
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.signal_names import require_known

#: Where a message points.
PATH = f"{OPTIONS_PATH}.delay"


def is_auto(delay: Any) -> bool:
    """Whether one delay of all faults is to be chosen."""
    return isinstance(delay, str)


def delays_of(delays: Any, plant: DescriptorSystem) -> tuple[int | None, ...]:
    """Return the delay of each fault, ``None`` where it is to be chosen; raise `SpecError` for what fits no fault."""
    if isinstance(delays, Mapping):
        require_known(delays, plant.fault_names, what=PATH, kind="fault")
        missing = [name for name in plant.fault_names if name not in delays]
        if missing:
            raise SpecError(f"delay has no entry for {', '.join(missing)}: give samples or 'auto' for each.", path=PATH)
        delays = [delays[name] for name in plant.fault_names]
    if is_auto(delays) or not isinstance(delays, (Sequence, np.ndarray)):
        delays = [delays] * plant.nf
    if len(delays) != plant.nf:
        raise SpecError(f"delay has {len(delays)} entries; the plant has {plant.nf} faults.", path=PATH)
    return tuple(None if isinstance(one, str) else int(one) for one in delays)


def plain_delays(delays: tuple[int, ...]) -> int | list[int]:
    """Return the delays as an option: one number where all are the same."""
    return delays[0] if len(set(delays)) == 1 else [*delays]


def in_words(delays: tuple[int, ...]) -> str:
    """Return the delays as a text: one number where all are the same."""
    return ", ".join(str(late) for late in (delays if len(set(delays)) > 1 else delays[:1]))

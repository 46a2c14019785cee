"""Checks of every linear observer, whatever its method: its signals fit the plant, and its state decays.

They need only the plant and the stored numbers, so that a method of another package cannot leave them out.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from obsynth.observers.linear.modes import poles_of
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.results.checks import OPEN_LOOP, Check, information, nothing_wrong, upper_bound_check
from obsynth.verification.error_system import contraction_of

SOURCE = "ours, for every linear observer"


def platform_rows(plant: DescriptorSystem, observer: LinearObserver, *, open_loop: bool) -> Iterator[Check]:
    """Yield the checks that no method can leave out; an ``open_loop`` model makes no claim of decay."""
    wrong = _unfitting(plant, observer)
    yield nothing_wrong("signals", "signals and sample time fit the plant", wrong, source=SOURCE)
    if wrong:
        return
    decays = not observer.order or contraction_of(observer) is not None
    if open_loop:
        yield information(
            OPEN_LOOP,
            "by its method this is a model without feedback: nothing is claimed of its stability",
            float(decays),
            source=SOURCE,
            status="assumed",
            detail="" if decays else f"no decay is proved: {_outermost(observer)}",
        )
        return
    yield upper_bound_check(
        "decay of the state",
        "the observer's state decays from every start: a contraction is proved",
        float(not decays),
        0.0,
        source=SOURCE,
        kind="proved",
        detail="" if decays else _outermost(observer),
    )


def _unfitting(plant: DescriptorSystem, observer: LinearObserver) -> list[str]:
    """Return the names and times of an observer that do not fit the plant."""
    pairs = (
        ("names of inputs", observer.input_names == plant.input_names),
        ("names of outputs", observer.output_names == plant.output_names),
        ("sample time", observer.dt == plant.dt),
    )
    wrong = [name for name, fits in pairs if not fits]
    wrong += [f"fault {name}" for name in observer.fault_names if name not in plant.fault_names]
    return wrong + [f"state {name}" for name in observer.state_names if name not in plant.state_names]


def _outermost(observer: LinearObserver) -> str:
    """Return the slowest or most unstable eigenvalue, in words."""
    poles = poles_of(observer)
    pole = complex(poles[int(np.argmax(np.abs(poles) if observer.dt > 0.0 else poles.real))])
    return f"an eigenvalue of {pole.real:.6g}" + (f"{pole.imag:+.6g}j" if pole.imag else "")

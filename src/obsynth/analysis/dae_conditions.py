"""Existence conditions of the observer of a DAE."""

from __future__ import annotations

from collections.abc import Iterator

from obsynth.analysis.conditions import Condition
from obsynth.analysis.dae_index import index_report
from obsynth.models.dae import DAEModel

_SOURCE = "Moussa Ali, Zhang 2013 (DAE)"


def dae_conditions(model: object, dt: float) -> Iterator[Condition]:
    """Yield the existence conditions; the list ends at the first failure.

    Parameters
    ----------
    model : object
        Any plant; other kinds than `DAEModel` fail.
    dt : float
        Seconds between samples.
    """
    if not isinstance(model, DAEModel):
        yield Condition("plant of this kind", "a DAEModel: F(x', x, u, theta) = 0, y = h(x, theta)", False, 0.0, 1.0,
                        f"{_SOURCE}, (3)", f"the plant is a {type(model).__name__}")  # fmt: skip
        return
    found = index_report(model, dt)
    growth = ", then ".join(f"{value:.3g}" for value in found.conditions)
    detail = f"the condition of dF/dx' / dt + dF/dx is {growth} when dt falls to a tenth"
    if found.index == 0:
        detail += (f": it is singular for every dt; the equations {', '.join(map(repr, found.equations))} are not "
                   "independent")  # fmt: skip
    elif found.index > 1:
        detail += (
            f": index {found.index}, because of the equations {', '.join(map(repr, found.equations))}; differentiate "
            "the constraint until it determines the algebraic states"
        )
    yield Condition("index", "the plant has index 1", found.index == 1, float(found.index), 1.0, f"{_SOURCE}, (7)",
                    detail, signals=found.states)  # fmt: skip
    if found.index == 1:
        yield Condition("parameters", "the plant has parameters to estimate", model.nq > 0, float(model.nq), 1.0,
                        f"{_SOURCE}, (3)", f"{model.nq} parameter(s)")  # fmt: skip

"""Functionals of the state, ``w = K x``, as algebraic states of their own."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics.arguments import arguments_checked, is_finite_number, shown
from obsynth.numerics.sparse import is_sparse
from obsynth.numerics.suggestions import there_are
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.transformations.recovery import Transformation


@arguments_checked
def with_functionals(
    plant: DescriptorSystem | Transformation,
    functionals: Mapping[str, Mapping[str, float]],
    *,
    units: Mapping[str, str] | None = None,
) -> DescriptorSystem:
    """Return a plant with functionals of its state as further states: ``0 = K x - w``.

    They are simulated, named, drawn and estimated like any other state: by methods that estimate the whole state, and
    alone, by an observer of low order, with ``states`` of `functional_filter`.

    Parameters
    ----------
    plant : DescriptorSystem or Transformation
        Either time, any index.
    functionals : mapping of str to mapping of str to float
        By name, how much of each state is in it: ``{"twist": {"theta m": 1, "theta l": -1}}``.
    units : mapping of str to str, optional
        Units of the functionals.

    Returns
    -------
    DescriptorSystem
        With ``nx`` larger by the number of functionals, which come last; every index of 1 or more stays as it is.

    Raises
    ------
    SpecError
        A functional has no states, an unknown one, a weight that is no number, or the name of another state.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(A=[[-1.0, 1.0], [0.0, -2.0]], C=[[1, 0]])
    >>> more = obsynth.with_functionals(plant, {"sum": {"x1": 1.0, "x2": 1.0}})
    >>> obsynth.functional_filter(more, states=["sum"], decay=1.0).observer.state_names
    ('sum',)
    """
    if isinstance(plant, Transformation):
        plant = plant.plant
    if not functionals:
        return plant
    rows = np.zeros((len(functionals), plant.nx))
    for row, (name, weights) in enumerate(functionals.items()):
        path = f"functionals.{name}"
        if name in plant.state_names:
            raise SpecError(f"{name!r} is a state already: give the functional another name.", path=path)
        if not isinstance(weights, Mapping) or not weights:
            raise SpecError(
                f"{name!r} needs the weight of each state in it, such as {{{plant.state_names[0]}: 1}}.", path=path
            )
        for state, weight in weights.items():
            if state not in plant.state_names:
                there = there_are(state, plant.state_names)
                raise SpecError(f"{name!r} is made of {state!r}, which is no state; {there}", path=path)
            if not is_finite_number(weight):
                raise SpecError(f"The weight of {state!r} is {shown(weight)}: give a number.", path=path)
            rows[row, plant.state_names.index(state)] = float(weight)
        if not rows[row].any():
            raise SpecError(f"{name!r} is zero: give a weight that is not.", path=path)
    count = len(functionals)
    e, a = _block(plant.E, None, np.zeros((count, count))), _block(plant.A, rows, -np.eye(count))
    more = {name: np.vstack([getattr(plant, name), np.zeros((count, getattr(plant, name).shape[1]))])
            for name in ("B", "Bf", "Bd", "Bw")}  # fmt: skip
    c = _block(plant.C, None, np.zeros((0, count)))
    point = plant.operating_point
    known = {
        name: sum(float(weight) * point[state] for state, weight in weights.items())
        for name, weights in functionals.items()
        if all(state in point for state in weights)
    }
    return plant.replace(
        E=e,
        A=a,
        C=c,
        **more,
        state_names=[*plant.state_names, *functionals],
        units={**plant.units, **(units or {})},
        operating_point={**point, **known},
    )


def _block(first: Any, below: Any, corner: np.ndarray[Any, Any]) -> Any:
    """Return ``[first 0; below corner]``, of arrays or sparse matrices."""
    below = np.zeros((len(corner), first.shape[1])) if below is None else below
    beside = np.zeros((first.shape[0], corner.shape[1]))
    if not is_sparse(first):
        return np.block([[first, beside], [below, corner]])
    from scipy.sparse import bmat

    return bmat([[first, beside], [below, corner]], format="csr")

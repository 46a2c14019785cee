"""Observers of nonlinear plants over a region as a problem of cvxpy: at corners of slopes, or by a multiplier."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from obsynth.analysis.existence.condition import require_all
from obsynth.analysis.existence.nonlinear_region import MOST_CORNER_SLOPES, region_conditions
from obsynth.conditions.polytope import vertex_inequalities
from obsynth.conditions.problem import Conditions
from obsynth.conditions.slope_multipliers import SlopedErrors, slope_inequality
from obsynth.errors import SpecError
from obsynth.numerics.arguments import arguments_checked, chosen, real_number
from obsynth.plants.dae import DAEModel
from obsynth.plants.operating_region import OperatingRegion
from obsynth.plants.transformations.nonlinear_terms import nonlinear_terms
from obsynth.verification.error_polytope import ErrorPolytope
from obsynth.verification.nonlinear_drive import drive_of, wanted_of
from obsynth.verification.nonlinear_region import corners_of, directions


@arguments_checked
def nonlinear_region(
    model: DAEModel,
    region: Mapping[str, Any],
    *,
    sample_time: float | None = None,
    noise: Mapping[str, float] | None = None,
    goal: str = "gain",
    multiplier: str = "vertices",
    faults: Sequence[str] | None = None,
    wanted: Mapping[str, float] | None = None,
    decay: float | None = None,
) -> Conditions:
    """Return the inequalities of an observer of a nonlinear plant over a region, in the plant's own units.

    Parameters
    ----------
    model : DAEModel
        Its equations as texts.
    region : mapping
        Ranges of signals and linear combinations, as for `obsynth.region_observer`; so are the others.
    sample_time : float, seconds
        Of the outputs' noise.
    noise : mapping
        Deviations of outputs, and how faults drift.  A goal of decay needs neither.
    goal : {"gain", "power", "decay"}, optional
        What is made small.
    multiplier : {"vertices", "full", "diagonal"}, optional
        All corners of up to 12 slopes, or one inequality.
    faults, wanted, decay : optional
        As for `obsynth.region_observer`.

    Returns
    -------
    Conditions
        Variables ``P1, P2, P3`` (or P), Y, and ``gamma_squared``, ``mean_square`` or ``room``; gains ``L[1]``.

    Raises
    ------
    SpecError, PreconditionError
        As for `obsynth.region_observer`.

    Examples
    --------
    >>> import obsynth
    >>> tank = obsynth.DAEModel(
    ...     {"balance": "2.0 * der(level) = inflow - 0.5 * sqrt(level) - leak"}, {"gauge": "level"},
    ...     states={"level": 1.0}, inputs={"inflow": 0.5}, parameters={"leak": 0.0},
    ... )
    >>> found = nonlinear_region(
    ...     tank, {"level": [0.2, 2.0]}, sample_time=1.0, noise={"gauge": 0.1, "leak": 0.1}, goal="gain"
    ... )
    >>> _ = found.solve()
    >>> found.problem.status
    'optimal'
    """
    chosen(multiplier, "multiplier", ("vertices", "full", "diagonal"))
    # A decay alone needs no noise, and no samples of it.
    undriven = goal == "decay" and noise is None
    step = 1.0 if undriven else real_number(sample_time, "sample_time", "the seconds between samples", above=0.0)
    chosen_faults = tuple(model.parameter_names if faults is None else faults)
    conditions = region_conditions(model, region, chosen_faults, step)
    require_all(conditions)
    terms = nonlinear_terms(model, faults=chosen_faults)
    place = OperatingRegion.of(terms, region)
    slopes = place.slopes()
    bounds = np.array([[each.low, each.high] for each in slopes]).reshape(len(slopes), 2)
    W, Wy, V = directions(terms, slopes)
    nd, n = terms.differential, len(terms.names)
    B, D = (np.zeros((n, 0)), np.zeros((len(terms.output_names), 0))) if undriven else drive_of(terms, noise, step)
    shared: dict[str, Any] = {
        "B": B,
        "D": D,
        "Cz": wanted_of(terms, place, wanted),
        "dt": 0.0,
        "differential": nd if nd < n else None,
    }
    if multiplier == "vertices":
        if len(slopes) > MOST_CORNER_SLOPES:
            raise SpecError(
                f"{len(slopes)} slopes have 2 ** {len(slopes)} corners: take multiplier='diagonal'.", path="multiplier"
            )
        corners = corners_of(bounds)
        errors = ErrorPolytope(
            [terms.A + W @ np.diag(d) @ V for d in corners], [terms.C + Wy @ np.diag(d) @ V for d in corners], **shared
        )
        return vertex_inequalities(errors, goal=goal, gain="constant", decay=decay)
    middle, half = bounds.mean(axis=1), 0.5 * (bounds[:, 1] - bounds[:, 0])
    nominal = ErrorPolytope([terms.A + W @ np.diag(middle) @ V], [terms.C + Wy @ np.diag(middle) @ V], **shared)
    return slope_inequality(
        SlopedErrors(nominal, W * half, Wy * half, V), goal=goal, multiplier=multiplier, decay=decay
    )

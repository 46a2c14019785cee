"""The fault-estimation filter of least gain over all causal filters: the public function and its result."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from obsynth.errors import PreconditionError, SpecError
from obsynth.methods.optimal_filter.reduction import Inputs, StateSpace, reduce
from obsynth.numerics.arrays import as_matrix
from obsynth.numerics.optimal_estimation import NoStableFilterError, optimal_estimator
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.transformations.delays import without_delays
from obsynth.plants.transformations.recovery import Transformation

#: ``delay="auto"`` takes the first delay whose gain is within this share of that of the longest one looked at.
WORTH_WAITING = 0.05

#: Delays looked at beyond the least one.
DELAYS_LOOKED_AT = 6

#: Gains below this, relative to the largest of the table, are zero but for rounding.
ZERO_GAIN = 1e-9


@dataclass(frozen=True)
class DelayChoice:
    """A row of the table of gains against delay: ``delay`` in samples, the least gain, and the filter's own."""

    delay: int
    least: float
    gain: float


@dataclass(frozen=True, eq=False)
class OptimalFilter:
    """A fault-estimation filter and what no other can undercut; made by `optimal_filter`.

    Parameters
    ----------
    observer : LinearObserver
        The filter: run it on a record or sample by sample.
    gain : float
        Norm from noise (without an exact fault map: from faults and noise) to the error, recomputed in floating point.
    least : float
        No causal filter with the same fault map has a smaller norm: a lower bound, computed in floating point from a
        past that the outputs do not show, or from one frequency.
    non_causal_limit : float
        Least norm over all delays; NaN for H2.
    delay : int
        Samples by which the estimates lag; 0 for a reference model.
    norm : str
        ``"hinf"`` or ``"h2"``.
    exact : bool
        Whether the fault map is exact.
    extra_noise : float
        Deviation of the noise that was added to every output because the problem is singular; 0 for none.
    trade_off : tuple of DelayChoice
        Gain against delay, as far as ``delay="auto"`` looked; one row for a delay that was given.
    """

    observer: LinearObserver
    gain: float
    least: float
    non_causal_limit: float
    delay: int
    norm: str
    exact: bool
    extra_noise: float
    trade_off: tuple[DelayChoice, ...]

    def __str__(self) -> str:
        what = "this exact fault map" if self.exact else "this reference model"
        waits = f" and delay {self.delay}" if self.delay else ""
        kind = "gain" if self.norm == "hinf" else "H2 norm"
        text = (
            f"Least {kind} over all causal filters with {what}{waits}: at least {self.least:.8g} (recomputed in "
            f"floating point); this filter: {self.gain:.8g}."
        )
        for row in self.trade_off:
            text += f" With delay {row.delay}: {row.gain:.5g}." if row.delay != self.delay else ""
        if np.isfinite(self.non_causal_limit):
            text += f" No delay brings it below {self.non_causal_limit:.5g}." if self.exact else ""
        if self.extra_noise:
            text += (
                f" The problem is singular: the filter is designed with noise of deviation {self.extra_noise:.2g} on "
                "every measurement besides; state a noise of the outputs to close the gap between the two bounds."
            )
        return text


def optimal_filter(
    plant: DescriptorSystem,
    *,
    delay: int | Literal["auto"] = "auto",
    reference: Any = None,
    norm: Literal["hinf", "h2"] = "hinf",
    exact: bool = True,
    decoupled: Sequence[str] = (),
) -> OptimalFilter:
    r"""Return the fault-estimation filter of least gain over all causal filters.

    .. math::
        \hat f = Q [y; u], \qquad e_k = \hat f_k - f_{k - L} \quad \text{or} \quad e = \hat f - M_r f

    Known inputs and ``decoupled`` disturbances never reach e; noise and the other disturbances are bounded in energy
    (``norm="hinf"``) or white with unit intensity (``"h2"``).  With ``exact``, faults do not reach e either.

    Parameters
    ----------
    plant : DescriptorSystem
        Discrete or continuous time; sE - A regular.
    delay : int or "auto"
        Samples L by which the estimates lag.  ``"auto"``: the first delay whose gain is within 5 % of that of later
        ones.  Discrete time without ``reference``.
    reference : tuple of matrices or dict, optional
        ``(A, B, C, D)`` of a stable reference model Mr from the faults, or ``{"bandwidth": w}``: first-order lags of w
        rad/s.  Continuous time needs one.
    norm : {"hinf", "h2"}
        What is least: the H-infinity or the H2 norm (discrete time).
    exact : bool
        Whether the fault map must be exact; otherwise the norm is from faults and noise together.
    decoupled : sequence of str
        Disturbances that must not reach the estimates at all.

    Returns
    -------
    OptimalFilter
        The filter, its gain, and a lower bound for every other.

    Raises
    ------
    SpecError
        An option is malformed: a negative delay, an unstable reference, an unknown disturbance.
    PreconditionError
        No causal stable filter has this fault map, or the plant has no faults.

    Notes
    -----
    Not yet a method of `design`: specs, `verify` and gain sets do not know it.  Numbers are recomputed in floating
    point, not proved.  Source: Hassibi, Sayed, Kailath, Indefinite-Quadratic Estimation and Control, SIAM 1999, chapter
    4; the reduction is ours.  Its matrices E, A, B and so on are used in the plant's own units.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.5]], C=[[1], [1]], Bf=[[0]], Df=[[1], [1]], Bw=[[0, 0]], Dw=[[1, 0], [0, 1]], dt=1.0
    ... )
    >>> print(f"{obsynth.optimal_filter(plant, delay=0).gain:.6f}")
    0.707107
    """
    made = without_delays(plant)
    plant = made.plant if isinstance(made, Transformation) else made
    model = _checked(plant, delay, reference, norm, exact, decoupled)
    inputs = _inputs(plant, decoupled)
    if model is not None or delay != "auto":
        wait = 0 if isinstance(delay, str) else delay
        found = _designed(plant, inputs, wait, model, norm, exact)
        return _result(found, (DelayChoice(found.delay, found.least, found.gain),))
    tried = _tried(plant, inputs, norm)
    table = tuple(DelayChoice(one.delay, one.least, one.gain) for one in tried)
    largest, last = max(row.gain for row in table), table[-1].gain
    enough = max(last * (1.0 + WORTH_WAITING), ZERO_GAIN * largest)
    chosen = next(one for one in tried if one.gain <= enough)
    return _result(chosen, table)


def _checked(
    plant: DescriptorSystem, delay: Any, reference: Any, norm: Any, exact: Any, decoupled: Sequence[str]
) -> StateSpace | None:
    """Return the reference model as matrices; raise `SpecError` for malformed options."""
    if not isinstance(plant, DescriptorSystem):
        raise SpecError("optimal_filter takes a DescriptorSystem.", path="plant")
    if not plant.nf:
        raise PreconditionError("The plant has no faults: there is nothing to estimate.", condition="faults")
    if norm not in ("hinf", "h2"):
        raise SpecError(f'norm is {norm!r}: give "hinf" or "h2".', path="norm")
    if not isinstance(exact, bool):
        raise SpecError(f"exact is {exact!r}: give True or False.", path="exact")
    whole = isinstance(delay, int) and not isinstance(delay, bool) and delay >= 0
    if delay != "auto" and not whole:
        raise SpecError(f'delay is {delay!r}: give a whole number of samples, 0 or more, or "auto".', path="delay")
    if isinstance(decoupled, str) or not all(name in plant.disturbance_names for name in decoupled):
        known = ", ".join(plant.disturbance_names) or "none"
        raise SpecError(f"decoupled is {decoupled!r}: give names of disturbances ({known}).", path="decoupled")
    if reference is None:
        if plant.dt == 0.0:
            raise SpecError(
                "In continuous time a delay is no finite filter: give reference=, such as {'bandwidth': 10}.",
                path="reference",
            )
        if not exact:
            raise SpecError("exact=False matches a reference model: give reference=.", path="reference")
        return None
    if delay not in ("auto", 0):
        raise SpecError("Give a delay or a reference model, not both.", path="delay")
    if norm == "h2" and plant.dt == 0.0:
        raise SpecError('norm="h2" is for discrete time: sample the plant first (obsynth.discretise).', path="norm")
    return _reference_model(reference, plant)


def _reference_model(reference: Any, plant: DescriptorSystem) -> StateSpace:
    if isinstance(reference, dict):
        rate = reference.get("bandwidth")
        if set(reference) != {"bandwidth"} or not isinstance(rate, (int, float)) or not 0.0 < rate < np.inf:
            raise SpecError(
                f"reference is {reference!r}: give {{'bandwidth': rad/s}} or matrices (A, B, C, D).", path="reference"
            )
        one = np.eye(plant.nf)
        if plant.dt == 0.0:
            return -rate * one, rate * one, one, 0.0 * one
        pole = float(np.exp(-rate * plant.dt))
        return pole * one, (1.0 - pole) * one, pole * one, (1.0 - pole) * one
    if not isinstance(reference, (tuple, list)) or len(reference) != 4:
        raise SpecError("reference is no tuple of four matrices (A, B, C, D).", path="reference")
    d = as_matrix(reference[3], "D of reference")
    order = int(np.shape(reference[0])[0]) if np.size(reference[0]) else 0
    shapes = ((order, order), (order, plant.nf), (len(d), order), (len(d), plant.nf))
    parts = [
        np.zeros(shape) if 0 in shape else as_matrix(part, f"{letter} of reference")
        for part, letter, shape in zip(reference, "ABCD", shapes, strict=True)
    ]
    if any(part.shape != shape for part, shape in zip(parts, shapes, strict=True)):
        given = ", ".join(str(part.shape) for part in parts)
        raise SpecError(
            f"Shapes of reference are {given}: D has a column for each of {plant.nf} faults, and A, B, C fit it.",
            path="reference",
        )
    a, b, c, d = parts
    poles = np.linalg.eigvals(a) if order else np.zeros(0)
    if order and (np.max(poles.real) >= 0.0 if plant.dt == 0.0 else np.max(np.abs(poles)) >= 1.0):
        raise SpecError("The reference model is not stable: no stable filter has its fault map.", path="reference")
    return a, b, c, d


def _inputs(plant: DescriptorSystem, decoupled: Sequence[str]) -> Inputs:
    hidden = [i for i, name in enumerate(plant.disturbance_names) if name in decoupled]
    bounded = [i for i in range(plant.nd) if i not in hidden]
    return Inputs(
        plant.E,
        plant.A,
        plant.C,
        (plant.B, plant.Bf, plant.Bd[:, hidden], np.hstack([plant.Bd[:, bounded], plant.Bw])),
        (plant.D, plant.Df, plant.Dd[:, hidden], np.hstack([plant.Dd[:, bounded], plant.Dw])),
        plant.dt,
    )


def _tried(plant: DescriptorSystem, inputs: Inputs, norm: Literal["hinf", "h2"]) -> list[OptimalFilter]:
    """Return the filters of the least delay and of those after it."""
    found: list[OptimalFilter] = []
    for delay in range(plant.nx + 1 + DELAYS_LOOKED_AT):
        try:
            found.append(_designed(plant, inputs, delay, None, norm, True))
        except PreconditionError as refused:
            if refused.condition != "exact fault map" or delay == plant.nx:
                raise
        if len(found) == DELAYS_LOOKED_AT or (found and found[-1].gain <= ZERO_GAIN * found[0].gain):
            break
    return found


def _designed(
    plant: DescriptorSystem,
    inputs: Inputs,
    delay: int,
    model: StateSpace | None,
    norm: Literal["hinf", "h2"],
    exact: bool,
) -> OptimalFilter:
    problem = reduce(inputs, delay, model, exact=exact)
    try:
        found = optimal_estimator(problem.problem, norm)
    except NoStableFilterError as refused:
        raise PreconditionError(
            f"No stable filter with this fault map was found: {refused}.", condition="stable filter"
        ) from None
    a, b, c, d = problem.filter_of(found.K, found.Z0)
    rows = len(c)
    named = rows == plant.nf
    ny = plant.ny
    observer = LinearObserver(
        Az=a,
        Bu=b[:, ny:],
        By=b[:, :ny],
        Cz=c,
        Du=d[:, ny:],
        Dy=d[:, :ny],
        dt=plant.dt,
        input_names=plant.input_names,
        output_names=plant.output_names,
        state_names=(),
        fault_names=plant.fault_names if named else (),
        residual_names=() if named else tuple(f"Mr f {i + 1}" for i in range(rows)),
        state_delays=(),
        fault_delays=(delay,) * rows if named else (),
    )
    return OptimalFilter(observer, found.gain, found.least, found.non_causal, delay, norm, exact, found.extra_noise, ())


def _result(found: OptimalFilter, table: tuple[DelayChoice, ...]) -> OptimalFilter:
    return replace(found, trade_off=table)

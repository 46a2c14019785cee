"""Fault maps that the options leave free, and the filter of least gain for each of them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import reduce
from typing import Any, NamedTuple, Protocol

import numpy as np

from obsynth.analysis.existence.condition import Condition
from obsynth.errors import PreconditionError
from obsynth.methods.optimal_filter.delays import delays_of
from obsynth.methods.optimal_filter.lasting_modes import (
    ADDED_DRIVES,
    with_growing_modes_reached,
    with_lasting_modes_driven,
)
from obsynth.methods.optimal_filter.reference import lag_model, reference_model
from obsynth.methods.optimal_filter.weights import Weights, in_series, inverse, weights_of
from obsynth.numerics.arrays import ComplexArray, FloatArray, remembered
from obsynth.numerics.decoupling_windows import (
    Channels,
    EstimationProblem,
    Model,
    estimation_problem,
    with_late_inputs,
)
from obsynth.numerics.gramians import gramian
from obsynth.numerics.least_estimation import (
    ADDED_NOISES,
    LeastEstimation,
    least_estimation,
    realised,
    require_stable_filter,
)
from obsynth.numerics.least_mean_square import least_mean_square
from obsynth.numerics.matrix_equations import continuous_lyapunov
from obsynth.numerics.norms import hinf_norm
from obsynth.numerics.standard_form import cayley, cayley_point, finite_poles, uncayley
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.pencil import regularity_of, structure_of, without_hidden
from obsynth.plants.plant_units import PlantUnits
from obsynth.verification.fault_map_zeros import require_vanishing
from obsynth.verification.seen_outputs import Setting, seen_plant
from obsynth.verification.weighted_plant import weighted_plant

#: A gain below this share of what the faults do to the error without a filter is zero but for rounding.
ZERO_GAIN = 1e-9
#: A filter whose deviation is by no more than this share below that of the estimate zero reads rounding.
NO_LESS = 1e-12
#: The search of a least gain ends within this share of it.
SEARCHED_SHARE = 1e-7

_SOURCE = "Varga 2017, section 5.2, and ours"


class Options(Protocol):
    """The options that say which fault maps are open."""

    @property
    def delay(self) -> Any:
        """Samples, ``"auto"``, or one of these for each fault."""

    @property
    def reference(self) -> Any:
        """A reference model, or ``None``."""

    @property
    def norm(self) -> str:
        """``hinf`` or ``h2``."""

    @property
    def exact(self) -> bool:
        """Whether faults pass exactly by the fault map."""

    @property
    def weights(self) -> Any:
        """Weights of errors and inputs, or ``None``."""

    def decoupled_names(self, plant: DescriptorSystem) -> tuple[str, ...]:
        """Return the disturbances that never reach the error."""


class FaultMap(NamedTuple):
    """What the estimate is of the faults: a delay of each, or a reference model; exact or not; what is weighted.

    ``undriven``: number of last columns of the plant's noise whose intensity is zero: they keep the states that they
    reach in the problem.
    """

    delays: tuple[int, ...] | None
    reference: Model | None
    exact: bool
    weights: Weights | None = None
    undriven: int = 0

    @property
    def delay(self) -> int | None:
        """The longest delay; ``None`` of a reference model."""
        return None if self.delays is None else max(self.delays)

    @property
    def setting(self) -> Setting:
        """What bounds on every filter are for."""
        weights = self.weights or Weights(None, None, None)
        models = (weights.faults, self.reference, weights.errors)
        return Setting(self.delays or (), tuple(model for model in models if model is not None), self.exact)

    def driven(self, plant: DescriptorSystem) -> DescriptorSystem:
        """Return the plant behind the weights of its noise and its faults."""
        if self.weights is None:
            return plant
        return weighted_plant(plant, noise=self.weights.noise, faults=self.weights.faults)

    def at_points(self, plant: DescriptorSystem, states: FloatArray) -> list[tuple[complex, ComplexArray]]:
        """Return what faults shall be in the estimates, at more points than the difference to a filter has states.

        ``states``: the filter's A.
        """
        reference, order = self.reference, len(states)
        late = np.array(self.delays or (0,) * plant.nf)
        own = 0 if reference is None else len(reference[0])
        count = 2 * (order + own + (self.delay or 0)) + 3
        if plant.is_discrete:
            points = np.exp(1j * (np.arange(count) + 0.5) * np.pi / count)
        else:
            size = max(float(np.max(np.abs(np.linalg.eigvals(states)), initial=0.0)), 1.0) if order else 1.0
            points = 1j * size * np.tan((np.arange(count) + 0.5) * np.pi / (2 * count))
        return [
            (point, np.diag(point**-late) if reference is None else response_at(reference, point)) for point in points
        ]

    def behind_delay(self, samples: int) -> FaultMap:
        """Return the map of estimates that come so many samples later."""
        if not samples:
            return self
        late = self.delays and tuple(delay + samples for delay in self.delays)
        reference = self.reference and with_late_inputs(self.reference, samples)
        return self._replace(delays=late, reference=reference)

    def later(self, samples: int = 1, *, which: tuple[bool, ...] | None = None) -> FaultMap:
        """Return the map with more samples of delay, of all faults or of some."""
        delays = self.delays or ()
        more = which or (True,) * len(delays)
        return self._replace(delays=tuple(late + samples * add for late, add in zip(delays, more, strict=True)))


class Units(NamedTuple):
    """Powers of two in which a plant is near one, and its errors and noise, on which the gain rests, are scaled."""

    equations: FloatArray
    outputs: FloatArray
    error: float
    noise: float


class Designed(NamedTuple):
    """The filter of least gain for a fault map, from y, in the units of the plant; ``nothing``: a gain that is zero."""

    fault_map: FaultMap
    problem: EstimationProblem
    filter: Model
    gain: float
    limit: float
    limit_angle: float
    added_noise: float
    decays: tuple[ComplexArray, ...]
    nothing: float
    least: float | None = None  # where the filter is another one than that of least norm

    @property
    def least_gain(self) -> float:
        """The least norm of all filters with this fault map."""
        return self.gain if self.least is None else self.least

    @property
    def is_nothing(self) -> bool:
        """Whether the gain is zero but for rounding."""
        return self.gain <= self.nothing


def response_at(system: Model, point: complex) -> Any:
    """Return the transfer of a system at a point."""
    a, b, c, d = system
    return c @ np.linalg.solve(point * np.eye(len(a)) - a, b) + d if len(a) else d


def conditions(plant: DescriptorSystem, options: Options) -> tuple[Condition, ...]:
    """Return whether the pencil is regular, whether there are faults, and whether a stable filter has a fault map."""
    plant = seen_plant(plant.dense(), options.decoupled_names(plant))
    regular, rank = regularity_of(plant)
    claim = "the equations determine the states: det(z E - A) is not zero everywhere"
    first = Condition("regularity", claim, regular, rank, plant.nx, _SOURCE)
    if not regular:
        return (first,)
    if not plant.nf:
        return first, Condition(
            "faults",
            "the plant has a fault to be estimated",
            False,
            0.0,
            1.0,
            _SOURCE,
            detail="it has none: state where faults enter (Bf, Df)",
            of_the_method=True,
        )
    claim = "a stable causal filter has this fault map, whatever known and decoupled inputs do"
    try:
        first_problem_or_driven(plant, options)
    except PreconditionError as error:
        return first, Condition("fault map", claim, False, 0.0, 1.0, _SOURCE, detail=str(error), unclear=error.unclear)
    second = Condition("fault map", claim, True, 1.0, 1.0, _SOURCE, detail="decided in floating point")
    if options.norm != "h2" or plant.is_discrete:
        return first, second
    return first, second, _finite_mean_square(plant, options)


def _finite_mean_square(plant: DescriptorSystem, options: Options) -> Condition:
    """Return whether the least mean square is finite and the Riccati equation of its filter has a solution."""
    claim, holds, detail, of_ours = "some filter has a finite mean square, by a Riccati equation", True, "", False
    try:
        try:
            least_mean_square(first_problem(plant, options)[1])
        except PreconditionError:
            if with_lasting_modes_driven(plant) is plant:
                raise
            fault_map, _ = first_problem_or_driven(plant, options)
            least_deviation_of_every_start(plant, fault_map, options.weights)
    except (PreconditionError, np.linalg.LinAlgError) as error:
        holds, detail = False, str(error)
        of_ours = not (isinstance(error, PreconditionError) and error.condition == "finite mean square")
    return Condition(
        "finite mean square", claim, holds, float(holds), 1.0, _SOURCE, detail=detail, of_the_method=of_ours
    )


def first_problem_or_driven(plant: DescriptorSystem, options: Options) -> tuple[FaultMap, EstimationProblem]:
    """Return `first_problem` of the plant, or where it has none of the one whose lasting modes are driven."""
    try:
        return first_problem(plant, options)
    except PreconditionError:
        driven = with_lasting_modes_driven(plant)
        if driven is plant:
            raise
        return first_problem(driven, options)


def first_problem(plant: DescriptorSystem, options: Options) -> tuple[FaultMap, EstimationProblem]:
    """Return the first fault map that exists, of those that the options leave open, with its problem."""
    last = PreconditionError("No fault map is left open by the options.", condition="fault map")
    tries_delays = options.reference is None and plant.is_discrete and None in delays_of(options.delay, plant)
    for fault_map in _open_maps(plant, options):
        try:
            problem = problem_of(plant, fault_map, brief=tries_delays)
            # A zero far out changes so little of a problem's numbers that the equations take it for rounding.
            if fault_map.exact:
                require_vanishing(plant, reference=fault_map.reference, delays=fault_map.delays)
            require_stable_filter(problem)
            if options.reference is None and options.norm == "h2" and not plant.is_discrete:
                least_mean_square(problem)
        except PreconditionError as error:
            last = error
            # A lag of higher order passes less.
            if error.condition == "finite mean square":
                continue
            # None depends on the delay, nor the last on how many lags there are.
            if error.condition == "fault map" or (error.condition in ("decoupling", "zeros") and plant.is_discrete):
                break
        else:
            return fault_map, problem
    raise last


def _open_maps(plant: DescriptorSystem, options: Options) -> Iterator[FaultMap]:
    for fault_map in _unweighted_maps(plant, options):
        rows = plant.nf if fault_map.reference is None else len(fault_map.reference[2])
        yield fault_map._replace(weights=weights_of(options.weights, plant, rows=rows, exact=fault_map.exact))


def _unweighted_maps(plant: DescriptorSystem, options: Options) -> Iterator[FaultMap]:
    if options.reference is not None:
        yield FaultMap(None, reference_model(options.reference, plant), options.exact)
    elif plant.is_discrete:
        delays = delays_of(options.delay, plant)
        tried = range(plant.nx + 2 if None in delays else 1)
        yield from (FaultMap(tuple(late if one is None else one for one in delays), None, True) for late in tried)
    else:
        poles = _finite_poles(plant, plant.E, plant.A)
        shown = without_hidden(plant, poles)
        width = cayley_point(shown if shown.size else poles)
        yield from (FaultMap(None, lag_model(width, order, plant.nf, 0.0), True) for order in range(1, plant.nx + 2))


@remembered
def _units_of(plant: DescriptorSystem) -> tuple[PlantUnits, Units]:
    own = PlantUnits.of(plant).rounded()
    noise = np.vstack([own.equations[:, None] * plant.Bw, own.outputs[:, None] * plant.Dw])
    faults = own.faults[own.faults > 0.0]
    return own, Units(
        own.equations,
        own.outputs,
        _power(float(np.exp(np.mean(np.log(faults)))) if faults.size else 1.0),
        1.0 / _power(float(np.max(np.abs(noise), initial=0.0)) or 1.0),
    )


def _power(value: float) -> float:
    return float(2.0 ** np.round(np.log2(value))) if value > 0.0 and np.isfinite(value) else 1.0


def problem_of(plant: DescriptorSystem, fault_map: FaultMap, *, brief: bool = False) -> EstimationProblem:
    """Return the problem of estimation of a fault map, in units in which the plant is near one; with ``brief`` a delay
    that is clearly too short is refused without saying which would do."""
    plant = fault_map.driven(plant)
    own, units = _units_of(plant)
    channels, each = channels_of(plant, fault_map)
    models = fault_map.setting.models
    poles = None if plant.is_discrete else _finite_poles(plant, channels.E, channels.A)
    if not models:
        problem = estimation_problem(channels, delay=fault_map.delays, exact=fault_map.exact, poles=poles, brief=brief)
        weights = (own.faults / units.error)[:, None]
        problem = replace(problem, L=weights * problem.L, D1=weights * problem.D1, F=weights * problem.F)
    else:
        a, b, c, d = reduce(in_series, models)
        scaled = (a, b * each, c / units.error, d * each / units.error)
        problem = estimation_problem(
            channels, delay=fault_map.delays, reference=scaled, exact=fault_map.exact, poles=poles, brief=brief
        )
    driving = np.arange(problem.B.shape[1]) < problem.B.shape[1] - fault_map.undriven
    return replace(problem, B=problem.B * driving, D=problem.D * driving, D1=problem.D1 * driving)


def _finite_poles(plant: DescriptorSystem, e: FloatArray, a: FloatArray) -> ComplexArray:
    """Return the finite poles of a plant's pencil, given in some units, as many as its structure has."""
    return finite_poles(e, a, len(structure_of(plant).finite_eigenvalues))


def channels_of(plant: DescriptorSystem, fault_map: FaultMap) -> tuple[Channels, FloatArray]:
    """Return a plant in units in which it is near one, and the unit of each fault."""
    own, units = _units_of(plant)
    equations, outputs, states = own.equations[:, None], own.outputs[:, None], own.states
    each = own.faults if fault_map.exact else np.full(plant.nf, units.error)
    noise = units.noise if fault_map.exact else units.error
    channels = Channels(
        equations * plant.E * states,
        equations * plant.A * states,
        outputs * plant.C * states,
        equations * plant.B,
        outputs * plant.D,
        equations * plant.Bf * each,
        outputs * plant.Df * each,
        equations * plant.Bd * own.disturbances,
        outputs * plant.Dd * own.disturbances,
        equations * plant.Bw * noise,
        outputs * plant.Dw * noise,
        plant.dt,
    )
    return channels, each


def unit_of_errors(plant: DescriptorSystem) -> float:
    """Return the unit of the errors, of what is estimated, beside the channels of a plant."""
    return _units_of(plant)[1].error


def unit_of_gains(plant: DescriptorSystem, fault_map: FaultMap) -> float:
    """Return what a gain of the problem of estimation is in the units of the plant."""
    _, units = _units_of(fault_map.driven(plant))
    return units.error / (units.noise if fault_map.exact else units.error)


def filter_in_plant_units(plant: DescriptorSystem, fault_map: FaultMap, filter_: Model) -> Model:
    """Return a filter of the problem of estimation as one from y to the faults, both in the units of the plant."""
    own, units = _units_of(fault_map.driven(plant))
    a, b, c, d = filter_
    weighted = a, b * own.outputs, units.error * c, units.error * d * own.outputs
    errors = None if fault_map.weights is None else fault_map.weights.errors
    return weighted if errors is None else in_series(weighted, inverse(errors))


def designed(
    plant: DescriptorSystem, fault_map: FaultMap, norm: str, noises: Sequence[float] = ADDED_NOISES
) -> Designed:
    """Return the filter of least norm, for the first of the added ``noises`` that gives one.

    Raise `PreconditionError` where there is none.
    """
    problem, ratio = problem_of(plant, fault_map), unit_of_gains(plant, fault_map)
    size = float(np.linalg.norm(problem.D1) + np.linalg.norm(problem.L) * np.linalg.norm(problem.B))
    if not fault_map.exact:
        # What the reference model does to its faults, beside states that these drive in other units.
        size = min(size, _reference_gain(plant, fault_map, problem.alpha) / ratio)
    try:
        if norm == "h2" and not plant.is_discrete:
            continuous = least_mean_square(problem, noises=noises)
            filter_, gain = continuous.filter, continuous.deviation
            nothing = filter_[0]
            least = LeastEstimation(nothing, nothing, gain, 0.0, 0.0, continuous.added_noise, ())
            least_gain = continuous.least * ratio if continuous.added_noise else None
            if not fault_map.exact and gain * ratio >= _deviation_without_filter(fault_map) * (1.0 - NO_LESS):
                filter_ = _no_filter(len(filter_[3]), plant.ny)
        else:
            least, least_gain = least_estimation(problem, norm=norm, noises=noises), None
            filter_, gain = realised(problem, least.K, least.Z0, plant.ny), least.gain
            filter_ = filter_ if plant.is_discrete else uncayley(*filter_, problem.alpha)
    except np.linalg.LinAlgError as error:
        raise PreconditionError(
            f"The equations of the least gain have no solution: {error}.", condition="zeros"
        ) from error
    return Designed(
        fault_map,
        problem,
        filter_in_plant_units(plant, fault_map, filter_),
        gain * ratio,
        least.limit * ratio,
        least.limit_angle,
        least.added_noise,
        least.decays,
        ZERO_GAIN * (1.0 + size) * ratio,
        least_gain,
    )


def _reference_gain(plant: DescriptorSystem, fault_map: FaultMap, alpha: float) -> float:
    """Return the gain from the faults to the error without any filter."""
    model = reduce(in_series, fault_map.setting.models)
    return float(hinf_norm(*(model if plant.is_discrete else cayley(*model, alpha))).upper)


def _deviation_without_filter(fault_map: FaultMap) -> float:
    """Return the root mean square of what the reference model makes of white faults; infinite where these pass."""
    a, b, c, d = reduce(in_series, fault_map.setting.models)
    if d.any():
        return math.inf
    return float(np.sqrt(max(np.trace(c @ continuous_lyapunov(a, -b @ b.T) @ c.T), 0.0))) if len(a) else 0.0


def without_filter(plant: DescriptorSystem, chosen: Designed, norm: str) -> Designed | None:
    """Return the estimate zero, where no filter of model matching has a norm below its own; else ``None``."""
    fault_map = chosen.fault_map
    if fault_map.exact or (norm == "h2" and not plant.is_discrete):
        return None
    model = reduce(in_series, fault_map.setting.models)
    if norm == "h2":
        a, b, c, d = model
        own = float(np.sqrt(np.sum(d**2) + np.trace(c @ gramian(a, b @ b.T) @ c.T)))
    else:
        own = _reference_gain(plant, fault_map, chosen.problem.alpha)
    if chosen.least_gain < own * (1.0 - SEARCHED_SHARE):
        return None
    return chosen._replace(filter=_no_filter(len(model[3]), plant.ny), gain=own, added_noise=0.0)


def _no_filter(rows: int, outputs: int) -> Model:
    """Return the filter whose estimate is zero."""
    return np.zeros((0, 0)), np.zeros((0, outputs)), np.zeros((rows, 0)), np.zeros((rows, outputs))


def on_plant(plant: DescriptorSystem, fault_map: FaultMap, weights: Any) -> FaultMap:
    """Return a fault map, with the weights of an option, for the noise of a plant and with all of it."""
    rows = plant.nf if fault_map.reference is None else len(fault_map.reference[2])
    own = weights_of(weights, plant, rows=rows, exact=fault_map.exact)
    return fault_map._replace(weights=own, undriven=0)


def least_deviation_of_every_start(plant: DescriptorSystem, fault_map: FaultMap, weights: Any) -> float:
    """Return the least mean square, its root, of filters whose errors decay whatever the start of undriven modes.

    Those on the boundary of stability cost nothing in the limit of slow decay.
    """
    reached, undriven = with_growing_modes_reached(plant)
    own = on_plant(reached, fault_map, weights)._replace(undriven=undriven)
    return designed(reached, own, "h2").least_gain


def least_gain_of_every_start(plant: DescriptorSystem, fault_map: FaultMap, weights: Any) -> float:
    """Return the least gain of filters whose errors decay whatever the start of undriven modes.

    Those on the boundary of stability have the least noise that is tried, in place of the limit of ever less.
    """
    reached, undriven = with_growing_modes_reached(plant, ADDED_DRIVES[-1])
    own = on_plant(reached, fault_map, weights)._replace(undriven=undriven)
    return designed(reached, own, "hinf").least_gain

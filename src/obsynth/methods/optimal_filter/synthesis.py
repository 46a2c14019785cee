"""Synthesis of the optimal filter: the delay, the filter of least gain, and its certificate."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from obsynth.errors import InfeasibleError, PreconditionError, SolverError, counted
from obsynth.methods.method import Synthesis
from obsynth.methods.optimal_filter.certificate import certified
from obsynth.methods.optimal_filter.delays import delays_of, in_words, is_auto, plain_delays
from obsynth.methods.optimal_filter.error_channel import ErrorChannel
from obsynth.methods.optimal_filter.fault_maps import (
    Designed,
    FaultMap,
    designed,
    filter_in_plant_units,
    first_problem,
    least_deviation_of_every_start,
    least_gain_of_every_start,
    on_plant,
    unit_of_gains,
    without_filter,
)
from obsynth.methods.optimal_filter.lasting_modes import (
    ADDED_DRIVES,
    with_growing_modes_reached,
    with_lasting_modes_driven,
)
from obsynth.methods.optimal_filter.late_outputs import with_late_outputs
from obsynth.methods.optimal_filter.method import OptimalFilterMethod
from obsynth.methods.optimal_filter.realisation import (
    without_undriven,
)
from obsynth.methods.optimal_filter.realised_filter import RealisedFilter, behind_delay, error_model_of
from obsynth.methods.optimal_filter.reduced_order import filters_of_order, free_filters
from obsynth.methods.optimal_filter.reference import plain
from obsynth.methods.optimal_filter.shipped_numbers import EXACT_SHARE, realisation_of
from obsynth.methods.optimal_filter.weights import plain_weights
from obsynth.methods.refusals import require_all_conditions
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.decoupling_windows import with_late_inputs
from obsynth.numerics.least_estimation import ADDED_NOISES, achieved, realised, whitened
from obsynth.numerics.norms import hinf_norm
from obsynth.numerics.outward import lower_text, upper_text
from obsynth.numerics.ranks import decide_rank
from obsynth.numerics.standard_form import cayley, uncayley
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.plant_units import PlantUnits
from obsynth.plants.signal_names import unused_names
from obsynth.results.design import Certificate
from obsynth.verification.inequalities import stability_factor
from obsynth.verification.seen_outputs import seen_plant
from obsynth.verification.signals_from_rest import has_index_one

#: A delay is taken if its least gain is at most this factor times the smallest one of the tried delays.
DELAY_ROOM = 1.05
#: Number of delays that are tried after the shortest possible one, and their largest number if each of them lowers the
#: gain by more than `DELAY_ROOM`.
MORE_DELAYS, MOST_MORE_DELAYS = 4, 8
#: Relative difference up to which the gain counts as equal to the least gain.
CLOSED_GAP = 3e-5
#: Sensor noises, relative to the sizes of the outputs, that are tried to close the gap between both; and the largest
#: number of states for which this does not take too long.
OFFERED_NOISES, MOST_STATES_OF_OFFERS = (1e-4, 1e-3, 1e-2), 16
LASTING_NOTE = (
    "A mode of the plant does not decay, and no noise drives it: a filter of least gain may ignore it, and its "
    "errors do not decay then. This one was found with a little noise on that mode; its claims are for the plant "
    "without it."
)
EVERY_START_NOTE = (
    " The least gain of filters whose errors decay after any start is about {} (computed, not proved); the bound is "
    "also of filters that ignore that mode."
)
MODES_NOTE = (
    "Modes of the plant that decay are in the errors of this filter, not in its state: after a start that is not at "
    "rest the errors die out as they do. Gains and deviations count from rest."
)
LATE_NOTE = (
    "Outputs of this plant show inputs of later samples (its index is 2 or more): this filter reads each output "
    "{} late. The least gain is that of all causal filters, also of those that read each output at once: a gap between "
    "both is from that."
)
AT_ONCE_NOTE = (
    "Outputs of this plant show inputs of later samples (its index is 2 or more), and this filter reads each output at "
    "once: its errors are a state only {} later, of which the proofs are."
)
#: The errors of lasting modes decay as fast as the deviation stays below this factor times the least one.
FORGETTING_ROOM = 1.01
#: Significant digits of a bound in a text.
FEWEST_DIGITS, MOST_DIGITS = 4, 8


def synthesise(plant: DescriptorSystem, options: OptimalFilterMethod, *, progress: Callable[[str], None]) -> Synthesis:
    """Design the filter; see `obsynth.optimal_filter` for the options, results and errors."""
    options.require_stated(plant)
    progress("checking the existence conditions")
    require_all_conditions(options.existence(plant))
    plant = seen_plant(plant, options.decoupled_names(plant))
    progress("searching the least gain")
    try:
        curve, chosen = _chosen(plant, options)
        progress("building the realisation and its certificate")
        return _made(plant, options, curve, chosen)
    except (PreconditionError, SolverError):
        lasts = with_lasting_modes_driven(plant) is not plant
        try:
            made = _with_late_outputs(plant, options)
        except SolverError:
            # The errors contain an undriven growing mode, whether or not outputs are delayed.
            if not lasts:
                raise
            made = None
        if made is not None:
            return made
        if not lasts:
            raise
    progress("searching the least gain with noise on modes that last")
    return _with_every_start(plant, options) if options.norm == "h2" else _with_lasting_modes(plant, options)


def _with_late_outputs(plant: DescriptorSystem, options: OptimalFilterMethod) -> Synthesis | None:
    """Return the filter of least gain for delayed outputs; ``None`` for other plants, or if there is no such filter.

    Outputs of a plant of index 2 or more depend on inputs of later samples, so that the errors of a stored realisation
    have no state equation.  They have one if each output is delayed until these inputs have acted.
    """
    if not plant.is_discrete or has_index_one(plant):
        return None
    try:
        late = first_problem(plant, options)[1].shift
        if not late:
            return None
        delayed = with_late_outputs(plant, late)
        _, chosen = _chosen(delayed, options)
        least = designed(plant, chosen.fault_map, options.norm)
    except PreconditionError:
        return None
    chosen = chosen._replace(
        filter=with_late_inputs(chosen.filter, late),
        problem=replace(chosen.problem, shift=chosen.problem.shift + late),
        decays=least.decays,
        least=min(least.least_gain, chosen.gain) if options.norm == "h2" else None,
    )
    made = _made(plant, options, [], chosen)
    return replace(made, notes=(*made.notes, LATE_NOTE.format(counted(late, "sample"))))


def _with_every_start(plant: DescriptorSystem, options: OptimalFilterMethod) -> Synthesis:
    """Return the filter of least mean square whose errors decay from any initial state of modes that no noise drives.

    Modes that neither decay nor grow get the largest of some noises with which the deviation is little above the least
    one.  This noise determines how fast the errors of these modes decay.
    """
    lasts = with_growing_modes_reached(plant, ADDED_DRIVES[0])[0].nw > with_growing_modes_reached(plant)[0].nw
    for drive in ADDED_DRIVES if lasts else (None,):
        driven, undriven = with_growing_modes_reached(plant, drive)
        curve, chosen = _chosen(driven, options, undriven=undriven)
        own_map = on_plant(plant, chosen.fault_map, options.weights)
        least = least_deviation_of_every_start(plant, own_map, options.weights)
        made = _made(plant, options, curve, chosen, searched=driven, least=least if lasts else None)
        if made.certificate.claims["deviation"] <= FORGETTING_ROOM * least:
            break
    notes = [*made.notes[:-1]]
    from_rest = designed(plant, own_map, "h2").least_gain
    if from_rest < least * (1.0 - CLOSED_GAP):
        notes[0] = notes[0].replace("linear filters", "linear filters whose errors decay after any start,", 1)
        notes.append(
            "A mode of the plant grows, and no noise drives it. From rest alone the least deviation is "
            f"{from_rest:.6g}, of a filter whose errors grow after any other start."
        )
    if lasts:
        notes.append(
            "A mode of the plant does not decay, and no noise drives it: the slower filters forget an error of it, the "
            "nearer they come to the least deviation, as near as one likes. This one is for noise on that mode of "
            f"{drive:g} of the plant's own."
        )
    return replace(made, notes=tuple(notes))


def _with_lasting_modes(plant: DescriptorSystem, options: OptimalFilterMethod) -> Synthesis:
    """Return the filter for the largest noise on lasting modes below which less noise does not lower the gain."""
    candidates: list[tuple[Synthesis, FaultMap]] = []
    least_gain = math.inf
    for drive in ADDED_DRIVES:
        driven = with_lasting_modes_driven(plant, drive)
        try:
            curve, chosen = _chosen(driven, options)
            made = _made(plant, options, curve, chosen, searched=driven)
        except (PreconditionError, SolverError):
            # With less noise the proof may fail by rounding; the filter for more noise is already proved.
            if not candidates:
                raise
            break
        gain, least = made.certificate.claims["gain"], made.certificate.claims.get("least", 0.0)
        if candidates and gain >= least_gain * (1.0 - CLOSED_GAP):
            break
        candidates.append((made, chosen.fault_map))
        least_gain = gain
        if chosen.is_nothing or gain - least <= CLOSED_GAP * gain:
            return made
    return _with_least_of_every_start(plant, options, *candidates[-1])


def _with_least_of_every_start(
    plant: DescriptorSystem, options: OptimalFilterMethod, made: Synthesis, fault_map: FaultMap
) -> Synthesis:
    """Return a design whose note states the least gain of filters whose errors decay, if it could be computed."""
    try:
        least = least_gain_of_every_start(plant, fault_map, options.weights)
    except (PreconditionError, SolverError):
        return made
    return replace(made, notes=(*made.notes[:-1], made.notes[-1] + EVERY_START_NOTE.format(f"{least:.6g}")))


def synthesis_of_gains(
    plant: DescriptorSystem, options: OptimalFilterMethod, fault_map: FaultMap, gains: Mapping[str, FloatArray]
) -> Synthesis:
    """Return the filter with gains ``K`` and ``Z0`` of the innovation, with the bounds on the gains of all filters."""
    plant = seen_plant(plant, options.decoupled_names(plant))
    least = designed(plant, fault_map, options.norm)
    white = whitened(least.problem)
    own = realised(least.problem, *white.restored(least.problem, gains["K"], gains["Z0"]), plant.ny)
    own = own if plant.is_discrete else uncayley(*own, least.problem.alpha)
    gain = unit_of_gains(plant, fault_map) * achieved(white, gains["K"], gains["Z0"], options.norm)
    chosen = least._replace(filter=filter_in_plant_units(plant, fault_map, own), gain=gain, least=least.least_gain)
    return _made(plant, options, [], chosen)


def _made(
    plant: DescriptorSystem,
    method: OptimalFilterMethod,
    curve: list[_Row],
    chosen: Designed,
    *,
    searched: DescriptorSystem | None = None,
    least: float | None = None,
) -> Synthesis:
    """Return the realisation and the certificate of a filter.

    ``plant`` has the disturbances that are not decoupled.  ``searched`` is the plant with added noise for which the
    filter was designed, if there is one; ``least`` is the least deviation.
    """
    fault_map = chosen.fault_map
    own = plant if searched is None else searched
    chosen, follower, observer = _with_enough_noise(own, chosen, method.norm)
    full, follower = observer.order, follower._replace(undriven=0)
    if method.order_limit is not None and full > method.order_limit:
        chosen, follower, observer = _of_low_order(own, chosen, method.order_limit, full, method.norm)
    if searched is not None:
        own_map = on_plant(plant, fault_map, method.weights)
        chosen = chosen._replace(fault_map=own_map)
        chosen = chosen._replace(gain=_recomputed_gain(plant, chosen, follower, observer, method.norm))
    chosen = chosen if least is None else chosen._replace(least=min(least, chosen.gain))
    matrices, claims = certified(plant, chosen, observer, follower, method.norm)
    whole = behind_delay(observer, follower.later)
    matrices |= {"T": follower.T, "T0": follower.T0, "stability": stability_factor(whole)}
    matrices |= {"later": np.array([[float(follower.later)]])} if follower.later else {}
    observer, modes = without_undriven(observer, follower)
    matrices, claims = matrices | modes, claims | {"order": float(observer.order)}
    reference = fault_map.reference
    if reference is not None:
        matrices |= {f"reference_{name}": part for name, part in zip("ABCD", reference, strict=True)}
    options: dict[str, Any] = {
        "delay": "auto" if fault_map.delays is None else plain_delays(fault_map.delays),
        "reference": None if reference is None else plain(reference),
        "norm": method.norm,
        "exact": fault_map.exact,
        "decoupled": [*plant.disturbance_names],
        "weights": plain_weights(method.weights, plant),
        "order_limit": method.order_limit,
    }
    if fault_map.exact:
        options["steady_error_limit"] = method.steady_error_limit
    solver = {
        "engine": "filtering Riccati equation",
        "added_noise": chosen.added_noise,
        "trade_off": [[row.filter.fault_map.delay, row.gain, row.deviation] for row in curve],
    }
    gains = {"T": follower.T, "T0": follower.T0}
    dependent = [plant.output_names[int(place)] for place in matrices.get("dependent", np.zeros(0)).ravel()]
    notes = tuple(_notes(plant, curve, chosen, method, claims, dependent))
    notes += (
        ()
        if chosen.least is None or method.order_limit is None
        else (_reduced_note(chosen, observer.order, full, claims),)
    )
    notes += (MODES_NOTE,) if modes else ()
    notes += (AT_ONCE_NOTE.format(counted(follower.later, "sample")),) if follower.later else ()
    notes += () if searched is None else (LASTING_NOTE,)
    return Synthesis(options, gains, observer, Certificate(matrices, claims), solver=solver, notes=notes)


def _recomputed_gain(
    plant: DescriptorSystem, chosen: Designed, follower: RealisedFilter, observer: LinearObserver, norm: str
) -> float:
    """Return the norm of a filter on a plant, which may differ from the one that the filter was designed for."""
    channel = ErrorChannel.of(error_model_of(plant, observer, follower), chosen.fault_map)
    if norm == "h2":
        return channel.deviation(plant.dt)
    a, b, c, d = channel.middle
    if not plant.is_discrete:
        a, b, c, d = cayley(a, b, c, d, chosen.problem.alpha)
    return float(hinf_norm(a, b, c, d).upper)


_Realised: TypeAlias = tuple[Designed, RealisedFilter, LinearObserver]


def _of_low_order(plant: DescriptorSystem, chosen: Designed, limit: int, full: int, norm: str) -> _Realised:
    """Return the filter of at most ``limit`` states with the least gain among those whose realisation keeps the fault
    map.

    The candidates are ordered by their norms at some frequencies; the peak of a gain may be between these.
    """
    filters = free_filters(plant, chosen, limit, norm)
    best = _best_of(plant, filters, limit, norm)
    try:
        bound = filters_of_order(plant, chosen, limit, full, norm)
    except (InfeasibleError, SolverError):
        if best is None:
            raise
        bound = []
    best = _best_of(plant, bound, limit, norm, best)
    if best is not None:
        return best
    raise SolverError(
        f"The filters of at most {limit} states that were found keep the fault map by rounding only: the result is "
        f"inconclusive. Give a larger order_limit: the filter of least gain has {full} states."
    )


def _best_of(
    plant: DescriptorSystem, filters: Sequence[Designed], limit: int, norm: str, best: _Realised | None = None
) -> _Realised | None:
    """Return the filter of least gain among some and a known one (``best``) that can be realised."""
    for filter_ in filters:
        realised = _of_at_most(plant, filter_, limit, norm)
        gain = math.inf if realised is None else _recomputed_gain(plant, filter_, *realised, norm)
        if realised is not None and gain < (math.inf if best is None else best[0].gain):
            best = filter_._replace(gain=gain), *realised
    return best


def _of_at_most(
    plant: DescriptorSystem, chosen: Designed, limit: int, norm: str
) -> tuple[RealisedFilter, LinearObserver] | None:
    """Return a filter's realisation; ``None`` if it has more than ``limit`` states or does not keep the fault map."""
    try:
        follower, observer, missed = realisation_of(plant, chosen, norm)
    except SolverError:
        return None
    fits = observer.order - follower.undriven <= limit and missed <= EXACT_SHARE
    return (follower, observer) if fits else None


def _reduced_note(chosen: Designed, order: int, full: int, claims: Mapping[str, float]) -> str:
    own = claims.get("gain", claims.get("deviation", 0.0))
    return (
        f"The filter of least gain has {full} states, and {chosen.least:.6g}; this one has {order} and {own:.6g}, a "
        "local minimum for its order. The least is that of filters of any order."
    )


def _with_enough_noise(
    plant: DescriptorSystem, chosen: Designed, norm: str
) -> tuple[Designed, RealisedFilter, LinearObserver]:
    """Return a filter and its realisation, for the least added noise with which the realisation is accurate enough.

    The poles of a filter tend to infinity as noise vanishes, and large poles cost significant digits.
    """
    may_have_more = chosen.least is None or (norm == "h2" and not plant.is_discrete)
    more = [noise for noise in ADDED_NOISES if noise > chosen.added_noise and may_have_more]
    best: tuple[float, tuple[Designed, RealisedFilter, LinearObserver]] | None = None
    while True:
        try:
            follower, observer, missed = realisation_of(plant, chosen, norm)
            # Columns of zero intensity, which reach undriven modes, would count in the mean square of this plant.
            if norm == "h2" and not plant.is_discrete and not chosen.fault_map.undriven:
                missed = max(missed, _lost_share(plant, chosen, follower, observer))
            if best is None or missed < best[0]:
                best = missed, (chosen, follower, observer)
        except SolverError:
            if not more and best is None:
                # If the outputs do not depend on the faults, the gains of a filter are rounding errors.
                zero = without_filter(plant, chosen, norm)
                if zero is None:
                    raise
                return (zero, *realisation_of(plant, zero, norm)[:2])
        if best is not None and (best[0] <= EXACT_SHARE or not more):
            return best[1]
        try:
            chosen = designed(plant, chosen.fault_map, norm, more)
        except PreconditionError as error:
            # A filter exists, since its equations have a solution for less noise.  Verification checks its accuracy.
            if best is not None:
                return best[1]
            raise SolverError(
                "The filter of least gain keeps its fault map by rounding only, and with noise added to every output "
                "its equations were not solved: the result is inconclusive. Give every sensor noise (sensor_noise), or "
                "a longer delay."
            ) from error
        more = [noise for noise in more[1:] if noise > chosen.added_noise]


def _lost_share(plant: DescriptorSystem, chosen: Designed, follower: RealisedFilter, observer: LinearObserver) -> float:
    """Return the relative difference between the root mean square of the stored realisation and that of the design."""
    own = _recomputed_gain(plant, chosen, follower, observer, "h2")
    if chosen.is_nothing:
        return 0.0 if np.isfinite(own) else math.inf
    return abs(own - chosen.gain) / chosen.gain if np.isfinite(own) else math.inf


class _Row(NamedTuple):
    """A delay that was tried: its filter for the chosen norm, and the least value of both norms."""

    filter: Designed
    gain: float
    deviation: float

    @property
    def chosen_norm(self) -> float:
        return 0.0 if self.filter.is_nothing else self.filter.gain


def _chosen(plant: DescriptorSystem, options: OptimalFilterMethod, *, undriven: int = 0) -> tuple[list[_Row], Designed]:
    """Return the delays that were tried, and the filter with the chosen one; a reference model has no delay.

    ``undriven`` is the number of last columns of noise whose intensity is zero: they only reach undriven modes.
    """
    fault_map, _ = first_problem(plant, options)
    fault_map = fault_map._replace(undriven=undriven)
    first = designed(plant, fault_map, options.norm)
    if fault_map.delays is None:
        return [], first
    curve = [_row(plant, first, options.norm)]
    is_open = tuple(late is None for late in delays_of(options.delay, plant))
    # Beside a delay that the user chose, the gain with one more sample is reported.
    more, most = (MORE_DELAYS, MOST_MORE_DELAYS) if any(is_open) else (1, 1)
    which = is_open if any(is_open) else None
    for samples in range(1, 1 + most):
        falling = len(curve) < 2 or DELAY_ROOM * curve[-1].chosen_norm < curve[-2].chosen_norm
        if curve[-1].filter.is_nothing or (len(curve) > more and not falling):
            break
        try:
            curve.append(
                _row(plant, designed(plant, fault_map.later(samples, which=which), options.norm), options.norm)
            )
        except PreconditionError:
            break
    if not any(is_open):
        return curve, first
    enough = max(DELAY_ROOM * min(row.chosen_norm for row in curve), first.nothing)
    chosen = next(row.filter for row in curve if row.filter.gain <= enough)
    if is_auto(options.delay):
        return curve, chosen
    return curve, _shortened(plant, chosen, is_open, enough, options.norm)


def _shortened(
    plant: DescriptorSystem, chosen: Designed, is_open: tuple[bool, ...], enough: float, norm: str
) -> Designed:
    """Return the filter with each delay that the user left open shortened in turn, as long as the gain is at most
    ``enough``."""
    for i, may_be_shorter in enumerate(is_open):
        delays = chosen.fault_map.delays or ()
        for late in range(delays[i] if may_be_shorter else 0):
            shorter = chosen.fault_map._replace(delays=(*delays[:i], late, *delays[i + 1 :]))
            try:
                tried = designed(plant, shorter, norm)
            except PreconditionError:
                continue
            if tried.gain <= enough:
                chosen = tried
                break
    return chosen


def _row(plant: DescriptorSystem, filter_: Designed, norm: str) -> _Row:
    """Return the row of a filter, with the least value of the other norm."""
    if filter_.is_nothing:
        return _Row(filter_, 0.0, 0.0)
    other = designed(plant, filter_.fault_map, "h2" if norm == "hinf" else "hinf")
    least = 0.0 if other.is_nothing else other.least_gain
    return _Row(filter_, filter_.gain, least) if norm == "hinf" else _Row(filter_, least, filter_.gain)


def _notes(
    plant: DescriptorSystem,
    curve: list[_Row],
    chosen: Designed,
    options: OptimalFilterMethod,
    claims: Mapping[str, float],
    dependent: Sequence[str],
) -> list[str]:
    notes = [_statement(curve, chosen, options, claims, dependent)]
    if len(curve) > 1:
        listed = "; ".join(f"delay {_late(row)}: {row.gain:.6g}, {row.deviation:.6g}" for row in curve)
        notes.append(f"Least gain, and least deviation for white noise of unit intensity, by delay: {listed}.")
    if chosen.added_noise:
        quiet = not decide_rank(plant.Dw, expected=plant.ny).full
        why = (
            "An output, or a combination of outputs, has no noise"
            if quiet
            else "With less noise than is added here the equations were not solved, or lost digits"
        )
        gap = "" if options.norm == "h2" and not quiet else f" {_gap(plant, chosen, options, claims)}"
        notes.append(
            f"{why}: the filter is the one for {chosen.added_noise:g} of the plant's own sizes more on every "
            f"output.{gap}"
        )
    if chosen.is_nothing and options.norm == "hinf":
        notes.append(
            "The least gain is zero: with exact numbers nothing reaches the error; what is claimed is rounding."
        )
    return notes


def _statement(
    curve: list[_Row],
    chosen: Designed,
    options: OptimalFilterMethod,
    claims: Mapping[str, float],
    dependent: Sequence[str],
) -> str:
    """Return a text on the least norm of all filters, the norm of this one, and the norms with longer delays."""
    fault_map = chosen.fault_map
    if not fault_map.exact:
        of = "over all causal filters, matching this reference model"
    elif fault_map.delays is None:
        of = "over all causal filters, linear or not, with this exact fault map"
    else:
        of = f"over all causal filters, linear or not, with this exact fault map and delay {in_words(fault_map.delays)}"
    of = of if fault_map.weights is None else f"{of}, of the weighted problem"
    if options.norm == "h2":
        of = of.replace("causal filters, linear or not,", "causal linear filters")
        own, least = claims["deviation"], claims["least_deviation"]
        reached = "reached by this filter" if own == least else f"this filter: {own:.8g}"
        reached = reached if least or not own else f"{reached}, which is rounding"
        text = f"Least deviation {of}: {least:.8g}, {reached}."
    elif chosen.is_nothing:
        text = f"Least gain from disturbances and noise together, {of}: 0; this filter: 0 but for rounding."
    else:
        # A bound for all delays is one for this delay.
        least = max(claims.get("least", 0.0), claims.get("non_causal_limit", 0.0))
        low, high = bracketed(least, claims["gain"])
        if dependent:
            few = "depends" if len(dependent) == 1 else "depend"
            of += f", whose gain from {', '.join(dependent)}, which {few} on the other outputs but for rounding,"
            of += f" is at most {upper_text(claims['answer_limit'], 3)}"
        of = f"from disturbances and noise together, {of}"
        text = f"Least gain {of}: between {low} and {high}, proved; this filter: {high}."
    places = [row.filter.fault_map.delays for row in curve]
    place = places.index(fault_map.delays) if fault_map.delays in places else len(curve)
    if place + 1 < len(curve):
        text += f" With delay {_late(curve[place + 1])}: {curve[place + 1].chosen_norm:.5g}."
    elif place > 0 and place + 1 == len(curve) and not chosen.is_nothing:
        text += " Longer delays were not tried, and each sample more still lowered it: give a delay to go on."
    if "non_causal_limit" in claims:
        low, _ = bracketed(claims["non_causal_limit"], np.inf)
        text += f" No delay brings it below {low}."
    return text


def _late(row: _Row) -> str:
    return in_words(row.filter.fault_map.delays or ())


def _gap(plant: DescriptorSystem, chosen: Designed, options: OptimalFilterMethod, claims: Mapping[str, float]) -> str:
    """Return a text on the gap between the gain and the least gain, and on a sensor noise that closes it."""
    least, gain = claims.get("least", 0.0), claims.get("gain", 0.0)
    if options.norm == "h2" or chosen.is_nothing or chosen.least is not None:
        return "State the noise of every sensor (sensor_noise)."
    text = f"The least gain is {(gain - least) / gain:.2g} of the gain below it"
    if gain - least <= CLOSED_GAP * gain:
        return f"{text}."
    offered = _noise_that_closes(plant, chosen)
    if offered is None:
        return f"{text}."
    noise, low, high = offered
    listed = ", ".join(f"{name!r}: {value:g}" for name, value in noise.items())
    return (
        f"{text}. With sensor_noise={{{listed}}} of the plant, which was tried, both meet: the least gain is then "
        f"between {low} and {high}."
    )


def _noise_that_closes(plant: DescriptorSystem, chosen: Designed) -> tuple[dict[str, float], str, str] | None:
    """Return the least of some noises on sensors without noise that closes the gap, with both bounds on the least
    gain."""
    quiet = [i for i in range(plant.ny) if not plant.Dw[i].any()] or list(range(plant.ny))
    sizes = 1.0 / PlantUnits.of(plant).outputs
    few = plant.nx <= MOST_STATES_OF_OFFERS and chosen.fault_map.weights is None
    for share in OFFERED_NOISES if few else ():
        noise = {plant.output_names[i]: float(f"{share * sizes[i]:.0e}") for i in quiet}
        columns = np.zeros((plant.ny, len(quiet)))
        columns[quiet, range(len(quiet))] = [*noise.values()]
        noisy = plant.replace(
            Bw=np.hstack([plant.Bw, np.zeros((plant.nx, len(quiet)))]),
            Dw=np.hstack([plant.Dw, columns]),
            noise_names=[*plant.noise_names, *unused_names([f"noise {name}" for name in noise], plant.noise_names)],
        )
        try:
            least = designed(noisy, chosen.fault_map, "hinf", ADDED_NOISES[:1])
            least, follower, observer = _with_enough_noise(noisy, least, "hinf")
            _, claims = certified(noisy, least, observer, follower, "hinf")
        except (PreconditionError, SolverError):
            continue
        if not least.added_noise and claims["gain"] - claims.get("least", 0.0) <= CLOSED_GAP * claims["gain"]:
            return noise, *bracketed(claims["least"], claims["gain"])
    return None


def bracketed(low: float, high: float) -> tuple[str, str]:
    """Return both ends of an interval as texts, rounded outwards, with two digits more than agree."""
    gap = (high - low) / high if np.isfinite(high) and high > 0.0 else 1.0
    agreeing = -math.log10(gap) if gap > 0.0 else MOST_DIGITS
    digits = int(np.clip(agreeing + 2.0, FEWEST_DIGITS, MOST_DIGITS))
    return lower_text(low, digits), upper_text(high, digits)

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

#: A delay is taken when its least gain is at most this much above that of the longest one that was tried.
DELAY_ROOM = 1.05
#: Delays that are tried after the first one that exists, and at most where each is better than that by `DELAY_ROOM`.
MORE_DELAYS, MOST_MORE_DELAYS = 4, 8
#: Gain and least gain that differ by no more than this share are together.
CLOSED_GAP = 3e-5
#: Noise of the sensors that is tried to bring them together, of the outputs' sizes; with more states it takes too long.
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
#: A filter forgets modes that last as fast as its deviation is at most this much above the least one.
FORGETTING_ROOM = 1.01
#: Significant digits of a bound in words.
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
            # Read late or not, an undriven mode that grows is in the errors of a filter of this plant.
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
    """Return the filter of least gain that reads no output before the inputs which it shows have acted.

    Outputs of index 2 or more show inputs of later samples, of which the errors of no stored realisation are a state:
    that of a filter which takes the outputs as many samples later is.  ``None`` for another plant, or without one.
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


def _with_every_start(plant: DescriptorSystem, asked: OptimalFilterMethod) -> Synthesis:
    """Return the filter of least mean square whose errors decay whatever the start of modes that no noise drives.

    Modes that neither decay nor grow have the most noise, of some, that costs little: it sets how fast they are forgot.
    """
    lasts = with_growing_modes_reached(plant, ADDED_DRIVES[0])[0].nw > with_growing_modes_reached(plant)[0].nw
    for drive in ADDED_DRIVES if lasts else (None,):
        driven, undriven = with_growing_modes_reached(plant, drive)
        curve, chosen = _chosen(driven, asked, undriven=undriven)
        own_map = on_plant(plant, chosen.fault_map, asked.weights)
        least = least_deviation_of_every_start(plant, own_map, asked.weights)
        made = _made(plant, asked, curve, chosen, searched=driven, least=least if lasts else None)
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
    """Return the filter for the largest noise on modes that last of which less does not lower the gain."""
    found: list[tuple[Synthesis, FaultMap]] = []
    least_gain = math.inf
    for drive in ADDED_DRIVES:
        driven = with_lasting_modes_driven(plant, drive)
        try:
            curve, chosen = _chosen(driven, options)
            made = _made(plant, options, curve, chosen, searched=driven)
        except (PreconditionError, SolverError):
            # With less noise rounding may spoil the proof; the filter for more of it is proved already.
            if not found:
                raise
            break
        gain, least = made.certificate.claims["gain"], made.certificate.claims.get("least", 0.0)
        if found and gain >= least_gain * (1.0 - CLOSED_GAP):
            break
        found.append((made, chosen.fault_map))
        least_gain = gain
        if chosen.is_nothing or gain - least <= CLOSED_GAP * gain:
            return made
    return _with_least_of_every_start(plant, options, *found[-1])


def _with_least_of_every_start(
    plant: DescriptorSystem, options: OptimalFilterMethod, made: Synthesis, fault_map: FaultMap
) -> Synthesis:
    """Return a design whose note has the least gain of filters whose errors decay, where one was found."""
    try:
        least = least_gain_of_every_start(plant, fault_map, options.weights)
    except (PreconditionError, SolverError):
        return made
    return replace(made, notes=(*made.notes[:-1], made.notes[-1] + EVERY_START_NOTE.format(f"{least:.6g}")))


def synthesis_of_gains(
    plant: DescriptorSystem, options: OptimalFilterMethod, fault_map: FaultMap, gains: Mapping[str, FloatArray]
) -> Synthesis:
    """Return the filter of gains ``K`` and ``Z0`` on the innovation, beside the bounds on every filter."""
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
    """Return realisation and certificate of a filter, on the plant with its disturbances that are not decoupled.

    ``searched``: the plant that the filter was searched for, where noise was added; ``least``: the least deviation.
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
        "trade_off": [[row.found.fault_map.delay, row.gain, row.deviation] for row in curve],
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
    """Return the norm of a filter on a plant, which need not be the one that it was searched for."""
    channel = ErrorChannel.of(error_model_of(plant, observer, follower), chosen.fault_map)
    if norm == "h2":
        return channel.deviation(plant.dt)
    a, b, c, d = channel.middle
    if not plant.is_discrete:
        a, b, c, d = cayley(a, b, c, d, chosen.problem.alpha)
    return float(hinf_norm(a, b, c, d).upper)


_Realised: TypeAlias = tuple[Designed, RealisedFilter, LinearObserver]


def _of_low_order(plant: DescriptorSystem, chosen: Designed, limit: int, full: int, norm: str) -> _Realised:
    """Return the filter of low order with the least gain of its own, of those whose realisation keeps the fault map.

    They come in the order of their norms at some angles, between which a gain may have its peak.
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
    """Return the filter of least gain of its own, of some and one that is known, that has a realisation."""
    for filter_ in filters:
        realised = _of_at_most(plant, filter_, limit, norm)
        gain = math.inf if realised is None else _recomputed_gain(plant, filter_, *realised, norm)
        if realised is not None and gain < (math.inf if best is None else best[0].gain):
            best = filter_._replace(gain=gain), *realised
    return best


def _of_at_most(
    plant: DescriptorSystem, chosen: Designed, limit: int, norm: str
) -> tuple[RealisedFilter, LinearObserver] | None:
    """Return a filter's realisation; ``None`` where it has more states, or no longer the fault map."""
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
    """Return a filter and its realisation, for the least added noise with which this keeps its digits.

    The poles of a filter without noise run to infinity: the nearer they are to it, the fewer digits are left.
    """
    may_have_more = chosen.least is None or (norm == "h2" and not plant.is_discrete)
    more = [noise for noise in ADDED_NOISES if noise > chosen.added_noise and may_have_more]
    best: tuple[float, tuple[Designed, RealisedFilter, LinearObserver]] | None = None
    while True:
        try:
            follower, observer, missed = realisation_of(plant, chosen, norm)
            # Noise that carries none, beside undriven modes, would count in the mean square of this plant.
            if norm == "h2" and not plant.is_discrete and not chosen.fault_map.undriven:
                missed = max(missed, _lost_share(plant, chosen, follower, observer))
            if best is None or missed < best[0]:
                best = missed, (chosen, follower, observer)
        except SolverError:
            if not more and best is None:
                # Where outputs show nothing of the faults, what a filter reads of them is rounding.
                zero = without_filter(plant, chosen, norm)
                if zero is None:
                    raise
                return (zero, *realisation_of(plant, zero, norm)[:2])
        if best is not None and (best[0] <= EXACT_SHARE or not more):
            return best[1]
        try:
            chosen = designed(plant, chosen.fault_map, norm, more)
        except PreconditionError as error:
            # A filter exists: its equations have a solution for less noise.  Verification judges its digits.
            if best is not None:
                return best[1]
            raise SolverError(
                "The filter of least gain keeps its fault map by rounding only, and with noise added to every output "
                "its equations were not solved: the result is inconclusive. Give every sensor noise (sensor_noise), or "
                "a longer delay."
            ) from error
        more = [noise for noise in more[1:] if noise > chosen.added_noise]


def _lost_share(plant: DescriptorSystem, chosen: Designed, follower: RealisedFilter, observer: LinearObserver) -> float:
    """Return by which share the mean square of the stored numbers, its root, is another one than that of the design."""
    own = _recomputed_gain(plant, chosen, follower, observer, "h2")
    if chosen.is_nothing:
        return 0.0 if np.isfinite(own) else math.inf
    return abs(own - chosen.gain) / chosen.gain if np.isfinite(own) else math.inf


class _Row(NamedTuple):
    """A delay that was looked at: the filter of the norm that counts, and the least of both norms."""

    found: Designed
    gain: float
    deviation: float

    @property
    def counts(self) -> float:
        return 0.0 if self.found.is_nothing else self.found.gain


def _chosen(plant: DescriptorSystem, options: OptimalFilterMethod, *, undriven: int = 0) -> tuple[list[_Row], Designed]:
    """Return the delays that were looked at, and the filter of the one that is taken; a reference model has none.

    ``undriven``: last columns of the noise that carry none.
    """
    fault_map, _ = first_problem(plant, options)
    fault_map = fault_map._replace(undriven=undriven)
    first = designed(plant, fault_map, options.norm)
    if fault_map.delays is None:
        return [], first
    curve = [_row(plant, first, options.norm)]
    is_open = tuple(late is None for late in delays_of(options.delay, plant))
    # A delay that was asked for is printed with what one sample more would give.
    more, most = (MORE_DELAYS, MOST_MORE_DELAYS) if any(is_open) else (1, 1)
    which = is_open if any(is_open) else None
    for samples in range(1, 1 + most):
        falling = len(curve) < 2 or DELAY_ROOM * curve[-1].counts < curve[-2].counts
        if curve[-1].found.is_nothing or (len(curve) > more and not falling):
            break
        try:
            curve.append(
                _row(plant, designed(plant, fault_map.later(samples, which=which), options.norm), options.norm)
            )
        except PreconditionError:
            break
    if not any(is_open):
        return curve, first
    enough = max(DELAY_ROOM * min(row.counts for row in curve), first.nothing)
    chosen = next(row.found for row in curve if row.found.gain <= enough)
    if is_auto(options.delay):
        return curve, chosen
    return curve, _shortened(plant, chosen, is_open, enough, options.norm)


def _shortened(
    plant: DescriptorSystem, chosen: Designed, is_open: tuple[bool, ...], enough: float, norm: str
) -> Designed:
    """Return the filter with each delay that is open as short as a gain that is enough allows, one after the other."""
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
    """Return the row of a filter, with the least of the norm that it is not for."""
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
    """Return what no filter beats, how near this one is to it, and what more delay would give."""
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
        # What holds at any delay holds at this one.
        least = max(claims.get("least", 0.0), claims.get("non_causal_limit", 0.0))
        low, high = bracketed(least, claims["gain"])
        if dependent:
            few = "depends" if len(dependent) == 1 else "depend"
            of += f", whose gain from {', '.join(dependent)}, which {few} on the other outputs but for rounding,"
            of += f" is at most {upper_text(claims['answer_limit'], 3)}"
        of = f"from disturbances and noise together, {of}"
        text = f"Least gain {of}: between {low} and {high}, proved; this filter: {high}."
    places = [row.found.fault_map.delays for row in curve]
    place = places.index(fault_map.delays) if fault_map.delays in places else len(curve)
    if place + 1 < len(curve):
        text += f" With delay {_late(curve[place + 1])}: {curve[place + 1].counts:.5g}."
    elif place > 0 and place + 1 == len(curve) and not chosen.is_nothing:
        text += " Longer delays were not tried, and each sample more still lowered it: give a delay to go on."
    if "non_causal_limit" in claims:
        low, _ = bracketed(claims["non_causal_limit"], np.inf)
        text += f" No delay brings it below {low}."
    return text


def _late(row: _Row) -> str:
    return in_words(row.found.fault_map.delays or ())


def _gap(plant: DescriptorSystem, chosen: Designed, options: OptimalFilterMethod, claims: Mapping[str, float]) -> str:
    """Return how far gain and least gain are apart, and which noise, that was tried, brings them together."""
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
    """Return the least noise of the sensors without any, of some that are tried, with which the gap is closed."""
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
    """Return both ends of an interval as texts, rounded outwards, in the digits that agree and two more."""
    gap = (high - low) / high if np.isfinite(high) and high > 0.0 else 1.0
    agreeing = -math.log10(gap) if gap > 0.0 else MOST_DIGITS
    digits = int(np.clip(agreeing + 2.0, FEWEST_DIGITS, MOST_DIGITS))
    return lower_text(low, digits), upper_text(high, digits)

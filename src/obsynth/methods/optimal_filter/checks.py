"""Checks of an optimal filter, from the plant and the shipped realisation alone."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from obsynth.errors import PreconditionError, SpecError
from obsynth.methods.optimal_filter.delays import in_words, plain_delays
from obsynth.methods.optimal_filter.error_channel import ErrorChannel
from obsynth.methods.optimal_filter.fault_maps import (
    ZERO_GAIN,
    FaultMap,
    designed,
    least_deviation_of_every_start,
    response_at,
)
from obsynth.methods.optimal_filter.realisation import with_modes
from obsynth.methods.optimal_filter.realised_filter import behind_delay
from obsynth.methods.optimal_filter.reference import stored_reference
from obsynth.methods.optimal_filter.weights import weights_of
from obsynth.numerics.arguments import is_whole
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.decoupling_windows import Model
from obsynth.numerics.outward import upper_text
from obsynth.numerics.spectra import pole_text
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.plant_units import PlantUnits
from obsynth.proofs.contraction import prove_contraction
from obsynth.proofs.definiteness import unproved
from obsynth.results.checks import Check, fitting_check, lower_bound_check, upper_bound_check
from obsynth.results.design import ObserverDesign
from obsynth.verification.claims import claimed, listed_gains
from obsynth.verification.error_system import IDENTITY_SHARE, ErrorModel
from obsynth.verification.fault_map_zeros import VANISHING_SHARE, missed_zeros
from obsynth.verification.gain_by_pencil import prove_norm_by_eigenvalues
from obsynth.verification.inequalities import proof_row, prove_norm, stability_row
from obsynth.verification.invisible_at_infinity import proved_at_infinity
from obsynth.verification.invisible_faults import LONGEST_DELAY, proved_least, proved_limit
from obsynth.verification.plant import plant_information
from obsynth.verification.seen_outputs import Setting, seen_plant

#: Faults pass by the fault map to this share of its largest entry.
FAULT_MAP_SHARE = 1e-6
#: A recomputed deviation repeats the claimed one to this share.
DEVIATION_SHARE = 1e-6
#: The bound on a deviation that is rounding is a power of ten, at most so many times as large.
ROUNDING_ROOM = 20.0


def checks(design: ObserverDesign, printed_digits: int | None) -> Iterator[Check]:
    """Yield every check of ``design``; see `obsynth.methods.verifying.verify`."""
    plant, observer = design.linear
    yield from plant_information(plant)
    fitting = _fits(design)
    yield fitting_check("observer, certificate, options and plant have matching signals and shapes", fits=fitting)
    if not fitting:
        return
    matrices, claims, options = design.certificate.matrices, design.certificate.claims, design.options
    # Disturbances that are not decoupled count as noise.
    plant = seen_plant(plant, options["decoupled"])
    lag = matrices["T0"].shape[1] // plant.nx - 1
    # Modes of the plant that the errors hold stay at zero in the observer, which ships without them.
    whole = with_modes(observer, matrices)
    later = _later(design)
    whole = behind_delay(whole, later)
    model = ErrorModel(plant, whole, matrices["T"], -matrices["T0"], lag=lag, decoupled=True, later=later)
    yield _decoupling(model, printed_digits)
    yield listed_gains(design, {name: matrices[name] for name in ("T", "T0")})
    yield stability_row(whole.Az, matrices["stability"], plant.dt, "Lyapunov")
    yield upper_bound_check(
        "order",
        "the filter has as many states as claimed: difference",
        abs(observer.order - claimed(claims, "order")),
        0.0,
        source="shipped realisation",
        kind="equality",
        detail=f"{observer.order} states",
    )
    if options["exact"]:
        yield _fault_map(design, model)
        yield from _zeros(design, plant)
    weights = _claimed_map(design).weights
    channel = ErrorChannel.of(model, _claimed_map(design))
    if options["norm"] == "h2":
        yield _deviation(channel, claimed(claims, "deviation"), plant)
        yield _least_deviation(design, plant)
        return
    channel = channel.in_units_of(claimed(claims, "gain"))
    level = claims["gain"] / channel.unit
    if "P" in matrices:
        proof, source = prove_norm(channel, matrices["P"], level, dt=plant.dt), "bounded real lemma"
    elif not all(
        _decays(model, plant) for model in (stored_reference(matrices), *(weights or ())) if model is not None
    ):
        # Of the filter's own states the row on its poles says so.
        proof = unproved("no decay is proved of the weights, or of the reference model")
        source = "eigenvalues of the Hamiltonian matrix"
    else:
        proof = prove_norm_by_eigenvalues(channel, channel.order, level, dt=plant.dt)
        source = "eigenvalues of the Hamiltonian matrix"
    driven = "noise" if options["exact"] else "faults and noise together"
    driven = driven if weights is None else f"{driven}, each behind its weight"
    error = "error" if weights is None else "weighted error"
    yield proof_row("gain", f"the {error} is at most {upper_text(claims['gain'], 9)} times the {driven}", proof, source)
    plant = _claimed_map(design).driven(plant)
    if "least" in claims:
        yield _least(design, plant)
    if "non_causal_limit" in claims:
        yield _limit(design, plant)


def _decoupling(model: ErrorModel, printed_digits: int | None) -> Check:
    """Return whether neither the state, nor known inputs, nor decoupled disturbances reach the estimates."""
    bound = IDENTITY_SHARE if printed_digits is None else 10.0**-printed_digits
    return upper_bound_check(
        "decoupling",
        "neither states, nor known inputs, nor decoupled disturbances reach the estimates",
        model.missed(),
        bound,
        source="Az T E + By C = T A, Bu + By D = T B, Cz T E + Dy C = T0 A, Du + Dy D = T0 B, T0 E = 0, By Dd = T Bd",
        kind="equality",
        detail="relative to the size of the terms",
    )


def _later(design: ObserverDesign) -> int:
    """Return by how many samples the rows are later of which T and T0 are."""
    matrices = design.certificate.matrices
    return int(matrices["later"][0, 0]) if "later" in matrices else 0


def _fits(design: ObserverDesign) -> bool:
    (plant, observer), matrices = design.linear, design.certificate.matrices
    claims, options = design.certificate.claims, design.options
    if not {"T", "T0", "stability"} <= set(matrices) or not _options_fit(design):
        return False
    parts = (observer.Az, observer.Bu, observer.By, observer.Cz, observer.Du, observer.Dy, *matrices.values())
    states, reference = matrices["T0"].shape[1], stored_reference(matrices)
    if "later" in matrices and not (plant.is_discrete and _is_count(matrices["later"], plant.nx)):
        return False
    later = _later(design)
    extra = 0 if reference is None or options["exact"] else len(reference[0]) + later * plant.nf
    try:
        weights = _claimed_map(design).weights
    except SpecError:
        return False
    extra += 0 if weights is None else weights.order
    rows = plant.nf if reference is None else len(reference[2])
    held = matrices["modes_A"].shape[-1] if "modes_A" in matrices else 0
    order = observer.order + held + later * rows
    shapes = {
        "stability": (order,) * 2,
        "T": (order, states),
        "T0": (rows, max(states // plant.nx, 1) * plant.nx),
    }
    shapes |= {"modes_A": (order, held), "modes_C": (rows, held)} if {"modes_A", "modes_C"} & set(matrices) else {}
    shapes |= {} if "P" not in matrices else {"P": (order + extra,) * 2}
    if "least" in claims:
        shapes |= {"invisible": (len(matrices.get("invisible", ())), 2), "samples": (1, 1)}
    shapes |= {"limit_point": (1, 2)} if "non_causal_limit" in claims else {}
    if ("dependent" in matrices) != ("answer_limit" in claims) or not claims.get("answer_limit", 1.0) > 0.0:
        return False
    if not _are_outputs(matrices.get("dependent"), plant):
        return False
    needed = {"gain"} if options["norm"] == "hinf" else {"deviation", "least_deviation"}
    return bool(
        all(np.all(np.isfinite(part)) for part in parts)
        and all(name in matrices and matrices[name].shape == shape for name, shape in shapes.items())
        and needed <= set(claims)
        and len(observer.Cz) == rows
        and (observer.input_names, observer.output_names) == (plant.input_names, plant.output_names)
        and observer.state_names == ()
        and observer.fault_names == (plant.fault_names if rows == plant.nf else ())
        and observer.dt == plant.dt
    )


def _options_fit(design: ObserverDesign) -> bool:
    """Whether the options are those of this method, and the delay and the reference model are those of the claims."""
    (plant, observer), options = design.linear, design.options
    claims, matrices = design.certificate.claims, design.certificate.matrices
    if not {"norm", "exact", "delay", "reference", "decoupled"} <= set(options):
        return False
    reference = stored_reference(matrices)
    late = observer.fault_delays
    if reference is None:
        timed = bool(late) and options["delay"] == plain_delays(late) and plant.nf == len(late)
        timed = timed and claims.get("delay") == max(late, default=None) and options["reference"] is None
        timed = timed and plant.is_discrete and options["exact"] is True
    else:
        stated = options["reference"]
        same = isinstance(stated, Mapping) and all(
            np.array_equal(np.reshape(stated.get(name, ()), np.shape(part)), part)
            if np.size(stated.get(name, ())) == np.size(part)
            else False
            for name, part in zip("ABCD", reference, strict=True)
        )
        timed = same and "delay" not in claims and not any(late) and _is_stable(reference, plant)
    return bool(
        timed
        and options["norm"] in ("hinf", "h2")
        and isinstance(options["exact"], bool)
        and _within_limit(observer.order, options.get("order_limit"))
        and set(options["decoupled"]) <= set(plant.disturbance_names)
    )


def _is_count(matrix: FloatArray, most: int) -> bool:
    """Return whether a matrix is one whole number from 1."""
    return matrix.shape == (1, 1) and float(matrix[0, 0]) in range(1, most + 1)


def _within_limit(order: int, limit: Any) -> bool:
    return limit is None or (is_whole(limit) and order <= limit)


def _is_stable(reference: Model, plant: DescriptorSystem) -> bool:
    a, b, c, d = reference
    n = len(a)
    if a.shape != (n, n) or b.shape != (n, plant.nf) or c.shape != (len(d), n) or d.shape[1] != plant.nf:
        return False
    modes = np.linalg.eigvals(a) if n else np.zeros(0)
    return bool(np.all(np.abs(modes) < 1.0) if plant.is_discrete else np.all(modes.real < 0.0))


def _decays(model: Model, plant: DescriptorSystem) -> bool:
    """Return whether all states of a model are proved to decay."""
    return not len(model[0]) or prove_contraction(model[0], discrete=plant.is_discrete) is not None


def _are_outputs(places: FloatArray | None, plant: DescriptorSystem) -> bool:
    """Whether places, where there are any, are those of some of the outputs, but not of all."""
    if places is None:
        return True
    own = set(places.ravel().tolist())
    return places.shape == (len(own), 1) and 0 < len(own) < plant.ny and own <= set(range(plant.ny))


def _setting(design: ObserverDesign) -> Setting:
    setting, certificate = _claimed_map(design).setting, design.certificate
    if "dependent" not in certificate.matrices:
        return setting
    places = tuple(int(place) for place in certificate.matrices["dependent"].ravel())
    return setting._replace(dependent=places, answer_limit=claimed(certificate.claims, "answer_limit"))


def _among(design: ObserverDesign) -> str:
    """Return of which filters a bound is, where not of all."""
    setting = _setting(design)
    if not setting.dependent:
        return ""
    names = ", ".join(design.linear[0].output_names[place] for place in setting.dependent)
    return f" and a gain of at most {upper_text(setting.answer_limit, 3)} from {names}"


def _claimed_map(design: ObserverDesign) -> FaultMap:
    reference = stored_reference(design.certificate.matrices)
    delays = design.linear[1].fault_delays if reference is None else None
    exact, rows = bool(design.options["exact"]), len(design.linear[1].Cz)
    plant = seen_plant(design.linear[0], design.options["decoupled"])
    weights = weights_of(design.options.get("weights"), plant, rows=rows, exact=exact)
    return FaultMap(delays, reference, exact, weights)


def _fault_map(design: ObserverDesign, model: ErrorModel) -> Check:
    fault_map = _claimed_map(design)
    missed, count = fault_map_missed(model, fault_map)
    delays = fault_map.delays
    late = (
        "as by the reference model"
        if delays is None
        else f"late by {in_words(delays)} {'sample' if set(delays) == {1} else 'samples'}"
    )
    return upper_bound_check(
        "fault map",
        f"faults pass exactly, {late}, whatever their time course",
        missed,
        FAULT_MAP_SHARE,
        source=f"transfer functions at {count} points, which determine them",
        kind="equality",
    )


def _zeros(design: ObserverDesign, plant: DescriptorSystem) -> Iterator[Check]:
    """Yield the row on the zeros of faults that are not strictly stable, where there are any."""
    fault_map = _claimed_map(design)
    missed = missed_zeros(plant, reference=fault_map.reference, delays=fault_map.delays)
    if missed:
        yield upper_bound_check(
            "zeros of the faults",
            "the fault map is zero where no output shows the faults: at their zeros that are not strictly stable",
            max(zero.share for zero in missed),
            VANISHING_SHARE,
            source="invariant zeros of the plant, and the fault map at them",
            kind="equality",
            detail=", ".join(pole_text(zero.value, 6, pair=True) for zero in missed),
        )


def fault_map_missed(model: ErrorModel, fault_map: FaultMap) -> tuple[float, int]:
    """Return by which share of what it shall be the transfer from the faults misses the fault map, and the points.

    Each estimate is judged beside the largest entry of its own row, each fault in a unit that suits the plant.  The
    points are more than the difference has states.
    """
    plant, observer = model.plant, model.observer
    c, df, _, _ = model.output(slice(0, len(observer.Cz)))
    points = fault_map.behind_delay(model.later).at_points(plant, observer.Az)
    units = PlantUnits.of(plant).faults
    worst, largest = np.zeros(len(c)), np.zeros(len(c))
    for point, wanted in points:
        response = df - response_at((observer.Az, model.fault, c, 0.0 * df), point)
        # What is no number stays none, and fails.
        worst = np.maximum(worst, np.max(np.abs(response - wanted) * units, axis=1, initial=0.0))
        largest = np.maximum(largest, np.max(np.abs(wanted) * units, axis=1, initial=0.0))
    sizes = np.where(largest > 0.0, largest, np.max(largest, initial=0.0) or 1.0)
    return float(np.max(worst / sizes, initial=0.0)), len(points)


def _least(design: ObserverDesign, plant: DescriptorSystem) -> Check:
    """Prove the bound on every causal filter again, from the plant and the points: no filter is in it."""
    matrices, stated = design.certificate.matrices, claimed(design.certificate.claims, "least")
    points = [complex(*pair) for pair in matrices["invisible"]]
    samples = int(matrices["samples"][0, 0])
    # Without points a bound of continuous time is that of infinite frequency.
    at_once = not points and not plant.is_discrete
    if at_once:
        bound = proved_at_infinity(plant, _setting(design))
    else:
        bound = proved_least(plant, points, samples, _setting(design), level=stated)
    return _bound_row(
        "least gain",
        f"every causal filter, linear or not, with this fault map{_among(design)} has at least this gain",
        bound,
        stated,
        "faults and noise of ever higher frequency that no output shows"
        if at_once
        else f"{len(points)} points of faults and noise that no output shows",
    )


def _limit(design: ObserverDesign, plant: DescriptorSystem) -> Check:
    matrices, stated = design.certificate.matrices, claimed(design.certificate.claims, "non_causal_limit")
    point = complex(*matrices["limit_point"][0])
    return _bound_row(
        "gain at any delay",
        f"no delay of up to {LONGEST_DELAY} samples brings the gain of an exact fault map{_among(design)} below this",
        proved_limit(plant, point, _setting(design)),
        stated,
        "faults and noise of one frequency that no output shows",
    )


def _bound_row(name: str, claim: str, bound: float | None, stated: float, detail: str) -> Check:
    """Return the row of a proved lower bound on what is claimed."""
    if bound is None:
        return lower_bound_check(
            name, claim, np.nan, stated, source="the plant's equations in ball arithmetic", detail="not proved"
        )
    return Check(
        name,
        claim,
        bound,
        stated,
        bound - stated,
        bool(bound >= stated > 0.0),
        "the plant's equations in ball arithmetic",
        "proved",
        detail,
    )


def _deviation(channel: ErrorChannel, stated: float, plant: DescriptorSystem) -> Check:
    deviation, source = channel.deviation(plant.dt), "Lyapunov equation"
    repeated = abs(deviation - stated) <= DEVIATION_SHARE * stated
    if 0.0 < stated <= ROUNDING_ROOM * channel.rounding and deviation <= channel.rounding and not repeated:
        claim = "root mean square of the error for white noise: rounding, of which this is a bound"
        return upper_bound_check("deviation", claim, deviation, stated, source=source, kind="computed")
    # Of zero nothing but rounding may be left.
    unit = stated if stated else channel.size * ZERO_GAIN / DEVIATION_SHARE
    return upper_bound_check(
        "deviation",
        "root mean square of the error for white noise, recomputed: relative difference",
        abs(deviation - stated) / max(unit, float(np.finfo(float).tiny)),
        DEVIATION_SHARE,
        source=source,
        kind="computed",
    )


def _least_deviation(design: ObserverDesign, plant: DescriptorSystem) -> Check:
    """Compute the least mean square from the plant again: the filtering Riccati equation is the proof."""
    stated, fault_map = claimed(design.certificate.claims, "least_deviation"), _claimed_map(design)
    of = "every causal linear filter with this fault map"
    least = _least_or_nan(lambda: designed(plant, fault_map, "h2").least_gain)
    if not least * (1.0 + DEVIATION_SHARE) >= stated:
        every = _least_or_nan(lambda: least_deviation_of_every_start(plant, fault_map, design.options.get("weights")))
        if every > least or np.isnan(least):
            least, of = every, f"{of} whose errors decay after any start"
    return lower_bound_check(
        "least deviation",
        f"{of} has at least this root mean square",
        least * (1.0 + DEVIATION_SHARE),
        stated,
        source="filtering Riccati equation of the plant, solved again",
    )


def _least_or_nan(least: Callable[[], float]) -> float:
    try:
        return least()
    except PreconditionError:
        return np.nan

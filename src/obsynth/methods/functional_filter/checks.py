"""Checks of a functional filter, from plant, realisation, T and T0; its gains are checked without T and T0."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence

import numpy as np

from obsynth.analysis.existence.augmented_pencils import shipped_model
from obsynth.analysis.existence.functional_filter import conditions, residual_sets
from obsynth.analysis.existence.functional_states import chosen_states, state_conditions
from obsynth.errors import SpecError
from obsynth.methods.functional_filter.method import FunctionalFilter
from obsynth.methods.functional_filter.tracking import estimate_deviations, wanted_faults
from obsynth.methods.ui_pi_observer.decoupling import decoupling_norms
from obsynth.numerics.arrays import FloatArray, reachable
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.noise import noise_words
from obsynth.plants.plant_units import PlantUnits
from obsynth.results.checks import Check, fitting_check, information, nothing_wrong, upper_bound_check
from obsynth.results.design import ObserverDesign
from obsynth.verification.claims import listed_gains
from obsynth.verification.error_system import ErrorModel, natural_scaling
from obsynth.verification.fault_models import fault_model_row
from obsynth.verification.identities import Identity, equality, relative_tolerance
from obsynth.verification.inequalities import decay_row, stability_row
from obsynth.verification.plant import condition_rows, plant_information

#: Estimates at a frequency may miss by this much, relative to terms that pass through the inverse of ``sI - Az``.
DECOUPLING_LEVEL = 1e-7

#: The regulator equation may miss by this much, relative to its terms: its solution is no part of the gains.
TRACKING_TOLERANCE = 1e-8

#: Claimed deviations may be missed by this share: two ways through a Lyapunov equation.
DEVIATION_TOLERANCE = 1e-4

_FUNCTIONAL_MATRICES = ("T", "T0", "Phi", "Cw", "walks", "stability", "tracking", "deviations")

_SOURCE = "identities of the error z - T E x, ours"

_WALKS, _WALKS_CLAIM = "walks of faults", "the random walks of the deviations are those of the options"


def decoupling_rows(design: ObserverDesign) -> Iterator[Check]:
    """Yield the measured gains: of d to everything, of other faults into each estimate or set of residuals."""
    plant, observer = design.linear
    # Unknown inputs move states: what their estimates make of them is in the identities.
    checked_rows = list(range(len(observer.Cz)))[len(observer.state_names) :]
    groups = [("unknown inputs", checked_rows, list[str]())] if plant.nd and checked_rows else []
    groups += [(f"free of others: {name}", rows, blind) for name, rows, blind in _blind_to(design) if blind]
    if not groups:
        return
    every = plant.replace(
        Bd=np.hstack([plant.Bd, plant.Bf]),
        Dd=np.hstack([plant.Dd, plant.Df]),
        disturbance_names=[*plant.disturbance_names, *(f"fault {fault}" for fault in plant.fault_names)],
    )
    known = range(plant.nd)
    inputs = [[*known, *(plant.nd + plant.fault_names.index(fault) for fault in blind)] for _, _, blind in groups]
    norms = decoupling_norms(every, observer, [(rows, of) for (_, rows, _), of in zip(groups, inputs, strict=True)])
    for (name, _, blind), norm in zip(groups, norms, strict=True):
        claim = f"neither unknown inputs nor {', '.join(blind)} reach it, whatever their time course"
        yield upper_bound_check(
            name,
            claim if blind else "the unknown inputs reach neither estimates nor residuals",
            norm.relative,
            DECOUPLING_LEVEL,
            source="computed from the transfer functions of plant and filter, without T and T0",
            detail=f"relative to the terms; worst at {norm.frequency:.3g} rad/s",
        )


def _blind_to(design: ObserverDesign) -> Iterator[tuple[str, list[int], list[str]]]:
    """Yield, for groups of rows, their name, the rows and the faults that must not reach them."""
    plant, observer = design.linear
    options = design.options
    if options.get("residuals") is None:
        left_out = [name for name in plant.fault_names if name not in observer.fault_names]
        for row, name in enumerate(observer.fault_names):
            beside = [] if options.get("joint") else [other for other in observer.fault_names if other != name]
            yield name, [observer.fault_rows.start + row], [*left_out, *beside]
        return
    sets = residual_sets(options["residuals"], plant) or []
    for own_faults in ([plant.fault_names[i] for i in indices] for indices in sets):
        label = f"{' '.join(own_faults)}: "
        rows = [row for row, name in enumerate(observer.residual_names) if len(sets) == 1 or name.startswith(label)]
        yield label.rstrip(": "), rows, [name for name in plant.fault_names if name not in own_faults]


def noise_rows(design: ObserverDesign) -> Iterator[Check]:
    """Yield, for each estimate, the deviation that noise causes, and that of its error with the stated walk."""
    (plant, observer), matrices = design.linear, design.certificate.matrices
    if not plant.nw or not observer.fault_names:
        return
    deviations = estimate_deviations(plant, observer, matrices)
    noise = noise_words(plant.noise_names)
    unit = "" if plant.dt > 0.0 else " (for a sample time of 1 s, times its root for others)"
    for name, (alone, total), (claimed, claimed_total) in zip(
        observer.fault_names, deviations, matrices["deviations"], strict=True
    ):
        if np.isnan(alone) or np.isnan(claimed):
            yield information(
                f"noise in fhat[{name}]",
                f"standard deviation under {noise}",
                alone,
                source="recomputed, Lyapunov equation",
                detail="all digits are rounding errors" + (": no deviation is claimed" if np.isnan(claimed) else ""),
            )
            continue
        yield upper_bound_check(
            f"noise in fhat[{name}]",
            f"standard deviation under {noise} is at most the claimed one{unit}",
            float(alone),
            float(claimed) * (1.0 + DEVIATION_TOLERANCE),
            source="recomputed, Lyapunov equation",
        )
        if np.isfinite(total) and matrices["walks"].any():
            yield upper_bound_check(
                f"error of fhat[{name}]",
                f"standard deviation of the error with the random walk of the fault{unit}",
                float(total),
                float(claimed_total) * (1.0 + DEVIATION_TOLERANCE),
                source="recomputed, Lyapunov equation",
            )


def _walk_row(design: ObserverDesign) -> Check:
    """Return the row on the walks of the fault models: those that the options state, or say that they found."""
    (plant, _), matrices, options = design.linear, design.certificate.matrices, design.options
    walks, wrong = np.diag(matrices["walks"]), list[str]()
    if np.any(matrices["walks"] != np.diag(walks)):
        wrong.append("one walk moves several states")
    rates = {name: options.get(f"fault_rate{name}") for name in ("", "_found")}
    of_faults = matrices["Cw"] != 0.0
    if rates[""] is not None:
        try:
            stated = FunctionalFilter(fault_rate=rates[""]).rates(plant)
        except (SpecError, TypeError, ValueError) as error:
            return nothing_wrong(_WALKS, _WALKS_CLAIM, [str(error)], source="options")
        for name in design.linear[1].fault_names:
            row = plant.fault_names.index(name)
            if stated is not None and np.any(walks[of_faults[row]] != stated[row]):
                wrong.append(f"the walk of {name}")
    elif sorted(walks[walks != 0.0]) != sorted(rate for rate in rates["_found"] or () if rate != 0.0):
        wrong.append("fault_rate_found")
    return nothing_wrong(_WALKS, _WALKS_CLAIM, wrong, source="options")


def checks(design: ObserverDesign, printed_digits: int | None) -> Iterator[Check]:
    """Yield every check of ``design``; see `obsynth.methods.verifying.verify`."""
    (plant, observer), matrices = design.linear, design.certificate.matrices
    yield from plant_information(plant)
    fitting = _fits(design)
    yield fitting_check("observer, certificate and plant have matching signals and shapes", fits=fitting)
    if not fitting:
        return
    options = design.options
    yield from condition_rows(
        state_conditions(plant, chosen_states(options.get("states"), plant), options.get("decay"))
    )
    if observer.fault_names or options.get("residuals") is not None:
        yield fault_model_row(plant, design)
        yield from condition_rows(
            conditions(
                plant,
                fault_model=shipped_model(matrices, plant.nf),
                faults=options.get("faults"),
                residuals=options.get("residuals"),
            )
        )
    tolerance = relative_tolerance(printed_digits, plant.nx + plant.ny + observer.order)
    for name, claim, identity in _identities(plant, observer, matrices["T"], matrices["T0"]):
        yield equality(name, claim, identity.residual(), _SOURCE, bound=tolerance)
    yield listed_gains(design, {name: matrices[name] for name in ("T", "T0")})
    yield _walk_row(design)
    yield stability_row(observer.Az, matrices["stability"], plant.dt, "Lyapunov")
    claims = design.certificate.claims
    order = claims.get("order", float("nan"))
    yield upper_bound_check(
        "order",
        "the filter has as many states as claimed: difference",
        abs(observer.order - order),
        0.0,
        source="shipped realisation",
        kind="equality",
        detail=f"{observer.order} states",
    )
    if "decay" in claims:
        yield decay_row(observer, claims["decay"])
    for name, claim, identity in _tracking(plant, observer, design):
        yield equality(
            name, claim, identity.residual(), "regulator equation, ours", bound=max(tolerance, TRACKING_TOLERANCE)
        )
    yield from _mean_rows(design)
    yield from decoupling_rows(design)
    yield from noise_rows(design)


def _mean_rows(design: ObserverDesign) -> Iterator[Check]:
    """Yield the row that estimates are means: of the last m, what the filter makes of any signal is divisible by
    ``1 + 1/z + ... + 1/z^(m-1)``, whose zeros are the m-th roots of unity but one."""
    observer, mean = design.linear[1], design.options.get("mean", 1)
    if mean == 1 or not observer.fault_names:
        return
    rows = observer.fault_rows
    entering, direct = np.hstack([observer.Bu, observer.By]), np.hstack([observer.Du, observer.Dy])[rows]
    missed, size = 0.0, float(np.max(np.abs(direct), initial=0.0))
    for root in np.exp(2j * np.pi * np.arange(1, int(mean)) / int(mean)):
        states = np.linalg.solve(root * np.eye(observer.order) - observer.Az, entering)
        size = max(size, float(np.max(np.abs(observer.Cz[rows]) @ np.abs(states), initial=0.0)))
        missed = max(missed, float(np.max(np.abs(observer.Cz[rows] @ states + direct), initial=0.0)))
    yield upper_bound_check(
        "mean",
        f"each fault estimate is a mean over {mean} samples: what repeats every {mean} samples with mean zero leaves "
        "nothing",
        missed,
        DECOUPLING_LEVEL * size,
        source="computed from the transfer function of the filter",
    )


def _fits(design: ObserverDesign) -> bool:
    (plant, observer), matrices = design.linear, design.certificate.matrices
    if any(name not in matrices for name in _FUNCTIONAL_MATRICES):
        return False
    # A deviation of which all digits are rounding errors is claimed as NaN: not at all.
    if not all(np.all(np.isfinite(matrices[name])) for name in _FUNCTIONAL_MATRICES if name != "deviations"):
        return False
    order, count = observer.order, len(matrices["Phi"])
    shapes = {
        "T": (order, plant.nx),
        "T0": (len(observer.Cz), plant.nx),
        "Phi": (count, count),
        "Cw": (plant.nf, count),
        "walks": (count, count),
        "stability": (order, order),
        "tracking": (order, count),
        "deviations": (len(observer.fault_names), 2),
    }
    finite = all(np.all(np.isfinite(part)) for part in (observer.Az, observer.Bu, observer.By, observer.Cz))
    return bool(
        all(matrices[name].shape == shape for name, shape in shapes.items())
        and finite
        and observer.input_names == plant.input_names
        and observer.output_names == plant.output_names
        and observer.state_names == _states_asked_for(design)
        and set(observer.fault_names) <= set(plant.fault_names)
        and (observer.state_names or observer.fault_names or observer.residual_names)
        and observer.dt == plant.dt
        and list(observer.fault_names) == list(design.options.get("faults") or [])
        and _are_residual_names(design)
        and all(delay == _delay(design) for delay in observer.fault_delays)
    )


def _are_residual_names(design: ObserverDesign) -> bool:
    """Whether residuals are numbered, for each set of faults anew where a name says for which: ``leak: r1``.

    Names that would be there twice are numbered once more, in front."""
    plant, observer = design.linear
    counts: dict[str, int] = {}
    for place, name in enumerate(observer.residual_names, 1):
        plain = name.removeprefix(f"{place}: ")
        label, _, own = plain.rpartition(": ")
        counts[label] = counts.get(label, 0) + 1
        is_numbered = own == f"r{counts[label]}" if plain == name else re.fullmatch(r"r[1-9]\d*", own)
        if not is_numbered or not _is_of_names(label, plant.fault_names):
            return False
    return True


def _is_of_names(text: str, names: Sequence[str]) -> bool:
    """Whether a text is names one after the other, with a blank between."""
    return not text or any(
        text == name or (text.startswith(f"{name} ") and _is_of_names(text[len(name) + 1 :], names)) for name in names
    )


def _states_asked_for(design: ObserverDesign) -> tuple[str, ...]:
    """Return the states asked for, in the order of the plant's."""
    names = design.options.get("states") or ()
    listed = (names,) if isinstance(names, str) else tuple(names)
    return tuple(name for name in design.linear[0].state_names if name in listed)


def _delay(design: ObserverDesign) -> int:
    return int(design.options.get("delay", 0)) + (int(design.options.get("mean", 1)) - 1) // 2


def _identities(
    plant: DescriptorSystem, observer: LinearObserver, t: FloatArray, t0: FloatArray
) -> Iterator[tuple[str, str, Identity]]:
    """Yield the identities that leave neither x, nor u, nor d in the error: name, claim, terms."""
    az, bu, by, cz, du, dy = observer.Az, observer.Bu, observer.By, observer.Cz, observer.Du, observer.Dy
    scaling = natural_scaling(plant)
    units = scaling.states
    # What cancels down to rounding is judged by the terms that it was formed of.
    size_t, size_t0 = (_in_equations(matrix, scaling.equations) for matrix in (t, t0))
    yield (
        "state in the error",
        "Az T E + By C = T A",
        Identity(
            (az @ (t @ plant.E), by @ plant.C, -t @ plant.A),
            ((az, t, plant.E), (by, plant.C), (size_t, plant.A), (az, t, plant.A)),
            units,
        ),
    )
    yield (
        "inputs in the error",
        "Bu + By D = T B",
        Identity((bu, by @ plant.D, -t @ plant.B), ((by, plant.D), (size_t, plant.B))),
    )
    yield (
        "unknown inputs in the error",
        "By Dd = T Bd",
        Identity((by @ plant.Dd, -t @ plant.Bd), ((by, plant.Dd), (size_t, plant.Bd))),
    )
    yield "algebraic rows", "T0 E = 0", Identity((t0 @ plant.E,), ((size_t0, plant.E), (size_t0, plant.A)), units)
    goal = np.zeros_like(t0)
    places = [plant.state_names.index(name) for name in observer.state_names]
    goal[range(len(places)), places] = 1.0
    yield (
        "state in the estimates",
        "Cz T E + Dy C = T0 A + the states estimated" if observer.state_names else "Cz T E + Dy C = T0 A",
        Identity(
            (cz @ (t @ plant.E), dy @ plant.C, -t0 @ plant.A, -goal),
            ((cz, t, plant.E), (dy, plant.C), (size_t0, plant.A), (cz, t, plant.A)),
            units,
        ),
    )
    yield (
        "inputs in the estimates",
        "Du + Dy D = T0 B",
        Identity((du, dy @ plant.D, -t0 @ plant.B), ((dy, plant.D), (size_t0, plant.B))),
    )
    yield (
        "unknown inputs in the estimates",
        "Dy Dd = T0 Bd",
        Identity((dy @ plant.Dd, -t0 @ plant.Bd), ((dy, plant.Dd), (size_t0, plant.Bd), (cz, t, plant.Bd))),
    )


def _in_equations(matrix: FloatArray, equations: FloatArray) -> FloatArray:
    """Return the largest entry of each row, in the units of each equation: what a row is made of."""
    sizes = np.max(np.abs(matrix) / equations, axis=1, initial=0.0)
    return np.asarray(np.outer(sizes, equations))


def _tracking(
    plant: DescriptorSystem, observer: LinearObserver, design: ObserverDesign
) -> Iterator[tuple[str, str, Identity]]:
    """Yield what the estimates make of faults that follow their models: each its own, and no other."""
    matrices = design.certificate.matrices
    pi, phi, cw = matrices["tracking"], matrices["Phi"], matrices["Cw"]
    errors = ErrorModel(plant, observer, matrices["T"], -matrices["T0"])
    direct = errors.output(slice(None))[1]
    # The filter's states are of like size: an entry that is nothing but rounding is judged beside them.
    largest = np.full_like(pi, np.max(np.abs(pi), initial=0.0))
    yield (
        "motion with the fault model",
        "Az Pi + (By Df - T Bf) Cw = Pi Phi",
        Identity((errors.Az @ pi, -errors.fault @ cw, -pi @ phi), ((observer.Az, largest), (largest, phi))),
    )
    if not observer.fault_names:
        return
    targets = wanted_faults(plant, observer, matrices, mean=int(design.options.get("mean", 1)))[observer.fault_rows]
    rows, units = observer.fault_rows, _model_units(plant, phi, cw)
    # How large each state is that the faults move, in the natural unit of each of these.
    moved = np.max(np.abs(pi) * units, axis=1, initial=0.0, keepdims=True) / units
    yield (
        "fault models",
        "the gain of each estimate for its own fault model is one, for all others zero",
        Identity(
            (observer.Cz[rows] @ pi, direct[rows] @ cw, -targets),
            ((observer.Cz[rows], moved), (np.abs(direct[rows]), cw)),
            units,
        ),
    )


def _model_units(plant: DescriptorSystem, phi: FloatArray, cw: FloatArray) -> FloatArray:
    """Return natural units of the states of the fault models ``(nw,)``: those of the faults that they make."""
    made = (cw != 0.0).astype(np.float64) @ reachable(phi) > 0.0
    units = np.max(np.where(made, PlantUnits.of(plant).rounded().faults[:, None], 0.0), axis=0, initial=0.0)
    return np.where(units > 0.0, units, 1.0)

"""The optimal filter: the delay, the filter of least gain, and what proves it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from obsynth.analysis.existence.condition import OPTIONS_PATH
from obsynth.errors import PreconditionError, SpecError
from obsynth.methods.method import Synthesis
from obsynth.methods.optimal_filter.certificate import certified
from obsynth.methods.optimal_filter.fault_maps import Designed, FaultMap, designed, first_problem
from obsynth.methods.optimal_filter.method import OptimalFilterMethod
from obsynth.methods.optimal_filter.realisation import followed, minimal, observer_of
from obsynth.methods.optimal_filter.reference import plain
from obsynth.methods.refusals import require_all_conditions
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.results.design import Certificate
from obsynth.verification.inequalities import stability_factor
from obsynth.verification.invisible_faults import seen_plant

#: A delay is taken when its least gain is at most this much above that of the longest one that was tried.
DELAY_ROOM = 1.05
#: Delays that are tried after the first one that exists.
MORE_DELAYS = 4


def synthesise(plant: DescriptorSystem, asked: OptimalFilterMethod, *, progress: Callable[[str], None]) -> Synthesis:
    """Design the filter; see `obsynth.optimal_filter` for the options, results and errors."""
    if asked.delay != "auto" and not plant.is_discrete:
        raise SpecError(
            "A delay in samples is for discrete time: give a reference model.", path=f"{OPTIONS_PATH}.delay"
        )
    progress("checking the existence conditions")
    require_all_conditions(asked.existence(plant))
    decoupled = asked.decoupled_names(plant)
    plant = seen_plant(plant, decoupled)
    progress("searching the least gain")
    curve, chosen = _chosen(plant, asked)
    progress("building the realisation and its certificate")
    fault_map, problem = chosen.fault_map, chosen.problem
    found = followed(plant, minimal(chosen.filter), problem.window + problem.shift)
    rows = len(found.C)
    names = plant.fault_names if rows == plant.nf else tuple(f"reference {i + 1}" for i in range(rows))
    observer = observer_of(plant, found, names, fault_map.delay or 0)
    matrices, claims = certified(plant, chosen, observer, found, asked.norm)
    matrices |= {"T": found.T, "T0": found.T0, "stability": stability_factor(observer)}
    reference = fault_map.reference
    if reference is not None:
        matrices |= {f"reference_{name}": part for name, part in zip("ABCD", reference, strict=True)}
    options: dict[str, Any] = {
        "delay": "auto" if fault_map.delay is None else fault_map.delay,
        "reference": None if reference is None else plain(reference),
        "norm": asked.norm,
        "exact": fault_map.exact,
        "decoupled": [*decoupled],
    }
    solver = {
        "engine": "filtering Riccati equation",
        "added_noise": chosen.added_noise,
        "trade_off": [[one.fault_map.delay, 0.0 if one.is_nothing else one.gain] for one in curve],
    }
    gains = {"T": found.T, "T0": found.T0}
    notes = tuple(_notes(curve, chosen, asked.norm))
    return Synthesis(options, gains, observer, Certificate(matrices, claims), solver=solver, notes=notes)


def _chosen(plant: DescriptorSystem, asked: OptimalFilterMethod) -> tuple[list[Designed], Designed]:
    """Return the delays that were looked at, and the one that is taken; a reference model has none."""
    fault_map, _ = first_problem(plant, asked)
    curve = [designed(plant, fault_map, asked.norm)]
    if fault_map.delay is None:
        return curve, curve[0]
    # A delay that was asked for is printed with what one sample more would give.
    more = MORE_DELAYS if asked.delay == "auto" else 1
    for delay in range(fault_map.delay + 1, fault_map.delay + 1 + more):
        if curve[-1].is_nothing:
            break
        try:
            curve.append(designed(plant, FaultMap(delay, None, True), asked.norm))
        except PreconditionError:
            break
    if asked.delay != "auto":
        return curve, curve[0]
    enough = max(DELAY_ROOM * min(one.gain for one in curve), curve[0].nothing)
    return curve, next(one for one in curve if one.gain <= enough)


def _notes(curve: list[Designed], chosen: Designed, norm: str) -> list[str]:
    notes = []
    if chosen.fault_map.delay is not None:
        listed = "; ".join(
            f"delay {one.fault_map.delay}: {'0' if one.is_nothing else f'{one.gain:.6g}'}" for one in curve
        )
        notes.append(f"Least {'gain' if norm == 'hinf' else 'root mean square'} by delay in samples: {listed}.")
    if chosen.added_noise:
        notes.append(
            "An output, or a combination of outputs, has no noise: the filter is the one for "
            f"{chosen.added_noise:g} of the plant's own sizes more on every output. State the noise of every sensor "
            "(sensor_noise) to close the gap between the gain and the least gain."
        )
    if chosen.is_nothing and norm == "hinf":
        notes.append(
            "The least gain is zero: with exact numbers nothing reaches the error; what is claimed is rounding."
        )
    return notes

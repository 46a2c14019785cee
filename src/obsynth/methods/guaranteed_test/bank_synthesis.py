"""Synthesis of a bank of guaranteed tests: for each fault the smallest group that can be isolated, and the least
threshold.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np

from obsynth.analysis.existence.condition import Condition, require_all
from obsynth.errors import SolverError
from obsynth.methods.guaranteed_test.bank import (
    BANK_GROUPS,
    BANK_PAIRS,
    BY_TEST,
    PAIR_MULTIPLIERS,
    PAIR_RADIUS,
    blind_to,
    blind_to_one,
    joined,
    pairs_of,
    proved_hidden,
)
from obsynth.methods.guaranteed_test.existence import conditions, detectability
from obsynth.methods.guaranteed_test.problem import problem_of
from obsynth.methods.guaranteed_test.synthesis import TRADE_OFF, chosen_samples, padded, synthesise
from obsynth.methods.method import Synthesis, silent
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.outward import upper_text
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.results.design import Certificate

#: Room for what another processor finds for the remainder: a share, and roundings of the signals.
SHARE_ROOM, REMAINDER_ROUNDINGS = 1e-6, 1024.0


def synthesise_bank(plant: DescriptorSystem, options: Any, *, progress: Callable[[str], None]) -> Synthesis:
    """Return one observer with a row for each fault, its certificate, and what an alarm of each row means."""
    require_all(conditions(plant, replace(options, isolate=False, fault=plant.fault_names[0]), with_windows=False))
    progress("searching for the smallest groups that can be isolated")
    smallest = [_smallest(plant, options, fault) for fault in range(plant.nf)]
    groups, lags, reasons = zip(*smallest, strict=True)
    if options.course == "any" and options.lag is None:
        options = replace(options, lag=max(lags))
    tests = [blind_to(options, plant, fault, group) for fault, group in enumerate(groups)]
    progress("searching for the least number of samples")
    tables = [_table(plant, test) for test in tests]
    samples = max(samples for samples, _ in tables)
    options = replace(options, samples=samples)
    progress(f"proving the thresholds on {samples} samples")
    made = [synthesise(plant, replace(test, samples=samples, lag=options.lag), progress=silent) for test in tests]
    pairs = _pairs(plant, options)
    matrices = _stacked([dict(test.certificate.matrices) for test in made]) | pairs
    matrices |= {
        BANK_GROUPS: np.array([[float(k in group) for k in range(plant.nf)] for group in groups]),
        TRADE_OFF: np.column_stack([tables[0][1][:, 0], *[table[:, 1] for _, table in tables]]),
    }
    claims = {
        f"{name}[{fault}]": value
        for fault, test in zip(plant.fault_names, made, strict=True)
        for name, value in test.certificate.claims.items()
    }
    shipped_options = {**made[0].options, "isolate": True, "fault": None, "free": "others"}
    gains = {
        f"{name}[{fault}]": gain
        for fault, test in zip(plant.fault_names, made, strict=True)
        for name, gain in test.gains.items()
    }
    observer = joined([test.observer for test in made], plant.fault_names)  # type: ignore[misc]
    notes = tuple(_bank_notes(plant, groups, reasons, claims, matrices[BANK_PAIRS]))
    return Synthesis(shipped_options, gains, observer, Certificate(matrices, claims), notes=notes)


def _smallest(plant: DescriptorSystem, options: Any, fault: int) -> tuple[tuple[int, ...], int, str]:
    """Return the smallest group with this fault that can be isolated, the lag, and why there is no smaller one."""
    other_faults = [other for other in range(plant.nf) if other != fault]
    why, first = "", None
    for size in range(len(other_faults) + 1):
        best: tuple[float, tuple[int, ...], int] | None = None
        candidates = list(combinations(other_faults, size))
        for chosen in candidates:
            group = tuple(sorted((fault, *chosen)))
            own = blind_to(options, plant, fault, group)
            condition, lag = detectability(problem_of(plant, own), own)
            if not condition.holds:
                first = first or condition
                why = why or condition.detail
                _require_proved(plant, replace(own, lag=own.lag if own.course != "any" else lag), condition)
                continue
            width = _table(plant, replace(own, lag=lag or own.lag))[1][-1, 1] if len(candidates) > 1 else 0.0
            if best is None or width < best[0]:
                best = (float(width), group, lag)
        if best is not None:
            return best[1], best[2], why
    if first is not None:
        first.require()
    raise SolverError(f"No test of {plant.fault_names[fault]} was found: the result is inconclusive.")


def _require_proved(plant: DescriptorSystem, own: Any, condition: Condition) -> None:
    if not proved_hidden(plant, own):
        raise SolverError(
            f"Whether {own.fault} can be distinguished from {', '.join(own.free)} is inconclusive: {condition.detail}"
        )


def _table(plant: DescriptorSystem, own: Any) -> tuple[int, FloatArray]:
    """Return the number of samples of a test alone, and its table of samples against thresholds."""
    samples, table, _ = chosen_samples(problem_of(plant, own), own, None)
    return samples, table


def _pairs(plant: DescriptorSystem, options: Any) -> dict[str, FloatArray]:
    """Return the thresholds of tests that are blind to one other fault alone, infinite where there are none."""
    pairs = pairs_of(plant)
    table, proofs = np.zeros((plant.nf, plant.nf)), []
    for fault, other in pairs:
        own = blind_to_one(options, plant, fault, other)
        condition, _ = detectability(problem_of(plant, own), own)
        if condition.holds:
            made = synthesise(plant, own, progress=silent)
            table[fault, other] = made.certificate.claims["threshold"]
            proofs.append(made.certificate.matrices)
        else:
            _require_proved(plant, own, condition)
            table[fault, other] = np.inf
            proofs.append({"multipliers": np.zeros(1), "multiplier_radius": np.zeros(1)})
    if not pairs:
        return {BANK_PAIRS: table}
    stacked = _stacked([dict(proof) for proof in proofs])
    return {BANK_PAIRS: table, PAIR_MULTIPLIERS: stacked["multipliers"], PAIR_RADIUS: stacked["multiplier_radius"]}


def _stacked(parts: list[dict[str, FloatArray]]) -> dict[str, FloatArray]:
    """Return by name a row for each test, as wide as the widest."""
    stacked = {}
    for name in BY_TEST:
        if not any(name in matrices for matrices in parts):
            continue
        stacked[name] = padded([np.ravel(matrices.get(name, np.zeros(1))) for matrices in parts])
    return stacked


def _bank_notes(
    plant: DescriptorSystem, groups: Any, reasons: Any, claims: Mapping[str, float], pairs: FloatArray
) -> Any:
    names = plant.fault_names
    for fault, (group, why) in enumerate(zip(groups, reasons, strict=True)):
        size, certain = claims[f"threshold[{names[fault]}]"], claims[f"surely_found[{names[fault]}]"]
        group_names = " or ".join(names[k] for k in group)
        no_smaller = f" No smaller group can be isolated: {why}" if why else ""
        yield (
            f"An alarm of {names[fault]} means {group_names}, as long as the bounds hold: threshold "
            f"{upper_text(size, 6)}, {upper_text(certain, 6)} is certain to be detected.{no_smaller}"
        )
        listed = [
            f"{names[other]}: {'impossible' if np.isinf(pairs[fault, other]) else upper_text(pairs[fault, other], 6)}"
            for other in range(plant.nf)
            if other != fault
        ]
        if len(listed) > 1:
            yield (
                f"Thresholds of {names[fault]} by a test that is insensitive to one other fault alone: "
                f"{'; '.join(listed)}."
            )

"""A bank of guaranteed tests: one row for each fault, blind to all others, or to all but the smallest group.

What is shipped is one observer and one certificate; each test is cut out of them again and checked as if it were alone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np

from obsynth.methods.guaranteed_test.checks import checks
from obsynth.methods.guaranteed_test.existence import samples_decided_on
from obsynth.methods.guaranteed_test.options import TestOptions
from obsynth.methods.guaranteed_test.problem import problem_of, window_as_designed
from obsynth.methods.guaranteed_test.proofs import proved_ray, proved_threshold, repaired_multipliers
from obsynth.methods.guaranteed_test.windows import courses_of
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.proofs.nearby_solutions import NearbySolution
from obsynth.results.checks import Check, lower_bound_check, upper_bound_check
from obsynth.results.design import Certificate, ObserverDesign

BANK_SOURCE = "each test alone, cut out of the bank"

#: What a certificate of a bank has a row of for each test, as wide as the widest.
BY_TEST = ("multipliers", "multiplier_radius", "witness", "witness_radius", "rounding")

#: Which faults an alarm of each test may mean; and the thresholds pair by pair, with what proves them.
BANK_GROUPS, BANK_PAIRS, PAIR_MULTIPLIERS, PAIR_RADIUS = "groups", "pairs", "pair_multipliers", "pair_radius"


def blind_to(options: Any, plant: DescriptorSystem, fault: int, group: Sequence[int]) -> Any:
    """Return the options of the test of a fault that is blind to all faults outside of a group."""
    names = plant.fault_names
    free = [name for k, name in enumerate(names) if k != fault and k not in group]
    return replace(options, isolate=False, fault=names[fault], free=free)


def blind_to_one(options: Any, plant: DescriptorSystem, fault: int, other: int) -> Any:
    """Return the options of the test of a fault that is blind to one other alone."""
    names = plant.fault_names
    return replace(options, isolate=False, fault=names[fault], free=[names[other]])


def proved_hidden(plant: DescriptorSystem, options: Any) -> bool:
    """Whether numbers that satisfy every equation exactly hide the fault: there is no test with these options."""
    problem = problem_of(plant, options)
    lag = options.lag or 0
    return proved_ray(problem.window(samples_decided_on(problem, options, lag), lag=lag)) is not None


def joined(parts: Sequence[LinearObserver], names: tuple[str, ...]) -> LinearObserver:
    """Return observers of one row each as one, their rows as residuals; shorter windows begin with zeros."""
    count, length = len(parts), max(part.order for part in parts)

    def stacked(name: str) -> FloatArray:
        blocks = [np.pad(getattr(part, name), ((0, length - part.order), (0, 0))) for part in parts]
        return np.vstack(blocks)

    first = np.zeros((1, length))
    first[0, :1] = 1.0
    return replace(
        parts[0],
        Az=np.asarray(np.kron(np.eye(count), np.eye(length, k=1)), dtype=np.float64),
        Bu=stacked("Bu"),
        By=stacked("By"),
        Cz=np.asarray(np.kron(np.eye(count), first), dtype=np.float64),
        Du=np.vstack([part.Du for part in parts]),
        Dy=np.vstack([part.Dy for part in parts]),
        fault_names=(),
        fault_delays=(),
        residual_names=names,
        constant=np.concatenate([part.added for part in parts]),
    )


def is_bank(design: ObserverDesign) -> bool:
    """Whether a design is a bank."""
    return design.options.get("isolate") is True


def groups_of(design: ObserverDesign) -> tuple[tuple[int, ...], ...]:
    """Return by test the numbers of the faults, its own among them, of which an alarm means that one is there."""
    return tuple(tuple(np.flatnonzero(row).tolist()) for row in design.certificate.matrices[BANK_GROUPS])


def tests_of(design: ObserverDesign, read: Callable[[Mapping[str, Any]], Any]) -> tuple[ObserverDesign, ...]:
    """Return the tests of a bank, each as a design of its own; ``read`` returns options that are checked."""
    plant, observer = design.linear
    options, certificate = read(design.options), design.certificate
    tests = []
    for fault, group in enumerate(groups_of(design)):
        own = blind_to(options, plant, fault, group)
        window = window_as_designed(plant, own)
        cut = {"witness": len(window.inner.bar), "witness_radius": len(window.inner.bar)}
        matrices = {
            name: certificate.matrices[name][fault][: cut.get(name)] for name in BY_TEST if name in certificate.matrices
        }
        if not np.any(matrices.get("witness", 0.0)):
            matrices = {name: value for name, value in matrices.items() if not name.startswith("witness")}
        length = len(window.weights(matrices["multipliers"].ravel())[0]) - 1
        name, registers = plant.fault_names[fault], observer.order // plant.nf
        ending = f"[{name}]"
        claims = {key.removesuffix(ending): value for key, value in certificate.claims.items() if key.endswith(ending)}
        table = certificate.matrices["trade_off"]
        tests.append(
            design.replace(
                name=f"test of {name}",
                options={field: getattr(own, field) for field in design.options},
                gains={key.removesuffix(ending): gain for key, gain in design.gains.items() if key.endswith(ending)},
                observer=_single_observer(observer, window, fault, registers, length),
                certificate=Certificate({**matrices, "trade_off": table[:, [0, fault + 1]]}, claims),
                notes=(),
            )
        )
    return tuple(tests)


def _single_observer(observer: LinearObserver, window: Any, fault: int, registers: int, length: int) -> LinearObserver:
    """Return the row of one test with its own registers, named as the test alone has it."""
    at, own = slice(fault * registers, fault * registers + length), [fault]
    estimated = window.test_problem.course != "step"
    name = (window.plant.fault_names[fault],)
    delay = length + 1 - window.test_problem.samples
    return replace(
        observer,
        Az=observer.Az[at, at],
        Bu=observer.Bu[at],
        By=observer.By[at],
        Cz=observer.Cz[own, at],
        Du=observer.Du[own],
        Dy=observer.Dy[own],
        fault_names=name if estimated else (),
        fault_delays=(window.test_problem.lag + delay,) if estimated else (),
        residual_names=() if estimated else name,
        constant=observer.added[own],
    )


def bank_checks(design: ObserverDesign, read: Callable[[Mapping[str, Any]], Any]) -> Iterator[Check]:
    """Yield the rows of every test, and those of what makes them a bank."""
    plant, observer = design.linear
    try:
        tests, reason = tests_of(design, read), ""
        fits = len(tests) == plant.nf and observer.residual_names == plant.fault_names
        fits = fits and all(fault in group for fault, group in enumerate(groups_of(design)))
        faults, gains = (
            {name.partition("[")[2].rstrip("]") for name in named}
            for named in (design.certificate.claims, design.gains)
        )
        fits = fits and faults == set(plant.fault_names) and gains <= faults
    # A file that was changed may hold anything: what cannot be cut is no bank.
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError, RuntimeError) as error:
        tests, fits, reason = (), False, str(error)
    yield upper_bound_check(
        "bank", "there is one test for each fault", float(not fits), 0.0, source="certificate", detail=reason
    )
    if not fits:
        return
    again = joined([test.linear[1] for test in tests], plant.fault_names)
    same = all(
        np.array_equal(value, getattr(observer, name)) if isinstance(value, np.ndarray)
        else value == getattr(observer, name)
        for name, value in again.as_dict().items()
    )  # fmt: skip
    yield upper_bound_check(
        "joined", "the rows that run are those of all tests", float(not same), 0.0,
        source="shipped realisation",
    )  # fmt: skip
    for test in tests:
        for row in checks(test, read):
            yield replace(row, name=f"{row.name}[{test.options['fault']}]")
    options = read(design.options)
    yield from _smallest_groups(design, options)
    yield from _pairs(design, options)


def hidden_by(design: ObserverDesign, read: Callable[[Mapping[str, Any]], Any], fault: int) -> dict[str, FloatArray]:
    """Return courses that hide a fault from every test of a group that is smaller by one; none where it is isolated."""
    plant, group = design.linear[0], groups_of(design)[fault]
    if len(group) == 1:
        return {}
    other_faults = [other for other in range(plant.nf) if other != fault]
    own = blind_to(read(design.options), plant, fault, other_faults[: len(group) - 2])
    problem = problem_of(plant, own)
    window = problem.window(samples_decided_on(problem, own, own.lag or 0), lag=own.lag or 0)
    point = proved_ray(window)
    return {} if point is None else courses_of(window, point)


def _smallest_groups(design: ObserverDesign, options: TestOptions) -> Iterator[Check]:
    plant = design.linear[0]
    for fault, group in enumerate(groups_of(design)):
        if len(group) == 1:
            continue
        other_faults = [other for other in range(plant.nf) if other != fault]
        smaller = [set(chosen) for chosen in combinations(other_faults, len(group) - 2)]
        unrefuted = sum(not proved_hidden(plant, blind_to(options, plant, fault, sorted(chosen))) for chosen in smaller)
        name = plant.fault_names[fault]
        yield upper_bound_check(
            f"smallest group[{name}]",
            f"no test of {name} is insensitive to more faults: the other faults can then hide it, by numbers that "
            "satisfy every equation exactly",
            float(unrefuted),
            0.0,
            source=BANK_SOURCE,
            kind="proved",
            detail="groups that are smaller by one and not refuted",
        )


def pairs_of(plant: DescriptorSystem) -> tuple[tuple[int, int], ...]:
    """Return all pairs of a fault and another, in the order of the certificate."""
    return tuple((fault, other) for fault in range(plant.nf) for other in range(plant.nf) if fault != other)


def _pairs(design: ObserverDesign, options: TestOptions) -> Iterator[Check]:
    """Yield the row on the table pair by pair; of two faults it is that of the tests themselves."""
    plant, shipped = design.linear[0], design.certificate.matrices
    pairs, wrong = pairs_of(plant), []
    table = shipped.get(BANK_PAIRS)
    fits = table is not None and table.shape == (plant.nf, plant.nf)
    for place, (fault, other) in enumerate(pairs if fits and table is not None else ()):
        own = blind_to_one(options, plant, fault, other)
        size = float(table[fault, other]) if table is not None else np.nan
        if np.isinf(size):
            holds = proved_hidden(plant, own)
        else:
            window = window_as_designed(plant, own)
            test = NearbySolution(shipped[PAIR_MULTIPLIERS][place], shipped[PAIR_RADIUS][place])
            zero, promised = size == 0.0, window.outer
            exact = repaired_multipliers(
                promised if zero else window, test.values, refine=False, exact_zero=zero, among=test.radius
            )
            holds = exact is not None and bool(np.all(exact.radius <= test.radius))
            holds = holds and proved_threshold(promised, test, exact_zero=zero) <= size
        if not holds:
            wrong.append(f"{plant.fault_names[fault]} insensitive to {plant.fault_names[other]}")
    yield lower_bound_check(
        "pairs",
        "thresholds pair by pair, and the pairs without a test, hold",
        float(len(pairs) - len(wrong)) if fits else np.nan,
        float(len(pairs)),
        source=BANK_SOURCE,
        kind="proved",
        detail=f"wrong: {', '.join(wrong)}" if wrong else "",
    )

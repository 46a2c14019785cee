"""A bank of guaranteed tests: one for each fault, blind to all others, or for the smallest group that can be told."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from obsynth.errors import PreconditionError, SpecError
from obsynth.files.tables import html_table, text_table
from obsynth.methods.guaranteed_test.result import GuaranteedTest, guaranteed_test
from obsynth.numerics.arguments import require_kind
from obsynth.plants.descriptor import DescriptorSystem

#: Options that the bank itself chooses.
_OWN = ("fault", "free", "name")


@dataclass(frozen=True, eq=False)
class GuaranteedBank:
    """Tests that isolate; made by `guaranteed_bank`.

    Parameters
    ----------
    tests : tuple of GuaranteedTest
        One for each fault that some test tells.
    groups : tuple of tuple of str
        By test: an alarm means that at least one of these faults is not zero; one fault where it is isolated.
    pairs : mapping of tuple of str to float
        Threshold of the test of the first fault that is blind to the second alone, whatever other faults are zero;
        infinite where there is none.
    refused : mapping of str to str
        By fault: why no test is blind to all others, in words.
    """

    tests: tuple[GuaranteedTest, ...]
    groups: tuple[tuple[str, ...], ...]
    pairs: Mapping[tuple[str, str], float]
    refused: Mapping[str, str]

    @property
    def isolates(self) -> bool:
        """Whether every fault has a test of its own."""
        return not self.refused

    def alarms(self, y: ArrayLike, u: ArrayLike | None = None) -> dict[str, np.ndarray]:
        """Return from which row on each test alarms over a record: truths ``(steps,)`` by fault or group in words.

        Parameters
        ----------
        y : array_like
            Outputs ``(steps, ny)``.
        u : array_like, optional
            Known inputs ``(steps, nu)``.

        Raises
        ------
        SpecError
            Shapes do not fit, or a sample is not finite.
        """
        outputs, found = np.asarray(y, dtype=np.float64), {}
        inputs = None if u is None else np.asarray(u, dtype=np.float64)
        for test, group in zip(self.tests, self.groups, strict=True):
            rows = test.residual(test.linear[1].run(outputs, inputs))
            passed = np.abs(np.nan_to_num(rows)) > test.threshold + test.slack(outputs, inputs)
            found[f"{test.fault}: {' or '.join(group)}" if len(group) > 1 else test.fault] = np.maximum.accumulate(
                passed
            )
        return found

    def rows(self) -> tuple[tuple[str, ...], ...]:
        """Return the table as texts: the header, then a row for each test."""
        faults = sorted({first for first, _ in self.pairs})
        header = ("test of", "an alarm means", "threshold", "surely found", *(f"blind to {name}" for name in faults))
        found = []
        for test, group in zip(self.tests, self.groups, strict=True):
            pairs = [self.pairs.get((test.fault, other), np.nan) for other in faults]
            found.append((
                test.fault, " or ".join(group), f"{test.threshold:.4g}", f"{test.surely_found:.4g}",
                *("-" if np.isnan(size) else "impossible" if np.isinf(size) else f"{size:.4g}" for size in pairs),
            ))  # fmt: skip
        return (header, *found)

    def __str__(self) -> str:
        return "\n".join([*text_table(self.rows(), left=2), *(f"{k}: {why}" for k, why in self.refused.items())])

    def _repr_html_(self) -> str:
        return html_table(self.rows()) + "".join(f"<p>{escape(f'{k}: {w}')}</p>" for k, w in self.refused.items())


def guaranteed_bank(plant: DescriptorSystem, faults: Sequence[str] | None = None, **options: Any) -> GuaranteedBank:
    """Design tests that isolate faults without ever being wrong, as long as the bounds hold.

    Each test is blind to all other faults, so that its alarm means that its own fault is not zero.  Where blindness is
    impossible, it is blind to as many as can be: its alarm then means one of the smallest group that can be told.

    Parameters
    ----------
    plant : DescriptorSystem
        Discrete time.
    faults : sequence of str, optional
        Faults to isolate; all by default.
    **options
        Those of `guaranteed_test`, but for ``fault``, ``free`` and ``name``.

    Returns
    -------
    GuaranteedBank
        With the thresholds pair by pair.

    Raises
    ------
    SpecError
        An option is malformed, or a fault unknown.
    PreconditionError
        Not even the group of all faults can be told from none.
    """
    require_kind(plant, DescriptorSystem, "plant", "a DescriptorSystem")
    wrong = [name for name in _OWN if name in options]
    if wrong:
        raise SpecError(f"{', '.join(wrong)}: the bank chooses this itself.", path=wrong[0])
    asked = plant.fault_names if faults is None else tuple(faults)
    unknown = [str(name) for name in asked if name not in plant.fault_names]
    if unknown:
        raise SpecError(f"There is no fault {', '.join(unknown)}: {', '.join(plant.fault_names)}.", path="faults")
    tests, groups, refused = [], [], {}
    for fault in asked:
        others = [name for name in plant.fault_names if name != fault]
        test, group, why = _smallest(plant, fault, others, options)
        tests.append(test)
        groups.append(group)
        if why:
            refused[fault] = why
    pairs = {
        (fault, other): _threshold(plant, fault, [other], options)
        for fault in asked for other in plant.fault_names if other != fault
    }  # fmt: skip
    return GuaranteedBank(tuple(tests), tuple(groups), pairs, refused)


def _smallest(
    plant: DescriptorSystem, fault: str, others: list[str], options: Mapping[str, Any]
) -> tuple[GuaranteedTest, tuple[str, ...], str]:
    """Return the test of a fault with the smallest group that its alarm stands for, and why there is no smaller one."""
    first: PreconditionError | None = None
    for size in range(len(others) + 1):
        best: tuple[GuaranteedTest, tuple[str, ...]] | None = None
        for with_it in combinations(others, size):
            try:
                test = guaranteed_test(
                    plant,
                    fault,
                    free=[name for name in others if name not in with_it],
                    name=f"test of {fault}",
                    **options,
                )
            except PreconditionError as error:
                first = first or error
                continue
            if best is None or test.threshold < best[0].threshold:
                best = test, (fault, *with_it)
        if best is not None:
            return *best, "" if first is None else str(first)
    raise first if first is not None else PreconditionError(f"No test tells {fault}.", condition="fault told")


def _threshold(plant: DescriptorSystem, fault: str, free: list[str], options: Mapping[str, Any]) -> float:
    try:
        return guaranteed_test(plant, fault, free=free, **options).threshold
    except PreconditionError:
        return np.inf

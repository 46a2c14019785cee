"""Sensors, sample time and number of samples with which a fault of a given size is detected by a guaranteed test."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from math import comb
from typing import Any

from obsynth.analysis.diagnosis.candidate_sensors import Sensor, with_sensors
from obsynth.errors import PreconditionError, SpecError
from obsynth.methods.guaranteed_test.result import GuaranteedTest, guaranteed_test
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.transformations.sampling import discretise

#: Sets are tried in the order of their cost; more than these are too many.
MOST_TRIED_SETS = 4096


@dataclass(frozen=True, eq=False)
class ThresholdProblem:
    """What must be found: a fault whose least threshold is at most ``below``; ``test``: options of the test."""

    plant: DescriptorSystem
    fault: str
    below: float
    sensors: tuple[Sensor, ...]
    costs: Sequence[float]
    sample_times: tuple[float, ...]
    test: Mapping[str, Any]

    def best(self, chosen: Sequence[int]) -> GuaranteedTest | None:
        """Return the test with the fewest seconds that goes below with some sensors; ``None`` where none does."""
        tests = [test for test in self._tests(chosen) if test.threshold <= self.below]
        return min(tests, key=lambda test: (test.delay, test.threshold)) if tests else None

    def least(self, chosen: Sequence[int]) -> float:
        """Return the least threshold with some sensors."""
        return min((test.threshold for test in self._tests(chosen)), default=float("inf"))

    def _tests(self, chosen: Sequence[int]) -> Iterator[GuaranteedTest]:
        equipped = with_sensors(self.plant, [self.sensors[i] for i in chosen])
        for seconds in self.sample_times or (None,):
            plant = equipped if seconds is None else discretise(equipped, seconds).plant
            try:
                test = guaranteed_test(plant, self.fault, **self.test)
            except PreconditionError:
                continue
            enough = test.trade_off[test.trade_off[:, 1] <= self.below]
            if len(enough) and int(enough[0, 0]) != test.samples:
                # The fewest samples that go below, not those within 5 % of the last.
                test = guaranteed_test(plant, self.fault, **{**self.test, "samples": int(enough[0, 0])})
            yield test

    def minimal_sets(self, largest: int | None, most: int) -> list[tuple[tuple[int, ...], GuaranteedTest]]:
        """Return the inclusion-minimal sets, cheapest first: more sensors never raise a least threshold."""
        count = len(self.sensors)
        sizes = range(min(count, count if largest is None else largest) + 1)
        if sum(comb(count, size) for size in sizes) > MOST_TRIED_SETS:
            raise SpecError(
                f"{count} candidates have more than {MOST_TRIED_SETS} sets: give fewer candidates, or largest.",
                path="candidates",
            )
        sets = [chosen for size in sizes for chosen in combinations(range(count), size)]
        minimal: list[tuple[tuple[int, ...], GuaranteedTest]] = []
        for chosen in sorted(sets, key=lambda each: (sum(self.costs[i] for i in each), len(each))):
            if any(set(smaller) <= set(chosen) for smaller, _ in minimal):
                continue
            test = self.best(chosen)
            if test is not None:
                minimal.append((chosen, test))
            if len(minimal) == most:
                break
        return minimal

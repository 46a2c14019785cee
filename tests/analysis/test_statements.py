"""Statements about a plant, decided in rational arithmetic, in enclosures and in floating point."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

import obsynth
from obsynth import DescriptorSystem, discretise
from obsynth.analysis.existence.condition import Condition
from obsynth.analysis.existence.plant_numbers import SystemFacts
from obsynth.analysis.existence.statements import Evaluator, FullRank, NoZeroOutside
from obsynth.analysis.existence.witnesses import Unclear

SOURCE = Path(obsynth.__file__).parent
RNG = np.random.default_rng(5)
#: Integers, with a row of E that is zero, an output that repeats another and an unknown input that is twice another.
PLANT = DescriptorSystem(
    np.diag([1, 1, 0]), RNG.integers(-2, 3, (3, 3)) + np.eye(3), C=[[1, 0, 2], [2, 0, 4]], Bf=[[1], [0], [1]],
    Df=[[0], [1]], Bd=[[1, 2], [0, 0], [1, 2]], dt=1.0,
)  # fmt: skip


def matrix_of(said: FullRank) -> np.ndarray:
    """The matrix of a statement, put together by numpy alone."""
    rows = [[None if name is None else getattr(PLANT, name)[:, said.columns.get(name, slice(None))] for name in row]
            for row in said.blocks]  # fmt: skip
    heights = [next(part.shape[0] for part in row if part is not None) for row in rows]
    widths = [next(row[j].shape[1] for row in rows if row[j] is not None) for j in range(len(rows[0]))]
    filled = [np.hstack([np.zeros((h, w)) if part is None else part for part, w in zip(row, widths, strict=True)])
              for row, h in zip(rows, heights, strict=True)]  # fmt: skip
    filled[-1] = filled[-1] if said.last_rows is None else filled[-1][list(said.last_rows)]
    return np.vstack(filled)


@pytest.mark.parametrize(
    "said",
    [
        FullRank([["E"], ["C"]]),
        FullRank([["C"]], of_rows=True),
        FullRank([["E"], ["C"], ["A"]], last_rows=[2]),
        FullRank([["Bd"], ["Dd"]], columns={"Bd": [1], "Dd": [1]}),
        FullRank([["Bd"], ["Dd"]]),
        FullRank([["E", None, "Bd"], ["C", "Df", None]]),
        NoZeroOutside("Bf").at_zero,
    ],
)
@pytest.mark.parametrize("exactly", [True, False])
def test_a_rank_is_that_of_the_blocks(said: FullRank, exactly: bool) -> None:
    judge, matrix = Evaluator(PLANT, exactly), matrix_of(said)
    rank = int(np.linalg.matrix_rank(matrix))
    assert np.array_equal(judge.arranged(said, PLANT), matrix)
    assert judge.exact_rank(said) == (rank if exactly else None)
    decision = judge.rank(said)
    assert (decision.rank, decision.expected) == (rank, matrix.shape[0 if said.of_rows else 1])
    assert decision.means == ("exact" if exactly else "tolerance")


def judge_of(zero: float, *, exactly: bool = True, sampled: bool = False) -> Evaluator:
    """What decides about a plant whose fault has one zero."""
    plant = DescriptorSystem(np.eye(2), [[0, 1], [0, 0.1]], C=[[-zero, 1]], Bf=[[0], [1]], dt=0.0 if sampled else 0.1)
    return Evaluator(discretise(plant, 0.1).plant if sampled else plant, exactly)


def told_by(judge: Evaluator) -> Condition:
    """What it says of the zeros."""

    def told(facts: SystemFacts) -> Condition:
        return Condition("zeros", "inside", not facts.outside, len(facts.outside), 0.0, "", "told")

    return judge.no_zero_outside(NoZeroOutside("Bf"), holding=told, lost=told, what="filter")


def test_the_evaluator_says_how_it_decided() -> None:
    assert told_by(judge_of(0.5)).detail.endswith("exactly, on the numbers as written")
    assert told_by(judge_of(-5.0, sampled=True)).detail.endswith("to hundreds of digits of the sampled plant")
    assert told_by(judge_of(0.5, exactly=False)).detail == "told"
    for exactly in (True, False):
        lost = told_by(judge_of(1.5, exactly=exactly))
        assert not lost.holds
        assert lost.unclear is None


def test_what_rounding_could_change_is_unclear_and_another_plant_within_it_has_the_other_answer() -> None:
    judge = judge_of(1.0 - 1e-15)
    found = told_by(judge)
    assert not found.holds
    assert found.detail.startswith("A filter exists for the numbers as written (exactly, on the numbers as written)")
    assert isinstance(found.unclear, Unclear)
    assert found.unclear.witness is not None
    assert judge.verdict(NoZeroOutside("Bf")).answer == "unclear"
    assert Evaluator(found.unclear.witness.plant(judge.plant)).verdict(NoZeroOutside("Bf")).answer == "no"


def test_nothing_behind_the_arguments_steers_a_verdict() -> None:
    """The one context variable is about the files that a spec reads."""
    users = [file.relative_to(SOURCE).as_posix() for file in SOURCE.rglob("*.py") if re.search(
        r"\bContextVar\b|\bthreading\.local\b", file.read_text(encoding="utf-8"))]  # fmt: skip
    assert users == ["files/inputs.py"]

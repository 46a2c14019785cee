"""What all tests share: how many of the cases drawn at random a run looks at, and which tests other machines run.

Tests marked ``long`` take seconds and are left to `.ci/run`, or to who names them.

`.ci/run` takes the tests marked ``sampled`` once more with the cases that were left out (``--rest``), and those marked
``numerics`` with other processors' kernels and with the oldest dependencies: of each the share whose turn it is
(``--turn``), drawn by the commit, so that its time does not grow and two or three dozen commits see them all.
"""

from __future__ import annotations

import gc
import zlib
from collections import defaultdict
from collections.abc import Callable, Generator, Sequence
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

#: Examples of each property with ``--whole`` or ``--rest``, and without: CI runs both.
EXAMPLES, FEWER = 15, 5
#: Without ``--whole`` or ``--rest`` one of so many cases that are drawn at random is looked at.
PARTS = 4
#: With ``--turn`` one of so many tests is run, drawn by its argument.
TURNS = 12
#: Files of tests that decide something numerically.
NUMERIC = frozenset({
    "test_balls.py", "test_ball_arithmetic.py", "test_certain_covariance.py", "test_compiled_run.py",
    "test_continuous_norms.py", "test_corrupted_functional_filters.py", "test_corrupted_pd_designs.py",
    "test_corrupted_ui_pi_designs.py", "test_dae_engines.py", "test_definiteness.py", "test_exact_existence.py",
    "test_exact_tests.py", "test_existence_again.py", "test_filasova.py", "test_guaranteed_alarms.py",
    "test_guaranteed_intervals.py", "test_guaranteed_monitors.py", "test_guaranteed_nonlinear.py",
    "test_guaranteed_test.py",
    "test_guaranteed_tolerances.py", "test_guaranteed_varying.py", "test_least_beside.py", "test_hard_structures.py",
    "test_kalman_unknown_inputs.py", "test_lmi.py", "test_matrix_equations.py", "test_norms.py",
    "test_other_machines.py", "test_pd_observer.py",
    "test_pencils.py", "test_placement.py", "test_platforms.py", "test_polish.py",
    "test_random_ui_pi_units.py", "test_recursive_conditions.py", "test_refuted_levels.py", "test_riccati.py",
    "test_rounding_of_plants.py", "test_scaling.py", "test_sharepasand.py", "test_singular_covariances.py",
    "test_steady_filter.py", "test_ui_pi_edges.py", "test_ui_pi_units.py", "test_wang2015.py", "test_weight_limit.py",
    "test_witnesses.py", "test_zeros.py",
})  # fmt: skip


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--whole", action="store_true", help="all cases of the tests marked sampled, not a share of them")
    parser.addoption(
        "--rest", action="store_true", help="the cases of the tests marked sampled that a run without it leaves out"
    )
    parser.addoption("--turn", default="", help="run the share of the tests that this text draws, a commit for example")


def pytest_configure(config: pytest.Config) -> None:
    """Take one profile for every property: the same examples in each run, and no clock in the verdict."""
    settings.register_profile(
        "obsynth",
        deadline=None,
        derandomize=True,
        database=None,
        max_examples=EXAMPLES if config.option.whole or config.option.rest else FEWER,
        suppress_health_check=[HealthCheck.too_slow],
    )
    settings.load_profile("obsynth")


@pytest.hookimpl(wrapper=True)
def pytest_collection(session: pytest.Session) -> Generator[None, object, object]:
    """Collect no garbage while tests are collected, nor look at them again in each collection that follows.

    Everything that is made there is kept, and a quarter of its time went to looking for what is not.
    """
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """With ``-m numerics`` the others are not even read: they may need what the oldest dependencies go without."""
    is_test = collection_path.suffix == ".py" and collection_path.name.startswith("test_")
    return True if config.option.markexpr == "numerics" and is_test and collection_path.name not in NUMERIC else None


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    for item in items:
        if item.path.name in NUMERIC:
            item.add_marker(pytest.mark.numerics)
        drawn = getattr(getattr(item, "function", None), "is_hypothesis_test", False)
        if drawn or "share" in getattr(item, "fixturenames", ()) or item.get_closest_marker("long"):
            item.add_marker(pytest.mark.sampled)
    left_out = _left_out(config, items) | _whose_turn_it_is_not(config.option.turn, items)
    config.hook.pytest_deselected(items=list(left_out))
    items[:] = [item for item in items if item not in left_out]


def _left_out(config: pytest.Config, items: Sequence[pytest.Item]) -> set[pytest.Item]:
    """Return the tests marked ``long`` and the cases of those marked ``one_in`` that this run leaves out."""
    cases: dict[str, list[pytest.Item]] = defaultdict(list)
    for item in items:
        if item.get_closest_marker("one_in"):
            item.add_marker(pytest.mark.sampled)
            cases[item.nodeid.partition("[")[0]].append(item)
    looks_at_long = config.option.whole or config.option.rest
    found = {item for item in items if item.get_closest_marker("long") and not looks_at_long}
    for test, same in cases.items():
        parts = max(item.get_closest_marker("one_in").args[0] for item in same)
        # Not the first of each test: these are often alike.
        first = zlib.crc32(test.encode()) % parts
        found.update(set(same) - set(looked_at(same[first:] + same[:first], parts, config)))
    # A case that is named on the command line is run.
    return {item for item in found if item.nodeid not in config.args}


def _whose_turn_it_is_not(turn: str, items: Sequence[pytest.Item]) -> set[pytest.Item]:
    """Return the tests that a turn leaves out; none without one."""
    return {item for item in items if turn and zlib.crc32(f"{turn} {item.nodeid}".encode()) % TURNS}


def looked_at(cases: Sequence[Any], parts: int, config: pytest.Config) -> Sequence[Any]:
    """Return the cases of a family that this run looks at: one in ``parts``, the others (``--rest``) or all."""
    if config.option.whole:
        return cases
    others = [case for number, case in enumerate(cases) if number % parts]
    return others or cases if config.option.rest else cases[::parts]


@pytest.fixture
def taken_as_verified(monkeypatch: pytest.MonkeyPatch) -> None:
    """Designs are made without their verification: for tests of what runs, of which it would be most of the time."""
    from obsynth.results.checks import upper_bound_check
    from obsynth.results.verification_report import VerificationReport

    row = upper_bound_check("not checked", "taken as verified by a test", 0.0, 1.0, source="tests")
    monkeypatch.setattr("obsynth.methods.designing.verify", lambda _, **__: VerificationReport((row,)))


@pytest.fixture(scope="session")
def share(pytestconfig: pytest.Config) -> Callable[..., Sequence[Any]]:
    """Return the cases of a family that this run looks at: one in ``parts``, the others (``--rest``) or all.

    Where a test judges its cases ``together``, by a count, the others alone would be another test: it takes all.
    """

    def taken(cases: Sequence[Any], parts: int = PARTS, *, together: bool = False) -> Sequence[Any]:
        return cases if together and pytestconfig.option.rest else looked_at(cases, parts, pytestconfig)

    return taken

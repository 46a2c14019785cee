"""What all tests share: how many of the plants that are drawn at random a run looks at."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import pytest

#: Without ``--whole`` one of so many cases that are drawn at random is looked at.
PARTS = 4


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--whole", action="store_true", help="all random plants of the property tests, not every fourth (ten minutes)"
    )


@pytest.fixture(scope="session")
def share(pytestconfig: pytest.Config) -> Callable[..., Sequence[Any]]:
    """Return the cases of a family that this run looks at: all with ``--whole``, else every fourth."""
    whole = pytestconfig.getoption("--whole")

    def taken(cases: Sequence[Any], parts: int = PARTS) -> Sequence[Any]:
        return cases if whole else cases[::parts]

    return taken

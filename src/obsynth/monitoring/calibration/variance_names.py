"""Names of variances of equations (Q) and sensors (R), with their letter where an equation and a sensor share one."""

from __future__ import annotations

from collections.abc import Iterable, Sequence


def variance_names(equations: Sequence[str], sensors: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return a name for the variance of each equation and of each sensor, all of them different."""
    shared = set(equations) & set(sensors)
    q, r = (
        [f"{letter} of {name}" if name in shared else name for name in names]
        for letter, names in (("Q", equations), ("R", sensors))
    )
    return q, r


def limited_names(limits: Iterable[str], letter: str, names: Iterable[str], other_names: Iterable[str]) -> set[str]:
    """Return the equations or sensors (``names``, of this ``letter``) whose variances are among ``limits``."""
    limited, shared = set(limits), set(other_names)
    return {name for name in names if (f"{letter} of {name}" if name in shared else name) in limited}


def with_letter(name: str, sensors: Iterable[str]) -> str:
    """Return the name of a variance with its letter."""
    return name if name.startswith(("Q of ", "R of ")) else f"{'R' if name in set(sensors) else 'Q'} of {name}"

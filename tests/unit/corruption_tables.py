"""What every table of corrupted designs must show; a table maps a case to a good design, a corruption, and the rows
that then fail.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence

from obsynth import ObserverDesign, VerificationReport, verify

Corruption = Callable[[ObserverDesign], ObserverDesign]
Table = Mapping[str, tuple[str, Corruption, Sequence[str]]]
Maker = Callable[[str], ObserverDesign]


def assert_exactly_the_untrue_rows_fail(table: Table, case: str, good: Maker) -> None:
    name, corrupt, expected = table[case]
    report = verify(corrupt(good(name)))
    assert {check.name for check in report.failures} == set(expected)
    assert not report.passed


def rows_that_decide(report: VerificationReport) -> set[str]:
    return {check.name for check in report.checks if check.kind != "information"}


def assert_every_row_is_broken(table: Table, names: Iterable[str], good: Maker) -> None:
    produced = set().union(*(rows_that_decide(good(name).report) for name in names))
    for name, corrupt, _ in table.values():
        produced |= rows_that_decide(verify(corrupt(good(name))))
    broken = set().union(*(expected for _, _, expected in table.values()))
    assert broken == produced


def assert_information_does_not_fail(table: Table, good: Maker) -> None:
    for name, corrupt, _ in table.values():
        report = verify(corrupt(good(name)))
        assert all(check.passed for check in report.checks if check.kind == "information")
        assert len({check.name for check in report.checks}) == len(report.checks)

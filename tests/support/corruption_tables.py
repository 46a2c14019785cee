"""What every table of corrupted designs must show; a table maps a case to a good design, a corruption, and the rows
that then fail.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from obsynth import Certificate, DescriptorSystem, ObserverDesign, VerificationReport, verify
from obsynth.methods.designing import with_stored_errors

#: What no number of a design breaks: a wrong error model is the method's, see `test_every_method`.
OF_THE_METHOD = {"error model"}

Corruption = Callable[[ObserverDesign], ObserverDesign]
Table = Mapping[str, tuple[str, Corruption, Sequence[str]]]
Maker = Callable[[str], ObserverDesign]


def assert_exactly_the_untrue_rows_fail(table: Table, case: str, good: Maker) -> None:
    """One verification of a case says what fails, that information does not, and that the table breaks all else."""
    name, corrupt, expected = table[case]
    report = verify(corrupt(good(name)))
    assert {check.name for check in report.failures} == set(expected)
    assert not report.passed
    assert all(check.passed for check in report.checks if check.kind == "information")
    assert len({check.name for check in report.checks}) == len(report.checks)
    assert_every_row_is_broken(table, report)


def assert_every_row_is_broken(table: Table, *reports: VerificationReport) -> None:
    """Every row that decides fails in a case of the table, where `assert_exactly_the_untrue_rows_fail` sees it."""
    broken = set().union(*(expected for _, _, expected in table.values()))
    produced = {check.name for report in reports for check in report.checks if check.kind != "information"}
    assert produced - OF_THE_METHOD <= broken


# A plant that is slow, of which the last digits of an observer matter.


def slow_plant(dt: float) -> DescriptorSystem:
    """Two states in a row, each of which takes a million time constants of the fault: a unit fault moves them by 1e12
    and 1e6 in the end."""
    a = np.array([[-1e-6, 1.0], [0.0, -1e-6]])
    return DescriptorSystem(A=a + np.eye(2) * (dt > 0.0), C=[[1.0, 0.0]], Bf=[[0.0], [1.0]], dt=dt)


#: Of the largest entry of a row.
SMALL = 1e-12


def last_digits(design: ObserverDesign) -> ObserverDesign:
    """By is off in its last digits; what is claimed of stored numbers is made to fit, letters that are By are gone."""
    by = np.array(design.observer.By)
    by[:, 0] += SMALL * np.max(np.abs(by), axis=1) * (-1.0) ** np.arange(len(by))
    changed = with_observer(design, By=by)
    kept = {name: m for name, m in design.certificate.matrices.items() if not name.endswith("_error")}
    gains = {} if design.method == "fault-estimation-filter" else design.gains
    changed = changed.replace(gains=gains, certificate=Certificate(kept, design.certificate.claims))
    with np.errstate(all="ignore"):
        return with_stored_errors(changed)


# Ways to corrupt a design, and what then fails.


def failed(design: ObserverDesign, **options: int) -> set[str]:
    return {check.name for check in verify(design, **options).failures}


def nudged(matrix: np.ndarray, row: int, column: int, by: float = 1e-6) -> np.ndarray:
    changed = np.array(matrix)
    changed[row, column] += by
    return changed


def scattered(shape: tuple[int, ...]) -> list[tuple[int, ...]]:
    """Return the places of a matrix in an order drawn once: each share of them is spread over rows and columns."""
    places = list(np.ndindex(shape))
    return [places[i] for i in np.random.default_rng(1).permutation(len(places))]


def with_observer(design: ObserverDesign, **changes: object) -> ObserverDesign:
    return design.replace(observer=dataclasses.replace(design.observer, **changes))


def shipped(**changes: object) -> Corruption:
    """Other fields of the observer."""
    return lambda design: with_observer(design, **changes)


def entry(name: str, row: int, column: int, by: float = 1e-6) -> Corruption:
    """One entry of the observer."""
    return lambda design: with_observer(design, **{name: nudged(getattr(design.observer, name), row, column, by)})


def with_plant(design: ObserverDesign, **changes: object) -> ObserverDesign:
    return design.replace(plant=design.plant.replace(**changes))


def with_certificate(
    design: ObserverDesign, claims: Mapping[str, float] | None = None, **matrices: np.ndarray
) -> ObserverDesign:
    old = design.certificate
    return design.replace(certificate=Certificate({**old.matrices, **matrices}, {**old.claims, **(claims or {})}))


def claim(name: str, value: float) -> Corruption:
    return lambda design: with_certificate(design, {name: value})


def claim_times(name: str, factor: float) -> Corruption:
    return lambda design: with_certificate(design, {name: factor * design.certificate.claims[name]})


def without_claim(name: str) -> Corruption:
    def corrupt(design: ObserverDesign) -> ObserverDesign:
        claims = {key: value for key, value in design.certificate.claims.items() if key != name}
        return design.replace(certificate=Certificate(design.certificate.matrices, claims))

    return corrupt

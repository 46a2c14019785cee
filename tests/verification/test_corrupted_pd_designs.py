"""The corruption table of the PD observer: a row of its report fails when, and only when, what it claims is untrue."""

from __future__ import annotations

import random
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from corruption_tables import (
    Corruption,
    assert_every_row_is_broken,
    assert_exactly_the_untrue_rows_fail,
    claim,
    entry,
    failed,
    last_digits,
    nudged,
    slow_plant,
    with_certificate,
    with_observer,
    with_plant,
    without_claim,
)

from obsynth import Certificate, DescriptorSystem, ObserverDesign, SpecError, design_from_gains, pd_observer, verify
from obsynth.proofs.balls import Ball
from obsynth.specs.loader import load_spec
from obsynth.verification.claims import WITNESS_CLAIMS
from obsynth.verification.inequalities import prove_gain

PAPER = Path(__file__).parents[2] / "designs" / "filasova" / "spec.yaml"

DYNAMICS, INPUTS, ESTIMATES = "unbiased: dynamics", "unbiased: inputs", "unbiased: estimates"
RESIDUAL, FEEDTHROUGH = "unbiased: residual", "unbiased: feedthrough"
GAINS, DET, ERRORS, DECAY, DISK, PAIR = (
    "gains", "det(I + L C)", "error system", "decay rate", "disk", "descriptor pair",
)  # fmt: skip
P1, Q, LMI, RANGE, LMI_RATE, LMI_NOISE = "P1", "Q", "LMI", "adaptation range", "LMI, rate", "LMI, noise"
RATE, NOISE, BOUND = (
    "fault rate in the fault estimate", "noise and its derivative in the fault estimate", "gain bound",
)  # fmt: skip
FITS = "fits the plant"

# The good designs.


def paper() -> DescriptorSystem:
    """The paper's example, unstable."""
    return load_spec(PAPER).plant


def direct() -> DescriptorSystem:
    """Feedthrough of input, fault and disturbance, and sensor noise; one fault is that of a sensor."""
    return DescriptorSystem(
        None,
        [[-0.7, 0.2, 0], [-0.1, 0.8, 0.3], [0.2, 0.1, -1]],
        [[1], [0.5], [0.2]],
        [[1, 0, 0], [0, 0, 1], [1, 1, 0]],
        D=[[0.3], [0.4], [-0.2]],
        Bf=[[0, 1], [0, 0.3], [0, 0]],
        Df=[[1, 0], [0, 0.1], [0, 0]],
        Bd=[[0.3], [0.1], [0.2]],
        Dd=[[0.1], [0], [0.2]],
        Bw=0.01 * np.eye(3),
        Dw=0.01 * np.ones((3, 3)),
    )


def single() -> DescriptorSystem:
    """Two states, one output, one fault."""
    return DescriptorSystem(None, [[0.5, 1.0], [0.0, -1.0]], [[0.0], [1.0]], [[1.0, 0.0]], Bf=[[0.0], [1.0]])


GOOD: dict[str, Callable[[], ObserverDesign]] = {
    "paper": lambda: pd_observer(paper(), delta=0.1, decay=0.0),
    "second theorem": lambda: pd_observer(paper(), theorem=2, decay=0.5),
    "bounds": lambda: pd_observer(
        paper(), delta=0.1, decay=1.0, gain_bound=60.0, fault_rate_gain=0.5, noise_gain=3.0, disk=[20.0, 19.5]
    ),
    "range": lambda: pd_observer(paper(), delta=0.1, decay=0.0, adaptation_range=[1.0, 12.0]),
    "direct": lambda: pd_observer(direct(), adaptation_gain=[[2.0, 0.5], [0.0, 3.0]]),
    "single": lambda: pd_observer(single(), decay=0.0),
}


@cache
def good(name: str) -> ObserverDesign:
    return pd_observer(slow_plant(0.0), decay=1.0) if name == "slow" else GOOD[name]()


# Ways to corrupt a design.


def asked(**changes: object) -> Corruption:
    return lambda design: design.replace(options={**design.options, **changes})


def plant_entry(name: str, row: int, column: int, by: float = 1e-6) -> Corruption:
    return lambda design: with_plant(design, **{name: nudged(getattr(design.plant, name), row, column, by)})


def gain_entry(name: str, row: int, column: int, by: float = 1e-6) -> Corruption:
    return lambda design: design.replace(
        gains={**design.gains, name: nudged(design.gains[name], row, column, by)}
    )  # fmt: skip


def gains(**changes: object) -> Corruption:
    return lambda design: design.replace(gains={**design.gains, **changes})


def without_gain(name: str) -> Corruption:
    return lambda design: design.replace(gains={key: value for key, value in design.gains.items() if key != name})


def certificate_entry(name: str, row: int, column: int, value: float) -> Corruption:
    def corrupt(design: ObserverDesign) -> ObserverDesign:
        changed = np.array(design.certificate.matrices[name])
        changed[row, column] = value
        return with_certificate(design, **{name: changed})

    return corrupt


def certificate_nudge(name: str, row: int, column: int) -> Corruption:
    return lambda design: with_certificate(
        design, **{name: nudged(design.certificate.matrices[name], row, column, 1e-12)}
    )  # fmt: skip


def certificate_times(name: str, factor: float) -> Corruption:
    return lambda design: with_certificate(design, **{name: factor * design.certificate.matrices[name]})


def certificate_cut(name: str, *key: object) -> Corruption:
    return lambda design: with_certificate(design, **{name: design.certificate.matrices[name][key]})


def claim_beside(name: str, row: str, factor: float) -> Corruption:
    """The claim is moved past the number that the report recomputed."""
    return lambda design: with_certificate(design, {name: design.report[row].value * factor})


def observer_field(**changes: object) -> Corruption:
    return lambda design: with_observer(design, **changes)


def plant_field(**changes: object) -> Corruption:
    return lambda design: with_plant(design, **changes)


def sampled(design: ObserverDesign) -> ObserverDesign:
    return with_plant(with_observer(design, dt=0.1), dt=0.1)


def with_gains(design: ObserverDesign, **changes: np.ndarray) -> ObserverDesign:
    """Gains that are consistent in themselves, with the certificate and claims of the good design."""
    letters = {name: design.gains[name] for name in "JLMN"} | changes
    other = design_from_gains(design.plant, "pd-observer", **letters, adaptation_gain=design.gains.get("G"))
    return other.replace(certificate=design.certificate)


def unstable(design: ObserverDesign) -> ObserverDesign:
    return with_gains(design, M=-design.gains["M"])


def singular_estimate(design: ObserverDesign) -> ObserverDesign:
    """The realisation of infinite gains: S C has the eigenvalue one, so that I - S C is singular."""
    observer, n = design.observer, design.observer.order
    c = np.hstack([design.plant.C, design.plant.Df])
    s = np.linalg.pinv(c)
    return with_observer(
        design, Cz=np.vstack([np.eye(n) - s @ c, observer.Cz[n:]]), Dy=np.vstack([s, observer.Dy[n:]])
    )  # fmt: skip


def without_faults(design: ObserverDesign) -> ObserverDesign:
    """Plant and observer agree that there is no fault."""
    plant, observer = design.plant, design.observer
    bare = with_plant(design, Bf=np.zeros((plant.nx, 0)), Df=np.zeros((plant.ny, 0)), fault_names=())
    kept = [*range(plant.nx), *range(plant.nx + plant.nf, len(observer.Cz))]
    parts = {name: getattr(observer, name)[kept] for name in ("Cz", "Dy", "Du")}
    return with_observer(bare, **parts, fault_names=(), fault_delays=())


def exchanged_faults(design: ObserverDesign) -> ObserverDesign:
    """The estimates of two faults under each other's names."""
    observer, nx = design.observer, design.plant.nx
    rows = [*range(nx), nx + 1, nx, *range(nx + 2, len(observer.Cz))]
    return with_observer(design, Cz=observer.Cz[rows], Dy=observer.Dy[rows], Du=observer.Du[rows])


def faults(count: int) -> Corruption:
    rng = np.random.default_rng(1)
    return lambda design: with_plant(
        design, Bf=rng.standard_normal((design.plant.nx, count)), Df=None, fault_names=None
    )  # fmt: skip


TABLE: dict[str, tuple[str, Corruption, tuple[str, ...]]] = {
    "By in the last digits, of a slow plant": ("slow", last_digits, ("constant fault",)),
    # One entry of the observer, by 1e-6.
    "Az": ("paper", entry("Az", 1, 1), (DYNAMICS, GAINS)),
    "Az of a fault": ("direct", entry("Az", 4, 0), (DYNAMICS, GAINS)),
    "By": ("paper", entry("By", 2, 1), (DYNAMICS, GAINS)),
    "By with feedthrough of the input": ("direct", entry("By", 1, 1), (DYNAMICS, INPUTS, GAINS)),
    "Bu": ("paper", entry("Bu", 0, 1), (INPUTS,)),
    "Bu of a fault": ("paper", entry("Bu", 4, 1), (INPUTS,)),
    "Cz, state": ("paper", entry("Cz", 0, 1), (ESTIMATES, GAINS)),
    "Cz, fault": ("paper", entry("Cz", 5, 1), (ESTIMATES, GAINS)),
    "Cz, residual": ("paper", entry("Cz", 6, 1), (RESIDUAL,)),
    "Dy, state": ("paper", entry("Dy", 3, 1), (ESTIMATES, GAINS)),
    "Dy, fault": ("paper", entry("Dy", 4, 0), (ESTIMATES, GAINS)),
    "Dy, residual": ("paper", entry("Dy", 6, 0), (RESIDUAL,)),
    "Dy, fault, with feedthrough of the input": ("direct", entry("Dy", 3, 0), (ESTIMATES, FEEDTHROUGH, GAINS)),
    "Dy, residual, with feedthrough of the input": ("direct", entry("Dy", 5, 0), (RESIDUAL, FEEDTHROUGH)),
    "Du, state": ("paper", entry("Du", 0, 0), (FEEDTHROUGH,)),
    "Du, fault": ("direct", entry("Du", 4, 0), (FEEDTHROUGH,)),
    "Du, residual": ("direct", entry("Du", 6, 0), (FEEDTHROUGH,)),
    "fault estimates exchanged": ("paper", exchanged_faults, (ESTIMATES, LMI)),
    "infinite gains": ("paper", singular_estimate, (GAINS, DET, LMI)),
    "unstable gains": ("paper", unstable, (ERRORS, PAIR, LMI)),
    "unstable gains, one state": ("single", unstable, (ERRORS, PAIR, LMI)),
    "unstable gains, all bounds": (
        "bounds", unstable, (ERRORS, DECAY, DISK, PAIR, LMI, RATE, NOISE, LMI_RATE, LMI_NOISE)),
    "unstable gains, range": ("range", unstable, (ERRORS, PAIR, LMI, RANGE)),
    # The listed gains.
    "J": ("paper", gain_entry("J", 1, 1), (GAINS,)),
    "L": ("paper", gain_entry("L", 1, 1), (GAINS,)),
    "M": ("paper", gain_entry("M", 1, 1), (GAINS,)),
    "N": ("paper", gain_entry("N", 1, 1), (GAINS,)),
    "G": ("direct", gain_entry("G", 0, 1), (GAINS,)),
    "J of another observer": ("paper", gain_entry("J", 0, 0, -1e3), (GAINS, PAIR)),
    "J of the wrong shape": ("paper", gains(J=np.zeros((3, 2))), (FITS,)),
    "N NaN": ("paper", gain_entry("N", 0, 0, np.nan), (FITS,)),
    "M missing": ("paper", without_gain("M"), (FITS,)),
    "a G that the loop does not have": ("paper", gains(G=2.0 * np.eye(2)), (GAINS,)),
    "a gain too many": ("paper", gains(K=np.eye(2)), (FITS,)),
    # What the observer says about itself.
    "a fault delay": ("paper", observer_field(fault_delays=(1, 0)), (FITS,)),
    "a state delay": ("paper", observer_field(state_delays=(0, 0, 0, 1)), (FITS,)),
    "sampled observer": ("paper", observer_field(dt=0.1), (FITS,)),
    "input names": ("paper", observer_field(input_names=("u2", "u1")), (FITS,)),
    "output names": ("paper", observer_field(output_names=("y2", "y1")), (FITS,)),
    "state names": ("paper", observer_field(state_names=("x2", "x1", "x3", "x4")), (FITS,)),
    "fault names": ("paper", observer_field(fault_names=("actuator 2", "actuator 1")), (FITS,)),
    "residual names": ("paper", observer_field(residual_names=("a", "b")), (FITS,)),
    # The certificate.
    "P1 wrong": ("paper", certificate_times("P1", 1e3), (LMI,)),
    "P1 not symmetric": ("paper", certificate_nudge("P1", 0, 1), (P1,)),
    "P1 negative": ("paper", certificate_times("P1", -1.0), (P1, LMI)),
    "P1 zero": ("second theorem", certificate_times("P1", 0.0), (P1, LMI)),
    "P1 NaN": ("paper", certificate_entry("P1", 0, 0, np.nan), (FITS,)),
    "P1 without a row": ("paper", certificate_cut("P1", slice(1, None)), (FITS,)),
    "P1 a vector": ("paper", certificate_cut("P1", 0), (FITS,)),
    "P3 wrong": ("paper", certificate_entry("P3", 0, 0, 100.0), (LMI,)),
    "P3 zero": ("paper", certificate_times("P3", 0.0), (LMI,)),
    "P3 transposed": ("paper", lambda d: with_certificate(d, P3=d.certificate.matrices["P3"].T), (LMI,)),
    "P3 huge": ("paper", certificate_entry("P3", 0, 0, 1e300), (LMI,)),
    "P3 infinite": ("paper", certificate_entry("P3", 0, 0, np.inf), (FITS,)),
    "Q not symmetric": ("second theorem", certificate_nudge("P3", 0, 1), (Q,)),
    "Q negative": ("second theorem", certificate_times("P3", -1.0), (Q, LMI)),
    "P3 of Theorem 1 called Q": ("paper", claim("theorem", 2.0), (Q,)),
    "P1_low negative": ("range", certificate_times("P1_low", -1.0), (RANGE,)),
    "P1_low not symmetric": ("range", certificate_nudge("P1_low", 0, 1), (RANGE,)),
    "P1_high not symmetric": ("range", certificate_nudge("P1_high", 1, 2), (RANGE,)),
    "P1_high wrong": ("range", certificate_times("P1_high", 100.0), (RANGE,)),
    "P1_high missing": (
        "range",
        lambda d: d.replace(certificate=Certificate({k: d.certificate.matrices[k] for k in ("P1", "P3", "P1_low")},
                                                    d.certificate.claims)),
        (FITS,)),
    "no matrices": ("paper", lambda d: d.replace(certificate=Certificate({}, d.certificate.claims)), (FITS,)),
    # The claims.
    "no claims": ("paper", lambda d: d.replace(certificate=Certificate(d.certificate.matrices, {})), (FITS,)),
    "theorem 3": ("paper", claim("theorem", 3.0), (FITS,)),
    "delta wrong": ("paper", claim("delta", 100.0), (LMI,)),
    "delta zero": ("paper", claim("delta", 0.0), (FITS,)),
    "delta NaN": ("paper", claim("delta", np.nan), (FITS,)),
    "decay too fast": ("paper", claim_beside("decay", ERRORS, -1.0 - 1e-9), (DECAY, LMI)),
    "decay too fast, second theorem": ("second theorem", claim_beside("decay", ERRORS, -1.0 - 1e-9), (DECAY, LMI)),
    "asked for more": ("bounds", asked(gain_bound=6.0, decay=500.0), ("requested bounds", "requested decay")),
    "asked for nonsense": ("bounds", asked(engine="none"), ("options",)),
    "decay infinite": ("bounds", claim("decay", np.inf), (FITS,)),
    "decay negative": ("paper", claim("decay", -1.0), (FITS,)),
    "decay missing": ("paper", without_claim("decay"), (FITS,)),
    "disk too small": ("bounds", claim_beside("disk_radius", DISK, 1.0 - 1e-9), (DISK,)),
    "disk elsewhere": ("bounds", claim("disk_centre", 100.0), (DISK,)),
    "disk without a centre": ("bounds", without_claim("disk_centre"), (FITS,)),
    "disk of negative radius": ("bounds", claim("disk_radius", -1.0), (FITS,)),
    "gain bound too small": ("bounds", claim_beside("gain_bound", BOUND, 1.0 - 1e-9), (BOUND,)),
    "gain bound zero": ("bounds", claim("gain_bound", 0.0), (FITS,)),
    "rate gain too small": ("bounds", claim_beside("fault_rate_gain", RATE, 1.0 - 1e-6), (RATE, LMI_RATE)),
    "rate gain hardly too small": ("bounds", claim_beside("fault_rate_gain", RATE, 1.0 - 0.5e-9), (RATE, LMI_RATE)),
    "noise gain too small": ("bounds", claim_beside("noise_gain", NOISE, 1.0 - 1e-6), (NOISE, LMI_NOISE)),
    "P_rate wrong": ("bounds", certificate_times("P_rate", 100.0), (LMI_RATE,)),
    "P_rate not symmetric": ("bounds", certificate_nudge("P_rate", 0, 1), (LMI_RATE,)),
    "P_rate without a row": ("bounds", certificate_cut("P_rate", slice(1, None)), (FITS,)),
    "P_noise negative": ("bounds", certificate_times("P_noise", -1.0), (LMI_NOISE,)),
    "P_noise NaN": ("bounds", certificate_entry("P_noise", 0, 0, np.nan), (FITS,)),
    "noise gain NaN": ("bounds", claim("noise_gain", np.nan), (FITS,)),
    "range too wide": ("range", claim("adaptation_high", 1e3), (RANGE,)),
    "range without an end": ("range", without_claim("adaptation_high"), (FITS,)),
    "range from zero": ("range", claim("adaptation_low", 0.0), (FITS,)),
    # Numbers that overflow.
    "Az huge": ("paper", entry("Az", 0, 0, 1e300), (DYNAMICS, GAINS, ERRORS, LMI)),
    "By huge": ("bounds", entry("By", 0, 0, 1e300), (DYNAMICS, GAINS, BOUND, NOISE)),
    "Cz huge": ("bounds", entry("Cz", 4, 0, 1e300), (ESTIMATES, GAINS, LMI, RATE, NOISE, BOUND, LMI_RATE, LMI_NOISE)),
    # The plant is another one.
    "A": ("paper", plant_entry("A", 3, 2), (DYNAMICS,)),
    "B": ("paper", plant_entry("B", 1, 1), (INPUTS,)),
    "C": ("paper", plant_entry("C", 0, 1), (DYNAMICS, ESTIMATES, RESIDUAL)),
    "D": ("direct", plant_entry("D", 1, 0), (INPUTS, FEEDTHROUGH)),
    "fault direction": ("paper", plant_entry("Bf", 0, 0), (DYNAMICS,)),
    "direction of a sensor fault": ("direct", plant_entry("Df", 1, 0), (DYNAMICS, ESTIMATES, RESIDUAL)),
    "more noise than the bound allows": (
        "bounds", lambda d: with_plant(d, Bw=np.zeros((4, 2)), Dw=100.0 * np.eye(2), noise_names=None),
        (NOISE, LMI_NOISE)),
    "names of the plant": ("paper", plant_field(state_names=["a", "b", "c", "d"]), (FITS,)),
    "a factor in E": ("paper", plant_field(E=2.0 * np.eye(4)), (FITS,)),
    # Existence conditions.
    "discrete plant": ("paper", plant_field(dt=0.1), ("exists: continuous time", FITS)),
    "discrete plant and observer": ("paper", sampled, ("exists: continuous time", FITS)),
    "no fault": ("paper", without_faults, ("exists: faults", FITS)),
    "equations that determine nothing": (
        "paper", plant_field(E=np.diag([1.0, 1, 1, 0]), A=np.zeros((4, 4))), ("exists: regularity", FITS)),
    "index two": (
        "single", plant_field(E=[[0.0, 1.0], [0.0, 0.0]], A=np.eye(2)), ("exists: index", FITS)),
    "algebraic states alone": ("single", plant_field(E=np.zeros((2, 2))), ("exists: dynamic states", FITS)),
    "more faults than outputs": ("paper", faults(3), ("exists: nf <= ny", FITS)),
    "a fault that acts nowhere": ("single", plant_field(Bf=np.zeros((2, 1))), ("exists: rank F", DYNAMICS, PAIR)),
    "two faults in one direction": (
        "paper", lambda d: with_plant(d, Bf=d.plant.Bf[:, [0, 0]]), ("exists: rank F", DYNAMICS, PAIR)),
    "an unstable mode that nothing measures": (
        "single", plant_field(A=[[0.5, 0.0], [0.0, 1.0]]), ("exists: detectability", DYNAMICS, PAIR)),
    "a zero at the origin": (
        "single", plant_field(A=[[0.5, 0.0], [1.0, -1.0]], Bf=[[0.0], [1.0]]),
        ("exists: rank [A F; C Df]", DYNAMICS, PAIR)),
    # The last digits, and what nothing checks.
    "By in the last digits": (
        "paper", lambda d: with_observer(d, By=d.observer.By * (1.0 + 1e-12)), ("stored numbers: states",)),
    "a claimed error per unit of an input": (
        "direct", lambda d: with_certificate(d, input_error=0.1 * d.certificate.matrices["input_error"]),
        ("stored numbers: inputs",)),
    "a claimed gain": ("paper", claim("gamma", 1e-9), ("claims covered",)),
}  # fmt: skip


@pytest.mark.one_in(6)
@pytest.mark.parametrize("name", GOOD)
def test_a_good_design_passes(name: str) -> None:
    design = good(name)
    assert design.report.passed
    assert failed(design) == set()


@pytest.mark.one_in(4)
@pytest.mark.parametrize("case", TABLE)
def test_exactly_the_rows_that_are_untrue_fail(case: str) -> None:
    assert_exactly_the_untrue_rows_fail(TABLE, case, good)


def test_the_table_breaks_every_row_that_verification_produces() -> None:
    assert_every_row_is_broken(TABLE, *(good(name).report for name in GOOD))


#: Observer matrix -> for each part of its rows, the row of the report that must fail.
CAUGHT_BY = {
    "Az": {"all": DYNAMICS},
    "By": {"all": DYNAMICS},
    "Bu": {"all": INPUTS},
    "Cz": {"state": ESTIMATES, "fault": ESTIMATES, "residual": RESIDUAL},
    "Dy": {"state": ESTIMATES, "fault": ESTIMATES, "residual": RESIDUAL},
    "Du": {"state": FEEDTHROUGH, "fault": FEEDTHROUGH, "residual": FEEDTHROUGH},
}


def entries(name: str, matrix: np.ndarray, share: Callable[..., Any]) -> Any:
    """Return places in a matrix: all of a small one, else a share, drawn for each design."""
    places = list(np.ndindex(matrix.shape))
    return places if len(places) <= 6 else share(random.Random(name).sample(places, len(places)))


@cache
def failed_by(name: str, matrix: str, row: int, column: int) -> set[str]:
    """What fails of a good design when an entry of its observer is changed."""
    return failed(entry(matrix, row, column)(good(name)))


@pytest.mark.one_in(4)
@pytest.mark.parametrize("matrix", CAUGHT_BY)
@pytest.mark.parametrize("name", GOOD)
def test_every_single_entry_of_the_observer_counts(name: str, matrix: str, share: Callable[..., Any]) -> None:
    observer = good(name).observer
    parts = {"state": observer.state_rows, "fault": observer.fault_rows, "residual": observer.residual_rows}
    cells = getattr(observer, matrix)
    for part, cause in CAUGHT_BY[matrix].items():
        rows = range(len(cells))[parts.get(part, slice(None))]
        for row, column in entries(name, cells, share):
            assert row not in rows or cause in failed_by(name, matrix, row, column), (row, column)


@pytest.mark.one_in(4)
@pytest.mark.parametrize("matrix", ["A", "B", "C", "D", "Bf", "Df", "E"])
@pytest.mark.parametrize("name", GOOD)
def test_every_single_entry_of_the_plant_counts(name: str, matrix: str, share: Callable[..., Any]) -> None:
    design = good(name)
    for row, column in entries(name, getattr(design.plant, matrix), share):
        assert failed(plant_entry(matrix, row, column)(design)), (row, column)


@pytest.mark.one_in(4)
@pytest.mark.parametrize("letter", ["J", "L", "M", "N", "G"])
@pytest.mark.parametrize("name", GOOD)
def test_every_single_entry_of_the_gains_counts(name: str, letter: str) -> None:
    design = good(name)
    rows, columns = design.gains[letter].shape if letter in design.gains else (0, 0)
    for row in range(rows):
        for column in range(columns):
            assert GAINS in failed(gain_entry(letter, row, column)(design)), (row, column)


@pytest.mark.one_in(4)
@pytest.mark.parametrize("name", GOOD)
def test_not_a_number_anywhere_is_refused_or_fails(name: str) -> None:
    design = good(name)
    for owner in (design.observer, design.plant):
        for field, value in owner.as_dict().items():
            if isinstance(value, np.ndarray) and value.size:
                for bad in (np.nan, np.inf):
                    changed = np.array(value)
                    changed[-1, -1] = bad
                    change = with_observer if owner is design.observer else with_plant
                    with pytest.raises(SpecError):
                        change(design, **{field: changed})
    for key, matrix in design.certificate.matrices.items():
        for row in range(matrix.shape[0]):
            assert failed(certificate_entry(key, row, 0, np.nan)(design)) == {WITNESS_CLAIMS.get(key, FITS)}
    for key in design.certificate.claims:
        assert failed(claim(key, np.nan)(design)) == {FITS}


def test_a_gain_is_proved_down_to_the_norm_and_no_further() -> None:
    """x' = -x + v: norm one, and P = 1 solves the equation at it.  P = 1/8 does for x' = -2 x + v, z = x / 2."""
    one = np.eye(1)
    for a, c, p, norm in ((-1.0, 1.0, 1.0, 1.0), (-2.0, 0.5, 0.125, 0.25)):
        for level, proved in ((1.0 + 1e-6, True), (1.0 - 1e-6, False), (0.95, False)):
            found = prove_gain(a * one, Ball.exact(one), c * one, p * one, level * norm)
            assert found.proved is proved, (a, level)
    # Of an unstable system no P is positive and solves it.
    assert not prove_gain(one, Ball.exact(one), one, -one, 2.0).proved


def test_a_report_is_about_the_design_it_is_made_of_not_about_the_one_saved() -> None:
    corrupted = entry("By", 0, 0)(good("paper"))
    assert corrupted.report.passed
    assert not verify(corrupted).passed


@pytest.mark.one_in(4)
@pytest.mark.parametrize("name", GOOD)
def test_units_of_states_and_faults_hide_no_corruption(name: str, share: Callable[..., Any]) -> None:
    """What fails is the same when states, faults and outputs are measured in units from 2^-12 to 2^12."""
    design = good(name)
    assert failed(in_units(design)) == set()
    for matrix in CAUGHT_BY:
        for row, column in entries(name, getattr(design.observer, matrix), share):
            corrupted = entry(matrix, row, column)(design)
            exact = {DYNAMICS, INPUTS, ESTIMATES, RESIDUAL, FEEDTHROUGH, GAINS}
            assert failed(in_units(corrupted)) & exact == failed_by(name, matrix, row, column) & exact, (
                matrix,
                row,
                column,
            )


#: Options that bound gains, in units of faults and outputs.
BOUNDS = ("gain_bound", "fault_rate_gain", "noise_gain")


def in_units(design: ObserverDesign) -> ObserverDesign:
    """The same design in other units, powers of two: exact in every digit.  Bounds go, asked for and
    claimed, which have units."""
    plant, observer = design.plant, design.observer
    nx, nf = plant.nx, plant.nf
    own = np.exp2(np.round(np.linspace(-12.0, 12.0, nx + nf)))
    x, f, y = own[:nx], own[nx:], np.exp2(np.round(np.linspace(6.0, -6.0, plant.ny)))
    columns = {"B": 1.0, "Bf": f, "Bd": 1.0, "Bw": 1.0}
    changed = {key: getattr(plant, key) * right / x[:, None] for key, right in columns.items()}
    through = {"C": x, "D": 1.0, "Df": f, "Dd": 1.0, "Dw": 1.0}
    changed |= {key: getattr(plant, key) * right / y[:, None] for key, right in through.items()}
    moved = with_plant(design, A=plant.A * x / x[:, None], **changed)
    rows = np.concatenate([own, y])[:, None]
    moved = with_observer(
        moved, Az=observer.Az * own / own[:, None], Bu=observer.Bu / own[:, None], By=observer.By * y / own[:, None],
        Cz=observer.Cz * own / rows, Du=observer.Du / rows, Dy=observer.Dy * y / rows,
    )  # fmt: skip
    g = design.gains.get("G", np.eye(nf))
    bottom = {key: design.gains[key] * y / f[:, None] for key in "MN"}
    top = {key: design.gains[key] * y / x[:, None] for key in "JL"}
    more = {"G": g * f / f[:, None]} if "G" in design.gains else {}
    matrices = {
        key: value * own * own[:, None]
        for key, value in design.certificate.matrices.items()
        if key not in WITNESS_CLAIMS
    }
    claims = {key: v for key, v in design.certificate.claims.items() if "gain" not in key}
    options = {key: value for key, value in design.options.items() if key not in BOUNDS}
    return moved.replace(gains={**top, **bottom, **more}, certificate=Certificate(matrices, claims), options=options)

"""The corruption table of unknown-input PI observers: every row fails when, and only when, what it claims is untrue."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import cache
from pathlib import Path

import mpmath
import numpy as np
import pytest
from corruption_tables import (
    assert_every_row_is_broken,
    assert_exactly_the_untrue_rows_fail,
    claim_times,
    entry,
    failed,
    last_digits,
    nudged,
    slow_plant,
    with_certificate,
    with_plant,
)

from obsynth import Certificate, DescriptorSystem, ObserverDesign, ui_pi_observer, verify
from obsynth.numerics.spectra import decay_rates
from obsynth.specs.loader import load_spec

PAPER = Path(__file__).parents[2] / "designs" / "sharepasand" / "spec.yaml"

FITS, SYLVESTER, INPUTS = "fits the plant", "Sylvester", "inputs"
IN_ERROR, IN_ESTIMATES = "disturbance in the error", "disturbance in the estimates"
STATE, FAULT, RESIDUAL, FEEDTHROUGH = "state", "fault", "residual", "feedthrough"
STABILITY, POLES, DECAY, DIGITS = "stability", "poles", "decay", "stable with 9 digits"
DECOUPLING, NOISE, MODEL = "decoupling", "noise amplification", "model of faults"
D3_STEP, D3_ONE, D3_HALF = (f"exists: (D3) fault model at {value}" for value in ("0", "1", "0.5"))
D3_SINE, ORDER = "exists: (D3) fault model at 0.939373 +- 0.342898j", "exists: order of the fault model"
ENOUGH, D1, D2 = "exists: nd <= ny", "exists: (D1) decoupling", "exists: (D2) zeros"


# The good designs.


def paper() -> ObserverDesign:
    """The paper's example with its E#, C#, G: continuous, an algebraic state, a ramp model."""
    spec = load_spec(PAPER)
    return ui_pi_observer(spec.plant, **spec.options)


def direct() -> ObserverDesign:
    """Feedthrough of input, fault and disturbance, stated noise; one fault is that of a sensor; discrete time."""
    plant = DescriptorSystem(
        np.diag([1.0, 1, 0]),
        [[0.7, 0.2, 0], [-0.1, 0.8, 0.3], [0.2, 0.1, -1]],
        [[1], [0.5], [0.2]],
        [[1, 0, 0], [0, 0, 1], [1, 1, 0], [0, 1, 1]],
        D=[[0.3], [0.4], [-0.2], [1]],
        Bf=[[0, 1], [0, 0.3], [0, 0]],
        Df=[[1, 0], [0, 0], [0, 0], [0, 0]],
        Bd=[[0.3], [0.1], [0.2]],
        Dd=[[0.1], [0], [0.2], [0]],
        Bw=np.zeros((3, 4)),
        Dw=0.01 * np.eye(4),
        dt=0.5,
    )
    return ui_pi_observer(plant, fault_model={"f1": "step", "f2": {"sinusoid": 0.7}})


def fixed() -> ObserverDesign:
    """A stable mode at -1 that no output shows; no known input; a triple pole."""
    plant = DescriptorSystem(
        None,
        [[-2.0, 1, 0], [0, 0.5, 0], [1, 0, -1]],
        C=[[1, 0, 0], [0, 1, 0]],
        Bf=[[1.0], [0], [0]],
        Bd=[[0.0], [1], [0]],
    )
    return ui_pi_observer(plant, poles=[-3, -3, -3])


def long() -> ObserverDesign:
    """A polynomial model of order 8."""
    return ui_pi_observer(load_spec(PAPER).plant, fault_model={"polynomial": 8})


DESIGNS = {"paper": paper, "direct": direct, "fixed": fixed, "long": long}


@cache
def good(name: str) -> ObserverDesign:
    return ui_pi_observer(slow_plant(0.0), decay=1.0) if name == "slow" else DESIGNS[name]()


# Ways to corrupt a design.


def asked(**changes: object) -> Callable[[ObserverDesign], ObserverDesign]:
    return lambda design: design.replace(options={**design.options, **changes})


def observer_change(change: Callable[[object], dict]) -> Callable[[ObserverDesign], ObserverDesign]:
    return lambda design: design.replace(observer=dataclasses.replace(design.observer, **change(design.observer)))


def observer_field(**changes: object) -> Callable[[ObserverDesign], ObserverDesign]:
    return observer_change(lambda _: changes)


def plant_entry(name: str, row: int, column: int, by: float = 1e-5) -> Callable[[ObserverDesign], ObserverDesign]:
    return lambda design: with_plant(design, **{name: nudged(getattr(design.plant, name), row, column, by)})


def plant_field(**changes: object) -> Callable[[ObserverDesign], ObserverDesign]:
    return lambda design: with_plant(design, **changes)


def certificate(name: str, row: int, column: int, value: float) -> Callable[[ObserverDesign], ObserverDesign]:
    def corrupt(design: ObserverDesign) -> ObserverDesign:
        changed = np.array(design.certificate.matrices[name])
        changed[row, column] = value
        return with_certificate(design, **{name: changed})

    return corrupt


def cut(name: str) -> Callable[[ObserverDesign], ObserverDesign]:
    return lambda design: with_certificate(design, **{name: design.certificate.matrices[name][1:]})


def scaled(name: str, factor: float) -> Callable[[ObserverDesign], ObserverDesign]:
    return lambda design: with_certificate(design, **{name: factor * design.certificate.matrices[name]})


def without(name: str) -> Callable[[ObserverDesign], ObserverDesign]:
    def corrupt(design: ObserverDesign) -> ObserverDesign:
        kept = {key: value for key, value in design.certificate.matrices.items() if key != name}
        return design.replace(certificate=Certificate(kept, design.certificate.claims))

    return corrupt


def moved_gain(design: ObserverDesign, gain: np.ndarray) -> ObserverDesign:
    """Add an output injection: Az - gain Ca Cz-part and By change so that every identity still holds."""
    plant, observer, matrices = design.plant, design.observer, design.certificate.matrices
    augmented = np.hstack([plant.C, plant.Df @ matrices["Cw"]])
    whole = np.zeros((observer.order, plant.ny))
    whole[: len(gain)] = gain
    # D_a: what y adds to the augmented state; rows of the fault model are zero unless the design was joint.
    d_a = np.zeros((observer.order, plant.ny))
    d_a[: plant.nx] = observer.Dy[observer.state_rows]
    az = observer.Az - whole @ augmented
    by = observer.By + whole - whole @ augmented @ d_a
    return design.replace(observer=dataclasses.replace(observer, Az=az, By=by))


def unstable(design: ObserverDesign) -> ObserverDesign:
    """An output injection that makes the observer run away, and changes nothing else."""
    return moved_gain(design, -10.0 * design.plant.C.T)


def in_other_coordinates(design: ObserverDesign, size: float) -> ObserverDesign:
    """The same observer with its states sheared: every identity and every pole stays; the digits do not."""
    observer, matrices = design.observer, design.certificate.matrices
    shear = np.eye(observer.order)
    shear[0, 1:] = size
    back = np.eye(observer.order)
    back[0, 1:] = -size
    changed = dataclasses.replace(
        observer, Az=shear @ observer.Az @ back, Bu=shear @ observer.Bu, By=shear @ observer.By, Cz=observer.Cz @ back
    )
    factor = np.triu(np.linalg.qr(matrices["stability"] @ back, mode="r"))
    # How far rounding of the sheared numbers moves the poles is chance: the claims are those of the numbers stored.
    with mpmath.workdps(60):
        poles = np.array([complex(value) for value in mpmath.eig(mpmath.matrix(changed.Az.tolist()), right=False)])
    return with_certificate(
        design.replace(observer=changed),
        {"decay": float(np.min(decay_rates(poles, observer.dt)))},
        tracking=shear @ matrices["tracking"], stability=factor, poles=np.column_stack([poles.real, poles.imag]),
    )  # fmt: skip


def swapped_faults(design: ObserverDesign) -> ObserverDesign:
    """The estimates of two faults under each other's names."""
    observer, nx = design.observer, design.plant.nx
    rows = [*range(nx), nx + 1, nx, *range(nx + 2, len(observer.Cz))]
    return observer_field(Cz=observer.Cz[rows], Dy=observer.Dy[rows], Du=observer.Du[rows])(design)


def more_disturbances(design: ObserverDesign) -> ObserverDesign:
    rng = np.random.default_rng(1)
    plant = design.plant
    count = plant.ny + 1
    return with_plant(
        design, Bd=rng.standard_normal((plant.nx, count)), Dd=np.zeros((plant.ny, count)), disturbance_names=None
    )


def like_the_disturbance(fault: int) -> Callable[[ObserverDesign], ObserverDesign]:
    """Give a fault the direction of the disturbance."""

    def corrupt(design: ObserverDesign) -> ObserverDesign:
        changed = {}
        for name, other in (("Bf", "Bd"), ("Df", "Dd")):
            matrix = np.array(getattr(design.plant, name))
            matrix[:, fault] = getattr(design.plant, other)[:, 0]
            changed[name] = matrix
        return with_plant(design, **changed)

    return corrupt


#: What is corrupted -> (good design, corruption, exactly the rows that fail).
TABLE: dict[str, tuple[str, Callable[[ObserverDesign], ObserverDesign], tuple[str, ...]]] = {
    "By in the last digits, of a slow plant": ("slow", last_digits, ("constant fault",)),
    # The options.
    "faster than it is": ("slow", asked(decay=1e3), ("requested decay",)),
    "other poles": ("fixed", asked(poles=[-3, -3, -4]), ("requested poles",)),
    "another region": ("direct", asked(region={"decay": 1e3}), ("requested region",)),
    # One entry of the observer.
    "Az": ("paper", entry("Az", 1, 1, 1e-5), (SYLVESTER, POLES, DECOUPLING)),
    "Az of a fixed mode": ("fixed", entry("Az", 2, 2, 1e-5), (SYLVESTER, DECOUPLING)),
    "Az, discrete": ("direct", entry("Az", 0, 1, 1e-5), (SYLVESTER, DECOUPLING)),
    "By": ("paper", entry("By", 1, 0, 1e-5), (SYLVESTER, DECOUPLING)),
    "By with feedthrough": ("direct", entry("By", 1, 0, 1e-5), (SYLVESTER, INPUTS, IN_ERROR, DECOUPLING)),
    "Bu": ("paper", entry("Bu", 0, 0, 1e-5), (INPUTS,)),
    "Bu with feedthrough": ("direct", entry("Bu", 3, 0, 1e-5), (INPUTS,)),
    "Cz, state": ("paper", entry("Cz", 1, 1, 1e-5), (STATE, DECOUPLING)),
    "Cz, fault": ("paper", entry("Cz", 3, 3, 1e-5), (FAULT,)),
    "Cz, fault from a state": ("fixed", entry("Cz", 3, 0, 1e-5), (FAULT, DECOUPLING)),
    "Cz, residual": ("direct", entry("Cz", 5, 0, 1e-5), (RESIDUAL, DECOUPLING)),
    "Dy, state": ("paper", entry("Dy", 0, 0, 1e-5), (STATE, DECOUPLING)),
    "Dy, fault": ("paper", entry("Dy", 3, 0, 1e-5), (FAULT, DECOUPLING)),
    "Dy, residual": ("paper", entry("Dy", 4, 0, 1e-5), (RESIDUAL, DECOUPLING)),
    "Dy, fault, with feedthrough of the disturbance": ("direct", entry("Dy", 3, 0, 1e-5),
        (IN_ESTIMATES, FAULT, FEEDTHROUGH, DECOUPLING)),
    "Du, state": ("paper", entry("Du", 0, 0, 1e-5), (FEEDTHROUGH,)),
    "Du, fault": ("direct", entry("Du", 4, 0, 1e-5), (FEEDTHROUGH,)),
    # What the observer says about itself.
    "fault delay": ("paper", observer_field(fault_delays=(1,)), (FITS,)),
    "state delay": ("paper", observer_field(state_delays=(0, 1, 0)), (FITS,)),
    "sampling time of the observer": ("direct", observer_field(dt=0.25), (FITS,)),
    "input names": ("paper", observer_field(input_names=("other",)), (FITS,)),
    "output names": ("paper", observer_field(output_names=("y2", "y1")), (FITS,)),
    "state names": ("paper", observer_field(state_names=("x2", "x1", "x3")), (FITS,)),
    "fault names": ("direct", observer_field(fault_names=("f2", "f1")), (FITS,)),
    "fault estimates exchanged": ("direct", swapped_faults, (FAULT,)),
    "unstable gain": ("paper", unstable, (STABILITY, POLES, DECAY, DIGITS, NOISE)),
    "unstable gain, discrete": ("direct", unstable,
        (INPUTS, IN_ERROR, STABILITY, POLES, DECAY, DIGITS, DECOUPLING, NOISE)),
    "coordinates that cost digits": ("paper", lambda d: in_other_coordinates(d, 3e4), (DIGITS,)),
    "coordinates that cost digits, discrete": ("direct", lambda d: in_other_coordinates(d, 5e5), (DIGITS,)),
    "fewer digits claimed than needed": (
        "paper", lambda d: with_certificate(in_other_coordinates(d, 3e4), claims={"digits": 9.0}),
        ("stable with the claimed digits",)),
    # The certificate.
    "tracking": ("paper", certificate("tracking", 1, 0, 0.4), (SYLVESTER, IN_ERROR, STATE, RESIDUAL)),
    "tracking of the fault model": ("fixed", certificate("tracking", 3, 3, 1.1), (SYLVESTER, FAULT)),
    "tracking zero": ("paper", scaled("tracking", 0.0), (SYLVESTER, INPUTS, STATE, FAULT, RESIDUAL)),
    "tracking NaN": ("paper", certificate("tracking", 0, 0, np.nan), (FITS,)),
    "tracking without a row": ("paper", cut("tracking"), (FITS,)),
    "stability not triangular": ("paper", certificate("stability", 3, 0, 1e-300), (STABILITY,)),
    "stability zero": ("direct", scaled("stability", 0.0), (STABILITY,)),
    "stability wrong": ("fixed", certificate("stability", 0, 1, 1e3), (STABILITY,)),
    "stability infinite": ("fixed", certificate("stability", 0, 1, np.inf), (FITS,)),
    "stability without a row": ("direct", cut("stability"), (FITS,)),
    "poles": ("paper", certificate("poles", 0, 0, -6.1), (POLES,)),
    "poles, imaginary part": ("direct", certificate("poles", 0, 1, 0.3), (POLES,)),
    "poles without a row": ("fixed", cut("poles"), (FITS,)),
    "no tracking": ("paper", without("tracking"), (FITS,)),
    "no fault model": ("paper", without("Phi"), (FITS,)),
    "Phi of another fault": ("fixed", certificate("Phi", 0, 0, -0.5), (SYLVESTER, MODEL)),
    "Phi of a growing fault at the zero": ("paper", certificate("Phi", 0, 0, 0.5), (SYLVESTER, D3_HALF, MODEL)),
    "Cw": ("paper", certificate("Cw", 0, 0, 1.1), (SYLVESTER, FAULT, MODEL)),
    "decay claimed too large": ("paper", claim_times("decay", 1.01), (DECAY,)),
    "decay NaN": ("direct", claim_times("decay", np.nan), (DECAY,)),
    "noise claimed too small": ("paper", claim_times("noise_amplification", 0.99), (NOISE,)),
    "noise NaN": ("direct", claim_times("noise_amplification", np.nan), (NOISE,)),
    # Numbers that overflow.
    "Az huge": ("paper", entry("Az", 0, 0, 1e300), (STABILITY, POLES, DECAY, DIGITS, NOISE)),
    "By huge": ("direct", entry("By", 0, 0, 1e300), (SYLVESTER, INPUTS, IN_ERROR, DECOUPLING, NOISE)),
    # The plant is another one.
    "E": ("paper", plant_entry("E", 0, 0), (SYLVESTER, STATE, RESIDUAL, DECOUPLING)),
    "A": ("paper", plant_entry("A", 0, 2, 5e-5), (SYLVESTER, DECOUPLING)),
    "B": ("paper", plant_entry("B", 1, 0), (INPUTS,)),
    "C": ("paper", plant_entry("C", 0, 2), (SYLVESTER, STATE, RESIDUAL, DECOUPLING)),
    "D": ("direct", plant_entry("D", 1, 0), (INPUTS, FEEDTHROUGH)),
    "fault direction": ("paper", plant_entry("Bf", 1, 0), (SYLVESTER,)),
    "direction of a sensor fault": ("direct", plant_entry("Df", 1, 0), (SYLVESTER, STATE, RESIDUAL)),
    "disturbance direction": ("paper", plant_entry("Bd", 0, 0), (IN_ERROR, DECOUPLING)),
    "disturbance in the outputs": ("direct", plant_entry("Dd", 1, 0), (IN_ERROR, IN_ESTIMATES, DECOUPLING)),
    "sampling time of the plant": ("direct", plant_field(dt=0.25), (FITS,)),
    "names of the plant": ("paper", plant_field(state_names=["a", "b", "c"]), (FITS,)),
    # Existence conditions.
    "more disturbances than outputs": ("fixed", more_disturbances, (IN_ERROR, DECOUPLING, ENOUGH)),
    "a disturbance that no output shows at once": ("fixed", plant_field(Bd=[[0.0], [0], [1]]),
        (IN_ERROR, DECOUPLING, D1, D2)),
    "a disturbance that moves an unmeasured state": ("paper", plant_field(Bd=[[0], [1.0], [0]]),
        (IN_ERROR, DECOUPLING)),
    "an unstable mode that no output shows": ("fixed", plant_entry("A", 2, 2, 1.5), (SYLVESTER, DECOUPLING, D2)),
    "a fault like the disturbance": ("paper", plant_field(Bf=[[1], [0], [-1]]), (SYLVESTER, D3_STEP)),
    "a constant fault like the disturbance, discrete": ("direct", like_the_disturbance(0),
        (SYLVESTER, STATE, RESIDUAL, D3_ONE)),
    "a sinusoidal fault like the disturbance, discrete": ("direct", like_the_disturbance(1), (SYLVESTER, D3_SINE)),
    "a zero where a long fault model hides": ("long", plant_entry("A", 0, 2, 0.96), (SYLVESTER, DECOUPLING, ORDER)),
    "a fault model at the zero": ("fixed", plant_field(Bf=[[0.0], [1], [0]]), (SYLVESTER, D3_STEP)),
    # The letters, and the last digits, and what nothing checks.
    "a listed gain": ("paper", lambda d: d.replace(gains={**d.gains, "K": 1.001 * d.gains["K"]}), ("gains",)),
    "an unknown letter": ("paper", lambda d: d.replace(gains={**d.gains, "Z": np.eye(2)}), ("gains",)),
    "a letter that is left out": (
        "paper", lambda d: d.replace(gains={name: K for name, K in d.gains.items() if name != "K_a"}), ("gains",)
    ),
    "By in the last digits": (
        "paper", lambda d: d.replace(observer=dataclasses.replace(d.observer, By=d.observer.By * (1.0 + 3e-12))),
        ("stored numbers: states",)),
    "a claimed error per unit of an input": ("direct", scaled("input_error", 0.1), ("stored numbers: inputs",)),
    "a claimed error per unit of a disturbance": (
        "direct", scaled("disturbance_error", 0.1), ("stored numbers: disturbances",)),
    "a claimed error per unit of a state": ("paper", scaled("state_error", 0.1), ("stored numbers: states",)),
    "a claimed gain": ("paper", lambda d: with_certificate(d, {"gamma": 1e-9}), ("claims covered",)),
}  # fmt: skip


@pytest.mark.one_in(4)
@pytest.mark.parametrize("name", DESIGNS)
def test_a_good_design_passes(name: str) -> None:
    assert good(name).report.passed
    assert failed(good(name)) == set()


@pytest.mark.one_in(4)
@pytest.mark.parametrize("case", TABLE)
def test_exactly_the_rows_that_are_untrue_fail(case: str) -> None:
    assert_exactly_the_untrue_rows_fail(TABLE, case, good)


def test_the_table_breaks_every_row_that_verification_produces() -> None:
    assert_every_row_is_broken(TABLE, *(good(name).report for name in DESIGNS))


@pytest.mark.parametrize("name", DESIGNS)
def test_verification_changes_nothing(name: str) -> None:
    design = good(name)
    before = [np.array(value) for value in (*design.certificate.matrices.values(), design.observer.Az, design.plant.A)]
    verify(design)
    after = [*design.certificate.matrices.values(), design.observer.Az, design.plant.A]
    assert all(np.array_equal(first, second) for first, second in zip(before, after, strict=True))


def test_printed_digits_soften_equalities_only() -> None:
    design = good("paper")
    rounded = dataclasses.replace(
        design.observer, By=np.round(design.observer.By, 4), Az=np.round(design.observer.Az, 4)
    )
    printed = design.replace(observer=rounded)
    assert SYLVESTER in failed(printed)
    assert SYLVESTER not in failed(printed, printed_digits=4)
    assert STABILITY in failed(unstable(design), printed_digits=1)

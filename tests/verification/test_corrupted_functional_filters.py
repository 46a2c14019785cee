"""The corruption table of functional filters: every row fails when, and only when, what it claims is untrue."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
from corruption_tables import assert_every_row_is_broken, assert_exactly_the_untrue_rows_fail

from obsynth import Certificate, DescriptorSystem, ObserverDesign, functional_filter

A_ERROR, U_ERROR, D_ERROR = "state in the error", "inputs in the error", "unknown inputs in the error"
T0E, A_ROW, U_ROW, D_ROW = (
    "algebraic rows", "state in the estimates", "inputs in the estimates", "unknown inputs in the estimates",
)  # fmt: skip
FITS, STABILITY, ORDER, DECAY = "fits the plant", "stability", "order", "decay"
MOTION, MODELS, LEAK = "motion with the fault model", "fault models", "unknown inputs"
FREE_A, FREE_B, NOISE_A, NOISE_B = "free of others: a", "free of others: b", "noise in fhat[a]", "noise in fhat[b]"
ERROR_A, ERROR_B = "error of fhat[a]", "error of fhat[b]"
SHOWS_A, FOLLOWS_A = "exists: a detectable", "exists: a follows its model"
SHOWS_B, FOLLOWS_B = "exists: b detectable", "exists: b follows its model"


def plant() -> DescriptorSystem:
    """Feedthrough of input, fault and disturbance; an algebraic state; sampled."""
    return DescriptorSystem(
        np.diag([1.0, 1, 0]), [[0.7, 0.2, 0], [-0.1, 0.8, 0.3], [0.2, 0.1, -1]], [[1], [0.5], [0.2]],
        [[1, 0, 0], [0, 0, 1], [1, 1, 0], [0, 1, 1]], D=[[0.3], [0.4], [-0.2], [1]], Bf=[[0, 1], [0, 0.3], [0, 0]],
        Df=[[1, 0], [0, 0], [0, 0], [0, 0]], Bd=[[0.3], [0.1], [0.2]], Dd=[[0.1], [0], [0.2], [0]],
        Bw=np.zeros((3, 4)), Dw=0.01 * np.eye(4), dt=0.5, fault_names=["a", "b"],
    )  # fmt: skip


def both() -> ObserverDesign:
    """Two faults, each free of the other, with a lag."""
    return functional_filter(plant(), fault_rate=0.05, delay=1)


def apart() -> ObserverDesign:
    """Two faults on two plants that have nothing to do with each other; each has a zero at -0.5."""
    alone = DescriptorSystem(
        None, 0.5 * np.eye(2), None, np.eye(2), Bf=np.eye(2), Df=np.eye(2), Bw=np.zeros((2, 2)), Dw=0.01 * np.eye(2),
        dt=1.0, fault_names=["a", "b"],
    )  # fmt: skip
    return functional_filter(alone, fault_rate=0.05)


DESIGNS = {"both": both, "apart": apart}


@cache
def good(name: str) -> ObserverDesign:
    return DESIGNS[name]()


Corruption = Callable[[ObserverDesign], ObserverDesign]


def observer(**changes: Callable[[np.ndarray], np.ndarray]) -> Corruption:
    """Change matrices of the shipped observer."""

    def corrupt(design: ObserverDesign) -> ObserverDesign:
        changed = {name: change(getattr(design.observer, name).copy()) for name, change in changes.items()}
        return design.replace(observer=dataclasses.replace(design.observer, **changed))

    return corrupt


def matrix(name: str, change: Callable[[np.ndarray], np.ndarray]) -> Corruption:
    """Change a matrix of the certificate."""

    def corrupt(design: ObserverDesign) -> ObserverDesign:
        matrices = {**design.certificate.matrices, name: change(design.certificate.matrices[name].copy())}
        return design.replace(certificate=Certificate(matrices, design.certificate.claims))

    return corrupt


def claim(**claims: float) -> Corruption:
    return lambda design: design.replace(
        certificate=Certificate(design.certificate.matrices, {**design.certificate.claims, **claims})
    )


def of_plant(**changes: Callable[[np.ndarray], np.ndarray]) -> Corruption:
    return lambda design: design.replace(
        plant=design.plant.replace(
            **{name: change(getattr(design.plant, name).copy()) for name, change in changes.items()}
        )
    )


def at(row: int, column: int, factor: float = 1.0, *, add: float = 0.01) -> Callable[[np.ndarray], np.ndarray]:
    def change(values: np.ndarray) -> np.ndarray:
        values[row, column] = factor * values[row, column] + add
        return values

    return change


TABLE = {
    "a limit below what is missed": (
        "both", lambda d: d.replace(options={**d.options, "steady_error_limit": 1e-18}), ["constant fault"],
    ),
    "a limit that is none": (
        "both", lambda d: d.replace(options={**d.options, "steady_error_limit": "none"}), ["options"],
    ),
    "states beside no estimate": ("both", lambda d: d.replace(options={**d.options, "faults": ["a"]}), [FITS]),
    "a delay that is not shipped": ("both", lambda d: d.replace(options={**d.options, "delay": 2}), [FITS]),
    "a model of faults that is not shipped": (
        "both", lambda d: d.replace(options={**d.options, "fault_model": "ramp"}), ["model of faults"],
    ),
    "a walk that is not shipped": (
        "both", lambda d: d.replace(options={**d.options, "fault_rate": 0.06}), ["walks of faults"],
    ),
    "known input": ("both", observer(Bu=at(0, 0)), [U_ERROR]),
    "known input at once": ("both", observer(Du=at(0, 0)), [U_ROW]),
    "input of the plant": ("both", of_plant(B=at(0, 0)), [U_ERROR]),
    "disturbance of the plant": (
        "both", of_plant(Bd=at(1, 0)), [D_ERROR, LEAK, FREE_A, FREE_B],
    ),
    "T0 sees a dynamic row": ("both", matrix("T0", at(0, 0, add=1.0)), [T0E, A_ROW, U_ROW, D_ROW, MODELS, "gains"]),
    "a listed gain": ("both", lambda d: d.replace(gains={**d.gains, "T": 1.001 * d.gains["T"]}), ["gains"]),
    "a gain that is none of its own": ("both", lambda d: d.replace(gains={**d.gains, "K": np.eye(2)}), ["gains"]),
    "a gain that is left out": ("both", lambda d: d.replace(gains={"T": d.gains["T"]}), ["gains"]),
    "no proof of stability": ("both", matrix("stability", lambda q: np.diag(-np.diag(q) + 1e3)), [STABILITY]),
    "order": ("both", claim(order=1.0), [ORDER]),
    "order, more than there are": ("both", claim(order=40.0), [ORDER]),
    "order, off by one": ("both", lambda d: claim(order=d.certificate.claims["order"] - 1.0)(d), [ORDER]),
    "decay": ("both", claim(decay=1e3), [DECAY]),
    "decay, a little too fast": ("both", lambda d: claim(decay=1.01 * d.certificate.claims["decay"])(d), [DECAY]),
    "a claimed gain": ("both", claim(gamma=1e-9), ["claims covered"]),
    "a claimed error per unit of a state": (
        "both", matrix("state_error", lambda found: 0.5 * found), ["stored numbers: states"],
    ),
    "no error per unit of a state": ("both", matrix("state_error", np.zeros_like), ["stored numbers: states"]),
    "a claimed error per unit of an input": (
        "both", matrix("input_error", lambda found: 0.5 * found), ["stored numbers: inputs"],
    ),
    "a claimed error per unit of a disturbance": (
        "both", matrix("disturbance_error", lambda found: 0.5 * found), ["stored numbers: disturbances"],
    ),
    "motion": ("both", matrix("tracking", at(0, 0)), [MOTION, MODELS, ERROR_A]),
    "deviations": (
        "both", matrix("deviations", lambda found: 0.5 * found), [NOISE_A, NOISE_B, ERROR_A, ERROR_B],
    ),
    "deviations, a little too small": (
        "both", matrix("deviations", lambda found: 0.99 * found), [NOISE_A, NOISE_B, ERROR_A, ERROR_B],
    ),
    # The closest sums are 8 to 16 % below what is claimed, as processors round: that much less is still true.
    "claimed errors per unit, a little too small": (
        "both", lambda d: matrix("state_error", lambda found: 0.8 * found)(
            matrix("input_error", lambda found: 0.8 * found)(
                matrix("disturbance_error", lambda found: 0.8 * found)(d))),
        ["stored numbers: states", "stored numbers: inputs", "stored numbers: disturbances"],
    ),
    "a fault that nothing shows": (
        "both", of_plant(Df=lambda found: 0.0 * found), [SHOWS_A, MODELS, MOTION],
    ),
    "dynamics of the plant": ("both", of_plant(A=at(1, 1)), [A_ERROR, LEAK, FREE_A, FREE_B]),
    "a that is b": (
        "both", of_plant(Df=lambda found: 0.0 * found, Bf=lambda found: found[:, [1, 1]]),
        [SHOWS_A, SHOWS_B, MODELS, MOTION, FREE_B],
    ),
    "seen only while they change": (
        "apart", of_plant(Bf=lambda found: -0.5 * found), [FOLLOWS_A, FOLLOWS_B, MOTION],
    ),
}  # fmt: skip


@pytest.mark.one_in(4)
@pytest.mark.parametrize("case", TABLE)
def test_exactly_the_untrue_rows_fail(case: str) -> None:
    assert_exactly_the_untrue_rows_fail(TABLE, case, good)


def test_every_row_is_broken() -> None:
    assert_every_row_is_broken(TABLE, *(good(name).report for name in DESIGNS))

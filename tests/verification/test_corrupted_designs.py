"""The corruption table: every row of the verification report fails when, and only when, what it claims is untrue."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from corruption_tables import (
    assert_every_row_is_broken,
    assert_exactly_the_untrue_rows_fail,
    claim,
    entry,
    failed,
    last_digits,
    nudged,
    scattered,
    slow_plant,
    with_certificate,
    with_observer,
    with_plant,
    without_claim,
)

from obsynth import (
    Certificate,
    DescriptorSystem,
    ObserverDesign,
    SpecError,
    VerificationReport,
    design_from_gains,
    fault_estimation_filter,
    verify,
)
from obsynth.plants.transformations.recovery import StateRecovery
from obsynth.plants.uncertainty import matrices_of
from obsynth.specs.loader import load_spec
from obsynth.verification.claims import WITNESS_CLAIMS
from obsynth.verification.least_gain_proof import LEAST_GAIN_WITNESSES

PAPER = Path(__file__).parents[2] / "designs" / "wang2015" / "spec.yaml"

DYNAMICS, INPUTS, STATE = "unbiased: dynamics", "unbiased: inputs", "unbiased: state"
FAULT, RESIDUAL, FEEDTHROUGH = "unbiased: fault", "unbiased: residual", "unbiased: feedthrough"
DECOUPLED, ESTIMATE = "fault decoupled after its delay", "fault estimate"
IN_RESIDUAL, IN_STATE = "fault in the residual", "no fault in the state estimate"
RADIUS, LMI, NORM, FITS = "spectral radius", "LMI", "H-infinity norm", "fits the plant"
GAINS, RESTRICTED, WEIGHT, PAPERS = "gains fit", "gains: T and N", "gains: W", "gains: paper's W"
MATRIX, FREE, REALISED = "gains: Psi and Upsilon", "gains: R", "gains: realisation"
CLAIMS, ORDER = "claims", "claimed gains"
RECOVERY, KEPT = "recovery fits", "recovery of kept states"
TEXTS, FAMILY = "tolerances as written", "tolerances of the plant"
ESTIMATES = (ESTIMATE, IN_RESIDUAL)


# The good designs.


def paper() -> DescriptorSystem:
    """The paper's example: index 1 for both faults, an algebraic state."""
    return load_spec(PAPER).plant


def chain() -> DescriptorSystem:
    """Detectability indexes 3 and 1: the state estimate lags by two samples, past states form a chain."""
    return DescriptorSystem(
        np.diag([1.0, 1, 1, 1, 0]),
        [[0.5, 1, 0, 0, 0], [0.1, 0.4, 1, 0, 0], [0, 0.2, 0.3, 0, 0.1], [0.1, 0, 0, 0.6, 0.2], [0, 0.3, 0, 0.1, -1]],
        [[0], [1], [0], [0.5], [0.2]],
        [[1, 0, 0, 0, 0], [0, 0, 0, 1, 0], [0, 0, 0, 0, 1]],
        Bf=[[0, 0], [0, 0], [1, 0], [0, 1], [0, 0]],
        Bd=[[0.1], [0.2], [0.3], [0.1], [0.1]],
        dt=0.1,
    )


def direct() -> DescriptorSystem:
    """Feedthrough of input, fault and disturbance, and sensor noise; one fault is that of a sensor."""
    return DescriptorSystem(
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


def quiet() -> DescriptorSystem:
    """No disturbance; an unstable plant."""
    return DescriptorSystem(
        np.diag([1.0, 1, 0]),
        [[1.1, 0.2, 0], [-0.1, 0.8, 0.3], [0.2, 0.1, -1]],
        [[1], [0.5], [0.2]],
        [[1, 0, 0], [0, 0, 1]],
        Bf=[[1.0], [0], [0.1]],
        dt=0.5,
    )


def drifting() -> DescriptorSystem:
    """A state that adds up the disturbance for ever, and from which the fault estimate is all but decoupled."""
    return DescriptorSystem(
        None, [[1.0, 0], [0, 0.5]], C=np.eye(2), Bf=[[0.0], [1]], Bd=[[1000.0], [0.01]], dt=1.0
    )  # fmt: skip


def metered() -> DescriptorSystem:
    """A disturbance that a state adds up for ever, and that another one shows at once: the estimate is free of it."""
    return DescriptorSystem(
        None, np.diag([1.0, 0.5, 0.0]), C=np.eye(3), Bf=[[0.0], [1], [0]], Bd=[[1.0], [1], [1]], dt=1.0
    )


PLANTS = {"paper": paper, "chain": chain, "direct": direct, "quiet": quiet, "drifting": drifting}


@cache
def good(name: str) -> ObserverDesign:
    if name == "slow":
        return fault_estimation_filter(slow_plant(1.0), name=name)
    if name == "metered":
        return fault_estimation_filter(metered(), weight="free", name=name)
    return fault_estimation_filter(PLANTS[name](), weight="paper", name=name)


# Ways to corrupt a design.


def tolerances(**changes: object) -> Callable[[ObserverDesign], ObserverDesign]:
    """Change what is stored of the tolerances, for which nominal plant and observer stay as they are."""

    def corrupt(design: ObserverDesign) -> ObserverDesign:
        changed = {name: value(design.plant) for name, value in changes.items()}
        return with_plant(design, uncertainty=dataclasses.replace(design.plant.uncertainty, **changed))

    return corrupt


def plant_entry(name: str, row: int, column: int, by: float) -> Callable[[ObserverDesign], ObserverDesign]:
    return lambda design: with_plant(design, **{name: nudged(getattr(design.plant, name), row, column, by)})


def certificate_entry(name: str, row: int, column: int, value: float) -> Callable[[ObserverDesign], ObserverDesign]:
    def corrupt(design: ObserverDesign) -> ObserverDesign:
        changed = np.array(design.certificate.matrices[name])
        changed[row, column] = value
        return with_certificate(design, **{name: changed})

    return corrupt


def certificate_times(name: str, factor: float) -> Callable[[ObserverDesign], ObserverDesign]:
    return lambda design: with_certificate(design, **{name: factor * design.certificate.matrices[name]})


def certificate_cut(name: str, *key: object) -> Callable[[ObserverDesign], ObserverDesign]:
    return lambda design: with_certificate(design, **{name: design.certificate.matrices[name][key]})


def claimed_bracket(low: float, high: float) -> Callable[[ObserverDesign], ObserverDesign]:
    """A bracket around the least gain, its ends given relative to it."""

    def corrupt(design: ObserverDesign) -> ObserverDesign:
        least = design.certificate.claims["gamma_min"]
        return with_certificate(design, {"gamma_bracket_low": low * least, "gamma_bracket_high": high * least})

    return corrupt


def gain_set(change: Callable[[dict[str, np.ndarray]], dict[str, np.ndarray]]) -> Callable[..., ObserverDesign]:
    """The letters that go with the realisation, which itself stays as it is."""
    return lambda design: design.replace(gains=change(dict(design.gains)))


def gain_entry(letter: str, row: int, column: int, by: float = 1e-6) -> Callable[..., ObserverDesign]:
    return gain_set(lambda gains: {**gains, letter: nudged(gains[letter], row, column, by)})


def with_recovery(**changes: object) -> Callable[[ObserverDesign], ObserverDesign]:
    """A map back to a plant with one more state, the sum of all others and of all other signals, with changes."""

    def corrupt(design: ObserverDesign) -> ObserverDesign:
        plant = design.plant
        widths = {"input": plant.nu, "fault": plant.nf, "disturbance": plant.nd, "noise": plant.nw}
        fields = {
            f"from_{signal}": np.vstack([np.zeros((plant.nx, n)), np.ones((1, n))]) for signal, n in widths.items()
        }
        fields["from_state"] = np.vstack([np.eye(plant.nx), np.ones((1, plant.nx))])
        fields |= {"noise_kept": np.eye(plant.nw), "names": (*plant.state_names, "their sum")}
        wanted = {name: value(fields[name]) if callable(value) else value for name, value in changes.items()}
        return design.replace(recovery=StateRecovery(**{**fields, **wanted}))

    return corrupt


def observer_field(**changes: object) -> Callable[[ObserverDesign], ObserverDesign]:
    return lambda design: with_observer(design, **changes)


def plant_field(**changes: object) -> Callable[[ObserverDesign], ObserverDesign]:
    return lambda design: with_plant(design, **changes)


def gamma_just_below_the_norm(design: ObserverDesign) -> ObserverDesign:
    return with_certificate(design, {"gamma": design.report[NORM].value * (1.0 - 1e-4)})


def gamma_hardly_below_the_norm(design: ObserverDesign) -> ObserverDesign:
    """Below by less than the norm's own tolerance: the row fails because its upper bound is compared."""
    return with_certificate(design, {"gamma": design.report[NORM].value * (1.0 - 0.5e-9)})


def in_continuous_time(design: ObserverDesign) -> ObserverDesign:
    return with_plant(with_observer(design, dt=0.0), dt=0.0)


def swapped_faults(design: ObserverDesign) -> ObserverDesign:
    """The estimates of two faults under each other's names."""
    observer, nx = design.observer, design.plant.nx
    rows = [*range(nx), nx + 1, nx, *range(nx + 2, len(observer.Cz))]
    return with_observer(design, Cz=observer.Cz[rows], Dy=observer.Dy[rows], Du=observer.Du[rows])


def with_paper_state_estimate(design: ObserverDesign) -> ObserverDesign:
    """The paper's state estimate z + N y, biased by Psi under a fault: no correction by the residual."""
    observer, nx = design.observer, design.plant.nx
    psi, residual = design.gains["Psi"], observer.residual_rows
    cz, dy, du = (np.array(getattr(observer, name)) for name in ("Cz", "Dy", "Du"))
    cz[:nx] -= psi @ cz[residual]
    dy[:nx] -= psi @ dy[residual]
    du[:nx] -= psi @ du[residual]
    return with_observer(design, Cz=cz, Dy=dy, Du=du)


def with_unstable_gain(design: ObserverDesign) -> ObserverDesign:
    """L moved along the directions that keep (TA - LC) Psi = 0: unbiased, decoupled, and unstable."""
    gains = design.gains
    free = np.eye(design.plant.ny) - gains["Upsilon"] @ np.linalg.pinv(gains["Upsilon"])
    moved = gains["L"] - 10.0 * np.ones((len(gains["L"]), 1)) @ np.ones((1, design.plant.ny)) @ free
    gamma = design.certificate.claims.get("gamma")
    return design_from_gains(
        design.plant, "fault-estimation-filter", T=gains["T"], N=gains["N"], L=moved, W=gains["W"], gamma=gamma
    )


def without_faults(design: ObserverDesign) -> ObserverDesign:
    """Plant and observer agree that there is no fault: nothing is estimated."""
    plant, rows = design.plant, design.observer.state_rows
    bare = with_plant(design, Bf=np.zeros((plant.nx, 0)), Df=np.zeros((plant.ny, 0)), fault_names=())
    parts = {name: getattr(design.observer, name)[rows] for name in ("Cz", "Dy", "Du")}
    gains = design.gains
    nothing = {"W": gains["W"][:0], "Psi": gains["Psi"][:, :0], "Upsilon": gains["Upsilon"][:, :0], "R": gains["L"]}
    bare = bare.replace(gains={**gains, **nothing})
    return with_observer(bare, **parts, fault_names=(), residual_names=(), fault_delays=())


def with_more_faults_than_outputs(design: ObserverDesign) -> ObserverDesign:
    rng = np.random.default_rng(1)
    count = design.plant.ny + 1
    return with_plant(design, Bf=rng.standard_normal((design.plant.nx, count)), Df=None, fault_names=None)


def grown(matrix: np.ndarray, rows: int, columns: int, corner: float = 0.0) -> np.ndarray:
    """Return the matrix with zero rows and columns appended, and ``corner`` in the last place."""
    larger = np.zeros((matrix.shape[0] + rows, matrix.shape[1] + columns))
    larger[: matrix.shape[0], : matrix.shape[1]] = matrix
    if rows and columns:
        larger[-1, -1] = corner
    return larger


def with_repeated_output(design: ObserverDesign) -> ObserverDesign:
    """The last output once more, as it is without the unknown inputs; the observer does not use it, so all else stays
    true.  With it there are fewer independent directions of C than independent outputs: their difference measures an
    unknown input."""
    plant, observer = design.plant, design.observer
    again = {
        name: np.vstack([getattr(plant, name), getattr(plant, name)[-1:]]) for name in ("C", "D", "Df", "Dd", "Dw")
    }
    again["Dd"][-1] += 1.0
    larger = with_plant(design, **again, output_names=(*plant.output_names, "again"))
    used = {name: grown(getattr(observer, name), 0, 1) for name in ("By", "Dy")}
    gains = {letter: grown(design.gains[letter], 0, 1) for letter in "NLWR"}
    gains["Upsilon"] = np.vstack([design.gains["Upsilon"], design.gains["Upsilon"][-1:]])
    larger = larger.replace(gains={**design.gains, **gains})
    return with_observer(larger, **used, output_names=(*observer.output_names, "again"))


def with_state(
    design: ObserverDesign, *, e: float, a: float, measured: bool, estimated_by: str | None
) -> ObserverDesign:
    """Append a state of its own, ``e x+ = a x``, to a design without lag, and a row that estimates it.

    ``estimated_by`` is ``"output"`` (its own measurement), ``"copy"`` (a copy of its dynamics) or nothing.
    """
    plant, observer, nx = design.plant, design.observer, design.plant.nx
    more = int(measured)
    changes = {name: grown(getattr(plant, name), 1, 0) for name in ("B", "Bf", "Bd", "Bw")}
    changes |= {name: grown(getattr(plant, name), more, 0) for name in ("D", "Df", "Dd", "Dw")}
    changes |= {"E": grown(plant.E, 1, 1, e), "A": grown(plant.A, 1, 1, a), "C": grown(plant.C, more, 1, 1.0)}
    names = {
        "state_names": (*plant.state_names, "extra"),
        "output_names": (*plant.output_names, "its own")[: plant.ny + more],
    }
    copied = int(estimated_by == "copy")
    cz = np.insert(grown(observer.Cz, 0, copied), nx, 0.0, axis=0)
    dy = np.insert(grown(observer.Dy, 0, more), nx, 0.0, axis=0)
    if estimated_by == "copy":
        cz[nx, -1] = 1.0
    if estimated_by == "output":
        dy[nx, -1] = 1.0
    matrices, gains = design.certificate.matrices, design.gains
    larger = with_plant(design, **changes, **names)
    larger = larger.replace(
        gains={
            "T": grown(gains["T"], 1, 1, 1.0),
            **{letter: grown(gains[letter], 1, more) for letter in ("N", "L", "R")},
            "W": grown(gains["W"], 0, more),
            "Psi": grown(gains["Psi"], 1, 0),
            "Upsilon": grown(gains["Upsilon"], more, 0),
        }
    )
    # What rounding adds is claimed of the smaller plant.
    kept = {name: matrix for name, matrix in matrices.items() if not name.endswith("_error")}
    larger = larger.replace(certificate=Certificate(kept, larger.certificate.claims))
    larger = with_certificate(
        larger,
        tracking=grown(matrices["tracking"], copied, 1, float(copied)),
        P_factor=grown(matrices["P_factor"], copied, copied, 1.0),
    )
    return with_observer(
        larger, **names, state_delays=(0,) * (nx + 1), Cz=cz, Dy=dy,
        Az=grown(observer.Az, copied, copied, a), By=grown(observer.By, copied, more),
        Bu=grown(observer.Bu, copied, 0), Du=np.insert(observer.Du, nx, 0.0, axis=0),
    )  # fmt: skip


def with_hidden_fault(design: ObserverDesign) -> ObserverDesign:
    """A state that nothing measures (stable, so this alone is harmless), on which the fault then acts alone."""
    hidden = with_state(design, e=1.0, a=0.5, measured=False, estimated_by="copy")
    assert failed(hidden) == set()
    direction = np.zeros((hidden.plant.nx, 1))
    direction[-1] = 1.0
    return with_plant(hidden, Bf=direction)


# What fails when a fault acts otherwise than the observer expects.
WRONG_FAULT = (DECOUPLED, *ESTIMATES, IN_STATE)
OTHER_GAINS = (WEIGHT, MATRIX, REALISED)
UNBIASED = (DYNAMICS, STATE, FAULT, RESIDUAL)


def without_stored_errors(design: ObserverDesign) -> ObserverDesign:
    """The claims that schema 2 adds are gone, and so are the letters: the realisation stands for itself."""
    kept = {name: m for name, m in design.certificate.matrices.items() if not name.endswith("_error")}
    return design.replace(gains={}, certificate=Certificate(kept, design.certificate.claims))


#: Rows on the stored numbers, and on claims that nothing checks.
STORED_X, STORED_U, COVERED = "stored numbers: states", "stored numbers: inputs", "claims covered"
COMPOSITE, LEAST = "gain with stored numbers", "least gain"

#: What is corrupted -> (good design, corruption, exactly the rows that fail).
TABLE: dict[str, tuple[str, Callable[[ObserverDesign], ObserverDesign], tuple[str, ...]]] = {
    # One entry of the observer, by 1e-6.
    "Az": ("paper", entry("Az", 1, 1), (DYNAMICS, DECOUPLED, REALISED)),
    "Az in a direction that only faults excite": ("paper", entry("Az", 1, 3), (DECOUPLED, REALISED)),
    "Az, core of a chain": ("chain", entry("Az", 0, 1), (DYNAMICS, DECOUPLED, *ESTIMATES, IN_STATE, REALISED)),
    "Az, a delayed state drives the core": ("chain", entry("Az", 0, 9), (DYNAMICS, LMI, REALISED)),
    "Az, a delayed state drives itself": ("chain", entry("Az", 6, 6), (DYNAMICS, DECOUPLED, LMI, REALISED)),
    "By": ("paper", entry("By", 2, 1), (DYNAMICS, REALISED)),
    "By with feedthrough of the input": ("direct", entry("By", 1, 1), (DYNAMICS, INPUTS, REALISED)),
    "By of an output with a sensor fault": ("direct", entry("By", 1, 0), (DYNAMICS, INPUTS, *WRONG_FAULT, REALISED)),
    "Bu": ("paper", entry("Bu", 0, 1), (INPUTS, REALISED)),
    "Bu of a delayed state": ("chain", entry("Bu", 12, 0), (INPUTS, REALISED)),
    "Cz, state": ("paper", entry("Cz", 0, 1), (STATE, IN_STATE, REALISED)),
    "Cz, state, seen by faults alone": ("paper", entry("Cz", 2, 3), (IN_STATE, REALISED)),
    "Cz, fault": ("paper", entry("Cz", 4, 1), (FAULT, ESTIMATE, REALISED)),
    "Cz, fault, seen by faults alone": ("paper", entry("Cz", 5, 3), (ESTIMATE, REALISED)),
    "Cz, fault from a delayed state": ("chain", entry("Cz", 6, 9), (FAULT, LMI, REALISED)),
    "Cz, residual": ("paper", entry("Cz", 6, 1), (RESIDUAL, IN_RESIDUAL, REALISED)),
    "Cz, residual, seen by faults alone": ("paper", entry("Cz", 7, 3), (IN_RESIDUAL, REALISED)),
    "Dy, state": ("paper", entry("Dy", 3, 2), (STATE, REALISED)),
    "Dy, fault": ("paper", entry("Dy", 4, 0), (FAULT, REALISED)),
    "Dy, residual": ("paper", entry("Dy", 6, 0), (RESIDUAL, REALISED)),
    "Dy, fault, with feedthrough of input and fault": (
        "direct", entry("Dy", 3, 0), (FAULT, FEEDTHROUGH, ESTIMATE, REALISED)),
    "Dy, state, with feedthrough of input and fault": (
        "direct", entry("Dy", 0, 0), (STATE, FEEDTHROUGH, IN_STATE, REALISED)),
    "Du, state": ("paper", entry("Du", 0, 0), (FEEDTHROUGH, REALISED)),
    "Du, fault": ("paper", entry("Du", 4, 1), (FEEDTHROUGH, REALISED)),
    "Du, residual": ("direct", entry("Du", 5, 0), (FEEDTHROUGH, REALISED)),
    # What the observer says about itself.
    "fault delay one too long": ("paper", observer_field(fault_delays=(2, 1)), (*ESTIMATES, GAINS)),
    "fault delay far too long": ("quiet", observer_field(fault_delays=(40,)), (*ESTIMATES, GAINS)),
    "fault delay one too short": ("chain", observer_field(fault_delays=(2, 1)), (DECOUPLED, *ESTIMATES, GAINS)),
    "fault delays exchanged": ("chain", observer_field(fault_delays=(1, 3)), (*ESTIMATES, *OTHER_GAINS)),
    "no fault delay": ("paper", observer_field(fault_delays=(0, 1)), (FITS,)),
    "state delays": ("paper", observer_field(state_delays=(1, 1, 1, 1)), (FITS,)),
    "one state delay": ("chain", observer_field(state_delays=(2, 2, 2, 2, 1)), (FITS,)),
    "sampling time of the observer": ("paper", observer_field(dt=0.5), (FITS,)),
    "input names": ("paper", observer_field(input_names=("u2", "u1")), (FITS,)),
    "output names": ("paper", observer_field(output_names=("x3", "x2", "x4")), (FITS,)),
    "state names": ("paper", observer_field(state_names=("x2", "x1", "x3", "x4")), (FITS,)),
    "fault names": ("paper", observer_field(fault_names=("actuator 2", "actuator 1")), (FITS,)),
    "residual names": ("paper", observer_field(residual_names=("a", "b")), (FITS,)),
    "fault estimates exchanged": ("paper", swapped_faults, (ESTIMATE, REALISED)),
    "the paper's biased state estimate": ("paper", with_paper_state_estimate, (IN_STATE, REALISED)),
    "unstable gain": ("quiet", with_unstable_gain, (RADIUS, LMI)),
    "unstable gain, with disturbance": ("paper", with_unstable_gain, (RADIUS, LMI, NORM)),
    # The certificate.
    "tracking": (
        "paper", certificate_entry("tracking", 0, 0, 0.9),
        (DYNAMICS, INPUTS, STATE, DECOUPLED, IN_STATE, REALISED, LMI)),
    "tracking, a delayed state": ("chain", certificate_entry("tracking", 6, 6, 1.0 + 1e-6), (DYNAMICS, REALISED)),
    "tracking zero": ("paper", certificate_times("tracking", 0.0), (*UNBIASED, INPUTS, *ESTIMATES, REALISED)),
    "tracking NaN": ("paper", certificate_entry("tracking", 1, 2, np.nan), (FITS,)),
    "tracking infinite": ("quiet", certificate_entry("tracking", 1, 2, np.inf), (FITS,)),
    "tracking without a row": ("paper", certificate_cut("tracking", slice(1, None)), (FITS,)),
    "tracking a vector": ("paper", certificate_cut("tracking", 0), (FITS,)),
    "P_factor wrong": ("paper", certificate_entry("P_factor", 0, 0, 1.0), (LMI,)),
    "P_factor zero": ("paper", certificate_times("P_factor", 0.0), (LMI,)),
    "P_factor zero, no disturbance": ("quiet", certificate_times("P_factor", 0.0), (LMI,)),
    "P_factor with a zero on the diagonal": ("chain", certificate_entry("P_factor", 2, 2, 0.0), (LMI,)),
    "P_factor not triangular": ("paper", certificate_entry("P_factor", 3, 0, 1e-300), (LMI,)),
    "P_factor twice as large": ("paper", certificate_times("P_factor", 2.0), (LMI,)),
    "P_factor tiny": ("quiet", certificate_times("P_factor", 1e-200), (LMI,)),
    "P_factor huge": ("direct", certificate_entry("P_factor", 0, 0, 1e300), (LMI,)),
    "P_factor too small for the core": ("paper", certificate_cut("P_factor", slice(1, None), slice(1, None)), (LMI,)),
    "P_factor empty": ("quiet", certificate_cut("P_factor", slice(0), slice(0)), (LMI,)),
    "P_factor NaN": ("paper", certificate_entry("P_factor", 0, 1, np.nan), (FITS,)),
    "P_factor infinite": ("direct", certificate_entry("P_factor", 0, 1, np.inf), (FITS,)),
    "P_factor a vector": ("paper", certificate_cut("P_factor", 0), (FITS,)),
    "P_factor not square": ("chain", certificate_cut("P_factor", slice(1, None)), (FITS,)),
    "no matrices": ("paper", lambda d: d.replace(certificate=Certificate({}, d.certificate.claims)), (FITS,)),
    "no claims": ("paper", lambda d: d.replace(certificate=Certificate(d.certificate.matrices, {})), (FITS, CLAIMS)),
    "gamma 1e-4 below the norm": ("paper", gamma_just_below_the_norm, (LMI, NORM)),
    "gamma 1e-4 below the norm, chain": ("chain", gamma_just_below_the_norm, (LMI, NORM)),
    "gamma 1e-4 below the norm, feedthrough": ("direct", gamma_just_below_the_norm, (LMI, NORM)),
    "gamma within 1e-9 of the norm": ("paper", gamma_hardly_below_the_norm, (LMI, NORM)),
    "gamma NaN": ("paper", claim("gamma", np.nan), (LMI, NORM, CLAIMS, ORDER)),
    "gamma zero": ("direct", claim("gamma", 0.0), (LMI, NORM, CLAIMS, ORDER)),
    "gamma negative": ("paper", claim("gamma", -1.6), (LMI, NORM, CLAIMS, ORDER)),
    "gamma infinite": ("paper", claim("gamma", np.inf), (LMI, CLAIMS, ORDER)),
    "lag NaN": ("paper", claim("state_lag", np.nan), (FITS, CLAIMS)),
    "lag infinite": ("chain", claim("state_lag", np.inf), (FITS, CLAIMS)),
    "lag negative": ("paper", claim("state_lag", -1.0), (FITS,)),
    "lag not whole": ("paper", claim("state_lag", 0.5), (FITS,)),
    "lag too long": ("chain", claim("state_lag", 3.0), (FITS,)),
    # What the certificate claims.
    "no gamma": ("paper", without_claim("gamma"), (LMI, NORM, CLAIMS, ORDER)),
    "gamma a text": ("paper", claim("gamma", "1.6"), (LMI, NORM, CLAIMS, ORDER)),
    "gamma true": ("direct", claim("gamma", True), (LMI, NORM, CLAIMS, ORDER)),
    "gamma NaN without a disturbance": ("quiet", claim("gamma", np.nan), (CLAIMS,)),
    "gamma zero without a disturbance": ("quiet", claim("gamma", 0.0), (CLAIMS,)),
    "lag a text": ("chain", claim("state_lag", "2"), (FITS, CLAIMS)),
    "a claim that nobody knows": ("paper", claim("delay_margin", 1.0), (CLAIMS,)),
    "a claim that nobody knows, no disturbance": ("quiet", claim("gamma_max", 1.0), (CLAIMS,)),
    "gamma_min above gamma": ("paper", claim("gamma_min", 1.6), (ORDER, LEAST)),
    "gamma_min a little too high": ("paper", lambda d: claim("gamma_min", 1.001 * d.certificate.claims["gamma_min"])(d),
                                    (LEAST,)),
    "gamma_min a little too low": ("chain", lambda d: claim("gamma_min", 0.999 * d.certificate.claims["gamma_min"])(d),
                                   (LEAST,)),
    "a proof of the least gain, of another": (
        "paper", lambda d: with_certificate(d, least_gain_pairs=d.certificate.matrices["least_gain_pairs"][::-1]),
        (LEAST,)),
    "a proof of the least gain, cut": ("paper", certificate_cut("least_gain_pairs", slice(1, None)), (LEAST,)),
    "gamma_min negative": ("chain", claim("gamma_min", -0.1), (ORDER, LEAST)),
    "gamma_min NaN": ("direct", claim("gamma_min", np.nan), (CLAIMS, ORDER, LEAST)),
    "gamma_min without gamma": ("quiet", claim("gamma_min", 0.1), (ORDER,)),
    "bracket above gamma_min": ("paper", claimed_bracket(1.001, 1.002), (ORDER,)),
    "bracket below gamma_min": ("paper", claimed_bracket(0.998, 0.999), (ORDER,)),
    "bracket turned round": ("paper", claimed_bracket(1.001, 0.999), (ORDER,)),
    "bracket from below zero": ("paper", claimed_bracket(-0.1, 1.0), (ORDER,)),
    "bracket NaN": ("direct", claimed_bracket(np.nan, 1.0), (CLAIMS, ORDER)),
    "half a bracket": ("paper", claim("gamma_bracket_low", 1.0), (CLAIMS, ORDER)),
    # The gain set is not that of the realisation.
    "T": ("paper", gain_entry("T", 0, 0), (RESTRICTED, MATRIX, FREE, REALISED)),
    "N": ("paper", gain_entry("N", 1, 0), (RESTRICTED, REALISED)),
    "L": ("paper", gain_entry("L", 3, 2), (FREE, REALISED)),
    "W": ("chain", gain_entry("W", 1, 1), (WEIGHT, PAPERS, REALISED)),
    "Psi": ("paper", gain_entry("Psi", 2, 0), (MATRIX, FREE)),
    "Upsilon": ("direct", gain_entry("Upsilon", 3, 1), (MATRIX, FREE, PAPERS)),
    "R": ("paper", gain_entry("R", 0, 0), (FREE,)),
    "gains rounded": (
        "paper", gain_set(lambda gains: {key: np.round(gain, 5) for key, gain in gains.items()}),
        (WEIGHT, FREE, PAPERS, REALISED)),
    "no W": ("quiet", gain_set(lambda gains: {key: gains[key] for key in gains if key != "W"}), (GAINS,)),
    "a letter that nobody knows": ("paper", gain_set(lambda gains: {**gains, "K": gains["L"]}), (GAINS,)),
    "L without a row": ("chain", gain_set(lambda gains: {**gains, "L": gains["L"][1:]}), (GAINS,)),
    "Upsilon transposed": ("paper", gain_set(lambda gains: {**gains, "Upsilon": gains["Upsilon"].T}), (GAINS,)),
    # The way back to the states before a transformation.
    "tolerances of other entries": ("paper", tolerances(entries=lambda plant: {"A": ((0, 1, "A[1,1]"),)}), (TEXTS,)),
    "tolerances of another plant": (
        "paper", tolerances(written=matrices_of, steps=lambda plant: (("eliminate", 0.0),)), (FAMILY,)),
    "recovery without a name": ("paper", with_recovery(names=lambda names: names[1:]), (RECOVERY,)),
    "recovery with a name twice": ("paper", with_recovery(names=lambda names: (*names[:-1], names[0])), (RECOVERY,)),
    "recovery with names in a list": ("quiet", with_recovery(names=list), (RECOVERY,)),
    "recovery from other states": ("paper", with_recovery(from_state=lambda m: m[:, 1:]), (RECOVERY,)),
    "recovery from other inputs": ("paper", with_recovery(from_input=lambda m: m[:, 1:]), (RECOVERY,)),
    "recovery from other faults": ("direct", with_recovery(from_fault=lambda m: m[:, 1:]), (RECOVERY,)),
    "recovery from other disturbances": ("direct", with_recovery(from_disturbance=lambda m: m[:, 1:]), (RECOVERY,)),
    "recovery from other noise": ("direct", with_recovery(from_noise=lambda m: m[1:]), (RECOVERY,)),
    "recovery of other noise": ("direct", with_recovery(noise_kept=lambda m: m[:, 1:]), (RECOVERY,)),
    "recovery NaN": ("chain", with_recovery(from_state=lambda m: np.nan * m), (RECOVERY,)),
    "recovery exchanges states": ("paper", with_recovery(from_state=lambda m: m[[1, 0, *range(2, len(m))]]), (KEPT,)),
    "recovery adds a fault to a state": ("quiet", with_recovery(from_fault=lambda m: m + 1e-6), (KEPT,)),
    # Numbers that overflow.
    "Az huge": ("paper", entry("Az", 0, 0, 1e300), (DYNAMICS, DECOUPLED, RADIUS, LMI, NORM, REALISED)),
    "Cz huge": ("direct", entry("Cz", 3, 0, 1e300), (FAULT, ESTIMATE, LMI, NORM, REALISED)),
    "By huge": ("direct", entry("By", 0, 0, 1e300), (DYNAMICS, INPUTS, *WRONG_FAULT, LMI, NORM, REALISED)),
    # The plant is another one.
    "E": ("paper", plant_entry("E", 0, 0, 1e-6), (DYNAMICS, STATE, RESTRICTED)),
    "A": ("paper", plant_entry("A", 3, 2, 1e-6), (DYNAMICS, FREE, REALISED)),
    "B": ("paper", plant_entry("B", 1, 1, 1e-6), (INPUTS, REALISED)),
    "C": ("paper", plant_entry("C", 0, 1, 1e-6), (*UNBIASED, RESTRICTED, *OTHER_GAINS, LEAST)),
    "D": ("direct", plant_entry("D", 1, 0, 1e-6), (INPUTS, FEEDTHROUGH, REALISED)),
    "fault direction": ("quiet", plant_entry("Bf", 0, 0, 1e-6), (*WRONG_FAULT, *OTHER_GAINS)),
    "fault direction, index 3": ("chain", plant_entry("Bf", 2, 0, 1e-6), (*ESTIMATES, *OTHER_GAINS)),
    "direction of a sensor fault": (
        "direct", plant_entry("Df", 1, 0, 1e-6), (*WRONG_FAULT, RESTRICTED, *OTHER_GAINS)),
    "disturbance twice as large": ("paper", lambda d: with_plant(d, Bd=2.0 * d.plant.Bd), (LMI, NORM, LEAST)),
    "disturbance in the outputs": ("direct", plant_entry("Dd", 1, 0, 5.0), (LMI, NORM, LEAST)),
    "sampling time of the plant": ("paper", plant_field(dt=0.5), (FITS,)),
    "continuous plant": ("paper", plant_field(dt=0.0), ("exists: discrete time", FITS)),
    "names of the plant": ("paper", plant_field(state_names=["a", "b", "c", "d"]), (FITS,)),
    # Existence conditions.
    "continuous plant and observer": ("quiet", in_continuous_time, ("exists: discrete time",)),
    "continuous plant and observer, disturbance": ("paper", in_continuous_time, ("exists: discrete time",)),
    "no fault": ("quiet", without_faults, ("exists: faults", REALISED)),
    "no fault, disturbance and noise": ("direct", without_faults, ("exists: faults", GAINS)),
    "a state that no equation determines": (
        "quiet", lambda d: with_state(d, e=0.0, a=0.0, measured=True, estimated_by="output"),
        ("exists: regularity", GAINS)),
    "more faults than outputs": ("quiet", with_more_faults_than_outputs, ("exists: nf <= ny", FITS)),
    "a fault that acts nowhere": (
        "quiet", plant_field(Bf=np.zeros((3, 1))), ("exists: rank F", *ESTIMATES, *OTHER_GAINS)),
    "two faults in one direction": (
        "paper", lambda d: with_plant(d, Bf=d.plant.Bf[:, [0, 0]]), ("exists: rank F", *ESTIMATES, *OTHER_GAINS)),
    "a repeated output but for the disturbance, which it measures": ("direct", with_repeated_output, (PAPERS,)),
    "outputs that show nothing": (
        "quiet", lambda d: with_plant(d, C=0.0 * d.plant.C),
        ("exists: rank [C Dd]", RESTRICTED, WEIGHT, MATRIX, REALISED, DYNAMICS, STATE, FAULT, RESIDUAL)),
    "an algebraic state that nothing measures": (
        "quiet", lambda d: with_state(d, e=0.0, a=1.0, measured=False, estimated_by=None),
        ("exists: rank [E; C]", STATE, GAINS)),
    "a sensor fault like an algebraic state": (
        "quiet", plant_entry("Df", 1, 0, 1.0), ("exists: rank [E 0; 0 0; C Df]", *WRONG_FAULT)),
    "a fault that reaches no output": (
        "quiet", with_hidden_fault, ("exists: finite detectability indexes", *WRONG_FAULT, *OTHER_GAINS)),
    "two faults alike at first sight": (
        "chain", plant_field(Bf=[[0, 0], [0, 1], [1, 0], [0, 0], [0, 0]]),
        ("exists: rank Upsilon", *ESTIMATES, IN_STATE, *OTHER_GAINS)),
    "two faults alike through the dynamics": (
        "chain", plant_entry("A", 3, 2, 0.5), ("exists: rank Upsilon", DYNAMICS, FREE, *OTHER_GAINS)),
    "a zero outside the unit circle": (
        "quiet", plant_field(A=[[1.1, 0.2, 0], [-0.1, 1.3, 0.3], [0.2, 0, -1]], Bf=[[1.0], [0], [0]]),
        ("exists: fault zeros", DYNAMICS, *WRONG_FAULT, *OTHER_GAINS)),
    "an unstable mode that nothing measures": (
        "quiet", lambda d: with_state(d, e=1.0, a=1.1, measured=False, estimated_by="copy"),
        ("exists: fault zeros", RADIUS, LMI)),
    "a mode on the unit circle that nothing measures": (
        "quiet", lambda d: with_state(d, e=1.0, a=1.0, measured=False, estimated_by="copy"),
        ("exists: fault zeros", RADIUS, LMI)),
    # The last digits: every identity passes, and the claimed error per unit of a state or an input is passed.
    "By in the last digits": ("paper", lambda d: with_observer(d, By=d.observer.By * (1.0 + 3e-13)), (STORED_X,)),
    "a claimed error per unit of a state": ("paper", certificate_times("state_error", 0.9), (STORED_X,)),
    "a claimed error per unit of an input": ("direct", certificate_times("input_error", 0.1), (STORED_U,)),
    "a claimed error that is no number": ("paper", certificate_entry("state_error", 0, 0, np.nan), (STORED_X,)),
    "a claimed error of another shape": ("paper", certificate_cut("state_error", slice(1, None)), (STORED_X,)),
    "a gain from a state that never decays": (
        "metered", lambda d: without_stored_errors(entry("By", 1, 0, 2e-10)(d)), (COMPOSITE,)),
    "By in the last digits, of a slow plant": ("slow", last_digits, ("constant fault",)),
    "a matrix that nothing checks": ("paper", lambda d: with_certificate(d, more=np.eye(2)), (COVERED,)),
}  # fmt: skip


@pytest.mark.one_in(5)
@pytest.mark.parametrize("name", PLANTS)
def test_a_good_design_passes(name: str) -> None:
    design = good(name)
    assert design.report.passed
    assert failed(design) == set()


@pytest.mark.parametrize("name", PLANTS)
def test_good_claims_and_a_good_recovery_pass(name: str) -> None:
    design = with_recovery()(good(name))
    if design.plant.nd:
        design = claimed_bracket(1.0 - 1e-6, 1.0)(design)
        assert verify(design)[ORDER].passed
    assert failed(design) == set()
    assert verify(design)[RECOVERY].passed
    assert verify(design)[KEPT].passed


#: The first output shows no fault: what is added to R there, in the row of T A Psi, makes another left inverse G.
ALSO_RIGHT = {("drifting", "R", (1, 0))}


@pytest.mark.parametrize("letter", ["T", "N", "L", "W", "Psi", "Upsilon", "R"])
@pytest.mark.parametrize("name", PLANTS)
def test_every_single_entry_of_the_gain_set_counts(name: str, letter: str, share: Callable[..., Any]) -> None:
    for row, column in share(scattered(good(name).gains[letter].shape)):
        if (name, letter, (row, column)) in ALSO_RIGHT:
            continue
        assert failed(gain_entry(letter, row, column)(good(name))), (row, column)


@pytest.mark.one_in(4)
@pytest.mark.parametrize("case", TABLE)
def test_exactly_the_rows_that_are_untrue_fail(case: str) -> None:
    assert_exactly_the_untrue_rows_fail(TABLE, case, good)


def test_the_table_breaks_every_row_that_verification_produces() -> None:
    assert_every_row_is_broken(TABLE, *(good(name).report for name in PLANTS))


#: Observer matrix -> for each part of its rows, the rows of the report of which at least one must fail.
CAUGHT_BY = {
    "Az": {"all": {DYNAMICS, DECOUPLED}},
    "Bu": {"all": {INPUTS}},
    "By": {"all": {DYNAMICS}},
    "Cz": {"state": {STATE, IN_STATE}, "fault": {FAULT, ESTIMATE}, "residual": {RESIDUAL, IN_RESIDUAL}},
    "Du": {"state": {FEEDTHROUGH}, "fault": {FEEDTHROUGH}, "residual": {FEEDTHROUGH}},
    "Dy": {"state": {STATE}, "fault": {FAULT}, "residual": {RESIDUAL}},
}


@pytest.mark.one_in(4)
@pytest.mark.parametrize("matrix", CAUGHT_BY)
@pytest.mark.parametrize("name", PLANTS)
def test_every_single_entry_of_the_observer_counts(name: str, matrix: str, share: Callable[..., Any]) -> None:
    design = good(name)
    observer = design.observer
    parts = {"state": observer.state_rows, "fault": observer.fault_rows, "residual": observer.residual_rows}
    shape = getattr(observer, matrix).shape
    for part, causes in CAUGHT_BY[matrix].items():
        rows = range(shape[0])[parts.get(part, slice(None))]
        for row, column in share([place for place in scattered(shape) if place[0] in rows], 5):
            found = failed(entry(matrix, row, column)(design))
            assert found & causes, (row, column, found)


@pytest.mark.one_in(4)
@pytest.mark.parametrize("matrix", ["E", "A", "B", "C", "D", "Bf", "Df"])
@pytest.mark.parametrize("name", PLANTS)
def test_every_single_entry_of_the_plant_counts(name: str, matrix: str, share: Callable[..., Any]) -> None:
    design = good(name)
    for row, column in share(scattered(getattr(design.plant, matrix).shape), 6):
        assert failed(plant_entry(matrix, row, column, 1e-6)(design)), (row, column)


@pytest.mark.one_in(4)
@pytest.mark.parametrize("name", PLANTS)
def test_not_a_number_anywhere_is_refused_or_fails(name: str, share: Callable[..., Any]) -> None:
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
        for row, column in share(scattered(matrix.shape), 8):
            expected = {LEAST if key in LEAST_GAIN_WITNESSES else WITNESS_CLAIMS.get(key, FITS)}
            assert failed(certificate_entry(key, row, column, np.nan)(design)) == expected
    needed = {"state_lag": {FITS, CLAIMS}}
    needed["gamma"] = {LMI, NORM, CLAIMS, ORDER} if design.plant.nd else {CLAIMS}
    for key, expected in needed.items():
        assert failed(claim(key, np.nan)(design)) == expected
    for letter in design.gains:
        for bad in (np.nan, np.inf):
            assert failed(gain_entry(letter, -1, -1, bad)(design)) == {GAINS}


def in_units(design: ObserverDesign, powers: np.ndarray) -> ObserverDesign:
    """The same design with the states of plant and observer in other units, powers of two: exact in every digit.

    Bounds that are claimed of stored numbers go, which have units, and the proof of the least gain, which has a basis.
    """
    plant, observer, nx = design.plant, design.observer, design.plant.nx
    lag = int(design.certificate.claims["state_lag"])
    core = observer.order - lag * nx
    own = np.concatenate([np.resize(np.append(powers, 1.0), core), *[powers] * lag])
    rows = np.append(powers, np.ones(len(observer.Cz) - nx))[:, None]
    changed = with_plant(design, E=plant.E * powers, A=plant.A * powers, C=plant.C * powers)
    changed = with_observer(
        changed,
        Az=observer.Az * own / own[:, None],
        Bu=observer.Bu / own[:, None],
        By=observer.By / own[:, None],
        Cz=observer.Cz * own / rows,
        Du=observer.Du / rows,
        Dy=observer.Dy / rows,
    )
    matrices = design.certificate.matrices
    moved = {letter: design.gains[letter] / own[:core, None] for letter in ("T", "N", "L", "Psi", "R")}
    changed = changed.replace(gains={**design.gains, **moved})
    kept = {
        key: value for key, value in matrices.items() if key not in WITNESS_CLAIMS and key not in LEAST_GAIN_WITNESSES
    }
    changed = changed.replace(certificate=Certificate(kept, design.certificate.claims))
    return with_certificate(
        changed,
        tracking=matrices["tracking"] * np.concatenate([np.ones(nx), *[powers] * lag]) / own[:, None],
        P_factor=matrices["P_factor"] * own[:core],
    )


@pytest.mark.one_in(4)
@pytest.mark.parametrize("name", PLANTS)
def test_units_of_the_states_do_not_hide_a_corruption(name: str, share: Callable[..., Any]) -> None:
    """What fails is the same when the states are measured in units from 2^-14 to 2^14."""
    design = good(name)
    powers = np.exp2(np.round(np.linspace(-14.0, 14.0, design.plant.nx)))
    assert failed(in_units(design, powers)) == set()
    for matrix in CAUGHT_BY:
        for row, column in share(scattered(getattr(design.observer, matrix).shape), 12):
            corrupted = entry(matrix, row, column)(design)
            assert failed(in_units(corrupted, powers)) == failed(corrupted), (matrix, row, column)


@pytest.mark.parametrize("name", PLANTS)
def test_a_design_without_a_gain_set_says_nothing_about_gains(name: str) -> None:
    bare = good(name).replace(gains={})
    report = verify(bare)
    assert report.passed
    assert not any(check.name.startswith("gains") for check in report.checks)
    assert failed(bare, printed_digits=4) == set()


def test_an_empty_report_does_not_pass() -> None:
    emptied = good("paper").replace(report=VerificationReport())
    assert not emptied.report.passed
    assert verify(emptied).passed


def test_a_report_is_about_the_design_it_is_made_of_not_about_the_one_saved() -> None:
    """The report that a corrupted design carries still says that all is well; only a new one knows."""
    corrupted = entry("By", 0, 0)(good("paper"))
    assert corrupted.report.passed
    assert not verify(corrupted).passed


@pytest.mark.parametrize("name", PLANTS)
def test_verification_changes_nothing(name: str) -> None:
    design = good(name)
    before = [np.array(value) for value in (*design.certificate.matrices.values(), design.observer.Az, design.plant.A)]
    verify(design)
    after = [*design.certificate.matrices.values(), design.observer.Az, design.plant.A]
    assert all(np.array_equal(first, second) for first, second in zip(before, after, strict=True))


class TestPrintedDigits:
    """Gains from paper: rounded to four decimals."""

    GAMMA = 1.6

    def rounded(self, **changes: np.ndarray) -> ObserverDesign:
        gains = {letter: np.round(good("paper").gains[letter], 4) for letter in "TNLW"} | changes
        return design_from_gains(good("paper").plant, "fault-estimation-filter", **gains, gamma=self.GAMMA)

    def test_rounded_gains_fail_by_default_and_pass_with_their_digits(self) -> None:
        design = self.rounded()
        assert failed(design) == {WEIGHT, DECOUPLED, ESTIMATE, IN_RESIDUAL, IN_STATE}
        assert failed(design, printed_digits=4) == set()
        assert failed(design, printed_digits=7) == {WEIGHT, DECOUPLED, ESTIMATE, IN_RESIDUAL, IN_STATE}

    def test_full_digits_pass_either_way(self) -> None:
        for name in PLANTS:
            assert failed(good(name), printed_digits=4) == set()

    @pytest.mark.one_in(4)
    @pytest.mark.parametrize("letter", ["T", "N", "L", "W"])
    def test_any_wrong_digit_still_fails(self, letter: str, share: Callable[..., Any]) -> None:
        gain = np.round(good("paper").gains[letter], 4)
        for row, column in share(scattered(gain.shape), 6):
            for by in (0.05, -0.05):
                wrong = self.rounded(**{letter: nudged(gain, row, column, by)})
                assert failed(wrong, printed_digits=4), (row, column, by)

    def unnoticed(self, letter: str, units: int, places: Sequence[tuple[int, int]]) -> set[tuple[int, int]]:
        """Those of these entries that may be wrong by so many units of the last digit without any row failing."""
        gain = np.round(good("paper").gains[letter], 4)
        return {
            (row, column)
            for row, column in places
            for by in (units * 1e-4, -units * 1e-4)
            if not failed(self.rounded(**{letter: nudged(gain, row, column, by)}), printed_digits=4)
        }

    @pytest.mark.one_in(3)
    @pytest.mark.parametrize("letter", ["T", "N", "W"])
    def test_ten_units_of_the_last_digit_fail(self, letter: str, share: Callable[..., Any]) -> None:
        """What rounding can do to each identity is known entry by entry: a wrong digit before the last one shows."""
        places = share(scattered(good("paper").gains[letter].shape), 5)
        assert self.unnoticed(letter, 10, places) == set()

    @pytest.mark.long
    def test_in_L_ten_units_fail_in_most_entries_and_twenty_in_all(self, share: Callable[..., Any]) -> None:
        """In the rows of large gains, roundings of T at their worst would do as much as ten units of one entry of L."""
        places = share(scattered(good("paper").gains["L"].shape), 3)
        softened = {(0, 0), (0, 1), (3, 0), (3, 1)} & set(places)
        assert softened
        assert softened != set(places)
        assert self.unnoticed("L", 10, places) == softened
        assert self.unnoticed("L", 20, places) == set()

    def test_digits_do_not_soften_the_inequalities(self) -> None:
        lowered = gamma_just_below_the_norm(good("paper"))
        assert failed(lowered, printed_digits=1) == {LMI, NORM}
        assert failed(with_unstable_gain(good("paper")), printed_digits=1) == {RADIUS, LMI, NORM}

    @pytest.mark.parametrize("digits", [0, -1, 16])
    def test_digits_out_of_range(self, digits: int) -> None:
        with pytest.raises(SpecError) as caught:
            verify(good("paper"), printed_digits=digits)
        assert caught.value.path == "printed_digits"

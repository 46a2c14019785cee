"""The corruption table of the recursive methods: every row that decides fails when what it claims is untrue."""

from __future__ import annotations

import dataclasses
from functools import cache

import numpy as np
import pytest
from corruption_tables import Corruption, claim, claim_times, failed, shipped
from time_varying_plants import varying

import obsynth
from obsynth import Certificate, ObserverDesign, verify
from obsynth.plants.sequences import MatrixSequence

FITS, STATE, COVARIANCE, REGRESSOR = "fits the plant", "batch: state", "batch: covariance", "batch: regressor"
CONTRACTION, CLAIMS, NEES, NIS, WHITE, RUNS = "contraction", "claims", "NEES", "NIS", "whiteness", "runs"
RANK, PARAMETERS, DIRECTIONS = "exists: rank [E; C]", "exists: parameters", "exists: residual directions"
EARLY_RANK = "exists: rank [E; C; algebraic rows of A]"
DETECTABLE, IDENTIFIABLE, KNOWN = "exists: detectability", "exists: identifiable parameters", "known directions"
UNBIASED, DEFINITE = "unbiased", "covariance"
STEADY_UNBIASED, STEADY_CONTRACTION = "steady state: unbiased", "steady state: contraction"
STEADY_DEFINITE = "steady state: covariance"
EVERYTHING = {FITS, STATE, COVARIANCE, REGRESSOR, CLAIMS, NEES, NIS, WHITE, CONTRACTION}


GOOD = ("innovation", "literal", "early", "early walk", "walk", "constant", "constant walk", "exact output")
STILL = {
    "E": np.diag([1.0, 1, 0]), "A": [[0.8, 0.1, 0.3], [0, 0.7, 0.2], [1, 0.4, -1]],
    "C": [[1, 0, 0.3], [0, 1, 1]], "Phi": [[0.5, 0.3], [1, 0.2], [0.2, 0]], "Psi": None,
}  # fmt: skip


@cache
def good(name: str = "innovation") -> ObserverDesign:
    if name == "constant":
        return obsynth.adaptive_observer(varying(horizon=60, **STILL), Q=0.1, R=0.2, window=10, name=name)
    if name == "constant walk":
        options = {"form": "random-walk", "random_walk": 1e-3}
        return obsynth.adaptive_observer(varying(horizon=60, **STILL), Q=0.1, R=0.2, window=10, name=name, **options)
    if name == "exact output":
        return obsynth.descriptor_kalman(varying(horizon=60, **STILL), Q=0.1, R=np.diag([0.0, 0.2]), name=name)
    if name == "early walk":
        # The correction of x(0) has as many rows as a step, of other kinds.
        plant = obsynth.TimeVaryingDescriptorSystem(
            E=np.diag([1.0, 0]), A=[[0.9, 0.1], [0.5, -1.0]], C=[[1.0, 0]], Phi=[[0.1], [0.0]], dt=1.0, horizon=60
        )
        return obsynth.adaptive_observer(
            plant, Q=0.1, R=0.2, form="random-walk", random_walk=1e-3, early_constraints=True, window=10, name=name
        )
    options = {"literal": {"form": "literal"}, "early": {"early_constraints": True},
               "walk": {"form": "random-walk", "random_walk": 1e-3}}.get(name, {})  # fmt: skip
    return obsynth.adaptive_observer(varying(horizon=60), Q=0.1, R=0.2, window=10, name=name, **options)


def with_model(**changes) -> Corruption:
    """Another model in the shipped observer than in the plant."""
    return lambda design: shipped(plant=design.plant.replace(**changes))(design)


def with_both(**changes) -> Corruption:
    """Another plant throughout: what the plant itself lacks."""

    def corrupt(design: ObserverDesign) -> ObserverDesign:
        plant = design.plant.replace(**changes)
        return design.replace(plant=plant, observer=dataclasses.replace(design.observer, plant=plant))

    return corrupt


def with_adaptation(**changes) -> Corruption:
    def corrupt(design: ObserverDesign) -> ObserverDesign:
        adaptation = dataclasses.replace(design.observer.adaptation, **changes)
        return shipped(adaptation=adaptation)(design)

    return corrupt


def with_gains(change) -> Corruption:
    def corrupt(design: ObserverDesign) -> ObserverDesign:
        L, K = change(design.gains["L"], design.gains["K"])
        return design.replace(gains={**design.gains, "L": L, "K": K})

    return corrupt


def noise(name: str, size: int, variance: float) -> Corruption:
    return shipped(**{name: MatrixSequence.of(variance * np.eye(size), name)})


OTHER_A = [["0.8 + 0.1 * cos(0.2 * k)", 0.1, 0.3], [0, 0.7, "0.2 * sin(k)"], [1, "0.6 + 0.1 * sin(k)", -1]]
BLIND = {
    "E": np.diag([1.0, 1, 0]), "A": [[1.2, 0, 0], [0, 0.5, 0], [0, 0, 1]], "C": [[0, 1, 1], [0, 0, 1]],
}  # fmt: skip
BLIND_AND_VARYING = {**BLIND, "A": [["1.2 + 0.1 * sin(k)", 0, 0], [0, 0.5, 0], [0, 0, 1]]}
TWINS = [[0.5, 1.0], [1, 2.0], [0.2, 0.4]]

#: Corruption -> what must fail, at least.
TABLE: dict[str, tuple[str, Corruption, set[str]]] = {
    "another A": ("innovation", with_model(A=OTHER_A), {FITS, STATE, REGRESSOR, CLAIMS}),
    "another operating point": ("innovation", with_model(operating_point={"x1": 1.0}), {FITS}),
    "other units": ("innovation", with_model(units={"x1": "m"}), {FITS}),
    "other scales": ("innovation", with_model(scales={"y1": 2.0}), {FITS}),
    "another E": ("innovation", with_model(E=np.diag([1.0, 1.1, 0])), {FITS, STATE, REGRESSOR, CLAIMS}),
    "another B": ("innovation", with_model(B=[[1], [0.5], [0.3]]), {FITS, STATE}),
    "another C": ("innovation", with_model(C=[[1, 0, 0.3], [0, 1, 1.1]]), {FITS, STATE, CLAIMS}),
    "another Phi": ("innovation", with_model(Phi=np.ones((3, 2))), {FITS, REGRESSOR, CLAIMS}),
    "another Psi": ("innovation", with_model(Psi=np.ones((2, 2))), {FITS, REGRESSOR, CLAIMS}),
    "another A, early": ("early", with_model(A=OTHER_A), {FITS, STATE, COVARIANCE, REGRESSOR, CLAIMS}),
    "too little Q": ("innovation", noise("Q", 3, 0.03), {FITS, STATE, COVARIANCE, NEES, NIS, WHITE, CLAIMS}),
    "too much Q": ("innovation", noise("Q", 3, 1.0), {FITS, STATE, COVARIANCE, NEES, NIS, CLAIMS}),
    "too little R": ("innovation", noise("R", 2, 0.02), {FITS, STATE, COVARIANCE, NEES, NIS, CLAIMS}),
    "too little R, literal": ("literal", noise("R", 2, 0.02), {FITS, STATE, COVARIANCE, NEES, NIS, CLAIMS}),
    "too little Q, walk": ("walk", noise("Q", 3, 0.03), {FITS, STATE, COVARIANCE, NEES, NIS}),
    "another P0": ("innovation", shipped(initial_covariance=9.0 * np.eye(3)), {FITS, STATE, COVARIANCE}),
    "another x0": ("innovation", shipped(initial_state=np.ones(3)), {FITS, STATE}),
    "another lambda": ("innovation", with_adaptation(forgetting=0.9), {FITS}),
    "another S0": ("innovation", with_adaptation(initial_covariance=4.0 * np.eye(2)), {FITS}),
    "another theta0": ("innovation", with_adaptation(initial_parameters=np.ones(2)), {FITS}),
    "another guard": ("innovation", with_adaptation(guard="none"), {FITS}),
    "a reset": ("innovation", with_adaptation(reset=1e-6), {FITS}),
    "another window": ("innovation", with_adaptation(window=20), {FITS, CLAIMS}),
    "another walk": ("walk", with_adaptation(walk=np.eye(2)), {FITS, STATE, COVARIANCE}),
    "no adaptation": ("innovation", shipped(adaptation=None), {FITS}),
    "early after all": ("innovation", shipped(early_constraints=True), {FITS, STATE, COVARIANCE}),
    "delayed sensors": ("innovation", shipped(sensors={"y1": {"delay": 1}}), {FITS}),
    "bounds on states": ("innovation", shipped(state_bounds={"x1": [0.0, 1.0]}), {FITS}),
    "another dt": ("innovation", with_model(dt=2.0), {FITS}),
    "another name": ("innovation", with_model(state_names=["a", "b", "c"]), {FITS}),
    "another horizon": ("innovation", with_model(horizon=59), {FITS, CLAIMS}),
    "an option is lost": (
        "innovation", lambda d: d.replace(options={k: v for k, v in d.options.items() if k != "Q"}), {FITS},
    ),
    "an option is wrong": ("innovation", lambda d: d.replace(options={**d.options, "Q": -1.0}), {FITS}),
    "an undetectable mode": ("innovation", with_both(**BLIND_AND_VARYING), {CONTRACTION, CLAIMS}),
    "an undetectable mode, constant": ("constant", with_both(**BLIND), {DETECTABLE}),
    "two parameters in one": ("innovation", with_both(Phi=TWINS, Psi=None), {IDENTIFIABLE}),
    "two parameters in one, constant": ("constant", with_both(Phi=TWINS), {IDENTIFIABLE}),
    "no rank": ("innovation", with_both(E=np.diag([1.0, 0, 0]), C=[[1, 0, 0], [0, 1, 0]]), {RANK}),
    "no rank, early": ("early", with_both(E=np.diag([1.0, 0, 0]), A=np.diag([0.5, 0.5, 0]), C=[[1, 0, 0], [0, 1, 0]]),
                       {EARLY_RANK}),
    "an output taken as exact": (
        "exact output", noise("R", 2, 0.0), {FITS, STATE, COVARIANCE, CLAIMS, NEES, NIS, KNOWN},
    ),
    "no parameters": (
        "innovation", with_both(Phi=None, Psi=None, parameter_names=None), {PARAMETERS},
    ),
    "no residual direction": (
        "literal", with_both(E=np.diag([1.0, 0, 0]), C=[[0, 1, 0], [0, 0, 1]]), {DIRECTIONS},
    ),
    "a singular R, literal": ("literal", noise("R", 2, 0.0), {FITS, RUNS}),
    "claim: condition": ("innovation", claim_times("condition", 1.001), {CLAIMS}),
    "claim: contraction": ("innovation", claim_times("contraction", 1.001), {CLAIMS}),
    "claim: excitation": ("innovation", claim_times("excitation", 1.001), {CLAIMS}),
    "claim: directions": ("innovation", claim_times("residual_directions", 2.0), {CLAIMS}),
    "claim: steps": ("innovation", claim_times("steps", 2.0), {CLAIMS}),
    "claim: sample of the condition": ("innovation", claim("condition_k", 3.5), {CLAIMS}),
    "exact outputs after all": ("innovation", noise("R", 2, 0.0), {FITS, DEFINITE}),
    "another C, constant": (
        "constant", with_model(C=[[1, 0, 0.3], [0, 1, 1.001]]), {FITS, UNBIASED},
    ),
    "a kept gain, by little": ("constant", with_gains(lambda L, K: (L, (1.0 + 1e-7) * K)), {STEADY_UNBIASED}),
    "kept gains that make errors grow": (
        "constant", with_gains(lambda L, K: (10.0 * L, K)), {"gains", STEADY_UNBIASED, STEADY_CONTRACTION},
    ),
    "kept gains that hear nothing": (
        "constant", with_gains(lambda L, K: (0.0 * L, 0.0 * K)), {"gains", STEADY_UNBIASED, STEADY_DEFINITE},
    ),
    "a listed gain": ("innovation", lambda d: d.replace(gains={**d.gains, "K": 1.001 * d.gains["K"]}), {"gains"}),
    "a gain that is left out": ("innovation", lambda d: d.replace(gains={"L": d.gains["L"]}), {"gains"}),
    "claim: a gain": ("innovation", claim("gamma", 1e-9), {"claims covered"}),
    "claim: not a number": ("innovation", claim("contraction", np.nan), {CLAIMS}),
    "claim: missing": (
        "innovation", lambda d: d.replace(certificate=Certificate({}, {"steps": 60.0})), {CLAIMS},
    ),
}  # fmt: skip


def adapted(design: ObserverDesign, corrupt: Corruption) -> ObserverDesign:
    """A corruption that removes parameters must remove them from the observer too."""
    if design.plant.nq and corrupt is TABLE["no parameters"][1]:
        return design.replace(plant=design.plant.replace(Phi=None, Psi=None, parameter_names=None))
    return corrupt(design)


@pytest.mark.one_in(6)
@pytest.mark.parametrize("name", GOOD)
def test_the_good_designs_pass(name: str) -> None:
    assert failed(good(name)) == set()


@pytest.mark.one_in(4)
@pytest.mark.parametrize("name", TABLE)
def test_a_corrupted_design_fails(name: str) -> None:
    base, corrupt, expected = TABLE[name]
    found = failed(adapted(good(base), corrupt))
    assert expected <= found, (expected - found, found)


def test_claims_alone_fail_alone() -> None:
    for name, (base, corrupt, expected) in TABLE.items():
        if name.startswith("claim"):
            assert failed(corrupt(good(base))) == expected, name


def test_every_row_that_decides_has_a_corruption() -> None:
    broken = set().union(*(expected for _, _, expected in TABLE.values()))
    produced = {check.name for name in GOOD for check in good(name).report.checks if check.kind != "information"}
    assert produced <= broken
    assert broken - produced == {RUNS}


def test_a_report_passes_only_with_rows_that_decide_and_names_are_unique() -> None:
    for name in GOOD:
        names = [check.name for check in good(name).report.checks]
        assert len(set(names)) == len(names)
    assert not good().replace(report=obsynth.VerificationReport()).report.passed


def test_verification_is_the_same_every_time() -> None:
    assert repr(verify(good())) == repr(verify(good()))

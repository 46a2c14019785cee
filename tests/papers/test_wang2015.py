"""Wang, Rodrigues, Theilliol, Shen 2015: what they print, what is true of it, and what we ship.

Three levels: printed intermediate matrices, printed performance, and gains only where they are unique.  The published
numbers, their corrections and their reasons are in ``designs/wang2015*/expected.yaml``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import obsynth
from obsynth.analysis.existence.restricted_equivalent import prepare, restricted_equivalent_from
from obsynth.analysis.zeros import fault_zeros
from obsynth.errors import InfeasibleError
from obsynth.methods.fault_estimation_filter.convex_problem import gain_problem
from obsynth.methods.fault_estimation_filter.small_gains import PrintedInequality
from obsynth.numerics.central_filter import search_least_gain
from obsynth.numerics.norms import hinf_norm, spectral_radius
from obsynth.simulation.linear import simulate_plant
from obsynth.specs.documents import read_yaml
from obsynth.specs.loader import load_spec

DESIGNS = Path(__file__).parents[2] / "designs"
EXPECTED = read_yaml(DESIGNS / "wang2015" / "expected.yaml")
EXPECTED_PSI = read_yaml(DESIGNS / "wang2015_printed_psi" / "expected.yaml")
PLANT = load_spec(DESIGNS / "wang2015" / "spec.yaml").plant
PLANT_PSI = load_spec(DESIGNS / "wang2015_printed_psi" / "spec.yaml").plant
S = np.array(EXPECTED["given"]["S"], dtype=float)
BOTH = pytest.mark.parametrize(
    ("plant", "expected"), [(PLANT, EXPECTED), (PLANT_PSI, EXPECTED_PSI)], ids=["F = B", "F = [a1, b2]"]
)


def printed(name: str, expected: dict[str, Any]) -> np.ndarray:
    return np.array(expected["printed"][name]["value"], dtype=float)


def corrected(name: str, expected: dict[str, Any]) -> np.ndarray:
    matrix = printed(name, expected)
    for fix in expected["printed"][name].get("corrections", ()):
        assert matrix[fix["row"] - 1, fix["column"] - 1] == fix["printed"]
        matrix[fix["row"] - 1, fix["column"] - 1] = fix["corrected"]
    return matrix


def places_not_reproduced(ours: np.ndarray, name: str, expected: dict[str, Any]) -> set[tuple[int, int]]:
    """Return rows and columns, from 1, in which the print differs by more than half a unit of its last digit."""
    half_a_unit = 0.5 * 10.0 ** -expected["printed"][name]["decimals"]
    off = np.argwhere(np.abs(ours - printed(name, expected)) > half_a_unit * (1.0 + 1e-9))
    return {(int(row) + 1, int(column) + 1) for row, column in off}


def intermediate(plant: obsynth.DescriptorSystem) -> dict[str, np.ndarray]:
    """Return the matrices that the paper prints on the way, for the paper's S."""
    prepared = prepare(plant, S)
    problem, parts = gain_problem(prepared, free_weight=False)
    psi, upsilon = prepared.detectability.Psi, prepared.detectability.Upsilon
    return {
        "T": prepared.T, "N": prepared.N, "Psi": psi, "Upsilon": upsilon,
        "A1": problem.A, "C1": parts.V @ problem.C,
    }  # fmt: skip


T, N = restricted_equivalent_from(PLANT.E, PLANT.C, S)
TA = T @ PLANT.A


def filter_from(plant: obsynth.DescriptorSystem, gain: np.ndarray, *, gamma: float = 1.5) -> obsynth.ObserverDesign:
    """Return the paper's filter with the gain L and the W of (47)."""
    weight = np.linalg.pinv(plant.C @ T @ plant.Bf)
    return obsynth.design_from_gains(plant, "fault-estimation-filter", T=T, N=N, L=gain, W=weight, gamma=gamma)


def norm_of(plant: obsynth.DescriptorSystem, gain: np.ndarray) -> float:
    weight = np.linalg.pinv(plant.C @ T @ plant.Bf)
    return hinf_norm(TA - gain @ plant.C, T @ plant.Bd, weight @ plant.C, np.zeros((2, 1))).upper


# Level 1: what is printed on the way


@BOTH
@pytest.mark.parametrize("name", ["T", "N"])
def test_T_and_N_are_reproduced_exactly(plant, expected, name: str) -> None:
    np.testing.assert_allclose(intermediate(plant)[name], printed(name, EXPECTED), rtol=0, atol=1e-14)


@pytest.mark.parametrize("name", ["Psi", "Upsilon", "A1", "C1"])
def test_matrices_are_reproduced_but_for_the_documented_misprints(name: str) -> None:
    fixes = EXPECTED_PSI["printed"][name].get("corrections", ())
    ours = intermediate(PLANT_PSI)[name]
    assert places_not_reproduced(ours, name, EXPECTED_PSI) == {(fix["row"], fix["column"]) for fix in fixes}
    half_a_unit = 0.5 * 10.0 ** -EXPECTED_PSI["printed"][name]["decimals"]
    np.testing.assert_allclose(ours, corrected(name, EXPECTED_PSI), rtol=0, atol=half_a_unit * (1.0 + 1e-9))


def test_the_misprints_are_three_entries_of_A1_and_C1() -> None:
    counts = {name: len(item.get("corrections", ())) for name, item in EXPECTED_PSI["printed"].items()}
    assert counts == {"Psi": 0, "Upsilon": 0, "A1": 2, "C1": 1, "gamma": 1}


def test_the_text_says_F_equals_B_but_that_gives_other_matrices() -> None:
    misfit = EXPECTED_PSI["truth"]["misfit_of_F_equal_B"]
    ours = intermediate(PLANT)
    for name in ("A1", "C1"):
        assert len(places_not_reproduced(ours[name], name, EXPECTED_PSI)) == misfit[name]
    assert np.max(np.abs(ours["Psi"] - printed("Psi", EXPECTED_PSI))) == pytest.approx(misfit["Psi"])


@BOTH
def test_indexes_and_fault_zeros(plant, expected) -> None:
    assert list(prepare(plant, S).detectability.indexes) == EXPECTED["printed"]["indexes"]["value"]
    zeros = [zero.value for zero in fault_zeros(plant)[0]]
    np.testing.assert_allclose(zeros, expected["truth"]["fault_zeros"], atol=1e-12)


def test_the_printed_L_passes_only_with_its_transposed_digits_mended() -> None:
    as_printed = obsynth.verify(filter_from(PLANT, printed("L", EXPECTED)), printed_digits=4)
    assert [check.name for check in as_printed.failures] == ["fault decoupled after its delay"]
    mended = obsynth.verify(filter_from(PLANT, corrected("L", EXPECTED)), printed_digits=4)
    assert mended.failures == ()
    assert mended.passed


def test_four_decimals_are_not_double_precision() -> None:
    report = filter_from(PLANT, corrected("L", EXPECTED)).report
    assert [check.name for check in report.failures] == ["fault decoupled after its delay"]


def test_the_printed_L_does_not_belong_to_the_printed_Psi() -> None:
    for gain in (printed("L", EXPECTED), corrected("L", EXPECTED)):
        report = obsynth.verify(filter_from(PLANT_PSI, gain), printed_digits=4)
        assert not report["fault decoupled after its delay"].passed
        assert not report["H-infinity norm"].passed
        miss = np.max(np.abs((TA - gain @ PLANT.C) @ (T @ PLANT_PSI.Bf)))
        assert miss == pytest.approx(EXPECTED_PSI["truth"]["decoupling_miss_of_printed_L"], abs=5e-5)


@pytest.mark.parametrize(("facts", "choose"), [("printed_L", printed), ("mended_L", corrected)])
def test_what_the_printed_L_does(facts: str, choose) -> None:
    truth, gain = EXPECTED["truth"][facts], choose("L", EXPECTED)
    loop = TA - gain @ PLANT.C
    assert np.max(np.abs(loop @ T @ PLANT.Bf)) == pytest.approx(truth["decoupling_miss"], rel=1e-9)
    assert spectral_radius(loop) == pytest.approx(truth["spectral_radius"], abs=5e-6)
    assert norm_of(PLANT, gain) == pytest.approx(truth["hinf"], abs=5e-8)


def test_the_evidence_for_the_transposed_digits() -> None:
    """Each row of L less its fixed part is a multiple of the null vector of Upsilon'."""
    upsilon = PLANT.C @ T @ PLANT.Bf
    null = np.linalg.svd(upsilon.T)[2][-1]
    np.testing.assert_allclose(null / null[0], [1.0, -1.0, 0.55], atol=1e-14)
    fixed = TA @ T @ PLANT.Bf @ np.linalg.pinv(upsilon)

    def misses(gain: np.ndarray) -> np.ndarray:
        free = gain - fixed
        return np.max(np.abs(free - np.outer(free @ null, null)), axis=1)

    assert list(misses(printed("L", EXPECTED)) < 1e-4) == [False, True, True, True]
    assert np.all(misses(corrected("L", EXPECTED)) < 1e-4)


# Level 2: the performance


@BOTH
@pytest.mark.parametrize(
    "options", [{"weight": "paper"}, {"S": S}, {"gamma_search": "bisection"}], ids=["paper", "S", "bisection"]
)
def test_the_least_gamma(plant, expected, options) -> None:
    design = obsynth.fault_estimation_filter(plant, **options)
    claims, truth = design.certificate.claims, expected["truth"]["gamma_min"]["value"]
    # Every gamma that is reported is the norm of a filter in hand: never below the truth.
    assert truth <= claims["gamma_min"] < truth + 2e-7
    assert claims["gamma"] == pytest.approx(1.05 * truth, abs=1e-6)
    assert design.report["H-infinity norm"].value <= claims["gamma"]
    assert design.report["LMI"].passed
    assert design.report.passed


def test_the_truth_follows_from_two_markov_parameters() -> None:
    weight = np.linalg.pinv(PLANT.C @ T @ PLANT.Bf)
    p = weight @ PLANT.C @ TA[:, 0]
    bound = np.sqrt(1.0 + p @ p / 2.0 + np.sqrt((p @ p) ** 2 / 4.0 + p[1] ** 2))
    assert bound == pytest.approx(EXPECTED["truth"]["gamma_min"]["value"], abs=5e-13)


@BOTH
def test_bisection_ends_with_a_bracket_around_the_truth(plant, expected) -> None:
    """Algorithm 1 as printed tries one gamma for ever."""
    claims = obsynth.fault_estimation_filter(plant, gamma_search="bisection", tolerance=1e-6).certificate.claims
    low, high = claims["gamma_bracket_low"], claims["gamma_bracket_high"]
    assert low <= expected["truth"]["gamma_min"]["value"] <= high
    assert 0.0 < high - low <= 1e-6 * high


@BOTH
def test_the_printed_minimum_is_a_point_of_a_grid(plant, expected) -> None:
    assert obsynth.fault_estimation_filter(plant, S=S, gamma=1.5).certificate.claims["gamma"] == 1.5
    truth = expected["truth"]["gamma_min"]["value"]
    with pytest.raises(InfeasibleError) as caught:
        obsynth.fault_estimation_filter(plant, S=S, gamma=1.4)
    assert caught.value.lower_bound is not None
    assert truth * (1.0 - 1e-5) < caught.value.lower_bound <= truth
    assert not caught.value.necessary


@BOTH
def test_the_second_stage_at_five_percent(plant, expected) -> None:
    """In the paper's coordinates, at the full 5 %: the audit's numbers."""
    truth = expected["truth"]
    prepared = prepare(plant, S)
    problem, parts = gain_problem(prepared, free_weight=False)
    level = 1.05 * truth["gamma_min"]["value"]
    printed = PrintedInequality(plant, prepared, parts, False, "CLARABEL")
    found = printed.small_gains(problem, level, [])
    assert found is not None
    a, b, c, d = problem.closed_loop(found)
    stage = truth["second_stage"]
    assert np.linalg.norm(found.R) == pytest.approx(stage["norm_R"], abs=5.1e-4)
    assert spectral_radius(a) == pytest.approx(stage["spectral_radius"], abs=5.1e-4)
    assert hinf_norm(a, b, c, d).upper == pytest.approx(stage.get("hinf", np.sqrt(2.0)), abs=5.1e-4)


@pytest.mark.parametrize(("engine", "key"), [("auto", "shipped"), ("lmi", "shipped_by_the_inequality")])
def test_what_is_shipped(engine: str, key: str) -> None:
    """A little below the full 5 %, so that the claim has a well-conditioned proof."""
    design, shipped = obsynth.fault_estimation_filter(PLANT, weight="paper", engine=engine), EXPECTED[key]
    assert design.certificate.claims["gamma"] == pytest.approx(shipped["gamma"], abs=5.1e-6)
    assert design.report["H-infinity norm"].value == pytest.approx(shipped["hinf"], abs=5.1e-4)
    assert np.linalg.norm(design.gains["R"]) == pytest.approx(shipped["norm_R"], abs=5.1e-3)
    assert spectral_radius(design.observer.Az) == pytest.approx(shipped["spectral_radius"], abs=5.1e-3)


def test_nothing_is_shipped_where_no_gain_is_needed() -> None:
    other = obsynth.fault_estimation_filter(PLANT_PSI, weight="paper")
    assert np.linalg.norm(other.gains["R"]) == 0.0
    stage = EXPECTED_PSI["truth"]["second_stage"]
    assert spectral_radius(other.observer.Az) == pytest.approx(stage["spectral_radius"], abs=5.1e-4)


def test_a_free_residual_weight_lowers_gamma_to_one() -> None:
    free = obsynth.fault_estimation_filter(PLANT)
    truth = EXPECTED["truth"]["gamma_min_free_weight"]
    assert truth <= free.certificate.claims["gamma_min"] < truth + 1e-6
    assert free.report.passed
    np.testing.assert_allclose(free.gains["W"] @ free.gains["Upsilon"], np.eye(2), atol=1e-12)
    # The other reading gains nothing: every admissible filter has the same response.
    other = obsynth.fault_estimation_filter(PLANT_PSI, weight="free")
    assert other.certificate.claims["gamma_min"] == pytest.approx(np.sqrt(2.0), abs=1e-8)


def test_the_sign_printed_in_48_is_unstable() -> None:
    """TA - LC is A1 - R C1 by (60), and A1 + R C1 by (48) as printed."""
    problem, _ = gain_problem(prepare(PLANT, S), free_weight=False)
    gain = search_least_gain(problem).injection.R
    printed_sign = spectral_radius(problem.A + gain @ problem.C)
    assert printed_sign == pytest.approx(EXPECTED["truth"]["as_printed"]["spectral_radius_with_sign_of_48"], abs=5e-3)
    assert spectral_radius(problem.A - gain @ problem.C) < 0.4


def test_what_is_shipped_has_the_sign_of_60() -> None:
    gains = obsynth.fault_estimation_filter(PLANT, S=S).gains
    fixed = TA @ gains["Psi"] @ np.linalg.pinv(gains["Upsilon"])
    np.testing.assert_allclose(fixed + gains["R"], gains["L"], rtol=0, atol=1e-12)
    assert spectral_radius(TA - (fixed - gains["R"]) @ PLANT.C) > 2.0


# Level 3: gains only where they are unique


@BOTH
@pytest.mark.parametrize(
    "options", [{"weight": "paper"}, {"S": S}, {"weight": "paper", "gamma": 1.5}], ids=["paper", "S", "gamma 1.5"]
)
def test_equal_gains_where_they_are_unique(plant, expected, options) -> None:
    """T, N, Psi and Upsilon by construction, W by (47), and of L what (32) fixes: L Upsilon = T A Psi."""
    ours, fixed = obsynth.fault_estimation_filter(plant, **options).gains, intermediate(plant)
    for name in ("T", "N", "Psi", "Upsilon"):
        np.testing.assert_allclose(ours[name], fixed[name], rtol=0, atol=1e-13, err_msg=name)
    np.testing.assert_allclose(ours["W"], np.linalg.pinv(fixed["Upsilon"]), rtol=0, atol=1e-12)
    np.testing.assert_allclose(ours["L"] @ ours["Upsilon"], TA @ ours["Psi"], rtol=0, atol=1e-12)


def test_of_the_printed_L_the_fixed_part_agrees_with_ours() -> None:
    ours = obsynth.fault_estimation_filter(PLANT, S=S).gains
    gain = corrected("L", EXPECTED)
    # Three entries of at most 1, each rounded to four decimals.
    assert np.max(np.abs((ours["L"] - gain) @ ours["Upsilon"])) < 1.5 * 0.5e-4
    assert np.max(np.abs(ours["L"] - gain)) > 0.1


# The simulation of section 4

STEPS = EXPECTED["truth"]["simulation"]["samples"]
K = np.arange(STEPS)
INPUTS = np.column_stack([2.0 * np.sin(K), 2.0 * np.sin(K)])
FAULTS = np.column_stack([np.where(K >= 80, 1.0, 0.0), np.where(K >= 100, 1.2 * np.sin(0.1 * K), 0.0)])
NOISE = np.random.default_rng(EXPECTED["truth"]["simulation"]["seed"]).uniform(0.0, 0.1, STEPS)


def residuals_of(design: obsynth.ObserverDesign, disturbance: np.ndarray | None) -> np.ndarray:
    given = EXPECTED["given"]
    run = simulate_plant(
        design.plant, steps=STEPS, u=INPUTS, f=FAULTS, d=disturbance, initial_state=given["initial_state"]
    )
    assert run.inconsistency == 0.0
    start = np.array(given["initial_estimate"]) - design.gains["N"] @ run.outputs[0]
    return design.observer.run(run.outputs, INPUTS, initial_state=start).residuals


def errors_of(design: obsynth.ObserverDesign, disturbance: np.ndarray | None) -> np.ndarray:
    """Return r(k) - n(k-1), with a row of zeros for k = 0."""
    return np.vstack([np.zeros((1, 2)), residuals_of(design, disturbance)[1:] - FAULTS[:-1]])


@pytest.mark.parametrize(
    ("plant", "choose", "rmse"),
    [
        (PLANT, printed, EXPECTED["truth"]["simulation"]["rmse_printed_L"]),
        (PLANT, corrected, EXPECTED["truth"]["simulation"]["rmse_mended_L"]),
        (PLANT_PSI, None, EXPECTED_PSI["truth"]["simulation"]["rmse"]),
    ],
    ids=["printed L", "mended L", "ours, F = [a1, b2]"],
)
def test_root_mean_square_errors_of_the_audit(plant, choose, rmse) -> None:
    design = (
        obsynth.fault_estimation_filter(plant, weight="paper")
        if choose is None
        else filter_from(plant, choose("L", EXPECTED))
    )
    errors = errors_of(design, NOISE)
    for window, values in rmse.items():
        first, last = map(int, window.split(".."))
        found = np.sqrt(np.mean(errors[first : last + 1] ** 2, axis=0))
        np.testing.assert_allclose(found, values, rtol=0, atol=1e-4, err_msg=window)


@BOTH
def test_without_disturbance_the_faults_are_found_exactly(plant, expected) -> None:
    design = obsynth.fault_estimation_filter(plant, weight="paper")
    assert np.max(np.abs(errors_of(design, None)[20:])) < 1e-8


def test_without_disturbance_the_printed_L_confuses_the_faults() -> None:
    simulated = EXPECTED["truth"]["simulation"]
    for choose, name in ((printed, "printed_L"), (corrected, "mended_L")):
        worst = np.max(np.abs(errors_of(filter_from(PLANT, choose("L", EXPECTED)), None)[20:]))
        assert worst == pytest.approx(simulated[f"no_noise_error_{name}"], rel=0.02)


def test_the_other_reading_adds_two_noise_samples_whatever_L_is() -> None:
    errors = errors_of(obsynth.fault_estimation_filter(PLANT_PSI, weight="paper"), NOISE)
    # The initial error has decayed at 30.
    np.testing.assert_allclose(errors[30:, 0], NOISE[28:-2], atol=1e-9)
    np.testing.assert_allclose(errors[30:, 1], NOISE[29:-1], atol=1e-9)


def thresholds(design: obsynth.ObserverDesign) -> dict[str, np.ndarray]:
    """Return (66) as printed, (66) with the norm of the power, and the pointwise bound of the audit."""
    given, gains = EXPECTED["given"], design.gains
    loop = gains["T"] @ design.plant.A - gains["L"] @ design.plant.C
    shown, driven = gains["W"] @ design.plant.C, gains["T"] @ design.plant.Bd
    powers = [np.linalg.matrix_power(loop, int(k)) for k in K]
    bound, start = given["disturbance_bound"], given["initial_error_bound"]

    def squared(decay: np.ndarray) -> np.ndarray:
        return np.hypot(1.5 * bound, np.linalg.norm(shown, 2) * decay * start)

    response = np.array([np.linalg.norm(shown @ power @ driven) for power in powers])
    return {
        "as printed": squared(np.linalg.norm(loop, 2) ** K.astype(float)),
        "norm of the power": squared(np.array([np.linalg.norm(power, 2) for power in powers])),
        "pointwise": np.array([np.linalg.norm(shown @ power, 2) for power in powers]) * start
        + bound * np.concatenate([[0.0], np.cumsum(response)[:-1]]),
    }


@pytest.mark.parametrize("which", ["printed L", "mended L", "ours", "ours, free W", "F = [a1, b2]"])
def test_detection_one_sample_after_the_fault(which: str) -> None:
    makers = {
        "printed L": lambda: filter_from(PLANT, printed("L", EXPECTED)),
        "mended L": lambda: filter_from(PLANT, corrected("L", EXPECTED)),
        "ours": lambda: obsynth.fault_estimation_filter(PLANT, weight="paper"),
        "ours, free W": lambda: obsynth.fault_estimation_filter(PLANT, weight="free"),
        "F = [a1, b2]": lambda: obsynth.fault_estimation_filter(PLANT_PSI, weight="paper"),
    }
    design = makers[which]()
    size = np.linalg.norm(residuals_of(design, NOISE), axis=1)
    curves = thresholds(design)
    for name in ("norm of the power", "pointwise"):
        crossed = np.flatnonzero(size > curves[name])
        assert crossed[0] == EXPECTED["truth"]["simulation"]["detection"], name
    assert not np.any(size > curves["as printed"])
    assert curves["as printed"][80] > 1e18


def test_no_gain_makes_the_norm_of_the_loop_less_than_one() -> None:
    """What the proof of Theorem 2 calls stable: C e1 = 0, so L cannot touch the first column of TA."""
    assert not np.any(PLANT.C[:, 0])
    assert np.linalg.norm(TA[:, 0]) == pytest.approx(1.3462, abs=5e-5)


def test_the_state_estimate_of_23_is_biased_by_psi_and_ours_is_not() -> None:
    design = obsynth.fault_estimation_filter(PLANT, S=S)
    gains, faults = design.gains, np.tile([1.0, -0.5], (60, 1))
    run = simulate_plant(PLANT, steps=60, f=faults)
    z = np.zeros(4)
    for y in run.outputs[:-1]:
        estimate = z + gains["N"] @ y
        z = TA @ estimate + gains["L"] @ (y - PLANT.C @ estimate)
    papers = z + gains["N"] @ run.outputs[-1]
    np.testing.assert_allclose(run.states[-1] - papers, gains["Psi"] @ faults[0], atol=1e-9)
    shipped = design.observer.run(run.outputs, np.zeros((60, 2))).states
    np.testing.assert_allclose(shipped[20:], run.states[20:], atol=1e-9)

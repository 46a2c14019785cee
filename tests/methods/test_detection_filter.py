"""Detection against disturbance: the optimum by its property, a proved gain, and refusals."""

from __future__ import annotations

import functools
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import obsynth
from obsynth.numerics.continuous import ContinuousNorms
from obsynth.verification.error_system import ErrorModel


def plant(seed: int = 0) -> obsynth.DescriptorSystem:
    rng = np.random.default_rng(seed)
    return obsynth.DescriptorSystem(
        None, rng.standard_normal((3, 3)) - 2 * np.eye(3), None, rng.standard_normal((2, 3)),
        Bf=rng.standard_normal((3, 1)), Df=[[1.0], [0.0]], Bd=rng.standard_normal((3, 1)), Dd=[[0.2], [0.0]],
        Bw=np.zeros((3, 2)), Dw=0.3 * np.eye(2),
    )  # fmt: skip


def transfer(system: obsynth.DescriptorSystem, gain: np.ndarray, b: np.ndarray, d: np.ndarray, w: float) -> np.ndarray:
    closed = system.A - gain @ system.C
    return system.C @ np.linalg.solve(1j * w * np.eye(3) - closed, b - gain @ d) + d


@pytest.mark.one_in(3)
@pytest.mark.parametrize(("provable", "margin", "tried"), [(0.0, 1.0, 2), (0.95, 0.1, 5), (1.0, 1e-4, 1)])
def test_levels_of_sensitivity_are_tried_from_above_and_none_if_the_lowest_fails(
    provable: float, margin: float, tried: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each failing proof takes seconds: of a slow thermal plant all five levels were tried, 8 s instead of 3."""
    levels: list[float] = []
    least = obsynth.detection_filter(plant(), band=(0.0, 10.0)).certificate.claims["fault_sensitivity"] / (1.0 - 1e-4)

    def is_proved(_: object, level: float, *__: float) -> bool:
        levels.append(level)
        return level < provable * least

    monkeypatch.setattr("obsynth.methods.detection_filter.synthesis.sensitivity_is_proved", is_proved)
    found = obsynth.detection_filter(plant(), band=(0.0, 10.0)).certificate.claims["fault_sensitivity"]
    assert (found, len(levels)) == (pytest.approx((1.0 - margin) * least), tried)


@pytest.mark.one_in(4)
@pytest.mark.parametrize("seed", range(4))
def test_gain_is_one_everywhere_and_proved(seed: int) -> None:
    system = plant(seed)
    found = obsynth.detection_filter(system, band=(0.0, 10.0))
    assert found.report["disturbance gain"].status == "proved"
    # Plants 2 and 3 have an unstable pole: what stored numbers miss by rounding has no finite gain there.
    assert found.proved == (seed < 2) == bool(np.max(np.linalg.eigvals(system.A).real) < 0.0)
    b, d = np.hstack([system.Bd, system.Bw]), np.hstack([system.Dd, system.Dw])
    for w in (0.0, 0.3, 2.0, 40.0):
        values = np.linalg.svd(found.observer.Dy @ transfer(system, found.observer.By, b, d, w), compute_uv=False)
        assert values == pytest.approx([1.0, 1.0], abs=1e-9)


@pytest.mark.one_in(4)
@pytest.mark.parametrize("seed", range(4))
def test_units_decide_nothing(seed: int) -> None:
    # Riccati equations were solved in units of the data: of 100 random plants in others 58 were refused.
    system, rng = plant(seed), np.random.default_rng([7, seed])
    states, outputs, time = (2.0 ** rng.integers(-20, 21, size) for size in (3, 2, 1))
    left, shown = time[0] / states[:, None], outputs[:, None]
    other = system.replace(
        A=left * system.A * states, Bf=left * system.Bf, Bd=left * system.Bd, Bw=left * system.Bw,
        C=shown * system.C * states, Df=shown * system.Df, Dd=shown * system.Dd, Dw=shown * system.Dw,
    )  # fmt: skip
    first = obsynth.detection_filter(system, band=(0.0, 10.0))
    second = obsynth.detection_filter(other, band=(0.0, 10.0 * time[0]))
    here, there = (found.certificate.claims for found in (first, second))
    assert there["disturbance_gain"] == here["disturbance_gain"]
    # Both are proved levels, 1e-4 below what a grid finds at best.
    assert there["fault_sensitivity"] == pytest.approx(here["fault_sensitivity"], rel=1e-6)


@pytest.mark.parametrize("time", [1.0, 2.0**-30, 2.0**30])
def test_the_band_follows_the_unit_of_time(time: float) -> None:
    # It ended at 1000 rad/s: a plant of minutes had a sensitivity of nothing there, one of microseconds that of rest.
    system = plant(1)
    other = system.replace(**{name: time * getattr(system, name) for name in ("A", "Bf", "Bd", "Bw")})
    here, there = obsynth.detection_filter(system), obsynth.detection_filter(other)
    fastest = np.max(np.abs(np.linalg.eigvals(system.A - here.observer.By @ system.C)))
    assert here.band == pytest.approx((0.0, fastest), rel=1e-9)
    assert there.band == pytest.approx((0.0, fastest * time), rel=1e-9)
    assert there.report.passed
    if time == 1.0:
        assert there.fault_sensitivity == here.fault_sensitivity > 0.0


@pytest.mark.parametrize("time", [1.0, 2.0**-9])
@pytest.mark.long
def test_a_gain_is_proved_wherever_noise_drives_every_state(time: float) -> None:
    # No zero is anywhere: of 330 random plants 18 were refused for one, as the strictness of the proof was a fixed one.
    a = [
        [0.0, 1.0, 0.0, -1.0, 1.0],
        [-0.5, -1.0, -1.0, -0.5, 0.0],
        [-1.0, 1.0, 0.0, -2.0, 3.0],
        [-1.5, -1.0, 0.0, -0.5, 1.0],
        [0.0, 0.0, 0.0, 0.0, -0.5],
    ]
    system = obsynth.DescriptorSystem(
        None, time * np.array(a), C=[[0, -2, 0, 1, -1]], Bf=time * np.array([[-2.0], [0.0], [-2.0], [1.0], [0.0]]),
        Bw=np.sqrt(time) * np.eye(5, 6), Dw=np.eye(1, 6, 5) / np.sqrt(time),
    )  # fmt: skip
    found = obsynth.detection_filter(system, band=(0.0, 10.0 * time))
    assert found.disturbance_gain == 1.0 + 1e-6
    closed = np.linalg.eigvals(system.A - found.observer.By @ system.C)
    assert np.max(closed.real) == pytest.approx(-0.3964974 * time, rel=1e-6)  # by SciPy's Riccati equation


@pytest.mark.one_in(3)
@pytest.mark.parametrize(("noise", "most"), [(0.1, 1e-5), (1e-3, 1e-2), (1e-4, 0.1)])
def test_a_larger_bound_is_claimed_where_the_least_is_below_rounding(noise: float, most: float) -> None:
    # Three integrators in a row, and a sensor ever better: the poles go to -50 1/s, and all of these were refused.
    a = [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [-1e-4, -1e-3, -0.01]]
    drive = [[0.0, 0.0], [0.0, 0.0], [noise**-0.5, 0.0]]
    system = obsynth.DescriptorSystem(
        None, a, C=[[1.0, 0.0, 0.0]], Bf=[[0.0], [0.0], [1.0]], Bw=drive, Dw=[[0.0, noise]]
    )
    found = obsynth.detection_filter(system, band=(0.0, 1.0))
    assert found.report.passed
    assert 1.0 < found.disturbance_gain < 1.0 + most


def test_no_other_filter_has_a_larger_ratio() -> None:
    system = plant()
    found = obsynth.detection_filter(system, band=(0.0, 10.0))
    b, d = np.hstack([system.Bd, system.Bw]), np.hstack([system.Dd, system.Dw])
    rng = np.random.default_rng(7)
    for _ in range(30):
        gain = found.observer.By + 0.3 * rng.standard_normal((3, 2))
        closed = system.A - gain @ system.C
        if np.max(np.linalg.eigvals(closed).real) >= 0.0:
            continue
        weight = rng.standard_normal((1, 2))
        norm = ContinuousNorms(closed).between(b - gain @ d, weight @ system.C, weight @ d).value
        shown = min(
            abs((weight @ transfer(system, gain, system.Bf, system.Df, w))[0, 0]) for w in np.linspace(0.0, 10.0, 60)
        )
        assert shown / norm <= found.ratio * (1 + 1e-6)


@pytest.mark.one_in(3)
@pytest.mark.parametrize("seed", range(3))
def test_sensitivity_is_proved_on_the_whole_range(seed: int) -> None:
    system = plant(seed)
    found = obsynth.detection_filter(system, band=(0.0, 1e3))
    assert found.report["fault sensitivity"].kind == "proved"
    shown = [
        np.linalg.svd(
            found.observer.Dy @ transfer(system, found.observer.By, system.Bf, system.Df, w), compute_uv=False
        )
        for w in (*np.linspace(0.0, 20.0, 400), *np.geomspace(20.0, 1e3, 200))
    ]
    least = float(np.min(shown))
    assert found.fault_sensitivity <= least <= found.fault_sensitivity * (1.0 + 3e-3)


def claiming(found: obsynth.types.DetectionFilter, **changed: float) -> dict[str, Any]:
    certificate = found.certificate
    return {"certificate": replace(certificate, claims={**certificate.claims, **changed})}


CORRUPTED = {
    "state in the error": lambda found: {"observer": replace(found.observer, Az=found.observer.Az * 1.01)},
    "inputs in the error": lambda found: {"observer": replace(found.observer, Bu=found.observer.Bu + 1.0)},
    "state in the residuals": lambda found: {"observer": replace(found.observer, Cz=found.observer.Cz * 1.001)},
    "inputs in the residuals": lambda found: {"observer": replace(found.observer, Du=found.observer.Du + 1.0)},
    "gains": lambda found: {"gains": {**found.gains, "L": 1.001 * found.gains["L"]}},
    "disturbance gain": lambda found: claiming(found, disturbance_gain=0.999),
    "fault sensitivity": lambda found: claiming(found, fault_sensitivity=found.fault_sensitivity * 1.001),
    "disturbance gain ": lambda found: {
        "certificate": replace(found.certificate, matrices={**found.certificate.matrices, "P": np.eye(3)}),
    },
    "fits the plant": lambda found: claiming(found, band_to=20.0),
    "exists: rank [Dd, Dw]": lambda found: {"plant": found.plant.replace(Dw=0.0 * found.plant.Dw)},
    "exists: faults": lambda found: {"plant": found.plant.replace(Bf=np.zeros((3, 0)), Df=None, fault_names=None)},
    "continuous time": lambda found: {
        "plant": found.plant.replace(dt=0.1), "observer": replace(found.observer, dt=0.1),
    },
    "exists: detectable": lambda found: {
        "plant": found.plant.replace(A=np.diag([1.0, -1.0, -2.0]), C=[[0, 1, 1], [0, 1, 0]]),
    },
}  # fmt: skip


@functools.cache
def with_input() -> obsynth.types.DetectionFilter:
    system = plant(1).replace(B=[[1.0], [0.0], [0.0]], D=None, input_names=None)
    found = obsynth.detection_filter(system, band=(0.0, 10.0))
    assert found.verify().passed
    return found


@pytest.mark.one_in(4)
@pytest.mark.parametrize("row", CORRUPTED)
def test_every_row_can_fail(row: str) -> None:
    found = with_input()
    report = replace(found, **CORRUPTED[row](found)).verify()
    if row == "continuous time":
        row = "fits the plant"
    assert not report[row.strip()].passed


def test_it_is_a_design_like_the_others(tmp_path: Path) -> None:
    found = with_input()
    assert isinstance(found, obsynth.ObserverDesign)
    assert found.method == "detection-filter"
    again = obsynth.load(found.save(tmp_path / "gains.json"))
    assert obsynth.verify(again).passed
    assert obsynth.export(again, tmp_path / "filter.c", sample_time=0.1)
    same = obsynth.design(plant(1), "detection-filter", band=[0.0, 10.0])
    assert same.certificate.claims["disturbance_gain"] == found.disturbance_gain


def test_algebraic_states_are_eliminated() -> None:
    system = plant(1)
    # x4 = x1 + d2, and the second output sees it.
    wide = obsynth.DescriptorSystem(
        np.diag([1.0, 1.0, 1.0, 0.0]), np.block([[system.A, np.zeros((3, 1))], [np.array([[1.0, 0, 0, -1.0]])]]), None,
        np.hstack([system.C, [[0.0], [1.0]]]), Bf=np.vstack([system.Bf, [[0.0]]]), Df=system.Df,
        Bd=np.vstack([system.Bd, [[0.3]]]), Dd=system.Dd, Bw=np.zeros((4, 2)), Dw=system.Dw,
    )  # fmt: skip
    found = obsynth.detection_filter(wide, band=(0.0, 10.0))
    assert found.proved
    assert found.plant.nx == 3
    assert found.recovery is not None
    b, d = np.hstack([found.plant.Bd, found.plant.Bw]), np.hstack([found.plant.Dd, found.plant.Dw])
    values = np.linalg.svd(found.observer.Dy @ transfer(found.plant, found.observer.By, b, d, 0.7), compute_uv=False)
    assert values == pytest.approx([1.0, 1.0], abs=1e-9)


INTEGRATING = {
    "integrator": ([[0.0, 1.0], [0.0, -0.3]], [[1.0, 0.0], [0.7, 0.9]], False),
    "unstable": ([[0.1, 1.0], [0.0, -0.3]], [[1.0, 0.0], [0.7, 0.9]], False),
    "stable": ([[-0.1, 1.0], [0.0, -0.3]], [[1.0, 0.0], [0.7, 0.9]], True),
}


@pytest.mark.parametrize("name", INTEGRATING)
def test_gain_is_proved_for_the_stored_numbers_only_where_it_holds(name: str) -> None:
    a, c, holds = INTEGRATING[name]
    system = obsynth.DescriptorSystem(
        None, a, None, c, Bf=[[0], [1]], Bd=[[0.3, 0, 0], [1, 0, 0]], Dd=[[0, 0.3, 0], [0, 0, 0.7]]
    )
    found = obsynth.detection_filter(system, band=(0.01, 10.0))
    assert found.report.passed
    assert found.proved == holds
    told = found.report["with stored numbers"]
    assert told.status == ("proved" if holds else "assumed")
    assert holds or "no finite gain" in told.detail
    # Exactly: what is stored misses the equations of the error.
    observer = found.observer
    exact = [
        Fraction(observer.Az[i, j]) - Fraction(system.A[i, j])
        + sum(Fraction(observer.By[i, k]) * Fraction(system.C[k, j]) for k in range(2))
        for i in range(2) for j in range(2)
    ]  # fmt: skip
    k = ErrorModel(system, observer, np.eye(system.nx)).remainder.K
    pairs = zip(exact, k.midpoint.ravel(), k.radius.ravel(), strict=True)
    assert all(abs(Fraction(middle) - value) <= Fraction(radius) for value, middle, radius in pairs)
    assert any(value != 0 for value in exact)


def test_stored_numbers_that_miss_nothing_prove_it_for_a_plant_that_does_not_forget() -> None:
    found = obsynth.detection_filter(
        obsynth.DescriptorSystem(None, [[0.0]], None, [[1.0]], Bf=[[1.0]], Bd=[[4.0, 0.0]], Dd=[[0.0, 2.0]]),
        band=(0.01, 10.0),
    )
    assert found.proved
    assert "exactly" in found.report["with stored numbers"].detail


def test_a_stored_number_far_off_is_not_proved_together() -> None:
    found = with_input()
    observer = found.observer
    # Far inside the tolerance of the identities, and too much for a margin of 1e-6 where the plant is hardly stable.
    slow = obsynth.DescriptorSystem(
        None, [[-1e-7]], None, [[1.0]], Bf=[[1.0]], Bd=[[0.3, 0.0]], Dd=[[0.0, 0.7]],
    )  # fmt: skip
    made = obsynth.detection_filter(slow, band=(0.01, 10.0))
    off = replace(made, observer=replace(made.observer, Az=made.observer.Az * (1.0 + 1e-12)))
    row = off.verify()["with stored numbers"]
    assert row.status == "assumed"
    assert "too slowly" in row.detail
    assert observer.order == 3


def test_a_zero_on_the_axis_is_refused_by_name() -> None:
    # Rw = s / (s + 2), Rf = (s + 1) / (s + 2).
    system = obsynth.DescriptorSystem(None, [[-2.0]], None, [[1.0]], Bf=[[-1.0]], Df=[[1.0]], Bd=[[-2.0]], Dd=[[1.0]])
    with pytest.raises(obsynth.PreconditionError, match="zeros of the unknown inputs"):
        obsynth.detection_filter(system)
    # Numbers that were computed: where there is none of theirs on the axis, the Riccati equation decides.
    both = system.replace(Bd=[[-2.0 * (1.0 + 2**-50)]], A=[[-2.0 * (1.0 + 2**-50)]])
    with pytest.raises(obsynth.PreconditionError, match="zeros of the unknown inputs"):
        obsynth.detection_filter(both)
    with pytest.raises(obsynth.SolverError, match="imaginary axis"):
        obsynth.detection_filter(system.replace(Bd=[[-2.0 * (1.0 + 2**-50)]]))


def test_sensitivity_is_refuted_between_the_points_of_a_grid() -> None:
    # A notch far narrower than any grid: the proof must not pass over it.
    from obsynth.proofs.balls import Ball
    from obsynth.verification.norm_proofs import Transfer, sensitivity_is_proved

    a = np.array([[-1e-4, 1.2345], [-1.2345, -1e-4]])
    notch = Transfer(
        a, Ball.exact(np.array([[1.0], [0.0]])), Ball.exact(np.array([[-2e-4, 0.0]])), Ball.exact(np.eye(1))
    )
    assert abs(1.0 - 2e-4 / (1j * 1.2345 - a[0, 0] + 1.2345**2 / (1j * 1.2345 - a[0, 0]))) < 0.1
    assert not sensitivity_is_proved(notch, 0.2, 0.0, 10.0)
    assert sensitivity_is_proved(notch, 0.2, 2.0, 10.0)


def test_sensitivity_is_proved_far_beyond_the_rates_of_a_plant() -> None:
    # Heat in joules and kelvin: rates of 1e-3 1/s below a band that ends at 1e3 rad/s. In norms of equal weights an
    # interval was a hundred-millionth of the band, and nothing was proved after twenty thousand of them.
    spec = obsynth.load_spec(Path(__file__).parents[2] / "docs/examples/thermal/spec.yaml")
    assert spec.transformation is not None
    oven = spec.transformation.source
    found = obsynth.detection_filter(oven, band=(0.0, 1e3))
    system, observer = found.plant, found.observer
    shown = [
        np.linalg.svd(observer.Dy @ transfer(system, observer.By, system.Bf, system.Df, w), compute_uv=False)
        for w in (0.0, *np.geomspace(1e-6, 1e3, 300))
    ]
    least = float(np.min(shown))
    assert 0.999 * least < found.fault_sensitivity <= least


def test_refusals() -> None:
    system = plant()
    with pytest.raises(obsynth.PreconditionError, match="lacks row rank"):
        obsynth.detection_filter(system.replace(Dw=np.zeros((2, 2))))
    with pytest.raises(obsynth.PreconditionError, match="continuous plant"):
        obsynth.detection_filter(system.replace(dt=0.1))
    with pytest.raises(obsynth.SpecError, match="lowest and the highest"):
        obsynth.detection_filter(system, band=(3.0, 1.0))

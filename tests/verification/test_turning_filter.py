"""Filters of faults that turn with the scheduling: exact decoupling, proved gains, corrupted designs, C."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.conditions.test_turning_faults import turning_plant
from tests.exporting.test_scheduled_c import _MAIN as MAIN
from tests.exporting.test_scheduled_c import _compiled as compiled
from tests.exporting.test_scheduled_c import _in_c as in_c
from tests.support.corruptions import with_claims, with_matrices, with_observer

import obsynth
from obsynth import ObserverDesign, PolytopicSystem, PreconditionError, SolverError, SpecError
from obsynth.numerics.arrays import FloatArray

_BD = [[0.1], [0.2], [0.0], [0.3]]


def _plant(**changes: Any) -> PolytopicSystem:
    """Return reference case 14 with a disturbance and an input."""
    return turning_plant(**{"Bd": _BD, "B": [["1 + v"], [0], [0], [1]], "D": [[0.5], [0], [0]], **changes})


@pytest.fixture(scope="module")
def design() -> ObserverDesign:
    return obsynth.fault_estimation_filter(_plant())


def _run(
    plant: PolytopicSystem, v: FloatArray, u: FloatArray, f: FloatArray, d: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return states and outputs of the plant, sample by sample."""
    x, states, outputs = np.array([1.0, -1, 2, 1]), [], []
    for k in range(len(v)):
        now = plant.at([v[k]])
        states.append(x)
        outputs.append(now.C @ x + now.D @ u[k])
        x = now.A @ x + now.B @ u[k] + now.Bf @ f[k] + now.Bd @ d[k]
    return np.array(states), np.array(outputs)


@pytest.mark.long
def test_faults_are_exact_for_wild_courses(design: ObserverDesign) -> None:
    plant, observer = design.scheduled
    rng = np.random.default_rng(1)
    v, u, f = rng.uniform(0.0, 1.0, 300), rng.standard_normal((300, 1)), 10.0 * rng.standard_normal((300, 1))
    states, y = _run(plant, v, u, f, np.zeros((300, 1)))
    found = observer.run(y, np.column_stack([u, v]))
    # The plant grows (its third state is unstable): rounding is beside its size.
    size = np.abs(states).max(axis=1)
    assert np.max(np.abs(found.states - states).max(axis=1)[250:] / size[250:]) < 1e-12
    assert np.max(np.abs(found.faults[251:] - f[250:-1])[:, 0] / size[251:]) < 1e-12
    # A P that decays: after as many rows as it waits a hundredth is left at most.
    assert np.abs(found.faults[observer.forgetting :] - f[observer.forgetting - 1 : -1]).max() < 0.05


@pytest.mark.long
def test_disturbances_pass_by_less_than_is_proved(design: ObserverDesign) -> None:
    plant, observer = design.scheduled
    gamma = design.certificate.claims["gamma"]
    nothing = np.zeros((60, 1))
    for seed in range(4):
        rng = np.random.default_rng(seed)
        v = rng.integers(0, 2, 60).astype(float) if seed % 2 else rng.uniform(0, 1, 60)
        d = rng.standard_normal((60, 1)) if seed < 2 else np.ones((60, 1))
        both = [observer.run(_run(plant, v, nothing, nothing, each)[1], np.column_stack([nothing, v])).faults
                for each in (d, nothing)]  # fmt: skip
        assert np.linalg.norm(both[0] - both[1]) <= gamma * np.linalg.norm(d)
    assert 0.1 * gamma < design.report["worst switching found"].value <= gamma


def _nudged(design: ObserverDesign, name: str, place: tuple[int, ...], size: float = 1e-3) -> ObserverDesign:
    matrix = np.array(getattr(design.observer, name))
    matrix[place] += size
    return with_observer(design, **{name: matrix})


def _moved_along_freedom(design: ObserverDesign) -> ObserverDesign:
    """Return corrections that decouple the faults as well, without the gain that is proved."""
    plant, observer = design.scheduled
    correction = np.array(observer.correction)
    C, TB = plant.vertices[0].C, [design.gains["T"] @ vertex.Bf for vertex in plant.vertices]
    rows = np.vstack([np.hstack([2 * C @ TB[0], C @ TB[1], 0 * C @ TB[0]]),
                      np.hstack([0 * C @ TB[0], C @ TB[0], 2 * C @ TB[1]])])  # fmt: skip
    free = np.linalg.svd(rows)[0][:, 3:].sum(axis=1)
    correction += 5.0 * np.ones((4, 1)) * free.reshape(2, 1, 3)
    return with_observer(design, correction=correction)


_P = "P_region"
_CORRUPTIONS: dict[str, tuple[Callable[[ObserverDesign], ObserverDesign], str]] = {
    "faults that turn otherwise": (
        lambda d: d.replace(plant=_plant(Bf=[["1 - v"], ["0.9 * v"], [0.3], [0.2]])),
        "fault decoupled for every scheduling",
    ),
    "another plant": (
        lambda d: d.replace(plant=_plant(C=[[1, 0, 0, 0], [0, 2, 0, 0], [0, 0, 1, 0]])),
        "unbiased: state",
    ),
    "smaller number": (lambda d: with_claims(d, gamma=0.9 * d.certificate.claims["gamma"]), "LMI"),
    "no number": (lambda d: with_claims(d, gamma=float("nan")), "LMI"),
    "faster decay": (lambda d: with_claims(d, region_decay=0.5 * d.certificate.claims["region_decay"]),
                     "decay over the region"),
    "asymmetric P": (lambda d: with_matrices(d, P_region=d.certificate.matrices[_P] + 1e-9 * np.eye(4, k=1)), "LMI"),
    "flat P": (lambda d: with_matrices(d, P_region=1e-6 * np.eye(4)[None]), "LMI"),
    "a slack": (lambda d: with_matrices(d, G_region=d.certificate.matrices[_P]), "LMI"),
    "changed correction": (lambda d: _nudged(d, "correction", (1, 0, 0)), "fault decoupled for every scheduling"),
    "corrections in another order": (
        lambda d: with_observer(d, correction=np.array(d.scheduled[1].correction)[::-1]),
        "fault decoupled for every scheduling",
    ),
    "other corrections that decouple": (_moved_along_freedom, "LMI"),
    "no correction": (lambda d: with_observer(d, correction=None), "fits the plant"),
    "changed Az": (lambda d: _nudged(d, "Az", (1, 0, 0)), "unbiased: dynamics"),
    "changed fault row": (lambda d: _nudged(d, "Cz", (4, 0)), "unbiased: fault"),
    "changed residual row": (lambda d: _nudged(d, "Cz", (5, 0)), "unbiased: residual"),
    "changed Du": (lambda d: _nudged(d, "Du", (5, 0)), "unbiased: feedthrough"),
    "changed effectiveness": (lambda d: _nudged(d, "effectiveness", (1, 0, 0)), "fault estimate"),
    "one row out less": (lambda d: with_observer(d, forgetting=d.scheduled[1].forgetting - 1), "rows without a claim"),
    "other tracking": (
        lambda d: with_matrices(d, tracking=1.01 * d.certificate.matrices["tracking"]),
        "unbiased: dynamics",
    ),
}  # fmt: skip


@pytest.mark.one_in(6)
@pytest.mark.parametrize("name", _CORRUPTIONS)
def test_corrupted_designs_are_refused(name: str, design: ObserverDesign) -> None:
    corrupt, row = _CORRUPTIONS[name]
    report = obsynth.verify(corrupt(design))
    assert not report.passed
    assert not report[row].passed


def test_a_correction_of_another_shape_is_refused(design: ObserverDesign) -> None:
    with pytest.raises(SpecError, match="correction of the observer"):
        with_observer(design, correction=np.zeros((2, 4, 2)))


def test_a_gain_set_and_arrays_hold_the_correction(tmp_path: Path, design: ObserverDesign) -> None:
    again = obsynth.load(design.save(tmp_path / "turning.gains.json"))
    assert obsynth.verify(again).passed
    assert np.array_equal(again.scheduled[1].correction, design.scheduled[1].correction)  # type: ignore[arg-type]
    (file,) = obsynth.export(design, tmp_path / "turning.npz")
    assert np.array_equal(np.moveaxis(np.load(file)["correction"], -1, 0), again.scheduled[1].correction)  # type: ignore[arg-type]


@pytest.mark.long
def test_what_has_no_such_filter_is_refused_and_left_to_the_pi_observer() -> None:
    # Six equations in four columns of gains.
    two = turning_plant(
        A=np.diag([0.5, 0.4, 0.3, 0.2]), C=np.eye(2, 4), Bf=[["1 - v", -1], ["v", 1], [0.3, 0], [0.2, "v"]]
    )
    with pytest.raises(PreconditionError, match="too few outputs to follow how the faults turn"):
        obsynth.fault_estimation_filter(two)
    # The fault of one end is against that of the other: between them it has no effect on what is read.
    opposite = turning_plant(Bf=[["1 - 2 * v"], ["0.3 - 0.6 * v"], ["0.1 - 0.2 * v"], [0.2]])
    with pytest.raises(PreconditionError):
        obsynth.fault_estimation_filter(opposite)
    with pytest.raises(SpecError, match="turning_faults"):
        obsynth.conditions.wang2015(_plant())
    # The equations have a solution, but none with a certificate.
    few = turning_plant(C=np.eye(2, 4), Bf=[["1 - v"], ["v"], ["0.3 + v"], ["0.2 - v"]])
    with pytest.raises(SolverError, match="ui-pi-observer takes such faults"):
        obsynth.fault_estimation_filter(few)
    assert obsynth.design(few).method == "ui-pi-observer"


@pytest.mark.one_in(4)
@pytest.mark.skipif(shutil.which("gcc") is None, reason="no C compiler")
def test_c_corrects_as_python_does(tmp_path: Path, design: ObserverDesign) -> None:
    observer, rng = design.scheduled[1], np.random.default_rng(5)
    rows = np.column_stack([rng.standard_normal(150), rng.uniform(0, 1, 150), rng.standard_normal((150, 3))])
    rows[40, 1], rows[41, 1], rows[90, 1], rows[0, 1] = np.nan, 1.5, -1e9, np.nan
    main = MAIN.replace("residuals[NF]", "residuals[NY]").replace(
        'i < NF; i++) printf(" %.17g", residuals', 'i < NY; i++) printf(" %.17g", residuals'
    )
    found = in_c(compiled(design, tmp_path, main), rows)
    run, claimed = observer.record(rows[:, 2:], rows[:, :2])
    assert np.max(np.abs(run - found[:, 1:]) / np.maximum(np.abs(run), 1.0)) < 1e-12
    after = int(observer.forgetting)
    assert np.array_equal(found[after:, 0] == 0, claimed[after:])


@pytest.mark.long
def test_without_disturbances_the_decay_is_proved() -> None:
    made = obsynth.fault_estimation_filter(turning_plant())
    assert made.report.passed
    assert "gamma" not in made.certificate.claims
    assert 0.0 < made.certificate.claims["region_decay"] < 1.0

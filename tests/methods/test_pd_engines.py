"""The ways to a PD observer: the inequality of the theorem, and a closed form."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.linalg

import obsynth
from obsynth.conditions.pd_inequalities import PdTask
from obsynth.methods.pd_observer import synthesis
from obsynth.methods.pd_observer.certificate_proofs import prove_gains
from obsynth.methods.pd_observer.closed_form import closed_form
from obsynth.methods.pd_observer.limits import fastest_mode
from obsynth.methods.pd_observer.method import LMI_UP_TO, PdObserver
from obsynth.methods.pd_observer.realisation import with_faults_as_states
from obsynth.specs.loader import load_spec

PLANT = load_spec(Path(__file__).parents[2] / "designs" / "filasova" / "spec.yaml").plant
ENGINES = ("lmi", "riccati")


def task_of(plant: obsynth.DescriptorSystem, *, theorem: int, delta: float, decay: float) -> PdTask:
    augmented = with_faults_as_states(plant)
    empty = np.zeros((0, 0))
    return PdTask(
        plants=((augmented.A, augmented.C),), theorem=theorem, delta=delta, decay=decay, disk=None, gain_bound=None,
        gain_unit=1.0, rate_gain=None, noise_gain=None, rate=empty, fault_error=empty, process=empty, sensor=empty,
        sensor_rate=empty,
    )  # fmt: skip


def large_plant(nx: int, seed: int = 0) -> obsynth.DescriptorSystem:
    rng = np.random.default_rng([nx, seed])
    a = rng.normal(size=(nx, nx)) / np.sqrt(nx)
    return obsynth.DescriptorSystem(
        None, a, C=rng.normal(size=(nx // 4, nx)) / np.sqrt(nx), Bf=rng.normal(size=(nx, 2))
    )


class TestClosedForm:
    @pytest.mark.parametrize("theorem", [1, 2])
    @pytest.mark.parametrize("decay", [0.0, 1.5])
    def test_it_serves_below_its_delta(self, theorem: int, decay: float) -> None:
        task = task_of(PLANT, theorem=theorem, delta=1e3, decay=decay)
        found, delta = closed_form(task, free_delta=True)
        assert delta < 1e3
        a, c = task.plants[0]
        assert prove_gains(a, c, found.J, found.L, found.P1[0], found.P3, delta=delta, decay=decay).proved
        np.testing.assert_array_equal(found.P3, found.P3.T)
        smaller, same = closed_form(replace(task, delta=0.1 * delta), free_delta=True)
        assert same == 0.1 * delta
        np.testing.assert_array_equal(smaller.J, found.J)

    def test_a_delta_that_is_asked_is_kept(self) -> None:
        """Theorem 1 has a solution for every delta; Theorem 2 with these gains has none above the limit."""
        design = obsynth.pd_observer(PLANT, engine="riccati", delta=10.0, decay=0.0)
        assert design.certificate.claims["delta"] == 10.0
        with pytest.raises(obsynth.SolverError, match="smaller delta"):
            obsynth.pd_observer(PLANT, engine="riccati", theorem=2, delta=10.0, decay=0.0)

    def test_two_algorithms_for_the_riccati_equation_and_an_error(self, monkeypatch: pytest.MonkeyPatch) -> None:
        task = task_of(PLANT, theorem=1, delta=0.1, decay=0.0)
        expected = closed_form(task, free_delta=True)[0].J

        def failing(*_: object, **__: object) -> None:
            raise np.linalg.LinAlgError("broken")

        monkeypatch.setattr(scipy.linalg, "schur", failing)
        np.testing.assert_allclose(closed_form(task, free_delta=True)[0].J, expected, rtol=1e-9, atol=1e-12)
        monkeypatch.setattr(scipy.linalg, "solve_continuous_are", failing)
        with pytest.raises(obsynth.SolverError, match="not solved") as caught:
            closed_form(task, free_delta=True)
        assert caught.value.record["what"]


class TestChoice:
    @pytest.mark.parametrize("theorem", [1, 2])
    @pytest.mark.parametrize("engine", ENGINES)
    def test_each_engine_runs_and_the_result_says_so(self, engine: str, theorem: int) -> None:
        design = obsynth.pd_observer(PLANT, engine=engine, theorem=theorem, decay=0.7)
        assert (design.solver["engine"], design.options["engine"]) == (engine, engine)
        assert design.report.passed
        assert np.max(np.linalg.eigvals(design.observer.Az).real) < -0.7
        assert np.any(design.gains["L"]) is np.bool_(engine == "lmi")

    def test_small_plants_get_the_smallest_gains(self) -> None:
        default = obsynth.pd_observer(PLANT)
        assert default.solver["engine"] == "lmi"
        np.testing.assert_array_equal(default.gains["J"], obsynth.pd_observer(PLANT, engine="lmi").gains["J"])

    def test_large_plants_get_the_closed_form_with_a_note(self) -> None:
        design = obsynth.pd_observer(large_plant(60))
        assert design.report.passed
        assert design.solver["engine"] == "riccati"
        assert any("62 unknown states" in note for note in design.notes)

    @pytest.mark.long
    def test_where_the_closed_form_does_not_serve_the_inequality_does(self) -> None:
        """Theorem 2 for a delta of many time constants: "auto" goes on, and says so."""
        plant = large_plant(LMI_UP_TO)
        design = obsynth.pd_observer(plant, theorem=2, delta=20.0, decay=0.0)
        assert design.report.passed
        assert design.solver["engine"] == "lmi"
        assert any("'riccati' failed" in note for note in design.notes)

    def test_what_is_asked_besides_takes_the_whole_inequality(self) -> None:
        assert PdObserver(gain_bound=3.0).engines_for(10 * LMI_UP_TO) == ("lmi",)
        assert obsynth.pd_observer(PLANT, fault_rate_gain=0.7).solver["engine"] == "lmi"
        with pytest.raises(obsynth.SpecError, match="stability and a decay rate alone") as caught:
            obsynth.pd_observer(PLANT, engine="riccati", gain_bound=30.0)
        assert "gain_bound" in str(caught.value)
        with pytest.raises(obsynth.SpecError, match="engine is 'reduced-lmi'"):
            obsynth.pd_observer(PLANT, engine="reduced-lmi")

    def test_adaptation_gain_works_with_each(self) -> None:
        for engine in ENGINES:
            assert obsynth.pd_observer(PLANT, engine=engine, adaptation_gain=5.0).report.passed

    def test_the_spare_engine_is_named(self, monkeypatch: pytest.MonkeyPatch) -> None:
        def failing(*_: object, **__: object) -> None:
            raise obsynth.SolverError("broken")

        monkeypatch.setattr(synthesis, "solve", failing)
        design = obsynth.pd_observer(PLANT, engine="lmi")
        assert design.solver["engine"] == "riccati"
        assert any("'lmi' failed" in note and "Riccati" in note for note in design.notes)


@pytest.mark.parametrize("rest", [7e-17, -7e-17, 0.0])
def test_an_integrator_sets_no_pace_on_either_side_of_zero(rest: float) -> None:
    # As a damped mode it was the slowest: delta was 1.4e16 s, and no engine found gains.
    assert fastest_mode(np.diag([rest, -1.875, -2.0])) == 2.0
    assert fastest_mode(np.array([[rest, 0.0, 0.0], [0.0, -1.0, 3.0], [0.0, -3.0, -1.0]])) == pytest.approx(10.0**0.5)

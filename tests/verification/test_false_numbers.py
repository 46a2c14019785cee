"""Numbers of a stored design that hide what is claimed: constants added to estimates, negative gains, no numbers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import obsynth
from obsynth.proofs.vertex_inequalities import Witness, pairs_of, prove_mean_square
from obsynth.verification.over_region import decay_row, forgetting_row

PLANT = obsynth.DescriptorSystem(A=[[0.5]], C=[[1.0]], Bf=[[1.0]], Bw=[[0.1]], Dw=[[1.0]], dt=0.1)
DESIGNS = {
    "optimal-filter": lambda: obsynth.optimal_filter(PLANT),
    "ui-pi-observer": lambda: obsynth.ui_pi_observer(PLANT),
    "functional-filter": lambda: obsynth.functional_filter(PLANT),
    "fault-estimation-filter": lambda: obsynth.fault_estimation_filter(PLANT),
}


@pytest.mark.one_in(4)
@pytest.mark.parametrize("method", DESIGNS)
def test_a_constant_that_is_added_to_an_estimate_fails(method: str) -> None:
    design = DESIGNS[method]()
    assert obsynth.verify(design).passed
    observer = replace(design.observer, constant=np.full(len(design.observer.Cz), 5.0))
    report = obsynth.verify(replace(design, observer=observer, report=None))
    assert not report.passed
    assert "error model" in {row.name for row in report.failures}


CONSTRAINED = obsynth.DescriptorSystem(
    E=np.diag([1.0, 1.0, 0.0]), A=[[-0.8, 0.1, 0.3], [0.0, -0.7, 0.2], [1.0, 0.4, -1.0]],
    B=[[1.0], [0.5], [0.2]], C=[[1.0, 0.0, 0.3], [0.0, 1.0, 1.0]], Bf=[[1.0], [0.0], [0.0]],
    Bw=0.1 * np.eye(3, 5)[:, [0, 1, 4, 2, 3]] * [[1.0], [1.0], [0.0]],
    Dw=0.1 * np.eye(2, 5, k=3), operating_point={"x3": 2.0}, dt=0.0,
)  # fmt: skip


def _changed(matrix: np.ndarray, place: tuple[int, int], value: float) -> np.ndarray:
    changed = matrix.copy()
    changed[place] = value
    return changed


@pytest.mark.one_in(4)
@pytest.mark.parametrize("sampled", [True, False])
@pytest.mark.parametrize("field", ["names", "from_state", "both", "from_noise", "noise_kept", "operating_point"])
def test_states_as_written_are_recovered_under_their_names(field: str, sampled: bool) -> None:
    """A state under another name, ten times as large, or about another point, was verified."""
    if sampled:
        design = obsynth.ui_pi_observer(obsynth.discretise(CONSTRAINED, 0.1))
    else:
        design = obsynth.functional_filter(obsynth.eliminate_algebraic_states(CONSTRAINED))
    known = design.recovery
    assert obsynth.verify(design).passed
    assert "recovery as written" in {row.name for row in design.report.checks}
    other = {
        "names": ("x1", "x2", "level"),
        "from_state": _changed(known.from_state, (2, 0), 10.0),
        "from_noise": _changed(known.from_noise, (2, 1), 0.1),
        "noise_kept": _changed(known.noise_kept, (0, 0), 0.5),
        "operating_point": {"x3": 5.0},
    }
    fields = ("names", "from_state") if field == "both" else (field,)
    changed = replace(design, recovery=replace(known, **{name: other[name] for name in fields}), report=None)
    expected = "stored twice" if "noise" in field else "recovery as written"
    assert {row.name for row in obsynth.verify(changed).failures} == {expected}


def test_states_that_a_model_of_noise_adds_need_no_row_in_the_recovery() -> None:
    stated = {"y1": {"deviation": 0.05, "correlation": "2 s"}, "y2": 0.1}
    noisy, _ = obsynth.with_noise(CONSTRAINED.replace(Bw=None, Dw=None, noise_names=None), sensor_noise=stated)
    assert noisy.plant.nx > CONSTRAINED.nx
    design = obsynth.ui_pi_observer(obsynth.discretise(noisy, 0.1))
    assert design.recovery.names == CONSTRAINED.state_names
    assert "recovery as written" in {row.name for row in design.report.checks if row.passed}


def test_the_way_back_to_a_network_too_large_to_be_held_is_assumed() -> None:
    """Its elimination was held against the plant that was sampled, which has fewer states: no design was verified."""
    eliminated = obsynth.eliminate_algebraic_states(CONSTRAINED)
    # As that of a sparse network, which leaves no note.
    object.__delattr__(eliminated.plant, "_made_from")
    design = obsynth.ui_pi_observer(obsynth.discretise(eliminated, 0.1))
    assert design.recovery.names == CONSTRAINED.state_names
    assert [row.status for row in design.report.checks if row.name == "plant as written"] == ["assumed"]


def test_a_negative_gain_is_no_bound() -> None:
    design = DESIGNS["optimal-filter"]()
    certificate = replace(
        design.certificate, claims={**design.certificate.claims, "gain": -design.certificate.claims["gain"]}
    )
    report = obsynth.verify(replace(design, certificate=certificate, report=None))
    assert "gain" in {row.name for row in report.failures}


def test_a_mean_square_with_steps_holds_between_the_corners_too() -> None:
    """The trace at the corners of the steps is 1.5 squared at most; at rest in the middle the mean square is larger."""

    def vertex(t: float):
        def matrices(kind):
            numbers = ([[0.0, 10.0 * t], [0.0, 0.0]], [[0.0], [1.0 - t]], np.eye(2), np.zeros((2, 1)))
            return tuple(kind.exact(np.array(each)) for each in numbers)

        return matrices

    witness = Witness([np.diag([1.05, 1.01]), np.diag([1.05, 111.01])], [np.diag([1.05, 120.0])], pairs_of(2, 0.01))
    vertices = [vertex(0.0), vertex(1.0)]
    assert not prove_mean_square(vertices, witness, 1.5, discrete=True).proved
    assert prove_mean_square(vertices, witness, 12.0, discrete=True).proved


def test_a_negative_decay_is_none() -> None:
    one = np.ones((1, 1))
    vertices = [lambda kind: (kind.exact(2.0 * one), kind.exact(one), kind.exact(one), kind.exact(0.0 * one))] * 2
    assert not decay_row(vertices, Witness([one]), -3.0, discrete=True, words="").passed
    assert not forgetting_row(0.99999, 100_001.0, discrete=True).passed


@pytest.mark.long
def test_unknown_inputs_are_decoupled_in_any_unit() -> None:
    plant = obsynth.PolytopicSystem(
        plant={
            "A": [["0.5*v", 0, 0], [0, 0.4, 0], [0, 0, 0.3]],
            "Bd": [[1e8, 0], [1e8, 0], [0, 1e-3]],
            "C": np.eye(3).tolist(),
            "dt": 1.0,
        },
        scheduling={"v": [0, 1]},
    )
    design = obsynth.descriptor_kalman(plant, Q=1e-8, R=1e-8)
    missed = np.abs(design.certificate.matrices["tracking"] @ plant.vertices[0].Bd).max(axis=0)
    assert np.all(missed <= 1e-12 * np.abs(plant.vertices[0].Bd).max(axis=0))


@pytest.mark.one_in(6)
@pytest.mark.parametrize("method", ["ui-pi-observer", "functional-filter"])
@pytest.mark.parametrize("model", ["ramp", {"f1": "ramp"}, {"sinusoid": 3.0}, {"exponential": -1e-6}])
def test_an_observer_for_steps_is_named_as_one(method: str, model: object) -> None:
    design = DESIGNS[method]()
    named = replace(design, options={**design.options, "fault_model": model}, report=None)
    assert "model of faults" in {row.name for row in obsynth.verify(named).failures}


def test_walks_are_those_of_the_options() -> None:
    """A smaller walk than the one that was designed for has a smaller deviation."""
    design = DESIGNS["functional-filter"]()
    matrices = design.certificate.matrices
    deviations = np.column_stack([matrices["deviations"][:, 0], 1.01 * matrices["deviations"][:, 0]])
    smaller = {**matrices, "walks": 0.01 * matrices["walks"], "deviations": deviations}
    report = obsynth.verify(replace(design, certificate=replace(design.certificate, matrices=smaller), report=None))
    assert {row.name for row in report.failures} == {"walks of faults"}


def test_a_large_fault_does_not_show_in_the_estimate_of_a_small_one() -> None:
    """A share of 1e-7 of a fault of a million is a tenth of a fault of one, beside which it is judged."""
    plant = obsynth.DescriptorSystem(
        A=[[0.5, 0.1], [0.0, 0.4]],
        C=[[1, 0], [0, 1], [1, 1]],
        Bf=[[1e-6, 0], [0, 1]],
        Bw=np.zeros((2, 3)),
        Dw=0.1 * np.eye(3),
        dt=1.0,
    )
    design = obsynth.optimal_filter(plant, delay=1)
    mixed = np.array([[1.0, 0.0], [1e-7, 1.0]])
    rows = {name: mixed @ getattr(design.observer, name) for name in ("Cz", "Du", "Dy")}
    matrices = {**design.certificate.matrices, "T0": mixed @ design.certificate.matrices["T0"]}
    changed = replace(
        design,
        observer=replace(design.observer, **rows),
        certificate=replace(design.certificate, matrices=matrices),
        gains={},
        report=None,
    )
    assert obsynth.verify(design).passed
    assert "fault map" in {row.name for row in obsynth.verify(changed).failures}

"""Regularity, index, stability and observability of plants."""

import json
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from scipy.linalg import block_diag

from obsynth.analysis.structure import analyse_structure
from obsynth.plants.descriptor import DescriptorSystem

SMIB = Path(__file__).parents[2] / "designs" / "smib"

PAPER = DescriptorSystem(
    np.diag([1.0, 1, 1, 0]),
    [[0.9, 0.005, -0.095, 0], [0.005, 0.995, 0.0997, 0], [0.095, -0.0997, 0.99, 0], [1, 0, 1, 1]],
    C=[[0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
    dt=1.0,
)


def nonsingular(size, rng):
    left, right = (np.linalg.qr(rng.standard_normal((size, size)))[0] for _ in range(2))
    return left * 5.0 ** rng.uniform(-0.5, 0.5, size) @ right


def smib(outputs):
    E, A = (scipy.io.mmread(SMIB / f"{name}.mtx").toarray() for name in "EA")
    names = json.loads((SMIB / "names.json").read_text(encoding="utf-8"))
    return DescriptorSystem(E, A, C=outputs, state_names=names["differential"] + names["algebraic"])


def test_paper_example():
    structure = analyse_structure(PAPER)
    assert structure.regular
    assert structure.index == 1
    assert structure.infinite_block_sizes == (1,)
    assert structure.impulse_free
    assert structure.impulse_observable
    assert structure.causally_observable
    assert structure.detectable
    assert structure.finitely_observable
    assert structure.rank_of_E.rank == 3
    assert structure.unclear == ()
    assert structure.stable == bool(np.all(np.abs(np.linalg.eigvals(PAPER.A[:3, :3])) < 1))
    assert {"rank E", "rank [E; C]", "rank [E A; 0 E; 0 C]"} <= set(structure.decisions)
    with pytest.raises(TypeError):
        structure.decisions["rank E"] = None


@pytest.mark.parametrize("seed", range(5))
def test_invariant_under_equation_state_and_output_coordinates(seed):
    rng = np.random.default_rng(seed)
    E = block_diag(np.eye(3), np.eye(2, k=1), [[0.0]])
    A = block_diag(np.diag([0.5, 1.2, -0.3]), np.eye(2), [[1.0]])
    C = np.zeros((2, 6))
    C[0, [0, 3]] = 1.0  # the state with eigenvalue 1.2 and its algebraic neighbour never show
    C[1, [2, 4]] = 1.0
    P, Q, M = nonsingular(6, rng), nonsingular(6, rng), nonsingular(2, rng)
    units = 10.0 ** rng.uniform(-3, 3, 6)
    for plant in (
        DescriptorSystem(E, A, C=C, dt=0.1),
        DescriptorSystem(P @ E @ Q * units, P @ A @ Q * units, C=M @ C @ Q * units, dt=0.1),
    ):
        structure = analyse_structure(plant)
        assert structure.regular
        assert structure.index == 2
        assert structure.infinite_block_sizes == (2, 1)
        assert not structure.impulse_free
        assert not structure.admissible
        assert not structure.stable
        assert structure.unobservable_modes == pytest.approx([1.2])
        assert structure.undetectable_modes == pytest.approx([1.2])
        assert not structure.detectable
        assert structure.impulse_observable
        assert not structure.causally_observable
        assert structure.rank_of_E.rank == 4


def test_stable_unobservable_mode_is_detectable():
    structure = analyse_structure(DescriptorSystem(None, np.diag([0.5, 0.9]), C=[[1, 0]], dt=1.0))
    assert structure.unobservable_modes == pytest.approx([0.9])
    assert structure.undetectable_modes == ()
    assert structure.detectable
    assert not structure.finitely_observable
    assert structure.stable
    assert structure.admissible


def test_same_matrices_in_continuous_time_are_unstable():
    structure = analyse_structure(DescriptorSystem(None, np.diag([0.5, 0.9]), C=[[1, 0]]))
    assert not structure.stable
    assert structure.undetectable_modes == pytest.approx([0.9])


@pytest.mark.parametrize(("A", "dt"), [(np.zeros((1, 1)), 0.0), (np.eye(1), 0.5), (-np.eye(1), 0.5)])
def test_marginal_is_not_stable(A, dt):
    assert not analyse_structure(DescriptorSystem(None, A, dt=dt)).stable


@pytest.mark.parametrize("seed", range(20))
def test_double_pole_on_the_boundary_is_not_stable(seed):
    rng = np.random.default_rng(seed)
    T = nonsingular(5, rng)
    block = block_diag([[0.0, 1.0], [0.0, 0.0]], np.diag(rng.uniform(-2, -0.5, 3)))
    assert not analyse_structure(DescriptorSystem(None, np.linalg.solve(T, block @ T))).stable
    turned = block_diag([[-1.0, 1.0], [0.0, -1.0]], np.diag(rng.uniform(-0.9, 0.9, 3)))
    assert not analyse_structure(DescriptorSystem(None, np.linalg.solve(T, turned @ T), dt=1.0)).stable
    inside = block_diag([[-0.999, 1.0], [0.0, -0.999]], np.diag(rng.uniform(-0.9, 0.9, 3)))
    assert analyse_structure(DescriptorSystem(None, np.linalg.solve(T, inside @ T), dt=1.0)).stable


def test_singular_plant_is_an_answer_not_an_error():
    structure = analyse_structure(DescriptorSystem(np.diag([1.0, 0.0]), [[0.5, 0.0], [0.0, 0.0]], C=[[1, 0]]))
    assert not structure.regular
    assert structure.index is None
    assert not structure.stable
    assert not structure.impulse_free
    assert structure.observability_normal_rank == 1
    assert not structure.detectable
    assert not structure.finitely_observable


def test_plant_without_outputs():
    structure = analyse_structure(DescriptorSystem(None, np.diag([0.5, 0.7]), dt=1.0))
    assert structure.unobservable_modes == pytest.approx([0.5, 0.7])
    assert structure.causally_observable


def test_measured_differentiator_is_impulse_observable_only_through_its_output():
    E, A = np.eye(2, k=1), np.eye(2)
    assert analyse_structure(DescriptorSystem(E, A, C=[[1, 0]])).impulse_observable
    assert not analyse_structure(DescriptorSystem(E, A, C=[[0, 1]])).impulse_observable


@pytest.mark.parametrize(("outputs", "detectable"), [(["a Bus 1"], True), (["v Bus 3", "omega GENCLS 1"], False)])
def test_smib(outputs, detectable):
    """Without an angle among the outputs the common angle of all machines is invisible: a mode at zero."""
    structure = analyse_structure(smib(outputs))
    assert structure.index == 1
    assert len(structure.infinite_block_sizes) == 30
    assert len(structure.finite_eigenvalues) == 4
    assert np.min(np.abs(structure.finite_eigenvalues)) < 1e-10
    assert not structure.stable
    assert structure.detectable == detectable
    assert structure.impulse_observable
    assert structure.unclear == ()
    if not detectable:
        assert len(structure.undetectable_modes) == 1
        assert abs(structure.undetectable_modes[0]) < 1e-10
    at_zero = [decision for name, decision in structure.decisions.items() if "at z =" in name]
    assert [decision.full for decision in at_zero] == [detectable]

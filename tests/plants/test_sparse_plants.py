"""Plants with sparse matrices: kept, checked, and reduced to what LAPACK finds; variables that act on nothing."""

from __future__ import annotations

import pickle
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import scipy.sparse as sp
from scipy.linalg import block_diag
from scipy.sparse.csgraph import structural_rank

import obsynth
from obsynth.analysis.diagnosis.decoupled import decouple
from obsynth.analysis.existence.filasova import pd_observer_conditions
from obsynth.analysis.existence.sharepasand import existence_conditions
from obsynth.methods.designing import check
from obsynth.numerics.ranks import CANCELLATION_TOLERANCE
from obsynth.numerics.sparse_factor import SparseFactor, scales_by_all_entries
from obsynth.numerics.sparse_structure import blocks_of, coarse_structure
from obsynth.plants.faults import exosystem
from obsynth.plants.transformations.elimination import eliminated_by_sparsity
from obsynth.plants.transformations.recovery_operator import without_rounding
from obsynth.specs.loader import load_spec

sys.path.insert(0, str(Path(__file__).parent))
from networks import random_network, write

MATRICES = ("A", "B", "C", "D", "Bf", "Df", "Bd", "Dd", "Bw", "Dw")
MAPS = ("from_state", "from_input", "from_fault", "from_disturbance", "from_noise")
FORMATS = (np.array, sp.csr_array, sp.csc_matrix, sp.coo_array, sp.lil_matrix)


def random_index_one(rng: np.random.Generator, *, mass: bool, mixed: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return E and A of eight variables, five of them dynamic; a mass matrix, rows in any order."""
    e, a = np.zeros((8, 8)), rng.normal(size=(8, 8)) * (rng.random((8, 8)) < 0.5) - 2 * np.eye(8)
    e[:5, :5] = np.diag(rng.uniform(0.5, 2, 5))
    if mass:
        e[0, 1], e[3, 2] = 0.3, -0.4
    order = rng.permutation(8) if mixed else np.arange(8)
    return e[order], a[order]


class TestKept:
    def test_matrices_stay_as_given(self):
        e, a = sp.csc_matrix(np.eye(3)), sp.csr_array(-np.eye(3))
        plant = obsynth.DescriptorSystem(e, a, C=["x1"], B=[[1], [0], [0]])
        assert isinstance(plant.A, sp.csr_array)
        assert isinstance(plant.E, sp.csc_matrix)
        assert plant.is_sparse
        assert isinstance(plant.B, np.ndarray)
        with pytest.raises(ValueError, match="read-only"):
            plant.A.data[0] = 5.0
        a.data[0] = 7.0
        assert plant.A[0, 0] == -1.0

    def test_dense(self):
        plant = obsynth.DescriptorSystem(None, sp.coo_array(np.diag([1.0, 2.0])), C=["x2"])
        arrays = plant.dense()
        assert isinstance(arrays.A, np.ndarray)
        np.testing.assert_array_equal(arrays.E, np.eye(2))
        assert arrays.dense() is arrays
        assert arrays.state_names == plant.state_names

    @pytest.mark.parametrize(
        ("bad", "message"),
        [
            (sp.csr_array([[1.0, np.nan], [0, 1]]), "row 1, column 2"),
            (sp.csr_array([[1j, 0], [0, 1]]), "complex"),
            (sp.csr_array((2, 3)), "square"),
        ],
    )
    def test_bad_matrices(self, bad, message):
        with pytest.raises(obsynth.SpecError, match=message):
            obsynth.DescriptorSystem(None, bad)

    def test_a_sparse_zero_matrix_has_columns(self):
        plant = obsynth.DescriptorSystem(None, sp.eye_array(2, format="csr"), B=sp.csr_array((2, 3)))
        assert plant.nu == 3


class TestElimination:
    @pytest.mark.one_in(4)
    @pytest.mark.parametrize("make", FORMATS[1:])
    def test_like_lapack(self, make):
        rng = np.random.default_rng(1)
        for trial in range(6):
            e, a = random_index_one(rng, mass=trial % 2 == 1, mixed=trial % 3 == 0)
            b = rng.normal(size=(8, 2))
            signals = {
                "B": b,
                "C": rng.normal(size=(3, 8)),
                "Bf": b[:, :1],
                "Bd": b[:, 1:],
                "Bw": b,
                "D": np.ones((3, 2)),
            }
            ours = eliminated_by_sparsity(obsynth.DescriptorSystem(make(e), make(a), **signals))
            other = obsynth.eliminate_algebraic_states(obsynth.DescriptorSystem(e, a, **signals))
            for name in MATRICES:
                np.testing.assert_allclose(getattr(ours.plant, name), getattr(other.plant, name), atol=1e-11)
            for name in MAPS:
                np.testing.assert_allclose(getattr(ours.recovery, name), getattr(other.recovery, name), atol=1e-11)
            assert ours.recovery.flags() == other.recovery.flags()
            assert ours.plant.state_names == other.plant.state_names
            assert ours.bounds.forward_error < 1e-11

    def test_networks_against_their_truth(self):
        network = random_network(300, 60, 3)
        plant = network.plant()
        found = obsynth.eliminate_algebraic_states(plant)
        assert set(found.dropped) == set(network.idle)
        assert found.plant.state_names == network.dynamic
        np.testing.assert_allclose(found.plant.A, network.truth(), rtol=1e-10, atol=1e-10)
        assert all(repr(name) in found.notes[0] for name in network.idle)
        states = np.random.default_rng(0).normal(size=found.plant.nx)
        recovered = dict(zip(found.recovery.names, found.recovery.from_state @ states, strict=True))
        values = np.array([recovered.get(name, 0.0) for name in plant.state_names])
        algebraic = [i for i, name in enumerate(plant.state_names) if name in recovered and not plant.E[[i]].nnz]
        np.testing.assert_allclose((plant.A @ values)[algebraic], 0.0, atol=1e-9)

    def test_arrays_of_many_variables_go_by_sparsity(self):
        network = random_network(520, 40, 4)
        plant = network.plant()
        by_sparsity = obsynth.eliminate_algebraic_states(plant.dense())
        assert by_sparsity.bounds is not None
        np.testing.assert_array_equal(by_sparsity.plant.A, obsynth.eliminate_algebraic_states(plant).plant.A)

    def test_sampled_and_pickled(self):
        plant = random_network(300, 40, 5).plant()
        sampled = obsynth.discretise(plant, 0.02)
        again = pickle.loads(pickle.dumps(sampled))
        np.testing.assert_array_equal(again.recovery.from_noise, sampled.recovery.from_noise)
        dense = obsynth.eliminate_algebraic_states(plant)
        np.testing.assert_allclose(sampled.recovery.from_state, dense.recovery.from_state, atol=1e-12)

    def test_from_files(self, tmp_path):
        network = random_network(320, 40, 6)
        write(network, tmp_path)
        spec = load_spec(tmp_path / "ui-pi-observer.yaml")
        assert spec.transformation.source.is_sparse
        np.testing.assert_allclose(spec.plant.A, network.truth(), rtol=1e-9, atol=1e-9)


class TestIdleVariables:
    E = np.diag([1.0, 1.0, 0.0, 0.0])
    # x2' = x4, 0 = x1 - x2, 0 = x1 - 2 x3: x4 is the derivative of x1, and acts on nothing.
    A = np.array([[-1.0, 0, 0, 0], [0, 0, 0, 1], [1, -1, 0, 0], [1, 0, -2, 0]])

    @pytest.mark.parametrize("make", FORMATS)
    def test_a_derivative_is_left_out(self, make):
        plant = obsynth.DescriptorSystem(make(self.E), make(self.A), C=[[1, 0, 0, 0]])
        found = obsynth.eliminate_algebraic_states(plant)
        assert found.dropped == ("x4",)
        assert "x4" in found.description
        assert found.recovery.names == ("x1", "x2", "x3")
        np.testing.assert_allclose(found.plant.A, [[-1.0]])
        np.testing.assert_allclose(found.recovery.from_state[:, 0], [1.0, 1.0, 0.5])

    @pytest.mark.parametrize("make", FORMATS)
    def test_where_it_is_measured_or_acts_it_follows_from_the_states(self, make):
        acting = self.A.copy()
        acting[0, 3] = 0.5
        # x4 = x1': -x1, and with 0.5 x4 in the equation of x1 x1' = -2 x1.
        for a, c, rate, shown in ((self.A, [[1, 0, 0, 1]], -1.0, 0.0), (acting, [[1, 0, 0, 0]], -2.0, 1.0)):
            found = obsynth.eliminate_algebraic_states(obsynth.DescriptorSystem(make(self.E), make(a), C=c))
            assert found.dropped == ()
            np.testing.assert_array_equal(found.plant.A, [[rate]])
            np.testing.assert_array_equal(found.plant.C, [[shown]])
            np.testing.assert_array_equal(found.recovery.from_state, [[1], [1], [0.5], [rate]])

    @pytest.mark.parametrize("make", FORMATS)
    def test_not_where_what_is_measured_needs_the_derivative_of_a_signal(self, make):
        # 0 = x1 - x2 + f: x4 = x1' + f'.
        plant = obsynth.DescriptorSystem(
            make(self.E), make(self.A), C=[[1, 0, 0, 0], [0, 0, 0, 1]], Bf=[[0], [0], [1], [0]], output_names=["a", "b"]
        )
        with pytest.raises(obsynth.PreconditionError, match="output 'b' needs the derivative of 'f1'") as caught:
            obsynth.eliminate_algebraic_states(plant)
        assert caught.value.condition == "index"
        assert caught.value.signals == ("b", "f1")
        found = obsynth.eliminate_algebraic_states(plant.replace(C=[[1, 0, 0, 0], [0, 1, 0, 0]]))
        assert found.dropped == ("x4",)
        np.testing.assert_array_equal(found.plant.Df, [[0], [1]])

    @pytest.mark.parametrize("make", FORMATS)
    def test_a_large_plant_whose_variable_acts_is_refused(self, make):
        acting = self.A.copy()
        acting[0, 3] = 0.5
        more = -np.eye(64)
        for a, c in ((self.A, [[1, 0, 0, 1]]), (acting, [[1, 0, 0, 0]])):
            plant = obsynth.DescriptorSystem(
                make(block_diag(self.E, np.eye(64))), make(block_diag(a, more)), C=np.pad(c, ((0, 0), (0, 64)))
            )
            with pytest.raises(obsynth.PreconditionError, match="index") as caught:
                obsynth.eliminate_algebraic_states(plant)
            assert "x4" in caught.value.signals

    @pytest.mark.parametrize("make", FORMATS)
    def test_an_equation_that_repeats_another(self, make):
        e, a = np.diag([1.0, 0, 0]), np.array([[-1.0, 0, 0], [1, -1, 0], [3, -3, 0]])
        found = obsynth.eliminate_algebraic_states(obsynth.DescriptorSystem(make(e), make(a), C=[[1, 0, 0]]))
        assert found.dropped == ("x3",)
        a[2] = [3, -2, 0]
        with pytest.raises(obsynth.PreconditionError) as caught:
            obsynth.eliminate_algebraic_states(obsynth.DescriptorSystem(make(e), make(a), C=[[1, 0, 0]]))
        assert caught.value.condition == "regularity"

    @pytest.mark.parametrize("make", FORMATS)
    def test_an_isolated_variable(self, make):
        e, a = np.diag([1.0, 0, 0]), np.array([[-1.0, 0, 0], [1, -1, 0], [0, 0, 0]])
        found = obsynth.eliminate_algebraic_states(obsynth.DescriptorSystem(make(e), make(a), C=[[1, 0, 0]]))
        assert found.dropped == ("x3",)
        assert found.recovery.names == ("x1", "x2")
        # 0 = f says something, and a measured variable acts on something.
        for others in ({"C": [[1, 0, 0]], "Bf": [[0], [0], [1]]}, {"C": [[1, 0, 1]]}):
            with pytest.raises(obsynth.PreconditionError, match=r"'x3' is in too few .* 3 \(of 'x3'\)"):
                obsynth.eliminate_algebraic_states(obsynth.DescriptorSystem(make(e), make(a), **others))

    @pytest.mark.one_in(4)
    @pytest.mark.parametrize("make", FORMATS)
    def test_washouts_in_a_chain(self, make):
        # 0 = x1 - x2, 0 = 9 (x1 - x2) for the output x3; 0 = x3 - x4, 0 = 2 (x3 - x4) for the output x5.
        e, a = np.zeros((5, 5)), np.zeros((5, 5))
        e[0, 0], a[0, 0] = 1.0, -1.0
        a[1, :2], a[2, :2], a[3, 2:4], a[4, 2:4] = [1, -1], [9, -9], [1, -1], [2, -2]
        units = 10.0 ** np.array([0, 6, -7, 5, -8])[:, None]
        for rows in (np.ones((5, 1)), units):
            plant = obsynth.DescriptorSystem(make(rows * e), make(rows * a), C=[[1, 0, 0, 0, 0]])
            found = obsynth.eliminate_algebraic_states(plant)
            assert found.dropped == ("x3", "x4", "x5")
            np.testing.assert_allclose(found.plant.A, [[-1.0]])
        with pytest.raises(obsynth.PreconditionError, match="not determine 'x3', 'x4'"):
            obsynth.eliminate_algebraic_states(plant.replace(C=[[1, 0, 1, 0, 0]]))

    @pytest.mark.parametrize("make", FORMATS)
    def test_what_only_such_a_variable_drives(self, make):
        # x4 is the derivative of x1, x5 a lag of it that nothing depends on.
        e, a = np.diag([1.0, 1.0, 0, 0, 0.1]), np.zeros((5, 5))
        a[:4, :4] = self.A
        a[4, 3], a[4, 4] = 1.0, -1.0
        plant = obsynth.DescriptorSystem(make(e), make(a), C=[[1, 0, 0, 0, 0]])
        found = obsynth.eliminate_algebraic_states(plant)
        assert found.dropped == ("x4", "x5")
        np.testing.assert_allclose(found.plant.A, [[-1.0]])
        # Measured it stays, as a lag of -x1.
        found = obsynth.eliminate_algebraic_states(plant.replace(C=[[1, 0, 0, 0, 1]]))
        assert found.dropped == ()
        np.testing.assert_allclose(found.plant.A, [[-1.0, 0], [-10, -10]])

    @pytest.mark.parametrize("make", FORMATS)
    def test_a_derivative_of_a_state_is_kept(self, make):
        # x2 = x1' needs no differentiation; x3 has no equation.
        e, a = np.array([[1.0, 0, 0], [1, 0, 0], [0, 0, 0]]), np.array([[-2.0, 0, 0], [0, 1, 0], [0, 0, 0]])
        found = obsynth.eliminate_algebraic_states(obsynth.DescriptorSystem(make(e), make(a), C=[[1, 0, 0]]))
        assert found.dropped == ("x3",)
        np.testing.assert_allclose(found.recovery.from_state, [[1.0], [-2.0]])

    @pytest.mark.parametrize("make", [sp.csr_array, np.array])
    def test_numbers_are_those_of_the_plant_as_given(self, make):
        # The first variable and the second equation are left out; measured x5 asks for a derivative.
        # (Smaller plants are solved with all derivatives.)
        e, a = np.zeros((70, 70)), np.zeros((70, 70))
        e[1, 1], e[2, 2], e[5:, 5:], a[5:, 5:] = 1.0, 1.0, np.eye(65), -np.eye(65)
        a[0, 2], a[0, 1], a[1, 0], a[2, 2], a[2, 4] = 1, -1, 1, -1, 1
        a[3, 2], a[3, 3], a[4, 2], a[4, 3] = 1, -1, 3, -2
        plant = obsynth.DescriptorSystem(make(e), make(a), C=[[0, 0, 0, 0, *np.ones(66)]])
        with pytest.raises(obsynth.PreconditionError, match=r"5 \(of 'x5'\).* not determine 'x5'") as caught:
            obsynth.eliminate_algebraic_states(plant)
        assert caught.value.condition == "index"

    @pytest.mark.parametrize("make", FORMATS)
    def test_where_no_state_would_be_left_the_index_is_told(self, make):
        plant = obsynth.DescriptorSystem(make([[0.0, 1], [0, 0]]), make(np.eye(2)), C=[[0, 1.0]])
        with pytest.raises(obsynth.PreconditionError, match=r"index 2.*'x1'") as caught:
            obsynth.eliminate_algebraic_states(plant)
        assert caught.value.condition == "index"

    def test_a_large_singular_pencil_is_no_index(self):
        network = random_network(200, 60, 2)
        a = network.A.toarray()
        row = network.names.index("v Bus 2")
        a[row] = 2.0 * a[network.names.index("a Bus 2")]
        plant = obsynth.DescriptorSystem(network.E.toarray(), a, C=list(network.outputs), state_names=network.names)
        with pytest.raises(obsynth.PreconditionError, match=f"not regular.*{row + 1} ") as caught:
            obsynth.eliminate_algebraic_states(plant)
        assert caught.value.condition == "regularity"

    @pytest.mark.parametrize("make", FORMATS)
    def test_a_repetition_that_a_fault_enters_is_none(self, make):
        e, a = np.diag([1.0, 0, 0]), np.array([[-1.0, 0, 0], [1, -1, 0], [3, -3, 0]])
        plant = obsynth.DescriptorSystem(make(e), make(a), C=[[1, 0, 0]], Bf=[[0], [0], [1]])
        with pytest.raises(obsynth.PreconditionError) as caught:
            obsynth.eliminate_algebraic_states(plant)
        assert caught.value.condition == "regularity"


class TestUnits:
    """Nothing is found singular, and no derivative lost, because of the units that equations and variables are in."""

    @pytest.mark.one_in(4)
    @pytest.mark.parametrize(("rows", "columns"), [(10, 0), (0, 6), (6, 6), (10, 10)])
    def test_decades(self, rows, columns):
        network = random_network(300, 60, 11)
        rng, count = np.random.default_rng(0), len(network.names)
        left, right = (sp.diags_array(10.0 ** rng.uniform(-d, d, count)) for d in (rows, columns))
        plant = network.plant(Bf=None, Bd=None, disturbance_names=None)
        found = obsynth.eliminate_algebraic_states(plant.replace(E=left @ plant.E @ right, A=left @ plant.A @ right))
        assert set(found.dropped) == set(network.idle)
        assert found.plant.state_names == network.dynamic
        units = right.diagonal()[[network.names.index(name) for name in network.dynamic]]
        truth = network.truth()
        np.testing.assert_allclose(units[:, None] * found.plant.A / units, truth, atol=1e-12 * np.max(np.abs(truth)))

    def test_scales_by_all_entries(self):
        rng = np.random.default_rng(1)
        matrix = sp.random_array((60, 60), density=0.1, rng=rng) + sp.eye_array(60)
        rows, columns = (2.0 ** rng.integers(-40, 40, 60) for _ in range(2))
        plain = scales_by_all_entries(sp.csr_array(matrix))
        other = scales_by_all_entries(sp.csr_array(rows[:, None] * matrix.toarray() * columns))
        ratios = np.log2(np.outer(*other) * np.outer(rows, columns) / np.outer(*plain))
        assert np.max(np.abs(ratios)) <= 2.0


class TestMethods:
    def test_a_small_sparse_plant_is_designed_for_as_written(self):
        plant = obsynth.DescriptorSystem(
            sp.diags_array([1.0, 0.0]).tocsr(),
            sp.csr_array([[0.5, 0.2], [0.1, 1.0]]),
            C=np.eye(2),
            Bf=[[1], [0]],
            dt=1.0,
        )
        ours = obsynth.fault_estimation_filter(plant)
        assert ours.report.passed
        assert isinstance(ours.plant.A, np.ndarray)
        np.testing.assert_array_equal(ours.observer.Az, obsynth.fault_estimation_filter(plant.dense()).observer.Az)

    def test_a_large_one_is_reduced_first(self):
        network = random_network(520, 20, 7)
        design = obsynth.pd_observer(network.plant(Bd=None, disturbance_names=None))
        assert design.report.passed
        assert design.plant.state_names == network.dynamic
        assert set(design.recovery.names) == set(network.names) - set(network.idle)
        assert any(network.idle[0] in note for note in design.notes)

    def test_saved_run_and_recovered(self, tmp_path):
        network = random_network(520, 20, 7)
        plant = network.plant(Bd=None, disturbance_names=None)
        design = obsynth.load(obsynth.pd_observer(plant).save(tmp_path / "large.gains.json"))
        assert design.recovery.by_operator is not None
        assert design.report.passed
        again = obsynth.eliminate_algebraic_states(plant).recovery
        np.testing.assert_array_equal(design.recovery.from_state, again.from_state)
        assert design.recovery.flags() == again.flags()
        rng = np.random.default_rng(0)
        data = pd.DataFrame(0.01 * rng.normal(size=(5, plant.ny)), columns=list(plant.output_names))
        data.insert(0, "time", 0.01 * np.arange(5))
        assert not obsynth.run_on_data(design, data).recovered
        bus = "v Bus 3"
        found = obsynth.run_on_data(design, data, recovered=[bus])
        assert set(found.recovered) == {bus}
        states = found.table[[f"xhat[{name}]" for name in design.plant.state_names]].to_numpy()
        faults = found.table[[f"fhat[{name}]" for name in design.plant.fault_names]].to_numpy()
        row = design.recovery.names.index(bus)
        expected = states @ design.recovery.from_state[row] + faults @ design.recovery.from_fault[row]
        np.testing.assert_allclose(found.table[f"xhat[{bus}]"].to_numpy(), expected, rtol=1e-9, atol=1e-12)
        with pytest.raises(obsynth.SpecError, match="nothing"):
            obsynth.run_on_data(design, data, recovered=["nothing"])

    def test_check_says_why_a_large_one_cannot_be_reduced(self):
        network = random_network(520, 20, 8)
        plant = network.plant(C=[*network.outputs, network.idle[0]], Dw=None)
        reports = check(plant)
        assert all(not report.passed for report in reports.values())
        assert all(report.failures[0].name.endswith("index") for report in reports.values())


class TestNumerics:
    def test_overdetermined_and_underdetermined(self):
        pattern = sp.csr_array([[1, 0, 0, 0], [1, 0, 0, 0], [0, 1, 1, 1], [0, 0, 0, 0]])
        found = coarse_structure(pattern)
        assert found.structural_rank == 2
        assert set(found.over_rows) == {0, 1, 3}
        assert set(found.under_columns) == {1, 2, 3}

    def test_blocks(self):
        pattern = sp.csr_array([[1, 1, 0], [1, 1, 0], [0, 1, 1]])
        count, block = blocks_of(pattern, coarse_structure(pattern).row_of_column)
        assert count == 2
        assert block[0] == block[1] != block[2]

    def test_condition_and_errors_of_a_factor(self):
        rng = np.random.default_rng(2)
        matrix = rng.normal(size=(40, 40)) * 10.0 ** rng.uniform(-6, 6, 40)
        factor = SparseFactor(sp.csr_array(matrix))
        right = rng.normal(size=(40, 3))
        solution, error = factor.solve_with_error(right)
        assert error < 1e-15
        np.testing.assert_allclose(matrix @ solution, right, atol=1e-10)
        transposed = factor.solve_transposed(right)
        assert np.all(np.abs(matrix.T @ transposed - right) <= 1e-13 * (np.abs(matrix.T) @ np.abs(transposed)))
        true = np.linalg.cond(factor.matrix.toarray(), 1)
        assert 0.1 * true <= factor.condition <= 1.01 * true

    @pytest.mark.parametrize("exactly", [True, False])
    def test_null_vectors(self, exactly):
        rng = np.random.default_rng(3)
        matrix = rng.normal(size=(12, 12))
        matrix[:, 5] = 2.0 * matrix[:, 7] if exactly else matrix[:, 7] * (1.0 + 1e-15)
        factor = SparseFactor(sp.csr_array(matrix))
        assert factor.singular
        assert set(np.argsort(-factor.null_vectors()[2])[:2]) == {5, 7}


class TestRounding:
    """Entries that are only rounding: by random signs, as by the rows of the inverse."""

    def test_signs_and_rows_of_the_inverse_agree(self, monkeypatch):
        rng = np.random.default_rng(5)
        size = 400
        links = sp.diags_array([rng.uniform(0.2, 0.5, size - 1), rng.uniform(0.2, 0.5, size - 1)], offsets=[-1, 1])
        factor = SparseFactor(sp.csr_array(links + 1.5 * sp.eye_array(size)))
        solution = rng.normal(size=(size, 2)) * 10.0 ** rng.uniform(-20, 0, (size, 2))
        kept = np.abs(solution) > CANCELLATION_TOLERANCE * factor.size_of_terms(solution, np.arange(size))
        assert 0 < kept.sum() < kept.size
        exact_rows, by_rows = [], SparseFactor.size_of_terms
        monkeypatch.setattr(
            SparseFactor, "size_of_terms", lambda self, x, rows: exact_rows.append(len(rows)) or by_rows(self, x, rows)
        )
        np.testing.assert_array_equal(without_rounding(factor, solution), np.where(kept, solution, 0.0))
        assert sum(exact_rows) < size // 2


@pytest.mark.parametrize("kind", FORMATS)
def test_a_part_of_a_sparse_plant_is_replaced(kind):
    rng = np.random.default_rng(0)
    e, a = random_index_one(rng, mass=True, mixed=False)
    plant = obsynth.DescriptorSystem(kind(e), kind(a), C=kind(np.eye(8)[:3]), Bf=kind(np.eye(8)[:, :1]))
    changed = plant.replace(Bf=np.eye(8)[:, 5:6])
    assert type(changed.A) is type(plant.A)
    np.testing.assert_array_equal(changed.dense().A, a)
    again = plant.replace(A=kind(2.0 * a))
    np.testing.assert_array_equal(again.dense().A, 2.0 * a)
    whole = obsynth.eliminate_algebraic_states(again).plant
    expected = obsynth.eliminate_algebraic_states(obsynth.DescriptorSystem(e, 2.0 * a, C=np.eye(8)[:3])).plant
    np.testing.assert_allclose(
        np.sort_complex(np.linalg.eigvals(whole.A)), np.sort_complex(np.linalg.eigvals(expected.A))
    )


@pytest.mark.parametrize("seed", range(40))
def test_the_matching_is_a_largest_one(seed):
    rng = np.random.default_rng([71, seed])
    rows, columns = rng.integers(1, 12, 2)
    matrix = rng.normal(size=(rows, columns)) * (rng.random((rows, columns)) < rng.uniform(0.0, 0.5))
    found = coarse_structure(sp.csr_array(matrix))
    matched = np.flatnonzero(found.row_of_column >= 0)
    assert np.all(matrix[found.row_of_column[matched], matched] != 0.0)
    assert len(set(found.row_of_column[matched])) == len(matched)
    assert len(matched) == (structural_rank(sp.csr_array(matrix)) if matrix.any() else 0)


def test_a_time_constant_that_is_taken_as_zero_is_told():
    plant = random_network(300, 40, 3).plant()
    whole = eliminated_by_sparsity(plant)
    assert not any("Taken as algebraic" in note for note in whole.notes)
    lag = plant.state_names.index("LAG_y TGOV1 1")
    for factor, told in ((1e-6, False), (1e-14, True)):
        e = sp.lil_array(plant.E)
        e[lag, lag] *= factor
        found = eliminated_by_sparsity(plant.replace(E=e.tocsr()))
        assert found.plant.nx == whole.plant.nx - told
        assert any("Taken as algebraic" in note and "'LAG_y TGOV1 1'" in note for note in found.notes) == told


def chain_of_parts(seed: int, states: int = 70) -> obsynth.DescriptorSystem:
    """Return a plant whose parts hardly touch each other, and one way less than the other: its natural units drift."""
    rng, apart = np.random.default_rng(seed), np.subtract.outer(np.arange(states), np.arange(states))
    couplings = np.where(apart < 0, 0.55 ** np.abs(apart), 5e-4 ** np.abs(apart))
    a = couplings * rng.choice([-1.0, 1.0], size=(states, states))
    np.fill_diagonal(a, -2 - np.arange(states) / states)
    c, faults = np.eye(states)[np.sort(rng.permutation(states)[:6])], np.eye(states)[:, rng.permutation(states)[:2]]
    return obsynth.DescriptorSystem(None, a, C=c, Bf=faults)


@pytest.mark.long
@pytest.mark.parametrize("seed", [0, 4])
def test_units_that_drift_along_a_plant_hide_no_fault(seed: int) -> None:
    plant = chain_of_parts(seed)
    rows = np.block([[plant.A, plant.Bf], [plant.C, plant.Df]])
    values = np.linalg.svd(rows, compute_uv=False)
    assert values[-1] > 1e-6 * values[0]
    assert not [found.name for found in pd_observer_conditions(plant) if not found.holds]
    courses = exosystem("step", plant.fault_names, plant.dt)
    assert not [found.name for found in existence_conditions(plant, courses) if not found.holds]
    assert obsynth.pd_observer(plant).report.passed


def test_a_fault_twice_is_refused_in_any_units() -> None:
    plant = chain_of_parts(0)
    twice = plant.replace(Bf=plant.Bf[:, [0, 0]])
    assert [found.name for found in pd_observer_conditions(twice) if not found.holds] == ["rank F"]


def test_filters_of_networks_keep_to_their_identities() -> None:
    """Units by least squares drift apart along a network, and of the reduction only half of the digits were left."""
    network = random_network(400, 80, 3)
    plant = obsynth.discretise(obsynth.eliminate_algebraic_states(network.plant()), 0.02).plant
    found = decouple(plant, without=plant.fault_names[:1])
    still, moving = np.vstack([plant.E, np.zeros((plant.ny, plant.nx))]), np.vstack([plant.A, plant.C])
    e, a = np.vstack([found.E, np.zeros_like(found.C)]), np.vstack([found.A, found.C])
    disturbed = np.hstack([np.vstack([plant.Bd, plant.Dd]), np.vstack([plant.Bf, plant.Df])[:, :1]])
    for left, right in ((found.rows @ moving, a @ found.states), (found.rows @ disturbed, 0.0)):
        size = np.abs(found.rows) @ np.abs(moving if left.shape[1] == plant.nx else disturbed)
        assert np.all(np.abs(left - right) <= 1e-9 * np.max(size, axis=1, keepdims=True))
    assert np.linalg.cond(found.E) < 1e4
    np.testing.assert_allclose(found.rows @ still, e @ found.states, atol=1e-9 * np.max(np.abs(found.rows)))

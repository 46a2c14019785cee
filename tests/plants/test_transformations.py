"""Plants made from plants: elimination, sampling, and faults as states."""

import itertools
import json
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from scipy.linalg import block_diag, expm
from scipy.signal import cont2discrete

import obsynth
from obsynth.analysis.structure import analyse_structure
from obsynth.analysis.zeros import fault_zeros, sampling_zero_warnings
from obsynth.errors import PreconditionError, SpecError
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.transformations.elimination import eliminate_algebraic_states
from obsynth.plants.transformations.fault_states import augment_faults
from obsynth.plants.transformations.sampling import discretise

SMIB = Path(__file__).parents[2] / "designs" / "smib"


def nonsingular(size, rng):
    left, right = (np.linalg.qr(rng.standard_normal((size, size)))[0] for _ in range(2))
    return left * 5.0 ** rng.uniform(-0.5, 0.5, size) @ right


def smib(**changes):
    E, A = (scipy.io.mmread(SMIB / f"{name}.mtx").toarray() for name in "EA")
    names = json.loads((SMIB / "names.json").read_text(encoding="utf-8"))
    return DescriptorSystem(E, A, state_names=names["differential"] + names["algebraic"], **changes)


def random_plant(rng, *, dt=0.0, explicit=False, dynamic=3, algebraic=2):
    """Return an index-1 plant with every signal everywhere."""
    size = dynamic + algebraic
    E = block_diag(nonsingular(dynamic, rng), np.zeros((algebraic, algebraic)))
    A = rng.standard_normal((size, size))
    A[dynamic:, dynamic:] = nonsingular(algebraic, rng)
    if explicit:
        order, other = rng.permutation(size), rng.permutation(size)
        E, A = E[order][:, other], A[order][:, other]
    else:
        P, Q = nonsingular(size, rng), nonsingular(size, rng)
        E, A = P @ E @ Q, P @ A @ Q
    widths = {"B": 2, "Bf": 2, "Bd": 1, "Bw": 2}
    inputs = {name: rng.standard_normal((size, width)) for name, width in widths.items()}
    outputs = {name.replace("B", "D"): rng.standard_normal((3, width)) for name, width in widths.items()}
    return DescriptorSystem(E, A, C=rng.standard_normal((3, size)), dt=dt, **inputs, **outputs)


def transfer(plant, s):
    """Return the transfer matrix from [u; f; d; w] to y at the point ``s``."""
    inputs, direct = np.hstack([plant.B, plant.Bf, plant.Bd, plant.Bw]), [plant.D, plant.Df, plant.Dd, plant.Dw]
    return plant.C @ np.linalg.solve(s * plant.E - plant.A, inputs) + np.hstack(direct)


def states(plant, s, signals):
    inputs = np.hstack([plant.B, plant.Bf, plant.Bd, plant.Bw])
    return np.linalg.solve(s * plant.E - plant.A, inputs @ signals)


class TestElimination:
    @pytest.mark.one_in(4)
    @pytest.mark.parametrize("explicit", [True, False])
    @pytest.mark.parametrize("dt", [0.0, 0.1])
    @pytest.mark.parametrize("seed", range(8))
    def test_transfer_and_states_are_kept(self, seed, dt, explicit):
        rng = np.random.default_rng(seed)
        plant = random_plant(rng, dt=dt, explicit=explicit)
        before = plant.A.copy()
        result = eliminate_algebraic_states(plant)
        new = result.plant
        np.testing.assert_array_equal(new.E, np.eye(3))
        np.testing.assert_array_equal(plant.A, before)
        assert new.dt == dt
        assert result.source is plant
        recovery = result.recovery
        back = np.hstack([recovery.from_input, recovery.from_fault, recovery.from_disturbance, recovery.from_noise])
        for point in (0.3 + 1.1j, -2.0, 5j):
            np.testing.assert_allclose(transfer(new, point), transfer(plant, point), rtol=1e-9, atol=1e-9)
            signals = rng.standard_normal(7)
            recovered = recovery.from_state @ states(new, point, signals) + back @ signals
            np.testing.assert_allclose(recovered, states(plant, point, signals), rtol=1e-9, atol=1e-9)
        if explicit:
            dynamic = [name for name, used in zip(plant.state_names, plant.E.any(axis=0), strict=True) if used]
            assert list(new.state_names) == dynamic
        else:
            assert new.state_names == ("xi 1", "xi 2", "xi 3")

    def test_explicit_columns_keep_their_names_when_the_equations_are_mixed(self):
        rng = np.random.default_rng(0)
        plant = random_plant(rng, explicit=True)
        mixing = nonsingular(5, rng)
        mixed = plant.replace(
            E=mixing @ plant.E, A=mixing @ plant.A, B=mixing @ plant.B, Bf=mixing @ plant.Bf, Bd=mixing @ plant.Bd,
            Bw=mixing @ plant.Bw,
        )  # fmt: skip
        one, two = eliminate_algebraic_states(plant), eliminate_algebraic_states(mixed)
        assert one.plant.state_names == two.plant.state_names
        for name in ("A", "B", "C", "D", "Df"):
            np.testing.assert_allclose(getattr(one.plant, name), getattr(two.plant, name), rtol=1e-8, atol=1e-9)

    def test_nonsingular_E_is_inverted(self):
        E, A = np.array([[2.0, 0.0], [0.0, 4.0]]), np.array([[1.0, 2.0], [3.0, 4.0]])
        result = eliminate_algebraic_states(DescriptorSystem(E, A, C=["x1"]))
        np.testing.assert_array_equal(result.plant.A, [[0.5, 1.0], [0.75, 1.0]])
        assert result.recovery.flags() == ("exact", "exact")
        np.testing.assert_array_equal(result.recovery.from_state, np.eye(2))

    def test_state_space_plant_is_returned_unchanged(self):
        plant = DescriptorSystem(None, [[0.5]])
        assert eliminate_algebraic_states(plant).plant is plant

    def test_flags(self):
        # states: x dynamic; p = x; q = x + f; r = q + d
        E = np.diag([1.0, 0, 0, 0])
        A = [[-1.0, 0, 0, 0], [1, -1, 0, 0], [1, 0, -1, 0], [0, 0, 1, -1]]
        plant = DescriptorSystem(
            E, A, C=["q"], Bf=[[0], [0], [1], [0]], Bd=[[0], [0], [0], [1]], state_names=list("xpqr"),
            units={"x": "m", "q": "m"}, operating_point={"p": 3.0, "x": 2.0},
        )  # fmt: skip
        result = eliminate_algebraic_states(plant)
        assert result.recovery.flags() == ("exact", "exact", "needs the fault estimate", "biased by the disturbance")
        assert result.plant.state_names == ("x",)
        assert result.plant.units == {"x": "m", "q": "m"}  # q is still an output
        assert result.plant.operating_point == {"x": 2.0}
        np.testing.assert_array_equal(result.plant.Df, [[1.0]])
        np.testing.assert_array_equal(result.plant.Dd, [[0.0]])
        assert not result.recovery.from_fault.flags.writeable

    def test_rounding_does_not_flag_states(self):
        rng = np.random.default_rng(5)
        # the fault enters two equations so that it cancels in the first algebraic state
        coupling = nonsingular(3, rng)
        E = block_diag([[1.0]], np.zeros((3, 3)))
        A = block_diag([[-1.0]], coupling)
        Bf = np.concatenate([[0.0], coupling @ [0.0, 0.3, 0.7]])[:, None]
        result = eliminate_algebraic_states(DescriptorSystem(E, A, C=["x1"], Bf=Bf))
        assert result.recovery.flags() == ("exact", "exact", *["needs the fault estimate"] * 2)

    @pytest.mark.parametrize(
        ("E", "A", "condition"),
        [
            (np.diag([1.0, 0.0]), np.diag([1.0, 0.0]), "regularity"),
            (np.zeros((2, 2)), np.eye(2), "dynamic states"),
        ],
    )
    def test_refusals(self, E, A, condition):
        with pytest.raises(PreconditionError) as caught:
            eliminate_algebraic_states(DescriptorSystem(E, A))
        assert caught.value.condition == condition

    def test_an_output_that_needs_a_derivative(self):
        E = block_diag(np.eye(2, k=1), [[1.0]])
        plant = DescriptorSystem(E, np.diag([1.0, 1, -1]), [[0.0], [1], [1]], C=[[1, 0, 0], [0, 1, 1]])
        with pytest.raises(PreconditionError, match="output 'y1' needs the derivative of 'u1'") as caught:
            eliminate_algebraic_states(plant)
        assert caught.value.condition == "index"
        found = eliminate_algebraic_states(plant.replace(C=[[0, 1, 0], [0, 1, 1]]))
        np.testing.assert_array_equal(found.plant.D, [[-1], [-1]])
        np.testing.assert_array_equal(found.plant.C, [[0], [1]])
        assert found.dropped == ("x1",)

    def test_smib(self):
        plant = smib(C=["a Bus 1"], Bf=["tm GENCLS 1"])
        result = eliminate_algebraic_states(plant)
        names = ("delta GENCLS 1", "delta GENCLS 2", "omega GENCLS 1", "omega GENCLS 2")
        assert result.plant.state_names == names
        expected = analyse_structure(plant).finite_eigenvalues
        np.testing.assert_allclose(
            np.sort_complex(np.linalg.eigvals(result.plant.A)), np.sort_complex(expected), atol=1e-11
        )
        needing = [n for n, flag in zip(plant.state_names, result.recovery.flags(), strict=True) if flag != "exact"]
        assert needing == ["tm GENCLS 1"]


class TestSampling:
    @pytest.mark.parametrize("seed", range(8))
    def test_zero_order_hold_agrees_with_scipy(self, seed):
        rng = np.random.default_rng(seed)
        plant = random_plant(rng, explicit=True).replace(Bw=None, Dw=None, noise_names=None)
        smooth = eliminate_algebraic_states(plant).plant
        result = discretise(plant, 0.05)
        inputs = np.hstack([smooth.B, smooth.Bf, smooth.Bd])
        A, B, *_ = cont2discrete((smooth.A, inputs, smooth.C, np.zeros((3, 5))), 0.05)
        np.testing.assert_allclose(result.plant.A, A, rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(
            np.hstack([result.plant.B, result.plant.Bf, result.plant.Bd]), B, rtol=1e-10, atol=1e-12
        )
        np.testing.assert_array_equal(result.plant.Df, smooth.Df)
        assert result.plant.dt == 0.05
        np.testing.assert_array_equal(result.plant.E, np.eye(3))

    def test_constant_fault_agrees_with_a_fine_integration(self):
        plant = smib(C=["a Bus 1"], Bf=["tm GENCLS 1"])
        smooth, sampled = eliminate_algebraic_states(plant).plant, discretise(plant, 0.02).plant
        steps = 2000
        x, h = np.array([0.01, -0.02, 1e-4, 0.0]), 0.02 / steps
        expected = sampled.A @ x + sampled.Bf[:, 0] * 0.3

        def slope(x):
            return smooth.A @ x + smooth.Bf[:, 0] * 0.3

        for _ in range(steps):
            k1 = slope(x)
            k2 = slope(x + h / 2 * k1)
            k3 = slope(x + h / 2 * k2)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + slope(x + h * k3))
        np.testing.assert_allclose(expected, x, rtol=1e-11, atol=1e-15)

    def test_bad_units_do_not_spoil_the_exponential(self):
        rng = np.random.default_rng(0)
        A, B = rng.standard_normal((3, 3)), rng.standard_normal((3, 1))
        units = np.array([1e-8, 1.0, 1e8])
        good = discretise(DescriptorSystem(None, A, B), 0.1).plant
        bad = discretise(DescriptorSystem(None, A * units / units[:, None], 1e9 * B / units[:, None]), 0.1).plant
        np.testing.assert_allclose(bad.A / units * units[:, None], good.A, rtol=1e-12)
        np.testing.assert_allclose(bad.B * units[:, None], 1e9 * good.B, rtol=1e-12)

    def test_process_noise_of_a_first_order_lag(self):
        plant = DescriptorSystem(None, [[-2.0]], C=[[1.0]], Bw=[[3.0, 0.0]], Dw=[[0.0, 0.1]], noise_names=["q", "r"])
        result = discretise(plant, 0.4)
        assert result.plant.noise_names == ("process noise 1", "r")
        variance = 9.0 / 4.0 * (1 - np.exp(-4.0 * 0.4))
        assert result.plant.Bw[0, 0] ** 2 == pytest.approx(variance, rel=1e-13)
        np.testing.assert_array_equal(result.plant.Dw, [[0.0, 0.1]])
        np.testing.assert_array_equal(result.recovery.noise_kept, [[0.0, 0.0], [0.0, 1.0]])

    def test_process_noise_of_a_double_integrator(self):
        plant = DescriptorSystem(None, [[0.0, 1.0], [0.0, 0.0]], C=["x1"], Bw=[[0.0], [1.0]])
        for h in (0.3, 1e-7):
            factor = discretise(plant, h).plant.Bw
            np.testing.assert_allclose(factor @ factor.T, [[h**3 / 3, h**2 / 2], [h**2 / 2, h]], rtol=1e-12)

    @pytest.mark.long
    @pytest.mark.parametrize("sample_time", [0.01, 5.0])
    def test_process_noise_of_a_stiff_plant(self, sample_time):
        """Where exp(-A h) overflows, the covariance is still the stationary one of the fast state."""
        A, Bw = np.array([[-1e4, 1.0], [0.0, -1.0]]), np.array([[1.0], [0.5]])
        plant = DescriptorSystem(None, A, Bw=Bw)
        factor = discretise(plant, sample_time).plant.Bw
        nodes, weights = np.polynomial.legendre.leggauss(60)
        expected = np.zeros((2, 2))
        edges = np.concatenate([[0.0], np.geomspace(1e-6, sample_time, 60)])
        for start, end in itertools.pairwise(edges):
            for node, weight in zip(nodes, weights, strict=True):
                column = expm(A * ((end - start) * (node + 1) / 2 + start)) @ Bw
                expected += weight * (end - start) / 2 * column @ column.T
        np.testing.assert_allclose(factor @ factor.T, expected, rtol=1e-9)

    def test_noise_on_a_direct_path_is_refused(self):
        E, A = np.diag([1.0, 0.0]), [[-1.0, 1.0], [1.0, -1.0]]
        plant = DescriptorSystem(E, A, C=["x2"], Bw=[[0.0], [1.0]], noise_names=["load"])
        with pytest.raises(PreconditionError, match="load") as caught:
            discretise(plant, 0.1)
        assert caught.value.signals == ("load",)
        assert discretise(plant.replace(C=[[1.0, 0.0]]), 0.1).plant.nw == 1

    def test_recovery_reaches_the_original_states(self):
        plant = random_plant(np.random.default_rng(4), explicit=True).replace(Bw=None, Dw=None, noise_names=None)
        first, whole = eliminate_algebraic_states(plant), discretise(plant, 0.1)
        assert whole.source is plant
        assert whole.recovery.names == plant.state_names
        np.testing.assert_array_equal(whole.recovery.from_state, first.recovery.from_state)
        np.testing.assert_array_equal(whole.recovery.from_fault, first.recovery.from_fault)
        assert "eliminated" in whole.description
        assert "sampled" in whole.description

    @pytest.mark.parametrize("sample_time", [0.0, -1.0, np.nan, np.inf])
    def test_bad_sample_times(self, sample_time):
        with pytest.raises(SpecError):
            discretise(DescriptorSystem(None, [[1.0]]), sample_time)

    def test_sampled_plants_are_refused(self):
        with pytest.raises(SpecError, match="already sampled"):
            discretise(DescriptorSystem(None, [[1.0]], dt=0.1), 0.1)

    def test_smib_has_a_slow_sampling_zero(self):
        sampled = discretise(smib(C=["a Bus 1"], Bf=["tm GENCLS 1"]), 0.02).plant
        zeros, outside = fault_zeros(sampled)
        assert outside == ()
        assert min(zero.value.real for zero in zeros) == pytest.approx(-0.99884, abs=1e-5)
        warnings = sampling_zero_warnings(sampled)
        assert any("17.2 s" in text for text in warnings)
        assert sampling_zero_warnings(smib(C=["a Bus 1"], Bf=["tm GENCLS 1"])) == ()

    def test_warning_gives_the_decay_time(self):
        # y = (z - 0.99) / (z (z - 0.5)) f
        plant = DescriptorSystem(None, [[0.5, 1.0], [0.0, 0.0]], C=[[1.0, 0.0]], Bf=[[1.0], [-0.99]], dt=0.1)
        (text,) = sampling_zero_warnings(plant)
        assert "0.99" in text
        assert f"{-0.1 / np.log(0.99):.3g} s" in text
        assert sampling_zero_warnings(plant.replace(Bf=[[1.0], [-0.97]])) == ()
        assert sampling_zero_warnings(plant.replace(Bf=[[1.0], [-1.0]])) == ()


class TestFaultsAsStates:
    PLANT = DescriptorSystem(
        np.diag([1.0, 0.0]), [[0.5, 1.0], [1.0, -1.0]], C=[[1, 0], [0, 1], [1, 1]], Bf=[[1, 0, 0], [0, 0, 0]],
        Df=[[0, 1, 0], [0, 0, 0], [0, 0, 2]], fault_names=["leak", "gauge", "other gauge"], dt=1.0,
    )  # fmt: skip

    def test_only_faults_on_outputs_become_states(self):
        result = augment_faults(self.PLANT, ["leak", "gauge"])
        new = result.plant
        assert new.state_names == ("x1", "x2", "fault:gauge")
        np.testing.assert_array_equal(new.E, np.diag([1.0, 0, 0]))
        np.testing.assert_array_equal(new.A, [[0.5, 1, 0], [1, -1, 0], [0, 0, -1]])
        np.testing.assert_array_equal(new.Bf, [[1, 0, 0], [0, 0, 0], [0, 1, 0]])
        np.testing.assert_array_equal(new.C, [[1, 0, 1], [0, 1, 0], [1, 1, 0]])
        np.testing.assert_array_equal(new.Df, [[0, 0, 0], [0, 0, 0], [0, 0, 2]])
        np.testing.assert_array_equal(result.recovery.from_state, np.eye(2, 3))
        assert result.recovery.flags() == ("exact", "exact")
        for point in (0.3j, 2.0):
            np.testing.assert_allclose(transfer(new, point), transfer(self.PLANT, point), atol=1e-14)

    def test_nothing_to_do(self):
        result = augment_faults(self.PLANT, ["leak"])
        assert result.plant.state_names == self.PLANT.state_names
        assert result.description == ""

    def test_too_many_faults_are_named(self):
        C = [[1.0, 0.0], [0.0, 1.0]]
        plant = self.PLANT.replace(C=C, D=None, Dd=None, Dw=None, Df=[[0, 0, 1], [0, 1, 0]], output_names=None)
        with pytest.raises(PreconditionError) as caught:
            augment_faults(plant, ["gauge"])
        assert caught.value.condition == "rank [E 0; 0 0; C Df]"
        assert caught.value.signals == ("gauge",)
        with pytest.raises(PreconditionError) as caught:
            augment_faults(plant, ["gauge", "other gauge"])
        assert caught.value.signals == ("gauge",)
        assert augment_faults(plant, ["other gauge"]).plant.nx == 3

    def test_invisible_states_are_named(self):
        plant = DescriptorSystem(np.diag([1.0, 0.0]), np.eye(2), C=[[1, 0], [0, 0]], Df=[[0], [1]], dt=1.0)
        with pytest.raises(PreconditionError) as caught:
            augment_faults(plant, ["f1"])
        assert caught.value.signals == ("x2",)

    def test_unknown_fault(self):
        with pytest.raises(SpecError, match="gauge"):
            augment_faults(self.PLANT, ["gouge"])

    def test_elimination_after_augmentation_gives_the_plant_back(self):
        augmented = augment_faults(self.PLANT, ["gauge", "other gauge"])
        whole = augmented.then(eliminate_algebraic_states(augmented.plant))
        direct = eliminate_algebraic_states(self.PLANT)
        for name in ("A", "Bf", "C", "Df"):
            np.testing.assert_allclose(getattr(whole.plant, name), getattr(direct.plant, name), atol=1e-14)
        assert whole.recovery.flags() == direct.recovery.flags()


@pytest.mark.long
def test_a_transformation_stands_for_its_plant_everywhere():
    written = obsynth.DescriptorSystem(
        E=[[1, 0, 0], [0, 1, 0], [0, 0, 0]], A=[[-1, 0.2, 0.1], [0.1, -2, 1], [0.5, 0.5, -1]], B=[[1], [0], [0]],
        C=["a", "b"], Bf=["a"], state_names=["a", "b", "c"], sensor_noise={"a": 0.1, "b": 0.1},
    )  # fmt: skip
    reduced, sampled = obsynth.eliminate_algebraic_states(written), obsynth.discretise(written, 0.1)
    assert obsynth.analyse_structure(sampled).index == 0
    assert obsynth.diagnose(sampled).faults[0].name == "a"
    assert obsynth.check(sampled)["fault-estimation-filter"].passed
    assert obsynth.decouple(sampled).faults == ("a",)
    assert obsynth.eliminate_algebraic_states(sampled).recovery.names == ("a", "b", "c")
    assert obsynth.discretise(reduced, 0.1).recovery.names == ("a", "b", "c")
    assert obsynth.sensor_sets(sampled).sets
    assert obsynth.steady_state_filter(sampled, Q=0.01, R=0.01).rate < 1.0
    assert np.shape(obsynth.simulate(sampled, steps=3).states) == (3, 2)
    assert obsynth.compare(sampled, methods=["ui-pi-observer"], runs=2).methods[0].method == "ui-pi-observer"
    designs = [
        obsynth.design(sampled, "ui-pi-observer"), obsynth.fault_estimation_filter(sampled),
        obsynth.functional_filter(sampled), obsynth.descriptor_kalman(sampled), obsynth.pd_observer(reduced),
    ]  # fmt: skip
    assert [design.recovery.names for design in designs] == [("a", "b", "c")] * 5
    assert obsynth.detection_filter(reduced).fault_sensitivity > 0.0
    with pytest.raises(obsynth.SpecError, match=r"give an obsynth\.DescriptorSystem"):
        obsynth.diagnose("plant.yaml")

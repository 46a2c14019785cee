"""Gains for pairs: repeated poles, fixed modes, regions, rates, prices."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import scipy.linalg

from obsynth import DescriptorSystem, PreconditionError, SolverError, SpecError, ui_pi_observer
from obsynth.methods.engines.kalman_problem import NOISE_PRICE, KalmanProblem, compromise, fastest_halving
from obsynth.methods.engines.region import region_gain
from obsynth.numerics.eigenstructure import MOST_CONDITION, jordan_form, place
from obsynth.numerics.observable_part import observable_split
from obsynth.numerics.placed_noise import PlacedNoise
from obsynth.numerics.regions import NamedRegion
from obsynth.numerics.spectra import decay_rates, spectrum_error

#: The paper's pair: observability indices 4 and 1.
PAIR = np.array([[0, 0, 0, 0, 0], [-2.5, -1.5, -0.5, 1, 0], [0, -2, 0, 1, 0], [0, 0, 0, 0, 1], [0, 0, 0, 0, 0.0]])
OUTPUTS = np.eye(2, 5)


def noisy(f: np.ndarray, c: np.ndarray, dt: float = 0.0) -> KalmanProblem:
    n, outputs = len(f), len(c)
    return KalmanProblem(
        F=f, C=c, B=np.zeros((n, outputs)), D=np.eye(outputs), drive=np.eye(n), background=np.zeros((outputs, 1)),
        estimates=np.eye(1, n, k=n - 2 if n > 1 else 0), dt=dt,
    )  # fmt: skip


class TestPoles:
    @pytest.mark.one_in(4)
    @pytest.mark.parametrize("objective", ["conditioning", "gain"])
    @pytest.mark.parametrize(
        "poles",
        [
            [-2, -3, -4, -5, -6],
            [-4] * 5,
            [-4, -4, -5, -5, -6],
            [-2 + 1j, -2 - 1j, -2 + 1j, -2 - 1j, -3],
            [-1, -1.0001, -1.0002, -3 + 4j, -3 - 4j],
        ],
    )
    def test_any_multiplicity(self, poles: list[complex], objective: str) -> None:
        wanted = [complex(pole) for pole in poles]
        gain, _ = place(PAIR, OUTPUTS, wanted, objective=objective)
        assert spectrum_error(PAIR - gain @ OUTPUTS, wanted, 0.0) < 1e-6
        # By the characteristic polynomial, which a multiple pole does not make ill-conditioned.
        np.testing.assert_allclose(np.poly(PAIR - gain @ OUTPUTS), np.real(np.poly(wanted)), rtol=1e-6)

    @pytest.mark.long
    def test_the_objectives_differ_as_promised(self) -> None:
        wanted = [complex(pole) for pole in (-2, -3, -4, -5, -6)]
        best, least = (place(PAIR, OUTPUTS, wanted, objective=name) for name in ("conditioning", "gain"))
        assert best[1] < least[1]
        assert np.linalg.norm(least[0]) < 0.1 * np.linalg.norm(best[0])

    def test_poles_that_f_has_already(self) -> None:
        f = np.diag([-1.0, -2.0, -3.0])
        c = np.ones((1, 3))
        gain, _ = place(f, c, [-1 + 0j, -2 + 0j, -5 + 0j])
        np.testing.assert_allclose(np.sort(np.linalg.eigvals(f - gain @ c).real), [-5, -2, -1], rtol=1e-8)

    def test_an_unobservable_pair_is_no_garbage(self) -> None:
        f, c = np.diag([-1.0, -2.0, -3.0]), np.array([[1.0, 1.0, 0.0]])
        with pytest.raises(SolverError):
            place(f, c, [-4 + 0j, -5 + 0j, -6 + 0j])

    def test_jordan_form_is_cyclic_with_the_given_spectrum(self) -> None:
        poles = [-1, -1, -1, -2 + 1j, -2 - 1j, -2 + 1j, -2 - 1j]
        matrix = jordan_form([complex(pole) for pole in poles])
        np.testing.assert_allclose(np.poly(matrix), np.real(np.poly(poles)), atol=1e-9)
        for value in (-1, -2 + 1j):
            assert np.linalg.matrix_rank(matrix - value * np.eye(7)) == 6

    def test_no_states(self) -> None:
        assert place(np.zeros((0, 0)), np.zeros((2, 0)), [])[0].shape == (0, 2)


class TestSplit:
    def hidden(self, modes: list[complex], seed: int) -> tuple[np.ndarray, np.ndarray]:
        """Return a random pair with these hidden modes, mixed by an orthogonal matrix."""
        rng = np.random.default_rng(seed)
        block, count = jordan_form(modes), len(modes)
        f = np.zeros((4 + count, 4 + count))
        f[:4, :4], f[4:, :4], f[4:, 4:] = rng.standard_normal((4, 4)), rng.standard_normal((count, 4)), block
        c = np.hstack([rng.standard_normal((2, 4)), np.zeros((2, count))])
        turn = np.linalg.qr(rng.standard_normal((4 + count, 4 + count)))[0]
        return turn @ f @ turn.T, c @ turn.T

    @pytest.mark.one_in(4)
    @pytest.mark.parametrize("modes", [[-1], [-1, -2], [-1, -1], [-1 + 2j, -1 - 2j], [-0.5, -1 + 2j, -1 - 2j]])
    def test_hidden_modes_are_found_and_the_rest_can_be_placed(
        self, modes: list[complex], share: Callable[..., Any]
    ) -> None:
        for seed in share(range(5), 3):
            f, c = self.hidden([complex(mode) for mode in modes], seed)
            split = observable_split(f, c, np.array(modes, dtype=complex), dt=0.0)
            assert split.order == 4
            np.testing.assert_allclose(np.poly(split.fixed_modes).real, np.real(np.poly(modes)), rtol=1e-6)
            gain, _ = place(split.F, split.C, [-3 + 0j, -4 + 0j, -5 + 0j, -6 + 0j])
            closed = f - split.lift(gain) @ c
            assert spectrum_error(closed, [-3, -4, -5, -6, *modes], 0.0) < 1e-4

    def test_a_double_mode_that_rounding_has_split_into_a_pair(self) -> None:
        f = np.diag([-2.0, -3.0, -1.0, -1.0, -1.0])
        c = np.array([[1.0, 1.0, 0.0, 0.0, 0.0]])
        split = observable_split(f, c, np.array([-1 + 1e-15j, -1 - 1e-15j, -1.0]), dt=0.0)
        assert split.order == 2

    @pytest.mark.parametrize(("modes", "dt"), [((-1.0, -2.0), 0.0), ((0.3, -0.5), 1.0)])
    def test_a_stable_mode_that_the_pair_shows_stays_in_it(self, modes: tuple[float, float], dt: float) -> None:
        f, c = np.diag(modes), np.array([[1e-7, 1.0]])
        split = observable_split(f, c, np.array([modes[0] + 0j]), dt=dt)
        assert split.order == 2
        assert not split.fixed_modes.size
        np.testing.assert_allclose(np.sort(np.linalg.eigvals(split.F).real), np.sort(modes), rtol=1e-12)

    @pytest.mark.parametrize(("mode", "dt"), [(0.5, 0.0), (-1.5, 1.0), (0.0, 0.0)])
    def test_an_unstable_mode_that_the_pair_shows_is_refused(self, mode: float, dt: float) -> None:
        f, c = np.diag([mode, -0.2]), np.array([[1.0, 1.0]])
        with pytest.raises(PreconditionError, match="rescale the plant"):
            observable_split(f, c, np.array([mode + 0j]), dt=dt)


class TestKalman:
    @pytest.mark.parametrize("decay", [0.0, 0.5, 2.0])
    def test_every_pole_decays_as_asked(self, decay: float) -> None:
        problem = noisy(PAIR, OUTPUTS)
        gain = problem.gain(decay)
        assert gain is not None
        assert np.max(np.linalg.eigvals(PAIR - gain @ OUTPUTS).real) < -decay
        sampled = noisy(np.eye(5) + 0.1 * PAIR, OUTPUTS, dt=0.1)
        gain = sampled.gain(decay)
        assert gain is not None
        assert np.max(np.abs(np.linalg.eigvals(sampled.F - gain @ OUTPUTS))) < np.exp(-0.1 * decay)

    def test_without_a_rate_it_is_the_kalman_filter(self) -> None:
        from scipy.linalg import solve_continuous_are

        x = solve_continuous_are(PAIR.T, OUTPUTS.T, np.eye(5), np.eye(2))
        gain = noisy(PAIR, OUTPUTS).gain(0.0)
        assert gain is not None
        np.testing.assert_allclose(gain, x @ OUTPUTS.T, rtol=1e-8, atol=1e-10)

    def test_the_compromise_pays_its_price_and_no_more(self) -> None:
        problem = noisy(PAIR, OUTPUTS)
        found = compromise(problem, 10.0)
        assert found is not None
        assert 0.5 * NOISE_PRICE < found[2] <= NOISE_PRICE
        easy = compromise(problem, 0.1)
        assert easy is not None
        assert easy[1] == 0.1

    @pytest.mark.parametrize("like", [None, 1.0, 0.3, 1e-4])
    @pytest.mark.parametrize("enough", range(17))
    def test_many_states_take_few_halvings(self, enough: int, like: float | None) -> None:
        """The fastest of 16 halvings that is cheap enough, or none, wherever the search begins; and the highest rate
        is not solved by QZ where it is too noisy."""
        tried: list[float] = []

        def attempt(decay: float, *, only_doubled: bool = False) -> tuple[np.ndarray, float, float] | None:
            tried.append(decay)
            return (np.zeros((0, 0)), decay, 1.0) if decay <= 0.7 * 2.0**-enough and not only_doubled else None

        found = fastest_halving(attempt, 0.7, 16, one_by_one=False, like=like)
        reached = None if found is None else found[1]
        assert reached == (None if enough == 16 else 0.7 * 2.0**-enough)
        if like is None and enough < 16:
            assert len(tried) <= 6
        assert len(tried[1:]) == len({*tried[1:]})

    def test_one_rate_that_is_cheap_enough_is_found(self) -> None:
        def attempt(decay: float, **_: bool) -> tuple[np.ndarray, float, float] | None:
            return (np.zeros((0, 0)), decay, 1.0) if decay == 0.125 else None

        found = fastest_halving(attempt, 1.0, 16, one_by_one=False, like=None)
        assert found is not None
        assert found[1] == 0.125

    def test_correlated_noise(self) -> None:
        """Process noise that the measurement carries: the gain that removes it is part of the filter."""
        problem = KalmanProblem(
            F=np.array([[0.5]]), C=np.array([[1.0]]), B=np.array([[2.0]]), D=np.array([[1.0]]),
            drive=1e-6 * np.eye(1), background=1e-6 * np.eye(1), estimates=np.eye(1), dt=1.0,
        )  # fmt: skip
        # e+ = 0.5 e + 2 w - K (e + w): K = 2 removes w and leaves e+ = -1.5 e; the optimum mirrors that pole.
        gain = problem.gain(0.0)
        assert gain is not None
        closed = 0.5 - gain[0, 0]
        assert closed == pytest.approx(-1.0 / 1.5, abs=1e-4)


def test_without_an_output_no_pole_is_placed() -> None:
    with pytest.raises(SolverError, match="no gain moves"):
        place(np.eye(2), np.zeros((0, 2)), [-1.0, -2.0])


class TestRegion:
    @pytest.mark.one_in(4)
    @pytest.mark.parametrize(
        "region",
        [
            NamedRegion(decay=1.0),
            NamedRegion(radius=6.0),
            NamedRegion(decay=1.5, radius=8.0),
            NamedRegion(1.0, 10.0, 0.8),
        ],
    )
    def test_all_poles_are_inside(self, region: NamedRegion) -> None:
        gain, record = region_gain(noisy(PAIR, OUTPUTS), region, solver="CLARABEL")
        poles = np.linalg.eigvals(PAIR - gain @ OUTPUTS)
        assert np.all(poles.real < -region.decay)
        if region.radius is not None:
            assert np.all(np.abs(poles) <= region.radius)
        if region.damping is not None:
            assert np.all(-poles.real / np.abs(poles) >= region.damping)
        assert record["solver"] == "CLARABEL"

    def test_discrete(self) -> None:
        problem = noisy(np.eye(5) + 0.1 * PAIR, OUTPUTS, dt=0.1)
        gain, _ = region_gain(problem, NamedRegion(decay=1.0), solver="CLARABEL")
        assert np.max(np.abs(np.linalg.eigvals(problem.F - gain @ OUTPUTS))) < np.exp(-0.1)

    def test_large_pairs_move_only_what_lies_outside(self) -> None:
        rng = np.random.default_rng(3)
        f = rng.standard_normal((30, 30))
        problem = noisy(f, rng.standard_normal((4, 30)))
        plain = problem.gain(0.5 * 1.001)
        assert plain is not None
        before = np.linalg.eigvals(f - plain @ problem.C)
        ratios = np.sort(-before.real / np.abs(before))
        # Between the four least damped poles and the others.
        damping = float(np.mean(ratios[3:5]))
        region = NamedRegion(decay=0.5, damping=damping)
        assert ratios[4] > 1.01 * damping > 1.02 * ratios[3]
        gain, record = region_gain(problem, region, solver="CLARABEL")
        closed = f - gain @ problem.C
        after, left, right = scipy.linalg.eig(closed, left=True, right=True)
        assert np.all(-after.real >= damping * np.abs(after))
        assert np.max(after.real) < -0.5
        kept = before[-before.real > damping * np.abs(before)]
        distances = np.abs(after[:, None] - kept)
        # Entries rounded by eps move a pole by eps times the norm and the pole's condition number, 6e6 at most here.
        conditions = 1.0 / np.abs(np.sum(left.conj() * right, axis=0))
        rounding = np.finfo(np.float64).eps * np.linalg.norm(closed, 2) * conditions[np.argmin(distances, axis=0)]
        assert np.max(rounding) < 1e-5
        assert np.all(np.min(distances, axis=0) < rounding)
        assert record["solver"] == "CLARABEL"
        assert region_gain(problem, NamedRegion(decay=0.5), solver="CLARABEL")[1] == {}

    def test_bad_regions(self) -> None:
        for data in ({"decay": -1.0}, {"radius": 0.0}, {"damping": 1.0}, {"decay": True}, {"side": 1.0}, {}):
            with pytest.raises(SpecError):
                NamedRegion.of(data, 0.0)


class TestDesigns:
    PLANT = DescriptorSystem(
        None, [[-2.0, 1, 0], [0, 0.5, 0], [1, 0, -1]], C=[[1, 0, 0], [0, 1, 0]], Bf=[[1.0], [0], [0]],
        Bd=[[0.0], [1], [0]], fault_names=["leak"],
    )  # fmt: skip

    @pytest.mark.long
    def test_every_way_to_choose_gains_passes_and_keeps_the_fixed_mode(self) -> None:
        for options in (
            {}, {"poles": [-3, -3, -3]}, {"decay": 2.0}, {"region": {"decay": 1.0, "radius": 20.0}},
            {"noise": {"measurement": 0.1, "fault": 5.0}}, {"joint": True},
            {"poles": [[-3.0, 1.0], [-3.0, -1.0], -2.0], "objective": "gain"},
        ):  # fmt: skip
            design = ui_pi_observer(self.PLANT, **options)
            assert design.report.passed, options
            poles = np.linalg.eigvals(design.observer.Az)
            assert np.min(np.abs(poles + 1.0)) < 1e-9, options
            assert any("1 of 4 poles are fixed" in note and "-1" in note for note in design.notes)
            if "decay" in options:
                movable = np.sort(decay_rates(poles, 0.0))
                assert movable[0] == pytest.approx(1.0)
                assert movable[1] > options["decay"]
                assert "slower than asked" in " ".join(design.notes)

    def test_units_change_nothing(self) -> None:
        """Time in milliseconds: the default is a thousand times as fast."""
        fast = self.PLANT.replace(A=1e3 * self.PLANT.A, Bf=1e3 * self.PLANT.Bf, Bd=1e3 * self.PLANT.Bd)
        slow, quick = (ui_pi_observer(plant).certificate.claims["decay"] for plant in (self.PLANT, fast))
        assert quick == pytest.approx(1e3 * slow, rel=1e-3)

    def test_saved_and_verified_without_a_solver(self, tmp_path) -> None:
        from obsynth import load, verify

        design = ui_pi_observer(self.PLANT, fault_model={"leak": {"sinusoid": 2.0}})
        again = load(design.save(tmp_path / "gains.json"))
        assert verify(again).passed
        np.testing.assert_array_equal(again.observer.Az, design.observer.Az)
        assert again.options["fault_model_in_words"] == {"leak": "sinusoid of 2 rad/s"}


@pytest.mark.one_in(2)
@pytest.mark.parametrize("dt", [0.0, 0.1])
def test_what_poles_leave_free_is_spent_on_noise(dt: float) -> None:
    """The same poles, and less of the noise in the estimate, which is summed sample by sample."""
    rng = np.random.default_rng(3)
    f = rng.standard_normal((5, 5)) - 2.0 * np.eye(5)
    f = scipy.linalg.expm(dt * f) if dt else f
    c, b, read = rng.standard_normal((3, 5)), np.zeros((5, 3)), rng.standard_normal((1, 5))
    d = np.diag([0.01, 0.1, 1.0])
    rates = np.linspace(3.0, 5.0, 5)
    poles = np.exp(-rates * dt) if dt else -rates
    noise = PlacedNoise(f, c, b, d, read, dt)

    def summed(gain: np.ndarray) -> float:
        step = dt or 1e-3
        ahead = f - gain @ c if dt else scipy.linalg.expm(step * (f - gain @ c))
        driven, total = gain @ d, 0.0
        for _ in range(int(20.0 / step)):
            total += float(np.sum((read @ driven) ** 2)) * (1.0 if dt else step)
            driven = ahead @ driven
        return total

    (plain, _), (quiet, _) = place(f, c, poles, dt=dt), place(f, c, poles, dt=dt, noise=noise)
    np.testing.assert_allclose(np.sort(np.linalg.eigvals(f - quiet @ c).real), np.sort(poles), rtol=1e-6)
    assert summed(quiet) < 0.9 * summed(plain)
    assert noise.value_and_slope(quiet)[0] == pytest.approx(summed(quiet), rel=1e-2)
    direction = rng.standard_normal(quiet.shape)
    after, before = (noise.value_and_slope(quiet + change * direction)[0] for change in (1e-6, -1e-6))
    slope = noise.value_and_slope(quiet)[1]
    assert np.sum(slope * direction) == pytest.approx((after - before) / 2e-6, rel=1e-5)


@pytest.mark.parametrize("seed", [3, 4])
def test_less_noise_costs_at_most_a_stated_share_of_the_condition(seed: int) -> None:
    rng = np.random.default_rng([11, seed])
    f, c, b, read = (rng.standard_normal(shape) for shape in ((6, 6), (2, 6), (6, 1), (1, 6)))
    f, b, d = f - 2.0 * np.eye(6), np.hstack([1e-3 * b, np.zeros((6, 2))]), np.diag([1e-3, 1.0])
    noise = PlacedNoise(f, c, b, np.hstack([np.zeros((2, 1)), d]), read, 0.0)
    poles = -np.linspace(2.0, 4.0, 6)
    (plain, best), (quiet, condition) = place(f, c, poles), place(f, c, poles, noise=noise)
    assert condition <= 1.001 * MOST_CONDITION * best
    assert noise.value_and_slope(quiet)[0] <= noise.value_and_slope(plain)[0]

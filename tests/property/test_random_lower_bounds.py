"""What is asked for just below the least gain is refused with a proof, whatever the units and however far the start."""

import numpy as np
import pytest

import obsynth
from obsynth.analysis.existence.restricted_equivalent import prepare
from obsynth.conditions.gamma_lower_bound import _checked_bound, _DualProblem, proved_lower_bound
from obsynth.methods.fault_estimation_filter.convex_problem import gain_problem
from obsynth.numerics.central_filter import search_least_gain
from obsynth.proofs.exact_doubles import stored_matrix
from obsynth.verification.least_gain_proof import ALONE, LAST, LEAST_GAIN_PAIRS, InvisiblePairs


def random_plant(seed: int, units: float) -> obsynth.DescriptorSystem:
    """Return a plant of 4 to 9 states with E of rank nx - 2; every signal and equation in a unit of its own."""
    rng = np.random.default_rng([8, seed])
    nx, nf, nd = int(rng.integers(4, 10)), 2, 2
    ny = nf + 1 + int(rng.integers(0, 2))
    a = rng.normal(size=(nx, nx))
    a *= 1.1 / np.max(np.abs(np.linalg.eigvals(a)))
    hidden = rng.normal(size=(nx, 2))
    e = np.eye(nx) - hidden @ np.linalg.pinv(hidden)
    rows, states, outputs, faults, disturbances = (
        units ** rng.uniform(-1.0, 1.0, size) for size in (nx, nx, ny, nf, nd)
    )
    return obsynth.DescriptorSystem(
        E=rows[:, None] * e * states,
        A=rows[:, None] * a * states,
        C=outputs[:, None] * rng.normal(size=(ny, nx)) * states,
        Bf=rows[:, None] * rng.normal(size=(nx, nf)) * faults,
        Bd=rows[:, None] * rng.normal(size=(nx, nd)) * disturbances,
        dt=1.0,
    )


@pytest.mark.long
@pytest.mark.parametrize(("units", "gap"), [(1.0, 1e-4), (1e3, 1e-4), (1e6, 5e-3)])
def test_the_proved_lower_bound_is_close_to_the_least_gain_found(units, gap):
    weak = []
    for seed in range(8):
        problem, _ = gain_problem(prepare(random_plant(seed, units)), free_weight=False)
        least = search_least_gain(problem)
        bound = proved_lower_bound(problem, solver="CLARABEL", best=least.injection)
        assert bound <= least.gain * (1.0 + 1e-9)
        if bound < (1.0 - gap) * least.gain:
            weak.append((seed, bound / least.gain))
    assert weak == []


def test_a_bound_is_not_improved_once_it_is_enough():
    problem, _ = gain_problem(prepare(random_plant(1, 1.0)), free_weight=False)
    least = search_least_gain(problem)
    assert 0.5 * least.gain < proved_lower_bound(problem, solver="CLARABEL", enough=0.5 * least.gain) <= least.gain


def pairs_of_everything(a, b, c, d) -> InvisiblePairs:
    """Return the pairs of a system whose outputs no gain can change: all errors, all disturbances."""
    one, none = np.eye(len(a)), np.zeros((len(a), b.shape[1]))
    top, bottom = np.hstack([one, none]), np.hstack([none.T, np.eye(b.shape[1])])
    parts = (one, top, bottom, np.hstack([a, b]), np.hstack([c, d]), c, d)
    return InvisiblePairs(*(stored_matrix(part) for part in parts))


def samples(a, b, disturbances) -> np.ndarray:
    """Return the pairs that a disturbance from rest runs through: they can follow each other."""
    errors = [np.zeros(len(a))]
    for value in disturbances[:-1]:
        errors.append(a @ errors[-1] + b @ value)
    return np.vstack([np.array(errors).T, disturbances.T])


def random_system(rng: np.random.Generator) -> tuple[tuple[np.ndarray, ...], float]:
    """Return ``A, B, C, D`` of two states, and the norm: no less than the largest gain on a fine grid."""
    a, b, c, d = (rng.normal(size=shape) for shape in ((2, 2), (2, 1), (1, 2), (1, 1)))
    a *= 0.7 / np.max(np.abs(np.linalg.eigvals(a)))
    points = np.exp(1j * np.linspace(0.0, np.pi, 2001))
    inner = np.linalg.solve(points[:, None, None] * np.eye(2) - a, np.broadcast_to(b + 0j, (len(points), 2, 1)))
    return (a, b, c, d), float(np.max(np.abs(c @ inner + d))) * (1.0 + 1e-5)


@pytest.mark.parametrize("free_weight", [False, True])
def test_no_dual_point_however_infeasible_proves_more_than_is_true(free_weight):
    """Sums of runs, with any disturbance after them; less what no next state shows; and points of any signs."""
    rng = np.random.default_rng(0)
    proved = 0
    for _ in range(4):
        (a, b, c, d), norm = random_system(rng)
        one, none = np.eye(2), np.zeros((2, 1))
        top, bottom, image = np.hstack([one, none]), np.hstack([none.T, np.eye(1)]), np.hstack([a, b])
        dual = _DualProblem(top, bottom, image, np.hstack([c, d]), np.hstack([c, d]), free_weight)
        unseen = np.linalg.svd(image)[2][-1:]
        for trial in range(60):
            runs = np.hstack([samples(a, b, rng.normal(size=(4, 1))) for _ in range(3)])
            size = 10.0 ** rng.uniform(-2.0, 3.0, size=3)
            z1 = runs @ runs.T - (size[0] * unseen.T @ unseen if trial % 3 == 1 else 0.0)
            q = image @ z1 @ image.T - top @ z1 @ top.T
            later = size[1] * rng.normal(size=(1, 2))
            corner, last = later @ q, later @ q @ later.T + size[2]
            if trial % 3 == 2:
                z1, corner, last = (size[0] * rng.normal(size=shape) for shape in ((3, 3), (1, 2), (1, 1)))
            bound = _checked_bound(dual, z1, corner, last)
            assert bound <= norm, trial
            proved += bound > 0.0
    assert proved > 0


@pytest.mark.parametrize("free_weight", [False, True])
def test_no_stated_proof_of_the_least_gain_proves_more_than_what_is_true(free_weight):
    """Where no gain changes anything the least gain is the norm: runs from rest show less, whatever follows them."""
    rng = np.random.default_rng(1)
    proved = 0
    for _ in range(3):
        (a, b, c, d), norm = random_system(rng)
        pairs = pairs_of_everything(a, b, c, d)
        for trial in range(30):
            # Two runs, as one leaves a slack of rank one; and mixtures that cannot follow each other.
            runs = [samples(a, b, rng.normal(size=(5, 1))) for _ in range(2)]
            mixture = np.hstack(runs) if trial % 2 else rng.normal(size=(3, 2)) * (rng.random((3, 2)) < 0.6)
            size = 10.0 ** rng.uniform(-3.0, 3.0, size=2)
            parts = {
                LEAST_GAIN_PAIRS: mixture,
                LAST: size[0] * rng.normal(size=(1, 2)),
                ALONE: size[1] * rng.normal(size=(1, 1)),
            }
            for left_out in (set(), {LEAST_GAIN_PAIRS}, {LAST}, {ALONE}, {LAST, ALONE}):
                stated = {name: part for name, part in parts.items() if name not in left_out}
                bound = pairs.bound(stated, free_weight=free_weight)
                assert bound <= norm, (trial, left_out)
                proved += bound > 0.0
    assert proved > 0


def test_a_long_run_proves_nearly_the_norm():
    """The gain of e+ = e / 2 + d, xi = e is 2, and a constant disturbance comes near it."""
    one = np.eye(1)
    mixture = samples(0.5 * one, one, np.ones((400, 1)))
    pairs = pairs_of_everything(0.5 * one, one, one, 0.0 * one)
    assert 1.99 < pairs.bound({LEAST_GAIN_PAIRS: mixture}, free_weight=False) <= 2.0
    # Without the first sample, which is the one at rest, nothing says where the run came from.
    assert pairs.bound({LEAST_GAIN_PAIRS: np.array([[1.0], [0.0]])}, free_weight=False) == 0.0


def noisy_plant(seed: int, nx: int) -> obsynth.DescriptorSystem:
    """Return a plant with more unknown inputs than outputs, so that some of them are invisible for ever."""
    rng = np.random.default_rng([9, nx, seed])
    a = rng.normal(size=(nx, nx))
    a *= 1.1 / np.max(np.abs(np.linalg.eigvals(a)))
    hidden = rng.normal(size=(nx, 2))
    e = np.eye(nx) - hidden @ np.linalg.pinv(hidden)
    parts = (rng.normal(size=shape) for shape in ((nx // 4 + 2, nx), (nx, 2), (nx, nx // 2 + 2)))
    return obsynth.DescriptorSystem(e, a, None, next(parts), Bf=next(parts), Bd=0.3 * next(parts), dt=0.1)


@pytest.mark.one_in(2)
@pytest.mark.parametrize("nx", [5, 8])
def test_runs_of_a_few_samples_prove_the_least_gain_of_small_filters(nx):
    """Neither the two steps nor a semidefinite solver: what is proved is below the gain of the filter in hand."""
    for seed in range(3):
        design = obsynth.fault_estimation_filter(noisy_plant(seed, nx))
        row, claims = design.report["least gain"], design.certificate.claims
        assert row.status == "proved"
        assert (1.0 - 1e-4) * claims["gamma_min"] <= row.value <= claims["gamma_min"] * (1.0 + 1e-6)
        pairs = design.certificate.matrices[LEAST_GAIN_PAIRS]
        assert pairs.shape[1] > 1


def test_a_proof_of_the_least_gain_at_any_price_is_made_on_request():
    plant = noisy_plant(0, 12)
    quick = obsynth.fault_estimation_filter(plant, weight="paper")
    assert quick.report["least gain"].status == "assumed"
    assert "prove_least" in quick.report["least gain"].detail
    thorough = obsynth.fault_estimation_filter(plant, weight="paper", prove_least=True)
    assert thorough.report["least gain"].status == "proved"
    assert thorough.options["prove_least"] is True
    assert thorough.certificate.claims["gamma"] == quick.certificate.claims["gamma"]

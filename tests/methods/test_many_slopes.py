"""Observers of plants with more than 12 slopes: one block in place of corners, against closed forms and a search."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from tests.support.corruptions import with_claims, with_matrices, with_observer

import obsynth
from obsynth import DAEModel, ObserverDesign, PreconditionError, SpecError
from obsynth.conditions import nonlinear_region
from obsynth.numerics.arrays import FloatArray
from obsynth.plants.operating_region import OperatingRegion
from obsynth.plants.transformations.nonlinear_terms import nonlinear_terms
from obsynth.verification.nonlinear_drive import drive_of, wanted_of
from obsynth.verification.nonlinear_region import directions, middle_and_half, whole_gain

#: Of a scalar plant with a sine of every multiple of its state.
SHARES = 0.05 / np.arange(1.0, 14.0)
STEP = 0.01


def _scalar(unit: float = 1.0, shares: FloatArray = SHARES) -> DAEModel:
    """Return ``x' = -2 x + sum_k c_k sin(k x)``: the slope of each term is between ``-k c_k`` and ``k c_k``."""
    terms = " + ".join(f"{float(c) * unit!r} * sin({k + 1} * x / {unit!r})" for k, c in enumerate(shares))
    return DAEModel({"x": f"der(x) = -2.0 * x + u + {terms}"}, {"y": "x"}, states={"x": 0.0}, inputs={"u": 0.0})


def _designed(unit: float = 1.0) -> ObserverDesign:
    noise = {"y": 0.1 * unit, "der(x)": 0.3 * unit}
    return obsynth.region_observer(
        _scalar(unit), region={"x": [-4.0 * unit, 4.0 * unit]}, sample_time=STEP, noise=noise, gains=[[0.5]],
        wanted={"x": unit},
    )  # fmt: skip


@pytest.fixture(scope="module")
def design() -> ObserverDesign:
    return _designed()


@pytest.mark.long
def test_of_one_state_the_block_loses_nothing(design: ObserverDesign) -> None:
    # All slopes at their upper ends together: x' = (-2 - 0.5 + 13 * 0.05) x.
    rate = 2.5 - float(np.arange(1.0, 14.0) @ SHARES)
    deviation = np.sqrt((0.3**2 + (0.5 * 0.1) ** 2 * STEP) / (2.0 * rate))
    claims = design.certificate.claims
    assert 0.99 * rate < claims["region_decay"] <= rate
    assert deviation <= claims["region_deviation"] < 1.002 * deviation
    assert design.report.passed
    assert any("one block with a multiplier for each of 13 slopes" in note for note in design.notes)


@pytest.mark.long
def test_units_change_nothing(design: ObserverDesign) -> None:
    other = _designed(1e3)
    assert other.report.passed
    for name, value in design.certificate.claims.items():
        assert other.certificate.claims[name] == pytest.approx(value, rel=1e-3)


_CORRUPTIONS: dict[str, tuple[Callable[[ObserverDesign], ObserverDesign], str]] = {
    "negative multiplier": (
        lambda d: with_matrices(d, T_region=d.certificate.matrices["T_region"] * np.r_[-1.0, np.ones(12)]),
        "decay over the region",
    ),
    "no number": (
        lambda d: with_matrices(d, T_gain=d.certificate.matrices["T_gain"] * np.r_[np.nan, np.ones(12)]),
        "mean square over the region",
    ),
    "infinite multiplier": (
        lambda d: with_matrices(d, T_gain=d.certificate.matrices["T_gain"] * np.r_[np.inf, np.ones(12)]),
        "mean square over the region",
    ),
    "missing multiplier": (
        lambda d: with_matrices(d, T_gain=d.certificate.matrices["T_gain"][:12]), "mean square over the region",
    ),
    "no multipliers": (
        lambda d: with_matrices(d, T_gain=np.zeros(13)), "mean square over the region",
    ),
    "smaller deviation": (
        lambda d: with_claims(d, region_deviation=0.99 * d.certificate.claims["region_deviation"]),
        "mean square over the region",
    ),
    "faster decay": (
        lambda d: with_claims(d, region_decay=1.02 * d.certificate.claims["region_decay"]), "decay over the region",
    ),
    "wider slopes": (
        lambda d: with_observer(d, slopes=1.1 * d.over_region[1].slopes), "mean square over the region",
    ),
    "narrower slopes": (lambda d: with_observer(d, slopes=0.999 * d.over_region[1].slopes), "slopes over the region"),
    "changed gain": (lambda d: with_observer(d, gain=-d.over_region[1].gain), "mean square over the region"),
    "P of other sign": (
        lambda d: with_matrices(d, P_region=-d.certificate.matrices["P_region"]), "decay over the region",
    ),
}  # fmt: skip


@pytest.mark.one_in(6)
@pytest.mark.parametrize("name", _CORRUPTIONS)
def test_corrupted_designs_are_refused(name: str, design: ObserverDesign) -> None:
    corrupt, row = _CORRUPTIONS[name]
    report = obsynth.verify(corrupt(design))
    assert not report.passed
    assert not report[row].passed


def test_a_gain_set_keeps_the_multipliers(design: ObserverDesign, tmp_path: Path) -> None:
    again = obsynth.load(design.save(tmp_path / "many.gains.json"))
    assert obsynth.verify(again).passed
    assert np.array_equal(again.certificate.matrices["T_region"], design.certificate.matrices["T_region"])


def test_too_many_slopes_and_too_many_corners_are_refused() -> None:
    plant = _scalar(shares=1e-4 * np.ones(65))
    with pytest.raises(PreconditionError, match="65 slopes"):
        obsynth.region_observer(plant, region={"x": [-1, 1]}, sample_time=STEP, goal="decay")
    with pytest.raises(SpecError, match="multiplier='diagonal'"):
        nonlinear_region(_scalar(), {"x": [-1, 1]}, goal="decay", decay=0.1)


def test_the_rounded_middle_and_half_hold_the_bounds() -> None:
    rng = np.random.default_rng(0)
    bounds = np.sort(rng.standard_normal((500, 2)) * 10.0 ** rng.integers(-8, 8, (500, 1)), axis=1)
    bounds[:50] = bounds[:50, :1] * (1.0 + np.array([0.0, 1e-15]) * np.sign(bounds[:50, :1]))
    middle, half = middle_and_half(bounds)
    for (low, high), m, h in zip(bounds.tolist(), middle.tolist(), half.tolist(), strict=True):
        assert Fraction(m) - Fraction(h) <= Fraction(low) <= Fraction(high) <= Fraction(m) + Fraction(h)


def _network(count: int, unit: float, seed: int) -> tuple[DAEModel, dict[str, list[float]], dict[str, float]]:
    """Return damped masses with hardening springs and sines between them, stable by construction, and one algebraic
    state."""
    rng, n = np.random.default_rng(seed), (count + 1) // 2
    shares = rng.uniform(0.02, 0.08, 2 * n).tolist()
    equations, region = {"w": "tension = x1 + 0.1 * tanh(tension) * 0.5"}, {"tension": [-3.0, 3.0]}
    for i in range(1, n + 1):
        force = f"-2.0 * x{i} - 1.5 * v{i} / {unit!r} - {shares[i - 1]!r} * x{i} ** 3"
        force += f" - {shares[n + i - 1]!r} * sin(x{i} - x{i - 1})" if i > 1 else " + f + 0.01 * tension"
        equations |= {f"a{i}": f"der(x{i}) = v{i} / {unit!r}", f"b{i}": f"der(v{i}) = ({force}) * {unit!r}"}
        region |= {f"x{i}": [-1.0, 1.0]} | ({f"x{i} - x{i - 1}": [-1.0, 1.0]} if i > 1 else {})
    outputs = {f"y{i}": f"x{i}" for i in range(1, n + 1, 2)}
    states = {f"{kind}{i}": 0.0 for i in range(1, n + 1) for kind in "xv"} | {"tension": 0.0}
    model = DAEModel(equations, outputs, states=states, inputs={}, parameters={"f": 0.0})
    return model, region, {**dict.fromkeys(outputs, 0.01), "f": 0.5}


def _at_slopes(design: ObserverDesign, noise: dict[str, float]) -> Callable[[FloatArray], tuple[FloatArray, ...]]:
    """Return how the closed error system without algebraic states is formed at shares of the slopes in [-1, 1]."""
    model, observer = design.over_region
    terms = nonlinear_terms(model, faults=observer.faults)
    region = OperatingRegion.of(terms, observer.region)
    W, Wy, V = directions(terms, region.slopes())
    B, D = drive_of(terms, noise, observer.dt)
    Cz, L, k = wanted_of(terms, region, None), whole_gain(terms, observer.gain), terms.differential
    low, high = observer.slopes.T

    def formed(shares: FloatArray) -> tuple[FloatArray, ...]:
        d = np.diag(0.5 * (low + high) + 0.5 * (high - low) * shares)
        M, N = terms.A + W @ d @ V - L @ (terms.C + Wy @ d @ V), B - L @ D
        below = np.linalg.solve(M[k:, k:], M[k:, :k])
        return M[:k, :k] - M[:k, k:] @ below, N[:k], Cz[:, :k] - Cz[:, k:] @ below

    return formed


@pytest.mark.long
@pytest.mark.parametrize(("count", "unit", "goal"), [(13, 1.0, "power"), (14, 1e3, "gain")])
def test_no_slopes_exceed_what_one_block_proves(count: int, unit: float, goal: str) -> None:
    from scipy.linalg import solve_continuous_lyapunov

    model, region, noise = _network(count, unit, count)
    made = obsynth.region_observer(model, region=region, sample_time=STEP, noise=noise, goal=goal)
    observer, claims = made.over_region[1], made.certificate.claims
    assert made.report.passed
    assert len(observer.slopes) >= 13
    assert "exactly one solution for tension" in made.report["index 1 over the region"].claim
    formed, rng, q = _at_slopes(made, noise), np.random.default_rng(1), len(observer.slopes)
    P = made.certificate.matrices["P_region"][0]
    P1 = P[: observer.gain.shape[0], : observer.gain.shape[0]]
    factor = np.linalg.cholesky(P1).T
    worst = 0.0

    def level(shares: FloatArray) -> float:
        A, B, Cz = formed(shares)
        # No error grows in the norm of the certificate more than the decay says, at any slopes.
        inner = factor @ A @ np.linalg.inv(factor)
        assert np.linalg.eigvalsh(inner + inner.T)[-1] <= -2.0 * claims["region_decay"] * (1.0 - 1e-9)
        if goal == "power":
            return float(np.sqrt(np.trace(Cz @ solve_continuous_lyapunov(A, -B @ B.T) @ Cz.T)))
        frequencies = np.r_[0.0, np.logspace(-2, 3, 30)]
        return max(np.linalg.norm(Cz @ np.linalg.solve(1j * w * np.eye(len(A)) - A, B), 2) for w in frequencies)

    for _ in range(3):
        shares = rng.choice([-1.0, 1.0], q)
        best = level(shares)
        for j in rng.permutation(q):
            trial = np.where(np.arange(q) == j, -shares, shares)
            value = level(trial)
            shares, best = (trial, value) if value > best else (shares, best)
        worst = max(worst, best)
    claimed = claims["region_deviation" if goal == "power" else "region_gain"]
    assert 0.8 * claimed < worst <= claimed


@pytest.mark.long
def test_a_block_is_near_the_corners_of_few_slopes(monkeypatch: pytest.MonkeyPatch) -> None:
    model, region, noise = _network(4, 1.0, 5)
    options = {"region": region, "sample_time": STEP, "noise": noise}
    corners = obsynth.region_observer(model, **options)
    for module in ("obsynth.methods.region_observer.synthesis", "obsynth.verification.nonlinear_region"):
        monkeypatch.setattr(f"{module}.MOST_CORNER_SLOPES", 0)
    block = obsynth.region_observer(model, **options)
    assert "T_gain" in block.certificate.matrices
    one, other = (each.certificate.claims["region_deviation"] for each in (corners, block))
    assert other == pytest.approx(one, rel=0.02)

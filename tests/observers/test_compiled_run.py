"""The compiled kernel: the same as the normal path, the same as a batch solution, and where it must yield."""

from __future__ import annotations

import importlib.util
from dataclasses import fields

import numpy as np
import pytest
from time_varying_plants import maximum_likelihood, observer_for, printed, record, textbook, varying

from obsynth import PreconditionError, SpecError, TimeVaryingDescriptorSystem
from obsynth.observers.recursive import compiled_run
from obsynth.observers.recursive.recursion import Recursion

SAMPLES = 40
#: Relative to the largest entry of each result: rounding of well-posed problems over a record.
ROUNDING = 1e-10
WALK = {"form": "random-walk", "walk": 0.01 * np.eye(2)}


@pytest.fixture
def kernel() -> None:
    pytest.importorskip("numba")


@pytest.fixture
def single_steps(kernel, monkeypatch) -> list[int]:
    """The samples that were taken step by step."""
    taken: list[int] = []
    plain = Recursion.advance

    def counted(self, state, y, u):
        taken.append(state.k)
        return plain(self, state, y, u)

    monkeypatch.setattr(Recursion, "advance", counted)
    return taken


def assert_same(found, exact) -> None:
    for field in fields(exact):
        if field.name in ("state_covariances", "cross_covariances"):
            # The kernel hands out deviations alone.
            continue
        ours, theirs = getattr(found, field.name), getattr(exact, field.name)
        if field.name.endswith(("names", "delays")):
            assert ours == theirs
            continue
        scale = np.max(np.abs(theirs[np.isfinite(theirs)]), initial=np.finfo(float).tiny)
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=ROUNDING * scale, err_msg=field.name)


def invariant(nx: int, ny: int) -> TimeVaryingDescriptorSystem:
    """A stable plant without any structure, with some zero rows in E."""
    rng = np.random.default_rng(nx)
    E = rng.standard_normal((nx, nx))
    E[: ny // 2] = 0.0
    return TimeVaryingDescriptorSystem(
        E, 0.3 * rng.standard_normal((nx, nx)), rng.standard_normal((nx, 2)), rng.standard_normal((ny, nx)), dt=1.0
    )


def stacked() -> TimeVaryingDescriptorSystem:
    """Every matrix a stack."""
    plant = varying()
    stacks = {
        name: np.array([getattr(plant, name).at(k) for k in range(SAMPLES if name in "EC" else SAMPLES - 1)])
        for name in ("E", "A", "B", "C", "Phi", "Psi")
    }
    return varying(**stacks)


COVERED = {
    "expressions": lambda: observer_for(varying()),
    "E = I": lambda: observer_for(textbook()),
    "no residual direction": lambda: observer_for(printed()),
    "early constraints": lambda: observer_for(varying(), early_constraints=True),
    "random walk": lambda: observer_for(varying(), adapt=WALK),
    "every matrix a stack": lambda: observer_for(stacked()),
    "noise that varies": lambda: observer_for(varying(), R=[["1.5 + sin(k)", 0.1], [0.1, 0.4]]),
    "noise as a stack": lambda: observer_for(varying(), Q=np.linspace(1, 2, SAMPLES)[:, None, None] * np.eye(3)),
    "time-invariant": lambda: observer_for(invariant(4, 3)),
    "time-invariant, twenty states": lambda: observer_for(invariant(20, 5)),
    "rectangular E": lambda: observer_for(
        TimeVaryingDescriptorSystem([[1, 0]], [[0.9, 0.2]], [[1]], [[1, 0], [0.3, 1]], dt=1.0)
    ),
    "little noise in one equation": lambda: observer_for(varying(), Q=np.diag([0.1, 0.2, 1e-24])),
}


@pytest.mark.one_in(4)
@pytest.mark.parametrize("name", COVERED)
def test_it_gives_what_the_normal_path_gives(name: str, single_steps) -> None:
    observer = COVERED[name]()
    y, u = record(observer.plant, SAMPLES)
    exact = observer.run(y, u, compiled=False)
    assert single_steps == list(range(SAMPLES))
    single_steps.clear()
    found = observer.run(y, u, compiled=True)
    assert single_steps == [0]
    assert_same(found, exact)


@pytest.mark.parametrize("adapt", [None, {"form": "random-walk"}], ids=["a filter", "a walk that stands still"])
def test_it_is_the_maximum_likelihood_estimate(adapt: dict | None, single_steps) -> None:
    observer = observer_for(varying(), adapt=adapt)
    y, u = record(observer.plant, SAMPLES)
    found = observer.run(y, u, compiled=True)
    exact, covariance = maximum_likelihood(observer, y, u, parameters=adapt is not None)
    np.testing.assert_allclose(np.concatenate([found.states[-1], found.parameters[-1]]), exact, rtol=0, atol=1e-10)
    np.testing.assert_allclose(found.state_deviations[-1], np.sqrt(np.diag(covariance))[:3], rtol=0, atol=1e-10)
    np.testing.assert_allclose(found.parameter_covariances[-1], covariance[3:, 3:], rtol=0, atol=1e-10)
    assert single_steps == [0]


class TestWhatItLeavesToTheNormalPath:
    def test_missing_samples(self, single_steps) -> None:
        """One is missing, then all are for two samples, which leaves the third state open."""
        observer = observer_for(varying())
        y, u = record(observer.plant, SAMPLES)
        y[12, 0] = np.nan
        y[24:26] = np.nan
        exact = observer.run(y, u, compiled=False)
        single_steps.clear()
        found = observer.run(y, u, compiled=True)
        assert single_steps == [0, 12, 24, 25, 26]
        assert np.isinf(found.state_deviations[24:26, 2]).all()
        assert_same(found, exact)

    def test_short_stretches(self, single_steps) -> None:
        observer = observer_for(varying())
        y, u = record(observer.plant, SAMPLES)
        y[::3, 1] = np.nan
        found = observer.run(y, u, compiled=True)
        assert single_steps == list(range(SAMPLES))
        assert_same(found, observer.run(y, u, compiled=False))

    def test_perfect_equations(self, single_steps) -> None:
        """The same exact equation twice at some k: a rank is decided there, and after it, where less is unknown."""
        R = np.tile(np.diag([0.2, 0.3]), (SAMPLES, 1, 1))
        R[20] = 0.0
        plant = TimeVaryingDescriptorSystem(
            None, [[0.9, 0.1], [0, 0.8]], [[1], [0]], [[1, 0.5], [2, 1]], dt=1.0
        )  # fmt: skip
        observer = observer_for(plant, R=R)
        y, u = record(plant, SAMPLES)
        y[21, 1] = 2.0 * y[21, 0]
        exact = observer.run(y, u, compiled=False)
        single_steps.clear()
        found = observer.run(y, u, compiled=True)
        assert single_steps == [0, 21, 22]
        assert_same(found, exact)
        y[21, 1] += 1.0
        with pytest.raises(PreconditionError, match="contradict each other"):
            observer.run(y, u, compiled=True)

    def test_where_every_step_needs_a_decision_the_kernel_is_tried_less_and_less(self, single_steps, monkeypatch):
        plant = TimeVaryingDescriptorSystem(
            [[1, 0], [0, 1]], [[0.9, 0.1], [0, 0.8]], np.zeros((2, 0)), [[1, 0], [1, 0]], dt=1.0
        )  # fmt: skip
        observer = observer_for(plant, R=1e-30 * np.eye(2))
        y = np.repeat(record(plant, SAMPLES)[0][:, :1], 2, axis=1)
        tried = []
        plain = compiled_run._kernel_steps

        def counted(observer, state, *rest):
            tried.append(state.k)
            return plain(observer, state, *rest)

        monkeypatch.setattr(compiled_run, "_kernel_steps", counted)
        found = observer.run(y, compiled=True)
        assert tried == [1, 2, 4, 8, 16, 32]
        assert_same(found, observer.run(y, compiled=False))

    def test_a_rank_is_lost_at_one_k(self, kernel) -> None:
        plant = varying(C=[[1, 0, "1 - step(k - 14) + step(k - 15)"], [0, 1, 0]], E=np.diag([1.0, 1, 0]))
        with pytest.raises(PreconditionError, match="rank H_k is lost at k = 14"):
            observer_for(plant).run(*record(plant, SAMPLES), compiled=True)


def test_long_records_are_taken_in_parts(single_steps, monkeypatch) -> None:
    observer = observer_for(varying())
    y, u = record(observer.plant, SAMPLES)
    exact = observer.run(y, u, compiled=False)
    single_steps.clear()
    monkeypatch.setattr(compiled_run, "PREPARED_STEPS", 10)
    assert_same(observer.run(y, u, compiled=True), exact)
    assert single_steps == [0]


class TestTheChoice:
    def test_it_is_made_by_length_and_order_where_numba_is(self, monkeypatch) -> None:
        monkeypatch.setattr(importlib.util, "find_spec", lambda name: name)
        small, large = observer_for(varying()), observer_for(invariant(compiled_run.SMALL_ORDER + 1, 3))
        learning, walking = observer_for(varying(), adapt={}), observer_for(varying(), adapt=WALK)
        long = compiled_run.LONG_RECORD
        for observer, samples, expected in (
            (small, long, True), (small, long - 1, False), (large, long, False), (learning, long, False),
            (walking, long, True),
        ):  # fmt: skip
            assert compiled_run.kernel_is_chosen(observer, samples, None) == expected
        assert compiled_run.kernel_is_chosen(large, 1, True)
        assert not compiled_run.kernel_is_chosen(small, long, False)
        monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
        assert not compiled_run.kernel_is_chosen(small, long, None)

    def test_asked_for_without_numba(self, monkeypatch) -> None:
        monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
        observer = observer_for(varying())
        with pytest.raises(SpecError, match=r"numba, which is not installed: pip install 'obsynth\[fast\]'") as caught:
            observer.run(*record(observer.plant, 5), compiled=True)
        assert caught.value.path == "compiled"
        assert len(observer.run(*record(observer.plant, 5)).states) == 5

    def test_asked_for_where_it_does_not_reach(self, kernel) -> None:
        observer = observer_for(varying(), adapt={})
        with pytest.raises(SpecError, match="the kernel runs filters") as caught:
            observer.run(*record(observer.plant, 5), compiled=True)
        assert caught.value.path == "compiled"

    def test_bad_records_are_refused_as_ever(self, kernel) -> None:
        observer = observer_for(varying(horizon=5))
        with pytest.raises(SpecError, match="horizon of 5 steps"):
            observer.run(*record(observer.plant, 7), compiled=True)
        with pytest.raises(SpecError, match="u is missing"):
            observer.run(record(observer.plant, 5)[0], compiled=True)


@pytest.mark.one_in(2)
@pytest.mark.parametrize("units", [1.0, 1e3])
def test_a_factorisation_that_has_settled_is_kept_and_changes_nothing(single_steps, units: float) -> None:
    """Records many times longer than the filter's memory, with states of different sizes, and parameters that walk."""
    rng = np.random.default_rng(3)
    sizes = units ** rng.uniform(-1.0, 1.0, 5)
    A = rng.standard_normal((5, 5))
    A *= 0.95 / np.max(np.abs(np.linalg.eigvals(A)))
    plant = TimeVaryingDescriptorSystem(
        None, sizes[:, None] * A / sizes, np.eye(5), rng.standard_normal((2, 5)) / sizes, dt=1.0,
        Phi=sizes[:, None] * rng.standard_normal((5, 1)),
    )  # fmt: skip
    y, u = rng.standard_normal((1500, 2)), sizes * rng.standard_normal((1500, 5))
    y[900, 1] = np.nan
    for adapt in (None, {"form": "random-walk", "walk": 0.01 * np.eye(1)}):
        observer = observer_for(plant, adapt=adapt)
        single_steps.clear()
        found = observer.run(y, u, compiled=True)
        assert single_steps == [0, 900]
        exact = observer.run(y, u, compiled=False)
        for name in ("states", "state_deviations", "innovations", "faults", "fault_covariances"):
            ours, theirs = getattr(found, name), getattr(exact, name)
            scale = np.nanmax(np.abs(theirs), axis=0, initial=np.finfo(float).tiny)
            np.testing.assert_allclose(ours / scale, theirs / scale, rtol=0, atol=1e-9, err_msg=name)

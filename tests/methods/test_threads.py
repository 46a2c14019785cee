"""Designs and verifications of small plants run on one BLAS thread, and nothing of it stays behind."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import scipy.linalg
import threadpoolctl
from threadpoolctl import threadpool_info, threadpool_limits

import obsynth
from obsynth.analysis.structure import analyse_structure
from obsynth.methods import designing
from obsynth.methods.pd_observer import synthesis as method
from obsynth.methods.pd_observer.method import PdObserver
from obsynth.numerics.libraries import STATES_WORTH_THREADS, one_thread_if_small

PLANT = obsynth.DescriptorSystem(None, [[0.5, 1.0], [0.0, -1.0]], C=[[1.0, 0.0]], Bf=[[0.0], [1.0]])

#: A solver may have brought a BLAS that was built for one thread: its number cannot be set.
with threadpool_limits(limits=2, user_api="blas"):
    LOADED = {
        library["filepath"]
        for library in threadpool_info()
        if library["user_api"] == "blas" and library["num_threads"] == 2
    }


def blas_threads() -> set[int]:
    """Of NumPy and SciPy; solvers that are loaded on the way may bring another BLAS."""
    libraries = [library for library in threadpool_info() if library["user_api"] == "blas"]
    found = {library["num_threads"] for library in libraries if library["filepath"] in LOADED}
    assert found
    return found


@pytest.fixture(autouse=True)
def two_threads() -> Iterator[None]:
    with threadpool_limits(limits=2, user_api="blas"):
        assert blas_threads() == {2}
        yield


def test_inside_there_is_one_thread_and_afterwards_what_there_was() -> None:
    with one_thread_if_small(STATES_WORTH_THREADS - 1):
        assert blas_threads() == {1}
        with one_thread_if_small(3):
            assert blas_threads() == {1}
        assert blas_threads() == {1}
    assert blas_threads() == {2}


def test_large_problems_keep_their_threads() -> None:
    with one_thread_if_small(STATES_WORTH_THREADS):
        assert blas_threads() == {2}


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_an_error_puts_the_number_back(error: type[BaseException]) -> None:
    with pytest.raises(error), one_thread_if_small(3):
        raise error
    assert blas_threads() == {2}


TWO_AT_ONCE = """
import threading
import scipy.linalg
from threadpoolctl import threadpool_info
from obsynth.numerics.libraries import one_thread_if_small

first_is_in, second_is_in, first_is_out = threading.Event(), threading.Event(), threading.Event()

def blas_threads():
    return sorted({library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"})

def first():
    with one_thread_if_small(3):
        print(blas_threads())
        with one_thread_if_small(3):
            first_is_in.set()
        assert second_is_in.wait(20.0)
    first_is_out.set()

def second():
    assert first_is_in.wait(20.0)
    with one_thread_if_small(3):
        second_is_in.set()
        assert first_is_out.wait(20.0)

before = blas_threads()
both = [threading.Thread(target=work) for work in (first, second)]
for thread in both:
    thread.start()
for thread in both:
    thread.join(30.0)
print(before == blas_threads())
"""


def test_two_python_threads_at_once_leave_nothing_behind() -> None:
    """The first one in is the first one out: with limits of their own the second would restore what the first set."""
    environment = {**os.environ, "OMP_NUM_THREADS": "2", "OPENBLAS_NUM_THREADS": "2"}
    done = subprocess.run(
        [sys.executable, "-c", TWO_AT_ONCE], capture_output=True, text=True, check=True, env=environment
    )
    assert done.stdout.splitlines() == ["[1]", "True"]


def test_a_design_runs_on_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []
    right = designing.verify

    def watched(design: obsynth.ObserverDesign) -> obsynth.VerificationReport:
        seen.append(blas_threads())
        return right(design)

    monkeypatch.setattr(designing, "verify", watched)
    made = obsynth.design(PLANT, "pd-observer", progress=lambda _: seen.append(blas_threads()))
    assert made.report.passed
    assert len(seen) >= 3
    assert all(found == {1} for found in seen)
    assert blas_threads() == {2}


KUNDUR = Path(__file__).parents[2] / "designs" / "kundur" / "spec_fault_filter.yaml"
ENTRIES: dict[str, Callable[[obsynth.DescriptorSystem], object]] = {
    "load_spec": lambda _: obsynth.load_spec(KUNDUR),
    "analyse_structure": lambda plant: analyse_structure.__wrapped__(plant),
    "diagnose": obsynth.diagnose,
    "decouple": obsynth.decouple,
    "sensor_sets": obsynth.sensor_sets,
    "compare": lambda plant: obsynth.compare(plant, runs=1, methods=["functional-filter"]),
    "discretise": lambda plant: obsynth.discretise(plant, 0.1),
}


@pytest.mark.one_in(4)
@pytest.mark.parametrize("entry", ENTRIES)
def test_every_entry_runs_on_one_thread(entry: str, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []
    for home, name in ((np.linalg, "svd"), (np.linalg, "solve"), (scipy.linalg, "expm"), (scipy.linalg, "svd")):
        right = getattr(home, name)

        def watched(*arguments: object, right: Callable[..., object] = right, **options: object) -> object:
            seen.append(blas_threads())
            return right(*arguments, **options)

        monkeypatch.setattr(home, name, watched)
    plant = obsynth.DescriptorSystem(
        np.diag([1.0, 1, 0]), [[-0.5, 1, 0], [0, -1, 0], [1, 0, -1]], None, [[1.0, 0, 0.5]], Bf=[[0.0], [1], [0]],
        Dw=[[0.1]],
    )  # fmt: skip
    ENTRIES[entry](plant)
    assert seen
    assert all(found == {1} for found in seen)
    assert blas_threads() == {2}


def test_a_design_that_fails_puts_the_number_back() -> None:
    with pytest.raises(obsynth.PreconditionError):
        obsynth.pd_observer(PLANT.replace(C=np.zeros((1, 2))))
    assert blas_threads() == {2}


def test_verification_alone_runs_on_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    from obsynth.methods.pd_observer import checks as checker

    made = obsynth.pd_observer(PLANT)
    seen = []
    right = checker.checks

    def watched(design: obsynth.ObserverDesign, printed_digits: int | None) -> Iterator[object]:
        seen.append(blas_threads())
        yield from right(design, printed_digits)

    monkeypatch.setattr(checker, "checks", watched)
    assert obsynth.verify(made).passed
    assert seen == [{1}]
    assert blas_threads() == {2}


def test_the_method_itself_leaves_the_threads_alone() -> None:
    """The setting is in `design`, once for every method."""
    method.synthesise(PLANT, PdObserver(), progress=lambda _: None)
    assert blas_threads() == {2}


def test_a_library_that_was_loaded_later_is_limited_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """Libraries are looked for once for as long as no module is imported."""
    looked: list[int] = []
    right = threadpoolctl.ThreadpoolController

    def watched() -> threadpoolctl.ThreadpoolController:
        looked.append(1)
        return right()

    monkeypatch.setattr(threadpoolctl, "ThreadpoolController", watched)
    for _ in range(3):
        with one_thread_if_small(3):
            pass
    before = len(looked)
    assert before <= 1
    monkeypatch.setitem(sys.modules, "a_module_that_is_new", sys)
    with one_thread_if_small(3):
        assert len(looked) == before + 1
        assert blas_threads() == {1}

"""A sweep goes wherever an executor takes it, threads, processes or a Dask cluster, with the same result."""

from __future__ import annotations

from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import pytest

import obsynth
from obsynth.specs.loader import load_spec

DESIGNS = Path(__file__).parents[2] / "designs"
#: More than one batch of either design.
RUNS = 400


@pytest.fixture(scope="module")
def linear() -> tuple[obsynth.ObserverDesign, obsynth.Scenario, object]:
    spec = load_spec(DESIGNS / "wang2015" / "spec.yaml")
    design = obsynth.fault_estimation_filter(spec.plant)
    return design, spec.scenario, obsynth.monitor(design, spec.scenario, disturbance_bounds={"w": 0.1})


@pytest.fixture(scope="module")
def recursive() -> tuple[obsynth.ObserverDesign, obsynth.Scenario, object]:
    spec = load_spec(DESIGNS / "moussaali2013_ltv" / "two_outputs.yaml")
    design = obsynth.design(spec.plant, spec.method, **dict(spec.options))
    return design, spec.scenario.replace(horizon=300), obsynth.ParameterMonitor()


@pytest.fixture(scope="module")
def here(linear, recursive) -> tuple[dict[str, object], dict[str, object]]:
    """Return what this process finds."""
    return swept(linear, None), swept(recursive, None)


def swept(
    case: tuple[obsynth.ObserverDesign, obsynth.Scenario, object], executor: Executor | None
) -> dict[str, object]:
    design, scenario, monitor = case
    done: list[int] = []
    found = obsynth.evaluate(
        design, scenario, runs=RUNS, monitor=monitor, executor=executor, progress=lambda some, _: done.append(some)
    )
    assert len(done) > 1
    assert done[-1] == RUNS
    return found.as_dict()


@pytest.mark.long
def test_a_dask_cluster_gives_the_same_numbers(linear, recursive, here) -> None:
    distributed = pytest.importorskip("distributed", reason="no Dask: pip install 'obsynth[cluster]'")
    with (
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=False, dashboard_address=":0") as cluster,
        distributed.Client(cluster) as client,
    ):
        executor = client.get_executor()
        there = [swept(case, executor) for case in (linear, recursive)]
    assert there == [*here]


@pytest.mark.long
def test_a_dask_worker_of_another_process_gives_the_same_numbers(linear, here) -> None:
    distributed = pytest.importorskip("distributed", reason="no Dask: pip install 'obsynth[cluster]'")
    with (
        distributed.LocalCluster(n_workers=1, threads_per_worker=1, processes=True, dashboard_address=":0") as cluster,
        distributed.Client(cluster) as client,
    ):
        there = swept(linear, client.get_executor())
    assert there == here[0]


@pytest.mark.long
@pytest.mark.parametrize("kind", ["threads", "processes"])
def test_threads_and_processes_give_the_same_numbers(kind: str, recursive, here) -> None:
    make = ThreadPoolExecutor(2) if kind == "threads" else ProcessPoolExecutor(1, mp_context=get_context("spawn"))
    with make as executor:
        assert swept(recursive, executor) == here[1]


def test_a_bar_shows_how_far_it_is(linear, capsys) -> None:
    design, scenario, _ = linear
    obsynth.evaluate(design, scenario, runs=RUNS, progress=True)
    shown = capsys.readouterr()
    assert f"{RUNS}/{RUNS}" in shown.err
    obsynth.evaluate(design, scenario, runs=3, progress=False)
    silent = capsys.readouterr()
    assert (shown.out, silent.out, silent.err) == ("", "", "")

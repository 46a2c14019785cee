"""A small instance of each benchmark runs, so that none can rot; what it measures is no business of a test."""

import os
import re
import runpy
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture
def printed(monkeypatch, capfd):
    """Return what a benchmark prints that is run as a script, in this process: its libraries are loaded once."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        monkeypatch.setenv(name, os.environ.get(name, "1"))
    # The tests have a module of this name, too.
    monkeypatch.delitem(sys.modules, "networks", raising=False)

    def run(name, *arguments):
        script = str(ROOT / "benchmarks" / f"{name}.py")
        monkeypatch.setattr(sys, "argv", [script, *arguments])
        capfd.readouterr()
        code = None
        try:
            runpy.run_path(script, run_name="__main__")
        except SystemExit as end:
            code = end.code
        assert not code
        return capfd.readouterr().out

    yield run
    sys.modules.pop("networks", None)


@pytest.fixture
def small_table(printed):
    """Return the rows that the small instance of a benchmark prints, cell by cell."""

    def table(name):
        return [line.strip("| ").split(" | ") for line in printed(name, "--small").splitlines()[2:]]

    return table


def cells(line):
    return [cell.strip() for cell in line.strip().strip("|").split("|")]


def tables(text):
    """Return, by the first column's title, the rows of each table."""
    found, rows = {}, []
    for line in text.splitlines():
        if not line.startswith("|"):
            rows = []
        elif not rows:
            rows = found.setdefault(line, [])
            rows.append(cells(line))
        elif not line.startswith("| ---"):
            rows.append(cells(line))
    return list(found.values())


@pytest.mark.long
def test_the_fault_filter_benchmark_runs(printed):
    text = printed("fault_estimation_filter", "--small")
    speed, growth, verified, constraints, networks = tables(text)
    assert [line[0] for line in speed[1:]] == ["6, brief", "6, noise", "6, delay"]
    # The bisection of one family: it builds the inequality a dozen times.
    assert [line[5] == "-" for line in speed[1:]] == [False, True, True]
    for line in speed[1:]:
        # gamma of every way, relative to the best: the bisection ends within 1e-4, the scripts lose 1e-6 of strictness.
        distances = [float(cell.split(", ")[1]) for cell in line[2:6] if cell != "-"]
        assert max(distances[:2]) <= 1e-5
        assert max(distances) <= 1e-2
    assert [line[-1] for line in growth[1:]] == ["True"]
    assert [line[1] for line in verified[1:]] == ["1 of 1"] * 3
    assert [line[1] for line in constraints[1:]] == ["1 of 1"]
    assert [line[4] for line in networks[1:]] == ["True"]


@pytest.mark.long
@pytest.mark.usefixtures("taken_as_verified")
def test_the_false_alarm_benchmark_runs(printed):
    rows = [line.strip("| ").split(" | ") for line in printed("false_alarms", "1").splitlines()[3:]]
    assert len(rows) == 6
    for _, *cells in rows:
        for cell in cells:
            shares = [float(share) for share in cell.split(" / ")]
            assert len(shares) == 3
            # One run: an alarm or none, and none at a small probability without one at a larger.
            assert set(shares) <= {0.0, 100.0}
            assert shares == sorted(shares)


@pytest.mark.long
def test_the_benchmark_of_nonlinear_observers_runs(printed):
    rows = [line.strip("| ").split(" | ") for line in printed("dae_adaptive_observer", "--small").splitlines()[3:]]
    assert len(rows) == 7
    assert all(len(row) == 3 for row in rows)


@pytest.mark.long
def test_the_unknown_input_observer_benchmark_runs(small_table):
    (row,) = small_table("ui_pi_observer")
    rates = [float(cell.split(", ")[1].split()[0]) for cell in row[1:]]
    assert row[0] == "16"
    assert min(rates[:3]) > max(rates[3], 0.0)


@pytest.mark.long
def test_the_optimal_filter_benchmark_runs(small_table):
    rows = small_table("optimal_filter")
    assert [row[:2] for row in rows] == [["one", "3"], ["every state", "3"]]


def test_the_pd_observer_benchmark_runs(small_table):
    rows = small_table("pd_observer")
    assert [row[0] for row in rows] == ["6"]
    # Time, gain and slowest mode of each engine, which ran itself.
    for cell in rows[0][1:]:
        seconds, gain, slowest = cell.split(", ")
        assert seconds.endswith(" s")
        assert float(gain) > 0.0
        assert float(slowest) >= 0.1


def test_the_definiteness_benchmark_proves_every_row(small_table):
    rows = small_table("definiteness")
    assert len(rows) == 6
    assert all(" ms" in row[1] for row in rows)
    assert sum("ball arithmetic" in row[1] for row in rows) == 1


@pytest.mark.long
def test_the_benchmark_of_designs_over_a_region_proves_every_row(small_table):
    rows = small_table("over_region")
    assert [row[:2] for row in rows] == [["2", "2"], ["2", "4"]]
    assert all(row[2].endswith(" s") and row[4].rstrip(" |").endswith(" ms") for row in rows)


def test_the_benchmark_of_threads_runs(small_table):
    assert [row[0] for row in small_table("blas_threads")] == ["6"]


@pytest.mark.parametrize("name", ["evaluate", "run_on_data"])
def test_the_benchmarks_of_running_run(name, printed):
    """Their own comparisons with python-control hold, and every rate is a number."""
    row = printed(name, "--small").splitlines()[-1].strip("| ").split(" | ")
    assert row[0] == "4"
    assert len(row) == 5
    assert all(float(cell.replace(",", "")) > 0.0 for cell in row[1:])


@pytest.mark.long
def test_the_benchmark_of_the_start_runs(small_table):
    rows = small_table("start")
    assert len(rows) == 6
    assert all(float(cell) > 0.0 for row in rows for cell in row[1:])


@pytest.mark.long
def test_the_gate_runs_and_has_a_bound_for_each_of_its_cases(printed):
    import json

    bounds = json.loads((ROOT / "benchmarks" / "gate_bounds.json").read_text())
    (rows,) = tables(printed("gate", "--small", "--commit", "0"))
    assert len(bounds) == 13
    found = [re.sub(r"\d+, |of \d+$", "", line[0]) for line in rows[1:]]
    wanted = [re.sub(r"\d+, |of \d+$", "", name) for name in bounds]
    assert found == [name for name in wanted if name in found]
    assert len(found) >= 12  # without numba one is left out
    for line in rows[1:]:
        assert float(line[4]) > 0.0


@pytest.mark.long
def test_every_goal_of_speed_is_measured_and_judged(printed):
    pytest.importorskip("numba")
    (rows,) = tables(printed("goals", "--small", "--commit", "0"))
    assert len(rows) > 20
    for line in rows[1:]:
        # Where there is a goal there is a verdict; small instances meet what is asked of large ones, or miss it.
        assert (line[5] == "-") == (line[6] == "-")
        assert line[6] in ("-", "yes", "**no**")
        assert min(map(float, line[3].split(", "))) > 0.0


def test_the_gates_table_in_the_readme_is_of_its_cases():
    """Written by ``gate.py --write`` and never by hand: a case that is not in it was added since."""
    import json

    bounds = json.loads((ROOT / "benchmarks" / "gate_bounds.json").read_text())
    text = (
        (ROOT / "benchmarks" / "README.md")
        .read_text()
        .partition("<!-- gate -->")[2]
        .partition("<!-- end of gate -->")[0]
    )
    (rows,) = tables(text)
    assert [line[0] for line in rows[1:]] == list(bounds)


def test_the_benchmark_of_guaranteed_tests_runs(small_table):
    rows = small_table("guaranteed_tests")
    assert [row[:3] for row in rows] == [["4", "3", "14"], ["4", "10", "56"]]
    for *_, verify, _, _, exact, gap in rows:
        assert verify != "fails"
        assert float(exact) > 0.0
        assert 0.0 <= float(gap) < 1e-6

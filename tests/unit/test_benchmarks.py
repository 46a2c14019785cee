"""A small instance of each benchmark runs, so that none can rot; what it measures is no business of a test."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def small_table(name):
    """Return the rows that the small instance of a benchmark prints, cell by cell."""
    script = ROOT / "benchmarks" / f"{name}.py"
    done = subprocess.run([sys.executable, script, "--small"], capture_output=True, text=True, check=True)
    return [line.strip("| ").split(" | ") for line in done.stdout.splitlines()[2:]]


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


def test_the_fault_filter_benchmark_runs():
    script = ROOT / "benchmarks" / "fault_estimation_filter.py"
    done = subprocess.run([sys.executable, script, "--small"], capture_output=True, text=True, check=True)
    speed, growth, verified, constraints, networks = tables(done.stdout)
    assert [line[0] for line in speed[1:]] == ["6, brief", "6, noise", "6, delay"]
    for line in speed[1:]:
        # gamma of every way, relative to the best: the bisection ends within 1e-4, the scripts lose 1e-6 of strictness.
        distances = [float(cell.split(", ")[1]) for cell in line[2:6]]
        assert max(distances[:2]) <= 1e-5
        assert max(distances) <= 1e-2
    assert [line[-1] for line in growth[1:]] == ["True", "True"]
    assert [line[1] for line in verified[1:]] == ["2 of 2"] * 3
    assert [line[1] for line in constraints[1:]] == ["1 of 1"] * 3
    assert [line[4] for line in networks[1:]] == ["True"]


def test_the_false_alarm_benchmark_runs():
    script = ROOT / "benchmarks" / "false_alarms.py"
    done = subprocess.run([sys.executable, script, "1"], capture_output=True, text=True, check=True)
    rows = [line.strip("| ").split(" | ") for line in done.stdout.splitlines()[3:]]
    assert len(rows) == 6
    for _, *cells in rows:
        for cell in cells:
            shares = [float(share) for share in cell.split(" / ")]
            assert len(shares) == 3
            # One run: an alarm or none, and none at a small probability without one at a larger.
            assert set(shares) <= {0.0, 100.0}
            assert shares == sorted(shares)


def test_the_unknown_input_observer_benchmark_runs():
    (row,) = small_table("ui_pi_observer")
    rates = [float(cell.split(", ")[1].split()[0]) for cell in row[1:]]
    assert row[0] == "16"
    assert min(rates[:3]) > max(rates[3], 0.0)


def test_the_pd_observer_benchmark_runs():
    rows = small_table("pd_observer")
    assert [row[0] for row in rows] == ["6"]
    # Time, gain and slowest mode of each engine, which ran itself.
    for cell in rows[0][1:]:
        seconds, gain, slowest = cell.split(", ")
        assert seconds.endswith(" s")
        assert float(gain) > 0.0
        assert float(slowest) >= 0.1


def test_the_definiteness_benchmark_proves_every_row():
    rows = small_table("definiteness")
    assert len(rows) == 6
    assert all(" ms" in row[1] for row in rows)
    assert sum("ball arithmetic" in row[1] for row in rows) == 1


def test_the_benchmark_of_threads_runs():
    assert [row[0] for row in small_table("blas_threads")] == ["6"]


@pytest.mark.parametrize("name", ["evaluate", "run_on_data"])
def test_the_benchmarks_of_running_run(name):
    """Their own comparisons with python-control hold, and every rate is a number."""
    script = ROOT / "benchmarks" / f"{name}.py"
    done = subprocess.run([sys.executable, script, "--small"], capture_output=True, text=True, check=True)
    row = done.stdout.splitlines()[-1].strip("| ").split(" | ")
    assert row[0] == "4"
    assert len(row) == 5
    assert all(float(cell.replace(",", "")) > 0.0 for cell in row[1:])


def test_the_benchmark_of_the_start_runs():
    rows = small_table("start")
    assert len(rows) == 6
    assert all(float(cell) > 0.0 for row in rows for cell in row[1:])


def test_the_gate_runs_and_has_a_bound_for_each_of_its_cases():
    import json

    script, bounds = ROOT / "benchmarks" / "gate.py", json.loads((ROOT / "benchmarks" / "gate_bounds.json").read_text())
    done = subprocess.run(
        [sys.executable, script, "--small", "--commit", "0"], capture_output=True, text=True, check=True
    )
    (rows,) = tables(done.stdout)
    assert len(bounds) == 12
    found = [re.sub(r"\d+, |of \d+$", "", line[0]) for line in rows[1:]]
    wanted = [re.sub(r"\d+, |of \d+$", "", name) for name in bounds]
    assert found == [name for name in wanted if name in found]
    assert len(found) >= 11  # without numba one is left out
    for line in rows[1:]:
        assert float(line[4]) > 0.0


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


def test_the_benchmark_of_guaranteed_tests_runs():
    rows = small_table("guaranteed_tests")
    assert [row[:3] for row in rows] == [["4", "3", "14"], ["4", "10", "56"]]
    for *_, verify, _, _, exact, gap in rows:
        assert verify != "fails"
        assert float(exact) > 0.0
        assert 0.0 <= float(gap) < 1e-6

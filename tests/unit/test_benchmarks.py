"""A small instance of each benchmark runs, so that none can rot; what it measures is no business of a test."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def test_the_fault_filter_benchmark_runs():
    script = ROOT / "benchmarks" / "fault_estimation_filter.py"
    done = subprocess.run([sys.executable, script, "--small"], capture_output=True, text=True, check=True)
    rows = [line.strip("| ").split(" | ") for line in done.stdout.splitlines()[2:]]
    assert [row[0] for row in rows] == ["6"]
    gains = [float(cell.split(", ")[1]) for cell in rows[0][1:]]
    # The bisection ends within 1e-4 of the least gain, the others much closer.
    assert max(gains) <= min(gains) * (1.0 + 2e-4)


def test_the_unknown_input_observer_benchmark_runs():
    script = ROOT / "benchmarks" / "ui_pi_observer.py"
    done = subprocess.run([sys.executable, script, "--small"], capture_output=True, text=True, check=True)
    (row,) = [line.strip("| ").split(" | ") for line in done.stdout.splitlines()[2:]]
    rates = [float(cell.split(", ")[1].split()[0]) for cell in row[1:]]
    assert row[0] == "16"
    assert min(rates[:3]) > max(rates[3], 0.0)


@pytest.mark.parametrize("name", ["evaluate", "run_on_data"])
def test_the_benchmarks_of_running_run(name):
    """Their own comparisons with python-control hold, and every rate is a number."""
    script = ROOT / "benchmarks" / f"{name}.py"
    done = subprocess.run([sys.executable, script, "--small"], capture_output=True, text=True, check=True)
    row = done.stdout.splitlines()[-1].strip("| ").split(" | ")
    assert row[0] == "4"
    assert len(row) == 5
    assert all(float(cell.replace(",", "")) > 0.0 for cell in row[1:])

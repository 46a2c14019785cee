"""`import obsynth` and ``--help`` stay fast: what is heavy is loaded only when it is used."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

HEAVY = (
    "casadi", "control", "cvxpy", "flint", "matplotlib", "numba", "numpy", "pandas", "pyarrow", "pydantic",
    "scipy.linalg", "slycot",
)  # fmt: skip
SOURCE = Path(__file__).parents[2] / "src"

IMPORT = "import obsynth"
DESIGN_HELP = "from obsynth.cli.main import design_command as run; arguments = ['--help']"
OBSYNTH_HELP = "from obsynth.cli.main import main as run; arguments = ['--help']"
CHECK_HELP = "from obsynth.cli.main import main as run; arguments = ['check', '--help']"
SIMULATE_HELP = "from obsynth.cli.main import main as run; arguments = ['simulate', '--help']"
VERSION = "from obsynth.cli.main import main as run; arguments = ['--version']"
RUN = """
try:
    run(arguments)
except SystemExit as end:
    print('exit code', end.code)
"""
SHOW = "import sys; print('LOADED', [name for name in {names!r} if name in sys.modules])"


def loaded_modules(program: str, names: tuple[str, ...]) -> str:
    """Run a program in a fresh interpreter; return the line that says which of ``names`` it loaded."""
    code = "\n".join([program, SHOW.format(names=names)])
    path = os.pathsep.join([str(SOURCE), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": path},
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()[-1]


@pytest.mark.parametrize(
    "program",
    [IMPORT, DESIGN_HELP + RUN, OBSYNTH_HELP + RUN, CHECK_HELP + RUN, SIMULATE_HELP + RUN, VERSION + RUN],
    ids=[
        "import obsynth",
        "design --help",
        "obsynth --help",
        "obsynth check --help",
        "obsynth simulate --help",
        "obsynth --version",
    ],
)
def test_nothing_heavy_is_loaded(program: str) -> None:
    assert loaded_modules(program, HEAVY) == "LOADED []"


def test_a_short_record_is_run_without_numba() -> None:
    run = (
        "import numpy as np, obsynth; from obsynth.observers.recursive.observer import RecursiveObserver; "
        "from obsynth.plants.sequences import MatrixSequence as M; one = np.eye(1); "
        "plant = obsynth.TimeVaryingDescriptorSystem(None, one, one, one, dt=1.0); "
        "RecursiveObserver(plant, M.of(one, 'Q'), M.of(one, 'R'), [0.0], one, None).run(np.ones(9), np.ones(9))"
    )
    assert loaded_modules(run, ("numba",)) == "LOADED []"


def test_the_help_was_really_run() -> None:
    """The probe above sees modules that are loaded, and the programs do end in their help."""
    assert loaded_modules("import scipy.linalg", HEAVY) == "LOADED ['numpy', 'scipy.linalg']"
    assert (
        loaded_modules(DESIGN_HELP + RUN, ("obsynth.cli.main", "argparse")) == "LOADED ['obsynth.cli.main', 'argparse']"
    )


def test_a_run_of_a_linear_gain_set_loads_nothing_heavy(tmp_path):
    """No data frames, no pictures, no solver: what a controller's computer would wait for.

    The gain set is verified again, which takes proofs and scipy: its own report is no signature."""
    import subprocess
    import sys

    import obsynth

    plant = obsynth.DescriptorSystem(None, [[0.5]], C=[[1.0]], Bf=[[1.0]], dt=1.0)
    obsynth.fault_estimation_filter(plant).save(tmp_path / "gains.json")
    (tmp_path / "log.csv").write_text("time;y1\n0;0,5\n1;0,25\n")
    heavy = (
        "pandas",
        "matplotlib",
        "casadi",
        "cvxpy",
        "clarabel",
        "control",
        "numba",
        "rich",
        "pydantic",
        "obsynth.analysis.structure",
    )
    code = (
        "import sys\nfrom obsynth.cli.main import main\n"
        "code = main(['run', '--gains', 'gains.json', '--data', 'log.csv', '--out', 'out.csv', '--quiet'])\n"
        f"print(code, [name for name in {heavy!r} if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert done.stdout.split(maxsplit=1) == ["0", "[]\n"]


def test_a_design_with_default_options_needs_no_semidefinite_solver() -> None:
    """The README's first command; its least gain is proved all the same. Of SciPy it takes LAPACK alone."""
    spec = SOURCE.parent / "designs" / "wang2015" / "spec.yaml"
    design = (
        f"import obsynth; spec = obsynth.load_spec({str(spec)!r}); "
        "design = obsynth.fault_estimation_filter(spec.plant); print(design.report['least gain'].status); "
        "assert design.report['least gain'].status == 'proved'"
    )
    heavy = ("cvxpy", "clarabel", "matplotlib", "pandas", "scipy.linalg.lapack", "scipy.sparse")
    assert loaded_modules(design, heavy) == "LOADED []"

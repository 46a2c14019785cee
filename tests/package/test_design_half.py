"""The design half is whole without the rooms on data and on many designs: both are deleted in a copy of the package."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from shutil import copytree, ignore_patterns, rmtree
from typing import Any

import pytest

import obsynth

SOURCE = Path(obsynth.__file__).parent
SPECS = sorted((SOURCE.parents[1] / "designs").rglob("spec*.yaml"))

#: What a spec comes to by Python: its design, verified again, exported, on a page and simulated.
PROGRAM = """
import json, sys
from pathlib import Path
import obsynth
from obsynth.specs.loader import design_of_spec

spec = obsynth.load_spec(sys.argv[1])
design = design_of_spec(spec, progress=lambda text: None)
assert obsynth.verify(design).passed
design.save("design.gains.json")
design = obsynth.load("design.gains.json")
varies = isinstance(design.plant, obsynth.TimeVaryingDescriptorSystem) and not design.plant.is_time_invariant
constant = isinstance(design.observer, (obsynth.LinearObserver, obsynth.RecursiveObserver))
files = [] if varies else obsynth.export(design, "design.npz" if constant else "design.c")
obsynth.html_report(design, "design.html", scenario=spec.scenario)
if spec.scenario is not None:
    obsynth.simulate(design, spec.scenario).summary()
loaded = [name for name in sys.modules if name.startswith(("obsynth.monitoring", "obsynth.studies"))]
page = Path("design.html").stat().st_size
print(json.dumps({"files": list(map(str, files)), "varies": varies, "loaded": loaded, "page": page}))
"""


@pytest.fixture(scope="module")
def design_half(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a copy of the package without monitoring and studies."""
    folder = tmp_path_factory.mktemp("half")
    copytree(SOURCE, folder / "obsynth", ignore=ignore_patterns("__pycache__"))
    for room in ("monitoring", "studies"):
        rmtree(folder / "obsynth" / room)
    return folder


def run(half: Path, cwd: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Run Python with that copy alone."""
    place = {**os.environ, "PYTHONPATH": str(half)}
    return subprocess.run([sys.executable, *words], cwd=cwd, env=place, capture_output=True, text=True, check=False)


def command(half: Path, cwd: Path, *words: str) -> str:
    """Run a command of obsynth, which must succeed."""
    done = run(half, cwd, "-m", "obsynth", *words)
    assert done.returncode == 0, (words, done.stderr)
    return done.stdout


def test_the_copy_is_what_runs_and_lacks_both_rooms(design_half: Path, tmp_path: Path) -> None:
    done = run(design_half, tmp_path, "-c", "import obsynth; print(obsynth.__file__); obsynth.run_on_data")
    assert done.stdout.strip() == str(design_half / "obsynth" / "__init__.py")
    assert "obsynth.monitoring" in done.stderr
    listed = command(design_half, tmp_path, "--help")
    assert "simulate" in listed
    assert not any(verb in listed for verb in ("calibrate", "sweep"))


@pytest.mark.long
def test_every_shipped_spec_is_designed_by_python(
    design_half: Path, tmp_path: Path, share: Callable[..., Sequence[Any]]
) -> None:
    for number, spec in enumerate(share(SPECS, 12)):
        folder = tmp_path / str(number)
        folder.mkdir()
        done = run(design_half, folder, "-c", PROGRAM, str(spec))
        assert done.returncode == 0, (spec, done.stderr)
        found = json.loads(done.stdout.splitlines()[-1])
        assert found["loaded"] == [], spec
        assert found["page"] > 0, spec
        assert found["varies"] or found["files"], spec


@pytest.mark.long
def test_every_shipped_spec_is_designed_by_the_command_line(
    design_half: Path, tmp_path: Path, share: Callable[..., Sequence[Any]]
) -> None:
    program = "import sys; from obsynth.cli.main import design_command; sys.exit(design_command(sys.argv[1:]))"
    for number, spec in enumerate(share(SPECS, 12)):
        folder = tmp_path / str(number)
        folder.mkdir()
        done = run(design_half, folder, "-c", program, "--system", str(spec), "--output", "design.gains.json")
        assert done.returncode == 0, (spec, done.stderr)
        command(design_half, folder, "check", "--system", str(spec))
        command(design_half, folder, "verify", "design.gains.json")
        command(design_half, folder, "report", "--gains", "design.gains.json", "--out", "page.html")
        if obsynth.load_spec(spec).scenario is not None:
            command(design_half, folder, "simulate", "--system", str(spec), "--gains", "design.gains.json")

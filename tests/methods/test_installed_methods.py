"""A method of another package: installed, found by its entry point, and known everywhere; the example of the site."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import cvxpy as cp
import numpy as np
import pytest

import obsynth
from obsynth.methods.installed import OWN, REGISTRY
from obsynth.methods.registry import method_class

pytestmark = pytest.mark.long

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "docs/examples/h2_filter"


@pytest.fixture(scope="module")
def installed(tmp_path_factory) -> Path:
    """Install the example package, into a folder of its own."""
    folder = tmp_path_factory.mktemp("installed")
    shutil.copytree(EXAMPLE, folder / "source")
    command = [
        sys.executable, "-m", "pip", "install", "--quiet", "--no-deps",
        "--disable-pip-version-check", "--target", str(folder / "site"), str(folder / "source"),
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return folder / "site"


def run(installed: Path, folder: Path, *arguments: str) -> str:
    """Run Python in a folder where the package can be found; return what it printed."""
    path = os.pathsep.join([str(installed), str(ROOT / "src"), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        [sys.executable, *arguments], cwd=folder, capture_output=True, text=True, check=False,
        env={**os.environ, "PYTHONPATH": path},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr + done.stdout
    return done.stdout


@pytest.fixture(scope="module")
def designed(installed, tmp_path_factory) -> Path:
    """The H2 filter within a disk of .3 on the plant of Wang et al., by the command line; then corrupted claims."""
    folder = tmp_path_factory.mktemp("designed")
    plant = ROOT / "designs/wang2015/plant.yaml"
    (folder / "spec.yaml").write_text(
        f"schema_version: 1\nname: h2\nplant: {{file: {plant}}}\nmethod: {{id: h2-filter, options: {{radius: 0.3}}}}\n"
    )
    script = (
        "from obsynth.cli.main import main\n"
        "assert main(['design', '--system', 'spec.yaml', '--quiet']) == 0\n"
        "assert main(['verify', 'h2.gains.json']) == 0\n"
        "assert main(['check', '--system', 'spec.yaml']) == 0\n"
        "assert main(['export', '--gains', 'h2.gains.json', '--to', 'filter.c']) == 0\n"
        "assert main(['report', '--gains', 'h2.gains.json', '--out', 'report.html']) == 0\n"
        "try: main(['design', '--help'])\n"
        "except SystemExit: pass\n"
        "import obsynth\n"
        "design = obsynth.load('h2.gains.json')\n"
        "claims = dict(design.certificate.claims)\n"
        "for name in ('h2_norm', 'radius'):\n"
        "    worse = obsynth.Certificate(design.certificate.matrices, {**claims, name: 0.9 * claims[name]})\n"
        "    print([row.name for row in obsynth.verify(design.replace(certificate=worse)).failures])\n"
    )
    (folder / "told.txt").write_text(run(installed, folder, "-c", script))
    return folder


def test_design_verify_check_export_report_and_help_know_it(designed):
    told = (designed / "told.txt").read_text()
    assert told.count("h2-filter") >= 3  # check, design's help and the design itself
    assert "H2 norm from the disturbances" in (designed / "report.html").read_text()
    assert "Scherer" in (designed / "report.html").read_text()
    assert "void" in (designed / "filter.c").read_text()


def test_its_norm_is_that_of_plain_cvxpy(designed):
    """The same problem written out here, without obsynth."""
    plant = obsynth.load_spec(ROOT / "designs/wang2015/spec.yaml").plant
    E, A, C, F, D = plant.E, plant.A, plant.C, plant.Bf, plant.Bd
    S = np.hstack([np.eye(4), C.T])
    stacked = np.vstack([E, C])
    M = np.linalg.pinv(stacked) + S @ (np.eye(7) - stacked @ np.linalg.pinv(stacked))
    T = M[:, :4]
    Psi = T @ F
    Upsilon = C @ Psi
    W = np.linalg.pinv(Upsilon)
    V = np.linalg.svd(Upsilon.T)[2][2:]
    A1, C1, TD, Z0 = T @ A - T @ A @ Psi @ W @ C, V @ C, T @ D, W @ C
    P, Y, Z = cp.Variable((4, 4), symmetric=True), cp.Variable((4, 1)), cp.Variable((1, 1), symmetric=True)
    moved = P @ A1 - Y @ C1
    constraints = [
        cp.bmat([[P - Z0.T @ Z0, moved.T], [moved, P]]) >> 0,
        cp.bmat([[Z, (P @ TD).T], [P @ TD, P]]) >> 0,
        cp.bmat([[0.3 * P, moved.T], [moved, 0.3 * P]]) >> 0,
    ]
    problem = cp.Problem(cp.Minimize(cp.trace(Z)), constraints)
    problem.solve(solver="CLARABEL")
    gains = json.loads((designed / "h2.gains.json").read_text())
    claimed = gains["design"]["certificate"]["claims"]["h2_norm"]
    R = np.linalg.solve(P.value, Y.value)
    loop = A1 - R @ C1
    gram, power = np.zeros((4, 4)), TD
    for _ in range(400):
        gram, power = gram + power @ power.T, loop @ power
    assert claimed == pytest.approx(float(np.sqrt(np.trace(Z0 @ gram @ Z0.T))), rel=1e-6)
    assert np.abs(np.linalg.eigvals(loop)).max() < 0.3
    assert gains["design"]["certificate"]["claims"]["radius"] < 0.3


def test_the_example_fits_on_a_page():
    assert len((EXAMPLE / "h2_filter.py").read_text().splitlines()) <= 100


def test_a_corrupted_claim_is_found(designed):
    assert (designed / "told.txt").read_text().splitlines()[-2:] == ["['h2_norm']", "['radius']"]


def test_what_cannot_be_loaded_is_told(monkeypatch):
    monkeypatch.setitem(REGISTRY, "broken", "no_such_package:Method")
    with pytest.raises(obsynth.SpecError, match=r"'broken' is registered as 'no_such_package:Method', which cannot be"):
        method_class("broken")
    monkeypatch.setitem(REGISTRY, "wrong", "json:JSONDecoder")
    with pytest.raises(obsynth.SpecError, match=r"no class derived from obsynth.methods.method.Method with the id"):
        method_class("wrong")
    with pytest.raises(obsynth.SpecError, match=r"There is no method 'nothing'. .* There are: fault-estimation-filter"):
        method_class("nothing")


def test_our_own_ids_stay_ours(monkeypatch):
    from importlib import metadata

    entry = metadata.EntryPoint("pd-observer", "json:JSONDecoder", "obsynth.methods")
    other = metadata.EntryPoint("another", "json:JSONDecoder", "obsynth.methods")
    monkeypatch.setattr(metadata, "entry_points", lambda group: [entry, other])
    found = type(REGISTRY)()
    assert "another" in found
    assert found["pd-observer"] == OWN["pd-observer"]
    assert list(found) == [*OWN, "another"]

"""Each linear method, from a paper's spec and from a power network's: design, run, report and export."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import obsynth
from obsynth.cli.main import main

ROOT = Path(__file__).parents[2]
ROWS = 40


@pytest.mark.parametrize(
    "spec",
    [
        "wang2015/spec.yaml", "smib/spec.yaml", "filasova/spec.yaml", "smib/pd_observer.yaml", "sharepasand/spec.yaml",
        "kundur/spec.yaml",
    ],
)  # fmt: skip
def test_a_design_has_the_same_life_whatever_its_method(spec, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["design", "--system", str(ROOT / "designs" / spec), "--output", "gains.json", "--quiet"]) == 0
    _, observer = obsynth.load("gains.json").linear
    step = observer.dt or 0.02
    names = [*observer.input_names, *observer.output_names]
    table = pd.DataFrame(1e-3 * np.random.default_rng(0).normal(size=(ROWS, len(names))), columns=names)
    table.insert(0, "time", step * np.arange(ROWS))
    table.to_csv("log.csv", index=False)

    gains = ["--gains", "gains.json"]
    assert main(["run", *gains, "--data", "log.csv", "--out", "estimates.csv"]) == 0
    sampling = [] if observer.dt else ["--sample-time", str(step)]
    assert main(["export", *gains, "--to", "observer.c", *sampling]) == 0
    assert main(["export", *gains, "--to", "observer.mat"]) == 0
    assert main(["report", *gains, "--out", "report.html"]) == 0
    found = pd.read_csv("estimates.csv")
    estimates = found[[name for name in found.columns if name.startswith(("xhat[", "fhat[", "r["))]]
    assert estimates.shape == (ROWS, observer.Cz.shape[0])
    assert np.isfinite(estimates.to_numpy()).all()
    assert "Verified: all" in Path("report.html").read_text(encoding="utf-8")

"""Each linear method, from a paper's spec and from a power network's: design, simulate, run, report and export."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import obsynth
from obsynth.cli.main import main

ROOT = Path(__file__).parents[2]
#: Horizons of shorter scenarios for specs whose own are long.
SCENARIOS = {
    "filasova/spec.yaml": 4,
    "smib/spec.yaml": 2,
    "kundur/spec.yaml": 2,
    "smib/pd_observer.yaml": 2,
    "sharepasand/spec.yaml": 8,
    "moussaali2013_ltv/spec.yaml": 299,
    "smib/spec_inertia.yaml": 20,
}
#: Shorter horizons of plants that vary with time, in samples: a design goes along all of them.
HORIZONS = {
    "moussaali2013_ltv/spec.yaml": ("plant.yaml", "horizon: 1000", "horizon: 300"),
    "smib/spec_inertia.yaml": ("plant_inertia.yaml", "horizon: 2000", "horizon: 1020"),
}
PAPERS_AND_NETWORKS = (
    "wang2015/spec.yaml", "smib/spec.yaml", "filasova/spec.yaml", "smib/pd_observer.yaml", "sharepasand/spec.yaml",
    "kundur/spec.yaml", "moussaali2013_ltv/spec.yaml", "smib/spec_inertia.yaml",
)  # fmt: skip
#: The descriptor Kalman filter and the adaptive observer for the network of designs/smib, without its unknown load.
NETWORK = """\
schema_version: 1
name: network
plant:
  dt: 0
  E: {{file: {folder}/E.mtx}}
  A: {{file: {folder}/A.mtx}}
  state_names: {{file: {folder}/names.json}}
  C: {{outputs: [omega GENCLS 1, a Bus 1, v Bus 1]}}
  Bf: {{states: [tm GENCLS 1]}}
  sensor_noise: {{omega GENCLS 1: 1.0e-4, a Bus 1: 1.0e-3, v Bus 1: 1.0e-3}}
  operating_point: {{v Bus 1: 1.03, a Bus 1: 0.2, v Bus 3: 0.99}}
  transform: {{eliminate_algebraic_states: true, sample_time: 0.02}}
method: {{id: {method}, options: {{Q: {Q}}}}}
scenario:
  horizon: 4
  faults: {{tm GENCLS 1: {{kind: step, size: 0.1, start: 2}}}}
  noise: 1
"""
Q = [[1e-10 if i == j else 0 for j in range(4)] for i in range(4)]


def spec_of(name: str, folder: Path) -> Path:
    """Return a spec, its scenario shortened: the folder of the design is copied."""
    source = ROOT / "designs" / name
    if name not in SCENARIOS:
        return source
    for file in source.parent.iterdir():
        (folder / file.name).write_bytes(file.read_bytes())
    if name in HORIZONS:
        plant, own, shorter = HORIZONS[name]
        text = (folder / plant).read_text(encoding="utf-8")
        assert text.count(own) == 1
        (folder / plant).write_text(text.replace(own, shorter), encoding="utf-8")
    text = source.read_text(encoding="utf-8").split("scenario:")[0]
    own = source.read_text(encoding="utf-8").partition("scenario:")[2]
    target = folder / source.name
    horizon = re.search(r"horizon: ([\d.]+)", own)
    assert horizon is not None
    share = SCENARIOS[name] / float(horizon[1])
    shorter = re.sub(r"\b(horizon|start|end): ([\d.]+)", lambda time: f"{time[1]}: {share * float(time[2]):g}", own)
    target.write_text(f"{text}scenario:{shorter}", encoding="utf-8")
    return target


def lives(spec: Path) -> tuple[obsynth.ObserverDesign, pd.DataFrame, pd.DataFrame]:
    """Design, simulate, run on what the simulation wrote, report; return the design and both tables."""
    assert main(["design", "--system", str(spec), "--output", "gains.json", "--quiet"]) == 0
    gains = ["--gains", "gains.json"]
    assert main(["simulate", "--system", str(spec), *gains, "--out", "simulated.csv", "--quiet"]) == 0
    assert main(["run", *gains, "--data", "simulated.csv", "--out", "estimates.csv"]) == 0
    assert main(["report", *gains, "--out", "report.html"]) == 0
    assert "Verified: all" in Path("report.html").read_text(encoding="utf-8")
    return obsynth.load("gains.json"), pd.read_csv("simulated.csv"), pd.read_csv("estimates.csv")


@pytest.mark.one_in(9)
@pytest.mark.parametrize("name", PAPERS_AND_NETWORKS)
def test_a_design_has_the_same_life_whatever_its_method(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    design, simulated, found = lives(spec_of(name, tmp_path))
    assert len(found) == len(simulated)
    names = [column for column in simulated.columns if column.startswith(("xhat[", "fhat["))]
    # The run begins at rest, the simulation where its scenario says: what is left of that decays.
    late = slice(-len(found) // 4, None)
    for column in names:
        at = design.plant.operating_point.get(column[5:-1], 0.0)
        size = np.abs(simulated[column].to_numpy()).max()
        away = np.abs(found[column].to_numpy() - at - simulated[column].to_numpy())[late].max()
        assert away <= 0.05 * size, column
    recovered = [f"xhat[{state}]" for state in (design.recovery.names if design.recovery is not None else ())]
    assert set(recovered) <= set(found.columns)
    export_as_far_as_it_goes(design)


def export_as_far_as_it_goes(design: obsynth.ObserverDesign) -> None:
    gains, sampling = ["--gains", "gains.json"], []
    if design.method in ("adaptive-observer", "descriptor-kalman") and not design.plant.is_time_invariant:
        assert main(["export", *gains, "--to", "observer.c"]) == 2
        assert not Path("observer.c").exists()
        return
    if isinstance(design.observer, obsynth.LinearObserver) and not design.observer.dt:
        sampling = ["--sample-time", "0.02"]
    for target in ("observer.c", "observer.mat", "observer.npz"):
        assert main(["export", *gains, "--to", target, *(sampling if target == "observer.c" else [])]) == 0
        assert Path(target).exists()
    assert design.to_control().ninputs == len(design.plant.input_names) + len(design.plant.output_names)


@pytest.mark.long
@pytest.mark.parametrize("method", ["descriptor-kalman", "adaptive-observer"])
def test_recursive_methods_on_a_network_with_an_operating_point(method, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for file in ("E.mtx", "A.mtx", "names.json"):
        Path(file).write_bytes((ROOT / "designs/smib" / file).read_bytes())
    Path("network.yaml").write_text(NETWORK.format(folder=".", method=method, Q=Q), encoding="utf-8")
    design, simulated, _ = lives(Path("network.yaml"))
    # A log has absolute values, and so has what simulate writes.
    logged = simulated[["time", *design.plant.output_names]].copy()
    for name, value in {"v Bus 1": 1.03, "a Bus 1": 0.2}.items():
        assert abs(logged[name].iloc[:20].mean() - value) < 0.02
    logged.to_csv("log.csv", index=False)
    monitor = ["--monitor", "nis"] if method == "descriptor-kalman" else ["--monitor", "chi-square"]
    capsys.readouterr()
    assert main(["run", "--gains", "gains.json", "--data", "log.csv", "--out", "out.csv", "--warm-up", "1", *monitor,
                 "--json"]) == 0  # fmt: skip
    printed = json.loads(capsys.readouterr().out)
    assert printed["warnings"] == []
    assert len(printed["recovered"]) == 30
    found = pd.read_csv("out.csv")
    plain = pd.read_csv("estimates.csv")
    truth = simulated["x[delta GENCLS 1]"].iloc[60:100]
    assert np.abs(found["xhat[delta GENCLS 1]"].iloc[60:100] - truth).max() < 0.01
    # A bus that nobody measures, by the recovery, at its own operating point.
    assert abs(found["xhat[v Bus 3]"].iloc[60:100].mean() - 0.99) < 1e-3
    assert plain["status"].iloc[-1] == "ok"
    assert printed["monitor"]["kind"] in printed["alarms"]
    assert printed["alarms"][printed["monitor"]["kind"]] >= 2.0
    if method == "adaptive-observer":
        assert printed["isolated"] == "tm GENCLS 1"
        assert found["fhat[tm GENCLS 1]"].iloc[-1] == pytest.approx(0.1, abs=0.03)
    export_as_far_as_it_goes(design)

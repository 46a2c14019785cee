"""What a design states about outliers is the rule of every run: on data, by the command line, from a file, as C or FMU.

A stated value that equals the default of the observer counts as stated; without any, runs on data leave outliers out.
"""

from __future__ import annotations

import re
from inspect import signature

import numpy as np
import pandas as pd
import pytest

import obsynth
from obsynth.cli.main import main
from obsynth.exporting.dae_c_source import dae_alarms, dae_c_texts
from obsynth.observers.changed_options import changed

LINEAR = obsynth.DescriptorSystem(
    A=[[0.9]], B=[[0.1]], C=[[1.0]], Bf=[[0.1]], dt=1.0, input_names=["u"], output_names=["y"], fault_names=["p"]
)


def tank(**more):
    equation = "der(level) = u - p * level" if "parameters" in more else "der(level) = u - 0.5 * level"
    return obsynth.DAEModel({"tank": equation}, {"y": "level"}, states={"level": 1.0}, inputs={"u": 0.5}, **more)


def kalman(**options):
    return obsynth.descriptor_kalman(LINEAR, Q=1e-3, R=1e-2, **options)


def adaptive(**options):
    return obsynth.adaptive_observer(LINEAR, Q=1e-3, R=1e-2, **options)


def extended(**options):
    return obsynth.extended_kalman(tank(), dt=1.0, Q=1e-4, R=1e-2, **options)


def nonlinear(**options):
    return obsynth.dae_adaptive_observer(tank(parameters={"p": 0.5}), dt=1.0, Q=1e-4, R=1e-2, **options)


pytestmark = pytest.mark.usefixtures("taken_as_verified")

DESIGNS = {"kalman": kalman, "adaptive": adaptive, "extended": extended, "nonlinear": nonlinear}
STATED = [None, "none", "gate", "huber"]


def log():
    y = 1.0 + 0.02 * np.random.default_rng(0).standard_normal(60)
    y[40] += 3.0
    return pd.DataFrame({"time": np.arange(60.0), "u": 0.5, "y": y})


def by(design, rule):
    """The observer with a rule, over the whole record."""
    rows = log()
    return np.ravel(changed(design.observer, outliers=rule).run(rows[["y"]].to_numpy(), rows[["u"]].to_numpy()).states)


def states_of(table):
    return table.filter(regex="^xhat").to_numpy().ravel()


@pytest.mark.one_in(4)
@pytest.mark.parametrize("stated", STATED)
@pytest.mark.parametrize("kind", DESIGNS)
def test_every_run_follows_what_is_stated(kind, stated, tmp_path):
    design = DESIGNS[kind]() if stated is None else DESIGNS[kind](outliers=stated)
    wanted = by(design, stated or "gate")
    others = [by(design, rule) for rule in ("none", "gate", "huber") if rule != (stated or "gate")]
    assert all(np.abs(other - wanted).max() > 1e-3 for other in others)
    np.testing.assert_allclose(states_of(obsynth.run_on_data(design, log()).table), wanted, atol=1e-9)
    # Asked for at the run, another rule is taken.
    for rule in ("none", "gate", "huber"):
        np.testing.assert_allclose(
            states_of(obsynth.run_on_data(design, log(), outliers=rule).table), by(design, rule), atol=1e-9
        )
    # From a file, and by the command line.
    path = design.save(tmp_path / "gains.json")
    again = obsynth.load(path)
    assert again.options["outliers"] == stated
    np.testing.assert_allclose(states_of(obsynth.run_on_data(again, log()).table), wanted, atol=1e-9)
    log().to_csv(tmp_path / "log.csv", index=False)
    done = main(["run", "--gains", str(path), "--data", str(tmp_path / "log.csv"), "--out", str(tmp_path / "out.csv")])
    assert done == 0
    np.testing.assert_allclose(states_of(pd.read_csv(tmp_path / "out.csv")), wanted, atol=1e-6)
    # In parts, the state kept in a file.
    first, rest = log()[:35], log()[35:]
    tables = [obsynth.run_on_data(design, part, state=tmp_path / "state.json").table for part in (first, rest)]
    np.testing.assert_allclose(np.concatenate([states_of(table) for table in tables]), wanted, atol=1e-9)


@pytest.mark.long
@pytest.mark.parametrize("kind", ["extended", "nonlinear"])
def test_c_and_fmu_are_made_from_the_same_rule(kind):
    """Both are written from these texts."""

    def text(stated, asked=None):
        design = DESIGNS[kind](**({} if stated is None else {"outliers": stated}))
        source = dae_c_texts(design, "a", "a.h", dae_alarms(design, None, None, None), asked)[0]
        # What comes before names the gain set.
        return source.partition("#include")[2]

    assert text(None) == text("gate")
    assert len({text("none"), text("gate"), text("huber")}) == 3
    assert text("huber", "none") == text("none", "none") == text("none")


@pytest.mark.long
@pytest.mark.parametrize("kind", ["extended", "nonlinear"])
@pytest.mark.parametrize("asked", [None, 7.0])
def test_the_warm_up_of_a_run_is_that_of_c(kind, asked):
    design = DESIGNS[kind]()
    rows = obsynth.run_on_data(design, log(), warm_up=asked).table
    begins = float((rows["status"] == "warm-up").sum())
    source = "".join(dae_c_texts(design, "a", "a.h", dae_alarms(design, None, asked, None), None))
    (written,) = re.findall(r"#define WARM_UP_SECONDS (\S+)", source)
    # Rows of 1 s; those up to the warm-up are not decided.
    assert begins == np.ceil(float(written))


@pytest.mark.parametrize("stated", ["gate", "huber"])
def test_an_export_of_a_steady_filter_says_that_it_has_no_rule(stated, tmp_path):
    with pytest.raises(obsynth.SpecError, match="outliers"):
        obsynth.export(kalman(outliers=stated), tmp_path / "a.c")
    assert obsynth.export(kalman(outliers="none"), tmp_path / "b.c")


#: Of each option of `run_on_data`: how the command line says it (a value to try; `None`: by another test), and which
#: argument of `export` is the same rule in C and FMUs, or `None` where it is about the log that these do not read.
OPTIONS = {
    "design": (["--gains"], "design"),
    "data": (["--data"], None),
    "out": (["--out"], None),
    "columns": (["--map", "y=level"], None),
    "time_column": (["--time-column", "t"], None),
    "time_zone": (["--time-zone", "+01:00"], None),
    "time_unit": (["--time-unit", "min"], None),
    "scales": (["--scale", "y=2"], None),
    "thresholds": (["--threshold", "r[innovation 1]=0.5"], "thresholds"),
    "monitor": (["--monitor", "nis"], "monitor"),
    "gap": (["--gap", "5"], None),
    "warm_up": (["--warm-up", "7"], "warm_up"),
    "outliers": (["--outliers", "huber"], "outliers"),
    "smooth": (["--smooth"], None),
    "lag": (["--lag", "3"], None),
    "recovered": (["--recovered"], None),
    "state": (["--state"], None),
    "state_every": (["--state-every", "10"], None),
    "chunk_rows": (None, None),  # memory alone
    "progress": (None, None),  # a function
    "units_as_is": (["--units-as-is"], None),
}
#: What is said in Python of those that are tried, and the log that they need.
TRIED = {
    "columns": ({"y": "level"}, lambda rows: rows.rename(columns={"y": "level"})),
    "time_column": ("t", lambda rows: rows.rename(columns={"time": "t"})),
    "time_unit": ("min", lambda rows: rows.assign(time=rows["time"] / 60.0)),
    "time_zone": ("+01:00", lambda rows: rows.assign(time=pd.date_range("2026-03-01", periods=len(rows), freq="s"))),
    "scales": ({"y": 2.0}, lambda rows: rows),
    "thresholds": ({"r[innovation 1]": 0.5}, lambda rows: rows),
    "warm_up": (7.0, lambda rows: rows),
    "outliers": ("huber", lambda rows: rows),
    "smooth": (True, lambda rows: rows),
    "lag": (3, lambda rows: rows),
    "units_as_is": (True, lambda rows: rows),
    "chunk_rows": (7, lambda rows: rows),
}


def test_every_option_of_a_run_has_its_place_in_the_command_line_and_in_exports():
    assert list(signature(obsynth.run_on_data).parameters) == list(OPTIONS)
    exported = signature(obsynth.export).parameters
    assert {place for _, place in OPTIONS.values() if place} <= set(exported)
    # What `export` has beside is of the files that it writes, and of plants that run on samples.
    rest = set(exported) - {place for _, place in OPTIONS.values()}
    assert rest == {"path", "sample_time", "fmi", "precision", "checker", "unverified"}


@pytest.mark.long
@pytest.mark.parametrize("option", TRIED)
def test_each_option_is_the_same_in_python_and_in_the_command_line(option, tmp_path):
    value, changed_log = TRIED[option]
    design, rows = kalman(), changed_log(log())
    table = obsynth.run_on_data(design, rows, **{option: value}).table
    plain = obsynth.run_on_data(design, log()).table
    names = [name for name in table.columns if name != "time"]
    if option in ("scales", "outliers", "smooth", "lag", "warm_up"):
        same = [name for name in names if name in plain and plain[name].equals(table[name])]
        assert len(same) < len(names), "the option does nothing"
    words = OPTIONS[option][0]
    if words is None:
        pd.testing.assert_frame_equal(table, plain)
        return
    rows.to_csv(tmp_path / "log.csv", index=False, float_format="%.17g")
    path, out = design.save(tmp_path / "gains.json"), tmp_path / "out.csv"
    assert main(["run", "--gains", str(path), "--data", str(tmp_path / "log.csv"), "--out", str(out), *words]) in (0, 7)
    again = pd.read_csv(out)
    assert list(again.columns) == list(table.columns)
    for name in names:
        if table[name].dtype.kind == "f":
            np.testing.assert_allclose(again[name].to_numpy(dtype=float), table[name], atol=1e-6, err_msg=name)
        else:
            assert again[name].fillna("").astype(str).tolist() == table[name].astype(str).tolist(), name

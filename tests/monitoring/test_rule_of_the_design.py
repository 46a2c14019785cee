"""What a design states about outliers is the rule of every run: on data, by the command line, from a file, as C or FMU.

A stated value that equals the default of the observer counts as stated; without any, runs on data leave outliers out.
"""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

import obsynth
from obsynth.cli.main import main
from obsynth.exporting.dae_c_source import dae_alarms, dae_c_texts
from obsynth.observers.running import changed

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


@pytest.mark.parametrize("stated", ["gate", "huber"])
def test_an_export_of_a_steady_filter_says_that_it_has_no_rule(stated, tmp_path):
    with pytest.raises(obsynth.SpecError, match="outliers"):
        obsynth.export(kalman(outliers=stated), tmp_path / "a.c")
    assert obsynth.export(kalman(outliers="none"), tmp_path / "b.c")

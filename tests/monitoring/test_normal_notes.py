"""Events that raise learned levels, and outputs that are stuck: both are told of the rows that are learned from."""

from __future__ import annotations

import itertools
import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from heated_plant import DT, heated
from scipy.signal import lfilter

import obsynth
from obsynth.cli.main import main
from obsynth.monitoring.logs.stuck_sensors import RepeatedValues, Unrepeated, longest_repeats, stuck_rows
from obsynth.monitoring.thresholds.learned_events import Event
from obsynth.monitoring.thresholds.learned_from_rows import Raised
from obsynth.monitoring.thresholds.normal_notes import notes_of_normal_rows

ROWS, EVENT = 1_500, slice(700, 709)
pytestmark = pytest.mark.usefixtures("taken_as_verified")


def log(seed: int, *, memory: float = 0.8, step: float = 0.0, freedom: float = np.inf) -> pd.DataFrame:
    """Return rows without faults; ``step``: of the quantisation of both sensors, ``freedom`` of Student's t."""
    rng = np.random.default_rng(seed)
    drawn = rng.standard_normal((ROWS, 2)) if np.isinf(freedom) else rng.standard_t(freedom, (ROWS, 2))
    noise = 0.01 * lfilter([1.0], [1.0, -memory], drawn, axis=0)
    plant, x, found = heated().plant, np.zeros(2), []
    for k in range(ROWS):
        u = np.array([np.sin(k / 4.0)])
        found.append([k * DT, u[0], *(x + noise[k])])
        x = plant.A @ x + plant.B @ u
    table = pd.DataFrame(found, columns=["time", "u", "ya", "yb"])
    if step:
        table[["ya", "yb"]] = step * np.round(table[["ya", "yb"]] / step)
    return table


def learned(data: pd.DataFrame) -> obsynth.types.LearnedThresholds:
    return obsynth.learn_thresholds(heated(), data, false_alarms="1 per 500 rows")


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.long
def test_an_event_that_raises_the_levels_is_told_with_its_rows(seed: int) -> None:
    data = log(seed)
    usual = learned(data)
    data.loc[EVENT.start : EVENT.stop - 1, "ya"] += 0.3
    raised = learned(data.drop(index=range(300, 310)).reset_index(drop=True))
    (note,) = raised.notes
    first, last, begin, end = (float(part) for part in stretch_of(note))
    # Ten rows are gone before it; the estimate takes a few rows to forget it.
    assert 690 <= first <= 692
    assert 698 <= last <= 704
    assert (begin, end) == (pytest.approx((first + 10) * DT), pytest.approx((last + 10) * DT))
    # What is told is what the levels are, in units in which the noise counts: the whitener has shrunk by the event.
    told = float(note.split("a change ")[1].split()[0])
    ratio = np.sqrt(raised.levels[0] / usual.levels[0]) * usual.statistics.model.whitener[0, 0]
    assert told > 2.0
    assert told >= 0.8 * ratio / raised.statistics.model.whitener[0, 0]


@pytest.mark.parametrize(
    ("factor", "told"),
    [(9.8, "9.8 times smaller"), (150.0, "150 times larger"), (5.6e10, "more than 1000 times larger")],
)
def test_levels_that_hide_every_fault_are_of_no_use(factor: float, told: str) -> None:
    """A fault in a normal log was told as a change 5.6e+10 times smaller that would pass a level."""
    stamps = SimpleNamespace(shown=lambda time: f"{time:g} s")
    raised = Raised((Event(3, 5, 3, 5, "r[ya]"),), "T2", factor)
    numbers, times = np.arange(10), 0.1 * np.arange(10)
    (note,) = notes_of_normal_rows(raised, numbers, times, [(0, 10)], {}, [(0, 10)], [stamps])
    assert told in note
    assert "r[ya] in rows 3 to 5 (0.3 s to 0.5 s)" in note
    assert note.startswith("These thresholds are of no use") == (factor > 100.0)


def stretch_of(note: str) -> list[str]:
    """Return the first and last row and time of the first stretch that a note names."""
    rows, times = note.split("rows ")[1].split(")")[0].split(" (")
    return [*rows.split(" to "), *times.replace(" s", "").split(" to ")]


@pytest.mark.one_in(4)
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("memory", "step"), [(0.0, 0.0), (0.8, 0.0), (0.8, 0.02), (0.95, 0.05)])
def test_nothing_is_told_of_usual_rows(seed: int, memory: float, step: float) -> None:
    assert learned(log(seed, memory=memory, step=step)).notes == ()


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.long
def test_wild_rows_of_noise_with_heavy_tails_are_no_event(seed: int) -> None:
    assert learned(log(seed, freedom=4.0)).notes == ()


def noise_that_follows_itself(seed: int) -> pd.DataFrame:
    """Return rows without faults whose noise has a variance that is .95 of what it was on average."""
    rng, variance = np.random.default_rng(seed), np.ones(2)
    table, noise = log(seed), rng.standard_normal((ROWS, 2))
    for k in range(ROWS):
        noise[k] *= np.sqrt(variance)
        variance = 0.05 + 0.1 * noise[k] ** 2 + 0.85 * variance
    quiet = log(seed, memory=0.0)
    drawn = np.random.default_rng(seed).standard_normal((ROWS, 2))
    table[["ya", "yb"]] = quiet[["ya", "yb"]].to_numpy() + 0.01 * (noise - drawn)
    return table


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.long
def test_noise_whose_variance_follows_itself_is_told(seed: int) -> None:
    found, usual = learned(noise_that_follows_itself(seed)), learned(log(seed))
    assert found.lasting > 0.05
    assert "the size of the residuals follows itself" in found.statement
    assert (usual.lasting, "follows itself" in usual.statement) == (0.0, False)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.long
def test_errors_of_the_model_where_inputs_move_are_told(seed: int) -> None:
    """What sensors read as well while a held input moves, once in 25 rows; a held input without it is none."""
    for wrong, told in ((0.0, 0), (0.1, 1)):
        rng = np.random.default_rng(seed)
        u = np.repeat(rng.standard_normal(ROWS // 25), 25)
        plant, x, found = heated().plant, np.zeros(2), []
        for k, moved in enumerate(np.diff(u, prepend=u[0])):
            found.append([k * DT, u[k], *(x + 0.01 * rng.standard_normal(2) + wrong * moved)])
            x = plant.A @ x + plant.B @ u[k : k + 1]
        notes = learned(pd.DataFrame(found, columns=["time", "u", "ya", "yb"])).notes
        assert sum(note.startswith("Where inputs move") for note in notes) == told
        assert told or not notes


@pytest.mark.parametrize("offset", [True, False])
@pytest.mark.long
def test_an_offset_that_each_start_divides_anew_is_told(offset: bool) -> None:
    """The bias of a sensor beside its unknown offset: the estimate stays where the start has left it."""
    model, q = obsynth.DAEModel(
        {"tank": "der(h) = q - a * h"}, {"LT": "h + bias", "L2": "h"}, states={"h": 1.0}, inputs={"q": 0.1},
        parameters={"bias": 0.0}, constants={"a": 0.1},
    ), np.diag([4e-6])  # fmt: skip
    if offset:
        model, q = obsynth.with_noise(model, offset=["LT"])[0], np.diag([4e-6, 0.0])
    design = obsynth.dae_adaptive_observer(
        model, dt=1.0, Q=q, R=1e-4 * np.eye(2), form="augmented-kalman", random_walk=[[1e-8]],
        initial_parameter_covariance=[[1e-4]], integration="backward-euler",
    )  # fmt: skip
    rng, h, rows = np.random.default_rng(2), 1.0, []
    for k, flow in enumerate(np.repeat(rng.uniform(0.05, 0.15, 75), 20)):
        h = (h + flow) / 1.1 + 0.002 * rng.standard_normal() if k else h
        rows.append([float(k), flow, h + 0.1 * offset + 0.01 * rng.standard_normal(), h + 0.01 * rng.standard_normal()])
    data = pd.DataFrame(rows, columns=["time", "q", "LT", "L2"])
    notes = obsynth.learn_thresholds(design, data, false_alarms="1 per 1000 rows").notes
    assert [note.startswith("The estimate of bias stays what the start") for note in notes] == [True] * offset


@pytest.mark.long
def test_an_event_that_raises_the_levels_by_little_is_none() -> None:
    data = log(0)
    data.loc[EVENT.start : EVENT.stop - 1, "ya"] += 0.07
    assert learned(data).notes == ()


@pytest.mark.long
def test_a_stuck_sensor_is_told_by_the_command_and_kept_in_the_file(tmp_path: Path, capsys) -> None:
    data = log(1)
    data.loc[EVENT.start : EVENT.stop - 1, "yb"] = data.loc[EVENT.start, "yb"]
    gains, normal, file = (tmp_path / name for name in ("g.json", "normal.csv", "t.json"))
    heated().save(gains)
    data.to_csv(normal, index=False)
    asked = ["thresholds", "--gains", str(gains), "--data", str(normal), "--false-alarms", "1 per 500 rows"]
    assert main([*asked, "--out", str(file)]) == 0
    assert "yb repeats one value in rows 700 to 708 (70 s to 70.8 s)" in " ".join(capsys.readouterr().out.split())
    assert main([*asked, "--json"]) == 0
    notes = json.loads(capsys.readouterr().out)["notes"]
    assert [note.split(" in ")[0] for note in notes] == ["yb repeats one value"]
    assert obsynth.load_thresholds(file).notes == tuple(notes)


@pytest.mark.long
def test_what_a_stuck_sensor_repeats_is_not_learned_from() -> None:
    """Levels were those of a sensor that is stuck: they are those of a log that is blank there."""
    data = log(1)
    data.loc[EVENT.start : EVENT.stop - 1, "yb"] = data.loc[EVENT.start, "yb"]
    blank = data.copy()
    blank.loc[EVENT.start + 1 : EVENT.stop - 1, "yb"] = np.nan
    found, wanted = learned(data), learned(blank)
    assert found.levels.tolist() == wanted.levels.tolist()
    assert found.rows == wanted.rows
    assert (len(found.notes), len(wanted.notes)) == (1, 0)


@pytest.mark.long
def test_a_sensor_that_is_stuck_in_a_run_counts_as_not_measured_there_too(tmp_path: Path) -> None:
    """It alarmed, as its repeats were blank in the rows that were learned from and taken for measured in runs."""
    normal = learned(log(1))
    assert normal.repeats.tolist() == [2.0, 2.0]
    data = log(2)
    data.loc[703:799, "ya"] = data.loc[703, "ya"]
    blank = data.copy()
    blank.loc[704:799, "ya"] = np.nan
    design = heated()
    both = (normal, replace(normal, repeats=None))
    monitors = [obsynth.online_monitor(design, "learned", normal=one) for one in both]
    run, as_measured = (obsynth.run_on_data(design, data, monitor=monitor) for monitor in monitors)
    assert as_measured.events
    assert not run.events
    assert run.stuck == {"ya": ((704, 800),)}
    pd.testing.assert_frame_equal(run.table, obsynth.run_on_data(design, blank, monitor=monitors[0]).table)
    # In the middle of the repeats, and after one of them.
    for cut in (704, 705, 750):
        state = tmp_path / f"{cut}.json"
        parts = [
            obsynth.run_on_data(design, part, monitor=monitors[0], state=state).table
            for part in (data[:cut], data[cut:])
        ]
        pd.testing.assert_frame_equal(pd.concat(parts, ignore_index=True), run.table)
    file = normal.save(tmp_path / "t.json")
    assert obsynth.load_thresholds(file).repeats.tolist() == [2.0, 2.0]


@pytest.mark.long
def test_a_sensor_that_stays_stuck_is_an_alarm_of_its_own() -> None:
    """Without its samples no other alarm may ever come."""
    design, data = heated(), log(2)
    monitor = obsynth.online_monitor(design, "learned", normal=learned(log(1)))
    data.loc[703:, "ya"] = data.loc[703, "ya"]
    run = obsynth.run_on_data(design, data, monitor=monitor)
    (event,) = run.events
    # Rows count from 1: the second equal sample is in row 705, and 100 rows later it has lasted.
    assert (event.by, event.fault, event.first_row, event.last_row) == ("stuck sensor ya", "", 806, ROWS)
    assert run.table["alarm"].iloc[804] == ""
    assert run.table["alarm"].iloc[805] == "stuck sensor ya"
    assert run.alarms == {"stuck sensor ya": pytest.approx(805 * DT)}
    assert run.isolated == ""
    # In pieces, as a stream has them, and not without a monitor that has learned how many samples may be equal.
    pd.testing.assert_frame_equal(obsynth.run_on_data(design, data, monitor=monitor, chunk_rows=7).table, run.table)
    assert not obsynth.run_on_data(design, data).alarms


def test_repeats_are_left_out_in_pieces_as_in_one() -> None:
    rng = np.random.default_rng(3)
    for _ in range(50):
        n, longest = int(rng.integers(1, 40)), np.array([3.0, rng.choice([4.0, np.inf])])
        values, counted = rng.integers(0, 3, (n, 2)).astype(float), rng.random(n) < 0.8
        values[rng.random(values.shape) < 0.2] = np.nan
        wanted = values.copy()
        for i in range(2):
            last, equal = np.nan, 0
            for k in np.flatnonzero(counted & np.isfinite(values[:, i])):
                equal = equal + 1 if values[k, i] == last else 1
                last = values[k, i]
                if equal >= longest[i]:
                    wanted[k, i] = np.nan
        pieces, parts = Unrepeated(longest), []
        for piece, taken in zip(np.array_split(values, 5), np.array_split(counted, 5), strict=True):
            found, memory = pieces.of_rows(piece, taken)
            pieces.memory = memory[-1] if len(memory) else pieces.memory
            parts.append(found)
        np.testing.assert_array_equal(np.vstack(parts), wanted)


def test_from_which_repeat_on_a_sensor_is_stuck_follows_from_normal_logs() -> None:
    rng = np.random.default_rng(4)
    fine, coarse = rng.standard_normal((2, 2_000))
    coarse = 2.0 * np.round(coarse / 2.0)
    held = np.repeat(rng.standard_normal(200), 10)
    ramp, still = np.arange(2_000.0), np.full(2_000, 5.0)
    fine[500:560] = fine[500]
    log = np.column_stack([fine, coarse, held, ramp, still])
    longest = longest_repeats([log, log])
    assert longest[0] == 2.0
    usual = max(len(list(group)) for _, group in itertools.groupby(coarse.tolist()))
    assert longest[1] == 3.0 * usual
    assert longest[2] == 30.0
    # Without noise a sensor may rest.
    assert np.isinf(longest[3:]).all()


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("memory", [0.0, 0.9, 0.98])
@pytest.mark.parametrize("step", [0.0, 0.3, 1.0, 3.0])
def test_quantised_signals_are_not_stuck_until_they_are(seed: int, memory: float, step: float) -> None:
    drawn = np.random.default_rng(seed).standard_normal(3_000)
    values = lfilter([np.sqrt(1.0 - memory**2)], [1.0, -memory], drawn)
    values = step * np.round(values / step) if step else values
    assert stuck_rows(values) == []
    changes = np.flatnonzero(np.diff(values, prepend=np.nan) != 0.0)
    longest = int(np.diff(changes).max())
    if longest > 100:
        # What seldom changes at all does not show what is usual.
        return
    last = 1_000 + 6 * max(longest, 10)
    values[1_000 : last + 1] = 99.0
    values[1_005] = np.nan
    assert stuck_rows(values) == [(1_000, last)]


@pytest.mark.one_in(3)
@pytest.mark.parametrize(("step", "least"), [(1.0, 13), (2.0, 16), (3.0, 16)])
def test_coarse_sensors_that_stick_are_told_in_noise(step: float, least: int) -> None:
    """Steps in deviations of the noise.  Three single steps before were taken for a course that comes to rest: of these
    logs 11, 5 and none were told."""
    told = 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        course = np.sin(np.arange(3000) * rng.uniform(0.01, 0.1)) + rng.standard_normal(3000)
        shown, first = step * np.round(course / step), int(rng.integers(200, 2500))
        assert stuck_rows(shown) == []
        shown[first : first + 200] = shown[first]
        told += any(begin <= first and end >= first + 199 for begin, end in stuck_rows(shown))
    assert told >= least


def test_what_never_or_rarely_changes_is_not_stuck() -> None:
    assert stuck_rows(np.full(500, 2.0)) == []
    assert stuck_rows(np.repeat(np.arange(30.0), 20)) == []
    held = np.repeat(np.random.default_rng(0).standard_normal(200), 10)
    assert stuck_rows(held) == []
    held[1_000:1_040] = held[1_000]
    assert stuck_rows(held) == [(1_000, 1_039)]
    # Where a tenth of the runs is long, of any length, one of three times the longest is no wonder.
    lengths = [1] * 50 + [2, 4, 8, 10, 20, 40, 60, 80, 301, 100]
    assert stuck_rows(np.repeat(np.arange(60.0), lengths)) == []


@pytest.mark.parametrize("digits", [6, 17])
@pytest.mark.parametrize("poles", [(0.9, 0.5), (0.95 * np.exp(0.3j), 0.95 * np.exp(-0.3j))])
@pytest.mark.parametrize("course", ["a step", "steps", "from rest"])
def test_what_comes_to_rest_without_noise_is_not_stuck(
    digits: int, poles: tuple[complex, complex], course: str
) -> None:
    u = np.repeat(np.random.default_rng(2).standard_normal(10), 400)
    if course != "steps":
        u[400:] = 0.0 if course == "a step" else u[400:].cumsum()
        u[:400] = 1.0 if course == "a step" else 0.0
    y = lfilter([0.0, 1.0], np.poly(poles).real, u)
    assert stuck_rows(np.array([float(f"{value:.{digits}g}") for value in y])) == []


@pytest.mark.parametrize("rows", [1, 7, 400])
def test_stuck_rows_do_not_depend_on_the_pieces_of_a_log(rows: int) -> None:
    values = np.round(np.random.default_rng(4).standard_normal((3_000, 2)), 1)
    values[1_000:1_040, 1], values[2_990:, 1], values[50:60] = 5.0, 7.0, np.nan
    gathered = RepeatedValues(2)
    for first in range(0, len(values), rows):
        gathered.take(values[first : first + rows])
    assert gathered.stuck() == [[], [(1_000, 1_039), (2_990, 2_999)]]


@pytest.mark.long
def test_a_stuck_sensor_is_told_by_runs_of_files_and_of_streams(tmp_path: Path, capsys) -> None:
    data = log(1)
    data.loc[EVENT.start : EVENT.stop - 1, "yb"] = data.loc[EVENT.start, "yb"]
    # The same row once more is left out, and repeats nothing.
    data = data.loc[[*range(200), *[199] * 9, *range(200, ROWS)]].reset_index(drop=True)
    gains, file, out = (tmp_path / name for name in ("g.json", "log.csv", "out.csv"))
    heated().save(gains)
    data.to_csv(file, index=False)
    assert main(["run", "--gains", str(gains), "--data", str(file), "--out", str(out), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["stuck"] == {"yb": [[710, 718]]}
    assert "yb repeats one value in rows 710 to 718, for longer" in " ".join(told["warnings"])
    with file.open(encoding="utf-8") as stream:
        assert obsynth.run_on_data(heated(), stream).stuck == {"yb": ((710, 718),)}
    assert obsynth.run_on_data(heated(), log(1)).stuck == {}


def test_a_stuck_sensor_is_told_by_validate() -> None:
    from obsynth.monitoring.calibration.logs import read_log

    data = log(1)
    data.loc[EVENT.start : EVENT.stop - 1, "yb"] = data.loc[EVENT.start, "yb"]
    (note,) = read_log(data, ["u"], ["ya", "yb"], rows="100:").notes
    assert "yb repeats one value in rows 700 to 708, for longer" in note
    assert read_log(log(1), ["u"], ["ya", "yb"]).notes == ()


@pytest.mark.long
def test_an_estimate_that_is_not_watched_says_how_many_rows_it_needs_and_a_level_that_alarms() -> None:
    """One log of a motor: its residuals alarm at the onset of a fault or not at all, and no level was named."""
    plant = obsynth.DescriptorSystem(
        None, [[0.9, 0.05], [0.0, 0.8]], [[1.0], [0.5]], ["T1", "T2"], Bf=[[1.0], [0.0]], dt=1.0,
        state_names=["T1", "T2"], input_names=["heat"], fault_names=["loss"], sensor_noise={"T1": 0.05, "T2": 0.05},
        units={"loss": "kW"},
    )  # fmt: skip
    design, rng, x, rows = obsynth.ui_pi_observer(plant), np.random.default_rng(1), np.zeros(2), []
    slow = 0.0
    for k in range(400):
        slow = 0.995 * slow + 0.01 * rng.standard_normal()
        rows.append([float(k), 0.0, *(x + 0.05 * rng.standard_normal(2))])
        x = plant.A @ x + plant.Bf @ [slow + 0.5 * (k >= 250)]
    data = pd.DataFrame(rows, columns=["time", "heat", "T1", "T2"])
    learned = obsynth.learn_thresholds(design, data[:250])
    assert "fhat[loss]" in learned.left_out
    (note,) = (note for note in learned.notes if note.startswith("fhat[loss] is not watched"))
    assert int(note.split("about ")[1].split(" ")[0].replace(",", "")) > learned.rows
    # Both numbers had no unit.
    assert " kW at most here" in note
    text, unit = note.split("such as ")[1].split(",")[0].split()
    level = float(text)
    assert unit == "kW"
    monitor = obsynth.online_monitor(design, "learned", normal=learned)
    alarm = obsynth.run_on_data(design, data, monitor=monitor, thresholds={"fhat[loss]": level}).table["alarm"]
    assert (alarm[:250] == "").all()
    assert alarm[265:].str.contains("fhat", regex=False).all()
    assert obsynth.run_on_data(design, data, monitor=monitor).table["alarm"].iloc[-1] == ""

"""Every shipped design as C: on a log with blanks it says what `obsynth run` says, row by row."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import zipfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

import obsynth
from obsynth.exporting.c_source import c_identifier
from obsynth.monitoring.thresholds.learned import LearnedThresholds
from obsynth.monitoring.thresholds.learned_ranges import LearnedRanges
from obsynth.monitoring.thresholds.learned_statistics import AGES, Statistics
from obsynth.monitoring.thresholds.parameter_scores import parameter_walk
from obsynth.monitoring.thresholds.watched_columns import watched_names
from obsynth.numerics.autoregression import Autoregression
from obsynth.observers.nonlinear.observer import DAEObserver
from obsynth.results.gain_set_writing import gain_set_digest
from obsynth.results.verification_report import VerificationReport
from obsynth.specs.loader import load_spec

ROOT = Path(__file__).parents[2]
COMPILER = shutil.which("cc")
pytestmark = pytest.mark.skipif(COMPILER is None, reason="no C compiler")
FLAGS = ["-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-O0", "-ffp-contract=off", "-shared", "-fPIC"]
LINEAR = (
    "bicycle/spec", "drive/spec", "filasova/spec", "ieee14/spec", "kundur/spec", "kundur/spec_fault_filter",
    "motor/sampled", "motor/spec", "sharepasand/spec", "smib/functional", "smib/pd_observer", "smib/spec", "tanks/spec",
    "wang2015/spec", "wang2015_printed_psi/spec",
)  # fmt: skip
NONLINEAR = ("diode_circuit/spec", "moussaali2013_dae/spec", "pendulum/spec", "threetank/spec")
#: Faults that walk with the states, whose changes are looked for.
WALKING = "walking"
#: The same with a sensor that is slower than the rows, whose innovation is not watched.
SLOWLY_SEEN = "slowly_seen"
#: Rows that a log leaves out are a longer step of a continuous design, which C, on its clock, does not know of.
CONTINUOUS = ("filasova/spec", "kundur/spec", "motor/spec", "sharepasand/spec", "smib/pd_observer")
#: Their C is a dot product of its own, with the same test in test_guaranteed_c.
WINDOWS = ("drive/guaranteed_test", "smib/guaranteed_test", "vehicle/spec")
#: Those of which there is no C: gains or noise that change with k, and specs that say that there is no filter.  The
#: adaptive observer of smib takes ten seconds to settle: a small one stands for its steady state in
#: test_export_recursive.
NONE = ("moussaali2013_ltv/as_printed", "moussaali2013_ltv/spec", "moussaali2013_ltv/two_outputs", "motor/one_encoder")
SLOW = ("smib/spec_inertia",)
ROWS, WARM_UP, SAMPLE_TIME = 260, 20, 0.01
#: Rows and columns (of outputs, then of inputs) that are missing: before the start, in the warm-up, cells, whole rows,
#: and inputs.
MISSING = ((0, -1), (1, -1), (3, 0), (60, 0), *((row, None) for row in range(90, 97)), (131, -1), (170, 0), (172, 0),
           (200, None), *((row, -1) for row in range(230, 234)))  # fmt: skip

RUN = """
void run_NAME(const double *in, double *out, int rows)
{
    static NAME_state state;
    int k, i;
    NAME_reset(&state);
    for (i = 0; i < NAME_WATCHED_UPPER; i++) {
        if (i + 1 < NAME_WATCHED_UPPER) state.level[i] = in[i];
    }
    state.warm_up = in[NAME_WATCHED_UPPER];
    in += NAME_WATCHED_UPPER + 1;
    for (k = 0; k < rows; k++) {
        double *row = out + k * WIDTH;
        int failed;
        FOUND
        failed = CALL;
        row[LAST] = failed; row[LAST + 1] = state.status; row[LAST + 2] = state.any_alarm;
        row[LAST + 3] = state.monitor.statistic; row[LAST + 4] = state.monitor.fault;
        COPY
        in += TAKEN;
    }
}
"""


def told(design: obsynth.ObserverDesign) -> LearnedThresholds:
    """Return thresholds as if they had been learned: an autoregression of order 2 of up to two columns."""
    names = watched_names(design)
    columns = tuple(dict.fromkeys((names[0], names[-1])))
    m, nf = len(columns), len(design.observer.fault_names)
    A = np.array([0.5 * np.eye(m) + 0.1, -0.2 * np.eye(m)])
    model = Autoregression(np.full(m, 0.02), A, 3.0 * np.eye(m) - 0.5)
    signatures = np.vstack([np.eye(m), np.ones(m)])
    shown = (*columns, f"fault {design.observer.fault_names[-1]}" if nf else "both")
    estimates = names[:nf] if parameter_walk(design.observer) is not None else ()
    by_age = np.geomspace(2.0, 0.5, len(AGES)) * np.linspace(0.8, 1.2, 2 * len(shown))[:, None]
    bands = np.linspace(0.0, 0.05, len(shown))
    statistics = Statistics(model, signatures, shown, estimates, by_age, bands, np.linspace(0.0, 0.02, len(estimates)))
    starts = 2.0 * design.observer.initial_covariance if isinstance(design.observer, DAEObserver) else None
    levels = np.linspace(8.0, 20.0, len(statistics.names))
    dt = design.observer.dt or SAMPLE_TIME
    slow = getattr(design.observer, "sensors", None) or {}
    # Narrower than the logs, so that levels are raised in some of their rows.
    signals = (*design.plant.input_names, *design.plant.output_names)
    ends = np.full(len(signals), 0.7)
    nu = len(design.plant.input_names)
    rates = np.linspace(0.1, 1.0, nu * len(levels)).reshape(nu, len(levels))
    ranges = LearnedRanges(signals, nu, -ends, ends, np.zeros(len(signals)), rates)
    return LearnedThresholds(columns, statistics, levels, 500.0, 1000, 500, dt, np.zeros(nf), np.ones(nf),
                             gain_set_digest(design), settling=0 if m == 1 else 30, innovation=0.7,
                             seldom=tuple(f"r[{name}]" for name in slow), initial_covariance=starts,
                             repeats=np.full(len(design.plant.output_names), 3.0), ranges=ranges,
                             memory=40.0)  # fmt: skip


def designed(name: str) -> obsynth.ObserverDesign:
    if name in (WALKING, SLOWLY_SEEN):
        model = obsynth.DAEModel(
            {"coil": "3000 * der(coil) = valve * (1 - stuck) * 20 * (60 - coil) - 8 * (coil - air)",
             "air": "800 * der(air) = 8 * (coil - air) + 10 * (outside - air)"},
            {"Tair": "air + bias", "Tcoil": "coil"}, states={"coil": 40.0, "air": 25.0},
            inputs={"valve": 0.5, "outside": 15.0},
            parameters={"stuck": 0.0, "bias": 0.0},
        )  # fmt: skip
        return obsynth.dae_adaptive_observer(
            model, dt=60.0, Q=np.diag([4e-4, 4e-4]), R=np.diag([0.02, 0.01]), form="augmented-kalman", name=name,
            random_walk=np.diag([1e-4, 1e-3]), initial_parameter_covariance=np.diag([1e-3, 1e-2]),
            sensors={"Tair": {"every": 3}} if name == SLOWLY_SEEN else None, outliers="gate",
            # Nearer than what the prediction excludes: only a sensor that waits for the next sample is judged by them.
            outlier_sizes={"Tair": 0.3, "Tcoil": 0.3},
        )  # fmt: skip
    spec = load_spec(ROOT / "designs" / f"{name}.yaml")
    return obsynth.design(spec.plant, spec.method, name=spec.name, **dict(spec.options))


def log_of(design: obsynth.ObserverDesign) -> pd.DataFrame:
    """Return signals that move, with offsets and what is missing, in the units of the plant."""
    rng, plant = np.random.default_rng(5), design.plant
    nu, ny = len(plant.input_names), len(plant.output_names)
    dt = design.observer.dt or SAMPLE_TIME
    if isinstance(design.observer, DAEObserver):
        u = np.tile(plant.nominal_input, (ROWS, 1)).reshape(ROWS, nu) * (1.0 + 0.01 * rng.standard_normal((ROWS, nu)))
        y = np.array(obsynth.simulate_dae(plant, u, dt=dt, R=design.observer.R, seed=1).outputs)
        deviations = np.sqrt(np.diag(np.atleast_2d(design.observer.R)))
        y[150:, 0] += 4.0 * deviations[0]
        # Outliers: of one sensor, and of all of them, which leaves nothing of a row.
        y[120, -1] += 60.0 * deviations[-1]
        y[140] += 60.0 * deviations
        # Below, which is left out as well; and several above, of which the second and those after it are believed.
        y[125, -1] -= 60.0 * deviations[-1]
        y[210:213, 0] += 60.0 * deviations[0]
    else:
        moved = np.cumsum(rng.standard_normal((ROWS, nu + ny)), axis=0) * 0.05 + 0.1 * rng.standard_normal((ROWS, 1))
        point = [plant.operating_point.get(name, 0.0) for name in (*plant.input_names, *plant.output_names)]
        u, y = np.split(moved + point, [nu], axis=1)
    # A sensor is stuck: from the third equal sample on it is not measured.
    y[180:190, -1] = y[180, -1]
    for row, column in MISSING:
        if column is None:
            y[row] = np.nan
        elif column == 0:
            y[row, 0] = np.nan
        elif nu:
            u[row, -1] = np.nan
    scales = [getattr(plant, "scales", {}).get(name, 1.0) for name in (*plant.input_names, *plant.output_names)]
    names = [*plant.input_names, *plant.output_names]
    table = pd.DataFrame(np.hstack([u, y]) / scales, columns=names)
    table.insert(0, "time", np.arange(ROWS) * dt)
    return table


def harness(design: obsynth.ObserverDesign, name: str) -> tuple[str, int]:
    """Return the function that runs a design in C over a log, and the numbers of a row that it writes."""
    observer = design.observer
    nu, ny = len(design.plant.input_names), len(design.plant.output_names)
    nx, nf = len(observer.state_names), len(observer.fault_names)
    nonlinear = isinstance(observer, DAEObserver)
    nr = ny if nonlinear else len(observer.residual_names)
    given = [text for text, count in (("in", nu), (f"in + {nu}", ny)) if count]
    last = (2 * nx + 2 * nf if nonlinear else nx + nf) + nr
    found, copied = "", ""
    if nonlinear:
        call = f"{name}_step(&state, {', '.join([*given, '&found'])})"
        found = f"static {name}_estimates found;"
        place = 0
        for field, count in (("states", nx), ("faults", nf), ("state_deviations", nx), ("fault_deviations", nf),
                             ("residuals", nr)):  # fmt: skip
            copied += f"for (i = 0; i < {count}; i++) row[{place} + i] = found.{field}[i];\n"
            place += count
    else:
        outputs = (("row", nx), (f"row + {nx}", nf), (f"row + {nx + nf}", nr))
        call = f"{name}_take(&state, {', '.join([*given, *(text for text, count in outputs if count)])})"
    parts = {"NAME_WATCHED_UPPER": f"{name.upper()}_WATCHED", "NAME": name, "WIDTH": str(last + 5), "FOUND": found,
             "CALL": call, "LAST": str(last), "COPY": copied, "TAKEN": str(nu + ny)}  # fmt: skip
    text = RUN
    for word, value in parts.items():
        text = text.replace(word, value)
    return text, last + 5


class Shipped:
    """The shipped designs with their C, each made when a test needs it; they are not verified here."""

    names = (*LINEAR, *NONLINEAR, WALKING, SLOWLY_SEEN)

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._made: dict[str, tuple[obsynth.ObserverDesign, list[Path], int]] = {}
        self._code: dict[str, ctypes.CDLL] = {}

    def made(self, name: str) -> tuple[obsynth.ObserverDesign, list[Path], int]:
        """Return a design, its C with a program that runs it, and the numbers of a row that this writes."""
        if name not in self._made:
            holds = SimpleNamespace(passed=True, failures=(), checks=())
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr("obsynth.methods.designing.verify", lambda design, **_: holds)
                design = designed(name).replace(report=VerificationReport())
                monitor = obsynth.online_monitor(design, "learned", normal=told(design), sensor_faults=False)
                stem, rate = c_identifier(name), SAMPLE_TIME if design.observer.dt == 0.0 else None
                sources = obsynth.export(design, self.folder / f"{stem}.c", sample_time=rate, monitor=monitor)
            text, width = harness(design, stem)
            (self.folder / f"{stem}_run.c").write_text(f'#include "{stem}.h"\n{text}')
            files = [*(file for file in sources if file.suffix == ".c"), self.folder / f"{stem}_run.c"]
            self._made[name] = design, files, width
        return self._made[name]

    def design(self, name: str) -> obsynth.ObserverDesign:
        return self.made(name)[0]

    def compiled(self, library: Path, names: Sequence[str]) -> ctypes.CDLL:
        """Return the C of designs in one library, compiled with warnings as errors."""
        files = [str(file) for name in names for file in self.made(name)[1]]
        command = [str(COMPILER), *FLAGS, *files, "-o", str(library), "-lm"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr[:4000]
        return ctypes.CDLL(str(library))

    def code(self, name: str) -> ctypes.CDLL:
        if name not in self._code:
            self._code[name] = self.compiled(self.folder / f"{c_identifier(name)}.so", [name])
        return self._code[name]


@pytest.fixture(scope="module")
def shipped(tmp_path_factory: pytest.TempPathFactory) -> Shipped:
    return Shipped(tmp_path_factory.mktemp("c"))


def test_every_shipped_design_is_one_of_these() -> None:
    from test_guaranteed_c import SHIPPED

    files = (path for path in (ROOT / "designs").glob("*/*.yaml") if "method:" in path.read_text())
    found = {str(path.relative_to(ROOT / "designs").with_suffix("")) for path in files}
    assert found == {*LINEAR, *NONLINEAR, *WINDOWS, *NONE, *SLOW}
    assert set(WINDOWS) <= {*SHIPPED}


@pytest.mark.one_in(4)
@pytest.mark.parametrize("name", NONE)
@pytest.mark.usefixtures("taken_as_verified")
def test_what_has_no_c_says_why(name: str, tmp_path: Path) -> None:
    refused = {"motor/one_encoder": "torque detectable", "moussaali2013_ltv/as_printed": "residual directions"}
    if name in refused:
        with pytest.raises(obsynth.PreconditionError, match=refused[name]):
            designed(name)
        return
    design = designed(name)
    with pytest.raises(obsynth.SpecError, match=r"changes? with k|time-varying|horizon"):
        obsynth.export(design, tmp_path / "a.c", unverified=True)


@pytest.mark.long
def test_an_fmu_holds_the_c_that_is_tested_here(shipped: Shipped, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of every design, with the same monitor; test_fmu_export runs the wrapper around it."""
    from obsynth.exporting.fmu import archive

    monkeypatch.setattr(archive, "_binary", lambda *_: None)
    for name in shipped.names:
        design = shipped.design(name)
        stem, rate = c_identifier(name), {"sample_time": SAMPLE_TIME} if design.observer.dt == 0.0 else {}
        monitor = obsynth.online_monitor(design, "learned", normal=told(design), sensor_faults=False)
        (unit,) = obsynth.export(design, shipped.folder / f"{stem}.fmu", monitor=monitor, **rate)
        with zipfile.ZipFile(unit) as packed:
            inside = packed.read("sources/observer.c").decode()
        alone = (shipped.folder / f"{stem}.c").read_text()
        assert inside == alone.replace(stem, "observer").replace(stem.upper(), "OBSERVER")


def test_headers_say_what_a_controller_needs(shipped: Shipped) -> None:
    """Units, names of columns, the operating point, alarms, the monitor, the status of verification, and C++."""
    names = ("threetank/spec", "wang2015/spec", WALKING)
    for name in names:
        shipped.made(name)
    tanks = (shipped.folder / "threetank_spec.h").read_text()
    assert 'extern "C"' in tanks
    assert '/* faults[0]: "fhat[leak]", "V^0.5/s" */' in tanks
    assert '/* state_deviations[0]: "sd xhat[h1]", "V" */' in tanks
    assert '/* "alarm[0]: fhat[leak]" */' in tanks.replace(
        '/* alarm[0]: "fhat[leak]" */', '/* "alarm[0]: fhat[leak]" */'
    )
    assert "learned from 1000 rows without faults" in tanks
    assert "UNVERIFIED: no check was made" in tanks
    cc = shutil.which("g++")
    if cc is not None:
        text = "\n".join(f'#include "{c_identifier(name)}.h"' for name in names)
        (shipped.folder / "all.cpp").write_text(text + "\nint main() { return 0; }\n")
        subprocess.run([cc, "-Wall", "-Werror", "-fsyntax-only", str(shipped.folder / "all.cpp")], check=True)


@pytest.mark.long
def test_all_designs_fit_into_one_program(shipped: Shipped) -> None:
    code = shipped.compiled(shipped.folder / "all.so", shipped.names)
    assert all(hasattr(code, f"run_{c_identifier(name)}") for name in shipped.names)


@pytest.mark.skipif(shutil.which("g++") is None, reason="no compiler of C++")
@pytest.mark.long
def test_every_source_is_cplusplus_too(shipped: Shipped) -> None:
    """Who builds controllers in C++ compiles sources as such: casts, tables and enumerations are checked more."""
    files = [str(file) for name in shipped.names for file in shipped.made(name)[1]]
    command = [str(shutil.which("g++")), "-x", "c++", "-Wall", "-Wextra", "-Werror", "-fsyntax-only", *files]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[:4000]


@pytest.mark.long
def test_c_finds_changes_of_faults_as_a_run_does(shipped: Shipped) -> None:
    design = shipped.design(WALKING)
    alone = told(design)
    statistics = replace(alone.statistics, estimates=())
    count = len(statistics.names)
    assert alone.ranges is not None
    assert alone.ranges.rates is not None
    ranges = alone.ranges._replace(rates=alone.ranges.rates[:, :count])
    alone = replace(alone, statistics=statistics, levels=alone.levels[:count], ranges=ranges)
    with_changes, without = (
        obsynth.run_on_data(
            design, log_of(design), monitor=obsynth.online_monitor(design, "learned", normal=one, sensor_faults=False)
        ).table
        for one in (told(design), alone)
    )
    assert (with_changes.statistic > 1.5 * without.statistic).sum() >= 50
    test_c_says_what_a_run_says(shipped, WALKING)
    test_c_says_what_a_run_says(shipped, SLOWLY_SEEN)


@pytest.mark.long
def test_floats_find_changes_of_faults_too(shipped: Shipped, tmp_path: Path) -> None:
    design = shipped.design(WALKING)
    monitor = obsynth.online_monitor(design, "learned", normal=replace(told(design), ranges=None), sensor_faults=False)
    sources = obsynth.export(design, tmp_path / "walking.c", monitor=monitor, precision="float", unverified=True)
    text, width = harness(design, "walking")
    (tmp_path / "run.c").write_text('#include "walking.h"\n' + text.replace("double", "float"))
    files = [str(file) for file in (*sources, tmp_path / "run.c") if file.suffix == ".c"]
    subprocess.run([str(COMPILER), *FLAGS, *files, "-o", str(tmp_path / "run.so"), "-lm"], check=True)
    log = log_of(design)
    count = len(design.observer.fault_names) + design.plant.ny + 3
    given = np.concatenate([np.zeros(count), log.to_numpy()[:, 1:].ravel()]).astype(np.float32)
    out, pointer = np.zeros((ROWS, width), dtype=np.float32), ctypes.POINTER(ctypes.c_float)
    code = ctypes.CDLL(str(tmp_path / "run.so"))
    code.run_walking(given.ctypes.data_as(pointer), out.ctypes.data_as(pointer), ROWS)
    run = obsynth.run_on_data(design, log, monitor=monitor).table
    found, wanted = out[:, -2], run.statistic.to_numpy()
    np.testing.assert_array_equal(np.isnan(found), np.isnan(wanted))
    assert (wanted > 1.0).sum() >= 50
    # Single precision has seven digits, of which the difference of two inverses leaves two or more.
    np.testing.assert_allclose(found[wanted > 1.0], wanted[wanted > 1.0], rtol=0.03)


def flawed(design: obsynth.ObserverDesign) -> tuple[pd.DataFrame, pd.DataFrame, list[int]]:
    """Return a log with flaws of stamps and cells, what a controller has at its clock instead, and which rows of that
    are those of the log, -1 for rows that it does not have."""
    clock = log_of(design)
    nu, dt = len(design.plant.input_names), design.observer.dt
    rng, signals = np.random.default_rng(7), list(clock.columns[1:])
    outputs = signals[nu:]
    clock.loc[60, outputs[0]], clock.loc[180, outputs[-1]] = np.inf, -np.inf
    clock.loc[185:215, outputs[-1]] = clock.loc[185, outputs[-1]]
    clock.loc[:, signals] = clock[signals].mask(rng.random((ROWS, len(signals))) < 0.03 / len(signals))
    left_out = {*range(1, 6), *range(30, 34), 105, *range(142, 160)}
    clock.loc[sorted(left_out), signals] = np.nan
    rows = [row for row in range(ROWS) if row not in left_out]
    log = clock.assign(time=clock["time"] + dt * rng.uniform(-0.2, 0.2, ROWS))
    # Stamps that come again, of the row before or of an older one.
    again = {25: 25, 70: 70, 55: 51, 120: 114}
    order = [place for row in rows for place in ((row, again[row]) if row in again else (row,))]
    known = [place if k == 0 or place > max(order[:k]) else -1 for k, place in enumerate(order)]
    return log.loc[order].reset_index(drop=True), clock, known


#: Of 62 states Python is a relative 1.1e-12 away from the same sums in extended precision, and C is 2.2e-12.
MANY_STATES = {"ieee14/spec": 5e-12}


@pytest.mark.one_in(5)
@pytest.mark.parametrize("name", [*LINEAR, *NONLINEAR])
def test_c_says_what_a_run_says(shipped: Shipped, name: str) -> None:
    log = log_of(shipped.design(name))
    same_as_c(shipped, name, log, log, list(range(ROWS)))


@pytest.mark.one_in(5)
@pytest.mark.parametrize(
    "name", [name for name in (*LINEAR, *NONLINEAR, WALKING, SLOWLY_SEEN) if name not in CONTINUOUS]
)
def test_c_at_its_clock_says_what_a_run_says_of_a_log_with_all_flaws(shipped: Shipped, name: str) -> None:
    same_as_c(shipped, name, *flawed(shipped.design(name)), least={"ok", "gap", "repeated stamp", "out of order"})


def same_as_c(
    shipped: Shipped,
    name: str,
    log: pd.DataFrame,
    clock: pd.DataFrame,
    known: list[int],
    *,
    least: set[str] | None = None,
) -> None:
    """C says at each row of its clock what a run says at that row of a log."""
    design = shipped.design(name)
    dt = design.observer.dt or SAMPLE_TIME
    monitor = obsynth.online_monitor(design, "learned", normal=told(design), sensor_faults=False, unverified=True)
    nonlinear = isinstance(design.observer, DAEObserver)
    names = [f"fhat[{f}]" for f in design.observer.fault_names]
    names += [f"r[{r}]" for r in (design.plant.output_names if nonlinear else design.observer.residual_names)]
    levels = dict.fromkeys(names, 0.3)
    run = obsynth.run_on_data(
        design, log, thresholds=levels, monitor=monitor, warm_up=WARM_UP * dt, recovered="none"
    ).table
    assert (least or {"ok", "gap"}) <= set(run.status)
    run = run[np.array(known) >= 0].reset_index(drop=True)
    rows = [row for row in known if row >= 0]
    scales = getattr(design.plant, "scales", {})
    scaled = clock.to_numpy()[:, 1:] * [scales.get(column, 1.0) for column in clock.columns[1:]]
    count = len(names) + nonlinear + 1
    head = [0.3] * len(names) + [0.0] * (count - len(names)) + [WARM_UP * dt]
    given, out = np.concatenate([head, scaled.ravel()]), np.full((ROWS, shipped.made(name)[2]), np.inf)
    pointer = ctypes.POINTER(ctypes.c_double)
    function = getattr(shipped.code(name), f"run_{c_identifier(name)}")
    function(given.ctypes.data_as(pointer), out.ctypes.data_as(pointer), ROWS)
    out, scaled = out[rows], scaled[rows]
    columns = [column for column in run.columns if column.startswith(("xhat[", "fhat[", "sd ", "r["))]
    wanted, found = run[columns].to_numpy(float), out[:, : len(columns)]
    np.testing.assert_array_equal(np.isnan(found), np.isnan(wanted))
    sizes = np.maximum(np.nanmax(np.abs(wanted), axis=0), 1e-9)
    assert np.nanmax(np.abs(found - wanted) / sizes) <= (1e-10 if nonlinear else MANY_STATES.get(name, 1e-12))
    statuses = np.array(["ok", "warm-up", "gap", "recovering", "partial"])[out[:, -4].astype(int)]
    assert statuses.tolist() == run.status.tolist()
    inputs = scaled[:, : len(design.plant.input_names)]
    returned = np.isnan(inputs).any(axis=1) if nonlinear else run.status == "gap"
    np.testing.assert_array_equal(out[:, -5] != 0.0, returned)
    np.testing.assert_array_equal(out[:, -3] != 0.0, run.alarm != "")
    statistic = run.statistic.to_numpy(float)
    np.testing.assert_array_equal(np.isnan(out[:, -2]), np.isnan(statistic))
    np.testing.assert_allclose(out[:, -2], statistic, rtol=1e-9 if nonlinear else 1e-12)
    faults = design.observer.fault_names
    isolated = [faults[int(i)] if i >= 0 else "" for i in out[:, -1]]
    shown = [text.partition("learned: ")[2].split(";")[0] for text in run.alarm]
    assert isolated == shown


@pytest.mark.long
def test_floats_keep_the_bound_that_their_header_states(shipped: Shipped, tmp_path: Path) -> None:
    """Against doubles, for signals within one unit; and the bound is not idle."""
    design = shipped.design("wang2015/spec")
    found = {}
    for precision, kind in (("double", ctypes.c_double), ("float", ctypes.c_float)):
        stem = f"wang_{precision}"
        monitor = obsynth.online_monitor(design, "learned", normal=told(design), sensor_faults=False)
        source, header = obsynth.export(design, tmp_path / f"{stem}.c", precision=precision, monitor=monitor)
        nu, ny = len(design.observer.input_names), len(design.observer.output_names)
        rows = len(design.observer.row_names)
        nx, nf = len(design.observer.state_names), len(design.observer.fault_names)
        real = "double" if precision == "double" else "float"
        call = f"{stem}_step(&state, in, in + {nu}, out, out + {nx}, out + {nx + nf})"
        (tmp_path / f"{stem}_run.c").write_text(
            f'#include "{stem}.h"\nvoid run(const {real} *in, {real} *out, int rows) {{ static {stem}_state state;\n'
            f"{stem}_reset(&state); while (rows-- > 0) {{ {call}; in += {nu + ny}; out += {rows}; }} }}\n"
        )
        library = tmp_path / f"{stem}.so"
        files = [str(source), str(tmp_path / f"{stem}_run.c")]
        subprocess.run([str(COMPILER), *FLAGS, "-Wdouble-promotion", *files, "-o", str(library)], check=True)
        signals = np.random.default_rng(0).uniform(-1.0, 1.0, (2_000, nu + ny)).astype(np.float32).astype(kind)
        said, pointer = np.zeros((2_000, rows), kind), ctypes.POINTER(kind)
        ctypes.CDLL(str(library)).run(signals.ctypes.data_as(pointer), said.ctypes.data_as(pointer), 2_000)
        found[precision] = said
        text = header.read_text()
    stated = text.partition("for n units): ")[2].partition('"')[0].split(", ")
    bounds = np.array([float(part.rpartition(" ")[2]) for part in stated])
    errors = np.abs(found["float"] - found["double"]).max(axis=0)
    assert (errors <= bounds).all()
    assert (errors >= 1e-3 * bounds).all()
    with pytest.raises(obsynth.SpecError, match="precision"):
        obsynth.export(design, tmp_path / "a.npz", precision="float")


@pytest.mark.long
@pytest.mark.parametrize(("logs", "memory"), [(1, 40.0), (2, 0.0)])
def test_c_ends_an_alarm_that_stands_since_the_start_as_a_run_does(
    shipped: Shipped, tmp_path: Path, logs: int, memory: float
) -> None:
    design, log = shipped.design(WALKING), log_of(shipped.design(WALKING))
    # A sensor that is off from the first row on, and levels that it passes in every row.
    log["Tair"] += 6.0 * np.sqrt(np.atleast_2d(design.observer.R)[0, 0])
    learned = replace(told(design), levels=0.02 * told(design).levels, logs=logs, memory=memory)
    monitor = obsynth.online_monitor(design, "learned", normal=learned, sensor_faults=False)
    run = obsynth.run_on_data(design, log, monitor=monitor)
    assert any("taken for what is usual in this log, and levels are raised" in text for text in run.warnings)
    (out,) = rows_in_c(design, monitor, [log], tmp_path)
    np.testing.assert_allclose(out[:, -2], run.table["statistic"], rtol=1e-9)


def rows_in_c(
    design: obsynth.ObserverDesign, monitor: obsynth.types.Monitor, logs: Sequence[pd.DataFrame], folder: Path
) -> list[np.ndarray]:
    """Return what the C of a design with a monitor writes at each row of each log, without levels of its outputs."""
    rate = {"sample_time": SAMPLE_TIME} if design.observer.dt == 0.0 else {}
    sources = obsynth.export(design, folder / "exported.c", monitor=monitor, unverified=True, **rate)
    text, width = harness(design, "exported")
    (folder / "run.c").write_text('#include "exported.h"\n' + text)
    files = [str(file) for file in (*sources, folder / "run.c") if file.suffix == ".c"]
    subprocess.run([str(COMPILER), *FLAGS, *files, "-o", str(folder / "run.so"), "-lm"], check=True)
    code, pointer = ctypes.CDLL(str(folder / "run.so")), ctypes.POINTER(ctypes.c_double)
    nonlinear = isinstance(design.observer, DAEObserver)
    residuals = design.plant.ny if nonlinear else len(design.observer.residual_names)
    head = np.zeros(len(design.observer.fault_names) + residuals + 2 + nonlinear)
    scales = getattr(design.plant, "scales", {})
    found = []
    for log in logs:
        scaled = log.to_numpy()[:, 1:] * [scales.get(name, 1.0) for name in log.columns[1:]]
        given, out = np.concatenate([head, scaled.ravel()]), np.zeros((len(log), width))
        code.run_exported(given.ctypes.data_as(pointer), out.ctypes.data_as(pointer), len(log))
        found.append(out)
    return found


def in_discrete_time() -> obsynth.DescriptorSystem:
    return obsynth.DescriptorSystem(
        A=[[0.9, 0.1], [0.05, 0.8]], B=[[1.0], [0.5]], C=np.eye(2), Bf=[[1], [0]], dt=1.0,
        sensor_noise={"y1": 0.05, "y2": 0.05},
    )  # fmt: skip


#: One design of each kind whose residuals are watched.
WATCHED = {
    "PI observer": lambda: obsynth.ui_pi_observer(in_discrete_time()),
    "fault estimation filter": lambda: obsynth.fault_estimation_filter(in_discrete_time()),
    "functional filter": lambda: obsynth.functional_filter(in_discrete_time()),
    "optimal filter": lambda: obsynth.optimal_filter(in_discrete_time()),
    "PD observer": lambda: designed("smib/pd_observer"),
    "Kalman filter with faults": lambda: designed(WALKING),
    "Kalman filter with a slow sensor": lambda: designed(SLOWLY_SEEN),
}


def predicted_closely(design: obsynth.ObserverDesign) -> LearnedThresholds:
    """Return thresholds of which one column is predicted to a tenth of its deviation: a row without the one before is
    no evidence."""
    thresholds = told(design)
    model = thresholds.statistics.model
    past = np.array([0.997 * np.eye(model.channels), np.zeros((model.channels, model.channels))])
    close = Autoregression(0.003 * model.offset, past, model.whitener)
    assert close.rests_on_the_past
    return replace(thresholds, statistics=replace(thresholds.statistics, model=close))


def with_gaps(log: pd.DataFrame, seed: int) -> pd.DataFrame:
    """Return a log without single cells, without rows, and without one output for some rows."""
    rng, gaps, signals = np.random.default_rng(seed), log.copy(), list(log.columns[1:])
    gaps.loc[:, signals] = gaps[signals].mask(rng.random((len(log), len(signals))) < 0.02)
    for first in rng.integers(0, len(log), 3):
        gaps.loc[first : first + rng.integers(0, 12), signals] = np.nan
    first = int(rng.integers(0, len(log)))
    gaps.loc[first : first + 8, signals[-1]] = np.nan
    return gaps


@pytest.mark.one_in(3)
@pytest.mark.parametrize("kind", WATCHED)
@pytest.mark.usefixtures("taken_as_verified")
def test_c_after_gaps_says_what_a_run_says(kind: str, tmp_path: Path) -> None:
    """Rows behind a gap are no evidence where a column is predicted closely, and are where it is not."""
    design = WATCHED[kind]()
    logs = [with_gaps(log_of(design), seed) for seed in range(3)]
    for number, learned in enumerate((predicted_closely(design), told(design))):
        monitor = obsynth.online_monitor(design, "learned", normal=learned, sensor_faults=False)
        folder = tmp_path / str(number)
        folder.mkdir()
        for log, out in zip(logs, rows_in_c(design, monitor, logs, folder), strict=True):
            run = obsynth.run_on_data(design, log, monitor=monitor, warm_up=0.0, recovered="none").table
            assert {"ok", "gap"} <= set(run.status)
            statistic = run.statistic.to_numpy(float)
            assert np.isfinite(statistic).sum() >= 20
            np.testing.assert_array_equal(np.isnan(out[:, -2]), np.isnan(statistic))
            np.testing.assert_allclose(out[:, -2], statistic, rtol=1e-8)
            np.testing.assert_array_equal(out[:, -3] != 0.0, run.alarm != "")


@pytest.mark.usefixtures("taken_as_verified")
def test_c_keeps_an_alarm_of_the_start_that_is_larger_than_an_offset_as_a_run_does(tmp_path: Path) -> None:
    design = obsynth.fault_estimation_filter(in_discrete_time())
    learned = replace(told(design), logs=1, memory=300.0)
    monitor = obsynth.online_monitor(design, "learned", normal=learned, sensor_faults=False)
    small, large = log_of(design), log_of(design)
    size = float(np.nanmax(np.abs(small["y1"])))
    small["y1"] += size
    large["y1"] += 1e4 * size
    alarms = []
    for log, out in zip((small, large), rows_in_c(design, monitor, [small, large], tmp_path), strict=True):
        run = obsynth.run_on_data(design, log, monitor=monitor, warm_up=0.0, recovered="none")
        np.testing.assert_allclose(out[:, -2], run.table["statistic"], rtol=1e-9)
        alarms.append(any("taken for what is usual" in text for text in run.warnings))
    assert alarms == [True, False]


@pytest.mark.usefixtures("taken_as_verified")
def test_c_raises_levels_where_residuals_swing_as_a_run_does(tmp_path: Path) -> None:
    design = obsynth.fault_estimation_filter(in_discrete_time())
    log = log_of(design)
    log["y1"] = np.sin(np.arange(ROWS) / 8.0)
    low = 0.02 * told(design).levels
    low[0] *= 10.0
    # With fewer logs, or without offsets in them, the alarm would be ended, and levels raised by what it had reached.
    learned = replace(told(design), levels=low, logs=3, drift_limits={})
    monitor = obsynth.online_monitor(design, "learned", normal=learned, sensor_faults=False)
    run = obsynth.run_on_data(design, log, monitor=monitor, warm_up=0.0, recovered="none")
    assert any("swing to both sides" in text for text in run.warnings)
    (out,) = rows_in_c(design, monitor, [log], tmp_path)
    np.testing.assert_allclose(out[:, -2], run.table["statistic"], rtol=1e-9)

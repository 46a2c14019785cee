"""Documents that grow when they are read, FMUs that cannot be loaded, and numbers that Python alone takes for some."""

from __future__ import annotations

import hashlib
import json
import os
import tracemalloc
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy import sparse
from scipy.io import savemat

import obsynth
from obsynth.cli.main import main
from obsynth.errors import SpecError
from obsynth.monitoring.logs.text_logs import number_in_cell
from obsynth.specs.documents import read_yaml
from obsynth.specs.matrix_files import read_matrix

FMU = """<?xml version="1.0"?><fmiModelDescription fmiVersion="2.0" modelName="m" guid="{x}"><ModelExchange
modelIdentifier="m" providesDirectionalDerivative="true"/><ModelVariables><ScalarVariable name="x" valueReference="1"
causality="local" variability="continuous"><Real/></ScalarVariable><ScalarVariable name="der(x)" valueReference="2"
causality="local" variability="continuous"><Real derivative="1"/></ScalarVariable></ModelVariables><ModelStructure>
<Derivatives><Unknown index="2"/></Derivatives></ModelStructure></fmiModelDescription>"""


def stack(count: int) -> str:
    row = "[" + ",".join(["0"] * count) + "]"
    rows = f"    - &m\n      - &r {row}\n" + "      - *r\n" * (count - 1)
    matrices = "    - *m\n" * (count - 1)
    return f"A:\n{rows}{matrices}"


def test_aliases_that_multiply_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "stack.yaml"
    path.write_text(stack(20))
    assert len(read_yaml(path)["A"]) == 20
    path.write_text(stack(120))
    with pytest.raises(obsynth.SpecError, match=r"expands to 1\.7\de\+06 values: its aliases"):
        read_yaml(path)
    path.write_text("a: &a [*a]\n")
    with pytest.raises(obsynth.SpecError):
        read_yaml(path)


@pytest.mark.parametrize("entry", ["binaries/linux64/m.so", "../outside.txt"])
def test_damaged_fmus_end_in_one_error_and_leave_the_process_where_it_was(
    entry: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("fmpy")
    monkeypatch.chdir(tmp_path)
    with zipfile.ZipFile("m.fmu", "w") as archive:
        archive.writestr("modelDescription.xml", FMU)
        archive.writestr("binaries/linux64/m.so", b"not a library")
        if entry.startswith(".."):
            archive.writestr(entry, b"x")
    with pytest.raises(obsynth.SpecError, match=r"m\.fmu"):
        obsynth.from_fmu("m.fmu")
    assert Path(os.getcwd()) == tmp_path
    assert not (tmp_path.parent / "outside.txt").exists()


def _fmu_of(text: str, change: Callable[[bytearray], None], file: Path) -> None:
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("modelDescription.xml", text)
    content = bytearray(file.read_bytes())
    change(content)
    file.write_bytes(content)


def encrypted(content: bytearray) -> None:
    content[6] |= 1
    content[content.index(b"PK\x01\x02") + 8] |= 1


def of_unknown_compression(content: bytearray) -> None:
    content[8] = content[content.index(b"PK\x01\x02") + 10] = 99


def garbled(content: bytearray) -> None:
    for place in range(60, 90):
        content[place] ^= 0x5A


@pytest.mark.parametrize(
    ("declared", "change"),
    [
        ('encoding="klingon"', lambda content: None),
        ('encoding="big5"', lambda content: None),
        ("", encrypted),
        ("", of_unknown_compression),
        ("", garbled),
    ],
)
def test_descriptions_that_cannot_be_read_end_in_one_error(
    declared: str, change: Callable[[bytearray], None], tmp_path: Path
) -> None:
    """They ended in LookupError, ValueError, RuntimeError, NotImplementedError and zlib.error."""
    pytest.importorskip("fmpy")
    _fmu_of(FMU.replace("?>", f" {declared}?>", 1), change, tmp_path / "m.fmu")
    with pytest.raises(obsynth.SpecError, match=r"m\.fmu cannot be used as an FMU"):
        obsynth.from_fmu(tmp_path / "m.fmu")


def test_small_files_that_unpack_to_large_matrices_are_refused_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """3 MB of an .npz took 2.7 GB and longer than 40 s."""
    matrix = np.zeros((1000, 1000))
    np.savez_compressed(tmp_path / "A.npz", A=matrix)
    savemat(tmp_path / "A.mat", {"A": matrix}, do_compression=True)
    assert all(file.stat().st_size < matrix.nbytes / 100 for file in tmp_path.iterdir())
    assert read_matrix(tmp_path / "A.mat", where="A").shape == read_matrix(tmp_path / "A.npz", where="A").shape
    monkeypatch.setattr("obsynth.numerics.arrays.MAXIMUM_ENTRIES", matrix.size // 2)
    monkeypatch.setattr("scipy.io.loadmat", lambda _: pytest.fail("it is read"))
    with pytest.raises(obsynth.SpecError, match=r"it is too large \(1\.0e\+06 entries\)"):
        read_matrix(tmp_path / "A.mat", where="A")
    tracemalloc.start()
    with pytest.raises(obsynth.SpecError, match=r"it is too large \(1\.0e\+06 entries\)"):
        read_matrix(tmp_path / "A.npz", where="A")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < matrix.nbytes / 4


def test_gain_sets_that_unpack_to_more_are_refused_before(tmp_path: Path) -> None:
    """A few megabytes of blanks took the memory, and minutes."""
    file = tmp_path / "g.json"
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("gain_set.json", b" " * 1_000_000)
        archive.writestr("arrays.npz", b"")
    with pytest.raises(obsynth.SpecError, match="it is compressed, as no gain set is"):
        obsynth.load(file)


@pytest.mark.parametrize("text", ["1_000", "1_0.5", "1e1_0"])
def test_underscores_are_no_part_of_a_number(text: str) -> None:
    with pytest.raises(obsynth.SpecError, match="Row 7"):
        number_in_cell(text, 7, "y1")


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        (["--set", "change=nan"], "nan is no positive number"),
        (["--set", "false-alarms=2"], "2 is no probability"),
        (["--set", "window=0"], "0 is less than 1"),
        (["--jobs", "-1"], "-1 is less than 1"),
    ],
)
def test_options_out_of_their_range_are_refused_where_they_do_nothing_as_well(
    wrong: list[str], told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(["run", "--gains", "g.json", "--data", "log.csv", *wrong])
    assert told in capsys.readouterr().err


@pytest.mark.parametrize("wrong", [["--jobs", "2"], ["--cluster", "tcp://nowhere:1"]])
def test_options_of_folders_are_refused_for_one_gain_set(wrong: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "--gains", "g.json", "--data", "log.csv", *wrong]) == 2
    assert f"{wrong[0]} spreads the gain sets of a folder" in capsys.readouterr().err


PLANT = obsynth.DescriptorSystem(A=[[1000.0, 1.0], [0.0, -1.0]], B=[[1.0], [1.0]], C=[[1.0, 0.0]])


@pytest.mark.parametrize(
    ("make", "told"),
    [
        (lambda: PLANT.replace(A=[[1e155, 0.0], [0.0, 1.0]]), r"A has 1e\+155, but numbers beyond 1e\+100 overflow"),
        (lambda: PLANT.replace(C=[[1.0, -1e308]]), r"C has -1e\+308"),
        (lambda: PLANT.replace(A=sparse.csr_array([[1e155, 0.0], [0.0, 1.0]])), r"A has 1e\+155"),
        (lambda: PLANT.replace(operating_point={"x1": 1e300}), r"operating_point\['x1'\] is 1e\+300"),
        (lambda: obsynth.TimeVaryingDescriptorSystem(E=None, A=[[1e155]], C=[[1]], dt=1.0), r"A has 1e\+155"),
        (lambda: PLANT.replace(dt=10**400), "dt is a whole number of about 401 digits: give"),
        (lambda: obsynth.Step(size=1e200), r"size is 1e\+200"),
        (lambda: obsynth.Step(size=10**5000), "size is a whole number of about 5001 digits: give"),
        (lambda: obsynth.Scenario(horizon=9, noise=1e155), r"noise is 1e\+155"),
        (lambda: obsynth.Scenario(horizon=9, initial_state={"x1": -1e160}), r"initial_state\['x1'\] is -1e\+160"),
        (lambda: obsynth.Scenario(horizon=9, observer_state=[0.0, 1e160]), r"observer_state has 1e\+160"),
        (lambda: obsynth.Scenario(horizon=9, observer_state=3), "observer_state must be a list of finite numbers"),
        (lambda: obsynth.discretise(PLANT, 1.0), r"eigenvalue 1e\+03 1/s\) grows .*more often than every 0.23 s"),
        (lambda: obsynth.discretise(PLANT.replace(A=-1e99 * np.eye(2)), 1e90), r"A times sample_time is 1e\+189"),
    ],
)
def test_numbers_that_would_overflow_are_refused_by_name(make: Callable[[], object], told: str) -> None:
    with pytest.raises(SpecError, match=told):
        make()


def test_the_largest_numbers_admitted_do_not_overflow() -> None:
    plant = obsynth.DescriptorSystem(
        A=[[0.5e100, 1e100], [0.0, 0.2]], C=[[1e100, 0.0], [0.0, 1e100]], Bf=[[0.0], [1e100]], dt=1.0
    )
    obsynth.check(plant)


@pytest.mark.parametrize(
    ("part", "matrix", "told"),
    [
        ("from_fault", np.zeros((4, 1)), "from_fault is 4 by 1, but 3 by 1 is needed"),
        ("from_input", np.zeros((1, 3)), "from_input is 1 by 3, but 3 by 1 is needed"),
        ("from_state", np.zeros((0, 0)), "from_state is 0 by 0, but 3 by 2 is needed"),
        ("noise_kept", np.zeros((2, 3)), "noise_kept has 3 columns, but 2 are needed"),
    ],
)
def test_a_recovery_that_does_not_fit_its_plant_is_refused(part: str, matrix: Any, told: str, tmp_path: Path) -> None:
    """Runs and pages of such a gain set ended in errors of NumPy."""
    plant = obsynth.DescriptorSystem(
        E=np.diag([1.0, 1.0, 0.0]),
        A=[[-1.0, 0.2, 0.0], [0.0, -2.0, 0.5], [1.0, 0.5, -1.0]],
        B=[[1.0], [0.0], [0.0]],
        C=[[1, 0, 0], [0, 1, 0]],
        Bf=[[1.0], [0.0], [0.0]],
        sensor_noise={"y1": 0.1, "y2": 0.1},
    )
    obsynth.ui_pi_observer(obsynth.discretise(plant, 0.1)).save(tmp_path / "g.json")
    document = json.loads((tmp_path / "g.json").read_text("utf-8"))
    recovery = document["design"]["recovery"]
    recovery[part] = {"shape": list(matrix.shape), "data": matrix.ravel().tolist()}
    text = json.dumps(document["design"], sort_keys=True, separators=(",", ":"))
    document["sha256"] = hashlib.sha256(text.encode()).hexdigest()
    (tmp_path / "g.json").write_text(json.dumps(document), "utf-8")
    with pytest.raises(SpecError, match=f"its recovery is refused: {told}"):
        obsynth.load(tmp_path / "g.json")


def named(**names: Any) -> obsynth.DescriptorSystem:
    return obsynth.DescriptorSystem(A=np.diag([0.5, 0.2]), C=np.eye(2), dt=1.0, **names)


def test_names_may_be_an_array_or_the_index_of_a_frame() -> None:
    """`DescriptorSystem(..., output_names=frame.columns)` ended in "the truth value of an Index is ambiguous"."""
    names = pd.DataFrame({"speed": [0.0], "torque": [0.0]}).columns
    plant = named(state_names=np.array(["a", "b"]), output_names=names)
    assert plant.output_names == ("speed", "torque")
    assert plant.state_names == ("a", "b")
    assert {type(name) for name in (*plant.output_names, *plant.state_names)} == {str}


@pytest.mark.parametrize(
    ("call", "told"),
    [
        (lambda: named(output_names=np.array("a")), "output_names must be a list of non-empty texts"),
        (lambda: named(state_names=np.zeros((2, 2))), "state_names must be a list of non-empty texts"),
        (lambda: named(operating_point=3.0), "operating_point is a float: give a mapping"),
        (lambda: named(scales=np.zeros((1, 0))), "scales is a ndarray: give a mapping"),
        (lambda: obsynth.with_noise(named(), sensor_noise={1: 2}), "has no signal named 1"),
        (lambda: obsynth.load_spec(3), "path is an int: give the name of a file"),
        (lambda: obsynth.load_thresholds(None), "path is missing: give the name of a file"),
        (lambda: obsynth.verify_alarm(True), "path is a bool: give the name of a file"),
        (lambda: obsynth.verify_certificate([]), "path is a list: give the name of a file"),
        (lambda: obsynth.from_matlab(None), "path is missing: give the name of a file"),
        (lambda: obsynth.from_modelica(None), "path is missing: give the name of a file"),
        (lambda: obsynth.from_fmu([]), "path is a list: give the name of a file"),
    ],
)
def test_arguments_of_a_wrong_kind_are_refused_by_name(call: Callable[[], object], told: str) -> None:
    """Names that are numbers ended in errors of difflib, mappings that are none and paths in a TypeError."""
    with pytest.raises(SpecError, match=told):
        call()

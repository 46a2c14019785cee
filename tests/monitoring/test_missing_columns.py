"""Columns that data do not have: what is said of them on the command line and in Python, for any table."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import obsynth

PLANT = obsynth.DescriptorSystem(
    A=[[0.9, 0.1], [0.0, 0.8]], B=[[1.0], [0.0]], C=[[1.0, 0.0], [0.0, 1.0]], Bf=[[1.0], [0.0]], dt=1.0
)


@pytest.fixture(scope="module")
def design() -> obsynth.ObserverDesign:
    return obsynth.fault_estimation_filter(PLANT)


def refusal(design: obsynth.ObserverDesign, data: object) -> str:
    with pytest.raises(obsynth.SpecError) as caught:
        obsynth.run_on_data(design, data)
    return str(caught.value)


def table(*names: str) -> pd.DataFrame:
    return pd.DataFrame(np.zeros((9, len(names))), columns=list(names))


def test_a_table_without_names_is_called_so(design: obsynth.ObserverDesign, tmp_path: Path) -> None:
    told = refusal(design, pd.DataFrame(np.zeros((9, 4))))
    assert "no columns 'time', 'u1', 'y1', 'y2'" in told
    assert "numbers, not names" in told
    assert "Did you mean" not in told
    (tmp_path / "log.csv").write_text("0,1.5,2.5,3\n1,1.5,2.5,3\n", encoding="utf-8")
    assert "name the columns in the first line of a file" in refusal(design, tmp_path / "log.csv")


def test_the_remedy_is_one_for_python_too(design: obsynth.ObserverDesign) -> None:
    data = table("time", "valve", "y1", "y2").assign(time=np.arange(9.0))
    told = refusal(design, data)
    assert "no column 'u1'" in told
    assert "--map u1=YOUR_COLUMN, or columns={'u1': 'YOUR_COLUMN'}" in told
    assert obsynth.run_on_data(design, data, columns={"u1": "valve"}).rows == 9


def test_a_number_is_no_slip_of_a_name(design: obsynth.ObserverDesign) -> None:
    assert "Did you mean" not in refusal(design, table("time", "1", "y1", "y2"))
    assert "Did you mean 'U1'" in refusal(design, table("time", "U1", "y1", "y2"))


@pytest.mark.parametrize("line", ["<html>" + "x" * 5_000, ";".join(f"sensor_{i}" for i in range(900))])
def test_a_long_first_line_is_not_repeated(design: obsynth.ObserverDesign, tmp_path: Path, line: str) -> None:
    (tmp_path / "log.csv").write_text(f"{line}\n1\n", encoding="utf-8")
    told = refusal(design, tmp_path / "log.csv")
    assert len(told) < 1_000
    assert line[:8].split(";")[0] in told

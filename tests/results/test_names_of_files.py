"""What is saved has a name of its own format, in Python as at the command line."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest

import obsynth


@cache
def design() -> obsynth.ObserverDesign:
    plant = obsynth.DescriptorSystem(A=[[0.9]], C=[[1.0]], Bf=[[1.0]], dt=1.0, fault_names=["leak"])
    return obsynth.fault_estimation_filter(plant)


def simulated(path: Path) -> Path:
    return obsynth.simulate(design(), obsynth.Scenario(horizon=20.0)).write_csv(path)


WRITERS: dict[str, tuple[Callable[[Path], object], str]] = {
    "a gain set": (lambda path: design().save(path), ".json"),
    "a page": (lambda path: obsynth.html_report(design(), path), ".html"),
    "simulated signals": (simulated, ".csv"),
}


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.parametrize("suffix", [".pdf", ".yaml", ".mat"])
def test_nothing_is_written_under_the_name_of_another_format(tmp_path: Path, name: str, suffix: str) -> None:
    write, usual = WRITERS[name]
    with pytest.raises(obsynth.SpecError, match=rf"give it a name that ends in \{usual}\."):
        write(tmp_path / f"out{suffix}")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", WRITERS)
def test_a_name_of_no_format_is_anybodys(tmp_path: Path, name: str) -> None:
    write, usual = WRITERS[name]
    for file in (tmp_path / f"out{usual}", tmp_path / "out", tmp_path / "out.of-monday"):
        write(file)
        assert file.stat().st_size > 0

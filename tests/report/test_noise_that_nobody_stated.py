"""What is printed of noise: stated where somebody stated it, else assumed, in every sentence."""

from __future__ import annotations

from pathlib import Path

import pytest

import obsynth
from obsynth.plants.noise import is_noise_assumed
from obsynth.report.headline import headline

SILENT = obsynth.DescriptorSystem(A=[[0.5, 0], [0, 0.7]], C=["x1"], Bf=["x1"], dt=1)
NOISY = SILENT.replace(Bw=[[0.0], [0.0]], Dw=[[1.0]])


def printed(design: obsynth.ObserverDesign) -> str:
    """Everything that a design says of itself, and of a monitor where it has one."""
    rows = (f"{row.claim} {row.detail}" for row in design.report.checks)
    text = [str(design), *design.notes, *rows, *headline(design, None)]
    if design.method == "functional-filter":
        for options in ({"noise_bound": 3.0}, {"kind": "chi-square"}):
            text.append(obsynth.online_monitor(design, **options).statement)
    return " ".join(" ".join(text).split())


METHODS = ("functional-filter", "descriptor-kalman", "adaptive-observer", "fault-estimation-filter", "ui-pi-observer")


@pytest.mark.one_in(5)
@pytest.mark.parametrize("method", METHODS)
def test_no_sentence_calls_noise_stated_that_nobody_stated(method: str) -> None:
    text = printed(obsynth.design(SILENT, method))
    for word in ("white noise on 1 of 1", "the stated noise"):
        assert word not in text


def test_assumed_noise_is_called_so_and_stated_noise_is_not(tmp_path: Path) -> None:
    silent, noisy = obsynth.functional_filter(SILENT), obsynth.functional_filter(NOISY)
    assert is_noise_assumed(silent.plant.noise_names)
    assert not is_noise_assumed(noisy.plant.noise_names)
    for design in (silent, obsynth.load(silent.save(tmp_path / "gains.json"))):
        text = printed(design)
        assert "white noise of deviation 1 on every sensor, as none is stated" in text
        assert text.count("under the assumed noise (none is stated)") >= 1
        assert text.count("noise of deviation 1 is assumed on every sensor") == 2
    text = printed(noisy)
    assert "white noise on 1 of 1 sensors" in text
    assert "under the stated noise" in text
    assert "assumed" not in text
    # Noise by an option is stated, too.
    assert "white noise on 1 of 1 sensors" in printed(obsynth.functional_filter(SILENT, noise=1.0))


@pytest.mark.parametrize("method", ["descriptor-kalman", "adaptive-observer"])
def test_a_file_without_its_notes_calls_no_noise_stated(method: str) -> None:
    """The sentence followed the notes: without them noise that nobody stated was stated."""
    silent = obsynth.design(SILENT, method)
    assert "Q = R = identity, because no noise was given" in printed(silent)
    stripped = printed(silent.replace(notes=()))
    assert "Q = R = identity" in stripped
    assert "stated noise" not in stripped
    assert "noise of the covariances Q and R" in printed(obsynth.design(SILENT, method, Q=0.1, R=0.2))

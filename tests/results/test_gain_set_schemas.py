"""Gain sets hold the plant as written, which is eliminated and sampled again."""

from __future__ import annotations

import dataclasses
import json
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

import obsynth
from obsynth import verify
from obsynth.plants.transformations import elimination
from obsynth.plants.transformations.recovery import StateRecovery
from obsynth.results.plant_source import PlantSource, source_of
from obsynth.specs.loader import load_spec

DESIGNS = Path(__file__).parents[2] / "designs"


@pytest.fixture(scope="module")
def smib() -> obsynth.ObserverDesign:
    spec = load_spec(DESIGNS / "smib" / "spec.yaml")
    recovery = spec.transformation.recovery
    return obsynth.design(spec.plant, spec.method, name="smib", recovery=recovery, **dict(spec.options))


def test_another_schema_is_refused(smib: obsynth.ObserverDesign, tmp_path: Path):
    path = smib.save(tmp_path / "a.json")
    document = json.loads(path.read_text(encoding="utf-8"))
    path.write_text(json.dumps({**document, "schema_version": 2}), encoding="utf-8")
    with pytest.raises(obsynth.SpecError, match="schema version 2; this obsynth reads 1"):
        obsynth.load(path)


def test_the_plant_as_written_comes_back_bit_for_bit(smib, tmp_path):
    assert smib.source.sample_time == 0.02
    again = obsynth.load(smib.save(tmp_path / "smib.json"))
    for name in ("E", "A", "B", "C", "Bf", "Bd", "Dw"):
        assert np.array_equal(getattr(again.source.plant, name), getattr(smib.source.plant, name))
    assert again.source.plant.state_names == smib.source.plant.state_names
    report = verify(again)
    assert report.passed
    assert report["plant as written"].value == 0.0
    assert "eliminated 30 algebraic states; sampled every 0.02 s" in report["plant as written"].detail


def test_elimination_sampling_and_recovery_are_done_again(smib):
    def failures(design: obsynth.ObserverDesign) -> set[str]:
        return {check.name for check in verify(design).failures}

    written = smib.source.plant
    a = np.array(written.A)
    place = np.argwhere((a != 0.0) & (a != 1.0) & (a != -1.0))[0]
    a[tuple(place)] *= 1.0 + 1e-6
    assert "plant as written" in failures(smib.replace(source=PlantSource(written.replace(A=a), 0.02)))
    assert "plant as written" in failures(smib.replace(source=PlantSource(written, 0.021)))
    assert "plant as written" in failures(smib.replace(source=PlantSource(written, None)))
    exact = dataclasses.replace(smib.plant.exact, computed=not smib.plant.exact.computed)
    assert "plant as written" in failures(smib.replace(plant=smib.plant.replace(exact=exact)))
    recovery = smib.recovery
    moved = np.array(recovery.from_state)
    row = next(i for i, name in enumerate(recovery.names) if name not in smib.plant.state_names and moved[i].any())
    moved[row] *= 1.0 + 1e-6
    fields = {field.name: getattr(recovery, field.name) for field in dataclasses.fields(recovery)}
    changed = StateRecovery(**{**fields, "from_state": moved})
    assert failures(smib.replace(recovery=changed)) == {"recovery as written"}


def test_exact_numbers_behind_a_plant_of_many_states_are_known_to_rounding(smib, monkeypatch):
    """Floating point eliminates there, with other last digits on another processor: its gain sets failed."""

    def moved(design: obsynth.ObserverDesign, share: Fraction) -> obsynth.ObserverDesign:
        known = design.plant.exact
        rows = tuple(tuple(value * (1 + share) for value in row) for row in known.matrices["A"])
        exact = dataclasses.replace(known, matrices={**known.matrices, "A": rows})
        return design.replace(plant=design.plant.replace(exact=exact))

    rounding = Fraction(1, 2**52)
    assert "plant as written" in {check.name for check in verify(moved(smib, rounding)).failures}
    monkeypatch.setattr(elimination, "exact_elimination", lambda plant: None)
    spec = load_spec(DESIGNS / "smib" / "spec.yaml")
    recovery = spec.transformation.recovery
    many = obsynth.design(spec.plant, spec.method, name="smib", recovery=recovery, **dict(spec.options))
    assert verify(moved(many, rounding)).passed
    assert {check.name for check in verify(moved(many, Fraction(1, 10**8))).failures} == {"plant as written"}


@pytest.mark.long
def test_what_is_stored_twice_is_compared(smib):
    """Names, units, operating point, noise and tolerances stand in the plant and in the plant as written."""
    written, plant = smib.source.plant, smib.plant

    def failures(**changes: object) -> set[str]:
        return {check.name for check in verify(smib.replace(**changes)).failures}

    hidden = next(name for name in plant.state_names if name not in plant.output_names)
    for changed in (
        plant.replace(units={**plant.units, plant.output_names[0]: "km"}),
        plant.replace(units={**plant.units, hidden: "km"}),
        plant.replace(operating_point={**plant.operating_point, plant.output_names[0]: 7.0}),
        plant.replace(Dw=1.001 * plant.Dw),
    ):
        assert failures(plant=changed) == {"stored twice"}
    renamed = written.replace(output_names=[f"other {name}" for name in written.output_names])
    assert "stored twice" in failures(source=PlantSource(renamed, 0.02))
    observer = dataclasses.replace(smib.observer, output_names=renamed.output_names)
    assert failures(observer=observer)
    # Noise that was stated after the plant was sampled is not compared with that of the plant as written.
    louder = load_spec(DESIGNS / "smib" / "spec.yaml").plant.replace(Dw=2.0 * plant.Dw)
    assert not source_of(louder).plant.nw
    assert not failures(plant=louder, source=source_of(louder)) & {"stored twice"}


@pytest.fixture(scope="module")
def drive() -> obsynth.ObserverDesign:
    spec = load_spec(DESIGNS / "drive" / "spec.yaml")
    return obsynth.design(spec.plant, spec.method, name="drive", recovery=spec.transformation.recovery)


@pytest.mark.one_in(4)
@pytest.mark.parametrize("name", ["E", "A", "B", "Bf", "Bd", "C", "sample", "nominal", "text", "steps"])
def test_tolerances_are_those_of_the_plant_as_written(drive, name: str):
    assert verify(drive).passed
    uncertain = drive.plant.uncertainty
    change: dict[str, object] = {"written": {**uncertain.written, name: 0.9 * uncertain.written.get(name, np.eye(1))}}
    if name == "sample":
        change = {"steps": (uncertain.steps[0], ("sample", 0.03))}
    elif name == "steps":
        change = {"steps": (*uncertain.steps, ("balance", 0.0))}
    elif name == "nominal":
        k = uncertain.box.constants["k"]
        box = {**uncertain.box.constants, "k": dataclasses.replace(k, nominal=20.5)}
        change = {"box": dataclasses.replace(uncertain.box, constants=box)}
    elif name == "text":
        entries = {key: tuple((i, j, text.replace("-k", "-0.9 * k")) for i, j, text in found)
                   for key, found in uncertain.entries.items()}  # fmt: skip
        change = {"entries": entries}
    plant = drive.plant.replace(uncertainty=dataclasses.replace(uncertain, **change))
    assert {check.name for check in verify(drive.replace(plant=plant)).failures} == {"tolerances as written"}
    alone = {check.name for check in verify(drive.replace(plant=plant, source=None)).failures}
    # Without the plant as written beside it, the plant of the design tells.
    assert alone & {"tolerances as written", "tolerances of the plant"}


def test_a_changed_plant_forgets_what_it_was_made_from(smib):
    plant = load_spec(DESIGNS / "smib" / "spec.yaml").plant
    assert source_of(plant).sample_time == 0.02
    assert source_of(plant.replace(units={})) is not None
    assert source_of(plant.replace(A=1.001 * plant.A)) is None


def test_the_gain_over_all_disturbances_is_at_least_that_of_fast_sines(smib):
    """No feedthrough: the lifted norm.  A sine between samples is one disturbance of many."""
    written = obsynth.DescriptorSystem(
        None, [[-1.0, 2.0], [-2.0, -1.0]], C=np.eye(2), Bf=[[0.0], [1.0]], Bd=[[1.0], [0.3]], disturbance_names=["d"]
    )
    plant = obsynth.discretise(written, 0.5).plant
    design = obsynth.fault_estimation_filter(plant)
    value = design.report["gain over all d(t)"].value
    assert design.report["sampling: delay"].value == 1.0
    # Held disturbances are some of all: in the same norm their gain is no larger.
    assert value >= design.report["H-infinity norm"].value * (1.0 - 1e-6)
    # One pulse within a sample, of the worst kind, gives a gain of its own that is no larger.
    observer, samples, pieces = design.observer, 60, 20
    from scipy.linalg import expm

    step = 0.5 / pieces
    whole = expm(np.block([[written.A, written.Bd], [np.zeros((1, 3))]]) * step)
    effects = []
    for piece in range(pieces):
        x, z, shown = np.zeros(2), np.zeros(observer.order), []
        for k in range(samples):
            shown.append((observer.Cz @ z + observer.Dy @ (written.C @ x))[observer.fault_rows])
            z = observer.Az @ z + observer.By @ (written.C @ x)
            for i in range(pieces):
                x = whole[:2, :2] @ x + whole[:2, 2] * (k == 0 and i == piece)
        effects.append(np.ravel(shown))
    found = np.sqrt(0.5) * np.linalg.norm(np.array(effects), 2) / np.sqrt(step)
    assert found <= value * (1.0 + 1e-6)

"""Gain sets on disk: bit for bit, guarded by a digest, written whole or not at all, verified without a solver."""

import dataclasses
import json
import math
import os
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import obsynth
from obsynth import Certificate, DescriptorSystem, ObserverDesign, SpecError, VerificationReport, load, verify
from obsynth.files.outputs import write_atomically
from obsynth.results.checks import Check
from obsynth.results.gain_set_writing import design_as_dict, digest_of, plain, restored

AWKWARD = [-0.0, 5e-324, -2.2250738585072014e-308, 1.7976931348623157e308, 0.1, 1.0 / 3.0, np.nextafter(1.0, 2.0), 2e22]


def bits(value):
    return struct.pack("<d", value)


def same_bits(first, second):
    return first.shape == second.shape and first.tobytes() == second.tobytes() and first.dtype == second.dtype


@pytest.fixture(scope="module")
def design():
    """A continuous plant with an algebraic state, a disturbance and noise, eliminated and sampled."""
    source = DescriptorSystem(
        [[1, 0, 0], [0, 1, 0], [0, 0, 0]],
        [[-1.0, 0.4, 0.0], [0.0, -0.5, 1.0], [0.3, 0.2, -1.0]],
        [[1.0], [0.0], [0.5]],
        [[1, 0, 0], [0, 1, 0]],
        Bf=[[0.0], [1.0], [0.2]],
        Bd=[[0.2], [0.0], [0.1]],
        Bw=np.zeros((3, 2)),
        Dw=0.01 * np.eye(2),
        state_names=["x 1", "xé", "v"],
        units={"v": "pu"},
        operating_point={"v": 1.02},
    )
    reduced = obsynth.eliminate_algebraic_states(source)
    sampled = obsynth.discretise(reduced.plant, 0.1)
    return obsynth.design(
        sampled.plant, "fault-estimation-filter", name="sampled", recovery=reduced.recovery.then(sampled.recovery)
    )


@pytest.fixture
def awkward(design):
    """The design with every kind of float in gains, claims, notes, options and report."""
    gains = {**design.gains, "awkward": np.array([AWKWARD, AWKWARD[::-1]]), "empty": np.zeros((0, 3))}
    claims = {**design.certificate.claims, **{f"claim {i}": value for i, value in enumerate(AWKWARD)}}
    rows = [
        Check(f"row {value}", "c", value, -value, value, True, "s", "information")
        for value in (*AWKWARD, math.nan, math.inf)
    ]
    return design.replace(
        gains=gains,
        certificate=Certificate(design.certificate.matrices, claims),
        options={"list": [1, 2.5, None, True, "text"], "nested": {"a": [math.inf, -math.inf, math.nan]}, "S": None},
        notes=("a note with é and \u2028", ""),
        report=VerificationReport.of([*design.report.checks, *rows]),
    )


def damage(path, change):
    """Apply ``change`` to the document in ``path`` and write it back."""
    document = json.loads(path.read_text(encoding="utf-8"))
    change(document)
    path.write_text(json.dumps(document), encoding="utf-8")


class TestRoundTrip:
    def test_every_array_bit_for_bit(self, awkward, tmp_path):
        again = load(awkward.save(tmp_path / "a.json"))
        assert list(again.gains) == list(awkward.gains)
        for name in awkward.gains:
            assert same_bits(again.gains[name], awkward.gains[name]), name
        for name in awkward.certificate.matrices:
            assert same_bits(again.certificate.matrices[name], awkward.certificate.matrices[name]), name
        for part in ("plant", "observer"):
            first, second = getattr(awkward, part).as_dict(), getattr(again, part).as_dict()
            assert first.keys() == second.keys()
            # Numbers in text, and arrays of the sizes of their terms.
            assert plain(first.pop("exact", None)) == plain(second.pop("exact", None))
            for name, value in first.items():
                same = same_bits(second[name], value) if isinstance(value, np.ndarray) else second[name] == value
                assert same, (part, name)
                assert type(second[name]) is type(value)
        for field in dataclasses.fields(awkward.recovery):
            value, found = getattr(awkward.recovery, field.name), getattr(again.recovery, field.name)
            assert same_bits(found, value) if isinstance(value, np.ndarray) else found == value
        assert again.recovery.operating_point == {"v": 1.02}

    def test_claims_options_notes_and_report(self, awkward, tmp_path):
        again = load(awkward.save(tmp_path / "a.json"))
        assert {key: bits(value) for key, value in again.certificate.claims.items()} == {
            key: bits(value) for key, value in awkward.certificate.claims.items()
        }
        assert (again.name, again.method, again.notes) == (awkward.name, awkward.method, awkward.notes)
        assert again.options["list"] == [1, 2.5, None, True, "text"]
        assert [repr(value) for value in again.options["nested"]["a"]] == ["inf", "-inf", "nan"]
        assert again.solver == restored(plain(awkward.solver))
        assert len(again.report.checks) == len(awkward.report.checks)
        for first, second in zip(awkward.report.checks, again.report.checks, strict=True):
            for field in dataclasses.fields(Check):
                value, found = getattr(first, field.name), getattr(second, field.name)
                if isinstance(value, float):
                    assert bits(found) == bits(value) or (math.isnan(found) and math.isnan(value))
                else:
                    assert found == value
                    assert type(found) is type(value)

    def test_saving_again_gives_the_same_file(self, awkward, tmp_path):
        first = awkward.save(tmp_path / "a.json")
        second = load(first).save(tmp_path / "b.json")
        assert first.read_bytes() == second.read_bytes()

    def test_the_loaded_design_verifies_with_the_same_numbers(self, design, tmp_path):
        again = verify(load(design.save(tmp_path / "a.json")))
        assert again.passed
        assert json.dumps(plain(again.as_dict())) == json.dumps(plain(design.report.as_dict()))

    def test_loaded_arrays_are_read_only(self, design, tmp_path):
        again = load(design.save(str(tmp_path / "a.json")))
        for array in (again.gains["T"], again.plant.A, again.observer.Az, again.certificate.matrices["P_factor"]):
            with pytest.raises(ValueError, match="read-only"):
                array[0, 0] = 1.0

    @pytest.mark.parametrize("name", ["float", "shape", "data"])
    def test_a_signal_may_be_called_like_a_mark_of_the_format(self, name, design, tmp_path):
        names = [name, *design.plant.state_names[1:]]
        plant = design.plant.replace(state_names=names, units={name: "pu"}, operating_point={name: 1.5})
        renamed = design.replace(plant=plant, observer=dataclasses.replace(design.observer, state_names=tuple(names)))
        again = load(renamed.save(tmp_path / "a.json"))
        assert again.plant.units == {name: "pu"}
        assert again.plant.operating_point == {name: 1.5}

    @pytest.mark.parametrize(
        "value", [{"shape": 1.0, "data": 2.0}, {"float": "pu"}, {"float": 1.0}, {"a": [{"float": 3.0}]}]
    )
    def test_any_mapping_survives(self, value):
        assert restored(json.loads(json.dumps(plain(value)))) == value

    def test_what_is_not_data_is_refused(self, design, tmp_path):
        for value in (object(), {1, 2}, b"bytes", 1j, lambda: None):
            with pytest.raises(SpecError):
                design.replace(options={"bad": value}).save(tmp_path / "a.json")
        assert list(tmp_path.iterdir()) == []


def leaves(value, path=()):
    """Yield the paths of all values in a JSON document that are no containers."""
    if isinstance(value, dict):
        for key in value:
            yield from leaves(value[key], (*path, key))
    elif isinstance(value, list):
        for index, item in enumerate(value):
            yield from leaves(item, (*path, index))
    else:
        yield path


def changed(value):
    if isinstance(value, bool) or value is None:
        return not value
    if isinstance(value, int):
        return value + 1
    if isinstance(value, float):
        return math.nextafter(value, math.inf)
    return value + " "


class TestTampering:
    @pytest.mark.long
    def test_every_change_of_every_value_is_detected(self, design):
        document = json.loads(json.dumps(design_as_dict(design)))
        body = document["design"]
        assert digest_of(body) == document["sha256"]
        paths = list(leaves(body))
        assert len(paths) > 300
        for path in paths:
            parent = body
            for key in path[:-1]:
                parent = parent[key]
            value = parent[path[-1]]
            parent[path[-1]] = changed(value)
            assert digest_of(body) != document["sha256"], path
            parent[path[-1]] = value
        assert digest_of(body) == document["sha256"]

    @pytest.mark.parametrize(
        "path",
        [
            ("design", "observer", "Az", "data", 0),
            ("design", "gains", "L", "data", 1),
            ("design", "certificate", "claims", "gamma"),
            ("design", "plant", "dt"),
            ("design", "report", "checks", 0, "passed"),
            ("design", "observer", "fault_delays", 0),
            ("design", "name"),
            ("sha256",),
        ],
        ids=lambda path: ".".join(map(str, path)),
    )
    def test_a_changed_file_is_refused(self, path, design, tmp_path):
        file = design.save(tmp_path / "a.json")

        def change(document):
            for key in path[:-1]:
                document = document[key]
            document[path[-1]] = changed(document[path[-1]])

        damage(file, change)
        with pytest.raises(SpecError, match="changed") as caught:
            load(file)
        assert caught.value.path == str(file)

    def test_one_changed_character_of_a_number(self, design, tmp_path):
        file = design.save(tmp_path / "a.json")
        text = file.read_text(encoding="utf-8")
        digits = [i for i in range(1, len(text)) if text[i] in "2345678" and text[i - 1] == "."][::5]
        assert len(digits) >= 5
        for i in digits:
            file.write_text(text[:i] + chr(ord(text[i]) + 1) + text[i + 1 :], encoding="utf-8")
            with pytest.raises(SpecError, match="changed"):
                load(file)

    @pytest.mark.parametrize(
        ("key", "value", "words"),
        [
            ("kind", "something else", "no gain set"),
            ("kind", None, "no gain set"),
            ("schema_version", 3, "schema version 3"),
            ("schema_version", "1", "schema version '1'"),
            ("schema_version", None, "schema version None"),
            ("design", None, "changed"),
            ("design", [], "changed"),
            ("sha256", None, "changed"),
        ],
    )
    def test_wrong_kind_version_or_parts(self, key, value, words, design, tmp_path):
        file = design.save(tmp_path / "a.json")
        damage(file, lambda document: document.update({key: value}))
        with pytest.raises(SpecError, match=words) as caught:
            load(file)
        assert caught.value.path == str(file)

    @pytest.mark.parametrize(
        "text", ["", "{", "[]", "null", "3", "not json", '{"kind": NaN}', "\ufeff{}", "[" * 100000]
    )
    def test_no_gain_set_at_all(self, text, tmp_path):
        file = tmp_path / "a.json"
        file.write_text(text, encoding="utf-8")
        with pytest.raises(SpecError) as caught:
            load(file)
        assert caught.value.path == str(file)

    @pytest.mark.parametrize("number", ["NaN", "Infinity", "-Infinity", "1e999"])
    def test_numbers_that_json_does_not_have(self, number, design, tmp_path):
        file = design.save(tmp_path / "a.json")
        document = json.loads(file.read_text(encoding="utf-8"))
        document["design"]["plant"]["dt"] = "here"
        file.write_text(json.dumps(document).replace('"here"', number), encoding="utf-8")
        with pytest.raises(SpecError) as caught:
            load(file)
        assert caught.value.path == str(file)

    def test_bytes_that_are_no_text(self, tmp_path):
        file = tmp_path / "a.json"
        file.write_bytes(b"\xff\xfe\x00")
        with pytest.raises(SpecError):
            load(file)

    @pytest.mark.parametrize("part", ["plant", "observer", "certificate", "report", "gains", "notes", "recovery"])
    def test_a_missing_or_misshapen_part_with_a_digest_that_fits(self, part, design, tmp_path):
        for value in ("gone", 3, []):
            file = design.save(tmp_path / "a.json")

            def change(document, value=value):
                if value == "gone":
                    del document["design"][part]
                else:
                    document["design"][part] = value
                document["sha256"] = digest_of(document["design"])

            damage(file, change)
            if part == "notes" and value == []:
                assert load(file).notes == ()
            else:
                with pytest.raises(SpecError):
                    load(file)

    @pytest.mark.parametrize("part", ["name", "method"])
    def test_a_name_that_is_no_text_with_a_digest_that_fits(self, part, design, tmp_path):
        for value in (None, 3, [], {}):
            file = design.save(tmp_path / "a.json")

            def change(document, value=value):
                document["design"][part] = value
                document["sha256"] = digest_of(document["design"])

            damage(file, change)
            with pytest.raises(SpecError, match=f"{part} is .*, not a text"):
                load(file)

    def test_missing_file_and_folder(self, tmp_path):
        for path, why in ((tmp_path / "missing.json", "does not exist"), (tmp_path, "is a folder")):
            with pytest.raises(SpecError, match=why) as caught:
                load(path)
            assert caught.value.path == str(path)


class TestAtomicWriting:
    def test_replaces_a_file_and_leaves_nothing_else(self, design, tmp_path):
        target = tmp_path / "a.json"
        target.write_text("old", encoding="utf-8")
        assert design.save(target) == target
        assert [path.name for path in tmp_path.iterdir()] == ["a.json"]
        assert load(target).name == design.name

    def test_permissions_are_those_of_a_new_file(self, design, tmp_path):
        (tmp_path / "plain").write_text("", encoding="utf-8")
        assert design.save(tmp_path / "a.json").stat().st_mode == (tmp_path / "plain").stat().st_mode

    @pytest.mark.parametrize("call", ["fdopen", "chmod", "replace"])
    def test_an_existing_file_is_untouched_when_writing_fails(self, call, design, tmp_path, monkeypatch):
        target = tmp_path / "a.json"
        target.write_text("old", encoding="utf-8")

        def refuse(*_, **__):
            raise OSError(28, "No space left on device")

        monkeypatch.setattr(os, call, refuse)
        with pytest.raises(SpecError, match="No space left") as caught:
            design.save(target)
        assert caught.value.path == str(target)
        assert target.read_text(encoding="utf-8") == "old"
        assert [path.name for path in tmp_path.iterdir()] == ["a.json"]

    def test_no_part_file_is_left_by_an_interruption(self, tmp_path, monkeypatch):
        target = tmp_path / "a.json"
        target.write_text("old", encoding="utf-8")

        def interrupt(*_, **__):
            raise KeyboardInterrupt

        monkeypatch.setattr(os, "replace", interrupt)
        with pytest.raises(KeyboardInterrupt):
            write_atomically(target, "new")
        assert [path.name for path in tmp_path.iterdir()] == ["a.json"]
        assert target.read_text(encoding="utf-8") == "old"

    def test_text_that_cannot_be_encoded(self, tmp_path):
        with pytest.raises(UnicodeEncodeError):
            write_atomically(tmp_path / "a.json", "half a pair: \ud800")
        assert list(tmp_path.iterdir()) == []

    def test_a_folder_as_target(self, design, tmp_path):
        folder = tmp_path / "folder.json"
        folder.mkdir()
        with pytest.raises(SpecError, match="folder") as caught:
            design.save(folder)
        assert caught.value.path == str(folder)
        assert list(tmp_path.rglob("*")) == [folder]

    def test_a_folder_that_does_not_exist_or_is_a_file(self, design, tmp_path):
        (tmp_path / "file").write_text("", encoding="utf-8")
        for target in (tmp_path / "missing" / "a.json", tmp_path / "file" / "a.json"):
            with pytest.raises(SpecError, match="cannot be written") as caught:
                design.save(target)
            assert caught.value.path == str(target)
        assert [path.name for path in tmp_path.iterdir()] == ["file"]

    def test_saving_does_not_change_the_design(self, design, tmp_path):
        before = json.dumps(design_as_dict(design))
        design.save(tmp_path / "a.json")
        assert json.dumps(design_as_dict(design)) == before


PROGRAM = """
import sys
from obsynth import load, verify
report = verify(load(sys.argv[1]))
print(report.passed, [name for name in sys.argv[2:] if name in sys.modules])
"""


HEAVY = (
    *("cvxpy", "clarabel", "scs", "control", "slycot", "matplotlib", "pydantic"),
    *("obsynth.methods.conic", "obsynth.methods.placement", "obsynth.methods.designing"),
)


@pytest.mark.long
def test_loading_and_verifying_needs_no_solver(design, tmp_path):
    file = design.save(tmp_path / "a.json")
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", PROGRAM, str(file), *HEAVY],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": str(Path(obsynth.__file__).parents[1])},
    )
    assert done.stdout == "True []\n", done.stderr


class TestReport:
    def row(self, name="row", passed=True, kind="computed"):
        return Check(name, "claim", 1.0, 2.0, 1.0, passed, "source", kind)

    def test_an_empty_report_fails(self):
        assert not VerificationReport().passed
        assert not VerificationReport.of([self.row(kind="information")]).passed

    def test_one_failure_fails(self):
        report = VerificationReport.of([self.row("a"), self.row("b", passed=False), self.row("c")])
        assert not report.passed
        assert [check.name for check in report.failures] == ["b"]
        assert VerificationReport.of([self.row("a"), self.row("c")]).passed

    def test_rows_by_name(self):
        report = VerificationReport.of([self.row("a"), self.row("b")])
        assert report["b"].name == "b"
        with pytest.raises(KeyError, match="there are: a, b"):
            report["c"]

    def test_as_dict_and_back(self, design):
        assert VerificationReport.from_dict(VerificationReport.of([self.row()]).as_dict()).checks == (self.row(),)
        assert design.report.as_dict()["passed"] is True

    def test_bounds_with_nan_fail(self):
        from obsynth.results.checks import lower_bound_check, upper_bound_check

        for make in (upper_bound_check, lower_bound_check):
            for value, bound in ((math.nan, 1.0), (1.0, math.nan), (math.nan, math.nan)):
                assert not make("n", "c", value, bound, source="s").passed
        assert upper_bound_check("n", "c", 1.0, 1.0, source="s").passed
        assert not upper_bound_check("n", "c", np.nextafter(1.0, 2.0), 1.0, source="s").passed
        assert upper_bound_check("n", "c", 3.0, 1.0, source="s").margin == -2.0
        assert lower_bound_check("n", "c", 1.0, 1.0, source="s").passed
        assert lower_bound_check("n", "c", 1.0, 3.0, source="s").margin == -2.0

    def test_a_design_without_report_has_an_empty_one(self, design):
        bare = ObserverDesign(
            name="n", method=design.method, plant=design.plant, options={}, gains={}, observer=design.observer,
            certificate=design.certificate, solver={},
        )  # fmt: skip
        assert not bare.report.passed
        assert verify(bare).passed

    def test_an_unknown_method_and_wrong_digits(self, design):
        with pytest.raises(SpecError, match="no such method") as caught:
            verify(design.replace(method="no such method"))
        assert caught.value.path == "method"
        for digits in (0, 16, -1):
            with pytest.raises(SpecError) as caught:
                verify(design, printed_digits=digits)
            assert caught.value.path == "printed_digits"


@pytest.mark.parametrize(
    "options",
    [
        {"gamma": "a"}, {"gamma": [1.0]}, {"gamma": True}, {"tolerance": "x"}, {"gamma_margin": None},
        {"residual_weight_limit": "2"}, {"weight": "no"}, {"engine": "fast"},
        {"residual_weight_limit": 2.0, "engine": "riccati"},
    ],
    ids=str,
)  # fmt: skip
def test_options_of_a_wrong_type_are_named(options):
    plant = obsynth.DescriptorSystem(None, [[0.5]], None, [[1.0]], Bf=[[1.0]], dt=0.1)
    with pytest.raises(obsynth.SpecError, match=next(iter(options))):
        obsynth.fault_estimation_filter(plant, **options)


@pytest.mark.parametrize("plant", [None, {}, 3.0])
def test_what_is_no_plant_is_refused(plant):
    with pytest.raises(obsynth.SpecError, match="DescriptorSystem"):
        obsynth.fault_estimation_filter(plant)


def test_trouble_inside_lapack_is_a_solver_error(monkeypatch):
    def gives_up(*_: object, **__: object) -> None:
        raise np.linalg.LinAlgError("did not converge")

    monkeypatch.setattr("obsynth.methods.fault_estimation_filter.synthesis.gain_problem", gives_up)
    plant = obsynth.DescriptorSystem(None, [[0.5]], None, [[1.0]], Bf=[[1.0]], dt=0.1)
    with pytest.raises(obsynth.SolverError, match=r"LAPACK gave up \(did not converge\)"):
        obsynth.fault_estimation_filter(plant)

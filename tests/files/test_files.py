"""The one writer: whole files or none, never over inputs, pairs together, and tables that spreadsheets do not run."""

import io
import os
import signal

import pytest

from obsynth import SpecError
from obsynth.files.inputs import input_file, protect_stream, protected_inputs, read_json, read_text
from obsynth.files.outputs import (
    FileKind,
    check_output,
    check_replaceable,
    replacement_of,
    require_distinct,
    write_atomically,
    write_together,
)
from obsynth.files.signals import HeldSignals, ending_signals
from obsynth.files.tables import harmless, table_writer, unquoted

KIND = FileKind("a note", rb"\Anote:", ending=".note.txt")


@pytest.fixture(autouse=True)
def _in_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def written(name, content="note: 1"):
    with open(name, "w", encoding="utf-8") as stream:
        stream.write(content)
    return name


class TestInputsAreKept:
    @pytest.mark.parametrize("link", ["itself", "symlink", "hard link", "another way"])
    def test_under_every_name(self, link, tmp_path):
        written("in.txt")
        names = {"itself": "in.txt", "symlink": "a", "hard link": "b", "another way": str(tmp_path / "." / "in.txt")}
        os.symlink("in.txt", "a")
        os.link("in.txt", "b")
        with protected_inputs():
            assert read_text(input_file(tmp_path / "in.txt")) == "note: 1"
            for write in (check_output, lambda path: write_atomically(path, "new")):
                with pytest.raises(SpecError, match="is read by this command"):
                    write(names[link])
        assert read_text(tmp_path / "in.txt") == "note: 1"
        # Afterwards, and for another command, it is a file as any other.
        assert write_atomically(names[link], "new").name

    def test_one_that_is_read_after_the_output_was_begun(self, tmp_path):
        written("in.txt")

        def replace_what_is_read():
            with replacement_of(tmp_path / "in.txt") as (handle, _):
                os.close(handle)
                input_file(tmp_path / "in.txt")

        with protected_inputs(), pytest.raises(SpecError, match="is read by this command"):
            replace_what_is_read()
        assert (tmp_path / "in.txt").read_text() == "note: 1"
        assert os.listdir() == ["in.txt"]

    def test_what_standard_input_reads(self):
        written("in.txt")
        with protected_inputs(), open("in.txt", encoding="utf-8") as stream:
            protect_stream(stream)
            with pytest.raises(SpecError, match="as standard input"):
                check_output("in.txt")

    def test_files_that_must_differ(self):
        written("a")
        os.symlink("a", "b")
        with pytest.raises(SpecError, match="--out and --data are the same file b"):
            require_distinct({"--data": "a", "--out": "b", "--state": None})
        with pytest.raises(SpecError, match="--out and --state are the same file"):
            require_distinct({"--state": "new", "--out": "./new"})
        require_distinct({"--data": "a", "--out": "new", "--state": None})


class TestOtherFilesAreKept:
    def test_only_the_own_kind_is_replaced(self, tmp_path):
        written("own.txt")
        written("named.note.txt", "cut off")
        written("empty.txt", "")
        written("other.txt", "a letter")
        for name in ("own.txt", "named.note.txt", "empty.txt", "new.txt"):
            check_replaceable(tmp_path / name, KIND)
        with pytest.raises(SpecError, match="exists and is not a note: give another name, or --force"):
            check_replaceable(tmp_path / "other.txt", KIND)
        with pytest.raises(SpecError, match=r"own\.txt exists"):
            check_replaceable(tmp_path / "own.txt", None)

    def test_a_mark_far_behind_the_beginning_counts_at_the_end(self, tmp_path):
        kind = FileKind("a table", rb"END")
        written("long.txt", "x" * 200_000 + "END")
        check_replaceable(tmp_path / "long.txt", kind)

    @pytest.mark.skipif(os.geteuid() == 0, reason="root may write everything")
    def test_a_read_only_file(self, tmp_path):
        written("own.txt")
        os.chmod("own.txt", 0o444)
        with pytest.raises(SpecError, match="is read-only"):
            check_replaceable(tmp_path / "own.txt", KIND)


class TestPlaces:
    def test_a_link_stays_a_link(self, tmp_path):
        written("real.txt")
        os.symlink("real.txt", "link.txt")
        os.chmod("real.txt", 0o640)
        write_atomically("link.txt", "new")
        assert os.path.islink("link.txt")
        assert (tmp_path / "real.txt").read_text() == "new"
        assert (tmp_path / "real.txt").stat().st_mode & 0o777 == 0o640

    def test_no_place(self):
        os.mkfifo("pipe")
        os.symlink("nowhere/file", "dangling")
        os.symlink("loop", "loop")
        refused = {
            "pipe": "is a named pipe", "/dev/null": "is a device", "dangling": "does not exist", ".": "is a folder",
            "loop": "symbolic links", "x" * 300: "too long", "a\0b": "null",
        }  # fmt: skip
        for name, message in refused.items():
            with pytest.raises(SpecError, match=message):
                write_atomically(name, "new")
        assert sorted(os.listdir()) == ["dangling", "loop", "pipe"]

    def test_pipes_and_devices_are_not_read(self, tmp_path):
        os.mkfifo("pipe")
        for name, message in (("pipe", "is a named pipe"), ("/dev/zero", "is a device"), (".", "is a folder")):
            with pytest.raises(SpecError, match=message):
                read_text(tmp_path / name)


class TestPairs:
    def test_together(self, tmp_path):
        paths = (tmp_path / "x.c", tmp_path / "x.h")
        assert write_together(dict(zip(paths, ("source", b"header"), strict=True))) == paths
        assert [path.read_text() for path in paths] == ["source", "header"]

    @pytest.mark.parametrize("existed", [False, True])
    def test_or_not_at_all(self, existed, tmp_path, monkeypatch):
        first, second = tmp_path / "x.c", tmp_path / "x.h"
        if existed:
            first.write_text("old source")
            second.write_text("old header")
        replace, calls = os.replace, []

        def fail_second(source, target):
            calls.append(target)
            if len(calls) == 2:
                raise OSError(28, "No space left on device")
            replace(source, target)

        monkeypatch.setattr(os, "replace", fail_second)
        with pytest.raises(SpecError, match=r"x\.h cannot be written: No space left"):
            write_together({first: "source", second: "header"})
        texts = {path.name: path.read_text() for path in tmp_path.iterdir()}
        assert texts == ({"x.c": "old source", "x.h": "old header"} if existed else {})

    def test_a_folder_in_the_way_of_the_second(self, tmp_path):
        (tmp_path / "x.h").mkdir()
        with pytest.raises(SpecError, match=r"x\.h is a folder"):
            write_together({tmp_path / "x.c": "source", tmp_path / "x.h": "header"})
        assert os.listdir() == ["x.h"]


class TestJson:
    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("NaN", "NaN is not allowed"), ("[-Infinity]", "is not allowed"), ("1" + "0" * 400, "401 digits"),
            ("1e999", "1e999 is beyond"), ("-1E+0400", "beyond"), ("1" * 400 + ".0", r"1\.\.\. is beyond"),
            ("9" * 5000, "digits"), ('{"a": 1, "b": 2, "a": 3}', "'a' is there twice"), ('"\\ud800"', "surrogates"),
            ("[" * 100_000, "recursion"), ("{", "Expecting"), ("", "Expecting"),
        ],
        ids=range(12),
    )  # fmt: skip
    def test_what_is_refused(self, text, message, tmp_path):
        written("a.json", text)
        with pytest.raises(SpecError, match=f"(?s)a.json is not a JSON document.*{message}"):
            read_json(tmp_path / "a.json")

    def test_what_is_read(self, tmp_path):
        written("a.json", '\ufeff{"a": [1, -2.5e-3, 1e308, 1e-999, null, true, "\\ud83d\\ude00"]}')
        assert read_json(tmp_path / "a.json") == {"a": [1, -2.5e-3, 1e308, 0.0, None, True, "\U0001f600"]}

    def test_too_large(self, tmp_path):
        written("a.json", "[" + "1," * 100 + "1]")
        with pytest.raises(SpecError, match="too large for a document"):
            read_json(tmp_path / "a.json", most=50)


@pytest.fixture
def _usual_signals():
    """What signals do by default: whoever runs the tests may have them ignored."""
    usual = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL, signal.SIGHUP: signal.SIG_DFL}
    before = {number: signal.signal(number, handler) for number, handler in usual.items()}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.usefixtures("_usual_signals")
class TestSignals:
    @pytest.fixture(autouse=True)
    def heeded(self):
        """As in a shell in the foreground, whatever this process was told to ignore."""
        usual = {
            signal.SIGTERM: signal.SIG_DFL,
            signal.SIGHUP: signal.SIG_DFL,
            signal.SIGINT: signal.default_int_handler,
        }
        before = {number: signal.signal(number, handler) for number, handler in usual.items()}
        yield
        for number, handler in before.items():
            signal.signal(number, handler)

    @pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
    def test_an_ended_process_leaves_no_part_behind(self, name, tmp_path):
        number = getattr(signal, name)

        def write():
            with replacement_of(tmp_path / "new.txt") as (handle, _):
                os.close(handle)
                signal.raise_signal(number)

        with pytest.raises(SystemExit) as caught:
            write()
        assert caught.value.code == 128 + number
        assert os.listdir() == []
        assert signal.getsignal(number) == signal.SIG_DFL

    def test_what_the_program_has_said_of_a_signal_stays(self):
        heard = []
        before = signal.signal(signal.SIGTERM, lambda number, _: heard.append(number))
        try:
            with ending_signals():
                signal.raise_signal(signal.SIGTERM)
        finally:
            signal.signal(signal.SIGTERM, before)
        assert heard == [signal.SIGTERM]

    def test_a_row_is_finished_first_and_a_second_signal_acts_at_once(self):
        held, done = HeldSignals(), []

        def take(row, *signals):
            with held:
                for number in signals:
                    signal.raise_signal(number)
                    done.append(row)

        with ending_signals(), held.installed():
            with pytest.raises(SystemExit):
                take("row", signal.SIGTERM)
            with pytest.raises(KeyboardInterrupt):
                take("second row", signal.SIGTERM, signal.SIGINT)
            with pytest.raises(SystemExit):
                signal.raise_signal(signal.SIGTERM)
        assert done == ["row", "second row"]
        assert signal.getsignal(signal.SIGINT) == signal.default_int_handler


class TestTables:
    NAMES = ("=1+1", "+a", "-b", "@SUM(A1)", "  =x", "\tx", "\uff1dx")

    def test_no_cell_is_a_formula(self):
        stream = io.StringIO()
        table_writer(stream, ["time", *self.NAMES])([(1.0, float("nan"), "=alarm", -2.0, 0.1, 1e-300, 1, 2)])
        header, row = stream.getvalue().replace("'\t", "'").splitlines()
        assert all(cell.strip('"')[0] not in "=+-@\t \uff1d" for cell in header.split(","))
        assert row == "1.0,,'=alarm,-2.0,0.1,1e-300,1,2"

    def test_names_are_read_back(self):
        for name in (*self.NAMES, "plain", "'quoted", "it's", ""):
            assert unquoted(harmless(name)) == name

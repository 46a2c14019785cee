"""What is known to differ between platforms is not in src: encodings, line ends, integers, long doubles, signals."""

from __future__ import annotations

import ast
import gc
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest
from scipy.sparse import csr_array

import obsynth
from obsynth.numerics.sparse_factor import residual_in_twice_the_digits

ROOT = Path(__file__).parents[2]
SOURCE = ROOT / "src" / "obsynth"
#: Modules of Unix alone.
UNIX = {"fcntl", "grp", "pty", "pwd", "resource", "termios", "tty"}
#: What only some systems have in `os` and `signal`; by getattr, or with hasattr before, they may be asked for.
UNIX_NAMES = {
    "fork", "getuid", "geteuid", "getpgid", "killpg", "mkfifo", "nice", "uname", "wait", "O_DIRECTORY", "O_NOFOLLOW",
    "SIGALRM", "SIGHUP", "SIGKILL", "SIGPIPE", "SIGUSR1", "SIGUSR2", "alarm", "setitimer", "pthread_sigmask",
}  # fmt: skip
#: Types that are of other sizes elsewhere; on Windows and on Apple's ARM a long double is a double.
SIZES = {"longdouble", "clongdouble", "float96", "float128", "complex256", "int_", "uint", "long", "ulong"}


@pytest.fixture(autouse=True, scope="module")
def no_rubbish() -> Iterator[None]:
    """No rubbish is looked for among the nodes of the sources, which takes as long as reading them."""
    gc.disable()
    yield
    gc.enable()


Nodes = Sequence[ast.AST]
#: What the rules look at.
KINDS = (ast.Call, ast.Attribute, ast.Constant, ast.Import, ast.ImportFrom)


def nodes_of(text: str) -> Nodes:
    return [node for node in ast.walk(ast.parse(text)) if isinstance(node, KINDS)]


def calls(nodes: Nodes) -> Iterator[tuple[ast.Call, str]]:
    for node in nodes:
        if isinstance(node, ast.Call):
            name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
            yield node, name


def keywords(call: ast.Call) -> dict[str, ast.expr]:
    return {word.arg: word.value for word in call.keywords if word.arg}


def text_files(nodes: Nodes) -> Iterator[str]:
    """Yield files that are read or written as text without an encoding, or written without their ends of lines."""
    for call, name in calls(nodes):
        given = keywords(call)
        if name in ("read_text", "write_text") and isinstance(call.func, ast.Attribute):
            if "encoding" not in given:
                yield f"{call.lineno}: {name} without encoding"
            if name == "write_text" and "newline" not in given:
                yield f"{call.lineno}: write_text without newline"
        if name not in ("open", "fdopen", "NamedTemporaryFile"):
            continue
        constants = [arg.value for arg in [*call.args, *given.values()] if isinstance(arg, ast.Constant)]
        modes = [value for value in constants if isinstance(value, str) and set(value) <= set("rwaxbt+") and value]
        mode = modes[0] if modes else "r"
        owner = getattr(call.func, "value", None)
        if "b" in mode or getattr(owner, "id", "") in ("os", "archive", "TdmsFile", "Image", "webbrowser"):
            continue
        if "encoding" not in given:
            yield f"{call.lineno}: {name} without encoding"
        if set(mode) & set("wax") and "newline" not in given:
            yield f"{call.lineno}: {name} without newline"


def unix_alone(nodes: Nodes) -> Iterator[str]:
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from (f"{node.lineno}: import {alias.name}" for alias in node.names if alias.name in UNIX)
        if isinstance(node, ast.ImportFrom) and node.module in UNIX:
            yield f"{node.lineno}: from {node.module}"
        owner = getattr(getattr(node, "value", None), "id", "")
        if isinstance(node, ast.Attribute) and owner in ("os", "signal", "sys") and node.attr in UNIX_NAMES:
            yield f"{node.lineno}: {ast.unparse(node)}"
        text = node.value if isinstance(node, ast.Constant) and isinstance(node.value, str) else ""
        if text.startswith(("/tmp", "/dev/", "/proc", "/etc", "/usr")):
            yield f"{node.lineno}: {text!r}"


def other_sizes(nodes: Nodes) -> Iterator[str]:
    for node in nodes:
        if isinstance(node, ast.Attribute) and getattr(node.value, "id", "") == "np" and node.attr in SIZES:
            yield f"{node.lineno}: np.{node.attr}"
    for call, name in calls(nodes):
        # NumPy 1 makes 32 bits of it on Windows.
        given = [keywords(call).get("dtype"), *(call.args[:1] if name == "astype" else [])]
        if any(isinstance(kind, ast.Name) and kind.id == "int" for kind in given):
            yield f"{call.lineno}: {name} with dtype int"


def processes(nodes: Nodes) -> Iterator[str]:
    """Yield programs that are run as text without saying how that is encoded, and libraries kept in folders that go."""
    loads = any(name in ("CDLL", "external") for _, name in calls(nodes))
    for call, name in calls(nodes):
        given = keywords(call)
        if name in ("run", "Popen", "check_output") and "text" in given and "encoding" not in given:
            yield f"{call.lineno}: {name} as text without encoding"
        # A library that is loaded cannot be removed on Windows.
        if loads and name == "TemporaryDirectory" and "ignore_cleanup_errors" not in given:
            yield f"{call.lineno}: TemporaryDirectory of a library that is loaded"


RULES = (text_files, unix_alone, other_sizes, processes)


def test_src_holds_nothing_that_differs() -> None:
    """Every file is read once."""
    found = []
    for file in sorted(SOURCE.rglob("*.py")):
        nodes = nodes_of(file.read_text(encoding="utf-8"))
        found += [f"{file.relative_to(SOURCE)}:{told}" for rule in RULES for told in rule(nodes)]
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    ("rule", "code"),
    [
        (text_files, "path.write_text('a', encoding='utf-8')"),
        (text_files, "open('a', 'w', encoding='utf-8')"),
        (text_files, "open('a')"),
        (unix_alone, "import resource"),
        (unix_alone, "signal.signal(signal.SIGALRM, end)"),
        (unix_alone, "open('/tmp/a', 'rb')"),
        (other_sizes, "np.zeros(3, dtype=int)"),
        (other_sizes, "a.astype(np.longdouble)"),
        (processes, "subprocess.run(['cc'], text=True)"),
        (processes, "with TemporaryDirectory() as folder: ctypes.CDLL(folder)"),
    ],
)
def test_the_rules_find_what_differs(rule: Callable[[Nodes], Iterator[str]], code: str) -> None:
    assert list(rule(nodes_of(code)))


def test_sums_have_twice_the_digits_where_long_doubles_have_none() -> None:
    rng = np.random.default_rng(2)
    matrix = rng.standard_normal((20, 20)) * (rng.random((20, 20)) < 0.4)
    unknown = rng.standard_normal((20, 3))
    right = matrix @ unknown
    found = residual_in_twice_the_digits(csr_array(matrix), unknown, right)
    exact = [[_exact(right[i, j], matrix[i], unknown[:, j]) for j in range(3)] for i in range(20)]
    # Rounded once, and the second digits' own rounding: n^2 u^2 of the terms.
    np.testing.assert_allclose(found, exact, rtol=2.0**-52, atol=1e-28)
    assert np.max(np.abs(found)) > 0.0


def _exact(right: float, row: np.ndarray, column: np.ndarray) -> float:
    from fractions import Fraction

    return float(Fraction(right) - sum(Fraction(a) * Fraction(b) for a, b in zip(row, column, strict=True)))


@pytest.mark.parametrize("method", [obsynth.fault_estimation_filter, obsynth.functional_filter, obsynth.ui_pi_observer])
def test_proofs_need_no_long_doubles(
    method: Callable[..., obsynth.ObserverDesign], monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(5)
    a = rng.standard_normal((4, 4))
    plant = obsynth.DescriptorSystem(
        None, 0.8 * a / np.max(np.abs(np.linalg.eigvals(a))), C=rng.standard_normal((3, 4)),
        Bf=rng.standard_normal((4, 1)), Bd=rng.standard_normal((4, 1)), dt=0.1,
    )  # fmt: skip
    usual = {row.name: row.passed for row in method(plant).report.checks}
    monkeypatch.setattr(np, "longdouble", np.float64)
    design = method(plant.replace(A=plant.A.copy()))
    assert {row.name: row.passed for row in design.report.checks} == usual
    proofs = {obsynth.fault_estimation_filter: "LMI"}
    assert design.report[proofs.get(method, "stability")].status == "proved"

"""What is released: one version everywhere, extras that are what they say, a plant without its package."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import tomllib
from pathlib import Path

from benchmarks.mutants import mutants
from ruamel.yaml import YAML

import obsynth

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def names(requirements: list[str]) -> set[str]:
    return {requirement.split("[")[0].split(">")[0].strip() for requirement in requirements}


def test_there_is_one_version():
    citation = YAML(typ="safe").load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert obsynth.__version__ == PROJECT["version"] == citation["version"]
    assert citation["license"] == PROJECT["license"]


def test_no_package_under_the_gpl_is_needed():
    extras = PROJECT["optional-dependencies"]
    assert "andes" not in names(PROJECT["dependencies"])
    assert [name for name, listed in extras.items() if "andes" in names(listed)] == ["andes"]


def test_casadi_is_for_nonlinear_plants_only():
    assert "casadi" not in names(PROJECT["dependencies"])
    assert "casadi" in names(PROJECT["optional-dependencies"]["nonlinear"])
    code = (
        "import sys\nsys.modules['casadi'] = None\nimport obsynth\n"
        "try:\n    obsynth.DAEModel({'a': 'der(x) = -x'}, {'y': 'x'}, states={'x': 1.0})\n"
        "except obsynth.SpecError as error:\n    print(error)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "A nonlinear plant needs casadi, which is not installed: pip install 'obsynth[nonlinear]'\n"


def test_the_readme_is_short():
    # The table of methods grows with the methods.
    lines = (ROOT / "README.md").read_text(encoding="utf-8").splitlines()
    assert sum(len(line.split()) for line in lines if not line.startswith("|")) <= 700


def test_dir_is_the_public_names_only():
    shown = set(dir(obsynth))
    assert shown == {*obsynth.__all__, "conditions", "plotting", "types", "__version__"}
    assert obsynth.plotting.plot_data is not None
    assert obsynth.conditions.wang2015 is not None
    assert obsynth.check is not None


def test_the_package_s_docstring_lists_what_is_public_in_groups():
    words = set(re.findall(r"\w+", obsynth.__doc__ or ""))
    assert {*obsynth.__all__, "conditions", "plotting", "types"} - words == set()
    # And nothing that does not exist.
    assert {word for word in words if "_" in word} - {*obsynth.__all__, *obsynth.plotting.__all__} == set()


WARNED = {
    "theirs.py": "import warnings\n\ndef old(category):\n    warnings.warn('old', category, stacklevel=1)\n",
    "obsynth_part.py": "import warnings\n\ndef ours(category):\n    warnings.warn('old', category, stacklevel=1)\n",
    "test_warned.py": "import obsynth_part\nimport pytest\nimport theirs\n\n"
    "EACH = pytest.mark.parametrize('category', [DeprecationWarning, FutureWarning, UserWarning])\n\n"
    "@EACH\ndef test_theirs(category):\n    theirs.old(category)\n\n"
    "@EACH\ndef test_ours(category):\n    obsynth_part.ours(category)\n",
}


def test_only_warnings_that_our_code_causes_fail_a_run(tmp_path: Path) -> None:
    """What dependencies deprecate in each other does not; their other warnings, about our numbers, do."""
    for name, text in WARNED.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    places = ["-c", str(ROOT / "pyproject.toml"), "--rootdir", str(tmp_path), str(tmp_path)]
    command = [sys.executable, "-m", "pytest", "-q", "-n0", "-p", "no:cacheprovider", *places]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path)
    failed = set(re.findall(r"^FAILED \S*::(\S+)", done.stdout, re.MULTILINE))
    assert failed == {f"test_ours[{kind}]" for kind in ("DeprecationWarning", "FutureWarning", "UserWarning")} | {
        "test_theirs[UserWarning]"
    }, done.stdout
    assert "4 failed, 2 passed" in done.stdout


def test_the_floors_are_in_pyproject_alone():
    """`.ci/run` installs the oldest versions that these admit: every dependency has one."""
    listed = [
        *PROJECT["dependencies"],
        *(entry for part in PROJECT["optional-dependencies"].values() for entry in part),
    ]
    assert not [entry for entry in listed if ">=" not in entry]
    assert "--resolution lowest-direct '.[nonlinear,fast,parquet]'" in (ROOT / ".ci" / "run").read_text(
        encoding="utf-8"
    )


def test_mutants_are_killed_by_tests_that_the_readme_s_command_runs():
    named = set(re.findall(r"([\w/]+\.py)::([\w:]+)", (ROOT / "benchmarks/mutants.md").read_text(encoding="utf-8")))
    assert len(named) > 50
    for file, path in named:
        text = (ROOT / "tests" / file).read_text(encoding="utf-8")
        assert "pytestmark = pytest.mark.long" not in text, file
        found = [node for node in ast.walk(ast.parse(text))
                 if isinstance(node, ast.FunctionDef) and node.name == path.split("::")[-1]]  # fmt: skip
        assert found, f"{file}::{path}"
        marks = {ast.unparse(decorator) for node in found for decorator in node.decorator_list}
        assert "pytest.mark.long" not in marks, f"{file}::{path}"


def test_every_mutant_applies_to_the_sources_and_compiles():
    listed = [*mutants(), *mutants("Equivalent"), *mutants("Not killed by the nearest tests")]
    assert len(listed) > 100
    for mutant in listed:
        home = ROOT if mutant.file.startswith("checker/") else ROOT / "src/obsynth"
        source = (home / mutant.file).read_text("utf-8")
        changed = mutant.source(source)
        assert changed != source, mutant.was
        if mutant.file.endswith(".py"):
            ast.parse(changed)

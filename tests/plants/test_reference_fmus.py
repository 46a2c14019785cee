"""Reference models of FMI, from equations: linearised by their derivatives, and by differences where they tell none."""

from __future__ import annotations

import subprocess
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import obsynth
from obsynth.errors import PreconditionError

fmpy = pytest.importorskip("fmpy", reason="fmpy is not installed (obsynth[fmu])")
SOURCE = Path(__file__).parents[1] / "support" / "fmu_plants" / "reference.c"
# By model: name, causality, start (of the first entry), sizes, and which variable it is the derivative of; in the order
# of references, from 1.
MODELS = {
    "dahlquist": [("x", "output", 1.0, (), None), ("der(x)", "local", None, (), 1), ("k", "parameter", 1.5, (), None)],
    "vanderpol": [
        ("x0", "output", 2.0, (), None), ("der(x0)", "local", None, (), 1), ("x1", "output", 0.0, (), None),
        ("der(x1)", "local", None, (), 3), ("mu", "parameter", 1.0, (), None),
    ],
    "statespace": [
        ("A", "parameter", 0.0, (2, 2), None), ("B", "parameter", 0.0, (2, 1), None),
        ("C", "parameter", 0.0, (3, 2), None), ("D", "parameter", 0.0, (3, 1), None), ("u", "input", 0.1, (1,), None),
        ("x", "local", 0.0, (2,), None), ("der(x)", "local", None, (2,), 6), ("y", "output", None, (3,), None),
    ],
}  # fmt: skip


def description(name: str, version: str, *, derivatives: bool) -> str:
    rows, flag, lines = MODELS[name], str(derivatives).lower(), []
    for reference, (label, causality, start, sizes, of) in enumerate(rows, 1):
        fixed = causality == "parameter"
        common = f'name="{label}" valueReference="{reference}" causality="{causality}"'
        common += f' variability="{"fixed" if fixed else "continuous"}"'
        common += "" if causality == "input" else f' initial="{"calculated" if start is None else "exact"}"'
        count = int(np.prod(sizes)) if sizes else 1
        value = "" if start is None else f' start="{" ".join([str(start)] * count)}"'
        value += f' derivative="{of}"' if of else ""
        if version == "2.0":
            lines.append(f"<ScalarVariable {common}><Real{value}/></ScalarVariable>")
        else:
            inner = "".join(f'<Dimension start="{size}"/>' for size in sizes)
            lines.append(f"<Float64 {common}{value}>{inner}</Float64>")
    outputs = [i for i, row in enumerate(rows, 1) if row[1] == "output"]
    rates = [i for i, row in enumerate(rows, 1) if row[4]]
    if version == "2.0":
        head = f'fmiVersion="2.0" modelName="{name}" guid="t"'
        exchange = f'<ModelExchange modelIdentifier="{name}" providesDirectionalDerivative="{flag}"/>'
        structure = "".join(
            f"<{part}>" + "".join(f'<Unknown index="{i}"/>' for i in found) + f"</{part}>"
            for part, found in (("Outputs", outputs), ("Derivatives", rates), ("InitialUnknowns", rates))
        )
    else:
        lines.append('<Float64 name="time" valueReference="0" causality="independent" variability="continuous"/>')
        head = f'fmiVersion="3.0" modelName="{name}" instantiationToken="t"'
        exchange = f'<ModelExchange modelIdentifier="{name}" providesDirectionalDerivatives="{flag}"/>'
        calculated = [*rates, *(i for i in outputs if rows[i - 1][2] is None)]
        structure = "".join(
            f'<{part} valueReference="{i}"/>'
            for part, found in (
                ("Output", outputs), ("ContinuousStateDerivative", rates), ("InitialUnknown", calculated),
            )
            for i in found
        )  # fmt: skip
    return (
        f'<?xml version="1.0" encoding="UTF-8"?><fmiModelDescription {head}>{exchange}'
        f"<ModelVariables>{''.join(lines)}</ModelVariables><ModelStructure>{structure}</ModelStructure>"
        "</fmiModelDescription>"
    )


@pytest.fixture(scope="session")
def built(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """Return a function that builds a model once: name, version of FMI, and whether it tells derivatives."""
    from tank_fmu import stubs

    from obsynth.observers.nonlinear.c_code import compiler

    command, folder, made = compiler(), tmp_path_factory.mktemp("fmus"), dict[tuple[str, str, bool], Path]()
    if command is None:
        pytest.skip("no C compiler")

    def build(name: str, version: str, *, derivatives: bool) -> Path:
        key = name, version, derivatives
        if key in made:
            return made[key]
        text = SOURCE.read_text()
        own = text.partition("#ifdef FMI2")[2].partition("#else")[0 if version == "2.0" else 2]
        stem = f"{name}{version[0]}{derivatives}"
        source, library, target = (folder / f"{stem}.{suffix}" for suffix in ("c", "so", "fmu"))
        source.write_text(text + stubs(version, own))
        flags = [f"-D{name.upper()}", *(["-DDERIVATIVES"] if derivatives else []), "-w"]
        flags += ["-DFMI2"] if version == "2.0" else []
        subprocess.run([*command, "-shared", "-fPIC", *flags, str(source), "-o", str(library)], check=True)
        place = fmpy.platform if version == "2.0" else fmpy.platform_tuple
        with zipfile.ZipFile(target, "w") as archive:
            archive.writestr("modelDescription.xml", description(name, version, derivatives=derivatives))
            archive.write(library, f"binaries/{place}/{name}.so")
        made[key] = target
        return target

    return build


BOTH = pytest.mark.parametrize("derivatives", [True, False])
VERSIONS = pytest.mark.parametrize("version", ["2.0", "3.0"])


@BOTH
@VERSIONS
def test_dahlquist_is_one_state_that_is_its_output(built, version: str, derivatives: bool) -> None:
    path = built("dahlquist", version, derivatives=derivatives)
    with pytest.raises(PreconditionError, match="no equilibrium"):
        obsynth.from_fmu(path)
    plant = obsynth.from_fmu(path, equilibrium=True)
    np.testing.assert_allclose(plant.A, [[-1.5]], rtol=1e-9)
    np.testing.assert_array_equal(plant.C, [[1.0]])
    assert plant.output_names == plant.state_names == ("x",)
    np.testing.assert_allclose(obsynth.from_fmu(path, at={"x": 0.0, "k": 4.0}).A, [[-4.0]], rtol=1e-9)


@BOTH
@VERSIONS
def test_van_der_pol_at_its_rest(built, version: str, derivatives: bool) -> None:
    path = built("vanderpol", version, derivatives=derivatives)
    plant = obsynth.from_fmu(path, at={"x0": 0.0, "x1": 0.0, "mu": 2.5})
    np.testing.assert_allclose(plant.A, [[0.0, 1.0], [-1.0, 2.5]], rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(plant.C, np.eye(2))
    assert plant.state_names == ("x0", "x1")


@BOTH
def test_a_state_space_of_arrays(built, derivatives: bool) -> None:
    path = built("statespace", "3.0", derivatives=derivatives)
    plant = obsynth.from_fmu(path, equilibrium=True)
    assert plant.state_names == ("x[1]", "x[2]")
    assert (plant.input_names, plant.output_names) == (("u[1]",), ("y[1]", "y[2]", "y[3]"))
    wanted = {"A": [[-1.0, 0.5], [0.0, -2.0]], "B": [[1.0], [2.0]], "C": [[1.0, 0.0], [3.0, 4.0], [0.0, 0.0]],
              "D": [[0.0], [5.0], [0.25]]}  # fmt: skip
    for letter, matrix in wanted.items():
        np.testing.assert_allclose(getattr(plant, letter), matrix, rtol=1e-9, atol=1e-9)
    # At rest with u = .1: x = -A^-1 B u.
    rest = np.linalg.solve(-np.array(wanted["A"]), np.array(wanted["B"])[:, 0] * 0.1)
    np.testing.assert_allclose([plant.operating_point["x[1]"], plant.operating_point["x[2]"]], rest, rtol=1e-7)
    other = obsynth.from_fmu(path, at={"A[1,2]": 0.0, "x[1]": 0.1, "x[2]": 0.1})
    np.testing.assert_allclose(other.A, [[-1.0, 0.0], [0.0, -2.0]], rtol=1e-9, atol=1e-9)


def test_a_tank_without_derivatives_is_linearised_by_differences(tmp_path: Path) -> None:
    from tank_fmu import tank

    at = {"inflow": 0.2, "level": 4.0}
    told = obsynth.from_fmu(tank(tmp_path, "2.0"), at=at)
    (tmp_path / "other").mkdir()
    found = obsynth.from_fmu(tank(tmp_path / "other", "2.0", derivatives=False), at=at)
    for letter in "ABCD":
        np.testing.assert_allclose(getattr(found, letter), getattr(told, letter), rtol=1e-8, atol=1e-9)
    assert found.operating_point == told.operating_point

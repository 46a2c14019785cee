"""Stacks of matrices in a spec: written out, or in a file beside it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

import obsynth
from obsynth import ObserverDesign, SpecError
from obsynth.cli.main import main
from obsynth.specs.loader import load_spec

STEPS = 6
A = np.array([[[0.5 + 0.05 * k, 0.1], [0.0, 0.7]] for k in range(STEPS)])
C = np.array([[[1.0, 0.1 * k], [0.0, 1.0]] for k in range(STEPS + 1)])
Q = np.array([(0.1 + 0.01 * k) * np.eye(2) for k in range(STEPS)])
PHI = np.array([[[np.sin(k)], [1.0]] for k in range(STEPS)])


def spec(folder: Path, **changes: object) -> Path:
    """Write a spec as JSON, which is YAML; a change of ``None`` leaves a matrix out."""
    plant = {"kind": "time-varying", "dt": 1.0, "A": A.tolist(), "C": C.tolist(), "Phi": PHI.tolist()}
    options = {"Q": Q.tolist(), "R": [[0.2, 0], [0, 0.2]], "window": 3}
    for name, value in changes.items():
        (options if name in options else plant)[name] = value
    document = {
        "schema_version": 1, "name": "stacks", "plant": {k: v for k, v in plant.items() if v is not None},
        "method": {"id": "adaptive-observer", "options": options},
    }  # fmt: skip
    path = folder / "spec.yaml"
    path.write_text(json.dumps(document))
    return path


def designed(path: Path) -> ObserverDesign:
    found = load_spec(path)
    return obsynth.design(found.plant, found.method, **found.options)


def expected() -> ObserverDesign:
    plant = obsynth.TimeVaryingDescriptorSystem(None, A, C=C, Phi=PHI, dt=1.0)
    return obsynth.adaptive_observer(plant, Q=Q, R=0.2, window=3)


def assert_same(found: ObserverDesign) -> None:
    y = np.random.default_rng(1).standard_normal((STEPS + 1, 2))
    assert found.plant.horizon == STEPS
    np.testing.assert_array_equal(found.observer.run(y).states, expected().observer.run(y).states)


def test_written_out_and_from_the_command_line(tmp_path: Path, capsys) -> None:
    assert_same(designed(spec(tmp_path)))
    gains = tmp_path / "gains.json"
    assert main(["design", "--system", str(spec(tmp_path)), "--output", str(gains), "--quiet"]) == 0
    assert main(["verify", str(gains)]) == 0
    assert_same(obsynth.load(gains))
    capsys.readouterr()


def test_in_files(tmp_path: Path) -> None:
    np.savez(tmp_path / "all.npz", A=A, Q=Q)
    savemat(tmp_path / "C.mat", {"C": np.moveaxis(C, 0, -1)})
    np.savetxt(tmp_path / "Phi.csv", PHI.reshape(-1, 1), delimiter=",", fmt="%.17g")
    path = spec(
        tmp_path, A={"file": "all.npz", "variable": "A"}, Q={"file": "all.npz", "variable": "Q"},
        C={"file": "C.mat"}, Phi={"file": "Phi.csv", "stack": STEPS},
    )  # fmt: skip
    assert_same(designed(path))


def with_entry(stack: np.ndarray, entry: object) -> list:
    listed = stack.tolist()
    listed[3][1][0] = entry
    return listed


@pytest.mark.parametrize(
    ("changes", "part"),
    [
        ({"A": A[:-1].tolist()}, "stacks are good for different numbers of steps: A for 5, C for 6, Phi for 6"),
        ({"C": C[:-1].tolist()}, "A for 6, C for 5, Phi for 6. For N steps E and C need N [+] 1 matrices"),
        ({"C": C[0].tolist(), "horizon": 9}, "horizon is 9, but the stack A is good for 6 steps only"),
        ({"Q": Q[:-1].tolist()}, "Q is a stack for 5 steps"),
        ({"A": [*A.tolist(), [[1, 0]]]}, "plant.A: matrix 7 of the stack is 1 by 2, but the first is 2 by 2"),
        ({"A": [*A.tolist(), [[1, 0], [0]]]}, "plant.A: matrix 7 row 2 has 1 entry, but row 1 has 2"),
        ({"A": with_entry(A, "k")}, "plant.A: matrix 4, row 2, column 1 must be a number, not the text 'k'"),
        ({"A": with_entry(A, True)}, "plant.A: matrix 4, row 2, column 1 must be a number"),
        ({"A": with_entry(A, float("nan"))}, "NaN"),
        ({"A": [*A.tolist(), 3.0]}, "plant.A: matrix 7 must be"),
        ({"Q": [*Q.tolist(), [[1]]]}, "method.options.Q: matrix 7 of the stack is 1 by 1"),
        ({"A": {"file": "A.csv", "stack": 5}}, "A.csv has 12 rows, which cannot be shared out among 5 matrices"),
        ({"A": {"file": "A.csv", "stack": 0}}, "plant.A.stack: must be at least 1"),
        ({"A": {"file": "A.npz", "stack": 5}}, "A.npz holds a stack of 6 matrices, not 5"),
        ({"A": {"file": "bad.npz"}}, "bad.npz, matrix 3 of the stack, has nan in row 1, column 1"),
        ({"A": {"file": "empty.npz"}}, "empty.npz holds an empty stack"),
    ],
)
def test_mistakes(tmp_path: Path, changes: dict, part: str) -> None:
    np.savetxt(tmp_path / "A.csv", A.reshape(-1, 2), delimiter=",")
    np.savez(tmp_path / "A.npz", A)
    np.savez(tmp_path / "bad.npz", np.where(np.arange(STEPS)[:, None, None] == 2, np.nan, A))
    np.savez(tmp_path / "empty.npz", np.zeros((0, 2, 2)))
    with pytest.raises(SpecError, match=part):
        designed(spec(tmp_path, **changes))


def test_a_stack_is_nothing_for_a_plant_that_does_not_change(tmp_path: Path) -> None:
    document = {
        "schema_version": 1, "name": "still", "plant": {"dt": 1.0, "A": A.tolist(), "C": [[1, 0]]},
        "method": {"id": "descriptor-kalman"},
    }  # fmt: skip
    path = tmp_path / "spec.yaml"
    path.write_text(json.dumps(document))
    with pytest.raises(SpecError, match=r"plant.A: row 1, column 1 must be a number, not"):
        load_spec(path)


class TestOneVariance:
    """A number stands for that multiple of the identity, in a spec as from Python."""

    def test_it_is_the_matrix(self, tmp_path: Path) -> None:
        number = designed(spec(tmp_path, Q=0.3, R=0.2))
        matrix = designed(spec(tmp_path, Q=[[0.3, 0], [0, 0.3]]))
        y = np.random.default_rng(1).standard_normal((STEPS + 1, 2))
        np.testing.assert_array_equal(number.observer.run(y).states, matrix.observer.run(y).states)

    def test_zero_is_one_and_what_is_none_is_refused(self, tmp_path: Path) -> None:
        assert load_spec(spec(tmp_path, Q=0)).options["Q"] == 0
        with pytest.raises(SpecError) as caught:
            load_spec(spec(tmp_path, Q=-1, R=True, window=3))
        assert "method.options.Q: must be at least 0, not the number -1." in str(caught.value)
        assert "method.options.R: must be a list of rows" in str(caught.value)

"""What the papers print, by `obsynth.conditions` in a few lines each and by two solvers."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from ruamel.yaml import YAML

import obsynth
from obsynth import conditions

DESIGNS = Path(__file__).parents[2] / "designs"
SOLVERS = pytest.mark.parametrize(
    ("solver", "settings"), [("CLARABEL", {}), ("SCS", {"eps_abs": 1e-9, "eps_rel": 1e-9, "max_iters": 20_000})]
)


@cache
def paper(name: str):
    """Return the plant of a paper, and what it prints."""
    expected = YAML(typ="safe").load((DESIGNS / name / "expected.yaml").read_text(encoding="utf-8"))
    return obsynth.load_spec(DESIGNS / name / "spec.yaml").plant, expected


@SOLVERS
def test_the_least_gamma_of_wang(solver, settings):
    plant, _ = paper("wang2015")
    found = conditions.wang2015(plant, S=np.hstack([np.eye(4), plant.C.T]))
    found.problem.solve(solver=solver, **settings)
    assert np.sqrt(found.variables["gamma_squared"].value) == pytest.approx(1.464718345733, abs=1e-6)
    np.testing.assert_allclose(found.data["T"], np.diag([1, 0.5, 0.5, 1]), atol=1e-15)
    assert found.design().certificate.claims["gamma"] == pytest.approx(1.464718, abs=2e-5)


@SOLVERS
def test_the_least_gamma_with_the_printed_psi(solver, settings):
    plant, _ = paper("wang2015_printed_psi")
    found = conditions.wang2015(plant, S=np.hstack([np.eye(4), plant.C.T]))
    found.problem.solve(solver=solver, **settings)
    assert np.sqrt(found.variables["gamma_squared"].value) == pytest.approx(np.sqrt(2.0), abs=1e-6)
    np.testing.assert_allclose(found.data["Psi"], [[0.9, 0], [0.0025, 0.5], [0.0475, 0.5], [1, 0]], atol=1e-15)


@SOLVERS
def test_the_spectra_of_filasova(solver, settings):
    """The printed gains satisfy Theorem 1 as printed, and have the printed spectra."""
    plant, expected = paper("filasova")
    printed = expected["printed"]
    J, L = (np.vstack([printed[top], printed[bottom]]) for top, bottom in ("JM", "LN"))
    found = conditions.filasova_theorem1(plant, delta=0.1, reading="printed")
    P3, Y, Z = (found.variables[name] for name in ("P3", "Y", "Z"))
    found = found.changed(constraints=[P3.T @ J == Y, P3.T @ L == Z])
    found.problem.solve(solver=solver, **settings)
    assert found.problem.status == "optimal"
    gains, data = found.gains(), found.data
    J, L = (np.vstack([gains[top], gains[bottom]]) for top, bottom in ("JM", "LN"))
    np.testing.assert_allclose(gains["J"], printed["J"], atol=1e-4)
    error = np.linalg.solve(np.eye(6) + L @ data["C_o"], data["A_o"] - J @ data["C_o"])
    state = np.linalg.solve(np.eye(4) + gains["L"] @ plant.C, plant.A - gains["J"] @ plant.C)
    for name, matrix in {"P_part": plant.A - gains["J"] @ plant.C, "state_part": state, "error_system": error}.items():
        wanted = np.array([complex(*pair) for pair in printed["spectra"][name]])
        values = np.linalg.eigvals(matrix)
        upper = values[values.imag >= -1e-12]
        np.testing.assert_allclose(sorted(upper, key=abs), sorted(wanted, key=abs), atol=5e-4)


def test_the_printed_gains_are_no_solution_with_the_safe_scale():
    plant, expected = paper("filasova")
    J, L = (np.vstack([expected["printed"][top], expected["printed"][bottom]]) for top, bottom in ("JM", "LN"))
    found = conditions.filasova_theorem1(plant, delta=0.1)
    P3, Y, Z = (found.variables[name] for name in ("P3", "Y", "Z"))
    found = found.changed(constraints=[P3.T @ J == Y, P3.T @ L == Z])
    found.problem.solve(solver="CLARABEL")
    assert found.problem.status == "infeasible"


@pytest.mark.one_in(2)
@SOLVERS
def test_the_gains_of_share_pasand(solver, settings):
    plant, expected = paper("sharepasand")
    printed = expected["printed"]
    found = conditions.sharepasand(plant, fault_model="ramp", poles=[-2, -3, -4, -5, -6], **expected["given"])
    found.problem.solve(solver=solver, **settings)
    gains = found.gains()
    for letter in ("U", "D"):
        np.testing.assert_allclose(gains[letter], printed[letter], atol=1e-14)
    np.testing.assert_allclose(gains["U"] @ plant.Bf, printed["Hhat"], atol=1e-14)
    np.testing.assert_allclose(gains["Jhat"][:3], printed["Jhat"], atol=1e-14)
    np.testing.assert_allclose(found.data["UA"], expected["truth"]["UaAa"], atol=1e-14)
    # The search for the least gain ends in local minima, which another processor may change.
    assert 156.5 < np.linalg.norm(gains["K_a"]) < 157.2
    np.testing.assert_allclose(sorted(np.linalg.eigvals(gains["Ahat"]).real), [-6, -5, -4, -3, -2], rtol=1e-6)
    assert found.design().report.passed


def test_the_printed_k_of_share_pasand_with_an_f_is_stable():
    """K is recovered from the printed Ahat with its decimal points; F, which is not printed, makes it stable."""
    plant, expected = paper("sharepasand")
    truth = expected["truth"]
    found = conditions.sharepasand(plant, fault_model="ramp", **expected["given"])
    K_a = np.vstack([truth["K"], truth["F"]])
    loop = found.data["UA"] - K_a @ found.data["C_a"]
    np.testing.assert_allclose(loop[:3, :3], expected["printed"]["Ahat"], atol=1e-12)
    np.testing.assert_allclose(sorted(np.linalg.eigvals(loop).real), sorted(truth["F_poles"]), atol=2e-3)

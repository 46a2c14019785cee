"""Constraints, objectives, regions and solvers of one's own, through the front door of each method."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import cvxpy as cp
import numpy as np
import pytest

import obsynth
from obsynth import conditions
from obsynth.conditions import lmi
from obsynth.conditions.options import SEMIDEFINITE_SOLVERS

DESIGNS = Path(__file__).parents[2] / "designs"


@cache
def plant_of(name: str):
    return obsynth.load_spec(DESIGNS / name / "spec.yaml").plant


def a_filter(**options):
    return obsynth.fault_estimation_filter(plant_of("wang2015"), **options)


def a_pd(**options):
    return obsynth.pd_observer(plant_of("filasova"), **options)


def a_ui_pi(**options):
    return obsynth.ui_pi_observer(plant_of("sharepasand"), fault_model="ramp", **options)


def poles(design):
    return np.linalg.eigvals(design.observer.Az)


def h2_norm(design) -> float:
    """Return the norm from the disturbance to the fault error, by a Lyapunov equation."""
    from scipy.linalg import solve_discrete_lyapunov

    plant, gains = plant_of("wang2015"), design.gains
    loop, entering = gains["T"] @ plant.A - gains["L"] @ plant.C, gains["T"] @ plant.Bd
    gram = solve_discrete_lyapunov(loop, entering @ entering.T)
    shown = gains["W"] @ plant.C
    return float(np.sqrt(np.trace(shown @ gram @ shown.T)))


DISK = conditions.disk(0.0, 0.3)
MADE = {
    "filter, constraint": lambda: a_filter(constraints=lambda v: [cp.norm(v["Y"], 2) <= 30]),
    "filter, objective": lambda: a_filter(gamma=1.6, objective=lambda v: cp.norm(v["Y"], "fro") + cp.trace(v["P"])),
    "filter, region": lambda: a_filter(region=DISK),
    "filter, h2": lambda: a_filter(objective="h2"),
    "filter, h2 in a region": lambda: a_filter(objective="h2", region=DISK),
    "filter, h2 and gamma": lambda: a_filter(objective="h2", gamma=1.6),
    "filter, decay": lambda: a_filter(decay=1.0, weight="free", mean=3),
    "filter, another solver": lambda: a_filter(engine="lmi", solver="CLARABEL", solver_options={"max_iter": 150}),
    "pd, constraint": lambda: a_pd(delta=0.3, constraints=lambda v: [v["Z"] == 0]),
    "pd, sector": lambda: a_pd(region=conditions.sector(0.9)),
    "pd, disk": lambda: a_pd(region=conditions.disk(-3.0, 2.5)),
    "pd, theorem 2": lambda: a_pd(
        theorem=2, objective=lambda v: cp.norm(v["Y"], "fro"), region=conditions.half_plane(1)
    ),
    "ui-pi, region": lambda: a_ui_pi(region=conditions.half_plane(1) & conditions.disk(0, 10)),
    "ui-pi, constraint": lambda: a_ui_pi(
        region={"decay": 1, "radius": 10}, constraints=lambda v: [cp.norm(v["Y"], "fro") <= 2000]
    ),
    "ui-pi, objective": lambda: a_ui_pi(objective=lambda v: cp.trace(v["P"]), decay=0.5),
}


@cache
def made(name: str):
    return MADE[name]()


@pytest.mark.one_in(3)
@pytest.mark.parametrize("name", MADE)
def test_it_is_a_verified_design_that_can_be_kept(name, tmp_path):
    design = made(name)
    assert design.report.passed
    assert design.solver["engine"] == "lmi" if "engine" in design.solver else design.solver["runs"]
    again = obsynth.load(design.save(tmp_path / "own.gains.json"))
    assert obsynth.verify(again).passed
    if name != "filter, another solver":
        assert "as it stands in the paper" in design.notes[0]
        assert again.options["constraints"]


REGIONS = {
    "filter, region": lambda z: abs(z) < 0.3,
    "filter, h2 in a region": lambda z: abs(z) < 0.3,
    "pd, sector": lambda z: -z.real > 0.9 * abs(z) - 1e-6,
    "pd, disk": lambda z: abs(z + 3) < 2.5,
    "pd, theorem 2": lambda z: z.real < -1 + 1e-6,
    "ui-pi, region": lambda z: abs(z) < 10 and z.real < -1,
    "ui-pi, constraint": lambda z: abs(z) < 10 and z.real < -1,
    "ui-pi, objective": lambda z: z.real < -0.5,
}


@pytest.mark.one_in(4)
@pytest.mark.parametrize("name", REGIONS)
def test_every_eigenvalue_is_in_the_region(name):
    assert all(REGIONS[name](z) for z in poles(made(name)))
    assert "every eigenvalue in" in made(name).notes[0]


def test_what_is_asked_for_is_what_is_shipped():
    assert np.abs(made("pd, constraint").gains["L"]).max() < 1e-8
    assert made("filter, another solver").solver["runs"][-1]["solver"] in ("CLARABEL", "lower bound")
    settings = [run["settings"] for run in made("filter, another solver").solver["runs"] if "settings" in run]
    assert all(setting["max_iter"] == 150 for setting in settings)
    assert settings
    assert max(abs(poles(made("filter, decay")))) < np.exp(-1.0)
    assert made("filter, h2 and gamma").certificate.claims["gamma"] == 1.6


def test_h2_is_least_and_a_region_costs():
    least, inside, bounded = (
        h2_norm(made(name)) for name in ("filter, h2", "filter, h2 in a region", "filter, h2 and gamma")
    )
    others = [h2_norm(made(name)) for name in ("filter, constraint", "filter, region", "filter, objective")]
    assert least <= min(others) + 1e-6
    assert least <= inside + 1e-6
    assert least <= bounded + 1e-6


def test_the_least_gain_with_constraints_that_cost_nothing_is_the_paper_s():
    design = made("filter, constraint")
    assert design.certificate.claims["gamma"] == pytest.approx(1.05 * 1.464718, rel=6e-3)


BAD = {
    "no list": (lambda: a_filter(constraints=lambda v: 3.0), "give a list of cvxpy constraints"),
    "nothing": (lambda: a_filter(constraints=lambda v: None), "give a list of cvxpy constraints"),
    "no constraint in it": (lambda: a_filter(constraints=lambda v: [True]), "'own 1' is a bool: give cvxpy"),
    "no function": (lambda: a_filter(constraints=[1]), r"constraints is \[1\]: give a function of the variables"),
    "no solver": (lambda: a_filter(solver="MOSEK"), "no solver 'MOSEK' .*installed are: CLARABEL"),
    "not for matrices": (lambda: a_pd(solver="HIGHS"), "no solver 'HIGHS' .*installed are: CLARABEL"),
    "solver 3": (lambda: a_ui_pi(solver=3), "solver is 3: give the name"),
    "settings": (lambda: a_pd(solver_options=[1]), "give the solver's settings by name"),
    "unknown setting": (lambda: a_pd(solver_options={"leak": True}), "CLARABEL has no setting 'leak'"),
    "settings of another": (lambda: a_filter(solver_options={"eps": 1}), "CLARABEL has no setting .eps."),
    "no inequality": (
        lambda: a_filter(engine="riccati", constraints=lambda v: []), "engine 'riccati' solves no inequality that",
    ),
    "no inequality in a pd": (
        lambda: a_pd(engine="riccati", region=conditions.half_plane(1)), "'riccati' solves no inequality",
    ),
    "placed": (lambda: a_ui_pi(poles=[-1], constraints=lambda v: []), "cannot be combined with poles"),
    "two bounds": (lambda: a_pd(gain_bound=3, region=DISK), "cannot be combined with gain_bound"),
    "bisection": (lambda: a_filter(gamma_search="bisection", region=DISK), "bisection does not know"),
    "objective": (lambda: a_filter(objective="h3"), "objective is 'h3': give 'h2'"),
    "objective of a pd": (lambda: a_pd(objective="h2"), "objective is 'h2': give a function"),
    "objective of a ui-pi": (lambda: a_ui_pi(objective="least"), "use one of conditioning, gain, or a function"),
    "no objective": (lambda: a_filter(gamma=2, objective=lambda v: v["P"]), "give cvxpy.Minimize"),
    "region": (lambda: a_filter(region=3), "region is 3: give conditions.disk"),
    "region in words": (lambda: a_filter(region={"circle": 3}), "use one of disk, half_plane, sector"),
    "region with too few": (lambda: a_filter(region={"disk": 3}), r"disk takes \[center, radius\]"),
    "delta": (lambda: a_pd(delta=0.1, region=conditions.disk(-3, 2.5)), "-1 / delta = -10 lies outside"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_bad_input_is_told(name):
    call, told = BAD[name]
    with pytest.raises(obsynth.SpecError, match=told):
        call()


def test_what_cannot_be_is_told():
    with pytest.raises(obsynth.PreconditionError, match="puts those of the fault directions at 0"):
        a_filter(region=conditions.disk(0.5, 0.3))
    with pytest.raises(obsynth.SolverError, match=r"status 'infeasible' .* 'own 1': with these constraints nothing"):
        a_filter(constraints=lambda v: [v["gamma_squared"] <= 1.4**2])


def test_a_document_may_write_regions_and_objectives(tmp_path):
    text = (DESIGNS / "wang2015/spec.yaml").read_text().replace("plant.yaml", str(DESIGNS / "wang2015/plant.yaml"))
    text = text[: text.index("  options:")]
    more = "  options: {objective: h2, region: {disk: [0, 0.3]}, solver: CLARABEL, solver_options: {max_iter: 150}}\n"
    (tmp_path / "spec.yaml").write_text(text + more)
    spec = obsynth.load_spec(tmp_path / "spec.yaml")
    design = obsynth.design(spec.plant, spec.method, **spec.options)
    assert h2_norm(design) == pytest.approx(h2_norm(made("filter, h2 in a region")), rel=1e-6)
    (tmp_path / "spec.yaml").write_text(text + "  options: {constraints: 'lambda v: []'}\n")
    with pytest.raises(obsynth.SpecError, match=r"method\.options\.constraints"):
        obsynth.load_spec(tmp_path / "spec.yaml")


def test_installed_solvers_are_those_of_cvxpy_that_take_matrices():
    found = lmi.semidefinite_solvers()
    assert {"CLARABEL", "SCS"} <= set(found) <= set(cp.installed_solvers())
    assert not {"HIGHS", "OSQP", "SCIPY"} & set(found)


def test_solvers_that_a_gain_set_may_name_are_all_those_that_cvxpy_knows():
    """Installed here or not: a gain set may come from another machine.  Other versions of cvxpy know fewer or more."""
    from cvxpy.reductions.solvers.defines import SOLVER_MAP_CONIC

    cones_of = {name: {cone.__name__ for cone in each.SUPPORTED_CONSTRAINTS} for name, each in SOLVER_MAP_CONIC.items()}
    assert not {name for name in SEMIDEFINITE_SOLVERS if name in cones_of and not cones_of[name] & {"PSD", "SvecPSD"}}
    assert {"CLARABEL", "SCS", "MOSEK", "CVXOPT", "COPT", "SDPA"} <= set(SEMIDEFINITE_SOLVERS)

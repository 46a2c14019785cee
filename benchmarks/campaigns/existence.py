"""Existence on rational plants of which it is known: whether a design, a refusal or an unclear answer comes.

A case draws an integer plant (some with a hidden or hardly seen mode, a masked fault, a fault that reaches no output),
finds out whether an observer exists from all minors of its pencil, in fractions, and gives it to a method in other
integer coordinates and in units from 2^-13 to 2^13, the filter without its algebraic states; 3 in 10 of the plants in
discrete time are chains of integrators in continuous time, given with their algebraic states, which the package
eliminates, and then samples.  Wrong is: a design for a plant that has none; one whose estimate of constant faults does
not settle at them to 1e-4, in rational numbers; a refusal, other than an unclear one, of a plant that has one (of
functional filters those are known to exist where an observer of the whole state does).  Columns: the answer; *coarse*
is an error of 1e-6 to 1e-4 (plants that one part in 1e11 makes unsolvable), or a larger one that the design tells in
its notes, *no design* is exit code 4, 5 or 6, where nothing is claimed, *asks for noise* a plant whose outputs are
bound to each other by its equations, for which a Kalman gain needs more to be stated.
"""

from __future__ import annotations

import warnings

import numpy as np
from benchmarks.campaigns._rational_plants import Drawn, drawn_plant
from benchmarks.campaigns.frame import Outcome
from flint import fmpq, fmpq_mat

import obsynth as ob
from obsynth.methods.rounding import rounding_shares

CASES = 12000
LIMIT = 120.0  # s

#: Relative error of a settled estimate above which a design is coarse, and above which it is wrong.
_TOLERANCE, _DROWNED = 1e-6, 1e-4
_METHODS = {
    "fault-estimation-filter": ob.fault_estimation_filter,
    "pd-observer": ob.pd_observer,
    "ui-pi-observer": ob.ui_pi_observer,
    "functional-filter": ob.functional_filter,
}


def case(seed: int) -> Outcome:
    """Run one case: the method goes by the seed."""
    method = list(_METHODS)[seed % len(_METHODS)]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return judged(method, drawn_plant(method, seed))


def judged(method: str, drawn: Drawn) -> Outcome:
    """Design for a drawn plant and judge the answer."""
    g = drawn.given
    dt = drawn.dt if drawn.step is None else 0.0
    plant = ob.DescriptorSystem(g["E"], g["A"], C=g["C"], Bf=g["Bf"], Df=g["Df"], Bd=g["Bd"], Dd=g["Dd"], dt=dt)
    try:
        if method == "fault-estimation-filter" or drawn.step is not None:
            plant = ob.eliminate_algebraic_states(plant).plant
        if drawn.step is not None:
            plant = ob.discretise(plant, float(drawn.step)).plant
        design = _METHODS[method](plant)
    except ob.PreconditionError as error:
        if str(error).startswith("Unclear:"):
            return Outcome(method, "unclear")
        if error.condition == "noise of every output":
            return Outcome(method, "asks for noise")
        wrong = f"refused ({error.condition}: {error}), but an observer exists" if drawn.exists else ""
        return Outcome(method, "refused", wrong)
    except ob.ObsynthError as error:
        wrong = "" if drawn.exists is not False else f"{type(error).__name__}, though {drawn.why}"
        return Outcome(method, "no design", wrong if isinstance(error, ob.SpecError) else "")
    if drawn.exists is False:
        return Outcome(method, "designed", f"designed, but {drawn.why}")
    error = settling_error(drawn, design.observer)
    told = rounding_shares(design.plant, design.observer, 1.0 if design.plant.is_discrete else 0.0)[1]
    if error >= _DROWNED and not (design.notes and error <= np.max(told)):
        return Outcome(method, "designed", f"the estimates settle {error:.1e} off")
    return Outcome(method, "designed" if error < _TOLERANCE else "designed, coarse")


def settling_error(drawn: Drawn, observer: ob.LinearObserver) -> float:
    """Return the relative error of the fault estimates once all faults have stayed at one, all else at zero."""
    m, units = drawn.matrices, drawn.units
    discrete = drawn.dt > 0
    still = (_exact(m["E"]) if discrete else 0 * _exact(m["E"])) - _exact(m["A"])
    nf = m["Bf"].shape[1]
    if still.det() == 0:
        return 0.0  # no steady state: nothing settles
    faults = _exact(np.ones((nf, 1)))
    y = _exact(m["C"]) * still.solve(_exact(m["Bf"]) * faults) + _exact(m["Df"]) * faults
    y = _exact(np.diag(units["output"])) * y
    rest = _exact(np.eye(observer.order) if discrete else np.zeros((observer.order, observer.order)))
    z = (rest - _exact(observer.Az)).solve(_exact(observer.By) * y)
    found = _exact(observer.Cz) * z + _exact(observer.Dy) * y
    values = np.array([int(v.p) / int(v.q) for v in found.entries()])[observer.fault_rows]
    return float(np.max(np.abs(values * units["fault"] - 1.0)))


def _exact(matrix: np.ndarray) -> fmpq_mat:
    rows, columns = matrix.shape
    ratios = [
        value.as_integer_ratio() if hasattr(value, "as_integer_ratio") else (value, 1) for value in matrix.ravel()
    ]
    return fmpq_mat(rows, columns, [fmpq(*ratio) for ratio in ratios])

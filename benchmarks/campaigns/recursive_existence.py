"""Existence of recursive observers on rational plants of which it is known, by brute force over all minors.

The plants are those of the campaign `existence`: integer plants in other integer coordinates and in units from 2^-13 to
2^13, some with a hidden or hardly seen mode, 3 in 10 sampled by the package after it has eliminated their algebraic
states; the others keep theirs.  A Kalman filter exists where equations and outputs determine the state and every hidden
mode dies out, an adaptive observer where the parameters leave traces of their own besides.  Wrong is a design for a
plant that has none, and a refusal, other than an unclear one, of a plant that has one.  Columns: the answer; *noise* is
a refusal that names the covariances (both of size one in the plant's own units) or the double precision of the steps.
"""

from __future__ import annotations

import warnings

from benchmarks.campaigns._rational_plants import RECURSIVE, Drawn, drawn_plant
from benchmarks.campaigns.frame import Outcome

import obsynth as ob

CASES = 2000
LIMIT = 120.0  # s

_METHODS = {"descriptor-kalman": ob.descriptor_kalman, "adaptive-observer": ob.adaptive_observer}
#: Conditions that depend on the covariances and on the start, which the truth does not know.
_OF_THE_NOISE = ("contraction", "bounded errors", "residual directions")


def case(seed: int) -> Outcome:
    """Run one case: the method goes by the seed."""
    method = RECURSIVE[seed % len(RECURSIVE)]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return judged(method, drawn_plant(method, seed))


def judged(method: str, drawn: Drawn) -> Outcome:
    """Design for a drawn plant and judge the answer."""
    g = drawn.given
    plant = ob.DescriptorSystem(
        g["E"], g["A"], C=g["C"], Bf=g["Bf"], Df=g["Df"], dt=drawn.dt if drawn.step is None else 0.0
    )
    try:
        if drawn.step is not None:
            plant = ob.discretise(ob.eliminate_algebraic_states(plant).plant, float(drawn.step)).plant
        _METHODS[method](plant, Q=1.0, R=1.0)
    except ob.PreconditionError as error:
        if str(error).startswith("Unclear:"):
            return Outcome(method, "unclear")
        if error.condition in _OF_THE_NOISE:
            return Outcome(method, "noise")
        wrong = f"refused ({error.condition}: {error}), but an observer exists" if drawn.exists else ""
        return Outcome(method, "refused", wrong)
    except ob.ObsynthError as error:
        return Outcome(method, "no design", str(error) if isinstance(error, ob.SpecError) else "")
    return Outcome(method, "designed", "" if drawn.exists else f"designed, but {drawn.why}")

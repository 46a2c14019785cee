"""One sensor more never makes a design worse: a copy, a scaled one, a nearly equal one, a dead one, one of an input.

Random plants with one sensor of white noise, and the same plants with one sensor more, whose noise is stated.  For each
method that exists with one sensor: it exists with both, is verified, and its fault estimate has at most 1.001 times the
deviation (of the sensors' noise alone); gamma and decay that are claimed are no worse by the same factor.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.linalg
from benchmarks.campaigns.frame import Outcome

import obsynth

CASES = 250
LIMIT = 120.0
WORSE = 1.001
NOISE = 0.1
#: Share of the first sensor in the one that is added, its share of a direction of its own, of the input, its noise.
SENSORS = {
    "copy": (1.0, 0.0, 0.0, NOISE),
    "scaled": (10.0, 0.0, 0.0, 10.0 * NOISE),
    "nearly equal": (1.0, 1e-3, 0.0, NOISE),
    "dead": (0.0, 0.0, 0.0, NOISE),
    "of an input": (0.0, 0.0, 2.0, NOISE),
}
#: By method: whether its plants are sampled, and its options.
METHODS: dict[str, tuple[bool, dict[str, Any]]] = {
    "ui-pi-observer": (False, {}),
    "ui-pi-observer, poles": (False, {}),
    "pd-observer": (False, {"decay": 0.3}),
    "functional-filter": (False, {"decay": 0.3}),
    "fault-estimation-filter": (True, {}),
}


def case(seed: int) -> Outcome:
    """Compare a design with one sensor and with two."""
    kinds, methods = list(SENSORS), list(METHODS)
    kind, name = kinds[seed % len(kinds)], methods[seed // len(kinds) % len(methods)]
    sampled, options = METHODS[name]
    method, options = name.partition(",")[0], dict(options)
    one, both = _plants(np.random.default_rng([49, seed]), kind, sampled=sampled)
    if name.endswith("poles"):
        options["poles"] = list(-np.linspace(3.0, 4.0, one.nx + 1))
    try:
        alone = obsynth.design(one, method, **options)
    except obsynth.ObsynthError:
        return Outcome(kind, f"{name}: none with one sensor")
    more = obsynth.design(both, method, **options)
    wrong = [] if more.report.passed else ["not verified"]
    deviations = [_deviation(design) for design in (alone, more)]
    if deviations[1] > WORSE * deviations[0]:
        wrong.append(f"deviation {deviations[1]:.4g} with two, {deviations[0]:.4g} with one")
    first, second = (design.certificate.claims for design in (alone, more))
    if "gamma" in first and second["gamma"] > WORSE * first["gamma"]:
        wrong.append(f"gamma {second['gamma']:.4g} with two, {first['gamma']:.4g} with one")
    if second.get("decay", 0.0) < first.get("decay", 0.0) / WORSE:
        wrong.append(f"decay {second['decay']:.4g} with two, {first['decay']:.4g} with one")
    return Outcome(kind, name, "; ".join(wrong))


def _plants(
    rng: np.random.Generator, kind: str, *, sampled: bool
) -> tuple[obsynth.DescriptorSystem, obsynth.DescriptorSystem]:
    """Return a plant with one sensor, and with one more."""
    n = int(rng.integers(2, 5))
    a = rng.standard_normal((n, n)) - 1.5 * np.eye(n)
    if sampled:
        a = scipy.linalg.expm(0.2 * a)
    c, own, b, bf = (rng.standard_normal(shape).round(3) for shape in ((1, n), (1, n), (n, 1), (n, 1)))
    share, apart, direct, noise = SENSORS[kind]
    given: dict[str, Any] = {"A": a.round(3), "B": b, "Bf": bf, "dt": 0.2 if sampled else 0.0}
    one = obsynth.DescriptorSystem(**given, C=c, Dw=[[NOISE]])
    both = obsynth.DescriptorSystem(
        **given, C=np.vstack([c, share * c + apart * own]), D=[[0.0], [direct]], Dw=np.diag([NOISE, noise])
    )
    return one, both


def _deviation(design: obsynth.ObserverDesign) -> float:
    """Return the deviation of the fault estimate under the sensors' noise."""
    observer, noise = design.observer, design.plant.Dw
    into, row = observer.By @ noise, observer.Cz[observer.fault_rows]
    direct = observer.Dy[observer.fault_rows] @ noise
    if design.plant.dt:
        spread = scipy.linalg.solve_discrete_lyapunov(observer.Az, into @ into.T)
        return float(np.sqrt((row @ spread @ row.T + direct @ direct.T)[0, 0]))
    spread = scipy.linalg.solve_continuous_lyapunov(observer.Az, -into @ into.T)
    return float(np.sqrt((row @ spread @ row.T)[0, 0]))

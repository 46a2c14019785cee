"""Gain sets as shipped, with one or two of their numbers changed: what still passes must claim no more than is true.

A case takes the gain set (schema 2) of one of ten designs by all seven methods, changes one of its numbers, or two
(claims, certificate, listed gains, observer, plant, plant as written, way back, options), by a factor, in sign or to
zero, and makes the digest fit again.  It may be refused when it is read or when it is verified.  Of what passes,
stability, poles, rates, norms, leaks, noise and bounds of stored numbers are compared with the truth (`_true_claims`:
mpmath, fractions and grids of frequencies of plant and stored observer together; a covariance filter of its own for
recursive designs; of nonlinear ones the claims before).  Columns: what became of it.
"""

from __future__ import annotations

import hashlib
import json
import tempfile
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from benchmarks.campaigns._mutations import holder_of
from benchmarks.campaigns._true_claims import raised
from benchmarks.campaigns.frame import Outcome

import obsynth as ob
from obsynth.results.gain_set_writing import design_as_dict
from obsynth.specs.loader import load_spec

CASES = 3_000
LIMIT = 120.0  # s: a busy machine is no hang
_DESIGNS = Path(__file__).parents[2] / "designs"
#: How often each design is drawn; those of the last three take half a second each.
DESIGNS = {
    "filter": 0.16, "filter, sampled": 0.12, "PD observer": 0.12, "PD observer, all claims": 0.14,
    "UI-PI observer": 0.14, "functional filter": 0.12, "Kalman filter": 0.08, "adaptive observer": 0.04,
    "random walk": 0.04, "nonlinear": 0.04,
}  # fmt: skip
#: Parts of a gain set, and how often a number of each is changed.
PARTS = {
    "claims": 0.3, "matrices": 0.2, "observer": 0.2, "gains": 0.12, "options": 0.06, "plant": 0.06, "source": 0.03,
    "recovery": 0.03,
}  # fmt: skip
_SPECS = {
    "filter": "wang2015/spec", "filter, sampled": "smib/spec", "PD observer": "smib/pd_observer",
    "UI-PI observer": "sharepasand/spec", "functional filter": "motor/sampled", "nonlinear": "moussaali2013_dae/spec",
}  # fmt: skip
_MATRICES = {
    "E": np.diag([1.0, 1.0, 0.0]), "A": [[0.8, 0.1, 0.3], [0.0, 0.7, 0.2], [1.0, 0.4, -1.0]],
    "B": [[1.0], [0.5], [0.2]], "C": [[1.0, 0.0, 0.3], [0.0, 1.0, 1.0]],
}  # fmt: skip
_PARAMETERS = {"Phi": [[0.5, 0.3], [1.0, 0.2], [0.2, 0.0]], "Psi": None}


@cache
def base(name: str) -> ob.ObserverDesign:
    """Return a good design."""
    if name in _SPECS:
        spec = load_spec(_DESIGNS / f"{_SPECS[name]}.yaml")
        return ob.design(spec.transformation or spec.plant, spec.method, name=spec.name, **spec.options)
    if name == "PD observer, all claims":
        plant = load_spec(_DESIGNS / "filasova/spec.yaml").plant
        return ob.pd_observer(plant, decay=0.3, disk=[6.0, 6.0], gain_bound=20.0, fault_rate_gain=2.0, noise_gain=6.0)
    if name == "Kalman filter":
        plant = ob.TimeVaryingDescriptorSystem(**_MATRICES, dt=1.0, horizon=80)
        return ob.descriptor_kalman(plant, Q=0.1, R=0.2)
    varying = {**_MATRICES, "A": [["0.8 + 0.1 * cos(0.2 * k)", 0.1, 0.3], [0, 0.7, "0.2 * sin(k)"], [1, 0.4, -1]]}
    plant = ob.TimeVaryingDescriptorSystem(**varying, **_PARAMETERS, dt=1.0, horizon=80)
    walk = {"form": "random-walk", "random_walk": 1e-3} if name == "random walk" else {}
    return ob.adaptive_observer(plant, Q=0.1, R=0.2, window=10, **walk)


@cache
def _text(name: str) -> str:
    return json.dumps(design_as_dict(base(name)))


def case(seed: int) -> Outcome:
    """Change one number of a gain set, or two, and compare what passes with the truth."""
    rng = np.random.default_rng(seed)
    name = str(rng.choice(list(DESIGNS), p=list(DESIGNS.values())))
    document = json.loads(_text(name))
    for _ in range(1 + int(rng.random() < 0.2)):
        part = _tamper(document["design"], rng)
    document["sha256"] = _digest(document["design"])
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "gains.json"
        file.write_text(json.dumps(document), "utf-8")
        try:
            design = ob.load(file)
        except ob.SpecError:
            return Outcome(f"{name}: {part}", "not read")
    try:
        report = ob.verify(design)
    except ob.ObsynthError as error:
        return Outcome(f"{name}: {part}", f"refused ({type(error).__name__})")
    if not report.passed:
        return Outcome(f"{name}: {part}", "refused")
    false = "; ".join(raised(design, base(name), report))
    return Outcome(f"{name}: {part}", "passed, and false" if false else "passed, and true", false)


def _tamper(body: dict[str, Any], rng: np.random.Generator) -> str:
    """Change one number; return in which part it is."""
    parts = {
        "claims": body["certificate"]["claims"], "matrices": body["certificate"]["matrices"],
        **{name: body.get(name) for name in ("observer", "gains", "options", "plant", "source", "recovery")},
    }  # fmt: skip
    found = {name: list(_numbers(part)) for name, part in parts.items()}
    found = {name: paths for name, paths in found.items() if paths}
    weights = np.array([PARTS[name] for name in found])
    part = str(rng.choice(list(found), p=weights / weights.sum()))
    path = found[part][int(rng.integers(len(found[part])))]
    holder, kind = holder_of(parts[part], path), rng.random()
    value = float(holder[path[-1]])
    if kind < 0.1:
        changed = -value
    elif kind < 0.2:
        changed = 0.0 if value else float(10.0 ** rng.uniform(-12.0, 1.0))
    else:
        factor = 1.0 + float(rng.choice([-1.0, 1.0]) * 10.0 ** rng.uniform(-12.0, 1.0))
        changed = value * factor if value else float(10.0 ** rng.uniform(-12.0, 1.0))
    holder[path[-1]] = changed
    return part


def _numbers(tree: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the path of every number but those that say how large an array is."""
    items = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    for key, value in items:
        if isinstance(value, (int, float)) and not isinstance(value, bool):
            yield (*path, key)
        elif key != "shape":
            yield from _numbers(value, (*path, key))


def _digest(body: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(body, sort_keys=True, separators=(",", ":")).encode()).hexdigest()

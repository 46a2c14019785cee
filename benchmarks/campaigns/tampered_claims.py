"""Gain sets with one number changed: what still passes must claim no more than what is true.

The truth is computed here with numpy alone: eigenvalues of the stored matrix, and the gain of plant and stored observer
together on a grid of frequencies.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
from benchmarks.campaigns.frame import Outcome

import obsynth as ob

CASES = 3_000
LIMIT = 60.0  # s
FOLDER = Path(__file__).parents[2] / "tests" / "data" / "schema_1"
#: How often each design is drawn; the last two take a second each.
DESIGNS = {
    "wang2015_spec": 0.32, "sharepasand_spec": 0.32, "smib_pd_observer": 0.32, "moussaali2013_ltv_spec": 0.02,
    "moussaali2013_dae_spec": 0.02,
}  # fmt: skip
#: Claims may exceed the truth by this share.
TOLERANCE = 1e-3
FREQUENCIES = np.geomspace(1e-6, np.pi, 40)  # rad per sample


def case(seed: int) -> Outcome:
    """Change one number of a gain set, and compare what passes with the truth."""
    rng = np.random.default_rng(seed)
    name = str(rng.choice(list(DESIGNS), p=list(DESIGNS.values())))
    changed, part = tampered(base(name), rng)
    report = ob.verify(changed)
    if not report.passed:
        return Outcome(f"{name}: {part}", "refused")
    false = raised(changed)
    return Outcome(f"{name}: {part}", "passed, and true" if not false else "passed, and false", false)


@cache
def base(name: str) -> ob.ObserverDesign:
    """Return a good design."""
    return ob.load(FOLDER / f"{name}.json")


def tampered(design: ob.ObserverDesign, rng: np.random.Generator) -> tuple[ob.ObserverDesign, str]:
    """Return the design with one number changed, and where."""
    factor = 1.0 + float(rng.choice([-1.0, 1.0]) * 10.0 ** rng.uniform(-12.0, 1.0))
    certificate, parts = design.certificate, ["claims"]
    if isinstance(design.observer, ob.LinearObserver):
        parts += ["observer", "gains", "witnesses"]
    part = str(rng.choice(parts))
    if part == "claims":
        key = str(rng.choice(sorted(certificate.claims)))
        claims = {**certificate.claims, key: certificate.claims[key] * factor}
        return replace(design, certificate=replace(certificate, claims=claims)), part
    if part == "observer":
        field = str(rng.choice(["Az", "By", "Cz", "Dy"]))
        return replace(
            design, observer=replace(design.linear[1], **{field: _one(getattr(design.observer, field), factor, rng)})
        ), part
    if part == "gains":
        letter = str(rng.choice(sorted(design.gains)))
        return replace(design, gains={**design.gains, letter: _one(design.gains[letter], factor, rng)}), part
    key = str(rng.choice(sorted(certificate.matrices)))
    matrices = {**certificate.matrices, key: _one(certificate.matrices[key], factor, rng)}
    return replace(design, certificate=replace(certificate, matrices=matrices)), part


def _one(matrix: np.ndarray, factor: float, rng: np.random.Generator) -> np.ndarray:
    found = np.array(matrix)
    if found.size:
        found.flat[int(rng.integers(found.size))] *= factor
    return found


def raised(design: ob.ObserverDesign) -> str:
    """Return which claim is more than the truth; empty where none is."""
    claims, good = design.certificate.claims, base_claims(design)
    if not isinstance(design.observer, ob.LinearObserver):
        far = [name for name, value in claims.items() if abs(value - good[name]) > 1e-5 * max(abs(good[name]), 1e-5)]
        return ", ".join(far)
    plant, observer = design.linear
    values = np.linalg.eigvals(observer.Az)
    rate = -np.log(np.max(np.abs(values))) / plant.dt if plant.dt else -np.max(values.real)
    if claims.get("decay", 0.0) > rate * (1.0 + TOLERANCE):
        return f"decay {claims['decay']:.6g}, true {rate:.6g}"
    if "gamma" in claims and max(map(lambda w: gain(plant, observer, w), FREQUENCIES)) > claims["gamma"] * (
        1.0 + TOLERANCE
    ):
        return f"gamma {claims['gamma']:.6g}"
    return ""


def base_claims(design: ob.ObserverDesign) -> dict[str, float]:
    """Return the claims of the design before it was changed."""
    found = {base(name).name: base(name) for name in DESIGNS if base(name).method == design.method}
    return dict(found[design.name].certificate.claims)


def gain(plant: ob.DescriptorSystem, observer: ob.LinearObserver, frequency: float) -> float:
    """Return the gain from the disturbances to the fault estimates, of plant and stored observer together."""
    z = np.exp(1j * frequency)
    y = plant.C @ np.linalg.solve(z * plant.E - plant.A, plant.Bd.astype(complex)) + plant.Dd
    states = np.linalg.solve(z * np.eye(observer.order) - observer.Az, observer.By @ y)
    rows = observer.fault_rows
    return float(np.linalg.norm(observer.Cz[rows] @ states + observer.Dy[rows] @ y, 2))

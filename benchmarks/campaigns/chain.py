"""Certificates with one entry changed anywhere, digests made anew: none that is false may verify.

A case takes a gain set with tolerances, the certificate of an alarm, of a robustness analysis or of a comparison, or
a calibration file, of a plant of one or two states drawn with its seed, changes one number, text or list anywhere in
it (by a few per cent, a sign, a power of ten, or to another kind of value), and makes every digest anew, those of
gain sets inside too; for alarms the sentence is made anew as well in every second case. Judged are those that verify:
of a gain set, the gain of plant and stored observer together at 400 frequencies against its claim, and the
tolerances' entries at nominal values against plant and plant as written; of an alarm, whether the linear programme of
what it then says still has no solution, solved again by HiGHS; of a calibration, whether constants, ranges and level
are those of the same calibration; of robustness and comparison, whether every figure is that of the true certificate.
"""

from __future__ import annotations

import json
import tempfile
import warnings
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from benchmarks.campaigns.frame import Outcome

import obsynth
from obsynth.monitoring.alarms.certificates import verify_alarm
from obsynth.monitoring.alarms.proof_file import proved_alarm
from obsynth.results.calibration_files import calibration_text, verify_calibration
from obsynth.results.gain_set_writing import design_as_dict, digest_of, restored
from obsynth.results.gain_sets import loaded

CASES = 3000
LIMIT = 120.0
#: Different plants: what is changed in them goes by the seed.
PLANTS = 12
KINDS = ("gain set", "alarm", "calibration", "robustness", "comparison")
#: A gain may exceed its claim by rounding.
ROUNDING = 1e-6


@lru_cache(maxsize=PLANTS)
def made(number: int) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return a gain set and the certificate of an alarm, as documents."""
    rng = np.random.default_rng([number, 29])
    n, smooth = 1 + number % 2, number % 3 == 0
    a = np.diag(rng.uniform(0.2, 0.8, n)) if not smooth else -np.diag(rng.uniform(0.5, 2.0, n))
    rows: list[list[Any]] = a.tolist()
    rows[0][0] = f"{rows[0][0]!r} * p"
    given = {"E": None, "A": rows, "B": np.ones((n, 1)).tolist(), "C": np.eye(n).tolist(),
             "Bf": np.eye(n)[:, :1].tolist(), "dt": 0.0 if smooth else 1.0}  # fmt: skip
    if n == 2:
        given["Bd"] = [[0.0], [1.0]]
    plant = obsynth.uncertain_system(
        given, {"p": {"nominal": 1.0, "tolerance": "5 %"}}, variation="varying" if number % 4 == 3 else "constant"
    )
    if smooth:
        plant = obsynth.discretise(plant, 0.1).plant
    design = obsynth.fault_estimation_filter(plant, name="chain")
    u, x, y = rng.uniform(-1.0, 1.0, (24, 1)), np.zeros(n), []
    for k in range(24):
        y.append(plant.C @ x)
        x = plant.A @ x + plant.B @ u[k] + plant.Bf[:, 0] * (3.0 if k > 12 else 0.0)
    proof = proved_alarm(
        design, u, np.array(y), window=8, disturbance_bounds=dict.fromkeys(plant.disturbance_names, 0.1),
        initial_set=dict.fromkeys(plant.state_names, 0.1),
    )  # fmt: skip
    if not proof.proved:
        raise ArithmeticError(f"plant {number} has no proof to change: {proof.statement}")
    return design_as_dict(design), dict(proof.certificate)


def calibration() -> dict[str, Any]:
    """Return a calibration as the verb writes it."""
    constants = {"p": {"nominal": 1.0, "range": [0.9, 1.2], "open": [], "unit": "1"}}
    data = {"system": "spec.yaml", "constants": constants, "level": 0.95, "log": {"digest": "ab" * 32, "rows": [0, 9]}}
    return dict(json.loads(calibration_text(data)))


def leaves(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Return the places of all numbers, texts and lists without content."""
    if isinstance(value, dict) and value:
        return [place for key, item in value.items() for place in leaves(item, (*path, key))]
    if isinstance(value, list) and value:
        return [place for i, item in enumerate(value) for place in leaves(item, (*path, i))]
    return [path]


def changed(value: Any, rng: np.random.Generator) -> Any:
    """Return something else in the place of a leaf."""
    if isinstance(value, bool):
        return not value
    if isinstance(value, (int, float)):
        factor = float(rng.choice([-1.0, 0.0, 0.1, 0.9, 0.99, 1.01, 1.1, 10.0]))
        new = value * factor if value else float(rng.choice([0.01, 1.0, -1.0]))
        return int(new) if isinstance(value, int) and rng.random() < 0.5 else new
    if isinstance(value, str):
        return value.replace("0.", "0.9") if "0." in value and rng.random() < 0.5 else f"{value}x"
    return 1.0 if value is None else None


def put(document: Any, path: tuple[Any, ...], value: Any) -> None:
    """Put a value into its place."""
    for key in path[:-1]:
        document = document[key]
    document[path[-1]] = value


@lru_cache(maxsize=2 * PLANTS)
def result(number: int, kind: str) -> dict[str, Any]:
    """Return the certificate of the robustness, or of a comparison, of a plant."""
    inside = {"kind": "obsynth gain set", "schema_version": 2, **_sealed(made(number)[0]["design"])}
    design = loaded(json.dumps(inside).encode())
    plant, _ = design.linear
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "c.json"
        if kind == "robustness":
            obsynth.robustness(design).save(file)
        else:
            scenario = obsynth.Scenario(
                horizon=20.0 * plant.dt, faults={plant.fault_names[0]: obsynth.Step(size=1.0, start=5.0 * plant.dt)},
                disturbances={name: obsynth.Step(size=0.1) for name in plant.disturbance_names},
            )  # fmt: skip
            obsynth.compare(plant, scenario=scenario, methods=["fault-estimation-filter"], runs=2).save(file)
        return dict(json.loads(file.read_text()))


def _sealed(body: dict[str, Any]) -> dict[str, Any]:
    return {"sha256": digest_of(body), "design": body}


def _result(kind: str) -> Callable[[np.random.Generator, Path], Outcome]:
    def judged(rng: np.random.Generator, file: Path) -> Outcome:
        true = result(int(rng.integers(PLANTS)), kind)
        body = _altered(true["certificate"], rng)
        try:
            for inside in body["gain_sets"].values():
                inside["sha256"] = digest_of(inside["design"])
        except (KeyError, TypeError, AttributeError):
            return Outcome(kind, "refused (no gain set)")
        file.write_text(json.dumps({**true, "sha256": digest_of(body), "certificate": body}))
        try:
            passed = obsynth.verify_certificate(file).passed
        except obsynth.ObsynthError as error:
            return Outcome(kind, f"refused ({type(error).__name__})")
        if not passed:
            return Outcome(kind, "fails")
        wrong = _other_figures(body["result"], true["certificate"]["result"])
        return Outcome(kind, "verifies", f"another figure verifies: {wrong}" if wrong else "")

    return judged


def _other_figures(found: Any, true: Any) -> str:
    """Return the first place at which figures are not those of the true certificate, to 1e-5 of the largest."""
    ours, theirs = leaves(found), leaves(true)
    if ours != theirs:
        return "places"
    for place in ours:
        one, other = found, true
        for key in place:
            one, other = one[key], other[key]
        if isinstance(one, bool) or not isinstance(one, (int, float)) or not isinstance(other, (int, float)):
            if one != other:
                return str(place)
        elif abs(one - other) > 1e-5 * abs(other) + 1e-9:
            return str(place)
    return ""


def case(seed: int) -> Outcome:
    """Run one case."""
    rng, kind = np.random.default_rng([seed, 31]), KINDS[seed % len(KINDS)]
    with warnings.catch_warnings(), tempfile.TemporaryDirectory() as folder:
        warnings.simplefilter("ignore")
        return {
            "gain set": _gain_set,
            "alarm": _alarm,
            "calibration": _calibration,
            "robustness": _result("robustness"),
            "comparison": _result("comparison"),
        }[kind](rng, Path(folder) / "c.json")


def _altered(document: dict[str, Any], rng: np.random.Generator) -> dict[str, Any]:
    found = json.loads(json.dumps(document))
    places = leaves(found)
    place = places[int(rng.integers(len(places)))]
    value = found
    for key in place:
        value = value[key]
    put(found, place, changed(value, rng))
    return dict(found)


def _gain_set(rng: np.random.Generator, _: Path) -> Outcome:
    body = _altered(made(int(rng.integers(PLANTS)))[0]["design"], rng)
    document = {"kind": "obsynth gain set", "schema_version": 2, "sha256": digest_of(body), "design": body}
    try:
        design = loaded(json.dumps(document).encode())
        passed = obsynth.verify(design).passed
    except obsynth.ObsynthError as error:
        return Outcome("gain set", f"refused ({type(error).__name__})")
    return Outcome("gain set", "verifies" if passed else "fails", _false_gains(design) if passed else "")


def _false_gains(design: obsynth.ObserverDesign) -> str:
    """Return what is false of a gain set that verifies."""
    plant, observer = design.linear
    uncertain, source = plant.uncertainty, design.source
    if uncertain is not None and not uncertain.lost:
        written = uncertain.written or {name: getattr(plant, name) for name in ("A", "B", "C", "Bf", "Bd")}
        filled = uncertain.filled(
            {**{name: getattr(plant, name) for name in ("E", "A", "B", "C", "D", "Bf", "Df", "Bd", "Dd")}, **written},
            {name: item.nominal for name, item in uncertain.box.constants.items()},
        )
        for name, matrix in filled.items():
            beside = written.get(name) if source is None else getattr(source.plant, name)
            if beside is not None and not np.array_equal(matrix, beside):
                return f"tolerances of another {name}"
    gamma = design.certificate.claims.get("gamma")
    if gamma is None or not plant.nd:
        return ""
    for angle in np.concatenate([np.geomspace(1e-3, 1.0, 200), np.linspace(1.0, np.pi, 200)]):
        z = np.exp(1j * angle)
        y = plant.C @ np.linalg.solve(z * plant.E - plant.A, plant.Bd) + plant.Dd
        states = np.linalg.solve(z * np.eye(observer.order) - observer.Az, observer.By @ y)
        found = (observer.Cz @ states + observer.Dy @ y)[observer.fault_rows]
        if np.linalg.norm(found, 2) > gamma * (1.0 + ROUNDING):
            return f"the gain is above {gamma} at {angle:.3g} rad per sample"
    return ""


def _alarm(rng: np.random.Generator, file: Path) -> Outcome:
    body = _altered(made(int(rng.integers(PLANTS)))[1], rng)
    again = bool(rng.random() < 0.5)
    try:
        inner = body["gain_set"]
        inner["sha256"] = digest_of(inner["design"])
    except (KeyError, TypeError):
        return Outcome("alarm", "refused (no gain set)")
    for _ in range(2 if again else 1):
        content = {"kind": "obsynth alarm certificate", "schema_version": 2, "sha256": digest_of(body),
                   "certificate": body}  # fmt: skip
        file.write_text(json.dumps(content))
        report = verify_alarm(file)
        rows = {check.name: check for check in report.checks}
        if "statement" in rows:
            body["statement"] = rows["statement"].claim
    if not report.passed:
        return Outcome("alarm", "fails")
    return Outcome("alarm", "verifies, told anew" if again else "verifies", _false_alarm(body))


def _false_alarm(body: dict[str, Any]) -> str:
    """Return what is false of a certificate that verifies: some plant explains the record without a fault."""
    design = loaded(json.dumps(body["gain_set"]).encode())
    data, (plant, _) = restored({key: value for key, value in body.items() if key != "gain_set"}), design.linear
    found = proved_alarm(
        design, np.reshape(data["u"], (-1, plant.nu)), np.reshape(data["y"], (-1, plant.ny)), window=data["window"],
        disturbance_bounds=dict(zip(plant.disturbance_names, np.ravel(data["bounds"]), strict=True)),
        noise_bound=data["noise_bound"] if plant.nw else None, initial_set=data["initial_set"],
        state_bounds=data["state_bounds"],
    )  # fmt: skip
    return "" if found.proved else f"a healthy window is proved faulty: {found.statement[:80]}"


def _calibration(rng: np.random.Generator, file: Path) -> Outcome:
    true = calibration()
    body = _altered({name: value for name, value in true.items() if name not in ("sha256", "kind")}, rng)
    body = {"kind": true["kind"], **body}
    file.write_text(json.dumps({"kind": true["kind"], "sha256": digest_of(body), **body}))
    try:
        passed = verify_calibration(file, true).passed
    except (obsynth.ObsynthError, KeyError, TypeError, ValueError, AttributeError) as error:
        return Outcome("calibration", "refused", "" if isinstance(error, obsynth.ObsynthError) else repr(error))
    item, other = body.get("constants", {}), true["constants"]
    width = 0.011 * 0.3
    far = passed and any(
        abs(a - b) > width for a, b in zip(item["p"]["range"], other["p"]["range"], strict=True)
    )  # fmt: skip
    false = passed and (far or body["level"] != true["level"] or body["log"]["digest"] != true["log"]["digest"])
    return Outcome("calibration", "verifies" if passed else "fails", "another range or level verifies" if false else "")

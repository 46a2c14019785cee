"""Changes of a proof file, each of which makes one of its claims false or its proof wrong."""

from __future__ import annotations

import copy
import importlib.util
from collections.abc import Callable, Iterator
from fractions import Fraction
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from obsynth.proofs.witnesses import Dyadic

CHECKER = Path(__file__).parents[2] / "checker/check_proof.py"
#: What a number is changed by, as a share of it.
CHANGE = 0.01


def checker() -> ModuleType:
    """Return the checker as a module."""
    spec = importlib.util.spec_from_file_location("check_proof", CHECKER)
    if spec is None or spec.loader is None:
        raise FileNotFoundError(CHECKER)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def as_array(data: dict[str, Any]) -> np.ndarray:
    """Return a matrix of a file, rounded."""
    values = [int(v, 16) if isinstance(v, str) else v for v in data["entries"]]
    scaled = [float(Fraction(v) * Fraction(2) ** data["exponent"]) for v in values]
    return np.array(scaled, dtype=np.float64).reshape(data["size"])


def as_data(values: Any) -> dict[str, Any]:
    """Return a matrix as data of a file."""
    return Dyadic.of(np.atleast_2d(values)).data()


def changes(proof: dict[str, Any]) -> Iterator[tuple[str, Callable[[dict[str, Any]], None]]]:
    """Yield every change that is one for this file: its name, and what does it to a copy."""
    yield "another version", lambda file: file.update(version=2)
    yield "another format", lambda file: file.update(format="proof")
    yield "no claims", lambda file: file.update(claims=[])
    yield "an unknown claim", lambda file: file["claims"][0].update(claim="gains")
    kinds = {claim["claim"] for claim in proof["claims"]}
    az, dt = as_array(proof["observer"]["Az"]), float(as_array(proof["plant"]["sample_time"])[0, 0])
    for claim in proof["claims"]:
        yield from _of_claim(claim, proof, az, dt)
    if "identities" in kinds:
        yield from _of_matrices(proof)
    if "threshold" in kinds:
        for name in ("Dy", "Cz"):
            if np.any(as_array(proof["observer"][name])):
                yield f"the weights {name}", _largest("observer", name)


def _of_matrices(proof: dict[str, Any]) -> Iterator[tuple[str, Callable[[dict[str, Any]], None]]]:
    t, by = as_array(proof["follows"]["T"]), as_array(proof["observer"]["By"])
    a, c = as_array(proof["plant"]["A"]), as_array(proof["plant"]["C"])
    if not t.size:
        return
    weight = np.abs(t[:, : len(a)]).max(axis=0)[:, None] * np.abs(a)
    if np.any(weight > 0.0):
        yield "the plant's A", _entry("plant", "A", np.unravel_index(int(np.argmax(weight)), a.shape))
    seen = np.abs(by).max(axis=0)[:, None] * np.abs(c)
    if np.any(seen > 0.0):
        yield "the plant's C", _entry("plant", "C", np.unravel_index(int(np.argmax(seen)), c.shape))
        moved = np.abs(by) * np.abs(c).max(axis=1)
        yield "the observer's By", _entry("observer", "By", np.unravel_index(int(np.argmax(moved)), by.shape))
    names = [row for row in proof["observer"]["rows"] if row[0] == "state"]
    if len(names) > 1:
        yield "states in another order", _swapped_states
    bd = as_array(proof["plant"]["Bd"])
    driven = t[:, : len(a)] @ bd - by @ as_array(proof["plant"]["Dd"])
    if not proof["follows"]["decoupled"] and np.any(np.abs(driven) > 1e-3 * np.max(np.abs(bd), initial=1e-300)):
        yield "disturbances that are not decoupled", lambda file: file["follows"].update(decoupled=True)


def _of_claim(
    claim: dict[str, Any], proof: dict[str, Any], az: np.ndarray, dt: float
) -> Iterator[tuple[str, Callable[[dict[str, Any]], None]]]:
    kind = claim["claim"]
    at = next(place for place, other in enumerate(proof["claims"]) if other is claim)

    def change(**values: Any) -> Callable[[dict[str, Any]], None]:
        return lambda file: file["claims"][at].update(copy.deepcopy(values))

    if kind == "stable":
        poles = np.linalg.eigvals(az)
        false = 0.99 * np.max(np.abs(poles)) if dt > 0.0 else -1.01 * np.max(poles.real)
        if false > 0.0:
            yield "a faster decay", change(rate=as_data([[false]]))
        yield "P with another sign", change(P=as_data(-as_array(claim["P"])))
        larger = as_data(2.0 * as_array(claim["decreases"]["factor"]))
        yield "a factor twice as large", change(decreases={**claim["decreases"], "factor": larger})
        yield "weights of zero", change(P_positive={**claim["P_positive"], "weights": [0] * claim["P"]["size"][0]})
    if kind == "gain":
        yield "a gain below the norm", change(gamma=as_data([[0.9999 * _norm(claim, proof, az, dt)]]))
        yield "a P that is zero", change(P=as_data(np.zeros(claim["P"]["size"])))
    if kind == "matching":
        norm, gamma = _matching_norm(claim, proof, dt), as_array(claim["gamma"]).item()
        yield "a gain from a reference below the norm", change(gamma=as_data([[0.9999 * norm]]))
        if claim["P"]["entries"]:
            yield "a P of a matching that is zero", change(P=as_data(np.zeros(claim["P"]["size"])))
        if claim["faults"] and not claim["noise"] and not claim["disturbances"]:
            yield "another reference model", change(reference=_larger(claim["reference"]))
        if claim["error_weight"] is not None and gamma < (1.0 + 0.1 * CHANGE) * norm:
            yield "a larger weight", change(error_weight=_larger(claim["error_weight"]))
    if kind == "deviation":
        yield "smaller deviations", change(deviations=as_data(0.99 * as_array(claim["deviations"])))
    if kind == "faults":
        if np.any(as_array(claim["bounds"])):
            yield "nothing left of faults", change(bounds=as_data(0.0 * as_array(claim["bounds"])))
        yield "another delay", _another_delay
    if kind == "fault models":
        pi = as_array(claim["Pi"])
        if np.any(pi):
            yield "another motion with the fault", change(Pi=as_data(pi * (1.0 + CHANGE)))
    if kind == "threshold":
        least = next((other for other in proof["claims"] if other["claim"] == "least"), None)
        value = as_array(claim["threshold"])[0, 0] if least is None else as_array(least["least"])[0, 0]
        yield "a threshold below the least", change(threshold=as_data([[0.99 * value]]))
        multipliers = copy.deepcopy(claim["multipliers"])
        numerators = [_integer(v) for v in multipliers["numerators"]]
        place = max(range(len(numerators)), key=lambda k: abs(numerators[k]))
        numerators[place] += abs(numerators[place]) // 100 + 1
        multipliers["numerators"] = [f"{v:x}" for v in numerators]
        yield "another multiplier", change(multipliers=multipliers)
        noise = [as_data(as_array(bound) * 1.1) for bound in claim["window"]["bounds"]["noise"]]
        if any(np.any(as_array(bound)) for bound in noise):
            window = copy.deepcopy(claim["window"])
            window["bounds"]["noise"] = noise
            yield "more noise", change(window=window)
    if kind == "least":
        larger = {"numerators": [f"{5 * _integer(v):x}" for v in claim["point"]["numerators"]],
                  "denominator": f"{4 * _integer(claim['point']['denominator']):x}"}  # fmt: skip
        yield "a larger least", change(point=larger, least=as_data(1.25 * as_array(claim["least"])))
        free = [_integer(v) for v in claim["point"]["numerators"]]
        place = max(range(len(free)), key=lambda k: abs(free[k]))
        free[place] += abs(free[place]) // 100 + 1
        moved = {**claim["point"], "numerators": [f"{v:x}" for v in free]}
        yield "a point that moved", change(point=moved)
    if kind == "alarm":
        yield "a larger margin", change(margin=as_data(1.1 * as_array(claim["margin"]) + 1e-3))
        yield "other samples", change(y=as_data(0.0 * as_array(claim["y"])), u=as_data(0.0 * as_array(claim["u"])))


def _matching_norm(claim: dict[str, Any], proof: dict[str, Any], dt: float) -> float:
    """Return a lower bound of the norm of a weighted error from a reference model, frequency by frequency."""
    system = checker().System(proof)
    counted = [system.index("disturbances", name) for name in claim["disturbances"]]
    signals = ["faults"] * claim["faults"] + ["disturbances"] * bool(counted) + ["noise"] * claim["noise"]
    pairs = {signal: [_rounded(part) for part in system.driven(signal)] for signal in signals}
    if counted:
        pairs["disturbances"] = [part[:, counted] for part in pairs["disturbances"]]
    rows = system.rows_of(claim["rows"])
    b, d = (np.hstack([pair[i] for pair in pairs.values()]) for i in (0, 1))
    own = _rounded(system.Az), b, -_rounded(system.Cz)[rows], d[rows]
    models = {name: claim[name] and [as_array(claim[name][letter]) for letter in "ABCD"]
              for name in ("reference", "input_weight", "error_weight")}  # fmt: skip
    points = np.exp(1j * np.linspace(0.0, np.pi, 2000)) if dt > 0.0 else 1j * np.r_[0.0, np.geomspace(1e-5, 1e4, 4000)]
    most = 0.0
    for point in points:
        response = _at(own, point)
        if models["reference"]:
            response[:, : system.Bf.columns] -= _at(models["reference"], point)
        if models["input_weight"]:
            response = response @ _at(models["input_weight"], point)
        if models["error_weight"]:
            response = _at(models["error_weight"], point) @ response
        most = max(most, float(np.linalg.norm(response, 2)))
    return most


def _at(model: Any, point: complex) -> np.ndarray:
    a, b, c, d = model
    return np.asarray(c @ np.linalg.solve(point * np.eye(len(a)) - a, b) + d)


def _larger(model: dict[str, Any]) -> dict[str, Any]:
    """Return a model whose outputs are larger."""
    return {name: as_data(as_array(part) * (1.0 + CHANGE * (name in "CD"))) if part["entries"] else part
            for name, part in model.items()}  # fmt: skip


def _norm(claim: dict[str, Any], proof: dict[str, Any], az: np.ndarray, dt: float) -> float:
    """Return a lower bound of the norm: the largest gain of many frequencies."""
    module = checker()
    system = module.System(proof)
    b, d = (_rounded(part) for part in system.driven(claim["signal"]))
    rows = system.rows_of(claim["rows"])
    c, d = -_rounded(system.Cz)[rows], d[rows]
    fast = max(float(np.max(np.abs(np.linalg.eigvals(az)), initial=1.0)), 1e-3)
    points = (
        np.exp(1j * np.linspace(0.0, np.pi, 2000))
        if dt > 0.0
        else 1j * np.r_[0.0, np.geomspace(1e-5, 1e3, 4000) * fast]
    )
    return max(float(np.linalg.norm(c @ np.linalg.solve(point * np.eye(len(az)) - az, b) + d, 2)) for point in points)


def _rounded(matrix: Any) -> np.ndarray:
    values = [[float(matrix.fraction(i, j)) for j in range(matrix.columns)] for i in range(matrix.rows)]
    return np.array(values).reshape(matrix.rows, matrix.columns)


def _integer(value: Any) -> int:
    return int(value, 16) if isinstance(value, str) else int(value)


def _entry(part: str, name: str, place: Any) -> Callable[[dict[str, Any]], None]:
    def change(file: dict[str, Any]) -> None:
        matrix = as_array(file[part][name])
        matrix[place] *= 1.0 + CHANGE
        file[part][name] = as_data(matrix)

    return change


def _largest(part: str, name: str) -> Callable[[dict[str, Any]], None]:
    def change(file: dict[str, Any]) -> None:
        matrix = as_array(file[part][name])
        matrix[np.unravel_index(int(np.argmax(np.abs(matrix))), matrix.shape)] *= 1.0 + CHANGE
        file[part][name] = as_data(matrix)

    return change


def _swapped_states(file: dict[str, Any]) -> None:
    rows = [row for row in file["observer"]["rows"] if row[0] == "state"]
    rows[0][1], rows[1][1] = rows[1][1], rows[0][1]


def _another_delay(file: dict[str, Any]) -> None:
    row = next(row for row in file["observer"]["rows"] if row[0] == "fault")
    row[2] += 1

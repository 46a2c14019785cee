"""DAE plants for tests: the heat exchanger, a diode circuit, pendulums of index 1, 2 and 3."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
from ruamel.yaml import YAML

from obsynth import DAEModel

DESIGNS = Path(__file__).parents[2] / "designs"


@cache
def _exchanger() -> DAEModel:
    document = YAML(typ="safe").load((DESIGNS / "moussaali2013_dae" / "plant.yaml").read_text(encoding="utf-8"))
    return DAEModel(**{key: value for key, value in document.items() if key not in ("schema_version", "kind")})


def exchanger(**changes) -> DAEModel:
    """The shipped heat exchanger: one model for all, whose functions are compiled once; or another one with changes."""
    return _exchanger().replace(**changes) if changes else _exchanger()


def diode() -> DAEModel:
    """A source charges a capacitor through a resistor and a diode: v is the voltage of the diode's node."""
    return DAEModel(
        {"node": "(source - v - c) / R = Is * (exp(v / VT) - 1)",
         "charge": "C * der(c) = Is * (exp(v / VT) - 1) - c / Rl"},
        {"seen": "c"},
        states={"v": 0.6, "c": 1.0}, inputs={"source": 2.0}, parameters={"Rl": 1000.0},
        constants={"R": 10.0, "Is": 1e-12, "VT": 0.02585, "C": 1e-3},
        units={"v": "V", "c": "V", "source": "V", "Rl": "ohm", "seen": "V"},
    )  # fmt: skip


def pendulum(constraint: str) -> DAEModel:
    """A pendulum in Cartesian coordinates with friction d; ``constraint`` decides the index."""
    return DAEModel(
        {
            "x velocity": "der(x) = vx", "y velocity": "der(y) = vy", "x force": "der(vx) = -tension * x - d * vx",
            "y force": "der(vy) = -tension * y - g - d * vy", "rod": constraint,
        },
        {"place": "x"},
        states={"x": 0.6, "y": -0.8, "vx": 0.0, "vy": 0.0, "tension": 7.848}, parameters={"d": 0.3},
        constants={"g": 9.81},
        units={"x": "m", "y": "m", "vx": "m/s", "vy": "m/s", "tension": "1/s2", "d": "1/s", "place": "m"},
    )  # fmt: skip


ROD = {
    3: "x ** 2 + y ** 2 = 1",
    2: "x * vx + y * vy = 0",
    1: "vx ** 2 + vy ** 2 - tension * (x ** 2 + y ** 2) - g * y - d * (x * vx + y * vy) = 0",
}


def linear(matrices: dict[str, np.ndarray]) -> DAEModel:
    """E (x - x_before) / dt = A x + B u + G theta as functions, y = C x + D theta."""
    E, A, B, G, C, D = (matrices[name] for name in "EABGCD")
    n, q, p = len(A), G.shape[1], len(C)

    def equations(rates, x, u, theta):
        return [
            sum(E[i, j] * rates[j] for j in range(n))
            - sum((A[i, j] + 0.05 * u[1] * (i == j)) * x[j] for j in range(n))
            - B[i, 0] * u[0] - sum(G[i, j] * theta[j] * (1 + u[1]) for j in range(q))
            for i in range(n)
        ]  # fmt: skip

    def outputs(x, theta):
        return [sum(C[i, j] * x[j] for j in range(n)) + sum(D[i, j] * theta[j] for j in range(q)) for i in range(p)]

    states = {f"x{i}": 0.0 for i in range(n)}
    parameters = {f"t{i}": 0.0 for i in range(q)}
    names = [f"y{i}" for i in range(p)]
    units = dict.fromkeys([*states, *parameters, *names, "drive", "clock"], "1")
    return DAEModel(
        equations, outputs, states=states, inputs={"drive": 0.0, "clock": 0.0}, parameters=parameters, units=units,
        output_names=names,
    )  # fmt: skip

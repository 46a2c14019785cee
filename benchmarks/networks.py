"""Random power networks of 300 to 10,000 variables with known truth, as a simulator would linearise them.

Buses on a random sparse graph (power balances in angle and voltage, lossy lines), machines of four states with stator
equations, governors, voltage regulators and filters.  Row i is the equation of variable i.  Some time constants are
zero, some filters act on nothing: two of a kind would give index 2, two a singular pencil.  What is known by
construction: the number of dynamic states, the index, and the names of the variables that act on nothing.

``python benchmarks/networks.py FOLDER VARIABLES STATES SEED`` writes a network and its specs;
``python benchmarks/networks.py --andes`` takes those of the simulator ANDES instead (`andes_networks`).
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.sparse import coo_array, csr_array

#: Dynamic states of a machine with governor and regulator, before any time constant is set to zero.
STATES_PER_MACHINE = 10
#: Variables of the same, algebraic ones included.
VARIABLES_PER_MACHINE = 22
#: Rated angular frequency, rad/s.
RATED = 2 * np.pi * 60


@dataclass(frozen=True, eq=False)
class Network:
    """A linearised network ``E x' = A x`` with its truth; the signals are named by variables."""

    E: csr_array
    A: csr_array
    names: tuple[str, ...]
    dynamic: tuple[str, ...]
    idle: tuple[str, ...]
    idle_equations: tuple[str, ...]
    outputs: tuple[str, ...]
    faults: tuple[str, ...]
    disturbances: tuple[str, ...]

    def plant(self, **changes):
        """Return the plant, with sparse E and A, and noise on every output."""
        import obsynth

        given = {
            "C": list(self.outputs), "Bf": list(self.faults), "Bd": list(self.disturbances),
            "disturbance_names": [f"load of {name}" for name in self.disturbances],
            "state_names": self.names, "Dw": 1e-4 * np.eye(len(self.outputs)),
        }  # fmt: skip
        return obsynth.DescriptorSystem(self.E, self.A, **(given | changes))

    def truth(self) -> np.ndarray:
        """Return A of the dynamic states by LAPACK: no sparsity, and idle variables left out as they were made."""
        count = len(self.names)
        rows = ~np.isin(np.arange(count), [self.names.index(name) for name in self.idle_equations])
        columns = ~np.isin(np.arange(count), [self.names.index(name) for name in self.idle])
        e, a = self.E.toarray()[np.ix_(rows, columns)], self.A.toarray()[np.ix_(rows, columns)]
        equations, states = e.any(axis=1), e.any(axis=0)
        inner = np.linalg.solve(a[~equations][:, ~states], a[~equations][:, states])
        reduced = a[equations][:, states] - a[equations][:, ~states] @ inner
        return np.linalg.solve(e[equations][:, states], reduced)


@dataclass
class _Builder:
    names: list[str] = field(default_factory=list)
    rows: list[tuple[int, int, float]] = field(default_factory=list)
    mass: list[tuple[int, int, float]] = field(default_factory=list)
    dynamic: list[str] = field(default_factory=list)
    idle: list[str] = field(default_factory=list)
    idle_equations: list[str] = field(default_factory=list)

    def add(self, name: str, time_constant: float = 0.0) -> int:
        index = len(self.names)
        self.names.append(name)
        if time_constant:
            self.mass.append((index, index, time_constant))
            self.dynamic.append(name)
        return index

    def terms(self, equation: int, *terms: tuple[int, float]) -> None:
        self.rows += [(equation, variable, value) for variable, value in terms]


def random_network(
    variables: int, states: int, seed: int, *, idle_filters: int = 4, most_speeds: int = 12, measured_buses: int = 8
) -> Network:
    """Return a network of about so many variables and dynamic states."""
    rng, made = np.random.default_rng(seed), _Builder()
    machines = max(2, round(states / STATES_PER_MACHINE))
    buses = max(machines + 2, (variables - VARIABLES_PER_MACHINE * machines - 2 * idle_filters) // 2)
    angle = [made.add(f"a Bus {i + 1}") for i in range(buses)]
    voltage = [made.add(f"v Bus {i + 1}") for i in range(buses)]
    _lines(made, rng, angle, voltage)
    places = rng.choice(buses, machines, replace=False)
    speeds = [_machine(made, rng, k + 1, angle[bus], voltage[bus]) for k, bus in enumerate(places)]
    for k in range(idle_filters):
        _idle_filter(made, k, speeds[int(rng.integers(machines))])
    # At machines: elsewhere angle and voltage of one bus may repeat those of its neighbour.
    measured = sorted(int(bus) for bus in places[-measured_buses:])
    outputs = [f"omega GENROU {k + 1}" for k in range(min(machines, most_speeds))]
    outputs += [made.names[angle[b]] for b in measured] + [made.names[voltage[b]] for b in measured]
    faults = [f"tm GENROU {k + 1}" for k in range(min(2, machines))]
    loads = [made.names[angle[int(rng.integers(buses))]]]
    size = (len(made.names),) * 2

    def matrix(entries: list[tuple[int, int, float]]) -> csr_array:
        row, column, value = (np.array(part) for part in zip(*entries, strict=True))
        return csr_array(coo_array((value, (row, column)), shape=size))

    return Network(
        matrix(made.mass), matrix(made.rows), tuple(made.names), tuple(made.dynamic), tuple(made.idle),
        tuple(made.idle_equations), tuple(outputs), tuple(faults), tuple(loads),
    )  # fmt: skip


def _lines(made: _Builder, rng, angle: list[int], voltage: list[int]) -> None:
    """Add the power balances: a random tree, half as many further lines between near buses, loads and shunts."""
    buses = len(angle)
    lines = {(int(rng.integers(max(0, i - 8), i)), i) for i in range(1, buses)}
    lines |= {
        (i, j) for i in rng.integers(0, buses - 1, buses // 2) for j in [int(min(buses - 1, i + rng.integers(1, 9)))]
    }
    for i, j in sorted((int(i), int(j)) for i, j in lines if i != j):
        b, g = rng.uniform(5, 30), rng.uniform(0.3, 3)
        for one, other in ((i, j), (j, i)):
            made.terms(angle[one], (angle[one], -b), (angle[other], b), (voltage[one], -g), (voltage[other], g))
            made.terms(voltage[one], (angle[one], g), (angle[other], -g), (voltage[one], -b), (voltage[other], b))
    for i in range(buses):
        made.terms(angle[i], (voltage[i], -rng.uniform(0.2, 1.5)))
        made.terms(voltage[i], (voltage[i], -rng.uniform(0.2, 1.0)))


def _machine(made: _Builder, rng, number: int, angle: int, voltage: int) -> int:
    """Add a machine with governor and regulator at a bus; return its speed."""

    def name(variable: str, model: str = "GENROU") -> str:
        return f"{variable} {model} {number}"

    delta, omega = made.add(name("delta"), 1.0), made.add(name("omega"), rng.uniform(6, 14))
    e1q, e1d = made.add(name("e1q"), rng.uniform(5, 9)), made.add(name("e1d"), rng.uniform(0.3, 0.9))
    vd, vq, current_d, current_q, te, qe, tm, vf = (
        made.add(name(v)) for v in ("vd", "vq", "Id", "Iq", "te", "qe", "tm", "vf")
    )
    xd, xq, x1d, x1q = rng.uniform(1.4, 1.9), rng.uniform(1.2, 1.7), rng.uniform(0.2, 0.35), rng.uniform(0.3, 0.5)
    load = rng.uniform(0.25, 0.6)
    vd0, vq0 = np.sin(load), np.cos(load)
    current = rng.uniform(0.4, 0.8) * np.exp(1j * (np.pi / 2 - load - rng.uniform(0, 0.2)))
    id0, iq0 = float(current.real), float(current.imag)
    made.terms(delta, (omega, RATED))
    made.terms(omega, (tm, 1.0), (te, -1.0), (omega, -rng.uniform(1, 3)))
    made.terms(e1q, (e1q, -1.0), (current_d, -(xd - x1d)), (vf, 1.0))
    made.terms(e1d, (e1d, -1.0), (current_q, xq - x1q))
    made.terms(vd, (vd, -1.0), (delta, vq0), (angle, -vq0), (voltage, vd0))
    made.terms(vq, (vq, -1.0), (delta, -vd0), (angle, vd0), (voltage, vq0))
    made.terms(current_d, (e1q, 1.0), (vq, -1.0), (current_d, -x1d))
    made.terms(current_q, (e1d, 1.0), (vd, -1.0), (current_q, x1q))
    made.terms(te, (te, -1.0), (vd, id0), (vq, iq0), (current_d, vd0), (current_q, vq0))
    made.terms(qe, (qe, -1.0), (vq, id0), (vd, -iq0), (current_d, vq0), (current_q, -vd0))
    made.terms(angle, (te, 1.0))
    made.terms(voltage, (qe, 1.0))
    # Governor: lag, lead-lag; its demand and output are algebraic.
    lag, lead = (
        made.add(name("LAG_y", "TGOV1"), rng.uniform(0.2, 0.6)),
        made.add(name("LL_x", "TGOV1"), rng.uniform(4, 9)),
    )
    demand, power = made.add(name("pd", "TGOV1")), made.add(name("LL_y", "TGOV1"))
    ahead = rng.uniform(0.1, 0.4)
    made.terms(demand, (demand, -1.0), (omega, -1.0 / rng.uniform(0.04, 0.06)))
    made.terms(lag, (demand, 1.0), (lag, -1.0))
    made.terms(lead, (lag, 1.0), (lead, -1.0))
    made.terms(power, (power, -1.0), (lag, ahead), (lead, 1.0 - ahead))
    made.terms(tm, (tm, -1.0), (power, 1.0))
    # Regulator: sensor lag (often without a time constant), lead-lag, amplifier, and a stabiliser's washout.
    sensor = made.add(name("LG_y", "EXST1"), rng.uniform(0.01, 0.03) if number % 3 else 0.0)
    compensator = made.add(name("LL_x", "EXST1"), rng.uniform(1, 4))
    amplifier = made.add(name("LR_y", "EXST1"), rng.uniform(0.05, 0.3))
    washout = made.add(name("WO_x", "IEEEST"), rng.uniform(3, 10))
    compensated, signal = made.add(name("LL_y", "EXST1")), made.add(name("vs", "IEEEST"))
    made.terms(sensor, (voltage, 1.0), (sensor, -1.0))
    made.terms(compensator, (sensor, -1.0), (signal, 1.0), (compensator, -1.0))
    made.terms(compensated, (compensated, -1.0), (sensor, -0.3), (signal, 0.3), (compensator, 0.7))
    made.terms(amplifier, (amplifier, -1.0), (compensated, rng.uniform(15, 40)))
    made.terms(vf, (vf, -1.0), (amplifier, 1.0))
    made.terms(washout, (omega, 1.0), (washout, -1.0))
    made.terms(signal, (signal, -1.0), (omega, 2.0), (washout, -2.0))
    return omega


def _idle_filter(made: _Builder, number: int, source: int) -> None:
    """Add a filter that acts on nothing and whose time constants are zero, of two kinds."""
    if number % 2:
        # A washout T y = K (u - x), T x' = u - x: nothing says what y is, and one equation is there twice.
        x, y = made.add(f"WF_x PMU {number + 1}"), made.add(f"WF_y PMU {number + 1}")
        made.terms(x, (source, 1.0), (x, -1.0))
        made.terms(y, (source, 3.0), (x, -3.0))
        made.idle.append(made.names[y])
        made.idle_equations.append(made.names[y])
        return
    # Second order, x' = y, T2 y' = u - x - T1 y: y is the derivative of what it filters.
    x, y = made.add(f"F2_x BusFreq {number + 1}"), made.add(f"F2_y BusFreq {number + 1}")
    made.mass.append((x, x, 1.0))
    made.terms(x, (y, 1.0))
    made.terms(y, (source, 1.0), (x, -1.0))
    made.idle.append(made.names[y])
    made.idle_equations.append(made.names[x])


def write(network: Network, folder: Path) -> None:
    """Write the matrices, names, plant and a spec for each method into a folder."""
    from scipy.io import mmwrite

    folder.mkdir(parents=True, exist_ok=True)
    for letter in "EA":
        mmwrite(folder / f"{letter}.mtx", coo_array(getattr(network, letter)), precision=17)
    (folder / "names.json").write_text(json.dumps(list(network.names)))
    lines = ["schema_version: 1", "dt: 0", "E: {file: E.mtx}", "A: {file: A.mtx}", "state_names: {file: names.json}"]
    lines += ["C:", "  outputs:", *(f"    - {name}" for name in network.outputs)]
    lines += [f"Bf: {{states: [{', '.join(network.faults)}]}}", f"Bd: {{states: [{', '.join(network.disturbances)}]}}"]
    lines += [f"disturbance_names: [{', '.join(f'load of {name}' for name in network.disturbances)}]"]
    lines += ["sensor_noise:", *(f"  {name}: 1.0e-4" for name in network.outputs)]
    (folder / "plant.yaml").write_text("\n".join(lines) + "\n")
    for method, transform in (
        ("fault-estimation-filter", "{eliminate_algebraic_states: true, sample_time: 0.02}"),
        ("ui-pi-observer", "{eliminate_algebraic_states: true}"),
        ("pd-observer", "{eliminate_algebraic_states: true}"),
        ("descriptor-kalman", "{eliminate_algebraic_states: true, sample_time: 0.02}"),
    ):
        (folder / f"{method}.yaml").write_text(
            f"schema_version: 1\nname: {method}\nplant: {{file: plant.yaml, transform: {transform}}}\n"
            f"method: {{id: {method}}}\n"
        )


if __name__ == "__main__":
    if "--andes" in sys.argv:
        from andes_networks import main

        main([argument for argument in sys.argv[1:] if argument != "--andes"])
        raise SystemExit
    write(random_network(int(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4])), Path(sys.argv[1]))

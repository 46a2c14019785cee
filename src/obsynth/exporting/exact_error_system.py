"""The error system of a linear observer in exact numbers, as the checker of proof files forms it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property
from typing import Any

import numpy as np

from obsynth.methods.optimal_filter.error_channel import ErrorChannel
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.decoupling_windows import Model
from obsynth.numerics.scaling import balanced_matrix
from obsynth.observers.linear.modes import poles_of
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.proofs.exact_doubles import rounded_outward
from obsynth.proofs.witnesses import (
    Dyadic,
    blocks,
    definite_witness,
    inverse_above,
    lyapunov_solution,
    lyapunov_witness,
    number_data,
    root_above,
)
from obsynth.verification.error_system import ErrorModel

#: A claimed rate of decay is proved for all but this share of it, as `obsynth.verify` does.
RATE_SHARE = 1e-4
#: Shares of the slowest mode's decay that are tried for a contraction: the first has the smallest bounds.
CONTRACTION_SHARES = (0.5, 0.9, 0.1, 0.01)
#: A norm is proved for the claimed one, or for one larger by rounding.
NORM_ROOM = (1.0, 1.0 + 1e-12, 1.0 + 1e-9)
#: A share that is a power of two itself is stated as the next one: its logarithm is rounded.
LOGARITHM_ROOM = 1e-9
#: Identities are stated to a power of two of their terms, and of this share of the largest in a column.
IDENTITY_FLOOR = 2.0**-20
#: Those that are stated to a share of their terms: the others are bounded per unit of what enters.
IDENTITIES = ("K", "U", "J", "L")
#: Relative room of bounds above what they are computed as.
BOUND_ROOM = 1.0 + 2.0**-20
#: Bits of the covariances, and the share of process noise that is added to make their inequality strict.
COVARIANCE_BITS, COVARIANCE_ROOM = 400, 2.0**-30
#: An estimate must be that of its fault to this share: the checker refuses others.
ESTIMATE_SHARE = 1e-3

#: Matrices of the plant and of the observer that the file holds.
PLANT_MATRICES = ("E", "A", "B", "C", "D", "Bf", "Df", "Bd", "Dd", "Bw", "Dw")
OBSERVER_MATRICES = ("Az", "Bu", "By", "Cz", "Du", "Dy")


def rows_of(observer: LinearObserver) -> list[tuple[str, str, int]]:
    """Return of each row of an observer's output what it is: kind, name and delay in samples."""
    states = zip(observer.state_names, observer.state_delays, strict=True)
    faults = zip(observer.fault_names, observer.fault_delays, strict=True)
    return [
        *(("state", name, delay) for name, delay in states),
        *(("fault", name, delay) for name, delay in faults),
        *(("residual", name, 0) for name in observer.residual_names),
    ]


@dataclass(frozen=True, eq=False)
class ExactErrorSystem:
    """The error system in exact numbers, as the checker forms it."""

    plant: DescriptorSystem
    observer: LinearObserver
    model: ErrorModel
    az: Dyadic
    cz: Dyadic

    @classmethod
    def of(cls, plant: DescriptorSystem, observer: LinearObserver, model: ErrorModel) -> ExactErrorSystem:
        """Return the error system of an observer that follows what a model says."""
        return cls(plant, observer, model, exact(observer.Az), exact(observer.Cz))

    @property
    def discrete(self) -> bool:
        """Whether the plant is sampled."""
        return self.plant.dt > 0.0

    @cached_property
    def units(self) -> FloatArray:
        """Units of the observer's states in which Az is balanced ``(nz,)``."""
        return np.asarray(balanced_matrix(self.observer.Az)[1], dtype=np.float64)

    def rates(self, shares: tuple[float, ...]) -> list[float]:
        """Return rates of decay that are shares of the slowest mode's."""
        poles = poles_of(self.observer)
        if self.discrete:
            slow = 1.0 - float(np.max(np.abs(poles), initial=0.0))
            return [1.0 - share * slow for share in shares] if slow > 0.0 else []
        slow = -float(np.max(poles.real, initial=-np.inf))
        return [share * slow for share in shares] if slow > 0.0 else []

    @cached_property
    def t0(self) -> Dyadic:
        """T0, zero where there is none."""
        rows, columns = len(self.observer.Cz), len(self.model.E)
        return exact(np.zeros((rows, columns)) if self.model.T0 is None else self.model.T0)

    @cached_property
    def missed(self) -> dict[str, tuple[Dyadic, Dyadic]]:
        """What the identities miss, and the sums of the absolute values of their terms."""
        model, observer = self.model, self.observer
        e, a, b, c, t = (exact(part) for part in (model.E, model.A, model.B, model.C, model.T))
        by, dy, d, bu, du, goal = (
            exact(part) for part in (observer.By, observer.Dy, self.plant.D, observer.Bu, observer.Du, model.goal)
        )
        te = t @ e
        residuals = {
            "K": [self.az @ te, by @ c, -(t @ a)],
            "U": [bu, by @ d, -(t @ b)],
            "J": [self.cz @ te, dy @ c, self.t0 @ a, -goal],
            "L": [du, dy @ d, self.t0 @ b],
            "Z": [self.t0 @ e],
        }
        size = Dyadic.absolute
        sizes = {
            "K": [size(self.az) @ (size(t) @ size(e)), size(by) @ size(c), size(t) @ size(a)],
            "U": [size(bu), size(by) @ size(d), size(t) @ size(b)],
            "J": [size(self.cz) @ (size(t) @ size(e)), size(dy) @ size(c), size(self.t0) @ size(a), size(goal)],
            "L": [size(du), size(dy) @ size(d), size(self.t0) @ size(b)],
            "Z": [size(self.t0) @ size(e)],
        }
        if model.decoupled:
            bd, dd = exact(model.Bd), exact(model.Dd)
            residuals |= {"V": [by @ dd, -(t @ bd)], "W": [dy @ dd, self.t0 @ bd]}
            sizes |= {
                "V": [size(by) @ size(dd), size(t) @ size(bd)],
                "W": [size(dy) @ size(dd), size(self.t0) @ size(bd)],
            }
        return {name: (_sum(residuals[name]), _sum(sizes[name])) for name in residuals}

    def contraction(self) -> tuple[ExactContraction, dict[str, Any]] | None:
        """Return the contraction with the smallest bounds of a few, and the same as data of the file."""
        best, least = None, np.inf
        for units in (self.units, np.ones(self.observer.order)):
            if (candidate := self._contraction(units)) is not None:
                bounds = candidate[0].bounds([self.missed["K"][0]], [self.missed["J"][0].absolute()])
                if best is None or np.max(bounds, initial=0.0) < least:
                    best, least = candidate, float(np.max(bounds, initial=0.0))
        return best

    def _contraction(self, units: FloatArray) -> tuple[ExactContraction, dict[str, Any]] | None:
        for rate in self.rates(CONTRACTION_SHARES):
            witness = lyapunov_witness(self.az, units, rate, discrete=self.discrete)
            inverted = None if witness is None else inverse_above(witness["P"])
            if witness is not None and inverted is not None:
                g, covers = inverted
                data = {"rate": number_data(rate), **written_data(witness), "G": g.data(), "G_covers": covers}
                slowness = 1 - Fraction(rate) if self.discrete else Fraction(rate)
                return ExactContraction(self.cz, [witness["P"]], g, slowness), data
        return None

    def rounding_claim(self, contraction: ExactContraction) -> dict[str, Any] | None:
        """Return what rounding adds to each row; ``None`` where an estimate may not be that of its fault."""
        residuals = self.missed
        if not self.discrete and any(map(bool, residuals["Z"][0].integers.entries())):
            return None
        own = {name: residuals[name][0].absolute() for name in ("J", "L", "W") if name in residuals}
        own["J"] = own["J"] + residuals["Z"][0].absolute()
        bounds = {
            "states": contraction.bounds([residuals["K"][0]], [own["J"]]),
            "inputs": contraction.bounds([residuals["U"][0]], [own["L"]]),
        }
        if self.model.decoupled:
            bounds["disturbances"] = contraction.bounds([residuals["V"][0]], [own["W"]])
        count = 0 if self.model.Phi is None else len(self.model.Phi)
        rows = self.observer.fault_rows
        if count:
            goal = np.abs(self.model.goal[rows, -count:])
            if np.any((goal > 0.0) & (bounds["states"][rows, -count:] > ESTIMATE_SHARE * goal)):
                return None
        return {"claim": "rounding", "bounds": {kind: matrix_data(bound) for kind, bound in bounds.items()}}

    def faults_claim(self, contraction: ExactContraction) -> dict[str, Any] | None:
        """Return that each fault shows in its own estimate after its delay; ``None`` where rounding may hide it."""
        b, d = self.driven("faults")
        rows = rows_of(self.observer)
        delays = {name: delay for kind, name, delay in rows if kind == "fault"}
        names = self.plant.fault_names
        if set(delays) != set(names):
            return None
        missed, trace = d.absolute(), b
        for step in range(1, max(delays.values()) + 1):
            wanted = np.zeros(d.shape)
            for i, (kind, name, _) in enumerate(rows):
                if kind != "state" and delays.get(name) == step:
                    wanted[i, names.index(name)] = 1.0
            missed = missed + (self.cz @ trace + exact(wanted)).absolute()
            trace = self.az @ trace
        bounds = contraction.bounds([trace], [missed])
        own = [bounds[i, names.index(name)] for i, (kind, name, _) in enumerate(rows) if kind == "fault"]
        return None if max(own) > ESTIMATE_SHARE else {"claim": "faults", "bounds": matrix_data(bounds)}

    def fault_models_claim(
        self, contraction: ExactContraction, matrices: Mapping[str, FloatArray], *, delay: int, mean: int
    ) -> dict[str, Any] | None:
        """Return that faults which follow their models are estimated; ``None`` where rounding may hide it."""
        pi, phi, cw = (exact(matrices[name]) for name in ("tracking", "Phi", "Cw"))
        first = delay
        b, d = self.driven("faults")
        drives = self.az @ pi - b @ cw - pi @ phi
        powers = [Dyadic.identity(phi.shape[0])]
        for _ in range(first + mean - 1):
            powers.append(powers[-1] @ phi)
        seen = (self.cz @ pi + d @ cw) @ powers[-1]
        wanted = np.zeros(seen.shape)
        goals = [[Fraction(0)] * seen.shape[1] for _ in range(seen.shape[0])]
        means = _sum(powers[:mean])
        for i, (kind, name, _) in enumerate(rows_of(self.observer)):
            if kind == "fault":
                k = self.plant.fault_names.index(name)
                row = exact(matrices["Cw"][[k]]) @ means
                goals[i] = [row.fraction(0, j) / mean for j in range(seen.shape[1])]
                wanted[i] = [abs(float(value)) for value in goals[i]]
        own = [[abs(seen.fraction(i, j) - goals[i][j]) for j in range(seen.shape[1])] for i in range(seen.shape[0])]
        bounds = contraction.bounds_beside([drives], own)
        rows = self.observer.fault_rows
        if np.any((wanted[rows] > 0.0) & (bounds[rows] > ESTIMATE_SHARE * wanted[rows])):
            return None
        data = {"Pi": pi.data(), "Phi": phi.data(), "Cw": matrix_data(matrices["Cw"]), "bounds": matrix_data(bounds)}
        return {"claim": "fault models", "delay": first, "mean": mean, **data}

    def driven(self, signal: str) -> tuple[Dyadic, Dyadic]:
        """Return what a signal does to the error and to the rows, see the checker."""
        model, plant, observer = self.model, self.plant, self.observer
        nx = plant.nx
        if signal == "fault model":
            count = 0 if model.Phi is None else len(model.Phi)
            return exact(model.T[:, model.T.shape[1] - count :]), self.t0.columns_from(model.T.shape[1] - count)
        b, d = {
            "faults": (plant.Bf, plant.Df),
            "disturbances": (plant.Bd, plant.Dd),
            "noise": (plant.Bw, plant.Dw),
            "disturbances and noise": (np.hstack([plant.Bd, plant.Bw]), np.hstack([plant.Dd, plant.Dw])),
        }[signal]
        own = exact(model.T[:, :nx])
        own0 = exact(np.zeros((len(observer.Cz), nx)) if model.T0 is None else model.T0[:, :nx])
        return own @ exact(b) - exact(observer.By) @ exact(d), exact(observer.Dy) @ exact(d) + own0 @ exact(b)

    def gain_claim(self, signal: str, kinds: list[str], gamma: float, p: Dyadic) -> dict[str, Any] | None:
        """Return that a gain is below gamma, with P of it; ``None`` where P does not prove it."""
        first = p.shape[0]
        rows = [i for i, (kind, _, _) in enumerate(rows_of(self.observer)) if kind in kinds]
        b, d = self.driven(signal)
        a = exact(self.observer.Az[:first, :first])
        b, c, d = b.rows_at(range(first)), -exact(self.observer.Cz[rows, :first]), d.rows_at(rows)
        proved = self._bounded_real(a, b, c, d, gamma, p)
        return None if proved is None else {"claim": "gain", "signal": signal, "rows": kinds, "states": first, **proved}

    def bounded_real_form(
        self, gamma: float, p: Dyadic, after: Dyadic, a: Dyadic, b: Dyadic, c: Dyadic, d: Dyadic
    ) -> Dyadic:
        """Return the matrix of the bounded real inequality, with P now and, in discrete time, P of the next sample."""
        level = Dyadic.identity(b.shape[1]).scaled(gamma).scaled(gamma) - d.T @ d
        if self.discrete:
            corner, side = p - a.T @ after @ a - c.T @ c, -(a.T @ after @ b + c.T @ d)
            level = level - b.T @ after @ b
        else:
            corner, side = -(a.T @ p + p @ a + c.T @ c), -(p @ b + c.T @ d)
        return blocks([[corner, side], [side.T, level]])

    def _bounded_real(
        self, a: Dyadic, b: Dyadic, c: Dyadic, d: Dyadic, gamma: float, p: Dyadic
    ) -> dict[str, Any] | None:
        positive = definite_witness(p)
        for room in NORM_ROOM if positive is not None else ():
            proved = definite_witness(self.bounded_real_form(gamma * room, p, p, a, b, c, d))
            if proved is not None:
                return {
                    "gamma": number_data(gamma * room), "P": p.data(), "P_positive": positive, "bounded_real": proved,
                }  # fmt: skip
        return None

    def matching_claim(
        self, channel: ErrorChannel, kinds: list[str], gamma: float, p: Dyadic, *, disturbances: list[str]
    ) -> dict[str, Any] | None:
        """Return the claim on the gain from weighted signals to a weighted error, from a reference model of faults;
        ``disturbances`` are those that count as noise."""
        formed: Any = replace(channel, unit=1.0)
        a, b, c, d = formed(ExactArithmetic)
        if a.shape != p.shape or not b.shape[1]:
            return None
        proved = self._bounded_real(a, b, c, d, gamma, p)
        return None if proved is None else {
            "claim": "matching", "rows": kinds, "faults": channel.matched is not None, "disturbances": disturbances,
            "noise": channel.model.plant.nw > len(disturbances), "reference": _model_data(channel.matched),
            "input_weight": _model_data(channel.input_weight),
            "error_weight": _model_data(channel.weights.errors if channel.weights else None), **proved,
        }  # fmt: skip

    def deviation_claim(self, kinds: list[str]) -> dict[str, Any] | None:
        """Return bounds on standard deviations of rows under the plant's noise; ``None`` where they are not bounded."""
        rows = [i for i, (kind, _, _) in enumerate(rows_of(self.observer)) if kind in kinds]
        b, d = self.driven("noise")
        through = d.rows_at(rows)
        if not rows or (not self.discrete and any(map(bool, through.integers.entries()))):
            return None
        c, more = self.cz.rows_at(rows), exact(np.diag(self.units**2))
        parts = [self._covariance(q) for q in (b @ b.T, more)]
        if parts[0] is None or parts[1] is None:
            return None
        sizes = [max((_entry(c @ x @ c.T, k) for k in range(len(rows))), default=Fraction(0)) for x in parts if x]
        room = float(COVARIANCE_ROOM * sizes[0] / sizes[1]) if sizes[0] and sizes[1] else COVARIANCE_ROOM
        x = parts[0] + parts[1].scaled(room)
        moved = self.az @ x
        rest = x - moved @ self.az.T - b @ b.T if self.discrete else -(moved + moved.T) - b @ b.T
        covers, positive = definite_witness(rest), definite_witness(x)
        if covers is None or positive is None:
            return None
        variances = [_entry(c @ x @ c.T, k) + self.discrete * _entry(through @ through.T, k) for k in range(len(rows))]
        bounds = np.array([[root_above(value) * BOUND_ROOM] for value in variances])
        return {
            "claim": "deviation", "rows": kinds, "X": x.data(), "X_positive": positive, "covers": covers,
            "deviations": matrix_data(bounds),
        }  # fmt: skip

    def _covariance(self, q: Dyadic) -> Dyadic | None:
        rate = 1.0 if self.discrete else 0.0
        return lyapunov_solution(self.az.T, q, rate, discrete=self.discrete, bits=COVARIANCE_BITS)


@dataclass(frozen=True, eq=False)
class ExactContraction:
    """What columns of inputs do to each row at most, see ``Contraction`` of the checker."""

    cz: Dyadic
    matrices: Sequence[Dyadic]  # P, or those at the vertices of a region
    g: Dyadic
    slowness: Fraction

    def bounds(self, columns: Sequence[Dyadic], own: Sequence[Dyadic]) -> FloatArray:
        """Return what the checker accepts: the largest own part, and what any of the columns adds to it."""
        rows, count = own[0].shape
        largest = [[max(part.fraction(i, j) for part in own) for j in range(count)] for i in range(rows)]
        return self.bounds_beside(columns, largest)

    def bounds_beside(self, columns: Sequence[Dyadic], own: list[list[Fraction]]) -> FloatArray:
        """Return the same, with own parts that are fractions."""
        seen, count = self.cz @ self.g @ self.cz.T, columns[0].shape[1]
        products = [each.T @ P @ each for each in columns for P in self.matrices]
        lengths = [max(_entry(product, j) for product in products) for j in range(count)]
        bounds = np.zeros((seen.shape[0], count))
        for i in range(len(bounds)):
            for j, length in enumerate(lengths):
                added = Fraction(root_above(_entry(seen, i) * length / self.slowness**2))
                bounds[i, j] = rounded_outward((own[i][j] + added) * Fraction(BOUND_ROOM))
        return bounds


def _model_data(model: Model | None) -> dict[str, Any] | None:
    return None if model is None else {name: matrix_data(part) for name, part in zip("ABCD", model, strict=True)}


class ExactArithmetic:
    """Dyadic numbers as an arithmetic in which an error channel is formed."""

    @staticmethod
    def exact(matrix: FloatArray) -> Dyadic:
        """Return an array as it is."""
        return exact(matrix)

    @staticmethod
    def blocks(rows: Sequence[Sequence[Dyadic]]) -> Dyadic:
        """Return a block matrix."""
        return blocks(rows)


def exact(matrix: Any) -> Dyadic:
    """Return an array of doubles as it is."""
    array = np.asarray(matrix, dtype=np.float64)
    return Dyadic.of(array.reshape(array.shape))


def matrix_data(matrix: Any) -> dict[str, Any]:
    """Return an array of doubles as data of a proof file."""
    return exact(matrix).data()


def written_data(claim: Mapping[str, Any]) -> dict[str, Any]:
    """Return witnesses as data of a proof file."""
    return {name: value.data() if isinstance(value, Dyadic) else value for name, value in claim.items()}


def _sum(parts: list[Dyadic]) -> Dyadic:
    total = parts[0]
    for part in parts[1:]:
        total = total + part
    return total


def _entry(matrix: Dyadic, i: int) -> Fraction:
    return matrix.fraction(i, i)


def identities_claim(name: str, missed: Iterable[tuple[str, tuple[Dyadic, Dyadic]]]) -> dict[str, Any] | None:
    """Return the claim that identities hold, from what each misses and the sizes of its terms; ``None`` where they miss
    more than the checker accepts."""
    share = max((_share(*both) for identity, both in missed if identity in IDENTITIES), default=Fraction(0))
    stated = 0.0 if not share else float(2.0 ** np.ceil(np.log2(float(share)) + LOGARITHM_ROOM))
    if stated > ESTIMATE_SHARE:
        return None
    return {"claim": name, "share": number_data(stated), "floor": number_data(IDENTITY_FLOOR)}


def _share(missed: Dyadic, sizes: Dyadic) -> Fraction:
    """Return what is missed as a share of the terms, see the checker's ``require_small``."""
    worst = Fraction(0)
    for j in range(missed.shape[1]):
        column = [sizes.fraction(i, j) for i in range(sizes.shape[0])]
        floor = Fraction(IDENTITY_FLOOR) * max(column, default=Fraction(0))
        for i, size in enumerate(column):
            value = abs(missed.fraction(i, j))
            if value:
                worst = max(worst, value / max(size, floor))
    return worst

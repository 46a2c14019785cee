"""Proof files: a design's claims with witnesses in whole numbers, which one short program checks without obsynth.

The program is ``checker/check_proof.py``; its claims and the format are described in docs/explanation/proof_files.md.
What a design claims and the file does not prove is listed in it by name.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from flint import fmpz_mat

from obsynth.errors import ObsynthError, PreconditionError, SpecError
from obsynth.exporting.proof_of_tests import test_claims
from obsynth.files.outputs import write_atomically
from obsynth.methods.optimal_filter.certificate import gain_matrix
from obsynth.methods.optimal_filter.error_channel import ErrorChannel
from obsynth.methods.optimal_filter.reference import constant_gain, delayed, stored_reference
from obsynth.methods.optimal_filter.weights import weights_of
from obsynth.methods.registry import error_model
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.decoupling_windows import Model
from obsynth.numerics.scaling import balanced_matrix
from obsynth.observers.linear.modes import poles_of
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.noise import noise_words
from obsynth.proofs.exact_arithmetic import rounded_outward
from obsynth.proofs.witnesses import (
    Dyadic,
    blocks,
    definite_witness,
    inverse,
    inverse_above,
    lyapunov_solution,
    lyapunov_witness,
    number_data,
    root_above,
)
from obsynth.results.design import ObserverDesign
from obsynth.results.gain_set_writing import gain_set_digest
from obsynth.verification.error_system import ErrorModel
from obsynth.verification.seen_outputs import seen_plant

PROOF_FORMAT, PROOF_VERSION = "obsynth-proof", 1
#: A claimed rate of decay is proved for all but this share of it, as `obsynth.verify` does.
RATE_SHARE = 1e-4
#: Shares of the slowest mode's decay that are tried for a contraction: the first has the smallest bounds.
CONTRACTION_SHARES = (0.5, 0.9, 0.1, 0.01)
#: The same of a decay that no claim states.
STABILITY_SHARES = (0.9, 0.5, 0.1, 0.01)
#: A norm is proved for the claimed one, or for one larger by rounding.
NORM_ROOM = (1.0, 1.0 + 1e-12, 1.0 + 1e-9)
#: An optimal filter's gain that is proved without a P has one a little above: the file states the first that is proved.
GAIN_ROOMS = (1e-7, 1e-6, 1e-5, 1e-4, 1e-3)
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
#: A fault map that no contraction is for is proved to the first of these shares of its size for constant faults that
#: is: its P has a condition number of the square of what cancels.
FAULT_MAP_LEVELS = (1e-5, 1e-4, 1e-3)

#: Matrices of the plant and of the observer that the file holds.
_PLANT_MATRICES = ("E", "A", "B", "C", "D", "Bf", "Df", "Bd", "Dd", "Bw", "Dw")
_OBSERVER_MATRICES = ("Az", "Bu", "By", "Cz", "Du", "Dy")

#: What methods claim besides, by their ids; `obsynth.verify` checks it.
_NOT_COVERED: Mapping[str, list[str]] = {
    "fault-estimation-filter": ["that no filter has a smaller gain (gamma_min)", "which gains the realisation has"],
    "pd-observer": ["the gain from noise and its derivative", "a range of adaptation rates", "a disk of poles"],
    "ui-pi-observer": ["that the poles are the claimed ones: their decay alone", "a region of poles"],
    "functional-filter": ["deviations with random walks of the faults", "that estimates are free of other faults"],
    "detection-filter": ["the least sensitivity to faults over the band"],
    "optimal-filter": ["that no causal filter has less"],
    "guaranteed-test": ["the mean threshold over tolerances", "that no test is insensitive to more faults"],
}  # fmt: skip


def proof_of(design: ObserverDesign) -> dict[str, Any]:
    """Return the proof file of a linear time-invariant design as JSON data.

    Parameters
    ----------
    design : ObserverDesign
        Of any method with constant matrices.

    Returns
    -------
    dict
        Integers only; see docs/explanation/proof_files.md.

    Raises
    ------
    SpecError
        The plant is nonlinear, changes with k or with parameters of a region: such designs have no proof file.
    PreconditionError
        No claim of the design could be proved.
    """
    if not isinstance(design.plant, DescriptorSystem) or not isinstance(design.observer, LinearObserver):
        raise SpecError(
            f"Design {design.name!r} is over an operating region, or has gains that change with k, or a nonlinear "
            "plant: proof files are for linear methods with constant matrices. `obsynth verify` checks it.",
            path="design",
        )
    proof = _Proof(design)
    proof.collect()
    if not proof.claims:
        raise PreconditionError(
            f"No claim of design {design.name!r} could be written as a proof: {'; '.join(proof.not_covered)}. "
            "`obsynth verify` checks it.",
            condition="proof file",
        )
    return proof.data()


def write_proof(design: ObserverDesign, path: str | Path) -> Path:
    """Write the proof file of a design, whole or not at all, and return its path.

    Parameters
    ----------
    design : ObserverDesign
        See `proof_of`.
    path : str or Path
        Where to write.

    Raises
    ------
    SpecError, PreconditionError
        See `proof_of`.
    """
    return write_atomically(path, proof_bytes(proof_of(design)))


def proof_bytes(data: Mapping[str, Any]) -> bytes:
    """Return what a proof file holds."""
    return (json.dumps(data, separators=(",", ":"), allow_nan=False) + "\n").encode()


@dataclass
class _Proof:
    """Collects claims, and the names of those that are left out."""

    design: ObserverDesign
    claims: list[dict[str, Any]] = field(default_factory=list)
    not_covered: list[str] = field(default_factory=list)
    witness: dict[str, Any] | None = None

    @property
    def plant(self) -> DescriptorSystem:
        return self.design.linear[0]

    @property
    def observer(self) -> LinearObserver:
        return self.design.linear[1]

    @cached_property
    def model(self) -> ErrorModel | None:
        """What the observer follows; ``None`` where nothing is known of it, and for tests."""
        if self.design.method == "guaranteed-test":
            return None
        try:
            return error_model(self.design)
        except ObsynthError:
            return None

    def data(self) -> dict[str, Any]:
        plant, observer, model = self.plant, self.observer, self.model
        nx, rows = plant.nx, len(observer.Cz)
        follows = {
            "T": np.zeros((observer.order, nx)) if model is None else model.T,
            "T0": np.zeros((rows, nx if model is None else len(model.E)))
            if model is None or model.T0 is None else model.T0,
            "Phi": np.zeros((0, 0)) if model is None or model.Phi is None else model.Phi,
            "Cw": np.zeros((plant.nf, 0)) if model is None or model.Cw is None else model.Cw,
        }  # fmt: skip
        names = {"states": plant.state_names, "faults": plant.fault_names, "disturbances": plant.disturbance_names}
        return {
            "format": PROOF_FORMAT,
            "version": PROOF_VERSION,
            "about": f"design {self.design.name} by {self.design.method}, gain set {gain_set_digest(self.design)}",
            "plant": {
                **{name: _shaped(getattr(plant, name)) for name in _PLANT_MATRICES},
                "sample_time": number_data(plant.dt),
                "names": {kind: list(each) for kind, each in names.items()},
            },
            "observer": {
                **{name: _shaped(getattr(observer, name)) for name in _OBSERVER_MATRICES},
                "rows": [list(row) for row in rows_of(observer)],
            },
            "follows": {
                **{name: _shaped(value) for name, value in follows.items()},
                "lag": 0 if model is None else model.lag,
                "decoupled": model is not None and model.decoupled,
            },
            "contraction": self.witness,
            "claims": self.claims,
            "not_covered": self.not_covered,
        }

    def collect(self) -> None:
        """Write every claim that can be proved, and name the others."""
        if self.design.method == "guaranteed-test":
            for name, claim in test_claims(self.design):
                self._add(name, claim)
        elif self.model is None:
            self.not_covered.append("the error system: what the observer follows is not known")
        else:
            self._of_the_error_system(self.model)
        self.not_covered += _NOT_COVERED.get(self.design.method, ["what the method claims by rows of its own"])
        if self.design.source is not None:
            self.not_covered.append(
                "that the plant follows from the plant as written (elimination, sampling): `obsynth verify` repeats it"
            )

    def _add(self, name: str, claim: Mapping[str, Any] | None) -> None:
        if claim is None:
            self.not_covered.append(name)
        else:
            self.claims.append(dict(claim))

    def _of_the_error_system(self, model: ErrorModel) -> None:
        system = _Exact.of(self.plant, self.observer, model)
        self._add("the identities hold to less than a thousandth of their terms", system.identities_claim())
        if self.observer.order:
            self._add("stability: no Lyapunov matrix was found", self._stable(system))
            self._add_contraction(system)
        else:
            self._add_faults(system, None)
        self._add_gains(system)
        self._add_deviation(system)

    def _stable(self, system: _Exact) -> dict[str, Any] | None:
        decay, dt = self.design.certificate.claims.get("decay"), self.plant.dt
        rates = [] if not decay or not np.isfinite(decay) else [decay * (1.0 - RATE_SHARE)]
        rates = [float(np.nextafter(np.exp(-rate * dt), 1.0)) for rate in rates] if dt > 0.0 else rates
        for rate in [*rates, *system.rates(STABILITY_SHARES)]:
            if (witness := lyapunov_witness(system.az, system.units, rate, discrete=dt > 0.0)) is not None:
                return {"claim": "stable", "rate": number_data(rate), **_written(witness)}
        return None

    def _add_contraction(self, system: _Exact) -> None:
        contraction_and_witness = system.contraction()
        if contraction_and_witness is None:
            self.not_covered.append("what rounding of stored numbers adds: no contraction was found")
            self._add_faults(system, None)
            return
        contraction, self.witness = contraction_and_witness
        self._add("what rounding of stored numbers adds: too much for an estimate", system.rounding_claim(contraction))
        self._add_faults(system, contraction)
        matrices = self.design.certificate.matrices
        if {"tracking", "Phi", "Cw", "T0"} <= matrices.keys() and len(matrices["Phi"]):
            mean = int(self.design.options.get("mean", 1))
            delay = int(self.design.options.get("delay", 0))
            claim = system.fault_models_claim(contraction, matrices, delay=delay, mean=mean)
            self._add("faults that follow their models are estimated as they are", claim)

    def _add_faults(self, system: _Exact, contraction: _Contraction | None) -> None:
        """Add that faults of any course are estimated; of an optimal filter this is the fault map, where it is late."""
        optimal = self.design.method == "optimal-filter"
        if not optimal and not (self.design.method == "fault-estimation-filter" and self.plant.dt > 0.0):
            return
        late = not optimal or min(self.observer.fault_delays, default=0) > 0
        claim = system.faults_claim(contraction) if late and contraction is not None else None
        if optimal and not self.design.options["exact"]:
            return
        if optimal and claim is None:
            claim = self._fault_map_claim(system)
        self._add("the fault map" if optimal else "each fault's own estimate: rounding may hide it", claim)

    def _add_gain_of_optimal_filter(self, system: _Exact) -> None:
        """Add the gain of an optimal filter: of weighted signals, or from a reference model, by the claim for these."""
        (certificate, options), plant = (self.design.certificate, self.design.options), self.plant
        if "gain" not in certificate.claims:
            return
        gain, claim = certificate.claims["gain"], None
        plain = options.get("exact") and options.get("weights") is None
        # Its P is of the error in units of its own.  What is decoupled adds its rounding, and is no exception.
        decoupled = () if plain else tuple(options["decoupled"])
        seen = seen_plant(plant, decoupled)
        matched = None if options["exact"] else stored_reference(certificate.matrices)
        weights = weights_of(options.get("weights"), seen, rows=len(self.observer.Cz), exact=bool(options["exact"]))
        channel = ErrorChannel(replace(system.model, plant=seen), matched, weights).in_units_of(gain)
        signal = "disturbances and noise" if plant.nd else "noise"
        for level, P in _gain_witnesses(channel, gain, certificate.matrices.get("P"), plant.dt):
            p = Dyadic.of(0.5 * (P + P.T)).scaled(channel.unit).scaled(channel.unit)
            if plain:
                claim = system.gain_claim(signal, self._rows, level, p)
            else:
                counted = [name for name in plant.disturbance_names if name not in decoupled]
                claim = system.matching_claim(channel, self._rows, level, p, disturbances=counted)
            if claim is not None:
                break
        self._add(f"the gain {gain:.6g} of this filter", claim)

    @property
    def _rows(self) -> list[str]:
        return ["fault"] if self.observer.fault_names else ["residual"]

    def _fault_map_claim(self, system: _Exact) -> dict[str, Any] | None:
        """Return that the estimates differ from the reference model, or from the faults delayed, by next to nothing."""
        plant, observer, matrices = self.plant, self.observer, self.design.certificate.matrices
        reference = stored_reference(matrices) or delayed(observer.fault_delays)
        size = float(np.max(np.abs(constant_gain(reference, plant.dt)), initial=0.0))
        quiet = plant.replace(Bw=None, Dw=None, noise_names=None)
        channel = ErrorChannel(replace(system.model, plant=quiet), reference)
        for share in FAULT_MAP_LEVELS if size > 0.0 else ():
            scaled = channel.in_units_of(share * size)
            if (P := gain_matrix(channel, share * size, plant.dt, self._alpha)) is not None:
                p = Dyadic.of(0.5 * (P + P.T)).scaled(scaled.unit).scaled(scaled.unit)
                claim = system.matching_claim(channel, self._rows, share * size, p, disturbances=[])
                if claim is not None:
                    return claim
        return None

    @property
    def _alpha(self) -> float:
        return _mapped_at(self.observer, self.plant.dt)

    def _add_gains(self, system: _Exact) -> None:
        certificate, plant = self.design.certificate, self.plant
        claims, matrices = certificate.claims, certificate.matrices
        if "gamma" in claims and plant.nd and "P_factor" in matrices:
            factor = Dyadic.of(matrices["P_factor"])
            claim = system.gain_claim("disturbances", ["fault"], claims["gamma"], factor.T @ factor)
            self._add(f"the l2 gain {claims['gamma']:.6g} from the disturbances", claim)
        if "fault_rate_gain" in claims and "P_rate" in matrices:
            gain = claims["fault_rate_gain"]
            claim = system.gain_claim("fault model", ["fault"], gain, Dyadic.of(matrices["P_rate"]))
            self._add(f"the l2 gain {gain:.6g} from the rates of the faults", claim)
        if "disturbance_gain" in claims and "P" in matrices:
            gain = claims["disturbance_gain"]
            p = dual_matrix(0.5 * (matrices["P"] + matrices["P"].T), gain)
            claim = None if p is None else system.gain_claim("disturbances and noise", ["residual"], gain, p)
            self._add(f"the l2 gain {gain:.6g} from unknown inputs and noise", claim)
        if self.design.method == "optimal-filter":
            self._add_gain_of_optimal_filter(system)

    def _add_deviation(self, system: _Exact) -> None:
        rows = ["fault"] if self.observer.fault_names else ["residual"]
        if self.plant.nw and self.observer.order and (self.plant.Bw.any() or self.plant.Dw.any()):
            self._add(f"standard deviations under {noise_words(self.plant.noise_names)}", system.deviation_claim(rows))


def _gain_witnesses(
    channel: ErrorChannel, gain: float, P: FloatArray | None, dt: float
) -> Iterator[tuple[float, FloatArray]]:
    """Yield levels with a P that may prove them: the stored one, or where there is none of levels a little above."""
    if P is not None:
        yield gain, P
        return
    alpha = _mapped_at(channel.model.observer, dt)
    for room in GAIN_ROOMS:
        if (P := gain_matrix(channel, gain * (1.0 + room), dt, alpha)) is not None:
            yield gain * (1.0 + room), P


def _mapped_at(observer: LinearObserver, dt: float) -> float:
    """Return where frequencies are mapped to the circle of samples, in continuous time: near those of the filter."""
    poles = np.abs(poles_of(observer))
    return float(np.exp(np.mean(np.log(poles[poles > 0.0])))) if dt == 0.0 and np.any(poles > 0.0) else 1.0


def rows_of(observer: LinearObserver) -> list[tuple[str, str, int]]:
    """Return of each row of an observer's output what it is: kind, name and delay in samples."""
    states = zip(observer.state_names, observer.state_delays, strict=True)
    faults = zip(observer.fault_names, observer.fault_delays, strict=True)
    return [
        *(("state", name, delay) for name, delay in states),
        *(("fault", name, delay) for name, delay in faults),
        *(("residual", name, 0) for name in observer.residual_names),
    ]


def dual_matrix(p: FloatArray, gain: float) -> Dyadic | None:
    """Return ``gain^2`` times the inverse: it proves of a system what p proves of the transposed one."""
    inverse_p = inverse(Dyadic.of(p))
    return None if inverse_p is None else inverse_p.scaled(gain).scaled(gain)


@dataclass(frozen=True, eq=False)
class _Exact:
    """The error system in exact numbers, as the checker forms it."""

    plant: DescriptorSystem
    observer: LinearObserver
    model: ErrorModel
    az: Dyadic
    cz: Dyadic

    @classmethod
    def of(cls, plant: DescriptorSystem, observer: LinearObserver, model: ErrorModel) -> _Exact:
        return cls(plant, observer, model, _exact(observer.Az), _exact(observer.Cz))

    @property
    def discrete(self) -> bool:
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
        return _exact(np.zeros((rows, columns)) if self.model.T0 is None else self.model.T0)

    @cached_property
    def missed(self) -> dict[str, tuple[Dyadic, Dyadic]]:
        """What the identities miss, and the sums of the absolute values of their terms."""
        model, observer = self.model, self.observer
        e, a, b, c, t = (_exact(part) for part in (model.E, model.A, model.B, model.C, model.T))
        by, dy, d, bu, du, goal = (
            _exact(part) for part in (observer.By, observer.Dy, self.plant.D, observer.Bu, observer.Du, model.goal)
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
            bd, dd = _exact(model.Bd), _exact(model.Dd)
            residuals |= {"V": [by @ dd, -(t @ bd)], "W": [dy @ dd, self.t0 @ bd]}
            sizes |= {
                "V": [size(by) @ size(dd), size(t) @ size(bd)],
                "W": [size(dy) @ size(dd), size(self.t0) @ size(bd)],
            }
        return {name: (_sum(residuals[name]), _sum(sizes[name])) for name in residuals}

    def identities_claim(self) -> dict[str, Any] | None:
        share = max((_share(*both) for name, both in self.missed.items() if name in IDENTITIES), default=Fraction(0))
        stated = 0.0 if not share else float(2.0 ** np.ceil(np.log2(float(share)) + LOGARITHM_ROOM))
        if stated > ESTIMATE_SHARE:
            return None
        return {"claim": "identities", "share": number_data(stated), "floor": number_data(IDENTITY_FLOOR)}

    def contraction(self) -> tuple[_Contraction, dict[str, Any]] | None:
        """Return the contraction with the smallest bounds of a few, and the same as data of the file."""
        best, least = None, np.inf
        for units in (self.units, np.ones(self.observer.order)):
            if (candidate := self._contraction(units)) is not None:
                bounds = candidate[0].bounds(self.missed["K"][0], self.missed["J"][0].absolute())
                if best is None or np.max(bounds, initial=0.0) < least:
                    best, least = candidate, float(np.max(bounds, initial=0.0))
        return best

    def _contraction(self, units: FloatArray) -> tuple[_Contraction, dict[str, Any]] | None:
        for rate in self.rates(CONTRACTION_SHARES):
            witness = lyapunov_witness(self.az, units, rate, discrete=self.discrete)
            inverted = None if witness is None else inverse_above(witness["P"])
            if witness is not None and inverted is not None:
                g, covers = inverted
                data = {"rate": number_data(rate), **_written(witness), "G": g.data(), "G_covers": covers}
                slowness = 1 - Fraction(rate) if self.discrete else Fraction(rate)
                return _Contraction(self.cz, witness["P"], g, slowness), data
        return None

    def rounding_claim(self, contraction: _Contraction) -> dict[str, Any] | None:
        residuals = self.missed
        if not self.discrete and any(map(bool, residuals["Z"][0].integers.entries())):
            return None
        own = {name: residuals[name][0].absolute() for name in ("J", "L", "W") if name in residuals}
        own["J"] = own["J"] + residuals["Z"][0].absolute()
        bounds = {
            "states": contraction.bounds(residuals["K"][0], own["J"]),
            "inputs": contraction.bounds(residuals["U"][0], own["L"]),
        }
        if self.model.decoupled:
            bounds["disturbances"] = contraction.bounds(residuals["V"][0], own["W"])
        count = 0 if self.model.Phi is None else len(self.model.Phi)
        rows = self.observer.fault_rows
        if count:
            goal = np.abs(self.model.goal[rows, -count:])
            if np.any((goal > 0.0) & (bounds["states"][rows, -count:] > ESTIMATE_SHARE * goal)):
                return None
        return {"claim": "rounding", "bounds": {kind: _shaped(bound) for kind, bound in bounds.items()}}

    def faults_claim(self, contraction: _Contraction) -> dict[str, Any] | None:
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
            missed = missed + (self.cz @ trace + _exact(wanted)).absolute()
            trace = self.az @ trace
        bounds = contraction.bounds(trace, missed)
        own = [bounds[i, names.index(name)] for i, (kind, name, _) in enumerate(rows) if kind == "fault"]
        return None if max(own) > ESTIMATE_SHARE else {"claim": "faults", "bounds": _shaped(bounds)}

    def fault_models_claim(
        self, contraction: _Contraction, matrices: Mapping[str, FloatArray], *, delay: int, mean: int
    ) -> dict[str, Any] | None:
        pi, phi, cw = (_exact(matrices[name]) for name in ("tracking", "Phi", "Cw"))
        first = delay
        b, d = self.driven("faults")
        drives = self.az @ pi - b @ cw - pi @ phi
        powers = [Dyadic.identity(phi.shape[0])]
        for _ in range(first + mean - 1):
            powers.append(powers[-1] @ phi)
        seen = (self.cz @ pi + d @ cw) @ powers[-1]
        wanted = np.zeros(seen.shape)
        exact = [[Fraction(0)] * seen.shape[1] for _ in range(seen.shape[0])]
        means = _sum(powers[:mean])
        for i, (kind, name, _) in enumerate(rows_of(self.observer)):
            if kind == "fault":
                k = self.plant.fault_names.index(name)
                row = _exact(matrices["Cw"][[k]]) @ means
                exact[i] = [row.fraction(0, j) / mean for j in range(seen.shape[1])]
                wanted[i] = [abs(float(value)) for value in exact[i]]
        own = [[abs(seen.fraction(i, j) - exact[i][j]) for j in range(seen.shape[1])] for i in range(seen.shape[0])]
        bounds = contraction.bounds_beside(drives, own)
        rows = self.observer.fault_rows
        if np.any((wanted[rows] > 0.0) & (bounds[rows] > ESTIMATE_SHARE * wanted[rows])):
            return None
        data = {"Pi": pi.data(), "Phi": phi.data(), "Cw": _shaped(matrices["Cw"]), "bounds": _shaped(bounds)}
        return {"claim": "fault models", "delay": first, "mean": mean, **data}

    def driven(self, signal: str) -> tuple[Dyadic, Dyadic]:
        """Return what a signal does to the error and to the rows, see the checker."""
        model, plant, observer = self.model, self.plant, self.observer
        nx = plant.nx
        if signal == "fault model":
            count = 0 if model.Phi is None else len(model.Phi)
            return _exact(model.T[:, model.T.shape[1] - count :]), _columns(self.t0, model.T.shape[1] - count)
        b, d = {
            "faults": (plant.Bf, plant.Df),
            "disturbances": (plant.Bd, plant.Dd),
            "noise": (plant.Bw, plant.Dw),
            "disturbances and noise": (np.hstack([plant.Bd, plant.Bw]), np.hstack([plant.Dd, plant.Dw])),
        }[signal]
        own = _exact(model.T[:, :nx])
        own0 = _exact(np.zeros((len(observer.Cz), nx)) if model.T0 is None else model.T0[:, :nx])
        return own @ _exact(b) - _exact(observer.By) @ _exact(d), _exact(observer.Dy) @ _exact(d) + own0 @ _exact(b)

    def gain_claim(self, signal: str, kinds: list[str], gamma: float, p: Dyadic) -> dict[str, Any] | None:
        first = p.shape[0]
        rows = [i for i, (kind, _, _) in enumerate(rows_of(self.observer)) if kind in kinds]
        b, d = self.driven(signal)
        a = _exact(self.observer.Az[:first, :first])
        b, c, d = _rows(b, range(first)), -_exact(self.observer.Cz[rows, :first]), _rows(d, rows)
        proved = self._bounded_real(a, b, c, d, gamma, p)
        return None if proved is None else {"claim": "gain", "signal": signal, "rows": kinds, "states": first, **proved}

    def _bounded_real(
        self, a: Dyadic, b: Dyadic, c: Dyadic, d: Dyadic, gamma: float, p: Dyadic
    ) -> dict[str, Any] | None:
        positive = definite_witness(p)
        for room in NORM_ROOM if positive is not None else ():
            level = Dyadic.identity(b.shape[1]).scaled(gamma * room).scaled(gamma * room) - d.T @ d
            if self.discrete:
                corner, side = p - a.T @ p @ a - c.T @ c, -(a.T @ p @ b + c.T @ d)
                level = level - b.T @ p @ b
            else:
                corner, side = -(a.T @ p + p @ a + c.T @ c), -(p @ b + c.T @ d)
            proved = definite_witness(blocks([[corner, side], [side.T, level]]))
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
        a, b, c, d = formed(_ExactArithmetic)
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
        rows = [i for i, (kind, _, _) in enumerate(rows_of(self.observer)) if kind in kinds]
        b, d = self.driven("noise")
        through = _rows(d, rows)
        if not rows or (not self.discrete and any(map(bool, through.integers.entries()))):
            return None
        c, more = _rows(self.cz, rows), _exact(np.diag(self.units**2))
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
            "deviations": _shaped(bounds),
        }  # fmt: skip

    def _covariance(self, q: Dyadic) -> Dyadic | None:
        rate = 1.0 if self.discrete else 0.0
        return lyapunov_solution(self.az.T, q, rate, discrete=self.discrete, bits=COVARIANCE_BITS)


@dataclass(frozen=True, eq=False)
class _Contraction:
    cz: Dyadic
    p: Dyadic
    g: Dyadic
    slowness: Fraction

    def bounds(self, columns: Dyadic, own: Dyadic) -> FloatArray:
        """Return what the checker accepts: own, and what columns add to it ``(rows, columns)``."""
        parts = [[own.fraction(i, j) for j in range(own.shape[1])] for i in range(own.shape[0])]
        return self.bounds_beside(columns, parts)

    def bounds_beside(self, columns: Dyadic, own: list[list[Fraction]]) -> FloatArray:
        heights = [_entry(self.cz @ self.g @ self.cz.T, i) for i in range(self.cz.shape[0])]
        lengths = [_entry(columns.T @ self.p @ columns, j) for j in range(columns.shape[1])]
        bounds = np.zeros((len(heights), len(lengths)))
        for i, height in enumerate(heights):
            for j, length in enumerate(lengths):
                added = Fraction(root_above(height * length / self.slowness**2))
                bounds[i, j] = rounded_outward((own[i][j] + added) * Fraction(BOUND_ROOM))
        return bounds


def _model_data(model: Model | None) -> dict[str, Any] | None:
    return None if model is None else {name: _shaped(part) for name, part in zip("ABCD", model, strict=True)}


class _ExactArithmetic:
    """Dyadic numbers as an arithmetic in which an error channel is formed."""

    @staticmethod
    def exact(matrix: FloatArray) -> Dyadic:
        """Return an array as it is."""
        return _exact(matrix)

    @staticmethod
    def blocks(rows: Sequence[Sequence[Dyadic]]) -> Dyadic:
        """Return a block matrix."""
        return blocks(rows)


def _exact(matrix: Any) -> Dyadic:
    array = np.asarray(matrix, dtype=np.float64)
    return Dyadic.of(array.reshape(array.shape))


def _shaped(matrix: Any) -> dict[str, Any]:
    return _exact(matrix).data()


def _written(claim: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value.data() if isinstance(value, Dyadic) else value for name, value in claim.items()}


def _sum(parts: list[Dyadic]) -> Dyadic:
    total = parts[0]
    for part in parts[1:]:
        total = total + part
    return total


def _rows(matrix: Dyadic, rows: Any) -> Dyadic:
    integers = matrix.integers.tolist()
    chosen = [integers[i] for i in rows]
    entries = [value for row in chosen for value in row]
    return Dyadic(fmpz_mat(len(chosen), matrix.shape[1], entries), matrix.exponent)


def _columns(matrix: Dyadic, first: int) -> Dyadic:
    return _rows(matrix.T, range(first, matrix.shape[1])).T


def _entry(matrix: Dyadic, i: int) -> Fraction:
    return matrix.fraction(i, i)


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

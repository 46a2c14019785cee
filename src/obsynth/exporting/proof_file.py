"""Proof files: a design's claims with witnesses in whole numbers, which one short program checks without obsynth.

The program is ``checker/check_proof.py``; its claims and the format are described in docs/explanation/proof_files.md.
What a design claims and the file does not prove is listed in it by name.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from obsynth.errors import ObsynthError, PreconditionError, SpecError, counted
from obsynth.exporting.exact_error_system import (
    OBSERVER_MATRICES,
    PLANT_MATRICES,
    RATE_SHARE,
    ExactContraction,
    ExactErrorSystem,
    identities_claim,
    matrix_data,
    rows_of,
    written_data,
)
from obsynth.exporting.proof_claims import ProofClaims
from obsynth.exporting.proof_of_tests import test_claims
from obsynth.exporting.proof_over_region import RegionProof
from obsynth.files.outputs import write_atomically
from obsynth.methods.optimal_filter.certificate import gain_matrix
from obsynth.methods.optimal_filter.error_channel import ErrorChannel
from obsynth.methods.optimal_filter.reference import constant_gain, delayed, stored_reference
from obsynth.methods.optimal_filter.weights import weights_of
from obsynth.methods.registry import error_model
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.linear.modes import poles_of
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.noise import noise_words
from obsynth.plants.polytopic import PolytopicSystem
from obsynth.proofs.witnesses import (
    Dyadic,
    inverse,
    lyapunov_witness,
    number_data,
)
from obsynth.results.design import ObserverDesign
from obsynth.results.gain_set_writing import gain_set_digest
from obsynth.results.gain_sets import PROOF_FORMAT
from obsynth.verification.error_system import ErrorModel
from obsynth.verification.seen_outputs import seen_plant

PROOF_VERSION = 1
#: Shares of the slowest mode's decay that are tried where no claim states one.
STABILITY_SHARES = (0.9, 0.5, 0.1, 0.01)
#: An optimal filter's gain that is proved without a P has one a little above: the file states the first that is proved.
GAIN_ROOMS = (1e-7, 1e-6, 1e-5, 1e-4, 1e-3)
#: A fault map that no contraction is for is proved to the first of these shares of its size for constant faults that
#: is: its P has a condition number of the square of what cancels.
FAULT_MAP_LEVELS = (1e-5, 1e-4, 1e-3)

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
    """Return the proof file of a linear design as JSON data.

    Parameters
    ----------
    design : ObserverDesign
        Of any method with constant matrices, or with those of the vertices of a region.

    Returns
    -------
    dict
        Integers only; see docs/explanation/proof_files.md.

    Raises
    ------
    SpecError
        The plant is nonlinear, or its gains change with k: such designs have no proof file.
    PreconditionError
        No claim of the design could be proved.
    """
    proof: _Proof | RegionProof
    if isinstance(design.plant, PolytopicSystem):
        proof = RegionProof(design)
    elif isinstance(design.plant, DescriptorSystem) and isinstance(design.observer, LinearObserver):
        proof = _Proof(design)
    else:
        raise SpecError(
            f"Design {design.name!r} has gains that change with k, or a nonlinear plant: proof files are for linear "
            "methods with constant matrices or scheduled ones. `obsynth verify` checks it.",
            path="design",
        )
    proof.collect()
    if not proof.claims:
        raise PreconditionError(
            f"No claim of design {design.name!r} could be written as a proof: {'; '.join(proof.not_covered)}. "
            "`obsynth verify` checks it.",
            condition="proof file",
        )
    about = f"design {design.name} by {design.method}, gain set {gain_set_digest(design)}"
    return {"format": PROOF_FORMAT, "version": PROOF_VERSION, "about": about, **proof.data()}


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
class _Proof(ProofClaims):
    """Collects claims, and the names of those that are left out."""

    @property
    def plant(self) -> DescriptorSystem:
        return self.design.linear[0]

    @property
    def observer(self) -> LinearObserver:
        """The shipped one, beside modes of the plant that its errors hold: nothing drives these, they stay at zero."""
        return self.design.linear[1] if self.model is None else self.model.observer

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
            "plant": {
                **{name: matrix_data(getattr(plant, name)) for name in PLANT_MATRICES},
                "sample_time": number_data(plant.dt),
                "names": {kind: list(each) for kind, each in names.items()},
            },
            "observer": {
                **{name: matrix_data(getattr(observer, name)) for name in OBSERVER_MATRICES},
                "rows": [list(row) for row in rows_of(observer)],
            },
            "follows": {
                **{name: matrix_data(value) for name, value in follows.items()},
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
                self.add(name, claim)
        elif self.model is None:
            self.not_covered.append("the error system: what the observer follows is not known")
        else:
            self._of_the_error_system(self.model)
        self.not_covered += _NOT_COVERED.get(self.design.method, ["what the method claims by rows of its own"])
        held = self.observer.order - self.design.linear[1].order
        if held:
            self.not_covered.append(
                f"that the last {counted(held, 'state')} of the observer, which nothing drives, may be left out of it"
            )
        self.leave_the_source()

    def _of_the_error_system(self, model: ErrorModel) -> None:
        system = ExactErrorSystem.of(self.plant, self.observer, model)
        self.add(
            "the identities hold to less than a thousandth of their terms",
            identities_claim("identities", system.missed.items()),
        )
        if self.observer.order:
            self.add("stability: no Lyapunov matrix was found", self._stable(system))
            self._add_contraction(system)
        else:
            self._add_faults(system, None)
        self._add_gains(system)
        self._add_deviation(system)

    def _stable(self, system: ExactErrorSystem) -> dict[str, Any] | None:
        decay, dt = self.design.certificate.claims.get("decay"), self.plant.dt
        rates = [] if not decay or not np.isfinite(decay) else [decay * (1.0 - RATE_SHARE)]
        rates = [float(np.nextafter(np.exp(-rate * dt), 1.0)) for rate in rates] if dt > 0.0 else rates
        for rate in [*rates, *system.rates(STABILITY_SHARES)]:
            if (witness := lyapunov_witness(system.az, system.units, rate, discrete=dt > 0.0)) is not None:
                return {"claim": "stable", "rate": number_data(rate), **written_data(witness)}
        return None

    def _add_contraction(self, system: ExactErrorSystem) -> None:
        contraction_and_witness = system.contraction()
        if contraction_and_witness is None:
            self.not_covered.append("what rounding of stored numbers adds: no contraction was found")
            self._add_faults(system, None)
            return
        contraction, self.witness = contraction_and_witness
        self.add("what rounding of stored numbers adds: too much for an estimate", system.rounding_claim(contraction))
        self._add_faults(system, contraction)
        matrices = self.design.certificate.matrices
        if {"tracking", "Phi", "Cw", "T0"} <= matrices.keys() and len(matrices["Phi"]):
            mean = int(self.design.options.get("mean", 1))
            delay = int(self.design.options.get("delay", 0))
            claim = system.fault_models_claim(contraction, matrices, delay=delay, mean=mean)
            self.add("faults that follow their models are estimated as they are", claim)

    def _add_faults(self, system: ExactErrorSystem, contraction: ExactContraction | None) -> None:
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
        self.add("the fault map" if optimal else "each fault's own estimate: rounding may hide it", claim)

    def _add_gain_of_optimal_filter(self, system: ExactErrorSystem) -> None:
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
        self.add(f"the gain {gain:.6g} of this filter", claim)

    @property
    def _rows(self) -> list[str]:
        return ["fault"] if self.observer.fault_names else ["residual"]

    def _fault_map_claim(self, system: ExactErrorSystem) -> dict[str, Any] | None:
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

    def _add_gains(self, system: ExactErrorSystem) -> None:
        certificate, plant = self.design.certificate, self.plant
        claims, matrices = certificate.claims, certificate.matrices
        if "gamma" in claims and plant.nd and "P_factor" in matrices:
            factor = Dyadic.of(matrices["P_factor"])
            claim = system.gain_claim("disturbances", ["fault"], claims["gamma"], factor.T @ factor)
            self.add(f"the l2 gain {claims['gamma']:.6g} from the disturbances", claim)
        if "fault_rate_gain" in claims and "P_rate" in matrices:
            gain = claims["fault_rate_gain"]
            claim = system.gain_claim("fault model", ["fault"], gain, Dyadic.of(matrices["P_rate"]))
            self.add(f"the l2 gain {gain:.6g} from the rates of the faults", claim)
        if "disturbance_gain" in claims and "P" in matrices:
            gain = claims["disturbance_gain"]
            p = dual_matrix(0.5 * (matrices["P"] + matrices["P"].T), gain)
            claim = None if p is None else system.gain_claim("disturbances and noise", ["residual"], gain, p)
            self.add(f"the l2 gain {gain:.6g} from unknown inputs and noise", claim)
        if self.design.method == "optimal-filter":
            self._add_gain_of_optimal_filter(system)

    def _add_deviation(self, system: ExactErrorSystem) -> None:
        rows = ["fault"] if self.observer.fault_names else ["residual"]
        if self.plant.nw and self.observer.order and (self.plant.Bw.any() or self.plant.Dw.any()):
            self.add(f"standard deviations under {noise_words(self.plant.noise_names)}", system.deviation_claim(rows))


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


def dual_matrix(p: FloatArray, gain: float) -> Dyadic | None:
    """Return ``gain^2`` times the inverse: it proves of a system what p proves of the transposed one."""
    inverse_p = inverse(Dyadic.of(p))
    return None if inverse_p is None else inverse_p.scaled(gain).scaled(gain)

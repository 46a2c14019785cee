"""Gains of a PD observer with realisation and proved certificate."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from obsynth.conditions.pd_inequalities import PdSolution
from obsynth.methods.pd_observer.certificate import explicit_certificate, gain_certificate
from obsynth.methods.pd_observer.certificate_proofs import (
    GAIN_CLAIMS,
    error_inputs,
    prove_gains,
    prove_shipped_stability,
)
from obsynth.methods.pd_observer.method import PdObserver
from obsynth.methods.pd_observer.realisation import realise_pd_observer, with_faults_as_states, with_sensor_noise
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.doubling import symmetric
from obsynth.numerics.spectra import abscissa
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.verification.inequalities import prove_symmetric_positive


@dataclass(frozen=True, eq=False)
class PdGains:
    """Gains in the loop with what proves them."""

    J: FloatArray  # (nx + nf, ny), the paper's [J; G M]
    L: FloatArray  # (nx + nf, ny), [L; G N]
    P1: FloatArray  # (nx + nf, nx + nf), for the state [x; f]
    P3: FloatArray
    theorem: int
    asked_delta: float  # seconds, of the design; ``delta``: of the certificate
    delta: float
    decay: float  # alpha, 1/seconds
    observer: LinearObserver
    record: Mapping[str, Any]
    ends: tuple[FloatArray, ...] = ()  # P1 at the ends of the range of adaptation gains
    gain_certificates: Mapping[str, FloatArray] = field(default_factory=dict)  # P_rate, P_noise (nx + nf, nx + nf)
    proved: bool = False
    proved_in_double_precision: bool = False
    engine: str = ""

    @property
    def abscissa(self) -> float:
        """Largest real part of an eigenvalue of the error system, 1/seconds."""
        return abscissa(self.observer.Az, 0.0)


def certified(
    plant: DescriptorSystem, method: PdObserver, solution: PdSolution, *, delta: float, decay: float
) -> PdGains | None:
    """Return the gains with the solver's certificate or a computed one; ``None`` without a realisation."""
    augmented = with_faults_as_states(plant)
    try:
        observer = realise_pd_observer(plant, augmented, solution.J, solution.L)
    except np.linalg.LinAlgError:
        return None
    ends = method.range_numbers
    p1, p3 = symmetric(solution.P1[0]), symmetric(solution.P3) if method.theorem == 2 else solution.P3
    gains = PdGains(
        J=solution.J,
        L=solution.L,
        P1=p1,
        P3=p3,
        theorem=method.theorem,
        asked_delta=delta,
        delta=delta,
        decay=decay,
        observer=observer,
        record=solution.record,
    )
    if ends is not None:
        return _certified_range(plant, replace(gains, ends=solution.P1), ends)
    certificates = _gain_certificates(plant, method, gains)
    if certificates is None:
        return gains
    gains = _with_proofs(replace(gains, gain_certificates=certificates))
    if gains.proved_in_double_precision:
        return gains
    own = explicit_certificate(observer.Az, observer.Cz[: observer.order], decay=decay) if method.theorem == 1 else None
    if own is None:
        return gains
    other = _with_proofs(replace(gains, P1=own[0], P3=own[1], delta=own[2]))
    return gains if gains.proved and not other.proved_in_double_precision else other


def _gain_certificates(plant: DescriptorSystem, method: PdObserver, gains: PdGains) -> dict[str, FloatArray] | None:
    """Return the certificates of the bounds on l2 gains that are asked for; ``None`` when one is not found."""
    observer, certificates = gains.observer, {}
    for option, kind in GAIN_CLAIMS.items():
        bound = getattr(method, option)
        if bound is None:
            continue
        driving = error_inputs(with_sensor_noise(plant), gains.J, gains.L, kind)
        certificate = gain_certificate(observer.Az, driving, observer.Cz[observer.fault_rows], float(bound))
        if certificate is None:
            return None
        certificates[f"P_{kind}"] = certificate
    return certificates


def _with_proofs(gains: PdGains) -> PdGains:
    """Return the gains with the outcome of proving their certificate."""
    proofs = [
        prove_symmetric_positive(gains.P1),
        prove_shipped_stability(gains.observer, gains.P1, gains.P3, delta=gains.delta, decay=gains.decay),
    ]
    if gains.theorem == 2:
        proofs.append(prove_symmetric_positive(gains.P3))
    return replace(
        gains,
        proved=all(proof.proved for proof in proofs),
        proved_in_double_precision=all(proof.in_double_precision for proof in proofs),
    )


def _certified_range(plant: DescriptorSystem, gains: PdGains, ends: tuple[float, float]) -> PdGains:
    """Certify every ``g I`` of a range by its ends (affine in g); ships g = 1 or the nearer end, P1 interpolated."""
    p1 = tuple(map(symmetric, gains.ends))
    plants = [with_faults_as_states(plant, end * np.eye(plant.nf)) for end in ends]
    proved = all(
        prove_symmetric_positive(matrix).proved
        and prove_gains(p.A, p.C, gains.J, gains.L, matrix, gains.P3, delta=gains.delta, decay=gains.decay).proved
        for matrix, p in zip(p1, plants, strict=True)
    )
    shipped = min(max(1.0, ends[0]), ends[1])
    share = (shipped - ends[0]) / (ends[1] - ends[0])
    middle = (1.0 - share) * p1[0] + share * p1[1]
    loop = np.eye(len(middle))
    loop[plant.nx :, plant.nx :] *= shipped
    back = np.linalg.inv(loop)
    gain_j, gain_l = loop @ gains.J, loop @ gains.L
    p3 = back.T @ gains.P3 @ back
    p3 = symmetric(p3) if gains.theorem == 2 else p3
    moved = replace(
        gains,
        J=gain_j,
        L=gain_l,
        P1=symmetric(back.T @ middle @ back),
        P3=p3,
        ends=p1,
        observer=realise_pd_observer(plant, with_faults_as_states(plant), gain_j, gain_l),
    )
    moved = _with_proofs(moved)
    return replace(moved, proved=proved and moved.proved)

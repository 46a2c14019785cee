r"""The inequalities of the certificate of a PD observer, proved with all rounding bounded.

Theorem 1 of Filasova, Krokavec, Serbak, (40)-(43) with Y = P3' J, Z = P3' L, ``D = I + L C``, ``Ae = A - J C``:

.. math::
    \mathrm{He}\left(\begin{bmatrix} A_e^T \\ -D^T \end{bmatrix} P_3 \begin{bmatrix} I & \delta I \end{bmatrix}\right)
    + \begin{bmatrix} 0 & P_1 \\ P_1 & 0 \end{bmatrix} < 0, \qquad P_1 > 0 .

If ``(Ae - s D) x = 0``, [x; s x] makes of it ``2 Re(s) x' P1 x < 0``; ``D x = 0`` contradicts the second diagonal
block.  A decay rate is the same for ``Ae + alpha D``.  Shipped are ``Az = Ae D^-1`` and ``S = D^-1``: the congruence
diag(S, S) gives it for ``Az + alpha I`` and ``I`` with ``X = P3 S`` and ``P = S' P1 S``, without an inverse, and its
lower right block proves that S is nonsingular.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

import numpy as np

from obsynth.methods.pd_observer.realisation import with_faults_as_states, with_sensor_noise
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.outward import upper_text
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.proofs.balls import Ball
from obsynth.proofs.definiteness import DefinitenessProof, prove_positive_definite
from obsynth.proofs.extended_balls import Enclosed, block
from obsynth.results.checks import Check
from obsynth.results.design import ObserverDesign
from obsynth.verification.inequalities import proof_row, prove_gain, prove_symmetric_positive

#: Claims that a certificate always makes, those on l2 gains with the names of their certificates, and those that are
#: positive.
NEEDED_CLAIMS = ("theorem", "delta", "decay")

GAIN_CLAIMS: dict[str, Literal["rate", "noise"]] = {"fault_rate_gain": "rate", "noise_gain": "noise"}

POSITIVE_CLAIMS = ("delta", "gain_bound", "fault_rate_gain", "noise_gain", "disk_radius", "adaptation_low")


def prove_shipped_stability(
    observer: LinearObserver, P1: FloatArray, P3: FloatArray, *, delta: float, decay: float
) -> DefinitenessProof:
    """Try to prove errors decay faster than ``exp(-decay t)``, with ``P1, P3 (nz, nz)``."""
    size = observer.order

    def formula(kind: type[Enclosed]) -> Enclosed:
        moving = kind.exact(observer.Az) + kind.exact(decay * np.eye(size))
        estimate = kind.exact(observer.Cz[:size])
        x = kind.exact(P3) @ estimate
        p = estimate.T @ kind.exact(P1) @ estimate
        return _inequality(moving.T @ x, x, p, delta)

    return prove_positive_definite(formula)


def prove_gains(
    A: FloatArray,
    C: FloatArray,
    J: FloatArray,
    L: FloatArray,
    P1: FloatArray,
    P3: FloatArray,
    *,
    delta: float,
    decay: float,
) -> DefinitenessProof:
    """Try to prove the inequality for gains on an augmented plant ``A (n, n)``, ``C (ny, n)``."""

    def formula(kind: type[Enclosed]) -> Enclosed:
        c, p3 = kind.exact(C), kind.exact(P3)
        ae = kind.exact(A) - kind.exact(J) @ c
        d = kind.exact(np.eye(len(A))) + kind.exact(L) @ c
        moving = ae + d.scaled(decay)
        return _inequality(moving.T @ p3, d.T @ p3, kind.exact(P1), delta)

    return prove_positive_definite(formula)


def error_inputs(plant: DescriptorSystem, J: FloatArray, L: FloatArray, kind: Literal["rate", "noise"]) -> Ball:
    """Return B ``(nx + nf, *)`` of f', or of ``[w; w']``, in ``eps' = Az eps + B v``; ``J, L (nx + nf, ny)``."""
    if kind == "rate":
        return Ball.exact(np.vstack([np.zeros((plant.nx, plant.nf)), np.eye(plant.nf)]))
    process = Ball.exact(np.vstack([plant.Bw, np.zeros((plant.nf, plant.nw))]))
    sensor = Ball.exact(plant.Dw)
    return block([[process - Ball.exact(J) @ sensor, -(Ball.exact(L) @ sensor)]])


def _inequality(moving: Enclosed, still: Enclosed, p: Enclosed, delta: float) -> Enclosed:
    """Return minus the inequality for a pencil ``M - s T``, from ``moving = M' X`` and ``still = T' X``."""
    lower = p - still + moving.T.scaled(delta)
    return block([[-(moving + moving.T), -lower.T], [-lower, (still + still.T).scaled(delta)]])


def stacked_gains(design: ObserverDesign) -> tuple[FloatArray, FloatArray]:
    """Return the gains in the loop, ``[J; G M]`` and ``[L; G N]``."""
    gains = design.gains
    g = gains.get("G", np.eye(design.linear[0].nf))
    return np.vstack([gains["J"], g @ gains["M"]]), np.vstack([gains["L"], g @ gains["N"]])


def fitting_claims(design: ObserverDesign) -> bool:
    """Whether gains, matrices and claims are there, finite and of the right shapes."""
    plant, claims = design.linear[0], design.certificate.claims
    n = plant.nx + plant.nf
    gains = {"J": (plant.nx, plant.ny), "L": (plant.nx, plant.ny), "M": (plant.nf, plant.ny), "N": (plant.nf, plant.ny)}
    if "G" in design.gains:
        gains["G"] = (plant.nf, plant.nf)
    matrices = {"P1": (n, n), "P3": (n, n)}
    matrices |= {f"P_{kind}": (n, n) for claim, kind in GAIN_CLAIMS.items() if claim in claims}
    if "adaptation_low" in claims:
        matrices |= {"P1_low": (n, n), "P1_high": (n, n)}
    numbers = all(np.isfinite(value) for value in claims.values())
    return bool(
        set(NEEDED_CLAIMS) <= set(claims)
        and numbers
        and claims["theorem"] in (1.0, 2.0)
        and claims["decay"] >= 0.0
        and all(claims[name] > 0.0 for name in POSITIVE_CLAIMS if name in claims)
        and ("adaptation_low" in claims) == ("adaptation_high" in claims)
        and ("disk_centre" in claims) == ("disk_radius" in claims)
        and set(design.gains) == set(gains)
        and all(_has_shape(design.gains[name], shape) for name, shape in gains.items())
        and all(_has_shape(design.certificate.matrices.get(name), shape) for name, shape in matrices.items())
    )


def _has_shape(matrix: FloatArray | None, shape: tuple[int, int]) -> bool:
    return matrix is not None and matrix.shape == shape and bool(np.all(np.isfinite(matrix)))


def proof_rows(design: ObserverDesign) -> Iterator[Check]:
    """Yield the rows that prove the inequalities of the theorem for what is shipped."""
    matrices, claims = design.certificate.matrices, design.certificate.claims
    p1, p3, delta, decay = matrices["P1"], matrices["P3"], claims["delta"], claims["decay"]
    theorem = int(claims["theorem"])
    labels = ("(40)", "(41)") if theorem == 1 else ("(61)", "(62)")
    yield _proof("P1", "P1 is symmetric and positive definite", prove_symmetric_positive(p1), labels[0])
    if theorem == 2:
        yield _proof("Q", "Q = P3 is symmetric and positive definite", prove_symmetric_positive(p3), labels[0])
    proof = prove_shipped_stability(design.linear[1], p1, p3, delta=delta, decay=decay)
    rate = f"errors decay faster than exp(-{decay:.6g} t)" if decay > 0.0 else "the observer is stable"
    yield _proof(
        "LMI", f"Theorem {theorem} holds for the shipped realisation (delta = {delta:.6g} s): {rate}", proof, labels[1]
    )
    for claim, kind in GAIN_CLAIMS.items():
        if claim in claims:
            yield _gain_row(design, kind, claims[claim])
    if "adaptation_low" in claims:
        yield _range_row(design)


def _gain_row(design: ObserverDesign, kind: Literal["rate", "noise"], gain: float) -> Check:
    plant, observer = design.linear
    inputs = error_inputs(with_sensor_noise(plant), *stacked_gains(design), kind)
    proof = prove_gain(
        observer.Az, inputs, observer.Cz[observer.fault_rows], design.certificate.matrices[f"P_{kind}"], gain
    )
    source = {"rate": "the rate of the faults", "noise": "noise and its derivative, as free inputs,"}[kind]
    claim = f"l2 gain from {source} to the fault error < {upper_text(gain, 6)}"
    return proof_row(f"LMI, {kind}", claim, proof, "ours: bounded real lemma")


def _proof(name: str, claim: str, proof: DefinitenessProof, label: str) -> Check:
    return proof_row(name, claim, proof, f"Filasova et al., eq. {label}")


def _range_row(design: ObserverDesign) -> Check:
    """Prove the inequality at both ends of the range of g in G = g I; between them it is an average of the two."""
    plant, matrices, claims = design.linear[0], design.certificate.matrices, design.certificate.claims
    gains = design.gains
    gain_j, gain_l = np.vstack([gains["J"], gains["M"]]), np.vstack([gains["L"], gains["N"]])
    loop = np.eye(plant.nx + plant.nf)
    loop[plant.nx :, plant.nx :] = gains.get("G", np.eye(plant.nf))
    p3 = loop.T @ matrices["P3"] @ loop
    proofs = []
    for name in ("low", "high"):
        p1 = matrices[f"P1_{name}"]
        end = with_faults_as_states(plant, claims[f"adaptation_{name}"] * np.eye(plant.nf))
        proofs.append(prove_symmetric_positive(p1))
        proofs.append(prove_gains(end.A, end.C, gain_j, gain_l, p1, p3, delta=claims["delta"], decay=claims["decay"]))
    worst = min(proofs, key=lambda proof: (proof.proved, proof.lower_bound))
    low, high = claims["adaptation_low"], claims["adaptation_high"]
    claim = f"stable for every G = g I with g from {low:.6g} to {high:.6g}"
    return proof_row("adaptation range", claim, worst, "ours: the theorem at both ends, with common P3")

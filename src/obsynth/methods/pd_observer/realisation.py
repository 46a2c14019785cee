"""The derivative-free realisation of a PD observer, its gains, and its error system.

Filasova, Krokavec, Serbak, eqs. (29)-(32), with feedthrough, ``C_o = [C Df]``.  With ``T = I + L C``, ``S = T^-1 L``,
``K = J + (A - J C) S`` and the augmented ``A, B, C, D``, the state ``nu = T xi - L (y - D u)`` has no derivative:

    nu' = (A - K C) nu + B u + K (y - D u),   xi = nu + S (y - D u - C nu)

Any K and S with ``I - S C`` nonsingular come from gains: ``L = (I - S C)^-1 S``, ``J = K - (A - K C) L``.  With
``eps = [x; f] - nu`` and the estimates ``S nu + T (y - D u)``, ``S + T C = I``, no derivative of the noise is left:

    eps' = Az eps + [0; I] f' + (Bd - By Dd) d + (Bw - By Dw) w,   error = S eps - T (Dd d + Dw w)

A certificate of Theorem 1 for gains in hand, without a solver.

A solution P1, P3 exists for every delta > 0 (elimination lemma): P1 from a Lyapunov equation, and in coordinates in
which the factors around P3 are unit columns, P3 cancels its off-diagonal block.

PD observers whose gains are given; and the gain G of the loop, checked.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from obsynth.analysis.conditions import require_all
from obsynth.errors import SpecError
from obsynth.methods.method import Synthesis
from obsynth.methods.pd_observer.conditions import explicit_form, pd_observer_conditions
from obsynth.numerics.arguments import FloatArray, as_matrix, largest_singular_value, require_shape
from obsynth.numerics.continuous import ContinuousNorms
from obsynth.numerics.matrix_equations import continuous_lyapunov, continuous_solution
from obsynth.numerics.norms import HinfNorm
from obsynth.numerics.ranks import decide_rank
from obsynth.numerics.scaling import balanced_matrix
from obsynth.numerics.spectra import abscissa
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.proofs.balls import Ball
from obsynth.results.design import Certificate
from obsynth.verification.claims import prove_gain
from obsynth.verification.error_system import ErrorModel


def realise_pd_observer(
    plant: DescriptorSystem, augmented: DescriptorSystem, J: FloatArray, L: FloatArray
) -> LinearObserver:
    """Return the observer with gains ``J, L (nx + nf, ny)`` of the augmented plant; ``I + L C`` is nonsingular."""
    n, a, c, d = augmented.nx, augmented.A, augmented.C, augmented.D
    correction = np.linalg.solve(np.eye(n) + L @ c, L)
    gain = J + (a - J @ c) @ correction
    estimate = np.eye(n) - correction @ c
    return LinearObserver(
        Az=a - gain @ c,
        Bu=augmented.B - gain @ d,
        By=gain,
        # The residual is y less what the estimates say about it.
        Cz=np.vstack([estimate, -c @ estimate]),
        Dy=np.vstack([correction, np.eye(plant.ny) - c @ correction]),
        Du=np.vstack([-correction @ d, -d + c @ correction @ d]),
        dt=0.0,
        input_names=plant.input_names,
        output_names=plant.output_names,
        state_names=plant.state_names,
        fault_names=plant.fault_names,
        residual_names=plant.output_names,
        state_delays=(0,) * plant.nx,
        fault_delays=(0,) * plant.nf,
    )


def with_faults_as_states(plant: DescriptorSystem, gain: FloatArray | None = None) -> DescriptorSystem:
    """Return the plant with state ``[x; phi]``, f = G phi, ``gain (nf, nf)``, driven by the rate ``phi' = v``."""
    nx, nf = plant.nx, plant.nf
    g = np.eye(nf) if gain is None else gain
    a = np.zeros((nx + nf, nx + nf))
    a[:nx, :nx], a[:nx, nx:] = plant.A, plant.Bf @ g
    b, bd, bw = (np.vstack([part, np.zeros((nf, part.shape[1]))]) for part in (plant.B, plant.Bd, plant.Bw))
    states = [*(f"state:{name}" for name in plant.state_names), *(f"fault:{name}" for name in plant.fault_names)]
    return DescriptorSystem(
        None,
        a,
        b,
        np.hstack([plant.C, plant.Df @ g]),
        Bf=np.eye(nx + nf)[:, nx:],
        Bd=bd,
        Bw=bw,
        D=plant.D,
        Dd=plant.Dd,
        Dw=plant.Dw,
        state_names=states,
        input_names=plant.input_names,
        output_names=plant.output_names,
        fault_names=[f"rate:{name}" for name in plant.fault_names],
    )


def with_sensor_noise(plant: DescriptorSystem) -> DescriptorSystem:
    """Return the plant itself where it states noise, else the plant with unit noise on every output."""
    if plant.nw:
        return plant
    return plant.replace(Bw=np.zeros((plant.nx, plant.ny)), Dw=np.eye(plant.ny), noise_names=None)


@dataclass(frozen=True, eq=False)
class PdErrorSystem:
    """The error system of a shipped PD observer; f', d and w by input matrix and feedthrough to the error."""

    Az: FloatArray  # (n, n), n = nx + nf
    estimate: FloatArray  # (nx + nf, n): error = ``estimate eps``
    rate: tuple[FloatArray, FloatArray]  # (n, *), (nx + nf, *)
    disturbance: tuple[FloatArray, FloatArray]
    noise: tuple[FloatArray, FloatArray]
    J: FloatArray  # (n, ny), recovered from the realisation, as L
    L: FloatArray
    nx: int

    @classmethod
    def of(cls, augmented: DescriptorSystem, observer: LinearObserver, nx: int) -> PdErrorSystem:
        """Return the error system of ``observer`` on a plant with its faults as states."""
        n = augmented.nx
        rows = slice(0, n)
        direct = observer.Dy[rows]
        errors = ErrorModel(augmented, observer, np.eye(n))
        gain_l = solved(observer.Cz[rows], direct)
        return cls(
            observer.Az,
            observer.Cz[rows],
            (errors.fault, -direct @ augmented.Df),
            (errors.disturbance, -direct @ augmented.Dd),
            (errors.noise, -direct @ augmented.Dw),
            observer.By - observer.Az @ gain_l,
            gain_l,
            nx,
        )

    @cached_property
    def _norms(self) -> ContinuousNorms:
        return ContinuousNorms(self.Az)

    def fault_norm(self, driven: tuple[FloatArray, FloatArray]) -> HinfNorm:
        """Return the H-infinity norm to the fault error from one of ``rate``, ``disturbance``, ``noise``."""
        return self._norms.between(driven[0], self.estimate[self.nx :], driven[1][self.nx :])

    def state_norm(self, driven: tuple[FloatArray, FloatArray]) -> HinfNorm:
        """Return the same to the error of the state estimate."""
        return self._norms.between(driven[0], self.estimate[: self.nx], driven[1][: self.nx])

    def separate_noise_norm(self, process: FloatArray, sensor: FloatArray) -> HinfNorm:
        """Return the H-infinity norm from ``[w; w']``, both free, with ``process (nx, nw)`` and ``sensor (ny, nw)``."""
        n = len(self.Az)
        padded = np.vstack([process, np.zeros((n - self.nx, process.shape[1]))])
        # (I + L C) e' = Ae e + Bw w - J Dw w - L Dw w', and eps = (I + L C) e.
        b = np.hstack([padded - self.J @ sensor, -self.L @ sensor])
        # The estimate is S of eps + L noise: in terms of the error itself no feedthrough is left.
        shown = self.estimate[self.nx :]
        return self._norms.between(b, shown, np.zeros((len(shown), b.shape[1])))


def solved(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """Return ``matrix^-1 right``; NaN when the matrix is singular."""
    try:
        return np.asarray(np.linalg.solve(matrix, right))
    except np.linalg.LinAlgError:
        return np.full_like(right, np.nan)


#: delta is moved by this factor when -1/delta is close to an eigenvalue, where the construction breaks down.
DELTA_STEP = 1.7
#: Condition number of the change of coordinates that is good enough.
GOOD_CONDITION = 1e3
#: As many values of delta are tried.
DELTA_TRIES = 12
#: Slack of the Riccati equation relative to the output weight, largest first: the first that proves is taken.
PD_SLACKS = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8)


def explicit_certificate(
    Az: FloatArray, estimate: FloatArray, *, decay: float
) -> tuple[FloatArray, FloatArray, float] | None:
    """Return P1, P3 ``(n, n)`` and delta for a shipped observer; ``None`` when its errors do not decay so fast."""
    moving = Az + decay * np.eye(len(Az))
    if not abscissa(moving, 0.0) < 0.0:
        return None
    balanced, units = balanced_matrix(moving)
    try:
        p = _gram(balanced)
        # A delta for which -1 / delta is far from the eigenvalues.
        one = np.eye(len(balanced))
        middle = 1.0 / float(np.exp(np.mean(np.log(np.abs(np.linalg.eigvals(balanced))))))
        steps = sorted(range(-DELTA_TRIES // 2, DELTA_TRIES // 2), key=abs)
        candidates = [middle * DELTA_STEP**step for step in steps]
        conditions = [float(np.linalg.cond(one + delta * balanced)) for delta in candidates]
        good = [i for i, condition in enumerate(conditions) if condition <= GOOD_CONDITION]
        delta = candidates[good[0] if good else int(np.argmin(conditions))]
        x = _coupling(balanced, p, delta)
        inverse = np.linalg.inv(estimate)
    except np.linalg.LinAlgError:
        return None
    p1 = inverse.T @ (p / units[:, None] / units) @ inverse
    return 0.5 * (p1 + p1.T), (x / units[:, None] / units) @ inverse, delta


def symmetric_certificate(Az: FloatArray) -> tuple[FloatArray, FloatArray, float] | None:
    """Return a certificate of Theorem 2 in closed form for ``Az (n, n)`` and L = 0; ``None`` when errors do not decay.

    It is a symmetric P3 and a weight, both positive definite: ``A' P3 + P3 A = -weight``, and ``P3 + (delta / 2)
    weight`` is P1 for every delta below a limit, infinite where it always serves.
    """
    from scipy.linalg import eigvalsh

    if not abscissa(Az, 0.0) < 0.0:
        return None
    balanced, units = balanced_matrix(Az)
    try:
        p = _gram(balanced)
        through = p @ balanced
        weight, skew = -(through + through.T), 0.5 * (through - through.T)
        largest = float(eigvalsh(skew.T @ np.linalg.solve(p, skew), weight)[-1])
    except np.linalg.LinAlgError:
        return None
    # With P1 = P3 + (delta / 2) weight the lower left block is delta times S, the skew part of P3 A: it holds when
    # weight > (delta / 2) S' P3^-1 S.
    limit = 2.0 / largest if largest > 0.0 else np.inf
    return p / units[:, None] / units, weight / units[:, None] / units, limit


def coupled_certificate(a: FloatArray, delta: float) -> tuple[FloatArray, FloatArray]:
    """Return P1 and P3 ``(n, n)`` of Theorem 1 for a stable observer, L = 0; noise where ``-1 / delta`` is a pole."""
    balanced, units = balanced_matrix(a)
    p = _gram(balanced)
    x = _coupling(balanced, p, delta)
    return p / units[:, None] / units, x / units[:, None] / units


def gain_certificate(a: FloatArray, b: Ball, c: FloatArray, gain: float) -> FloatArray | None:
    """Return P ``(n, n)`` that proves the l2 gain of ``x' = a x + b v``, ``z = c x`` below ``gain``, or ``None``."""
    balanced, units = balanced_matrix(a)
    entering, shown = b.midpoint / units[:, None], c * units
    weight = max(largest_singular_value(shown) ** 2, np.finfo(np.float64).tiny)
    spare = None
    for slack in PD_SLACKS:  # the largest that gives a proof
        out = shown.T @ shown + slack * weight * np.eye(len(a))
        p = continuous_solution(balanced.T, entering.T, out, -(gain**2) * np.eye(entering.shape[1]))
        if p is None:
            continue
        found = 0.5 * (p + p.T) / units[:, None] / units
        found = np.asarray(0.5 * (found + found.T))
        if not np.all(np.isfinite(found)):
            continue
        proof = prove_gain(a, b, c, found, gain)
        if proof.in_double_precision:
            return found
        spare = found if proof.proved and spare is None else spare
    return spare


def _gram(a: FloatArray) -> FloatArray:
    """Return P with ``a' P + P a = -norm(a) I`` for a stable ``a (n, n)``."""

    with warnings.catch_warnings(action="ignore"):
        # "An eigenvalue pair whose sum is very close to zero": what comes of it is proved or thrown away.
        p = continuous_lyapunov(a.T, -np.linalg.norm(a) * np.eye(len(a)))
    return np.asarray(0.5 * (p + p.T))


def _coupling(a: FloatArray, p: FloatArray, delta: float) -> FloatArray:
    """Return X with ``He([a'; -I] X [I, delta I]) + [0, p; p, 0] < 0`` for a stable ``a`` with Gram matrix p."""
    # With alpha = a xi1 - xi2, beta = xi1 + delta xi2 the first term is 2 alpha' X beta; the second is negative on
    # alpha = 0 and on beta = 0, whatever delta is.
    n, one = len(a), np.eye(len(a))
    change = np.linalg.inv(np.block([[a, -one], [one, delta * one]]))
    form = change.T @ np.block([[np.zeros((n, n)), p], [p, np.zeros((n, n))]]) @ change
    return np.asarray(-form[:n, n:])


def checked_adaptation_gain(value: Any, nf: int) -> FloatArray:
    """Return G as a matrix ``(nf, nf)``; raise `SpecError` when it has another shape or is singular."""
    matrix = as_matrix(value, "adaptation_gain")
    if matrix.shape == (1, 1) and nf != 1:
        matrix = float(matrix[0, 0]) * np.eye(nf)
    if matrix.shape != (nf, nf) or not decide_rank(matrix, expected=nf).full:
        raise SpecError(
            f"adaptation_gain is {matrix.shape[0]} by {matrix.shape[1]}: give a nonsingular matrix {nf} by {nf}, or "
            "one number.",
            path="method.options.adaptation_gain",
        )
    return matrix


def synthesis_from_gains(
    plant: DescriptorSystem, *, gains: Mapping[str, Any], adaptation_gain: Any, decay: float
) -> Synthesis:
    """Return the realisation and certificate of given gains; see `obsynth.design_from_gains`."""
    require_all(pd_observer_conditions(plant))
    form = explicit_form(plant)
    work = plant if form is None else form.plant
    matrices = {name: as_matrix(value, name) for name, value in gains.items()}
    for name, rows in (("J", work.nx), ("L", work.nx), ("M", work.nf), ("N", work.nf)):
        require_shape(matrices[name].shape, (rows, work.ny), name)
    if not (np.isfinite(decay) and decay >= 0.0):
        raise SpecError(f"decay is {decay}: give 0 or a positive number in 1/seconds.", path="decay")
    g = None if adaptation_gain is None else checked_adaptation_gain(adaptation_gain, work.nf)
    inner = np.eye(work.nf) if g is None else g
    pairs = (("J", "M"), ("L", "N"))
    gain_j, gain_l = (np.vstack([matrices[top], inner @ matrices[bottom]]) for top, bottom in pairs)
    observer = _realised(work, gain_j, gain_l)
    found = explicit_certificate(observer.Az, observer.Cz[: observer.order], decay=decay)
    if found is None:  # not stable, or too slow: the report will say so
        found = np.eye(observer.order), np.eye(observer.order), 1.0
    return Synthesis(
        {"from_gains": True, "decay": decay},
        matrices if g is None else {**matrices, "G": g},
        observer,
        Certificate({"P1": found[0], "P3": found[1]}, {"theorem": 1.0, "delta": found[2], "decay": float(decay)}),
        {"runs": []},
        transformation=form,
    )


def _realised(plant: DescriptorSystem, gain_j: FloatArray, gain_l: FloatArray) -> LinearObserver:
    augmented = with_faults_as_states(plant)
    if not np.linalg.cond(np.eye(augmented.nx) + gain_l @ augmented.C) < 1.0 / np.finfo(np.float64).eps:
        raise SpecError(
            "I + L C is singular with these gains: the observer's equations do not determine its estimates.", path="L"
        )
    return realise_pd_observer(plant, augmented, gain_j, gain_l)

"""The convex problem behind Theorem 2 of Wang et al. 2015: the design of an output injection and a residual weight."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from obsynth.analysis.existence.restricted_equivalent import PreparedPlant
from obsynth.errors import InfeasibleError, SpecError
from obsynth.numerics.arguments import require_shape
from obsynth.numerics.arrays import FloatArray, identity_missed
from obsynth.numerics.injection_problem import GainProblem, Injection, WeightLimit, null_basis
from obsynth.numerics.outward import upper_text
from obsynth.numerics.ranks import RANK_TOLERANCE

#: Fictitious measurement noise, relative to the given noise: with it every direction of the gains has a cost.
BACKGROUND_NOISE = 1e-3


@dataclass(frozen=True, eq=False)
class GainParts:
    """Fixed parts of the gains in balanced coordinates: ``L = L0 + R V'`` and ``W = W0 + Vw V'`` with free R and Vw."""

    L0: FloatArray
    W0: FloatArray
    V: FloatArray


def gain_problem(prepared: PreparedPlant, *, free_weight: bool) -> tuple[GainProblem, GainParts]:
    """Return the convex problem behind Theorem 2 and the fixed parts of the gains, which solve (32) exactly."""
    detectability = prepared.detectability
    upsilon = detectability.Upsilon
    w0, v = _left_inverse(upsilon), null_basis(upsilon.T)
    l0 = prepared.TA @ detectability.Psi @ w0
    measure, na = v.T, prepared.TA.shape[0]
    if prepared.Bw.shape[1]:
        size = BACKGROUND_NOISE * max(
            float(np.linalg.norm(measure @ prepared.Dw)),
            # In units of the outputs: W may be large.
            float(np.linalg.norm(w0 @ prepared.Dw) / np.linalg.norm(w0)),
        )
        background = size if size > 0.0 else BACKGROUND_NOISE
        bn = np.hstack([prepared.Bw - l0 @ prepared.Dw, np.zeros((na, v.shape[1]))])
        dn = np.hstack([measure @ prepared.Dw, -background * np.eye(v.shape[1])])
        zn = np.hstack([w0 @ prepared.Dw, np.zeros((w0.shape[0], v.shape[1]))])
    else:
        # Unit noise on the free measurements makes the variance the squared norm of R (and Vw).
        bn, dn, zn = np.zeros((na, v.shape[1])), -np.eye(v.shape[1]), np.zeros((w0.shape[0], v.shape[1]))
    problem = GainProblem(
        A=prepared.TA - l0 @ prepared.C,
        C=measure @ prepared.C,
        Z=w0 @ prepared.C,
        B=prepared.Bd - l0 @ prepared.Dd,
        D=measure @ prepared.Dd,
        Zd=w0 @ prepared.Dd,
        Bn=bn,
        Dn=dn,
        Zn=zn,
        free_weight=free_weight,
    )
    return problem, GainParts(l0, w0, v)


def _left_inverse(upsilon: FloatArray) -> FloatArray:
    """Return the left inverse of least norm of a matrix of full column rank, computed in balanced units of the faults.

    The units are powers of two, so that a fault in other units changes the rows by exact factors.
    """
    units = np.exp2(np.round(np.log2(np.linalg.norm(upsilon, axis=0))))
    return np.asarray(np.linalg.pinv(upsilon / units) / units[:, None])


def gains_in_given_units(prepared: PreparedPlant, parts: GainParts, chosen: Injection) -> dict[str, FloatArray]:
    """Return the gains in the coordinates of the plant; the scaling is by powers of two and therefore exact."""
    states, equations, outputs = (
        prepared.scaling.states[:, None],
        prepared.scaling.equations,
        prepared.scaling.outputs,
    )
    free = chosen.R @ parts.V.T
    return {
        "T": states * prepared.T * equations,
        "N": states * prepared.N * outputs,
        "L": states * (parts.L0 + free) * outputs,
        "W": (parts.W0 + chosen.V @ parts.V.T) * outputs,
        "Psi": states * prepared.detectability.Psi,
        "Upsilon": prepared.detectability.Upsilon / outputs[:, None],
        "R": states * free * outputs,
    }


def left_inverse_near(weight: FloatArray, upsilon: FloatArray, path: str) -> FloatArray:
    """Return the left inverse of Upsilon nearest to a given one that has lost its last digits.

    Raises
    ------
    SpecError
        The weight has another shape, or ``W Upsilon`` is not the identity.
    """
    require_shape(weight.shape, upsilon.T.shape, path)
    product = weight @ upsilon
    share = identity_missed(product, np.abs(weight) @ np.abs(upsilon))
    if not share <= RANK_TOLERANCE:
        raise SpecError(
            f"{path}: W Upsilon misses the identity by {share:.3g}: give a left inverse of Upsilon in all its digits. "
            f"With the T of this design Upsilon is {np.round(upsilon, 6).tolist()}.",
            path=path,
        )
    return np.asarray(weight + (np.eye(len(product)) - product) @ _left_inverse(upsilon))


def centred(
    problem: GainProblem, prepared: PreparedPlant, parts: GainParts, *, weight: FloatArray | None = None
) -> tuple[GainProblem, GainParts]:
    """Return the problem with its weight measured from a given W: Vw = 0 means this W.

    Without ``weight``, W is the left inverse of least norm in the units of the plant's outputs, not in balanced ones.
    """
    outputs = prepared.scaling.outputs
    upsilon = prepared.detectability.Upsilon / outputs[:, None]
    own = _left_inverse(upsilon) if weight is None else left_inverse_near(weight, upsilon, "method.options.weight")
    w0 = own / outputs
    v = (w0 - parts.W0) @ parts.V
    moved = replace(problem, Z=problem.Z + v @ problem.C, Zd=problem.Zd + v @ problem.D, Zn=problem.Zn + v @ problem.Dn)
    return moved, replace(parts, W0=w0)


def with_output_noise(problem: GainProblem, parts: GainParts) -> GainProblem:
    """Return the problem whose second stage minimises the effect of unit noise on every output, in balanced units."""
    return replace(problem, Bn=-parts.L0, Dn=parts.V.T, Zn=parts.W0)


def with_weight_limit(problem: GainProblem, prepared: PreparedPlant, parts: GainParts, bound: float) -> GainProblem:
    """Return the problem with a bound on the norm of W in the units of the plant's outputs."""
    outputs = prepared.scaling.outputs
    smallest = 1.0 / float(np.linalg.svd(prepared.detectability.Upsilon / outputs[:, None], compute_uv=False)[-1])
    if smallest >= bound:
        raise InfeasibleError(
            f"No residual weight W with W Upsilon = I has a norm of {bound:.6g} or less: the least is "
            f"{upper_text(smallest, 6)}. Raise residual_weight_limit.",
            necessary=True,
            lower_bound=smallest,
        )
    return replace(problem, weight_limit=WeightLimit(parts.W0 * outputs, parts.V.T * outputs, bound))

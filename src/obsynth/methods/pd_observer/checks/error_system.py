r"""The error of a PD observer and what drives it, from the plant and the shipped realisation.

With ``eps = [x; f] - nu`` and the estimates ``S nu + T (y - D u)``, ``S + T C = I``:

    eps' = Az eps + [0; I] f' + (Bd - By Dd) d + (Bw - By Dw) w,   error = S eps - T (Dd d + Dw w)

No derivative of the noise is left in it: this is the whole transfer, high frequencies included.

What a PD observer makes of faults that move, of noise and of disturbances, and how large its gains are.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from obsynth.methods.pd_observer.realisation import with_sensor_noise
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.continuous import ContinuousHinfNorm, continuous_hinf_norm
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.results.checks import Check, information, upper_bound_check
from obsynth.results.design import ObserverDesign
from obsynth.verification.error_system import ErrorSystem


@dataclass(frozen=True, eq=False)
class PdErrorSystem:
    """The error system of a shipped PD observer; see the module's text.

    Fields: Az: ``(n, n)``, n = nx + nf; estimate: ``(nx + nf, n)``: error = ``estimate eps``; rate, disturbance, noise:
    Input matrix ``(n, *)`` and feedthrough to the error ``(nx + nf, *)`` of f', d and w; J, L: ``(n, ny)``, recovered
    from the realisation; nx: Number of states of the plant.
    """

    Az: FloatArray
    estimate: FloatArray
    rate: tuple[FloatArray, FloatArray]
    disturbance: tuple[FloatArray, FloatArray]
    noise: tuple[FloatArray, FloatArray]
    J: FloatArray
    L: FloatArray
    nx: int

    @classmethod
    def of(cls, augmented: DescriptorSystem, observer: LinearObserver, nx: int) -> PdErrorSystem:
        """Return the error system of ``observer`` on a plant with its faults as states."""
        n = augmented.nx
        rows = slice(0, n)
        direct = observer.Dy[rows]
        errors = ErrorSystem.of(augmented, observer, np.eye(n), 0)
        gain_l = solved(observer.Cz[rows], direct)
        return cls(
            observer.Az, observer.Cz[rows],
            (errors.fault, -direct @ augmented.Df),
            (errors.disturbance, -direct @ augmented.Dd),
            (errors.noise, -direct @ augmented.Dw),
            observer.By - observer.Az @ gain_l, gain_l, nx,
        )  # fmt: skip

    def fault_norm(self, driven: tuple[FloatArray, FloatArray]) -> ContinuousHinfNorm:
        """Return the H-infinity norm to the fault error from one of ``rate``, ``disturbance``, ``noise``."""
        return continuous_hinf_norm(self.Az, driven[0], self.estimate[self.nx :], driven[1][self.nx :])

    def state_norm(self, driven: tuple[FloatArray, FloatArray]) -> ContinuousHinfNorm:
        """Return the same to the error of the state estimate."""
        return continuous_hinf_norm(self.Az, driven[0], self.estimate[: self.nx], driven[1][: self.nx])

    def separate_noise_norm(self, process: FloatArray, sensor: FloatArray) -> ContinuousHinfNorm:
        """Return the H-infinity norm to the fault error from ``[w; w']`` taken as two inputs that are free.

        ``process (nx, nw)`` and ``sensor (ny, nw)`` say where w enters.
        """
        n = len(self.Az)
        padded = np.vstack([process, np.zeros((n - self.nx, process.shape[1]))])
        # (I + L C) e' = Ae e + Bw w - J Dw w - L Dw w', and eps = (I + L C) e.
        b = np.hstack([padded - self.J @ sensor, -self.L @ sensor])
        # The estimate is S of eps + L noise: in terms of the error itself no feedthrough is left.
        inner = _similar(self.Az, self.estimate)
        shown = np.eye(n)[self.nx :]
        return continuous_hinf_norm(inner, self.estimate @ b, shown, np.zeros((len(shown), b.shape[1])))


def solved(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """Return ``matrix^-1 right``; NaN when the matrix is singular."""
    try:
        return np.asarray(np.linalg.solve(matrix, right))
    except np.linalg.LinAlgError:
        return np.full_like(right, np.nan)


def _similar(a: FloatArray, s: FloatArray) -> FloatArray:
    """Return ``s a s^-1``; NaN when s is singular."""
    return solved(s.T, (s @ a).T).T


#: Norms of ``[J L]`` above this many times the norm of A are out of proportion to the plant, and worth a warning.
LARGE_GAIN = 1e2


def norm_rows(design: ObserverDesign, errors: PdErrorSystem) -> Iterator[Check]:
    """Yield norms and gains: checks where a bound is claimed, else information."""
    plant, claims = design.linear[0], design.certificate.claims
    noisy = with_sensor_noise(plant)
    unit = "" if plant.nw else "unit noise on every output, as the plant states none"
    yield _norm_row(
        "fault rate in the fault estimate", "H-infinity norm from f' to the fault error, seconds",
        errors.fault_norm(errors.rate), claims.get("fault_rate_gain"),
    )  # fmt: skip
    yield _norm_row(
        "noise and its derivative in the fault estimate",
        "H-infinity norm from noise and its derivative, as free inputs, to the fault error",
        errors.separate_noise_norm(noisy.Bw, noisy.Dw), claims.get("noise_gain"), unit,
    )  # fmt: skip
    yield _norm_row(
        "noise in the fault estimate", "H-infinity norm from the noise to the fault error",
        errors.fault_norm(errors.noise), None, unit,
    )  # fmt: skip
    yield information(
        "fast noise in the fault estimate", "gain from the noise to the fault error at high frequencies",
        _size(errors.noise[1][plant.nx :]), source="recomputed", detail=unit,
    )  # fmt: skip
    if plant.nd:
        yield _norm_row(
            "disturbance in the fault estimate", "H-infinity norm from d to the fault error: d is not decoupled",
            errors.fault_norm(errors.disturbance), None,
        )  # fmt: skip
        yield _norm_row(
            "disturbance in the state estimate", "H-infinity norm from d to the state error",
            errors.state_norm(errors.disturbance), None,
        )  # fmt: skip
    yield from _gain_rows(design, errors)


def _norm_row(name: str, claim: str, norm: ContinuousHinfNorm, bound: float | None, note: str = "") -> Check:
    peak = f"peak at {norm.frequency:.4g} rad/s"
    detail = f"{peak}; {note}" if note else peak
    if bound is None:
        return information(name, claim, norm.upper, source="recomputed", detail=detail)
    return upper_bound_check(name, f"{claim}: at most as claimed", norm.upper, bound, source="ours", detail=detail)


def _gain_rows(design: ObserverDesign, errors: PdErrorSystem) -> Iterator[Check]:
    claims = design.certificate.claims
    gain = _size(np.hstack([errors.J, errors.L]))
    if "gain_bound" in claims:
        yield upper_bound_check(
            "gain bound", "norm of [J L], with the rows of M and N: at most as claimed", gain, claims["gain_bound"],
            source="ours",
        )  # fmt: skip
    own = max(_size(design.linear[0].A), 1.0)
    warning = (
        "WARNING: out of proportion to the plant: any error of the model or the sensors is multiplied by it. Ask for a "
        "slower decay."
        if not gain <= LARGE_GAIN * own
        else ""
    )
    yield information(
        "gain", "spectral norm of [J L], with the rows of M and N", gain, source="recomputed", detail=warning
    )


def _size(matrix: np.ndarray) -> float:
    return (
        float(np.linalg.norm(matrix, 2))
        if matrix.size and np.all(np.isfinite(matrix))
        else float(0.0 if not matrix.size else np.inf)
    )

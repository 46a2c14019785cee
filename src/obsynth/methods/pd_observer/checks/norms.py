"""What a PD observer makes of faults that move, of noise and of disturbances, and how large its gains are."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from obsynth.methods.pd_observer.augmentation import with_sensor_noise
from obsynth.methods.pd_observer.checks.error_system import PdErrorSystem
from obsynth.numerics.continuous import ContinuousHinfNorm
from obsynth.results.design import ObserverDesign
from obsynth.results.report import Check, information, upper_bound_check

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

"""What is true of a gain set, found with numpy, mpmath and fractions alone, to compare claims with.

Nothing here calls a check, a norm or a proof of obsynth: plants and observers are taken as matrices.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from fractions import Fraction

import mpmath
import numpy as np
import numpy.typing as npt

import obsynth as ob

#: Claims may exceed the truth by this share; estimates may miss what they are to show by this.
TOLERANCE = 1e-3
#: Numbers that a check finds again to 1e-6 are compared to ten times that.
FOUND_AGAIN = 1e-5
_FREQUENCIES = 240
#: Samples after which sums and integrals of stable observers are cut off: truth is then no more than underestimated.
_LAST = 4000

Matrix = npt.NDArray[np.float64]


def raised(design: ob.ObserverDesign, good: ob.ObserverDesign, report: ob.VerificationReport) -> Iterator[str]:
    """Yield what a design claims beyond the truth; ``good`` is the design before it was changed."""
    if isinstance(design.observer, ob.LinearObserver):
        yield from _of_linear(design, good, report)
    elif isinstance(design.observer, ob.RecursiveObserver):
        yield from _of_recursive(design, good)
    else:
        yield from _changed(design, good)


def _of_linear(design: ob.ObserverDesign, good: ob.ObserverDesign, report: ob.VerificationReport) -> Iterator[str]:
    plant, observer, claims = design.plant, design.observer, design.certificate.claims
    poles = _poles(observer.Az)
    rate = _rate(poles, plant.dt)
    if not rate > 0.0:
        yield f"unstable: {rate:.3g}"
        return
    for name in ("theorem", "state_lag", "order"):
        if name in claims and claims[name] != good.certificate.claims[name]:
            yield f"{name} {claims[name]!r}"
    if claims.get("decay", 0.0) > rate * (1.0 + TOLERANCE):
        yield f"decay {claims['decay']:.6g}, true {rate:.6g}"
    if "disk_radius" in claims:
        reach = max(abs(pole + claims["disk_centre"]) for pole in poles)
        if reach > claims["disk_radius"] * (1.0 + TOLERANCE):
            yield f"disk {claims['disk_radius']:.6g}, true {reach:.6g}"
    if "poles" in design.certificate.matrices:
        listed = [complex(*pair) for pair in design.certificate.matrices["poles"]]
        far = max(min(abs(pole - other) for other in listed) / abs(pole) for pole in poles)
        if far > TOLERANCE or len(listed) != len(poles):
            yield f"poles: one is {far:.2g} of its size away"
    yield from _transfers(design, good, report)
    yield from _errors_per_unit(design)


def _poles(matrix: Matrix) -> list[complex]:
    """Return eigenvalues found with 40 digits: those of observers are often multiple."""
    if not len(matrix):
        return []
    with mpmath.workdps(40):
        values = mpmath.eig(mpmath.matrix(matrix.tolist()), left=False, right=False)
        return [complex(value) for value in values]


def _rate(poles: list[complex], dt: float) -> float:
    if not poles:
        return np.inf
    if dt == 0.0:
        return -max(pole.real for pole in poles)
    radius = max(abs(pole) for pole in poles)
    return np.inf if radius == 0.0 else float(-np.log(radius) / dt)


def _points(plant: ob.DescriptorSystem, poles: list[complex]) -> npt.NDArray[np.complex128]:
    """Return points on the boundary of stability, off the poles of plants that do not forget."""
    if plant.dt > 0.0:
        return np.exp(1j * np.geomspace(1e-3, np.pi, _FREQUENCIES))
    size = max(abs(pole) for pole in poles)
    return 1j * np.geomspace(1e-3 * size, 1e3 * size, _FREQUENCIES)


def _transfer(
    plant: ob.DescriptorSystem, observer: ob.LinearObserver, B: Matrix, D: Matrix, z: complex
) -> npt.NDArray[np.complex128]:
    """Return the transfer from a signal to the fault estimates, of plant and stored observer together."""
    y = plant.C @ np.linalg.solve(z * plant.E - plant.A, B.astype(complex)) + D
    states = np.linalg.solve(z * np.eye(observer.order) - observer.Az, observer.By @ y)
    first = len(observer.state_names)
    rows = slice(first, first + len(observer.fault_names))
    return observer.Cz[rows] @ states + observer.Dy[rows] @ y


def _transfers(design: ob.ObserverDesign, good: ob.ObserverDesign, report: ob.VerificationReport) -> Iterator[str]:
    """Yield claims about gains, and estimates that show something else than the fault."""
    plant, observer, claims = design.plant, design.observer, design.certificate.claims
    points = _points(plant, _poles(observer.Az))
    own = [plant.fault_names.index(name) for name in observer.fault_names]
    seen = np.array([_transfer(plant, observer, plant.Bf, plant.Df, z) for z in points])
    leaks = np.array([_transfer(plant, observer, plant.Bd, plant.Dd, z) for z in points])
    gains = np.array([np.linalg.norm(leak, 2) if leak.size else 0.0 for leak in leaks])
    if "gamma" in claims and gains.max() > claims["gamma"] * (1.0 + TOLERANCE):
        yield f"gamma {claims['gamma']:.6g}, at least {gains.max():.6g}"
    least = claims.get("gamma_min", 0.0)
    if least > good.certificate.claims.get("gamma_min", 0.0) * (1.0 + TOLERANCE):
        row = next(row for row in report.checks if row.name == "least gain")
        if row.status != "assumed":
            yield f"gamma_min {least:.6g} is {row.status}"
    if design.method in ("ui-pi-observer", "functional-filter") and gains.max() > TOLERANCE:
        yield f"an unknown input leaks by {gains.max():.3g}"
    if design.method == "fault-estimation-filter":
        wanted = np.array([np.diag([z**-delay for delay in observer.fault_delays]) for z in points])
        missed = np.abs(seen[:, :, own] - wanted).max()
        if missed > TOLERANCE:
            yield f"a fault estimate misses its fault by {missed:.3g}"
    if "fault_rate_gain" in claims or "noise_gain" in claims:
        one = np.eye(len(own), plant.nf)
        rates = [np.linalg.norm((found - one) / z, 2) for found, z in zip(seen, points, strict=True)]
        if max(rates) > claims.get("fault_rate_gain", np.inf) * (1.0 + TOLERANCE):
            yield f"fault_rate_gain {claims['fault_rate_gain']:.6g}, at least {max(rates):.6g}"
        noise = np.zeros((plant.nx, plant.ny))
        for_outputs = [_transfer(plant, observer, noise, np.eye(plant.ny), z) for z in points]
        sizes = [np.linalg.norm(found, 2) / np.hypot(1.0, abs(z)) for found, z in zip(for_outputs, points, strict=True)]
        if max(sizes) > claims.get("noise_gain", np.inf) * (1.0 + TOLERANCE):
            yield f"noise_gain {claims['noise_gain']:.6g}, at least {max(sizes):.6g}"
    yield from _noise(design)


def _noise(design: ob.ObserverDesign) -> Iterator[str]:
    """Yield a claimed H2 norm below the true one."""
    observer, claimed = design.observer, design.certificate.claims.get("noise_amplification")
    if claimed is None:
        return
    first = len(observer.state_names)
    rows = observer.Cz[first : first + len(observer.fault_names)]
    count = observer.order
    if observer.dt > 0.0:
        whole = np.eye(count**2) - np.kron(observer.Az, observer.Az)
    else:
        whole = -np.kron(np.eye(count), observer.Az) - np.kron(observer.Az, np.eye(count))
    covariance = np.linalg.solve(whole, (observer.By @ observer.By.T).ravel()).reshape(count, count)
    direct = observer.Dy[first : first + len(rows)] if observer.dt > 0.0 else np.zeros((len(rows), 1))
    true = float(np.sqrt(np.max(np.diag(rows @ covariance @ rows.T) + np.sum(direct**2, axis=1))))
    if claimed < true * (1.0 - TOLERANCE):
        yield f"noise_amplification {claimed:.6g}, true {true:.6g}"


def _errors_per_unit(design: ob.ObserverDesign) -> Iterator[str]:
    """Yield bounds on the error per unit of state or input that are below what the stored numbers do."""
    from obsynth.methods.registry import method_class

    tracked = method_class(design.method).error_model(design)
    observer, certificate = design.observer, design.certificate.matrices
    e, a, b, c, d, t = (
        _exact(part) for part in (tracked.E, tracked.A, tracked.B, tracked.C, design.plant.D, tracked.T)
    )
    az, bu, by, cz, du, dy = (_exact(getattr(observer, name)) for name in ("Az", "Bu", "By", "Cz", "Du", "Dy"))
    te = t @ e
    missed = {
        "state_error": (az @ te + by @ c - t @ a, cz @ te + dy @ c - _exact(tracked.goal)),
        "input_error": (bu + by @ d - t @ b, du + dy @ d),
    }
    if tracked.T0 is not None:
        t0 = _exact(tracked.T0)
        missed = {
            "state_error": (missed["state_error"][0], missed["state_error"][1] + t0 @ a),
            "input_error": (missed["input_error"][0], missed["input_error"][1] + t0 @ b),
        }
    for name, (driven, direct) in missed.items():
        if name not in certificate:
            continue
        true = _absolute_sum(observer, driven.astype(np.float64)) + np.abs(direct.astype(np.float64))
        if np.any(true > certificate[name] * (1.0 + TOLERANCE)):
            yield f"{name} is below what the stored numbers do"


def _exact(matrix: Matrix) -> npt.NDArray[np.object_]:
    """Return a matrix of fractions."""
    found = np.empty(np.shape(matrix), dtype=object)
    for place, value in np.ndenumerate(matrix):
        found[place] = Fraction(float(value))
    return found


def _absolute_sum(observer: ob.LinearObserver, driven: Matrix) -> Matrix:
    """Return ``sum |Cz Az^j K|`` of the first steps; in continuous time the integral, from below."""
    if observer.dt > 0.0:
        step, weight, column = observer.Az, 1.0, driven
    else:
        h = 0.05 / max(abs(np.linalg.eigvals(observer.Az)))
        step, weight = np.real(_exponential(observer.Az * h)), h
        # The integral over a step, whose absolute value is no more than that of the integrand's absolute value.
        column = np.linalg.solve(observer.Az, step - np.eye(observer.order)) @ driven / h
    total, state = np.zeros((len(observer.Cz), driven.shape[1])), column
    for _ in range(_LAST):
        total += weight * np.abs(observer.Cz @ state)
        state = step @ state
        if np.max(np.abs(state), initial=0.0) < 1e-30:
            break
    return total


def _exponential(matrix: Matrix) -> Matrix:
    found = term = np.eye(len(matrix))
    for k in range(1, 20):
        term = term @ matrix / k
        found = found + term
    return found


def _of_recursive(design: ob.ObserverDesign, good: ob.ObserverDesign) -> Iterator[str]:
    """Yield claims that are not those of a covariance filter run on the plant as it stands in the changed gain set."""
    plant, claims = design.plant, design.certificate.claims
    steps = int(plant.horizon or good.certificate.claims["steps"])
    covariance = design.observer.initial_covariance
    product, conditions, logarithm = np.eye(plant.nx), [], 0.0
    gain = np.zeros((plant.nx, plant.ne + plant.ny))
    for k in range(steps):
        H = np.vstack([plant.E.at(k + 1), plant.C.at(k + 1)])
        A = plant.A.at(k)
        noise = np.zeros((len(H), len(H)))
        noise[: plant.ne, : plant.ne] = A @ covariance @ A.T + design.observer.Q.at(k)
        noise[plant.ne :, plant.ne :] = design.observer.R.at(k)
        weighted = np.linalg.solve(noise, H).T
        covariance = np.linalg.inv(weighted @ H)
        gain = covariance @ weighted
        conditions.append(np.linalg.cond(H))
        product = gain[:, : plant.ne] @ A @ product
        size = float(np.linalg.norm(product, 2))
        product, logarithm = product / size, logarithm + np.log(size)
    mean = float(np.exp(logarithm / steps))
    if claims["contraction"] < mean * (1.0 - FOUND_AGAIN):
        yield f"contraction {claims['contraction']:.6g}, true {mean:.6g}"
    if claims["condition"] < max(conditions) * (1.0 - FOUND_AGAIN):
        yield f"condition {claims['condition']:.6g}, true {max(conditions):.6g}"
    whole = np.hstack([design.gains["L"], design.gains["K"]])
    if np.max(np.abs(whole - gain)) > FOUND_AGAIN * np.max(np.abs(gain)):
        yield "the listed gains are not those of the last step"
    yield from _changed(design, good, ("steps", "residual_directions", "excitation", "excitation_k", "condition_k"))


def _changed(design: ob.ObserverDesign, good: ob.ObserverDesign, names: tuple[str, ...] | None = None) -> Iterator[str]:
    """Yield claims and listed gains that are not those of the design before; its checks find them again to 1e-6."""
    claims: Mapping[str, float] = good.certificate.claims
    for name, value in design.certificate.claims.items():
        if names is None or name in names:
            far = abs(value - claims.get(name, np.inf))
            if far > FOUND_AGAIN * max(abs(claims.get(name, 0.0)), FOUND_AGAIN):
                yield f"{name} {value:.6g}, was {claims.get(name)}"
    for letter, matrix in design.gains.items() if names is None else ():
        before = good.gains[letter]
        if np.max(np.abs(matrix - before)) > FOUND_AGAIN * np.max(np.abs(before)):
            yield f"listed gain {letter}"

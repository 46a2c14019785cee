"""Decoupling of a shipped observer, measured as a transfer function from the plant itself, without its tracking map.

At each frequency the trajectories ``(x, d) e^{st}`` of the plant are the null space of ``[sE - A, -Bd]``, whether the
plant is regular or not.  Through ``y = C x + Dd d`` and the realisation they give estimates, whose errors must vanish.

What an observer makes of faults that its model does not describe: fhat/f, steady errors, and what no gain can do.

For any fault, fhat = T(s) f once the initial-condition response has settled.  At a zero of (f, d) -> y outside the
region of stability T(s) f0 = 0 for every stable decoupled observer: a step is then first answered in the wrong
direction.

Checks of an unknown-input PI observer, from the plant and the shipped realisation alone.

Source of the claims: Share Pasand, Aliyari, Taghirad, eqs. (7), (19); (D1)-(D3) and the checks of numbers are ours.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from obsynth.analysis.plant_units import PlantUnits
from obsynth.analysis.zeros import is_outside, leading_names, system_pencil, system_zeros, zeros_with_directions
from obsynth.errors import SpecError
from obsynth.methods.ui_pi_observer.augmented_plant import AugmentedPlant, equilibrated, number, numbers, shipped_model
from obsynth.methods.ui_pi_observer.conditions import existence_conditions
from obsynth.numerics.arguments import ComplexArray, FloatArray, arguments_checked, largest_singular_value, real_array
from obsynth.numerics.lapack import LAPACK_BLOCK
from obsynth.numerics.modal_response import pencils_at
from obsynth.numerics.norms import balanced_realisation, response
from obsynth.numerics.ranks import NEGLIGIBLE_INPUT, RANK_TOLERANCE, numerical_rank
from obsynth.numerics.scaling import balancing_factors
from obsynth.numerics.spectra import (
    DOUBLE_DIGITS,
    PRINTED_DIGITS,
    abscissa_of,
    as_printed,
    boundary_points,
    decay_rates,
    digits_needed,
    eigenvalues,
    farthest_pole,
    mean_miss,
)
from obsynth.observers.linear.observer import LinearObserver, frequency_grid, is_stable, poles_of
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.fault_models import Exosystem, balanced_transition
from obsynth.proofs.balls import enclosed_eigenvalues, middle_of
from obsynth.proofs.products import certain_noise_covariance
from obsynth.results.checks import Check, fitting_check, information, upper_bound_check
from obsynth.results.design import ObserverDesign
from obsynth.verification.claims import (
    ALIKE,
    UNCERTAIN,
    Residual,
    decay_row,
    equality,
    fault_noise_rows,
    relative_tolerance,
    residual,
    stability_row,
    worst,
)
from obsynth.verification.error_system import ErrorModel
from obsynth.verification.plant import condition_rows, plant_information

#: Equations whose reciprocal condition is above this are independent to the tolerance of every rank.
FAR_FROM_SINGULAR = 1e3 * RANK_TOLERANCE
#: A signal below this share of what a trajectory of unit size could make of it is held not to be moved.
UNMOVED_SIGNAL = 1e-4
#: Points are taken together until their pencils have so many entries: 4 MB, of which a handful is held at once.
ENTRIES_AT_ONCE = 2**18


@dataclass(frozen=True)
class DecouplingNorm:
    """The largest gain found from the unknown inputs to the errors of the estimates."""

    relative: float  # error of an estimate over the terms it is computed from
    fault_gain: float  # error of a fault estimate for unit (x, d) in scaled units
    frequency: float  # where, rad/s

    def worse(self, found: tuple[float, float] | None, frequency: float) -> DecouplingNorm:
        """Return the larger of this and the relative error and that of a fault at a frequency; ``None`` at a pole."""
        if found is None:
            return DecouplingNorm(np.inf, np.inf, frequency) if np.isfinite(self.relative) else self
        relative, fault = found
        if not relative <= self.relative:
            return DecouplingNorm(relative, max(fault, self.fault_gain), frequency)
        return DecouplingNorm(self.relative, max(fault, self.fault_gain), self.frequency)


def decoupling_norm(plant: DescriptorSystem, observer: LinearObserver) -> DecouplingNorm:
    """Return how much of any unknown input reaches the estimates of states (if any), faults and residuals."""
    return decoupling_norms(plant, observer, [(range(len(observer.Cz)), range(plant.nd))])[0]


def decoupling_norms(
    plant: DescriptorSystem, observer: LinearObserver, groups: Sequence[tuple[Sequence[int], Sequence[int]]]
) -> list[DecouplingNorm]:
    """Return, for each group of rows and unknown inputs, how much of the inputs reaches those rows.

    The trajectories of all inputs are found once at each frequency: those of some are the combinations without the
    others.
    """
    if not all(np.all(np.isfinite(part)) for part in (observer.Az, observer.By, observer.Cz, observer.Dy)):
        return [DecouplingNorm(float("nan"), float("nan"), float("nan"))] * len(groups)
    frequencies = frequency_grid(observer)
    units = PlantUnits.of(plant).rounded()
    scaled = units.scaled_plant(plant)
    points = boundary_points(frequencies * (1.0 if units.discrete else units.time), scaled.dt)
    moved = trajectories_of(scaled, points, [inputs for _, inputs in groups])
    # How many trajectories there are at almost every frequency: where there seem to be more, rounding hides the rest.
    counts = [min(basis.shape[1] for basis in bases) for bases in moved]
    found = [DecouplingNorm(0.0, 0.0, 0.0) for _ in groups]
    for some in _parts(points, max(scaled.nx + scaled.nd, observer.order)):
        passing = _Passing.of(observer, units, points[some])
        for place, (rows, inputs) in enumerate(groups):
            if counts[place] == 0:
                continue
            bases = np.stack([basis[:, -counts[place] :] for basis in moved[place][some]])
            for frequency, missed in zip(frequencies[some], passing.misses(scaled, bases, rows, inputs), strict=True):
                found[place] = found[place].worse(missed, float(frequency))
    return found


def _parts(points: ComplexArray, order: int) -> list[slice]:
    """Return the points in parts whose matrices of an order fit into the room for them."""
    size = max(1, ENTRIES_AT_ONCE // max(1, order**2))
    return [slice(start, start + size) for start in range(0, len(points), size)]


def trajectories_of(
    plant: DescriptorSystem, points: ComplexArray, groups: Sequence[Sequence[int]]
) -> list[list[ComplexArray]]:
    """Return, for each group of unknown inputs, trajectories ``(nx + inputs, count)`` at each point, of unit norm."""
    found: list[list[ComplexArray]] = [[] for _ in groups]
    for some in _parts(points, plant.nx + plant.nd):
        none = np.zeros_like(plant.Bd)
        pencils = pencils_at(np.hstack([plant.E, none]), np.hstack([plant.A, plant.Bd]), points[some])
        whole, columns, sure = _null_spaces(pencils)
        for bases, inputs in zip(found, groups, strict=True):
            own = [*range(plant.nx), *(plant.nx + np.array(inputs, dtype=np.intp))]
            bases += _of_some(pencils, own, whole, columns, sure)
    return found


def _of_some(
    pencils: ComplexArray, own: Sequence[int], whole: list[ComplexArray], columns: FloatArray, sure: NDArray[np.bool_]
) -> list[ComplexArray]:
    """Return the part of null spaces that is zero outside some columns: combinations without the others."""
    others = np.setdiff1d(np.arange(pencils.shape[2]), own)
    if not len(others):
        return _of_unit_norm(whole, columns)
    found: list[ComplexArray | None] = [None] * len(whole)
    if sure.any():
        places = np.flatnonzero(sure)
        sure_bases = np.stack([whole[place] for place in places])
        _, values, right = np.linalg.svd(sure_bases[:, others])
        # Independent as they are, the others can be left out; or the null space is looked for by itself.
        left_out = (
            values[:, -1] > FAR_FROM_SINGULAR if 0 < values.shape[1] == len(others) else np.zeros(len(places), bool)
        )
        kept = np.conj(np.swapaxes(right[left_out, len(others) :], 1, 2))
        combined = (sure_bases[left_out] @ kept)[:, own]
        for place, basis in zip(
            places[left_out], _of_unit_norm([*combined], columns[places[left_out]][:, own]), strict=True
        ):
            found[place] = basis
    rest = [place for place, basis in enumerate(found) if basis is None]
    if rest:
        bases, scales, _ = _null_spaces(pencils[rest][:, :, own])
        for place, basis in zip(rest, _of_unit_norm(bases, scales), strict=True):
            found[place] = basis
    return [basis for basis in found if basis is not None]


def _of_unit_norm(bases: Sequence[ComplexArray], scales: FloatArray) -> list[ComplexArray]:
    """Return bases ``(n, count)`` with rows times their scales ``(k, n)``, each column of unit norm."""
    if len({basis.shape[1] for basis in bases}) > 1:
        return [_of_unit_norm([basis], own[None])[0] for basis, own in zip(bases, scales, strict=True)]
    if not len(bases):
        return []
    found = np.stack(bases) * scales[:, :, None]
    return [*(found / np.linalg.norm(found, axis=1, keepdims=True))]


def _null_spaces(pencils: ComplexArray) -> tuple[list[ComplexArray], FloatArray, NDArray[np.bool_]]:
    """Return bases ``(n, count)`` of the null spaces of ``(k, m, n)``, orthonormal, the least singular value last, in
    columns scaled by powers of two, with these ``(k, n)``, and whether the equations are independent beyond doubt."""
    from obsynth.numerics.lapack import zgecon, zunmqr

    scaled, columns = equilibrated(pencils)
    points, equations, count = scaled.shape
    found, sure = list[ComplexArray](), np.zeros(points, dtype=bool)
    # Of independent equations a tenth of the work gives the same null space; the condition is estimated to a small
    # factor, and only for pencils far from the tolerance.
    if 0 < equations <= count:
        packed, factors = np.linalg.qr(np.conj(np.swapaxes(scaled, 1, 2)), mode="raw")
        # A triangle is its own LU factor; LAPACK's estimate for triangles is not in the oldest SciPy.
        triangles = np.tril(packed[:, :, :equations])
        sizes = np.max(np.sum(np.abs(triangles), axis=2), axis=1)
        for place in range(points):
            sure[place] = zgecon(triangles[place].T, sizes[place])[0] > FAR_FROM_SINGULAR
    last = np.eye(count, dtype=np.complex128)[:, equations:]
    for place in range(points):
        if sure[place] and last.size:
            room = LAPACK_BLOCK * last.shape[1]
            found.append(zunmqr("L", "N", packed[place].T, factors[place], last, room)[0])
        elif sure[place]:
            found.append(last)
        else:
            _, values, right = np.linalg.svd(scaled[place])
            found.append(right[numerical_rank(values) :].conj().T)
    return found, columns, sure


@dataclass(frozen=True, eq=False)
class _Passing:
    """An observer of the first ``tracked`` states at some points: what it makes of scaled outputs, and of the sizes of
    their terms."""

    through: ComplexArray
    passed: FloatArray
    faults: slice
    tracked: int

    @classmethod
    def of(cls, observer: LinearObserver, units: PlantUnits, points: ComplexArray) -> _Passing:
        """Return it at points in scaled time, with the observer's own states balanced."""
        order, outputs, nx = observer.order, observer.By.shape[1], len(observer.state_names)
        rows = np.ones(len(observer.Cz))
        rows[:nx] = 1.0 / units.states[:nx]
        az, by = units.rate * observer.Az, units.rate * observer.By / units.outputs
        cz, dy = rows[:, None] * observer.Cz, rows[:, None] * observer.Dy / units.outputs
        system = np.zeros((order + outputs + len(cz),) * 2)
        system[:order, :order], system[:order, order : order + outputs] = az, by
        system[order + outputs :, :order] = cz
        states = balancing_factors(system)[:order]
        az, by, cz = az * states / states[:, None], by / states[:, None], cz * states
        # Bhat = Ahat D + K may cancel: what it is formed of says how well it can be known.
        offsets = (units.states[:nx] / states[:nx])[:, None] * np.abs(dy[:nx])
        formed = np.abs(by) + np.abs(az[:, :nx]) @ offsets
        # The same holds for a residual, y - C xhat with xhat = z + D y.
        direct = np.abs(dy) + np.abs(cz[:, :nx]) @ offsets
        resolvents = _inverses(pencils_at(None, az, points))
        passed = np.abs(cz) @ (np.abs(resolvents) @ formed) + direct
        return cls(cz @ (resolvents @ by) + dy, passed, observer.fault_rows, nx)

    def misses(
        self, plant: DescriptorSystem, trajectories: ComplexArray, rows: Sequence[int], inputs: Sequence[int]
    ) -> list[tuple[float, float] | None]:
        """Return, at each point, the largest relative error of an estimate in some rows, and that of a fault; ``None``
        at a pole."""
        tracked, dd, picked = self.tracked, plant.Dd[:, list(inputs)], list(rows)
        states = np.array([row for row in picked if row < tracked], dtype=np.intp)
        x, d = trajectories[:, : plant.nx], trajectories[:, plant.nx :]
        error = self.through[:, picked] @ (plant.C @ x + dd @ d)
        error[:, : len(states)] -= x[:, states]
        passed = self.passed[:, picked]
        size = passed @ (np.abs(plant.C) @ np.abs(x) + np.abs(dd) @ np.abs(d))
        size[:, : len(states)] += np.abs(x[:, states])
        # A signal that a trajectory does not move is rounding: it is judged by what trajectories of its size could do.
        possible = passed @ (np.sum(np.abs(plant.C), axis=1) + np.sum(np.abs(dd), axis=1))
        possible[:, : len(states)] += 1.0
        terms = np.maximum(np.max(size, axis=2), UNMOVED_SIGNAL * possible)
        shares = np.max(np.abs(error), axis=2) / np.where(terms > 0.0, terms, 1.0)
        faults = [place for place, row in enumerate(picked) if row in range(self.through.shape[1])[self.faults]]
        relative = np.max(shares, axis=1, initial=0.0)
        absolute = np.max(np.linalg.norm(error[:, faults], axis=2), axis=1, initial=0.0)
        poles = [bool(np.isnan(through).any()) for through in self.through]
        return [
            None if pole else (float(share), float(fault))
            for pole, share, fault in zip(poles, relative, absolute, strict=True)
        ]


def _inverses(matrices: ComplexArray) -> ComplexArray:
    """Return the inverses of ``(k, n, n)``, of a singular one nothing but NaN."""
    try:
        return np.asarray(np.linalg.inv(matrices))
    except np.linalg.LinAlgError:
        pass
    found = np.full_like(matrices, np.nan)
    for place, matrix in enumerate(matrices):
        with suppress(np.linalg.LinAlgError):
            found[place] = np.linalg.inv(matrix)
    return found


#: A fault estimate counts as faithful up to the frequency where it misses by this share of the fault.
FAITHFUL = 0.1
#: A step counts as settled within this share, after this many time constants of the slowest pole.
SETTLING_BAND, SETTLING_TIME_CONSTANTS = 0.02, 4.0
#: Eigenvalues of a fault model closer to constant courses than this, relative to the model's size, are constants.
CONSTANT = 1e-9


@arguments_checked
def fault_response(design: ObserverDesign, frequencies: ArrayLike) -> ComplexArray:
    """Return the frequency response from the faults to their estimates: what a sinusoidal fault looks like.

    Parameters
    ----------
    design : ObserverDesign
        By ``ui-pi-observer``; the fault model plays no role here.
    frequencies : array_like, rad/s
        ``(k,)``.

    Returns
    -------
    ComplexArray
        ``(k, nf, nf)``: entry (i, j) is ``fhat_i / f_j``; the identity where the estimates are faithful.

    Raises
    ------
    SpecError
        The design holds no tracking map.
    """
    if "tracking" not in design.certificate.matrices:
        raise SpecError("The design holds no tracking map: fhat/f cannot be computed.", path="certificate")
    points = boundary_points(np.atleast_1d(real_array(frequencies, "frequencies")).ravel(), design.linear[0].dt)
    return _transfer(*design.linear, design.certificate.matrices["tracking"], points)


def _system(
    plant: DescriptorSystem, observer: LinearObserver, tracking: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    errors = ErrorModel(plant, observer, tracking[:, : plant.nx])
    # In balanced states: units must not cost digits.
    return *balanced_realisation(errors.Az, errors.fault, -errors.fault_output[0]), errors.fault_output[1]


def _transfer(
    plant: DescriptorSystem, observer: LinearObserver, tracking: FloatArray, points: ComplexArray
) -> ComplexArray:
    return response(*_system(plant, observer, tracking), points)


def steady_errors(
    plant: DescriptorSystem, observer: LinearObserver, tracking: FloatArray, phi: FloatArray, cw: FloatArray
) -> list[tuple[int, float]]:
    """Return for each fault the order of the least ``t^order / order!`` that its model does not hold, and the error
    ``fhat - f`` for it in the end, in units of that derivative."""
    a, b, c, d = _system(plant, observer, tracking)
    shift = np.eye(len(a)) if plant.dt > 0.0 else np.zeros_like(a)
    step = plant.dt if plant.dt > 0.0 else 1.0
    found = []
    for fault in range(plant.nf):
        order = _constants(phi, cw[fault], shift=1.0 if plant.dt > 0.0 else 0.0)
        # T(s) = D + C (sI - A)^-1 B = D - C A^-1 B - C A^-2 B s - ...
        vector: FloatArray = b[:, fault]
        for _ in range(order + 1):
            vector = np.asarray(np.linalg.solve(a - shift, vector), dtype=np.float64)
        coefficient = -float(c[fault] @ vector) + (float(d[fault, fault]) - 1.0 if order == 0 else 0.0)
        found.append((order, coefficient * step**order))
    return found


def _constants(phi: FloatArray, row: FloatArray, *, shift: float) -> int:
    """Return how often 0 (1 in discrete time) is an eigenvalue of the part of ``phi`` that a fault is made of."""
    reached = row != 0.0
    for _ in range(len(row)):
        reached = reached | (np.any(phi[reached] != 0.0, axis=0) if reached.any() else reached)
    part = phi[np.ix_(reached, reached)]
    if not part.size:
        return 0
    balanced = balanced_transition(part)[0]
    reach = CONSTANT * largest_singular_value(balanced)
    return int(np.sum(np.abs(np.linalg.eigvals(balanced) - shift) <= reach))


def tracking_rows(
    plant: DescriptorSystem, observer: LinearObserver, tracking: FloatArray, phi: FloatArray, cw: FloatArray
) -> Iterator[Check]:
    """Yield what a user should know about faults outside the model; nothing here fails."""
    source = "recomputed from plant and realisation"
    if not is_stable(observer):
        return
    frequencies = frequency_grid(observer)
    gains = _transfer(plant, observer, tracking, boundary_points(frequencies, plant.dt))
    errors = steady_errors(plant, observer, tracking, phi, cw)
    for fault, name in enumerate(plant.fault_names):
        own = gains[:, fault, fault]
        peak = int(np.argmax(np.abs(own)))
        missed = np.flatnonzero(np.abs(own - 1.0) > FAITHFUL)
        limit = frequencies[missed[0]] if missed.size else np.inf
        yield information(
            f"fhat/f[{name}]",
            f"frequency in rad/s up to which the estimate of an unmodelled sinusoid is wrong by {FAITHFUL:.0%} or less",
            float(limit),
            source=source,
            detail=f"largest |fhat/f| {abs(own[peak]):.3g} at {frequencies[peak]:.3g} rad/s; |fhat/f| = 1 is faithful",
        )
        order, error = errors[fault]
        course = {0: "a step of 1", 1: "a ramp of 1 per s"}.get(order, f"t^{order} / {order}!")
        yield information(
            f"steady error[{name}]",
            f"fhat - f in the end when the fault is {course}, one order above its model",
            error,
            source=source,
            detail=plant.units.get(name, ""),
        )
    yield from _limits(plant, observer, tracking)


def _limits(plant: DescriptorSystem, observer: LinearObserver, tracking: FloatArray) -> Iterator[Check]:
    """Yield a row for each zero of (f, d) -> y outside the region of stability: it limits every gain."""
    units = PlantUnits.of(plant).rounded()
    scaled = units.scaled_plant(plant)
    inputs, direct = np.hstack([scaled.Bf, scaled.Bd]), np.hstack([scaled.Df, scaled.Dd])
    padded, whole = system_pencil(scaled.E, scaled.A, inputs, scaled.C, direct)
    if plant.nf == 0:
        return
    found = system_zeros(padded, whole, nx=scaled.nx)
    if found.normal_rank < whole.shape[1]:
        return
    slowest = float(np.min(decay_rates(poles_of(observer), plant.dt), initial=np.inf))

    def outside(value: complex) -> bool:
        return value.imag >= 0.0 and is_outside(value, plant.dt)

    for zero in zeros_with_directions(padded, whole, found, nx=scaled.nx, wanted=outside):
        if float(np.linalg.norm(zero.input_direction[: plant.nf])) <= NEGLIGIBLE_INPUT:
            continue
        fault, place = units.faults * zero.input_direction[: plant.nf], units.eigenvalue(zero.value)
        value = _transfer(plant, observer, tracking, np.array([place]))[0] @ fault
        names = leading_names(np.abs(fault), plant.fault_names)
        yield information(
            f"limit at {number(place)}",
            f"at this zero of (f, d) -> y the estimate of {', '.join(names)} cannot follow, whatever the gains: "
            "|T(zero) f0| of this observer",
            float(np.linalg.norm(value) / np.linalg.norm(fault)),
            source="a zero outside the region of stability",
            detail=_undershoot(plant, place, slowest),
        )


def _undershoot(plant: DescriptorSystem, zero: complex, slowest: float) -> str:
    if plant.nf != 1 or zero.imag != 0.0 or not np.isfinite(slowest) or slowest <= 0.0:
        return ""
    rate = np.log(zero.real) / plant.dt if plant.dt > 0.0 and zero.real > 0.0 else zero.real
    if (plant.dt > 0.0 and zero.real <= 1.0) or rate <= 0.0:
        return ""
    settling = SETTLING_TIME_CONSTANTS / slowest
    least = (1.0 - SETTLING_BAND) / np.expm1(rate * settling)
    return (
        f"inverse response: a step fault that is settled to {SETTLING_BAND:.0%} after {settling:.3g} s first has at "
        f"least {least:.3g} of its size in the wrong direction"
    )


#: Estimates at a frequency may miss by this much, relative to terms that pass through the inverse of ``sI - Az``.
DECOUPLING_TOLERANCE = 1e-8
_PAPER = "Share Pasand, eq. (19)"
_UI_PI_MATRICES = ("tracking", "Phi", "Cw", "poles", "stability")


def checks(design: ObserverDesign, printed_digits: int | None) -> Iterator[Check]:
    """Yield every check of ``design``; see `obsynth.verify`."""
    good = True
    for row in _realisation_rows(design, printed_digits):
        good &= row.passed
        yield row
    if good:
        # Letters of a realisation that fails need no word of their own.
        (plant, observer), matrices = design.linear, design.certificate.matrices
        model = shipped_model(matrices, plant.nf)
        tolerance = relative_tolerance(printed_digits, plant.nx + model.order + plant.ny)
        yield from gain_rows(design.gains, plant, observer, model, matrices["tracking"], tolerance)


def _realisation_rows(design: ObserverDesign, printed_digits: int | None) -> Iterator[Check]:
    """Yield every check of plant, realisation and certificate."""
    (plant, observer), certificate = design.linear, design.certificate
    yield from plant_information(plant)
    fitting = _fits(design)
    yield fitting_check("observer, certificate and plant have matching signals and shapes", fits=fitting)
    if not fitting:
        return
    tracking, phi, cw, poles, factor = (certificate.matrices[name] for name in _UI_PI_MATRICES)
    model = shipped_model(certificate.matrices, plant.nf)
    *conditions, last = existence_conditions(plant, model)
    yield from condition_rows(conditions)
    if last.name == "fixed modes":
        yield information(last.name, "poles that no gain moves", last.value, source=last.source, detail=last.detail)
    else:
        yield from condition_rows([last])
    tolerance = relative_tolerance(printed_digits, plant.nx + len(phi) + plant.ny)
    for name, claim, found, source in _identities(plant, observer, model, tracking):
        yield equality(name, claim, found, source, bound=tolerance)
    yield from stability_rows(design, poles, factor)
    norm = decoupling_norm(plant, observer)
    yield upper_bound_check(
        "decoupling",
        "the transfer functions from the unknown inputs to the errors of all estimates are zero",
        norm.relative,
        DECOUPLING_TOLERANCE if printed_digits is None else max(DECOUPLING_TOLERANCE, 10.0 * tolerance),
        source="computed from the transfer functions of plant and observer, without the tracking map",
        detail=f"relative to the terms; absolute gain to a fault estimate up to {norm.fault_gain:.1e}; "
        f"worst at {norm.frequency:.3g} rad/s",
    )
    yield from noise_rows(design)
    yield from tracking_rows(plant, observer, tracking, phi, cw)


def _fits(design: ObserverDesign) -> bool:
    (plant, observer), matrices = design.linear, design.certificate.matrices
    if any(name not in matrices for name in _UI_PI_MATRICES):
        return False
    order = matrices["Phi"].shape[0]
    shapes = {
        "tracking": (observer.order, plant.nx + order),
        "Phi": (order, order),
        "Cw": (plant.nf, order),
        "poles": (observer.order, 2),
        "stability": (observer.order, observer.order),
    }
    return bool(
        all(matrices[name].shape == shape and np.all(np.isfinite(matrices[name])) for name, shape in shapes.items())
        and observer.order == plant.nx + order
        and all(getattr(observer, name) == getattr(plant, name) for name in ALIKE)
        and all(delay == 0 for delay in (*observer.state_delays, *observer.fault_delays))
    )


def _identities(
    plant: DescriptorSystem, observer: LinearObserver, model: Exosystem, tracking: FloatArray
) -> Iterator[tuple[str, str, Residual, str]]:
    """Yield the identities (19) of the shipped realisation: name, claim, residual, source."""
    augmented = AugmentedPlant.of(plant, model)
    az, bu, by, cz, du, dy = observer.Az, observer.Bu, observer.By, observer.Cz, observer.Du, observer.Dy
    ve = tracking @ augmented.E
    # A row that is nothing but rounding is judged in the units of what it stands for, not against itself.
    scaling = PlantUnits.of(plant, model)
    units = scaling.augmented_states
    own_u = np.outer(units, scaling.augmented_equations)
    own_dy = np.outer(np.max(np.abs(cz) * units, axis=1, initial=0.0), scaling.outputs)
    # Bhat = Ahat D + K may cancel: what it is formed of says how well it can be known.
    formed = (az[:, : plant.nx], dy[observer.state_rows], augmented.C)
    yield (
        "Sylvester",
        "Ahat U_a E_a + Bhat C_a = U_a A_a",
        residual(
            az @ ve,
            by @ augmented.C,
            -tracking @ augmented.A,
            factors=((az, tracking, augmented.E), (by, augmented.C), (tracking, augmented.A), formed),
            units=units,
        ),
        _PAPER,
    )
    yield (
        "inputs",
        "Jhat = U_a B_a (and Bhat D, where u reaches y)",
        residual(bu, by @ plant.D, -tracking @ augmented.B, factors=((by, plant.D), (tracking, augmented.B))),
        _PAPER,
    )
    yield (
        "disturbance in the error",
        "U_a Bd_a = 0 (Bhat Dd, where d reaches y)",
        residual(
            tracking @ augmented.Bd,
            -by @ plant.Dd,
            factors=((tracking, augmented.Bd), (by, plant.Dd), (own_u, augmented.Bd)),
        ),
        _PAPER,
    )
    yield (
        "disturbance in the estimates",
        "D_a Dd = 0: d has no direct effect on any estimate",
        residual(dy @ plant.Dd, factors=((dy, plant.Dd), (own_dy, plant.Dd))),
        "our extension",
    )
    wanted = {
        "state": (observer.state_rows, np.eye(plant.nx, augmented.order), "U_a E_a + D_a C_a = I, rows of the state"),
        "fault": (
            observer.fault_rows,
            np.hstack([np.zeros((plant.nf, plant.nx)), model.Cw]),
            "Cw (U_a E_a + D_a C_a) = Cw: the fault estimate follows the fault model",
        ),
        "residual": (
            observer.residual_rows,
            np.zeros((len(observer.residual_names), augmented.order)),
            "neither the state nor a modelled fault has an effect on the residual",
        ),
    }
    for name, (rows, goal, claim) in wanted.items():
        factors = ((cz[rows], tracking, augmented.E), (dy[rows], augmented.C), (own_dy[rows], augmented.C))
        yield name, claim, residual(cz[rows] @ ve, dy[rows] @ augmented.C, -goal, factors=factors, units=units), _PAPER
    yield (
        "feedthrough",
        "the input has no direct effect on any estimate (Du + Dy D = 0)",
        residual(du, dy @ plant.D, factors=((dy, plant.D),)),
        "our extension",
    )


#: Recomputed poles may miss the claimed ones by this, relative to their size; claimed rates and norms likewise.
SPECTRUM_TOLERANCE = 1e-4
POLE_CLAIM_TOLERANCE = 1e-4
#: Poles that a row lists.
LISTED_POLES = 8


def stability_rows(design: ObserverDesign, poles: FloatArray, factor: FloatArray) -> Iterator[Check]:
    """Yield the proof of stability, and what the eigenvalues say about the claims."""
    (plant, observer), claims = design.linear, design.certificate.claims
    dt = plant.dt
    yield stability_row(observer.Az, factor, dt, "Share Pasand, eq. (7)")
    claimed = [complex(*row) for row in poles]
    slowest = numbers(sorted(claimed, key=lambda pole: -pole.real))[:LISTED_POLES]
    yield upper_bound_check(
        "poles",
        "the eigenvalues of Ahat are the claimed ones, each within this share of its size",
        _missed(observer, claimed),
        SPECTRUM_TOLERANCE,
        source="Share Pasand, procedure 1, step 7",
        detail="slowest " + ", ".join(slowest) if slowest else "none",
    )
    if "decay" in claims:
        yield decay_row(observer, claims["decay"])
    wanted = claims.get("digits", PRINTED_DIGITS)
    digits = int(wanted) if 1 <= wanted <= DOUBLE_DIGITS else 1
    rounded = as_printed(observer.Az, digits)
    values, bound = eigenvalues(rounded), 1.0 if dt > 0.0 else 0.0
    found = abscissa_of(values, dt)
    yield Check(
        "stable with the claimed digits" if "digits" in claims else f"stable with {PRINTED_DIGITS} digits",
        f"Ahat rounded to {digits} significant digits is still stable (strictly below the bound)",
        found,
        bound,
        bound - found,
        bool(found < bound),
        "ours: gains of high-order placements do not keep their poles when they are printed with few digits",
    )
    yield information(
        "digits needed",
        "significant digits of Ahat with which every mode stays stable",
        float(digits_needed(observer.Az, dt)),
        source="recomputed eigenvalues",
        detail=f"with {digits} digits poles move by {mean_miss(values, claimed, dt):.1e} of their size",
    )


def _missed(observer: LinearObserver, claimed: list[complex]) -> float:
    """Return by how much the claimed poles are missed, groups by their means; more digits tell ill-conditioned ones."""
    a, dt, values = observer.Az, observer.dt, poles_of(observer)
    missed = farthest_pole(values, claimed, dt)
    if missed > SPECTRUM_TOLERANCE and len(claimed) == len(a) and (enclosed := enclosed_eigenvalues(a)) is not None:
        return farthest_pole([middle_of(ball) for ball in enclosed], claimed, dt)
    return missed if missed > SPECTRUM_TOLERANCE else mean_miss(values, claimed, dt)


def noise_rows(design: ObserverDesign) -> Iterator[Check]:
    """Yield how much noise reaches the fault estimates."""
    (plant, observer), claims = design.linear, design.certificate.claims
    rows = observer.Cz[observer.fault_rows]
    direct = observer.Dy[observer.fault_rows]
    discrete = float(plant.dt > 0.0)
    unit = certain_noise_covariance(observer.Az, observer.By, rows, discrete * direct, plant.dt)
    if "noise_amplification" in claims:
        largest = float(np.sqrt(np.max(np.maximum(np.diag(unit), 0.0), initial=0.0)))
        yield upper_bound_check(
            "noise amplification",
            "H2 norm from white noise on every output to a fault estimate is at most the claimed one",
            largest,
            claims["noise_amplification"] * (1.0 + POLE_CLAIM_TOLERANCE),
            source="recomputed, Lyapunov equation",
            detail="outputs in their own units"
            + ("" if plant.dt else "; times the root of the sample time in s")
            + (f"; besides, y enters fhat directly by {largest_singular_value(direct):.3g}" if direct.any() else ""),
        )
    elif np.any(np.isnan(unit)):
        text = "H2 norm from white noise on every output to a fault estimate"
        yield information("noise amplification", text, np.nan, source="recomputed, Lyapunov equation", detail=UNCERTAIN)
    yield from fault_noise_rows(ErrorModel(plant, observer, design.certificate.matrices["tracking"][:, : plant.nx]))


def gain_rows(
    gains: Mapping[str, FloatArray],
    plant: DescriptorSystem,
    observer: LinearObserver,
    model: Exosystem,
    tracking: FloatArray,
    tolerance: float,
) -> Iterator[Check]:
    """Yield the row on the listed gains; nothing where none are listed, as the realisation stands for itself."""
    if not gains:
        return
    found, unknown = [], sorted(set(gains) - set(_shapes(plant, observer, model)))
    for letter, shape in _shapes(plant, observer, model).items():
        if letter in gains and (gains[letter].shape != shape or not np.all(np.isfinite(gains[letter]))):
            unknown.append(letter)
    if not unknown:
        found = list(_residuals(gains, plant, observer, model, tracking))
    missed = worst(found) if found else Residual(1.0 if unknown else 0.0, 1.0)
    claim = "the letters are known, and those of the realisation, the fault model and the certificate"
    row = equality("gains", claim, missed, "Share Pasand, eqs. (4), (12), (19), (20)", bound=tolerance)
    yield row if not unknown else Check(**{**row.__dict__, "detail": f"wrong: {', '.join(unknown)}"})


def _shapes(plant: DescriptorSystem, observer: LinearObserver, model: Exosystem) -> dict[str, tuple[int, int]]:
    nx, ny, nz, count = plant.nx, plant.ny, observer.order, model.order
    return {
        "U_a": (nz, nz),
        "D_a": (nz, ny),
        "K_a": (nz, ny),
        "Ahat": (nz, nz),
        "Bhat": (nz, ny),
        "Jhat": (nz, plant.nu),
        "U": (nx, nx),
        "D": (nx, ny),
        "K": (nx, ny),
        "F": (count, ny),
        "Hhat": (nx, plant.nf),
        "Phi": (count, count),
        "Cw": (plant.nf, count),
    }


def _residuals(
    gains: Mapping[str, FloatArray],
    plant: DescriptorSystem,
    observer: LinearObserver,
    model: Exosystem,
    tracking: FloatArray,
) -> Iterator[Residual]:
    """Yield, for every letter that is listed, how far it is from what it stands for."""
    nx, count = plant.nx, observer.order
    augmented = AugmentedPlant.of(plant, model)
    same = {"U_a": tracking, "Ahat": observer.Az, "Bhat": observer.By, "Phi": model.Phi, "Cw": model.Cw}
    whole = {"U": ("U_a", slice(0, nx), slice(0, nx)), "D": ("D_a", slice(0, nx), slice(None))}
    whole |= {"K": ("K_a", slice(0, nx), slice(None)), "F": ("K_a", slice(nx, count), slice(None))}
    for letter, matrix in same.items():
        if letter in gains:
            yield _same(gains[letter], matrix)
    for letter, (name, rows, columns) in whole.items():
        if letter in gains and name in gains:
            yield _same(gains[letter], gains[name][rows, columns])
    if "Hhat" in gains and "U" in gains:
        yield residual(gains["Hhat"], -gains["U"] @ plant.Bf, factors=((gains["U"], plant.Bf),))
    if "Jhat" in gains:
        yield residual(gains["Jhat"], -observer.Bu, -observer.By @ plant.D, factors=((observer.By, plant.D),))
    if "D_a" in gains:
        # The estimates are read from z + D_a y.
        estimates = slice(0, nx + plant.nf)
        shown = np.vstack([np.eye(nx, count), np.hstack([np.zeros((plant.nf, nx)), model.Cw])])
        yield residual(observer.Dy[estimates], -shown @ gains["D_a"], factors=((shown, gains["D_a"]),))
        yield from _injection(gains, augmented, observer)


def _injection(
    gains: Mapping[str, FloatArray], augmented: AugmentedPlant, observer: LinearObserver
) -> Iterator[Residual]:
    if "K_a" not in gains:
        return
    terms = ((observer.Az, gains["D_a"]), (augmented.A, gains["D_a"]))
    yield residual(observer.By, -observer.Az @ gains["D_a"], -gains["K_a"], factors=terms)


def _same(listed: FloatArray, matrix: FloatArray) -> Residual:
    if not listed.size:
        return Residual(0.0, 1.0)
    missed = np.abs(listed - matrix)
    size = np.maximum(np.abs(listed), np.abs(matrix))
    place = np.unravel_index(
        int(np.argmax(np.where(missed > 0.0, missed / np.where(size > 0.0, size, 1.0), 0.0))), missed.shape
    )
    return Residual(float(missed[place]), float(size[place]) or 1.0)

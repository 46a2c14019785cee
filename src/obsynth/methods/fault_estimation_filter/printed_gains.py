"""Printed gains of a filter, and the effect of their rounding on each identity.

Source: Wang 2015, eqs. (8), (17), (20), (23), (60). To first order an identity at gains printed to k decimals is off by
half a unit times the sizes of its cofactors, each found by moving an entry of the gains by as much, either way.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from obsynth.methods.fault_estimation_filter.whole_transfer import (
    OBSERVER_MATRICES,
    Equations,
    fault_identities,
    step_key,
)
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.ranks import RANK_TOLERANCE
from obsynth.numerics.scaling import Scaling
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.results.checks import Check, nothing_wrong, upper_bound_check
from obsynth.verification.error_system import ErrorModel
from obsynth.verification.identities import Identity, equality, tracking_totals, worst

#: Letters that every gain set has; it may have R as well.
NEEDED = ("T", "N", "L", "W", "Psi", "Upsilon")

RESTRICTED, WEIGHT = "gains: T and N", "gains: W"

PAPER_WEIGHT, GIVEN_WEIGHT = "gains: paper's W", "gains: given W"

#: W repeats the pseudoinverse to this share of its rows.
PSEUDOINVERSE_SHARE = 1e-8
#: W repeats a given matrix to this share of its rows: the digits that it may miss of a left inverse.
GIVEN_SHARE = 10.0 * RANK_TOLERANCE

#: The gains that are printed; Psi, Upsilon and R follow from them.
PRINTED = "TNLW"


def gains_fit(work: DescriptorSystem, gains: Mapping[str, FloatArray], observer: LinearObserver) -> Check:
    """Return the row on letters and shapes of the gain set."""
    na, ny, nf = work.nx, work.ny, work.nf
    shapes = {
        "T": (na, na),
        "N": (na, ny),
        "L": (na, ny),
        "W": (nf, ny),
        "Psi": (na, nf),
        "Upsilon": (ny, nf),
        "R": (na, ny),
    }
    wrong = [letter for letter in NEEDED if letter not in gains]
    wrong += [letter for letter in gains if letter not in shapes]
    wrong += [
        letter
        for letter, shape in shapes.items()
        if letter in gains and (gains[letter].shape != shape or not np.all(np.isfinite(gains[letter])))
    ]
    order = na + len(observer.state_names) * (max(observer.fault_delays, default=1) - 1)
    wrong += ["the order of the observer"] if observer.order != order else []
    return nothing_wrong(
        "gains fit",
        "the gain set has the letters and shapes of the plant, the observer the order that follows",
        wrong,
        source="gain set",
    )


def gain_identities(
    work: DescriptorSystem, gains: Mapping[str, FloatArray], equations: Equations, scaling: Scaling
) -> dict[str, Identity]:
    """Return the identities that T, N and W satisfy, and that the rounding of printed gains disturbs."""
    t, n, w = gains["T"], gains["N"], gains["W"]
    upsilon = work.C @ equations.detectability_matrix(gains)
    # The columns are in the units of the faults, which differ: each is compared with its own largest products.
    peaks = np.max(np.abs(w) @ np.abs(upsilon), axis=0, initial=0.0)
    return {
        RESTRICTED: Identity((t @ work.E, n @ work.C, -np.eye(work.nx)), ((t, work.E), (n, work.C)), scaling.states),
        WEIGHT: Identity((w @ upsilon, -np.eye(work.nf)), ((w, upsilon),), 1.0 / np.where(peaks > 0.0, peaks, 1.0)),
    }


def gain_rows(
    work: DescriptorSystem,
    gains: Mapping[str, FloatArray],
    observer: LinearObserver,
    tracking: FloatArray,
    equations: Equations,
    scaling: Scaling,
    allowances: Mapping[str, FloatArray],
) -> Iterator[Check]:
    """Yield the rows on the gain set, which must fit."""
    identities = gain_identities(work, gains, equations, scaling)
    claims = {
        RESTRICTED: ("T E + N C = I", "Wang 2015, eq. (8)"),
        WEIGHT: ("W Upsilon = I", "Wang 2015, eq. (44)"),
    }
    for name, (claim, source) in claims.items():
        yield equality(name, claim, identities[name].residual(allowances.get(name)), source)
    psi, upsilon = equations.detectability_matrix(gains), gains["Upsilon"]
    sizes = equations.absolute.detectability_matrix({"T": np.abs(gains["T"])})
    detectability = [
        Identity((gains["Psi"], -psi), ((sizes,),), entrywise=True),
        Identity((upsilon, -work.C @ gains["Psi"]), ((work.C, sizes),), entrywise=True),
    ]
    yield equality(
        "gains: Psi and Upsilon",
        "Psi holds the columns (TA)^(rho_i - 1) T f_i, and Upsilon = C Psi",
        worst([identity.residual() for identity in detectability]),
        "Wang 2015, eq. (20)",
    )
    if "R" in gains:
        yield equality(
            "gains: R",
            "R is the free part of L: R Upsilon = 0, and L - R = T A Psi G with G Upsilon = I",
            worst([identity.residual() for identity in _free_part_identities(work, gains, scaling)]),
            "Wang 2015, eq. (60)",
        )
    formed = equations.realised(gains)
    terms = equations.absolute.realised({letter: np.abs(gains[letter]) for letter in "TNLW"}, minus=1.0)
    realised = [
        Identity((getattr(observer, name), -formed[name]), ((terms[name],),), entrywise=True)
        for name in OBSERVER_MATRICES
    ]
    realised.append(Identity((tracking, -equations.tracking(gains["T"])), entrywise=True))
    yield equality(
        "gains: realisation",
        "the realisation is that of T, N, L and W, and the certificate tracks T x",
        worst([identity.residual() for identity in realised]),
        "Wang 2015, eq. (23); our state estimate",
    )


def _free_part_identities(work: DescriptorSystem, gains: Mapping[str, FloatArray], scaling: Scaling) -> list[Identity]:
    # Which left inverse G of Upsilon is taken depends on the units of the outputs: any is right.
    outputs, fixed, free = 1.0 / scaling.outputs, gains["L"] - gains["R"], gains["R"]
    moved = gains["T"] @ work.A @ gains["Psi"]
    # The columns of L - R are combinations of those of T A Psi: nothing is left beside their span.
    basis, sizes, _ = np.linalg.svd(moved / scaling.states[:, None], full_matrices=False)
    span = scaling.states[:, None] * basis[:, sizes > 0.0]
    shares = (basis[:, sizes > 0.0] / scaling.states[:, None]).T
    upsilon = gains["Upsilon"]
    # R is the difference of L and the fixed part: it is judged against these, however small it is itself.
    parts = np.abs(gains["L"]) + np.abs(fixed) + np.abs(free)
    rows = np.max(parts * outputs, axis=1, keepdims=True)
    columns = np.max(np.abs(upsilon) / outputs[:, None], axis=0, keepdims=True)
    products = ((rows, columns), (gains["T"], work.A, gains["Psi"]))
    formed = parts + np.abs(gains["T"]) @ np.abs(work.A) @ np.abs(gains["Psi"]) @ np.abs(gains["W"])
    # The projection mixes the rows in balanced units.
    mixed = scaling.states[:, None] * np.max(formed / scaling.states[:, None], axis=0, initial=0.0)
    return [
        Identity((free @ upsilon,), products),
        Identity((fixed @ upsilon, -moved), products),
        Identity((fixed, -span @ (shares @ fixed)), ((mixed,),), outputs),
    ]


def weight_rows(gains: Mapping[str, FloatArray], weight: object) -> Iterator[Check]:
    """Yield the row that W is the one that the options name: the paper's, or a matrix; of a free one there is none."""
    upsilon = gains["Upsilon"]
    if weight is None or weight == "free":
        return
    if weight == "paper":
        units = np.linalg.norm(upsilon, axis=0)
        name, named = PAPER_WEIGHT, np.linalg.pinv(upsilon / units) / units[:, None]
        claim = "W is the pseudoinverse of Upsilon, for the outputs as they are: relative difference"
    else:
        name, named = GIVEN_WEIGHT, _as_weight(weight, gains["W"].shape)
        claim = "W is the matrix that was given: relative difference"
    size = np.max(np.abs(named), axis=1, initial=0.0, keepdims=True)
    difference = np.abs(gains["W"] - named) / np.where(size > 0.0, size, 1.0)
    yield upper_bound_check(
        name,
        claim,
        float(np.max(difference, initial=0.0)),
        PSEUDOINVERSE_SHARE if weight == "paper" else GIVEN_SHARE,
        source="Wang 2015, eq. (47)" if weight == "paper" else "option weight",
        kind="equality",
    )


def _as_weight(weight: object, shape: tuple[int, ...]) -> FloatArray:
    """Return a stored weight as an array; NaN, which no W equals, where it is none of this shape."""
    try:
        matrix = np.array(weight, dtype=np.float64)
    except (TypeError, ValueError):
        matrix = np.zeros(0)
    return matrix if matrix.shape == shape else np.full(shape, np.nan)


def printed_allowances(
    plant: DescriptorSystem,
    work: DescriptorSystem,
    observer: LinearObserver,
    gains: Mapping[str, FloatArray],
    scaling: Scaling,
    digits: int,
) -> dict[str, FloatArray]:
    """Return, by identity, what the rounding of the gains can add to each of its entries, to first order."""
    half_a_unit = 0.5 * 10.0**-digits
    equations = Equations.of(plant, work, observer.fault_delays)

    def totals(letter: str = "", move: FloatArray | None = None) -> dict[str, FloatArray]:
        moved = dict(gains) if move is None else {**gains, letter: gains[letter] + move}
        built = LinearObserver(**{**observer.as_dict(), **equations.realised(moved)})
        tracking = equations.tracking(moved["T"])
        lag = tracking.shape[1] // plant.nx - 1
        errors = ErrorModel(plant, built, tracking, lag=lag)
        identities = gain_identities(work, moved, equations, scaling)
        for name, steps in fault_identities(errors, built.fault_delays).items():
            identities |= {step_key(name, step): identity for step, identity in enumerate(steps)}
        return {**tracking_totals(errors), **{name: identity.total for name, identity in identities.items()}}

    centre = totals()
    allowances = {name: np.zeros_like(total) for name, total in centre.items()}
    for letter in PRINTED:
        for index in np.ndindex(gains[letter].shape):
            move = np.zeros_like(gains[letter])
            move[index] = half_a_unit
            more, less = totals(letter, move), totals(letter, -move)
            for name, middle in centre.items():
                allowances[name] += np.maximum(np.abs(more[name] - middle), np.abs(less[name] - middle))
    return allowances

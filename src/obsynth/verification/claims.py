r"""The bounded real inequality and the stability of a shipped observer, proved with bounds on every rounding error.

With ``e+ = M e + B d``, fault error ``-C e + D d``, P = Q'Q, the gain is below g, and M is Schur stable, if

.. math::
    \begin{bmatrix} P & 0 & (QM)^T & C^T \\ & g^2 I & (QB)^T & -D^T \\ & & I & 0 \\ & & & I \end{bmatrix} > 0

((45) of Wang 2015 before its Schur complements, P divided out of the third block, with D).  Stable is A with
``-S^T (A^T Q^T Q + Q^T Q A) S > 0`` (``z' = A z``), or ``[[(QS)^T QS, (QAS)^T], [QAS, I]] > 0`` (``z+ = A z``), for any
congruence S (here close to the inverse of Q).  Q is stored: P, rounded, loses definiteness near condition 1e16.

Identities that must hold between plant and observer, and how far they are from holding.

An identity is a sum of terms that vanishes.  Its residual is judged entry by entry against what double precision can
do to the terms, and, for gains that were printed to some decimals, against what that rounding can do.

Claims: a closed list, each covered by a row; the recovery of states; fault estimates that are means.

A claim that is not on the list, or whose row is not in the report, fails: it would be printed, and nobody checked it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from hashlib import blake2b
from typing import Any

import numpy as np

from obsynth.analysis.transformations.linear_plants import StateRecovery
from obsynth.numerics.arguments import FloatArray, is_number, remembered
from obsynth.numerics.scaling import Scaling, balance_by_least_squares
from obsynth.numerics.spectra import decay_rates, eigenvalues
from obsynth.observers.linear.observer import LinearObserver, poles_of, unaveraged
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.proofs.balls import (
    Ball,
    DefinitenessProof,
    Enclosed,
    block,
    enclosed_eigenvalues,
    prove_positive_definite,
    unproved,
)
from obsynth.proofs.contraction import prove_contraction
from obsynth.proofs.products import certain_noise_covariance
from obsynth.results.checks import Check, CheckKind, information, nothing_wrong, upper_bound_check
from obsynth.results.design import Certificate, ObserverDesign
from obsynth.verification.error_system import ErrorModel, contraction_of, natural_scaling


def prove_bounded_real(
    plant: DescriptorSystem,
    observer: LinearObserver,
    tracking: FloatArray,
    factor: FloatArray,
    gain: float,
) -> DefinitenessProof:
    """Try to prove the bounded real inequality for the shipped observer; ``factor (core, core)``.

    What was proved of the same numbers, to the last bit, is not proved again while the observer lives.
    """
    known = _proofs_of(observer)
    numbers = _digest(plant.Bd, plant.Dd, tracking, factor, np.array([gain]))
    if numbers in known:
        return known[numbers]
    found = _try_bounded_real(plant, observer, tracking, factor, gain)
    if found.proved:
        known[numbers] = found
    return found


@remembered
def _proofs_of(_observer: LinearObserver) -> dict[bytes, DefinitenessProof]:
    return {}


def _digest(*parts: FloatArray) -> bytes:
    """Return what tells numbers ``(m, n)`` from all others."""
    found = blake2b()
    for part in parts:
        found.update(repr((part.shape, part.dtype.str)).encode())
        found.update(np.ascontiguousarray(part).data)
    return found.digest()


def _try_bounded_real(
    plant: DescriptorSystem, observer: LinearObserver, tracking: FloatArray, factor: FloatArray, gain: float
) -> DefinitenessProof:
    core = factor.shape[0]
    outside = (observer.Az[:core, core:], observer.Cz[observer.fault_rows, core:])
    # What follows the core must be a chain of delays: strictly lower triangular, hence stable.
    chain = np.triu(observer.Az[core:, core:])
    if any(np.any(part != 0.0) for part in (*outside, chain)):
        return unproved("the states after the core are no chain of delays, or act on the core or the fault estimate")
    if not _is_triangular(factor) or not gain > 0.0:
        return unproved("the certificate is not triangular and nonsingular, or the gain is not positive")
    inverse = np.triu(np.linalg.inv(factor))
    if not _is_invertible(inverse):
        return unproved("the certificate cannot be inverted")

    def formula(kind: type[Enclosed]) -> Enclosed:
        exact = kind.exact
        core, nd = factor.shape[0], plant.nd
        q, s = exact(factor), exact(inverse)
        b = exact(tracking[:core, : plant.nx]) @ exact(plant.Bd) - exact(observer.By[:core]) @ exact(plant.Dd)
        qs, qms = q @ s, q @ (exact(observer.Az[:core, :core]) @ s)
        cs = exact(observer.Cz[observer.fault_rows, :core]) @ s
        d = exact(observer.Dy[observer.fault_rows]) @ exact(plant.Dd)
        level = exact(np.eye(nd)).scaled(gain).scaled(gain)
        qb, nf = q @ b, cs.shape[0]

        def zero(rows: int, columns: int) -> Enclosed:
            return exact(np.zeros((rows, columns)))

        return block(
            [
                [qs.T @ qs, zero(core, nd), qms.T, cs.T],
                [zero(nd, core), level, qb.T, -d.T],
                [qms, qb, exact(np.eye(core)), zero(core, nf)],
                [cs, -d, zero(nf, core), exact(np.eye(nf))],
            ]
        )

    return prove_positive_definite(formula)


def _is_triangular(factor: FloatArray) -> bool:
    """Whether a factor is upper triangular and nonsingular."""
    return bool(np.all(np.tril(factor, -1) == 0.0) and np.all(np.diag(factor) != 0.0))


def _is_invertible(inverse: FloatArray) -> bool:
    return bool(np.all(np.isfinite(inverse)) and np.all(np.diag(inverse) != 0.0))


def prove_symmetric_positive(matrix: FloatArray) -> DefinitenessProof:
    """Try to prove that a matrix is symmetric, exactly, and positive definite."""
    if not np.array_equal(matrix, matrix.T):
        return unproved("the matrix is not symmetric")
    return prove_positive_definite(matrix)


def prove_gain(
    a: FloatArray | Ball,
    b: FloatArray | Ball,
    c: FloatArray | Ball,
    P: FloatArray,
    gain: float,
    *,
    direct: FloatArray | Ball | None = None,
) -> DefinitenessProof:
    """Try to prove that ``x' = a x + b v``, ``z = c x + direct v`` is stable, and of an H-infinity norm below ``gain``:
    ``P > 0``, ``[P a + a' P, P b, c'; b' P, -gain^2 I, direct'; c, direct, -I] < 0``."""
    positive = prove_symmetric_positive(P)
    if not positive.proved:
        return unproved(f"P itself: {positive.reason}")
    states, inputs, outputs = Ball.of(a), Ball.of(b), Ball.of(c)
    through = Ball.of(np.zeros((outputs.shape[0], inputs.shape[1])) if direct is None else direct)

    def formula(kind: type[Enclosed]) -> Enclosed:
        p, shown, d = kind.exact(P), kind.of(outputs), kind.of(through)
        moved, entering = p @ kind.of(states), p @ kind.of(inputs)
        level = kind.exact(np.eye(inputs.shape[1])).scaled(gain).scaled(gain)
        identity = kind.exact(np.eye(outputs.shape[0]))
        return block([[-(moved + moved.T), -entering, shown.T], [-entering.T, level, d.T], [shown, d, identity]])

    return prove_positive_definite(formula)


#: A claimed rate is proved for all but this share of it.
RATE_TOLERANCE = 1e-4


def prove_stable(a: FloatArray, factor: FloatArray, dt: float) -> DefinitenessProof:
    """Try to prove that every mode of ``a (n, n)`` decays; ``factor (n, n)``."""
    if factor.shape != a.shape or not np.all(np.isfinite(factor)) or not np.all(np.isfinite(a)):
        return unproved("the certificate does not fit, or a number is not finite")
    if a.shape[0] == 0:
        return DefinitenessProof(True, np.inf, 0.0, "Cholesky")
    if not _is_triangular(factor):
        return unproved("the certificate is not triangular and nonsingular")
    inverse = np.triu(np.linalg.inv(factor))
    if not _is_invertible(inverse):
        return unproved("the certificate cannot be inverted")

    def formula(kind: type[Enclosed]) -> Enclosed:
        q, s = kind.exact(factor), kind.exact(inverse)
        whole, moved = q @ s, q @ (kind.exact(a) @ s)
        if dt > 0.0:
            identity = kind.exact(np.eye(a.shape[0]))
            return block([[whole.T @ whole, moved.T], [moved, identity]])
        half = whole.T @ moved
        return -(half + half.T)

    return prove_positive_definite(formula)


def stability_factor(observer: LinearObserver) -> FloatArray:
    """Return Q, upper triangular, with which `prove_stable` succeeds: of a proved contraction, the identity without."""
    found = contraction_of(observer)
    return np.eye(observer.order) if found is None else found.Q


def stability_row(a: FloatArray, factor: FloatArray, dt: float, source: str) -> Check:
    """Return the row that every mode of ``a (n, n)`` decays, by a Lyapunov factor."""
    claim = "every error decays: the Lyapunov inequality is positive definite"
    return proof_row("stability", claim, prove_stable(a, factor, dt), source)


def proof_row(name: str, claim: str, proof: DefinitenessProof, source: str) -> Check:
    """Return the row of a proof that a matrix is positive definite."""
    bound = proof.lower_bound
    return Check(name, claim, bound, 0.0, bound, proof.proved, source, "proved", proof.text)


def decay_row(observer: LinearObserver, claimed: float) -> Check:
    """Return the row on a claimed decay (1/s): proved for all but `RATE_TOLERANCE` of it, whatever poles there are."""
    a, dt = observer.Az, observer.dt
    slowest = float(np.min(decay_rates(poles_of(observer), dt), initial=np.inf))
    wanted = claimed - RATE_TOLERANCE * abs(claimed)
    source, passed = "recomputed eigenvalues", bool(slowest >= wanted)
    status: CheckKind = "computed"
    if not len(a) or _contracts(a, dt, wanted):
        source, passed, status = "Lyapunov inequality, shifted by the rate", True, "proved"
        slowest = max(slowest, wanted)
    elif (enclosed := enclosed_eigenvalues(a)) is not None:
        slowest = enclosed_decay(enclosed, dt)
        source, passed, status = "enclosure of each eigenvalue of the stored numbers", bool(slowest >= wanted), "proved"
    slow = f"slowest time constant {1.0 / slowest:.3g} s; " if 0.0 < slowest < np.inf else ""
    return Check(
        "decay",
        "every mode decays at the claimed rate (1/s) or faster",
        slowest,
        wanted,
        slowest - wanted,
        passed,
        source,
        status,
        f"{slow}{status} for {wanted:.6g} 1/s",
    )


def slowest_decay(a: FloatArray, dt: float) -> float:
    """Return the rate of the slowest mode (1/s), such that `decay_row` can find it again; infinite without modes."""
    slowest = float(np.min(decay_rates(eigenvalues(a), dt), initial=np.inf))
    if not np.isfinite(slowest) or _contracts(a, dt, slowest - RATE_TOLERANCE * abs(slowest)):
        return slowest
    enclosed = enclosed_eigenvalues(a)
    return slowest if enclosed is None else enclosed_decay(enclosed, dt)


def enclosed_decay(enclosed: tuple[Any, ...], dt: float) -> float:
    """Return a lower bound on the rate of the slowest of some enclosed eigenvalues."""
    if dt == 0.0:
        return float(np.nextafter(min(float((-ball.real).lower()) for ball in enclosed), -np.inf))
    # The two roundings of the logarithm's argument are far below the tolerance of a rate.
    radius = max(float(abs(ball).upper()) for ball in enclosed)
    return float(-np.log(np.nextafter(radius, np.inf)) / dt) if radius > 0.0 else np.inf


def _contracts(a: FloatArray, dt: float, rate: float) -> bool:
    if not rate > 0.0 or not np.isfinite(rate):
        return False
    return prove_contraction(a, discrete=dt > 0.0, rate=float(np.exp(-rate * dt)) if dt > 0.0 else rate) is not None


#: Equalities may miss by this much, relative to the terms they are made of.
EQUALITY_TOLERANCE = 1e-9
#: Gains smaller than this are compared as they are.
LEAST_GAIN_SIZE = 1e-12
#: Sizes of states that are told by what drives them alone are known to within this factor.
ROUGHLY = 4.0


#: What an observer of the plant's own states has in common with it.
ALIKE = ("input_names", "output_names", "state_names", "fault_names", "dt")


@dataclass(frozen=True, eq=False)
class Residual:
    """Error and scale (size of terms) of an identity at its worst entry, and what rounding of printed gains allows."""

    error: float
    scale: float
    allowance: float = 0.0

    @property
    def relative(self) -> float:
        """The error in units of its terms."""
        return self._in_terms(self.error)

    @property
    def bound(self) -> float:
        """What ``relative`` may be."""
        return EQUALITY_TOLERANCE + self._in_terms(self.allowance)

    @property
    def severity(self) -> float:
        """The error in units of what is allowed."""
        return self.relative / self.bound

    def _in_terms(self, size: float) -> float:
        return size / self.scale if self.scale > 0.0 else size


@dataclass(frozen=True, eq=False)
class Identity:
    """A sum of terms of one shape that must vanish."""

    terms: tuple[FloatArray, ...]
    factors: tuple[tuple[FloatArray, ...], ...] = ()  # products in the terms: what rounding can do
    units: FloatArray | None = None  # of the columns, in which entries of a row compare
    entrywise: bool = False  # each entry judged by its own terms
    rough: float = 1.0  # units are known to within this factor
    also: Identity | None = None  # the same with other units; both must hold

    @property
    def total(self) -> FloatArray:
        """The sum of the terms."""
        return np.asarray(sum(self.terms[1:], start=self.terms[0].copy()))

    def residual(self, allowance: FloatArray | None = None) -> Residual:
        """Return the residual at the entry that is worst beside what is allowed there."""
        total = self.total
        if total.size == 0:
            return Residual(0.0, 1.0)
        size = np.abs(self.terms[0])
        for term in self.terms[1:]:
            size += np.abs(term)
        for product in self.factors:
            bound = np.abs(product[0])
            for factor in product[1:]:
                bound = bound @ np.abs(factor)
            size = size + bound
        # Where the sizes are finite, the sum is.
        if not np.isfinite(size).all() or (allowance is not None and not np.isfinite(allowance).all()):
            return Residual(float("nan"), 1.0)
        scale, missed = self.rough * self._scale(size), np.abs(total)
        allowed = EQUALITY_TOLERANCE * scale if allowance is None else EQUALITY_TOLERANCE * scale + allowance
        worst = divmod(int((missed / allowed).argmax()), total.shape[1])
        more = 0.0 if allowance is None else float(allowance[worst])
        found = Residual(float(missed[worst]), float(scale[worst]), more)
        if self.also is None:
            return found
        return max(found, self.also.residual(allowance), key=lambda item: item.severity)

    def _scale(self, size: FloatArray) -> FloatArray:
        if self.entrywise:
            # Nothing is a sum of nothing but zero itself: the least number makes any miss there a large one.
            return np.where(size > 0.0, size, np.finfo(np.float64).tiny)
        columns = np.ones(size.shape[1]) if self.units is None else self.units
        rows = np.max(size * columns, axis=1, keepdims=True)
        return np.asarray(np.where(rows > 0.0, rows, 1.0) / columns)


def residual(
    *terms: FloatArray, factors: tuple[tuple[FloatArray, ...], ...] = (), units: FloatArray | None = None
) -> Residual:
    """Return the residual of ``terms[0] + terms[1] + ... = 0``; see `Identity`."""
    return Identity(terms, factors, units).residual()


def worst(found: list[Residual]) -> Residual:
    """Return the residual that misses most of what it is allowed; one that is no number outdoes them all."""
    for item in found:
        if np.isnan(item.relative):
            return item
    return max(found, key=lambda item: item.severity)


def relative_tolerance(printed_digits: int | None, products: int) -> float:
    """Return what an equality may miss by, relative to its terms."""
    return EQUALITY_TOLERANCE if printed_digits is None else 0.5 * 10.0 ** (-printed_digits) * products


def equality(name: str, claim: str, found: Residual, source: str, *, bound: float | None = None) -> Check:
    """Return the row of a report for an identity; without a bound of the caller's, the residual knows its own."""
    printed = f"; printed digits allow {found.allowance:.1e}" if found.allowance else ""
    return upper_bound_check(
        name,
        claim,
        found.relative,
        found.bound if bound is None else bound,
        source=source,
        kind="equality",
        detail=f"largest miss {found.error:.1e} among terms of size {found.scale:.1e}{printed}",
    )


def tracking_identities(model: ErrorModel) -> dict[str, Identity]:
    """Return the identities that make the observer unbiased without faults and disturbances."""
    plain = _tracking_identities(model)
    found, others = (_in_units(plain, model, scaling) for scaling in _balances(model.plant))
    return {
        name: identity if identity.units is None else replace(identity, also=replace(others[name], rough=ROUGHLY))
        for name, identity in found.items()
    }


def tracking_totals(model: ErrorModel) -> dict[str, FloatArray]:
    """Return what is left of the same identities, whatever they are judged by."""
    return {name: identity.total for name, identity in _tracking_identities(model).items()}


@remembered
def _balances(plant: DescriptorSystem) -> tuple[Scaling, Scaling]:
    """Return the sizes of a plant's states without what drives them, and with it."""
    # A state in small units must not hide behind one in large units.
    alone = natural_scaling(plant)
    # States that do not touch each other have sizes beside each other only by what drives both.
    driven = balance_by_least_squares(plant.E, plant.A, inputs=[plant.B, plant.Bf, plant.Bd], outputs=[plant.C])
    return alone, driven


#: Identities whose columns are states.
_OF_STATES = ("dynamics", "state estimate", "fault estimate", "residual")


def _tracking_identities(model: ErrorModel) -> dict[str, Identity]:
    """Return the identities without units of the states."""
    plant, observer, tracking = model.plant, model.observer, model.T
    ve = tracking @ model.E
    states, cz, dy, du = observer.state_rows, observer.Cz, observer.Dy, observer.Du
    # An observer state that tracks nothing but a sensor fault cancels what it is formed of down to rounding.
    formed = np.abs(tracking) @ np.abs(model.A) + np.abs(observer.By) @ np.abs(model.C)

    def unseen(rows: slice) -> Identity:
        factors = ((cz[rows], tracking, model.E), (dy[rows], model.C), (cz[rows], formed))
        return Identity((cz[rows] @ ve, dy[rows] @ model.C), factors)

    return {
        "dynamics": Identity(
            (observer.Az @ ve, observer.By @ model.C, -tracking @ model.A),
            ((observer.Az, tracking, model.E), (tracking, model.A)),
        ),
        "inputs": Identity(
            (observer.Bu, observer.By @ plant.D, -tracking @ model.B),
            ((observer.By, plant.D), (tracking, model.B)),
        ),
        "state estimate": Identity(
            (cz[states] @ ve, dy[states] @ model.C, -model.goal[states]),
            ((cz[states], tracking, model.E), (dy[states], model.C)),
        ),
        "fault estimate": unseen(observer.fault_rows),
        "residual": unseen(observer.residual_rows),
        "input feedthrough": Identity((du, dy @ plant.D), ((dy, plant.D),)),
    }


def _in_units(identities: dict[str, Identity], model: ErrorModel, scaling: Scaling) -> dict[str, Identity]:
    """Return the same identities where those of the states are judged in some units."""
    units, by = np.tile(scaling.states, model.lag + 1), np.abs(model.observer.By)
    found = {
        name: replace(identity, units=units) if name in _OF_STATES else identity
        for name, identity in identities.items()
    }
    # Outputs that see no state may be all it takes; the others are then rounding errors of those.
    taken = np.max(by / scaling.outputs, axis=1, keepdims=True)
    seen = np.sum(scaling.outputs[:, None] * np.abs(model.C), axis=0, keepdims=True)
    first, last = identities["dynamics"].factors
    found["dynamics"] = replace(found["dynamics"], factors=(first, (taken, seen), last))
    return found


#: Every claim a fault-estimation filter can make.
KNOWN_CLAIMS = ("gamma", "gamma_min", "gamma_bracket_low", "gamma_bracket_high", "state_lag")
#: Gains are norms found in different coordinates: they may be out of order by this share of the claimed one.
ORDER_TOLERANCE = 1e-6
#: Why a variance is not known.
UNCERTAIN = "at rounding level: two ways of computing it disagree"


def claimed(claims: Mapping[str, Any], name: str) -> float:
    """Return a claim as a number; NaN where it is missing or none."""
    value = claims.get(name)
    return float(value) if value is not None and is_number(value) else math.nan


def claim_rows(plant: DescriptorSystem, claims: Mapping[str, Any]) -> Iterator[Check]:
    """Yield the rows on what is claimed: known names, numbers, and gains in order."""
    needed = {"state_lag"} | ({"gamma"} if plant.nd else set())
    # Both ends of a bracket, and what lies in it, or none of them.
    bracketed = bool({"gamma_bracket_low", "gamma_bracket_high"} & claims.keys())
    needed |= set(KNOWN_CLAIMS[:4]) if bracketed else set()
    wrong = [name for name in claims if name not in KNOWN_CLAIMS or not math.isfinite(claimed(claims, name))]
    wrong += sorted(needed - claims.keys())
    if "gamma" in claims and not claimed(claims, "gamma") > 0.0 and "gamma" not in wrong:
        wrong.append("gamma")
    yield nothing_wrong(
        "claims", "every claim is known and a finite number, and none is missing", wrong, source="certificate"
    )
    if "gamma_min" in claims or bracketed:
        yield upper_bound_check(
            "claimed gains",
            "0 <= bracket's lower end <= gamma_min <= its upper end, and gamma_min <= gamma",
            _disorder(claims, bracketed=bracketed),
            ORDER_TOLERANCE,
            source="certificate; whether a filter reaches less is said by the row 'least gain'",
            detail="the largest step backwards, as a share of gamma",
        )


def _disorder(claims: Mapping[str, Any], *, bracketed: bool) -> float:
    """Return by how much the claimed gains are out of order, relative to gamma; NaN when one is no number."""
    gamma, least = claimed(claims, "gamma"), claimed(claims, "gamma_min")
    steps = [least - gamma, -least]
    if bracketed:
        low, high = claimed(claims, "gamma_bracket_low"), claimed(claims, "gamma_bracket_high")
        steps += [low - least, least - high, -low]
    if not all(map(math.isfinite, steps)) or not gamma > 0.0:
        return math.nan
    return max(0.0, *steps) / gamma


def recovery_rows(plant: DescriptorSystem, recovery: StateRecovery | None) -> Iterator[Check]:
    """Yield the rows on the map back to the states of the plant before its transformation, where there is one."""
    if recovery is None:
        return
    wrong = _misfits(plant, recovery)
    source = "the plant; the one before its transformation is not stored"
    yield nothing_wrong(
        "recovery fits",
        "the map back to the original states has unique names, the plant's signals and finite entries",
        wrong,
        source=source,
    )
    if wrong:
        return
    kept = [name for name in recovery.names if name in plant.state_names]
    whole = np.hstack(
        [
            recovery.from_state,
            recovery.from_input,
            recovery.from_fault,
            recovery.from_disturbance,
            recovery.from_noise,
        ]
    )
    rows = [recovery.names.index(name) for name in kept]
    expected = np.eye(plant.nx, whole.shape[1])[[plant.state_names.index(name) for name in kept]]
    yield upper_bound_check(
        "recovery of kept states",
        "a state that the plant still has is recovered as itself",
        float(np.max(np.abs(whole[rows] - expected), initial=0.0)),
        EQUALITY_TOLERANCE,
        source=source,
        kind="equality",
        detail=f"{len(kept)} of {len(recovery.names)} states; how the others follow from these is not checked",
    )


def _misfits(plant: DescriptorSystem, recovery: StateRecovery) -> list[str]:
    names = recovery.names
    valid = isinstance(names, tuple) and all(isinstance(name, str) and name.strip() for name in names)
    wrong = [] if valid and len(set(names)) == len(names) else ["names"]
    widths = {
        "from_state": plant.nx,
        "from_input": plant.nu,
        "from_fault": plant.nf,
        "from_disturbance": plant.nd,
        "from_noise": plant.nw,
    }
    for field, width in widths.items():
        matrix = getattr(recovery, field)
        if matrix.shape != (len(names), width) or not np.all(np.isfinite(matrix)):
            wrong.append(field)
    kept = recovery.noise_kept
    if kept.ndim != 2 or kept.shape[1] != plant.nw or not np.all(np.isfinite(kept)):
        wrong.append("noise_kept")
    return wrong


#: In place of a row: what the search stated, which no check recomputes.  Such a claim has a row that says so.
STATED_BY_SEARCH = "stated by the search"
#: Matrices that the certificate of any linear design may hold, with the rows that cover them.
WITNESS_CLAIMS: Mapping[str, str] = {
    "state_error": "stored numbers: states",
    "input_error": "stored numbers: inputs",
    "disturbance_error": "stored numbers: disturbances",
}


def closed_claims(
    design: ObserverDesign,
    rows: Iterable[Check],
    covered: Mapping[str, str],
    meanings: Mapping[str, str],
    witnesses: frozenset[str],
) -> Iterator[Check]:
    """Yield the row on claims that no row covers (``covered``, by claim), and one for each that is only stated."""
    # Where a row fails already nothing more is said: a report that ends early covers little.
    given = tuple(rows)
    if not all(row.passed for row in given):
        return
    names = {row.name for row in given}
    claims = design.certificate.claims
    wrong = []
    for name, value in claims.items():
        # Of a bank each test has its claims, "threshold[leak]", and its rows.
        own, mark, which = name.partition("[")
        row = covered.get(own)
        row = f"{row}{mark}{which}" if row and row != STATED_BY_SEARCH else row
        # NaN claims nothing: a number that this design does not have.
        number = is_number(value) and not math.isinf(value)
        if not row or not number or (row != STATED_BY_SEARCH and row not in names):
            wrong.append(str(name))
    for name in design.certificate.matrices:
        if name not in witnesses and WITNESS_CLAIMS.get(name) not in names:
            wrong.append(str(name))
    yield upper_bound_check(
        "claims covered",
        "every claim is one that this method can make, and a row of this report checks it",
        float(len(wrong)),
        0.0,
        source="certificate",
        detail=f"not covered: {', '.join(wrong)}" if wrong else "",
    )
    for name, value in claims.items():
        own = name.partition("[")[0]
        if covered.get(own) == STATED_BY_SEARCH and name not in wrong:
            yield information(
                f"stated: {name}",
                f"{meanings[own]}; stated by the search, not recomputed",
                float(value),
                source="certificate",
                status="assumed",
            )


def before_the_mean(design: ObserverDesign) -> tuple[ObserverDesign, tuple[Check, ...]]:
    """Return the design without its mean, and the row that says that nothing else was done to it."""
    mean = design.options.get("mean", 1)
    if mean == 1:
        return design, ()
    _, observer = design.linear
    base = unaveraged(observer, mean) if isinstance(mean, int) and mean > 1 else None
    tracking = design.certificate.matrices.get("tracking")
    fitting = base is not None and tracking is not None and len(tracking) == observer.order
    row = upper_bound_check(
        "mean",
        f"each fault estimate is exactly the mean of the last {mean} of the filter that is checked below",
        float(not fitting),
        0.0,
        source="shipped realisation",
    )
    if base is None or tracking is None or not fitting:
        return design, (row,)
    matrices = {**design.certificate.matrices, "tracking": tracking[: base.order]}
    return replace(design, observer=base, certificate=Certificate(matrices, design.certificate.claims)), (row,)


def fault_noise_rows(errors: ErrorModel) -> Iterator[Check]:
    """Yield the deviation of each fault estimate under the noise that the plant states."""
    plant = errors.plant
    if not plant.nw:
        return
    shown, _, _, direct = errors.fault_output
    # What noise does to an estimate at once has no finite variance in continuous time, and is left out.
    seen = direct if plant.dt > 0.0 else 0.0 * direct
    covariance = certain_noise_covariance(errors.Az, errors.noise, shown, seen, plant.dt)
    for name, variance in zip(plant.fault_names, np.diag(covariance), strict=True):
        yield information(
            f"noise in fhat[{name}]",
            "standard deviation of the fault estimate under the stated noise"
            + ("" if plant.dt else ", for a sample time of 1 s (times its root for others)"),
            float(np.sqrt(variance)),
            source="recomputed, Lyapunov equation",
            detail=UNCERTAIN if np.isnan(variance) else plant.units.get(name, ""),
        )


def mean_noise_rows(design: ObserverDesign) -> Iterator[Check]:
    """Yield the deviation of each averaged estimate under the stated noise."""
    plant, observer = design.linear
    mean, tracking = design.options.get("mean", 1), design.certificate.matrices.get("tracking")
    if mean == 1 or not plant.nw or tracking is None or len(tracking) != observer.order:
        return
    rows = observer.fault_rows
    entering = observer.By @ plant.Dw - tracking[:, : plant.nx] @ plant.Bw
    found = certain_noise_covariance(observer.Az, entering, observer.Cz[rows], observer.Dy[rows] @ plant.Dw, plant.dt)
    for name, variance in zip(observer.fault_names, np.diag(found), strict=True):
        yield information(
            f"noise in the mean of fhat[{name}]",
            f"standard deviation under the stated noise of what is shipped, a mean of {mean}",
            float(np.sqrt(max(float(variance), 0.0))),
            source="recomputed, Lyapunov equation",
        )


def listed_gains(
    design: ObserverDesign, found: Mapping[str, FloatArray], *, tolerance: float = EQUALITY_TOLERANCE
) -> Check:
    """Return the row on the listed gains, which run; of a recursion they are those of the last step looked at."""
    wrong = [letter for letter in design.gains if letter not in found]
    gap = 0.0
    for letter, matrix in found.items():
        listed = design.gains.get(letter, matrix)
        if listed.shape != matrix.shape:
            wrong.append(letter)
        elif matrix.size:
            size = max(float(np.max(np.abs(matrix))), LEAST_GAIN_SIZE)
            # `max` would take a gain that is no number as none at all.
            gap = float(np.maximum(gap, np.max(np.abs(listed - matrix)) / size))
    return upper_bound_check(
        "gains",
        "the listed gains are those that run",
        np.inf if wrong else gap,
        tolerance,
        source="gain set",
        kind="equality",
        detail=f"wrong: {', '.join(wrong)}" if wrong else "",
    )

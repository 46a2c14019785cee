"""Reduction of optimal fault estimation to optimal estimation: windows of outputs free of unknown signals.

A bank ``chi+ = A chi + G (Y - O chi)`` of windows ``Y = (y_{k-W}, ..., y_k)`` follows the plant whatever the decoupled
inputs do.  Every causal linear filter with the asked fault map is then ``F (Y - O chi) + O' chi - Z r``, r = V (Y - O
chi), with a causal Z.  Continuous time becomes discrete by ``s = alpha (z - 1) / (z + 1)``, which keeps H-infinity
norms and stability, for descriptor plants of any index; in discrete time, the infinite modes are split off.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag, eigvals, lu_factor, lu_solve, null_space, ordqz, schur, svd

from obsynth.errors import PreconditionError
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.optimal_estimation import EstimationProblem, reachable_basis

#: Singular values of windows below this, relative to the largest, are rounding.
WINDOW_TOLERANCE = 1e-9

#: Residual of the equations of windows, relative, above which they have no solution.
SOLVED = 1e-7

#: Generalised eigenvalues above this are infinite: those of an index of three come out at 1e5.
INFINITE_MODE = 1e4

#: Frequencies outside this range, relative to 1 rad/s, do not take part in the choice of alpha.
USUAL_RATES = (1e-6, 1e6)

#: Directions that are reached, or seen, by less than this share are rounding.
REACHED = 1e-10

#: What a state may show in other outputs, relative to the direct term, and still be static.
SHOWN = 1e-8

#: alpha is off the geometric mean of the modes by this factor, so that it is none of them.
OFF_MODES = 1.0371

#: Modes with a modulus above this are where zeros at infinity come out, and unstable zeros.
EDGE = 0.999

#: What such a mode shows of itself below this, relative to the matrices, is rounding.
CANCELLED = 1e-6

StateSpace = tuple[FloatArray, FloatArray, FloatArray, FloatArray]


@dataclass(frozen=True, eq=False)
class Inputs:
    """A plant whose inputs are sorted: known, to be estimated, to be decoupled, and bounded."""

    E: FloatArray
    A: FloatArray
    C: FloatArray
    B: tuple[FloatArray, FloatArray, FloatArray, FloatArray]
    D: tuple[FloatArray, FloatArray, FloatArray, FloatArray]
    dt: float

    @property
    def stacked(self) -> tuple[FloatArray, FloatArray]:
        """B and D of all inputs, in this order."""
        return np.hstack(self.B), np.hstack(self.D)


@dataclass(frozen=True, eq=False)
class Reduction:
    """The estimation problem, and the bank that turns windows of y and u into its measurements and fault estimates."""

    problem: EstimationProblem
    G: FloatArray
    V: FloatArray
    F: FloatArray
    window: int
    outputs: int
    inputs: int
    alpha: float
    dt: float

    def filter_of(self, gain: FloatArray, output: FloatArray) -> StateSpace:
        """Return the filter from [y; u] to the estimates, of gains on the measurements."""
        problem = self.problem
        a, b = problem.A - gain @ problem.C, self.G + gain @ self.V
        c, d = -(problem.L - output @ problem.C), self.F - output @ self.V
        window, p, m = self.window, self.outputs, self.inputs
        first = p * (window + 1)
        old = [*range(p * window), *range(first, first + m * window)]
        new = [*range(p * window, first), *range(first + m * window, first + m * (window + 1))]
        registers = block_diag(np.eye(p * window, k=p), np.eye(m * window, k=m))
        entry = np.zeros((len(old), p + m))
        if window:
            entry[p * (window - 1) : p * window, :p] = np.eye(p)
            entry[p * window + m * (window - 1) :, p:] = np.eye(m)
        whole = (
            np.block([[a, b[:, old]], [np.zeros((len(old), len(a))), registers[: len(old), : len(old)]]]),
            np.vstack([b[:, new], entry]),
            np.hstack([c, d[:, old]]),
            d[:, new],
        )
        return from_circle(whole, self.alpha) if self.dt == 0.0 else whole


def onto_circle(system: StateSpace, alpha: float) -> StateSpace:
    """Return a continuous system at ``s = alpha (z - 1) / (z + 1)``, in discrete time."""
    a, b, c, d = system
    resolvent = np.linalg.inv(alpha * np.eye(len(a)) - a)
    root = np.sqrt(2.0 * alpha)
    return resolvent @ (alpha * np.eye(len(a)) + a), root * resolvent @ b, root * c @ resolvent, d + c @ resolvent @ b


def from_circle(system: StateSpace, alpha: float) -> StateSpace:
    """Return the continuous system that `onto_circle` made discrete."""
    a, b, c, d = system
    resolvent = np.linalg.inv(np.eye(len(a)) + a)
    root = np.sqrt(2.0 * alpha)
    return -alpha * resolvent @ (np.eye(len(a)) - a), root * resolvent @ b, root * c @ resolvent, d - c @ resolvent @ b


def reduce(plant: Inputs, delay: int, reference: StateSpace | None, *, exact: bool) -> Reduction:
    """Return the estimation problem of a plant: the fault at ``k - delay``, or a reference model's output.

    Raise `PreconditionError` where no causal filter has the fault map, or decouples what it should.
    """
    (a, b_all, c, d_all), alpha = _standard(plant, reference)
    cut = np.cumsum([part.shape[1] for part in plant.B[:3]])
    bu, bf, bd, bw = np.split(b_all, cut, axis=1)
    du, df, dd, dw = np.split(d_all, cut, axis=1)
    bh, dh = (np.hstack([bf, bd]), np.hstack([df, dd])) if exact else (bd, dd)
    if not exact:
        bw, dw = np.hstack([bf, bw]), np.hstack([df, dw])
    nf = bf.shape[1]
    found = _windows(a, c, (bh, dh), nf if exact else 0, delay if exact else 0, plant.dt)
    window, g, f, v, observed = found
    q, (nu, nw) = len(c), (bu.shape[1], bw.shape[1])
    tu, tw = _toeplitz(a, bu, c, du, window), _toeplitz(a, bw, c, dw, window)
    oldest_w, oldest_u = np.eye(nw, nw * (window + 1)), np.eye(nu, nu * (window + 1))
    core_a, core_b, core_c, core_d = a - g @ observed, bw @ oldest_w - g @ tw, v @ observed, v @ tw
    wanted, direct = f @ observed, f @ tw
    bank = np.hstack([g, bu @ oldest_u - g @ tu])
    measured = np.hstack([v, -v @ tu])
    shown = np.hstack([f, -f @ tu])
    if reference is not None:
        model = onto_circle(reference, alpha) if plant.dt == 0.0 else reference
        ra, rb, rc, rd = model
        k = len(ra)
        core_c = np.hstack([core_c, np.zeros((len(core_c), k))])
        if exact:
            core_a = np.block([[core_a, np.zeros((len(core_a), k))], [rb @ wanted, ra]])
            core_b = np.vstack([core_b, rb @ direct])
            bank = np.vstack([bank, -rb @ shown])
            wanted, direct, shown = np.hstack([rd @ wanted, rc]), rd @ direct, rd @ shown
        else:
            newest = np.hstack([np.zeros((nf, nw * window)), np.eye(nf, nw)])
            core_a, core_b = block_diag(core_a, ra), np.vstack([core_b, rb @ newest])
            bank = np.vstack([bank, np.zeros((k, bank.shape[1]))])
            wanted, direct = np.hstack([np.zeros((len(rd), len(a))), -rc]), -rd @ newest
            shown = np.zeros((len(rd), bank.shape[1]))
    if plant.dt == 0.0 or reference is not None:
        core_a, core_b, core_c, wanted, bank = _in(
            _without_cancelled(core_a, np.vstack([core_c, wanted])), core_a, core_b, core_c, wanted, bank
        )
    basis = reachable_basis(core_a.T, np.hstack([core_c.T, wanted.T]), REACHED)
    core_a, core_b, core_c, wanted, bank = _in(basis, core_a, core_b, core_c, wanted, bank)
    old = nw * window
    chain = np.eye(old, k=nw)
    entry = np.vstack([np.zeros((max(old - nw, 0), nw)), np.eye(nw)]) if window else np.zeros((0, nw))
    problem = EstimationProblem(
        A=np.block([[core_a, core_b[:, :old]], [np.zeros((old, len(core_a))), chain]]),
        B=np.vstack([core_b[:, old:], entry]),
        C=np.hstack([core_c, core_d[:, :old]]),
        D=core_d[:, old:],
        L=np.hstack([wanted, direct[:, :old]]),
        H=direct[:, old:],
    )
    bank = np.vstack([bank, np.zeros((old, bank.shape[1]))])
    return Reduction(problem, bank, measured, shown, window, q, nu, alpha, plant.dt)


def _in(
    basis: FloatArray, a: FloatArray, b: FloatArray, c: FloatArray, wanted: FloatArray, bank: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    back = basis.T
    return back @ a @ basis, back @ b, c @ basis, wanted @ basis, back @ bank


def _toeplitz(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray, window: int) -> FloatArray:
    """Return what inputs of samples 0..window do to the outputs of the same samples."""
    q, k = d.shape
    matrix = np.zeros((q * (window + 1), k * (window + 1)))
    markov, state = [d], b
    for _ in range(window):
        markov.append(c @ state)
        state = a @ state
    for row in range(window + 1):
        for column in range(row + 1):
            matrix[row * q : (row + 1) * q, column * k : (column + 1) * k] = markov[row - column]
    return matrix


def _windows(
    a: FloatArray, c: FloatArray, hidden: tuple[FloatArray, FloatArray], faults: int, delay: int, dt: float
) -> tuple[int, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return the length of the window, G, F and V, and the observability matrix of the window."""
    bh, dh = hidden
    n, q, nh = len(a), len(c), bh.shape[1]
    followed = read = False
    last = 0 if dt == 0.0 else n + delay + 1
    for window in range(0 if dt == 0.0 else delay, last + 1):
        powers = [c]
        for _ in range(window):
            powers.append(powers[-1] @ a)
        observed = np.vstack(powers)
        reach = _toeplitz(a, bh, c, dh, window)
        inverse = np.linalg.pinv(reach, rcond=WINDOW_TOLERANCE) if nh else np.zeros((0, len(reach)))
        goal = np.hstack([bh, np.zeros((n, nh * window))])
        select = np.zeros((faults, nh * (window + 1)))
        select[:, (window - delay) * nh : (window - delay) * nh + faults] = np.eye(faults)
        g, f = goal @ inverse, select @ inverse
        followed = bool(np.linalg.norm(g @ reach - goal) <= SOLVED * (1.0 + np.linalg.norm(bh)))
        read = bool(np.linalg.norm(f @ reach - select) <= SOLVED)
        if followed and read:
            free = null_space(reach.T, rcond=WINDOW_TOLERANCE).T if nh else np.eye(len(reach))
            left, values, _ = svd(free[:, -q:], full_matrices=False) if free.size else (free, np.zeros(0), 0)
            newest = left[:, values > WINDOW_TOLERANCE].T @ free if free.size else free
            return window, np.asarray(g), np.asarray(f), np.asarray(newest), observed
    if not read:
        raise PreconditionError(
            f"No filter has the exact fault map with delay {delay}: the outputs do not determine the faults after "
            f"{delay} samples, whatever the noise. Ask for a longer delay, or exact=False with a reference model."
            if dt > 0.0
            else "No filter has the exact fault map: the outputs do not determine the faults. "
            "Ask for exact=False with a reference model.",
            condition="exact fault map",
        )
    raise PreconditionError(
        "This method does not decouple these inputs: the outputs do not determine them together with the faults, "
        "however long one waits. Leave them out of decoupled=, so that they are bounded like noise.",
        condition="exact decoupling",
    )


def _without_cancelled(a: FloatArray, rows: FloatArray) -> FloatArray:
    """Return a basis without modes on or outside the circle that no output shows: zeros that a reference cancels."""
    n = len(a)
    if not n:
        return np.eye(0)
    triangular, turn, count = schur(a, output="real", sort=lambda re, im: np.hypot(re, im) > EDGE)
    if not count:
        return np.eye(n)
    leading, shown = triangular[:count, :count], rows @ turn[:, :count]
    least = CANCELLED * max(float(np.linalg.norm(rows)), np.finfo(float).tiny)
    basis, new = np.zeros((count, 0)), shown.T
    while basis.shape[1] < count:
        for _ in range(2):
            new = new - basis @ (basis.T @ new)
        left, values, _ = svd(new, full_matrices=False)
        left = left[:, values > least]
        if not left.shape[1]:
            break
        basis, new = np.hstack([basis, left]), leading.T @ left
    gone = turn[:, :count] @ (null_space(basis.T) if basis.shape[1] else np.eye(count))
    return null_space(gone.T) if gone.shape[1] else np.eye(n)


def _standard(plant: Inputs, reference: StateSpace | None) -> tuple[StateSpace, float]:
    """Return the plant as a minimal standard system in discrete time, and alpha of the change of variable."""
    inputs, direct = plant.stacked
    if plant.dt == 0.0:
        rates = np.abs(eigvals(plant.A, plant.E))
        if reference is not None and len(reference[0]):
            rates = np.concatenate([rates, np.abs(np.linalg.eigvals(reference[0]))])
        rates = rates[np.isfinite(rates)]
        rates = rates[(rates > USUAL_RATES[0]) & (rates < USUAL_RATES[1])]
        alpha = OFF_MODES * float(np.exp(np.mean(np.log(rates)))) if len(rates) else OFF_MODES
        factor, root = lu_factor(alpha * plant.E - plant.A), np.sqrt(2.0 * alpha)
        driven = lu_solve(factor, inputs)
        a, b = lu_solve(factor, alpha * plant.E + plant.A), root * driven
        c, d = root * plant.C @ lu_solve(factor, plant.E), direct + plant.C @ driven
    else:
        alpha, (a, b, c, d) = 1.0, _without_infinite_modes(plant, inputs, direct)
    reached = reachable_basis(a, b, REACHED)
    a, b, c = reached.T @ a @ reached, reached.T @ b, c @ reached
    seen = reachable_basis(a.T, c.T, REACHED)
    return (seen.T @ a @ seen, seen.T @ b, c @ seen, d), alpha


def _without_infinite_modes(plant: Inputs, inputs: FloatArray, direct: FloatArray) -> StateSpace:
    n = len(plant.A)

    def is_finite(alpha: FloatArray, beta: FloatArray) -> FloatArray:
        return np.asarray(np.abs(beta) * INFINITE_MODE > np.abs(alpha))

    a, e, upper, lower, left, right = ordqz(plant.A, plant.E, sort=is_finite, output="real")
    k = int(np.sum(is_finite(upper, lower)))
    b, c = left.T @ inputs, plant.C @ right
    m = n - k
    if m and k:
        # A11 R - S A22 = -A12 and E11 R - S E22 = -E12 make the pencil block diagonal.
        equations = np.block(
            [
                [np.kron(np.eye(m), a[:k, :k]), -np.kron(a[k:, k:].T, np.eye(k))],
                [np.kron(np.eye(m), e[:k, :k]), -np.kron(e[k:, k:].T, np.eye(k))],
            ]
        )
        found = np.linalg.solve(equations, -np.concatenate([a[:k, k:].ravel("F"), e[:k, k:].ravel("F")]))
        columns, rows = (part.reshape((k, m), order="F") for part in np.split(found, 2))
        b = np.vstack([b[:k] - rows @ b[k:], b[k:]])
        c = np.hstack([c[:, :k], c[:, k:] + c[:, :k] @ columns])
    if m:
        nilpotent, state = np.linalg.solve(a[k:, k:], e[k:, k:]), -np.linalg.solve(a[k:, k:], b[k:])
        direct = direct + c[:, k:] @ state
        for _ in range(m - 1):
            state = nilpotent @ state
            if np.max(np.abs(c[:, k:] @ state), initial=0.0) > SHOWN * (1.0 + np.max(np.abs(direct), initial=0.0)):
                raise PreconditionError(
                    "The outputs of this discrete-time plant depend on inputs of later samples (its index is above 1 "
                    "and the outputs show it): this method does not take it. Reduce the index first.",
                    condition="causal outputs",
                )
    return np.linalg.solve(e[:k, :k], a[:k, :k]), np.linalg.solve(e[:k, :k], b[:k]), c[:, :k], direct

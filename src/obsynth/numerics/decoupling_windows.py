"""Combinations of a window of samples that decouple faults and unknown inputs: fault estimation as plain estimation.

Every causal linear filter that decouples h = (f, d), or d alone, exactly is ``fhat0 - Z r`` with a causal Z, and

    xi+ = A xi + B w,   r = C xi + D w,   e0 = L xi + D1 w

is the error system of ``fhat0`` and r.  With ``Y_k = (y_{k-W}, ..., y_k) = O x_{k-W} + T_h H + T_w
W_k`` and ``G T_h = [Bh 0 .. 0]``, ``Mf T_h = [selects f_{k-L}]``, ``V T_h = 0``, the bank

    chi+ = A chi + G (Y - O chi),   fhat0 = Mf (Y - O chi),   r = V (Y - O chi)

does not depend on h.  In continuous time no window is needed after the Cayley transform.  Source: ours; compare
A. Varga, *Solving Fault Diagnosis Problems*, 2017, sections 5.2 and 7.4 to 7.9 (null-space method).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg
from numpy.typing import NDArray
from scipy.linalg import block_diag

from obsynth.errors import PreconditionError
from obsynth.numerics.arrays import ComplexArray, FloatArray
from obsynth.numerics.ranks import WINDOW_RANK_TOLERANCE
from obsynth.numerics.standard_form import cayley, cayley_point, reachable_basis, standard_form
from obsynth.numerics.unseen_inputs import seen_part

#: Most sufficient windows are this short; longer ones are searched by doubling.
LENGTHS_ONE_BY_ONE = 8
#: Largest residual of an identity of a window.
WINDOW_IDENTITY = 1e-7
#: A response of a reference model below this share is rounding: the input counts as further delayed.
DEAD_SHARE = 1e-9
#: When unobservable modes are removed, modes beyond this modulus count as not asymptotically stable.
EDGE_OF_STABILITY = 0.999
#: Observability of such a mode, relative to the outputs, below which it counts as unobservable.
SEEN_SHARE = 1e-6
#: The same for modes of finite frequency.  A fast zero is hardly observable behind a lag that does not cancel it; the
#: fault map without such a mode is verified to 1e-6.
SEEN_FINITE_SHARE = 1e-8
#: Modes of the Cayley transform within this distance of -1 have infinite frequency; one of order 4 is off by eps^(1/4).
NEAR_INFINITY = 1e-2

Model = tuple[FloatArray, FloatArray, FloatArray, FloatArray]

_Core = tuple[
    FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray
]


class Channels(NamedTuple):
    """A descriptor plant by its arrays: ``E x+ = A x + B u + Bf f + Bd d + Bw w``, ``y`` likewise, dt."""

    E: FloatArray
    A: FloatArray
    C: FloatArray
    B: FloatArray
    D: FloatArray
    Bf: FloatArray
    Df: FloatArray
    Bd: FloatArray
    Dd: FloatArray
    Bw: FloatArray
    Dw: FloatArray
    dt: float


@dataclass(frozen=True, eq=False)
class EstimationProblem:
    """The estimation problem and filter bank: ``chi+ = A chi + G Y``, ``r = V Y - C chi``, ``fhat0 = F Y - L chi``."""

    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray
    L: FloatArray
    D1: FloatArray
    G: FloatArray
    V: FloatArray
    F: FloatArray
    window: int
    alpha: float
    shift: int


class _Window(NamedTuple):
    observed: FloatArray
    Th: FloatArray
    Tw: FloatArray
    G: FloatArray
    Mf: FloatArray
    length: int


def estimation_problem(
    plant: Channels,
    *,
    delay: int | Sequence[int] | None = None,
    reference: Model | None = None,
    exact: bool = True,
    poles: ComplexArray | None = None,
    brief: bool = False,
) -> EstimationProblem:
    """Return the estimation problem of a plant.

    Parameters
    ----------
    plant : Channels
        A regular pencil of any index.
    delay : int or sequence of int, optional
        Samples L of the exact fault map ``z^-L`` (discrete time), of all faults or of each.
    reference : tuple of FloatArray, optional
        A reference model ``(a, b, c, d)`` from the faults (the delayed faults) to the required estimate.
    exact : bool, optional
        Whether the fault map is exact; otherwise faults drive the error as w does (model matching).
    poles : ComplexArray, optional
        Finite poles of the plant, which place the Cayley point; by default all eigenvalues of its pencil.
    brief : bool, optional
        Whether a delay that the faults' first responses exclude is refused at once, without computing the shortest
        delays, which needs long windows: for callers that try delays in turn.

    Raises
    ------
    PreconditionError
        No causal filter has this fault map, or the unknown inputs cannot be decoupled in this form.
    """
    point = None
    if plant.dt == 0.0:
        own = scipy.linalg.eigvals(plant.A, plant.E) if poles is None else poles
        lags = np.linalg.eigvals(reference[0]) if reference is not None and reference[0].size else own[:0]
        point = cayley_point(own, lags)
    inputs, through = np.hstack([plant.Bf, plant.Bd, plant.Bw]), np.hstack([plant.Df, plant.Dd, plant.Dw])
    form = standard_form(plant.E, plant.A, inputs, plant.C, through, plant.dt, alpha=point)
    nf, nd = plant.Bf.shape[1], plant.Bd.shape[1]
    (bf, bd, bw), (df, dd, dw) = (np.split(part, [nf, nf + nd], axis=1) for part in (form.B, form.D))
    bh, dh = (np.hstack([bf, bd]), np.hstack([df, dd])) if exact else (bd, dd)
    if not exact:
        bw, dw = np.hstack([bf, bw]), np.hstack([df, dw])
    # Remove the inputs that reach no output: they cannot be estimated and need not be decoupled.
    visible = seen_part(form.A, bh, form.C, dh)
    wanted = np.zeros((0, nf))
    if exact:
        wanted, reference = _distinguishable_faults(visible.unseen[:nf], nf, reference, disturbed=nd > 0)
    a, c, bw = visible.states @ form.A @ visible.states.T, form.C @ visible.states.T, visible.states @ bw
    hidden = visible.states @ bh @ visible.inputs, dh @ visible.inputs
    selection = wanted @ visible.inputs[:nf] if exact else np.zeros((0, visible.inputs.shape[1]))
    lags = np.broadcast_to(np.asarray(0 if delay is None else delay, dtype=np.int64), (len(wanted),))
    if reference is not None and exact and plant.dt > 0.0:
        dead, reference = _without_dead_samples(reference, longest=len(form.A) + len(reference[0]) + 1)
        lags = lags + dead
    lags = lags + form.shift
    if brief and plant.dt > 0.0 and not _may_show_within(a, c, hidden, selection, lags):
        raise PreconditionError("Some fault does not show in the outputs within its delay.", condition="delay")
    window = _decoupling_window(a, c, hidden, (bw, dw), selection, lags, plant.dt, form.shift)
    core = _core(a, (bw, dw), window, len(c))
    if reference is not None:
        # Where all inputs are delayed by some samples, the reference model has to be delayed likewise.
        reference = reference if exact else with_late_inputs(reference, form.shift)
        newest = np.hstack([np.zeros((nf, bw.shape[1] * window.length)), np.eye(nf, bw.shape[1])])
        core = _with_reference(core, reference, form.alpha if plant.dt == 0.0 else None, None if exact else newest)
    core = _without_unseen(core, modelled=plant.dt == 0.0 or reference is not None, continuous=plant.dt == 0.0)
    chained = _with_chain(core, bw.shape[1], window.length)
    return EstimationProblem(*chained, window.length, form.alpha, form.shift)


def _distinguishable_faults(
    unseen: FloatArray, nf: int, reference: Model | None, *, disturbed: bool
) -> tuple[FloatArray, Model | None]:
    """Return the combinations of faults that drive the reference model, and the model with these as inputs.

    ``disturbed``: whether disturbances are decoupled.  Raises `PreconditionError` where the outputs cannot distinguish
    the faults.
    """
    wanted = np.eye(nf)
    if np.linalg.norm(unseen) > WINDOW_IDENTITY and reference is not None:
        a, b, c, d = reference
        _, values, rows = np.linalg.svd(np.vstack([b, d]))
        wanted = rows[: int(np.sum(values > WINDOW_RANK_TOLERANCE * values[0]))]
        reference = a, b @ wanted.T, c, d @ wanted.T
    if np.linalg.norm(wanted @ unseen) > WINDOW_IDENTITY:
        raise PreconditionError(
            "The faults cannot be told from each other and from the decoupled disturbances, with whatever delay: the "
            "transfer matrix from both to the outputs has too low a rank. Let a disturbance count as noise (leave it "
            "out of decoupled), or measure more."
            if disturbed
            else "The faults cannot be told from each other, with whatever delay: the transfer matrix from them to the "
            "outputs has too low a rank. Measure more, or match a reference model (exact: false).",
            condition="decoupling",
        )
    return wanted, reference


def _without_dead_samples(model: Model, *, longest: int) -> tuple[NDArray[np.int64], Model]:
    """Return the delay of each input of a model to its outputs, in samples, and the model without these delays.

    With a delay L the Markov parameter ``C A^(L-1) B`` becomes the direct feedthrough.
    """
    a, b, c, d = model
    lags, delayed_b, direct = np.zeros(d.shape[1], dtype=np.int64), b.copy(), d.copy()
    nothing = DEAD_SHARE * (np.linalg.norm(c) * np.linalg.norm(b, axis=0) + np.linalg.norm(d, axis=0))
    for i in range(d.shape[1]):
        while lags[i] < longest and np.linalg.norm(direct[:, i]) <= nothing[i]:
            direct[:, i], delayed_b[:, i] = c @ delayed_b[:, i], a @ delayed_b[:, i]
            lags[i] += 1
        if lags[i] == longest:  # the input does nothing at all
            lags[i], direct[:, i], delayed_b[:, i] = 0, 0.0, 0.0
    return lags, (a, delayed_b, c, direct)


def with_late_inputs(model: Model, samples: int) -> Model:
    """Return a model whose inputs are delayed by a number of samples."""
    a, b, c, d = model
    for _ in range(samples):
        count = b.shape[1]
        a, b = np.block([[a, b], [np.zeros((count, len(a) + count))]]), np.eye(len(a) + count, count, k=-len(a))
        c, d = np.hstack([c, d]), np.zeros_like(d)
    return a, b, c, d


def first_responses(model: Model, count: int) -> list[FloatArray]:
    """Return the first ``count`` Markov parameters of a model: D, C B, C A B, ..."""
    a, b, c, d = model
    responses, moved = [d][:count], b
    while len(responses) < count:
        responses.append(c @ moved)
        moved = a @ moved
    return responses


def stacked(a: FloatArray, c: FloatArray, b: FloatArray, d: FloatArray, length: int) -> FloatArray:
    """Return the block Toeplitz matrix of a window from inputs to outputs."""
    rows, width = c.shape[0], b.shape[1]
    toeplitz, blocks = np.zeros((rows * (length + 1), width * (length + 1))), first_responses((a, b, c, d), length + 1)
    for i in range(length + 1):
        for j in range(i + 1):
            toeplitz[i * rows : (i + 1) * rows, j * width : (j + 1) * width] = blocks[i - j]
    return toeplitz


def _decoupling_window(
    a: FloatArray,
    c: FloatArray,
    hidden: tuple[FloatArray, FloatArray],
    noise: tuple[FloatArray, FloatArray],
    selection: FloatArray,
    lags: NDArray[np.int64],
    dt: float,
    shift: int,
) -> _Window:
    """Return the shortest window that decouples unknown inputs and estimates the faults; raise where there is none."""
    n, lag = len(a), int(np.max(lags, initial=0))
    shortest, longest = lag, n + lag + 1
    window = _first_window(
        lambda length: _tried_window(a, c, hidden, selection, lags, length),
        shortest,
        shortest if dt == 0.0 else longest,
    )
    if not window.decouples:
        raise PreconditionError(
            "The unknown inputs and faults cannot be reconstructed from the outputs by a window of any length: no "
            "filter of this form decouples them. Let a disturbance count as noise (leave it out of decoupled).",
            condition="decoupling",
        )
    if not window.estimates_faults:
        first = _first_lags(window.Th, selection)
        raise PreconditionError(
            f"No causal filter has the exact fault map with a delay of {_in_samples(lags - shift)}: the faults' "
            f"shortest delays are {_in_samples(first - shift)}.",
            condition="delay",
        )
    return _Window(window.observed, window.Th, stacked(a, c, *noise, window.length), window.G, window.Mf, window.length)


def _may_show_within(
    a: FloatArray, c: FloatArray, hidden: tuple[FloatArray, FloatArray], selection: FloatArray, lags: NDArray[np.int64]
) -> bool:
    """Whether the first responses span each fault: a window of any length has no other rows for one sample."""
    responses = first_responses((a, hidden[0], c, hidden[1]), int(np.max(lags, initial=0)) + 1)
    for fault, late in zip(selection, lags.tolist(), strict=True):
        spanning = np.vstack(responses[: late + 1]).T
        combination = np.linalg.lstsq(spanning, fault, rcond=None)[0]
        if np.linalg.norm(spanning @ combination - fault) > WINDOW_IDENTITY:
            return False
    return True


def _first_lags(th: FloatArray, selection: FloatArray) -> NDArray[np.int64]:
    """Return the shortest delay with which a long window estimates each fault."""
    count = selection.shape[1]
    residual = np.linalg.pinv(th, rcond=WINDOW_RANK_TOLERANCE) @ th - np.eye(th.shape[1])
    newest_first = [selection @ residual[i : i + count] for i in reversed(range(0, len(residual), count))]
    missed = np.array([np.linalg.norm(part, axis=1) for part in newest_first])
    return np.asarray(np.argmax(missed <= WINDOW_IDENTITY, axis=0))


def _in_samples(lags: NDArray[np.int64]) -> str:
    text = _listed(lags)
    return f"{text} {'sample' if text == '1' else 'samples'}"


def _listed(lags: NDArray[np.int64]) -> str:
    return ", ".join(str(lag) for lag in (lags[:1] if len(set(lags.tolist())) == 1 else lags))


class _TriedWindow(NamedTuple):
    """A window, and whether it decouples the states and reconstructs the faults."""

    observed: FloatArray
    Th: FloatArray
    G: FloatArray
    Mf: FloatArray
    length: int
    decouples: bool
    estimates_faults: bool

    @property
    def suffices(self) -> bool:
        return self.decouples and self.estimates_faults


def _first_window(tried: Callable[[int], _TriedWindow], shortest: int, longest: int) -> _TriedWindow:
    """Return the shortest window that suffices, or the longest one.

    Every window longer than a sufficient one suffices, too: after `LENGTHS_ONE_BY_ONE` the lengths double, and the
    last interval is bisected.
    """
    for length in range(shortest, min(shortest + LENGTHS_ONE_BY_ONE, longest) + 1):
        window = tried(length)
        if window.suffices:
            return window
    too_short = window.length
    while too_short < longest and not window.suffices:
        too_short = window.length
        window = tried(min(2 * too_short - shortest, longest))
        if window.length == longest and not window.suffices:
            return window
    while window.length - too_short > 1:
        middle = tried((too_short + window.length) // 2)
        if middle.suffices:
            window = middle
        else:
            too_short = middle.length
    return window


def _tried_window(
    a: FloatArray,
    c: FloatArray,
    hidden: tuple[FloatArray, FloatArray],
    selection: FloatArray,
    lags: NDArray[np.int64],
    length: int,
) -> _TriedWindow:
    n, (bh, dh) = len(a), hidden
    nh, rows = bh.shape[1], [c]
    for _ in range(length):
        rows.append(rows[-1] @ a)
    th = stacked(a, c, bh, dh, length)
    inverse = np.linalg.pinv(th, rcond=WINDOW_RANK_TOLERANCE) if nh else np.zeros((0, len(th)))
    first = np.hstack([bh, np.zeros((n, nh * length))])
    chosen = np.zeros((len(selection), nh * (length + 1)))
    for row, late, entries in zip(chosen, lags, selection, strict=True):
        row[(length - late) * nh : (length - late + 1) * nh] = entries
    G, Mf = first @ inverse, chosen @ inverse
    decouples = not nh or bool(np.linalg.norm(G @ th - first) <= WINDOW_IDENTITY * (1.0 + np.linalg.norm(bh)))
    estimates_faults = bool(np.linalg.norm(Mf @ th - chosen) <= WINDOW_IDENTITY)
    return _TriedWindow(np.vstack(rows), th, np.asarray(G), np.asarray(Mf), length, decouples, estimates_faults)


def _core(a: FloatArray, noise: tuple[FloatArray, FloatArray], window: _Window, ny: int) -> _Core:
    """Return A, B over the whole window, C, D, L, D1 and G, V, F."""
    nw, length = noise[0].shape[1], window.length
    hidden = window.Th.shape[1] > 0
    parity = (
        scipy.linalg.null_space(window.Th.T, rcond=WINDOW_RANK_TOLERANCE).T if hidden else np.eye(len(window.observed))
    )
    # A combination without the newest sample is that of the previous sample again: leave it out.
    directions, values, _ = np.linalg.svd(parity[:, -ny:], full_matrices=False)
    parity = directions[:, values > WINDOW_RANK_TOLERANCE].T @ parity
    first = np.hstack([np.eye(nw), np.zeros((nw, nw * length))])
    return (
        a - window.G @ window.observed,
        noise[0] @ first - window.G @ window.Tw,
        parity @ window.observed,
        parity @ window.Tw,
        window.Mf @ window.observed,
        window.Mf @ window.Tw,
        window.G,
        parity,
        window.Mf,
    )


def _with_reference(core: _Core, reference: Model, alpha: float | None, newest: FloatArray | None) -> _Core:
    """Return the core with the reference model in series with the exact estimates, or, with ``newest``, in parallel.

    ``newest`` selects from w the faults that drive a model in parallel.
    """
    a, b, c, d = reference
    k = len(a)
    if alpha is not None:
        a, b, c, d = cayley(a, b, c, d, alpha)
    A, B, C, D, L, D1, G, V, F = core
    n = len(A)
    if newest is None:
        A = np.block([[A, np.zeros((n, k))], [b @ L, a]])
        B, L, D1, G, F = np.vstack([B, b @ D1]), np.hstack([d @ L, c]), d @ D1, np.vstack([G, -b @ F]), d @ F
    else:
        A, B = block_diag(A, a), np.vstack([B, b @ newest])
        L, D1 = np.hstack([np.zeros((len(d), n)), -c]), -d @ newest
        G, F = np.vstack([G, np.zeros((k, G.shape[1]))]), np.zeros((len(d), G.shape[1]))
    return A, B, np.hstack([C, np.zeros((len(C), k))]), D, L, D1, G, V, F


def _without_unseen(core: _Core, *, modelled: bool, continuous: bool) -> _Core:
    """Return the core without modes that are unobservable from r and e: zeros that the reference model cancels."""
    A, B, C, D, L, D1, G, V, F = core
    for at_infinity in ((True, False) if continuous else (None,)) if modelled else ():
        if not len(A):
            break
        basis = _seen_basis(A, np.vstack([C, L]), at_infinity)
        A, B, C, L, G = basis.T @ A @ basis, basis.T @ B, C @ basis, L @ basis, basis.T @ G
    basis = reachable_basis(A.T, np.hstack([C.T, L.T]))
    return basis.T @ A @ basis, basis.T @ B, C @ basis, D, L @ basis, D1, basis.T @ G, V, F


def _seen_basis(a: FloatArray, outputs: FloatArray, at_infinity: bool | None) -> FloatArray:
    """Return a basis of the states without the unobservable unstable modes.

    ``at_infinity``: remove only modes of infinite (`True`) or of finite (`False`) frequency of a Cayley transform.
    """

    def chosen(x: Any, y: Any = 0.0) -> Any:
        near = np.hypot(x + 1.0, y) <= NEAR_INFINITY
        return (np.hypot(x, y) > EDGE_OF_STABILITY) & (near == at_infinity if at_infinity is not None else True)

    schur, vectors, count = scipy.linalg.schur(a, output="real", sort=chosen)
    if not count:
        return np.eye(len(a))
    own = vectors[:, :count]
    observable = reachable_basis(
        schur[:count, :count].T,
        (outputs @ own).T,
        share=SEEN_SHARE if at_infinity is not False else SEEN_FINITE_SHARE,
        scale=float(np.linalg.norm(outputs)),
    )
    unseen = own @ scipy.linalg.null_space(observable.T) if observable.shape[1] else own
    return np.asarray(scipy.linalg.null_space(unseen.T)) if unseen.shape[1] else np.eye(len(a))


def _with_chain(core: _Core, nw: int, length: int) -> _Core:
    """Return the core with the noise of a window as a chain of delays: samples enter one by one, the oldest first."""
    A, B, C, D, L, D1, G, V, F = core
    if not length:
        return core
    count = nw * length
    chain, enter = np.eye(count, k=nw), np.vstack([np.zeros((count - nw, nw)), np.eye(nw)])
    A = np.block([[A, B[:, :count]], [np.zeros((count, len(A))), chain]])
    return (
        A,
        np.vstack([B[:, count:], enter]),
        np.hstack([C, D[:, :count]]),
        D[:, count:],
        np.hstack([L, D1[:, :count]]),
        D1[:, count:],
        np.vstack([G, np.zeros((count, G.shape[1]))]),
        V,
        F,
    )

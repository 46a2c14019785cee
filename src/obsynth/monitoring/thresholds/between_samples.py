"""Bounds on the effect of disturbances that move between samples on the residual of a continuous design.

The observer takes outputs as straight lines, which the plant does not follow.  x enters the error by what these miss of
a free motion, as far as it decays: the other modes leave rounding, or there is no bound.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from obsynth.errors import PreconditionError, SpecError
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.continuous import first_order_hold, peak_gain
from obsynth.numerics.outward import lower_text
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.dead_times import delays_in_words, in_samples
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.transformations.elimination import eliminate_algebraic_states
from obsynth.proofs.balls import Ball, rounded_up
from obsynth.proofs.contraction import Contraction, column_norms, prove_contraction
from obsynth.proofs.extended_balls import block
from obsynth.proofs.peak_sums import gathered, interval_pieces, peak_sums
from obsynth.proofs.products import exponential

#: Modes of the plant that decay by less than this exponent in a sample are not followed until they have decayed.
LEAST_EXPONENT = 1e-4

#: Share of the terms of K that counts as rounding.
TERM_ROUNDING = 1e-9

#: Share of the bound that rounding on modes that do not decay may add.
ADDED = 1e-3

#: Share of what a disturbance does to the outputs below which it is held not to reach the residual.
UNREACHED_RESIDUAL = 1e-11

#: Share of its terms that rounding adds to a sum over a record of known length, where no tail has to be bounded.
FINITE = 1e-12


@dataclass(frozen=True, eq=False)
class IntersampleErrorSystem:
    """A design on samples: ``s+ = M s``, ``r = c s``, ``s = [x; eps]`` with the part of x that decays."""

    plant: DescriptorSystem
    dt: float
    M: Ball
    c: FloatArray
    contraction: Contraction | None
    into: Ball  # ``(n + nz, n)``: how q enters s
    first: FloatArray  # how ``y`` of a sample enters s at that sample
    second: FloatArray  # the same at the next sample
    direct: FloatArray
    rows: slice
    lasting_gain: float  # what modes that do not decay add per unit of each state, at most

    @classmethod
    def of(
        cls,
        plant: DescriptorSystem,
        observer: LinearObserver,
        tracking: FloatArray,
        dt: float,
        *,
        rows: slice,
        endless: bool = True,
    ) -> IntersampleErrorSystem:
        """Return the design at samples ``dt`` apart, for ``tracking V (nz, nx)``; raise `SpecError` without a bound.
        Without ``endless`` a record of known length is bounded whether or not anything decays."""
        try:
            done = eliminate_algebraic_states(plant)
        except PreconditionError as error:
            raise SpecError(
                f"The residual at the samples has no bound: {error} Where rates of disturbances reach the outputs no "
                "bound on the disturbances is one on the residual; use a statistical monitor (chi-square or cusum).",
                path="monitor",
            ) from error
        smooth, exact = done.plant, Ball.exact
        t = np.asarray(tracking @ (plant.E @ done.recovery.from_state))
        az, g0, g1 = first_order_hold(observer.Az, observer.By, dt)
        phi, c = exponential(smooth.A, dt), exact(smooth.C)
        earlier, ramp = exact(g0) - exact(g1), exact(g1) @ c
        # eps+ = Az eps + K x + (G1 C - T) q + (G0 - G1) Dd d + G1 Dd d+, r = Cz eps + J x + Dy Dd d: K is what straight
        # lines miss of a free motion of the plant, of third order in dt, and zero for constants and ramps.
        k = exact(az) @ exact(t) + earlier @ c + ramp @ phi - exact(t) @ phi
        j = exact(observer.Cz[rows]) @ exact(t) + exact(observer.Dy[rows]) @ c
        terms = np.abs(az) @ np.abs(t) + (np.abs(g0) + 2.0 * np.abs(g1)) @ np.abs(smooth.C) + np.abs(t)
        into = exact(g1) @ c - exact(t)

        def split(projector: FloatArray, *, decays: bool) -> IntersampleErrorSystem:
            parts = _split(phi, k, j, into, projector, az, observer.Cz[rows], endless=decays)
            return cls(smooth, dt, *parts[:4], g1, earlier.midpoint, observer.Dy[rows], rows, parts[4])

        try:
            return split(_onto_decaying_modes(smooth, dt, k, terms), decays=True)
        except SpecError:
            if endless:
                raise
            return split(np.eye(smooth.nx), decays=False)

    @classmethod
    def of_sampled(
        cls,
        written: DescriptorSystem,
        plant: DescriptorSystem,
        observer: LinearObserver,
        tracking: FloatArray,
        *,
        rows: slice,
    ) -> IntersampleErrorSystem:
        """Return a design for a sampled plant, with states of ``written``: ``eps+ = Az eps - T q + By Dd d``."""
        smooth = eliminate_algebraic_states(written).plant
        _require_readings_at_samples(smooth, plant.dt)
        # Samples of delayed signals are states that a disturbance reaches a sample later.
        tracking = tracking[:, : smooth.nx]
        n, nz, exact = smooth.nx, observer.order, Ball.exact
        m = block([[exact(np.zeros((n, n))), exact(np.zeros((n, nz)))], [exact(np.zeros((nz, n))), exact(observer.Az)]])
        c = np.hstack([np.zeros((len(observer.Cz[rows]), n)), observer.Cz[rows]])
        into = Ball.exact(np.vstack([np.zeros((n, n)), -tracking]))
        return cls(
            smooth,
            plant.dt,
            m,
            c,
            prove_contraction(m, discrete=True),
            into,
            np.zeros((nz, plant.ny)),
            observer.By,
            observer.Dy[rows],
            rows,
            0.0,
        )

    @cached_property
    def per_unit(self) -> FloatArray:
        """What each disturbance does to a residual in the long run, per unit of its bound ``(nd,)``."""
        return self.of_disturbances(np.ones(self.plant.nd), 1)[1]

    @property
    def reached(self) -> np.ndarray:
        """Which disturbances reach the residual beyond rounding ``(nd,)``."""
        a, b = self.plant.A, self.plant.Bd
        held = np.abs(self.plant.C) @ (np.abs(b) * self.dt + np.abs(a @ b) * self.dt**2) + np.abs(self.plant.Dd)
        scale = np.abs(self.direct) @ held + np.abs(self.c[:, len(a) :]) @ (np.abs(self.second) @ held)
        return np.asarray(self.per_unit > UNREACHED_RESIDUAL * np.linalg.norm(scale, axis=0))

    def of_disturbances(self, sizes: FloatArray, steps: int) -> tuple[FloatArray, FloatArray]:
        """Return the bounds at samples ``0 .. steps - 1``, and for ever ``(nd,)``, for ``|d_i(t)| <= sizes_i``."""
        plant, count = self.plant, self.plant.nd
        if not count:
            return np.zeros(steps), np.zeros(0)
        pieces = interval_pieces(plant.A, plant.Bd, self.into, self.dt)
        partial, for_ever = self._sums(pieces.columns, steps)
        # What the values at the samples do: at once, by later samples, and by all.
        above = np.zeros((len(plant.A), count))
        now, later = np.vstack([above, self.first @ plant.Dd]), Ball.exact(np.vstack([above, self.second @ plant.Dd]))
        at_once = column_norms(Ball.exact(self.direct) @ Ball.exact(plant.Dd) + Ball.exact(self.c) @ Ball.exact(now))
        by_later, by_all = self._sums(self.M @ Ball.exact(now) + later, steps)
        table = gathered(pieces, partial, count)[: max(steps - 1, 0)] + by_later[: max(steps - 1, 0)]
        per_unit = gathered(pieces, for_ever, count) + by_all + at_once
        # A disturbance that is zero does nothing, even where one that is not has no bound.
        for_ever = rounded_up(np.multiply(per_unit, sizes, out=np.zeros(count), where=sizes > 0.0), 6)
        earlier = np.vstack([np.zeros((1, count)), table])[:steps]
        return np.asarray(rounded_up(np.sum((earlier + at_once) * sizes, axis=1), count + 6)), np.asarray(for_ever)

    def of_process_noise(self, columns: FloatArray, steps: int) -> tuple[FloatArray, FloatArray]:
        """Return the same for what is gathered in each sample, columns ``(n, m)`` of x of at most one each."""
        if not columns.shape[1]:
            return np.zeros(steps), np.zeros(0)
        partial, for_ever = self._sums(self.into @ Ball.exact(columns), steps)
        earlier = np.vstack([np.zeros((1, columns.shape[1])), partial])[:steps]
        return np.asarray(np.sum(earlier, axis=1)), np.asarray(for_ever)

    def _sums(self, columns: Ball, steps: int) -> tuple[FloatArray, FloatArray]:
        if self.contraction is not None:
            return peak_sums(self.M, self.c, columns, self.contraction, least=steps)
        rows, terms = self.c, []
        size = np.abs(columns.midpoint) + columns.radius
        for _ in range(max(steps, 1)):
            rounding = FINITE * np.linalg.norm(np.abs(rows) @ size, axis=0)
            terms.append(np.linalg.norm(rows @ columns.midpoint, axis=0) + rounding)
            rows = rows @ self.M.midpoint
        partial = np.cumsum(np.array(terms), axis=0)
        return partial, np.full(partial.shape[1], np.inf)

    def input_response(self, observer: LinearObserver) -> InputResponse:
        """Return what known inputs do to what is watched: held between samples, or in straight lines."""
        plant, n = self.plant, self.plant.nx
        _, held, ramp = first_order_hold(plant.A, plant.B, self.dt)
        _, u0, u1 = first_order_hold(observer.Az, observer.Bu, self.dt)
        _, y0, y1 = first_order_hold(observer.Az, observer.By, self.dt)
        into, own = self.into.midpoint, np.zeros((n, plant.nu))
        before = np.vstack([own, u0 + y0 @ plant.D]) + into @ held
        rise = np.vstack([own, u1 + y1 @ plant.D])
        return InputResponse(self.M.midpoint, self.c, before, (rise, rise + into @ ramp))

    def lasting_words(self, limit: float) -> str:
        """Return what to say of modes that do not decay: up to which state rounding on them does not matter."""
        if not self.lasting_gain > 0.0 or not np.isfinite(limit):
            return ""
        return f"; while no state of the plant exceeds {lower_text(ADDED * limit / self.lasting_gain, 2)} in its unit"

    def at_any_stamps(self, sizes: FloatArray, observer: LinearObserver) -> float:
        """Return what straight lines between outputs add at any stamps at most ``dt`` apart; may be infinite."""
        plant, h = self.plant, self.dt
        if not plant.nd:
            return 0.0
        projector = _dying(plant.A, h)
        if projector is None:
            return np.inf
        lasting = np.eye(plant.nx) - projector
        second = plant.C @ plant.A @ plant.A
        if np.any(np.abs(second @ lasting) > TERM_ROUNDING * (np.abs(second) @ np.abs(lasting))):
            return np.inf
        # The modes that last are straight: they are moved to where they decay, and nothing enters them.
        stable = plant.A @ projector - lasting
        bent = np.array([np.sum(peak_gain(stable, projector @ plant.Bd * sizes, row[None])) for row in second])
        slope, turn = np.abs(plant.C @ plant.Bd) @ sizes, np.abs(plant.C @ plant.A @ plant.Bd) @ sizes
        missed = 0.25 * h * (2.0 * slope + h * (bent + turn)) + 2.0 * np.abs(plant.Dd) @ sizes
        return float(peak_gain(observer.Az, observer.By, observer.Cz[self.rows]) @ missed)


@dataclass(frozen=True, eq=False)
class InputResponse:
    """``s+ = M s + before u + rise (u+ - u)``, ``r = c s``, for a rise of two kinds: a step, and a line."""

    M: FloatArray
    c: FloatArray
    before: FloatArray
    rises: tuple[FloatArray, FloatArray]

    def start(self) -> FloatArray:
        """Return the states of both kinds, at rest ``(2, n)``."""
        return np.zeros((2, len(self.M)))

    def advanced(self, states: FloatArray, u: FloatArray, after: FloatArray) -> FloatArray:
        """Return the states one sample later, for inputs ``u (nu)`` and those of the next sample."""
        pairs = zip(states, self.rises, strict=True)
        return np.array([self.M @ s + self.before @ u + rise @ (after - u) for s, rise in pairs])

    def size(self, states: FloatArray) -> float:
        """Return the larger of what both kinds do to the norm of what is watched."""
        return float(np.max(np.linalg.norm(states @ self.c.T, axis=1), initial=0.0))


def _onto_decaying_modes(plant: DescriptorSystem, dt: float, k: Ball, terms: FloatArray) -> FloatArray:
    """Return the projector ``(n, n)`` onto the modes of a plant that decay; raise where others are not straight."""
    n = plant.nx
    if not np.any(np.abs(k.midpoint) + k.radius > TERM_ROUNDING * terms):
        return np.zeros((n, n))
    projector = _dying(plant.A, dt)
    lasting = np.eye(n) if projector is None else np.eye(n) - projector
    missed = np.abs(k.midpoint @ lasting)
    if np.any(missed > TERM_ROUNDING * (terms @ np.abs(lasting))):
        slow = np.linalg.eigvals(plant.A)
        slow = slow[slow.real > -LEAST_EXPONENT / dt]
        pole = complex(slow[int(np.argmax(np.abs(slow)))]) if slow.size else 0j
        raise SpecError(
            f"The residual at the samples has no bound: the plant's mode at {pole:.4g} 1/s does not decay, and its "
            "outputs are not straight between samples, as the observer takes them. Sample the plant first "
            "(transform.sample_time) and design for the samples, sample faster, or use a statistical monitor.",
            path="sample_time",
        )
    return np.zeros((n, n)) if projector is None else projector


def _dying(a: FloatArray, dt: float) -> FloatArray | None:
    """Return the projector ``(n, n)`` onto the modes that decay, along the others; ``None`` where there are none."""
    from scipy.linalg import schur, solve_sylvester

    n = len(a)
    form, basis, lasting = schur(a, sort=lambda re, im=0.0: re > -LEAST_EXPONENT / dt, output="real")
    if lasting == n:
        return None
    if not lasting:
        return np.eye(n)
    coupling = solve_sylvester(form[:lasting, :lasting], -form[lasting:, lasting:], -form[:lasting, lasting:])
    # x = Z [y1; y2]; the lasting part is y1 - X y2 along the first columns.
    return np.asarray(np.eye(n) - basis[:, :lasting] @ np.hstack([np.eye(lasting), -coupling]) @ basis.T)


def _split(
    phi: Ball, k: Ball, j: Ball, into: Ball, onto_followed: FloatArray, az: FloatArray, cz: FloatArray, *, endless: bool
) -> tuple[Ball, FloatArray, Contraction | None, Ball, float]:
    """Return ``M, c, contraction, into`` and the gain of the modes left out.

    ``onto_followed (n, n)`` is the projector onto the modes that are followed."""
    n, exact = len(onto_followed), Ball.exact
    followed = onto_followed.any()
    projector, lasting = exact(onto_followed), exact(np.eye(n)) - exact(onto_followed)
    moving = phi @ projector
    m = block([[moving, exact(np.zeros((n, len(az))))], [k if followed else exact(np.zeros(k.shape)), exact(az)]])
    c = np.hstack([j.midpoint if followed else np.zeros(j.shape), cz])
    contraction = prove_contraction(m, discrete=True) if endless else None
    if contraction is None and endless:
        raise SpecError(
            "The residual at the samples has no bound that double precision could prove: the observer, or a mode of "
            "the plant that is not straight between samples, decays too slowly. Sample the plant first "
            "(transform.sample_time), or use a statistical monitor.",
            path="sample_time",
        )
    # What the split misses, and the modes that it leaves: driven by the state, whatever it is.
    defect = projector @ phi - moving @ projector if followed else exact(np.zeros((n, n)))
    remainder = block([[defect], [k @ lasting if followed else k]])
    direct = j @ lasting if followed else j
    sizes = np.abs(direct.midpoint) + (direct.radius + (j.radius if followed else 0.0))
    driven = np.zeros_like(sizes) if contraction is None else contraction.gain(c, remainder.midpoint, remainder.radius)
    remaining_gain = float(np.linalg.norm(np.sum(rounded_up(driven + sizes, 4), axis=1)))
    return m, c, contraction, block([[projector], [into]]), remaining_gain


def _require_readings_at_samples(smooth: DescriptorSystem, step: float) -> None:
    """Raise `SpecError` where a disturbance between samples reaches the reading of a delayed output at once."""
    late = {name: delay for name, delay in smooth.delays.items() if name in smooth.output_names}
    rows = [smooth.output_names.index(name) for name in late]
    broken = {name: delay for name, delay in late.items() if in_samples(delay, step)[1]}
    if broken or np.any(smooth.Dd[rows]):
        why = "is no whole number of samples" if broken else "is of a reading that an unknown input reaches directly"
        raise SpecError(
            f"No threshold is known for disturbances that move between samples where a delay {why} "
            f"({delays_in_words(broken or late)}): choose a sample_time of which the delays are multiples, or measure "
            "something else.",
            path="delays",
        )

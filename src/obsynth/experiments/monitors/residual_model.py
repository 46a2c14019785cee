"""What reaches the residual of a design when nothing is wrong: ``e = V E x - z`` at the samples.

``e+ = Phi e + Gamma d + w - By_h n``, ``r = -C e + Dd d + Dy_h n``, ``e(0) = V E x(0) - z(0) + Gamma_1 n(0)``: held
d, process noise w gathered over an interval, sensor noise n.

Bounds of the norm of a residual, or of a window of it: the paper's, and such as are never passed without a fault.

For records of known length, and of any length: a table for the start, and one number for ever after.

The covariance of a window of residuals, and what whitens it: only innovations are white as they are.

What disturbances of any time course do to the residual of a continuous design at the samples of its data, from
above.

The observer takes outputs as straight lines, which the plant does not follow.  x enters the error by what these miss of
a free motion, as far as it decays: the other modes leave rounding, or there is no bound.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple, TypeAlias, cast

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from obsynth.analysis.transformations.linear_plants import discretise, eliminate_algebraic_states
from obsynth.errors import PreconditionError, SpecError
from obsynth.methods.registry import error_model
from obsynth.numerics.arguments import FloatArray, largest_singular_value
from obsynth.numerics.continuous import first_order_hold, peak_gain
from obsynth.numerics.matrix_equations import continuous_lyapunov
from obsynth.numerics.norms import hinf_norm, output_covariance, spectral_radius, state_units
from obsynth.numerics.ranks import CANCELLATION_TOLERANCE
from obsynth.observers.linear.observer import LinearObserver, sample_observer
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.proofs.balls import Ball, block, rounded_up
from obsynth.proofs.contraction import (
    Contraction,
    column_norms,
    gathered,
    interval_pieces,
    peak_sums,
    prove_contraction,
)
from obsynth.proofs.products import exponential
from obsynth.results.design import ObserverDesign
from obsynth.simulation.scenario import Additive, Random, Scenario, ScenarioSignals, observer_start, resolve
from obsynth.verification.error_structure import OUTWARD
from obsynth.verification.error_system import ErrorModel

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
class BetweenSamples:
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
    left: float  # what modes that do not decay add per unit of each state, at most

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
    ) -> BetweenSamples:
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

        def split(kept: FloatArray, *, decays: bool) -> BetweenSamples:
            found = _split(phi, k, j, into, kept, az, observer.Cz[rows], endless=decays)
            return cls(smooth, dt, *found[:4], g1, earlier.midpoint, observer.Dy[rows], rows, found[4])

        try:
            return split(_kept(smooth, dt, k, terms), decays=True)
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
    ) -> BetweenSamples:
        """Return a design for a sampled plant, with states of ``written``: ``eps+ = Az eps - T q + By Dd d``."""
        smooth = eliminate_algebraic_states(written).plant
        n, nz, exact = smooth.nx, observer.order, Ball.exact
        m = block([[exact(np.zeros((n, n))), exact(np.zeros((n, nz)))], [exact(np.zeros((nz, n))), exact(observer.Az)]])
        shown = np.hstack([np.zeros((len(observer.Cz[rows]), n)), observer.Cz[rows]])
        into = Ball.exact(np.vstack([np.zeros((n, n)), -tracking]))
        return cls(
            smooth,
            plant.dt,
            m,
            shown,
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
        partial, whole = self._sums(pieces.columns, steps)
        # What the values at the samples do: at once, by later samples, and by all.
        above = np.zeros((len(plant.A), count))
        now, later = np.vstack([above, self.first @ plant.Dd]), Ball.exact(np.vstack([above, self.second @ plant.Dd]))
        at_once = column_norms(Ball.exact(self.direct) @ Ball.exact(plant.Dd) + Ball.exact(self.c) @ Ball.exact(now))
        by_later, by_all = self._sums(self.M @ Ball.exact(now) + later, steps)
        table = gathered(pieces, partial, count)[: max(steps - 1, 0)] + by_later[: max(steps - 1, 0)]
        whole = rounded_up((gathered(pieces, whole, count) + by_all + at_once) * sizes, 6)
        earlier = np.vstack([np.zeros((1, count)), table])[:steps]
        return np.asarray(rounded_up(np.sum((earlier + at_once) * sizes, axis=1), count + 6)), np.asarray(whole)

    def of_process_noise(self, columns: FloatArray, steps: int) -> tuple[FloatArray, FloatArray]:
        """Return the same for what is gathered in each sample, columns ``(n, m)`` of x of at most one each."""
        if not columns.shape[1]:
            return np.zeros(steps), np.zeros(0)
        partial, whole = self._sums(self.into @ Ball.exact(columns), steps)
        earlier = np.vstack([np.zeros((1, columns.shape[1])), partial])[:steps]
        return np.asarray(np.sum(earlier, axis=1)), np.asarray(whole)

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
        if not self.left > 0.0 or not np.isfinite(limit):
            return ""
        return f"; while no state of the plant exceeds {ADDED * limit / self.left:.2g} in its unit"

    def at_any_stamps(self, sizes: FloatArray, observer: LinearObserver) -> float:
        """Return what straight lines between outputs add at any stamps at most ``dt`` apart; may be infinite."""
        plant, h = self.plant, self.dt
        if not plant.nd:
            return 0.0
        projector = _dying(plant.A, h)
        if projector is None:
            return np.inf
        others = np.eye(plant.nx) - projector
        second = plant.C @ plant.A @ plant.A
        if np.any(np.abs(second @ others) > TERM_ROUNDING * (np.abs(second) @ np.abs(others))):
            return np.inf
        # The modes that last are straight: they are moved to where they decay, and nothing enters them.
        stable = plant.A @ projector - others
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


def _kept(plant: DescriptorSystem, dt: float, k: Ball, terms: FloatArray) -> FloatArray:
    """Return the projector ``(n, n)`` onto the modes of a plant that decay; raise where others are not straight."""
    n = plant.nx
    if not np.any(np.abs(k.midpoint) + k.radius > TERM_ROUNDING * terms):
        return np.zeros((n, n))
    projector = _dying(plant.A, dt)
    others = np.eye(n) if projector is None else np.eye(n) - projector
    missed = np.abs(k.midpoint @ others)
    if np.any(missed > TERM_ROUNDING * (terms @ np.abs(others))):
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
    phi: Ball, k: Ball, j: Ball, into: Ball, kept: FloatArray, az: FloatArray, cz: FloatArray, *, endless: bool
) -> tuple[Ball, FloatArray, Contraction | None, Ball, float]:
    """Return ``M, c, contraction, into, left`` for the projector ``kept (n, n)`` onto the modes that are followed."""
    n, exact = len(kept), Ball.exact
    followed = kept.any()
    projector, others = exact(kept), exact(np.eye(n)) - exact(kept)
    moving = phi @ projector
    m = block([[moving, exact(np.zeros((n, len(az))))], [k if followed else exact(np.zeros(k.shape)), exact(az)]])
    shown = np.hstack([j.midpoint if followed else np.zeros(j.shape), cz])
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
    rest = block([[defect], [k @ others if followed else k]])
    direct = j @ others if followed else j
    sizes = np.abs(direct.midpoint) + (direct.radius + (j.radius if followed else 0.0))
    driven = np.zeros_like(sizes) if contraction is None else contraction.gain(shown, rest.midpoint, rest.radius)
    left = float(np.linalg.norm(np.sum(rounded_up(driven + sizes, 4), axis=1)))
    return m, shown, contraction, block([[projector], [into]]), left


def schur_form(matrix: FloatArray) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return ``T, Q`` with ``A = Q T Q'``, T triangular (complex): its powers keep the eigenvalues, however large
    entries of A are that cancel."""
    if not matrix.size:
        return matrix, matrix
    from scipy.linalg import schur

    triangular, basis = schur(matrix, output="complex")
    return triangular, basis


@dataclass(frozen=True, eq=False)
class ResidualModel:
    """``e+ = A e + Bd d + Bw w``, ``r = C e + Dd d + Dw w`` at the samples, without faults, w of unit covariance."""

    A: FloatArray
    C: FloatArray
    Bd: FloatArray
    Dd: FloatArray
    Bw: FloatArray
    Dw: FloatArray
    fault_C: FloatArray
    fault_Dd: FloatArray
    fault_Dw: FloatArray
    steps: int
    start: FloatArray  # ``(n,)``: e there
    bounds: FloatArray  # ``(nd,)``: largest absolute values of disturbances, or infinite
    means: FloatArray  # ``(nd,)``: of what is random in them, as deviations
    deviations: FloatArray
    steady: tuple[bool, ...]  # nothing but what is random, all the time
    errors: ErrorModel  # with the noise of the scenario
    continuous: ContinuousDesign | None = None
    sampled: BetweenSamples | None = None  # of a plant on samples, where the continuous one behind it is known

    @property
    def initial_error(self) -> float:
        """Norm of e at the start of the scenario."""
        return float(np.linalg.norm(self.start))

    def powers(self) -> list[FloatArray]:
        """Return ``A^k`` for every sample."""
        triangular, basis = schur_form(self.A)
        power = np.eye(len(self.A), dtype=triangular.dtype)
        found: list[FloatArray] = []
        while len(found) < self.steps:
            found.append(np.asarray((basis @ power @ basis.conj().T).real))
            power = np.triu(power @ triangular)
        return found

    @property
    def noisy(self) -> bool:
        """Whether white noise reaches the residual."""
        return bool(self.Bw.any() or self.Dw.any())

    def fault_scales(self) -> FloatArray:
        """Return ``(nf,)``: deviations of the fault estimates, for disturbances of theirs, or of half their bound."""
        known = np.where(np.isfinite(self.bounds), self.bounds, 0.0) / 2.0
        sizes = np.where(self.deviations > 0.0, self.deviations, known)
        covariance = output_covariance(
            self.A,
            np.hstack([self.Bd * sizes, self.Bw]),
            self.fault_C,
            np.hstack([self.fault_Dd * sizes, self.fault_Dw]),
        )
        scales = np.sqrt(np.abs(np.diag(covariance)))
        largest = float(np.max(scales, initial=0.0))
        # What nothing disturbs is compared as it is, in the units of what is disturbed most.
        return np.where(scales > 0.0, scales, largest if largest > 0.0 else 1.0)


@dataclass(frozen=True, eq=False)
class ContinuousDesign:
    """The errors of a continuous design from sample to sample, by the recursion of the module's text, w sensors first;
    and what a bound at the samples is made of; ``rows`` are watched; ``endless``: the record may have any length."""

    errors: ErrorModel
    dt: float
    rows: slice
    endless: bool

    @property
    def plant(self) -> DescriptorSystem:
        """The plant, with the noise of the scenario."""
        return self.errors.plant

    @property
    def observer(self) -> LinearObserver:
        """The observer, in continuous time."""
        return self.errors.observer

    @cached_property
    def between(self) -> BetweenSamples:
        """The design on samples; raises `SpecError` where what is watched has no bound."""
        return BetweenSamples.of(
            self.plant, self.observer, self.errors.own, self.dt, rows=self.rows, endless=self.endless
        )

    def gathered_noise(self, smooth: DescriptorSystem) -> FloatArray:
        """Return a factor ``(n, m)`` of what process noise adds to the states of the plant in a sample."""
        process = smooth.Bw[:, smooth.Bw.any(axis=0)]
        return _gathered(smooth.A, process, self.dt) if process.shape[1] else np.zeros((smooth.nx, 0))

    @cached_property
    def recursion(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Matrices of e, d and w in ``e+``."""
        process = self.plant.Bw.any(axis=0)
        if (process & self.sensors).any():
            raise SpecError(
                "One noise acts on the plant and on a sensor, which has no model between samples: state two.",
                path="noise",
            )
        transition, held, _ = first_order_hold(self.observer.Az, self.errors.disturbance, self.dt)
        measured = -sample_observer(self.observer, self.dt).By @ self.plant.Dw[:, self.sensors]
        gathered = _gathered(self.observer.Az, self.errors.noise[:, process], self.dt)
        return transition, held, np.hstack([measured, gathered])

    @property
    def sensors(self) -> NDArray[np.bool_]:
        """Which noise acts on sensors ``(nw,)``."""
        return np.asarray(self.plant.Dw.any(axis=0))

    def direct(self, rows: slice) -> FloatArray:
        """Return the direct effect of w on some rows of output at a sample."""
        shown = sample_observer(self.observer, self.dt).Dy[rows] @ self.plant.Dw[:, self.sensors]
        return np.hstack([shown, np.zeros((len(shown), self.recursion[2].shape[1] - shown.shape[1]))])

    @property
    def start_noise(self) -> FloatArray:
        """From the noise of the first sample to e ``(n, sensors)``."""
        ramp = first_order_hold(self.observer.Az, self.observer.By, self.dt)[2]
        return np.asarray(ramp @ self.plant.Dw[:, self.sensors])

    @property
    def sensor_noise(self) -> tuple[FloatArray, FloatArray]:
        """From noise drawn as straight lines between samples, to e' and to what is watched."""
        return self.errors.noise[:, self.sensors], self.errors.output(self.rows)[3][:, self.sensors]


def _gathered(A: FloatArray, noise: FloatArray, dt: float) -> FloatArray:
    """Return a factor of what noise ``(n, m)`` adds to states in a sample."""
    whole = DescriptorSystem(None, A, C=np.eye(len(A)), Bw=noise)
    return np.asarray(discretise(whole, dt).plant.Bw)


def watches_estimates(design: ObserverDesign) -> bool:
    """Whether the fault estimates are watched, as the residual is made not to see the faults that are modelled."""
    return "Phi" in design.certificate.matrices and bool(design.linear[1].fault_names)


def noisy_plant(plant: DescriptorSystem, scenario: Scenario, drive: ScenarioSignals) -> DescriptorSystem:
    """Return a plant with the noise of a scenario: its own, as often, and that of the sensors."""
    return plant.replace(
        Bw=np.hstack([scenario.noise * plant.Bw, np.zeros((plant.nx, plant.ny))]),
        Dw=np.hstack([scenario.noise * plant.Dw, np.diag(drive.deviations)]),
        noise_names=None,
    )


def residual_model(
    design: ObserverDesign, scenario: Scenario, *, endless: bool = False, estimates: bool = False
) -> ResidualModel:
    """Return the model of a design's residual on a scenario, or of its fault ``estimates``, zero but for errors."""
    plant, observer = design.linear
    drive = resolve(plant, scenario)
    noisy = noisy_plant(plant, scenario, drive)
    if not observer.residual_names:
        raise SpecError(f"Design {design.name!r} has no residual to monitor.", path="observer")
    errors = replace(error_model(design), plant=noisy)
    start = np.array([scenario.initial_state.get(name, 0.0) for name in plant.state_names])
    initial = errors.own @ (plant.E @ start) - observer_start(scenario, observer.order)
    shown, _, direct_d, direct_w = errors.fault_output if estimates else errors.residual_output
    rows = observer.fault_rows if estimates else observer.residual_rows
    faults, _, faults_d, faults_w = errors.fault_output
    bounds, means, deviations, steady = _disturbances(scenario, plant.disturbance_names, drive.steps, drive.dt)
    a, driven, noise, continuous = errors.Az, errors.disturbance, errors.noise, None
    if not plant.is_discrete:
        continuous = ContinuousDesign(errors, drive.dt, rows, endless)
        a, driven, noise = continuous.recursion
        direct_w, faults_w = continuous.direct(rows), continuous.direct(observer.fault_rows)
    between = None
    if plant.is_discrete and plant.nd and design.source is not None and design.source.sample_time is not None:
        between = BetweenSamples.of_sampled(design.source.plant, plant, observer, errors.own, rows=rows)
    return ResidualModel(
        a,
        -shown,
        driven,
        direct_d,
        noise,
        direct_w,
        -faults,
        faults_d,
        faults_w,
        drive.steps,
        initial,
        bounds,
        means,
        deviations,
        steady,
        errors,
        continuous,
        between,
    )


def largest_disturbances(scenario: Scenario, names: tuple[str, ...], steps: int, dt: float) -> FloatArray:
    """Return the largest absolute value of each disturbance of a scenario; infinite where it has none."""
    return _disturbances(scenario, names, steps, dt)[0]


def _disturbances(
    scenario: Scenario, names: tuple[str, ...], steps: int, dt: float
) -> tuple[FloatArray, FloatArray, FloatArray, tuple[bool, ...]]:
    totals, steady = np.zeros((3, len(names))), []
    for i, name in enumerate(names):
        fixed, calm = np.zeros(steps), True
        for profile in scenario.disturbances.get(name, ()):  # type: ignore[union-attr]
            if isinstance(profile, Random):
                calm &= bool(profile.active(steps, dt).all())
                totals[:, i] += profile.moments()
            else:
                fixed, calm = fixed + cast(Additive, profile).sampled(steps, dt)[0], False
        totals[0, i] += np.max(np.abs(fixed))
        steady.append(calm)
    return totals[0], totals[1], np.sqrt(totals[2]), tuple(steady)


class ScaledInputs(NamedTuple):
    """What drives a residual, each input scaled to at most one: ``B (n, m)``, ``D (nr, m)`` from sample to sample."""

    B: FloatArray
    D: FloatArray
    between: FloatArray  # ``(steps,)``: what signals that do anything between samples add to the norm
    limit: float  # what they add later, at most
    start: FloatArray  # ``(n, any)``: inputs of the first sample alone, straight to the error


def scaled_inputs(
    model: ResidualModel,
    bounds: FloatArray,
    noise_bound: float | None,
    disturbances: Sequence[str],
    *,
    any_stamps: bool = False,
) -> ScaledInputs:
    """Return what drives the residual, with every input scaled to at most one in absolute value; ``bounds (nd,)``."""
    continuous = model.continuous
    between = None if continuous is None else continuous.between
    sampled = np.any(model.Bd != 0.0, axis=0) | np.any(model.Dd != 0.0, axis=0)
    reached = sampled if between is None else between.reached
    if np.any(lacking := reached & ~np.isfinite(bounds)):
        names = ", ".join(disturbances[int(i)] for i in np.flatnonzero(lacking))
        raise SpecError(
            f"No bound is given on {names} (a Gaussian disturbance has none): give disturbance_bounds (--disturbance), "
            "or use a statistical threshold.",
            path="disturbance_bounds",
        )
    if model.noisy and noise_bound is None:
        raise SpecError(
            "Gaussian noise has no pointwise bound: state noise_bound (--noise-bound), the number of standard "
            "deviations that yours never exceeds, or use a statistical threshold (chi-square or cusum).",
            path="noise_bound",
        )
    sizes = np.where(reached, bounds, 0.0)
    factor = 0.0 if noise_bound is None else noise_bound
    none = np.zeros((len(model.A), 0))
    if model.sampled is not None:
        table, limits = model.sampled.of_disturbances(sizes, model.steps)
        return ScaledInputs(factor * model.Bw, factor * model.Dw, table, float(np.sum(limits)), none)
    if between is None or continuous is None:
        b, d = np.hstack([model.Bd * sizes, factor * model.Bw]), np.hstack([model.Dd * sizes, factor * model.Dw])
        return ScaledInputs(b, d, np.zeros(model.steps), 0.0, none)
    if any_stamps:
        return _at_any_stamps(model, continuous, sizes, factor)
    count = int(continuous.sensors.sum())
    process = factor * continuous.gathered_noise(between.plant)
    table, limits = between.of_disturbances(sizes, model.steps)
    noise, noise_limits = between.of_process_noise(process, model.steps)
    limit, start = float(np.sum(limits) + np.sum(noise_limits)), factor * continuous.start_noise
    return ScaledInputs(factor * model.Bw[:, :count], factor * model.Dw[:, :count], table + noise, limit, start)


def _at_any_stamps(
    model: ResidualModel, continuous: ContinuousDesign, sizes: FloatArray, factor: float
) -> ScaledInputs:
    """Return what drives the residual of a continuous design whose samples may be at any stamps, none further apart."""
    a, driven, (into, direct) = model.errors.Az, model.errors.disturbance, continuous.sensor_noise
    total = float(np.sum(peak_gain(a, driven * sizes, model.C) + np.linalg.norm(model.Dd * sizes, axis=0)))
    total += continuous.between.at_any_stamps(sizes, continuous.observer)
    total += factor * float(np.sum(peak_gain(a, into, model.C) + np.linalg.norm(direct, axis=0)))
    b, d = factor * model.Bw[:, into.shape[1] :], factor * model.Dw[:, into.shape[1] :]
    return ScaledInputs(b, d, np.full(model.steps, total), total, np.zeros((len(a), 0)))


def paper_threshold(model: ResidualModel, bounds: FloatArray, initial_error: float, gamma: float | None) -> FloatArray:
    """Return (66) of Wang et al. 2015 with the norm of the power where the paper has the power of the norm."""
    if model.continuous is not None:
        raise SpecError("Eq. (66) is for discrete designs: use pointwise, or sample the plant first.", path="kind")
    if not np.isfinite(bounds).all():
        raise SpecError("The paper's threshold needs a bound of each disturbance.", path="disturbance_bounds")
    gain = hinf_norm(model.A, model.Bd, model.C, model.Dd).upper if gamma is None else gamma
    decay = np.array([np.linalg.norm(power, 2) for power in model.powers()])
    return np.hypot(gain * float(np.linalg.norm(bounds)), largest_singular_value(model.C) * decay * initial_error)


def pointwise_threshold(model: ResidualModel, inputs: ScaledInputs, initial_error: float) -> FloatArray:
    """Return what the norm of the residual never passes: exact initial-error term and l1 (peak) gains of each input.
    Larger by more than rounding of these sums and of the residual: noise may be at its bounds with the worst signs."""
    powers = model.powers()
    shown = [model.C @ power for power in powers]
    start = np.array([np.linalg.norm(c, 2) for c in shown]) * initial_error
    start += np.array([_columns(c @ inputs.start) for c in shown])
    start += _left_of_powers(model, powers, np.hstack([inputs.start, initial_error * np.eye(len(model.A))]))
    seen = np.array([_columns(c @ inputs.B) for c in shown]) + _left_of_powers(model, powers, inputs.B)
    earlier = np.concatenate([[0.0], np.cumsum(seen)[:-1]])
    return np.asarray((start + earlier + _columns(inputs.D) + inputs.between) * OUTWARD)


def _left_of_powers(model: ResidualModel, powers: list[FloatArray], entering: FloatArray) -> FloatArray:
    """Return what rounding of the powers may hide of columns ``(n, m)`` at each sample, to the first order.

    Where entries of A cancel, powers keep half of their digits.  What ``C A^k`` misses by from one sample to the next
    is found, and moves on by A as everything does.
    """
    if not entering.any():
        return np.zeros(len(powers))
    # In these units what is added up has one size.
    units = state_units(model.A, entering, model.C)
    a, shown = model.A * units / units[:, None], [model.C @ power * units for power in powers]
    share = len(a) * np.finfo(float).eps
    missed = [
        np.linalg.norm(after - before @ a) + share * np.linalg.norm(np.abs(before) @ np.abs(a))
        for before, after in itertools.pairwise(shown)
    ]
    sizes = [_columns(power @ entering / units[:, None]) for power in powers[:-1]]
    return np.concatenate([[0.0], np.convolve(missed, sizes)[: len(missed)]]) if missed else np.zeros(1)


def _columns(matrix: FloatArray) -> float:
    """Return the sum of the norms of columns."""
    return float(np.sum(np.linalg.norm(matrix, axis=0)))


def _stacked_norms(shown: list[FloatArray], window: int) -> FloatArray:
    """Return the spectral norm of every ``window`` successive matrices ``(nr, n)``, one above the other."""
    rows = np.array(shown)
    squares = rows.transpose(0, 2, 1) @ rows
    count = len(squares) - window + 1
    # Added up anew for each window: late ones are far smaller than those before.
    energy = np.sum([squares[j : j + count] for j in range(window)], axis=0)
    return np.asarray(np.sqrt(np.maximum(np.linalg.eigvalsh(energy)[:, -1], 0.0))) if rows.size else np.zeros(count)


def _windowed_sums(values: FloatArray, window: int) -> FloatArray:
    """Return the sum of every ``window`` successive values."""
    return np.asarray(np.sum(sliding_window_view(values, window), axis=-1))


def norms_of_windows(values: FloatArray, window: int) -> FloatArray:
    """Return the norm of the last ``window`` values at each of them, of fewer at the start."""
    return np.array([np.linalg.norm(values[max(k - window + 1, 0) : k + 1]) for k in range(len(values))])


def _stacked_columns(shown: list[FloatArray], left: FloatArray, window: int) -> FloatArray:
    """Return the sum of the norms of the columns of every ``window`` successive matrices, one above the other; what
    rounding hides of each, ``left``, is added."""
    columns = np.array([np.linalg.norm(part, axis=0) for part in shown])
    seen = np.linalg.norm(sliding_window_view(columns, window, axis=0), axis=-1)
    return np.asarray(np.sum(seen, axis=-1) + _windowed_sums(left, window))


def _window_gain(model: ResidualModel, inputs: ScaledInputs) -> tuple[float, int]:
    """Return the l2 gain from the inputs to the residual, and how many of them there are."""
    count = int(np.sum(np.any(inputs.B != 0.0, axis=0) | np.any(inputs.D != 0.0, axis=0)))
    return hinf_norm(model.A, inputs.B, model.C, inputs.D).upper if count else 0.0, count


def window_threshold(model: ResidualModel, inputs: ScaledInputs, initial_error: float, window: int) -> FloatArray:
    """Return what the l2 norm of the residual over the last ``window`` samples never passes.
    Inputs: l2 gain times ``sqrt(window m)``; the error at the start: the root of its energy.  Or the pointwise bounds
    summed up in squares, where less, and for what moves between samples."""
    summed = norms_of_windows(pointwise_threshold(model, inputs, initial_error), window)
    if model.continuous is not None or model.sampled is not None:
        return summed
    powers, (gain, count) = model.powers(), _window_gain(model, inputs)
    shown = [model.C @ power for power in powers]
    # Before the window is full it begins with the record.
    before, length = [np.zeros_like(model.C)] * (window - 1), np.minimum(np.arange(model.steps) + 1, window)
    hidden = _left_of_powers(model, powers, initial_error * np.eye(len(model.A)))
    start = _stacked_norms(before + shown, window) * initial_error
    start += _windowed_sums(np.concatenate([np.zeros(window - 1), hidden]), window)
    earlier = np.zeros(model.steps)
    if window < model.steps:
        left = _left_of_powers(model, powers, inputs.B)
        gathered = np.cumsum(_stacked_columns([part @ inputs.B for part in shown], left, window))
        earlier[window:] = gathered[: model.steps - window]
    bound = (gain * np.sqrt(length * count) + start + earlier) * OUTWARD
    return np.asarray(np.minimum(bound, summed))


#: What is left of an error after the table.
LEFT_AFTER_TABLE = 1e-3
#: Longest table, and most numbers in its powers.
LONGEST_TABLE, MOST_NUMBERS = 16_384, 20_000_000


#: A bound by the number of samples since the start: a table, and a limit for every later one.
UnlimitedHorizonBound: TypeAlias = tuple[FloatArray, float]


def samples_of(transition: FloatArray, window: int) -> int:
    """Return how many samples a table of ``transition (n, n)`` needs until `LEFT_AFTER_TABLE` of a start is left."""
    # Entries that cancel hide the eigenvalues in the powers of a matrix, but not in those of its Schur form.
    power, count = schur_form(transition)[0], 1
    while len(power) and not np.linalg.norm(power, 2) <= LEFT_AFTER_TABLE:
        power, count = np.triu(power @ power), 2 * count
        if count > LONGEST_TABLE or count * power.size > MOST_NUMBERS or not np.isfinite(power).all():
            raise SpecError(
                "Errors of the observer decay too slowly at this sampling for a bound for ever: use a statistical "
                "monitor, or obsynth.monitor for a record of known length.",
                path="monitor",
            )
    return max(count, 1) + window


def unlimited_bound(
    kind: str, model: ResidualModel, inputs: ScaledInputs, initial_error: float, window: int
) -> UnlimitedHorizonBound:
    """Return the pointwise or window bound for records of any length."""
    powers = model.powers()
    last = powers[-1] @ model.A
    left = largest_singular_value(last)
    shown = [largest_singular_value(model.C @ power) for power in powers]
    # Of k = m N + j samples, m N shrink by left^m: inputs of that age, and the start, add no more than this.
    aged = _columns(last @ inputs.B) * sum(shown) / (1.0 - left)
    if not np.isfinite(inputs.limit):
        # What outputs do between stamps that may be anywhere has no bound.
        return np.full(model.steps, np.inf), np.inf
    bare = pointwise_threshold(model, inputs, 0.0)
    pointwise = float(bare[-1] - inputs.between[-1]) + inputs.limit + shown[-1] * _columns(inputs.B) + aged
    begins = initial_error + _columns(inputs.start)
    start = max(shown) * left * begins
    if kind == "pointwise":
        return _start_added(model, bare, initial_error) * OUTWARD, (pointwise + start) * OUTWARD
    table = window_threshold(model, inputs, initial_error, window)
    # No window has more energy than its samples one by one; for a sampled plant its own bound may be smaller.
    # Such a window may begin in the table, where more is left of the start.
    start = max(max(shown[-window:]), max(shown) * left) * begins
    limit = float(np.sqrt(window)) * (pointwise + start) * OUTWARD
    if model.continuous is None and model.sampled is None:
        limit = min(limit, _window_limit(model, inputs, (initial_error, left, last), window))
    return table, limit


def _window_limit(
    model: ResidualModel, inputs: ScaledInputs, start_of: tuple[float, float, FloatArray], window: int
) -> float:
    """Return the l2 bound of a window that begins after the table, see `window_threshold`."""
    (initial_error, left, last), (gain, count) = start_of, _window_gain(model, inputs)
    # A window that begins with the table's last sample ends after it.
    longer = replace(model, steps=model.steps + window - 1)
    powers = longer.powers()
    shown = [model.C @ power for power in powers]
    hidden = _windowed_sums(_left_of_powers(longer, powers, np.eye(len(model.A))), window)
    sizes = _stacked_norms(shown, window) + hidden
    left_of_inputs = _left_of_powers(longer, powers, inputs.B)
    gathered = float(np.sum(_stacked_columns([part @ inputs.B for part in shown], left_of_inputs, window)))
    aged = _columns(last @ inputs.B) * float(np.sum(sizes)) / (1.0 - left)
    start = float(max(np.max(sizes) * left, np.max(sizes[-window:]))) * initial_error
    return (gain * float(np.sqrt(window * count)) + gathered + aged + start) * OUTWARD


def unlimited_paper(
    model: ResidualModel, bounds: FloatArray, initial_error: float, gamma: float | None
) -> UnlimitedHorizonBound:
    """Return (66) of Wang et al. 2015 for records of any length."""
    table = paper_threshold(model, bounds, initial_error, gamma)
    return table, float(table[-1])


def _start_added(model: ResidualModel, bare: FloatArray, initial_error: float) -> FloatArray:
    """Return the bound with the start's; of a continuous design one that holds until the next sample."""
    if model.continuous is None or not initial_error:
        return bare + np.array([np.linalg.norm(model.C @ power, 2) for power in model.powers()]) * initial_error

    # In the norm of a Lyapunov function a free motion never grows.
    a = model.errors.Az
    root = np.linalg.cholesky(continuous_lyapunov(a.T, -np.eye(len(a)))).T
    seen = largest_singular_value(np.linalg.solve(root.T, model.C.T))
    return bare + np.array([seen * np.linalg.norm(root @ power, 2) for power in model.powers()]) * initial_error


#: The initial-condition response has settled when its effect on the residual is below this share of the residual's
#: deviation.
START_EFFECT_SHARE = 0.05
#: A disturbance that moves the residual by less than this share of its noise is decoupled, but for rounding.
NOTHING_FELT = 1e-6
#: Whitened residuals count as white when their correlations sum up to no more than this.
WHITE_CORRELATIONS = 0.01
#: What may be left of a correlation, relative to where it began, when its sum ends; and after how many samples at most.
CORRELATION_LEFT, MOST_LAGS = 1e-9, 200_000


def window_covariance(model: ResidualModel, window: int) -> FloatArray:
    """Return the covariance ``(window nr, window nr)`` of consecutive residuals in steady state, oldest first."""

    def size(b: FloatArray, d: FloatArray) -> FloatArray:
        return np.asarray(np.sqrt(np.abs(np.diag(output_covariance(model.A, b, model.C, d)))))

    # By more than rounding: from most observers some are decoupled.
    noise, sizes = size(model.Bw, model.Dw), np.where(np.isfinite(model.bounds), model.bounds, 1.0)
    reached = [
        bool(np.any(size(model.Bd[:, [j]] * largest, model.Dd[:, [j]] * largest) > NOTHING_FELT * noise))
        for j, largest in enumerate(sizes)
    ]
    if any(bool(hit) and not calm for hit, calm in zip(reached, model.steady, strict=True)):
        raise SpecError(
            "A disturbance that reaches the residual has a part that is not random or does not last: its covariance "
            "is not known. Use pointwise or window.",
            path="disturbances",
        )
    b, d, spread = _driving(model)
    lagged = [model.C @ spread @ model.C.T + d @ d.T]
    ahead = model.A @ spread @ model.C.T + b @ d.T
    for _ in range(window - 1):
        lagged.append(model.C @ ahead)
        ahead = model.A @ ahead
    if not np.max(np.abs(lagged[0]), initial=0.0) > 0.0:
        raise SpecError("No noise reaches the residual: any threshold would be one on rounding errors.", path="noise")
    return np.block([[lagged[i - j] if i >= j else lagged[j - i].T for j in range(window)] for i in range(window)])


def _driving(model: ResidualModel) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return what random disturbances and noise do to error and residual, and the covariance of the error."""
    b = np.hstack([model.Bd * model.deviations, model.Bw])
    d = np.hstack([model.Dd * model.deviations, model.Dw])
    return b, d, output_covariance(model.A, b, np.eye(len(model.A)), np.zeros((len(model.A), b.shape[1])))


def whitener_of(covariance: FloatArray) -> FloatArray:
    """Return ``Wh (rank, n)`` with ``Wh S Wh' = I`` for ``S (n, n)``; directions without any variance are left out."""
    sizes, vectors = np.linalg.eigh((covariance + covariance.T) / 2.0)
    kept = sizes > CANCELLATION_TOLERANCE * max(float(sizes[-1]), np.finfo(np.float64).tiny)
    return np.asarray((vectors[:, kept] / np.sqrt(sizes[kept])).T)


def innovation_whitener(covariance: FloatArray, count: int) -> FloatArray:
    """Return ``Wh (m, n)``: the newest ``count`` residuals less their prediction from the others, white."""
    old = len(covariance) - count
    past = whitener_of(covariance[:old, :old]) if old else np.zeros((0, 0))
    predict = covariance[old:, :old] @ past.T @ past
    error = np.hstack([-predict, np.eye(count)])
    left = error @ covariance @ error.T
    sizes, vectors = np.linalg.eigh((left + left.T) / 2.0)
    kept = sizes > CANCELLATION_TOLERANCE * float(np.max(np.abs(np.diag(covariance))))
    if not kept.any():
        raise SpecError("The newest residual is determined by the older ones: it has no innovation.", path="window")
    return np.asarray((vectors[:, kept] / np.sqrt(sizes[kept])).T @ error)


def correlation_left(model: ResidualModel, window: int, whitener: FloatArray) -> float:
    """Return the norms of all correlations, at every lag, that residuals whitened by a window still have, summed up."""
    count, n = len(model.C), len(model.A)
    covariance = window_covariance(model, 2 * window)
    span = window * count
    near = (whitener @ covariance[j * count : j * count + span, :span] @ whitener.T for j in range(1, window))
    total = float(sum(np.linalg.norm(part, 2) for part in near))
    # Later ones are P A^k Q, k = 0, 1, ...
    b, d, spread = _driving(model)
    ahead = model.A @ spread @ model.C.T + b @ d.T
    blocks = [whitener[:, i * count : (i + 1) * count] for i in range(window)]
    shown, driven = np.zeros((len(whitener), n)), np.zeros((n, len(whitener)))
    for newest, oldest in zip(reversed(blocks), blocks, strict=True):
        shown = shown @ model.A + newest @ model.C
        driven = model.A @ driven + ahead @ oldest.T
    left = CORRELATION_LEFT * float(np.linalg.norm(driven))
    for _ in range(MOST_LAGS):
        total += largest_singular_value(shown @ driven)
        driven = model.A @ driven
        if float(np.linalg.norm(driven)) <= left:
            return total
    raise SpecError("The residual is correlated for too long to be whitened: use chi-square.", path="kind")


def cusum_whitener(model: ResidualModel, window: int) -> tuple[FloatArray, bool]:
    """Return what cumulative sums add up, n samples of no more variance than n, and whether it is white."""
    whitener = innovation_whitener(window_covariance(model, window), len(model.C))
    left = correlation_left(model, window, whitener)
    return whitener / np.sqrt(1.0 + 2.0 * left), left <= WHITE_CORRELATIONS


def whitened(kind: str, model: ResidualModel, window: int) -> tuple[FloatArray, bool]:
    """Return the whitener of ``chi-square`` or ``cusum``, and whether what it makes is white."""
    if kind == "chi-square":
        return whitener_of(window_covariance(model, window)), True
    return cusum_whitener(model, window)


def steady_mean(model: ResidualModel) -> FloatArray:
    """Return the mean ``(nr,)`` of the residual in steady state."""
    state = np.linalg.solve(np.eye(len(model.A)) - model.A, model.Bd @ model.means)
    return np.asarray(model.C @ state + model.Dd @ model.means)


def settled(model: ResidualModel, initial_error: float, window: int) -> int:
    """Return the first sample whose window is free of the start."""
    deviation = float(np.sqrt(np.max(np.diag(window_covariance(model, 1)))))
    # The covariance and the mean have to settle as well, from a start of about the size of their own states.
    spread = _driving(model)[2]
    mean = np.linalg.norm(np.linalg.solve(np.eye(len(model.A)) - model.A, model.Bd @ model.means))
    size = initial_error + float(np.sqrt(np.trace(spread))) + float(mean)
    effects = np.array([np.linalg.norm(model.C @ power, 2) for power in model.powers()]) * size
    late = np.flatnonzero(effects > START_EFFECT_SHARE * deviation)
    first = (int(late[-1]) + 1 if late.size else 0) + window - 1
    if spectral_radius(model.A) >= 1.0 or first >= model.steps:
        raise SpecError(
            f"The initial-condition response has not settled, or fills the window, at the end of {model.steps} "
            "samples: a "
            "statistical threshold needs a longer horizon.",
            path="horizon",
        )
    return first

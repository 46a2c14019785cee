"""Proved lower bound on the gain of every causal filter, by faults and noise that no output has shown so far.

Whatever satisfies the plant's equations with u = 0 and y = 0 up to now is invisible: a causal filter of finite gain,
linear or not, estimates 0, so that its gain is at least the energy ratio of what it misses to the noise.  Here

.. math::
    \\begin{bmatrix} s E - A & -B_h & -B_w \\\\ C & D_h & D_w \\end{bmatrix} v = 0, \\qquad (x, h, w)(t) = v\\, s^t
    \\text{ or } v\\, e^{s t}, \\quad t \\le 0,

for some points s outside the unit circle (right of the axis), h the faults and unknown inputs that the error must not
show; in discrete time some last samples follow one by one, and of index 2 or more some
after now, on which the states of now depend.  The points alone are the witness: each v is enclosed by a
linear solution in ball arithmetic, where s must be a zero by an interval Newton step (Rump 2010, section 13), and the
ratio of one combination is rounded down.  Source: ours.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import flint
import numpy as np

from obsynth.numerics.arrays import ComplexArray, FloatArray
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.proofs.ball_kernels import independent_columns, pivots_of, solution_with_free, solution_with_one_free
from obsynth.proofs.balls import Ball
from obsynth.proofs.complex_balls import (
    adjoint,
    beside,
    columns_of,
    complex_matrix,
    middle,
    padded_with_zeros,
    real_matrix,
    rows_of,
    scaled_columns,
    zeros,
)
from obsynth.proofs.enclosed_solutions import enclosed_solution
from obsynth.verification.energy_ratios import worst_ratio
from obsynth.verification.seen_outputs import (
    Faint,
    Setting,
    hidden_and_bounded,
    with_independent_outputs,
    without_dependent,
)
from obsynth.verification.signals_from_rest import equations_from_rest, signals_from_rest
from obsynth.verification.worst_invisible import Directions, Kernel, Model, Shown, Through, kernel, worst_directions

#: Digits, in bits, that are tried: close points cancel, and more digits do not.
PRECISION_BITS = (256, 768)
#: Newton steps from a zero in double precision to one in all digits, and the half width of the box around it.
NEWTON_STEPS, BOX_BITS = 8, 0.6
#: A bound for all delays is lowered by this share: that covers so many samples of delay.
LIMIT_SHARE, LONGEST_DELAY = 1e-5, 1000
#: A bound of the worst direction of each point is taken where it is this near, as a share, to the ratio that double
#: precision has for it: more would be claimed of no bound.
SAME_RATIO = 1.0 - 1e-9
#: One this near the level is taken as well: double precision may have a ratio above every bound, and all directions of
#: 30 states take half a minute.
NEAR_LEVEL = 1.0 - 3e-8


def proved_least(
    plant: DescriptorSystem,
    points: Sequence[complex],
    samples: int,
    setting: Setting,
    *,
    level: float,
    enough: float | None = None,
) -> float | None:
    """Return a number that the gain of every causal filter reaches, rounded down; ``None`` where nothing is proved.

    Parameters
    ----------
    plant : DescriptorSystem
        As `seen_plant` returns it: its disturbances are those that never reach the error.
    points : sequence of complex
        Outside the unit circle, or right of the imaginary axis: with another one nothing is proved.  Conjugates are
        added.
    samples : int
        Last samples, discrete time, that are free: at least the longest delay.
    setting : Setting
        What the filter must do.
    level : float
        The gain near which the worst combination is looked for; nothing is concluded from it.
    enough : float, optional
        A bound that is enough, by default the level: a combination in double precision that reaches it is taken.
    """
    if plant.is_discrete and samples < max(setting.longest, 1):
        return None
    if not all(_grows(flint.acb(point), plant) for point in points):
        return None
    samples = samples if plant.is_discrete else 0
    plant, faint = without_dependent(plant, setting)
    plant = with_independent_outputs(plant)
    bound = _of_worst_directions(plant, points, samples, setting, level, level if enough is None else enough, faint)
    if bound is not None:
        return bound
    for bits in PRECISION_BITS:
        with flint.ctx.workprec(bits):
            try:
                bound = _Trajectories(plant, points, samples, setting, faint=faint).bound(level, enough)
            except ZeroDivisionError:  # a matrix is singular to these digits
                continue
        if bound is not None:
            return bound
    return None


def _of_worst_directions(
    plant: DescriptorSystem,
    points: Sequence[complex],
    samples: int,
    setting: Setting,
    level: float,
    enough: float,
    faint: Faint | None = None,
) -> float | None:
    """Return the proved ratio of one direction of each point, where it is enough, or near the level or the best one."""
    try:
        directions = _directions(plant, points, samples, setting)
        if directions is None:
            return None
        with flint.ctx.workprec(PRECISION_BITS[0]):
            trajectories = _Trajectories(plant, points, samples, setting, directions=directions, faint=faint)
            bound = trajectories.bound(None, 0.0)
    except (ZeroDivisionError, np.linalg.LinAlgError):
        return None
    needed = enough if enough > 0.0 else min(directions.ratio * SAME_RATIO, level * NEAR_LEVEL)
    return bound if bound is not None and bound >= needed else None


def _directions(
    plant: DescriptorSystem, points: Sequence[complex], samples: int, setting: Setting
) -> Directions | None:
    """Return the worst directions in double precision; ``None`` where points have one signal each, or none."""
    (bh, dh), (bw, dw) = hidden_and_bounded(plant, setting)
    still, moved = invisible_pencil(plant, np.hstack([bh, bw]), np.hstack([dh, dw]))
    if still.shape[1] <= len(still):
        return None
    kernels = dict[complex, Kernel]()
    for point in points:
        above = complex(point.real, abs(point.imag))
        matrix = still + above * moved if above.imag else still + above.real * moved
        kernels[above] = kernel(matrix, *pivots_of(matrix))
    nx, nf, nh = plant.nx, plant.nf, bh.shape[1]
    first = nx if setting.exact else nx + nh
    shown = Shown(slice(first, first + nf), slice(nx + nh, still.shape[1]))
    inputs, free = list[FloatArray](), np.zeros((0, 0))
    if samples:
        system, places = equations_from_rest(plant, (bh, dh), (bw, dw), samples)
        rest = kernel(system, *pivots_of(system))
        first = 0 if setting.exact else nh
        inputs, free = [np.asarray(rest.columns[place])[first:] for place in places], np.asarray(rest.free)
    through = Through(setting.models, setting.delays, samples)
    return worst_directions(kernels, (inputs, free), shown, through, discrete=plant.is_discrete)


def invisible_pencil(plant: DescriptorSystem, inputs: FloatArray, through: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return ``[-A, -B; C, D]`` and ``[E, 0; 0, 0]``: the kernel of their pencil are motions without outputs."""
    still = np.block([[-plant.A, -inputs], [plant.C, through]])
    moved = np.zeros_like(still)
    moved[: plant.nx, : plant.nx] = plant.E
    return still, moved


def proved_limit(plant: DescriptorSystem, point: complex, setting: Setting) -> float | None:
    """Return a number that the gain of every causal filter reaches at any delay up to `LONGEST_DELAY` samples.

    Of the signals ``v s^t`` of one point next to the unit circle: a delay takes ``|s|`` off their ratio per sample.
    """
    if not _grows(flint.acb(point), plant):
        return None
    plant, faint = without_dependent(plant, setting)
    plant, setting = with_independent_outputs(plant), setting._replace(delays=())
    for bits in PRECISION_BITS:
        with flint.ctx.workprec(bits):
            try:
                trajectories = _Trajectories(plant, [point], 0, setting, conjugates=False, faint=faint)
                bound = trajectories.bound(None)
            except ZeroDivisionError:
                continue
        if bound is not None:
            lower_bound = bound * (1.0 - LIMIT_SHARE)
            return lower_bound if LONGEST_DELAY * math.log(abs(point)) <= LIMIT_SHARE / 2.0 else None
    return None


def _in_doubles(still: FloatArray, moved: FloatArray, point: complex, columns: Sequence[int]) -> list[Ball]:
    """Return real and imaginary part of columns of a pencil at a point, in double precision with their rounding."""
    fixed, rate = Ball.exact(still[:, columns]), Ball.exact(moved[:, columns])
    return [fixed + rate.scaled(point.real), rate.scaled(point.imag)]


def _grows(point: Any, plant: DescriptorSystem) -> bool:
    """Whether the signals of a point, a complex ball, end with finite energy now: it is outside, or on the right."""
    return bool(point.abs_lower() > 1 if plant.is_discrete else point.real > 0)


class _Member(NamedTuple):
    point: Any  # a complex ball
    vector: Any  # (x, h, w), an acb_mat of one column


class _Trajectories:
    """The invisible trajectories of some points, with free last samples, and the energies of their combinations.

    They are complex: real and imaginary part are trajectories, and one of these has no smaller ratio.
    """

    def __init__(
        self,
        plant: DescriptorSystem,
        points: Sequence[complex],
        samples: int,
        setting: Setting,
        *,
        conjugates: bool = True,
        directions: Directions | None = None,
        faint: Faint | None = None,
    ) -> None:
        self.plant, self.setting, self.samples, self.directions = plant, setting, samples, directions
        self.faint = faint
        (self.Bh, self.Dh), (self.Bw, self.Dw) = hidden_and_bounded(plant, setting)
        self.members: list[_Member] = []
        if directions is not None:
            for point, free in directions.of_points.items():
                self.members += self._along(point, free)
            return
        for point in _with_conjugates(points) if conjugates else points:
            new_members = self._members(point)
            # Two starts may lead to one zero.
            known = any(one.point.overlaps(other.point) for one in new_members for other in self.members)
            self.members += [] if known else new_members

    # The members: kernels of the pencil.

    def _members(self, point: complex) -> list[_Member]:
        plant, nx = self.plant, self.plant.nx
        still, moved = invisible_pencil(plant, np.hstack([self.Bh, self.Bw]), np.hstack([self.Dh, self.Dw]))
        free = still.shape[1] - len(still)
        if free < 0:
            return []
        if not free:
            zero = _zero_near(still, moved, point)
            if zero is None:
                return []
            # A point at the edge may lead to a zero on the other side of it: the others are a witness without it.
            return [zero] if _grows(zero.point, plant) else []
        pivots, others = pivots_of(still + point * moved)
        exact = complex_matrix(still + 0j) + complex_matrix(moved + 0j) * flint.acb(point)
        regular = enclosed_solution(
            columns_of(exact, pivots), -columns_of(exact, others), _in_doubles(still, moved, point, pivots)
        )
        vectors = [solution_with_one_free(regular, pivots, others, j) for j in range(free)]
        # Unknown inputs alone may be invisible too, of which neither error nor noise is anything.
        nh, nw = self.Bh.shape[1], self.Bw.shape[1]
        counted = [*range(nx, nx + (plant.nf if self.setting.exact else 0)), *range(nx + nh, nx + nh + nw)]
        return [_Member(flint.acb(point), vectors[j]) for j in independent_columns(rows_of(beside(vectors), counted))]

    def _along(self, point: complex, free: ComplexArray) -> list[_Member]:
        """Return the signal of a point with these free entries, and its conjugate."""
        still, moved = invisible_pencil(self.plant, np.hstack([self.Bh, self.Bw]), np.hstack([self.Dh, self.Dw]))
        pivots, others = pivots_of(still + point * moved)
        nearby = _in_doubles(still, moved, point, pivots)
        if point.imag:
            exact = complex_matrix(still + 0j) + complex_matrix(moved + 0j) * flint.acb(point)
            vector = solution_with_free(exact, nearby, pivots, others, complex_matrix(free[:, None]))
            return [_Member(flint.acb(point), vector), _Member(flint.acb(point.conjugate()), vector.conjugate())]
        exact = real_matrix(still) + real_matrix(moved) * flint.arb(point.real)
        vector = solution_with_free(exact, nearby[:1], pivots, others, real_matrix(free.real[:, None]))
        return [_Member(flint.acb(point.real), flint.acb_mat(vector))]

    def _part(self, which: str) -> Any:
        """Return a part of the members' vectors, one member a column."""
        nx, nh, nw = self.plant.nx, self.Bh.shape[1], self.Bw.shape[1]
        nf, start = self.plant.nf, 0 if which == "x" else nx if which == "h" or self.setting.exact else nx + nh
        count = {"x": nx, "f": nf, "h": nh, "w": nw}[which]
        start = nx + nh if which == "w" else start
        columns = [rows_of(member.vector, range(start, start + count)) for member in self.members]
        return beside(columns) if columns else zeros(count, 0)

    # Combinations: coefficients of the members, then the last samples.

    def bound(self, level: float | None, enough: float | None = None) -> float | None:
        """Return the proved ratio of the worst combination, rounded down; without a level of the largest one."""
        error, noise, answered = self._energies()
        return worst_ratio(error, noise, level, level if enough is None else enough, answered=answered)

    def _energies(self) -> tuple[Any, Any, Any]:
        """Return the energies of error, noise and what a filter may answer to outputs that are faint (``None`` for
        none), as matrices on the members' coefficients and the last samples'."""
        points = [m.point for m in self.members]
        faults, noise, states = self._part("f"), self._part("w"), list[Any]()
        estimates = faults
        for model in self.setting.models:
            inner, estimates = _through(model, estimates, points)
            states.append(inner)
        weights = _weights(points, discrete=self.plant.is_discrete)
        energies = [_weighted(part, weights) for part in (estimates, noise)]
        signals = self._part("x"), self._part("h"), noise
        energies += [] if self.faint is None else [_weighted(_answered(self.faint, *signals), weights)]
        if not self.samples:
            return energies[0], energies[1], energies[2] if self.faint else None
        estimated = self.plant.nf if self.setting.exact else 0
        free = None if self.directions is None else self.directions.of_samples
        rest, passed = signals_from_rest(
            self.plant, (self.Bh, self.Dh), (self.Bw, self.Dw), self.samples, estimated, free=free
        )
        # The members go on, and what starts from rest is added to them.
        own = 0 if self.setting.exact else self.Bh.shape[1]
        tails, answers, powers = [], list[Any](), [flint.acb(1) for _ in points]
        for k, inputs in enumerate(rest):
            added = (
                rows_of(inputs, range(own, own + self.plant.nf)),
                rows_of(inputs, range(self.Bh.shape[1], inputs.nrows())),
            )
            tails.append(
                [
                    beside([scaled_columns(part, powers), more])
                    for part, more in zip((faults, noise), added, strict=True)
                ]
            )
            if self.faint is not None and k < self.samples:
                nh = self.Bh.shape[1]
                from_rest = passed[k], rows_of(inputs, range(nh)), rows_of(inputs, range(nh, inputs.nrows()))
                both = (
                    beside([scaled_columns(part, powers), more]) for part, more in zip(signals, from_rest, strict=True)
                )
                answers.append(_answered(self.faint, *both))
            powers = [power * point for power, point in zip(powers, points, strict=True)]
        count = len(points) + rest[0].ncols()
        padded = [padded_with_zeros(part, count) for part in energies]
        outputs = [tail[0] for tail in tails]
        for model, inner in zip(self.setting.models, states, strict=True):
            outputs = _recursion(model, beside([inner, zeros(inner.nrows(), rest[0].ncols())]), outputs)
        # Of each fault, what the estimate is late by is still to come.
        delays = self.setting.delays or (0,) * outputs[0].nrows()
        outputs = [
            rows_of(part, [i for i, late in enumerate(delays) if k + late < self.samples])
            for k, part in enumerate(outputs)
        ]
        for which, samples in enumerate((outputs, [tail[1] for tail in tails], answers)):
            for sample in samples:
                padded[which] = padded[which] + adjoint(sample) * sample
        return padded[0], padded[1], padded[2] if self.faint else None


def _answered(faint: Faint, states: Any, hidden: Any, noise: Any) -> Any:
    """Return the most that a filter may answer to outputs that are faint, signals as columns."""
    shown = complex_matrix(faint.C) * states + complex_matrix(faint.Dh) * hidden + complex_matrix(faint.Dw) * noise
    return shown * flint.acb(faint.answer_limit)


def _with_conjugates(points: Sequence[complex]) -> list[complex]:
    both = []
    for point in points:
        both += [complex(point)] if point.imag == 0.0 else [complex(point), complex(point).conjugate()]
    return both


def _zero_near(still: FloatArray, moved: FloatArray, point: complex) -> _Member | None:
    """Return an enclosed zero of a square pencil ``still + s moved`` with its vector, by an interval Newton step."""
    size = len(still)
    normal = np.conj(np.linalg.svd(still + point * moved)[2][-1])
    fixed, rate = complex_matrix(still + 0j), complex_matrix(moved + 0j)
    row = complex_matrix(np.conj(normal)[None, :] + 0j)
    point_, vector = flint.acb(point), complex_matrix(normal[:, None] + 0j)

    def step(s: Any, v: Any, at: tuple[Any, Any]) -> Any:
        """Return ``J(box)^-1 F(middle)``."""
        s0, v0 = at
        slope = beside([fixed + rate * s, rate * v])
        entries = [*slope.entries(), *row.entries(), flint.acb(0)]
        jacobian = flint.acb_mat(size + 1, size + 1, entries)
        missed = [*((fixed + rate * s0) * v0).entries(), (row * v0)[0, 0] - 1]
        return jacobian.solve(flint.acb_mat(size + 1, 1, missed))

    for _ in range(NEWTON_STEPS):
        moved_by = step(point_, vector, (point_, vector))
        vector = middle(vector - rows_of(moved_by, range(size)))
        point_ = (point_ - moved_by[size, 0]).mid()
    radius = flint.arb(0, flint.arb(2) ** -int(BOX_BITS * flint.ctx.prec))
    around = flint.acb(radius, radius)
    box = point_ + around, flint.acb_mat(size, 1, [entry + around for entry in vector.entries()])
    moved_by = step(*box, (point_, vector))
    inside = [entry - moved_by[i, 0] for i, entry in enumerate(vector.entries())]
    last = point_ - moved_by[size, 0]
    wide = [*box[1].entries(), box[0]]
    if not all(outer.contains(inner) for outer, inner in zip(wide, [*inside, last], strict=True)):
        return None
    return _Member(last, flint.acb_mat(size, 1, inside))


def _weights(points: Sequence[Any], *, discrete: bool) -> Any:
    """Return the sums, or integrals, of ``conj(s_i^t) s_j^t`` over the past."""
    count = len(points)
    weights = zeros(count, count)
    for i, first in enumerate(points):
        for j, second in enumerate(points):
            rate = first.conjugate() * second - 1 if discrete else first.conjugate() + second
            weights[i, j] = 1 / rate
    return weights


def _weighted(part: Any, weights: Any) -> Any:
    product, count = adjoint(part) * part, weights.nrows()
    entries = [a * b for a, b in zip(product.entries(), weights.entries(), strict=True)]
    return flint.acb_mat(count, count, entries)


def _through(model: Model, faults: Any, points: Sequence[Any]) -> tuple[Any, Any]:
    """Return the states and outputs of a reference model whose inputs are the members' faults."""
    a, b, c, d = (complex_matrix(part + 0j) for part in model)
    order, table = a.nrows(), []
    states = zeros(order, len(points))
    if order:
        for j, point in enumerate(points):
            resolvent = -a
            for i in range(order):
                resolvent[i, i] += point
            table.append(resolvent.solve(b * columns_of(faults, [j])))
        states = beside(table) if table else states
    return states, c * states + d * faults


def _recursion(model: Model, states: Any, faults: Sequence[Any]) -> list[Any]:
    """Return the outputs of a reference model, as rows on all coefficients, over the last samples."""
    a, b, c, d = (complex_matrix(part + 0j) for part in model)
    outputs = []
    for sample in faults:
        outputs.append(c * states + d * sample)
        states = a * states + b * sample
    return outputs

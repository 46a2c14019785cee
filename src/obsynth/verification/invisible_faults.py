"""Faults and noise of the whole past that no output shows: a proved lower bound on the gain of every causal filter.

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
import scipy.linalg

from obsynth.numerics.arrays import SMALLEST, ComplexArray, FloatArray
from obsynth.numerics.ranks import RANK_TOLERANCE, decide_rank, equilibrate
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.pencil import structure_of
from obsynth.proofs.exact_arithmetic import stored_matrix
from obsynth.verification.worst_invisible import Directions, Kernel, Model, Shown, Through, kernel, worst_directions

#: Digits, in bits, that are tried: close points cancel, and more digits do not.
PRECISION_BITS = (256, 768)
#: Steps of inverse iteration towards the worst combination: each gains the digits of the distance of the levels, which
#: is small where the bound is not close to the level (4 steps left two results from levels 1e-6 apart 3e-4 apart).
INVERSE_STEPS = 40
#: Shares by which the level of that iteration lies above the bound that is repeated, and of the noise's energy that is
#: taken off so that what is invisible without noise leaves no singular matrix.
LEVEL_ABOVE, REGULAR_SHARE = 1e-9, 1e-40
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
#: Columns of signals that are smaller beside the others, in double precision, are left out.
DEPENDENT_SHARE = 1e-12
#: Dependent equations of last samples with more unknowns than this are not solved in rational numbers.
MOST_UNKNOWNS = 120


class Setting(NamedTuple):
    """What the filter must do: ``delays`` in samples of each fault, and models that the faults pass one after the other
    to what is wanted (a reference model, a weight of its error); whether the fault map is exact.

    ``dependent``: outputs, by their places, which signals may show a little, where the filters in question answer them,
    with the others at zero, by at most ``answer_limit`` times the energy: as a rule, combinations of the others but for
    rounding.
    """

    delays: tuple[int, ...]
    models: tuple[Model, ...]
    exact: bool
    dependent: tuple[int, ...] = ()
    answer_limit: float = 0.0

    @property
    def longest(self) -> int:
        """The longest delay."""
        return max(self.delays, default=0)


def seen_plant(plant: DescriptorSystem, decoupled: Sequence[str]) -> DescriptorSystem:
    """Return the plant in which disturbances that are not ``decoupled`` count as noise, before the noise."""
    columns = [plant.disturbance_names.index(name) for name in decoupled]
    bounded = [i for i in range(plant.nd) if i not in columns]
    return plant.replace(
        Bd=plant.Bd[:, columns],
        Dd=plant.Dd[:, columns],
        disturbance_names=[plant.disturbance_names[i] for i in columns],
        Bw=np.hstack([plant.Bd[:, bounded], plant.Bw]),
        Dw=np.hstack([plant.Dd[:, bounded], plant.Dw]),
        noise_names=[*(plant.disturbance_names[i] for i in bounded), *plant.noise_names],
    )


def with_independent_outputs(plant: DescriptorSystem) -> DescriptorSystem:
    """Return the plant without outputs that are combinations of others, exactly: they show nothing more.

    Stored numbers count as they are: of outputs that depend on each other but for rounding none is left out.
    """
    shown = np.hstack([plant.C, plant.Df, plant.Dd, plant.Dw])
    if decide_rank(shown).rank == plant.ny:
        return plant
    echelon, rank = stored_matrix(shown.T).rref()
    if rank == plant.ny:
        return plant
    entries, width = echelon.entries(), plant.ny
    return with_outputs(plant, [next(j for j in range(width) if entries[i * width + j] != 0) for i in range(rank)])


def with_outputs(plant: DescriptorSystem, places: Sequence[int]) -> DescriptorSystem:
    """Return the plant with these of its outputs alone."""
    own = [*places]
    rows = {name: getattr(plant, name)[own] for name in ("C", "D", "Df", "Dd", "Dw")}
    return plant.replace(**rows, output_names=[plant.output_names[i] for i in own])


class Faint(NamedTuple):
    """Rows ``C x + Dh h + Dw w`` of outputs that signals show a little, and the gain of a filter from them."""

    C: FloatArray
    Dh: FloatArray
    Dw: FloatArray
    answer_limit: float


def nearly_dependent_outputs(plant: DescriptorSystem) -> tuple[int, ...]:
    """Return the places of outputs that are combinations of the others but for rounding, decided in floating point."""
    shown = np.hstack([plant.C, plant.Df, plant.Dd, plant.Dw])
    rank = decide_rank(shown).rank
    if rank == plant.ny:
        return ()
    *_, order = scipy.linalg.qr(equilibrate(shown).T, mode="economic", pivoting=True)
    return tuple(sorted(int(i) for i in order[rank:]))


def without_dependent(plant: DescriptorSystem, setting: Setting) -> tuple[DescriptorSystem, Faint | None]:
    """Return the plant without the outputs that a setting calls dependent, and these."""
    if not setting.dependent:
        return plant, None
    (_, dh), (_, dw) = hidden_and_bounded(plant, setting)
    places = [*setting.dependent]
    faint = Faint(plant.C[places], dh[places], dw[places], setting.answer_limit)
    return with_outputs(plant, [i for i in range(plant.ny) if i not in setting.dependent]), faint


def hidden_and_bounded(
    plant: DescriptorSystem, setting: Setting
) -> tuple[tuple[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]:
    """Return the columns ``(Bh, Dh)`` of what the error must not show, and ``(Bw, Dw)`` of what its gain is from."""
    faults, unknown, noise = ((getattr(plant, f"B{name}"), getattr(plant, f"D{name}")) for name in ("f", "d", "w"))
    hidden, bounded = ((faults, unknown), (noise,)) if setting.exact else ((unknown,), (faults, noise))
    return (
        (np.hstack([pair[0] for pair in hidden]), np.hstack([pair[1] for pair in hidden])),
        (np.hstack([pair[0] for pair in bounded]), np.hstack([pair[1] for pair in bounded])),
    )


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
    still, moved = _pencil(plant, np.hstack([bh, bw]), np.hstack([dh, dw]))
    if still.shape[1] <= len(still):
        return None
    kernels = dict[complex, Kernel]()
    for point in points:
        above = complex(point.real, abs(point.imag))
        matrix = still + above * moved if above.imag else still + above.real * moved
        kernels[above] = kernel(matrix, *_pivots(matrix))
    nx, nf, nh = plant.nx, plant.nf, bh.shape[1]
    first = nx if setting.exact else nx + nh
    shown = Shown(slice(first, first + nf), slice(nx + nh, still.shape[1]))
    inputs, free = list[FloatArray](), np.zeros((0, 0))
    if samples:
        system, places = _system_from_rest(plant, (bh, dh), (bw, dw), samples)
        rest = kernel(system, *_pivots(system))
        first = 0 if setting.exact else nh
        inputs, free = [np.asarray(rest.columns[place])[first:] for place in places], np.asarray(rest.free)
    through = Through(setting.models, setting.delays, samples)
    return worst_directions(kernels, (inputs, free), shown, through, discrete=plant.is_discrete)


def _pencil(plant: DescriptorSystem, inputs: FloatArray, through: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the pencil ``still + s moved`` whose kernel no output shows."""
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


def has_index_one(plant: DescriptorSystem) -> bool:
    """Whether every trajectory can be continued after now without inputs."""
    return samples_after(plant) == 0


def samples_after(plant: DescriptorSystem) -> int:
    """Return for how many samples after now the equations are to hold, so that a trajectory can be continued.

    None for index 1.  Beyond, states depend on inputs of some samples later: where the equations hold for as many
    samples as the index, the states up to now are those of a whole trajectory without inputs after these.
    """
    index = structure_of(plant).index
    if index is None:
        return plant.nx
    return index if index > 1 else 0


def _grows(point: Any, plant: DescriptorSystem) -> bool:
    """Whether the signals of a point, a complex ball, end with finite energy now: it is outside, or on the right."""
    return bool(point.abs_lower() > 1 if plant.is_discrete else point.real > 0)


def _complex(matrix: Any) -> Any:
    """Return a matrix of floating-point numbers as python-flint's, exactly."""
    rows, columns = np.shape(matrix)
    return flint.acb_mat(rows, columns, np.ravel(matrix).tolist())


def _real(matrix: FloatArray) -> Any:
    rows, columns = matrix.shape
    return flint.arb_mat(rows, columns, matrix.ravel().tolist())


def _zeros(rows: int, columns: int) -> Any:
    return flint.acb_mat(rows, columns)


def _middle(matrix: Any) -> Any:
    return flint.acb_mat(matrix.nrows(), matrix.ncols(), [entry.mid() for entry in matrix.entries()])


def _adjoint(matrix: Any) -> Any:
    return matrix.conjugate().transpose()


def _rows(matrix: Any, rows: Sequence[int]) -> Any:
    entries, width = matrix.entries(), matrix.ncols()
    return flint.acb_mat(len(rows), width, [entries[i * width + j] for i in rows for j in range(width)])


def _beside(parts: Sequence[Any]) -> Any:
    rows = parts[0].nrows()
    tables = [part.tolist() for part in parts]
    entries = [entry for i in range(rows) for table in tables for entry in table[i]]
    return flint.acb_mat(rows, sum(part.ncols() for part in parts), entries)


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
        still, moved = _pencil(plant, np.hstack([self.Bh, self.Bw]), np.hstack([self.Dh, self.Dw]))
        free = still.shape[1] - len(still)
        if free < 0:
            return []
        if not free:
            zero = _zero_near(still, moved, point)
            if zero is None:
                return []
            # A point at the edge may lead to a zero on the other side of it: the others are a witness without it.
            return [zero] if _grows(zero.point, plant) else []
        pivots, others = _pivots(still + point * moved)
        exact = _complex(still + 0j) + _complex(moved + 0j) * flint.acb(point)
        solved = _columns(exact, pivots).solve(-_columns(exact, others))
        vectors = [_placed(solved, pivots, others, j) for j in range(free)]
        # Unknown inputs alone may be invisible too, of which neither error nor noise is anything.
        nh, nw = self.Bh.shape[1], self.Bw.shape[1]
        counted = [*range(nx, nx + (plant.nf if self.setting.exact else 0)), *range(nx + nh, nx + nh + nw)]
        return [_Member(flint.acb(point), vectors[j]) for j in _independent(_rows(_beside(vectors), counted))]

    def _along(self, point: complex, free: ComplexArray) -> list[_Member]:
        """Return the signal of a point with these free entries, and its conjugate."""
        still, moved = _pencil(self.plant, np.hstack([self.Bh, self.Bw]), np.hstack([self.Dh, self.Dw]))
        pivots, others = _pivots(still + point * moved)
        if point.imag:
            exact = _complex(still + 0j) + _complex(moved + 0j) * flint.acb(point)
            vector = _with_free(exact, pivots, others, _complex(free[:, None]))
            return [_Member(flint.acb(point), vector), _Member(flint.acb(point.conjugate()), vector.conjugate())]
        exact = _real(still) + _real(moved) * flint.arb(point.real)
        vector = _with_free(exact, pivots, others, _real(free.real[:, None]))
        return [_Member(flint.acb(point.real), flint.acb_mat(vector))]

    def _part(self, which: str) -> Any:
        """Return a part of the members' vectors, one member a column."""
        nx, nh, nw = self.plant.nx, self.Bh.shape[1], self.Bw.shape[1]
        nf, start = self.plant.nf, 0 if which == "x" else nx if which == "h" or self.setting.exact else nx + nh
        count = {"x": nx, "f": nf, "h": nh, "w": nw}[which]
        start = nx + nh if which == "w" else start
        columns = [_rows(member.vector, range(start, start + count)) for member in self.members]
        return _beside(columns) if columns else _zeros(count, 0)

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
        rest, passed = _from_rest(
            self.plant, (self.Bh, self.Dh), (self.Bw, self.Dw), self.samples, estimated, free=free
        )
        # The members go on, and what starts from rest is added to them.
        own = 0 if self.setting.exact else self.Bh.shape[1]
        tails, answers, powers = [], list[Any](), [flint.acb(1) for _ in points]
        for k, inputs in enumerate(rest):
            added = (
                _rows(inputs, range(own, own + self.plant.nf)),
                _rows(inputs, range(self.Bh.shape[1], inputs.nrows())),
            )
            tails.append(
                [_beside([_scaled(part, powers), more]) for part, more in zip((faults, noise), added, strict=True)]
            )
            if self.faint is not None and k < self.samples:
                nh = self.Bh.shape[1]
                from_rest = passed[k], _rows(inputs, range(nh)), _rows(inputs, range(nh, inputs.nrows()))
                both = (_beside([_scaled(part, powers), more]) for part, more in zip(signals, from_rest, strict=True))
                answers.append(_answered(self.faint, *both))
            powers = [power * point for power, point in zip(powers, points, strict=True)]
        count = len(points) + rest[0].ncols()
        padded = [_padded(part, count) for part in energies]
        outputs = [tail[0] for tail in tails]
        for model, inner in zip(self.setting.models, states, strict=True):
            outputs = _recursion(model, _beside([inner, _zeros(inner.nrows(), rest[0].ncols())]), outputs)
        # Of each fault, what the estimate is late by is still to come.
        delays = self.setting.delays or (0,) * outputs[0].nrows()
        outputs = [
            _rows(part, [i for i, late in enumerate(delays) if k + late < self.samples])
            for k, part in enumerate(outputs)
        ]
        for which, samples in enumerate((outputs, [tail[1] for tail in tails], answers)):
            for sample in samples:
                padded[which] = padded[which] + _adjoint(sample) * sample
        return padded[0], padded[1], padded[2] if self.faint else None


def _answered(faint: Faint, states: Any, hidden: Any, noise: Any) -> Any:
    """Return the most that a filter may answer to outputs that are faint, signals as columns."""
    shown = _complex(faint.C) * states + _complex(faint.Dh) * hidden + _complex(faint.Dw) * noise
    return shown * flint.acb(faint.answer_limit)


def worst_ratio(
    error: Any, noise: Any, level: float | None, enough: float | None = None, *, answered: Any = None
) -> float | None:
    """Return the ratio of two energies for one combination near the worst, rounded down: without a level the largest.

    Nothing is concluded from the level, near which the combination is looked for.  One in double precision is taken
    where its ratio is ``enough``: more digits are a hundred times the work.  ``answered``: the energy of what may be
    taken off the error.
    """
    count = error.nrows()
    if not count:
        return None
    # Energies of the basis differ by many orders: each member in its own unit, without those that only rounding has.
    sizes = [(noise[i, i].real + error[i, i].real).mid() for i in range(count)]
    nothing = max(sizes) * flint.arb(2) ** -(flint.ctx.prec // 2)
    significant = [i for i, size in enumerate(sizes) if size > nothing]
    if not significant:
        return None
    units = [(1 / flint.acb(sizes[i]).sqrt()).mid() for i in significant]
    energies = [
        _scaled(_scaled(_columns(_rows(part, significant), significant), units).transpose(), units).transpose()
        for part in (error, noise, answered)
        if part is not None
    ]
    error, noise = energies[:2]
    largest, combination = _largest_ratio(error, noise)
    roughly = _ratio(energies, _complex(combination[:, None]))
    if roughly is not None and enough is not None and roughly >= enough:
        return roughly
    closely = _ratio(energies, _worst_combination(error, noise, largest if level is None else level))
    return max((bound for bound in (roughly, closely) if bound is not None), default=None)


def _ratio(energies: Sequence[Any], combination: Any) -> float | None:
    """Return the ratio of error and noise of a combination, rounded down; ``None`` where one of them may be zero.

    ``energies``: of both, and of what may be taken off the error, where there is a third.
    """
    above, below, *less = ((_adjoint(combination) * part * combination)[0, 0].real for part in energies)
    if not (above > 0 and below > 0):
        return None
    # An energy whose ball reaches below zero is none above its upper end.
    taken_off = sum((flint.arb(part.upper()).sqrt() for part in less), flint.arb(0))
    error = (flint.arb(above.lower()).sqrt() - taken_off).lower()
    if not error > 0:
        return None
    ratio = (error / flint.arb(below.upper()).sqrt()).lower()
    value = float(ratio) if ratio.is_finite() else 0.0
    return math.nextafter(value, 0.0) if value > 0.0 else None


def _worst_combination(error: Any, noise: Any, level: float) -> Any:
    """Return the combination whose ratio of energies is near a level, by inverse iteration in all digits."""
    count = error.nrows()
    square = flint.arb(level * (1.0 + LEVEL_ABOVE)) ** 2
    shifted = _middle(error - noise * square)
    for i in range(count):
        shifted[i, i] -= flint.arb(REGULAR_SHARE) * (1 + square)
    step = _middle(shifted.inv()) * _middle(noise)
    vector = flint.acb_mat(count, 1, [1.0 + 0.37 * (i % 7) for i in range(count)])
    for _ in range(INVERSE_STEPS):
        vector = _middle(step * vector)
        largest = max(entry.abs_upper() for entry in vector.entries())
        vector = _middle(vector * (1 / flint.acb(largest)))
    return vector


def _largest_ratio(error: Any, noise: Any) -> tuple[float, Any]:
    """Return the root of the largest ratio of two energies in double precision, and its combination: no proof."""
    above, below = (np.array([[complex(entry) for entry in row] for row in part.tolist()]) for part in (error, noise))
    below = below + np.finfo(float).eps * np.trace(below).real * np.eye(len(below))
    ratios, combinations = scipy.linalg.eigh(above, below)
    return float(np.sqrt(max(ratios[-1], 0.0))), combinations[:, -1]


def _from_rest(
    plant: DescriptorSystem,
    hidden: tuple[FloatArray, FloatArray],
    noise: tuple[FloatArray, FloatArray],
    samples: int,
    estimated: int,
    *,
    free: FloatArray | None = None,
) -> tuple[list[Any], list[Any]]:
    """Return the inputs ``(h, w)``, and the states, of each sample, solutions from rest with y = 0 as columns.

    Of these, what is independent in w and the first ``estimated`` of h, the faults; or the one with some free entries.
    """
    system, places = _system_from_rest(plant, hidden, noise, samples)
    if free is not None:
        one = flint.acb_mat(_with_free(_real(system), *_pivots(system), _real(free[:, None])))
        return [_rows(one, place) for place in places], _states_of(one, places, plant)
    try:
        pivots, others = _pivots(system)
        solved = _columns(_complex(system + 0j), pivots).solve(-_columns(_complex(system + 0j), others))
        columns = [_placed(solved, pivots, others, j) for j in range(len(others))]
        solutions = _beside(columns) if columns else _zeros(system.shape[1], 0)
    except ZeroDivisionError:
        solutions = exact_kernel(system)
    parts = [_rows(solutions, place) for place in places]
    counted = [*range(estimated), *range(hidden[0].shape[1], len(places[0]))]
    independent = _independent(_stacked([_rows(part, counted) for part in parts]))
    solutions = _columns(solutions, independent)
    return [_columns(part, independent) for part in parts], _states_of(solutions, places, plant)


def _states_of(solutions: Any, places: Sequence[range], plant: DescriptorSystem) -> list[Any]:
    """Return the states of each sample of solutions from rest: before its inputs, of the first one what is loose."""
    first = _zeros(plant.nx, solutions.ncols())
    for row, state in enumerate(_loose_states(plant)):
        for column in range(solutions.ncols()):
            first[state, column] = solutions[row, column]
    return [first, *(_rows(solutions, range(place.start - plant.nx, place.start)) for place in places[1:])]


def _loose_states(plant: DescriptorSystem) -> list[int]:
    """Return the states that no derivative or next sample holds: they may be anything at the start."""
    return [i for i in range(plant.nx) if not plant.E[:, i].any()]


def _system_from_rest(
    plant: DescriptorSystem,
    hidden: tuple[FloatArray, FloatArray],
    noise: tuple[FloatArray, FloatArray],
    samples: int,
) -> tuple[FloatArray, list[range]]:
    """Return the equations of last samples from rest with y = 0, and where the inputs of each are in the unknowns.

    Those after now follow, of whose outputs nothing is required.
    """
    nx, ny = plant.nx, plant.ny
    (bh, dh), (bw, dw) = hidden, noise
    inputs, through = np.hstack([bh, bw]), np.hstack([dh, dw])
    count = inputs.shape[1]
    loose = _loose_states(plant)
    block, every = count + nx, samples + samples_after(plant)
    system = np.zeros((every * (nx + ny), len(loose) + every * block))
    places = []
    for j in range(every):
        row, own = j * (nx + ny), len(loose) + j * block
        states, outputs = slice(row, row + nx), slice(row + nx, row + nx + ny)
        before = slice(own - nx, own) if j else slice(0, len(loose))
        system[states, before] = -plant.A if j else -plant.A[:, loose]
        system[states, own : own + count] = -inputs
        system[states, own + count : own + block] = plant.E
        if j < samples:
            system[outputs, before] = plant.C if j else plant.C[:, loose]
            system[outputs, own : own + count] = through
        places.append(range(own, own + count))
    return system[system.any(axis=1)], places


def _independent(matrix: Any) -> list[int]:
    """Return columns that span all of them, in double precision: whatever is left out, the rest is as valid."""
    table = np.array([[complex(entry) for entry in row] for row in matrix.tolist()]).reshape(matrix.nrows(), -1)
    sizes = np.linalg.norm(table, axis=0)
    if not sizes.any():
        return []
    _, upper, order = scipy.linalg.qr(table / np.where(sizes > 0.0, sizes, 1.0), mode="economic", pivoting=True)
    diagonal = np.abs(np.diag(upper))
    return sorted(int(i) for i in order[: len(diagonal)][diagonal > DEPENDENT_SHARE * diagonal[0]])


def _stacked(parts: Sequence[Any]) -> Any:
    rows = [row for part in parts for row in part.tolist()]
    return flint.acb_mat(len(rows), parts[0].ncols(), [entry for row in rows for entry in row])


def exact_kernel(system: FloatArray) -> Any:
    """Return a basis of the kernel of a matrix whose rows are dependent, in rational numbers; none of a large one."""
    rows, width = system.shape
    if width > MOST_UNKNOWNS:
        return _zeros(width, 0)
    entries = []
    for row in system:
        parts = [float(entry).as_integer_ratio() for entry in row]
        scale = max(bottom for _, bottom in parts)
        entries += [top * (scale // bottom) for top, bottom in parts]
    basis, count = flint.fmpz_mat(rows, width, entries).nullspace()
    table = [[flint.acb(flint.arb(entry)) for entry in row[:count]] for row in basis.tolist()]
    kernel = flint.acb_mat(width, count, [entry for row in table for entry in row])
    sizes = [max(abs(row[j]).abs_upper() for row in table) for j in range(count)]
    return _scaled(kernel, [1 / flint.acb(size.mid()) for size in sizes])


def _scaled(matrix: Any, factors: Sequence[Any]) -> Any:
    """Return a matrix whose columns are multiplied."""
    width = matrix.ncols()
    return flint.acb_mat(matrix.nrows(), width, [part * factors[i % width] for i, part in enumerate(matrix.entries())])


def _with_conjugates(points: Sequence[complex]) -> list[complex]:
    both = []
    for point in points:
        both += [complex(point)] if point.imag == 0.0 else [complex(point), complex(point).conjugate()]
    return both


def _pivots(matrix: Any) -> tuple[list[int], list[int]]:
    """Return the columns of a well-conditioned square part, and the others; raise for rows that are dependent."""
    sizes = np.max(np.abs(matrix), axis=1, keepdims=True)
    scaled = matrix / np.where(sizes > 0.0, sizes, 1.0)
    _, upper, order = scipy.linalg.qr(scaled, mode="economic", pivoting=True)
    if len(matrix) > matrix.shape[1]:
        raise ZeroDivisionError
    diagonal = np.abs(np.diag(upper))
    if len(diagonal) and not diagonal[-1] > RANK_TOLERANCE * max(diagonal[0], SMALLEST):
        raise ZeroDivisionError
    return [int(i) for i in order[: len(matrix)]], [int(i) for i in order[len(matrix) :]]


def _columns(matrix: Any, columns: Sequence[int]) -> Any:
    table = matrix.tolist()
    return type(matrix)(len(table), len(columns), [row[j] for row in table for j in columns])


def _with_free(matrix: Any, pivots: Sequence[int], others: Sequence[int], free: Any) -> Any:
    """Return the solution of the equations whose free entries are given, a column."""
    solved = _columns(matrix, pivots).solve(-(_columns(matrix, others) * free))
    entries = dict(zip([*pivots, *others], [*solved.entries(), *free.entries()], strict=True))
    return type(matrix)(len(entries), 1, [entries[place] for place in range(len(entries))])


def _placed(solved: Any, pivots: Sequence[int], others: Sequence[int], which: int) -> Any:
    """Return the solution in which one free entry is 1 and the other free ones are 0."""
    column = _zeros(len(pivots) + len(others), 1)
    column[others[which], 0] = 1
    for row, place in enumerate(pivots):
        column[place, 0] = solved[row, which]
    return column


def _zero_near(still: FloatArray, moved: FloatArray, point: complex) -> _Member | None:
    """Return an enclosed zero of a square pencil ``still + s moved`` with its vector, by an interval Newton step."""
    size = len(still)
    normal = np.conj(np.linalg.svd(still + point * moved)[2][-1])
    fixed, rate = _complex(still + 0j), _complex(moved + 0j)
    row = _complex(np.conj(normal)[None, :] + 0j)
    point_, vector = flint.acb(point), _complex(normal[:, None] + 0j)

    def step(s: Any, v: Any, at: tuple[Any, Any]) -> Any:
        """Return ``J(box)^-1 F(middle)``."""
        s0, v0 = at
        slope = _beside([fixed + rate * s, rate * v])
        entries = [*slope.entries(), *row.entries(), flint.acb(0)]
        jacobian = flint.acb_mat(size + 1, size + 1, entries)
        missed = [*((fixed + rate * s0) * v0).entries(), (row * v0)[0, 0] - 1]
        return jacobian.solve(flint.acb_mat(size + 1, 1, missed))

    for _ in range(NEWTON_STEPS):
        moved_by = step(point_, vector, (point_, vector))
        vector = _middle(vector - _rows(moved_by, range(size)))
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
    weights = _zeros(count, count)
    for i, first in enumerate(points):
        for j, second in enumerate(points):
            rate = first.conjugate() * second - 1 if discrete else first.conjugate() + second
            weights[i, j] = 1 / rate
    return weights


def _weighted(part: Any, weights: Any) -> Any:
    product, count = _adjoint(part) * part, weights.nrows()
    entries = [a * b for a, b in zip(product.entries(), weights.entries(), strict=True)]
    return flint.acb_mat(count, count, entries)


def _padded(matrix: Any, size: int) -> Any:
    count, padded = matrix.nrows(), _zeros(size, size)
    for i in range(count):
        for j in range(count):
            padded[i, j] = matrix[i, j]
    return padded


def _through(model: Model, faults: Any, points: Sequence[Any]) -> tuple[Any, Any]:
    """Return the states and outputs of a reference model whose inputs are the members' faults."""
    a, b, c, d = (_complex(part + 0j) for part in model)
    order, table = a.nrows(), []
    states = _zeros(order, len(points))
    if order:
        for j, point in enumerate(points):
            resolvent = -a
            for i in range(order):
                resolvent[i, i] += point
            table.append(resolvent.solve(b * _columns(faults, [j])))
        states = _beside(table) if table else states
    return states, c * states + d * faults


def _recursion(model: Model, states: Any, faults: Sequence[Any]) -> list[Any]:
    """Return the outputs of a reference model, as rows on all coefficients, over the last samples."""
    a, b, c, d = (_complex(part + 0j) for part in model)
    outputs = []
    for sample in faults:
        outputs.append(c * states + d * sample)
        states = a * states + b * sample
    return outputs

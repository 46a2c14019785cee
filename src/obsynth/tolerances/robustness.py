"""Single plants of a box: their matrices, what an observer follows of one, gains at vertices, effects like faults.

Statements about every matrix in a box, by cutting the box until each part is proved, or one point refutes it.

Whether a plant is stable, and of index 1 (or 0), at every point of its box.

What a design guarantees for every plant in the box of its constants, as lines for people and as plain data.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from obsynth.analysis.transformations.linear_plants import discretise, eliminate_algebraic_states
from obsynth.analysis.transformations.uncertain_plant import (
    ROW_ROUNDING_SHARE,
    AffinePlant,
    affine_plant,
    moving_basis,
    moving_family,
    untouched_states,
)
from obsynth.errors import ObsynthError, PreconditionError, SpecError
from obsynth.files.outputs import write_atomically
from obsynth.methods.verifying import tracking_of, verify
from obsynth.numerics.arguments import FloatArray, arguments_checked, freeze, largest_singular_value
from obsynth.numerics.matrix_equations import continuous_lyapunov, discrete_lyapunov
from obsynth.numerics.ranks import DIRECTION_SHARE, ROUNDED_ZERO
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.constants import SAME_TOLERANCE, SAMPLED, UNCERTAIN_MATRICES, ConstantsBox, Uncertainty, as_written
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.uncertain_system import uncertain_system
from obsynth.proofs.affine import AffineMatrix, affine_block, affine_inverse
from obsynth.proofs.exact_arithmetic import nearest_doubles, null_basis, pivot_columns, written_matrix
from obsynth.results.design import (
    ROBUSTNESS,
    SHOWN_DIGITS,
    ObserverDesign,
    design_as_dict,
    require_verified,
    result_text,
)
from obsynth.verification.error_structure import (
    ErrorStructure,
    Responses,
    Tracking,
    blame,
    blamed_rows,
    error_structure,
    largest_factor,
    loop_radius,
    responses_of,
    same_sample_inverse,
)


def plant_at(plant: DescriptorSystem, values: Mapping[str, float]) -> DescriptorSystem:
    """Return the plant for values of its constants: no family of matrices, and with the noise of the plant itself."""
    uncertain = plant.uncertainty
    if uncertain is None:
        return plant
    if uncertain.written is None:
        found = plant.replace(**uncertain.filled(as_written(plant, uncertain), values), uncertainty=None)
    else:
        bare = _written_at(plant, uncertain, values)
        for kind, size in uncertain.steps:
            bare = discretise(bare, size).plant if kind == SAMPLED else eliminate_algebraic_states(bare).plant
        found = plant.replace(**{name: getattr(bare, name) for name in UNCERTAIN_MATRICES}, uncertainty=None)
    # It is no family any more, but knows which of its inputs is one in every row, if one is.
    shift = uncertain.shift
    return found.replace(uncertainty=Uncertainty(ConstantsBox({}), {}, shift=shift)) if shift else found


def _written_at(plant: DescriptorSystem, uncertain: Uncertainty, values: Mapping[str, float]) -> DescriptorSystem:
    """Return the plant as it was written, for values of its constants."""
    matrices: dict[str, Any] = uncertain.filled(as_written(plant, uncertain), values)
    return DescriptorSystem(**matrices, dt=0.0 if any(kind == SAMPLED for kind, _ in uncertain.steps) else plant.dt)


def drawn_points(count: int, runs: int, seed: int, *, vertices: float = 0.5) -> FloatArray:
    """Return points ``(runs, count)`` of the box: a share of them vertices, the others uniform inside."""
    generator = np.random.default_rng(seed)
    points = generator.uniform(-1.0, 1.0, (runs, count))
    chosen = generator.random(runs) < vertices
    points[chosen] = generator.choice([-1.0, 1.0], (int(chosen.sum()), count))
    return points


#: Vertices beyond this number are drawn at random.
MOST_VERTICES = 32
#: Samples over which the gain at a vertex is summed up, at most.
MOST_GAIN_SAMPLES = 5_000
#: What is left of a response when its sum ends.
_GAIN_LEFT = 1e-6
#: Samples that are taken at once.
_GAIN_BLOCK = 50


def vertex_gains(
    design: ObserverDesign, plant: DescriptorSystem, affine: AffinePlant, tracking: Tracking
) -> dict[str, float]:
    """Return the largest peak (l1) gain from disturbances at the vertices; some drawn where there are too many."""
    observer, uncertain = design.linear[1], plant.uncertainty
    labels = observer.row_names[len(observer.state_names) :]
    if uncertain is None or not plant.nd or not labels:
        return {}
    count = len(uncertain.box.names)
    corners = (
        np.array(list(itertools.product((-1.0, 1.0), repeat=count)))
        if 2**count <= MOST_VERTICES
        else (np.random.default_rng(0).choice([-1.0, 1.0], (MOST_VERTICES, count)))
    )
    followed, basis = tracking.T, affine.coordinates
    nominal = eliminate_algebraic_states(plant)
    if plant.nx != nominal.plant.nx:
        followed, basis = followed @ plant.E @ nominal.recovery.from_state, np.eye(nominal.plant.nx)
    worst = np.zeros(len(labels))
    for corner in corners:
        at = plant_at(plant, uncertain.box.values(corner))
        worst = np.maximum(worst, _peak_gain(observer, at, followed, basis))
    return {label: float(gain) for label, gain in zip(labels, worst, strict=True)}


def _peak_gain(
    observer: LinearObserver, plant: DescriptorSystem, followed: FloatArray, basis: FloatArray
) -> FloatArray:
    """Return the peak gain of plant and error in series, without states that reach neither error nor outputs."""
    shown = slice(observer.fault_rows.start, len(observer.Cz))
    try:
        smooth = eliminate_algebraic_states(plant).plant
    except ObsynthError:
        return np.full(len(observer.Cz) - observer.fault_rows.start, np.inf)
    back = 2.0 * np.eye(len(basis)) - basis
    into = observer.Az @ followed + observer.By @ smooth.C - followed @ smooth.A
    through = observer.Cz[shown] @ followed + observer.Dy[shown] @ smooth.C
    seen = np.vstack([back @ smooth.A, into, through])
    terms = np.concatenate(
        [
            np.abs(back @ smooth.A).sum(axis=1),
            (np.abs(observer.Az @ followed) + np.abs(observer.By) @ np.abs(smooth.C)).sum(axis=1),
            (np.abs(observer.Cz[shown]) @ np.abs(followed) + np.abs(observer.Dy[shown]) @ np.abs(smooth.C)).sum(axis=1),
        ]
    )
    apart = untouched_states(seen @ basis, terms)
    kept = [i for i in range(smooth.nx) if i not in apart]
    nx, nz = len(kept), observer.order
    a = np.block(
        [[(back @ smooth.A @ basis)[np.ix_(kept, kept)], np.zeros((nx, nz))], [(into @ basis)[:, kept], observer.Az]]
    )
    b = np.vstack([(back @ smooth.Bd)[kept], observer.By @ smooth.Dd - followed @ smooth.Bd])
    c = np.hstack([(through @ basis)[:, kept], observer.Cz[shown]])
    total = np.abs(observer.Dy[shown] @ smooth.Dd).sum(axis=1)
    if np.max(np.abs(np.linalg.eigvals(a)), initial=0.0) >= 1.0:
        return np.full(len(c), np.inf)
    return np.asarray(total + _summed_response(a, b, c))


def _summed_response(a: FloatArray, b: FloatArray, c: FloatArray) -> FloatArray:
    """Return the sums of ``abs(c a^k b)`` over k and the columns, until little of ``a^k b`` is left."""
    powers = [np.eye(len(a))]
    while len(powers) <= _GAIN_BLOCK:
        powers.append(a @ powers[-1])
    block, onwards = np.array(powers[:-1]), powers[-1]
    column, left, total = b, _GAIN_LEFT * float(np.abs(b).max(initial=0.0)), np.zeros(len(c))
    for _ in range(0, MOST_GAIN_SAMPLES, _GAIN_BLOCK):
        moved = block @ column
        sizes = np.abs(moved).max(axis=(1, 2), initial=0.0)
        total = total + np.abs(c @ moved[: max(int(np.argmax(np.append(sizes <= left, True))), 1)]).sum(axis=(0, 2))
        if np.any(sizes <= left):
            break
        column = onwards @ column
    return total


def acting_like_faults(plant: DescriptorSystem) -> tuple[str, ...]:
    """Return the constants with tolerances that act where a fault does, from the plant as written."""
    uncertain = plant.uncertainty
    if uncertain is None or not plant.nf:
        return ()
    numbers = as_written(plant, uncertain)
    affine = uncertain.affine(numbers, uncertain.box)
    faults = np.vstack([numbers["Bf"], numbers["Df"]])
    found = []
    for i, name in enumerate(uncertain.box.names):
        # What multiplies the same signal stands in one column: derivative of the state, state, u, f, d.
        zero = np.zeros((plant.ny, len(numbers["A"])))
        above = [affine[key].parts[i] for key in ("E", "A", "B", "Bf", "Bd")]
        below = [zero, *(affine[key].parts[i] for key in ("C", "D", "Df", "Dd"))]
        directions = _range(np.vstack([np.hstack(above), np.hstack(below)]))
        both = np.hstack([faults / np.linalg.norm(faults, axis=0), directions])
        if np.linalg.matrix_rank(both, tol=DIRECTION_SHARE) < both.shape[1]:
            found.append(name)
    return tuple(found)


def _range(effects: FloatArray) -> FloatArray:
    """Return unit columns that span what a constant does to equations and outputs."""
    left, values, _ = np.linalg.svd(effects)
    return np.asarray(left[:, : int(np.sum(values > DIRECTION_SHARE * max(values[0], np.finfo(np.float64).tiny)))])


#: Boxes after which a statement is left open.
MOST_BOXES = 150
#: The matrix over ``lower <= q <= upper``.
Build: TypeAlias = Callable[[FloatArray, FloatArray], AffineMatrix]
#: Halvings of the way to a point that fails.
BISECTIONS = 50
#: With more constants than this, not all vertices are looked at first.
MOST_VERTEX_CONSTANTS = 10
#: Norms computed in double precision are multiplied by this before they are compared.
_NORM_OUTWARD = 1.0 + 1e-9
#: What rounding takes from a product of matrices, beside its terms.
_PRODUCT_ROUNDING = 1e-14


@dataclass(frozen=True, eq=False)
class BoxVerdict:
    """``proved``, ``refuted`` (at a point ``q``) or ``open``, and how many boxes it took."""

    verdict: str
    boxes: int
    at: FloatArray | None = None


def subdivided(
    build: Build,
    count: int,
    holds_on: Callable[[AffineMatrix], bool],
    fails_at: Callable[[FloatArray], bool],
    exact_at: Callable[[FloatArray], FloatArray],
    *,
    most: int = MOST_BOXES,
) -> BoxVerdict:
    """Cut the box along the constant that matters most; ``build``: the matrix over a part, ``exact_at``: at a point."""
    if count <= MOST_VERTEX_CONSTANTS:
        for corner in itertools.product((-1.0, 1.0), repeat=count):
            point = np.array(corner)
            if fails_at(exact_at(point)):
                return BoxVerdict("refuted", 0, point)
    todo = [(-np.ones(count), np.ones(count))]
    done = 0
    while todo:
        lower, upper = todo.pop()
        done += 1
        try:
            part = build(lower, upper)
        except PreconditionError:
            part = None
        if part is not None and holds_on(part):
            continue
        middle = (lower + upper) / 2.0
        if fails_at(exact_at(middle)):
            return BoxVerdict("refuted", done, middle)
        sizes = upper - lower if part is None else np.abs(part.parts).sum(axis=(1, 2))
        if done >= most or not sizes.any():
            return BoxVerdict("open", done)
        i = int(np.argmax(sizes))
        cut_above, cut_below = lower.copy(), upper.copy()
        cut_above[i], cut_below[i] = middle[i], middle[i]
        todo += [(lower, cut_below), (cut_above, upper)]
    return BoxVerdict("proved", done)


def values_at(box: ConstantsBox, q: FloatArray) -> dict[str, float]:
    """Return the values of the uncertain constants at a point, without the rounding of zero."""
    values = box.values(q)
    sizes = {item.name: max(abs(item.low), abs(item.high)) for item in box.uncertain}
    return {name: 0.0 if abs(values[name]) < ROUNDED_ZERO * size else values[name] for name, size in sizes.items()}


def proved_regular(build: Build, count: int, exact_at: Callable[[FloatArray], FloatArray]) -> BoxVerdict:
    """Return whether a matrix is nonsingular on the whole box; a change of the determinant's sign refutes it."""
    middle = exact_at(np.zeros(count))
    if not middle.size:
        return BoxVerdict("proved", 0)
    sign = np.linalg.slogdet(middle)[0]

    def invertible(part: AffineMatrix) -> bool:
        try:
            affine_inverse(part)
        except (PreconditionError, np.linalg.LinAlgError):
            return False
        return True

    def singular(point: FloatArray) -> bool:
        return bool(np.linalg.slogdet(point)[0] * sign <= 0.0)

    found = subdivided(build, count, invertible, singular, exact_at)
    if found.at is None:
        return found
    # Where, between the middle of the box and the point that fails, it begins to fail.
    low, high = 0.0, 1.0
    for _ in range(BISECTIONS):
        between = (low + high) / 2.0
        low, high = (low, between) if singular(exact_at(between * found.at)) else (between, high)
    return BoxVerdict(found.verdict, found.boxes, np.asarray(high * found.at))


def proved_stable(
    build: Build,
    count: int,
    exact_at: Callable[[FloatArray], FloatArray],
    *,
    discrete: bool,
    most: int = MOST_BOXES,
) -> BoxVerdict:
    """Return whether a matrix is stable on the whole box, in the norm of a Lyapunov function of each part's centre."""

    def stable(part: AffineMatrix) -> bool:
        return _contracts(part, discrete=discrete)

    def unstable(point: FloatArray) -> bool:
        values = np.linalg.eigvals(point)
        return bool(np.max(np.abs(values)) >= 1.0 if discrete else np.max(values.real) >= 0.0)

    return subdivided(build, count, stable, unstable, exact_at, most=most)


def _contracts(part: AffineMatrix, *, discrete: bool) -> bool:
    """Return whether ``A'PA - P < 0`` (``A'P + PA < 0``) on a part, P that of its centre for ``-I``."""
    a = part.center
    root, inverse = _energy_coordinates(a, discrete=discrete)
    if not np.isfinite(inverse).all():
        return False
    # Once more in the coordinates of the first: there all modes count alike.
    a = root @ a @ inverse
    lyapunov = _lyapunov(a, discrete=discrete)
    if not np.linalg.eigvalsh(lyapunov)[0] > 0.0:
        return False
    parts = [root @ item @ inverse for item in part.parts]
    rest = np.abs(root) @ part.radius @ np.abs(inverse)
    rest = rest + _PRODUCT_ROUNDING * len(a) * (np.abs(root) @ part.magnitude @ np.abs(inverse))
    size, remainder = np.abs(lyapunov), largest_singular_value(rest)
    if discrete:
        first = sum(largest_singular_value(a.T @ lyapunov @ item + item.T @ lyapunov @ a) for item in parts)
        spread = np.abs(parts).sum(axis=0) + rest if parts else rest
        second = largest_singular_value(spread.T @ size @ spread)
        second += 2.0 * largest_singular_value(np.abs(a.T) @ size) * remainder
        middle = a.T @ lyapunov @ a - lyapunov
    else:
        first = sum(largest_singular_value(lyapunov @ item + item.T @ lyapunov) for item in parts)
        second = 2.0 * largest_singular_value(size) * remainder
        middle = lyapunov @ a + a.T @ lyapunov
    rounding = _PRODUCT_ROUNDING * len(a) * largest_singular_value(size) * (1.0 + largest_singular_value(a) ** 2)
    return float(np.linalg.eigvalsh((middle + middle.T) / 2.0)[-1]) + (first + second + rounding) * _NORM_OUTWARD < 0.0


def _lyapunov(a: FloatArray, *, discrete: bool) -> FloatArray:

    weight = np.eye(len(a))
    found = discrete_lyapunov(a.T, weight) if discrete else continuous_lyapunov(a.T, -weight)
    return np.asarray((found + found.T) / 2.0)


def _energy_coordinates(a: FloatArray, *, discrete: bool) -> tuple[FloatArray, FloatArray]:
    """Return S and its inverse, in whose coordinates Lyapunov's function is a sum of squares; NaN if there is none."""
    values, vectors = np.linalg.eigh(_lyapunov(a, discrete=discrete))
    if not values[0] > 0.0:
        return np.full_like(a, np.nan), np.full_like(a, np.nan)
    return (vectors * np.sqrt(values)).T, vectors / np.sqrt(values)


#: What rounding may leave where a compressed row of E vanishes, beside the terms it is made of.
VANISHING_SHARE = 1e-13


def index_one_on_box(plant: DescriptorSystem) -> BoxVerdict:
    """Return whether ``[E_dyn; A_alg](q)`` is nonsingular on the box; `PreconditionError` where rows become dynamic."""
    written = plant.uncertainty
    if written is None:
        from obsynth.analysis.zeros import structure_of

        index = structure_of(plant).index
        return BoxVerdict("proved" if index is not None and index <= 1 else "refuted", 0, np.zeros(0))
    numbers = as_written(plant, written)
    affine = written.affine(numbers, written.box)
    # Rows of E of full rank, and combinations of its rows that vanish exactly.
    e = affine["E"].at(written.box.offsets)
    n = len(e)
    exact = written_matrix(e.T)
    chosen = pivot_columns(exact)
    null = nearest_doubles(null_basis(exact)) if len(chosen) < n else np.zeros((n, 0))
    dynamic, algebraic = np.eye(n)[chosen], np.asarray(null.T)
    changed, size = affine["E"].after(algebraic), np.abs(algebraic) @ affine["E"].magnitude
    moving = np.abs(changed.parts).sum(axis=0) > VANISHING_SHARE * size
    if moving.any():
        rows = np.flatnonzero(np.abs(algebraic[moving.any(axis=1)]).sum(axis=0))
        raise PreconditionError(
            f"A tolerance puts a derivative into an algebraic equation (rows {', '.join(str(i + 1) for i in rows)}): "
            "the plant's order changes inside the box. Give these rows of E no tolerance of their own.",
            condition="algebraic rows",
        )

    def build(lower: FloatArray, upper: FloatArray) -> AffineMatrix:
        found = written.affine(numbers, written.box.part(lower, upper))
        return affine_block([[found["E"].after(dynamic)], [found["A"].after(algebraic)]])

    def exactly(q: FloatArray) -> FloatArray:
        found = written.filled(numbers, written.box.values(q))
        return np.vstack([dynamic @ found["E"], algebraic @ found["A"]])

    return proved_regular(build, len(written.box.names), exactly)


#: A design without tolerances says this.
EXACT_MODEL = "assumes an exact model"
#: What a verdict over the box is called in texts.
VERDICTS = {"proved": "proved", "refuted": "refuted", "open": "not decided"}
#: Constants that are blamed at most.
MOST_BLAMED = 4
#: What is to blame for less is left out.
LISTED_BLAME_SHARE = 5e-3
#: What a certificate of robustness claims.
ROBUSTNESS_CLAIMS = (
    "regular", "stable", "breaking", "loop_radius", "largest_factor", "error_per_unit", "vertex_gains", "sharing",
    "untouched",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Robustness:
    """What holds for every plant in the box; see `obsynth.robustness`.

    Parameters
    ----------
    box : ConstantsBox
        The constants, and where their tolerances come from.
    assumes_exact_model : bool
        No constant has a tolerance: nothing below says anything about another plant.
    regular : str
        ``proved``, ``refuted`` or ``open``: regular and of index 1 at every point of the box.
    breaking : mapping of str to float
        Constants at which the plant is not regular of index 1, or not stable; empty where none was found.
    loop_radius : float or None
        Upper bound of the loop's radius: below 1, bounds stay finite for ever.  `None` where no bound exists.
    largest_factor : float or None
        Largest common factor on all tolerances with a radius below 1.
    blame : mapping of str to float
        Share of each constant in the loop's radius; ``remainders`` for what is not affine.
    rows : mapping of str to float
        Share of each row of the plant (named by its state) in the loop's radius.
    error_per_unit : mapping of str to mapping
        By estimate or residual: what an amplitude of one unit of each state and input can add to it.
    vertex_gains : mapping of str to float
        By fault estimate and residual: the largest peak gain from the disturbances at the vertices; infinite where the
        plant or the observer at a vertex is unstable.
    stable : str
        ``proved``, ``refuted`` or ``open``: the plant is stable at every point of the box.
    boxes : int
        Parts into which the box was cut for that.
    reason : str
        Why there is no bound; empty where there is one.
    sharing : tuple of str
        Constants that act where a fault acts: no observer can distinguish their tolerance from it.
    untouched : tuple of complex
        Modes of the plant that no constant touches and that are not stable: ``stable`` is about all others.
    not_covered : str
        For a linear model of a nonlinear plant: that its nonlinearity is not covered.
    design : ObserverDesign, optional
        Which all of this is about, with the tolerances that were asked for.
    """

    box: ConstantsBox
    assumes_exact_model: bool
    regular: str
    breaking: Mapping[str, float]
    loop_radius: float | None
    largest_factor: float | None
    blame: Mapping[str, float]
    rows: Mapping[str, float]
    error_per_unit: Mapping[str, Mapping[str, float]]
    vertex_gains: Mapping[str, float]
    stable: str
    boxes: int
    reason: str = ""
    sharing: tuple[str, ...] = ()
    untouched: tuple[complex, ...] = ()
    not_covered: str = ""
    design: ObserverDesign | None = None

    def __post_init__(self) -> None:
        freeze(self, "breaking", "blame", "rows", "error_per_unit", "vertex_gains")

    @property
    def finite_for_ever(self) -> bool:
        """Whether bounds stay finite however long a run is."""
        return self.loop_radius is not None and self.loop_radius < 1.0

    @property
    def largest_tolerance(self) -> float | None:
        """The largest common tolerance as a share, where all tolerances are the same share of their nominal values."""
        shares = [item.half / abs(item.nominal) for item in self.box.uncertain if item.nominal]
        if self.largest_factor is None or len(shares) != len(self.box.uncertain) or not shares:
            return None
        common = max(shares) - min(shares) <= SAME_TOLERANCE * max(shares)
        return self.largest_factor * shares[0] if common else None

    def claims(self) -> dict[str, Any]:
        """Return what a certificate claims, as plain data."""
        found = self.as_dict()
        return {name: found[name] for name in ROBUSTNESS_CLAIMS}

    @property
    def statement(self) -> str:
        """What holds for every plant in the box, in one sentence, with everything that it rests on."""
        if self.assumes_exact_model or self.design is None:
            return f"The design {EXACT_MODEL}."
        return robustness_statement(self.claims(), self.design, design_as_dict(self.design)["sha256"])

    def save(self, path: str | Path) -> Path:
        """Write a certificate that `obsynth verify` recomputes, with the gain set inside.

        Parameters
        ----------
        path : str or Path
            Where to write (.json).

        Raises
        ------
        SpecError
            No constant has a tolerance: there is nothing to certify.
        VerificationError
            The design fails its own verification.
        """
        if self.assumes_exact_model or self.design is None:
            raise SpecError("No constant has a tolerance: there is nothing to certify.", path="constants")
        design = self.design.replace(report=verify(self.design))
        require_verified(design)
        return write_atomically(
            path, result_text(ROBUSTNESS, {"design": self.design}, {}, self.claims(), self.statement)
        )

    def facts(self) -> Iterator[tuple[str, str]]:
        """Yield label and text of what a report shows."""
        if self.assumes_exact_model:
            yield "model", EXACT_MODEL
            return
        names = ", ".join(self.box.names[:6]) + (", ..." if len(self.box.names) > 6 else "")
        yield "constants", f"{len(self.box.names)} with a tolerance ({names}), {self.box.variation}, {self.box.origin}"
        if self.not_covered:
            yield "linear model", self.not_covered
        yield "regular, index 1", VERDICTS[self.regular] + (self._where() if self.regular == "refuted" else "")
        where = self._where() if self.stable == "refuted" and self.regular != "refuted" else ""
        lasting = ", ".join(f"{value.real:.4g}" if not value.imag else f"{value:.4g}" for value in self.untouched)
        but = f", but for the mode at {lasting}, which no constant touches" if lasting else ""
        yield "plant stable", VERDICTS[self.stable] + where + (f" ({self.boxes} boxes)" if self.boxes else "") + but
        if self.sharing:
            yield "never distinguished from a fault", f"{', '.join(self.sharing)}: they act where a fault acts"
        if self.reason:
            yield "bounds", f"none: {self.reason}"
        if self.loop_radius is None:
            return
        ever = ": bounds stay finite for ever" if self.finite_for_ever else ": bounds hold at each sample, but may grow"
        yield "loop radius", f"{self.loop_radius:.4g}{'' if self.reason else ever}"
        if self.largest_factor is not None:
            share = self.largest_tolerance
            percent = "" if share is None else f" ({100.0 * share:.3g} %)"
            yield "largest tolerances", f"{self.largest_factor:.4g} times those stated{percent}"
        yield "to blame", _top(self.blame)
        yield "rows of the plant", _top(self.rows)
        for name, gain in self.vertex_gains.items():
            yield f"largest gain, {name}", f"{gain:.4g} at a vertex, from the disturbances"

    def _where(self) -> str:
        if not self.breaking:
            return ""
        return " at " + ", ".join(f"{name} = {value:.6g}" for name, value in self.breaking.items())

    def as_dict(self) -> dict[str, Any]:
        """Return everything as plain data."""
        return {
            "box": self.box.as_dict(),
            "assumes_exact_model": self.assumes_exact_model,
            "regular": self.regular,
            "breaking": dict(self.breaking),
            "loop_radius": self.loop_radius,
            "largest_factor": self.largest_factor,
            "largest_tolerance": self.largest_tolerance,
            "blame": dict(self.blame),
            "rows": dict(self.rows),
            "error_per_unit": {name: dict(row) for name, row in self.error_per_unit.items()},
            "vertex_gains": dict(self.vertex_gains),
            "stable": self.stable,
            "boxes": self.boxes,
            "reason": self.reason,
            "sharing": list(self.sharing),
            "untouched": [[value.real, value.imag] for value in self.untouched],
            "not_covered": self.not_covered,
        }

    def __repr__(self) -> str:
        return "\n".join(f"{label}: {text}" for label, text in self.facts())

    def _repr_html_(self) -> str:
        from html import escape

        rows = "".join(f"<tr><th>{escape(a)}</th><td>{escape(b)}</td></tr>" for a, b in self.facts())
        return f"<table>{rows}</table>"


def robustness_statement(claims: Mapping[str, Any], design: ObserverDesign, digest: str) -> str:
    """Return what claims over the box of a design's plant say, in one sentence; ``digest`` is that of the gain set."""
    plant, _ = design.linear
    uncertain = plant.uncertainty
    box = "an exact model" if uncertain is None else uncertain.box.phrase
    where = ", ".join(f"{name} = {value:.6g}" for name, value in claims["breaking"].items())
    verdicts = {**VERDICTS, "refuted": f"refuted at {where}"} if where else VERDICTS
    lasting = f" but for {len(claims['untouched'])} mode(s) that no constant touches" if claims["untouched"] else ""
    words = [
        f"regular of index 1 ({verdicts.get(claims['regular'])})",
        f"stable{lasting} ({verdicts.get(claims['stable'])})",
    ]
    radius, factor = claims["loop_radius"], claims["largest_factor"]
    if radius is None:
        words.append("no bound of the observer's error is known")
    elif radius < 1.0:
        words.append(f"the observer's error keeps within bounds for ever (loop radius {radius:.4g})")
    else:
        words.append(f"bounds of the observer's error may grow (loop radius {radius:.4g})")
    if factor is not None:
        words.append(f"also for tolerances up to {factor:.4g} times as large")
    linear = "" if uncertain is None or not uncertain.not_covered else f"; {uncertain.not_covered}"
    return f"For every plant with {box}: {', '.join(words)}{linear}. Gain set {digest[:SHOWN_DIGITS]}."


def _top(shares: Mapping[str, float]) -> str:
    found = sorted(shares.items(), key=lambda item: -item[1])[:MOST_BLAMED]
    return (
        ", ".join(f"{name} {100.0 * share:.0f} %" for name, share in found if share > LISTED_BLAME_SHARE) or "nothing"
    )


#: Boxes for stability after which it is left open where most states are algebraic: each elimination takes long.
FEW_BOXES = 40
#: Two plants are the same where entries agree so well, relatively and around zero.
SAME_ENTRY, SAME_PLANT_ZERO = 1e-9, 1e-12


def with_tolerances(design: ObserverDesign, constants: Any) -> tuple[ObserverDesign, DescriptorSystem]:
    """Return a linear design and its plant with the tolerances that are asked for."""
    plant, _ = design.linear
    if constants is None:
        return design, plant
    if isinstance(constants, DescriptorSystem):
        changed = _with_tolerances_of(plant, constants)
    else:
        changed = uncertain_system(plant, constants.box if isinstance(constants, Uncertainty) else constants)
    return design.replace(plant=changed), changed


def _with_tolerances_of(plant: DescriptorSystem, given: DescriptorSystem) -> DescriptorSystem:
    """Return a plant with the tolerances of one that is the same but for these."""
    same = all(
        getattr(plant, name).shape == getattr(given, name).shape
        and np.allclose(getattr(plant, name), getattr(given, name), rtol=SAME_ENTRY, atol=SAME_PLANT_ZERO)
        for name in ("E", "A", "B", "C", "D", "Bd", "Dd", "Bf", "Df")
    )
    own, other = plant.uncertainty, given.uncertainty
    if not same and own is not None and other is not None and own.written is not None:
        # The design is for a plant that was made from the one that is given.
        before = as_written(given, other)
        if dict(own.entries) == dict(other.entries) and all(
            np.array_equal(own.written[name], before[name]) for name in own.written
        ):
            return plant.replace(uncertainty=own.with_box(other.box))
    if not same or plant.dt != given.dt:
        raise SpecError("constants is another plant than the design's: its nominal matrices differ.", path="constants")
    return plant.replace(uncertainty=given.uncertainty)


@arguments_checked
def robustness(
    design: ObserverDesign, *, constants: Any = None, progress: Callable[[str], None] | None = None
) -> Robustness:
    """Return what a linear discrete-time design guarantees for every plant in the box of its constants.

    Parameters
    ----------
    design : ObserverDesign
        Linear; of a plant with tolerances (`obsynth.uncertain_system`, or ``constants`` in a spec).
    constants : mapping, ConstantsBox or DescriptorSystem, optional
        Tolerances instead of the plant's own, as `obsynth.uncertain_system` takes them.
    progress : callable, optional
        Called with a text before each step.

    Returns
    -------
    Robustness
        Print it for a dozen lines.

    Raises
    ------
    SpecError
        The design is not linear, or a tolerance is malformed.

    Notes
    -----
    The loop's radius is that of ``H = D0 + sum_j D_j``, what the error adds to itself through what is uncertain, with
    the tail of the sum proved.  Below 1 all bounds stay finite for ever (sufficient for constant and varying
    constants).  The largest tolerance is found by bisection, all matrices built anew.  Stability and regularity are
    proved by cutting the box; a point that refutes them is named.  Theory: M. Khammash and J. Pearson,
    "Performance robustness of discrete-time systems with structured uncertainty", IEEE TAC 36, 1991.
    """
    design, plant = with_tolerances(design, constants)
    told = progress or (lambda text: None)
    uncertain = plant.uncertainty
    if uncertain is None or not uncertain.box.names:
        empty = ConstantsBox({}) if uncertain is None else uncertain.box
        return Robustness(empty, True, "open", {}, None, None, {}, {}, {}, {}, "open", 0, EXACT_MODEL)
    told("regularity over the box")
    regular = index_one_on_box(plant)
    reason = ""
    try:
        affine = affine_plant(plant)
        told("stability over the box")
        stable, untouched = _stability(plant, affine)
    except PreconditionError as error:
        affine, stable, untouched, reason = None, BoxVerdict("open", 0), (), str(error)
    broken = regular if regular.verdict == "refuted" else stable
    breaking = {} if broken.at is None or broken.verdict != "refuted" else values_at(uncertain.box, broken.at)
    radius = factor = None
    shares, rows, gains, errors = dict[str, float](), dict[str, float](), dict[str, float](), dict[str, Any]()
    if affine is not None:
        try:
            told("loop over the box")
            tracking = tracking_of(design, affine)
            responses = responses_of(structure_of(design, affine, tracking))
            radius = loop_radius(responses)
            try:
                same_sample_inverse(responses)
            except PreconditionError as error:
                # No bound holds at a sample, and all else is told.
                reason = str(error)
            told("largest tolerances")
            factor = largest_factor(
                lambda t: structure_of(design, affine_plant(plant, uncertain.box.scaled(t)), tracking), radius
            )
            shares = _named((*uncertain.box.names, "remainders"), blame(responses))
            parts = (affine.E.parts, affine.A.parts)
            rows = _named(plant.state_names, blamed_rows(responses, tracking.T, parts))
            errors = _error_per_unit(design, responses, affine)
            told("gains at the vertices")
            gains = vertex_gains(design, plant, affine, tracking)
        except PreconditionError as error:
            reason = str(error)
    return Robustness(
        uncertain.box,
        False,
        regular.verdict,
        breaking,
        radius,
        factor,
        shares,
        rows,
        errors,
        gains,
        stable.verdict,
        stable.boxes,
        reason,
        acting_like_faults(plant),
        untouched,
        uncertain.not_covered,
        design,
    )


def structure_of(
    design: ObserverDesign,
    affine: AffinePlant,
    tracking: Tracking,
    *,
    bounds: FloatArray | None = None,
    noise_bound: float = 0.0,
    faults: bool = False,
    states: bool = False,
) -> ErrorStructure:
    """Return the error system of a discrete design over its box."""
    plant, observer = design.linear
    if not plant.is_discrete:
        raise PreconditionError(
            "The design is continuous in time: bounds over tolerances are for sampled designs. Sample the plant first "
            "(transform: sample_time, or obsynth.discretise), or give online_monitor the sample time of its data.",
            condition="discrete time",
        )
    sizes = np.zeros(plant.nd) if bounds is None else bounds
    return error_structure(
        observer,
        affine,
        tracking,
        sizes,
        noise_bound,
        faults=faults,
        states=states,
        varying=affine.box.variation == "varying",
    )


def _named(names: tuple[str, ...], shares: FloatArray) -> dict[str, float]:
    return {name: float(share) for name, share in zip(names, shares, strict=True)}


def _stability(plant: DescriptorSystem, affine: AffinePlant) -> tuple[BoxVerdict, tuple[complex, ...]]:
    """Return whether the plant is stable on the box, but for modes that no constant touches, and these."""
    box, uncertain = affine.box, plant.uncertainty
    sampled = uncertain is not None and any(kind == SAMPLED for kind, _ in uncertain.steps)
    discrete = plant.is_discrete and not sampled
    basis = moving_basis(plant, box)
    whole = moving_family(plant, box, basis)
    least = np.vstack([np.abs(whole.center), whole.spread + whole.radius])
    size = whole.magnitude.sum(axis=1)
    apart = untouched_states(least, np.concatenate([size, size]))
    values = np.linalg.eigvals(whole.center[np.ix_(apart, apart)])
    outside = (
        np.abs(values) >= 1.0 - ROW_ROUNDING_SHARE if discrete else values.real >= -ROW_ROUNDING_SHARE * size.max()
    )
    lasting = tuple(complex(value) for value in values[outside])
    # Stable modes that no constant touches are stable everywhere.
    rest = [i for i in range(len(whole.center)) if i not in apart]
    if not rest:
        return BoxVerdict("proved", 0), lasting
    back = 2.0 * np.eye(len(basis)) - basis

    def exactly(q: FloatArray) -> FloatArray:
        bare = plant if plant.uncertainty is None else _written_at(plant, plant.uncertainty, box.values(q))
        # Of the signals nothing is asked: without them the elimination has a tenth of the columns.
        moving = DescriptorSystem(E=bare.E, A=bare.A, C=np.zeros((1, bare.nx)), dt=bare.dt)
        found = eliminate_algebraic_states(moving).plant.A
        return np.asarray((back @ found @ basis)[np.ix_(rest, rest)])

    def build(lower: FloatArray, upper: FloatArray) -> AffineMatrix:
        return moving_family(plant, box.part(lower, upper), basis)[rest, rest]

    most = MOST_BOXES if uncertain is None or len(basis) * 4 > len(as_written(plant, uncertain)["A"]) else FEW_BOXES
    return proved_stable(build, affine.count, exactly, discrete=discrete, most=most), lasting


def _error_per_unit(design: ObserverDesign, responses: Responses, affine: AffinePlant) -> dict[str, dict[str, float]]:
    """Return by output: what one unit of each state and input adds, first order and remainders, for ever."""
    plant, observer = design.linear
    structure = responses.structure
    inner, _, outputs = structure.rows
    back = 2.0 * np.eye(plant.nx) - affine.coordinates
    total = np.zeros((len(structure.Co), plant.nx + plant.nu))
    for i in range(affine.count):
        both = np.hstack([structure.state.parts[i] @ back, structure.inputs.parts[i]])
        total += (1.0 + abs(structure.offsets[i])) * responses.gain(structure.Co, both[inner], both[outputs])
    rest = np.hstack([structure.state.radius @ np.abs(back), structure.inputs.radius])
    total += responses.absolute_gain(structure.Co, rest[inner]) + rest[outputs]
    names = (*plant.state_names, *plant.input_names)
    return {
        label: _named(names, row)
        for label, row in zip(observer.row_names[len(observer.state_names) :], total, strict=True)
    }

"""What a design guarantees for every plant in the box of its constants, as lines for people and as plain data."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from obsynth.analysis.transformations.uncertain_plant import (
    ROW_ROUNDING_SHARE,
    AffinePlant,
    affine_plant,
    moving_basis,
    moving_family,
    untouched_states,
)
from obsynth.errors import PreconditionError, SpecError
from obsynth.files.outputs import write_atomically
from obsynth.methods.tracking import tracking_of
from obsynth.methods.verifying import verify
from obsynth.numerics.arguments import arguments_checked
from obsynth.numerics.arrays import FloatArray, freeze
from obsynth.plants.constants import SAME_TOLERANCE, ConstantsBox
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.uncertain_system import uncertain_system
from obsynth.plants.uncertainty import Uncertainty, as_written
from obsynth.proofs.affine import AffineMatrix
from obsynth.results.certificate_files import ROBUSTNESS, SHOWN_DIGITS, result_text
from obsynth.results.design import ObserverDesign, require_verified
from obsynth.results.gain_sets import design_as_dict
from obsynth.tolerances.exact_plant import acting_like_faults, is_sampled, moving_at, vertex_gains
from obsynth.tolerances.subdivision import MOST_BOXES, BoxVerdict, index_one_on_box, proved_stable, values_at
from obsynth.verification.error_structure import ErrorStructure, Tracking, error_structure
from obsynth.verification.responses import (
    Responses,
    blame,
    blamed_rows,
    largest_factor,
    loop_radius,
    responses_of,
    same_sample_inverse,
)

#: A design without tolerances says this.
EXACT_MODEL = "assumes an exact model"
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
        yield "regular, index 1", self.regular + (self._where() if self.regular == "refuted" else "")
        where = self._where() if self.stable == "refuted" and self.regular != "refuted" else ""
        lasting = ", ".join(f"{value.real:.4g}" if not value.imag else f"{value:.4g}" for value in self.untouched)
        but = f", but for the mode at {lasting}, which no constant touches" if lasting else ""
        yield "plant stable", self.stable + where + (f" ({self.boxes} boxes)" if self.boxes else "") + but
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

    def __str__(self) -> str:
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
    verdicts = {"proved": "proved", "refuted": f"refuted at {where}" if where else "refuted", "open": "not decided"}
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
    sampled = uncertain is not None and is_sampled(uncertain.steps)
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
        found = moving_at(plant, box.values(q))
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

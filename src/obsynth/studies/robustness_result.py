"""The result of a robustness analysis over the box of constants, as lines of text and as plain data."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from obsynth.errors import SpecError, counted
from obsynth.files.outputs import write_atomically
from obsynth.methods.verifying import verify
from obsynth.numerics.arrays import freeze
from obsynth.numerics.outward import lower_text
from obsynth.plants.constants import SAME_TOLERANCE, ConstantsBox
from obsynth.plants.transformations.moving_disturbances import continuous_behind
from obsynth.results.certificate_files import RESULT_FILE, SHOWN_DIGITS, result_text
from obsynth.results.design import ObserverDesign, require_verified
from obsynth.results.gain_set_writing import design_as_dict
from obsynth.results.gain_sets import ROBUSTNESS
from obsynth.verification.over_tolerances.responses import LARGEST_FACTOR
from obsynth.verification.over_tolerances.stated_tolerances import EXACT_MODEL
from obsynth.verification.over_tolerances.vertex_gains import MOST_VERTICES

#: What a verdict over the box is called in texts.
VERDICTS = {"proved": "proved", "refuted": "refuted", "open": "not decided"}

#: Constants that are blamed at most.
MOST_BLAMED = 4

#: What is to blame for less is left out.
LISTED_BLAME_SHARE = 5e-3

#: What a certificate of robustness claims.
ROBUSTNESS_CLAIMS = (
    "regular",
    "stable",
    "breaking",
    "loop_radius",
    "largest_factor",
    "error_per_unit",
    "vertex_gains",
    "sharing",
    "untouched",
)


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

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.uncertain_system(
    ...     {"A": [["a"]], "C": [[1]], "Bf": [[1]], "dt": 1.0}, {"a": {"nominal": 0.5, "tolerance": "5 %"}}
    ... )
    >>> margins = obsynth.robustness(obsynth.fault_estimation_filter(plant))
    >>> margins.stable, margins.finite_for_ever
    ('proved', True)
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
        data = self.as_dict()
        return {name: data[name] for name in ROBUSTNESS_CLAIMS}

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
        text = result_text(ROBUSTNESS, {"design": self.design}, {}, self.claims(), self.statement)
        return write_atomically(path, text, kind=RESULT_FILE)

    def facts(self) -> Iterator[tuple[str, str]]:
        """Yield label and text of what a report shows."""
        if self.assumes_exact_model:
            yield "model", EXACT_MODEL
            return
        names = ", ".join(self.box.names[:6]) + (", ..." if len(self.box.names) > 6 else "")
        yield "constants", f"{len(self.box.names)} with a tolerance ({names}), {self.box.variation}, {self.box.origin}"
        if self.not_covered:
            yield "linear model", self.not_covered
        yield (
            "regular, index 1",
            VERDICTS[self.regular] + (self._place_of_failure() if self.regular == "refuted" else ""),
        )
        where = self._place_of_failure() if self.stable == "refuted" and self.regular != "refuted" else ""
        lasting = ", ".join(f"{value.real:.4g}" if not value.imag else f"{value:.4g}" for value in self.untouched)
        but = f", but for the mode at {lasting}, which no constant touches" if lasting else ""
        yield (
            "plant stable",
            VERDICTS[self.stable] + where + (f" ({counted(self.boxes, 'box', 'boxes')})" if self.boxes else "") + but,
        )
        if self.sharing:
            yield "never distinguished from a fault", f"{', '.join(self.sharing)}: they act where a fault acts"
        if self.reason:
            yield "bounds", f"none. {self.reason}"
        if self.loop_radius is None:
            return
        ever = ": bounds stay finite for ever" if self.finite_for_ever else ": bounds hold at each sample, but may grow"
        yield "loop radius", f"{self.loop_radius:.4g}{'' if self.reason else ever}"
        if self.largest_factor is not None:
            yield "largest tolerances", self._largest_tolerances(self.largest_factor)
        yield "main contributors", _largest_shares(self.blame)
        yield "rows of the plant", _largest_shares(self.rows)
        for name, gain in self.vertex_gains.items():
            yield f"peak gain, {name}", f"{gain:.4g}{self._for_disturbances()}"

    def _largest_tolerances(self, factor: float) -> str:
        if not math.isfinite(factor):
            return f"no limit up to {LARGEST_FACTOR:,.0f} times those stated"
        share = self.largest_tolerance
        percent = "" if share is None else f" ({lower_text(100.0 * share, 3)} %)"
        return f"{lower_text(factor)} times those stated{percent}"

    def _for_disturbances(self) -> str:
        """Return for which constants and disturbances the peak gains are."""
        count = 2 ** len(self.box.names)
        vertices = f"{count} vertices" if count <= MOST_VERTICES else f"{MOST_VERTICES} drawn vertices of {count}"
        sampled = self.design is not None and continuous_behind(self.design.linear[0]) is not None
        held = " that are held between samples" if sampled else ""
        return f" at the worst of {vertices}, for disturbances within 1{held}"

    def _place_of_failure(self) -> str:
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
    lasting = (
        f" but for {counted(len(claims['untouched']), 'mode')} that no constant touches" if claims["untouched"] else ""
    )
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
        limit = f"{factor:.4g}" if math.isfinite(factor) else f"{LARGEST_FACTOR:,.0f}"
        words.append(f"also for tolerances up to {limit} times as large")
    linear = "" if uncertain is None or not uncertain.not_covered else f"; {uncertain.not_covered}"
    return f"For every plant with {box}: {', '.join(words)}{linear}. Gain set {digest[:SHOWN_DIGITS]}."


def _largest_shares(shares: Mapping[str, float]) -> str:
    largest = sorted(shares.items(), key=lambda item: -item[1])[:MOST_BLAMED]
    return (
        ", ".join(f"{name} {100.0 * share:.0f} %" for name, share in largest if share > LISTED_BLAME_SHARE) or "nothing"
    )

"""The head of a page: detectable faults, least sizes, delays, and the rate of false alarms."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from html import escape
from statistics import NormalDist
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

from obsynth.methods.guaranteed_test.method import is_guaranteed
from obsynth.methods.guaranteed_test.result import GuaranteedTest
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.noise import is_noise_assumed, noise_words
from obsynth.report.designs import (
    deviation_time,
    estimate_figures,
    followed_steps,
    gains_if_linear,
    is_of_held_disturbances,
)
from obsynth.results.number_texts import duration, number, upper_number

if TYPE_CHECKING:
    from obsynth.results.design import ObserverDesign

#: A level of so many standard deviations is named for estimates with noise.
DEVIATIONS = 5
#: Share of the samples of Gaussian noise beyond that level, on either side.
BEYOND = 2.0 * NormalDist().cdf(-float(DEVIATIONS))
#: Faults that are reported.
MOST_LISTED = 6
#: Seconds between readings at which a continuous design's deviation is told where nothing says how often they come.
USUAL_INTERVALS = (1.0, 0.01)


@runtime_checkable
class DataRun(Protocol):
    """What a page takes as a run on data: that of `obsynth.run_on_data`."""

    @property
    def rows(self) -> int:
        """How many rows it has."""

    @property
    def events(self) -> Any:
        """Its alarms."""

    @property
    def stamps(self) -> Any:
        """How its times are shown."""

    @property
    def statement(self) -> str:
        """What the threshold of its monitor means."""

    @property
    def thresholds(self) -> Mapping[str, float]:
        """Levels by column."""


def headline(design: ObserverDesign, run: DataRun | None, *, interval: float | None = None) -> Iterator[str]:
    """Yield the first lines of a page: what happened in a log, then what the design can detect.

    ``interval``: seconds between readings of the sensors of a continuous design, where a scenario says it."""
    if run is not None:
        yield _of_run(run)
    if not design.report.passed:
        return  # nothing that such a design claims is reported as what it can do
    lines = list(_of_test(GuaranteedTest.of(design)) if is_guaranteed(design) else _of_estimates(design, interval))
    if lines:
        yield '<div class="detected"><strong>What can be detected</strong><ul>'
        yield from (f"<li>{escape(line)}</li>" for line in lines[:MOST_LISTED])
        more = len(lines) - MOST_LISTED
        yield f"</ul>{f'<p>and {more} more: see Claims.</p>' if more > 0 else ''}</div>"


def _of_run(run: DataRun) -> str:
    if not run.events:
        if not (run.statement or run.thresholds):
            sentence = (
                f"{run.rows} rows; no alarm rule is set, so nothing is decided. Set one with --threshold or --monitor."
            )
            return f'<p class="verdict undecided">{sentence}</p>'
        return f'<p class="verdict holds">No alarm in {run.rows} rows.</p>'
    first = run.events[0]
    named = f" Probable fault: {first.fault}." if first.clear else ""
    more = f" {len(run.events)} alarms in all." if len(run.events) > 1 else ""
    return f'<p class="verdict fails">ALARM from {escape(run.stamps.shown(first.start))} on.{escape(named)}{more}</p>'


def _of_test(test: GuaranteedTest) -> Iterator[str]:
    """Yield what a guaranteed test detects: its numbers are proved."""
    if len(test.tests) > 1:
        for own in test.tests:
            size = _bound(own.threshold, test.plant.units.get(own.fault, ""))
            yield f"{own.fault}: estimated within {size}, proved."
        return
    unit = test.plant.units.get(test.fault, "")
    claims = test.certificate.claims
    soon = f", at the latest after {duration(claims['delay'])}" if "delay" in claims else ""
    sure = claims.get("surely_found", 2.0 * test.threshold)
    yield (
        f"{test.fault}: {_bound(sure, unit)} is certain to be detected{soon} (with the course of the "
        "test, from a sample on); no false alarm while disturbances and noise keep their bounds (proved)."
    )


def _of_estimates(design: ObserverDesign, interval: float | None) -> Iterator[str]:
    """Yield for each fault how small a step exceeds the noise of its estimate, how soon, and what looks like it."""
    observer = design.observer
    names = design.plant.noise_names if isinstance(design.plant, DescriptorSystem) else ()
    noise = noise_words(names) if is_noise_assumed(names) else "the noise"
    steps = followed_steps(design) if isinstance(observer, LinearObserver) else {}
    units = design.plant.units
    timed = not isinstance(observer, LinearObserver) or observer.dt > 0.0
    # Until its gain has settled an estimate has the deviation of the prior, and where the plant moves, another one.
    when = "" if isinstance(observer, LinearObserver) else f" as they are {deviation_time(design)}"
    held = ", if it is held between samples" if is_of_held_disturbances(design) else ""
    for figures in estimate_figures(design, gains_if_linear(design)):
        name, unit = figures["name"], figures["unit"] or ""
        sentence = f"{name}: "
        deviation = figures["deviation"]
        if deviation is not None and math.isfinite(deviation) and deviation > 0.0:
            # In continuous time noise has an intensity: that of the stated deviations, once a second.
            intervals = (USUAL_INTERVALS if interval is None else (interval,)) if not timed else (1.0,)
            first, *others = (_bound(DEVIATIONS * deviation * math.sqrt(seconds), unit) for seconds in intervals)
            if not timed:
                when = f" with a reading of the sensors every {duration(intervals[0])}"
                when += "".join(
                    f", {size} with one every {duration(s)}" for size, s in zip(others, intervals[1:], strict=True)
                )
            sentence += (
                f"{first} exceeds {DEVIATIONS} standard deviations of {noise}{when} "
                f"(false alarms: about 1 in {number(1.0 / BEYOND, digits=2)} samples, if the model is exact)"
            )
        else:
            sentence += "no sensor noise is stated, so that no smallest size is known"
        followed_step = steps.get(name)
        if followed_step is not None and followed_step.reaches:
            sentence += f"; 90 % of a step is reached after {duration(followed_step.most)}"
        elif figures["delay"]:
            sentence += f"; delay {duration(figures['delay_seconds'])}"
        if gain := figures.get("largest_gain", 0.0):
            source = figures["largest_gain_from"]
            sentence += (
                f"; a sine of amplitude {_size(1.0, units.get(source, ''))} in {source} moves the estimate by up to "
                f"{_bound(gain, unit)}{held}"
            )
        yield f"{sentence}."


def _size(value: float, unit: str) -> str:
    return f"{number(value, digits=3)} {'' if unit == '1' else unit}".strip()


def _bound(value: float, unit: str) -> str:
    """Return a size that is a bound: what is printed is one as well."""
    return f"{upper_number(value)} {'' if unit == '1' else unit}".strip()

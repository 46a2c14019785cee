"""Printed bounds, leasts and proofs, each with the words it carries, against simulations that use all that these allow.

A case is a random plant (benchmarks/campaigns/_written_plants.py), a method and a command: ``evaluate``, with and
without a monitor, ``run``, ``compare``, ``check -v``, ``design``, ``design -v``, ``prove-alarm`` and ``thresholds``.
What is printed is read as text.  A sentence that does not say what it holds for (the exact model or constants within
their tolerances; disturbances that are held or that move between samples) is wrong.  So is one that a simulation
breaks, which uses the stored numbers and no code of obsynth: disturbances that switch 24 times a sample where they may
move, noise at its bound, a plant at a corner of its tolerances where these count; a linear programme or a filter of
twelve samples that does better than a least; a null vector that does not cancel.  The mean is how many sentences of a
case were compared.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pandas as pd
from benchmarks.campaigns import _printed_claims as printed
from benchmarks.campaigns._written_plants import (
    WrittenPlant,
    effects,
    held,
    kernels,
    record,
    worst_sum,
    written_plant,
)
from benchmarks.campaigns.frame import Outcome

import obsynth as ob

CASES = 360
LIMIT = 300.0  # s
METHODS = ("fault-estimation-filter", "ui-pi-observer", "functional-filter", "optimal-filter", "guaranteed-test")
COMMANDS = ("evaluate", "monitor", "run", "compare", "check", "design", "prove-alarm", "thresholds")
#: Samples of a record and of what is added up; what rounding may add, as a share.
RECORD, ROUNDING = 60, 1e-6
#: Amplitude of the known input.
AMPLITUDE = 0.5
#: A fault that half of the records have of which an alarm is to be proved.
LARGE_FAULT = 1e3

#: A number as it is printed.
NUMBER = r"(\d+(?:\.\d+)?(?:e[-+]?\d+)?)"

EXACT, WITHIN = "the model is exact", "of nominal; the same at all times"
NOT_WITHIN = "assumes an exact model"
HELD, HELD_SAMPLE = re.compile(r"disturbances (that )?are held between samples"), "held over each sample"
MOVING = "disturbances move within their bounds between samples"


class Sentences:
    """What was read in one output: names of sentences, and what is wrong with them."""

    def __init__(self, output: str) -> None:
        self.output, self.read, self.wrong = output, list[str](), list[str]()

    def paragraphs(self, pattern: str) -> Iterator[tuple[str, re.Match[str]]]:
        """Yield each place where a pattern is printed, with its paragraph."""
        for part in re.split(r"\n\s*\n", self.output):
            told = " ".join(part.split())
            yield from ((told, found) for found in re.finditer(pattern, told))

    def expect(self, name: str, told: str, *words: str) -> None:
        """Count a sentence, which must carry words."""
        self.read.append(name)
        self.wrong += [f"{name}: does not say {word!r}" for word in words if word not in told]

    def refute(self, name: str, text: str) -> None:
        """Note that a sentence is false."""
        self.wrong.append(f"{name}: {text}")


def options_of(method: str, plant: WrittenPlant) -> dict[str, Any]:
    """Return the options that a method is designed with."""
    if method != "guaranteed-test":
        return {}
    limits = dict(zip(plant.names["d"], plant.bounds.tolist(), strict=True))
    return {"course": "step", "before": 3, "after": 4, "noise_bound": 3, "disturbance_bounds": limits}


def case(seed: int) -> Outcome:
    """Run one command on one plant and read what it prints."""
    rng = np.random.default_rng([seed, 46, 56])
    return of_plant(seed, written_plant(rng, uncertain=rng.random() < 0.5), rng)


def of_plant(seed: int, plant: WrittenPlant, rng: np.random.Generator) -> Outcome:
    """Run the command of a seed with its method on a plant, and read what it prints."""
    method, command = METHODS[seed % len(METHODS)], COMMANDS[seed // len(METHODS) % len(COMMANDS)]
    options = options_of(method, plant)
    with TemporaryDirectory() as name:
        folder = Path(name)
        spec = plant.save(folder / "spec.yaml", method, options, AMPLITUDE)
        gains = folder / "gains.json"
        design_code, text = printed.run("design", "--system", spec, "--output", gains, "--quiet")
        if command not in ("compare", "check") and design_code:
            return Outcome(command, "no design")
        reading = _READINGS[command]
        if command == "design":
            code, more = printed.run("design", "--system", spec, "--output", gains, "--quiet", "--force", "--verbose")
            sentences = Sentences(text + "\n\n" + more)
        else:
            code, text = printed.run(*_words(command, method, plant, folder, rng))
            sentences = Sentences(text)
        if code not in _CODES.get(command, (0,)):
            return Outcome(command, "refused")
        reading(sentences, plant, ob.load(gains) if not design_code else None, folder, rng)
    counts = Counter(sentences.read)
    result = "read" if counts else "nothing claimed"
    return Outcome(command, result, "; ".join(sentences.wrong[:3]), float(counts.total()), json.dumps(counts))


def _words(command: str, method: str, plant: WrittenPlant, folder: Path, rng: np.random.Generator) -> list[Any]:
    """Return the words of a command, whose files are written."""
    spec, gains, log = folder / "spec.yaml", folder / "gains.json", folder / "log.csv"
    limits = [part for name, bound in zip(plant.names["d"], plant.bounds, strict=True)
              for part in ("--disturbance", f"{name}={float(bound)!r}")]  # fmt: skip
    limits += ["--noise-bound", "3"]
    start = [part for name in plant.names["x"] for part in ("--initial", f"{name}=0")]
    bounded = [] if method == "guaranteed-test" else limits
    if command in ("evaluate", "compare"):
        return [command, "--system", spec, "--runs", "2", "--quiet"]
    if command == "monitor":
        noise = [] if method == "guaranteed-test" else ["--noise-bound", "3"]
        return ["evaluate", "--system", spec, "--runs", "2", "--quiet", "--monitor", "pointwise", *noise]
    if command == "check":
        return ["check", "--system", spec, "-v"]
    design = ob.load(gains)
    if command == "thresholds":
        printed.write_log(log, plant, *_random_record(plant, 1500, rng))
        return ["thresholds", "--gains", gains, "--data", log, "--false-alarms", "5 per 1000 rows", "--quiet",
                "--out", folder / "learned.json"]  # fmt: skip
    real, u = plant.corner(rng), AMPLITUDE * rng.choice([-1.0, 1.0], RECORD)
    fault = np.zeros(RECORD)
    if command == "prove-alarm" and rng.random() < 0.5:
        fault[-4:] = LARGE_FAULT
        (folder / "faulty").touch()
    weights = printed.weights(design, RECORD, rng)
    effect = effects(kernels(real, RECORD), weights)
    noise = 3.0 * plant.noise * np.sign(weights)
    # Of a plant with delays everything is said for disturbances that are held.
    signs = np.sign(effect if not plant.late else effect.sum(axis=1, keepdims=True) * np.ones_like(effect))
    printed.write_log(log, plant, u, record(real, signs, noise, u, fault))
    if command == "run":
        known = start if plant.uncertain and method not in ("guaranteed-test", "functional-filter") else []
        return ["run", "--gains", gains, "--data", log, "--out", folder / "rows.csv", "--monitor", "pointwise",
                "--warm-up", "0", *bounded, *known, *([] if known or method == "guaranteed-test" else
                                                    ["--initial-error", "0"])]  # fmt: skip
    return ["prove-alarm", "--gains", gains, "--data", log, "--row", str(RECORD), *bounded, *(
        [] if method == "guaranteed-test" else [*start, "--window", "6"])]  # fmt: skip


def _random_record(plant: WrittenPlant, rows: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    u = AMPLITUDE * np.sin(0.3 * np.arange(rows))
    return u, printed.random_outputs(plant, u, rng)


# --- one reading for each command ---------------------------------------------------------------------------------


def _evaluate(
    sentences: Sentences, plant: WrittenPlant, design: ob.ObserverDesign, folder: Path, rng: np.random.Generator
) -> None:
    """Bounds of estimates of the exact model, and the least of all tests."""
    beside = rf"(?:, {NUMBER} times the optimum of all|: less than any) tests? .*? \({NUMBER}\)"
    pattern = rf"\|estimate of f1\| <= {NUMBER}(?:{beside})?"
    for told, found in sentences.paragraphs(pattern):
        sentences.expect("bound of an estimate", told, EXACT, "noise within 3 standard deviations")
        moving, fixed = MOVING in told, bool(HELD.search(told))
        if moving == fixed:
            sentences.refute("bound of an estimate", "says neither or both of held and moving")
        worst = _worst_estimate(plant, design, is_held=fixed)
        if worst > float(found.group(1)) * (1.0 + ROUNDING):
            sentences.refute("bound of an estimate", f"{found.group(1)}, reached {worst:.6g}")
        if found.group(3) is not None:
            sentences.expect("optimum of all tests", told, EXACT)
            better = printed.better_test(plant, design, float(found.group(3)), is_held=fixed)
            if better:
                sentences.refute("optimum of all tests", f"{found.group(3)}, {better}")


def _worst_estimate(plant: WrittenPlant, design: ob.ObserverDesign, *, is_held: bool) -> float:
    weights = printed.weights_of(design, RECORD, row=0)
    effect = effects(kernels(plant, RECORD), weights)
    return worst_sum(held(effect) if is_held else effect, weights, plant.noise)


def _monitor(
    sentences: Sentences, plant: WrittenPlant, design: ob.ObserverDesign, folder: Path, rng: np.random.Generator
) -> None:
    """The threshold of a monitor that is printed with a number holds with this number."""
    for told, found in sentences.paragraphs(rf"Its threshold(?: \({NUMBER} at the end of a run\)| \([^)]*\))?: never"):
        model = WITHIN if plant.uncertain and WITHIN in told else NOT_WITHIN if NOT_WITHIN in told else "exact model"
        sentences.expect("threshold of a monitor", told, model)
        if (MOVING in told or "any time course, between samples too" in told) == bool(HELD.search(told)):
            sentences.refute("threshold of a monitor", "says neither or both of held and moving")
        deviations = re.search(rf"sensor noise within {NUMBER} standard deviations? \({NUMBER} at y1", told)
        if deviations is not None:
            sentences.expect("size of the noise", told)
            size = float(deviations.group(1)) * plant.noise[0]
            if abs(float(deviations.group(2)) - size) > 1e-3 * size:
                sentences.refute("size of the noise", f"{deviations.group()}: that would be {size:.6g}")
        if found.group(1) is not None:
            sentences.expect("size of a threshold", told)
            most = float(found.group(1)) * (1.0 + 1e-3)  # printed in four digits
            for _ in range(8 if WITHIN in told else 1):
                real = plant.corner(rng) if WITHIN in told else plant
                largest = printed.largest_statistic(design, real, RECORD, rng, is_held=bool(HELD.search(told)))
                if largest > most:
                    sentences.refute("size of a threshold", f"{found.group(1)}, reached {largest:.6g}")
                    break
    _evaluate(sentences, plant, design, folder, rng)


def _run(
    sentences: Sentences, plant: WrittenPlant, design: ob.ObserverDesign, folder: Path, rng: np.random.Generator
) -> None:
    """No row of the worst record without a fault alarms where the statement covers it."""
    for told, _ in sentences.paragraphs(r"never passed without a fault|never passed without f1"):
        over = WITHIN in told
        sentences.expect("threshold on data", told, WITHIN if over else "exact model")
        if (MOVING in told or "any time course, between samples too" in told) == bool(HELD.search(told)):
            sentences.refute("threshold on data", "says neither or both of held and moving")
        if over or not plant.uncertain:
            rows = pd.read_csv(folder / "rows.csv")
            share = float(np.nanmax((rows["statistic"] / rows["threshold"]).to_numpy(dtype=float)))
            if share > 1.0 + ROUNDING:
                sentences.refute("threshold on data", f"{share:.6g} of it without a fault")
        break


def _compare(
    sentences: Sentences, plant: WrittenPlant, _: ob.ObserverDesign | None, folder: Path, rng: np.random.Generator
) -> None:
    """Bounds of the table, gains, and the least of any causal filter with a delay."""
    meaning = "for the exact model (tolerances not counted) and held disturbances"
    least = "the least of any causal filter are of the exact model, with faults and disturbances that are held"
    table = printed.compared(folder)
    for told, _found in sentences.paragraphs(r"bound: largest estimate without a fault"):
        for method, row in table.items():
            design = printed.designed(folder, method)
            if design is None or not isinstance(design.observer, ob.LinearObserver):
                continue  # gains that change with the sample are not followed here
            sentences.expect("bound in a comparison", told, meaning)
            worst = _worst_estimate(plant, design, is_held=True)
            if worst > row["bound"] * (1.0 + ROUNDING):
                sentences.refute("bound in a comparison", f"{method} {row['bound']:.6g}, reached {worst:.6g}")
    whole = " ".join(sentences.output.split())
    for _told, found in sentences.paragraphs(
        rf"([a-z-]+): gain {NUMBER}; least of any causal filter with delay (\d+): {NUMBER}; with one sample more: "
        rf"{NUMBER}"
    ):
        for name, value, delay in (("least gain", 4, 0), ("least gain with one sample more", 5, 1)):
            sentences.expect(name, whole, least)
            _refute_least(sentences, name, plant, float(found.group(value)), int(found.group(3)) + delay)
        design = printed.designed(folder, found.group(1))
        if design is not None:
            sentences.expect("gain of a method", whole, least)
            own = printed.gain(plant, design)
            if abs(own - float(found.group(2))) > 1e-3 * own + 1e-6:
                sentences.refute("gain of a method", f"{found.group(1)} {found.group(2)}, by frequencies {own:.6g}")


def _refute_least(
    sentences: Sentences, name: str, plant: WrittenPlant, least: float, delay: int, *, noise: bool = False
) -> None:
    found = printed.filter_of_samples(plant, delay, noise=noise)
    if found is not None and found < least * (1.0 - 1e-3) - 1e-6:
        sentences.refute(name, f"{least:.6g} with delay {delay}, a filter of {printed.TAPS} samples has {found:.6g}")


def _check(
    sentences: Sentences, plant: WrittenPlant, _: ob.ObserverDesign | None, folder: Path, rng: np.random.Generator
) -> None:
    """Null vectors that cancel at every sensor, leasts, and which faults are detectable."""
    whole = " ".join(sentences.output.split())
    for told, found in sentences.paragraphs(
        rf"Least gain from the disturbances.*?delay (\d+).*? {NUMBER} of any causal filter; with one sample more: "
        rf"{NUMBER}\."
    ):
        for name, value, delay in (("least gain", 2, 0), ("least gain with one sample more", 3, 1)):
            sentences.expect(name, told, EXACT, HELD_SAMPLE)
            _refute_least(sentences, name, plant, float(found.group(value)), int(found.group(1)) + delay)
    steps = r"(a step of 1 in f1(?: and a step of \S+ in d\d)*(?: and states? .*?)?)"
    for _told, found in sentences.paragraphs(rf"{steps} cancel at every sensor \(z = 1\)"):
        sentences.expect("null vector", found.group())
        missed = printed.missed_by_steps(plant, found.group(1))
        if missed > 1e-2:
            sentences.refute("null vector", f"{found.group(1)}: {missed:.2g} of an effect is left")
    for found in re.finditer(r"^f1 +(yes|no) +(yes|no) +(yes|no) +(yes|no)", sentences.output, re.MULTILINE):
        sentences.expect("detectable", whole, "decoupled from d1")
        truths = printed.detectable(plant)
        told = tuple(word == "yes" for word in found.groups()[:2])
        if told != truths:
            sentences.refute("detectable", f"{told} in general and in steady state, by responses {truths}")


def _design(
    sentences: Sentences, plant: WrittenPlant, design: ob.ObserverDesign, folder: Path, rng: np.random.Generator
) -> None:
    """Claims of the summary and rows of the report."""
    whole = " ".join(sentences.output.split())
    for _told, found in sentences.paragraphs(rf"claim gamma = {NUMBER}, proved bound on the L2 gain"):
        sentences.expect("gamma", whole, f"{EXACT}, disturbances {HELD_SAMPLE}")
        own = printed.gain(plant, design)
        if own > float(found.group(1)) * (1.0 + 1e-3):
            sentences.refute("gamma", f"{found.group(1)}, by frequencies {own:.6g}")
    for told, found in sentences.paragraphs(rf"f1 +\d+ +\S+ +{NUMBER} +(?:none|{NUMBER} from d\d)"):
        sentences.expect("largest gain", whole, f"{EXACT}, disturbances {HELD_SAMPLE}")
        del told
        own, deviation = printed.gain(plant, design, each=True), printed.deviation(plant, design)
        stated = float(found.group(2) or 0.0)
        if abs(own - stated) > 1e-3 * own + 1e-6:
            sentences.refute("largest gain", f"{stated:.6g}, by frequencies {own:.6g}")
        if abs(deviation - float(found.group(1))) > 1e-3 * deviation:
            sentences.refute("deviation", f"{found.group(1)}, by a Lyapunov equation {deviation:.6g}")
        break
    for _told, found in sentences.paragraphs(
        rf"Least gain from disturbances and noise together, .*?delay (\d+): (?:between {NUMBER} and )?{NUMBER}, "
        rf"proved; this filter: {NUMBER}"
    ):
        sentences.expect("proved least of any filter", whole, f"{EXACT}, disturbances {HELD_SAMPLE}")
        least = float(found.group(2) or found.group(3))
        _refute_least(sentences, "proved least of any filter", plant, least, int(found.group(1)), noise=True)
        own = printed.gain(plant, design, noise=True)
        if own > float(found.group(4)) * (1.0 + 1e-6) + 1e-6:
            sentences.refute("gain of an optimal filter", f"{found.group(4)}, by frequencies {own:.6g}")
    for _told, found in sentences.paragraphs(rf"claim decay = {NUMBER} 1/s, slowest decay rate"):
        sentences.expect("decay", whole, EXACT)
        slowest = -np.log(np.max(np.abs(np.linalg.eigvals(design.observer.Az)))) / plant.dt
        if slowest < float(found.group(1)) * (1.0 - 1e-3):
            sentences.refute("decay", f"{found.group(1)}, the slowest pole has {slowest:.6g}")
    for told, found in sentences.paragraphs(
        rf"The threshold is {NUMBER}; none with (\d+) samples is below {NUMBER} \(proved"
    ):
        moving, fixed = "any time course, between samples too" in told, bool(HELD.search(told))
        sentences.expect("threshold of a test", whole, EXACT)
        sentences.expect("least threshold", whole, EXACT)
        if moving == fixed:
            sentences.refute("least threshold", "says neither or both of held and moving")
        weights = printed.weights_of(design, int(found.group(2)), row=0)
        effect = effects(kernels(plant, len(weights)), weights)
        worst = worst_sum(effect if moving else held(effect), weights, plant.noise)
        if worst > float(found.group(1)) * (1.0 + 1e-3):
            sentences.refute("threshold of a test", f"{found.group(1)}, reached {worst:.6g}")
        sure = re.search(rf"A fault of {NUMBER} with this course, from a sample on, is certain to raise an alarm", told)
        if sure is not None:
            sentences.expect("size that is sure to alarm", whole, EXACT)
            if float(sure.group(1)) * (1.0 + 1e-3) < worst + float(found.group(1)):
                sentences.refute("size that is sure to alarm", f"{sure.group(1)}, off by {worst:.6g}")
        better = printed.step_test(plant, before=3, after=4, is_held=not moving)
        if better < float(found.group(3)) * (1.0 - 1e-3):
            sentences.refute("least threshold", f"{found.group(3)}, a test has {better:.6g}")


def _prove(
    sentences: Sentences, plant: WrittenPlant, design: ob.ObserverDesign, folder: Path, rng: np.random.Generator
) -> None:
    """A record without a fault is never proved faulty."""
    for told, found in sentences.paragraphs(r"(Proved|Cannot be proved): (?:with |rows )"):
        proved, over = found.group(1) == "Proved", WITHIN in told
        sentences.expect("proof of an alarm" if proved else "no proof of an alarm", told, "between samples")
        if not over and not re.search(r"exact model|model is not exact", told):
            sentences.refute("proof of an alarm", "does not say for which model")
        if proved and not (folder / "faulty").exists() and (over or not plant.uncertain):
            sentences.refute("proof of an alarm", "there is no fault")
        break


def _thresholds(
    sentences: Sentences, plant: WrittenPlant, design: ob.ObserverDesign, folder: Path, rng: np.random.Generator
) -> None:
    """A learned rate of false alarms, on another record of the same kind."""
    for told, found in sentences.paragraphs(r"at most one false alarm per (\d+) rows"):
        sentences.expect("rate of false alarms", told, "Learned from", "on average")
        rows, fresh = 6000, folder / "fresh.csv"
        printed.write_log(fresh, plant, *_random_record(plant, rows, rng))
        code, _ = printed.run(
            *("run", "--gains", folder / "gains.json", "--data", fresh, "--out", folder / "fresh-rows.csv"),
            *("--monitor", "learned", "--normal", folder / "learned.json"),
        )
        if code not in (0, 1):
            return
        alarms = pd.read_csv(folder / "fresh-rows.csv")["alarm"].fillna(0).astype(bool).to_numpy()
        starts = printed.separate(alarms, 20)
        # Twice the mean of what is stated, and four deviations: a rate that is learned is an estimate.
        allowed = rows / float(found.group(1))
        if starts > 2.0 * allowed + 4.0 * np.sqrt(2.0 * allowed):
            sentences.refute("rate of false alarms", f"{starts} in {rows} rows, {allowed:.0f} on average")


#: Codes with which a command has printed what it claims: of check also where no method exists.
_CODES = {"check": (0, 3), "prove-alarm": (0, 1, 5), "run": (0, 1), "monitor": (0, 1)}

_READINGS = {"evaluate": _evaluate, "monitor": _monitor, "run": _run, "compare": _compare, "check": _check,
             "design": _design, "prove-alarm": _prove, "thresholds": _thresholds}  # fmt: skip


def more_of_table(outcomes: Mapping[int, Outcome]) -> list[str]:
    """Return how many sentences of each kind were read."""
    total = Counter[str]()
    for outcome in outcomes.values():
        total.update(json.loads(outcome.details or "{}"))
    return ["| sentence | read |", "| --- | --- |", *(f"| {name} | {count} |" for name, count in sorted(total.items()))]

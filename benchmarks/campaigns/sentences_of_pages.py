"""What the head of a page and the summary say in numbers, against simulations that use all that the sentences allow.

A case is a random plant (benchmarks/campaigns/_written_plants.py) and a method, on samples or in continuous time.  What
is read: five deviations of an estimate, the time to 90 % of a step, what a sine of amplitude one does to an estimate,
the size of a fault that is certain to be detected and the time after which it is, how long the slowest mode takes, and
the peak gain over the tolerances.  They are compared with a Lyapunov equation, a step of the plant as written, sines of
2,000 frequencies, a linear programme over disturbances that switch within samples and noise within its bounds, and
disturbances that switch at the worst times at each vertex: by numpy and scipy alone, from the stored numbers.
"""

from __future__ import annotations

import html
import json
import re
from collections import Counter
from collections.abc import Callable
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from benchmarks.campaigns import _printed_claims as printed
from benchmarks.campaigns._written_plants import (
    TOLERANCE,
    WrittenPlant,
    effects,
    kernels,
    sampled,
    written_plant,
)
from benchmarks.campaigns.frame import Outcome
from benchmarks.campaigns.sentences import NUMBER, Sentences, options_of
from scipy.linalg import expm, solve_continuous_lyapunov
from scipy.optimize import linprog

import obsynth as ob
from obsynth.report.designs import tolerance_facts
from obsynth.report.headline import headline
from obsynth.report.summary import summary

CASES = 64
LIMIT = 300.0  # s
ON_SAMPLES = ("fault-estimation-filter", "ui-pi-observer", "functional-filter", "optimal-filter", "guaranteed-test")
IN_TIME = ("pd-observer", "ui-pi-observer", "functional-filter")
#: What three printed digits may hide, to the nearest and rounded up, and what double precision may.
DIGITS, ROUNDED_UP, ROUNDING = 5e-3, 1e-2, 1e-9
#: Frequencies of sines, and parts of a sample in the programme.
SINES, PARTS = 2_000, 8


def case(seed: int) -> Outcome:
    """Write the page of one design and read it."""
    rng = np.random.default_rng([seed, 46, 58])
    plant = written_plant(rng, uncertain=rng.random() < 0.4)
    methods = [(name, True) for name in ON_SAMPLES] + [(name, False) for name in IN_TIME]
    method, is_sampled = methods[seed % len(methods)]
    group = f"{method}{'' if is_sampled else ', continuous'}"
    with TemporaryDirectory() as name:
        folder = Path(name)
        spec = plant.spec(method, options_of(method, plant), 0.5)
        if not is_sampled:
            del spec["plant"]["transform"]
            spec["scenario"]["sample_time"] = plant.dt
        (folder / "spec.yaml").write_text(json.dumps(spec), encoding="utf-8")
        gains = folder / "gains.json"
        if printed.run("design", "--system", folder / "spec.yaml", "--output", gains, "--quiet")[0]:
            return Outcome(group, "no design")
        design = ob.load(gains)
        parts = [
            *map(_plain, headline(design, None)),
            str(summary(design)),
        ]
        parts += [f"{label}: {text}" for label, text in tolerance_facts(design)]
        sentences = Sentences("\n\n".join(parts))
        for reading in _READINGS:
            reading(sentences, plant, design, is_sampled)
    counts = Counter(sentences.read)
    result = "read" if counts else "nothing claimed"
    return Outcome(group, result, "; ".join(sentences.wrong[:3]), float(counts.total()), json.dumps(counts))


def _plain(page: str) -> str:
    """Return the text of a page: one line for each element."""
    page = re.sub(r"<(script|style|svg)\b.*?</\1>", "", page, flags=re.DOTALL)
    return html.unescape(re.sub(r"<[^>]+>", "\n\n", page))


# --- the error of an estimate from the stored numbers ---------------------------------------------------------------


def _joined(plant: WrittenPlant, design: ob.ObserverDesign, is_sampled: bool) -> tuple[np.ndarray, ...]:
    """Return plant and observer in series: ``x' = a x + b [f, d], fhat = c x + e [f, d]``, or the same on samples."""
    observer = design.linear[1]
    if is_sampled:
        model = sampled(plant)
        A, C = model.A, model.C
        B, D = np.hstack([model.Bf, model.Bd]), np.hstack([model.Df, model.Dd])
    else:
        A, C = plant.A, plant.C
        B = np.hstack([plant.Bf, plant.Bd])
        D = np.hstack([np.zeros((len(C), 1)), plant.Dd])
    rows = observer.fault_rows
    a = np.block([[A, np.zeros((len(A), observer.order))], [observer.By @ C, observer.Az]])
    b = np.vstack([B, observer.By @ D])
    return a, b, np.hstack([observer.Dy[rows] @ C, observer.Cz[rows]]), observer.Dy[rows] @ D


def _deviation(plant: WrittenPlant, design: ob.ObserverDesign, is_sampled: bool) -> float:
    """Return the standard deviation of the fault estimate under the stated noise of the sensors."""
    if is_sampled:
        return printed.deviation(plant, design)
    observer = design.linear[1]
    driven = observer.By * plant.noise
    row = observer.Cz[observer.fault_rows]
    return float(np.sqrt((row @ solve_continuous_lyapunov(observer.Az, -driven @ driven.T) @ row.T)[0, 0]))


def _five_deviations(sentences: Sentences, plant: WrittenPlant, design: ob.ObserverDesign, is_sampled: bool) -> None:
    for told, found in sentences.paragraphs(rf"f1: {NUMBER} exceeds 5 standard deviations"):
        once = [] if is_sampled else ["if the sensors are read once a second"]
        sentences.expect("five deviations", told, "if the model is exact", *once)
        own = 5.0 * _deviation(plant, design, is_sampled)
        if not own * (1.0 - ROUNDING) <= float(found.group(1)) <= own * (1.0 + ROUNDED_UP):
            sentences.refute("five deviations", f"{found.group(1)}, by a Lyapunov equation {own:.6g}")


def _seconds(text: str) -> float:
    """Return a printed time in seconds."""
    number, unit = re.fullmatch(r"([\d.,e+-]+) (\S+)", text).groups()  # type: ignore[union-attr]
    return float(number.replace(",", "")) * {"ms": 1e-3, "s": 1.0, "min": 60.0, "h": 3600.0, "µs": 1e-6}[unit]


def _ninety_per_cent(sentences: Sentences, plant: WrittenPlant, design: ob.ObserverDesign, is_sampled: bool) -> None:
    a, b, c, e = _joined(plant, design, is_sampled)
    for told, found in sentences.paragraphs(r"90 % of a step is reached after ([\d.,e+-]+ [a-zµ]+)"):
        sentences.expect("90 % of a step", told)
        stated = _seconds(found.group(1))
        if is_sampled:
            state, samples = np.zeros(len(a)), round(stated / plant.dt)
            shown = []
            for _ in range(samples + 1):
                shown.append(float(c[0] @ state + e[0, 0]))
                state = a @ state + b[:, 0]
            before, then = max(shown[:-1], default=0.0), shown[-1]
        else:
            whole = np.block([[a, b[:, :1]], [np.zeros((1, len(a) + 1))]])
            shown = [float(c[0] @ expm(whole * t)[:-1, -1]) + e[0, 0] for t in stated * np.linspace(0.0, 1.1, 331)]
            at = np.linspace(0.0, 1.1, 331)
            before = max(value for value, t in zip(shown, at, strict=True) if t <= 0.9)
            then = max(value for value, t in zip(shown, at, strict=True) if t <= 1.1)
        if before >= 0.9 or then < 0.9 - DIGITS:
            sentences.refute("90 % of a step", f"{found.group(1)}: {before:.4g} before, {then:.4g} then")


def _sine(sentences: Sentences, plant: WrittenPlant, design: ob.ObserverDesign, is_sampled: bool) -> None:
    a, b, c, e = _joined(plant, design, is_sampled)
    for told, found in sentences.paragraphs(rf"a sine of amplitude 1 in (d\d) moves the estimate by up to {NUMBER}"):
        sentences.expect("a sine", told, *(["if it is held between samples"] if is_sampled else []))
        place = plant.names["d"].index(found.group(1)) + 1
        top = np.pi / plant.dt
        speeds = np.concatenate([[0.0], np.geomspace(1e-6 * top, top if is_sampled else 1e4 * top, SINES)])
        points = np.exp(1j * speeds * plant.dt) if is_sampled else 1j * speeds
        gains = [abs((c @ np.linalg.solve(p * np.eye(len(a)) - a, b) + e)[0, 1:]) for p in points]
        own = float(np.max(gains))
        if own > float(found.group(2)) * (1.0 + DIGITS) or np.max(np.array(gains)[:, place - 1]) < own * (1.0 - DIGITS):
            sentences.refute("a sine", f"{found.group(1)} {found.group(2)}, by frequencies {own:.6g}")
        if own < float(found.group(2)) * (1.0 - ROUNDED_UP):
            sentences.refute("a sine", f"{found.group(2)} is not reached: {own:.6g}")


# --- guaranteed tests -------------------------------------------------------------------------------------------------


def _certain(sentences: Sentences, plant: WrittenPlant, design: ob.ObserverDesign, is_sampled: bool) -> None:
    pattern = rf"f1: {NUMBER} is certain to be detected(?:, at the latest after ([\d.,e+-]+ [a-zµ]+))?"
    for told, found in sentences.paragraphs(pattern):
        sentences.expect("certain to be detected", told, "no false alarm while")
        if found.group(2) is None:
            continue
        sentences.read.append("latest alarm")
        after = round(_seconds(found.group(2)) / plant.dt)
        threshold = float(design.certificate.claims["threshold"])
        least = _least_largest(plant, design, float(found.group(1)), after)
        if least < threshold * (1.0 - DIGITS):
            sentences.refute("latest alarm", f"a fault of {found.group(1)} keeps below {least / threshold:.4g} of it")
        # The size is no larger than it has to be.
        if (less := _least_largest(plant, design, 0.9 * float(found.group(1)), after)) > threshold * (1.0 + DIGITS):
            sentences.read.append("a smaller fault would do")
            del less


def _least_largest(plant: WrittenPlant, design: ob.ObserverDesign, size: float, after: int) -> float:
    """Return the least that a test shows at most until ``after`` samples from the onset of a step of the fault, over
    disturbances that switch within samples and noise within its bounds."""
    order = design.linear[1].order
    weights = printed.weights_of(design, order + 1, row=0)
    used = int(np.max(np.flatnonzero(np.any(weights[::-1] != 0.0, axis=1)), initial=0)) + 1
    weights = weights[-used:]
    total = used + after
    kernel, model = kernels(plant, total, PARTS), sampled(plant)
    response, state = [model.Df[:, 0]], model.Bf[:, 0]
    for _ in range(after):
        response.append(response[-1] + model.C @ state)
        state = model.A @ state
    rows, shown = [], []
    for k in range(after + 1):
        placed = np.zeros((total, weights.shape[1]))
        placed[k : k + used] = weights
        noise = 3.0 * placed * plant.noise
        rows.append(np.concatenate([effects(kernel, placed).ravel(), noise.ravel()]))
        faults = np.zeros((total, weights.shape[1]))
        faults[used - 1 :] = size * np.array(response)[: total - used + 1]
        shown.append(float((placed * faults).sum()))
    matrix, offset = np.array(rows), np.array(shown)
    count = matrix.shape[1]
    ones = np.ones((len(matrix), 1))
    solved = linprog(
        np.append(np.zeros(count), 1.0),
        A_ub=np.block([[matrix, -ones], [-matrix, -ones]]),
        b_ub=np.concatenate([-offset, offset]),
        bounds=[(-1.0, 1.0)] * count + [(0.0, None)],
        method="highs",
    )
    return float(solved.fun)


# --- how long, and over tolerances ------------------------------------------------------------------------------------


def _settling(sentences: Sentences, plant: WrittenPlant, design: ob.ObserverDesign, is_sampled: bool) -> None:
    """The slowest mode, of an eigenvalue by numpy."""
    del plant
    modes = np.linalg.eigvals(design.linear[1].Az)
    with np.errstate(divide="ignore"):  # of a window nothing is left
        slowest = np.log(np.max(np.abs(modes), initial=0.0)) if is_sampled else np.max(modes.real)
    for told, found in sentences.paragraphs(rf"the slowest mode falls to 2 % in {NUMBER} s"):
        sentences.expect("slowest mode", told, "observer of order")
        stated = float(found.group(1)) / (design.linear[1].dt or 1.0)
        if np.exp(slowest * stated) > 0.02 * (1.0 + ROUNDING):
            sentences.refute("slowest mode", f"{found.group(1)}: {np.exp(slowest * stated):.3g} is left")


def _peak_gain(sentences: Sentences, plant: WrittenPlant, design: ob.ObserverDesign, is_sampled: bool) -> None:
    for told, found in sentences.paragraphs(
        rf"peak gain, fhat.f1.: {NUMBER} at the worst of (\d+) vertices, for disturbances within 1"
    ):
        sentences.expect("peak gain", told, *(["that are held between samples"] if is_sampled else []))
        worst = 0.0
        for signs in product((-1.0, 1.0), repeat=len(plant.A)):
            corner = plant._replace(A=plant.A + np.diag(TOLERANCE * np.array(signs) * np.diag(plant.A)))
            a, b, c, e = _joined(corner, design, is_sampled) if design.observer.fault_names else (None,) * 4
            if a is None:
                return
            state, total = b[:, 1:], np.abs(e[0, 1:]).sum()
            for _ in range(20_000):
                total += np.abs(c[0] @ state).sum()
                state = a @ state
                if np.abs(state).max() < 1e-12:
                    break
            worst = max(worst, float(total))
        if abs(worst - float(found.group(1))) > DIGITS * worst:
            sentences.refute("peak gain", f"{found.group(1)}, by switching {worst:.6g}")


_READINGS: tuple[Callable[[Sentences, WrittenPlant, ob.ObserverDesign, bool], None], ...] = (
    _five_deviations, _ninety_per_cent, _sine, _certain, _settling, _peak_gain,
)  # fmt: skip

"""Ranking of methods by errors of their estimates or delays of their alarms, in numbers and in words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.results.certificate_files import SHOWN_DIGITS
from obsynth.results.number_texts import number
from obsynth.studies.equal_delays import HEALTHY_TIME

#: Where nothing is known of delays on a log, a method comes last.
NO_DELAYS = (float("inf"), float("inf"))


def comparison_statement(claims: Mapping[str, Any], digests: Mapping[str, str], log: Mapping[str, Any] | None) -> str:
    """Return what the figures of a comparison come to; ``digests`` are those of the gain sets."""
    methods = claims["methods"]
    errors = {name: relative_error(entry["faults"]) for name, entry in methods.items()}
    delays = {
        name: mean_delay([float(fault.get("equal_delay", "nan")) for fault in entry["faults"]])
        for name, entry in methods.items()
    }
    best = min(methods, key=lambda name: (not methods[name]["fast_enough"], *(delays[name] or NO_DELAYS), errors[name]))
    if delays[best] is not None:
        return _statement_on_log(claims, digests, log, best, delays)
    other_errors = ", ".join(f"{errors[name]:.4g} of {name}" for name in methods if name != best)
    fast = "" if methods[best]["fast_enough"] else ", though none reaches 90 % of a step within the time asked for"
    where = "" if log is None else f", errors on {log['name']} (sha256 {log['sha256'][:SHOWN_DIGITS]})"
    gain_sets = ", ".join(f"{name} {digest[:SHOWN_DIGITS]}" for name, digest in digests.items())
    against = f" against {other_errors}" if other_errors else ""
    return (
        f"Of the methods that exist, {best} has the least rms error of the fault estimates, as a share of each fault's "
        f"size ({errors[best]:.4g}{against}){fast}: {claims['setting']}{where}. Gain sets: {gain_sets}."
    )


def _statement_on_log(
    claims: Mapping[str, Any],
    digests: Mapping[str, str],
    log: Mapping[str, Any] | None,
    best: str,
    delays: Mapping[str, tuple[int, float] | None],
) -> str:
    """Return the sentence where methods are ranked by their delays at equal healthy time in alarm on a log."""
    methods = claims["methods"]
    own = delays[best]
    words = "" if own is None else delay_in_words(own, HEALTHY_TIME)
    others = ", ".join(
        f"{short_delay(delay)} of {name}" for name, delay in delays.items() if name != best and delay is not None
    )
    fast = "" if methods[best]["fast_enough"] else ", though none reaches 90 % of a step within the time asked for"
    where = "" if log is None else f", on {log['name']} (sha256 {log['sha256'][:SHOWN_DIGITS]})"
    gain_sets = ", ".join(f"{name} {digest[:SHOWN_DIGITS]}" for name, digest in digests.items())
    return (
        f"Of the methods that exist, {best} comes first by the time that was asked for, the faults that raise no alarm "
        f"and the mean delay of the others: {words}{f', against {others}' if others else ''}"
        f"{fast}: {claims['setting']}{where}. Gain sets: {gain_sets}."
    )


def relative_error(faults: Sequence[Mapping[str, Any]]) -> float:
    """Return the root mean square of ``rms / size`` over faults; infinite where there are none."""
    shares = [fault["rms"] / fault["size"] if fault["rms"] else 0.0 for fault in faults]
    return rms(shares) if shares else float("inf")


def mean_delay(delays: Sequence[float]) -> tuple[int, float] | None:
    """Return how many delays are infinite, and the mean of the finite ones; `None` where there are none at all."""
    known = [delay for delay in delays if not np.isnan(delay)]
    finite = [delay for delay in known if np.isfinite(delay)]
    if not known:
        return None
    return len(known) - len(finite), float(np.mean(finite)) if finite else float("inf")


def delay_in_words(delay: tuple[int, float], healthy_time: float) -> str:
    """Return what `ComparedMethod.equal_delay` is, in words."""
    missing, mean = delay
    words = "no fault raises an alarm" if np.isinf(mean) else f"alarms after {number(mean)} s"
    words += f" with {100 * healthy_time:g} % of healthy time in alarm"
    return f"{words} ({missing} without one)" if missing and np.isfinite(mean) else words


def short_delay(delay: tuple[int, float]) -> str:
    """Return the same in two or three words, for a list."""
    missing, mean = delay
    if np.isinf(mean):
        return "no alarm"
    return f"{number(mean)} s" + (f" ({missing} without one)" if missing else "")


def rms(errors: Sequence[float] | FloatArray) -> float:
    """Return the root of the mean square; where a sample is missing (NaN) there is no error."""
    values = np.asarray(errors, dtype=np.float64)
    values = values[~np.isnan(values)]
    return float(np.sqrt(np.mean(values**2))) if values.size else float("nan")

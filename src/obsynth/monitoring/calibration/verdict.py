"""Sentences on a calibration: on its constants and variances, its innovations, and the log."""

from __future__ import annotations

import itertools
from collections.abc import Mapping

import numpy as np

from obsynth.monitoring.calibration.diagnostics import OUTLYING, SIGNIFICANT, Consistency, Whiteness, mean_off
from obsynth.monitoring.calibration.innovations_fit import InnovationsFit
from obsynth.monitoring.calibration.integration_error import IntegrationError
from obsynth.monitoring.calibration.logs import EVEN, listed_rows
from obsynth.monitoring.calibration.noise_states import correlation_name
from obsynth.monitoring.calibration.problem import CalibrationProblem
from obsynth.monitoring.calibration.simulation_error import Fit, unexplained
from obsynth.monitoring.calibration.variance_names import variance_names
from obsynth.numerics.arrays import FloatArray
from obsynth.plants.calibrated_box import CalibratedBox

#: Constants whose correlation exceeds this are named together.
CORRELATED = 0.9

#: A sensor's variance below this multiple of its quantisation's is reported.
AT_QUANTISATION = 1.5

#: A timing that is better by this many nats is reported, even where it is not taken.
NOTED_NATS = 2.0

#: A variance of a sensor above this share of what its signal has stands for the signal.
SIGNAL_SHARE = 0.1


def on_constants(
    problem: CalibrationProblem,
    box: CalibratedBox,
    fit: InnovationsFit,
    at_end: tuple[str, ...],
    correlation: FloatArray,
    limited: list[str],
    Q: dict[str, float],
    R: dict[str, float],
) -> list[str]:
    """Return sentences on constants that the log does not determine, on their box, and on weak variances."""
    sentences = []
    for direction in fit.information.undetermined:
        listed = ", ".join(f"{name} {share:+.2g}" for name, share in direction.items())
        sentences.append(
            f"This log does not determine the direction ({listed}), in widths of the bounds: excite it, state a prior, "
            "or fix one of them."
        )
    sentences += [
        f"The box of {name} is open on its {side} side: the bound limits it there, the log does not."
        for name, side in box.open_sides
    ]
    sentences += [
        f"{name} is at a bound: noise that lasts as long as the log is a drift, or an error of the model."
        if name.startswith(correlation_name(""))
        else f"{name} is at a bound: widen it if the constant may lie beyond."
        for name in at_end
    ]
    free = [
        i
        for i, name in enumerate(problem.names)
        if not any(name in direction for direction in fit.information.undetermined)
    ]
    sentences += [
        f"{problem.unknown[i]} and {problem.unknown[j]} are correlated by {correlation[i, j]:+.2f}: their "
        "combination is known better than either."
        for i, j in itertools.combinations(free, 2)
        if abs(correlation[i, j]) > CORRELATED
    ]
    q, r = variance_names(tuple(Q), tuple(R))
    values = dict(zip((*q, *r), (*Q.values(), *R.values()), strict=True))
    if not box.stands:
        sentences.append(
            f"The box is not valid: its {100 * box.level:g} % are those of white innovations, which these are not."
        )
    return sentences + [
        f"The variance of {name} cannot be distinguished from zero: its upper limit {values[name]:.3g} is used."
        for name in limited
    ]


def on_misfits(problem: CalibrationProblem, start: Fit, whitened: FloatArray, R: dict[str, float]) -> list[str]:
    """Return sentences about sensors that the model does not follow, their mean, and single samples that stand out."""
    sentences = []
    for name in unexplained(problem, start.deviations):
        signal = float(np.nanvar(problem.y[:, problem.output_names.index(name)]))
        sentences.append(
            f"The best simulation explains almost nothing of {name}: "
            + (
                "its sign, its unit or its equation is wrong, and its R is the variance of the signal itself."
                if R[name] > SIGNAL_SHARE * signal
                else "noise of the equations drives it more than the inputs do."
            )
        )
    for name, column in zip(problem.output_names, whitened.T, strict=True):
        mean = mean_off(column)
        if mean:
            sentences.append(
                f"The innovations of {name} have the mean {mean:+.2f} deviations: a bias of the sensor, or an "
                "offset that the model lacks."
            )
        rows = problem.log.rows[0] + np.flatnonzero(np.abs(np.nan_to_num(column)) > OUTLYING)
        if len(rows):
            sentences.append(
                f"Samples of {name} stand out by more than {OUTLYING:g} deviations (row {listed_rows(rows)}): "
                "if they are outliers, mark them as missing."
            )
    return sentences


def on_innovations(nis: Consistency, colours: dict[str, Whiteness], row: int | None, simulated: bool) -> list[str]:
    """Return sentences on innovations that are not white, not of the stated size, or not of one mean."""
    sentences = [
        f"The innovations of {name} are not white (p = {test.probability:.2g}, first autocorrelation "
        f"{test.first:+.2f}): a signal that acts on {name} is not in the model."
        for name, test in colours.items()
        if test.probability < SIGNIFICANT
    ]
    if simulated and sentences:
        sentences.append(
            "The residuals of a simulation that are not white make boxes too small: use method='innovations'."
        )
    if not simulated and not nis.holds:
        sentences.append(f"NIS per degree of freedom is {nis.value:.2f}, outside {nis.low:.2f} to {nis.high:.2f}.")
    if row is not None:
        sentences.append(
            f"These rows are not homogeneous: the mean of the innovations changes at row {row}. If a fault "
            "begins there, end the rows before it."
        )
    return sentences


def _rows_away(rows: int) -> str:
    """Return a number of rows, which is negative for earlier ones, in words."""
    return f"{abs(rows)} {'row' if abs(rows) == 1 else 'rows'} {'later' if rows > 0 else 'earlier'}"


def on_log(
    problem: CalibrationProblem, R: dict[str, float], losses: Mapping[int, float], error: IntegrationError | None
) -> list[str]:
    """Return sentences on quantisation, timing and integration."""
    sentences, delay = list[str](), problem.log.input_delay
    for name, step in zip(problem.output_names, problem.quanta, strict=True):
        if step > 0.0 and R[name] < AT_QUANTISATION * step**2 / EVEN:
            sentences.append(
                f"The noise of {name} is at its quantisation ({step:.3g} / sqrt 12): its R is at least that of the "
                "quantisation."
            )
    if delay and losses:
        rows = "1 row" if delay == 1 else f"{delay} rows"
        gained = losses[0] - losses[delay]
        sentences.append(f"The inputs act {rows} later than the log states: better by {gained:.1f} nats.")
    lost = losses.get(delay, 0.0)
    if lost > NOTED_NATS:
        least = min(losses, key=lambda rows: losses[rows])
        sentences.append(
            f"Inputs that act {_rows_away(least - delay)} than is taken here would be better by {lost:.1f} nats: give "
            f"input_delay = {least} if the log is so late."
        )
    if error is not None:
        used = "Radau" if problem.integration == "radau" else "backward Euler"
        movement = f" and moves a constant by {error.moved:.2g} of its own" if error.moved else ""
        sentences.append(
            f"A step of backward Euler has an error of at most {error.largest:.2g} deviations of "
            f"{error.sensor}{movement}: "
            f"{used} is used."
        )
    return sentences

"""A proof of an alarm from measured data."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np

from obsynth.errors import SpecError
from obsynth.methods.guaranteed_test.method import is_guaranteed
from obsynth.methods.guaranteed_test.result import GuaranteedTest
from obsynth.monitoring.alarms.multipliers import rows_of_test
from obsynth.monitoring.alarms.proof_file import AlarmProof, proved_alarm
from obsynth.monitoring.logs.log_run import LogRun
from obsynth.monitoring.logs.sources import Data, samples
from obsynth.monitoring.thresholds.options import WINDOW
from obsynth.numerics.arguments import arguments_checked, whole_number
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.window.observer import WindowObserver
from obsynth.results.design import ObserverDesign
from obsynth.verification.assumptions import LogReference


@arguments_checked
def prove_alarm(
    design: ObserverDesign,
    data: Data,
    row: int,
    *,
    window: int = WINDOW,
    disturbance_bounds: Mapping[str, float] | None = None,
    noise_bound: float | None = None,
    initial_set: Mapping[str, Any] | None = None,
    state_bounds: Mapping[str, Any] | None = None,
    columns: Mapping[str, str] | None = None,
    scales: Mapping[str, float] | None = None,
    unverified: bool = False,
    disturbance: Literal["any", "held"] = "any",
) -> AlarmProof:
    """Return a proof that measured data up to a row are not fault-free, or that there is none.

    The alarm of a guaranteed test is proved by one fraction for each equation of its window, on the bounds of its
    design: added up, the equations leave a sum of disturbances and noise that the bounds do not allow.  For other
    designs the window's samples are written as a linear programme over states, disturbances, noise and constants
    (products by McCormick); its dual is checked in rational arithmetic.  "Cannot be proved" is an answer, not an error.

    Parameters
    ----------
    design : ObserverDesign
        Linear, discrete in time; its plant's tolerances count.
    data : path, text stream or pandas.DataFrame
        As for `run_on_data`, without gaps from the first row to ``row`` (guaranteed tests: in the window).
    row : int
        Last row of the window, counted from 1.
    window : int, optional
        Samples.
    disturbance_bounds : mapping, optional
        Largest absolute value of each disturbance by name.
    noise_bound : float, optional
        Standard deviations that no component of the noise exceeds.
    initial_set : mapping, optional
        Bounds of the plant's states at the first row, as for `online_monitor`: bounds in the window follow from the
        observer, and what is proved is a fault since the first row.
    state_bounds : mapping, optional
        Without ``initial_set``: bounds of the absolute value of every state in the window.
    columns, scales : mapping, optional
        As for `run_on_data`.
    unverified : bool, optional
        Whether a design that fails its own verification gives the answer "cannot be proved" instead of an error.
    disturbance : {"any", "held"}, optional
        What disturbances do between the samples of a plant that was sampled from a continuous one: anything within
        their bounds, or nothing, which the statement and the certificate then repeat.  Of a plant in discrete time they
        are held.  For guaranteed tests an option of their design.

    Returns
    -------
    AlarmProof
        `proved`, a sentence, and the certificate, which `AlarmProof.save` writes for ``obsynth verify``.

    Raises
    ------
    SpecError
        The data or an option is malformed, or nothing bounds a signal.
    VerificationError
        The design fails its own verification.

    Notes
    -----
    A. Neumaier and O. Shcherbina, "Safe bounds in linear and mixed-integer linear programming", Math. Programming 99,
    2004; G. McCormick, "Computability of global solutions to factorable nonconvex programs", 1976.

    Examples
    --------
    >>> import pandas as pd
    >>> import obsynth
    >>> plant = obsynth.uncertain_system(
    ...     {"A": [["a"]], "B": [[1]], "C": [[1]], "Bf": [[1]], "dt": 1.0},
    ...     {"a": {"nominal": 0.5, "tolerance": "5 %"}},
    ... )
    >>> design = obsynth.fault_estimation_filter(plant)
    >>> log = pd.DataFrame({"time": range(6), "u1": 0.0, "y1": [0.0, 0.0, 0.0, 1.0, 0.5, 0.25]})  # row 4 jumps
    >>> proof = obsynth.prove_alarm(design, log, 4, initial_set={"x1": 0.1})
    >>> proof.proved
    True
    """
    whole_number(row, "row", "the number of a row", least=2)
    if isinstance(design.observer, WindowObserver):
        raise SpecError(
            "prove-alarm is for plants with constant matrices: of this test obsynth verify proves the threshold of "
            "each row.",
            path="observer",
        )
    own = max(map(rows_of_test, GuaranteedTest.of(design).tests)) if is_guaranteed(design) else None
    if own is not None and window not in (WINDOW, own):
        raise SpecError(f"window is {window}: the window of this test has {own} samples.", path="window")
    values, nu = rows_of(design, data, row, columns, scales, own), design.linear[0].nu
    log = LogReference.of(Path(data), columns, scales) if isinstance(data, (str, Path)) else None
    return proved_alarm(
        design,
        values[:, :nu],
        values[:, nu:],
        window=window,
        disturbance_bounds=disturbance_bounds,
        noise_bound=noise_bound,
        initial_set=initial_set,
        state_bounds=state_bounds,
        log=log,
        unverified=unverified,
        disturbance=disturbance,
    )


def rows_of(
    design: ObserverDesign,
    data: Data,
    row: int,
    columns: Mapping[str, str] | None = None,
    scales: Mapping[str, float] | None = None,
    complete: int | None = None,
) -> FloatArray:
    """Return the rows of data up to one, ``(row, nu + ny)``, as a design reads them; refuse what has gaps.

    ``complete``: so many of the last rows have to be without gaps; all by default.
    """
    run = LogRun(design, columns, scales)
    rows, flawed, count, status = list[FloatArray](), list[tuple[bool, bool, int]](), 0, ""
    for count, (time, values) in enumerate(itertools.islice(samples(data, run.signals), row), 1):
        status = run.clock.stale(time)
        if status:
            # The same rows are left out as in a run.
            continue
        _, missing = run.clock.advance(time, count)
        flawed.append((bool(missing and rows), not np.isfinite(values).all(), count))
        rows.append(values)
    if count < row:
        raise SpecError(f"The data have {count} rows: row {row} is not among them.", path="row")
    if status:
        raise SpecError(f"Row {row} is left out ({status}): give another one.", path="row")
    for place, (gap, blank, number) in enumerate(flawed[-(complete or len(flawed)) :]):
        # Of what is before the first row of a window nothing is asked.
        if blank or (gap and (place or complete is None)):
            raise SpecError(f"Row {number} has a gap before it or misses a sample: give complete rows.", path="data")
    return np.array(rows)

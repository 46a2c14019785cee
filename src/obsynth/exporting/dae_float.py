"""Measured error of the C code of a nonlinear observer in single precision.

No bound follows from the design alone, as each step is solved by iteration: the C runs beside the observer in double
precision over records that are simulated from the design, with missing samples.
"""

from __future__ import annotations

import ctypes
import re
from pathlib import Path

import numpy as np

from obsynth.errors import ObsynthError, SpecError
from obsynth.exporting.c_source import filled_template
from obsynth.files.outputs import working_folder
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.estimates import Estimates
from obsynth.observers.nonlinear.c_code import FLAGS, compiler, shared_library
from obsynth.results.design import ObserverDesign
from obsynth.simulation.dae import simulate_dae

#: Samples of each record that errors are measured on, their seeds, and the samples without outputs.
RECORD_SAMPLES, SEEDS = 400, (1, 2)

MISSING_SAMPLES = slice(200, 205)

#: Errors beyond this share of an estimate's own deviation: single precision does not carry the observer.
LARGEST_ERROR_SHARE = 0.5


def float_error(design: ObserverDesign, prefix: str, source: str, declared: str) -> str:
    """Return what the header of an export in floats says of its error; raise `SpecError` where it is too large."""
    model = design.nonlinear[0]
    names = [*(f"xhat[{name}]" for name in model.state_names), *(f"fhat[{name}]" for name in model.parameter_names)]
    worst, shares = np.zeros(len(names)), np.zeros(len(names))
    with working_folder() as folder:
        library = _compiled(folder, prefix, source, declared, model.nu, model.ny, (model.nx, model.nq))
        for seed in SEEDS:
            u, y, expected = _record(design, seed)
            expected_estimates = np.hstack([expected.states, expected.faults])
            deviations = np.hstack([expected.state_deviations, expected.fault_deviations])
            estimates = _run_in_floats(library, u, y, expected_estimates.shape[1])
            error = np.abs(estimates - expected_estimates)
            worst = np.maximum(worst, error.max(axis=0))
            with np.errstate(divide="ignore", invalid="ignore"):
                share = np.where(error > 0.0, error / deviations, 0.0)[1:]
            shares = np.maximum(shares, share.max(axis=0))
    if not (np.isfinite(worst).all() and (shares <= LARGEST_ERROR_SHARE).all()):
        at = int(np.argmax(np.where(np.isfinite(shares), shares, np.inf)))
        raise SpecError(
            f"Single precision does not carry this observer: {names[at]} is off by {worst[at]:.2g}, "
            f"{shares[at]:.2g} of its own standard deviation. Leave precision at double.",
            path="precision",
        )
    listed = ", ".join(f"{name} {error:.2g}" for name, error in zip(names, worst, strict=True))
    return (
        f"Floats: measured, not proved: the largest error against double precision in {len(SEEDS)} records of "
        f"{RECORD_SAMPLES} samples simulated from the design (5 of them missing): {listed}; at most "
        f"{shares.max(initial=0.0):.2g} of an estimate's own standard deviation"
    )


def _record(design: ObserverDesign, seed: int) -> tuple[FloatArray, FloatArray, Estimates]:
    """Return inputs and outputs, as floats hold them, of the plant with the noise that the observer assumes, and what
    the observer says of them in doubles."""
    model, observer = design.nonlinear
    u = np.tile(model.nominal_input, (RECORD_SAMPLES, 1)).reshape(RECORD_SAMPLES, model.nu)
    try:
        simulation = simulate_dae(
            model,
            u,
            dt=observer.dt,
            parameters=observer.initial_parameters,
            initial_state=observer.initial_state,
            Q=observer.Q,
            R=observer.R,
            integration=observer.integration,
            seed=seed,
        )
        y = np.array(simulation.outputs)
        y[MISSING_SAMPLES] = np.nan
        u, y = (values.astype(np.float32).astype(np.float64) for values in (u, y))
        return u, y, observer.run(y, u)
    except ObsynthError as error:
        raise SpecError(
            "The error of single precision is measured on a record that is simulated from the design, which fails: "
            f"{error} Leave precision at double.",
            path="precision",
        ) from error


def _compiled(
    folder: Path, prefix: str, source: str, declared: str, nu: int, ny: int, counts: tuple[int, int]
) -> ctypes.CDLL:
    """Return the C of an observer as a loaded library, with a loop over the samples of a record."""
    command = compiler()
    if command is None:
        raise SpecError(
            "The error of a nonlinear observer in floats is measured by running it: this needs a C compiler (cc, gcc "
            "or clang, or what CC in the environment names). Install one, or leave precision at double.",
            path="precision",
        )
    arguments = f"in, in + {nu}" if nu else "in"
    sizes = {"STATES": str(counts[0]), "FAULTS": str(counts[1]), "TAKEN": str(nu + ny)}
    harness = filled_template("run_floats.c", prefix, {"ARGUMENTS": arguments, **sizes})
    own = re.sub(r'^#include ".*"$', '#include "observer.h"', source, count=1, flags=re.MULTILINE)
    texts = {"observer.h": declared, "observer.c": own, "run.c": harness}
    return ctypes.CDLL(str(shared_library(folder, texts, [*command, *FLAGS], path="precision")))


def _run_in_floats(library: ctypes.CDLL, u: FloatArray, y: FloatArray, width: int) -> FloatArray:
    """Return the estimates ``(n, width)`` of the C in single precision over a record."""
    samples = np.ascontiguousarray(np.hstack([u, y]), dtype=np.float32)
    estimates = np.zeros((len(y), width))
    count = library.run(
        samples.ctypes.data_as(ctypes.POINTER(ctypes.c_float)),
        estimates.ctypes.data_as(ctypes.POINTER(ctypes.c_double)),
        len(y),
    )
    if count < len(y):
        raise SpecError(
            f"Single precision does not carry this observer: its step {count} has no solution there. Leave precision "
            "at double.",
            path="precision",
        )
    return estimates

"""Writing a gain set for other programs."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from obsynth.errors import SpecError
from obsynth.exporting.c_source import header_text, source_text
from obsynth.exporting.c_words import c_identifier
from obsynth.exporting.dae_c_source import write_dae_c
from obsynth.exporting.realisation import Realisation
from obsynth.numerics.arguments import require_kind
from obsynth.observers.dae.observer import DAEObserver
from obsynth.results.design import ObserverDesign
from obsynth.results.files import write_atomically

SUFFIXES = (".mat", ".npz", ".c")


def export(design: ObserverDesign, path: str | Path, *, sample_time: float | None = None) -> tuple[Path, ...]:
    """Write the observer of a design for MATLAB and Simulink, for numpy, or as C99.

    Parameters
    ----------
    design : ObserverDesign
        Linear, or recursive for a time-invariant plant: then the steady state of its recursion, which is what it is
        once the covariances have settled.
    path : path
        Its suffix says what is written.  ``.mat`` and ``.npz``: ``A (nz, nz)``, ``B (nz, nu + ny)``, ``C``, ``D``,
        ``x0 (nz, 1)`` and ``Ts`` (seconds, 0 for continuous time) of the system from ``[u; y]`` to
        ``[xhat; fhat; r]``, as a State-Space block takes them, with ``input_names``, ``output_names``, ``delays``
        (samples, of states and faults), ``input_point``, ``output_point``, ``name``, ``method`` and ``sha256``.
        ``.c``: a source file and the header beside it, with functions ``<stem>_reset`` and ``<stem>_step``; the only
        one for an observer of a nonlinear DAE, which holds the implicit step with its homotopy.
    sample_time : float, optional, seconds
        Samples a continuous-time observer by a first-order hold; needed for C.

    Returns
    -------
    tuple of Path
        The files.

    Raises
    ------
    SpecError
        A plant or its noise changes with k, the plant is nonlinear, the suffix is unknown, the sample time is missing
        or does not fit, or a file cannot be written.
    PreconditionError, SolverError
        A recursive design has no stable steady state, or none that is reached.

    Notes
    -----
    Every file holds the sha256 digest of the gain set.  Signals are deviations from the operating point.
    """
    require_kind(path, (str, Path), "path", "the name of a file")
    target = Path(path)
    suffix = target.suffix.lower()
    if suffix not in SUFFIXES:
        raise SpecError(f"{target} has an unknown suffix: use one of {', '.join(SUFFIXES)}.", path=str(target))
    if isinstance(design, ObserverDesign) and isinstance(design.observer, DAEObserver):
        return write_dae_c(design, target, sample_time)
    found = Realisation.of(design, sample_time)
    if suffix == ".c":
        return _write_c(found, target)
    buffer = io.BytesIO()
    if suffix == ".npz":
        np.savez(buffer, **found.as_arrays())
    else:
        from scipy.io import savemat

        arrays = found.as_arrays()
        # Cell arrays of texts, and vectors as columns.
        named = {
            key: np.array(value, dtype=object) if isinstance(value, list) else value for key, value in arrays.items()
        }
        savemat(buffer, named, oned_as="column")
    return (write_atomically(target, buffer.getvalue()),)


def _write_c(found: Realisation, target: Path) -> tuple[Path, ...]:
    if found.observer.dt == 0.0:
        raise SpecError("The observer is continuous in time: give the sample time, in seconds, for C.",
                        path="sample_time")  # fmt: skip
    prefix = c_identifier(target.stem)
    header = target.with_suffix(".h")
    source = source_text(found, prefix, header.name)
    # The source is refused first if it cannot be written, so that no header stays behind alone.
    written = write_atomically(target, source)
    return written, write_atomically(header, header_text(found, prefix))

"""Why a log cannot be used, or a model not be fitted to it: errors with a code that stays the same."""

from __future__ import annotations

from collections.abc import Sequence

from obsynth.errors import PreconditionError, SpecError


def bad_log(code: str, message: str, *, path: str = "log") -> SpecError:
    """Return the error of a log that is malformed: ``irregular``, ``nan``, ``time``, ``empty``, ``too-short``."""
    return SpecError(message, path=path, code=code)


def refused(code: str, message: str, *, signals: Sequence[str] = ()) -> PreconditionError:
    """Return the error of a log that cannot determine what is asked, or of a model that cannot follow it."""
    return PreconditionError(message, condition=code, signals=signals)

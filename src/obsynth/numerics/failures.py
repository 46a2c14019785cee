"""What a failed computation is for the user: the numbers are beyond double precision, and nothing is known."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from obsynth.errors import SolverError

#: How scipy says that an overflow has reached LAPACK.
_NOT_FINITE = "infs or NaNs"


def failure_of(error: Exception) -> SolverError | None:
    """Return what the error of a library says of the numbers; `None` if it says nothing of them."""
    is_numerical = isinstance(error, (np.linalg.LinAlgError, ArithmeticError))
    if not is_numerical and not (isinstance(error, ValueError) and _NOT_FINITE in str(error)):
        return None
    return SolverError(
        f"LAPACK gave up ({str(error).rstrip('.')}): the numbers are beyond double precision. Nothing is known; look "
        "at the units of the plant and at the options."
    )


@contextmanager
def failed_computations() -> Iterator[None]:
    """Raise `SolverError` where LAPACK or the range of numbers fails; also a decorator."""
    try:
        yield
    except (np.linalg.LinAlgError, ArithmeticError, ValueError) as error:
        told = failure_of(error)
        if told is None:
            raise
        raise told from error
